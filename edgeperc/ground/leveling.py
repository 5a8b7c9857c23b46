"""Find how a sensor is mounted from the ground in its scans."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from ..errors import MountingError
from ..types.frame import ModelFrame
from ..types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from ..types.points import Floats, Ints, Mask, Points, read_only
from .planes import CELL_M, N_CELLS, TOLERANCE_M, fill_lowest, fit_first_plane

__all__ = ["FROZEN_AFTER", "MountingEstimate", "MountingEstimator"]

# What differs from the training vehicle by less, or by less than two standard deviations, is taken for the street's own
# slope and camber: scans stay as they are. An error of 0.2 m, 2 deg of roll or 0.75 deg of pitch costs about one, one
# and three points of IoU of cars.
SAME_HEIGHT_M, SAME_ROLL_DEG, SAME_PITCH_DEG = 0.15, 2.5, 0.75
# A larger tilt is doubted if it is less than two standard deviations, and the quarters of the ground differ by more
# than those of streets: 95 % of 481 KITTI scans have standard errors of roll below 1.8 and of pitch below 0.6 deg.
DOUBTED_DEG, EVEN_ROLL_DEG, EVEN_PITCH_DEG = 2.0, 2.0, 0.75
# A given tilt is wrong if the ground shows another. Of 161 KITTI scans and 208 simulated ones, the ground of none that
# shows enough of it is off by more than 3.3 deg.
OTHER_TILT_DEG = 5.0
OTHER_HEIGHT_M = 0.5  # a height that differs by more is another one, however uncertain it is


@dataclass(frozen=True)
class MountingEstimate:
    """A mounting as scans show it."""

    mounting: Mounting  # a known one: what was given, and the medians over the scans of the rest
    # Standard deviation of each value; 0 for one that was given. It includes what streets differ in slope and camber,
    # and what the parts of the ground in a scan differ by, which more scans of one street do not reduce.
    height_sd_m: float
    roll_sd_deg: float
    pitch_sd_deg: float
    yaw_sd_deg: float
    n_scans: int  # that showed enough ground

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON."""
        return {**asdict(self), "mounting": self.mounting.to_dict()}

    def __str__(self) -> str:
        m = self.mounting
        # x ahead is the default, so nobody need have said it.
        kept = {"yaw": " (not estimated)" if m.yaw_deg == 0.0 else " (given)"}
        parts = [
            f"{name} {value:.{digits}f}{unit}" + (f" +- {sd:.{digits}f}" if sd else kept.get(name, " (given)"))
            for name, value, sd, unit, digits in (
                ("height", m.height_m, self.height_sd_m, " m", 2),
                ("roll", m.roll_deg, self.roll_sd_deg, " deg", 1),
                ("pitch", m.pitch_deg, self.pitch_sd_deg, " deg", 1),
                ("yaw", m.yaw_deg, self.yaw_sd_deg, " deg", 1),
            )
        ]
        return ", ".join(parts)


# Standard deviation of what single scans of one mounting show, by their support (cells on the plane less those below
# it): streets differ in slope and camber, and a plane with few cells may be a pavement or a bank. 151 KITTI scans of 26
# drives.
_SUPPORT = (150.0, 275.0, 700.0)
_HEIGHT_SD_M = (0.10, 0.06, 0.03)
_ROLL_SD_DEG = (2.5, 1.2, 1.0)
_PITCH_SD_DEG = (1.0, 0.35, 0.3)

