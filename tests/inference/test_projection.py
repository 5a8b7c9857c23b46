from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import tiny_model
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.projection
from edgeperc import Mounting, Perceiver
from edgeperc.errors import CardError, PointsError
from edgeperc.ground.planes import find_ground
from edgeperc.inference import projection
from edgeperc.inference.projection import Projection, column_edges, make_projector, row_edges, tabulate
from edgeperc.types.card import CHANNELS, InputSpec
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry
from edgeperc_bench.peers.projection import contenders

GRAPH = tiny_model.graph(tiny_model.CONVOLUTION, tiny_model.INITIALIZER)
UNEVEN = (2.0, 1.7, 1.3, 0.2, -0.1, -4.0, -4.4, -11.0, -24.8)
HDL_64E = tuple(2.0 - k / 3.0 for k in range(32)) + tuple(-8.83 - k / 2.0 for k in range(32))
# More pixels than 16 bits count; interpreted, so many take half of the time of all projections.
TURN = 256 if numba.config.DISABLE_JIT else 2048

VIEWS = {
    "top view": TopViewGeometry(),
    "coarse top view": TopViewGeometry((-3.0, 4.0), (-2.0, 5.0), (-1.0, 1.0), 0.7),
    "front": RangeImageGeometry(HDL_64E),
    "front, uneven": RangeImageGeometry(UNEVEN, 40),
    "full turn": RangeImageGeometry(HDL_64E, TURN, 180.0, -180.0),
    "full turn, uneven": RangeImageGeometry(UNEVEN, 36, 180.0, -180.0),
    "left half": RangeImageGeometry((80.0, 20.0, -20.0, -80.0), 7, 180.0, 0.0),
    "right rear": RangeImageGeometry((5.0, -5.0), 1, -95.0, -180.0),
    "all but the rear": RangeImageGeometry((30.0, 0.0, -30.0), 11, 170.0, -100.0),
    "front of a vlp-32c": RangeImageGeometry(get_sensor("vlp-32c").elevations_deg, 256),
}
SMALL = [name for name, view in VIEWS.items() if view.height * view.width < 2000]


def spec_of(view: Any, order: int = 1) -> InputSpec:
    names = CHANNELS[view.kind][::order]
    return InputSpec(
        "input", names, tuple(0.5 * k for k in range(len(names))), tuple(1.0 + k for k in range(len(names)))
    )


