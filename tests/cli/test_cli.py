"""The command line: running, output files, data sets, help pages and wrong usage."""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_captures import vlp16_packets, write_pcap

from checkout import printed
from cli_helpers import OBJECTS, POINTSEG, SSADNET, Shell, parsers, run, thinned, write_scan
from edgeperc import Tracker, __version__, live, zoo
from edgeperc.cli.evaluation.scans import figure_lines
from edgeperc.cli.main import build_parser, in_options
from edgeperc.cli.output import print_line, progress
from edgeperc.cli.report import Outcome, Report
from edgeperc.cli.scans import find_scans, output_names
from edgeperc.errors import InferenceError, ModelFileError, OptionError, PointsError
from edgeperc.evaluation.judge import Perceiving
from edgeperc.readers import captures
from edgeperc.readers.files import read_points
from edgeperc.simulation.drawn import random_scene
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import SCENE_CLASSES, simulate_sequence
from edgeperc.types.perception import Box, Perception, PointLabels, SensorHealth, TopView
from edgeperc.types.sensor import get_sensor
from scenes import Terminal, urban


class FakePerceiver:
    """Labels every second point a car; chokes where the first point's remission is 1."""

    made: ClassVar[list[FakePerceiver]] = []
    n_earlier: ClassVar[list[int | None]] = []  # points that came with each scan

    def __init__(
        self,
        models: Sequence[str | Path],
        *,
        sensor: str | None = "hdl-64e",
        provider: str = "auto",
        n_threads: int | None = None,
        on_mismatch: str = "warn",
        **more: Any,
    ) -> None:
        self.given = (list(models), sensor, provider, n_threads, on_mismatch)
        self.sensor = sensor
        self.more = more
        known = {"objects": OBJECTS, "pointseg": POINTSEG, "ssadnet": SSADNET}
        for name in models:
            if name not in known:
                raise ModelFileError(f"no model is called {name!r}.\nShipped: objects, pointseg, ssadnet.")
        if len(set(models)) < len(self.given[0]):
            raise OptionError(f"models {self.given[0]} have one view; n_threads is {n_threads}")
        self.cards = tuple(known[name] for name in models)
        FakePerceiver.made.append(self)

    def __call__(
        self,
        points: np.ndarray,
        stamp_s: float | None = None,
        *,
        image: np.ndarray | None = None,
        origin_m: tuple[float, float, float] | None = None,
        earlier: np.ndarray | None = None,
    ) -> Perception:
        FakePerceiver.n_earlier.append(None if earlier is None else len(earlier))
        if len(points) and points[0, 3] == 1.0:
            raise InferenceError("pointseg answered\nwith NaN")
        if len(points) and points[0, 3] == 2.0:
            raise KeyboardInterrupt
        views = [card.view.kind for card in self.cards]
        labels = np.arange(len(points), dtype=np.uint8) % 2
        cells = np.zeros((400, 200), dtype=np.uint8)
        cells[:100, :100] = 1
        top_view = TopView(cells, SSADNET.classes, 0.1, (6.0, 46.0), (-10.0, 10.0), np.ones(cells.shape, bool))
        box = Box("car", 0.912345, (20.0, -3.0, -0.9), (4.2, 1.8, 1.6), 0.3)
        return Perception(
            n_points=len(points),
            n_dropped=0,
            points=PointLabels(labels, np.ones(len(points), bool), POINTSEG.classes)
            if "range_image" in views
            else None,
            top_view=top_view if "top_view" in views else None,
            boxes=(box,) if "top_view" in views else (),
            stage_ms={"project": 1.0, "infer": 20.25},
            providers={card.name: "CPUExecutionProvider (fp32)" for card in self.cards},
            fitness=("the scan has 32 beams",) if len(points) == 5 else (),
            stamp_s=stamp_s,
            origin_m=origin_m,
        )


@pytest.fixture(autouse=True)
def fake(monkeypatch: pytest.MonkeyPatch) -> type[FakePerceiver]:
    monkeypatch.setitem(sys.modules, "edgeperc.perceiver", SimpleNamespace(Perceiver=FakePerceiver))
    monkeypatch.setattr(FakePerceiver, "made", [])
    return FakePerceiver


def test_scans_may_stand_between_and_after_options(tmp_path: Path, shell: Shell) -> None:
    first, second = write_scan(tmp_path / "a.bin"), write_scan(tmp_path / "b.bin")
    assert len(shell.out("run", first, "--json", second, "--threads", 1).splitlines()) == 2
    error = f"edgeperc run: error: unrecognized arguments: {tmp_path / 'c.bin'}"
    said = shell.err("run", first, "--json", tmp_path / "c.bin").splitlines()
    assert said == [error, "See edgeperc run --help"]


def test_version_and_usage(shell: Shell) -> None:
    assert shell.out("--version") == f"edgeperc {__version__}\n"
    for wrong in ((), ("run",), ("run", "\0")):
        assert shell.err(*wrong)
    assert "1 or more" in shell.err("run", "x.bin", "--threads", "0")


@pytest.mark.parametrize("sensor", ["os1-64", "av2", "vod", "lyft"])
def test_the_range_of_remission_is_an_option(sensor: str, tmp_path: Path, fake: type[FakePerceiver]) -> None:
    scan = write_scan(tmp_path / "0.bin")
    assert run("run", scan, "--sensor", sensor, "--remission-range", "0", "1000") == 0
    assert run("run", scan, "--sensor", sensor) == 0
    assert fake.made[0].given[1] == replace(get_sensor(sensor), remission_range=(0.0, 1000.0))
    assert fake.made[1].given[1] == sensor
    assert run("run", scan, "--sensor", sensor, "--remission-range", "5", "5") == 2


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys, edgeperc.cli\n"
        "try: edgeperc.cli.main(['run', '--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'numpy', 'numba', 'onnxruntime', 'matplotlib'} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)\n"
    )
    assert "--on-mismatch" in printed(code)


def test_help_of_eval_and_wrong_usage(shell: Shell) -> None:
    assert "95 % intervals over drives" in " ".join(shell.out("eval", "--help").split())
    assert shell.err("eval")
    assert "invalid choice: 'some'" in shell.err("eval", "simulation:1", "--split", "some")


