"""Building a top-view database: section 3 scene by scene, on this computer or a Ray cluster, resumed where it stopped.

Every scene is made by itself and leaves its files, each written aside and renamed, and then a record of them. A scene
with a record of the same inputs and settings is not made again, so a stopped build goes on where it was. The index is
put together from the records, and the manifest is written last.

Roads that nobody drew come from a model: any network of the top view with a class "drivable", shipped or of a file, or
one a fold, taught by the drawn ones (`edgeperc_export.road_folds`).
"""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from filelock import FileLock, Timeout
from tqdm import tqdm

from edgeperc import __version__
from edgeperc.atomic import write_aside
from edgeperc.errors import MissingExtraError
from edgeperc.evaluation.datasets import KittiObjects
from edgeperc.evaluation.metrics import Confusion
from edgeperc.evaluation.splits import TEST_DRIVES

from ..roads import CLASSES, VEHICLES, VIEW, Z_RANGE_M, DatabaseError, read_coco
from .files import FARTHEST_M, FORMAT, N_FOLDS
from .scenes import FOLDERS, INDEX, ROAD_FOLDERS, ROAD_INDEX, TRAIN, TRAINED, Plan, SceneBuilder, Task, inputs_of
from .workers import run_jobs

if TYPE_CHECKING:
    from ..recipe import Recipe

__all__ = ["Report", "build", "folds"]


@dataclass(frozen=True)
class Report:
    """What a build did.

    Attributes
    ----------
    scenes, made, kept : int
        Scenes in the database; of them, made by this build and found finished.
    skipped : dict of str to str
        Scenes left out, and why.
    scores : dict
        How well the road model finds the roads that were drawn, by split: F1, accuracy, precision, recall.
    notes : tuple of str
        What else is worth knowing.
    """

    scenes: int
    made: int
    kept: int
    skipped: dict[str, str]
    scores: dict[str, dict[str, float | None]]
    notes: tuple[str, ...] = ()


def folds(drives: Iterable[str]) -> dict[str, int]:
    """Drive -> fold, of five (section 3.4, Figure 14), given the drive of every scene.

    Frames of one drive look alike, so a drive stays whole: the longest goes first, each to the fold with fewest scenes.
    """
    sizes = [0] * N_FOLDS
    chosen = {}
    for drive, n in sorted(Counter(drives).items(), key=lambda each: (-each[1], each[0])):
        chosen[drive] = sizes.index(min(sizes))
        sizes[chosen[drive]] += n
    return chosen


def build(
    plan: Plan,
    *,
    polygons: Sequence[Path] = (),
    test_drives: Sequence[str] = (),
    recipe: Recipe | None = None,
    engine: Literal["local", "ray"] = "local",
    workers: int | None = None,
) -> Report:
    """Build a database, or go on with one.

    Parameters
    ----------
    plan : Plan
    polygons : sequence of Path
        COCO files of roads drawn by hand. A drawn scene has its road from them, and not from the model.
    test_drives : sequence of str
        Drives to set apart, besides `edgeperc.evaluation.splits.TEST_DRIVES`.
    recipe : edgeperc_export.recipe.Recipe, optional
        What is trained where ``plan.road_by`` says so (default: the paper's LoDNN).
    engine : {"local", "ray"}
        Processes of this computer, or ``ray.data`` on the cluster that ``RAY_ADDRESS`` names, else a local one.
    workers : int, optional
        Scenes made side by side (default: as many as there are cores; 1 starts no process).

    Raises
    ------
    DatabaseError
        ``plan.out`` holds something else, another build is at work there, a worker was killed, or too few roads are
        drawn to train on.
    PointsError, SensorError, ModelError, ProviderError
        ``plan`` names no KITTI object set, no sensor, no usable model.
    """
    objects = KittiObjects(plan.kitti)
    drawn = read_coco(polygons)
    held_back = TEST_DRIVES | set(test_drives)
    fold_of = folds(r["drive"] for r in objects.rows if r["drive"] not in held_back)
    tasks = [
        Task(
            r["name"],
            r["drive"],
            r.get("grade", "A"),
            "train" if r["drive"] in fold_of else "test",
            fold_of.get(r["drive"]),
            drawn.pop(r["name"], None),
        )
        for r in sorted(objects.rows, key=lambda r: r["name"])
    ]
    notes = []
    if drawn:
        notes.append(
            f"{len(drawn)} drawn scenes are not in {plan.kitti}, such as {min(drawn)}: their roads are not used"
        )
    if len({t.drive for t in tasks}) == len(tasks) > 1:
        notes.append("every scan counts as a drive of its own: without frames.csv, folds may share a drive's frames")
    unknown = set(test_drives) - {t.drive for t in tasks}
    if unknown:
        raise DatabaseError(f"no scene is of drive {', '.join(sorted(unknown))}; see the column drive of frames.csv")

    if plan.out.is_dir() and any(plan.out.iterdir()) and not (plan.out / ".build").is_dir():
        raise DatabaseError(f"{plan.out} holds something else than a top-view database; give a new or an empty folder")
    for folder in (*FOLDERS, *ROAD_FOLDERS):
        (plan.out / folder).mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(plan.out / ".build/lock", timeout=0):
            if plan.road_by == TRAIN:
                _train(plan, objects, tasks, recipe)
            else:
                for folder in TRAINED:
                    shutil.rmtree(plan.out / folder, ignore_errors=True)
            return _build(plan, tasks, engine, workers or os.cpu_count() or 1, tuple(notes))
    except Timeout as exc:
        raise DatabaseError(f"another build is at work in {plan.out}; wait for it, or stop it") from exc


