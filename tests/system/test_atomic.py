"""A file is there as a whole, or as it was before."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from edgeperc.system.atomic import name_whole, open_atomic, write_atomic


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


@pytest.mark.parametrize("content", [b"", b"few", bytes(100_000)])
def test_what_has_its_name_is_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes) -> None:
    """After a loss of power a file is whole, too: its content is there before its name."""
    path, synced = tmp_path / "file.bin", []
    sync = os.fsync

    def noted(number: int) -> None:
        synced.append((os.fstat(number).st_ino, os.fstat(number).st_size, path.exists()))
        sync(number)

    monkeypatch.setattr(os, "fsync", noted)
    write_atomic(path, content)
    assert synced == [(path.stat().st_ino, len(content), False)]
    folder, files = tmp_path / "beside", {"a": b"1", "b/c": content}
    for name, inside in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(inside)
    synced.clear()
    name_whole(folder, tmp_path / "folder")
    assert sorted(size for _, size, _ in synced) == sorted(map(len, files.values()))
    assert {name: (tmp_path / "folder" / name).read_bytes() for name in files} == files


def write_half(path: Path) -> None:
    with open_atomic(path) as file:
        file.write(b"half")
        raise KeyError


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file.bin"
    write_atomic(path, b"old")
    with pytest.raises(KeyError):
        write_half(path)
    with pytest.raises(OSError, match=r"\[Errno 28\] full: '.*file\.bin'"), open_atomic(path):
        raise OSError(errno.ENOSPC, "full")
    assert path.read_bytes() == b"old"
    assert [*tmp_path.iterdir()] == [path]


@pytest.mark.skipif(os.name != "posix", reason="no such files")
def test_a_link_is_followed_and_a_pipe_is_written(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "file.bin")
    write_atomic(tmp_path / "link", b"through")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "file.bin").read_bytes() == b"through"
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    write_atomic(tmp_path / "pipe", b"flows")
    assert os.read(reader, 10) == b"flows"
    os.close(reader)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_device_is_an_os_error() -> None:
    with pytest.raises(OSError, match=r"No space left.*'/dev/full'"):
        write_atomic("/dev/full", b"x" * 100_000)
    assert stat.S_ISCHR(Path("/dev/full").stat().st_mode)


@pytest.mark.skipif(os.name != "posix", reason="Windows has access lists")
def test_permissions_are_reduced_by_the_umask(tmp_path: Path) -> None:
    umask = os.umask(0o027)
    try:
        write_atomic(tmp_path / "given", b"", 0o644)
        write_atomic(tmp_path / "usual", b"")
    finally:
        os.umask(umask)
    assert [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("given", "usual")] == [0o640, 0o640]


def test_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="nowhere"):
        write_atomic(tmp_path / "nowhere" / "file.bin", b"")
