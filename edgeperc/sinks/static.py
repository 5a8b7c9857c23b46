"""Scans without what moves, or without what could move, for mapping and localization."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError, PointsError
from ..records import PerceivedScan
from ..system.fields import OPTIONS
from ..system.names import stem_of
from ..system.remote import location
from ..tracking.moving import movable_points, moving_points
from ..types.points import Floats32, Mask, as_points
from .run_file import ScanFiles

__all__ = ["StaticSink"]

_FIELDS = ("x", "y", "z", "intensity")


class StaticSink:
    """Writes each scan without its points on moving, or on movable, objects.

    A file has the name and the format of the scan's file: ``.bin``, ``.npy``, ``.npz``, ``.pcd`` or ``.ply`` with x, y,
    z and remission of the remaining points, in their order; ``.pcd.bin`` with all its values, such as the ring.
    Scans of captures and bags become ``NUMBER.bin``, float32 x, y, z, remission. Points whose place in a map is known
    (``origin_m``) stay there, as doubles; those of ``.bin`` are float32. A file that is there and differs stays: it may
    be the scan of another drive.

    Parameters
    ----------
    folder : str or Path
        Made if needed.
    without : {"moving", "movable"}
        ``"moving"``: points inside the boxes of tracks that move (`edgeperc.moving_points`). ``"movable"``: also those
        on everything that could move (`edgeperc.movable_points`). Of a late or doubled scan it is not known what moves,
        so both leave out what could.

    Attributes
    ----------
    n_points, n_removed : int
        Points of all scans so far, and those that were left out.

    Raises
    ------
    OptionError
        ``without`` is another value.
    OSError
        The folder cannot be made.
    """

    def __init__(self, folder: str | Path, *, without: Literal["moving", "movable"] = "moving") -> None:
        if without not in ("moving", "movable"):
            raise OptionError(f"without is {without!r}; expected 'moving' or 'movable'")
        self._folder, self._without = OPTIONS.path("folder", folder), without
        self._folder.mkdir(parents=True, exist_ok=True)
        self._files = ScanFiles()
        self.n_points = self.n_removed = 0

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan. Raises OptionError without tracks, and if the file would replace the scan or another one;
        PointsError if a ``.pcd.bin`` file holds another number of points than the scan; OSError.
        """
        points = as_points(scan.points)
        gone = np.zeros(len(points), np.bool_)
        if scan.tracked is not None:
            gone |= moving_points(scan.tracked, points)
        elif scan.tracks is None and self._without == "moving":
            raise OptionError("there are no tracks, so nothing is known to move; track the boxes (--track)")
        if self._without == "movable" or (scan.tracks is not None and scan.tracks.is_late):
            gone |= movable_points(scan.perception, points)
        xyz: NDArray[Any] = points[:, :3] if scan.perception.origin_m is None else scan.perception.to_map(points)
        content = _content(xyz, points[:, 3], ~gone, scan.name)
        self._files.write(self._folder / file_name(scan.name), scan.name, content)
        self.n_points += len(points)
        self.n_removed += int(np.count_nonzero(gone))

    def close(self, whole: bool = True) -> None:
        """Do nothing; every file is complete."""


def file_name(scan: str) -> str:
    """Name of the file that a scan becomes: its own, or a raw one's if it has another format."""
    stem, suffix = stem_of(scan)
    return Path(scan).name if suffix else f"{stem}.bin"


def _content(xyz: NDArray[Any], remission: Floats32, kept: Mask, source: str) -> bytes:
    """The file of the points that are kept; their coordinates have the type of ``xyz``."""
    suffix = stem_of(source)[1]
    others = remission[:, None]
    if suffix == ".pcd.bin":  # a scan that was straightened has other coordinates than its file
        whole = np.frombuffer(location(source).read_bytes(), np.uint8)
        if whole.size % (4 * len(xyz) or np.inf):
            raise PointsError(f"{source} holds {whole.size:,} bytes for {len(xyz):,} points; expected as many for each")
        others = whole.view("<f4").reshape(len(xyz), -1)[:, 3:]
    rows = np.column_stack([xyz, others])[kept]
    if suffix in (".npy", ".npz"):
        file = io.BytesIO()
        np.save(file, rows) if suffix == ".npy" else np.savez(file, points=rows)
        return file.getvalue()
    if suffix not in (".pcd", ".ply"):
        return rows.astype("<f4").tobytes()
    size = rows.itemsize
    if suffix == ".pcd":
        header = (
            f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {' '.join(_FIELDS)}\n"
            f"SIZE {size} {size} {size} {size}\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {len(rows)}\nHEIGHT 1\n"
            f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(rows)}\nDATA binary\n"
        )
    else:
        kind = {4: "float", 8: "double"}[size]
        properties = "".join(f"property {kind} {name}\n" for name in _FIELDS)
        header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    return header.encode("ascii") + rows.astype(f"<f{size}").tobytes()
