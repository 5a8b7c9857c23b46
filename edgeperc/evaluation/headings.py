"""How often the heading of a track points to the front of its object, and not to its rear.

The sequences hold no poses, so an object's own motion is that of its labels in the frame of `Tracks.T_world_sensor`,
which the tracker estimates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

import numpy as np

from ..tracking.tracks import Tracks
from ..types.points import Floats
from .tracking_metrics import FrameTruth, box_iou

MOVING_MPS = 1.5  # objects with a lower speed stand
WINDOW = 5  # frames before and after, over which an object's speed is measured
FRAME_S = 0.1


# Of an object: faster than `MOVING_MPS`; standing after it moved; that never moved so far.
MOTIONS = ("moving", "stopped", "parked")
COUNTS = (
    "n_boxes",  # of tracks that match a label, without ignored ones
    "n_tracks",
    "n_resolved",  # with a front (`edgeperc.Box.front`); the others' heading is known up to half a turn
    "n_right",  # of these, less than a quarter turn from the label's heading
    "n_right_of_all",
)


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
) -> dict[str, Counter[str]]:
    """`COUNTS` of one sequence by `MOTIONS`, of tracks of ``labels`` whose 3-D IoU with a label is large enough."""
    counted = {motion: Counter(dict.fromkeys(COUNTS, 0)) for motion in MOTIONS}
    moved: set[int] = set()
    met: set[tuple[str, int]] = set()
    for frame, result, speed in zip(truth, tracks, speeds(truth, tracks), strict=True):
        mine = np.flatnonzero([label in labels for label in result.labels])
        iou = box_iou(frame.boxes, result.boxes[mine])
        moves = speed > MOVING_MPS
        moved |= {*frame.ids[moves].tolist()}
        for i in np.flatnonzero(~frame.ignored & ~np.isnan(speed)).tolist():
            if iou[i].max(initial=0.0) < iou_threshold:
                continue
            track = mine[int(iou[i].argmax())]
            right = int(np.cos(result.boxes[track, 6] - frame.boxes[i, 6]) > 0.0)
            resolved = int(result.fronts[track] >= 0.5)
            motion = "moving" if moves[i] else "stopped" if int(frame.ids[i]) in moved else "parked"
            met.add((motion, int(result.ids[track])))
            counted[motion].update(n_boxes=1, n_resolved=resolved, n_right=resolved * right, n_right_of_all=right)
    for motion, _ in met:
        counted[motion]["n_tracks"] += 1
    return counted
