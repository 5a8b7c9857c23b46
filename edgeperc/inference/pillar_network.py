"""A detector of others that runs on pillars, as it is exported: no other stage is part of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..types.card import ModelCard
from ..types.detector import PillarGeometry
from ..types.frame import ModelFrame
from ..types.geometry import rectangles
from ..types.mounting import Mounting
from ..types.perception import Box
from ..types.points import Points
from ..types.views import TopViewGeometry
from .detections import decode_detections, distinct_rows
from .pillars import Pillarizer
from .session import Session


class PillarNetwork:
    """A detector of others: boxes from the pillars of all points in its range (PointPillars, CenterPoint); one that
    looks ahead runs four times for a ``full_turn``.
    """

    def __init__(self, session: Session, score_threshold: float, full_turn: bool) -> None:
        view = session.card.view
        assert isinstance(view, PillarGeometry)
        self.session, self.card, self.view, self._score = session, session.card, view, score_threshold
        self._pillarizer = Pillarizer(view, session.card.input, session.input)
        # Beside the values, which are written in place; a graph may take them in another type.
        self._beside = [*zip(session.inputs.values(), self._pillarizer.inputs, strict=True)][1:]
        quarters = 4 if full_turn and not view.is_all_around else 1
        height_m, yaws_deg = session.card.mount_height_m, [view.yaw_deg + 90.0 * k for k in range(quarters)]
        self.frames = [ModelFrame(Mounting(height_m, 0.0, view.pitch_deg, math.remainder(y, 360.0))) for y in yaws_deg]
        self.field = field_of(session.card, full_turn)
        self._n_left_out = 0

    def find_boxes(self, points: Points) -> Sequence[Box]:
        """Boxes in the frame of the models, best score first."""
        boxes: list[Box] = []
        labels: list[int] = []
        self._n_left_out = 0
        for frame in self.frames:
            n = self._pillarizer.fill(frame.move_back(points))
            self._n_left_out += self._pillarizer.n_left_out
            if n == 0:
                continue
            for taken, array in self._beside:
                taken[:n] = array[:n]
            found, numbers = decode_detections(self.card, self.session.run(n), self._score)
            boxes += frame.move_boxes(found)
            labels += numbers.tolist()
        if len(self.frames) == 1:
            return boxes
        scores = np.array([box.score for box in boxes])
        kept = distinct_rows(self.card, rectangles(boxes), scores, np.array(labels, np.int64))
        return [boxes[row] for row in kept.tolist()]

    def about_left_out(self) -> str:
        """What to say if pillars of the last scan had no room; else nothing."""
        if not self._n_left_out:
            return ""
        return (
            f"{self.card.name} does not see {self._n_left_out:,} points of the scan: they lie in pillars beyond the "
            f"first {self.view.max_pillars:,}, view.max_pillars of its card. Raise it; export a graph that takes a "
            "fixed number anew"
        )


def field_of(card: ModelCard, full_turn: bool) -> TopViewGeometry:
    """What a detector sees of the models' frame; of a full turn, the square that is seen as a whole."""
    view = card.view
    assert isinstance(view, PillarGeometry)
    turned = ModelFrame(Mounting(card.mount_height_m, 0.0, view.pitch_deg, view.yaw_deg)).R[:2, :2]
    corners = np.array([(x, y) for x in view.x_range_m for y in view.y_range_m]) @ turned.T
    (x_low, y_low), (x_high, y_high) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    reach_m = min(x_high, -y_low, y_high)
    if full_turn and not view.is_all_around and reach_m > 0.0:
        x_low, y_low, x_high, y_high = -reach_m, -reach_m, reach_m, reach_m
    return TopViewGeometry((x_low, x_high), (y_low, y_high), cell_m=min(100.0, x_high - x_low, y_high - y_low))
