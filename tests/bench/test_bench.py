"""The benchmark: accuracy, reports, the command, and real runs of a few scans."""

from __future__ import annotations

import argparse
import html
import importlib.util
import io
import json
import re
import signal
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import scenes
from cli_helpers import Shell, parsers
from edgeperc import Perceiver
from edgeperc.errors import ModelError, ModelFileError, PointsError, ProviderError, SensorError
from edgeperc.simulation.samples import simulated_scan
from edgeperc.simulation.scene import TOP_VIEW_CLASSES
from edgeperc.system import machine
from edgeperc.types.perception import Box, PointLabels, TopView
from edgeperc_bench import accuracy, cli, context, inputs, measure, render, report, worker
from edgeperc_bench.commands.matrix import recommend, settings_to_try
from edgeperc_bench.commands.soak import memory_growth
from edgeperc_bench.document import ReportError, latency, read_report, setting_label, stage_medians, write_report
from edgeperc_bench.plots import pictures
from edgeperc_bench.render import LiveTable, html_page, markdown
from edgeperc_bench.scenarios import Timings

# accuracy


def prediction(labels: Sequence[int], cells: int, boxes: Sequence[Box]) -> worker.Prediction:
    points = PointLabels(np.array(labels, np.uint8), np.array([True, True, True, False]), ("background", "car"))
    labels_of_cells, observed = np.full((2, 2), cells, np.uint8), np.ones((2, 2), bool)
    top_view = TopView(labels_of_cells, ("background", "drivable"), 0.1, (6.0, 6.2), (-0.1, 0.1), observed)
    return worker.Prediction(points, top_view, tuple(boxes))


def car(x: float) -> Box:
    return scenes.box(x, score=0.9, size=(4.0, 2.0, 1.5), z=-1.0)


def test_agreement_counts_labels_and_boxes() -> None:
    right, guess = [prediction([0, 1, 1, 0], 1, [car(20)])], [prediction([0, 1, 0, 1], 1, [car(20), car(30)])]
    same = accuracy.agreement(right, guess)
    # The last point is out of view; background: 1 of 2, car: 1 of 2.
    assert same["points"] == pytest.approx({"equal": 2.0 / 3.0, "mean_iou": 0.5}, abs=1e-6)
    assert same["cells"]["equal"] == 1.0
    assert same["boxes"] == pytest.approx({"n_reference": 1, "n_found": 2, "n_both": 1, "f1": 2.0 / 3.0})
    equal = {"agreement": accuracy.agreement(right, right), "truth": None, "reference_truth": None}
    assert accuracy.agrees(equal)
    assert not accuracy.agrees(equal | {"agreement": same})
    worse = {"truth": {"points_mean_iou": 0.58}, "reference_truth": {"points_mean_iou": 0.6}}
    assert not accuracy.agrees(equal | worse)


def test_boxes_are_compared_where_they_are_all_that_a_model_answers() -> None:
    right, guess = ([worker.Prediction(None, None, tuple(map(car, places)))] for places in ((20, 30), (20,)))
    for found, agrees in ((right, True), (guess, False)):
        compared = {"agreement": accuracy.agreement(right, found), "truth": None, "reference_truth": None}
        assert compared["agreement"]["boxes"]["n_both"] == len(found[0].boxes)
        assert accuracy.agrees(compared) == agrees
        sentence, _ = report.accuracy_sentences(compared | {"reference": ["objects fp32"]})
        assert "common boxes" in sentence


def test_correctness_of_the_truth_itself_is_full() -> None:
    scan = simulated_scan(3)
    cells = scan.top_view_labels()
    geometry = TopView(cells, TOP_VIEW_CLASSES, 0.1, (6.0, 46.0), (-10.0, 10.0), np.ones(cells.shape, bool))
    boxes = [
        box
        for box, n in zip(scan.boxes, scan.box_points, strict=True)
        if n >= 3 and box.label in ("car", "van", "truck")
    ]
    inside = [box for box in boxes if 6.0 <= box.center[0] < 46.0 and abs(box.center[1]) < 10.0]
    assert inside
    for view, found, cells in ((geometry, inside, 1.0), (None, boxes, None)):
        figures = accuracy.correctness([worker.Prediction(None, view, tuple(found))], [scan])
        assert figures == {"points_mean_iou": None, "cells_mean_iou": cells, "vehicle_ap50": 1.0}


