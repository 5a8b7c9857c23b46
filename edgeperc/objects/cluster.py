"""Cluster points by distance, label the clusters, and fit boxes to them (KUL-Seg 5.2).

KUL-Seg (section 5.2) clusters the points above the ground and keeps a cluster for tracking if more than 70 % of its
points have one class, which removes labels smeared over walls and trees. `objects_from_points` does the same and fits a
box to every kept cluster. It gives boxes of every class of points, all around the vehicle.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.points import Bytes, Floats, Ids, Ints, Ints64, Labels, Mask, Points, check_each, read_only
from .linkage import COLUMN_EDGE, MAX_COLUMNS, TESTS_PER_POINT, WORK, Strips, chain_points, fill_clusters, levels_of

WALKS, RIDES = 1, 2  # roles of labels
# Networks label many of a cyclist's points as pedestrian: who has this share of them or more rides.
MIN_OF_WHOLE = 0.25
PART_OF = MappingProxyType({"pedestrian": "cyclist"})
MIN_PERSON_SHARE = 0.1  # persons stand near walls and cars: a larger share loses people
PERSONS = MappingProxyType({"pedestrian": WALKS, "cyclist": RIDES})


def find_clusters(
    points: Points,
    *,
    among: Mask | None = None,
    seeds: Mask | None = None,
    votes: Bytes | None = None,
    min_share: float | Sequence[float] | Floats = 0.0,
    min_distance_m: float = 0.5,
    distance_per_m: float = 0.015,
    max_range_m: float = 100.0,
    min_points: int = 5,
    strips: Strips | None = None,
) -> Ints:
    """Number the groups of linked points by their first points, -1 for none (docs/concepts/clusters.md). With
    ``votes``, all seeds of dropped clusters have -2, and some of their other points. Raises PointsError; warns where
    the tests of links were not enough.

    among : the points to cluster, such as those above the ground.
    seeds : points that a cluster must hold, such as those labeled as an object. Only the parts of the scan that are
        linked with seeds are searched.
    votes : what every point counts for. Bit 0: the point counts; without it there are no other bits. Bit k + 1: it may
        count for the share ``min_share[k]``. By default every point counts, and the seeds count for one share.
    min_share : clusters are dropped unless more than this share of their points are seeds; with ``votes``, unless one
        of the shares is larger than its limit. A cluster that cannot reach that is not searched further.
    min_distance_m, distance_per_m : two points are linked if their distance is at most ``max(min_distance_m,
        distance_per_m * range)``, with the range of the nearer one. ``distance_per_m`` is twice the angle [rad] between
        neighboring beams: 0.015 for an HDL-64E, 0.07 for a VLP-16.
    max_range_m : points with a larger x, y or z are in no cluster.
    strips : from `sort_points` with the same arguments; they cannot be used again.
    """
    if strips is None:
        strips = sort_points(
            points, among, min_distance_m=min_distance_m, distance_per_m=distance_per_m, max_range_m=max_range_m
        )
    check_each(len(points), seeds=seeds, votes=votes, strips=strips.chain)
    seeded = read_only(np.ones(len(points), np.bool_) if seeds is None else seeds, np.bool_)
    counted = read_only(seeded.view(np.uint8) * 2 + 1 if votes is None else votes, np.uint8)
    clusters, work = np.empty(len(points), np.int32), np.empty(1, WORK)
    fill_clusters(strips, seeded, counted, np.array(min_share, np.float64).reshape(-1), min_points, clusters, work)
    if n_incomplete := int(work["n_incomplete"][0]):
        warnings.warn(
            f"{n_incomplete} neighboring parts of the scan were not compared completely, because that needs more than "
            f"{TESTS_PER_POINT} tests a point; a cluster may be split there. Is this the scan of a LiDAR, in meters?",
            stacklevel=2,
        )
    if votes is None:
        np.maximum(clusters, -1, out=clusters)
    return clusters


def sort_points(
    points: Points,
    among: Mask | None = None,
    *,
    min_distance_m: float = 0.5,
    distance_per_m: float = 0.015,
    max_range_m: float = 100.0,
) -> Strips:
    """The part of `find_clusters` that needs no labels, for a scan whose labels are not known yet."""
    if points.ndim != 2 or points.shape[1] < 3:
        raise PointsError(f"got points of shape {points.shape}; expected (n, 4): x, y, z, remission")
    n = len(points)
    check_each(n, among=among)
    if not (
        0.0 < min_distance_m < math.inf
        and 0.0 <= distance_per_m <= 1.0
        and max_range_m > 0.0
        and (2.0 * max_range_m / (COLUMN_EDGE * min_distance_m) + 2.0) ** 2 <= MAX_COLUMNS
    ):
        raise PointsError(
            f"got min_distance_m={min_distance_m}, distance_per_m={distance_per_m} and max_range_m={max_range_m}; "
            "expected a distance above 0 and at least 1/2000 of the range, and distance_per_m in 0..1"
        )
    levels = levels_of(float(min_distance_m), float(distance_per_m), float(max_range_m))
    rows, chain = np.empty((2, n), np.int32)
    used = read_only(np.ones(n, np.bool_) if among is None else among, np.bool_)
    scan = read_only(points)
    m, heads = chain_points(scan, used, float(max_range_m), levels, rows, chain)
    return Strips(scan, rows[:m], heads, chain, levels, float(distance_per_m), float(max_range_m))


class Groups(NamedTuple):
    """Points by the groups that they belong to."""

    # (m,) rows of the points of group 0, in input order unless stated otherwise, then of group 1, and so on
    order: Ints
    starts: Ints64  # (k + 1,) where each of the k groups begins in ``order``; last, where they end


def labels_of_groups(groups: Groups, labels: Labels) -> tuple[Bytes, Floats]:
    """The most frequent class of objects of each group's points, 0 without any, and its share (KUL-Seg 5.2)."""
    classes = np.empty(len(groups.starts) - 1, np.uint8)
    shares = np.empty(len(groups.starts) - 1)
    fill_cluster_labels(labels, groups, classes, shares)
    return classes, shares


