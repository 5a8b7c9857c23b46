"""Scenes around the boxes of a real, labeled scan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..types.choices import VEHICLES
from ..types.geometry import wrapped
from ..types.perception import Box
from .raycast import LANE, SLOPE_X, SLOPE_Y
from .roadside import add_beside_people, add_cafe, add_parked_bicycles, add_roadside
from .scene import NUMBERS, Scene
from .shapes import Row
from .street import IN_BAYS, ROW_RANGE_M, SHAPES, Street, any_vehicle, random_terrain, strip_row

_ROW_GAP_M = 9.0  # between the centers of two parked cars


def scene_from_boxes(boxes: Sequence[Box], seed: int, *, mount_height_m: float = 1.73) -> Scene:
    """Make a street around a real layout of boxes.

    Parameters
    ----------
    boxes : sequence of Box
        In a sensor frame with its origin ``mount_height_m`` above the road. Boxes with labels other than KITTI's are
        left out.
    seed : int
        Seed of everything else: road edges, roadside, and objects outside the labeled view.
    mount_height_m : float
        Height of the sensor above the road [m].

    Returns
    -------
    Scene
        Its first objects are the ``boxes``, in order. They stand on the ground of the scene, so z
        differs slightly from the boxes.
    """
    NUMBERS.number("mount_height_m", mount_height_m)
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 15485863))
    vehicles = [box for box in boxes if box.label in VEHICLES]
    heading, curvature = _road_direction(vehicles)
    lane = rng.uniform(2.9, 3.6)
    # Vehicles along the road widen it; vehicles across it stand on another road or in a yard.
    beside: list[tuple[float, float, float, float]] = []
    across: list[float] = []
    for box in vehicles:
        s, u = _along(box, heading, curvature)
        turn = box.yaw - heading - curvature * s
        if abs(math.sin(turn)) < 0.35 and abs(u) < 9.5:
            beside.append((s, u, box.size[1] / 2, math.cos(turn)))
        elif abs(math.sin(turn)) > 0.8 and abs(u) < 9.0 and s > 5.0:
            across.append(s)
    right = min([-lane / 2 - 0.2, *(u - w - 0.3 for _, u, w, _ in beside)])
    left = max([lane / 2 + 0.2, *(u + w + 0.3 for _, u, w, _ in beside)])
    if left < 3.0 and rng.random() < 0.7:
        left += lane  # an empty lane for oncoming traffic
    right -= rng.uniform(0.0, 0.8)
    left += rng.uniform(0.0, 0.8)
    on_foot = any(box.label == "pedestrian" for box in boxes)
    fast = len(beside) > 0 and not on_foot and rng.random() < 0.15
    place = str(rng.choice(["urban", "residential"])) if not fast else str(rng.choice(["rural", "highway"]))
    bays: list[Row] = []
    if rng.random() < IN_BAYS:
        right, left, bays = _parking_rows(beside, lane, right, left, heading, curvature)
    strips = [strip_row(0, 0, heading, curvature, right, left)]
    crossings: list[float] = []
    if across or rng.random() < 0.4:
        s = float(np.median(across)) if across else rng.uniform(10.0, 55.0)
        crossings.append(s)
        x, y = s * math.cos(heading), s * math.sin(heading) + curvature * s * s / 2
        width = rng.uniform(2.4, 5.5)
        ends = ((-200.0, 200.0), (0.0, 200.0), (-200.0, 0.0))[int(rng.integers(0, 3)) if not across else 0]
        turn = heading + curvature * s + math.pi / 2 + rng.normal(0.0, 0.2) * (not across)
        strips.append(strip_row(x, y, turn, 0.0, -width, width, ends))
    strips += bays
    terrain = random_terrain(rng, place)
    terrain[LANE] = lane
    bottoms = np.array([(b.center[0], b.center[1], b.center[2] - b.size[2] / 2 + mount_height_m) for b in vehicles])
    if len(bottoms) >= 3:
        # Slopes of the ground under the boxes, by least squares, regularized towards level by 1,000 m2.
        xy = bottoms[:, :2]
        slopes = np.linalg.solve(xy.T @ xy + 1000.0 * np.eye(2), xy.T @ bottoms[:, 2])
        terrain[[SLOPE_X, SLOPE_Y]] = np.clip(slopes, -0.04, 0.04)
    street = Street(rng, strips, terrain)
    street.take(-0.3, 0.0, 4.8, 2.2, 0.0)
    for box in boxes:
        if box.label in SHAPES:
            s, _ = _along(box, heading, curvature)
            ahead = math.cos(box.yaw - heading - curvature * s)
            moving = box.label in ("pedestrian", "cyclist") or ahead > 0.5
            pace = {"pedestrian": 1.3, "cyclist": 4.0}.get(box.label, 9.0)
            speed = float(pace * rng.uniform(0.5, 1.2)) if moving and rng.random() < 0.6 else 0.0
            street.add_object(box.label, *box.center[:2], box.yaw, box.size, speed, force=True)
    # Labeled objects are visible, so mostly keep the line of sight to them free.
    for box in boxes:
        away = math.hypot(box.center[0], box.center[1])
        if away > 8.0 and rng.random() < 0.85:
            share = 0.5 + 2.0 / away
            x, y = box.center[0] * share, box.center[1] * share
            street.take(x, y, away - 4.0, 1.0, math.atan2(box.center[1], box.center[0]))
    # Objects behind the sensor and far to its sides are not labeled, so mirror some of the labeled vehicles.
    for s, u, _, ahead in beside:
        if rng.random() < 0.7:
            x, y, yaw = street.on_strip(-s + rng.normal(0, 3.0), u)
            yaw += math.pi * (ahead < 0.0)
            street.add_object(any_vehicle(rng, 0.03), x, y, yaw)
    _add_unlabeled_people(street, boxes)
    for box in boxes:
        if box.label in ("pedestrian", "person_sitting") and rng.random() < 0.3:
            add_beside_people(street, *box.center[:2], box.yaw)
    add_parked_bicycles(street, 0.6 if not fast else 0.0)
    add_cafe(street, 0.0 if fast else 0.15)
    add_roadside(street, place)
    return street.scene()


def _parking_rows(
    beside: Sequence[tuple[float, float, float, float]],
    lane: float,
    right: float,
    left: float,
    heading: float,
    curvature: float,
) -> tuple[float, float, list[Row]]:
    """Find the road edges without the outermost rows of parked vehicles, and bays for those rows.

    A row counts as parked if it has at least two vehicles outside the sensor's lane, two of them close together.
    """
    edges, bays = {-1.0: -right, 1.0: left}, []
    for side in edges:
        own = [(s, side * u, w) for s, u, w, _ in beside if side * u - w > lane / 2 + 0.3]
        outermost = max((u for _, u, _ in own), default=0.0)
        row = sorted((s, u, w) for s, u, w in own if outermost - u < 0.8)
        gaps = np.diff([s for s, _, _ in row])
        if len(row) < 2 or gaps.min() > _ROW_GAP_M:
            continue
        inner = min(u - w for _, u, w in row) - 0.2
        bay = (inner, edges[side]) if side > 0 else (-edges[side], -inner)
        bays.append(strip_row(0, 0, heading, curvature, *bay, ROW_RANGE_M, True))
        edges[side] = inner
    return -edges[-1.0], edges[1.0], bays


def _add_unlabeled_people(street: Street, boxes: Sequence[Box]) -> None:
    rng = street.rng
    for box in boxes:
        if box.label in ("pedestrian", "cyclist") and rng.random() < 0.7:
            x, y = -box.center[0] + rng.normal(0, 2), box.center[1] + rng.normal(0, 0.3)
            street.add_object(box.label, x, y, box.yaw, box.size, 1.0)


def _along(box: Box, heading: float, curvature: float) -> tuple[float, float]:
    cos, sin = math.cos(heading), math.sin(heading)
    s = cos * box.center[0] + sin * box.center[1]
    return s, cos * box.center[1] - sin * box.center[0] - curvature * s * s / 2


def _road_direction(vehicles: Sequence[Box]) -> tuple[float, float]:
    """Estimate heading [rad] and curvature [1/m] of the road, from the vehicles near the sensor's lane."""
    leaning = []
    for box in vehicles:
        turn = wrapped(2.0 * box.yaw) / 2.0  # modulo pi
        if abs(turn) < 0.45 and abs(box.center[1]) < 4.0 + 0.35 * abs(box.center[0]):
            leaning.append((box.center[0], turn))
    if not leaning:
        return 0.0, 0.0
    s, turn = np.array(leaning).T
    if len(leaning) >= 3 and np.ptp(s) > 15.0:
        # Regularized towards straight ahead at the sensor, because the ego vehicle follows the road.
        weights = np.array([[60.0 + len(s) * 4.0, s.sum()], [s.sum(), (s * s).sum() + 3000.0]])
        heading, curvature = np.linalg.solve(weights, np.array([turn.sum(), (s * turn).sum()]))
        return float(np.clip(heading, -0.08, 0.08)), float(np.clip(curvature, -0.012, 0.012))
    return float(np.clip(np.median(turn) * 0.5, -0.08, 0.08)), 0.0
