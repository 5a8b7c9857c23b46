"""How right the answers are whose speed is told: by those of fp32 on the stock CPU provider, and by the truth."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from edgeperc.card import TopViewGeometry
from edgeperc.evaluation.metrics import BoxEvaluator, Confusion, boxes_to_find
from edgeperc.evaluation.tables import VEHICLES
from edgeperc.simulation.samples import IGNORE, labels_by_boxes
from edgeperc.simulation.scene import POINT_CLASSES, TOP_VIEW_CLASSES, SimulatedScan

from .worker import Answer

__all__ = ["agreement", "agrees", "correctness"]

# Answers agree where nearly all labels and boxes are the reference's, and no figure against the truth falls by a point.
LEAST_EQUAL = 0.99
LEAST_BOX_F1 = 0.9
MOST_LOST = 0.01


def agreement(reference: Sequence[Answer], found: Sequence[Answer]) -> dict[str, Any]:
    """How far answers are those of the reference, scan by scan the same.

    Returns
    -------
    dict
        Of ``"points"`` in view and ``"cells"``: the share of ``equal`` labels, and ``mean_iou`` with the reference as
        truth; of ``"boxes"``: ``n_reference``, ``n_found``, ``n_both`` (overlap at least 0.5) and ``f1``. None for what
        the models do not answer.
    """
    told: dict[str, Any] = {"n_scans": len(reference), "points": None, "cells": None, "boxes": None}
    points, cells = [], []
    for right, guess in zip(reference, found, strict=True):
        if right.points is not None and guess.points is not None:
            seen = right.points.in_view
            points.append((right.points.classes, guess.points.labels[seen], right.points.labels[seen]))
        if right.top_view is not None and guess.top_view is not None:
            cells.append((right.top_view.classes, guess.top_view.labels, right.top_view.labels))
    for name, pairs in (("points", points), ("cells", cells)):
        if pairs:
            confusion = Confusion(pairs[0][0])
            for _, guess_labels, right_labels in pairs:
                confusion.update(guess_labels, right_labels)
            told[name] = {"equal": _plain(confusion.accuracy()), "mean_iou": _plain(confusion.mean_iou())}
    if cells:
        boxes = BoxEvaluator()
        for right, guess in zip(reference, found, strict=True):
            boxes.update(guess.boxes, right.boxes)
        scores = boxes.overall()
        n = scores.n_truth + scores.n_predicted
        told["boxes"] = {"n_reference": scores.n_truth, "n_found": scores.n_predicted, "n_both": scores.n_hits}
        told["boxes"]["f1"] = 2.0 * scores.n_hits / n if n else 1.0
    return told


def correctness(answers: Sequence[Answer], truth: Sequence[SimulatedScan]) -> dict[str, float | None]:
    """Figures against what simulated scans hold: ``points_mean_iou``, ``cells_mean_iou``, ``vehicle_ap50``.

    None for what the models do not answer, or answer in other classes than the simulator's. A few scans make a check,
    no figure of merit: `edgeperc eval` has those.
    """
    points, cells, boxes = Confusion(POINT_CLASSES), Confusion(TOP_VIEW_CLASSES), BoxEvaluator()
    for answer, scan in zip(answers, truth, strict=True):
        if answer.points is not None and answer.points.classes == POINT_CLASSES:
            points.update(answer.points.labels, np.where(answer.points.in_view, labels_by_boxes(scan), IGNORE))
        view = answer.top_view
        if view is None:
            continue
        geometry = TopViewGeometry(view.x_range_m, view.y_range_m, cell_m=view.cell_m)
        if view.classes == TOP_VIEW_CLASSES:
            cells.update(view.labels, scan.top_view_labels(geometry))
        truth = zip(scan.boxes, scan.box_points, strict=True)
        to_find, ignored = boxes_to_find(truth, geometry, VEHICLES)
        boxes.update(answer.boxes, to_find, ignored=ignored)
    return {
        "points_mean_iou": _plain(points.mean_iou()),
        "cells_mean_iou": _plain(cells.mean_iou()),
        "vehicle_ap50": _plain(boxes.overall().ap),
    }


def agrees(accuracy: Mapping[str, Any]) -> bool:
    """Whether answers are as good as the reference's.

    Parameters
    ----------
    accuracy : mapping
        ``"agreement"`` of `agreement`, ``"truth"`` and ``"reference_truth"`` of `correctness`, or None.
    """
    told = accuracy["agreement"]
    if any(told[kind] is not None and told[kind]["equal"] < LEAST_EQUAL for kind in ("points", "cells")):
        return False
    if told["boxes"] is not None and told["boxes"]["f1"] < LEAST_BOX_F1:
        return False
    found, right = accuracy["truth"] or {}, accuracy["reference_truth"] or {}
    return all(
        found[key] is not None and found[key] >= right[key] - MOST_LOST for key in right if right[key] is not None
    )


def _plain(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 6)
