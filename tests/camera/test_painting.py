"""Painting against slow twins, and against the truth of simulated streets."""

from __future__ import annotations

import io
import json
import math
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import tiny_camera
from hypothesis import given, settings
from hypothesis import strategies as st

import twins.painting
import twins.returns
from cli_helpers import Shell
from edgeperc import (
    Box,
    Calibration,
    CalibrationError,
    ImageError,
    ImageLabels,
    Mounting,
    OptionError,
    Perception,
    PointsError,
    SensorError,
    camera_road,
    paint,
    road_ahead,
)
from edgeperc.camera import painting
from edgeperc.evaluation.painting import beside_edges, count_painting
from edgeperc.simulation.camera import CAMERA_CLASSES, VOID, CameraImage, forward_camera, render
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import SimulatedScan, simulate
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import TopViewGeometry
from edgeperc.view import draw_painted
from edgeperc.view.colors import color_of, rgb

ROAD = CAMERA_CLASSES.index("Road")
SCENES = ((2_000_000_000, "urban"), (2_000_000_001, "residential"), (2_000_000_002, "junction"))
NEAR = forward_camera(640, 480)


FAR = forward_camera(640, 480, at_m=(0.5, 0.5, -0.6))  # 0.9 m from the LiDAR


@cache
def seen(scene: int, sensor: str, calibration: Calibration) -> tuple[SimulatedScan, CameraImage]:
    """A street, its scan and its image."""
    seed, place = SCENES[scene]
    scan = simulate(random_scene(seed, place), sensor, seed)
    return scan, render(scan.scene, calibration, scan.T_world_sensor, seed)


@cache
def counted(sensor: str, calibration: Calibration, scenes: Sequence[int] = (0, 1, 2)) -> Counter[str]:
    drawn = (seen(scene, sensor, calibration) for scene in scenes)
    return sum((count_painting(*each, calibration, sensor) for each in drawn), Counter[str]())


def perceived(scan: SimulatedScan, image: CameraImage, mounting: Mounting = MODEL_MOUNTING) -> Perception:
    labels = ImageLabels(image.labels, CAMERA_CLASSES)
    return Perception(len(scan.points), 0, None, None, (), {}, {}, (), None, mounting, image=labels)


def a_case(rng: np.random.Generator, n: int) -> tuple[np.ndarray, ...]:
    """Points, their projection and windows; some points are not finite, behind the camera or far beside the image."""
    points = rng.uniform([-5.0, -10.0, -2.0, 0.0], [30.0, 10.0, 2.0, 1.0], (n, 4)).astype(np.float32)
    points[rng.random((n, 4)) < 0.02] = rng.choice([np.nan, np.inf, -np.inf, 3e38])
    places = NEAR.resized(64, 48).project(points)
    n_beams = int(rng.integers(1, 9))
    between = np.sort(rng.uniform(-0.4, 0.1, n_beams - 1))[::-1].copy()
    return points, *places, between, *rng.uniform(0.1, 6.0, (2, n_beams))


