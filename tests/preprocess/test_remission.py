"""Remission is matched to the training sensor's if the profile does not fit, and a constant if it is missing."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from edgeperc import Perceiver
from edgeperc.datasets.kitti import KittiObjects
from edgeperc.errors import FitnessError, PointsError
from edgeperc.evaluation.metrics import Confusion
from edgeperc.evaluation.truth import kitti_truth
from edgeperc.preprocess import remission
from edgeperc.preprocess.condition import condition
from edgeperc.preprocess.remission import FROZEN_AFTER, NO_REMISSION, RemissionMatcher, is_missing
from edgeperc.preprocess.sensor_fit import N_STRATA, incidences, quantiles_by_stratum, remission_strata, stratify
from edgeperc.readers.files import read_points
from edgeperc.simulation.samples import IGNORE
from edgeperc.types.sensor import SENSORS, SensorProfile, get_sensor
from scenes import urban

HDL = get_sensor("hdl-64e")
BYTE = get_sensor("hdl-32e")


@pytest.fixture(scope="module")
def streets() -> list[np.ndarray]:
    """Six streets as the training sensor sees them; remission 0..1."""
    return [urban(seed).points for seed in range(6)]


def with_remission(scan: np.ndarray, values: np.ndarray | float) -> np.ndarray:
    changed = scan.copy()
    changed[:, 3] = values
    return changed


def as_bytes(scan: np.ndarray, share: float = 1.0) -> np.ndarray:
    """The scan with the raw bytes from which the profile of the HDL-32E gives its remission, scaled by ``share``."""
    a, b = BYTE.remission.coefficients
    return with_remission(scan, np.rint(share * np.clip(np.expm1((scan[:, 3] - a) / b), 0.0, 255.0)))


def after(scans: Sequence[np.ndarray], sensor: SensorProfile) -> tuple[RemissionMatcher, SensorProfile]:
    matcher, used = RemissionMatcher(sensor), sensor
    for scan in scans:
        matcher, used, _ = matcher.add(scan)
    return matcher, used


def test_some_points_are_whole_cells(streets: list[np.ndarray]) -> None:
    """Surfaces are fitted to all returns of a cell, so incidences of a part are those of the whole."""
    scan = streets[0]
    unique = with_remission(scan, np.arange(len(scan)))  # identifies the points
    strata, rows = stratify(unique, 20_000)
    assert 10_000 < len(rows) < 40_000
    all_strata, all_rows = stratify(unique)
    of_row = np.full(len(scan), -1)
    of_row[all_rows.astype(int)] = all_strata
    np.testing.assert_array_equal(of_row[rows.astype(int)], strata)
    cells = np.floor(scan[:, :3] / np.float32(0.8)).astype(int)
    chosen = {tuple(cell) for cell in cells[rows.astype(int)]}
    left_out = np.setdiff1d(all_rows.astype(int), rows.astype(int))
    assert not chosen & {tuple(cell) for cell in cells[left_out]}
    assert quantiles_by_stratum([stratify(scan)]) == remission_strata([scan])
    share, all_share = (np.bincount(s, minlength=N_STRATA) / len(s) for s in (strata, all_strata))
    np.testing.assert_allclose(share, all_share, atol=0.08)


def test_strata_of_no_points() -> None:
    for empty in (np.empty((0, 4), np.float32), np.full((5, 4), np.nan, np.float32)):
        strata, rows = stratify(empty, 20_000)
        assert len(strata) == len(rows) == len(incidences(empty[:0])) == 0
    with pytest.raises(PointsError, match=r"\(5, 3\)"):
        stratify(np.zeros((5, 3), np.float32))


def test_a_profile_that_fits_is_kept(streets: list[np.ndarray]) -> None:
    """The very profile is returned, so that not a bit of the scan changes."""
    for sensor, scans in ((HDL, streets), (BYTE, [as_bytes(scan) for scan in streets])):
        matcher = RemissionMatcher(sensor)
        for n, scan in enumerate(scans, start=1):
            matcher, used, findings = matcher.add(scan)
            assert used is sensor
            assert findings == ()
            assert matcher.n_scans == min(n, FROZEN_AFTER)
        assert matcher.is_complete


@pytest.mark.parametrize("share", [1 / 8, 1 / 3])
def test_darker_bytes_are_matched(streets: list[np.ndarray], share: float) -> None:
    """As nuScenes has them: an eighth of what the profile of the sensor expects."""
    for scan in streets[:2]:
        dark = as_bytes(scan, share)
        matcher, used, findings = RemissionMatcher(BYTE).add(dark)
        assert matcher.matched is used.remission is not None
        assert used.remission.source == "matched to 1 scan, quantiles by range and incidence"
        assert not any(finding.gross for finding in findings)
        assert "matched to the first 5 scans" in findings[0]
        found, wrong = condition(dark, used)[0][:, 3], condition(dark, BYTE)[0][:, 3]
        shares = np.linspace(0.05, 0.95, 19)
        error, before = (
            np.abs(np.quantile(v, shares) - np.quantile(scan[:, 3], shares)).mean() for v in (found, wrong)
        )
        assert error < 0.05
        assert before > 0.1


def test_a_sensor_without_a_function_gets_one(streets: list[np.ndarray]) -> None:
    sensor = get_sensor("os1-64")
    assert sensor.remission is None
    matcher, used = after([as_bytes(scan) for scan in streets], sensor)
    assert used.remission is matcher.matched is not None
    assert used == replace(sensor, remission=used.remission)
    found = condition(as_bytes(streets[5]), used)[0][:, 3]
    assert abs(np.median(found) - np.median(streets[5][:, 3])) < 0.06


@settings(max_examples=25)
@given(name=st.sampled_from(sorted(SENSORS)), gain=st.floats(0.05, 1.0), power=st.floats(0.3, 4.0), whole=st.booleans())
def test_functions_keep_the_order_and_stay_in_0_to_1(
    streets: list[np.ndarray], name: str, gain: float, power: float, whole: bool
) -> None:
    sensor = get_sensor(name)
    top = sensor.remission_range[1]
    raw = top * gain * streets[0][:, 3] ** power
    _, used, _ = RemissionMatcher(sensor).add(with_remission(streets[0], np.rint(raw) if whole else raw))
    ramp = np.full((2000, 4), 10.0, np.float32)
    ramp[:, 3] = np.linspace(0.0, top, len(ramp))
    converted = condition(ramp, used)[0][:, 3]
    assert (np.diff(converted) >= 0.0).all()
    assert converted[0] >= 0.0
    assert converted[-1] <= 1.0


def test_the_training_sensor_is_converted_only_if_far_off(streets: list[np.ndarray]) -> None:
    darker, far_off = (with_remission(streets[0], share * streets[0][:, 3]) for share in (0.6, 0.1))
    assert RemissionMatcher(HDL).add(darker)[1] is HDL
    other = replace(HDL, name="mine")
    assert RemissionMatcher(other).add(darker)[1] is not other
    _, used, findings = RemissionMatcher(HDL).add(far_off)
    assert used.remission is not None
    assert "after scaling of the profile hdl-64e is unlike" in findings[0]


def test_usual_remission_of_the_training_sensor_is_not_looked_at_further(
    streets: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    far_off = [with_remission(scan, 0.1 * scan[:, 3]) for scan in streets]
    matched, used = after([far_off[0], *streets], HDL)  # an unusual scan first: all are looked at
    assert matched.n_scans == FROZEN_AFTER
    assert matched.matched is None

    looked_at = []

    def counted(scan: np.ndarray, n_points: int) -> tuple[np.ndarray, np.ndarray]:
        looked_at.append(scan)
        return stratify(scan, n_points)

    monkeypatch.setattr(remission, "stratify", counted)
    for scans in (streets, [streets[0], *far_off]):  # one usual scan is enough: a sensor does not change
        matcher, used = after(scans, HDL)
        assert used is HDL
        assert matcher.is_complete
    assert not looked_at
    for scan, sensor in ((far_off[0], HDL), (streets[0], replace(HDL, name="mine")), (streets[0][:900], HDL)):
        after([scan], sensor)
    assert len(looked_at) == 3


def test_what_is_out_of_range_is_left_to_the_check(streets: list[np.ndarray]) -> None:
    """A wrong remission_range is reported as before; matching would hide it."""
    raw = as_bytes(streets[0])
    for wrong in (raw[:, 3] * 257.0, raw[:, 3] / 255.0, raw[:, 3] - 50.0, np.where(raw[:, 3] > 20.0, 1e38, raw[:, 3])):
        matcher, used, findings = RemissionMatcher(BYTE).add(with_remission(raw, wrong))
        assert used is BYTE
        assert matcher.n_scans == len(findings) == 0
    unknown = replace(BYTE, remission=replace(BYTE.remission, to="another"))
    assert RemissionMatcher(unknown).add(as_bytes(streets[0], 1 / 8))[1] is unknown


def test_five_scans_settle_it(streets: list[np.ndarray]) -> None:
    dark = [as_bytes(scan, 1 / 8) for scan in streets]
    matcher = RemissionMatcher(BYTE)
    functions, told = [], []
    for scan in dark[:FROZEN_AFTER]:
        before, state = matcher, dict(vars(matcher))
        matcher, used, findings = matcher.add(scan)
        assert vars(before) == state  # the earlier matcher is as it was
        functions.append(used.remission)
        told += findings
    assert len(told) == 1
    assert len(set(functions)) == FROZEN_AFTER
    for scan in (as_bytes(streets[5]), dark[5], dark[0][:10]):
        matcher, used, findings = matcher.add(scan)
        assert (used.remission, findings) == (functions[-1], ())
    assert after(dark[:3], BYTE)[0].matched == functions[2]  # the same scans, the same function


def test_a_function_is_dropped_only_well_below_the_limit(
    streets: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mean differences of the profile, one for each scan; a matched function has none."""
    for off, wanted in (
        ([0.079, 0.081, 0.07, 0.061, 0.059], [False, True, True, True, False]),
        ([0.09, 0.05, 0.07, 0.079, 0.081], [True, False, False, False, True]),
    ):
        now = iter(off)
        monkeypatch.setattr(remission, "quantile_difference", lambda raw, t, s: next(now) if s is BYTE else 0.0)  # noqa: B023
        matcher, found = RemissionMatcher(BYTE), []
        for scan in streets[: len(off)]:
            matcher, used, _ = matcher.add(as_bytes(scan, 1 / 8))
            found.append(used is not BYTE)
        assert found == wanted


