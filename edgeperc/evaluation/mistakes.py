"""What a picture of mistakes needs to know about a scan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..perception import Box

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
        1: a point of an object, not labeled as its class. 2: a point of no object, labeled as one. 0: all others.
    found : tuple of Box
        True boxes that were found.
    missed : tuple of (Box, int)
        True boxes that were not found, and the number of points in each.
    false : tuple of Box
        Predicted boxes where there is no object.
    wrong_share : float
        Wrong points, as a share of the points that belong to objects or were labeled as objects.
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
        """Missed and false boxes, plus `wrong_share`, which ranks scans with equally many; 0 without any mistake."""
        return len(self.missed) + len(self.false) + self.wrong_share

    @property
    def summary(self) -> str:
        """Such as ``"missed: 2 car, 1 cyclist (340 points); false: 1 car; 57 points wrong"``."""

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
