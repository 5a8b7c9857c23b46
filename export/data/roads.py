"""Ground truth of the drivable area: cells that a scan makes certain, and hand-drawn roads (COCO files)."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc.errors import EdgepercError, MissingExtraError
from edgeperc.simulation.samples import IGNORE
from edgeperc.types.choices import VEHICLES
from edgeperc.types.points import Bytes, Floats, Points
from edgeperc.types.views import TopViewGeometry

from .scans import SURFACE

DRAWN = Path(__file__).with_name("kitti_roads.coco.json")
"""Hand-drawn roads of some training scans of KITTI, as ``edgeperc-export database-label`` saves them: polygons in the
top view, without the scans."""

RISE_M = 0.3
LANE_HALF_WIDTH_M = 1.2
LANE_RANGE_M = (3.0, 25.0)

# The remission of asphalt varies by 0.05 along a lane; that of grass is higher by 0.2 and more.
BRIGHTER = 0.15


def ground_plane(points: Points, seed: int = 0) -> Floats | None:
    """The ground plane near the vehicle, z = a x + b y + c (RANSAC, then least squares), of a sensor 1.73 m above the
    road; None with fewer than 500 low points or without a plausible plane.
    """
    # Not `edgeperc.ground.planes.find_ground`, which fits the lowest returns of cells: that plane is 0.3 to 12 cm lower
    # on 22 KITTI scans (median 4 cm). With it, the share of correct cells changes: of "no road" from 0.938 to
    # 0.921 on 8 drawn KITTI scans and from 0.982 to 0.963 on 24 simulated ones; of "road" from 0.987 to 0.991 and from
    # 0.988 to 0.986.
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
        # The sensor is mounted 1.73 m above the road, and no street is steeper than 12 %.
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


def sure_surface(points: Points) -> Bytes:
    """Ground truth of the cells of `SURFACE` that a scan makes certain: 1 road, 0 no road, `IGNORE` elsewhere.

    Low points in the lane ahead are road. Points above the ground, and areas brighter than the lane, are no road.
    """
    surface = np.full((SURFACE.height, SURFACE.width), IGNORE, np.uint8)
    plane = ground_plane(points)
    if plane is None:
        return surface
    x, y = points[:, 0].astype(np.float64), points[:, 1].astype(np.float64)
    height = points[:, 2] - (plane[0] * x + plane[1] * y + plane[2])
    distance = np.hypot(x, y)
    row, col, kept = SURFACE.cells(x, y)
    kept &= (distance > 2.5) & (height < 3.0)
    cell = row * SURFACE.width + col

    low = kept & (np.abs(height) < 0.08 + 0.004 * distance)
    lane = low & (np.abs(y) < LANE_HALF_WIDTH_M) & (x > LANE_RANGE_M[0]) & (x < LANE_RANGE_M[1])
    risen = kept & (height > RISE_M + 0.01 * distance)
    ahead = risen & (np.abs(y) < LANE_HALF_WIDTH_M + 0.3) & (x > LANE_RANGE_M[0])
    if ahead.any():
        lane &= x < x[ahead].min() - 1.0
    if np.count_nonzero(lane) > 100:
        asphalt = float(np.median(points[lane, 3]))
        size = surface.size
        count = np.bincount(cell[low], minlength=size).reshape(surface.shape)
        total = np.bincount(cell[low], weights=points[low, 3], minlength=size).reshape(surface.shape)
        around, bright = box_sums(count), box_sums(total)
        bright = (around >= 8) & (bright > (asphalt + BRIGHTER) * around) & (count > 0)
        # Lane markings are bright too, but narrower than the 1.4 m of `box_sums`. The lane itself always stays road.
        surface[bright] = 0
        surface.reshape(-1)[cell[lane]] = 1
    surface.reshape(-1)[cell[risen]] = 0
    return surface


def drawn_roads(path: Path = DRAWN) -> dict[str, Bytes]:
    """Hand-drawn roads: hash of the scan (`edgeperc.datasets.kitti.scan_hash`) -> mask (400, 200) uint8, 1 road.

    The file keeps the hash as ``scan`` of each image, because names of scans differ between copies of KITTI.
    """
    try:
        drawn = read_coco([path])
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "a package", "database", "a hand-drawn road") from exc
    hashes = {Path(image["file_name"]).stem: image["scan"] for image in json.loads(path.read_text())["images"]}
    return {hashes[name]: mask_of(polygons, f"{path}: {name}") for name, polygons in drawn.items()}


def with_road(surface: Bytes, road: Bytes) -> Bytes:
    """Ground truth over `SURFACE` with a drawn road over `VIEW`, from `mask_of`."""
    x, y = SURFACE.cell_centers()
    row, col, drawn = VIEW.cells(x, y)
    return np.where(drawn, road[row % VIEW.height, col % VIEW.width], surface).astype(np.uint8)


def box_sums(values: NDArray[Any], reach: int = 3) -> NDArray[Any]:
    """Sums over the (2 reach + 1)² cells around each cell."""
    for axis in (0, 1):
        padded = np.pad(values, [(reach + 1, reach) if a == axis else (0, 0) for a in (0, 1)])
        total = padded.cumsum(axis)
        n = values.shape[axis]
        values = np.take(total, range(2 * reach + 1, 2 * reach + 1 + n), axis) - np.take(total, range(n), axis)
    return values


ROAD = ("road", "drivable")


def read_coco(paths: Iterable[Path]) -> dict[str, list[Any]]:
    """Roads of COCO files: scene -> COCO segmentations, polygons in pixels of the top-view image or run lengths.

    Annotations of a category "road" or "drivable" are road. Scenes have the names of their image files. A scene with
    annotations but none of road has an empty list.
    """
    roads: dict[str, list[Any]] = {}
    for path in paths:
        try:
            content = json.loads(path.read_text())
            images = {image["id"]: image for image in content["images"]}
            road = {c["id"] for c in content["categories"] if str(c["name"]).lower() in ROAD}
            drawn = [(a["image_id"], a["category_id"], a["segmentation"]) for a in content["annotations"]]
        except (ValueError, KeyError, TypeError, RecursionError) as exc:
            raise DatabaseError(
                f"{path} is not a COCO file ({exc!r}); expected images, categories and annotations"
            ) from exc
        if not road:
            raise DatabaseError(f"{path} has no category called road or drivable; rename its road category")
        found: dict[str, list[Any]] = {}
        for image_id, category, segmentation in drawn:
            image = images.get(image_id)
            if image is None:
                raise DatabaseError(f"{path} annotates image {image_id!r}, which it does not list; export it again")
            size, name = (image.get("width"), image.get("height")), Path(str(image.get("file_name"))).stem
            if size != (WIDTH, HEIGHT):
                raise DatabaseError(
                    f"{path}: image {name} is {size[0]} x {size[1]}; expected the database's images, {WIDTH} x {HEIGHT}"
                )
            found.setdefault(name, [])
            if category in road:
                mask_of([segmentation], f"{path}: image {name}")
                found[name].append(segmentation)
        if common := sorted(found.keys() & roads.keys()):
            raise DatabaseError(f"{path} and another file both draw {', '.join(common[:5])}; give one of them")
        roads |= found
    return roads


def mask_of(segmentations: Sequence[Any], source: str = "a polygon") -> Bytes:
    """The union of COCO segmentations, (400, 200) uint8: 1 inside, 0 outside (section 3.3).

    ``source`` starts the error message.
    """
    from faster_coco_eval.core import mask as coco

    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for each in segmentations:
        try:
            if isinstance(each, list):
                rings = [[float(v) for v in ring] for ring in each]
                valid = all(len(ring) >= 6 and len(ring) % 2 == 0 and np.isfinite(ring).all() for ring in rings)
                if not rings or not valid or max(abs(v) for ring in rings for v in ring) > 1e5:
                    raise ValueError(f"a polygon is {str(each)[:60]}")
                runs = coco.merge(coco.frPyObjects(rings, HEIGHT, WIDTH))
            else:
                if tuple(each["size"]) != (HEIGHT, WIDTH):
                    raise ValueError(f"run lengths are of size {each['size']}")
                runs = coco.frPyObjects(each, HEIGHT, WIDTH) if isinstance(each["counts"], list) else each
                covered = sum(runs["counts"]) if isinstance(runs["counts"], list) else None
                if covered not in (None, HEIGHT * WIDTH):
                    raise ValueError(f"run lengths cover {covered} pixels")
            mask |= coco.decode(runs)
        except (ValueError, KeyError, TypeError, OverflowError) as exc:
            raise DatabaseError(
                f"{source}: {exc}; expected polygons x y x y ... of three corners or more, or run lengths of the image"
            ) from exc
    return mask


def write_coco(roads: Mapping[str, Sequence[Sequence[Sequence[float]]]], scans: Mapping[str, str] | None = None) -> str:
    """The text of a COCO file of roads, by scene, polygons of corners (x, y) in pixels; and of the hash of each scene's
    scan, because names differ between copies of KITTI.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for k, name in enumerate(sorted(roads), 1):
        scan = {"scan": scans[name]} if scans and name in scans else {}
        images.append({"id": k, "file_name": f"{name}.png", "width": WIDTH, "height": HEIGHT, **scan})
        for polygon in roads[name]:
            x, y = np.array(polygon, np.float64).T
            area = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2.0
            low, size = (float(x.min()), float(y.min())), (float(np.ptp(x)), float(np.ptp(y)))
            flat = [round(float(v), 2) for corner in polygon for v in corner]
            shape = {"segmentation": [flat], "bbox": [round(v, 2) for v in (*low, *size)], "area": round(area, 2)}
            annotations.append({"id": len(annotations) + 1, "image_id": k, "category_id": 1, **shape, "iscrowd": 0})
    content = {"images": images, "categories": [{"id": 1, "name": "road"}], "annotations": annotations}
    return json.dumps(content, indent=1) + "\n"


CLASSES = ("background", "road", *VEHICLES)

# The view of section 3.1 and SSADNet 2.1.2; both ends of each range belong to it.
X_RANGE_M, Y_RANGE_M, Z_RANGE_M, CELL_M = (6.0, 46.0), (-10.0, 10.0), (-2.5, 2.5), 0.1
HEIGHT, WIDTH = 400, 200

# Coordinates are rounded to whole pixels, so the center of pixel 0 is at 6.0 m. A network rounds down instead: its
# pixel 0 starts at 6.0 m. The database's cells are therefore half a cell nearer and farther right. A card with this
# view has the same cells as the database.
VIEW = TopViewGeometry(
    (X_RANGE_M[0] - 0.05, X_RANGE_M[1] - 0.05), (Y_RANGE_M[0] - 0.05, Y_RANGE_M[1] - 0.05), Z_RANGE_M
)


class DatabaseError(EdgepercError, ValueError):
    """A top-view database, or a COCO file of drawn roads, cannot be made or read."""
