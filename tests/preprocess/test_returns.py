"""Beams without a return and the own vehicle are not points: dropped, counted, and used by nothing."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

import twins.returns
from cli_helpers import Shell
from edgeperc import FitnessError, Mounting, Perceiver, SensorError, deskew, merge, occupancy_grid, read_points
from edgeperc.errors import OptionError
from edgeperc.preprocess.condition import condition
from edgeperc.preprocess.ego import suggest_ego_box
from edgeperc.preprocess.motion import Motion
from edgeperc.preprocess.remission import RemissionMatcher
from edgeperc.preprocess.returns import returns
from edgeperc.preprocess.sensor_fit import fit_sensor
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import DroppedPoints, Perception
from edgeperc.types.sensor import SensorProfile, get_sensor
from scenes import urban

Points = NDArray[np.float32]
VLP = get_sensor("vlp-16")
BOX = ((-1.5, 2.0), (-1.0, 1.0), (-1.5, -0.2))
values = st.one_of(
    st.sampled_from([0.0, -0.0, 0.5, -0.5, 0.49999, 0.50001, 1e-30, 1e-45, 3e38, np.nan, np.inf, -np.inf]),
    st.floats(-3.0, 3.0, width=32),
)
scans = hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(4)), elements=values)


def on_a_ray(n: int, nearest_m: float, farthest_m: float, seed: int = 0, remission: float = 10.0) -> Points:
    """Beams without a return, as many drivers write them."""
    ranges = np.random.default_rng(seed).uniform(nearest_m, farthest_m, n)
    ray = np.array([np.cos(-0.03), 0.0, np.sin(-0.03)])
    return np.column_stack([ranges[:, None] * ray, np.full(n, remission)]).astype(np.float32)


@settings(max_examples=150)
@given(
    scans,
    st.sampled_from([0.0, 0.3, 0.5, 2.0]),
    st.sampled_from([(0.0, 0.0), (0.5, -1.0)]),
    st.sampled_from([None, BOX]),
)
def test_rows_are_dropped_as_the_slow_twin_drops_them(
    points: Points, min_range_m: float, origin: tuple[float, float], box: tuple[tuple[float, float], ...] | None
) -> None:
    sensor = replace(VLP, min_range_m=min_range_m, mounting=Mounting(origin_m=origin), ego_box=box)
    before = points.copy()
    scan, dropped = returns(points, sensor)
    wanted, counts = twins.returns.returns(points, min_range_m, origin, box)
    np.testing.assert_array_equal(points, before)
    np.testing.assert_array_equal(scan, wanted)
    assert astuple(dropped) == counts
    assert not scan.flags.writeable
    has_changed = dropped.total or not np.isfinite(points).all()
    assert has_changed or np.shares_memory(scan, points) or not len(points)
    again, none = returns(scan, sensor)
    np.testing.assert_array_equal(again, scan)
    assert none == DroppedPoints(not_finite=dropped.total)


@settings(max_examples=100)
@given(st.floats(0.05, 5.0), st.floats(-np.pi, np.pi), st.floats(-1.5, 1.5))
def test_a_point_at_exactly_the_nearest_range_is_near(range_m: float, azimuth: float, elevation: float) -> None:
    ray = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    points = np.array([[*(range_m * ray), 1.0], [*(1.00001 * range_m * ray), 1.0]], np.float32)
    _, dropped = returns(points, replace(VLP, min_range_m=range_m))
    assert astuple(dropped) == (0, 1, 0)


def test_without_a_nearest_range_only_the_sensors_own_place_is_dropped() -> None:
    points = np.array([[0, 0, 0, 5], [-0.0, 0, -0.0, 0], [1e-30, 0, 0, 5], [0, 1e-45, 0, 1]], np.float32)
    _, dropped = returns(points, replace(VLP, min_range_m=0.0))
    assert astuple(dropped) == (0, 2, 0)


@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_a_missing_remission_is_no_missing_point(missing: float, share: float) -> None:
    points = on_a_ray(400, 3.0, 60.0, remission=10.0)
    points[:, 3] = np.arange(400) % 7
    without = np.random.default_rng(5).random(400) < share
    points[without, 3] = missing
    scan, dropped = returns(points, get_sensor("vlp-16"))
    assert dropped.total == 0
    np.testing.assert_array_equal(scan[:, :3], points[:, :3])
    np.testing.assert_array_equal(scan[~without, 3], points[~without, 3])
    known = points[~without, 3]
    assert {*scan[without, 3].tolist()} == {float(np.median(known)) if len(known) else 0.0}
    points[::5, 1] = missing
    scan, dropped = returns(points, get_sensor("vlp-16"))
    assert dropped == DroppedPoints(not_finite=80)
    assert np.isnan(scan[::5]).all()
    assert np.isfinite(np.delete(scan, np.s_[::5], axis=0)).all()


def test_dropped_rows_are_counted_with_those_whose_remission_overflows() -> None:
    points = np.array([[5, 0, 0, 3e38], [5, 0, 0, 0.5], [0, 0, 0, 0.5], [np.nan, 0, 0, 0]], np.float32)
    sensor = SensorProfile("half", (0.0,), 900, remission_range=(0.0, 0.5))
    scan, n_dropped = condition(points, sensor)
    assert n_dropped == 3
    assert np.isnan(scan[[0, 2, 3]]).all()
    np.testing.assert_array_equal(scan[1], [5, 0, 0, 1])


@pytest.mark.parametrize(
    "box", [(1, 2, 3), "box", ((0, 1), (0, 1)), ((1, 0), (0, 1), (0, 1)), ((0, np.nan), (0, 1), (0, 1)),
            ((0, 101), (0, 1), (0, 1)), (("0", "1"), ("0", "1"), ("0", "1")), ((0, 1), (0,), (0, 1))]
)  # fmt: skip
def test_boxes_that_are_not_boxes_are_refused(box: object) -> None:
    with pytest.raises(SensorError, match="lowest and highest"):
        replace(VLP, ego_box=box)


def test_a_profile_keeps_its_box_in_a_file_and_reads_files_without_one() -> None:
    sensor = replace(VLP, ego_box=BOX)
    assert SensorProfile.from_json(sensor.to_json()) == sensor
    document = json.loads(VLP.to_json())
    del document["ego_box"]
    assert SensorProfile.from_json(json.dumps(document)) == VLP


def perceived(points: Points, sensor: SensorProfile | str = "vlp-16", **options: object) -> Perception:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Perceiver(sensor=sensor, provider="cpu", n_threads=1, **options)(points)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def street() -> Points:
    points = simulated_scan(3, "vlp-16").points.copy()
    points[:, 3] *= 255.0
    return points


@pytest.fixture(scope="module")
def alone(street: Points) -> Perception:
    return perceived(street)


EMPTY: dict[str, Callable[[], Points]] = {
    "on one ray": lambda: on_a_ray(4400, 0.001, 0.45),
    "zeros with a remission": lambda: np.float32([0, 0, 0, 200]) * np.ones((20_000, 1), np.float32),
    "mixed": lambda: np.vstack([np.zeros((900, 4)), np.full((900, 4), np.nan), on_a_ray(900, 0.1, 0.4)]).astype("f4"),
}


@pytest.mark.parametrize("kind", EMPTY)
def test_beams_without_a_return_change_nothing(street: Points, alone: Perception, kind: str) -> None:
    empty = EMPTY[kind]()
    answer = perceived(np.vstack([street, empty]))
    assert answer.boxes == alone.boxes
    assert answer.mounting == alone.mounting
    assert answer.remission == alone.remission
    assert answer.fitness == alone.fitness
    np.testing.assert_array_equal(answer.require_points().labels[: len(street)], alone.require_points().labels)
    assert not answer.require_points().labels[len(street) :].any()
    assert not answer.require_points().in_view[len(street) :].any()
    assert answer.n_dropped == len(empty) == answer.dropped.total
    assert answer.dropped.not_finite == np.count_nonzero(np.isnan(empty[:, 0]))
    assert answer.to_dict()["dropped"] == {
        "not_finite": answer.dropped.not_finite, "too_near": answer.dropped.too_near, "ego": 0,
    }  # fmt: skip


def test_the_range_is_about_the_sensor_whatever_its_mounting(street: Points, alone: Perception) -> None:
    mounting = Mounting(2.4, 3.0, -2.0, 30.0)
    turned = street.copy()
    turned[:, :3] = (street[:, :3] + [0, 0, 1.73 - 2.4]) @ mounting.rotation()
    both = np.vstack([turned, on_a_ray(4400, 0.001, 0.45)])
    answer, without = (perceived(points, mounting=mounting, on_mismatch="ignore") for points in (both, turned))
    assert answer.dropped == DroppedPoints(too_near=4400)
    assert answer.boxes == without.boxes
    aside = replace(mounting, origin_m=(3.0, -1.0))
    moved = perceived(both + np.float32([3, -1, 0, 0]), mounting=aside, on_mismatch="ignore")
    assert moved.dropped == DroppedPoints(too_near=4400)


def test_a_scan_without_returns_is_empty() -> None:
    for points in (np.zeros((500, 4), np.float32), on_a_ray(500, 0.01, 0.4), np.zeros((500, 3))):
        with pytest.raises(FitnessError, match="holds no return: 500 of its 500 points"):  # as of a scan of NaN
            perceived(np.asarray(points, np.float32))
        answer = perceived(np.asarray(points, np.float32), on_mismatch="warn")
        assert answer.boxes == ()
        assert answer.n_dropped == answer.n_points == 500
        assert not answer.require_points().in_view.any()


def test_a_box_around_the_street_is_named(street: Points) -> None:
    """As one in centimeters; the scan is not called empty."""
    sensor = replace(VLP, ego_box=((-100.0, 100.0),) * 3)
    with pytest.raises(FitnessError, match=r"scan lie inside the ego_box of the profile vlp-16.*in meters"):
        perceived(street, sensor)


def test_a_street_in_kilometers_is_still_another_unit(street: Points) -> None:
    for size in (1e-3, 1.0 / 120.0):
        with pytest.raises(FitnessError, match="another unit"):
            perceived(street * np.float32([size, size, size, 1.0]))


def test_one_warning_a_perceiver_says_what_was_dropped(street: Points) -> None:
    perceive = Perceiver("pointseg", sensor="vlp-16", provider="cpu", n_threads=1, on_mismatch="ignore")
    perceive(street)
    with pytest.warns(UserWarning, match=r"4,400 of .* at most 0.5 m .* vlp-16 .* labeled 0.*min_range_m"):
        perceive(np.vstack([street, on_a_ray(4400, 0.001, 0.45)]))
    perceive(np.vstack([street, np.zeros((10, 4), np.float32)]))


def test_returns_of_the_own_vehicle_take_part_in_nothing(street: Points, alone: Perception) -> None:
    rng = np.random.default_rng(0)
    roof = np.column_stack([rng.uniform([-1.4, -0.9, -1.4], [1.9, 0.9, -0.6], (3000, 3)), np.full(3000, 30.0)])
    answer = perceived(np.vstack([street, roof.astype(np.float32)]), replace(VLP, ego_box=BOX))
    assert answer.dropped == DroppedPoints(ego=3000)
    assert answer.boxes == alone.boxes
    assert not answer.require_points().labels[len(street) :].any()


def test_grid_for_navigation_has_no_obstacle_at_the_sensor(street: Points, alone: Perception) -> None:
    near = np.vstack([street, on_a_ray(4400, 0.001, 0.45)])
    area = {"x_range_m": (-5.0, 20.0), "y_range_m": (-10.0, 10.0), "sensor": "vlp-16"}
    grids = [occupancy_grid(p, q, **area) for p, q in ((alone, street), (perceived(near), near))]  # type: ignore[arg-type]
    np.testing.assert_array_equal(grids[0].obstacle, grids[1].obstacle)
    np.testing.assert_array_equal(grids[0].observed, grids[1].observed)


def test_remission_is_matched_and_fitted_without_what_is_dropped(street: Points) -> None:
    sensor = replace(VLP, ego_box=BOX)
    rng = np.random.default_rng(2)
    roof = np.column_stack([rng.uniform([1.0, -0.9, -1.4], [1.9, 0.9, -0.3], (20_000, 3)), np.full(20_000, 255.0)])
    both = np.vstack([street, roof, np.zeros((20_000, 4))]).astype(np.float32)
    assert fit_sensor([street], sensor)[0] == fit_sensor([both], sensor)[0]
    constant = np.where(np.arange(4) == 3, np.float32(0.0), street)
    zeros = np.float32([0, 0, 0, 200]) * np.ones((len(street), 1), np.float32)
    assert RemissionMatcher(sensor).add(returns(np.vstack([constant, zeros]), sensor)[0])[2]


def test_motion_does_not_move_beams_without_a_return(street: Points) -> None:
    points = np.vstack([street, np.zeros((50, 4), np.float32), on_a_ray(50, 0.001, 0.45)])
    motion, times = Motion((20.0, 0.0, 0.0)), np.linspace(0.0, 0.1, len(points))
    straight = deskew(points, times, motion, min_range_m=0.5)
    np.testing.assert_array_equal(straight[-100:], points[-100:])
    np.testing.assert_array_equal(straight[:-100], deskew(street, times[:-100], motion, at_s=0.1))
    with pytest.raises(OptionError, match="min_range_m"):
        deskew(points, times, motion, min_range_m=-1.0)


def test_merged_scans_have_no_beams_without_a_return(street: Points) -> None:
    poses = [np.eye(4), np.eye(4)]
    poses[1][:3, 3] = 2.0, 1.0, 1.7
    points = np.vstack([street, np.zeros((50, 4), np.float32), on_a_ray(50, 0.001, 0.45)])
    merged = merge([points, points], poses, min_range_m=(0.0, 0.5))
    assert [np.count_nonzero(np.isnan(part[:, 0])) for part in np.split(merged, 2)] == [50, 100]
    with pytest.raises(OptionError, match="one for each"):
        merge([points, points], poses, min_range_m=(0.5,))


def test_info_counts_and_takes_a_box(street: Points, tmp_path: Path, shell: Shell) -> None:
    file, profile = tmp_path / "scan.npy", tmp_path / "mine.json"
    np.save(file, np.vstack([street, on_a_ray(4400, 0.001, 0.45), np.float32([[1, 0, -1, 9]])]))
    box = ["--ego-box", "-1.5", "2", "-1", "1", "-1.5", "-0.2"]
    (document,) = shell.records("info", file, "--sensor", "vlp-16", "--write", profile, *box)
    assert (document["n_not_finite"], document["n_too_near"], document["n_ego"]) == (0, 4400, 1)
    assert document["range_m"][0] > 1.0
    assert get_sensor(profile).ego_box == BOX
    printed = " ".join(shell.out("info", file, "--sensor", profile).split())
    assert "4,400 at most 0.5 m from the sensor, not returns, 1 inside the box" in printed


def roof(seed: int) -> Points:
    """Two corners of the own roof, with the noise of a sensor."""
    y, z = np.meshgrid(np.linspace(0.9, 1.1, 30), np.linspace(-0.8, -0.5, 8))
    corner = np.column_stack([np.full(y.size, 1.4), y.ravel(), z.ravel(), np.full(y.size, 0.2)])
    points = np.vstack([corner, corner * [-0.8, -1, 1, 1]])
    points[:, :3] *= 1.0 + np.random.default_rng(seed).normal(0.0, 0.005, (len(points), 1))
    return points.astype(np.float32)


def beside(seed: int) -> Points:
    """The side of a car that stands in the next lane."""
    x, z = np.meshgrid(np.arange(-2.5, 2.5, 0.02), np.arange(-1.2, -0.4, 0.05))
    side = np.column_stack([x.ravel(), np.full(x.size, 2.0), z.ravel(), np.full(x.size, 0.2)])
    side[:, 1] += np.random.default_rng(seed).normal(0.0, 0.01, len(side))
    return side.astype(np.float32)


@pytest.fixture(scope="module")
def drive() -> list[Points]:
    """Ten places."""
    return [urban(seed).points for seed in range(10)]


def test_the_own_roof_is_suggested_and_nothing_else(drive: list[Points]) -> None:
    hdl = get_sensor("hdl-64e")
    none = suggest_ego_box(drive, hdl, MODEL_MOUNTING)
    assert (none.box, none.n_places) == (None, 10)
    found = suggest_ego_box([np.vstack([p, roof(k)]) for k, p in enumerate(drive)], hdl, MODEL_MOUNTING)
    wanted = ((-1.2, 1.5), (-1.2, 1.2), (-0.9, -0.4))
    np.testing.assert_allclose(found.box, wanted, atol=0.12)


def test_a_car_beside_is_not_suggested_while_the_street_moves(drive: list[Points]) -> None:
    # It stands beside in half of the scans: the jam moves on.
    scans = [np.vstack([p, roof(k), *([beside(k)] if k % 2 else [])]) for k, p in enumerate(drive)]
    assert suggest_ego_box(scans, get_sensor("hdl-64e"), MODEL_MOUNTING).box[1][1] < 1.5


def test_a_traffic_jam_gives_no_suggestion(drive: list[Points]) -> None:
    rng = np.random.default_rng(0)
    standing = [
        np.vstack([drive[0] + rng.normal(0.0, 0.01, drive[0].shape).astype(np.float32), roof(k), beside(k)])
        for k in range(15)
    ]
    with pytest.raises(SensorError, match="in 1 different places in these 15 scans"):
        suggest_ego_box(standing, get_sensor("hdl-64e"), MODEL_MOUNTING)


@pytest.mark.parametrize(
    ("first", "last", "step", "n_places"), [(176, 252, 4, None), (0, 152, 10, 10)], ids=["jam", "drive"]
)
def test_real_drives(kitti_root: Path, first: int, last: int, step: int, n_places: int | None) -> None:
    files = [kitti_root / "training" / "velodyne" / f"{k:06d}.bin" for k in range(first, last + 1, step)]
    scans = [read_points(file) for file in files]
    hdl = get_sensor("hdl-64e")
    assert all(returns(scan, hdl)[1] == DroppedPoints() for scan in scans)
    if n_places is None:
        with pytest.raises(SensorError, match="3 different places"):
            suggest_ego_box(scans, hdl, MODEL_MOUNTING)
        return
    found = suggest_ego_box(scans, hdl, MODEL_MOUNTING)
    assert found.n_places >= n_places
    lows, highs = np.array(found.box).T
    assert (lows > [-1.6, -1.6, -1.2]).all()
    assert (highs < [1.8, 1.6, 0.0]).all()
