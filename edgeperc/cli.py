"""The ``edgeperc`` command: ``demo``, ``run``, ``info``, ``adapt``, ``eval``, ``eval sensors`` and ``eval tracking``.

Exit codes: 0 all is well, 1 some scans failed (each is reported, the others are done), 2 nothing could be done
(usage, model, provider, a missing extra), 130 interrupted, 141 the reader of the output went away.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import itertools
import json
import math
import os
import re
import shlex
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from . import __version__
from .errors import EdgepercError, MissingExtraError, ModelError, ModelFileError, PointsError, SensorError

# What takes long to import (numba's kernels, onnxruntime, matplotlib) is imported where a command needs it.
if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .live import Answer
    from .perceiver import Perceiver
    from .perception import Box, Perception, TopView
    from .session import Session
    from .tracking.tracker import Tracks

__all__ = ["main"]

SHIPPED = ("ssadnet", "pointseg")
# A junction with cars, a truck, pedestrians and a cyclist, most of which are found; far from the seeds that models are
# trained on.
DEMO_SCENE = (2_000_000_110, "junction")


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
            warnings.showwarning = _show_warning
            code: int = arguments.command(arguments)
            sys.stdout.flush()
            return code
    except EdgepercError as exc:
        _complain(exc)
        return 2
    except BrokenPipeError:
        # Python flushes stdout once more on its way out, and would complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as exc:
        _complain(exc)
        return 2
    except KeyboardInterrupt:
        _complain("interrupted")
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
        help=f"a shipped model or an .onnx with a card; may be repeated (default: {' and '.join(SHIPPED)})",
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
    demo.set_defaults(command=_demo)

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
    run.set_defaults(command=_run, usage_error=run.error)

    info = commands.add_parser(
        "info",
        parents=[sensing],
        help="what a model is; what a scan looks like and which models it suits",
    )
    info.add_argument("things", nargs="+", metavar="MODEL|SCAN", help="a shipped model's name, an .onnx, or a scan")
    info.add_argument("--json", action="store_true", help="print a model's card as it is, one line of JSON a model")
    info.set_defaults(command=_info)

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
    fit.set_defaults(command=_adapt_fit)

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
    judge.set_defaults(command=_eval)

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
    follow.set_defaults(command=_eval_tracking, usage_error=follow.error)

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
    other.set_defaults(command=_eval_sensors)
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


def _one_line(words: object) -> str:
    return " ".join(str(words).split())


def _complain(words: object) -> None:
    print(f"edgeperc: {_one_line(words)}", file=sys.stderr)


def _show_warning(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
    _complain(f"warning: {message}")


def _perceiver(
    arguments: argparse.Namespace,
    sensor: str,
    on_mismatch: Literal["warn", "raise", "ignore"],
    adapt: Literal["both", "remission", "interpolation", "neither"] = "both",
) -> Perceiver:
    from .perceiver import Perceiver

    try:
        return Perceiver(
            arguments.model or SHIPPED,
            sensor=sensor,
            provider=arguments.provider,
            n_threads=arguments.threads,
            on_mismatch=on_mismatch,
            adapt=adapt,
            boxes_from=arguments.boxes_from,
            all_around=arguments.all_around,
        )
    except EdgepercError:
        raise
    except ValueError as exc:  # two models of one view; no labels to cluster by
        raise ModelError(str(exc)) from exc


# run


def _run(arguments: argparse.Namespace) -> int:
    kinds = [kind for kind in ("png", "html", "labels", "ply") if getattr(arguments, kind)]
    if arguments.live and (kinds or arguments.gif or len(arguments.paths) > 1):
        arguments.usage_error("--live replays one PATH and writes no files")
    if (kinds or arguments.gif) and arguments.out is None:
        arguments.usage_error(f"--{[*kinds, 'gif'][0]} writes files; add --out DIR")
    if arguments.out is not None and not kinds and not arguments.gif:
        arguments.usage_error("--out DIR without anything to write; add --png, --html, --labels, --ply or --gif")
    if arguments.gif and not arguments.track:
        arguments.usage_error("--gif shows tracks; add --track")
    if arguments.png:
        _require_matplotlib()
    if arguments.gif:
        _require_pillow()
    scans, empty = (arguments.paths, []) if arguments.live else _find_scans(arguments.paths)
    targets = [arguments.out / name for name in _output_names(scans)] if kinds else [Path()] * len(scans)
    sources = {os.path.realpath(scan) for scan in scans}
    for file in (_file_of(target, kind) for target in targets for kind in kinds):
        if os.path.realpath(file) in sources:
            arguments.usage_error(f"{file} is one of the scans and would be overwritten; choose another --out")

    from .perception import Perception

    perceive = _perceiver(arguments, arguments.sensor, arguments.on_mismatch, arguments.adapt)
    if (arguments.labels or arguments.ply) and not any(card.view.kind == "range_image" for card in perceive.cards):
        raise ModelError("--labels and --ply need a class for every point; add a range-image model: --model pointseg")
    for target in targets if kinds else ():
        target.parent.mkdir(parents=True, exist_ok=True)
    follow = _follower(arguments.rate) if arguments.track else None
    followed: list[Tracks] = []

    progress = _Progress(len(scans))
    n_told = n_failed = 0

    def tell(source: Path, outcome: Perception | Answer | Exception, tracks: Tracks | None = None) -> None:
        nonlocal n_told, n_failed
        if isinstance(outcome, MissingExtraError):
            raise outcome
        n_told += 1
        progress.clear()
        if isinstance(outcome, Exception):
            n_failed += 1
            _complain(f"{source}: {str(outcome).removeprefix(f'{source}: ')}")
            if arguments.json:
                print(json.dumps({"scan": str(source), "error": _one_line(outcome)}), flush=True)
            return
        answer, perception = (None, outcome) if isinstance(outcome, Perception) else (outcome, outcome.perception)
        timing = None if answer is None else _timing(answer)
        if tracks is not None and arguments.gif:
            followed.append(tracks)
        if arguments.json:
            record = {"scan": str(source), "stamp_s": perception.stamp_s, "live": timing, **_record(perception, tracks)}
            print(json.dumps(record, allow_nan=False), flush=True)
        else:
            words = "  ".join(f"{key} {value}" for key, value in (timing or {}).items())
            tail = "" if tracks is None else f"  tracks: {_many(len(tracks), 'object')}"
            print(f"{source}  {words}{'  ' * bool(words)}{_summary(perception)}{tail}", flush=True)

    for folder in empty:
        tell(folder, PointsError("no scan in this folder; expected scans, captures or a ROS 2 bag's metadata.yaml"))
    started = time.perf_counter()
    for done, (scan, target) in enumerate(zip(scans, targets, strict=True), start=1):
        answers = (
            _live(perceive, follow, scan, arguments)
            if arguments.live
            else _each(perceive, follow, scan, target, kinds, arguments)
        )
        for told in answers:
            tell(*told)
        progress.show(done)
    progress.clear()
    if arguments.gif and followed:
        from .view import draw_tracks

        arguments.out.mkdir(parents=True, exist_ok=True)
        draw_tracks(followed, arguments.out / "tracks.gif")
    if n_told - len(empty) > 1:
        each_ms = 1e3 * (time.perf_counter() - started) / (n_told - len(empty))
        things = "answers" if arguments.live else "scans"
        print(f"{n_told} {things}, {n_failed} failed, {each_ms:.0f} ms each with files", file=sys.stderr)
    return 1 if n_failed else 0


Follow = Callable[["Perception"], "Tracks"]


def _follower(rate_hz: float) -> Follow:
    """What tells the tracks after a scan, of one without a stamp as after the next of a drive."""
    from .tracking.tracker import Tracker

    tracker, counted = Tracker(), itertools.count(1)

    def follow(perception: Perception) -> Tracks:
        k = next(counted)
        return tracker.update(perception.boxes, k / rate_hz if perception.stamp_s is None else perception.stamp_s)

    return follow


def _each(
    perceive: Perceiver,
    follow: Follow | None,
    path: Path,
    target: Path,
    kinds: Sequence[str],
    arguments: argparse.Namespace,
) -> Iterator[tuple[Path, Perception | Exception, Tracks | None]]:
    """Every scan of a file, those of a capture numbered, and what was perceived or what went wrong."""
    from .captures import is_capture, read_scans

    try:
        numbered = is_capture(path)
        for k, (stamp_s, points) in enumerate(read_scans(path, topic=arguments.topic)):
            name, file = (path / f"{k:06d}", target / f"{k:06d}") if numbered else (path, target)
            try:
                perception = perceive(points, stamp_s)
                tracks = None if follow is None else follow(perception)
                if kinds and numbered:
                    target.mkdir(exist_ok=True)
                _write(points, perception, {kind: _file_of(file, kind) for kind in kinds}, title=str(name))
            except (EdgepercError, OSError) as exc:
                yield name, exc, None
            else:
                yield name, perception, tracks
    except (EdgepercError, OSError) as exc:
        yield path, exc, None


def _live(
    perceive: Perceiver, follow: Follow | None, path: Path, arguments: argparse.Namespace
) -> Iterator[tuple[Path, Answer | Exception, Tracks | None]]:
    """Answers of a stream, and what went wrong, as they come."""
    from .live import stream

    with stream(path, perceive, follow, rate_hz=arguments.rate, topic=arguments.topic) as answers:
        while True:
            try:
                answer = answers.take()
            except StopIteration:
                return
            except (EdgepercError, OSError) as exc:
                yield path, exc, None
            else:
                assert answer is not None
                yield path, answer, answer.tracks


def _require_matplotlib() -> None:
    try:
        import matplotlib  # noqa: F401
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "Drawing a picture") from exc


def _require_pillow() -> None:
    try:
        import PIL  # noqa: F401
    except ImportError as exc:
        raise MissingExtraError("pillow", "view", "Drawing an animation") from exc


def _find_scans(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Scans and captures in the order given, folders opened and sorted, none twice; and the folders that hold none."""
    from .captures import is_capture, scan_files

    scans: dict[str, Path] = {}
    empty = []
    for path in paths:
        found = [path]
        if path.is_dir() and not is_capture(path):
            found = scan_files(path)
            if not found:
                empty.append(path)
        for scan in found:
            scans.setdefault(_absolute(scan), scan)
    return list(scans.values()), empty


