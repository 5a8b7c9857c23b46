"""The road on all sides by points: the nearest return of the ground along the azimuth of a cell decides."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from edgeperc.road.around import ON_GROUND_M, RING_M, SECTOR_DEG, knows_road, nearest_is_road
from edgeperc.types.perception import PointLabels
from edgeperc.types.views import TopViewGeometry

CLASSES = ("background", "car", "road", "sidewalk", "terrain")
VIEW = TopViewGeometry((-12.0, 12.0), (-8.0, 8.0), cell_m=0.8)


def slow(points: NDArray[np.float32], labels: PointLabels, height_m: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The same, cell by cell, (2, rows, columns)."""
    votes: dict[tuple[int, int], int] = {}
    told = {place_of(*point[:2])[0] for point in points[labels.in_view].tolist()}
    for (x, y), label, seen, height in zip(
        points[:, :2].tolist(), labels.labels, labels.in_view, height_m, strict=True
    ):
        name = CLASSES[label]
        if seen and abs(height) <= ON_GROUND_M and name in ("road", "sidewalk", "terrain"):
            place = place_of(x, y)
            votes[place] = votes.get(place, 0) + (1 if name == "road" else -1)
    xs, ys = VIEW.cell_centers()
    found = np.zeros((2, VIEW.height, VIEW.width), np.bool_)
    for r, x in enumerate(xs.ravel().tolist()):
        for c, y in enumerate(ys.ravel().tolist()):
            sector, ring = place_of(x, y)
            rings = sorted((abs(other - ring), other) for s, other in votes if s == sector)
            found[:, r, c] = bool(rings) and votes[sector, rings[0][1]] > 0, sector in told
    return found


def place_of(x: float, y: float) -> tuple[int, int]:
    return math.floor(math.degrees(math.atan2(y, x)) / SECTOR_DEG) % round(360 / SECTOR_DEG), int(
        math.hypot(x, y) / RING_M
    )


def scan_of(n: int, seed: int) -> tuple[NDArray[np.float32], PointLabels, NDArray[np.float32]]:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-11.9, 11.9, n), rng.uniform(-7.9, 7.9, n), np.zeros((n, 2))]).astype(
        np.float32
    )
    labels = PointLabels(rng.integers(0, len(CLASSES), n).astype(np.uint8), rng.random(n) < 0.8, CLASSES)
    return points, labels, rng.normal(0.0, 0.25, n).astype(np.float32)


def test_every_cell_is_that_of_a_slow_search() -> None:
    for n, seed in ((0, 0), (1, 1), (40, 2), (3000, 3)):
        points, labels, height_m = scan_of(n, seed)
        np.testing.assert_array_equal(
            nearest_is_road(points, labels, height_m, VIEW), slow(points, labels, height_m), f"{n} points"
        )


def test_the_curb_ends_the_road() -> None:
    azimuth, range_m = np.meshgrid(np.arange(0.0, 2.0 * math.pi, math.radians(0.2)), np.arange(0.2, 14.0, 0.3))
    x, y = range_m * np.cos(azimuth), range_m * np.sin(azimuth)
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros((x.size, 2))]).astype(np.float32)
    names = np.where(np.abs(y.ravel()) < 4.0, CLASSES.index("road"), CLASSES.index("sidewalk")).astype(np.uint8)
    labels = PointLabels(names, np.ones(x.size, np.bool_), CLASSES)
    found, _ = nearest_is_road(points, labels, np.zeros(x.size, np.float32), VIEW)
    beside = np.abs(np.broadcast_to(VIEW.cell_centers()[1], found.shape))
    assert found[beside < 3.5].all()
    assert not found[(beside > 4.5) & (beside < 7.0)].any()


def test_labels_above_the_ground_and_out_of_view_do_not_count() -> None:
    points = np.array([[5.2, 0.4, 0.0, 0.0], [6.0, 0.4, 0.0, 0.0]], np.float32)
    labels = PointLabels(np.full(2, CLASSES.index("road"), np.uint8), np.array([True, False]), CLASSES)
    assert np.any(nearest_is_road(points, labels, np.zeros(2, np.float32), VIEW)[0])
    assert not np.any(nearest_is_road(points, labels, np.array([1.0, 0.0], np.float32), VIEW)[0])


def test_only_labels_with_a_road_know_it() -> None:
    _, labels, _ = scan_of(3, 0)
    assert knows_road(labels)
    assert not knows_road(labels.objects())
    assert not knows_road(None)
