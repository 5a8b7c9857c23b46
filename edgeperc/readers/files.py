"""Read points from sensor files: raw binary, .npy and .npz here, .pcd and .ply in their own modules."""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import PointsError
from ..types.points import (
    Bytes,
    Floats32,
    Points,
    as_float64,
    as_points,
    assemble,
    columns_of,
    is_remission_name,
    plain_name,
    remission_name,
)
from .inflate import inflate, most_bytes
from .origin import find_place
from .packets import capture_kind
from .pcd import begins_like_pcd, parse_pcd
from .ply import parse_ply
from .raw import column_names, parse_raw
from .tables import MAX_HEADER_BYTES, MAX_SCAN_BYTES, Columns
from .text import begins_like_text, parse_text
from .times import LONGEST_S, TimedScan, point_times
from .unknown import advice_for, missing


def read_points(
    source: str | os.PathLike[str] | ArrayLike,
    *,
    columns: int | Sequence[str] | None = None,
    remission_field: str | None = None,
    origin_m: Sequence[float] | Literal["auto"] | None = None,
) -> Floats32:
    """Read the points of one scan from a file or an array.

    The first bytes of a file decide its format: a PCD header, ``ply``, NumPy's or zip's magic. Raw float32 files have
    no header, so their name must end in ``.bin``, or ``columns`` says what they hold. A ``.bin`` has 4 values a point
    (KITTI, SemanticKITTI: x, y, z, remission) and a ``.pcd.bin`` 5 (nuScenes: the same and the ring), unless the values
    themselves show that it has another number, 3 to 12: those of one column are alike.

    Remission is not scaled here: the `Perceiver` does that, by its sensor's ``remission_range``. It is 0 if the file
    holds none. Rows that are not finite stay in place, so that labels have the file's order.

    Parameters
    ----------
    source : str, path or array
        ``.bin``, ``.pcd.bin``, ``.npy``, ``.npz`` (its only array, or the one called ``points``, with the remission
        beside), ``.pcd`` (ascii, binary, binary_compressed), ``.ply`` (ascii, binary), a table of text (``.csv``,
        ``.xyz``, ``.txt``, ``.pts``), or an array for `as_points`.
    columns : int or sequence of str, optional
        What a raw file, an array or a text without names holds for each point: the names of the values in order, such
        as ``("x", "y", "z", "intensity", "ring")``; or, of a raw file or an array, the number of values, at least 3, of
        which the first are x, y, z and remission. Not used for files that have names, with a warning, and if ``source``
        is an array.
    remission_field : str, optional
        Name of the remission field, for formats with named fields. By default the first existing one of remission,
        intensity, i, reflectivity, reflectance.
    origin_m : sequence of 3 float or "auto", optional
        Place of the sensor in a map [m], subtracted from the coordinates before they become float32, which rounds UTM
        northings to 0.5 m. ``"auto"``: that of `find_origin`.

    Returns
    -------
    (n, 4) float32, C-contiguous
        x, y, z [m] and remission as stored. An array that already has this form is returned itself.

    Raises
    ------
    PointsError
        The file cannot be read, is empty, larger than 256 MiB, cut short or not a scan. A scan of no points is valid
        if a header says so; a file of 0 bytes is an error. Coordinates of a map need ``origin_m``.
    OptionError
        ``origin_m`` is not three finite numbers.
    """
    options = FileOptions(columns, remission_field, origin_m)
    if isinstance(source, str | os.PathLike):
        return _read(Path(source), options).points
    return _of_array(source, options).points


def find_origin(
    source: str | os.PathLike[str] | ArrayLike, *, columns: int | Sequence[str] | None = None
) -> tuple[float, float, float]:
    """Find the place of the sensor in a scan whose coordinates are those of a map.

    From there, the points of each beam have one elevation. The axes may be turned about z, but a sensor that leans, a
    scan whose points were moved one by one, or a sensor without rows of beams is refused.

    Parameters
    ----------
    source, columns
        As in `read_points`.

    Returns
    -------
    tuple of 3 float
        x, y, z [m], for ``origin_m`` of `read_points` and of a `Perceiver`'s call.

    Raises
    ------
    PointsError
        As `read_points`, or the place cannot be told.
    """
    options = FileOptions(columns, None, "auto")
    read = _read(Path(source), options) if isinstance(source, str | os.PathLike) else _of_array(source, options)
    assert read.origin_m is not None
    x, y, z = read.origin_m
    return x, y, z


class FileOptions(NamedTuple):
    """Options of `read_points`."""

    columns: int | Sequence[str] | None
    remission_field: str | None
    origin_m: Sequence[float] | Literal["auto"] | None