def _train(plan: Plan, objects: KittiObjects, tasks: list[Task], recipe: Recipe | None) -> None:
    try:
        from ..recipe import PAPER
        from .folds import DrawnScene, train_folds
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "torch", "export", "--road-by train") from exc

    drawn = {}
    for task in tasks:
        if task.road is not None and task.fold is not None:
            with contextlib.suppress(OSError):  # told of when the scene itself is made
                drawn[task.name] = DrawnScene(task.fold, task.road, inputs_of(plan.kitti, task.name))
    folders = [plan.out / folder for folder in TRAINED]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    train_folds(objects, drawn, recipe or PAPER["lodnn"], *folders)


def _build(plan: Plan, tasks: list[Task], engine: str, workers: int, notes: tuple[str, ...]) -> Report:
    builder = SceneBuilder(plan, "warn")
    # Fold by fold, as each has a road model of its own.
    pending = [task for task in sorted(tasks, key=lambda t: (t.fold or 0, t.name)) if not builder.is_made(task)]
    (plan.out / "manifest.json").unlink(missing_ok=True)
    skipped = {}
    with tqdm(total=len(tasks), initial=len(tasks) - len(pending), desc="building", unit="scene") as bar:
        for name, reason in run_jobs(builder, pending, engine, workers):
            bar.update()
            if reason:
                skipped[name] = reason
                bar.set_postfix(skipped=len(skipped))
    kept = len(tasks) - len(pending)
    scores = _finish(builder, [task for task in tasks if task.name not in skipped], skipped)
    return Report(len(tasks) - len(skipped), len(pending) - len(skipped), kept, skipped, scores, notes)


def _finish(builder: SceneBuilder, tasks: list[Task], skipped: dict[str, str]) -> dict[str, dict[str, float | None]]:
    """Index, leftovers, manifest: in this order. What `Report.scores` says."""
    out = builder.plan.out
    index, road_index = _Table(out / "index.csv", INDEX), _Table(out / "road/index.csv", ROAD_INDEX)
    counts: Counter[str] = Counter()
    confusions = {split: Confusion(CLASSES[:2]) for split in ("train", "test")}
    names, variations = {task.name for task in tasks}, set()
    for task in tasks:
        record = json.loads(builder.record_path(task.name).read_text())
        origin = {"scene": task.name, "drive": task.drive, "split": task.split, "fold": task.fold}
        index.add({**origin, "grade": task.grade, **record["row"]})
        for row in record["variations"]:
            road_index.add({**origin, **row})
            variations.add(row["name"])
        if record["found"]:
            confusions[task.split].counts += np.reshape(record["found"], (2, 2))
        counts.update([task.split] if task.fold is None else [task.split, f"fold {task.fold}"])
        counts.update({name: record["row"][name] for name in VEHICLES})
    sums = {"index.csv": index.close(), "road/index.csv": road_index.close()}
    # What a killed build left aside, and scenes that are no longer part of the database.
    for folder, kept in [*((f, names) for f in FOLDERS), *((f, variations) for f in ROAD_FOLDERS)]:
        for path in (out / folder).iterdir():
            if path.suffix == ".part" or path.stem not in kept:
                path.unlink()
    scores = {split: _scores(confusion) for split, confusion in confusions.items() if confusion.counts.any()}
    manifest = {
        "format": FORMAT,
        "edgeperc": __version__,
        "classes": CLASSES,
        "view": {"x_range_m": VIEW.x_range_m, "y_range_m": VIEW.y_range_m, "cell_m": VIEW.cell_m},
        "channels": {"red distance [m]": [0, FARTHEST_M], "green height [m]": Z_RANGE_M, "blue remission": [0, 1]},
        "road_models": [builder.facts[path] for path in sorted(builder.facts)],
        "road_scores": scores,
        "sensor": builder.sensor.name,
        "variations": builder.plan.variations,
        "scenes": len(tasks),
        "counts": counts,
        "skipped": skipped,
        "sha256": sums,
    }
    write_aside(out / "manifest.json", (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode())
    return scores


def _scores(confusion: Confusion) -> dict[str, float | None]:
    """The paper's table 1, but for AP, which maps alone do not give; None where no road is drawn or found."""
    iou = confusion.iou()[1]
    figures = {"f1": 2.0 * iou / (1.0 + iou), "accuracy": confusion.accuracy()}
    figures |= {"precision": confusion.precision()[1], "recall": confusion.recall()[1]}
    return {name: None if np.isnan(value) else round(float(value), 4) for name, value in figures.items()}


class _Table:
    """A CSV file written line by line, hashed on the way and there only when it is whole."""

    def __init__(self, path: Path, columns: Sequence[str]) -> None:
        self._path, self._columns = path, columns
        self._aside = path.with_name(f".{path.name}.part")
        self._file = self._aside.open("wb")
        self._hash = hashlib.sha256()
        self.add(dict(zip(columns, columns, strict=True)))

    def add(self, row: dict[str, Any]) -> None:
        line = io.StringIO()
        csv.writer(line, lineterminator="\n").writerow([row[name] for name in self._columns])
        self._file.write(line.getvalue().encode())
        self._hash.update(line.getvalue().encode())

    def close(self) -> str:
        self._file.close()
        self._aside.replace(self._path)
        return self._hash.hexdigest()