def test_eval_passes_its_options_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    asked = []

    def evaluate(datasets: list[str], models: tuple[str, ...], how: Perceiving, **_: object) -> tuple[dict, list]:
        asked.append((datasets, models, how))
        return {"models": {"x": "1"}, "providers": {"x": "x fp32, cpu"}, "split": "test", "fold": None}, []

    monkeypatch.setitem(sys.modules, "edgeperc.evaluation.evaluate", SimpleNamespace(evaluate=evaluate))
    assert run("eval", "KITTI", "simulation:2") == 0
    options = ("--provider", "openvino", "--precision", "bf16", "--boxes-from", "network", "--score-threshold", "0.1")
    assert run("eval", "x", "--model", "a", *options) == 0
    (datasets, models, first), (_, own, second) = asked
    assert (datasets, models, own) == (["KITTI", "simulation:2"], zoo.DEFAULT, ["a"])
    assert (first.provider, first.precision, first.boxes_from, first.score_threshold) == ("cpu", "auto", "both", None)
    assert (second.provider, second.precision, second.boxes_from) == ("openvino", "bf16", "network")
    assert second.score_threshold == 0.1
    assert capsys.readouterr().out.splitlines()[1] == "ran as x fp32, cpu"


def test_tables_of_figures() -> None:
    car = {"precision": 0.5, "recall": 0.25, "iou": 0.2, "iou_interval": [0.1, 0.3], "n_points": 1200, "n_objects": 3}
    none = dict.fromkeys(car) | {"n_points": 0, "n_objects": 0}
    boxes = {
        "ap": 1.0,
        "ap_interval": None,
        "precision": None,
        "recall": 0.0,
        "n_truth": 2,
        "n_predicted": 0,
        "n_hits": 0,
    }
    figures = {
        "models": {"pointseg": "1.2.3"},
        "providers": {"pointseg": "pointseg int8, CPUExecutionProvider"},
        "split": "validation",
        "fold": 1,
        "semantickitti": {
            "n_frames": 1,
            "n_drives": 1,
            "points": {"all": {"car": car, "cyclist": none}, "0-15 m": {"car": none, "cyclist": none}},
            "boxes": {"upright": {"all": {"mean_ap": 1.0, "car": boxes, "vehicle": boxes}}},
        },
    }
    lines = figure_lines(figures)
    assert lines[0].startswith("pointseg 1.2.3; validation drives, fold 1")
    assert lines[1] == "ran as pointseg int8, CPUExecutionProvider"
    assert lines[3] == "== SemanticKITTI: 1 scan, 1 drive =="
    words = [line.split() for line in lines[4:]]
    assert ["all", "car", "20.0", "10.0-30.0", "-", "-", "50.0", "-", "25.0", "-", "1,200", "3", "-"] in words
    assert ["all", "car", "100.0", "-", "-", "-", "0.0", *"-----", "2", "0", "0", "-", "-"] in words
    assert ["mean", "100.0", *"--------------"] in words
    assert not any("cyclist" in line for line in words)


def test_run_prints_a_line_a_scan(tmp_path: Path, shell: Shell, fake: type[FakePerceiver]) -> None:
    scans = [write_scan(tmp_path / f"{k}.bin", n) for k, n in enumerate((40, 1200, 0 + 3))]
    options = ("--sensor", "os1-64", "--provider", "cpu", "--threads", 2, "--on-mismatch", "ignore")
    lines = shell.out("run", *scans, *options).splitlines()
    assert [line.split("  ")[0] for line in lines] == [str(scan) for scan in scans]
    assert "1,200 points" in lines[1]
    assert "21.2 ms" in lines[1]
    assert "drivable 100.0 m2" in lines[1]
    assert "boxes: 1 car" in lines[1]
    assert "car 600, pedestrian 0, cyclist 0 of 1,200 in view" in lines[1]
    assert fake.made[0].given == ([*zoo.DEFAULT], "os1-64", "cpu", 2, "ignore")
    options = ("--boxes-from", "clusters", "--full-turn", "--precision", "bf16", "--adapt", "none", "--trusted")
    assert run("run", scans[0], *options, "--no-agreement", "--score-threshold", "0.4") == 0
    usual = {"precision": "auto", "adapt": "both", "boxes_from": "both", "full_turn": False, "agree": True}
    other = {"precision": "bf16", "adapt": "none", "boxes_from": "clusters", "full_turn": True, "agree": False}
    assert [one.more for one in fake.made] == [
        {**usual, "trusted": False, "score_threshold": None},
        {**other, "trusted": True, "score_threshold": 0.4},
    ]


