"""The scan that the stages work on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import PointsError
from ..types.perception import PointLabels
from ..types.points import Cloud, Points, check_each, read_only
from .planes import Ground


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Points in the frame of the models with the ground below them; every stage trusts it."""

    points: Points  # (n, 4) x, y, z [m], remission in 0..1; a row that is not finite is NaN
    ground: Ground  # of these points; its arrays are read-only

    @property
    def cloud(self) -> Cloud:
        """The points as kernels take them."""
        return Cloud(self.points, self.ground.height_m)

    @classmethod
    def of(cls, points: Points, ground: Ground, labels: PointLabels | None = None) -> Scan:
        """A scan of given arrays, which are checked and not copied."""
        if points.ndim != 2 or points.shape[1] < 3:
            raise PointsError(f"got points of shape {points.shape}; expected (n, 4): x, y, z, remission")
        if labels is not None:
            if labels.labels.size and int(labels.labels.max()) >= len(labels.classes):
                raise PointsError(
                    f"got label {int(labels.labels.max())} for {len(labels.classes)} classes; expected lower numbers"
                )
            check_each(len(points), **{"labels.labels": labels.labels, "labels.in_view": labels.in_view})
        check_each(len(points), **{"ground.height_m": ground.height_m, "ground.mask": ground.mask})
        heights = Ground(read_only(ground.mask, np.bool_), read_only(ground.height_m), ground.plane)
        return cls(read_only(points), heights)
