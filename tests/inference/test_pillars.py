"""The pillars of a scan: the kernels against their twin."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import twins.pillars
from edgeperc.inference.pillars import Pillarizer
from edgeperc.types.card import CHANNELS, InputSpec
from edgeperc.types.detector import PillarGeometry

VIEW = PillarGeometry((0.0, 4.0), (-2.0, 2.0), (-3.0, 1.0), 0.5, 3, 6, 0.0, 0.0, "num_points", "coors")
EVERY = CHANNELS["pillars"]
RAW = ("x", "y", "z", "remission")
# The first example compiles the kernels.

coordinates = st.floats(-3.0, 5.0, width=32) | st.sampled_from([0.0, -0.0, 4.0, 0.5, math.nan, math.inf, -math.inf])
clouds = st.lists(st.tuples(coordinates, coordinates, coordinates, st.floats(0.0, 1.0, width=32)), max_size=60).map(
    lambda rows: np.array(rows, np.float32).reshape(-1, 4)
)


def compare(maker: Pillarizer, points: NDArray[np.float32], channels: tuple[str, ...]) -> int:
    n = maker.fill(points)
    mean, std = np.arange(len(channels)) / 8.0, 1.0 + np.arange(len(channels)) / 4.0
    values, counts, places, n_left_out = twins.pillars.pillars(points, VIEW, channels, mean, std)
    assert (n, maker.n_left_out) == (len(counts), n_left_out)
    np.testing.assert_array_equal(maker.pillars.counts[:n], counts)
    np.testing.assert_array_equal(maker.pillars.places[:n], places)
    np.testing.assert_allclose(maker.pillars.values[:n], values, atol=1e-5)
    return n


def maker_of(channels: tuple[str, ...]) -> Pillarizer:
    mean, std = np.arange(len(channels)) / 8.0, 1.0 + np.arange(len(channels)) / 4.0
    return Pillarizer(VIEW, InputSpec("voxels", channels, tuple(mean.tolist()), tuple(std.tolist())))


@pytest.mark.kernel
@settings(max_examples=60)
@given(clouds, clouds, st.sampled_from([EVERY, RAW, EVERY[::-1], ("range",)]))
def test_pillars_match_the_slow_twin(
    points: NDArray[np.float32], later: NDArray[np.float32], channels: tuple[str, ...]
) -> None:
    """Two scans, one after the other, in the same buffers."""
    maker = maker_of(channels)
    compare(maker, points, channels)
    compare(maker, later, channels)


@pytest.mark.kernel
@pytest.mark.parametrize("n", [0, 1, 2000])
def test_empty_one_point_and_many(n: int) -> None:
    """Of many points, the first ones in the first pillars stay."""
    points = np.random.default_rng(n).uniform((-1, -3, -4, 0), (5, 3, 2, 1), (n, 4)).astype(np.float32)
    points[:1] = (1.0, 0.0, 0.0, 0.5)
    maker = maker_of(EVERY)
    assert compare(maker, points, EVERY) == {0: 0, 1: 1, 2000: VIEW.max_pillars}[n]


@pytest.mark.kernel
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("column", [0, 1, 2, 3])
def test_a_point_that_is_not_finite_is_in_no_pillar(value: float, column: int) -> None:
    points = np.tile(np.float32([1.0, 0.0, 0.0, 0.5]), (2, 1))
    points[0, column] = value
    maker = maker_of(RAW)
    assert maker.fill(points) == 1
    assert maker.pillars.counts[0] == 1
    assert np.isfinite(maker.pillars.values[0]).all()


@pytest.mark.kernel
@pytest.mark.parametrize(
    ("y_m", "row"), [(-36.0, 23), (-34.08, 34), (-31.84, 49), (-29.6, 63), (13.6, 333), (38.4, 488), (39.52, 495)]
)
def test_points_on_edges_are_where_spconv_and_mmcv_have_them(y_m: float, row: int) -> None:
    """Both divide in float32; a KITTI scan, rounded to a millimetre, has hundreds of such points (spconv 2.3.8)."""
    view = replace(VIEW, x_range_m=(0.0, 69.12), y_range_m=(-39.68, 39.68), cell_m=0.16)
    maker = Pillarizer(view, InputSpec("voxels", RAW, (0.0,) * 4, (1.0,) * 4))
    assert maker.fill(np.array([(1.0, y_m, 0.0, 0.5)], np.float32)) == 1
    assert maker.pillars.places[0, 2] == row


@pytest.mark.parametrize(
    ("x_range_m", "y_range_m", "is_all_around"),
    [
        ((0.0, 69.12), (-39.68, 39.68), False),
        ((-51.2, 51.2), (-51.2, 51.2), True),
        ((-5.12, 69.12), (-39.68, 39.68), False),
    ],
)
def test_whether_a_view_is_all_around(
    x_range_m: tuple[float, float], y_range_m: tuple[float, float], is_all_around: bool
) -> None:
    view = replace(VIEW, x_range_m=x_range_m, y_range_m=y_range_m, cell_m=0.16)
    assert view.is_all_around is is_all_around
