"""Immutable results, in the frame of the scan (meters, radians); the top view in that of the models."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..errors import ModelError, OptionError, PointsError
from ..system.fields import OPTIONS, Fields
from .choices import DEFAULT_SENSOR, STATIC
from .mounting import MODEL_MOUNTING, Mounting
from .points import Floats, Floats32, Ints, Labels, Mask, Points, as_points, by_axes
from .sensor import RemissionFunction, SensorProfile, get_sensor
from .views import TopViewGeometry

_FIELDS = Fields("box", PointsError, "write it with Box.to_dict", optional=("front",))
_PART = 2**20
_Part = TypeVar("_Part")
ROADS = ("drivable", "road")  # names of classes on which a vehicle may drive, in lower case


@dataclass(frozen=True, slots=True)
class Box:
    """An oriented box around one object.

    Attributes
    ----------
    label : str
        Class name, e.g. ``"car"``.
    score : float
        Confidence in 0..1.
    center : tuple of 3 float
        Middle of the box, x, y, z [m], in the frame of the scan.
    size : tuple of 3 float
        Length (along the heading), width, height [m].
    yaw : float
        Heading about +z from +x [rad], in -pi..pi.
    front : float or None
        Probability in 0..1 that ``yaw`` points to the object's front and not to its rear. None: the heading is known
        only up to half a turn.
    """

    label: str
    score: float
    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float
    front: float | None = None

    def corners(self) -> Floats:
        """Corners of the footprint, (4, 2) x, y [m]: front-left, rear-left, rear-right, front-right."""
        along, across = self.size[0] / 2.0, self.size[1] / 2.0
        local = np.array([[along, across], [-along, across], [-along, -across], [along, -across]])
        cos, sin = np.cos(self.yaw), np.sin(self.yaw)
        return local @ np.array([[cos, sin], [-sin, cos]]) + np.asarray(self.center[:2])

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON, rounded to 0.1 mm, 0.00001 rad and 0.0001 of the score; `from_dict` reads it."""
        return {
            "label": self.label,
            "score": round(float(self.score), 4),
            "center": [round(float(v), 4) for v in self.center],
            "size": [round(float(v), 4) for v in self.size],
            "yaw": round(float(self.yaw), 5),
            "front": None if self.front is None else round(float(self.front), 4),
        }

    @classmethod
    def from_dict(cls, document: Mapping[str, Any]) -> Box:
        """Read what `to_dict` wrote. Other keys are ignored, so the record of a track is read as its box.

        Without ``front``, as in records of earlier versions, it is None.

        Raises
        ------
        PointsError
            A key is missing, or its value is of another type or length.
        """
        return _FIELDS.read(cls, document, "box")


@dataclass(frozen=True, slots=True, eq=False)
class TopView:
    """A class for every cell of the ground ahead (SSADNet 2.1.2, 3.1.2).

    Cells lie in the frame of the models: x forward, y left, the road 1.73 m below the origin. It is the frame of the
    scan if the sensor is mounted as on the training vehicle; otherwise ``ModelFrame(perception.mounting).move(points)``
    (`edgeperc.ModelFrame`) moves points of the scan into it.

    Attributes
    ----------
    labels : (rows, columns) uint8
        Index into ``classes``. Row 0 is farthest ahead, column 0 leftmost.
    classes : tuple of str
    cell_m : float
        Edge of a cell [m].
    x_range_m, y_range_m : tuple of 2 float
        Nearest and farthest x, rightmost and leftmost y [m].
    observed : (rows, columns) bool
        Cells that the scan observed: with a return, or passed closely by a ray to a return on the ground
        (`observed.Observer`). The labels of the other cells are only the network's guess. They lie behind
        objects, between the rays of sensors with few beams, or beyond the last return.
    mounting : Mounting
        That of the scan, as in `Perception`.
    between_beams : (rows, columns) bool, optional
        Cells that are not observed in gaps that the spacing of the sensor's beams explains
        (`edgeperc.ground.observed.Observation`). A `Perceiver` knows them. None: no cell is known to be one.
    """

    labels: Labels
    classes: tuple[str, ...]
    cell_m: float
    x_range_m: tuple[float, float]
    y_range_m: tuple[float, float]
    observed: Mask
    mounting: Mounting = MODEL_MOUNTING
    between_beams: Mask | None = None

    @property
    def geometry(self) -> TopViewGeometry:
        """Where the cells lie."""
        return TopViewGeometry(self.x_range_m, self.y_range_m, cell_m=self.cell_m)

    @property
    def road(self) -> Mask:
        """Cells labeled drivable, observed or not, (rows, columns) bool; all False if the model has no such class."""
        if "drivable" not in self.classes:
            return np.zeros(self.labels.shape, dtype=np.bool_)
        return self.labels == self.classes.index("drivable")

    @property
    def drivable(self) -> Mask:
        """Cells labeled drivable that the scan observed, (rows, columns) bool. An empty scan has none."""
        return self.road & self.observed

    @property
    def drivable_area_m2(self) -> float:
        """Area of the drivable cells [m2], observed ones only."""
        return float(np.count_nonzero(self.drivable)) * self.cell_m**2

    def to_meters(self, row: float, col: float) -> tuple[float, float]:
        """Center of a cell as x, y [m] in the frame of the cells."""
        return self.x_range_m[1] - (row + 0.5) * self.cell_m, self.y_range_m[1] - (col + 0.5) * self.cell_m


