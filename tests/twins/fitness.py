"""Slow twins of measuring a scan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def scan_sums(points: np.ndarray, step: int, beam_step: int, view_right: float, view_left: float) -> tuple[Any, ...]:
    """Twin of `edgeperc.preprocess.fitness.fill_scan_sums`: its outputs in their order, but ``rows`` as eight lists."""

    def finite(rows: np.ndarray) -> np.ndarray:
        return rows[np.isfinite(rows).all(axis=1)].astype(np.float64)

    remissions, elevations, ranges = np.zeros(258, int), np.zeros(360, int), np.zeros(200, int)
    heights, seen, n_near, n_view = np.zeros((3, 100), int), np.zeros(64, bool), 0, 0
    far = np.zeros(64, int)
    sample = finite(points[::step])
    for x, y, z, remission in sample:
        remissions[0 if remission <= 0 else 257 if remission > 1 else 1 + min(int(remission * 256), 255)] += 1
        if x == 0 and y == 0:
            continue
        azimuth = y / (abs(x) + abs(y))
        if x < 0:
            azimuth = (2 if y >= 0 else -2) - azimuth
        seen[min(int((azimuth + 2) * 16), 63)] = True
        n_view += view_right <= azimuth <= view_left
        horizontal = math.sqrt(x * x + y * y)
        if x * x + y * y + z * z > 9:
            far[min(int((azimuth + 2) * 16), 63)] += 1
            elevations[min(int((math.atan(z / horizontal) * (180 / math.pi) + 90) * 2), 359)] += 1
        ranges[min(max(int((math.log10(horizontal) + 3) * 20), 0), 199)] += 1
        if 9 < x * x + y * y + z * z < 625:
            n_near += 1
            for axis, value in enumerate((x, y, z)):
                if -10 <= value < 10:
                    heights[axis, min(int((value + 10) * 5), 99)] += 1
    middles = (np.arange(64) + 0.5) / 16 - 2
    viewed = (middles >= view_right) & (middles <= view_left)

    x, y, z, remission = sample.T
    above = z - (heights[2].argmax() * 0.2 - 9.9)
    stands = (above > 0.5) & (above < 6) & (abs(x) < 30) & (abs(y) < 30)
    x, y = x[stands], y[stands]
    in_the_way = [(abs(y) < 2) & (x > 3), (abs(y) < 2) & (x < -3), (abs(x) < 2) & (y > 3), (abs(x) < 2) & (y < -3)]
    ahead, behind, left, right = (way.sum() + 0.002 * max(len(sample), 1) for way in in_the_way)
    along_x, along_y = (np.histogram(v, np.arange(-30, 30.1, 0.5))[0] for v in (x, y))
    alignment = np.log(max(left, right) / max(ahead, behind))
    alignment += 0.5 * np.log(((along_y**2).sum() + 1) / ((along_x**2).sum() + 1))

    rows = [[] for _ in range(8)]
    for x, y, z, _ in finite(points[::beam_step]):
        more, less = max(abs(x), abs(y)), min(abs(x), abs(y))
        if more > 1 and (less < 0.0044 * more or more - less < 0.0087 * more):
            direction = round(math.degrees(math.atan2(y, x)) / 45) % 8
            if len(rows[direction]) < 1024:
                rows[direction].append(math.degrees(math.atan(z / math.sqrt(x * x + y * y))))
    unevenness = far.max() * np.count_nonzero(far) / max(far.sum(), 1)
    lowest, highest = (remission.min(), remission.max()) if len(sample) else (np.inf, -np.inf)
    sums = [len(sample), n_view, seen.sum(), seen[viewed].sum() / max(viewed.sum(), 1)]
    return remissions, elevations, ranges, heights, rows, [*sums, alignment, lowest, highest, n_near, unevenness]
