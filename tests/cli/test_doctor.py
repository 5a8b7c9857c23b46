"""``edgeperc doctor`` on installations that are whole, damaged or incomplete."""

from __future__ import annotations

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
from email.message import Message
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from cli_helpers import Shell
from edgeperc import zoo
from edgeperc.cli import doctor
from edgeperc.errors import ProviderError
from edgeperc.inference import providers
from edgeperc.system.kernel_cache import KernelCache
from edgeperc.system.kernels import Kernel
from edgeperc.types import frame

posix = pytest.mark.skipif(os.name != "posix", reason="Windows' folders have access lists")


RUNS = doctor.find_runs


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A cache of its own; only the tests of the models open them."""
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(doctor, "find_runs", lambda found: iter(()))


def report(shell: Shell, code: int = 1) -> dict[str, dict[str, str]]:
    """The findings by name."""
    (found,) = shell.records("doctor", code=code)
    assert found["works"] == (code == 0)
    return {finding.pop("name"): finding for finding in found["findings"]}


def broken(found: dict[str, dict[str, str]]) -> set[str]:
    return {name for name, finding in found.items() if finding["state"] == "broken"}


def test_an_installation_that_works(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(doctor, "find_runs", RUNS)
    monkeypatch.setenv("ORT_DISABLE_TELEMETRY", "1")
    found = report(shell, 0)
    assert broken(found) == set()
    assert {"python", "platform", "processor", "int8", "bf16", "numpy", "numba", "kernels", "cache folder"} <= {*found}
    assert "cpu" in found["providers"]["found"]
    assert found["telemetry"]["state"] == "ok"
    for name in zoo.DEFAULT:
        assert found[f"model {name}.onnx"]["found"].endswith("as in SHA256SUMS")
        assert name in found[f"runs {name}"]["found"]
    lines = shell.out("doctor").splitlines()
    for name in found:  # and "compiled models", if the first report made them
        assert any(line.startswith(f"{name}  ") for line in lines), name
    assert lines[-1] == "What edgeperc needs is here and works."


@pytest.mark.parametrize("package", ["numpy", "numba", "onnxruntime"])
def test_a_package_that_cannot_be_imported(package: str, tmp_path: Path) -> None:
    """In a process of its own, where nothing has imported it before."""
    (tmp_path / f"{package}.py").write_text("raise ImportError('libfoo.so.3: cannot open shared object file')\n")
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from edgeperc.cli import main; sys.exit(main(['doctor', '--json']))"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1, done.stderr
    found = {finding["name"]: finding for finding in json.loads(done.stdout)["findings"]}
    assert "libfoo.so.3" in found[package]["found"]
    assert found[package]["advice"].startswith("pip install ")
    assert found["python"]["state"] == "ok"
    assert package in broken(found)
    if package == "onnxruntime":
        assert broken(found) == {"onnxruntime"}
        assert found["model ssadnet.onnx"]["state"] == "ok"


def test_compiled_kernels_need_no_numba(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    function = frame.fill_moved.py_func
    forms = SimpleNamespace(get=lambda kinds, default: function)
    library: Any = SimpleNamespace(functions_of=lambda kernel: forms)
    monkeypatch.setattr(frame, "fill_moved", Kernel(library, {}, function))
    for package in ("numba", "llvmlite"):
        monkeypatch.setitem(sys.modules, package, None)
    found = report(shell, 0)
    assert "numba" not in found
    assert found["kernels"]["found"].startswith("compiled when the package was built")


def test_no_onnxruntime(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setattr(doctor, "installed", lambda prefix="": {})
    found = report(shell)
    missing = {"state": "broken", "found": "not installed", "advice": "pip install 'edgeperc[cpu]'"}
    assert found["onnxruntime"] == missing
    assert "BROKEN" in (out := shell.out("doctor", code=1))
    assert "onnxruntime" in out.splitlines()[-1]


@pytest.mark.parametrize(
    ("versions", "features", "state", "text"),
    [
        ({"onnxruntime": "1.31.1", "onnxruntime-gpu": "1.31.1"}, (), "broken", "overwrite one another"),
        ({"onnxruntime": "1.24.4"}, ("sme",), "note", "leaks memory"),
        ({"onnxruntime": "1.24.4"}, (), "ok", "onnxruntime 1.24.4"),
        ({"onnxruntime": "1.27.0"}, ("sme",), "ok", "onnxruntime 1.27.0"),
    ],
)
def test_builds_of_onnxruntime(
    versions: dict[str, str], features: tuple[str, ...], state: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(providers, "runtime_version", lambda: versions["onnxruntime"])
    monkeypatch.setattr(doctor, "installed", lambda prefix="": versions)
    monkeypatch.setattr(doctor, "has_sme", lambda: "sme" in features)
    found = {finding.name: finding for finding in doctor.find_packages()}["onnxruntime"]
    assert (found.state, text in found.found) == (state, True)


@pytest.mark.parametrize(
    ("value", "state", "text"), [("1", "ok", "off"), ("0", "note", "=0"), ("", "note", "imported")]
)
def test_telemetry(value: str, state: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(providers, "runtime_version", lambda: "1.31.1")
    monkeypatch.setenv("ORT_DISABLE_TELEMETRY", value)
    if not value:
        monkeypatch.delenv("ORT_DISABLE_TELEMETRY")
    found = {finding.name: finding for finding in doctor.find_packages()}["telemetry"]
    assert found.state == state
    assert text in found.found


def test_a_plugin_that_does_not_load_and_kernels_that_are_not_kept(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def broken(ort: object, short: str) -> Any:
        raise ProviderError("the plugin for provider 'webgpu' is installed but does not load: no symbol")

    monkeypatch.setattr(providers, "plugin_devices", broken)
    monkeypatch.setattr(providers, "PLUGINS", {"webgpu": "numpy"})
    monkeypatch.setattr(KernelCache, "cache_path", None)
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "file" / "cache"))
    found = report(shell)
    assert "does not load" in found["providers"]["found"]
    assert found["kernels"]["state"] == "note"
    assert "NUMBA_CACHE_DIR" in found["kernels"]["advice"]
    assert found["cache folder"]["state"] == "note"
    assert "is not a folder" in found["cache folder"]["found"]
    assert "EDGEPERC_CACHE_DIR" in found["cache folder"]["advice"]


@posix
def test_a_cache_that_others_can_write_with_settings_that_cannot_be_read(tmp_path: Path, shell: Shell) -> None:
    (tmp_path / "cache" / "compiled").mkdir(parents=True)
    (tmp_path / "cache" / "compiled" / "blob").write_bytes(bytes(2_000_000))
    (tmp_path / "cache" / "compiled").chmod(0o777)
    (tmp_path / "cache").chmod(0o775)  # as many systems make it; what lies in it is this user's alone
    (tmp_path / "cache" / "settings.json").write_text("no json")
    found = report(shell, 0)
    assert found["cache folder"]["state"] == "ok"
    assert "2.0 MB in 2 files, writable" in found["cache folder"]["found"]
    assert found["compiled models"]["state"] == "note"
    assert "other users can write it" in found["compiled models"]["found"]
    assert found["settings"]["state"] == "note"
    assert "cannot be read as settings" in found["settings"]["found"]


def test_a_home_of_another_user(tmp_path: Path, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    stat, refuse = Path.stat, Mock(side_effect=PermissionError(13, "Permission denied"))
    monkeypatch.setattr(Path, "stat", lambda path, **how: (refuse if tmp_path in path.parents else stat)(path, **how))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache" / "kernels"))
    assert "cache: not made yet" in report(shell, 0)["cache folder"]["found"]
    assert not [*doctor.kept_files([])]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the folder of the models, in its place."""
    folder = tmp_path / "zoo"
    folder.mkdir()
    source = Path(zoo.__file__).parent
    for file in (*source.glob("*.onnx"), source / "SHA256SUMS"):
        shutil.copy(file, folder)
    monkeypatch.setattr(doctor.resources, "files", lambda package: folder)
    return folder


