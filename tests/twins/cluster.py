"""Slow twins of clustering, and boxes around clusters."""

from __future__ import annotations

import numpy as np


def clusters(
    points: np.ndarray, among: np.ndarray, min_distance: float, distance_per_m: float, max_range: float, min_points: int
) -> np.ndarray:
    """Twin of `edgeperc.objects.linkage.fill_clusters` with every point as a seed: every pair is looked at."""
    xyz = points[:, :3].astype(np.float64)
    used = np.flatnonzero(among & np.isfinite(xyz).all(axis=1) & (abs(xyz) <= max_range).all(axis=1))
    x, y, z = xyz[used].T
    reach = np.maximum(min_distance, distance_per_m * np.sqrt(x * x + y * y + z * z))
    dx, dy, dz = (np.subtract.outer(v, v) for v in (x, y, z))
    linked = dx * dx + dy * dy + dz * dz <= np.minimum.outer(reach, reach) ** 2
    found, number = np.full(len(points), -1), 0
    seen = np.zeros(len(used), bool)
    for k in range(len(used)):
        if seen[k]:
            continue
        members = np.zeros(len(used), bool)
        members[k] = True
        while (more := linked[members].any(axis=0) & ~members).any():
            members |= more
        seen |= members
        if members.sum() >= min_points:
            found[used[members]] = number
            number += 1
    return found


def votes(clusters: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twin of `edgeperc.objects.cluster.labels_of_groups`: a table of all clusters and labels."""
    counts = np.zeros((clusters.max(initial=-1) + 1, 256), int)
    np.add.at(counts, (clusters[clusters >= 0], labels[clusters >= 0]), 1)
    shares = counts[:, 1:].max(axis=1) / np.maximum(counts.sum(axis=1), 1)
    return np.where(shares > 0.0, counts[:, 1:].argmax(axis=1) + 1, 0), shares


def rectangle(members: np.ndarray, l_shaped: bool) -> np.ndarray:
    """Twin of `edgeperc.objects.boxes.fill_rectangle`: x, y, extent along, across, heading."""
    voting = members[:: -(-len(members) // 256)]

    def turned(points: np.ndarray, angle: float) -> np.ndarray:
        cos, sin = np.cos(angle), np.sin(angle)
        return np.c_[cos * points[:, 0] + sin * points[:, 1], cos * points[:, 1] - sin * points[:, 0]]

    def merit(angle: float) -> float:
        p = turned(voting, angle)
        low, high = p.min(axis=0), p.max(axis=0)
        if l_shaped:
            return (1 / np.maximum(np.minimum(p - low, high - p).min(axis=1), 0.05)).sum()
        return -np.prod(high - low)

    angles = np.pi / 2 * np.arange(90) / 90
    merits = np.array([merit(angle) for angle in angles])
    angle = angles[np.flatnonzero(merits >= merits.max() - 1e-9 * abs(merits.max()))[0]]
    p = turned(members, angle)
    low, high = p.min(axis=0), p.max(axis=0)
    x, y = turned((low + high)[None] / 2, -angle)[0]
    return np.array([x, y, *(high - low), angle])
