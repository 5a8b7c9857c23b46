"""Find the cells of a top view that a scan observed, and those between two beams.

A network labels every cell, including those that the sensor could not see. The rays tell which ones it saw. The scan is
sorted into a polar grid around the sensor, and each sector is followed outwards from one return on the ground to the
next. Between the returns of neighboring beams, the ray to the farther one passes over the ground. Where it passes at
most `CLEARANCE_M` above the ground, nothing higher stands, because it would have stopped the ray. The rest of a gap
that is as long as the spacing of the beams explains lies between two beams: a ray passes it, but higher.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.frame import ModelFrame
from ..types.mounting import MIN_MOUNT_HEIGHT_M, MODEL_MOUNTING, Mounting
from ..types.points import Bytes, Floats, Floats32, Ints, Mask, Points, read_only
from ..types.sensor import SensorProfile
from ..types.views import TopViewGeometry

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
BRIDGE_M = 0.8
"""A gap between two neighboring beams is bridged if the ray over it passes at most this far above the ground [m].

Lower than a child of three years. The ray is highest at the near end of the gap: 0.69 m for the beams of a VLP-16 that
meet the road at 20 and 33 m, 0.57 m for those of an HDL-32E at 25 and 37 m.
"""
BEAM_STEPS = 1.5
"""Two beams are neighbors if their gradients differ by at most this many steps of the sensor's beams there."""
BEAM_TOLERANCE = math.tan(math.radians(1.0))
"""Error of a beam's gradient in the frame of the sensor: the estimated tilt, pitch of the vehicle, calibration."""
OVERHEAD_M = 2.0
"""A return higher above the ground [m], such as a tree's crown or a ceiling, does not observe the cell below it."""

ROAD_Z_M = -1.73  # the road below the sensor
SECTOR_RAD = math.radians(0.4)
MAX_RINGS = 4096
STEEPEST_DEG = 80.0
GRADIENT_BIN = 0.005
SEEN, BETWEEN, PASSED = 1, 2, 3  # states of a bin, from `follow_rays`; 0: no ray says anything
FARTHER = 1.4  # returns up to this many times as far as the view are used, for the rays that pass over it

# A return is on the ground if it is at most MAX_STEP_M + MAX_SLOPE * distance above or below the previous one, with a
# distance of at most MAX_REACH_M: returns that follow a long gap are mostly objects.
MAX_STEP_M = 0.1
MAX_SLOPE = 0.1
MAX_REACH_M = 5.0


class Observation(NamedTuple):
    """What the rays of a scan say about the cells of a top view."""

    # (rows, columns) cells with a return at most 2 m above the ground, and cells between two connected returns on the
    # ground that the ray to the farther one passes at most `CLEARANCE_M` above the ground
    observed: Mask
    # (rows, columns) cells that are not observed in a gap that the spacing of the beams explains: from a return on the
    # ground to the next return of the neighboring beam, whose ray passes at most `BRIDGE_M` above the ground; and
    # before the first return, where its ray passes at most `CLEARANCE_M` above the road
    between_beams: Mask


