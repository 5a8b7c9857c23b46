"""The comparison of KISS-ICP with and without what moves: its figures, by drives of known motion."""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edgeperc import MissingExtraError, Perception
from edgeperc_bench.peers import slam
from scenes import box


def turned(degrees: float, *place: float) -> NDArray[np.float64]:
    pose = np.eye(4)
    a = math.radians(degrees)
    pose[:2, :2] = [[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]
    pose[:3, 3] = place
    return pose


def ways(n: int = 20, step: float = 0.8) -> NDArray[np.float64]:
    """Poses along a curve."""
    return np.array([turned(2.0 * k, step * k, 0.02 * k * k, 0.0) for k in range(n)])


def test_the_error_of_a_trajectory_is_that_after_the_best_alignment() -> None:
    true = ways()
    moved = turned(70.0, 5.0, -3.0, 1.0) @ true
    assert slam.trajectory_error(true, moved) == pytest.approx(0.0, abs=1e-9)
    wrong = true.copy()
    wrong[::2, 2, 3] += 0.4  # every second pose 0.2 m above the mean, the others as much below
    assert slam.trajectory_error(true, wrong) == pytest.approx(0.2, abs=0.01)
    helix = true.copy()
    helix[:, 2, 3] = np.sin(np.arange(20) / 3.0)
    mirrored = helix.copy()
    mirrored[:, 1, 3] *= -1.0
    assert slam.trajectory_error(helix, mirrored) > 0.2  # a mirror is no rigid motion
    # Errors of steps are in the frame of the sensor.
    np.testing.assert_allclose(slam.step_errors(true, moved), 0.0, atol=1e-9)
    jump = true.copy()
    jump[10:, 1, 3] += 0.3
    np.testing.assert_allclose(slam.step_errors(true, jump), [0.0] * 9 + [0.3] + [0.0] * 9, atol=1e-9)


def test_the_way_back_closes() -> None:
    given: list[int] = []

    def drifting(scans: Any) -> NDArray[np.float64]:
        given.extend(len(points) for points in scans)
        return np.array([turned(0.0, 0.1 * k, 0.0, 0.0) for k in range(len(scans))])

    poses, gap = slam.closure(drifting, [np.zeros((k + 1, 4), np.float32) for k in range(4)])
    assert given == [1, 2, 3, 4, 3, 2, 1]
    assert len(poses) == 4
    assert gap == pytest.approx(0.4)  # of the second scan: its poses are those of the second and the sixth


def test_cells_of_a_map_with_a_moving_point_are_counted_once() -> None:
    scan = np.array([[0.1, 0.1, 0.1, 0], [0.15, 0.1, 0.1, 0], [1.1, 0.1, 0.1, 0], [2.1, 0.1, 0.1, 0]], np.float32)
    moving = np.array([False, True, True, False])
    poses, whole = np.array([np.eye(4), turned(0.0, slam.CELL_M, 0.0, 0.0)]), np.ones(4, np.bool_)
    assert slam.ghost_share([scan[:, :]] * 2, [whole] * 2, [moving] * 2, poses[[0, 0]]) == pytest.approx(2 / 3)
    assert slam.ghost_share([scan] * 2, [whole] * 2, [moving] * 2, poses) == pytest.approx(4 / 6)
    assert slam.ghost_share([scan] * 2, [~moving] * 2, [moving] * 2, poses) == 0.0
    assert slam.ghost_share([scan], [~whole], [moving], poses[:1]) == 0.0


def test_labels_move_by_their_motion_over_ground() -> None:
    """From a vehicle at 8 m/s: one car ahead that is as fast, one parked; one that sets off after two seconds."""
    labels, poses = [], []
    for k in range(40):
        way = 0.8 * k
        later = 60.0 + 0.5 * max(0, k - 20) - way
        labels.append([box(12.0, 0.0), box(45.0 - way, 6.0), box(later, -4.0)])
        poses.append(turned(0.0, way, 0.0, 0.0))
    found = slam.moving_boxes(labels, np.array(poses))
    assert all(labels[k][0] in boxes for k, boxes in enumerate(found))  # from the first scan on
    assert not any(labels[k][1] in boxes for k, boxes in enumerate(found))
    assert not any(labels[k][2] in boxes for k, boxes in enumerate(found[:10]))
    assert all(labels[k][2] in boxes for k, boxes in enumerate(found) if k > 24)


def drive_with_a_car(n: int = 16) -> tuple[slam.Drive, Any]:
    """Scans of walls and of a car that keeps its distance, with its labels; and what perceives its box."""
    rng = np.random.default_rng(0)
    wall = rng.uniform([0.0, 8.0, -1.0], [60.0, 9.0, 1.0], (400, 3))
    on_car = rng.uniform([10.2, -0.8, -0.6], [13.8, 0.8, -0.2], (100, 3))
    scans, poses, moving = [], [], []
    for k in range(n):
        pose = turned(0.0, 0.8 * k, 0.0, 0.0)
        points = np.concatenate([wall - pose[:3, 3], on_car])
        scans.append(np.column_stack([points, np.zeros(len(points))]).astype(np.float32))
        poses.append(pose)
        moving.append(np.arange(len(points)) >= 400)
    every = [np.ones(500, np.bool_)] * n
    parked = [[box(25.0 + 7.0 * i - 0.8 * k, -6.0 if i % 2 else 6.0) for i in range(4)] for k in range(n)]
    drive = slam.Drive(
        "d", scans, np.array(poses), moving, every, every, [[box(12.0, 0.0), *parked[k]] for k in range(n)]
    )

    def perceive(points: NDArray[np.float32], stamp_s: float) -> Perception:
        boxes = (box(12.0, 0.0), *parked[round(10.0 * stamp_s)])
        return Perception(len(points), 0, None, None, boxes, {}, {}, (), stamp_s)

    return drive, perceive


def test_the_rows_of_a_drive() -> None:
    drive, perceive = drive_with_a_car()
    seen = slam.look(perceive, drive)
    assert [len(masks) for masks in seen.kept.values()] == [16, 16, 16, 16]
    assert not seen.kept["without moving"][-1][400:].any()
    assert seen.kept["without moving"][-1][:400].all()
    poses = np.concatenate([drive.poses, drive.poses[-2::-1]])
    (whole, still, known, parked), motion = slam.compared(drive, seen, lambda scans: poses)
    assert motion[:4] == ["d", "truth", "0.000 m", "0.000 m"]
    assert 0.0 < float(motion[4].removesuffix(" m")) < 0.1  # the parked cars show the motion
    assert float(motion[5].removesuffix(" m")) >= float(motion[4].removesuffix(" m"))
    assert whole[:5] == ["d", "all points", "16, 12 m", "0.000 m", "0.000 m"]
    shares = [float(row[5].removesuffix(" %")) for row in (whole, still, parked, known)]
    assert shares[0] > 2.0 * shares[1] > 0.0  # until the track is sure, the car is in the map
    assert shares[2:] == [0.0, 0.0]  # in hindsight it is not
    assert [row[6] for row in (whole, still, known)] == ["0.00 %"] * 3
    assert whole[7] == "-"
    assert float(still[7]) >= 0.0
    unknown = slam.Drive("r", drive.scans, None, None, drive.usable, drive.known, drive.labels)
    (labeled, first, _, second, _), motion = slam.compared(unknown, seen, lambda scans: poses, second_pass=True)
    assert motion[1:4] == ["KISS-ICP", "-", "-"]
    assert [first[1], second[1]] == ["without moving", "same, second pass"]
    assert 0.0 < float(second[5].removesuffix(" %")) <= shares[1]  # known poses leave less doubt
    assert labeled[3] == "-"
    assert labeled[5] == whole[5]  # the labels say the same as the points


def test_kiss_icp_follows_a_drawn_street() -> None:
    pytest.importorskip("kiss_icp")
    drive = next(slam.drawn_streets(6))
    assert any(mask.any() for mask in drive.moving)
    poses, gap = slam.closure(
        slam.kiss_icp, slam.chosen(drive, [np.ones(len(points), np.bool_) for points in drive.scans])
    )
    assert poses.shape == (6, 4, 4)
    assert slam.trajectory_error(drive.poses, poses) < 0.1
    assert gap < 0.05


def test_a_missing_extra_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["slam"])
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    with pytest.raises(MissingExtraError, match=r"edgeperc\[slam\]"):
        slam.main()
