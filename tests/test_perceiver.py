"""The whole runtime on shipped models: simulated scans, real ones where there are any, and bad input of every kind."""

from __future__ import annotations

import inspect
import json
import re
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

import edgeperc
from edgeperc import (
    Box,
    EdgepercError,
    FitnessError,
    InferenceError,
    ModelFileError,
    Mounting,
    OptionError,
    Perceiver,
    Perception,
    PointsError,
    ProviderError,
    SensorError,
    StampError,
    pipeline,
)
from edgeperc.inference import providers, session, sessions
from edgeperc.objects.boxes import weigh
from edgeperc.pipeline import Pipeline
from edgeperc.preprocess import findings
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.scene import SimulatedScan, simulate
from edgeperc.system.lanes import Stopwatch
from edgeperc.types.choices import SPARSE_MODELS
from edgeperc.types.geometry import inside, oriented_iou
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.perception import PointLabels
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import TopViewGeometry
from edgeperc.zoo import model_path, shipped_models
from scenes import assert_same, urban


@pytest.fixture(scope="module")
def scan() -> SimulatedScan:
    return urban(8)


@pytest.fixture(scope="module")
def perceive() -> Perceiver:
    # Scans are checked in tests of their own; here it would depend on the order of the tests which ones are.
    return Perceiver(["ssadnet", "pointseg"], provider="cpu", n_threads=1, on_mismatch="ignore")


