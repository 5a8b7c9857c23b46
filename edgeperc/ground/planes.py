"""Find the ground and the height of every point above it, by RANSAC in regions (KUL-Seg 5.2).

One plane fits a car park, but a street has slopes, camber and kerbs. `find_ground` divides the scan into cells and
keeps the lowest return of each. RANSAC fits a plane to these in each region, from the vehicle outwards; each region
starts from the planes of its neighbors. Where the lowest returns of a few cells agree on a step off the plane, such as
a pavement, the ground follows them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.draws import drawn_of, next_draw
from ..system.kernels import njit
from ..types.perception import GroundSurface
from ..types.points import Floats, Floats32, Heights, Ints, Mask, Points, Rows, read_only

# 256 x 256 cells of half a meter, in 16 x 16 regions of 16 x 16 cells. Farther out, few rays meet the ground.
CELL_M = 0.5
N_CELLS = 256
CELLS_A_REGION = 16
N_REGIONS = N_CELLS // CELLS_A_REGION
REGION_M = CELL_M * CELLS_A_REGION
REACH_M = 0.5 * CELL_M * N_CELLS

# The plane around the vehicle. The sensor may lean, and its mounting height may differ from the profile's.
FIRST_REACH_M, FARTHEST_REACH_M = 20.0, 60.0
FIRST_REACH_HEIGHTS = 4.0  # of a high sensor: its lowest beam meets the ground at up to 3.7 times its height
MAX_SLOPE = 0.3
MAX_MOUNT_ERROR_M = 0.5
MIN_FIRST_SUPPORT = 30  # cells
N_FIRST_HYPOTHESES = 100

# The planes of the regions, relative to the plane expected from their neighbors.
MAX_BEND = 0.12  # change of slope
MAX_SHIFT_M = 0.5
BAND_M = 0.8  # cells farther from the expected plane are ignored
MIN_SUPPORT = 6  # cells
N_HYPOTHESES = 24
PRIOR_CELLS = 4  # weight of the expected slope in the least squares

TOLERANCE_M = 0.1
MIN_AREA_M2 = 1.0  # twice the triangle of a hypothesis, seen from above
MAX_TESTED = 1024  # cells a hypothesis is tested on

# Steps in 5 x 5 cells. They raised recall and precision by 0.007 and 0.001 on simulated scans, by 0.027 and 0.002 on
# HDL-32E scans.
WINDOW = 2
MAX_STEP_M = 0.3
MAX_DEPTH_M = 0.5  # deeper points are reflections

FAR_ABOVE_M = 1e6  # a return so far above the ground says nothing of it

BLOCK = 256  # points: their intermediate values fit into the first-level cache
EMPTY = np.int64(0x7FFF_FFFF << 32)
LOW_WORD = np.int64(0xFFFF_FFFF)


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Result of `find_ground`."""

    mask: Mask  # points on the ground, in input order
    height_m: Heights  # of every point above the ground below it; NaN for points that are not finite
    # a, b, c of z = a x + b y + c [m] around the vehicle. None if no ground was found: then no point is ground, and
    # heights are above a level plane at the mounting height.
    plane: tuple[float, float, float] | None


def find_ground(
    points: Points, *, mount_height_m: float = 1.73, max_height_m: float = 0.125, regions: bool = True
) -> Ground:
    """Separate the ground from what stands on it (KUL-Seg 5.2), by planes of regions (docs/concepts/clusters.md);
    deterministic. Raises PointsError.

    mount_height_m : of the sensor above the ground; may be wrong by 0.5 m.
    max_height_m : a point is ground if it is at most this far above the ground and at most 0.5 m below it.
    regions : False fits only the plane around the vehicle.
    """
    return fit_ground(points, mount_height_m=mount_height_m, regions=regions).heights(max_height_m=max_height_m)


