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
import multiprocessing
import os
import shutil
import signal
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from filelock import FileLock, Timeout
from numpy.typing import NDArray
from tqdm import tqdm

from edgeperc import Perceiver, __version__
from edgeperc.card import TopViewGeometry
from edgeperc.datasets import KittiObjects, scan_hash
from edgeperc.errors import CardMismatchError, EdgepercError, MissingExtraError
from edgeperc.metrics import Confusion
from edgeperc.models import model_path
from edgeperc.sensors import get_sensor
from edgeperc.splits import TEST_DRIVES

from .road_polygons import mask_of, read_coco, varied
from .topview_database import (
    CLASSES,
    FARTHEST_M,
    FORMAT,
    HEIGHT,
    N_FOLDS,
    VEHICLES,
    VIEW,
    WIDTH,
    Z_RANGE_M,
    DatabaseError,
    picture,
    png,
    road_and_vehicles,
    vehicles,
    write_labels,
)

if TYPE_CHECKING:
    from .train import Recipe

__all__ = ["Plan", "Report", "RoadModel", "SceneBuilder", "build", "folds"]

INDEX = (
    "scene", "drive", "grade", "split", "fold", "points", "cells_returned", *VEHICLES,
    *(f"{name}_cells" for name in CLASSES[1:]), "road", "scan_sha256", "image_sha256", "label_sha256", "map_sha256",
)  # fmt: skip
ROAD_INDEX = (
    "name", "scene", "drive", "split", "fold", "turn_deg", "mirrored", "road_cells", "image_sha256", "mask_sha256"
)  # fmt: skip
FOLDERS = {"images": "png", "labels": "txt", "maps": "png", ".build/records": "json"}
ROAD_FOLDERS = {"road/images": "png", "road/masks": "png"}
# Tasks on their way to each worker: enough to keep it busy, few enough that memory stays flat.
AHEAD = 4
TRAIN, TRAINED = "train", ("road/models", ".build/road")


@dataclass(frozen=True)
class Plan:
    """What a database is made of, apart from the scenes.

    Attributes
    ----------
    kitti, out : Path
        Roots of the KITTI object set and of the database; on a Ray cluster, as every computer of it sees them.
    road_by : str
        What finds the roads that nobody drew: a shipped model's name, the path of an .onnx with a card, or ``"train"``,
        a model for every fold, taught by the roads that were drawn in the others.
    sensor : str
        Where the points come from (`edgeperc.sensors.SENSORS`).
    provider : str
        See `edgeperc.Perceiver`; what ``"auto"`` takes may change from one day to the next, and roads with it.
    variations : int
        How many variations of every drawn training scene to add (section 3.4).
    """

    kitti: Path
    out: Path
    road_by: str = "lodnn"
    sensor: str = "hdl-64e"
    provider: str = "cpu"
    variations: int = 8

    def road_model(self, fold: int | None) -> str:
        """The model that finds the roads of a fold's scenes; the first fold's has not seen the test scenes either."""
        return str(self.out / f"road/models/fold-{fold or 0}.onnx") if self.road_by == TRAIN else self.road_by


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


@dataclass(frozen=True)
class Task:
    """One scene to be made."""

    name: str
    drive: str
    grade: str
    split: str
    fold: int | None
    road: list[Any] | None = field(default=None)


