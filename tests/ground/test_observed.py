"""Cells that a scan observed: kernels against their twins, and scenes whose answer is known."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import twins.observed
from edgeperc import Box, Mounting, Perceiver, PointsError, TopView, free_ahead, road_ahead
from edgeperc.ground.observed import BRIDGE_M, CLEARANCE_M, Observer, fill_lowest_returns, follow_rays, mark_cells
from edgeperc.inference.projection import TopViewProjector
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.card import InputSpec
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import TopViewGeometry

VIEW = TopViewGeometry()
SMALL = TopViewGeometry((2.0, 10.0), (-3.0, 3.0), cell_m=0.5)
AROUND = TopViewGeometry((-8.0, 8.0), (-8.0, 8.0), cell_m=0.5)
ROAD_Z = -1.73
# The first example compiles a kernel.

coordinates = st.floats(-12.0, 12.0, width=32) | st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 3e38])
heights = st.floats(-2.5, 2.0, width=32) | st.sampled_from([ROAD_Z, -1.7, -1.6, math.nan, math.inf])
clouds = st.lists(st.tuples(coordinates, coordinates, heights), max_size=60).map(
    lambda rows: np.array([(*row, 0.5) for row in rows], np.float32).reshape(-1, 4)
) | st.integers(0, 2**32 - 1).map(  # hypothesis itself draws three points on average
    lambda seed: scan_of(np.random.default_rng(seed).uniform([-12.0, -12.0, -2.5], [12.0, 12.0, 2.0], (100, 3)))
)


def scan_of(xyz: NDArray[np.float64]) -> NDArray[np.float32]:
    return np.column_stack([xyz, np.full(len(xyz), 0.5)]).astype(np.float32)


def cast(
    sensor: SensorProfile, *blocks: tuple[float, float, float, float, float], height_m: float = -ROAD_Z
) -> NDArray[np.float32]:
    """A scan of the front half of level ground with blocks on it: first and last x, first and last y, height [m]."""
    azimuth = np.deg2rad(np.arange(-90.0, 90.0, 360.0 / sensor.columns))
    gradient = np.tan(np.deg2rad(sensor.elevations_deg))
    azimuth, gradient = (grid.ravel() for grid in np.meshgrid(azimuth, gradient))
    ahead = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    reach = np.where(gradient < 0.0, -height_m / np.where(gradient < 0.0, gradient, -1.0), np.inf)
    for x_first, x_last, y_first, y_last, tall in blocks:
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = np.stack(
                [np.array([x_first, x_last]) / ahead[:, :1], np.array([y_first, y_last]) / ahead[:, 1:]], 1
            )
        enter, leave = sides.min(2).max(1), sides.max(2).min(1)
        # What a ray meets first: the front at its height, or the top.
        on_top = np.where(gradient < 0.0, (height_m - tall) / np.where(gradient < 0.0, -gradient, 1.0), np.inf)
        hit = np.where(height_m + gradient * enter <= tall, enter, on_top)
        reach = np.where((enter < leave) & (enter > 0.0) & (hit < leave) & (hit < reach), hit, reach)
    hit = reach < 100.0
    return scan_of(np.column_stack([ahead[hit] * reach[hit, None], reach[hit] * gradient[hit] + height_m + ROAD_Z]))


def highest(points: NDArray[np.float32], view: TopViewGeometry) -> NDArray[np.int32]:
    """The highest point of each cell."""
    return TopViewProjector(view, InputSpec("image", ("height",), (0.0,), (1.0,))).project(points).index


def observe(points: NDArray[np.float32], sensor: str = "hdl-64e", view: TopViewGeometry = VIEW) -> NDArray[np.bool_]:
    return Observer(view, get_sensor(sensor)).observe(points, highest(points, view)).observed


def follow(lowest: NDArray[np.float32], *rays: Any) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """The levels and states of the kernel, which are the twin's."""
    level, state = np.full(lowest.shape, 7.0, np.float32), np.ones(lowest.shape, np.uint8)
    follow_rays(lowest, *rays, level, state)
    right_level, right_state = twins.observed.rays(lowest, *rays)
    np.testing.assert_array_equal(state, right_state)
    np.testing.assert_array_equal(level, right_level)
    return level, state


