"""``edgeperc run``: perceive scans, captures and live sources."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ..errors import EdgepercError, MissingExtraError, ModelError, PointsError
from ..records import scan_record
from ..zoo import DEFAULT
from .output import Progress, complain, many, one_line, require_matplotlib, require_pillow

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..live import Answer
    from ..perceiver import Perceiver
    from ..perception import Perception
    from ..tracking.tracks import Tracks

__all__ = ["find_scans", "make_perceiver", "run_command"]


def make_perceiver(
    arguments: argparse.Namespace,
    sensor: str,
    on_mismatch: Literal["warn", "raise", "ignore"],
    adapt: Literal["both", "remission", "interpolation", "neither"] = "both",
) -> Perceiver:
    """A perceiver by the command's options."""
    from ..perceiver import Perceiver

    try:
        return Perceiver(
            arguments.model or DEFAULT,
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


def run_command(arguments: argparse.Namespace) -> int:
    """``edgeperc run``: perceive scans; 1 if some failed."""
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
        require_matplotlib()
    if arguments.gif:
        require_pillow()
    scans, empty = (arguments.paths, []) if arguments.live else find_scans(arguments.paths)
    targets = [arguments.out / name for name in _output_names(scans)] if kinds else [Path()] * len(scans)
    sources = {os.path.realpath(scan) for scan in scans}
    for file in (_file_of(target, kind) for target in targets for kind in kinds):
        if os.path.realpath(file) in sources:
            arguments.usage_error(f"{file} is one of the scans and would be overwritten; choose another --out")

    from ..perception import Perception

    perceive = make_perceiver(arguments, arguments.sensor, arguments.on_mismatch, arguments.adapt)
    if (arguments.labels or arguments.ply) and not any(card.view.kind == "range_image" for card in perceive.cards):
        raise ModelError("--labels and --ply need a class for every point; add a range-image model: --model pointseg")
    for target in targets if kinds else ():
        target.parent.mkdir(parents=True, exist_ok=True)
    follow = _follower(arguments.rate) if arguments.track else None
    followed: list[Tracks] = []

    progress = Progress(len(scans))
    n_told = n_failed = 0

    def tell(source: Path, outcome: Perception | Answer | Exception, tracks: Tracks | None = None) -> None:
        nonlocal n_told, n_failed
        if isinstance(outcome, MissingExtraError):
            raise outcome
        n_told += 1
        progress.clear()
        if isinstance(outcome, Exception):
            n_failed += 1
            complain(f"{source}: {str(outcome).removeprefix(f'{source}: ')}")
            if arguments.json:
                print(json.dumps({"scan": str(source), "error": one_line(outcome)}), flush=True)
            return
        answer, perception = (None, outcome) if isinstance(outcome, Perception) else (outcome, outcome.perception)
        timing = None if answer is None else _timing(answer)
        if tracks is not None and arguments.gif:
            followed.append(tracks)
        if arguments.json:
            record = {
                "scan": str(source),
                "stamp_s": perception.stamp_s,
                "live": timing,
                **scan_record(perception, tracks),
            }
            print(json.dumps(record, allow_nan=False), flush=True)
        else:
            words = "  ".join(f"{key} {value}" for key, value in (timing or {}).items())
            tail = "" if tracks is None else f"  tracks: {many(len(tracks), 'object')}"
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
        from ..view.tracks import draw_tracks

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
    from ..tracking.tracker import Tracker

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
    from ..readers.captures import is_capture, read_scans

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
    from ..live import stream

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


def find_scans(paths: Sequence[Path]) -> tuple[list[Path], list[Path]]:
    """Scans and captures in the order given, folders opened and sorted, none twice; and the folders that hold none."""
    from ..readers.captures import is_capture, scan_files

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
    from .. import view

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
