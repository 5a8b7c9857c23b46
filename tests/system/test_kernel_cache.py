"""Compiled kernels on disk: damage, other users, full and missing folders never stop a start."""

from __future__ import annotations

import compileall
import errno
import importlib.util
import json
import logging
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import FunctionType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import llvmlite
import numba
import numpy as np
import pytest
import tiny_camera
from numba.core import serialize
from numba.core.caching import FunctionCache
from numba.core.codegen import CPUCodegen, CPUCodeLibrary, JitEngine
from numba.core.compiler import CompileResult

from checkout import REPOSITORY, printed
from edgeperc.system import kernel_cache, kernel_stamp, machine
from edgeperc.system.machine import unsafe_because

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled with the JIT off")

SOURCE = """
import llvmlite
import numba
import numpy as np
from edgeperc.system.kernel_cache import njit

@njit(cache=True, nogil=True)
def squared(x):
    return x * x

@njit(cache=True, nogil=True)
def total(values):
    found = 0.0
    for k in range(values.shape[0]):
        found += squared(values[k])
    return found
"""
VALUES = np.arange(5.0)
ANSWER = 30.0


class Place:
    """A folder of kernels, used as by one new process after another."""

    def __init__(self, source: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
        self.source, self._caplog, self._monkeypatch = source, caplog, monkeypatch

    def start(self) -> tuple[list[str], int]:
        """Load the kernels and call one; return the warnings and the number of compilations."""
        self._monkeypatch.setattr(kernel_cache, "reported", set())
        self._caplog.clear()
        module = self.load()
        assert module.total(VALUES) == ANSWER
        n_compiled = sum(sum(kernel.stats.cache_misses.values()) for kernel in (module.total, module.squared))
        warnings = [r.getMessage() for r in self._caplog.records if r.levelno >= logging.WARNING]
        return warnings, n_compiled

    def load(self) -> Any:
        """The module, as by a new process."""
        spec: Any = importlib.util.spec_from_file_location("some_kernels", self.source)
        module = importlib.util.module_from_spec(spec)
        self._monkeypatch.setitem(sys.modules, "some_kernels", module)
        spec.loader.exec_module(module)
        return module

    @property
    def files(self) -> list[Path]:
        """What lies in the folder given by ``NUMBA_CACHE_DIR``."""
        folder = Path(numba.config.CACHE_DIR)
        return sorted(path for path in folder.rglob("*") if not path.is_dir())


@pytest.fixture
def empty(tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    """Before the first start."""
    source = tmp_path / "package" / "some_kernels.py"
    source.parent.mkdir(mode=0o755)
    source.write_text(SOURCE)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    caplog.set_level(logging.INFO, logger="edgeperc.system.kernel_cache")
    umask = os.umask(0o022)
    yield Place(source, caplog, monkeypatch)
    os.umask(umask)


@pytest.fixture(scope="module")
def compiled() -> dict[str, bytes]:
    """The files that a first start leaves, by their names: it takes 0.15 s, and most tests begin with the second."""
    return {}


@pytest.fixture
def place(empty: Place, compiled: dict[str, bytes]) -> Place:
    """After the first start."""
    if not compiled:
        assert empty.start() == ([], 2)
        compiled.update({file.name: file.read_bytes() for file in empty.files})
        return empty
    folder = next(empty.load().total._cache.folders())
    folder.mkdir(0o755, parents=True)
    for name, content in compiled.items():
        (folder / name).write_bytes(content)
    return empty


def flipped(at: int) -> Callable[[bytes], bytes]:
    def flip(content: bytes) -> bytes:
        damaged = bytearray(content)
        damaged[at % len(content)] ^= 1 << at % 8
        return bytes(damaged)

    return flip


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    **{f"cut to {n}": lambda content, n=n: content[:n] for n in (0, 31, 64, 1000)},
    "cut in half": lambda content: content[: len(content) // 2],
    "without its last byte": lambda content: content[:-1],
    "one byte longer": lambda content: content + b"\0",
    "twice": lambda content: content * 2,
    "zeros": lambda content: bytes(len(content)),
    "text": lambda _: b"not machine code\n" * 100,
    "random": lambda content: np.random.default_rng(0).bytes(len(content)),
    **{f"bit flipped at {at}": flipped(at) for at in [0, 31, 32, 63, 64, *range(101, 8000, 3000)]},
}


def test_the_second_start_compiles_nothing(empty: Place) -> None:
    assert empty.start() == ([], 2)
    assert [file.name[:19] for file in empty.files] == ["some_kernels.square", "some_kernels.total-"]
    assert empty.start() == ([], 0)


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_reported_once_and_compiled_again(place: Place, damage: str) -> None:
    files = place.files
    for file in files:
        content = file.read_bytes()
        file.write_bytes(DAMAGE[damage](content))
        assert file.read_bytes() != content
    (warning,), n_compiled = place.start()
    assert re.search(r"the compiled kernel .*some_kernels.* cannot be used and is compiled again: ValueError", warning)
    assert n_compiled == 2
    assert place.start() == ([], 0)
    assert place.files == files


def test_folder_in_place_of_a_file_is_reported(place: Place) -> None:
    file = place.files[1]
    file.unlink()
    file.mkdir()
    for _ in range(2):
        warnings, n_compiled = place.start()
        assert n_compiled == 1
        assert str(file) in warnings[0]
        assert "compiled kernels are not kept" in warnings[1]
    assert not [each for each in place.files if each.suffix == ".part"]


@pytest.mark.parametrize("fault", ["ValueError", "PermissionError", "other users can write it (mode 666)"])
def test_one_file_that_cannot_be_used_costs_one_compilation(
    place: Place, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    file, opened = place.files[1], Path.open

    def refuse(self: Path, *arguments: Any, **options: Any) -> Any:
        if self == file and arguments == ("rb",):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(self))
        return opened(self, *arguments, **options)

    if fault == "ValueError":
        file.write_bytes(b"")
    elif fault == "PermissionError":  # root reads every file: so the error of another user's is put in its place
        monkeypatch.setattr(Path, "open", refuse)
    elif os.name == "posix":  # put there before the folder's mode was corrected
        file.chmod(0o666)
    else:
        pytest.skip("Windows has access lists")
    (warning,), n_compiled = place.start()
    assert str(file) in warning
    assert fault in warning
    assert n_compiled == 1
    monkeypatch.setattr(Path, "open", opened)
    assert place.start() == ([], 0)  # it was replaced


def test_an_edited_kernel_replaces_its_file_and_those_of_its_callers(place: Place) -> None:
    names = [file.name for file in place.files]
    # Of different lengths: Python reads a source again only if its size or its second of change differs.
    for edit, n_compiled in (("x * x * 1.0", 2), ("x * 1.00 * x", 2), ("x * x", 2)):
        place.source.write_text(SOURCE.replace("x * x", edit))
        assert place.start() == ([], n_compiled)
        assert place.start() == ([], 0)
        assert [file.name for file in place.files] == names
    place.source.write_text(SOURCE.replace("found = 0.0", "found = -0.0"))
    assert place.start() == ([], 1)


def test_edits_of_comments_and_dates_change_nothing(place: Place) -> None:
    place.source.write_text("# A comment.\n" + SOURCE.replace("    return x * x", "    return x * x  # as a float"))
    os.utime(place.source, (0, 0))
    assert place.start() == ([], 0)


def test_what_is_compiled_after_an_edit_is_of_the_imported_source(place: Place) -> None:
    place.start()
    whole = VALUES.astype(np.int64)
    place.source.write_text(SOURCE.replace("x * x", "2 * x * x"))
    assert sys.modules["some_kernels"].total(whole) == ANSWER  # as imported
    with pytest.raises(AssertionError, match=r"60\.0 == 30\.0"):
        place.start()
    assert sys.modules["some_kernels"].total(whole) == 2.0 * ANSWER


def test_each_signature_has_its_file(place: Place) -> None:
    place.start()
    module = sys.modules["some_kernels"]
    for dtype in (np.float32, np.int64, np.float64):
        assert module.total(VALUES.astype(dtype)) == ANSWER
    assert len([file for file in place.files if "total" in file.name]) == 3


def test_functions_of_one_name_are_not_confused(place: Place) -> None:
    place.source.write_text(
        SOURCE
        + "def times(factor):\n"
        + "    @njit(cache=True)\n"
        + "    def product(x):\n"
        + "        return factor * x\n"
        + "    return product\n"
        + "@njit(cache=True)\ndef shifted(x):\n    return x + 1.0\n"
        + "up = shifted\n"
        + "@njit(cache=True)\ndef shifted(x):\n    return x - 1.0\n"
    )
    for _ in range(2):
        place.start()
        module = sys.modules["some_kernels"]
        assert [module.times(factor)(5.0) for factor in (2.0, 3.0, 2.0)] == [10.0, 15.0, 10.0]
        assert (module.up(1.0), module.shifted(1.0), module.up(1.0)) == (2.0, 0.0, 2.0)


def status(**changed: int) -> Any:
    return SimpleNamespace(**{"st_uid": 1000, "st_mode": 0o40755, **changed})


@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="Windows has access lists")
def test_code_of_other_users_is_unsafe(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine.os, "geteuid", lambda: 1000)
    assert unsafe_because(status()) is None
    assert unsafe_because(status(st_uid=0)) is None
    assert unsafe_because(status(st_mode=0o40700)) is None
    assert unsafe_because(status(st_uid=1001)) == "it belongs to user 1001, this process to user 1000"
    for mode in (0o40775, 0o40757, 0o41777, 0o100666):
        assert f"(mode {mode & 0o7777:o}); run chmod go-w" in str(unsafe_because(status(st_mode=mode)))


@pytest.mark.skipif(os.name != "posix", reason="Windows has access lists")
@pytest.mark.parametrize("why", ["outer mode 777", "mode 777", "mode 775", "belongs to user"])
def test_a_folder_of_others_is_not_used(place: Place, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """What lies there is not loaded, and nothing is put there, until it is this user's alone."""
    folder = place.files[0].parent.parent if why.startswith("outer") else place.files[0].parent
    before = [(file, file.stat().st_mtime_ns) for file in place.files]
    with monkeypatch.context() as patch:
        if "mode" in why:
            folder.chmod(int(why[-3:], 8))
        elif os.geteuid() == 0:
            os.chown(folder, 54321, -1)
        else:
            patch.setattr(machine.os, "geteuid", lambda: 54321)
        for _ in range(2):
            (warning,), n_compiled = place.start()
            assert n_compiled == 2
            assert re.search(rf"compiled kernels are not kept.*{why.removeprefix('outer ')}", warning)
    assert [(file, file.stat().st_mtime_ns) for file in place.files] == before
    if os.geteuid() == 0:
        os.chown(folder, 0, -1)
    folder.chmod(0o755)
    assert place.start() == ([], 0)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES])