def _output_names(scans: Sequence[Path]) -> list[Path]:
    """A name for each scan's files: its own, with as many folders before it as tell all scans apart."""
    parts = [Path(_absolute(scan)).parts[1:] for scan in scans]
    names: list[Path] = []
    for depth in range(1, max(map(len, parts), default=0) + 1):
        names = [Path(*of_scan[-depth:]) for of_scan in parts]
        if _all_differ(names):
            break
    bare = [name.with_name(re.sub(r"(?i)(\.pcd)?\.[^.]+$", "", name.name) or name.name) for name in names]
    return bare if _all_differ(bare) else names


def _absolute(path: Path) -> str:
    return os.path.abspath(path)  # noqa: PTH100 - resolve() follows links, and a linked scan keeps its name


def _all_differ(names: Sequence[Path]) -> bool:
    # Some file systems take A and a for the same.
    return len({str(name).casefold() for name in names}) == len(names)


def _file_of(target: Path, kind: str) -> Path:
    return target.with_name(f"{target.name}.{'label' if kind == 'labels' else kind}")


def _write(points: NDArray[np.float32], perception: Perception, wanted: Mapping[str, Path], title: str) -> None:
    from . import view

    if "png" in wanted:
        view.draw(points, perception, wanted["png"], title=title)
    if "html" in wanted:
        view.write_html(points, perception, wanted["html"], title=title)
    if "labels" in wanted:
        view.write_labels(perception, wanted["labels"])
    if "ply" in wanted:
        view.write_ply(points, perception, wanted["ply"])


