"""One sensor's points as another's: the paper's table, fits without pairs, and points that lie between others."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import twins.condition
from cli_helpers import Shell
from edgeperc import Perceiver
from edgeperc.datasets.kitti import scan_hash
from edgeperc.errors import PointsError, SensorError, SplitError
from edgeperc.evaluation.transfer import compare
from edgeperc.inference.projection import RangeImageProjector
from edgeperc.preprocess import sensor_fit
from edgeperc.preprocess.condition import condition, render
from edgeperc.preprocess.interpolation import Interpolator
from edgeperc.types.card import InputSpec
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.sensor import SENSORS, RemissionFunction, SensorProfile, get_sensor
from edgeperc.types.views import RangeImageGeometry
from scenes import urban

HDL = get_sensor("hdl-64e")
VIEW = RangeImageGeometry(HDL.elevations_deg)
SPEC = InputSpec("image", ("range",), (0.0,), (1.0,))
LOGARITHM = RemissionFunction("logarithm", (-0.1, 0.15), 255.0, "hdl-64e", 0.0, "")
FUNCTIONS = (
    LOGARITHM,
    replace(LOGARITHM, kind="linear", coefficients=(0.1, 0.004)),
    replace(LOGARITHM, kind="polynomial", coefficients=(0.2, 0.004, -2e-5)),
)
POWER = replace(LOGARITHM, kind="power", coefficients=(0.06, 0.4))

# KUL-Seg, Table 4: Ouster's and Velodyne's intensity of vehicle, truck, ground and pillar.
OUSTER, VELODYNE = np.array([45.91, 714.50, 113.28, 376.01]), np.array([3.78, 123.38, 5.60, 108.64])


def test_ranking_of_functions_matches_the_papers_table() -> None:
    """The ranking of the paper's Table 5: logarithm 58.26, line 72.12, parabola 132.87."""
    best, *others = sensor_fit.fit_functions(
        OUSTER, VELODYNE / 255.0, full_scale=9000.0, to="hdl-64e", source="KUL-Seg"
    )
    assert [f.kind for f in (best, *others)] == ["logarithm", "linear", "polynomial", "power"]
    assert [round(255.0 * f.rmse, 1) for f in (best, *others)] == [35.1, 56.1, 177.0, 199.5]
    np.testing.assert_allclose(np.multiply(best.coefficients, 255.0), np.polyfit(np.log1p(OUSTER), VELODYNE, 1)[::-1])
    np.testing.assert_allclose(np.multiply(others[0].coefficients, 255.0), np.polyfit(OUSTER, VELODYNE, 1)[::-1])
    np.testing.assert_allclose(np.multiply(others[1].coefficients, 255.0), np.polyfit(OUSTER, VELODYNE, 2)[::-1])
    assert (best.full_scale, best.to, best.source) == (9000.0, "hdl-64e", "KUL-Seg")
    # On the four pairs themselves the parabola is nearest, which is why cross-validation ranks the functions.
    terms = np.stack([np.ones(4), OUSTER, OUSTER**2], axis=1)
    errors = terms @ others[1].coefficients - VELODYNE / 255.0
    assert 255.0 * np.sqrt(np.mean(errors**2)) < 11.0


@settings(max_examples=40)
@given(
    st.sampled_from(FUNCTIONS),
    st.floats(-0.5, 0.5),
    st.floats(0.01, 2.0),
    st.integers(0, 2**32 - 1),
    st.sampled_from([255.0, 100.0, 1.0]),
)
def test_exact_pairs_recover_the_function_in_any_unit(
    shape: RemissionFunction, offset: float, size: float, seed: int, unit: float
) -> None:
    x = np.random.default_rng(seed).uniform(0.0, 255.0, 60)
    wanted = offset + size * _value(shape, x)
    best = sensor_fit.fit_functions(unit / 255.0 * x, wanted, full_scale=unit, to="hdl-64e", source="")[0]
    assert best.full_scale == pytest.approx(255.0)
    assert best.rmse < 1e-9 * (1.0 + np.abs(wanted).max())
    np.testing.assert_allclose(_value(best, x), wanted, atol=1e-7)


@settings(max_examples=40)
@given(st.floats(0.12, 3.8), st.floats(0.05, 1.0), st.integers(0, 2**32 - 1))
def test_powers_are_recovered(exponent: float, top: float, seed: int) -> None:
    """Exponents are tried in steps of 6 %."""
    x = np.random.default_rng(seed).uniform(0.0, 255.0, 60)
    functions = sensor_fit.fit_functions(x, top * (x / 255.0) ** exponent, full_scale=255.0, to="hdl-64e", source="")
    found = next(function for function in functions if function.kind == "power")
    assert found.coefficients[1] == pytest.approx(exponent, rel=0.07)
    np.testing.assert_allclose(_value(found, x), top * (x / 255.0) ** exponent, atol=0.03 * top)
    assert found.rmse < 0.03 * top


