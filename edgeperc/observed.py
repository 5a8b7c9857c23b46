"""Find the cells of a top view that a scan observed: cells with returns, and cells that a ray passes closely.

A network labels every cell, including those that the sensor could not see. The rays tell which ones it saw. The scan is
sorted into a polar grid around the sensor, and each sector is followed outwards from one return on the ground to the
next. Between the returns of neighboring beams, the ray to the farther one passes over the ground. Where it passes at
most `CLEARANCE_M` above the ground, nothing higher stands, because it would have stopped the ray.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .card import TopViewGeometry
from .errors import PointsError
from .kernel_cache import njit
from .points import read_only
from .sensor import SensorProfile

__all__ = ["CLEARANCE_M", "OVERHEAD_M", "Observer", "fill_lowest_returns", "follow_rays", "mark_cells"]

CLEARANCE_M = 0.5
"""A ray observes the ground that it passes at most this far above [m].

Anything higher is seen: vehicles, people, a child. At the far edge of the view, 46 m, a ray of an HDL-64E passes 0.27 m
above the return of the beam below it, so its road is observed without gaps, even if one beam has no return. A VLP-16,
whose beams are 2 degrees apart, observes the road without gaps up to 20 m; farther out there are gaps between its
returns. In 10 simulated scenes, an HDL-64E observes 82 % of all road, an OS1-64 80 % and a VLP-16 54 %; with 0.3 m
82, 71 and 39 %, with 0.7 m 82, 81 and 62 %. Objects hide about 16 % from any sensor at this place.
"""
MAX_BEAMS = 2.2
"""Two returns on the ground are connected if their beams are at most this many steps of the sensor's beams apart.

One beam may have no return. In a wider gap the ground itself is missing: a pit, water, a floor that reflects nothing.
"""
OVERHEAD_M = 2.0
"""A return higher above the ground [m], such as a tree's crown or a ceiling, does not observe the cell below it."""

ROAD_Z_M = -1.73  # the road below the sensor
MIN_MOUNT_HEIGHT_M = 0.5
SECTOR_RAD = math.radians(0.4)
MAX_RINGS = 4096
FARTHER = 1.4  # returns up to this many times as far as the view are used, for the rays that pass over it

# A return is on the ground if it is at most MAX_STEP_M + MAX_SLOPE * distance above or below the previous one, with a
# distance of at most MAX_REACH_M: returns that follow a long gap are mostly objects.
MAX_STEP_M = 0.1
MAX_SLOPE = 0.1
MAX_REACH_M = 5.0


