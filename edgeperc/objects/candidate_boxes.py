"""Boxes from the outputs of the object network: decoding, suppression and merging."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..errors import InferenceError
from ..system.kernels import njit
from ..types.card import ModelCard
from ..types.geometry import oriented_iou, rectangles, suppress_overlaps
from ..types.perception import Box
from ..types.points import Floats, Floats32, read_only

# Columns of decoded boxes.
X, Y, Z, LENGTH, WIDTH, HEIGHT, YAW, SCORE, LABEL, FRONT = range(10)
FOOTPRINT = [X, Y, LENGTH, WIDTH, YAW]
MAX_LOG_SIDE = 1.0  # of a side, divided by the usual one
# IoU of two objects; the lower limit of the two counts. People stand closer than vehicles.
MAX_OVERLAP = {"pedestrian": 0.3}
MAX_OVERLAP_OF_OTHERS = 0.1
MAX_INSIDE = 0.5  # of the smaller of two footprints
MERGED = 0.5  # IoU of boxes that are averaged
LEAST_SCORE = 0.03


def decode_objects(card: ModelCard, outputs: Floats32, rectangles: Floats, level: Floats) -> Floats:
    """Decode the outputs of candidates, whose rectangles (m, 5) are on the ground at ``level``.

    outputs : (m, n): logits of the classes, the background first; x, y of the middle in the candidate's frame and
        height of the bottom above the ground [m]; for each class but the background, the logarithms of length, width
        and height divided by the usual ones (``box_size_priors``); cosine and sine of twice the yaw; a vector whose
        component along a heading is the logit that the front is there; logit of the overlap (IoU) with the object.
    Returns (m, 10): x, y, z of the middle, length, width, height [m], yaw [rad] towards the more probable front, score,
        class (a row of ``card.classes``), probability of the front. The score is the probability of the most probable
        class of objects times the overlap.
    """
    if not np.isfinite(outputs).all():
        raise InferenceError(f"{card.name} gives values that are not finite; check the scan, or the model file")
    priors = np.array([card.box_size_priors[name] for name in card.box_classes])
    boxes = np.empty((len(rectangles), 10))
    fill_boxes(read_only(outputs), rectangles, level, priors, boxes)
    return boxes


def footprints(boxes: Floats) -> Floats:
    """x, y, length, width, yaw of boxes (m, 10), (m, 5)."""
    return boxes.take(FOOTPRINT, axis=1)


def merge_boxes(boxes: Floats, classes: Sequence[str]) -> Floats:
    """Of boxes (m, 10) of `decode_objects` around one object, the one with the best score, averaged by scores in place,
    size and heading with those that overlap it by more than 0.5; the best first.
    """
    boxes = boxes[boxes[:, SCORE] >= LEAST_SCORE]
    boxes = boxes[np.argsort(-boxes[:, SCORE], kind="stable")]
    flat = footprints(boxes)
    limits = np.array([MAX_OVERLAP.get(name, MAX_OVERLAP_OF_OTHERS) for name in classes])[boxes[:, LABEL].astype(int)]
    kept = suppress_overlaps(flat, boxes[:, SCORE], limits, max_inside=MAX_INSIDE)
    merged = boxes[kept]
    fill_merged(boxes, oriented_iou(flat[kept], flat), merged)
    return merged


def confirm_boxes(found: Floats, again: Floats) -> Floats:
    """Each box, (k, 10), as the mean of what further looks at it show, (r, k, 10) with a score of 0 for nothing, with
    the mean of the box's score and the looks' mean; class and front are those of the best look (`merge_boxes`).
    """
    scores, every = again[:, :, SCORE], again.reshape(-1, again.shape[2])
    best = again[scores.argmax(axis=0), np.arange(len(found))]
    confirmed = np.where(scores.max(axis=0)[:, np.newaxis] > 0.0, best, found)
    overlap = oriented_iou(footprints(confirmed), footprints(every))
    fill_merged(every, np.where(np.tile(np.eye(len(found), dtype=np.bool_), len(again)), overlap, 0.0), confirmed)
    confirmed[:, SCORE] = 0.5 * (found[:, SCORE] + scores.mean(axis=0))
    return confirmed


def with_footprints(boxes: Floats, others: Sequence[Box]) -> Floats:
    """Boxes (k, 10) of `merge_boxes`, with footprints averaged, by scores, with those of another network that overlap
    them by more than 0.5: its errors are other errors. Heights, which it does not know, scores and fronts stay.
    """
    theirs = np.zeros((len(others), 10))
    theirs[:, FOOTPRINT] = rectangles(others)
    theirs[:, SCORE] = [box.score for box in others]
    every, averaged = np.concatenate([boxes, theirs]), boxes.copy()
    fill_merged(every, oriented_iou(footprints(boxes), footprints(every)), averaged)
    averaged[:, [Z, HEIGHT]] = boxes[:, [Z, HEIGHT]]
    return averaged


def boxes_of_objects(boxes: Floats, classes: Sequence[str], min_score: float) -> list[Box]:
    """Rows of `merge_boxes` with at least a score, as boxes."""
    return [
        Box(classes[int(label)], score, (x, y, z), (length, width, height), yaw, front)
        for x, y, z, length, width, height, yaw, score, label, front in boxes.tolist()
        if score >= min_score
    ]


@njit(cache=True, nogil=True)
def fill_boxes(outputs: Floats32, rectangles: Floats, level: Floats, priors: Floats, boxes: Floats) -> None:
    """Write the boxes of `decode_objects`; ``priors`` (c, 3) has the usual sizes."""
    c = priors.shape[0]
    for k in range(outputs.shape[0]):
        most, best, total = outputs[k, 0], 1, 0.0
        for label in range(1, c + 1):
            most = max(most, outputs[k, label])
            best = label if outputs[k, label] > outputs[k, best] else best
        for label in range(c + 1):
            total += math.exp(outputs[k, label] - most)
        place, size = c + 1, c + 4 + 3 * (best - 1)
        turn = 4 + 4 * c
        cos, sin = math.cos(rectangles[k, 4]), math.sin(rectangles[k, 4])
        u, v = np.float64(outputs[k, place]), np.float64(outputs[k, place + 1])
        boxes[k, X] = rectangles[k, 0] + cos * u - sin * v
        boxes[k, Y] = rectangles[k, 1] + sin * u + cos * v
        for side in range(3):
            ratio = min(max(np.float64(outputs[k, size + side]), -MAX_LOG_SIDE), MAX_LOG_SIDE)
            boxes[k, LENGTH + side] = priors[best - 1, side] * math.exp(ratio)
        boxes[k, Z] = level[k] + outputs[k, place + 2] + 0.5 * boxes[k, HEIGHT]
        yaw = 0.5 * math.atan2(outputs[k, turn + 1], outputs[k, turn])
        front = math.cos(yaw) * outputs[k, turn + 2] + math.sin(yaw) * outputs[k, turn + 3]
        yaw += rectangles[k, 4] + (math.pi if front < 0.0 else 0.0)
        boxes[k, YAW] = (yaw + math.pi) % (2.0 * math.pi) - math.pi
        chance = math.exp(outputs[k, best] - most) / total
        boxes[k, SCORE] = chance / (1.0 + math.exp(-np.float64(outputs[k, turn + 4])))
        boxes[k, LABEL] = best
        boxes[k, FRONT] = 1.0 / (1.0 + math.exp(-abs(front)))


@njit(cache=True, nogil=True)
def fill_merged(boxes: Floats, iou: Floats, merged: Floats) -> None:
    """Average each row of ``merged`` (k, 10) with the ``boxes`` (m, 10) that overlap it enough, by ``iou`` (k, m)."""
    sums = np.empty(SCORE)
    for k in range(merged.shape[0]):
        total, turn = 0.0, 0.0
        for axis in range(SCORE):
            sums[axis] = 0.0
        for j in range(boxes.shape[0]):
            if iou[k, j] > MERGED:
                total += boxes[j, SCORE]
                for axis in range(YAW):
                    sums[axis] += boxes[j, SCORE] * boxes[j, axis]
                off = boxes[j, YAW] - merged[k, YAW]  # headings may differ by half a turn
                turn += boxes[j, SCORE] * (off - math.pi * math.floor(off / math.pi + 0.5))
        if total > 0.0:
            for axis in range(YAW):
                merged[k, axis] = sums[axis] / total
            merged[k, YAW] = (merged[k, YAW] + turn / total + math.pi) % (2.0 * math.pi) - math.pi
