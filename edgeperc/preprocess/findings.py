"""What of a scan differs from the training scans, in sentences."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from ..types.frame import ModelFrame
from ..types.mounting import MODEL_HEIGHT_M, Mounting
from ..types.perception import DroppedPoints
from ..types.points import Floats, Points
from ..types.sensor import SensorProfile
from .fitness import FitnessProfile, Measures, Range, measure


class Finding(str):
    """A sentence about how a scan differs from the training scans."""

    gross: bool  # the scan is so different that results would be meaningless; a `Perceiver` refuses it by default

    def __new__(cls, text: str, gross: bool = False) -> Finding:
        finding = super().__new__(cls, text)
        finding.gross = gross
        return finding


def _gross(text: str) -> Finding:
    """A finding for which a scan is refused."""
    return Finding(text, True)


def _alone(text: str) -> tuple[Finding, ...]:
    """All there is to say of a scan that is refused."""
    return (_gross(text),)


_NUMBER = re.compile(r"\d[\d.,]*")


def by_kind(texts: Iterable[str]) -> dict[str, str]:
    """Sentences by what they say but for their numbers, which differ from scan to scan."""
    return {_NUMBER.sub("", text): text for text in texts}


def check_fitness(
    points: Points, profile: FitnessProfile, sensor: SensorProfile, frame: ModelFrame | None = None
) -> tuple[Finding, ...]:
    """Describe how a scan differs from those of the training, and what to do about it (docs/concepts/fitness.md).

    Margins are wide: the check finds gross mistakes (axes, units, remission scale, another sensor) and accepts ordinary
    scans of the right sensor, including scans cropped to the model's view. It does not find scans turned by 180 degrees
    or mirrored left to right, and misses one of nine scans turned by 90 degrees (measured on KITTI).

    sensor : that the caller says recorded the scan. If its remission function is constant, because the scan has no
        remission, remission is not checked.
    frame : what moved the scan into the frame of the models. A sensor that is high, or leans, sees points that are
        higher there than its beams.
    """
    return check_profiles(points, [profile], sensor, frame)


def check_profiles(
    points: Points,
    profiles: Iterable[FitnessProfile],
    sensor: SensorProfile,
    frame: ModelFrame | None = None,
    ceiling_m: float | None = None,
) -> tuple[Finding, ...]:
    """Describe how a scan, measured once for each view, differs from the training scans of several models."""
    measured: dict[Range, Measures | None] = {}
    found: dict[Finding, None] = {}
    for profile in profiles:
        if profile.azimuth_deg not in measured:
            scan = measure(points, profile.azimuth_deg)
            if scan is not None:
                scan = replace(_seen_again(scan, points, sensor, frame), ceiling_m=ceiling_m)
            measured[profile.azimuth_deg] = scan
        found |= dict.fromkeys(_findings(measured[profile.azimuth_deg], profile, sensor))
    return tuple(found)


def _seen_again(scan: Measures, points: Points, sensor: SensorProfile, frame: ModelFrame | None) -> Measures:
    """The measures with the ground as the lowest points show it, if it is not where most points are (on a ceiling, on
    walls, or around a high sensor), and with elevations as the sensor sees them, if these are lower.
    """
    raised_m = 0.0 if frame is None else float(frame.eye[2])
    sample = points[:: len(points) // _SAMPLE + 1, :3].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    off_m = 0.0 if scan.ground_m is None else abs(scan.ground_m + MODEL_HEIGHT_M)
    is_elsewhere, is_near = off_m > _LEVEL_OFF_M or scan.flat_axis is not None, scan.most_m < _MOST_OF_HALL_M
    is_road_below = (is_elsewhere or is_near) and _is_road_below(sample)
    is_on_car = not is_near or (is_road_below and raised_m >= _LOWER_M)
    scan = replace(scan, raised_m=raised_m, is_on_car=is_on_car, is_in_bay=is_near and is_on_car and _is_bay(points))
    if raised_m > _HIGH_M and len(sample):
        scan = replace(scan, ground_m=_ground_far_around(sample), road_ahead=None)
    elif is_elsewhere and is_road_below:
        scan = replace(scan, ground_m=-MODEL_HEIGHT_M, flat_axis=None, road_ahead=None)
    if frame is not None and scan.elevation_p99_deg > sensor.fov_up_deg + _TOO_HIGH_DEG:
        x, y, z = ((sample - frame.eye) @ frame.R).T
        highest_deg = float(np.percentile(np.degrees(np.arctan2(z * np.sign(frame.R[2, 2]), np.hypot(x, y))), 99.0))
        scan = replace(scan, elevation_p99_deg=min(scan.elevation_p99_deg, highest_deg))
    return scan


def _is_road_below(sample: Floats) -> bool:
    """Whether the lowest points of many cells near by are as high as the road, and those of few are lower."""
    lowest = _lowest_in_cells(sample, *_NEAR_AROUND_M)
    on_road = np.abs(lowest + MODEL_HEIGHT_M) <= _LEVEL_OFF_M
    return bool(len(lowest) and on_road.mean() >= _MANY and (lowest < -MODEL_HEIGHT_M - _LEVEL_OFF_M).mean() < _SOME)


def _is_bay(points: Points) -> bool:
    """Whether a car around the sensor touches nothing, with as much room before and behind it as in a garage."""
    x, y, z = points[np.isfinite(points).all(axis=1), :3].astype(np.float64).T
    height = z + MODEL_HEIGHT_M
    is_beside = (height > _BODY_M[0]) & (height < _BODY_M[1]) & (np.abs(y) < _HALF_CAR_M[1])
    if np.count_nonzero(is_beside & (np.abs(x) < _HALF_CAR_M[0])) > _FEW_INSIDE * len(x):
        return False
    ends_m = []
    for away in (x[is_beside], -x[is_beside]):
        away = away[away > 0.0]
        ends_m.append(float(np.percentile(away, 2.0)) if len(away) >= _FEWEST_AT_END else math.inf)
    deep_m = sum(ends_m)
    return min(ends_m) >= _BUMPER_M and (deep_m <= _GARAGE_M or deep_m >= _HALL_LENGTH_M)


def _lowest_in_cells(sample: Floats, reach_m: float, cell_m: float) -> Floats:
    """The lowest z in each square of ``cell_m`` with points up to ``reach_m`` away."""
    x, y, z = sample[np.hypot(sample[:, 0], sample[:, 1]) < reach_m].T
    _, cell = np.unique(np.floor([x / cell_m, y / cell_m]).astype(np.int64), axis=1, return_inverse=True)
    lowest = np.full(int(cell.max(initial=-1)) + 1, np.inf)
    np.minimum.at(lowest, cell.ravel(), z)
    return lowest


def _ground_far_around(sample: Floats) -> float | None:
    """The height that many of the lowest points in cells up to 60 m away have [m], nearest to the road's; or None."""
    steps, counts = np.unique(np.floor(_lowest_in_cells(sample, *_FAR_AROUND_M) / _STEP_M), return_counts=True)
    levels_m = (steps[counts >= _MANY * counts.sum()] + 0.5) * _STEP_M
    return round(float(levels_m[np.abs(levels_m + MODEL_HEIGHT_M).argmin()]), 1) if len(levels_m) else None


