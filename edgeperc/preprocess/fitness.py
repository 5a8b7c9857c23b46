"""Check whether a scan is like the scans that a model was trained on."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CardError, PointsError
from ..system.kernel_cache import njit
from ..types.perception import DroppedPoints
from ..types.points import read_only
from ..types.sensor import SensorProfile

__all__ = ["Finding", "FitnessProfile", "check_dropped", "check_fitness", "check_profiles", "fill_scan_sums"]

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

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m], remission.
    step, beam_step : int
        Every ``step``-th point is used; for the elevations in eight directions, every ``beam_step``-th.
    view_right, view_left : float
        Edges of the model's view as pseudo-azimuth, y / (|x| + |y|) unfolded to -2..2.
    remissions : (258,) int64, overwritten
        Points of remission <= 0, 256 even bins in 0..1, points above 1.
    elevations : (360,) int64, overwritten
        Bins of half a degree from -90, of the points farther than 3 m: nearer, it depends on where in its housing a
        laser sits, and on how far the origin is from the sensor.
    ranges : (200,) int64, overwritten
        Horizontal distance, 20 bins a decade from 1 mm.
    heights : (3, 100) int64, overwritten
        x, y and z of the points 3 to 25 m away, bins of 0.2 m from -10 m.
    rows : (8, 1024) float64, overwritten
        Elevation [deg] of the points in the eight directions ahead, left, behind, right and halfway between.
    n_rows : (8,) int64, overwritten
    sums : (9,) float64, overwritten
        0: finite points; 1: finite points in the view; 2: sectors of 1/64 turn with points; 3: share of the sectors in
        the view that have points; 4: logarithm of the ratio of obstacles at the sides to those ahead and behind;
        5, 6: lowest and highest remission; 7: points 3 to 25 m away; 8: points of the fullest sector over the mean of
        the sectors that have points, of the points farther than 3 m.
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
class _Measures:
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


def _measure(points: NDArray[np.float32], azimuth_deg: tuple[float, float]) -> _Measures | None:
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
    return _Measures(
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

        Parameters
        ----------
        scans : iterable of (n, 4) float32
            x, y, z [m], remission scaled to 0..1.
        azimuth_deg : tuple of 2 float
            Left and right edge of the model's view [deg], between 180 and -180.

        Raises
        ------
        PointsError
            No scan has a finite point, or an array is not a scan.
        """
        measures = [measure for scan in scans if (measure := _measure(scan, azimuth_deg)) is not None]
        if not measures:
            raise PointsError("no scan with a finite point was given; a profile needs the training scans")
        seen: dict[str, Range | None] = {}
        for name in _MEASURED:
            values = [value for measure in measures if (value := getattr(measure, name)) is not None]
            seen[name] = (round(min(values), 4), round(max(values), 4)) if values else None
        return cls(n_scans=len(measures), azimuth_deg=(float(azimuth_deg[0]), float(azimuth_deg[1])), **seen)  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON; `from_dict` reads it."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> FitnessProfile:
        """Read what `to_dict` wrote.

        Raises
        ------
        CardError
            An entry is missing, unknown, not a pair of numbers or out of its bounds.
        """
        names = {field.name for field in fields(cls)}
        if not isinstance(document, Mapping) or set(document) != names:
            raise CardError(f"the card's fitness entry must hold exactly {', '.join(sorted(names))}")
        values: dict[str, Any] = {}
        for name, value in document.items():
            if name == "n_scans":
                if not isinstance(value, int) or not 1 <= value <= 10**9:
                    raise CardError(
                        f"the card's fitness entry 'n_scans' is {reprlib.repr(value)}; expected 1 to 1e9 scans"
                    )
                values[name] = value
            elif value is None and name in ("ground_m", "road_ahead"):
                values[name] = None
            else:
                values[name] = _range(name, value)
        return cls(**values)


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


