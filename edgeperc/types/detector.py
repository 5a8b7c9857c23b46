"""What a detector on pillars takes and gives: its grid, and the heads of OpenPCDet and mmdetection3d."""

from __future__ import annotations

import math
import reprlib
from dataclasses import dataclass
from typing import Literal

from ..errors import CardError
from ..system.fields import Fields
from ..system.names import check_text
from .views import check_bounds, check_size

MAX_VALUES = 2**27  # of all points of all pillars
MAX_GROUPS, MAX_ANCHORS, MAX_CANDIDATES = 64, 64, 100_000
# Values of a position and a group of classes in an output of a center head; several may be one output.
CENTER_VALUES = {"reg": 2, "height": 1, "dim": 3, "rot": 2, "vel": 2}
CENTER_KINDS = ("heatmap", *CENTER_VALUES, "reg_height_dim", "reg_height_dim_vel")
ANCHOR_KINDS = ("cls_preds", "box_preds", "dir_cls_preds")
Scores = Literal["logits", "probabilities"]

_FIELDS = Fields("the card", CardError)


@dataclass(frozen=True, slots=True)
class PillarGeometry:
    """Pillars: the points of a grid of cells, seen from above (Lang et al., 2019, section 2.1).

    Row 0 is the rightmost (lowest y), column 0 the nearest (lowest x) one.
    """

    # bounds [m] in the frame of the training points, lower first; points outside are left out
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]
    z_range_m: tuple[float, float]
    cell_m: float  # edge of a pillar [m]
    max_points: int  # points of a pillar that the network sees: the first ones of the scan
    max_pillars: int  # pillars that it sees: those with the first points of the scan
    # how the frame of the training points lies on the vehicle [deg], as in `edgeperc.Mounting`; its height above the
    # road is the card's ``mount_height_m``. 0.66 and 0 for KITTI; a yaw of -90 where x is to the right (nuScenes).
    pitch_deg: float
    yaw_deg: float
    # names of the graph's inputs for the number of points in each pillar, (pillars,), and for its place, (pillars, 4):
    # batch, z, row, column. ``num_points`` is empty if the graph does not take it.
    num_points: str
    coords: str

    kind = "pillars"

    def __post_init__(self) -> None:
        _FIELDS.number("view.cell_m", self.cell_m, 1e-3, 100.0)
        for name, (low, high) in check_bounds(self).items():
            cells = (high - low) / self.cell_m
            if name != "z_range_m" and abs(cells - round(cells)) > 0.01:
                raise CardError(f"view.{name} is {(low, high)}; expected a multiple of view.cell_m, {self.cell_m:g} m")
        check_size(self.height, self.width)
        _FIELDS.whole("view.max_points", self.max_points, 1, 4096)
        _FIELDS.whole("view.max_pillars", self.max_pillars, 1, min(self.height * self.width, MAX_VALUES))
        _FIELDS.number("view.pitch_deg", self.pitch_deg, -45.0, 45.0)
        _FIELDS.number("view.yaw_deg", self.yaw_deg, -180.0, 180.0)
        check_text("view.coords", self.coords, CardError)
        if self.num_points:
            check_text("view.num_points", self.num_points, CardError)

    @property
    def height(self) -> int:
        """Rows, along y."""
        return round((self.y_range_m[1] - self.y_range_m[0]) / self.cell_m)

    @property
    def width(self) -> int:
        """Columns, along x."""
        return round((self.x_range_m[1] - self.x_range_m[0]) / self.cell_m)

    @property
    def is_all_around(self) -> bool:
        """Whether it reaches to every side of the sensor, a quarter as far as to its farthest side at least."""
        reach = [side for low, high in (self.x_range_m, self.y_range_m) for side in (-low, high)]
        return min(reach) >= 0.25 * max(reach)


@dataclass(frozen=True, slots=True)
class Anchor:
    """A box from which those of an anchor head start, at each position and in each direction."""

    size_m: tuple[float, float, float]  # length, width, height [m]
    bottom_m: float  # z of its bottom in the frame of the training points [m]
    yaws_rad: tuple[float, ...]  # its directions [rad]
    # where it stands: lowest x and y, highest x and y [m], of mmdet3d's ``ranges``; None: the bounds of the view
    range_m: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.range_m is not None:
            x_low, y_low, x_high, y_high = _FIELDS.numbers("head.anchors: range_m", self.range_m, 4, -1e4, 1e4)
            if not (x_low < x_high and y_low < y_high):
                _FIELDS.refuse("head.anchors: range_m", self.range_m, "lowest x and y, then highest x and y")
        _FIELDS.numbers("head.anchors: size_m", self.size_m, 3, 0.01, 100.0)
        _FIELDS.number("head.anchors: bottom_m", self.bottom_m, -100.0, 100.0)
        _FIELDS.numbers("head.anchors: yaws_rad", self.yaws_rad, None, -2.0 * math.pi, 2.0 * math.pi)


