"""Processes that are started or forked: what they run at their start, and what they leave alone."""

from __future__ import annotations

import ast
import gc
import itertools
import os
import sys
from pathlib import Path

import pytest

import edgeperc
from checkout import printed
from edgeperc.system.interpreter import kept_in_forks

ROOT = str(Path(edgeperc.__file__).parent.parent)
SAYS = f"""
import sys
sys.path.insert(0, {ROOT!r})
from edgeperc.system.interpreter import interpreter_flags
print(tuple(sys.flags)[:], interpreter_flags(), sys.dont_write_bytecode)
"""
FLAGS = ["-O", "-B", "-E", "-s", "-S", "-I", *(["-P"] if sys.version_info >= (3, 11) else [])]


def said(flags: list[str]) -> str:
    return printed(SAYS, flags=(*flags,), timeout=60)


@pytest.mark.parametrize(
    "flags",
    [[], *([flag] for flag in FLAGS), *map(list, itertools.combinations(FLAGS, 2)), ["-OO", "-I", "-S", "-B"]],
    ids=str,
)
def test_a_started_python_has_the_flags_of_this_one(flags: list[str]) -> None:
    first = said(flags)
    given = ast.literal_eval(first.partition(") ")[2].rpartition(" ")[0])
    assert said(given) == first


def test_the_users_own_code_stays_out(tmp_path: Path) -> None:
    """A ``.pth`` file of the user's packages is code that every Python runs at its start, but not with -s."""
    environment = {**os.environ, "PYTHONUSERBASE": str(tmp_path)}
    code = "import site; print(site.getusersitepackages())"
    folder = Path(printed(code, env=environment).strip())
    folder.mkdir(parents=True)
    (folder / "code.pth").write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).touch()\n")
    code = (
        f"import sys; sys.path.insert(0, {ROOT!r})\nfrom edgeperc.system.interpreter import interpreter_flags\n"
        "import subprocess; subprocess.run([sys.executable, *interpreter_flags(), '-c', ''], check=True)"
    )
    for flag in ("-s", "-I"):
        printed(code, flags=(flag,), env=environment)
        assert not (tmp_path / "ran").exists()


class Ends:
    """Says when it is destroyed."""

    def __init__(self, number: int) -> None:
        self._number = number

    def __del__(self) -> None:
        os.write(self._number, b"ended in %d\n" % os.getpid())


@pytest.mark.skipif(os.name != "posix", reason="nothing is forked elsewhere")
def test_what_is_kept_ends_in_its_own_process_alone() -> None:
    read, write = os.pipe()
    kept, plain = kept_in_forks(Ends(write)), Ends(write)
    child = os.fork()
    if child == 0:
        del kept, plain
        gc.collect()
        os._exit(0)
    os.waitpid(child, 0)
    del kept, plain
    gc.collect()
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        ended = pipe.read().decode().splitlines()
    assert sorted(ended) == sorted([f"ended in {child}", *[f"ended in {os.getpid()}"] * 2])
