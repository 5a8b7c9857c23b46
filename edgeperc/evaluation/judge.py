"""Compare one scan's perception with its labels."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..card import TopViewGeometry
from ..decode import decode_classes
from ..errors import EdgepercError, ModelError
from ..geometry import draw_footprints, inside
from ..perceiver import BoxesFrom, Perceiver
from ..perception import Box, Perception, PointLabels, TopView
from ..projection import make_projector
from ..session import Session
from ..simulation.samples import IGNORE, POINT_CLASS_OF, labels_by_boxes, simulated_scan
from ..simulation.scene import POINT_CLASSES, TOP_VIEW_CLASSES
from ..zoo import model_path
from .datasets import ROAD_CLASSES, Frame, RoadFrame
from .metrics import BoxEvaluator, ProbabilitySweep
from .mistakes import Mistakes
from .tables import BANDS, VEHICLES, Record, banded, within
from .unseen import check_unseen, training_scans_of

__all__ = ["FEWEST_RETURNS", "Judge", "Truth"]

FEWEST_RETURNS = 3  # no network could tell an object of fewer from clutter
FARTHEST_M = 46.0  # objects beyond count among the points' figures, but for no mistake
GROUND_Z_M = -1.5  # where a cell is looked up in the camera's image

# Names of what is judged in the top view; never put together, for each counts other cells by other truth.
BY_BOXES, OBSERVED, EVERY_CELL = "vehicles from 3-D boxes", "observed cells", "every cell"
Cells = dict[str, tuple[tuple[str, ...], NDArray[np.uint8]]]


@dataclass(frozen=True)
class Truth:
    """A scan and what is known about it.

    Attributes
    ----------
    name, drive : str
    points : (n, 4) float32
    labels : (n,) uint8 or None
        Index into `POINT_CLASSES`, `IGNORE` where unknown; None where neither points nor objects are to be judged.
    boxes : tuple of Box
    returns : tuple of int
        Returns from each box's object.
    known : callable
        Which of some places (k, 3) truth is known at, (k,) bool.
    cells : mapping
        Name of a table to its classes and the truth of every cell (rows, columns) uint8, `IGNORE` where unknown.
    road : tuple of 2 str, or None
        The table and its class by which the drivable cells are judged.
    """

    name: str
    drive: str
    points: NDArray[np.float32]
    labels: NDArray[np.uint8] | None
    boxes: tuple[Box, ...]
    returns: tuple[int, ...]
    known: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    cells: Cells
    road: tuple[str, str] | None = None


class _Network:
    """A model's own outputs, for the figures that a perception does not hold."""

    def __init__(self, model: str | Path, provider: str) -> None:
        self.session = Session(model if Path(model).suffix == ".onnx" else model_path(str(model)), provider)
        self.card = self.session.card
        self.projector = make_projector(self.card.view, self.card.input)
        self.kind = next(output.kind for output in self.card.outputs if output.kind.startswith("class_"))

    def classes(self, points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Logits or probabilities (C, H, W), and the flat pixel of every point."""
        projected = self.projector.project(points)
        self.session.input[:] = projected.image
        return self.session.run()[self.kind], projected.pixel

    def probability(self, points: NDArray[np.float32], name: str) -> NDArray[np.float64]:
        """Of one class in every pixel, (H, W)."""
        values = self.classes(points)[0].astype(np.float64)
        if self.kind == "class_logits":
            values = np.exp(values - values.max(axis=0))
        return values[self.card.classes.index(name)] / values.sum(axis=0)

    def point_labels(self, points: NDArray[np.float32]) -> NDArray[np.uint8]:
        """The label of every point's pixel, as PointSeg has it before any refinement, (n,) uint8."""
        output, pixel = self.classes(points)
        labels, _ = decode_classes(output, self.kind, model=self.card.name)
        return np.where(pixel >= 0, labels.ravel()[pixel], 0).astype(np.uint8)


class Judge:
    """Perceives scans and holds them against their truth.

    Parameters
    ----------
    models : sequence of str or Path
        Shipped names or paths; a range-image model is judged by points, a top-view model by boxes and cells.
    provider : str
    road_by : str, Path or None
        A top-view model whose drivable cells count as the truth of real scans with boxes (SSADNet 3.1.2 takes LoDNN's).
    training_scans : bool
        Judge scans that a model was trained on, too.
    boxes_from : {"network", "clusters", "both"}
        As `Perceiver` has it. Boxes of clusters are judged wherever the truth is known, a top-view model's in its view.
    """

    def __init__(
        self,
        models: Sequence[str | Path],
        *,
        provider: str = "cpu",
        road_by: str | Path | None = None,
        training_scans: bool = False,
        boxes_from: BoxesFrom = "network",
    ) -> None:
        self.perceive = _perceiver(models, provider, boxes_from)
        networks = [_Network(model, provider) for model in models]
        self.from_sensor = next((n for n in networks if n.card.view.kind == "range_image"), None)
        self.from_above = next((n for n in networks if n.card.view.kind == "top_view"), None)
        self.box_classes = self.from_above.card.box_classes if self.from_above and boxes_from != "clusters" else ()
        self.cluster_classes = self.from_sensor.card.classes[1:] if self.from_sensor and boxes_from != "network" else ()
        self.view = self.from_above.card.view if self.from_above else None
        if isinstance(self.view, TopViewGeometry):
            x, y = np.broadcast_arrays(*self.view.cell_centres())
            self.cell_range_m = np.hypot(x, y)
            self.places = np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_Z_M)], axis=1)
        self.draw_road = None if road_by is None else _perceiver([road_by], provider)
        cards = [*self.perceive.cards]
        if self.draw_road is not None:
            (card,) = self.draw_road.cards
            if card.view != self.view or "drivable" not in card.classes:
                raise ModelError(f"{card.name} does not draw the road that {cards[0].name} sees; expected one top view")
            if any((card.name, card.version) == (own.name, own.version) for own in cards):
                raise ModelError(f"{card.name} {card.version} cannot draw its own truth; name another model")
            cards.append(card)
        self.trained_on = {} if training_scans else training_scans_of(cards)

    def kitti(self, frame: Frame) -> Truth:
        """Boxes, and the points and cells in the camera's view outside DontCare.

        Raises
        ------
        SplitError
            A model was trained on this scan.
        """
        check_unseen(self.trained_on, frame.name, frame.drive, frame.points)
        cells: Cells = {}
        if isinstance(self.view, TopViewGeometry):
            vehicles, unnamed = np.zeros((2, self.view.height, self.view.width), np.uint8)
            draw_footprints(vehicles, frame.boxes, self.view, TOP_VIEW_CLASSES)
            # Nobody said whether a tram is a truck.
            strange = [replace(box, label="car") for box in frame.boxes if box.label in ("tram", "misc")]
            draw_footprints(unnamed, strange, self.view, TOP_VIEW_CLASSES)
            known = frame.judges(self.places).reshape(vehicles.shape) & (unnamed == 0)
            by_boxes = np.where(vehicles > 0, vehicles - 1, 0)
            cells[BY_BOXES] = ("background", *VEHICLES), np.where(known, by_boxes, IGNORE).astype(np.uint8)
        if self.draw_road is not None:
            drawn = self.draw_road(frame.points).top_view
            assert drawn is not None
            surface = np.where(vehicles > 0, vehicles, drawn.drivable)
            (card,) = self.draw_road.cards
            title = f"road drawn by {card.name} {card.version}"
            cells[title] = TOP_VIEW_CLASSES, np.where(known, surface, IGNORE).astype(np.uint8)
        returns = tuple(int(np.count_nonzero(inside(box, frame.points, 0.1))) for box in frame.boxes)
        labels = frame.point_labels()
        return Truth(frame.name, frame.drive, frame.points, labels, frame.boxes, returns, frame.judges, cells)

    def semantickitti(self, frame: RoadFrame) -> Truth:
        """Cells with labelled returns.

        Raises
        ------
        SplitError
            A model was trained on this scan.
        """
        check_unseen(self.trained_on, frame.name, frame.drive, frame.points)
        cells: Cells = {}
        if isinstance(self.view, TopViewGeometry):
            cells[OBSERVED] = ROAD_CLASSES, frame.top_view(self.view)
        return Truth(frame.name, frame.drive, frame.points, None, (), (), _everywhere, cells, (OBSERVED, "road"))

    def simulated(self, seed: int) -> Truth:
        """A scene drawn from a seed, which is a drive of its own: everything is known."""
        name, scan = f"scene {seed}", simulated_scan(seed)
        cells: Cells = {}
        if isinstance(self.view, TopViewGeometry):
            cells[EVERY_CELL] = TOP_VIEW_CLASSES, scan.top_view_labels(self.view)
        road = EVERY_CELL, "drivable"
        return Truth(
            name, name, scan.points, labels_by_boxes(scan), scan.boxes, scan.box_points, _everywhere, cells, road
        )

    def record(self, truth: Truth) -> tuple[Record, Mistakes | None]:
        """Judge one scan; the mistakes are None where no objects are known."""
        found = self.perceive(truth.points)
        tallies: dict[tuple[str, ...], Any] = {}
        mistakes = None
        if truth.labels is not None:
            x, y = truth.points[:, 0], truth.points[:, 1]
            shown = (x > -2.0) & (x < 52.0) & (np.abs(y) < 27.0)
            mistakes = Mistakes(truth.name, truth.drive, truth.points[shown], np.zeros(int(shown.sum()), np.uint8))
            if self.box_classes or self.cluster_classes:
                mistakes = self._count_boxes(tallies, truth, found, mistakes)
            if found.points is not None:
                mistakes = self._count_points(tallies, truth, found.points, mistakes, shown)
        if found.top_view is not None:
            self._count_cells(tallies, truth, found.top_view)
        return Record(truth.name, truth.drive, tallies), mistakes

    def _count_boxes(
        self, tallies: dict[tuple[str, ...], Any], truth: Truth, found: Perception, mistakes: Mistakes
    ) -> Mistakes:
        predicted, wanted, ignored = self._judged_boxes(truth, found)
        for kind in ("upright", "oriented"):
            evaluator = tallies["boxes", kind] = BoxEvaluator(oriented=kind == "oriented", together=VEHICLES)
            pairs = evaluator.update(predicted, wanted, ignored=ignored)
        returns = dict(zip(map(id, truth.boxes), truth.returns, strict=True))
        return replace(
            mistakes,
            found=tuple(right for guess, right in pairs if guess and right),
            missed=tuple((right, returns[id(right)]) for guess, right in pairs if right and not guess),
            false=tuple(guess for guess, right in pairs if guess and not right),
        )

    def _count_points(
        self,
        tallies: dict[tuple[str, ...], Any],
        truth: Truth,
        found: PointLabels,
        mistakes: Mistakes,
        shown: NDArray[np.bool_],
    ) -> Mistakes:
        """Also takes objects for found or missed that no box is predicted for, as most of their points are labelled."""
        assert self.from_sensor is not None
        assert truth.labels is not None
        right = np.where(found.in_view, truth.labels, IGNORE).astype(np.uint8)
        range_m = np.hypot(truth.points[:, 0], truth.points[:, 1])
        labels = _renamed(found.labels, found.classes, POINT_CLASSES)
        pixels = _renamed(self.from_sensor.point_labels(truth.points), found.classes, POINT_CLASSES)
        tallies |= banded(("points",), POINT_CLASSES, labels, right, range_m)
        tallies |= banded(("pixels",), POINT_CLASSES, pixels, right, range_m)
        tallies |= {("objects", band): Counter() for band in BANDS}
        by_box = {id(box) for box in (*mistakes.found, *(box for box, _ in mistakes.missed))}
        hit, missed = [*mistakes.found], [*mistakes.missed]
        for box in truth.boxes:
            kind, distance_m = POINT_CLASS_OF.get(box.label), math.hypot(*box.center[:2])
            own = inside(box, truth.points) & (right == kind)
            n_own = int(np.count_nonzero(own))
            if kind is None or n_own < FEWEST_RETURNS:
                continue
            for band, within_m in BANDS.items():
                tallies["objects", band][POINT_CLASSES[kind]] += int(within(distance_m, within_m))
            if id(box) in by_box or distance_m >= FARTHEST_M:
                continue
            if 2 * int(np.count_nonzero(labels[own] == kind)) >= n_own:
                hit.append(box)
            else:
                missed.append((box, n_own))
        counted = right != IGNORE
        wrong = np.where(counted & (labels != right), np.where(right > 0, 1, 2), 0).astype(np.uint8)
        n_objects = int(np.count_nonzero(counted & ((right > 0) | (labels > 0))))
        share = int(np.count_nonzero(wrong)) / max(n_objects, 1)
        return replace(mistakes, wrong=wrong[shown], found=tuple(hit), missed=tuple(missed), wrong_share=share)

    def _count_cells(self, tallies: dict[tuple[str, ...], Any], truth: Truth, found: TopView) -> None:
        assert self.from_above is not None
        for table, (classes, right) in truth.cells.items():
            if not self.box_classes:
                classes, right = _without_vehicles(classes, right)
            if len(classes) < 2:
                continue
            labels = _renamed(found.labels, found.classes, classes)
            tallies |= banded(("segmentation", table), classes, labels, right, self.cell_range_m)
        if truth.road is None or "drivable" not in found.classes:
            return
        table, name = truth.road
        classes, right = truth.cells[table]
        road = np.where(right == IGNORE, IGNORE, right == classes.index(name)).astype(np.uint8)
        tallies |= banded(("decision",), ("other", name), found.drivable.astype(np.uint8), road, self.cell_range_m)
        probability = self.from_above.probability(truth.points, "drivable")
        for band, within_m in BANDS.items():
            judged = (road != IGNORE) & within(self.cell_range_m, within_m)
            tallies["road", band] = ProbabilitySweep()
            tallies["road", band].update(probability[judged], road[judged])

    def _judged_boxes(self, truth: Truth, found: Perception) -> tuple[list[Box], list[Box], list[Box]]:
        """Predictions where truth is known, the boxes to find, and those that need not be found.

        To be found is whatever `FEWEST_RETURNS` or more came from and is of a class that clusters are of, or a vehicle
        whose centre lies in the top view.
        """
        centres = np.array([box.center for box in found.boxes], np.float64).reshape(-1, 3)
        predicted = [box for box, known in zip(found.boxes, truth.known(centres), strict=True) if known]
        wanted: list[Box] = []
        ignored: list[Box] = []
        for box, returns in zip(truth.boxes, truth.returns, strict=True):
            counts = box.label in self.cluster_classes
            if box.label in self.box_classes and isinstance(self.view, TopViewGeometry):
                counts |= self.view.holds(*box.center[:2])
            (wanted if counts and returns >= FEWEST_RETURNS else ignored).append(box)
        return predicted, wanted, ignored