def _value(function: RemissionFunction, x: np.ndarray) -> np.ndarray:
    if function.kind == "power":
        return function.coefficients[0] * x ** function.coefficients[1]
    if function.kind == "logarithm":
        return function.coefficients[0] + function.coefficients[1] * np.log1p(x)
    return sum(c * x**k for k, c in enumerate(function.coefficients))


@pytest.mark.parametrize(
    ("raw", "wanted", "message"),
    [
        ([1, 2, 3], [1, 2, 3], "3 finite pairs"),
        ([1, 2, 3, np.nan, 5], [1, 2, 3, 4, np.inf], "3 finite pairs"),
        ([7, 7, 7, 7, 7], [1, 2, 3, 4, 5], "5 finite pairs of 1 raw values"),
        ([1, 2, 3, 4], [1, 2, 3], "4 raw values and 3 wanted ones"),
    ],
)
def test_too_few_pairs_are_refused(raw: list[float], wanted: list[float], message: str) -> None:
    with pytest.raises(SensorError, match=message):
        sensor_fit.fit_functions(raw, wanted, full_scale=255.0, to="hdl-64e", source="")


def plane(n: int, normal: np.ndarray, at: np.ndarray, seed: int) -> np.ndarray:
    """Points on a plane around a place."""
    rng = np.random.default_rng(seed)
    along = np.linalg.svd(normal[None])[2][1:]
    return (at + rng.uniform(-0.39, 0.39, (n, 2)) @ along).astype(np.float32)


@settings(max_examples=30)
@given(hnp.arrays(np.float64, 3, elements=st.floats(-1.0, 1.0)), st.integers(0, 2**32 - 1))
def test_incidence_on_a_plane(normal: np.ndarray, seed: int) -> None:
    if np.linalg.norm(normal) < 0.1:
        return
    normal = normal / np.linalg.norm(normal)
    middle = np.array([10.0, 4.0, 1.2])  # of a cell of 0.8 m
    points = plane(400, normal, middle, seed)
    points = points[(np.floor(points / 0.8) == np.floor(middle / 0.8)).all(axis=1)]
    if len(points) < 50:
        return
    wanted = np.abs(points @ normal) / np.linalg.norm(points, axis=1)
    found = sensor_fit.incidences(np.column_stack([points, np.zeros(len(points))]).astype(np.float32))
    np.testing.assert_allclose(found, wanted, atol=0.02)


def test_incidence_without_a_surface_is_nan() -> None:
    rng = np.random.default_rng(1)
    leaves = rng.uniform([8.0, 0.0, 0.0], [8.8, 0.8, 0.8], (500, 3))
    beam = np.column_stack([np.full(50, 20.1), np.linspace(0.01, 0.79, 50), np.full(50, 0.1)])
    strange = np.array([[np.nan, 0, 0], [np.inf, 1, 1], [1e30, 0, 0], [0, 0, 0]])
    points = np.column_stack([np.vstack([leaves, beam, strange]), np.zeros(554)]).astype(np.float32)
    assert np.isnan(sensor_fit.incidences(points)).all()
    assert sensor_fit.incidences(points[:0]).shape == (0,)
    assert np.isnan(sensor_fit.incidences(points[:1])).all()


def street(seed: int) -> np.ndarray:
    return urban(seed).points.copy()


def test_function_is_recovered_from_other_streets() -> None:
    """A sensor that says exp of the HDL-64E's remission: seen in streets that the reference knows nothing of."""
    scans = [street(k) for k in (11, 12, 13)]
    for scan in scans:
        scan[:, 3] = np.rint(np.expm1((scan[:, 3] + 0.1) / 0.15))
    found = sensor_fit.fit_sensor(scans, SensorProfile("mine", HDL.elevations_deg, 2083, (0.0, 255.0)))
    best = found[1][0]
    assert best.kind == "logarithm"
    assert found[0].remission is best
    x = np.expm1((np.array([0.1, 0.2, 0.3, 0.4, 0.5]) + 0.1) / 0.15)
    # Simulated streets are not KITTI's; the same streets through `match_quantiles` below give 0.01.
    np.testing.assert_allclose(_value(best, x), [0.1, 0.2, 0.3, 0.4, 0.5], atol=0.08)
    own = sensor_fit.remission_strata([street(k) for k in (14, 15, 16)])
    raw, wanted = sensor_fit.match_quantiles(sensor_fit.remission_strata(scans), own)
    assert len(raw) == sensor_fit.N_SHARES
    assert (np.diff(raw) >= 0.0).all()
    assert (np.diff(wanted) >= 0.0).all()
    again = sensor_fit.fit_functions(raw, wanted, full_scale=255.0, to="hdl-64e", source="")[0]
    np.testing.assert_allclose(_value(again, x), [0.1, 0.2, 0.3, 0.4, 0.5], atol=0.05)


