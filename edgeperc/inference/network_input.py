"""A scan as a network sees it: its projection, with the height above the ground if the input has that channel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..ground.planes import find_ground
from ..types.mounting import MODEL_HEIGHT_M
from .projection import Projection, RangeImageProjector, TopViewProjector

__all__ = ["input_heights", "project"]


def input_heights(
    projector: TopViewProjector | RangeImageProjector, points: NDArray[np.float32]
) -> NDArray[np.float32] | None:
    """Heights of points of the models' frame above the ground, (n,) float32 [m]; None if the projector needs none."""
    return find_ground(points, mount_height_m=MODEL_HEIGHT_M).height_m if projector.needs_ground else None


def project(projector: TopViewProjector | RangeImageProjector, points: NDArray[np.float32]) -> Projection:
    """Project a scan and, if the projector needs it, find the ground first, as a `Perceiver` does.

    Parameters
    ----------
    projector : TopViewProjector or RangeImageProjector
    points : (n, 4) float32, C-contiguous
        x, y, z [m] in the frame of the models, remission in 0..1.

    Returns
    -------
    Projection

    Raises
    ------
    PointsError
        ``points`` has another shape, dtype or layout.
    """
    return projector.project(points, input_heights(projector, points))
