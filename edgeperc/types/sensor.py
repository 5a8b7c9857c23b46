"""Sensor profiles: beams, columns, remission range and mounting."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ..errors import SensorError
from ..system.fields import Fields
from ..system.names import check_text, nearest
from .choices import AUTO_SENSOR
from .mounting import MODEL_HEIGHT_M, UNKNOWN_MOUNTING, Mounting

__all__ = [
    "PUBLIC_SENSORS",
    "REMISSION_KINDS",
    "SENSORS",
    "RemissionFunction",
    "ScanPattern",
    "SensorProfile",
    "get_sensor",
]

SCHEMA = 2  # of a sensor profile's file
# Of a profile that states none. Empty beams of real recordings lie up to 0.45 m from the sensor, and the built-in
# sensors measure from 0.05 to 1 m on.
MIN_RANGE_M = 0.5
SPARSE_GAP_DEG = 1.5
# Where `pointseg` looks, and the fewest beams there for which it knows more than `pointseg-sparse`: on KITTI's drives
# kept back, thinned to 18 (os1-32) and 9 beams (jt128), the network alone has an IoU of cars of 53.7 and 56.2 %, that
# for sparse beams 64.0 and 65.4; with 20 (os0-64) the answers are as good, and nuScenes' 21 show more people without.
VIEW_DEG, FEWEST_IN_VIEW = (-25.0, 3.0), 20
MAX_EGO_M = 100.0
MIN_ACCUMULATE_S, MAX_ACCUMULATE_S = 0.01, 10.0

EgoBox = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_ADVICE = "write it again with edgeperc fit-sensor or edgeperc info --write"
# Profiles of earlier versions have no box of the own vehicle, and no pattern.
FIELDS = Fields("the sensor profile", SensorError, _ADVICE, optional=("ego_box", "pattern"), exact=True)
REMISSION_KINDS = {"linear": 2, "polynomial": 3, "logarithm": 2, "power": 2}  # number of coefficients


@dataclass(frozen=True)
class RemissionFunction:
    """Maps the remission of one sensor to that of another (KUL-Seg 5).

    With ``x = full_scale * remission``, where remission is scaled to 0..1 by the profile's ``remission_range``, the
    other sensor's remission in 0..1 is a + b x (linear), a + b x + c x^2 (polynomial), a + b ln(1 + x) (logarithm) or
    a x^b (power), clipped to 0..1. `preprocess.sensor_fit` fits it, `preprocess.condition` applies it.

    Attributes
    ----------
    kind : str
        ``"linear"``, ``"polynomial"``, ``"logarithm"`` or ``"power"``.
    coefficients : tuple of float
        a, b and, for a polynomial, c.
    full_scale : float
        x of a remission of 1. In fitted functions it is the width of the sensor's raw remission range, at least 255.
    to : str
        The sensor whose remission is the result.
    rmse : float
        Root mean square error on held-back samples, as a share of the other sensor's full scale.
    source : str
        The data that it was fitted to.

    Raises
    ------
    SensorError
        The values do not describe such a function.
    """

    kind: str
    coefficients: tuple[float, ...]
    full_scale: float
    to: str
    rmse: float
    source: str

    def __post_init__(self) -> None:
        if not isinstance(self.kind, str) or self.kind not in REMISSION_KINDS:
            FIELDS.refuse("remission.kind", self.kind, f"one of {', '.join(REMISSION_KINDS)}")
        n = REMISSION_KINDS[self.kind]
        coefficients = FIELDS.numbers("remission.coefficients", self.coefficients, n, -1e9, 1e9)
        if self.kind == "power" and coefficients[1] <= 0.0:
            FIELDS.refuse("remission.coefficients", coefficients, "an exponent above 0")
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "full_scale", FIELDS.number("remission.full_scale", self.full_scale, 0.0, 1e9))
        if self.full_scale == 0.0:
            FIELDS.refuse("remission.full_scale", self.full_scale, "a number above 0")
        object.__setattr__(self, "rmse", FIELDS.number("remission.rmse", self.rmse, 0.0, 1e9))
        if not isinstance(self.to, str) or not self.to or not isinstance(self.source, str):
            FIELDS.refuse("remission.to and source", (self.to, self.source), "two texts")


# Pulses of a non-repeating sensor in a cell of its virtual beams and columns, on average; many of them meet the sky.
# With 1, the points of an object are linked less: AP50 of vehicles falls from 63 to 54 % on twelve streets (Mid-360 of
# 0.2 s).
_POINTS_OF_CELL = 4.0


@dataclass(frozen=True)
class ScanPattern:
    """How a sensor without beams scans: in new directions all the time, evenly over its field of view.

    Its scans are gathered over a time (`edgeperc.accumulate`), and perceived as those of a spinning sensor whose beams
    and columns are as far apart as the points then are on average (`SensorProfile.accumulated`).

    Attributes
    ----------
    points_per_s : float
        Points a second [1/s].
    width_deg : float
        Field of view from left to right, about x [deg]; from top to bottom it is that of the profile.
    accumulate_s : float
        Time over which a scan is gathered [s].
    turns_hz : tuple of 2 float
        Turns a second of the two prisms, or of the sensor and of the mirror in it. Only the simulator uses them.

    Raises
    ------
    SensorError
        A value is out of range.
    """

    points_per_s: float
    width_deg: float
    accumulate_s: float
    turns_hz: tuple[float, float]

    def __post_init__(self) -> None:
        for name, low, high in (
            ("points_per_s", 1.0, 1e9),
            ("width_deg", 1.0, 360.0),
            ("accumulate_s", MIN_ACCUMULATE_S, MAX_ACCUMULATE_S),
        ):
            object.__setattr__(self, name, FIELDS.number(f"pattern.{name}", getattr(self, name), low, high))
        object.__setattr__(self, "turns_hz", FIELDS.pair("pattern.turns_hz", self.turns_hz, -1e6, 1e6))


@dataclass(frozen=True)
class SensorProfile:
    """A spinning LiDAR, or one with a pattern that does not repeat.

    A built-in profile (`SENSORS`) describes a usual set-up of the sensor. Change single values with
    ``dataclasses.replace``, e.g.
    ``replace(get_sensor("os1-64"), remission_range=(0, 65535))`` for an Ouster whose 16-bit signal is used instead of
    its 8-bit reflectivity. Describe another sensor with ``SensorProfile(...)``, or with
    `SensorProfile.uniform` if its beams are evenly spaced.

    Attributes
    ----------
    name : str
    elevations_deg : tuple of float
        Elevation of each beam [deg], strictly decreasing from the top beam to the bottom one, up positive.
    columns : int
        Azimuth steps in one turn.
    remission_range : tuple of 2 float
        Raw remissions that are scaled to 0 and 1.
    mounting : Mounting
        How it is mounted on the vehicle. What is None is estimated from the scans.
    min_range_m, max_range_m : float
        Nearest and farthest return to expect [m]. Points at most ``min_range_m`` from the sensor are not returns, but
        beams without one: they are dropped. With 0, only those at the sensor's own place (0, 0, 0) are.
    remission : RemissionFunction or None
        Maps this sensor's remission to that of the sensor that the models were trained on. None: remission is only
        scaled by ``remission_range``.
    ego_box : tuple of 3 tuples of 2 float, or None
        The vehicle or robot that carries the sensor, as far as its beams meet it: lowest and highest x, y and z [m]
        about the sensor, along the axes of the scan. Points inside are dropped. None: no point is.
    pattern : ScanPattern or None
        Of a sensor without beams, whose ``elevations_deg`` and ``columns`` are then those of a spinning one that would
        show as much. None: it spins.

    Raises
    ------
    SensorError
        The values do not describe a possible sensor.
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    remission_range: tuple[float, float] = (0.0, 1.0)
    mounting: Mounting = UNKNOWN_MOUNTING
    min_range_m: float = MIN_RANGE_M
    max_range_m: float = 120.0
    remission: RemissionFunction | None = None
    ego_box: EgoBox | None = None
    pattern: ScanPattern | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SensorError(f"a sensor's name is a non-empty str, got {self.name!r}")
        check_text("a sensor's name is", self.name, SensorError)
        who = f"sensor {self.name!r}:"
        columns = FIELDS.number(f"{who} columns", self.columns, 1, 1_000_000)
        if not columns.is_integer():
            FIELDS.refuse(f"{who} columns", self.columns, "a whole number")
        object.__setattr__(self, "columns", int(columns))
        object.__setattr__(self, "elevations_deg", FIELDS.numbers(f"{who} elevations_deg", self.elevations_deg))
        bounds = FIELDS.pair(f"{who} remission_range", self.remission_range, -1e9, 1e9)
        object.__setattr__(self, "remission_range", bounds)
        for name in ("min_range_m", "max_range_m"):
            object.__setattr__(self, name, FIELDS.number(f"{who} {name}", getattr(self, name), 0.0))
        if not 1 <= len(self.elevations_deg) <= 4096 or not all(-90.0 < e < 90.0 for e in self.elevations_deg):
            raise SensorError(f"{who} elevations_deg needs one angle a beam, between -90 and 90, of 1 to 4096 beams")
        if any(upper <= lower for upper, lower in pairwise(self.elevations_deg)):
            raise SensorError(f"{who} elevations_deg must strictly decrease, from the top beam down")
        if not bounds[1] - bounds[0] >= 1e-9:
            FIELDS.refuse(f"{who} remission_range", bounds, "the lowest and the highest raw value, such as (0, 255)")
        if not isinstance(self.mounting, Mounting):
            raise SensorError(f"{who} mounting is a Mounting, got {self.mounting!r:.80}")
        if not self.min_range_m < self.max_range_m:
            raise SensorError(
                f"{who} min_range_m is {self.min_range_m!r}; expected less than max_range_m, {self.max_range_m!r}"
            )
        if self.remission is not None and not isinstance(self.remission, RemissionFunction):
            raise SensorError(f"{who} remission is a RemissionFunction or None, got {self.remission!r}")
        if self.ego_box is not None:
            object.__setattr__(self, "ego_box", _ego_box(who, self.ego_box))
        if self.pattern is not None and not isinstance(self.pattern, ScanPattern):
            raise SensorError(f"{who} pattern is a ScanPattern or None, got {self.pattern!r:.80}")

    def to_json(self) -> str:
        """Convert to JSON, which `get_sensor` reads from a file."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> SensorProfile:
        """Read what `to_json` wrote.

        Raises
        ------
        SensorError
            Not JSON, another schema, or an entry that is missing, unknown or of another type.
        """
        return FIELDS.read(cls, FIELDS.document(text, SCHEMA))

    @classmethod
    def uniform(
        cls,
        name: str,
        n_beams: int,
        fov_up_deg: float,
        fov_down_deg: float,
        *,
        columns: int = 1800,
        remission_range: tuple[float, float] = (0.0, 1.0),
        mounting: Mounting = UNKNOWN_MOUNTING,
        min_range_m: float = MIN_RANGE_M,
        max_range_m: float = 120.0,
        remission: RemissionFunction | None = None,
        ego_box: EgoBox | None = None,
    ) -> SensorProfile:
        """Describe a sensor with evenly spaced beams.

        Parameters
        ----------
        name : str
        n_beams : int
        fov_up_deg, fov_down_deg : float
            Elevation of the top and of the bottom beam [deg].
        columns, remission_range, mounting, min_range_m, max_range_m, remission, ego_box
            As the attributes.

        Raises
        ------
        SensorError
            The values do not describe a possible sensor.
        """
        up = FIELDS.number(f"sensor {name!r}: fov_up_deg", fov_up_deg, -90.0, 90.0)
        down = FIELDS.number(f"sensor {name!r}: fov_down_deg", fov_down_deg, -90.0, 90.0)
        n_beams = FIELDS.whole(f"sensor {name!r}: n_beams", n_beams, 1, 4096)
        return cls(
            name,
            # Rounded: a card then holds 2.3 and not 2.3000000000000003.
            tuple(round(float(e), 4) for e in np.linspace(up, down, n_beams)),
            columns,
            remission_range,
            mounting,
            min_range_m,
            max_range_m,
            remission,
            ego_box,
        )

    def accumulated(self, accumulate_s: float) -> SensorProfile:
        """The profile of scans that are gathered over another time, with as many beams and columns as they show.

        Parameters
        ----------
        accumulate_s : float
            Time over which a scan is gathered [s].

        Raises
        ------
        SensorError
            The sensor spins, or the time is not 0.01 to 10 s.
        """
        if self.pattern is None:
            raise SensorError(
                f"sensor {self.name!r} spins: each of its turns is a scan, and none is gathered over time"
            )
        pattern = replace(self.pattern, accumulate_s=accumulate_s)
        up, down = self.fov_up_deg, self.fov_down_deg
        n_points = pattern.points_per_s * pattern.accumulate_s
        cell_deg = math.sqrt(_POINTS_OF_CELL * pattern.width_deg * (up - down) / n_points)
        n_beams = min(max(round((up - down) / cell_deg), 2), 256)
        elevations = tuple(round(float(e), 4) for e in np.linspace(up, down, n_beams))
        return replace(self, elevations_deg=elevations, columns=max(round(360.0 / cell_deg), 8), pattern=pattern)

    def upright(self, mounting: Mounting) -> SensorProfile:
        """The profile with its beams as in the upright world: those of a sensor that hangs are turned over."""
        return _turned_over(self) if mounting.hangs else self

    @property
    def n_beams(self) -> int:
        """Number of beams."""
        return len(self.elevations_deg)

    @property
    def is_sparse(self) -> bool:
        """Whether the median gap between its beams is at least 1.5 degrees, or fewer than 20 look where the range image
        does (-25 to 3 degrees): most rows of it are then interpolated. Of a sensor without beams, the gap of one that
        would show as much.
        """
        low_deg, high_deg = VIEW_DEG
        n_in_view = sum(low_deg <= angle <= high_deg for angle in self.upright(self.mounting).elevations_deg)
        return self.median_gap_deg >= SPARSE_GAP_DEG or (self.pattern is None and n_in_view < FEWEST_IN_VIEW)

    @property
    def median_gap_deg(self) -> float:
        """Median of the gaps between neighboring beams [deg]; 0 of a single one."""
        return float(np.median([upper - lower for upper, lower in pairwise(self.elevations_deg)] or [0.0]))

    @property
    def fov_up_deg(self) -> float:
        """Elevation of the top beam [deg]."""
        return self.elevations_deg[0]

    @property
    def fov_down_deg(self) -> float:
        """Elevation of the bottom beam [deg]."""
        return self.elevations_deg[-1]

    @property
    def azimuth_resolution_deg(self) -> float:
        """Azimuth step between columns [deg]."""
        return 360.0 / self.columns

    @property
    def link_per_m(self) -> float:
        """Twice the angle between neighboring beams or columns [rad], whichever is larger.

        An object whose return between two others is missing stays linked at any range
        (`edgeperc.objects.cluster.find_clusters`).
        """
        return 2.0 * math.radians(max(self.median_gap_deg, self.azimuth_resolution_deg))

    @property
    def mount_height_m(self) -> float:
        """Height above the road [m] in simulated scans: that of the mounting, or else of the training vehicle."""
        return MODEL_HEIGHT_M if self.mounting.height_m is None else self.mounting.height_m

    @property
    def remission_offset(self) -> float:
        """``(raw + remission_offset) * remission_scale`` lies in 0..1."""
        return -self.remission_range[0]

    @property
    def remission_scale(self) -> float:
        """See `remission_offset`."""
        return 1.0 / (self.remission_range[1] - self.remission_range[0])


# Median elevation of each laser's returns seen from the origin, over 77 KITTI scans of 15 drives; the order of the
# points in a scan identifies the lasers. The unit's own angles are 0.6 deg (upper block) to 1.4 deg (bottom laser)
# lower, as the lasers sit 0.21 and 0.12 m above the origin; S3 calibrations published for other units differ by up to
# 0.9 deg, and the data sheet (2 .. -8.33 every 1/3, -8.83 .. -24.33 every 1/2) by up to 0.7 deg.
_HDL_64E = (
    *(2.54, 2.17, 1.92, 1.46, 1.21, 0.79, 0.53, 0.15, -0.19, -0.59, -0.88, -1.22, -1.59, -1.93, -2.26, -2.61),
    *(-2.90, -3.27, -3.53, -3.91, -4.20, -4.55, -4.86, -5.18, -5.57, -5.88, -6.18, -6.45, -6.82, -7.17, -7.39, -7.76),
    *(-8.37, -8.89, -9.36, -9.75, -10.21, -10.81, -11.31, -11.73, -12.18, -12.61, -13.13, -13.65, -14.22, -14.65),
    *(-15.15, -15.51, -16.12, -16.64, -17.20, -17.65, -18.15, -18.55, -19.01, -19.55, -20.06, -20.66, -21.14, -21.54),
    *(-21.99, -22.62, -23.14, -23.62),
)

# Velodyne's default calibration of the model.
_VLP_32C = (
    *(15.0, 10.33, 7.0, 4.67, 3.33, 2.33, 1.67, 1.33, 1.0, 0.67, 0.33, 0.0, -0.33, -0.67, -1.0, -1.33, -1.67, -2.0),
    *(-2.33, -2.67, -3.0, -3.33, -3.67, -4.0, -4.67, -5.33, -6.15, -7.25, -8.84, -11.31, -15.64, -25.0),
)

_LOWEST_OF_128 = (-6.65, -6.85, -7.15, -7.65, -8.352, -9.244, -10.346, -11.742, -13.565, -16.042, -19.582, -25.0)
_VLS_128 = (
    *(15.0, 11.75, 9.7, 8.43, 7.58, 6.98, 6.48, 6.08, 5.73, 5.43, 5.18, 4.98, 4.83),
    *(round(4.72 - 0.11 * k, 2) for k in range(103)),
    *_LOWEST_OF_128,
)
_RUBY_PLUS_128 = (
    *(15.0, 11.5, 9.0, 7.4, 6.55, 5.95, 5.45, 5.05, 4.7, 4.4, 4.15, 3.95),
    *(round(3.8 - 0.1 * k, 1) for k in range(103)),
    -6.5,
    *_LOWEST_OF_128,
)
_HELIOS = (
    *(15.0, 13.0, 11.0, 9.0, 7.0, 5.5, 4.0, 2.67, 1.33, 0.0, -1.33, -2.67, -4.0, -5.33, -6.67, -8.0, -10.0),
    *(-3.0 * k - 1.0 for k in range(4, 19)),
)

# Design angles of the Pandar64, which its drivers use for units without a calibration file.
_PANDAR_64 = (
    *(14.88, 11.03, 8.06, 5.06, 3.04, 2.03, 1.86, 1.69, 1.52, 1.35, 1.18, 1.01, 0.85, 0.68, 0.51, 0.34, 0.17, 0.0),
    *(-0.17, -0.34, -0.51, -0.68, -0.85, -1.01, -1.18, -1.35, -1.52, -1.69, -1.86, -2.03, -2.20, -2.37, -2.54, -2.70),
    *(-2.87, -3.04, -3.21, -3.38, -3.55, -3.71, -3.88, -4.05, -4.22, -4.39, -4.56, -4.72, -4.89, -5.06, -5.23, -5.39),
    *(-5.57, -5.73, -5.90, -6.06, -7.06, -8.06, -9.06, -9.89, -11.03, -12.01, -12.97, -13.93, -18.89, -24.90),
)

# Angles of a unit of each, by which makers' and others' drivers read captures without its own.
_JT_128 = (
    *(88.865, 88.192, 86.601, 84.982, 83.19, 81.931, 80.584, 79.196, 78.473, 78.093, 77.427, 76.582, 76.289, 75.094),
    *(75.093, 73.633, 72.417, 72.06, 71.241, 70.653, 70.038, 69.263, 68.819, 67.885, 67.176, 66.613, 65.895, 65.252),
    *(64.612, 63.899, 63.329, 62.558, 61.663, 61.163, 60.408, 59.839, 59.146, 58.516, 57.89, 57.202, 56.565, 55.956),
    *(55.287, 54.64, 54.013, 53.332, 52.736, 52.024, 51.231, 50.66, 49.963, 49.359, 48.697, 48.058, 47.434, 46.758),
    *(46.191, 45.526, 44.911, 44.225, 43.629, 42.921, 42.35, 41.628, 40.837, 40.264, 39.561, 38.963, 38.281, 37.664),
    *(36.999, 36.365, 35.813, 35.122, 34.525, 33.815, 33.233, 32.509, 31.937, 31.202, 30.418, 29.828, 29.119, 28.517),
    *(27.814, 27.2, 26.501, 25.877, 25.331, 24.629, 24.01, 23.297, 22.681, 21.958, 21.342, 20.612, 19.788, 19.194),
    *(18.425, 17.83, 17.051, 16.442, 15.664, 15.053, 14.345, 13.55, 12.919, 12.112, 11.471, 10.645, 9.998, 9.156),
    *(8.235, 7.552, 6.695, 5.989, 5.117, 4.388, 3.485, 2.732, 2.056, 1.084, 0.261, -0.774, -1.659, -2.781, -3.739),
    -4.965,
)
_OT_128 = (
    *(15.14, 13.43, 11.92, 10.63, 9.97, 9.3, 8.62, 7.95, 7.59, 7.24, 6.91, 6.55, 6.19, 5.84, 5.48, 5.12, 4.77, 4.4),
    *(4.04, 3.68, 3.31, 2.94, 2.58, 2.2, 2.08, 1.97, 1.84, 1.71, 1.6, 1.47, 1.33, 1.23, 1.11, 0.97, 0.86, 0.73, 0.6),
    *(0.48, 0.36, 0.22, 0.1, -0.01, -0.15, -0.27, -0.39, -0.52, -0.65, -0.76, -0.9, -1.02, -1.14, -1.27, -1.4, -1.51),
    *(-1.65, -1.78, -1.88, -2.03, -2.15, -2.26, -2.4, -2.53, -2.64, -2.77, -2.89, -3.02, -3.15, -3.27, -3.39, -3.53),
    *(-3.64, -3.77, -3.91, -4.02, -4.15, -4.29, -4.41, -4.52, -4.66, -4.78, -4.9, -5.04, -5.16, -5.27, -5.42, -5.54),
    *(-5.65, -5.81, -5.91, -6.29, -6.67, -7.04, -7.42, -7.79, -8.17, -8.55, -8.91, -9.29, -9.67, -10.04, -10.41),
    *(-10.79, -11.15, -11.52, -11.89, -12.26, -12.64, -12.99, -13.37, -13.73, -14.1, -14.45, -14.81, -15.17, -15.52),
    *(-15.88, -16.23, -16.59, -16.93, -17.29, -17.64, -18.33, -19.0, -19.66, -20.32, -21.6, -22.99, -24.71),
)
_PANDAR_40P = (
    *(14.79, 10.94, 7.97, 4.97, 2.95, 1.94, 1.6, 1.26, 0.93, 0.59, 0.25, -0.09, -0.42, -0.76, -1.1, -1.44, -1.78),
    *(-2.12, -2.45, -2.79, -3.13, -3.46, -3.8, -4.14, -4.47, -4.81, -5.14, -5.48, -5.81, -6.15, -7.15, -8.15, -9.15),
    *(-10.13, -11.12, -12.09, -13.06, -14.02, -18.98, -24.98),
)
_PANDARQT_UP = (
    *(52.121, 49.785, 47.577, 45.477, 43.465, 41.528, 39.653, 37.831, 36.055, 34.32, 32.619, 30.95, 29.308, 27.69),
    *(26.094, 24.517, 22.964, 21.42, 19.889, 18.372, 16.865, 15.368, 13.88, 12.399, 10.925, 9.457, 7.994, 6.535),
    *(5.079, 3.626, 2.175, 0.725),
)
_PANDARQT_64 = (*_PANDARQT_UP, *(-angle for angle in reversed(_PANDARQT_UP)))


def _ouster(model: str, half_fov_deg: float, min_range_m: float, max_range_m: float) -> tuple[SensorProfile, ...]:
    # Evenly spaced over the field of view in the data sheet; calibrations of single units differ by up to 1.3 deg. The
    # first OS1 generation had 33.2 deg instead. Remission is the 8-bit reflectivity.
    return tuple(
        SensorProfile.uniform(
            f"{model}-{beams}",
            beams,
            half_fov_deg,
            -half_fov_deg,
            columns=1024,
            remission_range=(0.0, 255.0),
            min_range_m=min_range_m,
            max_range_m=max_range_m,
        )
        for beams in (32, 64, 128)
    )


_BYTE = (0.0, 255.0)


def _mirrors(
    name: str, n_lines: int, fov_deg: tuple[float, float], step_deg: float, max_range_m: float
) -> SensorProfile:
    columns = round(360.0 / step_deg)
    return SensorProfile.uniform(
        name, n_lines, *fov_deg, columns=columns, remission_range=_BYTE, max_range_m=max_range_m
    )


def _livox(
    name: str, fov_deg: tuple[float, float], pattern: ScanPattern, min_range_m: float, max_range_m: float
) -> SensorProfile:
    profile = SensorProfile(name, fov_deg, 1, _BYTE, min_range_m=min_range_m, max_range_m=max_range_m, pattern=pattern)
    return profile.accumulated(pattern.accumulate_s)


# `edgeperc fit-sensor`, from unlabeled scans. The logarithm was the best of line, parabola and logarithm each time.
_OF_NUSCENES = RemissionFunction(
    "logarithm", (-0.2949, 0.1832), 255.0, "hdl-64e", 0.0209, "13 nuScenes scans, quantiles by range and incidence"
)
_OF_PANDASET = RemissionFunction(
    "logarithm", (-0.0483, 0.1482), 255.0, "hdl-64e", 0.0353, "4 PandaSet scans, quantiles by range and incidence"
)

# Velodyne calibrates these to one scale: 0 to 100 diffuse, above that retro-reflectors. Measured on the HDL-32E alone.
_OF_VELODYNE = replace(_OF_NUSCENES, source=f"the hdl-32e's, calibrated to the same scale: {_OF_NUSCENES.source}")
_BUILT_IN = (
    # KITTI, where a turn has up to 2,160 returns a laser; its files hold remission / 255.
    SensorProfile("hdl-64e", _HDL_64E, 2083, min_range_m=0.9),
    # nuScenes (20 Hz, on the roof). It writes empty beams up to 0.452 m away on one ray; the nearest return of two
    # recordings, 0.26 m away, is on the own roof.
    SensorProfile.uniform(
        "hdl-32e",
        32,
        10.67,
        -30.67,
        columns=1084,
        remission_range=_BYTE,
        min_range_m=0.5,
        max_range_m=105.0,
        remission=_OF_NUSCENES,
    ),
    SensorProfile.uniform(
        "vlp-16", 16, 15.0, -15.0, remission_range=_BYTE, min_range_m=0.5, max_range_m=105.0, remission=_OF_VELODYNE
    ),
    SensorProfile.uniform(
        "vlp-16-hi-res",
        16,
        10.0,
        -10.0,
        remission_range=_BYTE,
        min_range_m=0.5,
        max_range_m=105.0,
        remission=_OF_VELODYNE,
    ),
    SensorProfile("vlp-32c", _VLP_32C, 1800, _BYTE, min_range_m=1.0, max_range_m=200.0, remission=_OF_VELODYNE),
    SensorProfile("vls-128", _VLS_128, 1800, _BYTE, min_range_m=0.5, max_range_m=245.0, remission=_OF_VELODYNE),
    *_ouster("os0", 45.0, 0.3, 75.0),
    *_ouster("os1", 22.5 - 1.25, 0.3, 170.0),
    *_ouster("os2", 11.25, 0.8, 350.0),
    SensorProfile("pandar64", _PANDAR_64, 1800, _BYTE, min_range_m=0.3, max_range_m=200.0, remission=_OF_PANDASET),
    SensorProfile("pandar40p", _PANDAR_40P, 1800, _BYTE, min_range_m=0.3, max_range_m=200.0),
    SensorProfile("pandarqt-64", _PANDARQT_64, 600, _BYTE, min_range_m=0.1, max_range_m=60.0),
    SensorProfile.uniform("pandarxt-32", 32, 15.0, -16.0, columns=2000, remission_range=_BYTE, min_range_m=0.05),
    SensorProfile.uniform("pandarxt-32m", 32, 19.5, -20.8, columns=2000, remission_range=_BYTE, max_range_m=300.0),
    SensorProfile("ot128", _OT_128, 3600, _BYTE, min_range_m=0.3, max_range_m=200.0),
    SensorProfile("jt128", _JT_128, 900, _BYTE, min_range_m=0.1, max_range_m=60.0),
    SensorProfile("helios-32", _HELIOS, 1800, _BYTE, min_range_m=0.2, max_range_m=150.0),
    SensorProfile("helios-16", _HELIOS[:16], 1800, _BYTE, min_range_m=0.2, max_range_m=150.0),
    SensorProfile.uniform("rs-bpearl", 32, 89.5, 2.31, columns=1800, remission_range=_BYTE, min_range_m=0.1),
    SensorProfile("ruby-plus-128", _RUBY_PLUS_128, 1800, _BYTE, min_range_m=0.4, max_range_m=240.0),
    # Mirrors sweep the lasers over 120 degrees ahead; by the makers' manuals.
    _mirrors("at128", 128, (12.9, -12.5), 0.1, 210.0),
    _mirrors("rs-m1", 125, (12.5, -12.5), 0.2, 200.0),
    _mirrors("rs-e1", 144, (45.0, -45.0), 0.625, 75.0),
    # By the maker's manuals. How fast their prisms turn is not in them; one beam turns here so fast that its lines are
    # as dense as those of the several beams in the sensor.
    _livox("mid-360", (52.0, -7.0), ScanPattern(200_000.0, 360.0, 0.2, (9.7, 1733.3)), 0.1, 70.0),
    _livox("hap", (12.5, -12.5), ScanPattern(452_000.0, 120.0, 0.1, (729.6, -466.2)), 0.5, 150.0),
    _livox("avia", (38.6, -38.6), ScanPattern(240_000.0, 70.4, 0.2, (729.6, -466.2)), 1.0, 190.0),
)
SENSORS: Mapping[str, SensorProfile] = MappingProxyType({profile.name: profile for profile in _BUILT_IN})
"""The built-in profiles by name."""

SAY_PATTERN = (
    "Pass its name, sensor= or --sensor: "
    f"{', '.join(profile.name for profile in _BUILT_IN if profile.pattern is not None)}; of another model, a profile "
    "with a ScanPattern. Its scans are gathered over time (edgeperc.accumulate, --accumulate)"
)
"""What to do with points of a sensor that does not spin."""

_TWO_VLP_32C = tuple(sorted({*_VLP_32C, *(-deg for deg in _VLP_32C)}, reverse=True))  # one is upside down
_LYFT = (*range(7, 2, -1), *(round(k / 3.0, 2) for k in range(6, -19, -1)), *range(-7, -17, -1))
# Waymo's TOP: the calibrations of two vehicles differ by up to 0.14 degrees, and from this by up to 0.13.
_WAYMO = np.polyval((16.07, -43.48, 20.69, -13.33, 2.5), np.linspace(0.0, 1.0, 64)).round(2).tolist()
PUBLIC_SENSORS: Mapping[str, SensorProfile] = MappingProxyType(
    {
        "av2": replace(SENSORS["vlp-32c"], name="av2", elevations_deg=_TWO_VLP_32C, remission_range=(0.0, 1.0)),
        "ddad": SensorProfile("ddad", np.linspace(10.0, -30.0, 64).round(2).tolist(), 720, max_range_m=250.0),
        "kitti-raw": SENSORS["hdl-64e"],
        "kitti-tracking": SENSORS["hdl-64e"],
        "lyft": SensorProfile("lyft", _LYFT, 1800, _BYTE, max_range_m=200.0),
        "nuscenes": SENSORS["hdl-32e"],
        "once": SENSORS["pandar40p"],
        "pandaset": SENSORS["pandar64"],
        "semantickitti": SENSORS["hdl-64e"],
        "vod": replace(SENSORS["hdl-64e"], name="vod", remission_range=_BYTE),
        "waymo": SensorProfile("waymo", _WAYMO, 2650, max_range_m=75.0),
    }
)
"""The profiles of public sets, which have names of their layouts; none is taken for the sensor of a scan unasked."""


@lru_cache(maxsize=8)  # a perceiver asks for each scan: with 128 beams, to make a profile takes 0.13 ms
def _turned_over(profile: SensorProfile) -> SensorProfile:
    return replace(profile, elevations_deg=tuple(-deg for deg in reversed(profile.elevations_deg)))


def _ego_box(who: str, given: Any) -> EgoBox:
    """The box as numbers; SensorError if it is not one."""
    try:
        x, y, z = (FIELDS.pair(f"{who} ego_box", bounds, -MAX_EGO_M, MAX_EGO_M) for bounds in given)
    except (TypeError, ValueError):
        x = y = z = (0.0, 0.0)
    if not all(low < high for low, high in (x, y, z)):
        FIELDS.refuse(
            f"{who} ego_box", given, "((x, x), (y, y), (z, z)), lowest and highest value about the sensor [m]"
        )
    return x, y, z


def get_sensor(sensor: str | os.PathLike[str] | SensorProfile) -> SensorProfile:
    """Get a sensor profile by name, from a file, or as given.

    Parameters
    ----------
    sensor : str, Path or SensorProfile
        A str that ends in ``.json`` and every Path is a file, as ``edgeperc fit-sensor`` or `SensorProfile.to_json`
        writes it.

    Raises
    ------
    SensorError
        No built-in profile has this name, or the file is not a sensor profile.
    """
    if isinstance(sensor, SensorProfile):
        return sensor
    if isinstance(sensor, os.PathLike) or (isinstance(sensor, str) and sensor.endswith(".json")):
        try:
            return SensorProfile.from_json(Path(sensor).read_text(encoding="utf-8-sig"))
        except SensorError as exc:
            raise SensorError(f"{os.fspath(sensor)}: {exc}") from exc
        except (OSError, ValueError) as exc:  # ValueError: of what is no UTF-8, and of a null character in the path
            raise SensorError(f"{os.fspath(sensor)!r}: the sensor profile cannot be read ({exc})") from exc
    try:
        return SENSORS[sensor] if sensor in SENSORS else PUBLIC_SENSORS[sensor]
    except (KeyError, TypeError):
        raise SensorError(
            "sensor 'auto' is found by a Perceiver, and not here: pass Perceiver.sensor, or what 'edgeperc info' names"
            if str(sensor) == AUTO_SENSOR
            else f"no sensor {sensor!r} is built in{nearest(str(sensor), (*SENSORS, *PUBLIC_SENSORS))}; "
            f"known are {', '.join(SENSORS)}, "
            f"and of public sets {', '.join(PUBLIC_SENSORS)}. "
            "Describe another with SensorProfile(...) or SensorProfile.uniform(...), or name a .json file."
        ) from None
