"""The frame that the models work in.

The models were trained on scans of one vehicle: x forward, the road 1.73 m below the sensor. `ModelFrame` moves a scan
of any mounting into that frame, and boxes there and back.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError
from ..system.fields import OPTIONS
from ..system.kernels import njit
from .mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from .perception import Box
from .points import Floats, Floats32, Points, as_points, read_only


def model_rotation(mounting: Mounting) -> Floats:
    """R, (3, 3), from the scan's axes to those of the models; angles that are not known count as 0."""
    return MODEL_MOUNTING.rotation().T @ mounting.rotation()


class ModelFrame:
    """Moves scans into the frame of the models, and boxes back.

    Parameters
    ----------
    mounting : Mounting
        Of a known height, such as that of a perception, otherwise OptionError. Unknown angles count as 0.

    Attributes
    ----------
    is_identity : bool
        Scans need not be moved.
    R : (3, 3) float64
    t : (3,) float64
        A point p of the scan lies at ``R p + t`` [m] in the models' frame.
    eye : (3,) float64
        Where the sensor is in the models' frame [m].
    """

    def __init__(self, mounting: Mounting) -> None:
        if not isinstance(mounting, Mounting) or mounting.height_m is None:
            raise OptionError(f"mounting is {mounting!r:.200}; expected one with a height_m, as a perception has it")
        self.R: Floats = model_rotation(mounting)
        raised = MODEL_MOUNTING.rotation().T @ np.array([0.0, 0.0, mounting.height_m - MODEL_HEIGHT_M])
        self.eye: Floats = raised
        self.t: Floats = raised - self.R @ np.array([*mounting.origin_m, 0.0])
        self.is_identity = bool(np.allclose(self.R, np.eye(3), atol=1e-9) and np.allclose(self.t, 0.0, atol=1e-6))

    @classmethod
    def of_training(cls, mount_height_m: float) -> ModelFrame:
        """Where the training points of a network lie: as of the models' vehicle, but for their height."""
        return cls(replace(MODEL_MOUNTING, height_m=mount_height_m))

    def move(self, points: ArrayLike) -> Floats32:
        """A scan, as a `Perceiver` takes it, (n, 4) float32 in the models' frame, read-only; the same array if nothing
        moves.
        """
        return moved_points(points, None if self.is_identity else (self.R, self.t))

    def move_back(self, points: ArrayLike) -> Floats32:
        """Points of the models' frame as a sensor of this mounting sees them; as `move`."""
        return moved_points(points, None if self.is_identity else (self.R.T.copy(), -self.R.T @ self.t))

    def move_boxes(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Boxes of the scan's frame in the models' frame. They stay upright: a box has no tilt."""
        return moved_boxes(boxes, None if self.is_identity else (self.R, self.t))

    def boxes_back(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Boxes of the models' frame in the frame of the scan."""
        return moved_boxes(boxes, None if self.is_identity else (self.R.T, -self.R.T @ self.t))


OF_MODELS = ModelFrame(MODEL_MOUNTING)
"""Of the shipped networks, which moves nothing."""


def turned(points: Points, angle_rad: float) -> Floats32:
    """Scan (n, 4) float32 as a sensor that is turned to the left by an angle sees it, read-only."""
    result = np.empty(points.shape, np.float32)
    fill_turned(read_only(points), np.float32(math.cos(angle_rad)), np.float32(math.sin(angle_rad)), result)
    return read_only(result)


def quaternion(R: Floats) -> tuple[float, float, float, float]:
    """x, y, z, w of a rotation matrix (3, 3); w >= 0."""
    # Of these four rows, each the quaternion times four of its entries, the longest is the most exact.
    rows = np.array(
        [
            [1 + R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
            [R[1, 0] + R[0, 1], 1 - R[0, 0] + R[1, 1] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
            [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1 + R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    row = rows[np.argmax(np.diag(rows))]
    x, y, z, w = (math.copysign(1.0, row[3]) * row / np.linalg.norm(row)).tolist()
    return x, y, z, w


def poses_of(positions: Floats, quaternions: Floats) -> Floats:
    """Matrices (n, 4, 4) of positions (n, 3) and unit quaternions x, y, z, w (n, 4)."""
    x, y, z, w = quaternions.T
    poses = np.zeros((len(positions), 4, 4))
    poses[:, 0, :3] = np.column_stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)])
    poses[:, 1, :3] = np.column_stack([2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)])
    poses[:, 2, :3] = np.column_stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)])
    poses[:, :3, 3], poses[:, 3, 3] = positions, 1.0
    return poses


def pose_between(first: tuple[Floats, Floats], second: tuple[Floats, Floats], share: float) -> Floats:
    """Matrix (4, 4) at a share of the way between two poses, or after it for a share above 1: positions (3,) and unit
    quaternions x, y, z, w (4,).
    """
    (place, turn), (later_place, later_turn) = first, second
    near = later_turn if turn @ later_turn >= 0.0 else -later_turn
    # The turn goes on at one rate (slerp): a straight line of quaternions falls short of it above a share of 1.
    angle = 2.0 * math.asin(min(float(np.linalg.norm(near - turn)) / 2.0, 1.0))
    rest, gone = 1.0 - share, share
    if angle > 1e-6:
        rest, gone = math.sin(rest * angle) / math.sin(angle), math.sin(gone * angle) / math.sin(angle)
    turned = rest * turn + gone * near
    (pose,) = poses_of(((1.0 - share) * place + share * later_place)[None], (turned / np.linalg.norm(turned))[None])
    return np.asarray(pose, np.float64)


def moved_points(points: ArrayLike, motion: tuple[Floats, Floats] | None) -> Floats32:
    """A scan whose points p lie at ``R p + t`` [m], (n, 4) float32, read-only; the same array if nothing moves."""
    scan = as_points(points)
    if motion is None:
        return scan
    moved = np.empty(scan.shape, np.float32)
    fill_moved(read_only(scan), *motion, moved)
    return read_only(moved)


def moved_boxes(boxes: Iterable[Box], motion: tuple[Floats, Floats] | None) -> tuple[Box, ...]:
    """Boxes whose centers p lie at ``R p + t`` [m], with the headings that R gives them; they stay upright."""
    given, moved = OPTIONS.each("boxes", boxes, Box), []
    if motion is None:
        return given
    R, t = motion
    for box in given:
        x, y, z = (R @ np.array(box.center) + t).tolist()
        ahead = R[:, 0] * math.cos(box.yaw) + R[:, 1] * math.sin(box.yaw)
        moved.append(replace(box, center=(x, y, z), yaw=math.atan2(ahead[1], ahead[0])))
    return tuple(moved)


@njit(cache=True, nogil=True)
def fill_moved(points: Points, R: Floats, t: Floats, moved: Points) -> None:
    """Write ``R p + t`` of every point into ``moved`` (n, 4) float32, with its remission.

    moved : (n, 4) float32, overwritten; a coordinate beyond the range of float32 becomes infinite.
    """
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for axis in range(3):
            moved[i, axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z + t[axis]
        moved[i, 3] = points[i, 3]


@njit(cache=True, nogil=True)
def fill_turned(points: Points, cos: np.float32, sin: np.float32, turned: Floats32) -> None:
    """Write the points, turned about the z axis in float32 to the right, as the sensor is turned to the left."""
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        turned[i, 0] = cos * x + sin * y
        turned[i, 1] = cos * y - sin * x
        turned[i, 2] = points[i, 2]
        turned[i, 3] = points[i, 3]
