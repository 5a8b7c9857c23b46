"""Slow twins of the agreement of labels, boxes and cells."""

from __future__ import annotations

from typing import Any

import numpy as np


def cells_of(points: np.ndarray, cell_m: float, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and column of each point in a square grid around the sensor, and whether it is in the grid."""
    x, y = (points[:, k].astype(np.float64) + 0.5 * n * cell_m for k in range(2))
    known = (x >= 0.0) & (x < n * cell_m) & (y >= 0.0) & (y < n * cell_m)
    row, col = (np.minimum(np.where(known, v, 0.0) / cell_m, n - 1).astype(int) for v in (x, y))
    return row, col, known


def columns(points: np.ndarray, height: np.ndarray, limits: Any, labels: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.agreement.rules.clear_columns`."""
    row, col, known = cells_of(points, 0.2, 512)
    h = height.astype(np.float64)
    known = known & (h >= 0.0) & (h < 64 * 0.1)
    level = np.minimum(np.where(known, h, 0.0) / 0.1, 63).astype(int)
    cleared = labels.copy()
    for i in np.flatnonzero(known & (limits[labels] > 0.0)):
        near = known & (height >= np.float32(0.2)) & (np.abs(row - row[i]) <= 1) & (np.abs(col - col[i]) <= 1)
        top = level[i]
        for at in np.unique(level[near]):
            if top < at <= top + 4:  # three empty levels of 0.1 m at most
                top = at
        if (top + 1) * 0.1 > limits[labels[i]] + 0.05:
            cleared[i] = 0
    return cleared


def tallies(
    cloud: Any, in_view: np.ndarray, labels: np.ndarray, clusters: np.ndarray, view: Any, n: int, n_classes: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twin of `edgeperc.agreement.votes.fill_tallies`."""
    (points, height), (cells, is_vehicle, grid) = cloud, view
    counts = np.zeros((n, n_classes + 1), np.int32)
    bounds = np.empty((n, 5), np.float32)
    above = np.zeros((n, 3), np.int32)
    row, col = ((grid[k] - points[:, k].astype(np.float64)) / grid[2] for k in range(2))
    is_held = (row >= 0) & (row < cells.shape[0]) & (col >= 0) & (col < cells.shape[1])
    marked = np.zeros(len(points), np.bool_)
    marked[is_held] = is_vehicle[cells[row[is_held].astype(int), col[is_held].astype(int)]]
    for k in range(n):
        own = clusters == k
        counts[k, :-1] = np.bincount(labels[own & in_view], minlength=n_classes)
        counts[k, -1] = np.count_nonzero(own & in_view)
        xy = points[own, :2]
        bounds[k, :2] = xy.min(axis=0, initial=np.inf)
        bounds[k, 2:4] = xy.max(axis=0, initial=-np.inf)
        bounds[k, 4] = height[own].max(initial=-np.inf)
        above[k, :2] = np.count_nonzero(own & in_view & is_held), np.count_nonzero(own & in_view & marked)
        above[k, 2] = np.count_nonzero(own)
    return counts, bounds, above


def inside(cloud: Any, on_ground: np.ndarray, box: Any) -> np.ndarray:
    """Points above the ground in a box of `edgeperc.agreement.rules.fill_support`, (n,) bool."""
    x, y, half_l, half_w, cos, sin, highest, *_ = box.tolist()
    dx, dy = cloud.points[:, 0].astype(np.float64) - x, cloud.points[:, 1].astype(np.float64) - y
    with np.errstate(invalid="ignore"):
        is_around = (np.abs(cos * dx + sin * dy) <= half_l) & (np.abs(cos * dy - sin * dx) <= half_w)
        return ~on_ground & is_around & (cloud.height <= highest)


def support(cloud: Any, on_ground: np.ndarray, labeled: Any, boxes: Any) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.agreement.rules.fill_support`."""
    scores, names = np.zeros(len(on_ground), np.float32), np.zeros(len(on_ground), np.uint8)
    for box in boxes:
        own = inside(cloud, on_ground, box)
        if np.count_nonzero(labeled.roles[labeled.labels[own]] == 1) < 0.1 * np.count_nonzero(own):
            continue
        better = own & (box["score"] > scores)
        scores[better], names[better] = box["score"], box["label"]
    return scores, names


def inside_counts(cloud: Any, on_ground: np.ndarray, in_view: np.ndarray, labeled: Any, boxes: Any) -> np.ndarray:
    """Twin of `edgeperc.agreement.rules.count_inside`."""
    seen_vehicles = in_view & (labeled.roles[labeled.labels] == 1)
    own = [inside(cloud, on_ground, box) for box in boxes]
    return np.array([[(o & of).sum() for of in (o, in_view, seen_vehicles)] for o in own], np.int64).reshape(-1, 3)


def inside_sums(cloud: Any, on_ground: np.ndarray, in_view: np.ndarray, labeled: Any, boxes: Any) -> np.ndarray:
    """Twin of `edgeperc.agreement.rules.sum_inside`."""
    (points, height), sums = cloud, np.zeros((len(boxes), 3))
    for row, box in zip(sums, boxes, strict=True):
        own = inside(cloud, on_ground, box) & (height >= 0.0) & (~in_view | (labeled.roles[labeled.labels] == 1))
        levels = points[own, 2].astype(np.float64) - height[own]
        row[:] = np.count_nonzero(own), sum(levels.tolist()), max(0.0, 0.0, *height[own].tolist())
    return sums


def verdicts(in_view: np.ndarray, clusters: np.ndarray, table: np.ndarray, support: Any, labeled: Any) -> np.ndarray:
    """Twin of `edgeperc.agreement.votes.apply_verdicts`."""
    (scores, names), (labels, roles) = support, labeled
    agreed = labels.copy()
    for i in np.flatnonzero(in_view):
        old, k = labels[i], clusters[i]
        new = old if k == -1 else table[k, old] if k >= 0 else 0 if roles[old] else old
        if k != -1 and roles[old] == 1 and roles[new] == 0 and scores[i] >= 0.3:
            new = old
        if scores[i] >= 0.5 and (new == 0 or roles[new] == 1):
            new = names[i]
        agreed[i] = new
    return agreed


def votes(in_view: np.ndarray, labeled: Any, scores: np.ndarray) -> np.ndarray:
    """Twin of `edgeperc.agreement.votes.fill_votes`."""
    role = labeled.roles[labeled.labels]
    return np.where(in_view, 1 + 2 * ((role == 1) | (scores >= 0.5)) + 4 * (role == 2), 0)


def verdict_table(
    counts: np.ndarray, bounds: np.ndarray, refused: np.ndarray, roles: np.ndarray, parts: Any, applied: Any, sight: Any
) -> np.ndarray:
    """Twin of `edgeperc.agreement.votes.fill_verdicts`: all clusters at once."""
    (by_share, by_height, is_filled), (eye_m, slope) = applied, sight
    vehicles, persons = np.flatnonzero(roles == 1), np.flatnonzero(roles == 2)
    seen = np.maximum(counts[:, -1], 1)
    vehicle_share, person_share = counts[:, vehicles].sum(axis=1) / seen, counts[:, persons].sum(axis=1) / seen
    length, top = np.hypot(*(bounds[:, 2:4].astype(np.float64) - bounds[:, :2]).T), bounds[:, 4]
    large = (length > 10.0) | (top > 4.0)
    low, high = bounds[:, :2].astype(np.float64), bounds[:, 2:4].astype(np.float64)
    away = np.hypot(*np.maximum(np.maximum(low, -high), 0.0).T)  # of the nearest place of the bounds
    visible = 0.7 * (eye_m + slope * np.minimum(away, 1000.0))
    is_own = (np.hypot(*np.maximum(np.abs(low), np.abs(high)).T) < 2.6) & (person_share < 0.1)
    is_own &= (length < 2.0) | (top < 1.7)
    is_low = top < np.minimum(np.where(away < 30.0, 1.0, 0.5), visible)
    no_vehicle = refused | by_share & (vehicle_share < np.where(large, 0.75, 0.6)) | by_height & (is_low | is_own)
    no_person = by_share & (person_share < 0.1) | by_height & (top < np.minimum(1.0, visible))
    table = np.tile(np.arange(len(roles), dtype=np.uint8), (len(counts), 1))
    table[np.ix_(no_vehicle, vehicles)] = 0
    table[np.ix_(no_person, persons)] = 0
    if is_filled:
        filled = ~no_vehicle & (vehicle_share >= 0.6) & ~large
        most = vehicles[np.argmax(counts[:, vehicles], axis=1)]
        table[np.ix_(filled, np.array([0, *vehicles, *persons]))] = most[filled, None]
        filled = ~no_person & (person_share >= 0.6) & (length < 3.0) & (top < 2.1)
        most = persons[np.argmax(counts[:, persons], axis=1)]
        for part, whole in parts:
            most = np.where(counts[:, whole] >= 0.25 * (counts[:, part] + counts[:, whole]), whole, most)
        table[np.ix_(filled, np.array([0, *persons]))] = most[filled, None]
    return table


def ground(cloud: Any, on_ground: np.ndarray, labeled: Any) -> np.ndarray:
    """Twin of `edgeperc.agreement.rules.clear_ground`."""
    (points, height), (labels, roles) = cloud, labeled
    row, col, known = cells_of(points, 0.2, 1024)
    cleared = labels.copy()
    for role in (1, 2):
        own = roles[labels] == role
        standing = {*zip(row[own & ~on_ground & known], col[own & ~on_ground & known], strict=True)}
        is_road = (height < 0.06) & ((points[:, :2].astype(np.float64) ** 2).sum(axis=1) < 36.0)
        for i in np.flatnonzero(own & on_ground):
            if is_road[i] or not known[i] or (row[i], col[i]) not in standing:
                cleared[i] = 0
    return cleared


def cells(
    cloud: Any, in_view: np.ndarray, labeled: Any, by_height: bool, view: Any, drivable: int, in_box: np.ndarray
) -> np.ndarray:
    """Twin of `edgeperc.agreement.cells.fill_marks` and `clear_cells`."""
    (points, height), (labels, roles), (cells, is_vehicle, (far, left, cell_m)) = cloud, labeled, view
    returns, vehicles, others = np.zeros(cells.shape, int), np.zeros(cells.shape, bool), np.zeros(cells.shape, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        row = (far - points[:, 0].astype(np.float64)) / cell_m
        col = (left - points[:, 1].astype(np.float64)) / cell_m
        known = (row >= 0) & (row < cells.shape[0]) & (col >= 0) & (col < cells.shape[1])
        is_object = known & (roles[labels] != 0)
        is_obstacle = known & ~is_object & (height >= 0.3) & (height <= 2.0) & by_height
    for i in np.flatnonzero(is_obstacle):
        returns[int(row[i]), int(col[i])] += 1
    for i in np.flatnonzero(is_object):
        returns[int(row[i]), int(col[i])] = 2
    for i in np.flatnonzero(known & in_view):
        (vehicles if roles[labels[i]] == 1 else others)[int(row[i]), int(col[i])] = True
    cleared = cells.copy()
    for r, c in np.ndindex(*cells.shape):
        around = slice(max(r - 1, 0), r + 2), slice(max(c - 1, 0), c + 2)
        blocked = returns[r, c] > 0 and np.minimum(returns[around], 2).sum() >= 2
        contradicted = others[r, c] and not vehicles[around].any() and not in_box[r, c]
        if (cells[r, c] == drivable and blocked) or (is_vehicle[cells[r, c]] and contradicted):
            cleared[r, c] = 0
    return cleared
