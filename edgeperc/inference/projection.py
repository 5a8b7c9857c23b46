"""Project points to the networks' inputs, and keep which pixel belongs to which point.

Two views: the ground ahead seen from above (`TopViewProjector`) and the scan seen from the sensor
(`RangeImageProjector`). Both write normalized pixels straight into the network's input buffer.

Pixels are computed in float32 with one rounding per operation. Compiled code, interpreted code and any other
implementation of the same steps therefore agree on every pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..errors import CardError, PointsError
from ..ground.planes import find_ground
from ..system.kernels import njit
from ..types.card import CHANNELS, InputSpec
from ..types.frame import OF_MODELS, ModelFrame
from ..types.mounting import MODEL_HEIGHT_M
from ..types.points import Floats32, Heights, Ints, Ints64, Points, read_only
from ..types.views import RangeImageGeometry, TopViewGeometry

# Number of each channel in the kernels. "height" is z; "distance" is the range in the x-y plane.
CHANNEL_CODES = {"x": 0, "y": 1, "z": 2, "height": 2, "remission": 3, "distance": 4, "range": 5}
CHANNEL_CODES["height_above_ground"] = 6
CURVATURE = CHANNEL_CODES["curvature"] = 7  # of pixels and their neighbors, not of points: by `fill_curvature`
HEIGHT_RANGE_M = (-1.0, 5.0)  # heights above the ground are clipped to it; what is farther off is seldom an object
LEVEL_M = np.float32(0.15)  # points this near to the ground say how much noise bends the range
FEWEST_LEVEL = 500
# Of KITTI the ground bends by 0.016 m in the median, with 2 cm of noise along the rays by 0.039. With 3 cm, 60 % of the
# walls on SemanticKITTI became vegetation, and 6 % with the rest taken off.
LEVEL_BEND_M = np.float32(0.04)
VARIANCE_OF_MEDIAN = np.float32(0.6745**-2)  # of a normal distribution, for the squared median of its absolute values

# The nearest point of a pixel is the smallest of `rank << 32 | row of points`: the better rank wins, then the earlier
# point. Ranks are the bits of floats, so those of finite points lie below infinity's.
INFINITE_RANK = np.int32(0x7F80_0000)
EMPTY = np.int64(0x7F80_0000 << 32)
LOW_WORD = np.int64(0xFFFF_FFFF)

ZERO = np.float32(0.0)
ONE, TWO = np.float32(1.0), np.float32(2.0)
INFINITY = np.float32(math.inf)
LOWEST, HIGHEST = np.float32(HEIGHT_RANGE_M[0]), np.float32(HEIGHT_RANGE_M[1])

# Points and pixels per block: the intermediate values of a block fit into the first-level cache.
BLOCK = 256
PIXEL_BLOCK = 64


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """A scan projected to one view."""

    # (C, H, W) the network's input: ``(raw - mean) / std`` per channel; 0 in every channel of a pixel without a return
    image: Floats32
    index: Ints  # (H, W) row of the point whose values the pixel has; -1 without a return
    # (n,) flat pixel ``row * W + column`` of every point, even if another point won that pixel; -1 for points that are
    # out of view, not finite or at the origin
    pixel: Ints


class Bounds(NamedTuple):
    """A top view as its kernel takes it: bounds [m], rows and columns."""

    x_min: np.float32
    x_max: np.float32
    y_min: np.float32
    y_max: np.float32
    z_min: np.float32
    z_max: np.float32
    cells_per_m: np.float32
    height: np.int32
    width: np.int32


class Intervals(NamedTuple):
    """Tables that find the interval of a value with one comparison (`tabulate`).

    Interval j holds ``edges[j] >= value > edges[j + 1]``. With ``k = int32((first - value) * cells_per_unit)`` in
    float32, j is exactly ``base[k] + (value <= split[k])``: the edges are sorted into table cells by the same rounded
    arithmetic, and no two edges share a cell. The last edge is lower than any value if it is straight behind the
    sensor.
    """

    first: np.float32
    last: np.float32
    cells_per_unit: np.float32
    base: Ints
    split: Floats32


# The kernels process points in blocks, in short loops without branches that compile to vector instructions. Only the
# table look-ups and the choice of a pixel's point are scalar code. Each of these rules makes its loop two to three
# times as fast:
# - Points are indexed flat (4 * i + 1), because the compiler does not know the stride of points[i, 1].
# - All four values of a point are used, because a gap in the loads prevents vector instructions.
# - Positions are unsigned, because a signed index needs a test for counting from the end.
# Both kernels repeat the selection of the points in view: as a separate function it made them 2 to 5 % slower.


@njit(cache=True, nogil=True, error_model="numpy")
def mark_top_view(points: Points, view: Bounds, index: Ints, pixel: Ints) -> None:
    """Mark the row of the highest point of each cell in ``index``, -1 without a return, and the flat cell of each point
    in ``pixel``, -1 out of view.
    """
    pixel[:] = np.int32(-1)
    index[:] = np.int32(-1)
    x_min, x_max, y_min, y_max, z_min, z_max, cells_per_m, height, width = view
    last_row = height - np.int32(1)
    last_col = width - np.int32(1)
    values = points.reshape(-1)
    seen = np.empty(BLOCK, np.uint32)
    chosen = np.empty(BLOCK, np.uint32)
    rows = np.empty(4 * BLOCK, np.float32)
    flats = np.empty(BLOCK, np.uint32)
    for start in range(0, points.shape[0], BLOCK):
        block = values[4 * start : 4 * (start + BLOCK)]
        size = block.shape[0] // 4

        any_seen = np.uint32(0)
        for j in range(size):
            x, y, z, remission = block[4 * j], block[4 * j + 1], block[4 * j + 2], block[4 * j + 3]
            inside = (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max) & (z >= z_min) & (z <= z_max)
            seen[j] = np.uint32(inside & (np.abs(remission) < INFINITY))  # NaN passes no comparison
        for j in range(size):
            any_seen |= seen[j]
        if any_seen == 0:
            continue

        count = np.int64(0)
        for j in range(size):
            chosen[count] = np.uint32(j)
            count += np.int64(seen[j])
        for k in range(count):
            at = np.uint64(chosen[k]) * np.uint64(4)
            x, y, z, remission = block[at], block[at + np.uint64(1)], block[at + np.uint64(2)], block[at + np.uint64(3)]
            rows[4 * k], rows[4 * k + 1], rows[4 * k + 2], rows[4 * k + 3] = x, y, z, remission

        for k in range(count):
            x, y, z = rows[4 * k], rows[4 * k + 1], rows[4 * k + 2]
            ahead = min(np.int32((x - x_min) * cells_per_m), last_row)
            left = min(np.int32((y - y_min) * cells_per_m), last_col)
            flats[k] = np.uint32((last_row - ahead) * width + (last_col - left))
        for k in range(count):
            i = start + np.int64(chosen[k])
            flat = flats[k]
            pixel[i] = np.int32(flat)
            last = index[flat]
            highest = values[np.uint64(max(last, 0)) * np.uint64(4) + np.uint64(2)]
            index[flat] = i if (last < 0) | (rows[4 * k + 2] > highest) else last


@njit(cache=True, nogil=True, error_model="numpy")
def mark_range_image(
    points: Points,
    wedge: Floats32,
    row_table: Intervals,
    col_table: Intervals,
    width: np.int32,
    winner: Ints64,
    index: Ints,
    pixel: Ints,
) -> None:
    """Mark the row of the nearest point of each pixel in ``index``, -1 without a return, and the flat pixel of each
    point in ``pixel``, -1 out of view.

    wedge : (4,) coefficients of x, y, x, y in two sums that are not negative for any point in view: a cheap test that
        saves the divisions for three quarters of a full turn.
    winner : scratch: ``rank << 32 | row of points``, or ``EMPTY``.
    """
    pixel[:] = np.int32(-1)
    winner[:] = EMPTY
    left_x, left_y, right_x, right_y = wedge[0], wedge[1], wedge[2], wedge[3]
    top, bottom, row_cells, row_base, row_split = row_table
    left, right, col_cells, col_base, col_split = col_table
    values = points.reshape(-1)
    seen = np.empty(BLOCK, np.uint32)
    chosen = np.empty(BLOCK, np.uint32)
    rows = np.empty(4 * BLOCK, np.float32)
    angles = np.empty((2, BLOCK), np.float32)
    cells = np.empty((2, BLOCK), np.uint32)
    ranks = np.empty(BLOCK, np.int32)
    flats = np.empty(BLOCK, np.uint32)
    for start in range(0, points.shape[0], BLOCK):
        block = values[4 * start : 4 * (start + BLOCK)]
        size = block.shape[0] // 4

        any_seen = np.uint32(0)
        for j in range(size):
            x, y, z, remission = block[4 * j], block[4 * j + 1], block[4 * j + 2], block[4 * j + 3]
            ahead = (x * left_x + y * left_y >= ZERO) & (x * right_x + y * right_y >= ZERO)
            seen[j] = np.uint32(ahead & (np.abs(z) < INFINITY) & (np.abs(remission) < INFINITY))
        for j in range(size):
            any_seen |= seen[j]
        if any_seen == 0:
            continue

        count = np.int64(0)
        for j in range(size):
            chosen[count] = np.uint32(j)
            count += np.int64(seen[j])
        for k in range(count):
            at = np.uint64(chosen[k]) * np.uint64(4)
            x, y, z, remission = block[at], block[at + np.uint64(1)], block[at + np.uint64(2)], block[at + np.uint64(3)]
            rows[4 * k], rows[4 * k + 1], rows[4 * k + 2], rows[4 * k + 3] = x, y, z, remission

        for k in range(count):
            x, y, z, remission = rows[4 * k], rows[4 * k + 1], rows[4 * k + 2], rows[4 * k + 3]
            squared_distance = x * x + y * y
            squared_range = squared_distance + z * z
            elevation = z / (np.sqrt(squared_distance) + np.abs(z))
            folded = y / (np.abs(x) + np.abs(y))
            azimuth = folded if x >= ZERO else ((TWO if y >= ZERO else -TWO) - folded)
            # points on the sensor's axis have no azimuth; NaN passes no comparison
            inside = (
                (squared_distance > ZERO) & (squared_range < INFINITY) & (np.abs(remission) < INFINITY)
                & (elevation <= top) & (elevation > bottom) & (azimuth <= left) & (azimuth > right)
            )  # fmt: skip
            elevation = elevation if inside else top
            azimuth = azimuth if inside else left
            angles[0, k] = elevation
            angles[1, k] = azimuth
            cells[0, k] = np.uint32(np.int32((top - elevation) * row_cells))
            cells[1, k] = np.uint32(np.int32((left - azimuth) * col_cells))
            # positive floats and their bits have the same order
            ranks[k] = np.float32(squared_range if inside else INFINITY).view(np.int32)
        for k in range(count):
            row_cell = cells[0, k]
            col_cell = cells[1, k]
            row = row_base[row_cell] + np.int32(angles[0, k] <= row_split[row_cell])
            col = col_base[col_cell] + np.int32(angles[1, k] <= col_split[col_cell])
            flats[k] = np.uint32(row * width + col)
        for k in range(count):
            i = start + np.int64(chosen[k])
            rank = ranks[k]
            flat = flats[k]
            pixel[i] = np.int32(flat) if rank < INFINITE_RANK else np.int32(-1)
            winner[flat] = min(winner[flat], (np.int64(rank) << 32) | i)  # an infinite rank never beats EMPTY
    for p in range(winner.shape[0]):
        index[p] = np.int32(winner[p] & LOW_WORD) if winner[p] != EMPTY else np.int32(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def fill_image(
    points: Points, heights: Heights, index: Ints, channels: Ints, mean: Floats32, std: Floats32, image: Floats32
) -> None:
    """Write the values of the points of ``index`` into ``image``; ``heights`` are empty if no channel needs them."""
    values = points.reshape(-1)
    rows = np.empty(4 * PIXEL_BLOCK, np.float32)
    planes = np.empty((7, PIXEL_BLOCK), np.float32)
    for start in range(0, index.shape[0], PIXEL_BLOCK):
        row_of = index[start : start + PIXEL_BLOCK]
        size = row_of.shape[0]
        last = np.int32(-1)
        for p in range(size):
            last = max(last, row_of[p])
        if last < 0:
            image[:, start : start + PIXEL_BLOCK] = ZERO
            continue
        for p in range(size):  # empty pixels take the first point: a branch here costs a top view 0.03 ms
            at = np.uint64(max(row_of[p], np.int32(0))) * np.uint64(4)
            x, y, z, remission = (
                values[at], values[at + np.uint64(1)], values[at + np.uint64(2)], values[at + np.uint64(3)]
            )  # fmt: skip
            rows[4 * p], rows[4 * p + 1], rows[4 * p + 2], rows[4 * p + 3] = x, y, z, remission
        for p in range(size):  # planes as numbered in CHANNEL_CODES
            x, y, z, remission = rows[4 * p], rows[4 * p + 1], rows[4 * p + 2], rows[4 * p + 3]
            squared_distance = x * x + y * y
            planes[0, p] = x
            planes[1, p] = y
            planes[2, p] = z
            planes[3, p] = remission
            planes[4, p] = np.sqrt(squared_distance)
            planes[5, p] = np.sqrt(squared_distance + z * z)
        if heights.shape[0] > 0:
            for p in range(size):  # NaN is the lower bound
                height = heights[max(row_of[p], np.int32(0))]
                height = height if height > LOWEST else LOWEST
                planes[6, p] = height if height < HIGHEST else HIGHEST
        for c in range(channels.shape[0]):
            if channels[c] == CURVATURE:
                continue
            raw = planes[channels[c]]
            channel_mean = mean[c]
            channel_std = std[c]
            out = image[c, start : start + PIXEL_BLOCK]
            for p in range(size):
                out[p] = (raw[p] - channel_mean) / channel_std if row_of[p] >= 0 else ZERO


@njit(cache=True, nogil=True, error_model="numpy")
def fill_curvature(
    points: Points, heights: Heights, index: Ints, mean: np.float32, std: np.float32, plane: Floats32
) -> None:
    """Write into a channel how the range bends along each row of ``index``: sqrt(|before - 2 here + after|), at most 1.

    The root tells leaves, which bend by centimeters, from walls and still holds the edges of objects. If ranges are so
    noisy that the ground bends by more than `LEVEL_BEND_M` in the median, the variance beyond that is taken off: walls
    would look like leaves.
    """
    values = points.reshape(-1)
    height, width = index.shape
    level, n_level, n_rough = np.empty(index.size if heights.shape[0] > 0 else 0, np.float32), 0, 0
    if values.shape[0] == 0:
        plane[:] = ZERO
        return
    ranges = np.empty(width + 2, np.float32)  # of a row and beyond its ends; NaN without a return
    ranges[0] = ranges[width + 1] = np.float32(math.nan)
    for row in range(height):
        row_of, out = index[row], plane[row]
        for column in range(width):
            at = np.uint64(max(row_of[column], np.int32(0))) * np.uint64(4)
            x, y, z = values[at], values[at + np.uint64(1)], values[at + np.uint64(2)]
            ranges[column + 1] = x * x + y * y + z * z if row_of[column] >= 0 else np.float32(math.nan)
        for column in range(1, width + 1):
            ranges[column] = np.sqrt(ranges[column])
        for column in range(width):
            bend = np.abs(ranges[column] - TWO * ranges[column + 1] + ranges[column + 2])
            out[column] = bend if bend >= ZERO else ZERO
            if level.shape[0] > 0 and bend > ZERO and np.abs(heights[row_of[column]]) < LEVEL_M:
                level[n_level] = bend
                n_level += 1
                n_rough += bend > LEVEL_BEND_M
    noise = ZERO
    if n_level >= FEWEST_LEVEL and 2 * n_rough >= n_level:  # else the median, which takes time, is not above the limit
        typical = np.float32(np.median(level[:n_level]))
        noise = max(typical * typical - LEVEL_BEND_M * LEVEL_BEND_M, ZERO) * VARIANCE_OF_MEDIAN
    for row in range(height):
        row_of, out = index[row], plane[row]
        for column in range(width):
            bend = out[column]
            if noise > ZERO:
                bend = np.sqrt(max(bend * bend - noise, ZERO))
            out[column] = (np.sqrt(min(bend, ONE)) - mean) / std if row_of[column] >= 0 else ZERO


class Projector:
    """Projects points to the images of a view: `mark` finds the pixels of the points."""

    def __init__(self, view: TopViewGeometry | RangeImageGeometry, input: InputSpec) -> None:
        self.view = view
        self.shape = (len(input.channels), view.height, view.width)
        self.needs_ground = input.needs_ground
        self._channels, self._mean, self._std = _channels(input, CHANNELS[view.kind])
        self._curved = np.flatnonzero(self._channels == CURVATURE)

    def mark(self, points: Points, index: Ints, pixel: Ints) -> None:
        """Write the row of the point of each pixel (H * W,), and the flat pixel of each point (n,); -1 for none."""
        raise NotImplementedError

    def fill(self, points: Points, image: Floats32, index: Ints, pixel: Ints, height_m: Heights | None = None) -> None:
        """Project into the caller's buffers; ``height_m`` is for the channel ``"height_above_ground"`` alone."""
        points = _checked(self.shape, points, image, index, pixel)
        self.mark(points, index.reshape(-1), pixel)
        self._write(points, index, image, height_m)

    def fill_image(self, points: Points, index: Ints, image: Floats32, height_m: Heights | None = None) -> None:
        """Write the image for a given ``index``; arguments and errors as in `fill`."""
        self._write(_checked(self.shape, points, image, index), index, image, height_m)

    def _write(self, points: Points, index: Ints, image: Floats32, height_m: Heights | None) -> None:
        heights = _heights(self.needs_ground, len(points), height_m)
        flat_image = image.reshape(self.shape[0], -1)
        fill_image(points, heights, index.reshape(-1), self._channels, self._mean, self._std, flat_image)
        for c in self._curved:
            fill_curvature(points, heights, index, self._mean[c], self._std[c], image[c])

    def project(self, points: Points, height_m: Heights | None = None) -> Projection:
        """Project into fresh buffers; arguments and errors as in `fill`."""
        _check_points(points)
        projection = Projection(
            image=np.empty(self.shape, np.float32),
            index=np.empty(self.shape[1:], np.int32),
            pixel=np.empty(points.shape[0], np.int32),
        )
        self.fill(points, projection.image, projection.index, projection.pixel, height_m)
        return projection


