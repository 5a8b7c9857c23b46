"""A run as one HTML page that plays it in 3-D."""

from __future__ import annotations

from pathlib import Path

from ..records import PerceivedScan
from ..system.atomic import part_of
from ..types.points import as_points
from ..view.page import DrivePage
from .run_file import warn_of
from .scene import checked_target

__all__ = ["PageSink"]


class PageSink:
    """Writes all scans of a run to one self-contained HTML page with a play bar; see `edgeperc.view.DrivePage`.

    Parameters
    ----------
    path : str or Path
        The file; it is written, or replaced, when the sink is closed, unless it is not whole (`Sink.close`).

    Raises
    ------
    OSError
        The file's folder is missing.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = checked_target(path)
        self._page = DrivePage(title=self._path.stem)

    def write(self, scan: PerceivedScan) -> None:
        """Add one scan. Raises PointsError for points that were not perceived."""
        self._page.add(scan.perception, as_points(scan.points), scan.stamp_s, scan.tracks, name=scan.name)

    def close(self, whole: bool = True) -> None:
        """Write the page; without scans, none is written. See `Sink.close`. After an OSError, nothing of it is left."""
        if len(self._page):
            self._page.write(self._path if whole else part_of(self._path))
            if not whole:
                warn_of(part_of(self._path), self._path)