class Observer:
    """Find the cells of a top view that a scan observed.

    Tables and scratch are made once and reused between calls, so use one instance per thread.

    Parameters
    ----------
    view : TopViewGeometry
    sensor : SensorProfile
        Its columns and beams. Sectors are at least 0.4 degrees wide, and at least two columns, so that a missing return
        leaves no gap.
    """

    def __init__(self, view: TopViewGeometry, sensor: SensorProfile) -> None:
        self.shape = (view.height, view.width)
        x, y = np.broadcast_arrays(*view.cell_centers())
        length = np.abs(x) + np.abs(y)
        folded = y / np.where(length > 0.0, length, 1.0)
        azimuth = np.where(x >= 0.0, folded, np.copysign(2.0, y) - folded)
        distance_m = np.hypot(x, y)
        width = max(SECTOR_RAD, 4.0 * math.pi / sensor.columns)
        ring_m = max(2.0 * view.cell_m, FARTHER * float(distance_m.max()) / MAX_RINGS)
        first = float(azimuth.min())
        sector, ring = ((azimuth - first) / width).astype(np.int64), (distance_m / ring_m).astype(np.int64)
        shape = (int(sector.max()) + 1, int(FARTHER * ring.max()) + 2)
        self._bin_of_cell = (sector * shape[1] + ring).astype(np.int32).reshape(-1)
        self._grid = np.array([first, 1.0 / width, ring_m])
        self._bounds = FARTHER * np.array(
            [(min(low, 0.0), max(high, 0.0)) for low, high in (view.x_range_m, view.y_range_m)]
        )
        # Gradients dz / dx of the beams that meet level ground. A sensor without such beams connects no returns.
        gradients = np.tan(np.deg2rad([max(angle, -80.0) for angle in sensor.elevations_deg if angle < 0.0]))
        widest_step = float(np.abs(np.diff(gradients)).max(initial=0.0))
        self._beams = float(gradients.min(initial=0.0)), MAX_BEAMS * widest_step
        self._lowest, self._level = np.empty((2, *shape), np.float32)
        self._seen = np.empty(shape, np.bool_)

    def observe(
        self, points: NDArray[np.float32], index: NDArray[np.int32], mount_height_m: float = 1.73
    ) -> NDArray[np.bool_]:
        """Find the observed cells.

        Parameters
        ----------
        points : (n, 4) float32
            x, y, z [m] in the sensor frame with the road at z = -1.73 m, to within 0.6 m, and remission. May be empty;
            rows that are not finite are ignored.
        index : (rows, columns) int32
            Highest point of each cell, -1 without one (`TopViewProjector`).
        mount_height_m : float
            Height of the beams above the road [m]. Below 0.5 m, 1.73 m is used: either the origin of the points is not
            at the beams, or the rays are so flat that this only connects fewer returns.

        Returns
        -------
        (rows, columns) bool
            True for a cell with a return at most 2 m above the ground, and for a cell between two connected returns on
            the ground that the ray to the farther one passes at most 0.5 m above the ground.

        Raises
        ------
        PointsError
            An array has another shape or dtype.

        Notes
        -----
        Each sector is followed outwards, by the lowest return of each ring of two cells' width. A return is on the
        ground if the line from the last return on the ground is level: it rises or falls by at most 0.1 m and 10 % of
        the distance, with at most 0.6 m in total. The line begins on the road below the sensor. Two returns are
        connected if one beam at most has no return between them, and no return lies below the line: then the ground
        between them is that line. Cells behind objects are observed only if rays pass beside them or above them. Cells
        beyond the last return are not observed.
        """
        if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
            raise PointsError(f"points are {points.shape} {points.dtype}; expected (n, 4) float32")
        if index.shape != self.shape or index.dtype != np.int32:
            raise PointsError(f"index is {index.shape} {index.dtype}; expected {self.shape} int32")
        rows, of_cell = read_only(points), read_only(index, np.int32)
        observed = np.empty(self.shape, np.bool_)
        fill_lowest_returns(rows, self._bounds, self._grid, self._lowest)
        z_beams = mount_height_m + ROAD_Z_M if mount_height_m >= MIN_MOUNT_HEIGHT_M else 0.0
        follow_rays(self._lowest, float(self._grid[2]), z_beams, *self._beams, self._level, self._seen)
        mark_cells(rows, of_cell, self._bin_of_cell, self._level, self._seen, observed)
        return observed


@njit(cache=True, nogil=True, error_model="numpy")
def fill_lowest_returns(
    points: NDArray[np.float32],
    bounds: NDArray[np.float64],
    grid: NDArray[np.float64],
    lowest: NDArray[np.float32],
) -> None:
    """Write the lowest return of each bin of the polar grid.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
    bounds : (2, 2) float64
        Lowest and highest x, and y, of the points that are used [m].
    grid : (3,) float64
        Pseudo-azimuth of the first sector's edge, sectors per unit of pseudo-azimuth, width of a ring [m]. The
        pseudo-azimuth is y / (|x| + |y|), unfolded to -2..2. It increases with the azimuth, and needs no trigonometry.
    lowest : (sectors, rings) float32, overwritten
        z [m]; infinite without a return.
    """
    lowest[:] = np.float32(math.inf)
    n_sectors, n_rings = lowest.shape
    flat = lowest.reshape(-1)
    x_min, x_max, y_min, y_max = bounds[0, 0], bounds[0, 1], bounds[1, 0], bounds[1, 1]
    first, sectors_per_unit, rings_per_m = grid[0], grid[1], 1.0 / grid[2]
    for i in range(points.shape[0]):
        x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), points[i, 2]
        if not ((x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max) & (abs(z) < np.float32(math.inf))):
            continue
        length = abs(x) + abs(y)
        if length == 0.0:
            continue
        azimuth = y / length
        if x < 0.0:
            azimuth = math.copysign(2.0, y) - azimuth
        sector = (azimuth - first) * sectors_per_unit
        ring = math.sqrt(x * x + y * y) * rings_per_m
        if (sector >= 0.0) & (sector < n_sectors) & (ring < n_rings):
            at = int(sector) * n_rings + int(ring)
            flat[at] = min(flat[at], z)