class TopViewProjector(Projector):
    """Project points to an image of the ground ahead (SSADNet 2.1.2). Row 0 is farthest ahead, column 0 leftmost.

    Cells are half-open: a cell includes its near and right edges. The view is ``x_min <= x < x_max``, ``y_min <= y <
    y_max`` and ``z_min <= z <= z_max``. The highest point wins a cell, the earlier one on ties. Channels, in any order:
    ``"distance"``, sqrt(x^2 + y^2) [m] (SSADNet equation 1), ``"remission"`` and ``"height"``, z [m].
    """

    view: TopViewGeometry

    def __init__(self, view: TopViewGeometry, input: InputSpec) -> None:
        super().__init__(view, input)
        limits = map(np.float32, (*view.x_range_m, *view.y_range_m, *view.z_range_m, 1.0 / view.cell_m))
        self._bounds = Bounds._make((*limits, np.int32(view.height), np.int32(view.width)))

    def mark(self, points: Points, index: Ints, pixel: Ints) -> None:
        """See `Projector`."""
        mark_top_view(points, self._bounds, index, pixel)


class RangeImageProjector(Projector):
    """Project points to a range image (PointSeg 3.1). Row 0 is the top beam, column 0 leftmost.

    A point's row is the beam with the nearest elevation; the top and the bottom row reach half a beam spacing farther
    out. Its column follows from its azimuth, atan2(y, x). Pixels are half-open: a pixel includes its upper and left
    edges. The point nearest to the sensor wins a pixel (by squared range in float32), the earlier one on ties. Points
    on the sensor's vertical axis have no azimuth and are out of view. Channels, in any order: ``"x"``, ``"y"``,
    ``"z"``, ``"remission"``, ``"range"`` and ``"height_above_ground"`` [m], clipped to -1..5 m, and ``"curvature"``,
    how much the range bends along a row (`fill_curvature`; LOAM, equation 1, with one neighbor on each side). One
    instance per thread.

    PointSeg's equation 2 uses arcsin(y / sqrt(x^2 + y^2 + z^2)) as azimuth. That is arcsin(sin(azimuth) *
    cos(elevation)), which is smaller than the azimuth, and the error grows as the beam points farther down. At azimuth
    45 degrees, a beam at -24.8 degrees gets 39.9 degrees: an error of 29 of 512 columns, which would bend vertical
    edges. This module uses the true azimuth.

    No angle is computed for a point. Two functions that increase with azimuth and elevation replace them: y / (|x| +
    |y|), unfolded over the half-planes, and z / (sqrt(x^2 + y^2) + |z|). The edges of the pixels are converted to the
    same quantities.
    """

    view: RangeImageGeometry

    def __init__(self, view: RangeImageGeometry, input: InputSpec) -> None:
        super().__init__(view, input)
        self._tables = wedge(view), tabulate(row_edges(view), "rows"), tabulate(column_edges(view), "columns")
        self._winner = np.empty(view.height * view.width, np.int64)

    def mark(self, points: Points, index: Ints, pixel: Ints) -> None:
        """See `Projector`."""
        mark_range_image(points, *self._tables, np.int32(self.shape[2]), self._winner, index, pixel)


