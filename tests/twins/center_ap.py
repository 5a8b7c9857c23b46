"""Slow twin of `edgeperc.evaluation.center_ap`: the steps of nuScenes' kit (``accumulate``, ``calc_ap``)."""

from __future__ import annotations

import math

import numpy as np

from edgeperc.types.perception import Box


def scores(scans: list[tuple[list[Box], list[Box]]], label: str, farthest_m: float) -> dict[str, float]:
    """Scores of one class from (objects, detections) of every scan, without ignored objects."""
    kept = [
        tuple([b for b in part if b.label == label and math.hypot(*b.center[:2]) <= farthest_m] for part in scan)
        for scan in scans
    ]
    n_truth = sum(len(rights) for rights, _ in kept)
    result: dict[str, float] = {}
    for distance_m in (0.5, 1.0, 2.0, 4.0):
        recall_curve = accumulate(kept, n_truth, distance_m)
        precision = recall_curve["precision"][11:] - 0.1
        precision[precision < 0] = 0
        result[f"ap_{distance_m:g}"] = float(precision.mean()) / 0.9
        if distance_m == 2.0:
            last = np.flatnonzero(recall_curve["confidence"])
            last_index = int(last[-1]) if len(last) else 0
            for name in ("ate", "ase", "aoe"):
                values = recall_curve[name]
                result[name] = 1.0 if last_index < 11 else float(np.mean(values[11 : last_index + 1]))
    result["ap"] = sum(result[f"ap_{d:g}"] for d in (0.5, 1.0, 2.0, 4.0)) / 4
    return result


def accumulate(kept: list[tuple[list[Box], ...]], n_truth: int, distance_m: float) -> dict[str, np.ndarray]:
    order = sorted(((k, guess) for k, (_, guesses) in enumerate(kept) for guess in guesses), key=lambda p: -p[1].score)
    taken: set[tuple[int, int]] = set()
    tp, fp, confidence = [], [], []
    data: dict[str, list[float]] = {"ate": [], "ase": [], "aoe": [], "confidence": []}
    for k, guess in order:
        nearest, best = math.inf, -1
        for i, right in enumerate(kept[k][0]):
            away = math.hypot(guess.center[0] - right.center[0], guess.center[1] - right.center[1])
            if (k, i) not in taken and away < nearest:
                nearest, best = away, i
        hit = nearest < distance_m
        tp.append(float(hit))
        fp.append(float(not hit))
        confidence.append(guess.score)
        if hit:
            taken.add((k, best))
            right = kept[k][0][best]
            shared = math.prod(min(a, b) for a, b in zip(guess.size, right.size, strict=True))
            data["ate"].append(nearest)
            data["ase"].append(1.0 - shared / (math.prod(guess.size) + math.prod(right.size) - shared))
            turn = (guess.yaw - right.yaw + math.pi) % (2 * math.pi) - math.pi
            data["aoe"].append(abs(turn))
            data["confidence"].append(guess.score)
    if not data["confidence"]:
        return {"precision": np.zeros(101), "confidence": np.zeros(101)} | {
            k: np.ones(101) for k in data if k[0] == "a"
        }
    sums, misses = np.cumsum(tp), np.cumsum(fp)
    levels = np.linspace(0, 1, 101)
    recall = sums / n_truth
    at = np.interp(levels, recall, confidence, right=0)
    curves = {"precision": np.interp(levels, recall, sums / (sums + misses), right=0), "confidence": at}
    for name in ("ate", "ase", "aoe"):
        means = np.cumsum(data[name]) / np.arange(1, len(data[name]) + 1)
        curves[name] = np.interp(at[::-1], data["confidence"][::-1], means[::-1])[::-1]
    return curves
