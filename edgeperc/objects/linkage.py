"""The kernels of `edgeperc.objects.cluster.find_clusters`: which points are linked, within bounds on the work."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..system.kernel_cache import njit

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


class Strips(NamedTuple):
    """The points of a scan by strips: `STRIP` columns of one row of a grid; no labels are needed for it.

    Attributes
    ----------
    rows : (m,) int32
        Of the points that take part, in input order.
    heads : (strips,) int32
        A point of each strip, -1 without one. `fill_clusters` overwrites them.
    chain : (n,) int32
        After each of the m points, the next one of its strip, or -1.
    edges : (levels + 1,) float64
        The reach of a point is the distance up to which it is linked. Points of a level have a reach from its edge up
        to the next one [m], and columns in proportion: a point has few columns within its reach at any range.
    limits : (levels + 1,) float64
        Squared ranges with these reaches [m2].
    grids : (levels, 3) float64
        Lowest x and y of the columns, columns per meter.
    shapes : (levels, 3) int64
        Rows and columns, and the first strip.
    """

    rows: NDArray[np.int32]
    heads: NDArray[np.int32]
    chain: NDArray[np.int32]
    edges: NDArray[np.float64]
    limits: NDArray[np.float64]
    grids: NDArray[np.float64]
    shapes: NDArray[np.int64]


def levels_of(
    min_distance: float, distance_per_m: float, max_range: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``edges`` and ``limits`` of `Strips`."""
    edges = [min_distance]
    power = LEVEL_STEP  # exact: there are fewer than 33 levels
    while min_distance * power <= 2.0 * distance_per_m * max_range:
        edges.append(min_distance * power)
        power *= LEVEL_STEP
    edges.append(min_distance * power)
    ranges = [edge / distance_per_m if distance_per_m > 0.0 else math.inf for edge in edges]
    return np.array(edges), np.array([each * each for each in ranges])