@pytest.fixture
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks run at once."""
    monkeypatch.setattr(session, "usable_cores", lambda: 2)


@pytest.fixture
def both(two_cores: None) -> Perceiver:
    return Perceiver(["ssadnet", "pointseg"], provider="cpu", on_mismatch="ignore")


@pytest.fixture(scope="module")
def perception(perceive: Perceiver, scan: SimulatedScan) -> Perception:
    return perceive(scan.points, stamp_s=12.5)


@pytest.fixture(scope="module")
def full_turn(scan: SimulatedScan) -> Perception:
    """By one thread."""
    alone = Perceiver(["ssadnet", "pointseg"], provider="cpu", n_threads=1, on_mismatch="ignore", full_turn=True)
    assert len(alone.pipeline.ranged) == 1
    return alone(scan.points)


def test_every_point_has_a_label(perception: Perception, scan: SimulatedScan) -> None:
    assert perception.n_points == len(scan.points)
    assert perception.n_dropped == 0
    assert perception.points.labels.shape == (len(scan.points),)
    assert perception.points.labels.dtype == np.uint8
    assert perception.points.classes == ("background", "car", "pedestrian", "cyclist")
    assert not perception.points.labels[~perception.points.in_view].any()
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    assert not perception.points.in_view[np.abs(azimuth) > 45.01].any()
    assert perception.points.in_view[np.abs(azimuth) < 44.9].mean() > 0.95
    assert sum(perception.points.counts().values()) == int(perception.points.in_view.sum())


def test_result_resembles_the_ground_truth(perception: Perception, scan: SimulatedScan) -> None:
    seen = perception.require_points().in_view
    found, true = perception.require_points().labels[seen] == 1, scan.labels[seen] == 1
    assert true.sum() > 500
    assert (found & true).sum() / (found | true).sum() > 0.5
    truth = scan.top_view_labels()
    drivable = perception.require_top_view().drivable
    assert (drivable & (truth == 1)).sum() / (drivable | (truth == 1)).sum() > 0.5
    assert any(b.score > 0.5 for b in perception.boxes)


def test_other_fields_of_the_perception(perception: Perception, perceive: Perceiver) -> None:
    assert perception.stamp_s == 12.5
    assert perception.require_top_view().labels.shape == (400, 200)
    assert perception.require_top_view().classes == ("background", "drivable", "car", "van", "truck")
    assert perception.require_top_view().to_meters(399, 0) == pytest.approx((6.05, 9.95))
    assert set(perception.stage_ms) == {"check", "project", "infer", "decode", "refine", "cluster", "agree"}
    assert min(perception.stage_ms.values()) > 0.0
    assert [*perception.providers] == ["ssadnet", "pointseg"]
    for name, text in perception.providers.items():
        assert re.fullmatch(rf"{name} (fp32|int8), CPUExecutionProvider", text)
    assert [c.name for c in perceive.cards] == ["ssadnet", "pointseg"]
    scores = [b.score for b in perception.boxes]
    assert scores == sorted(scores, reverse=True)
    for box in perception.boxes:
        assert box.label in ("car", "van", "truck", "pedestrian", "cyclist")
        assert -np.pi <= box.yaw <= np.pi


def test_result_is_the_same_for_any_thread_count(perception: Perception, scan: SimulatedScan) -> None:
    assert_same(perception, Perceiver(["ssadnet", "pointseg"], provider="cpu", n_threads=2)(scan.points))
    assert_same(perception, Perceiver(["pointseg", "ssadnet"], provider="cpu", n_threads=1)(scan.points))


@pytest.mark.parametrize(("cores", "at_once"), [(1, False), (5, True)])
def test_networks_at_once_give_the_results_of_one_after_the_other(
    monkeypatch: pytest.MonkeyPatch, perception: Perception, scan: SimulatedScan, cores: int, at_once: bool
) -> None:
    monkeypatch.setattr(session, "usable_cores", lambda: cores)
    both = Perceiver(["pointseg", "ssadnet"], provider="cpu", on_mismatch="ignore")
    assert [s.shares_cores for s in both.sessions] == [at_once] * 2
    found = both(scan.points)
    assert_same(perception, found)
    assert found.stage_ms.keys() == perception.stage_ms.keys()
    assert not Perceiver("pointseg", provider="cpu").sessions[0].shares_cores
    assert not Perceiver(provider="cpu", n_threads=2).sessions[0].shares_cores


@pytest.mark.parametrize("full_turn", [False, True])
def test_openvino_runs_both_networks_at_once_too(two_cores: None, scan: SimulatedScan, full_turn: bool) -> None:
    if "openvino" not in providers.available_providers():
        pytest.skip("the OpenVINO plugin is absent, or finds no device of Intel's")
    options: dict[str, Any] = {"provider": "openvino", "full_turn": full_turn, "on_mismatch": "ignore"}
    both = Perceiver(["ssadnet", "pointseg"], **options)
    assert [s.shares_cores for s in both.sessions] == [True] * 2
    one_by_one = Perceiver(["ssadnet", "pointseg"], n_threads=2, **options)
    assert not any(s.shares_cores for s in one_by_one.sessions)
    for _ in range(3):
        assert_same(one_by_one(scan.points), both(scan.points))


@pytest.mark.parametrize("failing", [0, 1])
def test_a_network_that_fails_beside_another_ends_the_call(
    monkeypatch: pytest.MonkeyPatch, both: Perceiver, perception: Perception, scan: SimulatedScan, failing: int
) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(both.sessions[failing], "run", Mock(side_effect=InferenceError("no memory left")))
        with pytest.raises(InferenceError, match="no memory left"):
            both(scan.points)
    assert_same(perception, both(scan.points))


@pytest.mark.parametrize("name", ["sort_points", "decode_cells"])
def test_a_call_that_fails_leaves_nothing_running(
    monkeypatch: pytest.MonkeyPatch, both: Perceiver, perception: Perception, scan: SimulatedScan, name: str
) -> None:
    begun, ended = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> None:
        begun.set()
        time.sleep(0.3)
        ended.set()

    def fail(*_: object, **__: object) -> None:
        assert begun.wait(10.0)
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(pipeline, name, slow)
        broken.setattr(pipeline, "label_points", fail)
        with pytest.raises(KeyboardInterrupt):
            both(scan.points)
        assert ended.is_set()
    assert_same(perception, both(scan.points))


@pytest.mark.parametrize("alone", ["perception", "full_turn"])
def test_networks_run_one_after_the_other_where_no_thread_can_be_started(
    monkeypatch: pytest.MonkeyPatch, two_cores: None, request: pytest.FixtureRequest, scan: SimulatedScan, alone: str
) -> None:
    known: Perception = request.getfixturevalue(alone)
    n_lanes = sum(thread.name.startswith("edgeperc-lane") for thread in threading.enumerate())
    options: dict[str, Any] = {"provider": "cpu", "on_mismatch": "ignore", "full_turn": alone == "full_turn"}
    both = Perceiver(["ssadnet", "pointseg"], **options)
    with monkeypatch.context() as limited:
        limited.setattr(threading.Thread, "start", Mock(side_effect=RuntimeError("can't start new thread")))
        for _ in range(2):
            assert_same(known, both(scan.points))
    for _ in range(2):
        assert_same(known, both(scan.points))
    lanes = [thread for thread in threading.enumerate() if thread.name.startswith("edgeperc-lane")]
    assert len(lanes) <= 1 + n_lanes


@pytest.mark.parametrize("failing", ["aside", "top view", "sectors", None])
def test_two_threads_share_the_sectors_of_a_full_turn(
    monkeypatch: pytest.MonkeyPatch, two_cores: None, full_turn: Perception, scan: SimulatedScan, failing: str | None
) -> None:
    both = Perceiver(["ssadnet", "pointseg"], provider="cpu", on_mismatch="ignore", full_turn=True)
    top, (ranged, aside) = both.sessions[0], (network.session for network in both.pipeline.ranged)
    of = {"aside": aside, "top view": top, "sectors": ranged}
    runs = dict.fromkeys(of, 0)

    def run(name: str, run: Callable[[], object]) -> object:
        runs[name] += 1
        if name in taken and failing != "top view":  # wait until the other thread has a sector, too
            taken[name].set()
            taken["aside" if name == "sectors" else "sectors"].wait(60.0)
        if name == failing:
            raise InferenceError("no memory left")
        return run()

    taken = {"aside": threading.Event(), "sectors": threading.Event()}
    with monkeypatch.context() as counted:
        for name, each in of.items():
            counted.setattr(each, "run", partial(run, name, each.run))
        if failing is None:
            assert_same(full_turn, both(scan.points))
            assert runs["top view"] == 1
            assert min(runs["aside"], runs["sectors"]) >= 1
            assert runs["aside"] + runs["sectors"] == 4
        else:
            with pytest.raises(InferenceError, match="no memory left"):
                both(scan.points)
    assert_same(full_turn, both(scan.points))


def test_result_does_not_depend_on_earlier_scans(perceive: Perceiver, perception: Perception) -> None:
    other = simulate(random_scene(9), "hdl-64e", seed=9).points
    again = urban(8).points.copy()
    perceive(other)
    assert_same(perception, perceive(again))


def in_threads(work: Sequence[Callable[[], None]]) -> None:
    threads = [threading.Thread(target=each) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_an_interrupt_loses_no_network_of_a_full_turn(
    monkeypatch: pytest.MonkeyPatch, full_turn: Perception, scan: SimulatedScan
) -> None:
    """A signal may come when a network has been taken, before anything else."""
    signals: list[type[BaseException]] = []

    class Taken(deque[Any]):
        def pop(self) -> Any:
            network = super().pop()
            if signals:
                raise signals.pop()
            return network

    monkeypatch.setattr(pipeline, "deque", Taken)
    alone = Perceiver(["ssadnet", "pointseg"], provider="cpu", n_threads=1, on_mismatch="ignore", full_turn=True)
    signals.append(KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        alone(scan.points)
    assert_same(full_turn, alone(scan.points))


def test_a_call_inside_of_a_call_is_refused_and_the_outer_one_goes_on(
    monkeypatch: pytest.MonkeyPatch, perceive: Perceiver, perception: Perception, scan: SimulatedScan
) -> None:
    """As of a signal handler: waiting for the call that it interrupts would never end."""
    refused = []

    def interrupted(ranged: Any) -> deque[Any]:
        for call in (lambda: perceive(scan.points), perceive.reset_mounting):
            with pytest.raises(EdgepercError, match="a Perceiver was called again inside of its own call"):
                call()
            refused.append(call)
        return deque(ranged)

    with monkeypatch.context() as patched:
        patched.setattr(pipeline, "deque", interrupted)
        assert_same(perception, perceive(scan.points))
    assert len(refused) == 2
    assert_same(perception, perceive(scan.points))


def test_perceivers_in_threads_give_the_same_result(perception: Perception, scan: SimulatedScan) -> None:
    answers: list[Perception] = []

    def work() -> None:
        one = Perceiver(["ssadnet", "pointseg"], provider="cpu", n_threads=1)
        answers.extend(one(scan.points) for _ in range(2))

    in_threads([work] * 2)
    assert len(answers) == 4
    for answer in answers:
        assert_same(perception, answer)


def test_one_perceiver_in_threads_gives_the_same_result(perceive: Perceiver, scan: SimulatedScan) -> None:
    scans = [scan.points, scan.points[::2], scan.points[:1000], scan.points[:0]]
    alone = [perceive(s) for s in scans]
    answers: dict[int, Perception] = {}
    in_threads([lambda k=k: answers.update({k: perceive(scans[k])}) for k in range(4)])
    for k in range(4):
        assert_same(alone[k], answers[k])


def test_results_own_their_arrays(perceive: Perceiver, scan: SimulatedScan) -> None:
    first = perceive(scan.points)
    kept = first.require_points().labels.copy(), first.require_top_view().labels.copy()
    other = perceive(scan.points[::3])
    assert (other.require_top_view().labels != kept[1]).any()
    np.testing.assert_array_equal(first.require_points().labels, kept[0])
    np.testing.assert_array_equal(first.require_top_view().labels, kept[1])


def test_non_finite_points_are_counted_and_ignored(
    perceive: Perceiver, perception: Perception, scan: SimulatedScan
) -> None:
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(len(scan.points), size=500, replace=False))
    dirty = np.insert(scan.points, rows, scan.points[rows], axis=0)
    at = rows + np.arange(500)
    dirty[at[:300], rng.integers(3, size=300)] = np.nan
    dirty[at[300:], rng.integers(3, size=200)] = np.inf
    answer = perceive(dirty)
    assert answer.n_dropped == 500
    assert not answer.require_points().labels[at].any()
    assert not answer.require_points().in_view[at].any()
    np.testing.assert_array_equal(np.delete(answer.require_points().labels, at), perception.require_points().labels)
    assert answer.boxes == perception.boxes


@pytest.mark.parametrize(
    "change",
    [
        lambda p: p.astype(np.float64),
        lambda p: np.asfortranarray(p),
        lambda p: np.repeat(p, 2, axis=0)[::2],
        lambda p: p.astype(">f4"),
        lambda p: np.frombuffer(p.tobytes(), np.float32).reshape(-1, 4),  # read-only
        lambda p: np.hstack([p, p])[:, :4],
    ],
)
def test_any_layout_in_memory(
    perceive: Perceiver,
    perception: Perception,
    scan: SimulatedScan,
    change: Callable[[NDArray[np.float32]], NDArray[np.float32]],
) -> None:
    given = change(scan.points)
    before = given.copy()
    assert_same(perception, perceive(given))
    np.testing.assert_array_equal(given, before)


@pytest.mark.parametrize(("n", "factor"), [(0, 1.0), (1, 1.0), (2, 1.0), (2, np.nan)])
def test_few_points(perceive: Perceiver, n: int, factor: float) -> None:
    points = factor * np.array([[12.0, 1.0, -1.0, 0.3], [30.0, -2.0, -1.5, 0.1]], np.float32)[:n]
    answer, is_dropped = perceive(points), np.isnan(factor)
    assert (answer.n_points, answer.n_dropped) == (n, n * is_dropped)
    assert answer.require_points().labels.tolist() == [0] * n
    assert answer.require_points().in_view.tolist() == [not is_dropped] * n
    assert answer.require_top_view().labels.shape == (400, 200)
    assert answer.boxes == ()


def test_points_without_remission_have_none(perceive: Perceiver, perception: Perception, scan: SimulatedScan) -> None:
    answer = perceive(np.ascontiguousarray(scan.points[:, :3]))
    assert_same(answer, perceive(scan.points * np.array([1, 1, 1, 0], np.float32)))
    assert (answer.require_points().labels != perception.require_points().labels).any()


def test_three_million_points(perceive: Perceiver, scan: SimulatedScan) -> None:
    many = np.resize(scan.points, (3_000_000, 4))
    answer = perceive(many)
    assert answer.require_points().labels.shape == (3_000_000,)
    assert np.count_nonzero(answer.require_points().labels == 1) > 10_000


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((5, 2), np.float32),
        np.zeros((5, 4), np.complex64),
        np.zeros((2, 5, 4), np.float32),
        np.array([["a"] * 4]),
        np.zeros(4, np.float32),
        "nonsense",
        None,
    ],
)
def test_arrays_that_are_not_scans_are_a_points_error(perceive: Perceiver, bad: object) -> None:
    with pytest.raises(PointsError):
        perceive(bad)  # type: ignore[arg-type]


def test_a_time_is_a_number_of_seconds_that_json_can_hold(perceive: Perceiver, scan: SimulatedScan) -> None:
    with pytest.raises(StampError, match="expected the time of the scan"):
        perceive(scan.points, "now")  # type: ignore[arg-type]
    assert json.dumps(perceive(scan.points[:0], np.float32(2.0)).to_dict()["stamp_s"]) == "2.0"


def test_remission_is_scaled_by_the_sensors_profile(perception: Perception, scan: SimulatedScan) -> None:
    raw = scan.points.copy()
    raw[:, 3] *= 255.0
    sensor = replace(get_sensor("hdl-64e"), remission_range=(0.0, 255.0))
    answer = Perceiver(["ssadnet", "pointseg"], sensor=sensor, provider="cpu")(raw)
    assert (answer.require_points().labels == perception.require_points().labels).mean() > 0.999


def faulty(points: NDArray[np.float32], how: str) -> NDArray[np.float32]:
    x, y, z, remission = points.T
    return np.ascontiguousarray(
        {
            "remission 0..255": np.c_[x, y, z, remission * 255],
            "no remission": np.c_[x, y, z, remission * 0],
            "upside down": np.c_[x, -y, -z, remission],
            "camera axes": np.c_[-y, -z, x, remission],
            "millimeters": np.c_[x * 1000, y * 1000, z * 1000, remission],
        }[how],
        dtype=np.float32,
    )


FAULTS = {
    "remission 0..255": "Remission runs from 0 to 25",
    "no remission": "The scan has no remission",
    "upside down": "mounted upside down",
    "camera axes": "ground seems to lie towards",
    "millimeters": "convert them to meters",
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_warning_or_an_error_names_the_fault(scan: SimulatedScan, fault: str) -> None:
    perceive = Perceiver("pointseg", provider="cpu", on_mismatch="warn")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = perceive(faulty(scan.points, fault))
    told = [str(w.message) for w in caught]
    assert told == [*answer.fitness, *answer.health.findings]
    assert re.search(FAULTS[fault], " ".join(answer.fitness))
    assert bool(answer.health.beams_missing) == (fault == "upside down")
    with pytest.raises(FitnessError, match=FAULTS[fault]):
        Perceiver("pointseg", provider="cpu", on_mismatch="raise")(faulty(scan.points, fault))


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "no remission"])
def test_gross_differences_are_refused_before_a_network_runs(
    scan: SimulatedScan, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As often as such a scan comes; good scans are perceived."""
    perceive = Perceiver("pointseg", provider="cpu")
    with monkeypatch.context() as patch:
        patch.setattr(Pipeline, "__call__", pytest.fail)
        for _ in range(7):
            with pytest.raises(FitnessError, match=rf"(?s){FAULTS[fault]}.*on_mismatch=\"warn\".*--anyway"):
                perceive(faulty(scan.points, fault))
    assert perceive(scan.points).fitness == ()


