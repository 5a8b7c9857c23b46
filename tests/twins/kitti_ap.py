"""Slow twin of `edgeperc.evaluation.kitti_ap`: KITTI's development kit, step by step.

Numbers follow ``evaluate_object.cpp``: `clean_data`, `compute_statistics`, `get_thresholds`, `eval_class`. Boxes are in
KITTI's camera frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from twins.decode import clip_polygon, polygon_area, rectangle_corners

MIN_HEIGHT = {"easy": 40, "moderate": 25, "hard": 25}
MAX_OCCLUSION = {"easy": 0, "moderate": 1, "hard": 2}
MAX_TRUNCATION = {"easy": 0.15, "moderate": 0.3, "hard": 0.5}
N_SAMPLE_PTS = 41
NO_DETECTION = -10000000.0


@dataclass
class Object:
    """A row of a label file, or of a file of results."""

    type: str
    x1: float
    y1: float
    x2: float
    y2: float
    h: float
    w: float
    l: float  # noqa: E741
    t1: float
    t2: float
    t3: float
    ry: float
    truncation: float = 0.0
    occlusion: int = 0
    thresh: float = 0.0


def overlap(metric: str, d: Object, g: Object, criterion: int = -1) -> float:
    gp, dp = (rectangle_corners((each.t1, each.t3, each.l, each.w, -each.ry)) for each in (g, d))
    inter = polygon_area(clip_polygon(list(gp), dp))
    if metric == "bird's eye":
        return inter / ((polygon_area(gp) + polygon_area(dp) - inter) if criterion == -1 else polygon_area(dp))
    low, high = max(d.t2 - d.h, g.t2 - g.h), min(d.t2, g.t2)
    volume = inter * max(0.0, high - low)
    det_vol, gt_vol = d.h * d.l * d.w, g.h * g.l * g.w
    return volume / ((det_vol + gt_vol - volume) if criterion == -1 else det_vol)


def get_thresholds(v: list[float], n_groundtruth: int) -> list[float]:
    t = []
    v = sorted(v, reverse=True)
    current_recall = 0.0
    for i in range(len(v)):
        l_recall = (i + 1) / n_groundtruth
        r_recall = (i + 2) / n_groundtruth if i < len(v) - 1 else l_recall
        if (r_recall - current_recall) < (current_recall - l_recall) and i < len(v) - 1:
            continue
        t.append(v[i])
        current_recall += 1.0 / (N_SAMPLE_PTS - 1.0)
    return t


def clean_data(label: str, gt: list[Object], det: list[Object], level: str) -> tuple[list[int], list[int], int]:
    neighbors = {"car": "van", "pedestrian": "person_sitting"}
    ignored_gt, ignored_det, n_gt = [], [], 0
    for g in gt:
        valid = 1 if g.type == label else 0 if neighbors.get(label) == g.type else -1
        ignore = (
            g.occlusion > MAX_OCCLUSION[level]
            or g.truncation > MAX_TRUNCATION[level]
            or g.y2 - g.y1 <= MIN_HEIGHT[level]
        )
        if valid == 1 and not ignore:
            ignored_gt.append(0)
            n_gt += 1
        elif valid == 0 or (ignore and valid == 1):
            ignored_gt.append(1)
        else:
            ignored_gt.append(-1)
    for d in det:
        if int(abs(d.y1 - d.y2)) < MIN_HEIGHT[level]:
            ignored_det.append(1)
        else:
            ignored_det.append(0 if d.type == label else -1)
    return ignored_gt, ignored_det, n_gt


def compute_statistics(
    gt: list[Object],
    det: list[Object],
    ignored_gt: list[int],
    ignored_det: list[int],
    compute_fp: bool,
    metric: str,
    min_overlap: float,
    thresh: float = 0.0,
) -> tuple[int, int, list[float]]:
    tp = fp = 0
    v: list[float] = []
    assigned = [False] * len(det)
    below = [compute_fp and d.thresh < thresh for d in det]
    for i, g in enumerate(gt):
        if ignored_gt[i] == -1:
            continue
        det_idx, valid_detection, max_overlap, assigned_ignored = -1, NO_DETECTION, 0.0, False
        for j, d in enumerate(det):
            if ignored_det[j] == -1 or assigned[j] or below[j]:
                continue
            o = overlap(metric, d, g)
            if not compute_fp and o > min_overlap and d.thresh > valid_detection:
                det_idx, valid_detection = j, d.thresh
            elif compute_fp and o > min_overlap and (o > max_overlap or assigned_ignored) and ignored_det[j] == 0:
                max_overlap, det_idx, valid_detection, assigned_ignored = o, j, 1.0, False
            elif compute_fp and o > min_overlap and valid_detection == NO_DETECTION and ignored_det[j] == 1:
                det_idx, valid_detection, assigned_ignored = j, 1.0, True
        if valid_detection == NO_DETECTION:
            continue
        if not (ignored_gt[i] == 1 or ignored_det[det_idx] == 1):
            tp += 1
            v.append(det[det_idx].thresh)
        assigned[det_idx] = True
    if compute_fp:
        fp = sum(not (assigned[j] or ignored_det[j] != 0 or below[j]) for j in range(len(det)))
        n_stuff = 0
        for dc in (g for g in gt if g.type == "dontcare"):
            for j, d in enumerate(det):
                if assigned[j] or ignored_det[j] != 0 or below[j]:
                    continue
                if overlap(metric, d, dc, 0) > min_overlap:
                    assigned[j] = True
                    n_stuff += 1
        fp -= n_stuff
    return tp, fp, v


def eval_class(
    scans: list[tuple[list[Object], list[Object]]], label: str, level: str, metric: str, min_overlap: float
) -> tuple[int, float, float]:
    """Number of objects, R40 and R11 of (objects, detections) of every scan."""
    n_gt, v, cleaned = 0, [], []
    for gt, det in scans:
        ignored_gt, ignored_det, n = clean_data(label, gt, det, level)
        n_gt += n
        cleaned.append((gt, det, ignored_gt, ignored_det))
        v += compute_statistics(gt, det, ignored_gt, ignored_det, False, metric, min_overlap)[2]
    precision = [0.0] * N_SAMPLE_PTS
    thresholds = get_thresholds(v, n_gt)
    for i, thresh in enumerate(thresholds):
        counts = [compute_statistics(*each, True, metric, min_overlap, thresh)[:2] for each in cleaned]
        tp, fp = (sum(column) for column in zip(*counts, strict=True))
        precision[i] = tp / (tp + fp) if tp + fp else 0.0
    precision = [max(precision[i:]) for i in range(N_SAMPLE_PTS)]
    return n_gt, sum(precision[1:]) / 40, sum(precision[::4]) / 11


def read_row(kind: str, numbers: Any) -> Object:
    """An object from the 14 numbers of a row of a label file."""
    truncation, occlusion, _, x1, y1, x2, y2, h, w, length, t1, t2, t3, ry = (float(value) for value in numbers)
    return Object(kind, x1, y1, x2, y2, h, w, length, t1, t2, t3, ry, truncation, int(occlusion))