def check_cells(points: NDArray[np.float32], index: NDArray[np.int32], *bins: Any) -> None:
    """Whether the kernel marks the cells that the twin does."""
    observed, between = np.ones((2, *index.shape), np.bool_)
    mark_cells(points, index, *bins, observed, between)
    np.testing.assert_array_equal([observed, between], twins.observed.cells(points, index, *bins))


def at(mask: NDArray[np.bool_], x: tuple[float, float], y: tuple[float, float]) -> NDArray[np.bool_]:
    """The cells of a mask of `VIEW` between two x and two y [m]."""
    (row, first), (last_row, last) = ((round((46.0 - x[k]) / 0.1), round((10.0 - y[k]) / 0.1)) for k in (1, 0))
    return mask[row:last_row, first:last]


@settings(max_examples=60)
@given(clouds, st.sampled_from([SMALL, AROUND, TopViewGeometry((0.0, 4.0), (-3.0, 3.0), cell_m=1.0)]))
def test_the_kernels_agree_with_their_twins(points: NDArray[np.float32], view: TopViewGeometry) -> None:
    observer = Observer(view, get_sensor("vlp-16"))
    shape = observer.lowest.shape
    lowest = np.full(shape, 7.0, np.float32)
    fill_lowest_returns(points, observer.bounds, observer.grid, lowest)
    np.testing.assert_array_equal(lowest, twins.observed.lowest_returns(points, observer.bounds, observer.grid, shape))
    for z_beams in (0.0, 0.4, -1.2):
        rays, tilt = np.array([1.0, z_beams, *observer.beams]), 0.03 * observer.ahead[1]
        level, state = follow(lowest, rays, observer.steps, tilt)
    check_cells(points, highest(points, view), observer.bin_of_cell, level, state)


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.floats(0.0, 0.3))
def test_rays_over_uneven_ground_agree_with_the_twin(seed: int, missing: float) -> None:
    rng = np.random.default_rng(seed)
    lowest = (ROAD_Z + np.cumsum(rng.normal(0.0, 0.15, (6, 80)), axis=1)).astype(np.float32)
    lowest[rng.random(lowest.shape) < 0.7 + missing] = np.inf
    follow(lowest, np.array([0.2, 0.1, -0.44, 0.02 + missing]), rng.uniform(0.0, 0.1, 90), rng.normal(0.0, 0.05, 6))


@settings(max_examples=60)
@given(st.integers(0, 2**32))
def test_cells_of_any_states_agree_with_the_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    observer, index = Observer(SMALL, get_sensor("vlp-16")), np.full((16, 12), -1, np.int32)
    state = rng.integers(0, 4, observer.state.shape).astype(np.uint8)
    level, points = np.zeros(state.shape, np.float32), np.empty((0, 4), np.float32)
    check_cells(points, index, observer.bin_of_cell, level, state)


@settings(max_examples=60)
@given(clouds)
def test_low_returns_observe_their_cells_and_order_does_not_matter(points: NDArray[np.float32]) -> None:
    observed = observe(points, view=SMALL)
    np.testing.assert_array_equal(observed, observe(np.ascontiguousarray(points[::-1]), view=SMALL))
    finite = points[np.isfinite(points).all(axis=1)]
    np.testing.assert_array_equal(observed, observe(finite, view=SMALL))
    # No return is below -2.5 m, so the ground is not, and returns up to -0.5 m are at most 2 m above it.
    index = highest(finite, SMALL)
    top = np.where(index >= 0, finite[index, 2] if len(finite) else np.inf, np.inf)
    assert observed[top <= -0.5].all()


@settings(max_examples=60)
@given(clouds, st.integers(0, 2**32))
def test_drivable_cells_are_road_and_observed(points: NDArray[np.float32], seed: int) -> None:
    labels = np.random.default_rng(seed).integers(0, 3, (16, 12)).astype(np.uint8)
    observed = observe(points, view=SMALL)
    view = TopView(labels, ("background", "drivable", "car"), 0.5, (2.0, 10.0), (-3.0, 3.0), observed)
    np.testing.assert_array_equal(view.drivable, (labels == 1) & observed)
    np.testing.assert_array_equal(view.road, labels == 1)
    assert view.drivable_area_m2 == 0.25 * np.count_nonzero(view.drivable)


