"""Slow twins of outlines."""

from __future__ import annotations

from typing import Any

import numpy as np
from shapely import LinearRing, LineString, Point, Polygon, box, coverage_union_all


def grown(cells: np.ndarray, radius: float) -> np.ndarray:
    """Twin of `edgeperc.road.outline.fill_grown`: distances to all marked cells."""
    rows, cols = np.nonzero(cells)
    row, col = np.indices(cells.shape)
    squares = (row[..., None] - rows) ** 2 + (col[..., None] - cols) ** 2
    return (squares <= radius**2).any(axis=-1)


def without_contacts(cells: np.ndarray, addable: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.road.outline.resolve_contacts`, in the same order."""
    cells, addable, changed = cells.copy(), addable.copy(), True
    while changed:  # a cell may be added and removed again in one pass
        changed = False
        for row, col in np.ndindex(len(cells) - 1, cells.shape[1] - 1):
            square, may = cells[row : row + 2, col : col + 2], addable[row : row + 2, col : col + 2]
            if square.sum() == 2 and square[0, 0] == square[1, 1]:
                changed = True
                between = [cell for cell in ((1, 0), (1, 1), (0, 0), (0, 1)) if may[cell] and not square[cell]]
                if between:
                    square[between[0]] = True
                else:
                    may[0] &= ~square[0]
                    square[0] = False
    return cells


def connected(cells: np.ndarray, row: int, col: int) -> Any:
    """Twin of `edgeperc.road.outline.mark_connected`: the part grows until it no longer does."""
    part = np.zeros_like(cells)
    part[row, col] = True
    while True:
        padded = np.pad(part, 1)
        grown = part | padded[:-2, 1:-1] | padded[2:, 1:-1] | padded[1:-1, :-2] | padded[1:-1, 2:]
        grown &= cells
        if (grown == part).all():
            return part
        part = grown


def sides(cells: np.ndarray) -> Any:
    """What the rings of `outline.fill_rings` consist of: sides from corner to corner, cells to the left."""
    found = set()
    for row, col in np.argwhere(cells).tolist():
        square = [(row + 1, col), (row + 1, col + 1), (row, col + 1), (row, col)]
        for k, (dr, dc) in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
            if not cells[row + dr, col + dc]:
                found.add((square[k], square[(k + 1) % 4]))
    return found


def needed(rings: list[Any], addable: np.ndarray, removable: np.ndarray, outer: int, enough: int) -> list[Any]:
    """Twin of `edgeperc.road.outline.mark_needed`: the same order, shapely's geometry; rings of tuples."""
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


def doubled_area(a: Any, b: Any, c: Any) -> Any:
    return abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def merged(ring: Any, edges: np.ndarray, changeable: np.ndarray, around: np.ndarray, enough: int) -> list[Any]:
    """Twin of `edgeperc.road.outline.merge_corners`: the same order, shapely's geometry; a ring of tuples."""
    ring, limit, tried = list(ring), 8, {}
    (height, width), others = changeable.shape, [LineString([edge[:2], edge[2:]]) for edge in edges]
    row, col = np.nonzero(~changeable)
    fixed = coverage_union_all(box(row, col, row + 1, col + 1))
    while limit <= 8 * height * width:
        changed, k = False, 0
        while k < len(ring):
            n = len(ring)
            if n <= max(enough, 4):
                return ring
            a, b, c, d = (ring[(k + step) % n] for step in (-1, 0, 1, 2))
            if tried.get(b) == limit:
                k += 1
                continue
            rest = [ring[(k + 2 + step) % n] for step in range(n - 2)]  # d to a
            places = [
                (row, col)
                for row in range(max(0, min(b[0], c[0]) - around), min(height, max(b[0], c[0]) + around) + 1)
                for col in range(max(0, min(b[1], c[1]) - around), min(width, max(b[1], c[1]) + around) + 1)
            ]
            areas = {p: sum(doubled_area(p, *side) for side in ((a, b), (b, c), (c, d))) for p in places}
            best = None
            for p in sorted((p for p in places if areas[p] <= limit), key=lambda p: (areas[p], p)):
                triangles = [Polygon([p, *side]) for side in ((a, b), (b, c), (c, d))]
                new = [LineString([a, p]), LineString([p, d])]
                if doubled_area(a, p, d) == 0 or any(each.intersection(fixed).area > 1e-9 for each in triangles):
                    continue
                around_p = [
                    (row, col)
                    for row in range(max(p[0] - 1, 0), min(p[0] + 1, height))
                    for col in range(max(p[1] - 1, 0), min(p[1] + 1, width))
                ]
                if not any(changeable[cell] for cell in around_p):
                    continue
                if LinearRing([*rest, p]).is_simple and not any(
                    each.intersects(edge) for each in new for edge in others
                ):
                    best = p
                    break
            if best is None:
                tried[b] = limit
                k += 1
                continue
            changed = True
            ring[k] = best
            del ring[(k + 1) % n]
            for step in range(-3, 3):
                tried.pop(ring[(k + step) % len(ring)], None)
        if not changed:
            limit *= 4
    return ring
