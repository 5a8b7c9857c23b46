"""Check whether a scan is like the scans that a model was trained on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CardError, PointsError
from ..system.fields import Fields
from ..system.kernel_cache import njit
from ..types.points import read_only

# About 6,000 points are enough. Steps are prime, so that they do not align with the rows of an organized scan.
_STEPS = np.array([1, 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 53, 61, 71, 83, 97, 127, 167, 223, 307, 401])
_SAMPLE, _BEAM_SAMPLE = 6000, 130_000

# The most frequent height of the near points counts as ground if it has at least this share of them. The 5th percentile
# of KITTI scans is 0.18.
_GROUND_SHARE = 0.15


@njit(cache=True, nogil=True)
def fill_scan_sums(
    points: NDArray[np.float32],
    step: int,
    beam_step: int,
    view_right: float,
    view_left: float,
    remissions: NDArray[np.int64],
    elevations: NDArray[np.int64],
    ranges: NDArray[np.int64],
    heights: NDArray[np.int64],
    rows: NDArray[np.float64],
    n_rows: NDArray[np.int64],
    sums: NDArray[np.float64],
) -> None:
    """Histograms of every ``step``-th point, for `check_fitness`. Points that are not finite are skipped.

    points : (n, 4) float32; x, y, z [m], remission.
    step, beam_step : every ``step``-th point is used; for the elevations in eight directions, every ``beam_step``-th.
    view_right, view_left : edges of the model's view as pseudo-azimuth, y / (|x| + |y|) unfolded to -2..2.
    remissions : (258,) int64, overwritten; points of remission <= 0, 256 even bins in 0..1, points above 1.
    elevations : (360,) int64, overwritten; bins of half a degree from -90, of the points farther than 3 m: nearer, it
        depends on where in its housing a laser sits, and on how far the origin is from the sensor.
    ranges : (200,) int64, overwritten; horizontal distance, 20 bins a decade from 1 mm.
    heights : (3, 100) int64, overwritten; x, y and z of the points 3 to 25 m away, bins of 0.2 m from -10 m.
    rows : (8, 1024) float64, overwritten; elevation [deg] of the points in the eight directions ahead, left, behind,
        right and halfway between.
    n_rows : (8,) int64, overwritten
    sums : (9,) float64, overwritten; 0: finite points; 1: finite points in the view; 2: sectors of 1/64 turn with
        points; 3: share of the sectors in the view that have points; 4: logarithm of the ratio of obstacles at the
        sides to those ahead and behind; 5, 6: lowest and highest remission; 7: points 3 to 25 m away; 8: points of
        the fullest sector over the mean of the sectors that have points, of the points farther than 3 m.
    """
    n = points.shape[0]
    remissions[:] = 0
    elevations[:] = 0
    ranges[:] = 0
    heights[:] = 0
    n_rows[:] = 0
    sums[:] = 0.0
    seen = np.empty(64)  # 1 in sectors with points
    far = np.empty(64)
    seen[:] = 0.0
    far[:] = 0.0
    lowest = math.inf
    highest = -math.inf
    for i in range(0, n, step):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        remission = np.float64(points[i, 3])
        if not math.isfinite(x + y + z + remission):
            continue
        sums[0] += 1.0
        lowest = min(lowest, remission)
        highest = max(highest, remission)
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
        sector = min(int((azimuth + 2.0) * 16.0), 63)
        seen[sector] = 1.0
        if view_right <= azimuth <= view_left:
            sums[1] += 1.0
        horizontal = math.sqrt(x * x + y * y)
        ranges[min(max(int((math.log10(horizontal) + 3.0) * 20.0), 0), 199)] += 1
        square = x * x + y * y + z * z
        if square > 9.0:
            far[sector] += 1.0
            elevations[min(int((math.atan(z / horizontal) * (180.0 / math.pi) + 90.0) * 2.0), 359)] += 1
        if 9.0 < square < 625.0:
            sums[7] += 1.0
            for axis in range(3):
                value = x if axis == 0 else y if axis == 1 else z
                if -10.0 <= value < 10.0:
                    heights[axis, min(int((value + 10.0) * 5.0), 99)] += 1
    sums[5] = lowest
    sums[6] = highest

    in_view = 0
    in_view_seen = 0.0
    for sector in range(64):
        sums[2] += seen[sector]
        middle = (sector + 0.5) / 16.0 - 2.0
        if view_right <= middle <= view_left:
            in_view += 1
            in_view_seen += seen[sector]
    sums[3] = in_view_seen / max(in_view, 1)
    n_far = 0.0
    n_sectors = 0.0
    fullest = 0.0
    for sector in range(64):
        n_far += far[sector]
        n_sectors += far[sector] > 0.0
        fullest = max(fullest, far[sector])
    sums[8] = fullest * n_sectors / max(n_far, 1.0)

    # Points above the ground in corridors 4 m wide to the four sides, and how well they align with the axes.
    # Loops in place of argmax and sum: the compiled form of those imports scipy, which takes 0.2 s a start.
    highest_bin = 0
    for k in range(1, heights.shape[1]):
        highest_bin = k if heights[2, k] > heights[2, highest_bin] else highest_bin
    ground = highest_bin * 0.2 - 9.9
    ways = np.empty(4)
    along_x = np.empty(120)
    along_y = np.empty(120)
    ways[:] = 0.0
    along_x[:] = 0.0
    along_y[:] = 0.0
    for i in range(0, n, step):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        z = np.float64(points[i, 2])
        if not ground + 0.5 < z < ground + 6.0 or not abs(x) < 30.0 or not abs(y) < 30.0:
            continue
        if not math.isfinite(points[i, 3]):
            continue
        along_x[int((x + 30.0) * 2.0)] += 1.0
        along_y[int((y + 30.0) * 2.0)] += 1.0
        if abs(y) < 2.0 and abs(x) > 3.0:
            ways[0 if x > 0.0 else 1] += 1.0
        if abs(x) < 2.0 and abs(y) > 3.0:
            ways[2 if y > 0.0 else 3] += 1.0
    few = 0.002 * max(sums[0], 1.0)
    sums[4] = math.log((max(ways[2], ways[3]) + few) / (max(ways[0], ways[1]) + few))
    square_x, square_y = 0.0, 0.0
    for k in range(along_x.shape[0]):
        square_x += along_x[k] * along_x[k]
        square_y += along_y[k] * along_y[k]
    sums[4] += 0.5 * math.log((square_y + 1.0) / (square_x + 1.0))

    for i in range(0, n, beam_step):
        x = np.float64(points[i, 0])
        y = np.float64(points[i, 1])
        more = max(abs(x), abs(y))
        less = min(abs(x), abs(y))
        # A quarter of a degree to either side of each direction.
        if less < 0.0044 * more:
            direction = (0 if x > 0.0 else 4) if abs(x) > abs(y) else (2 if y > 0.0 else 6)
        elif more - less < 0.0087 * more:
            direction = (1 if y > 0.0 else 7) if x > 0.0 else (3 if y > 0.0 else 5)
        else:
            continue
        z = np.float64(points[i, 2])
        if more > 1.0 and n_rows[direction] < rows.shape[1] and math.isfinite(x + y + z + np.float64(points[i, 3])):
            rows[direction, n_rows[direction]] = math.atan(z / math.sqrt(x * x + y * y)) * (180.0 / math.pi)
            n_rows[direction] += 1


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


def _pseudo_azimuth(azimuth_deg: float) -> float:
    x, y = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    across = y / (abs(x) + abs(y))
    return across if x >= 0.0 else math.copysign(2.0, azimuth_deg) - across


def _quantile(histogram: NDArray[np.int64], share: float) -> float:
    """Place in a histogram, in bins, below which ``share`` of it lies."""
    total = np.cumsum(histogram)
    return float(np.searchsorted(total, share * total[-1], side="right")) + 0.5


def measure(points: NDArray[np.float32], azimuth_deg: tuple[float, float]) -> Measures | None:
    """Statistics of one scan; None if no point is finite."""
    if points.ndim != 2 or points.shape[1] != 4:
        raise PointsError(f"got an array of shape {points.shape}; expected (n, 4): x, y, z, remission")
    points = read_only(points)
    remissions, elevations, ranges = (np.empty(size, np.int64) for size in (258, 360, 200))
    heights = np.empty((3, 100), np.int64)
    rows, n_rows, sums = np.empty((8, 1024)), np.empty(8, np.int64), np.empty(9)
    step = int(_STEPS[np.searchsorted(_STEPS[:-1], len(points) // _SAMPLE)])
    left, right = (_pseudo_azimuth(angle) for angle in azimuth_deg)
    fill_scan_sums(
        points, step, len(points) // _BEAM_SAMPLE + 1, right, left,
        remissions, elevations, ranges, heights, rows, n_rows, sums,
    )  # fmt: skip
    n_finite = sums[0]
    if n_finite == 0.0:
        return None
    # In one direction, returns of one beam are less than 0.1 deg apart, returns of two beams more.
    beams = [
        np.count_nonzero(np.diff(np.sort(row[:count])) > 0.1) + 1
        for row, count in zip(rows, n_rows, strict=True)
        if count
    ]
    n_beams = float(np.percentile(beams, 75)) if beams else 0.0
    low, high = (_quantile(elevations, share) / 2.0 - 90.0 if elevations.any() else 0.0 for share in (0.01, 0.99))
    peaks = heights.max(axis=1) / max(1.0, sums[7])
    flattest = int(peaks.argmax())
    has_ground = bool(peaks[2] >= _GROUND_SHARE)
    return Measures(
        points_in_view=float(sums[1]) * step,
        view_covered=float(sums[3]),
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
        road_ahead=float(sums[4]) if has_ground and sums[2] >= 58 else None,
        n_sampled=float(n_finite),
        remission_low=float(sums[5]),
        remission_high=float(sums[6]),
        remission_beyond=float(remissions[257] / n_finite),
        remission_alike=float(remissions.max() / n_finite),
        # Facades are flat along y too, but only ground along a camera's axis gives such a wide range of elevations.
        flat_axis=flattest if peaks[flattest] >= max(_GROUND_SHARE, 1.5 * peaks[2]) and high - low > 60.0 else None,
        flat_m=round(int(heights[flattest].argmax()) * 0.2 - 9.9, 1),
        unevenness=float(sums[8]),
        nearest_m=10.0 ** (_quantile(ranges, 0.01) / 20.0 - 3.0),
    )


Range = tuple[float, float]
_FIELDS = Fields("the card", CardError, "export the model again", exact=True)


@dataclass(frozen=True)
class FitnessProfile:
    """Lowest and highest value of each statistic over the training scans.

    The model's card holds it; `check_fitness` compares scans with it.

    Attributes
    ----------
    n_scans : int
    azimuth_deg : tuple of 2 float
        Left and right edge of the model's view [deg].
    points_in_view : tuple of 2 float
        Points in that view.
    view_covered : tuple of 2 float
        Share of the view with returns, in steps of 1/64 turn.
    remission_median, remission_p99, remission_zeros : tuple of 2 float
        Median, 99th percentile and share of zeros of the remission, scaled to 0..1.
    elevation_p01_deg, elevation_p99_deg : tuple of 2 float
        1st and 99th percentile of the elevation of points farther than 3 m [deg].
    beams, beams_per_deg : tuple of 2 float
        Rows of points above one another, and their number per degree of elevation.
    range_median_m : tuple of 2 float
        Median horizontal distance [m].
    ground_m : tuple of 2 float, or None
        Height of the ground in the sensor frame [m]; None if no scan shows the ground.
    road_ahead : tuple of 2 float, or None
        Logarithm of the ratio of obstacles at the sides to those ahead and behind; None if no scan is a full turn.
    """

    n_scans: int
    azimuth_deg: Range
    points_in_view: Range
    view_covered: Range
    remission_median: Range
    remission_p99: Range
    remission_zeros: Range
    elevation_p01_deg: Range
    elevation_p99_deg: Range
    beams: Range
    beams_per_deg: Range
    range_median_m: Range
    ground_m: Range | None
    road_ahead: Range | None

    @classmethod
    def from_scans(
        cls, scans: Iterable[NDArray[np.float32]], azimuth_deg: tuple[float, float] = (45.0, -45.0)
    ) -> FitnessProfile:
        """Measure training scans.

        scans : iterable of (n, 4) float32; x, y, z [m], remission scaled to 0..1.
        azimuth_deg : tuple of 2 float; left and right edge of the model's view [deg], between 180 and -180.
        Raises PointsError.
        """
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
        """Read what `to_dict` wrote.

        Raises CardError.
        """
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