def test_parabola_that_turns_down_is_not_used() -> None:
    """The best fit is a parabola that turns down before full scale; the second best is used."""
    x = np.linspace(0.0, 100.0, 60)
    wanted = 0.9 * x / 100.0 - 0.4 * (x / 100.0) ** 2
    for full_scale, used in ((100.0, 0), (4000.0, 1)):
        functions = sensor_fit.fit_functions(x, wanted, full_scale=full_scale, to="hdl-64e", source="")
        assert functions[0].kind == "polynomial"
        assert sensor_fit.increasing(functions) is functions[used]


def test_strata_with_few_points_are_empty() -> None:
    nothing = [(0.0, ())] * sensor_fit.N_STRATA
    few = np.tile(np.array([[5.0, 0.0, 0.0, 9.0]], np.float32), (199, 1))
    assert sensor_fit.remission_strata([]) == sensor_fit.remission_strata([few]) == nothing
    assert sensor_fit.remission_strata([np.full((500, 4), np.nan, np.float32)]) == nothing
    assert [len(a) for a in sensor_fit.match_quantiles(nothing, sensor_fit.REFERENCES["hdl-64e"])] == [0, 0]
    with pytest.raises(SensorError, match="0 finite pairs"):
        sensor_fit.fit_sensor([few], get_sensor("vlp-16"))
    with pytest.raises(SensorError, match="no reference remissions of 'vlp-16'; known are hdl-64e"):
        sensor_fit.fit_sensor([few], get_sensor("vlp-16"), "vlp-16")
    with pytest.raises(PointsError, match=r"shape \(3, 3\)"):
        sensor_fit.remission_strata([np.zeros((3, 3), np.float32)])


@given(
    function=st.sampled_from([*FUNCTIONS, POWER]),
    points=hnp.arrays(np.float32, st.tuples(st.integers(0, 20), st.just(4)), elements=st.floats(width=32)),
)
def test_rendering_agrees_with_the_twin(function: RemissionFunction, points: np.ndarray) -> None:
    sensor = replace(get_sensor("vlp-16"), remission_range=(5.0, 105.0), remission=function)
    before = points.copy()
    with np.errstate(over="ignore", invalid="ignore"):
        wanted = twins.condition.rendered(points, function, sensor.remission_range)
    found = render(points, sensor)
    np.testing.assert_array_equal(points, before)
    np.testing.assert_array_equal(found[:, :3], points[:, :3])
    np.testing.assert_allclose(found[:, 3], wanted[:, 3], atol=1e-6)
    finite = np.isfinite(points[:, 3])
    assert ((found[finite, 3] >= 0.0) & (found[finite, 3] <= 1.0)).all()
    assert np.isnan(found[~finite, 3]).all()


def test_rendering_uses_the_profiles_range() -> None:
    """The same values as bytes and scaled to 0..1 render alike."""
    byte = replace(get_sensor("pandar64"), remission=LOGARITHM)
    raw = np.column_stack([np.ones((256, 3)), np.arange(256)]).astype(np.float32)
    scaled = raw / np.array([1, 1, 1, 255], np.float32)
    np.testing.assert_allclose(render(raw, byte), render(scaled, replace(byte, remission_range=(0.0, 1.0))), atol=1e-6)
    with pytest.raises(SensorError, match="has no remission function"):
        render(raw, HDL)
    with pytest.raises(PointsError, match="float64"):
        render(raw.astype(np.float64), byte)


def test_built_in_functions_match_their_source() -> None:
    functions = {name: profile.remission for name, profile in SENSORS.items() if profile.remission}
    assert set(functions) == {"hdl-32e", "vlp-16", "vlp-16-hi-res", "vlp-32c", "vls-128", "pandar64"}
    for function in functions.values():
        assert function.kind == "logarithm"
        assert (function.to, function.full_scale) == ("hdl-64e", 255.0)
        assert "scans, quantiles by range and incidence" in function.source


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(schema=1), "schema 1; expected 2"),
        (lambda d: d.pop("schema"), "schema None"),
        (lambda d: d.pop("columns"), "lacks columns"),
        (lambda d: d.update(color="red"), "unknown entries color; expected some of columns, ego_box"),
        (lambda d: d.update(columns="1800"), "columns is '1800'; expected a whole number"),
        (lambda d: d.update(columns=True), "columns is True; expected a whole number"),
        (lambda d: d.update(elevations_deg=["1", 0]), r"elevations_deg\[0\] is '1'; expected a number"),
        (lambda d: d.update(elevations_deg=[0, 1]), "strictly decrease"),
        (lambda d: d.update(elevations_deg=None), "elevations_deg is None; expected a list of numbers"),
        (lambda d: d.update(remission=3), "remission is 3; expected an object with coefficients"),
        (lambda d: d["remission"].pop("kind"), "remission lacks kind"),
        (lambda d: d["remission"].update(kind="cubic"), "kind is 'cubic'; expected one of linear"),
        (lambda d: d["remission"].update(coefficients=[1.0]), "expected a list of 2 numbers"),
        (
            lambda d: d["remission"].update(coefficients=[1.0, float("nan")]),
            r"coefficients\[1\] is nan; expected a number",
        ),
        (lambda d: d["remission"].update(kind="power", coefficients=[1.0, 0.0]), "expected an exponent above 0"),
        (lambda d: d["remission"].update(full_scale=0), "full_scale is 0.0; expected a number above 0"),
        (lambda d: d["remission"].update(rmse=-1), "rmse is -1.0; expected a number from 0"),
        (lambda d: d["remission"].update(to=""), "expected two texts"),
        (lambda d: d["remission"].update(to=7), "remission.to is 7; expected a text"),
    ],
)
def test_wrong_profile_names_the_fault(change: object, message: str, tmp_path: Path) -> None:
    document = json.loads(get_sensor("vlp-16").to_json())
    change(document)  # type: ignore[operator]
    file = tmp_path / "sensor.json"
    file.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(SensorError, match=message) as caught:
        get_sensor(file)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize("text", ["", "[]", "7", "{", "[" * 100_000, "\xff"])
