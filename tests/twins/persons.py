"""Slow twins of the kernels of persons."""

from __future__ import annotations

from typing import Any

import numpy as np

from edgeperc.objects import persons


def measured(cloud: Any, members: np.ndarray, above: float) -> np.ndarray:
    """Twin of `persons.measure`: the axis is the mean direction of squared offsets, as complex numbers."""
    tall = cloud.height[members].astype(np.float64)
    top = tall.max(initial=-np.inf)
    xy = cloud.points[members, :2].astype(np.float64)[tall > above]
    if len(xy) == 0:
        return np.array([0, 0, 0, 0, 0, 0, top])
    offsets = (xy - xy.mean(axis=0)) @ [1, 1j]
    axis = np.exp(0.5j * np.angle((offsets**2).sum()))
    u, v = along(cloud, members, axis.real, axis.imag)
    u, v = u[tall > above], v[tall > above]
    return np.array([axis.real, axis.imag, u.min(), u.max(), v.min(), v.max(), top])


def along(cloud: Any, members: np.ndarray, cos: float, sin: float) -> tuple[np.ndarray, np.ndarray]:
    x, y = cloud.points[members, :2].astype(np.float64).T
    return cos * x + sin * y, cos * y - sin * x


def groups(cloud: Any, labeled: Any, clusters: np.ndarray) -> tuple[list[Any], list[int]]:
    """Twin of `edgeperc.objects.persons.fill_person_groups`: the groups, and the points outside of them."""
    whole, loose = [], []
    for k in range(clusters.max(initial=-1) + 1):
        members = np.flatnonzero(clusters == k)
        role = labeled.roles[labeled.labels[members]]
        own, n_seen = members[(role > 0) & (role < persons.UNSEEN)], (role != persons.UNSEEN).sum()
        if len(own) == 0:
            continue
        found = measured(cloud, members, -np.inf)
        small = found[3] - found[2] <= persons.MAX_LENGTH_M and found[6] <= persons.MAX_TOP_M
        if small and len(own) >= persons.MIN_GROUP_SHARE * n_seen:
            whole.append(members)
        else:
            loose += own.tolist()
    return whole, loose


def border(cloud: Any, members: np.ndarray, above: float, found: np.ndarray) -> float:
    """Twin of `edgeperc.objects.persons.border_of`: a smoothed histogram."""
    length = found[3] - found[2]
    n = int(min(length / persons.BIN_M, persons.MAX_BINS - 1)) + 1
    edge = max(persons.BIN_M, length / n)
    u, _ = along(cloud, members, found[0], found[1])
    u = u[cloud.height[members].astype(np.float64) > above] - found[2]
    counts = np.bincount(np.clip((u / edge).astype(int), 0, n - 1), minlength=n)
    smooth = np.convolve(counts, [1, 2, 1])[1:-1]
    places = (np.arange(n) + 0.5) * edge
    free = [b for b in range(n) if persons.MIN_PART_M <= places[b] <= length - persons.MIN_PART_M]
    best = min(free, key=lambda b: (smooth[b], abs(places[b] - length / 2)), default=None)
    return found[2] + (length / 2 if best is None else places[best])


def heads(cloud: Any, members: np.ndarray, found: np.ndarray) -> float:
    """Twin of `edgeperc.objects.persons.head_width`: sorted places, cut at gaps."""
    upper = members[cloud.height[members].astype(np.float64) > found[6] - persons.HEAD_M]
    u, v = along(cloud, upper, found[0], found[1])
    if np.ptp(v) > persons.MAX_FLAT_M:
        return 0.0
    gap = max(
        persons.HEAD_GAP_M, persons.HEAD_GAP_PER_M * np.hypot(*cloud.points[upper, :2].astype(np.float64).T).min()
    )
    u = np.sort(u)
    parts = np.split(u, np.flatnonzero(np.diff(u) > gap) + 1)
    return max(np.ptp(part) for part in parts)


