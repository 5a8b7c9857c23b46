"""Points -> the network's input, and the way back from its pixels to the points.

Two views: the ground ahead seen from above (`TopViewProjector`) and the scan seen from the sensor
(`RangeImageProjector`). Both write normalised pixels straight into the network's input buffer.

Every decision about a pixel is taken in float32, one rounding an operation, so that compiled and interpreted
runs, and any other implementation that follows the same steps, agree to the last pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .card import InputSpec, RangeImageGeometry, TopViewGeometry
from .errors import CardError, PointsError

__all__ = ["Projection", "RangeImageProjector", "TopViewProjector", "make_projector"]

# What a channel holds, as the kernels know it. "height" is z and "distance" the range within the x-y plane.
CHANNEL_CODES = {"x": 0, "y": 1, "z": 2, "height": 2, "remission": 3, "distance": 4, "range": 5}

# A pixel keeps the smallest of `rank << 32 | row of points`: the better rank wins, then the earlier point.
EMPTY = np.int64(0x7FFF_FFFF_FFFF_FFFF)
LOW_WORD = np.int64(0xFFFF_FFFF)
SIGN_AND_BELOW = np.int32(0x7FFF_FFFF)

ZERO = np.float32(0.0)
ONE = np.float32(1.0)
TWO = np.float32(2.0)
INFINITY = np.float32(math.inf)


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """One scan as one view.

    Attributes
    ----------
    image : (C, H, W) float32
        The network's input: ``(raw - mean) / std`` per channel, 0 in every channel where nothing returned.
    index : (H, W) int32
        Row of the points whose values the pixel carries; -1 where nothing returned.
    pixel : (n,) int32
        Flat pixel, ``row * W + column``, into which every point fell, also where another point won it; -1 for
        points out of view, not finite or at the origin.
    """

    image: NDArray[np.float32]
    index: NDArray[np.int32]
    pixel: NDArray[np.int32]


@njit(cache=True, nogil=True, error_model="numpy")
def mark_top_view(points, x_range, y_range, z_range, cells_per_m, height, width, winner, pixel):
    """Mark the highest point of each cell in ``winner``, and the cell of each point in ``pixel``.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
        x, y, z [m] in the sensor frame, remission.
    x_range, y_range, z_range : (2,) float32
        Bounds of the view [m], lower first.
    cells_per_m : float32
    height, width : int32
    winner : (height * width,) int64, ``EMPTY`` on entry
        ``rank << 32 | row of points``.
    pixel : (n,) int32, overwritten
    """
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        inside = (
            (x >= x_range[0]) & (x < x_range[1]) & (y >= y_range[0]) & (y < y_range[1])
            & (z >= z_range[0]) & (z <= z_range[1]) & (np.abs(points[i, 3]) < INFINITY)
        )  # fmt: skip
        if not inside:  # NaN is inside no range
            pixel[i] = np.int32(-1)
            continue
        up = min(np.int32((x - x_range[0]) * cells_per_m), height - np.int32(1))
        right = min(np.int32((y - y_range[0]) * cells_per_m), width - np.int32(1))
        flat = (height - np.int32(1) - up) * width + (width - np.int32(1) - right)
        pixel[i] = flat
        bits = np.float32(z + ZERO).view(np.int32)  # + 0 turns -0 into 0, which ties with it
        rank = ~(bits ^ ((bits >> np.int32(31)) & SIGN_AND_BELOW))  # falls as z grows
        winner[flat] = min(winner[flat], (np.int64(rank) << np.int64(32)) | np.int64(i))


@njit(cache=True, nogil=True, error_model="numpy")
def mark_range_image(points, row_edges, row_base, row_split, col_edges, col_base, col_split, width, winner, pixel):
    """Mark the nearest point of each pixel in ``winner``, and the pixel of each point in ``pixel``.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
        x, y, z [m] in the sensor frame, remission.
    row_edges, col_edges : (3,) float32
        Pseudo-angle of the first and last edge of the view, and table cells a unit of pseudo-angle.
    row_base, col_base : (m,) int32
    row_split, col_split : (m,) float32
        Look-up tables of `tabulate`.
    width : int32
    winner : (height * width,) int64, ``EMPTY`` on entry
        ``rank << 32 | row of points``.
    pixel : (n,) int32, overwritten
    """
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        squared_distance = x * x + y * y
        squared_range = squared_distance + z * z
        # NaN and infinity fail here; so do points on the sensor's axis, which have no azimuth
        if not ((squared_distance > ZERO) & (squared_range < INFINITY) & (np.abs(points[i, 3]) < INFINITY)):
            pixel[i] = np.int32(-1)
            continue
        elevation = z / (np.sqrt(squared_distance) + np.abs(z))
        folded = y / (np.abs(x) + np.abs(y))
        azimuth = folded if x >= ZERO else ((TWO - folded) if y >= ZERO else (-TWO - folded))
        inside = (
            (elevation <= row_edges[0]) & (elevation > row_edges[1])
            & (azimuth <= col_edges[0]) & (azimuth > col_edges[1])
        )  # fmt: skip
        if not inside:
            pixel[i] = np.int32(-1)
            continue
        k = np.int32((row_edges[0] - elevation) * row_edges[2])
        row = row_base[k] + np.int32(elevation <= row_split[k])
        k = np.int32((col_edges[0] - azimuth) * col_edges[2])
        col = col_base[k] + np.int32(azimuth <= col_split[k])
        flat = row * width + col
        pixel[i] = flat
        rank = np.float32(squared_range).view(np.int32)  # grows with the range, being positive
        winner[flat] = min(winner[flat], (np.int64(rank) << np.int64(32)) | np.int64(i))


@njit(cache=True, nogil=True, error_model="numpy")
def fill_image(points, winner, remission_offset, remission_scale, channels, mean, std, image, index):
    """Write the winners' values into ``image`` and their rows into ``index``, and empty ``winner`` again.

    Parameters
    ----------
    points : (n, 4) float32, C-contiguous
    winner : (pixels,) int64, ``EMPTY`` on return
    remission_offset, remission_scale : float32
        The remission used is ``(raw + offset) * scale``.
    channels : (C,) int32
        Of ``CHANNEL_CODES``.
    mean, std : (C,) float32
    image : (C, pixels) float32, overwritten
    index : (pixels,) int32, overwritten
    """
    for p in range(winner.shape[0]):
        key = winner[p]
        winner[p] = EMPTY
        index[p] = np.int32(key & LOW_WORD) if key != EMPTY else np.int32(-1)
    for c in range(channels.shape[0]):
        code = channels[c]
        for p in range(index.shape[0]):
            i = index[p]
            if i < 0:
                image[c, p] = ZERO
                continue
            if code <= 2:
                raw = points[i, code]
            elif code == 3:
                raw = (points[i, 3] + remission_offset) * remission_scale
            else:
                x = points[i, 0]
                y = points[i, 1]
                squared = x * x + y * y
                if code == 5:
                    squared += points[i, 2] * points[i, 2]
                raw = np.sqrt(squared)
            image[c, p] = (raw - mean[c]) / std[c]


class TopViewProjector:
    """Points -> the ground ahead as an image (SSADNet 2.1.2). Row 0 is farthest ahead, column 0 leftmost.

    Cells are half-open: each holds its near edge and its right edge, not its far and left ones, so the view is
    ``x_min <= x < x_max``, ``y_min <= y < y_max``; in height it is closed, ``z_min <= z <= z_max``. The highest
    point wins a cell, the earlier point wins a tie.

    Tables and scratch are made once and reused between calls, so use one instance per thread.

    Parameters
    ----------
    view : TopViewGeometry
    input : InputSpec
        Channels, in any order: ``"distance"``, sqrt(x^2 + y^2) [m] (SSADNet eq. 1), ``"remission"``, ``"height"``, z [m].
    """

    def __init__(self, view: TopViewGeometry, input: InputSpec) -> None:
        self.view = view
        self.shape = (len(input.channels), view.height, view.width)
        self._channels, self._mean, self._std = _channels(input, ("distance", "remission", "height"))
        self._ranges = tuple(np.array(r, dtype=np.float32) for r in (view.x_range_m, view.y_range_m, view.z_range_m))
        self._cells_per_m = np.float32(1.0 / view.cell_m)
        self._winner = np.full(view.height * view.width, EMPTY)

    def fill(
        self,
        points: NDArray[np.float32],
        remission_offset: float,
        remission_scale: float,
        image: NDArray[np.float32],
        index: NDArray[np.int32],
        pixel: NDArray[np.int32],
    ) -> None:
        """Project into the caller's buffers.

        Parameters
        ----------
        points : (n, 4) float32, C-contiguous
            x, y, z [m] in the sensor frame, remission as the sensor gives it. May be empty or read-only.
        remission_offset, remission_scale : float
            The remission used is ``(raw + offset) * scale``.
        image : (C, H, W) float32, C-contiguous, overwritten
        index : (H, W) int32, C-contiguous, overwritten
        pixel : (n,) int32, C-contiguous, overwritten
            As in `Projection`.

        Raises
        ------
        PointsError
            An array has another shape, dtype or layout, or the remission scaling is not finite.
        """
        points = _checked(self.shape, points, remission_offset, remission_scale, image, index, pixel)
        _, height, width = self.shape
        x_range, y_range, z_range = self._ranges
        mark_top_view(
            points, x_range, y_range, z_range, self._cells_per_m, np.int32(height), np.int32(width), self._winner, pixel
        )
        fill_image(
            points, self._winner, np.float32(remission_offset), np.float32(remission_scale),
            self._channels, self._mean, self._std, image.reshape(self.shape[0], -1), index.reshape(-1),
        )  # fmt: skip

    def project(
        self, points: NDArray[np.float32], remission_offset: float = 0.0, remission_scale: float = 1.0
    ) -> Projection:
        """Project into fresh buffers; arguments and errors as in `fill`."""
        return _project(self, points, remission_offset, remission_scale)


class RangeImageProjector:
    """Points -> the scan as the sensor sees it (PointSeg 3.1). Row 0 is the top beam, column 0 leftmost.

    A point's row is the beam whose elevation is nearest; the outermost beams reach half a neighbour spacing
    beyond themselves. Its column comes from its azimuth, atan2(y, x). Pixels are half-open: each holds its upper
    and its left edge. The nearest point wins a pixel (by its squared range in float32), the earlier point wins a
    tie. Points on the sensor's vertical axis have no azimuth and are out of view.

    Tables and scratch are made once and reused between calls, so use one instance per thread.

    Parameters
    ----------
    view : RangeImageGeometry
    input : InputSpec
        Channels, any of ``"x"``, ``"y"``, ``"z"``, ``"remission"``, ``"range"`` in any order, metres.

    Raises
    ------
    CardError
        A channel is not one of these, or beams or columns lie too close to be told apart.

    Notes
    -----
    PointSeg's equation 2 takes arcsin(y / sqrt(x^2 + y^2 + z^2)) for the azimuth. That is arcsin(sin(azimuth) *
    cos(elevation)), smaller than the azimuth by ever more as the beam points farther down: at azimuth 45 degrees a
    beam at -24.8 degrees gets 39.9, which is 29 of 512 columns off, so upright edges would bend. The true azimuth
    is used here.

    No angle is computed for a point. Azimuth and elevation are replaced by y / (|x| + |y|), unfolded over the
    half-planes, and z / (sqrt(x^2 + y^2) + |z|), which grow with them, and compared with the pixels' edges in the
    same terms.
    """

    def __init__(self, view: RangeImageGeometry, input: InputSpec) -> None:
        self.view = view
        self.shape = (len(input.channels), view.height, view.width)
        self._channels, self._mean, self._std = _channels(input, ("x", "y", "z", "remission", "range"))
        self._rows = tabulate(row_edges(view), "rows")
        self._cols = tabulate(column_edges(view), "columns")
        self._winner = np.full(view.height * view.width, EMPTY)

    def fill(
        self,
        points: NDArray[np.float32],
        remission_offset: float,
        remission_scale: float,
        image: NDArray[np.float32],
        index: NDArray[np.int32],
        pixel: NDArray[np.int32],
    ) -> None:
        """Project into the caller's buffers; arguments and errors as in `TopViewProjector.fill`."""
        points = _checked(self.shape, points, remission_offset, remission_scale, image, index, pixel)
        mark_range_image(points, *self._rows, *self._cols, np.int32(self.shape[2]), self._winner, pixel)
        fill_image(
            points, self._winner, np.float32(remission_offset), np.float32(remission_scale),
            self._channels, self._mean, self._std, image.reshape(self.shape[0], -1), index.reshape(-1),
        )  # fmt: skip

    def project(
        self, points: NDArray[np.float32], remission_offset: float = 0.0, remission_scale: float = 1.0
    ) -> Projection:
        """Project into fresh buffers; arguments and errors as in `TopViewProjector.fill`."""
        return _project(self, points, remission_offset, remission_scale)