def test_other_differences_are_warned_of(scan: SimulatedScan) -> None:
    raised = scan.points + np.float32([0, 0, 1.0, 0])
    with (
        pytest.warns(UserWarning, match=r"The ground lies at z = -0\.7 m"),
        pytest.warns(UserWarning, match="origin of the points is not at the sensor"),
    ):
        assert Perceiver("pointseg", mounting=MODEL_MOUNTING, provider="cpu")(raised).fitness
    with pytest.raises(FitnessError, match=r"The ground lies at z = -0\.7 m"):
        Perceiver("pointseg", mounting=MODEL_MOUNTING, provider="cpu", on_mismatch="raise")(raised)


@pytest.mark.parametrize(
    ("fault", "on_mismatch"),
    [*((fault, "refuse") for fault in FAULTS if fault != "no remission"), ("upside down", "ignore")],
)
def test_the_scans_of_another_vehicle_are_checked_as_the_first(
    scan: SimulatedScan, fault: str, on_mismatch: Literal["refuse", "ignore"]
) -> None:
    perceive = Perceiver("pointseg", provider="cpu", on_mismatch=on_mismatch)
    for _ in range(5):
        assert perceive(scan.points).fitness == ()
    lowest = "The lowest 48 of the sensor's beams have no returns"
    is_told = fault == "upside down" and on_mismatch == "refuse"
    with pytest.warns(UserWarning, match=lowest) if is_told else nullcontext():
        assert perceive(faulty(scan.points, fault)).fitness == ()  # not checked any more
    perceive.reset_mounting()
    if on_mismatch == "ignore":
        assert perceive(faulty(scan.points, fault)).fitness == ()
    else:
        with pytest.raises(FitnessError, match=FAULTS[fault]):
            perceive(faulty(scan.points, fault))


