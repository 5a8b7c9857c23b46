"""A run in Foxglove's schemas: as an MCAP file, or live over a WebSocket server.

Topics, all with the time of the scan:

=============  ==================================================================================================
``/points``    ``foxglove.PointCloud`` in ``lidar``: x, y, z, remission, red, green, blue, alpha, class; all points in
               the scan's order. The channel's metadata names the classes.
``/boxes``     ``foxglove.SceneUpdate`` in ``lidar``: a cube, its text and, if its front is known, an arrow for each
               box. The entity of a tracked box is called ``track ID``.
``/tracks``    ``foxglove.SceneUpdate`` in ``odom``: for each track its box as lines, its trail, its velocity as an
               arrow and its text; the entity is called ``track ID``. Only with a tracker.
``/drivable``  ``foxglove.Grid`` in ``base_link``: colors and class of every cell, and whether it is drivable.
``/status``    JSON: numbers of points, boxes and tracks, stage times [ms], health, fitness, providers.
``/tf``        ``foxglove.FrameTransforms``: ``base_link`` to ``lidar`` and, with a tracker, ``odom`` to ``base_link``.
=============  ==================================================================================================
"""

from __future__ import annotations

import json
import math
import socket
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import OptionError
from ..records import PerceivedScan
from ..system.extras import require
from ..system.lanes import returns
from ..system.printable import printable
from ..types.frame import ModelFrame, quaternion
from ..types.mounting import MODEL_HEIGHT_M
from ..types.perception import Box, TopView
from ..types.points import Floats
from ..view.colors import byte_colors
from ..view.content import EDGES, box_corners, box_text, packed, track_text
from . import scene
from .relay import MAX_VIEWERS, Relay
from .run_file import RunFile

__all__ = ["STATUS_SCHEMA", "McapSink", "ServeSink"]

_POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "remission")]
    + [(name, "u1") for name in ("red", "green", "blue", "alpha", "class")]
)
_CELL = np.dtype([(name, "u1") for name in ("red", "green", "blue", "alpha", "class", "drivable")])
_TYPES = {"<f4": "Float32", "|u1": "Uint8"}

# Messages that wait for a slow viewer, three scans; then the oldest are dropped. A scan has at most 6 messages, of 3 MB
# for 130,000 points.
_BACKLOG = 18
_GRACE_S = 2.0  # for viewers to take what waits, when the run has ended

STATUS_SCHEMA: dict[str, Any] = {
    "title": "edgeperc.Status",
    "type": "object",
    "properties": {
        "scan": {"type": "string"},
        "sensor": {"type": "string"},
        "health": {"type": "string"},
        "n_points": {"type": "integer"},
        "n_boxes": {"type": "integer"},
        "n_tracks": {"type": "integer"},
        "drivable_area_m2": {"type": "number"},
        "total_ms": {"type": "number"},
        "stage_ms": {"type": "object", "additionalProperties": {"type": "number"}},
        "providers": {"type": "object", "additionalProperties": {"type": "string"}},
        "fitness": {"type": "array", "items": {"type": "string"}},
    },
}
"""JSON schema of ``/status``; a key without a value is left out."""


def _sdk(part: str = "", purpose: str = "Messages for Foxglove") -> Any:
    """Foxglove's SDK, or a module in it."""
    return require(f"foxglove{part}", "foxglove", purpose, package="foxglove-sdk")


