"""Roads drawn by hand: COCO files in and out, masks of them, drafts to start from, variations to train on.

A COCO file is one that any drawing tool writes: polygons in pixels of the top-view image, from its upper left corner.
Whatever is of a category called "road" (or "drivable") is road; everything else, "background" included, is not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from edgeperc.datasets import IGNORE

from .topview_database import CLASSES, HEIGHT, VIEW, WIDTH, DatabaseError, TopViewDatabase, road_and_vehicles

__all__ = ["draft", "mask_of", "read_coco", "varied", "write_coco", "write_database_coco"]

ROAD = ("road", "drivable")
TURN_DEG = 8.0
SMALLEST_M2 = 2.0
SMOOTH_CELLS, SIMPLIFIED_CELLS = 5.0, 1.5


def read_coco(paths: Iterable[Path]) -> dict[str, list[Any]]:
    """Roads of COCO files: scene -> COCO segmentations, polygons or run lengths.

    Scenes are named by their images' file names. One with annotations, but none of road, has no road: an empty list.

    Raises
    ------
    DatabaseError
        A file is no COCO file, knows no road, is about images of another size, or two draw the same scene.
    """
    roads: dict[str, list[Any]] = {}
    for path in paths:
        try:
            content = json.loads(path.read_text())
            images = {image["id"]: image for image in content["images"]}
            road = {c["id"] for c in content["categories"] if str(c["name"]).lower() in ROAD}
            drawn = [(a["image_id"], a["category_id"], a["segmentation"]) for a in content["annotations"]]
        except (ValueError, KeyError, TypeError) as exc:
            raise DatabaseError(f"{path} is no COCO file ({exc!r}); expected images, categories, annotations") from exc
        if not road:
            raise DatabaseError(f"{path} has no category called road; expected the road's polygons under that name")
        found: dict[str, list[Any]] = {}
        for image_id, category, segmentation in drawn:
            image = images.get(image_id)
            if image is None:
                raise DatabaseError(f"{path} annotates image {image_id!r}, which it does not list; export it again")
            size, name = (image.get("width"), image.get("height")), Path(str(image.get("file_name"))).stem
            if size != (WIDTH, HEIGHT):
                raise DatabaseError(
                    f"{path}: image {name} is {size[0]} x {size[1]}; expected {WIDTH} x {HEIGHT}, the database's own"
                )
            found.setdefault(name, [])
            if category in road:
                mask_of([segmentation], f"{path}: image {name}")
                found[name].append(segmentation)
        twice = sorted(found.keys() & roads.keys())
        if twice:
            raise DatabaseError(f"{path} draws {', '.join(twice[:5])}, which another file draws too; keep one of them")
        roads |= found
    return roads


def mask_of(segmentations: Sequence[Any], of: str = "a polygon") -> NDArray[np.uint8]:
    """What COCO segmentations cover, together, (400, 200) uint8: 1 and 0 (section 3.3)."""
    from faster_coco_eval.core import mask as coco

    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    for each in segmentations:
        try:
            if isinstance(each, list):
                rings = [[float(v) for v in ring] for ring in each]
                whole = all(len(ring) >= 6 and len(ring) % 2 == 0 and np.isfinite(ring).all() for ring in rings)
                if not rings or not whole or max(abs(v) for ring in rings for v in ring) > 1e5:
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
        except (ValueError, KeyError, TypeError) as exc:
            raise DatabaseError(
                f"{of}: {exc}; expected polygons of three corners and more, x y x y ..., or run lengths of the image"
            ) from exc
    return mask


def write_coco(roads: Mapping[str, Sequence[Sequence[Sequence[float]]]], scans: Mapping[str, str] | None = None) -> str:
    """The text of a COCO file: scene -> polygons -> corners (x, y) in pixels.

    ``scans`` has `edgeperc.datasets.scan_hash` of the scenes: names differ from one copy of KITTI to the next.
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
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": k,
                    "category_id": 1,
                    "segmentation": [flat],
                    "bbox": [round(v, 2) for v in (*low, *size)],
                    "area": round(area, 2),
                    "iscrowd": 0,
                }
            )
    content = {"images": images, "categories": [{"id": 1, "name": "road"}], "annotations": annotations}
    return json.dumps(content, indent=1) + "\n"