# reports


def samples_document(ms: Sequence[float], rate_hz: float | None = None) -> dict[str, Any]:
    timings = Timings(start_s=[0.1 * k for k in range(len(ms))], ms=[*ms], age_ms=[v + 1.0 for v in ms])
    timings.n = len(ms)
    timings.stage_ms = {"project": [1.0] * len(ms), "infer": [v - 2.0 for v in ms]}
    return {
        **{"rate_hz": rate_hz, "limits": {}, **vars(timings), "wall_s": 2.0, "cpu_s": 1.0, "rss_mb": [[0, 300.0]]},
        **{"energy_j": {"<rail>": 5.0}, "before": {}, "after": {}, "interrupted": False},
    }


def document(*medians: float, sha256: str = "s", spread: float = 0.2) -> dict[str, Any]:
    engine = {"name": "pointseg", "variant": "fp32", "version": "1", "sha256": "f" * 64, "digest": "d" * 64}
    engine |= {"precision": "fp32", "provider": "CPU", "options": {"threads": "1"}}  # type: ignore[dict-item]
    start = {"engines": [engine], "construct_s": 0.5, "first_call_ms": 30.0, "rss_mb": 300.0, "peak_rss_mb": 310.0}
    start |= {"scans_mb": 5.0, "warnings": ["<script>alert(1)</script> & more"], "interrupted": False}
    rng = np.random.default_rng(3)
    drawn = [median + rng.gamma(2.0, spread, 120) for median in medians]
    repeats = [
        start | {"scenarios": {"single-stream": samples_document(ms), "paced:10": samples_document(ms, 10.0)}}
        for ms in drawn
    ]
    setting = {"models": ["pointseg"], "provider": "cpu", "precision": "fp32", "n_threads": 1, "sensor": "hdl-64e"}
    setting |= {"offline": [], "cold_start": [], "accuracy": None, "loadgen": None, "repeats": repeats}
    given = {"source": "two <b>scans</b>", "sensor": "hdl-64e", "n_points": [5, 6], "sha256": sha256}
    machine, software = {"cpu": "A <fast> & quiet CPU", "fingerprint": "m"}, {"numpy": "2", "environment": {}}
    whole = {"schema": 2, "kind": "run", "command": "edgeperc-bench run", "complete": True, "input": given}
    whole |= {"machine": machine, "software": software, "disturbances": ["others | are busy"], "settings": [setting]}
    return whole | {"skipped": [], "recommended": [], "tables": [], "soak": None}


def plain(value: Any) -> Any:
    return json.loads(json.dumps(value, default=float))


def test_json_comes_back_as_it_went(tmp_path: Path) -> None:
    written = plain(document(20.0, 20.1))
    write_report(written, tmp_path / "a.json")
    assert read_report(tmp_path / "a.json") == written
    for k, text in enumerate(("nonsense", "[]", "[" * 99999, '{"schema": 1, "kind": "run"}', '{"a": NaN}')):
        (tmp_path / f"{k}.json").write_text(text)
        with pytest.raises(ReportError, match=rf"{k}\.json"):
            read_report(tmp_path / f"{k}.json")


def test_figures_of_a_scenario_are_of_all_repeats() -> None:
    setting = document(20.0, 22.0)["settings"][0]
    figures = latency(setting, "single-stream")
    assert figures["n"] == 240
    assert figures["p99"] is None
    assert figures["noise"] == pytest.approx(0.1, abs=0.02)
    assert figures["cpu_s_per_scan"] == pytest.approx(2.0 / 240)
    assert figures["energy_j_per_scan"] == pytest.approx({"<rail>": 10.0 / 240})
    assert figures["age"]["p50"] == pytest.approx(figures["p50"] + 1.0)
    stages = stage_medians(setting, "single-stream")
    assert stages["project"] == stages["outside"] == pytest.approx(1.0)