def test_json_is_one_object_a_scan_and_nothing_else(tmp_path: Path, shell: Shell) -> None:
    good, bad, short = tmp_path / "good.bin", tmp_path / "bad.bin", tmp_path / "short.bin"
    write_scan(good, 5)
    write_scan(bad, 40, first_remission=1.0)
    short.write_bytes(b"123")
    absent = tmp_path / "absent.bin"
    captured = shell.both("run", bad, good, short, absent, "--json", code=1)
    answers = [json.loads(line) for line in captured.out.splitlines()]
    assert [answer["scan"] for answer in answers] == [str(path) for path in (bad, good, short, absent)]
    assert ["error" in answer for answer in answers] == [True, False, True, True]
    assert answers[0] == {"scan": str(bad), "error": "pointseg answered with NaN"}
    assert answers[1] == {
        "scan": str(good),
        "stamp_s": None,
        "live": None,
        "n_points": 5,
        "n_dropped": 0,
        "dropped": {"not_finite": 0, "too_near": 0, "ego": 0},
        "stage_ms": {"project": 1.0, "infer": 20.25},
        "providers": dict.fromkeys(zoo.DEFAULT, "CPUExecutionProvider (fp32)"),
        "boxes": [
            {"label": "car", "score": 0.9123, "center": [20.0, -3.0, -0.9], "size": [4.2, 1.8, 1.6]}
            | {"yaw": 0.3, "front": None}
        ],
        "drivable_area_m2": 100.0,
        "road": {
            "outline": [[36.0, 0.0], [46.0, 0.0], [46.0, 10.0], [36.0, 10.0]],
            "holes": [],
            "tolerance_m": 0.2,
            "free_ahead_end": "edge of the road",
            "free_ahead_m": 6.0,
            "obstacle_ahead_m": None,
            "edge_ahead_m": 6.0,
            "unknown_ahead_m": None,
            "view_ahead_m": 46.0,
            "lane_width_m": None,
        },
        "point_counts": {"background": 3, "car": 2, "pedestrian": 0, "cyclist": 0},
        "n_in_view": 5,
        "tracks": [],
        "tracks_late": None,
        "fitness": ["the scan has 32 beams"],
        "mounting": {"height_m": 1.73, "roll_deg": 0.0, "pitch_deg": 0.66, "yaw_deg": 0.0, "origin_m": [0.0, 0.0]},
        "remission": None,
        "image": None,
        "origin_m": None,
        "map_boxes": None,
        "map_tracks": None,
        "sensor_health": SensorHealth().to_dict(),
    }
    complaints = captured.err.splitlines()
    assert [line.startswith("edgeperc: ") for line in complaints] == [True, True, True, False]
    assert complaints[3].startswith("4 scans, 3 failed")
    assert captured.err.count(str(short)) == 1
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    "words",
    [
        ["--origin", "512345.25", "5412345.5", "113", "scan.npy"],
        ["scan.npy", "--origin", "auto"],
        ["--origin", "auto", "scan.npy"],
    ],
)
def test_boxes_come_back_in_the_map(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    monkeypatch.chdir(tmp_path)
    points, origin = simulated_scan(3, thinned("os1-64")).points, np.array([512345.25, 5412345.5, 113.0])
    np.save("scan.npy", np.column_stack([points[:, :3].astype(np.float64) + origin, points[:, 3]]))
    (answer,) = shell.records("run", *words, "--model", "ssadnet", "--model", "pointseg")
    np.testing.assert_allclose(answer["origin_m"], origin, atol=0.05)
    (box,), (placed,) = answer["boxes"], answer["map_boxes"]
    np.testing.assert_allclose(np.subtract(placed["center"], answer["origin_m"]), box["center"], atol=1e-3)
    assert placed["yaw"] == box["yaw"]


def test_tracks_are_placed_in_the_map(tmp_path: Path, shell: Shell) -> None:
    """The places of the scans are the sensor's motion: a box that stays ahead of it moves as fast as it."""
    origin, files = np.array([512345.25, 5412345.5, 113.0]), []
    drive = simulate_sequence(random_scene(4, "urban"), thinned("vlp-16"), 4, ego_speed_mps=8.0, seed=4)
    for k, (_, pose, scan) in enumerate(drive):
        files.append(tmp_path / f"{k}.npy")
        in_map = scan.points[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3] + origin
        np.save(files[-1], np.column_stack([in_map, scan.points[:, 3]]))
    answers = shell.records("run", *files, "--origin", "auto", "--track", "--model", "ssadnet", "--model", "pointseg")
    assert [len(answer["tracks"]) for answer in answers] == [0, 1, 1, 1]
    for answer in answers:
        for track, placed in zip(answer["tracks"], answer["map_tracks"], strict=True):
            assert (placed["id"], placed["label"], placed["yaw"]) == (track["id"], track["label"], track["yaw"])
            np.testing.assert_allclose(np.subtract(placed["center"], answer["origin_m"]), track["center"], atol=1e-3)
    assert np.hypot(*answers[-1]["tracks"][0]["velocity"]) == pytest.approx(8.0, abs=1.0)
    moved = np.subtract(answers[-1]["map_tracks"][0]["center"], answers[1]["map_tracks"][0]["center"])
    assert np.linalg.norm(moved) == pytest.approx(1.6, abs=0.3)


@pytest.mark.parametrize("names", [("x", "y", "z", "intensity", "ring"), ("ring", "z", "y", "x", "remission", "time")])
def test_an_array_of_more_columns_takes_their_names(tmp_path: Path, shell: Shell, names: tuple[str, ...]) -> None:
    points = read_points(write_scan(tmp_path / "a.bin"))
    columns = {**dict(zip(("x", "y", "z", "remission"), points.T, strict=True)), "intensity": points[:, 3]}
    np.save(tmp_path / "a.npy", np.column_stack([columns.get(name, np.zeros(len(points))) for name in names]))
    first, second = shell.records("run", tmp_path / "a.bin", tmp_path / "a.npy", code=1)
    assert "--columns x y z intensity ring" in second["error"]
    (answer,) = shell.records("run", tmp_path / "a.npy", "--columns", *names)
    assert answer["point_counts"] == first["point_counts"]


def test_an_origin_that_cannot_be_found_fails_the_scan(tmp_path: Path, shell: Shell) -> None:
    said = shell.err("run", write_scan(tmp_path / "a.bin"), "--origin", "auto", code=1)
    assert "place of the sensor cannot be told" in said


def test_json_of_one_model_says_null_for_the_other(tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "a.bin")
    (answer,) = shell.records("run", scan, "--model", "pointseg")
    assert answer["drivable_area_m2"] is None
    assert answer["road"] is None
    assert answer["boxes"] == []
    assert shell.records("run", scan, "--model", "ssadnet")[0]["point_counts"] is None


def test_folders_are_opened_and_sorted(tmp_path: Path, shell: Shell) -> None:
    folder = tmp_path / "scans"
    for name in ("b.bin", "a.BIN", ".hidden.bin", "deeper/c.bin"):
        write_scan(folder / name)
    np.save(folder / "c.npy", np.zeros((3, 4), np.float32))
    (folder / "notes.txt").write_text("no scan")
    (folder / "folder.bin").mkdir()
    answers = shell.records("run", folder, folder / "b.bin")
    assert [Path(answer["scan"]).name for answer in answers] == ["a.BIN", "b.bin", "c.npy"]
    bare = tmp_path / "bare"
    bare.mkdir()
    answers = shell.records("run", bare, folder / "b.bin", code=1)
    assert answers[0]["scan"] == str(bare)
    assert "no scan in this folder" in answers[0]["error"]
    assert answers[1]["n_points"] == 40
    (bare / "0.csv").write_text("x,y,z\n1,2,3\n")
    assert f"pass tables of text by name: {bare}/*.csv" in shell.err("run", bare, code=1)


def test_huge_scans_fail_and_the_others_go_on(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def perceive(self: FakePerceiver, points: np.ndarray, stamp_s: float | None = None, **more: Any) -> Perception:
        if len(points) == 41:
            raise MemoryError
        return real(self, points, stamp_s, **more)

    real = FakePerceiver.__call__
    monkeypatch.setattr(FakePerceiver, "__call__", perceive)
    with (tmp_path / "a.bin").open("wb") as file:
        file.truncate(100 << 30)  # sparse
    write_scan(tmp_path / "b.bin", 41)
    write_scan(tmp_path / "c.bin")
    done, errors = shell.both("run", tmp_path, code=1)
    assert "c.bin" in done
    assert "a.bin: 107,374,182,400 bytes are too much for one scan; expected at most 268,435,456" in errors
    assert "b.bin: 41 points take more memory than there is" in errors


@pytest.mark.skipif(os.name == "nt", reason="file names cannot have these characters")
@pytest.mark.parametrize("command", [("run",), ("run", "--json"), ("info",), ("info", "--json")])
def test_names_of_files_do_not_reach_the_terminal_raw(tmp_path: Path, shell: Shell, command: tuple[str, ...]) -> None:
    good = write_scan(tmp_path / "a\x1b]0;title\x07\n\u202eb.bin")
    bad, capture = tmp_path / "c\x1b[2J\r.bin", tmp_path / "d\x9b1m.pcap"
    bad.write_bytes(b"no scan")
    capture.write_bytes(b"no capture")
    shown = "".join(shell.both(*command, good, bad, capture, code=1))
    assert all(name in shown for name in ("\\u001b]0;title", "\\u001b[2J", "1m.pcap"))
    assert all(line.isprintable() for line in shown.split("\n"))


@pytest.mark.parametrize(("option", "passed"), [((), "refuse"), (("--anyway",), "warn")])
def test_anyway(tmp_path: Path, fake: type[FakePerceiver], option: tuple[str, ...], passed: str) -> None:
    assert run("run", write_scan(tmp_path / "a.bin"), *option) == 0
    assert fake.made[0].given[-1] == passed


@pytest.fixture
def capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A capture of three scans, cut short; the second of them makes the perceiver choke."""
    path = write_pcap(tmp_path / "drive.pcap", vlp16_packets(0.1))

    def read_scans(source: Path, topic: str | None = None, **_: object) -> Iterator[tuple[float, np.ndarray]]:
        if source != path:
            yield from real(source, topic=topic)
            return
        for k in range(3):
            points = np.full((10 + k, 4), 0.5, np.float32)
            points[0, 3] = float(k == 1)
            yield 100.0 + k, points
        raise PointsError(f"{path}: cut short, topic {topic}")

    real = captures.read_scans
    monkeypatch.setattr(captures, "read_scans", read_scans)
    return path


def test_the_scans_of_a_capture_are_numbered(capture: Path, tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "in" / "a.bin")
    out = tmp_path / "out"
    captured = shell.both("run", capture, scan, "--json", "--labels", "--out", out, "--topic", "/left", code=1)
    answers = [json.loads(line) for line in captured.out.splitlines()]
    names = [*(str(capture / f"{k:06d}") for k in range(3)), str(capture), str(scan)]
    assert [answer["scan"] for answer in answers] == names
    assert [answer.get("n_points") for answer in answers] == [10, None, 12, None, 40]
    assert [answer.get("stamp_s") for answer in answers] == [100.0, None, 102.0, None, None]
    assert answers[1]["error"] == "pointseg answered with NaN"
    assert answers[3]["error"].endswith("cut short, topic /left")
    assert "5 scans, 2 failed" in captured.err
    written = {file.relative_to(out).as_posix(): file.stat().st_size // 4 for file in out.rglob("*.label")}
    assert written == {"drive/000000.label": 10, "drive/000002.label": 12, "a.label": 40}
    assert "10, of which 0 are not finite" in shell.out("info", capture, code=1)  # run refuses its ten points


@pytest.mark.filterwarnings("always:got a scan at")
@pytest.mark.parametrize("live", [False, True])
@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda k: 100.0 + 0.1 * k - 2.0 * (k > 4), "the clock jumped"),
        (lambda k: 100.0 + 0.1 * k - 0.121 * (k == 5), "late or doubled"),
        (lambda k: 0.0 if k == 0 else 100.0 + 0.1 * k, "the clock jumped"),
        (lambda k: 100.0 + 0.1 * (k % 5), "the clock jumped"),
        (lambda k: 100.0 + 0.1 * (k // 2), "late or doubled"),
        (lambda k: 2147483651.0 if k == 4 else 100.0 + 0.1 * k, "the stamp before was wrong"),
    ],
)
def test_every_scan_is_answered_whatever_the_clock_does(
    wrong: Callable[[int], float], said: str, live: bool, tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_pcap(tmp_path / "drive.pcap", vlp16_packets(0.1))

    def read(source: Path, topic: str | None = None, **_: object) -> Iterator[tuple[float, np.ndarray]]:
        return ((wrong(k), np.full((10, 4), 0.5, np.float32)) for k in range(10))

    for module in ("edgeperc.readers.captures", "edgeperc.live"):
        monkeypatch.setattr(f"{module}.read_scans", read)
    options = ["--live", "--rate", 20] if live else []
    captured = shell.both("run", path, "--track", *options)
    answers = captured.out.splitlines()
    assert len(answers) == 10 or (live and answers)
    assert all("tracks: " in answer for answer in answers)
    if not live:
        assert captured.err.count(said) == 1
        assert all("boxes: 1 car" in answer for answer in answers)
        assert answers[-2 if said.startswith("late") else -1].endswith("tracks: 1 object")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (
            "ModuleNotFoundError('not installed', name='ouster')",
            "is not installed. Run: pip install 'edgeperc[ouster]'",
        ),
        ("ImportError('libfoo.so.3: no such file')", "is installed, but cannot be imported: libfoo.so.3: no such file"),
    ],
)
def test_a_missing_or_damaged_reader_is_said_at_once(
    tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch, error: str, text: str
) -> None:
    (tmp_path / "frames.osf").write_bytes(bytes(8) + b"OSF#" + bytes(8))
    (tmp_path / "absent").mkdir()
    (tmp_path / "absent" / "ouster.py").write_text(f"raise {error}\n")
    monkeypatch.syspath_prepend(tmp_path / "absent")  # the process that decodes captures has this process's path
    assert text in shell.err("run", tmp_path / "frames.osf")


def test_live(tmp_path: Path, shell: Shell) -> None:
    folder = tmp_path / "scans"
    for k in range(4):
        write_scan(folder / f"{k}.bin", 10 + k)
    answers = shell.records("run", folder, "--live", "--rate", 1000)
    assert [answer["scan"] for answer in answers] == [str(folder / f"{a['n_points'] - 10}.bin") for a in answers]
    assert answers[-1]["n_points"] == 13
    assert answers[-1]["stamp_s"] == pytest.approx(0.003)
    last = answers[-1]["live"]
    assert last["scans"] == 4
    assert last["dropped"] == 4 - len(answers)
    assert last["health"] in {"OK", "LATE", "STALE"}
    assert last["age_ms"] >= 0.0
    (folder / "4.bin").write_bytes(b"123")
    captured = shell.both("run", folder, "--live", "--rate", 1000, code=1)
    assert "4.bin" in captured.err
    words = captured.out.splitlines()[-1].split("  ")
    assert words[0] == str(folder / "3.bin")
    assert [word.split()[0] for word in words[1:5]] == ["age_ms", "health", "scans", "dropped"]
    assert words[5] == "13 points"


def test_live_goes_on_after_a_scan_that_fails(tmp_path: Path, shell: Shell) -> None:
    write_scan(tmp_path / "a.bin", 10, first_remission=1.0)
    (answer,) = shell.records("run", tmp_path, "--live", code=1)
    assert answer == {"scan": str(tmp_path), "error": "pointseg answered with NaN"}
    assert "there is no such file or folder" in shell.err("run", tmp_path / "absent", "--live")
    scan = write_scan(tmp_path / "drive" / "b.bin", 10)
    (tmp_path / "kept").mkdir()
    (tmp_path / "kept" / "b.bin").write_bytes(b"by hand")
    (answer,) = shell.records("run", scan, "--live", "--movable", "--static", tmp_path / "kept", code=1)
    assert answer["n_points"] == 10


@pytest.mark.usefixtures("matplotlib", "foreground")
def test_files_are_written(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of what comes at a port are whole when it is interrupted."""
    scan = write_scan(tmp_path / "in" / "000123.bin", 40)
    out = tmp_path / "out"
    (answer,) = shell.records("run", scan, "--out", out, "--png", "--html", "--labels", "--ply")
    assert sorted(file.name for file in out.iterdir()) == ["000123.html", "000123.label", "000123.ply", "000123.png"]
    np.testing.assert_array_equal(np.fromfile(out / "000123.label", "<u4"), np.arange(40) % 2 * 10)
    assert (out / "000123.png").read_bytes().startswith(b"\x89PNG")
    assert b"element vertex 40\n" in (out / "000123.ply").read_bytes()
    assert "000123.bin" in (out / "000123.html").read_text(encoding="utf-8")
    assert answer["n_points"] == 40
    (one,) = captures.read_scans(scan)
    sent = [one, None]
    monkeypatch.setattr(
        captures, "read_scans", lambda *_, **__: (each or signal.raise_signal(signal.SIGINT) for each in sent)
    )
    monkeypatch.setattr(captures, "known_sensor", lambda *_: None)
    given = ["--sensor", "hdl-64e", "--track", "--play", out / "play.html", "--consistency", out / "figures.json"]
    gif = ["--gif", "--out", tmp_path]
    for n_scans, option in ((1, gif), (2, gif), (3, [])):
        shell.both("run", "udp:2368", *given, *option, code=130)
        assert json.loads((out / "figures.json").read_text())["n_scans"] == n_scans
        sent.insert(0, one)
    assert (tmp_path / "tracks.gif").exists()
    assert (out / "play.html").exists()


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (["/d/a.bin", "/d/b.pcd.bin"], ["a", "b"]),
        (["/d/1699.25.bin", "/d/1699.50.bin"], ["1699.25", "1699.50"]),
        (["/d/a.bin", "/d/a.pcd"], ["a.bin", "a.pcd"]),
        (["/d/a.bin", "/d/a.pcd.bin", "/e/a.bin"], ["d/a.bin", "d/a.pcd.bin", "e/a.bin"]),
        (["/d/A.bin", "/e/a.bin"], ["d/A", "e/a"]),
        (["/x/d/a.bin", "/y/d/a.bin", "/y/d/b.bin"], ["x/d/a", "y/d/a", "y/d/b"]),
        (["/a.bin", "/d/a.bin"], ["a", "d/a"]),
        (["/00/velodyne/a.bin", "/01/velodyne/a.bin"], ["00/a", "01/a"]),
        (["/a/velodyne/0.bin", "/b/../b/velodyne/0.bin"], ["a/0", "b/0"]),
        (["/d/velodyne/a.bin", "/d/a.bin"], ["velodyne/a", "d/a"]),
        (["/d/.bin"], [".bin"]),
        (["/d/..bin"], ["..bin"]),
        ([], []),
    ],
)
def test_output_names(given: list[str], names: list[str]) -> None:
    assert [name.as_posix() for name in output_names([Path(scan) for scan in given])] == names


