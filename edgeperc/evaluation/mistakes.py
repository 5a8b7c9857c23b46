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
    """A scan held against its truth, to be drawn.

    Attributes
    ----------
    name, drive : str
    points : (n, 4) float32
        Those to be drawn.
    wrong : (n,) uint8
        1 where a point of an object was not labelled as its class, 2 where a point of none was labelled as one.
    found : tuple of Box
        True boxes that were found.
    missed : tuple of (Box, int)
        True boxes that were not, and the points in each.
    false : tuple of Box
        Predicted boxes where there is nothing.
    wrong_share : float
        Wrong points, of those that belong to objects or were said to.
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
        """Boxes missed and boxes made up; among equals, scans with more wrong points come first."""
        return len(self.missed) + len(self.false) + self.wrong_share

    @property
    def words(self) -> str:
        """Such as ``"missed: 2 car, 1 cyclist (340 points); false: 1 car"``."""

        def listed(boxes: Sequence[Box]) -> str:
            return ", ".join(f"{n} {label}" for label, n in Counter(box.label for box in boxes).most_common())

        told = []
        if self.missed:
            n_points = sum(n for _, n in self.missed)
            told.append(f"missed: {listed([box for box, _ in self.missed])} ({n_points:,} points)")
        if self.false:
            told.append(f"false: {listed(self.false)}")
        return "; ".join(told) or "no box missed or false"
