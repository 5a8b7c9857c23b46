"""Roads as polygons, free distances and lane widths: kernels against their twins, and roads whose answers are known."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from shapely import Point, Polygon

import twins.ahead
import twins.outline
from edgeperc import Box, OptionError, Perceiver, TopView, Tracker, read_points
from edgeperc.road.ahead import fill_corridor, fill_first_cells, free_ahead, road_ahead
from edgeperc.road.outline import resolve_contacts
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import MODEL_MOUNTING, Mounting

CLASSES = ("background", "drivable", "car", "van", "truck")
MASKS = npst.arrays(np.bool_, npst.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9))


def view(drivable: NDArray[np.bool_], classes: tuple[str, ...] = CLASSES[:2]) -> TopView:
    rows, cols = drivable.shape
    y = 0.1 * cols / 2.0
    observed = np.ones(drivable.shape, np.bool_)
    return TopView(drivable.astype(np.uint8), classes, 0.1, (6.0, 6.0 + 0.1 * rows), (-y, y), observed)


def blank() -> NDArray[np.bool_]:
    return np.zeros((400, 200), np.bool_)


@given(MASKS)
def test_cells_are_counted_from_the_near_edge_to_the_first_of_each_kind(cells: NDArray[np.bool_]) -> None:
    objects, road = np.roll(cells, 1, axis=0) & np.roll(cells, 1, axis=1), np.ascontiguousarray(cells[::-1])
    firsts = np.full((3, cells.shape[1]), 99)
    fill_first_cells(objects, cells, road, firsts)
    assert firsts.tolist() == twins.ahead.first_cells(objects, cells, road)


@given(MASKS, st.floats(-3.0, 9.0), st.floats(0.5, 9.0))
def test_the_corridor_follows_the_largest_overlap(cells: NDArray[np.bool_], first: float, width: float) -> None:
    bounds = np.full((len(cells), 2), 99)
    fill_corridor(cells, first, first + width, bounds)
    np.testing.assert_array_equal(bounds, twins.ahead.corridor(cells, first, first + width))


@pytest.mark.compiled
@given(npst.arrays(np.bool_, npst.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12)))
def test_the_polygon_is_the_part_nearest_to_the_sensor(cells: NDArray[np.bool_]) -> None:
    resolve_contacts(cells, np.zeros_like(cells))
    top_view = view(cells)
    road = road_ahead(top_view, tolerance_m=0.0)
    if not cells.any():
        assert road.outline.shape == (0, 2)
        assert road.holes == ()
        return
    polygon = Polygon(road.outline, road.holes)
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert all(not Polygon(hole).exterior.is_ccw for hole in road.holes)
    centers = {(row, col): top_view.to_meters(row, col) for row, col in np.argwhere(cells).tolist()}
    nearest = min(centers, key=lambda cell: math.hypot(*centers[cell]))
    part = twins.outline.connected(cells, *nearest)
    for row in range(cells.shape[0]):
        for col in range(cells.shape[1]):
            inside = polygon.buffer(1e-6).contains(Point(top_view.to_meters(row, col)))
            assert inside == part[row, col] or math.hypot(*centers.get((row, col), (0, 0))) == pytest.approx(
                math.hypot(*centers[nearest])
            )


def test_a_simplified_polygon_stays_within_its_tolerance() -> None:
    rows, cols = np.indices((400, 200))
    cells = np.abs(cols - 100 - 30 * np.sin(rows / 90.0)) < 35
    cells[120:160, 120:140] = False
    exact = road_ahead(view(cells), tolerance_m=0.0)
    road = road_ahead(view(cells))
    assert road.tolerance_m == 0.2
    assert len(road.outline) <= 40 < len(exact.outline) / 5
    assert len(road.holes) == len(exact.holes) == 1
    polygon = Polygon(road.outline, road.holes)
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert polygon.boundary.hausdorff_distance(Polygon(exact.outline, exact.holes).boundary) <= 0.2 + 1e-9
    assert polygon.area == pytest.approx(0.01 * np.count_nonzero(cells), rel=0.01)
    assert {tuple(corner) for corner in road.outline} <= {tuple(corner) for corner in exact.outline}


@pytest.mark.parametrize("seed", range(4))
def test_corners_are_free_where_those_of_cells_are_too_many(seed: int) -> None:
    random = np.random.default_rng(seed)
    rows = np.arange(400)
    middle, half = 100 + 25 * np.sin(rows / 90.0 + seed), 35 + 6 * np.sin(rows / 31.0)
    noise = np.repeat(random.integers(-1, 2, (2, 100)), 4, axis=1)
    cols = np.arange(200)[None, :]
    cells = (cols > (middle - half + noise[0])[:, None]) & (cols < (middle + half + noise[1])[:, None])
    cells[180:200, 95:105] = False
    road, exact = road_ahead(view(cells), max_corners=30), road_ahead(view(cells), tolerance_m=0.0)
    loose = road_ahead(view(cells), max_corners=1000)
    assert len(loose.outline) > 50  # of the cells' corners
    assert len(road.outline) <= 30
    assert road.tolerance_m == 0.2
    polygon = Polygon(road.outline, road.holes)
    assert polygon.is_valid
    assert polygon.exterior.is_ccw
    assert len(road.holes) == 1
    assert polygon.boundary.hausdorff_distance(Polygon(exact.outline, exact.holes).boundary) <= 0.6
    assert Polygon(exact.outline, exact.holes).boundary.buffer(0.2 + 1e-3).contains(polygon.boundary)


def test_a_ragged_road_leaves_out_more() -> None:
    cells = ~blank()
    cells[:, 150:] = (np.arange(400) // 10 % 2 == 0)[:, None]  # 20 bays, 5 m deep and 1 m wide
    fine, coarse = road_ahead(view(cells), max_corners=1000), road_ahead(view(cells), max_corners=10)
    assert fine.tolerance_m == 0.2
    assert len(fine.outline) > 80
    assert coarse.tolerance_m > 0.2
    assert len(coarse.outline) <= 10
    assert Polygon(fine.outline).buffer(0.2).contains(Polygon(coarse.outline))


def test_only_obstacles_are_holes() -> None:
    labels, observed = np.ones((400, 200), np.uint8), ~blank()
    labels[100:110, 50:60] = 2  # a car
    labels[100:110, 90:100] = 0  # an island
    observed[200:210, 50:60] = False  # a gap between the rays
    road = road_ahead(TopView(labels, CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), observed))
    assert sorted(float(hole[:, 1].mean().round(6)) for hole in road.holes) == [0.5, 4.5]


def check_real(top_view: TopView, boxes: tuple[Box, ...]) -> float:
    road = road_ahead(top_view, boxes)
    if len(road.outline):
        assert len(road.outline) <= 40
        assert Polygon(road.outline, road.holes).is_valid
    return road.tolerance_m


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_polygons_of_real_scans_are_valid(data_root: Callable[[str], Path]) -> None:
    for sensor, folder, step in (("pandar64", "pandaset/velodyne", 4), ("hdl-64e", "kitti3d/training/velodyne", 60)):
        group, _, inside = folder.partition("/")
        perceive = Perceiver(sensor=sensor, provider="cpu", on_mismatch="warn")
        files = sorted((data_root(group) / inside).glob("*.bin"))[::step]
        assert len(files) > 5
        tolerances = []
        for file in files:
            found = perceive(read_points(file))
            tolerances.append(check_real(found.require_top_view(), found.boxes))
        assert np.median(tolerances) <= 0.4
        assert max(tolerances) <= 0.8


def test_road_computed_by_hand() -> None:
    labels = blank().astype(np.uint8)
    labels[:, 65:130] = 1  # y from 3.5 to -3.0: 6.5 m
    labels[200:240, 90:110] = 2  # a car from x = 22.0 to 26.0
    road = road_ahead(TopView(labels, CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), ~blank()))
    assert road.free_m[100] == pytest.approx(22.0)
    assert road.free_m[64] == 6.0
    assert road.free_m[65] == 46.0
    assert road.y_m[0] == pytest.approx(9.95)
    assert road.free_ahead_m() == pytest.approx(22.0)
    assert road.free_ahead_m(0.06) == pytest.approx(22.0)
    assert road.x_m[0] == pytest.approx(6.05)
    assert road.left_m[0] == pytest.approx(3.5)
    assert road.right_m[0] == pytest.approx(-3.0)
    np.testing.assert_allclose(road.width_m[:160], 6.5)
    assert road.lane_width_m == pytest.approx(3.25)
    assert {tuple(np.round(c, 6)) for c in road.outline} == {(6.0, 3.5), (6.0, -3.0), (46.0, -3.0), (46.0, 3.5)}
    (hole,) = road.holes
    assert {tuple(np.round(c, 6)) for c in hole} == {(22.0, 1.0), (22.0, -1.0), (26.0, 1.0), (26.0, -1.0)}
    # Past the car the corridor is the wider of the two ways, of equally wide ones the left.
    assert road.left_m[170] == pytest.approx(3.5)
    assert road.right_m[170] == pytest.approx(1.0)


@pytest.mark.parametrize(("slope", "width", "lanes"), [(0.0, 3.0, 1), (0.3, 7.2, 2), (-0.2, 9.9, 3), (0.1, 1.4, 1)])
def test_lanes_of_a_slanting_road(slope: float, width: float, lanes: int) -> None:
    x, y = (46.0 - 0.1 * (np.arange(400)[:, None] + 0.5)), 10.0 - 0.1 * (np.arange(200)[None, :] + 0.5)
    cells = np.abs(y - slope * (x - 12.0)) / math.hypot(1.0, slope) < width / 2.0
    assert road_ahead(view(cells)).lane_width_m * lanes == pytest.approx(width, abs=0.12)


def test_no_drivable_cell() -> None:
    for road in (
        road_ahead(view(blank())),
        road_ahead(
            TopView(np.ones((4, 2), np.uint8), CLASSES[::2], 0.1, (6, 6.4), (0, 0.2), np.ones((4, 2), np.bool_))
        ),
    ):
        assert road.outline.shape == (0, 2)
        assert (road.free_m == 6.0).all()
        assert np.isnan(road.left_m).all()
        assert np.isnan(road.width_m).all()
        assert math.isnan(road.lane_width_m)
    assert road_ahead(view(blank())).free_ahead_m() == 6.0


def test_boxes_are_obstacles_on_the_road() -> None:
    pedestrian = Box("pedestrian", 0.9, (20.0, 0.0, -0.9), (0.8, 0.6, 1.8), 0.3)
    beside = Box("car", 0.9, (30.0, 15.0, -0.9), (4.0, 1.8, 1.5), 0.0)
    top_view = view(~blank())
    road = road_ahead(top_view, [pedestrian, beside])
    assert 19.3 <= road.free_ahead_m() <= 19.7
    assert len(road.holes) == 1
    assert (road.free_m[np.abs(road.y_m) > 0.6] == 46.0).all()
    assert top_view.drivable.all()  # the map itself is as it was


@pytest.mark.parametrize(("x", "free_m"), [(4.0, 3.6), (6.0, 5.6), (0.3, 46.0), (-4.0, 46.0)])
def test_a_box_before_the_view_ends_the_free_distance(x: float, free_m: float) -> None:
    """One that reaches beside the sensor is not ahead."""
    pedestrian = Box("pedestrian", 0.99, (x, 0.0, -0.9), (0.8, 0.6, 1.8), 0.0)
    for mounting in (MODEL_MOUNTING, Mounting(2.1, 0.0, 0.66, -90.0)):
        top_view = dataclasses.replace(view(~blank()), mounting=mounting)
        boxes = ModelFrame(mounting).boxes_back([pedestrian])
        ahead, road = free_ahead(top_view, boxes), road_ahead(top_view, Tracker().update(boxes, 0.0))
        assert ahead.free_m == pytest.approx(free_m, abs=0.051)
        assert ahead.end == ("obstacle" if free_m < 46.0 else "end of view")
        assert road.free_ahead() == ahead
        assert (road.free_m[np.abs(road.y_m) > 0.4] == 46.0).all()


@pytest.mark.parametrize(("x", "yaw_deg", "free_m"), [(2.0, 0.0, 46.0), (2.0, -12.0, 3.75), (-0.5, -20.0, 0.38)])
def test_a_truck_that_cuts_in_ends_the_free_distance(x: float, yaw_deg: float, free_m: float) -> None:
    truck = Box("truck", 0.9, (x, 2.6, -0.2), (12.0, 2.5, 3.0), math.radians(yaw_deg))
    assert free_ahead(view(~blank()), [truck]).free_m == pytest.approx(free_m, abs=0.1)


def test_each_end_of_the_free_distance_has_its_distance() -> None:
    labels, observed = np.ones((400, 200), np.uint8), ~blank()
    labels[:100] = 0  # no road from 36 m on
    labels[150:160, 95:100] = 2  # a car from 30 to 31 m, left of the axis
    observed[170:180, 100:105] = False  # a gap from 28 to 29 m, right of it
    top_view = TopView(labels, CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), observed)
    ahead = free_ahead(top_view)
    assert ahead.end == "unknown"
    np.testing.assert_allclose(ahead[2:], [30.0, 36.0, 28.0, 46.0])
    road = road_ahead(top_view)
    assert road.free_ahead() == ahead
    assert {*road.free_end} == {"obstacle", "unknown", "edge of the road"}
    # In a gap that the beams explain, the label counts.
    between = ~observed
    bridged = free_ahead(dataclasses.replace(top_view, between_beams=between))
    assert (bridged.end, bridged.free_m, bridged.unknown_m) == ("obstacle", pytest.approx(30.0), math.inf)
    labels[175, 102] = 0
    edge = free_ahead(dataclasses.replace(top_view, between_beams=between))
    assert (edge.end, edge.free_m) == ("edge of the road", pytest.approx(28.4))


@pytest.mark.parametrize(("before_m", "end"), [(0.4, "obstacle"), (1.4, "obstacle"), (1.7, "edge of the road")])
def test_the_margin_before_an_obstacle_is_not_the_edge_of_the_road(before_m: float, end: str) -> None:
    labels = np.ones((400, 200), np.uint8)
    labels[200 : 200 + round(10.0 * before_m)] = 0
    labels[150:200] = 2  # from 26 m on
    ahead = free_ahead(TopView(labels, CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), ~blank()))
    assert ahead.end == end
    assert ahead.free_m == ahead.edge_m == pytest.approx(26.0 - before_m)
    assert ahead.obstacle_m == pytest.approx(26.0)


def test_a_strip_without_columns_has_no_end() -> None:
    ahead = free_ahead(view(~blank()), half_width_m=0.01)
    assert math.isnan(ahead.free_m)
    assert ahead[1:] == (None, math.inf, math.inf, math.inf, 46.0)


def test_all_cells_drivable() -> None:
    road = road_ahead(view(~blank()))
    assert (road.free_m == 46.0).all()
    assert len(road.outline) == 4
    assert math.isnan(road.lane_width_m)  # neither edge is in view
    np.testing.assert_allclose(road.width_m, 20.0)


def test_rows_that_do_not_fill_the_view_are_counted_from_its_far_edge() -> None:
    cells = np.ones((13, 6), np.bool_)  # 19.5 m of 20 m
    cells[:2] = False
    top_view = TopView(cells.astype(np.uint8), CLASSES[:2], 1.5, (6.0, 26.0), (-4.5, 4.5), cells | True)
    road = road_ahead(top_view)
    assert road.outline[:, 0].min() == 6.5
    assert road.free_ahead_m() == road.outline[:, 0].max() == 23.0


def test_road_that_begins_farther_ahead_has_no_free_distance() -> None:
    cells = blank()
    cells[:300, 80:120] = True
    road = road_ahead(view(cells))
    assert (road.free_m == 6.0).all()
    assert np.isnan(road.left_m[:100]).all()
    assert road.left_m[100] == pytest.approx(2.0)
    aside = blank()
    aside[:, :70] = True  # begins 3 m to the left
    assert np.isnan(road_ahead(view(aside)).left_m).all()


def test_results_are_immutable_and_errors_name_the_reason() -> None:
    road = road_ahead(view(~blank()))
    with pytest.raises(dataclasses.FrozenInstanceError):
        road.lane_width_m = 3.0  # type: ignore[misc]
    for tolerance_m in (-0.1, math.nan, "a", None):
        with pytest.raises(OptionError, match=f"tolerance_m is {tolerance_m!r}; expected a number from 0"):
            road_ahead(view(blank()), tolerance_m=tolerance_m)
    for half_width_m in (-0.1, math.nan, "a", None):
        with pytest.raises(OptionError, match=f"half_width_m is {half_width_m!r}; expected a number from 0"):
            free_ahead(view(blank()), half_width_m=half_width_m)
    with pytest.raises(OptionError, match="max_corners is 3; expected a whole number from 4"):
        road_ahead(view(blank()), max_corners=3)
    for center, size in (((math.nan, 0, 0), (4, 2, 1)), ((10, 0, 0), (math.inf, 2, 1)), ((10, 0, 0), (4, -2, 1))):
        for measure in (road_ahead, free_ahead):  # the road would be free there
            with pytest.raises(OptionError, match="expected finite numbers, and a length and a width"):
                measure(view(~blank()), [Box("car", 0.9, center, size, 0.0)])
    for measure in (road_ahead, free_ahead):
        with pytest.raises(OptionError, match=r"got a NoneType for top_view; pass perception.require_top_view\(\)"):
            measure(None)
        with pytest.raises(OptionError, match="boxes is None; expected Box objects"):
            measure(view(blank()), None)
        with pytest.raises(OptionError, match=r"boxes\[0\] is 3.0; expected a Box"):
            measure(view(blank()), [3.0])