def _findings(scan: Measures | None, profile: FitnessProfile, sensor: SensorProfile) -> tuple[Finding, ...]:
    if scan is None:
        return _alone("The scan holds no finite point: is the sensor connected and its driver running?")
    if scan.n_sampled < 300.0 and scan.points_in_view < 0.2 * profile.points_in_view[0]:
        return (_too_few(scan, profile, sensor),)  # too few points for the other checks
    findings = _geometry_findings(scan, profile, sensor)
    if sensor.remission is None or any(sensor.remission.coefficients[1:]):
        findings.append(_other_remission(scan, profile, sensor))
    return tuple(finding for finding in findings if finding is not None)


def _too_few(scan: Measures, profile: FitnessProfile, sensor: SensorProfile) -> Finding:
    fewest, pattern = profile.points_in_view[0], sensor.pattern
    share = 1.0 if pattern is None else min(1.0, pattern.points_per_s * pattern.accumulate_s / _PULSES)
    return Finding(
        f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at least {fewest:.0f}: is "
        "the scan complete, and the sensor clean?",
        scan.points_in_view < share * fewest / 20.0,
    )


_PULSES = 130_000  # of a turn of the training sensor; a scan that is gathered for a short time has fewer
_NEARLY_ALL = 10  # dropped points for each that is left; also empty beams may be more than the returns
_USUAL_M = 9.0  # median distance in a street