@pytest.mark.parametrize("n", [0, 1, 60])
@pytest.mark.parametrize("seed", range(12))
def test_kernels_equal_twins(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    points, u, v, depth, between, half_up, half_down = a_case(rng, n)
    half_side, cell_h, cell_w = float(rng.uniform(0.1, 5.0)), *rng.integers(1, 4, 2).tolist()
    buffer = painting.DepthBuffer(np.empty((-(-48 // cell_h), -(-64 // cell_w)), np.float32), cell_h, cell_w)
    pixels, windows = painting.Pixels(u, v, depth), painting.Windows(between, half_up, half_down, half_side)
    painting.fill_nearest(points, pixels, windows, buffer)
    slow = twins.painting.nearest(points, *pixels, *windows, cell_h, cell_w, buffer.nearest.shape, painting.MAX_CELLS)
    np.testing.assert_array_equal(buffer.nearest, slow)
    assert np.isfinite(buffer.nearest).any() or n < 60
    labels = rng.integers(0, 256, (48, 64), np.uint8)
    painted = np.empty(n, np.uint8)
    slack = rng.uniform(0.0, 0.5), rng.uniform(0.0, 0.1)
    painting.fill_painted(labels, pixels, buffer, *slack, painted)
    slow = twins.painting.painted(labels, *pixels, *buffer, *slack)
    np.testing.assert_array_equal(painted, slow)

    # In any order, and the nearest point is never hidden.
    order = rng.permutation(n)
    turned = buffer._replace(nearest=np.empty_like(buffer.nearest))
    painting.fill_nearest(points[order], painting.Pixels(*(each[order] for each in pixels)), windows, turned)
    np.testing.assert_array_equal(turned.nearest, buffer.nearest)
    first = np.argmin(np.where(np.isfinite(u), depth, np.inf)) if n else 0
    if n and math.isfinite(u[first]) and 0 <= u[first] < 63 and 0 <= v[first] < 47:
        assert painted[first] == labels[round(v[first]), round(u[first])]


@pytest.mark.kernel
def test_the_last_float_of_a_pixel() -> None:
    """0.49999999999999994 + 0.5 is 1.0, beside an image of one pixel."""
    last, painted = np.array([np.nextafter(0.5, 0.0)]), np.empty(1, np.uint8)
    pixels, buffer = painting.Pixels(last, last, np.ones(1)), painting.DepthBuffer(np.ones((1, 1), np.float32), 1, 1)
    painting.fill_painted(np.array([[3]], np.uint8), pixels, buffer, 0.1, 0.0, painted)
    assert painted.tolist() == [3]


@pytest.mark.kernel
def test_a_window_is_bounded() -> None:
    """A point that nearly touches the camera covers 49 x 49 cells at most."""
    points = np.array([[0.2701, 0.0, -0.08]], np.float32)
    buffer = painting.DepthBuffer(np.empty((480, 640), np.float32), 1, 1)
    windows = painting.Windows(np.empty(0), np.full(1, 5.0), np.full(1, 5.0), 5.0)
    painting.fill_nearest(points, painting.Pixels(*NEAR.project(points)), windows, buffer)
    assert 40**2 < np.count_nonzero(np.isfinite(buffer.nearest)) <= (2 * painting.MAX_CELLS + 1) ** 2


@pytest.mark.parametrize(
    ("sensor", "calibration", "scenes"), [("hdl-64e", NEAR, (0, 1, 2)), ("hdl-64e", FAR, (0,)), ("os1-64", NEAR, (2,))]
)
def test_points_get_the_class_of_their_surface(sensor: str, calibration: Calibration, scenes: tuple[int, ...]) -> None:
    n = counted(sensor, calibration, scenes)
    assert n["painted"] > 3_500 * len(scenes)
    assert n["right"] / n["painted"] >= 0.99
    assert n["right"] / n["painted"] > n["right_untested"] / n["in_image"]  # each point with the class of its pixel
    assert n["seen"] / n["visible"] >= 0.94


def test_points_beside_edges_are_not_judged() -> None:
    labels = np.zeros((12, 20), np.uint8)
    labels[4, 10] = 1
    wanted = np.zeros(labels.shape, bool)
    wanted[1:8, 7:14] = True
    np.testing.assert_array_equal(beside_edges(labels), wanted)


def test_evaluate_painting(tmp_path: Path, shell: Shell) -> None:
    out = shell.out("eval-painting", "--sensor", "vlp-16", "--scenes", "1", "--json", tmp_path / "out.json")
    assert "1 simulated street;" in out
    assert out.count("0.9 m") == 2
    figures = json.loads((tmp_path / "out.json").read_text("utf-8"))
    assert figures["vlp-16, 0.3 m"]["points_right"] > 0.99
    assert figures["vlp-16, 0.3 m"]["n_points"] > 500
    assert "n_scenes is 0; expected at least 1" in shell.err("eval-painting", "--scenes", "0")


def test_a_hidden_point_is_not_painted() -> None:
    """A wall with a screen in front of it: the camera sees the screen alone, the LiDAR above it sees the wall too."""
    y, z = (each.ravel() for each in np.meshgrid(np.arange(-2.0, 2.0, 0.03), np.arange(-1.5, 1.0, 0.03)))
    screen = np.column_stack([np.full_like(y, 5.0), y, z])[z < 0.0]
    wall = np.column_stack([np.full_like(y, 12.0), 2.4 * y, 1.6 * (z + 1.5) - 1.5])
    ground = np.column_stack([np.repeat(np.arange(3.0, 15.0, 0.2), 60), np.tile(np.arange(-6.0, 6.0, 0.2), 60)])
    ground = np.column_stack([ground, np.full(len(ground), -1.73)])
    points = np.concatenate([screen, wall, ground]).astype(np.float32)
    low = forward_camera(640, 480, at_m=(0.0, 0.0, -0.8))
    u, v, _ = low.project(points)
    labels = np.full((480, 640), 7, np.uint8)
    painted = paint(labels, points, low)
    is_wall = np.arange(len(points)) // len(screen) >= 1
    is_wall &= np.arange(len(points)) < len(screen) + len(wall)
    # The screen's upper edge as the camera at z = -0.8 sees it on the wall.
    edge = -0.8 + 0.8 * 12.0 / 5.0
    inside = (u > 10.0) & (u < 630.0) & (v > 10.0) & (v < 470.0) & (np.abs(points[:, 1]) < 4.0)
    behind, above = inside & is_wall & (points[:, 2] < edge - 0.1), inside & is_wall & (points[:, 2] > edge + 0.25)
    assert behind.sum() > 1000
    assert above.sum() > 1000
    assert (painted[above] == 7).all()
    assert (painted[behind] == painting.UNSEEN).all()
    assert (painted[inside & (np.arange(len(points)) < len(screen))] == 7).all()


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.001, 0.02, 0.1]))
def test_the_order_of_points_does_not_matter(seed: int, step_m: float) -> None:
    """Of rounded points, many are the lowest of their cell."""
    scan, image = seen(0, "os1-64", NEAR)
    points = scan.points[::4].copy()
    if step_m:
        points[:, :3] = np.round(points[:, :3] / step_m) * step_m
    order = np.random.default_rng(seed).permutation(len(points))
    painted = paint(image.labels, points, NEAR, sensor="os1-64")
    np.testing.assert_array_equal(paint(image.labels, points[order], NEAR, sensor="os1-64"), painted[order])
    views = [camera_road(image.labels == ROAD, each, NEAR, sensor="os1-64") for each in (points, points[order])]
    np.testing.assert_array_equal(views[0].labels, views[1].labels)
    np.testing.assert_array_equal(views[0].observed, views[1].observed)


@pytest.mark.compiled
@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2, 500]), st.sampled_from([3, 4]))
def test_any_points_are_painted_or_unseen(seed: int, n: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0.0, rng.choice([0.1, 10.0, 1e4]), (n, columns)).astype(np.float32)
    points[rng.random((n, columns)) < 0.1] = rng.choice([np.nan, np.inf, -np.inf, 3e38, 0.0])
    labels = rng.integers(0, 11, (NEAR.height, NEAR.width), np.uint8)
    painted = paint(labels, points, NEAR, sensor="vlp-16")
    assert painted.shape == (n,)
    assert painted.dtype == np.uint8
    u, v, depth = NEAR.project(points)
    with np.errstate(invalid="ignore"):
        inside = (depth > 0) & (u >= -0.5) & (u < NEAR.width - 0.5) & (v >= -0.5) & (v < NEAR.height - 0.5)
    scan = np.zeros((n, 4), np.float32)
    scan[:, :3] = points[:, :3]
    kept, _ = twins.returns.returns(scan, get_sensor("vlp-16").min_range_m)  # what is nearer is not a return
    inside &= np.isfinite(kept).all(axis=1)
    assert (painted[~inside] == painting.UNSEEN).all()
    took = painted != painting.UNSEEN
    row, col = np.floor(v[took] + 0.5).astype(int), np.floor(u[took] + 0.5).astype(int)
    np.testing.assert_array_equal(painted[took], labels[row, col])
    assert took.any() == inside.any()  # the nearest point in the image is seen
    road = camera_road(labels == ROAD, points, NEAR, sensor="vlp-16")
    assert not (road.labels.astype(bool) & ~road.observed).any()


