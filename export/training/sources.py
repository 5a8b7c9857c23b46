"""What a network is trained on and watched on: read, checked, and told by digests."""

from __future__ import annotations

import hashlib
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from filelock import FileLock  # torch needs it, too
from torch import nn

from edgeperc.datasets.kitti import KittiObjects
from edgeperc.datasets.layout import numbers_of_scene
from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.preprocess.fitness import FitnessProfile
from edgeperc.simulation.samples import IGNORE
from edgeperc.simulation.scene import POINT_CLASSES, SCENE_CLASSES
from edgeperc.types.views import TopViewGeometry

from ..data.scan_sets import Labeled, check_trains, joined, read_scan_set
from ..data.scans import LabeledScan
from ..data.simulate import simulated_files
from ..recipe import Recipe
from .camera import Camera
from .images import ImageSamples, ImageWatch, camvid_samples
from .object_batches import ObjectBatches, ObjectWatch
from .object_samples import load_samples
from .object_sets import VALIDATION, varied, write_samples
from .object_task import Objects
from .samples import Samples, Watch, real_scans
from .task import Task, task_of
from .teacher import OnnxTeacher, pseudo_labeled, teacher_network, unlabeled_scans

LABELS, SENSOR = "truth of its scans or images, or simulated scan", "sensor or labeled sector of the scans"
OBJECT_SAMPLES = "object-samples"
"""Folder beside those of the runs, with the samples of the object network."""

# Of a drive with more frames than this, every sixth is enough to validate on, because neighboring frames look alike.
FEW_FRAMES = 6
VALIDATION_STRIDE = 6
FITNESS_SCANS = 64  # real scans, at least, that a card's check of inputs describes


@dataclass(frozen=True, slots=True)
class Data:
    """What a network is trained on and watched on; frames of test drives are not used."""

    # an object set; its validation drives, or all if only simulated scans are trained on, are watched
    kitti: Path | None = None
    simulated: Path | None = None  # folder of scans written by ``edgeperc-export simulate``
    camvid: Path | None = None  # for a camera's networks: training images, and validation images for the curve
    scan_sets: Sequence[ScanFolder] = ()  # of any sensor, by their own drives
    # to train on and to watch in place of those of ``kitti``, such as with hand-drawn roads
    given: tuple[Labeled, Sequence[LabeledScan]] | None = None
    fold: int | None = None  # validated on instead of trained on, and the best weights are kept (early stopping)


class Source(NamedTuple):
    """`Data`, read."""

    samples: Samples | ImageSamples | ObjectBatches
    watch: Watch | ImageWatch | ObjectWatch | None
    hashes: dict[str, str]
    n_real: int
    made_of: dict[str, str]  # digests of what a user may have changed: `LABELS`, `SENSOR`
    watched: Mapping[str, str]  # as ``hashes``
    teacher: nn.Module | None = None
    fitness: dict[str, Any] | None = None


def read_source(
    recipe: Recipe, folder: Path, data: Data, teacher: Path | None, n_workers: int, device: torch.device
) -> Source:
    """What a recipe's network learns from; samples of objects are kept in ``folder``. Raises ValueError."""
    check_used(recipe, data, teacher)
    if recipe.task == "camera":
        return _image_source(recipe, data, device)
    if recipe.task == "objects":
        return _object_source(recipe, folder / OBJECT_SAMPLES, data, n_workers)
    return _scan_source(recipe, data, teacher, n_workers, device)


def check_used(recipe: Recipe, data: Data, teacher: Path | None = None) -> None:
    """Raise ValueError for data that a network does not learn from, which would be left out in silence."""
    of_scans = {"kitti": data.kitti, "simulated": data.simulated, "scans": data.scan_sets or None, "fold": data.fold}
    unused = {**of_scans, "teacher": teacher} if recipe.task == "camera" else {"camvid": data.camvid}
    if recipe.task == "objects":
        unused["teacher"] = teacher
    for name, value in unused.items():
        if value is not None:
            raise ValueError(f"--{name} has no effect on {recipe.network}; leave it out")


