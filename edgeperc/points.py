"""A sensor file or an array becomes points: (n, 4) float32, x, y, z [m] and remission as the sensor gave it."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from .errors import PointsError

__all__ = ["as_points", "read_points"]

# Best first; of an Ouster's fields, "intensity" is the raw signal and "reflectivity" the calibrated byte.
_REMISSION_NAMES = ("remission", "intensity", "i", "reflectivity", "reflectance")
_PCD_TYPES = {f"{kind}{size}": f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)} | {
    "F4": "<f4",
    "F8": "<f8",
}
_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_MAX_HEADER_BYTES = 65536
_TEXT_BYTES = np.zeros(256, dtype=np.bool_)
_TEXT_BYTES[[9, 10, 13, *range(32, 127)]] = True


def read_points(
    source: str | os.PathLike[str] | ArrayLike,
    *,
    columns: int | None = None,
    remission_field: str | None = None,
) -> NDArray[np.float32]:
    """Points of one scan, from a file or an array.

    A file that begins with a PCD header, ``ply``, NumPy's or zip's magic is read as that, whatever its name. Raw
    float32 files have no header, so their name has to end in ``.bin`` (KITTI, SemanticKITTI: x, y, z, remission) or
    ``.pcd.bin`` (nuScenes: the same and the ring), or ``columns`` says how many values a point has.

    Remission is never scaled here: the `Perceiver` does that, by its sensor's ``remission_range``. Where a file
    holds none, it is 0. Rows that are not finite stay in place, so that labels keep the file's order.

    Parameters
    ----------
    source : str, path or array
        ``.bin``, ``.pcd.bin``, ``.npy``, ``.npz`` (its only array, or the one called ``points``), ``.pcd`` (ascii,
        binary, binary_compressed), ``.ply`` (ascii, binary), or an array for `as_points`.
    columns : int, optional
        float32 values a point in a file without a header, at least 3. Other files say it themselves.
    remission_field : str, optional
        Which field is the remission, where fields have names; by default the first there is of remission,
        intensity, i, reflectivity, reflectance.

    Returns
    -------
    (n, 4) float32, C-contiguous
        x, y, z [m] and remission as stored. An array that is this already is returned itself.

    Raises
    ------
    PointsError
        When the file cannot be read, is empty, cut short or no scan at all. A scan of no points is valid where the
        file says so in a header; a file of 0 bytes is an error.
    """
    if not isinstance(source, str | os.PathLike):
        return as_points(source, remission_field=remission_field)
    path = Path(source)
    try:
        data = np.fromfile(path, dtype=np.uint8) if path.is_file() else None
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the name
        raise PointsError(f"{path}: the file cannot be read ({exc})") from exc
    if data is None:
        raise PointsError(f"{path}: there is no such file; expected a scan as .bin, .npy, .npz, .pcd or .ply")
    try:
        return _parse(data, path.name.lower(), columns, remission_field)
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc


def as_points(array: ArrayLike, *, remission_field: str | None = None) -> NDArray[np.float32]:
    """An array as points.

    Parameters
    ----------
    array : (n, 4) or (n, 3) array of numbers, or a structured array
        Any float or integer dtype, byte order and memory layout. The columns are x, y, z [m], remission; without
        the fourth, remission is 0. A structured array (any shape, e.g. that of a PointCloud2 message) needs the
        fields x, y and z; other fields and padding are skipped.
    remission_field : str, optional
        As in `read_points`; structured arrays only.

    Returns
    -------
    (n, 4) float32, C-contiguous
        The very array, not a copy, where it is this already. Values beyond float32 become infinite.

    Raises
    ------
    PointsError
        When the shape, the dtype or the fields are not those of points.
    """
    if isinstance(array, np.ma.MaskedArray):
        raise PointsError("got a masked array; fill it first, e.g. with array.filled(np.nan)")
    try:
        # Ragged sequences raise ValueError; objects may raise whatever their __array__ raises.
        values = np.asarray(array)
    except Exception as exc:
        raise PointsError(f"got no array: {exc}; expected (n, 4) x, y, z, remission") from exc
    if values.dtype.names is not None:
        flat = values.reshape(-1)
        fields: dict[str, NDArray[Any]] = {}
        for name in values.dtype.names:
            field = flat[name]
            if field.ndim == 1 and field.dtype.kind in "fiu":
                fields.setdefault(_plain_name(name), field)
        return _assemble(flat.shape[0], fields, values.dtype.names, remission_field)
    if values.dtype.kind not in "fiu":
        raise PointsError(f"got an array of {values.dtype}; expected (n, 4) numbers: x, y, z, remission")
    if values.ndim != 2 or values.shape[1] not in (3, 4):
        advice = ""
        if values.ndim == 2 and values.shape[1] > 4:
            advice = "; if the first four columns are these, pass points[:, :4]"
            if values.shape[0] in (3, 4):
                advice = "; pass points.T"
        raise PointsError(f"got an array of shape {values.shape}; expected (n, 4): x, y, z, remission{advice}")
    if values.shape[1] == 3:
        return _assemble(values.shape[0], dict(zip("xyz", values.T, strict=True)), "xyz", None)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.require(values, dtype=np.float32, requirements=["C", "A"])


def _plain_name(name: str) -> str:
    # CloudCompare calls an intensity "scalar_Intensity".
    return name.lower().removeprefix("scalar_")


def _remission_name(names: Iterable[str], wanted: str | None) -> str | None:
    present = list(names)
    if wanted is None:
        return next((name for name in _REMISSION_NAMES if name in present), None)
    if _plain_name(wanted) not in present:
        raise PointsError(f"there is no number field {wanted!r} for the remission, only {', '.join(present)}")
    return _plain_name(wanted)


def _assemble(
    n: int, fields: Mapping[str, NDArray[Any]], names: Sequence[str], remission_field: str | None
) -> NDArray[np.float32]:
    """Gather named columns; ``names`` is what the source calls its fields, for the message."""
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        raise PointsError(
            f"no number field {', '.join(missing)} among {', '.join(map(str, names)) or 'no fields'}; "
            "expected x, y, z and a remission or intensity"
        )
    remission = _remission_name(fields, remission_field)
    points = np.zeros((n, 4), dtype=np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for column, name in enumerate(("x", "y", "z", remission)):
            if name is not None:
                points[:, column] = fields[name]
    return points


def _parse(data: NDArray[np.uint8], name: str, columns: int | None, remission_field: str | None) -> NDArray[np.float32]:
    if data.size == 0:
        raise PointsError(
            "the file is empty (0 bytes), as an interrupted recording leaves it; "
            "for a scan of no points pass an array of shape (0, 4)"
        )
    head = data[:_MAX_HEADER_BYTES].tobytes()
    if head.startswith(b"\x93NUMPY"):
        return as_points(_parse_npy(data), remission_field=remission_field)
    if head.startswith(b"PK\x03\x04"):
        return as_points(_parse_npz(data), remission_field=remission_field)
    if head.startswith((b"ply\n", b"ply\r")):
        return _parse_ply(data, head, remission_field)
    if _begins_like_pcd(head):
        return _parse_pcd(data, head, remission_field)
    if columns is None:
        if not name.endswith(".bin"):
            raise PointsError(
                "neither PCD, PLY, .npy nor .npz by its first bytes; for raw float32 values name it .bin or pass "
                "columns=4 (x, y, z, remission)"
            )
        return _parse_raw(data, 5 if name.endswith(".pcd.bin") else 4, by_name=True)
    return _parse_raw(data, columns, by_name=False)


def _parse_raw(data: NDArray[np.uint8], columns: int, by_name: bool) -> NDArray[np.float32]:
    if isinstance(columns, bool) or not isinstance(columns, int | np.integer) or not 3 <= columns <= 64:
        raise PointsError(f"columns is the number of float32 values a point, 3 to 64, got {columns!r}")
    if _TEXT_BYTES[data[:4096]].all():
        raise PointsError("the file holds text, not float32 values; expected x, y, z, remission as raw float32")
    record = 4 * int(columns)
    if data.size % record:
        raise PointsError(
            f"{data.size} bytes are no whole number of points of {columns} float32 values ({record} bytes): the file "
            "is cut short, or pass columns= with the right number of values a point"
        )
    values = data.view("<f4").reshape(-1, columns)
    xyz = np.abs(values[:: max(1, len(values) // 4096), :3])
    # Right values never look like this; float64, big-endian or other bytes taken for float32 do, in most rows.
    with np.errstate(invalid="ignore"):  # comparing signalling NaN
        absurd = ((xyz > 1e7) & (xyz < np.inf)) | ((xyz > 0.0) & (xyz < 1e-30))
    if absurd.any(axis=1).mean() > 0.2:
        raise PointsError(
            "the values are no coordinates; expected little-endian float32 x, y, z, remission, not float64 nor "
            "another format"
        )
    if by_name and columns == 4 and data.size % 20 == 0:
        rows = data.view("<f4").reshape(-1, 5)[:1024]
        with np.errstate(invalid="ignore"):
            whole = rows == np.floor(rows)
            rings = whole[:, 4] & (rows[:, 4] >= 0.0) & (rows[:, 4] < 256.0)
        if rings.all() and not whole[:, :3].all():
            raise PointsError(
                "every fifth value is a small whole number, so these seem to be points of 5 values (x, y, z, "
                "intensity, ring); pass columns=5 or name the file .pcd.bin"
            )
    return as_points(values[:, :4])


def _parse_npy(data: NDArray[np.uint8]) -> NDArray[Any]:
    stream = io.BytesIO(data[:_MAX_HEADER_BYTES].tobytes())
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
    if n_bytes > data.size - start:
        raise PointsError(
            f"cut short: the .npy header declares {n_bytes} bytes of values, the file holds {data.size - start}"
        )
    try:
        values: NDArray[Any] = data[start : start + n_bytes].view(dtype) if n_bytes else np.empty(0, dtype)
        return values.reshape(shape, order="F" if fortran else "C")
    except (TypeError, ValueError) as exc:
        raise PointsError(f"the .npy array of {dtype} cannot be read: {exc}") from exc


def _parse_npz(data: NDArray[np.uint8]) -> NDArray[Any]:
    try:
        # zipfile raises BadZipFile, RuntimeError (encrypted), NotImplementedError, zlib.error, EOFError and others.
        with zipfile.ZipFile(io.BytesIO(data.tobytes())) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if "points" in members:
                member = members["points"]
            elif len(members) == 1:
                (member,) = members.values()
            else:
                raise PointsError(f"several arrays and none called points: {', '.join(members)}")
            # Deflate packs at most 1,032 to 1; scans pack less than 20 to 1.
            if member.file_size > max(100 * data.size, 1 << 24):
                raise PointsError(
                    f"{data.size} bytes claim to unpack to {member.file_size}; no scan packs so well, so it is not "
                    "unpacked. Save it as .npy"
                )
            content = archive.read(member)
    except PointsError:
        raise
    except Exception as exc:
        raise PointsError(f"the .npz archive cannot be read: {exc}") from exc
    if not content.startswith(b"\x93NUMPY"):
        raise PointsError(f"{member.filename!r} in the archive is no .npy array")
    return _parse_npy(np.frombuffer(content, dtype=np.uint8))


# --- PCD -------------------------------------------------------------------------------------------------------------


def _begins_like_pcd(head: bytes) -> bool:
    for line in head.splitlines():
        words = line.split()
        if words and not words[0].startswith(b"#"):
            return words[0] in (b"VERSION", b"FIELDS", b"COLUMNS")
        if line.startswith(b"# .PCD"):
            return True
    return False


@dataclass(frozen=True)
class _PcdHeader:
    names: tuple[str, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    n_points: int
    encoding: str
    n_bytes: int


def _parse_pcd_header(head: bytes) -> _PcdHeader:
    entries: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in entries:
        end = head.find(b"\n", at)
        if end < 0:
            raise PointsError("the PCD header has no DATA line; the file is cut short or no PCD file")
        words = head[at:end].decode("latin-1").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0]] = words[1:]
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    try:
        sizes = [_whole(word) for word in entries.get("SIZE", [])]
        counts = [_whole(word) for word in entries.get("COUNT", ["1"] * len(names))]
        width, height = (_whole(entries[key][0]) if key in entries else None for key in ("WIDTH", "HEIGHT"))
        n_points = _whole(entries["POINTS"][0]) if "POINTS" in entries else None
    except (ValueError, IndexError) as exc:
        raise PointsError(f"the PCD header holds no number where one belongs ({exc})") from exc
    kinds = entries.get("TYPE", [])
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise PointsError("the PCD header's FIELDS, SIZE, TYPE and COUNT lines must be of equal length")
    types = [_PCD_TYPES.get(f"{kind}{size}", "") for kind, size in zip(kinds, sizes, strict=True)]
    if not all(types):
        raise PointsError(
            f"the PCD header has a field of an unknown TYPE and SIZE: {' '.join(kinds)} / {' '.join(map(str, sizes))}"
        )
    if any(not 1 <= count <= _MAX_HEADER_BYTES for count in counts):
        raise PointsError(f"the PCD header's COUNT must be at least 1, got {' '.join(map(str, counts))}")
    organised = None if width is None else width * (1 if height is None else height)
    if n_points is None and organised is not None and organised < 1 << 63:
        n_points = organised
    if n_points is None or n_points < 0 or organised not in (None, n_points):
        raise PointsError(f"the PCD header declares {width} x {height} points and POINTS {n_points}; they must agree")
    encoding = entries["DATA"][0].lower() if entries["DATA"] else ""
    return _PcdHeader(tuple(names), tuple(types), tuple(counts), n_points, encoding, at)


def _parse_pcd(data: NDArray[np.uint8], head: bytes, remission_field: str | None) -> NDArray[np.float32]:
    header = _parse_pcd_header(head)
    n = header.n_points
    widths = [int(np.dtype(kind).itemsize) * count for kind, count in zip(header.types, header.counts, strict=True)]
    record = sum(widths)
    body = data[header.n_bytes :]
    single: dict[str, int] = {}  # where each field of one value stands; padding is called "_" many times
    for k, name in enumerate(header.names):
        if header.counts[k] == 1:
            single.setdefault(_plain_name(name), k)
    fields: dict[str, NDArray[Any]]
    if header.encoding == "ascii":
        return _parse_table(
            body, 0, n, {name: sum(header.counts[:k]) for name, k in single.items()}, header.names, remission_field
        )
    if header.encoding == "binary":
        if n * record > body.size:
            raise _cut_short(n, record, body.size)
        fields = {name: _column(body, header.types[k], n, sum(widths[:k]), record) for name, k in single.items()}
    elif header.encoding == "binary_compressed":
        unpacked = _unpack_pcd(body, n * record)
        fields = {
            name: _column(unpacked, header.types[k], n, n * sum(widths[:k]), widths[k]) for name, k in single.items()
        }
    else:
        raise PointsError(f"PCD data is ascii, binary or binary_compressed, got {header.encoding!r}")
    return _assemble(n, fields, header.names, remission_field)


def _column(data: NDArray[np.uint8], kind: str, n: int, offset: int, stride: int) -> NDArray[Any]:
    if n == 0:
        return np.empty(0, dtype=kind)
    column: NDArray[Any] = np.ndarray((n,), kind, data.data, offset, (stride,))
    return column


def _whole(word: str) -> int:
    value = int(word)
    if abs(value) >= 1 << 63:
        raise ValueError("a number beyond 64 bits")
    return value


def _cut_short(n: int, record: int, size: int) -> PointsError:
    return PointsError(
        f"cut short: the header declares {n} points of {record} bytes, but {size} bytes follow it ({size // record} "
        "points)"
    )


def _unpack_pcd(body: NDArray[np.uint8], n_bytes: int) -> NDArray[np.uint8]:
    if n_bytes == 0:
        return np.empty(0, dtype=np.uint8)
    if body.size < 8:
        raise PointsError("cut short: no compressed data follows the PCD header")
    packed_size, size = (int(v) for v in body[:8].view("<u4"))
    if packed_size > body.size - 8:
        raise PointsError(f"cut short: {packed_size} bytes of compressed data declared, {body.size - 8} are there")
    # The longest LZF reference takes 3 bytes and gives 264, so a larger claim is false; check before allocating.
    if size != n_bytes or size > 88 * packed_size:
        raise PointsError(f"{packed_size} compressed bytes claim to unpack to {size}; the fields need {n_bytes}")
    unpacked = np.empty(size, dtype=np.uint8)
    if fill_unpacked_lzf(body[8 : 8 + packed_size], unpacked) != size:
        raise PointsError("the compressed data is damaged")
    return unpacked


@njit(cache=True, nogil=True)
def fill_unpacked_lzf(packed: NDArray[np.uint8], unpacked: NDArray[np.uint8]) -> int:
    """Decompress LZF data into ``unpacked``.

    Parameters
    ----------
    packed : (m,) uint8
    unpacked : (size,) uint8, overwritten

    Returns
    -------
    int
        Bytes written, or -1 where the data reads before its start, past its end or past the output.
    """
    n_in = packed.shape[0]
    n_out = unpacked.shape[0]
    i = 0
    o = 0
    while i < n_in:
        control = np.int64(packed[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n_in or o + length > n_out:
                return -1
            for _ in range(length):
                unpacked[o] = packed[i]
                o += 1
                i += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n_in:
                return -1
            length += np.int64(packed[i])
            i += 1
        if i >= n_in:
            return -1
        back = o - ((control & 31) << 8) - np.int64(packed[i]) - 1
        i += 1
        length += 2
        if back < 0 or o + length > n_out:
            return -1
        for _ in range(length):  # byte by byte: a reference may overlap what it writes
            unpacked[o] = unpacked[back]
            o += 1
            back += 1
    return o


def _parse_table(
    body: NDArray[np.uint8],
    skipped_rows: int,
    n: int,
    places: Mapping[str, int],
    names: Sequence[str],
    remission_field: str | None,
) -> NDArray[np.float32]:
    """Rows of text; ``places`` holds each field's position in a row."""
    wanted = {name: places[name] for name in "xyz" if name in places}
    remission = _remission_name(places, remission_field)
    if remission is not None:
        wanted[remission] = places[remission]
    if len(wanted) < 3 or n == 0:
        return _assemble(0, {name: np.empty(0) for name in wanted}, names, remission_field)
    ends = np.flatnonzero(np.append(body, np.uint8(10)) == 10) + 1
    if skipped_rows + n > len(ends):
        raise PointsError(f"cut short: {skipped_rows + n} rows declared, {len(ends)} are there")
    text = body[ends[skipped_rows - 1] if skipped_rows else 0 : ends[skipped_rows + n - 1]].tobytes()
    if not text.strip():
        raise PointsError(f"cut short: {n} rows declared, none are there")
    try:
        rows = np.loadtxt(
            io.BytesIO(text), np.float64, comments=None, usecols=list(wanted.values()), ndmin=2, encoding="latin-1"
        )
    except (ValueError, OverflowError) as exc:
        raise PointsError(f"a row of text is no row of numbers: {exc}") from exc
    if len(rows) != n:
        raise PointsError(f"cut short: {n} rows declared, {len(rows)} of numbers are there")
    return _assemble(n, dict(zip(wanted, rows.T, strict=True)), names, remission_field)


