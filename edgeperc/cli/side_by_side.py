"""``--workers`` and ``--engine ray`` of ``edgeperc run``, and scans and results at URLs.

A perceiver learns from its first scans how the sensor is mounted and how strong its remission is. The driver therefore
perceives these itself, until more scans change nothing. All other scans are perceived by workers, each scan from this
same state. So the results do not depend on the number of workers, and they equal those of a single process.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import __version__
from ..errors import EdgepercError
from ..system.atomic import write_atomic
from ..system.pool import MOST_FIRST, Lost
from ..system.printable import many
from ..system.ray_cluster import ENGINES, load_ray
from ..system.remote import Remote
from ..types.choices import AUTO_SENSOR
from .arguments import options, positive
from .output import one_line, print_line
from .report import Outcome, Report
from .scans import is_recording

if TYPE_CHECKING:
    from ..perceiver import Learned, Perceiver


# Options that do not change what is written about a scan.
_OTHERS = ("engine", "live", "out", "paths", "rate", "threads", "typed", "workers")
# What the parser adds to the arguments; it cannot be pickled.
_OF_PARSER = ("command", "parser", "usage_error")

Scan = Callable[..., Iterator[Outcome]]
_Pair = tuple[Path | Remote, Path | Remote]
_Show = Callable[[int, int], None]
Alone = Callable[..., "tuple[Perceiver, Scan, Callable[[Any], list[Any]]]"]
"""From the arguments to a perceiver, what perceives and writes a scan file with it, and the files it writes."""


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add ``--engine`` and ``--workers``."""
    group = options(parser, "engine")
    group(
        "--engine",
        "local: this computer; ray: worker processes with one thread each, on the cluster that the environment "
        "variable RAY_ADDRESS names, else on this computer (extra 'ray'). The results are the same (default: local)",
        choices=("local", "ray"),
        default="local",
    )
    group(
        "--workers N",
        "number of worker processes with one thread each, among which the scans are divided; the results are the "
        "same (default: this process alone; with --engine ray, one for each CPU of the cluster)",
        type=positive,
    )


def has_workers(arguments: argparse.Namespace) -> bool:
    """Whether scans are divided among worker processes."""
    return arguments.engine == "ray" or (arguments.workers or 1) > 1


def _asked_by(arguments: argparse.Namespace) -> str:
    return "--engine ray" if arguments.engine == "ray" else f"--workers {arguments.workers}"


def check_engine(arguments: argparse.Namespace, sinks: Sequence[str]) -> None:
    """Check for options that do not go with worker processes or with URLs."""
    in_order = [name for name in ("live", "track", "gif", "scan") if getattr(arguments, name)]
    in_order = [f"--{name.replace('_', '-')}" for name in (*in_order, *sinks, *["deskew"] * arguments.deskew)]
    if has_workers(arguments) and in_order:
        arguments.usage_error(
            f"{in_order[0]} needs the scans in their order, and {_asked_by(arguments)} perceives them side by side; "
            "leave out one"
        )
    local = [name for name in in_order if name in ("--live", "--gif", "--labels-for")]
    urls = [path for path in (*arguments.paths, arguments.out) if isinstance(path, Remote)]
    if urls and local:
        arguments.usage_error(f"{local[0]} takes no URL such as {urls[0]}; copy the files to this computer")
    if has_workers(arguments) and any(url.url.startswith("memory:") for url in urls):
        arguments.usage_error(
            f"memory:// belongs to one process, and {_asked_by(arguments)} has several; pass another URL or a path"
        )


def check_scan_files(arguments: argparse.Namespace, scans: Sequence[Path | Remote]) -> None:
    """Check that worker processes, if any, get scan files alone, and that there is Ray, before the first scans, which
    this process perceives.
    """
    for scan in scans if has_workers(arguments) else ():
        if is_recording(scan) or (isinstance(scan, Path) and scan.is_dir()):
            arguments.usage_error(
                f"{_asked_by(arguments)} takes scan files; {scan} is a capture, which is decoded in its order"
            )
    if arguments.engine == "ray":
        load_ray()


