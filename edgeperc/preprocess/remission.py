"""Match the remission of a sensor to that of the training sensor, from what its scans hold (KUL-Seg 5)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import SensorError
from ..system.printable import many
from ..types.points import Floats, Floats32, Ints64, Points
from ..types.sensor import RemissionFunction, SensorProfile
from .condition import scale
from .findings import Finding
from .sensor_fit import (
    RANGE_EDGES_M,
    REFERENCES,
    fit_functions,
    increasing,
    match_quantiles,
    quantiles,
    quantiles_by_stratum,
    stratify,
)

__all__ = ["FROZEN_AFTER", "NO_REMISSION", "RemissionMatcher", "is_missing"]

FROZEN_AFTER = 5  # scans

# What the networks get if there is no remission, between what is best for the simulation-only network (car IoU on 31
# scans of the training drives: 50, 60, 48, 36, 22, 5 and 1 with 0, 0.05, 0.1, 0.12, 0.14, 0.16 and 0.2; 83 with the
# remission) and for `pointseg` (33 validation scans: 27, 36, 44, 58, 62, 57, 35; 84). Values that imitate the training
# scans' are worse: their median (0.28) gives 0, and their medians by height, range and incidence 11 and 14.
NO_REMISSION = RemissionFunction("linear", (0.12, 0.0), 1.0, "hdl-64e", 0.0, "a constant: the scan has no remission")
"""The function of a scan that has no remission: a constant."""

_FEWEST = 300  # points; fewer may have one remission by chance

# Mean difference between the quantiles of converted and of training remission above which the function is replaced. Of
# single KITTI scans it is at most 0.072 (124 scans of 29 drives), of five scans at most 0.033: streets differ. The
# remission of the training sensor itself is converted only if it is far off.
_LIMIT, _LIMIT_OF_TRAINING_SENSOR = 0.08, 0.16
_HYSTERESIS = 0.75  # of the limit, below which a matched function is dropped again
# The same difference without strata, below which the training sensor's own remission is not looked at further: 0.4 in
# place of 7 ms a scan. It is at most 0.082 on single KITTI scans (121), and 0.015 in the median. Where it was below the
# limit, the difference with strata was at most 0.078, also with changed remissions (eleven ways, 21 scans).
_USUAL = 0.1

_SAMPLE = 6000  # points to look at for the range of the remission, and for whether it is usual
_STRATIFIED, _FEWEST_STRATIFIED = 20_000, 1000  # points for its quantiles
_BEYOND_SHARE, _BELOW = 0.01, 0.05  # out of its range, as in `check_fitness`
_OTHER_UNIT = 0.01  # of the range: nothing exceeds it if 0..1 comes where 0..255 is expected

_MISSING = Finding(
    "The scan has no remission, all points have the same: the networks get a constant instead and find fewer cars. "
    "Pass the sensor's remission (intensity, reflectivity) as the fourth column."
)


class RemissionMatcher:
    """Finds the remission function for a sensor's scans: that of the profile, or ``matched`` to the scans; None while
    the profile's fits.

    The quantiles of the raw remission by range and incidence are compared with the training sensor's
    (`edgeperc.preprocess.sensor_fit.match_quantiles`). If the profile's function, or mere scaling, does not give that
    distribution, `sensor_fit.fit_functions` fits a function to the quantiles. Every function increases, so the
    order of remissions is kept. The remission of the training drives was rendered as that of six other sensors: car IoU
    is 79 to 83 with the fitted functions, 83 as recorded (simulation-only network). A polyline through all quantiles
    reproduces the distribution better, but car IoU is up to 6 points lower.
    """

    def __init__(self, sensor: SensorProfile) -> None:
        self.sensor = sensor
        self.matched: RemissionFunction | None = None
        # None for a scan of the training sensor whose remission is usual: then nothing is matched.
        self._samples: tuple[tuple[Ints64, Floats] | None, ...] = ()
        self._reported: frozenset[str] = frozenset()

    @property
    def n_scans(self) -> int:
        """Scans that were used."""
        return len(self._samples)

    @property
    def is_complete(self) -> bool:
        """Whether more scans do not change the function: five were used."""
        return self.n_scans >= FROZEN_AFTER

    def add(self, points: Points) -> tuple[RemissionMatcher, SensorProfile, tuple[Finding, ...]]:
        """A matcher that used one more scan, the sensor with the function for it, and what to say of the remission.

        points : from `returns.returns`, with raw remission. A scan whose remission is out of the profile's range, or in
            another unit, or that has too few points, is not used.
        """
        more = RemissionMatcher(self.sensor)
        vars(more).update(vars(self))
        if is_missing(points):
            return more, replace(self.sensor, remission=NO_REMISSION), more._report(_MISSING)
        if not self.is_complete and self._to in REFERENCES and self.is_in_range(points):
            if self.matched is None and (None in self._samples or self._is_usual(points)):
                more._samples = (*self._samples, None)
            elif len((sample := stratify(points, _STRATIFIED))[0]) >= _FEWEST_STRATIFIED:
                more._samples = (*self._samples, sample)
                more.matched = more._match()
        if more.matched is None:
            return more, self.sensor, ()
        stated = "scaling" if self.sensor.remission is None else f"the {self.sensor.remission.kind}"
        finding = Finding(
            f"The remission after {stated} of the profile {self.sensor.name} is unlike the {self._to}'s: a function is "
            f"matched to the first {FROZEN_AFTER} scans. Check its remission_range, or fit a profile with edgeperc "
            "fit-sensor."
        )
        return more, replace(self.sensor, remission=more.matched), more._report(finding)

    def _report(self, finding: Finding) -> tuple[Finding, ...]:
        """The finding, if it was not reported yet."""
        new = (finding,) if finding not in self._reported else ()
        self._reported |= {*new}
        return new

    @property
    def _to(self) -> str:
        """The sensor that the models were trained on."""
        return NO_REMISSION.to if self.sensor.remission is None else self.sensor.remission.to

    def is_in_range(self, points: Points) -> bool:
        """Whether the remission is in the profile's unit; `check_fitness` reports it if not."""
        with np.errstate(invalid="ignore"):  # a signaling NaN
            raw = points[:: max(1, len(points) // _SAMPLE), 3].astype(np.float64)
        low, high = self.sensor.remission_range
        share = (raw[np.isfinite(raw)] - low) / (high - low)
        return bool(
            len(share)
            and np.count_nonzero(share > 1.0) <= _BEYOND_SHARE * len(share)
            and share.min() >= -_BELOW
            and share.max() >= _OTHER_UNIT
        )

    @property
    def _is_training_sensor(self) -> bool:
        return self.sensor.remission is None and self.sensor.name == self._to

    def _is_usual(self, points: Points) -> bool:
        """Whether the sensor is the training sensor, and the remission of the scan distributed as in its scans."""
        if not self._is_training_sensor:
            return False
        with np.errstate(invalid="ignore"):  # a signaling NaN
            x, y, z, raw = points[:: max(1, len(points) // _SAMPLE)].T.astype(np.float64)
            square = x * x + y * y + z * z
        raw = raw[(square >= RANGE_EDGES_M[0] ** 2) & (square < RANGE_EDGES_M[-1] ** 2) & np.isfinite(raw)]
        if len(raw) < _FEWEST_STRATIFIED:
            return False
        low, high = self.sensor.remission_range
        _, usual = match_quantiles(REFERENCES[self._to], REFERENCES[self._to])
        return float(np.abs(quantiles((raw - low) / (high - low)) - usual).mean()) <= _USUAL

    def _match(self) -> RemissionFunction | None:
        """A function for the scans so far; None if the profile's gives the training sensor's distribution."""
        samples = [sample for sample in self._samples if sample is not None]
        raw, wanted = match_quantiles(quantiles_by_stratum(samples), REFERENCES[self._to])
        if not len(raw):
            return None
        limit = _LIMIT_OF_TRAINING_SENSOR if self._is_training_sensor else _LIMIT
        off = quantile_difference(raw, wanted, self.sensor)
        if off <= limit * (1.0 if self.matched is None else _HYSTERESIS):
            return None
        low, high = self.sensor.remission_range
        source = f"matched to {many(self.n_scans, 'scan')}, quantiles by range and incidence"
        try:
            best = increasing(fit_functions(raw - low, wanted, full_scale=high - low, to=self._to, source=source))
        except SensorError:  # nearly all points have one remission
            return None
        return best if quantile_difference(raw, wanted, replace(self.sensor, remission=best)) < off else None


def quantile_difference(raw: Floats, wanted: Floats, sensor: SensorProfile) -> float:
    """Mean difference between converted quantiles and the training sensor's."""
    points = np.zeros((len(raw), 4), np.float32)
    points[:, 3] = raw
    return float(np.abs(scale(points, sensor)[0][:, 3] - wanted).mean())


def is_missing(points: Points) -> bool:
    """Whether all points, at least 300 with a finite remission, have one: a constant, or 0 without such a field."""
    raw = points[:, 3]
    some = raw[:: max(1, len(raw) // _FEWEST)]  # nearly always, a few points are enough
    if _n_values(some) > 1:
        return False
    return _n_values(raw) == 1 and int(np.count_nonzero(np.isfinite(raw))) >= _FEWEST


def tell_beyond(folder: Path, sensor: SensorProfile, scans: Iterable[tuple[str, Points]]) -> None:
    """Warn if the remission of some of the scans, each with its name, is not in the unit that the profile states."""
    matcher, (low, high) = RemissionMatcher(sensor), sensor.remission_range
    n, beyond = 0, list[tuple[str, float]]()
    for name, points in scans:
        n += 1
        if np.isfinite(points[:, 3]).any() and not (is_missing(points) or matcher.is_in_range(points)):
            beyond.append((name, float(np.nanmax(points[:, 3]))))
    if beyond:
        name, most = beyond[0]
        warnings.warn(
            f"{folder}: of {len(beyond)} of {n} scans, the remission does not fit the range {low:g} to {high:g} of "
            f"{sensor.name}: that of {name} is up to {most:g}. Give the sensor in scans.json the remission_range of "
            "this data",
            stacklevel=3,
        )


def _n_values(raw: Floats32) -> int:
    """0, 1, or 2 for more finite values."""
    finite = raw[np.isfinite(raw)]
    return 0 if not len(finite) else 1 if finite.min() == finite.max() else 2