@dataclass(frozen=True, slots=True, eq=False)
class GroundFit:
    """Planes of the ground below a scan, the first half of `find_ground`; `heights` is the second."""

    points: Points  # (n, 4) the scan; not a copy
    cell: Ints  # (n,) cell of each point
    lowest: Ints  # (N_CELLS, N_CELLS) row of the lowest point in each cell
    plane: Floats  # (3,) a, b, c around the vehicle
    # (N_REGIONS, N_REGIONS, 3) of each region; None if there is the first plane only
    planes: Floats | None
    found: bool  # whether there is ground

    def heights(self, rows: Rows | None = None, *, max_height_m: float = 0.125) -> Ground:
        """The ground of the points in some rows, or of all; parameters and errors as in `find_ground`."""
        if not 0.0 < max_height_m < math.inf:
            raise PointsError(f"got max_height_m={max_height_m}; expected meters above 0")
        wanted = np.arange(len(self.points), dtype=np.int32) if rows is None else rows
        height = np.empty(len(wanted), np.float32)
        mask = np.empty(len(wanted), np.bool_)
        if self.planes is not None:
            level = np.empty((N_CELLS, N_CELLS), np.float32)
            planes = read_only(self.planes, np.float64)  # as they come from another process that shares its memory
            fill_levels(self.points, self.lowest, planes, wanted, self.cell, level)
            fill_heights(self.points, wanted, self.cell, level, planes, max_height_m, height, mask)
        else:
            fill_heights_above_plane(self.points, wanted, self.plane, max_height_m, height, mask)
            mask &= self.found
        return Ground(mask, height, self._plane if self.found else None)

    @property
    def _plane(self) -> tuple[float, float, float]:
        a, b, c = self.plane.tolist()
        return a, b, c

    def surface(self) -> GroundSurface:
        """The ground without the scan: 0.2 MB in place of 3 MB."""
        cells, lowest = taken_cells(self.points, self.lowest)
        return GroundSurface(self._plane if self.found else None, self._plane, self.planes, cells, lowest)


def heights_above(ground: GroundSurface | None, points: Points) -> Ground:
    """Heights of points in the frame of the models above the ground that a scan showed; None: that they show."""
    if ground is None:
        return find_ground(points)
    scan, cell, own_lowest = _sorted_into_cells(points)
    n, k = len(scan), len(ground.lowest)
    # In a cell that only these points are in, the ground follows the planes, as below a return far above it.
    far_above = np.array([[0.0, 0.0, FAR_ABOVE_M, 0.0]], np.float32)
    lowest = np.where(own_lowest.reshape(-1) >= 0, np.int32(n + k), np.int32(-1))
    lowest[ground.cells] = np.arange(n, n + k, dtype=np.int32)
    rows = np.arange(n, dtype=np.int32)
    every = read_only(np.concatenate([scan, ground.lowest, far_above]))  # of the type that a `Perceiver` compiled
    plane, found = np.array(ground.expected), ground.plane is not None
    return GroundFit(every, cell, lowest.reshape(N_CELLS, N_CELLS), plane, ground.planes, found).heights(rows)


def fit_ground(
    points: Points,
    *,
    mount_height_m: float = 1.73,
    regions: bool = True,
    any_order: bool = False,
    reach_m: float = FIRST_REACH_M,
) -> GroundFit:
    """Fit the planes of the ground; parameters and errors as in `find_ground`.

    any_order : whether the ground is the same for any order of the points, which takes 2 ms more.
    reach_m : of the first plane; farther for a sensor so high that it sees no ground near by.
    """
    if not 0.0 < mount_height_m < math.inf:
        raise PointsError(f"got mount_height_m={mount_height_m}; expected meters above 0")
    scan, cell, lowest = _sorted_into_cells(points)
    if any_order:
        _settle_ties(scan, cell, lowest)
    plane = np.array([0.0, 0.0, -mount_height_m])
    found = fit_first_plane(scan, lowest, min(reach_m, FARTHEST_REACH_M), plane)
    planes = None
    if found and regions:
        planes = np.empty((N_REGIONS, N_REGIONS, 3))
        fill_planes(scan, lowest, plane, planes)
    return GroundFit(scan, cell, lowest, plane, planes, found)


def _settle_ties(points: Points, cell: Ints, lowest: Ints) -> None:
    """Of a cell's equally low points, take the one with the smallest x, then y."""
    flat = lowest.reshape(-1)
    inside = np.flatnonzero(cell >= 0)
    tied = inside[points[inside, 2] == points[flat[cell[inside]], 2]]
    # Of several points of a cell, the last one that is written stays.
    tied = tied[np.lexsort((points[tied, 1], points[tied, 0]))[::-1]]
    flat[cell[tied]] = tied


def _sorted_into_cells(points: Points) -> tuple[Points, Ints, Ints]:
    """A scan, the cell of each of its points, and the row of the lowest point in each cell."""
    if points.ndim != 2 or points.shape[1] < 3:
        raise PointsError(f"got points of shape {points.shape}; expected (n, 4): x, y, z, remission")
    scan = read_only(points if points.shape[1] == 4 else np.pad(points[:, :3], ((0, 0), (0, 1))))
    cell, lowest = np.empty(len(scan), np.int32), np.empty((N_CELLS, N_CELLS), np.int32)
    fill_lowest(scan, cell, lowest)
    return scan, cell, lowest


