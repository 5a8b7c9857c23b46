"""Training scans as sensors with other beams would have taken them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

pytest.importorskip("torch")

from edgeperc.inference.projection import make_projector
from edgeperc.simulation.samples import IGNORE, simulated_scan
from edgeperc.types.sensor import SENSORS, get_sensor
from edgeperc_export.cards import card_of
from edgeperc_export.data.augment import augmented
from edgeperc_export.data.beams import drawn_sensor, taken_by
from edgeperc_export.data.scan_sets import seen_by_network
from edgeperc_export.data.scans import LabeledScan
from edgeperc_export.recipe import Recipe
from edgeperc_export.release.thinned import main
from edgeperc_export.training.samples import Samples

SEED = 1_500_000_001


@pytest.fixture(scope="module")
def scan() -> LabeledScan:
    return LabeledScan.from_simulation(simulated_scan(SEED))


def elevations_deg(points: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))).astype(np.float64)


@pytest.mark.parametrize("name", ["vlp-16", "vlp-32c", "hdl-32e", "os1-64", "pandar64", "mid-360", "hap"])
def test_a_thinned_scan_fills_as_many_pixels_as_a_simulated_one(scan: LabeledScan, name: str) -> None:
    """Measured and interpolated pixels of the network's input, with the sensor in the same place of the same scene."""
    card = card_of(Recipe("pointseg", edge=True, height_above_ground=True), version="0")
    projector, sensor = make_projector(card.view, card.input), get_sensor(name)
    thinned = taken_by(sensor, scan, np.random.default_rng(0))
    true = replace(LabeledScan.from_simulation(simulated_scan(SEED, name)), sensor=sensor)
    counts = []
    for each in (thinned, true):
        seen, projected = seen_by_network(projector, each)
        assert len(seen.labels) == len(seen.points)
        measured = np.count_nonzero((projected.index >= 0) & (projected.index < len(each.points)))
        counts.append((measured, np.count_nonzero(projected.index >= len(each.points))))
    np.testing.assert_allclose(*counts, rtol=0.3)


@pytest.mark.parametrize("name", ["vlp-16", "pandarxt-32", "os0-128"])
def test_one_return_remains_in_each_column_of_the_nearest_beams(scan: LabeledScan, name: str) -> None:
    sensor = get_sensor(name)
    points = taken_by(sensor, scan, np.random.default_rng(0)).points
    assert 0.02 < len(points) / len(scan.points) < 0.6
    apart = np.abs(elevations_deg(points)[:, None] - np.array(sensor.elevations_deg)).min(1)
    assert np.quantile(apart, 0.99) < 0.8  # half a degree to the beam, and the beam's own noise
    own = np.array(SENSORS["hdl-64e"].elevations_deg)
    beam = np.abs(elevations_deg(points)[:, None] - own).argmin(1)
    column = np.floor(np.degrees(np.arctan2(points[:, 1], points[:, 0])) / sensor.azimuth_resolution_deg)
    _, counts = np.unique(np.stack([beam, column]), axis=1, return_counts=True)
    assert np.mean(counts == 1) > 0.95  # the nearest beam of a noisy return may be another one


def test_a_sensor_without_beams_has_points_in_its_field_of_view_alone(scan: LabeledScan) -> None:
    shares = []
    for accumulate_s in (0.1, 0.2, 0.5):
        sensor = get_sensor("mid-360").accumulated(accumulate_s)
        points = taken_by(sensor, scan, np.random.default_rng(0)).points
        assert elevations_deg(points).min() > sensor.fov_down_deg - 0.5
        shares.append(len(points))
    assert shares[0] < shares[1] < shares[2]


@pytest.fixture(scope="module")
def places(scan: LabeledScan) -> dict[tuple[float, ...], int]:
    """The label of the point at a place."""
    return {tuple(place): label for place, label in zip(scan.points[:, :3].tolist(), scan.labels, strict=True)}