def divided(cloud: Any, members: np.ndarray, n_cuts: int = 0) -> list[Any]:
    """The parts of a group, each one person."""
    limit = persons.UPPER * measured(cloud, members, -np.inf)[6]
    upper = measured(cloud, members, limit)
    if upper[3] - upper[2] <= persons.MAX_UPPER_M or n_cuts == persons.MAX_CUTS:
        return [members]
    u, _ = along(cloud, members, upper[0], upper[1])
    first = u <= border(cloud, members, limit, upper)
    parts = [part for part in (members[first], members[~first]) if len(part)]
    return [own for part in parts for own in divided(cloud, part, n_cuts + 1)]


def rows(
    cloud: Any, labeled: Any, groups: list[np.ndarray], n_whole: int, clusters: np.ndarray, min_points: int
) -> np.ndarray:
    """Twin of `edgeperc.objects.persons.fill_persons`: a row for each part that is large enough."""
    (points, height), role, found = cloud, labeled.roles[labeled.labels], []
    for k, group in enumerate(groups):
        box = measured(cloud, group, -np.inf)
        if not np.isfinite(box).all():
            continue
        width = heads(cloud, group, box)
        for part in divided(cloud, group):
            if len(part) < min_points:
                continue
            box = measured(cloud, part, -np.inf)
            of = role[part]
            n_seen = n_near = (of != persons.UNSEEN).sum()
            if k >= n_whole:
                is_near = (clusters == clusters[part[0]]) & (height <= persons.MAX_TOP_M)
                near = np.flatnonzero(is_near & (role != persons.UNSEEN))
                u, v = along(cloud, near, box[0], box[1])
                inside = (u >= box[2] - persons.NEAR_M) & (u <= box[3] + persons.NEAR_M)
                inside &= (v >= box[4] - persons.NEAR_M) & (v <= box[5] + persons.NEAR_M)
                n_near = max(n_near, inside.sum())
            u, v = (box[2] + box[3]) / 2, (box[4] + box[5]) / 2
            n, n_riding = ((of > 0) & (of < persons.UNSEEN)).sum(), (of == persons.RIDES).sum()
            rides = n_riding > 0 and n_riding >= 0.25 * n
            z = points[part, 2].astype(np.float64)
            middle = u * box[0] - v * box[1], u * box[1] + v * box[0]
            extent = box[3] - box[2], box[5] - box[4], np.arctan2(box[1], box[0])
            levels = (z - height[part].astype(np.float64)).mean(), z.max()
            found.append([rides, *middle, *extent, *levels, n_seen, n / max(n_near, 1), width])
    return np.array(found).reshape(-1, 11)


def completed(
    cloud: Any, in_view: np.ndarray, clusters: np.ndarray, walks: int, rides: int, labels: np.ndarray
) -> np.ndarray:
    """Twin of `edgeperc.objects.persons.complete_persons`."""
    labels = labels.copy()
    for k in range(clusters.max(initial=-1) + 1):
        members = np.flatnonzero(clusters == k)
        own = labels[members]
        n, n_riding, n_seen = np.isin(own, (walks, rides)).sum(), (own == rides).sum(), in_view[members].sum()
        if n < 5 or n < persons.MIN_GROUP_SHARE * n_seen or np.ptp(cloud.points[members, :2], axis=0).max() > 4.6:
            continue
        box = measured(cloud, members, -np.inf)
        upper = measured(cloud, members, persons.UPPER * box[6])
        length, top = box[3] - box[2], box[6]
        riding = length > persons.MAX_STRIDE_M or (n_riding > 0 and n_riding >= 0.25 * n)
        if box[5] - box[4] > (0.8 if riding else 0.7):
            continue
        if length > persons.MAX_LENGTH_M or top > persons.MAX_TOP_M or upper[3] - upper[2] > persons.MAX_UPPER_M:
            continue
        whole = n >= 0.3 * n_seen and 1.3 <= top <= 2.0
        changed = in_view[members] & (np.isin(own, (walks, rides)) | (whole & (own == 0)))
        if whole or length > persons.MAX_STRIDE_M:
            labels[members[changed]] = rides if riding else walks
    return labels
