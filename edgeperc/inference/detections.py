"""Boxes of a detector's anchor or center head, as OpenPCDet and mmdetection3d define them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..errors import InferenceError
from ..types.card import ModelCard
from ..types.detector import CENTER_VALUES, AnchorHead, CenterHead, PillarGeometry
from ..types.geometry import suppress_overlaps, wrapped
from ..types.perception import Box
from ..types.points import Floats, Floats32, Ints64
from .box_heads import MAX_PROBABILITY, SIZE_RANGE_M, check_finite, check_logits, logit, sigmoid

BEYOND_M = 5.0
"""A box whose center is farther out of the view is dropped."""
Values = Mapping[str, Floats32]


def decode_detections(card: ModelCard, outputs: Values, score_threshold: float) -> tuple[list[Box], Ints64]:
    """Decode the boxes of a detector on pillars.

    outputs : by their names, with the batch's axis or without.
    Returns: In the frame of the training points, `distinct_rows` alone, and the number of each one's class in the head.
        ``front`` is the probability of the direction's bin; of a center head, it is 1 if sine and cosine are those of
        an angle, and less the smaller both are: they are means of the headings that the network deems possible.
    Raises InferenceError.
    """
    view, head = card.view, card.head
    assert isinstance(view, PillarGeometry)
    maps: dict[str, list[Floats32]] = {}
    for spec in card.outputs:
        values = outputs[spec.name].reshape(card.shape_of(spec)[1:])
        check_finite(values, spec.name, card.name)
        maps.setdefault(spec.kind, []).append(values)
    if isinstance(head, AnchorHead):
        rows, scores, labels, fronts = _anchor_boxes({k: v for k, (v,) in maps.items()}, view, head, score_threshold)
    else:
        assert head is not None
        rows, scores, labels, fronts = _center_boxes(maps, view, head, score_threshold)
    near = np.ones(len(rows), np.bool_)
    for axis, (low, high) in enumerate((view.x_range_m, view.y_range_m, view.z_range_m)):
        near &= (rows[:, axis] >= low - BEYOND_M) & (rows[:, axis] <= high + BEYOND_M)
    rows, scores, labels, fronts = rows[near], scores[near], labels[near], fronts[near]
    kept = distinct_rows(card, rows[:, [0, 1, 3, 4, 6]], scores, labels)
    return [
        Box(card.box_classes[k], score, (x, y, z), (length, width, height), yaw, None if math.isnan(front) else front)
        for (x, y, z, length, width, height, yaw), score, k, front in zip(
            rows[kept].tolist(), scores[kept].tolist(), labels[kept].tolist(), fronts[kept].tolist(), strict=True
        )
    ], labels[kept]


def distinct_rows(card: ModelCard, footprints: Floats, scores: Floats, labels: Ints64) -> Ints64:
    """Rows of boxes, best first: of those of one class, or of one group of a center head, that overlap by more than the
    card's ``nms_iou``, or with ``across_classes`` of any classes, only the best one.
    """
    head = card.head
    assert head is not None
    kinds = np.array([card.box_classes.index(name) for name in card.box_classes])
    alike = [np.zeros_like(kinds) if head.across_classes else kinds]
    if isinstance(head, CenterHead):  # whose groups OpenPCDet and mmdet3d take as one class here
        alike.insert(0, np.repeat(np.arange(len(head.groups)), head.groups))
    kept = np.arange(len(scores))
    for numbers in alike:
        among = [kept[numbers[labels[kept]] == k] for k in np.unique(numbers)]
        apart = [rows[suppress_overlaps(footprints[rows], scores[rows], card.nms_iou)] for rows in among]
        kept = np.sort(np.concatenate(apart))
    return kept[np.argsort(-scores[kept], kind="stable")]


Decoded = tuple[Floats, Floats, Ints64, Floats]
"""x, y, z, length, width, height, yaw (n, 7); scores, classes, and probabilities of the front, NaN if unknown (n,)."""


def _anchor_boxes(maps: Values, view: PillarGeometry, head: AnchorHead, score_threshold: float) -> Decoded:
    """Boxes that start from anchors: SECOND's coding of residuals, with bins of directions."""

    def per_anchor(kind: str) -> Floats32:
        values = maps[kind] if head.channels_last else np.moveaxis(maps[kind], 0, -1)
        return values.reshape(*values.shape[:2], head.n_anchors, -1)

    raw = per_anchor("cls_preds")
    at, labels, scores = _best(raw, head, score_threshold)
    row, column, anchor = at
    turned = [each for each in head.anchors for _ in each.yaws_rad]
    sizes = np.array([each.size_m for each in turned])[anchor]
    bottoms = np.array([each.bottom_m for each in turned])[anchor]
    yaws = np.array([yaw for each in head.anchors for yaw in each.yaws_rad])[anchor]
    whole = [*zip(view.x_range_m, view.y_range_m, strict=True)]
    bounds = [each.range_m or (*whole[0], *whole[1]) for each in turned]
    x = np.array([_positions(each[::2], raw.shape[1], head.centered) for each in bounds])[anchor, column]
    y = np.array([_positions(each[1::2], raw.shape[0], head.centered) for each in bounds])[anchor, row]
    code = per_anchor("box_preds")[at][:, :7].astype(np.float64)
    boxes = np.empty((len(row), 7))
    diagonal = np.hypot(sizes[:, 0], sizes[:, 1])
    boxes[:, 0], boxes[:, 1] = x + code[:, 0] * diagonal, y + code[:, 1] * diagonal
    boxes[:, 2] = bottoms + (0.5 + code[:, 2]) * sizes[:, 2]
    boxes[:, 3:6] = _sizes(np.log(sizes) + code[:, 3:6])
    yaw, fronts = yaws + code[:, 6], np.full(len(row), np.nan)
    if "dir_cls_preds" in maps:
        bins = per_anchor("dir_cls_preds")[at].astype(np.float64)
        chances = np.exp(bins - bins.max(axis=1, keepdims=True))
        period, offset = 2.0 * math.pi / head.direction_bins, head.direction_offset_rad
        turns = (yaw - offset) / period
        within = turns - np.floor(turns + head.direction_limit_offset)
        yaw = offset + period * (within + bins.argmax(axis=1))
        fronts = chances.max(axis=1) / chances.sum(axis=1)
    boxes[:, 6] = wrapped(yaw)
    return boxes, scores, labels, fronts


