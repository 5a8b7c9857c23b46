"""Boxes of the three kinds of box heads: dense, slots, scored slots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from ..errors import CardMismatchError, InferenceError
from ..system.kernels import njit
from ..types.card import N_DENSE_CHANNELS, N_FRONT_CHANNELS, ModelCard
from ..types.geometry import suppress_overlaps
from ..types.perception import Box
from ..types.points import Floats, Floats32, Labels, Mask
from ..types.views import TopViewGeometry

STRIDE = 4  # cells of the top view behind one cell of a box_dense output, along each axis
MAX_BOXES = 100  # the best ones are decoded
MIN_EXTENT_M = 0.5  # smaller slots are empty
MAX_SUMMED = 2**18  # values under a box: 23 x 23 m of a map of 5 classes in cells of 0.1 m
SIZE_RANGE_M = (0.2, 40.0)  # boxes are clipped to these sizes
MAX_PROBABILITY = 1.02  # rounded to bfloat16, probabilities add up to a little more than 1


def decode_slots(card: ModelCard, slots: Floats32, labels: Labels, scores: Floats32) -> list[Box]:
    """Decode axis-aligned boxes on the road, best score first, with the class of the segmentation at their centers
    (SSADNet 2.2.1 B).

    slots : (K, 4), perhaps with the batch's axis (docs/concepts/cards.md). One is empty if an extent is below 0.5 m, or
        if there is no box class at its center, whose score a box has.
    """
    view = _view_of(card)
    values = _slot_rows(card, slots, 4)
    height, width = view.height, view.width
    if labels.shape != (height, width) or scores.shape != (height, width):
        raise CardMismatchError(
            f"{card.name}: labels {labels.shape} and scores {scores.shape} for a view of {(height, width)}; check the "
            "card"
        )
    smaller = np.minimum(values[:, 3] * height * view.cell_m, values[:, 2] * width * view.cell_m)
    values = values[((values[:, :2] >= 0.0) & (values[:, :2] < 1.0)).all(axis=1) & (smaller >= MIN_EXTENT_M)]
    at_row, at_col = (values[:, 1] * height).astype(np.int64), (values[:, 0] * width).astype(np.int64)
    is_box = np.array([name in card.box_classes for name in card.classes])[labels[at_row, at_col]]
    values, score = values[is_box], np.minimum(scores[at_row, at_col][is_box], 1.0)
    best = np.argsort(-score, kind="stable")[:MAX_BOXES]
    names = [card.classes[k] for k in labels[at_row[is_box], at_col[is_box]][best]]
    return _standing(card, _slot_rectangles(values[best], view), score[best], names)


def decode_scored_slots(
    card: ModelCard, slots: Floats32, class_output: Floats32, class_kind: str, score_threshold: float
) -> list[Box]:
    """Decode axis-aligned boxes with scores of their own, best first, without those that overlap a better one;
    ``slots`` have a logit, too. The class is the one with the largest sum of probabilities in the footprint.
    """
    view = _view_of(card)
    rows = _slot_rows(card, slots, 5)
    values = _cell_values(card, class_output, class_kind)
    check_finite(values, class_kind, card.name)
    if not card.box_classes:
        return []
    inside = ((rows[:, :2] >= 0.0) & (rows[:, :2] < 1.0)).all(axis=1)
    rows = rows[inside & (rows[:, 4] >= logit(score_threshold))]
    rows = rows[np.argsort(-rows[:, 4], kind="stable")[:MAX_BOXES]]
    rectangles = _slot_rectangles(rows, view)
    rectangles[:, 2:4] = np.clip(rectangles[:, 2:4], *SIZE_RANGE_M)
    scores = sigmoid(rows[:, 4])
    keep = suppress_overlaps(rectangles, scores, card.nms_iou)
    evidence = _footprint_evidence(card, values, class_kind, rectangles[keep])
    names = [card.box_classes[k] for k in np.argmax(evidence, axis=1)]
    return _standing(card, rectangles[keep], scores[keep], names)


def _view_of(card: ModelCard) -> TopViewGeometry:
    assert isinstance(card.view, TopViewGeometry)
    return card.view


def _cell_values(card: ModelCard, class_output: Floats32, class_kind: str) -> Floats32:
    """The values of all classes in all cells of a view, (classes, height, width) float32."""
    values, view = class_values(class_output, class_kind, card.name), _view_of(card)
    expected = (len(card.classes), view.height, view.width)
    if values.shape != expected:
        raise CardMismatchError(
            f"{card.name}: {class_kind} has shape {class_output.shape}; expected {(1, *expected)}; check the card"
        )
    return values


def _slot_rows(card: ModelCard, slots: Floats32, n_columns: int) -> Floats:
    """The slots of one scan (K, n_columns), checked."""
    rows = slots[0] if slots.ndim == 3 and slots.shape[0] == 1 else slots
    if rows.ndim != 2 or rows.shape[1] != n_columns:
        raise CardMismatchError(
            f"{card.name}: box_slots has shape {slots.shape}; expected (1, K, 4) or (1, K, 5); check the export"
        )
    missing = [name for name in card.box_classes if name not in card.box_size_priors]
    if missing:
        raise CardMismatchError(
            f"{card.name}: no box_size_priors for {missing}; box_slots needs one for each box class"
        )
    check_finite(rows, "box_slots", card.name)
    return rows.astype(np.float64)


def _slot_rectangles(slots: Floats, view: TopViewGeometry) -> Floats:
    """x, y, length, width [m] and yaw [rad] of slots: the length is the longer side."""
    along, across = slots[:, 3] * view.height * view.cell_m, slots[:, 2] * view.width * view.cell_m
    return np.stack(
        [
            view.x_range_m[1] - slots[:, 1] * view.height * view.cell_m,
            view.y_range_m[1] - slots[:, 0] * view.width * view.cell_m,
            np.maximum(along, across),
            np.minimum(along, across),
            np.where(along >= across, 0.0, math.pi / 2.0),
        ],
        axis=1,
    )


def _standing(card: ModelCard, rectangles: Floats, scores: NDArray[np.floating], names: Sequence[str]) -> list[Box]:
    """Boxes that stand on the road, as tall as is usual for their class."""
    boxes = []
    for (x, y, length, width, yaw), score, name in zip(rectangles.tolist(), scores.tolist(), names, strict=True):
        tall = float(card.box_size_priors[name][2])
        boxes.append(Box(name, score, (x, y, tall / 2.0 - card.mount_height_m), (length, width, tall), yaw))
    return boxes


def decode_dense(
    card: ModelCard,
    dense: Floats32,
    class_output: Floats32,
    class_kind: str,
    score_threshold: float,
    named_from: float = 0.0,
) -> list[Box]:
    """Decode oriented boxes from a heat map of centers, best score first, and a box regressed at every cell.

    dense : (9 or 11, H / 4, W / 4), perhaps with the batch's axis (docs/concepts/cards.md).
    named_from : boxes with a lower score are places only: their label is empty, which saves most of the time.

    The paper reads a box's class at its center pixel, which may be a hole in the roof. Here the class with the largest
    sum of probabilities over the footprint wins, times the likelihood of the measured size (log-normal), if the card
    has ``box_size_spreads``: from above, vans and cars differ only in size.
    """
    view = _view_of(card)
    maps = dense[0] if dense.ndim == 4 and dense.shape[0] == 1 else dense
    height, width = view.height, view.width
    expected = [(n, height // STRIDE, width // STRIDE) for n in (N_DENSE_CHANNELS, N_DENSE_CHANNELS + N_FRONT_CHANNELS)]
    if maps.shape not in expected:
        raise CardMismatchError(
            f"{card.name}: box_dense has shape {dense.shape}; expected {(1, *expected[0])} or {(1, *expected[1])} "
            f"for a view of {(height, width)}; check the card"
        )
    values = _cell_values(card, class_output, class_kind)
    maps = np.ascontiguousarray(maps, dtype=np.float32)
    check_finite(maps, "box_dense", card.name)
    check_finite(values, class_kind, card.name)
    if not card.box_classes:
        return []

    check_logits(
        float(maps[0].min()),
        float(maps[0].max()),
        f"{card.name}: values of the heat map of box_dense",
        "Export the network without the sigmoid of this output",
    )
    peak = np.empty(maps.shape[1:], np.bool_)
    mark_peaks(maps[0], logit(score_threshold), peak)
    rows, cols = np.nonzero(peak)
    best = np.argsort(-maps[0, rows, cols], kind="stable")[:MAX_BOXES]
    rows, cols = rows[best], cols[best]
    heat, d_row, d_col, log_l, log_w, sin, cos, z, log_h, *front = maps[:, rows, cols].astype(np.float64)
    scores = sigmoid(heat)
    shrink = STRIDE * view.cell_m
    low, high = np.log(SIZE_RANGE_M)
    rectangles = np.stack(
        [
            view.x_range_m[1] - (rows + 0.5 + d_row) * shrink,
            view.y_range_m[1] - (cols + 0.5 + d_col) * shrink,
            np.exp(np.clip(log_l, low, high)),
            np.exp(np.clip(log_w, low, high)),
            0.5 * np.arctan2(sin, cos),
        ],
        axis=1,
    )
    tall = np.exp(np.clip(log_h, low, high))
    yaws, fronts = _facing(rectangles[:, 4], *front) if front else (rectangles[:, 4], None)
    keep = suppress_overlaps(rectangles, scores, card.nms_iou)
    named = keep[: int(np.count_nonzero(scores[keep] >= named_from))]  # the best scores come first
    evidence = _footprint_evidence(card, values, class_kind, rectangles[named])
    if card.box_size_spreads:
        sizes = np.log(np.stack([rectangles[named, 2], rectangles[named, 3], tall[named]], axis=1))
        usual = np.log([card.box_size_priors[name] for name in card.box_classes])
        spread = np.array([card.box_size_spreads[name] for name in card.box_classes])
        off = (sizes[:, None] - usual) / spread
        likelihood = -0.5 * (off**2).sum(axis=2) - np.log(spread).sum(axis=1)
        evidence = np.log(np.maximum(evidence, np.finfo(np.float64).tiny)) + likelihood
    labels = [card.box_classes[k] for k in evidence.argmax(axis=1).tolist()] + [""] * (len(keep) - len(named))
    return [
        Box(
            label=label,
            score=float(scores[i]),
            center=(float(rectangles[i, 0]), float(rectangles[i, 1]), float(z[i])),
            size=(float(rectangles[i, 2]), float(rectangles[i, 3]), float(tall[i])),
            yaw=float(yaws[i]),
            front=None if fronts is None else float(fronts[i]),
        )
        for label, i in zip(labels, keep, strict=True)
    ]


def _footprint_evidence(card: ModelCard, values: Floats32, class_kind: str, rectangles: Floats) -> Floats:
    """Sums of the probabilities of each box class in each rectangle, (n, box classes)."""
    sums, view = np.empty((len(rectangles), len(card.classes))), _view_of(card)
    x_far, y_left = view.x_range_m[1], view.y_range_m[1]
    fill_footprint_sums(values, class_kind == "class_logits", rectangles, x_far, y_left, view.cell_m, sums)
    return sums[:, [card.classes.index(name) for name in card.box_classes]]


def _facing(yaws: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Yaws in -pi..pi towards the likelier fronts, and their probabilities; a logit of 0 keeps the yaw."""
    logits = np.cos(yaws) * x + np.sin(yaws) * y
    opposite = np.where(yaws > 0.0, yaws - math.pi, yaws + math.pi)
    return np.where(logits >= 0.0, yaws, opposite), 1.0 / (1.0 + np.exp(-np.abs(logits)))


