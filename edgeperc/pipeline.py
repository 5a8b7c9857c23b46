"""From a scan in the frame of the models to labels, cells and boxes: the stages in their order."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from .agreement.cells import agree_on_cells, mark_cells
from .agreement.rules import (
    Support,
    agree_on_boxes,
    agree_on_points,
    find_support,
    find_voters,
    roles_of,
    stand_boxes,
    without_poles,
)
from .agreement.votes import VEHICLE, Sight
from .ground.ceiling import find_hall, part_own, without_impossible
from .ground.observed import Observer
from .ground.planes import FIRST_REACH_HEIGHTS, FIRST_REACH_M, GroundFit, fit_ground
from .ground.scan import Scan
from .inference.crop import Crop, sectors_of_turn, spread
from .inference.decode import decode_boxes, decode_cells, decode_labels
from .inference.object_network import PARTS, BoxesFrom, ObjectNetwork
from .inference.pillar_network import PillarNetwork
from .inference.projection import input_heights, make_projector
from .inference.session import Session
from .objects.boxes import join_boxes, objects_from_points, weigh
from .objects.candidates import MIN_DETECTOR_SCORE
from .objects.cluster import sort_points
from .objects.linkage import Strips
from .objects.refine import label_points, remove_outliers
from .preprocess.interpolation import Interpolator
from .system.lanes import Lanes, Stopwatch, Values
from .types.frame import ModelFrame, turned
from .types.mounting import MODEL_HEIGHT_M, Mounting
from .types.perception import Box, GroundSurface, PointLabels, TopView
from .types.points import Bytes, Heights, Ids, Ints, Points, Rows
from .types.sensor import SensorProfile
from .types.views import RangeImageGeometry, TopViewGeometry

# What is taken from the scores of the object network, so that points are completed from 0.7 and supported from 0.5 on.
# All round on PandaSet, Lyft, Argoverse 2 and DDAD, 191 of 191 vehicles' boxes from 0.7 on are at a vehicle, and 236 of
# 304 from 0.5 to 0.7.
LESS_SURE = 0.2


class Parts(NamedTuple):
    """The answer to a scan, in the frame of the models; None without such a network, or where no ground is needed.
    ``beside`` is what was computed beside it.
    """

    points: PointLabels | None
    top_view: TopView | None
    boxes: Sequence[Box]
    ground: GroundSurface | None
    beside: Any


@dataclass(frozen=True)
class Options:
    """How the parts become one answer (`edgeperc.Perceiver`).

    Boxes below ``network_score``, ``cluster_score`` and ``object_score`` are dropped. ``distance_per_m`` links the
    points of an object (`edgeperc.objects.cluster.find_clusters`); ``slope`` is that of the highest beam.
    """

    rules: frozenset[str]
    boxes_from: BoxesFrom
    network_score: float
    cluster_score: float
    object_score: float
    distance_per_m: float
    slope: float
    full_turn: bool


class View(NamedTuple):
    """The points of a scan that a view needs, (n, 4), and their rows in the scan; None for all."""

    points: Points
    rows: Rows | None


class TopViewNetwork:
    """The top view: vehicles and drivable area ahead (SSADNet)."""

    def __init__(self, session: Session, sensor: SensorProfile) -> None:
        view = session.card.view
        assert isinstance(view, TopViewGeometry)
        self.session, self.card, self.view = session, session.card, view
        self.projector = make_projector(view, session.card.input)
        self.index = np.empty((view.height, view.width), np.int32)
        self._frame, self._observer = ModelFrame.of_training(self.card.mount_height_m), Observer(view, sensor)

    def project(self, near: View) -> None:
        """Write the points into the network's input (SSADNet 2.1.2)."""
        pixel = np.empty(len(near.points), np.int32)
        self.projector.fill(self._frame.move_back(near.points), self.session.input, self.index, pixel, None)

    def find_boxes(self, projected: None, score_threshold: float, named_from: float) -> Sequence[Box]:
        """Run the network on what was projected, and decode its boxes (SSADNet 3.1); weak ones without a class."""
        return self._frame.move_boxes(decode_boxes(self.card, self.session.run(), score_threshold, named_from))

    def label_cells(self, near: View, boxes: Sequence[Box], mounting: Mounting) -> TopView:
        """Class of every cell, and which cells the scan observed; after `find_boxes`."""
        view = self.view
        labels = decode_cells(self.card, self.index >= 0, self.session.outputs, boxes)
        observed, between_beams = self._observer.observe(near.points, self.index, mounting)
        return TopView(
            labels, self.card.classes, view.cell_m, view.x_range_m, view.y_range_m, observed, mounting, between_beams
        )


