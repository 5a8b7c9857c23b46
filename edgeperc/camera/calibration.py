"""How a camera sees what a LiDAR measures: intrinsics, pose, and the projection of points into the image."""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..errors import CalibrationError
from ..system.fields import Fields
from ..system.kernels import njit
from ..types.points import Floats, Points, by_axes, read_only
from ..types.rigid import ROW_TOLERANCE, numbers_of, rigid

_FIELDS = Fields("the calibration", CalibrationError)
MAX_EDGE, MAX_PIXELS = 2**15, 2**26  # of an image, as in `edgeperc.camera.image`
MAX_DISTANCE_M = 100.0  # between the sensors; more is probably a translation in millimeters
MAX_OFF_CENTER = 0.1  # of the image, in both directions: the lenses of KITTI, nuScenes and Waymo are off by 0.06 in one


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A pinhole camera without distortion, and its pose relative to the LiDAR.

    The camera frame is that of OpenCV and KITTI: x right, y down, z ahead [m]. The center of the top left pixel is at
    (0, 0). Rectify images of a lens with distortion first; ``K`` is then that of the rectified image.

    Attributes
    ----------
    K : (3, 3) float64, read-only
        ``[[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]]`` [px].
    T_camera_sensor : (4, 4) float64, read-only
        Moves a point of the sensor's frame into the camera's frame [m].
    width, height : int
        Size of the image [px].

    Raises
    ------
    CalibrationError
        A value is not finite or out of its bounds, ``K`` has another form or its center outside the image, or
        ``T_camera_sensor`` is not a rotation and a translation.
    """

    K: Floats
    T_camera_sensor: Floats
    width: int
    height: int

    def __post_init__(self) -> None:
        K = numbers_of("K is not an array of numbers", self.K, CalibrationError, "(3, 3)")
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise CalibrationError(f"K has shape {K.shape}; expected a finite (3, 3) matrix, got {self.K!r:.200}")
        T = rigid("T_camera_sensor", self.T_camera_sensor, CalibrationError)
        _check_matrix("K", K)
        if np.abs(T[:3, 3]).max() > MAX_DISTANCE_M:
            raise CalibrationError(
                f"T_camera_sensor has translation {T[:3, 3].tolist()}; expected at most {MAX_DISTANCE_M:g} m between "
                "camera and LiDAR (not millimeters)"
            )
        K[0, 1] = K[1, 0] = 0.0
        K[2] = 0.0, 0.0, 1.0
        object.__setattr__(self, "K", read_only(K, np.float64))
        object.__setattr__(self, "T_camera_sensor", read_only(T, np.float64))
        object.__setattr__(self, "width", _FIELDS.whole("width", self.width, 1, MAX_EDGE))
        object.__setattr__(self, "height", _FIELDS.whole("height", self.height, 1, MAX_EDGE))
        if self.width * self.height > MAX_PIXELS:
            raise CalibrationError(f"width x height is {self.width} x {self.height}; expected at most {MAX_PIXELS:,}")
        c_x, c_y = K[:2, 2].tolist()
        if not (-0.5 <= c_x <= self.width - 0.5 and -0.5 <= c_y <= self.height - 0.5):
            raise CalibrationError(
                f"K has its center at {c_x:g}, {c_y:g}, outside the image of {self.width} x {self.height} pixels; "
                "expected the size of the image that K is of. For a resized image, use calibration.resized(...)"
            )
        warn_off_center(K, self.width, self.height, "was it resized, cropped or turned since?")

    @classmethod
    def from_kitti(cls, path: str | os.PathLike[str], width: int, height: int) -> Calibration:
        """Read the calibration of KITTI's left color camera.

        Parameters
        ----------
        path : str or Path
            A ``calib`` file of the object, tracking or odometry data; of raw data, the folder of the day, or its
            ``calib_velo_to_cam.txt`` or ``calib_cam_to_cam.txt``.
        width, height : int
            Size of the image [px]. The file does not hold it; KITTI's images are 1224 to 1242 wide and 370 to 376 high.

        Returns
        -------
        Calibration

        Raises
        ------
        CalibrationError
            An entry is missing or malformed, or the values are not those of a camera.
        OSError
            The file cannot be read.
        """
        T_rectified_sensor, P2 = read_kitti_calibration(path)
        K = P2[:, :3]
        # P2 moves from the rectified frame of camera 0 to camera 2, and projects: K (p + t).
        T_camera_rectified = np.eye(4)
        T_camera_rectified[:3, 3] = np.linalg.solve(K, P2[:, 3])
        return cls(K, T_camera_rectified @ T_rectified_sensor, width, height)

    def resized(self, width: int, height: int) -> Calibration:
        """The calibration of the same image, resized to ``width`` x ``height`` [px] without a crop."""
        new = [_FIELDS.whole(name, n, 1, MAX_EDGE) for name, n in (("width", width), ("height", height))]
        scale = np.diag([new[0] / self.width, new[1] / self.height, 1.0])
        half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])  # from centers of pixels to their edges
        return Calibration(np.linalg.inv(half) @ scale @ half @ self.K, self.T_camera_sensor, width, height)

    def project(self, points: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Project points into the image.

        Parameters
        ----------
        points : (n, 3 or more) array_like, or a table
            x, y, z [m] in the sensor's frame, those of a table by their names; further columns are ignored.

        Returns
        -------
        u, v : (n,) float64
            Column and row [px]; may be outside the image. NaN for a point that is not in front of the camera, or not
            finite.
        depth_m : (n,) float64
            Distance along the optical axis [m], negative behind the camera; NaN for a point that is not finite.

        Raises
        ------
        PointsError
            ``points`` has another shape, or a table lacks x, y or z.
        """
        rows = read_only(by_axes(points))
        u, v, depth = np.empty((3, len(rows)))
        fill_projected(rows, self.K @ self.T_camera_sensor[:3], u, v, depth)
        return u, v, depth