def make_projector(
    view: TopViewGeometry | RangeImageGeometry, input: InputSpec
) -> TopViewProjector | RangeImageProjector:
    """Make the projector for a model's view and input."""
    return TopViewProjector(view, input) if isinstance(view, TopViewGeometry) else RangeImageProjector(view, input)


def row_edges(view: RangeImageGeometry) -> Floats32:
    """Pseudo-elevations z / (sqrt(x^2 + y^2) + |z|) of the H + 1 edges of rows, top to bottom, float32."""
    beams = np.asarray(view.row_elevations_deg, dtype=np.float64)
    middles = (beams[:-1] + beams[1:]) / 2.0
    edges_deg = np.concatenate(([2.0 * beams[0] - middles[0]], middles, [2.0 * beams[-1] - middles[-1]]))
    edges = np.deg2rad(np.clip(edges_deg, -90.0, 90.0))
    return (np.sin(edges) / (np.abs(np.cos(edges)) + np.abs(np.sin(edges)))).astype(np.float32)


def column_edges(view: RangeImageGeometry) -> Floats32:
    """Pseudo-azimuths, y / (|x| + |y|) unfolded to -2..2, of the W + 1 edges of columns, left to right, float32."""
    edges = np.deg2rad(np.linspace(view.azimuth_left_deg, view.azimuth_right_deg, view.width + 1))
    x, y = np.cos(edges), np.sin(edges)
    folded = y / (np.abs(x) + np.abs(y))
    return np.where(x >= 0.0, folded, np.copysign(2.0, edges) - folded).astype(np.float32)


