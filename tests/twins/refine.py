"""Slow twins of carrying labels back to the points."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np


def neighbors(row: int, col: int, reach: int, shape: tuple[int, int], full_turn: bool) -> Iterator[tuple[int, int]]:
    """Pixels at most ``reach`` rows and columns away, row by row."""
    for r in range(max(row - reach, 0), min(row + reach + 1, shape[0])):
        for c in range(col - reach, col + reach + 1):
            if full_turn or 0 <= c < shape[1]:
                yield r, c % shape[1]


def without_outliers(
    points: np.ndarray, index: np.ndarray, labels: np.ndarray, radii: Any, full_turn: bool
) -> np.ndarray:
    """Twin of `edgeperc.objects.refine.fill_without_outliers`."""
    cleaned = labels.copy()
    seen = np.zeros(labels.shape, dtype=bool)
    for first in np.ndindex(*labels.shape):
        radius = radii[labels[first]]
        if radius <= 0.0 or seen[first]:
            continue
        found = [first]
        seen[first] = True
        for pixel in found:
            for other in neighbors(*pixel, 1, labels.shape, full_turn):
                if not seen[other] and labels[other] == labels[first]:
                    seen[other] = True
                    found.append(other)
        left = [pixel for pixel in found if index[pixel] >= 0]
        draw = first[0] * labels.shape[1] + first[1]
        rim = set()
        for n_objects in range(64):
            if not left:
                break
            ground = np.array([points[index[pixel], :2] for pixel in left], dtype=np.float64)
            tested = ground[:: -(-len(left) // 512)]
            most, center = 0, None
            for _ in range(16):
                draw = (draw * 1103515245 + 12345) % 2**31
                hypothesis = tested[draw * len(tested) // 2**31]
                near = ((tested - hypothesis) ** 2).sum(axis=1) <= radius**2
                if not near.any():  # not finite
                    continue
                hypothesis = tested[near].mean(axis=0)
                near = ((tested - hypothesis) ** 2).sum(axis=1) <= radius**2
                if near.sum() > most:
                    most, center = near.sum(), hypothesis
            inside = np.zeros(len(left), dtype=bool)
            if center is not None:
                inside = ((ground - center) ** 2).sum(axis=1) <= radius**2
            members = [pixel for pixel, near in zip(left, inside, strict=True) if near]
            beyond = [pixel for pixel in members if pixel not in rim]
            is_object = len(members) >= 5 and len(beyond) >= 0.1 * len(members)
            if not members or (n_objects > 0 and not is_object):
                for pixel in left:
                    cleaned[pixel] = 0
                break
            for pixel in members:
                rim.update(neighbors(*pixel, 2, labels.shape, full_turn))
            left = [pixel for pixel, near in zip(left, inside, strict=True) if not near]
    return cleaned


def point_labels(
    points: np.ndarray, pixel: np.ndarray, index: np.ndarray, labels: np.ndarray, full_turn: bool
) -> np.ndarray:
    """Twin of `edgeperc.objects.refine.fill_point_labels`."""
    ranges = np.sqrt((points[:, :3].astype(np.float64) ** 2).sum(axis=1))
    out = np.zeros(len(points), dtype=np.uint8)
    for i, flat in enumerate(pixel):
        if flat < 0:
            continue
        at = divmod(int(flat), labels.shape[1])
        if index[at] == i:
            out[i] = labels[at]
            continue
        around = [p for p in neighbors(*at, 2, labels.shape, full_turn) if index[p] >= 0]
        gaps = [(abs(ranges[index[p]] - ranges[i]), k) for k, p in enumerate(around)]
        votes = [labels[around[k]] for gap, k in sorted(g for g in gaps if g[0] <= 1.0)[:5]]
        out[i] = max(votes, key=votes.count) if votes else 0
    return out
