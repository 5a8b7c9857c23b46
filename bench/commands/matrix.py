"""``edgeperc-bench matrix``: every combination of providers, precisions and threads; the recommended one."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeperc import EdgepercError
from edgeperc.session import PRECISIONS, PROVIDERS, available_providers
from edgeperc.tuning import write_settings
from edgeperc.zoo import DEFAULT

from .. import report
from ..options import SINGLE_STREAM
from ..samples import compare, percentile
from ..scenarios import Limits
from ..worker import Answer, Job, Scenario
from .common import new_document, prepare_input
from .compare import setting_label

if TYPE_CHECKING:
    from ..inputs import Input

__all__ = ["matrix_command"]


# matrix


def matrix_command(arguments: argparse.Namespace) -> int:
    from ..measure import reference

    limits = Limits(arguments.min_scans, arguments.min_seconds, arguments.warm_up)
    with new_document("matrix", arguments) as (document, live), tempfile.TemporaryDirectory() as folder:
        providers, skipped = settings_to_try(arguments.providers, arguments.precisions, available_providers())
        for words in skipped:
            document["skipped"].append(words)
            live.say(f"skipped: {words}")
        given = prepare_input(arguments, Path(folder), document, live)
        for model in dict.fromkeys(arguments.model or DEFAULT):
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
    from ..measure import judged, new_setting, repeat

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
            words += f"; the next, {setting_label(ranked[1])}, {sure}"
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