def test_points_that_a_camera_cannot_see() -> None:
    labels = np.zeros((NEAR.height, NEAR.width), np.uint8)
    assert paint(labels, np.empty((0, 4), np.float32), NEAR).shape == (0,)
    behind = np.array([[-10.0, 0.0, 0.0, 0.0], [-5.0, 1.0, -1.0, 0.0]], np.float32)
    assert paint(labels, behind, NEAR).tolist() == [painting.UNSEEN, painting.UNSEEN]
    assert paint(labels, np.full((3, 4), np.nan, np.float32), NEAR).tolist() == [painting.UNSEEN] * 3
    assert paint(labels, np.array([[10.0, 0.0, 0.0, 0.0]], np.float32), NEAR).tolist() == [0]
    assert paint(labels, np.array([[10, 0, 0]]), NEAR).tolist() == [0]
    no_class = np.full_like(labels, 255)
    assert paint(no_class, np.array([[10.0, 0.0, 0.0]]), NEAR).tolist() == [painting.UNSEEN]


def test_a_perception_and_its_labels_paint_alike() -> None:
    scan, image = seen(1, "hdl-64e", NEAR)
    labels = image.labels.copy()
    labels[280:320, 300:340] = VOID
    image = replace(image, labels=labels)
    painted, found = paint(labels, scan.points, NEAR), perceived(scan, image)
    assert sum(found.require_image().counts().values()) == np.count_nonzero(labels != VOID)
    np.testing.assert_array_equal(paint(found, scan.points, NEAR), painted)
    np.testing.assert_array_equal(paint(found.require_image(), scan.points, NEAR), painted)
    by_mask = camera_road(found.require_image().drivable, scan.points, NEAR)
    road = camera_road(found, scan.points, NEAR)
    assert (by_mask.road & by_mask.observed)[road.observed].tolist() == road.road[road.observed].tolist()
    assert by_mask.observed.sum() > road.observed.sum()  # pixels without a class are not road, and not seen