@dataclass(frozen=True, slots=True, eq=False)
class PointLabels:
    """A class for every input point, in input order.

    Attributes
    ----------
    labels : (n,) uint8
        Index into ``classes``; 0 for points out of the network's view and for dropped points (`DroppedPoints`).
    in_view : (n,) bool
        False if the point is out of the network's view; its label 0 is then not a prediction.
    classes : tuple of str
    """

    labels: Labels
    in_view: Mask
    classes: tuple[str, ...]

    def objects(self, kinds: Collection[str] = ()) -> PointLabels:
        """The labels of objects alone.

        Parameters
        ----------
        kinds : collection of str
            Classes of objects, as the ``box_classes`` of a card say; by default all but those in `STATIC`.

        Returns
        -------
        PointLabels
            Points of other classes are background, which has number 0. The same object if there are none.
        """
        kinds = kinds or {*self.classes} - {*STATIC}
        names = tuple(name for k, name in enumerate(self.classes) if k == 0 or name in kinds)
        if names == self.classes:
            return self
        number = np.array([names.index(name) if name in names else 0 for name in self.classes], np.uint8)
        return PointLabels(number[self.labels], self.in_view, names)

    def with_objects(self, objects: PointLabels) -> PointLabels:
        """These labels with those that `objects` gave replaced; an object that is none any more is background."""
        if objects.classes == self.classes:
            return objects
        number = np.array([self.classes.index(name) for name in objects.classes], np.uint8)
        static = np.isin(self.labels, [k for k, name in enumerate(self.classes) if name not in objects.classes])
        labels = np.where((objects.labels == 0) & static, self.labels, number[objects.labels])
        return PointLabels(labels, objects.in_view, self.classes)

    @property
    def n_in_view(self) -> int:
        """Number of points in view, which `counts` counts; by default the network sees the quarter turn ahead."""
        return int(np.count_nonzero(self.in_view))

    def counts(self) -> dict[str, int]:
        """Number of points by class, of the `n_in_view` points in view."""
        counted = np.bincount(self.labels[self.in_view], minlength=len(self.classes))
        return {name: int(counted[k]) for k, name in enumerate(self.classes)}