def group_points(clusters: Ids) -> Groups:
    """Points by cluster, (n,); -1 for none."""
    groups = Groups(np.empty(len(clusters), np.int32), np.empty(int(clusters.max(initial=-1)) + 2, np.int64))
    fill_groups(np.require(clusters, np.int32, ["C", "W"]), groups)  # writable, as where kernels call it
    return Groups(groups.order[: groups.starts[-1]], groups.starts)


@njit(cache=True, nogil=True)
def fill_groups(clusters: Ids, groups: Groups) -> None:
    """Sort points by their clusters, (n,); negative for none. ``groups`` is overwritten."""
    order, starts = groups.order, groups.starts
    starts[:] = 0
    for i in range(len(clusters)):
        if clusters[i] >= 0:
            starts[clusters[i] + 1] += 1
    for k in range(1, len(starts)):
        starts[k] += starts[k - 1]
    for i in range(len(clusters)):
        if clusters[i] >= 0:
            order[starts[clusters[i]]] = i
            starts[clusters[i]] += 1
    for k in range(len(starts) - 1, 0, -1):
        starts[k] = starts[k - 1]
    starts[0] = 0


@njit(cache=True, nogil=True)
def fill_cluster_labels(labels: Labels, groups: Groups, classes: Bytes, shares: Floats) -> None:
    """Write the class of every group, and its share; see `labels_of_groups`."""
    order, starts = groups.order, groups.starts
    counts = np.zeros(256, np.int64)
    for k in range(len(classes)):
        for place in range(starts[k], starts[k + 1]):
            counts[labels[order[place]]] += 1
        best = 0
        for c in range(1, 256):
            if counts[c] > 0 and (best == 0 or counts[c] > counts[best]):
                best = c
        shares[k] = (counts[best] if best > 0 else 0) / max(starts[k + 1] - starts[k], 1)
        classes[k] = best
        counts[:] = 0
