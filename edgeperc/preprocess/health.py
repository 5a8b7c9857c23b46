"""What the window of a sensor and the weather do to its scans: blocked sectors, drops in the air, a range that shrank.

Three signs are measured in each scan. Beams that point down must meet the ground: a sector without their returns is
blocked, and a scan without those of the lowest ones is a part of one. Rain, snow, dust and spray show as near points
without a neighbor (the dynamic radius of Charron, Phillips and Waslander, "De-noising of Lidar Point Clouds Corrupted
by Snowfall", 2018). Fog takes far returns away, while walls near by, which shorten the range too, add returns. The
first scans of a perceiver show what is normal; what is judged of a later one depends on these and on itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import median_high

import numpy as np
from numpy.typing import ArrayLike

from ..system.kernels import njit
from ..types.mounting import MIN_MOUNT_HEIGHT_M, MODEL_HEIGHT_M
from ..types.perception import SensorHealth
from ..types.points import Floats, Floats32, Ints, Ints64, Mask, Points, read_only
from ..types.sensor import SensorProfile

N_SECTORS = 72
NORMAL_SCANS = 5
NEAR_M = 10.0
# Ground within these ranges returns each beam, also if it is wet; nothing is nearer than the window but what is on it.
GROUND_M, WINDOW_M = (6.0, 15.0), 0.3
_SAMPLE = 8192  # points
_STEPS = (1, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)  # that meet every beam in turn
_FEWEST_OF_SECTOR, _BLOCKED = 6.0, 0.1  # sampled returns, and the share of them that a blocked sector has at most
_WIDEST = 24  # sectors; a scan may be cropped to what a camera sees, or the sensor look ahead
_NARROWEST, _NARROWEST_AT_FIRST, _WIDE = 2, 5, 6
_WEDGE = 0.05  # around the four directions in which isolated returns are counted: 6 % of a turn
_RADIUS_COLUMNS, _LEAST_RADIUS_M = 3.0, 0.06
_FEWEST_NEAR, _USUAL_POINTS, _ROOM = 100, 1e5, 8192
# Shares of the near returns that are isolated without a remission, and isolated and dim on nearly all sides, or on one
# side in a cloud; that are isolated in fog, if the range shrank, too; the dim ones' share of the isolated.
_ISOLATED, _ISOLATED_DIM, _CLOUD, _HAZE, _MOSTLY_DIM = 0.05, 0.02, 0.04, 0.03, 0.6
_OF_REMISSION = 1024  # points
_DIM = 0.15  # of the usual remission, which drops are below
_RANGE_SHARE, _SHRUNK, _FEWER_RETURNS = 0.95, 0.6, 0.85
# Of the sensor's beams, and how many of their returns must be sampled to judge them: the vehicle hides less.
_LOWEST, _FEWEST_OF_LOWEST = 0.1, 50.0
# Of another sensor: this many times more or fewer returns than in the first scans, and so far beyond the elevations of
# these and of the profile [deg]. A drive does not change both.
_OTHER_RETURNS, _OTHER_DEG = 1.5, 2.0


@dataclass(frozen=True)
class Normal:
    """What a sensor's first scans showed: least counts of `fill_sectors`; high ranges [m] and returns of each scan;
    lowest and highest elevation [deg].
    """

    fewest: Floats | None = None
    ranges_m: tuple[float, ...] = ()
    returns: tuple[float, ...] = ()
    reach_deg: tuple[float, float] = (math.inf, -math.inf)

    @property
    def is_complete(self) -> bool:
        """Whether further scans change nothing."""
        return len(self.returns) >= NORMAL_SCANS

    def add(self, counts: Floats, range_m: float, n_returns: float, steep: Floats) -> Normal:
        """With one more scan, unless it is complete."""
        if self.is_complete:
            return self
        fewest = counts if self.fewest is None else np.minimum(counts, self.fewest)
        low, high = _reach_deg(steep)
        reach_deg = min(low, self.reach_deg[0]), max(high, self.reach_deg[1])
        return Normal(fewest, (*self.ranges_m, range_m), (*self.returns, n_returns), reach_deg)


def sample_step(n_points: int) -> int:
    """Every how many points of a scan are looked at."""
    return next((step for step in _STEPS if n_points <= step * _SAMPLE), n_points // _SAMPLE | 1)


def check_health(
    points: Points,
    sensor: SensorProfile,
    normal: Normal,
    eye_m: ArrayLike = (0.0, 0.0, 0.0),
    own: Points | None = None,
) -> tuple[SensorHealth, Normal]:
    """Measure what window and weather do to a scan in the frame of the models, and compare it with the first scans;
    returns the health, and ``normal`` with this scan if that is not complete.

    own : the own vehicle's, which ``points`` lack, in every `sample_step`-th row: they came through the window.
    """
    eye, points = np.array(eye_m, np.float64), read_only(points)
    step = sample_step(len(points))
    # Beams of a higher sensor meet the ground farther away at the same elevation.
    height_m = max(MODEL_HEIGHT_M + float(eye[2]), 0.1)
    beams = np.tan(np.radians(sensor.elevations_deg))
    lowest = beams[-max(2, math.ceil(_LOWEST * len(beams))) :]
    tans = np.array([*(-height_m / np.array(GROUND_M)), lowest[0]])
    counts, ranges = np.empty((N_SECTORS, 4)), np.empty(256)
    n_sampled, n_low = fill_sectors(points, eye, step, tans, counts, ranges)
    if n_sampled == 0:
        return SensorHealth(), normal
    n_returns = n_sampled
    if own is not None:  # a load hides what returned before
        counts_own = np.empty_like(counts)
        n_own, n_own_low = fill_sectors(read_only(own), eye, 1, tans, counts_own, np.empty_like(ranges))
        counts, n_returns, n_low = counts + counts_own, n_sampled + n_own, n_low + n_own_low
    wedge = _WEDGE * min(1.0, _USUAL_POINTS / len(points))  # of as many points
    near, has_remission = _isolated(points, eye, sensor, wedge, (0, 0), None)
    n_near = int(near[:, 0].sum())
    range_m = float(np.cumsum(ranges).searchsorted(_RANGE_SHARE * n_sampled)) + 0.5
    is_judged = np.array([(beams < tans[0]).sum(), ((beams >= tans[0]) & (beams < tans[1])).sum()]) >= 2
    blocked = np.logical_and(_blocked(counts, normal), is_judged)
    isolated = float(near[:, 1].sum()) / n_near if n_near >= _FEWEST_NEAR else 0.0
    known = bool(normal.ranges_m)
    has_drops, has_cloud = _has_drops(near, has_remission) if n_near >= _FEWEST_NEAR else (False, False)
    n_expected = n_returns * len(lowest) / len(beams)
    are_judged = lowest[0] < tans[1] and height_m >= MIN_MOUNT_HEIGHT_M and n_expected > _FEWEST_OF_LOWEST
    is_cut = are_judged and n_low <= _BLOCKED * n_expected
    share = n_returns * step / median_high(normal.returns) if known else 1.0
    is_other = not 1.0 / _OTHER_RETURNS < share < _OTHER_RETURNS
    steep = _steepness(points[::step], eye) if is_cut or is_other or not normal.is_complete else np.empty(0)
    is_hazy = n_near >= _FEWEST_NEAR and _everywhere(near, near[:, 1]) > _HAZE
    # Walls near by shorten the range and add returns.
    is_dimmed = is_hazy or has_drops or has_cloud or share < _FEWER_RETURNS
    health = SensorHealth(
        # Those below what is nearly the lowest point.
        beams_missing=int(len(beams) - 1 - np.abs(beams - steep[len(steep) // 200]).argmin()) if is_cut else 0,
        other_sensor_deg=_beyond(steep, sensor, normal) if is_other else None,
        blocked=float(blocked.sum() / max(1, N_SECTORS * is_judged.sum())),
        blocked_deg=_arcs(np.asarray(blocked.any(axis=1))),
        isolated=isolated,
        range_m=range_m,
        normal_range_m=median_high(normal.ranges_m) if known else None,
        returns_share=share if known else None,
        has_drops=has_drops,
        has_cloud=has_cloud,
        has_fog=known and is_dimmed and range_m < _SHRUNK * median_high(normal.ranges_m),
    )
    health = replace(health, findings=tuple(text for _, text in findings_of(health)))
    return health, normal.add(counts, range_m, float(n_returns * step), steep)


def without_drops(points: Points, sensor: SensorProfile, eye_m: ArrayLike = (0.0, 0.0, 0.0)) -> tuple[Floats32, int]:
    """A scan (n, 4) in which near points with at most one neighbor, or four if they are dim, are NaN, and their number.

    Only for scans of which `check_health` says that there are drops: leaves and wires are as lonely.
    """
    mark = np.zeros(len(points), np.bool_)
    counts, _ = _isolated(read_only(points), np.array(eye_m, np.float64), sensor, math.inf, (1, 4), mark)
    n = int(counts[:, 1].sum())
    if n == 0:
        return points, 0
    kept = points.copy()
    kept[mark] = np.nan
    return read_only(kept), n


def findings_of(health: SensorHealth) -> Iterator[tuple[str, str]]:
    """What to tell the user: kind and sentence of each sign."""
    if health.other_sensor_deg is not None:
        low, high = health.other_sensor_deg
        yield (
            "sensor",
            f"The scan has {health.returns_share:.0%} as many returns as the first scans, and they lie between "
            f"{low:.0f} and {high:.0f} deg of elevation, as none did before: it seems to be of another sensor, and is "
            "taken as one of the same. Perceive the scans of each sensor apart, by a Perceiver or a run of their own.",
        )
        return  # what its beams lack says nothing of the window
    if health.beams_missing:
        yield (
            "beams",
            f"The lowest {health.beams_missing} of the sensor's beams have no returns, though they point to the "
            "ground near by: the scan is cut short or cropped, its ground was taken out, the vehicle hides them, "
            "the sensor is another one, or the origin of the points is not at the sensor. What is nearer than the "
            "nearest returns is missing in the results: read the whole scan, or pass the sensor's own profile and "
            "the mounting.",
        )
    if health.blocked_deg:
        arcs = " and ".join(f"from {_side(right)} to {_side(left)}" for left, right in health.blocked_deg)
        yield (
            "blocked",
            f"The window of the sensor is blocked {arcs}: beams that point to the ground there return nothing, or "
            "at most a tenth of what they should. Clean the window; if a part of the vehicle hides the view, or "
            "the scan is not a whole turn, results are missing there.",
        )
    if health.has_drops:
        yield (
            "drops",
            f"{health.isolated:.0%} of the points within {NEAR_M:g} m have no neighbor, and most of them "
            "are dim; in clear air hardly any are: rain, snow, or dust all round. Such points are left out of "
            "boxes, labels and cells. Expect a shorter range, and drive slower.",
        )
    if health.has_cloud:
        yield (
            "cloud",
            f"{health.isolated:.0%} of the points within {NEAR_M:g} m have no neighbor, and most of them "
            "are dim, on one side; in clear air hardly any are: spray, dust or exhaust. It hides what is behind "
            "it, and may get a box; keep more distance from the vehicle ahead.",
        )
    if health.has_fog:
        yield (
            "fog",
            f"{_RANGE_SHARE:.0%} of the returns are nearer than {health.range_m:.0f} m, and "
            f"{health.returns_share:.0%} as many came as in the first scans, when it was "
            f"{health.normal_range_m:.0f} m: fog, or a film on the whole window. Objects farther away are not "
            "seen; drive slower, and clean the window if the air is clear.",
        )


def _side(azimuth_deg: float) -> str:
    if azimuth_deg in (0.0, 180.0, -180.0):
        return "straight ahead" if azimuth_deg == 0.0 else "straight behind"
    return f"{abs(azimuth_deg):g} degrees {'left' if azimuth_deg > 0.0 else 'right'}"


def _everywhere(near: Ints64, lonely: Ints64) -> float:
    """Share of the near points that is lonely on nearly all sides; leaves and wires are on one side."""
    known = near[:, 0] >= _FEWEST_NEAR // 4
    of_sides = np.sort(lonely[known] / near[known, 0])
    return float(of_sides[(len(of_sides) - 1) // 3]) if len(of_sides) else 0.0


def _has_drops(near: Ints64, has_remission: bool) -> tuple[bool, bool]:
    """Whether there are drops on nearly all sides, and a cloud of them on one, by counts of `mark_isolated`."""
    if not has_remission:
        return _everywhere(near, near[:, 1]) > _ISOLATED, False
    # Where leaves are, some are dim.
    drops = np.where(near[:, 2] >= _MOSTLY_DIM * near[:, 1], near[:, 2], 0)
    has_drops = _everywhere(near, drops) > _ISOLATED_DIM
    return has_drops, not has_drops and bool(drops.max() > _CLOUD * near[:, 0].sum())


def _blocked(counts: Floats, normal: Normal) -> Mask:
    """Which sectors are blocked in the bands that meet the ground, (N_SECTORS, 2) bool."""
    lacks, blocked = np.empty(counts.shape, np.bool_), np.zeros((N_SECTORS, 2), np.bool_)
    fill_lacking(counts, np.full(counts.shape, np.inf) if normal.fewest is None else normal.fewest, lacks)
    if not lacks.any():
        return blocked
    least = _NARROWEST_AT_FIRST if normal.fewest is None else _NARROWEST
    dark = lacks | (counts == 0.0)  # with what the vehicle hides
    for band in range(2):
        # What a part of the vehicle hides was hidden before, and beams above it return.
        for columns, fewest in (((band, 3), least), ((band,), _WIDE if normal.fewest is not None else N_SECTORS)):
            for first, n in _runs(dark[:, columns].all(axis=1)):
                sectors = np.arange(first, first + n) % N_SECTORS
                sectors = sectors[lacks[sectors][:, columns].all(axis=1)]
                if fewest <= len(sectors) and n <= _WIDEST:
                    blocked[sectors, band] = True
    return blocked


def _runs(marks: Mask) -> list[tuple[int, int]]:
    """First sector and length of each run of marked ones; the last sector is beside the first."""
    if marks.all():
        return [(0, len(marks))]
    firsts = np.flatnonzero(marks & ~np.roll(marks, 1))
    ends = np.flatnonzero(~marks)
    return [(int(first), int(min((ends - first) % len(marks)))) for first in firsts]


def _steepness(points: Points, eye: Floats) -> Floats:
    """Tangents of the elevations of the points beyond the window, in order."""
    xyz = points[np.isfinite(points[:, :3]).all(axis=1), :3] - eye
    flat = np.hypot(xyz[:, 0], xyz[:, 1])
    return np.sort(xyz[flat > WINDOW_M, 2] / flat[flat > WINDOW_M]) if (flat > WINDOW_M).any() else np.zeros(1)


def _reach_deg(steep: Floats) -> tuple[float, float]:
    """Elevations between which nearly all points are [deg]."""
    few = len(steep) // 100
    low, high = np.degrees(np.arctan(steep[[few, -1 - few]])).round(1).tolist()
    return low, high


def _beyond(steep: Floats, sensor: SensorProfile, normal: Normal) -> tuple[float, float] | None:
    """The elevations of a scan, if they are beyond those of the first scans and of the sensor; None otherwise."""
    low, high = _reach_deg(steep)
    lowest, highest = normal.reach_deg
    is_lower = low < min(lowest, sensor.elevations_deg[-1]) - _OTHER_DEG
    return (low, high) if is_lower or high > max(highest, sensor.elevations_deg[0]) + _OTHER_DEG else None


def _arcs(marks: Mask) -> tuple[tuple[float, float], ...]:
    """Left and right edge of each run of sectors [deg], -180..180, left positive."""

    def degrees(edge: int) -> float:
        return (edge * (360.0 / N_SECTORS) + 180.0) % 360.0 - 180.0

    return tuple((degrees(first + n), degrees(first)) for first, n in _runs(marks))


def _isolated(
    points: Points, eye: Floats, sensor: SensorProfile, wedge: float, most: tuple[int, int], mark: Mask | None
) -> tuple[Ints64, bool]:
    """What `mark_isolated` counts, and whether the scan has a remission."""
    per_m = _RADIUS_COLUMNS * math.radians(sensor.azimuth_resolution_deg)
    radius = np.array([per_m, _LEAST_RADIUS_M, max(_LEAST_RADIUS_M, per_m * NEAR_M)])
    # Pages of large buffers are slow at first.
    room = len(points) if mark is not None else min(len(points), _ROOM)
    mark = np.empty(0, np.bool_) if mark is None else mark
    buffers = np.empty((2, room), np.int32)
    heads = np.empty(1 << (13 if math.isfinite(wedge) else 17), np.int32)
    counts = np.empty((4, 3), np.int64)
    remission = points[:: len(points) // _OF_REMISSION + 1, 3]
    remission = remission[np.isfinite(remission)]
    dim = _DIM * float(np.partition(remission, len(remission) // 2)[len(remission) // 2]) if len(remission) else 0.0
    mark_isolated(points, eye, (wedge, most[0], most[1], dim), radius, heads, buffers, mark, counts)
    return counts, dim > 0.0


@njit(cache=True, nogil=True)
def fill_sectors(
    points: Points, eye: Floats, step: int, tans: Floats, counts: Floats, ranges: Floats
) -> tuple[int, int]:
    """Count every ``step``-th point by sector and band, and by range in meters; returns the number of them, and of
    those on the lowest beams.

    tans : tangents of the elevations below which beams are in the first, or else in the second band of three, and at
        most at which they are the lowest.
    counts : (N_SECTORS, 4) sectors counter-clockwise from x; the last column is the sum of the bands.
    """
    for k in range(counts.shape[0]):
        counts[k, 0] = counts[k, 1] = counts[k, 2] = counts[k, 3] = 0.0
    for k in range(ranges.shape[0]):
        ranges[k] = 0.0
    n, n_low, per_rad = 0, 0, counts.shape[0] / (2.0 * math.pi)
    for i in range(0, points.shape[0], step):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        flat = x * x + y * y
        r = math.sqrt(flat + z * z)
        if not WINDOW_M < r < math.inf:
            continue
        n += 1
        ranges[int(min(r, ranges.shape[0] - 1.0))] += 1.0
        flat = math.sqrt(flat)
        n_low += z <= tans[2] * flat
        steep = tans[1] * flat
        # tan(azimuth - 45 deg) in the first quadrant; the arc tangent is at most 0.22 deg off.
        ax, ay = abs(x), abs(y)
        v = (ay - ax) / (ay + ax) if ax + ay > 0.0 else 0.0
        angle = 0.25 * math.pi * (1.0 + v) + 0.273 * v * (1.0 - abs(v))
        if x < 0.0:
            angle = math.pi - angle
        if y < 0.0:
            angle = 2.0 * math.pi - angle
        sector = min(int(angle * per_rad), counts.shape[0] - 1)
        counts[sector, 2 if z >= steep else 0 if z * tans[1] > steep * tans[0] else 1] += 1.0
        counts[sector, 3] += 1.0
    return n, n_low


@njit(cache=True, nogil=True)
def fill_lacking(counts: Floats, fewest: Floats, lacks: Mask) -> None:
    """Write where returns are missing: fewer than in other sectors, and than the fewest before.

    counts, fewest : (N_SECTORS, 4) of `fill_sectors`; infinite before the first scan.
    """
    ordered = np.empty(counts.shape[0])
    for column in range(counts.shape[1]):
        n = 0
        for k in range(counts.shape[0]):
            value = counts[k, column]
            if value > 0.0:
                at = n
                while at > 0 and ordered[at - 1] > value:
                    ordered[at] = ordered[at - 1]
                    at -= 1
                ordered[at] = value
                n += 1
        usual = ordered[n // 2] if n > 0 else 0.0
        for k in range(counts.shape[0]):
            expected = min(usual, fewest[k, column])
            lacks[k, column] = expected >= _FEWEST_OF_SECTOR and counts[k, column] <= _BLOCKED * expected


@njit(cache=True, nogil=True)
def mark_isolated(
    points: Points,
    eye: Floats,
    of: tuple[float, int, int, float],
    radius: Floats,
    heads: Ints,
    buffers: Ints,
    mark: Mask,
    counts: Ints64,
) -> None:
    """Count points within `NEAR_M`, and those with few others around them, which are marked.

    of : only points whose smaller horizontal coordinate is at most this share of the larger one; how many others; how
        many if it is dim; the remission below which it is.
    radius : (3,) around a point, per meter of its range, at least, and at most [m].
    heads, buffers : scratch: a power of two, and 2 x the most near points that are looked at.
    counts : (4, 3) of each side, with a larger x, y, -x and -y, the near points, those with few others around, and of
        these the dim ones.
    """
    wedge, most_bright, most_dim, dim = of
    n, full = 0, np.float64(NEAR_M * NEAR_M)
    rows, chain = buffers[0], buffers[1]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        ax, ay = abs(x), abs(y)
        if (min(ax, ay) <= wedge * max(ax, ay)) & (x * x + y * y + z * z < full) and n < rows.shape[0]:
            rows[n] = i
            n += 1
    for k in range(heads.shape[0]):
        heads[k] = -1
    last, per_m = heads.shape[0] - 1, 1.0 / radius[2]
    for k in range(n):
        i = rows[k]
        h = bucket(
            int((points[i, 0] - eye[0] + 16.0) * per_m),
            int((points[i, 1] - eye[1] + 16.0) * per_m),
            int((points[i, 2] - eye[2] + 16.0) * per_m),
            last,
        )
        chain[k] = heads[h]
        heads[h] = k
    for side in range(4):
        counts[side, 0] = counts[side, 1] = counts[side, 2] = 0
    for k in range(n):
        i = rows[k]
        x, y, z = points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]
        side = (0 if x > 0.0 else 2) if abs(x) >= abs(y) else (1 if y > 0.0 else 3)
        counts[side, 0] += 1
        around = max(radius[0] * math.sqrt(x * x + y * y + z * z), radius[1])
        is_dim = points[i, 3] < dim
        most = most_dim if is_dim else most_bright
        # Neighbors of a beam are often beside one another in a scan.
        beside = 0
        for j in (k - 1, k + 1):
            if 0 <= j < n:
                row = rows[j]
                px = np.float64(points[row, 0]) - np.float64(points[i, 0])
                py = np.float64(points[row, 1]) - np.float64(points[i, 1])
                pz = np.float64(points[row, 2]) - np.float64(points[i, 2])
                beside += 0.0 < px * px + py * py + pz * pz <= around * around
        if beside <= most and is_isolated(points, eye, k, most, (around, radius[2]), heads, buffers):
            counts[side, 1] += 1
            counts[side, 2] += is_dim
            if mark.shape[0] > 0:
                mark[i] = True


@njit(cache=True, nogil=True)
def bucket(a: int, b: int, c: int, last: int) -> int:
    """Number of a cell's list."""
    return (a * 73856093 ^ b * 19349663 ^ c * 83492791) & last