class RangeImageNetwork:
    """The range image: a class for every point (PointSeg)."""

    def __init__(self, session: Session, interpolator: Interpolator | None) -> None:
        view = session.card.view
        assert isinstance(view, RangeImageGeometry)
        self.session, self.card, self.view, self.interpolator = session, session.card, view, interpolator
        self.projector = make_projector(view, session.card.input)
        self.index = np.empty((view.height, view.width), np.int32)
        self._frame = ModelFrame.of_training(self.card.mount_height_m)
        self._edges_meet = view.azimuth_left_deg - view.azimuth_right_deg == 360.0

    def second(self) -> RangeImageNetwork:
        """The same with buffers of its own, for another thread."""
        return RangeImageNetwork(self.session.second(), self.interpolator)

    def label(self, points: Points, height_m: Heights | None, watch: Stopwatch) -> PointLabels:
        """Project points, run the network, decode pixels, remove outliers and label the points (PointSeg 3.1, 3.4)."""
        points = self._frame.move_back(points)
        pixel = np.empty(len(points), np.int32)
        if self.interpolator is None:
            self.projector.fill(points, self.session.input, self.index, pixel, height_m)
            watch.lap("project")
        else:
            self.projector.mark(points, self.index.reshape(-1), pixel)
            watch.lap("project")
            # Interpolated points are in the image only; refinement uses the points of the scan. The ground is found
            # anew below them: with heights between those of their neighbors, IoU of cars is up to 1.9 points lower.
            dense, filled = self.interpolator.fill(points, self.index)
            heights = input_heights(self.projector, self._frame.move(dense))
            self.projector.fill_image(dense, filled, self.session.input, heights)
            watch.lap("adapt")
        ((kind, raw),) = self.session.run().items()
        watch.lap("infer")
        pixels = decode_labels(raw, kind, model=self.card.name)
        watch.lap("decode")
        cleaned = remove_outliers(points, self.index, pixels, self.card.classes, full_turn=self._edges_meet)
        labels = label_points(points, pixel, self.index, cleaned, full_turn=self._edges_meet)
        watch.lap("refine")
        return PointLabels(labels, pixel >= 0, self.card.classes)

    def objects_of(self, labels: PointLabels) -> PointLabels:
        """The labels of the classes that have boxes."""
        return labels.objects(self.card.box_classes)


