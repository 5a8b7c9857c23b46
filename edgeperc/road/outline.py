"""The outline of cells as one valid polygon with few corners.

The cells are smoothed by a disc and traced. Then corners are removed one by one. A corner may go only if the triangle
that it forms with its two neighbors contains no other corner of any ring. Then no edge crosses that triangle, so the
polygon is valid after every removal. If too many corners remain, two neighbors are replaced by one new corner where the
new edges meet no other edge. The coordinates of corners are whole numbers, so these tests are exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..system.kernels import njit
from ..types.points import Ints, Ints64, Mask

REACHES = (1.0, 1.25, 1.5, 2.0, 4.0, 8.0)
"""Factors of the tolerance that are tried in turn if the outline has too many corners."""
FARTHEST = 8
"""Cells around two corners where one in their place is looked for, at most; time grows with its square."""


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The outline of connected cells. A cell's upper left corner has the cell's row and column."""

    # (k, 2) row and column of the corners, with the cells on the left. Shape (0, 2) if there are no cells.
    outer: Ints64
    holes: tuple[Ints64, ...]
    factor: float  # no cell that is left out is farther than this many times the tolerance from the edges of the cells


def outline_of(
    cells: Mask, origin: tuple[float, float], obstacles: Mask, in_holes: Mask, *, tolerance: float, max_corners: int
) -> Outline:
    """Outline the connected cells that are nearest to a place: a valid polygon, with holes that touch nothing.

    Closing by a disc fills gaps narrower than twice the tolerance, opening removes what is as narrow. So cells that are
    connected only over a narrower passage are left out. Where two cells share only a corner, a cell between them is
    added, or else the one with the smaller row is left out. Corners are removed by growing area of their triangle
    (Visvalingam and Whyatt, 1993), as long as all cells that the triangle touches are within the tolerance. If more
    than ``max_corners`` remain, pairs of neighbors are replaced by one corner that may be anywhere on the grid, by
    growing area between the old edges and the new ones, under the same condition.

    origin : row and column of the place, where a cell's middle has the cell's row and column; perhaps outside the grid.
    obstacles : cells that are never included.
    in_holes : a hole without such a cell is filled.
    tolerance : largest distance between the outline and the edges of the cells, in cells. 0 keeps all corners.
    max_corners : of the outer ring, at least 4. If they do not suffice, cells are left out that are farther from the
        edges, at last all between holes and the first row; no more are added.
    """
    # A kernel is compiled for arrays in C order.
    cells, obstacles, in_holes = (np.ascontiguousarray(mask, np.bool_) for mask in (cells, obstacles, in_holes))
    grid, wanted = np.pad(cells, 1), np.pad(in_holes & ~cells, 1)
    free = np.pad(cells | ~obstacles, 1)
    place = (origin[0] + 1.0, origin[1] + 1.0)
    near = _grown(grid, tolerance)
    addable = near & free
    closed = without_gaps(grid | (addable & ~_opened(~grid, near, tolerance)), addable, place, wanted)
    beside = _grown(~closed, tolerance)
    opened = _opened(closed, beside, tolerance)
    smooth = without_gaps(opened if opened.any() else closed, closed, place, wanted)
    rings = rings_of(smooth)
    if not rings:
        return Outline(np.empty((0, 2), np.int64), (), 1.0)

    outer = _outer(rings)
    added = addable | closed
    found = _needed(rings, row_sums(added), row_sums(beside), outer, 3)
    factor = 1.0
    if tolerance > 0.0 and len(found[outer]) > max_corners:
        holes = [np.hstack([ring, np.roll(ring, -1, axis=0)]) for k, ring in enumerate(found) if k != outer]
        edges, around = np.concatenate([*holes, np.empty((0, 4), np.int64)]), min(math.ceil(2.0 * tolerance), FARTHEST)
        for factor in REACHES:
            # Holes are not marked, as no cell of them may come outside.
            band = np.where(smooth, _grown(~closed, factor * tolerance), added & ~filled(smooth))
            n = merge_corners(found[outer], edges, row_sums(band), around, max_corners)
            found[outer] = found[outer][:n]
            if n <= max_corners:
                break
        else:
            factor = math.inf
            anywhere = row_sums(np.ones_like(closed))
            found = _needed(found, row_sums(added), anywhere, outer, max_corners)
            if len(found[outer]) > max_corners:  # a ring without holes loses any corners; these are in the way
                behind = np.logical_or.accumulate((filled(smooth) & ~smooth)[::-1])[::-1]
                rings = rings_of(without_gaps(smooth & ~behind, np.zeros_like(smooth), place, ~smooth))
                outer = _outer(rings)
                found = _needed(rings, row_sums(added), anywhere, outer, max_corners)
    found = [ring - 1 for ring in found]
    return Outline(found[outer], tuple(ring for k, ring in enumerate(found) if k != outer), factor)


