"""What a sensor is, and whether a scan is like those a model was trained on."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .errors import CardError, PointsError, SensorError

__all__ = ["SENSORS", "FitnessProfile", "RemissionFunction", "SensorProfile", "check_fitness", "get_sensor"]

SCHEMA = 1  # of a sensor profile's file
REMISSION_KINDS = {"linear": 2, "polynomial": 3, "logarithm": 2}  # and how many coefficients each has


@dataclass(frozen=True)
class RemissionFunction:
    """One sensor's remission as another sensor would report it (KUL-Seg 5).

    With ``x = full_scale * remission``, where remission is scaled to 0..1 by the profile's ``remission_range``, the
    other sensor's remission in 0..1 is a + b x (linear), a + b x + c x^2 (polynomial) or a + b ln(1 + x) (logarithm),
    cut off at 0 and 1. `edgeperc.adapt` fits and applies it.

    Attributes
    ----------
    kind : str
        ``"linear"``, ``"polynomial"`` or ``"logarithm"``.
    coefficients : tuple of float
        a, b and, of a polynomial, c.
    full_scale : float
        Raw values in the sensor's remission range when the function was fitted, 255 for a byte.
    to : str
        The sensor whose remission comes out.
    rmse : float
        Root mean square error on samples held back, in shares of the other sensor's full scale.
    source : str
        What it was fitted to.

    Raises
    ------
    SensorError
        When the values describe no such function.
    """

    kind: str
    coefficients: tuple[float, ...]
    full_scale: float
    to: str
    rmse: float
    source: str

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "coefficients", tuple(float(c) for c in self.coefficients))
            object.__setattr__(self, "full_scale", float(self.full_scale))
            object.__setattr__(self, "rmse", float(self.rmse))
        except (TypeError, ValueError, OverflowError) as exc:
            raise SensorError(f"remission function: a value is no number ({exc})") from exc
        if self.kind not in REMISSION_KINDS:
            raise SensorError(f"remission function of kind {self.kind!r}; expected one of {', '.join(REMISSION_KINDS)}")
        if len(self.coefficients) != REMISSION_KINDS[self.kind] or not all(map(math.isfinite, self.coefficients)):
            raise SensorError(
                f"a {self.kind} remission function has {REMISSION_KINDS[self.kind]} finite coefficients, "
                f"got {self.coefficients!r}"
            )
        if not 0.0 < self.full_scale < math.inf or not 0.0 <= self.rmse < math.inf:
            raise SensorError(
                f"full_scale {self.full_scale!r} must be above 0 and rmse {self.rmse!r} not below, finite"
            )
        if not isinstance(self.to, str) or not self.to or not isinstance(self.source, str):
            raise SensorError(f"remission function to {self.to!r} from {self.source!r}; expected two str")


@dataclass(frozen=True)
class SensorProfile:
    """A spinning LiDAR, as far as the networks care.

    A built-in one (`SENSORS`) fits one usual set-up of its model; change what differs with ``dataclasses.replace``,
    e.g. ``replace(get_sensor("os1-64"), remission_range=(0, 65535), mount_height_m=2.1)`` for an Ouster whose 16-bit
    signal is used instead of its 8-bit reflectivity. A sensor that is not built in is written down with
    ``SensorProfile(...)``, or `SensorProfile.uniform` where the beams are evenly spaced.

    Attributes
    ----------
    name : str
    elevations_deg : tuple of float
        Elevation of each beam, strictly decreasing from the top beam to the bottom one, up positive.
    columns : int
        Azimuth steps in one turn.
    remission_range : tuple of 2 float
        Raw values of the sensor's fourth channel that mean 0 and 1 to a network.
    mount_height_m : float
        Height of the sensor above the road.
    min_range_m, max_range_m : float
        Nearest and farthest return to expect.
    remission : RemissionFunction or None
        How this sensor's remission is rendered as that of the sensor that models were trained on; None where nothing
        is known: it is then scaled by ``remission_range`` alone.

    Raises
    ------
    SensorError
        When the values describe no possible sensor.
    """

    name: str
    elevations_deg: tuple[float, ...]
    columns: int
    remission_range: tuple[float, float] = (0.0, 1.0)
    mount_height_m: float = 1.73
    min_range_m: float = 0.9
    max_range_m: float = 120.0
    remission: RemissionFunction | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise SensorError(f"a sensor's name is a non-empty str, got {self.name!r}")
        try:
            object.__setattr__(self, "elevations_deg", tuple(float(e) for e in self.elevations_deg))
            object.__setattr__(self, "remission_range", tuple(float(v) for v in self.remission_range))
            for field in ("mount_height_m", "min_range_m", "max_range_m"):
                object.__setattr__(self, field, float(getattr(self, field)))
            columns_are_whole = int(self.columns) == self.columns
            object.__setattr__(self, "columns", int(self.columns))
        except (TypeError, ValueError, OverflowError) as exc:
            raise SensorError(f"sensor {self.name!r}: a value is no number ({exc})") from exc
        if not self.elevations_deg or not all(-90.0 < e < 90.0 for e in self.elevations_deg):
            raise SensorError(f"sensor {self.name!r}: elevations_deg needs one angle a beam, between -90 and 90")
        if any(upper <= lower for upper, lower in pairwise(self.elevations_deg)):
            raise SensorError(f"sensor {self.name!r}: elevations_deg must strictly decrease, from the top beam down")
        if not columns_are_whole or self.columns < 1:
            raise SensorError(f"sensor {self.name!r}: columns is a whole number of at least 1, got {self.columns!r}")
        if len(self.remission_range) != 2 or not 0.0 < self.remission_range[1] - self.remission_range[0] < math.inf:
            raise SensorError(
                f"sensor {self.name!r}: remission_range is (lowest, highest) raw value, such as (0, 255), "
                f"got {self.remission_range!r}"
            )
        if not 0.0 < self.mount_height_m < math.inf:
            raise SensorError(f"sensor {self.name!r}: mount_height_m must be above 0, got {self.mount_height_m!r}")
        if not 0.0 <= self.min_range_m < self.max_range_m < math.inf:
            raise SensorError(
                f"sensor {self.name!r}: 0 <= min_range_m < max_range_m must hold, "
                f"got {self.min_range_m!r} and {self.max_range_m!r}"
            )
        if self.remission is not None and not isinstance(self.remission, RemissionFunction):
            raise SensorError(f"sensor {self.name!r}: remission is a RemissionFunction or None, got {self.remission!r}")

    def to_json(self) -> str:
        """For a file that `get_sensor` reads."""
        return json.dumps({"schema": SCHEMA, **asdict(self)}, indent=1, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> SensorProfile:
        """Read what `to_json` wrote.

        Raises
        ------
        SensorError
            No JSON, another schema, an entry that is missing, unknown or of another type.
        """
        try:
            document = json.loads(text)
        except (RecursionError, ValueError) as exc:
            raise SensorError(f"the sensor profile is no JSON ({exc}); write it again with edgeperc adapt fit") from exc
        if not isinstance(document, dict) or document.get("schema") != SCHEMA:
            found = document.get("schema") if isinstance(document, dict) else None
            raise SensorError(f"the sensor profile has schema {found!r}, this edgeperc reads {SCHEMA}")
        _check_entries(document, {"schema", *(field.name for field in fields(cls))}, "sensor profile")
        del document["schema"]
        if document["remission"] is not None:
            _check_entries(document["remission"], {field.name for field in fields(RemissionFunction)}, "remission")
            document["remission"] = RemissionFunction(**document["remission"])
        return cls(**document)

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
        mount_height_m: float = 1.73,
        min_range_m: float = 0.9,
        max_range_m: float = 120.0,
        remission: RemissionFunction | None = None,
    ) -> SensorProfile:
        """A sensor with evenly spaced beams, the top one at ``fov_up_deg``, the bottom one at ``fov_down_deg``."""
        if isinstance(n_beams, bool) or not isinstance(n_beams, int | np.integer) or not 1 <= n_beams <= 4096:
            raise SensorError(f"sensor {name!r}: n_beams is a whole number in 1..4096, got {n_beams!r}")
        if not math.isfinite(fov_up_deg) or not math.isfinite(fov_down_deg):
            raise SensorError(f"sensor {name!r}: fov_up_deg and fov_down_deg must be finite")
        return cls(
            name,
            # Rounded, so that a card holds 2.3 and not 2.3000000000000003.
            tuple(round(float(e), 4) for e in np.linspace(fov_up_deg, fov_down_deg, int(n_beams))),
            columns,
            remission_range,
            mount_height_m,
            min_range_m,
            max_range_m,
            remission,
        )

    @property
    def n_beams(self) -> int:
        return len(self.elevations_deg)

    @property
    def fov_up_deg(self) -> float:
        """Elevation of the top beam."""
        return self.elevations_deg[0]

    @property
    def fov_down_deg(self) -> float:
        """Elevation of the bottom beam."""
        return self.elevations_deg[-1]

    @property
    def azimuth_resolution_deg(self) -> float:
        return 360.0 / self.columns

    @property
    def remission_offset(self) -> float:
        """``(raw + remission_offset) * remission_scale`` lies in 0..1."""
        return -self.remission_range[0]

    @property
    def remission_scale(self) -> float:
        """See `remission_offset`."""
        return 1.0 / (self.remission_range[1] - self.remission_range[0])


# Median elevation of each laser's returns seen from the origin, over 77 KITTI scans of 15 drives; every scan's order
# gives its lasers away. The unit's own angles are 0.6 deg (upper block) to 1.4 deg (bottom laser) lower, as the lasers
# sit 0.21 and 0.12 m above the origin; S3 calibrations published for other units differ by up to 0.9 deg, and the
# data sheet (2 .. -8.33 every 1/3, -8.83 .. -24.33 every 1/2) by up to 0.7 deg.
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
# Design angles of the Pandar64, as its drivers carry them for units without a calibration file.
_PANDAR_64 = (
    *(14.88, 11.03, 8.06, 5.06, 3.04, 2.03, 1.86, 1.69, 1.52, 1.35, 1.18, 1.01, 0.85, 0.68, 0.51, 0.34, 0.17, 0.0),
    *(-0.17, -0.34, -0.51, -0.68, -0.85, -1.01, -1.18, -1.35, -1.52, -1.69, -1.86, -2.03, -2.20, -2.37, -2.54, -2.70),
    *(-2.87, -3.04, -3.21, -3.38, -3.55, -3.71, -3.88, -4.05, -4.22, -4.39, -4.56, -4.72, -4.89, -5.06, -5.23, -5.39),
    *(-5.57, -5.73, -5.90, -6.06, -7.06, -8.06, -9.06, -9.89, -11.03, -12.01, -12.97, -13.93, -18.89, -24.90),
)


def _ouster(model: str, half_fov_deg: float, min_range_m: float, max_range_m: float) -> tuple[SensorProfile, ...]:
    # Even spacing over the data sheet's field of view; single units were calibrated up to 1.3 deg off that. The first
    # OS1 generation spanned 33.2 deg instead. 8-bit reflectivity.
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
# `edgeperc adapt fit`, from unlabelled scans. The logarithm was the best of three each time.
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
    SensorProfile("hdl-64e", _HDL_64E, 2083, (0.0, 1.0), 1.73, 0.9, 120.0),
    # nuScenes (20 Hz, on the roof).
    SensorProfile.uniform(
        "hdl-32e",
        32,
        10.67,
        -30.67,
        columns=1084,
        remission_range=_BYTE,
        mount_height_m=1.84,
        max_range_m=105.0,
        remission=_OF_NUSCENES,
    ),
    SensorProfile.uniform(
        "vlp-16", 16, 15.0, -15.0, remission_range=_BYTE, min_range_m=0.5, max_range_m=105.0, remission=_OF_VELODYNE
    ),
    SensorProfile("vlp-32c", _VLP_32C, 1800, _BYTE, 1.73, 1.0, 200.0, _OF_VELODYNE),
    *_ouster("os0", 45.0, 0.3, 75.0),
    *_ouster("os1", 22.5 - 1.25, 0.3, 170.0),
    *_ouster("os2", 11.25, 0.8, 350.0),
    # PandaSet, whose files have their origin on the road: the beams meet 2.1 m above it.
    SensorProfile("pandar64", _PANDAR_64, 1800, _BYTE, 2.1, 0.3, 200.0, _OF_PANDASET),
    SensorProfile.uniform("pandarxt-32", 32, 15.0, -16.0, columns=2000, remission_range=_BYTE, min_range_m=0.05),
)

SENSORS: Mapping[str, SensorProfile] = MappingProxyType({profile.name: profile for profile in _BUILT_IN})
"""The built-in profiles by name."""


def _check_entries(document: object, names: set[str], what: str) -> None:
    if not isinstance(document, dict) or set(document) != names:
        found = ", ".join(sorted(map(str, document))) if isinstance(document, dict) else repr(document)
        raise SensorError(f"a {what} file holds exactly {', '.join(sorted(names))}; got {found}")
    numbers = {name: value for name, value in document.items() if name not in ("name", "kind", "to", "source")}
    listed = [v for value in numbers.values() for v in (value if isinstance(value, list) else [value])]
    if any(isinstance(v, (str, bool)) for v in listed):
        raise SensorError(f"a {what} file has a text or truth value where a number belongs: {numbers!r}")


def get_sensor(sensor: str | os.PathLike[str] | SensorProfile) -> SensorProfile:
    """The built-in profile of that name, the one in a file, or the profile itself.

    Parameters
    ----------
    sensor : str, Path or SensorProfile
        A str that ends in ``.json`` and every Path is a file, as ``edgeperc adapt fit`` or `SensorProfile.to_json`
        writes it.

    Raises
    ------
    SensorError
        When no built-in profile has that name, or the file holds none.
    """
    if isinstance(sensor, SensorProfile):
        return sensor
    if isinstance(sensor, os.PathLike) or (isinstance(sensor, str) and sensor.endswith(".json")):
        try:
            return SensorProfile.from_json(Path(sensor).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError) as exc:
            raise SensorError(f"{os.fspath(sensor)}: the sensor profile cannot be read ({exc})") from exc
        except SensorError as exc:
            raise SensorError(f"{os.fspath(sensor)}: {exc}") from exc
    try:
        return SENSORS[sensor]
    except (KeyError, TypeError):
        raise SensorError(
            f"no sensor {sensor!r} is built in; known are {', '.join(SENSORS)}. "
            "Write down another with SensorProfile(...) or SensorProfile.uniform(...), or name a .json file."
        ) from None


# --- fitness ---------------------------------------------------------------------------------------------------------

# Some 6,000 points tell what is asked here; a prime step does not fall in with the rows of an organised scan.
_STEPS = np.array([1, 2, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 53, 61, 71, 83, 97, 127, 167, 223, 307, 401])
_SAMPLE, _BEAM_SAMPLE = 6000, 130_000

# Where the ground shows as a peak among the heights of near points; KITTI scans: 0.18 (5th percentile) and above.
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
    """Histograms of every ``step``-th point, from which `check_fitness` judges a scan. Points not finite are skipped.

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m], remission.
    step, beam_step : int
        The elevations along eight directions come from every ``beam_step``-th point.
    view_right, view_left : float
        Edges of the model's view as pseudo-azimuth, y / (|x| + |y|) unfolded to -2..2.
    remissions : (258,) int64, overwritten
        Points of remission <= 0, 256 even bins in 0..1, points above 1.
    elevations : (360,) int64, overwritten
        Bins of half a degree from -90.
    ranges : (200,) int64, overwritten
        Horizontal distance, 20 bins a decade from 1 mm.
    heights : (3, 100) int64, overwritten
        x, y and z of the points 3 to 25 m away, bins of 0.2 m from -10 m.
    rows : (8, 1024) float64, overwritten
        Elevation [deg] of the points exactly ahead, left, behind, right and halfway between.
    n_rows : (8,) int64, overwritten
    sums : (8,) float64, overwritten
        0 points that are finite; 1 of these, in the view; 2 sixty-fourths of the turn that hold points; 3 of those
        in the view, the share that holds points; 4 how much more is in the way to the sides than ahead and behind;
        5 lowest and 6 highest remission; 7 points 3 to 25 m away.
    """
    n = points.shape[0]
    remissions[:] = 0
    elevations[:] = 0
    ranges[:] = 0
    heights[:] = 0
    n_rows[:] = 0
    sums[:] = 0.0
    seen = np.zeros(64, dtype=np.bool_)
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
        seen[min(int((azimuth + 2.0) * 16.0), 63)] = True
        if view_right <= azimuth <= view_left:
            sums[1] += 1.0
        horizontal = math.sqrt(x * x + y * y)
        elevations[min(int((math.atan(z / horizontal) * (180.0 / math.pi) + 90.0) * 2.0), 359)] += 1
        ranges[min(max(int((math.log10(horizontal) + 3.0) * 20.0), 0), 199)] += 1
        square = x * x + y * y + z * z
        if 9.0 < square < 625.0:
            sums[7] += 1.0
            for axis, value in enumerate((x, y, z)):
                if -10.0 <= value < 10.0:
                    heights[axis, min(int((value + 10.0) * 5.0), 99)] += 1
    sums[5] = lowest
    sums[6] = highest

    in_view = 0
    in_view_seen = 0
    for sector in range(64):
        sums[2] += seen[sector]
        middle = (sector + 0.5) / 16.0 - 2.0
        if view_right <= middle <= view_left:
            in_view += 1
            in_view_seen += seen[sector]
    sums[3] = in_view_seen / max(in_view, 1)

    # What stands on the ground, in corridors 4 m wide to the four sides, and how well its sides line up with the axes.
    ground = np.argmax(heights[2]) * 0.2 - 9.9
    ways = np.zeros(4)
    along_x = np.zeros(120)
    along_y = np.zeros(120)
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
    sums[4] += 0.5 * math.log((np.sum(along_y * along_y) + 1.0) / (np.sum(along_x * along_x) + 1.0))

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
    """What one scan looks like. None where the scan does not tell."""

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
    # What follows is judged by itself, not against the training scans.
    n_sampled: float
    remission_low: float
    remission_high: float
    remission_beyond: float
    remission_alike: float
    flat_axis: int | None
    flat_m: float


def _pseudo_azimuth(azimuth_deg: float) -> float:
    x, y = math.cos(math.radians(azimuth_deg)), math.sin(math.radians(azimuth_deg))
    across = y / (abs(x) + abs(y))
    return across if x >= 0.0 else math.copysign(2.0, azimuth_deg) - across


def _quantile(histogram: NDArray[np.int64], share: float) -> float:
    """Place in a histogram, in bins, below which ``share`` of it lies."""
    total = np.cumsum(histogram)
    return float(np.searchsorted(total, share * total[-1], side="right")) + 0.5


def _measure(points: NDArray[np.float32], azimuth_deg: tuple[float, float]) -> _Measures | None:
    """None where no point is finite."""
    if points.ndim != 2 or points.shape[1] != 4:
        raise PointsError(f"got an array of shape {points.shape}; expected (n, 4): x, y, z, remission")
    points = np.ascontiguousarray(points, dtype=np.float32)
    remissions, elevations, ranges = (np.empty(size, dtype=np.int64) for size in (258, 360, 200))
    heights = np.empty((3, 100), dtype=np.int64)
    rows, n_rows, sums = np.empty((8, 1024)), np.empty(8, dtype=np.int64), np.empty(8)
    step = int(_STEPS[np.searchsorted(_STEPS[:-1], len(points) // _SAMPLE)])
    left, right = (_pseudo_azimuth(angle) for angle in azimuth_deg)
    fill_scan_sums(
        points, step, len(points) // _BEAM_SAMPLE + 1, right, left,
        remissions, elevations, ranges, heights, rows, n_rows, sums,
    )  # fmt: skip
    n_finite = sums[0]
    if n_finite == 0.0:
        return None
    # In one direction, returns of one beam lie closer than 0.1 deg, those of neighbours farther apart.
    beams = [
        np.count_nonzero(np.diff(np.sort(row[:count])) > 0.1) + 1
        for row, count in zip(rows, n_rows, strict=True)
        if count
    ]
    n_beams = float(np.percentile(beams, 75)) if beams else 0.0
    low, high = (_quantile(elevations, share) / 2.0 - 90.0 for share in (0.01, 0.99))
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
        # 58 of 64 sectors: a full turn with a pillar or two in it.
        road_ahead=float(sums[4]) if has_ground and sums[2] >= 58 else None,
        n_sampled=float(n_finite),
        remission_low=float(sums[5]),
        remission_high=float(sums[6]),
        remission_beyond=float(remissions[257] / n_finite),
        remission_alike=float(remissions.max() / n_finite),
        # Facades make y flat, too, but only a road ahead of a camera's z spreads the elevations so far.
        flat_axis=flattest if peaks[flattest] >= max(_GROUND_SHARE, 1.5 * peaks[2]) and high - low > 60.0 else None,
        flat_m=round(int(heights[flattest].argmax()) * 0.2 - 9.9, 1),
    )


Range = tuple[float, float]


@dataclass(frozen=True)
class FitnessProfile:
    """What the scans a model was trained on look like: lowest and highest value of each measure over the scans.

    Goes into the model's card, so that `check_fitness` can tell when a scan is unlike them.

    Attributes
    ----------
    n_scans : int
    azimuth_deg : tuple of 2 float
        Left and right edge of the model's view.
    points_in_view : tuple of 2 float
        Points in that view.
    view_covered : tuple of 2 float
        Share of the view, in steps of 1/64 turn, from which anything returned.
    remission_median, remission_p99, remission_zeros : tuple of 2 float
        Of remission scaled to 0..1: median, 99th percentile, share of points with none.
    elevation_p01_deg, elevation_p99_deg : tuple of 2 float
        1st and 99th percentile of the points' elevation.
    beams, beams_per_deg : tuple of 2 float
        Rows of points above one another, and their number per degree of elevation.
    range_median_m : tuple of 2 float
        Median horizontal distance.
    ground_m : tuple of 2 float, or None
        Height of the ground in the sensor's frame; None where no scan shows it.
    road_ahead : tuple of 2 float, or None
        Logarithm of how much more stands in the way to the sides than ahead and behind; None where no scan is a
        full turn.
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
            Left and right edge of the model's view, within 180 and -180.

        Raises
        ------
        PointsError
            When there is no scan with a finite point, or an array is no scan.
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
        """For JSON; `from_dict` reads it."""
        return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> FitnessProfile:
        """Read what `to_dict` wrote.

        Raises
        ------
        CardError
            When an entry is missing, unknown or no pair of numbers.
        """
        names = {field.name for field in fields(cls)}
        if not isinstance(document, Mapping) or set(document) != names:
            raise CardError(f"the card's fitness entry must hold exactly {', '.join(sorted(names))}")
        values: dict[str, Any] = {}
        for name, value in document.items():
            try:
                if name == "n_scans":
                    values[name] = int(value)
                elif value is None and name in ("ground_m", "road_ahead"):
                    values[name] = None
                else:
                    low, high = (float(v) for v in value)
                    if not math.isfinite(low) or not math.isfinite(high):
                        raise ValueError("not finite")
                    values[name] = (low, high)
            except (TypeError, ValueError, OverflowError) as exc:
                raise CardError(f"the card's fitness entry {name!r} is no pair of numbers: {value!r}") from exc
        return cls(**values)


