"""The JSON of a scan: what ``edgeperc run --json`` writes and the tracking reader reads."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .errors import TrackingError
from .perception import Box

if TYPE_CHECKING:
    from .perception import Box, Perception, TopView
    from .tracking.tracks import Tracks

__all__ = ["read_boxes", "scan_record"]


def _box_record(box: Box) -> dict[str, Any]:
    return {
        "label": box.label,
        "score": round(float(box.score), 4),
        "center": [round(float(v), 4) for v in box.center],
        "size": [round(float(v), 4) for v in box.size],
        "yaw": round(float(box.yaw), 5),
    }


def _road_record(top_view: TopView, boxes: Sequence[Box]) -> dict[str, Any]:
    from .drivable import road_ahead

    road = road_ahead(top_view, boxes)
    widths = {"free_ahead_m": road.free_ahead_m(), "lane_width_m": road.lane_width_m}
    return {
        "outline": [[round(float(v), 2) for v in corner] for corner in road.outline],
        **{name: None if math.isnan(value) else round(value, 2) for name, value in widths.items()},
    }


def scan_record(perception: Perception, tracks: Tracks | None = None) -> dict[str, Any]:
    """What `run --json` says of a scan. Keys are always all there; null where no model of that kind took part."""
    return {
        "n_points": perception.n_points,
        "n_dropped": perception.n_dropped,
        "stage_ms": {name: round(ms, 3) for name, ms in perception.stage_ms.items()},
        "providers": dict(perception.providers),
        "boxes": [_box_record(box) for box in perception.boxes],
        "drivable_area_m2": None if perception.top_view is None else round(perception.top_view.drivable_area_m2, 2),
        "road": None if perception.top_view is None else _road_record(perception.top_view, perception.boxes),
        "point_counts": None if perception.points is None else perception.points.counts(),
        "tracks": [
            {
                "id": track.id,
                **_box_record(track.box),
                "velocity": [round(float(v), 3) for v in track.velocity],
                "age_s": round(track.age_s, 3),
                "hits": track.hits,
                "coasting": track.coasting,
                "modes": {name: round(share, 4) for name, share in track.modes.items()},
            }
            for track in tracks or ()
        ],
        "fitness": list(perception.fitness),
    }


def read_boxes(path: Path | str) -> list[list[Box]]:
    """Read the boxes of a drive, a line a scan, as ``edgeperc run --json`` prints them.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    list of list of Box

    Raises
    ------
    TrackingError
        A line is no such record.
    OSError
        The file cannot be read.
    """
    try:
        return [
            [Box(of["label"], of["score"], tuple(of["center"]), tuple(of["size"]), of["yaw"]) for of in line["boxes"]]
            for line in map(json.loads, Path(path).read_text(encoding="utf-8").splitlines())
        ]
    except (KeyError, TypeError, ValueError) as exc:
        raise TrackingError(f"{path} holds no boxes ({exc}); expected what edgeperc run --json printed") from exc
