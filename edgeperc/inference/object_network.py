"""The object network: what is at every place where an object may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from ..ground.scan import Scan
from ..objects.boxes import distinct_boxes, join_boxes, not_among
from ..objects.candidate_boxes import (
    LABEL,
    MERGED,
    SCORE,
    boxes_of_objects,
    confirm_boxes,
    decode_objects,
    footprints,
    merge_boxes,
    with_footprints,
)
from ..objects.candidates import Candidates, CellBuffer, find_candidates
from ..objects.cluster import PERSONS, RIDES
from ..objects.crops import MIN_COUNT, Crops, crop_candidates, fill_features, with_points
from ..types.geometry import oriented_iou, rectangles
from ..types.perception import Box
from ..types.points import Floats
from ..types.views import ObjectGeometry
from .session import MAX_ROWS, Session

BoxesFrom = Literal["both", "network", "clusters"]

PARTS = 2  # of the clusters, each with a run of the network of its own

# A look that gives less sees nothing. All round on PandaSet, Lyft, Argoverse 2 and DDAD, 44 of 61 boxes that others
# show and a close look sees are at a vehicle, and 1 of 13 that it does not see.
SEEN = 0.1
AGAIN = 0.15  # boxes with less are not looked at again: a second look confirmed none of them on PandaSet and Lyft
# Nor are boxes that have less than the least score by more than this: of 1,755 boxes between 0.15 and 0.3 on KITTI and
# PandaSet, none reached 0.5 by looking again. This leaves out a quarter of the looks.
GAINED = 0.2
# Of a rectangle: what the network makes of points depends a little on the end from which they are given.
HALF_TURN = np.array([0.0, 0.0, 0.0, 0.0, np.pi])


class ObjectNetwork:
    """Objects all around: class, box and front from the points of every place where an object may be."""

    def __init__(self, session: Session) -> None:
        view = session.card.view
        assert isinstance(view, ObjectGeometry)
        self.card, self.view = session.card, view
        # Threads may take the first looks at the same time.
        self.sessions = [session, *(session.second() for _ in range(1, PARTS))]
        # The first look sifts clusters. What was found, and what others show, gets a close look in any case, for the
        # first one drops vehicles with a hundred points, too.
        self.closely = session.with_constants(least=-np.inf)
        self._cells = CellBuffer()
        self._scale = np.array([session.card.input.mean, session.card.input.std], np.float32)

    def cluster(self, scan: Scan, boxes_from: BoxesFrom, distance_per_m: float) -> Candidates:
        """Where objects may be by the points alone."""
        cells = self._cells.sort(scan, self.view.height_range_m)
        if boxes_from == "network":
            return Candidates(np.empty((0, 5)), cells)
        return find_candidates(scan, cells, distance_per_m)

    def look(self, part: int, scan: Scan, clusters: Candidates, detected: Sequence[Box]) -> Floats:
        """What the network finds, (n, 10), in a part of the clusters, and where the top view has boxes."""
        n = len(clusters.rectangles)
        of_part = clusters.rectangles[part * n // PARTS : (part + 1) * n // PARTS]
        candidates = clusters._replace(rectangles=np.concatenate([of_part, rectangles(detected)]))
        candidates, crops = with_points(candidates, self._crops(scan, candidates))
        return self._look(candidates.rectangles, crops, self.sessions[part])

    def find_boxes(
        self, scan: Scan, clusters: Candidates, detected: Sequence[Box], min_score: float, *looks: Floats
    ) -> tuple[Box, ...]:
        """Boxes by the first looks, each looked at again, and what that shows once more from its other end: a cascade
        (Cai and Vasconcelos, 2018).
        """
        found = merge_boxes(np.concatenate(looks), self.card.classes)
        found = found[found[:, SCORE] >= max(AGAIN, min_score - GAINED)]
        last, again = footprints(found), []
        for turn in (0.0, HALF_TURN):
            look = self._look_at(scan, clusters._replace(rectangles=last + turn))
            last = np.where(look[:, SCORE:LABEL] > 0.0, footprints(look), last)
            again.append(look)
        confirmed = confirm_boxes(found, np.stack(again))
        merged = with_footprints(merge_boxes(confirmed, self.card.classes), detected)
        return tuple(boxes_of_objects(merged, self.card.classes, min_score))

    def complete(
        self,
        scan: Scan,
        clusters: Candidates,
        objects: Sequence[Box],
        others: Sequence[Box],
        by_labels: bool,
        min_score: float,
    ) -> tuple[Box, ...]:
        """Boxes of this network, and what others show, which gets a look; what one of them alone shows is doubted.

        A vehicle that this network sees at a look has its box, with the mean of both scores; one that it does not see
        is dropped. Of two that share less than half of what both cover, the one with the better score stays. Where
        there are too few points for a look, the other box keeps half of its score. ``by_labels``: others show people,
        too, by the labels of their points. Their boxes have the mean of both scores, and stay unless looks move two
        onto one another; people without labels keep half of their scores.
        Boxes of classes that this network does not know stay where there is no other.
        """
        vehicles, people = _by_kind(objects)
        shown, labeled = _by_kind([box for box in others if box.label in self.card.classes])
        overlap = oriented_iou(rectangles(shown), rectangles(vehicles)).max(axis=1, initial=0.0)
        shown = [box for box, most in zip(shown, overlap.tolist(), strict=True) if most <= MERGED]
        looks = self._look_at(scan, clusters._replace(rectangles=rectangles([*shown, *labeled])))
        looks, of_people = looks[: len(shown)], looks[len(shown) :]
        doubted = [box for box, look in zip(shown, looks, strict=True) if look[SCORE] == 0.0]  # without a look
        looks[:, SCORE] = np.where(looks[:, SCORE] >= SEEN, 0.5 * (looks[:, SCORE] + [box.score for box in shown]), 0.0)
        found = boxes_of_objects(merge_boxes(looks, self.card.classes), self.card.classes, min_score)
        more = [box for box in found if box.label not in PERSONS]
        more = [box for box in more if not_among([rival for rival in vehicles if rival.score >= box.score], [box])]
        vehicles = not_among(more, vehicles)
        doubted = not_among([*vehicles, *more], doubted)
        if by_labels:
            doubted += not_among(labeled, people)
            # Looks move riders' boxes: two around parts of one rider come to lie on one another.
            labeled = distinct_boxes(
                [
                    _seen_person(box, look, self.card.classes, min_score)
                    for box, look in zip(labeled, of_people.tolist(), strict=True)
                ]
            )
        kept = [replace(box, score=0.5 * box.score) for box in doubted if 0.5 * box.score >= min_score]
        joined = join_boxes(vehicles if by_labels else [*vehicles, *people], [*more, *labeled, *kept])
        return join_boxes(joined, [box for box in others if box.label not in self.card.classes])

    def _look_at(self, scan: Scan, candidates: Candidates) -> Floats:
        """What the network finds at places, (n, 10), with a score of 0 where there are too few points."""
        crops = self._crops(scan, candidates)
        looks = self._look(candidates.rectangles, crops, self.closely)
        looks[crops.counts < MIN_COUNT] = 0.0
        return looks

    def _crops(self, scan: Scan, candidates: Candidates) -> Crops:
        return crop_candidates(scan, candidates, self.view.n_points, self.view.margin_m)

    def _look(self, places: Floats, crops: Crops, session: Session) -> Floats:
        """Run the network on rectangles (n, 5), and decode what it finds there, (n, 10)."""
        found = [np.empty((0, 10))]
        for first in range(0, len(places), MAX_ROWS):
            part = slice(first, first + MAX_ROWS)
            n = len(places[part])
            fill_features(crops.points[part], crops.counts[part], places[part], self._scale, session.input[:n])
            outputs = session.run(n)["objects"][:n]
            found.append(decode_objects(self.card, outputs, places[part], crops.level[part]))
        return np.concatenate(found)


def _seen_person(box: Box, look: Sequence[float], classes: Sequence[str], min_score: float) -> Box:
    """A person by the labels of points, with the mean of its score and that of a look, (10,).

    A rider's box that the network sees, too, is the mean of both, with the network's heading: labels miss the far side
    and parts of the bicycle. The network places pedestrians no better.
    """
    x, y, z, length, width, height, yaw, score, label, front = look
    seen = replace(box, score=max(0.5 * (box.score + score), min_score))
    if PERSONS[box.label] != RIDES or score < SEEN or classes[int(label)] != box.label:
        return seen
    both = 0.5 * np.add([box.center, box.size], [(x, y, z), (length, width, height)])
    (x, y, z), (length, width, height) = both.tolist()
    return replace(seen, center=(x, y, z), size=(length, width, height), yaw=yaw, front=front)


def _by_kind(boxes: Sequence[Box]) -> tuple[list[Box], list[Box]]:
    """Vehicles, and people."""
    return [box for box in boxes if box.label not in PERSONS], [box for box in boxes if box.label in PERSONS]
