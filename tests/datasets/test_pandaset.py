"""PandaSet is read as it is published, in data frames that pandas pickled; nothing in a pickle is called."""

from __future__ import annotations

import gzip
import json
import math
import pickle
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from cli_helpers import Shell
from edgeperc.datasets.pickled import read_pickled
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.errors import PointsError

Table = Mapping[str, Any]
Writer = Callable[[Path, Table], None]
MANAGER = "pandas.core.internals.managers.BlockManager"
TURN, PLACE = 2.0, np.array([500.0, -300.0, 12.0])  # of the vehicle, whose y axis is ahead, in the world


class Made:
    """What a function of pandas makes, as its pickle has it."""

    def __init__(self, function: str, *made_of: Any) -> None:
        self.parts = named(function), made_of

    def __reduce__(self) -> Any:
        return self.parts


def named(path: str) -> Any:
    """A class of this name in a module of `modules`."""
    module, _, name = path.rpartition(".")
    place = sys.modules[module]
    if not hasattr(place, name):
        inside = {"__module__": module, "__qualname__": name, "__getstate__": lambda self: self.given}
        setattr(place, name, type(name, (), inside))
    return getattr(place, name)


def given(path: str, state: Any) -> Any:
    """An object of this class with a state."""
    made = named(path)()
    made.given = state
    return made


@pytest.fixture
def modules(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("", ".core.frame", ".core.internals.managers", ".core.indexes.base", "._libs.internals"):
        monkeypatch.setitem(sys.modules, f"pandas{name}", ModuleType(f"pandas{name}"))


def blocks_of(table: Table) -> list[tuple[np.ndarray, Any]]:
    """Columns of one type together, as pandas keeps them; places as a slice, where they follow one another."""
    arrays = {name: np.asarray(column) for name, column in table.items()}
    arrays = {name: array.astype(object) if array.dtype.kind == "U" else array for name, array in arrays.items()}
    kinds: dict[str, list[int]] = {}
    for k, array in enumerate(arrays.values()):
        kinds.setdefault(array.dtype.str, []).append(k)
    together = [np.array([[*arrays.values()][k] for k in places]) for places in kinds.values()]
    slices = [slice(p[0], p[-1] + 1, 1) if p == [*range(p[0], p[-1] + 1)] else np.array(p) for p in kinds.values()]
    return [*zip((np.asfortranarray(values) for values in together), slices, strict=True)]


def index_of(data: Any) -> Made:
    array = np.array([*data], object)
    index = named("pandas.core.indexes.base.Index")
    return Made("pandas.core.indexes.base._new_Index", index, {"data": array, "name": None})


def write_frame(path: Path, manager: Any, attribute: str, protocol: int) -> None:
    state = {attribute: manager, "_typ": "dataframe", "_metadata": []}
    frame = given("pandas.core.frame.DataFrame", state)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(pickle.dumps(frame, protocol)))


def as_published(path: Path, table: Table) -> None:
    """By pandas 0.25 to 1.2."""
    axes = [index_of(table), index_of(range(3))]
    blocks = [{"values": values, "mgr_locs": places} for values, places in blocks_of(table)]
    state = (axes, [], [], {"0.14.1": {"axes": axes, "blocks": blocks}})
    write_frame(path, given(MANAGER, state), "_data", 4)


def as_of_later(path: Path, table: Table) -> None:
    """By pandas 1.3 and later."""
    unpickle = "pandas._libs.internals._unpickle_block"
    blocks = tuple(Made(unpickle, values, places, 2) for values, places in blocks_of(table))
    write_frame(path, Made(MANAGER, blocks, [index_of(table), index_of(range(3))]), "_mgr", 5)


def by_pandas(path: Path, table: Table) -> None:
    pandas = pytest.importorskip("pandas", reason="the sets are written without it, too")
    path.parent.mkdir(parents=True, exist_ok=True)
    kinds = {name: object if isinstance(column[0], str) else None for name, column in table.items()}
    columns = {name: pandas.Series(column, dtype=kinds[name]) for name, column in table.items()}
    frame = pandas.DataFrame(columns, columns=pandas.Index([*columns], dtype=object))
    frame.to_pickle(path, compression="gzip")


def in_world(ahead: np.ndarray) -> np.ndarray:
    """Places in the world of those with x ahead."""
    right, front, up = -ahead[:, 1], ahead[:, 0], ahead[:, 2]
    cos, sin = math.cos(TURN), math.sin(TURN)
    return np.column_stack([cos * right - sin * front, sin * right + cos * front, up]) + PLACE


POINTS = np.array([[10.0, 2.0, -1.0], [-5.0, 3.0, 0.5], [30.0, -4.0, 1.0], [8.0, 8.0, 0.0]])
BOX = (20.0, -3.0, -0.5), (4.5, 1.8, 1.5), 0.3


def pandaset(root: Path, write: Writer) -> Path:
    """A sequence of one scan: its last point is of the other LiDAR, as is the second box."""
    (x, y, z), center = in_world(POINTS).T, in_world(np.array([BOX[0]]))[0]
    lidar, labels = root / "001" / "lidar", root / "001" / "annotations"
    table = {
        "x": x,
        "y": y,
        "z": z,
        "i": np.array([0.0, 255.0, 7.0, 9.0]),
        "t": np.zeros(4),
        "d": np.array([0, 0, 0, 1]),
    }
    write(lidar / "00.pkl.gz", table)
    half = 0.5 * TURN
    pose = dict(zip("xyz", PLACE.tolist(), strict=True)), {"w": math.cos(half), "x": 0, "y": 0, "z": math.sin(half)}
    (lidar / "poses.json").write_text(json.dumps([{"position": pose[0], "heading": pose[1]}]))
    length, width, height = BOX[1]
    row = {"yaw": BOX[2] + TURN, "position.x": center[0], "position.y": center[1], "position.z": center[2]}
    row |= {"dimensions.x": width, "dimensions.y": length, "dimensions.z": height, "stationary": False}
    twice = {name: np.array([value, value]) for name, value in row.items()}
    texts = {"uuid": ["a", "b"], "label": ["Pickup Truck"] * 2}
    write(labels / "cuboids" / "00.pkl.gz", texts | twice | {"cuboids.sensor_id": np.array([-1, 1])})
    write(labels / "semseg" / "00.pkl.gz", {"class": np.array([7, 13, 13, 7])})
    (labels / "semseg" / "classes.json").write_text(json.dumps({"7": "Road", "13": "Car"}))
    return root


