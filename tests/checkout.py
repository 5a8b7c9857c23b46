"""The files of this project, whatever else lies in the checkout: `pip install .` leaves a copy in build/."""

from __future__ import annotations

import functools
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parent.parent
FOLDERS = ("edgeperc", "bench", "export", "models", "tests", "docs")
"""Where the project's files lie, in a source distribution too."""


@functools.cache
def tracked(root: Path = REPOSITORY) -> tuple[Path, ...]:
    """Files that git tracks; without git, as in a source distribution, all those in `FOLDERS`."""
    if (root / ".git").exists() and shutil.which("git"):
        command = ["git", "-c", f"safe.directory={root}", "ls-files", "-z", "--", *FOLDERS]
        listing = subprocess.run(command, cwd=root, capture_output=True, check=True).stdout.decode()
        paths = [root / name for name in listing.split("\0") if name]
    else:
        paths = [path for folder in FOLDERS for path in (root / folder).rglob("*")]
    return tuple(sorted(path for path in paths if path.is_file()))


@functools.cache
def files(suffix: str, *folders: str) -> tuple[Path, ...]:
    """Files of the project in some folders, at any depth, whose names end in ``suffix``; sorted."""
    roots = [REPOSITORY / folder for folder in folders]
    return tuple(path for path in tracked() if path.name.endswith(suffix) and any(map(path.is_relative_to, roots)))


def printed(code: str, *arguments: object, flags: tuple[str, ...] = (), **how: Any) -> str:
    """What code prints in a new Python; it has to end well."""
    command = [sys.executable, *flags, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, **how)
    assert done.returncode == 0, done.stderr
    return done.stdout
