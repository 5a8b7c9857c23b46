"""Slow twins of decoding a network's output, and of boxes' overlaps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np


def rectangle_corners(rectangle: Any) -> np.ndarray:
    """Corners of x, y, length, width, yaw, counter-clockwise, (4, 2)."""
    x, y, length, width, yaw = rectangle
    local = 0.5 * np.array([[length, width], [-length, width], [-length, -width], [length, -width]])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    return local @ turn.T + [x, y]


def polygon_area(corners: Any) -> float:
    """Shoelace formula; 0 for fewer than three corners."""
    if len(corners) < 3:
        return 0.0
    x, y = np.asarray(corners, dtype=np.float64).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))


def clip_polygon(subject: Any, clip: Any) -> list[Any]:
    """Sutherland and Hodgman: the part of polygon ``subject`` inside the convex, counter-clockwise ``clip``."""
    for start, end in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        edge = end - start

        def side(p: np.ndarray, start: tuple[float, float] | np.ndarray = start, edge: np.ndarray = edge) -> float:
            return edge[0] * (p[1] - start[1]) - edge[1] * (p[0] - start[0])

        inside = []
        for k, corner in enumerate(subject):
            last = subject[k - 1]
            if (side(corner) >= 0.0) != (side(last) >= 0.0):
                share = side(last) / (side(last) - side(corner))
                inside.append(last + share * (corner - last))
            if side(corner) >= 0.0:
                inside.append(corner)
        subject = inside
    return subject


def oriented_iou(a: Any, b: Any) -> np.ndarray:
    """Twin of `edgeperc.types.geometry.fill_oriented_iou`."""
    iou = np.zeros((len(a), len(b)))
    for i, first in enumerate(np.asarray(a, dtype=np.float64)):
        for j, second in enumerate(np.asarray(b, dtype=np.float64)):
            if not (np.isfinite([*first, *second]).all() and min(*first[2:4], *second[2:4]) > 0.0):
                continue
            shared = polygon_area(clip_polygon(list(rectangle_corners(first)), rectangle_corners(second)))
            union = first[2] * first[3] + second[2] * second[3] - shared
            iou[i, j] = shared / union
    return iou


def nms(rectangles: np.ndarray, iou_threshold: float | np.ndarray, max_inside: float = np.inf) -> np.ndarray:
    """Twin of `edgeperc.types.geometry.mark_nms`."""
    iou = oriented_iou(rectangles, rectangles)
    limits = np.broadcast_to(iou_threshold, len(rectangles))
    area = rectangles[:, 2] * rectangles[:, 3]
    shared = iou / (1.0 + iou) * np.add.outer(area, area)
    same = (iou > np.minimum.outer(limits, limits)) | (shared > max_inside * np.minimum.outer(area, area))
    keep = np.ones(len(rectangles), dtype=bool)
    for i in range(len(rectangles)):
        keep[i] = not same[i, :i][keep[:i]].any()
    return keep


def softmax(logits: np.ndarray) -> np.ndarray:
    """Probabilities along axis 0, in float64."""
    logits = np.asarray(logits, dtype=np.float64)
    e = np.exp(logits - logits.max(axis=0, keepdims=True))
    return e / e.sum(axis=0, keepdims=True)


def classes(values: np.ndarray, are_logits: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """Twin of `decode.fill_labels` and `fill_scores`: labels, scores, number of values that are not finite."""
    labels = np.argmax(values, axis=0).astype(np.uint8)
    probabilities = softmax(values) if are_logits else values
    return labels, probabilities.max(axis=0), int((~np.isfinite(values)).sum())


def peaks(heat: np.ndarray, threshold: float) -> np.ndarray:
    """Twin of `edgeperc.inference.box_heads.mark_peaks`."""
    padded = np.pad(heat.astype(np.float64), 1, constant_values=-np.inf)
    height, width = heat.shape
    peak = heat >= threshold
    for d_row in (-1, 0, 1):
        for d_col in (-1, 0, 1):
            other = padded[1 + d_row : 1 + d_row + height, 1 + d_col : 1 + d_col + width]
            if (d_row, d_col) < (0, 0):
                peak = peak & (heat > other)
            elif (d_row, d_col) > (0, 0):
                peak = peak & (heat >= other)
    return peak


def facing(yaw: float, x: float, y: float) -> tuple[float, bool]:
    """Twin of `box_heads._facing` for one box: the yaw of the likelier front, and its probability."""
    logit = np.dot([np.cos(yaw), np.sin(yaw)], [x, y])
    with np.errstate(over="ignore"):
        front = 1.0 / (1.0 + np.exp(-np.float64(logit)))
    if front >= 0.5:
        return yaw, front
    return (yaw - np.pi if yaw > 0.0 else yaw + np.pi), 1.0 - front


def footprint_sums(
    values: np.ndarray,
    are_logits: bool,
    rectangles: np.ndarray,
    x_far: float,
    y_left: float,
    cell: float,
    max_summed: int = 2**18,
) -> Any:
    """Twin of `edgeperc.inference.box_heads.fill_footprint_sums`."""
    probabilities = softmax(values) if are_logits else values.astype(np.float64)
    _, height, width = values.shape
    x = x_far - (np.arange(height)[:, None] + 0.5) * cell
    y = y_left - (np.arange(width)[None, :] + 0.5) * cell
    sums = np.zeros((len(rectangles), len(values)))
    for i, (at_x, at_y, length, across, yaw) in enumerate(rectangles):
        along = (x - at_x) * np.cos(yaw) + (y - at_y) * np.sin(yaw)
        aside = (y - at_y) * np.cos(yaw) - (x - at_x) * np.sin(yaw)
        inside = (abs(along) <= length / 2) & (abs(aside) <= across / 2)
        # Under huge rectangles only some rows and columns are summed.
        reach = 0.5 * np.hypot(length, across)
        first = [max(int(np.floor((edge - at - reach) / cell)), 0) for edge, at in ((x_far, at_x), (y_left, at_y))]
        last = [
            min(int(np.ceil((edge - at + reach) / cell)), size)
            for edge, at, size in ((x_far, at_x, height), (y_left, at_y, width))
        ]
        n_values = len(values) * max(last[0] - first[0], 0) * max(last[1] - first[1], 0)
        step = max(int(np.ceil(np.sqrt(n_values / max_summed))), 1)
        summed = np.zeros_like(inside)
        summed[first[0] :: step, first[1] :: step] = True
        inside &= summed
        if not inside.any():
            row = min(max(int(np.floor((x_far - at_x) / cell)), 0), height - 1)
            col = min(max(int(np.floor((y_left - at_y) / cell)), 0), width - 1)
            inside[row, col] = True
        sums[i] = probabilities[:, inside].sum(axis=1)
    return sums


def footprints(labels: np.ndarray, boxes: Sequence[Any], view: Any, classes: Sequence[str]) -> None:
    """Twin of `edgeperc.types.geometry.draw_footprints`: every cell of the view for every box."""
    x, y = view.cell_centers()
    for box in sorted(boxes, key=lambda box: -np.hypot(*box.center[:2])):
        dx, dy, cos, sin = x - box.center[0], y - box.center[1], np.cos(box.yaw), np.sin(box.yaw)
        is_in = (abs(cos * dx + sin * dy) <= box.size[0] / 2) & (abs(cos * dy - sin * dx) <= box.size[1] / 2)
        if box.label in classes:
            labels[is_in] = classes.index(box.label)