def _image_source(recipe: Recipe, data: Data, device: torch.device) -> Source:
    """The training images of CamVid; the validation images are watched."""
    if data.camvid is None:
        raise ValueError(f"no images to train {recipe.network} on; give --camvid")
    task = Camera.of(recipe)
    samples, watch = camvid_samples(task, data.camvid, device)
    labels, hashes = samples.images.labels.cpu().numpy(), samples.images.hashes
    if (labels == IGNORE).all():
        raise ValueError(
            f"no pixel of the {len(hashes)} images to train on has a class, so that nothing can be learned; see "
            f"{data.camvid / 'classes.json'}, and the ids in trainannot"
        )
    _check_apart("image", hashes, watch.images.hashes)
    made_of = {LABELS: hashlib.sha256(labels.tobytes()).hexdigest()}
    return Source(samples, watch, hashes, len(hashes), made_of, watch.images.hashes)


def _object_source(recipe: Recipe, folder: Path, data: Data, n_workers: int) -> Source:
    """Candidates of real and simulated scans, whose samples are kept in a folder; those of the fold are watched."""
    task = Objects.of(recipe)
    if not recipe.detector:
        folder = folder.with_name(f"{folder.name}-of-groups")
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / ".lock"):  # a run on other scans replaces the samples
        how = {"detector": recipe.detector, "thinned": recipe.thinned}
        hashes = write_samples(folder, data.kitti, data.simulated, data.scan_sets, n_workers, **how)
        watched = [VALIDATION if data.fold is None else f"kitti-{data.fold}"]
        trained = [name for name in hashes if name != VALIDATION and varied(name) not in watched]
        if not trained:
            raise ValueError("no scans to train objects on; give --kitti, --scans, --simulated or several of them")
        seen = {name: of for source in trained for name, of in hashes[source].items()}
        watch = ObjectWatch(task, load_samples(folder, watched)) if watched[0] in hashes else None
        truth = " ".join((folder / f"{name}.sha256").read_text() for name in trained)
        batches = ObjectBatches(task, load_samples(folder, trained), trained)
    return Source(batches, watch, seen, len(seen), {LABELS: truth}, hashes.get(watched[0], {}))