@dataclass(frozen=True, slots=True)
class AnchorHead:
    """Boxes relative to anchors: SECOND, PointPillars (OpenPCDet's AnchorHeadSingle, mmdet3d's Anchor3DHead)."""

    classes: tuple[str, ...]  # the network's names of its classes, in its order
    stride: int  # cells of the view behind a position of the outputs, along each axis
    scores: Scores  # what ``cls_preds`` holds
    max_candidates: int  # the best ones are decoded, before boxes that overlap are dropped
    across_classes: bool  # whether a box is also dropped if it overlaps a better one of another class
    anchors: tuple[Anchor, ...]  # all at a position, in the order of the channels: anchors, then their yaws
    # anchors stand in the middle of the positions' cells; else the outermost ones on the bounds
    centered: bool
    channels_last: bool  # whether the outputs are (1, rows, columns, channels) and not (1, channels, rows, columns)
    box_values: int  # values of a box; those after the seventh (velocities) are ignored
    # of ``dir_cls_preds``: the angle within a bin is ``yaw - offset`` wrapped to ``-limit_offset..1 - limit_offset`` of
    # a bin
    direction_bins: int
    direction_offset_rad: float
    direction_limit_offset: float

    kind = "anchors"

    def __post_init__(self) -> None:
        _check_common(self)
        _FIELDS.whole("the number of head.anchors", self.n_anchors, 1, MAX_ANCHORS)
        _FIELDS.whole("head.box_values", self.box_values, 7, 16)
        if self.box_values in (8, 10):
            expected = "7, or 9 with velocities; angles of two values (OpenPCDet's encode_angle_by_sincos) are not read"
            _FIELDS.refuse("head.box_values", self.box_values, expected)
        _FIELDS.whole("head.direction_bins", self.direction_bins, 1, 64)
        _FIELDS.number("head.direction_offset_rad", self.direction_offset_rad, -10.0, 10.0)
        _FIELDS.number("head.direction_limit_offset", self.direction_limit_offset, -1.0, 1.0)

    @property
    def n_anchors(self) -> int:
        """Anchors at a position."""
        return sum(len(anchor.yaws_rad) for anchor in self.anchors)

    def n_channels(self, kind: str, nth: int = 0, n: int = 1) -> int:
        """Channels of the output of a kind."""
        values = {"cls_preds": len(self.classes), "box_preds": self.box_values, "dir_cls_preds": self.direction_bins}
        return self.n_anchors * values[kind]

    def check_kinds(self, kinds: list[str]) -> None:
        """Refuse outputs that are not those of such a head."""
        if sorted(kinds) not in (sorted(ANCHOR_KINDS), sorted(ANCHOR_KINDS[:2])):
            raise CardError(f"output kinds {kinds} of an anchor head; expected {', '.join(ANCHOR_KINDS)}, each once")


@dataclass(frozen=True, slots=True)
class CenterHead:
    """Boxes at the peaks of heat maps (CenterPoint; OpenPCDet's and mmdet3d's CenterHead)."""

    # as of `AnchorHead`; ``scores`` is of ``heatmap``
    classes: tuple[str, ...]
    stride: int
    scores: Scores
    max_candidates: int
    across_classes: bool
    # numbers of classes that share one box at each position, in the order of the classes; they add up to all classes.
    # Of a group's boxes that overlap, only the best one stays, whatever their classes.
    groups: tuple[int, ...]
    # order of the channels of ``rot``: ``"sin_cos"`` of mmdet3d, ``"cos_sin"`` of OpenPCDet
    rotation: Literal["sin_cos", "cos_sin"]

    kind = "centers"
    channels_last = False

    def __post_init__(self) -> None:
        _check_common(self)
        if sum(self.groups) != len(self.classes) or not all(n >= 1 for n in self.groups):
            raise CardError(
                f"head.groups is {reprlib.repr(self.groups)}; expected numbers from 1 on that add up to the "
                f"{len(self.classes)} classes"
            )
        if self.rotation not in ("sin_cos", "cos_sin"):
            _FIELDS.refuse("head.rotation", self.rotation, "sin_cos or cos_sin")

    def n_channels(self, kind: str, nth: int = 0, n: int = 1) -> int:
        """Channels of the ``nth`` of ``n`` outputs of a kind: one for each group, or one for all."""
        if kind == "heatmap":
            return self.groups[nth] if n > 1 else len(self.classes)
        return sum(CENTER_VALUES[part] for part in kind.split("_")) * (1 if n > 1 else len(self.groups))

    def check_kinds(self, kinds: list[str]) -> None:
        """Refuse outputs that are not those of such a head."""
        parts = sorted(part for kind in {*kinds} for part in kind.split("_") if part != "vel")
        counts = {kinds.count(kind) for kind in kinds}
        if parts != sorted({"heatmap", *CENTER_VALUES} - {"vel"}) or not counts <= {1, len(self.groups)}:
            raise CardError(
                f"output kinds {kinds} of a center head; expected heatmap, reg, height, dim and rot, each once or once "
                f"for each of the {len(self.groups)} groups"
            )


Head = AnchorHead | CenterHead
HEADS = {"anchors": AnchorHead, "centers": CenterHead}


def _check_common(head: Head) -> None:
    _FIELDS.whole("the number of head.classes", len(head.classes), 1, 254)
    for name in head.classes:
        check_text("head.classes", name, CardError)
    _FIELDS.whole("head.stride", head.stride, 1, 64)
    _FIELDS.whole("head.max_candidates", head.max_candidates, 1, MAX_CANDIDATES)
    if head.scores not in ("logits", "probabilities"):
        _FIELDS.refuse("head.scores", head.scores, "logits or probabilities")
