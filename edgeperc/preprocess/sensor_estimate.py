"""Which sensor took a scan: its beams, columns and range of remission from the points alone.

A beam of a spinning sensor sweeps a cone: its points lie on a line in range and height. Where the points come beam by
beam, as in KITTI, each turn of their azimuths is a beam. Otherwise points vote for elevations and heights of the origin
(a Hough transform); lasers of one block, such as the upper half of an HDL-64E, start at one height.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..errors import SensorError
from ..system.kernels import njit
from ..types.mounting import MIN_MOUNT_HEIGHT_M, MODEL_HEIGHT_M
from ..types.points import Floats, Floats32, Ints64, Points
from ..types.sensor import SAY_PATTERN, SENSORS, SensorProfile
from .findings import BEYOND, FEET_PER_M, check_coordinates, in_feet
from .returns import with_remission

MOST_SCANS = 3  # that an estimate uses

FEWEST_POINTS = 2000
_NEAREST_M = (3.0, 1.0, 0.5)  # of the points that are used: the first of which enough are left
_ENOUGH = 4000
_SAMPLE, _CHECKED = 20_000, 6000  # points that vote, and that are compared with the beams of each scan

# Points that come beam by beam.
_STEP_DEG, _BACK_DEG = 2.0, 20.0  # between neighbors in a beam, and back to the start of the next one
_IN_STEP, _ONE_WAY = 0.96, 0.97  # share of the neighbors that are so near, and that go one way around
_FEWEST_OF_RING = 12
_FEWEST_OF_LINE, _SPREAD = 30, 0.2  # points, and the spread of their inverse distances, that show where a beam starts
# Beams that show the circle from which all start, its largest radius, and the weight of none: (1 mm / 3 cm) squared.
_FEWEST_LINES, _RADIUS_M, _RIDGE = 4, 0.05, 0.001
# Least error of where a beam starts, and how many errors show a circle: level beams that are a little off would put
# steep ones 0.2 degrees off.
_START_M, _SHOWN = 0.0005, 4.0

# Votes: heights of the origin about that of the scan [m], bins of elevations [deg].
_OFFSETS_M: Floats = np.arange(-20, 21) * np.float64(0.02)
_FINE_M: Floats = np.arange(-5, 6) * np.float64(0.004)
_BIN_DEG, _UP_DEG, _BAND_DEG = 0.02, 60.0, 1.0
_TWO_BLOCKS = 1.08  # how much more two heights must explain than one
_VALLEY = 0.5  # of a peak: lower ones part two beams
_FEWEST_OF_BEAM = 5  # votes
_SHARED = 0.5  # of the directions in which one of two beams has points; parts of one beam share fewer
# Place, way and tilt of the sensor: nearest points [m] that are used, and how often their votes are smoothed; how far
# points may be from a peak of votes, and from their beam [deg], and from where on they count little.
_STAGES = ((12.0, 8), (8.0, 8), (6.0, 6), (4.5, 6), (3.5, 4), (2.5, 4), (2.0, 3), (1.5, 2), (1.5, 1))
_REACH_DEG, _OFF_DEG = (0.25, 1.0), 0.05
_DAMPING = (1e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1)

# Points on beams: how near [deg], which share of them beyond that of random points.
_ON_BEAM_DEG, _ON_BEAM = 0.06, 0.95
_NEAR_M, _NEAR_ALL_M = 1.0, 3.0  # median distances of the points of a beam, and of most beams, that show no elevation
_LINE, _PURE = math.radians(_ON_BEAM_DEG), 0.6  # share of the points of a beam
# The same of a built-in profile's beams, and of those of the HDL-64E, which motion during the scan moves.
_ON_KNOWN, _ON_MOVED = 0.6, 0.3

# Differences from a built-in profile [deg], of units of one model. Those of the HDL-64E are of KITTI's unit about the
# middle of lasers 0.2 m above.
_UNIT_DEG = 0.1
_UNIT_OF_BLOCKS_DEG, _MEDIAN_OF_BLOCKS_DEG = 0.6, 0.25
_SEEN, _MOST_MISSED = 0.6, 1.25  # share of a profile's beams; beams from the top to the bottom one for each one seen
_FEW = 0.2  # points of a beam, as a share of the fewer of its neighbors'
# Other units of the HDL-64E: heights of its two blocks, where they part, and its outer lasers.
_HDL_64E_M, _HDL_64E_OFF_M, _HDL_64E_BEAMS = (0.13, 0.205), 0.04, (60, 67)
_HDL_64E_PARTED_DEG, _HDL_64E_DEG, _HDL_64E_OFF_DEG = -8.3, (2.0, -24.8), 1.6
_COLUMNS_OFF = 0.25  # another rate of turning
_DENSEST, _LEAST_STEP_DEG = 8, 0.02  # beams whose azimuths are looked at; two returns of one ray are nearer

# Points without beams: how many a degree are dense, and the beams of a profile for them.
_DENSE, _BEAMLESS_COLUMNS, _BEAMLESS_LOW_DEG = 100, 1800, -10.0
_BEAMLESS_DEG: Floats = np.linspace(15.0, -25.0, 65)
# Rings on the ground: distances [m], heights of the road in the scan and around it, width of a direction, how many of
# them show a gap, the number of places where gaps are measured, and the least one [deg].
_RINGS_M, _ROADS_M, _ROAD_M, _ROAD_SLOPE = (2.0, 40.0), (-6.0, 0.5), 0.15, 0.03
_DIRECTION_DEG, _FEWEST_DIRECTIONS, _RING_PLACES, _LEAST_GAP_DEG = 1.0, 20, 400, 0.1

_SECTOR_DEG = 5
_OUTSIDE, _LEAST_SEEN = 0.002, 0.6  # share of points outside of a field of view; of its width that has points
_FEWEST_SECTORS = 54  # of 72, of a sensor that is not known
_ADVICE = (
    "pass sensor= (on the command line --sensor) with a name of edgeperc sensors, or a profile: "
    "SensorProfile(...), or a .json file"
)


class Polar(NamedTuple):
    """Points of a scan about the sensor's axis."""

    # (n,) horizontal distance and height [m]
    flat: Floats
    z: Floats
    azimuth: Floats  # (n,) [deg]
    time: Floats  # (n,) when a point was taken, in turns from the middle of the scan, if the points come in turn
    rows: tuple[Ints64, ...]  # the points of each beam, if they come beam by beam


