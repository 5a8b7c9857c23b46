"""How a network sees its input: top view, range image, camera image, points of candidates."""

from __future__ import annotations

import itertools
import reprlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import CardError
from ..system.fields import Fields
from .points import Floats, Ints64, Mask

MAX_ROWS, MAX_COLUMNS, MAX_PIXELS = 4096, 65_536, 16 * 10**6
MIN_SECTOR_DEG = 1.0


_FIELDS = Fields("the card", CardError)


def check_size(rows: int, columns: int) -> None:
    """Refuse a view of more rows, columns or pixels than are possible."""
    if not (1 <= rows <= MAX_ROWS and 1 <= columns <= MAX_COLUMNS and rows * columns <= MAX_PIXELS):
        raise CardError(
            f"the view has {reprlib.repr(rows)} rows and {reprlib.repr(columns)} columns; expected 1 to {MAX_ROWS} "
            f"rows, 1 to {MAX_COLUMNS} columns and at most {MAX_PIXELS} pixels"
        )


def check_bounds(view: object) -> dict[str, tuple[float, float]]:
    """The bounds of a view along each axis by their names; refuses those that hold nothing."""
    names = ("x_range_m", "y_range_m", "z_range_m")
    bounds = {name: _FIELDS.pair(f"view.{name}", getattr(view, name), -1e4, 1e4) for name in names}
    for name, (low, high) in bounds.items():
        if not high - low >= 1e-3:
            raise CardError(f"view.{name} is {(low, high)}; expected two finite numbers, the lower first")
    return bounds


@dataclass(frozen=True, slots=True)
class TopViewGeometry:
    """The ground ahead as an image (SSADNet 2.1.2). Row 0 is farthest ahead, column 0 leftmost."""

    # bounds of the view [m] in the sensor frame, lower first
    x_range_m: tuple[float, float] = (6.0, 46.0)
    y_range_m: tuple[float, float] = (-10.0, 10.0)
    z_range_m: tuple[float, float] = (-2.5, 2.5)
    cell_m: float = 0.1  # edge of a cell [m]

    kind = "top_view"

    def __post_init__(self) -> None:
        for name, bounds in check_bounds(self).items():
            object.__setattr__(self, name, bounds)
        object.__setattr__(self, "cell_m", _FIELDS.number("view.cell_m", self.cell_m, 1e-3, 100.0))
        check_size(self.height, self.width)

    @property
    def height(self) -> int:
        """Rows, along x."""
        return round((self.x_range_m[1] - self.x_range_m[0]) / self.cell_m)

    @property
    def width(self) -> int:
        """Columns, along y."""
        return round((self.y_range_m[1] - self.y_range_m[0]) / self.cell_m)

    @property
    def corner_m(self) -> tuple[float, float]:
        """x and y of the nearest, rightmost corner of the cells [m]: counted from the other one, they may not fill the
        bounds.
        """
        (near, far), (right, left) = self.x_range_m, self.y_range_m
        # In this order, because a difference of 0 must leave the bound as it is.
        return near + ((far - near) - self.height * self.cell_m), right + ((left - right) - self.width * self.cell_m)

    def holds(self, x: float, y: float) -> bool:
        """Whether a position x, y [m] in the sensor frame is in view."""
        (near, far), (right, left) = self.x_range_m, self.y_range_m
        return near <= x < far and right <= y < left

    def cells(self, x: ArrayLike, y: ArrayLike) -> tuple[Ints64, Ints64, Mask]:
        """Find the rows and columns of the cells that contain some positions [m], and whether they are in view and
        finite; otherwise, row and column are not valid.
        """
        row = np.floor((self.x_range_m[1] - np.asarray(x)) / self.cell_m)
        col = np.floor((self.y_range_m[1] - np.asarray(y)) / self.cell_m)
        in_view = (row >= 0) & (row < self.height) & (col >= 0) & (col < self.width)
        with np.errstate(invalid="ignore"):  # NaN and what int64 cannot hold are out of view
            return row.astype(np.int64), col.astype(np.int64), in_view

    def cell_centers(self) -> tuple[Floats, Floats]:
        """Centers of the cells in the sensor frame [m]: x (rows, 1) and y (1, columns)."""
        # np.float64, because older type stubs of numpy widen the type of a product with a Python float
        cell_m = np.float64(self.cell_m)
        x = np.float64(self.x_range_m[1]) - (np.arange(self.height, dtype=np.float64)[:, None] + 0.5) * cell_m
        y = np.float64(self.y_range_m[1]) - (np.arange(self.width, dtype=np.float64)[None, :] + 0.5) * cell_m
        return x, y