FOLDERS = st.lists(st.sampled_from(["a", "b", "velodyne", "data", "A"]), max_size=3)


@given(
    st.lists(st.tuples(FOLDERS, st.sampled_from(["0", "1", "x"]), st.sampled_from([".bin", ".pcd", ".pcd.bin"]))),
    st.booleans(),
)
def test_output_names_never_collide(scans: list[tuple[list[str], str, str]], keep_folder: bool) -> None:
    paths = [Path("/", *folders, stem + suffix) for folders, stem, suffix in scans]
    paths = list({str(path).casefold(): path for path in paths}.values())
    names = output_names(paths, keep_folder=keep_folder)
    assert len({str(name).casefold() for name in names}) == len(paths)
    for path, name in zip(paths, names, strict=True):
        assert path.name.startswith(name.name)
        assert not name.is_absolute()


def test_a_scan_is_never_overwritten(tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "scan.bin")
    ply = tmp_path / "scan.ply"
    assert run("run", scan, "--ply", "--out", tmp_path) == 0
    before = ply.read_bytes()
    assert "would be overwritten" in shell.err("run", ply, "--ply", "--out", tmp_path)
    assert ply.read_bytes() == before


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="needs a file that opens and cannot be read")
def test_a_scan_that_cannot_be_read_costs_no_other_scan(tmp_path: Path, shell: Shell) -> None:
    for name in ("a.bin", "c.bin"):
        write_scan(tmp_path / name)
    (tmp_path / "b.bin").symlink_to("/proc/self/mem")
    out, err = shell.both("run", tmp_path, code=1)
    assert [Path(line.split()[0]).name for line in out.splitlines()] == ["a.bin", "c.bin"]
    assert f"{tmp_path / 'b.bin'}: the file cannot be read" in err


