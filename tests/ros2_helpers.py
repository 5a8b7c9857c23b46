"""Clouds, what stands in place of a perceiver, and a process that publishes scans, for the tests of ROS 2."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from edgeperc import Perception, PointLabels
from edgeperc.ros2.messages import CLOUD, RosMessages
from edgeperc.ros2.zenoh_graph import ZenohGraph
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate
from edgeperc.types.sensor import get_sensor
from waiting import TIMEOUT_S, until

MESSAGES = RosMessages()
FIELDS = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]


def cloud(points: np.ndarray, stamp_ns: int = 10**9, frame_id: str = "velodyne", **changes: Any) -> bytes:
    """The bytes of a PointCloud2 with x, y, z and intensity; some of its fields replaced by impossible ones."""
    make = MESSAGES.types
    seconds = min(stamp_ns // 10**9, 2**31 - 1)
    stamp = make["builtin_interfaces/msg/Time"](sec=seconds, nanosec=stamp_ns - seconds * 10**9)
    header = make["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)
    order = ">" if changes.get("is_bigendian") else "<"
    rows = np.ascontiguousarray(points, f"{order}f4")
    fields = [
        make["sensor_msgs/msg/PointField"](name=name, offset=4 * k, datatype=7, count=1)
        for k, (name, _) in enumerate(FIELDS)
    ]
    usual = {
        "header": header,
        "height": 1,
        "width": len(points),
        "fields": fields,
        "is_bigendian": False,
        "point_step": 16,
        "row_step": 16 * len(points),
        "data": rows.view(np.uint8).reshape(-1),
        "is_dense": True,
    }
    return MESSAGES.encode(make[CLOUD](**{**usual, **changes}))


def odometry(stamp_ns: int, x: float, y: float, yaw: float, **changes: Any) -> bytes:
    """The bytes of a nav_msgs/Odometry of base_link in odom."""
    make = MESSAGES.types
    stamp = make["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    turn = {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0), **changes}
    pose = make["geometry_msgs/msg/Pose"](
        position=make["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=make["geometry_msgs/msg/Quaternion"](**turn),
    )
    still = make["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = make["geometry_msgs/msg/Twist"](linear=still, angular=still)
    return MESSAGES.encode(
        make["nav_msgs/msg/Odometry"](
            header=make["std_msgs/msg/Header"](stamp=stamp, frame_id="odom"),
            child_frame_id="base_link",
            pose=make["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36)),
            twist=make["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36)),
        )
    )


def street() -> np.ndarray:
    """Level road around an HDL-64E, a wall 12 m ahead, a crown above, and what is none of these; an even number."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-14.0, 14.0, 0.25)]))
    road = np.column_stack([x, y, np.full(x.size, -1.73)])[np.hypot(x, y) > 2.0]
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-3.0, 3.0, 0.1), np.arange(-1.43, 0.3, 0.1)))
    wall = np.column_stack([np.full(y.size, 12.1), y, z])
    crown = np.array([[5.0, 5.0, 2.5], [5.2, 5.0, 2.9]])
    none = np.array([[math.nan, 1.0, 1.0], [0.0, 0.0, 0.0], [0.2, 0.1, 0.0], [6.0, 6.0, -3.5]])
    points = np.vstack([road, wall, crown, none])[: (len(road) + len(wall) + 6) // 2 * 2]
    return np.column_stack([points, np.full(len(points), 0.3)]).astype(np.float32)


def street_kinds() -> np.ndarray:
    """What each point of the `street` is: ground, obstacle, or neither (not a return, or a reflection)."""
    points = street().astype(float)
    distance, z = np.hypot(points[:, 0], points[:, 1]), points[:, 2]
    kinds = np.where(z > -1.6, "obstacle", "ground").astype(object)
    kinds[~np.isfinite(points).all(axis=1) | (distance < 0.9) | (z < -2.3)] = "neither"
    return kinds.astype(str)


class Perceive:
    """In place of a perceiver: every point is a car."""

    sensor = get_sensor("hdl-64e")

    def __init__(self) -> None:
        self.stamps: list[float] = []
        self.earlier: list[np.ndarray] = []

    def __call__(self, points: np.ndarray, *, stamp_s: float, earlier: Sequence[Any] = ()) -> Perception:
        self.stamps.append(stamp_s)
        self.earlier.append(np.asarray(earlier))
        labels = PointLabels(np.ones(len(points), np.uint8), np.ones(len(points), np.bool_), ("background", "car"))
        return Perception(len(points), 0, labels, None, (), {"infer": 1.0}, {"m": "cpu"}, (), stamp_s)


def scans(n: int) -> list[np.ndarray]:
    """Simulated scans of an HDL-64E, with the remission 0..255 that its driver writes."""
    found = [simulate(random_scene(3, "urban"), "hdl-64e", seed=3 + k).points.copy() for k in range(n)]
    for points in found:
        points[:, 3] *= 255.0
    return found


def publish(n: int) -> None:
    """Publish scans on /points, each after the answer to the one before, then bytes that are no cloud."""
    answered = threading.Semaphore(0)
    graph = ZenohGraph("lidar", messages=MESSAGES)
    try:
        graph.subscribe("/edgeperc/points", CLOUD, lambda _: answered.release())
        output = graph.advertise("/points", CLOUD)
        until(lambda: output.is_wanted)
        for k, points in enumerate(scans(n)):
            output.publish(cloud(points, 10**18 + k * 10**8, "velodyne_hdl64e"))
            assert answered.acquire(timeout=TIMEOUT_S), f"no answer to scan {k}"
        output.publish(b"no cloud")
        time.sleep(1.0)
    finally:
        graph.close()


if __name__ == "__main__":
    publish(int(sys.argv[1]))