def check_dropped(points: Points, dropped: DroppedPoints, sensor: SensorProfile) -> tuple[Finding, ...]:
    """Describe a scan of which nearly all was dropped: too near, in another unit or no returns; or in the ego box."""
    n_left = len(points) - dropped.total
    if dropped.ego > _NEARLY_ALL * max(n_left, dropped.too_near):
        return _alone(
            f"{dropped.ego:,} of the {len(points):,} points of the scan lie inside the ego_box of the profile "
            f"{sensor.name}, {sensor.ego_box}, and are dropped as the own vehicle: expected its lowest and highest "
            "x, y and z about the sensor, along the axes of the scan, in meters."
        )
    if dropped.too_near <= _NEARLY_ALL * n_left:
        return ()
    with np.errstate(over="ignore", invalid="ignore"):
        flat_m = np.hypot(points[:, 0], points[:, 1])
        known = np.isfinite(points).all(axis=1) & np.isfinite(flat_m) & (flat_m > 0.0)
        median_m = float(np.median(flat_m[known])) if known.any() else math.inf
        factors = np.array([*[_USUAL_M / median_m] * 3, 1.0], np.float32)
        street = measure(points[known] * factors, (180.0, -180.0))
    # Empty beams are on one ray, or at ranges that show no ground.
    if street is not None and street.ground_m is not None and street.beams >= min(_FEWEST_ROWS, sensor.n_beams):
        return _alone(
            f"The median distance is {median_m:.3g}, and {dropped.too_near / len(points):.0%} of the points are "
            f"nearer than the {sensor.name} measures ({sensor.min_range_m:g} m): the coordinates seem to be in "
            "another unit; convert them to meters."
        )
    if n_left:
        return ()
    return _alone(
        f"The scan holds no return: {dropped.too_near:,} of its {len(points):,} points are at most "
        f"{sensor.min_range_m:g} m from the sensor, beams without a return. Is the sensor covered, or the profile "
        f"{sensor.name} another sensor's?"
    )


# Around the sensor, 1 % of the points are nearer than half of the median distance; in a map, all are about as far.
_AWAY, _FARTHEST_M, _STEPS_M = 0.7, 8.9e6, 0.01
_STREET_M = (7.0, 12.0)  # median distance in streets
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
_MOST_UNEVEN, _EVEN, _ALL_AROUND = 4.0, 2.6, 0.9
_NEAREST_M = 25.0  # of 99 % of the points; at most 10 m in these data
_NEAREST_HEIGHTS = 4.0  # the lowest beam of a vlp-16 meets the ground at 3.7 times its height
_SAMPLE = 6000  # points
_HIGH_M = 1.0  # above the sensor of the models
# How far the lowest points are looked at, and the squares in which they are the lowest. In drawn tunnels, alleys and
# garages, 16 % and more of the squares near by have theirs on the road, if it lies where it should; in scans of KITTI
# and of simulated streets that are upside down, shifted or have other axes, at most 12 %.
_FAR_AROUND_M, _NEAR_AROUND_M = (60.0, 3.0), (15.0, 1.0)
_STEP_M, _LEVEL_OFF_M, _MANY, _SOME = 0.6, 0.5, 0.15, 0.4
# 99 % of the points of a room of 14 x 10 m are nearer than 10 m; of the most enclosed of 561 real streets, 33 m. Half
# of the points of a street that was cropped to 12 m are mostly farther than 5 m.
_ROOM_M, _HALL_M, _COVERED_M, _HALF_OF_SMALL_M = 12.0, 25.0, 1.5, 5.0
# Share of directions that end at a wall: 0.72 and more in 64 drawn rooms of four sensors, at most 0.70 in nearly all
# real streets that were cropped to 8 and 12 m.
_ENCLOSED = 0.71
# With windows and doors, some points are far: 90 % are nearer than 9 m in rooms and 11 m in garages, and farther than
# 11.6 m in real streets. Half of the points are nearer than in streets (3.6 m) and in garages, where the sensor is on a
# car. Two opposite directions of an alley are both seen farther than 17 m. Of streets that were cropped to 8 and 12 m,
# at most 0.88 of the directions end at a wall.
_HALF_OF_ROOM_M, _HALF_BESIDE_CAR_M, _MOST_OF_ROOM_M = 4.5, 2.6, 9.0  # the ranges below which half and 90 % are
_MOST_OF_HALL_M, _THROUGH_M, _ENCLOSED_HALL = 11.0, 12.0, 0.9
# Two opposite directions of 780 real streets are both seen 21 m far and farther.
_THROUGH_HALL_M = 18.0
# Where a car has its body, above the road, around the sensor on its roof; how few points may seem to be in it, as a
# share; how near its bumpers are; how deep a garage of a house, at most, and a hall, at least, is along the car.
_BODY_M, _HALF_CAR_M, _FEW_INSIDE, _BUMPER_M = (0.3, 1.4), (1.9, 0.75), 1e-4, 2.1
_GARAGE_M, _HALL_LENGTH_M, _FEWEST_AT_END = 8.8, 15.0, 20
_LYING_DEG = 45.0  # of tilt, beyond which boxes lie rather than stand
_LOWER_M = -0.3  # than the sensor of the models, on a car
# Fewer rows than a sensor of 16 beams has (12 to 13 are counted).
_FEWEST_ROWS, _FEWEST_FROM_ABOVE = 8.0, 4.0  # half of the beams of a high sensor may meet nothing


