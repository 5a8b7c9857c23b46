"""Make the labels of points, the boxes and the drivable cells of one scan agree.

A network labels pixels or cells without knowing where the ground is, what a point is connected with, or what the
network of the other view says. This stage knows all of it. Clusters of points above the ground vote on their class,
boxes of the top view support or complete the labels, the ground decides what may be an object, and cells below objects
are not drivable. The rules are listed in `RULES`; docs/concepts/agreement.md says what each is worth.

Thresholds were chosen on KITTI's training drives (`edgeperc.datasets.splits.FOLDS`) with networks that were trained
on simulated scans only.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..ground.planes import Ground
from ..ground.scan import Scan
from ..objects.cluster import MIN_PERSON_SHARE, PART_OF, find_clusters
from ..objects.linkage import Strips
from ..objects.persons import complete_persons
from ..system.kernels import njit
from ..types import choices
from ..types.choices import VEHICLES
from ..types.geometry import Grid, box_records, grid_of, is_inside
from ..types.mounting import MODEL_HEIGHT_M
from ..types.perception import Box, PointLabels, TopView
from ..types.points import (
    Bytes,
    Cloud,
    Floats,
    Floats32,
    Heights,
    Ids,
    Ints,
    Ints64,
    Labeled,
    Labels,
    Mask,
    Points,
    Records,
)
from .votes import (
    CLUSTER,
    COMPLETING_SCORE,
    EVERYTHING,
    MIN_VEHICLE_SHARE,
    PERSON,
    VEHICLE,
    Applied,
    Cells,
    Sight,
    Tallies,
    apply_verdicts,
    fill_tallies,
    fill_verdicts,
    fill_votes,
    find_persons_alone,
    may_be_persons,
)

RULES = frozenset(choices.RULES)
"""Names of the rules, for ablations.