# Heights of the origin above the road to start from [m]; the ground is found within 0.5 m of each.
_STARTS_M = (1.7, 0.9, 2.5, 0.1, 3.3, 4.1, -0.7)
_VOTING_M = 12.0  # farther out, the land beside a road is often lower
# A sensor on a truck, a pole or a crane may see no ground so near: the least reach counts in which its plane is seen.
_FAR_STARTS_M = (1.7, 2.5, 3.3, 4.1, 4.9, 5.7, 6.5, 7.3, 8.1, 8.9)
HIGH_M = 2.8  # a lower sensor would see ground within 12 m: something hides it
_FAR_REACHES_M = (24.0, 28.0, 32.0, 40.0, 48.0, 60.0)
_FEW_BELOW = 0.25  # cells below such a plane, as a share of the cells on it; if there is none, `_MAX_BELOW`
_LEVEL_DEG = 3.0  # embankments and rows of roofs are steeper
# What lies high within 12 m, such as roofs of cars, is not the ground if a lower plane has so many times its support,
# and most lies below it. Such roofs had a support of at most 106 in 400 simulated scans; streets have more.
_OUTVOTED, _SURE_SUPPORT = 3.0, 150
# A bank beside a road that is out of view is not the ground below the sensor: it is steep, and on one side of what the
# scan shows. Levers are at most 3 in all but 2 of 481 KITTI scans, and if half of the turn is hidden; banks that were
# taken for the ground have 4 to 14.
_BANK_DEG, _ONE_SIDED, _SECTORS, _MOST_SECTORS = 4.0, 3.0, 16, 0.75
_LOWEST_BEAM = 99.5  # percentile of the slopes at which returns are below the sensor
_BESIDE_M = 3.0  # nearer returns may be of the own body
_MIN_CELLS = 60  # of half a meter, on the plane
_MAX_BELOW = 0.8  # cells below the plane, as a share of the cells on it
_CORRIDOR_M = (3.0, 15.0)  # half its width, and its length ahead and behind: the road that the vehicle stands on
_BAND_M, _TRIM_M, _CLEAR_M = 0.2, 0.1, 0.3

_STREET_M = (0.3, 3.0, 40.0)  # lowest and highest point above the road, and the farthest, that show the street's axis
_STREET_BIN_M = 0.25
_MIN_CONTRAST = 1.15  # of the best axis to the best one that differs by more than 20 deg
_STREET_YAW_SD = 5.0

FROZEN_AFTER = 5  # scans