def make_projector(
    view: TopViewGeometry | RangeImageGeometry, input: InputSpec
) -> TopViewProjector | RangeImageProjector:
    """The projector that a model's card asks for.

    Raises
    ------
    CardError
        The input has a channel that the view does not, or beams or columns lie too close to be told apart.
    """
    if isinstance(view, TopViewGeometry):
        return TopViewProjector(view, input)
    return RangeImageProjector(view, input)


def row_edges(view: RangeImageGeometry) -> NDArray[np.float32]:
    """Pseudo-elevations z / (sqrt(x^2 + y^2) + |z|) of the H + 1 edges between rows, top to bottom, float32."""
    beams = np.asarray(view.row_elevations_deg, dtype=np.float64)
    middles = (beams[:-1] + beams[1:]) / 2.0
    edges_deg = np.concatenate(([2.0 * beams[0] - middles[0]], middles, [2.0 * beams[-1] - middles[-1]]))
    edges = np.deg2rad(np.clip(edges_deg, -90.0, 90.0))
    return (np.sin(edges) / (np.abs(np.cos(edges)) + np.abs(np.sin(edges)))).astype(np.float32)


def column_edges(view: RangeImageGeometry) -> NDArray[np.float32]:
    """Pseudo-azimuths, y / (|x| + |y|) unfolded to -2..2, of the W + 1 edges between columns, left to right, float32."""
    edges = np.deg2rad(np.linspace(view.azimuth_left_deg, view.azimuth_right_deg, view.width + 1))
    x, y = np.cos(edges), np.sin(edges)
    folded = y / (np.abs(x) + np.abs(y))
    return np.where(x >= 0.0, folded, np.copysign(2.0, edges) - folded).astype(np.float32)


