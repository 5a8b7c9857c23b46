"""One answer from the labels, the ground and the boxes of both views: the order of the steps of the agreement."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .agreement import agree_on_boxes, agree_on_points, find_support, find_voters, stand_boxes, without_poles
from .card import ModelCard, TopViewGeometry
from .cells import agree_on_cells, mark_cells
from .cluster import join_boxes, objects_from_points
from .geometry import oriented_iou, rectangles, shared_area
from .ground import Ground
from .linkage import Strips
from .perception import Box, PointLabels, TopView
from .stopwatch import Stopwatch

__all__ = ["BoxesFrom", "combine"]

BoxesFrom = Literal["both", "network", "clusters"]


def combine(
    scan: NDArray[np.float32],
    ground: Ground,
    points: PointLabels | None,
    cells: Callable[[], TopView | None],
    boxes: Sequence[Box],
    watch: Stopwatch,
    *,
    cards: Sequence[ModelCard],
    rules: Collection[str],
    boxes_from: BoxesFrom,
    min_score: float,
    distance_per_m: float,
    beside: Callable[[Callable[[], Any]], Callable[[], Any]],
    strips: Callable[[], Strips | None],
) -> tuple[PointLabels | None, TopView | None, Sequence[Box]]:
    """What the parts agree on, and boxes around clusters of points above the ground (KUL-Seg 5.2).

    A box around a cluster is not dropped because a network might have found it: if a network that sees the object has
    not, the score is lower (`_weighed`).

    Parameters
    ----------
    scan : (n, 4) float32
        x, y, z [m] in the frame of the models, remission.
    ground : Ground
    points : PointLabels or None
        Without a range image, None.
    cells : callable
        Returns the top view, or None without one. It is called while the top view may still be labeled.
    boxes : sequence of Box
        Of the top view's network.
    watch : Stopwatch
    cards : sequence of ModelCard
        Of the networks.
    rules : collection of str
        Of `edgeperc.agreement.RULES`.
    boxes_from : {"both", "network", "clusters"}
    min_score : float
        Boxes around clusters with a lower score are dropped.
    distance_per_m : float
        As in `edgeperc.cluster.find_clusters`.
    beside : callable
        Calls a function, at once in another thread (`edgeperc.side_thread.SideThread`) or later in this one, and
        returns what gives its result.
    strips : callable
        Returns the points above the ground, sorted by `edgeperc.cluster.sort_points`; None if they are not sorted yet.

    Returns
    -------
    tuple of PointLabels or None, TopView or None, and sequence of Box
    """
    clusters = None
    dropped: list[Box] = []
    if points is not None and rules:
        upright = beside(partial(without_poles, scan, points, ground, rules=rules))
        held = find_support(scan, points, ground, boxes, rules=rules)
        clusters = find_voters(
            scan,
            points,
            ground,
            boxes,
            distance_per_m=distance_per_m,
            rules=rules,
            support=held,
            strips=strips(),
        )
        watch.lap("cluster")
    top_view = cells()
    watch.lap("decode")
    if points is not None and clusters is not None:
        points = agree_on_points(
            scan, points, ground, clusters, boxes, view=top_view, rules=rules, support=held, upright=upright()
        )
    marks = None
    if top_view is not None and rules:
        marks = beside(partial(mark_cells, top_view, scan, points, ground, rules=rules))
    if points is not None and clusters is not None:
        kept = agree_on_boxes(boxes, scan, points, ground, rules=rules)
        boxes, dropped = kept, [box for box in boxes if box not in kept]
        watch.lap("agree")
    if points is not None and boxes_from != "network":
        clustered = objects_from_points(
            scan,
            points.labels,
            points.classes,
            among=~ground.mask,
            height_m=ground.height_m,
            clusters=clusters,
            in_view=points.in_view,
            others=boxes if boxes_from == "both" else (),
            distance_per_m=distance_per_m,
            min_score=min_score,
        )
        boxes = join_boxes(boxes, _weighed(clustered, cards, min_score)) if boxes_from == "both" else clustered
        watch.lap("cluster")
    boxes = stand_boxes(boxes, scan, points, ground, rules=rules)
    if top_view is not None and marks is not None:
        top_view = agree_on_cells(top_view, scan, points, ground, boxes, dropped, rules=rules, marks=marks())
        watch.lap("agree")
    return points, top_view, boxes


def _weighed(boxes: Sequence[Box], cards: Sequence[ModelCard], min_score: float) -> list[Box]:
    """Boxes around clusters that no network has found, with the scores that both views give them.

    The score is the mean of the cluster's and that of a network of the top view, which is 0 where it sees the object.
    The network's has the weight of the share of the footprint in its view: out of the view, the cluster's score stands.
    """
    weighed = list(boxes)
    for view, classes in ((card.view, card.box_classes) for card in cards):
        rows = [row for row, box in enumerate(weighed) if box.label in classes]
        if not isinstance(view, TopViewGeometry) or not rows:
            continue
        footprints = rectangles(weighed[row] for row in rows)
        (near, far), (right, left) = view.x_range_m, view.y_range_m
        field = np.array([(0.5 * (near + far), 0.5 * (right + left), far - near, left - right, 0.0)])
        areas = footprints[:, 2] * footprints[:, 3]
        seen = shared_area(oriented_iou(footprints, field), footprints, field)[:, 0] / areas
        for row, share in zip(rows, seen.tolist(), strict=True):
            box = weighed[row]
            weighed[row] = replace(box, score=box.score * (1.0 - 0.5 * share))
    return [box for box in weighed if box.score >= min_score]