@njit(cache=True, nogil=True)
def is_isolated(
    points: Points, eye: Floats, k: int, most: int, radius: tuple[float, float], heads: Ints, buffers: Ints
) -> bool:
    """Whether at most ``most`` of the other near points are around the k-th; its own cell is looked at first. What is
    in its very place is the same return: drivers write the two returns of a pulse even if they are one.

    radius : around it, and the edge of a cell [m].
    """
    rows, chain = buffers[0], buffers[1]
    i, found, last, per_m = rows[k], 0, heads.shape[0] - 1, 1.0 / radius[1]
    x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
    dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
    a, b, c = int((dx + 16.0) * per_m), int((dy + 16.0) * per_m), int((dz + 16.0) * per_m)
    for cell in range(27):
        at = (cell + 13) % 27  # of the middle one first
        u, v, w = a + at // 9 - 1, b + at // 3 % 3 - 1, c + at % 3 - 1
        j = heads[bucket(u, v, w, last)]
        while j >= 0:
            row = rows[j]
            px, py, pz = points[row, 0] - x, points[row, 1] - y, points[row, 2] - z
            is_near = 0.0 < px * px + py * py + pz * pz <= radius[0] * radius[0]
            if (
                is_near  # and of this cell, as another one may have the same list
                and int((points[row, 0] - eye[0] + 16.0) * per_m) == u
                and int((points[row, 1] - eye[1] + 16.0) * per_m) == v
                and int((points[row, 2] - eye[2] + 16.0) * per_m) == w
            ):
                found += 1
                if found > most:
                    return False
            j = chain[j]
    return True
