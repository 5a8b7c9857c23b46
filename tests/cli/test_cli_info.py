"""The commands that list and explain: info, models, sensors, providers, completion."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from checkout import printed
from cli_helpers import POINTSEG, SSADNET, Shell, run, thinned, write_scan
from edgeperc import zoo
from edgeperc.errors import ModelFileError
from edgeperc.inference import listing, providers
from edgeperc.preprocess.findings import Finding
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.simulation.samples import simulated_scan
from edgeperc.system import machine
from edgeperc.types.card import ModelCard
from edgeperc.types.frame import ModelFrame
from edgeperc.types.sensor import SENSORS, SensorProfile, get_sensor
from edgeperc.zoo import Variant
from scenes import urban

pytestmark = pytest.mark.usefixtures("networks_opened_once")


@pytest.fixture
def fake_models(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "pointseg.onnx"
    file.write_bytes(bytes(2_500_000))
    file.with_stem("pointseg-int8").write_bytes(bytes(700_000))
    file.with_stem("ssadnet").write_bytes(bytes(10))
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "cache"))

    def listed() -> tuple[Variant, ...]:
        return (
            Variant(file, POINTSEG),
            Variant(file.with_stem("pointseg-int8"), replace(POINTSEG, precision="int8")),
            Variant(file.with_stem("ssadnet"), SSADNET),
        )

    def resolve(model: str) -> tuple[Variant, ...]:
        found = tuple(each for each in listed() if each.name in (Path(model).stem, model))
        if not found:
            raise ModelFileError(f"no model is called {model!r}")
        return found

    monkeypatch.setattr(zoo, "listed", listed)
    monkeypatch.setattr(listing, "listed", listed)
    monkeypatch.setattr(zoo, "resolve", resolve)


def rows_of(text: str) -> dict[str, str]:
    """First words of lines, and what follows."""
    return dict((*line.split(None, 1), "")[:2] for line in text.splitlines())


@pytest.mark.usefixtures("fake_models")
@pytest.mark.parametrize("thing", ["pointseg", "pointseg.onnx"])
def test_info_of_a_model(thing: str, tmp_path: Path, shell: Shell) -> None:
    rows = rows_of(shell.out("info", thing if thing == "pointseg" else tmp_path / thing))
    assert rows["model"] == "pointseg 1.2.3: a class for every point (car, pedestrian, cyclist)"
    assert rows["variants"] == "fp32 2.5 MB, int8 0.7 MB"
    assert rows["sha256"] == hashlib.sha256(bytes(2_500_000)).hexdigest()
    assert rows["view"] == "range_image: 3 beams from 2 to -10 deg, azimuths 45 to -45 deg"
    assert rows["input"] == "3 x 3 x 8: x, y, z"
    assert rows["outputs"] == "logits (class_logits)"
    assert rows["classes"] == "background, car, pedestrian, cyclist"
    assert rows["data"] == "streets"
    assert rows["licence"] == "CC0"
    assert rows["on"] == "KITTI  21 scans of 3 drives, test split, %: IoU car 65.1 (n=3)"
    assert rows["int8"] == "99.95 % of the labels as in fp32, 0.1 points lost"
    assert "frames" not in rows


@pytest.mark.parametrize("name", zoo.shipped_models())
def test_info_of_a_shipped_model_fits_a_screen(name: str, shell: Shell) -> None:
    lines = shell.out("info", name).splitlines()
    assert 8 < len(lines) <= 24
    assert max(map(len, lines)) <= 100


def test_info_folds_what_is_long(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    card = replace(POINTSEG, training={"data": "street " * 100}, classes=tuple(f"class {k}" for k in range(250)))
    card = replace(card, metrics={"folders": {"mine": POINTSEG.metrics["real"]}})
    monkeypatch.setattr(zoo, "resolve", lambda model: (Variant(Path(__file__), card),))
    lines = shell.out("info", "pointseg").splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 100
    assert sum(line.endswith(" ...") for line in lines) == 3  # classes are in two rows
    assert "on mine   21 scans of 3 drives, %: IoU car 65.1 (n=3)" in lines
    card = replace(card, metrics={"real": 3})  # a stranger's card
    assert "not as edgeperc eval --json writes them" in shell.out("info", "pointseg")


@pytest.mark.usefixtures("fake_models")
def test_info_of_a_scan(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:

    checked = []

    def check_fitness(
        points: np.ndarray, profile: FitnessProfile | None, sensor: SensorProfile | None, frame: ModelFrame
    ) -> tuple[Finding, ...]:
        checked.append((points, profile, sensor.name))
        return (Finding("it has 32 beams"),)

    monkeypatch.setattr("edgeperc.preprocess.findings.check_fitness", check_fitness)
    monkeypatch.setattr(FitnessProfile, "from_dict", dict)
    monkeypatch.setattr(sys.modules[__name__], "POINTSEG", replace(POINTSEG, fitness={"n_beams": 64}))
    points = np.array([[3, 4, 0, 10], [0, 10, 10, 255], [-6, 0, 8, 51], [np.nan, 0, 0, 0]], np.float32)
    np.save(tmp_path / "scan.npy", points)
    out = shell.out("info", tmp_path / "scan.npy", "--sensor", "os1-64")
    rows = rows_of(out)
    assert rows["points"] == "4, of which 1 are not finite"
    assert rows["extent"] == "x -6.0 .. 3.0, y 0.0 .. 10.0, z 0.0 .. 10.0 m"
    assert rows["range"] == "5.0 .. 14.1 m, median 10.0 m"
    assert rows["remission"].startswith("min 10, 5 % ")
    assert rows["beams"].endswith("rows of points (os1-64: 64)")
    of_models = [line.split(None, 1)[1] for line in out.splitlines() if line.startswith("models ")]
    assert "pointseg: as a scan of os1-64: it has 32 beams" in of_models
    assert any("ssadnet: its card does not describe its training scans" in text for text in of_models)
    assert len({text.partition(": ")[2] for text in of_models}) == len(of_models)
    ((scaled, profile, sensor),) = checked
    np.testing.assert_allclose(scaled[:3, 3], np.array([10, 255, 51]) / 255, rtol=1e-6)
    assert (profile, sensor) == ({"n_beams": 64}, "os1-64")
    (document,) = shell.records("info", tmp_path / "scan.npy", "--sensor", "os1-64")
    assert document["range_m"] == pytest.approx([5.0, 10.0, 14.1421], abs=1e-4)
    assert (document["n_points"], document["n_not_finite"]) == (4, 1)
    assert document["models"] == {"pointseg": ["it has 32 beams"], "ssadnet": None}


REFUSED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "millimeters": lambda scan: scan * np.float32([1e3, 1e3, 1e3, 1.0]),
    "kilometers": lambda scan: scan * np.float32([1e-3, 1e-3, 1e-3, 1.0]),
    "upside down": lambda scan: scan * np.float32([1.0, -1.0, -1.0, 1.0]),
    "y up": lambda scan: scan[:, [0, 2, 1, 3]],
    "raw remission": lambda scan: scan * np.float32([1.0, 1.0, 1.0, 255.0]),
    "few points": lambda scan: scan[::700],
    "not finite": lambda scan: scan * np.float32(np.nan),
    "empty beams": lambda scan: scan * np.float32(0.0),
}


@pytest.mark.parametrize("change", ["none", *REFUSED])
def test_info_says_what_run_does(change: str, tmp_path: Path, shell: Shell) -> None:
    """The same exit code, and the whole advice."""
    pytest.importorskip("onnxruntime")
    scan = urban(3, thinned()).points
    file = tmp_path / "scan.bin"
    np.ascontiguousarray(REFUSED.get(change, lambda scan: scan)(scan), np.float32).tofile(file)
    sensor = "--sensor", "hdl-64e"
    refused = int(change != "none")
    error = shell.records("run", file, *sensor, code=refused)[0].get("error", "")
    printed = shell.both("info", file, *sensor, code=refused)
    shown = " ".join(line.partition(" ")[2].strip() for line in printed.out.splitlines())
    assert ("edgeperc run refuses this scan" in shown) == refused
    said = error.partition(" Results would be")[0]
    if change not in ("none", "not finite", "few points", "empty beams"):
        assert said in shown
    assert " ..." not in printed.out
    assert shell.records("info", file, *sensor, code=refused)[0]["refused"] is bool(refused)


@pytest.mark.parametrize("command", ["run", "info"])
@pytest.mark.parametrize(
    ("option", "said"),
    [
        ("--sensor hdl64e", "did you mean hdl-64e?"),
        ("--sensor absent.json", "absent.json"),
        ("--extrinsic absent.json", "absent.json"),
        ("--extrinsic 0.bin", "0.bin"),
    ],
)
def test_a_wrong_sensor_is_one_error_before_the_first_scan(
    command: str, option: str, said: str, tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for k in range(4):
        write_scan(tmp_path / f"{k}.bin")
    printed = shell.both(command, *sorted(tmp_path.iterdir()), *option.split(), code=2)
    assert len(printed.err.splitlines()) == 1
    assert said in printed.err
    assert not printed.out


def test_only_what_is_given_is_called_so(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for options, given in (("", 0), ("--mount-height 2.4", 1), ("--turn -90", 1), ("--mount-height 2.4 --turn -90", 2)):
        run("info", drive / "0.bin", *options.split())
        mounting = " ".join(capsys.readouterr().out.partition("\nmounting")[2].partition("\nbeams")[0].split())
        assert mounting.count("(given)") == given
        assert ("yaw 0.0 deg (not estimated)" in mounting) == ("--turn" not in options)


def test_info_prints_a_card_as_it_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("info", "ssadnet", "--json") == 0
    assert ModelCard.from_json(capsys.readouterr().out).to_json() == zoo.resolve("ssadnet")[0].card.to_json()


@pytest.mark.usefixtures("fake_models")
def test_info_goes_on_after_what_it_does_not_know(tmp_path: Path, shell: Shell) -> None:
    empty = tmp_path / "empty.npy"
    np.save(empty, np.zeros((0, 4), np.float32))
    captured = shell.both("info", "nonesuch", tmp_path / "absent.bin", empty, "ssadnet", code=1)
    assert [line.split(":")[0] for line in captured.err.splitlines()] == ["edgeperc", "edgeperc"]
    assert "0, of which 0 are not finite" in captured.out
    assert "top_view: x 6..46 m, y -10..10 m, cells of 0.1 m" in captured.out
    assert "car, van, score from 0.3" in captured.out
    assert "nonesuch" in shell.err("info", empty, "--sensor", "nonesuch")


def test_info_and_lists_need_no_onnxruntime(tmp_path: Path) -> None:
    scan = write_scan(tmp_path / "a.bin", 40)
    code = (
        "import sys; from edgeperc.cli import main\n"
        f"for words in (['info', 'pointseg', {str(scan)!r}], ['models'], ['sensors']): assert main(words) in (0, 1)\n"
        "sys.exit('opened' if 'onnxruntime' in sys.modules else 0)\n"
    )
    printed(code)


@pytest.mark.usefixtures("fake_models")
def test_models_are_listed_with_what_was_measured_here(shell: Shell) -> None:
    entry = {"provider": "cpu", "precision": "int8", "n_threads": 2, "p50_ms": 7.25}
    machine.write_settings(machine.settings_path(), machine.fingerprint(), {zoo.digest(zoo.resolve("pointseg")): entry})
    heading, pointseg, ssadnet = shell.out("models").splitlines()
    assert heading.split()[:2] == ["name", "default"]
    assert pointseg.split()[:2] == ["pointseg", "yes"]
    assert "fp32 2.5, int8 0.7" in pointseg
    assert "7.2 ms, cpu int8" in pointseg
    assert pointseg.endswith("CC0")
    assert "boxes of car, van" in ssadnet
    first, second = shell.records("models")
    assert (first["name"], first["measured"], first["default"]) == ("pointseg", entry, True)
    assert first["variants"] == {"fp32": 2.5, "int8": 0.7}
    assert second["measured"] is None


def test_sensors_are_listed(shell: Shell) -> None:
    lines = shell.out("sensors").splitlines()
    assert [line.split()[0] for line in lines[1:]] == [*SENSORS]
    assert [line.split()[0] for line in lines[1:] if line.split()[1] == "yes"] == ["hdl-64e"]
    records = shell.records("sensors")
    assert [record["name"] for record in records] == [*SENSORS]
    assert records[0]["beams"] == 64


def test_providers_are_listed(shell: Shell) -> None:
    pytest.importorskip("onnxruntime")
    records = {record["name"]: record for record in shell.records("providers")}
    assert {*records} == {*providers.PROVIDERS}
    assert records["cpu"]["available"]
    assert len(shell.out("providers").splitlines()) == 1 + len(records)


@pytest.mark.parametrize("name", ["bash", "zsh", "fish", "tcsh"])
def test_completion_knows_commands_options_and_names(name: str, shell: Shell) -> None:
    pytest.importorskip("shtab")
    script = shell.out("completion", name)
    for word in ("eval-tracking", "full-turn", "os1-64", "av2", "ssadnet", "openvino", "bf16"):
        assert word in script


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
@pytest.mark.parametrize(
    ("typed", "found"),
    [
        ("edgeperc mod", {"models"}),
        ("edgeperc run --full", {"--full-turn"}),
        ("edgeperc run --sensor pandarx", {"pandarxt-32", "pandarxt-32m"}),
        ("edgeperc run --model ssad", {"ssadnet", "ssadnet-open"}),
        ("edgeperc info sca", {"scan.bin"}),
    ],
)
def test_fish_completes(typed: str, found: set[str], tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("shtab")
    (tmp_path / "scan.bin").touch()
    (tmp_path / "edgeperc.fish").write_text(shell.out("completion", "fish"))
    code = f"source edgeperc.fish; complete -C {shlex.quote(typed)}"
    home = {**os.environ, "HOME": str(tmp_path)}
    done = subprocess.run(["fish", "-c", code], cwd=tmp_path, env=home, capture_output=True, text=True, check=False)
    assert {line.partition("\t")[0] for line in done.stdout.splitlines()} == found, done.stderr


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["mod"], {"models"}),
        (["run", "--full"], {"--full-turn"}),
        (["run", "--precision", "b"], {"bf16"}),
        (["run", "--model", "ssad"], {"ssadnet", "ssadnet-open"}),
        (["run", "--sensor", "pandarx"], {"pandarxt-32", "pandarxt-32m"}),
        (["run", "--model", "ssadnet", "sca"], {"scan.bin"}),
        (["info", "sca"], {"scan.bin"}),
        (["eval-tracking", "--gif", "sca"], {"scan.bin"}),
    ],
)
def test_bash_completes(words: list[str], found: set[str], tmp_path: Path, shell: Shell) -> None:
    pytest.importorskip("shtab")
    (tmp_path / "scan.bin").touch()
    (tmp_path / "completion").write_text(shell.out("completion", "bash"))
    code = (
        f"source ./completion; COMP_WORDS=(edgeperc {' '.join(words)}); COMP_CWORD={len(words)}; "
        '_shtab_edgeperc 2>/dev/null; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert {*done.stdout.split()} == found, done.stderr


def test_completion_names_its_extra(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert "pip install 'edgeperc[completion]'" in shell.err("completion", "bash")


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """Three simulated scans of a sensor 2.4 m above the road; the second shows nothing near the vehicle."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for k in range(3):
        scan = urban(k, thinned()).points - np.float32([0.0, 0.0, 0.67, 0.0])
        kept = np.hypot(scan[:, 0], scan[:, 1]) > (60.0 if k == 1 else 0.0)
        scan[kept].tofile(folder / f"{k}.bin")
    return folder