def test_an_empty_scan_observes_nothing() -> None:
    assert not observe(np.empty((0, 4), np.float32)).any()
    assert not observe(np.full((5, 4), np.nan, np.float32)).any()
    assert not observe(np.zeros((1, 4), np.float32)).any()


def test_one_return_observes_its_cell() -> None:
    observed = observe(scan_of(np.array([[20.05, 1.05, -1.0]])))
    rows, cols, _ = VIEW.cells(20.05, 1.05)
    assert observed[rows, cols]
    around = np.argwhere(observed) - [rows, cols]
    assert np.abs(around).max() <= 2  # its bin is two cells long


@pytest.mark.parametrize(
    ("sensor", "gapless_m"), [("hdl-64e", 46.0), ("os1-64", 40.0), ("hdl-32e", 20.0), ("vlp-16", 19.0)]
)
def test_level_ground_is_observed_as_far_as_the_beams_are_close(sensor: str, gapless_m: float) -> None:
    observed = observe(cast(get_sensor(sensor)), sensor)
    assert at(observed, (6.5, gapless_m), (-4.0, 4.0)).all()
    step = math.tan(math.radians(2.0))
    # Beams of a VLP-16 meet the ground at 19.8 and 33.0 m. The ray to 33.0 m is 0.69 m high at 19.8 m.
    if sensor == "vlp-16":
        begins = 33.0 - (33.0 - 19.8) * CLEARANCE_M / (19.8 * step)
        assert not at(observed, (20.2, begins - 0.3), (-1.0, 1.0)).any()
        assert at(observed, (begins + 0.4, 32.8), (-1.0, 1.0)).all()
        assert not at(observed, (33.4, 46.0), (-1.0, 1.0)).any()


def test_ground_behind_an_object_is_not_observed() -> None:
    car = (20.0, 24.0, -1.0, 1.0, 1.5)
    observed = observe(cast(get_sensor("hdl-64e"), car))
    assert at(observed, (6.0, 19.8), (-1.0, 1.0)).all()
    assert not at(observed, (25.0, 46.0), (-0.8, 0.8)).any()
    assert at(observed, (6.0, 46.0), (3.0, 6.0)).all()
    # Behind a box of 0.6 m the ray at 40 m passes 0.87 m above the ground at 20 m.
    low = observe(cast(get_sensor("hdl-64e"), (20.0, 20.5, -1.0, 1.0, 0.6)))
    assert not at(low, (21.5, 24.0), (-0.8, 0.8)).any()
    assert at(low, (36.0, 45.0), (-0.8, 0.8)).all()


def test_whatever_is_higher_than_the_clearance_is_never_overlooked() -> None:
    """An object in a gap between returns leaves the cells behind it unobserved, wherever it stands."""
    for sensor in ("hdl-64e", "vlp-16"):
        profile = get_sensor(sensor)
        level = observe(cast(profile), sensor)
        for x in np.arange(8.0, 40.0, 1.3):
            cell = at(level, (x, x + 0.1), (-0.05, 0.05))
            returns = cast(profile, (x, x + 0.3, -0.5, 0.5, CLEARANCE_M + 0.15))
            stopped = (np.abs(returns[:, 2] - ROAD_Z) > 1e-4).any()
            assert stopped or not cell.all(), f"{sensor} overlooks an object at {x:.1f} m"


def test_a_gap_without_returns_is_not_observed_even_between_level_returns() -> None:
    scan = cast(get_sensor("hdl-64e"))
    hole = (scan[:, 0] > 15.0) & (scan[:, 0] < 22.0)
    observed = observe(np.ascontiguousarray(scan[~hole]))
    assert not at(observed, (15.5, 21.5), (-2.0, 2.0)).any()
    assert at(observed, (24.5, 40.0), (-2.0, 2.0)).all()
    # One beam without returns makes no gap.
    ring = np.unique(np.hypot(scan[:, 0], scan[:, 1]).round(2))
    missing = np.abs(np.hypot(scan[:, 0], scan[:, 1]) - ring[ring > 20.0][0]) < 0.02
    assert at(observe(np.ascontiguousarray(scan[~missing])), (6.0, 44.0), (-2.0, 2.0)).all()