def _timing(answer: Answer) -> dict[str, Any]:
    """What `run --live` says of an answer beside what was perceived."""
    return {
        "age_ms": round(1e3 * answer.age_s, 3),
        "health": answer.health,
        "scans": answer.n_scans,
        "dropped": answer.n_dropped,
    }


def _box_record(box: Box) -> dict[str, Any]:
    return {
        "label": box.label,
        "score": round(float(box.score), 4),
        "center": [round(float(v), 4) for v in box.center],
        "size": [round(float(v), 4) for v in box.size],
        "yaw": round(float(box.yaw), 5),
    }


def _road_record(top_view: TopView, boxes: Sequence[Box]) -> dict[str, Any]:
    from .drivable import road_ahead

    road = road_ahead(top_view, boxes)
    widths = {"free_ahead_m": road.free_ahead_m(), "lane_width_m": road.lane_width_m}
    return {
        "outline": [[round(float(v), 2) for v in corner] for corner in road.outline],
        **{name: None if math.isnan(value) else round(value, 2) for name, value in widths.items()},
    }


def _record(perception: Perception, tracks: Tracks | None = None) -> dict[str, Any]:
    """What `run --json` says of a scan. Keys are always all there; null where no model of that kind took part."""
    return {
        "n_points": perception.n_points,
        "n_dropped": perception.n_dropped,
        "stage_ms": {name: round(ms, 3) for name, ms in perception.stage_ms.items()},
        "providers": dict(perception.providers),
        "boxes": [_box_record(box) for box in perception.boxes],
        "drivable_area_m2": None if perception.top_view is None else round(perception.top_view.drivable_area_m2, 2),
        "road": None if perception.top_view is None else _road_record(perception.top_view, perception.boxes),
        "point_counts": None if perception.points is None else perception.points.counts(),
        "tracks": [
            {
                "id": track.id,
                **_box_record(track.box),
                "velocity": [round(float(v), 3) for v in track.velocity],
                "age_s": round(track.age_s, 3),
                "hits": track.hits,
                "coasting": track.coasting,
                "modes": {name: round(share, 4) for name, share in track.modes.items()},
            }
            for track in tracks or ()
        ],
        "fitness": list(perception.fitness),
    }


