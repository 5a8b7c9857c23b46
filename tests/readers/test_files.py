"""Files and arrays become points, or `PointsError` says why not."""

from __future__ import annotations

import io
import os
import struct
import tempfile
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import edgeperc
import twins.points
from edgeperc.errors import OptionError, PointsError
from edgeperc.readers.files import read_points
from edgeperc.readers.pcd import fill_unpacked_lzf
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.points import as_points

POINTS = np.array(
    [[12.5, -3.25, -1.75, 0.25], [40.0, 8.5, 2.0, 0.99], [np.nan, 1.0, 1.0, 0.5], [5.0, np.inf, 0.0, 0.0]], np.float32
)
FORMATS = (".bin", ".pcd.bin", ".npy", ".npz", ".pcd", ".ply", ".unknown")


def save(folder: Path, name: str, content: bytes) -> Path:
    path = folder / name
    path.write_bytes(content)
    return path


XYZ, XYZI = ("x y z", "F F F", "4 4 4", "1 1 1"), ("x y z intensity", "F F F F", "4 4 4 4", "1 1 1 1")


def pcd(
    fields: str, types: str, sizes: str, counts: str, n: int, encoding: str, body: bytes, width: int | None = None
) -> bytes:
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        f"FIELDS {fields}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH {n if width is None else width}\n"
        f"HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA {encoding}\n"
    )
    return header.encode() + body


def pcd_of(rows: np.ndarray, encoding: str = "binary") -> bytes:
    """Of a structured array."""
    kinds = [rows.dtype[name] for name in rows.dtype.names or ()]
    text = "\n".join(" ".join(repr(value.item()) for value in row) for row in rows) + "\n"
    return pcd(
        " ".join(rows.dtype.names or ()),
        " ".join(kind.kind.upper() for kind in kinds),
        " ".join(str(kind.itemsize) for kind in kinds),
        " ".join("1" for _ in kinds),
        len(rows),
        encoding,
        text.encode() if encoding == "ascii" else rows.tobytes(),
    )


def lzf_literals(data: bytes) -> bytes:
    return b"".join(bytes([len(data[i : i + 32]) - 1]) + data[i : i + 32] for i in range(0, len(data), 32))


def packed_pcd(points: np.ndarray, packed: bytes | None = None, size: tuple[int, int] | None = None) -> bytes:
    plain = points.T.astype("<f4").tobytes()
    packed = lzf_literals(plain) if packed is None else packed
    sizes = struct.pack("<II", len(packed), len(plain) if size is None else size)
    return pcd(*XYZI, len(points), "binary_compressed", sizes + packed)


def properties(*names: str, kind: str = "float") -> str:
    return "".join(f"property {kind} {name}\n" for name in names)


def ply(encoding: str, body: bytes, n: int = 4, before: str = "", of: str = "") -> bytes:
    """``before`` and ``of``: other elements, and the vertex' properties in place of x, y, z and intensity."""
    of = of or properties("x", "y", "z", "intensity")
    return f"ply\nformat {encoding} 1.0\ncomment c\n{before}element vertex {n}\n{of}end_header\n".encode() + body


def ply_of(rows: np.ndarray) -> bytes:
    """Of a structured array."""
    kinds = {"f4": "float", "f8": "double", "u4": "uint"}
    of = "".join(properties(name, kind=kinds[rows.dtype[name].str[1:]]) for name in rows.dtype.names or ())
    return ply("binary_little_endian", rows.tobytes(), len(rows), of=of)


def text_rows(points: np.ndarray) -> bytes:
    return "".join(" ".join(f"{float(v)!r}" for v in row) + "\n" for row in points).encode()


def npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def npz(compressed: bool = True, **arrays: Any) -> bytes:
    stream = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(stream, **arrays)
    return stream.getvalue()


def zipped(name: str, content: bytes) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return stream.getvalue()


RINGS = np.arange(len(POINTS), dtype=np.float32)[:, None]
PADDED = np.zeros(len(POINTS), dtype="<f4, <f8, V3, <u2, <f4, <i4, <f4")
for _k, _name in enumerate(("f6", "f1", "f4", "f0")):
    PADDED[_name] = POINTS[:, _k]
PADDED["f3"] = 7
BIG = POINTS.astype(">f4")
FILES = {
    "kitti.bin": POINTS.tobytes(),
    "nuscenes.pcd.bin": np.hstack([POINTS, RINGS]).tobytes(),
    "plain.npy": npy(POINTS),
    "fortran.npy": npy(np.asfortranarray(POINTS)),
    "double.npy": npy(POINTS.astype(np.float64)),
    "big_endian.npy": npy(BIG),
    "magic_counts_not_the_name.bin": npy(POINTS),
    "packed.npz": npz(scan=POINTS),
    "named.npz": npz(points=POINTS, labels=np.zeros(4)),
    "plain.npz": npz(compressed=False, scan=POINTS),
    "binary.pcd": pcd(*XYZI, 4, "binary", POINTS.tobytes()),
    "padded.pcd": pcd(
        "intensity y _ ring z _ x", "F F U U F I F", "4 8 1 2 4 4 4", "1 1 3 1 1 1 1", 4, "binary", PADDED.tobytes()
    ),
    "ascii.pcd": pcd("x y z i", "F F F F", "4 4 4 4", "1 1 1 1", 4, "ascii", text_rows(POINTS)),
    "ascii_histogram.pcd": pcd(
        *("h x y z i", "F F F F F", "4 4 4 4 4", "2 1 1 1 1", 4, "ascii"),
        b"".join(b"8 9 " + row + b"\n" for row in text_rows(POINTS).splitlines()),
    ),
    "compressed.pcd": packed_pcd(POINTS),
    "no_hash.pcd": pcd("x y z i", "F F F F", "4 4 4 4", "1 1 1 1", 4, "binary", POINTS.tobytes()).split(b"\n", 1)[1],
    "little.ply": ply("binary_little_endian", POINTS.tobytes()),
    "big.ply": ply("binary_big_endian", BIG.tobytes()),
    "ascii.ply": ply(
        "ascii",
        text_rows(POINTS) + b"3 0 1 2\n",
        of=properties("x", "y", "z", "intensity") + "element face 1\nproperty list uchar int vertex_indices\n",
    ),
    "cloud_compare.ply": ply(
        "binary_little_endian", POINTS.tobytes(), of=properties("x", "y", "z", "scalar_Intensity")
    ),
    "element_before.ply": ply(
        "binary_little_endian",
        b"\1" * 9 + POINTS.tobytes(),
        before="element camera 3\nproperty uchar a\nproperty ushort b\n",
    ),
    "element_before_ascii.ply": ply(
        "ascii", b"1 2\n3 4\n" + text_rows(POINTS), before="element camera 2\nproperty uchar a\nproperty int b\n"
    ),
    "list_before.ply": ply(
        "binary_big_endian", b"\2aabb\0\1cc" + BIG.tobytes(), before="element face 3\nproperty list uchar short a\n"
    ),
    "list_in_vertex.ply": ply(
        "binary_little_endian",
        b"".join(row[:2].tobytes() + bytes([k, *([9] * k)]) + row[2:].tobytes() for k, row in enumerate(POINTS)),
        of=properties("x", "y") + "property list uchar uchar l\n" + properties("z", "remission"),
    ),
}
FILES |= {f"marked_{name}": b"\xef\xbb\xbf" + FILES[name] for name in ("ascii.pcd", "ascii.ply")}