def class_values(output: Floats32, kind: str, model: str) -> Floats32:
    """The class output of a network as (classes, H, W), checked."""
    if kind not in ("class_logits", "class_probabilities"):
        raise CardMismatchError(f"{model}: got kind {kind!r}; expected class_logits or class_probabilities")
    values = output[0] if output.ndim == 4 and output.shape[0] == 1 else output
    if values.ndim != 3 or not 1 <= values.shape[0] <= 255:
        raise CardMismatchError(f"{model}: {kind} has shape {output.shape}; expected (1, C, H, W), C in 1..255")
    return np.ascontiguousarray(values, dtype=np.float32)


def check_finite(values: Floats32, kind: str, model: str) -> None:
    """Raise `InferenceError` for an output with values that are not finite."""
    n_bad = count_not_finite(values.reshape(-1))
    if n_bad:
        raise_not_finite(n_bad, values.size, kind, model)


def raise_not_finite(n_bad: int, n: int, kind: str, model: str) -> NoReturn:
    """Say that so many of n values of an output are not finite."""
    raise InferenceError(
        f"{model}: {n_bad} of {n} values of {kind} are not finite; expected numbers. "
        "Check the scan's units, or run the model with provider='cpu' and precision='fp32'"
    )


def check_logits(lowest: float, highest: float, what: str, advice: str) -> None:
    """Raise `InferenceError` for logits of objects at all positions of a map that are probabilities, by their bounds.

    As logits, they would be an object everywhere. A map of zeros may be either.
    """
    if lowest >= 0.0 and 0.0 < highest <= MAX_PROBABILITY:
        raise InferenceError(
            f"{what} are {lowest:g} to {highest:g}, as after a sigmoid or without training; expected logits, most of "
            f"them below 0. {advice}"
        )