def perceive_side_by_side(
    arguments: argparse.Namespace,
    alone: Alone,
    perceivers: Any,
    scans: Sequence[Path | Remote],
    targets: Sequence[Path | Remote],
    report: Report,
    show: _Show,
) -> None:
    """Perceive scan files in worker processes, and report them in their order, those of one sensor after
    those of another. ``.run/NAME.json`` next to a scan's files says what they were made of; a later run keeps those
    that are the same and complete, but the first scans.
    """

    def sensor_of(pair: _Pair) -> Any:
        if arguments.sensor not in (None, AUTO_SENSOR):
            return arguments.sensor
        try:
            return perceivers.sensor_of(pair[0])
        except (EdgepercError, OSError) as exc:
            return exc

    done = 0
    for sensor, of_sensor in groupby(zip(scans, targets, strict=True), sensor_of):
        pairs = [*of_sensor]
        if isinstance(sensor, Exception):
            report.add(Outcome(pairs[0][0], sensor))
        else:
            given = argparse.Namespace(**{**vars(arguments), "sensor": sensor})
            shown = partial(lambda before, n, _: show(before + n, len(scans)), done)
            _perceive_one_sensor(given, alone, perceivers, pairs, report, shown)
        done += len(pairs)


def _perceive_one_sensor(
    arguments: argparse.Namespace, alone: Alone, perceivers: Any, pairs: Sequence[_Pair], report: Report, show: _Show
) -> None:
    scans, targets = zip(*pairs, strict=True)
    perceive, run, _ = alone(arguments, perceivers)
    n_first = 0
    while n_first < min(len(scans), MOST_FIRST) and not perceive.learned.is_settled:
        for outcome in run(scans[n_first], targets[n_first]):
            report.add(outcome)
        n_first += 1
        show(n_first, len(scans))
    if n_first == len(scans):
        return
    learned = perceive.learned
    if not learned.is_settled:
        warnings.warn(
            f"the first {n_first} scans do not settle mounting and remission (no ground, no remission, or refused): "
            "a single process would go on learning, and may give other results; pass --mount-height or --extrinsic",
            stacklevel=2,
        )
    options = {name: value for name, value in vars(arguments).items() if name not in _OF_PARSER}
    options["threads"] = n_threads = arguments.threads or 1
    options["model"] = arguments.model and [_absolute_if_there(model) for model in arguments.model]
    options |= {name: _absolute_if_there(options.get(name)) for name in ("sensor", "extrinsic", "poses", "out")}
    items = [
        (scan, _absolute(scan), _absolute(target))
        for scan, target in zip(scans[n_first:], targets[n_first:], strict=True)
    ]
    made_of = alone, argparse.Namespace(**options), learned
    perceived_by = ENGINES[arguments.engine]
    answers = perceived_by(ScanWorker, made_of, items, workers=arguments.workers, n_threads=n_threads)
    reported: set[str] = set()
    n_kept = 0
    for done, (scan, answer) in enumerate(zip(scans[n_first:], answers, strict=True), start=n_first + 1):
        if isinstance(answer, Lost):
            answer = _Answer(report.text(Outcome(scan, EdgepercError(answer.reason))), one_line(answer.reason), (), ())
        for message in answer.warnings:
            warnings.warn(message, stacklevel=2)
        report.show(scan, _said_once(answer, reported) if learned.is_settled else answer.text, answer.error)
        n_kept += answer.kept
        show(done, len(scans))
    if n_kept:
        print_line(f"{many(n_kept, 'scan')} of an earlier run kept", sys.stderr)


@dataclass(frozen=True)
class _Answer:
    text: str
    error: str | None
    fitness: tuple[str, ...]
    warnings: tuple[str, ...]
    kept: bool = False


def _said_once(answer: _Answer, reported: set[str]) -> str:
    """The text without sentences of other scans: a perceiver says of its remission once what is wrong with it."""
    text, again = answer.text, reported & {*answer.fitness}
    reported |= {*answer.fitness}
    if again and text.startswith("{"):
        record = json.loads(text)
        record["fitness"] = [sentence for sentence in record["fitness"] if sentence not in again]
        text = json.dumps(record, allow_nan=False)
    return text