class Observer:
    """Find the cells of a top view that a scan observed, and those between two beams; one instance per thread.

    Sectors are at least 0.4 degrees and two columns of the sensor wide, so that a missing return leaves no gap.
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
        self.bin_of_cell = (sector * shape[1] + ring).astype(np.int32).reshape(-1)
        self.grid = np.array([first, 1.0 / width, ring_m])
        self.bounds = FARTHER * np.array(
            [(min(low, 0.0), max(high, 0.0)) for low, high in (view.x_range_m, view.y_range_m)]
        )
        # Gradients dz / dx of the beams that meet level ground. A sensor without such beams connects no returns.
        steepest = math.tan(math.radians(STEEPEST_DEG))
        gradients = np.tan(np.deg2rad(np.clip(sensor.elevations_deg, -STEEPEST_DEG, STEEPEST_DEG)))
        downward = gradients[gradients < 0.0]
        widest_step = float(np.abs(np.diff(downward)).max(initial=0.0))
        self.beams = float(downward.min(initial=0.0)), MAX_BEAMS * widest_step
        # Step of the beams around each bin of -gradient, the widest within the tolerance.
        self.steps = np.zeros(int(steepest / GRADIENT_BIN) + 1)
        middles = -(np.arange(len(self.steps)) + 0.5) * GRADIENT_BIN
        for upper, lower in pairwise(gradients.tolist()):
            near = (middles <= upper + BEAM_TOLERANCE) & (middles >= lower - BEAM_TOLERANCE)
            self.steps[near] = np.maximum(self.steps[near], BEAM_STEPS * (upper - lower))
        # Directions of the sectors: x, y from the pseudo-azimuth.
        turn = first + (np.arange(shape[0]) + 0.5) * width
        ahead = np.stack([1.0 - np.abs(turn), np.where(np.abs(turn) <= 1.0, turn, np.copysign(2.0, turn) - turn)])
        self.ahead = ahead / np.maximum(np.hypot(*ahead), 1e-9)
        self.lowest, self._level = np.empty((2, *shape), np.float32)
        self.state = np.empty(shape, np.uint8)
        self._set_mounting(MODEL_MOUNTING)

    def _set_mounting(self, mounting: Mounting) -> None:
        self._mounting = mounting
        # A direction of the models' frame has this much more gradient in the frame of the sensor.
        self._tilt = ModelFrame(mounting).R[:2, 2] @ self.ahead

    def observe(self, points: Points, index: Ints, mounting: Mounting = MODEL_MOUNTING) -> Observation:
        """Find the observed cells, and those between two beams.

        points : with the road at z = -1.73 m, to within 0.6 m.
        index : highest point of each cell, -1 without one (`TopViewProjector`).
        mounting : its height is that of the beams above the road, its tilt tells which beam a ray belongs to. Below 0.5
            m, 1.73 m is used: either the origin of the points is not at the beams, or the rays are so flat that this
            only connects fewer returns.

        Each sector is followed outwards, by the lowest return of each ring of two cells' width. A return is on the
        ground if the line from the last return on the ground is level: it rises or falls by at most 0.1 m and 10 % of
        the distance, with at most 0.6 m in total. The line begins on the road below the sensor. Two returns are
        connected if one beam at most has no return between them, and no return lies below the line: then the ground
        between them is that line. Cells behind objects are observed only if rays pass beside them or above them.

        A gap is bridged up to the next return, but not beyond an object. Which beam is next is read from the profile's
        elevations at the gradient of the last return on the ground, to within 1 degree. The ground before the first
        return is bridged for any beam: there the vehicle itself hides the ground.
        """
        if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32:
            raise PointsError(f"points are {points.shape} {points.dtype}; expected (n, 4) float32")
        if index.shape != self.shape or index.dtype != np.int32:
            raise PointsError(f"index is {index.shape} {index.dtype}; expected {self.shape} int32")
        rows, cells = read_only(points), read_only(index, np.int32)
        observed, between = np.empty((2, *self.shape), np.bool_)
        fill_lowest_returns(rows, self.bounds, self.grid, self.lowest)
        rays = np.array([float(self.grid[2]), beams_above_m(mounting) + ROAD_Z_M, *self.beams])
        if mounting != self._mounting:
            self._set_mounting(mounting)
        follow_rays(self.lowest, rays, self.steps, self._tilt, self._level, self.state)
        mark_cells(rows, cells, self.bin_of_cell, self._level, self.state, observed, between)
        return Observation(observed, between)


def beams_above_m(mounting: Mounting) -> float:
    """Height of the beams above the road [m]; see `Observer.observe`."""
    height_m = mounting.height_m
    return height_m if height_m is not None and height_m >= MIN_MOUNT_HEIGHT_M else -ROAD_Z_M


@njit(cache=True, nogil=True, error_model="numpy")
def fill_lowest_returns(points: Points, bounds: Floats, grid: Floats, lowest: Floats32) -> None:
    """Write the z of the lowest return of each bin of the polar grid, infinite without one.

    bounds : lowest and highest x, and y, of the points that are used [m].
    grid : pseudo-azimuth of the first sector's edge, sectors per unit of it, width of a ring [m]. The pseudo-azimuth is
        y / (|x| + |y|), unfolded to -2..2: it increases with the azimuth, and needs no trigonometry.
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
def follow_rays(lowest: Floats32, rays: Floats, steps: Floats, tilt: Floats, level: Floats32, state: Bytes) -> None:
    """Follow the ground outwards in every sector; parameters (sectors, rings) unless stated otherwise.

    rays : (4,) width of a ring [m]; z of the beams [m], from which all rays start; dz / dx of the lowest beam; largest
        difference of the gradients of two connected returns.
    steps : (n,) largest difference of the gradients of two neighboring beams, by the bin of the lower one's gradient.
    tilt : (sectors,) what a gradient is more in the frame of the sensor.
    level : overwritten; z of the ground [m], on the line between two returns on the ground or that of the last one.
    state : overwritten; `SEEN`: observed (`Observer.observe`); `BETWEEN`: other bins of a gap that is bridged;
        `PASSED`: bins of a longer gap that a ray passes as closely as observed ones.
    """
    n_sectors, n_rings = lowest.shape
    ring_m, z_beams, first_gradient, max_apart = rays[0], rays[1], rays[2], rays[3]
    for sector in range(n_sectors):
        # The last return on the ground: distance, z, gradient of its ray. At first the road below the sensor; it is
        # connected with the return of the lowest beam.
        x_last, z_last, gradient = 0.0, ROAD_Z_M, first_gradient
        begin = 0  # the ring after it, or after a return below the ground
        hidden = False  # by an object after it
        for ring in range(n_rings):
            z = np.float64(lowest[sector, ring])
            rise = z - z_last
            level[sector, ring] = z_last
            state[sector, ring] = SEEN if rise <= OVERHEAD_M else 0
            x = (ring + 0.5) * ring_m
            limit = MAX_STEP_M + MAX_SLOPE * min(x - x_last, MAX_REACH_M)
            if rise < -limit:
                begin = ring + 1
            if not ((rise >= -limit) & (rise <= OVERHEAD_M)):
                continue
            on_ground = rise <= limit
            # Height of the ray above the ground: `height` at x_last, `foot` at x; in between, it is linear.
            height = z_beams + (z - z_beams) * x_last / x - z_last
            foot = 0.0 if on_ground else rise
            share = CLEARANCE_M / height if height > CLEARANCE_M else 1.0
            apart = (z - z_beams) / x - gradient
            step = steps[min(max(int(-(gradient + tilt[sector]) / GRADIENT_BIN), 0), steps.shape[0] - 1)]
            first = x_last == 0.0  # returns before it are those of the vehicle itself
            neighbors = first | (apart <= step)
            highest = BRIDGE_M if neighbors and not first else CLEARANCE_M
            bridged = (first or not hidden) and foot <= highest
            for between in range(begin, ring if on_ground | bridged else begin):
                back = (x - (between + 0.5) * ring_m) / (x - x_last)
                if on_ground:
                    level[sector, between] = z - rise * back
                    if (back <= share) & (apart <= max_apart):
                        state[sector, between] = SEEN
                if bridged & (state[sector, between] != SEEN) & (foot + (height - foot) * back <= highest):
                    state[sector, between] = BETWEEN if neighbors else PASSED
            hidden = not on_ground
            if on_ground:
                level[sector, ring] = z
                x_last, z_last, gradient, begin = x, z, (z - z_beams) / x, ring + 1