class MountingEstimator:
    """Finds what is not known of a mounting from the ground in scans.

    Parameters
    ----------
    known : Mounting
        Values that are given are kept.

    Notes
    -----
    RANSAC finds the plane of the ground in the lowest returns of half-meter cells within 12 m, from several heights.
    The plane with most support counts: the cells on it less those below it. It is refined by least squares in the
    corridor that the vehicle stands on, 6 m wide and 30 m long. Its height below the origin and its slopes give height,
    roll and pitch. The estimate is the median over the scans whose plane has at least half of the best one's support.
    The yaw, if it is to be estimated, is the axis along which returns 0.3 to 3 m above the road line up best.
    """

    def __init__(self, known: Mounting) -> None:
        self.known = known
        # By each scan: height, roll, pitch, yaw, support, and the uncertainty of the plane in height, roll and pitch.
        self._found: tuple[tuple[float, ...], ...] = ()

    @property
    def n_scans(self) -> int:
        """Scans that were used."""
        return len(self._found)

    @property
    def is_complete(self) -> bool:
        """Whether more scans change nothing: all is known, or five scans were used."""
        return self.known.is_known or len(self._found) >= FROZEN_AFTER

    def add(self, points: Points) -> MountingEstimator:
        """An estimator that has used one more scan; this one does not change.

        Parameters
        ----------
        points : (n, 4) float32
            Points that are not finite are skipped.

        Raises
        ------
        MountingError
            The scan does not show the ground, or not the street's axis if that is to be estimated.
        """
        if self.is_complete:
            return self
        scan = points
        if self.known.origin_m != (0.0, 0.0):
            scan = points - np.array([*self.known.origin_m, 0.0, 0.0], np.float32)
        # From a given tilt on: the ground of a sensor that hangs upside down is above it in the scan.
        found = replace(_usual(self.known, self.known.yaw_deg), height_m=MODEL_HEIGHT_M)
        found = replace(found, yaw_deg=self.known.yaw_deg or 0.0, origin_m=(0.0, 0.0))
        found, support, uncertainty = _leveled(scan, found, self.known.height_m)
        yaw_deg = _street_axis(ModelFrame(found).move(scan)) if self.known.yaw_deg is None else self.known.yaw_deg
        more = MountingEstimator(self.known)
        values = _values(replace(found, yaw_deg=yaw_deg))
        more._found = (*self._found, (*values.tolist(), support, *uncertainty.tolist()))
        return more

    def contradicted_by(self, points: Points) -> Mounting | None:
        """The mounting by the ground in a scan, if the given roll or pitch is another; None if not, or unsure."""
        given = _values(self.known)[1:3]
        start = replace(_usual(self.known, self.known.yaw_deg), yaw_deg=self.known.yaw_deg or 0.0)
        level = replace(start, roll_deg=180.0 * round((start.roll_deg or 0.0) / 180.0), pitch_deg=0.0)
        for guess in (start, level):  # the ground is found from up to 16 degrees off
            try:
                found, support, _ = _leveled(points, guess, None)
            except MountingError:
                continue
            off = np.abs((_values(found)[1:3] - given + 180.0) % 360.0 - 180.0)
            return found if support >= _SURE_SUPPORT and (off > OTHER_TILT_DEG).any() else None
        return None

    def estimate(self) -> MountingEstimate:
        """The mounting by the scans so far.

        Raises
        ------
        MountingError
            Something is to be estimated, and no scan showed it.
        """
        known = self.known
        if known.is_known:
            return MountingEstimate(known, 0.0, 0.0, 0.0, 0.0, 0)
        middle, sd = self._of_scans()
        of_scan = np.sqrt(sd**2 @ _to_vehicle(middle.yaw_deg) ** 2)
        height, roll, pitch, yaw = np.where(np.isnan(_values(known)), of_scan, 0.0).tolist()
        return MountingEstimate(middle, height, roll, pitch, yaw, len(self._found))

    def _of_scans(self) -> tuple[Mounting, Floats]:
        """The medians over the scans of what is not known, and standard deviations (4,), those of the tilt about the
        vehicle's axes.
        """
        if not self._found:
            raise MountingError("no scan shows the ground around the vehicle")
        scans = np.array(self._found)
        support = scans[:, 4].max()
        scans = scans[scans[:, 4] >= 0.5 * support]
        found, uncertainty = scans[:, :4], np.median(scans[:, 5:], axis=0)
        middle = _filled(self.known, np.median(found, axis=0))
        turned = found @ _to_vehicle(middle.yaw_deg).T
        spread = turned.std(axis=0, ddof=1) if len(found) > 1 else np.zeros(4)
        of_one = [np.interp(support, _SUPPORT, sd) for sd in (_HEIGHT_SD_M, _ROLL_SD_DEG, _PITCH_SD_DEG)]
        of_plane = np.hypot(of_one, uncertainty)
        return middle, np.hypot([*of_plane, _STREET_YAW_SD], spread / math.sqrt(len(found)))

    def mounting(self) -> Mounting:
        """The mounting to use: the estimate, or the training vehicle's where that differs by no more than streets do.

        It is the training vehicle's as well if no scan showed the ground. Given values are kept. A roll or pitch that
        differs by more, but by less than two standard deviations, is not used (`doubtful`).
        """
        if self.known.is_known or not self._found:
            return _usual(self.known, self.known.yaw_deg)
        found = self.estimate().mounting
        usual = _usual(self.known, found.yaw_deg)
        off, same, sure = self._compared()
        if (np.abs(off) <= np.maximum(same, sure)).all():
            return usual
        if not (doubted := self._doubted()).any():
            return found
        off[1:3][doubted] = 0.0
        roll_deg, pitch_deg = (_values(usual) + off @ _to_vehicle(found.yaw_deg))[1:3].tolist()
        return _filled(self.known, _values(replace(found, roll_deg=roll_deg, pitch_deg=pitch_deg)))

    def doubtful(self) -> tuple[str, ...]:
        """Which of ``roll_deg`` and ``pitch_deg`` the scans suggest, but do not show surely: they are not used."""
        if self.known.is_known or not self._found:
            return ()
        turn = np.abs(_to_vehicle(self.estimate().mounting.yaw_deg)[1:3, 1:3])
        is_part = (self._doubted() @ turn > 1e-9) & np.isnan(_values(self.known)[1:3])
        return tuple(name for name, is_so in zip(("roll_deg", "pitch_deg"), is_part.tolist(), strict=True) if is_so)

    def _doubted(self) -> Mask:
        """Of roll and pitch about the vehicle's axes, (2,), which the scans suggest, but do not show surely."""
        off, same, sure = self._compared()
        doubtful = ((np.abs(off) > same) & (np.abs(off) <= sure))[1:3]
        _, roll_deg, pitch_deg = np.median(np.array(self._found)[:, 5:], axis=0)
        is_uneven = roll_deg > EVEN_ROLL_DEG or pitch_deg > EVEN_PITCH_DEG
        return doubtful & (is_uneven and (doubtful & (np.abs(off[1:3]) > DOUBTED_DEG)).any())

    def is_height_unsure(self) -> bool:
        """Whether the scans suggest another height than the usual one, and show little ground, or only far away."""
        if self.known.height_m is not None or not self._found:
            return False
        height_m, scans = self.estimate().mounting.height_m or 0.0, np.array(self._found)
        is_far = height_m > HIGH_M or float(np.median(scans[:, 5])) > 0.0
        return abs(height_m - MODEL_HEIGHT_M) > SAME_HEIGHT_M and (is_far or scans[:, 4].max() < _SURE_SUPPORT)

    def _compared(self) -> tuple[Floats, Floats, Floats]:
        """How far height, roll, pitch and yaw are from the usual ones, and by how much they may be: as streets differ,
        and twice the standard deviation. The tilt is about the vehicle's axes.
        """
        found, sd = self._of_scans()
        off = _to_vehicle(found.yaw_deg) @ (_values(found) - _values(_usual(self.known, found.yaw_deg)))
        sure = 2.0 * np.array([min(sd[0], 0.5 * OTHER_HEIGHT_M), *sd[1:3], 0.0])
        return off, np.array([SAME_HEIGHT_M, SAME_ROLL_DEG, SAME_PITCH_DEG, 0.0]), sure


