"""Targets of the box heads: slots by place, the paper's slots, and dense maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from edgeperc.inference.box_heads import STRIDE
from edgeperc.types.card import N_DENSE_CHANNELS, N_FRONT_CHANNELS
from edgeperc.types.points import Floats, Floats32, Mask
from edgeperc.types.views import TopViewGeometry

SLOT_CELLS = 32
"""Top-view cells along the edge of the square that belongs to one slot: five poolings by two. The last row and column
of squares also get the cells that are left over."""
REGRESSED_FROM = 0.5
"""Cells with at least this heat learn the box's geometry, weighted by the heat. The detected peak may be a neighbor of
the true one, so the neighbors' geometry must be correct too."""


def slot_targets(
    boxes: ArrayLike, view: TopViewGeometry, *, labeled: Mask | None = None, unsure: ArrayLike = ()
) -> Floats32:
    """Targets of head "slots": each has a square of the view, and the upright box of the nearest object in it.

    Returns (rows * columns, 5): By rows from the far left square: center column, center row, width and height as in
        `paper_slot_targets`, and the presence: 1 with an object, 0 and zeros without one, -1 if it is not learned.
    """
    n_rows, n_cols = view.height // SLOT_CELLS, view.width // SLOT_CELLS
    target = np.zeros((n_rows, n_cols, 5), np.float32)
    if labeled is not None:
        known = labeled
        for axis, n in enumerate((n_rows, n_cols)):
            known = np.logical_and.reduceat(known, np.arange(n) * SLOT_CELLS, axis=axis)
        target[~known, 4] = -1.0
    for given, presence in ((unsure, -1.0), (boxes, 1.0)):
        group, rows, cols = _boxes_in_view(given, view)
        at_row = np.minimum(rows.astype(np.int64) // SLOT_CELLS, n_rows - 1)
        at_col = np.minimum(cols.astype(np.int64) // SLOT_CELLS, n_cols - 1)
        target[at_row, at_col, 4] = presence
        if presence > 0.0:
            nearest_last = np.argsort(rows, kind="stable")
            target[at_row[nearest_last], at_col[nearest_last], :4] = _upright(group, rows, cols, view)[nearest_last]
    return target.reshape(-1, 5)


def paper_slot_targets(boxes: ArrayLike, view: TopViewGeometry, n_slots: int) -> Floats32:
    """Targets of head "slots-paper": upright boxes around rotated footprints with their center in view, nearest first
    (SSADNet 3.1.1): center column, center row, width and height as shares of the image; zeros in empty slots.
    """
    boxes, rows, cols = _boxes_in_view(boxes, view)
    found = _upright(boxes, rows, cols, view)
    nearest = np.argsort(-rows, kind="stable")[:n_slots]
    target = np.zeros((n_slots, 4), np.float32)
    target[: len(nearest)] = found[nearest]
    return target


def dense_targets(
    boxes: ArrayLike, view: TopViewGeometry, *, labeled: Mask | None = None, unsure: ArrayLike = ()
) -> Floats32:
    """Heat map and geometry for head "dense", (11, height/4, width/4), of boxes (m, 7): center, sizes [m], yaw [rad].
    Cells near ``unsure`` ones, such as those without returns, and those that are not ``labeled`` are not learned.

    Channel 0, the heat: 1 in the output cell that holds a box's center; around it a Gaussian shaped like the box, whose
    edges are three standard deviations away; -1 in cells that are not learned. Channels 1 to 8: the geometry of the box
    with the highest heat, in the format of box_dense, where that heat is at least `REGRESSED_FROM`; else 0. Channels 9
    and 10: x and y of the unit vector towards its front.
    """
    height, width = view.height // STRIDE, view.width // STRIDE
    target = np.zeros((N_DENSE_CHANNELS + N_FRONT_CHANNELS, height, width), np.float32)
    heat = target[0]

    boxes, rows, cols = _boxes_in_view(boxes, view)
    for box, row, col in zip(boxes, rows / STRIDE, cols / STRIDE, strict=True):
        bump = _gaussian(box, row, col, (height, width), view.cell_m * STRIDE)
        cell_rows, cell_cols = np.nonzero((bump > heat) & (bump >= REGRESSED_FROM))
        doubled, front = (np.sin(2.0 * box[6]), np.cos(2.0 * box[6])), (np.cos(box[6]), np.sin(box[6]))
        target[1, cell_rows, cell_cols] = row - (cell_rows + 0.5)
        target[2, cell_rows, cell_cols] = col - (cell_cols + 0.5)
        target[3:, cell_rows, cell_cols] = np.array(
            [np.log(box[3]), np.log(box[4]), *doubled, box[2], np.log(box[5]), *front]
        )[:, None]
        np.maximum(heat, bump, out=heat)

    unlearned = np.zeros((height, width), bool)
    if labeled is not None:
        unlearned |= ~labeled.reshape(height, STRIDE, width, STRIDE).all((1, 3))
    boxes, rows, cols = _boxes_in_view(unsure, view)
    for box, row, col in zip(boxes, rows / STRIDE, cols / STRIDE, strict=True):
        unlearned |= _gaussian(box, row, col, (height, width), view.cell_m * STRIDE) > 0.1
    heat[unlearned & (heat < REGRESSED_FROM)] = -1.0
    return target


def _boxes_in_view(boxes: ArrayLike, view: TopViewGeometry) -> tuple[Floats, Floats, Floats]:
    """Boxes whose center is in the view, and the rows and columns of the centers [cells from the far left corner]."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    if not (boxes[:, 3:6] > 0.0).all():
        raise ValueError("a box has no extent; expected length, width and height above 0 m")
    rows = (view.x_range_m[1] - boxes[:, 0]) / view.cell_m
    cols = (view.y_range_m[1] - boxes[:, 1]) / view.cell_m
    inside = (rows >= 0) & (rows < view.height) & (cols >= 0) & (cols < view.width)
    return boxes[inside], rows[inside], cols[inside]


def _upright(boxes: Floats, rows: Floats, cols: Floats, view: TopViewGeometry) -> Floats:
    """Center column, center row, width and height of the upright boxes, (m, 4), as shares of the image's."""
    length, width, yaw = boxes[:, 3], boxes[:, 4], boxes[:, 6]
    across = np.abs(length * np.sin(yaw)) + np.abs(width * np.cos(yaw))
    along = np.abs(length * np.cos(yaw)) + np.abs(width * np.sin(yaw))
    return np.stack(
        [cols / view.width, rows / view.height, across / view.cell_m / view.width, along / view.cell_m / view.height],
        axis=1,
    )


def _gaussian(box: Floats, row: float, col: float, shape: tuple[int, int], cell_m: float) -> Floats32:
    """A bump of height 1 in the output cell that holds (row, col), as long and wide as the box."""
    forward = int(row) - np.arange(shape[0])[:, None]  # rows grow backwards, columns to the right
    left = int(col) - np.arange(shape[1])[None, :]
    cos, sin = np.cos(box[6]), np.sin(box[6])
    along, across = cos * forward + sin * left, cos * left - sin * forward
    # At least half a cell: a peak of a single cell would be hard to learn.
    sigma_along, sigma_across = max(box[3] / cell_m / 6.0, 0.5), max(box[4] / cell_m / 6.0, 0.5)
    return np.exp(-0.5 * ((along / sigma_along) ** 2 + (across / sigma_across) ** 2)).astype(np.float32)
