"""The stages of the agreement on arrays, in the order of the pipeline."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from edgeperc import Box, PointLabels, TopView
from edgeperc.agreement.cells import agree_on_cells, mark_cells
from edgeperc.agreement.rules import RULES, agree_on_points, find_support, find_voters, without_poles
from edgeperc.agreement.votes import EVERYTHING, Sight
from edgeperc.ground.planes import Ground
from edgeperc.ground.scan import Scan


def voters_of(
    points: NDArray[np.float32],
    labels: PointLabels,
    ground: Ground,
    boxes: Sequence[Box] = (),
    rules: Collection[str] = RULES,
) -> NDArray[np.int32]:
    scan = Scan.of(points, ground, labels)
    return find_voters(scan, labels, find_support(scan, labels, boxes, rules), rules=rules)


def agreed_points(
    points: NDArray[np.float32],
    labels: PointLabels,
    ground: Ground,
    clusters: NDArray[np.int32],
    boxes: Sequence[Box] = (),
    *,
    view: TopView | None = None,
    sight: Sight = EVERYTHING,
    rules: Collection[str] = RULES,
) -> PointLabels:
    scan = Scan.of(points, ground, labels)
    support, upright = find_support(scan, labels, boxes, rules), without_poles(scan, labels, rules)
    return agree_on_points(scan, labels, clusters, support, upright, view=view, sight=sight, rules=rules)


def agreed_cells(
    view: TopView,
    points: NDArray[np.float32],
    labels: PointLabels | None,
    ground: Ground,
    boxes: Sequence[Box],
    dropped: Sequence[Box] = (),
    rules: Collection[str] = RULES,
) -> TopView:
    marks = mark_cells(view, Scan.of(points, ground, labels), labels, rules)
    return agree_on_cells(view, labels, boxes, dropped, marks, rules)
