"""Options of ``edgeperc run`` for what is written about a whole run: see `edgeperc.sinks`."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from .output import print_line

if TYPE_CHECKING:
    from ..records import Sink


SINKS: tuple[str, ...] = (
    "mcap",
    "serve",
    "rrd",
    "play",
    "static",
    "labels_for",
    "bag",
)
"""Names of the options below as attributes of the arguments."""


def add_sinks(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    group = parser.add_argument_group("files of the whole run")
    group.add_argument(
        "--mcap",
        type=Path,
        metavar="FILE",
        help="write points, boxes, tracks, drivable cells and stage times to an MCAP file for Foxglove and other "
        "viewers (needs the extra 'foxglove'; default: none)",
    )
    group.add_argument(
        "--serve",
        type=_address,
        nargs="?",
        const=("127.0.0.1", 8765),
        metavar="HOST:PORT",
        help="stream the same to viewers while it runs, over Foxglove's WebSocket protocol; anyone who reaches "
        "HOST:PORT can watch (needs the extra 'foxglove'; without a value: 127.0.0.1:8765, this computer only; "
        "default: none)",
    )
    group.add_argument(
        "--rrd",
        type=Path,
        metavar="FILE",
        help="write a recording for the Rerun viewer (needs the extra 'rerun'; default: none)",
    )
    group.add_argument(
        "--play",
        type=Path,
        metavar="FILE",
        help="write one HTML page that plays all scans of the drive in 3-D, of at most 48 MB: scans are thinned "
        "(default: none)",
    )
    group.add_argument(
        "--static",
        type=Path,
        metavar="DIR",
        help="write every scan without its points on moving objects, as DIR/NAME in the format of the scan; scans of "
        "captures become .bin. Needs --track, or --movable (default: no scans)",
    )
    group.add_argument(
        "--movable",
        action="store_true",
        help="with --static: leave out the points on everything that could move, too: vehicles and people",
    )
    group.add_argument(
        "--labels-for",
        choices=("labelcloud", "cvat", "kitti", "sustechpoints"),
        help="write the boxes to --out as labels for an annotation tool; with --track with the ids of tracks. kitti "
        "takes the camera of --calib (a file, or a folder with one for each scan), or a nominal one (default: none)",
    )
    group.add_argument(
        "--bag",
        type=Path,
        metavar="DIR",
        help="write a ROS 2 bag, a folder that must not exist: points with classes, markers, grid, detections, "
        "diagnostics (needs the extra 'ros'; default: no bag)",
    )
    group.add_argument(
        "--bag-storage",
        choices=("sqlite3", "mcap"),
        default="sqlite3",
        help="format of the file in --bag; mcap needs rosbags 0.10 (default: %(default)s)",
    )
    group.add_argument(
        "--bag-frame", default="lidar", metavar="NAME", help="frame of the messages in --bag (default: %(default)s)"
    )


def _address(text: str) -> tuple[str, int]:
    """``HOST:PORT`` or ``PORT``."""
    host, _, port = text.rpartition(":")
    if not (port.isdecimal() and int(port) < 2**16):
        raise argparse.ArgumentTypeError(f"got {text!r}; expected HOST:PORT or PORT; write --serve after PATH")
    return host.strip("[]") or "127.0.0.1", int(port)


def wanted_sinks(arguments: argparse.Namespace) -> list[str]:
    """Names of the passed options, in the order of `SINKS`."""
    return [name for name in SINKS if getattr(arguments, name) is not None]


def open_sinks(arguments: argparse.Namespace, stack: ExitStack) -> list[Sink]:
    """Make the sinks of the passed options; errors of options and missing extras come here, before the first scan.

    The stack closes them, also those that were made before one that cannot be. What is served is closed last: the files
    are finished, whatever viewers do.
    """
    sinks: list[Sink] = []
    if arguments.serve is not None:
        from ..sinks.foxglove import ServeSink

        served = ServeSink(*arguments.serve)
        stack.callback(served.close)
        print_line(f"open {served.url} in Foxglove", sys.stderr)

    def add(sink: Sink) -> None:
        stack.callback(sink.close)
        sinks.append(sink)

    if arguments.mcap is not None:
        from ..sinks.foxglove import McapSink

        add(McapSink(arguments.mcap))
    if arguments.rrd is not None:
        from ..sinks.rerun import RerunSink

        add(RerunSink(arguments.rrd))
    if arguments.play is not None:
        from ..sinks.page import PageSink

        add(PageSink(arguments.play))
    if arguments.static is not None:
        from ..sinks.static import StaticSink

        add(StaticSink(arguments.static, without="movable" if arguments.movable else "moving"))
    if arguments.labels_for is not None:
        from ..sinks.prelabels import PrelabelSink

        add(PrelabelSink(arguments.out, arguments.labels_for, calib=arguments.calib))
    if arguments.bag is not None:
        from ..sinks.rosbag import BagSink

        add(BagSink(arguments.bag, storage=arguments.bag_storage, frame_id=arguments.bag_frame))
    if arguments.serve is not None:
        sinks.append(served)
    return sinks
