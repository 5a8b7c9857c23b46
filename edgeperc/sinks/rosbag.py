"""A ROS 2 bag of the answers of a run."""

from __future__ import annotations

import errno
import inspect
import os
import sqlite3
from contextlib import closing, suppress
from typing import Any, Literal

from ..errors import OptionError
from ..records import PerceivedScan
from ..ros2.messages import OUTPUTS, RosMessages, nanoseconds
from ..system.atomic import beside
from ..system.extras import require
from ..system.fields import OPTIONS
from .run_file import settle

__all__ = ["TOPICS", "BagSink"]

TOPICS = {name: "/diagnostics" if name == "diagnostics" else f"/edgeperc/{name}" for name in OUTPUTS}
"""The topic of each message of `edgeperc.ros2.messages.OUTPUTS`."""


class BagSink:
    """Writes a ROS 2 bag: points with their classes, markers, the grid, detections and diagnostics of every scan.

    The folder is made with the first scan, so a run in which every scan fails leaves none behind. It has its name after
    `close`, unless it is not whole (`Sink.close`). Times of messages are those of the scans.

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
        The folder exists, or rosbags cannot write it: MCAP before 0.10, sqlite3 where a path has #, ? or %.
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
        self._folder = OPTIONS.path("folder", folder)
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
        elif {*"#?%"} & {*str(self._folder)}:  # rosbags' sqlite3 takes the path as a URI: it would write elsewhere
            raise OptionError(
                f"rosbags writes no sqlite3 at {self._folder}, for '#', '?' or '%' there; choose another place, or MCAP"
            )
        self._beside = beside(self._folder)
        # A bag's files have the name of its folder.
        self._writer = rosbag2.Writer(self._beside / self._folder.name, **how)
        self._connections: dict[str, Any] = {}
        self._error: OSError | None = None

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan; see `Sink.write`."""
        if self._error is not None:
            raise self._error
        encoded = {name: self._messages.encode(getattr(self._messages, name)(scan)) for name in OUTPUTS}
        try:
            if not self._connections:
                self._open()
            for name, data in encoded.items():
                self._writer.write(self._connections[name], nanoseconds(scan.stamp_s), data)
            if (database := self._database) is not None:
                database.commit()  # a full disk or a process that is killed costs no earlier scan
        except (OSError, sqlite3.Error) as exc:
            self._error = self._typed(exc)
            raise self._error from exc

    def _open(self) -> None:
        self._writer.open()
        typestore = self._messages.typestore
        for name, kind in OUTPUTS.items():
            self._connections[name] = self._writer.add_connection(TOPICS[name], kind, typestore=typestore)

    @property
    def _database(self) -> sqlite3.Connection | None:
        storage = getattr(self._writer, "storage", self._writer)  # at first, rosbags' writer itself
        return getattr(storage, "conn", None)

    def _typed(self, error: OSError | sqlite3.Error) -> OSError:
        number = error.errno if isinstance(error, OSError) else errno.ENOSPC if "full" in str(error) else errno.EIO
        return OSError(number or errno.EIO, getattr(error, "strerror", str(error)), str(self._folder))

    def close(self, whole: bool = True) -> None:
        """Finish the bag; see `Sink.close`. One that could not be written has no ``metadata.yaml``."""
        if not self._beside.exists():
            return
        told = self._error
        try:
            if told is None:
                self._writer.close()
        except (OSError, sqlite3.Error) as exc:
            self._error = self._typed(exc)
        if self._error is not None:
            self._abandon()
        try:
            settle(self._beside / self._folder.name, self._folder, whole and self._error is None)
        finally:
            self._beside.rmdir()
        if self._error is not None and told is None:
            raise self._error

    def _abandon(self) -> None:
        """Keep what is on the disk, without metadata that promise more."""
        folder = self._beside / self._folder.name
        with suppress(OSError, sqlite3.Error):
            if hasattr(self._writer, "abort"):  # since rosbags 0.11
                self._writer.abort()
            elif (database := self._database) is not None:
                database.close()
            for file in folder.glob("*.db3"):  # opened again, sqlite takes back what it could not on a full disk
                with closing(sqlite3.connect(file)) as again:
                    again.execute("SELECT count(*) FROM messages")
        (folder / "metadata.yaml").unlink(missing_ok=True)
