"""KITTI's raw drives and tracking sequences, and View of Delft, which has KITTI's files, as they are downloaded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from ..errors import PointsError
from ..readers.files import read_points
from ..system.names import SCAN_SUFFIXES
from ..types.perception import Box
from .kitti import TRACKING_DRIVES, KittiCalibration, KittiLabels, label_lines, label_objects, labels_of, read_labels
from .tree import Camera, Labeled, Tree, present


class KittiTracking(Tree):
    """The sequences of KITTI's tracking benchmark (Geiger et al., 2012): ``training/velodyne/SEQ``, ``label_02`` and
    ``calib``, or ``ROOT`` in the place of ``training``. A sequence is the raw drive that it was taken from.
    """

    def __init__(self, root: Path) -> None:
        self._root = root / "training" if (root / "training").is_dir() else root
        sequences = sorted(path.stem for path in (self._root / "label_02").glob("[!.]*.txt"))
        if not sequences:
            raise PointsError(f"{root} has no label_02/SEQ.txt; expected the root of KITTI's tracking sequences")
        folders = {sequence: self._root / "velodyne" / sequence for sequence in sequences}
        files = {
            f"{sequence}_{path.stem}": path
            for sequence, folder in folders.items()
            for path in sorted(folder.glob("[0-9]*.bin")) or [folder / "000000.bin"]
        }
        self.scans = present(files, root, "labeled sequences' scans")
        of = {name: path.parent.name for name, path in self.scans.items()}
        self.drives = {
            name: TRACKING_DRIVES.get(sequence, f"kitti_tracking_{sequence}") for name, sequence in of.items()
        }
        self._labels = lru_cache(maxsize=2)(_labels_by_frame)

    def read(self, name: str) -> Labeled:
        """Read a scan and its labels, of what the left color camera sees. Raises PointsError."""
        path = self.scans[name]
        file = self._root / "label_02" / f"{path.parent.name}.txt"
        labels = self._labels(file).get(int(path.stem)) or labels_of([], file)
        calibration = KittiCalibration.read(self._root / "calib" / file.name)
        boxes, unlabeled = label_objects(labels, calibration)
        return Labeled(read_points(path), [*boxes], camera=Camera(calibration, unlabeled, labels))


def _labels_by_frame(path: Path) -> dict[int, KittiLabels]:
    """The labels of a sequence, whose lines begin with the numbers of the frame and of the track."""
    lines = dict[int, list[tuple[int, Sequence[str]]]]()
    for number, line in label_lines(path):
        frame, *words = line.split()
        if not frame.isdecimal():
            raise PointsError(f"{path}, line {number}: expected the number of a frame, got {frame!r:.40}")
        lines.setdefault(int(frame), []).append((number, words[1:]))
    return {frame: labels_of(of_frame, path) for frame, of_frame in lines.items()}


class KittiRaw(Tree):
    """Drives of KITTI's raw data with tracklets (Geiger et al., 2013): ``DRIVE/velodyne_points/data`` and
    ``DRIVE/tracklet_labels.xml``, below ``ROOT`` or a folder of it, and the calibration of the day beside ``DRIVE``.
    Without that, as CVAT exports drives, objects are labeled all around.
    """

    def __init__(self, root: Path) -> None:
        found = [path for deep in ("", "*/", "*/*/") for path in root.absolute().glob(f"{deep}tracklet_labels.xml")]
        if not found:
            raise PointsError(f"{root} has no tracklet_labels.xml; expected DRIVE/tracklet_labels.xml, or DATE/DRIVE")
        self._frames, files = dict[str, int](), dict[str, Path]()
        for drive in sorted(path.parent for path in found):
            for frame, path in _scans_of(drive).items():
                name = f"{drive.name}_{path.name.partition('.')[0]}"
                if name in files:
                    raise PointsError(f"{path} and {files[name]} have one name; evaluate the drives one by one")
                files[name], self._frames[name] = path, frame
        self.scans = present(files, root, "scans of tracklets")
        drives = {name: self._drive(path).name for name, path in self.scans.items()}
        self.drives = {name: drive.removesuffix("_sync") for name, drive in drives.items()}
        self._tracklets = lru_cache(maxsize=2)(_read_tracklets)

    def read(self, name: str) -> Labeled:
        """Read a scan and its boxes. Raises PointsError, CalibrationError."""
        path = self.scans[name]
        drive = self._drive(path)
        boxes = self._tracklets(drive / "tracklet_labels.xml").get(self._frames[name], [])
        camera = None
        if (drive.parent / "calib_velo_to_cam.txt").is_file():
            camera = Camera(KittiCalibration.read(drive.parent), np.empty((0, 4)))
        return Labeled(read_points(path), boxes, camera=camera)

    @staticmethod
    def _drive(scan: Path) -> Path:
        return scan.parents[2]


def _scans_of(drive: Path) -> dict[int, Path]:
    """The scans of a drive by frame: by their numbers, or as ``frame_list.txt`` tells, which CVAT writes."""
    folder, table = drive / "velodyne_points" / "data", drive / "frame_list.txt"
    paths = sorted(path for path in folder.glob("[!.]*") if path.name.lower().endswith(SCAN_SUFFIXES))
    if not table.is_file():
        numbered = {path.name.partition(".")[0]: path for path in paths}
        if odd := [path for name, path in numbered.items() if not name.isdecimal()]:
            raise PointsError(f"{odd[0]}: expected the number of its frame as its name, or {table}")
        return {int(name): path for name, path in numbered.items()} or {0: folder / "0000000000.bin"}
    stems, scans = {path.name.partition(".")[0]: path for path in paths}, dict[int, Path]()
    for number, line in label_lines(table):
        frame, _, name = line.strip().partition(" ")
        if not frame.isdecimal() or not name:
            raise PointsError(f"{table}, line {number}: {line[:100]!r}; expected the number of a frame and its name")
        stem = name.replace("\\", "/").rpartition("/")[2]
        if stem in stems:
            scans[int(frame)] = stems[stem]
    return scans or {0: folder / "0000000000.bin"}


def _read_tracklets(path: Path) -> dict[int, list[Box]]:
    """Boxes of the tracklets by frame, with KITTI's classes: poses are of the middle of the bottom face."""
    try:
        text = path.read_bytes()
        if b"<!ENTITY" in text:
            raise ValueError("it defines entities")
        boxes = dict[int, list[Box]]()
        for tracklet in ElementTree.fromstring(text).iterfind("tracklets/item"):
            kind, first = tracklet.findtext("objectType", ""), int(tracklet.findtext("first_frame", ""))
            height, width, length = (_number(tracklet, name) for name in "hwl")
            if not kind.strip() or not min(height, width, length) > 0.0:
                raise ValueError(f"a {kind!r:.60} of {length:g} x {width:g} x {height:g} m")
            for k, pose in enumerate(tracklet.iterfind("poses/item")):
                x, y, z, yaw = (_number(pose, name) for name in ("tx", "ty", "tz", "rz"))
                box = Box(kind.strip(), 1.0, (x, y, z + 0.5 * height), (length, width, height), yaw)
                boxes.setdefault(first + k, []).append(box)
    except (OSError, ElementTree.ParseError, UnicodeError, ValueError) as exc:
        expected = "expected objectType, h, w, l, first_frame and poses of each tracklet"
        raise PointsError(f"{path} has no tracklets of KITTI ({exc!s:.200}); {expected}") from exc
    return boxes