def _geometry_findings(scan: Measures, profile: FitnessProfile, sensor: SensorProfile) -> list[Finding | None]:
    """What differs in the coordinates; a mistake in their frame or unit alone, because it explains the rest."""
    walls = _walls(scan)
    room = walls if walls is not None and walls.gross else None  # its ceiling may count as ground
    mistake = (
        _other_unit(scan, profile.range_median_m)
        or _feet(scan, sensor)
        or _other_axes(scan)
        or room
        or _other_origin(scan)
        or _upside_down(scan, profile)
    )
    if mistake is not None:
        return [mistake]
    other_height = _other_height(scan, profile)
    has_ground = scan.ground_m is not None and profile.ground_m is not None and other_height is None
    return [
        other_height,
        _other_field_of_view(scan, profile, sensor),
        _cropped(scan, profile) or _turned(scan, profile),
        _room(scan, profile) or walls,
        _few_rows(scan, profile, sensor, has_ground),
        _other_number(scan, profile, sensor),
    ]


def check_coordinates(points: Points) -> Finding | None:
    """What is wrong with the unit, the axes or the origin of a scan of any sensor; None if nothing is found.

    points : (n, 4) float32; finite.
    """
    scan = measure(points, (180.0, -180.0))
    return None if scan is None else _other_unit(scan, _STREET_M) or _other_axes(scan) or _other_origin(scan)


def _other_unit(scan: Measures, usual_m: Range) -> Finding | None:
    near, far = usual_m
    if near / 20.0 <= scan.range_median_m <= far * 20.0:
        return None
    if _AWAY * scan.range_median_m < scan.nearest_m < _FARTHEST_M:
        steps = float(np.spacing(np.float32(scan.range_median_m)))
        rounded = f" As float32, they are rounded to {steps:.2g} m: subtract it in double." if steps > _STEPS_M else ""
        return _gross(
            f"The points are about {scan.range_median_m:,.0f} m away, all in one direction: the sensor is not at the "
            "origin, as in the frame of a map; subtract the sensor's position, which edgeperc.read_points does: "
            f"origin_m= or --origin X Y Z.{rounded}"
        )
    factor = scan.range_median_m / math.sqrt(near * far)
    unit = next((name for name, size in _UNITS if 0.2 * size < factor < 5.0 * size), "another unit")
    return _gross(
        f"The median distance is {scan.range_median_m:.3g}, in training it was {near:.0f} to {far:.0f} m: "
        f"the coordinates seem to be in {unit}; convert them to meters."
    )


FEET_PER_M = 3.28084
BEYOND, _FAR_BEYOND, _ABOVE_CAR_M = 1.25, 2.2, 1.8
"""Of the range of a sensor that 999 of 1,000 points are within: farther at any height, and above that of a car."""


def _feet(scan: Measures, sensor: SensorProfile) -> Finding | None:
    most = BEYOND if scan.raised_m > _ABOVE_CAR_M else _FAR_BEYOND
    if scan.farthest_m <= most * sensor.max_range_m or scan.view_covered < _ALL_AROUND:
        return None
    return in_feet(sensor) if scan.farthest_m <= _DECIMETERS * sensor.max_range_m else _IN_DECIMETERS


def in_feet(sensor: SensorProfile) -> Finding:
    """What to say of points beyond the range of a sensor."""
    return _gross(
        f"Points are farther away than the {sensor.name} measures ({sensor.max_range_m:g} m): the coordinates seem to "
        f"be in feet; multiply them by {1.0 / FEET_PER_M:.4f}. If they are in meters, pass sensor= a profile with the "
        "max_range_m of the sensor."
    )


_DECIMETERS = 4.3  # times the range of a sensor
_IN_DECIMETERS = _gross(
    "Points are too far away, on all sides: the coordinates seem to be in decimeters; multiply them by 0.1."
)


def _other_axes(scan: Measures) -> Finding | None:
    if scan.flat_axis is None:
        return None
    towards = ("+" if scan.flat_m > 0.0 else "-") + "xyz"[scan.flat_axis]
    advice = "" if towards != "+y" else " They may be a camera's (x right, y down, z forward): pass z, -x, -y."
    return _gross(
        f"The ground seems to lie towards {towards}, where the model expects it towards -z: the axes are not "
        f"x forward, y left, z up.{advice}"
    )


def _other_origin(scan: Measures) -> Finding | None:
    if scan.nearest_m <= _NEAREST_M + _NEAREST_HEIGHTS * max(0.0, scan.raised_m):
        if scan.unevenness <= _MOST_UNEVEN:
            return None
    elif scan.unevenness <= _EVEN and scan.view_covered > _ALL_AROUND:
        return _IN_DECIMETERS
    return _gross(
        f"One direction holds {scan.unevenness:.1f} times as many points as the mean one, and the nearest "
        f"points are {scan.nearest_m:.0f} m away: the sensor is not at the origin, as in the frame of a map; "
        "subtract the sensor's position from the points."
    )


