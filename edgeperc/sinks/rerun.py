"""A run as a recording of the Rerun viewer."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import PerceivedScan
from ..system.extras import require
from ..system.printable import printable
from ..types.frame import ModelFrame
from ..types.mounting import MODEL_HEIGHT_M
from ..types.perception import Box, TopView
from ..view.colors import byte_colors
from ..view.content import box_text, drivable_strips, track_text
from .run_file import Pipe, RunFile
from .scene import Trails, checked_target, colored_points, nanoseconds

__all__ = ["RerunSink"]

# The SDK writes in a thread of its own and waits for ever if that has failed, so it writes to a pipe. Where there is
# none, space is checked beforehand: a point takes 20 bytes; the rest of a scan less than 8 MB.
_HAS_PIPES = hasattr(os, "mkfifo")
_POINT_BYTES, _ROOM_BYTES = 20, 8 * 2**20
_PATIENCE_S = 60.0
_RADIUS = -1.2  # a negative one is in points of the screen
_BACKGROUND = [11, 15, 20]
_TRACKED = "world/lidar/tracked"


class RerunSink:
    """Writes a run to a recording (.rrd) of the Rerun viewer: ``rerun OUT.rrd`` shows it.

    The timeline ``stamp`` has the times of the scans. Entities:

    ==========================  ====================================================================================
    ``/world``                  classes with their colors
    ``/world/lidar``            the sensor's pose: that of the tracker, or none
    ``/world/lidar/points``     finite points, their remission, class and color
    ``/world/lidar/boxes``      boxes with class and score that no track has
    ``/world/lidar/tracked``    those that a track has, which the view leaves out: it shows the boxes of the tracks
    ``/world/lidar/drivable``   the drivable cells, as a mesh
    ``/world/tracks``           boxes of the tracks with id, class and speed
    ``/world/trails``           the way of each track so far
    ``/status/STAGE``           processing time [ms] of each stage; ``/status/health`` is the health of a live answer
    ==========================  ====================================================================================

    Parameters
    ----------
    path : str or Path
        The file; it replaces an existing one when the sink is closed, unless it is not whole (`Sink.close`).

    Raises
    ------
    MissingExtraError
        rerun-sdk is not installed.
    OSError
        The file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self._rr: Any = require("rerun", "rerun", "Writing a recording for Rerun", package="rerun-sdk")
        require("rerun.blueprint", "rerun", "Writing a recording for Rerun", package="rerun-sdk")
        self._path = checked_target(path)
        self._recording: Any = None
        self._trails = Trails()
        self._classes: dict[str, int] = {}
        self._pipe: Pipe | None = None

    def _start(self) -> None:
        """Open the file: with the first scan, so that a run without answers replaces no file."""
        self._file = RunFile(self._path)
        rr, views = self._rr, self._rr.blueprint
        recording = rr.RecordingStream("edgeperc")
        # The view moves with the sensor and looks ahead from behind and above it.
        eye = views.EyeControls3D(position=(-14.0, 0.0, 9.0), look_target=(12.0, 0.0, -1.7), eye_up=(0.0, 0.0, 1.0))
        seen = views.Spatial3DView(
            origin="/world/lidar",
            contents=["/world/**", f"- /{_TRACKED}"],
            background=_BACKGROUND,
            eye_controls=eye,
            name="scan",
        )
        times = views.TimeSeriesView(origin="/status", name="stages [ms]")
        layout = views.Blueprint(views.Vertical(seen, times, row_shares=[4, 1]), collapse_panels=True)
        recording.set_log_time_enabled(False)
        self._recording = recording
        try:
            self._pipe = Pipe(self._file) if _HAS_PIPES else None
            recording.save(self._file.place if self._pipe is None else self._pipe.path, default_blueprint=layout)
        except (OSError, RuntimeError) as exc:
            self._file.fail(OSError(errno.EIO, f"the recording could not be begun ({exc})"))
        if self._pipe is not None:
            self._pipe.start()
        self._recording.log("world", self._rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan. Raises PointsError for other points than perceived or a time that viewers lack, OSError."""
        points, labels, classes, colors = colored_points(scan)
        stamp_ns = nanoseconds(scan)
        if self._recording is None:
            self._start()
        self._file.check()
        room_bytes = len(points) * _POINT_BYTES + _ROOM_BYTES
        if not _HAS_PIPES and shutil.disk_usage(os.path.realpath(self._path.parent)).free < room_bytes:
            self._file.fail(OSError(errno.ENOSPC, "the recording does not fit on the disk"))
            self._file.check()
        rr, log = self._rr, self._recording.log
        self._recording.set_time("stamp", duration=np.timedelta64(stamp_ns, "ns"))
        view, tracks = scan.perception.top_view, scan.tracked
        boxes = [*scan.perception.boxes, *(track.box for track in tracks or ())]
        self._annotate([*classes, *(view.classes if view is not None else ()), *(box.label for box in boxes)])
        shown = np.isfinite(points[:, :3]).all(axis=1)
        ids = np.array([self._classes[name] for name in classes], np.uint16)[labels[shown]]
        log("world/lidar/points", rr.Points3D(points[shown, :3], colors=colors[shown], class_ids=ids, radii=_RADIUS))
        log("world/lidar/points", rr.AnyValues(remission=points[shown, 3]))
        of_tracks = set() if tracks is None else set(tracks.sources.tolist())
        for name, is_tracked in (("world/lidar/boxes", False), (_TRACKED, True)):
            listed = [box for k, box in enumerate(scan.perception.boxes) if (k in of_tracks) == is_tracked]
            log(name, self._boxes(listed, [box_text(box) for box in listed], show=tracks is None))
        if view is not None:
            log("world/lidar/drivable", self._drivable(view, ModelFrame(scan.perception.mounting)))
        if tracks is not None:
            pose = tracks.T_world_sensor
            log("world/lidar", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
            trails = self._trails.update(tracks)
            track_boxes = [track.world_box for track in tracks]
            log("world/tracks", self._boxes(track_boxes, [track_text(track) for track in tracks], show=True))
            ways = [trails[track.id] for track in tracks]
            log("world/trails", rr.LineStrips3D(ways, class_ids=self._ids(track_boxes), show_labels=False))
        for name, ms in scan.perception.stage_ms.items():
            log(["status", printable(name)], rr.Scalars(ms))
        if scan.health is not None:
            level = {"OK": "INFO", "LATE": "WARN"}.get(scan.health, "ERROR")
            log("status/health", rr.TextLog(scan.health, level=level))
        self._flush(self._recording)
        self._file.check()

    def _annotate(self, names: list[str]) -> None:
        """Number the classes in the order in which they come; static, so a new class is shown in earlier scans, too."""
        known = len(self._classes)
        for name in names:
            self._classes.setdefault(name, len(self._classes))
        if len(self._classes) > known:
            colors = byte_colors(self._classes).tolist()
            context = [(k, printable(name), tuple(colors[k])) for name, k in self._classes.items()]
            self._recording.log("world", self._rr.AnnotationContext(context), static=True)

    def _ids(self, boxes: Any) -> NDArray[np.uint16]:
        return np.array([self._classes[box.label] for box in boxes], np.uint16)

    def _boxes(self, listed: list[Box], texts: list[str], *, show: bool) -> Any:
        yaws = np.array([box.yaw for box in listed]) / 2.0
        turns = np.column_stack([np.zeros((len(listed), 2)), np.sin(yaws), np.cos(yaws)])
        return self._rr.Boxes3D(
            centers=np.array([box.center for box in listed]).reshape(-1, 3),
            sizes=np.array([box.size for box in listed]).reshape(-1, 3),
            quaternions=turns,
            class_ids=self._ids(listed),
            labels=texts,
            fill_mode="majorwireframe",
            show_labels=show,
        )

    def _drivable(self, view: TopView, frame: ModelFrame) -> Any:
        """Two triangles for each run of drivable cells along a row."""
        row, first, last = drivable_strips(view).T
        far, left = view.x_range_m[1] - view.cell_m * row, view.y_range_m[1] - view.cell_m * first
        near, right = far - view.cell_m, view.y_range_m[1] - view.cell_m * last
        x, y = np.stack([far, far, near, near], axis=1), np.stack([left, right, right, left], axis=1)
        corners = np.stack([x, y, np.full(x.shape, -MODEL_HEIGHT_M)], axis=2).reshape(-1, 3)
        triangles = 4 * np.arange(len(row))[:, None] + np.array([0, 2, 1, 0, 3, 2])
        color = [*byte_colors(["drivable"])[0].tolist(), 160]
        return self._rr.Mesh3D(
            vertex_positions=((corners - frame.t) @ frame.R).astype(np.float32),
            triangle_indices=triangles.reshape(-1, 3).astype(np.uint32),
            albedo_factor=color,
        )

    def _flush(self, recording: Any) -> None:
        try:
            recording.flush(timeout_sec=_PATIENCE_S)
        except RuntimeError as exc:
            self._file.fail(OSError(errno.EIO, f"the recording could not be written ({exc})"))

    def close(self, whole: bool = True) -> None:
        """Finish the file; see `Sink.close`."""
        if self._recording is not None:
            recording, self._recording = self._recording, None
            self._flush(recording)
            recording.disconnect()
            if self._pipe is not None and not self._pipe.ends(_PATIENCE_S):
                self._file.fail(OSError(errno.EIO, "the recording could not be written in time"))
            self._file.close(whole)
