"""Tables of a comparison: latencies, and each contender's share of the machine's peak."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from edgeperc.session import Session

from ..accuracy import agreement
from ..render import number, share
from ..samples import noise_floor, summary
from .arithmetic import COPY_BYTES, PRODUCT_SIZE, cost
from .contenders import INSTALL, OPENVINO, Contender, Found, absent

__all__ = ["floor_table", "latency_table"]


def latency_table(title: str, found: Sequence[Found], n_threads: int) -> dict[str, Any]:
    """Times of all contenders but the machine's peaks, beside those of the first."""
    shown = [each for each in found if each.contender.kind != "peak"]
    first = shown[0]
    rows = []
    for each in shown:
        told = summary(each.ms)
        agree = agreement(first.answers, each.answers) if first.answers and each.answers else {}
        equal = [agree[kind]["equal"] for kind in ("points", "cells") if agree.get(kind)]
        boxes = agree.get("boxes")
        rows.append(
            [
                *(each.contender.name, f"{told['n']:,}", *(number(told[q]) for q in ("p50", "p90", "p99"))),
                share(noise_floor([np.ravel(part) for part in np.array_split(np.array(each.rounds), 3)])),
                *(number(each.p50 / first.p50), share(min(equal, default=None))),
                f"{boxes['n_both']} of {boxes['n_reference']}" if boxes else "-",
                *(number(each.rss_mb, 0), each.why_not or "-"),
            ]
        )
    words = [
        f"ms; {n_threads} threads for every library; ratios are to the first row; noise: spread of the medians of "
        "three thirds; labels and boxes: those in common with the first row"
    ]
    if any(each.contender.kind == "rival" for each in shown):
        words.append("rivals leave out PointSeg's removal of outliers: they do less than edgeperc")
    for alone in (each for each in shown if each.contender.kind == "network" and each.contender.engine in OPENVINO):
        ratios = [
            f"{each.contender.name} {number(each.p50 / alone.p50)}"
            for each in shown
            if each.contender.kind == "edgeperc" and each.ms and alone.ms
        ]
        if ratios:
            words.append(f"whole way / {alone.contender.name}: {'; '.join(ratios)}")
    head = ["contender", "n", "p50", "p90", "p99", "noise", "x edgeperc", "labels equal", "boxes", "RSS MB", "note"]
    return {"title": title, "sentences": words, "head": head, "rows": rows}


def floor_table(title: str, found: Sequence[Found]) -> dict[str, Any]:
    """What the network of a table could take at least on this machine, and what it takes."""
    (path,) = found[0].contender.paths
    words, rows = [], []
    best_ms = {each.contender.engine: min(each.ms) for each in found if each.contender.kind == "peak" and each.ms}
    bytes_per_ms = 2.0 * COPY_BYTES / best_ms["copy"] if "copy" in best_ms else math.nan
    words.append(f"memory: {number(bytes_per_ms / 1e6, 1)} GB/s read and written by a copy")
    if absent(Contender("", "network", "torch")):
        words.append(f"multiplications are not counted: onnx is {INSTALL}")
    else:
        needs, rounded = cost(path), Session(path, "cpu").card.precision == "int8"
        words.append(
            f"{needs.macs / 1e9:.2f} GMAC, {needs.padding_macs / 1e9:.2f} of them on padding, which the floor leaves "
            f"out; {needs.weights / 1e6:.1f} M weights; {needs.activations / 1e6:.1f} M activations"
        )
        for precision, n_bytes in (("fp32", 4), ("bf16", 2), ("int8", 1)):
            peaks = {name: ms for name, ms in best_ms.items() if name.endswith(precision)}
            library = min(peaks, key=lambda name: peaks[name], default="")
            rate = PRODUCT_SIZE**3 / peaks[library] if library else math.nan
            floor = (needs.macs - needs.padding_macs) / rate
            networks = [
                each
                for each in found
                if each.contender.kind in ("network", "session")
                and each.ms
                and ("int8" if rounded else precision_of(each.contender)) == precision
            ]
            fastest = min(networks, key=lambda each: each.p50, default=None)
            took = fastest.p50 if fastest else math.nan
            rows.append(
                [
                    *(precision, number(rate / 1e6, 0), library.partition(":")[0] or "-", number(floor)),
                    *(number(n_bytes * (needs.weights + needs.activations) / bytes_per_ms), number(took)),
                    *(fastest.contender.name if fastest else "-", share(floor / took)),
                ]
            )
    head = ["precision", "peak GMAC/s", "by", "floor ms", "traffic ms", "network ms", "by", "share of peak"]
    words.append(
        "peak: the fastest matrix product seen; traffic: every layer's numbers from and to memory once, which "
        "caches save"
    )
    return {"title": f"Floor: {title.partition(': ')[2]}", "sentences": words, "head": head, "rows": rows}


def precision_of(contender: Contender) -> str:
    return contender.engine.partition(":")[2] or "fp32"