# --- PLY -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _PlyElement:
    name: str
    count: int
    properties: list[tuple[str, str, str]]  # name, type, type of a list's length or ""

    @property
    def has_lists(self) -> bool:
        return any(length_type for _, _, length_type in self.properties)


def _parse_ply_header(head: bytes) -> tuple[str, list[_PlyElement], int]:
    encoding = ""
    elements: list[_PlyElement] = []
    at = 0
    while True:
        end = head.find(b"\n", at)
        if end < 0:
            raise PointsError("the PLY header has no end_header line; the file is cut short or no PLY file")
        words = head[at:end].decode("latin-1").split()
        at = end + 1
        try:
            match words:
                case ["end_header"]:
                    break
                case ["format", kind, *_]:
                    encoding = kind
                case ["element", name, count]:
                    if _whole(count) < 0:
                        raise ValueError("a negative count")
                    elements.append(_PlyElement(name, _whole(count), []))
                case ["property", "list", length_type, kind, name]:
                    if _PLY_TYPES[length_type][0] == "f":
                        raise ValueError("a list's length must be whole")
                    elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[length_type]))
                case ["property", kind, name]:
                    elements[-1].properties.append((name, _PLY_TYPES[kind], ""))
                case ["ply"] | [] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    raise ValueError("an unknown line")
        except (ValueError, KeyError, IndexError) as exc:
            raise PointsError(f"the PLY header line {' '.join(words)[:80]!r} cannot be read ({exc})") from exc
    return encoding, elements, at