def test_a_page_is_well_formed_and_needs_nothing_from_elsewhere(matplotlib: None) -> None:
    shown = document(20.0, 20.1)
    page = html_page(report.sections(shown), "<title>", pictures(shown))
    root = ET.fromstring(page.partition("\n")[2])
    assert len([element for element in root.iter() if element.tag.endswith("svg")]) == 1
    assert "A <fast> & quiet CPU" in "".join(root.itertext())
    assert not [
        element for element in root.iter() if element.tag.rpartition("}")[2] in {"script", "link", "img", "iframe"}
    ]
    for element in root.iter():
        for name, value in element.attrib.items():
            local = name.rpartition("}")[2]
            assert local not in {"src", "srcset", "action"}
            assert local != "href" or value.startswith("#"), value
            assert "url(" not in value or "url(#" in value
    # The names of namespaces are never loaded.
    addresses = set(re.findall(r"(?:https?:)?//[^\"'\s<)]+", html.unescape(page)))
    assert addresses <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    assert "@import" not in page


def test_text_and_tables_hold_what_was_measured() -> None:
    whole = document(20.0, 20.1)
    whole["settings"][0]["loadgen"] = {"p50": 2.0, "p99": 9.0, "result": "VALID", "samples": {"n": 100}}
    shown = render.text(parts := report.sections(whole))
    assert "result VALID: p50 2.00 ms\n" in shown  # too few samples for more
    assert "disturbed: others | are busy\n  warning: <script>" in shown
    assert "single-stream" in shown
    assert "paced:10" in shown
    written = markdown(parts, "a | b")
    assert written.startswith("# a \\| b\n")
    for block in re.findall(r"(?:^\|.*\n)+", written, flags=re.M):
        counts = {len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}
        assert len(counts) == 1
    assert shown.splitlines()[-2] == "Verdict"
    assert "keeps 10 Hz with 7" in shown.splitlines()[-1]  # the slowest of 240 takes 21 to 25 ms
    interrupted = render.text(report.sections(document(20.0) | {"complete": False}))
    assert "interrupted" in interrupted


@pytest.mark.parametrize(
    ("ms", "rate_hz", "missed", "skipped", "sentence"),
    [
        ([20.0] * 50, 10.0, 0, 0, "keeps 10 Hz with 79 % to spare"),
        ([20.0] * 2000, 20.0, 0, 0, "keeps 20 Hz with 58 % to spare"),
        ([20.0] * 1995 + [40.0] * 5, 20.0, 0, 0, "keeps 20 Hz with 58 % to spare"),
        ([120.0] * 50, 10.0, 50, 9, "does not keep 10 Hz: 59 of 59 scans were answered late or skipped"),
        ([20.0] * 49 + [400.0], 10.0, 1, 3, "does not keep 10 Hz: 4 of 53 scans were answered late or skipped"),
        ([38.0] * 50, None, 0, 0, "keeps 10 Hz with 61 % to spare (judged by scans back to back)"),
        ([149.0] * 50, None, 0, 0, "does not keep 10 Hz: a scan takes 150 ms of 100 (judged by scans back to back)"),
    ],
)
def test_the_verdict_is_one_sentence(
    ms: list[float], rate_hz: float | None, missed: int, skipped: int, sentence: str
) -> None:
    setting = document(20.0)["settings"][0]
    scenario = samples_document(ms, rate_hz) | {"missed": missed, "skipped": skipped}
    setting["repeats"][0]["scenarios"] = {"only": scenario}
    assert report.verdict(setting).endswith(f" threads: {sentence}")
    setting["repeats"] = []
    assert report.verdict(setting) == ""


def test_a_live_table_replaces_itself_on_a_terminal_only(monkeypatch: pytest.MonkeyPatch) -> None:
    live, file = LiveTable(scenes.Terminal()), LiveTable(io.StringIO())
    for table in (live, file):
        table("single-stream", [3.0] * 30)
        table.note("next")
    shown = live.stream.getvalue()
    assert re.search(r"single-stream +30 +3\.00 +- ", shown)
    assert "\x1b[2A\x1b[J" in shown  # the head and one row are taken away before the next line
    assert file.stream.getvalue() == "edgeperc-bench: next\n"
    assert file.ms == {"single-stream": [3.0] * 30}
    full = Mock(isatty=lambda: False, write=Mock(side_effect=OSError("no space left")))
    monkeypatch.setattr("sys.stderr", full)
    LiveTable().note("next")  # where nobody can be told, the measurement goes on


# the command


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(capsys, cli.main)


@pytest.fixture
def reports(tmp_path: Path) -> Any:
    def written(name: str, *medians: float, of: Any = None, **changes: Any) -> str:
        write_report(plain(document(*medians, **changes) if of is None else of), tmp_path / name)
        return str(tmp_path / name)

    return written