def test_few_points_are_not_used(streets: list[np.ndarray]) -> None:
    for few in (streets[0][:0], streets[0][:1], streets[0][:900]):
        matcher, used, findings = RemissionMatcher(BYTE).add(as_bytes(few, 1 / 8))
        assert used is BYTE
        assert matcher.n_scans == len(findings) == 0


def test_missing() -> None:
    assert is_missing(np.zeros((300, 4), np.float32))
    assert not is_missing(np.zeros((299, 4), np.float32))
    assert not is_missing(np.empty((0, 4), np.float32))
    assert not is_missing(np.full((1000, 4), np.nan, np.float32))
    for one in (-1.0, 0.3, 1e38):
        scan = np.full((1000, 4), one, np.float32)
        assert is_missing(scan)
        scan[::2, 3] = np.nan
        assert is_missing(scan)
        scan[700, 3] = np.inf
        assert is_missing(scan)
        scan[701, 3] = 0.5
        assert not is_missing(scan)


def test_a_scan_without_remission_gets_a_constant(streets: list[np.ndarray]) -> None:
    for sensor in (HDL, BYTE, get_sensor("os1-64")):
        matcher, used, (finding,) = RemissionMatcher(sensor).add(with_remission(streets[0], 0.0))
        assert used == replace(sensor, remission=NO_REMISSION)
        assert not finding.gross
        assert finding.startswith("The scan has no remission")
        converted, n_dropped = condition(with_remission(streets[0], 0.0), used)
        assert n_dropped == 0
        assert np.unique(converted[:, 3]).tolist() == [np.float32(NO_REMISSION.coefficients[0])]
        assert matcher.add(with_remission(streets[1], 7.0))[1:] == (used, ())  # reported once
        # Remission that comes later is used.
        later = streets[1] if sensor is HDL else as_bytes(streets[1])
        assert matcher.add(later)[1].remission != NO_REMISSION


