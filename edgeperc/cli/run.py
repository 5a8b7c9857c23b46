"""``edgeperc run``: perceive scans, captures and live sources."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..errors import EdgepercError, MissingExtraError, ModelError, PointsError
from ..extras import require
from .arguments import (
    DEFAULT,
    DEFAULT_SENSOR,
    Commands,
    add_adapt,
    add_command,
    add_model,
    add_mounting,
    add_network,
    add_sensor,
    add_topic,
    positive_number,
)
from .output import many, one_line, print_error, print_line, progress
from .scans import Scans, find_scans, output_names, scan_folders, scan_namer, scan_sensor

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..live import Answer
    from ..perceiver import Perceiver
    from ..perception import Perception
    from ..sensor import SensorProfile
    from ..tracking.tracks import Tracks

__all__ = ["add_parser", "make_perceiver", "run_command"]

_KINDS = ("png", "html", "labels", "ply")


def add_parser(commands: Commands) -> None:
    """Add ``run``."""
    parser = add_command(
        commands,
        "run",
        run_command,
        help="perceive scans: a line or a JSON object for each, and files",
        description="Perceive scans and print one line for each: drivable area [m2], boxes, points of each class and "
        "processing time [ms]. If a scan fails, the error is printed, the other scans are processed, and the exit code "
        "is 1.",
        examples=[
            "edgeperc run 000123.bin",
            "edgeperc run velodyne/ --out out --png --labels",
            "edgeperc run KITTI/ --json > perceptions.jsonl",
            "edgeperc run drive.pcap --track --gif --out out",
            "edgeperc run scans/ --sensor os1-64",
            "edgeperc run velodyne/ --live --rate 10",
        ],
    )
    reading = parser.add_argument_group("input")
    reading.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="scan files (.bin, .pcd, .ply, .npy, .npz); folders of them; the root of a KITTI object set, of "
        "SemanticKITTI or of a KITTI raw drive; captures: .pcap, .osf, .bag, .mcap, a ROS 2 bag's folder (extra 'io')",
    )
    add_sensor(reading, of_capture=True)
    add_mounting(reading)
    add_topic(reading)
    reading.add_argument(
        "--on-mismatch",
        choices=("refuse", "warn", "raise", "ignore"),
        default="refuse",
        help="if a scan differs from the scans that a model was trained on. refuse: fail the scan if the difference is "
        "gross (another unit, other axes, no remission, a room), print a warning otherwise; warn: print a warning; "
        "raise: fail the scan; ignore: do not check (default: %(default)s)",
    )
    reading.add_argument(
        "--anyway",
        dest="on_mismatch",
        action="store_const",
        const="warn",
        help="perceive scans that differ grossly too, with a warning: --on-mismatch warn",
    )
    models = parser.add_argument_group("models")
    add_model(models)
    add_network(models)
    add_adapt(models)
    output = parser.add_argument_group("output")
    output.add_argument(
        "--json", action="store_true", help="print one JSON object for each scan, and nothing else, on stdout"
    )
    output.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the files below, made if needed (default: no files)"
    )
    output.add_argument("--png", action="store_true", help="write NAME.png, a picture (needs the extra 'view')")
    output.add_argument("--html", action="store_true", help="write NAME.html, the labeled points in 3-D for a browser")
    output.add_argument(
        "--labels", action="store_true", help="write NAME.label, SemanticKITTI's layout: one uint32 for each point"
    )
    output.add_argument("--ply", action="store_true", help="write NAME.ply, the points with labels and colors")
    tracking = parser.add_argument_group("tracking")
    tracking.add_argument(
        "--track", action="store_true", help="track the boxes from scan to scan; the scans must be one drive, in order"
    )
    tracking.add_argument(
        "--gif",
        action="store_true",
        help="write tracks.gif, the tracks drawn from above; needs --track, --out and the extra 'view'",
    )
    live = parser.add_argument_group("live")
    live.add_argument(
        "--live",
        action="store_true",
        help="replay one PATH in real time; always take the newest scan and drop older ones that still wait",
    )
    live.add_argument(
        "--rate",
        type=positive_number,
        default=10.0,
        metavar="HZ",
        help="scans per second, for files without time stamps with --live or --track (default: 10)",
    )


def make_perceiver(
    arguments: argparse.Namespace,
    *,
    sensor: str | SensorProfile,
    on_mismatch: Literal["refuse", "warn", "raise", "ignore"],
    adapt: Literal["both", "remission", "interpolation", "none"] = "both",
) -> Perceiver:
    """Make a perceiver with the options of the command line."""
    from ..perceiver import Perceiver

    return Perceiver(
        arguments.model or DEFAULT,
        sensor=sensor,
        provider=arguments.provider,
        precision=arguments.precision,
        n_threads=arguments.threads,
        on_mismatch=on_mismatch,
        adapt=adapt,
        boxes_from=arguments.boxes_from,
        full_turn=arguments.full_turn,
        agree=not arguments.no_agreement,
        trusted=arguments.trusted,
    )


def run_command(arguments: argparse.Namespace) -> int:
    """Perceive scans; return 1 if some failed."""
    kinds = [kind for kind in _KINDS if getattr(arguments, kind)]
    _check_usage(arguments, kinds)
    found = Scans([_live_source(arguments)], [], False) if arguments.live else find_scans(arguments.paths)
    scans = found.paths
    names = output_names(scans, keep_folder=found.of_data_set) if kinds else []
    targets = [arguments.out / name for name in names] if kinds else [Path()] * len(scans)
    sources = {os.path.realpath(scan) for scan in scans}
    for file in (_file_of(target, kind) for target in targets for kind in kinds):
        if os.path.realpath(file) in sources:
            arguments.usage_error(f"{file} is one of the scans and would be overwritten; choose another --out")

    perceivers = _Perceivers(arguments)
    perceivers.check(scans)
    for target in targets if kinds else ():
        target.parent.mkdir(parents=True, exist_ok=True)
    follow = _follower(arguments.rate) if arguments.track else None
    report = _Report(arguments)
    for folder in found.empty:
        report.add(folder, PointsError("no scan in this folder; expected scans, captures or a ROS 2 bag's folder"))
    started = time.perf_counter()
    with progress("file") as show:
        for done, (scan, target) in enumerate(zip(scans, targets, strict=True)):
            show(done, len(scans))
            outcomes = (
                _live(perceivers, follow, scan, arguments)
                if arguments.live
                else _each(perceivers, follow, scan, target, kinds, arguments)
            )
            for outcome in outcomes:
                report.add(*outcome)
    if report.tracks:
        from ..view.tracks import draw_tracks

        arguments.out.mkdir(parents=True, exist_ok=True)
        draw_tracks(report.tracks, arguments.out / "tracks.gif", under=report.under)
    n_perceived = report.n - len(found.empty)
    if n_perceived > 1:
        each_ms = 1e3 * (time.perf_counter() - started) / n_perceived
        things = "answers" if arguments.live else "scans"
        print_line(f"{report.n} {things}, {report.n_failed} failed, {each_ms:.0f} ms each with files", sys.stderr)
    return 1 if report.n_failed else 0


def _check_usage(arguments: argparse.Namespace, kinds: Sequence[str]) -> None:
    """Check for contradictory options and missing extras before any work."""
    if arguments.live and (kinds or arguments.gif or len(arguments.paths) > 1):
        arguments.usage_error("--live replays one PATH and writes no files")
    if (kinds or arguments.gif) and arguments.out is None:
        arguments.usage_error(f"--{[*kinds, 'gif'][0]} writes files; add --out DIR")
    if arguments.out is not None and not kinds and not arguments.gif:
        arguments.usage_error("--out DIR has nothing to write; add --png, --html, --labels, --ply or --gif")
    if arguments.gif and not arguments.track:
        arguments.usage_error("--gif shows tracks; add --track")
    if arguments.png:
        require("matplotlib", "view", "Drawing a picture")
    if arguments.gif:
        require("PIL", "view", "Drawing an animation", package="pillow")


def _live_source(arguments: argparse.Namespace) -> Path:
    """The path to replay: a scan, a capture, or one folder of scans."""
    from ..readers.captures import is_capture

    path: Path = arguments.paths[0]
    folders = scan_folders(path) if path.is_dir() and not is_capture(path) else []
    if len(folders) > 1:
        arguments.usage_error(f"--live replays one folder of scans; {path} has {len(folders)}, such as {folders[0]}")
    return folders[0] if folders else path


class _Report:
    """Prints the result of each scan, and counts scans and failures.

    Attributes
    ----------
    n, n_failed : int
        Number of scans, and of failed scans.
    tracks : list of Tracks
        Tracks of every scan, kept only for ``--gif``.
    under : list of bytes
        `edgeperc.view.flatten_scan` of every scan, drawn under the tracks.
    """

    def __init__(self, arguments: argparse.Namespace) -> None:
        self.n = self.n_failed = 0
        self.tracks: list[Tracks] = []
        self.under: list[bytes] = []
        self._json = arguments.json

    def add(
        self,
        source: Path,
        outcome: Perception | Answer | Exception,
        tracks: Tracks | None = None,
        under: bytes | None = None,
    ) -> None:
        """Print one scan's line or JSON object; print an error on stderr as well."""
        from ..perception import Perception

        if isinstance(outcome, MissingExtraError):
            raise outcome
        self.n += 1
        if isinstance(outcome, Exception):
            self.n_failed += 1
            print_error(f"{source}: {str(outcome).removeprefix(f'{source}: ')}")
            if self._json:
                print_line(json.dumps({"scan": str(source), "error": one_line(outcome)}))
            return
        answer, perception = (None, outcome) if isinstance(outcome, Perception) else (outcome, outcome.perception)
        timing = None if answer is None else _timing(answer)
        if tracks is not None and under is not None:
            self.tracks.append(tracks)
            self.under.append(under)
        if self._json:
            from ..records import scan_record

            stamp_s = perception.stamp_s
            record = {"scan": str(source), "stamp_s": stamp_s, "live": timing, **scan_record(perception, tracks)}
            print_line(json.dumps(record, allow_nan=False))
            return
        parts = [str(source)]
        if timing is not None:
            parts.append("  ".join(f"{key} {value}" for key, value in timing.items()))
        parts.append(_summary(perception))
        if tracks is not None:
            parts.append(f"tracks: {many(len(tracks), 'object')}")
        print_line("  ".join(parts))


