"""Earlier scans as seen from the newest one: what stands still stays, what moves or went away does not."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

import twins.sweeps
from edgeperc import (
    Box,
    EdgepercError,
    OptionError,
    Perceiver,
    Perception,
    PointsError,
    SensorHealth,
    StampError,
    SweepPerceiver,
    Sweeps,
    Tracker,
    TrackingError,
    Tracks,
)
from edgeperc.ground.planes import fit_ground, heights_above
from edgeperc.road.sweeps import mark_still_there
from edgeperc.simulation import random_scene, simulate_sequence
from edgeperc.types.geometry import oriented_iou, rectangles
from edgeperc.types.sensor import get_sensor
from scenes import assert_same, box, urban

NEAR = st.one_of(st.integers(-3, 3).map(float), st.floats(-4.0, 4.0, width=32), st.sampled_from([math.nan, math.inf]))
SCANS = npst.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(4)), elements=NEAR.map(np.float32))


@given(SCANS, SCANS, st.sampled_from([(0.0, 0.0), (1.0, -2.0)]), st.floats(0.05, 1.0))
def test_free_space_is_that_of_the_twin(
    scan: NDArray[np.float32], earlier: NDArray[np.float32], eye: tuple[float, float], step_rad: float
) -> None:
    step, found = np.array([step_rad, 0.5 * step_rad]), np.empty(len(earlier), np.bool_)
    mark_still_there(scan, earlier, np.array(eye), step, 0.6, found)
    np.testing.assert_array_equal(found, twins.sweeps.still_there(scan, earlier, np.array(eye), step, 0.6))


def moved(x: float, turn: float = 0.0) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:2, :2] = [[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]]
    pose[0, 3] = x
    return pose


def wall(x: float, y: float = 0.0, width: float = 2.0, height: float = 2.0) -> NDArray[np.float32]:
    """A panel that faces the sensor, as dense as a sensor of 64 beams sees it from 10 m."""
    ys, zs = np.meshgrid(np.arange(y - width / 2, y + width / 2, 0.03), np.arange(-height, height, 0.06))
    return np.column_stack([np.full(ys.size, x), ys.ravel(), zs.ravel(), np.full(ys.size, 0.5)]).astype(np.float32)


def perceived(points: NDArray[np.float32], boxes: Any = (), **more: Any) -> Perception:
    return replace(Perception(len(points), 0, None, None, tuple(boxes), {}, {}, (), None), **more)


def remembered(*scans: tuple[NDArray[np.float32], list[Box]], step_m: float = 0.0) -> tuple[Sweeps, Tracks]:
    sweeps, tracker = Sweeps(20), Tracker()
    for k, (points, boxes) in enumerate(scans):
        tracks = tracker.update(boxes, 0.1 * k, moved(step_m * k))
        sweeps.add(points, perceived(points, boxes), tracks)
    return sweeps, tracks


def test_what_stands_is_where_the_newest_scan_has_it() -> None:
    sweeps, _ = remembered((wall(10.0), []), (wall(9.0), []), step_m=1.0)
    seen = sweeps.earlier(wall(8.0), 0.2, moved(2.0))
    assert len(seen) == 2 * len(wall(10.0))
    assert not seen.flags.writeable
    np.testing.assert_allclose(seen, np.concatenate([wall(8.0)] * 2), atol=1e-5)
    turned = sweeps.earlier(np.zeros((0, 4)), 0.2, moved(2.0, math.pi / 2.0))
    np.testing.assert_allclose(turned[:, 1], -8.0, atol=1e-5)  # now to the right


def test_what_beams_pass_is_left_out() -> None:
    """A panel that went away in front of a wall, but not one that hides what is behind it, nor one beside the beams."""
    sweeps, _ = remembered((np.concatenate([wall(10.0), wall(10.0, 6.0)]), []))
    seen = sweeps.earlier(wall(15.0, width=6.0, height=4.0), 0.1, moved(0.0))
    np.testing.assert_array_equal(seen, wall(10.0, 6.0))
    assert len(sweeps.earlier(wall(5.0, width=6.0), 0.1, moved(0.0))) == 2 * len(wall(10.0))
    assert len(sweeps.earlier(wall(10.3, width=6.0), 0.1, moved(0.0))) == 2 * len(wall(10.0))  # as bent, or as noisy


@pytest.mark.parametrize(
    ("label", "speed_mps", "stays"), [("car", 0.0, True), ("car", 5.0, False), ("pedestrian", 0.0, False)]
)
def test_only_what_surely_stands_counts(label: str, speed_mps: float, stays: bool) -> None:
    size = (4.0, 2.4, 4.4) if label == "car" else (1.0, 2.4, 4.4)
    ways = [10.0 + 0.1 * speed_mps * k for k in range(12)]
    scans = [(wall(x), [box(x, 0.0, label, 0.99, size=size, z=0.0)]) for x in ways]
    new, _ = remembered(*scans[:2])
    assert not len(new.earlier(wall(ways[2]), 0.2, moved(0.0)))  # not yet known
    sweeps, _ = remembered(*scans)
    assert len(sweeps.earlier(wall(ways[-1]), 1.2, moved(0.0))) == len(wall(10.0)) * len(scans) * stays


def test_a_box_without_a_track_counts_as_moving() -> None:
    """It may be the first one of an object that moves."""
    sweeps, tracker = Sweeps(), Tracker()
    found = perceived(wall(10.0), [box(10.0, size=(4.0, 2.4, 4.4), z=0.0)])
    sweeps.add(wall(10.0), found, tracker.update([], 0.0, moved(0.0)))
    assert not len(sweeps.earlier(wall(10.0), 0.1, moved(0.0)))


def test_own_vehicle_rain_and_old_scans_are_left_out() -> None:
    own = replace(get_sensor("vlp-16"), ego_box=((-1.0, 1.0), (-1.0, 1.0), (-2.0, 2.0)), min_range_m=0.5)
    points = np.concatenate([wall(10.0), np.float32([[0.9, 0.0, 0.0, 0.0], [0.1, 0.0, 0.0, 0.0], [np.nan] * 4])])
    sweeps, tracker = Sweeps(3), Tracker()
    sweeps.add(points, perceived(points, sensor=own), tracker.update([], 0.0, moved(0.0)))
    assert len(sweeps.earlier(wall(7.0), 0.1, moved(3.0))) == len(wall(7.0))
    rainy = SensorHealth(has_drops=True)
    sweeps.add(points, perceived(points, health=rainy), tracker.update([], 0.1, moved(0.0)))
    with pytest.warns(UserWarning, match="late"):
        sweeps.add(points, perceived(points), tracker.update([], 0.05, moved(0.0)))
    assert len(sweeps.earlier(wall(10.0), 0.2, moved(0.0))) == len(wall(10.0))
    for stamp_s in (0.0, -5.0, 3.2):  # not later than it, or too late
        assert not len(sweeps.earlier(wall(10.0), stamp_s, moved(0.0)))
    for k in range(5):
        sweeps.add(wall(10.0), perceived(wall(10.0)), tracker.update([], 0.2 + 0.1 * k, moved(0.0)))
    assert len(sweeps.earlier(wall(10.0), 0.7, moved(0.0))) == 2 * len(wall(10.0))
    sweeps.reset()
    assert not len(sweeps.earlier(wall(10.0), 0.7, moved(0.0)))


def test_the_ground_of_an_earlier_scan_lies_on_that_of_the_newest() -> None:
    """Though its pose is tilted by half a degree and 0.1 m too high, as those of an odometry of few beams."""
    wrong = np.eye(4)
    wrong[:3, :3] = [[math.cos(0.01), 0.0, math.sin(0.01)], [0.0, 1.0, 0.0], [-math.sin(0.01), 0.0, math.cos(0.01)]]
    wrong[2, 3] = 0.1
    (_, first, earlier), (_, second, newest) = simulate_sequence(random_scene(5, "urban"), "vlp-16", 2, 10.0, 6.0)
    ground = fit_ground(newest.points).surface()
    for pose in (first, first @ wrong):
        sweeps, tracker = Sweeps(), Tracker()
        sweeps.add(earlier.points, perceived(earlier.points), tracker.update([], 0.0, pose))
        seen = sweeps.earlier(newest.points, 0.1, second)
        height_m = heights_above(ground, seen).height_m[np.hypot(seen[:, 0], seen[:, 1]) < 20.0]
        of_ground = height_m[np.abs(height_m) < 0.3]
        assert len(of_ground) > 3000
        assert np.median(np.abs(of_ground)) < 0.03


def test_a_jump_of_the_clock_begins_anew() -> None:
    sweeps, tracker = Sweeps(), Tracker()
    sweeps.add(wall(10.0), perceived(wall(10.0)), tracker.update([], 1000.0, moved(0.0)))
    with pytest.warns(UserWarning, match="jump"):
        sweeps.add(wall(10.0), perceived(wall(10.0)), tracker.update([], 999.0 - 500.0, moved(0.0)))
    assert len(sweeps.earlier(wall(10.0), 499.1, moved(0.0))) == len(wall(10.0))
    assert not len(sweeps.earlier(wall(10.0), 1000.1, moved(0.0)))  # of the clock before


def test_a_scan_without_a_pose_forgets_those_before() -> None:
    sweeps, _ = remembered((wall(10.0), []))
    assert len(sweeps.earlier(wall(10.0), 0.1, moved(0.0)))
    assert not len(sweeps.earlier(wall(10.0), 0.1, None))
    assert not len(sweeps.earlier(wall(10.0), 0.1, moved(0.0)))


def test_a_perceiver_gets_the_scans_before() -> None:
    """Those whose poses are known; a scan without a pose, or without a time, has no tracks."""
    given: list[NDArray[np.float32]] = []
    poses = iter([moved(0.0), moved(1.0), None, moved(3.0), moved(4.0)])

    def perceiver(points: NDArray[np.float32], stamp_s: float, earlier: NDArray[np.float32]) -> Perception:
        given.append(earlier)
        return perceived(points, stamp_s=stamp_s)

    def odometry(points: Any, stamp_s: float) -> NDArray[np.float64] | None:
        if not math.isfinite(stamp_s):
            raise StampError(f"got a scan at {stamp_s} s")
        return next(poses)

    perceive = SweepPerceiver(perceiver, Tracker(), odometry, n=3)
    tracked = [perceive.track(perceive(wall(10.0 - k), 0.1 * k)) for k in range(5)]
    assert [each is None for each in tracked] == [False, False, True, False, False]
    assert [bool(len(earlier)) for earlier in given] == [False, True, False, False, True]
    np.testing.assert_allclose(given[1][:, 0], 9.0)
    np.testing.assert_allclose(given[4][:, 0], 6.0)
    untimed = perceive(wall(5.0), math.nan)
    assert not len(given[-1])
    with pytest.raises(StampError, match="nan"):
        perceive.track(untimed)
    assert perceive.sensor is None
    with pytest.raises(OptionError, match="from 2 to 20"):
        SweepPerceiver(perceiver, Tracker(), odometry, n=1)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: Sweeps(1), OptionError, "expected a whole number from 2 to 20"),
        (lambda: Sweeps(2.5), OptionError, "expected a whole number from 2 to 20"),  # type: ignore[arg-type]
        (lambda: Sweeps().earlier([[1.0]], 0.0, np.eye(4)), PointsError, "expected"),
        (lambda: Sweeps().earlier(wall(1.0), "now", np.eye(4)), StampError, "now"),  # type: ignore[arg-type]
        (lambda: Sweeps().earlier(wall(1.0), math.nan, np.eye(4)), StampError, "finite"),
        (lambda: Sweeps().earlier(wall(1.0), 0.0, 2.0 * np.eye(4)), TrackingError, "T_world_sensor"),
        (lambda: Sweeps().add(wall(1.0), perceived(wall(2.0)), []), OptionError, "Tracker"),  # type: ignore[arg-type]
        (
            lambda: Sweeps().add(wall(1.0), perceived(wall(2.0)[1:]), Tracker().update([], 0.0)),
            PointsError,
            "perceived",
        ),
    ],
)
def test_bad_input(call: Any, error: type[EdgepercError], words: str) -> None:
    with pytest.raises(error, match=words):
        call()


@pytest.mark.parametrize("full_turn", [False, True])
def test_earlier_points_are_not_labeled(full_turn: bool) -> None:
    points = urban(3, "vlp-16").points
    perceive = Perceiver(sensor="vlp-16", on_mismatch="ignore", full_turn=full_turn, n_threads=1)
    alone = perceive(points)
    assert_same(perceive(points, earlier=points[:0]), alone)
    more = perceive(points, earlier=np.concatenate([points + np.float32([0.0, 0.0, 0.2, 0.0]), [[np.nan] * 4]]))
    assert more.n_points == len(points) == len(more.require_points().labels)
    assert more.n_dropped == alone.n_dropped
    with pytest.raises(PointsError):
        perceive(points, earlier=[[1.0]])


def test_a_sparse_sensor_finds_more_of_what_stands() -> None:
    """Vehicles in a street along which a VLP-16 drives, and how well they are covered."""
    perceive = Perceiver(sensor="vlp-16", on_mismatch="ignore", full_turn=True)
    covered: dict[bool, list[float]] = {False: [], True: []}
    for with_sweeps in covered:
        sweeps, tracker = Sweeps(5), Tracker()
        drive = simulate_sequence(random_scene(5, "residential"), "vlp-16", 10, 10.0, 6.0)
        for k, (stamp_s, pose, scan) in enumerate(drive):
            earlier = sweeps.earlier(scan.points, stamp_s, pose) if with_sweeps else None
            perception = perceive(scan.points, stamp_s, earlier=earlier)
            sweeps.add(scan.points, perception, tracker(perception, pose))
            if k >= 5:
                shown = zip(scan.boxes, scan.box_points, strict=True)
                true = [each for each, n in shown if each.label == "car" and n >= 3]
                overlap = oriented_iou(rectangles(true), rectangles(perception.boxes))
                covered[with_sweeps] += overlap.max(axis=1, initial=0.0).tolist()
    assert np.mean(covered[True]) > np.mean(covered[False]) + 0.03
