"""Slow twins of the kernels of candidates, their crops and the boxes of the object network."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from edgeperc.objects.candidate_boxes import MAX_LOG_SIDE, MERGED, SCORE, YAW
from edgeperc.objects.candidates import CELL_M, MIN_POINTS, MIN_TOP_M, N_SIDE, REACH_M, SAME
from edgeperc.objects.crops import LEVEL_MARGIN_M, MIN_SIDE_M, TOP_MARGIN_M


def cells(points: Any, height: Any, low: Any, high: Any) -> Any:
    """Twin of `objects.candidates.fill_cells`: flat cell -> rows of its points, in the order of their first points."""
    found = {}
    with np.errstate(invalid="ignore"):
        taken = (height > low) & (height < high) & (np.abs(points[:, :2]) < REACH_M).all(axis=1)
    for i in np.flatnonzero(taken).tolist():
        x, y = points[i, :2].astype(np.float64)
        row, col = (min(int((v + REACH_M) / CELL_M), N_SIDE - 1) for v in (x, y))
        found.setdefault(row * N_SIDE + col, []).append(i)
    return found


def groups(by_cell: Any, height: Any, scale: Any, per_m: Any) -> Any:
    """Twin of `objects.candidates.fill_groups_of_cells`: the cells of each group, as a set, in order."""
    active = [c for c, rows in by_cell.items() if any(scale.low_m < height[i] < scale.high_m for i in rows)]
    left, found = dict.fromkeys(active), []
    while left:
        group, open_ = set(), [next(iter(left))]
        while open_:
            cell = open_.pop()
            if cell not in left:
                continue
            del left[cell]
            group.add(cell)
            row, col = divmod(cell, N_SIDE)
            away = math.hypot((row + 0.5) * CELL_M - REACH_M, (col + 0.5) * CELL_M - REACH_M)
            reach = max(scale.link_m, per_m * away) / CELL_M
            open_ += [c for c in left if math.hypot(c // N_SIDE - row, c % N_SIDE - col) <= reach + 1e-12]
        found.append(group)
    return found


def is_candidate(points: Any, height: Any, rows: Any, scale: Any, n_cells: Any, around: Any) -> Any:
    """Whether `objects.candidates.fit_groups` fits a rectangle to a group; ``around``: cells of the outer group."""
    own = [i for i in rows if scale.low_m < height[i] < scale.high_m]
    if around is not None and n_cells >= SAME * around:
        return False
    xy = points[own, :2].astype(np.float64)
    diagonal = math.hypot(*(xy.max(axis=0) - xy.min(axis=0)))
    return len(own) >= MIN_POINTS and height[own].max() >= np.float32(MIN_TOP_M) and diagonal <= scale.longest_m


def crop(points: Any, height: Any, by_cell: Any, rectangle: Any, n_points: Any, margin_m: Any) -> Any:
    """Twin of `objects.crops.fill_crops` for one rectangle: points, their number, level."""
    x, y, length, width, yaw = rectangle
    near, core = [], []
    for cell in sorted(by_cell):
        for i in by_cell[cell]:
            dx, dy = points[i, :2].astype(np.float64) - (x, y)
            u, v = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
            if abs(u) < 0.5 * length + margin_m and abs(v) < 0.5 * width + margin_m:
                inner = abs(u) < 0.5 * length + LEVEL_MARGIN_M and abs(v) < 0.5 * width + LEVEL_MARGIN_M
                core += [float(points[i, 2]) - float(height[i])] if inner else []
                near.append((u, v, float(points[i, 2]), float(points[i, 3]), float(points[i, 2]) - float(height[i])))
    n = len(near)
    if n == 0:
        return np.zeros((n_points, 4)), 0, 0.0
    level = np.mean(core) if core else np.mean([point[4] for point in near])
    chosen = [k * n // n_points if n > n_points else k % n for k in range(n_points)]
    return np.array([[near[k][0], near[k][1], near[k][2] - level, near[k][3]] for k in chosen]), n, level


def features(points: Any, counts: Any, rectangles: Any, scale: Any) -> Any:
    """Twin of `objects.crops.fill_features`."""
    x, y, length, width, yaw = rectangles.T
    u, v = np.abs(points[:, :, 0]) - 0.5 * length[:, None], np.abs(points[:, :, 1]) - 0.5 * width[:, None]
    top = np.where((u < TOP_MARGIN_M) & (v < TOP_MARGIN_M), points[:, :, 2], 0.0).max(axis=1, initial=0.0)
    away = np.maximum(np.hypot(x, y), 1e-6)
    candidate = np.stack(
        [
            np.log(np.maximum(length, MIN_SIDE_M)),
            np.log(np.maximum(width, MIN_SIDE_M)),
            top,
            -(np.cos(yaw) * x + np.sin(yaw) * y) / away,
            -(np.cos(yaw) * y - np.sin(yaw) * x) / away,
            away,
            np.log(counts + 1.0),
        ],
        axis=1,
    )
    each = np.concatenate([points, u[:, :, None], v[:, :, None]], axis=2)
    whole = np.concatenate([each, np.repeat(candidate[:, None], points.shape[1], axis=1)], axis=2)
    return (whole - scale[0]) / scale[1]


def boxes(outputs: Any, rectangles: Any, level: Any, priors: Any) -> Any:
    """Twin of `objects.candidate_boxes.fill_boxes`."""
    c, found = len(priors), []
    for values, (x, y, _, _, turn), ground in zip(outputs.astype(np.float64), rectangles, level, strict=True):
        logits, place, sizes, axis, front, iou = np.split(values, np.cumsum([c + 1, 3, 3 * c, 2, 2]))
        chances = np.exp(logits - logits.max())
        chances /= chances.sum()
        label = 1 + int(logits[1:].argmax())
        size = priors[label - 1] * np.exp(np.clip(sizes.reshape(c, 3)[label - 1], -MAX_LOG_SIDE, MAX_LOG_SIDE))
        yaw = 0.5 * math.atan2(axis[1], axis[0])
        towards = math.cos(yaw) * front[0] + math.sin(yaw) * front[1]
        yaw += turn + (math.pi if towards < 0.0 else 0.0)
        center = x + math.cos(turn) * place[0] - math.sin(turn) * place[1]
        middle = y + math.sin(turn) * place[0] + math.cos(turn) * place[1]
        score = chances[label] / (1.0 + math.exp(-iou[0]))
        yaw = (yaw + math.pi) % (2.0 * math.pi) - math.pi
        bottom = ground + place[2] + 0.5 * size[2]
        found.append([center, middle, bottom, *size, yaw, score, label, 1.0 / (1.0 + math.exp(-abs(towards)))])
    return np.array(found).reshape(-1, 10)


def merged(rows: Any, iou: Any, best: Any) -> Any:
    """Twin of `objects.candidate_boxes.fill_merged`."""
    result = best.copy()
    for k in range(len(best)):
        alike = rows[iou[k] > MERGED]
        total = alike[:, SCORE].sum()
        if total > 0.0:
            result[k, :YAW] = alike[:, SCORE] @ alike[:, :YAW] / total
            off = alike[:, YAW] - best[k, YAW]
            off -= math.pi * np.floor(off / math.pi + 0.5)
            yaw = best[k, YAW] + alike[:, SCORE] @ off / total
            result[k, YAW] = (yaw + math.pi) % (2.0 * math.pi) - math.pi
    return result