@given(st.integers(0, 2**32))
@settings(max_examples=20)
def test_a_sparse_sensor_is_drawn_where_one_is_asked_for(seed: int) -> None:
    sensor = drawn_sensor(np.random.default_rng(seed), sparse=True)
    assert sensor.median_gap_deg >= 0.9
    assert sensor.name in ("random", "vlp-16", "hdl-32e", "pandarxt-32", "os0-32", "os1-32", "mid-360")


@given(st.integers(0, 2**32))
@settings(max_examples=20)
def test_points_labels_and_boxes_stay_together(
    scan: LabeledScan, places: dict[tuple[float, ...], int], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    sensor = drawn_sensor(rng)
    out = taken_by(sensor, scan, rng)
    assert out.points.dtype == np.float32
    assert ((out.points[:, 3] >= 0.0) & (out.points[:, 3] <= 1.0)).all()
    assert (out.boxes, out.counts, out.sensor) == (scan.boxes, scan.counts, sensor)
    assert all(
        places[tuple(place)] == label for place, label in zip(out.points[:, :3].tolist(), out.labels, strict=True)
    )


def test_empty_scans_and_those_of_another_sensor_are_as_they_were(scan: LabeledScan) -> None:
    rng, sensor = np.random.default_rng(0), get_sensor("vlp-16")
    empty = replace(scan, points=scan.points[:0], labels=scan.labels[:0])
    assert len(taken_by(sensor, empty, rng).points) == 0
    thinned = taken_by(sensor, scan, rng)
    for of_any in (False, True):
        assert taken_by(get_sensor("os1-64"), thinned, rng, of_any=of_any) is thinned
    assert augmented(thinned, rng, sensor=get_sensor("os1-64")).sensor == sensor


def test_scans_of_any_dense_sensor_are_thinned_where_it_is_asked_for() -> None:
    rng, sensor = np.random.default_rng(0), get_sensor("vlp-16")
    pandar = replace(LabeledScan.from_simulation(simulated_scan(SEED, "pandar64")), sensor=get_sensor("pandar64"))
    assert taken_by(sensor, pandar, rng) is pandar
    thinned = taken_by(sensor, pandar, rng, of_any=True)
    counts = [len(scan.points) for scan in (thinned, taken_by(sensor, replace(pandar, sensor=None), rng))]
    true = len(simulated_scan(SEED, "vlp-16").points)
    assert abs(counts[0] - true) < 0.25 * true < abs(counts[1] - true)  # by its own beams, which are few above
    apart = np.abs(elevations_deg(thinned.points)[:, None] - np.array(sensor.elevations_deg)).min(1)
    assert np.quantile(apart, 0.99) < 0.8


def test_the_recipe_says_how_often(tmp_path_factory: pytest.TempPathFactory, scan: LabeledScan) -> None:
    """The sectors of two scans are of one sensor, so that none is left out."""
    path = tmp_path_factory.mktemp("beams") / "000000.npz"
    scan.save(path)
    empty = []
    for beams in (0.0, 0.5, 1.0):
        recipe = Recipe("pointseg", edge=True, n_pasted=0.0, n_negatives=0.0, beams=beams, batch=8, swap=1.0)
        samples = Samples(recipe, [], [], [path])
        _, labels = samples.batch(0)
        empty.append(float(np.mean(labels == IGNORE)))
    np.testing.assert_array_equal(samples.batch(0)[1], labels)
    assert empty[0] < empty[1] < empty[2]


def test_a_drive_is_judged_by_its_last_scans(kitti_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    main([str(kitti_root), "--sensors", "vlp-16", "--drives", "0048", "--sweeps", "1", "3"])
    *_, alone, three = capsys.readouterr().out.splitlines()
    assert alone.startswith("| 0048 | vlp-16 | 1 | ")
    assert three.startswith("| 0048 | vlp-16 | 3 | ")
    for column in (3, 5):
        assert all(
            0.0 <= float(each) <= 100.0 or each == "nan" for each in three.strip(" |").split(" | ")[column].split(" / ")
        )
    assert three.split(" | ")[3] != alone.split(" | ")[3]
