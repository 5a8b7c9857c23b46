"""What can be said for sure about the road of a real scan whose road nobody labelled.

KITTI's boxes say nothing about the ground. Three things are certain enough to learn from: what rises from the ground is
no road; the lane just ahead of the vehicle, as far as it is flat and free, is road; ground that reflects much more than
that lane over a metre and more is grass or gravel. Everything else stays unknown, kerbs and pavements above all: they
are learnt from simulation.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgeperc.datasets import IGNORE
from edgeperc.errors import MissingExtraError

from .augment import SURFACE

__all__ = ["DRAWN", "drawn_roads", "ground_plane", "sure_surface", "with_road"]

DRAWN = Path(__file__).with_name("kitti_roads.coco.json")
"""Roads of some training scans of KITTI, drawn over them seen from above, as ``edgeperc-export database label`` keeps
them: polygons, no scan."""

RISE_M = 0.3
LANE_HALF_WIDTH_M = 1.2
LANE_RANGE_M = (3.0, 25.0)
# Asphalt's own remission varies by 0.05 along a lane; grass lies 0.2 and more above it.
BRIGHTER = 0.15


def ground_plane(points: NDArray[np.float32], seed: int = 0) -> NDArray[np.float64] | None:
    """a, b, c of z = a x + b y + c through the ground near the vehicle (RANSAC, then least squares), or None."""
    near = (np.hypot(points[:, 0], points[:, 1]) < 20.0) & (np.abs(points[:, 1]) < 8.0) & (points[:, 2] < -1.0)
    p = points[near].astype(np.float64)
    if len(p) < 500:
        return None
    rng = np.random.default_rng(seed)
    best, most = None, 0
    tested = p[:: max(1, len(p) // 4000)]
    for _ in range(100):
        corners = p[rng.integers(len(p), size=3)]
        try:
            a, b, c = np.linalg.solve(np.c_[corners[:, :2], np.ones(3)], corners[:, 2])
        except np.linalg.LinAlgError:
            continue
        # The sensor stands 1.73 m above the road, and no street leans by more than a tenth.
        if abs(a) > 0.12 or abs(b) > 0.1 or abs(c + 1.73) > 0.35:
            continue
        support = np.abs(tested[:, 2] - a * tested[:, 0] - b * tested[:, 1] - c) < 0.08
        if np.count_nonzero(support) > most:
            most, best = int(np.count_nonzero(support)), (a, b, c)
    if best is None:
        return None
    a, b, c = best
    support = np.abs(p[:, 2] - a * p[:, 0] - b * p[:, 1] - c) < 0.08
    return np.linalg.lstsq(np.c_[p[support, :2], np.ones(support.sum())], p[support, 2], rcond=None)[0]


def sure_surface(points: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Surface truth over `SURFACE`: 1 road, 0 no road, `IGNORE` where nobody can be sure."""
    surface = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
    plane = ground_plane(points)
    if plane is None:
        return surface
    x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    height = points[:, 2] - (plane[0] * x + plane[1] * y + plane[2])
    distance = np.hypot(x, y)
    row = np.floor((SURFACE.x_range_m[1] - x) / SURFACE.cell_m).astype(np.int64)
    col = np.floor((SURFACE.y_range_m[1] - y) / SURFACE.cell_m).astype(np.int64)
    kept = (row >= 0) & (row < SURFACE.height) & (col >= 0) & (col < SURFACE.width) & (distance > 2.5) & (height < 3.0)
    cell = row * SURFACE.width + col

    low = kept & (np.abs(height) < 0.08 + 0.004 * distance)
    lane = low & (np.abs(y) < LANE_HALF_WIDTH_M) & (x > LANE_RANGE_M[0]) & (x < LANE_RANGE_M[1])
    risen = kept & (height > RISE_M + 0.01 * distance)
    ahead = risen & (np.abs(y) < LANE_HALF_WIDTH_M + 0.3) & (x > LANE_RANGE_M[0])
    if ahead.any():
        lane &= x < x[ahead].min() - 1.0
    if np.count_nonzero(lane) > 100:
        usual = float(np.median(points[lane, 3]))
        size = surface.size
        count = np.bincount(cell[low], minlength=size).reshape(surface.shape)
        total = np.bincount(cell[low], weights=points[low, 3], minlength=size).reshape(surface.shape)
        around, bright = _boxed(count), _boxed(total)
        bright = (around >= 8) & (bright > (usual + BRIGHTER) * around) & (count > 0)
        # Markings are bright too, but not over a metre; the lane itself is never doubted.
        surface[bright] = 0
        surface.reshape(-1)[cell[lane]] = 1
    surface.reshape(-1)[cell[risen]] = 0
    return surface


def drawn_roads(path: Path = DRAWN) -> dict[str, NDArray[np.uint8]]:
    """Roads drawn by hand: hash of the scan (`edgeperc.datasets.scan_hash`) -> mask (400, 200) uint8, 1 road.

    By its hash and not by its name, for names of scans differ from one copy of KITTI to the next. A COCO file keeps it
    as ``scan`` of its images.

    Raises
    ------
    DatabaseError
        No COCO file of roads.
    MissingExtraError
        Nothing that reads COCO files is installed.
    """
    try:
        from .road_polygons import mask_of, read_coco

        drawn = read_coco([path])
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "a package", "database", "a road drawn by hand") from exc
    hashes = {Path(image["file_name"]).stem: image["scan"] for image in json.loads(path.read_text())["images"]}
    return {hashes[name]: mask_of(polygons, f"{path}: {name}") for name, polygons in drawn.items()}


def with_road(surface: NDArray[np.uint8], road: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Surface truth over `SURFACE` with a drawn road's (400, 200) where that reaches."""
    from .topview_database import VIEW

    x, y = SURFACE.cell_centres()
    row = np.floor((VIEW.x_range_m[1] - x) / VIEW.cell_m).astype(np.int64)
    col = np.floor((VIEW.y_range_m[1] - y) / VIEW.cell_m).astype(np.int64)
    drawn = (row >= 0) & (row < VIEW.height) & (col >= 0) & (col < VIEW.width)
    return np.where(drawn, road[row % VIEW.height, col % VIEW.width], surface).astype(np.uint8)


def _boxed(values: NDArray, reach: int = 3) -> NDArray:
    """Sums over (2 reach + 1)^2 cells."""
    for axis in (0, 1):
        padded = np.pad(values, [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)])
        total = padded.cumsum(axis)
        n = values.shape[axis]
        values = np.take(total, range(2 * reach + 1, 2 * reach + 1 + n), axis) - np.take(total, range(n), axis)
    return values
