"""The JSON of a scan: what ``edgeperc run --json`` writes and ``edgeperc eval-tracking --boxes`` reads."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import TrackingError
from .road.ahead import road_ahead
from .types.perception import Box

if TYPE_CHECKING:
    from .tracking.tracks import Tracks
    from .types.perception import Perception

__all__ = ["SCAN_KEYS", "read_boxes", "scan_record"]

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
    "tracks",
    "fitness",
    "mounting",
    "remission",
    "image",
)
"""Keys of a record, in their written order; every record has all of them."""


def scan_record(perception: Perception, tracks: Tracks | None = None) -> dict[str, Any]:
    """`Perception.to_dict` with the road ahead and the tracks, as ``edgeperc run --json`` prints it.

    Parameters
    ----------
    perception : Perception
    tracks : Tracks, optional

    Returns
    -------
    dict
        With the keys of `SCAN_KEYS`; None for results of a kind of model that was not used.
    """
    record = perception.to_dict()
    record["road"] = _road_record(perception)
    record["tracks"] = [track.to_dict() for track in tracks or ()]
    return {key: record[key] for key in SCAN_KEYS}


def _road_record(perception: Perception) -> dict[str, Any] | None:
    if perception.top_view is None:
        return None
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
        "outline": [[round(float(v), 2) for v in corner] for corner in road.outline],
        "tolerance_m": round(road.tolerance_m, 2) if math.isfinite(road.tolerance_m) else None,
        "free_ahead_end": ahead.end,
        **{name: round(value, 2) if math.isfinite(value) else None for name, value in lengths.items()},
    }


def read_boxes(path: Path | str) -> list[list[Box]]:
    """Read the boxes of a drive as ``edgeperc run --json`` prints them: one line for each scan.

    Parameters
    ----------
    path : str or Path
        A file of JSON lines.

    Returns
    -------
    list of list of Box
        By scan, in the sensor frame.

    Raises
    ------
    TrackingError
        A line is not such a record.
    OSError
        The file cannot be read.
    """
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
        return [[Box.from_dict(box) for box in json.loads(line)["boxes"]] for line in lines]
    except (KeyError, RecursionError, TypeError, ValueError) as exc:
        raise TrackingError(f"{path} holds no boxes ({exc}); expected what edgeperc run --json printed") from exc