def test_file_that_is_not_a_profile_is_refused(text: str, tmp_path: Path) -> None:
    file = tmp_path / "sensor.json"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(SensorError, match=r"sensor\.json"):
        get_sensor(file)
    with pytest.raises(SensorError, match="cannot be read"):
        get_sensor(tmp_path / "none.json")
    with pytest.raises(SensorError, match="RemissionFunction or None"):
        replace(HDL, remission=0.5)


def test_only_scans_of_a_coarser_sensor_are_interpolated() -> None:
    assert not Interpolator(VIEW, HDL).needed
    for name in ("hdl-32e", "vlp-16", "vlp-32c", "os1-64", "os0-32", "pandar64"):
        assert Interpolator(VIEW, get_sensor(name)).needed
    fine = SensorProfile.uniform("fine", 256, 5.0, -26.0, columns=4096)
    assert not Interpolator(VIEW, fine).needed
    assert Interpolator(VIEW, replace(fine, columns=1024)).needed


@pytest.mark.parametrize("name", ["mid-360", "hap", "avia"])
def test_points_that_lie_at_random_are_joined_however_the_sensor_is_mounted(name: str) -> None:
    """A wall ahead, seen by as many points as the sensor has in its time, is filled but for a few pixels."""
    sensor = get_sensor(name)
    field_deg2 = sensor.pattern.width_deg * (sensor.fov_up_deg - sensor.fov_down_deg)
    n = int(90.0 * 26.0 * sensor.pattern.points_per_s * sensor.pattern.accumulate_s / field_deg2)
    rng = np.random.default_rng(0)
    azimuth, elevation = np.radians(rng.uniform(-45.0, 45.0, n)), np.radians(rng.uniform(-24.0, 2.0, n))
    wall = np.column_stack(
        [np.full(n, 10.0), 10.0 * np.tan(azimuth), 10.0 * np.tan(elevation) / np.cos(azimuth), np.full(n, 0.5)]
    ).astype(np.float32)
    index = project(wall)
    interpolator = Interpolator(VIEW, sensor)
    assert interpolator.needed
    filled = interpolator.fill(wall, index)[1] >= 0
    assert filled.mean() > 0.9
    turned = replace(sensor, elevations_deg=tuple(-deg for deg in reversed(sensor.elevations_deg)))
    np.testing.assert_array_equal(Interpolator(VIEW, turned).fill(wall, index)[1] >= 0, filled)
    spun = replace(sensor, pattern=None, elevations_deg=tuple(np.linspace(2.0, -24.0, sensor.n_beams)))
    assert (Interpolator(VIEW, spun).fill(wall, index)[1] >= 0).mean() < filled.mean()


def project(points: np.ndarray, view: RangeImageGeometry = VIEW) -> np.ndarray:
    return RangeImageProjector(view, SPEC).project(points).index


def twin(
    points: np.ndarray, index: np.ndarray, view: RangeImageGeometry, sensor: SensorProfile
) -> tuple[np.ndarray, ...]:
    """Reaches are computed here anew, beam by beam, from the rule as it is written."""
    rows = np.array(view.row_elevations_deg)
    place = np.interp(-np.array(sensor.elevations_deg), -rows, np.arange(len(rows)), left=-1, right=len(rows))
    reach = np.zeros(len(rows), int)
    for upper, lower in pairwise(place):
        for row in range(len(rows)):
            spans = np.floor(upper) <= row <= np.ceil(lower)
            if spans and lower - upper > 1.1 and upper >= 0 and lower < len(rows):
                reach[row] = max(reach[row], int(np.ceil(lower - upper)) + 1)
    step = (view.azimuth_left_deg - view.azimuth_right_deg) / view.width
    azimuths = np.radians(view.azimuth_left_deg - (np.arange(view.width) + 0.5) * step)
    across = 360.0 / sensor.columns / step
    col_reach = int(across) + 1 if across > 1.1 else 0
    return twins.condition.between(points, index, np.radians(rows), azimuths, reach, col_reach, -1.73)


SMALL = RangeImageGeometry(tuple(np.linspace(2.0, -24.0, 14)), width=24, azimuth_left_deg=20.0, azimuth_right_deg=-20.0)
COARSE = SensorProfile.uniform("coarse", 6, 2.0, -24.0, columns=90)