def test_a_sensor_that_is_mounted_otherwise() -> None:
    """Turned by 20 degrees, tilted and higher: the same street, the same classes and cells."""
    scan, image = seen(0, "hdl-64e", NEAR)
    mounting = Mounting(2.1, 1.0, 3.0, 20.0, (0.4, -0.2))
    T_here_there = np.eye(4)  # the scan as the other sensor measures it, in the vehicle's frame
    T_here_there[:3, :3] = mounting.rotation().T @ MODEL_MOUNTING.rotation()
    T_here_there[:3, 3] = mounting.rotation().T @ [0.0, 0.0, 1.73 - 2.1] + [0.4, -0.2, 0.0]
    points = scan.points.copy()
    points[:, :3] = scan.points[:, :3] @ T_here_there[:3, :3].T + T_here_there[:3, 3]
    other = Calibration(NEAR.K, NEAR.T_camera_sensor @ np.linalg.inv(T_here_there), NEAR.width, NEAR.height)
    road = camera_road(perceived(scan, image), scan.points, NEAR)
    turned = camera_road(perceived(scan, image, mounting), points, other)
    assert turned.mounting == mounting
    both = road.observed & turned.observed
    assert both.sum() > 0.93 * road.observed.sum()
    assert np.mean(road.road[both] == turned.road[both]) > 0.99
    same = paint(image.labels, scan.points, NEAR) == paint(image.labels, points, other, mounting=mounting)
    assert same.mean() > 0.99
    with pytest.raises(OptionError, match="without None"):
        paint(image.labels, points, other, mounting=Mounting())
    for wrong in (np.linalg.inv(other.T_camera_sensor), np.eye(4)):
        with pytest.warns(UserWarning, match="lies on its side or looks up.*the inverse"):
            paint(image.labels, points, Calibration(NEAR.K, wrong, NEAR.width, NEAR.height), mounting=mounting)