@njit(cache=True, nogil=True)
def chain_points(
    points: NDArray[np.float32],
    among: NDArray[np.bool_],
    edges: NDArray[np.float64],
    limits: NDArray[np.float64],
    max_range: float,
    rows: NDArray[np.int32],
    chain: NDArray[np.int32],
    grids: NDArray[np.float64],
    shapes: NDArray[np.int64],
) -> tuple[int, NDArray[np.int32]]:
    """Write the points of every strip; see `Strips`.

    points : (n, 3 or more) float32, C-contiguous
    among : (n,) bool
    edges, limits : (levels + 1,) float64
    max_range : points with a larger x, y or z do not take part [m].
    rows, chain : (n,) int32, overwritten
    grids : (levels, 3) float64, overwritten
    shapes : (levels, 3) int64, overwritten
    Returns m: Number of points that take part.
    Returns heads: (strips,) int32.
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
    for at in range(shapes.shape[0] if m > 0 else 0):
        farthest = math.sqrt(limits[at + 1])
        grids[at, 0], grids[at, 1] = max(low_x, -farthest), max(low_y, -farthest)
        grids[at, 2] = 1.0 / (COLUMN_EDGE * edges[at])
        shapes[at, 0] = max(int((min(high_x, farthest) - grids[at, 0]) * grids[at, 2]) + 1, 0)
        shapes[at, 1] = max(int((min(high_y, farthest) - grids[at, 1]) * grids[at, 2]) + 1, 0)
        shapes[at, 2] = n_strips
        n_strips += shapes[at, 0] * ((shapes[at, 1] + STRIP - 1) // STRIP)
    heads = np.empty(n_strips, np.int32)
    heads[:] = -1
    for k in range(m):
        i = rows[k]
        strip = strip_of(points, i, limits, grids, shapes)
        chain[i] = heads[strip]
        heads[strip] = i
    return m, heads


@njit(cache=True, nogil=True)
def fill_clusters(
    points: NDArray[np.float32],
    rows: NDArray[np.int32],
    heads: NDArray[np.int32],
    chain: NDArray[np.int32],
    edges: NDArray[np.float64],
    limits: NDArray[np.float64],
    grids: NDArray[np.float64],
    shapes: NDArray[np.int64],
    seeds: NDArray[np.bool_],
    votes: NDArray[np.uint8],
    min_shares: NDArray[np.float64],
    distance_per_m: float,
    max_range: float,
    min_points: int,
    clusters: NDArray[np.int32],
    work: NDArray[np.int64],
) -> None:
    """Compute every point's cluster; see `find_clusters`.

    Only strips within reach of a growing cluster are opened: sorted, and divided into runs.

    points : (n, 3 or more) float32, C-contiguous
    rows, heads, chain, edges, limits, grids, shapes : of `Strips`; ``heads`` is overwritten.
    seeds : (n,) bool
    votes : (n,) uint8; bit 0: the point counts. Bit k + 1: it may count for share k.
    min_shares : (k,) float64, at most 7
    clusters : (n,) int32, overwritten; -1 without a cluster; -2 for points of clusters without a sufficient share, as
        far as they were looked at.
    work : (3,) int64, overwritten; number of pairs of runs looked at; of tests of their points and bounds; of pairs
        of runs whose tests were not completed.
    """
    clusters[:] = FREE
    work[:] = 0
    n_shares, n_levels, m = len(min_shares), len(shapes), len(rows)
    n_left = np.empty(n_shares + 1, np.int64)  # votes of points in no cluster yet
    n_left[:] = 0
    n_seeds = 0
    for k in range(m):  # compiles faster than `for i in rows`
        i = rows[k]
        n_seeds += 1 if seeds[i] else 0
        if votes[i] > 1:
            add_votes(votes[i], n_left)
    if n_seeds == 0:
        return

    # Runs: points of one column, each linked with the one before. Every run is the root of a tree of smaller parts,
    # which are made when they are needed (are_linked). Runs are numbered from 0, smaller parts from the end down.
    keys = np.empty(m)
    order = np.empty(m, np.int32)
    xyz = np.empty((m, 3), np.float32)
    reach = np.empty(m)
    n_parts = m + m // 2 + 64
    parts = np.empty((n_parts, 3), np.int32)  # first point, end, first child or 0
    bounds = np.empty((n_parts, 8))
    run_level = np.empty(m, np.int32)
    run_votes = np.empty((m, n_shares + 1), np.int32)
    run_of = np.empty(points.shape[0], np.int32)
    firsts = np.empty((m, STRIP + 1), np.int32)  # of opened strips: the first run of every column, and the end
    owner = np.empty(m, np.int32)
    # First of the smaller parts, tests left, the reserve of tests, points in opened strips, runs, opened strips.
    state = np.empty(6, np.int64)
    state[0], state[1], state[2] = n_parts, 2 * TESTS_PER_POINT * m, TESTS_PER_POINT * m
    state[3], state[4], state[5] = 0, 0, 0

    # Clusters grow from seeds, run by run. A run of another cluster is not linked with this one, which was complete.
    is_kept = np.empty(n_seeds, np.int32)  # 0 or 1, of every cluster that was not dropped
    queue = np.empty(m, np.int32)
    pairs = np.empty((MAX_PAIRS, 2), np.int32)
    n_votes, n_none = np.empty(n_shares + 1, np.int64), np.empty(n_shares + 1, np.int64)
    n_none[:] = 0
    n_clusters = 0
    for nth in range(m):
        seed = rows[nth]
        if not seeds[seed]:
            continue
        strip = strip_of(points, seed, limits, grids, shapes)
        if heads[strip] >= 0:
            open_strip(
                points, votes, heads, chain, strip, limits, grids, edges, max_range, distance_per_m, keys, order, xyz,
                reach, parts, bounds, run_level, run_votes, run_of, firsts, owner, state,
            )  # fmt: skip
        if owner[run_of[seed]] != FREE:
            continue
        n_votes[:] = 0
        queue[0], n_queued, n_done, size = run_of[seed], 1, 0, 0
        owner[queue[0]] = n_clusters
        is_dropped = False
        while n_done < n_queued and not is_dropped:
            run = np.int64(queue[n_done])
            n_done += 1
            size += parts[run, 1] - parts[run, 0]
            for k in range(n_shares + 1):
                n_votes[k] += run_votes[run, k]
                n_left[k] -= run_votes[run, k]
            is_dropped = not may_reach(n_votes, n_left, min_shares)
            # The reaches of linked points differ by at most distance_per_m times the shorter one.
            differ = SAFE * (1.0 + distance_per_m)
            lowest, highest = run_level[run], run_level[run]
            while lowest > 0 and bounds[run, 7] <= differ * edges[lowest]:
                lowest -= 1
            while highest < n_levels - 1 and differ * bounds[run, 6] >= edges[highest + 1]:
                highest += 1
            far = SAFE * bounds[run, 6]
            for at in range(lowest, highest + 1):
                scale = grids[at, 2]
                first_row = int(max((bounds[run, 0] - far - grids[at, 0]) * scale, 0.0))
                last_row = int(min((bounds[run, 3] + far - grids[at, 0]) * scale, shapes[at, 0] - 1.0))
                first_col = int(max((bounds[run, 1] - far - grids[at, 1]) * scale, 0.0))
                last_col = int(min((bounds[run, 4] + far - grids[at, 1]) * scale, shapes[at, 1] - 1.0))
                n_strips = (shapes[at, 1] + STRIP - 1) // STRIP
                for row in range(first_row, last_row + 1):
                    for number in range(first_col // STRIP, last_col // STRIP + 1):
                        strip = shapes[at, 2] + row * n_strips + number
                        if heads[strip] == -1:
                            continue
                        if heads[strip] >= 0:
                            open_strip(
                                points, votes, heads, chain, strip, limits, grids, edges, max_range, distance_per_m,
                                keys, order, xyz, reach, parts, bounds, run_level, run_votes, run_of, firsts, owner,
                                state,
                            )  # fmt: skip
                        opened = -2 - heads[strip]
                        col = max(first_col - number * STRIP, 0)
                        last_here = min(last_col - number * STRIP, STRIP - 1)
                        # If the columns hold many runs, they are searched one by one, by height.
                        one_by_one = firsts[opened, last_here + 1] - firsts[opened, col] > MAX_SCANNED
                        while col <= last_here and not is_dropped:
                            end = col if one_by_one else last_here
                            first, last = firsts[opened, col], firsts[opened, end + 1]
                            col = end + 1
                            if one_by_one:
                                first = first_above(bounds, first, last, bounds[run, 2] - far)
                            for other in range(first, last):
                                if one_by_one and bounds[other, 2] > bounds[run, 5] + far:
                                    break
                                work[0] += 1
                                if owner[other] >= 0:
                                    continue
                                longest = min(bounds[run, 6], bounds[other, 6])
                                if squared_gap(bounds, run, other) > longest * longest:
                                    continue
                                n_points = max(parts[run, 1] - parts[run, 0], parts[other, 1] - parts[other, 0])
                                if n_points <= MAX_TESTED:
                                    n_tests = test_points(xyz, reach, parts, bounds, state, run, other)
                                    state[1] -= abs(n_tests)
                                    linked = n_tests > 0
                                else:
                                    linked = are_linked(
                                        xyz, reach, order, parts, bounds, pairs, state, work, run, other
                                    )
                                if linked and owner[other] == DROPPED:
                                    is_dropped = True
                                elif linked:
                                    owner[other] = n_clusters
                                    queue[n_queued] = other
                                    n_queued += 1
        for k in range(n_done, n_queued):  # of a cluster that was dropped before it was complete
            for share in range(n_shares + 1):
                n_left[share] -= run_votes[queue[k], share]
        is_dropped = is_dropped or not may_reach(n_votes, n_none, min_shares)
        for k in range(n_queued):
            owner[queue[k]] = DROPPED if is_dropped else n_clusters
            for place in range(parts[queue[k], 0], parts[queue[k], 1]):
                clusters[order[place]] = owner[queue[k]]
        if not is_dropped:
            is_kept[n_clusters] = 1 if size >= min_points else 0
            n_clusters += 1
    work[1] = 2 * TESTS_PER_POINT * m - state[1]

    renumbered = np.empty(n_clusters, np.int32)
    renumbered[:] = FREE
    n_kept = 0
    for i in range(points.shape[0]):
        found = clusters[i]
        if found < 0:
            continue
        if is_kept[found] != 0 and renumbered[found] < 0:
            renumbered[found] = n_kept
            n_kept += 1
        clusters[i] = renumbered[found]


@njit(cache=True, nogil=True)
def add_votes(vote: np.uint8, counts: NDArray[np.int64]) -> None:
    """Add a point's votes to ``counts``: one for every bit."""
    for k in range(len(counts)):
        counts[k] += (vote >> k) & 1


