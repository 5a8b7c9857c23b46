"""Slow twin of the free space between earlier points and the beams of a scan."""

from __future__ import annotations

import math

import numpy as np


def still_there(
    scan: np.ndarray, earlier: np.ndarray, eye: np.ndarray, step: np.ndarray, beyond_m: float
) -> np.ndarray:
    """Twin of `edgeperc.road.sweeps.mark_still_there`: looks through the beams of each direction one by one."""
    n_columns = int(2.0 * math.pi / step[0])

    def place(point: np.ndarray) -> tuple[float, int, int] | None:
        x, y, z = point[:3].astype(float) - [*eye, 0.0]
        if not (math.isfinite(math.hypot(x, y)) and math.isfinite(z)):
            return None
        column = int((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * n_columns) % n_columns
        return math.sqrt(x * x + y * y), column, int((math.atan2(z, math.sqrt(x * x + y * y)) + math.pi / 2) / step[1])

    beams: dict[tuple[int, int], float] = {}
    for point in scan:
        found = place(point)
        if found is not None and found[0] > 0.0:
            beams[found[1:]] = min(beams.get(found[1:], math.inf), found[0])
    answers = []
    for point in earlier:
        found = place(point)
        if found is None or found[0] == 0.0:
            answers.append(True)
            continue
        range_m, column, row = found
        sides = []
        for k in ((column - 1) % n_columns, column, (column + 1) % n_columns):
            below = [beams[k, j] for j in (row, row - 1, row - 2) if (k, j) in beams][:1]
            above = [beams[k, j] for j in (row, row + 1, row + 2) if (k, j) in beams][:1]
            sides.append((below, above))
        told = [end for below, above in sides for end in (*below, *above)]
        is_open = any(below and above for below, above in sides)
        answers.append(not (is_open and all(end > range_m + beyond_m for end in told)))
    return np.array(answers, bool)