# Perceivers kept for the sensors of captures; each has its own networks in memory.
_MOST_PERCEIVERS = 4


class _Perceivers:
    """A perceiver for each sensor, made when its first scan comes."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments
        self._made: dict[str | SensorProfile, Perceiver] = {}
        self._sensors: dict[Path, str | SensorProfile] = {}

    def check(self, scans: Sequence[Path]) -> None:
        """Make the first perceiver, so that errors of options and models come before any file is written."""
        for scan in scans:
            try:
                self.sensor_of(scan)
            except (EdgepercError, OSError):  # reported when the scan's turn comes
                continue
            break
        else:
            if scans:
                return
        cards = self.of(self.sensor_of(scan) if scans else self._arguments.sensor or DEFAULT_SENSOR).cards
        if (self._arguments.labels or self._arguments.ply) and not any(c.view.kind == "range_image" for c in cards):
            raise ModelError(
                "--labels and --ply need a class for every point; add a range-image model: --model pointseg"
            )

    def sensor_of(self, path: Path) -> str | SensorProfile:
        """The sensor of ``--sensor``, of the capture, or the default."""
        if path not in self._sensors:
            self._sensors[path], _ = scan_sensor(path, self._arguments)
        return self._sensors[path]

    def of(self, sensor: str | SensorProfile) -> Perceiver:
        """The perceiver of a sensor."""
        if sensor not in self._made:
            if len(self._made) >= _MOST_PERCEIVERS:
                del self._made[next(iter(self._made))]
            self._made[sensor] = make_perceiver(
                self._arguments, sensor=sensor, on_mismatch=self._arguments.on_mismatch, adapt=self._arguments.adapt
            )
        return self._made[sensor]


Follow = Callable[["Perception"], "Tracks"]


def _follower(rate_hz: float) -> Follow:
    """Make a function from a perception to tracks. Scans without stamps are 1 / ``rate_hz`` apart."""
    from ..tracking.tracker import Tracker

    tracker, counted = Tracker(), itertools.count(1)

    def follow(perception: Perception) -> Tracks:
        k = next(counted)
        return tracker.update(perception.boxes, k / rate_hz if perception.stamp_s is None else perception.stamp_s)

    return follow


def _each(
    perceivers: _Perceivers,
    follow: Follow | None,
    path: Path,
    target: Path,
    kinds: Sequence[str],
    arguments: argparse.Namespace,
) -> Iterator[tuple[Path, Perception | Exception, Tracks | None, bytes | None]]:
    """Yield the name, perception or error, tracks and flattened scan of each scan in a file or capture."""
    from ..readers.captures import is_capture, read_scans

    try:
        sensor = perceivers.sensor_of(path)
    except (EdgepercError, OSError) as exc:
        yield path, exc, None, None
        return
    perceive = perceivers.of(sensor)
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
                yield name, exc, None, None
            except MemoryError:
                yield name, PointsError(f"{len(points):,} points take more memory than there is"), None, None
            else:
                yield name, perception, tracks, _under(points, perception) if arguments.gif else None
    except (EdgepercError, OSError) as exc:
        yield path, exc, None, None


def _live(
    perceivers: _Perceivers, follow: Follow | None, path: Path, arguments: argparse.Namespace
) -> Iterator[tuple[Path, Answer | Exception, Tracks | None]]:
    """Yield scan name, answer or error, and tracks, as a stream delivers them."""
    from ..live import stream

    name_of = scan_namer(path)
    perceive = perceivers.of(
        perceivers.sensor_of(path)
    ).__call__  # without a sensor, of which `stream` would warn again
    with stream(path, perceive, follow, rate_hz=arguments.rate, topic=arguments.topic) as answers:
        while True:
            try:
                answer = answers.take()
            except StopIteration:
                return
            except (EdgepercError, OSError) as exc:
                yield path, exc, None  # newer scans may have arrived, so the failed scan's number is unknown
            else:
                assert answer is not None
                yield name_of(answer.n_scans - 1), answer, answer.tracks


def _file_of(target: Path, kind: str) -> Path:
    return target.with_name(f"{target.name}.{'label' if kind == 'labels' else kind}")


def _write(points: NDArray[np.float32], perception: Perception, wanted: Mapping[str, Path], title: str) -> None:
    from .. import view

    if "png" in wanted:
        view.draw(perception, points, wanted["png"], title=title)
    if "html" in wanted:
        view.write_html(perception, points, wanted["html"], title=title)
    if "labels" in wanted:
        view.write_labels(perception, wanted["labels"])
    if "ply" in wanted:
        view.write_ply(perception, points, wanted["ply"])


def _under(points: NDArray[np.float32], perception: Perception) -> bytes:
    from ..view import flatten_scan

    return flatten_scan(points, perception)


def _timing(answer: Answer) -> dict[str, Any]:
    """Age, health and counts of an answer, which ``run --live`` prints."""
    return {
        "age_ms": round(1e3 * answer.age_s, 3),
        "health": answer.health,
        "scans": answer.n_scans,
        "dropped": answer.n_dropped,
    }


def _summary(perception: Perception) -> str:
    """Summarize on one line: points, time, drivable area, boxes and points of each class."""
    parts = [f"{perception.n_points:,} points", f"{sum(perception.stage_ms.values()):.1f} ms"]
    if perception.top_view is not None:
        parts.append(f"drivable {perception.top_view.drivable_area_m2:.1f} m2")
    labels = [box.label for box in perception.boxes]
    boxes = ", ".join(f"{labels.count(label)} {label}" for label in dict.fromkeys(labels))
    parts.append(f"boxes: {boxes or 'none'}")
    if perception.points is not None:
        counts = perception.points.counts()
        parts.append("points: " + ", ".join(f"{name} {counts[name]:,}" for name in perception.points.classes[1:]))
    return "  ".join(parts)