@njit(cache=True, nogil=True, error_model="numpy")
def fill_lowest(points: Points, cell: Ints, lowest: Ints) -> None:
    """Write every point's flat cell, -1 outside, and every cell's lowest point, the first of equals, or -1."""
    flat = lowest.reshape(-1)
    values = points.reshape(-1)
    reach = np.float32(REACH_M)
    cells_per_m = np.float32(1.0 / CELL_M)  # a power of two: no rounding
    last = np.int32(N_CELLS - 1)
    # Smallest of `bits of z << 32 | row of points`, without a branch; the bits of z are in the order of z. Points out
    # of the grid go to an entry of their own. A first loop without branches compiles to vector instructions. Both
    # together halve the time.
    best = np.empty(N_CELLS * N_CELLS + 1, np.int64)
    best[:] = EMPTY
    ordered = np.empty(BLOCK, np.int32)
    unused = np.empty(BLOCK, np.float32)  # a gap in the loads would prevent vector instructions
    for start in range(0, points.shape[0], BLOCK):
        block = values[4 * start : 4 * (start + BLOCK)]
        cells = cell[start : start + BLOCK]
        for j in range(cells.shape[0]):
            x, y, z, unused[j] = block[4 * j], block[4 * j + 1], block[4 * j + 2], block[4 * j + 3]
            inside = (abs(x) < reach) & (abs(y) < reach) & (abs(z) < np.float32(math.inf))
            # The last float below the edge may be rounded onto it.
            row = min(np.int32(((x if inside else np.float32(0.0)) + reach) * cells_per_m), last)
            col = min(np.int32(((y if inside else np.float32(0.0)) + reach) * cells_per_m), last)
            cells[j] = row * np.int32(N_CELLS) + col if inside else np.int32(-1)
            bits = np.float32(z + np.float32(0.0)).view(np.int32)  # -0 becomes 0
            ordered[j] = bits ^ ((bits >> np.int32(31)) & np.int32(0x7FFF_FFFF))
        for j in range(cells.shape[0]):
            at = np.uint64(np.int64(cells[j]) + 1)
            best[at] = min(best[at], np.int64(ordered[j]) << 32 | np.int64(start + j))
    for at in range(N_CELLS * N_CELLS):
        flat[at] = np.int32(best[at + 1] & LOW_WORD) if best[at + 1] != EMPTY else np.int32(-1)


@njit(cache=True, nogil=True)
def taken_cells(points: Points, lowest: Ints) -> tuple[Ints, Floats32]:
    """The flat numbers of the cells with a point, (k,), and the lowest point of each, (k, 4)."""
    flat, n = lowest.reshape(-1), 0
    taken = np.empty(len(flat) + 1, np.int32)
    for at in range(len(flat)):  # no branches: a third of the time
        taken[n] = at
        n += flat[at] >= 0
    cells, rows = np.empty(n, np.int32), np.empty((n, 4), np.float32)
    for k in range(n):
        cells[k] = taken[k]
        for axis in range(4):
            rows[k, axis] = points[flat[taken[k]], axis]
    return cells, rows


class Patch(NamedTuple):
    """A square of cells, from row and column on, to which a plane with its origin at x, y [m] is fitted."""

    row: int
    col: int
    size: int
    x: float
    y: float


@njit(cache=True, nogil=True)
def fit_first_plane(points: Points, lowest: Ints, reach_m: float, plane: Floats) -> bool:
    """Replace ``plane`` (3,), the expected a, b, c, by the plane within ``reach_m``; False if there is none."""
    size = 2 * int(reach_m / CELL_M)
    start = (N_CELLS - size) // 2
    residuals = np.empty((3, size * size))
    fitted = np.empty(3)
    patch = Patch(start, start, size, 0.0, 0.0)
    n = fill_residuals(points, lowest, patch, plane, MAX_MOUNT_ERROR_M, MAX_SLOPE, residuals)
    step = (n + MAX_TESTED - 1) // MAX_TESTED
    tested = np.empty((3, MAX_TESTED))
    n_tested = np.int64(0)
    for k in range(0, n, max(step, 1)):
        for axis in range(3):
            tested[axis, n_tested] = residuals[axis, k]
        n_tested += 1
    find_plane(tested, n_tested, MAX_SLOPE, MAX_MOUNT_ERROR_M, np.int64(N_FIRST_HYPOTHESES), np.int64(1), fitted)
    if refine_plane(residuals, n, 0.0, MAX_SLOPE, MAX_MOUNT_ERROR_M, fitted) < MIN_FIRST_SUPPORT:
        return False
    plane += fitted
    return True


