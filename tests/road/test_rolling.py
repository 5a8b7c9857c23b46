"""The grid with memory: posts on a level road, seen, hidden, gone and driven past."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import edgeperc
from edgeperc import (
    Box,
    Mounting,
    OptionError,
    Perception,
    PointLabels,
    PointsError,
    RollingGrid,
    StampError,
    TopView,
    Tracker,
    TrackingError,
    occupancy_grid,
)
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import simulate_sequence

ROAD_M = -1.73
Post = tuple[float, float]  # its middle in the odometry's frame; 1 m wide and high


def pose(x: float = 0.0, y: float = 0.0, yaw_deg: float = 0.0, z: float = 0.0) -> NDArray[np.float64]:
    cos, sin = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.array([[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def scan(
    at: NDArray[np.float64], posts: Sequence[Post] = (), *, within_m: float = 12.0, hidden: Sequence[Post] = ()
) -> NDArray[np.float32]:
    """Ground every 0.25 m around the sensor, and the faces of posts; nothing from what is ``hidden``, or behind it."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-within_m, within_m, 0.25)]))
    x, y = x[np.hypot(x, y) > 1.0], y[np.hypot(x, y) > 1.0]
    world = at[:2, :2] @ [x, y] + at[:2, 3:]
    for post in posts:
        world = world[:, (np.abs(world - np.array(post)[:, None]) > 0.5).any(axis=0)]
    for post in hidden:
        way, rays = np.array(post) - at[:2, 3], world - at[:2, 3:]
        length = np.hypot(*way)
        along, across = way @ rays / length, np.abs(way[0] * rays[1] - way[1] * rays[0]) / length
        world = world[:, (along < length - 1.5) | (across > 1.5 * np.maximum(along / length, 1.0))]
    rows = [np.vstack([world, np.full(world.shape[1], at[2, 3] + ROAD_M)])]
    for a, b in posts:
        u, z = (axis.ravel() for axis in np.meshgrid(np.arange(-0.45, 0.5, 0.1), np.arange(0.1, 1.05, 0.1)))
        side = np.full(len(u), 0.45)
        sides = [(a + u, b + side), (a + u, b - side), (a + side, b + u), (a - side, b + u)]
        rows += [np.vstack([east, north, at[2, 3] + ROAD_M + z]) for east, north in sides]
        rows.append(np.vstack([a + u, b - 0.55 + z, np.full(len(u), at[2, 3] + ROAD_M + 1.05)]))
    points = at[:3, :3].T @ (np.hstack(rows) - at[:3, 3:])
    return np.column_stack([points.T, np.full(points.shape[1], 0.3)]).astype(np.float32)


def perceived(points: NDArray[np.float32], stamp_s: float | None, **changes: Any) -> Perception:
    return replace(Perception(len(points), 0, None, None, (), {}, {}, (), stamp_s), **changes)