@pytest.mark.parametrize("name", FILES)
def test_every_format_gives_the_same_points_in_the_same_order(tmp_path: Path, name: str) -> None:
    points = read_points(save(tmp_path, name, FILES[name]))
    assert points.dtype == np.float32
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(points, POINTS)


@pytest.mark.parametrize("name", FILES)
def test_a_file_cut_anywhere_is_an_error_or_at_most_fewer_points(tmp_path: Path, name: str) -> None:
    content = FILES[name]
    for end in range(0, len(content), 7):
        try:
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                points = read_points(save(tmp_path, name, content[:end]))
        except PointsError as exc:
            assert name in str(exc)  # noqa: PT017
        else:
            # Only formats without a count can lose points unseen; trailing faces are not ours.
            n = len(points)
            assert name.endswith(".bin") or n == len(POINTS) or end == len(content) or said
            if said:
                assert f"{name}: cut short: the first {n} of {len(POINTS)} points are there" in str(said[0].message)
                np.testing.assert_array_equal(points, POINTS[:n])


@pytest.mark.parametrize("name", ["binary.pcd", "ascii.pcd", "little.ply", "ascii.ply"])
def test_the_points_in_front_of_a_cut_are_read(tmp_path: Path, name: str) -> None:
    """The last row of a text is left out if it has no end: a cut may leave half of a number."""
    content = FILES[name].removesuffix(b"3 0 1 2\n")
    with pytest.warns(UserWarning, match=rf"{name}: cut short: the first \d of {len(POINTS)} points are there"):
        points = read_points(save(tmp_path, name, content[:-9]))
    assert 0 < len(points) < len(POINTS)
    np.testing.assert_array_equal(points, POINTS[: len(points)])


def test_str_path_and_columns(tmp_path: Path) -> None:
    path = save(tmp_path, "six.raw", np.arange(24, dtype="<f4").tobytes())
    np.testing.assert_array_equal(read_points(str(path), columns=6)[1], [6, 7, 8, 9])
    np.testing.assert_array_equal(read_points(path, columns=3)[1], [3, 4, 5, 0])
    with pytest.raises(PointsError, match=r"six\.raw.*columns= \(--columns\) x y z remission"):
        read_points(path)
    for columns in (2, 65, 4.0, True, ("x", "y"), ("x", "y", "z", "z", "a", "b"), ["x"] * 65):
        with pytest.raises(PointsError, match="3 to 64"):
            read_points(path, columns=columns)


def test_remission_is_not_scaled_and_missing_remission_is_zero(tmp_path: Path) -> None:
    raw = np.array([[1, 2, 3, 255], [4, 5, 6, 0]], np.uint16)
    np.testing.assert_array_equal(read_points(raw)[:, 3], [255, 0])
    body = POINTS[:, :3].tobytes()
    for name, content in {
        "a.pcd": pcd(*XYZ, 4, "binary", body),
        "a.ply": ply("binary_little_endian", body, of=properties(*"xyz")),
        "a.npy": npy(POINTS[:, :3]),
    }.items():
        points = read_points(save(tmp_path, name, content))
        np.testing.assert_array_equal(points[:, :3], POINTS[:, :3])
        assert (points[:, 3] == 0).all()


def test_remission_field_chooses(tmp_path: Path) -> None:
    content = pcd("x y z reflectivity intensity", "F F F F F", "4 4 4 4 4", "1 1 1 1 1", 1, "ascii", b"1 2 3 4 5\n")
    path = save(tmp_path, "ouster.pcd", content)
    assert read_points(path)[0, 3] == 5
    assert read_points(path, remission_field="reflectivity")[0, 3] == 4
    with pytest.raises(PointsError, match="'signal'"):
        read_points(path, remission_field="signal")


def test_scan_without_points_is_valid_if_its_header_says_so(tmp_path: Path) -> None:
    for name, content in {
        "a.npy": npy(POINTS[:0]),
        "a.ply": ply("binary_little_endian", b"", n=0),
        "b.ply": ply("ascii", b"", n=0),
        "a.pcd": pcd(*XYZI, 0, "binary", b""),
        "b.pcd": pcd(*XYZI, 0, "ascii", b""),
        "c.pcd": pcd(*XYZI, 0, "binary_compressed", b""),
    }.items():
        assert read_points(save(tmp_path, name, content)).shape == (0, 4)
    assert as_points(np.zeros((0, 4))).shape == (0, 4)
    assert as_points(np.zeros((0, 3), np.int8)).shape == (0, 4)


def test_unreadable_paths(tmp_path: Path) -> None:
    with pytest.raises(PointsError, match="no such file"):
        read_points(tmp_path / "absent.bin")
    with pytest.raises(PointsError, match=r"a folder; expected one scan file\. edgeperc\.read_scans"):
        read_points(tmp_path)
    with pytest.raises(PointsError):
        read_points("a\0b.bin")


