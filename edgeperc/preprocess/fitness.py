"""Check whether a scan is like the scans that a model was trained on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from ..errors import CardError, PointsError
from ..system.fields import Fields
from ..system.kernels import njit
from ..types.points import Floats, Floats32, Ints64, Points, Records, read_only

# About 6,000 points are enough. Steps are prime, so that they do not align with the rows of an organized scan.
_STEPS = np.array([1, 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 53, 61, 71, 83, 97, 127, 167, 223, 307, 401])
_SAMPLE, _BEAM_SAMPLE = 6000, 130_000

# The most frequent height of the near points counts as ground if it has at least this share of them. The 5th percentile
# of KITTI scans is 0.18.
_GROUND_SHARE = 0.15


N_SECTORS = 64  # of a turn, by pseudo-azimuth: y / (|x| + |y|), unfolded to -2..2
# The points between these ranges show where the ground is. Nearer, the elevation of a point depends on where in its
# housing a laser sits, and on how far the origin is from the sensor.
NEAR_M, FAR_M = 3.0, 25.0
LEAST_HEIGHT_M = -10.0
OBSTACLE_M = (0.5, 6.0)  # heights above the ground
ALONG_M, HALF_LANE_M = 30.0, 2.0  # reach of the corridors to the four sides, and half their width
# A quarter of a degree to either side: tangents for the axes, and twice that for the diagonals.
BESIDE_AXIS, BESIDE_DIAGONAL = 0.0044, 0.0087

# Sums over a scan.
SUMS = np.dtype(
    [
        ("n_finite", np.float64),  # points
        ("n_in_view", np.float64),
        ("n_sectors", np.float64),  # with points
        ("view_covered", np.float64),  # share of the sectors in the view that have points
        ("road_ahead", np.float64),  # logarithm of the ratio of obstacles at the sides to those ahead and behind
        ("remission_low", np.float64),
        ("remission_high", np.float64),
        ("n_near", np.float64),  # points 3 to 25 m away
        ("unevenness", np.float64),  # points of the fullest sector over the mean of those with points, beyond 3 m
    ]
)


class Histograms(NamedTuple):
    """Numbers of points."""

    remissions: Ints64  # (258,) remission <= 0, 256 even bins in 0..1, above 1
    elevations: Ints64  # (360,) bins of half a degree from -90, of the points farther than 3 m
    ranges: Ints64  # (200,) horizontal distance, 20 bins a decade from 1 mm
    heights: Ints64  # (3, 100) x, y and z of the points 3 to 25 m away, bins of 0.2 m from -10 m


class Rows(NamedTuple):
    """Elevations in the eight directions ahead, left, behind, right and halfway between."""

    elevations: Floats  # (8, 1024) [deg]
    counts: Ints64  # (8,) how many of them each direction has


@njit(cache=True, nogil=True)
def fill_scan_sums(
    points: Points,
    step: int,
    beam_step: int,
    view: tuple[float, float],
    histograms: Histograms,
    rows: Rows,
    sums: Records,
) -> None:
    """Measure every ``step``-th point, and for ``rows`` every ``beam_step``-th, for `check_fitness`; not finite ones
    are skipped. ``view``: right and left edge of the model's view as pseudo-azimuth.
    """
    seen, far = np.zeros(N_SECTORS), np.zeros(N_SECTORS)  # 1 with points; points farther than 3 m
    fill_histograms(points, step, view, histograms, seen, far, sums)
    measure_sectors(view, seen, far, sums)
    # A loop in place of argmax: the compiled form of that imports scipy, which takes 0.2 s a start.
    heights, highest_bin = histograms.heights, 0
    for k in range(1, heights.shape[1]):
        highest_bin = k if heights[2, k] > heights[2, highest_bin] else highest_bin
    ground = highest_bin * 0.2 - 9.9
    sums[0]["road_ahead"] = road_ahead(points, step, ground, max(sums[0]["n_finite"], 1.0))
    fill_rows(points, beam_step, rows)


@njit(cache=True, nogil=True)
def fill_histograms(
    points: Points,
    step: int,
    view: tuple[float, float],
    histograms: Histograms,
    seen: Floats,
    far: Floats,
    sums: Records,
) -> None:
    """Count the points; see `Histograms`.

    seen, far : (N_SECTORS,) float64, modified; 1 for sectors with points; number of points farther than 3 m.
    """
    remissions, elevations, ranges, heights = histograms
    remissions[:] = 0
    elevations[:] = 0
    ranges[:] = 0
    heights[:] = 0
    right, left = view
    n_finite, n_in_view, n_near, lowest, highest = 0.0, 0.0, 0.0, math.inf, -math.inf
    for i in range(0, points.shape[0], step):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        remission = np.float64(points[i, 3])
        if not math.isfinite(x + y + z + remission):
            continue
        n_finite += 1.0
        lowest, highest = min(lowest, remission), max(highest, remission)
        if remission <= 0.0:
            remissions[0] += 1
        elif remission > 1.0:
            remissions[257] += 1
        else:
            remissions[1 + min(int(remission * 256.0), 255)] += 1
        across = abs(x) + abs(y)
        if across == 0.0:
            continue
        azimuth = y / across
        if x < 0.0:
            azimuth = 2.0 - azimuth if y >= 0.0 else -2.0 - azimuth
        sector = min(int((azimuth + 2.0) * (N_SECTORS / 4.0)), N_SECTORS - 1)
        seen[sector] = 1.0
        n_in_view += 1.0 if right <= azimuth <= left else 0.0
        horizontal = math.sqrt(x * x + y * y)
        ranges[min(max(int((math.log10(horizontal) + 3.0) * 20.0), 0), 199)] += 1
        square = x * x + y * y + z * z
        if square <= NEAR_M * NEAR_M:
            continue
        far[sector] += 1.0
        elevations[min(int((math.atan(z / horizontal) * (180.0 / math.pi) + 90.0) * 2.0), 359)] += 1
        if square < FAR_M * FAR_M:
            n_near += 1.0
            for axis in range(3):
                above = (x if axis == 0 else y if axis == 1 else z) - LEAST_HEIGHT_M
                if 0.0 <= above < 20.0:
                    heights[axis, min(int(above * 5.0), 99)] += 1
    sums[0]["n_finite"], sums[0]["n_in_view"], sums[0]["n_near"] = n_finite, n_in_view, n_near
    sums[0]["remission_low"], sums[0]["remission_high"] = lowest, highest


@njit(cache=True, nogil=True)
def measure_sectors(view: tuple[float, float], seen: Floats, far: Floats, sums: Records) -> None:
    """Write how many sectors have points, the share of the view that has, and how uneven they are."""
    right, left = view
    n_seen, n_view, n_view_seen, n_far, n_sectors, fullest = 0.0, 0, 0.0, 0.0, 0.0, 0.0
    for sector in range(N_SECTORS):
        n_seen += seen[sector]
        middle = (sector + 0.5) / (N_SECTORS / 4.0) - 2.0
        if right <= middle <= left:
            n_view += 1
            n_view_seen += seen[sector]
        n_far += far[sector]
        n_sectors += far[sector] > 0.0
        fullest = max(fullest, far[sector])
    sums[0]["n_sectors"], sums[0]["view_covered"] = n_seen, n_view_seen / max(n_view, 1)
    sums[0]["unevenness"] = fullest * n_sectors / max(n_far, 1.0)


@njit(cache=True, nogil=True)
def road_ahead(points: Points, step: int, ground: float, n: float) -> float:
    """Logarithm of the ratio of obstacles at the sides to those ahead and behind, and how well they align with x.

    ground : its z [m].
    n : finite points among every ``step``-th.
    """
    ahead, behind, left, right = 0.0, 0.0, 0.0, 0.0  # obstacles in corridors 4 m wide
    along_x, along_y = np.zeros(120), np.zeros(120)
    low, high = OBSTACLE_M
    for i in range(0, points.shape[0], step):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        if not ground + low < z < ground + high or not abs(x) < ALONG_M or not abs(y) < ALONG_M:
            continue
        if not math.isfinite(points[i, 3]):
            continue
        along_x[int((x + ALONG_M) * 2.0)] += 1.0
        along_y[int((y + ALONG_M) * 2.0)] += 1.0
        if abs(y) < HALF_LANE_M and abs(x) > NEAR_M:
            ahead += x > 0.0
            behind += x <= 0.0
        if abs(x) < HALF_LANE_M and abs(y) > NEAR_M:
            left += y > 0.0
            right += y <= 0.0
    few = 0.002 * n
    square_x, square_y = 0.0, 0.0
    for k in range(along_x.shape[0]):
        square_x += along_x[k] * along_x[k]
        square_y += along_y[k] * along_y[k]
    aligned = 0.5 * math.log((square_y + 1.0) / (square_x + 1.0))
    return math.log((max(left, right) + few) / (max(ahead, behind) + few)) + aligned


@njit(cache=True, nogil=True)
def fill_rows(points: Points, step: int, rows: Rows) -> None:
    """Write the elevations in eight directions; see `Rows`."""
    elevations, counts = rows
    counts[:] = 0
    for i in range(0, points.shape[0], step):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        more, less = max(abs(x), abs(y)), min(abs(x), abs(y))
        if less < BESIDE_AXIS * more:
            direction = (0 if x > 0.0 else 4) if abs(x) > abs(y) else (2 if y > 0.0 else 6)
        elif more - less < BESIDE_DIAGONAL * more:
            direction = (1 if y > 0.0 else 7) if x > 0.0 else (3 if y > 0.0 else 5)
        else:
            continue
        z, n = np.float64(points[i, 2]), counts[direction]
        if more > 1.0 and n < elevations.shape[1] and math.isfinite(x + y + z + np.float64(points[i, 3])):
            elevations[direction, n] = math.atan(z / math.sqrt(x * x + y * y)) * (180.0 / math.pi)
            counts[direction] += 1


class Walls(NamedTuple):
    """Where a scan ends, in `N_SECTORS` directions."""

    # share of the directions with points that end at a wall: the farthest points lie above one another
    enclosed: float = 0.0
    # the same for the nearest three quarters of the points of each: the others may be seen through windows
    mostly_enclosed: float = 0.0
    # how far two opposite directions are seen [m], each by a tenth of its points; one, where the other has no points
    through_m: float = math.inf


@dataclass(frozen=True)
class Measures:
    """Statistics of one scan; None where the scan does not determine a value."""

    points_in_view: float
    view_covered: float
    remission_median: float
    remission_p99: float
    remission_zeros: float
    elevation_p01_deg: float
    elevation_p99_deg: float
    beams: float
    beams_per_deg: float
    range_median_m: float
    ground_m: float | None
    road_ahead: float | None
    # The values below are checked on their own, not against the training scans.
    n_sampled: float
    remission_low: float
    remission_high: float
    remission_beyond: float
    remission_alike: float
    flat_axis: int | None
    flat_m: float
    unevenness: float
    nearest_m: float
    far_m: float
    most_m: float
    farthest_m: float
    walls: Walls
    raised_m: float = 0.0  # the sensor, above that of the models
    is_on_car: bool = True  # it is as high above the ground as on a car
    ceiling_m: float | None = None  # above the road
    is_in_bay: bool = False  # there is room for a car around the sensor, in a place as long as a garage


def _pseudo_azimuth(azimuth_deg: float) -> float:
    x, y = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    across = y / (abs(x) + abs(y))
    return across if x >= 0.0 else math.copysign(2.0, azimuth_deg) - across


def _quantile(histogram: Ints64, share: float) -> float:
    """Place in a histogram, in bins, below which ``share`` of it lies."""
    total = np.cumsum(histogram)
    return float(np.searchsorted(total, share * total[-1], side="right")) + 0.5


def measure(points: Points, azimuth_deg: tuple[float, float]) -> Measures | None:
    """Statistics of one scan; None if no point is finite."""
    if points.ndim != 2 or points.shape[1] != 4:
        raise PointsError(f"got an array of shape {points.shape}; expected (n, 4): x, y, z, remission")
    histograms = Histograms(*(np.empty(size, np.int64) for size in (258, 360, 200, (3, 100))))
    rows, filled = Rows(np.empty((8, 1024)), np.empty(8, np.int64)), np.empty(1, SUMS)
    step = int(_STEPS[np.searchsorted(_STEPS[:-1], len(points) // _SAMPLE)])
    left, right = (_pseudo_azimuth(angle) for angle in azimuth_deg)
    fill_scan_sums(read_only(points), step, len(points) // _BEAM_SAMPLE + 1, (right, left), histograms, rows, filled)
    remissions, elevations, ranges, heights = histograms
    sums = {name: float(filled[name][0]) for name in SUMS.names or ()}
    n_finite = sums["n_finite"]
    if n_finite == 0.0:
        return None
    # In one direction, returns of one beam are less than 0.1 deg apart, returns of two beams more.
    beams = [
        np.count_nonzero(np.diff(np.sort(row[:count])) > 0.1) + 1 for row, count in zip(*rows, strict=True) if count
    ]
    n_beams = float(np.percentile(beams, 75)) if beams else 0.0
    low, high = (_quantile(elevations, share) / 2.0 - 90.0 if elevations.any() else 0.0 for share in (0.01, 0.99))
    peaks = heights.max(axis=1) / max(1.0, sums["n_near"])
    flattest = int(peaks.argmax())
    most_m, far_m, farthest_m = (10.0 ** (_quantile(ranges, share) / 20.0 - 3.0) for share in (0.9, 0.99, 0.999))
    has_ground = bool(peaks[2] >= _GROUND_SHARE)
    return Measures(
        points_in_view=sums["n_in_view"] * step,
        view_covered=sums["view_covered"],
        remission_median=min(max((_quantile(remissions, 0.5) - 1.0) / 256.0, 0.0), 1.0),
        remission_p99=min(max((_quantile(remissions, 0.99) - 1.0) / 256.0, 0.0), 1.0),
        remission_zeros=float(remissions[0] / n_finite),
        elevation_p01_deg=low,
        elevation_p99_deg=high,
        beams=n_beams,
        beams_per_deg=n_beams / (high - low + 1.0),
        range_median_m=10.0 ** (_quantile(ranges, 0.5) / 20.0 - 3.0),
        ground_m=round(int(heights[2].argmax()) * 0.2 - 9.9, 1) if has_ground else None,
        # 58 of 64 sectors: a full turn, parts of which may be hidden by the vehicle.
        road_ahead=sums["road_ahead"] if has_ground and sums["n_sectors"] >= 58 else None,
        n_sampled=n_finite,
        remission_low=sums["remission_low"],
        remission_high=sums["remission_high"],
        remission_beyond=float(remissions[257] / n_finite),
        remission_alike=float(remissions.max() / n_finite),
        # Facades are flat along y too, but only ground along a camera's axis gives such a wide range of elevations.
        flat_axis=flattest if peaks[flattest] >= max(_GROUND_SHARE, 1.5 * peaks[2]) and high - low > 60.0 else None,
        flat_m=round(int(heights[flattest].argmax()) * 0.2 - 9.9, 1),
        unevenness=sums["unevenness"],
        nearest_m=10.0 ** (_quantile(ranges, 0.01) / 20.0 - 3.0),
        far_m=far_m,
        most_m=most_m,
        farthest_m=farthest_m,
        walls=_walls(points[::step]) if far_m < _STREET_M or most_m < _MOST_OF_STREET_M else Walls(),
    )


_WALL_DEPTH, _WALL_HEIGHT_M = 0.9, 0.3  # where a direction's end begins, as a share of it; how high it is
_FEWEST_OF_SECTOR = 5  # points
# 99 and 90 % of the points of 561 real streets reach farther than 33 and 11.6 m.
_STREET_M, _MOST_OF_STREET_M = 30.0, 25.0


def _walls(points: Points) -> Walls:
    x, y, z = points[np.isfinite(points).all(axis=1), :3].astype(np.float64).T
    across = np.hypot(x, y)
    sector = (np.floor((np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * N_SECTORS)).astype(np.int64) % N_SECTORS
    order = np.lexsort((across, sector))
    across, sector, z = across[order], sector[order], z[order]
    count = np.bincount(sector, minlength=N_SECTORS)
    first = np.cumsum(count) - count

    def ends(share: float) -> Floats:
        """The range below which this share of a direction's points lies; 0 if it has too few."""
        row = np.minimum(first + np.floor(share * (count - 1.0)).astype(np.int64), len(across) - 1)
        return np.where(count > 0, across[row], 0.0)

    def enclosed(share: float, fewest: int) -> float:
        end, top, bottom = ends(share), np.full(N_SECTORS, -np.inf), np.full(N_SECTORS, np.inf)
        at_end = (across > _WALL_DEPTH * end[sector]) & (across * _WALL_DEPTH <= end[sector])
        np.maximum.at(top, sector[at_end], z[at_end])
        np.minimum.at(bottom, sector[at_end], z[at_end])
        used = count >= fewest
        return float((used & (top - bottom >= _WALL_HEIGHT_M)).sum() / max(1, np.count_nonzero(used)))

    most = ends(0.9)
    opposite = np.roll(most, N_SECTORS // 2)
    both = np.minimum(most, opposite)
    # The own body hides one of two. Of a part of a turn, none are both seen.
    through_m = float(np.where(opposite > 0.0, both, most).max()) if both.any() else 0.0
    return Walls(enclosed(1.0, 1), enclosed(0.75, _FEWEST_OF_SECTOR), through_m)


Range = tuple[float, float]
_FIELDS = Fields("the card", CardError, "export the model again", exact=True)


@dataclass(frozen=True)
class FitnessProfile:
    """Lowest and highest value of each statistic over the training scans.

    The model's card holds it; `check_fitness` compares scans with it.
    """

    n_scans: int
    azimuth_deg: Range  # left and right edge of the model's view [deg]
    points_in_view: Range  # points in that view
    view_covered: Range  # share of the view with returns, in steps of 1/64 turn
    # median, 99th percentile and share of zeros of the remission, scaled to 0..1
    remission_median: Range
    remission_p99: Range
    remission_zeros: Range
    # 1st and 99th percentile of the elevation of points farther than 3 m [deg]
    elevation_p01_deg: Range
    elevation_p99_deg: Range
    # rows of points above one another, and their number per degree of elevation
    beams: Range
    beams_per_deg: Range
    range_median_m: Range  # median horizontal distance [m]
    ground_m: Range | None  # height of the ground in the sensor frame [m]; None if no scan shows the ground
    # logarithm of the ratio of obstacles at the sides to those ahead and behind; None if no scan is a full turn
    road_ahead: Range | None

    @classmethod
    def from_scans(cls, scans: Iterable[Floats32], azimuth_deg: tuple[float, float] = (45.0, -45.0)) -> FitnessProfile:
        """Measure training scans with remission in 0..1, for a view between a left and a right edge [deg]."""
        measures = [measured for scan in scans if (measured := measure(scan, azimuth_deg)) is not None]
        if not measures:
            raise PointsError("no scan with a finite point was given; a profile needs the training scans")
        seen: dict[str, Range | None] = {}
        for name in MEASURED:
            values = [value for measure in measures if (value := getattr(measure, name)) is not None]
            seen[name] = (round(min(values), 4), round(max(values), 4)) if values else None
        return cls(n_scans=len(measures), azimuth_deg=(float(azimuth_deg[0]), float(azimuth_deg[1])), **seen)  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON; `from_dict` reads it."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> FitnessProfile:
        """Read what `to_dict` wrote."""
        profile = _FIELDS.read(cls, document, "fitness")
        _FIELDS.whole("fitness.n_scans", profile.n_scans, 1, 10**9)
        for name, (low, high) in _BOUNDS.items():
            if (values := getattr(profile, name)) is not None:
                _FIELDS.pair(f"fitness.{name}", values, low, high)
                # left before right
                if sorted(values, reverse=name == "azimuth_deg") != [*values]:
                    _FIELDS.refuse(f"fitness.{name}", values, "the left edge or the lower value first")
        return profile


MEASURED = tuple(field.name for field in fields(FitnessProfile) if field.name not in ("n_scans", "azimuth_deg"))
# Of the entries in a card. A median distance of 0 is impossible, and would be divided by.
_BOUNDS = {
    "azimuth_deg": (-180.0, 180.0),
    "points_in_view": (0.0, 1e9),
    "view_covered": (0.0, 1.0),
    "remission_median": (0.0, 1.0),
    "remission_p99": (0.0, 1.0),
    "remission_zeros": (0.0, 1.0),
    "elevation_p01_deg": (-91.0, 91.0),
    "elevation_p99_deg": (-91.0, 91.0),
    "beams": (0.0, 1e4),
    "beams_per_deg": (0.0, 1e4),
    "range_median_m": (1e-3, 1e7),
    "ground_m": (-100.0, 100.0),
    "road_ahead": (-100.0, 100.0),
}
