"""What a computer keeps between starts."""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeperc import SettingsError
from edgeperc.inference import session
from edgeperc.inference.session import Session
from edgeperc.system import machine
from edgeperc.zoo import digest, resolve
from strategies import JSON

CPU_2 = {"provider": "cpu", "precision": "int8", "n_threads": 2}
CPU_4 = {"provider": "cpu", "precision": "fp32", "n_threads": 4}
OPENVINO = {"provider": "openvino", "precision": "bf16", "n_threads": None}
CUDA = {"provider": "cuda", "precision": "fp32", "n_threads": 1}


def test_file_holds_settings_of_several_computers_and_models(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "settings.json"
    assert machine.read_setting(path, "m", "s") is None
    machine.write_settings(path, "m", {"s": CPU_2})
    machine.write_settings(path, "m", {"t": OPENVINO})
    machine.write_settings(path, "n", {"s": CUDA})
    machine.write_settings(path, "m", {"s": CPU_4})
    assert machine.read_setting(path, "m", "s") == CPU_4
    assert machine.read_setting(path, "m", "t") == OPENVINO
    assert machine.read_setting(path, "n", "t") is None
    assert [*path.parent.iterdir()] == [path]


@pytest.mark.parametrize(
    ("own", "files", "quota"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 1.5),  # of a container, version 2
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "a/cpu.max": "50000 100000", "cpu.max": "90000 100000"}, 0.5),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "a/cpu.stat": "nr_periods 9\nnr_throttled 3\n"}, None),
        ("0::/../c\n", {"cpu.max": "300000 100000"}, 3.0),
        (  # version 1: other controllers have files of other names, and -1 is no limit
            "4:memory:/m\n3:cpuset:/s\n2:cpu,cpuacct:/d/e\n0::/\n",
            {
                "cpu,cpuacct/d/e/cpu.cfs_quota_us": "-1",
                "cpu,cpuacct/d/e/cpu.cfs_period_us": "100000",
                "cpu,cpuacct/d/cpu.cfs_quota_us": "400000",
                "cpu,cpuacct/d/cpu.cfs_period_us": "200000",
                "cpu,cpuacct/d/cpu.stat": "nr_throttled 3\n",
                "cpuset/s/cpu.cfs_quota_us": "1",
                "cpuset/s/cpu.cfs_period_us": "1",
            },
            2.0,
        ),
        ("0::/\n", {"cpu.max": "1 0"}, None),
        ("nonsense", {"cpu.max": "many few"}, None),
        (None, {"cpu.max": "100000 100000"}, None),  # not Linux
    ],
)
def test_a_container_has_as_many_cores_as_its_limit_of_time(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, own: str | None, files: dict[str, str], quota: float | None
) -> None:
    for name, text in files.items():
        path = tmp_path / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    if own is not None:
        (tmp_path / "own").write_text(own)
    monkeypatch.setattr(machine, "CONTROL_GROUPS", tmp_path / "groups")
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "own")
    assert machine.cpu_quota() == quota
    assert machine.quota_pauses() == (3 if any("cpu.stat" in name for name in files) else None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {*range(64)}, raising=False)
    assert machine.usable_cores() == (64 if quota is None else max(1, math.ceil(quota)))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3}, raising=False)
    assert machine.usable_cores() == 1


@pytest.mark.parametrize(("cores", "of"), [(1, 8), (3, 8), (8, 8)])
def test_a_network_alone_has_no_more_threads_than_cores_that_are_usable(
    monkeypatch: pytest.MonkeyPatch, cores: int, of: int
) -> None:
    """A provider's own choice is made by the cores of the computer."""
    monkeypatch.setattr(session, "usable_cores", lambda: cores)
    monkeypatch.setattr(os, "cpu_count", lambda: of)
    for at_once in (1, 16):
        alone = Session("pointseg", "cpu", at_once=at_once)
        assert not alone.shares_cores
        assert alone.options["threads"] == ("the provider's choice" if cores == of else str(cores))
    assert Session("pointseg", "cpu", n_threads=5).options["threads"] == "5"