def _scan_source(recipe: Recipe, data: Data, teacher: Path | None, n_workers: int, device: torch.device) -> Source:
    """Real and simulated scans, and the teacher."""
    task, objects = task_of(recipe), KittiObjects(data.kitti) if data.kitti else None
    (real, weights, hashes), watched, seen = (*data.given, {}) if data.given else _real(recipe, objects, data)
    paths = simulated_files(data.simulated) if data.simulated else []
    seen_as = [(s.sensor and s.sensor.to_json(), np.round(s.azimuths, 4).tolist(), s.boxes_known) for s in real]
    made_of = {LABELS: _digest_of_truth(real, paths), SENSOR: hashlib.sha256(repr(seen_as).encode()).hexdigest()}
    _check_labels(task, real, simulated=bool(paths))
    teaches = None if teacher is None else _teacher(task, teacher, labels_points=objects is not None)
    if recipe.distil > 0.0 and teacher is None:
        raise ValueError(f"the recipe distils ({recipe.distil:g}) but there is no teacher; give --teacher")
    if isinstance(teaches, nn.Module) and objects is not None and recipe.distil == 0.0:
        extra = unlabeled_scans(objects, data.fold)
        real = pseudo_labeled(teaches, task, [*real, *extra])
        weights = [*weights, *(len(extra) ** -0.5 for _ in extra)]
    samples = Samples(recipe, real, weights, paths, teaches if isinstance(teaches, OnnxTeacher) else None, n_workers)
    watch = Watch(samples, watched) if watched else None
    # Every set in its share: the scans of a set follow one another.
    few = [scan.points for scan in real[:: max(1, len(real) // FITNESS_SCANS)]]
    fitness = FitnessProfile.from_scans(few).to_dict() if few else None
    network = teaches.to(device) if isinstance(teaches, nn.Module) else None
    return Source(samples, watch, hashes, len(real), made_of, seen, network, fitness)


def _teacher(task: Task, path: Path, *, labels_points: bool) -> nn.Module | OnnxTeacher:
    """The teacher to distil from, or whose network labels points. Raises ValueError for one that is not used."""
    if task.recipe.distil == 0.0 and (not labels_points or task.recipe.task != "points"):
        raise ValueError("the teacher is not used; give --distil, or train a network that labels points on --kitti")
    if path.suffix != ".onnx":
        return teacher_network(path, task)
    teacher = OnnxTeacher(path, task)
    if task.recipe.distil == 0.0:
        raise ValueError(f"{path}: an exported teacher does not label scans; give its checkpoint.pt, or --distil")
    return teacher


def _real(recipe: Recipe, kitti: KittiObjects | None, data: Data) -> tuple[Labeled, list[LabeledScan], dict[str, str]]:
    """The real scans to train on, and the scans to watch with their hashes."""
    fold = data.fold
    trained: list[Labeled] = []
    watched: list[Labeled] = []
    only_simulated = recipe.simulated_share == 1.0
    if kitti is not None:
        kitti.tell_left_out()
        names = kitti.names("train") if only_simulated else kitti.names("validation", fold=fold)
        chosen = _few_of_each_drive(names, [kitti.drives[name] for name in names])
        watched.append(real_scans(kitti, chosen, classes=recipe.classes))
        if not only_simulated:
            names = kitti.names("train", fold=fold)
            trained.append(real_scans(kitti, names, drawn=recipe.drawn_roads, classes=recipe.classes))
    for folder in data.scan_sets:
        read = partial(read_scan_set, folder, fold=fold, classes=recipe.classes or POINT_CLASSES)
        if not only_simulated:
            check_trains(folder, "train", "validation", fold=fold)
            trained.append(read("train"))
        watched.append(read("validation"))
    own, seen = joined(trained), joined(watched)
    _check_apart("scan", own.hashes, seen.hashes)
    return own, seen.scans, seen.hashes


def _check_apart(what: str, trained: Mapping[str, str], watched: Mapping[str, str]) -> None:
    """Raise ValueError if one is trained on and watched, by hashes of names."""
    names_of = {digest: name for name, digest in trained.items()}
    if twice := next((name for name, digest in watched.items() if digest in names_of), None):
        raise ValueError(
            f"the validation {what} {twice} is the training {what} {names_of[watched[twice]]}, byte for byte; its "
            "figures would be too good. Remove one, or put both drives into one split"
        )


def _check_labels(task: Task, real: Sequence[LabeledScan], *, simulated: bool) -> None:
    """Warn of classes that no scan shows, as those of a mistyped name; ValueError if none shows any."""
    view = task.view
    labels = (scan.top_view_truth(view) if isinstance(view, TopViewGeometry) else scan.labels for scan in real)
    seen = {int(label) for each in labels for label in np.unique(each)} - {IGNORE}
    if simulated:
        own = task.recipe.classes
        seen |= {*numbers_of_scene(own)[: len(SCENE_CLASSES)].tolist()} if own else {*range(len(task.classes))}
    names = "see boxes and points in scans.json, and --classes"
    if real and not seen:
        raise ValueError(
            f"no label of the {len(real)} scans to train on is of {', '.join(task.classes)}, so that nothing can be "
            f"learned; {names}"
        )
    if lacking := [name for k, name in enumerate(task.classes) if k not in seen and seen]:
        warnings.warn(f"no scan to train on has a label of {', '.join(lacking)}; {names}", stacklevel=2)


def _digest_of_truth(real: Sequence[LabeledScan], simulated: Sequence[Path]) -> str:
    """The SHA-256 of real scans' labels, and of simulated scans' names and sizes, in hexadecimal digits."""
    digest = hashlib.sha256(repr([(path.name, path.stat().st_size) for path in simulated]).encode())
    for scan in real:
        # To the centimeter, as processors differ in the last digits of what a box was moved by.
        boxes = [(box.label, np.round((*box.center, *box.size, box.yaw), 2).tolist()) for box in scan.boxes]
        digest.update(repr((boxes, scan.counts)).encode() + scan.labels.tobytes() + scan.surface.tobytes())
    return digest.hexdigest()


def _few_of_each_drive(names: Sequence[str], drives: Sequence[str]) -> list[str]:
    """The names without most frames of long drives."""
    chosen, seen, n_frames = [], Counter[str](), Counter(drives)
    for name, drive in zip(names, drives, strict=True):
        if n_frames[drive] <= FEW_FRAMES or seen[drive] % VALIDATION_STRIDE == 0:
            chosen.append(name)
        seen[drive] += 1
    return chosen