def test_the_sensor_may_be_beside_the_origin_of_its_points() -> None:
    """Beams start at the sensor: where they did at the origin, other points were hidden."""
    scan, image = seen(0, "hdl-64e", NEAR)
    T_there_here = np.eye(4)
    T_there_here[:2, 3] = 16.0, -8.0
    points = scan.points + np.array([16.0, -8.0, 0.0, 0.0], np.float32)
    there = Calibration(NEAR.K, NEAR.T_camera_sensor @ np.linalg.inv(T_there_here), NEAR.width, NEAR.height)
    same = paint(image.labels, scan.points, NEAR) == paint(
        image.labels, points, there, mounting=replace(MODEL_MOUNTING, origin_m=(16.0, -8.0))
    )
    assert same.mean() > 0.9999


def test_the_road_of_an_image_lies_on_the_roads_of_the_scene() -> None:
    n = counted("hdl-64e", NEAR)
    assert n["cells_right"] / n["cells"] >= 0.96
    assert n["near_right"] / n["near_cells"] >= 0.97
    assert n["road_observed"] / n["road"] >= 0.5
    scan, image = seen(0, "hdl-64e", NEAR)
    found = camera_road(perceived(scan, image), scan.points, NEAR)
    assert found.classes == ("background", "drivable")
    assert found.drivable_area_m2 > 50.0
    assert road_ahead(found).free_ahead_m() > 6.0


def test_cells_behind_a_car_are_not_seen() -> None:
    scan, image = seen(0, "hdl-64e", NEAR)
    found = camera_road(perceived(scan, image), scan.points, NEAR)
    assert not found.observed.all()
    near, left = found.to_meters(399, 0)
    assert near < 6.1
    assert not found.observed[399, 0], left  # beside the field of view of 60 degrees
    hidden = np.full((NEAR.height, NEAR.width), False)
    whole = camera_road(~hidden, scan.points, NEAR)
    assert whole.road[whole.observed].all()
    nothing = camera_road(hidden, scan.points, NEAR)
    np.testing.assert_array_equal(nothing.observed, whole.observed)
    assert not nothing.road.any()


def test_without_ground_no_cell_is_seen() -> None:
    wall = np.random.default_rng(0).uniform([9.9, -5.0, 0.0, 0.0], [10.0, 5.0, 3.0, 1.0], (2000, 4)).astype(np.float32)
    mask = np.ones((NEAR.height, NEAR.width), bool)
    for points in (wall, wall[:0]):
        found = camera_road(mask, points, NEAR, view=TopViewGeometry((5.0, 15.0), (-5.0, 5.0), cell_m=0.5))
        assert found.observed.shape == (20, 20)
        assert not found.observed.any()
        assert found.drivable_area_m2 == 0.0


@pytest.mark.parametrize(
    "image", [None, "labels", np.zeros((480, 640)), np.zeros((480, 640, 3), np.uint8), np.zeros((480, 640), bool)]
)
def test_what_are_no_labels_is_refused(image: object) -> None:
    points = np.zeros((1, 4), np.float32)
    with pytest.raises(ImageError, match="expected a perception"):
        paint(image, points, NEAR)  # type: ignore[arg-type]
    image = np.zeros((480, 640), np.uint8) if isinstance(image, np.ndarray) and image.dtype == bool else image
    with pytest.raises(ImageError, match="expected a perception"):
        camera_road(image, points, NEAR)  # type: ignore[arg-type]


