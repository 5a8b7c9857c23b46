"""``edgeperc doctor``: what is installed, what is missing, and whether what is needed works."""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from importlib import import_module, resources
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from .. import __version__
from ..errors import EdgepercError, MissingExtraError, SettingsError
from ..system.printable import many
from ..types.choices import DEFAULT_MODELS
from .arguments import Commands, add_command, options
from .output import one_line, print_columns, print_line

# Extras for work on edgeperc itself, and the builds of onnxruntime, of which one at a time can be installed.
_FOR_DEVELOPERS = ("docs", "test")
_BUILDS = ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "onnxruntime-openvino")
# Versions with a leak at each convolution on ARM processors with SME (pyproject.toml excludes them there).
_LEAKING = ("1.23.", "1.24.", "1.25.", "1.26.")
_REINSTALL = "pip install --force-reinstall edgeperc"


@dataclass(frozen=True)
class Finding:
    """One line of the report."""

    name: str  # what was examined, e.g. "cache folder"
    state: Literal["ok", "note", "broken"]  # "note": edgeperc works without it; "broken": it needs it
    found: str
    advice: str = ""  # a command or what to do; empty if nothing is to be done


def add_parser(commands: Commands) -> None:
    """Add ``doctor``."""
    parser = add_command(
        commands,
        "doctor",
        doctor_command,
        help="what is installed, what is missing and how to install it, and whether what is needed works",
        description="Examine this installation: versions, processor, compiled kernels, execution providers and their "
        "devices, caches, the files of the models, extras. The default models are opened and checked against their "
        "golden inputs. The exit code is 1 if something that edgeperc needs is missing or broken.",
        examples=["edgeperc doctor", "edgeperc doctor --json", "edgeperc doctor --clean"],
    )
    options(parser)(
        "--clean",
        "examine nothing; delete what edgeperc keeps on this computer: compiled kernels, compiled models and "
        "measured settings; nothing is left then for pip uninstall to leave behind",
    )
    options(parser, "output")("--json", "print one JSON object")


def doctor_command(arguments: argparse.Namespace) -> int:
    """Print what `examine` finds; 1 if something is broken. With ``--clean``, delete what is kept."""
    if arguments.clean:
        files = [*dict.fromkeys(kept_files(package_folders()))]  # NUMBA_CACHE_DIR may be the folder of kernels itself
        n_bytes = sum(file.lstat().st_size for file in files)
        for file in files:
            file.unlink()
        for folder in sorted({parent for file in files for parent in [*file.parents][:3]}, reverse=True):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        said = f"deleted {many(len(files), 'file')}, {n_bytes / 1e6:.1f} MB; the next start compiles again"
        print_line(json.dumps({"deleted": len(files), "bytes": n_bytes}) if arguments.json else said)
        return 0
    findings = [*examine()]
    broken = [finding for finding in findings if finding.state == "broken"]
    if arguments.json:
        print_line(json.dumps({"works": not broken, "findings": [asdict(finding) for finding in findings]}))
        return 1 if broken else 0
    marks = {"ok": "ok", "note": "-", "broken": "BROKEN"}
    print_columns(
        ("what", "", "found"),
        [(each.name, marks[each.state], each.found + (f"; {each.advice}" if each.advice else "")) for each in findings],
    )
    print_line("")
    if broken:
        print_line(f"{many(len(broken), 'fault')}: {', '.join(finding.name for finding in broken)}")
    else:
        print_line("What edgeperc needs is here and works.")
    return 1 if broken else 0


def package_folders() -> list[Path]:
    """The folders of the installed packages, beside whose sources kernels are kept."""
    found = (find_spec(name) for name in ("edgeperc", "edgeperc_bench", "edgeperc_export"))
    return [Path(spec.origin).parent for spec in found if spec is not None and spec.origin]


def kept_files(packages: Sequence[Path]) -> Iterator[Path]:
    """Every file that edgeperc keeps on this computer: kernels beside their sources, and those of its cache folder."""
    from ..system.machine import cache_folder, settings_path

    for package in packages:
        yield from package.rglob("__pycache__/*.kernel")
    if os.access(named := os.environ.get("NUMBA_CACHE_DIR", ""), os.R_OK):
        yield from Path(named).glob("*/*.kernel")
    try:
        cache = cache_folder()
    except SettingsError:  # there is no home folder
        return
    for part in ("kernels", "compiled"):
        files = (cache / part).rglob("*") if os.access(cache / part, os.R_OK) else ()
        yield from (file for file in files if file.is_file() or file.is_symlink())
    if os.access(settings_path(), os.F_OK) and settings_path().is_file():
        yield settings_path()