def _range(name: str, value: Any) -> Range:
    """An entry of a card's profile."""
    least, most = _BOUNDS[name]
    try:
        first, second = (float(v) for v in value)
    except (TypeError, ValueError, OverflowError):
        first = second = math.nan
    low, high = (second, first) if name == "azimuth_deg" else (first, second)  # left before right
    if not least <= low <= high <= most:
        raise CardError(
            f"the card's fitness entry {name!r} is {reprlib.repr(value)}; expected two numbers from {least:g} to "
            f"{most:g}, the {'left edge' if name == 'azimuth_deg' else 'lower'} first"
        )
    return first, second


_MEASURED = tuple(field.name for field in fields(FitnessProfile) if field.name not in ("n_scans", "azimuth_deg"))


class Finding(str):
    """A sentence about how a scan differs from the training scans.

    Attributes
    ----------
    gross : bool
        The scan is so different that results would be meaningless; a `Perceiver` refuses it by default.
    """

    gross: bool

    def __new__(cls, text: str, gross: bool = False) -> Finding:
        """Make a finding from its sentence."""
        finding = super().__new__(cls, text)
        finding.gross = gross
        return finding


def check_fitness(points: NDArray[np.float32], profile: FitnessProfile, sensor: SensorProfile) -> tuple[Finding, ...]:
    """Describe how a scan differs from the scans that a model was trained on, and what to do about it.

    Margins are wide: the check finds gross mistakes (axes, units, remission scale, another sensor) and accepts ordinary
    scans of the right sensor, including scans cropped to the model's view. It does not find scans turned by 180 degrees
    or mirrored left to right, and misses one of nine scans turned by 90 degrees (measured on KITTI).

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m], remission scaled to 0..1 by ``sensor``. Points that are not finite are skipped.
    profile : FitnessProfile
    sensor : SensorProfile
        The sensor that the caller says recorded the scan. If its remission function is constant, because the scan has
        no remission, remission is not checked.

    Returns
    -------
    tuple of Finding
        One sentence for each difference; empty if there is none. Gross are: another unit; a vertical axis that is not
        z, or points down; ground more than 1.3 m from where it lay in training; no points below the horizon; points
        far above the sensor's field of view; points in less than a quarter of the model's view; half of the points as
        near as in a room; less than 1/20 of the fewest or more than 20 times the most points in training; fewer than
        eight rows of points; remission that is constant, missing or off the sensor's range.

    Raises
    ------
    PointsError
        ``points`` has another shape.
    """
    return check_profiles(points, [profile], sensor)


def check_profiles(
    points: NDArray[np.float32], profiles: Iterable[FitnessProfile], sensor: SensorProfile
) -> tuple[Finding, ...]:
    """Describe how a scan differs from the training scans of several models, each difference once.

    Parameters
    ----------
    points, sensor
        As in `check_fitness`.
    profiles : iterable of FitnessProfile
        The scan is measured once for all profiles of the same view.

    Returns
    -------
    tuple of Finding

    Raises
    ------
    PointsError
        ``points`` has another shape.
    """
    measured: dict[Range, _Measures | None] = {}
    found: dict[Finding, None] = {}
    for profile in profiles:
        if profile.azimuth_deg not in measured:
            measured[profile.azimuth_deg] = _measure(points, profile.azimuth_deg)
        found |= dict.fromkeys(_findings(measured[profile.azimuth_deg], profile, sensor))
    return tuple(found)


def _findings(scan: _Measures | None, profile: FitnessProfile, sensor: SensorProfile) -> tuple[Finding, ...]:
    if scan is None:
        return (Finding("The scan holds no finite point: is the sensor connected and its driver running?", True),)
    if scan.n_sampled < 300.0 and scan.points_in_view < 0.2 * profile.points_in_view[0]:
        return (_too_few(scan, profile),)  # too few points for the other checks
    findings = _geometry_findings(scan, profile, sensor)
    if sensor.remission is None or any(sensor.remission.coefficients[1:]):
        findings += _remission_findings(scan, profile, sensor)
    return tuple(findings)


