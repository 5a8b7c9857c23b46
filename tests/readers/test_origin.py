"""The place of the sensor is found in scans whose coordinates are those of a map, or refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from edgeperc.errors import PointsError
from edgeperc.readers.files import read_points
from edgeperc.readers.origin import bins_of, fill_contrasts, find_place
from edgeperc.simulation.samples import simulated_scan
from edgeperc.types.mounting import Mounting
from twins.origin import contrast


@pytest.mark.kernel
@pytest.mark.filterwarnings("ignore:.*encountered")
@pytest.mark.parametrize("n", [0, 1, 2, 300])
@pytest.mark.parametrize("width_deg", [0.05, 0.1])
def test_contrasts_are_those_of_the_twin(n: int, width_deg: float) -> None:
    rng, bins = np.random.default_rng(n), bins_of(width_deg)
    points = rng.normal(0.0, (20.0, 20.0, 2.0), (n, 3))
    for place, value in enumerate((np.nan, np.inf, -np.inf, 1e308)):
        points[place * n // 5 : place * n // 5 + 1, place % 3] = value
    level = [[0.0, 0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 1.0, 0.0, 0.0]]
    leaning = [[1.0, 0.0, 1.0, 0.2, -0.1], [1.0, -2.0, 1.0, 0.2, 0.0]]
    seen_from = np.array([*level, *leaning, [1.0, -2.0, 1.0, 0.0, 0.0]])
    if n:
        seen_from[2, :3] = points[-1]  # a point in the place itself
    found = np.full(len(seen_from), np.nan)
    fill_contrasts(points, seen_from, bins, found)
    np.testing.assert_allclose(found, [contrast(points, each, bins) for each in seen_from], rtol=1e-9)


PLACES = {"UTM": (512345.25, 5412345.5, 113.0), "local": (-35.5, 20.25, 7.0), "ECEF": (4.1e6, 6.2e5, 4.8e6)}


def in_map(points: NDArray[np.float32], place: tuple[float, float, float], yaw_deg: float) -> NDArray[np.float64]:
    """The scan of a level sensor at a place, turned about z."""
    return points[:, :3].astype(np.float64) @ Mounting(0.0, 0.0, 0.0, yaw_deg).rotation().T + place


@pytest.mark.parametrize(
    ("sensor", "place", "yaw_deg"),
    [("hdl-64e", "UTM", 0.0), ("vlp-16", "ECEF", -77.0), ("os1-64", "local", 130.0), ("hdl-32e", "UTM", 0.0)],
)
def test_the_place_of_a_level_sensor(sensor: str, place: str, yaw_deg: float) -> None:
    points = simulated_scan(len(place), sensor).points
    np.testing.assert_allclose(find_place(in_map(points, PLACES[place], yaw_deg)), PLACES[place], atol=0.1)


@pytest.mark.filterwarnings("error")
def test_damaged_coordinates_are_left_out() -> None:
    xyz = in_map(simulated_scan(3, "os1-64").points, PLACES["UTM"], 0.0)
    for k, damaged in enumerate((-3.4e38, 1.7e308, 1e4)):
        xyz[k::100, 2], xyz[k + 7 :: 100, 0] = damaged, -damaged
    np.testing.assert_allclose(find_place(xyz), PLACES["UTM"], atol=0.1)


@pytest.mark.parametrize("values", [1e30, 1e300, 1e5])
def test_points_that_are_all_far_apart_are_refused(values: float) -> None:
    xyz = np.random.default_rng(0).normal(0.0, values, (5000, 3))
    with pytest.raises(PointsError, match="within 1000 m of most"):
        find_place(xyz)


def test_the_places_of_real_scans(kitti_root: Path) -> None:
    """KITTI's lasers sit 0.21 and 0.12 m above the origin of its scans."""
    files = sorted(kitti_root.glob("training/velodyne/*.bin"))[:480:240]
    for file in files:
        x, y, z = np.subtract(find_place(in_map(read_points(file), PLACES["UTM"], 40.0)), PLACES["UTM"]).tolist()
        assert np.hypot(x, y) < 0.1
        assert 0.1 < z < 0.3


def leaning(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    return xyz @ Mounting(0.0, 6.0, -5.0, 0.0).rotation().T


def moved_point_by_point(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """As the driving sensor that took them one after another was not in one place."""
    return xyz + np.linspace(0.0, 3.0, len(xyz))[np.random.default_rng(0).permutation(len(xyz)), None] * [1.0, 0.2, 0.0]


SPOILT: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "leaning": leaning,
    "moved point by point": moved_point_by_point,
    "no beams": lambda xyz: xyz + np.random.default_rng(1).normal(0.0, 0.3, xyz.shape),
    "a part of a turn": lambda xyz: xyz[np.abs(np.arctan2(xyz[:, 1], xyz[:, 0])) < 0.3],
    "few points": lambda xyz: xyz[::100],
    "not finite": lambda xyz: xyz * np.nan,
    "empty": lambda xyz: xyz[:0],
    "one place": lambda xyz: xyz * 0.0,
    "random": lambda xyz: np.random.default_rng(2).normal(0.0, 30.0, xyz.shape),
    "flat": lambda xyz: xyz * [1.0, 1.0, 0.0],
}


@pytest.mark.parametrize("kind", SPOILT)
def test_a_place_that_cannot_be_told_is_refused(kind: str) -> None:
    points = SPOILT[kind](simulated_scan(2, "vlp-16").points[:, :3].astype(np.float64)) + PLACES["UTM"]
    with pytest.raises(PointsError, match=r"place of the sensor cannot be told .*--origin X Y Z"):
        find_place(points)
