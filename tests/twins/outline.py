"""Slow twins of outlines."""

from __future__ import annotations

import numpy as np
from shapely import LinearRing, Point, Polygon, box


def grown(cells, radius):
    """Twin of `edgeperc.outline.fill_grown`: distances to all marked cells."""
    rows, cols = np.nonzero(cells)
    row, col = np.indices(cells.shape)
    squares = (row[..., None] - rows) ** 2 + (col[..., None] - cols) ** 2
    return (squares <= radius**2).any(axis=-1)


def without_contacts(cells, addable):
    """Twin of `edgeperc.outline.resolve_contacts`, in the same order."""
    cells, addable, before = cells.copy(), addable.copy(), None
    while before is None or (cells != before).any():
        before = cells.copy()
        for row, col in np.ndindex(len(cells) - 1, cells.shape[1] - 1):
            square, may = cells[row : row + 2, col : col + 2], addable[row : row + 2, col : col + 2]
            if square.sum() == 2 and square[0, 0] == square[1, 1]:
                between = [cell for cell in ((1, 0), (1, 1), (0, 0), (0, 1)) if may[cell] and not square[cell]]
                if between:
                    square[between[0]] = True
                else:
                    may[0] &= ~square[0]
                    square[0] = False
    return cells


def connected(cells, row, col):
    """Twin of `edgeperc.outline.mark_connected`: the part grows until it no longer does."""
    part = np.zeros_like(cells)
    part[row, col] = True
    while True:
        padded = np.pad(part, 1)
        grown = part | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
        grown &= cells
        if (grown == part).all():
            return part
        part = grown


def sides(cells):
    """What the rings of `edgeperc.outline.fill_rings` consist of: sides from corner to corner, cells to the left."""
    found = set()
    for row, col in np.argwhere(cells).tolist():
        square = [(row + 1, col), (row + 1, col + 1), (row, col + 1), (row, col)]
        for k, (dr, dc) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
            if not cells[row + dr, col + dc]:
                found.add((square[k], square[(k + 1) % 4]))
    return found


def needed(rings, addable, removable, outer, enough):
    """Twin of `edgeperc.outline.mark_needed`: the same order, shapely's geometry; rings of tuples."""
    rings = [list(ring) for ring in rings]
    places = [(number, corner) for number, ring in enumerate(rings) for corner in ring]
    limit, largest = 0, 4 * np.prod(np.max([corner for _, corner in places], axis=0) + 2)
    while limit <= largest:
        changed = False
        for number, corner in places:
            ring = rings[number]
            if corner not in ring or len(ring) <= 3:
                continue
            if len(rings[outer]) <= enough:
                return rings
            k = ring.index(corner)
            before, after = ring[k - 1], ring[(k + 1) % len(ring)]
            rest = ring[:k] + ring[k + 1 :]
            triangle = Polygon([before, corner, after])
            if triangle.area * 2 > limit or Polygon(rest).area == 0:
                continue
            others = {other for each in rings for other in each} - {before, corner, after}
            (row, col), (to_row, to_col) = np.min(triangle.exterior.coords, 0), np.max(triangle.exterior.coords, 0)
            free = removable if LinearRing([before, corner, after]).is_ccw else addable
            touched = [
                (r, c)
                for r in range(int(row), int(to_row))
                for c in range(int(col), int(to_col))
                if triangle.intersection(box(r, c, r + 1, c + 1)).area > 1e-7
            ]
            if all(free[cell] for cell in touched) and not any(triangle.intersects(Point(each)) for each in others):
                rings[number] = rest
                changed = True
        if not changed:
            limit = max(1, 2 * limit)
    return rings