def tabulate(
    edges: NDArray[np.float32], what: str
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
    """Tables that find the interval of a value with one comparison.

    Interval j holds ``edges[j] >= value > edges[j + 1]``. With ``k = int32((first - value) * cells_per_unit)`` in
    float32, it is ``base[k] + (value <= split[k])``, exactly: the edges are sorted into table cells by the same
    rounded arithmetic, no two into one.

    Parameters
    ----------
    edges : (m + 1,) float32
        Strictly decreasing.
    what : str
        Named in the error.

    Returns
    -------
    scale : (3,) float32
        First edge, last edge (below any value where the view closes a full turn), cells_per_unit.
    base : (cells + 2,) int32
    split : (cells + 2,) float32

    Raises
    ------
    CardError
        Edges so close that 65,536 table cells do not part them.
    """
    first, last = edges[0], edges[-1]
    inner = edges[1:-1]
    cells = 64
    while cells <= 65536:
        cells_per_unit = np.float32(cells) / (first - last)
        at = ((first - inner) * cells_per_unit).astype(np.int32)
        if at.size == 0 or (at[0] >= 0 and np.all(np.diff(at) > 0)):
            base = np.searchsorted(at, np.arange(cells + 2)).astype(np.int32)
            split = np.full(cells + 2, -np.inf, dtype=np.float32)
            split[at] = inner
            # -2 is both the right edge of a full turn and what values a hair to the left of it round to.
            open_end = np.float32(-3.0) if last == np.float32(-2.0) else last
            return np.array([first, open_end, cells_per_unit], dtype=np.float32), base, split
        cells *= 2
    raise CardError(f"view has {edges.size - 1} {what}, some closer than float32 angles can part; expected wider ones")


def _channels(
    spec: InputSpec, known: tuple[str, ...]
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Channel codes, means and deviations of an input, as the kernels take them."""
    unknown = [name for name in spec.channels if name not in known]
    if unknown:
        raise CardError(f"input channels {', '.join(unknown)} are unknown to this view; expected some of {', '.join(known)}")
    codes = np.array([CHANNEL_CODES[name] for name in spec.channels], dtype=np.int32)
    return codes, np.array(spec.mean, dtype=np.float32), np.array(spec.std, dtype=np.float32)


def _checked(
    shape: tuple[int, int, int],
    points: NDArray[np.float32],
    remission_offset: float,
    remission_scale: float,
    image: NDArray[np.float32],
    index: NDArray[np.int32],
    pixel: NDArray[np.int32],
) -> NDArray[np.float32]:
    """The points as a read-only view, so that every scan runs the same compiled kernel; raises PointsError."""
    _check_points(points)
    for name, buffer, expected, dtype in (
        ("image", image, shape, np.float32),
        ("index", index, shape[1:], np.int32),
        ("pixel", pixel, points.shape[:1], np.int32),
    ):
        if buffer.shape != expected or buffer.dtype != dtype or not buffer.flags.carray:
            raise PointsError(
                f"{name} buffer is {buffer.shape} {buffer.dtype}; expected {expected} {np.dtype(dtype)}, "
                "C-contiguous and writeable"
            )
    if not (math.isfinite(remission_offset) and math.isfinite(remission_scale)):
        raise PointsError(f"remission offset {remission_offset}, scale {remission_scale}; expected finite numbers")
    read_only = points.view()
    read_only.flags.writeable = False
    return read_only


def _check_points(points: NDArray[np.float32]) -> None:
    if not isinstance(points, np.ndarray):
        raise PointsError(f"points are a {type(points).__name__}; expected a numpy array (n, 4) float32")
    if points.ndim != 2 or points.shape[1] != 4 or points.dtype != np.float32 or not points.flags.c_contiguous:
        raise PointsError(
            f"points are {points.shape} {points.dtype}, C-contiguous: {points.flags.c_contiguous}; expected (n, 4) "
            "float32, C-contiguous. numpy.ascontiguousarray(points, dtype=numpy.float32) makes them so"
        )


def _project(
    projector: TopViewProjector | RangeImageProjector,
    points: NDArray[np.float32],
    remission_offset: float,
    remission_scale: float,
) -> Projection:
    _check_points(points)
    projection = Projection(
        image=np.empty(projector.shape, dtype=np.float32),
        index=np.empty(projector.shape[1:], dtype=np.int32),
        pixel=np.empty(points.shape[0], dtype=np.int32),
    )
    projector.fill(
        points, remission_offset, remission_scale, projection.image, projection.index, projection.pixel
    )
    return projection