def read_kitti_calibration(path: str | os.PathLike[str]) -> tuple[Floats, Floats]:
    """Read a calibration of KITTI's object, tracking, odometry or raw data: T_rectified_sensor (4, 4), and P2 (3, 4)
    from there to the left color image.

    path : a text file with P2, R0_rect (or R_rect) and Tr_velo_to_cam (or Tr_velo_cam), or of odometry P2 and Tr, which
        includes the rectification; of raw data the folder of a day, or either of its two files.
    """
    T_rectified_sensor, P2 = _kitti_matrices(path)
    _check_matrix(f"{path}: P2", P2)
    return rigid(f"{path}: the place of the sensor", T_rectified_sensor, CalibrationError), P2


def _kitti_matrices(path: str | os.PathLike[str]) -> tuple[Floats, Floats]:
    path = _FIELDS.path("the calibration", path)
    folder = path if path.is_dir() else path.parent
    is_raw = path.is_dir() or path.name in _RAW_FILES
    values: dict[str, Floats] = {}
    try:
        for file in [folder / name for name in _RAW_FILES] if is_raw else [path]:
            for line in file.read_text("utf-8-sig").splitlines():
                key, _, numbers = line.replace(":", " ", 1).partition(" ")
                if numbers.strip() and key != "calib_time":
                    values[key] = np.array([float(v) for v in numbers.split()])
                    if not np.isfinite(values[key]).all():
                        raise ValueError(f"{key} has a value that is not finite")
        rectify, from_velo = np.eye(4), np.eye(4)
        if is_raw:
            rectify[:3, :3] = values["R_rect_00"].reshape(3, 3)
            from_velo[:3] = np.column_stack([values["R"].reshape(3, 3), values["T"].reshape(3)])
            return rectify @ from_velo, values["P_rect_02"].reshape(3, 4)
        if "Tr" in values:
            from_velo[:3] = values["Tr"].reshape(3, 4)
        elif {"P0", "P2"} <= values.keys() and not any(key.startswith(("R0", "R_", "Tr_")) for key in values):
            raise CalibrationError(
                f"{path} lacks Tr, the place of the Velodyne: KITTI's odometry calibration comes in two downloads. "
                "Take calib.txt of data_odometry_calib.zip"
            )
        else:
            rectify[:3, :3] = values["R0_rect" if "R0_rect" in values else "R_rect"].reshape(3, 3)
            from_velo[:3] = values["Tr_velo_to_cam" if "Tr_velo_to_cam" in values else "Tr_velo_cam"].reshape(3, 4)
        return rectify @ from_velo, values["P2"].reshape(3, 4)
    except FileNotFoundError as exc:
        if not is_raw:
            raise
        raise CalibrationError(
            f"{exc.filename} is missing; the calibration of a KITTI raw drive is the folder of its day, with "
            f"{' and '.join(_RAW_FILES)}"
        ) from exc
    except CalibrationError:
        raise
    except (KeyError, ValueError) as exc:
        expected = "R, T, R_rect_00 and P_rect_02" if is_raw else "P2, R0_rect and Tr_velo_to_cam"
        raise CalibrationError(
            f"{path} holds no KITTI calibration ({type(exc).__name__}: {exc}); expected {expected}"
        ) from exc


