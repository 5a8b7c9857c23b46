"""The kernels of `edgeperc.objects.cluster.find_clusters`: which points are linked, within bounds on the work."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.points import Bytes, Floats, Ids, Ints, Ints64, Mask, Points, Records, Rows

# A column's edge is slightly more than half the reach of its points. Points of one column are linked if their heights
# differ by at most 0.7 of the reach: 2 * 0.50005^2 + 0.7^2 < 1.
COLUMN_EDGE = 0.50005
RUN_GAP = 0.7
MAX_COLUMNS = 2**26
LEVEL_STEP = 1.5  # 2 took 8 % longer on KITTI scans
SAFE = 1.0 + 1e-6  # against rounding
STRIP = 4  # columns
MAX_SCANNED = 32  # runs of neighboring columns that are looked at in any order
MAX_TESTED = 32  # points of a part that is not halved
MAX_LAST_TESTED = 4  # the same, after the last of the tests
MAX_PAIRS = 2048  # bounds of float32 coordinates can be halved 831 times
TESTS_PER_POINT = 64  # 570 real scans of 10 sensors need at most 6
FREE, DROPPED = -1, -2  # runs in no cluster; runs of clusters without a sufficient share

# Points of similar reach, the distance up to which a point is linked, and a grid of columns in proportion to it: a
# point has few columns within its reach at any range.
LEVEL = np.dtype(
    [
        ("reach", np.float64),  # of its points [m]: from this one up to that of the next level
        ("limit", np.float64),  # squared range with this reach [m2]
        ("x", np.float64),  # lowest of the columns [m]
        ("y", np.float64),
        ("columns_per_m", np.float64),
        ("n_rows", np.int64),  # columns along x
        ("n_columns", np.int64),  # columns along y
        ("first_strip", np.int64),
    ],
    align=True,
)

# A run or a part of one: points that follow one another in `Search.order`.
PART = np.dtype(
    [
        ("first", np.int32),
        ("stop", np.int32),
        ("child", np.int32),  # number of the first of its two halves; 0 without any
        ("level", np.int32),
        *((f"{end}_{axis}", np.float64) for end in ("low", "high") for axis in "xyz"),  # of its points [m]
        ("longest", np.float64),  # reach of its points [m]
        ("shortest", np.float64),
    ],
    align=True,
)

# What `fill_clusters` did, and may still do.
WORK = np.dtype(
    [
        ("n_strips", np.int64),  # that were opened, and what they hold
        ("n_points", np.int64),
        ("n_runs", np.int64),
        ("first_half", np.int64),  # lowest number of a part that is no run
        ("n_compared", np.int64),  # pairs of runs
        ("n_incomplete", np.int64),  # pairs of runs whose points were not tested completely
        ("n_tests", np.int64),  # of points and bounds
        ("tests_left", np.int64),
        ("reserve", np.int64),  # the last of the tests
    ]
)


class Strips(NamedTuple):
    """The points of a scan by strips: `STRIP` columns of one row of a grid; no labels are needed for it."""

    points: Points  # (n, 3 or more)
    rows: Rows  # (m,) of the points that take part, in input order
    # (strips,) a point of each strip, -1 without one. `fill_clusters` overwrites them: -2 - k for the k-th opened
    # strip.
    heads: Ints
    chain: Ints  # (n,) after each of the m points, the next one of its strip, or -1
    levels: Records  # (levels + 1,) `LEVEL`; the last one only ends the one before it
    distance_per_m: float
    max_range_m: float


class Search(NamedTuple):
    """The points of opened strips, by column and height, and the clusters that grow from them.

    A run holds points of one column, each linked with the one before. It is the root of a tree of smaller parts, which
    are made when they are needed (`halves_are_linked`). Runs are numbered from 0, smaller parts from the end down.

    order, xyz, reach : of each point, its row, coordinates [m] and reach [m].
    owner : cluster of each run, `FREE` or `DROPPED`.
    run_of : run of each point of the scan.
    firsts : (strips, STRIP + 1) first run of each column of the opened strips, and the end.
    queue : runs of the cluster that grows.
    votes, votes_left : of the cluster that grows, and of the points in no cluster yet.
    keys, near, pairs : scratch.
    """

    order: Ints
    xyz: Points
    reach: Floats
    keys: Floats
    parts: Records
    run_votes: Ints
    owner: Ints
    run_of: Ints
    firsts: Ints
    queue: Ints
    near: Ints
    pairs: Ints
    votes: Ints64
    votes_left: Ints64
    min_shares: Floats
    work: Records


def levels_of(min_distance: float, distance_per_m: float, max_range: float) -> Records:
    """The levels of `Strips` without their grids."""
    reaches = [min_distance]
    power = LEVEL_STEP  # exact: there are fewer than 33 levels
    while min_distance * power <= 2.0 * distance_per_m * max_range:
        reaches.append(min_distance * power)
        power *= LEVEL_STEP
    reaches.append(min_distance * power)
    ranges = [reach / distance_per_m if distance_per_m > 0.0 else math.inf for reach in reaches]
    levels = np.zeros(len(reaches), LEVEL)
    levels["reach"], levels["limit"] = reaches, [each * each for each in ranges]
    return levels


@njit(cache=True, nogil=True)
def chain_points(
    points: Points, among: Mask, max_range: float, levels: Records, rows: Rows, chain: Ints
) -> tuple[int, Ints]:
    """Write the grids of the levels, and the points of every strip within ``max_range`` along each axis; see `Strips`.
    Returns the number of points that take part, and the heads of the strips.
    """
    m = 0
    low_x, low_y, high_x, high_y = math.inf, math.inf, -math.inf, -math.inf
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        if among[i] and abs(x) <= max_range and abs(y) <= max_range and abs(points[i, 2]) <= max_range:
            rows[m] = i
            m += 1
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
    n_strips = 0
    for at in range(levels.shape[0] - 1 if m > 0 else 0):
        level, farthest = levels[at], math.sqrt(levels[at + 1]["limit"])
        level["x"], level["y"] = max(low_x, -farthest), max(low_y, -farthest)
        level["columns_per_m"] = 1.0 / (COLUMN_EDGE * level["reach"])
        level["n_rows"] = max(int((min(high_x, farthest) - level["x"]) * level["columns_per_m"]) + 1, 0)
        level["n_columns"] = max(int((min(high_y, farthest) - level["y"]) * level["columns_per_m"]) + 1, 0)
        level["first_strip"] = n_strips
        n_strips += level["n_rows"] * strips_a_row(level)
    heads = np.empty(n_strips, np.int32)
    heads[:] = -1
    for k in range(m):
        i = rows[k]
        strip = strip_of(points, i, levels)
        chain[i] = heads[strip]
        heads[strip] = i
    return m, heads


@njit(cache=True, nogil=True)
def strips_a_row(level: np.void) -> int:
    """Strips along one row of the grid."""
    return int((level["n_columns"] + STRIP - 1) // STRIP)


@njit(cache=True, nogil=True)
def strip_of(points: Points, i: int, levels: Records) -> int:
    """The strip of columns that holds a point."""
    level = levels[level_of(points, np.int64(i), levels)]
    row = int((np.float64(points[i, 0]) - level["x"]) * level["columns_per_m"])
    col = int((np.float64(points[i, 1]) - level["y"]) * level["columns_per_m"])
    return int(level["first_strip"] + row * strips_a_row(level) + col // STRIP)


@njit(cache=True, nogil=True)
def level_of(points: Points, i: int, levels: Records) -> int:
    """The level whose squared ranges hold a point."""
    x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    squared_range = x * x + y * y + z * z
    level = 0
    while squared_range >= levels[level + 1]["limit"]:
        level += 1
    return level


@njit(cache=True, nogil=True)
def fill_clusters(
    strips: Strips, seeds: Mask, votes: Bytes, min_shares: Floats, min_points: int, clusters: Ids, work: Records
) -> None:
    """Compute every point's cluster; see `find_clusters`.

    Clusters grow from seeds, run by run. Only strips within reach of a growing cluster are opened: sorted, and divided
    into runs. A run of another cluster is not linked with this one, which was complete. Points of clusters without a
    sufficient share have -2, as far as they were looked at.
    """
    clusters[:] = FREE
    points, rows, levels, heads = strips.points, strips.rows, strips.levels, strips.heads
    search = new_search(len(points), len(rows), min_shares, work)
    n_seeds, left = 0, search.votes_left
    for k in range(len(rows)):  # compiles faster than `for i in rows`
        n_seeds += 1 if seeds[rows[k]] else 0
        if votes[rows[k]] > 1:
            for share in range(len(left)):
                left[share] += (votes[rows[k]] >> share) & 1
    is_kept = np.empty(n_seeds, np.bool_)  # of every cluster that was not dropped
    n_clusters = 0
    for k in range(len(rows) if n_seeds > 0 else 0):
        seed = rows[k]
        if not seeds[seed]:
            continue
        strip = strip_of(points, seed, levels)
        if heads[strip] >= 0:
            open_strip(strips, votes, search, strip)
        if search.owner[search.run_of[seed]] != FREE:
            continue
        n_queued, is_dropped = grow(strips, votes, search, np.int64(search.run_of[seed]), np.int64(n_clusters))
        size = assign(search, n_queued, DROPPED if is_dropped else n_clusters, clusters)
        if not is_dropped:
            is_kept[n_clusters] = size >= min_points
            n_clusters += 1
    renumber(is_kept[:n_clusters], clusters)
    work[0]["n_tests"] = 2 * TESTS_PER_POINT * len(rows) - work[0]["tests_left"]


@njit(cache=True, nogil=True)
def new_search(n: int, m: int, min_shares: Floats, work: Records) -> Search:
    """A search in which no strip is open; for n points, of which m take part."""
    n_parts, n_votes = m + m // 2 + 64, len(min_shares) + 1
    done = work[0]
    done["n_strips"], done["n_points"], done["n_runs"], done["first_half"] = 0, 0, 0, n_parts
    done["n_compared"], done["n_incomplete"], done["n_tests"] = 0, 0, 0
    done["tests_left"], done["reserve"] = 2 * TESTS_PER_POINT * m, TESTS_PER_POINT * m
    votes_left = np.empty(n_votes, np.int64)
    votes_left[:] = 0
    return Search(
        np.empty(m, np.int32),
        np.empty((m, 3), np.float32),
        np.empty(m),
        np.empty(m),
        np.empty(n_parts, PART),
        np.empty((m, n_votes), np.int32),
        np.empty(m, np.int32),
        np.empty(n, np.int32),
        np.empty((m, STRIP + 1), np.int32),
        np.empty(m, np.int32),
        np.empty(m, np.int32),
        np.empty((MAX_PAIRS, 2), np.int32),
        np.empty(n_votes, np.int64),
        votes_left,
        min_shares,
        work,
    )


@njit(cache=True, nogil=True)
def grow(strips: Strips, votes: Bytes, search: Search, first: int, cluster: int) -> tuple[int, bool]:
    """Collect the runs of a cluster in the queue; their number, and whether the cluster has no sufficient share."""
    # Fields are taken out once, before the loops: each time counts references, which made this four times as slow.
    levels, heads, firsts, parts, owner = strips.levels, strips.heads, search.firsts, search.parts, search.owner
    xyz, reach, near, queue, work = search.xyz, search.reach, search.near, search.queue, search.work
    counts, left, run_votes, min_shares = search.votes, search.votes_left, search.run_votes, search.min_shares
    distance_per_m = strips.distance_per_m
    counts[:] = 0
    queue[0] = first
    owner[first] = cluster
    n_queued, n_done, is_dropped = 1, 0, False
    while n_done < n_queued and not is_dropped:
        run = np.int64(queue[n_done])
        n_done += 1
        for k in range(len(counts)):
            counts[k] += run_votes[run, k]
            left[k] -= run_votes[run, k]
        is_dropped = not may_reach(counts, left, min_shares)
        part = parts[run]
        lowest, highest = levels_within(levels, part, distance_per_m)
        for at in range(lowest, highest + 1):
            level = levels[at]
            first_row, last_row, first_col, last_col = columns_within(level, part)
            for row in range(first_row, last_row + 1):
                for number in range(first_col // STRIP, last_col // STRIP + 1):
                    strip = level["first_strip"] + row * strips_a_row(level) + number
                    if is_dropped or heads[strip] == -1:
                        continue
                    if heads[strip] >= 0:
                        open_strip(strips, votes, search, strip)
                    begin, end = max(first_col - number * STRIP, 0), min(last_col - number * STRIP, STRIP - 1) + 1
                    n_near = find_near(parts, owner, firsts[-2 - heads[strip]], begin, end, part, near, work)
                    for k in range(n_near):
                        other = np.int64(near[k])
                        if max(n_points(part), n_points(parts[other])) <= MAX_TESTED:
                            linked = test_points(xyz, reach, part, parts[other], work)
                        else:
                            linked = halves_are_linked(search, run, other)
                        if linked and owner[other] == DROPPED:
                            is_dropped = True
                        elif linked:
                            owner[other] = cluster
                            queue[n_queued] = other
                            n_queued += 1
    for place in range(n_done, n_queued):  # of a cluster that was dropped before it was complete
        for k in range(len(counts)):
            left[k] -= run_votes[queue[place], k]
    nothing = np.empty(len(counts), np.int64)
    nothing[:] = 0
    return n_queued, is_dropped or not may_reach(counts, nothing, min_shares)


@njit(cache=True, nogil=True)
def n_points(part: np.void) -> int:
    """Number of points of a part."""
    return part["stop"] - part["first"]


@njit(cache=True, nogil=True)
def levels_within(levels: Records, part: np.void, distance_per_m: float) -> tuple[int, int]:
    """The lowest and the highest level that may hold points linked with those of a part."""
    # The reaches of linked points differ by at most distance_per_m times the shorter one.
    differ = SAFE * (1.0 + distance_per_m)
    lowest, highest = np.int64(part["level"]), np.int64(part["level"])
    while lowest > 0 and part["shortest"] <= differ * levels[lowest]["reach"]:
        lowest -= 1
    while highest < len(levels) - 2 and differ * part["longest"] >= levels[highest + 1]["reach"]:
        highest += 1
    return lowest, highest


@njit(cache=True, nogil=True)
def columns_within(level: np.void, part: np.void) -> tuple[int, int, int, int]:
    """First and last row, first and last column of a level within reach of a part."""
    far, scale = SAFE * part["longest"], level["columns_per_m"]
    return (
        int(max((part["low_x"] - far - level["x"]) * scale, 0.0)),
        int(min((part["high_x"] + far - level["x"]) * scale, level["n_rows"] - 1.0)),
        int(max((part["low_y"] - far - level["y"]) * scale, 0.0)),
        int(min((part["high_y"] + far - level["y"]) * scale, level["n_columns"] - 1.0)),
    )


@njit(cache=True, nogil=True, forceinline=True)
def find_near(
    parts: Records, owner: Ints, firsts: Ints, col: int, end: int, part: np.void, near: Ints, work: Records
) -> int:
    """List the runs of no cluster in columns ``col`` to ``end`` of a strip that may be linked with a part."""
    n_near, far = 0, SAFE * part["longest"]
    # If the columns hold many runs, they are searched one by one, by height.
    one_by_one = end > col and firsts[end] - firsts[col] > MAX_SCANNED
    while col < end:
        following = col + 1 if one_by_one else end
        first, last = np.int64(firsts[col]), np.int64(firsts[following])
        col = following
        if one_by_one:
            first = first_above(parts, first, last, part["low_z"] - far)
        for other in range(first, last):
            if one_by_one and parts[other]["low_z"] > part["high_z"] + far:
                break
            work[0]["n_compared"] += 1
            if owner[other] < 0 and are_near(part, parts[other]):
                near[n_near] = other
                n_near += 1
    return n_near


@njit(cache=True, nogil=True)
def assign(search: Search, n_queued: int, cluster: int, clusters: Ids) -> int:
    """Write the cluster of the runs in the queue, and of their points; the number of points."""
    parts, order, owner, queue, size = search.parts, search.order, search.owner, search.queue, 0
    for k in range(n_queued):
        part = parts[queue[k]]
        owner[queue[k]] = cluster
        size += part["stop"] - part["first"]
        for place in range(part["first"], part["stop"]):
            clusters[order[place]] = cluster
    return size


@njit(cache=True, nogil=True)
def renumber(is_kept: Mask, clusters: Ids) -> None:
    """Number the clusters that are kept by their first points; points of others become `FREE`."""
    numbers = np.empty(len(is_kept), np.int32)
    numbers[:] = FREE
    n = 0
    for i in range(len(clusters)):
        cluster = clusters[i]
        if cluster < 0:
            continue
        if is_kept[cluster] and numbers[cluster] < 0:
            numbers[cluster] = n
            n += 1
        clusters[i] = numbers[cluster]


@njit(cache=True, nogil=True)
def may_reach(counts: Ints64, left: Ints64, min_shares: Floats) -> bool:
    """Whether a cluster may have more than one of the shares, if it gets all of the votes that are left."""
    for k in range(len(min_shares)):
        if (counts[k + 1] + left[k + 1]) / max(counts[0] + left[k + 1], 1) > min_shares[k]:
            return True
    return False


@njit(cache=True, nogil=True)
def open_strip(strips: Strips, votes: Bytes, search: Search, strip: int) -> None:
    """Sort the points of a strip by column and height, and divide them into runs."""
    points, parts, order, work = strips.points, search.parts, search.order, search.work[0]
    xyz, reach, owner, run_votes, run_of = search.xyz, search.reach, search.owner, search.run_votes, search.run_of
    firsts, opened = search.firsts, work["n_strips"]
    number = level_of(points, np.int64(strips.heads[strip]), strips.levels)
    level, shortest, distance_per_m = strips.levels[number], strips.levels[0]["reach"], strips.distance_per_m
    start, first = work["n_points"], work["n_runs"]
    stop = sort_strip(strips, search, strip, level)
    column, run = -1, first - 1
    for k in range(start, stop):
        i = order[k]
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        xyz[k, 0], xyz[k, 1], xyz[k, 2] = points[i, 0], points[i, 1], points[i, 2]
        reach[k] = max(shortest, distance_per_m * math.sqrt(x * x + y * y + z * z))
        own = column_of(y, level)
        if own != column or z - np.float64(xyz[k - 1, 2]) > RUN_GAP * level["reach"]:
            run += 1
            parts[run]["first"], parts[run]["child"], parts[run]["level"] = k, 0, number
            owner[run] = FREE
            for share in range(run_votes.shape[1]):
                run_votes[run, share] = 0
        for empty in range(column + 1, own + 1):
            firsts[opened, empty] = run
        column = own
        parts[run]["stop"] = k + 1
        run_of[i] = run
        for share in range(run_votes.shape[1]):
            run_votes[run, share] += (votes[i] >> share) & 1
    for empty in range(column + 1, STRIP + 1):
        firsts[opened, empty] = run + 1
    for k in range(first, run + 1):
        set_bounds(xyz, reach, parts[k])
    strips.heads[strip] = -2 - opened
    work["n_points"], work["n_runs"], work["n_strips"] = stop, run + 1, opened + 1


@njit(cache=True, nogil=True)
def column_of(y: float, level: np.void) -> int:
    """Column of a point within its strip."""
    return int((y - level["y"]) * level["columns_per_m"]) % STRIP


@njit(cache=True, nogil=True)
def sort_strip(strips: Strips, search: Search, strip: int, level: np.void) -> int:
    """Append the points of a strip to the order, by column and height; the end of the order."""
    points, chain, farthest = strips.points, strips.chain, strips.max_range_m
    keys, order, start = search.keys, search.order, search.work[0]["n_points"]
    stop, i = start, strips.heads[strip]
    while i >= 0:
        keys[stop] = column_of(np.float64(points[i, 1]), level) * 4.0 * farthest + np.float64(points[i, 2])
        order[stop] = i
        stop += 1
        i = chain[i]
    gap = 1
    while gap < (stop - start) // 3:
        gap = 3 * gap + 1
    while gap > 0:  # Shell's method: no strip makes it slow
        for k in range(start + gap, stop):
            key, i, place = keys[k], order[k], k
            while place >= start + gap and keys[place - gap] > key:
                keys[place], order[place] = keys[place - gap], order[place - gap]
                place -= gap
            keys[place], order[place] = key, i
        gap //= 3
    return int(stop)


@njit(cache=True, nogil=True)
def first_above(parts: Records, first: int, last: int, z: float) -> int:
    """The first of a column's runs whose top is not below z; ``last`` if there is none."""
    while first < last:
        middle = (first + last) // 2
        if parts[middle]["high_z"] < z:
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, nogil=True)
def set_bounds(xyz: Points, reach: Floats, part: np.void) -> None:
    """Write the bounds of a part's points, and of their reaches."""
    low_x, low_y, low_z, shortest = math.inf, math.inf, math.inf, math.inf
    high_x, high_y, high_z, longest = -math.inf, -math.inf, -math.inf, 0.0
    for k in range(part["first"], part["stop"]):
        x, y, z = np.float64(xyz[k, 0]), np.float64(xyz[k, 1]), np.float64(xyz[k, 2])
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
        low_z, high_z = min(low_z, z), max(high_z, z)
        shortest, longest = min(shortest, reach[k]), max(longest, reach[k])
    part["low_x"], part["low_y"], part["low_z"] = low_x, low_y, low_z
    part["high_x"], part["high_y"], part["high_z"] = high_x, high_y, high_z
    part["longest"], part["shortest"] = longest, shortest


