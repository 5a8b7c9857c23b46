"""Slow twin of the contrast of elevations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from edgeperc.readers.origin import Bins


def contrast(points: np.ndarray, seen_from: Iterable[float], bins: Bins) -> float:
    """Twin of `edgeperc.readers.origin.fill_contrasts`: its output for one place and lean."""
    x, y, z, lean_x, lean_y = seen_from
    counts = [0] * (len(bins.tangents) - 1)
    for dx, dy, dz in (points - [x, y, z]).tolist():
        flat = np.sqrt((dx - lean_x * dz) ** 2 + (dy - lean_y * dz) ** 2)
        slope = (dz + lean_x * dx + lean_y * dy) / np.maximum(flat, 1e-9)
        k = int(np.searchsorted(bins.tangents, slope, "right")) - 1  # NaN is beyond the last
        if 0 <= k < len(counts):
            counts[k] += 1
    width = 2 * bins.half + 1
    bands = [sum(counts[max(k - bins.half, 0) : k + bins.half + 1]) / width for k in range(len(counts))]
    differences = sum((count - band) ** 2 for count, band in zip(counts, bands, strict=True))
    return float((differences - sum(counts)) / max(sum(band**2 for band in bands), 1.0))
