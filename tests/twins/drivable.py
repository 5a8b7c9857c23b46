"""Slow twins of the road ahead."""

from __future__ import annotations

import itertools
import math

import numpy as np


def free_cells(drivable):
    """Twin of `edgeperc.drivable.fill_free`."""
    return [len(list(itertools.takewhile(bool, column[::-1]))) for column in drivable.T]


def corridor(drivable, first, last):
    """Twin of `edgeperc.drivable.fill_corridor`: runs of every row, and how much of the last one they share."""
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


def connected(cells, row, col):
    """Twin of `edgeperc.drivable.mark_connected`: the part grows until it no longer does."""
    part = np.zeros_like(cells)
    part[row, col] = True
    while True:
        padded = np.pad(part, 1)
        grown = part | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
        grown &= cells
        if (grown == part).all():
            return part
        part = grown


def sides(cells):
    """What the rings of `edgeperc.drivable.fill_rings` consist of: sides from corner to corner, cells to the left."""
    found = set()
    for row, col in np.argwhere(cells).tolist():
        square = [(row + 1, col), (row + 1, col + 1), (row, col + 1), (row, col)]
        for k, (dr, dc) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
            if not cells[row + dr, col + dc]:
                found.add((square[k], square[(k + 1) % 4]))
    return found


def simplified(line, tolerance):
    """Douglas and Peucker's corners of an open line, as indices: twin of half of `edgeperc.drivable.mark_kept`."""
    (x, y), (ex, ey) = line[0], line[-1]
    dx, dy = ex - x, ey - y
    length2 = dx * dx + dy * dy
    offs = []
    for px, py in line[1:-1]:
        along = min(max(((px - x) * dx + (py - y) * dy) / length2, 0.0), 1.0) if length2 > 0 else 0.0
        offs.append(math.hypot(px - x - along * dx, py - y - along * dy))
    if not offs or max(offs) <= tolerance:
        return [0, len(line) - 1]
    worst = offs.index(max(offs)) + 1
    return simplified(line[: worst + 1], tolerance) + [worst + k for k in simplified(line[worst:], tolerance)[1:]]