def logit(probability: float) -> float:
    """Log odds; infinite from 0 and 1 on."""
    if 0.0 < probability < 1.0:
        return math.log(probability / (1.0 - probability))
    return math.copysign(math.inf, probability - 0.5)


def sigmoid(logits: Floats) -> Floats:
    """Probabilities."""
    with np.errstate(over="ignore"):  # a probability of 0
        return 1.0 / (1.0 + np.exp(-logits))


@njit(cache=True, nogil=True)
def fill_scores(values: Floats32, scores: Floats32) -> None:
    """Replace every pixel's largest logit in ``scores`` by its softmax probability among ``values`` (C, H, W)."""
    n_classes, height, width = values.shape
    total = np.empty(width, np.float32)
    for row in range(height):
        best = scores[row]
        total[:] = 0.0
        for c in range(n_classes):
            for col in range(width):
                # exp(x) = exp(x / 64) ** 64, from a Taylor series with an error below 2e-6 here. In vector
                # instructions this takes 0.3 ms for 5 x 400 x 200 logits; math.exp takes 1.1 ms.
                x = max(values[c, row, col] - best[col], np.float32(-24.0)) * np.float32(1.0 / 64.0)
                e = np.float32(1.0 / 120.0) * x + np.float32(1.0 / 24.0)
                e = (e * x + np.float32(1.0 / 6.0)) * x + np.float32(0.5)
                e = (e * x + np.float32(1.0)) * x + np.float32(1.0)
                e = e * e
                e = e * e
                e = e * e
                e = e * e
                e = e * e
                total[col] += e * e
        for col in range(width):
            best[col] = np.float32(1.0) / total[col]