def value(grid: RollingGrid, x: float, y: float, **options: int) -> int:
    """As a subscriber of the message reads it."""
    message = grid.to_occupancy_grid("odom", **options)
    info, origin = message["info"], message["info"]["origin"]["position"]
    column, row = ((p - o) // info["resolution"] for p, o in ((x, origin["x"]), (y, origin["y"])))
    assert 0 <= column < info["width"]
    assert 0 <= row < info["height"]
    return int(message["data"][int(row) * info["width"] + int(column)])


def rolling(**options: Any) -> RollingGrid:
    return RollingGrid(**{"size_m": 30.0, "cell_m": 0.5, **options})


@pytest.mark.parametrize("remember_s", [1.0, 3.0, 10.0])
def test_what_is_hidden_is_remembered_and_then_forgotten(remember_s: float) -> None:
    grid, post, at = rolling(remember_s=remember_s), (6.0, 2.0), pose()
    points = scan(at, [post])
    grid.update(perceived(points, 100.0), points, at)
    assert (value(grid, *post), value(grid, 6.0, -2.0), value(grid, 14.0, 14.0)) == (100, 0, -1)
    nearby = scan(at, within_m=4.0)
    for stamp_s in np.arange(100.5, 100.0 + remember_s + 0.1, 0.5):
        grid.update(perceived(nearby, stamp_s), nearby, at)
        assert (value(grid, *post), value(grid, 6.0, -2.0)) == (100, 0)
    grid.update(perceived(nearby, 100.1 + remember_s), nearby, at)
    assert (value(grid, *post), value(grid, 6.0, -2.0), value(grid, 2.0, 0.0)) == (-1, -1, 0)


@pytest.mark.parametrize("post", [(6.0, 2.0), (-4.25, 3.1), (0.3, -7.7)])
def test_only_observation_clears(post: Post) -> None:
    grid, at = rolling(), pose()
    points = scan(at, [post])
    grid.update(perceived(points, 1.0), points, at)
    gone = scan(at, hidden=[post])
    grid.update(perceived(gone, 1.1), gone, at)
    assert value(grid, *post) == 100
    assert grid.ages_s().min() == 0.0
    assert set(grid.ages_s()[grid.values() == 100].round(6)) == {0.1}
    gone = scan(at)
    grid.update(perceived(gone, 1.2), gone, at)
    assert value(grid, *post) == 0
    assert 100 not in grid.values()


@pytest.mark.parametrize("how", ["box", "points", "track", "not at all"])
def test_what_could_move_leaves_no_trail(how: str) -> None:
    """A car drives on while the ground that it leaves is hidden; a post beside it stays."""
    grid, tracker, post = rolling(), Tracker(), (2.0, 8.0)
    for k in range(6):
        at, middle = pose(0.3 * k), (4.0 + k, -3.0)
        last = k == 5
        points = scan(at, [middle, post], hidden=[(4.0 + j, -3.0) for j in range(k)])
        place = np.linalg.inv(at) @ [*middle, ROAD_M + 0.5, 1.0]
        box = Box("car", 0.95, tuple(place[:3].tolist()), (1.2, 1.2, 1.0), 0.0)
        on_car = (np.abs(points[:, :2] - place[:2]) < 0.6).all(axis=1) & (points[:, 2] > ROAD_M + 0.05)
        labels = PointLabels(on_car.astype(np.uint8), np.ones(len(points), np.bool_), ("background", "car"))
        found = perceived(points, 10.0 + 0.1 * k, boxes=(box,) if how == "box" or (how == "track" and not last) else ())
        tracks = tracker(found, at)
        if how == "points":
            found = replace(found, points=labels)
        grid.update(found, points, at, tracks=tracks if how == "track" else ())
    assert value(grid, *post) == 100
    trail = [value(grid, 4.0 + k, -3.0) for k in range(5)]
    assert (100 in trail) == (how == "not at all")
    assert value(grid, 9.0, -3.0) == 100
    points = scan(at, hidden=[(9.0, -3.0)])  # with the next scan the car is forgotten
    if how != "not at all":
        grid.update(perceived(points, 10.6), points, at)
        assert value(grid, 9.0, -3.0) == -1


@settings(max_examples=25)
@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.floats(-180.0, 180.0), st.floats(-9.0, 9.0), st.floats(3.0, 9.0))
@example(0.0, 0.0, 0.0, 5.0, 5.0)
@example(-12.25, 0.5, 45.0, -3.3, 4.0)
def test_a_post_lies_in_its_cells_however_the_sensor_is_turned(
    x: float, y: float, yaw_deg: float, left: float, ahead: float
) -> None:
    grid, at = rolling(), pose(x, y, yaw_deg, 3.0)
    post = tuple((at @ [ahead, left, 0.0, 1.0])[:2].tolist())
    points = scan(at, [post])
    grid.update(perceived(points, 5.0), points, at)
    for dx, dy in ((0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
        # The cells of a scan are not those of the window: off by up to 0.7 of a cell.
        near = [value(grid, post[0] + dx + a, post[1] + dy + b) for a in (-0.36, 0, 0.36) for b in (-0.36, 0, 0.36)]
        assert 100 in near
    assert np.count_nonzero(grid.values() == 100) <= 25  # a post covers up to 3 by 3 cells, and the next one each
    assert grid.to_occupancy_grid()["info"]["origin"]["position"]["z"] == pytest.approx(3.0 + ROAD_M)
    assert all(0.0 <= p - o - 15.0 < 0.5 + 1e-6 for p, o in zip((x, y), grid.origin_m, strict=True))


@pytest.mark.parametrize("mounting", [Mounting(1.73, 0.0, 0.0, 90.0), Mounting(2.2, 3.0, -4.0, 0.0)])
def test_a_sensor_that_is_turned_or_tilted(mounting: Mounting) -> None:
    frame = edgeperc.ModelFrame(mounting)
    post, level = (6.0, 2.0), scan(pose(), [(6.0, 2.0)])
    points = level.copy()
    points[:, :3] = (level[:, :3] - frame.t) @ frame.R
    at = np.eye(4)
    at[:3, :3], at[:3, 3] = frame.R, frame.t
    grid = rolling()
    grid.update(perceived(points, 1.0, mounting=mounting), points, at)
    assert value(grid, *post) == 100
    assert value(grid, 2.0, 6.0) == value(grid, 2.0, -6.0) == value(grid, -6.0, 2.0) == 0


@settings(max_examples=40)
@given(st.integers(-80, 80), st.integers(-80, 80))
def test_the_window_moves_over_what_it_remembers(dx: int, dy: int) -> None:
    grid, at = rolling(), pose(0.25, 0.25)
    points, nothing = scan(at, [(6.0, 2.0), (-3.0, -5.0)]), np.zeros((0, 4), np.float32)
    grid.update(perceived(points, 1.0), points, at)
    before = grid.values()
    n = len(before)
    grid.update(perceived(nothing, 1.1), nothing, pose(0.25 + 0.5 * dx, 0.25 + 0.5 * dy))
    after = grid.values()
    for row, column in np.ndindex(after.shape):
        inside = 0 <= row + dy < n and 0 <= column + dx < n
        assert after[row, column] == (before[row + dy, column + dx] if inside else -1)
    grid.update(perceived(nothing, 1.2), nothing, at)
    kept = grid.values() != -1
    np.testing.assert_array_equal(grid.values()[kept], before[kept])


@pytest.mark.parametrize("by_points", [False, True])
def test_ground_off_the_road_stays_off_the_road_behind_the_vehicle(by_points: bool) -> None:
    """Road ahead right of y = 2 m; later, both lie beside the view and are observed all the same."""
    cells = np.ones((40, 40), np.uint8)
    cells[:, :16] = 0
    view = TopView(cells, ("background", "drivable"), 0.5, (2.0, 22.0), (-10.0, 10.0), cells >= 0)
    grid = rolling()
    for k, at in enumerate((pose(), pose(8.0), pose(8.0, 0.0, 180.0))):
        points = scan(at)
        in_view, names = (points[:, 0] > 2.0) & (k < 2), (1 + (points[:, 1] > 2.0)).astype(np.uint8)
        labels = PointLabels(names, in_view, ("background", "road", "sidewalk"))
        part: dict[str, Any] = {"points": labels} if by_points else {"top_view": view if k < 2 else None}
        grid.update(replace(perceived(points, 1.0 + k), **part), points, at)
        assert (value(grid, 4.0, -4.0), value(grid, 4.0, 4.0)) == (0, 100)
        assert (value(grid, 4.0, 4.0, off_road=50), value(grid, 4.0, 4.0, off_road=-1)) == (50, -1)
    assert value(grid, -2.0, 4.0) == 0
    assert value(grid, -2.0, 4.0, unjudged=-1) == -1


def test_late_scans_and_clocks_that_jump() -> None:
    grid, at = rolling(), pose()
    empty, posted = scan(at), scan(at, [(6.0, 2.0)])
    grid.update(perceived(posted, 100.0), posted, at)
    for stamp_s in (100.0, 99.9):
        grid.update(perceived(empty, stamp_s), empty, at)
        assert (value(grid, 6.0, 2.0), grid.stamp_s) == (100, 100.0)
    nothing = np.zeros((0, 4), np.float32)
    grid.update(perceived(nothing, 20.0), nothing, at)
    assert (value(grid, 6.0, 2.0), grid.stamp_s) == (-1, 20.0)
    grid.update(perceived(posted, 20.1), posted, at)
    patient = rolling(remember_s=100.0)
    for stamp_s, points in ((0.0, posted), (90.0, nothing)):
        patient.update(perceived(points, stamp_s), points, at)
        assert value(patient, 6.0, 2.0) == 100
    grid.reset()
    assert grid.stamp_s is None
    assert (grid.values() == -1).all()
    assert np.isinf(grid.ages_s()).all()


def test_the_largest_float_of_what_did_not_return_is_no_warning() -> None:
    grid, at = rolling(), pose()
    points = np.vstack([scan(at), np.full((1, 4), np.finfo(np.float32).max)]).astype(np.float32)
    labels = np.zeros(len(points), np.uint8)
    labels[-1] = 1
    cars = PointLabels(labels, np.ones(len(points), np.bool_), ("background", "car"))
    grid.update(replace(perceived(points, 1.0), points=cars), points, at)
    assert value(grid, 2.0, 0.0) == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"size_m": 0.0}, "size_m is 0"),
        ({"cell_m": math.nan}, "cell_m is nan"),
        ({"remember_s": -1.0}, "remember_s is -1"),
        ({"margin_m": -0.1}, "margin_m is -0.1"),
        ({"classes": None}, "expected a collection of names"),
        ({"min_height_m": 2.0}, "min_height_m is 2"),
        ({"classes": "car"}, "expected a collection of names, such as {'car'}"),
        ({"size_m": 2.0, "cell_m": 3.0}, "cell_m is 3.0; expected a number from 0.01 to 2"),
        ({"size_m": 9e3, "cell_m": 0.01}, "no grid"),
    ],
)
def test_options_that_make_no_grid(options: dict[str, Any], said: str) -> None:
    with pytest.raises(OptionError, match=said):
        RollingGrid(**options)