class _Channels:
    """The topics of one run, and the messages of a scan."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._messages, self._channels = _sdk(".messages"), _sdk(".channels")
        self._open: dict[str, Any] = {}
        self._trails = scene.Trails()

    def _log(self, topic: str, kind: str, message: Any, classes: Sequence[str] = ()) -> None:
        if topic not in self._open:
            metadata = {"classes": json.dumps([printable(name) for name in classes])} if classes else None
            make = getattr(self._channels, f"{kind}Channel")
            self._open[topic] = make(topic, context=self._context, metadata=metadata)
        self._open[topic].log(message, log_time=self._now)

    def write(self, scan: PerceivedScan) -> None:
        """Log the messages of a scan."""
        self._now = scene.nanoseconds(scan)
        self._stamp = self._messages.Timestamp(self._now // 10**9, self._now % 10**9)
        self._write_frames(scan)
        self._write_points(scan)
        self._write_boxes(scan)
        if scan.tracked is not None:
            self._write_tracks(scan)
        if scan.perception.top_view is not None:
            self._write_drivable(scan.perception.top_view)
        self._write_status(scan)

    def _write_frames(self, scan: PerceivedScan) -> None:
        make = self._messages
        frame = ModelFrame(scan.perception.mounting)
        transforms = [(scene.BASE, scene.LIDAR, frame.R, frame.t)]
        if scan.tracks is not None:
            pose = scan.tracks.T_world_sensor
            turned = pose[:3, :3] @ frame.R.T
            transforms.append((scene.ODOM, scene.BASE, turned, pose[:3, 3] - turned @ frame.t))
        made = [
            make.FrameTransform(
                timestamp=self._stamp,
                parent_frame_id=parent,
                child_frame_id=child,
                translation=self._vector(translation),
                rotation=make.Quaternion(**dict(zip("xyzw", quaternion(rotation), strict=True))),
            )
            for parent, child, rotation, translation in transforms
        ]
        self._log("/tf", "FrameTransforms", make.FrameTransforms(transforms=made))

    def _write_points(self, scan: PerceivedScan) -> None:
        points, labels, classes, colors = scene.colored_points(scan)
        rows = packed(_POINT, *points.T, *colors.T, 255, labels)
        message = self._messages.PointCloud(
            timestamp=self._stamp,
            frame_id=scene.LIDAR,
            pose=self._pose((0.0, 0.0, 0.0), 0.0),
            point_stride=_POINT.itemsize,
            fields=self._fields(_POINT),
            data=rows.tobytes(),
        )
        self._log("/points", "PointCloud", message, classes)

    def _write_boxes(self, scan: PerceivedScan) -> None:
        make, entities = self._messages, []
        sources = {} if scan.tracks is None else dict(zip(scan.tracks.sources.tolist(), scan.tracks.ids, strict=True))
        for k, box in enumerate(scan.perception.boxes):
            pose, color = self._pose(box.center, box.yaw), self._color(box.label, 1.0)
            cube = make.CubePrimitive(pose=pose, size=self._vector(box.size), color=self._color(box.label, 0.4))
            arrows = [] if box.front is None else [self._arrow(pose, box.size[0] / 2.0 + 1.0, color)]
            entity = make.SceneEntity(
                timestamp=self._stamp,
                frame_id=scene.LIDAR,
                id=f"track {sources[k]}" if k in sources else f"box {k}",
                metadata=self._pairs(label=printable(box.label), score=f"{box.score:.4f}"),
                cubes=[cube],
                arrows=arrows,
                texts=[self._text(box, box_text(box), color)],
            )
            entities.append(entity)
        self._update("/boxes", entities)

    def _write_tracks(self, scan: PerceivedScan) -> None:
        assert scan.tracks is not None
        make, entities, trails = self._messages, [], self._trails.update(scan.tracks)
        for track in scan.tracks:
            box, color = track.world_box, self._color(track.label, 1.0)
            dx, dy, _ = np.subtract(track.predicted(1.0, world=True).center, box.center).tolist()
            gone = math.hypot(dx, dy)
            lines = [self._line("LineList", box_corners(box)[np.ravel(EDGES)], color)]
            lines.append(self._line("LineStrip", trails[track.id], color))
            ahead = self._pose(box.center, math.atan2(dy, dx))
            entity = make.SceneEntity(
                timestamp=self._stamp,
                frame_id=scene.ODOM,
                id=f"track {track.id}",
                metadata=self._pairs(
                    label=printable(track.label), score=f"{track.score:.4f}", coasting=str(track.coasting).lower()
                ),
                lines=lines,
                arrows=[self._arrow(ahead, gone, color)] if gone > 0.5 else [],  # to where it is in a second
                texts=[self._text(box, track_text(track), color)],
            )
            entities.append(entity)
        self._update("/tracks", entities)

    def _update(self, topic: str, entities: list[Any]) -> None:
        # All older entities go, so that a viewer that missed a message shows no old box.
        make = self._messages
        gone = make.SceneEntityDeletion(timestamp=self._stamp, type=make.SceneEntityDeletionType.All)
        self._log(topic, "SceneUpdate", make.SceneUpdate(deletions=[gone], entities=entities))

    def _write_drivable(self, view: TopView) -> None:
        colors = np.moveaxis(byte_colors(view.classes)[view.labels], -1, 0)
        # Only the drivable cells are opaque. Foxglove's rows begin at the lowest x and y.
        cells = packed(_CELL, *colors, np.where(view.drivable, 160, 0), view.labels, view.drivable)
        cells = np.ascontiguousarray(cells[::-1, ::-1].T)
        message = self._messages.Grid(
            timestamp=self._stamp,
            frame_id=scene.BASE,
            pose=self._pose((*view.geometry.corner_m, -MODEL_HEIGHT_M), 0.0),
            column_count=view.labels.shape[0],
            cell_size=self._messages.Vector2(x=view.cell_m, y=view.cell_m),
            row_stride=view.labels.shape[0] * _CELL.itemsize,
            cell_stride=_CELL.itemsize,
            fields=self._fields(_CELL),
            data=cells.tobytes(),
        )
        self._log("/drivable", "Grid", message, view.classes)

    def _write_status(self, scan: PerceivedScan) -> None:
        if "/status" not in self._open:
            self._open["/status"] = _sdk().Channel("/status", schema=STATUS_SCHEMA, context=self._context)
        perception = scan.perception
        status: dict[str, Any] = {
            "scan": printable(scan.name),
            "sensor": printable(scan.sensor.name),
            "health": scan.health,
            "n_points": perception.n_points,
            "n_boxes": len(perception.boxes),
            "n_tracks": None if scan.tracks is None else len(scan.tracks),
            "drivable_area_m2": None if perception.top_view is None else perception.top_view.drivable_area_m2,
            "total_ms": sum(perception.stage_ms.values()),
            "stage_ms": {printable(name): ms for name, ms in perception.stage_ms.items()},
            "providers": {printable(name): printable(text) for name, text in perception.providers.items()},
            "fitness": [printable(line) for line in perception.fitness],
        }
        self._log("/status", "", {name: value for name, value in status.items() if value is not None})

    def _fields(self, dtype: np.dtype[Any]) -> list[Any]:
        make, kinds = self._messages, self._messages.PackedElementFieldNumericType
        return [
            make.PackedElementField(name=name, offset=offset, type=getattr(kinds, _TYPES[kind.str]))
            for name, (kind, offset, *_) in (dtype.fields or {}).items()
        ]

    def _vector(self, values: Any) -> Any:
        x, y, z = map(float, values)
        return self._messages.Vector3(x=x, y=y, z=z)

    def _pose(self, center: Any, yaw: float) -> Any:
        turned = self._messages.Quaternion(z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
        return self._messages.Pose(position=self._vector(center), orientation=turned)

    def _color(self, label: str, alpha: float) -> Any:
        r, g, b = (byte_colors([label])[0] / 255.0).tolist()
        return self._messages.Color(r=r, g=g, b=b, a=alpha)

    def _pairs(self, **texts: str) -> list[Any]:
        return [self._messages.KeyValuePair(key=key, value=value) for key, value in texts.items()]

    def _arrow(self, pose: Any, length: float, color: Any) -> Any:
        return self._messages.ArrowPrimitive(
            pose=pose, shaft_length=length, shaft_diameter=0.1, head_length=0.4, head_diameter=0.3, color=color
        )

    def _line(self, kind: str, corners: Floats, color: Any) -> Any:
        make = self._messages
        return make.LinePrimitive(
            type=getattr(make.LinePrimitiveLineType, kind),
            thickness=2.0,
            scale_invariant=True,
            points=[make.Point3(x=x, y=y, z=z) for x, y, z in corners.tolist()],
            color=color,
        )

    def _text(self, box: Box, text: str, color: Any) -> Any:
        x, y, z = box.center
        top = self._pose((x, y, z + box.size[2] / 2.0 + 0.4), 0.0)
        return self._messages.TextPrimitive(
            pose=top, billboard=True, font_size=14.0, scale_invariant=True, color=color, text=text
        )


class McapSink:
    """Writes a run to an MCAP file in Foxglove's schemas; the module's text lists the topics.

    Parameters
    ----------
    path : str or Path
        The file; it replaces an existing one when the sink is closed, unless it is not whole (`Sink.close`).

    Raises
    ------
    MissingExtraError
        foxglove-sdk is not installed.
    OptionError, OSError
        The file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        _sdk(".mcap", "Writing an MCAP file")
        self._path = scene.checked_target(path)
        if self._path.is_fifo():  # the sizes of what was written are filled in afterwards
            raise OptionError(f"{path} is a pipe, and an MCAP file is not written in order; expected a file")
        self._channels: _Channels | None = None

    def _start(self) -> _Channels:
        """Open the file: with the first scan, so that a run without answers replaces no file."""
        self._file = RunFile(self._path)
        # Of a scan of 113,000 points, zstd's level 1 takes 10 ms and its default 30 ms for the same size.
        options = _sdk(".mcap").MCAPWriteOptions(compression_level=1, compression_threads=0)
        context = _sdk().Context()
        self._writer = _sdk().open_mcap(self._file, context=context, writer_options=options)
        return _Channels(context)

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan. Raises PointsError for points that were not perceived or a time that MCAP lacks, OSError."""
        if self._channels is None:
            self._channels = self._start()
        self._file.check()
        self._channels.write(scan)
        self._file.check()

    def close(self, whole: bool = True) -> None:
        """Finish the file; see `Sink.close`."""
        if self._channels is not None:
            self._channels = None
            self._writer.close()
            self._file.close(whole)


class ServeSink:
    """Streams a run to viewers over the WebSocket server of the SDK, with the topics of `McapSink`.

    Viewers only receive. The connection is neither encrypted nor protected by a password: whoever reaches the port sees
    the scans. A slow viewer misses messages; three scans wait for it at most, and it does not delay the run. There are
    `edgeperc.sinks.relay.MAX_VIEWERS` viewers at most; others are refused, with one warning.

    Parameters
    ----------
    host : str
        Address to listen on; by default only programs on this computer can connect.
    port : int
        0 chooses a free one.

    Attributes
    ----------
    url : str
        Address for the viewer, ``"ws://HOST:PORT"``.

    Raises
    ------
    MissingExtraError
        foxglove-sdk is not installed.
    OptionError
        The address is not one of this computer, or the port is in use.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 8765) -> None:
        sdk = _sdk(purpose="Streaming to Foxglove")
        context = sdk.Context()
        self._channels = _Channels(context)
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
            listener = socket.create_server(address[:2], family=family)
        except (OSError, OverflowError, UnicodeError) as exc:
            raise OptionError(
                f"cannot listen on {host}:{port} ({exc}); expected an address of this computer and a free port"
            ) from exc
        # The SDK's server accepts any number of viewers, and never stops while one of them is silent.
        try:
            self._server = sdk.start_server(
                name="edgeperc", host="127.0.0.1", port=0, context=context, message_backlog_size=_BACKLOG
            )
        except RuntimeError as exc:
            listener.close()
            raise OptionError(f"cannot listen on 127.0.0.1 ({exc}); expected a loopback interface") from exc
        self.url = f"ws://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}"
        self._relay = Relay(listener, self._server.port)
        self._has_warned = False

    def write(self, scan: PerceivedScan) -> None:
        """Send one scan to all viewers that are connected, without waiting for them. Raises PointsError for points that
        were not perceived, and for a time that is negative or not finite.
        """
        self._channels.write(scan)
        if self._relay.n_refused and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                f"a viewer was refused: {MAX_VIEWERS} are connected to {self.url}, as many as are served",
                RuntimeWarning,
                stacklevel=2,
            )

    def close(self, whole: bool = True) -> None:
        """Close all connections, within a few seconds whatever viewers do."""
        try:
            self._relay.end(_GRACE_S)
            returns(self._server.stop, 2.0 * _GRACE_S, f"the server of {self.url} did not stop")
        finally:
            self._relay.close()