def test_damaged_and_missing_models_and_sums(folder: Path, shell: Shell) -> None:
    content = bytearray((folder / "pointseg.onnx").read_bytes())
    content[len(content) // 2] ^= 1  # among the weights: the card can still be read
    (folder / "pointseg.onnx").write_bytes(content)
    (folder / "pointseg-int8.onnx").write_bytes(b"no model")
    for file in folder.glob("ssadnet*"):
        file.unlink()
    (folder / "SHA256SUMS").rename(folder / "sums")
    found = report(shell)
    assert found["SHA256SUMS"]["state"] == "note"
    assert found["model lodnn.onnx"]["found"].endswith("not compared")
    (folder / "sums").rename(folder / "SHA256SUMS")
    found = report(shell)
    assert "not the file of this release" in found["model pointseg.onnx"]["found"]
    assert {"model pointseg.onnx", "model pointseg-int8.onnx", "model ssadnet"} <= broken(found)
    assert found["model ssadnet"]["found"] == "missing"
    assert found["model lodnn.onnx"]["state"] == "ok"
    assert "pip install" in found["model pointseg.onnx"]["advice"]


REQUIRES = (
    "numpy>=1.24",
    'onnxruntime>=1.18; extra == "cpu"',
    'onnxruntime-gpu>=1.18; extra == "gpu"',
    'matplotlib>=3.8; extra == "view"',
    'winonly>=1; sys_platform == "nowhere" and extra == "view"',
    'rosbags>=0.9; extra == "ros"',
    'edgeperc[ros,view]; extra == "both"',
    'rosbags; extra == "both"',
    'sphinx; extra == "docs"',
)


def extras(monkeypatch: pytest.MonkeyPatch, versions: dict[str, str]) -> dict[str, doctor.Finding]:
    pytest.importorskip("packaging")
    metadata = Message()
    for text in REQUIRES:
        metadata["Requires-Dist"] = text
    for extra in ("both", "cpu", "docs", "gpu", "ros", "view"):
        metadata["Provides-Extra"] = extra
    monkeypatch.setattr(importlib.metadata, "metadata", lambda name: metadata)
    monkeypatch.setattr(doctor, "installed", lambda prefix="": versions)
    return {finding.name: finding for finding in doctor.find_extras()}


def test_missing_extras_come_with_the_line_that_installs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    found = extras(monkeypatch, {"numpy": "2.1", "onnxruntime": "1.31", "matplotlib": "3.9"})
    assert found["extras"].found == "cpu, view"
    for extra in ("ros", "both"):
        of_extra = found[f"extra {extra}"]
        assert (of_extra.found, of_extra.advice) == ("rosbags is missing", f"pip install 'edgeperc[{extra}]'")
    assert "providers" in found["extra gpu"].advice
    assert {*found} == {"extra both", "extra gpu", "extra ros", "extras"}


def test_versions_that_are_too_old(monkeypatch: pytest.MonkeyPatch) -> None:
    found = extras(monkeypatch, {"numpy": "1.20", "matplotlib": "3.7.5", "rosbags": "0.11"})
    assert found["numpy>=1.24"].state == "broken"
    assert found["numpy>=1.24"].found == "numpy is 1.20, expected >=1.24"
    assert found["extra view"].state == "note"
    assert found["extra view"].found == "matplotlib is 3.7.5, expected >=3.8"
    assert found["extras"].found == "ros"


def test_a_package_that_pip_did_not_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def metadata(name: str) -> Any:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "metadata", metadata)
    (found,) = doctor.find_extras()
    assert (found.name, found.state) == ("extras", "note")