def test_only_the_first_scans_are_checked(scan: SimulatedScan) -> None:
    perceive = Perceiver("pointseg", provider="cpu", on_mismatch="warn")
    bad = faulty(scan.points, "upside down")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        checked = [perceive(bad[k:]).fitness for k in range(7)]
    assert [bool(fitness) for fitness in checked] == [True] * 5 + [False] * 2
    kinds = {*findings.by_kind(str(each.message) for each in caught)}
    assert len(caught) == len(kinds) >= len({*findings.by_kind(checked[0])})


def test_one_model_gives_its_part_of_the_result() -> None:
    points = np.zeros((0, 4), np.float32)
    seen = Perceiver("pointseg", provider="cpu")(points)
    assert seen.points is not None
    assert seen.top_view is None
    assert seen.boxes == ()
    above = Perceiver(model_path("ssadnet"), provider="cpu")(points)
    assert above.points is None
    assert above.top_view is not None


def test_the_road_alone(scan: SimulatedScan) -> None:
    found = Perceiver("lodnn", provider="cpu", n_threads=1)(scan.points)
    assert found.points is None
    assert found.boxes == ()
    assert found.require_top_view().classes == ("background", "drivable")
    road = scan.top_view_labels(TopViewGeometry()) == 1
    assert (found.require_top_view().road & road).sum() > 0.85 * (found.require_top_view().road | road).sum()
    assert (found.require_top_view().drivable & road).sum() > 0.7 * road.sum()  # cars hide the rest
    ahead = edgeperc.road_ahead(found.require_top_view())
    assert ahead.free_ahead_m() > 40.0
    assert ahead.lane_width_m == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"on_mismatch": "panic"}, "on_mismatch is 'panic'; expected refuse, warn, raise or ignore"),
        ({"score_threshold": 2.0}, "score_threshold is 2.0"),
        ({"score_threshold": float("nan")}, "score_threshold is nan"),
        ({"score_threshold": "high"}, "score_threshold is 'high'"),
        ({"boxes_from": "thin air"}, "boxes_from is 'thin air'"),
        ({"full_turn": "yes"}, "full_turn is 'yes'; expected True or False"),
        ({"trusted": "no"}, "trusted is 'no'; expected True or False"),
        ({"agree": None}, "agree is None; expected True, False or some of boxes, "),
        ({"agree": [["road"]]}, r"agree is \[\['road'\]\]"),
        ({"n_threads": 0}, "n_threads is 0"),
        ({"n_threads": "two"}, "n_threads is 'two'"),
        ({"provider": 3}, "provider is 3"),
        ({"precision": None}, "precision is None"),
        ({"models": []}, r"models is \[\]"),
        ({"models": 5}, "models is 5"),
        ({"models": ["pointseg", 5]}, "models is .*5"),
        ({"models": ["pointseg", model_path("pointseg")], "provider": "cpu"}, "at most one a view"),
        ({"models": "ssadnet", "provider": "cpu", "boxes_from": "clusters"}, "range-image model"),
        ({"adapt": "some"}, "adapt is 'some'; expected none, remission, interpolation or both"),
        ({"adapt": "remision"}, r"adapt is 'remision' \(did you mean remission\?\); expected none"),
        ({"sensor": "radar"}, SensorError),
        ({"sensor": 5}, SensorError),
        ({"models": "pointsegg"}, ModelFileError),
        ({"models": "nowhere.onnx"}, ModelFileError),
        ({"models": ""}, ModelFileError),
        ({"provider": "abacus"}, ProviderError),
        ({"precision": "fp4"}, ProviderError),
    ],
)
def test_wrong_options_have_their_errors(arguments: dict[str, object], expected: str | type[Exception]) -> None:
    error, message = (OptionError, expected) if isinstance(expected, str) else (expected, None)
    with pytest.raises(error, match=message):
        Perceiver(**({"models": "pointseg"} | arguments))  # type: ignore[arg-type]