class RoadModel:
    """Road maps by a network (section 3.7).

    Parameters
    ----------
    plan : Plan
    model : str
        As `Plan.road_model` gives it.
    on_mismatch : {"warn", "ignore"}
        What to do when the scans are unlike those the model was trained on.

    Raises
    ------
    CardMismatchError
        The model sees no top view of these cells, or knows no drivable ground.
    """

    def __init__(self, plan: Plan, model: str, on_mismatch: Literal["warn", "ignore"]) -> None:
        # One thread each: scenes are made side by side.
        self.perceive = Perceiver(
            model, sensor=plan.sensor, provider=plan.provider, n_threads=1, on_mismatch=on_mismatch
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
                f"{model} sees x {view.x_range_m}, y {view.y_range_m} in cells of {view.cell_m} m; expected the "
                f"database's x {VIEW.x_range_m}, y {VIEW.y_range_m} in cells of {VIEW.cell_m} m, give or take a cell"
            )
        content = (Path(model) if Path(model).suffix == ".onnx" else model_path(model)).read_bytes()
        self.facts = {
            "name": card.name,
            "version": card.version,
            "sha256": hashlib.sha256(content).hexdigest(),
            "provider": self.perceive.providers[card.name],
        }

    def __call__(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Road of a scan, (400, 200) bool."""
        # A scan moved by as much as the views are apart falls into the model's cells as it does into the database's.
        top_view = self.perceive(points + self._shift.astype(np.float32)).top_view
        assert top_view is not None
        return top_view.drivable


class SceneBuilder:
    """Makes one scene after another: steps 3.1 to 3.4, 3.7 and 3.8.

    Parameters
    ----------
    plan : Plan
    on_mismatch : {"warn", "ignore"}
        Passed to `RoadModel`.
    """

    def __init__(self, plan: Plan, on_mismatch: Literal["warn", "ignore"] = "ignore") -> None:
        self.plan = plan
        self.objects = KittiObjects(plan.kitti)
        self.sensor = get_sensor(plan.sensor)
        self.facts: dict[str, dict[str, str]] = {}
        self._on_mismatch = on_mismatch
        self._road_model: RoadModel | None = None

    def road_model(self, fold: int | None) -> RoadModel:
        """The road model of a fold. One is held at a time, for scenes come fold by fold."""
        path = self.plan.road_model(fold)
        if self._road_model is None or self._road_model.path != path:
            self._road_model = RoadModel(self.plan, path, self._on_mismatch)
            self.facts[path] = self._road_model.facts
        return self._road_model

    def is_made(self, task: Task) -> bool:
        """Whether the scene lies there, made of the same inputs by the same settings."""
        facts = self.road_model(task.fold).facts
        try:
            record = json.loads(self.record_path(task.name).read_text())
            files = [self.plan.out / folder / f"{task.name}.{suffix}" for folder, suffix in FOLDERS.items()]
            files += [self._variation(folder, row["name"]) for row in record["variations"] for folder in ROAD_FOLDERS]
            return bool(record["key"] == self._key(task, facts)) and all(path.exists() for path in files)
        except (OSError, ValueError, KeyError, TypeError):
            return False  # a missing or foreign record: the scene is made again

    def __call__(self, task: Task) -> str:
        """Make a scene; why it was left out, or nothing.

        Raises
        ------
        OSError
            Its files cannot be written.
        """
        try:
            frame = self.objects.frame(task.name)
            boxes = vehicles(frame.boxes)
        except (EdgepercError, ValueError, OSError) as exc:
            # Without the root, so that the same set gives the same database wherever it lies.
            return (str(exc) or type(exc).__name__).replace(f"{self.plan.kitti}{os.sep}", "")
        image = picture(frame.points, self.sensor.remission_offset, self.sensor.remission_scale)
        model = self.road_model(task.fold)
        found = model(frame.points)
        drawn = None if task.road is None else mask_of(task.road, task.name) != 0
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
            row[f"{kind}_sha256"] = self._write(self.plan.out / folder / f"{task.name}.{suffix}", content)
        record = {
            "key": self._key(task, model.facts),
            "row": row,
            "variations": [] if drawn is None else list(self._vary(task, image, drawn)),
            "found": None if drawn is None else np.bincount((2 * drawn + found).ravel(), minlength=4).tolist(),
        }
        self._write(self.record_path(task.name), json.dumps(record, sort_keys=True).encode())
        return ""

    def _vary(self, task: Task, image: NDArray[np.uint8], road: NDArray[np.bool_]) -> Iterator[dict[str, Any]]:
        # Test scenes are set apart before augmentation (section 3.4, Figure 12): they are there as they are.
        for k in range(1 + (self.plan.variations if task.split == "train" else 0)):
            moved, mask, turn_deg, mirrored = varied(image, road.astype(np.uint8), task.name, k)
            name = f"{task.name}-{k:02d}"
            row = {"name": name, "turn_deg": turn_deg, "mirrored": int(mirrored)}
            row["road_cells"] = int(np.count_nonzero(mask == 1))
            row["image_sha256"] = self._write(self._variation("road/images", name), png(moved))
            row["mask_sha256"] = self._write(self._variation("road/masks", name), png(mask))
            yield row

    def record_path(self, name: str) -> Path:
        """Where a finished scene's record lies."""
        return self.plan.out / ".build/records" / f"{name}.json"

    def _variation(self, folder: str, name: str) -> Path:
        return self.plan.out / folder / f"{name}.{ROAD_FOLDERS[folder]}"

    def _key(self, task: Task, model: dict[str, str]) -> str:
        """Changes when anything does that the scene is made of."""
        facts = [
            FORMAT, model, asdict(self.sensor), self.plan.variations, task.name, task.split, task.road,
            inputs_of(self.plan.kitti, task.name),
        ]  # fmt: skip
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    def _write(self, path: Path, content: bytes) -> str:
        write_aside(path, content)
        return hashlib.sha256(content).hexdigest()


def inputs_of(kitti: Path, name: str) -> str:
    """Changes when a scene's files do; the scan, which is large, goes by its size."""
    training = kitti / "training"
    small = [training / "label_2" / f"{name}.txt", training / "calib" / f"{name}.txt"]
    facts = [hashlib.sha256(path.read_bytes()).hexdigest() for path in small]
    return f"{' '.join(facts)} {(training / 'velodyne' / f'{name}.bin').stat().st_size}"


def write_aside(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    aside.write_bytes(content)
    aside.replace(path)


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
        Drives to set apart, besides `edgeperc.splits.TEST_DRIVES`.
    recipe : edgeperc_export.train.Recipe, optional
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
        from .road_folds import DrawnScene, train_folds
        from .train import PAPER
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
        for name, reason in _run(builder, pending, engine, workers):
            bar.update()
            if reason:
                skipped[name] = reason
                bar.set_postfix(skipped=len(skipped))
    kept = len(tasks) - len(pending)
    scores = _finish(builder, [task for task in tasks if task.name not in skipped], skipped)
    return Report(len(tasks) - len(skipped), len(pending) - len(skipped), kept, skipped, scores, notes)


def _run(builder: SceneBuilder, tasks: list[Task], engine: str, workers: int) -> Iterator[tuple[str, str]]:
    """Make scenes in any order: their names, and why they were left out."""
    # The first is made here: it warns where scan and model do not go together, and stops what would fail everywhere.
    for task in tasks[:1]:
        yield task.name, builder(task)
    rest = tasks[1:]
    if not rest:
        return
    if engine == "ray":
        yield from _run_on_ray(builder.plan, rest, workers)
    elif workers == 1:
        yield from ((task.name, builder(task)) for task in rest)
    else:
        yield from _run_in_processes(builder.plan, rest, workers)


def _run_in_processes(plan: Plan, tasks: list[Task], workers: int) -> Iterator[tuple[str, str]]:
    # Spawned, as a fork of a process that runs an onnxruntime may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(tasks)), context, _start_worker, (plan,))
    try:
        left = iter(tasks)
        waiting: dict[Future[str], str] = {}
        while True:
            for task in left:
                waiting[pool.submit(_make_scene, task)] = task.name
                if len(waiting) >= AHEAD * workers:
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except BrokenProcessPool as exc:
        raise DatabaseError(
            f"a worker of {workers} was killed, as where memory runs out; build again to go on, with fewer --workers"
        ) from exc
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(plan: Plan) -> None:
    global _builder
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted too, and stops the workers in order
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _builder = SceneBuilder(plan)


def _die_with_parent() -> None:
    # A worker of a killed parent would wait for its next task for ever, and write until then.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _make_scene(task: Task) -> str:
    return _builder(task)


_builder: SceneBuilder


class RayWorker:
    """`SceneBuilder` as ``ray.data`` calls it: a row in, a row out, tasks as JSON for they are of uneven shape."""

    def __init__(self, plan: Plan) -> None:
        self.builder = SceneBuilder(plan)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Make one scene."""
        task = Task(**json.loads(row["task"]))
        return {"scene": task.name, "reason": self.builder(task)}


def _run_on_ray(plan: Plan, tasks: list[Task], workers: int) -> Iterator[tuple[str, str]]:
    try:
        import ray
        import ray.data
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "ray", "ray", "--engine ray") from exc

    ours = not ray.is_initialized()
    if ours:
        cores = None if "RAY_ADDRESS" in os.environ else workers
        ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        ray.data.DataContext.get_current().enable_progress_bars = False
        rows = ray.data.from_items(
            [{"task": json.dumps(asdict(task))} for task in tasks], override_num_blocks=min(len(tasks), 16 * workers)
        )
        done = rows.map(RayWorker, fn_constructor_args=(plan,), num_cpus=1, concurrency=min(workers, len(tasks)))
        for row in done.iter_rows():
            yield str(row["scene"]), str(row["reason"])
    finally:
        if ours:
            ray.shutdown()


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
