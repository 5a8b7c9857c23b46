"""The road in a top view for a planner: its outline as a polygon, the free distance, the lane width.

Everything is in the frame of the models [m]: x forward, y left. Only cells that the scan observed are drivable
(`TopView.observed`): where the sensor saw nothing, and outside the view, nothing is known. The free distance passes
the gaps that the spacing of the beams explains (`TopView.between_beams`), and no others.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from ..errors import OptionError
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..types.frame import ModelFrame
from ..types.geometry import footprints
from ..types.perception import Box, TopView
from ..types.points import Floats, Ints64, Mask
from ..types.views import TopViewGeometry
from .outline import outline_of

if TYPE_CHECKING:
    from ..tracking import Track

FreeEnd = Literal["obstacle", "edge of the road", "unknown", "end of view"]
"""What ends a free distance."""
FREE_ENDS: tuple[FreeEnd, ...] = ("obstacle", "edge of the road", "unknown", "end of view")
BEFORE_OBSTACLE_M = 1.5
"""What ends the road up to this far before an obstacle is the obstacle [m].

The network's road ends a little before a vehicle, and no beam may return from below its bumper. Of the columns with an
obstacle within 5 m of the axis, in 21 scans of KITTI and 12 of PandaSet, 59 and 72 % end less than 1.5 m before it, 1
and 3 % in the next half meter.
"""

USUAL_LANE_M = 3.25
"""Lanes of towns and country roads are 2.75 to 3.75 m wide. A road is divided into lanes nearest to this width."""
LANE_RANGE_M = 20.0
OWN_PLACE = TopViewGeometry((-0.1, 0.0), (-1.0, 1.0), cell_m=0.1)
"""Across the vehicle at its sensor; a truck that cuts in from the next lane has only its front before it."""
BESIDE_M = 2.0
"""The corridor must begin within this distance of the sensor's axis."""


class FreeAhead(NamedTuple):
    """The free distance ahead and what ends it, as x in the frame of the models [m] (see `TopView`).

    Attributes
    ----------
    free_m : float
        Up to which the road is free: the least of the four distances below. NaN if the view has no column there. Nearer
        than the view (6 m) only boxes end it: a wall there is not seen (`edgeperc.occupancy_grid` shows it).
    end : str or None
        What ends it: ``"obstacle"``, ``"edge of the road"``, ``"unknown"`` or ``"end of view"``. It is an obstacle,
        too, if one begins at most 1.5 m farther. None if the view has no column there.
    obstacle_m : float
        First cell of an obstacle: the footprint of a box, also nearer than the view, or a cell with an object's label.
        Infinite if there is none.
    edge_m : float
        First cell that is known and neither road nor an obstacle: a kerb, a hedge, a wall. Infinite if there is none.
    unknown_m : float
        First cell that no ray observed, in a gap larger than the spacing of the beams explains: behind an object,
        beyond the last return, where returns are missing. Infinite if there is none.
    view_m : float
        Far edge of the view.
    """

    free_m: float
    end: FreeEnd | None
    obstacle_m: float
    edge_m: float
    unknown_m: float
    view_m: float


