"""Public sets as they are downloaded: nuScenes' tables, Argoverse 2's logs, and PandaSet's sequences."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..readers.files import read_points
from ..types.frame import poses_of, turned
from ..types.perception import Box
from ..types.points import Floats
from .annotations import read_json
from .kitti import read_numbers
from .kitti_trees import KittiRaw, KittiTracking, ViewOfDelft
from .layout import WITH_RIDER, point_names_of
from .once import Once
from .parquet import arrow_module
from .pickled import read_pickled
from .tree import Labeled, Tree, present
from .waymo import Waymo

_Row = TypeVar("_Row")
_Json = dict[str, Any]
_Test = Callable[[_Json], bool]
_Annotation = tuple[str, Any, Any, Any]  # class, translation, rotation and size of a box, as nuScenes has them
_Posed = tuple[str, Floats, list[float]]  # class, pose, and width, length and height of a box
_TOP = "LIDAR_TOP"
_PLACE, _TURN = ("tx_m", "ty_m", "tz_m"), ("qx", "qy", "qz", "qw")
_BYTE = 255.0  # Argoverse 2's intensities, which its profile has as 0..1


class NuScenes(Tree):
    """The key frames of one LiDAR in nuScenes' tables (Caesar et al., 2020), which Lyft Level 5 and TIER IV's T4 have,
    too: ``ROOT/VERSION/*.json``, or those of ``ROOT`` itself. A bicycle with a rider has a class of its own.
    """

    def __init__(self, root: Path) -> None:
        self._tables = _folder_of_tables(root)
        self._root = self._tables.parent
        self._frames, self.scans = self._key_frames()
        scenes = self._texts("scene", "name")
        samples = self._by_token("sample", lambda row: scenes[row["scene_token"]])
        used = {frame.ego_pose_token for frame, _ in self._frames.values()}
        egos = self._by_token("ego_pose", _pose_of, lambda row: row["token"] in used)
        try:
            self.drives = {name: samples[frame.sample_token] for name, (frame, _) in self._frames.items()}
            self._egos = {name: egos[frame.ego_pose_token] for name, (frame, _) in self._frames.items()}
        except KeyError as exc:
            raise PointsError(f"{self._tables}: sample_data.json names a row {exc} that is not there") from exc
        self._boxes, numbered = self._annotated(), lambda row: (str(row["index"]), row["name"])
        named = dict(self._rows("category", numbered, lambda row: row.get("index") is not None))
        self.point_names = point_names_of(named, str(self._tables / "category.json"))
        self._numbers: dict[str, Path] = {}
        if (self._tables / "lidarseg.json").is_file():
            tokens = {frame.token for frame, _ in self._frames.values()}
            files = self._rows("lidarseg", lambda row: (_text(row["sample_data_token"]), _text(row["filename"])))
            of = {token: self._root / file for token, file in files if token in tokens}
            self._numbers = present(of, self._root, "files of lidarseg.json", all_may_lack=True)
        if self._boxes is None and not self._numbers:
            raise PointsError(f"{self._tables} has no labels; expected rows in sample_annotation.json or lidarseg.json")

    def read(self, name: str) -> Labeled:
        """Read a scan, turned until x is ahead, and its labels. Raises PointsError."""
        frame, sensor = self._frames[name]
        ahead = math.atan2(sensor[1, 0], sensor[0, 0])
        points = read_points(self.scans[name])
        about_z = math.cos(0.5 * ahead), 0.0, 0.0, math.sin(0.5 * ahead)
        into = _pose((0.0, 0.0, 0.0), about_z) @ np.linalg.inv(self._egos[name] @ sensor)
        boxes = None
        if self._boxes is not None:
            rows = self._boxes.get(frame.sample_token, ())
            try:
                boxes = [_box(kind, _pose(place, turn), size, into) for kind, place, turn, size in rows]
            except (TypeError, ValueError) as exc:
                raise PointsError(f"{self._tables}/sample_annotation.json: a box of {name} is none ({exc})") from exc
        file = self._numbers.get(frame.token)
        numbers = None if file is None else read_numbers(file, len(points))
        return Labeled(turned(points, -ahead) if ahead else points, boxes, numbers)

    def _key_frames(self) -> tuple[dict[str, tuple[_Frame, Floats]], dict[str, Path]]:
        """The key frames whose files are there, with the pose of their LiDAR in the vehicle; and these files."""
        modalities, channels_of = self._texts("sensor", "modality"), self._texts("sensor", "channel")
        mounted = self._by_token(
            "calibrated_sensor",
            lambda row: (channels_of[row["sensor_token"]], _pose_of(row)),
            lambda row: modalities.get(row["sensor_token"]) == "lidar",
        )
        frames = self._rows(
            "sample_data",
            lambda row: _Frame(*(_text(row[key]) for key in _Frame._fields)),
            lambda row: row["is_key_frame"] and row["calibrated_sensor_token"] in mounted,
        )
        channels = sorted({mounted[frame.calibrated_sensor_token][0] for frame in frames})
        if _TOP not in channels and len(channels) != 1:
            of = f"key frames of LiDARs {', '.join(channels)}" if channels else "no key frame of a LiDAR"
            raise PointsError(f"{self._tables}: sample_data.json has {of}; expected some of one, or of {_TOP}")
        of_channel, named = _TOP if _TOP in channels else channels[0], dict[str, tuple[_Frame, Floats]]()
        for frame in frames:
            channel, pose = mounted[frame.calibrated_sensor_token]
            if channel == of_channel and named.setdefault(_stem(frame.filename), (frame, pose))[0] is not frame:
                raise PointsError(f"{self._tables}: two key frames are called {_stem(frame.filename)}; expected one")
        files = {name: self._file(frame.filename) for name, (frame, _) in named.items()}
        there = present(files, self._root, "labeled scans")
        return {name: named[name] for name in there}, there

    def _file(self, name: str) -> Path:
        """A file of the set; Lyft's ``lidar`` is ``train_lidar`` beside ``train_data`` on Kaggle."""
        path, (part, data, _) = self._root / name, self._tables.name.rpartition("data")
        return self._root / f"{part}{name}" if part and data and not path.is_file() else path

    def _annotated(self) -> dict[str, list[_Annotation]] | None:
        """The boxes by sample; None for a set without labels."""
        if not (self._tables / "sample_annotation.json").is_file():
            return None
        attributes, categories = self._texts("attribute", "name"), self._texts("category", "name")
        instances = self._texts("instance", "category_token")
        wanted = {frame.sample_token for frame, _ in self._frames.values()}

        def labeled(row: dict[str, Any]) -> tuple[str, _Annotation]:
            ridden = any(attributes[token].endswith(WITH_RIDER) for token in row["attribute_tokens"])
            kind = categories[instances[row["instance_token"]]] + (WITH_RIDER if ridden else "")
            return row["sample_token"], (kind, row["translation"], row["rotation"], row["size"])

        boxes = dict[str, list[_Annotation]]()
        for sample, box in self._rows("sample_annotation", labeled, lambda row: row["sample_token"] in wanted):
            boxes.setdefault(sample, []).append(box)
        return boxes or None  # a test set's table is empty

    def _rows(self, table: str, row_of: Callable[[_Json], _Row], is_wanted: _Test = bool) -> list[_Row]:
        """What is wanted of the rows of a table, of which one alone is kept at a time: some have gigabytes."""
        path = self._tables / f"{table}.json"

        def wanted(row: dict[str, Any]) -> Any:
            if "token" not in row:  # a part of a row
                return row
            return (row_of(row),) if is_wanted(row) else None

        try:
            with path.open(encoding="utf-8") as file:
                rows = json.load(file, object_hook=wanted)
            if not isinstance(rows, list) or not all(row is None or isinstance(row, tuple) for row in rows):
                raise TypeError("no list of rows with a token")  # JSON has no tuples
            return [row for (row,) in filter(None, rows)]
        except (OSError, RecursionError, UnicodeDecodeError, json.JSONDecodeError) as exc:
            raise PointsError(f"{path} cannot be read ({exc}); expected a table of nuScenes") from exc
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError) as exc:
            told = f"{path} has a row that is not nuScenes' ({exc!r:.100}); expected docs/schema of its devkit"
            raise PointsError(told) from exc

    def _by_token(self, table: str, value_of: Callable[[_Json], _Row], is_wanted: _Test = bool) -> dict[str, _Row]:
        return dict(self._rows(table, lambda row: (_text(row["token"]), value_of(row)), is_wanted))

    def _texts(self, table: str, key: str) -> dict[str, str]:
        return self._by_token(table, lambda row: _text(row[key]))


class _Frame(NamedTuple):
    token: str
    sample_token: str
    ego_pose_token: str
    calibrated_sensor_token: str
    filename: str


class Argoverse2(Tree):
    """The labeled sweeps of Argoverse 2's sensor set (Wilson et al., 2021), in ``ROOT/LOG`` or ``ROOT/SPLIT/LOG``. The
    origin is that of the upper LiDAR, the axes are the vehicle's, and intensities are 0..1.
    """

    def __init__(self, root: Path) -> None:
        logs = [path.parent for depth in ("", "*/", "*/*/") for path in root.glob(f"{depth}annotations.feather")]
        if not logs:
            raise PointsError(f"{root} has no annotations.feather; expected LOG/annotations.feather, or SPLIT/LOG")
        files = {
            f"{log.name}_{stamp}": log / "sensors" / "lidar" / f"{stamp}.feather"
            for log in sorted(logs)
            for stamp in np.unique(_feather(log / "annotations.feather", "timestamp_ns")["timestamp_ns"]).tolist()
        }
        self.scans = present(files, root, "labeled scans")
        self.drives = {name: path.parents[2].name for name, path in self.scans.items()}
        self._log = lru_cache(maxsize=2)(_log)

    def read(self, name: str) -> Labeled:
        """Read a sweep and its labels. Raises PointsError."""
        path = self.scans[name]
        try:
            return self._read(path, int(path.stem), self._log(path.parents[2]))
        except PointsError:
            raise
        except (TypeError, ValueError) as exc:
            raise PointsError(f"{path.parents[2]}: {exc}") from exc

    def _read(self, path: Path, stamp: int, log: _Log) -> Labeled:
        columns = _feather(path, "x", "y", "z", "intensity")
        points = np.column_stack([*columns.values()]).astype(np.float64)
        points = ((points - [*log.lidar_m, 0.0]) / [1.0, 1.0, 1.0, _BYTE]).astype(np.float32)
        into = np.eye(4)
        into[:3, 3] = -log.lidar_m
        drivable = None
        if log.areas is not None and stamp in log.egos:
            here = into @ np.linalg.inv(log.egos[stamp])
            drivable = tuple(area @ here[:3, :3].T + here[:3, 3] for area in log.areas)
        return Labeled(points, [_box(*row, into) for row in log.boxes.get(stamp, ())], None, drivable)


class _Log(NamedTuple):
    """A log: place of the upper LiDAR in the vehicle's frame, its boxes and the vehicle's pose by the time of a sweep,
    and the drivable areas of the map.
    """

    lidar_m: Floats
    boxes: Mapping[int, list[_Posed]]
    egos: Mapping[int, Floats]
    areas: list[Floats] | None


def _log(folder: Path) -> _Log:
    sensors = _feather(folder / "calibration" / "egovehicle_SE3_sensor.feather", "sensor_name", *_PLACE)
    names = sensors.pop("sensor_name").tolist()
    if "up_lidar" not in names:
        raise PointsError(f"{folder} has no calibration of up_lidar; expected it in egovehicle_SE3_sensor.feather")
    boxes = dict[int, list[_Posed]]()
    sizes = ("width_m", "length_m", "height_m")
    rows = _feather(folder / "annotations.feather", "timestamp_ns", "category", *sizes, *_PLACE, *_TURN)
    poses = _poses(rows)
    for k, (stamp, kind) in enumerate(zip(rows["timestamp_ns"].tolist(), rows["category"].tolist(), strict=True)):
        boxes.setdefault(stamp, []).append((_text(kind), poses[k], [float(rows[size][k]) for size in sizes]))
    areas, egos = None, dict[int, Floats]()
    for path in folder.glob("map/log_map_archive_*.json"):
        egos_of = _feather(folder / "city_SE3_egovehicle.feather", "timestamp_ns", *_PLACE, *_TURN)
        egos = dict(zip(egos_of["timestamp_ns"].tolist(), _poses(egos_of), strict=True))
        try:
            rings = [area["area_boundary"] for area in read_json(path)["drivable_areas"].values()]
            areas = [np.array([[corner[axis] for axis in "xyz"] for corner in ring], np.float64) for ring in rings]
        except (AttributeError, KeyError, TypeError, ValueError) as exc:
            raise PointsError(f"{path} is not a map of Argoverse 2 ({exc!r:.100}); expected drivable_areas") from exc
    return _Log(np.array([sensors[axis][names.index("up_lidar")] for axis in _PLACE], np.float64), boxes, egos, areas)


class PandaSet(Tree):
    """The labeled scans of PandaSet (Xiao et al., 2021), in ``ROOT/SEQ``: the points of the Pandar64, and the boxes of
    what it sees. The origin is that of the vehicle's pose.
    """

    names_file = "annotations/semseg/classes.json"

    def __init__(self, root: Path) -> None:
        files = {
            f"{path.parents[1].name}_{path.name.partition('.')[0]}": path
            for depth in ("", "*/")
            for path in sorted(root.absolute().glob(f"{depth}lidar/[0-9]*.pkl.gz"))
        }
        self.scans = {name: path for name, path in files.items() if any(map(Path.is_file, _annotations(path)))}
        if not self.scans:
            labels = "SEQ/annotations/cuboids/00.pkl.gz or semseg/00.pkl.gz"
            raise PointsError(f"{root} has no labeled scans of PandaSet; expected SEQ/lidar/00.pkl.gz and {labels}")
        self.drives = {name: f"pandaset_{path.parents[1].name}" for name, path in self.scans.items()}
        named = (path.parents[1] / self.names_file for path in self.scans.values())
        file = next(filter(Path.is_file, named), None)
        self.point_names = {} if file is None else point_names_of(read_json(file), str(file))
        self._poses = lru_cache(maxsize=2)(lambda path: read_json(path, list))

    def read(self, name: str) -> Labeled:
        """Read a scan from the world's frame, and its labels. Raises PointsError."""
        path = self.scans[name]
        boxes_of, classes_of = _annotations(path)
        boxes = numbers = None
        try:
            pose = self._poses(path.with_name("poses.json"))[int(path.name.partition(".")[0])]
            place, turn = ([pose[of][axis] for axis in axes] for of, axes in (("position", "xyz"), ("heading", "wxyz")))
            into = _RIGHT_TO_AHEAD @ np.linalg.inv(_pose(place, turn))
            table = read_pickled(path)
            of_lidar = table["d"] == _PANDAR64
            xyz, intensity = np.column_stack([table[axis] for axis in "xyz"])[of_lidar], table["i"][of_lidar]
            points = np.column_stack([xyz @ into[:3, :3].T + into[:3, 3], intensity]).astype(np.float32)
            if boxes_of.is_file():
                boxes = _cuboids(read_pickled(boxes_of), into)
            if classes_of.is_file():
                numbers = read_pickled(classes_of)["class"]
                if len(numbers) != len(of_lidar) or numbers.dtype.kind not in "iu":
                    raise ValueError(f"{len(numbers)} classes, of the type {numbers.dtype}, for {len(of_lidar)} points")
                numbers = numbers[of_lidar].astype(np.uint64)
        except PointsError:
            raise
        except (ArithmeticError, AttributeError, IndexError, KeyError, TypeError, ValueError) as exc:
            raise PointsError(f"{path}, its labels or its poses.json are not as PandaSet's ({exc!r:.100})") from exc
        return Labeled(points, boxes, numbers)