def test_a_pit_is_not_bridged() -> None:
    scan = cast(get_sensor("hdl-64e"))
    pit = (scan[:, 0] > 16.0) & (scan[:, 0] < 19.0)
    scan[pit, 2] -= 1.0
    observed = observe(scan)
    far = scan[pit & (np.abs(scan[:, 1]) < 0.1), 0].max()
    rows = at(observed, (far + 0.3, 46.0), (-0.5, 0.5))
    assert rows[:-10].all()
    between = np.unique(np.round(scan[pit & (np.abs(scan[:, 1]) < 0.1), 0], 1))
    middle = (between[0] + between[1]) / 2.0 if len(between) > 1 else 17.0
    assert not at(observed, (middle - 0.05, middle + 0.05), (-0.3, 0.3)).any()


def test_a_slope_is_followed() -> None:
    for gradient in (-0.06, 0.06):
        scan = cast(get_sensor("os1-64"))
        # The rays that meet z = -1.73 at x meet z = -1.73 + gradient x nearer, or farther.
        scale = np.float32(1.0) / (1.0 + gradient * np.hypot(scan[:, 0], scan[:, 1]) / -ROAD_Z)
        kept = (scale > 0.0) & (scale < 3.0)
        sloping = scan[kept] * np.column_stack([scale, scale, scale, np.ones_like(scale)])[kept]
        assert sloping[:, 2].max() - sloping[:, 2].min() > 1.0
        assert at(observe(sloping.astype(np.float32), "os1-64"), (6.5, 20.0), (-2.0, 2.0)).all()


def test_a_ceiling_does_not_observe_the_floor() -> None:
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(20.0, 30.0, 0.1), np.arange(-4.0, 4.0, 0.1)))
    assert not observe(scan_of(np.column_stack([x, y, np.full(x.size, 1.5)]))).any()
    floor = scan_of(np.column_stack([x, y, np.full(x.size, ROAD_Z)]))
    both = np.concatenate([floor, scan_of(np.column_stack([x, y, np.full(x.size, 1.5)]))])
    assert at(observe(both), (20.5, 29.5), (-3.5, 3.5)).all()


def test_walls_without_a_floor_observe_nothing_else() -> None:
    """The rays to the foot of a wall pass closely over what could be a floor, but no return shows it."""
    x, z = (grid.ravel() for grid in np.meshgrid(np.arange(-5.0, 20.0, 0.05), np.arange(-1.7, 2.0, 0.05)))
    y, front = (grid.ravel() for grid in np.meshgrid(np.arange(-8.0, 8.0, 0.05), np.arange(-1.7, 2.0, 0.05)))
    walls = [np.column_stack([x, np.full(x.size, side), z]) for side in (-8.0, 8.0)]
    observed = observe(scan_of(np.concatenate([*walls, np.column_stack([np.full(y.size, 20.0), y, front])])))
    assert not at(observed, (6.0, 19.5), (-7.5, 7.5)).any()
    assert not at(observed, (20.5, 46.0), (-9.9, 9.9)).any()


def test_the_height_of_the_beams_counts() -> None:
    """From higher up rays are steeper: the same returns leave larger gaps."""
    index = np.full((VIEW.height, VIEW.width), -1, np.int32)
    profile = get_sensor("vlp-16")
    shares = []
    for height_m in (1.2, 1.73, 2.4):
        points = cast(profile, height_m=height_m)
        observed = Observer(VIEW, profile).observe(points, index, replace(MODEL_MOUNTING, height_m=height_m)).observed
        first_m = height_m / math.tan(math.radians(15.0))
        assert at(observed, (max(6.0, first_m + 0.3), 12.0), (-2.0, 2.0)).all()
        shares.append(observed[:, 90:110].mean())
    assert shares[2] > shares[0]
    # Points about an origin on the ground are no reason to observe more.
    points = cast(profile)
    observer = Observer(VIEW, profile)
    on_ground = replace(MODEL_MOUNTING, height_m=0.0)
    np.testing.assert_array_equal(observer.observe(points, index, on_ground), observer.observe(points, index))