def test_options_are_fixed_at_construction(perceive: Perceiver) -> None:
    for name in ("sensor", "on_mismatch", "score_threshold", "adapt", "boxes_from", "full_turn", "cards", "providers"):
        before = getattr(perceive, name)
        with pytest.raises(AttributeError, match=f"{name} of a Perceiver cannot be set.*make another"):
            setattr(perceive, name, "both")
        assert getattr(perceive, name) == before
    with pytest.raises(AttributeError, match="score_treshold"):
        perceive.score_treshold = 0.5  # type: ignore[attr-defined]


def test_the_signature_is_the_documented_one() -> None:
    names = [*inspect.signature(Perceiver).parameters]
    assert names[0] == "models"
    assert {"sensor", "provider", "precision", "adapt", "boxes_from", "full_turn"} < {*names}
    for name in names:
        assert re.search(rf"^    {name} : ", str(inspect.getdoc(Perceiver)).replace("\n", "\n    "), re.MULTILINE), name


def test_own_score_threshold(scan: SimulatedScan) -> None:
    few = Perceiver("ssadnet", provider="cpu", score_threshold=0.9)(scan.points).boxes
    many = Perceiver("ssadnet", provider="cpu", score_threshold=0.05)(scan.points).boxes
    assert all(b.score >= 0.9 for b in few)
    assert len(many) > len(few)


def test_shipped_views_match_the_papers() -> None:
    cards = {name: Perceiver(name, provider="cpu").cards[0] for name in shipped_models()}
    above = cards["ssadnet"].view
    assert (above.height, above.width) == (400, 200)
    seen = cards["pointseg"].view
    assert (seen.height, seen.width, seen.azimuth_left_deg, seen.azimuth_right_deg) == (64, 512, 45.0, -45.0)
    for card in cards.values():
        assert (card.fitness is None) == (card.view.kind in ("camera", "objects"))
        assert card.golden is not None
        assert card.training["licence"]
        assert card.parity["n_scans"] >= 4


