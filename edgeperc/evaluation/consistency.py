"""Figures of a drive without labels: each scan's answer, held against what all scans of the drive say."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..ground.planes import heights_above
from ..system.fields import OPTIONS
from ..tracking.smoothing import smooth_tracks
from ..tracking.tracks import Tracks
from ..types.choices import VEHICLES
from ..types.frame import ModelFrame, moved_boxes
from ..types.geometry import inside, wrapped
from ..types.perception import Box, Perception, scan_of
from ..types.points import Floats, Floats32, Mask
from .metrics import FEWEST_RETURNS
from .tables import within

__all__ = ["Consistency"]

_BANDS = {"all": (0.0, math.inf), **{f"{low}-{low + 15} m": (low, low + 15.0) for low in (0, 15, 30, 45)}}
# A vehicle stands if its places, in so many scans with a detection, are this close together along x and y. It is then
# looked for in the scans of a time before and after, up to a distance, by returns at these heights above the ground.
_STANDS_M, _STANDS_SCANS = 1.0, 5
_LOOK_S, _LOOK_M, _OVER_GROUND_M = 3.0, 80.0, (0.3, 4.0)
_CELL_M = 0.2  # in which returns are counted: the view ahead then takes 60 kB a scan, a full turn 240


class Consistency:
    """How consistent the answers of a drive are: what takes no labels to see.

    The tracks of the whole drive (`edgeperc.smooth_tracks`) stand for the truth. A vehicle that stands must also be
    detected in the scans of 3 s before its first and after its last detection, if it returns three points in view. What
    was never tracked is in no figure, and what is half hidden, which labels often leave out, is expected: ``detected``
    compares drives, sensors and distances, and is not the recall of labels.

    Examples
    --------
    >>> consistency = Consistency()                                             # doctest: +SKIP
    >>> for stamp_s, points in scans:                                           # doctest: +SKIP
    ...     perception = perceive(points, stamp_s)
    ...     consistency.add(perception, points, tracker(perception))
    >>> consistency.figures()["classes"]["car"]["30-45 m"]["detected"]          # doctest: +SKIP
    0.82
    """

    def __init__(self) -> None:
        self._scans: list[_Scan] = []

    def add(self, perception: Perception, points: ArrayLike, tracks: Tracks, name: str = "") -> None:
        """Take in the next scan. One that came late or twice does not count.

        Parameters
        ----------
        perception : Perception
        points : (n, 3 or 4) array_like
            The scan that was perceived.
        tracks : Tracks
            What one `Tracker` returned for the perception.
        name : str
            Of the scan, for the figures.

        Raises
        ------
        OptionError, PointsError
            One of them is something else.
        """
        counted = _counted(perception, points)
        (tracks,) = OPTIONS.each("tracks", (tracks,), Tracks)
        if not tracks.is_late:
            self._scans.append(_Scan(name, perception.boxes, tracks, counted))

    def figures(self) -> dict[str, Any]:
        """Compute the figures of the scans so far.

        Returns
        -------
        dict
            ``n_scans``, ``n_drives`` (sessions of the tracker), and ``classes``: by class of the track or of the
            detection, and by distance (``"all"``, ``"0-15 m"``, ``"15-30 m"``, ``"30-45 m"``, ``"45-60 m"``):

            - ``n_objects`` that are in ``n_scans`` scans altogether; ``detected``, the share of these scans in which
              the object was detected; of its detections, the shares with the ``class`` of its track, and with its
              ``heading`` within 90 degrees;
            - ``n_detections``, and the share of them that are ``lone``: where there is no track.

            A share of nothing is None. ``scans`` has for each its name as ``scan``, and the numbers of objects that
            were ``missed`` in it and of ``lone`` detections: those with most are worth a look, or labels, first.

        Raises
        ------
        TrackingError
            The tracks are not those of one recording in order.
        """
        smoothed = smooth_tracks(scan.tracks for scan in self._scans)
        sights = [*_tracked(self._scans, smoothed), *_standing(self._scans, smoothed)]
        detections = [*_detections(self._scans, smoothed)]
        classes = {
            label: {
                band: _row(
                    [sight for sight in sights if sight.label == label and within(sight.range_m, limits)],
                    [box for box in detections if box.label == label and within(box.range_m, limits)],
                )
                for band, limits in _BANDS.items()
            }
            for label in sorted({sight.label for sight in sights} | {box.label for box in detections})
        }
        n_drives = len({scan.tracks.session for scan in self._scans})
        missed = Counter(sight.scan for sight in sights if not sight.is_detected)
        lone = Counter(box.scan for box in detections if box.is_lone)
        scans = [{"scan": scan.name, "missed": missed[k], "lone": lone[k]} for k, scan in enumerate(self._scans)]
        return {"n_scans": len(scans), "n_drives": n_drives, "classes": classes, "scans": scans}


class _Scan(NamedTuple):
    name: str
    boxes: tuple[Box, ...]
    tracks: Tracks
    counted: Floats32  # (k, 4): centers of cells in the frame of the scan [m], and the number of returns in each


class _Sight(NamedTuple):
    """An object in a scan; of its own detection there, whether it has the class and the heading of the object."""

    scan: int
    label: str
    range_m: float
    number: int
    is_detected: bool
    has_class: bool | None = None
    has_heading: bool | None = None


class _Detection(NamedTuple):
    scan: int
    label: str
    range_m: float
    is_lone: bool


def _counted(perception: Perception, points: ArrayLike) -> Floats32:
    """Returns in view that are not on the ground, by cells."""
    seen = scan_of(perception, points)
    if perception.points is not None:
        seen = seen[perception.points.in_view]
    seen = seen[np.abs(seen[:, :3]).max(axis=1) < _LOOK_M]  # finite, too
    low, high = _OVER_GROUND_M
    above_m = heights_above(perception.ground, ModelFrame(perception.mounting).move(seen)).height_m
    cell = np.floor(seen[(above_m > low) & (above_m < high), :3] / _CELL_M).astype(np.int64) + 512  # 0..1023
    number, counts = np.unique(cell @ (1 << 20, 1 << 10, 1), return_counts=True)
    cells = np.column_stack([number >> 20, number >> 10 & 1023, number & 1023]) - 512
    return np.column_stack([(cells + 0.5) * _CELL_M, counts]).astype(np.float32)


def _detections(scans: Sequence[_Scan], smoothed: Sequence[Tracks]) -> Iterator[_Detection]:
    for k, (scan, tracks) in enumerate(zip(scans, smoothed, strict=True)):
        is_lone = np.asarray(~_covers(tracks.boxes, scan.boxes).any(axis=0))
        is_lone[tracks.sources[tracks.sources >= 0]] = False
        for box, mark in zip(scan.boxes, is_lone.tolist(), strict=True):
            yield _Detection(k, box.label, math.hypot(*box.center[:2]), mark)


def _tracked(scans: Sequence[_Scan], smoothed: Sequence[Tracks]) -> Iterator[_Sight]:
    """Objects from their first to their last detection."""
    for k, (scan, tracks) in enumerate(zip(scans, smoothed, strict=True)):
        is_near = np.asarray(_covers(tracks.boxes, scan.boxes).any(axis=1))
        away_m = np.hypot(tracks.boxes[:, 0], tracks.boxes[:, 1])
        for n, (label, source) in enumerate(zip(tracks.labels, tracks.sources.tolist(), strict=True)):
            of_track = k, label, float(away_m[n]), int(tracks.ids[n])
            if source < 0:
                yield _Sight(*of_track, bool(is_near[n]))
            else:
                own = scan.boxes[source]
                is_ahead = abs(wrapped(own.yaw - float(tracks.boxes[n, 6]))) < 0.5 * math.pi
                yield _Sight(*of_track, True, own.label == label, is_ahead)


def _standing(scans: Sequence[_Scan], smoothed: Sequence[Tracks]) -> Iterator[_Sight]:
    """Vehicles that stand, in the scans before their first and after their last detection that show them."""
    lives: dict[int, list[tuple[int, int]]] = {}  # scan and number in it
    for k, tracks in enumerate(smoothed):
        for n, number in enumerate(tracks.ids.tolist()):
            lives.setdefault(number, []).append((k, n))
    for number, life in lives.items():
        n_seen = sum(smoothed[k].sources[n] >= 0 for k, n in life)
        places = np.array([smoothed[k].rows["state"][n, :2] for k, n in life])
        if n_seen < _STANDS_SCANS or np.ptp(places, axis=0).max() > _STANDS_M:
            continue
        (first, _), (last, _) = life[0], life[-1]
        for (of, n), others in ((life[0], range(first - 1, -1, -1)), (life[-1], range(last + 1, len(scans)))):
            end = smoothed[of][n]
            for k in others if end.label in VEHICLES else ():
                tracks, scan = smoothed[k], scans[k]
                if tracks.session != smoothed[of].session or abs(tracks.stamp_s - smoothed[of].stamp_s) > _LOOK_S:
                    break
                R, t = tracks.T_world_sensor[:3, :3], tracks.T_world_sensor[:3, 3]
                (box,) = moved_boxes([end.world_box], (R.T, -R.T @ t))
                n_returns = scan.counted[inside(box, scan.counted), 3].sum()
                if n_returns >= FEWEST_RETURNS and not _covers(tracks.boxes, [box]).any():
                    is_detected = bool(_covers(np.array([[*box.center, *box.size, box.yaw]]), scan.boxes).any())
                    yield _Sight(k, end.label, math.hypot(*box.center[:2]), number, is_detected)


def _covers(rows: Floats, boxes: Sequence[Box]) -> Mask:
    """Whether the footprint of each row, as of `Tracks.boxes`, covers the center of each box, (rows, boxes)."""
    centers = np.array([box.center for box in boxes]).reshape(-1, 3)
    (x, y), yaw = (centers[:, :2] - rows[:, None, :2]).transpose(2, 0, 1), rows[:, 6:]
    along, across = x * np.cos(yaw) + y * np.sin(yaw), y * np.cos(yaw) - x * np.sin(yaw)
    return (np.abs(along) <= 0.5 * rows[:, 3:4]) & (np.abs(across) <= 0.5 * rows[:, 4:5])


def _row(sights: Sequence[_Sight], detections: Sequence[_Detection]) -> dict[str, Any]:
    own = [sight for sight in sights if sight.has_class is not None]
    return {
        "n_objects": len({sight.number for sight in sights}),
        "n_scans": len(sights),
        "detected": _share([sight.is_detected for sight in sights]),
        "class": _share([sight.has_class for sight in own]),
        "heading": _share([sight.has_heading for sight in own]),
        "n_detections": len(detections),
        "lone": _share([box.is_lone for box in detections]),
    }


def _share(marks: Sequence[bool | None]) -> float | None:
    return sum(map(bool, marks)) / len(marks) if marks else None