def _tally(perception: Perception) -> str:
    if perception.points is None:
        return ""
    counts = perception.points.counts()
    return ", ".join(f"{name} {counts[name]:,}" for name in perception.points.classes[1:])


def _summary(perception: Perception) -> str:
    words = [f"{perception.n_points:,} points", f"{sum(perception.stage_ms.values()):.1f} ms"]
    if perception.top_view is not None:
        words.append(f"drivable {perception.top_view.drivable_area_m2:.1f} m2")
    labels = [box.label for box in perception.boxes]
    boxes = ", ".join(f"{labels.count(label)} {label}" for label in dict.fromkeys(labels))
    words.append(f"boxes: {boxes or 'none'}")
    if perception.points is not None:
        words.append(f"points: {_tally(perception)}")
    return "  ".join(words)


class _Progress:
    """A bar on stderr, where that is a terminal and there is more than one scan."""

    def __init__(self, total: int) -> None:
        self.total = total
        self.live = total > 1 and sys.stderr.isatty()
        self.started = time.perf_counter()
        self.show(0)

    def show(self, done: int) -> None:
        if not self.live:
            return
        left_s = (time.perf_counter() - self.started) / max(done, 1) * (self.total - done)
        bar = "#" * (30 * done // self.total)
        words = f", {left_s:.0f} s left" if done else ""
        sys.stderr.write(f"\r\x1b[K[{bar:<30}] {done}/{self.total}{words}")
        sys.stderr.flush()

    def clear(self) -> None:
        if self.live:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()


@contextlib.contextmanager
def _counted() -> Iterator[Callable[[int, int], None]]:
    """What shows how many are done, of how many: a bar that learns the latter when it is first called."""
    bars: list[_Progress] = []

    def show(done: int, total: int) -> None:
        bars[:] = bars or [_Progress(total)]
        bars[0].show(done)

    yield show
    for bar in bars:
        bar.clear()


# demo


def _demo(arguments: argparse.Namespace) -> int:
    import numpy as np

    from . import view
    from .simulation import random_scene, simulate

    perceive = _perceiver(arguments, "hdl-64e", "ignore")
    scan = simulate(random_scene(*DEMO_SCENE), "hdl-64e", DEMO_SCENE[0])
    perceive(scan.points)  # the first pass over a whole scan meets cold caches
    perception = perceive(scan.points)

    rows = [("scene", f"{perception.n_points:,} points, a simulated hdl-64e in a street that is known to the cell")]
    if perception.top_view is not None:
        area_m2 = perception.top_view.drivable_area_m2
        rows.append(("drivable", f"{area_m2:.0f} m2 of the {_extent(perception)} ahead"))
    found = [_box_words(box) for box in perception.boxes] or ["none"]
    rows += [("boxes" if k == 0 else "", words) for k, words in enumerate(found)]
    if perception.points is not None:
        there = np.bincount(scan.labels[perception.points.in_view], minlength=len(perception.points.classes))
        for k, (name, count) in enumerate(perception.points.counts().items()):
            rows.append(("points" if k == 0 else "", f"{name:<12}{count:>9,}   (there are {there[k]:,})"))
    total_ms = sum(perception.stage_ms.values())
    rows.append(("time", f"{total_ms:.1f} ms: " + ", ".join(f"{k} {ms:.1f}" for k, ms in perception.stage_ms.items())))
    for k, (name, provider) in enumerate(perception.providers.items()):
        rows.append(("ran on" if k == 0 else "", f"{name}: {provider}"))

    arguments.out.mkdir(parents=True, exist_ok=True)
    page, picture = arguments.out / "scene.html", arguments.out / "scene.png"
    title = "edgeperc demo: a simulated street"
    view.write_html(scan.points, perception, page, title=title)
    try:
        view.draw(scan.points, perception, picture, title=title)
        rows.append(("picture", str(picture)))
    except MissingExtraError as exc:
        rows.append(("picture", _one_line(exc)))
    rows.append(("3-D page", f"{page} (open it in a browser)"))
    _print_rows(rows)
    return 0


def _extent(perception: Perception) -> str:
    assert perception.top_view is not None
    (x_near, x_far), (y_right, y_left) = perception.top_view.x_range_m, perception.top_view.y_range_m
    return f"{x_far - x_near:.0f} x {y_left - y_right:.0f} m"


def _box_words(box: Box) -> str:
    x, y, _ = box.center
    length, width, height = box.size
    side = f"{abs(y):4.1f} m {'left' if y >= 0 else 'right'}"
    return (
        f"{box.label:<10}{box.score:5.2f}   {math.hypot(x, y):5.1f} m away: {x:5.1f} m ahead, {side:<13}"
        f"{length:.1f} x {width:.1f} x {height:.1f} m, heading {round(math.degrees(box.yaw)):4d} deg"
    )


def _print_rows(rows: Sequence[tuple[str, str]]) -> None:
    width = max(len(name) for name, _ in rows) + 2
    for name, words in rows:
        print(f"{name:<{width}}{words}".rstrip())


# info


def _info(arguments: argparse.Namespace) -> int:
    n_failed = n_told = 0
    for thing in arguments.things:
        try:
            if arguments.json:
                print(_card(thing))
                n_told += 1
                continue
            rows = _model_rows(thing) if _is_model(thing) else _scan_rows(Path(thing), arguments.sensor)
        except (SensorError, MissingExtraError):
            raise
        except EdgepercError as exc:
            n_failed += 1
            _complain(exc)
            continue
        if n_told:
            print()
        _print_rows(rows)
        n_told += 1
    return 1 if n_failed else 0


def _is_model(thing: str) -> bool:
    """A path that exists, or looks like one, is a scan unless it ends in .onnx; any other word is a model's name."""
    path = Path(thing)
    return path.suffix == ".onnx" or not (path.exists() or path.suffix or len(path.parts) > 1)


def _open(thing: str) -> Session:
    from .models import model_path
    from .session import Session

    return Session(thing if Path(thing).suffix == ".onnx" else model_path(thing), "cpu")


def _card(thing: str) -> str:
    if not _is_model(thing):
        raise ModelFileError(f"{thing} is a scan; only models have a card")
    return _open(thing).card.to_json()


def _model_rows(thing: str) -> list[tuple[str, str]]:
    from .card import TopViewGeometry

    session = _open(thing)
    card = session.card
    channels, height, width = session.input.shape
    if isinstance(card.view, TopViewGeometry):
        (x_near, x_far), (y_right, y_left) = card.view.x_range_m, card.view.y_range_m
        seen = f"x {x_near:g}..{x_far:g} m, y {y_right:g}..{y_left:g} m, cells of {card.view.cell_m:g} m"
    else:
        up, down = card.view.row_elevations_deg[0], card.view.row_elevations_deg[-1]
        left, right = card.view.azimuth_left_deg, card.view.azimuth_right_deg
        seen = f"{height} beams from {up:g} to {down:g} deg, azimuths {left:g} to {right:g} deg"
    rows = [
        ("model", f"{card.name} {card.version}"),
        ("file", f"{session.path} ({session.path.stat().st_size / 1e6:.1f} MB)"),
        ("sha256", session.sha256),
        ("view", f"{card.view.kind}: {seen}"),
        ("input", f"{channels} x {height} x {width}: {', '.join(card.input.channels)}"),
        ("outputs", ", ".join(f"{output.name} ({output.kind})" for output in card.outputs)),
        ("classes", ", ".join(card.classes)),
    ]
    if card.box_classes:
        rows.append(("boxes", f"{', '.join(card.box_classes)}, score from {card.score_threshold:g}"))
    for name in ("training", "metrics", "parity"):
        rows += _nested(name, getattr(card, name))
    if not math.isnan(session.golden_deviation):
        rows.append(("here", f"answers within {session.golden_deviation:.2g} standard deviations of the exporter's"))
    return rows


def _nested(name: str, value: Any) -> list[tuple[str, str]]:
    """A card's free-form facts, an inner mapping's keys joined by dots; what is long by its length."""
    if isinstance(value, Mapping) and len(value) > 24:
        return [(name, f"{len(value)} entries")]
    if isinstance(value, Mapping):
        return [row for key, inner in value.items() for row in _nested(f"{name}.{key}", inner)]
    if isinstance(value, (list, tuple)) and (len(value) > 12 or any(isinstance(v, (list, Mapping)) for v in value)):
        return [(name, f"{len(value)} values")]
    if isinstance(value, (list, tuple)):
        return [(name, ", ".join(map(_one_line, value)))]
    return [(name, f"{value:.4g}" if isinstance(value, float) else _one_line(value))]


def _scan_rows(path: Path, sensor_name: str) -> list[tuple[str, str]]:
    import numpy as np

    from .adapt import render
    from .captures import read_scans
    from .models import model_path, shipped_models
    from .sensors import FitnessProfile, check_fitness, get_sensor
    from .session import Session

    sensor = get_sensor(sensor_name)
    _, points = next(read_scans(path))  # of several the first
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    rows = [("scan", str(path)), ("points", f"{len(points):,}, of which {len(points) - len(finite):,} are not finite")]
    if len(finite):
        flat = np.hypot(finite[:, 0], finite[:, 1])
        distance = np.hypot(flat, finite[:, 2])
        low, high = np.percentile(np.degrees(np.arctan2(finite[:, 2], flat)), [0.5, 99.5])
        for k, axis in enumerate(("x", "y", "z")):
            rows.append((axis, f"{finite[:, k].min():.1f} .. {finite[:, k].max():.1f} m"))
        rows.append(("range", "{:.1f} .. {:.1f} m, median {:.1f}".format(*np.percentile(distance, [0, 100, 50]))))
        rows.append(("elevation", f"{low:.1f} .. {high:.1f} deg (99 % of the points)"))
        quantiles = np.percentile(finite[:, 3], [0, 5, 50, 95, 100])
        rows.append(("remission", "least {:g}, 5 % {:g}, median {:g}, 95 % {:g}, most {:g}".format(*quantiles)))
    if sensor.remission is not None:
        points = render(points, sensor)
        rows.append(("", f"rendered as the {sensor.remission.to}'s by a {sensor.remission.kind}"))
    else:
        points = points.copy()
        points[:, 3] = (points[:, 3] + np.float32(sensor.remission_offset)) * np.float32(sensor.remission_scale)
    if not len(finite):
        return rows
    measured = FitnessProfile.from_scans([points])
    rows.append(("beams", f"about {measured.beams[0]:.0f} rows of points ({sensor.name}: {sensor.n_beams})"))
    rows.append(("ground", "not found" if measured.ground_m is None else f"at z = {measured.ground_m[0]:.1f} m"))
    for name in shipped_models():
        try:
            fitness = Session(model_path(name), "cpu").card.fitness
        except MissingExtraError as exc:
            rows.append((name, _one_line(exc)))
            continue
        if fitness is None:
            rows.append((name, "its card does not say what its training scans looked like"))
            continue
        found = check_fitness(points, FitnessProfile.from_dict(fitness), sensor)
        rows += [(name, f"as a scan of {sensor.name}: {sentence}") for sentence in found]
        if not found:
            rows.append((name, f"suits this scan, taken as one of {sensor.name}"))
    return rows


# adapt


def _adapt_fit(arguments: argparse.Namespace) -> int:
    from .adapt import fit_sensor
    from .captures import read_scans
    from .sensors import get_sensor

    paths, empty = _find_scans(arguments.scans)
    if empty:
        raise PointsError(f"{empty[0]}: no scan in this folder; expected scans or captures")
    if arguments.out.suffix != ".json":
        raise SensorError(f"{arguments.out}: a profile's name ends in .json, so that --sensor knows it for a file")
    scans = [points for path in paths for _, points in read_scans(path)]
    profile, functions = fit_sensor(scans, get_sensor(arguments.sensor), arguments.to)
    assert profile.remission is not None
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(profile.to_json() + "\n", encoding="utf-8")
    rows = [
        (f.kind, f"RMSE {f.rmse:.4f}; coefficients {', '.join(f'{c:.5g}' for c in f.coefficients)}") for f in functions
    ]
    _print_rows([*rows, ("written", f"{arguments.out}: {profile.name} with the {profile.remission.kind}")])
    return 0


# eval


def _write_figures(arguments: argparse.Namespace, figures: Mapping[str, Any]) -> None:
    """Every figure, and the command that gave them, where ``--json`` says."""
    if arguments.json is not None:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"command": arguments.typed, **figures}, indent=1, allow_nan=False)
        arguments.json.write_text(text + "\n", encoding="utf-8")


