"""Builds a top-view database scene by scene (section 3), on this computer or on a Ray cluster.

Each scene is made on its own: first its files, each written completely or not at all, then a record of them. A scene
with a record of the same inputs and settings is not made again, so a stopped build resumes. The index is made of the
records, and the manifest is written last.

Roads that are not drawn by hand come from a model: a top-view network with a class "drivable", by name or path, or one
trained for each fold on the drawn roads (`edgeperc_export.database.folds`).
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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from filelock import FileLock, Timeout
from tqdm import tqdm

from edgeperc import __version__
from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.datasets.splits import TEST_DRIVES
from edgeperc.errors import EdgepercError, MissingExtraError
from edgeperc.evaluation.metrics import Confusion
from edgeperc.system.atomic import write_atomic
from edgeperc.system.pool import Lost
from edgeperc.system.ray_cluster import ENGINES
from edgeperc.types.choices import VEHICLES

from ..data.roads import CLASSES, VIEW, Z_RANGE_M, DatabaseError, read_coco
from .coco import scans_of
from .files import FARTHEST_M, FORMAT, N_FOLDS
from .scenes import FOLDERS, INDEX, ROAD_FOLDERS, ROAD_INDEX, TRAIN, TRAINED, Job, Plan, SceneBuilder, inputs_of

if TYPE_CHECKING:
    from ..recipe import Recipe


@dataclass(frozen=True)
class Report:
    """The result of a build."""

    scenes: int
    made: int  # by this build
    kept: int  # already finished
    skipped: dict[str, str]  # name of each scene left out -> the reason
    # of the road model on the drawn roads, by split: F1, accuracy, precision, recall
    scores: dict[str, dict[str, float | None]]
    notes: tuple[str, ...] = ()  # remarks on the inputs, such as drawn scenes that do not exist


def folds(drives: Iterable[str]) -> dict[str, int]:
    """Assign drives, given for every scene, to five folds (section 3.4, Figure 14), because scenes of one look alike:
    in order of their number of scenes, each to the fold with the fewest.
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
    """Build a database, or resume a stopped build, here or on a Ray cluster. Drawn roads (COCO files) take precedence
    over the road model, of ``recipe`` if it is to be trained. Raises DatabaseError and the errors of models.
    """
    objects = KittiObjects(plan.kitti)
    drawn, own = read_coco(polygons), dict[str, str]()
    for name in drawn.keys() & objects.grades.keys():
        with contextlib.suppress(EdgepercError, OSError, ValueError):  # reported when the scene itself is made
            own[name] = scan_hash(objects.frame(name).points)
    for path in polygons:
        scans_of(path, own)
    held_back = TEST_DRIVES | set(test_drives)
    labeled = {name: objects.drives[name] for name in objects.grades}
    fold_of = folds(drive for drive in labeled.values() if drive not in held_back)
    jobs = [
        Job(name, drive, objects.grades[name], split, fold_of.get(drive), drawn.pop(name, None))
        for name, drive in sorted(labeled.items())
        for split in ["train" if drive in fold_of else "test"]
    ]
    notes = [objects.left_out] if objects.left_out else []
    if drawn:
        notes.append(
            f"{len(drawn)} drawn scenes, such as {min(drawn)}, are not in {plan.kitti}; their roads are not used"
        )
    if not objects.has_table and len(jobs) > 1:
        notes.append("no frames.csv: each scan counts as a drive, so scans of one drive may be in different folds")
    unknown = set(test_drives) - {job.drive for job in jobs}
    if unknown:
        raise DatabaseError(f"no scene is of drive {', '.join(sorted(unknown))}; see the column drive of frames.csv")

    if plan.out.is_dir() and any(plan.out.iterdir()) and not (plan.out / ".build").is_dir():
        raise DatabaseError(f"{plan.out} holds other files than a top-view database; give a new or an empty folder")
    for folder in (*FOLDERS, *ROAD_FOLDERS):
        (plan.out / folder).mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(plan.out / ".build/lock", timeout=0):
            if plan.road_by == TRAIN:
                _train(plan, objects, jobs, recipe)
            else:
                for folder in TRAINED:
                    shutil.rmtree(plan.out / folder, ignore_errors=True)
            return _build(plan, jobs, engine, workers or os.cpu_count() or 1, tuple(notes))
    except Timeout as exc:
        raise DatabaseError(f"another build is running in {plan.out}; wait for it, or stop it") from exc


def _train(plan: Plan, objects: KittiObjects, jobs: list[Job], recipe: Recipe | None) -> None:
    try:
        from ..recipe import PAPER
        from .folds import DrawnScene, train_folds
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "torch", "export", "--road-by train") from exc

    drawn = {}
    for job in jobs:
        if job.road is not None and job.fold is not None:
            with contextlib.suppress(OSError):  # reported when the scene itself is made
                drawn[job.name] = DrawnScene(job.fold, job.road, inputs_of(plan.kitti, job.name))
    folders = [plan.out / folder for folder in TRAINED]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    train_folds(objects, drawn, recipe or PAPER["lodnn"], *folders)