@njit(cache=True, nogil=True)
def are_near(a: np.void, b: np.void) -> bool:
    """Whether the bounds of two parts allow a link."""
    longest = min(a["longest"], b["longest"])
    return bool(squared_gap(a, b) <= longest * longest)


@njit(cache=True, nogil=True)
def squared_gap(a: np.void, b: np.void) -> float:
    """Squared distance between the bounds of two parts; 0 if they overlap."""
    gap_x = max(a["low_x"] - b["high_x"], b["low_x"] - a["high_x"], 0.0)
    gap_y = max(a["low_y"] - b["high_y"], b["low_y"] - a["high_y"], 0.0)
    gap_z = max(a["low_z"] - b["high_z"], b["low_z"] - a["high_z"], 0.0)
    return float(gap_x * gap_x + gap_y * gap_y + gap_z * gap_z)


@njit(cache=True, nogil=True)
def halves_are_linked(search: Search, run: int, other: int) -> bool:
    """Whether a point of one run is near enough to a point of another; for runs with many points.

    Parts are halved until their bounds are too far apart, or all their pairs of points are tested.
    """
    parts, pairs, work = search.parts, search.pairs, search.work
    pairs[0, 0], pairs[0, 1] = run, other
    n_pairs = 1
    while n_pairs > 0:
        n_pairs -= 1
        a, b = np.int64(pairs[n_pairs, 0]), np.int64(pairs[n_pairs, 1])
        if parts[a]["stop"] - parts[a]["first"] < parts[b]["stop"] - parts[b]["first"]:
            a, b = b, a
        if not split(search, a):
            a, b = b, a
            if not split(search, a):
                if test_points(search.xyz, search.reach, parts[a], parts[b], work):
                    return True
                continue
        if work[0]["tests_left"] <= work[0]["reserve"]:
            n_pairs = 0  # only the reserve is left: only the nearest parts are halved further
        far, near = np.int64(parts[a]["child"]), np.int64(parts[a]["child"]) + 1
        if squared_gap(parts[far], parts[b]) < squared_gap(parts[near], parts[b]):
            far, near = near, far
        work[0]["tests_left"] -= 2
        if work[0]["tests_left"] > work[0]["reserve"] and are_near(parts[far], parts[b]):
            pairs[n_pairs, 0], pairs[n_pairs, 1] = far, b
            n_pairs += 1
        if are_near(parts[near], parts[b]):  # the nearer half comes next
            pairs[n_pairs, 0], pairs[n_pairs, 1] = near, b
            n_pairs += 1
    work[0]["n_incomplete"] += 1 if work[0]["tests_left"] <= work[0]["reserve"] else 0
    return False