``"column"``: a person whose column of points goes on above a person's height is a pole. ``"share"``: a cluster loses a
class that too few of its points have. ``"height"``: a cluster that is too low, or a part of the own vehicle, loses its
class. ``"cells"``: a cluster in the top view that no vehicle's cell touches is no vehicle, and a vehicle's cell whose
points say otherwise becomes background. ``"fill"``: a cluster gets the class that most of its points have.
``"person"``: a cluster of a person's size and shape is one person, a cyclist if longer than a stride; labeled points of
that size stay in any cluster. ``"support"``: boxes of the top view keep and add labels. ``"ground"``: a point on the
ground is labeled only below an object. ``"boxes"``: uncertain boxes without labeled points are dropped. ``"stand"``:
a vehicle's box stands on the ground below its points, and is as tall as they are. ``"ceiling"``: no vehicle's box is
around the sensor, reaches a ceiling or stands behind walls below one (`ground.ceiling`). ``"road"``: cells below boxes,
labeled points and obstacles are not drivable.
"""
_NEED_GROUND = frozenset({"column", "height", "person", "ground", "stand", "road"})

# Height [m] above the ground up to which the column of points at a person may reach. At 2.2 and 2.4 m instead of 2.0 m,
# 24 and 38 % fewer of the false pedestrian points are removed; no pedestrian is lost at any of them.
PERSON_TOP_M: Mapping[str, float] = MappingProxyType({"pedestrian": 2.0, "cyclist": 2.2})
MIN_COLUMN_M = 0.2  # lower points are no part of a column
COLUMN_GAP_M = 0.3  # a larger gap ends a column: a head and the foliage above it

MARGIN_M = 0.1  # by which boxes are grown for points
ABOVE_BOX_M = 0.5
# Of a cluster's points; if more are out of the top view or of the range image's, its cells prove nothing. With 0.5 in
# place of 0.8, fold 1 loses 961 points of a car that is cut by the edge of the top view.
MIN_IN_TOP_VIEW = 0.8
# A box with a smaller share of vehicle points is contradicted. Of 28 such uncertain boxes on every second scan of the
# folds, 3 were right; of 119 others, 53. Between 0.05 and 0.2, car IoU of the folds is the same.
MIN_BOX_SHARE = 0.1
# Nearer than this, beams hit the road beside a vehicle, not below it. On SemanticKITTI, 1,848 of 1,956 points on the
# ground there that had a vehicle's label and were lower were road, and 10 of 168 higher ones.
NEAR_ROAD_M = 6.0
ROAD_TOP_M = 0.06

# Lowest and greatest height of vehicles [m]: 2.5 and 95 % of KITTI's labels, without validation and test drives (17,267
# cars, 1,738 vans, 747 trucks).
TALL_M: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"car": (1.40, 1.75), "van": (1.75, 2.75), "truck": (2.4, 4.15)}
)
# KITTI's boxes begin this far above the ground around them, and end as far above their highest points.
CLEARANCE_M = 0.03
MIN_STANDING = 5  # points that say where a box stands

# Grid of the columns, and of the footprints of labeled objects.
CELL_M = 0.2
N_COLUMNS = 512
BIN_M = 0.1
N_BINS = 64
N_FOOTPRINTS = 1024


class Support(NamedTuple):
    """Of the best vehicle's box around each point: its score, 0 for points in no box, out of view or on the ground
    ((n,) float32), and its class, 0 in no box ((n,) uint8).
    """

    scores: Floats32
    names: Bytes


def find_voters(
    scan: Scan,
    labels: PointLabels,
    support: Support,
    strips: Strips | None = None,
    *,
    distance_per_m: float = 0.015,
    rules: Collection[str] = RULES,
) -> Ints:
    """Cluster of every point, as far as it matters for `agree_on_points`; -1 for none.

    Where too few points of a cluster can have a label, the labeled ones are in cluster -2 and the search ends, so a
    forest is not searched because of a few labels in it. The results are those for complete clusters.
    """
    roles = roles_of(labels.classes)
    votes = np.empty(len(scan.points), np.uint8)
    fill_votes(labels.in_view, Labeled(labels.labels, roles), support.scores, votes)
    # A share of exactly the limit is enough. Labels that are neither vehicles nor persons are never lost.
    is_searched = "share" not in rules or not roles[1:].all()
    shares = (-1.0, -1.0) if is_searched else np.nextafter((MIN_VEHICLE_SHARE, MIN_PERSON_SHARE), 0.0)
    return find_clusters(
        scan.points,
        among=~scan.ground.mask,
        seeds=labels.labels > 0,
        votes=votes,
        min_share=shares,
        distance_per_m=distance_per_m,
        min_points=1,
        strips=strips,
    )


def agree_on_points(
    scan: Scan,
    labels: PointLabels,
    clusters: Ids,
    support: Support,
    upright: Bytes,
    *,
    view: TopView | None = None,
    sight: Sight = EVERYTHING,
    rules: Collection[str] = RULES,
) -> PointLabels:
    """Correct labels of vehicles' and persons' points by clusters, ground and boxes (docs/concepts/agreement.md).

    clusters, upright : modified. A person that stays in a cluster that loses the label gets a number of its own.
    view : without it, or if it has no class of vehicles, the rule ``"cells"`` is skipped; without a plane of the
        ground, rules that need heights.
    """
    rules = _applicable(rules, scan.ground)
    agreed, in_view, roles = upright, labels.in_view, roles_of(labels.classes)
    n = int(clusters.max(initial=-1)) + 1
    tallies = Tallies(np.empty(n, CLUSTER), np.empty((n, len(labels.classes) + 1), np.int32))
    votes = "cells" in rules and view is not None and not {*VEHICLES}.isdisjoint(view.classes)
    fill_tallies(scan.cloud, in_view, agreed, clusters, cells_of(view if votes else None), tallies)
    verdicts = _verdicts(labels.classes, tallies, sight, rules)
    before = agreed.copy()
    apply_verdicts(in_view, clusters, verdicts, roles, support.scores, support.names, agreed)
    if "person" in rules:
        alone = find_persons_alone(scan.cloud, roles, before, agreed)
        for own in alone:
            agreed[own] = before[own]
        for part, whole in PART_OF.items():
            if part in labels.classes and whole in labels.classes:
                walks, rides = labels.classes.index(part), labels.classes.index(whole)
                may_be = may_be_persons(tallies, walks, rides)
                complete_persons(scan.cloud, in_view, clusters, may_be, walks, rides, agreed)
        for number, own in enumerate(alone, start=n):
            clusters[own] = number
    if "ground" in rules:
        clear_ground(scan.points, scan.ground.height_m, scan.ground.mask, roles, agreed)
    return PointLabels(agreed, labels.in_view, labels.classes)


def without_poles(scan: Scan, labels: PointLabels, rules: Collection[str] = RULES) -> Bytes:
    """Labels without the persons whose column of points goes on above a person's height: a new (n,) uint8."""
    upright = labels.labels.copy()
    if "column" in _applicable(rules, scan.ground):
        limits = np.array([PERSON_TOP_M.get(name, 0.0) for name in labels.classes])
        clear_columns(scan.points, scan.ground.height_m, limits, upright)
    return upright


