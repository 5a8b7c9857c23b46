"""Options of ``edgeperc run`` for what is written about a whole run: see `edgeperc.sinks`."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

from ..errors import EdgepercError, TrackingError
from ..records import PerceivedScan, Sink
from .arguments import options
from .output import print_error, print_line

SINKS = ("mcap", "serve", "rrd", "play", "static", "labels_for", "bag", "consistency")
"""Names of the options below as attributes of the arguments."""


def add_sinks(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = options(parser, "files of the whole run")
    group(
        "--mcap FILE",
        "write points, boxes, tracks, drivable cells and stage times to an MCAP file for Foxglove and other "
        "viewers (needs the extra 'foxglove'; default: none)",
    )
    group(
        "--serve HOST:PORT",
        "stream the same to viewers while it runs, over Foxglove's WebSocket protocol; anyone who reaches "
        "HOST:PORT can watch (needs the extra 'foxglove'; without a value: 127.0.0.1:8765, this computer only; "
        "default: none)",
        type=_address,
        nargs="?",
        const=("127.0.0.1", 8765),
    )
    group("--rrd FILE", "write a recording for the Rerun viewer (needs the extra 'rerun'; default: none)")
    group(
        "--play FILE",
        "write one HTML page that plays all scans of the drive in 3-D, of at most 48 MB: scans are thinned "
        "(default: none)",
    )
    group(
        "--static DIR",
        "write every scan without its points on moving objects, as DIR/NAME in the format of the scan; scans of "
        "captures become .bin. Needs --track, or --movable (default: no scans)",
    )
    group("--movable", "with --static: leave out the points on everything that could move, too: vehicles and people")
    group(
        "--labels-for",
        "write the boxes to --out as labels for an annotation tool; with --track those of tracks, smoothed when the "
        "drive is over, with ids. kitti "
        "takes the camera of --calib (a file, or a folder with one for each scan), or a nominal one (default: none)",
        choices=("labelcloud", "cvat", "kitti", "sustechpoints"),
    )
    group(
        "--bag DIR",
        "write a ROS 2 bag, a folder that must not exist: points with classes, markers, grid, detections, "
        "diagnostics (needs the extra 'ros'; default: no bag)",
    )
    group(
        "--bag-storage",
        "format of the file in --bag; mcap needs rosbags 0.10 (default: sqlite3)",
        choices=("sqlite3", "mcap"),
    )
    group("--bag-frame NAME", "frame of the messages in --bag (default: lidar)")
    group(
        "--consistency FILE",
        "write figures of the drive without labels as JSON, and print them: in how many of the scans that show an "
        "object it was detected, by class and distance, and how steady its class and heading were. Needs --track "
        "(default: none)",
    )


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and int(port) < 2**16):
        raise argparse.ArgumentTypeError(f"got {text!r}; expected HOST:PORT or PORT; write --serve after PATH")
    return host.strip("[]") or "127.0.0.1", int(port)


def wanted_sinks(arguments: argparse.Namespace) -> list[str]:
    """Names of the passed options, in the order of `SINKS`."""
    return [name for name in SINKS if getattr(arguments, name) is not None]


class GifSink:
    """Collects the tracks of a run, and draws them above its scans when it is over, for ``--gif``."""

    def __init__(self, path: Path) -> None:
        self._path, self._scans = path, list[tuple[Any, ...]]()  # tracks, flattened scan, mounting

    def write(self, scan: PerceivedScan) -> None:
        """Take in a scan that has tracks."""
        from ..types.points import as_points
        from ..view.tracks import flatten_scan

        if scan.tracked is not None:
            flat = flatten_scan(as_points(scan.points), scan.perception)
            self._scans.append((scan.tracked, flat, scan.perception.mounting))

    def close(self, whole: bool = True) -> None:
        """Draw the tracks, if the run is whole and there are some. Raises EdgepercError, OSError."""
        from ..view.tracks import draw_tracks

        if whole and self._scans:
            tracks, under, mountings = zip(*self._scans, strict=True)
            try:
                draw_tracks(tracks, self._path, under=under, mountings=mountings)
            except TrackingError as exc:
                raise TrackingError(f"{self._path}: {exc}") from exc


class Sinks:
    """The sinks of the passed options, made before the first scan: each gets every scan and is closed, whatever becomes
    of the others. ``n_failed`` counts what could not be written: a live answer, or the end of a file.
    """

    def __init__(self, arguments: argparse.Namespace, *, of_ports: bool = False) -> None:
        self.n_failed = 0
        self._is_live: bool = arguments.live or of_ports
        self._is_whole = True
        self._told = set[str]()
        self._sinks: list[Sink] = []
        self._stack = ExitStack()
        try:
            self._open(arguments)
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Sinks:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # A live source has no end of its own: Ctrl-C is how it ends.
        self._is_whole = kind is None or (self._is_live and not issubclass(kind, Exception))
        self._stack.close()

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan to all sinks; raises the first EdgepercError or OSError of them."""
        errors: list[Exception] = []
        for sink in self._sinks:
            try:
                sink.write(scan)
            except (EdgepercError, OSError) as exc:
                errors.append(exc)
        if errors:
            raise errors[0]

    def _open(self, arguments: argparse.Namespace) -> None:
        if arguments.gif:
            self._add(GifSink(arguments.out / "tracks.gif"))
        if not wanted_sinks(arguments):
            return
        from ..sinks.foxglove import McapSink, ServeSink
        from ..sinks.page import PageSink
        from ..sinks.prelabels import PrelabelSink
        from ..sinks.rerun import RerunSink
        from ..sinks.rosbag import BagSink
        from ..sinks.static import StaticSink

        if arguments.serve is not None:
            served = ServeSink(*arguments.serve)
            self._add(served)
            print_line(f"open {served.url} in Foxglove", sys.stderr)
        for make, path in ((McapSink, arguments.mcap), (RerunSink, arguments.rrd), (PageSink, arguments.play)):
            if path is not None:
                self._add(make(path))
        if arguments.static is not None:
            self._add(StaticSink(arguments.static, without="movable" if arguments.movable else "moving"))
        if arguments.labels_for is not None:
            calib = arguments.calib if arguments.labels_for == "kitti" else None  # else it is of the pictures alone
            self._add(PrelabelSink(arguments.out, arguments.labels_for, calib=calib))
        if arguments.bag is not None:
            storage: Literal["sqlite3", "mcap"] = arguments.bag_storage or "sqlite3"
            self._add(BagSink(arguments.bag, storage=storage, frame_id=arguments.bag_frame or "lidar"))
        if arguments.consistency is not None:
            from .evaluation.unlabeled import ConsistencySink  # it loads numba

            self._add(ConsistencySink(arguments.consistency))

    def _add(self, sink: Sink) -> None:
        """The first is closed last: files are finished before what is served ends, whatever viewers do."""
        self._sinks.append(sink)
        self._stack.callback(self._close, sink)

    def _close(self, sink: Sink) -> None:
        try:
            sink.close(self._is_whole)
        except (EdgepercError, OSError) as exc:
            self.failed("", exc)

    def failed(self, where: str, error: Exception) -> None:
        """Count what could not be written, and say so; the same error of a live run's answers once."""
        self.n_failed += 1
        if str(error) not in self._told:
            self._told.add(str(error))
            print_error(f"{where}{error}")