def test_real_scans_are_perceived_without_warnings(kitti_root: Path) -> None:
    perceive = Perceiver(["ssadnet", "pointseg"], provider="cpu", on_mismatch="raise")
    for name in ("000000", "000160", "000200", "000264", "000300"):
        points = edgeperc.read_points(kitti_root / "training/velodyne" / f"{name}.bin")
        answer = perceive(points)
        assert answer.require_points().labels.shape == (len(points),)
        assert answer.require_top_view().drivable_area_m2 > 50.0


def overlaps(first: tuple[Box, ...], second: tuple[Box, ...]) -> NDArray[np.float64]:
    rows = [[(*box.center[:2], *box.size[:2], box.yaw) for box in boxes] for boxes in (first, second)]
    return oriented_iou(*rows)


def test_a_networks_boxes_are_vehicles_ahead(perceive: Perceiver, scan: SimulatedScan) -> None:
    boxes = Perceiver(["ssadnet", "pointseg"], provider="cpu", boxes_from="network", agree=False)(scan.points).boxes
    assert boxes
    for box in boxes:
        assert box.label in ("car", "van", "truck")
        assert 6.0 <= box.center[0] <= 46.0
        assert abs(box.center[1]) <= 10.0
    assert boxes == Perceiver("ssadnet", provider="cpu", agree=False)(scan.points).boxes
    assert Perceiver("pointseg", provider="cpu", boxes_from="network")(scan.points).boxes == ()


def test_boxes_of_labeled_points_are_around_them(scan: SimulatedScan) -> None:
    perceive = Perceiver("pointseg", provider="cpu")
    answer = perceive(scan.points)
    assert answer.boxes
    assert answer.stage_ms["cluster"] > 0.0
    for box in answer.boxes:
        label = "car" if box.label in ("van", "truck") else box.label  # the network's name of any vehicle
        number = answer.require_points().classes.index(label)
        own = answer.require_points().labels[inside(box, scan.points, 0.05)]
        assert np.count_nonzero(own == number) >= 5
    assert answer.boxes == perceive(scan.points).boxes


def test_clusters_do_not_repeat_boxes_of_the_network(scan: SimulatedScan) -> None:
    networks = Perceiver("ssadnet", provider="cpu", agree=False)(scan.points).boxes
    clusters = Perceiver("pointseg", provider="cpu", agree=False)(scan.points).boxes
    perception = Perceiver(["ssadnet", "pointseg"], provider="cpu", agree=False)(scan.points)
    assert overlaps(clusters, networks).max() > 0.5  # both find some
    others = tuple(box for box in perception.boxes if box not in networks)
    assert set(networks) < set(perception.boxes)
    assert overlaps(others, networks).max() < 0.1
    scores = {replace(box, score=0.0): box.score for box in clusters}
    for box in others:  # with a lower score where the network looks and has found no vehicle
        score = scores[replace(box, score=0.0)]
        doubted = (
            box.label not in ("pedestrian", "cyclist") and 6.0 <= box.center[0] < 46.0 and abs(box.center[1]) < 10.0
        )
        assert 0.5 * score <= box.score <= score
        assert box.score < 0.8 * score or not doubted


@pytest.mark.parametrize(
    ("x", "y", "score"),
    [(20.0, 0.0, 0.45), (4.0, 0.0, 0.9), (6.0, 0.0, 0.675), (46.0, 3.0, 0.675), (48.1, 0.0, 0.9), (20.0, 10.0, 0.675)],
)
def test_a_network_that_has_not_found_a_vehicle_lowers_its_score_as_far_as_it_sees_it(
    perceive: Perceiver, x: float, y: float, score: float
) -> None:
    car, person = (Box(label, 0.9, (x, y, -1.0), (4.0, 1.6, 1.5), 0.0) for label in ("car", "pedestrian"))
    view, vehicles = perceive.cards[0].view, perceive.cards[0].box_classes
    weighed = weigh([car, person], view, vehicles, 0.3)
    assert [box.label for box in weighed] == ["car", "pedestrian"]
    assert weighed[0].score == pytest.approx(score)
    assert weighed[1] == person
    assert [box.label for box in weigh([car, person], view, vehicles, score + 0.01)] == ["pedestrian"] * (score < 0.89)


@pytest.mark.parametrize("seen", [1.0, 0.8, 0.5, 0.3])
def test_car_cut_by_the_views_edge_gets_a_full_box_if_it_is_seen_at_all(
    monkeypatch: pytest.MonkeyPatch, seen: float
) -> None:
    perceive = Perceiver("pointseg", provider="cpu", n_threads=1)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-20.0, 20.0, 0.4), np.arange(-20.0, 20.0, 0.4)))
    floor = np.column_stack([x, y, np.full(x.size, -1.73)])
    along, up = (v.ravel() for v in np.meshgrid(np.arange(0.0, 4.01, 0.1), np.arange(-1.4, -0.3, 0.2)))
    flank = np.column_stack([4.0 + along, np.full(along.size, 6.0), up])
    scan = np.zeros((len(floor) + len(flank), 4), np.float32)
    scan[:, :3] = np.concatenate([floor, flank])
    scan[len(floor) :, 3] = along >= 4.0 * (1.0 - seen) - 0.01  # the label

    def label(points: NDArray[np.float32], *_: object) -> PointLabels:
        labels = points[:, 3].astype(np.uint8)
        return PointLabels(labels, labels > 0, ("background", "car", "pedestrian", "cyclist"))

    monkeypatch.setattr(perceive.pipeline.ranged[0], "label", label)
    (box,) = perceive.pipeline(scan, MODEL_MOUNTING, Stopwatch()).boxes
    np.testing.assert_allclose(box.center[0], 6.0, atol=0.05)
    np.testing.assert_allclose(box.size[0], 4.0, atol=0.05)


