"""What viewers show of a perceived scan: colored points, texts, trails of tracks, and the frames between them.

The frames have the names that ROS users expect: ``lidar`` is that of the scan, ``base_link`` that of the models (x
forward, y left, the road at z = -1.73 m), and ``odom`` the fixed frame of the tracker.
"""

from __future__ import annotations

import errno
import os
from collections import deque
from pathlib import Path

import numpy as np

from ..errors import PointsError
from ..records import PerceivedScan
from ..system.clock import nanoseconds_of
from ..system.fields import OPTIONS
from ..tracking.tracks import Tracks
from ..types.perception import scan_of
from ..types.points import Bytes, Floats, Floats32
from ..view.colors import byte_colors
from ..view.content import in_model_frame, paint_points

BASE, LIDAR, ODOM = "base_link", "lidar", "odom"

_TRAIL = 100  # scans


def checked_target(path: str | os.PathLike[str]) -> Path:
    """A file that a run will write; `FileNotFoundError` before the first scan if its folder is missing."""
    target = OPTIONS.path("path", path)
    if not target.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "the file's folder is missing", str(target.parent))
    return target


def colored_points(scan: PerceivedScan) -> tuple[Floats32, Bytes, tuple[str, ...], Bytes]:
    """All points of a scan in its order, their labels (0 without a network of points), the classes, and their colors:
    of a background point on the road, that of its cell of the top view. Raises PointsError.
    """
    perception = scan.perception
    points = scan_of(perception, scan.points)
    point_labels = perception.points
    classes: tuple[str, ...] = ("background",) if point_labels is None else point_labels.classes
    labels = np.zeros(len(points), np.uint8) if point_labels is None else point_labels.labels
    names, painted = paint_points(in_model_frame(perception, points)[1], perception)
    return points, labels, classes, byte_colors(names)[painted]


class Trails:
    """The way of each track so far: its centers in `ODOM`, of the last 100 scans."""

    def __init__(self) -> None:
        self._ways: dict[int, deque[tuple[float, float, float]]] = {}

    def update(self, tracks: Tracks) -> dict[int, Floats]:
        """Add a scan's tracks; return the trail of each, (k, 3) float64 [m], oldest first. Others are forgotten."""
        ways = {}
        for track in tracks:
            way = self._ways.get(track.id, deque(maxlen=_TRAIL))
            way.append(track.world_box.center)
            ways[track.id] = way
        self._ways = ways
        return {id_: np.array(way) for id_, way in ways.items()}


def nanoseconds(scan: PerceivedScan) -> int:
    """The time of a scan [ns], which viewers hold as an unsigned number. Raises PointsError."""
    if not 0.0 <= scan.stamp_s < 2.0**32:
        raise PointsError(f"the scan's time is {scan.stamp_s} s; a viewer needs one from 0 to 2^32 s")
    return nanoseconds_of(scan.stamp_s)
