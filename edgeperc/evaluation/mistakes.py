"""Missed objects, false detections and wrong points of a scan, for a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types.perception import Box

__all__ = ["Mistakes"]


@dataclass(frozen=True, eq=False)
class Mistakes:
    """A scan compared with its ground truth, to be drawn.

    Attributes
    ----------
    name, drive : str
    points : (n, 4) float32
        The points to draw: x, y, z [m] in the sensor frame, remission.
    wrong : (n,) uint8
        1: point of an object with another label. 2: background point with the label of an object. 0: all others.
    found : tuple of Box
        True boxes that were found.
    missed : tuple of (Box, int)
        True boxes that were not found, and the number of points in each.
    false : tuple of Box
        Predicted boxes where there is no object.
    wrong_share : float
        Wrong points divided by all points that are on objects or were labeled as objects.
    """

    name: str
    drive: str
    points: NDArray[np.float32]
    wrong: NDArray[np.uint8]
    found: tuple[Box, ...] = ()
    missed: tuple[tuple[Box, int], ...] = ()
    false: tuple[Box, ...] = ()
    wrong_share: float = 0.0

    @property
    def n_errors(self) -> float:
        """Number of missed and false boxes, plus `wrong_share` to rank scans with equal numbers; 0 without mistakes."""
        return len(self.missed) + len(self.false) + self.wrong_share

    @property
    def summary(self) -> str:
        """One line, such as ``"missed: 2 car, 1 cyclist (340 points); false: 1 car; 57 points wrong"``."""

        def listed(boxes: Sequence[Box]) -> str:
            return ", ".join(f"{n} {label}" for label, n in Counter(box.label for box in boxes).most_common())

        parts = []
        if self.missed:
            n_points = sum(n for _, n in self.missed)
            parts.append(f"missed: {listed([box for box, _ in self.missed])} ({n_points:,} points)")
        if self.false:
            parts.append(f"false: {listed(self.false)}")
        n_wrong = int(np.count_nonzero(self.wrong))
        if n_wrong:
            parts.append(f"{n_wrong:,} point{'s' * (n_wrong != 1)} wrong")
        return "; ".join(parts) or "no mistake"
