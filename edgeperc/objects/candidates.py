"""Places where an object may be: rectangles around groups of points above the ground, of no class.

Points are sorted into small cells once, for the groups here and for the crops (`objects.crops`). Groups are found at
three scales, because an object next to a wall is linked with it at a large distance, and a far one falls apart at a
small distance. A detector of the top view adds its boxes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, Floats, Heights, Ints, Points, Rows
from .rectangles import fit_rectangle

if TYPE_CHECKING:
    from ..ground.scan import Scan

CELL_M = 0.2
REACH_M = 80.0
N_SIDE = round(2.0 * REACH_M / CELL_M)
N_ANGLES = 30
MAX_FITTED = 64  # points that a heading is fitted to
MIN_POINTS = 4
MAX_LENGTH_M = 14.0
MIN_TOP_M = 0.45  # lower groups are kerbs and grass
MIN_DETECTOR_SCORE = 0.05  # of a box of a detector that is a candidate
# The place of a 64-bit number's only bit: the first six bits of its product with this one are different for all places.
DE_BRUIJN = np.uint64(0x03F7_9D71_B4CB_0A89)
PLACE_OF_BIT = np.empty(64, np.uint8)
PLACE_OF_BIT[[(int(DE_BRUIJN) << place) % 2**64 >> 58 for place in range(64)]] = np.arange(64)
SAME = 0.8  # a group with this share of the cells of the group around it is the same candidate


class Scale(NamedTuple):
    """Which points are linked: those of heights above the ground [m], at a distance; the longest group [m].

    Beyond ``far_m``, the distance grows in proportion to the range.
    """

    low_m: float
    high_m: float
    link_m: float
    longest_m: float


# The first one holds the others. The last one is for people beside walls or each other: only their upper bodies are
# apart.
SCALES = (Scale(0.2, 2.6, 0.5, MAX_LENGTH_M), Scale(0.3, 2.2, 0.3, MAX_LENGTH_M), Scale(0.9, 2.2, 0.3, 2.5))
# Links across wide gaps between beams join people with what is near: at a part of that distance they are apart.
WIDE_PER_M, CLOSE = 0.03, 0.25


class Cells(NamedTuple):
    """Points above the ground by the square cells that they lie in."""

    number: Ints  # (N_SIDE, N_SIDE) of each cell, x by y; -1 without a point
    flat: Ints  # (k,) flat index of each numbered cell
    scales: Bytes  # (k,) bit s: a point of the cell has a height of `SCALES[s]`
    starts: Ints  # (k + 1,) where the points of a cell start in ``rows``
    rows: Rows  # (m,) rows of the points, cell by cell


class Candidates(NamedTuple):
    """Rectangles x, y, length, width [m], yaw [rad], (m, 5) float64, and the cells that they were found in."""

    rectangles: Floats
    cells: Cells


class CellBuffer:
    """Memory for `Cells.number`, for one scan after the other: only the cells of the last scan are emptied."""

    def __init__(self) -> None:
        self._number = np.empty((N_SIDE, N_SIDE), np.int32)
        self._taken: Ints | None = None

    def sort(self, scan: Scan, height_range_m: tuple[float, float]) -> Cells:
        """`sort_into_cells`; the next call overwrites the numbers of the cells."""
        taken, self._taken = self._taken, None
        if taken is None:
            self._number.fill(-1)
        else:
            self._number.reshape(-1)[taken] = -1
        cells = sort_into_cells(scan, height_range_m, self._number)
        self._taken = cells.flat
        return cells


def sort_into_cells(scan: Scan, height_range_m: tuple[float, float], number: Ints | None = None) -> Cells:
    """Sort the points of a scan whose height above the ground is in a range [m]; ``number`` is -1 everywhere."""
    n = len(scan.points)
    number = np.full((N_SIDE, N_SIDE), -1, np.int32) if number is None else number
    flat, rows, of_point = np.empty((3, n), np.int32)
    starts, scales = np.empty(n + 1, np.int32), np.empty(n, np.uint8)
    low, high = height_range_m
    n_cells, n_rows = fill_cells(
        scan.points, scan.ground.height_m, low, high, Cells(number, flat, scales, starts, rows), of_point
    )
    return Cells(number, flat[:n_cells], scales[:n_cells], starts[: n_cells + 1], rows[:n_rows])


def find_candidates(scan: Scan, cells: Cells, distance_per_m: float = 0.015) -> Candidates:
    """Find where an object may be: the groups at each of the `SCALES`. ``distance_per_m`` is as in
    `objects.cluster.find_clusters`.
    """
    if not 0.0 <= distance_per_m <= 1.0:
        raise PointsError(f"got distance_per_m={distance_per_m}; expected radians in 0..1")
    n_cells = len(cells.flat)
    alone = np.full(n_cells, -1, np.int32), np.empty(n_cells, np.int32)
    wide: dict[int, tuple[Ints, Ints]] = {}  # of each scale, its groups at the distance for it, and their sizes
    found = []
    for k, per_m in links_of(distance_per_m):
        scale, (around, sizes) = SCALES[k], wide.get(k, wide.get(0, alone))
        group, order = np.empty((2, n_cells), np.int32)
        first = np.empty(n_cells + 1, np.int32)
        n_groups = fill_groups_of_cells(cells, k, scale.link_m, per_m, group, order, first)
        fits = np.empty((n_groups, 5))
        n = fit_groups(
            scan.points, scan.ground.height_m, cells, scale, Groups(order, first[: n_groups + 1], around, sizes), fits
        )
        found.append(fits[:n])
        wide.setdefault(k, (group, np.diff(first[: n_groups + 1])))
    return Candidates(np.concatenate(found), cells)


def links_of(distance_per_m: float) -> list[tuple[int, float]]:
    """Numbers of the `SCALES`, and the distance for each meter of range at which cells are linked: the first holds all
    others. The smaller scales are linked closely, too, where beams are far apart.
    """
    links = [(k, distance_per_m * scale.link_m / SCALES[0].link_m) for k, scale in enumerate(SCALES)]
    return links + [(k, CLOSE * per_m) for k, per_m in links[1:] if distance_per_m > WIDE_PER_M]


class Groups(NamedTuple):
    """Groups of cells, and the larger groups that they are parts of."""

    order: Ints  # (k,) numbers of cells, group by group
    first: Ints  # (groups + 1,) where the cells of a group start in ``order``
    around: Ints  # (cells,) of each cell, its larger group: at the first scale, or linked wider; -1: there is none
    sizes: Ints  # (larger groups,) numbers of their cells


@njit(cache=True, nogil=True)
def fill_cells(
    points: Points, height: Heights, low: float, high: float, cells: Cells, of_point: Ints
) -> tuple[int, int]:
    """Write `Cells` with arrays as long as the scan (``starts``: one more); return how many cells and rows there are.

    ``cells.number`` is -1 everywhere. ``of_point`` (n,) is overwritten with the number of each point's cell, or -1.
    """
    number, flat, starts, rows = cells.number.reshape(-1), cells.flat, cells.starts, cells.rows
    scales = cells.scales
    n_cells, n_rows = 0, 0
    for i in range(points.shape[0]):
        of_point[i] = -1
        x, y = points[i, 0], points[i, 1]
        if low < height[i] < high and abs(x) < REACH_M and abs(y) < REACH_M:
            row = min(int((x + REACH_M) / CELL_M), N_SIDE - 1)
            col = min(int((y + REACH_M) / CELL_M), N_SIDE - 1)
            c = row * N_SIDE + col
            if number[c] < 0:
                number[c] = n_cells
                flat[n_cells] = c
                starts[n_cells], scales[n_cells] = 0, 0
                n_cells += 1
            k = number[c]
            of_point[i] = k
            starts[k] += 1
            for scale in range(len(SCALES)):
                scales[k] |= np.uint8(SCALES[scale].low_m < height[i] < SCALES[scale].high_m) << np.uint8(scale)
            n_rows += 1
    total = 0
    for k in range(n_cells):
        total += starts[k]
        starts[k] = total
    starts[n_cells] = total
    for i in range(points.shape[0] - 1, -1, -1):
        if of_point[i] >= 0:
            starts[of_point[i]] -= 1
            rows[starts[of_point[i]]] = i
    return n_cells, n_rows


@njit(cache=True, nogil=True)
def fill_groups_of_cells(
    cells: Cells, scale: int, link_m: float, per_m: float, group: Ints, order: Ints, first: Ints
) -> int:
    """Link cells with points of a scale's heights whose middles are at most ``link_m`` apart, or ``per_m`` times the
    range; return the number of groups.

    ``group`` (k,) gets the group of each cell, -1 for none; ``order`` and ``first`` are those of `Groups`.
    """
    number, flat, scales = cells.number, cells.flat, cells.scales
    # A bit for each cell that takes part and is in no group yet: most cells near one are empty, and are passed 64 at
    # once, which takes a third of the time.
    free = np.zeros((N_SIDE, (N_SIDE + 63) // 64), np.uint64)
    one, all_ones = np.uint64(1), np.uint64(0xFFFF_FFFF_FFFF_FFFF)
    for k in range(flat.shape[0]):
        group[k] = -1
        if (scales[k] >> scale) & 1:
            row, col = flat[k] // N_SIDE, flat[k] % N_SIDE
            free[row, col >> 6] |= one << np.uint64(col & 63)
    n_groups, end = 0, 0
    first[0] = 0
    for seed in range(flat.shape[0]):
        row, col = flat[seed] // N_SIDE, flat[seed] % N_SIDE
        if not (free[row, col >> 6] >> np.uint64(col & 63)) & one:
            continue
        free[row, col >> 6] ^= one << np.uint64(col & 63)
        group[seed] = n_groups
        order[end] = seed
        at = end
        end += 1
        while at < end:
            row, col = flat[order[at]] // N_SIDE, flat[order[at]] % N_SIDE
            at += 1
            x, y = (row + 0.5) * CELL_M - REACH_M, (col + 0.5) * CELL_M - REACH_M
            reach = max(link_m, per_m * math.sqrt(x * x + y * y)) / CELL_M
            far = int(reach)
            low, high = max(col - far, 0), min(col + far, N_SIDE - 1)
            for r in range(max(row - far, 0), min(row + far, N_SIDE - 1) + 1):
                for word in range(low >> 6, (high >> 6) + 1):
                    bits = free[r, word]
                    bits &= all_ones << np.uint64(max(low - 64 * word, 0))
                    bits &= all_ones >> np.uint64(max(64 * word + 63 - high, 0))
                    while bits:
                        bit = bits & (~bits + one)  # the lowest one
                        bits ^= bit
                        c = 64 * word + np.int64(PLACE_OF_BIT[(bit * DE_BRUIJN) >> np.uint64(58)])
                        if (r - row) * (r - row) + (c - col) * (c - col) <= reach * reach:
                            free[r, word] ^= bit
                            group[number[r, c]] = n_groups
                            order[end] = number[r, c]
                            end += 1
        n_groups += 1
        first[n_groups] = end
    return n_groups


@njit(cache=True, nogil=True)
def fit_groups(points: Points, height: Heights, cells: Cells, scale: Scale, groups: Groups, fits: Floats) -> int:
    """Write the rectangles of the groups that may be an object into ``fits`` (groups, 5); return their number.

    Left out are groups of few points, those that are low or long, and those that are about the group around them.
    """
    starts, of_cells = cells.starts, cells.rows
    order, bounds, around, sizes = groups.order, groups.first, groups.around, groups.sizes
    rows = np.empty(of_cells.shape[0], np.int32)
    n_fits = 0
    for g in range(bounds.shape[0] - 1):
        start, end = bounds[g], bounds[g + 1]
        outer = around[order[start]]
        if outer >= 0 and end - start >= SAME * sizes[outer]:
            continue
        n, top = 0, 0.0
        low_x, low_y, high_x, high_y = math.inf, math.inf, -math.inf, -math.inf
        for k in order[start:end]:
            for at in range(starts[k], starts[k + 1]):
                i = of_cells[at]
                if scale.low_m < height[i] < scale.high_m:
                    rows[n] = i
                    n += 1
                    top = max(top, height[i])
                    low_x, high_x = min(low_x, points[i, 0]), max(high_x, points[i, 0])
                    low_y, high_y = min(low_y, points[i, 1]), max(high_y, points[i, 1])
        if n < MIN_POINTS or top < MIN_TOP_M or math.hypot(high_x - low_x, high_y - low_y) > scale.longest_m:
            continue
        rectangle = fits[n_fits]
        fit_rectangle(points, rows[:n], np.int64(N_ANGLES), np.int64(MAX_FITTED), np.bool_(True), rectangle)
        if rectangle[3] > rectangle[2]:
            rectangle[2], rectangle[3] = rectangle[3], rectangle[2]
            rectangle[4] += 0.5 * math.pi
        n_fits += 1
    return n_fits