def test_scans_that_cannot_be_taken_in_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    grid, at = rolling(), pose()
    points = scan(at, [(6.0, 2.0)])
    grid.update(perceived(points, 1.0), points, at)
    before = grid.values()
    upright = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    hanging = np.diag([1.0, -1.0, -1.0, 1.0])  # of points that do not hang: left and right would change places
    for wrong, error, said in (
        (dict(stamp_s=None), StampError, "stamp_s="),
        (dict(stamp_s=math.nan), StampError, "stamp_s="),
        (dict(at=np.zeros((4, 4))), TrackingError, "not rigid"),
        (dict(at=pose(1e9)), TrackingError, "expected at most"),
        (dict(at=upright), TrackingError, "upright"),
        (dict(at=hanging), TrackingError, "upside down"),
        (dict(points=points[1:]), PointsError, "that was perceived"),
        (dict(tracks=[1.0]), OptionError, r"tracks\[0\] is 1\.0; expected a Track"),
    ):
        given_points = wrong.get("points", points)
        found = perceived(points, wrong.get("stamp_s", 1.1))  # type: ignore[arg-type]
        with pytest.raises(error, match=said):
            grid.update(found, given_points, wrong.get("at", at), tracks=wrong.get("tracks", ()))  # type: ignore[arg-type]
        np.testing.assert_array_equal(grid.values(), before)
        assert grid.stamp_s == 1.0
    copied = copy.copy(grid)  # as for another thread
    with monkeypatch.context() as patch:
        patch.setattr(np.linalg, "inv", Mock(side_effect=KeyboardInterrupt))  # when the window has moved
        with pytest.raises(KeyboardInterrupt):
            grid.update(perceived(points, 1.1), points, pose(3.0))
    assert (grid.stamp_s, grid.origin_m) == (1.0, (-15.0, -15.0))
    np.testing.assert_array_equal(grid.values(), before)
    grid.update(perceived(points, 1.1), points, pose(3.0))
    assert grid.origin_m == (-12.0, -15.0)
    np.testing.assert_array_equal(copied.values(), before)
    for off in (-2, 101, True, 0.5):
        with pytest.raises(OptionError, match="off_road is"):
            grid.values(off)  # type: ignore[arg-type]
        with pytest.raises(OptionError, match="unjudged is"):
            grid.to_occupancy_grid(unjudged=off)  # type: ignore[arg-type]


