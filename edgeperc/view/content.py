"""Contents of pictures and pages: classes of points, drawable boxes, the ground, short facts."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..camera.image import as_image
from ..errors import ImageError
from ..ground.planes import fit_ground
from ..system.printable import many, printable
from ..types.frame import ModelFrame
from ..types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING
from ..types.perception import Box, ImageLabels, Perception, TopView
from ..types.points import Bytes, Floats, Floats32, Mask, Points
from .colors import CLASS_COLORS

if TYPE_CHECKING:
    from ..tracking.tracks import Track

# Limits of what is drawn: no sensor reaches as far, and a drawing library may fail on huge coordinates.
_REACH_M = 1000.0
_LARGEST_BOX_M = 100.0

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Pairs of `box_corners`: the edges of a box."""


def packed(dtype: DTypeLike, *columns: ArrayLike) -> NDArray[Any]:
    """Columns of one shape, or single values, as the fields of an array, in their order."""
    rows = np.empty(np.shape(columns[0]), dtype)
    for name, column in zip(rows.dtype.names or (), columns, strict=True):
        rows[name] = column
    return rows


def drivable_strips(view: TopView) -> NDArray[np.intp]:
    """Runs of drivable cells along the rows: row, first column and one past the last column, (n, 3)."""
    padded = np.pad(view.drivable, ((0, 0), (1, 1))).astype(np.int8)
    change = np.diff(padded, axis=1)
    (row, first), (_, last) = np.nonzero(change == 1), np.nonzero(change == -1)
    return np.column_stack([row, first, last])


def perceived_image(image: ArrayLike, perception: Perception) -> tuple[Bytes, ImageLabels]:
    """The image that was perceived, checked, and its labels; `ImageError` if it is another."""
    image, labels = as_image(image), perception.image
    if labels is None or labels.labels.shape != image.shape[:2]:
        given = "no image" if labels is None else f"an image of shape {labels.labels.shape}"
        raise ImageError(f"image has shape {image.shape}, of a perception of {given}; expected what was perceived")
    return image, labels


def in_model_frame(perception: Perception, points: Points) -> tuple[Perception, Floats32]:
    """The perception with its boxes, and its scan, in the frame of the models, where the top view lies."""
    frame = ModelFrame(perception.mounting)
    if frame.is_identity:
        return perception, points
    boxes = frame.move_boxes(drawable_boxes(perception.boxes))
    top_view = perception.top_view
    if top_view is not None:
        top_view = replace(top_view, mounting=MODEL_MOUNTING)
    return replace(perception, boxes=boxes, top_view=top_view, mounting=MODEL_MOUNTING), frame.move(points)


def drawable_points(points: Points) -> Mask:
    """Which points have a finite place within 1 km, (n,) bool; their remission may be unknown."""
    return np.asarray((np.abs(points[:, :3]) < _REACH_M).all(axis=1))


def drawable_boxes(boxes: Iterable[Box]) -> list[Box]:
    """Boxes that are finite, within 1 km and at most 100 m large."""
    return [
        box
        for box in boxes
        if all(map(math.isfinite, (*box.center, *box.size, box.yaw)))
        and max(map(abs, box.center)) < _REACH_M
        and 0.0 < min(box.size) <= max(box.size) < _LARGEST_BOX_M
    ]


def paint_points(points: Points, perception: Perception) -> tuple[list[str], Bytes]:
    """Classes of both views, and the one to show for every point: its own or that of its cell for background."""
    names = list(perception.points.classes if perception.points is not None else ("background",))
    painted = np.zeros(len(points), dtype=np.uint8)
    if perception.points is not None:
        painted[:] = perception.points.labels
    top_view = perception.top_view
    if top_view is None:
        return names, painted
    names += [name for name in top_view.classes if name not in names]
    near = np.flatnonzero(drawable_points(points))
    x, y, z = points[near, :3].astype(np.float64).T
    row, col, inside = top_view.geometry.cells(x, y)
    near, z = near[inside], z[inside]
    cell = top_view.labels[row[inside].astype(np.intp), col[inside].astype(np.intp)]
    lent = np.array([names.index(name) for name in top_view.classes], dtype=np.uint8)[cell]
    road = names.index("drivable") if "drivable" in names else -1
    take = (painted[near] == 0) & (lent != 0)
    if perception.points is not None:
        take &= lent == road
    if (lent == road).any():
        # Points more than 0.5 m above the road, such as leaves, are not road.
        take &= (lent != road) | (z < np.median(z[lent == road]) + 0.5)
    painted[near[take]] = lent[take]
    return names, painted


