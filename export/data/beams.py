"""Scans of the training sensor, or of another dense one, as sensors with other beams would have taken them.

The range image of such a scan is then filled between its beams as at run time (`scan_sets.seen_by_network`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edgeperc.inference.projection import row_edges
from edgeperc.types.mounting import Mounting
from edgeperc.types.sensor import PUBLIC_SENSORS, SENSORS, SensorProfile
from edgeperc.types.views import RangeImageGeometry

from .scans import TRAINING_SENSOR, LabeledScan

# How often one with random beams, a known one that spins and one without beams is drawn.
SHARES = (0.35, 0.45, 0.2)
SPARSE_SHARES = (0.15, 0.6, 0.25)
TRAINED_GAP_DEG = 0.9  # median gap of the beams that is drawn for sparse sensors, at least; they have 1.5
# The training sensor is not drawn; nor are those that came after the shipped networks were trained, whose recipes make
# the same samples again.
_NOT_DRAWN = {
    *(
        "hdl-64e",
        "kitti-raw",
        "kitti-tracking",
        "semantickitti",
        "vod",
        "vlp-16-hi-res",
        "vls-128",
        "pandar40p",
        "pandarqt-64",
        "pandarxt-32m",
    ),
    *("ot128", "jt128", "helios-32", "helios-16", "rs-bpearl", "ruby-plus-128", "once", "waymo"),
}
KNOWN = tuple(sensor for name, sensor in {**SENSORS, **PUBLIC_SENSORS}.items() if name not in _NOT_DRAWN)
SPINNING = tuple(sensor for sensor in KNOWN if sensor.pattern is None)
PATTERNED = tuple(sensor for sensor in KNOWN if sensor.pattern is not None)
ACCUMULATED_S = (0.1, 0.5)  # over which scans of a sensor without beams are gathered
FARTHEST_DEG = 0.4  # a beam is the training sensor's nearest one, if it is no farther away
# The function that maps a sensor's remission is only roughly right.
GAMMA, NOISE = 0.3, 0.03


def drawn_sensor(rng: np.random.Generator, *, sparse: bool = False) -> SensorProfile:
    """One with random beams, a known one that is a little tilted, or one without beams, which may hang upside down.
    ``sparse``: a sparse one; those with 16 and with 32 beams equally often.
    """
    kind = rng.choice(3, p=SPARSE_SHARES if sparse else SHARES)
    spinning, patterned = (
        [each for each in of if not sparse or each.median_gap_deg >= TRAINED_GAP_DEG] for of in (SPINNING, PATTERNED)
    )
    if kind == 0:
        up, down = rng.uniform(0.0, 20.0), rng.uniform(-30.0, -12.0)
        columns = int(rng.choice([900, 1024, 1800, 2048]))
        least, most = (8, int((up - down) / TRAINED_GAP_DEG) + 1) if sparse else (12, 48)
        return SensorProfile.uniform("random", int(rng.integers(least, most + 1)), up, down, columns=columns)
    if kind == 1:
        if sparse:
            n_beams = rng.choice([16, 32])
            spinning = [each for each in spinning if each.n_beams == n_beams]
        sensor, tilt = spinning[rng.integers(len(spinning))], rng.uniform(-0.5, 0.5)
        return replace(sensor, elevations_deg=tuple(round(deg + tilt, 2) for deg in sensor.elevations_deg))
    sensor = patterned[rng.integers(len(patterned))].accumulated(float(rng.uniform(*ACCUMULATED_S)))
    return sensor.upright(Mounting(roll_deg=180.0 if rng.random() < 0.5 else 0.0))


def taken_by(
    sensor: SensorProfile, scan: LabeledScan, rng: np.random.Generator, *, of_any: bool = False
) -> LabeledScan:
    """The points of a scan of the training sensor that another sensor would have; a scan of another one is unchanged,
    with ``of_any`` only that of a sparse one.

    Of the beams of the scan's sensor, those nearest to the other one's remain, with one return in each of its columns.
    Of a sensor without beams, points in its field of view remain at random, as densely as it has them.
    """
    source = scan.sensor or TRAINING_SENSOR
    is_dense = source.pattern is None and source.median_gap_deg < TRAINED_GAP_DEG
    if scan.sensor is not None and not (of_any and is_dense):
        return scan
    points, own = scan.points, np.array(source.elevations_deg)
    slope = points[:, 2] / (np.hypot(points[:, 0], points[:, 1]) + np.abs(points[:, 2]) + 1e-6)
    row = np.searchsorted(-row_edges(RangeImageGeometry(source.elevations_deg)), -slope) - 1
    inside = (row >= 0) & (row < len(own))
    row = np.clip(row, 0, len(own) - 1)
    if sensor.pattern is not None:
        fov_deg = sensor.fov_up_deg - sensor.fov_down_deg
        density = sensor.pattern.points_per_s * sensor.pattern.accumulate_s / (sensor.pattern.width_deg * fov_deg)
        share = 1.0 - np.exp(density * np.gradient(own) * source.azimuth_resolution_deg)
        share[(own > sensor.fov_up_deg) | (own < sensor.fov_down_deg)] = 0.0
        kept = np.nonzero(inside & (rng.random(len(points)) < share[row]))[0]
    else:
        beams = np.array(sensor.elevations_deg)
        apart = np.abs(beams[:, None] - own)
        rows = np.unique(apart.argmin(1)[apart.min(1) <= FARTHEST_DEG])
        step = 2.0 * np.pi / min(sensor.columns, source.columns)
        column = np.floor(np.arctan2(points[:, 1], points[:, 0]) / step).astype(np.int64)
        kept = np.nonzero(inside & np.isin(row, rows))[0]
        if sensor.columns < source.columns:
            kept = np.sort(kept[np.unique(row[kept] * 10_000 + column[kept], return_index=True)[1]])
    remission = points[kept, 3] ** np.float32(np.exp(rng.normal(0.0, GAMMA)))
    remission += rng.normal(0.0, NOISE, len(kept)).astype(np.float32)
    taken = np.column_stack([points[kept, :3], np.clip(remission, 0.0, 1.0)])
    return replace(scan, points=taken.astype(np.float32), labels=scan.labels[kept], sensor=sensor)