BAD_FILES = {
    "cut.bin": (POINTS.tobytes()[:-3], "cut short"),
    "text.bin": (b"12.0 3.0 1.0 0.5\n" * 16, "text"),
    "double.bin": (np.random.default_rng(0).normal(0, 20, (500, 4)).tobytes(), "not coordinates"),
    "big_endian.bin": (np.random.default_rng(0).normal(0, 20, (500, 4)).astype(">f4").tobytes(), "not coordinates"),
    "four.pcd.bin": (POINTS[:3].tobytes(), "columns="),
    "objects.npy": (npy(np.array([{}, []], dtype=object)), "never unpickled"),
    "strings.npy": (npy(np.array([["1", "2", "3", "4"]])), "<U1"),
    "complex.npy": (npy(POINTS.astype(np.complex64)), "complex64"),
    "bool.npy": (npy(np.ones((3, 4), dtype=bool)), "bool"),
    "flat.npy": (npy(POINTS.ravel()), r"shape \(16,\)"),
    "wide.npy": (npy(np.zeros((9, 5))), "--columns x y z intensity ring"),
    "turned.npy": (npy(np.zeros((4, 9))), r"points\.T"),
    "huge.npy": (npy(POINTS).replace(b"(4, 4)", b"(10**9, 4)"[:6]), "header"),
    "many.npy": (npy(POINTS).replace(b"(4, 4), }    ", b"(4000000000, 4), }"[:13]), "header"),
    "two.npz": (npz(a=POINTS, b=POINTS), "none called points"),
    "scans.zip": (zipped("a.bin", POINTS.tobytes()), "an archive; unpack it first"),
    "zip.npz": (b"PK\3\4" + b"\0" * 60, "cannot be read"),
    "names.pcd": (pcd("a b c", "F F F", "4 4 4", "1 1 1", 1, "ascii", b"1 2 3\n"), "x, y, z"),
    "vector.pcd": (pcd("x y z", "F F F", "4 4 4", "2 1 1", 1, "ascii", b"1 2 3 4\n"), "no numeric field x"),
    "half.pcd": (pcd("x y z", "F F F", "2 4 4", "1 1 1", 1, "ascii", b"1 2 3\n"), "TYPE and SIZE"),
    "counts.pcd": (pcd("x y z", "F F F", "4 4", "1 1 1", 1, "ascii", b"1 2 3\n"), "equal length"),
    "zero.pcd": (pcd("x y z", "F F F", "4 4 4", "1 1 0", 1, "ascii", b"1 2 3\n"), "COUNT"),
    "text.pcd": (pcd(*XYZ, 1, "ascii", b"1 two 3\n"), "row"),
    "ragged.pcd": (pcd(*XYZ, 2, "ascii", b"1 2 3\n1 2\n"), "row"),
    "blank.pcd": (pcd(*XYZ, 2, "ascii", b"\n\n\n"), "none are there"),
    "separators.pcd": (pcd(*XYZ, 2, "ascii", b"\x1c\n\x1f\n"), "none are there"),
    "disagree.pcd": (pcd(*XYZ, 2, "ascii", b"1 2 3\n", width=3), "must agree"),
    "declared.pcd": (pcd(*XYZ, 1 << 60, "binary", b"\0" * 24), "cut short"),
    "declared_ascii.pcd": (pcd(*XYZ, 1 << 60, "ascii", b"1 2 3\n"), "cut short"),
    "beyond.pcd": (pcd(*XYZ, 1 << 80, "binary", b""), "64 bits"),
    "encoding.pcd": (pcd(*XYZ, 1, "zstd", b"\0" * 24), "zstd"),
    "header.pcd": (b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n", "DATA line"),
    "bomb.pcd": (
        pcd(*XYZ, 10**8, "binary_compressed", struct.pack("<II", 8, 12 * 10**8) + b"12345678"),
        "claim to unpack",
    ),
    "lzf.pcd": (packed_pcd(POINTS, packed=b"\xff" * 40), "damaged"),
    "lzf_short.pcd": (packed_pcd(POINTS, packed=lzf_literals(b"\0" * 32)), "damaged"),
    "lzf_size.pcd": (packed_pcd(POINTS, size=65), "need 64"),
    "no_vertex.ply": (b"ply\nformat ascii 1.0\nend_header\n", "no vertex"),
    "no_end.ply": (b"ply\nformat ascii 1.0\n", "end_header"),
    "type.ply": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n", "quad"),
    "orphan.ply": (b"ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property float x"),
    "negative.ply": (ply("ascii", b"", n=-1), "negative"),
    "declared.ply": (ply("binary_little_endian", b"\0" * 64, n=1 << 60), "cut short"),
    "format.ply": (ply("binary_middle_endian", b"\0" * 64), "middle"),
    "list.ply": (
        ply("binary_little_endian", b"\xff\xff\xff\xff" * 4, before="element f 1\nproperty list uint double a\n"),
        "past the file",
    ),
    "ascii_list.ply": (
        ply("ascii", b"1 2 3 0\n", n=1, of=properties(*"xyz") + "property list uchar int l\n"),
        "save it as binary",
    ),
    "picture.pcd": (b"\x89PNG\r\n\x1a\n" + b"\0" * 64, "this is an image"),
    "twice.npy": (npy(POINTS) + npy(POINTS), "several arrays one after another"),
    **{f"empty{suffix}": (b"", "empty") for suffix in FORMATS},
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_file_names_the_fault(tmp_path: Path, name: str) -> None:
    content, match = BAD_FILES[name]
    if not isinstance(content, bytes):
        content = content.astype("<f4").tobytes()
    with pytest.raises(PointsError, match=match) as caught:
        read_points(save(tmp_path, name, content))
    assert name in str(caught.value)


@pytest.mark.parametrize("name", ["intensity", "remission", "Reflectivity"])
@pytest.mark.parametrize(("kind", "shape"), [("f4", (4,)), ("f8", (4, 1)), ("u1", (1, 4))])
def test_the_remission_beside_the_points_of_an_archive(tmp_path: Path, name: str, kind: str, shape: Any) -> None:
    remission = np.array([3, 0, 255, 7], kind)
    content = npz(points=POINTS[:, :3], labels=np.arange(4), **{name: remission.reshape(shape)})
    expected = np.column_stack([POINTS[:, :3], remission]).astype("f4")
    np.testing.assert_array_equal(read_points(save(tmp_path, "a.npz", content)), expected)
    np.testing.assert_array_equal(read_points(save(tmp_path, "b.npz", npz(points=POINTS, **{name: remission}))), POINTS)


@pytest.mark.parametrize("n", [0, 2])
@pytest.mark.parametrize("kind", ["ascii", "binary", "faces"])
@pytest.mark.parametrize("suffix", [".pcd", ".ply"])
def test_points_that_the_header_does_not_declare_are_warned_of(tmp_path: Path, suffix: str, kind: str, n: int) -> None:
    """As a recorder leaves them that ends before it has written their number."""
    body = POINTS.tobytes() if kind == "binary" else text_rows(POINTS) + b"\n"
    if suffix == ".pcd":
        content = pcd(*XYZI, n, "binary" if kind == "binary" else "ascii", body)
    else:
        faces = f"element face {len(POINTS) - n if kind == 'faces' else 0}\nproperty list uchar int k\n"
        content = ply("binary_little_endian" if kind == "binary" else "ascii", body, n, of=properties(*"xyzi") + faces)
    path = save(tmp_path, f"a{suffix}", content)
    if (suffix, kind) == (".ply", "faces"):
        assert len(read_points(path)) == n
        return
    with pytest.warns(UserWarning, match=f"{len(POINTS) - n} points follow the {n} that the header declares"):
        np.testing.assert_array_equal(read_points(path), POINTS[:n])


RECORDINGS = (
    b"\xd4\xc3\xb2\xa1",
    b"\n\r\r\n",
    b"#ROSBAG V2.0\n\0",
    b"\x89MCAP0\r\n",
    b"SQLite format 3\0",
    bytes(8) + b"OSF",
)


@pytest.mark.parametrize("head", RECORDINGS)
def test_a_recording_is_no_scan_file(tmp_path: Path, head: bytes) -> None:
    with pytest.raises(PointsError, match=r"a recording of many scans; .*edgeperc\.read_scans reads it"):
        read_points(save(tmp_path, "drive.recorded", head + bytes(range(256))))


@pytest.mark.parametrize("name", ["a.bin", "a.txt"])
def test_columns_may_have_the_names_of_cloudcompare(tmp_path: Path, name: str) -> None:
    rows = np.column_stack([POINTS, np.arange(len(POINTS))]).astype("<f4")
    path = save(tmp_path, name, text_rows(rows) if name == "a.txt" else rows.tobytes())
    columns = ("X", "Y", "Z", "scalar_Intensity", "scalar_Ring")
    np.testing.assert_array_equal(read_points(path, columns=columns), POINTS)
    ringed = read_points(path, columns=columns, remission_field="scalar_Ring")
    np.testing.assert_array_equal(ringed[:, 3], rows[:, 4])


@pytest.mark.parametrize("n", [3, 4])
def test_an_archive_gives_the_remission_that_is_asked_for(tmp_path: Path, n: int) -> None:
    beside = {name: np.arange(4.0) + k for k, name in enumerate(("intensity", "Reflectivity", "signal"))}
    path = save(tmp_path, "a.npz", npz(points=POINTS[:, :n], **beside))
    for name, values in beside.items():
        expected = np.column_stack([POINTS[:, :3], values])
        np.testing.assert_array_equal(read_points(path, remission_field=name), expected)
    with pytest.raises(PointsError, match=r"no (numeric )?field 'ring' for the remission"):
        read_points(path, remission_field="ring")


@pytest.mark.parametrize("beside", [np.arange(5.0), np.zeros((4, 2)), np.array(["a"] * 4), np.zeros(4, complex)])
def test_what_is_no_remission_of_the_points_is_refused(tmp_path: Path, beside: Any) -> None:
    path = save(tmp_path, "a.npz", npz(points=POINTS[:, :3], intensity=beside))
    with pytest.raises(PointsError, match=r"'intensity\.npy' in the archive is not one number for each of the points"):
        read_points(path)


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    bomb = zipped("points.npy", npy(np.zeros((5_000_000, 4), np.float32)))
    with pytest.raises(PointsError, match="not unpacked"):
        read_points(save(tmp_path, "bomb.npz", bomb))


def test_pickles_do_not_run(tmp_path: Path) -> None:
    class Bad:
        def __reduce__(self) -> tuple[Any, ...]:
            return (pytest.fail, ("a pickle was loaded",))

    with pytest.raises(PointsError, match="never unpickled"):
        read_points(save(tmp_path, "bad.npy", npy(np.array([Bad()], dtype=object))))


def test_points_pass_uncopied() -> None:
    assert as_points(POINTS) is POINTS
    assert read_points(POINTS) is POINTS


@pytest.mark.parametrize(
    "array",
    [
        POINTS.astype(np.float64),
        POINTS.astype(">f8"),
        np.asfortranarray(POINTS),
        np.repeat(POINTS, 2, axis=0)[::2],
        np.hstack([POINTS, POINTS])[:, :4],
        POINTS[::-1].copy()[::-1],
        np.frombuffer(b"\0" + POINTS.tobytes(), np.uint8)[1:].view(np.float32).reshape(4, 4),
        POINTS.tolist(),
    ],
)
def test_any_layout_and_dtype(array: np.ndarray) -> None:
    if isinstance(array, np.ndarray):
        array.flags.writeable = False
    points = as_points(array)
    assert points.dtype == np.float32
    assert points.dtype.isnative
    assert points.flags.c_contiguous
    assert points.flags.aligned
    np.testing.assert_array_equal(points, POINTS)


def test_structured_arrays_with_padding_and_rows_of_an_organized_cloud() -> None:
    layout = np.dtype(
        {
            "names": ["x", "y", "z", "intensity", "ring", "rgb"],
            "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", ("u1", 3)],
            "offsets": [0, 4, 8, 16, 20, 22],
            "itemsize": 32,
        }
    )
    cloud = np.zeros((2, 2), layout)
    for k, name in enumerate(("x", "y", "z", "intensity")):
        cloud[name] = POINTS[:, k].reshape(2, 2)
    np.testing.assert_array_equal(as_points(cloud), POINTS)
    np.testing.assert_array_equal(as_points(cloud[["x", "y", "z"]])[:, :3], POINTS[:, :3])
    with pytest.raises(PointsError, match=r"field z among x, y"):
        as_points(cloud[["x", "y"]])
    with pytest.raises(PointsError, match="no numeric field"):
        as_points(np.zeros(3, [("x", "O"), ("y", "f4"), ("z", "f4")]))


@pytest.mark.parametrize(
    "array",
    [
        None,
        "scan",
        [],
        [[1, 2], [3]],
        np.zeros(4),
        np.zeros((2, 2)),
        np.zeros((1, 3, 4)),
        np.zeros((3, 4), complex),
        np.zeros((3, 4), "U3"),
        np.zeros((3, 4), object),
        np.zeros((3, 4), "datetime64[s]"),
        np.ma.zeros((3, 4)),
        object(),
    ],
)
def test_arrays_that_are_not_scans_are_refused(array: Any) -> None:
    with pytest.raises(PointsError):
        as_points(array)


def test_ten_million_points(tmp_path: Path) -> None:
    many = np.zeros((10_000_000, 4), np.float32)
    many[:, 0] = np.arange(len(many)) % 100 + 1
    path = tmp_path / "many.bin"
    many.tofile(path)
    points = read_points(path)
    assert points.shape == many.shape
    assert points[-1, 0] == many[-1, 0]


PREFIXES = [
    b"",
    b"\x93NUMPY\1\0v\0{'descr': '<f4', 'fortran_order': False, 'shape': (",
    b"PK\3\4",
    b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z i\nSIZE 4 4 4 4\nTYPE F F F F\n",
    b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA ascii\n",
    b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 3\nHEIGHT 1\nPOINTS 3\nDATA binary_compressed\n",
    b"ply\n",
    b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
    b"ply\nformat binary_big_endian 1.0\nelement f 2\nproperty list char short l\nelement vertex 2\n"
    b"property float x\nproperty float y\nproperty float z\nend_header\n",
]


def check_points_or_error(path: Path) -> None:
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "(?s).*(cut short: the first|points follow the)", UserWarning)
            points = read_points(path)
    except PointsError:
        return
    assert points.dtype == np.float32
    assert points.ndim == 2
    assert points.shape[1] == 4
    assert points.flags.c_contiguous


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(FORMATS), st.sampled_from(PREFIXES), st.binary(max_size=300))
@example(".npy", b"\x93NUMPY\1\0", b"\x10\0" + b"(" * 16)
def test_any_bytes_give_points_or_points_error(tmp_path: Path, suffix: str, prefix: bytes, tail: bytes) -> None:
    check_points_or_error(save(tmp_path, f"scan{suffix}", prefix + tail))


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.sampled_from(sorted(FILES)), st.data())
def test_damaged_files_give_points_or_points_error(tmp_path: Path, name: str, data: st.DataObject) -> None:
    content = bytearray(FILES[name])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at : at + data.draw(st.integers(0, 8))] = data.draw(st.binary(max_size=8))
    check_points_or_error(save(tmp_path, name, bytes(content)))


