"""The kernels of `edgeperc.cluster.find_clusters`: which points are linked, within bounds on the work."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .kernel_cache import njit

__all__ = ["COLUMN_EDGE", "MAX_COLUMNS", "TESTS_PER_POINT", "fill_clusters"]

# A column's edge is slightly more than half the reach of its points. Points of one column are linked if their heights
# differ by at most 0.7 of the reach: 2 * 0.50005^2 + 0.7^2 < 1.
COLUMN_EDGE = 0.50005
RUN_GAP = 0.7
MAX_COLUMNS = 2**26
LEVEL_STEP = 1.5  # 2 took 8 % longer on KITTI scans
SAFE = 1.0 + 1e-6  # against rounding
MAX_SCANNED = 32  # runs of neighboring columns that are looked at in any order
MAX_TESTED = 32  # points of a part that is not halved
MAX_LAST_TESTED = 4  # the same, after the last of the tests
MAX_PAIRS = 2048  # bounds of float32 coordinates can be halved 831 times
TESTS_PER_POINT = 64  # 570 real scans of 10 sensors need at most 6
FREE, DROPPED = -1, -2  # runs in no cluster; runs of clusters with too few seeds


@njit(cache=True, nogil=True)
def fill_clusters(
    points: NDArray[np.float32],
    among: NDArray[np.bool_],
    seeds: NDArray[np.bool_],
    min_share: float,
    min_distance: float,
    distance_per_m: float,
    max_range: float,
    min_points: int,
    clusters: NDArray[np.int32],
    work: NDArray[np.int64],
) -> None:
    """Compute every point's cluster; see `find_clusters`.

    Parameters
    ----------
    points : (n, 3 or more) float32, C-contiguous
    among, seeds : (n,) bool
    min_share, min_distance, distance_per_m, max_range : float
    min_points : int
    clusters : (n,) int32, overwritten
    work : (3,) int64, overwritten
        Number of pairs of runs looked at; of tests of their points and bounds; of pairs of runs whose tests were not
        completed.
    """
    clusters[:] = -1
    work[:] = 0
    rows = np.empty(points.shape[0], dtype=np.int32)  # of the points that take part
    m = 0
    n_left = 0  # seeds in no cluster yet
    for i in range(points.shape[0]):
        if (
            among[i]
            and abs(points[i, 0]) <= max_range
            and abs(points[i, 1]) <= max_range
            and abs(points[i, 2]) <= max_range
        ):
            rows[m] = i
            m += 1
            n_left += 1 if seeds[i] else 0
    if n_left == 0:
        return

    # The reach of a point is the distance up to which it is linked. Points of a level have a reach from its edge up to
    # the next one, and columns in proportion: a point has few columns within its reach at any range.
    n_levels = 1
    while min_distance * LEVEL_STEP**n_levels <= 2.0 * distance_per_m * max_range:
        n_levels += 1
    edges = min_distance * LEVEL_STEP ** np.arange(n_levels + 1)
    limits = np.full(n_levels + 1, math.inf)  # squared ranges
    if distance_per_m > 0.0:
        limits = (edges / distance_per_m) ** 2
    low = np.full((n_levels, 3), math.inf)
    high = np.full((n_levels, 3), -math.inf)
    for i in rows[:m]:
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        at = level_of(limits, x, y, z)
        low[at, 0], high[at, 0] = min(low[at, 0], x), max(high[at, 0], x)
        low[at, 1], high[at, 1] = min(low[at, 1], y), max(high[at, 1], y)
        low[at, 2], high[at, 2] = min(low[at, 2], z), max(high[at, 2], z)
    columns_per_m = 1.0 / (COLUMN_EDGE * edges)
    layers_per_m = 1.0 / (0.5 * RUN_GAP * min_distance)
    low_z = low[:, 2].min()
    n_layers = int((high[:, 2].max() - low_z) * layers_per_m) + 1
    n_rows = np.zeros(n_levels, dtype=np.int64)
    n_cols = np.zeros(n_levels, dtype=np.int64)
    offsets = np.zeros(n_levels + 1, dtype=np.int64)  # the first column of every level
    for at in range(n_levels):
        if low[at, 0] <= high[at, 0]:
            n_rows[at] = int((high[at, 0] - low[at, 0]) * columns_per_m[at]) + 1
            n_cols[at] = int((high[at, 1] - low[at, 1]) * columns_per_m[at]) + 1
        offsets[at + 1] = offsets[at] + n_rows[at] * n_cols[at]
    n_columns = offsets[n_levels]

    # Points sorted by layer, then by column, so that those of a column are in upward order. Layers are half a gap
    # high: points of neighboring layers of a column are linked, in any order.
    layer = np.empty(m, dtype=np.int32)
    column = np.empty(m, dtype=np.int32)
    layer_starts = np.zeros(n_layers + 1, dtype=np.int32)
    starts = np.zeros(n_columns + 1, dtype=np.int32)
    for k in range(m):
        i = rows[k]
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        at = level_of(limits, x, y, z)
        row = int((x - low[at, 0]) * columns_per_m[at])
        column[k] = offsets[at] + row * n_cols[at] + int((y - low[at, 1]) * columns_per_m[at])
        layer[k] = int((z - low_z) * layers_per_m)
        layer_starts[layer[k] + 1] += 1
        starts[column[k] + 1] += 1
    for at in range(n_layers):
        layer_starts[at + 1] += layer_starts[at]
    for at in range(n_columns):
        starts[at + 1] += starts[at]
    upwards = np.empty(m, dtype=np.int32)
    for k in range(m):
        upwards[layer_starts[layer[k]]] = k
        layer_starts[layer[k]] += 1
    order = np.empty(m, dtype=np.int32)
    xyz = np.empty((m, 3), dtype=np.float32)
    for source in upwards:
        place, i = starts[column[source]], rows[source]
        starts[column[source]] += 1
        order[place] = i
        xyz[place, 0], xyz[place, 1], xyz[place, 2] = points[i, 0], points[i, 1], points[i, 2]

    # Runs: points of one column, each linked with the one before. From here on starts holds each column's first run.
    # Every run is the root of a tree of smaller parts, which are made when they are needed (are_linked).
    run_starts = np.empty(m + 1, dtype=np.int32)
    run_level = np.empty(m, dtype=np.int8)
    n_runs = 0
    start = 0
    for at in range(n_levels):
        for place in range(offsets[at], offsets[at + 1]):
            stop = starts[place]
            starts[place] = n_runs
            for k in range(start, stop):
                if k == start or abs(np.float64(xyz[k, 2]) - xyz[k - 1, 2]) > RUN_GAP * edges[at]:
                    run_starts[n_runs] = k
                    run_level[n_runs] = at
                    n_runs += 1
            start = stop
    run_starts[n_runs] = m
    starts[n_columns] = n_runs
    reach = np.empty(m)
    n_parts = n_runs + m // 2 + 64
    parts = np.empty((n_parts, 3), dtype=np.int32)  # first point, end, first child or 0
    bounds = np.empty((n_parts, 8))
    run_seeds = np.zeros(n_runs, dtype=np.int32)
    for run in range(n_runs):
        parts[run, 0], parts[run, 1], parts[run, 2] = run_starts[run], run_starts[run + 1], 0
        for k in range(parts[run, 0], parts[run, 1]):
            x, y, z = np.float64(xyz[k, 0]), np.float64(xyz[k, 1]), np.float64(xyz[k, 2])
            reach[k] = max(min_distance, distance_per_m * math.sqrt(x * x + y * y + z * z))
            clusters[order[k]] = run
            run_seeds[run] += 1 if seeds[order[k]] else 0
        set_bounds(xyz, reach, parts, bounds, run)

    # Clusters grow from seeds, run by run. A run of another cluster is not linked with this one, which was complete.
    owner = np.full(n_runs, FREE, dtype=np.int32)
    is_kept = np.zeros(n_runs, dtype=np.bool_)
    queue = np.empty(n_runs, dtype=np.int32)
    pairs = np.empty((MAX_PAIRS, 2), dtype=np.int32)
    state = np.array([n_runs, 2 * TESTS_PER_POINT * m, TESTS_PER_POINT * m])  # number of parts, tests left, reserve
    n_clusters = 0
    for seed in range(n_runs):
        if run_seeds[seed] == 0 or owner[seed] != FREE:
            continue
        queue[0], owner[seed] = seed, n_clusters
        n_queued, n_done = 1, 0
        size = parts[seed, 1] - parts[seed, 0]
        n_seeds = run_seeds[seed]
        n_left -= n_seeds
        is_dropped = False
        while n_done < n_queued and not is_dropped:
            if (n_seeds + n_left) / (size + n_left) <= min_share:  # too small, even if it gets all seeds that are left
                is_dropped = True
                break
            run = queue[n_done]
            n_done += 1
            # The reaches of linked points differ by at most distance_per_m times the shorter one.
            differ = SAFE * (1.0 + distance_per_m)
            lowest, highest = run_level[run], run_level[run]
            while lowest > 0 and bounds[run, 7] <= differ * edges[lowest]:
                lowest -= 1
            while highest < n_levels - 1 and differ * bounds[run, 6] >= edges[highest + 1]:
                highest += 1
            far = SAFE * bounds[run, 6]
            for at in range(lowest, highest + 1):
                if n_rows[at] == 0:
                    continue
                scale = columns_per_m[at]
                first_row = int(max((bounds[run, 0] - far - low[at, 0]) * scale, 0.0))
                last_row = int(min((bounds[run, 3] + far - low[at, 0]) * scale, n_rows[at] - 1.0))
                first_col = int(max((bounds[run, 1] - far - low[at, 1]) * scale, 0.0))
                last_col = int(min((bounds[run, 4] + far - low[at, 1]) * scale, n_cols[at] - 1.0))
                if first_col > last_col:
                    continue
                for row in range(first_row, last_row + 1):
                    place = offsets[at] + row * n_cols[at] + first_col
                    first, last = starts[place], starts[place + last_col - first_col + 1]
                    # Neighboring columns follow each other. If they hold many runs, they are searched by height.
                    n_searched = last_col - first_col + 1 if last - first > MAX_SCANNED else 1
                    for col in range(n_searched):
                        if n_searched > 1:
                            first, last = starts[place + col], starts[place + col + 1]
                            first = first_above(bounds, first, last, bounds[run, 2] - far)
                        for other in range(first, last):
                            if n_searched > 1 and bounds[other, 2] > bounds[run, 5] + far:
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
                                linked = are_linked(xyz, reach, order, parts, bounds, pairs, state, work, run, other)
                            if linked:
                                if owner[other] == DROPPED:
                                    is_dropped = True
                                    continue
                                owner[other] = n_clusters
                                queue[n_queued] = other
                                n_queued += 1
                                size += parts[other, 1] - parts[other, 0]
                                n_seeds += run_seeds[other]
                                n_left -= run_seeds[other]
        if is_dropped:
            for k in range(n_queued):
                owner[queue[k]] = DROPPED
        else:
            is_kept[n_clusters] = size >= min_points and n_seeds / size > min_share
            n_clusters += 1
    work[1] = 2 * TESTS_PER_POINT * m - state[1]

    number = np.full(n_clusters, -1, dtype=np.int32)
    n_kept = 0
    for i in rows[:m]:
        found = owner[clusters[i]]
        clusters[i] = -1
        if found >= 0 and is_kept[found]:
            if number[found] < 0:
                number[found] = n_kept
                n_kept += 1
            clusters[i] = number[found]


@njit(cache=True, nogil=True)
def level_of(limits: NDArray[np.float64], x: float, y: float, z: float) -> int:
    """The level whose squared ranges hold a point."""
    squared_range = x * x + y * y + z * z
    level = 0
    while squared_range >= limits[level + 1]:
        level += 1
    return level


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
        a, b = pairs[n_pairs, 0], pairs[n_pairs, 1]
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
        left, right = parts[a, 2], parts[a, 2] + 1
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
    if state[0] + 2 > len(parts):
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
    child = state[0]
    state[0] += 2
    parts[part, 2] = child
    parts[child, 0], parts[child, 1], parts[child, 2] = start, first, 0
    parts[child + 1, 0], parts[child + 1, 1], parts[child + 1, 2] = first, stop, 0
    set_bounds(xyz, reach, parts, bounds, child)
    set_bounds(xyz, reach, parts, bounds, child + 1)
    return True
