"""Numbers and times that callers pass, and rigid transforms: a rotation and a translation, up to rounding."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import EdgepercError, PointsError, StampError
from ..system.clock import LATEST_S
from .points import check_each

# Of R R^T. KITTI's rotations have seven digits; a product of two of them is off by some 1e-6.
ROTATION_TOLERANCE = 1e-3
ROW_TOLERANCE = 1e-6  # of the last row: what is multiplied or inverted in float32 is as far off
COARSEST_S = 0.002  # of times: 0.06 m at 30 m/s


def numbers_of(what: str, given: ArrayLike, error: type[EdgepercError], expected: str) -> NDArray[np.float64]:
    """A C-contiguous copy of a caller's numbers; else, as for masked ones, dates and texts, an error that begins so."""
    try:
        values = np.asarray(given)
        if isinstance(given, np.ma.MaskedArray) or values.dtype.kind not in "fiubO":
            raise TypeError(f"a {type(given).__name__} of {values.dtype}")
        return np.array(values, np.float64, order="C")
    except (OverflowError, RuntimeError, TypeError, ValueError) as exc:
        raise error(f"{what} ({exc}); expected {expected}") from exc


def times_of(given: ArrayLike, n: int) -> NDArray[np.float64]:
    """Times of n points [s], NaN for what is none; PointsError, or StampError of another unit or rounding."""
    times = numbers_of("got times that are not numbers", given, PointsError, f"({n},) seconds")
    check_each(n, times=times)
    sizes, is_coarse = np.abs(times), getattr(given, "dtype", None) == np.float32
    if not (is_coarse or (sizes > LATEST_S).any()):  # the median would take a third of the time of `deskew`
        return times
    known = sizes[np.isfinite(sizes)]
    usual = np.float64(np.median(known) if len(known) else 0.0)
    off_s = np.spacing(usual.astype(np.float32)) if is_coarse else 0.0
    if usual > LATEST_S or off_s > COARSEST_S:
        rounded = f", which float32 holds to {off_s:.2g} s" if off_s else ""
        raise StampError(
            f"got times of {usual:.6g} s{rounded}; expected float64 up to {LATEST_S:g}, or seconds since the start of "
            "the scan"
        )
    times[sizes > LATEST_S] = np.nan
    return times


def rigid(name: str, given: ArrayLike, error: type[EdgepercError]) -> NDArray[np.float64]:
    """A copy of a rigid transform, (4, 4), with an exact last row; otherwise an error of this type, with this name."""
    pose = numbers_of(f"{name} is not a matrix", given, error, "(4, 4) numbers")
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise error(f"{name} has shape {pose.shape}; expected (4, 4) finite numbers")
    R, row = pose[:3, :3], pose[3] - [0.0, 0.0, 0.0, 1.0]
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(R @ R.T - np.eye(3)).max()
        is_rotation = off <= ROTATION_TOLERANCE and np.linalg.det(R) > 0.0
    if not is_rotation or np.abs(row).max() > ROW_TOLERANCE:
        raise error(
            f"{name} is not rigid; expected a rotation R (R R^T = 1, det R = 1) and a translation, and the last row "
            "0, 0, 0, 1"
        )
    pose[3] = 0.0, 0.0, 0.0, 1.0
    return pose