def agree_on_boxes(
    boxes: Sequence[Box], scan: Scan, labels: PointLabels, rules: Collection[str] = RULES
) -> tuple[Box, ...]:
    """Drop the uncertain vehicle boxes of a top-view network that the agreed labels contradict: without points above
    the ground, or with too few vehicle points. Boxes out of the range image's view stay.
    """
    roles = roles_of(labels.classes)
    doubted = [k for k, box in enumerate(boxes) if box.score < COMPLETING_SCORE and box.label in VEHICLES]
    if "boxes" not in rules or not doubted or not (roles == VEHICLE).any():
        return tuple(boxes)
    counts = np.empty((len(doubted), 3), np.int64)
    rows = as_rows([boxes[k] for k in doubted])
    count_inside(scan.cloud, scan.ground.mask, labels.in_view, Labeled(labels.labels, roles), rows, counts)
    held, seen, labeled = counts.T
    wrong = (held == 0) | ((seen > 0) & (labeled < MIN_BOX_SHARE * seen))
    dropped = {k for k, is_wrong in zip(doubted, wrong, strict=True) if is_wrong}
    return tuple(box for k, box in enumerate(boxes) if k not in dropped)


def stand_boxes(
    boxes: Sequence[Box],
    scan: Scan,
    labels: PointLabels | None,
    rules: Collection[str] = RULES,
    distance_per_m: float = 0.015,
) -> tuple[Box, ...]:
    """Give vehicles' boxes the height of their points, and put them on the ground (docs/concepts/agreement.md)."""
    vehicles = [k for k, box in enumerate(boxes) if box.label in TALL_M]
    if "stand" not in _applicable(rules, scan.ground) or not vehicles:
        return tuple(boxes)
    rows = as_rows([boxes[k] for k in vehicles])
    rows["top"] = [TALL_M[boxes[k].label][1] for k in vehicles]
    sums = np.empty((len(rows), 3))
    if labels is None:
        nothing = np.zeros(len(scan.points), np.bool_)
        labels = PointLabels(nothing.view(np.uint8), nothing, ("background",))
    labeled = Labeled(labels.labels, roles_of(labels.classes))
    sum_inside(scan.cloud, scan.ground.mask, labels.in_view, labeled, rows, sums)
    standing = list(boxes)
    for k, (n, level, top) in zip(vehicles, sums.tolist(), strict=True):
        if n >= MIN_STANDING:
            box = boxes[k]
            low, high = TALL_M[box.label]
            gap_m = distance_per_m * math.hypot(*box.center[:2])
            # What is taller than the sensor may end above its view: the highest point does not show the top.
            most = math.inf if low > MODEL_HEIGHT_M else top + gap_m
            tall = min(max(box.size[2], top, low), max(most, low), high)
            center = (*box.center[:2], level / n + CLEARANCE_M + 0.5 * tall)
            standing[k] = replace(box, center=center, size=(*box.size[:2], tall))
    return tuple(standing)


def _applicable(rules: Collection[str], ground: Ground) -> frozenset[str]:
    return frozenset(rules) if ground.plane is not None else frozenset(rules) - _NEED_GROUND