@pytest.mark.parametrize("write", [as_published, as_of_later])
def test_pandaset_is_read_as_it_is_published(write: Writer, tmp_path: Path, modules: None) -> None:
    check(ScanFolder(pandaset(tmp_path, write), "pandaset"))
    check(ScanFolder(tmp_path / "001", "pandaset"))


def test_it_is_read_as_pandas_writes_it_today(tmp_path: Path) -> None:
    check(ScanFolder(pandaset(tmp_path, by_pandas), "pandaset"))


def check(folder: ScanFolder) -> None:
    assert folder.names("test") == ["001_00"]
    assert folder.drives == {"001_00": "pandaset_001"}
    frame = folder.frame("001_00")
    np.testing.assert_allclose(frame.points, np.column_stack([POINTS, [0, 255, 7, 9]])[:3], atol=1e-4)
    assert frame.points.dtype == np.float32
    assert frame.boxes is not None
    assert frame.point_classes is not None
    (box,) = frame.boxes
    assert box.label == "car"
    np.testing.assert_allclose((*box.center, *box.size, box.yaw), (*BOX[0], *BOX[1], BOX[2]), atol=1e-6)
    assert [frame.class_names[k] for k in frame.point_classes] == ["road", "car", "car"]


def test_a_pickle_calls_nothing(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> Any:
            return Path.touch, (tmp_path / "called",)

    for content in (Hostile(), {"_mgr": Hostile()}, [Hostile()] * 3):
        for protocol in range(2, 6):
            (tmp_path / "a.pkl.gz").write_bytes(gzip.compress(pickle.dumps(content, protocol)))
            with pytest.raises(PointsError, match=r"a\.pkl\.gz is damaged, or no data frame"):
                read_pickled(tmp_path / "a.pkl.gz")
    memo = b"\x80\x04]r\xff\xff\xff\x7f."  # a list whose number in the memo is large
    (tmp_path / "a.pkl.gz").write_bytes(gzip.compress(memo))
    with pytest.raises(PointsError, match="no data frame"):
        read_pickled(tmp_path / "a.pkl.gz")
    assert not (tmp_path / "called").exists()


def without(path: str) -> Callable[[Path], Any]:
    return lambda root: (root / path).unlink()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without("001/lidar/poses.json"), r"poses\.json cannot be read"),
        (lambda root: (root / "001/lidar/poses.json").write_text("[]"), r"not as PandaSet's \(IndexError"),
        (lambda root: (root / "001/lidar/poses.json").write_text('[{"position": 1}]'), r"not as PandaSet's"),
        (lambda root: as_published(root / "001/annotations/semseg/00.pkl.gz", {"class": np.zeros(3)}), "3 classes"),
        (lambda root: as_published(root / "001/annotations/semseg/00.pkl.gz", {"class": np.zeros(4)}), "type float64"),
        (lambda root: as_published(root / "001/lidar/00.pkl.gz", {"x": np.zeros(4)}), r"KeyError\('d'\)"),
        (lambda root: (root / "001/lidar/00.pkl.gz").write_bytes(b""), r"00\.pkl\.gz is damaged"),
        (lambda root: (root / "001/lidar/00.pkl.gz").write_bytes(b"version https://git-lfs"), "gzip data is damaged"),
        (
            lambda root: (root / "001/lidar/00.pkl.gz").write_bytes((root / "001/lidar/00.pkl.gz").read_bytes()[:200]),
            r"00\.pkl\.gz is damaged",
        ),
        (
            lambda root: as_published(root / "001/annotations/cuboids/00.pkl.gz", {"a": np.array([b"1"])}),
            "a column of the type 'S1'",
        ),
    ],
)  # fmt: skip
def test_damaged_files_are_refused(change: Callable[[Path], Any], said: str, tmp_path: Path, modules: None) -> None:
    change(pandaset(tmp_path, as_published))
    with pytest.raises(PointsError, match=said):
        ScanFolder(tmp_path, "pandaset").frame("001_00")


def test_a_set_without_labels_is_refused(tmp_path: Path, shell: Shell, modules: None) -> None:
    pandaset(tmp_path, as_published)
    for kind in ("cuboids", "semseg"):
        (tmp_path / "001/annotations" / kind / "00.pkl.gz").unlink()
    expected = "has no labeled scans of PandaSet; expected SEQ/lidar/00.pkl.gz"
    assert expected in shell.err("eval", f"{tmp_path}:pandaset", code=2)


def test_a_scan_that_was_trained_on_is_known_by_its_name(tmp_path: Path, shell: Shell, modules: None) -> None:
    """The copies that models were trained on are rounded to 1 mm, so that their hashes do not tell."""
    pandaset(tmp_path, as_published)
    (tmp_path / "001").rename(tmp_path / "002")
    said = shell.err("eval", f"{tmp_path}:pandaset", "--split", "all", code=2)
    assert "was trained on scan 002_00 of drive pandaset_002" in said