@dataclass(frozen=True, slots=True, eq=False)
class ImageLabels:
    """A class for every pixel of a camera's image, at the image's own size.

    Attributes
    ----------
    labels : (H, W) uint8
        Index into ``classes``; 255 for a pixel without a class, which a network never gives, but labeled images have.
        Row 0 is the top, column 0 leftmost.
    classes : tuple of str
    """

    labels: Labels
    classes: tuple[str, ...]

    @property
    def drivable(self) -> Mask:
        """Pixels of the road, (H, W) bool: of a class called road or drivable; all False if there is none."""
        is_road = np.zeros(self.labels.shape, np.bool_)
        for k, name in enumerate(self.classes):
            if name.casefold() in ROADS:  # np.isin takes 47 in place of 4 ms for 2.3 million pixels
                is_road |= self.labels == k
        return is_road

    @property
    def drivable_share(self) -> float:
        """Share of the image's pixels that are road, in 0..1."""
        return float(np.count_nonzero(self.drivable)) / self.labels.size

    def counts(self) -> dict[str, int]:
        """Number of pixels, by class."""
        flat, n_classes = self.labels.reshape(-1), len(self.classes)
        # In parts, because bincount makes eight bytes of each label.
        parts = (np.bincount(flat[k : k + _PART], minlength=n_classes)[:n_classes] for k in range(0, flat.size, _PART))
        counted = sum(parts, np.zeros(n_classes, np.int64))
        return {name: int(counted[k]) for k, name in enumerate(self.classes)}

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON: ``width``, ``height``, ``drivable_share`` and ``pixel_counts`` by class."""
        height, width = self.labels.shape
        return {
            "width": width,
            "height": height,
            "drivable_share": round(self.drivable_share, 4),
            "pixel_counts": self.counts(),
        }


@dataclass(frozen=True, slots=True, eq=False)
class GroundSurface:
    """The ground that a scan showed, in the frame of the models (KUL-Seg 5.2).

    `edgeperc.ground.planes.heights_above` gives the height of any points above it.

    Attributes
    ----------
    plane : tuple of 3 float, or None
        a, b, c of z = a x + b y + c [m] around the vehicle. None if the scan showed no ground.
    expected : tuple of 3 float
        The same, or the level plane at the mounting height.
    planes : (16, 16, 3) float64, or None
        Slopes along x and y, and height in the middle [m], of each region of 8 m; None without ground.
    cells : (k,) int32
        Cells of 0.5 m with a return: row of x times 256 plus row of y.
    lowest : (k, 4) float32
        The lowest return of each: x, y, z [m], remission.
    """

    plane: tuple[float, float, float] | None
    expected: tuple[float, float, float]
    planes: Floats | None
    cells: Ints
    lowest: Floats32


@dataclass(frozen=True, slots=True)
class DroppedPoints:
    """Number of input points that are not returns of the world, by kind. Each counts once, as the first of its kinds.

    Attributes
    ----------
    not_finite : int
        A coordinate is not finite, or the remission is not when scaled.
    too_near : int
        At most the profile's ``min_range_m`` from the sensor: beams without a return, such as (0, 0, 0).
    ego : int
        Inside the profile's ``ego_box``: the own vehicle.
    """

    not_finite: int = 0
    too_near: int = 0
    ego: int = 0

    @property
    def total(self) -> int:
        """Number of dropped points."""
        return self.not_finite + self.too_near + self.ego


@dataclass(frozen=True, slots=True)
class SensorHealth:
    """What the window of the sensor and the weather do to a scan (`edgeperc.preprocess.health`).

    Attributes
    ----------
    blocked : float
        Share of the sectors, in azimuth and elevation, that should show the ground and return nothing.
    blocked_deg : tuple of tuples of 2 float
        Left and right edge of each blocked sector [deg], counter-clockwise from x, in the frame of the models.
    isolated : float
        Share of the returns within 10 m that have no neighbor: drops of rain, flakes of snow, dust, spray.
    range_m : float
        95 % of the returns are nearer [m].
    normal_range_m : float or None
        The same in the first scans; None in the first one.
    returns_share : float or None
        Number of returns, as a share of that in the first scans.
    has_drops, has_cloud, has_fog : bool
        Isolated returns that are dim, on nearly all sides (rain, snow) or on one (spray, dust, exhaust); a range that
        shrank, with returns that are isolated or missing.
    n_drops : int
        Points that were left out as drops; 0 without ``has_drops``. They are labeled 0, and not in view.
    beams_missing : int
        The lowest beams of the sensor's profile, if they should show the ground and none of them returns anything.
    other_sensor_deg : tuple of 2 float, or None
        Lowest and highest elevation of the returns [deg], if they are those of another sensor than the first scans'.
    findings : tuple of str
        One sentence for each sign: what came, what was expected, and what to do.
    """

    blocked: float = 0.0
    blocked_deg: tuple[tuple[float, float], ...] = ()
    isolated: float = 0.0
    range_m: float = 0.0
    normal_range_m: float | None = None
    returns_share: float | None = None
    has_drops: bool = False
    has_cloud: bool = False
    has_fog: bool = False
    n_drops: int = 0
    beams_missing: int = 0
    other_sensor_deg: tuple[float, float] | None = None
    findings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON, shares rounded to 0.0001 and ranges to 0.1 m."""
        rounded = {"blocked": 4, "isolated": 4, "returns_share": 4, "range_m": 1, "normal_range_m": 1}
        record = asdict(self) | {"blocked_deg": [[*arc] for arc in self.blocked_deg], "findings": [*self.findings]}
        return record | {k: round(record[k], n) for k, n in rounded.items() if record[k] is not None}


