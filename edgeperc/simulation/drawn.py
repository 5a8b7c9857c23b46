"""Random scenes: streets with traffic, parked cars and people."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..errors import PointsError
from .raycast import LANE, PAVEMENT
from .roadside import add_beside_people, add_cafe, add_islands_poles, add_parked_bicycles, add_roadside
from .scene import Scene
from .shapes import Row
from .street import IN_BAYS, ROW_RANGE_M, ROW_WIDTH_M, SIZES, Street, any_vehicle, random_terrain, strip_row

ENVIRONMENTS = ("urban", "residential", "junction", "rural", "highway")


def random_scene(seed: int, environment: str | None = None) -> Scene:
    """Make a random street.

    Parameters
    ----------
    seed : int
        The same seed gives the same scene.
    environment : str, optional
        One of `ENVIRONMENTS`; random by default.

    Raises
    ------
    PointsError
        ``environment`` is not one of `ENVIRONMENTS`.
    """
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 104729))
    place = str(rng.choice(ENVIRONMENTS, p=[0.32, 0.28, 0.2, 0.12, 0.08])) if environment is None else environment
    if place not in ENVIRONMENTS:
        raise PointsError(f"got environment {place!r}; expected one of {', '.join(ENVIRONMENTS)}")
    terrain = random_terrain(rng, place)
    lane = float(rng.uniform(2.7, 3.7) if place != "highway" else rng.uniform(3.5, 3.9))
    terrain[LANE] = lane
    same, oncoming = 1, 1
    if place == "highway":
        same, oncoming = int(rng.integers(2, 4)), 0
    elif place in ("urban", "junction"):
        same, oncoming = ((1, 1), (1, 0), (2, 1), (2, 2))[int(rng.integers(0, 4))]
    park_right = park_left = 0.0
    if place in ("urban", "residential", "junction"):
        park_right, park_left = (ROW_WIDTH_M if rng.random() < 0.5 else 0.0 for _ in range(2))
    in_bays = rng.random() < IN_BAYS
    ego_lane = int(rng.integers(0, same))  # from the right
    sway = rng.normal(0.0, 0.25)
    right = -lane / 2 - ego_lane * lane - park_right + sway - rng.uniform(0.0, 0.6)
    left = lane / 2 + (same - 1 - ego_lane + oncoming) * lane + park_left + sway + rng.uniform(0.0, 0.6)
    curvature = rng.normal(0.0, 0.004) if rng.random() < 0.6 else 0.0
    heading = rng.normal(0.0, 0.03)
    strips = [strip_row(0, 0, heading, curvature, right, left)]
    crossings: list[float] = []
    if place == "junction" or (place != "highway" and rng.random() < 0.45):
        for _ in range(int(rng.integers(1, 4))):
            s = float(rng.uniform(8.0, 60.0) * rng.choice([1.0, 1.0, -1.0]))
            if any(abs(s - other) < 20.0 for other in crossings):
                continue
            crossings.append(s)
            x, y, turn = math.cos(heading) * s, math.sin(heading) * s + curvature * s * s / 2, heading + curvature * s
            across = turn + math.pi / 2 + rng.normal(0.0, 0.25)
            width = rng.uniform(2.0, 5.5)
            ends = ((-200.0, 200.0), (0.0, 200.0), (-200.0, 0.0))[int(rng.integers(0, 3))]
            strips.append(strip_row(x, y, across, rng.normal(0, 0.004), -width, width, ends))
    if in_bays:
        right, left = right + park_right, left - park_left
        strips[0] = strip_row(0, 0, heading, curvature, right, left)
        for edge, width in ((right - park_right, park_right), (left, park_left)):
            if width > 0.0:
                strips.append(strip_row(0, 0, heading, curvature, edge, edge + width, ROW_RANGE_M, True))
        park_right = park_left = 0.0
    if place in ("urban", "residential") and strips[-1][9] == 0.0 and rng.random() < 0.5:
        side = float(rng.choice([-1.0, 1.0]))
        start = rng.uniform(-30.0, 30.0)
        edge = left if side > 0 else -right
        deep = float(rng.choice([2.3, 5.0]))
        bay = (edge, edge + deep) if side > 0 else (-edge - deep, -edge)
        strips.append(strip_row(0, 0, heading, curvature, *bay, (start, start + rng.uniform(10.0, 45.0)), True))
    if place in ("urban", "residential", "junction") and rng.random() < 0.4:
        between = sway + (same - ego_lane - 0.5) * lane if oncoming else None  # where the two directions meet
        strips += _islands(rng, strips, crossings, right, left, between)
    street = Street(rng, strips, terrain)
    street.take(-0.3, 0.0, 4.8, 2.2, 0.0)  # the sensor's own vehicle
    for k in np.flatnonzero(street.strips[:, 9] < 0.0).tolist():
        u0, u1, s0, s1 = street.strips[k, 5:9].tolist()
        x, y, yaw = street.on_strip((s0 + s1) / 2, (u0 + u1) / 2, k)
        street.take(x, y, s1 - s0, u1 - u0, yaw)
    add_islands_poles(street)
    _add_traffic(street, place, lane, same, oncoming, ego_lane, sway)
    _add_parked(street, park_right > 0.0, park_left > 0.0, crossings, place)
    _add_people(street, place)
    add_cafe(street, 0.15 if place in ("urban", "residential", "junction") else 0.0)
    add_roadside(street, place)
    return street.scene()


def _islands(
    rng: np.random.Generator,
    strips: Sequence[Row],
    crossings: Sequence[float],
    right: float,
    left: float,
    between: float | None,
) -> list[Row]:
    """Draw islands in the mouths of side streets, and between the directions of the first road."""
    islands = []
    for k in range(1, 1 + len(crossings)):
        for first in (left + rng.uniform(1.0, 3.0), right - rng.uniform(1.0, 3.0)):
            half, length = rng.uniform(0.4, 1.0), rng.uniform(2.0, 8.0) * (1.0 if first > 0.0 else -1.0)
            ends = sorted((first, first + length))
            if strips[k][6] > 3.0 and strips[k][7] < ends[0] and ends[1] < strips[k][8] and rng.random() < 0.6:
                islands.append(strip_row(*_pose(strips[k]), strips[k][4], -half, half, (ends[0], ends[1]), island=True))
    if between is not None and rng.random() < 0.6:
        half, first = rng.uniform(0.3, 0.8), float(rng.uniform(6.0, 45.0) * rng.choice([1.0, 1.0, -1.0]))
        islands.append(
            strip_row(*_pose(strips[0]), strips[0][4], between - half, between + half,
                      (first, first + rng.uniform(2.5, 12.0)), island=True)
        )  # fmt: skip
    return islands


def _pose(strip: Row) -> tuple[float, float, float]:
    return strip[0], strip[1], math.atan2(strip[3], strip[2])


def _add_traffic(street: Street, place: str, lane: float, same: int, oncoming: int, ego_lane: int, sway: float) -> None:
    rng = street.rng
    density = {"urban": 0.022, "residential": 0.008, "junction": 0.022, "rural": 0.008, "highway": 0.016}[place]
    density *= rng.uniform(0.1, 1.8)
    pace = {"urban": 9.0, "residential": 7.0, "junction": 7.0, "rural": 18.0, "highway": 27.0}[place]
    for number in range(-ego_lane, same - ego_lane + oncoming):
        u = sway + number * lane
        against = number >= same - ego_lane
        for _ in range(int(rng.poisson(density * 150.0))):
            s = rng.uniform(-70.0, 80.0)
            x, y, yaw = street.on_strip(s, u + rng.normal(0.0, 0.25))
            label = any_vehicle(rng, 0.12 if place == "highway" else 0.05)
            speed = pace * rng.uniform(0.3, 1.2) if rng.random() < 0.8 else 0.0
            turn = float(street.strips[0, 4]) * speed * (-1.0 if against else 1.0)
            yaw += math.pi * against + rng.normal(0.0, 0.03)
            if place == "urban" and rng.random() < 0.02:
                label = "tram"
            placed = street.add_object(label, x, y, yaw, None, speed, turn)
            if placed and label in ("car", "van") and rng.random() < 0.03:
                away = street.objects[-1].size[0] / 2 + 2.2
                x, y = x - away * math.cos(yaw), y - away * math.sin(yaw)
                street.add_object("misc", x, y, yaw, (3.4, 1.7, rng.uniform(1.1, 2.4)), speed, turn)
    for k in range(1, len(street.strips)):
        if street.strips[k, 9] != 0.0:
            continue
        for _ in range(int(rng.poisson(2.5))):
            s = rng.uniform(street.strips[k, 7], street.strips[k, 8]) * 0.2
            against = bool(rng.random() < 0.5)
            u = street.strips[k, 6] * 0.5 * (1.0 if against else -1.0)
            x, y, yaw = street.on_strip(s, u, k)
            if street.ground(x, y)[1] < -1.0:
                label = any_vehicle(rng, 0.05)
                street.add_object(label, x, y, yaw + math.pi * against, None, float(rng.choice([0.0, 5.0])))
    if place != "highway":
        for _ in range(int(rng.poisson(1.9))):
            left = bool(rng.random() < 0.35)
            edge = street.strips[0, 6] if left else street.strips[0, 5]
            s = rng.uniform(-30.0, 45.0)
            x, y, yaw = street.on_strip(s, edge + rng.uniform(0.4, 2.6) * (-1 if left else 1))
            yaw += math.pi * left + rng.normal(0, 0.15)
            street.add_object("cyclist", x, y, yaw, None, rng.uniform(1.0, 7.0))
            if rng.random() < 0.15:  # two of them, one behind or beside the other
                a, b = (rng.uniform(2.0, 4.0), 0.2) if rng.random() < 0.6 else (0.3, 1.0)
                x, y = x - a * math.cos(yaw) + b * math.sin(yaw), y - a * math.sin(yaw) - b * math.cos(yaw)
                street.add_object("cyclist", x, y, yaw, None, rng.uniform(1.0, 7.0))


def _add_parked(street: Street, right: bool, left: bool, crossings: Sequence[float], place: str) -> None:
    rng = street.rng
    for on, side in ((right, -1.0), (left, 1.0)):
        fill = rng.uniform(0.2, 0.95)
        edge = abs(float(street.strips[0, 6 if side > 0 else 5]))
        shift = rng.uniform(-0.9, 0.1) if on else rng.uniform(0.3, 1.3)  # otherwise half on the pavement, for some cars
        if not on and (rng.random() > 0.25 or place in ("rural", "highway")):
            continue
        s = -70.0
        while s < 78.0:
            label = any_vehicle(rng, 0.02)
            length = SIZES[label][0][0]
            s += length / 2
            if rng.random() < fill and all(abs(s - c) > 9.0 for c in crossings):
                x, y, yaw = street.on_strip(s, side * (edge + shift - 0.9 + rng.normal(0, 0.12)))
                yaw += math.pi * bool(rng.random() < (0.12 if side < 0 else 0.75)) + rng.normal(0, 0.03)
                street.add_object(label, x, y, yaw)
            s += length / 2 + rng.uniform(0.5, 1.6)
    for k in range(1, len(street.strips)):
        u0, u1, s0, s1, bay = street.strips[k, 5:10]
        if bay <= 0.0:
            continue
        deep, fill = u1 - u0 > 4.0, rng.uniform(0.1, 0.95)
        for s in np.arange(s0 + 1.3, s1 - 1.0, 2.6 if deep else 5.6):
            if rng.random() < fill:
                x, y, yaw = street.on_strip(s, float((u0 + u1) / 2 + rng.normal(0, 0.15)), k)
                if street.ground(x, y)[1] < 0.0:
                    continue  # where another road crosses
                turn = math.pi / 2 if deep else 0.0
                yaw += turn + math.pi * bool(rng.random() < 0.5) + rng.normal(0, 0.04)
                street.add_object("car" if rng.random() < 0.85 else "van", x, y, yaw)
    if place in ("urban", "residential", "junction"):  # cars in drives and yards
        for _ in range(int(rng.poisson(3.0))):
            side = float(rng.choice([-1.0, 1.0]))
            edge = street.edge(0, side) + street.terrain[PAVEMENT]
            x, y, yaw = street.on_strip(rng.uniform(-50, 70), side * float(edge + rng.uniform(2.5, 9.0)))
            if street.ground(x, y)[1] > 2.0:
                street.add_object("car", x, y, yaw + float(rng.choice([0.0, 0.5, 1.0, 1.5]) * math.pi))


def _add_people(street: Street, place: str) -> None:
    rng = street.rng
    mean = {"urban": 7.5, "residential": 4.0, "junction": 7.5, "rural": 0.6, "highway": 0.0}[place]
    for _ in range(int(rng.poisson(mean))):
        side = float(rng.choice([-1.0, 1.0]))
        edge = street.edge(0, side)
        s = rng.uniform(-30.0, 50.0)
        u = side * (edge + rng.uniform(0.4, max(0.8, street.terrain[PAVEMENT])))
        if rng.random() < 0.1:
            u = rng.uniform(-edge, edge)  # on the road
        x, y, yaw = street.on_strip(s, u)
        yaw += float(rng.choice([0.0, math.pi])) if rng.random() < 0.75 else rng.uniform(-math.pi, math.pi)
        speed = rng.uniform(0.6, 1.8) if rng.random() < 0.75 else 0.0
        if rng.random() < 0.06:
            street.add_object("person_sitting", x, y, yaw)
            continue
        # Alone, in a group, or in a crowd.
        others = int(rng.integers(1, 4)) if rng.random() < 0.3 else int(rng.integers(4, 9)) * bool(rng.random() < 0.04)
        for _ in range(1 + others):
            spread = 0.5 if others < 4 else 1.2
            px, py = x + rng.normal(0, spread), y + rng.normal(0, spread)
            size = None
            if rng.random() < 0.08:  # a child
                size = (rng.uniform(0.35, 0.7), rng.uniform(0.35, 0.5), rng.uniform(0.95, 1.45))
            street.add_object("pedestrian", px, py, yaw + rng.normal(0, 0.2), size, speed)
        if rng.random() < 0.4:
            add_beside_people(street, px, py, yaw)
    standing = [each for each in street.objects if each.label in ("car", "van") and each.speed_mps == 0.0]
    for _ in range(int(rng.poisson(1.2)) if standing and mean > 1.0 else 0):  # beside a vehicle that stands
        car = standing[int(rng.integers(0, len(standing)))]
        a = rng.uniform(-0.6, 0.6) * car.size[0]
        b = float(rng.choice([-1.0, 1.0])) * (car.size[1] / 2 + rng.uniform(0.65, 0.9))
        x, y = car.center[0] + a * math.cos(car.yaw) - b * math.sin(car.yaw), car.center[1]
        street.add_object("pedestrian", x, y + a * math.sin(car.yaw) + b * math.cos(car.yaw), car.yaw)
    for _ in range(int(rng.poisson(0.5 if mean > 1.0 else 0.1))):  # motorcycles without a rider
        side = float(rng.choice([-1.0, 1.0]))
        x, y, yaw = street.on_strip(rng.uniform(-20, 40), side * (street.edge(0, side) + rng.normal(0, 1.0)))
        size = (rng.uniform(1.75, 2.2), rng.uniform(0.6, 0.85), rng.uniform(1.0, 1.3))
        street.add_object("misc", x, y, yaw + float(rng.choice([0.0, math.pi / 2])), size)
    add_parked_bicycles(street, 1.3 if place in ("urban", "junction") else 0.3)