def wedge(view: RangeImageGeometry) -> Floats32:
    """Coefficients of x, y, x, y in two sums that are not negative for any point in view, (4,) float32."""
    if view.azimuth_left_deg - view.azimuth_right_deg > 179.0:
        return np.zeros(4, np.float32)
    slack = 1e-5  # [rad] a hundred times what rounding can do to a sum
    left = math.radians(view.azimuth_left_deg) + slack
    right = math.radians(view.azimuth_right_deg) - slack
    return np.array([math.sin(left), -math.cos(left), -math.sin(right), math.cos(right)], dtype=np.float32)


def tabulate(edges: Floats32, what: str) -> Intervals:
    """Build tables that find the interval of a value between strictly decreasing edges with one comparison."""
    first, last = edges[0], edges[-1]
    inner = edges[1:-1]
    cells = 64
    while cells <= 65536 and np.all(edges[:-1] > edges[1:]):
        cells_per_unit = np.float32(cells) / (first - last)
        at = ((first - inner) * cells_per_unit).astype(np.int32)
        if np.all(np.diff(at) > 0):
            base = np.searchsorted(at, np.arange(cells + 2)).astype(np.int32)
            split = np.full(cells + 2, -np.inf, np.float32)
            split[at] = inner
            # -2 is straight behind; azimuths slightly to the left of that are rounded to it.
            open_end = np.float32(-3.0) if last == np.float32(-2.0) else last
            return Intervals(first, open_end, cells_per_unit, base, split)
        cells *= 2
    raise CardError(
        f"view has {edges.size - 1} {what}, some closer than float32 angles can separate; expected wider ones"
    )


