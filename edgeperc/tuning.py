"""What a computer keeps between starts: the fastest setting that was measured for a model, and compiled models.

Everything lies in one folder, `cache_folder`; deleting it costs time, never an answer.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .atomic import write_atomic
from .errors import SettingsError

__all__ = [
    "cache_folder",
    "compiled_folder",
    "cpu_features",
    "cpu_model",
    "fingerprint",
    "read_setting",
    "settings_path",
    "write_settings",
]

SCHEMA = 2


def cache_folder() -> Path:
    """``$EDGEPERC_CACHE_DIR``, or ``edgeperc`` in the system's place for caches. Not made by asking."""
    given = os.environ.get("EDGEPERC_CACHE_DIR")
    if given:
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "edgeperc"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "edgeperc"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edgeperc"


def compiled_folder(engine: str, sha256: str, precision: str) -> Path | None:
    """A folder for what an engine makes of a model, which only that engine and that file will find again.

    None where nothing can be written there: the engine then compiles at every start.

    Parameters
    ----------
    engine : str
        With its versions; whatever it compiled for another one is stale.
    sha256 : str
        Of the model file.
    precision : str
    """
    name = hashlib.sha256(f"{engine} {fingerprint()} {precision}".encode()).hexdigest()[:16]
    try:
        folder = cache_folder() / "compiled" / f"{sha256[:16]}-{name}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return folder if os.access(folder, os.W_OK) else None


def cpu_model() -> str:
    """The processor's name."""
    return _cpuinfo("model name", "Hardware", "Model") or platform.processor() or platform.machine()


def cpu_features() -> frozenset[str]:
    """Flags of the processor as Linux names them, such as ``avx512_vnni``; empty where the system does not say."""
    if sys.platform == "darwin" and platform.machine() == "arm64":
        return frozenset({"asimddp"})  # every Apple processor multiplies bytes in dot products
    return frozenset(_cpuinfo("flags", "Features").split())


def _cpuinfo(*keys: str) -> str:
    """The first value of any of the keys; empty where there is none."""
    for line in (_text(Path("/proc/cpuinfo")) or "").splitlines():
        key, _, value = line.partition(":")
        if key.strip() in keys:
            return value.strip()
    return ""


def fingerprint() -> str:
    """A name for computers that are alike: 16 hexadecimal digits of CPU, board, architecture, cores and their quota."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    board, quota = (_text(Path(p)) for p in ("/sys/firmware/devicetree/base/model", "/sys/fs/cgroup/cpu.max"))
    told = [cpu_model(), board, platform.machine(), os.cpu_count(), usable, quota]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]


def _text(path: Path) -> str | None:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


def settings_path() -> Path:
    """Where ``edgeperc-bench matrix --recommend`` writes and ``Perceiver(provider="auto")`` reads."""
    return cache_folder() / "settings.json"


def write_settings(path: Path, machine: str, entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Put settings into a file, beside those of other computers and models, in place of older ones.

    Parameters
    ----------
    path : Path
        JSON: ``{"schema": 2, "machines": {fingerprint: {digest: entry}}}``; created if it does not exist.
    machine : str
        `fingerprint` of the computer they were measured on.
    entries : mapping
        A network's digest (`edgeperc.zoo.digest`) to ``provider``, ``precision`` and ``n_threads``, as
        `edgeperc.Perceiver` takes them, and any further keys.

    Raises
    ------
    SettingsError
        The file is there and is something else.
    """
    document: dict[str, Any] = _read(path) if path.exists() else {"schema": SCHEMA, "machines": {}}
    document["machines"].setdefault(machine, {}).update({sha: dict(entry) for sha, entry in entries.items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, (json.dumps(document, indent=1, sort_keys=True, allow_nan=False) + "\n").encode())


def read_setting(path: Path, machine: str, digest: str) -> dict[str, Any] | None:
    """The setting for a computer and a network; None if none was measured.

    Raises
    ------
    SettingsError
    """
    if not path.exists():
        return None
    entry = _read(path)["machines"].get(machine, {}).get(digest)
    if entry is None:
        return None
    if not isinstance(entry, dict) or not _is_setting(entry):
        raise SettingsError(
            f"{path} keeps {entry!r} of a model; expected a provider, a precision and n_threads; delete it"
        )
    return entry


def _is_setting(entry: Mapping[str, Any]) -> bool:
    n_threads = entry.get("n_threads")
    words = all(isinstance(entry.get(key), str) for key in ("provider", "precision"))
    return words and (n_threads is None or (isinstance(n_threads, int) and n_threads >= 1))


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as exc:
        raise SettingsError(f"{path} cannot be read as settings: {exc}; delete it, or name another file") from exc
    machines = document.get("machines") if isinstance(document, dict) else None
    if machines is None or document.get("schema") != SCHEMA or not isinstance(machines, dict):
        raise SettingsError(f"{path} holds no settings of schema {SCHEMA}; name another file, or delete it")
    if not all(isinstance(models, dict) for models in machines.values()):
        raise SettingsError(f"{path} holds no settings by model; name another file, or delete it")
    return document
