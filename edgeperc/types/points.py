"""Convert arrays to points: (n, 4) float32, x, y, z [m] and remission in the sensor's raw unit."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..errors import OptionError, PointsError

# Arrays by the type of their numbers, and by what they hold; n points.
Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int32]
Ints64 = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Records = NDArray[np.void]
Points = NDArray[np.float32]  # (n, 4): x, y, z [m], remission
Heights = NDArray[np.float32]  # (n,): above the ground below [m]; NaN for points that are not finite
Labels = NDArray[np.uint8]  # (n,) or (rows, columns): index of a class
Mask = NDArray[np.bool_]  # (n,)
Rows = NDArray[np.int32]  # (m,): of some points in a scan
Ids = NDArray[np.int32]  # (n,): cluster of each point; -1 for none

# Best first; of an Ouster's fields, "intensity" is the raw signal and "reflectivity" the calibrated byte.
_REMISSION_NAMES = ("remission", "intensity", "i", "reflectivity", "reflectance")


MAX_ROUNDING_M = 5e-3  # of coordinates; a LiDAR measures to 1 to 3 cm
MAX_MAP_M = 1e8  # of a map's coordinates; projected ones are up to 1e7


class MapError(PointsError):
    """The coordinates are those of a map, which float32 would round."""


class Cloud(NamedTuple):
    """Points as kernels take them."""

    points: NDArray[np.float32]  # (n, 3 or more) x, y, z [m]
    height: NDArray[np.float32]  # (n,) above the ground [m]


class Labeled(NamedTuple):
    """Labels of points as kernels take them."""

    labels: NDArray[np.uint8]  # (n,)
    roles: NDArray[np.uint8]  # (classes,) what each label is for the kernel; 0 for what it does not treat


def as_points(
    array: ArrayLike, *, remission_field: str | None = None, origin_m: Sequence[float] | None = None
) -> NDArray[np.float32]:
    """Convert an array to points, (n, 4) float32 C-contiguous: itself if it has this form.

    array : (n, 4) or (n, 3), of any float or integer dtype, byte order and memory layout: x, y, z [m], remission, 0
        without it. A structured array (any shape, e.g. that of a PointCloud2 message) needs the fields x, y and z;
        other fields and padding are skipped. So does a data frame with such names (pandas, polars, Arrow).
    origin_m : subtracted from x, y, z [m] before they become float32. Raises PointsError: Also for coordinates of a
        map, which float32 would round by more than 5 mm.
    """
    named, values = columns_of(array)
    if values.dtype.names is not None:
        return assemble(values.size, named, values.dtype.names, remission_field, origin_m)
    if named:
        return assemble(len(values), named, [*named], remission_field, origin_m)
    if values.dtype.kind not in "fiu":
        raise PointsError(f"got an array of {values.dtype}; expected (n, 4) numbers: x, y, z, remission")
    if values.ndim != 2 or values.shape[1] not in (3, 4):
        advice = ""
        if values.ndim == 2 and values.shape[1] > 4:
            advice = "; if the first four columns are these, pass points[:, :4]"
            if values.shape[0] in (3, 4):
                advice = "; pass points.T"
        raise PointsError(f"got an array of shape {values.shape}; expected (n, 4): x, y, z, remission{advice}")
    if values.shape[1] == 3 or origin_m is not None or _is_rounded(values[:, :3]):
        columns = dict(zip(("x", "y", "z", "remission"), values.T, strict=False))
        return assemble(len(values), columns, [*columns], None, origin_m)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.require(values, dtype=np.float32, requirements=["C", "A"])


def columns_of(given: ArrayLike) -> tuple[dict[str, NDArray[Any]], NDArray[Any]]:
    """The numeric columns by `plain_name` of what has named ones, and all as an array; PointsError for what is none."""
    if isinstance(given, np.ma.MaskedArray):
        raise PointsError("got a masked array; fill it first, e.g. with array.filled(np.nan)")
    if not isinstance(given, np.ndarray) and (what := _to_convert(given)):
        raise PointsError(f"got {what[0]}; expected (n, 4) x, y, z, remission: pass {what[1]}")
    try:
        # Ragged sequences raise ValueError; the __array__ of an object may raise anything.
        named = {} if isinstance(given, np.ndarray) else _frame_columns(given)
        values = np.asarray(given)
    except Exception as exc:
        raise PointsError(f"got an object that is not an array: {exc}; expected (n, 4) x, y, z, remission") from exc
    return named or table_columns(values), values


def _frame_columns(thing: Any) -> dict[str, NDArray[Any]]:
    """The numeric columns of a data frame (pandas, polars, Arrow) by `plain_name`; empty if their names are numbers
    alone.
    """
    names = getattr(thing, "column_names", getattr(thing, "columns", None)) if hasattr(thing, "__array__") else None
    columns = _numeric((name, np.asarray(thing[name])) for name in (() if names is None else names))
    return {} if all(re.fullmatch(r"(column_)?\d+", name) for name in columns) else columns


def _to_convert(thing: Any) -> tuple[str, str] | None:
    """What something is that people have in place of an array, and what to pass; None if it may be an array."""
    first = next(iter(thing), None) if isinstance(thing, list | tuple) else None
    kind = f"{type(thing).__module__}.{type(thing).__qualname__}"
    if isinstance(thing, str | os.PathLike):
        return (
            f"the path {os.fspath(thing)[-200:]!r}",
            "edgeperc.read_points(path), or each scan of edgeperc.read_scans(path)",
        )
    if isinstance(first, str | os.PathLike):
        return "paths", "one scan a call, edgeperc.read_points(path)"
    if isinstance(thing, bytes | bytearray):
        return f"{len(thing):,} bytes", "np.frombuffer(data, np.float32).reshape(-1, 4), if these are float32"
    if isinstance(thing, Mapping):
        keys = ", ".join(map(str, thing))
        return (
            f"a mapping of {keys[:100] or 'nothing'} ({kind})",
            "the array of points in it, or np.column_stack of its columns",
        )
    if hasattr(thing, "__array__"):
        return None
    if all(hasattr(thing, name) for name in ("point_step", "fields", "data")):
        return f"a PointCloud2 message ({kind})", "edgeperc.readers.clouds.cloud_points(message)"
    if kind.startswith("open3d.") and hasattr(thing, "point"):
        remission = "its intensity, if it has one, as the fourth column"
        return f"a point cloud of Open3D ({kind})", f"cloud.point.positions.numpy(), with {remission}"
    if kind.startswith("open3d.") and hasattr(thing, "points"):
        return f"a point cloud of Open3D ({kind})", "np.asarray(cloud.points), which has no remission"
    if isinstance(thing, tuple) and len(thing) in (2, 3) and isinstance(thing[1], np.ndarray) and thing[1].ndim == 2:
        return (
            "a scan with its stamp",
            "its points alone, perceive(points, stamp_s), as in: for stamp_s, points in read_scans(...)",
        )
    if hasattr(thing, "read"):
        return f"an open file ({kind})", "edgeperc.read_points(path), or its bytes by np.frombuffer"
    if isinstance(thing, Iterator):
        return f"an iterator ({kind})", "one scan a call, as in: for stamp_s, points in read_scans(...)"
    if all(hasattr(thing, axis) for axis in "xyz"):
        return f"an object with x, y and z ({kind})", "np.column_stack([cloud.x, cloud.y, cloud.z, remission])"
    return None


def table_columns(table: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """The numeric fields of a structured array of any shape, each (n,), by `plain_name`."""
    return _numeric((name, table[name].reshape(-1)) for name in table.dtype.names or ())


def by_axes(points: ArrayLike, axes: str = "xyz") -> NDArray[Any]:
    """These columns of what has named ones, whatever their order; else the array. PointsError for what is no points."""
    columns, values = columns_of(points)
    is_plain = values.dtype.kind in "fiu" and values.ndim == 2 and values.shape[1] >= len(axes)
    if not ({*axes} <= columns.keys() if columns else is_plain):
        what = f"columns {', '.join(columns)}" if columns else f"shape {values.shape} and type {values.dtype}"
        raise PointsError(f"got points of {what}; expected (n, {len(axes)} or more) numbers: {', '.join(axes)}")
    return np.column_stack([columns[axis] for axis in axes]) if columns else values


def _numeric(fields: Iterable[tuple[Any, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """The first of the columns of numbers with each `plain_name`."""
    columns: dict[str, NDArray[Any]] = {}
    for name, values in fields:
        if isinstance(name, str) and values.ndim == 1 and values.dtype.kind in "fiu":
            columns.setdefault(plain_name(name), values)
    return columns


def read_only(array: ArrayLike, dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """A read-only, C-contiguous and aligned view of an array; a copy only if its layout or dtype differs.

    numba compiles a kernel separately for writable and read-only arrays. Kernels get their input through this function,
    so that a memory map or ``np.frombuffer`` needs no second compilation.
    """
    if type(array) is np.ndarray and array.dtype == dtype and array.flags.num & 0x101 == 0x101:
        if not array.flags.writeable:
            return array
        view = array.view()
    else:
        view = np.require(array, dtype=dtype, requirements=["C", "A"]).view()
    view.flags.writeable = False
    return view


def plain_name(name: str) -> str:
    """A field's name for comparison: lower case, without CloudCompare's prefix (``"scalar_Intensity"``)."""
    return name.lower().removeprefix("scalar_")


def as_float64(values: NDArray[Any]) -> NDArray[np.float64]:
    """Values in float64; a signalling NaN, as damaged files hold them, is a NaN without a warning."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def remission_name(names: Iterable[str], wanted: str | None) -> str | None:
    """Name of the remission field: the wanted one, or the first known name that is present; None if there is none."""
    present = list(names)
    if wanted is None:
        return next((name for name in _REMISSION_NAMES if name in present), None)
    if plain_name(str(wanted)) not in present:
        raise PointsError(f"there is no numeric field {wanted!r} for the remission, only {', '.join(present)}")
    return plain_name(str(wanted))


