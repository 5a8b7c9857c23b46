"""How a sensor is mounted: given, estimated from scans, and moved into the frame of the models."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import twins.frame
from edgeperc import Box, FitnessError, ModelFrame, Mounting, MountingError, OptionError, Perceiver, SensorError
from edgeperc.ground.leveling import FROZEN_AFTER, MountingEstimator
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import Scene, simulate
from edgeperc.types.frame import fill_moved, turned
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import SensorProfile, get_sensor

angles = st.floats(-60.0, 60.0)
mountings = st.builds(
    Mounting,
    height_m=st.floats(-1.0, 5.0),
    roll_deg=angles,
    pitch_deg=angles,
    yaw_deg=st.floats(-180.0, 180.0),
    origin_m=st.tuples(st.floats(-100.0, 100.0), st.floats(-100.0, 100.0)),
)


@functools.cache
def flat(seed: int) -> Scene:
    """A level street."""
    scene = random_scene(seed, "urban")
    terrain = np.zeros_like(scene.terrain)
    terrain[15:] = scene.terrain[15:]  # heights of kerbs and the like
    return replace(scene, terrain=terrain)


@pytest.fixture(scope="module")
def scans() -> list[NDArray[np.float32]]:
    """Simulated scans, 1.73 m above a level road."""
    scans = [simulate(flat(seed), "hdl-64e", seed=seed).points for seed in (1, 2, 3)]
    for scan in scans:
        scan.flags.writeable = False
    return scans


def seen_by(mounting: Mounting, points: NDArray[np.float32]) -> NDArray[np.float32]:
    """A scan of a level sensor, 1.73 m above the road, in the frame of a sensor mounted otherwise."""
    on_road = points[:, :3] + [0.0, 0.0, 1.73]
    moved = points.copy()
    moved[:, :3] = (on_road - [0.0, 0.0, mounting.height_m]) @ mounting.rotation() + [*mounting.origin_m, 0.0]
    return moved


def above(height_m: float, sensor: str, seed: int) -> NDArray[np.float32]:
    """A scan of a level sensor at a height above a level street."""
    high = replace(get_sensor(sensor), mounting=Mounting(height_m, 0.0, 0.0, 0.0))
    return simulate(flat(seed), high, seed=seed).points


def tilt_of(mounting: Mounting) -> tuple[float | None, float | None]:
    return mounting.roll_deg, mounting.pitch_deg


@given(mountings)
def test_matrix_and_dict_give_the_mounting_back(mounting: Mounting) -> None:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[2, 3] = mounting.rotation(), mounting.height_m
    again = Mounting.from_matrix(matrix)
    np.testing.assert_allclose(again.rotation(), mounting.rotation(), atol=1e-9)
    assert again.height_m == mounting.height_m
    assert Mounting.from_dict(json.loads(json.dumps(mounting.to_dict()))) == mounting


@pytest.mark.parametrize("pitch_deg", [90.0, -90.0, 89.99])
@pytest.mark.parametrize(("roll_deg", "yaw_deg"), [(0.0, 90.0), (45.0, 0.0), (180.0, -30.0)])
def test_a_matrix_with_x_up_or_down_gives_its_turn_back(roll_deg: float, pitch_deg: float, yaw_deg: float) -> None:
    """Rounded, as files have it: roll and yaw are turns about one axis."""
    matrix = np.eye(4)
    matrix[:3, :3] = Mounting(0.0, roll_deg, pitch_deg, yaw_deg).rotation().round(4)
    np.testing.assert_allclose(Mounting.from_matrix(matrix).rotation(), matrix[:3, :3], atol=1e-3)


def test_directions_of_the_angles() -> None:
    down, left_up, right = (Mounting(1.0, *a).rotation() for a in ((0, 10, 0), (10, 0, 0), (0, 0, -90)))
    assert down[2, 0] < 0.0  # pitch: x points down
    assert left_up[2, 1] > 0.0  # roll: the left side is up
    np.testing.assert_allclose(right @ [1, 0, 0], [0, -1, 0], atol=1e-12)  # x points right
    np.testing.assert_allclose(right @ [0, 1, 0], [1, 0, 0], atol=1e-12)  # y points ahead


@pytest.mark.parametrize(
    ("text", "mounting"),
    [
        ("[[1,0,0,9],[0,1,0,9],[0,0,1,2.5],[0,0,0,1]]", Mounting(2.5, 0.0, 0.0, 0.0)),
        ('{"T_vehicle_sensor": [[0,1,0,0],[-1,0,0,0],[0,0,1,2],[0,0,0,1]]}', Mounting(2.0, 0.0, 0.0, -90.0)),
        ("1 0 0 0\n0 1 0 0\n0 0 1 1.2\n0 0 0 1\n", Mounting(1.2, 0.0, 0.0, 0.0)),
        ("\ufeff[[1,0,0,0],[0,1,0,0],[0,0,1,2],[0,0,0,1]]", Mounting(2.0, 0.0, 0.0, 0.0)),  # Windows begins it so
        ("1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1.2", Mounting(1.2, 0.0, 0.0, 0.0)),
    ],
)
def test_extrinsic_files(tmp_path: Path, text: str, mounting: Mounting) -> None:
    (tmp_path / "extrinsic").write_text(text, "utf-8")
    assert Mounting.from_file(tmp_path / "extrinsic") == mounting


@pytest.mark.parametrize(
    "text",
    [
        "",
        "1 2 3",
        "a b c",
        "[[1,0],[0,1]]",
        '{"T": 1}',
        "nan " * 16,
        "1 " * 16,
        "[" * 100_000,
        "2 0 0 0 0 2 0 0 0 0 2 0",
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "extrinsic").write_text(text)
    with pytest.raises(SensorError, match="extrinsic"):
        Mounting.from_file(tmp_path / "extrinsic")
    with pytest.raises(SensorError, match="cannot be read"):
        Mounting.from_file(tmp_path / "absent")


@given(st.text(max_size=200))
def test_any_text_is_a_mounting_or_an_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    file = tmp_path_factory.getbasetemp() / "any"
    file.write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(SensorError):
        Mounting.from_file(file)


@pytest.mark.parametrize(
    "values",
    [
        {"height_m": math.nan},
        {"height_m": 1e6},
        {"roll_deg": 181.0},
        {"pitch_deg": "3"},
        {"yaw_deg": 361.0},
        {"yaw_deg": True},
        {"origin_m": (0.0,)},
        {"origin_m": (0.0, math.inf)},
        {"origin_m": "00"},
        {"height_m": 10**400},
        {"roll_deg": [1]},
    ],
)
def test_impossible_mountings_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(SensorError, match=next(iter(values))):
        Mounting(**values)  # type: ignore[arg-type]


def test_profiles_keep_their_mounting() -> None:
    profile = replace(get_sensor("vlp-16"), mounting=Mounting(2.0, 1.0, None, -3.0, (1.5, 0.0)))
    assert SensorProfile.from_json(profile.to_json()) == profile
    assert profile.mount_height_m == 2.0
    with pytest.raises(SensorError, match="mounting"):
        replace(profile, mounting=1.7)  # type: ignore[arg-type]
    broken = json.loads(profile.to_json())
    broken["mounting"]["height_m"] = "high"
    with pytest.raises(SensorError, match="height_m"):
        SensorProfile.from_json(json.dumps(broken))
    broken["mounting"] = {"height_m": 1.0}
    with pytest.raises(SensorError, match="mounting lacks origin_m"):
        SensorProfile.from_json(json.dumps(broken))


def test_scans_of_the_training_vehicle_are_not_moved(scans: list[NDArray[np.float32]]) -> None:
    frame = ModelFrame(MODEL_MOUNTING)
    assert frame.is_identity
    assert frame.move(scans[0]) is scans[0]
    with pytest.raises(OptionError, match=r"boxes\[0\] is 3; expected a Box"):
        frame.move_boxes([3])  # type: ignore[list-item]
    for unknown in (Mounting(), None):
        with pytest.raises(OptionError, match=r"mounting is .*; expected one with a height_m"):
            ModelFrame(unknown)  # type: ignore[arg-type]


@given(mountings, st.integers(0, 2**32 - 1))
def test_moved_points_lie_where_the_rule_says(mounting: Mounting, seed: int) -> None:
    """v = R (p - origin) + height in the vehicle frame; the models' frame is the training vehicle's sensor."""
    points = np.random.default_rng(seed).normal(0.0, 20.0, (50, 4)).astype(np.float32)
    points[::7] = np.nan
    vehicle = (points[:, :3] - [*mounting.origin_m, 0.0]) @ mounting.rotation().T + [0.0, 0.0, mounting.height_m]
    expected = (vehicle - [0.0, 0.0, 1.73]) @ MODEL_MOUNTING.rotation()
    moved = ModelFrame(mounting).move(points)
    np.testing.assert_allclose(moved[:, :3], expected, atol=1e-3)
    np.testing.assert_array_equal(moved[:, 3], points[:, 3])
    assert moved.dtype == np.float32
    assert len(ModelFrame(mounting).move(points[:0])) == 0
    named = np.rec.fromarrays(points.T[::-1], names="intensity,z,y,x")
    np.testing.assert_array_equal(ModelFrame(mounting).move(named), moved)
    assert ModelFrame(mounting).move(points[:, :3]).shape == (50, 4)  # a kernel that expects four wrote past the end


@pytest.mark.parametrize("kind", ["random", "empty", "one", "not finite", "huge"])
def test_the_kernel_agrees_with_its_twin(kind: str) -> None:
    points = np.random.default_rng(1).normal(0.0, 30.0, (200, 4)).astype(np.float32)
    if kind == "huge":
        points *= np.float32(3e36)
    if kind == "not finite":
        points[::3, 1], points[::5, 3] = np.inf, np.nan
    points = points[: {"empty": 0, "one": 1}.get(kind, 200)]
    frame = ModelFrame(Mounting(2.0, 3.0, -5.0, 70.0, (1.0, 2.0)))
    found = np.empty_like(points)
    fill_moved(points, frame.R, frame.t, found)
    np.testing.assert_array_equal(found, twins.frame.moved(points, frame.R, frame.t))
    for angle_rad in (0.0, math.pi / 2, math.pi, 2.0):
        np.testing.assert_array_equal(turned(points, angle_rad), twins.frame.turned(points, angle_rad))


@given(mountings, st.floats(-3.0, 3.0))
def test_boxes_come_back(mounting: Mounting, yaw: float) -> None:
    box = Box("car", 0.5, (12.0, -3.0, -0.9), (4.0, 1.8, 1.5), yaw)
    frame = ModelFrame(replace(mounting, roll_deg=0.0, pitch_deg=0.66))
    (back,) = frame.boxes_back(frame.move_boxes([box]))
    np.testing.assert_allclose(back.center, box.center, atol=1e-6)
    assert math.remainder(back.yaw - box.yaw, 2 * math.pi) == pytest.approx(0.0, abs=0.02)
    assert (back.label, back.score, back.size) == (box.label, box.score, box.size)


@pytest.mark.parametrize(
    "mounting",
    [
        Mounting(1.73, 0.0, 0.0, 0.0),
        Mounting(2.9, 4.0, -6.0, 0.0),
        Mounting(0.6, -5.0, 3.0, 0.0),
        Mounting(-0.3, 2.0, 2.0, 0.0),
        Mounting(3.8, 0.0, 8.0, 0.0),
    ],
)
def test_height_and_tilt_are_found(scans: list[NDArray[np.float32]], mounting: Mounting) -> None:
    estimator = MountingEstimator(Mounting())
    for scan in scans:
        estimator = estimator.add(seen_by(mounting, scan))
        found = estimator.estimate()
    assert found.n_scans == 3
    assert found.mounting.height_m == pytest.approx(mounting.height_m, abs=0.05)
    assert tilt_of(found.mounting) == pytest.approx(tilt_of(mounting), abs=0.5)
    assert found.mounting.yaw_deg == 0.0
    assert found.yaw_sd_deg == 0.0 < min(found.height_sd_m, found.roll_sd_deg, found.pitch_sd_deg)
    assert "height" in str(found)


def test_real_scans_give_the_applied_mounting_and_an_honest_uncertainty(kitti_root: Path) -> None:
    """Single scans of 26 drives, as recorded, and as a tilted and raised sensor would have recorded them."""
    files = sorted((kitti_root / "training" / "velodyne").glob("*.bin"))[254:374:2]
    rng = np.random.default_rng(0)
    errors, changes = [], []
    for file in files:
        scan = np.fromfile(file, np.float32).reshape(-1, 4)
        own = MountingEstimator(Mounting()).add(scan).estimate()
        m = own.mounting
        sds = np.array([own.height_sd_m, own.roll_sd_deg, own.pitch_sd_deg])
        errors.append((np.array([m.height_m, m.roll_deg, m.pitch_deg]) - [1.75, -0.2, 0.66]) / sds)
        applied = Mounting(rng.uniform(0.8, 3.0), rng.uniform(-8.0, 8.0), rng.uniform(-8.0, 8.0), 0.0)
        moved = MountingEstimator(Mounting()).add(seen_by(applied, scan)).estimate().mounting
        whole = Mounting.from_matrix(np.block([[m.rotation() @ applied.rotation(), np.zeros((3, 1))], [np.eye(4)[3:]]]))
        raised = m.height_m + applied.height_m - 1.73
        changes.append(
            [(moved.height_m or 0.0) - raised, (moved.roll_deg or 0.0) - (whole.roll_deg or 0.0),
             (moved.pitch_deg or 0.0) - (whole.pitch_deg or 0.0)]
        )  # fmt: skip
    near = np.abs(np.array(changes)) < [0.05, 0.5, 0.5]
    assert (near.mean(axis=0) >= 0.95).all(), near.mean(axis=0)
    within = np.abs(np.array(errors)) < 2.0
    assert (within.mean(axis=0) >= 0.9).all(), within.mean(axis=0)


@pytest.mark.parametrize("yaw_deg", [-90.0, 180.0, 37.0, -45.0])
def test_a_turned_scan_is_leveled_as_the_same_scan_ahead(scans: list[NDArray[np.float32]], yaw_deg: float) -> None:
    """The tilt of the training vehicle, and what streets differ by, are about the vehicle's axes, not the scan's."""
    for tilt in ((0.0, 0.0), (2.0, -0.8), (0.0, 3.0)):
        scan, turn = seen_by(Mounting(1.73, *tilt, 0.0), scans[0]), Mounting(0.0, 0.0, 0.0, yaw_deg).rotation()
        ahead = MountingEstimator(Mounting()).add(scan).mounting()
        scan[:, :3] = scan[:, :3] @ turn
        aside = MountingEstimator(Mounting(yaw_deg=yaw_deg)).add(scan).mounting()
        np.testing.assert_allclose(ModelFrame(aside).R, ModelFrame(ahead).R @ turn, atol=1e-3)
    unseen = MountingEstimator(Mounting(yaw_deg=yaw_deg)).mounting()
    np.testing.assert_allclose(ModelFrame(unseen).R, turn, atol=1e-3)


def test_given_values_are_kept(scans: list[NDArray[np.float32]]) -> None:
    known = Mounting(height_m=2.0, yaw_deg=0.0)
    found = MountingEstimator(known).add(seen_by(Mounting(2.6, 3.0, 0.0, 0.0), scans[0])).estimate()
    assert found.mounting.height_m == 2.0
    assert found.height_sd_m == 0.0
    assert found.mounting.roll_deg == pytest.approx(3.0, abs=0.5)
    whole = MountingEstimator(MODEL_MOUNTING)
    assert whole.is_complete
    assert whole.add(scans[0]) is whole
    assert whole.estimate().mounting == MODEL_MOUNTING


@pytest.mark.parametrize("yaw_deg", [-70.0, -20.0, 0.0, 35.0])
def test_the_street_gives_the_yaw_when_asked(scans: list[NDArray[np.float32]], yaw_deg: float) -> None:
    turned = seen_by(Mounting(2.0, 2.0, -2.0, yaw_deg), scans[0])
    found = MountingEstimator(Mounting(yaw_deg=None)).add(turned).estimate()
    assert found.mounting.yaw_deg == pytest.approx(yaw_deg, abs=5.0)
    assert found.yaw_sd_deg > 0.0


def test_a_few_scans_settle_it(scans: list[NDArray[np.float32]]) -> None:
    estimator = MountingEstimator(Mounting())
    for _ in range(FROZEN_AFTER):
        assert not estimator.is_complete
        estimator = estimator.add(scans[0])
    assert estimator.is_complete
    assert estimator.add(seen_by(Mounting(3.0, 0.0, 0.0, 0.0), scans[0])) is estimator


def no_ground(kind: str) -> NDArray[np.float32]:
    scan = np.random.default_rng(0).normal(0.0, 10.0, (20_000, 4)).astype(np.float32)
    if kind == "wall":
        scan[:, 0] = 8.0
    scan *= np.float32({"not finite": math.nan, "huge": 1e30}.get(kind, 1.0))
    if kind == "identical":
        scan[:] = scan[0]
    return scan[: {"few": 5, "one": 1, "empty": 0}.get(kind, len(scan))]


@pytest.mark.parametrize("kind", ["cloud", "wall", "few", "one", "empty", "not finite", "identical", "huge"])
def test_scans_without_ground_are_refused(kind: str) -> None:
    estimator = MountingEstimator(Mounting(yaw_deg=None))
    with pytest.raises(MountingError, match="ground"):
        estimator.add(no_ground(kind))
    with pytest.raises(MountingError, match="ground"):
        estimator.estimate()
    assert estimator.mounting() == MODEL_MOUNTING


def test_what_streets_differ_by_is_not_corrected(scans: list[NDArray[np.float32]]) -> None:
    nearly, clearly = (
        MountingEstimator(Mounting()).add(seen_by(Mounting(1.8, 1.0, 0.5 + extra, 0.0), scans[0])).mounting()
        for extra in (0.0, 2.0)
    )
    assert nearly == MODEL_MOUNTING
    assert clearly.pitch_deg == pytest.approx(2.5, abs=0.5)


@pytest.mark.parametrize(
    "mounting",
    [Mounting(2.5, 0.0, 0.0, 0.0), Mounting(1.73, 5.0, -4.0, 0.0), Mounting(-0.2, -3.0, 2.0, -90.0)],
    ids=["raised", "tilted", "of a vehicle frame, turned"],
)
def test_answers_do_not_depend_on_the_mounting(scans: list[NDArray[np.float32]], mounting: Mounting) -> None:
    """Found or given: nearly the same labels, and boxes in the frame of the scan."""
    usual = Perceiver(mounting=Mounting(1.73, 0.0, 0.0, 0.0), provider="cpu", on_mismatch="raise")(scans[0])
    scan = seen_by(mounting, scans[0])
    estimated = Perceiver(mounting=Mounting(yaw_deg=mounting.yaw_deg), provider="cpu", on_mismatch="raise")
    assert estimated.mounting is None
    for perceive in (estimated, Perceiver(mounting=mounting, provider="cpu", on_mismatch="raise")):
        found = perceive(scan)
        objects = usual.require_points().labels > 0
        assert (found.require_points().labels == usual.require_points().labels).mean() > 0.97
        assert (found.require_points().labels[objects] == usual.require_points().labels[objects]).mean() > 0.85
        assert found.require_top_view().drivable_area_m2 == pytest.approx(
            usual.require_top_view().drivable_area_m2, rel=0.1
        )
        assert found.mounting.height_m == pytest.approx(mounting.height_m, abs=0.1)
        assert found.to_dict()["mounting"] == found.mounting.to_dict()
        assert perceive.mounting is not None
        # Vehicles that both are sure of lie in the same place of the scan.
        sure = [box for box in usual.boxes if box.label == "car" and box.score > 0.55]
        assert sure
        places = seen_by(mounting, np.array([[*box.center, 0.0] for box in sure], np.float32))[:, :3]
        centers = np.array([box.center for box in found.boxes])
        near = np.linalg.norm(places[:, None] - centers, axis=2).min(axis=1)
        assert (near < 0.5).mean() >= 0.75


def test_the_mounting_is_settled_over_scans_and_refused_scans_teach_nothing(scans: list[NDArray[np.float32]]) -> None:
    perceive = Perceiver("pointseg", provider="cpu")
    raised = seen_by(Mounting(2.6, 0.0, 0.66, 0.0), scans[0])
    for _ in range(FROZEN_AFTER):
        perceive(raised)
    assert perceive.mounting.n_scans == FROZEN_AFTER
    assert perceive(scans[0]).mounting.height_m == pytest.approx(2.6, abs=0.05)
    other = Perceiver("pointseg", provider="cpu", on_mismatch="raise")
    bad = raised.copy()
    bad[:, 3] = 255.0
    with pytest.raises(FitnessError):
        other(bad)
    assert other.mounting is None


def test_a_scan_without_ground_is_told_of(scans: list[NDArray[np.float32]]) -> None:
    scan = scans[0][(scans[0][:, 2] > -1.6) | (np.hypot(*scans[0][:, :2].T) < 3.0)]  # hardly any of the road
    perceive = Perceiver("pointseg", provider="cpu", on_mismatch="warn")
    with (
        pytest.warns(UserWarning, match="--mount-height"),
        pytest.warns(UserWarning, match="lowest 29 of the sensor's beams have no returns.*ground was taken out"),
    ):
        found = perceive(scan)
    assert found.mounting == MODEL_MOUNTING
    with pytest.raises(OptionError, match="expected a Mounting"):
        Perceiver("pointseg", mounting=1.7, provider="cpu")  # type: ignore[arg-type]


@pytest.mark.parametrize("yaw_deg", [0.0, 90.0, -135.0])
def test_a_sensor_that_hangs_is_described(yaw_deg: float) -> None:
    """The scan of a sensor turned by 180 degrees about x lies where that of a level one does."""
    points = np.random.default_rng(3).normal(0.0, 9.0, (200, 4)).astype(np.float32)
    level = Mounting(2.1, 0.0, 0.0, yaw_deg)
    hanging = points * np.float32([1, -1, -1, 1])
    T_vehicle_sensor = np.eye(4)
    T_vehicle_sensor[:3, :3], T_vehicle_sensor[2, 3] = level.rotation() @ np.diag([1.0, -1.0, -1.0]), 2.1
    for mounting in (Mounting(2.1, 180.0, 0.0, yaw_deg), Mounting.from_matrix(T_vehicle_sensor)):
        np.testing.assert_allclose(ModelFrame(mounting).move(hanging), ModelFrame(level).move(points), atol=1e-4)


@pytest.mark.parametrize(
    ("sensor", "height_m"),
    [
        *product(("os1-64", "pandar64"), (3.5, 6.5)),
        *product(("hdl-64e", "vlp-16"), (5.0, 8.0)),
        *product(("os0-64",), (3.5, 8.0)),
    ],
)
def test_high_sensors_are_found_from_the_ground(sensor: str, height_m: float) -> None:
    """On a truck, a pole or a crane: no ground may be seen within 12 m."""
    errors = []
    for seed in (1, 2, 3):  # in the second, the land is half a meter lower than the road
        points = above(height_m, sensor, seed)
        found = MountingEstimator(Mounting()).add(points)
        assert not found.doubtful()
        assert found.mounting().height_m == found.estimate().mounting.height_m
        errors.append(abs((found.mounting().height_m or 0.0) - height_m))
        given = MountingEstimator(Mounting(height_m)).add(points).mounting()
        assert given.height_m == height_m
        assert given.roll_deg == pytest.approx(0.0, abs=1.0)
    assert np.median(errors) < 0.1
    assert max(errors) < 0.6


@pytest.mark.parametrize(
    ("sensor", "seed", "height_m"),
    [
        *(("vlp-16", 5, 8.0), ("os1-64", 5, 5.0), ("hdl-64e", 5, 6.5)),
        *(("mid-360", 2 * 10**9 + seed, height_m) for seed, height_m in ((101, 2.2), (105, 2.2), (111, 3.0))),
    ],
)
def test_a_height_that_is_found_from_little_ground_is_said(sensor: str, seed: int, height_m: float) -> None:
    profile = replace(get_sensor(sensor), remission=None, remission_range=(0.0, 1.0))
    points = simulated_scan(seed, replace(profile, mounting=Mounting(height_m))).points
    told = "sees little of the road near by, and its height may be off by a meter: pass mounting="
    for known in (Mounting(), Mounting(height_m), Mounting(height_m, 0.0, 0.0)):
        with warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter("always")
            found = Perceiver(["ssadnet"], sensor=profile, mounting=known, on_mismatch="warn")(points)
        for sentences in (found.fitness, [str(each.message) for each in shown]):
            assert sum(told in sentence for sentence in sentences) == (known.height_m is None)
        assert known.height_m in (None, found.mounting.height_m)


def test_heights_above_uneven_land_are_nearly_found() -> None:
    errors = []
    for sensor, height_m, seed in product(("os1-64", "hdl-64e", "pandar64", "vlp-16"), (3.0, 5.0, 6.5), range(40, 42)):
        points = simulated_scan(seed, replace(get_sensor(sensor), mounting=Mounting(height_m))).points
        found = MountingEstimator(Mounting()).add(points).mounting().height_m
        errors.append(abs((found or 0.0) - height_m))
    assert np.quantile(errors, 0.9) < 0.5
    assert np.median(errors) < 0.2


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(4.0, -3.0), (0.0, 8.0), (-5.0, 5.0)])
def test_high_sensors_that_lean_are_found(roll_deg: float, pitch_deg: float) -> None:
    level = above(6.0, "os1-64", 3)
    level[:, 2] += 6.0 - 1.73
    found = MountingEstimator(Mounting()).add(seen_by(Mounting(6.0, roll_deg, pitch_deg, 0.0), level)).mounting()
    assert found.height_m == pytest.approx(6.0, abs=0.2)
    assert tilt_of(found) == pytest.approx((roll_deg, pitch_deg), abs=1.0)


@pytest.mark.parametrize("seed", range(1, 7))
def test_land_below_a_bridge_is_not_its_road(seed: int) -> None:
    """A road 8 m wide, and land 6 m lower; the deck hides what is near."""
    points = above(1.73, "hdl-64e", seed)
    beside = np.abs(points[:, 1]) > 4.0
    points[beside, 2] -= 6.0
    seen = points[~beside | (np.abs(points[:, 1]) > 17.0)]
    assert MountingEstimator(Mounting()).add(seen).mounting().height_m == pytest.approx(1.73, abs=0.1)


@pytest.mark.parametrize("height_m", [0.5, 1.73, 3.0])
@pytest.mark.parametrize("sensor", ["vlp-16", "os1-64", "os0-64"])
def test_a_sensor_that_hangs_needs_no_height(sensor: str, height_m: float) -> None:
    """Its ground is above it in the scan; the tilt that is given says so."""
    hanging = above(height_m, sensor, 1) * np.float32([1, -1, -1, 1])
    for known in (Mounting(roll_deg=180.0), Mounting(roll_deg=180.0, pitch_deg=0.0), Mounting(roll_deg=-180.0)):
        found = MountingEstimator(known).add(hanging).estimate().mounting
        assert found.height_m == pytest.approx(height_m, abs=0.15)
        assert found.roll_deg == known.roll_deg
        assert found.pitch_deg == pytest.approx(0.0, abs=0.7)


@pytest.mark.parametrize(
    ("height_m", "seed", "mounting"),
    [
        (1.73, 1, (5.0, -4.0)),
        (1.73, 3, (-4.0, 3.0)),
        (1.73, 4, (5.0, -4.0)),
        (2.2, 1, (-4.0, 3.0)),
        (3.0, 4, (5.0, -4.0)),
    ],
)
def test_a_sensor_that_looks_up_is_found_from_the_road_far_away(
    height_m: float, seed: int, mounting: tuple[float, float]
) -> None:
    """An upright Mid-360 sees the road from 14 m on."""
    level = above(height_m, "mid-360", seed)
    level[:, 2] += height_m - 1.73
    scan = seen_by(Mounting(height_m, *mounting, 0.0), level)
    for known in (Mounting(), Mounting(height_m)):
        found = MountingEstimator(known).add(scan).mounting()
        assert found.height_m == pytest.approx(height_m, abs=0.1)
        assert tilt_of(found) == pytest.approx(mounting, abs=0.7)


def bank(toward_deg: float, walls_deg: float) -> NDArray[np.float32]:
    """A lawn that rises by 14 degrees from 5 m on, 2.5 m wide in view, and walls about the sensor."""
    rng = np.random.default_rng(0)
    away, along = rng.uniform(5.0, 10.0, 4000), rng.uniform(-9.0, 9.0, 4000)
    lawn = np.column_stack([away, along, 0.25 * away - 3.2])
    azimuth = np.radians(rng.uniform(-walls_deg, walls_deg, 8000))
    walls = np.column_stack([20.0 * np.cos(azimuth), 20.0 * np.sin(azimuth), rng.uniform(0.5, 6.0, 8000)])
    xyz = np.vstack([lawn, walls]) @ Mounting(0.0, 0.0, 0.0, toward_deg).rotation().T
    return np.column_stack([xyz, np.full(len(xyz), 0.3)]).astype(np.float32)


@pytest.mark.parametrize("toward_deg", [-90.0, 0.0, 90.0, 180.0])
def test_a_bank_beside_the_sensor_is_no_ground_below_it(toward_deg: float) -> None:
    with pytest.raises(MountingError, match="ground"):
        MountingEstimator(Mounting()).add(bank(toward_deg, 180.0))
    # Of a sensor that looks to one side, it is all there is.
    found = MountingEstimator(Mounting()).add(bank(toward_deg, 50.0)).estimate().mounting
    assert found.height_m == pytest.approx(3.1, abs=0.2)


Surface = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]
UNEVEN: dict[str, Surface] = {
    "a ramp ahead": lambda x, y: 0.06 * np.maximum(x, 0.0),
    "a ridge": lambda x, y: -0.06 * np.abs(x - 5.0),
    "a bank": lambda x, y: 0.1 * np.maximum(y - 1.0, 0.0) + 0.05 * y,
    "a twisted street": lambda x, y: 0.006 * x * y + 0.05 * x,
}


@pytest.mark.parametrize("surface", UNEVEN)
def test_one_scan_of_uneven_ground_does_not_level_the_sensor(scans: list[NDArray[np.float32]], surface: str) -> None:
    scan = scans[0].copy()
    scan[:, 2] += UNEVEN[surface](scan[:, 0], scan[:, 1])
    found = MountingEstimator(Mounting()).add(scan)
    assert found.doubtful()
    for name in found.doubtful():
        assert abs(getattr(found.estimate().mounting, name)) > 1.5
        assert getattr(found.mounting(), name) == getattr(MODEL_MOUNTING, name)
    # Even ground of the same slope is a tilt as far as the models are concerned, and so is one that several scans show.
    scan = scans[0].copy()
    scan[:, 2] += 0.05 * scan[:, 1] - 0.06 * scan[:, 0]
    even = MountingEstimator(Mounting()).add(scan)
    assert not even.doubtful()
    assert tilt_of(even.mounting()) == pytest.approx((-2.9, -3.4), abs=0.5)
    for _ in range(4):
        found = found.add(seen_by(Mounting(1.73, 5.0, -4.0, 0.0), scans[1]))
    assert not found.doubtful()
    assert tilt_of(found.mounting()) == pytest.approx((5.0, -4.0), abs=0.7)


@pytest.mark.parametrize(
    ("known", "doubtful"),
    [(Mounting(), True), (Mounting(1.73), True), (Mounting(pitch_deg=0.5), False), (Mounting(1.73, 0.0, 0.5), False)],
)
def test_a_doubtful_tilt_is_told_of(scans: list[NDArray[np.float32]], known: Mounting, doubtful: bool) -> None:
    scan = scans[0].copy()
    scan[:, 2] += UNEVEN["a ramp ahead"](scan[:, 0], scan[:, 1])
    perceive = Perceiver("pointseg", mounting=known, provider="cpu")
    with pytest.warns(UserWarning, match="--pitch") if doubtful else contextlib.nullcontext():
        found = perceive(scan)
    told = [sentence for sentence in found.fitness if "--pitch" in sentence]
    assert len(told) == doubtful
    assert found.mounting.pitch_deg == (0.66 if doubtful else 0.5)


@pytest.mark.parametrize(
    ("known", "is_told"),
    [
        (Mounting(1.73, 0.0, 8.0), False),
        (Mounting(1.73, 0.0, -8.0), True),  # the other direction
        (Mounting(pitch_deg=-8.0), True),
        (Mounting(roll_deg=0.0), False),
        (Mounting(1.73, 30.0, 8.0), True),  # so far off that there is no ground
    ],
)
def test_a_given_tilt_that_is_not_the_grounds_is_told_of(
    scans: list[NDArray[np.float32]], known: Mounting, is_told: bool
) -> None:
    scan = seen_by(Mounting(1.73, 0.0, 8.0, 0.0), scans[0])
    perceive = Perceiver("pointseg", mounting=known, provider="cpu", on_mismatch="warn")
    with (
        pytest.warns(UserWarning, match="ground shows a roll of .* and a pitch of 8.* Correct")
        if is_told
        else (contextlib.nullcontext())
    ):
        found = perceive(scan)
    assert any("ground shows a roll" in sentence for sentence in found.fitness) == is_told
    hanging = seen_by(Mounting(1.73, 178.0, 0.0, 0.0), scans[0])  # a roll of -179 is near
    assert MountingEstimator(Mounting(1.73, -179.0, 0.0)).contradicted_by(hanging) is None


def test_boxes_of_a_sensor_that_lies_are_told_of(scans: list[NDArray[np.float32]]) -> None:
    """As clouds in the axes of a camera, with the transform to the vehicle as mounting."""
    mounting = Mounting(1.73, -90.0, 0.0, -90.0)
    with pytest.warns(UserWarning, match="tilts the axes of the scan by 90 deg, and boxes have no tilt"):
        Perceiver("pointseg", mounting=mounting, provider="cpu")(seen_by(mounting, scans[0]))


def test_the_ground_around_a_bridge_is_no_tilt(data_root: Callable[[str], Path]) -> None:
    """A crowd on a bridge over a canal; the sensor is level."""
    scan = np.fromfile(data_root("other_roads") / "vod" / "velodyne" / "01201.bin", np.float32).reshape(-1, 4)
    found = MountingEstimator(Mounting()).add(scan)
    assert set(found.doubtful()) == {"roll_deg", "pitch_deg"}
    assert found.mounting() == MODEL_MOUNTING