def footprint(at: NDArray[np.float64], box: Box, grid: RollingGrid, margin_m: float) -> NDArray[np.bool_]:
    """The cells of the window whose middles lie in a box that was seen from a pose."""
    n = len(grid.values())
    x, y = ((low + (np.arange(n) + 0.5) * 0.5) for low in grid.origin_m)
    place, ahead = (at @ [*box.center, 1.0])[:2], at[:2, :2] @ [math.cos(box.yaw), math.sin(box.yaw)]
    dx, dy = x[None, :] - place[0], y[:, None] - place[1]
    length, width = (size / 2.0 + margin_m for size in box.size[:2])
    return (np.abs(ahead[0] * dx + ahead[1] * dy) <= length) & (np.abs(ahead[0] * dy - ahead[1] * dx) <= width)


@pytest.mark.parametrize("seed", [3, 7])
def test_a_drive_through_traffic(seed: int) -> None:
    """Simulated scans with the true boxes: the grid knows more than a scan, and keeps hardly anything of what moved."""
    grid, naive = rolling(size_m=40.0), rolling(size_m=40.0, classes=())
    seen: dict[int, list[tuple[NDArray[np.float64], Box]]] = {}
    for stamp_s, at, simulated in simulate_sequence(random_scene(seed, "urban"), "hdl-64e", 8, 5.0, 6.0, seed):
        points = simulated.points
        found = perceived(points, 10.0 + stamp_s, boxes=tuple(simulated.boxes))
        for each in (grid, naive):
            each.update(found, points, at)
        for number, box in zip(simulated.box_ids, simulated.boxes, strict=True):
            seen.setdefault(int(number), []).append((at, box))
    now, before = np.zeros((2, 80, 80), np.bool_)
    for history in seen.values():
        first, last = ((pose @ [*box.center, 1.0])[:2] for pose, box in (history[0], history[-1]))
        for pose, box in history:
            if pose is at:
                now |= footprint(pose, box, grid, 1.0)
            elif np.hypot(*(first - last)) > 1.5:
                before |= footprint(pose, box, grid, 0.0)
    trails = [int(((each.values() == 100) & (each.ages_s() > 0.0) & before & ~now).sum()) for each in (grid, naive)]
    assert trails[0] == 0 < trails[1]
    single = occupancy_grid(found, points, cell_m=0.5, x_range_m=(-20.0, 20.0), y_range_m=(-20.0, 20.0))
    assert (grid.values() == -1).mean() < 0.8 * single.unknown.mean()