def roles_of(classes: Sequence[str]) -> Bytes:
    """For each class: 1 for vehicles, 2 for persons, 0 for others."""
    return np.array([VEHICLE if c in VEHICLES else PERSON if c in PERSON_TOP_M else 0 for c in classes], np.uint8)


def cells_of(view: TopView | None) -> Cells:
    """A top view as the kernels take it; None has no cells."""
    classes = () if view is None else view.classes
    is_vehicle = np.array([name in VEHICLES for name in classes] + [False] * (256 - len(classes)), np.bool_)
    if view is None:
        return Cells(np.empty((0, 0), np.uint8), is_vehicle, Grid(1.0, 1.0, 1.0))
    return Cells(np.ascontiguousarray(view.labels), is_vehicle, grid_of(view.geometry))


def as_rows(boxes: Sequence[Box], labels: Sequence[int] | None = None) -> Records:
    """Boxes with a margin for points, (m,) `BOX`; ``labels`` are those of their points."""
    return box_records(boxes, labels or [0] * len(boxes), MARGIN_M, ABOVE_BOX_M)


def find_support(
    scan: Scan, labels: PointLabels, boxes: Sequence[Box], rules: Collection[str] = RULES, own: Sequence[Box] = ()
) -> Support:
    """The best vehicle's box around each point; boxes that the labels contradict (`MIN_BOX_SHARE`) do not count. Points
    in boxes of the ``own`` vehicle are background.
    """
    known = {name: labels.classes.index(name) for name in VEHICLES if name in labels.classes}
    usable = [box for box in boxes if box.label in VEHICLES] if "car" in known and "support" in rules else []
    support = Support(np.empty(len(scan.points), np.float32), np.empty(len(scan.points), np.uint8))
    among, labeled = labels.in_view & ~scan.ground.mask, Labeled(labels.labels, roles_of(labels.classes))
    numbers = [known.get(box.label, known["car"]) for box in usable]
    mine = [replace(box, score=1.0) for box in own]
    rows = as_rows([*usable, *mine], [*numbers, *(0 for _ in mine)])
    fill_support(scan.cloud, among, labeled, rows, support)
    return support


def _verdicts(classes: Sequence[str], tallies: Tallies, sight: Sight, rules: Collection[str]) -> Bytes:
    """What becomes of each label in each cluster, (k, classes)."""
    clusters = tallies.clusters
    refused = clusters["n_in_both"] >= MIN_IN_TOP_VIEW * clusters["n_points"]
    refused &= clusters["n_in_vehicles"] == 0
    parts = [(classes.index(p), classes.index(w)) for p, w in PART_OF.items() if p in classes and w in classes]
    verdicts = np.empty((len(clusters), len(classes)), np.uint8)
    applied = Applied("share" in rules, "height" in rules, "fill" in rules)
    fill_verdicts(
        tallies, refused, roles_of(classes), np.array(parts, np.int64).reshape(-1, 2), applied, sight, verdicts
    )
    return verdicts


@njit(cache=True, nogil=True)
def cell_of(points: Points, i: int, n: int) -> tuple[int, int]:
    """Row and column of a point in a grid of n x n cells of `CELL_M` around the sensor; -1, -1 outside of it."""
    half = 0.5 * n * CELL_M
    x, y = np.float64(points[i, 0]) + half, np.float64(points[i, 1]) + half
    if not ((x >= 0.0) & (x < 2.0 * half) & (y >= 0.0) & (y < 2.0 * half)):
        return -1, -1
    return min(int(x / CELL_M), n - 1), min(int(y / CELL_M), n - 1)


