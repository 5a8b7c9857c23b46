"""Where the sensor was when a cloud was made: poses of a topic of nav_msgs/Odometry, by time."""

from __future__ import annotations

import bisect
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np

from ..errors import OptionError, PointsError
from ..road.rolling import RollingGrid
from ..types.frame import pose_between
from ..types.mounting import Mounting
from ..types.points import Floats
from .graph import full_name
from .messages import RosMessages

ODOMETRY = "nav_msgs/msg/Odometry"
TOLERANCE_S = 0.2
"""A cloud may be newer than the newest pose by this; then the motion of the last `MOTION_S` is taken to go on."""
MOTION_S = 0.1
_MOST = 1000  # poses that are kept; 5 s at 200 Hz
_FARTHEST_M = 9e7  # the sensor, which is beside, is within what trackers and grids take


@dataclass(frozen=True, eq=False)
class Rolling:
    """What a node needs for a grid with memory."""

    topic: str = "/odom"  # of nav_msgs/Odometry
    # pose of the frame of the clouds in the child frame of the odometry: x, y, z [m], roll, pitch, yaw [deg]. By
    # default the two frames are one if they have one name; otherwise the sensor is above the child frame's origin,
    # mounted as the perceiver says.
    sensor_pose: Sequence[float] | None = None
    grid: RollingGrid = field(default_factory=RollingGrid)

    def __post_init__(self) -> None:
        full_name(self.topic)
        given = self.sensor_pose
        try:
            if given is not None and not (len(given) == 6 and all(map(math.isfinite, given))):
                raise ValueError("not six finite numbers")
            self.base_from_sensor("", "", Mounting())
        except (TypeError, ValueError) as exc:  # SensorError is one
            raise OptionError(
                f"sensor_pose is {given!r} ({exc}); expected x, y, z in meters, roll, pitch, yaw in degrees"
            ) from exc

    def base_from_sensor(self, child_frame: str, cloud_frame: str, mounting: Mounting) -> Floats:
        """Pose (4, 4) of the frame of the clouds in the child frame of the odometry."""
        pose = np.eye(4)
        if self.sensor_pose is not None:
            *place, roll, pitch, yaw = map(float, self.sensor_pose)
            pose[:3, :3] = Mounting(0.0, roll, pitch, yaw).rotation()
            pose[:3, 3] = place
        elif child_frame != cloud_frame:
            pose[:3, :3] = mounting.rotation()
            pose[:3, 3] = [0.0, 0.0, mounting.height_m or 0.0] - pose[:3, :2] @ mounting.origin_m
        return pose


class Poses:
    """The poses that came of late; received in a thread of the middleware, asked for in another."""

    def __init__(self, messages: RosMessages) -> None:
        self._messages, self._lock = messages, threading.Lock()
        self._poses: list[tuple[int, Floats, Floats]] = []
        self.frame_id = self.child_frame_id = ""
        self.n_failed = 0

    def receive(self, data: bytes) -> None:
        """Take the bytes of a message; what is no pose is counted."""
        try:
            message = self._messages.decode(data, ODOMETRY)
        except PointsError:
            self.n_failed += 1
            return
        pose = message.pose.pose
        place = np.array([pose.position.x, pose.position.y, pose.position.z])
        turn = np.array([getattr(pose.orientation, axis) for axis in "xyzw"])
        length = float(np.linalg.norm(turn))
        if not ((np.abs(place) < _FARTHEST_M).all() and abs(length - 1.0) < 1e-2):
            self.n_failed += 1
            return
        ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        with self._lock:
            # Later ones are of before a recording began again. A pose that came twice is taken once.
            del self._poses[bisect.bisect_left(self._poses, ns, key=itemgetter(0)) :]
            self._poses.append((ns, place, turn / length))
            del self._poses[:-_MOST]
            self.frame_id, self.child_frame_id = message.header.frame_id, message.child_frame_id

    def at(self, stamp_ns: int) -> Floats | None:
        """Pose (4, 4) of the child frame at a time, between the two around it or after the newest; None if there is
        none.
        """
        with self._lock:
            k = bisect.bisect_right(self._poses, stamp_ns, key=itemgetter(0))  # the first that is later
            if k == 0 or (k == len(self._poses) and stamp_ns - self._poses[-1][0] > TOLERANCE_S * 1e9):
                return None
            before, later = self._poses[k - 1], self._poses[min(k, len(self._poses) - 1)]
            if before is later:
                j = bisect.bisect_right(self._poses, later[0] - round(MOTION_S * 1e9), key=itemgetter(0))
                before = self._poses[max(j - 1, 0)]
        (ns, place, turn), (later_ns, later_place, later_turn) = before, later
        share = (stamp_ns - ns) / (later_ns - ns) if later_ns > ns else 0.0
        return pose_between((place, turn), (later_place, later_turn), share)
