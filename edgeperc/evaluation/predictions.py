"""How far the predicted places of tracks are from where their objects are then (`Track.predicted`).

Only objects faster than `Track.moving_mps` are counted: that one stands still is easily predicted. Places are
compared in the frame of `Tracks.T_world_sensor`, which the tracker estimates, so its errors count, too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

from ..tracking.tracks import AHEAD_S, Tracks
from .headings import FRAME_S, places
from .tracking_metrics import FrameTruth

COUNTS = (
    "n_predictions",
    "n_objects",
    "error_mm",  # the sum of their distances to the object
    "straight_mm",  # the same, if each drives straight on
)


def count_predictions(
    truth: Sequence[FrameTruth], tracks: Sequence[Tracks], matched: Iterable[tuple[int, int, int]]
) -> dict[str, Counter[str]]:
    """`COUNTS` of one sequence by time ahead (``"1 s"``), of the pairs of `headings.matches`."""
    at, met = places(truth, tracks), set()
    counted: dict[str, Counter[str]] = {f"{ahead_s:g} s": Counter(dict.fromkeys(COUNTS, 0)) for ahead_s in AHEAD_S}
    for k, i, row in matched:
        one, track = int(truth[k].ids[i]), tracks[k][row]
        for ahead_s, (name, counts) in zip(AHEAD_S, counted.items(), strict=True):
            later = k + round(ahead_s / FRAME_S)
            if later >= len(at) or one not in at[later]:
                continue
            if math.dist(at[k][one], at[later][one]) <= track.moving_mps * ahead_s:
                continue
            predicted = track.predicted(ahead_s, world=True).center[:2]
            straight = track.world_velocity[:2] * ahead_s + track.world_box.center[:2]
            error_mm, straight_mm = (round(1e3 * math.dist(at[later][one], place)) for place in (predicted, straight))
            counts.update(n_predictions=1, error_mm=error_mm, straight_mm=straight_mm)
            met.add((name, one))
    for name, _ in met:
        counted[name]["n_objects"] += 1
    return counted
