"""Write a file whole, or not at all."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["write_aside", "write_whole"]


def write_whole(path: str | Path, content: bytes) -> None:
    """Write beside the target, then rename, so that nobody ever reads half a file."""
    path = Path(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(content)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_aside(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    aside.write_bytes(content)
    aside.replace(path)