def sparse_scan(seed: int, n: int) -> np.ndarray:
    """Rays of the coarse sensor onto a floor, a wall and a few things before it."""
    rng = np.random.default_rng(seed)
    beams = np.radians(rng.choice(COARSE.elevations_deg, n))
    azimuths = np.radians(rng.choice(np.arange(-22.0, 22.0, 4.0), n) + rng.uniform(-0.3, 0.3, n))
    floor = np.where(beams < -0.01, 1.73 / np.maximum(np.sin(-beams), 1e-3), np.inf)
    range_m = np.minimum(floor, rng.choice([6.0, 8.0, 8.3, 12.0, 30.0], n) + rng.uniform(0.0, 0.3, n))
    xyz = np.stack([np.cos(beams) * np.cos(azimuths), np.cos(beams) * np.sin(azimuths), np.sin(beams)], axis=1)
    return np.column_stack([xyz * range_m[:, None], rng.uniform(0.0, 1.0, n)]).astype(np.float32)


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1), st.integers(0, 120))
def test_interpolation_agrees_with_the_twin_and_its_documentation(seed: int, n: int) -> None:
    points = sparse_scan(seed, n)
    index = project(points, SMALL)
    before, index_before = points.copy(), index.copy()
    wanted, wanted_index, parents = twin(points, index, SMALL, COARSE)
    dense, filled = Interpolator(SMALL, COARSE).fill(points, index)

    np.testing.assert_array_equal(points, before)
    np.testing.assert_array_equal(index, index_before)
    taken = wanted_index >= 0
    np.testing.assert_array_equal(filled >= 0, taken)
    # New points are in another order than the twin's.
    np.testing.assert_allclose(dense[filled[taken]], wanted[wanted_index[taken]], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(dense[:n], points)
    np.testing.assert_array_equal(filled[index >= 0], index[index >= 0])
    assert sorted(filled[filled >= n].tolist()) == list(range(n, len(dense)))  # each in one pixel
    for new, (i, j) in zip(wanted[n:], parents, strict=True):
        one, other = wanted[i].astype(np.float64), wanted[j].astype(np.float64)
        assert twins.condition.one_surface(one, other, -1.73)
        low, high = np.minimum(one, other) - 1e-4, np.maximum(one, other) + 1e-4
        assert ((new >= low) & (new <= high)).all()  # between them in every coordinate, remission included


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1), st.integers(1, 120))
def test_interpolated_point_falls_into_its_pixel(seed: int, n: int) -> None:
    """So that the image the network sees is that of a scan."""
    points = sparse_scan(seed, n)
    dense, filled = Interpolator(SMALL, COARSE).fill(points, project(points, SMALL))
    again = RangeImageProjector(SMALL, SPEC).project(dense)
    rows, cols = np.nonzero(filled >= n)
    # A point between two of one column lies in that column, not in its middle, and one between columns likewise.
    at = again.pixel[filled[rows, cols]]
    assert (np.abs(at // SMALL.width - rows) <= 1).all()
    assert (np.abs(at % SMALL.width - cols) <= 1).all()


def column(*ranges_m: float) -> np.ndarray:
    """Returns of the coarse sensor's beams straight ahead, from the top beam down; 0 for none."""
    e = np.radians(COARSE.elevations_deg[: len(ranges_m)])
    away = np.array(ranges_m)
    points = np.stack([away * np.cos(e), np.full(len(e), -1e-3), away * np.sin(e), np.full(len(e), 0.5)], axis=1)
    return points[away > 0.0].astype(np.float32)


def new_points(points: np.ndarray, sensor: SensorProfile = COARSE) -> np.ndarray:
    return Interpolator(SMALL, sensor).fill(points, project(points, SMALL))[0][len(points) :]


def test_no_interpolation_across_a_depth_edge() -> None:
    wall = new_points(column(10.0, 10.1, 10.2))
    assert len(wall) > 2
    assert (np.abs(np.linalg.norm(wall[:, :3], axis=1) - 10.1) < 0.3).all()
    assert len(new_points(column(30.0, 10.0))) == 0  # a wall far behind a car
    assert len(new_points(column(10.0, 10.6))) == 0
    assert len(new_points(column(10.0, 0.0, 10.0))) == 0  # a beam between them returned nothing
    assert len(new_points(column(10.0))) == 0
    assert len(new_points(column())) == 0


def test_rings_on_the_ground_are_joined_and_roofs_are_not() -> None:
    e = np.sin(np.radians(COARSE.elevations_deg))
    floor = column(0, 0, *(1.73 / -e[2:4]))
    assert np.ptp(np.linalg.norm(floor[:, :3], axis=1)) > 2.0
    rings = new_points(floor)
    assert len(rings) > 0
    np.testing.assert_allclose(rings[:, 2], -1.73, atol=1e-4)
    # As far apart and as level, but a meter above the road: the bonnet of one car and the next one's.
    assert len(new_points(column(0, 0, *(0.73 / -e[2:4])))) == 0


def test_non_finite_points_stay_in_place() -> None:
    points = np.vstack([column(10.0, 10.1, 10.2), np.full((2, 4), np.nan), [[np.inf, 0, 0, 0]]]).astype(np.float32)
    dense, filled = Interpolator(SMALL, COARSE).fill(points, project(points, SMALL))
    np.testing.assert_array_equal(dense[: len(points)], points)
    assert np.isfinite(dense[len(points) :]).all()
    assert len(dense) > len(points)
    assert not np.isin(filled, [3, 4, 5]).any()


def test_wrong_arrays() -> None:
    fill = Interpolator(SMALL, COARSE).fill
    with pytest.raises(PointsError, match=r"index of shape \(2, 2\)"):
        fill(column(10.0), np.zeros((2, 2), np.int32))
    with pytest.raises(PointsError, match="of these points"):
        fill(column(10.0), np.full((14, 24), 7, np.int32))
    with pytest.raises(PointsError, match="float64"):
        fill(column(10.0).astype(np.float64), np.full((14, 24), -1, np.int32))


# Nothing but the sensor adapts the scan; a tilted street does not move it.
ALONE = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore", "mounting": MODEL_MOUNTING}


@pytest.mark.parametrize("name", ["vlp-16", "os1-64"])
def test_labels_are_only_of_input_points(name: str) -> None:
    points = urban(4, name).points.copy()
    points[::97] = np.nan
    before = points.copy()
    own = replace(get_sensor(name), remission_range=(0.0, 1.0), remission=None)  # the simulator's is the HDL-64E's
    answers = {}
    for adapt in ("none", "interpolation"):
        perceive = Perceiver("pointseg", sensor=own, adapt=adapt, **ALONE)
        answers[adapt] = perceive(points)
        assert ("adapt" in answers[adapt].stage_ms) == (adapt == "interpolation")
        assert perceive(points[:0]).points.labels.shape == (0,)
    np.testing.assert_array_equal(points, before)
    one, other = answers["none"].points, answers["interpolation"].points
    assert one.labels.shape == other.labels.shape == (len(points),)
    np.testing.assert_array_equal(one.in_view, other.in_view)
    assert (one.labels != other.labels).any()


def test_scans_of_the_training_sensor_are_not_adapted() -> None:
    points = urban(4).points
    answers = [Perceiver("pointseg", adapt=adapt, **ALONE)(points) for adapt in ("both", "none")]
    np.testing.assert_array_equal(answers[0].points.labels, answers[1].points.labels)
    assert all("adapt" not in answer.stage_ms for answer in answers)
    with pytest.raises(ValueError, match="adapt is 'all'; expected none, remission"):
        Perceiver("pointseg", adapt="all")


def test_rendered_scan_gives_the_reference_result() -> None:
    """Remission taken through a function's inverse and rendered back: the same result as without both."""
    points = urban(4).points
    distorted = points.copy()
    distorted[:, 3] = np.expm1((points[:, 3].astype(np.float64) + 0.1) / 0.15)
    sensor = replace(HDL, remission_range=(0.0, 255.0), remission=LOGARITHM)
    given = Perceiver("pointseg", **ALONE)(points).points
    rendered = Perceiver("pointseg", sensor=sensor, **ALONE)(distorted)
    assert "adapt" in rendered.stage_ms
    plain = Perceiver("pointseg", sensor=sensor, adapt="none", **ALONE)(distorted)
    changed, changed_plain = (np.count_nonzero(each.points.labels != given.labels) for each in (rendered, plain))
    assert changed < 0.001 * len(points)
    assert changed * 10 < changed_plain


def test_adapt_fit_writes_what_run_takes(tmp_path: Path, shell: Shell) -> None:
    scans, out = tmp_path / "scans", tmp_path / "profiles" / "mine.json"
    scans.mkdir()
    for k in range(2):
        scan = urban(k, "vlp-16").points.copy()
        scan[:, 3] = np.rint(np.expm1((scan[:, 3] + 0.1) / 0.15))
        scan.tofile(scans / f"{k}.bin")
    fit = ["fit-sensor", str(scans), "--sensor", "vlp-16", "--to", "hdl-64e", "--out", str(out)]
    found = shell.out(*fit).splitlines()
    kinds = [line.split()[0] for line in found]
    assert kinds[0] == "logarithm"
    assert sorted(kinds) == ["linear", "logarithm", "polynomial", "power", "written"]
    profile = get_sensor(out)
    assert profile == replace(get_sensor("vlp-16"), remission=profile.remission)
    assert profile.remission.source == "quantiles by range and incidence of 2 scans"
    out.write_text(replace(profile, mounting=MODEL_MOUNTING).to_json())  # nothing else changes the scan
    run = ["run", str(scans / "0.bin"), "--sensor", str(out), "--model", "pointseg", "--provider", "cpu", "--json"]
    assert "adapt" in json.loads(shell.out(*run, "--on-mismatch", "ignore"))["stage_ms"]
    assert "adapt" not in json.loads(shell.out(*run, "--on-mismatch", "ignore", "--adapt", "none"))["stage_ms"]
    for wrong in ([*fit[:-1], str(tmp_path / "mine.txt")], [*fit[:3], "vlp-17", *fit[4:]], [*fit[:5], "x", *fit[6:]]):
        assert shell.err(*wrong).startswith("edgeperc: ")
    (tmp_path / "none").mkdir()
    assert "no scan in this folder" in shell.err("fit-sensor", tmp_path / "none", *fit[2:])


def folder_of(root: Path, scans: dict[str, np.ndarray], **description: Any) -> Path:
    """Labeled scans, whose files of boxes are empty."""
    for part in ("velodyne", "label"):
        (root / part).mkdir(parents=True)
    for name, points in scans.items():
        points.tofile(root / f"velodyne/{name}.bin")
        (root / f"label/{name}.txt").touch()
    (root / "scans.json").write_text(json.dumps({"schema": 1, "sensor": "hdl-64e"} | description))
    return root


def test_eval_sensors_counts_test_drives_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan, names = urban(4), {"car": "car", "*": "ignore"}
    splits = {"train": ["a"], "test": ["b"]}
    folder_of(tmp_path, dict.fromkeys("ab", scan.points), boxes=names, splits=splits)
    assert compare([str(tmp_path)], "pointseg")[str(tmp_path)]["n_scans"] == 1
    seen = {"pointseg 1": {scan_hash(scan.points)}}
    monkeypatch.setattr("edgeperc.evaluation.transfer.training_scans_of", lambda cards: seen)
    with pytest.raises(SplitError, match="was trained on scan b"):
        compare([str(tmp_path)], "pointseg")


def test_eval_sensors_finds_the_mounting_of_each_drive(tmp_path: Path) -> None:
    """An empty road that a low and tilted sensor sees changes nothing in the figures of another vehicle."""
    scan = urban(4)
    cos, sin = np.cos(np.radians(5.0)), np.sin(np.radians(5.0))
    road = scan.points[scan.points[:, 2] < -1.5].copy()
    road[:, :3] = (road[:, :3] + [0.0, 0.0, 0.9]) @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]).T
    boxes = [" ".join(map(str, (box.label, *box.center, *box.size, box.yaw))) for box in scan.boxes]
    for name, drives in (("alone", "b"), ("both", "aaaaab")):
        scans = {f"{k}": road if drive == "a" else scan.points for k, drive in enumerate(drives)}
        folder = folder_of(tmp_path / name, scans, boxes={"car": "car", "*": "ignore"})
        rows = ["name,drive", *(f"{k},{drive}" for k, drive in enumerate(drives))]
        (folder / "frames.csv").write_text("\n".join(rows))
        (folder / f"label/{len(drives) - 1}.txt").write_text("\n".join(boxes))
    alone, both = (compare([str(tmp_path / name)])[str(tmp_path / name)] for name in ("alone", "both"))
    assert both["n_scans"] == 6
    for adaptation in ("none", "both"):
        assert both[adaptation]["iou"]["car"] == alone[adaptation]["iou"]["car"]