@pytest.mark.parametrize(
    "text",
    [
        *("[]", "{", '{"schema": 9, "machines": {}}', '{"schema": 2}', '{"schema": 2, "machines": {"m": 3}}'),
        '{"schema": 1, "machines": {"m": {"s": {"provider": "openvino:bf16", "n_threads": 2}}}}',
        '{"schema": 2, "machines": {"m": {"s": "cpu"}}}',
        '{"schema": 2, "machines": {"m": {"s": {"provider": 3, "precision": "fp32"}}}}',
        '{"schema": 2, "machines": {"m": {"s": {"provider": "cpu", "n_threads": 2}}}}',
        '{"schema": 2, "machines": {"m": {"s": {"provider": "cpu", "precision": "fp32", "n_threads": 0}}}}',
    ],
)
def test_malformed_settings_are_named(tmp_path: Path, text: str) -> None:
    path = tmp_path / "settings.json"
    path.write_text(text)
    with pytest.raises(SettingsError, match=r"settings\.json.*delete it"):
        machine.read_setting(path, "m", "s")


EDITS = st.lists(st.tuples(st.integers(0, 10_000), st.integers(0, 3), st.binary(min_size=1, max_size=6)), max_size=4)


def check_settings(path: Path, content: bytes) -> None:
    """Whatever a file holds, reading and writing give a setting that can be used, or a SettingsError."""
    path.write_bytes(content)
    entry, message = None, "delete it"
    try:
        entry = machine.read_setting(path, "m", "s")
    except SettingsError as exc:
        message = str(exc)
    else:
        assert entry is None or (isinstance(entry["provider"], str) and isinstance(entry["precision"], str))
        assert entry is None or entry["n_threads"] is None or 1 <= entry["n_threads"] <= machine.MAX_THREADS
    assert "delete it" in message
    assert len(message) < 1000
    try:
        machine.write_settings(path, "m", {"s": CPU_2})
    except SettingsError:
        assert path.read_bytes() == content
    else:
        assert machine.read_setting(path, "m", "s") == CPU_2


@given(EDITS)
def test_damaged_settings_have_a_typed_error(tmp_path_factory: pytest.TempPathFactory, edits: list[Any]) -> None:
    content = json.dumps({"schema": 2, "machines": {"m": {"s": CPU_2, "t": OPENVINO}, "n": {"s": CUDA}}}, indent=1)
    damaged = bytearray(content.encode())
    for at, kind, new in edits:
        at %= len(damaged) + 1
        if kind == 0:
            damaged[at : at + 1] = new  # replaced
        elif kind == 1:
            damaged[at:at] = new
        elif kind == 2:
            del damaged[at : at + len(new)]
        else:
            damaged = damaged[:at] or bytearray(b" ")
    check_settings(tmp_path_factory.getbasetemp() / "damaged.json", bytes(damaged))


@given(
    JSON,
    st.sampled_from(["document", "schema", "machines", "m", "s", "provider", "precision", "n_threads", "p50_ms"]),
)
def test_settings_of_other_types_have_a_typed_error(
    tmp_path_factory: pytest.TempPathFactory, value: object, where: str
) -> None:
    entry = {**CPU_2, where: value} if where in ("provider", "precision", "n_threads", "p50_ms") else CPU_2
    machines: object = {"m": value if where == "m" else {"s": value if where == "s" else entry}}
    document = {"schema": value if where == "schema" else 2, "machines": value if where == "machines" else machines}
    text = json.dumps(value if where == "document" else document)  # with NaN and Infinity, as Python writes them
    check_settings(tmp_path_factory.getbasetemp() / "other.json", text.encode())


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"[" * 200_000, id="deep"),
        pytest.param(b'{"schema": 2, "machines": {"m": ' + b'{"s":' * 900 + b"1" + b"}" * 902, id="deep entry"),
        pytest.param(
            b'{"schema": 2, "machines": {"x": {"s": ' + b"[" * 400 + b"]" * 400 + b"}}}", id="deep other entry"
        ),
        pytest.param(b'{"schema": 2, "machines": {"m": {"s": ' + b"9" * 10_000 + b"}}}", id="huge number"),
        pytest.param(b'{"schema": 2, "machines": {"x": {"s": 1e999}}}', id="infinite"),
        pytest.param(b" " * ((1 << 24) + 1), id="large"),
        pytest.param(b"\xff\xfe" * 100, id="utf-16"),
        pytest.param(b"\0" * 100, id="zeros"),
        pytest.param(b"", id="empty"),
    ],
)
def test_extreme_settings_have_a_typed_error(tmp_path: Path, content: bytes) -> None:
    check_settings(tmp_path / "settings.json", content)


