"""The ``edgeperc-bench`` command: ``run``, ``compare``, ``matrix``, ``scaling``, ``soak`` and ``peers``.

Without a command it is ``run``, or ``matrix`` where ``--providers`` or ``--precisions`` is among the words. Exit codes:
0 all is well (``compare``: no difference, or faster), 1 ``compare``: slower, 2 nothing could be done or compared,
130 interrupted, after what was measured is written.
"""

from __future__ import annotations

import argparse
import importlib.util
import math
import os
import shlex
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from edgeperc import EdgepercError, __version__
from edgeperc.cli import SHIPPED
from edgeperc.session import PRECISIONS, PROVIDERS, available_providers
from edgeperc.settings import fingerprint, settings_path, write_settings

from . import context, loadgen, report
from .samples import compare, percentile, trend
from .scenarios import Limits
from .worker import MEMORY_SAMPLES, Answer, Job, Scenario

# A measuring process imports this file too, and what it then has in memory is measured: the simulator and what judges
# answers are imported where they are used.
if TYPE_CHECKING:
    from .inputs import Input

__all__ = ["main"]

COMMANDS = ("run", "compare", "matrix", "scaling", "soak", "peers")
SINGLE_STREAM = "single-stream"
DEFAULT_SCENARIOS = (SINGLE_STREAM, "paced:10", "paced:20", "offline", "cold-start")
POINT_COUNTS = (10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
CAR_COUNTS = (0, 4, 8, 16, 28)
# Memory that a run may gain and still be called level [MB]; an allocator's pages come and go by about so much.
LEVEL_MB = 1.0
# Of a long run, the share that counts as warm-up of the allocator.
SETTLING_SHARE = 0.1


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
    if not words or words[0] not in (*COMMANDS, "-h", "--help", "--version"):
        wanted = any(word.startswith(("--providers", "--precisions")) for word in words)
        words = ["matrix" if wanted else "run", *words]
    arguments = _parser().parse_args(words, argparse.Namespace(typed=shlex.join(["edgeperc-bench", *words])))
    try:
        code: int = arguments.command(arguments)
        sys.stdout.flush()
        return code
    except (EdgepercError, OSError) as exc:
        _complain(exc)
        return 2
    except KeyboardInterrupt:
        _complain("interrupted")
        return 130


def _complain(words: object) -> None:
    print(f"edgeperc-bench: {' '.join(str(words).split())}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edgeperc-bench", description="How long a scan takes on this machine, from the scan to the answer."
    )
    parser.add_argument("--version", action="version", version=f"edgeperc {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--model",
        action="append",
        metavar="NAME",
        help=f"a shipped model or an .onnx with a card; may be repeated (default: {' and '.join(SHIPPED)})",
    )
    common.add_argument(
        "--sensor", default="hdl-64e", metavar="NAME", help="what took the scans (default: %(default)s)"
    )
    common.add_argument("--json", type=Path, metavar="FILE", help="everything, all samples included")
    scans = argparse.ArgumentParser(add_help=False)
    scans.add_argument(
        "--input", nargs="+", type=Path, metavar="SCANS", help="your own scans or folders (default: simulated scans)"
    )
    scans.add_argument(
        "--scans", type=_at_least(1), default=8, metavar="N", help="simulated scans (default: %(default)s)"
    )
    scans.add_argument("--markdown", type=Path, metavar="FILE")
    scans.add_argument("--html", type=Path, metavar="FILE", help="a page with plots (needs the extra 'view')")
    engine = argparse.ArgumentParser(add_help=False)
    engine.add_argument("--provider", default="auto", metavar="P", help="cpu, openvino:bf16, cuda, ... (default: auto)")
    engine.add_argument(
        "--threads", type=_at_least(1), metavar="N", help="threads inside a model (default: its choice)"
    )

    def limits(command: argparse.ArgumentParser, min_scans: int, min_seconds: float, repeats: int) -> None:
        command.add_argument(
            "--min-scans", type=_at_least(1), default=min_scans, metavar="N", help="default: %(default)s"
        )
        command.add_argument(
            "--min-seconds", type=_seconds, default=min_seconds, metavar="S", help="default: %(default)s"
        )
        command.add_argument(
            "--warm-up", type=_at_least(0), default=20, metavar="N", help="scans (default: %(default)s)"
        )
        command.add_argument(
            "--repeats", type=_at_least(1), default=repeats, metavar="N", help="fresh processes (default: %(default)s)"
        )

    run = commands.add_parser("run", parents=[common, scans, engine], help="measure one setting")
    limits(run, 100, 10.0, 3)
    run.add_argument(
        "--scenario",
        action="append",
        type=_scenario,
        metavar="S",
        help=f"{SINGLE_STREAM}, paced:HZ, offline, offline:PROCESSES, cold-start; may be repeated "
        f"(default: {', '.join(DEFAULT_SCENARIOS)})",
    )
    run.add_argument("--loadgen", type=Path, metavar="DIR", help="also have MLPerf LoadGen drive it, its logs in DIR")
    run.set_defaults(command=_run)

    versus = commands.add_parser("compare", help="is B faster or slower than A, as far as their noise lets one say")
    versus.add_argument("a", type=Path, metavar="A.json")
    versus.add_argument("b", type=Path, metavar="B.json")
    versus.set_defaults(command=_compare)

    matrix = commands.add_parser("matrix", parents=[common, scans], help="measure many settings, recommend one")
    limits(matrix, 50, 3.0, 2)
    matrix.add_argument("--providers", type=_providers, default=["all"], metavar="A,B|all", help="default: all")
    matrix.add_argument("--precisions", type=_precisions, default=["all"], metavar="A,B|all", help="default: all")
    matrix.add_argument(
        "--threads", type=_thread_counts, default=[1, os.cpu_count() or 1], metavar="1,2,4", help="default: 1 and all"
    )
    matrix.add_argument(
        "--recommend", type=Path, nargs="?", const=settings_path(), metavar="FILE",
        help=f"keep the recommendation where Perceiver(provider='auto') finds it ({settings_path()}), or in FILE",
    )  # fmt: skip
    matrix.set_defaults(command=_matrix)

    scaling = commands.add_parser("scaling", parents=[common, engine], help="how the cost grows")
    limits(scaling, 20, 1.0, 1)
    scaling.add_argument(
        "--points", type=_point_counts, default=list(POINT_COUNTS), metavar="N,N", help="points a scan"
    )
    scaling.add_argument(
        "--cars", type=_car_counts, default=list(CAR_COUNTS), metavar="N,N", help="objects, 28 at most"
    )
    scaling.add_argument(
        "--sizes",
        type=_sizes,
        default=[50, 100, 200, 400],
        metavar="N,N",
        help="images, in per cent of the model's own, its weights at random (needs the extra 'export')",
    )
    scaling.add_argument("--processes", type=_thread_counts, metavar="N,N", help="default: 1, 2, 4 .. as cores")
    scaling.add_argument("--plot", type=Path, metavar="FILE", help=".svg or .png (needs the extra 'view')")
    scaling.add_argument("--markdown", type=Path, metavar="FILE")
    scaling.set_defaults(command=_scaling, html=None)

    soak = commands.add_parser("soak", parents=[common, engine], help="does memory grow over a long run")
    soak.add_argument("--scans", type=_at_least(1000), default=20_000, metavar="N", help="default: %(default)s")
    soak.add_argument("--markdown", type=Path, metavar="FILE")
    soak.set_defaults(command=_soak, html=None)

    peers = commands.add_parser(
        "peers",
        parents=[common, scans, engine],
        help="edgeperc beside torch, other engines and numpy, and the machine's own limits (extra 'peers')",
    )
    peers.add_argument(
        "--rounds", type=_at_least(1), default=25, metavar="N", help="turns of each, all scans (default: %(default)s)"
    )
    peers.set_defaults(command=_peers)
    return parser


def _at_least(least: int) -> Any:
    def number(text: str) -> int:
        if not text.lstrip("-").isdigit() or int(text) < least:
            raise argparse.ArgumentTypeError(f"got {text!r}; expected a whole number from {least}")
        return int(text)

    return number


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"got {text!r}; expected seconds")
    return value