def _parse_ply(data: NDArray[np.uint8], head: bytes, remission_field: str | None) -> NDArray[np.float32]:
    encoding, elements, start = _parse_ply_header(head)
    before: list[_PlyElement] = []
    for vertex in elements:
        if vertex.name == "vertex":
            break
        before.append(vertex)
    else:
        raise PointsError("the PLY file has no vertex element")
    body = data[start:]
    names = [name for name, _, _ in vertex.properties]
    places: dict[str, int] = {}
    for k, (name, _, length_type) in enumerate(vertex.properties):
        if not length_type:
            places.setdefault(_plain_name(name), k)
    if encoding == "ascii":
        if vertex.has_lists:
            raise PointsError("a PLY text file with lists among a vertex' properties; save it as binary")
        return _parse_table(body, sum(e.count for e in before), vertex.count, places, names, remission_field)
    if encoding not in ("binary_little_endian", "binary_big_endian"):
        raise PointsError(f"PLY data is ascii, binary_little_endian or binary_big_endian, got {encoding!r}")
    order = "<" if encoding == "binary_little_endian" else ">"
    at = 0
    for element in before:
        at = _row_starts(body, at, element, order)[1]
    starts, _ = _row_starts(body, at, vertex, order)
    n = vertex.count
    fields: dict[str, NDArray[Any]] = {}
    if starts is None:
        widths = [int(np.dtype(kind).itemsize) for _, kind, _ in vertex.properties]
        record = sum(widths)
        for name, k in places.items():
            kind = order + vertex.properties[k][1]
            fields[name] = _column(body, kind, n, at + sum(widths[:k]), record)
    else:
        for name, k in places.items():
            kind = order + vertex.properties[k][1]
            octets = starts[:, k, None] + np.arange(np.dtype(kind).itemsize)
            fields[name] = body[octets].reshape(-1).view(kind)
    return _assemble(n, fields, names, remission_field)