_MEASURED = tuple(field.name for field in fields(FitnessProfile) if field.name not in ("n_scans", "azimuth_deg"))


def check_fitness(points: NDArray[np.float32], profile: FitnessProfile, sensor: SensorProfile) -> tuple[str, ...]:
    """Say in plain words what is unlike the scans a model was trained on, and what to do about it.

    Margins are wide: this is to find gross mistakes (axes, units, remission scale, another sensor), and to stay quiet
    about ordinary scans of the right sensor, those cropped to the model's view among them. What it cannot see: a scan
    turned by 180 degrees, one mirrored left to right, and in one scan of nine (measured on KITTI) one turned by 90.

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m], remission scaled to 0..1 by ``sensor``. Points not finite are skipped.
    profile : FitnessProfile
    sensor : SensorProfile
        What the scan is said to come from.

    Returns
    -------
    tuple of str
        One sentence a finding; empty when all is well.

    Raises
    ------
    PointsError
        When ``points`` is of another shape.
    """
    scan = _measure(points, profile.azimuth_deg)
    if scan is None:
        return ("The scan holds no finite point: is the sensor connected and its driver running?",)
    if scan.n_sampled < 300.0 and scan.points_in_view < 0.2 * profile.points_in_view[0]:
        return (_too_few(scan, profile),)  # too few to tell anything else
    return (*_geometry_findings(scan, profile, sensor), *_remission_findings(scan, profile, sensor))