@njit(cache=True, nogil=True)
def fill_planes(points: Points, lowest: Ints, first: Floats, planes: Floats) -> None:
    """Fit every region's plane, from the middle outwards: slopes along x and y, and height in the region's middle [m];
    the expected plane if too few cells agree.
    """
    solved = np.empty((N_REGIONS, N_REGIONS))  # 1 and the cells that agree
    solved[:] = 0.0
    residuals = np.empty((3, CELLS_A_REGION * CELLS_A_REGION))
    expected = np.empty(3)
    fitted = np.empty(3)
    prior = PRIOR_CELLS * REGION_M * REGION_M / 12.0
    half = N_REGIONS // 2
    for ring in range(half):
        low, high = half - 1 - ring, half + ring
        for r in range(low, high + 1):
            for q in range(low, high + 1, 1 if r in (low, high) else high - low):
                middle_x = (r + 0.5) * REGION_M - REACH_M
                middle_y = (q + 0.5) * REGION_M - REACH_M
                total = 0.0
                expected[:] = 0.0
                for near_r in range(max(r - 1, 0), min(r + 2, N_REGIONS)):
                    for near_q in range(max(q - 1, 0), min(q + 2, N_REGIONS)):
                        # The four in the middle do not start from each other: one of them may hold a ditch.
                        weight = solved[near_r, near_q] if ring > 0 else 0.0
                        if weight > 0.0:
                            a, b = planes[near_r, near_q, 0], planes[near_r, near_q, 1]
                            height = planes[near_r, near_q, 2]
                            total += weight
                            expected[0] += weight * a
                            expected[1] += weight * b
                            expected[2] += weight * (height + REGION_M * (a * (r - near_r) + b * (q - near_q)))
                if total > 0.0:
                    expected /= total
                else:
                    expected[0], expected[1], expected[2] = first[0], first[1], first[2]
                    expected[2] += first[0] * middle_x + first[1] * middle_y
                row, col = r * CELLS_A_REGION, q * CELLS_A_REGION
                patch = Patch(row, col, np.int64(CELLS_A_REGION), middle_x, middle_y)
                n = fill_residuals(points, lowest, patch, expected, BAND_M, 0.0, residuals)
                # Element by element: to copy an array, numba compiles a broadcast with its error messages, for 3 s.
                for k in range(3):
                    planes[r, q, k] = expected[k]
                solved[r, q] = 1.0
                if n >= MIN_SUPPORT:
                    find_plane(residuals, n, MAX_BEND, MAX_SHIFT_M, np.int64(N_HYPOTHESES), r * N_REGIONS + q, fitted)
                    support = refine_plane(residuals, n, prior, MAX_BEND, MAX_SHIFT_M, fitted)
                    if support >= MIN_SUPPORT:
                        for k in range(3):
                            planes[r, q, k] += fitted[k]
                        solved[r, q] += support


@njit(cache=True, nogil=True)
def fill_residuals(
    points: Points, lowest: Ints, patch: Patch, expected: Floats, band: float, cone: float, residuals: Floats
) -> int:
    """Write x, y from the origin and z above the expected plane of the lowest returns of a patch; returns their number.
    Those farther from the plane than ``band`` plus ``cone`` times their distance from the origin are skipped.
    """
    n = 0
    for row in range(patch.row, patch.row + patch.size):
        for col in range(patch.col, patch.col + patch.size):
            i = lowest[row, col]
            if i < 0:
                continue
            x = np.float64(points[i, 0]) - patch.x
            y = np.float64(points[i, 1]) - patch.y
            z = np.float64(points[i, 2]) - (expected[0] * x + expected[1] * y + expected[2])
            if abs(z) <= band + cone * math.sqrt(x * x + y * y):
                residuals[0, n], residuals[1, n], residuals[2, n] = x, y, z
                n += 1
    return n


