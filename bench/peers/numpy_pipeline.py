"""The pipeline from scan to result without edgeperc: numpy around a network in another engine.

Projections are those of `projection`. Labels are an argmax. Boxes are decoded from peaks of the heat map, suppressed by
overlap and classified. Hidden points take a vote of their neighbors. Everything is vectorized. PointSeg's removal of
outliers is left out, because numpy has no fast search for components: the pipeline does less than edgeperc.

Engines are onnxruntime, OpenVINO's own API, and torch, whose network is the model's own graph, translated: the same
weights with batch norm folded in, as fast as a network written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from edgeperc import Box, PointLabels, TopView
from edgeperc.ground.planes import find_ground
from edgeperc.types.card import ModelCard
from edgeperc.types.geometry import draw_footprints
from edgeperc.types.mounting import MODEL_HEIGHT_M
from edgeperc.types.points import Bytes, Floats32, Ints, Labels, Points
from edgeperc.types.sensor import SensorProfile
from edgeperc.types.views import TopViewGeometry

from ..worker import Prediction
from .engines import Engine
from .projection import NumpyRangeImage, NumpyTopView

STRIDE, MAX_BOXES = 4, 100
WINDOW, N_VOTES, MAX_RANGE_GAP_M = 2, 5, 1.0


class NumpyPipeline:
    """`edgeperc.Perceiver` without its stages, of cards of a front quarter or a dense top view, each with an engine."""

    def __init__(self, cards: Sequence[ModelCard], engines: Sequence[Engine], sensor: SensorProfile) -> None:
        self.sensor = sensor
        self.networks = []
        for card, engine in zip(cards, engines, strict=True):
            view: Any = card.view
            made = NumpyTopView if isinstance(view, TopViewGeometry) else NumpyRangeImage
            index = np.empty(engine.input.shape[1:], np.int32)
            self.networks.append((card, engine, made(view, card.input), index))

    def __call__(self, points: Points) -> Prediction:
        """Compute labels and boxes of a scan (n, 4) with remission in the sensor's raw unit."""
        scale, offset = np.float32(self.sensor.remission_scale), np.float32(self.sensor.remission_offset)
        if (scale, offset) != (1.0, 0.0):
            points = np.column_stack((points[:, :3], (points[:, 3] + offset) * scale))
        labeled, top_view = None, None
        boxes: tuple[Box, ...] = ()
        for card, engine, projector, index in self.networks:
            pixel = np.empty(len(points), np.int32)
            # By edgeperc's kernels: numpy would take seconds.
            high = find_ground(points, mount_height_m=MODEL_HEIGHT_M).height_m if projector.needs_ground else None
            projector.fill(points, engine.input, index, pixel, high)
            by_name = engine.run()
            outputs = {o.kind: spread(by_name[o.name], o.block) for o in card.outputs}
            logits = next(v for kind, v in outputs.items() if kind.startswith("class_"))
            labels = logits.argmax(axis=0).astype(np.uint8)
            if isinstance(card.view, TopViewGeometry):
                boxes = tuple(dense_boxes(card, logits, outputs["box_dense"]))
                boxed = np.isin(labels, [card.classes.index(name) for name in card.box_classes])
                labels[boxed & (engine.input == 0.0).all(axis=0)] = 0
                draw_footprints(labels, boxes, card.view, card.classes)
                observed = np.ones(labels.shape, np.bool_)  # only labels are compared
                x_range_m, y_range_m = card.view.x_range_m, card.view.y_range_m
                top_view = TopView(labels, card.classes, card.view.cell_m, x_range_m, y_range_m, observed)
            else:
                labeled = PointLabels(vote(points, pixel, index, labels, len(card.classes)), pixel >= 0, card.classes)
        return Prediction(labeled, top_view, boxes)


