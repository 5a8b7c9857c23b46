"""Zones on the ground, and lines that tracked objects cross."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError
from ..system.clock import elapsed_s
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..types.perception import Box
from ..types.points import Floats, Mask, by_axes, read_only
from ..types.rigid import numbers_of
from . import Track, Tracks
from .tracker import FARTHEST_M

FORGET_S = 10.0
"""The last place of a track is kept for so long after its last report: a track that is hidden returns with its id."""


class Zone:
    """An area on the ground.

    Parameters
    ----------
    polygon : (k, 2) array_like
        Corners x, y [m], at least three, in either direction. Of a polygon that crosses itself, parts that it encloses
        twice are outside.

    Attributes
    ----------
    polygon : (k, 2) float64, read-only

    Raises
    ------
    OptionError
        Not such corners, or a corner is not finite or over 1e8 m away.

    Notes
    -----
    The frame is that of what is asked for: the sensor for points and boxes of a scan and by default for tracks, so the
    zone moves with the vehicle; or with ``world=True`` the world frame of the tracker.
    """

    def __init__(self, polygon: ArrayLike) -> None:
        corners = _places("a zone", polygon)
        if len(corners) < 3:
            raise OptionError(f"a zone has {len(corners)} corners; expected at least three")
        self.polygon = corners

    def mark(self, points: ArrayLike) -> Mask:
        """Mark the points that are inside, seen from above.

        Parameters
        ----------
        points : (n, 2 or more) array_like, or a table
            x, y [m]; those of a table by their names.

        Returns
        -------
        (n,) bool
            False for points that are not finite. Of a shared edge of two zones, each point is in one of them.

        Raises
        ------
        PointsError
            The points have another shape, or a table lacks x or y.
        """
        rows = read_only(by_axes(points, "xy")[:, :2], np.float64)
        inside = np.empty(len(rows), np.bool_)
        mark_inside(read_only(self.polygon, np.float64), rows, inside)  # a copy or a pickle may be written
        return inside

    def boxes(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """The boxes whose center is inside, in their order."""
        given = OPTIONS.each("boxes", boxes, Box)
        return tuple(compress(given, self._hold(given)))

    def _hold(self, boxes: Iterable[Box]) -> list[bool]:
        return self.mark(np.array([box.center[:2] for box in boxes], np.float64).reshape(-1, 2)).tolist()

    def tracks(self, tracks: Iterable[Track], *, world: bool = False) -> tuple[Track, ...]:
        """The tracks whose center is inside, in their order.

        Parameters
        ----------
        tracks : iterable of Track
        world : bool
            Whether the zone lies in the world frame of the tracker.

        Returns
        -------
        tuple of Track
        """
        given = OPTIONS.each("tracks", tracks, Track)
        return tuple(compress(given, self._hold(track.world_box if world else track.box for track in given)))


@dataclass(frozen=True, slots=True)
class Crossing:
    """One track that crossed a line.

    Attributes
    ----------
    id : int
        Of the track.
    label : str
    to_left : bool
        Whether it went from the right side of the line to the left, looking from the start of the line to its end.
    stamp_s : float
        Time of the scan after which it was on the other side [s].
    """

    id: int
    label: str
    to_left: bool
    stamp_s: float


class Line:
    """A line on the ground that counts the tracks that cross it.

    Parameters
    ----------
    start, end : (2,) array_like
        x, y [m].
    margin_m : float
        A track is on a side from this distance on [m]. In between, it keeps its side, so an object that stands on the
        line is not counted again and again.
    world : bool
        Whether the line lies in the world frame of the tracker. False: in that of the sensor, so that it moves with the
        vehicle.

    Attributes
    ----------
    to_left, to_right : int
        Number of counted tracks, by direction (`Crossing.to_left`). Each track counts at most once for each direction.

    Raises
    ------
    OptionError
        The line has no length, a number is not finite, or the margin is negative.

    Notes
    -----
    It belongs to one tracker and one run of it: make another one after `Tracker.reset`. If the clock of the scans
    jumps, objects get new ids, and count when they cross the line after the jump.
    """

    def __init__(self, start: ArrayLike, end: ArrayLike, *, margin_m: float = 0.3, world: bool = True) -> None:
        self.start, self.end = (_places("a line", [place])[0] for place in (start, end))
        if not math.dist(self.start, self.end) > 0.0:
            raise OptionError(f"a line from {self.start.tolist()} to itself; expected two places")
        self.margin_m, self.world = OPTIONS.number("margin_m", margin_m, 0.0), world
        self.to_left = self.to_right = 0
        # The time that has passed so far without jumps of the clock, and the stamp of the last scan.
        self._now_s, self._stamp_s = 0.0, math.inf
        # Of each track: the last place beyond the margin, the directions counted so far, and the time it was seen.
        self.known: dict[int, tuple[Floats, frozenset[bool], float]] = {}

    def count(self, tracks: Tracks) -> tuple[Crossing, ...]:
        """Count the tracks that crossed the line since the last scan.

        Parameters
        ----------
        tracks : Tracks
            Of the next scan. OptionError for anything else, such as a list of some of them: it has no time.

        Returns
        -------
        tuple of Crossing
            Those that were counted now. A track counts if its way between two places beyond the margin crosses the line
            between its ends. A late scan (`Tracks.is_late`) counts nothing.
        """
        if not isinstance(tracks, Tracks):
            raise OptionError(f"got a {type(tracks).__name__}; expected the Tracks of a scan, with its time")
        if tracks.is_late:
            return ()
        now_s, known, found = self._now_s + elapsed_s(self._stamp_s, tracks.stamp_s), {**self.known}, []
        for track in tracks:
            place = np.array((track.world_box if self.world else track.box).center[:2])
            last, counted, _ = known.get(track.id, (place, frozenset[bool](), 0.0))
            side = self._left_of(place)
            if abs(side) < self.margin_m:
                # Near the line it keeps its last place, if it had one on a side.
                if track.id in known:
                    known[track.id] = last, counted, now_s
                continue
            if side * self._left_of(last) < 0.0 and (side > 0.0) not in counted and self._between(last, place):
                counted |= {side > 0.0}
                found.append(Crossing(track.id, track.label, side > 0.0, tracks.stamp_s))
            known[track.id] = place, counted, now_s
        known = {k: each for k, each in known.items() if now_s - each[2] <= FORGET_S}
        n_left = sum(crossing.to_left for crossing in found)
        # Last, and without a call in between, so that a count that a signal ends can be repeated.
        self.known, self._now_s, self._stamp_s = known, now_s, tracks.stamp_s
        self.to_left, self.to_right = self.to_left + n_left, self.to_right + len(found) - n_left
        return tuple(found)

    def _left_of(self, place: Floats) -> float:
        """Distance to the left of the line, looking along it [m]."""
        (x, y), (px, py) = self.end - self.start, place - self.start
        return float(x * py - y * px) / math.hypot(x, y)

    def _between(self, last: Floats, place: Floats) -> bool:
        """Whether the way between two places on different sides passes between the ends of the line."""
        before, after = self._left_of(last), self._left_of(place)
        way = last + (place - last) * (before / (before - after)) - self.start
        along = self.end - self.start
        return bool(0.0 <= way @ along <= along @ along)


def _places(name: str, given: Any) -> Floats:
    places = numbers_of(f"{name} has corners that are not numbers", given, OptionError, "(k, 2): x, y")
    if places.ndim != 2 or places.shape[1] != 2 or not (np.abs(places) <= FARTHEST_M).all():
        raise OptionError(f"{name} has corners of shape {places.shape}; expected (k, 2) finite numbers: x, y")
    places.flags.writeable = False
    return places


@njit(cache=True, nogil=True)
def mark_inside(polygon: Floats, points: Floats, inside: Mask) -> None:
    """Mark the points from which a ray along y crosses the polygon an odd number of times."""
    n_corners = polygon.shape[0]
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        odd = False
        for k in range(n_corners):
            ax, ay = polygon[k, 0], polygon[k, 1]
            bx, by = polygon[(k + 1) % n_corners, 0], polygon[(k + 1) % n_corners, 1]
            if ax > bx:  # in either direction, an edge gives the same number
                ax, ay, bx, by = bx, by, ax, ay
            if (ax <= x) & (x < bx) and y < ay + (by - ay) * ((x - ax) / (bx - ax)):
                odd = not odd
        inside[i] = odd and math.isfinite(y)