def _eval_sensors(arguments: argparse.Namespace) -> int:
    from .transfer import compare

    with _counted() as on_scan:
        figures = compare(arguments.datasets, arguments.model, provider=arguments.provider, on_scan=on_scan)
    lines = [f"{arguments.model}; IoU of points in per cent, mIoU over the classes shown"]
    for name, told in figures.items():
        rows = [
            ((kind, ""), {**told[kind]["iou"], "mean": told[kind]["mean_iou"]})
            for kind in ("neither", "remission", "interpolation", "both")
        ]
        there = ", ".join(f"{count:,} {label}" for label, count in told["both"]["n_points"].items())
        columns = [(label, label) for label in told["both"]["iou"] if label != "background"]
        title = f"{name}: {_many(told['n_scans'], 'scan')}, {there}; remission: {told['function'] or 'no function'}"
        lines += _table(title, (*columns, ("mIoU", "mean")), rows)
    print("\n".join(lines))
    _write_figures(arguments, figures)
    return 0


def _eval(arguments: argparse.Namespace) -> int:
    if arguments.worst is not None:
        _require_matplotlib()
    for file in filter(None, (arguments.json, arguments.worst)):
        file.parent.mkdir(parents=True, exist_ok=True)
    from .evaluate import evaluate

    with _counted() as on_scan:
        figures, mistakes = evaluate(
            arguments.datasets,
            arguments.model or SHIPPED,
            split=arguments.split,
            fold=arguments.fold,
            road_by=arguments.road_by,
            boxes_from=arguments.boxes_from,
            provider=arguments.provider,
            on_scan=on_scan,
        )
    print("\n".join(_figure_lines(figures)))
    _write_figures(arguments, figures)
    if arguments.worst is not None:
        from .view import draw_mistakes

        models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
        draw_mistakes(mistakes, arguments.worst, title=f"the {len(mistakes)} scans with most mistakes: {models}")
    return 0


