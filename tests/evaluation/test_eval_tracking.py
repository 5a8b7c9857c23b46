"""Evaluation of tracking on KITTI's sequences, and animated tracks."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from checkout import printed
from cli_helpers import Shell
from edgeperc import PointsError, TrackingError, cli
from edgeperc.datasets.kitti import scan_hash
from edgeperc.evaluation import tracking
from edgeperc.types.sensor import get_sensor
from edgeperc_bench.peers.tracking import every_second_beam

CALIBRATION = """P2: 700.0 0.0 600.0 0.0 0.0 700.0 180.0 0.0 0.0 0.0 1.0 0.0
R0_rect: 1.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 1.0
Tr_velo_to_cam: 0.0 -1.0 0.0 0.0 0.0 0.0 -1.0 0.0 1.0 0.0 0.0 0.0
"""


@pytest.fixture
def kitti(tmp_path: Path) -> Path:
    """A sequence of a car that drives ahead, a van beside it, and a pedestrian whom nobody labeled."""
    for folder in ("calib", "label_02", *(f"detections/pointrcnn_{of}" for of in ("Car", "Pedestrian", "Cyclist"))):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "calib/0000.txt").write_text(CALIBRATION)
    labels, cars, pedestrians = [], [], []
    for k in range(20):
        z = 15.0 + 0.5 * k
        labels += [
            f"{k} 1 Car 0 0 0.0 100 100 300 200 1.5 1.8 4.2 0.0 1.7 {z} -1.57",
            f"{k} 2 Van 0 0 0.0 100 100 300 200 2.0 1.9 5.0 6.0 1.7 {z} -1.57",
            f"{k} -1 DontCare -1 -1 -10 0 100 200 300 -1000 -1000 -1000 -1000 -1000 -1000 -1000",
        ]
        cars.append(f"{k},2,100,100,300,200,5.0,1.5,1.8,4.2,0.0,1.7,{z},-1.57,0.0")
        cars.append(f"{k},2,100,100,300,200,4.0,2.0,1.9,5.0,6.0,1.7,{z},-1.57,0.0")
        pedestrians.append(f"{k},1,100,100,300,200,3.0,1.7,0.6,0.8,-10.0,1.7,14.0,0.0,0.0")
    (tmp_path / "label_02/0000.txt").write_text("\n".join(labels) + "\n")
    (tmp_path / "detections/pointrcnn_Car/0000.txt").write_text("\n".join(cars))
    (tmp_path / "detections/pointrcnn_Pedestrian/0000.txt").write_text("\n".join(pedestrians))
    (tmp_path / "detections/pointrcnn_Cyclist/0000.txt").write_text("")
    return tmp_path


def test_kitti_sequences_are_read_into_the_sensors_frame(kitti: Path) -> None:
    sequence = tracking.read_sequence(kitti, "0000")
    assert len(sequence.detections) == 20
    first = sequence.detections[0][0]
    assert first.center == pytest.approx((15.0, 0.0, -0.95))
    assert first.size == (4.2, 1.8, 1.5)
    assert first.yaw == pytest.approx(0.0, abs=1e-3)
    assert first.score == pytest.approx(1.0 / (1.0 + math.exp(-5.0)))
    truth = sequence.truth["car"][0]
    assert truth.ignored.tolist() == [False, True]
    np.testing.assert_allclose(truth.boxes[0, :3], first.center)
    assert len(sequence.truth["pedestrian"][0].ids) == 0


def test_kitti_is_evaluated_by_its_rules(kitti: Path) -> None:
    seen = []
    figures = tracking.evaluate_kitti(kitti, on_sequence=lambda done, total: seen.append((done, total)))
    car, pedestrian = figures["classes"]["car"], figures["classes"]["pedestrian"]
    assert (car["best"]["n_truth"], car["best"]["n_false"], car["best"]["n_switches"]) == (20, 0, 0)
    assert car["best"]["mota"] == 1.0
    assert car["hota"]["assa"] > 0.88  # of two vehicles that move alike and one pedestrian, who stands is unknown
    assert pedestrian["best"]["n_false"] == 0  # it stands where nothing was labeled
    assert (seen, figures["sequences"]) == ([(1, 1)], ["0000"])


def test_what_is_named_twice_counts_once(kitti: Path) -> None:
    once, twice = (tracking.evaluate_kitti(kitti, sequences=n * ["0000"], classes=n * ["car"]) for n in (1, 2))
    assert once | {"frames_per_s": 0} == twice | {"frames_per_s": 0}
    with pytest.raises(TrackingError, match="iou_threshold of 25"):
        tracking.evaluate_kitti(kitti, iou_threshold=25.0)
    labels = kitti / "label_02/0000.txt"
    labels.write_text(2 * labels.read_text())
    with pytest.raises(TrackingError, match=r"0000\.txt has track 1 twice in frame 0"):
        tracking.evaluate_kitti(kitti)


def test_the_rules_decide_which_box_is_small_and_who_sits(kitti: Path) -> None:
    """A false car whose detection is 20 pixels high in the image, although its box is higher; a person who sits."""
    detections = kitti / "detections/pointrcnn_Car/0000.txt"
    small = [f"{k},2,500,100,550,120,4.0,1.5,1.8,4.2,-9.0,1.7,30.0,-1.57,0.0" for k in range(20)]
    detections.write_text(detections.read_text() + "\n" + "\n".join(small))
    sitting = [f"{k} 3 Person 0 0 0.0 100 100 300 200 1.2 0.6 0.8 10.0 1.7 14.0 0.0" for k in range(20)]
    labels = kitti / "label_02/0000.txt"
    labels.write_text(labels.read_text() + "\n".join(sitting) + "\n")
    person = [f"{k},1,900,100,950,200,3.0,1.2,0.6,0.8,10.0,1.7,14.0,0.0,0.0" for k in range(20)]
    pedestrians = kitti / "detections/pointrcnn_Pedestrian/0000.txt"
    pedestrians.write_text(pedestrians.read_text() + "\n" + "\n".join(person))
    n_false = {}
    for rules in tracking.RULES:
        figures = tracking.evaluate_kitti(kitti, rules=rules, rival=True)
        assert figures["rules"] == rules
        n_false[rules] = [
            figures[method][of]["all_tracks"]["n_false"]
            for method in ("classes", "rival")
            for of in ("car", "pedestrian")
        ]
    # Cars and pedestrians of each method. The pedestrian in DontCare has half of its detection's rectangle in it, and
    # more of its box.
    assert n_false["edgeperc"] == [20, 0, 20, 0]
    assert n_false["ab3dmot"] == [0, 40, 0, 40]
    with pytest.raises(TrackingError, match="rules 'kitti'"):
        tracking.evaluate_kitti(kitti, rules="kitti")


TILTED = """P2: 700.0 0.0 600.0 0.0 0.0 700.0 180.0 0.0 0.0 0.0 1.0 0.0
R0_rect: 1.0 0.0 0.0 0.0 0.9998 -0.02 0.0 0.02 0.9998
Tr_velo_to_cam: 0.0 -1.0 0.0 0.0 0.0 0.0 -1.0 -0.08 1.0 0.0 0.0 -0.27
"""
SIZES = {"Car": (1.5, 1.8, 4.2), "Pedestrian": (1.7, 0.6, 0.8), "Cyclist": (1.7, 0.6, 1.8)}


def made_up_street(root: Path) -> None:
    """Objects of three classes, jittering, missed and false detections, and a camera that looks 1.1 degrees down."""
    labels: list[str] = []
    found: dict[str, list[str]] = {of: [] for of in SIZES}
    for k in range(60):
        for number in range(12):
            of = ("Car", "Pedestrian", "Cyclist")[number % 3]
            noise = [math.sin(12.9898 * (97 * number + 31 * k + 7 * part)) for part in range(6)]
            x, z = 4.0 * (number % 4) - 6.0, 10.0 + 4.0 * (number // 4) + 0.12 * k * (number % 2)
            high = 24.0 if number in (3, 6) else 60.0
            shown = f"{300 + 50 * number} 100 {340 + 50 * number} {100 + high}"
            size = " ".join(map(str, SIZES[of]))
            if number < 9:
                hidden = f"{int(k % 17 == 16)} {3 if 20 < k < 24 else 0}"
                labels.append(f"{k} {number} {of} {hidden} 0.0 {shown} {size} {x} 1.7 {z:.6f} -1.4")
            if number == 0 and k % 2:
                labels.append(f"{k} -1 DontCare -1 -1 -10 700 90 980 180 -1000 -1000 -1000 -1000 -1000 -1000 -1000")
            if (number >= 9 and k % 7 > number - 7) or (k + 5 * number) % 23 in (0, 1, 2, 3, 4, 5)[: number % 7]:
                continue
            spread = 0.35 if of == "Car" else 0.12
            place = f"{x + spread * noise[0]:.4f},{1.7 + 0.2 * noise[1]:.4f},{z + spread * noise[2]:.4f}"
            score = 4.0 - 0.7 * number % 5.0 + noise[3]
            numbers = f"{shown} {score:.4f} {size}".replace(" ", ",")
            found[of].append(f"{k},1,{numbers},{place},{-1.4 + 0.1 * noise[4]:.4f},0")
    for folder in ("calib", "label_02", *(f"detections/pointrcnn_{of}" for of in SIZES)):
        (root / folder).mkdir(parents=True)
    (root / "calib/0000.txt").write_text(TILTED)
    (root / "label_02/0000.txt").write_text("\n".join(labels) + "\n")
    for of, lines in found.items():
        (root / f"detections/pointrcnn_{of}/0000.txt").write_text("\n".join(lines))


def test_a_made_up_street_has_the_figures_of_ab3dmots_program(tmp_path: Path) -> None:
    """The numbers come from a run of scripts/KITTI/evaluate.py of xinshuoweng/AB3DMOT, commit 6a7fff5, Python 3.11.

    The run had the program's text without plots and messages. It read the same labels, and the tracks of AB3DMOT's
    method in its result format, at 3-D IoU 0.25.
    """
    made_up_street(tmp_path)
    figures = tracking.evaluate_kitti(tmp_path, rules="ab3dmot", rival=True)["rival"]
    # sAMOTA, AMOTA, AMOTP, MOTA, MOTP; ID switches, fragments, false, missed, found.
    program = {
        "car": ([0.812742, 0.408179, 0.566171, 0.709877, 0.642380], [0, 3, 9, 38, 137]),
        "pedestrian": ([0.402188, 0.270525, 0.406286, 0.475309, 0.594147], [0, 3, 28, 57, 117]),
        "cyclist": ([0.565437, 0.412500, 0.416962, 0.771605, 0.664107], [0, 0, 25, 12, 167]),
    }
    for of, (averages, counts) in program.items():
        best = figures[of]["best"]
        ours = [figures[of]["samota"], figures[of]["amota"], figures[of]["amotp"], best["mota"], best["motp"]]
        assert ours == pytest.approx(averages, abs=1e-6)
        assert [best[f"n_{name}"] for name in ("switches", "fragments", "false", "missed", "found")] == counts


def test_headings_and_the_rival_are_printed(kitti: Path, shell: Shell) -> None:
    text = shell.out("eval-tracking", kitti, "--rules", "ab3dmot", "--rival", "ab3dmot")
    assert "rules ab3dmot" in text
    assert text.count("AB3DMOT's method") == 3
    assert "headings within a quarter turn" in text
    rows = [line.split() for line in text.splitlines()]
    (moving,) = [row for row in rows if row[:2] == ["moving", "car"]]
    assert moving[2:4] == ["20", "1"]
    assert int(moving[4]) >= 10
    (ahead,) = [row for row in rows if row[:3] == ["car", "1", "s"]]
    assert (ahead[3:5], float(ahead[5]) < 2.0) == (["10", "1"], True)  # of 5 m/s, which it knows after a while
    assert moving[5:] == ["100.0", "100.0"]


COUNT = """
import sys, time
from importlib import import_module
from pathlib import Path

