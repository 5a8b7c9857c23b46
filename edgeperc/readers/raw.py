"""Raw float32 files, which have no header: their values a point show in the values themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..errors import PointsError
from ..types.points import Bytes, Floats32, as_float64, plain_name
from .tables import Columns

TEXT_BYTES = np.zeros(256, dtype=np.bool_)
TEXT_BYTES[[9, 10, 13, *range(32, 127)]] = True

_KNOWN = ("x", "y", "z", "remission")
_WIDTHS = range(3, 13)  # values a point that are told apart
_FEWEST_POINTS = 250  # fewer do not show it
_BLOCKS, _BLOCK = 4, 6000  # what is looked at: so many pieces of so many values

# Values of one column are alike. Of 561 real scans of 4 values, beam by beam, the difference at the right width is at
# most 1.05 times the smallest one; wrong widths have 1.2 times and more, even where the points are shuffled.
_ALIKE, _UNLIKE = 1.15, 1.2
# Median angle between neighboring points [rad]: at most 0.007 of four sensors; of a point and other values above 0.6.
_ONE_DIRECTION = 0.1
_ODD_SHARE = 0.2  # of points with odd coordinates, above which the values are of another format


def parse_raw(data: Bytes, columns: int | Sequence[str] | None, usual: int) -> Columns:
    """The columns of a raw float32 file.

    columns : number of values of a point, or their names; None: ``usual``, unless the values show another number.
    """
    names = column_names(columns)
    if TEXT_BYTES[data[:4096]].all():
        raise PointsError("the file holds text, not float32 values; expected x, y, z, remission as raw float32")
    if columns is None:
        names = column_names(_width(data[: data.size // 4 * 4].view("<f4"), usual))
    record = 4 * len(names)
    if data.size % record:
        raise PointsError(
            f"{data.size} bytes are not a whole number of points of {len(names)} float32 values ({record} bytes): the "
            "file is cut short, or pass columns= (--columns) with the right number of values a point"
        )
    values = data.view("<f4").reshape(-1, len(names))
    xyz = np.abs(values[:: max(1, len(values) // 4096), :3])
    # Coordinates do not have such values. Most rows do if float64, big-endian or other bytes are read as float32.
    with np.errstate(invalid="ignore"):  # comparing signalling NaN
        absurd = ((xyz > 1e7) & (xyz < np.inf)) | ((xyz > 0.0) & (xyz < 1e-30))
        odd = absurd | ((xyz > 0.0) & (xyz < 1e-3))
    if odd.any(axis=1).mean() > _ODD_SHARE and _are_halves(data):
        raise PointsError(
            "the values are float16; expected float32, as np.fromfile(path, np.float16).astype(np.float32) has them"
        )
    if absurd.any(axis=1).mean() > _ODD_SHARE:
        raise PointsError(
            "the values are not coordinates; expected little-endian float32 x, y, z, remission, not float64 or "
            "another format"
        )
    return Columns(len(values), dict(zip(names, values.T, strict=True)), names)


def column_names(columns: int | Sequence[str] | None) -> tuple[str, ...]:
    """The names of the columns; the first four of a number of them are x, y, z and remission."""
    if columns is None:
        return ()
    if isinstance(columns, Sequence) and not isinstance(columns, str):
        names = tuple(plain_name(str(name)) for name in columns)
        if not 3 <= len(names) <= 64 or len({*names}) < len(names):
            raise PointsError(f"columns are 3 to 64 different names, among them x, y and z, got {list(columns)!r:.200}")
        return names
    if isinstance(columns, bool) or not isinstance(columns, int | np.integer) or not 3 <= columns <= 64:
        raise PointsError(f"columns is the number of float32 values a point, 3 to 64, or their names, got {columns!r}")
    return (*_KNOWN[: int(columns)], *(f"column {k}" for k in range(5, int(columns) + 1)))


def _width(values: Floats32, usual: int) -> int:
    """How many values a point has, if not the usual number: those at this distance are most alike, of one column."""
    if len(values) < _FEWEST_POINTS * usual:
        return usual
    with np.errstate(all="ignore"):
        differences = np.array([_difference(values, width) for width in _WIDTHS])
    best = float(differences.min())
    width = _WIDTHS[int(np.argmax(differences <= _ALIKE * best))]
    if differences[usual - _WIDTHS[0]] <= _UNLIKE * best:
        return usual
    return next(part for part in _WIDTHS if width % part == 0 and _share_azimuth(values, width, part))


def _share_azimuth(values: Floats32, width: int, part: int) -> bool:
    """Whether records are rows of points with ``part`` values: lasers of a Velodyne that fire one after another look up
    and down in turn, so every second point is more alike than neighbors are, but neighbors lie in one direction.
    """
    first = values[: len(values) // width * width].reshape(-1, width)[:: max(1, len(values) // width // 4096)]
    places = as_float64(np.stack([first[:, :2], np.roll(first, -part, axis=1)[:, :2]]))
    x, y = places[..., 0], places[..., 1]
    with np.errstate(all="ignore"):
        known = np.isfinite(places).all(axis=(0, 2)) & (np.hypot(x, y) > 0.1).all(axis=0)
        angles = np.abs(np.arctan2(y[0] * x[1] - x[0] * y[1], x[0] * x[1] + y[0] * y[1]))[known]
    return width == part or bool(len(angles) and np.median(angles) < _ONE_DIRECTION)


def _are_halves(data: Bytes) -> bool:
    """Whether the bytes read as float16 are values of points; a third of the lower halves of float32 are not."""
    middle = data.size // 4 * 2
    values = np.abs(data[middle : middle + 4 * _BLOCK].view("<f2").astype(np.float64))
    return bool(((values == 0.0) | ((values > 1e-3) & (values < 1e3))).mean() > 0.98 and (values > 0.0).mean() > 0.6)


def _difference(values: Floats32, distance: int) -> float:
    """The mean relative difference, 0 to 1, between values at a distance."""
    starts = np.linspace(0, max(0, len(values) - _BLOCK - distance), _BLOCKS).astype(np.int64)
    total = n = 0.0
    for start in np.unique(starts):
        block = as_float64(values[start : start + _BLOCK + distance])
        one, other = block[:-distance], block[distance:]
        difference = np.abs(one - other) / (np.abs(one) + np.abs(other) + 0.01)
        known = np.isfinite(difference)
        total, n = total + float(difference[known].sum()), n + np.count_nonzero(known)
    return total / n if n else 1.0