def is_remission_name(name: str) -> bool:
    """Whether a name is one of those that remissions have."""
    return plain_name(str(name)) in _REMISSION_NAMES


def assemble(
    n: int,
    fields: Mapping[str, NDArray[Any]],
    names: Sequence[str],
    remission_field: str | None,
    origin_m: Sequence[float] | None = None,
) -> NDArray[np.float32]:
    """Build points (n, 4) from columns by `plain_name`; errors list ``names``. Remission is 0 without such a field."""
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise PointsError(
            f"no numeric field {', '.join(missing)} among {', '.join(map(str, names)) or 'no fields'}; "
            "expected x, y, z and a remission or intensity"
        )
    remission = remission_name(fields, remission_field)
    xyz = [fields[axis] for axis in "xyz"]
    if origin_m is not None:
        xyz = [as_float64(values) - origin for values, origin in zip(xyz, as_origin(origin_m), strict=True)]
    if any(_is_rounded(values) for values in xyz):
        middle = ", ".join(f"{np.median(as_float64(values)[np.isfinite(values)]):,.1f}" for values in xyz)
        raise MapError(
            f"the coordinates are those of a map, about ({middle}) m, and would be rounded by more than "
            f"{1e3 * MAX_ROUNDING_M:g} mm as float32; pass edgeperc.read_points the place of the sensor, which it "
            'subtracts first: origin_m= or --origin X Y Z; "auto" finds that of a level sensor'
        )
    points = np.zeros((n, 4), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for column, values in enumerate(xyz):
            points[:, column] = values
        if remission is not None:
            points[:, 3] = fields[remission]
    return points


def as_origin(given: Sequence[float]) -> tuple[float, float, float]:
    """A place in a map, x, y, z [m]."""
    try:
        x, y, z = (float(value) for value in given)
    except (OverflowError, TypeError, ValueError) as exc:
        raise OptionError(f"origin_m is {given!r:.200}; expected x, y, z [m]") from exc
    if not all(math.isfinite(value) for value in (x, y, z)):
        raise OptionError(f"origin_m is {(x, y, z)}; expected three finite numbers [m]")
    return x, y, z


def _is_rounded(values: NDArray[Any]) -> bool:
    """Whether float32 rounds most of the coordinates of an axis by more than they are measured to."""
    if values.dtype.itemsize <= 4 or not values.size:
        return False
    exact = as_float64(values[:: max(1, len(values) // 4096)])
    with np.errstate(over="ignore", invalid="ignore"):
        # Half the distance of float32 numbers there; larger ones are no map's. What float32 holds is not rounded.
        off = (np.abs(exact) >= MAX_ROUNDING_M * 2**24) & (np.abs(exact) < MAX_MAP_M) & (exact != exact.astype("f4"))
    return bool((off.mean(axis=0) > 0.5).any())


def check_each(n: int, **arrays: NDArray[Any] | None) -> None:
    """Raise PointsError for an array, named by its keyword, that has not one value for each of n points."""
    for name, array in arrays.items():
        if array is not None and array.shape != (n,):
            raise PointsError(f"got {name} of shape {array.shape} for {n} points; expected one value a point")
