"""A file of a run has its name only if it is whole; its errors are kept."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edgeperc.sinks.run_file import Pipe, RunFile, settle

posix = pytest.mark.skipif(os.name != "posix", reason="no pipes by name")
MOVES = st.tuples(st.sampled_from([os.SEEK_SET, os.SEEK_CUR, os.SEEK_END]), st.integers(0, 40))
ACTS = st.lists(st.binary(max_size=20) | MOVES, max_size=30)


def act(file: Any, acts: list[Any]) -> list[int]:
    """What a file answers to writes and moves, and where it is in the end."""
    answers = [file.write(each) if isinstance(each, bytes) else file.seek(each[1], each[0]) for each in acts]
    file.flush()
    return [*answers, file.tell()]


@given(acts=ACTS)
def test_it_is_a_file(tmp_path_factory: pytest.TempPathFactory, acts: list[Any]) -> None:
    path, twin = tmp_path_factory.mktemp("run") / "file", io.BytesIO()
    file = RunFile(path)
    assert act(file, acts) == act(twin, acts)
    file.check()
    assert not path.exists()
    file.close()
    assert path.read_bytes() == twin.getvalue()
    assert [*path.parent.iterdir()] == [path]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@given(acts=ACTS)
def test_a_library_sees_no_error_and_the_run_sees_the_first(acts: list[Any]) -> None:
    file = RunFile(Path("/dev/full"))
    acts = [b"first", *acts]
    assert act(file, acts) == act(io.BytesIO(), acts)
    for _ in range(2):
        with pytest.raises(OSError, match=r"No space left.*full"):
            file.check()
    file.close()  # it has been said


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_an_error_of_the_last_bytes_is_said_at_the_end() -> None:
    file = RunFile(Path("/dev/full"))
    file.write(b"few")
    file.check()
    with pytest.raises(OSError, match="No space left"):
        file.close()


@pytest.mark.parametrize("before", [None, b"an older run"])
@pytest.mark.parametrize("why", ["early", "error"])
def test_a_part_is_called_so(tmp_path: Path, before: bytes | None, why: str) -> None:
    path = tmp_path / "run.mcap"
    for content in (b"first", b"second"):
        if before is not None:
            path.write_bytes(before)
        file = RunFile(path)
        file.write(content)
        if why == "error":
            file.fail(OSError(5, "Input/output error"))
            with pytest.raises(OSError, match=r"Input/output error.*run\.mcap"):
                file.check()
        with pytest.warns(RuntimeWarning, match=r"run\.mcap was not written to its end; .*run\.mcap\.part"):
            file.close(whole=why == "error")
        assert (tmp_path / "run.mcap.part").read_bytes() == content
        assert (path.read_bytes() if path.exists() else None) == before
    assert {file.name for file in tmp_path.iterdir()} <= {"run.mcap", "run.mcap.part"}


def test_a_folder_replaces_no_other(tmp_path: Path) -> None:
    for k in range(3):
        (tmp_path / "beside").mkdir()
        (tmp_path / "beside/file").write_text(str(k))
        with pytest.warns(RuntimeWarning, match="not written to its end"):
            settle(tmp_path / "beside", tmp_path / "bag", whole=False)
    assert {each.name: (each / "file").read_text() for each in tmp_path.iterdir()} == {
        "bag.part": "0",
        "bag.2.part": "1",
        "bag.3.part": "2",
    }
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag/of another").touch()
    (tmp_path / "beside").mkdir()
    (tmp_path / "beside/file").touch()
    with pytest.warns(RuntimeWarning, match=r"bag\.4\.part"), pytest.raises(OSError, match="bag"):
        settle(tmp_path / "beside", tmp_path / "bag", whole=True)


@posix
@pytest.mark.parametrize("size", [0, 1, 10_000_000])
def test_a_pipe_ends_in_the_file(tmp_path: Path, size: int) -> None:
    content = os.urandom(size)
    file = RunFile(tmp_path / "file")
    pipe = Pipe(file)
    with pipe.path.open("wb") as library:
        pipe.start()
        assert not pipe.path.exists()
        assert not pipe.ends(0.0)
        library.write(content)
    assert pipe.ends(60.0)
    file.close()
    assert (tmp_path / "file").read_bytes() == content


@posix
def test_a_pipe_takes_all_where_the_file_takes_nothing() -> None:
    """A library that waits until its file is written does not wait for ever."""
    file = RunFile(Path("/dev/full"))
    pipe = Pipe(file)
    with pipe.path.open("wb") as library:
        pipe.start()
        library.write(bytes(10_000_000))
    assert pipe.ends(60.0)
    with pytest.raises(OSError, match="No space left"):
        file.check()
    file.close()