STRANGE = [0.0, 1.0, -1.0, 0.5, 255.0, 65535.0, 1e-40, 1e38, -1e38, np.inf, -np.inf, np.nan]


@settings(max_examples=150)
@given(
    name=st.sampled_from(["hdl-64e", "hdl-32e", "os1-64"]),
    values=st.lists(st.one_of(st.sampled_from(STRANGE), st.floats(width=32)), min_size=1, max_size=4),
    seed=st.integers(0, 2**32 - 1),
    n_strange=st.integers(0, 60),
)
def test_any_remission_is_survived(
    streets: list[np.ndarray], name: str, values: list[float], seed: int, n_strange: int
) -> None:
    """Whole scans of a few values, finite or not, at points that are finite or not."""
    rng = np.random.default_rng(seed)
    scan = with_remission(streets[0], rng.choice(np.array(values, np.float32), len(streets[0])))
    scan[rng.integers(0, len(scan), n_strange), rng.integers(0, 4, n_strange)] = rng.choice(STRANGE, n_strange)
    before = scan.copy()
    matcher, used, findings = RemissionMatcher(get_sensor(name)).add(scan)
    np.testing.assert_array_equal(scan, before)
    assert not any(finding.gross for finding in findings)
    assert (used.remission is None) or np.isfinite(used.remission.coefficients).all()
    if matcher.matched is not None or used.remission == NO_REMISSION:
        converted = condition(scan, used)[0]
        assert (np.isnan(converted[:, 3]) | ((converted[:, 3] >= 0.0) & (converted[:, 3] <= 1.0))).all()


