"""The input of a detector on pillars: the points of each cell of a grid (Lang et al., 2019, section 2.1)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..system.kernels import njit
from ..types.card import CHANNELS, InputSpec
from ..types.detector import PillarGeometry
from ..types.points import Floats32, Ints, Ints64, Points, read_only

# What kernels compute, by the channel's place in the card's list of all.
AXES = 3
X, Y, Z, REMISSION, TIME, FROM_MEAN_X = range(6)
FROM_CENTER_X, RANGE = FROM_MEAN_X + AXES, FROM_MEAN_X + 2 * AXES


class PillarGrid(NamedTuple):
    """A grid of pillars as kernels take it: bounds along x, y and z, and edge of a pillar [m]."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    cell: float


class Pillars(NamedTuple):
    """The pillars of a scan, as a network takes them; only the first ones that were written are valid."""

    values: Floats32  # (pillars, points, channels) 0 after the last point of a pillar
    counts: Ints  # (pillars,) points of each pillar
    places: Ints  # (pillars, 4) batch, z, row and column of each: 0, 0, and the cell


class Pillarizer:
    """Makes the pillars of scans in a card's view; `pillars` are overwritten by the next scan.

    values : (max_pillars, points, channels) float32, where their values are written; None: an array of its own.
    """

    def __init__(self, view: PillarGeometry, spec: InputSpec, values: Floats32 | None = None) -> None:
        bounds = (view.x_range_m, view.y_range_m, view.z_range_m)
        x, y, z = ((float(low), float(high)) for low, high in bounds)
        self._grid = PillarGrid((x[0], y[0], z[0]), (x[1], y[1], z[1]), float(view.cell_m))
        self._channels = np.array([CHANNELS["pillars"].index(name) for name in spec.channels], np.int64)
        self._scale = np.array([spec.mean, spec.std], np.float32)
        n, m = view.max_pillars, view.max_points
        values = np.zeros((n, m, len(spec.channels)), np.float32) if values is None else values
        self.pillars = Pillars(values, np.zeros(n, np.int32), np.zeros((n, 4), np.int32))
        self.inputs = [each for each, used in zip(self.pillars, (1, view.num_points, 1), strict=True) if used]
        """Arrays of `pillars` in the order of the graph's inputs (`edgeperc.inference.session.input_shapes`)."""
        self._members = np.empty((n, m), np.int32)
        self._numbers = np.full((view.height, view.width), -1, np.int32)
        self.n_left_out = 0
        """Points of the last scan whose pillars had no room."""

    def fill(self, points: Points) -> int:
        """Write the pillars of points (n, 4) in the frame of the training points; returns how many."""
        points = read_only(points)
        n, self.n_left_out = find_pillars(points, self._grid, self._numbers, self._members, self.pillars)
        fill_pillars(points, self._grid, self._channels, self._scale, self._members, n, self.pillars)
        return n


@njit(cache=True, nogil=True)
def find_pillars(points: Points, grid: PillarGrid, numbers: Ints, members: Ints, pillars: Pillars) -> tuple[int, int]:
    """Write the counts and places of pillars, in the order of their first points; returns how many had room, and the
    number of points in others.

    numbers : (rows, columns) -1 everywhere before and after.
    members : (pillars, points) overwritten; rows of the points of each pillar, the first ones of the scan.
    """
    n_rows, n_columns = numbers.shape
    # In float32 as spconv and mmcv divide: points of sensors that round lie on the edges of cells by the thousand.
    low_x, low_y, low_z = np.float32(grid.low[0]), np.float32(grid.low[1]), np.float32(grid.low[2])
    cell, tall = np.float32(grid.cell), np.float32(grid.high[2] - grid.low[2])
    n, n_left_out = 0, 0
    for i in range(points.shape[0]):
        x, y, z = (points[i, 0] - low_x) / cell, (points[i, 1] - low_y) / cell, (points[i, 2] - low_z) / tall
        inside = (0.0 <= x < n_columns) & (0.0 <= y < n_rows) & (0.0 <= z < 1.0)
        if not (inside & (abs(points[i, 3]) < np.float32(math.inf))):
            continue
        row, column = int(y), int(x)
        k = numbers[row, column]
        if k < 0:
            if n == members.shape[0]:
                n_left_out += 1
                continue
            k = n
            numbers[row, column] = k
            pillars.places[k, 0], pillars.places[k, 1] = 0, 0
            pillars.places[k, 2], pillars.places[k, 3] = row, column
            pillars.counts[k] = 0
            n += 1
        if pillars.counts[k] < members.shape[1]:
            members[k, pillars.counts[k]] = i
            pillars.counts[k] += 1
    for k in range(n):
        numbers[pillars.places[k, 2], pillars.places[k, 3]] = -1
    return n, n_left_out


@njit(cache=True, nogil=True)
def fill_pillars(
    points: Points, grid: PillarGrid, channels: Ints64, scale: Floats32, members: Ints, n: int, pillars: Pillars
) -> None:
    """Write the values of the points of ``n`` pillars, after `find_pillars`; ``scale`` has mean and standard deviation
    of each of the ``channels``, places in the card's list.
    """
    known = np.empty(RANGE + 1)
    mean, center = np.empty(AXES), np.empty(AXES)
    known[TIME] = 0.0
    for k in range(n):
        count = pillars.counts[k]
        for axis in range(AXES):
            mean[axis] = 0.0
        for j in range(count):
            for axis in range(AXES):
                mean[axis] += points[members[k, j], axis]
        for axis in range(AXES):
            mean[axis] /= count
        center[0] = grid.low[0] + (pillars.places[k, 3] + 0.5) * grid.cell
        center[1] = grid.low[1] + (pillars.places[k, 2] + 0.5) * grid.cell
        center[2] = 0.5 * (grid.low[2] + grid.high[2])
        for j in range(count):
            i = members[k, j]
            known[X], known[Y], known[Z], known[REMISSION] = points[i, 0], points[i, 1], points[i, 2], points[i, 3]
            for axis in range(AXES):
                known[FROM_MEAN_X + axis] = known[axis] - mean[axis]
                known[FROM_CENTER_X + axis] = known[axis] - center[axis]
            known[RANGE] = math.sqrt(known[X] ** 2 + known[Y] ** 2 + known[Z] ** 2)
            for c in range(channels.shape[0]):
                pillars.values[k, j, c] = (known[channels[c]] - scale[0, c]) / scale[1, c]
        for j in range(count, members.shape[1]):
            for c in range(channels.shape[0]):
                pillars.values[k, j, c] = np.float32(0.0)