def _annotations(scan: Path) -> tuple[Path, Path]:
    """The files of PandaSet with the boxes of a scan and the classes of its points."""
    folder = scan.parents[1] / "annotations"
    return folder / "cuboids" / scan.name, folder / "semseg" / scan.name


def _cuboids(table: Mapping[str, NDArray[Any]], into: Floats) -> list[Box]:
    """PandaSet's boxes, whose length is along y; one that both LiDARs see has a row of each."""
    boxes = []
    for k in np.flatnonzero(table["cuboids.sensor_id"] != _PANDARGT).tolist():
        place, size = ([table[f"{of}.{axis}"][k] for axis in "xyz"] for of in ("position", "dimensions"))
        half = 0.5 * (float(table["yaw"][k]) + 0.5 * math.pi)
        pose = _pose(place, (math.cos(half), 0.0, 0.0, math.sin(half)))
        boxes.append(_box(_text(table["label"][k]).replace(" ", "_"), pose, size, into))
    return boxes


_PANDAR64, _PANDARGT = 0, 1  # sensors of PandaSet
_RIGHT_TO_AHEAD = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def _feather(path: Path, *columns: str) -> dict[str, NDArray[Any]]:
    """Columns of a table. Raises PointsError."""
    with arrow_module("feather", path, columns) as feather:
        table = feather.read_table(path, columns=list(columns), memory_map=False)
        table.validate(full=True)
        return {name: table.column(name).to_numpy() for name in columns}