@njit(cache=True, nogil=True)
def find_plane(
    residuals: Floats, n: int, max_slope: float, max_shift: float, n_hypotheses: int, draw: int, plane: Floats
) -> None:
    """Write a, b, c of the best hypothesis into ``plane`` (3,); the first one is the expected plane, 0, 0, 0."""
    plane[:] = 0.0
    if n == 0:
        return
    most = count_support(residuals, n, 0.0, 0.0, 0.0)
    corners = np.empty(3, np.int64)
    for _ in range(n_hypotheses):
        for corner in range(3):
            draw = next_draw(draw)
            corners[corner] = drawn_of(draw, n)
        x0, y0, z0 = residuals[0, corners[0]], residuals[1, corners[0]], residuals[2, corners[0]]
        x1, y1, z1 = residuals[0, corners[1]] - x0, residuals[1, corners[1]] - y0, residuals[2, corners[1]] - z0
        x2, y2, z2 = residuals[0, corners[2]] - x0, residuals[1, corners[2]] - y0, residuals[2, corners[2]] - z0
        area = x1 * y2 - x2 * y1
        if abs(area) < MIN_AREA_M2:
            continue
        a = (z1 * y2 - z2 * y1) / area
        b = (x1 * z2 - x2 * z1) / area
        c = z0 - a * x0 - b * y0
        if abs(a) > max_slope or abs(b) > max_slope or abs(c) > max_shift:
            continue
        support = count_support(residuals, n, a, b, c)
        if support > most:
            most = support
            plane[0], plane[1], plane[2] = a, b, c


@njit(cache=True, nogil=True)
def count_support(residuals: Floats, n: int, a: float, b: float, c: float) -> int:
    """Number of cells on the plane minus the number of cells below it."""
    x, y, z = residuals[0, :n], residuals[1, :n], residuals[2, :n]
    support = 0
    for k in range(n):  # no branches: vector instructions
        gap = z[k] - a * x[k] - b * y[k] - c
        support += int(gap <= TOLERANCE_M) - 2 * int(gap < -TOLERANCE_M)
    return support


@njit(cache=True, nogil=True)
def refine_plane(residuals: Floats, n: int, prior: float, max_slope: float, max_shift: float, plane: Floats) -> int:
    """Replace ``plane`` by the least-squares plane of the cells on it; return their number, or 0 if there is no plane.

    ``prior`` [m2] is the weight of a slope of zero.
    """
    count = 0
    sx, sy, sz = 0.0, 0.0, 0.0
    xx, xy, yy, xz, yz = prior, 0.0, prior, 0.0, 0.0
    for k in range(n):
        x, y, z = residuals[0, k], residuals[1, k], residuals[2, k]
        if abs(z - plane[0] * x - plane[1] * y - plane[2]) <= TOLERANCE_M:
            count += 1
            sx += x
            sy += y
            sz += z
            xx += x * x
            xy += x * y
            yy += y * y
            xz += x * z
            yz += y * z
    if count == 0:
        return 0
    xx -= sx * sx / count
    xy -= sx * sy / count
    yy -= sy * sy / count
    xz -= sx * sz / count
    yz -= sy * sz / count
    determinant = xx * yy - xy * xy
    if determinant < 1e-3 * xx * yy or xx * yy == 0.0:  # the cells lie in a line
        return 0
    a = (xz * yy - yz * xy) / determinant
    b = (yz * xx - xz * xy) / determinant
    c = (sz - a * sx - b * sy) / count
    if abs(a) <= max_slope and abs(b) <= max_slope and abs(c) <= max_shift:
        plane[0], plane[1], plane[2] = a, b, c
    return count


