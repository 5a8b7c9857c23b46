"""The fuzzers: a short round of each kind, and every fault that one of them has found."""

from __future__ import annotations

import importlib.util
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from checkout import REPOSITORY, files

pytest.importorskip("resource")
if not hasattr(os, "fork"):
    pytest.skip("this system has no fork", allow_module_level=True)

from fuzz.models import checkpoint_of
from fuzz.running import Case, State, attempt, new_case, run_job
from fuzz.scans import DENSE, ELEVATIONS, SLOTS, MadeUp, card_of, perceiver_of
from fuzz.tiny import GRAPH, model
from tiny_model import field

from edgeperc import Box, Perceiver, SensorProfile, Tracker, Trajectory
from edgeperc.camera.calibration import read_kitti_calibration
from edgeperc.errors import EdgepercError, InferenceError, ModelFileError, PointsError, TrackingError
from edgeperc.inference.session import Session
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.records import read_boxes
from edgeperc.system.machine import read_setting
from edgeperc.types.card import ModelCard
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry

CORPUS = files("", "tests/fuzz/corpus")


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPoolExecutor]:
    """A process for the rounds: other tests may have left this one with more memory than a case may take."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        yield pool


def _round(kind: str, cases: int) -> State:
    module = importlib.import_module(f"fuzz.{kind}")
    return run_job(lambda: module.make(7), State(kind, 7), cases=cases)


@pytest.mark.parametrize(
    ("kind", "cases"),
    # Those that may take the least memory come first: what a round leaves counts in the next ones.
    [("scans", 120), ("packets", 40), ("trackers", 60), ("images", 100), ("models", 60), ("readers", 300)],
)
def test_a_round(pool: ProcessPoolExecutor, kind: str, cases: int) -> None:
    for library in ("lz4", "zstandard", "velodyne_decoder", "mcap", "rosbags") if kind == "readers" else ():
        pytest.importorskip(library)
    state = pool.submit(_round, kind, cases).result()
    assert state.cases == cases
    assert not state.failures, state.failures[0]["traceback"]
    answers = sum(count for name, count in state.outcomes.items() if "answer" in name or "scan" in name)
    assert answers > cases // 15, state.outcomes


@pytest.mark.parametrize(("kind", "cases"), [("captures", 120), ("commands", 8)])
def test_a_round_of_forked_processes(kind: str, cases: int, tmp_path: Path) -> None:
    if kind == "captures":
        for library in ("ouster.sdk.osf", "velodyne_decoder", "rosbags.highlevel"):
            pytest.importorskip(library)
    command = [sys.executable, "-m", "tests.fuzz", kind, "--here", "--cases", str(cases), "--seed", "7"]
    done = subprocess.run([*command, "--out", tmp_path], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{kind} seed 7: {cases} cases, 0 failures" in done.stdout


class Broken:
    """A kind whose every third case fails, in another way each time."""

    name, limit_s, limit_mb = "broken", 0.5, 1e6

    def run(self, case: Case) -> str:
        case.evidence["note.txt"] = b"what was tried"
        if case.index == 3:
            raise ZeroDivisionError
        if case.index == 6:
            np.float32(3e38) * np.float32(3e38)
        if case.index == 9:
            raise PointsError("of the project")
        return f"answer {case.rng.integers(10)}"


def test_failures_are_found_kept_and_repeated(tmp_path: Path) -> None:
    file = tmp_path / "state.json"
    state = run_job(Broken, State("broken", 5), cases=6, out=tmp_path, file=file)
    assert (state.cases, state.n_failures) == (6, 1)
    again = run_job(Broken, State.read(file), cases=12, out=tmp_path, file=file)  # goes on
    assert (again.cases, again.n_failures, again.outcomes["PointsError"]) == (12, 2, 1)
    assert [f["error"].partition(":")[0] for f in again.failures] == ["ZeroDivisionError", "RuntimeWarning"]
    kept = json.loads((tmp_path / "failures" / "broken-5-3" / "case.json").read_text())
    assert kept["again"] == "python -m tests.fuzz broken --seed 5 --case 3"
    assert (tmp_path / "failures" / "broken-5-3" / "note.txt").read_bytes() == b"what was tried"
    one, other = (attempt(Broken(), new_case("broken", 5, 4, tmp_path))[0] for _ in range(2))
    assert one == other


def test_a_process_that_dies_or_hangs_is_a_failure(tmp_path: Path) -> None:
    from fuzz.running import supervise

    program = tmp_path / "program.py"
    program.write_text(
        f"import sys; sys.path.insert(0, {str(REPOSITORY / 'tests')!r})\n"
        "import mmap, os, time, pathlib\n"
        "from fuzz.running import State, run_job\n"
        "class Bad:\n"
        "    name, limit_s, limit_mb = 'bad', 60.0, 1e6\n"
        "    def run(self, case):\n"
        "        if case.index == 2: os.kill(os.getpid(), 11)\n"
        "        if case.index == 4: time.sleep(600)\n"
        "        return 'answer'\n"
        "file, shared, jobs, seconds = sys.argv[2:]\n"
        "opened = open(shared, 'r+b')\n"
        "now = mmap.mmap(opened.fileno(), 0)\n"
        "run_job(Bad, State.read(pathlib.Path(file)), cases=7, jobs=int(jobs), file=pathlib.Path(file), now=now)\n"
    )
    state = supervise(
        [sys.executable, str(program)], "bad", 0.5, seed=1, cases=7, jobs=1, seconds=300.0, out=tmp_path,
        progress=lambda state: None,
    )  # fmt: skip
    assert (state.cases, state.n_failures) == (7, 2)
    assert [f["error"] for f in state.failures] == ["the process died (-11)", "hangs"]


def read_card(path: Path, folder: Path) -> object:
    """As `Session` does: from a model's file."""
    blob = model(GRAPH, card=path.read_bytes().strip())
    found = folder / "corpus.onnx"
    found.write_bytes(blob)
    return FitnessProfile.from_dict(dict(ModelCard.read(found).fitness or {}))


