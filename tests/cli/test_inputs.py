"""Options of reading that are for another kind of input than the given one are refused, never ignored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from test_captures import vlp16_packets, write_pcap

from cli_helpers import Shell, run, write_scan
from edgeperc import PointsError, read_scans

OF_RECORDINGS = ("--topic 10.0.0.1",)
OF_SCAN_FILES = ("--columns x y z i", "--columns=x", "--origin 1 2 3", "--origin auto")
OF_SCANS = (
    *("--sensor vlp-16", "--mount-height 1.8", "--roll 0", "--pitch=1", "--turn street", "--ego-box 0 1 0 1 0 1"),
    *("--remission-field i", "--remission-range 0 1"),
)
OF_PERCEIVING = (
    *("--on-mismatch raise", "--anyway", "--score-threshold 0.5", "--boxes-from both", "--no-agreement"),
    *("--full-turn", "--adapt none"),
)
GATHERED = "--sensor mid-360 --accumulate 0.2"


def write_inputs(folder: Path) -> dict[str, Path]:
    (folder / "scans").mkdir()
    (folder / "a.png").write_bytes(b"\x89PNG")
    return {
        "scan file": write_scan(folder / "a.bin"),
        "folder": write_scan(folder / "scans" / "a.bin").parent,
        "recording": write_pcap(folder / "a.pcap", vlp16_packets(0.1)),
        "image": folder / "a.png",
    }


@pytest.mark.parametrize(
    ("command", "kind", "options", "said"),
    [
        *(
            (command, kind, options, said)
            for command in ("run", "info")
            for kind, of_others, said in (
                ("scan file", OF_RECORDINGS, " is for recordings, and "),
                ("folder", OF_RECORDINGS, " is for recordings, and "),
                ("recording", OF_SCAN_FILES, " is for scan files, and "),
                ("image", (*OF_SCANS, *OF_RECORDINGS, *OF_SCAN_FILES), " is for scans, and "),
            )
            for options in of_others
        ),
        *(("run", "image", options, " is for scans, and ") for options in OF_PERCEIVING),
        *(("run", kind, GATHERED, "--accumulate is for recordings, and ") for kind in ("scan file", "folder")),
        *(("run", "recording", options, "need --bag DIR") for options in ("--bag-storage mcap", "--bag-frame a")),
    ],
)
def test_an_option_of_no_use_is_refused(
    command: str, kind: str, options: str, said: str, tmp_path: Path, shell: Shell
) -> None:
    if kind == "image":
        pytest.importorskip("PIL")
    path = write_inputs(tmp_path)[kind]
    shown = " ".join(shell.err(command, path, *options.split()).split())
    assert (f"{said}{path}" if said.endswith("and ") else said) in shown
    if said == " is for scan files, and ":
        assert f"{path} is a recording; leave it out" in shown
    assert any(word.partition("=")[0] in shown for word in options.split() if word.startswith("--"))


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("scan file", {"topic": "10.0.0.1"}),
        ("folder", {"topic": "/points"}),
        ("recording", {"columns": ["x", "y", "z"]}),
        ("recording", {"origin_m": (1.0, 2.0, 3.0)}),
    ],
)
def test_so_does_the_library(kind: str, options: dict[str, Any], tmp_path: Path) -> None:
    said = r"topic \(--topic\) chooses|columns \(--columns\) are those of scan files|the origin is that of scan files"
    with pytest.raises(PointsError, match=said):
        next(iter(read_scans(write_inputs(tmp_path)[kind], **options)))


def test_packets_have_one_remission(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    path = write_pcap(tmp_path / "a.pcap", vlp16_packets(1.2))
    with pytest.raises(PointsError, match=r"no field 'ambient' .* hold one remission"):
        next(read_scans(path, remission_field="ambient"))
    assert len(next(read_scans(path, remission_field="intensity"))[1])


def test_a_url_that_cannot_be_reached_is_named(shell: Shell) -> None:
    pytest.importorskip("fsspec")
    assert "ftp://127.0.0.1:1/a.bin: " in shell.err("run", "ftp://127.0.0.1:1/a.bin")


@pytest.mark.parametrize("option", ["--mcap", "--static", "--bag"])
def test_a_url_is_no_place_for_a_file_of_this_computer(option: str, shell: Shell) -> None:
    said = f"{option}: s3://bucket/a is a URL; expected a path of this computer"
    assert said in shell.err("run", "a.bin", option, "s3://bucket/a")


@pytest.mark.parametrize("out", ["a.bin", "a.bin/below"])
def test_a_folder_that_cannot_be_made_is_named_with_its_option(
    out: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = write_scan(tmp_path / "a.bin")
    for option in ("--labels", "--labels-for=kitti"):
        assert run("run", scan, option, "--out", tmp_path / out) == 2
        assert f"--out {tmp_path / out}: the folder {tmp_path / out} cannot be made" in capsys.readouterr().err
    assert run("demo", "--out", tmp_path / out) == run("run", scan, "--movable", "--static", tmp_path / out) == 2
    assert capsys.readouterr().err.count(f"the folder {tmp_path / out} cannot be made") == 2


def test_a_read_only_folder_is_named_before_the_first_scan(
    tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan = write_scan(tmp_path / "a.bin")
    monkeypatch.setattr("os.access", lambda *_: False)
    for given in (("--labels", "--out", tmp_path), ("--movable", "--static", tmp_path)):
        assert f"the folder {tmp_path} is read-only" in shell.err("run", scan, *given, code=2)


@pytest.mark.parametrize(
    ("model", "options", "said"),
    [
        ("ssadnet", "--full-turn", "--full-turn needs a model of all sides, and ssadnet is none"),
        ("pointseg", "--boxes-from network", "--boxes-from network needs a detector, and pointseg is none"),
    ],
)
def test_options_of_another_model_are_refused(
    model: str, options: str, said: str, tmp_path: Path, shell: Shell
) -> None:
    arguments = ("--model", model, "--provider", "cpu", *options.split())
    assert said in shell.err("run", write_scan(tmp_path / "a.bin"), *arguments)
    assert said in shell.err("demo", *arguments)
