"""What ``make test-arm`` does on this computer, and what edgeperc reads of an ARM processor."""

from __future__ import annotations

import copy
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from arm import __main__ as program
from arm import answers
from arm.compare import COLUMNS, MAX_UNLIKE, compare, read, unlike_boxes, unlike_values
from arm.environment import CPUS, cpuinfo

from checkout import REPOSITORY
from edgeperc.inference.session import golden_input
from edgeperc.simulation.samples import simulated_scan
from edgeperc.system import machine
from edgeperc.zoo import DEFAULT, choose, model_path, resolve

BOX = {"label": "car", "score": 0.9, "center": [10.0, 2.0, -1.0], "size": [4.0, 1.6, 1.5], "yaw": 3.14, "front": None}


@pytest.fixture
def show_cpuinfo(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A function that sets what /proc/cpuinfo holds; the board has no name, as on servers."""
    monkeypatch.setattr(sys, "platform", "linux")

    def show(text: str) -> None:
        monkeypatch.setattr(machine, "read_text", lambda path: text if path == Path("/proc/cpuinfo") else None)

    return show


@pytest.mark.parametrize(("cpu", "expected"), [("cortex-a53", "fp32"), ("neoverse-n1", "int8"), ("max", "int8")])
def test_int8_is_taken_with_dot_products_only(show_cpuinfo: Any, cpu: str, expected: str) -> None:
    show_cpuinfo(cpuinfo(cpu))
    for model in DEFAULT:
        assert choose(resolve(model), "cpu", "auto", machine.cpu_features())[1] == expected


def test_arm_processors_without_a_name_have_different_fingerprints(show_cpuinfo: Any) -> None:
    prints = set()
    for cpu, (part, _) in CPUS.items():
        show_cpuinfo(cpuinfo(cpu))
        assert machine.cpu_model() == f"ARM implementer 0x41 part {part}"
        prints.add(machine.fingerprint())
    assert len(prints) == len(CPUS)
    big_and_little = cpuinfo("neoverse-n1") + "\n" + cpuinfo("cortex-a53") * 2
    show_cpuinfo(big_and_little)
    assert machine.cpu_model() == "ARM implementer 0x41 part 0xd03, ARM implementer 0x41 part 0xd0c"
    show_cpuinfo(f"{big_and_little}\nModel\t\t: Raspberry Pi 5 Model B Rev 1.0")
    assert machine.cpu_model() == "Raspberry Pi 5 Model B Rev 1.0"
    # A hypervisor is unknown there.
    for text, known in ((cpuinfo("neoverse-n1"), None), ("flags\t: fpu vme", False), ("flags\t: fpu hypervisor", True)):
        show_cpuinfo(text)
        assert machine.has_hypervisor() is known


@pytest.mark.parametrize(
    ("change", "unlike"),
    [
        ({}, 0),
        ({"yaw": -3.14}, 0),  # 0.003 rad apart
        ({"center": [10.05, 2.0, -1.0], "score": 0.91, "size": [4.05, 1.6, 1.5]}, 0),
        ({"label": "van"}, 2),
        ({"score": 0.95}, 2),
        ({"center": [10.0, 2.2, -1.0]}, 2),
        ({"size": [4.0, 1.6, 1.8]}, 2),
        ({"yaw": 3.0}, 2),
    ],
)
def test_boxes_have_a_counterpart(change: dict[str, Any], unlike: int) -> None:
    other = BOX | {"center": [30.0, 2.0, -1.0]}
    assert unlike_boxes([BOX, other], [other, BOX | change]) == unlike
    assert unlike_boxes([BOX, BOX], [BOX | change]) == unlike + 1
    assert unlike_boxes([], [BOX]) == unlike_boxes([BOX], []) == 1


def test_what_is_missing_differs() -> None:
    here = {"fp32 points scan0": np.zeros(900, np.uint8), "fp32 points scan1": np.zeros(100, np.uint8)}
    changed = {**here, "fp32 points scan1": np.arange(100, dtype=np.uint8) % 2}
    assert unlike_values((here, {}), (here, {}), "fp32 points ") == (0, 1000)
    assert unlike_values((changed, {}), (here, {}), "fp32 points ") == (50, 1000)
    assert unlike_values(({"fp32 points scan0": np.zeros(900)}, {}), (here, {}), "fp32 points ") == (100, 1000)
    assert unlike_values(({"fp32 points scan0": np.zeros(9)}, {}), (here, {}), "fp32 points ") == (1000, 1000)
    assert unlike_values((here, {}), (here, {}), "int8 points ") == (0, 0)


def test_answers_of_one_computer_agree_and_changed_ones_do_not(tmp_path: Path) -> None:
    source, scans, networks = (tmp_path / f"{name}.npz" for name in ("source", "scans", "networks"))
    np.savez(source, scan0=simulated_scan(5 * 10**9 + 1).points)
    answers.main("scans", str(source), str(scans))
    answers.main("networks", str(scans), str(networks))
    seen, ran = read(scans), read(networks)
    assert seen[1]["boxes"]["int8 scan0"]
    auto = ran[1]["auto"]
    rows, faults = compare("x", seen, seen, "scans", auto)
    more, none = compare("x", ran, ran, "networks", auto)
    assert not faults + none
    assert {len(row) for row in rows + more} == {len(COLUMNS)}
    assert [row[2] for row in rows + more] == 2 * ["points", "cells", "boxes"] + 2 * ["pixels"]

    changed = copy.deepcopy(seen)
    labels = changed[0]["int8 points scan0"]
    labels[: int(2 * MAX_UNLIKE * len(labels))] += 1
    del changed[1]["boxes"]["fp32 scan0"][0]
    faults = compare("x", seen, changed, "scans", auto)[1]
    assert [fault.split(":")[0] for fault in faults] == ["x, fp32", "x, int8"]
    assert "precision auto took" in compare("x", ran, ran, "networks", dict.fromkeys(auto, "bf16"))[1][0]
    empty: Any = {}, {"boxes": {}, "auto": auto}
    assert len(compare("x", seen, empty, "scans", auto)[1]) == 6
    assert len(compare("x", empty, empty, "scans", auto)[1]) == 6  # nothing was compared


def test_the_tests_that_run_on_arm_are_there() -> None:
    assert [path for path in program.TESTS if not path.is_file()] == []


def test_without_qemu_it_is_skipped_with_the_line_that_installs_it(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.arm", "--out", str(tmp_path / "arm")]
    own = {**os.environ, "PATH": str(tmp_path)}
    done = subprocess.run(command, cwd=REPOSITORY, env=own, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("SKIPPED: no qemu-aarch64")
    assert "apt-get install qemu-user" in done.stdout
    assert not (tmp_path / "arm").exists()


def test_signed_activations_give_the_same_outputs(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    import onnxruntime
    from arm.instructions import write_signed

    shipped, signed = model_path("pointseg:int8"), tmp_path / "signed.onnx"
    write_signed(shipped, signed)
    kinds = [{w.data_type for w in onnx.load(str(file)).graph.initializer} for file in (shipped, signed)]
    assert kinds[0] - kinds[1] == {onnx.TensorProto.UINT8}
    sessions = [
        onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"]) for file in (shipped, signed)
    ]
    given = {each.name: golden_input(0, tuple(each.shape)) for each in sessions[0].get_inputs()}
    one, other = (session.run(None, given)[0] for session in sessions)
    assert one.std() > 0.1
    # Kernels of the two kinds round otherwise: 0.03 here.
    assert np.quantile(np.abs(one - other), 0.99) < 0.1 * one.std()
