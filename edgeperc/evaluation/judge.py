"""Evaluate the perception of one scan against its truth."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..agreement.rules import RULES
from ..datasets.kitti import Frame, KittiObjects, RoadFrame, scan_hash
from ..datasets.layout import COARSE, IGNORED, box_label, class_number, known_layouts
from ..datasets.scan_folder import ScanFolder, ScanFrame
from ..errors import ModelError, SplitError
from ..ground.planes import find_ground
from ..inference.decode import decode_classes
from ..inference.object_network import BoxesFrom
from ..inference.pillar_network import field_of
from ..inference.projection import make_projector, project
from ..inference.session import Session
from ..objects.boxes import classes_of_boxes
from ..perceiver import Perceiver
from ..preprocess.remission import tell_beyond
from ..simulation.samples import IGNORE
from ..simulation.scene import POINT_CLASSES
from ..types.card import ModelCard
from ..types.choices import STATIC, VEHICLES
from ..types.frame import ModelFrame
from ..types.geometry import inside
from ..types.mounting import MODEL_MOUNTING, Mounting
from ..types.perception import Box, Perception, PointLabels, TopView
from ..types.points import Bytes, Floats, Labels, Points, read_only
from ..types.sensor import SensorProfile
from ..types.views import TopViewGeometry
from .causes import count_causes
from .center_ap import count_centers
from .kitti_ap import count_all_round, count_in_image
from .metrics import FEWEST_RETURNS, BoxEvaluator, ProbabilitySweep, boxes_to_find, object_key
from .mistakes import Mistakes
from .tables import ALL_ROUND, BANDS, SITTING, Record, banded, within
from .truth import Truth, folder_truth, kitti_truth, semantickitti_truth, simulated_truth

FARTHEST_M = 46.0  # farther objects are evaluated by their points, but never listed as mistakes
_SCANS_CHECKED = 10  # by `check_scans`
_NEAR_M = 20.0
_MOST_EMPTY = 0.25  # of near boxes; 0 of the labels of six sets, 45 to 75 % of those of their next drive


@dataclass(frozen=True)
class Perceiving:
    """How the scans are perceived.

    Attributes
    ----------
    provider, precision : str
        As in `edgeperc.Perceiver`.
    boxes_from : {"both", "clusters", "network"}
        As in `edgeperc.Perceiver`. The figures ``"boxes"`` are of those that a top-view model or a detector on pillars
        detects, in its view; without one, or with "clusters", of those around clusters, wherever the truth is known.
    rules : collection of str
        Rules of the agreement of labels, boxes and cells; a part of `edgeperc.agreement.rules.RULES` for an ablation.
    score_threshold : float or None
        As in `edgeperc.Perceiver`.
    """

    provider: str = "cpu"
    precision: str = "auto"
    boxes_from: BoxesFrom = "both"
    rules: Collection[str] = RULES
    score_threshold: float | None = None


BY_DEFAULT = Perceiving()
NETWORK_ALONE = Perceiving(boxes_from="network", rules=())
"""The answers of the networks, without clusters and agreement: what the figures of a card are of."""


class Judge:
    """Compares perceptions with their truth. ``road_by`` draws the road that KITTI's labels lack (SSADNet 3.1.2);
    ``mounted``: scans as of a sensor mounted so, found from each alone; ``sensor``: of `perceive_frame`.
    """

    def __init__(
        self,
        models: Sequence[str | Path],
        perceiving: Perceiving = BY_DEFAULT,
        *,
        road_by: str | Path | None = None,
        training_scans: bool = False,
        mounted: Mounting | None = None,
        sensor: SensorProfile | None = None,
        n_threads: int | None = None,
    ) -> None:
        mounting = MODEL_MOUNTING if mounted is None else Mounting()
        mounting = mounting if sensor is None else sensor.mounting
        self.perceive = _perceiver(models, perceiving, n_threads, mounting, sensor)
        self.mounted = None if mounted is None else ModelFrame(mounted)
        self.as_recorded = mounted is None and sensor is None
        self.point_classes: tuple[str, ...] = POINT_CLASSES
        self.drive: str | None = None
        networks = [Network(s) for s in self.perceive.sessions if s.card.view.kind not in ("objects", "pillars")]
        self.from_sensor = next((n for n in networks if n.card.view.kind == "range_image"), None)
        self.from_above = next((n for n in networks if n.card.view.kind == "top_view"), None)
        if self.from_sensor is not None and (
            sensor is not None or not set(STATIC).isdisjoint(self.from_sensor.card.classes)
        ):
            self.point_classes = self.from_sensor.card.classes
        self.view: TopViewGeometry | None = None
        if self.from_above is not None:
            assert isinstance(self.from_above.card.view, TopViewGeometry)
            self.view = self.from_above.card.view
            self.cell_range_m = np.hypot(*np.broadcast_arrays(*self.view.cell_centers()))
        detector = self.from_above if perceiving.boxes_from != "clusters" else None
        self.box_classes = detector.card.box_classes if detector is not None else ()
        self.detected_in = self.view if self.box_classes else None  # None: anywhere
        if not self.box_classes and self.from_sensor is not None and perceiving.boxes_from != "network":
            self.box_classes = classes_of_boxes(self.from_sensor.card.classes)
        of_objects = next((card for card in self.perceive.cards if card.view.kind in ("objects", "pillars")), None)
        if not self.box_classes and of_objects is not None:
            self.box_classes = of_objects.box_classes
            if "objects" not in [card.view.kind for card in self.perceive.cards]:
                self.detected_in = field_of(of_objects, full_turn=sensor is not None)
        drawing = replace(perceiving, boxes_from="network", rules=())
        self.draw_road = None if road_by is None else _perceiver([road_by], drawing, n_threads)
        cards = [*self.perceive.cards]
        if self.draw_road is not None:
            (card,) = self.draw_road.cards
            if card.view != self.view or "drivable" not in card.classes:
                raise ModelError(f"{card.name} does not draw the road that {cards[0].name} sees; expected one top view")
            if any((card.name, card.version) == (judged.name, judged.version) for judged in cards):
                raise ModelError(f"{card.name} {card.version} cannot draw its own truth; name another model")
            cards.append(card)
        self.trained_on = {} if training_scans else training_scans_of(cards)

    def kitti(self, frame: Frame) -> Truth:
        """The truth of a KITTI frame; raises SplitError."""
        check_unseen(self.trained_on, frame.name, frame.drive, frame.points)
        if self.draw_road is None:
            return kitti_truth(frame, self.view)
        (card,) = self.draw_road.cards
        drawn = self.draw_road(frame.points).top_view
        assert drawn is not None
        return kitti_truth(frame, self.view, (f"road drawn by {card.name} {card.version}", drawn.road))

    def semantickitti(self, frame: RoadFrame) -> Truth:
        """The truth of a SemanticKITTI frame; raises SplitError."""
        check_unseen(self.trained_on, frame.name, frame.drive, frame.points)
        return semantickitti_truth(frame, self.view)

    def simulated(self, seed: int) -> Truth:
        """The truth of a simulated scene."""
        return simulated_truth(seed, self.view, self.point_classes)

    def record(self, truth: Truth) -> tuple[Record, Mistakes | None]:
        """Evaluate one scan; there are no mistakes of scans whose objects are not labeled."""
        return self.compare(truth, self._perceive(truth.points))

    def record_boxes(self, frame: ScanFrame) -> Record:
        """Evaluate the boxes of a scan alone: `kitti_ap` and `center_ap`."""
        truth, perception, scan_boxes = self.perceive_frame(frame)
        tallies: dict[tuple[str, ...], Any] = {}
        if frame.boxes is not None:
            self._count_ap(tallies, truth, perception.boxes, scan_boxes)
        return Record(truth.name, truth.drive, tallies)

    def perceive_frame(self, frame: ScanFrame) -> tuple[Truth, Perception, Sequence[Box]]:
        """Truth and perception of a scan in the frame of the models, and its boxes in that of the scan; as a user's,
        its mounting is that of its drive. Raises SplitError.
        """
        known_as = f"{frame.layout.name}/{frame.name}" if frame.layout.name in known_layouts() else ""
        check_unseen(self.trained_on, frame.name, frame.drive, frame.points, known_as)
        if frame.drive != self.drive:
            self.perceive.reset_mounting()
            self.drive = frame.drive
        perception = self.perceive(frame.points)
        boxes = ModelFrame(perception.mounting).move_boxes(perception.boxes)
        truth = folder_truth(frame, perception.mounting, self.view, self.point_classes)
        return truth, replace(perception, boxes=boxes), perception.boxes

    def compare(
        self, truth: Truth, perception: Perception, scan_boxes: Sequence[Box] | None = None
    ) -> tuple[Record, Mistakes | None]:
        """Evaluate the perception of a scan, the last one; ``scan_boxes``: its boxes in the frame of the scan."""
        scan_boxes = perception.boxes if scan_boxes is None else scan_boxes
        tallies: dict[tuple[str, ...], Any] = {}
        mistakes = None
        if truth.labels is not None:
            mistakes = Mistakes(truth.name, truth.drive, truth.points, np.zeros(len(truth.points), np.uint8))
            if self.box_classes or perception.points is not None:
                seen = (box for box, n in truth.counted if n >= FEWEST_RETURNS)
                tallies["labeled",] = Counter(object_key(truth.drive, box) for box in seen)
            if self.box_classes:
                mistakes = self._count_boxes(tallies, truth, perception, mistakes)
                self._count_ap(tallies, truth, perception.boxes, scan_boxes)
            if perception.points is not None:
                mistakes = self._count_points(tallies, truth, perception.points, mistakes)
        if perception.top_view is not None and self.mounted is None:
            self._count_cells(tallies, truth, perception.top_view)
        return Record(truth.name, truth.drive, tallies), mistakes

    def _perceive(self, points: Points) -> Perception:
        if self.mounted is None:
            return self.perceive(points)
        seen = points.copy()
        seen[:, :3] = (points[:, :3] - self.mounted.t) @ self.mounted.R
        self.perceive.reset_mounting()
        perception = self.perceive(seen)
        return replace(perception, boxes=self.mounted.move_boxes(perception.boxes))

    def _count_boxes(
        self, tallies: dict[tuple[str, ...], Any], truth: Truth, perception: Perception, mistakes: Mistakes
    ) -> Mistakes:
        """Match boxes where the truth is known, of detected classes in the view, and of the three kinds all round."""
        predicted = _comparable(truth, perception.boxes)
        returns = truth.counted
        classes, view = self.box_classes, self.detected_in
        detected = [b for b in predicted if b.label in classes and (view is None or view.holds(*b.center[:2]))]
        to_find, ignored = boxes_to_find(returns, view, classes, known=truth.knows)
        for kind in ("upright", "oriented"):
            evaluator = tallies["boxes", kind] = BoxEvaluator(oriented=kind == "oriented", together=VEHICLES)
            pairs = evaluator.update(detected, to_find, ignored=ignored, drive=truth.drive)
        around: list[tuple[Box | None, Box | None]] = []
        every = tuple(name for classes, _ in ALL_ROUND.values() for name in classes)
        to_find, ignored = boxes_to_find(returns, None, every, known=truth.knows)
        for group, (names, least_iou) in ALL_ROUND.items():
            evaluator = tallies["all_round", group] = BoxEvaluator(least_iou, together=names)
            guesses, rights = ([box for box in boxes if box.label in names] for boxes in (predicted, to_find))
            around += evaluator.update(guesses, rights, ignored=ignored, drive=truth.drive)
        returns_of = {id(box): n for box, n in returns}
        found = {id(right): right for guess, right in (*pairs, *around) if guess and right}
        missed = (right for guess, right in pairs if right and not guess and id(right) not in found)
        return replace(
            mistakes,
            found=tuple(found.values()),
            missed=tuple((right, returns_of[id(right)]) for right in missed),
            false=tuple(guess for guess, right in pairs if guess and not right),
        )

    def _count_ap(
        self, tallies: dict[tuple[str, ...], Any], truth: Truth, boxes: Sequence[Box], scan_boxes: Sequence[Box]
    ) -> None:
        """Match all boxes as KITTI's benchmark does, in its image or all round, and as nuScenes does, all round."""
        predicted = _comparable(truth, boxes)
        labels = {box.label for box in truth.boxes} - {IGNORED}
        to_find, ignored = boxes_to_find(truth.counted, None, labels, known=truth.knows)
        if truth.front is not None:
            tallies["kitti",] = count_in_image(truth.front, scan_boxes, truth.drive)
        else:
            tallies["kitti",] = count_all_round(predicted, to_find, ignored, truth.drive)
        tallies["centers",] = count_centers(predicted, to_find, ignored, truth.drive)

    def _count_points(
        self, tallies: dict[tuple[str, ...], Any], truth: Truth, predicted: PointLabels, mistakes: Mistakes
    ) -> Mistakes:
        """Count labels of points, of pixels before refinement, and causes of wrong ones. Objects that no
        box finds, beyond the view of boxes, count as found if at least half of their points have their label.
        """
        assert self.from_sensor is not None
        assert truth.labels is not None
        right = np.where(predicted.in_view, truth.labels, IGNORE).astype(np.uint8)
        range_m = np.hypot(truth.points[:, 0], truth.points[:, 1])
        labels = renamed(predicted.labels, predicted.classes, truth.classes)
        tallies |= banded(("points",), truth.classes, labels, right, range_m)
        objects = tuple(name for name in truth.classes if name not in STATIC)
        own, true = (renamed(each, truth.classes, objects) for each in (labels, right))
        sure = np.where((true > 0) & find_ground(truth.points).mask, IGNORE, true).astype(np.uint8)
        for box in truth.boxes:
            if box.label == SITTING:
                sure[inside(box, truth.points)] = IGNORE
        tallies |= banded(("sure",), objects, own, sure, range_m)
        if self.as_recorded:
            pixels = renamed(self.from_sensor.point_labels(truth.points), predicted.classes, truth.classes)
            tallies |= banded(("pixels",), truth.classes, pixels, right, range_m)
        counted = right != IGNORE
        if set(truth.classes) <= {*POINT_CLASSES}:
            said, known = (renamed(each, truth.classes, POINT_CLASSES) for each in (labels, truth.labels))
            tallies |= count_causes(truth.points, said, known, counted, predicted.in_view, truth.boxes, truth.drive)
        tallies |= {("objects", band): Counter() for band in BANDS}
        by_box = {id(box) for box in (*mistakes.found, *(box for box, _ in mistakes.missed))}
        hit, missed = [*mistakes.found], [*mistakes.missed]
        for box in truth.boxes:
            kind, distance_m = class_number(box.label, truth.classes), math.hypot(*box.center[:2])
            members = inside(box, truth.points) & (right == kind)
            n_members = int(np.count_nonzero(members))
            if kind in (0, IGNORE) or n_members < FEWEST_RETURNS:
                continue
            for band, within_m in BANDS.items():
                if within(distance_m, within_m):
                    tallies["objects", band][truth.classes[kind], object_key(truth.drive, box)] += 1
            if id(box) in by_box or distance_m >= FARTHEST_M:
                continue
            if 2 * int(np.count_nonzero(labels[members] == kind)) >= n_members:
                hit.append(box)
            else:
                missed.append((box, n_members))
        wrong = np.where(counted & (own != true), np.where(true > 0, 1, 2), 0).astype(np.uint8)
        n_objects = int(np.count_nonzero(counted & ((true > 0) | (own > 0))))
        share = int(np.count_nonzero(wrong)) / max(n_objects, 1)
        return replace(mistakes, wrong=wrong, found=tuple(hit), missed=tuple(missed), wrong_share=share)

    def _count_cells(self, tallies: dict[tuple[str, ...], Any], truth: Truth, view: TopView) -> None:
        """Count the labels of cells for each table, and the probability of road if the true road is known."""
        assert self.from_above is not None
        for table, (classes, right) in truth.cells.items():
            if not self.from_above.card.box_classes:
                every, classes = classes, tuple(name for name in classes if name not in (*VEHICLES, "vehicle"))
                right = renamed(right, every, classes)  # cells of vehicles become those of the first class
            if len(classes) < 2:
                continue
            labels = renamed(view.labels, view.classes, classes)
            tallies |= banded(("segmentation", table), classes, labels, right, self.cell_range_m)
        if truth.road is None or "drivable" not in view.classes:
            return
        table, name = truth.road
        classes, right = truth.cells[table]
        road = np.where(right == IGNORE, IGNORE, right == classes.index(name)).astype(np.uint8)
        for group, decided in (("decision", view.road), ("drivable", view.drivable)):
            tallies |= banded((group,), ("other", name), decided.astype(np.uint8), road, self.cell_range_m)
        probability = self.from_above.probability("drivable")
        for band, within_m in BANDS.items():
            counted = (road != IGNORE) & within(self.cell_range_m, within_m)
            tallies["road", band] = ProbabilitySweep()
            tallies["road", band].update(probability[counted], road[counted])


