"""How often the heading of a track points to the front of its object, and not to its rear.

The sequences hold no poses, so an object's own motion is that of its labels in the frame of `Tracks.T_world_sensor`,
which the tracker estimates.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import astuple, dataclass

import numpy as np

from ..tracking.tracks import Tracks
from ..types.points import Floats
from .tracking_metrics import FrameTruth, box_iou

MOVING_MPS = 1.5  # objects with a lower speed stand
WINDOW = 5  # frames before and after, over which an object's speed is measured
FRAME_S = 0.1


@dataclass(frozen=True, slots=True)
class Standing:
    """Counts of boxes of tracks that match a label, without ignored ones."""

    n_boxes: int = 0
    n_tracks: int = 0
    n_resolved: int = 0  # with a front (`edgeperc.Box.front`); the others' heading is known up to half a turn
    n_right: int = 0  # of these, less than a quarter turn from the label's heading
    n_right_of_all: int = 0  # of all boxes

    def __add__(self, other: Standing) -> Standing:
        return Standing(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))


@dataclass(frozen=True, slots=True)
class Headings:
    """Counts of objects that move (`MOVING_MPS`), that stand after they moved, and that never moved so far."""

    moving: Standing = Standing()
    stopped: Standing = Standing()
    parked: Standing = Standing()

    def __add__(self, other: Headings) -> Headings:
        return Headings(self.moving + other.moving, self.stopped + other.stopped, self.parked + other.parked)


def speeds(truth: Sequence[FrameTruth], tracks: Sequence[Tracks]) -> list[Floats]:
    """Speed over ground of each true box by frame [m/s], from places up to `WINDOW` frames away; NaN without others."""
    places: list[dict[int, Floats]] = []
    for frame, result in zip(truth, tracks, strict=True):
        world = frame.boxes[:, :3] @ result.T_world_sensor[:3, :3].T + result.T_world_sensor[:3, 3]
        places.append(dict(zip(frame.ids.tolist(), world[:, :2], strict=True)))
    speeds_mps = []
    for k, here in enumerate(places):
        speed = np.full(len(truth[k].ids), np.nan)
        for i, one in enumerate(here):
            near = [j for j in range(max(k - WINDOW, 0), min(k + WINDOW + 1, len(places))) if one in places[j]]
            if near[-1] > near[0]:
                way = places[near[-1]][one] - places[near[0]][one]
                speed[i] = np.hypot(*way) / (FRAME_S * (near[-1] - near[0]))
        speeds_mps.append(speed)
    return speeds_mps


def count_headings(
    truth: Sequence[FrameTruth], tracks: Sequence[Tracks], labels: Collection[str], iou_threshold: float
) -> Headings:
    """Count right headings in one sequence, of tracks of ``labels`` whose 3-D IoU with a label is large enough."""
    rows: list[tuple[int, int, bool, bool]] = []  # kind, track, resolved, right
    moved: set[int] = set()
    for frame, result, speed in zip(truth, tracks, speeds(truth, tracks), strict=True):
        mine = np.flatnonzero([label in labels for label in result.labels])
        iou = box_iou(frame.boxes, result.boxes[mine])
        moves = speed > MOVING_MPS
        moved |= {*frame.ids[moves].tolist()}
        for i in np.flatnonzero(~frame.ignored & ~np.isnan(speed)).tolist():
            if iou[i].max(initial=0.0) < iou_threshold:
                continue
            track = mine[int(iou[i].argmax())]
            right = bool(np.cos(result.boxes[track, 6] - frame.boxes[i, 6]) > 0.0)
            kind = 0 if moves[i] else 1 if int(frame.ids[i]) in moved else 2
            rows.append((kind, int(result.ids[track]), bool(result.fronts[track] >= 0.5), right))
    counted = []
    for number in range(3):
        of_kind = [row[1:] for row in rows if row[0] == number]
        n_tracks, n_resolved = len({track for track, *_ in of_kind}), sum(resolved for _, resolved, _ in of_kind)
        n_right = sum(resolved and right for _, resolved, right in of_kind)
        counted.append(Standing(len(of_kind), n_tracks, n_resolved, n_right, sum(right for *_, right in of_kind)))
    return Headings(*counted)