def paint_vehicles(names: list[str], painted: Bytes, points: Points, boxes: Iterable[Box]) -> None:
    """Give points of cars in the box of a van or a truck its class; networks of points have one class for all three."""
    cars = np.flatnonzero(painted == names.index("car")) if "car" in names else np.empty(0, np.intp)
    cars = cars[drawable_points(points[cars])]
    for box in drawable_boxes(boxes):
        if box.label in ("van", "truck") and len(cars):
            away = points[cars, :2] - np.asarray(box.center[:2])
            cos, sin = math.cos(box.yaw), math.sin(box.yaw)
            along, across = np.abs(away @ [cos, sin]), np.abs(away @ [-sin, cos])
            inside = cars[(along <= box.size[0] / 2.0) & (across <= box.size[1] / 2.0)]
            if box.label not in names:
                names.append(box.label)
            painted[inside] = names.index(box.label)


def ground_plane(perception: Perception, points: Points) -> tuple[float, float, float]:
    """The plane that a picture is drawn on, a + b x + c y [m] in the frame of the models; fitted if need be."""
    ground = perception.ground or fit_ground(points, mount_height_m=MODEL_HEIGHT_M).surface()
    slope_x, slope_y, level = ground.expected
    return level, slope_x, slope_y


def box_corners(box: Box) -> Floats:
    """The eight corners, (8, 3) float64 [m]: the four of `Box.corners` at the bottom, then at the top."""
    z = box.center[2] + np.repeat([-0.5, 0.5], 4) * box.size[2]
    return np.column_stack([np.tile(box.corners(), (2, 1)), z])


def edges_ahead(corners: Floats, near_m: float) -> Floats:
    """Edges of a box from ``near_m`` ahead on, (k, 2, 3): the last coordinate of its corners is the distance ahead."""
    ends = []
    for pair in EDGES:
        start, end = sorted(corners[[*pair]], key=lambda corner: float(corner[2]))
        if end[2] > near_m:
            if start[2] < near_m:
                start = start + (end - start) * (near_m - start[2]) / (end[2] - start[2])
            ends.append((start, end))
    return np.array(ends).reshape(-1, 2, 3)


def box_text(box: Box) -> str:
    """Label and score of a box."""
    return f"{printable(box.label)} {box.score:.2f}"


def track_text(track: Track) -> str:
    """Id, label and speed of a track."""
    return f"#{track.id} {printable(track.label)} {math.hypot(*track.world_velocity):.1f} m/s"


def class_facts(perception: Perception) -> dict[str, list[str]]:
    """Area, number of boxes and number of points of each class, as texts. The background comes last."""
    counts = perception.points.counts() if perception.points is not None else {}
    labels = [box.label for box in perception.boxes]
    facts: dict[str, list[str]] = {}
    known = {*counts, *(perception.top_view.classes if perception.top_view is not None else ()), *labels}
    order = [*CLASS_COLORS][1:]
    for name in sorted(known, key=lambda name: (order.index(name) if name in order else len(order), name)):
        facts[name] = []
        if name == "drivable" and perception.top_view is not None and perception.top_view.drivable.any():
            facts[name].append(f"{perception.top_view.drivable_area_m2:.0f} m²")
        if name in labels:
            facts[name].append(f"{labels.count(name)} box{'es' * (labels.count(name) > 1)}")
        if counts.get(name):
            facts[name].append(many(counts[name], "point"))
    return facts


def timing_line(perception: Perception) -> str:
    """Processing time [ms], in total and by stage, as one line."""
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in perception.stage_ms.items())
    return f"{sum(perception.stage_ms.values()):.1f} ms ({stages})" if stages else "not timed"


def provider_lines(perception: Perception) -> list[str]:
    """One line for each model: variant, precision and execution provider."""
    return [text if name in text else f"{name}: {text}" for name, text in perception.providers.items()]