def _numbers(least: int, most: float = math.inf) -> Any:
    def numbers(text: str) -> list[int]:
        found = [int(word) for word in text.split(",") if word.isdigit()]
        if len(found) != len(text.split(",")) or not all(least <= n <= most for n in found):
            raise argparse.ArgumentTypeError(f"got {text!r}; expected whole numbers from {least}, with commas")
        return list(dict.fromkeys(found))

    return numbers


_thread_counts, _point_counts, _car_counts = _numbers(1), _numbers(100), _numbers(0, CAR_COUNTS[-1])
_sizes = _numbers(25, 1600)


def _scenario(text: str) -> str:
    kind, _, value = text.partition(":")
    try:
        fits = (
            text in (SINGLE_STREAM, "offline", "cold-start")
            or (kind == "paced" and 0.0 < float(value) < math.inf)
            or (kind == "offline" and int(value) > 0)
        )
    except ValueError:
        fits = False
    if not fits:
        raise argparse.ArgumentTypeError(
            f"got {text!r}; expected {SINGLE_STREAM}, paced:HZ, offline, offline:PROCESSES or cold-start"
        )
    return text


def _words(known: Sequence[str]) -> Any:
    def words(text: str) -> list[str]:
        found = text.split(",")
        for word in found:
            if word not in (*known, "all"):
                raise argparse.ArgumentTypeError(f"got {word!r}; expected all, or some of {', '.join(known)}")
        return found

    return words