def test_disk_that_takes_nothing_is_reported(empty: Place, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    monkeypatch.setattr(kernel_cache, "write_atomic", Mock(side_effect=OSError(code, os.strerror(code))))
    (warning,), n_compiled = empty.start()
    assert n_compiled == 2
    assert os.strerror(code) in warning
    assert "set NUMBA_CACHE_DIR to a folder" in warning


def test_full_disk(empty: Place, small_disk: Callable[[int], Path]) -> None:
    folder = small_disk(32)
    (folder / "filler").write_bytes(bytes(28 << 10))
    numba.config.CACHE_DIR = str(folder / "cache")  # the fixture resets it
    (warning,), n_compiled = empty.start()
    assert n_compiled == 2
    assert os.strerror(errno.ENOSPC) in warning
    assert not empty.files


@pytest.fixture
def without_setting(empty: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Place:
    """Not ``NUMBA_CACHE_DIR`` but the package's and the user's folder."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "user"))
    return empty


def test_kernels_lie_beside_their_source(without_setting: Place) -> None:
    folder = without_setting.source.parent / "__pycache__"
    assert without_setting.start() == ([], 2)
    assert len([*folder.glob("*.kernel")]) == 2
    assert sys.modules["some_kernels"].total.stats.cache_path == str(folder)
    assert without_setting.start() == ([], 0)


@pytest.mark.parametrize("why", ["no folder", "others can write it"])
def test_users_folder_is_used_if_the_packages_cannot_be(without_setting: Place, tmp_path: Path, why: str) -> None:
    folder = without_setting.source.parent / "__pycache__"
    if why == "no folder":
        folder.write_bytes(b"")
    elif os.name == "posix":
        folder.mkdir()
        folder.chmod(0o777)
    else:
        pytest.skip("Windows has access lists")
    os.umask(0o002)  # with which some systems make folders that the user's group can write
    assert without_setting.start() == ([], 2)
    assert without_setting.start() == ([], 0)
    assert len([*(tmp_path / "user" / "kernels").glob("package-*/*.kernel")]) == 2


def test_a_read_only_package_is_named_only_if_it_holds_the_kernel(
    without_setting: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    folder = without_setting.source.parent / "__pycache__"
    without_setting.start()
    cache = sys.modules["some_kernels"].total._cache
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder and access(path, mode))
    assert cache.cache_path == str(folder)
    for file in folder.glob("*.kernel"):
        file.unlink()
    assert Path(cache.cache_path).is_relative_to(tmp_path / "user")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert cache.cache_path is None


@pytest.mark.parametrize("home", ["read-only", "none"])
def test_a_read_only_package_and_no_home_are_reported(
    without_setting: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, home: str
) -> None:
    (without_setting.source.parent / "__pycache__").write_bytes(b"")
    if home == "none":
        for name in ("EDGEPERC_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
            monkeypatch.delenv(name, raising=False)
        monkeypatch.setattr(Path, "home", Mock(side_effect=RuntimeError("Could not determine home directory.")))
    else:
        (tmp_path / "user").write_bytes(b"")
    named = [without_setting.source.parent, *[tmp_path / "user"] * (home != "none")]
    stat, refuse = Path.stat, Mock(side_effect=PermissionError(13, "Permission denied"))
    with monkeypatch.context() as patch:  # folders as in the home of another user
        patch.setattr(Path, "stat", lambda path, **how: (stat if path.suffix else refuse)(path, **how))
        assert len(kernel_cache.missing([without_setting.load().total])) == 1
    for _ in range(2):
        (warning,), n_compiled = without_setting.start()
        assert n_compiled == 2
        assert "compiled kernels are not kept" in warning
        assert all(str(folder) in warning for folder in named)


def refusing(owner: Any, name: str, error: type[Exception]) -> Callable[..., Any]:
    """An internal of numba that fails for the cache alone; numba itself calls it too."""
    original = getattr(owner, name)

    def call(*arguments: Any, **options: Any) -> Any:
        if sys._getframe(1).f_globals["__name__"] == kernel_cache.__name__:
            raise error("another numba")
        return original(*arguments, **options)

    return call


@pytest.mark.parametrize(
    ("owner", "name", "error"),
    [
        (CPUCodeLibrary, "_get_module_for_linking", AttributeError),
        (CompileResult, "_reduce", AssertionError),
        (serialize, "dumps", pickle.PicklingError),
    ],
)
def test_a_kernel_that_numba_cannot_write_is_compiled_at_every_start(
    empty: Place, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, error: type[Exception]
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, refusing(owner, name, error))
        (warning,), n_compiled = empty.start()
    assert n_compiled == 2
    assert f"{error.__name__}: another numba" in warning
    assert not empty.files
    assert empty.start() == ([], 2)


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (type(numba.core.runtime.rtsys), "initialize"),
        (CompileResult, "_rebuild"),
        (numba.core.sigutils, "normalize_signature"),
        (pickle, "loads"),  # of a numba that was changed without another version number
    ],
)
def test_a_file_that_numba_cannot_load_is_compiled_again(
    place: Place, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, refusing(owner, name, AttributeError))
        warnings, n_compiled = place.start()
    assert n_compiled == 2
    assert "AttributeError: another numba" in warnings[0]
    assert place.start() == ([], 0)


CALLER = """
import numpy as np
from edgeperc.system.kernel_cache import njit
from . import constants
from .callee import SHARE, share, table

@njit(cache=True, nogil=True)
def answer(x):
    return share(x) + SHARE + table[1] + constants.OFFSET
"""
CALLEE = """
import numpy as np
from edgeperc.system.kernel_cache import njit
from .constants import FACTOR, SCALES, Kind

SHARE = 0.25
table = np.array([0.0, 0.0])

@njit(cache=True, nogil=True)
def share(x):
    return x * FACTOR + SCALES[1] + Kind.ONE.value
"""
CONSTANTS = """
import enum

FACTOR = 1.0
OFFSET = 0.0
SCALES = (0.0, 0.0)

class Kind(enum.IntEnum):
    ONE = 0
"""
RUN = """
import sys
sys.path.insert(0, sys.argv[1])
from kernels.caller import answer, share
print(float(answer(1.0)), answer.stats.cache_misses.total(), share.stats.cache_misses.total())
"""


def start(folder: Path) -> subprocess.Popen[str]:
    settings = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "-c", RUN, str(folder)]
    return subprocess.Popen(command, env=settings, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def outcome(process: subprocess.Popen[str]) -> tuple[float, list[int], list[str]]:
    """What a process answers, whether it compiled the caller and the callee, and the lines on standard error."""
    out, err = process.communicate()
    assert process.returncode == 0, err
    answer, *n_compiled = out.split()
    return float(answer), [*map(int, n_compiled)], err.splitlines()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "kernels"
    folder.mkdir(0o755)
    sources = {"__init__": "", "caller": CALLER, "callee": CALLEE, "constants": CONSTANTS}
    for name, source in sources.items():
        (folder / f"{name}.py").write_text(source)
    return tmp_path


@pytest.fixture
def imported_anew(package: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[float, int]]:
    """What a new process that imports the package from a folder answers, and the number of callers that it compiled."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(package / "cache"))

    def anew(folder: Path = package) -> tuple[float, int]:
        for name in ("", ".caller", ".callee", ".constants"):
            monkeypatch.delitem(sys.modules, f"kernels{name}", raising=False)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(folder)
            answer = import_module("kernels.caller").answer
        return float(answer(1.0)), sum(answer.stats.cache_misses.values())

    return anew


def test_a_kernel_sees_what_other_modules_define(package: Path, imported_anew: Callable[..., Any]) -> None:
    """numba freezes it into the caller, whose own source does not change, nor do the dates of the files."""
    assert imported_anew() == (1.25, 1)
    assert imported_anew() == (1.25, 0)
    for module, old, new, answer in (
        ("callee", "SHARE = 0.25", "SHARE = 0.75", 1.75),  # a constant of another module
        ("callee", "[0.0, 0.0]", "[0.0, 2.0]", 3.25),  # an array
        ("callee", "x * FACTOR", "x + x * FACTOR", 2.25),  # a kernel
        ("constants", "FACTOR = 1.0", "FACTOR = 3.0", 3.25),  # a constant of the kernel called
        ("constants", "OFFSET = 0.0", "OFFSET = 7.0", 8.25),  # a module's attribute
        ("constants", "(0.0, 0.0)", "(0.0, 0.5)", 1.75),  # a tuple
        ("constants", "ONE = 0", "ONE = 4", 5.25),  # an enumeration
    ):
        file = package / "kernels" / f"{module}.py"
        status, source = file.stat(), file.read_text()
        assert source.count(old) == 1
        file.write_text(source.replace(old, new))
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
        assert imported_anew() == (answer, 1), new
        file.write_text(source)
        os.utime(file, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert imported_anew() == (1.25, 1)


WITHOUT_DOCSTRINGS = SimpleNamespace(**{name: getattr(sys.flags, name) for name in dir(sys.flags)} | {"optimize": 2})


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (numba.config, "BOUNDSCHECK", 1),
        (numba.config, "OPT", type(numba.config.OPT)(1)),
        (numba.config, "CPU_NAME", "generic"),
        (sys, "flags", WITHOUT_DOCSTRINGS),
    ],
)
def test_settings_and_processors_have_files_of_their_own(
    place: Place, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, value: object
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, value)
        assert place.start() == ([], 2)
        assert place.start() == ([], 0)
    assert place.start() == ([], 0)
    assert len(place.files) == 4


def test_another_version_of_what_compiles_has_another_stamp(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    for part in (numba.__version__, llvmlite.__version__, np.__version__, sys.version):
        assert part in kernel_stamp.versions()
    with monkeypatch.context() as patch:
        patch.setattr(kernel_stamp, "versions", lambda: "another")
        assert place.start() == ([], 2)
    assert place.start() == ([], 2)


def test_kernels_in_an_archive_are_kept(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, imported_anew: Callable[..., Any]
) -> None:
    packed = Path(shutil.make_archive(str(tmp_path / "packed"), "zip", package, "kernels"))
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setenv("EDGEPERC_CACHE_DIR", str(tmp_path / "user"))
    for n_compiled in (1, 0):
        assert imported_anew(packed) == (1.25, n_compiled)
    assert sys.modules["kernels"].__file__ == str(packed / "kernels" / "__init__.py")


def test_kernels_without_sources_are_kept(package: Path, imported_anew: Callable[..., Any]) -> None:
    assert imported_anew() == (1.25, 1)
    assert compileall.compile_dir(package / "kernels", legacy=True, quiet=1)
    for file in (package / "kernels").glob("*.py"):
        file.unlink()
    assert imported_anew() == (1.25, 0)
    assert sys.modules["kernels"].__file__ == str(package / "kernels" / "__init__.pyc")


def test_a_constant_set_after_the_import_is_not_kept_for_others(place: Place) -> None:
    place.source.write_text(SOURCE.replace("x * x", "FACTOR * x * x") + "\nFACTOR = 1.0\n")
    place.start()
    module: Any = sys.modules["some_kernels"]
    module.FACTOR = 3.0
    assert module.total(VALUES.astype(np.int64)) == 3.0 * ANSWER
    assert len(place.files) == 2
    assert place.start() == ([], 0)
    assert sys.modules["some_kernels"].total(VALUES.astype(np.int64)) == ANSWER


def test_a_value_without_a_digest_is_named(place: Place) -> None:
    place.source.write_text(SOURCE.replace("x * x", "x * x if x in WHAT else x * x") + "\nWHAT = iter([1.0])\n")
    kernel_cache.reported.clear()
    module = place.load()
    with pytest.raises(TypeError, match="squared reads WHAT, a list_iterator, which has no digest"):
        kernel_stamp.stamp_of(module.total)
    assert kernel_stamp.called_by(module.squared) == ()
    assert not module.total._cache.is_missing()


@pytest.mark.parametrize("other", [slice(1, 2), slice(0, 3), slice(0, 2, 1), slice(None, 2), (0, 2, None)])
def test_slices_have_a_digest(other: object) -> None:
    # Since Python 3.14, they are constants of a function's code.
    code = compile("PART", "part", "eval")
    first, again, changed = (
        kernel_stamp.stamp_of(FunctionType(code, {"PART": value})) for value in (slice(0, 2), slice(0, 2), other)
    )
    assert first == again != changed


STAMPS = """
import json, pkgutil, sys
from importlib import import_module
from numba.core.dispatcher import Dispatcher
import edgeperc
from edgeperc.system.kernel_cache import KernelCache
names = [m.name for m in pkgutil.walk_packages(edgeperc.__path__, "edgeperc.") if not m.name.endswith("__main__")]
print(json.dumps({
    f"{name}.{key}": (thing._cache.stamp() or b"").hex() if isinstance(thing._cache, KernelCache) else "not kept"
    for name in names
    for key, thing in vars(import_module(name)).items()
    if isinstance(thing, Dispatcher) and thing.py_func.__module__ == name
}))
"""


def test_every_kernel_of_edgeperc_is_kept_here_with_the_same_stamp_in_every_process() -> None:
    here, elsewhere = (json.loads(printed(STAMPS, env=os.environ | {"PYTHONHASHSEED": seed})) for seed in "12")
    assert len(here) > 80
    assert [name for name, stamp in here.items() if stamp == "not kept"] == [], "import njit from kernel_cache"
    assert elsewhere == here


def test_the_internals_of_numba_that_are_used_exist() -> None:
    """With a numba that moves one, kernels are compiled at every start. Then raise the bound in pyproject.toml."""
    library, engine = CPUCodeLibrary, JitEngine
    used = [
        (numba.core.compiler.DefaultPassBuilder, "define_nopython_pipeline"),
        (numba.core.compiler, "PassManager"),
        (numba.core.compiler.PassManager, "add_pass"),
        (numba.core.compiler.PassManager, "finalize"),
        (numba.core.config, "CACHE_DIR"),
        *((numba.core.config, name) for name in kernel_stamp.SETTINGS),
        (type(numba.core.runtime.rtsys), "initialize"),
        (serialize, "dumps"),
        (numba.core.sigutils, "normalize_signature"),
        (CompileResult, "_reduce"),
        (CompileResult, "_rebuild"),
        (CompileResult, "codegen"),
        (library, "has_dynamic_globals"),
        (library, "_get_module_for_linking"),
        (CPUCodegen, "magic_tuple"),
        (engine, "is_symbol_defined"),
    ]
    assert [f"{owner.__name__}.{name}" for owner, name in used if not hasattr(owner, name)] == []
    kernel: Any = numba.njit(lambda x: x)
    assert {"_cache", "py_func", "targetoptions"} <= {*dir(kernel)}
    assert kernel(1) == 1
    (result,) = kernel.overloads.values()
    assert isinstance(result.codegen._engine._defined_symbols, set)
    assert hasattr(result.library, "_shared_module")


def test_the_bound_of_numba_is_stated_once_and_holds() -> None:
    """`make test-newest` tests the versions above it."""
    text = "\n".join(
        (REPOSITORY / name).read_text("utf-8") for name in ("pyproject.toml", "setup.py", "recipe/recipe.yaml")
    )
    bounds = re.findall(r"numba ?>=[\d.]+,<(\d+\.\d+)", text)
    assert len(bounds) == 3
    (bound,) = {*bounds}
    version = [int(part) for part in numba.__version__.split(".")[:2]]
    assert version < [int(part) for part in bound.split(".")]


def test_caches_of_other_libraries_are_untouched(place: Place) -> None:
    with place.source.open("a") as source:
        source.write("@numba.njit(cache=True)\ndef tripled(x):\n    return 3.0 * x\n")
    place.start()
    other = sys.modules["some_kernels"].tripled
    assert type(other._cache) is FunctionCache
    assert other(2.0) == 6.0
    assert {file.suffix for file in place.files if "tripled" in file.name} == {".nbi", ".nbc"}


def test_processes_that_start_together_leave_what_another_loads(
    package: Path, imported_anew: Callable[..., Any]
) -> None:
    found = [outcome(process) for process in [start(package) for _ in range(2)]]
    assert [(answer, lines) for answer, _, lines in found] == [(1.25, [])] * 2
    assert imported_anew() == (1.25, 0)
    assert sum(sys.modules["kernels.caller"].share.stats.cache_misses.values()) == 0


LOADED = """
import sys
from pathlib import Path

sys.path.insert(0, sys.argv[1])
import numpy as np
import some_kernels

assert some_kernels.total(np.arange(5.0)) == 30.0
print(some_kernels.total.stats.cache_misses.total(), "numba.np.arraymath" in sys.modules)
"""


def test_cached_kernels_load_without_the_compiler_which_is_there_when_one_is_missing(place: Place) -> None:
    def started() -> str:
        environment = os.environ | {"NUMBA_CACHE_DIR": numba.config.CACHE_DIR}
        return printed(LOADED, place.source.parent, env=environment).strip()

    (called, caller) = place.files
    caller.unlink()  # it is compiled again, with the one that it calls from the cache
    assert started() == "1 True"
    called.unlink()
    assert started() == "0 False"


def test_a_second_start_imports_no_compiler_of_array_functions_no_scipy_and_no_tracker() -> None:
    """A kernel with ``np.sum`` or ``np.argmax`` would import the two when it is loaded: 0.2 s more of 0.4 s."""
    code = """
import sys
from edgeperc import Perceiver
Perceiver(provider="cpu", n_threads=1)
unused = {"edgeperc.simulation", "edgeperc.tracking", "scipy.linalg", "numba.np.arraymath", "numba.np.linalg"}
print(sorted(unused & set(sys.modules)))
"""
    for _ in range(2):  # the first start may compile
        answer = printed(code)
        if answer.strip() == "[]":
            break
    assert answer.strip() == "[]"


CALLS = """
import itertools, json, os, pkgutil, sys, warnings
from importlib import import_module

import numpy as np
from numba.core.dispatcher import Dispatcher

import edgeperc
from edgeperc import Box, Perceiver, Tracker, road_ahead

warnings.simplefilter("ignore")  # some scans are unlike the training scans
# Rings of a road around the vehicle, and the rears of some cars.
turn, down = np.meshgrid(np.linspace(-np.pi, np.pi, 900, endpoint=False), np.radians(np.linspace(1.2, 24.9, 60)))
radius = 1.73 / np.tan(down)
columns = radius * np.cos(turn), radius * np.sin(turn), np.full_like(turn, -1.73), 0.3 + 0.1 * np.sin(turn)
points = np.stack(columns, -1).reshape(-1, 4).astype(np.float32)
for k in range(6):
    rear = (points[:, 0] > 8 + 5 * k) & (abs(points[:, 1] - 6 + 2 * k) < 0.9)
    points[rear, 0], points[rear, 2] = 8 + 5 * k, np.linspace(-1.7, 0, rear.sum())
names = [m.name for m in pkgutil.walk_packages(edgeperc.__path__, "edgeperc.") if not m.name.endswith("__main__")]
kernels = {
    f"{name}.{key}": thing
    for name in names
    for key, thing in vars(import_module(name)).items()
    if isinstance(thing, Dispatcher) and thing.py_func.__module__ == name
}

def snapshot():
    return {name: len(kernel.signatures) for name, kernel in kernels.items()}

def perceptions(options):
    perceive = Perceiver(**options, provider="cpu", n_threads=1, on_mismatch="warn")
    yield
    fields = np.zeros(len(points), [("x", "f4"), ("y", "f4"), ("z", "f4"), ("intensity", "u1")])
    for k, name in enumerate("xyz"):
        fields[name] = points[:, k]
    shapes = [
        points.copy(), np.frombuffer(points.tobytes(), np.float32).reshape(-1, 4), np.asfortranarray(points),
        points[::2], points[:, ::-1][:, ::-1], points.astype(np.float64), points.astype(">f4"), points[:, :3],
        points.astype(np.int16), fields, points[:1], points[:0], points[:1].tolist(),
        np.where(np.arange(len(points))[:, None] % 7, points, np.nan).astype(np.float32),
        np.frombuffer(b"x" + points.tobytes(), np.float32, offset=1).reshape(-1, 4), points * np.float32(1e6),
        points - np.float32([0, 0, 1, 0]),
    ]
    for k, scan in enumerate(shapes):
        perceive.reset_mounting()  # each scan alone shows how its sensor is mounted
        try:
            found = perceive(scan, stamp_s=k)
        except edgeperc.FitnessError:
            continue
        if found.top_view is not None:
            tolerances_m = [0.1, 0, np.float32(0.2)] if k == 0 else [0.1]
            for boxes, tolerance_m in itertools.product([found.boxes, []], tolerances_m):
                road_ahead(found.top_view, boxes, tolerance_m=tolerance_m)

def images(options):
    perceive = Perceiver(**options, provider="cpu", n_threads=1, on_mismatch="ignore")
    yield
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    shapes = [
        image, image[:1, :1], image[:, :, ::-1], image[::2], np.asfortranarray(image), image[:20],
        np.frombuffer(image.tobytes(), np.uint8).reshape(image.shape), np.full((24, 32, 3), 7, np.uint8),
        np.broadcast_to(np.uint8(9), (1, 2000, 3)), np.broadcast_to(np.uint8(9), (2000, 1, 3)),
    ]
    for picture in shapes:
        perceive(None if len(perceive.cards) == 1 else points, image=picture).image.drivable_share

def tracks():
    for posed in (None, np.asfortranarray(np.eye(4)), np.eye(4, dtype=np.float32), np.eye(4).tolist()):
        tracker = Tracker()
        yield
        for k, n in enumerate([0, 1, 0, 2, 5, 0, 0, 1, 40, 3, 3, 0, 0, 0]):
            names = itertools.islice(itertools.cycle(["car", "cyclist", "tram"]), n)
            boxes = [Box(name, 0.9, (8 * i + k, 2.0, -0.9), (4.2, 1.8, 1.5), 0) for i, name in enumerate(names)]
            found = tracker.update(boxes, np.float32(k) if k % 2 else k, posed)
            [track.to_dict() for track in found]

def report(options):
    of_images = options is not None and any("tinycam" in str(model) for model in options["models"])
    calls = tracks() if options is None else images(options) if of_images else perceptions(options)
    next(calls)
    before = snapshot()
    for _ in calls:
        pass
    after = snapshot()
    later = [name for name in after if after[name] > before[name]]
    print(json.dumps({"constructed": sum(before.values()), "later": later}), flush=True)

# A fork of a process that has imported everything and called nothing is as good as a new one.
*others, last = json.loads(sys.argv[1])
for options in others:
    if not (child := os.fork()):
        report(options)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, options
report(last)
"""


def test_construction_compiles_what_calls_need(tmp_path: Path) -> None:
    """Whatever the layout of a scan in memory and the number of boxes, in processes that do nothing else."""
    camera = {"models": [str(tiny_camera.write_camera(tmp_path))]}
    perceivers: list[dict[str, Any] | None] = [
        {"models": ["ssadnet", "pointseg"]},
        {"models": "lodnn"},
        {"models": "pointseg", "full_turn": True},
        {"models": "pointseg", "sensor": "vlp-16"},
        {"models": "pointseg", "sensor": "os1-64", "boxes_from": "network", "adapt": "none"},
        camera,
        {"models": ["pointseg", *camera["models"]]},
        None,  # a tracker
    ]
    for together in [perceivers] if hasattr(os, "fork") else [[each] for each in perceivers]:
        command = [sys.executable, "-c", CALLS, json.dumps(together)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        for options, line in zip(together, done.stdout.splitlines(), strict=True):
            report = json.loads(line)
            assert report["constructed"] >= (2 if options == camera else 6), options
            assert report["later"] == [], options
