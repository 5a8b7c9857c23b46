"""What people have in place of an array is named, with the call that makes points of it."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import edgeperc
from edgeperc import PointsError, read_points, read_scans
from edgeperc.readers.clouds import cloud_points
from edgeperc.types.points import as_points

POINTS = np.random.default_rng(0).random((50, 4)).astype(np.float32)


class OfOpen3D:
    """A legacy cloud."""

    points = POINTS[:, :3].astype(np.float64)


class Tensors:
    """A cloud of tensors."""

    point = SimpleNamespace(positions=SimpleNamespace(numpy=lambda: POINTS[:, :3]))


OfOpen3D.__module__ = "open3d.cpu.pybind.geometry"
Tensors.__module__ = "open3d.cpu.pybind.t.geometry"


def a_message() -> Any:
    fields = [SimpleNamespace(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate(("x", "y", "z", "i"))]
    return SimpleNamespace(
        height=1, width=50, fields=fields, is_bigendian=False, point_step=16, row_step=800, data=POINTS.tobytes()
    )


@pytest.fixture
def file(tmp_path: Path) -> Path:
    POINTS.tofile(tmp_path / "scan.bin")
    return tmp_path / "scan.bin"


THINGS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "text": (str, r"scan\.bin'; .*edgeperc\.read_points\(path\)"),
    "path": (Path, r"scan\.bin'; .*edgeperc\.read_scans\(path\)"),
    "paths": (lambda path: [path, path], "got paths; .*one scan a call"),
    "texts": (lambda path: (str(path),), "got paths; .*one scan a call"),
    "bytes": (lambda path: path.read_bytes(), r"got 800 bytes; .*np\.frombuffer"),
    "message": (
        lambda path: a_message(),
        r"a PointCloud2 message .*edgeperc\.readers\.clouds\.cloud_points\(message\)",
    ),
    "open3d": (lambda path: OfOpen3D(), r"Open3D \(open3d.*np\.asarray\(cloud\.points\)"),
    "open3d tensors": (lambda path: Tensors(), r"Open3D .*cloud\.point\.positions\.numpy\(\)"),
    "stamped": (lambda path: next(iter(read_scans(path))), "with its stamp; .*for stamp_s, points in read_scans"),
    "stamped with times": (lambda path: (1.0, POINTS, None), "with its stamp; .*its points alone"),
    "upload": (lambda path: io.BytesIO(path.read_bytes()), r"an open file \(_io.*read_points\(path\).*np\.frombuffer"),
    "scans": (read_scans, "got an iterator .*one scan a call"),
    "dict": (lambda path: {"points": POINTS}, r"a mapping of points \(builtins\.dict\)"),
    "dict of columns": (
        lambda path: dict(zip("xyz", POINTS.T, strict=False)),
        "a mapping of x, y, z .*np.column_stack",
    ),
    "mapping": (lambda path: MappingProxyType({"xyz": POINTS}), "a mapping of xyz .*the array of points in it"),
    "columns": (lambda path: SimpleNamespace(x=POINTS[:, 0], y=POINTS[:, 1], z=POINTS[:, 2]), r"np\.column_stack"),
}


@pytest.mark.parametrize("thing", THINGS)
def test_what_is_no_array_names_the_call_that_converts_it(thing: str, file: Path) -> None:
    make, text = THINGS[thing]
    with pytest.raises(PointsError, match=text) as error:
        as_points(make(file))
    assert "; expected (n, 4) x, y, z, remission: pass " in str(error.value)


@pytest.mark.parametrize("order", [("x", "y", "z", "intensity"), ("Intensity", "Z", "ring", "Y", "X"), ("z", "y", "x")])
def test_the_columns_of_a_data_frame_have_names(order: tuple[str, ...]) -> None:
    """By position, they would be other axes."""
    pandas = pytest.importorskip("pandas")
    columns = {"x": POINTS[:, 0], "y": POINTS[:, 1], "z": POINTS[:, 2], "intensity": POINTS[:, 3], "ring": POINTS[:, 0]}
    frame = pandas.DataFrame({name: columns[name.lower()] for name in order}).assign(label="car", box=None)
    expected = POINTS if len(order) > 3 else POINTS * np.float32([1, 1, 1, 0])
    np.testing.assert_array_equal(as_points(frame), expected)
    np.testing.assert_array_equal(as_points(frame, remission_field="X")[:, 3], POINTS[:, 0])
    for unnamed in (pandas.DataFrame(POINTS), pandas.DataFrame(POINTS).rename(columns=str)):
        np.testing.assert_array_equal(as_points(unnamed), POINTS)
    with pytest.raises(PointsError, match="no numeric field x, y, z among range, azimuth"):
        as_points(pandas.DataFrame(POINTS, columns=["range", "azimuth", "elevation", "intensity"]))


def test_the_columns_of_an_arrow_table_have_names() -> None:
    table = pytest.importorskip("pyarrow").table(
        {"label": ["car"] * 50, **dict(zip("izyx", POINTS.T[::-1], strict=True))}
    )
    np.testing.assert_array_equal(as_points(table), POINTS)


@pytest.mark.parametrize("source", [None, 5, POINTS, ["a.bin", "b.bin"], b"a.bin"])
def test_what_is_no_path_is_no_recording(source: Any) -> None:
    for read in (read_scans, edgeperc.read_timed_scans, edgeperc.sensor_of):
        with pytest.raises(PointsError, match=r"got a \w+; expected the path of one recording"):
            read(source)


def test_the_named_calls_convert(file: Path) -> None:
    for points in (
        read_points(file),
        next(iter(read_scans(file)))[1],
        np.frombuffer(file.read_bytes(), np.float32).reshape(-1, 4),
        cloud_points(a_message(), remission_field="i"),
    ):
        np.testing.assert_array_equal(as_points(points), POINTS)
    np.testing.assert_array_equal(as_points(np.asarray(OfOpen3D.points))[:, :3], POINTS[:, :3])
    np.testing.assert_array_equal(as_points(Tensors.point.positions.numpy())[:, :3], POINTS[:, :3])


class Wrapped:
    """As a table of pandas or a tensor: it says how it becomes an array, whatever its attributes."""

    x = y = z = fields = data = point_step = 0

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return POINTS


@pytest.mark.parametrize("array", [POINTS.tolist(), [*POINTS], memoryview(POINTS), Wrapped(), (*POINTS,)], ids=type)
def test_what_becomes_an_array_is_taken(array: Any) -> None:
    np.testing.assert_array_equal(as_points(array), POINTS)