class ScanWorker:
    """Perceives scan files in a worker process, each from the same state."""

    def __init__(self, alone: Alone, arguments: argparse.Namespace, learned: Learned) -> None:
        self._perceive, self._run, self._files = alone(arguments)
        self._learned = learned
        self._report = Report(arguments, {})
        state = learned.mounting.mounting(), learned.mounting.n_scans, learned.remission.matched, learned.to_check
        options = {name: value for name, value in sorted(vars(arguments).items()) if name not in _OTHERS}
        perceiver = self._perceive
        # The sensor as it is: its file, or that of its mounting, may have changed since an earlier run.
        named = perceiver.cards, perceiver.sensor, dict(perceiver.providers)
        self.made_of = repr((__version__, *named, state, learned.normal, options))

    def __call__(self, item: tuple[Path | Remote, Path | Remote, Path | Remote]) -> _Answer:
        name, path, target = item
        files = self._files(target)
        record = target.parent / ".run" / f"{target.name}.json"
        made_of = hashlib.sha256(f"{self.made_of} {name} {_stamp(path)}".encode()).hexdigest()
        if files and (recorded := _kept(record, made_of, files)) is not None:
            return recorded
        self._perceive.start_from(self._learned)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            outcomes = list(self._run(path, target, name))
        if len(outcomes) != 1:
            raise EdgepercError(f"{name} holds {many(len(outcomes), 'scan')}; worker processes take files of one")
        found: Any = outcomes[0].answer
        if isinstance(found, EdgepercError):  # it names the absolute path
            found.args = (str(found).replace(str(path), str(name)),)
        text = self._report.text(Outcome(name, found))
        warned = tuple(dict.fromkeys(str(warning.message) for warning in caught))
        if isinstance(found, Exception):
            return _Answer(text, str(found).removeprefix(f"{name}: "), (), warned)
        answer = _Answer(text, None, tuple(map(str, found.fitness)), warned)
        if files:
            written = {"made_of": made_of, "files": _stamps(files), "answer": astuple(answer)}
            content = json.dumps(written).encode()
            if isinstance(record, Path):
                record.parent.mkdir(parents=True, exist_ok=True)
                write_atomic(record, content)
            else:
                record.write_bytes(content)
        return answer


def _kept(record: Path | Remote, made_of: str, files: Sequence[Path | Remote]) -> _Answer | None:
    """The answer of an earlier run, if it was made of the same and its files are complete."""
    try:
        content = json.loads(record.read_bytes())
        # A run in one process, or one that was stopped, may have replaced files by others of the same size.
        if content["made_of"] != made_of or content["files"] != _stamps(files):
            return None
        text, error, fitness, warned, _ = content["answer"]
    except (FileNotFoundError, KeyError, TypeError, ValueError):
        return None
    return _Answer(text, error, tuple(fitness), tuple(warned), kept=True)


def _stamps(files: Sequence[Path | Remote]) -> dict[str, list[int | str] | None]:
    """`_stamp` of each file by its name, as JSON has it."""
    return {file.name: (stamp := _stamp(file)) and [*stamp] for file in files}


def _stamp(file: Path | Remote) -> tuple[int, str] | None:
    """Size, and time or version of a file; None if there is none."""
    if isinstance(file, Remote):
        return file.stamp()
    try:
        status = file.stat()
    except OSError:
        return None
    return status.st_size, str(status.st_mtime_ns)


def _absolute(path: Path | Remote) -> Path | Remote:
    # A worker has another current folder. A link keeps its name, so no resolve().
    return path if isinstance(path, Remote) else Path(os.path.abspath(path))  # noqa: PTH100


def _absolute_if_there(value: Any) -> Any:
    return _absolute(Path(value)) if isinstance(value, str | Path) and Path(value).exists() else value


def through_temporary(run: Scan, path: Path | Remote, target: Path | Remote) -> Iterator[Outcome]:
    """Perceive a scan or capture that is at a URL, or whose files go to one, through a temporary folder."""
    with tempfile.TemporaryDirectory(prefix="edgeperc-") as folder:
        written = Path(folder) / "written"
        written.mkdir()
        try:
            local = path.fetch(Path(folder)) if isinstance(path, Remote) else path
        except (EdgepercError, OSError) as exc:
            yield Outcome(path, exc)
            return
        aside = written / target.name if isinstance(target, Remote) else target
        for outcome in run(local, aside, path):
            try:
                for file in sorted(each for each in written.rglob("*") if each.is_file()):
                    assert isinstance(target, Remote)
                    (target.parent / file.relative_to(written)).write_bytes(file.read_bytes())
                    file.unlink()
            except (EdgepercError, OSError) as exc:
                outcome = Outcome(outcome.source, exc)
            if isinstance(outcome.answer, EdgepercError):  # it names the temporary file
                outcome.answer.args = (str(outcome.answer).replace(str(local), str(path)),)
            yield outcome
