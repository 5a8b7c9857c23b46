"""Suggest the box of the own vehicle: returns near the sensor that stay where they are while the sensor moves.

It is a suggestion for a person to look at, and nothing in the pipeline uses it by itself: a vehicle that drove beside
the sensor in all scans would look the same, and a wrong box hides what stands there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ..errors import SensorError
from ..types.frame import ModelFrame
from ..types.mounting import MODEL_HEIGHT_M, Mounting
from ..types.points import Floats, Floats32, Points
from ..types.sensor import EgoBox, SensorProfile
from .returns import returns

# In KITTI's drives with 10 to 43 such places, 7 to 9 directions fulfil all of these, all on corners of the own roof, as
# in one scan each of 30 drives. In 77 scans of a traffic jam the vehicle is in 3 places: too few to tell the cars
# beside it, which stand as still as it does, from itself.
MIN_PLACES = 10
REACH_M = 3.0  # horizontal
ABOVE_ROAD_M = 0.4  # the road never moves either
BIN_AZIMUTH_DEG, BIN_ELEVATION_DEG = 2.0, 1.0
MIN_PRESENCE = 0.8  # of the places
MAX_SPREAD_M = 0.1  # 10th to 90th percentile of the nearest range
MARGIN_M = 0.1
# Places differ if at most this share of the occupied square meters of either is common to both.
MAX_COMMON = 0.35
_AROUND_M, _HEIGHTS_M = (4.0, 25.0), (0.5, 2.5)


@dataclass(frozen=True)
class EgoSuggestion:
    """The box of the own vehicle, as scans suggest it."""

    box: EgoBox | None  # for `SensorProfile.ego_box` [m]; None if nothing near the sensor stays where it is
    n_places: int  # different places of the vehicle
    n_directions: int  # directions, of 2 by 1 degrees, in which the nearest return stayed


def suggest_ego_box(scans: Iterable[Floats32], sensor: SensorProfile, mounting: Mounting) -> EgoSuggestion:
    """Find returns within 3 m of the sensor that never move with respect to it, while the street does.

    scans : of one sensor on one vehicle, from at least ten places a few meters apart, better from several streets.
    mounting : a known one, for the height of the road.
    """
    frame, plain = ModelFrame(mounting), replace(sensor, ego_box=None)
    x, y = mounting.origin_m
    places: list[frozenset[tuple[int, int]]] = []
    ranges: list[Floats] = []
    n_scans = 0
    for scan in scans:
        n_scans += 1
        cleaned = returns(scan, plain, mounting.origin_m)[0]
        cleaned = cleaned[~np.isnan(cleaned[:, 0])]
        moved = frame.move(cleaned)
        above_m = moved[:, 2] + MODEL_HEIGHT_M
        place = _place(moved, above_m)
        if all(len(place & other) <= MAX_COMMON * len(place | other) for other in places) and place:
            places.append(place)
            near = cleaned[above_m > ABOVE_ROAD_M, :3].astype(np.float64) - [x, y, 0.0]
            ranges.append(_nearest(near[np.hypot(near[:, 0], near[:, 1]) < REACH_M]))
    if len(places) < MIN_PLACES:
        raise SensorError(
            f"the vehicle is in {len(places)} different places in these {n_scans} scans; expected at least "
            f"{MIN_PLACES}, so that what stands beside it is not taken for the vehicle itself: pass scans of a drive"
        )
    presence = np.mean([np.isfinite(each) for each in ranges], axis=0)
    elevation, azimuth = np.nonzero(presence >= MIN_PRESENCE)
    sampled = np.array([each[elevation, azimuth] for each in ranges])
    sampled[np.isinf(sampled)] = np.nan
    if not sampled.size:
        return EgoSuggestion(None, len(places), 0)
    low, middle, high = np.nanpercentile(sampled, (10.0, 50.0, 90.0), axis=0)
    still = high - low <= MAX_SPREAD_M
    if not still.any():
        return EgoSuggestion(None, len(places), 0)
    a = np.radians((azimuth[still] + 0.5) * BIN_AZIMUTH_DEG - 180.0)
    e = np.radians((elevation[still] + 0.5) * BIN_ELEVATION_DEG - 90.0)
    places_m = middle[still] * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    lows, highs = places_m.min(axis=1) - MARGIN_M, places_m.max(axis=1) + MARGIN_M
    (x0, y0, z0), (x1, y1, z1) = (np.round(side, 2).tolist() for side in (lows, highs))
    return EgoSuggestion(((x0, x1), (y0, y1), (z0, z1)), len(places), int(np.count_nonzero(still)))


def _place(moved: Points, above_m: Floats32) -> frozenset[tuple[int, int]]:
    """Square meters around the vehicle on which something stands."""
    flat_m = np.hypot(moved[:, 0], moved[:, 1])
    standing = (flat_m > _AROUND_M[0]) & (flat_m < _AROUND_M[1])
    standing &= (above_m > _HEIGHTS_M[0]) & (above_m < _HEIGHTS_M[1])
    return frozenset(map(tuple, np.unique(np.floor(moved[standing, :2]).astype(int), axis=0).tolist()))


def _nearest(points: Floats) -> Floats:
    """Nearest range [m] in each direction, (180, 180): elevation by azimuth; infinite without a return."""
    x, y, z = points.T
    flat = np.hypot(x, y)
    azimuth = np.floor((np.degrees(np.arctan2(y, x)) + 180.0) / BIN_AZIMUTH_DEG).astype(int)
    elevation = np.floor((np.degrees(np.arctan2(z, flat)) + 90.0) / BIN_ELEVATION_DEG).astype(int)
    n_azimuths, n_elevations = round(360.0 / BIN_AZIMUTH_DEG), round(180.0 / BIN_ELEVATION_DEG)
    nearest = np.full((n_elevations, n_azimuths), np.inf)
    np.minimum.at(nearest, (np.minimum(elevation, n_elevations - 1), azimuth % n_azimuths), np.hypot(flat, z))
    return nearest