def _values(mounting: Mounting) -> Floats:
    """Height, roll, pitch and yaw, (4,); NaN where they are None."""
    values = (mounting.height_m, mounting.roll_deg, mounting.pitch_deg, mounting.yaw_deg)
    return np.array([math.nan if value is None else value for value in values])


def _filled(mounting: Mounting, values: Floats) -> Mounting:
    """The mounting with ``values`` (4,) where its own are None."""
    own = _values(mounting)
    height_m, roll_deg, pitch_deg, yaw_deg = np.where(np.isnan(own), values, own).tolist()
    return Mounting(height_m, roll_deg, pitch_deg, yaw_deg, mounting.origin_m)


def _usual(known: Mounting, yaw_deg: float | None) -> Mounting:
    """The mounting with the training vehicle's values where its own are None. That vehicle's looks down ahead: a scan
    whose x axis points elsewhere has other parts of this tilt in its roll and pitch.
    """
    yaw = math.radians(yaw_deg or 0.0)
    height_m, _, pitch_deg, _ = _values(MODEL_MOUNTING).tolist()
    return _filled(known, np.array([height_m, math.sin(yaw) * pitch_deg + 0.0, math.cos(yaw) * pitch_deg, 0.0]))


def _to_vehicle(yaw_deg: float | None) -> Floats:
    """What turns small differences of height, roll, pitch and yaw (4,) of a scan with this yaw to those of the tilt
    about the vehicle's axes.
    """
    cos, sin = math.cos(math.radians(yaw_deg or 0.0)), math.sin(math.radians(yaw_deg or 0.0))
    turn = np.eye(4)
    turn[1:3, 1:3] = [[cos, -sin], [sin, cos]]
    return turn


def _leveled(scan: Points, guess: Mounting, height_m: float | None) -> tuple[Mounting, float, Floats]:
    """The mounting by the ground in a scan, from a first guess and a height; its support; its `_uncertainty`."""
    frame = ModelFrame(guess)
    (a, b, c), support, uncertainty = _ground_plane(read_only(frame.move(scan)), height_m)
    norm = math.sqrt(1.0 + a * a + b * b)
    rest = Mounting(-c / norm, math.degrees(math.atan(-b)), math.degrees(math.asin(a / norm)), 0.0)
    T_vehicle_sensor = np.eye(4)
    T_vehicle_sensor[:3, :3] = rest.rotation() @ frame.R
    T_vehicle_sensor[:3, 3] = rest.rotation() @ frame.t + [0.0, 0.0, -c / norm]
    return replace(Mounting.from_matrix(T_vehicle_sensor), yaw_deg=guess.yaw_deg), support, uncertainty