def _eval_tracking(arguments: argparse.Namespace) -> int:
    if arguments.gif is not None:
        _require_pillow()
    if arguments.boxes is not None and len(arguments.sequences or ()) != 1:
        arguments.usage_error("--boxes are of one drive; add --sequences SEQ")
    for file in filter(None, (arguments.json, arguments.gif)):
        file.parent.mkdir(parents=True, exist_ok=True)
    from .tracking.kitti import evaluate_kitti, read_boxes, read_sequence, sequence_names, track_sequence

    names = arguments.sequences or sequence_names(arguments.root)
    of = "given detections"
    boxes: dict[str, list[list[Box]]] = {}
    if arguments.boxes is not None:
        boxes, of = {names[0]: read_boxes(arguments.boxes)}, f"boxes of {arguments.boxes}"
    elif arguments.model or not (arguments.root / "detections").is_dir():
        boxes, of = _perceived(arguments, names)
    with _counted() as on_sequence:
        figures = {"of": of} | evaluate_kitti(
            arguments.root,
            sequences=names,
            classes=arguments.classes,
            boxes=boxes,
            iou_threshold=arguments.iou,
            on_sequence=on_sequence,
        )
    print("\n".join(_tracking_lines(figures)))
    _write_figures(arguments, _without_nan(figures))
    if arguments.gif is not None:
        from .view import draw_tracks

        name = figures["sequences"][0]
        sequence = read_sequence(arguments.root, name, arguments.classes, boxes.get(name))
        draw_tracks(track_sequence(sequence)[0], arguments.gif, title=f"sequence {sequence.name}")
    return 0