def parse_points(content: bytes, name: str) -> Floats32:
    """Read the points in the content of a file of this name; errors as `read_points`, and for one that is cut short or
    holds more than it declares.
    """
    read = _parse_named(np.frombuffer(content, np.uint8), Path(name), FileOptions(None, None, None))
    if read.n_missing:
        raise PointsError(f"{name}: {read.missing()}")
    return read.points


def read_timed_file(path: Path, options: FileOptions) -> TimedScan:
    """Read a scan file with the times of its points; on a clock, the last is its stamp. Errors as `read_points`."""
    read = _read(path, options)
    times_s = point_times(read.fields, read.points, None)
    last_s = 0.0 if times_s is None else float(np.nanmax(times_s))
    return TimedScan(last_s if last_s >= LONGEST_S else None, read.points, times_s)


class _Read(NamedTuple):
    """Points, the fields of the file if they have names, the place in a map that was subtracted, and how many points a
    file that was cut short lacks; below 0: how many it holds beyond those that its header declares.
    """

    points: Points
    fields: Mapping[str, NDArray[Any]]
    origin_m: Sequence[float] | None
    n_missing: int = 0

    def missing(self) -> str:
        """What a file that was cut short lacks, or what of a longer one is not read, as a sentence."""
        if self.n_missing < 0:
            return f"{-self.n_missing:,} points follow the {len(self.points):,} that the header declares: not read"
        there = f"the first {len(self.points):,} of {len(self.points) + self.n_missing:,} points are there"
        return f"cut short: {there}, so a part of the surroundings is missing"


def _read(path: Path, options: FileOptions) -> _Read:
    try:
        if path.is_dir():
            raise PointsError(f"{path}: a folder; expected one scan file. edgeperc.read_scans reads those in a folder")
        if not path.exists():
            raise PointsError(f"{path}: {missing(path, 'file', 'a scan as .bin, .npy, .npz, .pcd or .ply')}")
        if not path.is_file():
            raise PointsError(f"{path}: a pipe or a device, not a file; write what it gives into a file, and pass that")
        size = path.stat().st_size
        if size > MAX_SCAN_BYTES:
            raise PointsError(f"{path}: {size:,} bytes are too much for one scan; expected at most {MAX_SCAN_BYTES:,}")
        data = np.fromfile(path, dtype=np.uint8)
    except PointsError:
        raise
    except (MemoryError, OSError, ValueError) as exc:  # ValueError: a NUL in the name
        raise PointsError(f"{path}: the file cannot be read ({exc})") from exc
    read = _parse_named(data, path, options)
    if read.n_missing:
        warnings.warn(f"{path}: {read.missing()}", UserWarning, stacklevel=3)
    return read


def _parse_named(data: Bytes, path: Path, options: FileOptions) -> _Read:
    try:
        return _parse(data, path.name.lower(), options)
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc
    except MemoryError as exc:
        raise PointsError(f"{path}: reading {data.size:,} bytes takes more memory than there is") from exc


def _parse(data: Bytes, name: str, options: FileOptions) -> _Read:
    if data.size == 0:
        raise PointsError(
            "the file is empty (0 bytes), as an interrupted recording leaves it; "
            "for a scan of no points pass an array of shape (0, 4)"
        )
    head = data[:MAX_HEADER_BYTES].tobytes()
    if head.startswith(b"\xef\xbb\xbf") and not name.endswith(".bin"):  # as editors of Windows begin a text
        data, head = data[3:], head[3:]
    if head.startswith(b"\x93NUMPY"):
        return _of_stored(_parse_npy(data), options)
    if head.startswith(b"PK\x03\x04"):
        array, is_joined = _parse_npz(data, options)
        return _of_stored(array, options._replace(remission_field=None) if is_joined else options)
    if head.startswith((b"ply\n", b"ply\r")):
        return _of_named(parse_ply(data, head, options.remission_field), options)
    if begins_like_pcd(head):
        return _of_named(parse_pcd(data, head, options.remission_field), options)
    # The first bytes of float32 values may be any, but thousands of them are no text.
    may_be_raw = options.columns is not None or (name.endswith(".bin") and not begins_like_text(head))
    advice = None if may_be_raw else advice_for(head, name)
    if advice is not None:
        raise PointsError(f"this is {advice}")
    if begins_like_text(head) and not name.endswith(".bin"):
        table, is_named = parse_text(data, options.columns)
        return _of_named(table, options) if is_named else _of_columns(table, options)
    if options.columns is None and not name.endswith(".bin"):
        if capture_kind(head) is not None:
            raise PointsError("this is a recording of many scans; expected one scan file. edgeperc.read_scans reads it")
        raise PointsError(
            f"neither PCD, PLY, .npy, .npz nor text by its first bytes, {head[:8]!r}; if they are raw float32 values, "
            "name it .bin, or pass columns= (--columns) x y z remission"
        )
    try:
        raw = parse_raw(data, options.columns, 5 if name.endswith(".pcd.bin") else 4)
    except PointsError as exc:
        advice = advice_for(head)
        raise exc if advice is None else PointsError(f"{exc}; its first bytes are those of {advice}") from exc
    return _of_values(raw, options)