def _upside_down(scan: Measures, profile: FitnessProfile) -> Finding | None:
    if scan.ground_m is None or profile.ground_m is None or scan.ground_m <= 0.5 or profile.ground_m[1] >= 0.0:
        return None
    return _gross(
        f"The ground lies {scan.ground_m:.1f} m above the sensor: it is mounted upside down, or z points "
        f"down: {_TURN_OVER}"
    )


_TURN_OVER = (
    "pass the mounting of a sensor that hangs, Mounting(roll_deg=180) or --roll 180, or turn the points by 180 degrees "
    "about x (negate y and z)."
)
_ASYMMETRIC_DEG = 8.0  # of beams that tell up from down


def _off_beams(scan: Measures, sensor: SensorProfile) -> tuple[float, float]:
    """How far the highest and lowest points are from the beams of a sensor the right way up, and upside down [deg]."""
    up, down = sensor.fov_up_deg, sensor.fov_down_deg
    highest, lowest = scan.elevation_p99_deg, scan.elevation_p01_deg
    return abs(highest - up) + abs(lowest - down), abs(highest + down) + abs(lowest + up)


def check_beams(points: Points, sensor: SensorProfile) -> tuple[Finding, ...]:
    """Describe a scan with its ground above, whose elevations are those of the sensor's beams with the opposite sign.

    points : (n, 4) float32; returns in the frame of the scan, before a mounting moves them.
    """
    up, down = sensor.fov_up_deg, sensor.fov_down_deg
    scan = measure(points, (180.0, -180.0)) if abs(up + down) > _ASYMMETRIC_DEG else None
    # Elevations about an origin on the road, as in the frame of a vehicle, are as high; its ground is not above it.
    if scan is None or scan.ground_m is None or scan.ground_m <= 0.5:
        return ()
    highest, lowest = scan.elevation_p99_deg, scan.elevation_p01_deg
    as_is, turned = _off_beams(scan, sensor)
    if as_is <= _ASYMMETRIC_DEG or turned >= 0.5 * as_is:
        return ()
    return _alone(
        f"The points lie between {lowest:.0f} and {highest:.0f} deg of elevation, and the beams of the "
        f"{sensor.name} between {down:.0f} and {up:.0f}: it is mounted upside down, or z points down: {_TURN_OVER}"
    )


# 154 real scans show at least 1.2 times as much ground below as a plane above, 240 simulated ones 3 times, drawn
# underpasses 0.8 times. In halls and garages, the ceiling may show more than the floor: that has 834 cells in drawn
# depots. Of 290 real and simulated scans that are upside down, what is taken for the ground has at most 362.
_ABOVE, _FEWEST_ABOVE, _FLOOR = 1.5, 120, 400  # times the cells below, and cells of half a meter
# An origin near the road sees it above and below as the same plane: then most points are on its wrong side. Right side
# up, the plane above has at most 0.13 times as many cells where many points are below; upside down, 1.36 times.
_SAME, _HANGING = 1.15, 0.5


def check_ground(
    points: Points,
    support_of: Callable[[Points], float],
    below_of: Callable[[Points], float],
    sensor: SensorProfile | None = None,
) -> tuple[Finding, ...]:
    """Describe a scan that shows a plane above, as it should show the ground below, and little of a plane below.

    points : returns in the frame of the scan, before a mounting moves them.
    sensor : if its beams look up more than down, and so do the points, it is the right way up: it sees a roof above and
        little ground.
    """
    above, below = support_of(points * np.array([1.0, -1.0, -1.0, 1.0], np.float32)), support_of(points)
    if above < _FEWEST_ABOVE or above <= _SAME * below:
        return ()
    is_over_all = below_of(points) >= _HANGING  # what is taken for the ground
    if (above <= _ABOVE * below or below >= _FLOOR) and not is_over_all:
        return ()
    is_no_floor = is_over_all and below >= _FEWEST_ABOVE  # seen well, so that it is no hall's, nor hidden by a roof
    scan = measure(points, (180.0, -180.0))
    if scan is None or (not is_no_floor and (scan.far_m < _HALL_M or scan.most_m < _MOST_OF_HALL_M)):
        return ()
    if sensor is not None and not is_no_floor:
        as_is, turned = _off_beams(scan, sensor)
        if sensor.fov_up_deg + sensor.fov_down_deg > _ASYMMETRIC_DEG and turned - as_is > _ASYMMETRIC_DEG:
            return ()
    return _alone(
        "The ground seems to lie above the sensor, and there is none below: it is mounted upside down, or z points "
        f"down: {_TURN_OVER}"
    )