@pytest.fixture
def in_a_turned_drive(drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In its folder, with the extrinsic of a sensor that looks to the right, 1.9 m high."""
    monkeypatch.chdir(drive)
    (drive / "T.json").write_text("[[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 1.9], [0, 0, 0, 1]]")


def test_info_prints_the_mounting_and_writes_a_profile(drive: Path, tmp_path: Path, shell: Shell) -> None:
    written = tmp_path / "mine.json"
    printed = shell.out("info", *sorted(drive.iterdir()), "--write", written, code=1)  # of a scan that run refuses
    assert printed.count("edgeperc run refuses this scan") == 1
    assert printed.count("cannot be estimated: the scan shows no ground") == 1
    assert "hdl-64e, by 2 scans" in printed
    mounting = get_sensor(written).mounting
    assert mounting.is_known
    assert mounting.height_m == pytest.approx(2.4, abs=0.1)
    assert replace(get_sensor(written), mounting=thinned().mounting) == thinned()

    of_folder = shell.records("info", drive)[0]["mounting"]  # one scan shows no ground
    assert (of_folder["n_scans"], of_folder["mounting"]["height_m"]) == (2, pytest.approx(2.4, abs=0.1))
    estimate = shell.records("info", drive / "0.bin", "--mount-height", "2.0")[0]["mounting"]
    assert (estimate["mounting"]["height_m"], estimate["height_sd_m"]) == (2.0, 0.0)
    assert estimate["roll_sd_deg"] > 0.0


def test_the_written_mounting_is_that_of_a_run_without_it(tmp_path: Path, shell: Shell) -> None:
    scan, written = write_simulated(tmp_path / "0.bin", "hdl-64e", 1), tmp_path / "mine.json"
    printed = " ".join(shell.out("info", scan, "--write", written).split())
    assert "pitch 0.1 deg +- 0.3" in printed
    assert "within what streets differ by: taken as the training vehicle's, height 1.73 m, roll 0.0 deg" in printed
    given = " ".join(shell.out("info", scan, "--mount-height", "1.7").split())
    assert "taken as the training vehicle's, roll 0.0 deg, pitch 0.7 deg beams" in given
    of_run, of_profile = (shell.records("run", scan, *more, "--json")[0] for more in ((), ("--sensor", written)))
    for name in ("mounting", "boxes", "point_counts"):
        assert of_profile[name] == of_run[name]


@pytest.mark.filterwarnings("default")
def test_near_returns_are_kept_as_the_warning_says(tmp_path: Path, shell: Shell) -> None:
    scan, written = write_simulated(tmp_path / "0.bin", "hdl-64e", 1), tmp_path / "mine.json"
    points = np.fromfile(scan, np.float32).reshape(-1, 4)
    np.vstack([points, np.tile(np.float32([0.6, 0.0, 0.0, 0.3]), (20, 1))]).tofile(scan)
    assert "--sensor the file that edgeperc info SCAN --write gives" in shell.both("run", scan, code=0).err
    shell.out("info", scan, "--write", written)
    written.write_text(json.dumps({**json.loads(written.read_text()), "min_range_m": 0.0}))
    assert shell.records("run", scan, "--sensor", written, "--json")[0]["dropped"]["too_near"] == 0


def test_a_profile_replaces_no_other_file(drive: Path, tmp_path: Path, shell: Shell) -> None:
    metadata, fit = tmp_path / "drive.json", ("--sensor", "hdl-64e", "--out")
    metadata.write_text('{"beam_altitude_angles": [1, 2]}')
    for arguments in (("info", drive / "0.bin", "--write", metadata), ("fit-sensor", drive / "0.bin", *fit, metadata)):
        assert f"{metadata} is there, and is no sensor profile" in shell.err(*arguments)
    assert metadata.read_text() == '{"beam_altitude_angles": [1, 2]}'
    for _ in range(2):  # a profile replaces another
        assert run("info", drive / "0.bin", "--write", tmp_path / "mine.json") == 0


def test_no_profile_is_written_without_ground_or_of_two_sensors(drive: Path, tmp_path: Path, shell: Shell) -> None:
    written = tmp_path / "mine.json"
    said = shell.err("info", drive / "1.bin", "--sensor", "hdl-64e", "--write", written, code=1)
    assert "no scan shows the ground" in said
    assert "the scans are of 0 sensors" in shell.err("info", "pointseg", "--write", written, code=1)
    assert not written.exists()
    assert "ends in .json" in shell.err("info", drive / "0.bin", "--write", tmp_path / "mine.txt")


@pytest.mark.parametrize(
    ("options", "mounting"),
    [
        (["--mount-height", "2.1"], {"height_m": 2.1}),
        (["--turn", "-90"], {"yaw_deg": -90.0}),
        (["--roll", "-2.5"], {"roll_deg": -2.5}),
        (
            ["--pitch", "3", "--roll", "180", "--mount-height", "6"],
            {"roll_deg": 180.0, "pitch_deg": 3.0, "height_m": 6.0},
        ),
        (["--extrinsic", "T.json", "--pitch", "4"], {"height_m": 1.9, "pitch_deg": 4.0, "yaw_deg": -90.0}),
        (["--extrinsic", "T.json"], {"height_m": 1.9, "roll_deg": 0.0, "pitch_deg": 0.0, "yaw_deg": -90.0}),
        (["--extrinsic", "T.json", "--mount-height", "3"], {"height_m": 3.0, "yaw_deg": -90.0}),
    ],
)
@pytest.mark.filterwarnings("ignore:.*which is taken:UserWarning")
@pytest.mark.usefixtures("in_a_turned_drive")
def test_run_uses_the_given_mounting(options: list[str], mounting: dict[str, float], shell: Shell) -> None:
    arguments = ["0.bin", "--json", "--model", "pointseg", "--provider", "cpu", "--on-mismatch", "ignore"]
    used = json.loads(shell.out("run", *arguments, *options))["mounting"]
    assert {name: round(used[name], 6) for name in mounting} == mounting


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mount-height", "3"], "T.json says height_m = 1.90, and --mount-height 3, which is taken"),
        (["--pitch", "4"], "T.json says pitch_deg = 0.00, and --pitch 4, which is taken"),
        (["--turn", "street"], "T.json says yaw_deg = -90.00, and --turn street, which is taken"),
        (["--turn", "270", "--mount-height", "1.9"], ""),
    ],
)
@pytest.mark.parametrize("command", ["run", "info"])
@pytest.mark.filterwarnings("always::UserWarning")
@pytest.mark.usefixtures("in_a_turned_drive")
def test_options_that_contradict_an_extrinsic_are_said_once(
    command: str, options: list[str], said: str, shell: Shell
) -> None:
    words = ("0.bin", "1.bin", "--sensor", "hdl-64e", "--extrinsic", "T.json", *options)
    warned = [line for line in shell.err(command, *words, code=1).splitlines() if "which is taken" in line]
    assert warned == ([f"edgeperc: warning: {said}"] if said else [])


@pytest.mark.parametrize(
    "options",
    [
        ["--mount-height", "nan"],
        ["--turn", "left"],
        ["--mount-height", "1e9"],
        ["--extrinsic", "absent"],
        ["--roll", "181"],
        ["--pitch", "steep"],
    ],
)
def test_impossible_mountings_are_refused(options: list[str], drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with contextlib.suppress(SystemExit):  # argparse
        assert run("run", drive / "0.bin", *options) != 0
    error = capsys.readouterr().err
    assert options[0] in error or "mounting" in error or "extrinsic" in error
    assert "Traceback" not in error


def test_info_finds_the_sensor_and_writes_it(fake_models: None, tmp_path: Path, shell: Shell) -> None:
    sensor = SensorProfile.uniform("mine", 40, 8.0, -20.0, columns=1500)
    scans = [tmp_path / f"{k}.bin" for k in range(2)]
    for k, scan in enumerate(scans):
        urban(k, sensor).points.tofile(scan)
    profile = tmp_path / "found.json"
    shown = " ".join(shell.out("info", *scans, "--write", profile).split())
    assert shown.count("40-beam: 40 beams from 8.0 to -20.0 deg, 1500 columns, found in the points") == 2
    found = get_sensor(profile)
    assert found.name == "40-beam"
    np.testing.assert_allclose(found.elevations_deg, sensor.elevations_deg, atol=0.02)
    assert shell.records("info", scans[0], "--sensor", profile)[0]["sensor"] == "40-beam"


@pytest.mark.parametrize("name", ["vlp-16", "os1-64", "hdl-64e"])
@pytest.mark.parametrize("option", [[], ["--sensor", "auto"]])
def test_info_names_the_sensor_of_scan_files(
    fake_models: None, name: str, option: list[str], tmp_path: Path, shell: Shell
) -> None:
    urban(3, thinned(name)).points.tofile(tmp_path / "0.bin")
    (shown,) = shell.records("info", tmp_path / "0.bin", *option)
    assert shown["sensor"] == name
    assert "beams found" in shown["sensor_from"]


def test_info_says_that_a_sensor_cannot_be_told(fake_models: None, tmp_path: Path, shell: Shell) -> None:
    scan = write_scan(tmp_path / "0.bin", 5000)
    said = shell.err("info", scan, code=1)
    assert f"{scan}: the sensor cannot be told from the scan" in said
    assert "pass --sensor with a name" in said
    assert "sensor=" not in said
    assert "pass --sensor" in shell.err("info", write_scan(tmp_path / "few" / "0.bin"), "--sensor", "auto", code=1)
    assert "cannot be told" not in shell.err("info", scan, "--sensor", "hdl-64e", code=0)


def write_simulated(path: Path, sensor: str, seed: int) -> Path:
    """A scan with remission in 0..1."""
    points = simulated_scan(seed, thinned(sensor)).points
    points = points[np.isfinite(points).all(axis=1)]
    points[:, 3] /= max(1.0, points[:, 3].max())
    points.tofile(path)
    return path


@pytest.mark.parametrize(("sensor", "said"), [("vlp-16", "os1-64"), ("hdl-64e", "vlp-16"), ("pandar64", "hdl-64e")])
@pytest.mark.filterwarnings("always::UserWarning")
def test_a_sensor_whose_beams_the_points_do_not_have_is_warned_of(
    sensor: str, said: str, tmp_path: Path, shell: Shell
) -> None:
    scan = write_simulated(tmp_path / "0.bin", sensor, 1)
    for name, is_warned in ((said, True), (sensor, False)):
        error = shell.err("run", scan, "--sensor", name, "--anyway", "--remission-range", "0", "1", code=0)
        assert (f"--sensor says {name}, the points {sensor} (" in error) == is_warned


@pytest.mark.parametrize("sensor", ["vlp-16", "hdl-64e"])
@pytest.mark.parametrize(("scale", "is_warned"), [(1.0, False), (np.pi / 180.0, True), (2.0, True)])
@pytest.mark.filterwarnings("always::UserWarning")
def test_a_profile_of_other_beams_is_warned_of(
    sensor: str, scale: float, is_warned: bool, tmp_path: Path, shell: Shell
) -> None:
    """As in radians."""
    scan, profile = write_simulated(tmp_path / "0.bin", sensor, 1), get_sensor(sensor)
    elevations = tuple(scale * angle for angle in profile.elevations_deg)
    other = replace(profile, elevations_deg=elevations, remission_range=(0.0, 1.0))
    (tmp_path / "mine.json").write_text(other.to_json())
    error = shell.err("run", scan, "--sensor", tmp_path / "mine.json", "--anyway", code=0)
    assert ("it is read as" in error) == is_warned


@pytest.mark.parametrize(
    ("on_mismatch", "code", "said"),
    [
        ("refuse", 0, "warning: {}: The sensor cannot be told"),
        ("raise", 1, "The sensor cannot be told"),
        ("ignore", 0, ""),
    ],
)
@pytest.mark.filterwarnings("always::UserWarning")
def test_dense_files_without_beams_are_read_with_a_warning(
    on_mismatch: str, code: int, said: str, tmp_path: Path, shell: Shell
) -> None:
    """Of two sensors at once, about one of them."""
    points = urban(8, "os1-64").points
    path = tmp_path / "a.bin"
    np.concatenate([points, points + np.array([1.4, 0.3, -0.2, 0.0], np.float32)]).tofile(path)
    error = shell.err("run", path, "--on-mismatch", on_mismatch, code=code)
    assert said.format(path) in error
    assert error.count("no beams stand out") == bool(said)


@pytest.mark.parametrize("sensors", [("hdl-64e", "vlp-16"), ("pandar64", "os1-64", "os1-64"), ("vlp-16", "vlp-32c")])
def test_a_folder_of_several_sensors_is_said_to_be_one(sensors: Sequence[str], tmp_path: Path, shell: Shell) -> None:
    for k, sensor in enumerate(sensors):
        write_simulated(tmp_path / f"{k}.bin", sensor, k)
    said = f"the first scans are of several sensors: {', '.join(sorted({*sensors}))}; read those of each on their own"
    assert said in shell.err("run", tmp_path, code=1)


@pytest.mark.parametrize("roll", [180.0, -175.0, 170.0])
def test_a_roll_that_turns_a_scan_upside_down_is_refused(roll: float, tmp_path: Path, shell: Shell) -> None:
    scan = write_simulated(tmp_path / "0.bin", "hdl-64e", 1)
    said = shell.err("run", scan, "--sensor", "hdl-64e", "--roll", roll, code=1)
    assert "it does not hang upside down, or the points are turned already" in said
