"""The papers' figures on real scans of drives that nothing was trained on.

Everything runs through `edgeperc.Perceiver`, as it would in a vehicle: what is judged is what a user gets.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from edgeperc import Perceiver
from edgeperc.card import ModelCard, TopViewGeometry
from edgeperc.metrics import BoxEvaluator, BoxScores, Confusion
from edgeperc.perception import Box, Perception

from .kitti import IGNORE, Frame, KittiObjects, RoadFrame, inside, road_frames
from .train import FEWEST

__all__ = ["evaluate", "table"]


def evaluate(
    models: Sequence[str],
    *,
    kitti: Path | None = None,
    semantickitti: Path | None = None,
    split: str = "validation",
    provider: str = "cpu",
) -> dict[str, Any]:
    """Figures of one or two models.

    Parameters
    ----------
    models : sequence of str
        Shipped names or paths; a range-image model is judged on points, a top-view model on boxes and road.
    kitti : Path or None
        Root of a KITTI object set. Whole scans of ``split`` with checked boxes are judged, where the camera saw.
    semantickitti : Path or None
        Root of SemanticKITTI scans. Cells with labelled returns are judged.
    split : str
    provider : str

    Returns
    -------
    dict
        ``points``, by class: precision, recall, IoU (PointSeg 5.1), number of true points.
        ``boxes``: ``upright`` (as SSADNet's appendix A has them) and ``oriented``, each for every class and for
        ``"vehicle"``, which is all of them together whatever their class: 11-point AP at IoU 0.5 and so on.
        ``road``: IoU, precision, recall, F1, pixel accuracy of drivable cells, and the number of cells.
    """
    perceive = Perceiver(list(models), sensor="hdl-64e", provider=provider, on_mismatch="ignore")
    figures: dict[str, Any] = {"models": {c.name: c.version for c in perceive.cards}, "split": split}
    if kitti is not None:
        objects = KittiObjects(kitti)
        names = objects.names(split, grades="A", crops=False)
        frames = (objects.frame(n) for n in tqdm(names, desc="KITTI", leave=False))
        figures |= _on_kitti(perceive, frames)
        figures["n_frames"] = len(names)
    if semantickitti is not None and any("drivable" in c.classes for c in perceive.cards):
        figures["road"] = _on_road(perceive, road_frames(semantickitti))
    return figures


def _on_kitti(perceive: Perceiver, frames: Iterable[Frame]) -> dict[str, Any]:
    point_card = next((c for c in perceive.cards if c.view.kind == "range_image"), None)
    box_card = next((c for c in perceive.cards if c.box_classes), None)
    confusion = Confusion(point_card.classes) if point_card else None
    evaluators = {"upright": BoxEvaluator(oriented=False), "oriented": BoxEvaluator(oriented=True)}
    for frame in frames:
        found = perceive(frame.points)
        if confusion is not None and found.points is not None:
            truth = np.where(found.points.in_view, frame.point_labels(), IGNORE)
            confusion.update(found.points.labels, truth)
        if box_card is not None:
            predicted, truth_boxes, ignored = _judged_boxes(frame, found, box_card)
            for evaluator in evaluators.values():
                evaluator.update(predicted, truth_boxes, ignored=ignored)
    figures: dict[str, Any] = {}
    if confusion is not None:
        rates = {"precision": confusion.precision(), "recall": confusion.recall(), "iou": confusion.iou()}
        figures["points"] = {
            name: {rate: _number(values[k]) for rate, values in rates.items()} | {"n": int(confusion.counts[k].sum())}
            for k, name in enumerate(confusion.classes)
        }
    if box_card is not None:
        figures["boxes"] = {
            name: {"vehicle": _scores(e.overall())} | {c: _scores(s) for c, s in e.per_class().items()}
            for name, e in evaluators.items()
        }
    return figures


def _judged_boxes(frame: Frame, found: Perception, card: ModelCard) -> tuple[list[Box], list[Box], list[Box]]:
    """Predictions where truth is known, the boxes to find, and those that need not be found.

    To be found is every vehicle whose centre lies in the top view and whose box holds `FEWEST` returns or more.
    """
    assert found.top_view is not None
    (near, far), (right, left) = found.top_view.x_range_m, found.top_view.y_range_m
    centres = np.array([b.center for b in found.boxes], np.float64).reshape(-1, 3)
    predicted = [b for b, judged in zip(found.boxes, frame.judges(centres), strict=True) if judged]
    truth, ignored = [], []
    for box in frame.boxes:
        seen = near <= box.center[0] < far and right <= box.center[1] < left
        counts = int(np.count_nonzero(inside(box, frame.points, 0.1))) >= FEWEST
        if box.label in card.box_classes and seen and counts:
            truth.append(box)
        else:
            ignored.append(box)
    return predicted, truth, ignored


def _on_road(perceive: Perceiver, frames: Iterable[RoadFrame]) -> dict[str, Any]:
    confusion, n_frames = Confusion(("other", "road")), 0
    view = next(c.view for c in perceive.cards if "drivable" in c.classes)
    assert isinstance(view, TopViewGeometry)
    for frame in tqdm(frames, desc="SemanticKITTI", leave=False):
        found = perceive(frame.points)
        assert found.top_view is not None
        confusion.update(found.top_view.drivable.astype(np.uint8), frame.top_view(view))
        n_frames += 1
    precision, recall = float(confusion.precision()[1]), float(confusion.recall()[1])
    return {
        "iou": _number(confusion.iou()[1]),
        "precision": _number(precision),
        "recall": _number(recall),
        "f1": _number(2.0 * precision * recall / max(precision + recall, 1e-9)),
        "accuracy": _number(confusion.accuracy()),
        "n_cells": int(confusion.counts.sum()),
        "n_frames": n_frames,
    }


def _scores(scores: BoxScores) -> dict[str, float | int | None]:
    return {name: _number(value) if isinstance(value, float) else value for name, value in asdict(scores).items()}


def _number(value: float) -> float | None:
    """For JSON: four decimals, None where there was nothing to count."""
    return None if math.isnan(value) else round(float(value), 4)


def table(figures: dict[str, Any]) -> str:
    """The figures as text."""
    lines = [f"{', '.join(f'{n} {v}' for n, v in figures['models'].items())} on the {figures['split']} drives"]
    if "points" in figures:
        lines += ["", f"points, {figures['n_frames']} frames       precision   recall      IoU    true points"]
        for name, row in figures["points"].items():
            lines.append(f"  {name:24}{_percent(row['precision'], row['recall'], row['iou'])}{row['n']:>15,}")
    for kind, rows in figures.get("boxes", {}).items():
        lines += [
            "",
            f"{kind} boxes, {figures['n_frames']} frames".ljust(28) + "  AP50 precision   recall  mIoU@0.5  boxes",
        ]
        for name, row in rows.items():
            rates = _percent(row["ap"], row["precision"], row["recall"], row["mean_iou_50"])
            lines.append(f"  {name:24}{rates}{row['n_truth']:>8}")
    if "road" in figures:
        road = figures["road"]
        lines += [
            "",
            f"road, {road['n_frames']} frames".ljust(30) + "IoU precision   recall       F1  accuracy     cells",
        ]
        rates = _percent(road["iou"], road["precision"], road["recall"], road["f1"], road["accuracy"])
        lines.append(f"  {'drivable':24}{rates}{road['n_cells']:>12,}")
    return "\n".join(lines)


def _percent(*values: float | None) -> str:
    return "".join("        -" if v is None else f"{100.0 * v:9.1f}" for v in values)