def _folder_of_tables(root: Path) -> Path:
    """The folder of the tables of one version."""
    found = sorted(path.parent for depth in ("", "*/") for path in root.glob(f"{depth}sample_data.json"))
    if len(found) != 1:
        versions = ", ".join(path.name for path in found)
        raise PointsError(
            f"{root} has tables of {versions}; pass the folder of one, such as {found[0]}"
            if found
            else f"{root} has no tables of nuScenes; expected VERSION/sample_data.json beside samples/"
        )
    return found[0]


def _stem(filename: str) -> str:
    return Path(filename).name.removesuffix(".bin").removesuffix(".pcd")


def _pose_of(row: _Json) -> Floats:
    return _pose(row["translation"], row["rotation"])


def _pose(translation: Iterable[Any], rotation: Iterable[Any]) -> Floats:
    """Matrix (4, 4) of x, y, z [m] and a quaternion w, x, y, z."""
    (w, *xyz), (east, north, up) = map(float, rotation), map(float, translation)
    (pose,) = _matrices(np.array([[east, north, up]]), np.array([[*xyz, w]]))
    return pose


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r:.40} in place of a text")
    return value


def _poses(columns: Mapping[str, NDArray[Any]]) -> Floats:
    """Matrices (n, 4, 4) of a table."""
    place, turn = (np.column_stack([columns[name] for name in names]).astype(np.float64) for names in (_PLACE, _TURN))
    return _matrices(place, turn)