def _number(item: ElementTree.Element, name: str) -> float:
    text = item.findtext(name)
    with suppress(TypeError, ValueError):
        value = float(text)  # type: ignore[arg-type]  # None raises TypeError
        if abs(value) < 1e8:
            return value
    raise ValueError(f"{name} is {text!r:.40}")


class ViewOfDelft(Tree):
    """The labeled LiDAR scans of View of Delft (Palffy et al., 2022): ``lidar/training`` below ``ROOT``, or ``ROOT``
    itself, with ``velodyne``, ``label_2`` and ``calib``. Each scan counts as a drive.
    """

    def __init__(self, root: Path) -> None:
        places = (root / deep for deep in ("", "training", "lidar/training", "view_of_delft_PUBLIC/lidar/training"))
        found = next((place for place in places if (place / "label_2").is_dir()), None)
        if found is None:
            raise PointsError(
                f"{root} has no lidar/training/label_2; expected the root of View of Delft, or velodyne/ and label/"
            )
        self._root = found
        names = [path.stem for path in sorted((found / "label_2").glob("[!.]*.txt"))]
        self.scans = present({name: found / "velodyne" / f"{name}.bin" for name in names}, root, "labeled scans")
        self.drives = {name: name for name in self.scans}

    def read(self, name: str) -> Labeled:
        """Read a scan and its labels. Raises PointsError, CalibrationError."""
        labels = read_labels(self._root / "label_2" / f"{name}.txt")
        calibration = KittiCalibration.read(self._root / "calib" / f"{name}.txt")
        kinds, rows = labels.objects
        # Places are the camera's, but boxes stand along the z axis of the LiDAR, and turn about it.
        bottom = np.column_stack([rows[:, 10:13], np.ones(len(rows))]) @ np.linalg.inv(calibration.T_cam_velo).T
        boxes = []
        for kind, (x, y, z, _), row in zip(kinds, bottom.tolist(), rows.tolist(), strict=True):
            height, width, length, *_, turn = row[7:14]
            yaw = math.remainder(-turn - 0.5 * math.pi, 2.0 * math.pi)
            boxes.append(Box(kind, 1.0, (x, y, z + 0.5 * height), (length, width, height), yaw))
        return Labeled(read_points(self.scans[name]), boxes)