@dataclass(frozen=True, slots=True)
class RangeImageGeometry:
    """The scan as seen from the sensor (PointSeg 3.1). Row 0 is the top beam, column 0 leftmost."""

    # elevation of every row [deg], top to bottom, strictly decreasing, not necessarily evenly spaced
    row_elevations_deg: tuple[float, ...]
    width: int = 512  # columns, evenly spread over the azimuths
    # azimuths of the image's left and right edges [deg], counter-clockwise from +x; 180 and -180 for a full turn
    azimuth_left_deg: float = 45.0
    azimuth_right_deg: float = -45.0

    kind = "range_image"

    def __post_init__(self) -> None:
        rows = self.row_elevations_deg
        falling = all(a > b for a, b in itertools.pairwise(rows))
        if len(rows) < 2 or not falling or not all(-90.0 < e < 90.0 for e in rows):
            raise CardError(
                f"view.row_elevations_deg holds {len(rows)} values; expected two or more, strictly decreasing, "
                "between -90 and 90 degrees"
            )
        check_size(len(rows), self.width)
        left, right = self.azimuth_left_deg, self.azimuth_right_deg
        # A full turn takes a run of the network for each sector.
        if not (right >= -180.0 and right + MIN_SECTOR_DEG <= left and left <= 180.0):
            raise CardError(
                f"view azimuths are left {left}, right {right}; expected -180 <= right < left <= 180, at least "
                f"{MIN_SECTOR_DEG:g} degree apart"
            )

    @property
    def height(self) -> int:
        """Rows, one per beam."""
        return len(self.row_elevations_deg)


@dataclass(frozen=True, slots=True)
class CameraGeometry:
    """The image of a camera, scaled to the network's input. Row 0 is the top, column 0 leftmost."""

    # columns and rows of the input
    width: int
    height: int
    # {"stretch"}; how an image of another size gets there: all of it is scaled to ``width`` and ``height``, bilinearly
    # with half-pixel centers (`edgeperc.camera.image.ImageScaler`), whatever its aspect; nothing is cropped or padded
    fit: Literal["stretch"] = "stretch"

    kind = "camera"

    def __post_init__(self) -> None:
        if self.fit != "stretch":
            raise CardError(f"view.fit is {reprlib.repr(self.fit)}; expected stretch")
        check_size(self.height, self.width)


@dataclass(frozen=True, slots=True)
class ObjectGeometry:
    """The points of each place where an object may be, one row of the batch each (`edgeperc.objects.crops`)."""

    n_points: int = 64  # points of a candidate that the network sees
    margin_m: float = 0.8  # they lie in the candidate's rectangle, grown by this on every side [m]
    height_range_m: tuple[float, float] = (0.1, 4.2)  # lowest and greatest height above the ground of these points [m]

    kind = "objects"

    def __post_init__(self) -> None:
        _FIELDS.whole("view.n_points", self.n_points, 1, MAX_COLUMNS)
        _FIELDS.number("view.margin_m", self.margin_m, 0.0, 10.0)
        low, high = _FIELDS.pair("view.height_range_m", self.height_range_m, -100.0, 100.0)
        if not low < high:
            raise CardError(f"view.height_range_m is {(low, high)}; expected two numbers, the lower first")
