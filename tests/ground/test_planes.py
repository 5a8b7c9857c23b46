from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.planes
from edgeperc.errors import PointsError
from edgeperc.ground.planes import Ground, find_ground, fit_ground, heights_above
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import simulate


def street(
    rng: np.random.Generator,
    n: int = 4000,
    slope_x: float = 0.0,
    slope_y: float = 0.0,
    kerb: float = 0.0,
    reach: float = 30.0,
    mount: float = 1.73,
) -> tuple[np.ndarray, np.ndarray]:
    """Points of a street with a pavement left of y = 4 m, and whether they are ground; a third stand on boxes."""
    x, y = rng.uniform(-reach, reach, (2, n))
    z = slope_x * x + slope_y * y - mount + kerb * (y > 4.0) + rng.normal(0.0, 0.01, n)
    on = rng.random(n) > 0.3
    z[~on] += rng.uniform(0.4, 2.0, (~on).sum())
    points = np.column_stack([x, y, z, np.zeros(n)]).astype(np.float32)
    return points, on


def check_same(found: Ground, expected: Ground, rows: np.ndarray | slice = np.s_[:]) -> None:
    """Whether a ground is that of some rows of another one."""
    np.testing.assert_array_equal(found.height_m, expected.height_m[rows])
    np.testing.assert_array_equal(found.mask, expected.mask[rows])
    assert found.plane == expected.plane


def check_against_twin(points: np.ndarray, regions: bool, atol: float) -> None:
    heights, plane = twins.planes.ground_heights(points, 1.73, regions)
    ground = find_ground(points, regions=regions)
    np.testing.assert_allclose(ground.plane, plane, atol=1e-9)
    np.testing.assert_allclose(ground.height_m, heights, atol=atol, rtol=1e-6)


@pytest.mark.parametrize("columns", [3, 5])
def test_other_columns_do_not_matter(columns: int) -> None:
    points, _ = street(np.random.default_rng(0))
    other = np.full((len(points), columns), np.nan, np.float32)
    other[:, :3] = points[:, :3]
    check_same(find_ground(other), find_ground(points))


@pytest.mark.parametrize("regions", [True, False])
@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.08, -0.05), (-0.2, 0.1)])
def test_a_slope_is_ground_and_what_stands_on_it_is_not(slope_x: float, slope_y: float, regions: bool) -> None:
    points, on = street(np.random.default_rng(0), slope_x=slope_x, slope_y=slope_y)
    ground = find_ground(points, regions=regions)
    np.testing.assert_allclose(ground.plane, (slope_x, slope_y, -1.73), atol=0.01)
    assert ground.mask.dtype == bool
    assert ground.height_m.dtype == np.float32
    np.testing.assert_array_equal(ground.mask, on)
    assert abs(ground.height_m[on]).max() < 0.1


def test_the_ground_steps_onto_the_pavement() -> None:
    points, on = street(np.random.default_rng(1), n=20000, kerb=0.2)
    stepped, plane = find_ground(points), find_ground(points, regions=False)
    assert stepped.mask[on].mean() > 0.999
    assert np.abs(stepped.height_m[on]).mean() < 0.02
    assert np.abs(plane.height_m[on]).mean() > 0.04


def test_the_ground_follows_a_hill_that_no_plane_fits() -> None:
    points, on = street(np.random.default_rng(2), n=20000)
    points[:, 2] += 0.002 * points[:, 0] ** 2  # 1.8 m up at 30 m
    assert (find_ground(points).mask == on).mean() > 0.999
    assert find_ground(points, regions=False).mask[on].mean() < 0.7


def test_street_between_roofs_is_the_ground() -> None:
    """Roofs on both sides have three fifths of the cells around the vehicle; the street between lies lower."""
    rng = np.random.default_rng(3)
    points, _ = street(rng, n=12000)
    points[:, 2] = -1.73 + rng.normal(0.0, 0.01, len(points))
    roofs = np.abs(points[:, 1]) > 8.0
    points[roofs, 2] += 0.35
    ground = find_ground(points)
    near = np.hypot(points[:, 0], points[:, 1]) < 20.0
    assert ground.plane[2] == pytest.approx(-1.73, abs=0.02)
    assert ground.mask[near & ~roofs].all()