def _too_few(scan: _Measures, profile: FitnessProfile) -> Finding:
    fewest = profile.points_in_view[0]
    return Finding(
        f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at least {fewest:.0f}: is "
        "the scan complete, and the sensor clean?",
        scan.points_in_view < fewest / 20.0,
    )


_NEARLY_ALL = 10  # near points for each that is left; also empty beams may be more than the returns
_USUAL_M = 9.0  # median distance in a street


def check_dropped(points: NDArray[np.float32], dropped: DroppedPoints, sensor: SensorProfile) -> tuple[Finding, ...]:
    """Describe a scan of which nearly all is nearer than the sensor measures: a street in another unit, or no returns.

    Parameters
    ----------
    points : (n, 4) float32
        The scan before anything was dropped.
    dropped : DroppedPoints
        What `edgeperc.preprocess.returns.returns` dropped of it.
    sensor : SensorProfile
    """
    n_left = len(points) - dropped.total
    if dropped.too_near <= _NEARLY_ALL * n_left:
        return ()
    with np.errstate(over="ignore", invalid="ignore"):
        flat_m = np.hypot(points[:, 0], points[:, 1])
        known = np.isfinite(points).all(axis=1) & np.isfinite(flat_m) & (flat_m > 0.0)
        median_m = float(np.median(flat_m[known])) if known.any() else math.inf
        factors = np.array([*[_USUAL_M / median_m] * 3, 1.0], np.float32)
        street = _measure(points[known] * factors, (180.0, -180.0))
    # Empty beams are on one ray, or at ranges that show no ground.
    if street is not None and street.ground_m is not None and street.beams >= min(_FEWEST_ROWS, sensor.n_beams):
        return (
            Finding(
                f"The median distance is {median_m:.3g}, and {dropped.too_near / len(points):.0%} of the points are "
                f"nearer than the {sensor.name} measures ({sensor.min_range_m:g} m): the coordinates seem to be in "
                "another unit; convert them to meters.",
                True,
            ),
        )
    if n_left:
        return ()
    return (
        Finding(
            f"The scan holds no return: {dropped.too_near:,} of its {len(points):,} points are at most "
            f"{sensor.min_range_m:g} m from the sensor, beams without a return. Is the sensor covered, or the profile "
            f"{sensor.name} another sensor's?",
            True,
        ),
    )


_UNITS = (("millimeters", 1e3), ("centimeters", 1e2), ("kilometers", 1e-3))

# Bounds of a gross difference.
# Less than the height of a sensor on a car, so that an origin on the road is found. The ground of 481
# KITTI scans varies by 0.4 m.
_GROUND_OFF_M = 1.3
# Points this far above the sensor's field of view and that of training. At most 2 deg in KITTI and PandaSet; 16 deg if
# PandaSet's origin is on the road.
_TOO_HIGH_DEG = 12.0
# A spinning sensor has as many returns in all directions: the fullest of 64 sectors has at most 2.6 times the mean in
# KITTI, PandaSet, Argoverse 2, Lyft, DDAD, nuScenes and View of Delft; 6 and more if the origin is 45 m off.
_MOST_UNEVEN = 4.0
_NEAREST_M = 25.0  # of 99 % of the points; at most 10 m in these data
# Fewer rows than a sensor of 16 beams has (12 to 13 are counted).
_FEWEST_ROWS = 8.0


