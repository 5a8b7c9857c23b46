"""The top-view database: what its files hold, and the reader of them.

KITTI's scenes as images, labels and maps of the ground ahead, made by the eight steps of section 3 of the paper in
Electronics 12, 3165 (2023)::

    OUT/images/NAME.png   3.1  the scan: red distance, green height, blue remission, 0 where nothing returned
    OUT/labels/NAME.txt   3.2  a vehicle a line: class x y length width yaw, metres and radians in the sensor frame
    OUT/maps/NAME.png     3.8  a class for every cell: background 0, road 1, car 2, van 3, truck 4
    OUT/index.csv              a scene a line, with its drive, split, fold, counts and hashes
    OUT/road/             3.4  images and masks to train a road model on, with an index of their own
    OUT/manifest.json          what all this was made of; written last, so that a folder without one is unfinished

The index is CSV, not Parquet: a few megabytes at any size anyone has, the same bytes whatever library wrote it, read by
everything and compared by diff.

KITTI labels what the camera sees: vehicles in the near corners, outside the camera's view, are in no label and no map.
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

from edgeperc.geometry import draw_footprints, rectangles
from edgeperc.perception import Box

from ..roads import CELL_M, CLASSES, HEIGHT, VEHICLES, VIEW, WIDTH, X_RANGE_M, Y_RANGE_M, Z_RANGE_M, DatabaseError

__all__ = [
    "FARTHEST_M",
    "FORMAT",
    "N_FOLDS",
    "TopViewDatabase",
    "TopViewScene",
    "picture",
    "png",
    "read_labels",
    "road_and_vehicles",
    "vehicles",
    "write_labels",
]

FORMAT = 1
N_FOLDS = 5
FARTHEST_M = float(np.hypot(X_RANGE_M[1], Y_RANGE_M[1]))


def picture(points: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A scan seen from above (section 3.1).

    Metres become pixels of 0.1 m, rounded to the nearest and clamped to the image; of the points of a pixel the highest
    counts, of equally high ones the first. Every channel is scaled from its range to 0..255.

    Parameters
    ----------
    points : (n, 4) float32
        x, y, z [m], remission, clamped to 0..1 (`edgeperc.adapt.condition` scales a sensor's). Rows that are not finite
        are left out.

    Returns
    -------
    (400, 200, 3) uint8
        Distance in the plane 0..47.07 m, height -2.5..2.5 m, remission 0..1. Row 0 is farthest, column 0 leftmost.
        The first channel is 0 where nothing returned, and nowhere else.
    """
    p = points[(points[:, 0] >= X_RANGE_M[0]) & (points[:, 0] <= X_RANGE_M[1])]
    p = p[(p[:, 1] >= Y_RANGE_M[0]) & (p[:, 1] <= Y_RANGE_M[1]) & (p[:, 2] >= Z_RANGE_M[0]) & (p[:, 2] <= Z_RANGE_M[1])]
    p = p[np.isfinite(p[:, 3])].astype(np.float64)  # NaN passes none of the comparisons above
    ahead = np.clip(np.floor((p[:, 0] - X_RANGE_M[0]) / CELL_M + 0.5), 0, HEIGHT - 1).astype(np.int64)
    left = np.clip(np.floor((p[:, 1] - Y_RANGE_M[0]) / CELL_M + 0.5), 0, WIDTH - 1).astype(np.int64)
    remission = np.clip(p[:, 3], 0.0, 1.0)
    height = (p[:, 2] - Z_RANGE_M[0]) / (Z_RANGE_M[1] - Z_RANGE_M[0])
    values = np.stack([np.hypot(p[:, 0], p[:, 1]) / FARTHEST_M, height, remission], axis=1)
    # Of several assignments to a pixel the last one stays: lowest first, and of equals the later ones first.
    order = len(p) - 1 - np.argsort(p[::-1, 2], kind="stable")
    image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    image[HEIGHT - 1 - ahead[order], WIDTH - 1 - left[order]] = np.rint(255.0 * values[order]).astype(np.uint8)
    return image