_RAW_FILES = ("calib_velo_to_cam.txt", "calib_cam_to_cam.txt")  # of a day's drives


def _check_matrix(name: str, K: Floats) -> None:
    """Raise `CalibrationError` unless the first three columns are of a pinhole camera that is not mirrored."""
    if max(abs(K[0, 1]), abs(K[1, 0]), *np.abs(K[2, :3] - [0.0, 0.0, 1.0])) > ROW_TOLERANCE:
        raise CalibrationError(
            f"{name} is {K.tolist()}; expected [[f_x, 0, c_x], [0, f_y, c_y], [0, 0, 1]], without skew. "
            "Rectify the images first"
        )
    if not (min(K[0, 0], K[1, 1]) > 0.0 and np.abs(K[:, :3]).max() <= 1e6):
        raise CalibrationError(
            f"{name} has focal lengths {K[0, 0]:g}, {K[1, 1]:g} and center {K[0, 2]:g}, {K[1, 2]:g}; expected focal "
            "lengths above 0 and values up to 1e6 pixels"
        )


def level_heading(R_camera_sensor: Floats, yaw: ArrayLike) -> Floats:
    """Direction (3, ...) of headings in the camera's frame, level there, as those of KITTI's labels are."""
    (down_x, down_y, down_z), cos, sin = R_camera_sensor[1], np.cos(yaw), np.sin(yaw)
    return R_camera_sensor @ np.stack([cos, sin, -(down_x * cos + down_y * sin) / down_z])


def warn_off_center(K: Floats, width: int, height: int, advice: str) -> None:
    """Warn if the center of a camera matrix is far from the middle of the image in both directions."""
    c_x, c_y = K[:2, 2].tolist()
    if min(abs(c_x / width - 0.5), abs(c_y / height - 0.5)) > MAX_OFF_CENTER:
        warnings.warn(
            f"the camera matrix has its center at {c_x:g}, {c_y:g}, far from the middle of the image of {width} x "
            f"{height} pixels; expected K, or P2, of this image: {advice}",
            stacklevel=4,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def fill_projected(points: Points, P: Floats, u: Floats, v: Floats, depth: Floats) -> None:
    """Project points by P, ``K`` times the upper rows of ``T_camera_sensor``: column, row and depth of each; NaN unless
    finite, and u and v behind the camera.
    """
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        u[i] = v[i] = depth[i] = math.nan
        if not (abs(x) < math.inf and abs(y) < math.inf and abs(z) < math.inf):
            continue
        depth[i] = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
        if depth[i] > 0.0:
            u[i] = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / depth[i]
            v[i] = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / depth[i]
