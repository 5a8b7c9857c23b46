"""Augmentation of labeled scans: pasted objects, swapped sectors, bad weather, turns. Labels stay correct."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edgeperc.geometry import inside
from edgeperc.perception import Box
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import POINT_CLASS_OF

from .scans import LabeledScan, mirrored, turned, turned_box

__all__ = ["ObjectBank", "augmented", "facing", "pasted", "swapped", "weathered"]

RARE = ("pedestrian", "cyclist")
PASTE_AZIMUTHS = (-0.65, 0.65)
FEWEST_PASTED = 5


@dataclass(frozen=True)
class ObjectBank:
    """Objects cut out of labeled scans, to paste into others (ground-truth sampling of SECOND; Yan et al., 2018).

    Attributes
    ----------
    objects : dict of str to list of (Box, (n, 4) float32)
        Label -> boxes and the points in them.
    """

    objects: dict[str, list[tuple[Box, NDArray[np.float32]]]]

    @classmethod
    def of(cls, scans: Iterable[LabeledScan], fewest: int = 8) -> ObjectBank:
        """The objects of the scans within 60 m that have at least ``fewest`` returns."""
        objects: dict[str, list[tuple[Box, NDArray[np.float32]]]] = {}
        for scan in scans:
            for box, count in zip(scan.boxes, scan.counts, strict=True):
                name = "pedestrian" if box.label == "person_sitting" else box.label
                if name not in POINT_CLASS_OF or count < fewest or np.hypot(*box.center[:2]) > 60.0:
                    continue
                points = scan.points[inside(box, scan.points)]
                if len(points) >= fewest:
                    objects.setdefault(name, []).append((box, points))
        return cls(objects)


def pasted(
    scan: LabeledScan, bank: ObjectBank, rng: np.random.Generator, n: int, odds: Mapping[str, float]
) -> LabeledScan:
    """The scan with up to ``n`` objects of the bank added, of kinds drawn by ``odds``.

    An object keeps its distance, and so its density of returns, and moves to a random azimuth ahead. It is placed on
    the ground there if the place is free. Ray by ray, only the nearer return remains: the scan's or the object's.
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
        cos, sin = np.float32(np.cos(angle)), np.float32(np.sin(angle))
        here = cut.copy()
        here[:, 0], here[:, 1] = cos * cut[:, 0] - sin * cut[:, 1], sin * cut[:, 0] + cos * cut[:, 1]
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
        new_labels.append(np.full(np.count_nonzero(visible), POINT_CLASS_OF[box.label], np.uint8))
        boxes.append(box)
        counts.append(int(np.count_nonzero(visible)))
    if not new_points:
        return scan
    return replace(
        scan,
        points=np.concatenate([points[kept], *new_points]),
        labels=np.concatenate([labels[kept], *new_labels]),
        boxes=tuple(boxes),
        counts=tuple(counts),
    )


def _close(box: Box, other: Box) -> bool:
    """Whether two boxes are so close that they may overlap."""
    apart = np.hypot(box.center[0] - other.center[0], box.center[1] - other.center[1])
    return bool(apart < 0.45 * (np.hypot(*box.size[:2]) + np.hypot(*other.size[:2])))


def _rays(points: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
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


def facing(scan: LabeledScan, rng: np.random.Generator) -> float:
    """The angle [rad] that turns a pedestrian or cyclist to the front; 0 if there is none within 40 m."""
    rare = [b for b, n in zip(scan.boxes, scan.counts, strict=True) if b.label in RARE and n >= FEWEST_PASTED]
    rare = [b for b in rare if np.hypot(*b.center[:2]) < 40.0]
    if not rare:
        return 0.0
    box = rare[rng.integers(len(rare))]
    return float(rng.uniform(-0.6, 0.6) - np.arctan2(box.center[1], box.center[0]))


def augmented(
    scan: LabeledScan,
    rng: np.random.Generator,
    *,
    bank: ObjectBank | None = None,
    n_pasted: float = 0.0,
    odds: Mapping[str, float] | None = None,
    turn_to_rare: float = 0.0,
    turn_anywhere: float = 0.0,
    weather: float = 0.0,
) -> LabeledScan:
    """The scan turned, mirrored, thinned, shifted in height and scaled in remission, all at random.

    A scan that is labeled on all sides (simulation) faces forwards or backwards along the street. Other scans are
    turned by a few degrees only.

    Parameters
    ----------
    scan : LabeledScan
    rng : np.random.Generator
    bank : ObjectBank, optional
    n_pasted : float
        Mean number of objects to paste.
    odds : mapping of str to float, optional
        How often each kind is pasted; by default equally often.
    turn_to_rare : float
        Share of the scans labeled on all sides that are turned to a pedestrian or cyclist instead.
    turn_anywhere : float
        Share of the remaining ones that are turned by any angle.
    weather : float
        Share of scans in bad weather.
    """
    full = scan.azimuths[1] - scan.azimuths[0] >= 2.0 * np.pi
    angle = rng.normal(0.0, np.radians(5.0))
    if full and rng.random() < turn_to_rare:
        angle = facing(scan, rng)
    elif full and turn_anywhere > 0.0 and rng.random() < turn_anywhere:
        angle = rng.uniform(-np.pi, np.pi)
    elif full and rng.random() < 0.5:
        angle += np.pi
    scan = turned(scan, float(angle))
    if rng.random() < 0.5:
        scan = mirrored(scan)
    # Points behind the sensor are in neither view and would only cost time.
    ahead = scan.points[:, 0] > 0.0
    scan = replace(scan, points=scan.points[ahead], labels=scan.labels[ahead])
    if bank is not None and n_pasted > 0.0:
        scan = pasted(scan, bank, rng, int(rng.poisson(n_pasted)), odds or dict.fromkeys(bank.objects, 1.0))
    if rng.random() < weather:
        scan = weathered(scan, rng)
    points, labels = scan.points, scan.labels
    if rng.random() < 0.3:
        kept = rng.random(len(points)) < rng.uniform(0.75, 1.0)
        points, labels = points[kept], labels[kept]
    points = points.copy()
    lift = np.float32(rng.normal(0.0, 0.04))
    points[:, 2] += lift
    gain = np.exp(rng.normal(0.0, 0.15))
    points[:, 3] = np.clip(points[:, 3] * np.float32(gain) + np.float32(rng.normal(0.0, 0.02)), 0.0, 1.0)
    boxes = tuple(replace(b, center=(b.center[0], b.center[1], b.center[2] + float(lift))) for b in scan.boxes)
    return replace(scan, points=points, labels=labels, boxes=boxes)
