"""``edgeperc-bench matrix``: measure every combination of provider, precision and threads, and recommend one."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeperc import EdgepercError
from edgeperc.cli.output import make_places
from edgeperc.inference.providers import PROVIDERS, available_providers, recompiles
from edgeperc.system.machine import cpu_features, read_setting, settings_path, usable_cores, write_settings
from edgeperc.types.choices import PRECISIONS
from edgeperc.zoo import DEFAULT, choose, resolve

from ..document import pooled, repeats_ms, setting_label
from ..options import SINGLE_STREAM, add_command, add_limits, choices, numbers
from ..render import LiveTable
from ..samples import compare, percentile
from ..worker import Job, Prediction, Scenario
from .common import limits_of, new_document, prepare_input

if TYPE_CHECKING:
    from ..inputs import Input
    from ..measure import Reference


def add_parser(subparsers: Any) -> None:
    add = add_command(
        subparsers,
        "matrix",
        run_command,
        ("model", "scans", "output", "page"),
        help="measure many settings and recommend the fastest",
        description="Measure each model on every provider, in every precision and with every number of threads, and "
        "recommend the fastest setting whose results agree with fp32 on the CPU.",
    )
    add_limits(add, min_scans=50, min_seconds=3.0, repeats=2)
    for option, what, known in (
        ("--providers A,B", "execution providers", tuple(PROVIDERS)),
        ("--precisions A,B", "precisions", tuple(PRECISIONS)),
    ):
        text = f"{what} with commas between them, or all; one of {', '.join(known)} (default: all)"
        add(option, text, type=choices(known), default=list(known))
    threads = "numbers of threads with commas between them (default: 1 and the number of cores that may be used)"
    add("--threads 1,2,4", threads, type=numbers(1), default=list(dict.fromkeys([1, usable_cores()])))
    add(
        "--recommend FILE",
        "save the recommendation to FILE; without FILE, to settings.json in the folder EDGEPERC_CACHE_DIR, by "
        "default edgeperc in the user's cache folder, where Perceiver(provider='auto') finds it",
        nargs="?",
        const="",
    )


def run_command(arguments: argparse.Namespace) -> int:
    """Measure all settings, one model at a time."""
    from ..measure import reference

    if arguments.recommend == Path():
        arguments.recommend = settings_path()
    if arguments.recommend is not None:
        make_places(arguments.recommend)
        read_setting(arguments.recommend, "", "")  # raises now what it would raise after the measurement
    with new_document("matrix", arguments) as (document, live, folder):
        scans = prepare_input(arguments, folder, document, live)
        scenario = Scenario(SINGLE_STREAM, scans.files, limits_of(arguments))
        for model in dict.fromkeys(arguments.model or DEFAULT):
            settings, skipped = settings_to_try(model, arguments.providers, arguments.precisions, available_providers())
            for reason in skipped:
                _skip(reason, document, live)
            base = Job((model,), sensor=arguments.sensor, scenarios=(scenario,))
            right = reference(base, scans.files)
            for provider, precision in settings:
                for n_threads in arguments.threads:
                    job = replace(base, provider=provider, precision=precision, n_threads=n_threads)
                    _try(job, right, scans, arguments.repeats, document, live)
        document["recommended"] = recommend(document)
        if arguments.recommend is not None and document["recommended"]:
            entries = {each["digest"]: each["entry"] for each in document["recommended"]}
            write_settings(arguments.recommend, document["machine"]["fingerprint"], entries)
            live.note(f"saved in {arguments.recommend}")
    return 0 if document["recommended"] else 2


def settings_to_try(
    model: str, providers: Sequence[str], precisions: Sequence[str], present: Sequence[str]
) -> tuple[list[tuple[str, str]], list[str]]:
    """The (provider, precision) of a model that this computer can run by ``present``; a sentence for each other."""
    variants = resolve(model)
    settings, skipped = [], []
    for provider in providers:
        if provider not in present:
            skipped.append(f"{model} on {provider}: not available on this computer (present: {', '.join(present)})")
            continue
        if recompiles(provider, variants[0].card.view.kind):
            skipped.append(f"{model} on {provider}: it compiles the network anew for each number of candidates")
            continue
        for precision in precisions:
            try:
                choose(variants, provider, precision, cpu_features())
            except EdgepercError as exc:
                skipped.append(f"{model} on {provider} in {precision}: {exc}")
            else:
                settings.append((provider, precision))
    return settings, skipped


def _skip(reason: str, document: dict[str, Any], live: LiveTable) -> None:
    if reason not in document["skipped"]:
        document["skipped"].append(reason)
        live.note(f"skipped: {reason}")


def _try(job: Job, right: Reference, scans: Input, n_repeats: int, document: dict[str, Any], live: LiveTable) -> None:
    from ..measure import accuracy_of, new_setting, repeat

    setting = new_setting(job)
    name = f"{'+'.join(job.models)} on {job.provider} in {job.precision}, {job.n_threads} threads"
    live.ms.clear()
    try:
        predictions: list[Prediction] = repeat(setting, replace(job, predict=scans.files), n_repeats, document, live)
    except EdgepercError as exc:
        _skip(f"{name}: {' '.join(str(exc).split())}", document, live)
        return
    # Added last: an interrupted setting must not be recommended.
    setting["accuracy"] = accuracy_of(right, predictions, scans.truth)
    document["settings"].append(setting)
    ms = percentile(pooled(setting, SINGLE_STREAM), 50.0)
    live.note(f"{name}: median {ms:.2f} ms, {'agrees' if setting['accuracy']['agrees'] else 'results differ'}")


def recommend(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """For each model, the fastest setting whose results agree, and whether the next one is significantly slower."""

    def median_ms(setting: Mapping[str, Any]) -> float:
        return percentile(pooled(setting, SINGLE_STREAM), 50.0)

    recommended = []
    for models in dict.fromkeys(tuple(setting["models"]) for setting in document["settings"]):
        agreeing = [s for s in document["settings"] if tuple(s["models"]) == models and s["accuracy"]["agrees"]]
        ranked = sorted(agreeing, key=median_ms)
        if not ranked:
            continue
        best, (engine,) = ranked[0], ranked[0]["repeats"][0]["engines"]
        chosen = {key: best[key] for key in ("provider", "precision", "n_threads")}
        call = ", ".join([repr(best["models"][0]), *(f"{key}={value!r}" for key, value in chosen.items())])
        sentence = f"Perceiver({call}), median {median_ms(best):.2f} ms"
        if len(ranked) > 1:
            verdict = compare(repeats_ms(best, SINGLE_STREAM), repeats_ms(ranked[1], SINGLE_STREAM))
            words = {"slower": "is slower", "unusable": "was measured once, so that the noise is unknown"}
            result = words.get(verdict.word, "is not slower within the noise")
            sentence += f"; the next, {setting_label(ranked[1])}, {result}"
        entry = chosen | {
            "name": engine["name"],
            "p50_ms": round(median_ms(best), 4),
            "cpu": document["machine"]["cpu"],
            "onnxruntime": document["software"]["onnxruntime"],
            "measured": document["software"]["measured"],
        }
        recommended.append({"name": engine["name"], "digest": engine["digest"], "text": sentence, "entry": entry})
    return recommended
