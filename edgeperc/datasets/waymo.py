"""The Waymo Open Dataset as it is downloaded: the Parquet files of its version 2, a folder for each component."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..types.points import Floats
from ..types.rigid import rigid
from .annotations import upright_box
from .parquet import LargeRows, read_rows
from .tree import Labeled, Tree, present

_TOP, _LASER, _STAMP = 1, "key.laser_name", "key.frame_timestamp_micros"
_OF_TOP = (f"[LiDARCalibrationComponent].{of}" for of in ("extrinsic.transform", "beam_inclination.values"))
_CALIBRATION, _POSE = (_LASER, *_OF_TOP), (_STAMP, "[VehiclePoseComponent].world_from_vehicle.transform")
_OF_BOX = ("type", "box.heading", *(f"box.{of}.{axis}" for of in ("center", "size") for axis in "xyz"))
_BOX = (_STAMP, *(f"[LiDARBoxComponent].{of}" for of in _OF_BOX))
_KINDS = dict(enumerate(("unknown", "vehicle", "pedestrian", "sign", "cyclist")))
_IMAGES = {"lidar": "LiDAR", "lidar_pose": "LiDARPose", "lidar_segmentation": "LiDARSegmentationLabel"}
_NEEDED, _POSES, _LABELS = (
    ("lidar", "lidar_calibration"),
    ("lidar_pose", "vehicle_pose"),
    ("lidar_box", "lidar_segmentation"),
)


class Waymo(Tree):
    """The labeled frames of Waymo's Perception set (Sun et al., 2020), in ``ROOT`` or ``ROOT/SPLIT``: first returns of
    the TOP LiDAR, but for those in zones that nobody labeled. The origin is that of TOP, the axes are the vehicle's.
    Intensities, which have no limit, become their tanh.
    """

    names_file = "waymo.json"

    def __init__(self, root: Path) -> None:
        self.point_names, self.scans, self.drives = {}, {}, {}
        found = (path for depth in ("", "*/") for part in _LABELS for path in root.glob(f"{depth}{part}/*.parquet"))
        folders = {path.stem: path.parents[1] for path in sorted(found)}
        if not folders:
            told = "expected lidar_box/SEGMENT.parquet or lidar_segmentation/SEGMENT.parquet, of version 2 of the set"
            raise PointsError(f"{root} has no labels of Waymo; {told}")
        self._files: dict[str, dict[str, Path]] = {}
        for part in (*_NEEDED, *_POSES, *_LABELS):
            files = {name: folder / part / f"{name}.parquet" for name, folder in folders.items()}
            if part in _LABELS:
                files = {name: path for name, path in files.items() if path.is_file()}
            else:
                files = present(files, root, f"files of {part}", all_may_lack=part in _POSES)
            folders = {name: folders[name] for name in files} if part in _NEEDED else folders
            self._files[part] = files
        self._rows, self._images = lru_cache(maxsize=8)(read_rows), lru_cache(maxsize=3)(LargeRows)
        for segment in folders:
            frames = self._of(segment, "lidar" if segment in self._files["lidar_box"] else "lidar_segmentation").groups
            for stamp in sorted(stamp for laser, stamp in frames if laser == _TOP):
                self.scans[f"{segment}_{stamp}"] = self._files["lidar"][segment]
                self.drives[f"{segment}_{stamp}"] = segment
        if not self.scans:
            raise PointsError(f"{root} has no labeled frame of TOP; expected rows with {_LASER} {_TOP} in lidar/")

    def read(self, name: str) -> Labeled:
        """Read a frame and its labels. Raises PointsError."""
        segment, _, stamp = name.rpartition("_")
        files = {part: files[segment] for part, files in self._files.items() if segment in files}
        try:
            return self._read(segment, int(stamp), files)
        except PointsError:
            raise
        except (ArithmeticError, AttributeError, IndexError, KeyError, StopIteration, TypeError, ValueError) as exc:
            raise PointsError(f"{files['lidar']}, or another file of {name}, is not as Waymo's ({exc!r:.200})") from exc

    def _read(self, segment: str, stamp: int, files: dict[str, Path]) -> Labeled:
        rows = self._rows(files["lidar_calibration"], *_CALIBRATION)
        extrinsic, beams = next((_transform(of[1], segment), of[2]) for of in rows if of[0] == _TOP)
        image = self._image(segment, "lidar", stamp, 4)
        is_point = (image[..., 0] > 0.0) & (image[..., 0] < math.inf) & ~(image[..., 3] > 0.0)
        xyz = _measured(image[..., 0], is_point, extrinsic, np.array(beams[::-1], np.float64))
        if files.keys() >= {*_POSES}:
            frame = next(pose for at, pose in self._rows(files["vehicle_pose"], *_POSE) if at == stamp)
            into = np.linalg.inv(_transform(frame, segment))
            xyz = _in_world(xyz, self._image(segment, "lidar_pose", stamp, 6)[is_point].astype(np.float64))
            xyz = xyz @ into[:3, :3].T + into[:3, 3]
        place, boxes, numbers = extrinsic[:3, 3], None, None
        points = np.column_stack([xyz - place, np.tanh(image[..., 1][is_point])]).astype(np.float32)
        if "lidar_box" in files:
            rows = [row[1:] for row in self._rows(files["lidar_box"], *_BOX) if row[0] == stamp]
            boxes = [
                upright_box(_KINDS[kind], np.array(of[:3]) - place, of[3:], (0.0, 0.0, yaw)) for kind, yaw, *of in rows
            ]
        if "lidar_segmentation" in files and (_TOP, stamp) in self._of(segment, "lidar_segmentation").groups:
            numbers = self._image(segment, "lidar_segmentation", stamp, 2)[is_point][:, 1].astype(np.uint64)
        return Labeled(points, boxes, numbers)

    def _of(self, segment: str, part: str) -> LargeRows:
        column = f"[{_IMAGES[part]}Component].range_image_return1"
        return self._images(self._files[part][segment], (_LASER, _STAMP), (f"{column}.values", f"{column}.shape"))

    def _image(self, segment: str, part: str, stamp: int, channels: int) -> NDArray[Any]:
        values, shape = self._of(segment, part).read((_TOP, stamp))
        rows, columns, depth = shape[0].as_py()
        if depth != channels:
            raise ValueError(f"{part}: {depth} channels; expected {channels}")
        return np.reshape(values.flatten().to_numpy(), (rows, columns, depth))


def _transform(values: Any, segment: str) -> Floats:
    return rigid(f"a transform of {segment}", np.reshape(values, (4, 4)), PointsError)


def _measured(ranges: NDArray[Any], is_point: NDArray[Any], extrinsic: Floats, beams: Floats) -> Floats:
    """Points (n, 3) in the vehicle's frame. Columns of ``ranges`` go clockwise from the vehicle's rear."""
    if beams.shape != ranges.shape[:1] or not np.isfinite(beams).all():
        raise ValueError(f"{beams.shape} inclinations; expected {len(ranges)} finite ones, as the range image has rows")
    row, column = np.nonzero(is_point)
    azimuth = math.pi * (1.0 - (2 * column + 1) / ranges.shape[1]) - math.atan2(extrinsic[1, 0], extrinsic[0, 0])
    flat = np.cos(beams[row])
    rays = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(beams[row])])
    return rays * ranges[is_point, None] @ extrinsic[:3, :3].T + extrinsic[:3, 3]


def _in_world(xyz: Floats, poses: Floats) -> Floats:
    """Points (n, 3), which are changed, of vehicles with poses (n, 6): roll, pitch, yaw [rad], x, y, z."""
    if not np.isfinite(poses).all():
        raise ValueError("poses of points that are not finite")
    for angle, a, b in zip(poses.T, (1, 2, 0), (2, 0, 1), strict=False):
        cos, sin = np.cos(angle), np.sin(angle)
        xyz[:, a], xyz[:, b] = cos * xyz[:, a] - sin * xyz[:, b], sin * xyz[:, a] + cos * xyz[:, b]
    return xyz + poses[:, 3:]