def near_support(points: Points) -> int:
    """How many more cells of half a meter within 12 m lie on the ground than below it; 0 without ground."""
    near = _ground_near(points)
    return 0 if near is None else near.support


def share_below(points: Points) -> float:
    """Of the points within 12 m that are clear of the ground, the share that lies below it; 1 without ground."""
    near = _ground_near(points)
    if near is None:
        return 1.0
    x, y, z = points[:, :3].astype(np.float64).T
    with np.errstate(invalid="ignore", over="ignore"):
        above_m = np.where(np.hypot(x, y) < _VOTING_M, z - x * near.abc[0] - y * near.abc[1] - near.abc[2], 0.0)
        below, above = np.count_nonzero(above_m < -_CLEAR_M), np.count_nonzero(above_m > _CLEAR_M)
    return below / max(1, below + above)


class _Plane(NamedTuple):
    """A plane z = a x + b y + c [m]: ``abc``, and how many cells of half a meter within a reach lie on and below it."""

    abc: Floats
    reach_m: float
    on: int
    below: int

    @property
    def support(self) -> int:
        return self.on - self.below

    @property
    def level_support(self) -> float:
        """The support, less for a plane that is steeper than streets."""
        tilt_deg = math.degrees(math.hypot(self.abc[0], self.abc[1]))
        return self.support / (1.0 + (tilt_deg / _LEVEL_DEG) ** 2)

    def is_bank(self, low: Floats) -> bool:
        """Whether it is steep, and on one side of the lowest returns (n, 3)."""
        if self.on < _MIN_CELLS or math.degrees(math.hypot(self.abc[0], self.abc[1])) < _BANK_DEG:
            return False
        if self.lever(low) <= _ONE_SIDED:
            return False
        far = low[np.hypot(low[:, 0], low[:, 1]) > _BESIDE_M]
        return _n_sectors(self.those_on(far)) < _MOST_SECTORS * _n_sectors(far)

    def lever(self, low: Floats) -> float:
        """By how much an error of the lowest returns (n, 3) on it grows towards the sensor: 1 if they surround it."""
        on = self.those_on(low)[:, :2]
        middle, spread = on.mean(axis=0), np.cov(on.T) + CELL_M**2 / 12.0 * np.eye(2)
        return float(math.sqrt(1.0 + middle @ np.linalg.solve(spread, middle)))

    def is_in_view(self, scan: Points) -> bool:
        """Whether the lowest beams of a scan look at it within 12 m: if it is not seen there, something hides it."""
        x, y, z = scan[:, :3].astype(np.float64).T
        range_m = np.hypot(x, y)
        with np.errstate(invalid="ignore", over="ignore"):
            is_far = (range_m > _BESIDE_M) & (np.abs(z) < range_m)
            down = (x * self.abc[0] + y * self.abc[1] - z)[is_far] / range_m[is_far]
        return bool(len(down)) and float(np.percentile(down, _LOWEST_BEAM)) * _VOTING_M > -self.abc[2]

    def those_on(self, low: Floats) -> Floats:
        """Those of the lowest returns (n, 3) that are on it."""
        above = low[:, 2] - low[:, :2] @ self.abc[:2] - self.abc[2]
        return low[(np.hypot(low[:, 0], low[:, 1]) < self.reach_m) & (np.abs(above) <= TOLERANCE_M)]

    def is_lowest(self, share: float = _MAX_BELOW) -> bool:
        """Whether little lies below it, as below the ground."""
        return self.below <= share * self.on


def _n_sectors(xyz: Floats) -> int:
    """How many of 16 sectors of the turn hold a point (n, 3)."""
    return len(np.unique(np.floor(np.arctan2(xyz[:, 1], xyz[:, 0]) * (_SECTORS / (2.0 * math.pi))) % _SECTORS))