def _build(plan: Plan, jobs: list[Job], engine: str, workers: int, notes: tuple[str, ...]) -> Report:
    builder = SceneBuilder(plan, "warn")
    # Fold by fold, because each fold has its own road model.
    pending = [job for job in sorted(jobs, key=lambda job: (job.fold or 0, job.name)) if not builder.is_made(job)]
    (plan.out / "manifest.json").unlink(missing_ok=True)
    skipped = {}
    with tqdm(total=len(jobs), initial=len(jobs) - len(pending), desc="building", unit="scene") as bar:
        for name, reason in _made(builder, pending, engine, workers):
            bar.update()
            if reason:
                skipped[name] = reason
                bar.set_postfix(skipped=len(skipped))
    kept = len(jobs) - len(pending)
    scores = _finish(builder, [job for job in jobs if job.name not in skipped], skipped)
    return Report(len(jobs) - len(skipped), len(pending) - len(skipped), kept, skipped, scores, notes)


def _made(builder: SceneBuilder, jobs: list[Job], engine: str, workers: int) -> Iterator[tuple[str, str]]:
    """Make scenes in their order; yields each name with the reason if the scene is left out, else ""."""
    # The first scene is made in this process: warnings are shown, and errors that concern all scenes stop the build.
    n_here = len(jobs) if engine == "local" and workers == 1 else 1
    for job in jobs[:n_here]:
        yield job.name, builder(job)
    rest = jobs[n_here:]
    reasons = ENGINES[engine](SceneBuilder, (builder.plan,), rest, workers=workers)
    for job, reason in zip(rest, reasons, strict=True):
        if isinstance(reason, Lost):
            raise DatabaseError(f"scene {job.name}: {reason.reason}")
        yield job.name, reason


def _finish(builder: SceneBuilder, jobs: list[Job], skipped: dict[str, str]) -> dict[str, dict[str, float | None]]:
    """Write the indexes, delete leftovers and write the manifest, in this order; returns the scores of `Report`."""
    out = builder.plan.out
    rows: list[dict[str, Any]] = []
    road_rows: list[dict[str, Any]] = []
    counts: Counter[str] = Counter()
    confusions = {split: Confusion(CLASSES[:2]) for split in ("train", "test")}
    names, variations = {job.name for job in jobs}, set()
    for job in jobs:
        record = json.loads(builder.record_path(job.name).read_text())
        origin = {"scene": job.name, "drive": job.drive, "split": job.split, "fold": job.fold}
        rows.append({**origin, "grade": job.grade, **record["row"]})
        for row in record["variations"]:
            road_rows.append({**origin, **row})
            variations.add(row["name"])
        if record["found"]:
            confusions[job.split].counts += np.reshape(record["found"], (2, 2))
        counts.update([job.split] if job.fold is None else [job.split, f"fold {job.fold}"])
        counts.update({name: record["row"][name] for name in VEHICLES})
    sums = {
        "index.csv": _write_table(out / "index.csv", INDEX, rows),
        "road/index.csv": _write_table(out / "road/index.csv", ROAD_INDEX, road_rows),
    }
    # Partial files of a killed build, and scenes that are no longer part of the database.
    for folder, kept in [*((f, names) for f in FOLDERS), *((f, variations) for f in ROAD_FOLDERS)]:
        for path in (out / folder).iterdir():
            if path.suffix == ".part" or path.stem not in kept:
                path.unlink()
    for path in [*out.glob(".*.part"), *out.glob("road/.*.part")]:
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
        "scenes": len(jobs),
        "counts": counts,
        "skipped": skipped,
        "sha256": sums,
    }
    write_atomic(out / "manifest.json", (json.dumps(manifest, indent=1, sort_keys=True) + "\n").encode())
    return scores


def _scores(confusion: Confusion) -> dict[str, float | None]:
    """The scores of the paper's Table 1 without AP, which needs probabilities; None where a score is not defined."""
    iou = confusion.iou()[1]
    figures = {"f1": 2.0 * iou / (1.0 + iou), "accuracy": confusion.accuracy()}
    figures |= {"precision": confusion.precision()[1], "recall": confusion.recall()[1]}
    return {name: None if np.isnan(value) else round(float(value), 4) for name, value in figures.items()}


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    """Write a CSV file; returns its SHA-256."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(columns)
    table.writerows([row[name] for name in columns] for row in rows)
    content = text.getvalue().encode()
    write_atomic(path, content)
    return hashlib.sha256(content).hexdigest()
