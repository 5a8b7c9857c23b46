"""Points on things that move, and on things that could move: what a map should not contain."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..types.choices import VEHICLES
from ..types.perception import Box, Perception, scan_of
from ..types.points import Floats, Mask, Points, as_points, read_only
from . import Track

PEOPLE = frozenset({"pedestrian", "person", "person_sitting", "cyclist", "bicyclist", "motorcyclist"})
MOVABLE = frozenset(
    {
        *VEHICLES,
        *("bus", "tram", "trailer", "vehicle", "motorcycle", "bicycle"),
        *("construction_vehicle", "emergency_vehicle", "other_vehicle", "other-vehicle", "on-rails"),  # of data sets
        *PEOPLE,
    }
)
"""Classes of points and boxes that can move on their own or are moved by people."""


def as_classes(names: Collection[str]) -> frozenset[str]:
    """Names of classes; OptionError for numbers of classes, or a single name, whose letters would be the classes."""
    if isinstance(names, str | bytes) or not isinstance(names, Iterable):
        raise OptionError(f"classes is {names!r}; expected a collection of names, such as {{{names!r}}}")
    return frozenset(OPTIONS.each("classes", names, str))


def moving_tracks(
    tracks: Iterable[Track], *, min_speed_mps: float | None = None, n_sigmas: float = 3.0
) -> tuple[Track, ...]:
    """The tracks that move over ground, in their order, faster than ``min_speed_mps`` (by default
    `Track.moving_mps`) and than ``n_sigmas`` standard deviations of their speed.

    A new track has no certain speed, so it does not count as moving in its first scans. Tracks that coast count.
    """
    least = None if min_speed_mps is None else OPTIONS.number("min_speed_mps", min_speed_mps, 0.0)
    n_sigmas, found = OPTIONS.number("n_sigmas", n_sigmas, 0.0), []
    for track in OPTIONS.each("tracks", tracks, Track):
        slowest = track.moving_mps if least is None else least
        speed, sigma = abs(float(track.state[2])), math.sqrt(max(float(track.covariance[2, 2]), 0.0))
        if speed > max(slowest, n_sigmas * sigma):
            found.append(track)
    return tuple(found)


def moving_points(
    tracks: Iterable[Track],
    points: ArrayLike,
    *,
    margin_m: float = 0.2,
    min_speed_mps: float | None = None,
    n_sigmas: float = 3.0,
) -> Mask:
    """Mark the points inside the boxes of tracks that move over ground.

    Parameters
    ----------
    tracks : iterable of Track
        `Tracks` of this scan. Their speed is over ground: the motion of the sensor is taken out, with poses or without.
    points : (n, 3 or 4) array_like
        The scan: x, y, z [m] in the frame of the sensor.
    margin_m : float
        Boxes are grown by this on every side [m].
    min_speed_mps, n_sigmas
        As in `moving_tracks`.

    Returns
    -------
    (n,) bool
        False for points that are not finite.

    Raises
    ------
    OptionError
        An option is negative or not finite, or a track is none.
    PointsError
        ``points`` is not a scan.
    """
    moving = moving_tracks(tracks, min_speed_mps=min_speed_mps, n_sigmas=n_sigmas)
    return inside_boxes([track.box for track in moving], as_points(points), margin_m)


def movable_points(
    perception: Perception, points: ArrayLike, *, classes: Collection[str] = MOVABLE, margin_m: float = 0.2
) -> Mask:
    """Mark the points on things that could move, whether they move or not: by the classes of points and by boxes.

    Parameters
    ----------
    perception : Perception
        Of this scan.
    points : (n, 3 or 4) array_like
        The scan: x, y, z [m] in the frame of the sensor.
    classes : collection of str
        Classes that could move. Others, such as those of a network of your own, must be added.
    margin_m : float
        Boxes are grown by this on every side [m].

    Returns
    -------
    (n,) bool
        True for points of these classes, and for points in a box of these classes.

    Raises
    ------
    OptionError
        ``margin_m`` is negative or not finite, or ``classes`` is a single name, or of numbers.
    PointsError
        ``points`` is not the scan of the perception.
    """
    scan, classes = scan_of(perception, points), as_classes(classes)
    found = inside_boxes([box for box in perception.boxes if box.label in classes], scan, margin_m)
    if perception.points is not None:
        numbers = [k for k, name in enumerate(perception.points.classes) if name in classes]
        found |= np.isin(perception.points.labels, numbers) & perception.points.in_view
    return found


def inside_boxes(boxes: list[Box], points: Points, margin_m: float) -> Mask:
    """Mark the points (n, 3 or 4) inside at least one box, grown by a margin on every side."""
    margin_m = OPTIONS.number("margin_m", margin_m, 0.0)
    rows = [
        (*box.center, *(size / 2.0 + margin_m for size in box.size), math.cos(box.yaw), math.sin(box.yaw))
        for box in boxes
    ]
    inside = np.empty(len(points), np.bool_)
    mark_in_boxes(read_only(np.array(rows, np.float64).reshape(-1, 8), np.float64), read_only(points), inside)
    return inside


@njit(cache=True, nogil=True)
def mark_in_boxes(boxes: Floats, points: Points, inside: Mask) -> None:
    """Mark the points inside at least one box: center, half length, width and height [m], cosine and sine of yaw."""
    for i in range(points.shape[0]):
        inside[i] = False
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
        for k in range(boxes.shape[0]):
            dx, dy = x - boxes[k, 0], y - boxes[k, 1]
            if (
                abs(z - boxes[k, 2]) <= boxes[k, 5]
                and abs(dx * boxes[k, 6] + dy * boxes[k, 7]) <= boxes[k, 3]
                and abs(dy * boxes[k, 6] - dx * boxes[k, 7]) <= boxes[k, 4]
            ):
                inside[i] = True
                break