def _ground_plane(scan: Points, height_m: float | None) -> tuple[tuple[float, float, float], float, Floats]:
    """a, b, c of the ground z = a x + b y + c [m] around the sensor, near a given height below it or at any; how many
    more cells lie on it than below; the `_uncertainty`.
    """
    cell, lowest, low = _lowest_returns(scan)
    plane = None if height_m is None else _lowest_plane(scan, lowest, low, [height_m], [height_m], high_m=-math.inf)
    plane = plane or _lowest_plane(scan, lowest, low, _STARTS_M, _FAR_STARTS_M)
    if plane is None:
        raise MountingError(
            f"the scan shows no ground: fewer than {_MIN_CELLS} cells of half a meter lie on one plane within "
            f"{_VOTING_M:.0f} m, or farther away below a high sensor"
        )
    if plane.reach_m == _VOTING_M:
        plane = plane._replace(abc=_refined(scan, cell, plane.abc))
    a, b, c = plane.abc.tolist()
    return (a, b, c), float(plane.support), _uncertainty(scan, lowest, low, plane)


def _ground_near(points: Points) -> _Plane | None:
    scan = read_only(points)
    _, lowest, low = _lowest_returns(scan)
    return _near_plane(scan, lowest, low, _STARTS_M)


def _lowest_returns(scan: Points) -> tuple[Ints, Ints, Floats]:
    """The cell of each point, the row of the lowest point in each cell, and these points (n, 3)."""
    cell = np.empty(len(scan), np.int32)
    lowest = np.empty((N_CELLS, N_CELLS), np.int32)
    fill_lowest(scan, cell, lowest)
    return cell, lowest, scan[lowest[lowest >= 0], :3].astype(np.float64)


def _near_plane(scan: Points, lowest: Ints, low: Floats, starts_m: Sequence[float]) -> _Plane | None:
    """The ground within 12 m, from several heights above it."""
    planes = [plane for plane in _planes(scan, lowest, low, starts_m, _VOTING_M) if plane.is_lowest()]
    near = max(planes, key=lambda plane: plane.support, default=None)
    return None if near is None or near.on < _MIN_CELLS else near


def _lowest_plane(
    scan: Points,
    lowest: Ints,
    low: Floats,
    starts_m: Sequence[float],
    far_starts_m: Sequence[float],
    high_m: float = HIGH_M,
) -> _Plane | None:
    """The ground within 12 m or, below a sensor higher than ``high_m``, farther away; from several heights above it."""
    near = _near_plane(scan, lowest, low, starts_m)
    if near is not None and (near.support >= _SURE_SUPPORT or _counted(near.abc, low, _FAR_REACHES_M[-1]).is_lowest()):
        return near
    far = _far_plane(scan, lowest, low, far_starts_m)
    if far is not None and far.abc[2] > -high_m and far.is_in_view(scan):
        far = None
    if near is None or far is None:
        return near or far
    is_outvoted = far.support >= _OUTVOTED * near.support and not _counted(near.abc, low, far.reach_m).is_lowest()
    return far if is_outvoted else near


def _far_plane(scan: Points, lowest: Ints, low: Floats, starts_m: Sequence[float]) -> _Plane | None:
    """The ground in the least reach that shows it."""
    seen = []
    for reach_m in _FAR_REACHES_M:
        planes = [plane for plane in _planes(scan, lowest, low, starts_m, reach_m) if plane.support >= _MIN_CELLS]
        few_below = [plane for plane in planes if plane.is_lowest(_FEW_BELOW) and plane.level_support >= _MIN_CELLS]
        if few_below:
            return max(few_below, key=lambda plane: plane.level_support)
        seen += [plane for plane in planes if plane.is_lowest()]
    return max(seen, key=lambda plane: plane.level_support, default=None)


def _planes(scan: Points, lowest: Ints, low: Floats, starts_m: Sequence[float], reach_m: float) -> Iterator[_Plane]:
    """The plane near each of several heights below the origin, if there is one with support."""
    for start in starts_m:
        abc = np.array([0.0, 0.0, -start])
        if fit_first_plane(scan, lowest, reach_m, abc):
            plane = _counted(abc, low, reach_m)
            if plane.support > 0 and not plane.is_bank(low):
                yield plane


def _counted(abc: Floats, low: Floats, reach_m: float) -> _Plane:
    """The plane with the lowest returns (n, 3) that are on and below it."""
    within = low[np.hypot(low[:, 0], low[:, 1]) < reach_m]
    above = within[:, 2] - within[:, :2] @ abc[:2] - abc[2]
    return _Plane(abc, reach_m, int((np.abs(above) <= TOLERANCE_M).sum()), int((above < -TOLERANCE_M).sum()))


