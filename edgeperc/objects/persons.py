"""The kernels of boxes around persons: which labeled points are one person, and how much room that person takes.

`boxes.objects_from_points` calls them. A cluster of points is often more than one person: two people who
walk side by side, or a person beside a wall. Groups of points are measured along their principal axis, seen from above.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..system.kernel_cache import njit

WALKS, RIDES = 1, 2  # roles of labels
UNSEEN = 3  # role of points out of view: they belong to a person, but say nothing about the class
MIN_OF_WHOLE = 0.25  # a person rides if at least this share of the persons' points says so: many say "pedestrian"

# A cluster with this share of persons' points is one group if it is not larger than a cyclist. Of larger clusters, only
# the labeled points are grouped. With 0.3 and 0.5, 1 and 3 % fewer of the cyclists on the validation drives are found.
MIN_GROUP_SHARE = 0.2
MAX_LENGTH_M, MAX_TOP_M = 2.3, 2.2

# The upper quarter of a person on the training drives is at most 0.6 m wide, that of two people side by side 0.9 m.
UPPER = 0.75
MAX_UPPER_M = 0.8
MIN_PART_M = 0.3  # a cut is at least this far from both ends
MAX_CUTS = 8  # one after another
BIN_M = 0.1
MAX_BINS = 1024

# Feet that are a step of 0.8 m apart take 1.1 m. A bicycle takes 1.7 m, of which 1.0 to 1.8 m are seen on the training
# drives.
MAX_STRIDE_M = 1.1

# A cluster of a person's size and shape is completed. With 0.2, 0.3, 0.4 and 0.6, pedestrians' points on the validation
# drives have an IoU of 58.6, 58.6, 57.8 and 57.1 %, and cyclists' 74.0, 74.2, 74.2 and 73.4 %.
MIN_WHOLE_SHARE, MIN_LABELED = 0.3, 5
WHOLE_TOP_M = (1.3, 2.0)
MAX_WALKING_WIDTH_M, MAX_RIDING_WIDTH_M = 0.7, 0.8  # across the axis; at most 0.67 and 0.76 m on the training drives

HEAD_M = 0.2  # heads are in the uppermost part of a group, shoulders are not
HEAD_GAP_M, HEAD_GAP_PER_M = 0.2, 0.006  # a wider gap is between two heads; 0.006: two beams of an HDL-64E
MAX_FLAT_M = 0.35  # heads of several rows of people have no gaps; a board is flat

NEAR_M = 0.2  # around a person's points


@njit(cache=True, nogil=True)
def measure(
    points: NDArray[np.float32],
    height: NDArray[np.float32],
    members: NDArray[np.int32],
    above: float,
    found: NDArray[np.float64],
) -> None:
    """Measure the points of a group that are higher than a limit, along their principal axis.

    points : (n, 3 or more) float32, C-contiguous
    height : (n,) float32
    members : (k,) int32; rows of the group.
    above : [m] above the ground.
    found : (7,) float64, overwritten; cosine and sine of the axis, lowest and highest coordinate along and across it
        [m], greatest height of all members [m]. Zeros before the height without a point above the limit.
    """
    n, x, y, top = 0, 0.0, 0.0, -math.inf
    for i in members:
        top = max(top, np.float64(height[i]))
        if height[i] > above:
            n += 1
            x += np.float64(points[i, 0])
            y += np.float64(points[i, 1])
    found[:] = 0.0
    found[6] = top
    if n == 0:
        return
    x, y = x / n, y / n
    xx, xy, yy = 0.0, 0.0, 0.0
    for i in members:
        if height[i] > above:
            dx, dy = np.float64(points[i, 0]) - x, np.float64(points[i, 1]) - y
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    cos, sin = math.cos(angle), math.sin(angle)
    low_u, high_u, low_v, high_v = math.inf, -math.inf, math.inf, -math.inf
    for i in members:
        if height[i] > above:
            u = cos * np.float64(points[i, 0]) + sin * np.float64(points[i, 1])
            v = cos * np.float64(points[i, 1]) - sin * np.float64(points[i, 0])
            low_u, high_u, low_v, high_v = min(low_u, u), max(high_u, u), min(low_v, v), max(high_v, v)
    found[0], found[1], found[2], found[3], found[4], found[5] = cos, sin, low_u, high_u, low_v, high_v


@njit(cache=True, nogil=True)
def fill_person_groups(
    points: NDArray[np.float32],
    height: NDArray[np.float32],
    labels: NDArray[np.uint8],
    roles: NDArray[np.uint8],
    order: NDArray[np.int32],
    starts: NDArray[np.int64],
    groups: NDArray[np.int32],
    group_starts: NDArray[np.int64],
    loose: NDArray[np.int32],
) -> tuple[int, int]:
    """List the clusters that may be one or a few persons, and the persons' points of the others.

    points : (n, 3 or more) float32, C-contiguous
    height : (n,) float32; [m] above the ground.
    labels : (n,) uint8
    roles : (256,) uint8; 0 for labels that are no persons', `UNSEEN` for points out of view.
    order, starts : (m,) int32, (k + 1,) int64; points by cluster, from `edgeperc.objects.cluster.fill_groups`.
    groups, group_starts : (m,) int32, (k + 1,) int64, overwritten; points by group.
    loose : (m,) int32, overwritten; persons' points of clusters that are larger than a person or hold too few
        persons' points.
    """
    found = np.empty(7)
    n_groups, n_loose, n = 0, 0, 0
    group_starts[0] = 0
    for k in range(len(starts) - 1):
        members = order[starts[k] : starts[k + 1]]
        n_labeled, n_seen = 0, 0
        for i in members:
            n_labeled += 1 if 0 < roles[labels[i]] < UNSEEN else 0
            n_seen += 1 if roles[labels[i]] != UNSEEN else 0
        if n_labeled == 0:
            continue
        is_group = n_labeled >= MIN_GROUP_SHARE * n_seen
        if is_group:
            measure(points, height, members, -math.inf, found)
            is_group = found[3] - found[2] <= MAX_LENGTH_M and found[6] <= MAX_TOP_M
        for i in members:
            if is_group:
                groups[n] = i
                n += 1
            elif 0 < roles[labels[i]] < UNSEEN:
                loose[n_loose] = i
                n_loose += 1
        if is_group:
            n_groups += 1
            group_starts[n_groups] = n
    return n_groups, n_loose


@njit(cache=True, nogil=True)
def complete_persons(
    points: NDArray[np.float32],
    height: NDArray[np.float32],
    in_view: NDArray[np.bool_],
    clusters: NDArray[np.int32],
    counts: NDArray[np.int32],
    bounds: NDArray[np.float32],
    walks: int,
    rides: int,
    labels: NDArray[np.uint8],
) -> None:
    """Give the points of a cluster that has a person's size and shape one label.

    points : (n, 3 or more) float32, C-contiguous
    height : (n,) float32; [m] above the ground.
    in_view : (n,) bool
    clusters : (n,) int32; negative for none.
    counts, bounds : (k, classes + 1) int32, (k, 5) float32; of each cluster, from
        `edgeperc.agreement.votes.fill_tallies`.
    walks, rides : the labels of persons on foot and of those who ride.
    labels : (n,) uint8, modified; a cluster up to 2.3 m long and 0.7 m wide (0.8 m if the person rides), whose upper
        quarter is at most 0.8 m wide, and of which a fifth in view is labeled as persons, is one person, who rides if
        longer than a stride, or if a quarter of the persons' points says so. The persons' points of one who is longer
        than a stride, or all points of one who is 1.3 to 2.0 m high and of whom at least 0.3 is labeled, get the
        label.
    """
    slots = np.full(bounds.shape[0], -1, np.int64)  # of clusters whose size may be a person's
    n_slots = 0
    for k in range(bounds.shape[0]):
        edge = max(bounds[k, 2] - bounds[k, 0], bounds[k, 3] - bounds[k, 1])
        is_small = edge <= 2.0 * MAX_LENGTH_M and bounds[k, 4] <= MAX_TOP_M
        if is_small and counts[k, walks] + counts[k, rides] > 0:
            slots[k] = n_slots
            n_slots += 1
    if n_slots == 0:
        return
    ends = np.zeros(n_slots + 1, np.int64)
    for i in range(len(clusters)):
        if clusters[i] >= 0 and slots[clusters[i]] >= 0:
            ends[slots[clusters[i]] + 1] += 1
    for slot in range(n_slots):
        ends[slot + 1] += ends[slot]
    starts = ends.copy()
    order = np.empty(ends[n_slots], np.int32)
    for i in range(len(clusters)):
        if clusters[i] >= 0 and slots[clusters[i]] >= 0:
            order[ends[slots[clusters[i]]]] = i
            ends[slots[clusters[i]]] += 1
    found = np.empty(7)
    for slot in range(n_slots):
        members = order[starts[slot] : starts[slot + 1]]
        n_walking, n_riding, n_seen = 0, 0, 0
        for i in members:
            n_seen += 1 if in_view[i] else 0
            n_walking += 1 if labels[i] == walks else 0
            n_riding += 1 if labels[i] == rides else 0
        n_labeled = n_walking + n_riding
        if n_labeled < max(MIN_GROUP_SHARE * n_seen, MIN_LABELED):
            continue
        measure(points, height, members, -math.inf, found)
        length, width, top = found[3] - found[2], found[5] - found[4], found[6]
        measure(points, height, members, UPPER * top, found)
        is_riding = length > MAX_STRIDE_M or (n_riding > 0 and n_riding >= MIN_OF_WHOLE * n_labeled)
        max_width = MAX_RIDING_WIDTH_M if is_riding else MAX_WALKING_WIDTH_M
        if not (length <= MAX_LENGTH_M and width <= max_width and found[3] - found[2] <= MAX_UPPER_M):
            continue
        is_whole = n_labeled >= MIN_WHOLE_SHARE * n_seen and WHOLE_TOP_M[0] <= top <= WHOLE_TOP_M[1]
        if not is_whole and length <= MAX_STRIDE_M:
            continue
        for i in members:
            if in_view[i] and (labels[i] == walks or labels[i] == rides or (is_whole and labels[i] == 0)):
                labels[i] = rides if is_riding else walks


@njit(cache=True, nogil=True)
def border_of(
    points: NDArray[np.float32],
    height: NDArray[np.float32],
    members: NDArray[np.int32],
    above: float,
    found: NDArray[np.float64],
) -> float:
    """Where two persons meet along the axis of `measure`: at the fewest points, as near to the middle as possible."""
    low, length = found[2], found[3] - found[2]
    n_bins = int(min(length / BIN_M, MAX_BINS - 1.0)) + 1
    edge = max(BIN_M, length / n_bins)
    counts = np.zeros(n_bins + 2, np.int64)  # one more at each end
    for i in members:
        if height[i] > above:
            u = found[0] * np.float64(points[i, 0]) + found[1] * np.float64(points[i, 1])
            counts[min(max(int((u - low) / edge), 0), n_bins - 1) + 1] += 1
    border, fewest, nearest = low + 0.5 * length, -1, math.inf
    for b in range(n_bins):
        place = (b + 0.5) * edge
        if place < MIN_PART_M or place > length - MIN_PART_M:
            continue
        n = counts[b] + 2 * counts[b + 1] + counts[b + 2]
        aside = abs(place - 0.5 * length)
        if fewest < 0 or n < fewest or (n == fewest and aside < nearest):
            border, fewest, nearest = low + place, n, aside
    return border


@njit(cache=True, nogil=True)
def head_width(
    points: NDArray[np.float32], height: NDArray[np.float32], members: NDArray[np.int32], found: NDArray[np.float64]
) -> float:
    """Width of the widest part without a gap at the height of heads [m], along the axis of `measure`; 0 if not flat."""
    low, length = found[2], found[3] - found[2]
    n_bins = int(min(length / BIN_M, MAX_BINS - 1.0)) + 1
    edge = max(BIN_M, length / n_bins)
    firsts, lasts = np.full(n_bins, math.inf), np.full(n_bins, -math.inf)
    away, low_v, high_v = math.inf, math.inf, -math.inf
    for i in members:
        if height[i] > found[6] - HEAD_M:
            x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
            u, v = found[0] * x + found[1] * y, found[0] * y - found[1] * x
            b = min(max(int((u - low) / edge), 0), n_bins - 1)
            firsts[b], lasts[b] = min(firsts[b], u), max(lasts[b], u)
            low_v, high_v = min(low_v, v), max(high_v, v)
            away = min(away, math.hypot(x, y))
    if high_v - low_v > MAX_FLAT_M:
        return 0.0
    gap = max(HEAD_GAP_M, HEAD_GAP_PER_M * away)
    widest, start, last = 0.0, math.inf, -math.inf
    for b in range(n_bins):
        if firsts[b] > lasts[b]:
            continue
        if firsts[b] - last > gap:
            start = firsts[b]
        last = lasts[b]
        widest = max(widest, last - start)
    return widest


@njit(cache=True, nogil=True)
def fill_persons(
    points: NDArray[np.float32],
    height: NDArray[np.float32],
    labels: NDArray[np.uint8],
    roles: NDArray[np.uint8],
    order: NDArray[np.int32],
    starts: NDArray[np.int64],
    n_whole: int,
    clusters: NDArray[np.int32],
    cluster_order: NDArray[np.int32],
    cluster_starts: NDArray[np.int64],
    min_points: int,
    persons: NDArray[np.float64],
) -> int:
    """Divide groups into persons, and measure them.

    A group whose upper quarter is wider than 0.8 m is cut where the fewest points are, and its parts again. A person
    rides if a quarter of the persons' points says so.

    points : (n, 3 or more) float32, C-contiguous
    height : (n,) float32; [m] above the ground.
    labels : (n,) uint8
    roles : (256,) uint8; 0 for labels that are no persons', `UNSEEN` for points out of view, `WALKS` or `RIDES` for
        others.
    order : (m,) int32, modified
    starts : (k + 1,) int64; points by group. Those of a group are put in the order of its persons.
    n_whole : groups from this number on are labeled points of larger clusters. The share of the labels is counted
        among the points of the cluster within 0.2 m of the person.
    clusters, cluster_order, cluster_starts : cluster of every point, and points by cluster.
    min_points : smaller parts are dropped.
    persons : (p, 11) float64, overwritten; for each person: 1 if he or she rides, else 0; x, y of the middle, extent
        along and across the principal axis [m], its angle [rad]; lowest and highest z [m], from the ground on; number
        of points in view; share of labeled ones among them; `head_width` of the group [m].
    Returns: Number of persons. Those beyond p are left out, and groups with points that are not finite.
    """
    found, upper = np.empty(7), np.empty(7)
    left = np.empty((MAX_CUTS + 1, 3), np.int64)  # parts: first and last place in `order`, number of cuts before
    n_found = 0
    for k in range(len(starts) - 1):
        group = order[starts[k] : starts[k + 1]]
        measure(points, height, group, -math.inf, found)
        if not math.isfinite(found[2] + found[3] + found[4] + found[5] + found[6]):
            continue
        heads = head_width(points, height, group, found)
        left[0, 0], left[0, 1], left[0, 2] = starts[k], starts[k + 1], 0
        n_left = 1
        while n_left > 0 and n_found < persons.shape[0]:
            n_left -= 1
            first, end, n_cuts = left[n_left]
            members = order[first:end]
            if len(members) < min_points:
                continue
            measure(points, height, members, -math.inf, found)
            limit = UPPER * found[6]
            measure(points, height, members, limit, upper)
            if upper[3] - upper[2] > MAX_UPPER_M and n_cuts < MAX_CUTS:
                border = border_of(points, height, members, limit, upper)
                middle = first
                for at in range(first, end):
                    i = order[at]
                    if upper[0] * np.float64(points[i, 0]) + upper[1] * np.float64(points[i, 1]) <= border:
                        order[at], order[middle] = order[middle], i
                        middle += 1
                left[n_left, 0], left[n_left, 1], left[n_left, 2] = middle, end, n_cuts + 1
                left[n_left + 1, 0], left[n_left + 1, 1], left[n_left + 1, 2] = first, middle, n_cuts + 1
                n_left += 2
                continue
            n_labeled, n_riding, n_seen, ground, highest = 0, 0, 0, 0.0, -math.inf
            for i in members:
                role = roles[labels[i]]
                n_labeled += 1 if 0 < role < UNSEEN else 0
                n_seen += 1 if role != UNSEEN else 0
                n_riding += 1 if role == RIDES else 0
                ground += np.float64(points[i, 2]) - np.float64(height[i])
                highest = max(highest, np.float64(points[i, 2]))
            n_near = n_seen
            if k >= n_whole:
                n_near = 0
                own = clusters[members[0]]
                for i in cluster_order[cluster_starts[own] : cluster_starts[own + 1]]:
                    u = found[0] * np.float64(points[i, 0]) + found[1] * np.float64(points[i, 1])
                    v = found[0] * np.float64(points[i, 1]) - found[1] * np.float64(points[i, 0])
                    along = found[2] - NEAR_M <= u <= found[3] + NEAR_M
                    across = found[4] - NEAR_M <= v <= found[5] + NEAR_M
                    is_near = along and across and height[i] <= MAX_TOP_M
                    n_near += 1 if is_near and roles[labels[i]] != UNSEEN else 0
            length, u, v = found[3] - found[2], 0.5 * (found[2] + found[3]), 0.5 * (found[4] + found[5])
            rides = n_riding > 0 and n_riding >= MIN_OF_WHOLE * n_labeled
            persons[n_found, 0] = 1.0 if rides else 0.0
            persons[n_found, 1] = u * found[0] - v * found[1]
            persons[n_found, 2] = u * found[1] + v * found[0]
            persons[n_found, 3], persons[n_found, 4] = length, found[5] - found[4]
            persons[n_found, 5] = math.atan2(found[1], found[0])
            persons[n_found, 6], persons[n_found, 7] = ground / len(members), highest
            persons[n_found, 8] = n_seen
            persons[n_found, 9] = n_labeled / max(n_near, n_seen, 1)
            persons[n_found, 10] = heads
            n_found += 1
    return n_found
