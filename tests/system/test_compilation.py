"""What is said while kernels are compiled: one line with an honest count on a terminal, and nothing elsewhere."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numba
import pytest

from edgeperc.system import compilation, compiling, kernel_cache
from edgeperc.system.compilation import KERNELS, Compilation, kernels_of
from edgeperc.system.compiling import tell_watchers
from edgeperc.system.kernel_cache import KernelCache, missing
from scenes import Terminal

pytestmark = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled with the JIT off")


class Closed(Terminal):
    def write(self, text: str) -> int:
        raise OSError(5, "Input/output error")


class Gone(Terminal):
    def isatty(self) -> bool:
        raise ValueError("I/O operation on closed file")


class Kernel:
    """A kernel that some process compiles."""

    signatures: tuple[()] = ()

    def __init__(self, k: int) -> None:
        self.k, self._cache = k, object.__new__(KernelCache)


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Eighty that are missing; remove one, and it is compiled."""
    left: list[Any] = [Kernel(k) for k in range(80)]
    monkeypatch.setattr(kernel_cache, "missing", lambda wanted: [each for each in wanted if each in left])
    monkeypatch.setattr(kernel_cache, "are_kept", lambda _: True)
    monkeypatch.setattr(compilation.logger, "hasHandlers", lambda: False)  # but those of pytest
    # The module's own, because pytest puts its capture into sys.stderr before each test.
    monkeypatch.setattr(compilation, "sys", SimpleNamespace(stderr=Terminal()))
    yield left
    assert compiling.watchers == []


def lines() -> list[str]:
    """What stands on the terminal's line, one after the other."""
    terminal: Any = compilation.sys.stderr
    return str(terminal.getvalue()).split("\r")


def watched(kernels: list[Any]) -> None:
    """Compile some kernels, during which those who watch are told twice."""
    every = list(kernels)
    with Compilation(lambda: every):
        tell_watchers()
        tell_watchers()


def test_a_terminal_shows_one_line_with_a_bar(kernels: list[Any]) -> None:
    every = list(kernels)
    with Compilation(lambda: every, n_processes=2):
        tell_watchers()
        assert lines() == ["", "edgeperc: compiling 80 functions once for this computer, about 15 s"]
        del kernels[40:]
        tell_watchers()
        assert re.search(r"this computer \[#####-----\] \d+ s left *$", lines()[-1])
        kernels.clear()
        tell_watchers()
        assert re.search(r"\[##########\] 0 s left *$", lines()[-1])
    assert re.fullmatch(r"edgeperc: compiled 80 functions in \d+ s; later starts load them *\n", lines()[-1])
    assert max(map(len, lines())) <= 80


@pytest.mark.parametrize("n_missing", [0, 1, 3])
def test_few_kernels_are_not_worth_a_line(kernels: list[Any], n_missing: int, caplog: pytest.LogCaptureFixture) -> None:
    del kernels[n_missing:]
    watched(kernels)
    assert lines() == [""]


def test_nothing_is_counted_while_nothing_is_compiled(kernels: list[Any]) -> None:
    with Compilation(Mock(side_effect=AssertionError)):
        pass
    assert lines() == [""]


def test_what_is_not_kept_is_not_compiled_once(kernels: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_cache, "are_kept", lambda _: False)
    every = list(kernels)
    with Compilation(lambda: every):
        tell_watchers()
    assert "edgeperc: compiling 80 functions, about 20 s" in lines()
    assert re.fullmatch(r"edgeperc: compiled 80 functions in \d+ s *\n", lines()[-1])


@pytest.mark.parametrize("stream", [io.StringIO(), Gone(), None])
def test_nothing_is_written_where_no_user_reads_it(
    kernels: list[Any], stream: io.StringIO | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(compilation.sys, "stderr", stream)
        watched(kernels)
    assert stream is None or stream.getvalue() == ""


@pytest.mark.parametrize("why", ["logging is set up", "edgeperc.system.compilation", "edgeperc"])
def test_a_program_can_have_it_its_own_way(kernels: list[Any], why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if why == "logging is set up":
        monkeypatch.setattr(compilation.logger, "hasHandlers", lambda: True)
    else:
        monkeypatch.setattr(logging.getLogger(why), "level", logging.WARNING)
    watched(kernels)
    assert lines() == [""]


def test_the_log_has_the_line_wherever_standard_error_goes(
    kernels: list[Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="edgeperc.system.compilation")
    watched(kernels)
    assert caplog.messages == ["compiling 80 functions once for this computer, about 20 s"]


def test_a_terminal_that_went_away_stops_nothing(kernels: list[Any], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compilation.sys, "stderr", Closed())
    watched(kernels)


def test_an_error_leaves_the_line_and_what_is_printed_next_begins_its_own(kernels: list[Any]) -> None:
    every = list(kernels)

    def interrupted() -> None:
        with Compilation(lambda: every):
            tell_watchers()
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert lines()[-1] == "edgeperc: compiling 80 functions once for this computer, about 20 s\n"


def test_kernels_that_are_needed_exist_and_are_missing_from_an_empty_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    kernels = kernels_of(KERNELS)
    assert len(kernels) == len(set(kernels)) > 60
    monkeypatch.setattr(type(kernels[0]), "signatures", ())
    assert missing(kernels) == kernels
    cache = kernels[3]._cache
    folder = next(cache.folders())
    folder.mkdir(0o755)
    (folder / f"{cache.name}-0123456789abcdef.kernel").write_bytes(bytes(32) + cache.stamp())
    (folder / f"{kernels[5]._cache.name}-0123456789abcdef.kernel").write_bytes(bytes(64))
    assert missing(kernels) == [*kernels[:3], *kernels[4:]]