def test_a_scan_that_looks_back_with_points_far_away_has_the_same_answer(scan: SimulatedScan) -> None:
    options: dict[str, Any] = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore", "full_turn": True}
    back = Mounting(MODEL_MOUNTING.height_m, 0.0, -(MODEL_MOUNTING.pitch_deg or 0.0), 180.0)
    far = np.float32([[2e3, 90.0, 5.0, 0.3], [0.0, 1e30, 0.0, 0.2], [-60.0, 3.0, -20.0, 0.1]])
    here = Perceiver(mounting=MODEL_MOUNTING, **options)(scan.points)
    there = Perceiver(mounting=back, **options)(np.vstack([scan.points * np.float32([-1, -1, 1, 1]), far]))
    n = len(scan.points)
    np.testing.assert_array_equal(there.require_points().labels[:n], here.require_points().labels)
    np.testing.assert_array_equal(there.require_top_view().drivable, here.require_top_view().drivable)
    assert [box.label for box in there.boxes] == [box.label for box in here.boxes]
    places = np.array([box.center for box in here.boxes]) * [-1, -1, 1]
    np.testing.assert_allclose([box.center for box in there.boxes], places, atol=1e-3)


def test_boxes_all_around_the_vehicle(scan: SimulatedScan) -> None:
    options: dict[str, Any] = {"mounting": MODEL_MOUNTING, "provider": "cpu", "n_threads": 1, "on_mismatch": "ignore"}
    ahead, around = (Perceiver("pointseg", full_turn=full_turn, **options) for full_turn in (False, True))
    seen, every = ahead(scan.points), around(scan.points)
    in_view = seen.require_points().in_view
    np.testing.assert_array_equal(every.require_points().labels[in_view], seen.require_points().labels[in_view])
    elevation = np.degrees(np.arcsin(scan.points[:, 2] / np.linalg.norm(scan.points[:, :3], axis=1)))
    assert every.require_points().in_view[(elevation < 2.0) & (elevation > -23.0)].mean() > 0.98
    # A quarter turn of the scan is a quarter turn of the answer, but for heights: the ground is found in other cells.
    behind = scan.points[:, [1, 0, 2, 3]] * np.array([1, -1, 1, 1], np.float32)  # what is left is ahead
    left = ahead(behind).points
    fresh = left.in_view & ~in_view
    assert (every.require_points().labels[fresh] == left.labels[fresh]).mean() > 0.999
    assert any(box.center[0] < 0.0 for box in every.boxes)


@pytest.mark.parametrize("name", ["hdl-64e", "vlp-16", "os1-64"])
def test_a_sensor_that_is_found_gives_the_answers_of_the_named_one(name: str) -> None:
    """Also for a perceiver elsewhere that starts from what this one has learned, and after a reset."""
    sensor = replace(get_sensor(name), remission_range=(0.0, 1.0))
    options: dict[str, Any] = {"provider": "cpu", "n_threads": 1, "on_mismatch": "ignore"}
    scan = urban(8, name).points
    finds = Perceiver(["ssadnet", "pointseg"], sensor="auto", **options)
    assert finds.sensor_estimate is None
    assert not finds.learned.is_settled
    assert finds(np.empty((0, 4), np.float32)).n_points == 0  # tells nothing
    assert finds.sensor_estimate is None
    answer = finds(scan)
    assert_same(answer, Perceiver(["ssadnet", "pointseg"], sensor=sensor, **options)(scan))
    assert answer.sensor == finds.sensor == sensor
    assert (finds.sensor is get_sensor("hdl-64e")) == (name == "hdl-64e")
    assert finds.sensor_estimate is not None
    elsewhere = Perceiver(["ssadnet", "pointseg"], sensor="auto", **options)
    elsewhere.start_from(finds.learned)
    assert elsewhere.sensor == sensor
    assert_same(elsewhere(scan), finds(scan))
    finds.reset_mounting()
    assert finds.sensor_estimate is None
    other = "os1-64" if name == "vlp-16" else "vlp-16"
    finds(urban(8, other).points)
    assert finds.sensor.name == other


def test_a_sensor_beside_the_origin_of_its_points_is_found_and_matched_from_its_place() -> None:
    scan, place = urban(8, "vlp-16").points, (6.0, -2.0)
    answers = [
        Perceiver("pointseg", sensor="auto", mounting=replace(MODEL_MOUNTING, origin_m=origin_m), on_mismatch="ignore")(
            points
        )
        for points, origin_m in ((scan, (0.0, 0.0)), (scan + np.float32([*place, 0.0, 0.0]), place))
    ]
    here, there = answers
    assert there.sensor == here.sensor == replace(get_sensor("vlp-16"), remission_range=(0.0, 1.0))
    assert here.remission is not None
    assert there.remission.coefficients == pytest.approx(here.remission.coefficients, rel=0.01)