_providers, _precisions = _words(tuple(PROVIDERS)), _words(tuple(PRECISIONS))


@contextmanager
def _document(kind: str, arguments: argparse.Namespace) -> Iterator[tuple[dict[str, Any], report.LiveTable]]:
    """A report to be filled in; what is in it is shown and written however the measuring ends."""
    if arguments.html:
        report.require_matplotlib()
    for file in filter(None, (arguments.json, arguments.markdown, arguments.html)):
        file.parent.mkdir(parents=True, exist_ok=True)
    hardware = context.machine()
    document: dict[str, Any] = {
        "schema": report.SCHEMA,
        "kind": kind,
        "command": arguments.typed,
        "complete": False,
        "machine": hardware | {"fingerprint": fingerprint(), "load_average": context.conditions()["load_average"]},
        "software": context.software(),
        "input": None,
        "spoilers": context.standing_spoilers(hardware, context.busiest()),
        "settings": [],
        "skipped": [],
        "recommended": [],
        "tables": [],
        "soak": None,
    }
    live = report.LiveTable()
    for words in document["spoilers"]:
        live.say(f"note: {words}")
    try:
        yield document, live
        document["complete"] = True
    finally:
        live.clear()
        if any(setting["repeats"] for setting in document["settings"]) or document["tables"]:
            _write(document, arguments)


def _write(document: Mapping[str, Any], arguments: argparse.Namespace) -> None:
    parts = report.sections(document)
    title = f"edgeperc-bench {document['kind']}: {document['machine']['cpu']}"
    print(report.text(parts))
    if arguments.json:
        report.write_report(document, arguments.json)
    if arguments.markdown:
        arguments.markdown.write_text(report.markdown(parts, title), encoding="utf-8")
    if arguments.html:
        page = report.html_page(parts, title, report.pictures(document))
        arguments.html.write_text(page, encoding="utf-8")


