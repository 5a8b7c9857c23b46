"""A grid for navigation: drivable, obstacle, other ground, and unknown where no ray came."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CardError, OptionError
from ..ground.observed import OVERHEAD_M, Observer
from ..ground.planes import heights_above
from ..preprocess.health import without_drops
from ..preprocess.returns import returns
from ..system.atomic import write_atomic
from ..system.clock import nanoseconds_of
from ..system.fields import OPTIONS
from ..system.kernels import njit
from ..types.frame import ModelFrame, quaternion
from ..types.geometry import footprints
from ..types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from ..types.perception import Perception, TopView, check_perception, scan_of, sensor_behind
from ..types.points import Floats, Floats32, Heights, Ints, Mask, Points, read_only
from ..types.sensor import SensorProfile
from ..types.views import TopViewGeometry
from .around import knows_road, nearest_is_road

ALL_AROUND = TopViewGeometry((-40.0, 40.0), (-40.0, 40.0))
UNKNOWN, FREE, OCCUPIED = -1, 0, 100  # values of nav_msgs/OccupancyGrid


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """What a scan shows of the ground around the vehicle, cell by cell.

    Cells lie in the frame of the models, as those of a `TopView`: x forward, y left [m], the road at z = -1.73 m.

    Attributes
    ----------
    drivable : (rows, columns) bool
        Observed cells of which more than half is road, without an obstacle: by the top view where it sees, elsewhere
        by the points if they have a class ``road``. Row 0 is farthest ahead, column 0 leftmost. All False if there is
        neither.
    obstacle : (rows, columns) bool
        Something stands on the ground: a return above it, or the footprint of a box.
    height_m : (rows, columns) float32
        Height of the highest return or box of an obstacle above the ground [m]; NaN in other cells.
    observed : (rows, columns) bool
        Cells that the scan observed (`edgeperc.ground.observed.Observer`).
    judged : (rows, columns) bool
        Cells that the top view sees, or in whose direction points are in view that know the road.
    cell_m : float
        Edge of a cell [m].
    x_range_m, y_range_m : tuple of 2 float
        Nearest and farthest x, rightmost and leftmost y of the cells [m].
    stamp_s : float or None
        That of the perception.
    mounting : Mounting
        That of the perception. If it is not ``MODEL_MOUNTING``, `edgeperc.ModelFrame` moves points of the scan into
        the frame of the cells.
    """

    drivable: Mask
    obstacle: Mask
    height_m: Heights
    observed: Mask
    judged: Mask
    cell_m: float
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]
    stamp_s: float | None = None
    mounting: Mounting = MODEL_MOUNTING

    @property
    def unknown(self) -> Mask:
        """Cells that no ray observed and no obstacle is known in, (rows, columns) bool."""
        return ~self.observed & ~self.obstacle

    def values(self, off_road: int = OCCUPIED) -> NDArray[np.int8]:
        """Values of a map, (cells along y, cells along x) int8, from the lowest x and y on.

        Parameters
        ----------
        off_road : int
            Value in -1..100 of observed ground that is neither drivable nor an obstacle, such as a pavement.

        Returns
        -------
        ndarray
            -1 unknown, 0 drivable, 100 obstacle.

        Raises
        ------
        OptionError
            ``off_road`` is out of its range.
        """
        off_road = OPTIONS.whole("off_road", off_road, UNKNOWN, OCCUPIED)
        found = np.select([self.unknown, self.obstacle, self.drivable], (UNKNOWN, OCCUPIED, FREE), off_road)
        return np.ascontiguousarray(found[::-1, ::-1].T, np.int8)

    def to_occupancy_grid(self, frame_id: str = "base_link", off_road: int = OCCUPIED) -> dict[str, Any]:
        """Convert to the fields of a ROS message nav_msgs/OccupancyGrid.

        Parameters
        ----------
        frame_id : str
            Name of the frame of the scan: the message's origin turns and moves the cells there.
        off_road : int
            As in `values`.

        Returns
        -------
        dict
            ``header``, ``info`` and ``data`` (n,) int8, row by row from the corner with the lowest x and y. The stamp
            is 0 if the perception has none.

        Raises
        ------
        OptionError
            ``off_road`` is out of its range.
        """
        frame = ModelFrame(self.mounting)
        R, t = (np.eye(3), np.zeros(3)) if frame.is_identity else (frame.R, frame.t)
        corner = R.T @ (np.array([self.x_range_m[0], self.y_range_m[0], -MODEL_HEIGHT_M]) - t)
        return grid_message(
            self.values(off_road), self.cell_m, self.stamp_s, frame_id, corner.tolist(), quaternion(R.T)
        )

    def save_map(self, folder: str | os.PathLike[str], off_road: int = OCCUPIED) -> Path:
        """Write ``map.pgm`` and ``map.yaml`` for nav2's map server (mode trinary).

        Parameters
        ----------
        folder : str or Path
            Created if it does not exist.
        off_road : int
            As in `values`. Other values than -1, 0 and 100 are shades between free and occupied; a map server in mode
            trinary reads most of them as unknown.

        Returns
        -------
        Path
            The YAML file.

        Raises
        ------
        OptionError
            ``off_road`` is out of its range.
        OSError
            The files cannot be written.
        """
        values = self.values(off_road)[::-1].astype(np.int64)  # the first row of an image is its top
        pixels = np.where(values < 0, 205, 254 - values * 254 // 100).astype(np.uint8)
        out = OPTIONS.path("folder", folder)
        out.mkdir(parents=True, exist_ok=True)
        write_atomic(out / "map.pgm", f"P5\n{pixels.shape[1]} {pixels.shape[0]}\n255\n".encode() + pixels.tobytes())
        # 205 stands for an occupancy of 0.1961: above free_thresh, so unknown.
        text = (
            f"image: map.pgm\nmode: trinary\nresolution: {float(self.cell_m)!r}\n"
            f"origin: [{float(self.x_range_m[0])!r}, {float(self.y_range_m[0])!r}, 0.0]\n"
            "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        )
        write_atomic(out / "map.yaml", text.encode())
        return out / "map.yaml"


def check_height(min_height_m: float) -> None:
    """Up to where returns are no obstacles. Raises OptionError."""
    if not 0.0 <= OPTIONS.number("min_height_m", min_height_m) < OVERHEAD_M:
        raise OptionError(f"min_height_m is {min_height_m}; expected meters from 0 to below {OVERHEAD_M:g}")


def grid_message(
    values: NDArray[np.int8],
    cell_m: float,
    stamp_s: float | None,
    frame_id: str,
    corner_m: Sequence[float],
    orientation: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> dict[str, Any]:
    """The fields of a nav_msgs/OccupancyGrid, by corner with the lowest x and y [m] and quaternion of the cells."""
    nanoseconds = nanoseconds_of(stamp_s or 0.0)
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    return {
        "header": {"stamp": stamp, "frame_id": frame_id},
        "info": {
            "map_load_time": dict(stamp),
            "resolution": cell_m,
            "width": values.shape[1],
            "height": values.shape[0],
            "origin": {
                "position": dict(zip("xyz", corner_m, strict=True)),
                "orientation": dict(zip("xyzw", orientation, strict=True)),
            },
        },
        "data": values.reshape(-1),
    }


def occupancy_grid(
    perception: Perception,
    points: ArrayLike,
    *,
    cell_m: float = 0.2,
    x_range_m: tuple[float, float] | None = None,
    y_range_m: tuple[float, float] | None = None,
    min_height_m: float = 0.2,
    sensor: str | os.PathLike[str] | SensorProfile | None = None,
) -> OccupancyGrid:
    """Build a grid for navigation from a perception and its scan.

    Parameters
    ----------
    perception : Perception
        Drivable cells are those of its top view and, where that does not see, cells whose nearest return of the ground
        is a point of the road, if its points have such a class (``sceneseg``); boxes are obstacles.
    points : (n, 4) or (n, 3) array_like, or a structured array
        The scan that was perceived: it has the heights of obstacles, and its rays show what is unknown.
    cell_m : float
        Edge of a cell [m].
    x_range_m, y_range_m : tuple of 2 float, optional
        Bounds of the grid [m], lower first; by default 40 m on all sides if points know the road, else those of the top
        view. The lower one is moved by up to half a cell, so that whole cells lie between them.
    min_height_m : float
        Returns up to this height above the ground are no obstacles [m]. A kerb is 0.1 to 0.2 m high.
    sensor : str, Path or SensorProfile, optional
        Its beams tell which ground was observed between two returns, and its nearest range and ``ego_box`` which points
        are not returns. By default that of the perception.

    Returns
    -------
    OccupancyGrid

    Raises
    ------
    PointsError
        ``points`` is not a scan, or has another number of points than the perceived one.
    OptionError
        The grid has no cell or too many, ``min_height_m`` is not from 0 to 2, or a box is none, as for `road_ahead`.
    SensorError
        The sensor is unknown.

    Notes
    -----
    The heights are above the ground that was perceived. Returns more than 2 m above it, such as those of a tree's
    crown, are no obstacles. Returns and rays decide what is unknown, not the network's labels.

    Its kernel is compiled in the first call, not when a `Perceiver` is made; later processes load it from the cache.

    Examples
    --------
    >>> grid = edgeperc.occupancy_grid(found, points)       # doctest: +SKIP
    >>> grid.save_map("map")                                # doctest: +SKIP
    PosixPath('map/map.yaml')
    """
    check_height(min_height_m)
    check_perception(perception)
    top_view = perception.top_view
    usual = TopViewGeometry() if top_view is None else top_view.geometry
    usual = ALL_AROUND if knows_road(perception.points) else usual
    x_m, y_m = usual.x_range_m if x_range_m is None else x_range_m, usual.y_range_m if y_range_m is None else y_range_m
    try:
        view = TopViewGeometry(x_m, y_m, cell_m=cell_m)
    except (CardError, TypeError, ValueError) as exc:
        raise OptionError(
            f"got cell_m={cell_m!r}, x_range_m={x_range_m!r}, y_range_m={y_range_m!r}: no grid ({exc})"
        ) from exc
    profile = sensor_behind(perception, sensor).upright(perception.mounting)
    frame = ModelFrame(perception.mounting)
    moved = _returns_of(perception, points, profile, frame)
    ground = heights_above(perception.ground, moved)

    shape = (view.height, view.width)
    highest, tallest = np.empty(shape, np.int32), np.empty(shape, np.float32)
    corner = np.array([view.x_range_m[1], view.y_range_m[1], view.cell_m])
    fill_standing(moved, read_only(ground.height_m), corner, float(min_height_m), OVERHEAD_M, highest, tallest)
    observed = Observer(view, profile).observe(moved, highest, perception.mounting).observed
    for box in frame.move_boxes(perception.boxes):
        np.fmax(tallest, np.float32(box.size[2]), out=tallest, where=footprints([box], view))
    obstacle = ~np.isnan(tallest)
    drivable, judged = _drivable(top_view, view)
    if perception.points is not None and knows_road(perception.points):
        around, told = nearest_is_road(moved, perception.points, ground.height_m, view)
        drivable, judged = np.where(judged, drivable, around), judged | told
    return OccupancyGrid(
        drivable=drivable & observed & ~obstacle,  # cells of the top view may be smaller, and observed in part of these
        obstacle=obstacle,
        height_m=tallest,
        observed=observed,
        judged=judged,
        cell_m=view.cell_m,
        x_range_m=(view.corner_m[0], view.x_range_m[1]),
        y_range_m=(view.corner_m[1], view.y_range_m[1]),
        stamp_s=perception.stamp_s,
        mounting=perception.mounting,
    )


class Split(NamedTuple):
    """Points on the ground and points of what stands on it, (n,) bool each; a point is in one of them or in none."""

    ground: Mask
    obstacle: Mask


def split_points(perception: Perception, points: ArrayLike, *, sensor: SensorProfile) -> Split:
    """Separate the ground from what stands on it, by the ground that was perceived; parameters as `occupancy_grid`.

    Ground is at most 0.125 m above and 0.5 m below it; an obstacle is anything higher, crowns and bridges, too. In
    neither are points that are not returns, drops, and reflections from more than 0.5 m below the ground. A scan
    without ground has obstacles only.
    """
    found = heights_above(perception.ground, _returns_of(perception, points, sensor, ModelFrame(perception.mounting)))
    return Split(found.mask, (found.height_m > (0.0 if found.plane else -np.inf)) & ~found.mask)


def _returns_of(perception: Perception, points: ArrayLike, profile: SensorProfile, frame: ModelFrame) -> Points:
    """The scan that was perceived in the frame of the models; NaN in place of what is no return, and of drops."""
    scan = scan_of(perception, points)
    moved = read_only(frame.move(returns(scan, profile, perception.mounting.origin_m)[0]))
    return read_only(without_drops(moved, profile, frame.eye)[0]) if perception.health.has_drops else moved


def _drivable(top_view: TopView | None, view: TopViewGeometry) -> tuple[Mask, Mask]:
    """Cells of ``view`` of which more than half is drivable, and those of which more than half is in the top view."""
    shape = (view.height, view.width)
    if top_view is None:
        return np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    # Each cell is sampled at its middle or, if it is larger than those of the top view, as finely as they are.
    parts = max(1, math.ceil(view.cell_m / top_view.cell_m - 1e-6))
    fine = (np.arange(parts) + 0.5) / parts
    x = view.x_range_m[1] - (np.arange(shape[0])[:, None] + fine).reshape(-1, 1) * view.cell_m
    y = view.y_range_m[1] - (np.arange(shape[1])[:, None] + fine).reshape(1, -1) * view.cell_m
    row, col, in_view = top_view.geometry.cells(*np.broadcast_arrays(x, y))
    found = np.zeros(in_view.shape, np.bool_)
    found[in_view] = top_view.drivable[row[in_view], col[in_view]]
    parted = shape[0], parts, shape[1], parts
    return found.reshape(parted).mean(axis=(1, 3)) > 0.5, in_view.reshape(parted).mean(axis=(1, 3)) > 0.5


@njit(cache=True, nogil=True)
def fill_standing(
    points: Points, height_m: Heights, corner: Floats, lowest: float, overhead: float, highest: Ints, tallest: Floats32
) -> None:
    """Find what stands in each cell of a grid, between the heights ``lowest`` and ``overhead`` above the ground [m].

    corner : x and y of the upper left corner of the grid, edge of a cell [m].
    highest, tallest : the point with the largest height, the first of equals, or -1; its height above ``lowest`` [m],
        or NaN.
    """
    n_rows, n_cols = highest.shape
    for r in range(n_rows):
        for c in range(n_cols):
            highest[r, c] = -1
            tallest[r, c] = np.float32(np.nan)
    for i in range(points.shape[0]):
        row = np.floor((corner[0] - np.float64(points[i, 0])) / corner[2])
        col = np.floor((corner[1] - np.float64(points[i, 1])) / corner[2])
        if not ((row >= 0) & (row < n_rows) & (col >= 0) & (col < n_cols) & (height_m[i] <= overhead)):
            continue
        r, c = int(row), int(col)
        if highest[r, c] < 0 or height_m[i] > height_m[highest[r, c]]:
            highest[r, c] = i
            if height_m[i] > lowest:
                tallest[r, c] = height_m[i]