@njit(cache=True, nogil=True)
def may_reach(counts: NDArray[np.int64], left: NDArray[np.int64], min_shares: NDArray[np.float64]) -> bool:
    """Whether a cluster may have more than one of the shares, if it gets all of the votes that are left."""
    for k in range(len(min_shares)):
        if (counts[k + 1] + left[k + 1]) / max(counts[0] + left[k + 1], 1) > min_shares[k]:
            return True
    return False


@njit(cache=True, nogil=True)
def strip_of(
    points: NDArray[np.float32],
    i: int,
    limits: NDArray[np.float64],
    grids: NDArray[np.float64],
    shapes: NDArray[np.int64],
) -> int:
    """The strip of columns that holds a point."""
    x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    at = level_of(limits, x, y, z)
    row, col = int((x - grids[at, 0]) * grids[at, 2]), int((y - grids[at, 1]) * grids[at, 2])
    return int(shapes[at, 2] + row * ((shapes[at, 1] + STRIP - 1) // STRIP) + col // STRIP)


@njit(cache=True, nogil=True)
def level_of(limits: NDArray[np.float64], x: float, y: float, z: float) -> int:
    """The level whose squared ranges hold a point."""
    squared_range = x * x + y * y + z * z
    level = 0
    while squared_range >= limits[level + 1]:
        level += 1
    return level


@njit(cache=True, nogil=True)
def open_strip(
    points: NDArray[np.float32],
    votes: NDArray[np.uint8],
    heads: NDArray[np.int32],
    chain: NDArray[np.int32],
    strip: int,
    limits: NDArray[np.float64],
    grids: NDArray[np.float64],
    edges: NDArray[np.float64],
    max_range: float,
    distance_per_m: float,
    keys: NDArray[np.float64],
    order: NDArray[np.int32],
    xyz: NDArray[np.float32],
    reach: NDArray[np.float64],
    parts: NDArray[np.int32],
    bounds: NDArray[np.float64],
    run_level: NDArray[np.int32],
    run_votes: NDArray[np.int32],
    run_of: NDArray[np.int32],
    firsts: NDArray[np.int32],
    owner: NDArray[np.int32],
    state: NDArray[np.int64],
) -> None:
    """Sort the points of a strip by column and height, and divide them into runs; its head becomes -2 - its number."""
    start = stop = state[3]
    i = heads[strip]
    level = level_of(limits, np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2]))
    while i >= 0:
        column = int((np.float64(points[i, 1]) - grids[level, 1]) * grids[level, 2]) % STRIP
        keys[stop] = column * 4.0 * max_range + np.float64(points[i, 2])
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
    opened, first = state[5], state[4]
    column, run = -1, first - 1
    for k in range(start, stop):
        i = order[k]
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        xyz[k, 0], xyz[k, 1], xyz[k, 2] = points[i, 0], points[i, 1], points[i, 2]
        reach[k] = max(edges[0], distance_per_m * math.sqrt(x * x + y * y + z * z))
        is_new = int((y - grids[level, 1]) * grids[level, 2]) % STRIP != column
        if is_new or z - np.float64(xyz[k - 1, 2]) > RUN_GAP * edges[level]:
            run += 1
            parts[run, 0], parts[run, 2] = k, 0
            run_level[run] = level
            owner[run] = FREE
            for share in range(run_votes.shape[1]):
                run_votes[run, share] = 0
        if is_new:
            before = column
            column = int((y - grids[level, 1]) * grids[level, 2]) % STRIP
            for empty in range(before + 1, column + 1):
                firsts[opened, empty] = run
        parts[run, 1] = k + 1
        run_of[i] = run
        for share in range(run_votes.shape[1]):
            run_votes[run, share] += (votes[i] >> share) & 1
    for empty in range(column + 1, STRIP + 1):
        firsts[opened, empty] = run + 1
    for k in range(first, run + 1):
        set_bounds(xyz, reach, parts, bounds, k)
    heads[strip] = -2 - opened
    state[3], state[4], state[5] = stop, run + 1, opened + 1


