"""The sensor that took a scan, found in its points."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edgeperc import read_points, read_scans
from edgeperc.errors import SensorError
from edgeperc.preprocess.sensor_estimate import SensorEstimate, estimate_sensor, fill_votes, has_enough_points
from edgeperc.simulation.samples import FIRST_SEED, simulated_scan
from edgeperc.types.points import Points
from edgeperc.types.sensor import SENSORS, SensorProfile
from twins.sensor_estimate import votes

CANNOT_TELL = "the sensor cannot be told from the scan"


def street(elevation: np.ndarray, azimuth: np.ndarray, rng: np.random.Generator, offset_m: float = 0.0) -> np.ndarray:
    """Points of rays [rad] on a road 1.8 m below, between walls and poles at many distances; 2 cm of noise."""
    walls = 6.0 + 30.0 * np.abs(np.sin(2.0 * azimuth)) + 9.0 * (np.sin(37.0 * azimuth) > 0.7)
    below = np.maximum(np.sin(-elevation), 1e-4)
    ranges = np.minimum((1.8 + offset_m) / below, walls / np.cos(elevation)) + rng.normal(0.0, 0.02, len(elevation))
    flat = ranges * np.cos(elevation)
    points = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(elevation) + offset_m], axis=1)
    seen = (ranges < 80.0) & (points[:, 2] < 6.0)
    return np.column_stack([points, rng.uniform(0.0, 255.0, len(points))])[seen].astype(np.float32)


def spinning(elevations_deg: np.ndarray, columns: int = 1200, seed: int = 0, noise_deg: float = 0.0) -> Points:
    """A scan of a sensor, beam by beam."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = np.meshgrid(np.radians(elevations_deg), np.linspace(0, 2 * math.pi, columns, endpoint=False))
    elevation, azimuth = elevation.T.ravel(), azimuth.T.ravel()
    return street(elevation + rng.normal(0.0, math.radians(noise_deg), len(elevation)), azimuth, rng)


def off_deg(estimate: SensorEstimate, elevations_deg: np.ndarray) -> float:
    """Largest distance from a beam found to one of the sensor's."""
    found = np.array(estimate.profile.elevations_deg)
    return float(np.abs(found[:, None] - elevations_deg).min(axis=1).max())