@njit(cache=True, nogil=True)
def fill_levels(points: Points, lowest: Ints, planes: Floats, rows: Rows, cell: Ints, level: Floats32) -> None:
    """Write the height of the ground in the middle of every cell that holds one of the points ``rows``, else NaN."""
    # Of the points ahead, the cells behind are not needed: half of the time.
    first, last = N_CELLS - 1, 0
    for k in range(rows.shape[0]):
        row = cell[rows[k]] // N_CELLS
        if row >= 0:
            first, last = min(first, row), max(last, row)
    # Padded with zeros, so that the sums below need no bounds checks: this halves the time.
    step = np.empty((N_CELLS + 2 * WINDOW, N_CELLS + 2 * WINDOW), np.float32)
    counts = np.empty((N_CELLS + 2 * WINDOW, N_CELLS + 2 * WINDOW), np.float32)
    step[:] = 0.0
    counts[:] = 0.0
    for row in range(max(first - WINDOW, 0), min(last + WINDOW + 1, N_CELLS)):
        u = min(max((row + 0.5) / CELLS_A_REGION - 0.5, 0.0), N_REGIONS - 1.0)
        r = min(int(u), N_REGIONS - 2)
        u -= r
        x = (row + 0.5) * CELL_M - REACH_M
        for col in range(N_CELLS):
            i = lowest[row, col]
            if i < 0:
                level[row, col] = math.nan
                continue
            v = min(max((col + 0.5) / CELLS_A_REGION - 0.5, 0.0), N_REGIONS - 1.0)
            q = min(int(v), N_REGIONS - 2)
            v -= q
            y = (col + 0.5) * CELL_M - REACH_M
            ground = 0.0
            slope_x = 0.0
            slope_y = 0.0
            for near_r in range(r, r + 2):
                for near_q in range(q, q + 2):
                    weight = (u if near_r > r else 1.0 - u) * (v if near_q > q else 1.0 - v)
                    a, b = planes[near_r, near_q, 0], planes[near_r, near_q, 1]
                    height = planes[near_r, near_q, 2]
                    dx = x - ((near_r + 0.5) * REGION_M - REACH_M)
                    dy = y - ((near_q + 0.5) * REGION_M - REACH_M)
                    ground += weight * (height + a * dx + b * dy)
                    slope_x += weight * a
                    slope_y += weight * b
            level[row, col] = ground
            off = points[i, 2] - ground - slope_x * (points[i, 0] - x) - slope_y * (points[i, 1] - y)
            if abs(off) <= MAX_STEP_M:
                step[row + WINDOW, col + WINDOW] = off
                counts[row + WINDOW, col + WINDOW] = 1.0
    for row in range(first, last + 1):
        for col in range(N_CELLS):
            if lowest[row, col] < 0:
                continue
            count = np.float32(0.0)
            total = np.float32(0.0)
            for near_row in range(row, row + 2 * WINDOW + 1):
                for near_col in range(col, col + 2 * WINDOW + 1):
                    count += counts[near_row, near_col]
                    total += step[near_row, near_col]
            if count >= 3.0:
                level[row, col] += total / (count + 1.0)  # the plane counts as one


@njit(cache=True, nogil=True)
def fill_heights(
    points: Points,
    rows: Rows,
    cell: Ints,
    level: Floats32,
    planes: Floats,
    max_height: float,
    height: Heights,
    mask: Mask,
) -> None:
    """Write heights of the points ``rows`` above the ground, or the nearest region's plane, and which are on it."""
    levels, slopes = level.reshape(-1), planes.reshape(-1)
    for k in range(rows.shape[0]):
        i = rows[k]
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if cell[i] >= 0:  # unsigned positions need no test for counting from the end: a third of the time
            at = np.uint32(cell[i])
            row, col = at // np.uint32(N_CELLS), at % np.uint32(N_CELLS)
            region = row // np.uint32(CELLS_A_REGION) * np.uint32(N_REGIONS) + col // np.uint32(CELLS_A_REGION)
            a, b = slopes[np.uint32(3) * region], slopes[np.uint32(3) * region + np.uint32(1)]
            dx = x - ((np.int32(row) + 0.5) * CELL_M - REACH_M)
            dy = y - ((np.int32(col) + 0.5) * CELL_M - REACH_M)
            height[k] = z - levels[at] - a * dx - b * dy
        elif abs(x) < math.inf and abs(y) < math.inf and abs(z) < math.inf:
            r = int(min(max((x + REACH_M) / REGION_M, 0.0), N_REGIONS - 1.0))
            q = int(min(max((y + REACH_M) / REGION_M, 0.0), N_REGIONS - 1.0))
            dx = x - ((r + 0.5) * REGION_M - REACH_M)
            dy = y - ((q + 0.5) * REGION_M - REACH_M)
            height[k] = z - planes[r, q, 2] - planes[r, q, 0] * dx - planes[r, q, 1] * dy
        else:
            height[k] = math.nan
    for k in range(rows.shape[0]):
        mask[k] = (height[k] >= -MAX_DEPTH_M) & (height[k] <= max_height)


@njit(cache=True, nogil=True)
def fill_heights_above_plane(
    points: Points, rows: Rows, plane: Floats, max_height: float, height: Heights, mask: Mask
) -> None:
    """Write the heights of some points above z = a x + b y + c (NaN if not finite), and whether they are on it."""
    for k in range(rows.shape[0]):
        i = rows[k]
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        above = z - plane[0] * x - plane[1] * y - plane[2]
        height[k] = above if abs(x) < math.inf and abs(y) < math.inf and abs(z) < math.inf else math.nan
        mask[k] = -MAX_DEPTH_M <= height[k] <= max_height