class Beams(NamedTuple):
    """Beams from the top down."""

    # (n,) a beam's points have z = offset + slope * horizontal distance; the elevation is the angle of that slope
    elevations_deg: Floats
    slopes: Floats
    offsets_m: Floats
    seen_deg: Floats  # (n,) median elevation of its points as seen from the origin of the scan
    counts: Floats  # (n,) the number of its points
    pure: Floats  # (n,) share of these on its line
    flat_m: Floats  # (n,) their median distance


class Match(NamedTuple):
    """A built-in sensor with given beams; ``part_of``: they are few of its beams."""

    name: str = ""
    off_deg: float = 0.0
    part_of: str = ""
    also: str = ""  # the shorter one
    open_way: float = 0.0  # which way up it is, if its lowest beams are not among them; 0: they are


@dataclass(frozen=True)
class SensorEstimate:
    """The sensor of one to three scans."""

    # A built-in one, as it is or with the range of remission and the columns of the scans, or one of its own.
    profile: SensorProfile
    columns: int  # steps in a turn
    nearest_m: float  # range below which one point in a thousand lies
    blind_deg: tuple[tuple[float, float], ...]  # sectors of azimuth without a point, of at least 10 degrees
    is_built_in: bool = False  # the beams are those of the built-in profile of this name
    offsets_m: tuple[float, ...] = ()  # height at which each beam that was seen starts, above the origin of the scan
    n_beams: int = 0  # beams that were seen; of a built-in profile, others may have had no return
    off_deg: float = 0.0  # largest difference between the beams that were seen and those of the profile
    on_beams: float = 0.0  # share of the points that lie on the beams, beyond that of random points
    doubt: str = ""  # why the beams cannot be told, and what is assumed; the profile is then one for dense scans

    def __str__(self) -> str:
        if self.doubt:
            return "no beams found in the points"
        up, down = self.profile.fov_up_deg, self.profile.fov_down_deg
        what = f"{self.n_beams} beams from {up:.1f} to {down:.1f} deg, {self.columns} columns, found in the points"
        if self.is_built_in:
            what = f"{self.n_beams} of its {self.profile.n_beams} beams found, at most {self.off_deg:.2f} deg off"
        blind = ", ".join(f"{start:.0f} to {end:.0f}" for start, end in self.blind_deg)
        return (
            f"{what}; {self.on_beams:.0%} of the points are on beams"
            f"{f'; none at azimuths {blind} deg' if blind else ''}"
        )

    def tell_doubt(self, on_mismatch: str | None, of: str = "") -> None:
        """Warn of the ``doubt``, unless ``on_mismatch`` is "ignore"; SensorError if it is "raise"."""
        if self.doubt and on_mismatch == "raise":
            raise SensorError(self.doubt)
        if self.doubt and on_mismatch != "ignore":
            warnings.warn(f"{of}{self.doubt}", stacklevel=4)