def test_adding_returns_never_hides_what_has_returns() -> None:
    """A new return may connect others differently, but every low return keeps its own cell."""
    rng = np.random.default_rng(3)
    scan = cast(get_sensor("vlp-16"))
    more = scan_of(rng.uniform([6.0, -8.0, -1.8], [40.0, 8.0, 0.0], (300, 3)))
    both = np.concatenate([scan, more])
    rows, cols, inside = VIEW.cells(both[:, 0], both[:, 1])
    assert observe(both, "vlp-16")[rows[inside], cols[inside]].all()


def test_simulated_road_near_returns_is_kept() -> None:
    for seed in range(3):
        scan = simulated_scan(FIRST_SEED + seed)
        points = np.ascontiguousarray(scan.points, np.float32)
        observed = observe(points)
        road = scan.top_view_labels(VIEW) == 1
        rows, cols, inside = VIEW.cells(points[:, 0], points[:, 1])
        own = np.zeros_like(road)
        own[rows[inside], cols[inside]] = True
        assert observed[road & own].mean() > 0.999
        assert 0.5 < observed[road].mean() < 1.0


def test_arrays_of_a_wrong_shape_are_refused() -> None:
    observer = Observer(SMALL, get_sensor("hdl-64e"))
    points, index = np.zeros((3, 4), np.float32), np.full((16, 12), -1, np.int32)
    for wrong in (points[:, :3], points.astype(np.float64), points[0]):
        with pytest.raises(PointsError, match="expected \\(n, 4\\) float32"):
            observer.observe(wrong, index)
    for wrong_index in (index[1:], index.astype(np.int64)):
        with pytest.raises(PointsError, match="expected \\(16, 12\\) int32"):
            observer.observe(points, wrong_index)


def test_large_views_have_bounded_tables() -> None:
    far = TopViewGeometry((9000.0, 9040.0), (-10.0, 10.0), cell_m=0.1)
    assert Observer(far, get_sensor("hdl-64e")).lowest.size < 100_000
    wide = TopViewGeometry((-1000.0, 1000.0), (-1000.0, 1000.0), cell_m=5.0)
    assert Observer(wide, get_sensor("hdl-64e")).lowest.size < 600 * 4200
    no_ground = SensorProfile("up", (5.0, 3.0), 1800)
    index = np.full((16, 12), -1, np.int32)
    assert not np.any(Observer(SMALL, no_ground).observe(np.empty((0, 4), np.float32), index))


def test_an_unobserved_cell_is_not_free() -> None:
    observed = np.ones((400, 200), np.bool_)
    observed[:200] = False  # from 26 m on
    view = TopView(np.ones((400, 200), np.uint8), ("background", "drivable"), 0.1, (6.0, 46.0), (-10.0, 10.0), observed)
    road = road_ahead(view)
    np.testing.assert_allclose(road.free_m, 26.0)
    assert view.drivable_area_m2 == pytest.approx(400.0)
    assert road.outline[:, 0].max() == pytest.approx(26.0)
    assert np.isnan(road.left_m[201:]).all()
    assert road_ahead(view, [Box("car", 0.9, (20.0, 0.0, -1.0), (4.0, 2.0, 1.5), 0.0)]).free_ahead_m() < 18.2


def test_an_empty_scan_has_no_road() -> None:
    for model in ("ssadnet", "lodnn"):
        found = Perceiver(model, provider="cpu")(np.empty((0, 4), np.float32))
        assert not found.require_top_view().observed.any()
        assert found.require_top_view().drivable_area_m2 == found.to_dict()["drivable_area_m2"] == 0.0
        assert len(road_ahead(found.require_top_view()).outline) == 0


