"""Augmentation of labeled scans: pasted objects, swapped sectors, bad weather, turns, errors of the mounting. Labels
stay correct."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, pairwise

import numpy as np

from edgeperc.datasets.layout import class_number
from edgeperc.ground.planes import find_ground
from edgeperc.objects.cluster import find_clusters
from edgeperc.preprocess.remission import NO_REMISSION
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import POINT_CLASSES
from edgeperc.types.geometry import inside
from edgeperc.types.mounting import MODEL_HEIGHT_M
from edgeperc.types.perception import Box
from edgeperc.types.points import Floats32, Ints64, Points
from edgeperc.types.sensor import SensorProfile

from .beams import taken_by
from .processes import mapped
from .scans import LabeledScan, mirrored, turned, turned_box, turned_points

RARE = ("pedestrian", "cyclist")
PASTE_AZIMUTHS = (-0.65, 0.65)
FEWEST_PASTED = 5

NEGATIVES: Mapping[str, float] = {"pole": 0.6, "wall": 0.4}
"""Pieces of background to paste, and how often: what is most often taken for a person or for a vehicle."""
NEGATIVE_RANGES_M = (4.0, 45.0)
WALL_PIECE_M = 1.5  # a piece of a wall, a hedge or a bank reaches this far to both sides

# Most persons of a bank are near. A pasted one moves away by up to this factor, but not beyond this range.
MAX_STRETCH = 1.6
MAX_PERSON_RANGE_M = 45.0
MAX_TILT_SIGMAS = 2.0

# |y| < slope * x + margin: 55 degrees to both sides. Range images reach 45 degrees, top views 10 m at 6 m ahead.
AHEAD_SLOPE, AHEAD_MARGIN_M = 1.43, 2.0


@dataclass(frozen=True)
class ObjectBank:
    """Objects cut out of labeled scans, to paste into others (ground-truth sampling of SECOND; Yan et al., 2018)."""

    objects: dict[str, list[tuple[Box, Floats32]]]  # label -> boxes and the points in them
    classes: tuple[str, ...] = POINT_CLASSES  # classes of points that pasted objects get, the background first

    @classmethod
    def of(
        cls, scans: Iterable[LabeledScan], fewest: int = 8, classes: tuple[str, ...] = POINT_CLASSES, n_workers: int = 0
    ) -> ObjectBank:
        """The objects of the scans within 60 m that have at least ``fewest`` returns, and pieces of the background.

        ``n_workers`` processes look for them; 0: this one. The bank is the same.
        """
        objects: dict[str, list[tuple[Box, Floats32]]] = {}
        with mapped(partial(_cut_out, fewest=fewest, classes=classes), scans, n_workers) as found:
            for name, piece in chain.from_iterable(found):
                objects.setdefault(name, []).append(piece)
        return cls(objects, classes)


def _cut_out(scan: LabeledScan, *, fewest: int, classes: tuple[str, ...]) -> list[tuple[str, tuple[Box, Floats32]]]:
    """The objects of one scan and pieces of its background, each with its kind."""
    found = []
    for box, count in zip(scan.boxes, scan.counts, strict=True):
        name = "pedestrian" if box.label == "person_sitting" else box.label
        known = class_number(name, classes) not in (0, IGNORE)
        if not known or count < fewest or np.hypot(*box.center[:2]) > 60.0:
            continue
        points = scan.points[inside(box, scan.points)]
        if len(points) >= fewest:
            found.append((name, (box, points)))
    return found + [(box.label, (box, points)) for box, points in background_pieces(scan, fewest)]


def background_pieces(scan: LabeledScan, fewest: int = 8) -> Iterator[tuple[Box, Floats32]]:
    """Poles, trunks and signs, and pieces of walls, hedges and banks of at least ``fewest`` points, cut out of what is
    known to be background; each with a box on the ground, a ``"pole"`` or a ``"wall"``.

    A pole is a cluster at most 0.9 m wide, between 0.4 and 1.8 m above the ground, that goes on above 2 m. A wall is a
    cluster longer than 4 m; each gives the piece around its nearest point and the one around its middle.
    """
    points = scan.points
    if not len(points):
        return
    height = find_ground(points, mount_height_m=MODEL_HEIGHT_M).height_m
    flat = np.hypot(points[:, 0], points[:, 1])
    above = (height > 0.1) & (height < 4.0)
    body = (scan.labels == 0) & (height > 0.4) & (height < 1.8)
    body &= (flat > NEGATIVE_RANGES_M[0]) & (flat < NEGATIVE_RANGES_M[1])
    clusters = find_clusters(points, among=body, min_distance_m=0.4, min_points=fewest)
    # Of each cluster, and of what is near along x, not of the whole scan: 30 in place of 110 ms a scan.
    members = np.argsort(clusters, kind="stable")
    first = np.searchsorted(clusters[members], np.arange(clusters.max(initial=-1) + 2))
    upright = np.flatnonzero(above)
    upright = upright[np.argsort(points[upright, 0], kind="stable")]
    along = points[upright, 0]
    for start, end in pairwise(first):
        own = points[members[start:end]]
        low, high = own[:, :2].min(0), own[:, :2].max(0)
        extent = float((high - low).max())
        if extent <= 0.9:
            label, places, reach = "pole", [(low + high) / 2.0], extent / 2.0 + 0.3
        elif extent >= 4.0:
            middle = own[np.argsort(own[:, 0] + own[:, 1], kind="stable")[len(own) // 2], :2]
            nearest = own[np.argmin(np.hypot(own[:, 0], own[:, 1])), :2]
            label, places, reach = "wall", [nearest, middle], WALL_PIECE_M
        else:
            continue
        for x, y in np.asarray(places, np.float64).tolist():
            near = np.sort(upright[slice(*np.searchsorted(along, (x - 1.001 * reach, x + 1.001 * reach)))])
            near = near[np.hypot(points[near, 0] - x, points[near, 1] - y) < reach]
            cut, heights = points[near], height[near]
            pure = len(cut) >= fewest and not scan.labels[near].any()
            if not pure or (label == "pole" and np.count_nonzero(heights > 2.0) < 3):
                continue
            foot = float(np.median(cut[:, 2] - heights))
            size = (2.0 * reach, 2.0 * reach, float(heights.max()))
            yield Box(label, 1.0, (x, y, foot + size[2] / 2.0), size, 0.0), cut


def pasted(
    scan: LabeledScan, bank: ObjectBank, rng: np.random.Generator, n: int, odds: Mapping[str, float]
) -> LabeledScan:
    """The scan with up to ``n`` objects of the bank added, of kinds drawn by ``odds``.

    An object keeps its distance, and so its density of returns, and moves to a random azimuth ahead. It is placed on
    the ground there if the place is free. Ray by ray, only the nearer return remains: the scan's or the object's.
    Persons are `resized`. Pieces of background (`NEGATIVES`) are labeled background and add no box.
    """
    names = [name for name in odds if bank.objects.get(name)]
    if not names or n == 0:
        return scan
    shares = np.array([odds[name] for name in names])
    points, labels = scan.points, scan.labels
    flat = np.hypot(points[:, 0], points[:, 1])
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    kept = np.ones(len(points), bool)
    boxes, counts, new_points, new_labels = list(scan.boxes), list(scan.counts), [], []
    for name in rng.choice(names, size=n, p=shares / shares.sum()):
        box, cut = bank.objects[name][rng.integers(len(bank.objects[name]))]
        if name in RARE:
            box, cut = resized(box, cut, rng)
        angle = rng.uniform(*PASTE_AZIMUTHS) - np.arctan2(box.center[1], box.center[0])
        box = turned_box(box, angle)
        reach = np.hypot(*box.size[:2]) / 2.0 + 0.5
        distance = np.hypot(*box.center[:2])
        middle = np.arctan2(box.center[1], box.center[0])
        window = np.nonzero(np.abs(azimuth - middle) < np.arctan2(reach, max(distance - reach, 1.0)))[0]
        window = window[kept[window]]
        around = window[np.abs(flat[window] - distance) < reach]
        foot = box.center[2] - box.size[2] / 2.0
        near = points[around]
        low = near[np.abs(near[:, 2] - foot) < 0.6]
        if len(low) < 6:
            continue
        ground = float(np.percentile(low[:, 2], 15))
        box = replace(box, center=(box.center[0], box.center[1], ground + box.size[2] / 2.0))
        standing = inside(box, near, 0.1) & (near[:, 2] > ground + 0.25)
        if np.count_nonzero(standing) > 2 or any(_close(box, other) for other in boxes):
            continue
        here = turned_points(cut, angle)
        here[:, 2] += np.float32(ground - foot)

        own, own_range = _rays(here)
        other, other_range = _rays(points[window])
        rays = np.unique(own)
        nearest = np.full(len(rays), np.inf)
        np.minimum.at(nearest, np.searchsorted(rays, own), own_range)
        at = np.minimum(np.searchsorted(rays, other), len(rays) - 1)
        met = rays[at] == other
        blocking = np.full(len(rays), np.inf)
        np.minimum.at(blocking, at[met], other_range[met])
        visible = own_range < blocking[np.searchsorted(rays, own)] + 0.3
        if np.count_nonzero(visible) < FEWEST_PASTED:
            continue
        kept[window[met & (other_range > nearest[at])]] = False
        new_points.append(here[visible])
        number = 0 if box.label in NEGATIVES else class_number(box.label, bank.classes)
        new_labels.append(np.full(np.count_nonzero(visible), number, np.uint8))
        boxes.append(box)
        counts.append(int(np.count_nonzero(visible)))
    if not new_points:
        return scan
    objects = [k for k, box in enumerate(boxes) if box.label not in NEGATIVES]
    return replace(
        scan,
        points=np.concatenate([points[kept], *new_points]),
        labels=np.concatenate([labels[kept], *new_labels]),
        boxes=tuple(boxes[k] for k in objects),
        counts=tuple(counts[k] for k in objects),
    )


def resized(box: Box, points: Points, rng: np.random.Generator) -> tuple[Box, Floats32]:
    """An object 15 % smaller or larger and farther away by up to `MAX_STRETCH`, with one return in each ray."""
    x, y, z = box.center
    farthest = max(1.0, MAX_PERSON_RANGE_M / max(np.hypot(x, y), 1.0))
    scale, stretch = rng.uniform(0.87, 1.15), min(rng.uniform(1.0, MAX_STRETCH), farthest)
    length, width, height = box.size
    foot = z - height / 2.0
    moved = points.copy()
    moved[:, 0] = (points[:, 0] - x) * scale + x * stretch
    moved[:, 1] = (points[:, 1] - y) * scale + y * stretch
    moved[:, 2] = (points[:, 2] - foot) * scale + foot
    size = (length * scale, width * scale, height * scale)
    box = replace(box, center=(x * stretch, y * stretch, foot + size[2] / 2.0), size=size)
    rays, distance = _rays(moved)
    nearest = np.lexsort((distance, rays))
    return box, moved[nearest[np.unique(rays[nearest], return_index=True)[1]]]


def _close(box: Box, other: Box) -> bool:
    """Whether two boxes are so close that they may overlap."""
    apart = np.hypot(box.center[0] - other.center[0], box.center[1] - other.center[1])
    return bool(apart < 0.45 * (np.hypot(*box.size[:2]) + np.hypot(*other.size[:2])))


def _rays(points: Points) -> tuple[Ints64, Floats32]:
    """The ray number of each point, and its range [m]."""
    # The beams of an HDL-64E are 0.4 degrees apart, its columns 0.17.
    flat = np.hypot(points[:, 0], points[:, 1])
    row = np.floor(np.degrees(np.arctan2(points[:, 2], flat)) / 0.42).astype(np.int64)
    column = np.floor(np.degrees(np.arctan2(points[:, 1], points[:, 0])) / 0.18).astype(np.int64)
    return (row + 500) * 10_000 + column + 5_000, np.hypot(flat, points[:, 2])


def swapped(scan: LabeledScan, other: LabeledScan, rng: np.random.Generator) -> LabeledScan:
    """The scan with one sector replaced by another scan's (PolarMix; Xiao et al., 2022): points and their labels only.

    Boxes and surface do not change, so this suits only networks that label points.
    """
    low = rng.uniform(-np.pi / 4.0, np.pi / 8.0)
    high = low + rng.uniform(np.pi / 8.0, np.pi / 4.0)
    parts = []
    for each, wanted in ((scan, False), (other, True)):
        azimuth = np.arctan2(each.points[:, 1], each.points[:, 0])
        chosen = ((azimuth >= low) & (azimuth < high)) == wanted
        parts.append((each.points[chosen], each.labels[chosen]))
    points, labels = (np.concatenate(part) for part in zip(*parts, strict=True))
    return replace(scan, points=points, labels=labels)


def weathered(scan: LabeledScan, rng: np.random.Generator) -> LabeledScan:
    """The scan in rain, snow or fog: far returns are lost more often, and a few returns come from drops in the air."""
    points, labels = scan.points, scan.labels
    distance = np.linalg.norm(points[:, :3], axis=1)
    kept = rng.random(len(points)) < np.exp(-rng.uniform(0.0, 0.02) * distance)
    points, labels = points[kept].copy(), labels[kept].copy()
    drops = np.nonzero(rng.random(len(points)) < rng.uniform(0.0, 0.01))[0]
    share = np.minimum(rng.gamma(2.0, 3.0, len(drops)) / np.maximum(distance[kept][drops], 1.0), 1.0)
    points[drops, :3] *= share.astype(np.float32)[:, None]
    points[drops, 3] *= 0.3
    labels[drops] = np.where(labels[drops] == IGNORE, IGNORE, 0)
    return replace(scan, points=points, labels=labels)


def noisy(scan: LabeledScan, rng: np.random.Generator, most_m: float) -> LabeledScan:
    """The scan by a sensor whose ranges have a standard deviation of up to ``most_m`` more."""
    noise_m = rng.normal(0.0, rng.uniform(0.0, most_m), len(scan.points))
    stretch = 1.0 + noise_m / np.maximum(np.linalg.norm(scan.points[:, :3], axis=1), 1.0)
    points = scan.points.copy()
    points[:, :3] *= stretch.astype(np.float32)[:, None]
    return replace(scan, points=points)


def with_ground_ahead(scan: LabeledScan) -> LabeledScan:
    """The scan with the unlabeled ground at the own bumper as background.

    KITTI's camera does not see the ground within 6 m, so it has no labels there, and networks took it for a car.
    """
    points = scan.points
    near = (points[:, 0] > 0.0) & (points[:, 0] < 6.0) & (np.abs(points[:, 1]) < 3.0) & (scan.labels == IGNORE)
    near &= (points[:, 2] < -MODEL_HEIGHT_M + 0.25) & (points[:, 2] > -MODEL_HEIGHT_M - 0.5)
    for box in scan.boxes:
        near &= ~inside(box, points, 0.3)
    return replace(scan, labels=np.where(near, np.uint8(0), scan.labels)) if near.any() else scan


def tilted(scan: LabeledScan, roll: float, pitch: float, lift: float) -> LabeledScan:
    """The scan as it is levelled with an error: rolled and pitched [rad], and lifted [m]. Boxes stay upright."""
    turn = np.array([[1.0, roll * pitch, pitch], [0.0, 1.0, -roll], [-pitch, roll, 1.0]])  # small: exact to 1e-4
    points = scan.points.copy()
    points[:, :3] = scan.points[:, :3] @ turn.T.astype(np.float32)
    points[:, 2] += np.float32(lift)
    centers = [(turn @ np.array(box.center) + (0.0, 0.0, lift)).tolist() for box in scan.boxes]
    boxes = tuple(replace(box, center=(x, y, z)) for box, (x, y, z) in zip(scan.boxes, centers, strict=True))
    return replace(scan, points=points, boxes=boxes)


def facing(scan: LabeledScan, rng: np.random.Generator) -> float:
    """The angle [rad] that turns a pedestrian or cyclist to the front; 0 if there is none within 40 m."""
    rare = [b for b, n in zip(scan.boxes, scan.counts, strict=True) if b.label in RARE and n >= FEWEST_PASTED]
    rare = [b for b in rare if np.hypot(*b.center[:2]) < 40.0]
    if not rare:
        return 0.0
    box = rare[rng.integers(len(rare))]
    return float(rng.uniform(-0.6, 0.6) - np.arctan2(box.center[1], box.center[0]))


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How scans are changed at random."""

    n_pasted: float = 0.0  # mean number of objects to paste
    odds: Mapping[str, float] | None = None  # how often each kind is pasted; None: equally often
    turn_to_rare: float = 0.0  # share of the scans labeled on all sides that are turned to a pedestrian or cyclist
    turn_anywhere: float = 0.0  # share of the remaining ones that are turned by any angle
    weather: float = 0.0  # share of scans in bad weather
    n_negatives: float = 0.0  # mean number of pieces of background to paste
    negatives: Mapping[str, float] = field(default_factory=lambda: NEGATIVES)  # how often each kind is pasted
    # standard deviation of the errors of roll and pitch [deg]; the errors are at most twice as large
    tilt_deg: float = 0.0
    no_remission: float = 0.0  # share of scans whose remission is the constant that stands for a missing one
    range_noise_m: float = 0.0  # half of the scans get noise along the rays, of a standard deviation up to this
    sparse: bool = False  # scans of any dense sensor are thinned, not those of the training sensor alone