def test_eval_sensors_measures_points_where_the_objects_network_was_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    scan = urban(4)
    folder_of(tmp_path, {"a": scan.points}, boxes={"*": "ignore"})
    seen = {"objects 1": {scan_hash(scan.points)}}
    monkeypatch.setattr("edgeperc.evaluation.judge.training_scans_of", lambda cards: seen)
    printed = shell.out("eval-sensors", tmp_path)
    assert "no boxes: objects 1 was trained on scan a of drive" in printed
    assert "IoU of points" in printed


def test_eval_sensors(tmp_path: Path, shell: Shell) -> None:
    """Two simulated scans, and the same street as boxes and as range images."""
    scan = urban(4)
    boxes, images = tmp_path / "boxes", tmp_path / "images"
    images.mkdir()
    near = scan.points[np.hypot(*scan.points[:, :2].T) < 40.0]
    # Fired together: all beams of one azimuth, then the next.
    near = near[np.lexsort((near[:, 2], np.round(np.arctan2(near[:, 1], near[:, 0]) / 0.003)))]
    columns = ["class", "-", "x", "y", "z", "l", "w", "h", "yaw"]
    names = {name: name for name in ("car", "van", "truck", "pedestrian", "cyclist")} | {"*": "ignore"}
    folder_of(boxes, {"a": near + np.array([3.0, -2.0, 0.5, 0.0], np.float32)}, boxes=names, box_columns=columns)
    with (boxes / "label" / "a.txt").open("w") as file:
        for box in scan.boxes:
            x, y, z = np.add(box.center, (3.0, -2.0, 0.5))
            print(box.label.title(), 0, x, y, z, *box.size, box.yaw, file=file)
    index = project(scan.points)
    image = np.zeros((64, 512, 6), np.float32)
    seen = index >= 0
    image[seen, :4] = scan.points[index[seen]]
    image[seen, 4] = 1.0
    image[seen, 5] = np.array([0, 7, 5, 6])[scan.labels[index[seen]]]
    np.save(images / "a.npy", image)

    datasets = ["os1-64=simulation:1", f"hdl-64e={boxes}", f"hdl-64e={images}"]
    out = tmp_path / "figures.json"
    printed = shell.out("eval-sensors", *datasets, "--json", out)
    assert printed.count("none") == printed.count("both") == 3
    figures = json.loads(out.read_text())
    simulated, boxed, pictured = (figures[name] for name in datasets)
    assert simulated["n_scans"] == 1
    assert "os1-64=simulation:1, pointseg: 1 scan" in printed
    assert {figures[name]["network"] for name in datasets} == {"pointseg"}
    assert simulated["function"].startswith(("logarithm", "linear", "power"))
    assert (boxed["n_scans"], pictured["n_scans"]) == (1, 1)
    near_cars = [b for b in scan.boxes if b.label in ("car", "van", "truck") and np.hypot(*b.center[:2]) < 40.0]
    assert 0 < boxed["n_objects"]["car"] <= len(near_cars)
    assert ("car" in boxed["few"]) == (boxed["n_objects"]["car"] < 10)
    assert set(boxed["few"]) == {name for name, n in boxed["n_objects"].items() if 0 < n < 10}
    assert (pictured["n_objects"], pictured["few"]) == (None, [])
    assert printed.count("KITTI's benchmark") == printed.count("nuScenes measures") == 1  # boxes alone have them
    assert boxed["boxes"]["kitti"]["car"]["bird's eye 0.5"]["all round"]["ap"] > 0.2
    assert boxed["boxes"]["centers"]["car"]["n_truth"] > 0
    assert all((f"{name} (n<10)" in printed) for found in (simulated, boxed) for name in found["few"])
    for found in (boxed, pictured):
        assert found["function"] is None
        assert found["both"] == found["none"] == found["remission"] == found["interpolation"]
        assert found["both"]["iou"]["car"] > 0.5
    assert pictured["both"]["iou"]["cyclist"] is None  # two-wheelers are not found apart from their riders
    for source in ("vlp-16", "vlp-16=simulation:0", f"vlp-16={tmp_path}", "vlp-17=simulation"):
        assert shell.err("eval-sensors", source).startswith("edgeperc: ")