def _perceived(arguments: argparse.Namespace, names: Sequence[str]) -> tuple[dict[str, list[list[Box]]], str]:
    """By sequence and frame, what the models find in the scans; and their names."""
    from .evaluate import perceive_drive
    from .tracking.kitti import sequence_scans

    scans = {name: sequence_scans(arguments.root, name) for name in names}
    for name, of in scans.items():
        if not of:
            raise PointsError(f"{arguments.root} has no scans of {name}; expected velodyne/{name}/*.bin, or detections")
    perceive = _perceiver(arguments, arguments.sensor, "ignore", arguments.adapt)
    progress, counted = _Progress(sum(map(len, scans.values()))), itertools.count(1)
    boxes = {
        name: perceive_drive(perceive, of, name, lambda: progress.show(next(counted))) for name, of in scans.items()
    }
    progress.clear()
    return boxes, "boxes of " + " and ".join(f"{card.name} {card.version}" for card in perceive.cards)


_AVERAGE_COLUMNS = (
    *(("sAMOTA", "samota"), ("AMOTA", "amota"), ("AMOTP", "amotp"), ("MOTA", "mota"), ("MOTP", "motp")),
    *(("HOTA", "hota"), ("DetA", "deta"), ("AssA", "assa"), ("fragments", "n_fragments")),
)
_COUNT_COLUMNS = (
    *(("frames", "n_frames"), ("objects", "n_objects"), ("boxes", "n_truth"), ("false alarms", "n_false")),
    *(("missed", "n_missed"), ("ID switches", "n_switches")),
)


def _tracking_lines(figures: Mapping[str, Any]) -> list[str]:
    rows = [(("", name), _without_nan({**of, **of["best"], **of["hota"]})) for name, of in figures["classes"].items()]
    told = [(("", name), _without_nan({**of, **of["told"]})) for name, of in figures["classes"].items()]
    return [
        f"{_many(len(figures['sequences']), 'sequence')}, {figures['of']}, 3-D IoU {figures['iou_threshold']}; "
        f"{figures['frames_per_s']:,.0f} scans a second in the tracker; shares in per cent",
        *_table("over forty recalls; at the best MOTA", _AVERAGE_COLUMNS, rows),
        *_table("counts at the best MOTA", _COUNT_COLUMNS, rows),
        *_table("counts of all tracks, whatever their score", _COUNT_COLUMNS, told),
    ]


