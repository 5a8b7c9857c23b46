"""Slow twin of the votes for the beams of a sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np


def votes(flat: Sequence[float], z: Sequence[float], offsets_m: Sequence[float], up: float, n_bins: int) -> np.ndarray:
    """Twin of `edgeperc.preprocess.sensor_estimate.fill_votes`: its output."""
    found = np.zeros((len(offsets_m), n_bins))
    for row, offset in enumerate(offsets_m):
        for distance, height in zip(flat, z, strict=True):
            elevation = math.atan2(height - offset, distance)
            place = (elevation + up) / (2.0 * up) * n_bins
            if math.isfinite(place) and 0.0 <= place < n_bins:
                found[row, math.floor(place)] += 1.0
    return found