def examine() -> Iterator[Finding]:
    """Examine this installation and yield a `Finding` for each thing. Nothing is written but the caches."""
    checks: dict[str, Callable[[], Iterator[Finding]]] = {
        "edgeperc": _program,
        "processor": _processor,
        "packages": find_packages,
        "kernels": _kernels,
        "providers": _providers,
        "caches": _caches,
        "models": _models,
        "extras": find_extras,
    }
    for name, check in checks.items():
        try:
            yield from check()
        except Exception as exc:  # a broken package may raise anything, and the other checks still run
            yield _broken(name, exc)


def _broken(name: str, exc: BaseException, advice: str = "") -> Finding:
    kind = "" if isinstance(exc, EdgepercError) else f"{type(exc).__name__}: "
    return Finding(name, "broken", one_line(f"{kind}{exc}"), advice)


def _program() -> Iterator[Finding]:
    yield Finding("edgeperc", "ok", f"{__version__} in {Path(__file__).parent.parent}")
    yield Finding("python", "ok", f"{platform.python_implementation()} {platform.python_version()}, {sys.executable}")
    yield Finding("platform", "ok", f"{platform.platform()}, {platform.machine()}")


def _processor() -> Iterator[Finding]:
    from ..system.machine import cpu_features, cpu_model, usable_cores

    yield Finding("processor", "ok", f"{cpu_model()}, {usable_cores()} of {os.cpu_count()} cores usable")
    from ..zoo import BF16_FEATURES, INT8_FEATURES, SEVEN_BIT_FEATURES

    present = cpu_features()
    for precision, features in (("int8", INT8_FEATURES | SEVEN_BIT_FEATURES), ("bf16", BF16_FEATURES)):
        here = ", ".join(sorted(features & present))
        found = f"fast here ({here})" if here else "no instructions for it here; fp32 is used"
        yield Finding(precision, "ok" if here else "note", found)


def installed(prefix: str = "") -> dict[str, str]:
    """Version of each installed distribution whose name has this beginning."""
    versions: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        name = distribution.metadata["Name"]  # None if its folder is damaged
        if name and name.lower().replace("_", "-").startswith(prefix):
            versions.setdefault(name.lower().replace("_", "-"), distribution.version)
    return versions


def find_packages() -> Iterator[Finding]:
    """numpy, numba and the one build of onnxruntime."""
    # Compiled kernels need no numba. Where it is needed and missing, `_kernels` and `find_extras` say so.
    for name in ("numpy", *filter(find_spec, ("numba", "llvmlite"))):
        try:
            yield Finding(name, "ok", str(import_module(name).__version__))
        except Exception as exc:  # a wheel for another processor or numpy raises other errors than ImportError
            yield _broken(name, exc, f"pip install --force-reinstall {name}")
    from ..inference.providers import runtime_version

    versions = installed("onnxruntime")
    builds = [name for name in _BUILDS if name in versions]
    try:
        version = runtime_version()
    except MissingExtraError as exc:
        if builds and exc.__cause__ is not None:
            yield _broken("onnxruntime", exc.__cause__, f"pip install --force-reinstall {builds[0]}")
        else:
            yield Finding("onnxruntime", "broken", "not installed", "pip install 'edgeperc[cpu]'")
        return
    shown = ", ".join(f"{name} {versions[name]}" for name in sorted(versions)) or version
    if len(builds) > 1:
        both = f"{shown}: they overwrite one another"
        yield Finding("onnxruntime", "broken", both, f"pip uninstall {' '.join(builds)}, then install one")
    elif version.startswith(_LEAKING) and has_sme():
        leaks = f"{shown}: leaks memory at each convolution on this processor"
        yield Finding("onnxruntime", "note", leaks, "pip install 'onnxruntime>=1.27'")
    else:
        yield Finding("onnxruntime", "ok", shown)
    setting = os.environ.get("ORT_DISABLE_TELEMETRY")
    on = "not turned off: onnxruntime was imported before" if setting is None else f"ORT_DISABLE_TELEMETRY={setting}"
    yield Finding("telemetry", "ok", "off") if setting == "1" else Finding("telemetry", "note", on)