@njit(cache=True, nogil=True)
def first_above(bounds: NDArray[np.float64], first: int, last: int, z: float) -> int:
    """The first of a column's runs whose top is not below z; ``last`` if there is none."""
    while first < last:
        middle = (first + last) // 2
        if bounds[middle, 5] < z:
            first = middle + 1
        else:
            last = middle
    return first


@njit(cache=True, nogil=True)
def set_bounds(
    xyz: NDArray[np.float32],
    reach: NDArray[np.float64],
    parts: NDArray[np.int32],
    bounds: NDArray[np.float64],
    part: int,
) -> None:
    """Write lowest x, y, z, highest x, y, z, longest and shortest reach of a part's points."""
    low_x, low_y, low_z, shortest = math.inf, math.inf, math.inf, math.inf
    high_x, high_y, high_z, longest = -math.inf, -math.inf, -math.inf, 0.0
    for k in range(parts[part, 0], parts[part, 1]):
        x, y, z = np.float64(xyz[k, 0]), np.float64(xyz[k, 1]), np.float64(xyz[k, 2])
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
        low_z, high_z = min(low_z, z), max(high_z, z)
        shortest, longest = min(shortest, reach[k]), max(longest, reach[k])
    bounds[part, 0], bounds[part, 1], bounds[part, 2] = low_x, low_y, low_z
    bounds[part, 3], bounds[part, 4], bounds[part, 5] = high_x, high_y, high_z
    bounds[part, 6], bounds[part, 7] = longest, shortest