def check_hanging(
    points: Points, support_of: Callable[[Points], float], below_of: Callable[[Points], float], known: Mounting
) -> tuple[Finding, ...]:
    """Describe a scan that is upside down because of the given roll, of a sensor that hangs.

    points, support_of, below_of : as in `check_ground`.
    """
    if not known.hangs:
        return ()
    turned = points.copy()
    turned[:, :3] = points[:, :3] @ known.rotation().T.astype(np.float32)
    if not check_ground(turned, support_of, below_of):
        return ()
    return _alone(
        f"With the given roll of {known.roll_deg:g} deg, the ground lies above the sensor, and none below: it "
        "does not hang upside down, or the points are turned already: leave out the roll (--roll, --extrinsic)."
    )


def about_lying(mounting: Mounting) -> Finding | None:
    """What to say of a sensor that lies on its side, as a camera's axes do: its boxes cannot stand upright."""
    tilt_deg = math.degrees(math.acos(min(1.0, abs(mounting.rotation()[2, 2]))))
    if tilt_deg <= _LYING_DEG:
        return None
    return Finding(
        f"The mounting tilts the axes of the scan by {tilt_deg:.0f} deg, and boxes have no tilt: in the frame of the "
        "scan they lie askew, as do tracks. Points, cells and grids do not. For upright boxes, turn the points first "
        "(z, -x, -y of a camera's axes), and give the mounting of the turned ones."
    )


def about_given_tilt(given: Mounting, shown: Mounting | None) -> Finding | None:
    """What to say if the ground shows another tilt than was given, as where a sign is wrong."""
    if shown is None:
        return None
    return Finding(
        f"The ground shows a roll of {shown.roll_deg:.1f} and a pitch of {shown.pitch_deg:.1f} deg, and the mounting "
        f"has {given.roll_deg:.1f} and {given.pitch_deg:.1f}: roll is positive if the left side is up, pitch if x "
        "points down. Correct them (mounting=, --roll, --pitch, --extrinsic), or leave them out to have them found. "
        "If the vehicle stands before a ramp, ignore this."
    )


def _other_height(scan: Measures, profile: FitnessProfile) -> Finding | None:
    if scan.ground_m is None or profile.ground_m is None:
        return None
    low, high = profile.ground_m
    if low - 0.6 <= scan.ground_m <= high + 0.6:
        return None
    return Finding(
        f"The ground lies at z = {scan.ground_m:.1f} m, in training it lay at {low:.1f} to {high:.1f} m: "
        "the sensor is mounted at another height than was given, or was found from the ground: pass its height above "
        "the road (--mount-height).",
        not low - _GROUND_OFF_M <= scan.ground_m <= high + _GROUND_OFF_M,
    )


def _other_field_of_view(scan: Measures, profile: FitnessProfile, sensor: SensorProfile) -> Finding | None:
    low, high = profile.elevation_p01_deg[1], profile.elevation_p99_deg[1]
    # The lowest beams are missing from a crop to a camera's view (9 deg) and from a scan cut short (up to 13).
    unlike = scan.elevation_p01_deg > low + 13.0 or scan.elevation_p99_deg > high + 8.0
    if not (unlike and scan.elevation_p01_deg < scan.elevation_p99_deg):  # both are 0 if no point is far
        return None
    return Finding(
        f"The points lie between {scan.elevation_p01_deg:.0f} and {scan.elevation_p99_deg:.0f} deg of "
        f"elevation, in training between {low:.0f} and {high:.0f}: this is a sensor of another field of view, "
        "or the origin is not the sensor, or it is not level.",
        scan.elevation_p01_deg > 0.0 or scan.elevation_p99_deg > max(high, sensor.fov_up_deg) + _TOO_HIGH_DEG,
    )


def _cropped(scan: Measures, profile: FitnessProfile) -> Finding | None:
    if scan.view_covered >= 0.6 * profile.view_covered[0]:
        return None
    left, right = profile.azimuth_deg
    return Finding(
        f"Only {scan.view_covered:.0%} of the model's view ({left:.0f} to {right:.0f} deg of azimuth) holds "
        "points: the scan is cropped, or x does not point forward.",
        scan.view_covered < 0.25 * profile.view_covered[0],
    )


def _turned(scan: Measures, profile: FitnessProfile) -> Finding | None:
    if scan.road_ahead is None or profile.road_ahead is None:
        return None
    if scan.road_ahead >= min(-0.5, profile.road_ahead[0] - 0.3):
        return None
    return Finding(
        "There are more obstacles ahead and behind than to the sides, as if the road ran along y: if x does "
        "not point forward, pass its direction: Mounting(yaw_deg=-90), --turn -90, for x right, y forward. "
        "If the vehicle stands across the road, ignore this."
    )


_COVERED = (
    "There is a ceiling {:.1f} m above the road: this seems to be a garage, a hall or a tunnel; the models know roads."
)


