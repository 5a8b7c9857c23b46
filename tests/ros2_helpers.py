"""Clouds, what stands in place of a perceiver, and a process that publishes scans, for the tests of ROS 2."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import numpy as np

from edgeperc import Perception, PointLabels
from edgeperc.ros2.graph import SENSOR_DATA
from edgeperc.ros2.messages import CLOUD, RosMessages
from edgeperc.ros2.zenoh_graph import ZenohGraph
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate
from edgeperc.types.sensor import get_sensor
from waiting import TIMEOUT_S, until

__all__ = ["FIELDS", "MESSAGES", "Perceive", "cloud", "publish", "scans"]

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


class Perceive:
    """In place of a perceiver: every point is a car."""

    sensor = get_sensor("hdl-64e")

    def __init__(self) -> None:
        self.stamps: list[float] = []

    def __call__(self, points: np.ndarray, *, stamp_s: float) -> Perception:
        self.stamps.append(stamp_s)
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
        output = graph.advertise("/points", CLOUD, SENSOR_DATA)
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