def estimate_sensor(scans: Sequence[Points]) -> SensorEstimate:
    """Estimate which spinning sensor took some scans.

    scans : (n, 4) float32 each, of one sensor; x, y, z [m] about it, z along its axis, raw remission. The first three
        are used. Points need no order, but if they have that of their time, the motion of the sensor is found too.
    Returns: The built-in profile whose beams the scans have; otherwise one of their own beams; or one for points
        without beams (`_beamless`), with the ``doubt``, which a caller tells.
    Raises SensorError: The points do not tell: too few, or without beams (solid-state sensors, scans thinned to voxels)
        and sparse, or a part of a turn of a sensor that is not built in.
    """
    clean = [with_remission(scan[np.isfinite(scan[:, :3]).all(axis=1)]) for scan in scans[:MOST_SCANS]]
    polar = [_polar(scan) for scan in clean]
    n_points = max((len(each.flat) for each in polar), default=0)
    if n_points < FEWEST_POINTS:
        raise _unknown(f"the scan has {n_points:,} points; expected at least {FEWEST_POINTS:,}")
    polar = [each for each in polar if len(each.flat) >= FEWEST_POINTS // 2]
    beams, match, on_beams = _beams_of(polar)
    if on_beams < _ON_BEAM and not match.name:
        polar = [_straightened(each) for each in polar]
        beams, match, on_beams = _beams_of(polar)
        on_beams = on_beams if match.name else min(on_beams, _ON_KNOWN)  # moved beams are not sure to 0.1 degrees
    if not match.name and (name := _in_feet(polar)):
        raise SensorError(f"the sensor cannot be told from the scan. {in_feet(SENSORS[name])}")
    if on_beams < _least_on_beams(match):
        mistake = check_coordinates(max(clean, key=len))
        if mistake is not None:
            raise SensorError(f"the sensor cannot be told from the scan. {mistake}")
        explained = f"{len(beams.slopes)} explain {max(on_beams, 0.0):.0%} of them"
        return _beamless(polar, _remission_range(np.concatenate([scan[:, 3] for scan in clean])), explained)
    if match.part_of:
        also = f" or the {SENSORS[match.also].n_beams} of the {match.also}" if match.also else ""
        raise _unknown(
            f"it has {len(beams.slopes)} of the {SENSORS[match.part_of].n_beams} beams of the {match.part_of}{also}: a "
            "part of a scan, if it is of that sensor"
        )
    if not match.name and np.median(beams.flat_m) < _NEAR_ALL_M:
        raise _unknown(
            f"half of its points are nearer than {np.median(beams.flat_m):.1f} m, which shows the beams of no built-in "
            "sensor to 0.1 degrees"
        )
    blind = _blind(np.concatenate([each.azimuth for each in polar]))
    covered = 360.0 - sum(end - start for start, end in blind)
    if not match.name and covered < _FEWEST_SECTORS * _SECTOR_DEG:
        raise _unknown(
            f"its points cover {covered:.0f} deg of azimuth, and its {len(beams.slopes)} beams are of no built-in "
            "sensor: a part of a turn, or a sensor that does not turn"
        )
    columns = _columns(max(polar, key=lambda each: len(each.flat)), beams)
    remission_range = _remission_range(np.concatenate([scan[:, 3] for scan in clean]))
    ranges = np.concatenate([np.hypot(each.flat, each.z) for each in polar])
    return SensorEstimate(
        profile=_profile(match.name, beams, columns, remission_range),
        is_built_in=bool(match.name),
        offsets_m=tuple(round(float(offset), 3) for offset in beams.offsets_m),
        n_beams=len(beams.slopes),
        off_deg=match.off_deg,
        on_beams=on_beams,
        columns=columns,
        nearest_m=round(float(np.quantile(ranges, 0.001)), 2),
        blind_deg=blind,
    )


def _beamless(polar: Sequence[Polar], remission_range: tuple[float, float] | None, explained: str) -> SensorEstimate:
    """A profile for whole turns without beams that are so dense that it hardly counts where the beams are (measured in
    docs/howto/sensor.md). Raises SensorError for parts of a turn and sparse scans.
    """
    largest = max(polar, key=lambda each: len(each.flat))
    blind = _blind(largest.azimuth)
    covered = 360.0 - sum(end - start for start, end in blind)
    without = (
        "Points of several sensors, about another place than the sensor or along other axes, moved to one time, and "
        "thinned ones have no beams"
    )
    fitting = _fitting_patterns(polar)
    explained = f"no beams stand out in its {len(largest.flat):,} points: {explained}"
    if covered < _FEWEST_SECTORS * _SECTOR_DEG or len(largest.flat) < _DENSE * covered:
        which = f", by the field of view {fitting}" if fitting else ""
        raise _unknown(
            f"{explained}. They may be of a solid-state or non-repeating sensor{which}. {SAY_PATTERN}. {without}"
        )
    beams, columns = _ground_beams(polar)
    low_deg = math.degrees(math.atan(float(np.quantile(largest.z / largest.flat, _OUTSIDE))))
    last_deg = beams[0] + _LEAST_GAP_DEG if beams.size else min(low_deg, _BEAMLESS_LOW_DEG)
    beams = np.concatenate([_BEAMLESS_DEG[last_deg <= _BEAMLESS_DEG], beams])
    profile = SensorProfile("beamless", tuple(beams.tolist()), columns, remission_range or (0.0, 1.0))
    ranges = np.hypot(largest.flat, largest.z)
    return SensorEstimate(
        profile=profile,
        columns=columns,
        nearest_m=round(float(np.quantile(ranges, 0.001)), 2),
        blind_deg=blind,
        doubt=f"The sensor cannot be told from the scan: {explained}. {without}. It is taken as a dense sensor that "
        f"spins, with remission from 0 to {profile.remission_range[1]:g}. If you know the sensor"
        f"{f', by the field of view perhaps {fitting}' if fitting else ''}, {_ADVICE}.",
    )


def _ground_beams(polar: Sequence[Polar]) -> tuple[Floats, int]:
    """Elevations [deg] of beams, from the top down, that leave the gaps between rings on the ground around the scan, as
    the median of all directions, and the columns that give as many points a ring; no beams if no ground is seen. The
    eye is in the scan's origin, or, where that is near the road, at the height of the models.
    """
    flat, z = (np.concatenate([each[k] for each in polar]) for k in range(2))
    near = (flat > _RINGS_M[0]) & (flat < 12.0)
    counts, edges = np.histogram(z[near], np.arange(*_ROADS_M, 0.05))
    road_m = edges[counts.argmax()] + 0.025
    eye_m = -road_m if road_m <= -MIN_MOUNT_HEIGHT_M else MODEL_HEIGHT_M
    gaps = []
    for each in polar:
        used = (each.flat > _RINGS_M[0]) & (each.flat < _RINGS_M[1])
        far, high = each.flat[used], each.z[used]
        direction = np.floor(each.azimuth[used] / _DIRECTION_DEG)
        order = np.lexsort((far, direction))
        far, direction = far[order], direction[order]
        on_road = np.abs(high[order] - road_m) < _ROAD_M + _ROAD_SLOPE * far
        free = on_road[1:] & on_road[:-1] & (np.diff(direction) == 0.0)  # nothing stands between the two
        gaps.append(1.0 / np.stack([far[1:][free], far[:-1][free]]))
    beyond, before = np.concatenate(gaps, axis=1)
    places = np.linspace(1.0 / _RINGS_M[1], 1.0 / _RINGS_M[0], _RING_PLACES)
    spacing = np.zeros(len(places))
    for k, place in enumerate(places):
        around = (beyond <= place) & (before > place)
        if np.count_nonzero(around) >= _FEWEST_DIRECTIONS:
            spacing[k] = np.median((before - beyond)[around])
    seen = np.flatnonzero(spacing)
    if not seen.size:
        return np.empty(0), _BEAMLESS_COLUMNS
    # A gap is one beam wide: beams are where the number of gaps up to a place is whole.
    spacing = np.interp(places, places[seen], np.maximum(spacing[seen], math.radians(_LEAST_GAP_DEG) / eye_m))
    number = np.concatenate([[0.0], np.cumsum(np.diff(places) / spacing[1:])])
    whole = np.arange(math.ceil(number[seen[0]]), number[seen[-1]] + 0.5)
    n_rings = float((np.interp(before, places, number) - np.interp(beyond, places, number)).sum())
    columns = len(before) / n_rings * 360.0 / _DIRECTION_DEG
    elevations = -np.degrees(np.arctan(eye_m * np.interp(whole, number, places))).round(2)
    return elevations, min(round(columns), _BEAMLESS_COLUMNS)


def _least_on_beams(match: Match) -> float:
    return _ON_MOVED if match.name == "hdl-64e" else _ON_KNOWN if match.name else _ON_BEAM


def _in_feet(polar: Sequence[Polar]) -> str:
    """The built-in sensor whose beams a scan has if its coordinates are in feet, and farther than it measures."""
    scaled = [each._replace(flat=each.flat / FEET_PER_M, z=each.z / FEET_PER_M) for each in polar]
    _, match, on_beams = _beams_of(scaled)
    farthest = max(float(np.quantile(np.hypot(each.flat, each.z), 0.999)) for each in polar)
    is_found = match.name and on_beams >= _least_on_beams(match)
    return match.name if is_found and farthest > BEYOND * SENSORS[match.name].max_range_m else ""


def _fitting_patterns(polar: Sequence[Polar]) -> str:
    """Which sensors that do not spin have such a field of view."""
    elevation = np.degrees(np.concatenate([np.arctan2(each.z, each.flat) for each in polar]))
    low, high = np.quantile(elevation, (_OUTSIDE, 1.0 - _OUTSIDE))
    seen_deg = 360.0 - sum(end - start for start, end in _blind(np.concatenate([each.azimuth for each in polar])))
    return " or ".join(
        name
        for name, profile in SENSORS.items()
        if profile.pattern is not None
        and _LEAST_SEEN * profile.pattern.width_deg <= seen_deg <= profile.pattern.width_deg + 2.0 * _SECTOR_DEG
        # upright, or upside down
        and any(
            bottom - 1.0 <= low and high <= top + 1.0
            for bottom, top in (
                (profile.fov_down_deg, profile.fov_up_deg),
                (-profile.fov_up_deg, -profile.fov_down_deg),
            )
        )
    )


def has_enough_points(scan: Points) -> bool:
    """Whether a scan has so many points that it may tell; empty beams are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        flat = np.hypot(scan[:, 0], scan[:, 1])
    return int(np.count_nonzero((flat > _NEAREST_M[-1]) & np.isfinite(scan[:, :3]).all(axis=1))) >= FEWEST_POINTS


def _unknown(reason: str) -> SensorError:
    return SensorError(f"the sensor cannot be told from the scan: {reason}; {_ADVICE}")


def _polar(scan: Points) -> Polar:
    """The points that are no empty beams."""
    x, y, z = scan[:, :3].T.astype(np.float64)
    flat = np.hypot(x, y)
    used = flat > _NEAREST_M[-1]
    azimuth = np.degrees(np.arctan2(y[used], x[used]))
    rows: tuple[Ints64, ...] = ()
    time = np.linspace(-0.5, 0.5, len(azimuth))
    steps = (np.diff(azimuth) + 180.0) % 360.0 - 180.0
    near = np.abs(steps) < _STEP_DEG
    way = math.copysign(1.0, float(np.median(steps[near]))) if near.any() else 1.0
    if near.any() and near.mean() >= _IN_STEP and (steps[near] * way > 0.0).mean() >= _ONE_WAY:
        along = ((azimuth - azimuth[0]) * way + 1.0) % 360.0  # a beam may start a little before the first one
        starts = np.flatnonzero(np.diff(along) < -_BACK_DEG) + 1
        rows = tuple(row for row in np.split(np.arange(len(along)), starts) if len(row) >= _FEWEST_OF_RING)
        if len(rows) > 1:
            time = along / 360.0 - 0.5
        else:
            rows = ()
    return Polar(flat[used], z[used], azimuth, time, rows)


def _beams_of(polar: Sequence[Polar]) -> tuple[Beams, Match, float]:
    """Beams, the built-in sensor that has them, and the share of the points on them."""
    most = max(polar, key=lambda each: len(each.rows))
    flat, z = (most.flat, most.z) if most.rows else (np.concatenate([each[k] for each in polar]) for k in (0, 1))
    far = _far(flat, z, _SAMPLE)
    offsets_m, split = _blocks(*far)
    blocks: list[Beams] = []
    for offset_m, is_upper in zip(offsets_m, (False, True), strict=True):
        if most.rows:
            slope = math.tan(math.radians(split * _BIN_DEG - _UP_DEG))
            rows = [row for row in most.rows if (np.median((z[row] - offset_m) / flat[row]) >= slope) == is_upper]
            blocks.append(_fitted(flat, z, rows))
        else:
            votes = _votes(*far, offset_m + _FINE_M)
            votes[:, slice(0, split) if is_upper else slice(split, None)] = 0.0
            offset_m += float(_FINE_M[_contrast(votes).sum(axis=1).argmax()])
            blocks.append(_voted(polar, offset_m, split, is_upper))
    beams = _distinct(Beams(*(np.concatenate([block[k] for block in reversed(blocks)]) for k in range(7))))
    match = _match(beams)
    if not match.name and _is_hdl_64e(beams, split):
        known = np.array(SENSORS["hdl-64e"].elevations_deg)
        match = Match("hdl-64e", round(float(np.abs(beams.seen_deg[:, None] - known).min(axis=1).max()), 3))
    if not match.name:  # points of several beams, which no turn parts, lie on none; near ones show where beams start
        beams = Beams(*(values[(beams.pure >= _PURE) & (beams.flat_m >= _NEAR_M)] for values in beams))
        match = _match(beams)
    return beams, match, min(_on_beams(each, beams) for each in polar)


def _distinct(beams: Beams) -> Beams:
    """Beams from the top down without what is a part of another one, or has few points among those that have many."""
    beams = Beams(*(values[np.argsort(-beams.slopes)] for values in beams))
    apart = np.append(True, -np.diff(beams.elevations_deg) >= _ON_BEAM_DEG)
    counts = np.append(np.append(0, beams.counts), 0)
    full = beams.counts >= _FEW * np.minimum(counts[:-2], counts[2:])
    return Beams(*(values[apart[: len(full)] & full] for values in beams))


def _is_hdl_64e(beams: Beams, split: int) -> bool:
    """Whether the beams start at the two heights of an HDL-64E, and look where its units do."""
    angles, (fewest, most) = beams.elevations_deg, _HDL_64E_BEAMS
    return (
        split > 0
        and fewest <= len(angles) <= most
        and bool(np.abs(angles[[0, -1]] - _HDL_64E_DEG).max() < _HDL_64E_OFF_DEG)
    )


def _fitted(flat: Floats, z: Floats, rows: Sequence[Ints64]) -> Beams:
    """A line through the points of each beam, from the top down; all start on a circle about the axis."""
    if not rows:
        return Beams(*[np.empty(0)] * 7)
    middles = np.array([np.median(z[row] / flat[row]) for row in rows])
    order = np.argsort(-middles)
    rows, middles = [rows[k] for k in order], middles[order]
    own = np.array([_offset(flat[row], z[row], middle) for row, middle in zip(rows, middles, strict=True)])
    known = np.isfinite(own)
    offsets = np.full(len(rows), np.median(own[known]) if known.any() else 0.0)
    for limit_m in (0.05, 0.02, 0.01):
        used = known & (np.abs(own - offsets) < limit_m)
        if np.count_nonzero(used) < _FEWEST_LINES:
            break
        lean, mean = middles[used] - middles[used].mean(), own[used].mean()
        radius = np.clip(lean @ own[used] / (lean @ lean + _RIDGE), -_RADIUS_M, _RADIUS_M)
        error_m = max(float((own[used] - mean - radius * lean).std(ddof=2)), _START_M)
        if abs(radius) * math.sqrt(lean @ lean) < _SHOWN * error_m:
            radius = 0.0
        offsets = mean + radius * (middles - middles[used].mean())
    slopes = np.array([np.median((z[row] - h) / flat[row]) for row, h in zip(rows, offsets, strict=True)])
    elevations, seen = np.degrees(np.arctan([slopes, middles]))
    lines = zip(rows, offsets, slopes, strict=True)
    pure = [np.mean(np.abs((z[row] - h) / flat[row] - t) < _LINE * (1.0 + t * t)) for row, h, t in lines]
    distances = np.array([np.median(flat[row]) for row in rows])
    return Beams(elevations, slopes, offsets, seen, np.array([*map(len, rows)], np.float64), np.array(pure), distances)


def _offset(flat: Floats, z: Floats, slope: float) -> float:
    """Where a line through points starts: least squares in angle, twice without what is off; NaN if it is not shown."""
    inverse, seen, offset = 1.0 / flat, z / flat, 0.0
    for limit_deg in (1.0, 0.2, 0.1):
        used = np.abs(seen - slope - offset * inverse) < math.radians(limit_deg) * (1.0 + slope * slope)
        near, level = inverse[used], seen[used]
        if len(near) < _FEWEST_OF_LINE or near.std() < _SPREAD * near.mean():  # nearly one range
            return math.nan
        near = near - near.mean()
        offset = float(near @ level / (near @ near))
        slope = float(level.mean() - offset * inverse[used].mean())
    return offset


def _voted(polar: Sequence[Polar], offset_m: float, split: int, is_upper: bool) -> Beams:
    """The beams of a block of points in any order, by votes for elevations from a height of the origin."""
    flat, z = (np.concatenate([each[k] for each in polar]) for k in (0, 1))
    column = np.concatenate([(each.azimuth * 2.0 + 360.0).astype(np.int64) + 721 * k for k, each in enumerate(polar)])
    elevation = np.degrees(np.arctan2(z - offset_m, flat))
    votes = _votes(flat, z, np.array([offset_m]))[0]
    votes[slice(0, split) if is_upper else slice(split, None)] = 0.0
    order = np.argsort(elevation)
    rows: list[Ints64] = []
    for peak_deg, half_deg in _peaks(votes):
        low, high = np.searchsorted(elevation, (peak_deg - half_deg, peak_deg + half_deg), sorter=order)
        rows.append(order[low:high])
    rows = _merged(rows, column)
    beams = _fitted(flat, z, rows)
    # Parts of one beam may have one line.
    apart = np.abs(np.diff(beams.elevations_deg)) >= _ON_BEAM_DEG
    if apart.all():
        return beams
    rows.sort(key=lambda row: -float(np.median(z[row] / flat[row])))
    groups = np.split(np.arange(len(rows)), np.flatnonzero(apart) + 1)
    return _fitted(flat, z, [np.concatenate([rows[k] for k in group]) for group in groups])


def _merged(rows: Sequence[Ints64], column: Ints64) -> list[Ints64]:
    """Rows of beams, from the bottom up, without those that are parts of one: it has one point in each direction."""
    merged: list[Ints64] = []
    taken: list[Ints64] = []
    for row in rows:
        columns = np.unique(column[row])
        if merged:
            both = np.intersect1d(columns, taken[-1], assume_unique=True)
            if len(both) < _SHARED * min(len(columns), len(taken[-1])):
                merged[-1], taken[-1] = np.append(merged[-1], row), np.union1d(taken[-1], columns)
                continue
        merged.append(row)
        taken.append(columns)
    return merged


def _far(flat: Floats, z: Floats, n: int) -> tuple[Floats, Floats]:
    """Some of the points that show elevations well, if there are enough; every k-th may be of one beam."""
    nearest = next((least for least in _NEAREST_M if np.count_nonzero(flat > least) >= _ENOUGH), _NEAREST_M[-1])
    chosen = np.random.default_rng(0).permutation(np.flatnonzero(flat > nearest))[:n]
    return flat[chosen], z[chosen]


def _blocks(flat: Floats, z: Floats) -> tuple[tuple[float, float], int]:
    """Heights of the origin of the lower and the upper beams [m], and the bin of elevation that parts them, or 0: two
    are sought only where the lasers of an HDL-64E are, as rings on the road show no height.
    """
    gains = np.cumsum(_contrast(_votes(flat, z, _OFFSETS_M)), axis=1)
    above = gains[:, -1:] - gains
    lower, upper = (np.flatnonzero(np.abs(_OFFSETS_M - height) < _HDL_64E_OFF_M) for height in _HDL_64E_M)
    first, last = (round((_HDL_64E_PARTED_DEG + off + _UP_DEG) / _BIN_DEG) for off in (-_HDL_64E_OFF_DEG, 1.0))
    both = gains[lower, first:last].max(axis=0) + above[upper, first:last].max(axis=0)
    split = first + int(both.argmax())
    if both.max() < _TWO_BLOCKS * gains[:, -1].max():
        best = float(_OFFSETS_M[gains[:, -1].argmax()])
        return (best, best), 0
    heights_m = _OFFSETS_M[lower[gains[lower, split].argmax()]], _OFFSETS_M[upper[above[upper, split].argmax()]]
    return (float(heights_m[0]), float(heights_m[1])), split + 1


def _straightened(polar: Polar) -> Polar:
    """The points as seen from where the sensor was, about its axis. Data sets move points to one time, and turn them
    level. The place, the way of the sensor during the scan and its tilt are fitted so that the points of each beam have
    one elevation: first of far points, which hardly depend on it, and then of nearer ones.
    """
    flat, z, azimuth, time, rows = polar
    ahead, left = np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))
    moves = np.stack([ahead, left, time * ahead, time * left])
    offsets_m, split = _blocks(*_far(flat, z, _SAMPLE))
    level = z - np.where(np.degrees(np.arctan2(z, flat)) < split * _BIN_DEG - _UP_DEG, *offsets_m)
    numbers = np.full(len(flat), -1)
    for k, row in enumerate(rows):
        numbers[row] = k
    values = np.zeros(6)
    for near_m, n_smooth in _STAGES:
        chosen = np.random.default_rng(0).permutation(np.flatnonzero(flat > near_m))[:_SAMPLE]
        seen = moves[:, chosen]
        some = _moved(flat[chosen], level[chosen], seen, values)
        values = values + _step(*some, seen, numbers[chosen] if rows else None, n_smooth)
    flat, z = _moved(flat, z, moves, values)
    return Polar(np.maximum(flat, 0.1), z, azimuth, time, rows)


def _moved(flat: Floats, z: Floats, moves: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Distances and heights after a move [m] and a small tilt [rad]."""
    lean = values[4:] @ moves[:2]
    return flat - values[:4] @ moves + lean * z, z - lean * flat


def _step(flat: Floats, z: Floats, moves: Floats, numbers: Ints64 | None, n_smooth: int) -> Floats:
    """A Gauss-Newton step of the move and the tilt towards one elevation for each beam, or for each peak of votes."""
    elevation = np.degrees(np.arctan2(z, flat))
    if numbers is None:
        votes = _votes(flat, z, np.zeros(1))[0]
        for _ in range(n_smooth):
            votes = np.convolve(votes, [0.25, 0.5, 0.25], "same")
        peaks_deg = np.array([peak_deg for peak_deg, _ in _peaks(votes)])
        numbers = np.searchsorted((peaks_deg[1:] + peaks_deg[:-1]) / 2.0, elevation)
        reach_deg = _REACH_DEG[0]
    else:
        rows = [np.flatnonzero(numbers == k) for k in range(int(numbers.max(initial=-1)) + 1)]
        peaks_deg = np.array([np.median(elevation[row]) if len(row) else 0.0 for row in rows])
        reach_deg = _REACH_DEG[1]
    if len(peaks_deg) < _FEWEST_LINES:
        return np.zeros(6)
    off_deg = elevation - peaks_deg[numbers]
    used = (np.abs(off_deg) < reach_deg) & (numbers >= 0)
    numbers, off_deg = numbers[used], off_deg[used]
    slopes = np.degrees(np.concatenate([z * moves / (flat * flat + z * z), -moves[:2]]))[:, used]
    # What all points of a beam share moves the beam, and is no error.
    counts = np.maximum(np.bincount(numbers, minlength=len(peaks_deg)), 1)
    off_deg, *rows_of = (
        each - (np.bincount(numbers, each, minlength=len(peaks_deg)) / counts)[numbers] for each in (off_deg, *slopes)
    )
    slopes = np.array(rows_of)
    weights = 1.0 / (1.0 + (off_deg / _OFF_DEG) ** 2)
    return np.asarray(-np.linalg.solve((slopes * weights) @ slopes.T + np.diag(_DAMPING), slopes * weights @ off_deg))


def _votes(flat: Floats, z: Floats, offsets_m: Floats) -> Floats:
    votes = np.empty((len(offsets_m), round(2.0 * _UP_DEG / _BIN_DEG)))
    fill_votes(flat, z, offsets_m, math.radians(_UP_DEG), votes)
    return votes


def compile_votes() -> None:
    """Compile the kernel before the first scan."""
    _votes(np.ones(1), np.ones(1), np.zeros(1))


@njit(cache=True, nogil=True)
def fill_votes(flat: Floats, z: Floats, offsets_m: Floats, up: float, votes: Floats) -> None:
    """Count the points in bins of elevation, from -``up`` to ``up`` [rad], seen from each height of the origin."""
    n_bins = votes.shape[1]
    for k in range(votes.shape[0]):
        for b in range(n_bins):
            votes[k, b] = 0.0
    scale = n_bins / (2.0 * up)
    for i in range(flat.shape[0]):
        for k in range(votes.shape[0]):
            place = (math.atan2(z[i] - offsets_m[k], flat[i]) + up) * scale
            if 0.0 <= place < n_bins:
                votes[k, int(place)] += 1.0


def _contrast(votes: Floats) -> Floats:
    """How much each bin stands out from the band around it; random counts do by their own number."""
    half = round(_BAND_DEG / _BIN_DEG / 2.0)
    total = np.cumsum(np.pad(votes, ((0, 0), (half + 1, half))), axis=1)
    band = (total[:, 2 * half + 1 :] - total[:, : -2 * half - 1]) / (2 * half + 1)
    return np.asarray(votes * (votes - 1.0) / (band + 1.0))


def _peaks(votes: Floats) -> list[tuple[float, float]]:
    """Elevation and half width [deg] of each beam: maxima with valleys on both sides."""
    smooth = np.convolve(votes, [0.5, 1.0, 0.5], "same")
    found: list[int] = []
    lowest = 0.0  # since the last peak
    for k in np.flatnonzero(votes).tolist():
        last = found[-1] if found else None
        if last is not None:
            lowest = float(smooth[last : k + 1].min())
        if smooth[k] < _FEWEST_OF_BEAM:
            continue
        if last is None or lowest < _VALLEY * min(smooth[k], smooth[last]):
            found.append(k)
        elif smooth[k] > smooth[last]:
            found[-1] = k
    places = (np.array(found, np.float64) + 0.5) * _BIN_DEG - _UP_DEG
    gaps = np.diff(places, prepend=-np.inf, append=np.inf)
    halves = np.minimum(np.minimum(gaps[:-1], gaps[1:]) / 2.0, 2.0 * _ON_BEAM_DEG)
    return list(zip(places.tolist(), halves.tolist(), strict=True))


def _on_beams(polar: Polar, beams: Beams) -> float:
    """Share of the points that lie on beams, beyond that of points anywhere between the top and the bottom one."""
    if len(beams.slopes) < 2:
        return 0.0
    step = len(polar.flat) // _CHECKED + 1
    share = float(np.mean(_nearest_beams(polar.flat[::step], polar.z[::step], beams) >= 0))
    gaps = -np.diff(beams.elevations_deg)
    by_chance = float(np.minimum(gaps, 2.0 * _ON_BEAM_DEG).sum() / gaps.sum())
    return (share - by_chance) / (1.0 - by_chance) if by_chance < 1.0 else 0.0


def _nearest_beams(flat: Floats, z: Floats, beams: Beams) -> Ints64:
    """The beam that each point is on; -1 if none is near."""
    off = z[:, None] - beams.offsets_m - beams.slopes * flat[:, None]
    off_deg = np.degrees(np.abs(off) / (flat[:, None] * (1.0 + beams.slopes**2)))
    return np.where(off_deg.min(axis=1) < _ON_BEAM_DEG, off_deg.argmin(axis=1), -1)


def _match(beams: Beams) -> Match:
    """The built-in sensor with these beams, also upside down, or the one that has them and many more."""
    found, n = [Match()], len(beams.slopes)
    for name, profile in SENSORS.items():
        known = np.array(profile.elevations_deg if profile.pattern is None else ())
        if not 0 < n <= len(known):
            continue
        for way in (1.0, -1.0):
            off = np.abs(way * beams.elevations_deg[:, None] - known)
            nearest, off_deg = off.argmin(axis=1), off.min(axis=1)
            is_run = np.ptp(nearest) < _MOST_MISSED * n and len(np.unique(nearest)) == n
            # Where all beams are closer than that, any would fit.
            fits = is_run and off_deg.max() <= min(_UNIT_DEG, float(np.abs(np.diff(known)).max()) / 3.0)
            if name == "hdl-64e" and not fits and _is_above(beams, way):
                # As the profile has them, seen from the origin, the elevations depend on the distances.
                seen = np.sort(way * beams.seen_deg)[::-1]
                off_deg = min((np.abs(seen - known[k : k + n]) for k in range(len(known) - n + 1)), key=np.median)
                fits = off_deg.max() <= _UNIT_OF_BLOCKS_DEG and np.median(off_deg) <= _MEDIAN_OF_BLOCKS_DEG
            if fits:
                error_deg = round(float(off_deg.max()), 3)
                # Beams above them may meet nothing but the sky.
                has_lowest = way > 0.0 and nearest.max() >= len(known) - 2
                is_whole = n >= _SEEN * (len(known) - int(nearest.min()) * has_lowest)
                open_way = way if nearest.max() < len(known) - 2 else 0.0
                whole, part_of = (name, "") if is_whole else ("", name)
                found.append(Match(whole, error_deg, part_of, open_way=open_way))
    best = min(found[1:] or found, key=lambda each: (not each.name, each.off_deg))
    # A Helios-16P's beams are the upper half of a Helios': where none of the lower ones is seen, it may be either.
    longer = (each for each in found if each.part_of and best.open_way == each.open_way != 0.0)
    return next((each._replace(also=best.name) for each in longer if each.off_deg <= best.off_deg), best)


def _is_above(beams: Beams, way: float) -> bool:
    """Whether the upper beams start where the upper lasers of an HDL-64E are."""
    upper_m = way * beams.offsets_m[way * beams.elevations_deg > _HDL_64E_PARTED_DEG]
    return len(upper_m) > 0 and bool(abs(np.median(upper_m) - _HDL_64E_M[1]) < _HDL_64E_OFF_M)


def _columns(polar: Polar, beams: Beams) -> int:
    """Steps of a turn: of the azimuths of the beams with the most points."""
    step = len(polar.flat) // _CHECKED + 1
    some = _nearest_beams(polar.flat[::step], polar.z[::step], beams)
    densest = np.argsort(-np.bincount(some + 1, minlength=len(beams.slopes) + 1)[1:])[:_DENSEST]
    nearest = _nearest_beams(polar.flat, polar.z, Beams(*(values[densest] for values in beams)))
    steps = np.concatenate([np.diff(np.sort(polar.azimuth[nearest == k])) for k in range(len(densest))])
    steps = steps[steps > _LEAST_STEP_DEG]
    usual = np.abs(steps / np.median(steps) - 1.0) < 0.4 if len(steps) else steps > 0.0
    return round(360.0 / float(steps[usual].mean())) if usual.any() else 1


def _blind(azimuth: Floats) -> tuple[tuple[float, float], ...]:
    """Sectors without a point, of at least 10 degrees."""
    n = 360 // _SECTOR_DEG
    seen = np.bincount(((azimuth + 180.0) / _SECTOR_DEG).astype(np.int64) % n, minlength=n) > 0
    first = int(seen.argmax())  # a sector may lie across the seam
    edges = np.flatnonzero(np.diff(np.roll(seen, -first).astype(np.int64), append=1))
    starts, ends = edges[::2] + 1 + first, edges[1::2] + 1 + first
    return tuple(
        (start * _SECTOR_DEG - 180.0, end * _SECTOR_DEG - 180.0)
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
        if end - start > 1
    )


def _remission_range(raw: Floats32) -> tuple[float, float] | None:
    """The range of remission that the values are of; None if all are the same."""
    low, high = float(raw.min()), float(raw.max())
    if low == high:
        return None
    most = next((most for most in (1.0, 255.0, 65535.0) if high <= most), math.inf)
    if low < 0.0 or math.isinf(most):
        raise _unknown(f"its remission lies between {low:g} and {high:g}, in an unknown unit")
    return 0.0, most


def _profile(name: str, beams: Beams, columns: int, remission_range: tuple[float, float] | None) -> SensorProfile:
    """The built-in profile, itself if nothing differs, or one of these beams."""
    if not name:
        elevations = beams.elevations_deg.round(2)
        scaled = (0.0, 1.0) if remission_range is None else remission_range
        return SensorProfile(f"{len(elevations)}-beam", tuple(elevations.tolist()), columns, scaled)
    profile = SENSORS[name]
    changes: dict[str, object] = {}
    if remission_range not in (None, profile.remission_range):
        changes["remission_range"] = remission_range
    if abs(columns - profile.columns) > _COLUMNS_OFF * profile.columns:
        changes["columns"] = columns
    return replace(profile, **changes) if changes else profile  # type: ignore[arg-type]