def _refined(scan: Points, cell: Ints, plane: Floats) -> Floats:
    """The plane by least squares in the corridor that the vehicle stands on."""
    across, along = _CORRIDOR_M
    # Half the time of taking the columns row by row.
    x, y, z = np.ascontiguousarray(scan[:, :3].T)
    rows = np.flatnonzero((np.abs(y) < across) & (np.abs(x) < along))
    x, y, z = x[rows], y[rows], z[rows]
    with np.errstate(invalid="ignore", over="ignore"):
        on_road = np.abs(z - x * plane[0] - y * plane[1] - plane[2]) < _BAND_M
    rows = rows[on_road & (np.hypot(x, y) < along)]
    rows = rows[np.unique(cell[rows], return_index=True)[1]]
    xyz = scan[rows, :3].astype(np.float64)
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    for _ in range(4):
        on_plane = np.abs(xyz[:, 2] - design @ plane) < _TRIM_M
        if np.count_nonzero(on_plane) < _MIN_CELLS // 2:
            break
        plane = np.linalg.lstsq(design[on_plane], xyz[on_plane, 2], rcond=None)[0]
    return plane


def _uncertainty(scan: Points, lowest: Ints, low: Floats, plane: _Plane) -> Floats:
    """Standard errors of height [m], roll and pitch [deg], (3,), by how the quarters of the ground differ in slope; of
    them, two are independent, as left and right show one pitch, ahead and behind one roll.
    """
    half = N_CELLS // 2
    slopes = []
    for row in (slice(None, half), slice(half, None)):
        for col in (slice(None, half), slice(half, None)):
            quarter, part = np.full_like(lowest, -1), plane.abc.copy()
            quarter[row, col] = lowest[row, col]
            if fit_first_plane(scan, quarter, plane.reach_m, part):
                slopes.append(np.degrees(part[:2] - plane.abc[:2]))
    pitch, roll = (
        np.sqrt(np.mean(np.square(slopes), axis=0) / 2.0) if len(slopes) > 1 else (_PITCH_SD_DEG[0], _ROLL_SD_DEG[0])
    )
    if plane.reach_m == _VOTING_M:
        return np.array([0.0, roll, pitch])
    nearest_m = float(np.percentile(np.hypot(*plane.those_on(low)[:, :2].T), 5.0))
    return np.array([nearest_m * math.tan(math.radians(math.hypot(pitch, roll))), roll, pitch])


def _street_axis(scan: Points) -> float:
    """Yaw [deg] of a scan whose z axis is upright: minus the direction of the street, in -90..90."""
    low, high, far = _STREET_M
    height = scan[:, 2] + np.float32(MODEL_HEIGHT_M)
    with np.errstate(invalid="ignore", over="ignore"):
        kept = (height > low) & (height < high) & (np.hypot(scan[:, 0], scan[:, 1]) < far)
    # One return in each column of _STREET_BIN_M, so that near objects do not outvote far ones.
    columns = np.unique(np.floor(scan[kept, :2] / np.float32(_STREET_BIN_M)).astype(np.int64), axis=0)
    if len(columns) < 200:
        raise MountingError("the scan shows too few objects beside the street to tell its direction; give the yaw")
    xy = (columns + 0.5) * _STREET_BIN_M
    angles = np.arange(-90, 90)
    scores = np.empty(len(angles))
    for k, angle in enumerate(np.radians(angles)):
        across = xy[:, 1] * math.cos(angle) - xy[:, 0] * math.sin(angle)
        counts = np.bincount(np.floor((across + far + 1.0) / _STREET_BIN_M).astype(np.int64))
        scores[k] = float((counts.astype(np.float64) ** 2).sum())
    best = int(scores.argmax())
    apart = np.abs((angles - angles[best] + 90) % 180 - 90)
    contrast = scores[best] / scores[apart > 20].max()
    if contrast < _MIN_CONTRAST:
        raise MountingError(f"no direction of the street stands out (contrast {contrast:.2f}); give the yaw")
    return float(-angles[best])