@njit(cache=True, nogil=True)
def test_points(xyz: Points, reach: Floats, a: np.void, b: np.void, work: Records) -> bool:
    """Whether a point of one part is near enough to a point of another, by pairs of points."""
    most = MAX_TESTED if work[0]["tests_left"] > 0 else MAX_LAST_TESTED
    stop_a, stop_b = min(a["stop"], a["first"] + most), min(b["stop"], b["first"] + most)
    low_x, low_y, low_z = b["low_x"], b["low_y"], b["low_z"]
    high_x, high_y, high_z = b["high_x"], b["high_y"], b["high_z"]
    n_tests = 0
    for k in range(a["first"], stop_a):
        n_tests += 1
        x, y, z = np.float64(xyz[k, 0]), np.float64(xyz[k, 1]), np.float64(xyz[k, 2])
        dx, dy, dz = max(low_x - x, x - high_x, 0.0), max(low_y - y, y - high_y, 0.0), max(low_z - z, z - high_z, 0.0)
        if dx * dx + dy * dy + dz * dz > reach[k] * reach[k]:
            continue
        for j in range(b["first"], stop_b):
            n_tests += 1
            dx, dy, dz = xyz[j, 0] - x, xyz[j, 1] - y, xyz[j, 2] - z
            shorter = min(reach[k], reach[j])
            if dx * dx + dy * dy + dz * dz <= shorter * shorter:
                work[0]["tests_left"] -= n_tests
                return True
    work[0]["tests_left"] -= n_tests
    return False