def augmented(
    scan: LabeledScan,
    rng: np.random.Generator,
    how: Augmentation = Augmentation(),  # it is immutable
    bank: ObjectBank | None = None,
    sensor: SensorProfile | None = None,
) -> LabeledScan:
    """The scan turned, mirrored, thinned, shifted in height and scaled in remission, all at random.

    A scan that is labeled on all sides (simulation) faces forwards or backwards along the street. Other scans are
    turned by a few degrees only. ``sensor`` takes a scan of a denser one (`beams.taken_by`).
    """
    full = scan.azimuths[1] - scan.azimuths[0] >= 2.0 * np.pi
    angle = rng.normal(0.0, np.radians(5.0))
    if full and rng.random() < how.turn_to_rare:
        angle = facing(scan, rng)
    elif full and how.turn_anywhere > 0.0 and rng.random() < how.turn_anywhere:
        angle = rng.uniform(-np.pi, np.pi)
    elif full and rng.random() < 0.5:
        angle += np.pi
    scan = turned(scan, float(angle))
    if rng.random() < 0.5:
        scan = mirrored(scan)
    # Points outside this sector are in neither view and would only cost time.
    x, y = scan.points[:, 0], scan.points[:, 1]
    ahead = np.abs(y) < AHEAD_SLOPE * x + AHEAD_MARGIN_M
    scan = replace(scan, points=scan.points[ahead], labels=scan.labels[ahead])
    if bank is not None and how.n_pasted + how.n_negatives > 0.0:
        kinds = how.odds or {name: 1.0 for name in bank.objects if name not in NEGATIVES}
        shares: dict[str, float] = {}
        for n, group in ((how.n_pasted, kinds), (how.n_negatives, how.negatives)):
            total = sum(group.values())
            shares |= {name: n * share / total for name, share in group.items()}
        scan = pasted(scan, bank, rng, int(rng.poisson(how.n_pasted + how.n_negatives)), shares)
    if rng.random() < how.weather:
        scan = weathered(scan, rng)
    if sensor is not None:
        scan = taken_by(sensor, scan, rng, of_any=how.sparse)
    if how.range_noise_m > 0.0 and rng.random() < 0.5:
        scan = noisy(scan, rng, how.range_noise_m)
    points, labels = scan.points, scan.labels
    if rng.random() < 0.3:
        kept = rng.random(len(points)) < rng.uniform(0.75, 1.0)
        points, labels = points[kept], labels[kept]
    roll, pitch = np.radians(how.tilt_deg) * np.clip(rng.normal(size=2), -MAX_TILT_SIGMAS, MAX_TILT_SIGMAS)
    scan = tilted(replace(scan, points=points, labels=labels), roll, pitch, float(rng.normal(0.0, 0.04)))
    gain, offset = np.exp(rng.normal(0.0, 0.15)), rng.normal(0.0, 0.02)
    scan.points[:, 3] = np.clip(scan.points[:, 3] * np.float32(gain) + np.float32(offset), 0.0, 1.0)
    if rng.random() < how.no_remission:
        scan.points[:, 3] = NO_REMISSION.coefficients[0]
    return scan
