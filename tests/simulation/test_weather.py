"""Dirt and weather in a scan: what is lost, where drops are, and what stays."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from edgeperc import OptionError
from edgeperc.simulation import random_scene, simulate, simulate_sequence, weather
from edgeperc.simulation.camera import forward_camera
from scenes import urban

Points = NDArray[np.float32]
KINDS: dict[str, Callable[[Points, float, int], Points]] = {
    "dirt": lambda scan, k, seed: weather.dirty(scan, 60.0, 60.0 - 20.0 * k, 0.9, seed=seed),
    "rain": lambda scan, k, seed: weather.rain(scan, 10.0 * k, seed=seed),
    "snow": lambda scan, k, seed: weather.snow(scan, 0.5 * k, seed=seed),
    "fog": lambda scan, k, seed: weather.fog(scan, 100.0 / k, seed=seed),
    "cloud": lambda scan, k, seed: weather.cloud(scan, (8.0, 0.0, -1.0), 2.5, 0.1 * k, seed=seed),
}


def changed(scan: Points, bad: Points) -> NDArray[np.bool_]:
    """Which points are no points of the scan in clear air."""
    known = {tuple(row) for row in scan[:, :3].tolist()}
    return np.array([tuple(row) not in known for row in bad[:, :3].tolist()], np.bool_)


@settings(max_examples=40)
@given(
    hnp.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(4)), elements=st.floats(0.0, 80.0, width=32)),
    st.sampled_from(sorted(KINDS)),
    st.sampled_from([0.1, 1.0, 5.0]),
)
def test_any_scan_stays_one(points: Points, kind: str, strength: float) -> None:
    before = points.copy()
    bad = KINDS[kind](points, strength, 3)
    np.testing.assert_array_equal(points, before)
    assert bad.dtype == np.float32
    assert bad.shape[1:] == (4,)
    assert len(bad) <= len(points)
    assert np.isfinite(bad).all()
    np.testing.assert_array_equal(bad, KINDS[kind](points, strength, 3))


@pytest.mark.parametrize("number", [0.0, -1.0, math.nan, "heavy"])
def test_numbers_out_of_their_range_are_refused(number: Any) -> None:
    """As of all simulations; they were complex, or divided by zero."""
    scan, scene = np.ones((1, 4), np.float32), random_scene(0)
    for name, simulate_it in {
        "rate_mm_h": lambda: weather.rain(scan, number),
        "rate_mm_h ": lambda: weather.snow(scan, number),
        "visibility_m": lambda: weather.fog(scan, number),
        "per_m": lambda: weather.cloud(scan, (8.0, 0.0, -1.0), 2.5, number),
        "rate_hz": lambda: next(simulate_sequence(scene, "vlp-16", 1, number)),
        "max_range_m": lambda: simulate(scene, "vlp-16", 0, max_range_m=number),
        "duration_s": lambda: simulate(scene, "mid-360", 0, duration_s=number),
        "fov_deg": lambda: forward_camera(fov_deg=number),
    }.items():
        with pytest.raises(OptionError, match=f"{name.strip()} is .*; expected a number from"):
            simulate_it()


@pytest.mark.parametrize("kind", ["rain", "snow", "fog", "cloud"])
def test_stronger_weather_has_more_drops_on_the_beams_before_their_targets(kind: str) -> None:
    scan = urban(3).points[::4]
    shares = []
    for strength in (1.0, 2.0, 5.0):
        bad = KINDS[kind](scan, strength, 0)
        drops = changed(scan, bad)
        shares.append(float(drops.mean()))
        far = np.linalg.norm(bad[drops, :3], axis=1)
        assert far.max() < 40.0
        assert (bad[drops, 3] <= 1.0).all()
    assert 0.0 < shares[0] < shares[1] < shares[2]


@pytest.mark.parametrize("kind", ["rain", "fog"])
def test_far_targets_are_lost_first(kind: str) -> None:
    scan = urban(4).points
    ranges = np.linalg.norm(scan[:, :3], axis=1)
    bad = KINDS[kind](scan, 5.0, 0)
    kept = np.linalg.norm(bad[~changed(scan, bad), :3], axis=1)
    near, far = ((kept < 10.0).sum() / (ranges < 10.0).sum(), (kept > 40.0).sum() / (ranges > 40.0).sum())
    assert near > 0.6
    assert far < 0.5 * near


@pytest.mark.parametrize(("left", "right"), [(60.0, 20.0), (10.0, -10.0), (-170.0, 160.0)])
def test_dirt_is_where_it_is(left: float, right: float) -> None:
    scan = urban(5).points
    azimuth = np.degrees(np.arctan2(*weather.dirty(scan, left, right)[:, 1::-1].T))
    assert not ((left - azimuth) % 360.0 <= (left - right) % 360.0).any()
    assert len(weather.dirty(scan, left, right, 0.5)) > len(azimuth)


@pytest.mark.parametrize("seed", range(3))
def test_a_cloud_is_a_ball(seed: int) -> None:
    scan = urban(6).points
    bad = weather.cloud(scan, (8.0, 1.0, -1.0), 2.0, 1.0, seed=seed)
    drops = bad[changed(scan, bad)]
    assert len(drops) > 100
    assert (np.linalg.norm(drops[:, :3] - (8.0, 1.0, -1.0), axis=1) < 2.001).all()
    assert (drops[:, 3] <= weather.DROP_REMISSION + 1e-6).all()
