"""Grids for navigation: a scene whose cells are known, and the files and messages that others read."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray

import twins.grid
from edgeperc import Box, Mounting, OccupancyGrid, OptionError, Perception, PointsError, TopView, occupancy_grid
from edgeperc.road.grid import fill_standing
from edgeperc.types.frame import ModelFrame
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import get_sensor
from scenes import rotation_of

NUMBERS = st.one_of(st.floats(-3, 3, width=32), st.sampled_from([math.nan, math.inf, -math.inf]))


@given(st.integers(0, 12), st.data())
def test_what_stands_in_a_cell(n: int, data: st.DataObject) -> None:
    points = data.draw(npst.arrays(np.float32, (n, 4), elements=NUMBERS))
    height_m = data.draw(npst.arrays(np.float32, n, elements=NUMBERS))
    corner = np.array([2.0, 1.5, 0.5])
    highest, tallest = np.empty((5, 4), np.int32), np.empty((5, 4), np.float32)
    fill_standing(points, height_m, corner, 0.25, 2.0, highest, tallest)
    expected = twins.grid.standing(points, height_m, corner, 0.25, 2.0, (5, 4))
    np.testing.assert_array_equal(highest, expected[0])
    np.testing.assert_array_equal(tallest, expected[1])


def street() -> NDArray[np.float32]:
    """A level road with returns every 0.1 m up to 30 m ahead, and a wall 1 m high at x = 20 m, y = 2..4 m."""
    x, y = np.meshgrid(np.arange(2.0, 30.0, 0.1), np.arange(-11.95, 12.0, 0.1))
    hidden = (x > 20.0) & (np.abs(y / x - 0.15) < 0.05)
    ground = np.column_stack([x[~hidden], y[~hidden], np.full((~hidden).sum(), -1.73)])
    y, z = np.meshgrid(np.arange(2.05, 4.0, 0.1), np.arange(-1.7, -0.69, 0.1))
    wall = np.column_stack([np.full(y.size, 20.05), y.ravel(), z.ravel()])
    crown = np.array([[15.05, -5.05, 1.5]])  # 3.2 m above the road
    points = np.vstack([ground, wall, crown])
    return np.column_stack([points, np.full(len(points), 0.3)]).astype(np.float32)


def perceived(points: NDArray[np.float32], boxes: tuple[Box, ...] = (), **changes: Any) -> Perception:
    labels = np.ones((400, 200), np.uint8)
    labels[:, :50] = 0  # no road left of y = 5 m
    top_view = TopView(labels, ("background", "drivable"), 0.1, (6.0, 46.0), (-10.0, 10.0), labels >= 0)
    found = Perception(len(points), 0, None, top_view, boxes, {}, {}, (), 12.25)
    return dataclasses.replace(found, **changes)


def at(grid: OccupancyGrid, x: float, y: float) -> tuple[int, int]:
    return int((grid.x_range_m[1] - x) / grid.cell_m), int((grid.y_range_m[1] - y) / grid.cell_m)


@pytest.mark.parametrize("cell_m", [0.1, 0.2, 0.5])
def test_a_street_with_a_wall(cell_m: float) -> None:
    points = street()
    car = Box("car", 0.9, (12.0, -3.0, -0.98), (4.0, 1.8, 1.5), 0.0)
    grid = occupancy_grid(perceived(points, (car,)), points, cell_m=cell_m)
    assert grid.drivable.shape == (round(40 / cell_m), round(20 / cell_m))
    wall, behind, road, aside, far = (at(grid, *p) for p in ((20.05, 3), (25, 3.75), (18, 0), (18, 7), (40, 0)))
    assert grid.obstacle[wall]
    assert grid.height_m[wall] == pytest.approx(1.0, abs=0.06)
    assert not grid.drivable[wall]
    assert grid.unknown[behind] & grid.unknown[far]
    assert not (grid.drivable & grid.unknown).any()
    assert grid.drivable[road]
    assert not grid.drivable[aside]
    assert grid.observed[aside]
    assert grid.obstacle[at(grid, 12.0, -3.0)]
    assert grid.height_m[at(grid, 12.0, -3.0)] == pytest.approx(1.5)
    assert not grid.obstacle[at(grid, 15.05, -5.05)]  # under the crown
    np.testing.assert_array_equal(np.isnan(grid.height_m), ~grid.obstacle)
    assert np.count_nonzero(grid.obstacle) * cell_m**2 == pytest.approx(4.0 * 1.8 + 2.0 * cell_m, rel=0.25)


def test_values_of_a_message() -> None:
    points = street()
    grid = occupancy_grid(perceived(points), points)
    assert (grid.values(np.int64(50)) == grid.values(50)).all()
    message = grid.to_occupancy_grid("velodyne", off_road=50)
    info, data = message["info"], message["data"]
    assert message["header"] == {"stamp": {"sec": 12, "nanosec": 250_000_000}, "frame_id": "velodyne"}
    assert (info["width"], info["height"], info["resolution"]) == (200, 100, 0.2)
    assert info["origin"]["position"] == {"x": 6.0, "y": -10.0, "z": -1.73}
    assert data.dtype == np.int8

    def value(x: float, y: float) -> int:
        """As nav_msgs/OccupancyGrid has it: row by row, x along a row."""
        col, row = int((x - 6.0) / 0.2), int((y + 10.0) / 0.2)
        return int(data[row * info["width"] + col])

    assert [value(18, 0), value(20.05, 3.0), value(40, 0), value(18, 7)] == [0, 100, -1, 50]
    assert {*grid.values().tolist()[80]} <= {-1, 0, 100}
    for wrong in (-2, 101, 3.5, True):
        with pytest.raises(OptionError, match=r"off_road is .*from -1 to 100"):
            grid.values(wrong)  # type: ignore[arg-type]


def test_cells_that_do_not_fill_the_bounds_lie_where_the_message_says(tmp_path: Path) -> None:
    points = street()
    grid = occupancy_grid(perceived(points), points, cell_m=1.5)  # 27 rows and 13 columns: 40.5 m of 40, 19.5 of 20
    fields = grid.to_occupancy_grid()
    origin, cells = fields["info"]["origin"]["position"], fields["data"].reshape(13, 27)
    assert (origin["x"], origin["y"]) == (grid.x_range_m[0], grid.y_range_m[0]) == (5.5, -9.5)
    column, row = int((20.05 - origin["x"]) / 1.5), int((3.0 - origin["y"]) / 1.5)
    assert (np.flatnonzero(cells[row] == 100) == column).all()
    assert cells[row, column] == 100
    assert "origin: [5.5, -9.5, 0.0]" in grid.save_map(tmp_path).read_text("utf-8")


def test_a_map_is_read_back(tmp_path: Path) -> None:
    image, yaml = pytest.importorskip("PIL.Image"), pytest.importorskip("yaml")
    points = street()
    grid = occupancy_grid(perceived(points), points, x_range_m=np.array([-5, 31], np.int8))  # type: ignore[arg-type]
    path = grid.save_map(tmp_path / "new" / "map")
    found = yaml.safe_load(path.read_text())
    assert found["origin"] == [-5.0, -10.0, 0.0]
    assert found["resolution"] == 0.2
    with image.open(path.parent / found["image"]) as picture:
        pixels = np.asarray(picture)
    assert pixels.dtype == np.uint8
    # The rule of nav2's map server in mode trinary.
    occupied = (255 - pixels[::-1].astype(float)) / 255
    read = np.full(pixels.shape, -1)
    read[occupied > found["occupied_thresh"]] = 100
    read[occupied < found["free_thresh"]] = 0
    np.testing.assert_array_equal(read, grid.values())
    assert {*np.unique(read)} == {-1, 0, 100}


def test_another_mounting_moves_the_scan() -> None:
    points = street()
    turned = points[:, [1, 0, 2, 3]] * np.float32([-1, 1, 1, 1])  # x of the scan points to the right of the vehicle
    mounting = Mounting(1.73, 0.0, 0.0, -90.0)
    level = occupancy_grid(perceived(points, mounting=Mounting(1.73, 0.0, 0.0, 0.0)), points)
    grid = occupancy_grid(perceived(turned, mounting=mounting), turned)
    assert (grid.obstacle == level.obstacle).mean() > 0.999
    assert grid.mounting == mounting
    assert level.obstacle.any()


def test_the_grid_is_of_the_sensor_of_the_perception() -> None:
    points = np.vstack([street(), [[3.1, 0.1, -0.3, 0.3]]]).astype(np.float32)  # of the own hood
    sensor = dataclasses.replace(get_sensor("vlp-16"), ego_box=((-2.0, 3.5), (-1.0, 1.0), (-1.0, 0.5)))
    whole = {"x_range_m": (-10.0, 40.0)}
    own, other = (occupancy_grid(perceived(points, sensor=each), points, **whole) for each in (sensor, None))
    assert not own.obstacle[at(own, 3.1, 0.1)]
    assert other.obstacle[at(other, 3.1, 0.1)]
    assert (own.observed != other.observed).any()


def test_no_points_and_no_top_view() -> None:
    nothing = np.empty((0, 4), np.float32)
    grid = occupancy_grid(perceived(nothing, top_view=None), nothing)
    assert grid.unknown.all()
    assert (grid.values() == -1).all()
    assert grid.mounting == MODEL_MOUNTING


def test_results_are_immutable_and_errors_name_the_reason() -> None:
    points = street()
    found = perceived(points)
    with pytest.raises(dataclasses.FrozenInstanceError):
        occupancy_grid(found, points).cell_m = 1.0  # type: ignore[misc]
    with pytest.raises(PointsError, match="expected the scan that was perceived"):
        occupancy_grid(found, points[1:])
    with pytest.raises(OptionError, match="got a ndarray for the perception; pass what a Perceiver returned"):
        occupancy_grid(points, points)  # type: ignore[arg-type]
    for options in (
        {"cell_m": 0.0},
        {"cell_m": math.nan},
        {"cell_m": 1e-3},
        {"x_range_m": (3, 1)},
        {"y_range_m": (1,)},
    ):
        with pytest.raises(OptionError, match="no grid"):
            occupancy_grid(found, points, **options)  # type: ignore[arg-type]
    for height in (-0.1, 2.0, math.nan):
        with pytest.raises(OptionError, match="min_height_m is"):
            occupancy_grid(found, points, min_height_m=height)


@pytest.mark.parametrize(
    "mounting",
    [
        Mounting(1.73, 0.0, 0.0, 0.0),
        Mounting(2.1, 0.0, 0.66, -90.0),
        Mounting(1.5, 3.0, -2.0, 135.0),
        Mounting(3.0, 0.0, 0.0, 180.0, origin_m=(1.0, -2.0)),
    ],
)
def test_the_message_lies_in_the_frame_of_the_scan(mounting: Mounting) -> None:
    """A post that the sensor sees lies in an occupied cell, however the sensor is turned."""
    frame = ModelFrame(mounting)
    post = np.array([20.05, 6.05, -1.0])  # in the frame of the models
    place = frame.R.T @ (post - frame.t)
    empty = np.zeros((60, 40), np.bool_)
    height_m = np.zeros((60, 40), np.float32)
    grid = OccupancyGrid(empty, empty, height_m, ~empty, ~empty, 0.5, (0.0, 30.0), (-10.0, 10.0), mounting=mounting)
    origin = grid.to_occupancy_grid("lidar")["info"]["origin"]
    R = rotation_of(**origin["orientation"])
    corner = np.array([origin["position"][axis] for axis in "xyz"])
    np.testing.assert_allclose(R.T @ (place - corner), [20.05, 16.05, 0.73], atol=1e-9)  # column, row and height