def top_view(points: NDArray[np.float32], sensor: str, mounting: Mounting = MODEL_MOUNTING) -> TopView:
    """The view of a network that takes everything for road."""
    observed, between_beams = Observer(VIEW, get_sensor(sensor)).observe(points, highest(points, VIEW), mounting)
    return TopView(
        np.ones((400, 200), np.uint8),
        ("background", "drivable"),
        0.1,
        VIEW.x_range_m,
        VIEW.y_range_m,
        observed,
        between_beams=between_beams,
    )


def last_ring_m(sensor: str, height_m: float = -ROAD_Z) -> float:
    """Where the last beam meets the ground in view [m], or the end of the view if a beam does beyond it."""
    rings = [height_m / math.tan(math.radians(-e)) for e in get_sensor(sensor).elevations_deg if e < 0.0]
    return 46.0 if any(46.0 < ring < 60.0 for ring in rings) else max(ring for ring in rings if ring < 46.0)


@pytest.mark.parametrize("sensor", ["vlp-16", "vlp-32c", "hdl-32e", "os1-64", "hdl-64e"])
def test_an_empty_road_is_free_as_far_as_rings_remain(sensor: str) -> None:
    view = top_view(cast(get_sensor(sensor)), sensor)
    ahead = free_ahead(view)
    last = {"vlp-16": 33.0, "hdl-32e": 37.1}.get(sensor, 46.0)
    assert last_ring_m(sensor) == pytest.approx(last, abs=0.1)
    assert ahead.free_m == pytest.approx(last, abs=0.3)
    assert ahead.end == ("end of view" if last == 46.0 else "unknown")
    assert not (view.between_beams & view.observed).any()
    # Without the beams, the observed cells alone count, as in a view that comes from elsewhere.
    assert free_ahead(replace(view, between_beams=None)).free_m <= ahead.free_m


@pytest.mark.parametrize("sensor", ["vlp-16", "vlp-32c", "hdl-32e", "os1-64", "hdl-64e"])
@pytest.mark.parametrize("x_m", [12.0, 20.0, 30.0])
def test_a_box_ends_the_free_distance_before_its_shadow(sensor: str, x_m: float) -> None:
    view = top_view(cast(get_sensor(sensor), (x_m, x_m + 4.0, -0.9, 0.9, 1.5)), sensor)
    ahead = free_ahead(view, [Box("car", 0.9, (x_m + 2.0, 0.0, -1.0), (4.0, 1.8, 1.5), 0.0)])
    assert ahead.end == "obstacle"
    assert ahead.free_m == ahead.obstacle_m == pytest.approx(x_m, abs=0.11)
    assert ahead.obstacle_m <= ahead.unknown_m < x_m + 4.0
    # What no network finds ends it, too: nothing is seen behind it.
    unnoticed = free_ahead(view)
    assert unnoticed.end == "unknown"
    assert unnoticed.free_m < x_m + 0.5


@pytest.mark.parametrize("sensor", ["vlp-16", "vlp-32c", "hdl-32e", "os1-64", "hdl-64e"])
def test_a_kerb_and_a_hedge_are_the_edge_of_the_road(sensor: str) -> None:
    for tall in (0.12, 1.0):
        view = top_view(cast(get_sensor(sensor), (18.0, 22.0, -9.0, 9.0, tall)), sensor)
        view.labels[240:280] = 0
        ahead = free_ahead(view)
        assert ahead.end == "edge of the road"
        assert ahead.free_m == ahead.edge_m == pytest.approx(18.0, abs=0.11)
        assert ahead.obstacle_m == math.inf


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-32e", "os1-64", "hdl-64e"])
def test_a_missing_sector_is_unknown(sensor: str) -> None:
    scan = cast(get_sensor(sensor))
    azimuth = np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))
    ahead = free_ahead(top_view(np.ascontiguousarray(scan[np.abs(azimuth - 1.0) > 1.5]), sensor))
    assert (ahead.free_m, ahead.end) == (6.0, "unknown")
    distance = np.hypot(scan[:, 0], scan[:, 1])
    # From here to there no beam returns: several rings, more than one beam explains.
    first, end = (12.0, 25.0) if sensor == "vlp-16" else (12.0, 22.0)
    hole = (np.abs(azimuth) < 4.0) & (distance > first) & (distance < end)
    ahead = free_ahead(top_view(np.ascontiguousarray(scan[~hole]), sensor))
    assert ahead.end == "unknown"
    assert ahead.free_m < end - 1.0