@njit(cache=True, nogil=True)
def squared_gap(bounds: NDArray[np.float64], a: int, b: int) -> float:
    """Squared distance between two axis-aligned bounds (lowest x, y, z, highest x, y, z); 0 if they overlap."""
    gap_x = max(bounds[a, 0] - bounds[b, 3], bounds[b, 0] - bounds[a, 3], 0.0)
    gap_y = max(bounds[a, 1] - bounds[b, 4], bounds[b, 1] - bounds[a, 4], 0.0)
    gap_z = max(bounds[a, 2] - bounds[b, 5], bounds[b, 2] - bounds[a, 5], 0.0)
    return gap_x * gap_x + gap_y * gap_y + gap_z * gap_z


@njit(cache=True, nogil=True)
def are_linked(
    xyz: NDArray[np.float32],
    reach: NDArray[np.float64],
    order: NDArray[np.int32],
    parts: NDArray[np.int32],
    bounds: NDArray[np.float64],
    pairs: NDArray[np.int32],
    state: NDArray[np.int64],
    work: NDArray[np.int64],
    run: int,
    other: int,
) -> bool:
    """Whether a point of one run is near enough to a point of another; their bounds are.

    Parts with many points are halved until their bounds are too far apart, or all their pairs of points are tested.
    """
    pairs[0, 0], pairs[0, 1] = run, other
    n_pairs = 1
    while n_pairs > 0:
        n_pairs -= 1
        a, b = np.int64(pairs[n_pairs, 0]), np.int64(pairs[n_pairs, 1])
        if parts[a, 1] - parts[a, 0] < parts[b, 1] - parts[b, 0]:
            a, b = b, a
        if not split(xyz, reach, order, parts, bounds, state, a):
            a, b = b, a
            if not split(xyz, reach, order, parts, bounds, state, a):
                n_tests = test_points(xyz, reach, parts, bounds, state, a, b)
                state[1] -= abs(n_tests)
                if n_tests > 0:
                    return True
                continue
        if state[1] <= state[2]:
            n_pairs = 0  # only the reserve is left: only the nearest parts are halved further
        left, right = np.int64(parts[a, 2]), np.int64(parts[a, 2]) + 1
        gap_left, gap_right = squared_gap(bounds, left, b), squared_gap(bounds, right, b)
        if gap_left < gap_right:
            left, right = right, left
            gap_left, gap_right = gap_right, gap_left
        state[1] -= 2
        longest = min(bounds[left, 6], bounds[b, 6])
        if state[1] > state[2] and gap_left <= longest * longest:
            pairs[n_pairs, 0], pairs[n_pairs, 1] = left, b
            n_pairs += 1
        longest = min(bounds[right, 6], bounds[b, 6])
        if gap_right <= longest * longest:  # the nearer half comes next
            pairs[n_pairs, 0], pairs[n_pairs, 1] = right, b
            n_pairs += 1
    work[2] += 1 if state[1] <= state[2] else 0
    return False


