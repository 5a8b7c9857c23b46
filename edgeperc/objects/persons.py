"""The kernels of boxes around persons: which labeled points are one person, and how much room that person takes.

`boxes.objects_from_points` calls them. A cluster of points is often more than one person: two people who
walk side by side, or a person beside a wall. Groups of points are measured along their principal axis, seen from above.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.points import Cloud, Ids, Ints, Labeled, Labels, Mask, Records
from .cluster import MIN_OF_WHOLE, RIDES, Groups, fill_groups

UNSEEN = 3  # role of points out of view, beside `WALKS` and `RIDES`: they say nothing about the class

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


PERSON = np.dtype(
    [
        ("rides", np.bool_),
        ("x", np.float64),  # of the middle [m]
        ("y", np.float64),
        ("length", np.float64),  # along and across the principal axis [m]
        ("width", np.float64),
        ("yaw", np.float64),  # of the axis [rad]
        ("bottom", np.float64),  # mean z of the ground below, and highest z [m]
        ("top", np.float64),
        ("n_seen", np.int64),  # points in view
        ("share", np.float64),  # of labeled ones among the points in view; of larger clusters, among those around
        ("heads", np.float64),  # `head_width` of the group [m]
    ],
    align=True,
)


class Extent(NamedTuple):
    """A group of points along (u) and across (v) its principal axis from above [m]; ``top`` is above the ground."""

    cos: float
    sin: float
    low_u: float
    high_u: float
    low_v: float
    high_v: float
    top: float


@njit(cache=True, nogil=True)
def measure(cloud: Cloud, members: Ints, above: float) -> Extent:
    """Measure the members of a group that are higher than a limit [m], and the top of all; zeros if none is higher.

    members : (k,) int32; rows of the points.
    """
    points, height = cloud.points, cloud.height
    n, x, y, top = 0, 0.0, 0.0, -math.inf
    for i in members:
        top = max(top, np.float64(height[i]))
        if height[i] > above:
            n += 1
            x += np.float64(points[i, 0])
            y += np.float64(points[i, 1])
    if n == 0:
        return Extent(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, top)
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
    return Extent(cos, sin, low_u, high_u, low_v, high_v, top)


@njit(cache=True, nogil=True)
def fill_person_groups(
    cloud: Cloud, labeled: Labeled, clusters: Groups, groups: Groups, loose: Ints
) -> tuple[int, int]:
    """List the clusters that may be one or a few persons, and the persons' points of the others, which are larger or
    hold too few of them; returns both numbers. Roles are 0 for other labels, `UNSEEN` for points out of view.
    """
    labels, roles, order, starts = labeled.labels, labeled.roles, groups.order, groups.starts
    cluster_order, cluster_starts = clusters.order, clusters.starts
    n_groups, n_loose, n = 0, 0, 0
    starts[0] = 0
    for k in range(len(cluster_starts) - 1):
        members = cluster_order[cluster_starts[k] : cluster_starts[k + 1]]
        n_labeled, n_seen = 0, 0
        for i in members:
            n_labeled += 1 if 0 < roles[labels[i]] < UNSEEN else 0
            n_seen += 1 if roles[labels[i]] != UNSEEN else 0
        if n_labeled == 0:
            continue
        is_group = n_labeled >= MIN_GROUP_SHARE * n_seen
        if is_group:
            extent = measure(cloud, members, -math.inf)
            is_group = extent.high_u - extent.low_u <= MAX_LENGTH_M and extent.top <= MAX_TOP_M
        for i in members:
            if is_group:
                order[n] = i
                n += 1
            elif 0 < roles[labels[i]] < UNSEEN:
                loose[n_loose] = i
                n_loose += 1
        if is_group:
            n_groups += 1
            starts[n_groups] = n
    return n_groups, n_loose


@njit(cache=True, nogil=True)
def complete_persons(
    cloud: Cloud, in_view: Mask, clusters: Ids, may_be: Mask, walks: int, rides: int, labels: Labels
) -> None:
    """Give the points of a cluster that has a person's size and shape one label, ``walks`` or ``rides`` (rule
    ``person`` of docs/concepts/agreement.md).

    may_be : clusters whose bounds are not too large for a person, and that hold labeled points.
    """
    numbers, n = np.empty(len(may_be), np.int32), 0
    for k in range(len(may_be)):
        numbers[k] = n if may_be[k] else -1
        n += 1 if may_be[k] else 0
    if n == 0:
        return
    own = np.empty(len(clusters), np.int32)
    for i in range(len(clusters)):
        own[i] = numbers[clusters[i]] if clusters[i] >= 0 else -1
    order, starts = np.empty(len(clusters), np.int32), np.empty(n + 1, np.int64)
    fill_groups(own, Groups(order, starts))
    for k in range(n):
        members = order[starts[k] : starts[k + 1]]
        n_walking, n_riding, n_seen = 0, 0, 0
        for i in members:
            n_seen += 1 if in_view[i] else 0
            n_walking += 1 if labels[i] == walks else 0
            n_riding += 1 if labels[i] == rides else 0
        n_labeled = n_walking + n_riding
        if n_labeled < max(MIN_GROUP_SHARE * n_seen, MIN_LABELED):
            continue
        extent = measure(cloud, members, -math.inf)
        length, width, top = extent.high_u - extent.low_u, extent.high_v - extent.low_v, extent.top
        upper = measure(cloud, members, UPPER * top)
        is_riding = length > MAX_STRIDE_M or (n_riding > 0 and n_riding >= MIN_OF_WHOLE * n_labeled)
        max_width = MAX_RIDING_WIDTH_M if is_riding else MAX_WALKING_WIDTH_M
        if not (length <= MAX_LENGTH_M and width <= max_width and upper.high_u - upper.low_u <= MAX_UPPER_M):
            continue
        is_whole = n_labeled >= MIN_WHOLE_SHARE * n_seen and WHOLE_TOP_M[0] <= top <= WHOLE_TOP_M[1]
        if not is_whole and length <= MAX_STRIDE_M:
            continue
        for i in members:
            if in_view[i] and (labels[i] == walks or labels[i] == rides or (is_whole and labels[i] == 0)):
                labels[i] = rides if is_riding else walks


@njit(cache=True, nogil=True)
def border_of(cloud: Cloud, members: Ints, above: float, extent: Extent) -> float:
    """Where two persons meet along the axis of a group: at the fewest points, as near to the middle as possible."""
    points, height, cos, sin = cloud.points, cloud.height, extent.cos, extent.sin
    low, length = extent.low_u, extent.high_u - extent.low_u
    n_bins = int(min(length / BIN_M, MAX_BINS - 1.0)) + 1
    edge = max(BIN_M, length / n_bins)
    counts = np.zeros(n_bins + 2, np.int64)  # one more at each end
    for i in members:
        if height[i] > above:
            u = cos * np.float64(points[i, 0]) + sin * np.float64(points[i, 1])
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
def head_width(cloud: Cloud, members: Ints, extent: Extent) -> float:
    """Width of the widest part without a gap at the height of heads [m], along the axis of a group; 0 if not flat."""
    points, height, cos, sin = cloud.points, cloud.height, extent.cos, extent.sin
    low, length = extent.low_u, extent.high_u - extent.low_u
    n_bins = int(min(length / BIN_M, MAX_BINS - 1.0)) + 1
    edge = max(BIN_M, length / n_bins)
    firsts, lasts = np.full(n_bins, math.inf), np.full(n_bins, -math.inf)
    away, low_v, high_v = math.inf, math.inf, -math.inf
    for i in members:
        if height[i] > extent.top - HEAD_M:
            x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
            u, v = cos * x + sin * y, cos * y - sin * x
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
    cloud: Cloud,
    labeled: Labeled,
    groups: Groups,
    n_whole: int,
    cluster_of: Ids,
    clusters: Groups,
    min_points: int,
    persons: Records,
) -> int:
    """Divide groups into persons, and measure them; returns their number, without groups that are not finite.

    A group whose upper quarter is wider than 0.8 m is cut where the fewest points are, and its parts again.

    labeled : roles are 0 for labels that are not persons', `UNSEEN` for points out of view, `WALKS` or `RIDES`.
    groups : the points of a group are put in the order of its persons; from ``n_whole`` on, they are labeled points of
        larger clusters.
    """
    order, starts, others, other_starts = groups.order, groups.starts, clusters.order, clusters.starts
    left = np.empty((MAX_CUTS + 1, 3), np.int64)  # parts: first and last place in `order`, number of cuts before
    n = 0
    for k in range(len(starts) - 1):
        group = order[starts[k] : starts[k + 1]]
        extent = measure(cloud, group, -math.inf)
        if not math.isfinite(extent.low_u + extent.high_u + extent.low_v + extent.high_v + extent.top):
            continue
        heads = head_width(cloud, group, extent)
        left[0, 0], left[0, 1], left[0, 2] = starts[k], starts[k + 1], 0
        n_left = 1
        while n_left > 0 and n < persons.shape[0]:
            n_left -= 1
            first, end, n_cuts = left[n_left]
            members = order[first:end]
            if len(members) < min_points:
                continue
            extent = measure(cloud, members, -math.inf)
            n_first = cut(cloud, members, UPPER * extent.top) if n_cuts < MAX_CUTS else -1
            if n_first >= 0:
                left[n_left, 0], left[n_left, 1], left[n_left, 2] = first + n_first, end, n_cuts + 1
                left[n_left + 1, 0], left[n_left + 1, 1], left[n_left + 1, 2] = first, first + n_first, n_cuts + 1
                n_left += 2
                continue
            own = cluster_of[members[0]] if k >= n_whole else 0
            around = others[other_starts[own] : other_starts[own + 1] if k >= n_whole else other_starts[own]]
            fill_person(cloud, labeled, members, extent, around, persons[n])
            persons[n]["heads"] = heads
            n += 1
    return n


@njit(cache=True, nogil=True)
def cut(cloud: Cloud, members: Ints, above: float) -> int:
    """Put the points of the first of two persons first; their number, or -1 if a group is one person."""
    points, upper = cloud.points, measure(cloud, members, above)
    if not upper.high_u - upper.low_u > MAX_UPPER_M:
        return -1
    border = border_of(cloud, members, above, upper)
    n = 0
    for at in range(len(members)):
        i = members[at]
        if upper.cos * np.float64(points[i, 0]) + upper.sin * np.float64(points[i, 1]) <= border:
            members[at], members[n] = members[n], i
            n += 1
    return n


@njit(cache=True, nogil=True)
def fill_person(cloud: Cloud, labeled: Labeled, members: Ints, extent: Extent, around: Ints, person: np.void) -> None:
    """Write the record of a person.

    around : (m,) int32; of the larger cluster, of which the points within 0.2 m of the person count for the share.
    """
    points, height, labels, roles = cloud.points, cloud.height, labeled.labels, labeled.roles
    cos, sin, low_u, high_u, low_v, high_v, _ = extent
    n_labeled, n_riding, n_seen, ground, highest = 0, 0, 0, 0.0, -math.inf
    for i in members:
        role = roles[labels[i]]
        n_labeled += 1 if 0 < role < UNSEEN else 0
        n_seen += 1 if role != UNSEEN else 0
        n_riding += 1 if role == RIDES else 0
        ground += np.float64(points[i, 2]) - np.float64(height[i])
        highest = max(highest, np.float64(points[i, 2]))
    n_near = 0
    for i in around:
        u = cos * np.float64(points[i, 0]) + sin * np.float64(points[i, 1])
        v = cos * np.float64(points[i, 1]) - sin * np.float64(points[i, 0])
        is_near = low_u - NEAR_M <= u <= high_u + NEAR_M and low_v - NEAR_M <= v <= high_v + NEAR_M
        n_near += 1 if is_near and height[i] <= MAX_TOP_M and roles[labels[i]] != UNSEEN else 0
    u, v = 0.5 * (low_u + high_u), 0.5 * (low_v + high_v)
    person["rides"] = n_riding > 0 and n_riding >= MIN_OF_WHOLE * n_labeled
    person["x"], person["y"] = u * cos - v * sin, u * sin + v * cos
    person["length"], person["width"], person["yaw"] = high_u - low_u, high_v - low_v, math.atan2(sin, cos)
    person["bottom"], person["top"] = ground / len(members), highest
    person["n_seen"], person["share"] = n_seen, n_labeled / max(n_near, n_seen, 1)