def _center_boxes(
    maps: Mapping[str, list[Floats32]], view: PillarGeometry, head: CenterHead, score_threshold: float
) -> Decoded:
    """Boxes at the cells of the heat maps, for each group of classes."""
    heat = np.concatenate(maps["heatmap"])
    parts: list[Decoded] = []
    first = 0
    for group, n_classes in enumerate(head.groups):
        raw = np.moveaxis(heat[first : first + n_classes], 0, -1)
        (row, column, _), labels, scores = _best(raw[:, :, None, :], head, score_threshold)
        values = _values_at(maps, group, row, column)
        boxes = np.empty((len(row), 7))
        shrink = head.stride * view.cell_m
        boxes[:, 0] = view.x_range_m[0] + (column + values["reg"][:, 0]) * shrink
        boxes[:, 1] = view.y_range_m[0] + (row + values["reg"][:, 1]) * shrink
        boxes[:, 2] = values["height"][:, 0]
        boxes[:, 3:6] = _sizes(values["dim"])
        sin, cos = values["rot"].T if head.rotation == "sin_cos" else values["rot"].T[::-1]
        boxes[:, 6] = np.arctan2(sin, cos)
        fronts = 0.5 + 0.5 * np.minimum(np.hypot(sin, cos), 1.0)
        parts.append((boxes, scores, first + labels, fronts))
        first += n_classes
    rows, scores, labels, fronts = (np.concatenate(part) for part in zip(*parts, strict=True))
    return rows, scores, labels, fronts


def _values_at(maps: Mapping[str, list[Floats32]], group: int, row: Ints64, column: Ints64) -> dict[str, Floats]:
    """Values of a group of classes at some positions, (n, values) of each part of a box."""
    found: dict[str, Floats] = {}
    for kind, given in maps.items():
        if kind == "heatmap":
            continue
        parts = kind.split("_")
        n_values = sum(CENTER_VALUES[part] for part in parts)
        whole, start = (given[group], 0) if len(given) > 1 else (given[0], group * n_values)
        for part in parts:
            n = CENTER_VALUES[part]
            found[part] = whole[start : start + n, row, column].T.astype(np.float64)
            start += n
    return found


def _best(
    raw: Floats32, head: AnchorHead | CenterHead, score_threshold: float
) -> tuple[tuple[Ints64, ...], Ints64, Floats]:
    """Row, column and anchor of the best candidates of a map (rows, columns, anchors, classes), classes and scores."""
    best = raw[..., 0].copy()
    for k in range(1, raw.shape[3]):  # a third of the time of a maximum along the short axis
        np.maximum(best, raw[..., k], out=best)
    are_logits = head.scores == "logits"
    what = "the best scores of the head's positions"
    if are_logits and best.size:
        advice = "Check the card: an output with sigmoid has head.scores probabilities"
        check_logits(float(best.min()), float(best.max()), what, advice)
    least = logit(score_threshold) if are_logits else score_threshold
    at = np.flatnonzero(best.reshape(-1) >= least)
    values = best.reshape(-1)[at]
    order = np.argsort(-values, kind="stable")[: head.max_candidates]
    place = np.unravel_index(at[order], best.shape)
    scores = sigmoid(values[order].astype(np.float64)) if are_logits else values[order].astype(np.float64)
    if not are_logits and best.size and not (best.min() >= 0.0 and best.max() <= MAX_PROBABILITY):
        raise InferenceError(
            f"{what} are {best.min():g} to {best.max():g}; expected probabilities, 0 "
            "to 1. Check the card: an output without sigmoid or softmax has head.scores logits"
        )
    return place, raw[place].argmax(axis=1), np.clip(scores, 0.0, 1.0)


def _positions(limits: Sequence[float], n: int, centered: bool) -> Floats:
    """Where anchors stand along an axis [m]."""
    low, high = limits
    if centered:
        return low + (np.arange(n) + 0.5) * (high - low) / n
    return np.linspace(low, high, n)


def _sizes(logarithms: Floats) -> Floats:
    return np.exp(np.clip(logarithms, *np.log(SIZE_RANGE_M)))
