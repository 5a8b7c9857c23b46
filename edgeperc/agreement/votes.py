"""The votes in `edgeperc.agreement.rules`: what a cluster of points makes of their labels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..objects.cluster import MIN_OF_WHOLE, MIN_PERSON_SHARE, find_clusters
from ..objects.persons import MAX_LENGTH_M as MAX_PERSON_M
from ..objects.persons import MAX_RIDING_WIDTH_M, measure
from ..objects.persons import MAX_TOP_M as MAX_PERSON_TOP_M
from ..system.kernels import njit
from ..types.geometry import Grid, cell_at
from ..types.points import Bytes, Cloud, Floats32, Ids, Ints, Ints64, Labeled, Labels, Mask, Records

VEHICLE, PERSON = 1, 2  # roles of classes
NO_CLUSTER = -1

# Shares are of a cluster's points in the network's view. Car IoU is 80.8, 81.2, 81.6 and 81.6 for 0.4, 0.5, 0.6, 0.7.
MIN_VEHICLE_SHARE = 0.6
# Of clusters larger than vehicles; trucks with trailers are kept if nearly all of their points are labeled.
MIN_LARGE_SHARE = 0.75
MAX_LENGTH_M, MAX_TOP_M = 10.0, 4.0
MIN_VEHICLE_TOP_M, MIN_PERSON_TOP_M = 0.5, 1.0
# Nearer vehicles show enough of themselves to be higher. With 0.5 m for all, 4,140 more points of tables, kerbs and
# hedges on the folds are called car, and 298 fewer points of cars are missed. Some sports cars are lower than 1.2 m.
NEAR_M, MIN_NEAR_VEHICLE_TOP_M = 30.0, 1.0
# A low sensor that hardly looks up sees the wheels of what is near: then this share of what it sees is high enough.
MIN_VISIBLE, FAR_M = 0.7, 1000.0
# What ends nearer to the sensor and is not a person is a part of the own vehicle, such as a mirror or an open door:
# other vehicles are longer. Open doors in two KITTI scans reach to 2.5 m. What is both longer and higher than a door is
# the flank or the rear of a truck.
OWN_REACH_M = 2.6
DOOR_M, DOOR_TOP_M = 2.0, 1.7
# A cluster is completed if this share of its points is labeled, and if it is not too large for a group of persons.
MIN_FILL_SHARE = 0.6
MAX_GROUP_M, MAX_GROUP_TOP_M = 3.0, 2.1

SUPPORTING_SCORE, COMPLETING_SCORE = 0.3, 0.5  # of boxes of the top view

# A person linked with a hedge, a wall or a high pavement. The points of 43 pedestrians on the training drives are at
# least 1.41 m high and 0.26 m wide; a piece of a wall is flat. With 15 points in place of 30, two groups on the folds
# would stay that are no persons.
MIN_ALONE, MIN_ALONE_TOP_M, MIN_ALONE_WIDTH_M, MIN_ALONE_SHARE = 30, 1.4, 0.15, 0.7
ALONE_MARGIN_M = 0.1
BODY_M = 0.3  # lower points may be of grass or pavement


# A cluster; bounds are those of all of its points, in view or not.
CLUSTER = np.dtype(
    [
        ("low_x", np.float32),  # [m]
        ("low_y", np.float32),
        ("high_x", np.float32),
        ("high_y", np.float32),
        ("top", np.float32),  # greatest height above the ground [m]
        ("n_points", np.int32),
        ("n_in_both", np.int32),  # points in view of the range image and of the top view
        ("n_in_vehicles", np.int32),  # those of them in cells of vehicles
    ],
    align=True,
)


class Tallies(NamedTuple):
    """What clusters hold."""

    clusters: Records  # (k,) `CLUSTER`
    counts: Ints  # (k, classes + 1) points in view of each class; last, of all classes


class Cells(NamedTuple):
    """A top view as kernels take it."""

    labels: Labels  # (rows, columns) no cells without a top view
    is_vehicle: Mask  # (256,) which labels are vehicles that count
    grid: Grid


class Sight(NamedTuple):
    """How high a sensor sees: its height above the ground [m], and the slope of its highest beam."""

    eye_m: float
    slope: float


EVERYTHING = Sight(math.inf, 0.0)


class Applied(NamedTuple):
    """Which rules on whole clusters apply."""

    share: bool
    height: bool
    fill: bool


@njit(cache=True, nogil=True)
def fill_votes(in_view: Mask, labeled: Labeled, scores: Floats32, votes: Bytes) -> None:
    """Write what each point may count for in its cluster.

    in_view : (n,) bool
    labeled : roles are 1 for vehicles, 2 for persons, 0 for others.
    scores : (n,) float32; from `edgeperc.agreement.rules.fill_support`.
    votes : (n,) uint8, overwritten; bit 0: the point is in view. Bit 1: it may get the label of a vehicle. Bit 2: it
        has the label of a person.
    """
    labels, roles = labeled.labels, labeled.roles
    of_label = np.empty(len(roles), np.uint8)
    for c in range(len(roles)):
        of_label[c] = 3 if roles[c] == VEHICLE else 5 if roles[c] == PERSON else 1
    for i in range(in_view.shape[0]):
        votes[i] = 0
        if in_view[i]:
            votes[i] = of_label[labels[i]] | (2 if scores[i] >= COMPLETING_SCORE else 0)


@njit(cache=True, nogil=True)
def fill_tallies(cloud: Cloud, in_view: Mask, labels: Labels, cluster_of: Ids, view: Cells, tallies: Tallies) -> None:
    """Count the labels of every cluster, and measure it."""
    points, height, clusters, counts = cloud.points, cloud.height, tallies.clusters, tallies.counts
    cells, is_vehicle, grid = view.labels, view.is_vehicle, view.grid
    counts[:] = 0
    last = counts.shape[1] - 1
    for k in range(len(clusters)):
        cluster = clusters[k]
        cluster["low_x"], cluster["low_y"] = np.float32(math.inf), np.float32(math.inf)
        cluster["high_x"], cluster["high_y"] = np.float32(-math.inf), np.float32(-math.inf)
        cluster["top"] = np.float32(-math.inf)
        cluster["n_points"], cluster["n_in_both"], cluster["n_in_vehicles"] = 0, 0, 0
    for i in range(points.shape[0]):
        k = cluster_of[i]
        if k < 0:
            continue
        cluster = clusters[k]
        cluster["n_points"] += 1
        if in_view[i]:
            counts[k, labels[i]] += 1
            counts[k, last] += 1
            row, col = cell_at(grid, cells.shape, np.float64(points[i, 0]), np.float64(points[i, 1]))
            if row >= 0:
                cluster["n_in_both"] += 1
                cluster["n_in_vehicles"] += 1 if is_vehicle[cells[row, col]] else 0
        cluster["low_x"], cluster["low_y"] = min(cluster["low_x"], points[i, 0]), min(cluster["low_y"], points[i, 1])
        cluster["high_x"], cluster["high_y"] = (
            max(cluster["high_x"], points[i, 0]),
            max(cluster["high_y"], points[i, 1]),
        )
        cluster["top"] = max(cluster["top"], height[i])


@njit(cache=True, nogil=True)
def fill_verdicts(
    tallies: Tallies, refused: Mask, roles: Bytes, parts: Ints64, applied: Applied, sight: Sight, verdicts: Bytes
) -> None:
    """Decide what becomes of each label in each cluster; ``refused`` clusters are not vehicles for another reason.

    parts : (p, 2) class, and the class that it may be a part of.
    """
    clusters, counts = tallies.clusters, tallies.counts
    n_classes = len(roles)
    for k in range(len(clusters)):
        seen = max(counts[k, n_classes], 1)
        n_of_role = np.zeros(3, np.int64)
        most = np.zeros(3, np.int64)  # the most frequent class of each role, the first one on ties
        for c in range(n_classes):
            role = roles[c]
            n_of_role[role] += counts[k, c]
            if role > 0 and (most[role] == 0 or counts[k, c] > counts[k, most[role]]):
                most[role] = c
        vehicle_share, person_share = n_of_role[VEHICLE] / seen, n_of_role[PERSON] / seen
        low_x, low_y = np.float64(clusters[k]["low_x"]), np.float64(clusters[k]["low_y"])
        high_x, high_y = np.float64(clusters[k]["high_x"]), np.float64(clusters[k]["high_y"])
        length, top = math.hypot(high_x - low_x, high_y - low_y), clusters[k]["top"]
        is_large = length > MAX_LENGTH_M or top > MAX_TOP_M
        no_vehicle = refused[k]
        no_vehicle |= applied.share and vehicle_share < (MIN_LARGE_SHARE if is_large else MIN_VEHICLE_SHARE)
        no_person = applied.share and person_share < MIN_PERSON_SHARE
        if applied.height:
            away = math.hypot(max(low_x, -high_x, 0.0), max(low_y, -high_y, 0.0))
            reach = math.hypot(max(abs(low_x), abs(high_x)), max(abs(low_y), abs(high_y)))
            visible = MIN_VISIBLE * (sight.eye_m + sight.slope * min(away, FAR_M))
            no_vehicle |= top < min(MIN_NEAR_VEHICLE_TOP_M if away < NEAR_M else MIN_VEHICLE_TOP_M, visible)
            is_door = length < DOOR_M or top < DOOR_TOP_M
            no_vehicle |= reach < OWN_REACH_M and is_door and person_share < MIN_PERSON_SHARE
            no_person |= top < min(MIN_PERSON_TOP_M, visible)
        for c in range(n_classes):
            is_lost = (roles[c] == VEHICLE and no_vehicle) or (roles[c] == PERSON and no_person)
            verdicts[k, c] = 0 if is_lost else c
        if applied.fill and most[VEHICLE] > 0 and not no_vehicle and vehicle_share >= MIN_FILL_SHARE and not is_large:
            for c in range(n_classes):
                if c == 0 or roles[c] > 0:
                    verdicts[k, c] = most[VEHICLE]
        is_group = person_share >= MIN_FILL_SHARE and length < MAX_GROUP_M and top < MAX_GROUP_TOP_M
        if applied.fill and most[PERSON] > 0 and not no_person and is_group:
            for at in range(parts.shape[0]):
                part, whole = parts[at]
                if counts[k, whole] >= MIN_OF_WHOLE * (counts[k, part] + counts[k, whole]):
                    most[PERSON] = whole
            for c in range(n_classes):
                if c == 0 or roles[c] == PERSON:
                    verdicts[k, c] = most[PERSON]


@njit(cache=True, nogil=True)
def apply_verdicts(
    in_view: Mask, clusters: Ids, verdicts: Bytes, roles: Bytes, scores: Floats32, names: Bytes, labels: Labels
) -> None:
    """Replace each label in view by what its cluster and the box around it say.

    clusters : -1 for none; -2 for a cluster in which no label of a vehicle or person stays.
    scores, names : from `edgeperc.agreement.rules.fill_support`.
    """
    for i in range(labels.shape[0]):
        if not in_view[i]:
            continue
        old, k = labels[i], clusters[i]
        new = old
        if k != NO_CLUSTER:
            new = verdicts[k, old] if k >= 0 else (0 if roles[old] > 0 else old)
            if roles[old] == VEHICLE and roles[new] == 0 and scores[i] >= SUPPORTING_SCORE:
                new = old
        if scores[i] >= COMPLETING_SCORE and (new == 0 or roles[new] == VEHICLE):
            new = names[i]
        labels[i] = new


def may_be_persons(tallies: Tallies, walks: int, rides: int) -> Mask:
    """The clusters that hold labels of persons and whose bounds are not too large for one, (k,)."""
    clusters, counts = tallies
    edge = np.maximum(clusters["high_x"] - clusters["low_x"], clusters["high_y"] - clusters["low_y"])
    # In float64: numpy would round the limits to float32.
    is_small = (edge.astype(np.float64) <= 2.0 * MAX_PERSON_M) & (
        clusters["top"].astype(np.float64) <= MAX_PERSON_TOP_M
    )
    return np.asarray(is_small & (counts[:, walks] + counts[:, rides] > 0), np.bool_)


def find_persons_alone(cloud: Cloud, roles: Bytes, before: Bytes, labels: Labels) -> list[Ints]:
    """Rows of each group of points that lost its labels but is a person by itself, linked with something large."""
    points, height = cloud
    changed = np.flatnonzero(before != labels)
    lost = changed[(roles[before[changed]] == PERSON) & (labels[changed] == 0)].astype(np.int32)
    if len(lost) < MIN_ALONE:
        return []
    alone = []
    groups = find_clusters(points[lost], min_points=MIN_ALONE)
    for k in range(int(groups.max()) + 1):
        own = lost[groups == k]
        cos, sin, u_low, u_high, v_low, v_high, top = measure(cloud, own, BODY_M)
        if (
            u_high - u_low > MAX_PERSON_M
            or not MIN_ALONE_WIDTH_M <= v_high - v_low <= MAX_RIDING_WIDTH_M
            or not MIN_ALONE_TOP_M <= top <= MAX_PERSON_TOP_M
        ):
            continue
        with np.errstate(over="ignore", invalid="ignore"):  # other points may be far out
            u, v = points[:, 0] * cos + points[:, 1] * sin, points[:, 1] * cos - points[:, 0] * sin
        is_body = (height > BODY_M) & (height <= MAX_PERSON_TOP_M)
        here = is_body & (u >= u_low - ALONE_MARGIN_M) & (u <= u_high + ALONE_MARGIN_M)
        here &= (v >= v_low - ALONE_MARGIN_M) & (v <= v_high + ALONE_MARGIN_M)
        if np.count_nonzero(is_body[own]) >= MIN_ALONE_SHARE * np.count_nonzero(here):
            alone.append(own)
    return alone
