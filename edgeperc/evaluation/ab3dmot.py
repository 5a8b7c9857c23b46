"""AB3DMOT's tracker, implemented again from its paper (Weng et al., IROS 2020), to compare `edgeperc.Tracker` with.

A Kalman filter of constant velocity follows each object in the sensor frame. Boxes are associated with it by their
generalized 3-D IoU or their distance. There is one tracker for each class, with the settings of its authors for
PointRCNN's detections on KITTI. Their compensation of the vehicle's own motion needs poses, which these sequences lack.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..types.geometry import wrapped
from ..types.perception import Box
from ..types.points import Floats, Ints64
from .metrics import box_rows
from .tracking_metrics import box_iou, fill_assignment


@dataclass(frozen=True, slots=True)
class Settings:
    """Association and life of the tracks of one class."""

    by_distance: bool  # associate by the distance of the centers, instead of generalized 3-D IoU
    greedy: bool  # assign the best pair first, instead of the best sum
    least: float  # lowest affinity of a pair: generalized IoU, or the negative distance [m]
    min_hits: int  # detections before a track is reported
    max_age: int  # scans without a detection after which it is deleted


SETTINGS = {
    "car": Settings(by_distance=False, greedy=False, least=-0.2, min_hits=3, max_age=2),
    "pedestrian": Settings(by_distance=False, greedy=True, least=-0.4, min_hits=1, max_age=4),
    "cyclist": Settings(by_distance=True, greedy=False, least=-2.0, min_hits=3, max_age=4),
}

# State: x, y, z, yaw, length, width, height, and the change of x, y, z from scan to scan.
N_STATE, N_SEEN = 10, 7
_F = np.eye(N_STATE) + np.eye(N_STATE, k=N_SEEN) * (np.arange(N_STATE) < 3)[:, None]
_Q = np.diag([1.0] * N_SEEN + [0.01] * 3)
_P = np.diag([10.0] * N_SEEN + [10000.0] * 3)
_ORDER = [0, 1, 2, 6, 3, 4, 5]  # a box's row -> the state's order
_BACK = [0, 1, 2, 4, 5, 6, 3]
_NUMBERS = [(name, "i8") for name in ("id", "hits", "missed")]
_TRACK = np.dtype([*_NUMBERS, ("score", "f8"), ("state", "f8", N_STATE), ("covariance", "f8", _P.shape)])


class Ab3dmot:
    """Track the boxes of one class from scan to scan, at a fixed rate."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self._n_scans = 0
        self._next_id = 1
        self._tracks = np.zeros(0, _TRACK)

    def update(self, boxes: Sequence[Box], scores: Sequence[float]) -> tuple[Ints64, Floats, Floats, Ints64]:
        """Track the boxes of a scan: ids, rows, scores of the last detection, the detections' indices (-1: none)."""
        self._n_scans += 1
        given, tracks = box_rows(boxes), self._tracks
        states = np.ascontiguousarray(tracks["state"]) @ _F.T
        states[:, 3] = wrapped(states[:, 3])
        covariances = _F @ np.ascontiguousarray(tracks["covariance"]) @ _F.T + _Q
        source = np.full(len(states), -1)
        for detection, track in self._pairs(given, states[:, _BACK]):
            source[track] = detection
        is_matched = source >= 0
        tracks["missed"] = np.where(is_matched, 0, tracks["missed"] + 1)
        tracks["hits"] += is_matched
        tracks["score"] = np.where(is_matched, np.append(scores, 0.0)[source], tracks["score"])

        # Headings are known up to half a turn; the state turns to the detection's direction.
        seen = given[source[is_matched]][:, _ORDER]
        mine = states[is_matched]
        off = np.abs(wrapped(seen[:, 3] - mine[:, 3])) > math.pi / 2.0
        mine[off, 3] += math.pi
        innovation = seen - mine[:, :N_SEEN]
        innovation[:, 3] = wrapped(innovation[:, 3])
        spread = covariances[is_matched]
        gain = spread[:, :, :N_SEEN] @ np.linalg.inv(spread[:, :N_SEEN, :N_SEEN] + np.eye(N_SEEN))
        states[is_matched] = mine + (gain @ innovation[:, :, None])[:, :, 0]
        states[:, 3] = wrapped(states[:, 3])
        covariances[is_matched] = spread - gain @ spread[:, :N_SEEN]
        tracks["state"], tracks["covariance"] = states, covariances

        new = np.setdiff1d(np.arange(len(given)), source)
        born = np.zeros(len(new), _TRACK)
        born["id"] = self._next_id + np.arange(len(new))
        self._next_id += len(new)
        born["state"][:, :N_SEEN] = given[new][:, _ORDER]
        born["covariance"], born["hits"], born["score"] = _P, 1, np.asarray(scores, np.float64)[new]
        tracks, source = np.concatenate([tracks, born]), np.concatenate([source, new])

        stays = tracks["missed"] < self.settings.max_age
        shown = stays & ((tracks["hits"] >= self.settings.min_hits) | (self._n_scans <= self.settings.min_hits))
        self._tracks = tracks[stays]
        return tracks["id"][shown], tracks["state"][shown][:, _BACK], tracks["score"][shown], source[shown]

    def _pairs(self, boxes: Floats, tracks: Floats) -> list[tuple[int, int]]:
        """Pairs (detection, track) of at least the lowest affinity."""
        if self.settings.by_distance:
            affinity = -np.linalg.norm(boxes[:, None, :3] - tracks[None, :, :3], axis=2)
        else:
            affinity = generalized_iou(boxes, tracks)
        made: list[tuple[int, int]] = []
        if self.settings.greedy:
            free = np.ones(affinity.shape, np.bool_)
            for index in np.argsort(-affinity, axis=None, kind="stable").tolist():
                i, j = divmod(index, len(tracks))
                if free[i, j]:
                    made.append((i, j))
                    free[i] = free[:, j] = False
        elif affinity.size:
            column = np.empty(len(boxes), np.int64)
            fill_assignment(affinity - affinity.min() + 1e3, column)  # as many pairs as possible, then the best sum
            made = [(i, int(j)) for i, j in enumerate(column) if j >= 0]
        return [(i, j) for i, j in made if affinity[i, j] >= self.settings.least]