def has_sme() -> bool:
    """Whether the processor has the instructions with which some versions of onnxruntime leak."""
    from ..system.machine import cpu_features

    return "sme" in cpu_features() or (sys.platform == "darwin" and platform.machine() == "arm64")


def _kernels() -> Iterator[Finding]:
    import numpy as np

    from ..system.kernels import Kernel
    from ..types.frame import fill_moved
    from ..types.points import read_only

    moved = np.empty((1, 4), np.float32)
    started = time.perf_counter()
    fill_moved(read_only(np.ones((1, 4))), np.eye(3), np.ones(3), moved)
    took_s = time.perf_counter() - started
    if moved.tolist() != [[2.0, 2.0, 2.0, 1.0]]:
        yield Finding("kernels", "broken", f"a kernel gave {moved.tolist()}", "pip install --force-reinstall numba")
        return
    by_numba = fill_moved.by_numba if isinstance(fill_moved, Kernel) else fill_moved
    if by_numba is None:
        yield Finding("kernels", "ok", f"compiled when the package was built; loaded in {took_s:.1f} s")
        return
    cache = getattr(by_numba, "_cache", None)
    place = None if cache is None else cache.cache_path
    compiled = f"compiled or loaded in {took_s:.1f} s"
    if place is None:
        keep = "set NUMBA_CACHE_DIR to a folder that only you can write"
        yield Finding("kernels", "note", f"{compiled}; not kept, so that every start compiles again", keep)
    else:
        yield Finding("kernels", "ok", f"{compiled}; kept in {place}")


def _providers() -> Iterator[Finding]:
    from ..inference.listing import providers

    present = [provider.name for provider in providers() if provider.available]
    if not present:
        return  # without onnxruntime, which `find_packages` reports
    from ..inference.providers import PLUGINS, devices, is_available

    for short, package in PLUGINS.items():
        if short not in present and find_spec(package) is not None and not is_available(short):  # or does not load
            yield Finding(f"plugin {short}", "note", "installed, but finds no device on this computer")
    yield Finding("providers", "ok", f"{', '.join(present)}; 'edgeperc providers' says how to install others")
    yield Finding("devices", "ok", ", ".join(devices()) or "this version of onnxruntime does not list them")


def _caches() -> Iterator[Finding]:
    from ..system.machine import cache_folder, fingerprint, read_setting, settings_path, unsafe_because
    from ..zoo import digest, resolve

    try:
        folder = cache_folder()
    except SettingsError as exc:
        yield Finding("cache folder", "note", one_line(exc))
        return
    for name, inside in (("cache folder", ""), ("compiled models", "compiled"), ("compiled kernels", "kernels")):
        is_there = os.access(part := folder / inside, os.F_OK)  # False in the home of another user
        if part != folder and not is_there:
            continue
        reason = _unwritable(part) or (unsafe_because(part.stat()) if part != folder else None)
        found = f"{part}: {_size(part) if is_there else 'not made yet'}, {reason or 'writable'}"
        advice = "what is compiled anew is not kept; set EDGEPERC_CACHE_DIR to a folder that only you can write"
        yield Finding(name, "note", found, advice) if reason else Finding(name, "ok", found)
    try:
        measured = [read_setting(settings_path(), fingerprint(), digest(resolve(model))) for model in DEFAULT_MODELS]
    except SettingsError as exc:
        yield Finding("settings", "note", one_line(exc))
        return
    if all(measured):
        yield Finding("settings", "ok", f"{settings_path()}: the fastest of this computer")
    else:
        yield Finding("settings", "note", "nothing was measured here", "edgeperc-bench matrix --recommend")


def _unwritable(folder: Path) -> str | None:
    """Why files cannot be made in a folder, or the folder itself; None if they can."""
    place = next(path for path in (folder, *folder.parents) if os.access(path, os.F_OK))
    if not place.is_dir():
        return f"{place} is not a folder"
    return None if os.access(place, os.W_OK | os.X_OK) else f"{place} cannot be written"