@settings(max_examples=60)
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(4)), elements=st.floats(width=32)))
def test_any_points_are_survived(points: np.ndarray) -> None:
    tiled = np.tile(points, (30, 1))
    matcher, used, _ = RemissionMatcher(BYTE).add(tiled)
    strata, rows = stratify(tiled, 100)
    assert len(strata) == len(rows)
    assert ((strata >= 0) & (strata < N_STRATA)).all()
    assert used is BYTE or matcher.matched is not None or used.remission == NO_REMISSION


def perceiver(sensor: SensorProfile | str = "hdl-64e", **options: object) -> Perceiver:
    return Perceiver("pointseg", sensor=sensor, provider="cpu", n_threads=1, **options)


def heard(perceive: Perceiver, points: np.ndarray) -> tuple[object, list[str]]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return perceive(points), [str(warning.message) for warning in caught]


def about_remission(texts: Sequence[str]) -> list[str]:
    return [text for text in texts if "remission" in text.lower()]


def test_a_scan_without_remission_is_perceived_and_reported_once(streets: list[np.ndarray]) -> None:
    perceive = perceiver()
    for n, scan in enumerate(streets[:3]):
        points = np.ascontiguousarray(scan[:, :3]) if n else with_remission(scan, 0.0)
        found, warned = heard(perceive, points)
        assert found.remission == NO_REMISSION
        assert found.to_dict()["remission"]["coefficients"] == NO_REMISSION.coefficients
        for texts in (found.fitness, warned):
            assert len(about_remission(texts)) == (n == 0)
        assert "adapt" in found.stage_ms
    perceive.reset_mounting()
    assert about_remission(heard(perceive, with_remission(streets[0], 0.0))[0].fitness)
    silent, warned = heard(perceiver(on_mismatch="ignore"), with_remission(streets[0], 0.0))
    assert silent.fitness == ()
    assert (silent.remission, warned) == (NO_REMISSION, [])
    with pytest.raises(FitnessError, match="The scan has no remission"):
        perceiver(on_mismatch="raise")(with_remission(streets[0], 0.0))
    unchanged = perceiver(adapt="none", on_mismatch="warn")
    found, _ = heard(unchanged, with_remission(streets[0], 0.0))
    assert found.remission is None
    assert about_remission(found.fitness)[0].startswith("Remission is 0 for 100%")


