"""Slow twin of the points in boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def in_boxes(boxes: Sequence[Any], points: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.tracking.moving.mark_in_boxes`: each point is turned into the frame of each box."""
    found = []
    for point in points[:, :3].astype(float):
        there = False
        for row in boxes:
            x, y, z = point - row[:3]
            c, s = row[6:]
            there |= bool((np.abs([[c, s], [-s, c]] @ np.array([x, y])) <= row[3:5]).all() and abs(z) <= row[5])
        found.append(there)
    return np.array(found, bool)