def _without_nan(value: Any) -> Any:
    """The same with None for every number that is none, as JSON has it."""
    if isinstance(value, Mapping):
        return {key: _without_nan(of) for key, of in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


# Columns of the tables: heading and key. Shares are printed in per cent.
_RATES = (("precision", "precision"), ("recall", "recall"))
_POINT_COLUMNS = (*_RATES, ("IoU", "iou"), ("95 %", "iou_interval"), ("points", "n_points"), ("objects", "n_objects"))
_BOX_COLUMNS = (
    *(("AP50", "ap"), ("95 %", "ap_interval"), *_RATES, ("mIoU@.5", "mean_iou_50"), ("mIoU@.7", "mean_iou_70")),
    *(("true", "n_truth"), ("predicted", "n_predicted"), ("hits", "n_hits")),
)
_MAP_COLUMNS = (("ACC", "accuracy"), ("mAP", "mean_ap"), ("mIoU", "mean_iou"), ("95 %", "mean_iou_interval"))
_ROAD_COLUMNS = (
    *(("F1", "f1"), ("95 %", "f1_interval"), ("AP", "ap"), ("ACC", "accuracy"), ("PRE", "precision")),
    *(("REC", "recall"), ("IoU", "iou"), ("MaxF", "max_f1"), ("cells", "n_cells")),
)
_BLOCKS = {"real": "real scans with boxes", "semantickitti": "SemanticKITTI", "simulated": "simulated scans"}


def _figure_lines(figures: Mapping[str, Any]) -> list[str]:
    models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
    fold = "" if figures["fold"] is None else f", fold {figures['fold']}"
    lines = [f"{models}; {figures['split']} drives{fold}; shares in per cent, intervals over drives"]
    for block, name in _BLOCKS.items():
        if block not in figures:
            continue
        told = figures[block]
        lines += ["", f"== {name}: {_many(told['n_frames'], 'scan')}, {_many(told['n_drives'], 'drive')} =="]
        for kind, title in (("points", "points"), ("pixels", "points, each as its pixel, unrefined")):
            lines += _table(title, _POINT_COLUMNS, _class_rows(told.get(kind, {}), "n_points"))
        for kind, of_kind in told.get("boxes", {}).items():
            means = {
                band: {"mean": {"ap": rows["mean_ap"], "ap_interval": rows.get("mean_ap_interval")}}
                for band, rows in of_kind.items()
                if rows["mean_ap"] is not None
            }
            rows = [*_class_rows(of_kind, "n_truth"), *_class_rows(means, "ap")]
            lines += _table(f"boxes, {kind}", _BOX_COLUMNS, sorted(rows, key=lambda row: [*of_kind].index(row[0][0])))
        for kind, of_kind in told.get("segmentation", {}).items():
            names = next(iter(of_kind.values()))["iou"]
            columns = (*_MAP_COLUMNS, *((name, name) for name in names), ("cells", "n_cells"))
            rows = [((band, ""), {**row, **row["iou"]}) for band, row in of_kind.items() if row["n_cells"]]
            lines += _table(f"top view, {kind}; the classes' columns are IoU", columns, rows)
        rows = [((band, ""), row) for band, row in told.get("road", {}).items() if row["n_cells"]]
        lines += _table("road", _ROAD_COLUMNS, rows)
        for (band, _), row in rows[:1]:  # of all of them
            titles = ("no road", "road")
            shares = [
                ((band, f"is {name}"), dict(zip(titles, part, strict=True)))
                for name, part in zip(titles, row["confusion"], strict=True)
            ]
            lines += _table("road, confusion in shares of all cells", [(f"taken for {t}", t) for t in titles], shares)
    return lines


def _many(n: int, noun: str) -> str:
    return f"{n:,} {noun}{'s' * (n != 1)}"


def _class_rows(bands: Mapping[str, Any], count: str) -> list[tuple[tuple[str, str], Mapping[str, Any]]]:
    """A row a class and band, of those with anything to tell."""
    return [
        ((band, name), row)
        for band, rows in bands.items()
        for name, row in rows.items()
        if isinstance(row, Mapping) and (row[count] or row.get("n_predicted"))
    ]


def _table(
    title: str, columns: Sequence[tuple[str, str]], rows: Sequence[tuple[tuple[str, str], Mapping[str, Any]]]
) -> list[str]:
    if not rows:
        return []
    cells = [["", "", *(heading for heading, _ in columns)]]
    cells += [[*names, *(_cell(row.get(key)) for _, key in columns)] for names, row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for k in range(len(cells) - 1, 1, -1):
        if cells[k][0] == cells[k - 1][0]:
            cells[k][0] = ""
    lines = []
    for cell in cells:
        left = "  ".join(text.ljust(width) for text, width in zip(cell[:2], widths[:2], strict=True))
        right = "  ".join(text.rjust(width) for text, width in zip(cell[2:], widths[2:], strict=True))
        lines.append(f"  {left}  {right}".rstrip())
    return ["", title, *lines]


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, list):
        return "-".join(f"{100.0 * bound:.1f}" for bound in value)
    return f"{100.0 * value:.1f}" if isinstance(value, float) else f"{value:,}"


if __name__ == "__main__":
    sys.exit(main())
