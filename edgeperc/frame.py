"""The frame that the models work in.

The models were trained on scans of one vehicle: x forward, the road 1.73 m below the sensor. `ModelFrame` moves a scan
of any mounting into that frame, and boxes there and back.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from .perception import Box
from .points import read_only

__all__ = ["ModelFrame"]


class ModelFrame:
    """Moves scans into the frame of the models, and boxes back.

    Parameters
    ----------
    mounting : Mounting
        A known one.

    Attributes
    ----------
    is_identity : bool
        Scans need not be moved.
    R : (3, 3) float64
    t : (3,) float64
        A point p of the scan lies at ``R p + t`` [m] in the models' frame.
    """

    def __init__(self, mounting: Mounting) -> None:
        assert mounting.height_m is not None
        from_vehicle = MODEL_MOUNTING.rotation().T
        self.R: NDArray[np.float64] = from_vehicle @ mounting.rotation()
        raised = from_vehicle @ np.array([0.0, 0.0, mounting.height_m - MODEL_HEIGHT_M])
        self.t: NDArray[np.float64] = raised - self.R @ np.array([*mounting.origin_m, 0.0])
        self.is_identity = bool(np.allclose(self.R, np.eye(3), atol=1e-9) and np.allclose(self.t, 0.0, atol=1e-6))

    def move(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Scan (n, 4) in the models' frame; the same array if nothing moves."""
        if self.is_identity:
            return points
        moved = np.empty_like(points, order="C")
        moved[:, 3] = points[:, 3]
        with np.errstate(over="ignore", invalid="ignore"):
            # Coordinates of a world frame need more than float32 until they are shifted.
            xyz = points[:, :3].astype(np.float64) if abs(self.t).max() > 1e3 else points[:, :3]
            moved[:, :3] = xyz @ self.R.T.astype(xyz.dtype) + self.t.astype(xyz.dtype)
        return read_only(moved)

    def move_boxes(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Boxes of the scan's frame in the models' frame. They stay upright: a box has no tilt."""
        return tuple(boxes) if self.is_identity else _moved(boxes, self.R, self.t)

    def boxes_back(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Boxes of the models' frame in the frame of the scan."""
        return tuple(boxes) if self.is_identity else _moved(boxes, self.R.T, -self.R.T @ self.t)


def _moved(boxes: Iterable[Box], R: NDArray[np.float64], t: NDArray[np.float64]) -> tuple[Box, ...]:
    moved = []
    for box in boxes:
        x, y, z = (R @ np.array(box.center) + t).tolist()
        ahead = R[:, 0] * math.cos(box.yaw) + R[:, 1] * math.sin(box.yaw)
        moved.append(replace(box, center=(x, y, z), yaw=math.atan2(ahead[1], ahead[0])))
    return tuple(moved)
