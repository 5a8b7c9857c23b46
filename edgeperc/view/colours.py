"""Colours of classes, points and boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..perception import Box, Perception

__all__ = [
    "AMBER",
    "CLASS_COLOURS",
    "EDGES",
    "FAINT",
    "FALSE",
    "FOUND",
    "GROUND",
    "HIGH",
    "INK",
    "LOW",
    "MISSED",
    "PANEL",
    "box_corners",
    "check_points",
    "colour_of",
    "ground_height",
    "paint_points",
    "ramp",
    "rgb",
    "timing_line",
]

# Okabe and Ito's palette: tells the classes apart for colour-blind readers too, and stays clear on dark ground.
CLASS_COLOURS = {
    "background": "#8493a3",
    "drivable": "#009e73",
    "car": "#e69f00",
    "van": "#f0e442",
    "truck": "#d55e00",
    "pedestrian": "#cc79a7",
    "cyclist": "#56b4e9",
}
_OTHER_COLOUR = "#ffffff"
INK, FAINT, PANEL, GROUND = "#e8edf2", "#8b98a7", "#0b0f14", "#131920"
AMBER = "#ffc46b"

# From the ground up (height) and from near to far (range): dim and cool, so that the classes stand out.
LOW, HIGH = "#3a5067", "#c3d0dd"
FOUND, MISSED, FALSE = "#00b98a", "#ff5c5c", "#ffa928"


def check_points(points: NDArray[np.float32], perception: Perception) -> None:
    """Raise `PointsError` unless the points are the scan that was perceived."""
    if points.ndim != 2 or points.shape[1] != 4:
        raise PointsError(f"points have shape {points.shape}; expected (n, 4): x, y, z, remission")
    if len(points) != perception.n_points:
        raise PointsError(
            f"{len(points)} points with a perception of {perception.n_points}; expected the scan that was perceived"
        )


def colour_of(name: str) -> str:
    """The colour of a class."""
    return CLASS_COLOURS.get(name, _OTHER_COLOUR)


def rgb(colours: list[str]) -> NDArray[np.float64]:
    """Colours "#rrggbb" as (n, 3) in 0..1."""
    return np.array([[int(c[k : k + 2], 16) / 255.0 for k in (1, 3, 5)] for c in colours]).reshape(-1, 3)


def ramp(value: NDArray[Any], low: float, high: float) -> NDArray[np.float64]:
    """Shade ``value`` from LOW to HIGH, (n, 3)."""
    share = np.clip((value - low) / (high - low), 0.0, 1.0)[..., None]
    dim, bright = rgb([LOW, HIGH])
    return np.asarray(dim + share * (bright - dim))


def timing_line(perception: Perception) -> str:
    """Milliseconds in all and by stage."""
    total = sum(perception.stage_ms.values())
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in perception.stage_ms.items())
    return f"{total:.1f} ms ({stages})" if perception.stage_ms else "not timed"


def paint_points(points: NDArray[np.float32], perception: Perception) -> tuple[list[str], NDArray[np.uint8]]:
    """Classes of both views, and one for every point: its own, else what its cell of the top view lends it."""
    names = list(perception.points.classes if perception.points is not None else ("background",))
    painted = np.zeros(len(points), dtype=np.uint8)
    if perception.points is not None:
        painted[:] = perception.points.labels
    top_view = perception.top_view
    if top_view is None:
        return names, painted
    names += [name for name in top_view.classes if name not in names]
    finite = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    x, y, z = points[finite, :3].astype(np.float64).T
    row = np.floor((top_view.x_range_m[1] - x) / top_view.cell_m)
    col = np.floor((top_view.y_range_m[1] - y) / top_view.cell_m)
    inside = (row >= 0) & (row < top_view.labels.shape[0]) & (col >= 0) & (col < top_view.labels.shape[1])
    finite, z = finite[inside], z[inside]
    cell = top_view.labels[row[inside].astype(np.intp), col[inside].astype(np.intp)]
    lent = np.array([names.index(name) for name in top_view.classes], dtype=np.uint8)[cell]
    road = names.index("drivable") if "drivable" in names else -1
    take = (painted[finite] == 0) & (lent != 0)
    if perception.points is not None:
        take &= lent == road
    if (lent == road).any():
        # Leaves over the road are not road.
        take &= (lent != road) | (z < np.median(z[lent == road]) + 0.5)
    painted[finite[take]] = lent[take]
    return names, painted


def ground_height(points: NDArray[np.float32], names: list[str], painted: NDArray[np.uint8]) -> float:
    """Height of the ground around the sensor [m]; good enough to stand a grid on."""
    if "drivable" in names:
        road = painted == names.index("drivable")
        if np.count_nonzero(road) >= 50:
            return float(np.median(points[road, 2]))
    near = np.hypot(points[:, 0], points[:, 1]) < 30.0
    return float(np.percentile(points[near, 2], 15.0)) if near.any() else -1.73


def box_corners(box: Box) -> NDArray[np.float64]:
    """The eight corners, (8, 3) [m]: the four of `Box.corners` below, then above."""
    z = box.center[2] + np.repeat([-0.5, 0.5], 4) * box.size[2]
    return np.column_stack([np.tile(box.corners(), (2, 1)), z])


EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