@pytest.mark.parametrize("kept", ["beside", "cache", "numba", "one folder", "nothing"])
def test_clean_leaves_nothing_of_edgeperc_and_all_of_others(
    kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shell: Shell
) -> None:
    package, cache = tmp_path / "edgeperc", tmp_path / "cache"
    own = {
        "beside": [package / "ground/__pycache__/planes.f-0123456789abcdef.kernel"],
        "cache": [cache / "kernels/ground-0/a.kernel", cache / "compiled/b/c/blob", cache / "settings.json"],
        "numba": [tmp_path / "numba/ground-0/a.kernel"],
        "one folder": [cache / "kernels/ground-0/a.kernel"],
        "nothing": [],
    }[kept]
    others = [package / "ground/planes.py", package / "ground/__pycache__/planes.pyc", tmp_path / "numba/x/y.nbc"]
    for file in (*own, *others):
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"123")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache / "kernels" if kept == "one folder" else tmp_path / "numba"))
    monkeypatch.setattr(doctor, "package_folders", lambda: [package])
    assert f"deleted {len(own)} file" in shell.out("doctor", "--clean")
    left = {file for file in tmp_path.rglob("*") if file.is_file()}
    assert left == {*others}
    assert not cache.exists()
    assert shell.records("doctor", "--clean")[0] == {"deleted": 0, "bytes": 0}


def test_the_packages_are_where_they_are_imported_from() -> None:
    assert Path(str(zoo.__file__)).parents[1] / "edgeperc" in doctor.package_folders()
