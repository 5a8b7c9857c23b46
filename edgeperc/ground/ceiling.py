"""Find the ceiling of a garage, a hall or a tunnel, and leave out vehicles that cannot be below it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..types.choices import VEHICLES
from ..types.mounting import MODEL_HEIGHT_M, Mounting
from ..types.perception import Box
from ..types.points import Floats, Points

_SAMPLE, _REACH_M, _LEAST_M = 8192, (1.5, 40.0), 2.0  # points; their range; their height above the road
# A sensor whose rays rise less meets a ceiling too far away to tell it from walls and bushes near it, which end where
# its rays do: the steepest ones rise by 0.18 and more in 144 drawn garages and depots, by at most 0.13 in 5 of 481
# scans of KITTI and in 1 of 3 of View of Delft, where vans were dropped below a ceiling of 2.0 to 2.2 m.
_LEAST_SLOPE, _RISING, _UPPER_PART, _FEWEST = 0.15, 0.002, 0.4, 30
# Such a share of the points of the upper rays lies at one height: 0.3 and more in most drawn garages and halls, at most
# 0.06 in 29 real scans of four sensors of such beams, and 0.1 in 75 drawn streets.
_BELOW_M, _ABOVE_M, _SHARE, _SECTORS = 0.3, 0.15, 0.3, 0.35
# Nothing is above a ceiling, whatever of a tilt is left: no point in those garages. In such streets, 0.012 and more of
# those on it were.
_SURELY_ABOVE_M, _TILT, _OUTSIDE_M, _MOST_ABOVE = 0.35, 0.01, 60.0, 0.01
_CLEAR_M, _ON_ROOF_M = 0.1, 0.5  # between a vehicle and the ceiling, and the sensor on it
# A sensor so high above the road is on a vehicle, whose body is around it. The nearest of 3,316 vehicles labeled in
# five sets is 1.9 m from the sensor; a box of the own roof began 0.8 m behind it.
_ROOF_M, _BODY_M = 1.4, 1.0
_SURE = 0.5  # half of the score has what the object network does not see: below a ceiling, a wall or a beam
_BEHIND_M = 1.5  # how much of a vehicle may be estimated to lie behind a wall


def find_ceiling(points: Points, eye_m: float = 0.0) -> float | None:
    """Height of a ceiling above the road [m]; None if most rays that rise do not end at one height all around, or if
    there are points above it.
    """
    x, y, z = points[:: (len(points) // _SAMPLE) | 1, :3].astype(np.float64).T
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        across_m = np.hypot(x, y)
        near = (across_m > _REACH_M[0]) & np.isfinite(across_m + z)
        slope = (z - eye_m) / across_m
    n_rising, n_near = np.count_nonzero(near & (slope > _LEAST_SLOPE)), np.count_nonzero(near)
    if n_near < _FEWEST or n_rising < _RISING * n_near:
        return None
    steepest = float(np.percentile(slope[near], 100.0 * (1.0 - _RISING)))
    upper = near & (across_m < _REACH_M[1]) & (slope > _UPPER_PART * steepest) & (z > _LEAST_M - MODEL_HEIGHT_M)
    if np.count_nonzero(upper) < _FEWEST:
        return None
    top = z[upper]
    level = float(np.percentile(top, 95.0))
    on_it = (top > level - _BELOW_M) & (top < level + _ABOVE_M)
    sectors = np.unique(np.floor(np.arctan2(y[upper], x[upper])[on_it] * (16.0 / np.pi)))
    if on_it.mean() < _SHARE or len(sectors) < _SECTORS * 32:
        return None
    ceiling = float(np.median(top[on_it]))
    above = near & (across_m < _OUTSIDE_M) & (z > ceiling + _SURELY_ABOVE_M + _TILT * across_m)
    return None if above.sum() > _MOST_ABOVE * on_it.sum() else ceiling + MODEL_HEIGHT_M


class Hall(NamedTuple):
    """What is above and around the sensor."""

    ceiling_m: float | None  # above the road; None under the sky
    outline: Floats  # how far the points reach in each of the `_DIRECTIONS` [m]


def find_hall(points: Points, mounting: Mounting) -> Hall:
    """The ceiling and the walls of a scan in the frame of the models."""
    ceiling_m = find_ceiling(points, _eye_m(mounting))
    if ceiling_m is None:
        return Hall(None, np.empty(0))
    xy = points[:: (len(points) // _SAMPLE) | 1, :2].astype(np.float64)
    return Hall(ceiling_m, (xy[np.isfinite(xy).all(axis=1)] @ _DIRECTIONS).max(axis=0))


def _eye_m(mounting: Mounting) -> float:
    return (mounting.height_m or MODEL_HEIGHT_M) - MODEL_HEIGHT_M


def part_own(boxes: Sequence[Box], mounting: Mounting) -> tuple[list[Box], list[Box]]:
    """Boxes of others, and of the own vehicle: around the sensor, or next to it on a roof, unless it is on a pole."""
    eye_m = _eye_m(mounting)
    body_m = _BODY_M if eye_m + MODEL_HEIGHT_M >= _ROOF_M else 0.0
    others, own = list[Box](), list[Box]()
    for box in boxes:
        is_own = box.label in VEHICLES and _top_m(box) >= eye_m - _ON_ROOF_M and _is_around(box, body_m)
        (own if is_own else others).append(box)
    return others, own


def without_impossible(boxes: Sequence[Box], hall: Hall, mounting: Mounting) -> tuple[Box, ...]:
    """The boxes without the own vehicle, and without vehicles that do not fit between a ceiling and walls: a small
    garage, beams, pipes.
    """
    kept, _ = part_own(boxes, mounting)
    if hall.ceiling_m is None:
        return tuple(kept)
    least_m, most_m = (level_m - _CLEAR_M - MODEL_HEIGHT_M for level_m in (_LEAST_M, hall.ceiling_m))
    return tuple(
        box
        for box in kept
        if box.label not in VEHICLES
        or _top_m(box) <= least_m
        or (box.score > _SURE and _top_m(box) <= most_m and not _sticks_out(box, hall.outline))
    )


def _top_m(box: Box) -> float:
    return box.center[2] + 0.5 * box.size[2]


def _is_around(box: Box, body_m: float) -> bool:
    """Whether the footprint holds the sensor, or is so near to it."""
    (x, y, _), cos, sin = box.center, math.cos(box.yaw), math.sin(box.yaw)
    along_m, across_m = abs(x * cos + y * sin) - 0.5 * box.size[0], abs(y * cos - x * sin) - 0.5 * box.size[1]
    return math.hypot(max(along_m, 0.0), max(across_m, 0.0)) <= body_m


_DIRECTIONS = np.stack([np.cos(np.arange(32) * np.pi / 16.0), np.sin(np.arange(32) * np.pi / 16.0)])


def _sticks_out(box: Box, outline: Floats) -> bool:
    """Whether a vehicle would stand partly behind the walls: a part of a wall was taken for its end."""
    cos, sin = 0.5 * math.cos(box.yaw), 0.5 * math.sin(box.yaw)
    middle = np.array(box.center[:2]) @ _DIRECTIONS
    along, across = box.size[0] * np.array([cos, sin]), box.size[1] * np.array([-sin, cos])
    return bool((middle + np.abs(along @ _DIRECTIONS) + np.abs(across @ _DIRECTIONS) > outline + _BEHIND_M).any())