@pytest.mark.parametrize("kind", ["folder", "pipe"])
def test_settings_that_are_no_file_are_named(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "settings.json"
    if kind == "folder":
        path.mkdir()
    elif os.name == "posix":
        os.mkfifo(path)  # reading it would wait for ever
    else:
        pytest.skip("no named pipes")
    with pytest.raises(SettingsError, match=r"settings\.json.*not a regular file.*delete it"):
        machine.read_setting(path, "m", "s")


@pytest.mark.parametrize("provider", ["\ud800", "\x1b[31m", "n" * 100_000])
def test_a_start_survives_strange_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str], provider: str
) -> None:
    """The log names what was skipped, in characters that every terminal can show."""
    pytest.importorskip("onnxruntime")
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    entry = {"provider": provider, "precision": "fp32", "n_threads": 1}
    machine.write_settings(machine.settings_path(), machine.fingerprint(), {digest(resolve("pointseg")): entry})
    assert Session("pointseg").card.name == "pointseg"
    assert "\x1b" not in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="no passwd")
def test_no_home_is_a_typed_error(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    for name in ("EDGEPERC_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError("Could not determine home directory.")))
    with pytest.raises(SettingsError, match="no home folder; set EDGEPERC_CACHE_DIR"):
        machine.settings_path()
    assert machine.compiled_folder("a", "f" * 64, "fp32") is None
    assert "the compiled model is not kept" in caplog.text


@pytest.mark.skipif(os.name != "posix", reason="Windows has access lists")
def test_compiled_models_that_others_can_write_are_not_used(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    umask = os.umask(0o022)
    folder = machine.compiled_folder("a", "f" * 64, "fp32")
    os.umask(umask)
    for each in (folder, folder.parent):
        each.chmod(0o777)
        assert machine.compiled_folder("a", "f" * 64, "fp32") is None
        assert "other users can write it (mode 777)" in caplog.messages[-1]
        each.chmod(0o755)
    assert machine.compiled_folder("a", "f" * 64, "fp32") == folder


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "here"))
    assert machine.cache_folder() == tmp_path / "here"
    assert machine.settings_path() == tmp_path / "here" / "settings.json"
    assert not (tmp_path / "here").exists()
    monkeypatch.delenv("EDGEPERC_CACHE_DIR")
    if sys.platform.startswith("linux"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert machine.cache_folder() == tmp_path / "edgeperc"


def test_compiled_folder_depends_on_engine_model_and_precision(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    asked = [("a 1", "f" * 64, "fp32"), ("a 2", "f" * 64, "fp32"), ("a 1", "e" * 64, "fp32"), ("a 1", "f" * 64, "bf16")]
    folders = [machine.compiled_folder(*each) for each in asked]
    assert len(set(folders)) == len(asked)
    assert all(folder is not None and folder.is_dir() for folder in folders)
    assert machine.compiled_folder(*asked[0]) == folders[0]
    monkeypatch.setattr(machine, "fingerprint", lambda: "another computer")
    assert machine.compiled_folder(*asked[0]) not in folders
    monkeypatch.setattr(os, "access", lambda *_: False)  # it is read-only
    assert machine.compiled_folder(*asked[0]) is None
    (tmp_path / "file").touch()
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert machine.compiled_folder(*asked[1]) is None


def test_a_compiled_model_that_is_damaged_is_compiled_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """OpenVINO loads it, and its labels are others: after a power failure, blocks of a new file may be zeros."""
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    folder = machine.compiled_folder("a", "f" * 64, "fp32")
    assert folder is not None
    # First as of a process that ended before it was noted; then whole; then damaged.
    for is_noted, damage, left in ((False, b"", []), (True, b"", ["1.blob", "sha256"]), (True, b"\0", [])):
        (folder / "1.blob").write_bytes(b"weights")
        if is_noted:
            machine.keep_compiled(folder)
        assert not caplog.messages
        with (folder / "1.blob").open("r+b") as blob:
            blob.write(damage)
        assert machine.compiled_folder("a", "f" * 64, "fp32") == folder
        assert sorted(file.name for file in folder.iterdir()) == left
    assert "is damaged, and is compiled again" in caplog.text


def test_equal_computers_have_one_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    assert machine.cpu_model()
    before = machine.fingerprint()
    assert len(before) == 16
    assert machine.fingerprint() == before
    monkeypatch.setattr(machine, "cpu_model", lambda: "another")
    assert machine.fingerprint() != before