def test_one_missing_return_is_not_a_gap_but_two_sectors_are() -> None:
    scan = cast(get_sensor("hdl-64e"))
    sector, distance = np.arctan2(scan[:, 1], scan[:, 0]), np.hypot(scan[:, 0], scan[:, 1])
    missing = (distance > 9.0) & (distance < 11.5)
    for width_deg, end in ((0.35, "end of view"), (2.0, "unknown")):
        kept = ~(missing & (np.abs(sector) < math.radians(width_deg) / 2.0))
        assert free_ahead(top_view(np.ascontiguousarray(scan[kept]), "hdl-64e")).end == end


@pytest.mark.parametrize("sensor", ["vlp-16", "vlp-32c", "hdl-32e", "os1-64"])
@pytest.mark.parametrize("height_m", [1.2, 2.2])
def test_no_bridge_leads_over_anything_higher_than_its_rays(sensor: str, height_m: float) -> None:
    mounting = replace(MODEL_MOUNTING, height_m=height_m)
    for x in np.arange(6.5, 45.0, 2.3):
        scan = cast(get_sensor(sensor), (x, x + 0.4, -1.2, 1.2, BRIDGE_M + 0.05), height_m=height_m)
        view = top_view(scan, sensor, mounting)
        row, col, inside = VIEW.cells(scan[:, 0], scan[:, 1])
        touched = inside & (scan[:, 2] > ROAD_Z + 0.1)
        view.labels[row[touched], col[touched]] = 0
        ahead = free_ahead(view, half_width_m=0.5)
        assert ahead.free_m <= x + 0.5, f"{sensor} at {height_m} m: free through a block at {x:.1f} m"


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(-2.0, 0.0), (3.0, 0.0), (0.66, 4.0)])
def test_a_tilted_sensor_is_read_with_its_tilt(pitch_deg: float, roll_deg: float) -> None:
    mounting = Mounting(1.73, roll_deg, pitch_deg, 0.0)
    frame, profile = ModelFrame(mounting), get_sensor("vlp-32c")
    azimuth = np.deg2rad(np.arange(-90.0, 90.0, 0.2))
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(azimuth, np.deg2rad(profile.elevations_deg)))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    rays = rays @ frame.R.T
    rays = rays[rays[:, 2] < -0.01]
    scan = scan_of(rays * (ROAD_Z / rays[:, 2:]))
    assert free_ahead(top_view(scan, "vlp-32c", mounting)).free_m > 40.0


@settings(max_examples=60)
@given(clouds, st.integers(0, 2**32))
def test_the_free_distance_is_the_least_of_the_distances_to_its_ends(points: NDArray[np.float32], seed: int) -> None:
    seen = Observer(SMALL, get_sensor("vlp-16")).observe(points, highest(points, SMALL))
    labels = np.random.default_rng(seed).integers(0, 3, (16, 12)).astype(np.uint8)
    view = TopView(
        labels, ("background", "drivable", "car"), 0.5, (2.0, 10.0), (-3.0, 3.0), seen[0], between_beams=seen[1]
    )
    road = road_ahead(view)
    np.testing.assert_array_equal(
        road.free_m, np.minimum(np.minimum(road.obstacle_m, road.unknown_m), np.minimum(road.edge_m, 10.0))
    )
    assert road.free_ahead(0.6) == free_ahead(view, half_width_m=0.6)
    assert road.free_ahead_m(0.6) == road.free_ahead(0.6).free_m
    for k, end in enumerate(road.free_end):
        named = {"edge of the road": road.edge_m, "unknown": road.unknown_m}.get(end)
        assert named is None or named[k] == road.free_m[k]
        assert end != "obstacle" or road.obstacle_m[k] <= road.free_m[k] + 1.5
        assert end != "end of view" or road.free_m[k] == 10.0
