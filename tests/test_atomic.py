"""A file is there as a whole, or as it was before."""

from __future__ import annotations

from pathlib import Path

import pytest

from edgeperc.atomic import open_atomic, write_atomic


def test_a_written_file_replaces_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "file.bin"
    for content in (b"old", b"new", b""):
        write_atomic(str(path), content)
        assert path.read_bytes() == content
    assert [*tmp_path.iterdir()] == [path]


def test_readers_see_the_old_file_until_the_new_one_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    write_atomic(path, b"old")
    with open_atomic(path, "w") as file:
        file.write("Straße")
        file.flush()
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == "Straße".encode()


def write_half(path: Path) -> None:
    with open_atomic(path) as file:
        file.write(b"half")
        raise KeyError


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file.bin"
    write_atomic(path, b"old")
    with pytest.raises(KeyError):
        write_half(path)
    assert path.read_bytes() == b"old"
    assert [*tmp_path.iterdir()] == [path]


def test_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        write_atomic(tmp_path / "nowhere" / "file.bin", b"")