@njit(cache=True, nogil=True)
def clear_columns(points: Points, height: Heights, limits: Floats, labels: Labels) -> None:
    """Make persons background whose column of points goes on above the limit of their class [m]; 0: not persons."""
    first_row, last_row, first_col, last_col = N_COLUMNS, -1, N_COLUMNS, -1  # of the cells around persons
    for i in range(points.shape[0]):
        if limits[labels[i]] > 0.0:
            row, col = cell_of(points, i, np.int64(N_COLUMNS))
            if row >= 0:
                first_row, last_row = min(first_row, max(row - 1, 0)), max(last_row, min(row + 1, N_COLUMNS - 1))
                first_col, last_col = min(first_col, max(col - 1, 0)), max(last_col, min(col + 1, N_COLUMNS - 1))
    if last_row < 0:
        return
    half = 0.5 * N_COLUMNS * CELL_M + CELL_M  # a cell more, for what is rounded
    low_x, high_x = first_row * CELL_M - half, (last_row + 3) * CELL_M - half
    low_y, high_y = first_col * CELL_M - half, (last_col + 3) * CELL_M - half
    taken = np.zeros((last_row - first_row + 1, last_col - first_col + 1), np.uint64)
    one = np.uint64(1)
    for i in range(points.shape[0]):
        x, y = points[i, 0], points[i, 1]
        if not ((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y) & (height[i] >= MIN_COLUMN_M)):
            continue
        z = np.float64(height[i])
        row, col = cell_of(points, i, np.int64(N_COLUMNS))
        if first_row <= row <= last_row and first_col <= col <= last_col and z < N_BINS * BIN_M:
            taken[row - first_row, col - first_col] |= one << np.uint64(min(int(z / BIN_M), N_BINS - 1))
    most_missing = int(COLUMN_GAP_M / BIN_M + 0.5)
    for i in range(points.shape[0]):
        limit = limits[labels[i]]
        if limit <= 0.0:
            continue
        z = np.float64(height[i])
        row, col = cell_of(points, i, np.int64(N_COLUMNS))
        if row < 0 or not ((z >= 0.0) & (z < N_BINS * BIN_M)):
            continue
        column = np.uint64(0)
        for r in range(max(row - 1, 0), min(row + 2, N_COLUMNS)):
            for c in range(max(col - 1, 0), min(col + 2, N_COLUMNS)):
                column |= taken[r - first_row, c - first_col]
        top = min(int(z / BIN_M), N_BINS - 1)
        for at in range(top + 1, N_BINS):
            if (column >> np.uint64(at)) & one:
                top = at
            elif at - top > most_missing:
                break
        if (top + 1) * BIN_M > limit + 0.5 * BIN_M:
            labels[i] = 0


@njit(cache=True, nogil=True)
def fill_support(cloud: Cloud, among: Mask, labeled: Labeled, boxes: Records, support: Support) -> None:
    """Find the best box around each point ``among`` others, of those with enough vehicle points (`MIN_BOX_SHARE`)."""
    points, height, labels, roles = cloud.points, cloud.height, labeled.labels, labeled.roles
    scores, names = support.scores, support.names
    scores[:] = 0.0
    names[:] = 0
    if boxes.shape[0] == 0:
        return
    low_x, high_x, low_y, high_y = bounds_of(boxes)
    near = np.empty(points.shape[0], np.int32)  # points that may be in a box
    n_near = 0
    n_inside, n_labeled = np.zeros(boxes.shape[0], np.int64), np.zeros(boxes.shape[0], np.int64)
    for i in range(points.shape[0]):
        if not among[i]:
            continue
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        if not ((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)):
            continue
        is_near = False
        for k in range(boxes.shape[0]):
            if height[i] <= boxes[k]["top"] and is_inside(boxes[k], x, y):
                is_near = True
                n_inside[k] += 1
                n_labeled[k] += 1 if roles[labels[i]] == VEHICLE else 0
        near[n_near] = i
        n_near += 1 if is_near else 0
    for i in near[:n_near]:
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        for k in range(boxes.shape[0]):
            box = boxes[k]
            if n_labeled[k] < MIN_BOX_SHARE * n_inside[k]:
                continue
            if box["score"] > scores[i] and height[i] <= box["top"] and is_inside(box, x, y):
                scores[i] = box["score"]
                names[i] = box["label"]


