"""One scene of the database: its inputs, maps and files."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from edgeperc import Perceiver, __version__
from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.errors import CardMismatchError, EdgepercError
from edgeperc.preprocess.condition import condition
from edgeperc.system.atomic import write_atomic
from edgeperc.types.choices import VEHICLES
from edgeperc.types.mounting import MODEL_MOUNTING
from edgeperc.types.points import Bytes, Mask, Points
from edgeperc.types.sensor import get_sensor
from edgeperc.types.views import TopViewGeometry
from edgeperc.zoo import model_path

from ..data.roads import CLASSES, HEIGHT, VIEW, WIDTH, mask_of
from .coco import varied
from .files import FORMAT, picture, png, road_and_vehicles, vehicles, write_labels

INDEX = (
    "scene", "drive", "grade", "split", "fold", "points", "cells_returned", *VEHICLES,
    *(f"{name}_cells" for name in CLASSES[1:]), "road", "scan_sha256", "image_sha256", "label_sha256", "map_sha256",
)  # fmt: skip
ROAD_INDEX = (
    "name", "scene", "drive", "split", "fold", "turn_deg", "mirrored", "road_cells", "image_sha256", "mask_sha256"
)  # fmt: skip
FOLDERS = {"images": "png", "labels": "txt", "maps": "png", ".build/records": "json"}
ROAD_FOLDERS = {"road/images": "png", "road/masks": "png"}
TRAIN, TRAINED = "train", ("road/models", ".build/road")


@dataclass(frozen=True)
class Plan:
    """Settings of a database. All computers of a Ray cluster need its folders at these paths."""

    kitti: Path
    out: Path
    road_by: str = "lodnn"  # of roads that are not drawn: a model's name or path, or "train": one for each fold
    sensor: str = "hdl-64e"
    provider: str = "cpu"  # with "auto" the roads may change between builds
    variations: int = 8  # of each drawn training scene (section 3.4)

    def road_model(self, fold: int | None) -> str:
        """The road model of a fold. Test scenes (None) take the first fold's, whose training set has no test scene."""
        return str(self.out / f"road/models/fold-{fold or 0}.onnx") if self.road_by == TRAIN else self.road_by


@dataclass(frozen=True)
class Job:
    """One scene to make, as in the index."""

    name: str
    drive: str
    grade: str
    split: str
    fold: int | None  # None for test scenes
    road: list[Any] | None = field(default=None)  # COCO segmentations; None if none is drawn


class RoadModel:
    """Road maps by a network (section 3.7), as `Plan.road_model` names it. Raises CardMismatchError."""

    def __init__(self, plan: Plan, model: str, on_mismatch: Literal["warn", "ignore"]) -> None:
        # One thread each, because scenes are made in parallel.
        self.perceive = Perceiver(
            model,
            sensor=plan.sensor,
            mounting=MODEL_MOUNTING,  # the cells are those of the scan's frame
            provider=plan.provider,
            n_threads=1,
            on_mismatch=on_mismatch,
            agree=False,
        )
        (card,) = self.perceive.cards
        view = card.view
        if not isinstance(view, TopViewGeometry) or "drivable" not in card.classes:
            raise CardMismatchError(
                f"{model} is a {view.kind} model of {', '.join(card.classes)}; expected a top_view model with a "
                "class drivable, such as lodnn"
            )
        self.path = model
        self._shift = np.array([view.x_range_m[1] - VIEW.x_range_m[1], view.y_range_m[1] - VIEW.y_range_m[1], 0, 0])
        same = (view.height, view.width, view.cell_m) == (HEIGHT, WIDTH, VIEW.cell_m)
        if not same or np.abs(self._shift).max() > VIEW.cell_m:
            raise CardMismatchError(
                f"{model} covers x {view.x_range_m}, y {view.y_range_m} in cells of {view.cell_m} m; expected the "
                f"database's x {VIEW.x_range_m}, y {VIEW.y_range_m} in cells of {VIEW.cell_m} m, to within one cell"
            )
        content = (Path(model) if Path(model).suffix == ".onnx" else model_path(model)).read_bytes()
        self.facts = {
            "name": card.name,
            "version": card.version,
            "sha256": hashlib.sha256(content).hexdigest(),
            "provider": self.perceive.providers[card.name],
        }

    def __call__(self, points: Points) -> Mask:
        """Road of a scan, (400, 200) bool."""
        # The scan is moved by the offset between the views, so that its points are in the same cells of both.
        return self.perceive(points + self._shift.astype(np.float32)).require_top_view().road