@pytest.mark.filterwarnings("default")
def test_a_scan_that_fails_takes_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    """Without it, what moves had twice its speed behind the gap. The next folder's scans continue no track."""
    stamps_s = []
    update = Tracker.update
    monkeypatch.setattr(Tracker, "update", lambda self, *a, **k: (stamps_s.append(a[1]), update(self, *a, **k))[1])
    for k in range(5):
        write_scan(tmp_path / f"{k}.bin")
    (tmp_path / "1.bin").write_bytes(b"\0" * 17)  # cannot be read
    (tmp_path / "3.bin").unlink()
    (tmp_path / "3.bin").symlink_to("nowhere")
    scans = [tmp_path / f"next_{k}/0.bin" for k in range(2)]  # a folder of one scan is no drive
    for scan in scans:
        scan.parent.mkdir()
        write_scan(scan)
    assert shell.err("run", tmp_path, *scans, "--track", code=1).count("another drive") == 1
    assert stamps_s[-5:] == pytest.approx([0.1, 0.3, 0.5, 100.6, 100.7])  # before them, those of a warm-up


@pytest.mark.filterwarnings("default")
def test_sweeps_come_with_the_next_scans(tmp_path: Path, shell: Shell) -> None:
    """From the second scan on, at places in a map or by KISS-ICP; none of another drive."""
    for k in range(12):
        (tmp_path / f"{k // 6}").mkdir(exist_ok=True)
        write_scan(tmp_path / f"{k // 6}" / f"{k % 6}.bin")
    FakePerceiver.n_earlier.clear()
    shell.out("run", tmp_path / "0", "--track", "--sweeps", 3, "--origin", 0, 0, 0)
    assert [bool(n) for n in FakePerceiver.n_earlier] == [False, True, True, True, True, True]
    pytest.importorskip("kiss_icp", reason="the extra slam is not installed")
    FakePerceiver.n_earlier.clear()
    shell.out("run", tmp_path / "0", tmp_path / "1", "--track", "--sweeps", 3)
    assert [bool(n) for n in FakePerceiver.n_earlier] == 2 * [False, True, True, True, True, True]
    FakePerceiver.n_earlier.clear()
    answers = shell.records("run", tmp_path / "0", "--track", "--sweeps", 3, "--live", "--rate", 2)
    assert [bool(n) for n in FakePerceiver.n_earlier] == [False, True, True, True, True, True]
    assert [answer["tracks_late"] for answer in answers] == [False] * 6
    FakePerceiver.n_earlier.clear()
    shell.out("run", tmp_path / "0", "--track")
    assert FakePerceiver.n_earlier == [None] * 6