@pytest.mark.parametrize(
    ("model", "sensor", "precision", "loaded"),
    [
        ("pointseg", "hdl-64e", "auto", "pointseg"),
        ("pointseg", "vlp-32c", "auto", "pointseg"),  # a third of a degree between the beams around the horizon
        ("pointseg", "vlp-16", "auto", "pointseg-sparse"),
        ("pointseg", "mid-360", "int8", "pointseg-sparse"),
        ("pointseg:int8", "vlp-16", "auto", "pointseg"),
        ("sceneseg", "vlp-16", "auto", "sceneseg"),
    ],
)
def test_a_sparse_sensor_has_weights_of_its_own(model: str, sensor: str, precision: str, loaded: str) -> None:
    perceive = Perceiver(model, sensor=sensor, precision=precision, provider="cpu")
    assert [card.name for card in perceive.cards] == [*perceive.providers] == [loaded]
    assert [session.card.name for session in perceive.sessions] == [loaded]


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_a_precision_that_sparse_weights_lack_takes_the_others(monkeypatch: pytest.MonkeyPatch, precision: str) -> None:
    """As in the wheel, which has them in int8 alone."""
    int8 = [variant for variant in sessions.resolve("pointseg-sparse") if variant.precision == "int8"]
    monkeypatch.setattr(sessions, "resolve", lambda _: int8)
    perceive = Perceiver("pointseg", sensor="vlp-16", precision=precision, provider="cpu")
    assert [*perceive.providers] == ["pointseg-sparse" if precision == "int8" else "pointseg"]


def test_the_weights_are_those_of_the_sensor_that_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    finds = Perceiver("pointseg", sensor="auto", provider="cpu", on_mismatch="ignore")
    for sensor, loaded in (("hdl-64e", "pointseg"), ("vlp-16", "pointseg-sparse"), ("hdl-64e", "pointseg")):
        assert [*finds(urban(8, sensor).points).providers] == [loaded]
        finds.reset_mounting()
    first = Perceiver("pointseg", sensor="auto", provider="cpu", on_mismatch="ignore")
    monkeypatch.setitem(SPARSE_MODELS, "pointseg", "nowhere.onnx")
    for _ in range(2):  # nothing of the sensor is learned before its weights are there
        with pytest.raises(ModelFileError, match="nowhere"):
            first(urban(8, "vlp-16").points)
    assert [*first(urban(8).points).providers] == ["pointseg"]


def test_a_sensor_that_hangs_sees_what_one_with_its_beams_turned_over_sees() -> None:
    hung = replace(MODEL_MOUNTING, roll_deg=180.0)
    sensor = replace(get_sensor("hdl-32e"), remission_range=(0.0, 1.0), mounting=hung)
    turned = replace(sensor.upright(hung), mounting=MODEL_MOUNTING)
    scan = urban(8, turned).points
    level, hanging = (Perceiver("ssadnet", sensor=each, on_mismatch="ignore") for each in (turned, sensor))
    answers = level(scan), hanging(scan * np.float32([1, -1, -1, 1]))
    cells, findings = zip(*((a.require_top_view().drivable, a.health.findings) for a in answers), strict=True)
    assert findings == ((), ())
    assert np.mean(cells[0] != cells[1]) < 0.002  # by rounding


def test_a_scan_that_does_not_tell_the_sensor_is_refused_and_the_next_one_may() -> None:
    finds = Perceiver("pointseg", sensor="auto", provider="cpu", on_mismatch="ignore")
    for few in (urban(8).points[:500], np.random.default_rng(0).uniform(-30.0, 30.0, (9000, 4)), np.ones((1, 4))):
        with pytest.raises(SensorError, match="the sensor cannot be told"):
            finds(few)
    finds(urban(8).points)
    assert finds.sensor is get_sensor("hdl-64e")


def test_a_dense_scan_about_the_vehicle_is_perceived_and_the_doubt_is_told() -> None:
    """Two sensors, moved to one time: no beams."""
    ahead = np.array([1.4, 0.3, -0.2, 0.0], np.float32)
    scan = np.concatenate([urban(8, "os1-64").points, urban(8, "os1-64").points + ahead])
    finds = Perceiver("pointseg", sensor="auto", provider="cpu")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = finds(scan)
    assert sum("no beams stand out" in str(w.message) for w in caught) == 1
    assert finds.sensor.name == "beamless"
    sensor = replace(get_sensor("os1-64"), remission_range=(0.0, 1.0))
    named = Perceiver("pointseg", sensor=sensor, on_mismatch="ignore")(scan)
    assert np.mean(answer.points.labels == named.points.labels) > 0.97
    with pytest.raises(SensorError, match="no beams stand out"):
        Perceiver("pointseg", sensor="auto", provider="cpu", on_mismatch="raise")(scan)


def test_a_refused_scan_neither_settles_the_sensor_nor_unsettles_it() -> None:
    finds = Perceiver("pointseg", sensor="auto", provider="cpu")
    scan = urban(8, "vlp-16").points * np.array([1000.0, 1000.0, 1000.0, 1.0], np.float32)  # millimeters
    with pytest.raises(FitnessError):
        finds(scan)
    assert finds.sensor_estimate is None
    finds(urban(8).points)
    assert finds.sensor is get_sensor("hdl-64e")
    with pytest.raises(FitnessError):
        finds(scan)
    assert finds.sensor_estimate is not None


def test_auto_is_of_a_perceiver() -> None:
    with pytest.raises(SensorError, match="found by a Perceiver, and not here"):
        get_sensor("auto")
