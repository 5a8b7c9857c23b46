"""A scan with its answer, what writes it, and its JSON, which ``edgeperc run --json`` writes.

``edgeperc eval-tracking --boxes`` reads that JSON.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from .errors import TrackingError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from .tracking.tracks import Tracks
    from .types.perception import Box, Perception
    from .types.sensor import SensorProfile


SCAN_KEYS = (
    "n_points",
    "n_dropped",
    "dropped",
    "stage_ms",
    "providers",
    "boxes",
    "drivable_area_m2",
    "road",
    "point_counts",
    "n_in_view",
    "tracks",
    "tracks_late",
    "fitness",
    "mounting",
    "remission",
    "image",
    "origin_m",
    "map_boxes",
    "map_tracks",
    "sensor_health",
)
"""Keys of a record, in their written order; every record has all of them."""


_NUMBER = re.compile(r"(?<![0-9])0*([0-9]{1,6})[^0-9]*$")  # of a frame; times have more digits


def scan_record(perception: Perception, tracks: Tracks | None = None) -> dict[str, Any]:
    """`Perception.to_dict` with the road ahead and the tracks, as ``edgeperc run --json`` prints it. ``tracks_late``
    says whether the scan came late or twice, and so has no tracks; None if it was not tracked.

    Returns: With the keys of `SCAN_KEYS`; None for results of a kind of model that was not used.
    """
    record = perception.to_dict()
    listed = [*(tracks or ())]
    record |= {"road": _road_record(perception), "tracks": [track.to_dict() for track in listed], "map_tracks": None}
    record["tracks_late"] = None if tracks is None else tracks.is_late
    if perception.origin_m is not None:
        boxes = perception.in_map(track.box for track in listed)
        record["map_tracks"] = [{"id": track.id, **box.to_dict()} for track, box in zip(listed, boxes, strict=True)]
    return {key: record[key] for key in SCAN_KEYS}


def _road_record(perception: Perception) -> dict[str, Any] | None:
    if perception.top_view is None:
        return None
    from .road.ahead import road_ahead  # numba, for who reads records alone

    road = road_ahead(perception.top_view, perception.boxes)
    ahead = road.free_ahead()
    lengths = {
        "free_ahead_m": ahead.free_m,
        "obstacle_ahead_m": ahead.obstacle_m,
        "edge_ahead_m": ahead.edge_m,
        "unknown_ahead_m": ahead.unknown_m,
        "view_ahead_m": ahead.view_m,
        "lane_width_m": road.lane_width_m,
    }
    return {
        "outline": road.outline.round(2).tolist(),
        "holes": [hole.round(2).tolist() for hole in road.holes],
        "tolerance_m": round(road.tolerance_m, 2) if math.isfinite(road.tolerance_m) else None,
        "free_ahead_end": ahead.end,
        **{name: round(value, 2) if math.isfinite(value) else None for name, value in lengths.items()},
    }


def read_boxes(path: Path | str, frames: Mapping[str, int] | None = None) -> list[list[Box]]:
    """Read the boxes of a drive by frame, in the sensor frame, as ``edgeperc run --json`` prints them. The frame is
    that of the scan's name without suffix in ``frames``, else the number at the end of its name, or the line's, if some
    scan has no number. Warns of frames that have no line, or that of a scan that failed. Raises TrackingError, OSError.
    """
    from .types.perception import Box

    scans, boxes = list[str](), list[list[Box] | None]()
    try:
        for line in Path(path).read_text(encoding="utf-8").splitlines():
            record = json.loads(line)
            has_failed = {"scan", "error"} <= {*record}
            boxes.append(None if has_failed else [Box.from_dict(box) for box in record["boxes"]])
            scans.append(str(record.get("scan")))
    except (KeyError, RecursionError, TypeError, ValueError) as exc:
        raise TrackingError(f"{path} holds no boxes ({exc}); expected what edgeperc run --json printed") from exc
    numbers = [_NUMBER.search(Path(scan).name) for scan in scans]
    found = [int(number[1]) for number in numbers if number] if all(numbers) else [*range(len(scans))]
    if frames:
        found = [frames.get(Path(scan).stem, -1) for scan in scans]
    by_frame: dict[int, int] = {}
    for line_number, (frame, scan) in enumerate(zip(found, scans, strict=True)):
        other = by_frame.setdefault(frame, line_number)
        if frame < 0 or other != line_number:
            what = "is none of the sequence" if frame < 0 else f"has the frame of {scans[other]}, {frame}"
            raise TrackingError(f"{path}: {scan} {what}; expected one line for each scan of one sequence")
    n_frames = 1 + max(by_frame, default=-1)
    in_order = [boxes[by_frame[frame]] if frame in by_frame else None for frame in range(n_frames)]
    if lacking := [frame for frame, of_frame in enumerate(in_order) if of_frame is None]:
        warnings.warn(
            f"{path} has no line with boxes for {len(lacking)} of {n_frames} frames, such as {lacking[0]}; they count "
            "as frames without boxes",
            stacklevel=2,
        )
    return [of_frame or [] for of_frame in in_order]


@dataclass(frozen=True, eq=False)
class PerceivedScan:
    """A scan with its answer.

    Attributes
    ----------
    name : str
        The scan's file, or its capture and number.
    stamp_s : float
        Time of the scan [s]; without a time stamp, its number in the run divided by the rate.
    points : (n, 3 or more) floating
        x, y, z [m] in the sensor's frame; then remission, if the scan has it.
    perception : Perception
    tracks : Tracks or None
        None without a tracker; empty for a late or doubled scan (`Tracks.is_late`).
    sensor : SensorProfile
    health : str or None
        ``"OK"``, ``"LATE"`` or ``"STALE"`` of a live answer; None for a scan that was read from a file.
    """

    name: str
    stamp_s: float
    points: NDArray[np.floating]
    perception: Perception
    tracks: Tracks | None
    sensor: SensorProfile
    health: str | None = None

    @property
    def tracked(self) -> Tracks | None:
        """The tracks; None without a tracker, and for a late or doubled scan, of which only the boxes are known."""
        return None if self.tracks is None or self.tracks.is_late else self.tracks


class Sink(Protocol):
    """Writes perceived scans."""

    def write(self, scan: PerceivedScan) -> None:
        """Write one scan.

        Raises
        ------
        EdgepercError or OSError
            The scan could not be written; the next one may be.
        """

    def close(self, whole: bool = True) -> None:
        """Finish the file; nothing is written afterwards. Called after an error, too.

        A file that is not whole, because an error kept a scan from it or the run ended early, is called ``NAME.part``.
        A `RuntimeWarning` says so, and an existing file of its name stays.

        Parameters
        ----------
        whole : bool
            False if the run ended before its last scan.

        Raises
        ------
        EdgepercError or OSError
            The file could not be finished.
        """