def test_nothing_is_written_that_the_next_run_of_the_folder_would_read(tmp_path: Path, shell: Shell) -> None:
    """A second run perceived each scan twice: the .bin, and the .ply of the first run."""
    drive = tmp_path / "drive"
    drive.mkdir()
    scan = write_scan(drive / "scan.bin")
    for options in (("--ply", "--out", drive), ("--mcap", drive / "run.mcap")):
        assert "would be read with the scans of its folder by the next run" in shell.err("run", drive, *options)
    assert [*drive.iterdir()] == [scan]
    assert run("run", drive, "--labels", "--out", drive) == 0
    assert run("run", scan, "--ply", "--out", tmp_path) == 0


@pytest.mark.parametrize(
    ("options", "both"),
    [
        ("--mcap out/a --play out/a", "--mcap and --play"),
        ("--rrd a --bag out/../a", "--rrd and --bag"),
        ("--ply --out out --play out/0.ply", "--out and --play"),
        ("--labels-for cvat --out out --mcap out/annotations.zip", "--mcap and --labels-for"),
        ("--track --gif --out out --play out/tracks.gif", "--gif and --play"),
        ("--static out --movable --play out/0.bin", "--play and --static"),
        ("--mcap link/a --play out/a", "--mcap and --play"),
    ],
)
def test_no_file_is_written_twice(
    options: str, both: str, tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "--gif" in options:  # an extra is missed before what is written is compared
        pytest.importorskip("PIL")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "out")
    write_scan(tmp_path / "0.bin")
    assert f"{both} both write" in shell.err("run", "0.bin", *options.split())
    assert not [*(tmp_path / "out").iterdir()]


def test_wrong_usage(tmp_path: Path, shell: Shell, fake: type[FakePerceiver]) -> None:
    scan = write_scan(tmp_path / "a.bin")
    (tmp_path / "tracks.gif").mkdir()
    for arguments, words in [
        (("--play", tmp_path), "is a folder; expected the name of a file"),
        *[(("--gif", "--track", "--out", tmp_path), "tracks.gif is a folder; expected")]
        * (find_spec("PIL") is not None),
        (("--png",), "--png needs --out DIR"),
        (("--out", tmp_path / "out"), "add --png"),
        (("--on-mismatch", "explode"), "invalid choice"),
        (("--rate", "0"), "above 0"),
        (("--rate", "nan"), "above 0"),
        (("--threads", "2.5"), "--threads: '2.5' is no whole number"),
        *((("--score-threshold", value), "--score-threshold: ") for value in ("1.5", "-0.1", "nan")),
        (("--origin", "1", "2"), "--origin: expected 3 arguments"),
        (("--origin", "auto", "1", "2"), "unrecognized arguments: 1 2"),
        (("--origin", "1", "auto", "2"), "--origin 1.0 auto 2.0: expected X Y Z, or auto"),
        (("--origin", "a", "b", "c"), "--origin: 'a' is no number"),
        (("--origin", "nan", "0", "0"), "--origin: nan is not finite"),
        (("--live", "--ply", "--out", tmp_path / "out"), "--live writes no files; leave out --ply"),
        ((scan, "--live"), f"--live replays one path, got 2: {scan}, {scan}"),
        (("--deskew",), "--deskew needs --poses FILE or --track"),
        (("--poses", scan), "--poses needs --deskew or --track"),
        (("--times", scan, "--live"), "--times needs no --live"),
        (("--sweeps", "5"), "--sweeps needs --track"),
        (("--sweeps", "21", "--track"), "--sweeps is 21; expected 2 to 20"),
        (("--deskew", "--track", "--live"), "and no --live"),
    ]:
        assert words in shell.err("run", scan, *arguments)
    for arguments, words in [
        (("--model", "nonesuch"), "no model is called 'nonesuch'. Shipped: objects, pointseg, ssadnet."),
        (
            ("--model", "pointseg", "--model", "pointseg"),
            "--model ['pointseg', 'pointseg'] have one view; --threads is",
        ),
        (("--model", "ssadnet", "--labels", "--out", tmp_path / "out"), "add a range-image model"),
    ]:
        captured = shell.both("run", scan, *arguments, code=2)
        assert captured.out == ""
        assert captured.err.startswith("edgeperc: ")
        assert captured.err.count("\n") == 1
        assert words in captured.err
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("in the way")
    assert shell.err("run", scan, "--labels", "--out", tmp_path / "file").count("\n") == 1


def test_a_file_that_cannot_be_written_fails_its_scan_alone(tmp_path: Path, shell: Shell) -> None:
    scans = [write_scan(tmp_path / name) for name in ("a.bin", "b.bin")]
    (tmp_path / "out" / "a.label").mkdir(parents=True)
    assert "a.label" in shell.err("run", *scans, "--labels", "--out", tmp_path / "out", code=1)
    assert (tmp_path / "out" / "b.label").stat().st_size == 160


