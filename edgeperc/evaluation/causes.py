"""Why points have wrong labels: missed and false points of each class, counted by cause."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..ground.planes import find_ground
from ..objects.cluster import find_clusters
from ..simulation.scene import POINT_CLASS_OF, POINT_CLASSES
from ..types.geometry import inside
from ..types.perception import Box
from ..types.points import Bytes, Labels, Mask, Points
from .metrics import object_key

BUMPER = "car at the own bumper"
OTHER, VANS, FAR = "of other objects", "in vans and trucks", "beyond 30 m"
NEAR, LARGE, FLOOR, POLE = "within 0.4 m of an object", "on large structures", "on the ground", "on poles"

# The causes that are counted for each error. A point may have several of them, or none.
CAUSES: dict[str, tuple[str, ...]] = {
    "missed car": (VANS, FAR, FLOOR),
    "missed pedestrian": (OTHER, FAR),
    "missed cyclist": (OTHER, FAR),
    "false car": (OTHER, NEAR, LARGE, FLOOR),
    "false pedestrian": (OTHER, NEAR, POLE),
    "false cyclist": (OTHER, NEAR, POLE),
}

FAR_M = 30.0
NEAR_M = 0.4
LARGE_LENGTH_M, LARGE_HEIGHT_M = 8.0, 4.0  # a longer or higher cluster is a wall, a hedge or a bank
POLE_RADIUS_M, POLE_HEIGHT_M = 0.3, 2.0  # a column of points that goes on above this height is not a person
BUMPER_X_M, BUMPER_Y_M, BUMPER_Z_M = 4.5, 3.0, -1.5  # upper bounds of x, |y| and z; the road is at z = -1.73

Counts = dict[tuple[str, ...], "Counter[Any]"]


def count_causes(
    points: Points, labels: Labels, right: Bytes, known: Mask, in_view: Mask, boxes: Sequence[Box], drive: str
) -> Counts:
    """Count one scan's wrong points by (error, cause), and 1 by drive and by missed object. The cause "all" has all of
    an error, "of" what it is a share of. Where the truth is unknown, `BUMPER` may be a car.
    """
    ground, (x, y, z) = find_ground(points), points[:, :3].T
    at_bumper = (x < BUMPER_X_M) & (np.abs(y) < BUMPER_Y_M) & (z < BUMPER_Z_M)
    at_bumper &= in_view & (labels == 1) & ~((right > 0) & (right < len(POINT_CLASSES)))
    chosen = {(BUMPER, "all"): at_bumper, (BUMPER, FLOOR): at_bumper & ground.mask}
    for number, name in enumerate(POINT_CLASSES[1:], start=1):
        true, predicted = known & (right == number), known & (labels == number)
        missed, false = true & ~predicted, predicted & ~true
        background = false & (right == 0)
        of_missed = {"of": true, "all": missed, FAR: missed & (np.hypot(x, y) >= FAR_M)}
        near = _within(points, background, boxes, NEAR_M)
        of_false = {"of": predicted, "all": false, OTHER: false & ~background, NEAR: near}
        if name == "car":
            of_missed[VANS] = _within(points, missed, [box for box in boxes if box.label in ("van", "truck")])
            of_missed[FLOOR] = missed & ground.mask  # KITTI's boxes hold the road below a car
            of_false |= {LARGE: _large(points, background, ~ground.mask), FLOOR: background & ground.mask}
        else:
            of_missed[OTHER] = missed & (labels > 0)
            of_false[POLE] = _on_poles(points, background, ground.height_m > POLE_HEIGHT_M)
        chosen |= {(f"missed {name}", cause): mask for cause, mask in of_missed.items()}
        chosen |= {(f"false {name}", cause): mask for cause, mask in of_false.items()}
    counts: Counts = {("errors", name): Counter() for name in ("points", "scans", "objects")}
    for (error, cause), mask in chosen.items():
        n = int(np.count_nonzero(mask))
        if n:
            counts["errors", "points"][error, cause] = n
            counts["errors", "scans"][error, cause, drive] = 1
        if n and error.startswith("missed"):
            own = [box for box in boxes if error == f"missed {POINT_CLASSES[POINT_CLASS_OF.get(box.label, 0)]}"]
            keys = {object_key(drive, box) for box in own if inside(box, points[mask]).any()}
            counts["errors", "objects"].update((error, cause, key) for key in keys)
    return counts


def _within(points: Points, mask: Mask, boxes: Sequence[Box], margin_m: float = 0.0) -> Mask:
    """Points of a mask in one of the boxes."""
    rows, is_near = np.flatnonzero(mask), np.zeros(len(mask), np.bool_)
    for box in boxes:
        is_near[rows] |= inside(box, points[rows], margin_m)
    return is_near


def _large(points: Points, mask: Mask, above: Mask) -> Mask:
    """Points of a mask above the ground, in a cluster that is too large for a car."""
    above = above & np.isfinite(points).all(axis=1)
    clusters = find_clusters(points, among=above, seeds=mask & above, min_points=1)
    rows = np.flatnonzero(clusters >= 0)
    rows = rows[np.argsort(clusters[rows], kind="stable")]
    large = np.zeros(len(mask), np.bool_)
    if rows.size:
        first = np.flatnonzero(np.diff(clusters[rows], prepend=-1))
        members = points[rows, :3]
        size = np.maximum.reduceat(members, first) - np.minimum.reduceat(members, first)
        is_large = (np.hypot(size[:, 0], size[:, 1]) > LARGE_LENGTH_M) | (size[:, 2] > LARGE_HEIGHT_M)
        large[rows] = is_large[clusters[rows]]
    return mask & large


def _on_poles(points: Points, mask: Mask, is_tall: Mask) -> Mask:
    """Points of a mask with a tall point, higher than people, above or below them, at most 0.3 m aside."""
    is_pole = np.zeros(len(mask), np.bool_)
    tall = points[is_tall, :2]
    tall = tall[np.argsort(tall[:, 1])]
    for row in np.flatnonzero(mask):
        x, y = points[row, :2]
        first, end = np.searchsorted(tall[:, 1], (y - POLE_RADIUS_M, y + POLE_RADIUS_M))
        is_pole[row] = (np.hypot(*(tall[first:end] - (x, y)).T) <= POLE_RADIUS_M).any()
    return is_pole
