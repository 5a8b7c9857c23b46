"""PointPillars' pillars, with random weights (Lang et al., 2019, section 2.1)."""

from __future__ import annotations

import numpy as np

from edgeperc.system.extras import require
from edgeperc.types.points import Floats32

njit = require("numba", "peers", "edgeperc-bench peers").njit

CELL_M = 0.16
LOWEST_M, HIGHEST_M = -3.0, 1.0
N_VALUES, N_FEATURES = 9, 64


def random_weights() -> Floats32:
    """The linear layer from a point's values to its features, (9, 64)."""
    return np.random.default_rng(0).standard_normal((N_VALUES, N_FEATURES), np.float32)


@njit(cache=True, nogil=True)
def fill_pillars(points: Floats32, weights: Floats32, image: Floats32) -> None:
    """Write the image (64, H, W) of a scan (n, 4): rows along y around 0, x from 0. The paper's limits of 12,000
    pillars and 100 points each serve tensors of a fixed size, which loops do not need.
    """
    image.fill(0.0)
    n, n_pillars, (_, n_rows, n_columns) = len(points), 0, image.shape
    pillar_at, pillar_of = np.full((n_rows, n_columns), -1, np.int32), np.full(n, -1, np.int32)
    cells, sums, features = np.empty((n, 2), np.int32), np.zeros((n, 4)), np.zeros((n, N_FEATURES), np.float32)
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        up, along = np.floor(y / CELL_M) + n_rows // 2, np.floor(x / CELL_M)
        if not (0 <= up < n_rows and 0 <= along < n_columns and LOWEST_M <= z < HIGHEST_M):
            continue
        row, column = int(up), int(along)
        k = pillar_at[row, column]
        if k < 0:
            k = pillar_at[row, column] = n_pillars
            cells[k, 0], cells[k, 1] = row, column
            n_pillars += 1
        pillar_of[i] = k
        for axis in range(3):
            sums[k, axis] += points[i, axis]
        sums[k, 3] += 1.0
    values = np.empty(N_VALUES, np.float32)
    for i in range(n):
        k = pillar_of[i]
        if k < 0:
            continue
        for axis in range(4):
            values[axis] = points[i, axis]
        for axis in range(3):
            values[4 + axis] = points[i, axis] - sums[k, axis] / sums[k, 3]
        values[7] = points[i, 0] - (cells[k, 1] + 0.5) * CELL_M
        values[8] = points[i, 1] - (cells[k, 0] - n_rows // 2 + 0.5) * CELL_M
        for j in range(N_FEATURES):
            value = np.float32(0.0)
            for v in range(N_VALUES):
                value += values[v] * weights[v, j]
            features[k, j] = max(features[k, j], value)
    for j in range(N_FEATURES):
        for k in range(n_pillars):
            image[j, cells[k, 0], cells[k, 1]] = features[k, j]