def nearest_part(cells: Mask, origin: tuple[float, float]) -> Mask:
    """The connected cells (rows, columns) around the one nearest to ``origin``; cells share sides."""
    part = np.zeros(cells.shape, np.bool_)
    rows, cols = np.nonzero(cells)
    if len(rows):
        nearest = int(np.argmin(np.hypot(rows - origin[0], cols - origin[1])))
        mark_connected(cells, int(rows[nearest]), int(cols[nearest]), part)
    return part


def without_gaps(cells: Mask, addable: Mask, origin: tuple[float, float], wanted: Mask) -> Mask:
    """The nearest part, without cells that touch only at a corner, and without holes that contain no wanted cell."""
    part = cells.copy()
    resolve_contacts(part, addable.copy())
    part = nearest_part(part, origin)
    holes = filled(part) & ~part
    pending, hole = holes & wanted, np.empty_like(part)
    while pending.any():
        row, col = divmod(int(np.argmax(pending)), pending.shape[1])
        mark_connected(holes, row, col, hole)
        pending &= ~hole
        holes &= ~hole
    return part | holes


def filled(cells: Mask) -> Mask:
    """The cells and their holes, in a grid whose border is not marked."""
    outside = np.empty_like(cells)
    mark_connected(~cells, 0, 0, outside)
    return ~outside


def _grown(cells: Mask, radius: float) -> Mask:
    grown = np.empty_like(cells)
    fill_grown(cells, radius, grown)
    return grown


def _opened(cells: Mask, beside: Mask, radius: float) -> Mask:
    """The cells without parts that no disc fits into; ``beside`` are the other cells, grown by the radius."""
    return cells & _grown(_grown(~beside, radius), radius)