names = ("tracking.egomotion", "tracking.imm", "tracking.jpda", "tracking.lives", "tracking.ukf")
modules = [import_module(f"edgeperc.{name}") for name in names]
kernels = [kernel for module in modules for kernel in vars(module).values() if hasattr(kernel, "signatures")]
clock, counted = time.perf_counter, []

def stop():
    counted.append(sum(len(kernel.signatures) for kernel in kernels))
    return clock()

if sys.argv[1] == "bench":
    from edgeperc_bench.peers import tracking
    run = lambda: tracking.time_tracker([tracking.drawn_street(30)])
else:
    from edgeperc.evaluation import tracking
    run = lambda: tracking.evaluate_kitti(Path(sys.argv[1]), rival=True)
time.perf_counter = stop
run()
assert len(kernels) > 20 and len(counted) == 2, (len(kernels), counted)
print(*counted)
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled with the JIT off")
@pytest.mark.parametrize("what", ["eval-tracking", "bench"])
def test_nothing_is_compiled_while_the_clock_runs(kitti: Path, what: str) -> None:
    """A new process counts the compiled kernels when the clock starts, and when it stops."""
    before, after = map(int, printed(COUNT, "bench" if what == "bench" else kitti).split())
    assert after == before > 10


def test_kitti_errors(kitti: Path, tmp_path: Path) -> None:
    with pytest.raises(TrackingError, match="no label_02"):
        tracking.evaluate_kitti(tmp_path / "elsewhere")
    with pytest.raises(TrackingError, match=r"has no sequence '\.\./0000'; expected one of 0000"):
        tracking.read_sequence(kitti, "../0000")
    found, cars = tracking.read_sequence(kitti, "0000").detections, kitti / "detections/pointrcnn_Car/0000.txt"
    text = cars.read_text()
    cars.write_text("\ufeff" + text)
    assert tracking.read_sequence(kitti, "0000").detections == found
    for wrong, said in (("0,2,100\n", "15 comma-separated"), ("-1" + text[text.index(",") :], "first column, got -1")):
        cars.write_text(wrong)
        with pytest.raises(TrackingError, match=said):
            tracking.read_sequence(kitti, "0000")
    (kitti / "velodyne/0000").mkdir(parents=True)
    (kitti / "velodyne/0000/first.bin").touch()
    with pytest.raises(TrackingError, match=r"first\.bin: expected the number of a frame"):
        tracking.sequence_scans(kitti, "0000")
    (kitti / "detections/other_Car").mkdir()
    with pytest.raises(TrackingError, match=r"one folder \*_Car, got other_Car, pointrcnn_Car"):
        tracking.read_sequence(kitti, "0000")
    (kitti / "label_02/0000.txt").write_text("0 1 Car\n")
    with pytest.raises(TrackingError, match="17 columns"):
        tracking.read_sequence(kitti, "0000")


