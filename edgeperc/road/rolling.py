"""A grid for navigation that moves with the vehicle, remembers what earlier scans showed, and forgets it again."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CardError, OptionError, StampError, TrackingError
from ..system.clock import GAP_S, LATEST_S, Clock
from ..system.fields import OPTIONS
from ..tracking import Track
from ..tracking.moving import MOVABLE, as_classes, movable_points
from ..types.frame import ModelFrame
from ..types.geometry import footprints
from ..types.mounting import MODEL_HEIGHT_M
from ..types.perception import Perception, check_perception
from ..types.points import Bytes, Floats, Mask
from ..types.rigid import rigid
from ..types.sensor import SensorProfile
from ..types.views import TopViewGeometry
from .grid import FREE, OCCUPIED, UNKNOWN, check_height, grid_message, occupancy_grid

# What a cell holds.
_NOTHING, _ROAD, _OFF_ROAD, _OBSTACLE, _GROUND = range(5)
_FARTHEST_M = 1e8  # of a pose: cells are still counted exactly
_SMALLEST_AREA = 0.05  # of a cell of the road as odometry sees it from above; less: upright, or hanging


class RollingGrid:
    """A grid for navigation in the frame of an odometry: what the scans of the last seconds showed around the vehicle.

    Its cells are fixed to the odometry's frame; the window moves by whole cells and keeps the sensor in its middle.
    Each scan replaces what it observed, so that an obstacle that is gone is cleared where the scan sees the ground, and
    nowhere else: what is hidden now keeps what was known, for `remember_s`. Then it is unknown, never free.

    Objects that could move are not remembered: their cells are unknown again with the next scan, unless it sees them.

    Parameters
    ----------
    size_m : float
        Edge of the window [m].
    cell_m : float
        Edge of a cell [m].
    remember_s : float
        A cell is unknown again when it was not observed for longer than this [s].
    min_height_m : float
        As in `edgeperc.occupancy_grid`.
    classes : collection of str
        Classes of points, boxes and tracks that are not remembered.
    margin_m : float
        Boxes of such objects are grown by this on every side [m].

    Raises
    ------
    OptionError
        A number is out of its range, the grid has too many cells, or ``classes`` is a single name, or of numbers.

    Examples
    --------
    >>> rolling = edgeperc.RollingGrid(remember_s=5.0)       # doctest: +SKIP
    >>> rolling.update(found, points, T_odom_sensor)         # doctest: +SKIP
    >>> message = rolling.to_occupancy_grid("odom")          # doctest: +SKIP
    """

    def __init__(
        self,
        *,
        size_m: float = 40.0,
        cell_m: float = 0.2,
        remember_s: float = 10.0,
        min_height_m: float = 0.2,
        classes: Collection[str] = MOVABLE,
        margin_m: float = 0.3,
    ) -> None:
        self._cell_m = OPTIONS.number("cell_m", cell_m, 0.01, OPTIONS.number("size_m", size_m, 1.0, 1e4))
        self._remember_s = OPTIONS.number("remember_s", remember_s, 0.0, 1e4)
        self._margin_m = OPTIONS.number("margin_m", margin_m, 0.0, 10.0)
        check_height(min_height_m)
        self._min_height_m, self._classes = min_height_m, as_classes(classes)
        n = round(float(size_m) / self._cell_m)
        # A scan's own cells lie around the sensor, turned; in their square, the window fits however it is turned.
        reach_m = (math.ceil(n * math.sqrt(0.5)) + 1) * self._cell_m
        try:
            self._view = TopViewGeometry((-reach_m, reach_m), (-reach_m, reach_m), cell_m=self._cell_m)
        except CardError as exc:
            raise OptionError(f"got size_m={size_m} and cell_m={cell_m}: no grid ({exc})") from exc
        self._kind = np.zeros((n, n), np.uint8)
        self._seen_s = np.full((n, n), -math.inf)
        self._fleeting = np.zeros((n, n), np.bool_)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._clock, self._z_m = Clock(gap_s=max(GAP_S, self._remember_s)), 0.0
        self._corner = (0, 0)  # cells from the odometry's origin to the window's corner with the lowest x and y
        self._forget(np.ones(self._kind.shape, np.bool_))

    def _forget(self, where: Mask) -> None:
        self._kind[where], self._seen_s[where], self._fleeting[where] = _NOTHING, -math.inf, False

    @property
    def stamp_s(self) -> float | None:
        """Time of the newest scan [s]; None before the first."""
        return self._clock.last_s

    @property
    def origin_m(self) -> tuple[float, float]:
        """x and y of the window's corner with the lowest ones, in the frame of the odometry [m]."""
        return self._corner[0] * self._cell_m, self._corner[1] * self._cell_m

    def update(
        self,
        perception: Perception,
        points: ArrayLike,
        T_odom_sensor: ArrayLike,
        *,
        tracks: Iterable[Track] = (),
        sensor: str | os.PathLike[str] | SensorProfile | None = None,
    ) -> None:
        """Take in a scan. A late or doubled one changes nothing; where the clock jumps, everything is forgotten.

        Parameters
        ----------
        perception : Perception
            With its time; a top view says which ground is road.
        points : (n, 4) or (n, 3) array_like, or a structured array
            The scan that was perceived.
        T_odom_sensor : (4, 4) array_like
            Pose of the frame of the scan in that of the odometry, at the time of the scan.
        tracks : iterable of Track
            `Tracks` of this scan: objects that coast are not remembered, either.
        sensor : str, Path or SensorProfile, optional
            As for `edgeperc.occupancy_grid`.

        Raises
        ------
        OptionError
            ``perception`` or a track is none.
        StampError
            The perception has no time.
        TrackingError
            The pose is not rigid, too far, or lays the sensor on its side.
        PointsError, SensorError
            As `edgeperc.occupancy_grid`.
        """
        check_perception(perception)
        tracks = OPTIONS.each("tracks", tracks, Track)
        stamp_s = perception.stamp_s
        if stamp_s is None or not abs(stamp_s) <= LATEST_S:
            raise StampError(f"the perception has the time {stamp_s}; call the perceiver with stamp_s=, in seconds")
        pose = rigid("T_odom_sensor", T_odom_sensor, TrackingError)
        to_odom, z_m = _road_in(pose, perception)
        step, clock = self._clock.after(stamp_s)
        if step == "late":
            self._clock = clock
            return
        grid = occupancy_grid(
            perception,
            points,
            cell_m=self._cell_m,
            x_range_m=self._view.x_range_m,
            y_range_m=self._view.y_range_m,
            min_height_m=self._min_height_m,
            sensor=sensor,
        )
        masks = [grid.unknown, grid.obstacle, grid.drivable, grid.judged]
        kinds = np.select(masks, (_NOTHING, _OBSTACLE, _ROAD, _OFF_ROAD), _GROUND).astype(np.uint8)
        movable = self._movable(perception, points, tracks)
        new = copy.copy(self)  # an update that a signal ends changes nothing
        new._kind, new._seen_s, new._fleeting = self._kind.copy(), self._seen_s.copy(), self._fleeting.copy()
        if step != "next":
            new.reset()
        new._clock, new._z_m = clock, z_m
        new._roll(*(math.floor(along / new._cell_m) - len(new._kind) // 2 for along in pose[:2, 3]))
        new._forget(new._fleeting | (new._seen_s < stamp_s - new._remember_s))
        new._observe(kinds, movable & (kinds == _OBSTACLE), to_odom, stamp_s)
        vars(self).update(vars(new))

    def _movable(self, perception: Perception, points: ArrayLike, tracks: Iterable[Track]) -> Mask:
        """The scan's own cells in which something is that could move."""
        frame = ModelFrame(perception.mounting)
        boxes = [box for box in (*perception.boxes, *(track.box for track in tracks)) if box.label in self._classes]
        grow = np.array([2.0 * self._margin_m, 2.0 * self._margin_m, 0.0])
        grown = [replace(box, size=tuple((box.size + grow).tolist())) for box in frame.move_boxes(boxes)]
        movable = footprints(grown, self._view)
        mark = movable_points(perception, points, classes=self._classes, margin_m=self._margin_m)
        moved = frame.move(points)[mark]
        with np.errstate(over="ignore"):  # sensors that mark what did not return with the largest float
            row, col, in_view = self._view.cells(moved[:, 0], moved[:, 1])
        movable[row[in_view], col[in_view]] = True
        return movable

    def _roll(self, x: int, y: int) -> None:
        """Move the window to another corner; what comes into it is unknown."""
        dx, dy = x - self._corner[0], y - self._corner[1]
        self._corner = x, y
        if not (dx or dy):
            return
        for array in (self._kind, self._seen_s, self._fleeting):
            array[:] = np.roll(array, (-dy, -dx), (0, 1))
        n = len(self._kind)
        was_in = [(np.arange(n) + d >= 0) & (np.arange(n) + d < n) for d in (dy, dx)]
        self._forget(~(was_in[0][:, None] & was_in[1]))

    def _observe(self, kinds: Bytes, fleeting: Mask, to_odom: Floats, stamp_s: float) -> None:
        """Write what a scan shows of its own cells into those of the window."""
        # Every cell of the window asks the scan's cell at its middle, so that none is left out between two of them.
        n = len(self._kind)
        x, y = ((corner + np.arange(n) + 0.5) * self._cell_m for corner in self._corner)
        back = np.linalg.inv(to_odom[:, :2])
        dx, dy = x[None, :] - to_odom[0, 2], y[:, None] - to_odom[1, 2]
        row, col, asked = self._view.cells(back[0, 0] * dx + back[0, 1] * dy, back[1, 0] * dx + back[1, 1] * dy)
        row[~asked], col[~asked] = 0, 0
        seen = np.where(asked, kinds[row, col], np.uint8(_NOTHING))
        # Ground beside the top view: an earlier scan may have seen whether it is road.
        known = (seen == _GROUND) & ((self._kind == _ROAD) | (self._kind == _OFF_ROAD))
        new = (seen != _NOTHING) & ~known
        self._kind[new], self._fleeting[new] = seen[new], fleeting[row, col][new]
        self._seen_s[seen != _NOTHING] = stamp_s
        # Every obstacle of the scan is in the cell that holds its middle, so that none falls between two of them.
        across, along = (axis.ravel() for axis in np.broadcast_arrays(*self._view.cell_centers()))
        at = np.flatnonzero(kinds.ravel() == _OBSTACLE)
        place = np.floor((to_odom @ [across[at], along[at], np.ones(len(at))]) / self._cell_m).astype(np.int64)
        col, row = place - np.array(self._corner)[:, None]
        inside = (row >= 0) & (row < n) & (col >= 0) & (col < n)
        row, col, at = row[inside], col[inside], at[inside]
        self._kind[row, col], self._seen_s[row, col] = _OBSTACLE, stamp_s
        # Of two in one cell, the one that stands there for good is remembered.
        self._fleeting[row, col] = True
        lasting = ~fleeting.ravel()[at]
        self._fleeting[row[lasting], col[lasting]] = False

    def values(self, off_road: int = OCCUPIED, unjudged: int = FREE) -> NDArray[np.int8]:
        """Values of a map at the time of the newest scan, (cells along y, cells along x) int8, from the lowest x and y.

        Parameters
        ----------
        off_road : int
            Value in -1..100 of ground that a top view, or points with a class ``road``, showed not to be road.
        unjudged : int
            Value in -1..100 of observed ground that neither has shown, such as that behind the vehicle at first.

        Returns
        -------
        ndarray
            -1 unknown, 0 drivable, 100 obstacle.

        Raises
        ------
        OptionError
            A value is out of its range.
        """
        off_road = OPTIONS.whole("off_road", off_road, UNKNOWN, OCCUPIED)
        unjudged = OPTIONS.whole("unjudged", unjudged, UNKNOWN, OCCUPIED)
        return np.array((UNKNOWN, FREE, off_road, OCCUPIED, unjudged), np.int8)[self._kind]

    def ages_s(self) -> Floats:
        """Time since each cell was last observed, as of the newest scan [s]; infinite where nothing is known.

        Returns
        -------
        ndarray
            In the order of `values`.
        """
        return (self.stamp_s or 0.0) - self._seen_s

    def to_occupancy_grid(
        self, frame_id: str = "odom", off_road: int = OCCUPIED, unjudged: int = FREE
    ) -> dict[str, Any]:
        """Convert to the fields of a ROS message nav_msgs/OccupancyGrid.

        Parameters
        ----------
        frame_id : str
            Name of the frame of the odometry.
        off_road, unjudged : int
            As in `values`.

        Returns
        -------
        dict
            ``header``, ``info`` and ``data`` (n,) int8, as of `OccupancyGrid.to_occupancy_grid`. The origin lies at the
            height of the road below the sensor and is not turned.

        Raises
        ------
        OptionError
            A value is out of its range.
        """
        corner_m = (*self.origin_m, self._z_m)
        return grid_message(self.values(off_road, unjudged), self._cell_m, self.stamp_s, frame_id, corner_m)


def _road_in(pose: Floats, perception: Perception) -> tuple[Floats, float]:
    """What takes x, y, 1 of the road in the frame of the models to x, y of the odometry, and the road's z there [m]."""
    frame = ModelFrame(perception.mounting)
    R = pose[:3, :3] @ frame.R.T
    t = pose[:3, 3] - R @ frame.t - MODEL_HEIGHT_M * R[:, 2]
    to_odom = np.column_stack([R[:2, :2], t[:2]])
    if np.abs(t).max() > _FARTHEST_M or np.linalg.det(R[:2, :2]) < _SMALLEST_AREA:
        raise TrackingError(
            f"T_odom_sensor puts the road below the sensor at {t.round(1).tolist()}, upright, or upside down; expected "
            f"at most {_FARTHEST_M:g} m, and a frame with z upwards, in which a sensor that hangs is rolled by 180 deg"
        )
    return to_odom, float(t[2])