def _row_starts(
    body: NDArray[np.uint8], at: int, element: _PlyElement, order: str
) -> tuple[NDArray[np.int64] | None, int]:
    """Where each property of each row begins, None where rows are of one length; and where the element ends."""
    if not element.has_lists:
        record = sum(int(np.dtype(kind).itemsize) for _, kind, _ in element.properties)
        end = at + element.count * record
        if end > body.size:
            raise _cut_short(element.count, record, body.size - at)
        return None, end
    byte_order: Literal["little", "big"] = "little" if order == "<" else "big"
    steps = [
        (np.dtype(kind).itemsize, np.dtype(length or "u1").itemsize if length else 0)
        for _, kind, length in element.properties
    ]
    least = sum(length_size or size for size, length_size in steps)
    if at + element.count * least > body.size:
        raise _cut_short(element.count, least, body.size - at)
    starts = np.empty((element.count, len(steps)), dtype=np.int64)
    for row in range(element.count):
        for k, (size, length_size) in enumerate(steps):
            starts[row, k] = at
            if length_size:
                at += length_size + size * int.from_bytes(body[at : at + length_size].tobytes(), byte_order)
            else:
                at += size
            if at > body.size:
                raise PointsError(f"cut short: row {row} of {element.count} of {element.name!r} ends past the file")
    return starts, at
