"""What a computer keeps between starts."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from edgeperc import SettingsError
from edgeperc import tuning as settings
from edgeperc.tuning import (
    cache_folder,
    compiled_folder,
    cpu_model,
    fingerprint,
    read_setting,
    settings_path,
    write_settings,
)

CPU_2 = {"provider": "cpu", "precision": "int8", "n_threads": 2}
CPU_4 = {"provider": "cpu", "precision": "fp32", "n_threads": 4}
OPENVINO = {"provider": "openvino", "precision": "bf16", "n_threads": None}
CUDA = {"provider": "cuda", "precision": "fp32", "n_threads": 1}


def test_file_holds_settings_of_several_computers_and_models(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "settings.json"
    assert read_setting(path, "m", "s") is None
    write_settings(path, "m", {"s": CPU_2})
    write_settings(path, "m", {"t": OPENVINO})
    write_settings(path, "n", {"s": CUDA})
    write_settings(path, "m", {"s": CPU_4})
    assert read_setting(path, "m", "s") == CPU_4
    assert read_setting(path, "m", "t") == OPENVINO
    assert read_setting(path, "n", "t") is None
    assert [*path.parent.iterdir()] == [path]


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
        read_setting(path, "m", "s")


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "here"))
    assert cache_folder() == tmp_path / "here"
    assert settings_path() == tmp_path / "here" / "settings.json"
    assert not (tmp_path / "here").exists()
    monkeypatch.delenv("EDGEPERC_CACHE_DIR")
    if sys.platform.startswith("linux"):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert cache_folder() == tmp_path / "edgeperc"


def test_compiled_folder_depends_on_engine_model_and_precision(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    asked = [("a 1", "f" * 64, "fp32"), ("a 2", "f" * 64, "fp32"), ("a 1", "e" * 64, "fp32"), ("a 1", "f" * 64, "bf16")]
    folders = [compiled_folder(*each) for each in asked]
    assert len(set(folders)) == len(asked)
    assert all(folder is not None and folder.is_dir() for folder in folders)
    assert compiled_folder(*asked[0]) == folders[0]
    monkeypatch.setattr(settings, "fingerprint", lambda: "another computer")
    assert compiled_folder(*asked[0]) not in folders


def test_read_only_cache_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert compiled_folder("a", "f" * 64, "fp32") is None
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert compiled_folder("a", "f" * 64, "fp32") is None


def test_equal_computers_have_one_fingerprint(monkeypatch: pytest.MonkeyPatch) -> None:
    assert cpu_model()
    assert len(fingerprint()) == 16
    assert fingerprint() == fingerprint()
    before = fingerprint()
    monkeypatch.setattr(settings, "cpu_model", lambda: "another")
    assert fingerprint() != before