@njit(cache=True, nogil=True)
def mark_cells(
    points: Points, index: Ints, bin_of_cell: Ints, level: Floats32, state: Bytes, observed: Mask, between: Mask
) -> None:
    """Mark the observed cells of a top view, and those between two beams, by the bin of each cell's center. `PASSED`
    bins are between two beams where both neighboring sectors are `SEEN` or `BETWEEN`: returns of a single sector are
    missing.
    """
    highest, z_ground, state_of_bin = index.reshape(-1), level.reshape(-1), state.reshape(-1)
    is_observed, is_between = observed.reshape(-1), between.reshape(-1)
    n_rings, n_bins = state.shape[1], state_of_bin.shape[0]
    for cell in range(is_observed.shape[0]):
        at, i = bin_of_cell[cell], highest[cell]
        # A small cell may hold a return that lies in the next bin.
        seen = state_of_bin[at] == SEEN or (i >= 0 and np.float64(points[i, 2]) - z_ground[at] <= OVERHEAD_M)
        is_observed[cell] = seen
        bridged = state_of_bin[at] == BETWEEN
        if state_of_bin[at] == PASSED and n_rings <= at < n_bins - n_rings:
            left, right = state_of_bin[at - n_rings], state_of_bin[at + n_rings]
            bridged = ((left == SEEN) | (left == BETWEEN)) & ((right == SEEN) | (right == BETWEEN))
        is_between[cell] = bridged & (not seen)