class SceneBuilder:
    """Makes scenes, one at a time (sections 3.1 to 3.4, 3.7 and 3.8)."""

    def __init__(self, plan: Plan, on_mismatch: Literal["warn", "ignore"] = "ignore") -> None:
        self.plan = plan
        self.objects = KittiObjects(plan.kitti)
        self.sensor = get_sensor(plan.sensor)
        self.facts: dict[str, dict[str, str]] = {}
        self._on_mismatch = on_mismatch
        self._road_model: RoadModel | None = None

    def road_model(self, fold: int | None) -> RoadModel:
        """The road model of a fold. Only one is kept in memory, because scenes come fold by fold."""
        path = self.plan.road_model(fold)
        if self._road_model is None or self._road_model.path != path:
            self._road_model = RoadModel(self.plan, path, self._on_mismatch)
            self.facts[path] = self._road_model.facts
        return self._road_model

    def is_made(self, job: Job) -> bool:
        """Whether the scene exists and was made from the same inputs with the same settings."""
        facts = self.road_model(job.fold).facts
        try:
            record = json.loads(self.record_path(job.name).read_text())
            files = [self.plan.out / folder / f"{job.name}.{suffix}" for folder, suffix in FOLDERS.items()]
            files += [self._variation(folder, row["name"]) for row in record["variations"] for folder in ROAD_FOLDERS]
            return bool(record["key"] == self._key(job, facts)) and all(path.exists() for path in files)
        except (OSError, ValueError, KeyError, TypeError):
            return False  # no record, or not one of this format: the scene is made again

    def __call__(self, job: Job) -> str:
        """Make a scene; returns the reason if it is left out, else "". Raises OSError."""
        try:
            frame = self.objects.frame(job.name)
            boxes = vehicles(frame.boxes)
        except (EdgepercError, ValueError, OSError) as exc:
            # Without the folder's path, so that the database does not depend on it.
            return (str(exc) or type(exc).__name__).replace(f"{self.plan.kitti}{os.sep}", "")
        image = picture(condition(frame.points, self.sensor, rendered=False)[0])
        model = self.road_model(job.fold)
        found = model(frame.points)
        drawn = None if job.road is None else mask_of(job.road, job.name) != 0
        road = found if drawn is None else drawn
        labels = road_and_vehicles(road, boxes)
        contents = {"image": png(image), "label": write_labels(boxes).encode(), "map": png(labels)}
        kinds = Counter(box.label for box in boxes)
        cells = np.bincount(labels.ravel(), minlength=len(CLASSES))
        row = {
            "points": len(frame.points),
            "cells_returned": int(np.count_nonzero(image[..., 0])),
            **{name: kinds[name] for name in VEHICLES},
            **{f"{name}_cells": int(cells[k]) for k, name in enumerate(CLASSES) if k},
            "road": "model" if drawn is None else "polygons",
            "scan_sha256": scan_hash(frame.points),
        }
        for (folder, suffix), (kind, content) in zip(list(FOLDERS.items())[:3], contents.items(), strict=True):
            row[f"{kind}_sha256"] = self._write(self.plan.out / folder / f"{job.name}.{suffix}", content)
        record = {
            "key": self._key(job, model.facts),
            "row": row,
            "variations": [] if drawn is None else list(self._vary(job, image, drawn)),
            "found": None if drawn is None else np.bincount((2 * drawn + found).ravel(), minlength=4).tolist(),
        }
        self._write(self.record_path(job.name), json.dumps(record, sort_keys=True).encode())
        return ""

    def _vary(self, job: Job, image: Bytes, road: Mask) -> Iterator[dict[str, Any]]:
        # Test scenes are separated before augmentation (section 3.4, Figure 12), so they are not varied.
        for k in range(1 + (self.plan.variations if job.split == "train" else 0)):
            moved, mask, turn_deg, mirrored = varied(image, road.astype(np.uint8), job.name, k)
            name = f"{job.name}-{k:02d}"
            row = {"name": name, "turn_deg": turn_deg, "mirrored": int(mirrored)}
            row["road_cells"] = int(np.count_nonzero(mask == 1))
            row["image_sha256"] = self._write(self._variation("road/images", name), png(moved))
            row["mask_sha256"] = self._write(self._variation("road/masks", name), png(mask))
            yield row

    def record_path(self, name: str) -> Path:
        """Path of a finished scene's record."""
        return self.plan.out / ".build/records" / f"{name}.json"

    def _variation(self, folder: str, name: str) -> Path:
        return self.plan.out / folder / f"{name}.{ROAD_FOLDERS[folder]}"

    def _key(self, job: Job, model: dict[str, str]) -> str:
        """A hash of everything that decides a scene's files."""
        facts = [
            FORMAT, __version__, model, asdict(self.sensor), self.plan.variations, job.name, job.split, job.road,
            inputs_of(self.plan.kitti, job.name),
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def _write(self, path: Path, content: bytes) -> str:
        write_atomic(path, content)
        return hashlib.sha256(content).hexdigest()


def inputs_of(kitti: Path, name: str) -> str:
    """A key of a scene's input files, label, calibration and scan: their hashes."""
    files = (f"label_2/{name}.txt", f"calib/{name}.txt", f"velodyne/{name}.bin")
    return " ".join(hashlib.sha256((kitti / "training" / file).read_bytes()).hexdigest() for file in files)
