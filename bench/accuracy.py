"""Compare the measured results with a reference (fp32 on the CPU provider) and with the ground truth."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from edgeperc.evaluation.judge import renamed
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion, boxes_to_find
from edgeperc.simulation.samples import IGNORE, labels_by_boxes
from edgeperc.simulation.scene import POINT_CLASSES, TOP_VIEW_CLASSES, SimulatedScan
from edgeperc.types.choices import VEHICLES
from edgeperc.types.mounting import Mounting
from edgeperc.types.perception import Box, Perception
from edgeperc.types.points import Labels, Points
from edgeperc.types.sensor import SensorProfile, get_sensor
from edgeperc.types.views import TopViewGeometry

from .worker import Prediction

# Results agree if nearly all labels and boxes equal the reference's, and no value of `correctness` falls by 0.01.
LEAST_EQUAL = 0.99
LEAST_BOX_F1 = 0.9
MOST_LOST = 0.01
FARTHEST_M = 50.0


def agreement(reference: Sequence[Prediction], found: Sequence[Prediction]) -> dict[str, Any]:
    """Compare predictions with the reference's on the same scans: of points in view, cells and pixels the share of
    equal labels and the mean IoU, of boxes the matches at IoU 0.5 and F1. None for what the models do not predict.
    """
    result: dict[str, Any] = {"n_scans": len(reference), "points": None, "cells": None, "pixels": None, "boxes": None}
    for name, part in (("points", "points"), ("cells", "top_view"), ("pixels", "image")):
        pairs = [(getattr(right, part), getattr(guess, part)) for right, guess in zip(reference, found, strict=True)]
        if pairs := [pair for pair in pairs if pair[0] is not None and pair[1] is not None]:
            confusion = Confusion(pairs[0][0].classes)
            for right, guess in pairs:
                seen = right.in_view if name == "points" else ...
                confusion.update(guess.labels[seen], right.labels[seen])
            result[name] = {"equal": _rounded(confusion.accuracy()), "mean_iou": _rounded(confusion.mean_iou())}
    boxes_alone = not (result["points"] or result["pixels"])
    if result["cells"] is not None or boxes_alone:
        boxes = BoxEvaluator()
        for right, guess in zip(reference, found, strict=True):
            boxes.update(guess.boxes, right.boxes)
        scores = boxes.overall()
        n = scores.n_truth + scores.n_predicted
        result["boxes"] = {
            "n_reference": scores.n_truth,
            "n_found": scores.n_predicted,
            "n_both": scores.n_hits,
            "f1": 2.0 * scores.n_hits / n if n else 1.0,
        }
    return result


def correctness(predictions: Sequence[Prediction], truth: Sequence[SimulatedScan]) -> dict[str, float | None]:
    """Figures on the truth of simulated scans; None for what is not predicted, or has other classes than the
    simulator's. A few scans only check an engine; `edgeperc eval` evaluates a model.
    """
    points, cells, boxes = Confusion(POINT_CLASSES), Confusion(TOP_VIEW_CLASSES), BoxEvaluator()
    for predicted, scan in zip(predictions, truth, strict=True):
        if predicted.points is not None and predicted.points.classes == POINT_CLASSES:
            points.update(predicted.points.labels, np.where(predicted.points.in_view, labels_by_boxes(scan), IGNORE))
        view, geometry = predicted.top_view, None
        if view is not None:
            geometry = TopViewGeometry(view.x_range_m, view.y_range_m, cell_m=view.cell_m)
            if view.classes == TOP_VIEW_CLASSES:
                cells.update(view.labels, scan.top_view_labels(geometry))
        elif predicted.points is not None:
            continue
        to_find, ignored = boxes_to_find(zip(scan.boxes, scan.box_points, strict=True), geometry, VEHICLES)
        boxes.update(predicted.boxes, to_find, ignored=ignored)
    return {
        "points_mean_iou": _rounded(points.mean_iou()),
        "cells_mean_iou": _rounded(cells.mean_iou()),
        "vehicle_ap50": _rounded(boxes.overall().ap),
    }


def agrees(accuracy: Mapping[str, Any]) -> bool:
    """Whether predictions are as good as the reference's: `agreement` with it, and `correctness` of both, or None."""
    same = accuracy["agreement"]
    if any(same[kind] is not None and same[kind]["equal"] < LEAST_EQUAL for kind in ("points", "cells")):
        return False
    if same["boxes"] is not None and same["boxes"]["f1"] < LEAST_BOX_F1:
        return False
    figures, right = accuracy["truth"] or {}, accuracy["reference_truth"] or {}
    return all(
        figures[key] is not None and figures[key] >= right[key] - MOST_LOST for key in right if right[key] is not None
    )


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)


def profile_of(name: str) -> SensorProfile:
    """A sensor; "-hanging": as it sees the street upside down."""
    roll_deg = 180.0 if name.endswith("-hanging") else 0.0
    return get_sensor(name.removesuffix("-hanging")).upright(Mounting(roll_deg=roll_deg))


class NearFigures:
    """Counts of simulated scans within `FARTHEST_M`: classes of points, and boxes by each evaluator's classes."""

    def __init__(self, *evaluators: BoxEvaluator) -> None:
        self.points, self.evaluators = Confusion(POINT_CLASSES), evaluators

    def count(self, perception: Perception, points: Points, labels: Labels, boxes: Iterable[tuple[Box, int]]) -> None:
        """Count a scan by its true labels, and boxes with their returns."""
        found = perception.require_points()
        near = found.in_view & (np.hypot(points[:, 0], points[:, 1]) < FARTHEST_M)
        self.points.update(renamed(found.labels[near], found.classes, POINT_CLASSES), labels[near])
        near_boxes = [(box, n) for box, n in boxes if math.hypot(*box.center[:2]) < FARTHEST_M]
        for evaluator in self.evaluators:
            classes = evaluator.together or ()
            to_find, ignored = boxes_to_find(near_boxes, None, classes)
            evaluator.update([box for box in perception.boxes if box.label in classes], to_find, ignored=ignored)
