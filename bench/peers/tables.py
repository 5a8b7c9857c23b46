"""Tables of a comparison: latencies, and each network's share of the machine's peak."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from edgeperc.types.card import ModelCard

from ..accuracy import agreement
from ..render import number, share
from ..samples import noise_floor, percentile, summary
from .arithmetic import COPY_BYTES, PRODUCT_SIZE, cost
from .contenders import INSTALL, OPENVINO, Contender, Measured, why_missing


def latency_table(title: str, measured: Sequence[Measured], n_threads: int) -> dict[str, Any]:
    """Table of the times of all contenders except the machine's peaks, with ratios to the first."""
    shown = [each for each in measured if each.contender.kind != "peak"]
    first = shown[0]
    rows = []
    for each in shown:
        figures = summary(each.ms)
        same = agreement(first.predictions, each.predictions) if first.predictions and each.predictions else {}
        equal = [same[kind]["equal"] for kind in ("points", "cells", "pixels") if same.get(kind)]
        boxes = same.get("boxes")
        times = f"{figures['n']:,}", *(number(figures[q]) for q in ("p50", "p90", "p99"))
        noise = share(noise_floor([np.ravel(part) for part in np.array_split(np.array(each.rounds), 3)]))
        found = f"{boxes['n_both']} of {boxes['n_reference']}" if boxes else "-"
        compared = number(each.p50 / first.p50), share(min(equal, default=None)), found
        rows.append([each.contender.name, *times, noise, *compared, number(each.rss_mb, 0), each.missing or "-"])
    sentences = [
        f"ms; {n_threads} threads for every library; ratios are to the first row; noise: spread of the medians of the "
        "three thirds; labels and boxes: those equal to the first row's"
    ]
    if first.contender.inputs:
        sentences.append("images of simulated streets, at the size of the model's input")
    elif any(each.contender.kind == "pipeline" for each in shown):
        sentences.append("the numpy pipelines leave out PointSeg's removal of outliers, so they do less than edgeperc")
    whole = [each for each in shown if each.contender.kind == "edgeperc" and each.ms]
    for alone in (each for each in shown if each.contender.kind == "network" and each.ms and whole):
        if (alone.contender.engine, alone.contender.precision) in OPENVINO:
            ratios = (f"{each.contender.name} {number(each.p50 / alone.p50)}" for each in whole)
            sentences.append(f"scan to result / {alone.contender.name}: {'; '.join(ratios)}")
    head = ["contender", "n", "p50", "p90", "p99", "noise", "x edgeperc", "labels equal", "boxes", "RSS MB", "note"]
    return {"title": title, "sentences": sentences, "head": head, "rows": rows}


def methods_table(title: str, measured: Sequence[Measured], n_threads: int) -> dict[str, Any]:
    """Table of quartiles of whole answers, networks and methods, with the part that is timed."""
    rows = []
    for each in measured:
        quartiles = [number(percentile(each.ms, q)) for q in (25.0, 50.0, 75.0)]
        ratio = number(each.p50 / measured[0].p50)
        end = number(each.rss_mb, 0), each.missing or "-"
        rows.append([each.contender.name, each.contender.timed, f"{len(each.ms):,}", *quartiles, ratio, *end])
    sentences = [
        f"ms; onnxruntime's CPU provider, {n_threads} threads; ratios are of medians to the first row",
        "weights of others are random: they take the time of trained ones, and their answers mean nothing",
    ]
    head = ["contender", "timed", "n", "25 %", "median", "75 %", "x edgeperc", "RSS MB", "note"]
    return {"title": title, "sentences": sentences, "head": head, "rows": rows}


def floor_table(title: str, measured: Sequence[Measured]) -> dict[str, Any]:
    """Table of the lower bound for a network's time on this machine, and of its measured time."""
    (path,) = measured[0].contender.paths
    peaks = {
        (each.contender.engine, each.contender.precision): min(each.ms)
        for each in measured
        if each.contender.kind == "peak" and each.ms
    }
    bytes_per_ms = 2.0 * COPY_BYTES / peaks["copy", ""] if ("copy", "") in peaks else math.nan
    sentences = [f"memory: {number(bytes_per_ms / 1e6, 1)} GB/s read and written by a copy"]
    rows = []
    if why_missing(Contender("", "network", "torch")):
        sentences.append(f"multiplications are not counted: onnx is {INSTALL}")
    else:
        work, stored = cost(path), "int8" if ModelCard.read(path).precision == "int8" else "fp32"
        as_stored = ("", "auto", "fp32", "bf16") if stored == "int8" else ("", "auto")
        runs = [each for each in measured if each.contender.kind in ("network", "session") and each.ms]
        computed_in = [stored if each.contender.precision in as_stored else each.contender.precision for each in runs]
        sentences.append(
            f"{work.macs / 1e9:.2f} GMAC, {work.padding_macs / 1e9:.2f} of them on padding, which the floor leaves "
            f"out; {work.weights / 1e6:.1f} M weights; {work.activations / 1e6:.1f} M activations"
        )
        for precision, n_bytes in (("fp32", 4), ("bf16", 2), ("int8", 1)):
            of_precision = {engine: ms for (engine, kind), ms in peaks.items() if kind == precision}
            library = min(of_precision, key=lambda engine: of_precision[engine], default="")
            rate = PRODUCT_SIZE**3 / of_precision[library] if library else math.nan
            floor = (work.macs - work.padding_macs) / rate
            networks = [each for each, kind in zip(runs, computed_in, strict=True) if kind == precision]
            fastest = min(networks, key=lambda each: each.p50, default=None)
            took = fastest.p50 if fastest else math.nan
            peak, traffic = number(rate / 1e6, 0), number(n_bytes * (work.weights + work.activations) / bytes_per_ms)
            fastest_is = number(took), fastest.contender.name if fastest else "-", share(floor / took)
            rows.append([precision, peak, library or "-", number(floor), traffic, *fastest_is])
    head = ["precision", "peak GMAC/s", "by", "floor ms", "traffic ms", "network ms", "by", "share of peak"]
    sentences.append(
        "peak: the fastest matrix product; traffic: all values of every layer to and from memory once, less with caches"
    )
    return {"title": f"Floor: {title.partition(': ')[2]}", "sentences": sentences, "head": head, "rows": rows}
