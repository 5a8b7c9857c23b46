"""How often the heading of a track points to the front of its object, and not to its rear.

The sequences hold no poses, so an object's own motion is that of its labels in the frame of `Tracks.T_world_sensor`,
which the tracker estimates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence

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


def places(truth: Sequence[FrameTruth], tracks: Sequence[Tracks]) -> list[dict[int, Floats]]:
    """x, y [m] of the true boxes in the frame of `Tracks.T_world_sensor`, by frame and id."""
    found = []
    for frame, result in zip(truth, tracks, strict=True):
        world = frame.boxes[:, :3] @ result.T_world_sensor[:3, :3].T + result.T_world_sensor[:3, 3]
        found.append(dict(zip(frame.ids.tolist(), world[:, :2], strict=True)))
    return found


def matches(
    truth: Sequence[FrameTruth], tracks: Sequence[Tracks], labels: Collection[str], iou_threshold: float
) -> Iterator[tuple[int, int, int]]:
    """Frame, true box that is not ignored, and the track of ``labels`` with the largest 3-D IoU, if large enough."""
    for k, (frame, result) in enumerate(zip(truth, tracks, strict=True)):
        mine = np.flatnonzero([label in labels for label in result.labels])
        iou = box_iou(frame.boxes, result.boxes[mine])
        for i in np.flatnonzero(~frame.ignored).tolist():
            if iou[i].max(initial=0.0) >= iou_threshold:
                yield k, i, int(mine[iou[i].argmax()])


def speeds(truth: Sequence[FrameTruth], tracks: Sequence[Tracks]) -> list[Floats]:
    """Speed over ground of each true box by frame [m/s], from places up to `WINDOW` frames away; NaN without others."""
    at, speeds_mps = places(truth, tracks), []
    for k, here in enumerate(at):
        speed = np.full(len(truth[k].ids), np.nan)
        for i, one in enumerate(here):
            near = [j for j in range(max(k - WINDOW, 0), min(k + WINDOW + 1, len(at))) if one in at[j]]
            if near[-1] > near[0]:
                speed[i] = np.hypot(*(at[near[-1]][one] - at[near[0]][one])) / (FRAME_S * (near[-1] - near[0]))
        speeds_mps.append(speed)
    return speeds_mps


def count_headings(
    truth: Sequence[FrameTruth], tracks: Sequence[Tracks], matched: Iterable[tuple[int, int, int]]
) -> dict[str, Counter[str]]:
    """`COUNTS` of one sequence by `MOTIONS`, of the pairs of `matches`."""
    counted = {motion: Counter(dict.fromkeys(COUNTS, 0)) for motion in MOTIONS}
    speeds_mps, met = speeds(truth, tracks), set()
    first = {}  # frame in which an object moves first
    for k in reversed(range(len(truth))):
        first.update(dict.fromkeys(truth[k].ids[speeds_mps[k] > MOVING_MPS].tolist(), k))
    for k, i, track in matched:
        speed, tracked = speeds_mps[k][i], tracks[k]
        if np.isnan(speed):
            continue
        right = int(np.cos(tracked.boxes[track, 6] - truth[k].boxes[i, 6]) > 0.0)
        resolved = int(tracked.fronts[track] >= 0.5)
        stopped = first.get(int(truth[k].ids[i]), k + 1) <= k
        motion = "moving" if speed > MOVING_MPS else "stopped" if stopped else "parked"
        met.add((motion, int(tracked.ids[track])))
        counted[motion].update(n_boxes=1, n_resolved=resolved, n_right=resolved * right, n_right_of_all=right)
    for motion, _ in met:
        counted[motion]["n_tracks"] += 1
    return counted