class Pipeline:
    """Networks, and what makes one answer of theirs. The next scan overwrites their buffers.

    ranged : the same network once for each lane that may run it; none without a range image.
    """

    def __init__(
        self,
        top: TopViewNetwork | None,
        ranged: Sequence[RangeImageNetwork],
        options: Options,
        lanes: Lanes,
        objects: ObjectNetwork | None = None,
        pillars: PillarNetwork | None = None,
    ) -> None:
        self.top, self.ranged, self.options, self._lanes = top, ranged, options, lanes
        self.objects, self.pillars = objects, pillars
        self._least_score = options.network_score if objects is None else min(options.network_score, MIN_DETECTOR_SCORE)
        projectors = [network.projector for network in (top, *ranged) if network is not None]
        self.needs_ground = (
            bool(options.rules)
            or objects is not None
            or any(projector.needs_ground for projector in projectors)
            or (options.boxes_from != "network" and bool(ranged))
        )
        self.sectors = sectors_of_turn(ranged[0].view) if ranged and options.full_turn else []
        # Half of the points of a scan are near no view that looks ahead: 16.1 in place of 17.5 ms.
        views = [network.view for network in (top, *ranged[:1]) if network is not None]
        self.crop, self._crop_gathered = (Crop([] if options.full_turn else views) for _ in range(2))

    def __call__(
        self,
        points: Points,
        mounting: Mounting,
        watch: Stopwatch,
        beside: Callable[[Points], object] | None = None,
        earlier: Points | None = None,
    ) -> Parts:
        """Perceive points in the frame of the models, (n, 4) float32, read-only, finite or NaN; ``beside`` is computed
        of them when a lane has nothing else to do. Ground and objects are found with ``earlier`` points of the same
        frame, too, if there are any.
        """
        top, options, rules, per_m = self.top, self.options, self.options.rules, self.options.distance_per_m

        # A value stands after those that it needs, and before those that are less urgent.
        value = Values(watch)
        absent, nothing = value("check", _absent), value("check", tuple)
        near = value("project", self._select, points)
        planes = scan = gathered = surface = cells = labels = places = absent
        boxes = detected = detections = objects = nothing
        if self.needs_ground:
            planes = value("cluster", _fit_ground, points, earlier, mounting)
            scan = value("cluster", _on_ground, near, planes)
            gathered = scan if earlier is None else value("cluster", self._gathered, planes)
            surface = value("cluster", GroundFit.surface, planes)

        # The top view (SSADNet)
        if top is not None:
            projected = value("project", top.project, near)
            detected = value("infer", top.find_boxes, projected, self._least_score, options.network_score)
            boxes = value("decode", _at_least, detected, options.network_score)
        if self.objects is not None:
            places = value("cluster", self.objects.cluster, gathered, options.boxes_from, per_m)

        # The range image (PointSeg), once or for each sector of a turn
        free = deque(self.ranged)  # of this call: an interrupt would lose one that a lane has taken
        sectors = [value("refine", self._label_sector, k, near, scan, watch, free) for k in range(len(self.sectors))]
        if sectors:
            labels = value("refine", _joined, near, *sectors)
        elif self.ranged:
            labels = value("refine", self._label_ahead, near, scan, watch)

        # Objects of a detector, and by the points of their candidates
        if (detector := self.pillars if options.boxes_from != "clusters" else None) is not None:
            detections = value("infer", detector.find_boxes, points)
        if self.objects is not None:
            detected = detected if options.boxes_from != "clusters" else nothing
            shown = [nothing] * (PARTS - 1) + [detected]
            looks = [value("infer", self.objects.look, k, gathered, places, shown[k]) for k in range(PARTS)]
            objects = value("infer", self.objects.find_boxes, gathered, places, detected, options.object_score, *looks)

        # Objects alone: classes such as road and building are background to the stages below
        seen, labels = labels, value("refine", self.ranged[0].objects_of, labels) if self.ranged else absent

        # Objects, and what the parts say of one another (KUL-Seg 5.2)
        clusters = upright = support = absent
        agreed, trusted, joined = labels, boxes, boxes
        if self.ranged and rules:
            strips = value("cluster", _sorted, scan, per_m)
            upright = value("agree", without_poles, scan, labels, rules)
            support = value("cluster", find_support, scan, labels, boxes, rules)
            clusters = value("cluster", find_voters, scan, labels, support, strips, distance_per_m=per_m, rules=rules)
        if top is not None:
            cells = value("decode", top.label_cells, near, boxes, mounting)
        if self.ranged and rules:
            if self.objects is not None or detector is not None:  # boxes outvote clusters
                support = value("cluster", _support, scan, labels, rules, mounting, boxes, objects, detections)
            agreed = value("agree", self._agreed, scan, labels, clusters, support, upright, cells, mounting)
            trusted = joined = value("agree", agree_on_boxes, boxes, scan, agreed, rules)
        if self.ranged and options.boxes_from != "network":
            left = agreed if self.objects is None or not rules else value("cluster", _unboxed, agreed, support)
            around = value("cluster", _objects, scan, left, clusters, trusted, options)
            joined = value("cluster", self._join, trusted, around)
        standing = joined
        if rules and self.objects is None:
            standing = value("agree", stand_boxes, joined, scan, agreed, rules, per_m)
        if self.objects is not None:
            labeled, score = bool(self.ranged) and options.boxes_from != "network", options.cluster_score
            standing = value("infer", self.objects.complete, gathered, places, objects, standing, labeled, score)
        if detector is not None:
            standing = value("cluster", _detected, detections, standing, detector, options.cluster_score)
        if "ceiling" in rules:
            hall = value("agree", find_hall, points, mounting)
            standing = value("agree", without_impossible, standing, hall, mounting)
        joined, view = joined if self.objects is None and detector is None else standing, cells
        if top is not None and rules:
            marks = value("agree", mark_cells, cells, scan, agreed, rules)
            view = value("agree", _agreed_cells, cells, agreed, joined, boxes, trusted, marks, rules)
        whole = value("refine", _whole, seen, agreed, near, len(points))
        extra = absent if beside is None else value("check", beside, points)
        self._lanes.run(value)
        return Parts(whole(), view(), standing(), surface(), extra())

    def _select(self, points: Points) -> View:
        return View(*self.crop.select(points))

    def _gathered(self, planes: GroundFit) -> Scan:
        return _on_ground(View(*self._crop_gathered.select(planes.points)), planes)

    def _label_ahead(self, near: View, scan: Scan | None, watch: Stopwatch) -> PointLabels:
        return self.ranged[0].label(near.points, None if scan is None else scan.ground.height_m, watch)

    def _label_sector(
        self, k: int, near: View, scan: Scan | None, watch: Stopwatch, free: deque[RangeImageNetwork]
    ) -> tuple[PointLabels, Ints | None]:
        """Labels of the points in a sector of the turn, by a network that is free, and their rows."""
        turn_rad, crop = self.sectors[k]
        points, rows = crop.select(near.points)
        heights = None if scan is None else scan.ground.height_m
        if heights is not None and rows is not None:
            heights = heights[rows]
        # What float32 cannot hold after the turn is not in view.
        network = free.pop()
        try:
            return network.label(turned(points, turn_rad) if k else points, heights, watch), rows
        finally:
            free.append(network)

    def _agreed(
        self,
        scan: Scan,
        labels: PointLabels,
        clusters: Ids,
        support: Support,
        upright: Bytes,
        cells: TopView | None,
        mounting: Mounting,
    ) -> PointLabels:
        sight, rules = Sight(mounting.height_m or MODEL_HEIGHT_M, self.options.slope), self.options.rules
        return agree_on_points(scan, labels, clusters, support, upright, view=cells, sight=sight, rules=rules)

    def _join(self, boxes: Sequence[Box], objects: Sequence[Box]) -> Sequence[Box]:
        """Boxes of the network, and those around clusters; one that the network should have found is weighed."""
        if self.options.boxes_from != "both":
            return objects
        if self.top is not None:
            objects = weigh(objects, self.top.view, self.top.card.box_classes, self.options.cluster_score)
        return join_boxes(boxes, objects)