def vehicles(boxes: Iterable[Box]) -> tuple[Box, ...]:
    """Cars, vans and trucks that cover a cell of the view, reduced to the plane (section 3.2).

    Rounded to a tenth of a millimetre, as a label file says them, so that the map drawn from them is the label's.

    Raises
    ------
    DatabaseError
        A vehicle's numbers are not finite, or its footprint has no area.
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


def road_and_vehicles(road: NDArray[Any], boxes: Iterable[Box]) -> NDArray[np.uint8]:
    """The map of a scene (section 3.8): road 1, other ground 0, and the vehicles' classes over it.

    A cell is a vehicle's where its centre, turned back by the vehicle's yaw, lies in the rectangle: the paper's rotated
    box, without the holes that turning whole pixels forward leaves. Of two vehicles the nearer one is drawn.
    """
    labels = road.astype(np.uint8)
    draw_footprints(labels, boxes, VIEW, CLASSES)
    return labels


def write_labels(boxes: Iterable[Box]) -> str:
    """The text of a label file: a vehicle a line, ``class x y length width yaw``."""
    rows = [(b.label, *b.center[:2], *b.size[:2], b.yaw) for b in boxes]
    return "".join(
        f"{name} {x:.4f} {y:.4f} {length:.4f} {width:.4f} {yaw:.4f}\n" for name, x, y, length, width, yaw in rows
    )


def read_labels(path: Path) -> tuple[Box, ...]:
    """Vehicles of a label file, in the plane: their z and height are 0."""
    boxes = []
    for line in path.read_text().splitlines():
        try:
            name, *numbers = line.split()
            x, y, length, width, yaw = map(float, numbers)
        except ValueError as exc:
            raise DatabaseError(f"{path} says {line!r}; expected lines of: class x y length width yaw") from exc
        boxes.append(Box(name, 1.0, (x, y, 0.0), (length, width, 0.0), yaw))
    return tuple(boxes)


def png(array: NDArray[np.uint8]) -> bytes:
    """An image (rows, cols) or (rows, cols, 3) as the bytes of a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


def read_png(path: Path) -> NDArray[np.uint8]:
    """An image as `png` wrote it."""
    try:
        with Image.open(path) as image:
            return np.asarray(image)
    except (OSError, SyntaxError) as exc:
        raise DatabaseError(f"{path} is no image ({exc}); run database check, then build again") from exc


@dataclass(frozen=True, eq=False)
class TopViewScene:
    """One scene of the database.

    Attributes
    ----------
    name, drive, split : str
    fold : int or None
        None for a test scene.
    image : (400, 200, 3) uint8
    boxes : tuple of Box
        In the plane: z and height are 0.
    map : (400, 200) uint8
        Index into `CLASSES`.
    """

    name: str
    drive: str
    split: str
    fold: int | None
    image: NDArray[np.uint8]
    boxes: tuple[Box, ...]
    map: NDArray[np.uint8]

    @property
    def rectangles(self) -> NDArray[np.float64]:
        """The vehicles as `edgeperc.geometry` takes them, (k, 5): x, y, length, width [m], yaw [rad]."""
        return rectangles(self.boxes)


class TopViewDatabase:
    """A finished database, read back scene by scene; a sequence of `TopViewScene`.

    Parameters
    ----------
    root : Path or str
        What ``edgeperc-export database build`` wrote.
    split : str
        ``"all"``, ``"train"``, ``"validation"`` or ``"test"``.
    fold : int, optional
        With it, validation is that fold and training the other four; without, validation is empty.

    Attributes
    ----------
    manifest : dict
    rows : list of dict of str to str
        The chosen lines of the index.

    Raises
    ------
    DatabaseError
        ``root`` holds no finished database, one of a newer format, or an index that is not the manifest's.
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
                f"{path} is not there: the database is unfinished or elsewhere; run edgeperc-export database build"
            ) from exc
        except (ValueError, KeyError, TypeError) as exc:
            raise DatabaseError(f"{path} is no manifest of a top-view database; build it again") from exc
        if known != FORMAT:
            raise DatabaseError(f"{path} is of format {known}; this edgeperc reads {FORMAT}: build it again, or update")
        content = (self.root / "index.csv").read_bytes()
        if hashlib.sha256(content).hexdigest() != index_hash:
            raise DatabaseError(f"{self.root / 'index.csv'} is not the one of the manifest; build the database again")
        rows = csv.DictReader(io.StringIO(content.decode()))
        self.rows = [row for row in rows if _belongs(row, split, fold)]
        self._at = {row["scene"]: k for k, row in enumerate(self.rows)}

    @property
    def names(self) -> list[str]:
        """Names of the chosen scenes, sorted."""
        return list(self._at)

    def scene(self, name: str) -> TopViewScene:
        """Read one of the chosen scenes by its name."""
        if name not in self._at:
            raise DatabaseError(f"no scene is called {name!r} among the {len(self)} chosen ones; see .names")
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
        """Files of the chosen scenes that are missing, or not the ones that the index was written for."""
        bad = []
        for row in self.rows:
            for folder, suffix in (("image", "png"), ("label", "txt"), ("map", "png")):
                path = self.root / f"{folder}s" / f"{row['scene']}.{suffix}"
                if not path.exists() or hashlib.sha256(path.read_bytes()).hexdigest() != row[f"{folder}_sha256"]:
                    bad.append(str(path.relative_to(self.root)))
        return bad


def _belongs(row: dict[str, str], split: str, fold: int | None) -> bool:
    if split == "all" or row["split"] == "test" or split == "test":
        return split in ("all", row["split"])
    return (row["fold"] == str(fold)) == (split == "validation")
