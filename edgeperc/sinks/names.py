"""Names of the files that a run writes for its scans."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import OptionError

_SUFFIXES = (".pcd.bin", ".bin", ".npy", ".npz", ".pcd", ".ply")


def stem_of(name: str) -> tuple[str, str]:
    """Name of a scan without folder and suffix, and its suffix in lower case, none for a capture's or an image's."""
    last = Path(name).name
    suffix = next((ending for ending in _SUFFIXES if last.lower().endswith(ending)), "")
    return (last[: -len(suffix)] if suffix else Path(last).stem), suffix


class ScanFiles:
    """The files of one run in one folder: each scan has its own, and none replaces a scan."""

    def __init__(self) -> None:
        self._sources: dict[Path, str] = {}

    def checked(self, target: Path, scan: str) -> Path:
        """Return ``target`` for the scan of this name; OptionError if it is the scan itself, or another one's file."""
        if os.path.realpath(target) == os.path.realpath(scan):
            raise OptionError(f"{target} is the scan itself and would be overwritten; choose another folder")
        source = self._sources.setdefault(target, scan)
        if source != scan:
            raise OptionError(f"{target} is already the file of {source}; run each folder of scans by itself")
        return target