def generalized_iou(a: Floats, b: Floats) -> Floats:
    """Generalized 3-D IoU (n, m) of boxes (n, 7) and (m, 7): IoU less the share of the smallest upright prism around
    both that neither fills; -1 for boxes farther apart than the sum of their lengths and widths.
    """
    iou = box_iou(a, b)
    volumes = np.add.outer(a[:, 3:6].prod(axis=1), b[:, 3:6].prod(axis=1))
    union = volumes / (1.0 + iou)
    top = np.maximum.outer(a[:, 2] + a[:, 5] / 2.0, b[:, 2] + b[:, 5] / 2.0)
    height = top - np.minimum.outer(a[:, 2] - a[:, 5] / 2.0, b[:, 2] - b[:, 5] / 2.0)
    apart = np.hypot(np.subtract.outer(a[:, 0], b[:, 0]), np.subtract.outer(a[:, 1], b[:, 1]))
    near = apart <= np.add.outer(a[:, 3] + a[:, 4], b[:, 3] + b[:, 4])
    around = np.full(iou.shape, np.inf)
    corners = _corners(a), _corners(b)
    for i, j in np.argwhere(near).tolist():
        around[i, j] = height[i, j] * _hull_area([*corners[0][i], *corners[1][j]])
    return iou - 1.0 + union / np.maximum(around, union)


def _corners(boxes: Floats) -> list[list[tuple[float, float]]]:
    signs = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    along, across = (signs[None] * boxes[:, None, 3:5]).transpose(2, 0, 1)
    cos, sin = np.cos(boxes[:, 6:]), np.sin(boxes[:, 6:])
    x, y = boxes[:, :1] + cos * along - sin * across, boxes[:, 1:2] + sin * along + cos * across
    return [list(zip(*row, strict=True)) for row in zip(x.tolist(), y.tolist(), strict=True)]


def _hull_area(points: list[tuple[float, float]]) -> float:
    """Area of the convex hull of points, by Andrew's monotone chain."""
    area = 0.0
    points = sorted(points)
    for one_way in (points, points[::-1]):
        chain: list[tuple[float, float]] = []
        for x, y in one_way:
            while len(chain) > 1:
                (ax, ay), (bx, by) = chain[-2:]
                if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0.0:
                    break
                chain.pop()
            chain.append((x, y))
        area += 0.5 * sum(ax * by - bx * ay for (ax, ay), (bx, by) in itertools.pairwise(chain))
    return area