@pytest.mark.kernel
@pytest.mark.parametrize("n", [0, 1, 2, 300])
def test_votes_are_those_of_the_twin(n: int) -> None:
    rng = np.random.default_rng(n)
    flat, z = rng.uniform(0.0, 30.0, n), rng.normal(0.0, 3.0, n)
    for place, value in enumerate((math.nan, math.inf, -math.inf)):
        flat[n // 2 + place : n // 2 + place + 1] = value
        z[n // 3 + place : n // 3 + place + 1] = value
    offsets_m, found = np.array([-0.3, 0.0, 0.2]), np.full((3, 500), np.nan)
    fill_votes(flat, z, offsets_m, 0.9, found)
    np.testing.assert_array_equal(found, votes(flat.tolist(), z.tolist(), offsets_m.tolist(), 0.9, 500))


SPINNING = [name for name, profile in SENSORS.items() if profile.pattern is None]
SHUFFLED = ("vlp-16", "hdl-64e", "pandar64", "os0-32", "os1-128", "vlp-32c")


@pytest.mark.parametrize(
    ("name", "order"), [*((name, "as simulated") for name in SPINNING), *((name, "shuffled") for name in SHUFFLED)]
)
def test_built_in_sensors_are_found(name: str, order: str) -> None:
    sensor = replace(SENSORS[name], remission_range=(0.0, 1.0))
    scan = simulated_scan(FIRST_SEED, name).points
    if order == "shuffled":
        scan = np.random.default_rng(0).permutation(scan)
    try:
        found = estimate_sensor([scan])
    except SensorError:
        assert order == "shuffled"
        assert name == "os0-32"  # sees few points above, which no order parts
        return
    assert found.is_built_in
    assert found.profile == sensor
    assert found.off_deg <= 0.1
    assert abs(found.columns - sensor.columns) <= 0.02 * sensor.columns


@settings(max_examples=15)
@given(
    gaps_deg=st.lists(st.floats(0.3, 3.0), min_size=7, max_size=47),
    top_deg=st.floats(-2.0, 20.0),
    columns=st.sampled_from([900, 1200, 1800]),
    noise_deg=st.sampled_from([0.0, 0.01, 0.03]),
    is_shuffled=st.booleans(),
)
def test_any_beams_are_found_or_it_cannot_be_told(
    gaps_deg: list[float], top_deg: float, columns: int, noise_deg: float, is_shuffled: bool
) -> None:
    elevations_deg = top_deg - np.cumsum([0.0, *gaps_deg])
    elevations_deg = elevations_deg[elevations_deg > -50.0]
    scan = spinning(elevations_deg, columns, len(gaps_deg), noise_deg)
    if is_shuffled:
        scan = np.random.default_rng(1).permutation(scan)
    try:
        found = estimate_sensor([scan])
    except SensorError:
        return
    if found.doubt:
        assert (found.profile.name, found.n_beams) == ("beamless", 0)
        return
    assert off_deg(found, elevations_deg) <= 0.1
    assert found.n_beams <= len(elevations_deg)


@pytest.mark.parametrize("name", ["os0-64", "jt128", "rs-bpearl"])
def test_beams_to_the_sky_may_have_no_return(name: str) -> None:
    """The others are as if they all were; beams in the middle alone may be of another sensor."""
    scan = spinning(np.array(SENSORS[name].elevations_deg))
    elevation = np.degrees(np.arctan2(scan[:, 2], np.hypot(scan[:, 0], scan[:, 1])))
    found = estimate_sensor([scan[elevation < SENSORS[name].fov_down_deg + 35.0]])
    assert found.profile.name == name
    assert found.n_beams < 0.6 * SENSORS[name].n_beams
    if name == "os0-64":
        with pytest.raises(SensorError, match="a part of a scan, if it is of that sensor"):
            estimate_sensor([scan[np.abs(elevation) < 15.0]])


@pytest.mark.parametrize(("n", "up_deg", "down_deg"), [(16, 10.0, -20.0), (40, 7.0, -16.0), (96, 12.0, -24.0)])
def test_beams_of_an_unknown_sensor_are_its_profile(n: int, up_deg: float, down_deg: float) -> None:
    elevations_deg = np.linspace(up_deg, down_deg, n)
    found = estimate_sensor([spinning(elevations_deg, 1500, k) for k in range(3)])
    assert not found.is_built_in
    assert found.profile.n_beams == n
    assert off_deg(found, elevations_deg) <= 0.02
    assert found.columns == 1500
    assert found.profile.remission_range == (0.0, 255.0)
    assert f"{n} beams" in str(found)
    assert SensorProfile.from_json(found.profile.to_json()) == found.profile


@pytest.mark.parametrize("radius_m", [0.0, 0.04])
@pytest.mark.parametrize("seed", [9, 25, 32])
def test_beams_may_start_on_a_circle(radius_m: float, seed: int) -> None:
    """Only beams that meet walls show it: with few of them, noise is no circle."""
    top = [2.0, -1.0, -3.0, -4.0, -7.0] if radius_m == 0.0 else np.arange(2.0, -7.5, -0.5)
    elevations_deg = np.append(top, np.arange(-9.0, -50.0, -3.0))
    scan = spinning(elevations_deg, 900, seed, 0.03 if radius_m == 0.0 else 0.0).astype(np.float64)
    scan[:, :2] *= 1.0 + radius_m / np.hypot(scan[:, 0], scan[:, 1])[:, None]
    assert off_deg(estimate_sensor([scan.astype(np.float32)]), elevations_deg) <= 0.1


@pytest.mark.parametrize("offset_m", [-0.1, 0.05, 0.2])
def test_beams_may_start_above_the_origin(offset_m: float) -> None:
    elevations_deg = np.linspace(9.0, -18.0, 32)
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(np.radians(elevations_deg), np.linspace(0, 2 * math.pi, 1200, endpoint=False))
    scan = street(elevation.ravel(), azimuth.ravel(), rng, offset_m)
    found = estimate_sensor([scan])
    assert off_deg(found, elevations_deg) <= 0.1
    assert abs(float(np.median(found.offsets_m)) - offset_m) < 0.01


def moved(scan: Points, way_m: tuple[float, float]) -> Points:
    """A scan that was taken on the way, with all points as seen from the middle of it."""
    time = np.linspace(-0.5, 0.5, len(scan))[:, None]
    return (scan + np.array([*way_m, 0.0, 0.0]) * time).astype(np.float32)


@pytest.mark.parametrize("way_m", [(1.0, 0.0), (0.0, -0.8), (-0.5, 0.5)])
def test_motion_is_found(way_m: tuple[float, float]) -> None:
    """Points in the order of time, as a sensor sends them, moved to one time, as data sets have them."""
    elevations_deg = np.array(SENSORS["hdl-32e"].elevations_deg)
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(np.radians(elevations_deg), np.linspace(0, 2 * math.pi, 1084, endpoint=False))
    found = estimate_sensor([moved(street(elevation.ravel(), azimuth.ravel(), rng), way_m)])
    assert (found.profile.name, found.off_deg <= 0.1) == ("hdl-32e", True)


def test_upside_down_is_the_same_sensor() -> None:
    scan = simulated_scan(FIRST_SEED, "hdl-32e").points * np.array([1.0, -1.0, -1.0, 1.0], np.float32)
    assert estimate_sensor([scan]).profile.name == "hdl-32e"


RNG = np.random.default_rng(5)
N = 60_000
TURN = np.arange(N) * 0.137
CONE = np.radians(35.0) * np.cos(TURN)


@pytest.mark.parametrize("name", ["helios-16", "helios-32"])
def test_beams_of_two_sensors_are_neither(name: str) -> None:
    """The upper half of a Helios' beams are a Helios-16P's: hung in a field, where the others meet nothing, either."""
    hung = -np.array(SENSORS[name].elevations_deg)
    scan = spinning(hung[hung < 2.0], columns=1800)
    with pytest.raises(SensorError, match="of the 32 beams of the helios-32 or the 16 of the helios-16: a part"):
        estimate_sensor([scan])
    found = estimate_sensor([spinning(hung, columns=1800)])  # a wall shows the others
    assert found.profile.name == name


def voxels(scan: Points, size_m: float) -> Points:
    """The middle of the points in each cube."""
    _, cell, count = np.unique(
        np.floor(scan[:, :3] / size_m).astype(int), axis=0, return_inverse=True, return_counts=True
    )
    return np.stack([np.bincount(cell.ravel(), column) / count for column in scan.T], axis=1).astype(np.float32)


OTHERS: dict[str, Callable[[], np.ndarray]] = {
    "empty": lambda: np.empty((0, 4)),
    "one point": lambda: np.ones((1, 4)),
    "not finite": lambda: np.full((5000, 4), np.nan),
    "one place": lambda: np.tile([3.0, 1.0, -1.0, 7.0], (5000, 1)),
    "at the sensor": lambda: np.zeros((5000, 4)),
    "huge": lambda: RNG.uniform(-1e38, 1e38, (5000, 4)),
    "box": lambda: RNG.uniform(-40.0, 40.0, (N, 4)),
    "rosette": lambda: street(CONE * np.sin(0.23 * TURN + 1.0), CONE * np.cos(0.23 * TURN), RNG),
    "non-repeating, all around": lambda: street(
        np.radians(22.5 + 29.5 * np.sin(np.arange(N) * 0.3717)), np.arange(N) * 0.0171 % (2 * math.pi), RNG
    ),
    "solid state": lambda: street(
        np.radians(-12.5 + 0.25 * (np.arange(N) // 600)), np.radians(-60.0 + 0.2 * (np.arange(N) % 600)), RNG
    ),
    "quarter of a turn": lambda: (scan := spinning(np.linspace(9, -18, 40)))[
        np.abs(np.arctan2(scan[:, 1], scan[:, 0])) < 0.7
    ],
    "map": lambda: voxels(spinning(np.linspace(9, -18, 64)), 0.3),
    "a few of its beams": lambda: spinning(np.array(SENSORS["vlp-32c"].elevations_deg[10:20])),
    "remission below 0": lambda: spinning(np.linspace(9, -18, 32)) - np.array([0.0, 0.0, 0.0, 90.0]),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_cannot_be_told_is_refused(name: str) -> None:
    with pytest.raises(SensorError, match=rf"{CANNOT_TELL}.*(pass sensor=|convert them)"):
        estimate_sensor([OTHERS[name]().astype(np.float32)])


DENSE: dict[str, Callable[[], np.ndarray]] = {
    "plane": lambda: np.column_stack([RNG.uniform(-40.0, 40.0, (N, 2)), np.full(N, -1.7), np.ones(N)]),
    "random elevations": lambda: street(RNG.uniform(-0.4, 0.1, N), RNG.uniform(0.0, 6.28, N), RNG),
    "two sensors": lambda: np.concatenate(
        [spinning(np.linspace(9, -18, 32)), spinning(np.linspace(11, -21, 32)) + np.array([1.0, 0.5, -0.4, 0.0])]
    ),
}


@pytest.mark.parametrize("name", DENSE)
def test_a_dense_turn_without_beams_has_a_profile_for_such_and_its_doubt_is_told(name: str) -> None:
    scan = DENSE[name]().astype(np.float32)
    found = estimate_sensor([scan])
    assert (found.profile.name, found.is_built_in, found.n_beams) == ("beamless", False, 0)
    assert found.profile.fov_down_deg <= -10.0
    assert found.profile.remission_range[1] >= scan[:, 3].max()
    assert re.search("no beams stand out in its .*taken as a dense sensor.*pass sensor=", found.doubt)
    assert str(found) == "no beams found in the points"
    with pytest.raises(SensorError, match=f"{CANNOT_TELL}: no beams stand out"):  # too sparse
        estimate_sensor([scan[:: len(scan) // 20_000]])


@pytest.mark.parametrize("is_whole", [True, False], ids=["road", "trench ahead"])
@pytest.mark.parametrize(("name", "seed"), [("pandar64", 2), ("vlp-32c", 3), ("os1-64", 2)])
def test_without_beams_the_gaps_are_those_of_the_rings_on_the_ground(name: str, seed: int, is_whole: bool) -> None:
    """Beams that shake by 0.12 degrees; ground that is missing on one side is no gap between two beams."""
    points = simulated_scan(FIRST_SEED + seed, name).points
    flat, ahead = np.hypot(points[:, 0], points[:, 1]), np.abs(np.arctan2(points[:, 1], points[:, 0])) < 1.0
    elevation = np.arctan2(points[:, 2], flat) + np.radians(np.random.default_rng(0).normal(0.0, 0.12, len(flat)))
    shaken = np.column_stack([points[:, :2], flat * np.tan(elevation), points[:, 3]]).astype(np.float32)
    found = estimate_sensor([shaken[is_whole | ~(ahead & (flat > 7.0) & (flat < 12.0))]]).profile
    assert found.name == "beamless"
    right, beams = (-np.array(profile.elevations_deg) for profile in (SENSORS[name], found))
    beams = beams[(beams > 3.0) & (beams < 16.0)]
    places = 0.5 * (beams[1:] + beams[:-1])
    above = np.searchsorted(right, places)
    share = np.diff(beams) / (right[above] - right[above - 1])
    low, middle, high = np.quantile(share, (0.1, 0.5, 0.9))
    assert low > 0.4
    assert 0.7 < middle < 1.1
    assert high < 1.4


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["upright", "upside down"])
@pytest.mark.parametrize("name", [name for name, profile in SENSORS.items() if profile.pattern is not None])
def test_sensors_without_beams_are_named_by_their_field_of_view(name: str, way: float) -> None:
    scan = simulated_scan(FIRST_SEED + 1, name).points * np.array([1.0, way, way, 1.0], np.float32)
    with pytest.raises(
        SensorError, match=rf"{CANNOT_TELL}.*non-repeating.*by the field of view {name}\b.*pass sensor="
    ):
        estimate_sensor([scan])


MISTAKES = {"UTM": (512345, 5412345, 113, 0), "ECEF": (4.1e6, 6e5, 4.8e6, 0), "a local map": (-6000, 2000, 5, 0)}


@pytest.mark.parametrize(("name", "sensor"), [*zip(MISTAKES, ("hdl-64e", "vlp-32c", "os1-64"), strict=True)])
def test_a_mistake_in_the_coordinates_is_named(name: str, sensor: str) -> None:
    """It explains why there are no beams; the scan is of no sensor that does not spin."""
    scan = simulated_scan(FIRST_SEED + 2, sensor).points + np.array(MISTAKES[name])
    with pytest.raises(SensorError, match=rf"{CANNOT_TELL}\. The .* in the frame of a map.*--origin"):
        estimate_sensor([scan.astype(np.float32)])


@pytest.mark.parametrize(("unit", "factor"), [("millimeters", 1000.0), ("centimeters", 100.0), ("millimeters", 700.0)])
def test_another_unit_is_named(unit: str, factor: float) -> None:
    scan = (OTHERS | DENSE)["random elevations"]() * np.array([factor, factor, factor, 1.0])
    with pytest.raises(SensorError, match=rf"{CANNOT_TELL}\. The median distance .* in {unit}; convert them"):
        estimate_sensor([scan.astype(np.float32)])


@pytest.mark.parametrize("axes", [((1, -1), (2, -1), (0, 1)), ((1, -1), (2, 1), (0, 1)), ((2, 1), (0, 1), (1, 1))])
def test_other_axes_are_named(axes: tuple[tuple[int, int], ...]) -> None:
    points = simulated_scan(FIRST_SEED + 2, "os0-32").points
    scan = np.column_stack([*(sign * points[:, axis] for axis, sign in axes), points[:, 3]])
    with pytest.raises(SensorError, match=f"{CANNOT_TELL}. The ground seems to lie towards .[xy].*the axes are not"):
        estimate_sensor([scan.astype(np.float32)])


def test_scans_of_two_sensors_are_in_doubt_and_none_are_refused() -> None:
    with pytest.raises(SensorError, match="0 points"):
        estimate_sensor([])
    found = estimate_sensor([spinning(np.linspace(9, -18, 40)), spinning(np.linspace(12, -20, 30))])
    assert CANNOT_TELL in found.doubt.lower()


def test_blind_sectors_and_nearest_range() -> None:
    scan = spinning(np.linspace(9, -18, 40))
    azimuth = np.degrees(np.arctan2(scan[:, 1], scan[:, 0]))
    found = estimate_sensor([scan[(azimuth < 100.0) | (azimuth > 140.0)]])
    assert found.blind_deg == ((100.0, 140.0),)
    assert "100 to 140" in str(found)
    ranges = np.linalg.norm(scan[:, :3], axis=1)
    assert ranges.min() - 0.1 <= found.nearest_m <= np.quantile(ranges, 0.02)


@pytest.mark.parametrize(("scale", "most"), [(1.0 / 255.0, 1.0), (1.0, 255.0), (200.0, 65535.0)])
def test_range_of_remission(scale: float, most: float) -> None:
    scan = spinning(np.linspace(9, -18, 40))
    scan[:, 3] *= scale
    assert estimate_sensor([scan]).profile.remission_range == (0.0, most)


def test_a_scan_without_remission_shows_its_sensor() -> None:
    """Drivers that have no intensity write NaN."""
    scan = simulated_scan(FIRST_SEED, "vlp-16").points.copy()
    scan[:, 3] = np.nan
    assert has_enough_points(scan)
    assert estimate_sensor([scan]).profile is SENSORS["vlp-16"]


@pytest.mark.parametrize("kind", ["whole", "cropped", "cut short"])
def test_kitti_is_the_built_in_profile(kind: str, kitti_root: Path) -> None:
    names = {"whole": [0, 60, 200, 254, 330, 400], "cropped": [*range(307, 314)], "cut short": [253]}[kind]
    for number in names:
        scan = read_points(kitti_root / f"training/velodyne/{number:06d}.bin")
        assert estimate_sensor([scan]).profile is SENSORS["hdl-64e"], number


def test_semantickitti_is_the_built_in_profile(semantickitti_root: Path) -> None:
    """Its points are moved to one time."""
    scans = [read_points(path) for path in sorted((semantickitti_root / "sequences/00/velodyne").glob("*.bin"))[:3]]
    assert estimate_sensor(scans).profile is SENSORS["hdl-64e"]


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("nuscenes_sweep/*.bin", "hdl-32e"),
        ("velodyne/sample_velodyne_hdl32.pcap", "hdl-32e"),
        ("velodyne/sample_velodyne_vlp16_gps.pcap", "vlp-16"),
        ("pandaset/sensor/velodyne/000000.bin", "beamless"),  # about the vehicle, not the sensor
    ],
)
@pytest.mark.parametrize("turn_deg", [0.0, -140.0])
def test_real_scans(path: str, name: str, turn_deg: float, data_root: Callable[[str], Path]) -> None:
    if path.startswith("velodyne/"):
        pytest.importorskip("velodyne_decoder")
    (file,) = data_root("other_sensors").glob(path)
    _, scan = next(iter(read_scans(file)))
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    scan = scan.copy()
    scan[:, :2] = scan[:, :2] @ np.array([[cos, sin], [-sin, cos]], np.float32)
    found = estimate_sensor([scan])
    assert found.profile.name == name
    assert bool(found.doubt) == (name == "beamless")
