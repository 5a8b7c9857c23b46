"""The returns of a scan, without the rows that are not: empty beams, and the vehicle that carries the sensor.

Many drivers write a beam without a return as (0, 0, 0) or as a point a few centimeters from the sensor, on its ray.
`returns` blanks such rows, and those inside the profile's `ego_box`, before any stage uses them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .kernel_cache import njit
from .perception import DroppedPoints
from .points import read_only
from .sensor import SensorProfile

__all__ = ["about_too_near", "blank_too_near", "fill_blanked", "mark_dropped", "returns"]

# A coordinate of float32 is off by at most 6e-8 of its size: a point at exactly the nearest range counts as near.
ROUNDING = 1e-6


def returns(
    points: NDArray[np.float32], sensor: SensorProfile, origin_m: tuple[float, float] | None = None
) -> tuple[NDArray[np.float32], DroppedPoints]:
    """Blank the rows of a scan that are not returns of the world.

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m] in the frame of the scan, before its mounting moves it; remission. Not modified.
    sensor : SensorProfile
        Rows at most ``min_range_m`` from the sensor are too near; with ``min_range_m=0``, those of the sensor's own
        place. Rows inside ``ego_box`` are of the own vehicle.
    origin_m : tuple of 2 float, optional
        x, y of the sensor in the frame of the scan [m]; by default as the profile's mounting says.

    Returns
    -------
    scan : (n, 4) float32, C-contiguous, read-only
        In input order. Blanked rows are NaN in all four columns. A view of ``points`` if there are none.
    dropped : DroppedPoints
        A row of several kinds counts once, as the first of them.
    """
    x, y = sensor.mounting.origin_m if origin_m is None else origin_m
    box = np.array([(np.inf, -np.inf)] * 3 if sensor.ego_box is None else sensor.ego_box)
    return _blanked(points, np.array([x, y, 0.0]), sensor.min_range_m, box)


def blank_too_near(points: NDArray[np.float32], min_range_m: float) -> NDArray[np.float32]:
    """A scan (n, 4) in which rows at most ``min_range_m`` from its origin are NaN, read-only; see `returns`."""
    return _blanked(points, np.zeros(3), min_range_m, np.array([(np.inf, -np.inf)] * 3))[0]


def about_too_near(dropped: DroppedPoints, n_points: int, sensor: SensorProfile) -> str:
    """A sentence about the rows that are too near: how many, what they are, what was done, how to change it."""
    return (
        f"{dropped.too_near:,} of {n_points:,} points of the scan lie at most {sensor.min_range_m:g} m from "
        f"the sensor: nearer than the profile {sensor.name} says that it measures. They are beams without a return, such as "
        "(0, 0, 0). In this and later scans, such points are labeled 0, counted in perception.dropped, and otherwise "
        "ignored. If they are true returns, pass sensor= a profile with a smaller min_range_m, such as "
        "dataclasses.replace(profile, min_range_m=0)."
    )


def _blanked(
    points: NDArray[np.float32], origin: NDArray[np.float64], min_range_m: float, box: NDArray[np.float64]
) -> tuple[NDArray[np.float32], DroppedPoints]:
    points = read_only(points)
    kind = np.empty(len(points), np.uint8)
    limit = min_range_m * (1.0 + ROUNDING)
    dropped = DroppedPoints(*mark_dropped(points, origin, limit * limit, box, kind))
    if not dropped.total:
        return points, dropped
    blanked = np.empty(points.shape, np.float32)
    fill_blanked(points, kind, blanked)
    return read_only(blanked), dropped


@njit(cache=True, nogil=True)
def mark_dropped(
    points: NDArray[np.float32],
    origin: NDArray[np.float64],
    square: float,
    box: NDArray[np.float64],
    kind: NDArray[np.uint8],
) -> tuple[int, int, int]:
    """Write the kind of each row (n,): 0 kept, 1 not finite, 2 too near, 3 ego; return how many are of 1, 2 and 3.

    ``square`` is that of the nearest range [m2] about ``origin`` (3,); ``box`` (3, 2) has lowest and highest x, y, z
    about it.
    """
    x0, y0, z0 = origin[0], origin[1], origin[2]
    x_low, x_high = box[0, 0], box[0, 1]
    y_low, y_high = box[1, 0], box[1, 1]
    z_low, z_high = box[2, 0], box[2, 1]
    n_not_finite, n_too_near, n_ego = 0, 0, 0
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]) - x0, np.float64(points[i, 1]) - y0, np.float64(points[i, 2]) - z0
        # Differences to 0, as inf - inf and nan - nan are nan; no sum of four float32 overflows in float64.
        total = x + y + z + np.float64(points[i, 3])
        finite = total - total == 0.0
        near = finite & (x * x + y * y + z * z <= square)
        inside = (x >= x_low) & (x <= x_high) & (y >= y_low) & (y <= y_high) & (z >= z_low) & (z <= z_high)
        ego = finite & (not near) & inside
        kind[i] = (not finite) * 1 + near * 2 + ego * 3
        n_not_finite += not finite
        n_too_near += near
        n_ego += ego
    return n_not_finite, n_too_near, n_ego


@njit(cache=True, nogil=True)
def fill_blanked(points: NDArray[np.float32], kind: NDArray[np.uint8], blanked: NDArray[np.float32]) -> None:
    """Copy the points (n, 4) whose kind is 0, and write NaN into the rows of the others."""
    for i in range(points.shape[0]):
        kept = kind[i] == 0
        for column in range(4):
            blanked[i, column] = points[i, column] if kept else np.float32(np.nan)
