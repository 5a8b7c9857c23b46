"""Data cached on this computer: the fastest measured setting of each model, and compiled models.

Everything is in one folder, `cache_folder`. It can be deleted: the next start takes longer, the results stay the same.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import platform
import reprlib
import stat
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import SettingsError
from .atomic import write_atomic

logger = logging.getLogger(__name__)

SCHEMA = 2
MAX_BYTES = 1 << 24  # of a settings file; an entry has about 200
MAX_THREADS = 4096
DIGEST = "sha256"  # the file with the `_digest_of` a compiled model
CONTROL_GROUPS, OWN_GROUPS = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def cache_folder() -> Path:
    """``$EDGEPERC_CACHE_DIR``, or ``edgeperc`` in the system's cache folder; not created by this call."""
    given = os.environ.get("EDGEPERC_CACHE_DIR")
    if given:
        return Path(given)
    name = {"win32": "LOCALAPPDATA", "darwin": ""}.get(sys.platform, "XDG_CACHE_HOME")
    system = os.environ.get(name)
    try:
        if not system:
            inside = {"win32": "AppData/Local", "darwin": "Library/Caches"}.get(sys.platform, ".cache")
            system = str(Path.home() / inside)
    except RuntimeError as exc:
        raise SettingsError("this user has no home folder; set EDGEPERC_CACHE_DIR to a folder") from exc
    return Path(system) / "edgeperc"


def unsafe_because(status: os.stat_result) -> str | None:
    """Why compiled code in a file or folder may come from another user; None if only this user or root can write it,
    and on Windows, where the user's folders have access lists.
    """
    if not hasattr(os, "geteuid"):
        return None
    if status.st_uid not in (0, os.geteuid()):
        return f"it belongs to user {status.st_uid}, this process to user {os.geteuid()}"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"other users can write it (mode {stat.S_IMODE(status.st_mode):o}); run chmod go-w"
    return None


def unusable_because(folder: Path) -> str | None:
    """Why a folder of compiled code is not used: other users could write it, or replace it; None if it may be used."""
    for each in (folder, folder.parent):
        try:
            status = each.stat()
        except OSError:
            continue  # it does not exist, so it holds nothing
        reason = unsafe_because(status) if stat.S_ISDIR(status.st_mode) else "it is not a folder"
        if reason is not None:
            return reason if each == folder else f"in {each}, {reason}"
    return None


def make_folder(folder: Path) -> None:
    """Create a folder of compiled code, and the one it is in, which only this user can write."""
    folder.parent.mkdir(0o755, parents=True, exist_ok=True)  # the mode, lessened by the umask, is of the last one only
    folder.mkdir(0o755, exist_ok=True)


def compiled_folder(engine: str, sha256: str, precision: str) -> Path | None:
    """Create the folder for the compiled form of a model, separate for each engine, its version, file and precision.

    None if there is no folder that this user can write and other users cannot. The engine then compiles at every start,
    and a warning in the log says so.
    """
    name = hashlib.sha256(f"{engine} {fingerprint()} {precision}".encode()).hexdigest()[:16]
    try:
        folder = cache_folder() / "compiled" / f"{sha256[:16]}-{name}"
        make_folder(folder)
        reason = unusable_because(folder)
        if reason is None and os.access(folder, os.W_OK):
            _remove_damaged(folder)
            return folder
        message = f"{folder}: {reason or 'it cannot be written'}"
    except (OSError, SettingsError) as exc:
        message = str(exc)
    logger.warning("the compiled model is not kept, and every start compiles it again: %s", message)
    return None


def _remove_damaged(folder: Path) -> None:
    """Remove files that are not as `keep_compiled` saw them: OpenVINO would compute with damaged weights."""
    kept = read_text(folder / DIGEST)
    if kept != _digest_of(folder):
        for file in folder.iterdir():
            file.unlink(missing_ok=True)
        if kept is not None:
            logger.warning("the compiled model in %s is damaged, and is compiled again", folder)