def is_rounded(array: np.ndarray) -> bool:
    """Whether float32 changes a coordinate that is as large as those of maps."""
    exact = array[:, :3].astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(((np.abs(exact) > 8e4) & (np.abs(exact) < 1e8) & (exact != exact.astype(np.float32))).any())


@example(np.full((1, 3), 83887))  # float32 holds it
@example(np.full((2, 3), 2**24 + 1))
@example(np.full((2, 4), 5e5 + 0.1))
@example(np.full((2, 3), 1e300))  # becomes infinite
@example(np.full((2, 4), 1e300))
@given(
    hnp.arrays(
        st.one_of(hnp.floating_dtypes(), hnp.integer_dtypes(), hnp.complex_number_dtypes(), hnp.boolean_dtypes()),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5),
    )
)
def test_any_array_gives_points_or_points_error(array: np.ndarray) -> None:
    try:
        points = as_points(array)
    except PointsError:
        assert array.ndim != 2 or array.shape[1] not in (3, 4) or array.dtype.kind in "cb" or is_rounded(array)
    else:
        assert points.shape == (len(array), 4)
        with np.errstate(over="ignore"):
            np.testing.assert_array_equal(points[:, :3], array[:, :3].astype(np.float32))


@settings(max_examples=300)
@given(st.binary(max_size=60), st.integers(0, 200))
@example(b"\0a\xe0\xff\0", 300)
@example(b"\0a\x20\0", 4)
def test_lzf_agrees_with_the_twin(packed: bytes, size: int) -> None:
    unpacked = np.zeros(size, np.uint8)
    written = fill_unpacked_lzf(np.frombuffer(packed, np.uint8), unpacked)
    expected = twins.points.unpack_lzf(packed, size)
    if expected is None:
        assert written == -1
    else:
        assert unpacked[:written].tobytes() == expected