def rings_of(cells: Mask) -> list[Ints64]:
    """Rings of corners (row, column) around cells of a grid whose border is not marked."""
    n_sides = sum(int(np.count_nonzero(cells & ~np.roll(cells, shift, axis))) for axis in (0, 1) for shift in (1, -1))
    corners, ends = np.empty((n_sides, 2), np.int64), np.empty(n_sides // 4 + 1, np.int64)
    n_rings = fill_rings(cells, corners, ends)
    return np.split(corners, ends[:n_rings])[:n_rings]


def _needed(rings: list[Ints64], not_addable: Ints, not_removable: Ints, outer: int, enough: int) -> list[Ints64]:
    """The rings with the corners that `mark_needed` keeps."""
    corners, ends = np.concatenate(rings), np.cumsum([len(ring) for ring in rings], dtype=np.int64)
    kept = np.empty(len(corners), np.bool_)
    mark_needed(corners, ends, not_addable, not_removable, outer, enough, kept)
    return [ring[few] for ring, few in zip(rings, np.split(kept, ends[:-1]), strict=True)]


def _outer(rings: list[Ints64]) -> int:
    """Which of the rings has a positive area: only the outer one."""
    return int(np.argmax([row @ np.roll(col, -1) - col @ np.roll(row, -1) for row, col in (r.T for r in rings)]))


def row_sums(cells: Mask) -> Ints:
    """Number of cells of each row before each column that are not marked, (rows, columns + 1)."""
    sums = np.zeros((cells.shape[0], cells.shape[1] + 1), np.int32)
    np.cumsum(~cells, axis=1, out=sums[:, 1:])
    return sums


@njit(cache=True, nogil=True)
def fill_grown(cells: Mask, radius: float, grown: Mask) -> None:
    """Mark the cells whose middle is within a distance of the middle of a marked cell.

    radius : in cells, 0 or more and finite.
    """
    height, width = cells.shape
    for row in range(height):
        for col in range(width):
            grown[row, col] = cells[row, col]
    around = int(radius)
    for row in range(height):
        for col in range(width):
            if not cells[row, col]:
                continue
            if (  # the marked cell that is nearest to another cell has a side in common with one that is not marked
                (row == 0 or cells[row - 1, col])
                and (row == height - 1 or cells[row + 1, col])
                and (col == 0 or cells[row, col - 1])
                and (col == width - 1 or cells[row, col + 1])
            ):
                continue
            for r in range(max(row - around, 0), min(row + around + 1, height)):
                for c in range(max(col - around, 0), min(col + around + 1, width)):
                    if (r - row) * (r - row) + (c - col) * (c - col) <= radius * radius:
                        grown[r, c] = True


@njit(cache=True, nogil=True)
def resolve_contacts(cells: Mask, addable: Mask) -> None:
    """Add or remove cells until no two marked cells share only a corner. Of the two between such a pair, the one with
    the larger row is added, if possible; if none is addable, the one of the pair with the smaller row is removed for
    good.
    """
    height, width = cells.shape
    changed = True
    while changed:
        changed = False
        for row in range(height - 1):
            for col in range(width - 1):
                a, b = cells[row, col], cells[row, col + 1]
                if a == b or cells[row + 1, col] != b or cells[row + 1, col + 1] != a:
                    continue
                changed = True
                left = 0 if a else 1  # the upper cell of the pair stands at col + left, the lower one opposite
                if addable[row + 1, col + left]:
                    cells[row + 1, col + left] = True
                elif addable[row, col + 1 - left]:
                    cells[row, col + 1 - left] = True
                else:
                    cells[row, col + left] = False
                    addable[row, col + left] = False


@njit(cache=True, nogil=True)
def mark_connected(cells: Mask, row: int, col: int, part: Mask) -> None:
    """Mark the cells that are connected to a start cell over shared sides.

    row, col : a marked cell of ``cells``, where the search begins.
    """
    height, width = cells.shape
    part[:] = False
    pending = np.empty((height * width, 2), np.int32)
    pending[0, 0], pending[0, 1] = row, col
    part[row, col] = True
    n = 1
    while n > 0:
        n -= 1
        r, c = pending[n, 0], pending[n, 1]
        for k in range(4):
            dr = -1 if k == 0 else 1 if k == 1 else 0
            dc = -1 if k == 2 else 1 if k == 3 else 0
            if 0 <= r + dr < height and 0 <= c + dc < width and cells[r + dr, c + dc] and not part[r + dr, c + dc]:
                part[r + dr, c + dc] = True
                pending[n, 0], pending[n, 1] = r + dr, c + dc
                n += 1


@njit(cache=True, nogil=True)
def fill_rings(cells: Mask, corners: Ints64, ends: Ints64) -> int:
    """Trace the edges of marked cells, none of them along the border, with the cells on the left.

    corners : (n, 2) corners where the trace turns, ring after ring; a cell's upper left corner has its row and column.
        ``n`` is at least the number of sides between a marked and an unmarked cell.
    ends : (m,) where each ring ends in ``corners``; ``m`` at least a quarter of ``n``.
    """
    height, width = cells.shape
    walked = np.empty((height, width), np.bool_)  # lower sides
    walked[:] = False
    n_corners, n_rings = 0, 0
    for top in range(height - 1):
        for left in range(width):
            if not cells[top, left] or cells[top + 1, left] or walked[top, left]:
                continue
            row, col, heading = top + 1, left, 0  # to the right along the lower side of the cell
            while True:
                if heading == 0:
                    walked[row - 1, col] = True
                    col += 1
                    ahead_left, ahead_right = cells[row - 1, col], cells[row, col]
                elif heading == 1:  # up
                    row -= 1
                    ahead_left, ahead_right = cells[row - 1, col - 1], cells[row - 1, col]
                elif heading == 2:  # left
                    col -= 1
                    ahead_left, ahead_right = cells[row, col - 1], cells[row - 1, col - 1]
                else:  # down
                    row += 1
                    ahead_left, ahead_right = cells[row, col], cells[row, col - 1]
                turn = 1 if not ahead_left else -1 if ahead_right else 0
                if turn != 0:
                    corners[n_corners, 0], corners[n_corners, 1] = row, col
                    n_corners += 1
                    heading = (heading + turn) % 4
                if row == top + 1 and col == left and heading == 0:
                    break
            ends[n_rings] = n_corners
            n_rings += 1
    return n_rings


@njit(cache=True, nogil=True)
def may_change(ar: int, ac: int, br: int, bc: int, cr: int, cc: int, fixed: Ints) -> bool:
    """Whether all cells that a triangle touches may change sides; ``fixed`` counts those before each that may not."""
    # In the strip of a row, its columns are bounded by its corners there and by the crossings of its edges with the
    # strip's two lines.
    for row in range(min(ar, br, cr), max(ar, br, cr)):
        low, high = np.inf, -np.inf
        for side in range(3):
            pr, pc, qr, qc = ar, ac, br, bc
            if side == 1:
                pr, pc, qr, qc = br, bc, cr, cc
            elif side == 2:
                pr, pc, qr, qc = cr, cc, ar, ac
            if max(pr, qr) < row or min(pr, qr) > row + 1:
                continue
            for line in range(2):
                at = min(max(row + line, min(pr, qr)), max(pr, qr))
                if pr != qr:
                    x = pc + (qc - pc) * (at - pr) / (qr - pr)
                    low, high = min(low, x), max(high, x)
                else:
                    low, high = min(low, np.float64(min(pc, qc))), max(high, np.float64(max(pc, qc)))
        left, right = int(np.floor(low + 1e-9)), int(np.ceil(high - 1e-9))
        if right > left and fixed[row, right] != fixed[row, left]:
            return False
    return True


@njit(cache=True, nogil=True)
def turn(ar: int, ac: int, br: int, bc: int, cr: int, cc: int) -> int:
    """Twice the area of a triangle, by row and column of its corners; the sign is that of the turn at b."""
    return (br - ar) * (cc - ac) - (bc - ac) * (cr - ar)


@njit(cache=True, nogil=True)
def meet(ar: int, ac: int, br: int, bc: int, cr: int, cc: int, dr: int, dc: int) -> bool:
    """Whether the edges ab and cd have a point in common, by row and column of their ends."""
    if max(ar, br) < min(cr, dr) or max(cr, dr) < min(ar, br) or max(ac, bc) < min(cc, dc) or max(cc, dc) < min(ac, bc):
        return False
    c, d = np.sign(turn(ar, ac, br, bc, cr, cc)), np.sign(turn(ar, ac, br, bc, dr, dc))
    a, b = np.sign(turn(cr, cc, dr, dc, ar, ac)), np.sign(turn(cr, cc, dr, dc, br, bc))
    return c * d <= 0 and a * b <= 0


@njit(cache=True, nogil=True)
def is_apart(ring: Ints64, edges: Ints64, k: int, pr: int, pc: int) -> bool:
    """Whether a ring stays valid with a corner p in place of its corners k and k + 1 (`merge_corners`)."""
    n = ring.shape[0]
    before, following, behind = (k - 1) % n, (k + 1) % n, (k + 2) % n
    ar, ac, dr, dc = ring[before, 0], ring[before, 1], ring[behind, 0], ring[behind, 1]
    for v in range(n):
        if v in (before, k, following):
            continue
        w = (v + 1) % n
        vr, vc, wr, wc = ring[v, 0], ring[v, 1], ring[w, 0], ring[w, 1]
        if w == before:  # has a in common with the edge ap
            if turn(vr, vc, ar, ac, pr, pc) == 0 and (vr - ar) * (pr - ar) + (vc - ac) * (pc - ac) > 0:
                return False
        elif meet(ar, ac, pr, pc, vr, vc, wr, wc):
            return False
        if v == behind:  # has d in common with the edge pd
            if turn(wr, wc, dr, dc, pr, pc) == 0 and (wr - dr) * (pr - dr) + (wc - dc) * (pc - dc) > 0:
                return False
        elif meet(pr, pc, dr, dc, vr, vc, wr, wc):
            return False
    for e in range(edges.shape[0]):
        vr, vc, wr, wc = edges[e, 0], edges[e, 1], edges[e, 2], edges[e, 3]
        if meet(ar, ac, pr, pc, vr, vc, wr, wc) or meet(pr, pc, dr, dc, vr, vc, wr, wc):
            return False
    return True


@njit(cache=True, nogil=True)
def merge_corners(ring: Ints64, edges: Ints64, fixed: Ints, around: int, enough: int) -> int:
    """Replace two neighboring corners of a valid ring by one, smallest changes first; returns how many are left.

    Between the neighbors a and d, the corner p replaces b and c. What changes sides lies in the triangles pab, pbc and
    pcd. No cell that they touch may be fixed, and of all such p, that with the smallest sum of their areas is taken.
    The new edges may meet no other edge, so the ring stays valid. Holes stay inside if none of their cells may change.

    edges : (m, 4) row and column of the two ends of other edges, which the ring may not touch.
    fixed : (rows, columns + 1) number of cells of each row before each column that may not change sides.
    around : how far the new corner may lie from the rectangle around the two [cells].
    enough : the ring keeps at least so many corners, and at least 4.
    """
    n, height, width = ring.shape[0], fixed.shape[0], fixed.shape[1] - 1
    tried = np.empty(n, np.int64)  # the limit at which a corner and the next one were tried in vain
    tried[:] = 0
    limit = 8  # of twice the areas together
    while limit <= 8 * height * width:
        changed = False
        k = 0
        while k < n:
            if n <= max(enough, 4):
                return n
            if tried[k] == limit:
                k += 1
                continue
            before, following, behind = (k - 1) % n, (k + 1) % n, (k + 2) % n
            ar, ac, br, bc = ring[before, 0], ring[before, 1], ring[k, 0], ring[k, 1]
            cr, cc, dr, dc = ring[following, 0], ring[following, 1], ring[behind, 0], ring[behind, 1]
            least, best_r, best_c = limit + 1, -1, -1
            for pr in range(max(0, min(br, cr) - around), min(height, max(br, cr) + around) + 1):
                for pc in range(max(0, min(bc, cc) - around), min(width, max(bc, cc) + around) + 1):
                    area = (
                        abs(turn(pr, pc, ar, ac, br, bc))
                        + abs(turn(pr, pc, br, bc, cr, cc))
                        + abs(turn(pr, pc, cr, cc, dr, dc))
                    )
                    if area >= least or turn(ar, ac, pr, pc, dr, dc) == 0:
                        continue
                    up, left = max(pr - 1, 0), max(pc - 1, 0)
                    down, right = min(pr + 1, height), min(pc + 1, width)
                    room = False  # beside the corner
                    for row in range(up, down):
                        room |= fixed[row, right] - fixed[row, left] < right - left
                    if not room:
                        continue
                    if not (
                        may_change(pr, pc, ar, ac, br, bc, fixed)
                        and may_change(pr, pc, br, bc, cr, cc, fixed)
                        and may_change(pr, pc, cr, cc, dr, dc, fixed)
                    ):
                        continue
                    if is_apart(ring[:n], edges, np.int64(k), pr, pc):
                        least, best_r, best_c = area, pr, pc
            if best_r < 0:
                tried[k] = limit
                k += 1
                continue
            changed = True
            ring[k, 0], ring[k, 1] = best_r, best_c
            for v in range(following, n - 1):
                ring[v, 0], ring[v, 1], tried[v] = ring[v + 1, 0], ring[v + 1, 1], tried[v + 1]
            n -= 1
            for near in range(-3, 3):
                tried[(k + near) % n] = 0
        if not changed:
            limit *= 4
    return n


@njit(cache=True, nogil=True)
def mark_needed(
    corners: Ints64, ends: Ints64, not_addable: Ints, not_removable: Ints, outer: int, enough: int, kept: Mask
) -> None:
    """Mark the corners of rings, with the region on the left, that are left when those of the smallest triangles are
    removed; at least three of each ring, and ``enough`` of the ``outer`` one.

    ends : where each ring ends in ``corners``.
    not_addable, not_removable : (rows, columns + 1) number of cells of each row before each column that may not be
        added to the region, or removed from it.
    """
    n = corners.shape[0]
    before, after, ring_of = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    size = np.empty(ends.shape[0], np.int64)
    largest = 1
    begin = 0
    for ring in range(ends.shape[0]):
        size[ring] = ends[ring] - begin
        for k in range(begin, ends[ring]):
            kept[k], ring_of[k], before[k], after[k] = True, ring, k - 1, k + 1
            largest = max(largest, 2 * (corners[k, 0] + 2) * (corners[k, 1] + 2))
        before[begin], after[ends[ring] - 1] = ends[ring] - 1, begin
        begin = ends[ring]

    limit = 0  # of twice the area of a triangle
    while limit <= 2 * largest:
        changed = False
        for k in range(n):
            if not kept[k] or size[ring_of[k]] <= 3:
                continue
            if size[outer] <= enough:
                return
            a, c = before[k], after[k]
            ar, ac, br, bc = corners[a, 0], corners[a, 1], corners[k, 0], corners[k, 1]
            cr, cc = corners[c, 0], corners[c, 1]
            twice = turn(ar, ac, br, bc, cr, cc)  # positive: the region is inside the corner
            if abs(twice) > limit:
                continue
            if size[ring_of[k]] == 4:  # the three corners that stay must not lie on a line
                d = after[c]
                if turn(ar, ac, cr, cc, corners[d, 0], corners[d, 1]) == 0:
                    continue
            if twice != 0 and not may_change(ar, ac, br, bc, cr, cc, not_removable if twice > 0 else not_addable):
                continue
            allowed = True
            low_r, high_r, low_c, high_c = min(ar, br, cr), max(ar, br, cr), min(ac, bc, cc), max(ac, bc, cc)
            sign = 1 if twice > 0 else -1
            for v in range(n):
                vr, vc = corners[v, 0], corners[v, 1]
                if vr < low_r or vr > high_r or vc < low_c or vc > high_c or not kept[v]:
                    continue
                if v in (a, k, c):
                    continue
                if (
                    sign * turn(ar, ac, br, bc, vr, vc) >= 0
                    and sign * turn(br, bc, cr, cc, vr, vc) >= 0
                    and sign * turn(cr, cc, ar, ac, vr, vc) >= 0
                ):
                    allowed = False
                    break
            if allowed:
                kept[k] = False
                after[a], before[c] = c, a
                size[ring_of[k]] -= 1
                changed = True
        if not changed:
            limit = max(1, 2 * limit)