def _absent() -> None:
    """The value of a part without a network, or that no option asks for."""


def _support(
    scan: Scan, labels: PointLabels, rules: frozenset[str], mounting: Mounting, *found: Sequence[Box]
) -> Support:
    """Boxes that keep and add labels of points: of the top view, of the object network, and of a detector. Those around
    the sensor take the labels of vehicles away: it is on what they show.
    """
    boxes, objects, detections = found
    sure = [*boxes, *detections, *(replace(box, score=box.score - LESS_SURE) for box in objects)]
    others, own = part_own(sure, mounting) if "ceiling" in rules else (sure, [])
    return find_support(scan, labels, others, rules, own=own)


def _unboxed(labels: PointLabels, support: Support) -> PointLabels:
    """Labels without those of vehicles that have a box: what has one needs no other."""
    boxed = np.flatnonzero(support.scores > 0.0)
    left = labels.labels.copy()
    left[boxed[roles_of(labels.classes)[left[boxed]] == VEHICLE]] = 0
    return replace(labels, labels=left)


def _at_least(boxes: Sequence[Box], min_score: float) -> list[Box]:
    return [box for box in boxes if box.score >= min_score]


def _fit_ground(points: Points, earlier: Points | None, mounting: Mounting) -> GroundFit:
    reach_m = max(FIRST_REACH_M, FIRST_REACH_HEIGHTS * (mounting.height_m or 0.0))
    every = points if earlier is None else np.concatenate([points, earlier])
    return fit_ground(every, mount_height_m=MODEL_HEIGHT_M, reach_m=reach_m)


def _on_ground(near: View, planes: GroundFit) -> Scan:
    """The points of a view, which are the first ones of the fit unless it says which."""
    rows = near.rows
    if rows is None and len(near.points) < len(planes.points):
        rows = np.arange(len(near.points), dtype=np.int32)
    return Scan.of(near.points, planes.heights(rows))


def _sorted(scan: Scan, distance_per_m: float) -> Strips:
    return sort_points(scan.points, ~scan.ground.mask, distance_per_m=distance_per_m)


def _whole(seen: PointLabels | None, agreed: PointLabels | None, near: View, n: int) -> PointLabels | None:
    """Labels of all n points of a scan: of objects as agreed, and of all else as seen."""
    if seen is None or agreed is None:
        return None
    return spread([(seen.with_objects(agreed), near.rows)], n)


def _joined(near: View, *sectors: tuple[PointLabels, Ints | None]) -> PointLabels:
    """Labels of all points; one in two sectors keeps that of the first."""
    return spread(sectors, len(near.points))


def _objects(
    scan: Scan, labels: PointLabels, clusters: Ids | None, boxes: Sequence[Box], options: Options
) -> tuple[Box, ...]:
    """Boxes around clusters above the ground; one cut by the edge of the range image gets a box of the whole object."""
    return objects_from_points(
        scan.points,
        labels.labels,
        labels.classes,
        among=~scan.ground.mask,
        height_m=scan.ground.height_m,
        clusters=clusters,
        in_view=labels.in_view,
        others=boxes if options.boxes_from == "both" else (),
        distance_per_m=options.distance_per_m,
        min_score=options.cluster_score,
    )


def _detected(
    detections: Sequence[Box], others: Sequence[Box], detector: PillarNetwork, min_score: float
) -> tuple[Box, ...]:
    """Boxes of a detector, and those of others where it has none: of its classes in its range, with half the score."""
    return join_boxes(detections, weigh(others, detector.field, detector.card.box_classes, min_score))


def _agreed_cells(
    cells: TopView,
    labels: PointLabels | None,
    boxes: Sequence[Box],
    detected: Sequence[Box],
    trusted: Sequence[Box],
    marks: Bytes,
    rules: frozenset[str],
) -> TopView:
    dropped = [box for box in detected if box not in trusted]
    return agree_on_cells(cells, labels, boxes, dropped, marks, rules)