@njit(cache=True, nogil=True)
def test_points(
    xyz: NDArray[np.float32],
    reach: NDArray[np.float64],
    parts: NDArray[np.int32],
    bounds: NDArray[np.float64],
    state: NDArray[np.int64],
    a: int,
    b: int,
) -> int:
    """Number of tests until a point of one part was near enough to a point of another; negative if none was."""
    most = MAX_TESTED if state[1] > 0 else MAX_LAST_TESTED
    stop_a, stop_b = min(parts[a, 1], parts[a, 0] + most), min(parts[b, 1], parts[b, 0] + most)
    low_x, low_y, low_z = bounds[b, 0], bounds[b, 1], bounds[b, 2]
    high_x, high_y, high_z = bounds[b, 3], bounds[b, 4], bounds[b, 5]
    n_tests = 0
    for k in range(parts[a, 0], stop_a):
        n_tests += 1
        x, y, z = np.float64(xyz[k, 0]), np.float64(xyz[k, 1]), np.float64(xyz[k, 2])
        dx, dy, dz = max(low_x - x, x - high_x, 0.0), max(low_y - y, y - high_y, 0.0), max(low_z - z, z - high_z, 0.0)
        if dx * dx + dy * dy + dz * dz > reach[k] * reach[k]:
            continue
        for j in range(parts[b, 0], stop_b):
            n_tests += 1
            dx, dy, dz = xyz[j, 0] - x, xyz[j, 1] - y, xyz[j, 2] - z
            shorter = min(reach[k], reach[j])
            if dx * dx + dy * dy + dz * dz <= shorter * shorter:
                return n_tests
    return -n_tests


@njit(cache=True, nogil=True)
def split(
    xyz: NDArray[np.float32],
    reach: NDArray[np.float64],
    order: NDArray[np.int32],
    parts: NDArray[np.int32],
    bounds: NDArray[np.float64],
    state: NDArray[np.int64],
    part: int,
) -> bool:
    """Halve a part along the longest side of its bounds, unless that was done before; False if it stays whole."""
    if parts[part, 2] > 0:
        return True
    if state[0] - 2 < len(order):
        state[1] = min(state[1], 0)  # no room for more parts
    if parts[part, 1] - parts[part, 0] <= MAX_TESTED or state[1] <= 0:
        return False
    axis = 0
    for other in range(1, 3):
        if bounds[part, 3 + other] - bounds[part, other] > bounds[part, 3 + axis] - bounds[part, axis]:
            axis = other
    low, high = bounds[part, axis], bounds[part, 3 + axis]
    if low == high:  # one point many times
        return False
    middle = low + 0.5 * (high - low)
    start, stop = parts[part, 0], parts[part, 1]
    state[1] -= stop - start
    first, last = start, stop - 1
    while first <= last:
        if xyz[first, axis] <= middle:
            first += 1
            continue
        for c in range(3):
            xyz[first, c], xyz[last, c] = xyz[last, c], xyz[first, c]
        reach[first], reach[last] = reach[last], reach[first]
        order[first], order[last] = order[last], order[first]
        last -= 1
    state[0] -= 2
    child = state[0]
    parts[part, 2] = child
    parts[child, 0], parts[child, 1], parts[child, 2] = start, first, 0
    parts[child + 1, 0], parts[child + 1, 1], parts[child + 1, 2] = first, stop, 0
    set_bounds(xyz, reach, parts, bounds, child)
    set_bounds(xyz, reach, parts, bounds, child + 1)
    return True