def test_a_model_without_points_is_refused() -> None:
    from edgeperc.errors import ModelError

    with pytest.raises(ModelError, match="labels no points"):
        compare(["hdl-32e=simulation:1"], "ssadnet")


RAW = replace(get_sensor("hdl-64e"), remission_range=(-3.0, 252.0))


def some_scan(n: int = 300) -> np.ndarray:
    rng = np.random.default_rng(n)
    points = rng.normal((0.0, 0.0, 0.0, 100.0), 10.0, (n, 4)).astype(np.float32)
    points[:: max(1, n // 20), rng.integers(0, 4)] = rng.choice([np.nan, np.inf, -np.inf])
    return points


@pytest.mark.parametrize("sensor", [get_sensor("hdl-64e"), RAW, get_sensor("vlp-16")], ids=lambda s: s.name)
@pytest.mark.parametrize("rendered", [True, False])
@pytest.mark.parametrize("n", [0, 1, 300])
def test_conditioned_scan_is_finite_or_nan_and_read_only(sensor: SensorProfile, rendered: bool, n: int) -> None:
    points = some_scan(n)
    before = points.copy()
    scan, n_dropped = condition(points, sensor, rendered=rendered)
    np.testing.assert_array_equal(points, before)
    assert (scan.shape, scan.dtype) == ((n, 4), np.float32)
    assert scan.flags.c_contiguous
    assert scan.flags.aligned
    assert not scan.flags.writeable
    dropped = ~np.isfinite(points).all(axis=1)
    assert n_dropped == np.count_nonzero(dropped)
    assert np.isnan(scan[dropped]).all()
    np.testing.assert_array_equal(scan[~dropped, :3], points[~dropped, :3])
    if sensor.remission is not None and rendered:
        expected = render(points, sensor)[:, 3]
    else:  # one rounding an operation, in float32
        expected = (points[:, 3] + np.float32(sensor.remission_offset)) * np.float32(sensor.remission_scale)
    np.testing.assert_array_equal(scan[~dropped, 3], expected[~dropped])


def test_a_scan_that_is_ready_is_not_copied() -> None:
    points = some_scan()[1:2].copy()
    scan, _ = condition(points, get_sensor("hdl-64e"))
    assert np.shares_memory(scan, points)
    assert points.flags.writeable
    again, _ = condition(scan, get_sensor("hdl-64e"))
    assert np.shares_memory(again, points)


@pytest.mark.parametrize("bad", [np.zeros((5, 2)), "scan", None, np.zeros((2, 5, 4))])
def test_arrays_that_are_not_scans_are_refused(bad: Any) -> None:
    with pytest.raises(PointsError):
        condition(bad, RAW)