@pytest.mark.parametrize(
    "words", ["run a.bin --png --out out", "eval simulation:1 --worst worst.png --json out/a.json"]
)
def test_missing_matplotlib_is_said_before_any_work(
    words: str, tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch, fake: type[FakePerceiver]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    write_scan(tmp_path / "a.bin")
    assert "pip install 'edgeperc[view]'" in shell.err(*words.split())
    assert fake.made == []
    assert not (tmp_path / "out").exists()


def test_interrupted(tmp_path: Path, shell: Shell) -> None:
    scans = [write_scan(tmp_path / "a.bin"), write_scan(tmp_path / "b.bin", 40, first_remission=2.0)]
    captured = shell.both("run", *scans, "--json", code=130)
    assert len(captured.out.splitlines()) == 1
    assert captured.err == "edgeperc: interrupted\n"


@pytest.mark.skipif(os.name != "posix", reason="pipes are told of differently elsewhere")
def test_a_reader_that_goes_away_is_no_accident(tmp_path: Path) -> None:
    for k in range(30):
        write_scan(tmp_path / f"{k:02}.bin")
    code = (
        "import sys, types; from edgeperc.types.perception import Perception\n"
        "class Perceiver:\n"
        "    cards = (); sensor = 'hdl-64e'\n"
        "    def __init__(self, models, **_): pass\n"
        "    def __call__(self, points, stamp_s=None, **_):\n"
        "        return Perception(len(points), 0, None, None, (), {}, {}, (), stamp_s)\n"
        "sys.modules['edgeperc.perceiver'] = types.SimpleNamespace(Perceiver=Perceiver)\n"
        "from edgeperc.cli import main; sys.exit(main(['run', sys.argv[1], '--json']))\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    complaints = process.stderr.read().decode()
    process.stderr.close()
    assert process.wait() == 141
    assert "Traceback" not in complaints
    assert "BrokenPipe" not in complaints


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere file names are Unicode")
def test_names_that_are_no_text(tmp_path: Path, shell: Shell) -> None:
    scan = tmp_path / os.fsdecode(b"caf\xe9.bin")
    write_scan(scan)
    assert "\\udce9.bin" in shell.out("run", scan)
    assert run("run", scan, "--html", "--out", tmp_path / "out") == 0
    assert len(list((tmp_path / "out").iterdir())) == 1


def test_a_progress_bar_is_drawn_on_a_terminal_below_the_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("tqdm")
    monkeypatch.setattr(sys, "stderr", Terminal())
    with progress("file") as show:
        show(0, 4)
        show(2, 4)
        print_line("a line")
    shown = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert "0/4" in shown
    assert "2/4" in shown
    assert "file" in shown
    assert shown.endswith("\r")  # nothing of the bar stays
    assert capsys.readouterr().out == "a line\n"


@pytest.mark.parametrize("why", ["no terminal", "one thing", "no tqdm"])
def test_no_progress_bar(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", io.StringIO() if why == "no terminal" else Terminal())
    if why == "no tqdm":
        monkeypatch.setitem(sys.modules, "tqdm", None)
    with progress() as show:
        show(0, 1 if why == "one thing" else 4)
        show(1, 1 if why == "one thing" else 4)
    assert sys.stderr.getvalue() == ""  # type: ignore[attr-defined]


def test_run_shows_progress_beside_its_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell) -> None:
    pytest.importorskip("tqdm")
    scans = [write_scan(tmp_path / f"{k}.bin") for k in range(3)]
    monkeypatch.setattr(sys, "stderr", Terminal())
    lines = shell.out("run", *scans).splitlines()
    assert "1/3" in sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert [line.split("  ")[0] for line in lines] == [str(scan) for scan in scans]


@pytest.fixture
def fake_street(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (1000, 4)).astype(np.float32)
    street = SimpleNamespace(points=points)
    monkeypatch.setattr("edgeperc.simulation.drawn.random_scene", lambda seed, environment: seed)
    monkeypatch.setattr("edgeperc.simulation.scene.simulate", lambda scene, sensor, seed: street)
    road = np.full(1000, SCENE_CLASSES.index("road"), np.uint8)
    monkeypatch.setattr("edgeperc.simulation.samples.labels_of_scene", lambda street: road)


@pytest.mark.usefixtures("fake_street", "matplotlib")
def test_demo(tmp_path: Path, shell: Shell) -> None:
    out = shell.out("demo", "--out", tmp_path / "demo")
    assert "100 m2 of the 40 x 20 m ahead" in out
    assert "20.2 m away:  20.0 m ahead,  3.0 m right" in out
    assert "heading   17 deg" in out
    assert re.search(r"background +[\d,]+   \(true: 1,000\)", out)  # as the network names what the street knows as road
    assert "ssadnet: CPUExecutionProvider (fp32)" in out
    for name in ("scene.png", "scene.html", "scan.bin"):
        assert str(tmp_path / "demo" / name) in out
        assert (tmp_path / "demo" / name).stat().st_size > 10_000
    assert len(read_points(tmp_path / "demo/scan.bin")) == 1000


@pytest.mark.usefixtures("fake_street")
def test_demo_without_matplotlib(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("matplotlib", "matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)
    out = shell.out("demo", "--out", tmp_path / "demo", "--model", "ssadnet")
    assert "pip install 'edgeperc[view]'" in out
    assert "drivable" in out
    assert sorted(file.name for file in (tmp_path / "demo").iterdir()) == ["scan.bin", "scene.html"]


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (
            ["training/velodyne/000000.bin", "testing/velodyne/000000.bin", "training/label_2/000000.txt"],
            ["training/000000", "testing/000000"],
        ),
        (["sequences/01/velodyne/000000.bin", "sequences/00/velodyne/000001.bin"], ["00/000001", "01/000000"]),
        (["sequences/08/velodyne/000000.bin"], ["08/000000"]),
        (["velodyne/0000/000000.bin", "velodyne/0001/000000.bin"], ["0000/000000", "0001/000000"]),
        (["velodyne_points/data/0000000000.bin", "velodyne_points/timestamps.txt"], ["root/0000000000"]),
        (["drive_1/velodyne_points/data/0.bin", "drive_2/velodyne_points/data/0.bin"], ["drive_1/0", "drive_2/0"]),
        (["0.bin", "velodyne/1.bin"], ["0"]),
    ],
)
def test_the_scans_of_a_data_set(files: list[str], names: list[str], tmp_path: Path) -> None:
    for file in files:
        write_scan(tmp_path / "root" / file)
    assert run("run", tmp_path / "root", "--labels", "--out", tmp_path / "out") == 0
    found = find_scans([tmp_path / "root"])
    assert [n.as_posix() for n in output_names(found.paths, keep_folder=found.of_data_set)] == names
    written = {file.relative_to(tmp_path / "out").as_posix() for file in (tmp_path / "out").rglob("*.label")}
    assert written == {f"{name}.label" for name in names}


def test_live_replays_the_one_folder_of_a_data_set(tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "sequences" / "00" / "velodyne" / "000000.bin")
    assert shell.records("run", tmp_path, "--live")[0]["scan"] == str(scan)
    write_scan(tmp_path / "sequences" / "01" / "velodyne" / "000000.bin")
    assert "--live replays one folder of scans" in shell.err("run", tmp_path, "--live")


def test_live_names_the_scans_of_a_capture(capture: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "read_scans", captures.read_scans)
    answers = shell.records("run", capture, "--live", code=1)
    named = [answer["scan"] for answer in answers if "error" not in answer]
    assert named
    assert {*named} <= {str(capture / f"{k:06d}") for k in range(3)}


COMMANDS = (
    *("demo", "run", "ros2", "info", "doctor", "models", "sensors", "providers", "eval", "eval-sensors"),
    *("eval-tracking", "eval-painting", "fit-sensor", "completion"),
)


def test_there_is_one_level_of_commands(shell: Shell) -> None:
    assert tuple(parsers(build_parser())) == COMMANDS
    out = shell.out("--help")
    assert all(f"    {name}" in out for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_every_help_page_fits_a_terminal_and_explains_every_option(
    name: str, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    page = shell.out(name, "--help")
    assert max(map(len, page.splitlines())) <= 80
    assert f"examples:\n  edgeperc {name}" in page
    for action in parsers(build_parser())[name]._actions:
        if action.help is argparse.SUPPRESS:
            continue
        assert action.help, f"{action.option_strings or action.dest} has no help text"
        if action.option_strings and action.nargs != 0 and not action.required:
            assert "(default: " in action.help or "; default: " in action.help, f"{action.dest} names no default"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_examples_of_a_help_page_can_be_parsed(name: str) -> None:
    parser = build_parser()
    epilog = parsers(build_parser())[name].epilog or ""
    examples = [line for line in epilog.splitlines() if line.startswith("  edgeperc ")]
    assert examples
    for line in examples:
        words = shlex.split(line.partition(" > ")[0].partition(" #")[0])
        assert callable(parser.parse_args(words[1:]).command)


@pytest.mark.parametrize(
    ("words", "new"),
    [
        (["evl", "root"], "(did you mean eval?)"),
        (["fit-sensors", "a"], "(did you mean fit-sensor?)"),
        (["run", "a.bin", "--full-trun"], "unrecognized arguments: --full-trun (did you mean --full-turn?)"),
        (["run", "a.bin", "--precis=int8"], "unrecognized arguments: --precis=int8 (did you mean --precision?)"),
        (["run", "a.bin", "--xyzw"], "unrecognized arguments: --xyzw\n"),
        (["run", "a.bin", "--adapt", "remision"], "(did you mean remission?)"),
    ],
)
def test_mistyped_words_name_the_nearest(words: list[str], new: str, shell: Shell) -> None:
    assert new in shell.err(*words)
    said = shell.err("info", "a.bin", "--sensor", "hdl64e")
    assert "no --sensor 'hdl64e' is built in (did you mean hdl-64e?)" in said


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("n_threads is 0; expected at least 1", "--threads is 0; expected at least 1"),
        ("provider 'x' is unknown; expected auto", "--provider 'x' is unknown; expected auto"),
        ("ask for provider 'openvino' and precision 'bf16'", "ask for --provider 'openvino' and --precision 'bf16'"),
        ('pass precision="fp32", or adapt=none', "pass --precision fp32, or --adapt none"),
        ("models ['a', 'b'] have views", "--model ['a', 'b'] have views"),
        (
            "the sensor gives no remission; the provider's choice",
            "the sensor gives no remission; the provider's choice",
        ),
        ("pass sensor= a profile whose remission_range is (0, 65535).", "pass --remission-range 0 65535."),
        ("sensor= a profile with the remission_range of this data, (0, 1) if", "--remission-range 0 1 if"),
        (
            "meters: the sensor is mounted higher, the sensor 'x' is",
            "meters: the sensor is mounted higher, the sensor 'x' is",
        ),
        ("Pass its name, sensor= or --sensor: hap", "Pass its name, --sensor: hap"),
        ("subtract it: origin_m= or --origin X Y Z.", "subtract it: --origin X Y Z."),
        ("pass columns= (--columns) with their names", "pass --columns with their names"),
        ("quaternion= or --quaternion, xyzw or wxyz", "--quaternion, xyzw or wxyz"),
        ("pass sensor= a profile whose range is (0, 255)", "pass --sensor a profile whose range is (0, 255)"),
        ('pass on_mismatch="warn" (on the command line --anyway).', "pass --anyway."),
        ("pass mounting= (on the command line --mount-height or --extrinsic).", "pass --mount-height or --extrinsic."),
        ("--provider 'x' is given; no sensor 'y' is built in", "--provider 'x' is given; no --sensor 'y' is built in"),
    ],
)
def test_messages_name_options(message: str, expected: str) -> None:
    assert in_options(message) == expected


def test_one_reason_is_written_out_once(capsys: pytest.CaptureFixture[str]) -> None:
    report = Report(argparse.Namespace(json=False), {})
    for k, error in enumerate(
        ("farther than 12.5 m: pass sensor= a profile", "farther than 9 m: pass sensor= a profile", "x")
    ):
        report.add(Outcome(Path(f"{k}.bin"), PointsError(error)))
    assert capsys.readouterr().err.splitlines() == [
        "edgeperc: 0.bin: farther than 12.5 m: pass --sensor a profile",
        "edgeperc: 1.bin: the same as 0.bin",
        "edgeperc: 2.bin: x",
    ]
    assert report.n_failed == 3


def test_python_m_edgeperc() -> None:
    done = subprocess.run([sys.executable, "-m", "edgeperc", "--version"], capture_output=True, text=True, check=False)
    assert done.stdout == f"edgeperc {__version__}\n"


def test_the_sensor_of_scan_files_is_found_once_a_folder(
    tmp_path: Path, fake: type[FakePerceiver], shell: Shell
) -> None:
    """Also of scans that do not tell it themselves; a folder whose scans do not tell fails alone."""
    for name in ("vlp-16", "os1-64"):
        (tmp_path / name).mkdir()
        urban(3, name).points.tofile(tmp_path / name / "0.bin")
        write_scan(tmp_path / name / "1.bin")
    unknown = write_scan(tmp_path / "unknown" / "0.bin", 5000)
    out, err = shell.both("run", tmp_path / "vlp-16", tmp_path / "os1-64", unknown, code=1)
    assert [made.sensor.name for made in fake.made] == ["vlp-16", "os1-64"]
    assert len(out.splitlines()) == 4
    assert f"{unknown}: the sensor cannot be told" in err


@pytest.mark.parametrize("option", [[], ["--sensor", "auto"]])
def test_files_with_few_points_are_the_defaults_unless_auto_asks(
    option: list[str], tmp_path: Path, fake: type[FakePerceiver], shell: Shell
) -> None:
    said = shell.err("run", write_scan(tmp_path / "0.bin"), *option, code=len(option) // 2)
    assert [made.sensor for made in fake.made] == ["hdl-64e"][: 1 - len(option) // 2]
    assert ("no scan has enough points" in said) == bool(option)


def test_auto_and_a_mounting_where_no_scan_is_read_first(shell: Shell) -> None:
    pytest.importorskip("zenoh")
    assert "edgeperc info SCAN --write" in shell.err("ros2", "--sensor", "auto", "--mount-height", 2)