def _walls(scan: Measures) -> Finding | None:
    walls, half_m = scan.walls, _HALF_BESIDE_CAR_M if scan.is_on_car else _HALF_OF_ROOM_M
    is_walled = walls.mostly_enclosed >= _ENCLOSED_HALL
    is_small = scan.far_m < _ROOM_M and walls.enclosed >= _ENCLOSED
    is_small = is_small and (scan.range_median_m < _HALF_OF_SMALL_M or is_walled)
    is_closed = walls.through_m < _THROUGH_M and walls.mostly_enclosed >= _ENCLOSED
    is_small |= is_closed and scan.most_m < _MOST_OF_ROOM_M and scan.range_median_m < half_m
    is_hall = scan.far_m < _HALL_M and walls.enclosed >= _ENCLOSED
    # Of a part of a turn, no two opposite directions have points.
    is_seen = walls.through_m > 0.0 or scan.most_m < _MOST_OF_HALL_M
    is_hall |= is_walled and is_seen and walls.through_m < _THROUGH_HALL_M
    if not (is_small or is_hall):
        return None if scan.ceiling_m is None else Finding(_COVERED.format(scan.ceiling_m))
    is_room = is_small and not scan.is_in_bay
    return Finding(
        f"Half of the points are nearer than {scan.range_median_m:.1f} m, nine tenths nearer than {scan.most_m:.0f} m, "
        f"and there are walls on all sides: this seems to be a {'room' if is_room else 'garage or a hall'}; the models "
        "know roads.",
        is_room,
    )


def _room(scan: Measures, profile: FitnessProfile) -> Finding | None:
    near, far = profile.range_median_m
    # The smallest median in 481 KITTI scans is 3.8 m, above half of `near`; in two captures of a room 1.3 and 2.1 m.
    if scan.ground_m is not None or scan.is_in_bay or scan.range_median_m >= near / 2.0:
        return None
    if scan.far_m >= _HALL_M and scan.range_median_m > _COVERED_M:  # a narrow alley
        return None
    return _gross(
        f"Half of the points are nearer than {scan.range_median_m:.1f} m, in training {near:.0f} to "
        f"{far:.0f} m, and no ground was found: this seems to be a room, or the sensor is covered; the models "
        "know roads."
    )


def _few_rows(scan: Measures, profile: FitnessProfile, sensor: SensorProfile, has_ground: bool) -> Finding | None:
    few_rows = scan.beams < 0.75 * profile.beams[0] and scan.beams_per_deg < 0.65 * profile.beams_per_deg[0]
    fewest = _FEWEST_FROM_ABOVE if scan.raised_m > _HIGH_M else _FEWEST_ROWS
    too_few_rows = scan.beams < min(fewest, sensor.n_beams)
    if not ((few_rows and has_ground) or too_few_rows):  # rows cannot be separated if the origin is wrong
        return None
    return Finding(
        f"The scan has about {scan.beams:.0f} rows of points (sensor {sensor.name}: {sensor.n_beams}), in "
        f"training it had at least {profile.beams[0]:.0f}: alone, it shows little of far and small objects; several "
        "scans together show more (--track --sweeps 10, SweepPerceiver).",
        too_few_rows and sensor.pattern is None,  # which has no rows
    )


def _other_number(scan: Measures, profile: FitnessProfile, sensor: SensorProfile) -> Finding | None:
    fewest, most = profile.points_in_view
    if scan.points_in_view < 0.2 * fewest:
        return _too_few(scan, profile, sensor)
    if scan.points_in_view <= 5.0 * most:
        return None
    return Finding(
        f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at most "
        f"{most:.0f}: pass one turn of the sensor at a time.",
        scan.points_in_view > 20.0 * most,
    )


_ALL_ZERO = "Remission is 0 for"
# Share of the variance of the elevation, the azimuth, the height and the logarithm of the distance that 128 steps of
# the remission explain: at most 0.37, 0.15, 0.17 and 0.5 in 120 real scans of nine sensors.
_EXPLAINED = {"number of the beam": 0.97, "time or azimuth": 0.95, "height": 0.98, "distance": 0.99}
_FEWEST_PLACED = 300


