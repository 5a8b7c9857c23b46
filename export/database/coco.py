"""Drafts and variations of hand-drawn roads, and the COCO file of a database.

`edgeperc_export.data.roads` reads and writes the COCO files of drawn roads.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from edgeperc.simulation.samples import IGNORE
from edgeperc.types.points import Bytes, Labels

from ..data.roads import CLASSES, HEIGHT, VIEW, WIDTH, DatabaseError
from .files import TopViewDatabase, road_and_vehicles

TURN_DEG = 8.0
SMALLEST_M2 = 2.0
SMOOTH_CELLS, SIMPLIFIED_CELLS = 5.0, 1.5


def scans_of(path: Path, own: Mapping[str, str]) -> dict[str, str]:
    """Scene -> hash of the scan that its road was drawn over, where a COCO file of `write_coco` has it. Raises
    DatabaseError if one of its names is that of another scan here: ``own`` are the hashes of the scans by name.
    """
    images = json.loads(path.read_text())["images"]
    scans = {Path(str(image.get("file_name"))).stem: str(image["scan"]) for image in images if "scan" in image}
    if others := sorted(name for name, digest in scans.items() if own.get(name, digest) != digest):
        raise DatabaseError(
            f"{path} has roads that were drawn over other scans than those of these names here: {', '.join(others[:5])}"
            "; names differ between copies of a set. Rename its images, or remove those that were drawn for other scans"
        )
    return scans


def draft(labels: Labels) -> list[list[list[float]]]:
    """Polygons around the road of a map [px], for a person to correct, without holes and details below 1 m."""
    from shapely import box, union_all

    bars = []
    for row, line in enumerate(labels == CLASSES.index("road")):
        edges = np.nonzero(np.diff(line.astype(np.int8), prepend=0, append=0))[0]
        bars += [box(a, row, b, row + 1) for a, b in edges.reshape(-1, 2)]
    # Closing, then opening: about ten corners to edit instead of the hundred of a network's ragged edge.
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


def varied(image: Bytes, mask: Bytes, name: str, k: int) -> tuple[Bytes, Bytes, float, bool]:
    """Variation ``k`` of a drawn scene (section 3.4), always the same by its name; 0 is itself. Image and mask are
    turned about the sensor and perhaps mirrored, without interpolation, 0 and `IGNORE` outside the scene.
    """
    if k == 0:
        return image, mask, 0.0, False
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(f"{name}/{k}".encode()).digest()[:8], "little"))
    turn_deg, mirrored = round(float(rng.uniform(-TURN_DEG, TURN_DEG)), 3), bool(rng.random() < 0.5)
    x, y = VIEW.cell_centers()
    cos, sin = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    from_x, from_y = cos * x + sin * y, cos * y - sin * x
    if mirrored:
        from_y = -from_y
    row, col, inside = VIEW.cells(from_x, from_y)
    row, col = row % HEIGHT, col % WIDTH
    moved = np.where(inside[..., None], image[row, col], 0).astype(np.uint8)
    return moved, np.where(inside, mask[row, col], IGNORE).astype(np.uint8), turn_deg, mirrored


def write_database_coco(database: TopViewDatabase, file: IO[str]) -> int:
    """Write a database as COCO, one scene at a time, an annotation for each vehicle (complete, even if a nearer one
    covers part of it in the map) and each scene's road; returns their number.
    """
    from faster_coco_eval.core import mask as coco

    def annotations() -> Iterator[dict[str, Any]]:
        for image_id, scene in enumerate(database, 1):
            masks = [(CLASSES.index(b.label), road_and_vehicles(np.zeros_like(scene.map), [b])) for b in scene.boxes]
            for category, mask in [(1, scene.map == 1), *masks]:
                if not mask.any():
                    continue
                runs = coco.encode(np.asfortranarray(mask != 0, np.uint8))
                yield {
                    "image_id": image_id,
                    "category_id": category,
                    "area": int(coco.area(runs)),
                    "bbox": [float(v) for v in coco.toBbox(runs)],
                    "segmentation": {"size": [HEIGHT, WIDTH], "counts": runs["counts"].decode()},
                    "iscrowd": 0,
                }

    images = [
        {"id": k, "file_name": f"{name}.png", "width": WIDTH, "height": HEIGHT}
        for k, name in enumerate(database.names, 1)
    ]
    categories = [{"id": k, "name": name} for k, name in enumerate(CLASSES) if k]
    file.write(f'{{"images": {json.dumps(images)},\n"categories": {json.dumps(categories)},\n"annotations": [')
    n = 0
    for n, entry in enumerate(annotations(), 1):
        file.write(f"{',' if n > 1 else ''}\n{json.dumps({'id': n, **entry})}")
    file.write("\n]}\n")
    return n
