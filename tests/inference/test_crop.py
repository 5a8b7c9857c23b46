"""Points near the views: the kernel against its twin, and the same answers as with all points."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import twins.crop
from edgeperc import Perceiver
from edgeperc.ground.observed import Observer
from edgeperc.inference.crop import MARGIN_M, Crop, fill_rows, spread
from edgeperc.inference.projection import make_projector
from edgeperc.pipeline import Pipeline
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.perception import PointLabels
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import ObjectGeometry, RangeImageGeometry, TopViewGeometry
from scenes import assert_same

AHEAD = RangeImageGeometry((2.0, -10.0, -24.0))
TOP = TopViewGeometry()
# The first example compiles a kernel.

coordinates = st.floats(-80.0, 80.0, width=32) | st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 3e38])
clouds = st.lists(st.tuples(coordinates, coordinates), max_size=60).map(
    lambda rows: np.array([(*row, -1.0, 0.5) for row in rows], np.float32).reshape(-1, 4)
)
sectors = st.tuples(st.integers(-180, 178), st.integers(2, 360)).map(
    lambda edges: replace(AHEAD, azimuth_right_deg=edges[0], azimuth_left_deg=min(edges[0] + edges[1], 180))
)
low = st.integers(-40, 30)
rectangles = st.tuples(low, st.integers(1, 60), low, st.integers(1, 60)).map(
    lambda v: TopViewGeometry((v[0], v[0] + v[1]), (v[2], v[2] + v[3]), cell_m=0.5)
)


def rows_of(crop: Crop, points: NDArray[np.float32]) -> NDArray[np.int64]:
    kept, rows = crop.select(points)
    if rows is None:
        assert kept is points
        return np.arange(len(points))
    np.testing.assert_array_equal(kept, points[rows])
    return rows.astype(np.int64)


@pytest.mark.kernel
@settings(max_examples=60)
@given(clouds, st.lists(st.tuples(*[st.floats(-20.0, 20.0)] * 3), min_size=2, max_size=2))
def test_rows_match_the_slow_twin(points: NDArray[np.float32], lines: list[tuple[float, float, float]]) -> None:
    rows, kept = np.empty(len(points) + 1, np.int32), np.empty((len(points) + 1, 4), np.float32)
    n = fill_rows(points, np.array(lines), rows, kept)
    expected = twins.crop.kept_rows(points, lines)
    np.testing.assert_array_equal(rows[:n], expected)
    np.testing.assert_array_equal(kept[:n], points[expected])


@pytest.mark.kernel
@settings(max_examples=60)
@given(st.lists(st.lists(st.booleans(), min_size=20, max_size=20), min_size=1, max_size=4), st.integers(0, 2**32 - 1))
def test_spread_labels_match_the_slow_twin(parts: list[list[bool]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    given_parts = []
    for is_kept in parts:
        rows = np.flatnonzero(is_kept).astype(np.int32)
        labels, in_view = rng.integers(0, 5, len(rows)).astype(np.uint8), rng.random(len(rows)) < 0.5
        given_parts.append((PointLabels(labels, in_view, ("background", "car", "van", "truck", "person")), rows))
    found = spread(given_parts, 20)
    labels, in_view = twins.crop.spread(given_parts, 20)
    np.testing.assert_array_equal(found.labels, labels)
    np.testing.assert_array_equal(found.in_view, in_view)
    assert spread([(given_parts[0][0], None)], 20) is given_parts[0][0]


@settings(max_examples=60)
@given(clouds, sectors)
def test_a_sector_and_what_is_beside_it_are_kept(points: NDArray[np.float32], view: RangeImageGeometry) -> None:
    points = points[~(np.abs(points[:, :2]) > 1e15).any(axis=1)]  # there, rounding of a sine is more than the margin
    x, y = points[:, :2].T.astype(np.float64)
    turned = np.degrees(np.arctan2(y, x))
    finite = np.isfinite(x) & np.isfinite(y)
    in_sector = finite & (turned <= view.azimuth_left_deg) & (turned >= view.azimuth_right_deg)
    rows = rows_of(Crop([view]), points)
    assert set(np.flatnonzero(in_sector)) <= set(rows)
    near = finite & (np.hypot(x, y) < MARGIN_M)
    assert set(np.flatnonzero(near)) <= set(rows)
    if view.azimuth_left_deg - view.azimuth_right_deg <= 180:  # no more than the margin
        for row in rows[finite[rows]]:
            rays = np.radians([view.azimuth_left_deg, view.azimuth_right_deg])
            beside = [abs(math.sin(ray) * x[row] - math.cos(ray) * y[row]) for ray in rays]
            assert in_sector[row] or min(beside) <= MARGIN_M + 1e-3


@settings(max_examples=60)
@given(clouds, sectors, st.floats(-7.0, 7.0))
def test_a_turned_view_keeps_what_it_sees_of_the_turned_scan(
    points: NDArray[np.float32], view: RangeImageGeometry, turn_rad: float
) -> None:
    points = points[(np.abs(points[:, :2]) < 1e3).all(axis=1)]
    rows = rows_of(Crop([view], turn_rad=turn_rad), points)
    x, y = points[:, :2].T.astype(np.float64)
    azimuth = np.degrees(np.angle((x + 1j * y) * np.exp(-1j * turn_rad)))
    seen = (azimuth <= view.azimuth_left_deg) & (azimuth >= view.azimuth_right_deg)
    assert set(np.flatnonzero(seen)) <= set(rows)


@settings(max_examples=60)
@given(clouds, rectangles)
def test_what_an_observer_uses_is_kept(points: NDArray[np.float32], view: TopViewGeometry) -> None:
    points[:, 2] = -1.73
    index = np.full((view.height, view.width), -1, np.int32)
    of_all = Observer(view, get_sensor("hdl-64e")).observe(points, index)
    kept = points[rows_of(Crop([view]), points)]
    np.testing.assert_array_equal(Observer(view, get_sensor("hdl-64e")).observe(kept, index), of_all)
    _, _, inside = view.cells(points[:, 0].astype(np.float64), points[:, 1].astype(np.float64))
    assert set(np.flatnonzero(inside)) <= set(rows_of(Crop([view]), points))


def test_a_full_turn_and_no_view_keep_everything() -> None:
    points = np.ones((3, 4), np.float32)
    turn = replace(AHEAD, azimuth_left_deg=180.0, azimuth_right_deg=-180.0)
    half = replace(AHEAD, azimuth_left_deg=100.0, azimuth_right_deg=-100.0)
    for views in ([], [turn], [turn, TOP], [half], [TopViewGeometry((-8.0, 8.0), cell_m=0.5)]):
        kept, rows = Crop(views).select(points)
        assert kept is points
        assert rows is None


def test_buffers_grow_and_empty_scans_stay_empty() -> None:
    crop = Crop([AHEAD, TOP])
    for n in (0, 1, 1000, 3, 0):
        points = np.zeros((n, 4), np.float32)
        points[:, 0] = np.where(np.arange(n) % 2, -50.0, 30.0)
        np.testing.assert_array_equal(rows_of(crop, points), np.arange(0, n, 2))


def pipeline_of(perceive: Perceiver) -> Pipeline:
    return perceive.pipeline


OPTIONS: dict[str, Any] = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore"}


@pytest.mark.parametrize("models", [["ssadnet", "pointseg"], ["pointseg"], ["ssadnet"]])
def test_answers_are_those_with_all_points(models: list[str]) -> None:
    cropping, whole = (Perceiver(models, **OPTIONS) for _ in range(2))
    pipeline_of(whole).crop = Crop([])
    for seed in range(3):
        points = simulated_scan(FIRST_SEED + seed).points
        assert 0.2 < len(rows_of(pipeline_of(cropping).crop, points)) / len(points) < 0.8
        assert_same(cropping(points), whole(points))


def whole_sectors(perceive: Perceiver) -> None:
    """Let each sector of a turn have all points."""
    everything = Crop([])
    everything.select = lambda points: (points, np.arange(len(points), dtype=np.int32))  # type: ignore[method-assign]
    pipeline = pipeline_of(perceive)
    pipeline.sectors = [(turn_rad, everything) for turn_rad, _ in pipeline.sectors]


def test_answers_of_a_full_turn_are_those_of_sectors_with_all_points() -> None:
    cropping, whole = (Perceiver("pointseg", full_turn=True, **OPTIONS) for _ in range(2))
    whole_sectors(whole)
    for seed in range(2):
        points = simulated_scan(FIRST_SEED + seed).points
        seen = cropping(points)
        assert_same(seen, whole(points))
        assert seen.require_points().in_view.mean() > 0.9


@pytest.mark.parametrize("full_turn", [False, True])
def test_between_few_beams_labels_are_about_those_with_all_points(full_turn: bool) -> None:
    """The ground below interpolated points is found with those that are kept."""
    cropping, whole = (Perceiver("pointseg", sensor="vlp-16", full_turn=full_turn, **OPTIONS) for _ in range(2))
    pipeline_of(whole).crop = Crop([])
    whole_sectors(whole)
    for seed in range(2):
        points = simulated_scan(FIRST_SEED + seed, "vlp-16").points
        seen, expected = cropping(points).require_points(), whole(points).require_points()
        np.testing.assert_array_equal(seen.in_view, expected.in_view)
        assert seen.in_view.mean() > (0.7 if full_turn else 0.15)
        assert np.count_nonzero(expected.labels)
        assert (seen.labels == expected.labels).mean() > 0.99


def test_every_point_that_a_network_sees_is_kept() -> None:
    points = simulated_scan(FIRST_SEED).points
    perceive = Perceiver(provider="cpu", n_threads=1, on_mismatch="ignore")
    for card in perceive.cards:
        if isinstance(card.view, ObjectGeometry):
            continue
        index = np.empty((card.view.height, card.view.width), np.int32)
        pixel = np.empty(len(points), np.int32)
        values = np.empty((len(card.input.channels), *index.shape), np.float32)
        make_projector(card.view, card.input).fill(points, values, index, pixel, points[:, 2].copy())
        assert set(np.flatnonzero(pixel >= 0)) <= set(rows_of(pipeline_of(perceive).crop, points))
