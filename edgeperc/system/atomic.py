"""Write files atomically: a reader sees the old file or the new one, never a part of it."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from .fields import OPTIONS


@contextmanager
def open_atomic(path: str | Path, mode: str = "wb", permissions: int = 0o666) -> Iterator[IO[Any]]:
    """Open a temporary file in the target's folder; it replaces the target when the block ends without an error.

    A link is followed. A target that is not a regular file, such as ``/dev/stdout`` or a named pipe, is written
    directly. What was written is on the disk before it has its name; an `OSError` has the target's. ``permissions`` of
    a new file are reduced by the umask.
    """
    path = Path(os.path.realpath(OPTIONS.path("path", path)))
    if path.exists() and not path.is_file():
        with _named(path), path.open(mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
        return
    temporary = beside(path)

    def opener(name: str, flags: int) -> int:
        return os.open(name, flags | os.O_EXCL, permissions)

    try:
        with _named(path, temporary):
            with open(temporary, mode, encoding=None if "b" in mode else "utf-8", opener=opener) as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _named(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Let an `OSError` of writing have the path of the target."""
    try:
        yield
    except OSError as exc:
        if exc.errno is not None and exc.filename in (None, str(temporary)):  # None: of a full disk
            exc.filename = str(path)
        raise


def write_atomic(path: str | Path, content: bytes, permissions: int = 0o666) -> None:
    """Write ``content`` to a file; see `open_atomic`."""
    with open_atomic(path, permissions=permissions) as file:
        file.write(content)


def beside(path: Path) -> Path:
    """A new name in the folder of ``path``, for what is not whole yet."""
    # Process numbers are not unique: containers that share a folder have equal ones.
    return path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.part")


def name_whole(temporary: Path, path: Path) -> None:
    """Give a file or folder that was written `beside` its name, once it is on the disk."""
    for file in (temporary, *temporary.rglob("*")):
        if file.is_file():
            with file.open("rb+") as written:
                os.fsync(written.fileno())
    temporary.replace(path)


def name_part(temporary: Path, path: Path) -> Path:
    """Give what was written `beside` and is not whole the name ``NAME.part``; return it. An older folder stays."""
    part, n = part_of(path), 1
    while part.is_dir():
        n += 1
        part = part_of(path.with_name(f"{path.name[:200]}.{n}"))
    temporary.replace(part)
    return part


def part_of(path: Path) -> Path:
    """The name of a part of what would be called ``path``."""
    return path.with_name(f"{path.name[:200]}.part")
