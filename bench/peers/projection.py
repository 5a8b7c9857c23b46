"""The projection of a scan to the networks' inputs in edgeperc's kernels and in numpy, whose pixels are the same bit by
bit: what ``edgeperc-bench peers`` times.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc.inference.projection import (
    HEIGHT_RANGE_M,
    Intervals,
    RangeImageProjector,
    TopViewProjector,
    column_edges,
    row_edges,
    tabulate,
)
from edgeperc.types.card import InputSpec
from edgeperc.types.points import Floats32, Heights, Ints, Points
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import RangeImageGeometry, TopViewGeometry

TOP_VIEW = TopViewGeometry()
RANGE_IMAGE = RangeImageGeometry(get_sensor("hdl-64e").elevations_deg)
TOP_VIEW_INPUT = InputSpec("top_view", ("distance", "remission", "height"), (0.0, 0.0, -2.5), (47.07, 1.0, 5.0))
RANGE_IMAGE_INPUT = InputSpec(
    "range_image", ("x", "y", "z", "remission", "range"), (13.0, 0.0, -1.3, 0.23, 14.5), (11.4, 7.9, 0.8, 0.15, 12.3)
)
Selection = tuple[NDArray[np.intp], Ints, Floats32]


class _NumpyProjector:
    """A projector in numpy: the kernel's computation in float32, on all points in one pass."""

    def __init__(self, view: TopViewGeometry | RangeImageGeometry, input: InputSpec) -> None:
        self.shape = (len(input.channels), view.height, view.width)
        self.needs_ground = input.needs_ground
        self.mean, self.std = (np.array(of, np.float32)[:, None] for of in (input.mean, input.std))

    def fill(self, points: Points, image: Floats32, index: Ints, pixel: Ints, height_m: Heights | None = None) -> None:
        """Project into the caller's buffers, as `TopViewProjector.fill`; a height above the ground comes last."""
        rows, flat, rank = self.select(points)
        pixel[:] = -1
        pixel[rows] = flat
        seen, winner = winners(flat, rank, index.reshape(-1), rows)
        image[:] = 0.0
        raw = self.planes(points[winner])
        if height_m is not None:
            raw = np.vstack((raw, np.clip(height_m[winner], *HEIGHT_RANGE_M)))
        image.reshape(len(image), -1)[:, seen] = (raw - self.mean) / self.std

    def select(self, points: Floats32) -> Selection:
        """Rows in view, the flat pixel of each, and its rank: the smallest rank wins the pixel."""
        raise NotImplementedError

    def planes(self, points: Floats32) -> Floats32:
        """Channels of the points that won a pixel, not normalized yet."""
        raise NotImplementedError


class NumpyTopView(_NumpyProjector):
    """`TopViewProjector` in numpy, of the channels distance, remission, height."""

    def __init__(self, view: TopViewGeometry, input: InputSpec) -> None:
        super().__init__(view, input)
        self.low, self.high = np.array([view.x_range_m, view.y_range_m, view.z_range_m], np.float32).T
        self.cells_per_m = np.float32(1.0 / view.cell_m)

    def select(self, points: Floats32) -> Selection:
        # The highest point wins.
        _, height, width = self.shape
        x, y, z, remission = points.T
        rows = np.flatnonzero((x >= self.low[0]) & (x < self.high[0]) & (y >= self.low[1]) & (y < self.high[1]))
        x, y, z, remission = points[rows].T
        inside = (z >= self.low[2]) & (z <= self.high[2]) & np.isfinite(remission)
        rows, x, y, z = rows[inside], x[inside], y[inside], z[inside]
        ahead = np.minimum(((x - self.low[0]) * self.cells_per_m).astype(np.int32), height - 1)
        left = np.minimum(((y - self.low[1]) * self.cells_per_m).astype(np.int32), width - 1)
        flat: Ints = (height - 1 - ahead) * width + (width - 1 - left)
        return rows, flat, -z

    def planes(self, points: Floats32) -> Floats32:
        x, y, z, remission = points.T
        return np.stack((np.sqrt(x * x + y * y), remission, z))


class NumpyRangeImage(_NumpyProjector):
    """`RangeImageProjector` in numpy, for the front quarter: the usual channels and, if wanted, height_above_ground."""

    def __init__(self, view: RangeImageGeometry, input: InputSpec) -> None:
        super().__init__(view, input)
        self.rows, self.cols = tabulate(row_edges(view), "rows"), tabulate(column_edges(view), "columns")

    def select(self, points: Floats32) -> Selection:
        # The nearest point wins.
        rows = np.flatnonzero((points[:, 0] > 0.0) & (np.abs(points[:, 1]) <= points[:, 0]))
        x, y, z, remission = points[rows].T
        squared_distance = x * x + y * y
        squared_range = squared_distance + z * z
        elevation, azimuth = z / (np.sqrt(squared_distance) + np.abs(z)), y / (x + np.abs(y))
        top, bottom, left, right = self.rows.first, self.rows.last, self.cols.first, self.cols.last
        inside = (elevation <= top) & (elevation > bottom) & (azimuth <= left) & (azimuth > right)
        inside &= np.isfinite(squared_range) & np.isfinite(remission)
        flat = look_up(elevation[inside], self.rows) * self.shape[2] + look_up(azimuth[inside], self.cols)
        return rows[inside], flat, squared_range[inside]

    def planes(self, points: Floats32) -> Floats32:
        x, y, z, _ = points.T
        return np.stack((*points.T, np.sqrt(x * x + y * y + z * z)))


def look_up(values: Floats32, table: Intervals) -> Ints:
    """Find the intervals of the values with `tabulate`'s table; takes a third of searchsorted's time."""
    first, _, cells_per_unit, base, split = table
    cells = ((first - values) * cells_per_unit).astype(np.int32)
    return base[cells] + (values <= split[cells])


def winners(flat: Ints, rank: Floats32, index: Ints, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], Ints]:
    """Write into ``index`` the row of the smallest rank, the earlier of two; return the pixels seen and their rows."""
    best = np.full(len(index), np.inf, np.float32)
    np.minimum.at(best, flat, rank)
    # If several values are assigned to one pixel, numpy keeps the last one.
    winning = np.flatnonzero(rank == best[flat])[::-1]
    index[:] = -1
    index[flat[winning]] = rows[winning]
    seen = np.flatnonzero(index >= 0)
    return seen, index[seen]


def contenders(points: Points) -> dict[str, Callable[[], object]]:
    """The calls to measure by their names, each with its own buffers; AssertionError if results differ."""
    calls: dict[str, Callable[[], object]] = {}
    for name, (of_kernels, by_numpy), view, input in (
        ("top view", (TopViewProjector, NumpyTopView), TOP_VIEW, TOP_VIEW_INPUT),
        ("range image", (RangeImageProjector, NumpyRangeImage), RANGE_IMAGE, RANGE_IMAGE_INPUT),
    ):
        results = []
        for title, made in ((name, of_kernels), (f"{name}, numpy", by_numpy)):
            projector: Any = made(view, input)  # type: ignore[arg-type]
            image, index = np.empty(projector.shape, np.float32), np.empty(projector.shape[1:], np.int32)
            results.append((image, index, np.empty(len(points), np.int32)))
            calls[title] = partial(projector.fill, points, *results[-1])
            calls[title]()
        if not all(np.array_equal(own, other) for own, other in zip(*results, strict=True)):
            raise AssertionError(f"{name}: numpy gives other pixels than the kernels")
    return calls
