"""Boxes around clusters of labeled points, joined with those of a network."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from ..errors import PointsError
from ..system.kernels import njit
from ..types.choices import VEHICLES
from ..types.geometry import oriented_iou, rectangles, shared_area, suppress_overlaps
from ..types.perception import Box
from ..types.points import Cloud, Floats, Heights, Ids, Ints, Labeled, Labels, Mask, Points, check_each, read_only
from ..types.views import TopViewGeometry
from .cluster import MIN_PERSON_SHARE, PERSONS, Groups, find_clusters, group_points, labels_of_groups
from .persons import PERSON, UNSEEN, fill_person_groups, fill_persons
from .rectangles import fit_rectangle

# Mean length, width and height [m] of KITTI's labeled objects.
OBJECT_SIZE_M: Mapping[str, tuple[float, float, float]] = MappingProxyType(
    {
        "car": (3.89, 1.63, 1.53),
        "van": (5.07, 1.91, 2.20),
        "truck": (10.44, 2.59, 3.23),
        "pedestrian": (0.85, 0.66, 1.76),
        "cyclist": (1.77, 0.61, 1.74),
    }
)
# A cluster that is at least this high, or this long, is a van or a truck [m]. On the training drives, 100 % of 421 cars
# on KITTI are lower and 80 % of 307 vans are higher; 91 % of 905 cars on PandaSet, with pickups, are lower.
VAN_HEIGHT_M = 1.8
TRUCK_HEIGHT_M, TRUCK_LENGTH_M = 2.4, 7.0
MAX_WIDTH_M = 3.0  # 10 of the 22,760 vehicles in KITTI's labels are wider, by up to 0.2 m
MAX_FITS = 4  # of a rectangle to what is left of a cluster; 14 clusters in 385 scans need more than one
N_ANGLES = 90
MAX_FITTED = 256  # a rectangle's heading is fitted to at most this many points
MAX_OBJECTS = 1000  # clusters that get a box; 40 KITTI scans have at most 16
MIN_SIDE_M = 0.1
MAX_END = 1.4  # a front or a rear is at most this many usual widths wide
MAX_OVERLAP = 0.1  # IoU of two objects; the completed boxes of two pieces of one object overlap by more
# Of two of these and others, the lower limit counts. Boxes of people 0.5 m apart overlap by 0.26. In KITTI's labels,
# none of 53 pairs of cyclists within 2 m, and none of 67 pairs of a cyclist and a pedestrian, overlaps by 0.05.
MAX_OVERLAP_OF = MappingProxyType({"pedestrian": 0.3})
MAX_INSIDE = 0.5  # of the smaller of two footprints
EVIDENCE = 10.0  # number of points for which this factor of the score is 0.5
# Of a person, a fifth of those that an HDL-64E gets from 0.85 m2 (1.25 m / distance_per_m / range, squared) and at most
# 80: what has 30 points at a distance of 10 m is a small part of something. Precision of pedestrians and cyclists on
# the training drives, labeled by networks that were not trained on them, is 44 and 73 % with it, 36 and 52 % without.
PERSON_POINTS, MAX_EVIDENCE = 1.25, 80.0
# Heads are not wider; the widest is 0.47 m on the training drives. A rider's back is as high as the head.
MAX_HEADS_M = MappingProxyType({"pedestrian": 0.55, "cyclist": 0.8})
MIN_SCORE = 0.3  # precision of cars on KITTI's drive 0005 rose from 0.24 to 0.57, recall stayed at 0.70


def objects_from_points(
    points: Points,
    labels: Labels,
    classes: Sequence[str],
    *,
    among: Mask | None = None,
    height_m: Heights | None = None,
    clusters: Ids | None = None,
    in_view: Mask | None = None,
    others: Sequence[Box] = (),
    min_share: float = 0.7,
    distance_per_m: float = 0.015,
    min_points: int = 5,
    min_score: float = MIN_SCORE,
) -> tuple[Box, ...]:
    """Fit boxes to the clusters that have one dominant class (KUL-Seg 5.2), and to persons (docs/concepts/clusters.md);
    the best score comes first. Raises PointsError.

    labels : index into ``classes`` of every point; 0 is the background.
    among : points to cluster. Leave out the ground (`Ground.mask`), which would join everything on it.
    height_m : `Ground.height_m`; a box then reaches down to the ground, otherwise to its lowest point.
    clusters : of `find_clusters` with labeled points as seeds; by default they are found among ``among``.
    in_view : points in the network's view, all by default. The others have no label.
    others : boxes that are known, such as a network's. Points inside of them are no further object.
    min_share : a cluster needs more than this share of its points in view with one class. Persons need no share.
    """
    check_each(len(points), labels=labels, height_m=height_m, in_view=in_view, clusters=clusters)
    if labels.size and int(labels.max()) >= len(classes):
        raise PointsError(f"got label {int(labels.max())} for {len(classes)} classes; pass the classes of the labels")
    roles = np.zeros(256, np.uint8)  # `WALKS` or `RIDES` for persons' labels
    roles[: len(classes)] = [PERSONS.get(name, 0) for name in classes[:256]]
    if clusters is None:
        clusters = find_clusters(
            points,
            among=among,
            seeds=labels > 0,
            votes=np.where(labels > 0, np.where(roles > 0, 7, 3)[labels], in_view is None or in_view).astype(np.uint8),
            min_share=(min_share, min(min_share, MIN_PERSON_SHARE)),
            distance_per_m=distance_per_m,
            min_points=min_points,
        )
    labels, clusters = read_only(labels, np.uint8), read_only(clusters, np.int32)
    cloud = Cloud(read_only(points), read_only(np.zeros(len(points)) if height_m is None else height_m))
    groups = group_points(clusters)
    numbers = labels
    if in_view is not None and roles.any() and len(classes) < len(roles):
        numbers = read_only(np.where(in_view, labels, len(classes)), np.uint8)
        roles[len(classes)] = UNSEEN
    standing = cloud if height_m is not None else _above_lowest(cloud, clusters, groups)
    persons = _persons(standing, Labeled(numbers, roles), classes, clusters, groups, distance_per_m, max(min_points, 1))
    sizes = np.diff(groups.starts)
    found, shares = labels_of_groups(groups, labels)
    seen = sizes
    if in_view is not None and len(sizes):
        seen = np.add.reduceat(in_view[groups.order], groups.starts[:-1], dtype=np.int64)
        shares *= sizes / np.maximum(seen, 1)
    found[(shares <= min_share) | (roles[found] > 0)] = 0
    evidence = seen / (seen + EVIDENCE)
    highest = np.where((found > 0) & (sizes >= min_points), shares * evidence, -math.inf)  # the box may reduce it
    kept = np.argsort(-highest, kind="stable")[:MAX_OBJECTS]
    kept = np.sort(kept[(found[kept] > 0) & (highest[kept] >= min_score)])
    named_by_size = {*classes_of_boxes(classes)} - {*classes}
    boxes, spans = [], []
    for k in kept.tolist():
        name = classes[found[k]]
        members = groups.order[groups.starts[k] : groups.starts[k + 1]]
        rectangle, levels, top = _fitted(cloud, members, name in VEHICLES)
        levels.sort()
        if height_m is None:
            bottom = float(levels[0])
        else:
            bottom = 0.5 * float(levels[(len(levels) - 1) // 2] + levels[len(levels) // 2])  # the median
        side = float(max(rectangle[2:4]))
        score = float(highest[k])
        if name in OBJECT_SIZE_M:
            _, width, height = OBJECT_SIZE_M[name]
            # Points below the ground are reflections. What is too tall for a car may be a van.
            unseen = distance_per_m * math.hypot(rectangle[0], rectangle[1])  # between the last return and the edge
            score *= min(max(top - bottom + unseen, 0.0) / height, 1.0) ** 2
            score *= min(1.0, (side + unseen) / width)
        if score >= min_score:
            usual = name
            if named_by_size and name == "car":
                name = _vehicle_of_size(side, top - bottom)
                usual = "car" if name == "car" else "van"  # trucks differ too much in length
            boxes.append(_completed(name, score, rectangle, bottom, top, OBJECT_SIZE_M.get(usual, (0.0, 0.0, 0.0))))
            spans.append(rectangle)
    boxes = _not_inside(boxes, spans, others)
    persons = [box for box in persons if box.score >= min_score]
    return join_boxes(distinct_boxes(boxes), distinct_boxes(persons))


def _not_inside(boxes: list[Box], spans: Sequence[Floats], others: Sequence[Box]) -> list[Box]:
    """The boxes whose points, with rectangles ``spans``, do not lie mostly in a better one, such as inside of a bus."""
    if not boxes:
        return boxes
    every = [*boxes, *others]
    a, b = np.array(spans), rectangles(every)
    a[:, 2:4] = np.maximum(a[:, 2:4], MIN_SIDE_M)
    scores = np.array([box.score for box in every])
    inside = shared_area(oriented_iou(a, b), a, b) > MAX_INSIDE * (a[:, 2] * a[:, 3])[:, np.newaxis]
    inside &= scores > scores[: len(boxes), np.newaxis]
    return [boxes[row] for row in np.flatnonzero(~inside.any(axis=1)).tolist()]


def _fitted(cloud: Cloud, members: Ints, l_shaped: bool) -> tuple[Floats, Floats, float]:
    """What `fill_rectangle` finds. A vehicle is not wider than `MAX_WIDTH_M`: in a wider cluster, which holds something
    else too, the rectangle is fitted to the points in the strip of that width that holds the most.
    """
    for _ in range(MAX_FITS):
        rectangle, levels = np.empty(5), np.empty(len(members))
        top = fill_rectangle(cloud, members, l_shaped, rectangle, levels)
        if not l_shaped or min(rectangle[2:4]) <= MAX_WIDTH_M:
            break
        across = rectangle[4] + (math.pi / 2.0 if rectangle[2] >= rectangle[3] else 0.0)
        side = cloud.points[members, :2] @ np.array([math.cos(across), math.sin(across)])
        ordered = np.sort(side)
        n_within = np.searchsorted(ordered, ordered + MAX_WIDTH_M, side="right") - np.arange(len(side))
        first = ordered[n_within.argmax()]
        members = members[(side >= first) & (side <= first + MAX_WIDTH_M)]
    return rectangle, levels, top


def classes_of_boxes(classes: Sequence[str]) -> tuple[str, ...]:
    """Classes that the boxes around labeled points can have: `objects_from_points` names vans and trucks by their size.

    classes : of the labels; the first one is the background.
    """
    by_size = ("van", "truck") if "car" in classes and not {"van", "truck"} & {*classes} else ()
    return (*classes[1:], *by_size)


def distinct_boxes(boxes: Sequence[Box]) -> list[Box]:
    """Of boxes that overlap by more than either may, the one with the better score; best score first."""
    limits = [MAX_OVERLAP_OF.get(box.label, MAX_OVERLAP) for box in boxes]
    best = suppress_overlaps(rectangles(boxes), [box.score for box in boxes], limits, max_inside=MAX_INSIDE)
    return [boxes[row] for row in best]


def _above_lowest(cloud: Cloud, clusters: Ids, groups: Groups) -> Cloud:
    """Points with their heights above the lowest point of their cluster, (n,)."""
    z = cloud.points[:, 2]
    if not len(groups.order):
        return cloud
    lowest = np.minimum.reduceat(z[groups.order], groups.starts[:-1])
    return Cloud(cloud.points, read_only(z - np.where(clusters >= 0, lowest[clusters], 0.0)))


def _persons(
    cloud: Cloud,
    labeled: Labeled,
    classes: Sequence[str],
    clusters: Ids,
    by_cluster: Groups,
    distance_per_m: float,
    min_points: int,
) -> list[Box]:
    """The boxes of persons, of any score; see `objects_from_points`."""
    if not labeled.roles.any() or not len(by_cluster.order):
        return []
    groups = Groups(np.empty_like(by_cluster.order), np.empty_like(by_cluster.starts))
    loose = np.empty_like(by_cluster.order)
    n_whole, n_loose = fill_person_groups(cloud, labeled, by_cluster, groups, loose)
    groups = Groups(groups.order[: groups.starts[n_whole]], groups.starts[: n_whole + 1])
    if n_loose:
        linked = find_clusters(cloud.points[loose[:n_loose]], distance_per_m=distance_per_m, min_points=min_points)
        order, starts = group_points(linked)
        groups = Groups(
            np.concatenate([groups.order, loose[order]]),
            np.concatenate([groups.starts, groups.starts[-1] + starts[1:]]),
        )
    persons = np.empty(min(len(groups.order) // min_points, MAX_OBJECTS), PERSON)
    n = fill_persons(cloud, labeled, groups, n_whole, clusters, by_cluster, min_points, persons)
    known = [name for name in PERSONS if name in classes]
    boxes = []
    for rides, x, y, along, across, yaw, bottom, top, n_points, share, heads in persons[:n].tolist():
        name = known[-1] if rides else known[0]
        evidence = EVIDENCE
        if distance_per_m > 0.0:
            expected = (PERSON_POINTS / max(distance_per_m * math.hypot(x, y), MIN_SIDE_M)) ** 2
            evidence = min(max(expected, EVIDENCE), MAX_EVIDENCE)
        score = share * n_points / (n_points + evidence)
        usual = OBJECT_SIZE_M.get(name, (0.0, 0.0, 0.0))
        if name in OBJECT_SIZE_M:
            seen = max(top - bottom, 0.0) / usual[2]
            score *= min(seen, 1.0 / max(seen, 1.0)) ** 2  # too tall: probably a pole
            score *= min(1.0, MAX_HEADS_M[name] / max(heads, MIN_SIDE_M)) ** 2
        sides = (max(along, usual[0], MIN_SIDE_M), max(across, usual[1], MIN_SIDE_M))
        tall = max(top - bottom, usual[2], MIN_SIDE_M)
        if not rides:  # whose shoulders are the axis: of 80 pedestrians of 19 drives, 60 look across it, 20 along it
            sides, yaw = sides[::-1], yaw + math.pi / 2.0
        yaw = (yaw + math.pi / 2.0) % math.pi - math.pi / 2.0
        boxes.append(Box(name, score, (x, y, bottom + 0.5 * tall), (*sides, tall), yaw))
    return boxes


def weigh(boxes: Sequence[Box], view: TopViewGeometry, classes: Sequence[str], min_score: float) -> list[Box]:
    """Boxes around clusters that a network of the top view has not found, with the mean of the cluster's score and the
    network's, 0 where it sees the object; that has the weight of the share of the footprint in its view. Boxes below
    ``min_score`` are dropped.
    """
    rows = [row for row, box in enumerate(boxes) if box.label in classes]
    weighed = list(boxes)
    if rows:
        footprints = rectangles(boxes[row] for row in rows)
        (near, far), (right, left) = view.x_range_m, view.y_range_m
        field = np.array([(0.5 * (near + far), 0.5 * (right + left), far - near, left - right, 0.0)])
        areas = footprints[:, 2] * footprints[:, 3]
        seen = shared_area(oriented_iou(footprints, field), footprints, field)[:, 0] / areas
        for row, share in zip(rows, seen.tolist(), strict=True):
            weighed[row] = replace(boxes[row], score=boxes[row].score * (1.0 - 0.5 * share))
    return [box for box in weighed if box.score >= min_score]


def join_boxes(first: Sequence[Box], second: Sequence[Box]) -> tuple[Box, ...]:
    """Join two lists of boxes, best score first; a box of ``second`` is dropped if ``first`` has the same object.

    A person with the better score is kept, because people stand close to cars. Two boxes are one object if they overlap
    by more than 0.1 (IoU), or if more than half of one footprint lies in the other.
    """
    others: list[Box] = []
    same = _same_object(second, first) if first and second else np.zeros((len(second), 0), np.bool_)
    for row, box in enumerate(second):
        best = max((first[k].score for k in np.flatnonzero(same[row]).tolist()), default=-math.inf)
        if best == -math.inf or (box.label in PERSONS and box.score > best):
            others.append(box)
    return tuple(sorted((*first, *others), key=lambda box: -box.score))


def not_among(first: Sequence[Box], second: Sequence[Box]) -> list[Box]:
    """The boxes of ``second`` that are no object of ``first``."""
    known = {*np.flatnonzero(_same_object(second, first).any(axis=1)).tolist()} if first and second else set()
    return [box for row, box in enumerate(second) if row not in known]


def _same_object(first: Sequence[Box], second: Sequence[Box]) -> Mask:
    """Whether boxes of two lists are the same object, (n, m) bool."""
    a, b = rectangles(first), rectangles(second)
    overlap = oriented_iou(a, b)
    smaller = np.minimum.outer(a[:, 2] * a[:, 3], b[:, 2] * b[:, 3])
    found: Mask = (overlap > MAX_OVERLAP) | (shared_area(overlap, a, b) > MAX_INSIDE * smaller)
    return found


def _vehicle_of_size(length: float, height: float) -> str:
    """Car, van or truck, by the length and the height of its points."""
    if length >= TRUCK_LENGTH_M or height >= TRUCK_HEIGHT_M:
        return "truck"
    return "van" if height >= VAN_HEIGHT_M else "car"


def _completed(
    name: str, score: float, rectangle: Floats, bottom: float, top: float, usual: tuple[float, float, float]
) -> Box:
    """The box around a rectangle of points, completed to the usual size of the class."""
    x, y, along, across, yaw = rectangle.tolist()
    if across > along:
        along, across, yaw = across, along, yaw + math.pi / 2.0
    cos, sin = math.cos(yaw), math.sin(yaw)
    may_be_end = along <= MAX_END * usual[1] < MAX_END * usual[0]
    if may_be_end and abs(x * cos + y * sin) < abs(y * cos - x * sin):
        along, across, yaw, cos, sin = across, along, yaw + math.pi / 2.0, -sin, cos
    sides = []
    for extent, typical, axis_x, axis_y in ((along, usual[0], cos, sin), (across, usual[1], -sin, cos)):
        size = max(extent, typical, MIN_SIDE_M)
        # The sensor is at 0 and saw the near end, unless it is beside the object.
        away = x * axis_x + y * axis_y
        sides.append((size, math.copysign(0.5 * (size - extent), away) if abs(away) > 0.5 * extent else 0.0))
    (length, shift), (width, slide) = sides
    x += shift * cos - slide * sin
    y += shift * sin + slide * cos
    height = max(top - bottom, usual[2], MIN_SIDE_M)
    yaw = (yaw + math.pi / 2.0) % math.pi - math.pi / 2.0
    return Box(name, score, (x, y, bottom + 0.5 * height), (length, width, height), yaw)


@njit(cache=True, nogil=True)
def fill_rectangle(cloud: Cloud, members: Ints, l_shaped: bool, rectangle: Floats, levels: Floats) -> float:
    """Write the rectangle around the points ``members`` (`rectangles.fit_rectangle`), and z of the ground below each
    into ``levels``; returns z of the highest.
    """
    points, height = cloud.points, cloud.height
    fit_rectangle(points, members, np.int64(N_ANGLES), np.int64(MAX_FITTED), l_shaped, rectangle)
    top = -math.inf
    for at in range(len(members)):
        z = np.float64(points[members[at], 2])
        top = max(top, z)
        levels[at] = z - height[members[at]]
    return top
