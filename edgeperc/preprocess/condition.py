"""Prepare scans for the networks: remission in 0..1, gaps of a coarser sensor filled (KUL-Seg 5).

`condition` prepares every scan: rows that are not returns are dropped, and remission is scaled. If the sensor's profile
has a remission function, `render` converts the remission to that of the sensor that the models were trained on.
`Interpolator` fills the pixels between neighboring beams and columns of a coarser sensor. Only the network sees the
interpolated points; the results do not contain them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..errors import PointsError, SensorError
from ..system.kernels import njit
from ..types.points import Floats, Floats32, Points, as_points, read_only
from ..types.sensor import SensorProfile
from .returns import returns

KIND_CODES = {"linear": 0, "polynomial": 1, "logarithm": 2, "power": 3}


def condition(points: ArrayLike, sensor: SensorProfile, *, rendered: bool = True) -> tuple[Floats32, int]:
    """Prepare a scan for every stage: returns of the world alone (`returns.returns`), remission in 0..1 (`scale`), by
    ``sensor.remission`` if ``rendered``; dropped rows are NaN. Also returns how many these are.

    The scan is read-only, and a view of ``points`` if nothing had to be changed.
    """
    scan, dropped = returns(as_points(points), sensor)
    scan, n_overflowed = scale(scan, sensor, rendered=rendered)
    return scan, dropped.total + n_overflowed


def scale(points: Points, sensor: SensorProfile, *, rendered: bool = True) -> tuple[Floats32, int]:
    """The scan with remission scaled to 0..1, read-only; and how many rows became NaN, as theirs is not finite."""
    if rendered and sensor.remission is not None:
        return read_only(render(points, sensor)), 0
    offset, factor = np.float32(sensor.remission_offset), np.float32(sensor.remission_scale)
    if (offset, factor) == (0.0, 1.0):
        return read_only(points), 0
    scan = points.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        scan[:, 3] = (scan[:, 3] + offset) * factor
    overflowed = np.isinf(scan[:, 3])
    n_overflowed = int(np.count_nonzero(overflowed))
    if n_overflowed:
        scan[overflowed] = np.nan
    return read_only(scan), n_overflowed


def render(points: Points, sensor: SensorProfile) -> Floats32:
    """Convert the remission to that of the sensor that the models were trained on, 0..1 (KUL-Seg 5).

    points : (n, 4) float32; x, y, z [m], remission in the sensor's raw unit. Not modified. Non-finite values stay
        non-finite.
    sensor : a profile with a remission function.
    Returns (n, 4) float32: x, y, z [m], remission in 0..1.
    Raises PointsError, SensorError.
    """
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
        raise PointsError(f"got points of shape {points.shape} and {points.dtype}; expected (n, 4) float32")
    if sensor.remission is None:
        raise SensorError(f"sensor {sensor.name!r} has no remission function; fit one with edgeperc fit-sensor")
    function = sensor.remission
    rendered = np.empty_like(points, order="C")
    coefficients = np.zeros(3)
    coefficients[: len(function.coefficients)] = function.coefficients
    fill_rendered(
        read_only(points),
        KIND_CODES[function.kind],
        coefficients,
        sensor.remission_offset,
        sensor.remission_scale * function.full_scale,
        rendered,
    )
    return rendered


@njit(cache=True, nogil=True)
def fill_rendered(
    points: Points, kind: int, coefficients: Floats, offset: float, scale: float, rendered: Floats32
) -> None:
    """Write the points with rendered remission, NaN if it is not finite.

    kind : a value of ``KIND_CODES``.
    offset, scale : the argument x of `RemissionFunction` is ``(raw + offset) * scale``; logarithm and power clip it to
        0 from below.
    """
    # Most sensors report whole numbers up to 255. A table of their 256 results takes 0.3 instead of 2 ms.
    whole = np.empty(256)
    for k in range(len(whole)):
        whole[k] = rendered_at(float(k), kind, coefficients)
    for i in range(points.shape[0]):
        rendered[i, 0] = points[i, 0]
        rendered[i, 1] = points[i, 1]
        rendered[i, 2] = points[i, 2]
        x = (np.float64(points[i, 3]) + offset) * scale
        nearest = math.floor(x + 0.5) if 0.0 <= x < 255.5 else -1.0
        if x == nearest or (nearest >= 1.0 and abs(x - nearest) < 2e-5):  # 255ths as float32 are not quite whole
            rendered[i, 3] = whole[int(nearest)]
        elif math.isfinite(x):
            rendered[i, 3] = rendered_at(x, kind, coefficients)
        else:
            rendered[i, 3] = np.nan


@njit(cache=True, nogil=True)
def rendered_at(x: float, kind: int, coefficients: Floats) -> float:
    """Value of a `RemissionFunction` at a finite x."""
    a, b, c = coefficients[0], coefficients[1], coefficients[2]
    if kind == 3:
        value = a * math.exp(min(b * math.log(x), 700.0)) if x > 0.0 else 0.0
    else:
        value = a + b * math.log1p(max(x, 0.0)) if kind == 2 else a + (b + c * x) * x
    return min(max(value, 0.0), 1.0)