class Network:
    """Raw outputs of the perceiver's last run, for figures that need more than a perception."""

    def __init__(self, session: Session) -> None:
        self.session, self.card = session, session.card
        self.projector = make_projector(self.card.view, self.card.input)
        self.kind = next(output.kind for output in self.card.outputs if output.kind.startswith("class_"))

    def probability(self, name: str) -> Floats:
        """Probability of one class in each pixel, (H, W) float64."""
        values = self.session.outputs[self.kind].astype(np.float64)
        if self.kind == "class_logits":
            values = np.exp(values - values.max(axis=0))
        return values[self.card.classes.index(name)] / values.sum(axis=0)

    def point_labels(self, points: Points) -> Bytes:
        """Label of the pixel of each point before PointSeg's refinement, (n,) uint8; 0 out of view."""
        labels, _ = decode_classes(self.session.outputs[self.kind], self.kind, model=self.card.name)
        pixel = project(self.projector, read_only(points), ModelFrame.of_training(self.card.mount_height_m)).pixel
        return np.where(pixel >= 0, labels.ravel()[pixel], 0).astype(np.uint8)


def _perceiver(
    models: Sequence[str | Path],
    perceiving: Perceiving,
    n_threads: int | None,
    mounting: Mounting = MODEL_MOUNTING,  # the truth of cells is in the frame of the scan
    sensor: SensorProfile | None = None,
) -> Perceiver:
    return Perceiver(
        list(models),
        sensor=sensor or "hdl-64e",
        full_turn=sensor is not None,
        mounting=mounting,
        provider=perceiving.provider,
        precision=perceiving.precision,
        n_threads=n_threads,
        on_mismatch="ignore",
        score_threshold=perceiving.score_threshold,
        boxes_from=perceiving.boxes_from,
        agree=perceiving.rules,
    )