def keep_compiled(folder: Path) -> None:
    """Note what an engine has written to a `compiled_folder`, which the next start compares."""
    try:
        if (digest := _digest_of(folder)) != read_text(folder / DIGEST):
            write_atomic(folder / DIGEST, digest.encode())
    except OSError as exc:
        logger.warning("the compiled model is not kept, and the next start compiles it again: %s", exc)


def _digest_of(folder: Path) -> str:
    """SHA-256 of the files of a compiled model."""
    contents = [file.read_bytes() for file in sorted(folder.iterdir()) if DIGEST not in file.name]
    return hashlib.sha256(b"".join(hashlib.sha256(content).digest() for content in contents)).hexdigest()


def cpu_model() -> str:
    """The processor's name."""
    return _cpuinfo("model name", "Hardware", "Model") or _arm_cores() or platform.processor() or platform.machine()


def cpu_features() -> frozenset[str]:
    """Flags of the processor as Linux names them, such as ``avx512_vnni``; empty if the system does not list them."""
    if sys.platform == "darwin" and platform.machine() == "arm64":
        return frozenset({"asimddp"})  # every Apple processor multiplies bytes in dot products
    return frozenset(_cpuinfo("flags", "Features").split())


def usable_cores() -> int:
    """Number of processor cores that this process may use: that it may run on, and whose time its container gives it.

    With more threads than that, all of them stand still for the rest of each period in which the limit is reached.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, math.ceil(cpu_quota() or cores)))


def has_hypervisor() -> bool | None:
    """Whether this is a virtual machine; None where the processor does not tell, as on ARM."""
    flags = _cpuinfo("flags")
    return "hypervisor" in flags.split() if flags else None


def board() -> str | None:
    """The name of the board; None on computers without one."""
    return read_text(Path("/sys/firmware/devicetree/base/model"))


def cpu_quota() -> float | None:
    """The strictest limit of CPU time of this process' control groups, in cores; None without a limit."""
    limits = []
    for folder, files in _control_groups():
        words = " ".join(read_text(folder / name) or "" for name in files).split()
        if len(words) == 2 and all(word.isdecimal() and int(word) > 0 for word in words):  # else "max", or -1
            limits.append(int(words[0]) / int(words[1]))
    return min(limits, default=None)


def quota_pauses() -> int | None:
    """How often a limit of CPU time has paused this process' control groups; None where nothing counts it."""
    stats = [(read_text(folder / "cpu.stat") or "").splitlines() for folder, _ in _control_groups()]
    counts = [int(line.split()[1]) for lines in stats for line in lines if line.startswith("nr_throttled ")]
    return sum(counts) if counts else None


def _control_groups() -> Iterator[tuple[Path, Sequence[str]]]:
    """The folders of this process' control groups for CPU time, and the names of their files with a limit."""
    for line in (read_text(OWN_GROUPS) or "").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, group = rest.partition(":")
        if controllers and "cpu" not in controllers.split(","):
            continue
        # A container may see its own group as the root; a group is limited by those around it, too.
        for place in (PurePosixPath(group), *PurePosixPath(group).parents):
            files = ("cpu.cfs_quota_us", "cpu.cfs_period_us") if controllers else ("cpu.max",)
            yield CONTROL_GROUPS / controllers / str(place).lstrip("/"), files


def _cpuinfo(*keys: str) -> str:
    """The first value of any of the keys; empty if there is none."""
    for line in (read_text(Path("/proc/cpuinfo")) or "").splitlines():
        key, _, value = line.partition(":")
        if key.strip() in keys:
            return value.strip()
    return ""