def test_remission_that_vanishes_is_reported(streets: list[np.ndarray]) -> None:
    """After the scans that are checked, it is a warning and never an error."""
    perceive = perceiver(on_mismatch="raise")
    for _ in range(5):
        assert heard(perceive, streets[1])[0].remission is None
    found, warned = heard(perceive, with_remission(streets[0], 0.0))
    assert found.remission == NO_REMISSION
    assert len(found.fitness) == len(warned) == 1
    found, warned = heard(perceive, streets[1])
    assert (found.remission, found.fitness, warned) == (None, (), [])


def test_a_refused_scan_teaches_nothing(streets: list[np.ndarray]) -> None:
    perceive = perceiver(BYTE)
    upside_down = as_bytes(streets[0], 1 / 8) * np.float32([1, -1, -1, 1])
    for _ in range(2):
        with pytest.raises(FitnessError, match=r"upside down.*matched to the first"):
            perceive(upside_down)
    found, warned = heard(perceive, as_bytes(streets[0]))
    assert found.remission == BYTE.remission
    assert not any("matched" in text for text in warned)


def test_reset_and_options(streets: list[np.ndarray]) -> None:
    perceive = perceiver(BYTE, on_mismatch="ignore")
    dark = as_bytes(streets[0], 1 / 8)
    found = perceive(dark)
    assert found.remission.source.startswith("matched to 1 scan,")
    assert perceive(dark).remission.source.startswith("matched to 2 scans,")
    perceive.reset_mounting()
    again = perceive(dark)
    assert again.remission == found.remission
    np.testing.assert_array_equal(again.points.labels, found.points.labels)
    for adapt in ("none", "interpolation"):
        assert perceiver(BYTE, on_mismatch="ignore", adapt=adapt)(dark).remission is None
    assert perceiver(BYTE, on_mismatch="ignore", adapt="remission")(dark).remission == found.remission


def test_kitti_scans_are_not_converted(kitti_root: Path) -> None:
    with (kitti_root / "frames.csv").open() as file:
        names = [row["name"] for row in csv.DictReader(file)]
    for name in names[::9]:
        scan = read_points(kitti_root / "training" / "velodyne" / f"{name}.bin")
        matcher, used, findings = RemissionMatcher(HDL).add(scan)
        assert used is HDL, name
        assert matcher.n_scans == 1
        assert findings == ()


def test_kitti_scans_without_remission(kitti_root: Path) -> None:
    """IoU of cars: the constant loses less than 25 points, and at least 20 points less than zeros."""
    objects = KittiObjects(kitti_root)
    perceivers = {adapt: perceiver(adapt=adapt, on_mismatch="ignore") for adapt in ("both", "none")}
    counts = {name: Confusion(("background", "car", "pedestrian", "cyclist")) for name in ("recorded", *perceivers)}
    for name in objects.names("validation")[::8]:
        truth = kitti_truth(objects.frame(name), None)
        for kind, count in counts.items():
            points = truth.points if kind == "recorded" else with_remission(truth.points, 0.0)
            found = perceivers.get(kind, perceivers["both"])(points).points
            counted = found.in_view & (truth.labels != IGNORE)
            count.update(found.labels[counted], truth.labels[counted])
    cars = {kind: count.iou()[1] for kind, count in counts.items()}
    assert cars["both"] > cars["recorded"] - 0.25
    assert cars["both"] > cars["none"] + 0.2