def _geometry_findings(scan: _Measures, profile: FitnessProfile, sensor: SensorProfile) -> list[Finding]:
    near, far = profile.range_median_m
    if not near / 20.0 <= scan.range_median_m <= far * 20.0:
        factor = scan.range_median_m / math.sqrt(near * far)
        unit = next((name for name, size in _UNITS if 0.2 * size < factor < 5.0 * size), "another unit")
        return [
            Finding(
                f"The median distance is {scan.range_median_m:.3g}, in training it was {near:.0f} to {far:.0f} m: "
                f"the coordinates seem to be in {unit}; convert them to meters.",
                True,
            )
        ]
    if scan.flat_axis is not None:
        towards = ("+" if scan.flat_m > 0.0 else "-") + "xyz"[scan.flat_axis]
        advice = "" if towards != "+y" else " They may be a camera's (x right, y down, z forward): pass z, -x, -y."
        return [
            Finding(
                f"The ground seems to lie towards {towards}, where the model expects it towards -z: the axes are not "
                f"x forward, y left, z up.{advice}",
                True,
            )
        ]

    if scan.unevenness > _MOST_UNEVEN or scan.nearest_m > _NEAREST_M:
        return [
            Finding(
                f"One direction holds {scan.unevenness:.1f} times as many points as the mean one, and the nearest "
                f"points are {scan.nearest_m:.0f} m away: the sensor is not at the origin, as in the frame of a map; "
                "subtract the sensor's position from the points.",
                True,
            )
        ]

    findings: list[Finding] = []
    has_ground = scan.ground_m is not None and profile.ground_m is not None
    if scan.ground_m is not None and profile.ground_m is not None:
        low, high = profile.ground_m
        if scan.ground_m > 0.5 and high < 0.0:
            return [
                Finding(
                    f"The ground lies {scan.ground_m:.1f} m above the sensor: it is mounted upside down, or z points "
                    "down; turn the points by 180 degrees about x (negate y and z).",
                    True,
                )
            ]
        if not low - 0.6 <= scan.ground_m <= high + 0.6:
            has_ground = False
            findings.append(
                Finding(
                    f"The ground lies at z = {scan.ground_m:.1f} m, in training it lay at {low:.1f} to {high:.1f} m: "
                    "the sensor is mounted at another height: pass the right mounting (--mount-height), or none, "
                    "so that it is found.",
                    not low - _GROUND_OFF_M <= scan.ground_m <= high + _GROUND_OFF_M,
                )
            )

    low, high = profile.elevation_p01_deg[1], profile.elevation_p99_deg[1]
    # The lowest beams are missing from a crop to a camera's view (9 deg) and from a scan cut short (up to 13).
    unlike = scan.elevation_p01_deg > low + 13.0 or scan.elevation_p99_deg > high + 8.0
    if unlike and scan.elevation_p01_deg < scan.elevation_p99_deg:  # both are 0 if no point is far
        findings.append(
            Finding(
                f"The points lie between {scan.elevation_p01_deg:.0f} and {scan.elevation_p99_deg:.0f} deg of "
                f"elevation, in training between {low:.0f} and {high:.0f}: this is a sensor of another field of view, "
                "or the origin is not the sensor, or it is not level.",
                scan.elevation_p01_deg > 0.0 or scan.elevation_p99_deg > max(high, sensor.fov_up_deg) + _TOO_HIGH_DEG,
            )
        )

    left, right = profile.azimuth_deg
    if scan.view_covered < 0.6 * profile.view_covered[0]:
        findings.append(
            Finding(
                f"Only {scan.view_covered:.0%} of the model's view ({left:.0f} to {right:.0f} deg of azimuth) holds "
                "points: the scan is cropped, or x does not point forward.",
                scan.view_covered < 0.25 * profile.view_covered[0],
            )
        )
    elif (
        scan.road_ahead is not None
        and profile.road_ahead is not None
        and scan.road_ahead < min(-0.5, profile.road_ahead[0] - 0.3)
    ):
        findings.append(
            Finding(
                "There are more obstacles ahead and behind than to the sides, as if the road ran along y: if x does "
                "not point forward, pass its direction: Mounting(yaw_deg=-90), --turn -90, for x right, y forward. "
                "If the vehicle stands across the road, ignore this."
            )
        )

    # The smallest median in 481 KITTI scans is 3.8 m, above half of `near`; in two captures of a room 1.3 and 2.1 m.
    if scan.ground_m is None and scan.range_median_m < near / 2.0:
        findings.append(
            Finding(
                f"Half of the points are nearer than {scan.range_median_m:.1f} m, in training {near:.0f} to "
                f"{far:.0f} m, and no ground was found: this seems to be a room, or the sensor is covered; the models "
                "know roads.",
                True,
            )
        )

    few_rows = scan.beams < 0.75 * profile.beams[0] and scan.beams_per_deg < 0.65 * profile.beams_per_deg[0]
    too_few_rows = scan.beams < min(_FEWEST_ROWS, sensor.n_beams)
    if (few_rows and has_ground) or too_few_rows:  # rows cannot be separated if the origin is wrong
        findings.append(
            Finding(
                f"The scan has about {scan.beams:.0f} rows of points (sensor {sensor.name}: {sensor.n_beams}), in "
                f"training it had at least {profile.beams[0]:.0f}: expect to lose far and small objects, or use a "
                "model trained for it.",
                too_few_rows,
            )
        )

    if scan.points_in_view < 0.2 * profile.points_in_view[0]:
        findings.append(_too_few(scan, profile))
    elif scan.points_in_view > 5.0 * profile.points_in_view[1]:
        findings.append(
            Finding(
                f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at most "
                f"{profile.points_in_view[1]:.0f}: pass one turn of the sensor at a time.",
                scan.points_in_view > 20.0 * profile.points_in_view[1],
            )
        )
    return findings


