"""A ROS 2 bag of the answers of a run."""

from __future__ import annotations

import inspect
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..errors import OptionError
from ..ros2.messages import OUTPUTS, RosMessages, nanoseconds
from ..system.extras import require

if TYPE_CHECKING:
    from ..records import PerceivedScan

__all__ = ["TOPICS", "BagSink"]

TOPICS = {name: "/diagnostics" if name == "diagnostics" else f"/edgeperc/{name}" for name in OUTPUTS}
"""The topic of each message of `edgeperc.ros2.messages.OUTPUTS`."""


class BagSink:
    """Writes a ROS 2 bag: points with their classes, markers, the grid, detections and diagnostics of every scan.

    The folder is made with the first scan, so a run in which every scan fails leaves none behind. It is complete after
    `close`. Times of messages are those of the scans.

    Parameters
    ----------
    folder : str or Path
        Must not exist.
    storage : {"sqlite3", "mcap"}
        Format of the file in the folder. ``"mcap"`` needs rosbags 0.10 or later.
    frame_id : str
        Frame of the messages: the sensor's.

    Raises
    ------
    OptionError
        The folder exists, or the installed rosbags writes no MCAP.
    MissingExtraError
        rosbags is not installed.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        storage: Literal["sqlite3", "mcap"] = "sqlite3",
        frame_id: str = "lidar",
    ) -> None:
        self._folder = Path(folder)
        rosbag2 = require("rosbags.rosbag2", "ros", "Writing a ROS 2 bag", package="rosbags")
        self._messages = RosMessages(frame_id)
        if self._folder.exists() or self._folder.is_symlink():
            raise OptionError(f"{self._folder} exists; a bag does not overwrite it. Choose another folder")
        # Before 0.10, rosbags' writer has no choice of format or version.
        choices = inspect.signature(rosbag2.Writer).parameters
        how: dict[str, Any] = {"version": 8} if "version" in choices else {}
        if storage == "mcap":
            if "storage_plugin" not in choices:
                raise OptionError(
                    "this rosbags writes no MCAP; run: pip install --upgrade 'rosbags>=0.10' (ouster-sdk needs "
                    "0.9.23), or choose the storage sqlite3"
                )
            how["storage_plugin"] = rosbag2.StoragePlugin.MCAP
        self._writer = rosbag2.Writer(self._folder, **how)
        self._connections: dict[str, Any] = {}

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan; see `Sink.write`."""
        encoded = {name: self._messages.encode(getattr(self._messages, name)(scan)) for name in OUTPUTS}
        if not self._connections:
            self._writer.open()
            typestore = self._messages.typestore
            for name, kind in OUTPUTS.items():
                self._connections[name] = self._writer.add_connection(TOPICS[name], kind, typestore=typestore)
        for name, data in encoded.items():
            self._writer.write(self._connections[name], nanoseconds(scan.stamp_s), data)

    def close(self) -> None:
        """Finish the bag; see `Sink.close`."""
        if self._connections:
            self._connections = {}
            self._writer.close()