def test_compare_answers_by_its_exit_code(reports: Any, shell: Shell) -> None:
    a = reports("a.json", 20.0, 20.1)
    assert "no difference" in shell.out("compare", a, reports("same.json", 20.05, 19.95))
    assert "faster" in shell.out("compare", a, reports("fast.json", 17.0, 17.1))
    assert "slower" in shell.out("compare", a, reports("slow.json", 23.0, 23.1), code=1)
    assert "--repeats" in shell.out("compare", a, reports("once.json", 23.0), code=2)
    assert "different scans" in shell.err("compare", a, reports("other.json", 20.0, 20.1, sha256="t"))
    other = document(20.0, 20.1) | {"complete": False}
    other["input"]["sensor"] = "os1-64"
    said = shell.out("compare", a, reports("b.json", of=other))
    assert "different sensors: A as of hdl-64e, B as of os1-64" in said
    assert "B was interrupted" in said
    assert "nowhere.json" in shell.err("compare", a, "nowhere.json")
    assert "edited.json is not as" in shell.err("compare", a, reports("edited.json", of=other | {"machine": None}))


def test_compare_wants_the_same_setting_or_one_of_each(reports: Any, shell: Shell) -> None:
    one = document(20.0, 20.1)
    # With several settings in a report only equal ones are compared.
    several = reports("several.json", of=one | {"settings": [*one["settings"], *one["settings"]]})
    for key, value, code in (("precision", "int8", 0), ("provider", "openvino", 0), ("models", ["ssadnet"], 2)):
        changed = reports("b.json", of=one | {"settings": [one["settings"][0] | {key: value}]})
        shell.both("compare", reports("a.json", of=one), changed, code=code)
        shell.both("compare", several, changed, code=2)


WRONG = (
    *("--scenario paced:0", "--scenario offline:x", "--min-scans 0", "--threads none", "matrix --providers abacus"),
    *("--precisions fp7", "--provider abacus", "--precision bf17", "scaling --cars 29", "soak --scans 3"),
    "compare only-one.json",
)


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        *((typed, "error: ") for typed in WRONG),
        ("--provider openvino:bf16", "ask for --provider 'openvino' and --precision 'bf16'"),
        ("compair a.json b.json", "(did you mean compare?)"),
        ("run --min-scan 2", "--min-scan 2 (did you mean --min-scans?)"),
        ("--provider openvno", "'openvno' is unknown (did you mean openvino?)"),
        ("--precisions int", "got 'int' (did you mean int8?)"),
    ],
)
def test_wrong_options_are_refused_and_name_the_nearest(typed: str, said: str, shell: Shell) -> None:
    message = shell.err(*typed.split())
    assert message.startswith("edgeperc-bench")
    assert said in message


def test_every_option_has_a_help_text() -> None:
    commands = parsers(cli.build_parser())
    assert commands.keys() == cli.COMMANDS.keys()
    for parser in commands.values():
        assert parser.description
        for action in parser._actions:
            assert action.help, f"{parser.prog} {action.dest}"
            takes_value = action.option_strings and action.nargs != 0
            assert "default" in action.help or not takes_value or action.default in (None, argparse.SUPPRESS)
        assert "%(" not in parser.format_help()