# --- raw files of other columns --------------------------------------------------------------------------------------


def street(seed: int, n: int = 6000) -> np.ndarray:
    """Points along the rings of a sensor: ground, and walls beside it."""
    rng = np.random.default_rng(seed)
    azimuth = np.tile(np.linspace(-np.pi, np.pi, n // 20, endpoint=False), 20)
    elevation = np.repeat(np.radians(np.linspace(-25.0, 3.0, 20)), n // 20)
    reach = np.minimum(8.0 / np.maximum(np.abs(np.sin(azimuth)), 0.1), 1.7 / np.maximum(-np.sin(elevation), 0.02))
    reach += rng.normal(0.0, 0.02, len(reach))
    across = reach * np.cos(elevation)
    xyz = [across * np.cos(azimuth), across * np.sin(azimuth), reach * np.sin(elevation)]
    return np.column_stack([*xyz, rng.uniform(0.0, 0.6, len(reach))]).astype("<f4")


OTHERS = {
    "time": lambda n, rng: np.linspace(0.0, 0.1, n),
    "ring": lambda n, rng: np.repeat(np.arange(20), n // 20)[:n],
    "unknown": lambda n, rng: np.full(n, -1.0),
    "elongation": lambda n, rng: rng.uniform(0.0, 1.0, n),
    "noise": lambda n, rng: rng.normal(size=n),
    "large": lambda n, rng: rng.integers(0, 2**24, n),
}


def raw_rows(seed: int, others: Sequence[str], remission: float | None, order: str) -> np.ndarray:
    """Points in an order, with other values behind them; without a remission if there are none."""
    rng, points = np.random.default_rng(seed), street(seed)
    points[:, 3] *= remission or 0.0
    points = points[:, : 4 if others or remission is not None else 3]
    if order == "shuffled":
        points = rng.permutation(points)
    if order == "fired":  # as a Velodyne's lasers: up and down in turn
        lasers = np.arange(20).reshape(2, 10).T.ravel()
        points = points.reshape(20, 300, -1)[lasers].swapaxes(0, 1).reshape(6000, -1)
    return np.column_stack([points, *(OTHERS[name](len(points), rng) for name in others)]).astype("<f4")


@given(
    seed=st.integers(0, 9),
    others=st.lists(st.sampled_from([*OTHERS]), max_size=5),
    remission=st.sampled_from([None, 0.0, 1.0, 255.0]),
    order=st.sampled_from(["rings", "shuffled", "fired"]),
)
@settings(max_examples=60)
def test_raw_files_show_how_many_values_a_point_has(seed: int, others: Any, remission: Any, order: str) -> None:
    rows = raw_rows(seed, others, remission, order)
    points = rows[:, :4]
    with tempfile.TemporaryDirectory() as folder:
        for name in ("scan.bin", "scan.pcd.bin"):
            path = save(Path(folder), name, rows.tobytes())
            for columns in (None, rows.shape[1]):
                np.testing.assert_array_equal(read_points(path, columns=columns)[:, : points.shape[1]], points)


@pytest.mark.parametrize("n", [1, 3, 40, 249])
def test_few_points_have_the_usual_columns(tmp_path: Path, n: int) -> None:
    points = street(1)[:: 6000 // n][:n]
    np.testing.assert_array_equal(read_points(save(tmp_path, "scan.bin", points.tobytes())), points)


def test_columns_have_names(tmp_path: Path) -> None:
    rows = np.arange(30, dtype="<f4").reshape(5, 6)
    path = save(tmp_path, "scan.bin", rows.tobytes())
    names = ("ring", "X", "intensity", "z", "y", "time")
    np.testing.assert_array_equal(read_points(path, columns=names), rows[:, [1, 4, 3, 2]])
    np.testing.assert_array_equal(read_points(path, columns=names, remission_field="ring"), rows[:, [1, 4, 3, 0]])
    ((_, points),) = edgeperc.read_scans(path, columns=names, remission_field="time")
    np.testing.assert_array_equal(points, rows[:, [1, 4, 3, 5]])
    with pytest.raises(PointsError, match="'signal'"):
        read_points(path, columns=names, remission_field="signal")
    with pytest.raises(PointsError, match="no numeric field y, z"):
        read_points(path, columns=("x", "a", "b", "c", "d", "e"))
    with pytest.raises(PointsError, match="whole number of points of 4 float32"):
        read_points(path, columns=("x", "y", "z", "i"))


def test_named_columns_have_times(tmp_path: Path) -> None:
    points = street(2)
    rows = np.column_stack([points, np.linspace(0.0, 0.1, len(points))]).astype("<f4")
    path = save(tmp_path, "scan.bin", rows.tobytes())
    (scan,) = edgeperc.read_timed_scans(path, columns=("x", "y", "z", "intensity", "time"))
    np.testing.assert_allclose(scan.times_s, rows[:, 4])
    np.testing.assert_array_equal(scan.points, points)
    (scan,) = edgeperc.read_timed_scans(path)
    assert scan.times_s is None
    np.testing.assert_array_equal(scan.points, points)


@pytest.mark.parametrize("kind", ["<f2", "<f4", ">f8", "<i4"])
@pytest.mark.parametrize("width", [3, 4, 5, 6, 12])
@pytest.mark.parametrize("name", ["a.npy", "a.npz"])
def test_stored_arrays_take_columns(tmp_path: Path, name: str, width: int, kind: str) -> None:
    """As a raw file of the same values; only if there are more than four need they be said."""
    rows = np.round(np.column_stack([street(3, 600)] * 3)[:, :width] * 8.0).astype(kind)
    path, raw = tmp_path / name, save(tmp_path, "raw.bin", rows.astype("<f4").tobytes())
    (np.save if name.endswith("npy") else np.savez)(path, np.asfortranarray(rows))
    names = ("z", "Ring", "x", "y", "time", "intensity", "a", "b", "c", "d", "e", "f")[:width]
    for columns in (width, *[names] * (width > 3)):
        np.testing.assert_array_equal(read_points(path, columns=columns), read_points(raw, columns=columns))
    if width > 3:
        np.testing.assert_array_equal(read_points(path, columns=names, remission_field="ring")[:, 3], rows[:, 1])
    if width > 4:
        with pytest.raises(PointsError, match=rf"shape \(600, {width}\).*--columns x y z intensity ring"):
            read_points(path)
    with pytest.raises(PointsError, match=rf"shape \(600, {width}\), and columns= \(--columns\) names 13 values"):
        read_points(path, columns=13)


def test_columns_of_a_stored_array_have_times_and_places(tmp_path: Path) -> None:
    points, path = street(2), tmp_path / "a.npy"
    times_s, origin = np.linspace(0.0, 0.1, len(points)), np.array(MAPS["UTM"])
    np.save(path, np.column_stack([times_s, points[:, :3].astype("f8") + origin, points[:, 3]]))
    names = ("time", "x", "y", "z", "intensity")
    (scan,) = edgeperc.read_timed_scans(path, columns=names, origin_m=MAPS["UTM"])
    np.testing.assert_array_equal(scan.times_s, times_s)
    np.testing.assert_allclose(scan.points, points, atol=1e-6)
    with pytest.raises(PointsError, match="are those of a map"):
        read_points(path, columns=names)


@given(
    seed=st.integers(0, 9),
    others=st.lists(st.sampled_from(["time", "ring", "unknown", "elongation"]), max_size=3),
    remission=st.sampled_from([0.0, 1.0, 255.0]),
    order=st.sampled_from(["rings", "shuffled", "fired"]),
)
@settings(max_examples=60)
def test_raw_float16_is_refused_and_stored_float16_is_exact(
    seed: int, others: list[str], remission: float, order: str
) -> None:
    rows = raw_rows(seed, others, remission, order).astype("<f2")
    with tempfile.TemporaryDirectory() as folder:
        path = save(Path(folder), "scan.bin", rows.tobytes())
        for columns in (None, 4, 3):
            with pytest.raises(PointsError, match=r"are float16; expected float32|whole number|are not coordinates"):
                read_points(path, columns=columns)
        np.save(Path(folder) / "scan.npy", rows)
        found = read_points(Path(folder) / "scan.npy", columns=rows.shape[1])
        np.testing.assert_array_equal(found, rows[:, :4].astype("<f4"))
        exact = save(Path(folder), "exact.bin", rows.astype("<f4").tobytes())  # what is advised
        np.testing.assert_array_equal(read_points(exact, columns=rows.shape[1]), found)


# --- coordinates of a map --------------------------------------------------------------------------------------------

MAPS = {
    "UTM": (512_345.25, 5_412_345.5, 113.0),
    "Gauss-Krüger": (3_500_000.5, 5_800_000.0, 40.0),
    "south": (-9e4, 0, 0),
}


def in_map(folder: Path, kind: str, points: np.ndarray, origin: Any) -> Any:
    """A scan with coordinates of a map: an array, or a file."""
    placed = np.column_stack([points[:, :3].astype("f8") + np.array(origin), points[:, 3]])
    named = np.rec.fromarrays(placed.T, names="x,y,z,intensity")
    if kind in ("array", "named"):
        return placed if kind == "array" else named
    write = {"pcd": pcd_of, "ply": ply_of, "npy": lambda _: npy(placed)}[kind]
    return save(folder, f"a.{kind}", write(named))


@pytest.mark.parametrize("place", MAPS)
@pytest.mark.parametrize("kind", ["pcd", "ply", "array", "named", "npy"])
def test_coordinates_of_a_map_are_not_rounded(tmp_path: Path, kind: str, place: Any) -> None:
    """A scan whose coordinates float32 would round is refused, and exact if the place of the sensor is subtracted."""
    points, origin = street(4), np.array(MAPS[place])
    source = in_map(tmp_path, kind, points, origin)
    with pytest.raises(PointsError, match=r"of a map, about \(.* edgeperc\.read_points .*--origin X Y Z"):
        read_points(source)
    read = read_points(source, origin_m=origin)
    np.testing.assert_allclose(read, points, atol=1e-5)
    if isinstance(source, Path):
        ((_, read),) = edgeperc.read_scans(source, origin_m=origin.tolist())
        np.testing.assert_allclose(read, points, atol=1e-5)


@pytest.mark.parametrize("origin", [(0, 0), ("a", 0, 0), (0, np.nan, 0), 5.0])
def test_an_origin_is_three_numbers(origin: Any) -> None:
    with pytest.raises(OptionError, match="origin_m is"):
        read_points(POINTS, origin_m=origin)


@pytest.mark.parametrize("kind", ["pcd", "npy", "array", "named"])
def test_the_origin_of_a_level_sensor_is_found(tmp_path: Path, kind: str) -> None:
    points, origin = simulated_scan(3, "os1-64").points, MAPS["UTM"]
    source = in_map(tmp_path, kind, points, origin)
    read = read_points(source, origin_m="auto")
    np.testing.assert_allclose(read, points, atol=0.05)
    found = edgeperc.find_origin(source)
    np.testing.assert_allclose(found, origin, atol=0.05)
    np.testing.assert_array_equal(read, read_points(source, origin_m=found))
    if kind == "named":  # as a data frame, whose columns have another order
        table = pytest.importorskip("pandas").DataFrame(source)[["z", "intensity", "y", "x"]]
        np.testing.assert_array_equal(read_points(table, origin_m="auto"), read)
        assert edgeperc.find_origin(table) == found


@pytest.mark.parametrize(
    "source", [POINTS, np.zeros((5, 2)), np.zeros(3), np.zeros((9, 4)), [[1.0], [2.0, 3.0]], np.ma.masked_all((9, 4))]
)
def test_an_origin_that_cannot_be_found_is_an_error(source: Any) -> None:
    for read in (edgeperc.find_origin, lambda given: read_points(given, origin_m="auto")):
        with pytest.raises(PointsError):
            read(source)
    with pytest.raises(OptionError, match="origin_m is 'atuo'"):
        read_points(POINTS, origin_m="atuo")  # type: ignore[arg-type]


def test_an_origin_may_be_subtracted_from_float32() -> None:
    moved = read_points(POINTS, origin_m=(1.0, -2.0, 0.5))
    np.testing.assert_allclose(moved, POINTS - np.float32([1.0, -2.0, 0.5, 0.0]))


# --- text, and formats that are not read -----------------------------------------------------------------------------


@given(
    separator=st.sampled_from([" ", ",", ";", "\t", ", ", "  "]),
    names=st.permutations(["x", "Y", "z", "Intensity", "ring", "time"]),
    end=st.sampled_from(["\n", "\r\n"]),
    comment=st.sampled_from(["", "# made by a tool\n", "// made by a tool\n", "\ufeff"]),
    mark=st.sampled_from(["", "#", "//", "# "]),
)
@settings(max_examples=60)
def test_tables_of_text_with_names(separator: Any, names: Any, end: Any, comment: Any, mark: Any) -> None:
    values = np.round(np.random.default_rng(1).normal(0.0, 20.0, (7, 6)), 3)
    rows = [mark + separator.join(names), *(separator.join(str(v) for v in row) for row in values)]
    places = [[name.lower() for name in names].index(name) for name in ("x", "y", "z", "intensity")]
    with tempfile.TemporaryDirectory() as folder:
        path = save(Path(folder), "scan.csv", (comment + end.join(rows) + end).encode())
        np.testing.assert_array_equal(read_points(path), values[:, places].astype("f4"))
        ((_, points),) = edgeperc.read_scans(path, remission_field="ring")
        np.testing.assert_array_equal(points[:, 3], values[:, [*names].index("ring")].astype("f4"))


@pytest.mark.parametrize(
    ("name", "head", "n"),
    [("a.xyz", "", 3), ("b.xyz", "", 4), ("a.txt", "", 4), ("a.pts", "5\n", 3), ("b.pts", "5\n", 4)],
)
def test_tables_of_text_without_names(tmp_path: Path, name: str, head: Any, n: int) -> None:
    values = np.arange(5.0 * n).reshape(5, n) * 1.25
    path = save(tmp_path, name, (head + "\n".join(" ".join(map(str, row)) for row in values)).encode())
    points = read_points(path)
    np.testing.assert_array_equal(points[:, :n], values)
    assert points.shape == (5, 4)
    named = read_points(path, columns=("z", "y", "x", "i")[:n])
    np.testing.assert_array_equal(named[:, :3], values[:, [2, 1, 0]])


@pytest.mark.parametrize("n", [6, 7])
def test_pts_with_colors(tmp_path: Path, n: int) -> None:
    values = np.arange(5.0 * n).reshape(5, n)
    points = read_points(save(tmp_path, "a.pts", b"5\n" + text_rows(values)))
    np.testing.assert_array_equal(points, np.c_[values[:, :3], values[:, 3] if n == 7 else np.zeros(5)])


TABLES = {
    "Livox Viewer": (
        "Version,Slot ID,LiDAR Index,Rsvd,Timestamp,X,Y,Z,Reflectivity,Tag",
        "5,1,1,0,17,{x},{y},{z},{i},0",
    ),
    "VeloView": (
        '"Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2","X","intensity","azimuth"',
        "{x},{y},{z},7,{i},900",
    ),
    "ParaView": ('"intensity","laser_id","Points:0","Points:1","Points:2"', "{i},3,{x},{y},{z}"),
    "units": ("x(m),y(m),z(m),Intensity (%),azimuth(\u00b0)", "{x},{y},{z},{i},9"),
    "units of two words": ("X [m];Y [ m ];Z [meters];Intensity", "{x};{y};{z};{i}"),
    "index": (",x,y,z,intensity", "12,{x},{y},{z},{i}"),
    "a name of two words": ("//X,Y,Z,Scalar field,Intensity", "{x},{y},{z},0,{i}"),
    "classes": ("x,y,z,intensity,class", "{x},{y},{z},{i},car"),
    "dates": ("time,x,y,z,intensity", "2025-05-01T10:00:00.1,{x},{y},{z},{i}"),
    "a remission in words": ("x,y,z,intensity,reflectivity", "{x},{y},{z},{i},high"),
    "empty": ("x,y,z,label,intensity", "{x},{y},{z},,{i}"),
    "a separator behind": ("x,y,z,intensity,", "{x},{y},{z},{i},"),
    "the same, without one above": ("x,y,z,intensity", "{x},{y},{z},{i},"),
    "quotes": ('"x","y","z","intensity"', '"{x}","{y}","{z}","{i}"'),
    "twice the same name": ("x,y,z,intensity,x", "{x},{y},{z},{i},0"),
}


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "latin-1"])
def test_tables_as_other_programs_write_them(tmp_path: Path, name: str, encoding: Any) -> None:
    head, row = TABLES[name]
    values = np.random.default_rng(3).normal(0.0, 20.0, (9, 4)).round(3)
    rows = [row.format(**dict(zip("xyzi", each, strict=True))) for each in values.tolist()]
    path = save(tmp_path, "scan.csv", "\n".join([head, *rows[:4], "# more", *rows[4:], ""]).encode(encoding))
    np.testing.assert_array_equal(read_points(path), values.astype("f4"))


@given(
    separator=st.sampled_from([";", " ", "; ", "  ", "\t"]),
    head=st.sampled_from(["", "x;y;z;intensity\n", "5\n", "x y z i\n"]),
    n=st.sampled_from([3, 4]),
    decimals=st.integers(1, 4),
)
@settings(max_examples=40)
def test_a_comma_in_place_of_the_point(separator: Any, head: Any, n: int, decimals: int) -> None:
    """As spreadsheets write numbers in German, French and others; three columns of them were read as six."""
    values = np.random.default_rng(n).normal(0.0, 20.0, (5, n)).round(decimals)
    rows = [separator.join(f"{value:.{decimals}f}".replace(".", ",") for value in row) for row in values]
    head = "" if n == 3 and "i" in head else head
    with tempfile.TemporaryDirectory() as folder:
        points = read_points(save(Path(folder), "scan.pts", (head + "\n".join(rows)).encode()))
    np.testing.assert_array_equal(points[:, :n], values.astype("f4"))


@pytest.mark.parametrize("separator", [";", " "])
def test_whole_numbers_above_those_with_commas(tmp_path: Path, separator: str) -> None:
    """As a first point without a return is: 0;0;0;0."""
    rows = [separator.join(row) for row in (("0", "0", "0", "0"), ("1,5", "-2", "3,25", "0,5"))]
    points = read_points(save(tmp_path, "scan.csv", "\n".join(rows).encode()))
    np.testing.assert_array_equal(points, [[0, 0, 0, 0], [1.5, -2, 3.25, 0.5]])


@pytest.mark.parametrize("columns", [("x", "y", "z", "intensity", "ring"), 4])
@pytest.mark.parametrize("kind", ["csv", "npy", "ply", "pcd"])
def test_names_in_a_file_are_taken_before_those_of_columns(tmp_path: Path, kind: str, columns: Any) -> None:
    named = np.array([(1, 2, 3, 7, 0.5)], [(name, "<f4") for name in ("x", "y", "z", "ring", "intensity")])
    csv = b"x,y,z,ring,intensity\n1,2,3,7,0.5\n"
    content = {"csv": csv, "npy": npy(named), "ply": ply_of(named), "pcd": pcd_of(named)}[kind]
    path = save(tmp_path, f"scan.{kind}", content)
    np.testing.assert_array_equal(read_points(path), [[1, 2, 3, 0.5]])
    said = r"columns= \(--columns\) is not used: the file names its values, x, y, z, ring, intensity"
    with pytest.warns(UserWarning, match=said):
        np.testing.assert_array_equal(read_points(path, columns=columns), [[1, 2, 3, 0.5]])
    if kind == "csv":
        path.write_bytes(csv.replace(b",intensity", b""))  # not a name for each
        found = read_points(path, columns=("x", "y", "z", "ring", "intensity"))
        np.testing.assert_array_equal(found, [[1, 2, 3, 0.5]])


@pytest.mark.parametrize("gap", ["", " ", "null", "NaN", "N/A", "-", "none"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_what_a_table_lacks_is_nan(tmp_path: Path, gap: str, separator: str) -> None:
    rows = [
        ["x", "y", "z", "i"],
        ["1", "2", "-3", "4"],
        [gap, gap, gap, "7"],
        ["5", "-6", "7", gap],
        ["1", "1", "1", "-1"],
    ]
    points = read_points(save(tmp_path, "scan.csv", "\n".join(separator.join(row) for row in rows).encode()))
    expected = [[1, 2, -3, 4], [np.nan, np.nan, np.nan, 7], [5, -6, 7, np.nan], [1, 1, 1, -1]]
    np.testing.assert_array_equal(points, np.array(expected, "f4"))


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b"x(mm),y(mm),z(mm),i\n1,2,3,4\n", "coordinates are in 'mm' by the name 'x\\(mm\\)'; expected meters"),
        (b"X (cm);Y (cm);Z (cm);I\n1;2;3;4\n", "coordinates are in 'cm' by the name 'X \\(cm\\)'"),
        (b"x [ft];y [ft];z [ft]\n1;2;3\n", "the coordinates are in 'ft' by the name 'x .ft.'"),
        (b"x,y,z,i\n1,2,3,4\n1,2,3\n", "row 2 of 2 has 3, '1,2,3'; the file may be cut short"),
        (b"x,y,z,i\n1,2,3,4\n1,2\n1,2,3,4\n", "row 2 of 3 has 2, '1,2'$"),
        (b"x,y,z,i\n1,far,3,4\n1,2,3,4\n", "no numeric field y among x, y, z, i"),
        (b"x,y,z,i\n1,2,3,4\n1,far,3,4\n", "does not hold 4 numbers"),
        (b"x,y,z,i\n1,2,3,-nan(ind)\n1,2,3,4\n", "first row has '-nan\\(ind\\)' in the column i, and others"),
        (b"x y z Time\n1 2 3 ?\n1 2 3 0.5\n", "first row has '[?]' in the column time, and others"),
        (b"1 2 3 4 5 6\n" * 9, "a row has 6 numbers, and there are no names: pass columns="),
        (b"x y z i\n1 2 3 4 5\n", "a row has 5 numbers, and there are 4 names"),
        (b"1 2 3 4\n1 2 3\n", "does not hold 4 numbers"),
        (b"1 2 3 4\nfar 2 3 1\n", "does not hold 4 numbers"),
        (b"Dear reader,\nno points here\n", "no table of points: it has a line 'Dear reader,'"),
        (b"# x y z\n", "no row of three numbers"),
        (b"300\n200\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n", "this is a PTX file"),
        (b"3\n1 2 3 4\n4 5 6 7\n", "cut short: the first line declares 3 points, 2 rows follow"),
        (b"1\n1 2 3\n4 5 6\n", "the first line declares 1 points, 2 rows follow"),
        (b"9" * 5000 + b"\n1 2 3\n4 5 6\n", "no table of points"),
    ],
)
def test_text_that_is_no_table_or_of_other_units_is_refused(tmp_path: Path, content: bytes, error: str) -> None:
    with pytest.raises(PointsError, match=error):
        read_points(save(tmp_path, "scan.csv", content))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
@pytest.mark.parametrize("name", ["a.bin", "a.pcd", "a.pcap"])
def test_a_pipe_is_not_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(PointsError, match="a pipe or a device, not a file"):
        next(edgeperc.read_scans(tmp_path / name))


SIGNALLING = np.frombuffer(b"\1\0\x80\x7f", "<f4")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "a.npy", "a.bin"])
def test_signalling_nan_is_nan(tmp_path: Path, name: str) -> None:
    points = POINTS.copy()
    points[1, :1] = SIGNALLING
    content = {
        "a.pcd": pcd(*XYZI, 4, "binary", points.tobytes()),
        "a.ply": ply("binary_little_endian", points.tobytes()), "a.npy": npy(points), "a.bin": points.tobytes(),
    }[name]  # fmt: skip
    for origin in (None, (1.0, 0.0, 0.0)):
        read = read_points(save(tmp_path, name, content), origin_m=origin)
        assert np.isnan(read[:, 0]).tolist() == [False, True, True, False]