@dataclass(frozen=True, slots=True, eq=False)
class RoadAhead:
    """The road in a top view, in the frame of the models [m] (see `TopView`).

    Attributes
    ----------
    outline : (k, 2) float64
        Corners x, y of the connected road nearest to the sensor, counter-clockwise seen from above, the first not
        repeated. Shape (0, 2) if no cell is drivable. With the holes it is a valid polygon: no ring touches or crosses
        itself or another one.
    holes : tuple of (k, 2) float64
        Obstacles inside the outline: objects, and ground that the scan observed and that is not road; clockwise. Gaps
        inside the road that the scan did not observe are not holes.
    tolerance_m : float
        The outline leaves out no road that is farther than this from the edges of the cells [m]. It is larger than the
        tolerance that was asked for if no outline within that was found that has few enough corners.
    y_m : (columns,) float64
        Middles of the top view's columns, leftmost first.
    free_m : (columns,) float64
        x up to which each column is free, from the near edge of the view: the least of the three distances below and
        of the far edge. It is the near edge if the nearest cell is not free, and less if a box stands before it.
    obstacle_m, edge_m, unknown_m : (columns,) float64
        x of each column's first cell that is an obstacle, the edge of the road, or unknown, as in `FreeAhead`;
        infinite if there is none.
    x_m : (rows,) float64
        Middles of the top view's rows, nearest first.
    left_m, right_m : (rows,) float64
        y of the edges of the corridor ahead. In each row, the corridor is the run of drivable cells that continues the
        run of the row before. NaN before the corridor begins and after it ends, and everywhere if none begins within
        2 m of the sensor's axis. An edge may be the edge of the road, an object, or the edge of what the scan observed.
    lane_width_m : float
        Estimated from the corridor's width across its direction (median of the nearest 20 m of view), because the map
        has no lane markings. The width is divided by the number of lanes, at least one, that gives about 3.25 m. NaN if
        no row has both edges in view.
    """

    outline: Floats
    holes: tuple[Floats, ...]
    tolerance_m: float
    y_m: Floats
    free_m: Floats
    obstacle_m: Floats
    edge_m: Floats
    unknown_m: Floats
    x_m: Floats
    left_m: Floats
    right_m: Floats
    lane_width_m: float
    view_m: float

    @property
    def free_end(self) -> tuple[FreeEnd, ...]:
        """What ends each column's free distance, as in `FreeAhead`."""
        firsts = zip(self.obstacle_m.tolist(), self.edge_m.tolist(), self.unknown_m.tolist(), strict=True)
        return tuple(_end_of((*first, self.view_m)) for first in firsts)

    @property
    def width_m(self) -> Floats:
        """Width of the corridor along y in every row, (rows,); NaN where there is none."""
        return self.left_m - self.right_m

    def free_ahead_m(self, half_width_m: float = 1.0) -> float:
        """x [m] up to which a strip as wide as a vehicle is free: lowest `free_m` within ``half_width_m`` of the axis.

        NaN if the view has no column there.
        """
        return self.free_ahead(half_width_m).free_m

    def free_ahead(self, half_width_m: float = 1.0) -> FreeAhead:
        """As `free_ahead_m`, with what ends it: the nearest of each kind within ``half_width_m`` of the axis.

        Raises
        ------
        OptionError
            ``half_width_m`` is negative or NaN.
        """
        firsts = np.stack([self.obstacle_m, self.edge_m, self.unknown_m])
        return _strip_ahead(self.y_m, firsts, self.view_m, half_width_m)


def road_ahead(
    top_view: TopView, boxes: Iterable[Box | Track] = (), *, tolerance_m: float = 0.2, max_corners: int = 40
) -> RoadAhead:
    """Measure the road in a top view: polygon, free distance and lane width.

    Parameters
    ----------
    top_view : TopView
        Cells that the scan did not observe are not free, whatever their label.
    boxes : iterable of Box or Track
        Obstacles that are not road, such as `Perception.boxes`, in the frame of the scan: the top view has no class for
        pedestrians. Of a track, its ``box``.
    tolerance_m : float
        Largest distance of the polygon from the edges of the cells [m], in both directions; 0 keeps all corners. Gaps
        in the road narrower than twice the tolerance are closed, and road that is connected only over a narrower
        passage is left out. No cell of an object is ever inside.
    max_corners : int
        Largest number of corners of the outline. Corners of cells are used if so few suffice, otherwise some that lie
        anywhere within the tolerance. Where these are too many, more road is left out, up to 1.25, 1.5, 2, 4 or 8 times
        the tolerance from its edges or, at last, any distance (`RoadAhead.tolerance_m`), with all behind the holes
        where these are in the way. No more is added. With a tolerance of 0, there is no limit.

    Returns
    -------
    RoadAhead

    Raises
    ------
    OptionError
        The tolerance is negative or NaN, ``max_corners`` is below 4, or ``top_view`` is none, such as a whole
        perception. Or a box is none, is not finite, or has no length or width: it would stand nowhere.

    Examples
    --------
    >>> found = perceive(points)                            # doctest: +SKIP
    >>> road = road_ahead(found.require_top_view(), found.boxes)       # doctest: +SKIP
    >>> road.free_ahead_m(), road.lane_width_m              # doctest: +SKIP
    (31.4, 3.1)
    """
    OPTIONS.number("tolerance_m", tolerance_m, 0.0, math.inf)
    OPTIONS.whole("max_corners", max_corners, 4, sys.maxsize)
    standing = _standing(top_view, boxes)
    objects = _objects(top_view, standing)
    drivable = np.ascontiguousarray(top_view.drivable & ~objects)
    height, width = drivable.shape
    cell_m, (x_near, x_far), y_left = top_view.cell_m, top_view.x_range_m, top_view.y_range_m[1]
    y_m = _columns_m(top_view)
    x_m = x_far - (np.arange(height, dtype=np.float64)[::-1] + 0.5) * np.float64(cell_m)
    firsts = _first_m(top_view, objects, standing)

    bounds = np.empty((height, 2), np.int64)
    axis = y_left / cell_m  # the column where y is 0
    fill_corridor(drivable, axis - BESIDE_M / cell_m, axis + BESIDE_M / cell_m, bounds)
    bounds = bounds[::-1]
    there = bounds[:, 0] >= 0
    left_m = np.where(there, y_left - bounds[:, 0] * cell_m, np.nan)
    right_m = np.where(there, y_left - bounds[:, 1] * cell_m, np.nan)
    whole = there & (bounds[:, 0] > 0) & (bounds[:, 1] < width) & (x_m < x_near + LANE_RANGE_M)

    found = outline_of(
        drivable,
        (x_far / cell_m - 0.5, y_left / cell_m - 0.5),
        objects,
        objects | (top_view.observed & ~top_view.road),
        # A multiple of a cell's edge may have been rounded down. No distance in the view is larger.
        tolerance=min(float(tolerance_m) / cell_m + 1e-6, float(height + width)) if tolerance_m > 0.0 else 0.0,
        max_corners=int(max_corners),
    )
    at_corner, turned = np.array([x_far, y_left]), np.float64(-cell_m)
    return RoadAhead(
        outline=at_corner + found.outer * turned,
        holes=tuple(at_corner + hole * turned for hole in found.holes),
        tolerance_m=float(tolerance_m) * found.factor,
        y_m=y_m,
        free_m=np.minimum(firsts.min(axis=0), x_far),
        obstacle_m=firsts[0],
        edge_m=firsts[1],
        unknown_m=firsts[2],
        x_m=x_m,
        left_m=left_m,
        right_m=right_m,
        lane_width_m=_lane_width(x_m[whole], left_m[whole], right_m[whole]),
        view_m=float(x_far),
    )