def spread(values: Floats32, block: tuple[int, int]) -> Floats32:
    """`edgeperc.inference.decode.fill_pixels` in numpy."""
    (rows, cols), (n, height, width) = block, values.shape
    parts = values.reshape(n // (rows * cols), rows, cols, height, width)
    return parts.transpose(0, 3, 1, 4, 2).reshape(-1, height * rows, width * cols)


def vote(points: Points, pixel: Ints, index: Ints, labels: Labels, n_classes: int) -> Bytes:
    """`edgeperc.objects.refine.label_points` of a view that is not a full turn, in numpy."""
    classes = np.where(pixel >= 0, labels.reshape(-1)[pixel], 0).astype(np.uint8)
    hidden = np.flatnonzero((pixel >= 0) & (index.reshape(-1)[pixel] != np.arange(len(points))))
    distance = np.linalg.norm(points[:, :3].astype(np.float64), axis=1)
    ranges = np.pad(np.where(index >= 0, distance[index], np.inf), WINDOW, constant_values=np.inf)
    around = np.pad(labels, WINDOW)
    row, col = np.divmod(pixel[hidden], labels.shape[1])
    d_row, d_col = np.mgrid[: 2 * WINDOW + 1, : 2 * WINDOW + 1].reshape(2, -1)
    cell = row[:, None] + d_row, col[:, None] + d_col
    gaps = np.abs(ranges[cell] - distance[hidden, None])
    nearest = np.argsort(gaps, axis=1, kind="stable")[:, :N_VOTES]
    votes = np.take_along_axis(around[cell], nearest, axis=1).astype(np.int64)
    votes[np.take_along_axis(gaps, nearest, axis=1) > MAX_RANGE_GAP_M] = n_classes
    same = (votes[:, :, None] == votes[:, None, :]).sum(axis=2) * (votes < n_classes)
    winner = np.take_along_axis(votes, same.argmax(axis=1)[:, None], axis=1)[:, 0]
    classes[hidden] = np.where(winner < n_classes, winner, 0)
    return classes


def dense_boxes(card: ModelCard, logits: Floats32, dense: Floats32) -> list[Box]:
    """`edgeperc.inference.box_heads.decode_dense` in numpy."""
    view = card.view
    assert isinstance(view, TopViewGeometry)
    heat = dense[0]
    height, width = heat.shape
    padded = np.pad(heat, 1, constant_values=-np.inf)
    highest = np.max([padded[r : r + height, c : c + width] for r in range(3) for c in range(3)], axis=0)
    threshold = math.log(card.score_threshold / (1.0 - card.score_threshold))
    rows, cols = np.nonzero((heat == highest) & (heat >= threshold))
    best = np.argsort(-heat[rows, cols], kind="stable")[:MAX_BOXES]
    rows, cols = rows[best], cols[best]
    score, d_row, d_col, log_l, log_w, sin, cos, z, log_h, *front = dense[:, rows, cols].astype(np.float64)
    cell_m = STRIDE * view.cell_m
    x, y = view.x_range_m[1] - (rows + 0.5 + d_row) * cell_m, view.y_range_m[1] - (cols + 0.5 + d_col) * cell_m
    sizes, yaw = np.exp([log_l, log_w, log_h]).T, 0.5 * np.arctan2(sin, cos)
    boxes: list[Box] = []
    all_x, all_y = (centers.reshape(-1) for centers in view.cell_centers())
    for k in range(len(rows)):
        place, size = (float(x[k]), float(y[k]), float(z[k])), tuple(sizes[k].tolist())
        box = Box("", float(1.0 / (1.0 + math.exp(-score[k]))), place, size, float(yaw[k]))
        if any(iou(box, better) > card.nms_iou for better in boxes):
            continue
        reach = math.hypot(*size[:2]) / 2.0
        near_rows, near_cols = np.flatnonzero(abs(all_x - x[k]) < reach), np.flatnonzero(abs(all_y - y[k]) < reach)
        dx, dy = all_x[near_rows, None] - x[k], all_y[None, near_cols] - y[k]
        inside = abs(dx * np.cos(yaw[k]) + dy * np.sin(yaw[k])) <= size[0] / 2.0
        inside &= abs(dy * np.cos(yaw[k]) - dx * np.sin(yaw[k])) <= size[1] / 2.0
        shares = np.exp(logits[:, near_rows[:, None], near_cols].astype(np.float64))
        sums = (shares / shares.sum(axis=0))[:, inside].sum(axis=1)
        evidence = [_evidence(card, name, sums[card.classes.index(name)], size) for name in card.box_classes]
        label = card.box_classes[int(np.argmax(evidence))]
        heading, p_front = float(yaw[k]), None
        if front:
            logit = float(front[0][k] * math.cos(heading) + front[1][k] * math.sin(heading))
            p_front = 1.0 / (1.0 + math.exp(-abs(logit)))
            if logit < 0.0:
                heading += -math.pi if heading > 0.0 else math.pi
        boxes.append(Box(label, box.score, place, size, heading, p_front))
    return boxes


def _evidence(card: ModelCard, name: str, share: float, size: Sequence[float]) -> float:
    if not card.box_size_spreads:
        return float(share)
    spread = np.array(card.box_size_spreads[name])
    off = np.log(size) - np.log(card.box_size_priors[name])
    return float(np.log(max(share, 1e-300)) - 0.5 * ((off / spread) ** 2).sum() - np.log(spread).sum())


def iou(a: Box, b: Box) -> float:
    """Intersection over union of two footprints, by clipping one polygon with the sides of the other."""
    reach = math.hypot(*a.size[:2]) / 2.0 + math.hypot(*b.size[:2]) / 2.0
    if math.hypot(a.center[0] - b.center[0], a.center[1] - b.center[1]) >= reach:
        return 0.0
    polygon, clip = a.corners().tolist(), b.corners().tolist()
    for (x0, y0), (x1, y1) in zip(clip, clip[1:] + clip[:1], strict=True):
        sides = [(x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) for x, y in polygon]
        kept = []
        for k, (x, y) in enumerate(polygon):
            (last_x, last_y), last, side = polygon[k - 1], sides[k - 1], sides[k]
            if (side >= 0.0) != (last >= 0.0):
                share = last / (last - side)
                kept.append([last_x + share * (x - last_x), last_y + share * (y - last_y)])
            if side >= 0.0:
                kept.append([x, y])
        polygon = kept
    shared = 0.5 * sum(polygon[k - 1][0] * y - x * polygon[k - 1][1] for k, (x, y) in enumerate(polygon))
    return shared / (a.size[0] * a.size[1] + b.size[0] * b.size[1] - shared)