@njit(cache=True, nogil=True)
def count_not_finite(values: Floats32) -> int:
    """Number of values (n,) that are not finite, without a temporary array."""
    n_bad = 0
    for i in range(len(values)):
        n_bad += 0 if abs(values[i]) < np.float32(math.inf) else 1
    return n_bad


@njit(cache=True, nogil=True)
def mark_peaks(heat: Floats32, threshold: float, peak: Mask) -> None:
    """Mark the cells from the threshold on that no neighbor exceeds; of equal neighbors, the first one in row order."""
    height, width = heat.shape
    for row in range(height):
        for col in range(width):
            value = heat[row, col]
            top = value >= threshold
            if top:
                for r in range(max(row - 1, 0), min(row + 2, height)):
                    for c in range(max(col - 1, 0), min(col + 2, width)):
                        earlier = r < row or (r == row and c < col)
                        if heat[r, c] > value or (earlier and heat[r, c] == value):
                            top = False
            peak[row, col] = top


@njit(cache=True, nogil=True)
def fill_footprint_sums(
    values: Floats32, are_logits: bool, rectangles: Floats, x_far: float, y_left: float, cell: float, sums: Floats
) -> None:
    """Sum each class's probability over the pixels whose centers lie in a rectangle.

    rectangles : (n, 5) x, y, length, width [m], yaw [rad].
    x_far, y_left, cell : the view's far left corner, and edge of a pixel [m].
    sums : (n, C), overwritten; a rectangle that holds no pixel center gets the nearest pixel in view. If its bounds
        hold more than 2^18 values, only every other row and column is summed, or fewer still.
    """
    n_classes, height, width = values.shape
    pixel = np.empty(n_classes)
    for i in range(rectangles.shape[0]):
        for c in range(n_classes):
            sums[i, c] = 0.0
        x, y, length, across = rectangles[i, 0], rectangles[i, 1], rectangles[i, 2], rectangles[i, 3]
        cos, sin = math.cos(rectangles[i, 4]), math.sin(rectangles[i, 4])
        reach = 0.5 * math.hypot(length, across)
        first_row = max(math.floor((x_far - x - reach) / cell), 0)
        last_row = min(math.ceil((x_far - x + reach) / cell), height)
        first_col = max(math.floor((y_left - y - reach) / cell), 0)
        last_col = min(math.ceil((y_left - y + reach) / cell), width)
        n_values = n_classes * max(last_row - first_row, 0) * max(last_col - first_col, 0)
        step = max(math.ceil(math.sqrt(n_values / MAX_SUMMED)), 1)
        n_inside = 0
        for row in range(first_row, last_row, step):
            dx = x_far - (row + 0.5) * cell - x
            for col in range(first_col, last_col, step):
                dy = y_left - (col + 0.5) * cell - y
                if abs(dx * cos + dy * sin) <= 0.5 * length and abs(dy * cos - dx * sin) <= 0.5 * across:
                    n_inside += 1
                    add_probabilities(values, are_logits, row, col, pixel, sums[i])
        if n_inside == 0:
            row = min(max(math.floor((x_far - x) / cell), 0), height - 1)
            col = min(max(math.floor((y_left - y) / cell), 0), width - 1)
            add_probabilities(values, are_logits, row, col, pixel, sums[i])


@njit(cache=True, nogil=True)
def add_probabilities(values: Floats32, are_logits: bool, row: int, col: int, pixel: Floats, sums: Floats) -> None:
    """Add one pixel's class probabilities to ``sums`` (C,); ``pixel`` (C,) is scratch."""
    n_classes = values.shape[0]
    best = np.float64(values[0, row, col])
    for c in range(1, n_classes):
        best = max(best, np.float64(values[c, row, col]))
    total = 0.0
    for c in range(n_classes):
        value = np.float64(values[c, row, col])
        pixel[c] = (math.exp(value - best) if value < best else 1.0) if are_logits else value
        total += pixel[c]
    for c in range(n_classes):
        sums[c] += pixel[c] / total if are_logits else pixel[c]