@pytest.mark.parametrize("mount", [0.5, 1.73, 3.2])
def test_any_mounting_height_works_if_given(mount: float) -> None:
    points, on = street(np.random.default_rng(4), mount=mount)
    np.testing.assert_array_equal(find_ground(points, mount_height_m=mount + 0.3).mask, on)
    assert find_ground(points, mount_height_m=mount + 2.0).plane is None


@pytest.mark.parametrize("regions", [True, False])
@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 4)),
        np.array([[5.0, 0.0, -1.73, 0.2]]),
        np.full((9, 4), np.nan),
        np.array([[np.inf, 0, 0, 0], [0, -np.inf, 0, 0], [1, 1, np.nan, 0], [3, 0, -1.7, 0]]),
        np.column_stack([np.full(5000, 5.0), *np.random.default_rng(5).uniform(-2, 2, (2, 5000)), np.zeros(5000)]),
    ],
    ids=["empty", "one", "nan", "not finite", "a wall"],
)
def test_scan_without_ground_has_no_ground_points(points: np.ndarray, regions: bool) -> None:
    ground = find_ground(points.astype(np.float32), regions=regions)
    assert ground.plane is None
    assert not ground.mask.any()
    finite = np.isfinite(points[:, :3]).all(axis=1)
    np.testing.assert_array_equal(np.isnan(ground.height_m), ~finite)
    np.testing.assert_allclose(ground.height_m[finite], points[finite, 2] + 1.73, atol=1e-6)


def test_points_that_are_not_finite_change_nothing() -> None:
    points, _ = street(np.random.default_rng(6))
    broken = np.insert(points, [0, 100, 4000], [np.nan, np.inf, -np.inf, 0.0], axis=0)
    kept = np.delete(np.arange(len(broken)), [0, 101, 4002])
    ground, without = find_ground(broken), find_ground(points)
    np.testing.assert_array_equal(ground.mask[kept], without.mask)
    np.testing.assert_array_equal(ground.height_m[kept], without.height_m)
    assert not np.delete(ground.mask, kept).any()


def test_points_far_below_are_not_ground() -> None:
    points, _ = street(np.random.default_rng(7))
    points[:3, 2] -= 3.0
    assert not find_ground(points).mask[:3].any()


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("regions", [True, False])
def test_heights_agree_with_the_twin(seed: int, regions: bool) -> None:
    rng = np.random.default_rng(seed)
    points, _ = street(rng, n=1500, slope_x=0.05, kerb=0.12 * seed, reach=[20.0, 45.0, 70.0, 90.0][seed])
    points[rng.random(len(points)) < 0.02] *= np.float32(3.0)
    points[rng.integers(0, len(points), 5), rng.integers(0, 3, 5)] = np.nan
    check_against_twin(points, regions, 1e-5)


# Few distinct values, so that points share cells, rows and heights.
numbers = st.sampled_from([0.0, 1.0, -1.7, -1.73, -2.0, 3.0, 63.99999, 64.0, -64.0, 1e6, np.nan, np.inf])


@settings(max_examples=30)
@given(st.lists(st.tuples(numbers, numbers, numbers), max_size=40), st.booleans())
def test_random_scans_match_the_twin(rows: list[tuple[float, float, float]], regions: bool) -> None:
    # The floor makes sure that there is something to find.
    x, y = np.meshgrid(np.arange(-10.0, 10.0, 2.5), np.arange(-10.0, 10.0, 2.5))
    floor = np.column_stack([x.ravel(), y.ravel(), 0.03 * x.ravel() - 1.7])
    points = np.concatenate([np.array(rows).reshape(-1, 3), floor]).astype(np.float32)
    check_against_twin(points, regions, 1e-4)


def test_ground_is_deterministic() -> None:
    points, _ = street(np.random.default_rng(8))
    check_same(find_ground(points), find_ground(points.copy()))