LABEL = "0 1 Car 0 0 0 500 150 700 300 1.5 1.6 3.9 1.0 1.7 12.0 1.57"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (LABEL.encode("utf-16"), "the labels cannot be read"),
        ("\n\n" + LABEL.replace("12.0", "nan"), "label 1: .* not finite"),
        (LABEL.replace("0 1", "inf 1", 1), "label 1: expected the numbers of a frame and of a track, got inf, 1"),
        (LABEL.replace("0 1", "nan 1", 1), "label 1: expected the numbers of a frame"),
        (LABEL + "\n" + LABEL.replace("0 1", "1000000001 1", 1), "label 2: expected the numbers of a frame"),
        (LABEL.replace("0 1", "-3 1", 1), "label 1: expected the numbers of a frame"),
        (LABEL.replace("0 1", "0 nan", 1), "label 1: expected the numbers of a frame"),
        (LABEL.replace("0 1", "0.5 1", 1), "label 1: expected the numbers of a frame"),  # it would be of none
        (LABEL.replace("1.5 1.6 3.9", "0 0 0"), "label 1: .* above 0 m"),
        (LABEL.replace("1.57", "90"), "label 1: .* in degrees"),
    ],
)
def test_malformed_labels_of_tracks_name_the_label(kitti: Path, text: str | bytes, error: str) -> None:
    (kitti / "label_02/0000.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises((PointsError, TrackingError), match=rf"0000\.txt[,:] {error}"):
        tracking.read_sequence(kitti, "0000")


def test_eval_tracking_prints_the_tables(kitti: Path, shell: Shell) -> None:
    arguments = ["eval-tracking", str(kitti), "--json", str(kitti / "out/figures.json")]
    lines = shell.out(*arguments).splitlines()
    assert lines[0].startswith("1 sequence, given detections, 3-D IoU 0.25, rules edgeperc;")
    words = [line.split() for line in lines]
    assert ["car", "100.0"] in [line[:1] + line[4:5] for line in words if len(line) > 8]
    assert any(line[:7] == ["sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "HOTA", "DetA"] for line in words)
    figures = json.loads((kitti / "out/figures.json").read_text())
    assert figures["classes"]["cyclist"]["best"]["mota"] is None
    assert figures["command"].startswith("edgeperc eval-tracking")
    assert "no label_02" in shell.err("eval-tracking", kitti / "calib")
    smoothed = shell.out("eval-tracking", kitti, "--smooth")
    assert smoothed.startswith("1 sequence, given detections, 3-D IoU 0.25, rules edgeperc, smoothed;")
    assert ("after a time" in "".join(lines), "after a time" in smoothed) == (True, False)  # it predicts nothing


def test_a_models_boxes_are_evaluated(kitti: Path, shell: Shell) -> None:
    """What run --json prints takes the place of the detections, which need not be there."""
    detections = tracking.read_sequence(kitti, "0000").detections
    lines = [{"scan": "x", "boxes": [replace(one, label="van").to_dict() for one in of]} for of in detections]
    for of in ("Car", "Pedestrian", "Cyclist"):
        (kitti / f"detections/pointrcnn_{of}/0000.txt").unlink()
    boxes = kitti / "boxes.jsonl"
    boxes.write_text("\n".join(map(json.dumps, lines)))
    of_boxes = ["--sequences", "0000", "--boxes", str(boxes), "--classes", "vehicle", "car"]
    arguments = ["eval-tracking", str(kitti), *of_boxes]
    assert cli.main([*arguments, "--json", str(kitti / "figures.json")]) == 0
    figures = json.loads((kitti / "figures.json").read_text())["classes"]
    assert figures["vehicle"]["best"]["mota"] > 0.9  # the car and the van
    assert figures["vehicle"]["best"]["n_truth"] == 40
    assert figures["car"]["best"]["n_missed"] == 20  # all were labeled as vans
    boxes.write_text("\n".join(map(json.dumps, lines[:-1])))
    assert "19 frames for 20" in shell.err(*arguments)
    boxes.write_text('{"scan": "x"}')
    assert "holds no boxes" in shell.err(*arguments)
    assert shell.err(*arguments[:2], "--boxes", boxes)


@pytest.fixture
def drive_root(kitti: Path, tmp_path: Path) -> Path:
    """The same sequence as an object set with track ids: a label and a scan a frame, of two drives."""
    root = tmp_path / "objects"
    for folder in ("label_2", "track_id", "calib", "velodyne"):
        (root / "training" / folder).mkdir(parents=True)
    by_frame: dict[int, list[list[str]]] = {}
    for line in (kitti / "label_02/0000.txt").read_text().splitlines():
        words = line.split()
        by_frame.setdefault(int(words[0]), []).append(words)
    rows = ["name,drive"]
    for k, labels in by_frame.items():
        name = f"{100 + k:06}"
        rows.append(f"{name},my_drive")
        (root / f"training/label_2/{name}.txt").write_text("".join(" ".join(words[2:]) + "\n" for words in labels))
        (root / f"training/track_id/{name}.txt").write_text("".join(words[1] + "\n" for words in labels))
        (root / f"training/calib/{name}.txt").write_text(CALIBRATION)
        (root / f"training/velodyne/{name}.bin").write_bytes(np.full((3, 4), 0.5 + k, np.float32).tobytes())
    (root / "frames.csv").write_text("\n".join([*rows, "000000,unlabeled_drive"]) + "\n")
    return root


def test_an_object_set_with_track_ids_is_the_same_sequence(kitti: Path, drive_root: Path) -> None:
    assert tracking.sequence_names(drive_root) == ["my_drive"]
    scans = tracking.sequence_scans(drive_root, "my_drive")
    assert [path.stem for path in scans.values()] == [f"{100 + k:06}" for k in range(20)]
    given = tracking.read_sequence(kitti, "0000")
    labels = drive_root / "training/label_2/000102.txt"
    labels.write_text("\ufeff" + labels.read_text() + "\n")  # the first one was of an unknown class
    same = tracking.read_sequence(drive_root, "my_drive", boxes=given.detections)
    for of in ("car", "pedestrian"):
        for a, b in zip(given.truth[of], same.truth[of], strict=True):
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.boxes, b.boxes)
            np.testing.assert_array_equal(a.ignored, b.ignored)
    (drive_root / "training/track_id/000103.txt").write_text("1\n")
    with pytest.raises(TrackingError, match="3 labels, and 1 track ids"):
        tracking.read_sequence(drive_root, "my_drive", boxes=given.detections)


def test_a_drive_is_perceived_and_tracked(
    kitti: Path, drive_root: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    """From scans to the table in one command; a scan that a model was trained on is refused."""
    found = tracking.read_sequence(kitti, "0000").detections
    card = SimpleNamespace(name="seer", version="1.0", training={})

    def perceive(points: np.ndarray) -> SimpleNamespace:
        return SimpleNamespace(boxes=found[int(points[0, 0])])

    perceive.cards = (card,)
    monkeypatch.setattr("edgeperc.cli.evaluation.tracking.make_perceiver", lambda *_, **__: perceive)
    arguments = ["eval-tracking", str(drive_root), "--classes", "car", "--json", str(drive_root / "f.json")]
    assert "1 sequence, boxes of seer 1.0" in shell.out(*arguments)
    best = json.loads((drive_root / "f.json").read_text())["classes"]["car"]["best"]
    assert (best["n_truth"], best["n_missed"], best["n_false"]) == (20, 0, 0)

    # Beside KITTI's own sequences, --model takes the place of the detections that are there.
    assert "no scans of 0000" in shell.err("eval-tracking", kitti, "--model", "seer")
    (kitti / "velodyne/0000").mkdir(parents=True)
    for k, path in tracking.sequence_scans(drive_root, "my_drive").items():
        (kitti / f"velodyne/0000/{k:06}.bin").write_bytes(path.read_bytes())
    (kitti / "velodyne/0000/000003.bin").unlink()  # as in KITTI's sequence 0001
    assert cli.main(["eval-tracking", str(kitti), "--model", "seer", "--classes", "car"]) == 0

    card.training = {"frames": {"x": scan_hash(np.full((3, 4), 4.5, np.float32))}}
    assert "seer 1.0 was trained on scan 000104" in shell.err(*arguments)


def test_a_coarser_sensors_drive_has_every_second_beam(drive_root: Path, tmp_path: Path) -> None:
    turn = np.radians(np.arange(0.5, 360.0, 30.0))
    beams = [np.column_stack([9.0 * np.cos(turn), 9.0 * np.sin(turn), 0 * turn - k, 0 * turn + 0.5]) for k in range(5)]
    for path in tracking.sequence_scans(drive_root, "my_drive").values():
        np.concatenate(beams).astype(np.float32).tofile(path)
    every_second_beam(drive_root, tmp_path / "coarse")
    scans = tracking.sequence_scans(tmp_path / "coarse", "my_drive")
    assert len(scans) == 20
    points = np.fromfile(scans[7], np.float32).reshape(-1, 4)
    assert points[:, 2].tolist() == [0.0] * 12 + [-2.0] * 12 + [-4.0] * 12
    assert (points[:, 3] == 63.75).all()
    sensor = get_sensor(tmp_path / "coarse/sensor.json")
    assert (len(sensor.elevations_deg), sensor.remission_range) == (32, (0.0, 255.0))


def test_real_sequences_are_tracked_well(data_root: Callable[[str], Path]) -> None:
    """Sequence 0004 with PointRCNN's detections; the figures of the whole set are in the documents."""
    figures, smoothed = (
        tracking.evaluate_kitti(data_root("tracking"), sequences=["0004"], smooth=smooth)["classes"]["car"]
        for smooth in (False, True)
    )
    assert smoothed["hota"]["hota"] > figures["hota"]["hota"] + 0.01
    assert smoothed["all_tracks"]["n_missed"] < figures["all_tracks"]["n_missed"]
    assert figures["best"]["mota"] > 0.85
    assert figures["best"]["n_switches"] == 0
    assert figures["hota"]["hota"] > 0.6


def test_real_vehicles_that_move_point_to_where_they_drive(data_root: Callable[[str], Path]) -> None:
    """Motion alone: PointRCNN's boxes do not say that they know the front."""
    figures = tracking.evaluate_kitti(data_root("tracking"), sequences=["0011"], classes=["car"])["headings"]["car"]
    moving = figures["moving"]
    assert moving["n_boxes"] > 500
    assert moving["n_resolved"] > 0.9 * moving["n_boxes"]
    assert moving["n_right"] > 0.95 * moving["n_resolved"]


def test_tracks_are_animated(kitti: Path, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    from edgeperc.view.tracks import draw_tracks

    tracks, _ = tracking.track_sequence(tracking.read_sequence(kitti, "0000"))
    content = draw_tracks(tracks, tmp_path / "tracks.gif", title="a drive")
    assert (tmp_path / "tracks.gif").read_bytes() == content
    with image.open(tmp_path / "tracks.gif") as animation:
        assert animation.n_frames == 20
        first = np.asarray(animation.convert("RGB")).copy()
        animation.seek(19)
        assert (np.asarray(animation.convert("RGB")) != first).any()
        assert animation.info["duration"] == 1000
    for few in ([], tracks[:1]):
        with pytest.raises(TrackingError, match="two or more"):
            draw_tracks(few, tmp_path / "none.gif")
    assert not (tmp_path / "none.gif").exists()