def _channels(spec: InputSpec, known: tuple[str, ...]) -> tuple[Ints, Floats32, Floats32]:
    """Channel codes, means and deviations of an input, as the kernels take them."""
    unknown = [name for name in spec.channels if name not in known]
    if unknown:
        raise CardError(f"input has channels {unknown}, unknown to this view; expected some of {list(known)}")
    codes = np.array([CHANNEL_CODES[name] for name in spec.channels], dtype=np.int32)
    return codes, np.array(spec.mean, dtype=np.float32), np.array(spec.std, dtype=np.float32)


def _checked(
    shape: tuple[int, int, int], points: Points, image: Floats32, index: Ints, pixel: Ints | None = None
) -> Floats32:
    """The points as a read-only view, so that every scan runs the same compiled kernel; raises PointsError."""
    _check_points(points)
    for name, buffer, expected, dtype in (
        ("image", image, shape, np.float32),
        ("index", index, shape[1:], np.int32),
        ("pixel", pixel, points.shape[:1], np.int32),
    ):
        if buffer is None:
            continue
        if buffer.shape != expected or buffer.dtype != dtype or not buffer.flags.carray:
            raise PointsError(
                f"{name} buffer is {buffer.shape} {buffer.dtype}; expected {expected} {np.dtype(dtype)}, "
                "C-contiguous and writeable"
            )
    return read_only(points)