def _remission_findings(scan: _Measures, profile: FitnessProfile, sensor: SensorProfile) -> list[Finding]:
    # Without remission, 36 % of the car points and 74 % of the road cells remain (intersection over union with the
    # results with remission, 20 KITTI scans, default models); with a constant one, 15 % and 32 %.
    low, high = sensor.remission_range
    raw_low, raw_high, raw_p99 = (
        value * (high - low) + low for value in (scan.remission_low, scan.remission_high, scan.remission_p99)
    )
    stated = f"the profile {sensor.name} has {low:g} to {high:g}"
    useless = max(0.9, profile.remission_zeros[1] + 0.05)
    if scan.remission_beyond > 0.01 or scan.remission_low < -0.05:
        likely = next((f"(0, {top})" for top in (1, 255, 65535) if raw_low >= 0.0 and raw_high <= top), "that")
        return [
            Finding(
                f"Remission runs from {raw_low:g} to {raw_high:g}, but {stated}: pass sensor= a profile whose "
                f"remission_range is {likely}.",
                True,
            )
        ]
    if scan.remission_zeros > useless:
        return [
            Finding(
                f"Remission is 0 for {scan.remission_zeros:.0%} of the points: the field is missing or was not read; "
                "the model needs it.",
                True,
            )
        ]
    # Data in 0..1 has 0.004 of a full scale of 255, which is one bin too.
    in_one_bin = scan.remission_p99 < 0.02 and scan.remission_low < scan.remission_high
    if scan.remission_alike > useless and not in_one_bin:
        return [
            Finding(
                f"Remission is the same for {scan.remission_alike:.0%} of the points ({raw_high:g}): the field holds "
                "something else; the model needs it.",
                True,
            )
        ]
    if scan.remission_p99 < 0.2 * profile.remission_p99[0]:
        return [
            Finding(
                f"Remission hardly exceeds {raw_p99:.2g}, but {stated}: pass sensor= a profile with the "
                "remission_range of this data, (0, 1) if it is scaled already.",
                scan.remission_p99 < 0.02,
            )
        ]
    darkest, brightest = profile.remission_median
    if not darkest / 4.0 <= scan.remission_median <= brightest * 2.5:
        return [
            Finding(
                f"The median remission is {scan.remission_median:.2f} of full scale, in training it was {darkest:.2f} "
                f"to {brightest:.2f}: sensors differ in remission; fit a profile with edgeperc fit-sensor."
            )
        ]
    return []