@pytest.mark.parametrize(
    ("options", "command"),
    [([], "run"), (["--threads", "2"], "run"), (["--precision", "int8"], "run"), (["--precisions", "int8"], "matrix")],
)
def test_without_a_command_it_runs_or_measures_a_matrix(
    options: list[str], command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    for name in ("run", "matrix"):
        module = cli.COMMANDS[name]
        monkeypatch.setattr(module, "run_command", lambda arguments, name=name: asked.append(name) or 0)
    assert cli.main(options) == 0
    assert asked == [command]


def test_without_psutil_only_measuring_fails(tmp_path: Path, reports: Any) -> None:
    """In a process of its own, where psutil cannot be imported."""
    block = """
import json, sys
sys.modules["psutil"] = None
from edgeperc_bench.cli import main
codes = []
for options in json.loads(sys.argv[1]):
    try:
        codes.append(main(options))
    except SystemExit as end:
        codes.append(end.code or 0)
    print("end of", options[0], file=sys.stderr)
print("codes", codes, file=sys.stderr)
"""
    report = str(reports("a.json", 20.0, 20.1))
    asked = json.dumps([["--version"], ["--help"], ["compare", report, report], ["soak"]])
    done = subprocess.run([sys.executable, "-c", block, asked], capture_output=True, text=True)
    assert "codes [0, 0, 0, 2]" in done.stderr
    before, soak = done.stderr.split("end of compare")
    assert "pip install 'edgeperc[bench]'" not in before
    assert "pip install 'edgeperc[bench]'" in soak


def test_the_matrix_skips_nothing_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    # A processor of which nothing is known is asked for everything.
    monkeypatch.setattr("edgeperc_bench.commands.matrix.cpu_features", frozenset)
    settings, skipped = settings_to_try("pointseg", ["cuda", "openvino", "cpu"], ["fp32", "bf16"], ("openvino", "cpu"))
    assert settings == [("openvino", "fp32"), ("openvino", "bf16"), ("cpu", "fp32")]
    assert len(skipped) == 2
    assert "pointseg on cuda: not available" in skipped[0]
    assert "pointseg on cpu in bf16: " in skipped[1]
    assert settings_to_try("pointseg:int8", ["cpu"], ["fp32", "int8"], ("cpu",))[0] == [("cpu", "int8")]
    settings, (skipped,) = settings_to_try("objects", ["openvino", "cpu"], ["fp32"], ("openvino", "cpu"))
    assert settings == [("cpu", "fp32")]
    assert "objects on openvino: it compiles the network anew" in skipped
    with pytest.raises(ModelFileError):
        settings_to_try("nobody", ["cpu"], ["fp32"], ("cpu",))


def test_the_matrix_recommends_the_fastest_that_agrees() -> None:
    settings = []
    for provider, precision, median, agrees in (
        ("cpu", "fp32", 30.0, True),
        ("openvino", "fp32", 20.0, True),
        ("openvino", "bf16", 9.0, False),
    ):
        (setting,) = document(median, median + 0.1)["settings"]
        settings.append(setting | {"provider": provider, "precision": precision, "accuracy": {"agrees": agrees}})
    measured = {"settings": settings, "machine": {"cpu": "c"}, "software": {"onnxruntime": "1", "measured": "t"}}
    (best,) = recommend(measured)
    assert (best["entry"]["provider"], best["entry"]["precision"]) == ("openvino", "fp32")
    assert best["digest"] == "d" * 64
    assert "Perceiver('pointseg', provider='openvino', precision='fp32', n_threads=1)" in best["text"]
    assert "is slower" in best["text"]
    once = [setting | {"repeats": setting["repeats"][:1]} for setting in settings]
    assert recommend(measured | {"settings": once})[0]["text"].endswith(
        "was measured once, so that the noise is unknown"
    )
    for setting in settings:
        setting["accuracy"] = {"agrees": False}
    assert recommend(measured) == []


def test_scans_are_sized_and_crowded_in_the_sensors_own_unit(tmp_path: Path) -> None:
    assert inputs.sized(1000, "hdl-64e").shape == (1000, 4)
    assert inputs.sized(150_000, "hdl-64e").shape == (150_000, 4)
    assert len(inputs.crowd(4, "hdl-64e")) > 50_000
    scans, profile = inputs.simulated_input(tmp_path, 1, "os1-64"), inputs.get_sensor("os1-64")
    remission = np.load(scans.files[0])[:, 3] + np.float32(profile.remission_offset)
    back = remission * np.float32(profile.remission_scale)
    np.testing.assert_allclose(back, scans.truth[0].points[:, 3], atol=1e-4)
    (nothing := tmp_path / "nothing").mkdir()
    with pytest.raises(PointsError, match="holds no scan"):
        inputs.read_input(tmp_path, [nothing], "hdl-64e")
    with pytest.raises(OSError, match=r"scan\.npy cannot be written .*set TMPDIR"):
        inputs.store(tmp_path / "nowhere", "scan", np.ones((1, 4), np.float32))


def test_the_sensor_of_ones_own_scans_is_found_in_their_points(tmp_path: Path) -> None:
    """As HDL-64E's, which they were all taken for, their remission and beams would be others."""
    for folder in (folders := [tmp_path / "vlp-16", tmp_path / "os1-64"]):
        folder.mkdir()
        inputs.simulated_input(folder, 1, folder.name)
    scans, sensor = inputs.read_input(tmp_path, folders[:1], "auto")
    assert (scans.record["sensor"], inputs.get_sensor(sensor).n_beams) == ("vlp-16", 16)
    with pytest.raises(SensorError, match=r"several sensors: .*vlp-16 of vlp-16, .*os1-64 of os1-64; measure those"):
        inputs.read_input(tmp_path, folders, "auto")
    assert cli.build_parser().parse_args(["run"]).sensor == "auto"


class Street:
    """In place of a Perceiver: every result is the same, but for the first scans."""

    n_scans = 0

    def reset_mounting(self) -> None:
        self.n_scans = 0

    def __call__(self, scan: np.ndarray) -> Any:
        self.n_scans += 1
        labels = np.full(len(scan), self.n_scans > 5, np.uint8)
        points = PointLabels(labels, np.ones(len(scan), bool), ("background", "car"))
        return SimpleNamespace(points=points, top_view=None, boxes=(), stage_ms={"project": 0.0, "infer": 0.0})


@pytest.fixture
def in_process(no_wait: None, monkeypatch: pytest.MonkeyPatch) -> list[worker.Job]:
    """Measuring without processes and networks; the jobs that were asked for."""
    jobs: list[worker.Job] = []
    connection = SimpleNamespace(send=lambda message: None, recv=lambda: "go", poll=lambda: False)

    def measured(asked: Sequence[worker.Job], on_tick: Any = None) -> list[dict[str, Any]]:
        jobs.extend(asked)
        if any((job.provider, job.precision) == ("openvino", "bf16") for job in asked):
            raise ProviderError("cannot run this model")
        return [worker.work(connection, job) for job in asked]

    def engines(perceive: Street) -> list[dict[str, Any]]:
        engine = {"name": "n", "variant": "fp32", "version": "1", "sha256": "b" * 64, "digest": "a" * 64}
        engine |= {"precision": "fp32", "provider": "P", "description": "n fp32, P"}
        return [engine | {"options": {"threads": "1"}}]

    monkeypatch.setattr(worker, "make_perceiver", lambda job: Street())
    monkeypatch.setattr(worker, "active_engines", engines)
    monkeypatch.setattr(measure, "measure", measured)
    return jobs


def test_a_matrix_measures_every_setting_and_keeps_the_best(
    in_process: list[worker.Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("edgeperc_bench.commands.matrix.available_providers", lambda: ("openvino", "cpu"))
    monkeypatch.setattr("edgeperc_bench.commands.matrix.cpu_features", frozenset)
    np.save(tmp_path / "own.npy", np.ones((50, 4), np.float32))
    options = ["--model", "pointseg", "--providers", "all", "--precisions", "fp32,bf16", "--threads", "1,2"]
    options += ["--min-scans", "20", "--min-seconds", "0", "--input", str(tmp_path / "own.npy")]
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "cache"))
    assert cli.main([*options, "--recommend", "--json", str(tmp_path / "m.json")]) == 0
    measured = read_report(tmp_path / "m.json")
    assert [(s["provider"], s["precision"], s["n_threads"]) for s in measured["settings"]] == [
        ("openvino", "fp32", 1),
        ("openvino", "fp32", 2),
        ("cpu", "fp32", 1),
        ("cpu", "fp32", 2),
    ]
    assert in_process[0] == worker.Job(("pointseg:fp32",), "cpu", predict=in_process[0].predict)  # the reference
    assert measured["settings"][0]["accuracy"]["reference"] == ["n fp32, P"]
    skipped = "\n".join(measured["skipped"])
    for part in ("cuda: not available", "cpu in bf16", "openvino in bf16, 1 threads: cannot run this model"):
        assert part in skipped
    saved = machine.read_setting(machine.settings_path(), measured["machine"]["fingerprint"], "a" * 64)
    assert saved["provider"] in ("openvino", "cpu")
    assert saved["precision"] == "fp32"
    assert "recommended for n" in capsys.readouterr().out
    in_process.clear()
    (tmp_path / "bad.json").write_text("{")
    assert cli.main([*options, "--recommend", str(tmp_path / "bad.json")]) == 2
    assert in_process == []  # nothing was measured for nothing


def test_scaling_measures_points_cars_sizes_and_processes(
    in_process: list[worker.Job],
    tmp_path: Path,
    matplotlib: None,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = []
    if HAS_EXPORT:  # networks of other sizes have tests beside the other peers
        monkeypatch.setattr(
            "edgeperc_bench.peers.networks.resized", lambda *asked: made.append(asked) or tmp_path / "n"
        )
    options = ["scaling", "--points", "1000,2000,4000", "--cars", "0,2", "--sizes", "100", "--processes", "2,1"]
    options += ["--min-scans", "20", "--precision", "int8"]
    plot = tmp_path / "new" / "growth.svg"
    assert cli.main([*options, "--min-seconds", "0", "--plot", str(plot), "--json", str(tmp_path / "s.json")]) == 0
    tables = read_report(tmp_path / "s.json")["tables"]
    assert [[row[0] for row in table["rows"]] for table in tables] == [
        ["1,000", "2,000", "4,000"],
        ["0", "2"],
        ["100"] if HAS_EXPORT else [],
        ["2", "1"],
    ]
    assert tables[3]["rows"][1][2] == "1.00"  # times one process, whatever the first count is
    assert HAS_EXPORT or "edgeperc[export]" in tables[2]["sentences"][0]
    assert [share for _, share, _ in made] == [1.0] * len(made)
    assert bool(made) == HAS_EXPORT
    assert {job.precision for job in in_process if job.models[0] == str(tmp_path / "n")} <= {"fp32"}
    assert "ms per 1,000 points" in capsys.readouterr().out
    ET.fromstring(plot.read_text())
    monkeypatch.setattr("edgeperc_bench.peers.networks.resized", Mock(side_effect=ModelError("made elsewhere")))
    assert cli.main([*options, "--min-seconds", "0"]) == 0
    assert "Growth with processes" in capsys.readouterr().out.partition("not measured: ")[2]


def test_a_soak_reports_memory(in_process: list[worker.Job], tmp_path: Path, shell: Shell) -> None:
    assert "Memory over a long run" in shell.out("soak", "--scans", "1000", "--json", tmp_path / "s.json")
    measured = read_report(tmp_path / "s.json")
    timings = measured["settings"][0]["repeats"][0]["scenarios"]["soak"]
    assert (timings["n"], len(timings["warm_up_ms"]), len(timings["ms"])) == (900, 100, 450)
    assert measured["soak"] == memory_growth(timings["rss_mb"], 100)


def test_a_report_is_written_though_nobody_reads_it(
    in_process: list[worker.Job], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edgeperc.cli.output.print_line", Mock(side_effect=OSError("nobody reads")))
    with pytest.raises(OSError, match="nobody reads"):
        cli.main(["soak", "--scans", "1000", "--json", str(tmp_path / "s.json")])
    assert read_report(tmp_path / "s.json")["soak"]


def test_an_application_uses_every_answer(matplotlib: None) -> None:
    from edgeperc_bench.application import Application

    perceive = Perceiver("lodnn", provider="cpu", n_threads=1, on_mismatch="ignore")
    application = Application(perceive, draw_every=2)
    scans = [np.full((n, 4), 5.0, np.float32) for n in (3, 4, 5)]
    before = threading.active_count()
    assert [application(scan).n_points for scan in scans] == [3, 4, 5]
    application.close()
    assert threading.active_count() <= before


HAS_EXPORT = all(importlib.util.find_spec(name) for name in ("torch", "onnx"))


FEW = ["--model", "pointseg", "--provider", "cpu", "--precision", "fp32", "--threads", "1", "--repeats", "1"]
FEW += ["--warm-up", "1", "--min-seconds", "0", "--sensor", "hdl-64e"]


@pytest.fixture
def no_wait(psutil: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(context, "busiest", lambda: [])


def test_a_full_turn_is_a_setting_of_its_own(in_process: list[worker.Job], tmp_path: Path) -> None:
    simulated_scan(5).points[::10].tofile(tmp_path / "own.bin")
    command = ["run", *FEW, "--scenario", "single-stream", "--min-scans", "2", "--full-turn"]
    assert cli.main([*command, "--input", str(tmp_path / "own.bin"), "--json", str(tmp_path / "a.json")]) == 0
    (around,) = read_report(tmp_path / "a.json")["settings"]
    assert setting_label(around) == f"{setting_label(around | {'full_turn': False})}, full turn"
    assert [job.full_turn for job in in_process] == [True] * len(in_process) != []
    assert worker.settings_of(in_process[0])["full_turn"]


def test_a_run_from_scans_to_files(no_wait: None, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulated_scan(5).points.tofile(tmp_path / "own.bin")
    files = ["--json", str(tmp_path / "a.json"), "--markdown", str(tmp_path / "a.md")]
    wanted = ["--scenario", "single-stream", "--scenario", "paced:20", "--min-scans", "3"]
    assert cli.main(["run", *FEW, *wanted, *files, "--input", str(tmp_path / "own.bin")]) == 0
    measured = read_report(tmp_path / "a.json")
    assert measured["complete"]
    (setting,) = measured["settings"]
    assert "full turn" not in setting_label(setting)
    (only,) = setting["repeats"]
    assert [len(each["ms"]) for each in only["scenarios"].values()] == [3, 3]
    (engine,) = only["engines"]
    ran = [engine[key] for key in ("name", "variant", "precision", "provider")]
    assert ran == ["pointseg", "fp32", "fp32", "CPUExecutionProvider"]
    assert len(engine["sha256"]) == 64
    assert setting["accuracy"]["reference"] == ["pointseg fp32, CPUExecutionProvider"]
    assert setting["accuracy"]["agreement"]["points"]["equal"] == 1.0
    assert setting["accuracy"]["truth"] is None
    assert measured["input"]["source"] == "1 scan: own.bin"
    assert "pointseg:fp32" in capsys.readouterr().out
    assert "## Latency" in (tmp_path / "a.md").read_text()


def test_an_interrupted_run_writes_what_it_has(
    no_wait: None, foreground: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "own.npy", simulated_scan(5).points[::10])

    calls = []

    def interrupt(live: LiveTable, name: str, ms: Sequence[float]) -> None:
        calls.append(name)
        if len(calls) == 1:  # a second Ctrl-C would end it at once
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(LiveTable, "__call__", interrupt)
    files = ["--input", str(tmp_path / "own.npy"), "--json", str(tmp_path / "a.json")]
    # Without the interruption this would not end.
    assert cli.main(["run", *FEW, *files, "--scenario", "single-stream", "--min-scans", "1000000000"]) == 130
    measured = read_report(tmp_path / "a.json")
    assert not measured["complete"]
    assert measured["settings"][0]["repeats"][0]["interrupted"]
    assert "interrupted: only what was measured" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_errors_of_a_process_arrive_as_they_were() -> None:
    with pytest.raises(ModelFileError, match="no model is called 'nobody'"):
        worker.measure([worker.Job(("nobody",), "cpu")])
    dead, silent = SimpleNamespace(exitcode=-9, join=lambda: None), SimpleNamespace(recv=Mock(side_effect=EOFError))
    with pytest.raises(worker.WorkerError, match="exit code -9"):
        worker.receive(silent, dead)


def test_a_cold_start_is_measured_step_by_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = {"interpreter_s": 0.1, "total_s": 1.0}
    caches = []
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    machine.settings_path().write_text("{}")

    def start(command: list[str], env: dict[str, str], **_: Any) -> Any:
        request = json.loads(command[-1])
        assert request["models"] == ["pointseg"]
        assert request["precision"] == "int8"
        caches.append(env["NUMBA_CACHE_DIR"])
        assert env["EDGEPERC_CACHE_DIR"] == caches[0] != str(tmp_path)
        assert (Path(caches[0]) / "settings.json").read_text() == "{}"
        return SimpleNamespace(returncode=0, stdout=json.dumps(steps), stderr="")

    monkeypatch.setattr(measure.subprocess, "run", start)
    starts = measure.cold_starts(worker.Job(("pointseg",), precision="int8"), tmp_path / "scan.npy", 3)
    assert [each["start"] for each in starts] == ["first", "again (1)", "again (2)"]
    assert len(set(caches)) == 1
    monkeypatch.setattr(
        measure.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=1, stderr="no such model")
    )
    with pytest.raises(worker.WorkerError, match="no such model"):
        measure.cold_starts(worker.Job(("pointseg",)), tmp_path / "scan.npy", 1)
