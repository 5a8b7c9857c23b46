"""Outlines of cells: kernels against their twins, and polygons that are valid for all cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from shapely import LineString, Polygon, box, coverage_union_all

import twins.outline
from edgeperc.road import outline as outlines

MASKS = npst.arrays(np.bool_, npst.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9))


@st.composite
def streets(draw: st.DrawFn, most: int = 40) -> NDArray[np.bool_]:
    """Cells as of a street: noise, blobs, or both."""
    shape = draw(st.tuples(st.integers(1, most), st.integers(1, most)))
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    cells = random.random(shape) < draw(st.sampled_from([0.3, 0.5, 0.7, 0.9, 0.98]))
    grain = draw(st.integers(1, 6))
    cells = np.kron(cells, np.ones((grain, grain), np.bool_))[: shape[0], : shape[1]]
    return cells ^ (random.random(shape) < draw(st.sampled_from([0.0, 0.02, 0.1])))


def traced(cells: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], list[NDArray[np.int64]]]:
    """The nearest part of padded cells, and its rings."""
    grid = np.pad(cells, 1)
    part = outlines.without_gaps(grid, np.zeros_like(grid), (0.0, 0.0), ~np.zeros_like(grid))
    return part, outlines.rings_of(part)


@given(MASKS, st.floats(0.0, 12.0))
def test_cells_grow_by_a_disc(cells: NDArray[np.bool_], radius: float) -> None:
    grown = ~cells
    outlines.fill_grown(cells, radius, grown)
    np.testing.assert_array_equal(grown, twins.outline.grown(cells, radius))


# One cell is added and removed again in one pass.
@example(np.array([[0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0, 1, 0, 0], [1, 0, 0, 0, 0], [0, 1, 0, 1, 0]], np.bool_), 5)
@given(MASKS, st.integers(0, 99))
def test_no_two_cells_share_only_a_corner(cells: NDArray[np.bool_], seed: int) -> None:
    addable = np.random.default_rng(seed).random(cells.shape) < 0.5
    expected = twins.outline.without_contacts(cells, addable)
    outlines.resolve_contacts(cells, addable)
    np.testing.assert_array_equal(cells, expected)
    a, b, c, d = cells[:-1, :-1], cells[:-1, 1:], cells[1:, :-1], cells[1:, 1:]
    assert not ((a == d) & (b == c) & (a != b)).any()


@given(MASKS, st.data())
def test_connected_cells_share_sides(cells: NDArray[np.bool_], data: st.DataObject) -> None:
    row, col = (data.draw(st.integers(0, n - 1)) for n in cells.shape)
    cells[row, col] = True
    part = np.ones_like(cells)
    outlines.mark_connected(cells, row, col, part)
    np.testing.assert_array_equal(part, twins.outline.connected(cells, row, col))


@given(MASKS)
def test_rings_trace_every_side_once_with_the_cells_on_the_left(cells: NDArray[np.bool_]) -> None:
    padded = np.pad(cells, 1)
    sides = twins.outline.sides(padded)
    corners, ends = np.empty((len(sides), 2), np.int64), np.empty(len(sides) // 4 + 1, np.int64)
    n_rings = outlines.fill_rings(padded, corners, ends)
    walked: list[tuple[tuple[int, int], tuple[int, int]]] = []
    begin = 0
    for end in ends[:n_rings].tolist():
        ring = corners[begin:end].tolist()
        begin = end
        assert len(ring) >= 4
        for (row, col), (to_row, to_col) in zip(ring, ring[1:] + ring[:1], strict=True):
            assert (row == to_row) != (col == to_col)
            steps = abs(to_row - row) + abs(to_col - col)
            way = ((to_row - row) // steps, (to_col - col) // steps)
            walked += [
                ((row + k * way[0], col + k * way[1]), (row + (k + 1) * way[0], col + (k + 1) * way[1]))
                for k in range(steps)
            ]
    assert len(walked) == len(sides)
    assert set(walked) == sides


@settings(max_examples=40)
@given(streets(14), st.data())
def test_corners_are_removed_as_by_the_twin(cells: NDArray[np.bool_], data: st.DataObject) -> None:
    part, rings = traced(cells)
    if not rings:
        return
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    addable, removable = (random.random((2, *part.shape)) < data.draw(st.sampled_from([0.0, 0.8, 1.0]))) | [part, ~part]
    outer, enough = data.draw(st.integers(0, len(rings) - 1)), data.draw(st.integers(3, 12))
    corners, ends = np.concatenate(rings), np.cumsum([len(ring) for ring in rings])
    kept = np.ones(len(corners), np.bool_)
    outlines.mark_needed(corners, ends, outlines.row_sums(addable), outlines.row_sums(removable), outer, enough, kept)
    found = [ring[few].tolist() for ring, few in zip(rings, np.split(kept, ends[:-1]), strict=True)]
    expected = twins.outline.needed([map(tuple, ring.tolist()) for ring in rings], addable, removable, outer, enough)
    assert found == [[list(corner) for corner in ring] for ring in expected]


CORNERS = st.tuples(st.integers(0, 9), st.integers(0, 9))


@pytest.mark.kernel
@given(st.tuples(CORNERS, CORNERS, CORNERS), npst.arrays(np.bool_, (9, 9)))
def test_cells_that_a_triangle_touches(triangle: tuple[tuple[int, int], ...], fixed: NDArray[np.bool_]) -> None:
    touched = Polygon(triangle).intersection(shape_of(fixed)).area > 1e-9
    if Polygon(triangle).area > 0.0:
        assert outlines.may_change(*np.ravel(triangle).tolist(), outlines.row_sums(~fixed)) == (not touched)
    assert abs(outlines.turn(*np.ravel(triangle).tolist())) == pytest.approx(2.0 * Polygon(triangle).area)


@pytest.mark.kernel
@given(st.tuples(CORNERS, CORNERS, CORNERS, CORNERS))
def test_edges_that_meet(ends: tuple[tuple[int, int], ...]) -> None:
    a, b, c, d = ends
    if a != b and c != d:
        assert outlines.meet(*np.ravel(ends).tolist()) == LineString([a, b]).intersects(LineString([c, d]))


@settings(max_examples=40)
@given(streets(14), st.data())
def test_corners_are_merged_as_by_the_twin(cells: NDArray[np.bool_], data: st.DataObject) -> None:
    part, rings = traced(cells)
    if not rings:
        return
    random = np.random.default_rng(data.draw(st.integers(0, 99)))
    changeable = random.random(part.shape) < data.draw(st.sampled_from([0.0, 0.7, 0.9, 1.0]))
    changeable &= part | ~outlines.filled(part)  # otherwise a hole may come outside
    around, enough = data.draw(st.integers(0, 4)), data.draw(st.integers(0, 12))
    outer, *holes = sorted(rings, key=lambda ring: -Polygon(ring).area)
    edges = np.concatenate([*(np.hstack([hole, np.roll(hole, -1, 0)]) for hole in holes), np.empty((0, 4), np.int64)])
    ring = outer.copy()
    few = ring[: outlines.merge_corners(ring, edges, outlines.row_sums(changeable), around, enough)]
    expected = twins.outline.merged(list(map(tuple, outer.tolist())), edges.tolist(), changeable, around, enough)
    assert list(map(tuple, few.tolist())) == expected
    assert Polygon(few, holes).is_valid
    assert Polygon(few).symmetric_difference(Polygon(outer)).intersection(shape_of(~changeable)).area < 1e-9


def polygon_of(outline: outlines.Outline) -> Polygon:
    return Polygon(outline.outer, outline.holes)


def shape_of(cells: NDArray[np.bool_]) -> Polygon:
    row, col = np.nonzero(cells)
    return coverage_union_all(box(row, col, row + 1, col + 1))


@given(streets(), streets(), st.floats(0.0, 6.0), st.integers(4, 40), st.integers(-10, 50))
def test_polygons_are_valid(
    cells: NDArray[np.bool_], others: NDArray[np.bool_], tolerance: float, max_corners: int, row: int
) -> None:
    objects = np.zeros_like(cells)
    few = tuple(min(sizes) for sizes in zip(cells.shape, others.shape, strict=True))
    objects[: few[0], : few[1]] = ~others[: few[0], : few[1]]
    cells &= ~objects
    found = outlines.outline_of(cells, (row, 5.0), objects, objects, tolerance=tolerance, max_corners=max_corners)
    if not cells.any():
        assert found.outer.shape == (0, 2)
        assert found.holes == ()
        return
    polygon = polygon_of(found)
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert polygon.area > 0.0
    assert found.factor == 1.0 or tolerance > 0.0
    assert len(found.outer) <= max_corners or tolerance == 0.0
    standing = shape_of(objects)
    assert polygon.intersection(standing).area < 1e-9
    for hole in found.holes:
        assert not Polygon(hole).exterior.is_ccw
        assert Polygon(hole).intersection(standing).area > 0.9


@settings(max_examples=40)
@given(streets(30), st.floats(1.0, 5.0), st.integers(4, 1000))
def test_polygons_are_near_the_cells(cells: NDArray[np.bool_], tolerance: float, max_corners: int) -> None:
    found = outlines.outline_of(cells, (40.0, 20.0), ~cells, ~cells, tolerance=tolerance, max_corners=max_corners)
    loose = outlines.outline_of(cells, (40.0, 20.0), cells, ~cells, tolerance=tolerance, max_corners=max_corners)
    if not cells.any():
        return
    edges = shape_of(cells).boundary
    # Where objects are all around, nothing is added.
    assert shape_of(cells).buffer(1e-6).contains(polygon_of(found))
    if np.isfinite(loose.factor):
        assert edges.buffer(tolerance * loose.factor + 1e-2, quad_segs=16).contains(polygon_of(loose).boundary)
    assert polygon_of(loose).difference(shape_of(cells).buffer(tolerance + 1e-2, quad_segs=16)).is_empty


@given(streets(20), st.integers(4, 12))
def test_the_outline_has_few_corners(cells: NDArray[np.bool_], max_corners: int) -> None:
    nothing = np.zeros_like(cells)
    found = outlines.outline_of(cells, (0.0, 0.0), nothing, nothing, tolerance=2.0, max_corners=max_corners)
    assert len(found.outer) <= max_corners
    assert found.holes == ()


@given(st.integers(0, 2**32), st.integers(4, 60), st.floats(0.5, 4.0), st.sampled_from([0.002, 0.01, 0.05, 0.3]))
def test_holes_do_not_cost_corners(seed: int, max_corners: int, tolerance: float, density: float) -> None:
    """A road full of obstacles, and of any shape, has few corners, too; it covers none of them."""
    random = np.random.default_rng(seed)
    cells = np.kron(random.random((6, 5)) < 0.8, np.ones((8, 8), np.bool_))
    objects = random.random(cells.shape) < density
    cells &= ~objects
    found = outlines.outline_of(cells, (48.0, 20.0), objects, objects, tolerance=tolerance, max_corners=max_corners)
    assert len(found.outer) <= max_corners
    polygon = polygon_of(found)
    assert polygon.is_valid
    assert polygon.area > 0.0 or not cells.any()
    assert polygon.intersection(shape_of(objects)).area < 1e-9


@given(streets(12))
def test_without_a_tolerance_the_cells_are_outlined(cells: NDArray[np.bool_]) -> None:
    outlines.resolve_contacts(cells, np.zeros_like(cells))
    found = outlines.outline_of(cells, (6.0, 6.0), ~cells, ~cells, tolerance=0.0, max_corners=4)
    part = outlines.nearest_part(cells, (6.0, 6.0))
    assert shape_of(part).symmetric_difference(polygon_of(found)).area == 0.0


def test_results_by_hand() -> None:
    cells = np.ones((20, 30), np.bool_)
    cells[0, ::2] = False  # teeth
    cells[6:12, 8:14] = False  # an obstacle
    cells[15:18, 20:27] = False  # a gap
    obstacle = np.zeros_like(cells)
    obstacle[9, 11] = True
    found = outlines.outline_of(cells, (20.0, 15.0), np.zeros_like(cells), obstacle, tolerance=2.0, max_corners=40)
    assert found.factor == 1.0
    assert len(found.outer) == 4
    (hole,) = found.holes
    assert box(8, 10, 10, 12).within(Polygon(hole))
    assert box(6, 8, 12, 14).contains(Polygon(hole))
    exact = outlines.outline_of(cells, (20.0, 15.0), ~cells, ~cells, tolerance=0.0, max_corners=4)
    assert len(exact.outer) == 62
    assert len(exact.holes) == 2


def test_a_ring_of_one_cell_stays_a_ring() -> None:
    (ring,) = outlines.rings_of(np.pad([[True]], 1))
    assert ring.tolist() == [[2, 2], [1, 2], [1, 1], [2, 1]]
    cell = np.ones((1, 1), np.bool_)
    found = outlines.outline_of(cell, (0.0, 0.0), ~cell, ~cell, tolerance=5.0, max_corners=4)
    assert len(found.outer) in (3, 4)


@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_of_any_order(order: str) -> None:
    cells = np.asarray(np.random.default_rng(0).random((12, 9)) < 0.8, order=order)  # type: ignore[call-overload]
    expected = outlines.outline_of(
        np.ascontiguousarray(cells), (3.0, 3.0), ~cells, ~cells, tolerance=1.0, max_corners=9
    )
    found = outlines.outline_of(cells, (3.0, 3.0), ~cells, ~cells, tolerance=1.0, max_corners=9)
    np.testing.assert_array_equal(found.outer, expected.outer)