def _place_as_remission(points: Points) -> Finding | None:
    """What the remission, as recorded, is, if it follows from where the points are."""
    sample = points[:: len(points) // (4 * _SAMPLE) + 1].astype(np.float64)
    x, y, z, remission = sample[np.isfinite(sample).all(axis=1) & (np.hypot(sample[:, 0], sample[:, 1]) > 3.0)].T
    if len(x) < _FEWEST_PLACED:
        return None
    edges = np.unique(np.quantile(remission, np.linspace(0.0, 1.0, 129)))
    step = np.searchsorted(edges, remission, side="right")
    n, flat = np.maximum(np.bincount(step), 1), np.hypot(x, y)
    places = (np.arctan2(z, flat), (x + 1j * y) / flat, z, np.log(flat))
    for (what, least), place in zip(_EXPLAINED.items(), places, strict=True):
        mean = (np.bincount(step, place.real) + 1j * np.bincount(step, place.imag)) / n
        if np.mean(np.abs(place - mean[step]) ** 2) < (1.0 - least) * np.mean(np.abs(place - place.mean()) ** 2):
            # Simulators such as CARLA have no other: exp(-a distance).
            is_simulated = what == "distance" and np.corrcoef(place, remission)[0, 1] < 0.0
            return Finding(
                f"The remission of each point follows from the {what}: the field holds "
                f"{'nothing else, as in some simulators' if is_simulated else 'something else'}. Say which one "
                "is the remission: remission_field= or columns= (--remission-field, --columns).",
                not is_simulated,
            )
    return None


def with_raw_remission(findings: Iterable[Finding], points: Points, sensor: SensorProfile) -> tuple[Finding, ...]:
    """The findings, but of a remission that is there in another unit, that, in place of one that is missing, and of
    one that is none, that alone.

    The function of a profile, such as a logarithm, maps all values of 0..1 to 0 where 0..255 is expected.

    points : (n, 4) float32; as recorded.
    """
    found = tuple(findings)
    is_mistaken = any(finding.gross and "emission" not in finding for finding in found)
    placed = None if is_mistaken else _place_as_remission(points)
    if placed is not None:
        return placed, *(finding for finding in found if "emission" not in finding)
    if not any(finding.startswith(_ALL_ZERO) for finding in found):
        return found
    known = points[np.isfinite(points[:, 3]), 3].astype(np.float64)  # float32 may overflow in a difference
    low, high = sensor.remission_range
    brightest = float(np.percentile(known, 99)) if len(known) else high
    if not (known > 0.0).any() or np.ptp(known) == 0.0 or brightest - low > 0.2 * (high - low):
        return found
    likely, own = _likely_range(float(known.min()), float(known.max())), f"({low:g}, {high:g})"
    there = _gross(
        f"Remission hardly exceeds {brightest:.2g}, but the profile {sensor.name} has {low:g} to {high:g}: pass "
        f"sensor= a profile with the remission_range of this data{'' if likely == own else f', {likely}'}."
    )
    return tuple(there if finding.startswith(_ALL_ZERO) else finding for finding in found)


def _likely_range(low: float, high: float) -> str:
    return next((f"(0, {top})" for top in (1, 255, 65535) if low >= 0.0 and high <= top), f"({low:g}, {high:g})")


def _other_remission(scan: Measures, profile: FitnessProfile, sensor: SensorProfile) -> Finding | None:
    # Without remission, 36 % of the car points and 74 % of the road cells remain (intersection over union with the
    # results with remission, 20 KITTI scans, default models); with a constant one, 15 % and 32 %.
    low, high = sensor.remission_range
    raw_low, raw_high, raw_p99 = (
        value * (high - low) + low for value in (scan.remission_low, scan.remission_high, scan.remission_p99)
    )
    stated = f"the profile {sensor.name} has {low:g} to {high:g}"
    useless = max(0.9, profile.remission_zeros[1] + 0.05)
    if scan.remission_beyond > 0.01 or scan.remission_low < -0.05:
        return _gross(
            f"Remission runs from {raw_low:g} to {raw_high:g}, but {stated}: pass sensor= a profile whose "
            f"remission_range is {_likely_range(raw_low, raw_high)}."
        )
    if scan.remission_zeros > useless:
        return _gross(
            f"{_ALL_ZERO} {scan.remission_zeros:.0%} of the points: the field is missing or was not read; "
            "the model needs it."
        )
    # Data in 0..1 has 0.004 of a full scale of 255, which is one bin too.
    in_one_bin = scan.remission_p99 < 0.02 and scan.remission_low < scan.remission_high
    if scan.remission_alike > useless and not in_one_bin:
        return _gross(
            f"Remission is the same for {scan.remission_alike:.0%} of the points ({raw_high:g}): the field holds "
            "something else; the model needs it."
        )
    if scan.remission_p99 < 0.2 * profile.remission_p99[0]:
        return Finding(
            f"Remission hardly exceeds {raw_p99:.2g}, but {stated}: pass sensor= a profile with the "
            "remission_range of this data, (0, 1) if it is scaled already.",
            scan.remission_p99 < 0.02,
        )
    darkest, brightest = profile.remission_median
    if not darkest / 4.0 <= scan.remission_median <= brightest * 2.5:
        return Finding(
            f"The median remission is {scan.remission_median:.2f} of full scale, in training it was {darkest:.2f} "
            f"to {brightest:.2f}: sensors differ in remission; fit a profile with edgeperc fit-sensor."
        )
    return None