def _size(folder: Path) -> str:
    files = [file for file in folder.rglob("*") if file.is_file() and not file.is_symlink()] if folder.is_dir() else []
    return f"{sum(file.stat().st_size for file in files) / 1e6:.1f} MB in {many(len(files), 'file')}"


def _models() -> Iterator[Finding]:
    from ..types.card import ModelCard

    folder = resources.files("edgeperc.zoo")
    sums = folder / "SHA256SUMS"
    listed = sums.read_text("utf-8").split() if sums.is_file() else []
    if not listed:
        yield Finding("SHA256SUMS", "note", "missing, so that the models' hashes are not compared", _REINSTALL)
    names = set()
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        if not entry.name.endswith(".onnx"):
            continue
        path = Path(str(entry))
        try:
            card = ModelCard.read(path)
        except EdgepercError as exc:
            yield _broken(f"model {path.name}", exc, _REINSTALL)
            continue
        sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
        names.add(card.name)
        if listed and sha256 not in listed:
            other = f"SHA-256 {sha256} is not in SHA256SUMS, so it is not the file of this release"
            yield Finding(f"model {path.name}", "broken", other, _REINSTALL)
        else:
            checked = "as in SHA256SUMS" if listed else "not compared"
            yield Finding(f"model {path.name}", "ok", f"{card.name} {card.version}, SHA-256 {sha256[:16]}... {checked}")
    for name in DEFAULT_MODELS:
        if name not in names:
            yield Finding(f"model {name}", "broken", "missing", _REINSTALL)
    yield from find_runs(names)


def find_runs(names: set[str]) -> Iterator[Finding]:
    """Whether the default models open and answer their golden inputs, with the provider that is chosen here."""
    from ..inference.session import Session

    for name in DEFAULT_MODELS:
        if name in names:
            try:
                yield Finding(f"runs {name}", "ok", Session(name).description)
            except MissingExtraError:  # `find_packages` reports it
                return
            except EdgepercError as exc:
                yield _broken(f"runs {name}", exc)


def find_extras() -> Iterator[Finding]:
    """What is installed of each extra."""
    try:
        metadata = importlib.metadata.metadata("edgeperc")
        requirement: Any = import_module("packaging.requirements").Requirement
    except importlib.metadata.PackageNotFoundError:
        yield Finding("extras", "note", "edgeperc was not installed by pip, so its extras are not known")
        return
    except ImportError:
        yield Finding("extras", "note", "not examined: that needs packaging, which comes with onnxruntime")
        return
    needed = [requirement(text) for text in metadata.get_all("Requires-Dist") or ()]
    versions = installed()
    for package, fault in _faults(needed, "", versions):
        yield Finding(package, "broken", fault, f"pip install '{package}'")
    present = []
    for extra in sorted(metadata.get_all("Provides-Extra") or ()):
        faults = _faults(needed, extra, versions)
        if not faults:
            present.append(extra)
        elif extra == "gpu" and "onnxruntime" in versions:
            yield Finding("extra gpu", "note", "in place of cpu", "'edgeperc providers' says how to install it")
        elif extra not in _FOR_DEVELOPERS:
            missing = ", ".join(dict.fromkeys(fault for _, fault in faults))
            yield Finding(f"extra {extra}", "note", missing, f"pip install 'edgeperc[{extra}]'")
    yield Finding("extras", "ok", ", ".join(present) or "none is complete")


def _faults(needed: list[Any], extra: str, versions: dict[str, str]) -> list[tuple[str, str]]:
    """Requirements of an extra, or of edgeperc itself, that are not met: each with what is wrong."""
    faults = []
    for requirement in needed:
        marker, package = requirement.marker, str(requirement).partition(";")[0].strip()
        of_extra = marker is not None and "extra" in str(marker)
        if of_extra != bool(extra) or (marker is not None and not marker.evaluate({"extra": extra})):
            continue
        name = requirement.name.lower().replace("_", "-")
        if name == "edgeperc":  # an extra that consists of others
            for other in sorted(requirement.extras):
                faults += _faults(needed, other, versions)
        elif name not in versions:
            faults.append((package, f"{name} is missing"))
        elif not requirement.specifier.contains(versions[name], prereleases=True):
            faults.append((package, f"{name} is {versions[name]}, expected {requirement.specifier}"))
    return faults