@dataclass(frozen=True, slots=True, eq=False)
class Perception:
    """Everything perceived in one scan, in one image, or in both.

    Attributes
    ----------
    n_points : int
        Points in the input; 0 without a scan.
    n_dropped : int
        Input points that are not returns of the world: the total of ``dropped``. They are labeled 0, are not in view,
        and take no part in anything.
    points : PointLabels or None
        From a range-image model; None without one.
    top_view : TopView or None
        From a top-view model; None without one.
    boxes : tuple of Box
        Best score first.
    stage_ms : mapping
        Wall time [ms] of ``check``, ``project``, ``infer``, ``decode``, ``refine``, ``cluster`` and ``agree``, and of
        ``adapt`` for sensors whose scans are adapted. ``project``, ``infer`` and ``decode`` include a camera's.
    providers : mapping
        What ran, by model name, e.g. ``"pointseg int8, CPUExecutionProvider"``.
    fitness : tuple of str
        How the scan differs from the training scans, one sentence for each difference; empty if there is none.
    stamp_s : float or None
        The time given with the scan [s].
    mounting : Mounting
        The mounting with which the scan was moved into the frame of the models: as given, or as estimated from the
        scans so far. ``MODEL_MOUNTING``: the scan was not moved.
    remission : RemissionFunction or None
        The function that converted the remission: that of the sensor's profile, one that is matched to the scans so
        far, or a constant if the scan has no remission; its ``source`` says which. None: remission was only scaled.
    image : ImageLabels or None
        From a camera model; None without one.
    dropped : DroppedPoints
        ``n_dropped`` by kind.
    ground : GroundSurface or None
        The ground under the scan; None if no stage needed it, or without a scan.
    origin_m : tuple of 3 float, or None
        Place of the frame of the scan in a map [m], as given with the scan: what was subtracted from the coordinates
        (`edgeperc.read_points`). The axes are the map's.
    health : SensorHealth
        What the sensor's window and the weather did to the scan; nothing without a scan.
    sensor : SensorProfile or None
        The sensor that the perceiver took the scan for: its beams and what is no return matter to grids and to `paint`,
        too. None: not known.
    """

    n_points: int
    n_dropped: int
    points: PointLabels | None
    top_view: TopView | None
    boxes: tuple[Box, ...]
    stage_ms: Mapping[str, float]
    providers: Mapping[str, str]
    fitness: tuple[str, ...]
    stamp_s: float | None
    mounting: Mounting = MODEL_MOUNTING
    remission: RemissionFunction | None = None
    image: ImageLabels | None = None
    dropped: DroppedPoints = DroppedPoints()
    ground: GroundSurface | None = None
    origin_m: tuple[float, float, float] | None = None
    health: SensorHealth = SensorHealth()
    sensor: SensorProfile | None = None

    def require_points(self) -> PointLabels:
        """``points``; `ModelError`, which names the model to add, if it is None."""
        return _required(self.points, "no class for every point", "pointseg")

    def require_top_view(self) -> TopView:
        """``top_view``; `ModelError`, which names the model to add, if it is None."""
        return _required(self.top_view, "no top view", "ssadnet")

    def require_image(self) -> ImageLabels:
        """``image``; `ModelError`, which names the model to add, if it is None."""
        return _required(self.image, "no labels of an image", "camseg", "and pass image=")

    def require_ground(self) -> GroundSurface:
        """``ground``; `ModelError`, which names the model to add, if it is None."""
        return _required(self.ground, "no ground", "pointseg", "and leave agree=True")

    def to_map(self, points: ArrayLike) -> Floats:
        """Coordinates of points of the scan in the map, x, y, z [m], (n, 3) float64; exact, unlike float32.

        Parameters
        ----------
        points : (n, 3 or more) array_like, or a table
            x, y, z [m] in the frame of the scan, such as the scan itself; those of a table by their names.

        Raises
        ------
        PointsError
            The place of the scan in a map was not given, or ``points`` are none.
        """
        return by_axes(points)[:, :3].astype(np.float64) + np.array(self._origin())

    @property
    def map_boxes(self) -> tuple[Box, ...]:
        """The boxes with their centers in the map; PointsError if the place of the scan in a map was not given."""
        return self.in_map(self.boxes)

    def in_map(self, boxes: Iterable[Box]) -> tuple[Box, ...]:
        """Boxes in the frame of the scan, such as the ``box`` of each track, with their centers in the map.

        Raises
        ------
        PointsError
            The place of the scan in a map was not given.
        """
        ox, oy, oz = self._origin()
        placed = [(box, *box.center) for box in OPTIONS.each("boxes", boxes, Box)]
        return tuple(replace(box, center=(x + ox, y + oy, z + oz)) for box, x, y, z in placed)

    def _origin(self) -> tuple[float, float, float]:
        if self.origin_m is None:
            raise PointsError(
                "the place of the scan in a map is not known; pass it with the points: origin_m=(x, y, z)"
            )
        return self.origin_m

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON, with the number of points of each class in place of their labels.

        Returns
        -------
        dict
            ``stamp_s``, ``n_points``, ``n_dropped``, ``dropped`` (by kind), ``stage_ms``, ``providers``, ``boxes``
            (`Box.to_dict`), ``drivable_area_m2``, ``point_counts``, ``n_in_view`` (their sum),
            ``fitness``, ``mounting``, ``remission``, ``image`` (`ImageLabels.to_dict`), ``origin_m``,
            ``map_boxes`` and ``sensor_health`` (`SensorHealth.to_dict`). Every key is always present; its value is
            None if no model of that kind ran, if remission was only scaled, or if the place in a map was not given.
        """
        return {
            "stamp_s": None if self.stamp_s is None or not np.isfinite(self.stamp_s) else self.stamp_s,
            "n_points": self.n_points,
            "n_dropped": self.n_dropped,
            "dropped": asdict(self.dropped),
            "stage_ms": {name: round(ms, 3) for name, ms in self.stage_ms.items()},
            "providers": dict(self.providers),
            "boxes": [box.to_dict() for box in self.boxes],
            "drivable_area_m2": None if self.top_view is None else round(self.top_view.drivable_area_m2, 2),
            "point_counts": None if self.points is None else self.points.counts(),
            "n_in_view": None if self.points is None else self.points.n_in_view,
            "fitness": list(self.fitness),
            "mounting": self.mounting.to_dict(),
            "remission": None if self.remission is None else asdict(self.remission),
            "image": None if self.image is None else self.image.to_dict(),
            "origin_m": None if self.origin_m is None else list(self.origin_m),
            "map_boxes": None if self.origin_m is None else [box.to_dict() for box in self.map_boxes],
            "sensor_health": self.health.to_dict(),
        }


def check_perception(perception: object) -> None:
    """OptionError for what is no perception."""
    if not isinstance(perception, Perception):
        raise OptionError(f"got a {type(perception).__name__} for the perception; pass what a Perceiver returned")


def scan_of(perception: Perception, points: ArrayLike) -> Points:
    """The scan that was perceived, as points; PointsError if it is another."""
    check_perception(perception)
    scan = as_points(points)
    if len(scan) != perception.n_points:
        what = f"{len(scan):,} points and a perception of {perception.n_points:,}"
        raise PointsError(f"got {what}; expected the scan that was perceived")
    return scan


def sensor_behind(image: object, given: str | os.PathLike[str] | SensorProfile | None) -> SensorProfile:
    """The sensor that is given, else that of a perception, else the training sensor."""
    if given is None and isinstance(image, Perception):
        given = image.sensor
    return get_sensor(DEFAULT_SENSOR if given is None else given)


def _required(part: _Part | None, lacks: str, model: str, also: str = "") -> _Part:
    """A part of a perception that its models need not give."""
    if part is None:
        raise ModelError(
            f"the perception has {lacks}: no model that ran on this scan gives it; add {model!r} to the models of the "
            f"Perceiver {also}".rstrip()
        )
    return part