def _comparable(truth: Truth, boxes: Sequence[Box]) -> list[Box]:
    """Boxes where the truth is known, with the classes that the set tells apart; of others nothing is known."""
    known = [box for box in boxes if truth.knows(box)]
    if truth.box_labels is None:
        return known
    named = (replace(box, label=box_label(box.label, truth.box_labels)) for box in known)
    return [box for box in named if box.label in truth.box_labels]


def renamed(labels: Labels, names: Sequence[str], classes: Sequence[str]) -> Bytes:
    """A model's labels as those of a table: of a coarser class if it lacks one, as in `class_number`, else of its first
    class; `IGNORE` stays as it is.
    """
    numbers = np.full(IGNORE + 1, IGNORE, np.uint8)
    for k, name in enumerate(names):
        others = (name, "vehicle" if name in VEHICLES else "", COARSE.get(name, ""))
        numbers[k] = next((classes.index(other) for other in others if other in classes), 0)
    return numbers[labels]


def check_scans(scans: ScanFolder | KittiObjects, sensor: SensorProfile | None, names: Sequence[str]) -> None:
    """Warn if the first scans of drives have remission in another unit than the sensor's, or labeled boxes in which
    nothing stands, as those of another scan: figures would be worse. Of a few drives, or of few drives a few scans, as
    these scans are read again.
    """
    first = [*{scans.drives[name]: name for name in reversed(names)}.values()]
    some = first if len(first) >= _SCANS_CHECKED else names
    frames = [scans.frame(name) for name in some[:: math.ceil(len(some) / _SCANS_CHECKED) or 1]]
    if sensor is not None:
        tell_beyond(scans.root, sensor, ((frame.name, frame.points) for frame in frames))
    n, empty = 0, list[str]()
    for frame in frames:
        for box in frame.boxes or ():
            (x, y, z), height = box.center, box.size[2]
            if box.label != IGNORED and math.hypot(x, y) < _NEAR_M:
                n += 1
                if not inside(box, frame.points[frame.points[:, 2] > z - 0.25 * height]).any():
                    empty.append(f"the {box.label} at x {x:.1f}, y {y:.1f} of {frame.name}")
    if len(empty) > max(2.0, _MOST_EMPTY * n):
        warnings.warn(
            f"{scans.root}: nothing stands in {len(empty)} of {n} labeled boxes within {_NEAR_M:g} m, such as "
            f"{empty[0]}. Are these the labels of these scans, in their frame (m, x ahead, y left, z up)?",
            stacklevel=3,
        )


def training_scans_of(cards: Sequence[ModelCard]) -> dict[str, set[str]]:
    """Read from cards the `scan_hash` of every real training scan, and the names (SET/NAME) of those of other sets than
    KITTI, by name and version of the model.
    """
    frames = {f"{card.name} {card.version}": card.training.get("frames", {}) for card in cards}
    return {
        model: {*hashes.values(), *(name for name in hashes if "/" in name)} if isinstance(hashes, Mapping) else set()
        for model, hashes in frames.items()
    }


def check_unseen(trained_on: Mapping[str, set[str]], name: str, drive: str, points: Points, known_as: str = "") -> None:
    """Raise `SplitError` if one of the models was trained on this scan (see `training_scans_of`), or on a copy whose
    values were rounded, of a public set that knows it by a name.
    """
    seen = {scan_hash(points), known_as}
    for model, hashes in trained_on.items():
        if not hashes.isdisjoint(seen):
            raise SplitError(
                f"{model} was trained on scan {name} of drive {drive}, so figures on it are too good; evaluate drives "
                "that were held back, or models trained without this drive (--model), or, with 'edgeperc eval', split "
                "'train'; if splits of a description do not list the drive, it is for both: list it, or '*', as train"
            )