def _too_few(scan: _Measures, profile: FitnessProfile) -> str:
    return (
        f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at least "
        f"{profile.points_in_view[0]:.0f}: is the scan complete, and the sensor clean?"
    )


_UNITS = (("millimetres", 1e3), ("centimetres", 1e2), ("kilometres", 1e-3))


def _geometry_findings(scan: _Measures, profile: FitnessProfile, sensor: SensorProfile) -> list[str]:
    near, far = profile.range_median_m
    if not near / 20.0 <= scan.range_median_m <= far * 20.0:
        factor = scan.range_median_m / math.sqrt(near * far)
        unit = next((name for name, size in _UNITS if 0.2 * size < factor < 5.0 * size), "another unit")
        return [
            f"The median distance is {scan.range_median_m:.3g}, in training it was {near:.0f} to {far:.0f} m: "
            f"the coordinates seem to be in {unit}; convert them to metres."
        ]
    if scan.flat_axis is not None:
        towards = ("+" if scan.flat_m > 0.0 else "-") + "xyz"[scan.flat_axis]
        advice = "" if towards != "+y" else " They may be a camera's (x right, y down, z forward): pass z, -x, -y."
        return [
            f"The ground seems to lie towards {towards}, where the model expects it towards -z: the axes are not "
            f"x forward, y left, z up.{advice}"
        ]

    findings = []
    has_ground = scan.ground_m is not None and profile.ground_m is not None
    if scan.ground_m is not None and profile.ground_m is not None:
        low, high = profile.ground_m
        if scan.ground_m > 0.5 and high < 0.0:
            return [
                f"The ground lies {scan.ground_m:.1f} m above the sensor: it is mounted upside down, or z points down; "
                "turn the points by 180 degrees about x (negate y and z)."
            ]
        if not low - 0.6 <= scan.ground_m <= high + 0.6:
            has_ground = False
            findings.append(
                f"The ground lies at z = {scan.ground_m:.1f} m, in training it lay at {low:.1f} to {high:.1f} m: the "
                "origin is not the sensor, or the sensor is mounted at another height; shift z to match."
            )

    low, high = profile.elevation_p01_deg[1], profile.elevation_p99_deg[1]
    # The lowest beams are missing from a crop to a camera's view (9 deg) and from a scan cut short (up to 13).
    if scan.elevation_p01_deg > low + 13.0 or scan.elevation_p99_deg > high + 8.0:
        findings.append(
            f"The points lie between {scan.elevation_p01_deg:.0f} and {scan.elevation_p99_deg:.0f} deg of elevation, "
            f"in training between {low:.0f} and {high:.0f}: this is a sensor of another field of view, or the origin "
            "is not the sensor, or it is not level."
        )

    left, right = profile.azimuth_deg
    if scan.view_covered < 0.6 * profile.view_covered[0]:
        findings.append(
            f"Only {scan.view_covered:.0%} of the model's view ({left:.0f} to {right:.0f} deg of azimuth) holds "
            "points: the scan is cropped, or x does not point forward."
        )
    elif (
        scan.road_ahead is not None
        and profile.road_ahead is not None
        and scan.road_ahead < min(-0.5, profile.road_ahead[0] - 0.3)
    ):
        findings.append(
            "More stands in the way ahead and behind than to the sides, as if the road ran along y: if x does not "
            "point forward, turn the points (from x right, y forward: pass y, -x, z). Across a road this may be right."
        )

    few_rows = scan.beams < 0.75 * profile.beams[0] and scan.beams_per_deg < 0.65 * profile.beams_per_deg[0]
    if few_rows and has_ground:  # from a wrong origin, rows are not to be told apart
        findings.append(
            f"The scan has about {scan.beams:.0f} rows of points (sensor {sensor.name}: {sensor.n_beams}), in training "
            f"it had at least {profile.beams[0]:.0f}: expect to lose far and small objects, or use a model trained for "
            "it."
        )

    if scan.points_in_view < 0.2 * profile.points_in_view[0]:
        findings.append(_too_few(scan, profile))
    elif scan.points_in_view > 5.0 * profile.points_in_view[1]:
        findings.append(
            f"The model's view holds about {scan.points_in_view:.0f} points, in training it held at most "
            f"{profile.points_in_view[1]:.0f}: pass one turn of the sensor at a time."
        )
    return findings


