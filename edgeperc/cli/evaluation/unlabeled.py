"""``edgeperc run --consistency``: figures of a drive without labels."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from ...evaluation.consistency import Consistency
from ...records import PerceivedScan
from ...sinks.run_file import warn_of
from ...system.atomic import part_of, write_atomic
from ...system.printable import many
from ..output import print_line, table_lines

_COLUMNS = (
    *(("objects", "n_objects"), ("in scans", "n_scans"), ("detected", "detected"), ("class", "class")),
    *(("heading", "heading"), ("detections", "n_detections"), ("lone", "lone")),
)


class ConsistencySink:
    """Collects a run, and writes and prints its `Consistency` when it is over."""

    def __init__(self, path: Path) -> None:
        self._path, self._consistency = path, Consistency()

    def write(self, scan: PerceivedScan) -> None:
        """Take in a scan; of a late one nothing is known. Raises OptionError, PointsError."""
        if scan.tracks is not None:
            self._consistency.add(scan.perception, scan.points, scan.tracks, scan.name)

    def close(self, whole: bool = True) -> None:
        """Write the figures; see `Sink.close`."""
        figures = self._consistency.figures()
        path = self._path if whole else part_of(self._path)
        if figures["n_scans"]:  # a run without answers replaces no file
            write_atomic(path, (json.dumps(figures, indent=1, allow_nan=False) + "\n").encode())
            if not whole:
                warn_of(path, self._path)
        rows = [
            ((label, band), row)
            for label, bands in figures["classes"].items()
            for band, row in bands.items()
            if row["n_scans"] or row["n_detections"]
        ]
        scans, drives = many(figures["n_scans"], "scan"), many(figures["n_drives"], "drive")
        title = f"consistency of {scans} of {drives}, without labels [%]"
        contradicted = [scan for scan in figures["scans"] if scan["missed"] or scan["lone"]]
        worst = sorted(contradicted, key=lambda scan: -scan["missed"] - scan["lone"])[:3]
        named = [f"{scan['scan']} ({scan['missed']} missed, {scan['lone']} lone)" for scan in worst]
        lines = [*table_lines(title, _COLUMNS, rows), *[f"look first at {', '.join(named)}"] * bool(named)]
        for line in lines if rows else [f"{title}: nothing was detected"]:
            print_line(line, sys.stderr)