def free_ahead(top_view: TopView, boxes: Iterable[Box | Track] = (), *, half_width_m: float = 1.0) -> FreeAhead:
    """Measure the free distance ahead, without the rest of `road_ahead`, in a fraction of its time.

    Parameters
    ----------
    top_view : TopView
    boxes : iterable of Box or Track
        Obstacles, in the frame of the scan, as for `road_ahead`.
    half_width_m : float
        Half the width of the strip around the sensor's axis [m].

    Returns
    -------
    FreeAhead

    Raises
    ------
    OptionError
        ``half_width_m`` is negative or NaN; or ``top_view`` or a box is none, as for `road_ahead`.

    Examples
    --------
    >>> free_ahead(found.require_top_view(), found.boxes)       # doctest: +SKIP
    FreeAhead(free_m=31.4, end='obstacle', obstacle_m=31.9, edge_m=31.4, unknown_m=33.0, view_m=46.0)
    """
    standing = _standing(top_view, boxes)
    firsts = _first_m(top_view, _objects(top_view, standing), standing)
    return _strip_ahead(_columns_m(top_view), firsts, float(top_view.x_range_m[1]), half_width_m)


def _standing(top_view: TopView, boxes: Iterable[Box | Track]) -> tuple[Box, ...]:
    """Boxes and those of tracks in the frame of the cells. OptionError for what is no top view."""
    if not isinstance(top_view, TopView):
        raise OptionError(f"got a {type(top_view).__name__} for top_view; pass perception.require_top_view()")
    given = OPTIONS.iterator("boxes", boxes, "Box objects or tracks")
    return ModelFrame(top_view.mounting).move_boxes([getattr(each, "box", each) for each in given])


def _objects(top_view: TopView, standing: Sequence[Box]) -> Mask:
    """Cells with an object's label or in the footprint of a box of their frame, (rows, columns) bool."""
    objects = np.ones(top_view.labels.shape, np.bool_)
    for k, name in enumerate(top_view.classes):
        if name in ("background", "drivable"):
            objects &= top_view.labels != k
    return objects | footprints(standing, top_view.geometry) if standing else objects


def _columns_m(top_view: TopView) -> Floats:
    """Middles of the columns, (columns,) y [m]."""
    columns = np.arange(top_view.labels.shape[1], dtype=np.float64)
    return top_view.y_range_m[1] - (columns + 0.5) * np.float64(top_view.cell_m)