def _input(arguments: argparse.Namespace, folder: Path, document: dict[str, Any], live: report.LiveTable) -> Input:
    from . import inputs

    if arguments.input:
        given = inputs.read(folder, arguments.input, arguments.sensor)
    else:
        live.say(f"simulating {arguments.scans} scans")
        given = inputs.simulate(folder, arguments.scans, arguments.sensor)
    document["input"] = given.told
    return given


# run


def _run(arguments: argparse.Namespace) -> int:
    from .measure import cold_starts, judged, new_setting, reference, repeat

    if arguments.loadgen:
        loadgen.require()
        arguments.loadgen.mkdir(parents=True, exist_ok=True)
    wanted = list(dict.fromkeys(arguments.scenario or DEFAULT_SCENARIOS))
    limits = Limits(arguments.min_scans, arguments.min_seconds, arguments.warm_up)
    with _document("run", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = _input(arguments, Path(folder), document, live)
        arriving = tuple(
            Scenario(name, given.files, limits, float(name.partition(":")[2]) if name != SINGLE_STREAM else None)
            for name in wanted
            if name == SINGLE_STREAM or name.startswith("paced")
        )
        job = Job(tuple(arguments.model or SHIPPED), arguments.provider, arguments.threads, arguments.sensor, arriving)
        setting = new_setting(job)
        document["settings"].append(setting)
        live.say(f"{arguments.repeats} repeats of {', '.join(s.name for s in arriving) or 'nothing but the start'}")
        answers = repeat(setting, replace(job, answers=given.files), arguments.repeats, document, live)
        live.say("comparing the answers with fp32 on the stock CPU provider")
        setting["accuracy"] = judged(reference(job, given.files), answers, given.truth)
        for name in wanted:
            kind, _, value = name.partition(":")
            if kind == "offline":
                n = int(value or document["machine"]["usable_cores"] or os.cpu_count() or 1)
                _offline(setting, job, given.files, n, limits, document, live)
            elif kind == "cold-start":
                live.say("cold starts")
                setting["cold_start"] = cold_starts(job, given.files[0], 1 + arguments.repeats)
        if arguments.loadgen:
            _loadgen(setting, job, given.files, limits, arguments.loadgen, live)
    return 0


def _offline(
    setting: dict[str, Any],
    job: Job,
    files: Sequence[Path],
    n: int,
    limits: Limits,
    document: dict[str, Any],
    live: report.LiveTable,
) -> None:
    from .measure import offline

    live.say(f"offline, {n} processes")
    told = offline(job, files, n, limits, live)
    setting["offline"].append(told)
    cpu_s = sum(part["cpu_s"] for part in told["parts"])
    for words in context.spoilers(document["machine"], told["before"], told["after"], cpu_s):
        # What the processes take to get ready is other processes' work by this count.
        if not words.startswith("other processes"):
            document["spoilers"].append(f"offline x {n}: {words}")
    if told["interrupted"]:
        raise KeyboardInterrupt


def _loadgen(
    setting: dict[str, Any], job: Job, files: Sequence[Path], limits: Limits, folder: Path, live: report.LiveTable
) -> None:
    from .measure import new_setting, repeat

    live.say(f"MLPerf LoadGen, logs in {folder}")
    driven = replace(job, scenarios=(Scenario("loadgen", tuple(files), limits),), loadgen=folder)
    scratch = new_setting(driven)
    repeat(scratch, driven, 1, {"machine": {"logical_cores": os.cpu_count()}, "spoilers": []}, live)
    setting["loadgen"] = loadgen.told(folder) | {"samples": scratch["repeats"][0]["scenarios"]["loadgen"]}


# compare


def _compare(arguments: argparse.Namespace) -> int:
    a, b = report.read_report(arguments.a), report.read_report(arguments.b)
    if not a["input"] or not b["input"] or a["input"]["sha256"] != b["input"]["sha256"]:
        _complain("the reports are of different scans; measure both with the same --input, --scans and --sensor")
        return 2
    if a["machine"]["fingerprint"] != b["machine"]["fingerprint"]:
        print(f"other machines: A on {a['machine']['cpu']}, B on {b['machine']['cpu']}")
    found = []
    for one, other in _pairs(a["settings"], b["settings"]):
        for name in report.scenario_names(one):
            if name not in report.scenario_names(other):
                continue
            verdict = compare(report.repeats_ms(one, name), report.repeats_ms(other, name))
            found.append(verdict.word)
            words = (
                f"{'+'.join(one['models'])}, {name}: {_setting_words(one)} -> {_setting_words(other)}: {verdict.word}"
            )
            if verdict.word == "unusable":
                print(f"{words}; a run of one repeat says nothing of its noise: measure with --repeats 3")
                continue
            low, high = verdict.interval
            print(
                f"{words}; median x {verdict.ratio:.3f} (95 %: {low:.3f} to {high:.3f}), "
                f"noise {100.0 * verdict.noise:.1f} %"
            )
    for letter, document in (("A", a), ("B", b)):
        for words in document["spoilers"][:5]:
            print(f"{letter} was disturbed: {words}")
    if not found or "unusable" in found:
        _complain("not everything could be compared" if found else "the reports have no setting and scenario in common")
        return 2
    return 1 if "slower" in found else 0


def _pairs(a: Sequence[dict[str, Any]], b: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Settings that are compared: the same ones, or, where each report has but one, of the same models."""
    keys = ("models", "provider", "n_threads")
    same = [(one, other) for one in a for other in b if all(one[key] == other[key] for key in keys)]
    if same or len(a) != 1 or len(b) != 1:
        return same
    return [(a[0], b[0])] if a[0]["models"] == b[0]["models"] else []


def _setting_words(setting: Mapping[str, Any]) -> str:
    return f"{setting['provider']}, {setting['n_threads'] or 'default'} threads"


# matrix


def _matrix(arguments: argparse.Namespace) -> int:
    from .measure import reference

    limits = Limits(arguments.min_scans, arguments.min_seconds, arguments.warm_up)
    with _document("matrix", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        providers, skipped = settings_to_try(arguments.providers, arguments.precisions, available_providers())
        for words in skipped:
            document["skipped"].append(words)
            live.say(f"skipped: {words}")
        given = _input(arguments, Path(folder), document, live)
        for model in dict.fromkeys(arguments.model or SHIPPED):
            base = Job((model,), sensor=arguments.sensor)
            right = reference(base, given.files)
            for provider in providers:
                for n_threads in arguments.threads:
                    scenario = Scenario(SINGLE_STREAM, given.files, limits)
                    job = replace(base, provider=provider, n_threads=n_threads, scenarios=(scenario,))
                    _try(job, right, given, arguments.repeats, document, live)
        document["recommended"] = _recommended(document)
        if arguments.recommend and document["recommended"]:
            entries = {each["sha256"]: each["entry"] for each in document["recommended"]}
            write_settings(arguments.recommend, document["machine"]["fingerprint"], entries)
            live.say(f"kept in {arguments.recommend}")
    return 0 if document["recommended"] else 2


def settings_to_try(
    providers: Sequence[str], precisions: Sequence[str], present: Sequence[str]
) -> tuple[list[str], list[str]]:
    """What `Perceiver` is to be asked for, and a sentence for everything asked for that cannot be had here."""
    wanted = list(PROVIDERS) if "all" in providers else list(dict.fromkeys(providers))
    kinds = list(PRECISIONS) if "all" in precisions else list(dict.fromkeys(precisions))
    settings, skipped = [], []
    for provider in wanted:
        if provider not in present:
            skipped.append(f"{provider}: not available on this computer (present: {', '.join(present)})")
        elif provider == "openvino":
            settings += [f"{provider}:{kind}" for kind in kinds]
        else:
            skipped += [
                f"{provider} in {k}: it runs a model in the precision of its file" for k in kinds if k != "fp32"
            ]
            settings += [provider] * ("fp32" in kinds)
    return settings, skipped


def _try(
    job: Job,
    right: Sequence[Answer],
    given: Input,
    n_repeats: int,
    document: dict[str, Any],
    live: report.LiveTable,
) -> None:
    from .measure import judged, new_setting, repeat

    setting = new_setting(job)
    words = f"{'+'.join(job.models)} on {job.provider}, {job.n_threads} threads"
    live.ms.clear()
    try:
        found = repeat(setting, replace(job, answers=given.files), n_repeats, document, live)
    except EdgepercError as exc:
        sentence = f"{words}: {' '.join(str(exc).split())}"
        document["skipped"].append(sentence)
        live.say(f"skipped: {sentence}")
        return
    # Only now, so that a setting that was broken off recommends nothing.
    setting["accuracy"] = judged(right, found, given.truth)
    document["settings"].append(setting)
    ms = percentile(report.pooled(setting, SINGLE_STREAM), 50.0)
    live.say(f"{words}: median {ms:.2f} ms, {'agrees' if setting['accuracy']['agrees'] else 'answers differ'}")


def _recommended(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each model the setting of the least median whose answers agree, and whether the next best is truly slower."""
    told = []
    for models in dict.fromkeys(tuple(setting["models"]) for setting in document["settings"]):
        agreeing = [s for s in document["settings"] if tuple(s["models"]) == models and s["accuracy"]["agrees"]]
        ranked = sorted(agreeing, key=lambda setting: percentile(report.pooled(setting, SINGLE_STREAM), 50.0))
        if not ranked:
            continue
        best, (engine,) = ranked[0], ranked[0]["repeats"][0]["engines"]
        ms = percentile(report.pooled(best, SINGLE_STREAM), 50.0)
        asked = f"provider={best['provider']!r}, n_threads={best['n_threads']}"
        words = f"Perceiver({engine['name']!r}, {asked}), median {ms:.2f} ms"
        if len(ranked) > 1:
            verdict = compare(report.repeats_ms(best, SINGLE_STREAM), report.repeats_ms(ranked[1], SINGLE_STREAM))
            sure = "is slower" if verdict.word == "slower" else "is no slower as far as the noise lets one say"
            words += f"; the next, {_setting_words(ranked[1])}, {sure}"
        entry = {
            "name": engine["name"],
            "provider": best["provider"],
            "n_threads": best["n_threads"],
            "p50_ms": round(ms, 4),
            "cpu": document["machine"]["cpu"],
            "onnxruntime": document["software"]["onnxruntime"],
            "measured": document["software"]["taken"],
        }
        told.append({"name": engine["name"], "sha256": engine["sha256"], "words": words, "entry": entry})
    return told


# scaling


def _scaling(arguments: argparse.Namespace) -> int:
    from . import inputs
    from .measure import new_setting, repeat

    if arguments.plot:
        report.require_matplotlib()
        arguments.plot.parent.mkdir(parents=True, exist_ok=True)
    limits = Limits(arguments.min_scans, arguments.min_seconds, min(arguments.warm_up, 5))
    with _document("scaling", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        live.say("simulating scans")
        makers = [("points", n, inputs.sized) for n in arguments.points] + [
            ("cars", n, inputs.crowd) for n in arguments.cars
        ]
        files = {
            (kind, n): inputs.store(Path(folder), f"{kind}{n}", make(n, arguments.sensor)) for kind, n, make in makers
        }
        scenarios = {key: Scenario(f"{key[1]:,} {key[0]}", (file,), limits) for key, file in files.items()}
        job = Job(tuple(arguments.model or SHIPPED), arguments.provider, arguments.threads, arguments.sensor)
        setting = new_setting(job)
        document["settings"].append(setting)
        repeat(setting, replace(job, scenarios=tuple(scenarios.values())), arguments.repeats, document, live)
        curves: dict[str, list[tuple[float, float]]] = {}
        for kind, unit in (("points", "1,000 points"), ("cars", "car")):
            counts = [n for of, n in scenarios if of == kind]
            ms = [percentile(report.pooled(setting, scenarios[kind, n].name), 50.0) for n in counts]
            curves[kind] = list(zip(counts, ms, strict=True))
            rows = []
            for n in counts:
                told = report.latency(setting, scenarios[kind, n].name)
                own = report.stage_medians(setting, scenarios[kind, n].name)
                beside = sum(took for stage, took in own.items() if stage != "infer")
                rows.append([f"{n:,}", *(report.number(told[q]) for q in ("p50", "p90")), report.number(beside)])
            words = _line(curves[kind], unit, 1000.0 if kind == "points" else 1.0)
            head = [kind, "p50 ms", "p90 ms", "beside the network ms"]
            document["tables"].append({"title": f"Growth with {kind}", "sentences": words, "head": head, "rows": rows})
        middle = min(files, key=lambda key: (key[0] != "points", abs(key[1] - 100_000)))
        curves["pixels %"] = _growth_with_images(document, live, job, arguments, Path(folder), files[middle], limits)
        most = document["machine"]["usable_cores"] or os.cpu_count() or 1
        counts = arguments.processes or sorted({*(2**k for k in range(most.bit_length())), most})
        for n in counts:
            _offline(setting, job, [files[middle]], n, limits, document, live)
        curves["processes"] = [(told["processes"], told["scans_per_s"] or math.nan) for told in setting["offline"]]
        one = curves["processes"][0][1] / curves["processes"][0][0]
        rows = [[str(n), report.number(rate), report.number(rate / one)] for n, rate in curves["processes"]]
        head = ["processes", "scans/s", "times one"]
        document["tables"].append({"title": "Growth with processes", "sentences": [], "head": head, "rows": rows})
        if arguments.plot:
            _plot(curves, arguments.plot)
    return 0


def _growth_with_images(
    document: dict[str, Any],
    live: report.LiveTable,
    job: Job,
    arguments: argparse.Namespace,
    folder: Path,
    scan: Path,
    limits: Limits,
) -> list[tuple[float, float]]:
    """The same networks, for views of more or fewer pixels."""
    from .measure import new_setting, repeat

    head = ["pixels %", "p50 ms", "p90 ms", "beside the network ms"]
    table: dict[str, Any] = {"title": "Growth with image size", "sentences": [], "head": head, "rows": []}
    document["tables"].append(table)
    if not all(importlib.util.find_spec(name) for name in ("torch", "onnx")):
        table["sentences"] = ["not measured: pip install 'edgeperc[export]'"]
        return []
    from .peers import resized

    curve = []
    for percent in arguments.sizes:
        live.say(f"making networks for {percent} % of the pixels")
        models = tuple(str(resized(name, percent / 100.0, folder)) for name in job.models)
        scenario = Scenario(f"{percent} % of the pixels", (scan,), limits)
        setting = new_setting(own := replace(job, models=models, scenarios=(scenario,)))
        document["settings"].append(setting)
        repeat(setting, own, arguments.repeats, document, live)
        told, stages = report.latency(setting, scenario.name), report.stage_medians(setting, scenario.name)
        beside = sum(took for stage, took in stages.items() if stage != "infer")
        table["rows"].append([f"{percent}", *(report.number(told[q]) for q in ("p50", "p90")), report.number(beside)])
        curve.append((float(percent), float(told["p50"])))
    table["sentences"] = ["networks made anew, in fp32", *_line(curve, "per cent of the model's own image")]
    return curve


def _line(curve: Sequence[tuple[float, float]], unit: str, per: float = 1.0) -> list[str]:
    line = trend(*(np.array(curve, np.float64).reshape(-1, 2) / (per, 1.0)).T)
    if math.isnan(line.slope):
        return []
    told = f"{line.intercept:.2f} ms + {line.slope:.4f} ms per {unit} (+- {line.error:.4f}), R2 {line.r2:.4f}"
    return [f"a line through the medians: {told}"]


def _plot(curves: Mapping[str, Sequence[tuple[float, float]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    for axes, (kind, curve) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        axes.plot(*np.array(curve, np.float64).reshape(-1, 2).T, marker="o", color="#3b6ea8")
        axes.set(xlabel=kind, ylabel="scans a second" if kind == "processes" else "median ms", ylim=(0.0, None))
    if path.suffix == ".svg":
        path.write_text(report.as_svg(figure), encoding="utf-8")
    else:
        figure.savefig(path, dpi=150)


# soak


def _soak(arguments: argparse.Namespace) -> int:
    from . import inputs
    from .measure import new_setting, repeat

    settling = round(SETTLING_SHARE * arguments.scans)
    with _document("soak", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = inputs.simulate(Path(folder), 8, arguments.sensor)
        document["input"] = given.told
        scenario = Scenario(
            "soak",
            given.files,
            Limits(arguments.scans - settling, 0.0, settling, max(1, arguments.scans // MEMORY_SAMPLES)),
        )
        job = Job(
            tuple(arguments.model or SHIPPED), arguments.provider, arguments.threads, arguments.sensor, (scenario,)
        )
        setting = new_setting(job)
        document["settings"].append(setting)
        try:
            repeat(setting, job, 1, document, live)
        finally:
            for each in setting["repeats"]:
                if "soak" in each["scenarios"]:
                    document["soak"] = memory_growth(each["scenarios"]["soak"]["rss_mb"], settling)
    return 0


def memory_growth(rss_mb: Sequence[Sequence[float]], settling: int) -> dict[str, Any]:
    """Whether memory grew.

    Parameters
    ----------
    rss_mb : sequence of (scans done, MB)
    settling : int
        Scans before the first of these.

    Returns
    -------
    dict
        ``verdict`` (grows, level, undecided), ``growth_mb`` over the run by a straight line and its ``growth_error_mb``
        (half of a 95 % interval), ``last_minus_first_mb``, ``sentences``. It grows where the interval lies above 0 and
        the growth above `LEVEL_MB`; it is level where the interval ends below `LEVEL_MB`.
    """
    done, mb = np.asarray(rss_mb, np.float64).reshape(-1, 2).T
    line = trend(done, mb)
    told: dict[str, Any] = {
        "verdict": "undecided",
        "growth_mb": None,
        "growth_error_mb": None,
        "last_minus_first_mb": None,
    }
    if math.isnan(line.slope):
        return told | {"sentences": ["undecided: too few samples of the memory for a line"]}
    span = float(done[-1] - done[0])
    growth, error = line.slope * span, line.error * span
    if growth + error <= LEVEL_MB:
        told["verdict"] = "level"
    elif growth - error > 0.0 and growth > LEVEL_MB:
        told["verdict"] = "grows"
    told |= {"growth_mb": growth, "growth_error_mb": error, "last_minus_first_mb": float(mb[-1] - mb[0])}
    sentences = [
        f"{told['verdict']}: {growth:+.3f} MB (+- {error:.3f}) over {span:,.0f} scans, after {settling:,} to settle",
        f"resident {mb[0]:.1f} MB first, {mb[-1]:.1f} MB last, {mb.max():.1f} MB at most; "
        f"slope {1e3 * line.slope:+.5f} MB per 1,000 scans (+- {1e3 * line.error:.5f}), from {len(mb):,} samples",
    ]
    return told | {"sentences": sentences}


# peers


def _peers(arguments: argparse.Namespace) -> int:
    from . import peers

    with _document("peers", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        given = _input(arguments, Path(folder), document, live)
        peers.run(
            document,
            given.files,
            Path(folder),
            models=arguments.model or peers.default_models(),
            provider=arguments.provider,
            sensor=arguments.sensor,
            n_threads=arguments.threads or document["machine"]["usable_cores"] or os.cpu_count() or 1,
            n_rounds=arguments.rounds,
            say=live.say,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