def test_what_does_not_fit_is_refused() -> None:
    points, labels = np.zeros((1, 4), np.float32), np.zeros((480, 640), np.uint8)
    scan, image = seen(0, "hdl-64e", NEAR)
    with pytest.raises(CalibrationError, match="image is 640 x 480, the calibration is for 320 x 240"):
        paint(labels, points, NEAR.resized(320, 240))
    with pytest.raises(ImageError, match="got NoneType for the image"):
        paint(replace(perceived(scan, image), image=None), points, NEAR)
    with pytest.raises(ImageError, match="for the image"):
        paint(np.ma.array(labels), points, NEAR)
    with pytest.raises(CalibrationError, match="got NoneType for the calibration"):
        paint(labels, points, None)  # type: ignore[arg-type]
    for wrong in (np.zeros(4), np.zeros((3, 2)), np.ma.masked_all((2, 3)), np.array([["a"] * 3])):
        with pytest.raises(PointsError, match=r"got points of shape|got a masked array"):
            paint(labels, wrong, NEAR)  # type: ignore[arg-type]
    with pytest.raises(SensorError):
        paint(labels, points, NEAR, sensor="hdl-65e")
    with pytest.raises(OptionError, match="mounting"):
        paint(labels, points, NEAR, mounting="roof")  # type: ignore[arg-type]


def test_the_legend_has_the_classes_of_boxes_that_the_camera_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    scan, image = seen(0, "hdl-64e", NEAR)
    boxes = tuple(Box(label, 0.9, (12.0, 0.0, -0.8), (4.0, 1.7, 1.6), 0.0) for label in ("car", "van", "van"))
    legend: dict[str, list[str]] = {}
    monkeypatch.setattr("edgeperc.view.canvas.draw_legend", lambda *given: legend.update(given[-1]))
    draw_painted(replace(perceived(scan, image), boxes=boxes), image.rgb, scan.points, NEAR)
    assert legend["van"] == ["boxes alone"]
    assert "car" not in legend


def test_draw_painted(tmp_path: Path) -> None:
    pillow = pytest.importorskip("PIL.Image")
    matplotlib = pytest.importorskip("matplotlib")
    scan, image = seen(0, "hdl-64e", NEAR)
    found = perceived(scan, image)
    png = draw_painted(found, image.rgb, scan.points, NEAR, tmp_path / "both.png", title="a street")
    with matplotlib.rc_context({"image.origin": "lower", "scatter.marker": "x", "text.usetex": True}):
        assert draw_painted(found, image.rgb, scan.points, NEAR, title="a street") == png
    assert (tmp_path / "both.png").read_bytes() == png
    # Without any class, the same picture has no color of a class beside the image itself.
    nothing = replace(found, image=ImageLabels(np.full_like(image.labels, VOID), CAMERA_CLASSES))
    # The panel from above shows what a camera that looks back sees.
    back = Calibration(NEAR.K, np.diag([-1.0, 1.0, -1.0, 1.0]) @ NEAR.T_camera_sensor, 640, 480)
    cars = replace(found, image=ImageLabels(np.full_like(image.labels, CAMERA_CLASSES.index("Car")), CAMERA_CLASSES))
    given = ((nothing, NEAR), (cars, back))
    drawn = [png, *(draw_painted(each, image.rgb, scan.points, camera) for each, camera in given)]
    whole, empty, looking_back = (np.asarray(pillow.open(io.BytesIO(png)).convert("RGB"), np.int16) for png in drawn)
    assert whole.shape[1] == 1600
    car = (rgb([color_of("car")])[0] * 255.0).round()
    shown = (whole, empty, looking_back[120:860, 900:])
    dots = [int((np.abs(each - car).max(axis=2) < 12).sum()) for each in shown]
    assert min(dots[0], dots[2]) > 300
    assert dots[1] == 0
    wide = forward_camera(1240, 376)
    labels = ImageLabels(np.zeros((376, 1240), np.uint8), ("Sky",))
    few = scan.points[::50]
    draw_painted(replace(found, n_points=len(few), image=labels), np.zeros((376, 1240, 3), np.uint8), few, wide)
    with pytest.raises(ImageError, match="of a perception of an image of shape"):
        draw_painted(found, image.rgb[:-1], scan.points, NEAR)
    with pytest.raises(ImageError, match="of a perception of no image"):
        draw_painted(replace(found, image=None), image.rgb, scan.points, NEAR)
    with pytest.raises(PointsError, match="expected the scan that was perceived"):
        draw_painted(found, image.rgb, scan.points[:-1], NEAR)
    with pytest.raises(CalibrationError, match="calibration is for"):
        draw_painted(found, image.rgb, scan.points, wide)