def _first_m(top_view: TopView, objects: Mask, standing: Sequence[Box]) -> Floats:
    """x of each column's first obstacle, edge and unknown cell, (3, columns) [m]; infinite without one. A box between
    the sensor and the view is an obstacle, too, but not one in `OWN_PLACE`: it is no road user ahead.
    """
    known, road = top_view.observed, top_view.road
    if top_view.between_beams is not None:
        known = known | top_view.between_beams
    firsts = np.empty((3, objects.shape[1]), np.int64)
    fill_first_cells(objects, np.ascontiguousarray(known), np.ascontiguousarray(road), firsts)
    near_m = top_view.geometry.corner_m[0]
    first_m = np.where(firsts == len(objects), math.inf, near_m + firsts * top_view.cell_m)
    n_before = math.floor(near_m / top_view.cell_m)
    near = [box for box in standing if abs(2.0 * box.center[0] - near_m) < near_m + math.hypot(*box.size[:2])]
    ahead = [box for box in near if not footprints([box], OWN_PLACE).any()]
    if ahead and n_before > 0:
        begin_m = near_m - n_before * top_view.cell_m
        before = TopViewGeometry((begin_m, near_m), top_view.y_range_m, cell_m=top_view.cell_m)
        blocked = footprints(ahead, before)[::-1]
        nearer_m = begin_m + blocked.argmax(axis=0) * top_view.cell_m
        first_m[0] = np.where(blocked.any(axis=0), nearer_m, first_m[0])
    return first_m


def _strip_ahead(y_m: Floats, firsts: Floats, view_m: float, half_width_m: float) -> FreeAhead:
    """The nearest of each kind within ``half_width_m`` of the axis."""
    OPTIONS.number("half_width_m", half_width_m, 0.0, math.inf)
    near = np.abs(y_m) <= half_width_m
    if not near.any():
        return FreeAhead(math.nan, None, math.inf, math.inf, math.inf, view_m)
    distances = (*firsts[:, near].min(axis=1).tolist(), view_m)
    return FreeAhead(min(distances), _end_of(distances), *distances)


def _end_of(distances: tuple[float, ...]) -> FreeEnd:
    """Which of the first obstacle, edge and unknown cell, or the far edge of the view, ends the free distance."""
    least = min(distances)
    return "obstacle" if distances[0] <= least + BEFORE_OBSTACLE_M else FREE_ENDS[distances.index(least)]


def compile_kernels() -> None:
    """Compile what `road_ahead` calls. A `Perceiver` with a top view does this, so that the first call is fast."""
    cells = np.ones((2, 2), np.bool_)
    fill_first_cells(cells, cells, cells, np.empty((3, 2), np.int64))
    fill_corridor(cells, 0.0, 2.0, np.empty((2, 2), np.int64))
    cells = np.ones((9, 9), np.bool_)
    cells[4, 4] = cells[:4, :4] = False  # a ring of six corners, too many
    outline_of(cells, (0.0, 0.0), ~cells, ~cells, tolerance=1.0, max_corners=4)


def _lane_width(x: Floats, left: Floats, right: Floats) -> float:
    if len(x) == 0:
        return math.nan
    # A road at an angle is narrower than its width along y. The median slope is robust against vehicles on the road.
    half = len(x) // 2
    middle = 0.5 * (left + right)
    slope = float(np.median((middle[-half:] - middle[:half]) / (x[-half:] - x[:half]))) if half else 0.0
    width = float(np.median(left - right)) / math.hypot(1.0, slope)
    return width / max(1, round(width / USUAL_LANE_M))


@njit(cache=True, nogil=True)
def fill_first_cells(objects: Mask, known: Mask, road: Mask, firsts: Ints64) -> None:
    """Count the cells of each column, from the last row up, before the first that is an object; that is known and
    neither road nor an object; that is neither known nor an object. The number of rows if there is none.
    """
    height, width = objects.shape
    for kind in range(3):
        for col in range(width):
            firsts[kind, col] = height
    for row in range(height):  # the nearest last
        for col in range(width):
            if objects[row, col]:
                firsts[0, col] = height - 1 - row
            elif not known[row, col]:
                firsts[2, col] = height - 1 - row
            elif not road[row, col]:
                firsts[1, col] = height - 1 - row


@njit(cache=True, nogil=True)
def fill_corridor(drivable: Mask, first: float, last: float, bounds: Ints64) -> None:
    """Follow the drivable cells ahead, from the last row up: first column of the corridor, one past its last, or -1.

    The corridor begins in the last row that has a run of drivable cells between ``first`` and ``last``. It continues
    with the run that shares most columns with the row before, the left one on ties, and ends where no run shares one.
    """
    height, width = drivable.shape
    bounds[:] = -1
    begun = False
    low, high = first, last
    for row in range(height - 1, -1, -1):
        most = 0.0
        col = 0
        while col < width:
            if not drivable[row, col]:
                col += 1
                continue
            start = col
            while col < width and drivable[row, col]:
                col += 1
            shared = min(np.float64(col), high) - max(np.float64(start), low)
            if shared > most:
                most = shared
                bounds[row, 0] = start
                bounds[row, 1] = col
        if most > 0.0:
            begun = True
            low, high = np.float64(bounds[row, 0]), np.float64(bounds[row, 1])
        elif begun:
            return
