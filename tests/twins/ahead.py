"""Slow twins of the road ahead."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np


def first_cells(objects: np.ndarray, known: np.ndarray, road: np.ndarray) -> Any:
    """Twin of `edgeperc.road.ahead.fill_first_cells`."""
    kinds = (objects, known & ~road & ~objects, ~known & ~objects)
    return [[len(list(itertools.takewhile(lambda cell: not cell, c[::-1]))) for c in kind.T] for kind in kinds]


def corridor(drivable: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.road.ahead.fill_corridor`: runs of every row, and how much of the last one they share."""
    bounds = np.full((len(drivable), 2), -1)
    before, begun = (first, last), False
    for row in reversed(range(len(drivable))):
        edges = np.flatnonzero(np.diff(drivable[row].astype(int), prepend=0, append=0)).reshape(-1, 2).tolist()
        shared = [min(b, before[1]) - max(a, before[0]) for a, b in edges]
        if shared and max(shared) > 0:
            before, begun = edges[shared.index(max(shared))], True
            bounds[row] = before
        elif begun:
            break
    return bounds