@njit(cache=True, nogil=True)
def split(search: Search, number: int) -> bool:
    """Halve a part along the longest side of its bounds, unless that was done before; False if it stays whole."""
    parts, xyz, reach, order, work = search.parts, search.xyz, search.reach, search.order, search.work[0]
    part = parts[number]
    if part["child"] > 0:
        return True
    if work["first_half"] - 2 < len(order):
        work["tests_left"] = min(work["tests_left"], 0)  # no room for more parts
    if part["stop"] - part["first"] <= MAX_TESTED or work["tests_left"] <= 0:
        return False
    low, high, axis = part["low_x"], part["high_x"], 0
    if part["high_y"] - part["low_y"] > high - low:
        low, high, axis = part["low_y"], part["high_y"], 1
    if part["high_z"] - part["low_z"] > high - low:
        low, high, axis = part["low_z"], part["high_z"], 2
    if low == high:  # one point many times
        return False
    middle = low + 0.5 * (high - low)
    work["tests_left"] -= part["stop"] - part["first"]
    first, last = part["first"], part["stop"] - 1
    while first <= last:
        if xyz[first, axis] <= middle:
            first += 1
            continue
        for c in range(3):
            xyz[first, c], xyz[last, c] = xyz[last, c], xyz[first, c]
        reach[first], reach[last] = reach[last], reach[first]
        order[first], order[last] = order[last], order[first]
        last -= 1
    work["first_half"] -= 2
    part["child"] = work["first_half"]
    left, right = parts[part["child"]], parts[part["child"] + 1]
    left["first"], left["stop"], left["child"] = part["first"], first, 0
    right["first"], right["stop"], right["child"] = first, part["stop"], 0
    set_bounds(xyz, reach, left)
    set_bounds(xyz, reach, right)
    return True
