"""Write a file whole, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

__all__ = ["open_atomic", "write_atomic"]


@contextmanager
def open_atomic(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file in the target's folder; it replaces the target when the block ends without an error.

    Readers see the old file or the new one, never a part of it.

    Parameters
    ----------
    path : str or Path
    mode : {"wb", "w"}
        ``"w"`` writes text as UTF-8.

    Raises
    ------
    OSError
        The file cannot be written; the target is then as it was.
    """
    path = Path(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with aside.open(mode, encoding=None if "b" in mode else "utf-8") as file:
            yield file
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_atomic(path: str | Path, content: bytes) -> None:
    """Write a file at once, as `open_atomic` does."""
    with open_atomic(path) as file:
        file.write(content)
