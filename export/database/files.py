"""The files of the top-view database, and their reader.

KITTI's scenes as images, labels and maps of the ground ahead, made by the eight steps of section 3 of the paper in
Electronics 12, 3165 (2023)::

    OUT/images/NAME.png   3.1  the scan: red distance, green height, blue remission; 0 without a return
    OUT/labels/NAME.txt   3.2  a line for each vehicle: class x y length width yaw, meters and radians, sensor frame
    OUT/maps/NAME.png     3.8  the class of each cell: background 0, road 1, car 2, van 3, truck 4
    OUT/index.csv              a line for each scene: drive, split, fold, counts and hashes
    OUT/road/             3.4  images and masks to train a road model on, with their own index
    OUT/manifest.json          sources and settings; written last, so a folder without it is unfinished

The index is CSV rather than Parquet: a few megabytes, the same bytes with every library, and diff can compare it.

KITTI labels only what the camera sees. Vehicles in the near corners of the image, outside the camera's view, are in
neither labels nor maps.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from edgeperc.system.names import check_file
from edgeperc.types.choices import VEHICLES
from edgeperc.types.geometry import draw_footprints, rectangles
from edgeperc.types.perception import Box
from edgeperc.types.points import Bytes, Floats, Points

from ..data.roads import CELL_M, CLASSES, HEIGHT, VIEW, WIDTH, X_RANGE_M, Y_RANGE_M, Z_RANGE_M, DatabaseError

FORMAT = 1
N_FOLDS = 5
FARTHEST_M = float(np.hypot(X_RANGE_M[1], Y_RANGE_M[1]))


def picture(points: Points) -> Bytes:
    """A scan seen from above (section 3.1): distance, height and remission (0..1) of each pixel's highest point, the
    first of equally high ones, scaled to 0..255. The first channel is 0 in exactly the pixels without a return.
    """
    p = points[(points[:, 0] >= X_RANGE_M[0]) & (points[:, 0] <= X_RANGE_M[1])]
    p = p[(p[:, 1] >= Y_RANGE_M[0]) & (p[:, 1] <= Y_RANGE_M[1]) & (p[:, 2] >= Z_RANGE_M[0]) & (p[:, 2] <= Z_RANGE_M[1])]
    p = p[np.isfinite(p[:, 3])].astype(np.float64)  # NaN passes none of the comparisons above
    ahead = np.clip(np.floor((p[:, 0] - X_RANGE_M[0]) / CELL_M + 0.5), 0, HEIGHT - 1).astype(np.int64)
    left = np.clip(np.floor((p[:, 1] - Y_RANGE_M[0]) / CELL_M + 0.5), 0, WIDTH - 1).astype(np.int64)
    remission = np.clip(p[:, 3], 0.0, 1.0)
    height = (p[:, 2] - Z_RANGE_M[0]) / (Z_RANGE_M[1] - Z_RANGE_M[0])
    values = np.stack([np.hypot(p[:, 0], p[:, 1]) / FARTHEST_M, height, remission], axis=1)
    # The last assignment to a pixel remains, so points are sorted by height, and equally high ones from last to first.
    order = len(p) - 1 - np.argsort(p[::-1, 2], kind="stable")
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[HEIGHT - 1 - ahead[order], WIDTH - 1 - left[order]] = np.rint(255.0 * values[order]).astype(np.uint8)
    return image


def vehicles(boxes: Iterable[Box]) -> tuple[Box, ...]:
    """Cars, vans and trucks that cover a cell of the view, as rectangles (section 3.2), rounded to 0.1 mm as in the
    label files, so that a map drawn from a file is the same. Raises DatabaseError.
    """
    kept = []
    for box in boxes:
        if box.label not in VEHICLES:
            continue
        numbers = [round(float(v), 4) for v in (*box.center[:2], *box.size[:2], box.yaw)]
        if not np.isfinite(numbers).all() or min(numbers[2:4]) <= 0.0 or max(map(abs, numbers)) > 1e4:
            raise DatabaseError(
                f"a {box.label} is {numbers}; expected x, y, length, width [m] and yaw [rad], with an area"
            )
        x, y, length, width, yaw = numbers
        flat = Box(box.label, 1.0, (x, y, 0.0), (length, width, 0.0), yaw)
        if road_and_vehicles(np.zeros((HEIGHT, WIDTH), np.uint8), [flat]).any():
            kept.append(flat)
    return tuple(kept)


def road_and_vehicles(road: NDArray[Any], boxes: Iterable[Box]) -> Bytes:
    """The map of a scene (section 3.8), indices into `CLASSES`: the road, 1, with the vehicles over it, the nearer one
    where two overlap; a cell is a vehicle's if its center is. It has no holes left by rotating whole pixels.
    """
    labels = road.astype(np.uint8)
    draw_footprints(labels, boxes, VIEW, CLASSES)
    return labels


def write_labels(boxes: Iterable[Box]) -> str:
    """The text of a label file: a line ``class x y length width yaw`` [m, rad] for each vehicle, sensor frame."""
    rows = [(b.label, *b.center[:2], *b.size[:2], b.yaw) for b in boxes]
    return "".join(
        f"{name} {x:.4f} {y:.4f} {length:.4f} {width:.4f} {yaw:.4f}\n" for name, x, y, length, width, yaw in rows
    )


def read_labels(path: Path) -> tuple[Box, ...]:
    """Vehicles of a label file; their z and height are 0. Raises DatabaseError."""
    boxes = []
    for line in path.read_text().splitlines():
        try:
            name, *numbers = line.split()
            x, y, length, width, yaw = map(float, numbers)
        except ValueError as exc:
            raise DatabaseError(f"{path} has the line {line!r}; expected lines of: class x y length width yaw") from exc
        boxes.append(Box(name, 1.0, (x, y, 0.0), (length, width, 0.0), yaw))
    return tuple(boxes)


def png(array: Bytes) -> bytes:
    """The bytes of a PNG file of an image (rows, cols) or (rows, cols, 3)."""
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


def read_png(path: Path) -> Bytes:
    """Read an image that `png` wrote."""
    try:
        with Image.open(path) as image:
            return np.asarray(image)
    except (OSError, SyntaxError) as exc:
        raise DatabaseError(f"{path} is not an image ({exc}); run database-check, then build again") from exc


@dataclass(frozen=True, eq=False)
class TopViewScene:
    """One scene of the database."""

    name: str
    drive: str
    split: str
    fold: int | None  # None for test scenes
    image: Bytes
    boxes: tuple[Box, ...]  # their z and height are 0
    map: Bytes  # index into `CLASSES`

    @property
    def rectangles(self) -> Floats:
        """The vehicles as `edgeperc.types.geometry` takes them, (k, 5) float64: x, y, length, width [m], yaw [rad]."""
        return rectangles(self.boxes)


class TopViewDatabase:
    """A finished database: a sequence of `TopViewScene`, read one at a time; of a split "all", "train", "test" or
    "validation", which is a ``fold``, and empty without one. Raises DatabaseError, ValueError.
    """

    def __init__(self, root: Path | str, split: str = "all", fold: int | None = None) -> None:
        if split not in ("all", "train", "validation", "test"):
            raise ValueError(f"split is {split!r}; expected all, train, validation or test")
        if fold is not None and fold not in range(N_FOLDS):
            raise ValueError(f"fold is {fold}; expected 0 to {N_FOLDS - 1}")
        self.root = Path(root)
        path = self.root / "manifest.json"
        try:
            self.manifest: dict[str, Any] = json.loads(path.read_text())
            known, index_hash = self.manifest["format"], self.manifest["sha256"]["index.csv"]
        except FileNotFoundError as exc:
            raise DatabaseError(
                f"{path} does not exist: the database is unfinished or elsewhere; run edgeperc-export database-build"
            ) from exc
        except (ValueError, KeyError, TypeError) as exc:
            raise DatabaseError(f"{path} is not the manifest of a top-view database; build it again") from exc
        if known != FORMAT:
            raise DatabaseError(f"{path} has format {known}; this edgeperc reads {FORMAT}: build it again, or update")
        content = (self.root / "index.csv").read_bytes()
        if hashlib.sha256(content).hexdigest() != index_hash:
            raise DatabaseError(f"{self.root / 'index.csv'} does not match the manifest; build the database again")
        rows = csv.DictReader(io.StringIO(content.decode()))
        self.rows = [row for row in rows if _belongs(row, split, fold)]
        for name in (row.get("scene") or "" for row in self.rows):
            check_file(f"{self.root / 'index.csv'} has a scene called", name, DatabaseError)
        self._at = {row["scene"]: k for k, row in enumerate(self.rows)}

    @property
    def names(self) -> list[str]:
        """Names of the scenes, sorted."""
        return list(self._at)

    def scene(self, name: str) -> TopViewScene:
        """Read a scene by its name; `DatabaseError` if there is none of this name."""
        if name not in self._at:
            raise DatabaseError(f"none of the {len(self)} scenes is called {name!r}; see .names")
        return self[self._at[name]]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, k: int) -> TopViewScene:
        row = self.rows[k]
        name = row["scene"]
        return TopViewScene(
            name,
            row["drive"],
            row["split"],
            int(row["fold"]) if row["fold"] else None,
            read_png(self.root / "images" / f"{name}.png"),
            read_labels(self.root / "labels" / f"{name}.txt"),
            read_png(self.root / "maps" / f"{name}.png"),
        )

    def __iter__(self) -> Iterator[TopViewScene]:
        return (self[k] for k in range(len(self)))

    def damaged(self) -> list[str]:
        """Files of scenes and of drawn roads that are missing, or differ from the hash in their index."""
        index, kinds = "road/index.csv", (("image", "png"), ("label", "txt"), ("map", "png"))
        files = {f"{kind}s/{row['scene']}.{end}": row[f"{kind}_sha256"] for row in self.rows for kind, end in kinds}
        bad_index = _digest(self.root / index) != self.manifest["sha256"].get(index)
        roads = () if bad_index else csv.DictReader(io.StringIO((self.root / index).read_text()))
        drawn = [(row, kind) for row in roads if row["scene"] in self._at for kind in ("image", "mask")]
        files |= {f"road/{kind}s/{row['name']}.png": row[f"{kind}_sha256"] for row, kind in drawn}
        bad = [name for name, digest in files.items() if _digest(self.root / name) != digest]
        return bad + [index] * bad_index


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def _belongs(row: dict[str, str], split: str, fold: int | None) -> bool:
    if split == "all" or row["split"] == "test" or split == "test":
        return split in ("all", row["split"])
    return (row["fold"] == str(fold)) == (split == "validation")