def _arm_cores() -> str:
    """Numbers of the kinds of cores, which Linux shows on ARM in place of a name; empty on other processors."""
    lines = [line.partition(":") for line in (read_text(Path("/proc/cpuinfo")) or "").splitlines()]
    makers, parts = ([v.strip() for k, _, v in lines if k.strip() == key] for key in ("CPU implementer", "CPU part"))
    # A processor may have cores of several kinds.
    kinds = sorted({*zip(makers, parts, strict=False)})
    return ", ".join(f"ARM implementer {maker} part {part}" for maker, part in kinds)


def fingerprint() -> str:
    """Identify this kind of computer: 16 hexadecimal digits from CPU, board, architecture, cores and CPU quota."""
    properties = [cpu_model(), board(), platform.machine(), os.cpu_count(), usable_cores(), cpu_quota()]
    return hashlib.sha256(json.dumps(properties).encode()).hexdigest()[:16]


def read_text(path: Path) -> str | None:
    """A file of the system, without blanks at its ends; None if it cannot be read."""
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return None


def settings_path() -> Path:
    """The file that ``edgeperc-bench matrix --recommend`` writes and ``Perceiver(provider="auto")`` reads."""
    return cache_folder() / "settings.json"


def write_settings(path: Path, machine: str, entries: Mapping[str, Mapping[str, Any]]) -> None:
    """Add settings to a file. They replace older ones of the same computer and model; others stay.

    path : JSON: ``{"schema": 2, "machines": {fingerprint: {digest: entry}}}``; created if it does not exist.
    entries : a network's digest (`edgeperc.zoo.digest`) to ``provider``, ``precision`` and ``n_threads``, as
        `edgeperc.Perceiver` takes them, and any further keys.
    """
    document = _read(path) or {"schema": SCHEMA, "machines": {}}
    document["machines"].setdefault(machine, {}).update({sha: dict(entry) for sha, entry in entries.items()})
    try:
        text = json.dumps(document, indent=1, sort_keys=True, allow_nan=False)
    except RecursionError as exc:
        raise SettingsError(f"{path} is nested too deeply for settings; delete it, or name another file") from exc
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, f"{text}\n".encode())


def read_setting(path: Path, machine: str, digest: str) -> dict[str, Any] | None:
    """Read the setting for a computer (`fingerprint`) and a network (`edgeperc.zoo.digest`).

    Returns: ``provider``, ``precision``, ``n_threads`` and further keys; None if nothing was measured.
    """
    document = _read(path)
    entry = None if document is None else document["machines"].get(machine, {}).get(digest)
    if entry is None:
        return None
    if not isinstance(entry, dict) or not _is_setting(entry):
        raise SettingsError(
            f"{path} has the entry {reprlib.repr(entry)} for a model; expected a provider, a precision and n_threads, "
            f"at most {MAX_THREADS}; delete it"
        )
    return entry


def _is_setting(entry: Mapping[str, Any]) -> bool:
    n_threads = entry.get("n_threads", 0)
    are_names = all(isinstance(entry.get(key), str) for key in ("provider", "precision"))
    is_timed = type(entry.get("p50_ms", 0.0)) in (int, float)
    return are_names and is_timed and (n_threads is None or (type(n_threads) is int and 1 <= n_threads <= MAX_THREADS))


def _read(path: Path) -> dict[str, Any] | None:
    """The document; None if there is no file."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError("it is not a regular file")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ValueError(f"it has more than {MAX_BYTES:,} bytes")
        document = json.loads(content, parse_constant=_finite, parse_float=_finite)
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as exc:
        raise SettingsError(f"{path} cannot be read as settings: {exc}; delete it, or name another file") from exc
    machines = document.get("machines") if isinstance(document, dict) else None
    if machines is None or document.get("schema") != SCHEMA or not isinstance(machines, dict):
        raise SettingsError(f"{path} holds no settings of schema {SCHEMA}; name another file, or delete it")
    if not all(isinstance(models, dict) for models in machines.values()):
        raise SettingsError(f"{path} holds no settings by model; name another file, or delete it")
    return document


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError(f"{text} is not a number of JSON")
    return number