def _perceiver(models: Sequence[str | Path], provider: str, boxes_from: BoxesFrom = "network") -> Perceiver:
    try:
        return Perceiver(list(models), sensor="hdl-64e", provider=provider, on_mismatch="ignore", boxes_from=boxes_from)
    except EdgepercError:
        raise
    except ValueError as exc:  # two models of one view; no labels to cluster by
        raise ModelError(str(exc)) from exc


def _everywhere(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.ones(len(places), np.bool_)


def _without_vehicles(classes: tuple[str, ...], right: NDArray[np.uint8]) -> tuple[tuple[str, ...], NDArray[np.uint8]]:
    """Classes and truth of a table as a model without vehicles is judged: where one stands is no road."""
    kept = tuple(name for name in classes if name not in (*VEHICLES, "vehicle"))
    number = np.full(256, IGNORE, np.uint8)
    number[: len(classes)] = [kept.index(name) if name in kept else 0 for name in classes]
    return kept, number[right]


def _renamed(labels: NDArray[np.uint8], names: Sequence[str], classes: Sequence[str]) -> NDArray[np.uint8]:
    """Labels of a model as those of a table; the first class stands for what the table does not tell apart."""
    coarse = {"drivable": "road", **dict.fromkeys(VEHICLES, "vehicle")}
    own = [name if name in classes else coarse.get(name, "") for name in names]
    return np.array([classes.index(name) if name in classes else 0 for name in own], np.uint8)[labels]