def _remission_findings(scan: _Measures, profile: FitnessProfile, sensor: SensorProfile) -> list[str]:
    low, high = sensor.remission_range
    raw_low, raw_high, raw_p99 = (
        value * (high - low) + low for value in (scan.remission_low, scan.remission_high, scan.remission_p99)
    )
    told = f"the profile {sensor.name} says {low:g} to {high:g}"
    useless = max(0.9, profile.remission_zeros[1] + 0.05)
    if scan.remission_beyond > 0.01 or scan.remission_low < -0.05:
        likely = next((f"(0, {top})" for top in (1, 255, 65535) if raw_low >= 0.0 and raw_high <= top), "that")
        return [
            f"Remission runs from {raw_low:g} to {raw_high:g}, but {told}: pass sensor= a profile whose "
            f"remission_range is {likely}."
        ]
    if scan.remission_zeros > useless:
        return [
            f"Remission is 0 for {scan.remission_zeros:.0%} of the points: the field is missing or was not read; the "
            "model needs it."
        ]
    if scan.remission_p99 < 0.2 * profile.remission_p99[0]:
        return [
            f"Remission hardly exceeds {raw_p99:.2g}, but {told}: pass sensor= a profile with the remission_range of "
            "this data, (0, 1) if it is scaled already."
        ]
    if scan.remission_alike > useless:
        return [
            f"Remission is the same for {scan.remission_alike:.0%} of the points ({raw_high:g}): the field holds "
            "something else; the model needs it."
        ]
    darkest, brightest = profile.remission_median
    if not darkest / 4.0 <= scan.remission_median <= brightest * 2.5:
        return [
            f"The median remission is {scan.remission_median:.2f} of full scale, in training it was {darkest:.2f} to "
            f"{brightest:.2f}: sensors differ in this; fit a profile to it with edgeperc adapt fit."
        ]
    return []