@njit(cache=True, nogil=True)
def bounds_of(boxes: Records) -> tuple[float, float, float, float]:
    """Lowest and highest x, lowest and highest y of the circles around boxes; none is inside if there are no boxes."""
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    for k in range(boxes.shape[0]):
        box = boxes[k]
        radius = math.hypot(box["half_length"], box["half_width"])
        low_x, high_x = min(low_x, box["x"] - radius), max(high_x, box["x"] + radius)
        low_y, high_y = min(low_y, box["y"] - radius), max(high_y, box["y"] + radius)
    return low_x, high_x, low_y, high_y


@njit(cache=True, nogil=True)
def clear_ground(points: Points, height: Heights, on_ground: Mask, roles: Bytes, labels: Labels) -> None:
    """Make points on the ground background, except in cells in which an object of their kind stands (roles 1 and 2);
    within `NEAR_ROAD_M`, points below `ROAD_TOP_M` in any cell.
    """
    labeled = np.empty(points.shape[0], np.int32)
    n, n_lying = 0, 0
    for i in range(points.shape[0]):
        labeled[n] = i
        has_role = roles[labels[i]] != 0
        n += 1 if has_role else 0
        n_lying += 1 if has_role and on_ground[i] else 0
    if n_lying == 0:
        return
    standing = np.zeros((N_FOOTPRINTS, N_FOOTPRINTS), np.uint8)
    for is_second in range(2):
        for i in labeled[:n]:
            if on_ground[i] != (is_second == 1):
                continue
            role = roles[labels[i]]
            row, col = cell_of(points, np.int64(i), np.int64(N_FOOTPRINTS))
            if is_second == 0:
                if row >= 0:
                    standing[row, col] |= role
                continue
            x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
            is_road = height[i] < ROAD_TOP_M and x * x + y * y < NEAR_ROAD_M * NEAR_ROAD_M
            if is_road or row < 0 or standing[row, col] & role == 0:
                labels[i] = 0


@njit(cache=True, nogil=True)
def count_inside(
    cloud: Cloud, on_ground: Mask, in_view: Mask, labeled: Labeled, boxes: Records, counts: Ints64
) -> None:
    """Count the points above the ground in every box.

    counts : (m, 3) int64, overwritten; all points, those in view, and vehicle points in view.
    """
    points, height, labels, roles = cloud.points, cloud.height, labeled.labels, labeled.roles
    counts[:] = 0
    low_x, high_x, low_y, high_y = bounds_of(boxes)
    for i in range(points.shape[0]):
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        if on_ground[i] or not ((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)):
            continue
        for k in range(boxes.shape[0]):
            if is_inside(boxes[k], x, y) and height[i] <= boxes[k]["top"]:
                counts[k, 0] += 1
                if in_view[i]:
                    counts[k, 1] += 1
                    counts[k, 2] += 1 if roles[labels[i]] == VEHICLE else 0


@njit(cache=True, nogil=True)
def sum_inside(cloud: Cloud, on_ground: Mask, in_view: Mask, labeled: Labeled, boxes: Records, sums: Floats) -> None:
    """Sum up the points above the ground in every box, (m,) `BOX`: vehicles', and those out of view.

    ``sums``, (m, 3), is overwritten: number of points, sum of the z of the ground below them, greatest height [m].
    """
    points, height, labels, roles = cloud.points, cloud.height, labeled.labels, labeled.roles
    sums[:] = 0.0
    low_x, high_x, low_y, high_y = bounds_of(boxes)
    for i in range(points.shape[0]):
        if on_ground[i] or (in_view[i] and roles[labels[i]] != VEHICLE):
            continue
        x, y = np.float64(points[i, 0]), np.float64(points[i, 1])
        if not ((x >= low_x) & (x <= high_x) & (y >= low_y) & (y <= high_y)):
            continue
        above = np.float64(height[i])
        for k in range(boxes.shape[0]):
            if (above >= 0.0) & (above <= boxes[k]["top"]) and is_inside(boxes[k], x, y):
                sums[k, 0] += 1.0
                sums[k, 1] += np.float64(points[i, 2]) - above
                sums[k, 2] = max(sums[k, 2], above)