def test_the_demo_with_a_camera(tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("onnxruntime")
    options = ("--out", str(tmp_path / "out"), "--model", "pointseg")
    with pytest.MonkeyPatch.context() as patch:  # the pictures are drawn once
        for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
            patch.setitem(sys.modules, name, None)
        out = shell.out("demo", "--camera", *options)
    assert "not a photograph" in out
    assert "no model of a camera's images ran" in out
    assert "the scene's true classes, not those of a network" in out
    assert float(re.search(r"([\d.]+) % of them have the class of their surface", out)[1]) > 98.0  # type: ignore[index]
    assert float(re.search(r"(\d+) m2 of the image's road", out)[1]) > 100.0  # type: ignore[index]
    assert {file.name for file in (tmp_path / "out").iterdir()} == {"image.png", "scan.bin", "scene.html"}
    # A network that calls every pixel road, sky or tree.
    out = shell.out("demo", "--camera", *options, "--model", tiny_camera.write_camera(tmp_path))
    assert re.search(r"camera +\d+ % of the pixels get their true class\n", out)
    assert "the scene's true classes, not those of a network" in out
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "camera.png",
        "image.png",
        "scan.bin",
        "scene.html",
        "scene.png",
    }


def test_run_draws_an_image_and_its_scan(tmp_path: Path, shell: Shell) -> None:
    pillow = pytest.importorskip("PIL.Image")
    pytest.importorskip("matplotlib")
    pytest.importorskip("onnxruntime")
    scan, image = seen(0, "hdl-64e", NEAR)
    pillow.fromarray(image.rgb).save(tmp_path / "street.png")
    scan.points.tofile(tmp_path / "street.bin")
    calib = tmp_path / "calib.txt"
    calib.write_text(
        "P2: 554 0 320 0 0 554 240 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
        "Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
    )
    model, out = str(tiny_camera.write_camera(tmp_path)), tmp_path / "out"
    both = [str(tmp_path / "street.png"), "--scan", str(tmp_path / "street.bin"), "--calib", str(calib)]
    options = ["--model", model, "--model", "pointseg", "--on-mismatch", "ignore"]
    shell.out("run", *both, *options, "--png", "--out", out)
    assert {file.name for file in out.iterdir()} == {"street.png", "street_both.png", "street_scan.png"}
    with pillow.open(out / "street_both.png") as picture:
        assert picture.size[0] == 1600
    for wrong in ([*both, *options], [both[0], "--calib", calib, "--png", "--out", out], both[2:]):
        assert "--calib needs images with --scan and --png" in shell.err("run", *wrong)
    calib.write_text("P2: 1 2 3\n")
    assert "holds no KITTI calibration" in shell.err("run", *both, *options, "--png", "--out", out)