def draft(labels: NDArray[np.uint8]) -> list[list[list[float]]]:
    """Polygons around the road of a map, to be corrected by hand: holes filled, what is narrower than a metre smoothed.

    Parameters
    ----------
    labels : (400, 200) uint8
        Index into `CLASSES`.

    Returns
    -------
    list of polygons of corners [x, y], in pixels from the upper left corner
    """
    from shapely import box, union_all

    bars = []
    for row, line in enumerate(labels == CLASSES.index("road")):
        edges = np.nonzero(np.diff(line.astype(np.int8), prepend=0, append=0))[0]
        bars += [box(a, row, b, row + 1) for a, b in edges.reshape(-1, 2)]
    # Closed, then opened: a person wants ten corners, not the hundred of a network's ragged edge.
    whole = union_all(bars)
    for reach in (SMOOTH_CELLS, -2 * SMOOTH_CELLS, SMOOTH_CELLS):
        whole = whole.buffer(reach, join_style="mitre")
    whole = whole.intersection(box(0, 0, WIDTH, HEIGHT))
    polygons = []
    for part in getattr(whole, "geoms", [whole]):
        outline = type(part)(part.exterior) if not part.is_empty else part
        if outline.area * VIEW.cell_m**2 >= SMALLEST_M2:
            corners = outline.simplify(SIMPLIFIED_CELLS).exterior.coords[:-1]
            polygons.append([[round(x, 2), round(y, 2)] for x, y in corners])
    return polygons


def varied(
    image: NDArray[np.uint8], mask: NDArray[np.uint8], name: str, k: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], float, bool]:
    """Variation ``k`` of a drawn scene (section 3.4): image and mask turned about the sensor, and mirrored, alike.

    About the sensor, so that the distances that the image holds stay true. Cells are moved whole and nothing is
    interpolated: the mask stays a mask. Variation 0 is the scene itself; the same name and number give the same again.

    Returns
    -------
    image : (400, 200, 3) uint8
        0 where the scene does not reach.
    mask : (400, 200) uint8
        Likewise `IGNORE`.
    turn_deg : float
    mirrored : bool
    """
    if k == 0:
        return image, mask, 0.0, False
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(f"{name}/{k}".encode()).digest()[:8], "little"))
    turn_deg, mirrored = round(float(rng.uniform(-TURN_DEG, TURN_DEG)), 3), bool(rng.random() < 0.5)
    x, y = VIEW.cell_centres()
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    from_x, from_y = cos * x + sin * y, cos * y - sin * x
    if mirrored:
        from_y = -from_y
    row = np.floor((VIEW.x_range_m[1] - from_x) / VIEW.cell_m).astype(np.int64)
    col = np.floor((VIEW.y_range_m[1] - from_y) / VIEW.cell_m).astype(np.int64)
    inside = (row >= 0) & (row < HEIGHT) & (col >= 0) & (col < WIDTH)
    row, col = row % HEIGHT, col % WIDTH
    moved = np.where(inside[..., None], image[row, col], 0).astype(np.uint8)
    return moved, np.where(inside, mask[row, col], IGNORE).astype(np.uint8), turn_deg, mirrored


def write_database_coco(database: TopViewDatabase, file: TextIO) -> int:
    """Write a database as COCO: an annotation for every vehicle and for the road; how many.

    Scene by scene, so that memory does not grow with the database. Vehicles are whole, also where a nearer one hides
    part of them in the map.
    """
    from faster_coco_eval.core import mask as coco

    def annotations() -> Iterator[str]:
        n = 0
        for image_id, scene in enumerate(database, 1):
            masks = [(CLASSES.index(b.label), road_and_vehicles(np.zeros_like(scene.map), [b])) for b in scene.boxes]
            for category, mask in [(1, scene.map == 1), *masks]:
                if not mask.any():
                    continue
                n += 1
                runs = coco.encode(np.asfortranarray(mask != 0, np.uint8))
                entry = {
                    "id": n,
                    "image_id": image_id,
                    "category_id": category,
                    "area": int(coco.area(runs)),
                    "bbox": [float(v) for v in coco.toBbox(runs)],
                    "segmentation": {"size": [HEIGHT, WIDTH], "counts": runs["counts"].decode()},
                    "iscrowd": 0,
                }
                yield json.dumps(entry)

    images = [
        {"id": k, "file_name": f"{name}.png", "width": WIDTH, "height": HEIGHT}
        for k, name in enumerate(database.names, 1)
    ]
    categories = [{"id": k, "name": name} for k, name in enumerate(CLASSES) if k]
    file.write(f'{{"images": {json.dumps(images)},\n"categories": {json.dumps(categories)},\n"annotations": [')
    n = 0
    for n, entry in enumerate(annotations(), 1):
        file.write(f"{',' if n > 1 else ''}\n{entry}")
    file.write("\n]}\n")
    return n