@pytest.mark.parametrize("regions", [False, True])
def test_heights_of_some_points_are_those_of_all(regions: bool) -> None:
    points, _ = street(np.random.default_rng(8))
    every = find_ground(points, regions=regions)
    x, y = points[:, 0], points[:, 1]
    for wanted in (np.arange(len(points)) % 7 == 3, (x > 10.0) & (x < 25.0), (x > 0.0) & (abs(y) < x), x < -5.0):
        rows = np.flatnonzero(wanted).astype(np.int32)
        assert len(rows) > 100
        check_same(fit_ground(points, regions=regions).heights(rows), every, rows)
    check_same(fit_ground(points, regions=regions).heights(rows[:0]), every, rows[:0])


@pytest.mark.parametrize("mount", [1.73, 4.0])  # the second is so wrong that no ground is found
@pytest.mark.parametrize("regions", [True, False])
def test_the_surface_gives_the_heights_of_the_scan(mount: float, regions: bool) -> None:
    points, _ = street(np.random.default_rng(7), n=3000, kerb=0.15, reach=80.0)
    points[:5, 2] = np.nan
    fit = fit_ground(points, mount_height_m=mount, regions=regions)
    check_same(heights_above(fit.surface(), points), fit.heights())


@pytest.mark.kernel
@pytest.mark.parametrize("n", [0, 1, 50, 3000])
def test_the_surface_holds_the_lowest_point_of_each_cell(n: int) -> None:
    points, _ = street(np.random.default_rng(n), n=n, kerb=0.15, reach=80.0)
    points[::7, 0] = np.inf
    fit = fit_ground(points)
    surface, rows = fit.surface(), fit.lowest.reshape(-1)
    np.testing.assert_array_equal(surface.cells, [cell for cell in range(len(rows)) if rows[cell] >= 0])
    assert surface.cells.dtype == np.int32
    np.testing.assert_array_equal(surface.lowest, points[rows[rows >= 0]])


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(0, 40), st.integers(0, 300))
def test_other_points_are_as_high_as_in_the_scan(seed: int, n: int, n_scan: int) -> None:
    """Far above the ground, they would change nothing in the scan; any z only shifts their height."""
    rng = np.random.default_rng(seed)
    points, _ = street(rng, n=n_scan)
    others = np.concatenate([rng.uniform(-90.0, 90.0, (n, 2)), np.full((n, 1), 200.0)], axis=1).astype(np.float32)
    both = np.concatenate([points[:, :3], others])
    expected = find_ground(both).height_m[n_scan:]
    surface = fit_ground(points).surface()
    np.testing.assert_array_equal(heights_above(surface, others).height_m, expected)
    lower = others - np.float32([0.0, 0.0, 201.5])
    np.testing.assert_allclose(heights_above(surface, lower).height_m, expected - 201.5, atol=1e-4)


def test_ground_of_a_simulated_street() -> None:
    scan = simulate(random_scene(3), "hdl-64e", 0)
    world = scan.points[:, :3] @ scan.T_world_sensor[:3, :3].T + scan.T_world_sensor[:3, 3]
    some = np.arange(0, len(world), 97)
    above = world[some, 2] - [scan.scene.ground_height(x, y) for x, y in world[some, :2]]
    mask = find_ground(scan.points).mask[some]
    assert mask[np.abs(above) < 0.03].mean() > 0.98
    assert not mask[above > 0.5].any()


def test_the_ground_of_a_road_above_lower_land_is_the_road() -> None:
    """The land on the right is 0.4 m lower, and as large."""
    scan = simulated_scan(2_000_000_002, "os1-64")
    near = np.hypot(*scan.points[:, :2].T) < 20.0
    road = near & (scan.surfaces == -1) & (scan.points[:, 1] > 0.0)
    assert road.sum() > 5000
    assert find_ground(scan.points).mask[road].mean() > 0.95


@pytest.mark.parametrize("points", [np.zeros((3, 2), np.float32), np.zeros(4, np.float32)])
def test_a_wrong_shape_is_refused(points: np.ndarray) -> None:
    with pytest.raises(PointsError, match="expected"):
        find_ground(points)


@pytest.mark.parametrize("option", [{"mount_height_m": 0.0}, {"mount_height_m": np.nan}, {"max_height_m": -1.0}])
def test_an_impossible_height_is_refused(option: dict[str, float]) -> None:
    with pytest.raises(PointsError, match="meters above 0"):
        find_ground(np.zeros((3, 4), np.float32), **option)