def _heights(needed: bool, n: int, height_m: Heights | None) -> Floats32:
    """The heights as the kernel takes them; raises PointsError."""
    if not needed:
        return read_only(np.empty(0, np.float32))
    if height_m is None:
        raise PointsError(
            "the input has the channel height_above_ground and height_m is missing; pass height_m of "
            "edgeperc.ground.planes.find_ground, or use edgeperc.inference.projection.project"
        )
    if height_m.shape != (n,) or height_m.dtype != np.float32:
        raise PointsError(f"height_m is {height_m.shape} {height_m.dtype} for {n} points; expected ({n},) float32")
    return read_only(np.ascontiguousarray(height_m))


def _check_points(points: Points) -> None:
    if not isinstance(points, np.ndarray):
        raise PointsError(f"points are a {type(points).__name__}; expected a numpy array (n, 4) float32")
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32 or not points.flags.c_contiguous:
        raise PointsError(
            f"points are {points.shape} {points.dtype}, C-contiguous: {points.flags.c_contiguous}; expected (n, 4) "
            "float32, C-contiguous. numpy.ascontiguousarray(points, dtype=numpy.float32) makes them so"
        )


def input_heights(projector: Projector, points: Points) -> Floats32 | None:
    """Heights of points of the models' frame above the ground, (n,) float32 [m]; None if the projector needs none."""
    return find_ground(points, mount_height_m=MODEL_HEIGHT_M).height_m if projector.needs_ground else None


def project(projector: Projector, points: Points, seen_from: ModelFrame = OF_MODELS) -> Projection:
    """Project a scan and, if the projector needs it, find the ground first, as a `Perceiver` does.

    points : (n, 4) float32, C-contiguous; x, y, z [m] in the frame of the models, remission in 0..1.
    seen_from : `ModelFrame.of_training` of the network.
    """
    return projector.project(seen_from.move_back(points), input_heights(projector, points))