def _of_named(columns: Columns, options: FileOptions) -> _Read:
    """Of a file that names its values."""
    _check_unused(columns.fields, options)
    return _of_columns(columns, options)


def _check_unused(names: Iterable[str], options: FileOptions) -> None:
    """Say that names of columns are not taken; without the path, so that it is said once for a folder."""
    if options.columns is not None:
        warnings.warn(f"columns= (--columns) is not used: the file names its values, {', '.join(names)}", stacklevel=2)


def _of_values(columns: Columns, options: FileOptions) -> _Read:
    """Of a file whose columns have the names of the options, or none."""
    if options.columns is None or isinstance(options.columns, int | np.integer):
        return _of_columns(columns, _unnamed(options, len(columns.names)))._replace(fields={})
    return _of_columns(columns, options)


def _unnamed(options: FileOptions, n: int) -> FileOptions:
    """Options for ``n`` values a point without names, of which the fourth is the remission. Raises PointsError."""
    if options.remission_field is not None and (n < 4 or not is_remission_name(options.remission_field)):
        raise PointsError(
            f"there is no field {options.remission_field!r} for the remission: the values have no names"
            f"{' and are three a point' if n < 4 else ''}. Say what they are: columns=, or --columns x y z intensity "
            "ring"
        )
    return options._replace(remission_field=None)


def _of_stored(array: NDArray[Any], options: FileOptions) -> _Read:
    """Of the array of a file."""
    usual = array.ndim == 2 and (array.shape[1] <= 4 or array.shape[0] in (3, 4))
    if array.dtype.names:
        _check_unused(array.dtype.names, options)
    if array.dtype.kind not in "fiu" or array.ndim != 2 or (options.columns is None and usual):
        return _of_array(array, options)
    if options.columns is None:
        raise PointsError(
            f"the array has the shape {array.shape}; expected (n, 4): x, y, z, remission. Say what its columns hold: "
            "columns=, or --columns x y z intensity ring; of a set of labeled scans, keep these four"
        )
    names = column_names(options.columns)
    if len(names) != array.shape[1]:
        raise PointsError(
            f"the array has the shape {array.shape}, and columns= (--columns) names {len(names)} values a point"
        )
    return _of_values(Columns(len(array), dict(zip(names, array.T, strict=True)), names), options)


def _of_array(given: ArrayLike, options: FileOptions) -> _Read:
    fields, array = columns_of(given)
    options = options if fields else _unnamed(options, array.shape[1] if array.ndim == 2 else 4)
    xyz = fields if fields or array.ndim != 2 else dict(zip("xyz", array.T, strict=False))
    origin = _origin(xyz, options)
    return _Read(as_points(given, remission_field=options.remission_field, origin_m=origin), fields, origin)


def _of_columns(columns: Columns, options: FileOptions) -> _Read:
    origin = _origin(columns.fields, options)
    n, fields, names, n_missing = columns
    return _Read(assemble(n, fields, names, options.remission_field, origin), fields, origin, n_missing)


def _origin(fields: Mapping[str, NDArray[Any]], options: FileOptions) -> Sequence[float] | None:
    """The given place of the sensor, or the one that is found; fields without coordinates are refused afterwards."""
    if not isinstance(options.origin_m, str) or options.origin_m != "auto":
        return options.origin_m
    if not all(axis in fields for axis in "xyz"):
        return None
    return find_place(np.column_stack([as_float64(fields[axis]) for axis in "xyz"]))