@pytest.mark.parametrize(
    ("content", "error"),
    [
        (b"LASF" + bytes(400), "a LAS or LAZ file; convert it"),
        (b"ARROW1\0\0" + bytes(400), "a Feather .* pandas"),
        (b"PAR1" + bytes(99), "a Parquet table"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n", "Run: git lfs pull"),
        (b"\0\0\0\x20ftypisom" + bytes(400), "a film"),
        (b"II*\0" + bytes(40), "a TIFF or GIF image"),
        (b"GIF89a" + bytes(40), "a TIFF or GIF image"),
        (b"\x89PNG\r\n" + bytes(40), "an image; pass it with a camera model"),
        (b"\x1f\x8b\x08" + bytes(40), "an archive; unpack it"),
        (bytes(257) + b"ustar" + bytes(99), "an archive; unpack it"),
        (b"ASTM-E57" + bytes(40), "an E57 file"),
        ("x,y,z\n1,2,3\n".encode("utf-16"), "text in UTF-16"),
        (b"\x80\x04\x95" + bytes(40), "a pickle, which is never unpickled"),
        (b"<!DOCTYPE html><html>not found</html>", "a download may have failed"),
        (b'{"points": []}', "JSON"),
        (b"\x01\x02\x03\x04\x05\x06\x07\x08", r"by its first bytes, b'\\x01\\x02"),
    ],
)
@pytest.mark.parametrize("suffix", ["", ".pcd", ".bin"])
def test_other_formats_are_named(tmp_path: Path, content: bytes, error: str, suffix: str) -> None:
    if suffix == ".bin" and min(content) < 9:
        return  # may be float32 values
    with pytest.raises(PointsError, match=rf"scan{suffix}: .*{error}"):
        read_points(save(tmp_path, f"scan{suffix}", content))


@pytest.mark.parametrize("first", [b"{\0\x90A", b"[ab@", b"RIFF", b"BZh@", b"\xff\xd8\xff@"])
def test_raw_values_may_begin_like_another_format(tmp_path: Path, first: Any) -> None:
    content = first + street(1).tobytes()[4:]
    assert len(read_points(save(tmp_path, "scan.bin", content))) == 6000
    assert len(read_points(save(tmp_path, "scan.raw", content), columns=4)) == 6000


@pytest.mark.parametrize(
    ("name", "n"), [("a.bin", 3), ("a.bin", 4), ("a.pcd.bin", 5), ("a.npy", 3), ("a.npy", 4), ("a.npz", 3)]
)
@pytest.mark.parametrize("wanted", ["ring", "time", "intensity"])
def test_values_without_names_have_no_field_of_another_name(tmp_path: Path, name: str, n: int, wanted: str) -> None:
    rows = np.random.default_rng(1).normal(0.0, [20.0, 10.0, 1.0, 0.1, 9.0], (2000, 5)).astype(np.float32)[:, :n]
    write = {"a.npy": npy, "a.npz": lambda array: npz(points=array)}.get(name, np.ndarray.tobytes)
    path = save(tmp_path, name, write(rows))
    if wanted == "intensity" and n > 3:
        np.testing.assert_array_equal(read_points(path, remission_field=wanted, columns=n), rows[:, :4])
        return
    three = " and are three a point" if n == 3 else ""
    with pytest.raises(PointsError, match=f"no field '{wanted}' for the remission: the values have no names{three}. "):
        read_points(path, remission_field=wanted, columns=n)