def random_points(rng: np.random.Generator, n: int) -> np.ndarray:
    """Points in every direction, near and far, on and off the grid, some not finite, some twice."""
    points = rng.normal(0.0, 1.0, (n, 4)) * 10.0 ** rng.uniform(-1.0, 1.7, (n, 1)) * (1.0, 1.0, 0.2, 1.0)
    points[: n // 4] = np.round(points[: n // 4], 1)
    bad = rng.integers(0, n, n // 20)
    points[bad, rng.integers(0, 4, n // 20)] = rng.choice([math.nan, math.inf, -math.inf, 1e30], n // 20)
    points[n // 2 :: 7] = points[n // 3 :: 7][: len(points[n // 2 :: 7])]
    return points.astype(np.float32)


def edges_of(name: str) -> tuple[np.ndarray, np.ndarray]:
    return row_edges(VIEWS[name]), column_edges(VIEWS[name])


def assert_same(got: Any, expected: Any) -> None:
    for name, expected_array in zip(("image", "index", "pixel"), expected, strict=True):
        np.testing.assert_array_equal(getattr(got, name), expected_array, err_msg=name)


def heights_of(points: np.ndarray) -> np.ndarray:
    """Heights above an uneven ground, some beyond the limits, some not finite."""
    rng = np.random.default_rng(len(points))
    height_m = (points[:, 2] + rng.normal(1.7, 0.1, len(points))).astype(np.float32)
    height_m[::11] = rng.choice([math.nan, math.inf, -math.inf, 4.9999, 5.0001, -1.0], len(height_m[::11]))
    return height_m


def check(points: np.ndarray, view: Any, spec: InputSpec | None = None) -> Projection:
    """The projection, which agrees with the slow one to the last bit."""
    spec = spec or spec_of(view)
    projector = make_projector(view, spec)
    # Leftovers must not shine through.
    projector.project(np.full((3, 4), 7.0, np.float32), np.full(3, 7.0, np.float32))
    with np.errstate(all="ignore"):
        height_m = heights_of(points)
    found = projector.project(points, height_m)
    edges = (row_edges(view), column_edges(view)) if view.kind == "range_image" else ()
    assert_same(found, twins.projection.project(points, view, edges, spec, height_m))
    return found


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("n", [1, 255, 256, 257, 3000])
def test_random_points(name: str, n: int) -> None:
    rng = np.random.default_rng(n)
    seen = check(random_points(rng, n), VIEWS[name], spec_of(VIEWS[name], (-1) ** n))
    assert n < 3000 or (seen.index >= 0).any()


@pytest.mark.parametrize("name", VIEWS)
def test_no_points(name: str) -> None:
    seen = check(np.empty((0, 4), np.float32), VIEWS[name])
    assert (seen.index == -1).all()
    assert (seen.image == 0.0).all()


numbers = st.one_of(
    st.floats(width=32),
    st.floats(-12.0, 12.0, width=32),
    st.sampled_from([0.0, -0.0, 1.0, -1.0, 4.0, 5.0, 0.7, -3.0, -2.0, 1e-30, -1e-30, 1e25, math.inf, math.nan]),
)


@settings(max_examples=60)
@given(st.lists(st.tuples(numbers, numbers, numbers, numbers), max_size=12), st.sampled_from(SMALL))
def test_any_numbers(rows: list[tuple[float, float, float, float]], name: str) -> None:
    check(np.array(rows, np.float32).reshape(-1, 4), VIEWS[name])


@pytest.mark.parametrize("name", [name for name, view in VIEWS.items() if view.kind == "range_image"])
def test_pixels_are_those_of_true_angles(name: str) -> None:
    view = VIEWS[name]
    points = random_points(np.random.default_rng(5), 20000)
    seen = make_projector(view, spec_of(view)).project(points, heights_of(points))
    with np.errstate(all="ignore"):
        x, y, z, _ = points.astype(np.float64).T
        azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    beams = np.array(view.row_elevations_deg)
    middles = (beams[1:] + beams[:-1]) / 2.0
    edges = np.array([2.0 * beams[0] - middles[0], *middles, 2.0 * beams[-1] - middles[-1]])
    left, right = view.azimuth_left_deg, view.azimuth_right_deg
    col = (left - azimuth) / (left - right) * view.width
    row = (elevation[:, None] <= edges).sum(axis=1) - 1
    sure = np.isfinite(points).all(axis=1) & (np.abs(points) < 1e9).all(axis=1) & (np.hypot(x, y) > 0.0)
    sure &= (np.abs(elevation[:, None] - edges) > 1e-4).all(axis=1) & (np.abs(col - np.round(col)) > 1e-4)
    inside = sure & (col > 0) & (col < view.width) & (row >= 0) & (row < view.height)
    expected = np.where(inside, row * view.width + np.floor(np.where(inside, col, 0)), -1)
    np.testing.assert_array_equal(seen.pixel[sure], expected[sure])
    assert sure.mean() > 0.85
    assert inside.sum() > 200


def test_point_lands_in_the_pixel_of_the_equations() -> None:
    point = np.float32([[10.0, 0.0, -1.0, 0.25]])
    above = check(point, VIEWS["top view"], InputSpec("input", ("distance", "remission", "height"), (0,) * 3, (1,) * 3))
    assert above.pixel[0] == 359 * 200 + 99  # (46 - 10) / 0.1 cells from the far edge; half-way across, on the edge
    np.testing.assert_array_equal(above.image[:, 359, 99], np.float32([10.0, 0.25, -1.0]))
    # atan(-1 / 10) is -5.71 degrees: HDL_64E has beams at -5.667 (row 23) and -6 (row 24).
    ahead = check(point, VIEWS["front"], InputSpec("input", ("x", "y", "z", "remission", "range"), (0,) * 5, (1,) * 5))
    assert ahead.pixel[0] == 23 * 512 + 256
    np.testing.assert_allclose(ahead.image[:, 23, 256], [10.0, 0.0, -1.0, 0.25, math.sqrt(101.0)], rtol=1e-6)
    assert np.count_nonzero(ahead.image) == 4


@pytest.mark.parametrize("channels", [("height",), ("remission", "distance"), ("height", "distance", "remission")])
def test_channels_are_normalized_in_the_order_asked_for(channels: tuple[str, ...]) -> None:
    mean, std = (10.0, 0.5, -1.0)[: len(channels)], (2.0, 0.25, 4.0)[: len(channels)]
    points = np.float32([[3.0, 4.0, 1.0, 0.5], [1.0, 1.0, 0.5, 1.5]])
    seen = check(points, VIEWS["coarse top view"], InputSpec("input", channels, mean, std))
    raw = {"distance": 5.0, "remission": 0.5, "height": 1.0}
    expected = [(raw[name] - m) / s for name, m, s in zip(channels, mean, std, strict=True)]
    np.testing.assert_allclose(seen.image.reshape(len(channels), -1)[:, seen.pixel[0]], expected, rtol=1e-6)
    assert seen.pixel[0] >= 0
    assert (seen.image[:, seen.index < 0] == 0.0).all()


@pytest.mark.parametrize("name", [name for name, view in VIEWS.items() if view.kind == "range_image"])
def test_tables_find_the_interval_of_every_value(name: str) -> None:
    for edges in (row_edges(VIEWS[name]), column_edges(VIEWS[name])):
        first, last, cells_per_unit, base, split = tabulate(edges, "edges")
        rng = np.random.default_rng(2)
        values = np.concatenate(
            [edges, np.nextafter(edges, np.float32(9)), np.nextafter(edges, np.float32(-9)),
             rng.uniform(edges[-1], edges[0], 5000).astype(np.float32)]
        )  # fmt: skip
        values = values[(values <= first) & (values > max(last, edges[-1] - 1e-6))]
        cells = ((first - values) * cells_per_unit).astype(np.int32)
        found = base[cells] + (values <= split[cells])
        np.testing.assert_array_equal(found, (values[:, None] <= edges[1:-1]).sum(axis=1))


def test_edges_of_the_top_view() -> None:
    points = np.float32([
        [6.0, -10.0, -2.5, 0.0], [46.0, 0.0, 0.0, 0.0], [6.0, 10.0, 0.0, 0.0],
        [np.nextafter(np.float32(46), np.float32(0)), np.nextafter(np.float32(10), np.float32(0)), 2.5, 0.0],
        [np.nextafter(np.float32(6), np.float32(0)), 0.0, 0.0, 0.0], [26.0, 0.0, 0.0, 0.0],
        [26.0, 0.0, np.nextafter(np.float32(2.5), np.float32(9)), 0.0],
    ])  # fmt: skip
    assert check(points, VIEWS["top view"]).pixel.tolist() == [399 * 200 + 199, -1, -1, 0, -1, 199 * 200 + 99, -1]


def test_edges_of_the_range_image() -> None:
    view = RangeImageGeometry((45.0, 0.0, -45.0), 2)  # edges at 67.5, 22.5, -22.5, -67.5 degrees
    points = np.float32([[5, 5, 0, 0], [5, -5, 0, 0], [5, 0, 0, 0], [5, -0.001, 0, 0], [5, 0, 5, 0], [-5, 0, 0, 0]])
    assert check(points, view).pixel.tolist() == [2, -1, 3, 3, 1, -1]


def test_straight_behind_is_in_a_full_turn() -> None:
    points = np.float32([[-5, 0.0, 0, 0], [-5, -0.0, 0, 0], [-5, -1e-20, 0, 0], [-5, 1e-20, 0, 0]])
    view = VIEWS["full turn, uneven"]
    assert (check(points, view).pixel % view.width).tolist() == [0, 0, view.width - 1, 0]


def test_axis_and_origin_are_out_of_view() -> None:
    # The squares of 1e-30 are 0 in float32.
    points = np.float32([[0, 0, 0, 0], [-0.0, 0, 0, 0.5], [0, 0, 1, 0], [0, 0, -1, 0], [1e-30, 1e-30, 1, 0]])
    points = np.concatenate([points, points * np.float32([-1, 1, 1, 1])])
    for name, view in VIEWS.items():
        if view.kind == "range_image":
            assert (check(points, view).pixel == -1).all(), name


def test_points_not_finite_are_out_of_view() -> None:
    bad = [(column, value) for column in range(4) for value in (math.nan, math.inf, -math.inf)]
    points = np.float32([[10.0, 1.0, -1.0, 0.5]] * (len(bad) + 1))
    for row, (column, value) in enumerate(bad):
        points[row, column] = value
    for view in VIEWS.values():
        seen = check(points, view)
        assert (seen.pixel[:-1] == -1).all()
        assert {*np.unique(seen.index)} <= {-1, len(bad)}


def test_the_best_point_wins_and_the_earlier_of_two() -> None:
    points = np.full((1000, 4), (10.02, 0.03, 0.0, 0.5), np.float32)
    for view in (VIEWS["top view"], VIEWS["front"]):
        seen = check(points, view)
        assert len(set(seen.pixel.tolist())) == 1
        assert seen.index.max() == 0
    points[:, 2] = np.where(np.arange(1000) % 2, 0.0, -0.0)
    assert check(points, VIEWS["top view"]).index.max() == 0
    points[[600, 700], 2] = 1.0
    assert check(points, VIEWS["top view"]).index.max() == 600
    points[:, 2] = 0.0
    points[[300, 800], 0] = 10.01
    assert check(points, VIEWS["front"]).index.max() == 300


def test_points_may_be_read_only() -> None:
    points = random_points(np.random.default_rng(0), 500)
    before = points.copy()
    points.flags.writeable = False
    for view in VIEWS.values():
        check(points, view)
    np.testing.assert_array_equal(points, before)


def test_every_pixel_leads_back_to_its_point() -> None:
    points = random_points(np.random.default_rng(1), 5000)
    for view in VIEWS.values():
        seen = make_projector(view, spec_of(view)).project(points, heights_of(points))
        flat = np.flatnonzero(seen.index >= 0)
        np.testing.assert_array_equal(seen.pixel[seen.index.reshape(-1)[flat]], flat)
        np.testing.assert_array_equal(np.unique(seen.pixel[seen.pixel >= 0]), flat)


def test_error_of_the_papers_azimuth() -> None:
    paper_deg = math.degrees(math.asin(math.sin(math.radians(45.0)) * math.cos(math.radians(-24.8))))
    assert paper_deg == pytest.approx(39.9, abs=0.05)
    assert round((45.0 - paper_deg) / 90.0 * 512) == 29


def test_wrong_arrays_are_refused() -> None:
    view = VIEWS["coarse top view"]
    projector = make_projector(view, spec_of(view))
    good = np.zeros((5, 4), np.float32)
    for bad, message in (
        (good.astype(np.float64), "float64"),
        (good[:, :3], r"\(5, 3\)"),
        (good[::2], "C-contiguous: False"),
        (good.reshape(-1), r"\(20,\)"),
        (good.astype(">f4"), ">f4|float32"),
        (np.asfortranarray(good), "C-contiguous: False"),
        ([[1.0, 2.0, 3.0, 4.0]], "list"),
    ):
        with pytest.raises(PointsError, match=message):
            projector.project(bad)
    seen = projector.project(good)
    locked = seen.pixel.copy()
    locked.flags.writeable = False
    buffers = {"image": seen.image, "index": seen.index, "pixel": seen.pixel}
    for name, bad in (
        ("image", seen.image[:1]),
        ("image", seen.image.astype(np.float64)),
        ("index", seen.index.astype(np.int64)),
        ("index", seen.index.T.copy().T),
        ("pixel", seen.pixel[:2]),
        ("pixel", locked),
    ):
        with pytest.raises(PointsError, match=f"^{name} buffer"):
            projector.fill(good, **(buffers | {name: bad}))


def test_heights_above_the_ground_are_clipped_and_normalized() -> None:
    spec = InputSpec("input", ("height_above_ground", "z"), (1.0, 0.0), (2.0, 1.0))
    points = np.zeros((7, 4), np.float32)
    points[:, 0], points[:, 1] = 10.0, np.linspace(-9.0, 9.0, 7)  # seven columns of one row
    height_m = np.float32([0.0, 3.0, -1.0, -2.0, 5.0, 80.0, math.nan])
    projector = make_projector(VIEWS["front"], spec)
    assert projector.needs_ground
    assert not make_projector(VIEWS["top view"], spec_of(VIEWS["top view"])).needs_ground
    seen = projector.project(points, height_m)
    got = seen.image[0].reshape(-1)[seen.pixel]
    np.testing.assert_array_equal(got, [-0.5, 1.0, -1.0, -1.0, 2.0, 2.0, -1.0])
    assert not seen.image[:, seen.index < 0].any()


def test_curvature_is_the_root_of_the_bend_between_neighbors() -> None:
    """A wall is straight, leaves are not; ends of rows and neighbors of gaps have none."""
    view = RangeImageGeometry((0.0, -1.0), 8, 4.0, -4.0)
    spec = InputSpec("input", ("range", "curvature"), (0.0, 0.5), (1.0, 2.0))
    ranges = np.float32([10.0, 11.0, 12.0, 12.09, 12.18, 50.0, math.nan, 20.0])
    azimuth = np.deg2rad(3.5 - np.arange(8))
    points = np.float32([ranges * np.cos(azimuth), ranges * np.sin(azimuth), 0.0 * ranges, 0.0 * ranges]).T.copy()
    seen = make_projector(view, spec).project(points)
    np.testing.assert_allclose(seen.image[0, 0], np.nan_to_num(ranges), rtol=1e-6)
    bends = [0.0, 0.0, 0.91, 0.0, 1.0, 0.0, math.nan, 0.0]
    np.testing.assert_allclose(seen.image[1, 0], np.nan_to_num((np.sqrt(bends) - 0.5) / 2.0), atol=2e-3)


@pytest.mark.parametrize(("noise_m", "bend_m"), [(0.0, 0.0), (0.01, 0.016), (0.02, 0.028), (0.1, 0.0)])
def test_noise_of_the_ranges_is_no_curvature(noise_m: float, bend_m: float) -> None:
    """Beyond a median of 4 cm on the ground, the rest is taken off: little of a rough ground then bends."""
    view = RangeImageGeometry(tuple(np.linspace(-5.0, -20.0, 41).tolist()), 20, 20.0, -20.0)
    spec = InputSpec("input", ("height_above_ground", "curvature"), (0.0, 0.0), (1.0, 1.0))
    azimuth, elevation = np.radians(np.meshgrid(np.arange(20) + 0.5 - 10.0, -5.19 - 0.375 * np.arange(40)))
    azimuth, elevation = (angle.ravel() for angle in (2.0 * azimuth, elevation))
    noise = noise_m * np.random.default_rng(0).standard_normal(azimuth.shape)
    ranges = 2.0 / -np.sin(elevation) + noise
    ahead = ranges * np.cos(elevation)
    points = np.float32([ahead * np.cos(azimuth), ahead * np.sin(azimuth), ranges * np.sin(elevation), noise]).T.copy()
    height_m = np.zeros(len(points), np.float32)
    seen = make_projector(view, spec).project(points, height_m)
    edges = row_edges(view), column_edges(view)
    assert_same(seen, twins.projection.project(points, view, edges, spec, height_m))
    assert np.count_nonzero(seen.index >= 0) > 700
    assert np.median(seen.image[1][seen.index >= 0] ** 2) == pytest.approx(bend_m, abs=0.004)


def test_missing_or_wrong_heights_are_refused() -> None:
    projector = make_projector(VIEWS["front"], spec_of(VIEWS["front"]))
    points = np.ones((5, 4), np.float32)
    with pytest.raises(PointsError, match=r"height_m is missing.*find_ground"):
        projector.project(points)
    for bad in (np.zeros(4, np.float32), np.zeros(5), np.zeros((5, 1), np.float32)):
        with pytest.raises(PointsError, match=r"height_m is \(.*for 5 points; expected \(5,\) float32"):
            projector.project(points, bad)
    strided = np.zeros(10, np.float32)[::2]
    strided.flags.writeable = False
    assert (projector.project(points, strided).pixel >= -1).all()


def test_five_channels_do_not_depend_on_heights() -> None:
    points = random_points(np.random.default_rng(4), 3000)
    names = CHANNELS["range_image"][:5]
    without = make_projector(VIEWS["front"], InputSpec("input", names, (0.5,) * 5, (2.0,) * 5)).project(points)
    six = InputSpec("input", CHANNELS["range_image"][:6], (0.5,) * 6, (2.0,) * 6)
    seen = make_projector(VIEWS["front"], six).project(points, heights_of(points))
    np.testing.assert_array_equal(seen.image[:5], without.image)


@pytest.mark.parametrize("n", [0, 1, 4000])
def test_a_scan_is_projected_with_its_ground(n: int) -> None:
    rng = np.random.default_rng(n)
    points = np.zeros((n, 4), np.float32)
    points[:, :2] = rng.uniform(-30.0, 30.0, (n, 2))
    points[:, 2] = 0.05 * points[:, 0] - 1.73  # a slope
    points[::9, 2] += 1.2
    points[3::50] = math.nan
    projector = make_projector(VIEWS["front"], spec_of(VIEWS["front"]))
    seen = projection.project(projector, points)
    height_m = find_ground(points, mount_height_m=1.73).height_m
    assert_same(
        seen, twins.projection.project(points, VIEWS["front"], edges_of("front"), spec_of(VIEWS["front"]), height_m)
    )
    assert n < 4000 or abs(np.nanmedian(height_m)) < 0.05
    plain = make_projector(VIEWS["top view"], spec_of(VIEWS["top view"]))
    assert projection.input_heights(plain, points) is None
    assert_same(
        projection.project(plain, points), [getattr(plain.project(points), k) for k in ("image", "index", "pixel")]
    )


def test_the_benchmark_compares_equal_answers() -> None:
    points = random_points(np.random.default_rng(3), 20000)
    calls = contenders(points[(np.abs(points) < 1e9).all(axis=1)])  # raises where numpy and the kernels differ
    assert {*calls} == {"top view", "top view, numpy", "range image", "range image, numpy"}


def test_wrong_cards_are_refused() -> None:
    with pytest.raises(CardError, match="range"):
        make_projector(VIEWS["top view"], InputSpec("input", ("range",), (0.0,), (1.0,)))
    with pytest.raises(CardError, match="height"):
        make_projector(VIEWS["front"], InputSpec("input", ("x", "height"), (0.0, 0.0), (1.0, 1.0)))
    spec = InputSpec("input", ("x",), (0.0,), (1.0,))
    for view in (RangeImageGeometry((1.0, 1.0 - 1e-9, -1.0)), RangeImageGeometry((1.0, -1.0), 60000, 46.0, 45.0)):
        with pytest.raises(CardError, match="closer than"):
            make_projector(view, spec)
    with pytest.raises(CardError, match="at least 1 degree apart"):
        RangeImageGeometry((1.0, -1.0), 4, 45.0 + 1e-9, 45.0)


@pytest.mark.parametrize("view", [RangeImageGeometry(tuple(range(8, -8, -1)), 16), tiny_model.tiny_card().view])
def test_a_network_sees_a_scan_from_the_height_of_its_training(tmp_path: Path, view: Any) -> None:
    """As the scan is, where the sensor stands as high as the training sensor."""
    channels = ("range", "z") if view.kind == "range_image" else ("distance", "height")
    spec = InputSpec("x", channels, (0.0, 0.0), (10.0, 1.0))
    card = replace(tiny_model.tiny_card(), view=view, input=spec, mount_height_m=2.6)
    card = replace(card, classes=("background", "car"))
    (tmp_path / "own.onnx").write_bytes(tiny_model.model(GRAPH, card=card))
    points = np.random.default_rng(0).uniform((4.0, -4.0, -2.0, 0.0), (15.0, 4.0, 1.0, 1.0), (400, 4))
    options = {"agree": False, "boxes_from": "network", "adapt": "none", "on_mismatch": "ignore"}
    perceive = Perceiver(tmp_path / "own.onnx", mounting=Mounting(2.6, 0.0, 0.66, 0.0), **options)
    perceive(points.astype(np.float32))
    expected = projection.project(make_projector(view, spec), points.astype(np.float32)).image
    np.testing.assert_allclose(perceive.sessions[0].input, expected, atol=1e-5)