def _parse_npy(data: Bytes) -> NDArray[Any]:
    stream = io.BytesIO(data[:MAX_HEADER_BYTES].tobytes())
    try:
        # numpy's header parser evaluates a literal and raises many things on a bad one.
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, fortran, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise ValueError(f"version {version} is for field names that are not ASCII; save it without")
    except Exception as exc:
        raise PointsError(f"the .npy header cannot be read: {exc}") from exc
    if dtype.hasobject:
        raise PointsError("the array holds Python objects, which are never unpickled; save numbers: (n, 4) float32")
    if dtype.itemsize == 0 or any(not 0 <= edge <= data.size for edge in shape):
        raise PointsError(f"the .npy header declares {shape} values of {dtype}, more than the file can hold")
    start = stream.tell()
    n_bytes = math.prod(shape) * dtype.itemsize
    if data[start + n_bytes : start + n_bytes + 6].tobytes() == b"\x93NUMPY":
        raise PointsError("several arrays one after another, as np.save appends them; save each in a file of its own")
    if n_bytes > data.size - start:
        raise PointsError(
            f"cut short: the .npy header declares {n_bytes} bytes of values, the file holds {data.size - start}"
        )
    try:
        values: NDArray[Any] = data[start : start + n_bytes].view(dtype) if n_bytes else np.empty(0, dtype)
        return values.reshape(shape, order="F" if fortran else "C")
    except (TypeError, ValueError) as exc:
        raise PointsError(f"the .npy array of {dtype} cannot be read: {exc}") from exc


def _parse_npz(data: Bytes, options: FileOptions) -> tuple[NDArray[Any], bool]:
    """The points of an archive, and whether the remission beside them, by its name or the usual ones, is among them."""
    try:
        # zipfile raises BadZipFile, RuntimeError (encrypted), NotImplementedError, zlib.error, EOFError and others.
        with zipfile.ZipFile(io.BytesIO(data.tobytes())) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if members and not any(info.filename.endswith(".npy") for info in members.values()):
                raise PointsError("this is an archive; unpack it first")
            name = "points" if "points" in members else next(iter(members), "")
            if len(members) != 1 and name != "points":
                raise PointsError(
                    f"several arrays and none called points: {', '.join(members)}; save one of shape (n, 4), x, y, z "
                    "and remission, as points"
                )
            points = _parse_member(data, members[name])
            others = {plain_name(other): other for other in members if other != name}
            wanted = options.remission_field
            replaces = wanted is not None and plain_name(wanted) in others and options.columns is None
            if points.dtype.names or points.shape[1:] not in ((3,), (4,) if replaces else (3,)):
                return points, False
            remission = remission_name(others, wanted) if others else None
            if remission is None:
                return points, False
            beside = members[others[remission]]
            values = _parse_member(data, beside).reshape(-1, 1)
            if len(values) != len(points) or not {points.dtype.kind, values.dtype.kind} <= {*"fiu"}:
                raise PointsError(f"{beside.filename!r} in the archive is not one number for each of the points")
            return np.hstack([points[:, :3], values]), True
    except PointsError:
        raise
    except Exception as exc:
        raise PointsError(f"the .npz archive cannot be read: {exc}") from exc


def _parse_member(data: Bytes, member: zipfile.ZipInfo) -> NDArray[Any]:
    if member.file_size > most_bytes(data.size):
        raise PointsError(
            f"{data.size} bytes claim to unpack to {member.file_size}; no scan packs so well, so it is not "
            "unpacked. Save it as .npy"
        )
    content = _unpack_member(data, member)
    if not content.startswith(b"\x93NUMPY"):
        raise PointsError(f"{member.filename!r} in the archive is not a .npy array")
    return _parse_npy(np.frombuffer(content, dtype=np.uint8))


def _unpack_member(data: Bytes, member: zipfile.ZipInfo) -> bytes:
    """A member of a zip archive, without unpacking more than it claims: `zipfile` has no such limit for bzip2."""
    methods = {zipfile.ZIP_STORED: "", zipfile.ZIP_DEFLATED: "deflate", zipfile.ZIP_BZIP2: "bz2"}
    if member.compress_type not in methods or member.flag_bits & 1:
        raise PointsError(f"{member.filename!r} is encrypted, or compressed by another method than deflate or bzip2")
    offset = member.header_offset
    # The header in front of a member has a name and an extra field of its own.
    if data[offset : offset + 4].tobytes() != b"PK\x03\x04" or offset + 30 > data.size:
        raise PointsError(f"{member.filename!r} does not begin at the byte {offset:,} that the archive names")
    offset += 30 + int(data[offset + 26 : offset + 30].view("<u2").sum())
    packed = data[offset : offset + member.compress_size].tobytes()
    content = inflate(packed, methods[member.compress_type], min(member.file_size, MAX_SCAN_BYTES))
    if len(content) != member.file_size or zlib.crc32(content) != member.CRC:
        raise PointsError(f"{member.filename!r} in the archive is damaged: its length or CRC-32 is wrong")
    return content
