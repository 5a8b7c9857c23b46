"""The ``edgeperc`` command: ``demo``, ``run``, ``info``, ``adapt``, ``eval``, ``eval sensors`` and ``eval tracking``.

Exit codes: 0 all is well, 1 some scans failed (each is reported, the others are done), 2 nothing could be done
(usage, model, provider, a missing extra), 130 interrupted, 141 the reader of the output went away.
"""

from __future__ import annotations

import argparse
import io
import math
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

# What takes long to import (numba's kernels, onnxruntime, matplotlib) is imported where a command needs it.
from .. import __version__
from ..errors import EdgepercError
from ..zoo import DEFAULT
from .adapt import fit_command
from .demo import demo_command
from .eval import eval_command, eval_sensors_command, eval_tracking_command
from .info import info_command
from .output import complain, show_warning
from .run import run_command

__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments without the program's name; by default those of this process.

    Returns
    -------
    code : int
        The exit code; wrong usage leaves by argparse's ``SystemExit(2)``.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    # argparse knows no commands of a command that takes paths, too; a data set called so is given as ./tracking.
    spelled = (
        [f"eval-{words[1]}", *words[2:]]
        if words[:1] == ["eval"] and words[1:2] in (["sensors"], ["tracking"])
        else words
    )
    arguments = _parser().parse_args(spelled, argparse.Namespace(typed=shlex.join(["edgeperc", *words])))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # file names need not fit the terminal's encoding
    try:
        with warnings.catch_warnings():
            warnings.showwarning = show_warning
            code: int = arguments.command(arguments)
            sys.stdout.flush()
            return code
    except EdgepercError as exc:
        complain(exc)
        return 2
    except BrokenPipeError:
        # Python flushes stdout once more on its way out, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as exc:
        complain(exc)
        return 2
    except KeyboardInterrupt:
        complain("interrupted")
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edgeperc", description="A LiDAR scan in, perception out: drivable area, boxes, a class for every point."
    )
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    sensing = argparse.ArgumentParser(add_help=False)
    sensing.add_argument(
        "--sensor",
        default="hdl-64e",
        metavar="NAME",
        help="what took the scans: a built-in name, or a .json file of edgeperc adapt fit (default: hdl-64e)",
    )
    running = argparse.ArgumentParser(add_help=False)
    running.add_argument(
        "--model",
        action="append",
        metavar="NAME",
        help=f"a shipped model or an .onnx with a card; may be repeated (default: {' and '.join(DEFAULT)})",
    )
    running.add_argument("--provider", default="auto", metavar="P", help="cpu, openvino, cuda, ... (default: auto)")
    running.add_argument("--threads", type=_positive, metavar="N", help="threads inside a model (default: its choice)")
    running.add_argument(
        "--boxes-from",
        choices=("both", "network", "clusters"),
        default="both",
        help="boxes of the top-view model, those around clusters of labelled points, or both (default: both)",
    )
    running.add_argument(
        "--all-around", action="store_true", help="run a range-image model on every part of the turn, not ahead alone"
    )

    adapted = argparse.ArgumentParser(add_help=False)
    adapted.add_argument(
        "--adapt",
        choices=("both", "remission", "interpolation", "neither"),
        default="both",
        help="of a sensor unlike the models': render its remission, fill between its beams (default: both)",
    )

    demo = commands.add_parser("demo", parents=[running], help="perceive the bundled scene: a table and a picture")
    demo.add_argument("--out", type=Path, default=Path("edgeperc-demo"), metavar="DIR", help="default: edgeperc-demo")
    demo.set_defaults(command=demo_command)

    run = commands.add_parser(
        "run",
        parents=[sensing, running, adapted],
        help="perceive scans",
        description="Perceive scans: a line each on the terminal, and the files asked for in DIR.",
    )
    run.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="scans, folders of scans, or captures: .pcap, .osf, .bag, .mcap, a ROS 2 bag's folder (extra 'io')",
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="where files go; NAME.png and so on")
    run.add_argument("--json", action="store_true", help="one JSON object a scan on the output, and nothing else there")
    run.add_argument("--png", action="store_true", help="a picture of each scan (needs the extra 'view')")
    run.add_argument("--html", action="store_true", help="a page with the labelled points in 3-D, for a browser")
    run.add_argument("--labels", action="store_true", help="NAME.label: a uint32 a point, SemanticKITTI's layout")
    run.add_argument("--ply", action="store_true", help="the points with their labels and colours")
    run.add_argument("--track", action="store_true", help="follow the boxes from scan to scan: the scans are a drive")
    run.add_argument("--gif", action="store_true", help="tracks.gif: the tracks from above (needs the extra 'view')")
    run.add_argument(
        "--on-mismatch",
        choices=("warn", "raise", "ignore"),
        default="warn",
        help="a scan unlike those a model was trained on: warn, fail that scan, or say nothing (default: warn)",
    )
    run.add_argument("--topic", metavar="NAME", help="which topic of a bag, or serial number in an Ouster capture")
    run.add_argument("--live", action="store_true", help="replay one PATH in its own time; the newest scan wins")
    run.add_argument(
        "--rate", type=_rate, default=10.0, metavar="HZ", help="scans a second, where they bear no stamps (default: 10)"
    )
    run.set_defaults(command=run_command, usage_error=run.error)

    info = commands.add_parser(
        "info",
        parents=[sensing],
        help="what a model is; what a scan looks like and which models it suits",
    )
    info.add_argument("things", nargs="+", metavar="MODEL|SCAN", help="a shipped model's name, an .onnx, or a scan")
    info.add_argument("--json", action="store_true", help="print a model's card as it is, one line of JSON a model")
    info.set_defaults(command=info_command)

    adapting = commands.add_parser("adapt", help="make a sensor known: fit its remission to another's")
    fits = adapting.add_subparsers(required=True, metavar="fit")
    fit = fits.add_parser(
        "fit",
        help="write a sensor profile for --sensor",
        description="Fit a function that renders a sensor's remission as another's, from scans of any streets, the "
        "more the better: equal shares of the points of both sensors are taken to be equally bright.",
    )
    fit.add_argument("scans", nargs="+", type=Path, metavar="SCAN", help="scans, or folders of scans")
    fit.add_argument("--sensor", required=True, metavar="NAME", help="what took them: a built-in name or a .json file")
    fit.add_argument("--to", default="hdl-64e", metavar="NAME", help="whose remission to render (default: hdl-64e)")
    fit.add_argument("--out", type=Path, required=True, metavar="FILE", help="the profile, a .json file")
    fit.set_defaults(command=fit_command)

    judge = commands.add_parser(
        "eval",
        help="the papers' figures on labelled scans",
        description="Hold what models say of labelled scans against the truth: points, boxes, top view and road, over "
        "all distances and by range, with 95 % intervals over drives.",
    )
    judge.add_argument(
        "datasets",
        nargs="+",
        metavar="DATASET",
        help="the root of a KITTI object set or of SemanticKITTI, or simulation:N for N simulated scans (default: 24)",
    )
    judge.add_argument("--model", action="append", metavar="NAME", help="as in run")
    judge.add_argument(
        "--split", choices=("test", "train", "all"), help="which drives (default: test, or those of --fold)"
    )
    judge.add_argument("--fold", type=int, choices=(0, 1, 2), help="the drives held back by this fold of the training")
    judge.add_argument(
        "--road-by", metavar="NAME", help="another top-view model whose drivable cells count as true on KITTI"
    )
    judge.add_argument(
        "--boxes-from", choices=("network", "clusters", "both"), default="network", help="as in run (default: network)"
    )
    judge.add_argument("--json", type=Path, metavar="FILE", help="every figure, also those without a table")
    judge.add_argument("--worst", type=Path, metavar="PNG", help="a picture of the scans with most mistakes")
    judge.add_argument("--provider", default="cpu", metavar="P", help="as in run (default: cpu)")
    judge.set_defaults(command=eval_command)

    follow = commands.add_parser(
        "eval-tracking",
        parents=[sensing, running, adapted],
        prog="edgeperc eval tracking",
        help="the tracking figures on KITTI's sequences; also written: eval tracking",
        description="Track the given detections of KITTI's sequences, without ego poses, and hold the tracks against "
        "the labels: CLEAR-MOT at the score with the best MOTA, its averages over forty recalls, HOTA. With --model, "
        "and where there are no detections, the scans are perceived, and what is found in them is tracked.",
    )
    follow.add_argument(
        "root",
        type=Path,
        metavar="ROOT",
        help="holds label_02, calib, and detections/DETECTOR_CLASS or velodyne; or an object set with track_id",
    )
    follow.add_argument("--sequences", nargs="+", metavar="SEQ", help="such as 0000 0002 (default: all with labels)")
    follow.add_argument(
        "--classes",
        nargs="+",
        choices=("car", "pedestrian", "cyclist", "vehicle"),
        default=["car", "pedestrian", "cyclist"],
        metavar="CLASS",
        help="of car, pedestrian, cyclist (all three by default) and vehicle: cars, vans and trucks (with --boxes)",
    )
    follow.add_argument(
        "--boxes",
        type=Path,
        metavar="FILE",
        help="boxes to track in place of either: what run --json printed of the one sequence's scans",
    )
    follow.add_argument("--iou", type=float, default=0.25, metavar="X", help="3-D overlap of a match (default: 0.25)")
    follow.add_argument("--json", type=Path, metavar="FILE", help="every figure")
    follow.add_argument("--gif", type=Path, metavar="FILE", help="the first sequence's tracks from above")
    follow.set_defaults(command=eval_tracking_command, usage_error=follow.error)

    other = commands.add_parser(
        "eval-sensors",
        prog="edgeperc eval sensors",
        help="IoU on other sensors, without and with adaptation; also written: eval sensors",
        description="What a model is worth on scans of another sensor: with remission rendered, with interpolation, "
        "with both and with neither.",
    )
    other.add_argument(
        "datasets",
        nargs="+",
        metavar="SENSOR=SOURCE",
        help="simulation:N; a folder with velodyne/NAME.bin and label/NAME.txt; a folder of labelled range images",
    )
    other.add_argument("--model", default="pointseg", metavar="NAME", help="as in run (default: pointseg)")
    other.add_argument("--provider", default="cpu", metavar="P", help="as in run (default: cpu)")
    other.add_argument("--json", type=Path, metavar="FILE", help="every figure")
    other.set_defaults(command=eval_sensors_command)
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is no number of threads; expected 1 or more")
    return value


def _rate(text: str) -> float:
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{value} is no rate; expected scans a second, above 0")
    return value


if __name__ == "__main__":
    sys.exit(main())