@njit(cache=True, nogil=True)
def follow_rays(
    lowest: NDArray[np.float32],
    ring_m: float,
    z_beams: float,
    first_gradient: float,
    max_apart: float,
    level: NDArray[np.float32],
    seen: NDArray[np.bool_],
) -> None:
    """Follow the ground outwards in every sector.

    Parameters
    ----------
    lowest : (sectors, rings) float32
        From `fill_lowest_returns`.
    ring_m : float
        Width of a ring [m].
    z_beams : float
        z of the beams [m], from which all rays start.
    first_gradient : float
        dz / dx of the lowest beam.
    max_apart : float
        Largest difference of the gradients of two connected returns.
    level : (sectors, rings) float32, overwritten
        z of the ground [m]: on the line between two returns on the ground; that of the last one beyond it.
    seen : (sectors, rings) bool, overwritten
        Bins with a return below `OVERHEAD_M`, and bins between two connected returns that the ray to the farther one
        passes at most `CLEARANCE_M` above the ground.
    """
    n_sectors, n_rings = lowest.shape
    for sector in range(n_sectors):
        # The last return on the ground: distance, z, gradient of its ray. At first the road below the sensor; it is
        # connected with the return of the lowest beam.
        x_last, z_last, gradient = 0.0, ROAD_Z_M, first_gradient
        begin = 0  # the ring after it, or after a return below the ground
        for ring in range(n_rings):
            z = np.float64(lowest[sector, ring])
            rise = z - z_last
            level[sector, ring] = z_last
            seen[sector, ring] = rise <= OVERHEAD_M
            x = (ring + 0.5) * ring_m
            limit = MAX_STEP_M + MAX_SLOPE * min(x - x_last, MAX_REACH_M)
            if rise < -limit:
                begin = ring + 1
            if not abs(rise) <= limit:
                continue
            # The ray is on the ground at x and this high above it at x_last; in between, its height is linear.
            height = z_beams + (z - z_beams) * x_last / x - z_last
            share = CLEARANCE_M / height if height > CLEARANCE_M else 1.0
            apart = (z - z_beams) / x - gradient
            for between in range(begin, ring):
                back = (x - (between + 0.5) * ring_m) / (x - x_last)
                level[sector, between] = z - rise * back
                seen[sector, between] |= (back <= share) & (apart <= max_apart)
            level[sector, ring] = z
            x_last, z_last, gradient, begin = x, z, (z - z_beams) / x, ring + 1


@njit(cache=True, nogil=True)
def mark_cells(
    points: NDArray[np.float32],
    index: NDArray[np.int32],
    bin_of_cell: NDArray[np.int32],
    level: NDArray[np.float32],
    seen: NDArray[np.bool_],
    observed: NDArray[np.bool_],
) -> None:
    """Mark the observed cells of a top view.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
    index : (rows, columns) int32, C-contiguous
        Highest point of each cell, -1 without one.
    bin_of_cell : (rows * columns,) int32
        Flat bin of each cell's center.
    level : (sectors, rings) float32, C-contiguous
    seen : (sectors, rings) bool, C-contiguous
    observed : (rows, columns) bool, C-contiguous, overwritten
    """
    highest, z_ground, seen_bin, marked = index.reshape(-1), level.reshape(-1), seen.reshape(-1), observed.reshape(-1)
    for cell in range(marked.shape[0]):
        at, i = bin_of_cell[cell], highest[cell]
        # A small cell may hold a return that lies in the next bin.
        marked[cell] = seen_bin[at] or (i >= 0 and np.float64(points[i, 2]) - z_ground[at] <= OVERHEAD_M)