READERS: dict[str, Callable[[Path, Path], object]] = {
    "boxes": lambda path, _: read_boxes(path),
    "calibration": lambda path, _: read_kitti_calibration(path),
    "card": read_card,
    "sensor": lambda path, _: get_sensor(path),
    "settings": lambda path, _: read_setting(path, "machine", "digest"),
}


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_the_corpus_is_refused(path: Path, tmp_path: Path) -> None:
    assert path.stat().st_size < 10_000
    with pytest.raises(EdgepercError) as caught:
        READERS[path.name.partition("-")[0]](path, tmp_path)
    assert len(str(caught.value)) < 1000


FAR = Box("car", 0.9, (1e200, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0)
NEAR = Box("car", 0.9, (10.0, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0)


@pytest.mark.parametrize(
    "boxes",
    [
        [FAR],
        [Box("car", 0.9, (10**400, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0)],
        [Box("car", 0.9, (1.0, 0.0, 0.0), (1e308, 2.0, 1.5), 0.0)],
        [Box("car", 0.9, (1.0, 0.0, 0.0), (1e-300, 2.0, 1.5), 0.0)],
        [Box(("car",), 0.9, (1.0, 0.0, 0.0), (4.0, 2.0, 1.5), 0.0)],  # type: ignore[arg-type]
    ],
)
def test_boxes_beyond_the_limits(boxes: list[Box]) -> None:
    tracker = Tracker()
    tracker.update([NEAR], 0.0)
    with pytest.raises(TrackingError):
        tracker.update(boxes, 0.1)
    tracker.update([NEAR], 0.1)  # the tracker is unchanged


@pytest.mark.parametrize("stamp_s", [1e-300, 1e-7])
def test_doubled_stamps_change_no_track(stamp_s: float) -> None:
    tracker = Tracker()
    tracker.update([NEAR], 0.0)
    with pytest.warns(UserWarning, match="late or doubled"):
        assert tracker.update([NEAR], stamp_s).is_late


@pytest.mark.parametrize("stamp_s", [1e300, 1.7e18, -1e300])
def test_stamps_beyond_the_limits(stamp_s: float) -> None:
    tracker = Tracker()
    tracker.update([NEAR], 0.0)
    with pytest.raises(TrackingError):
        tracker.update([NEAR], stamp_s)
    far = np.eye(4)
    far[0, 3] = 1e200
    with pytest.raises(TrackingError, match="at most 1e"):
        Tracker().update([NEAR], 0.0, far)


def made_up(*cards: ModelCard, values: float = 0.0, **options: Any) -> Perceiver:
    sessions = [MadeUp(card) for card in cards]
    perceive = perceiver_of(*sessions, on_mismatch="ignore", **options)
    for session in sessions:
        for output in session.outputs.values():
            output.fill(values)
    return perceive


POINTS = np.array([[10.0, 1.0, -1.0, 0.5], [20.0, -2.0, -1.0, 0.1]], np.float32)
VIEW = TopViewGeometry((6.0, 46.0), (-10.0, 10.0), (-2.5, 2.5), 0.4)


def test_probabilities_above_one_are_refused() -> None:
    perceive = made_up(card_of(VIEW, *SLOTS), values=2.5)
    with pytest.raises(InferenceError, match=r"probabilities of classes are 2\.5 to 2\.5"):
        perceive(POINTS)


@pytest.mark.filterwarnings("error")
def test_huge_outputs_and_coordinates_do_not_warn() -> None:
    made_up(card_of(VIEW, *DENSE), values=-1e38, score_threshold=0.0)(POINTS)
    image = card_of(RangeImageGeometry(ELEVATIONS, 64), DENSE[1])
    perceive = made_up(image, full_turn=True)
    far = np.full((5, 4), 3.4e38, np.float32)
    assert perceive(far).n_points == 5


def test_profiles_beyond_the_limits() -> None:
    with pytest.raises(EdgepercError, match=r"remission_range\[0\] is 1e\+300; expected a number from -1e\+09"):
        SensorProfile.uniform("any", 16, 15.0, -15.0, remission_range=(1e300, 2e300))


def test_columns_of_points_take_bounded_work() -> None:
    """100,000 points above one another: z was a 16-bit value. It took 16 s."""
    points = np.zeros((100_000, 4), np.float32)
    points[:, 0], points[:, 2] = -10.2, np.random.default_rng(3).integers(0, 65536, len(points))
    perceive = made_up(card_of(RangeImageGeometry(ELEVATIONS, 64), DENSE[1]), values=1.0)
    perceive(points)
    assert perceive(points).stage_ms["cluster"] < 10_000.0


def test_onnxruntime_prints_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """It told of another provider on stdout, where the JSON of ``edgeperc run`` goes, if a name was not UTF-8."""
    path = tmp_path / "model.onnx"
    path.write_bytes(model(GRAPH.replace(field(1, b"x"), field(1, b"\xfc"))))
    with pytest.raises(ModelFileError, match="cannot open it"):
        Session(path, "cpu")
    assert capfd.readouterr() == ("", "")


CHANGES: list[Callable[[dict[str, Any]], Any]] = [
    lambda state: state.pop("step"),
    lambda state: state.update(step=1.5),
    lambda state: state.update(curve=7),
    lambda state: state.update(recipe="{}"),
    lambda state: state.update(recipe=json.dumps({"network": "lodnn", "context_width": 10**9})),
    lambda state: state.update(recipe=json.dumps({"network": ["lodnn"]})),
    lambda state: state.update(averaged="weights"),
    lambda state: state.update(averaged={}),
]


@pytest.mark.parametrize("change", range(len(CHANGES) + 4))
def test_damaged_checkpoints(tmp_path: Path, change: int) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnx")
    from edgeperc_export.recipe import Recipe
    from edgeperc_export.release.to_onnx import load
    from edgeperc_export.training.checkpoint import CheckpointError

    recipe = Recipe("lodnn", edge=True)
    state = checkpoint_of(recipe)
    path = tmp_path / "checkpoint.pt"
    torch.save(state, path)
    assert load(path)[1] == recipe
    if change < len(CHANGES):
        CHANGES[change](state)
        torch.save(state, path)
    else:
        content = path.read_bytes()
        call = __import__("pickle").dumps({"recipe": os.system})
        damaged = [content[:1000], content[:30_000], b"PK\x03\x04" + content[40:], call]
        path.write_bytes(damaged[change - len(CHANGES)])
    with pytest.raises(CheckpointError, match=r"checkpoint\.pt"):
        load(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("column", "value"), [(0, "inf"), (0, "-1e999"), (2, "nan"), (5, "inf")])
def test_poses_that_are_not_finite_are_refused(tmp_path: Path, column: int, value: str) -> None:
    """Two infinite times made numpy warn."""
    rows = [[f"{k}.5", "1", "2", "3", "0", "0", "0.6", "0.8"] for k in range(4)]
    for row in rows[1:3]:
        row[column] = value
    path = tmp_path / "poses.txt"
    path.write_text("\n".join(" ".join(row) for row in rows))
    with pytest.raises(EdgepercError, match=r"poses\.txt"):
        Trajectory.from_tum(path)