def _matrices(positions: Floats, quaternions: Floats) -> Floats:
    norms = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not (quaternions.shape[1] == 4 and np.isfinite(positions).all() and (np.abs(norms - 1.0) < 0.1).all()):
        raise ValueError("a pose that is not finite, or whose quaternion has not the length 1")
    return poses_of(positions, quaternions / norms)


def _box(kind: str, pose: Floats, size: Iterable[float], into: Floats) -> Box:
    """An upright box of a pose in the world; ``size`` is width, length, height."""
    there = into @ pose
    (x, y, z), (width, length, height) = there[:3, 3].tolist(), map(float, size)
    if not 0.0 < min(width, length, height) <= max(width, length, height) < math.inf:
        raise ValueError(f"a {kind!r:.60} of {width:g} x {length:g} x {height:g} m; expected sizes above 0")
    return Box(kind, 1.0, (x, y, z), (length, width, height), math.atan2(there[1, 0], there[0, 0]))


TREES: Mapping[str, Callable[[Path], Tree]] = {
    "argoverse2": Argoverse2,
    "kitti-raw": KittiRaw,
    "kitti-tracking": KittiTracking,
    "nuscenes": NuScenes,
    "once": Once,
    "pandaset": PandaSet,
    "vod": ViewOfDelft,
    "waymo": Waymo,
}
"""What reads a set in its own tree, by ``files`` of its description."""
