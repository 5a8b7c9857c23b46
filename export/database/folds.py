"""Road models trained on hand-drawn roads, one for each fold (sections 3.5 and 3.6 of Electronics 12, 3165).

The model of a fold is trained on the drawn scenes of the other four folds and validated on those of its own. It then
finds the roads of the fold's scenes (section 3.7), so that no road comes from a model that was trained on its drive.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import onnx

from edgeperc.datasets.kitti import KittiObjects, scan_hash
from edgeperc.errors import EdgepercError
from edgeperc.types.card import ModelCard

from ..data.roads import DatabaseError, mask_of, with_road
from ..data.scan_sets import Labeled
from ..data.scans import LabeledScan
from ..recipe import Recipe
from ..release.to_onnx import export, write_card
from ..training.train import Data, train
from .files import N_FOLDS


@dataclass(frozen=True)
class DrawnScene:
    """A scene with a drawn road."""

    fold: int
    road: list[Any]  # COCO segmentations
    inputs: str  # `scenes.inputs_of`


def train_folds(objects: KittiObjects, drawn: Mapping[str, DrawnScene], recipe: Recipe, out: Path, work: Path) -> None:
    """Write ``out/fold-0.onnx`` to ``fold-4.onnx``, of drawn scenes by name; a model of the same scenes and recipe is
    not made again. Stopped runs resume from ``work``. Raises DatabaseError.
    """
    made: dict[str, Path] = {}
    if len(folds := {scene.fold for scene in drawn.values()}) < 2:
        raise DatabaseError(
            f"{len(drawn)} drawn scenes are in {len(folds)} of {N_FOLDS} folds, and the road model of a fold is made "
            "of those of the others; draw roads in more drives, or give a model with --road-by NAME"
        )
    for fold in range(N_FOLDS):
        trained_on = {name: scene for name, scene in sorted(drawn.items()) if scene.fold != fold}
        held_out = {name: scene for name, scene in sorted(drawn.items()) if scene.fold == fold}
        parts = [{name: asdict(scene) for name, scene in part.items()} for part in (trained_on, held_out)]
        key = hashlib.sha256(json.dumps([asdict(recipe), *parts], sort_keys=True).encode()).hexdigest()
        model, made_of = out / f"fold-{fold}.onnx", work / f"fold-{fold}.sha256"
        if model.exists() and made_of.exists() and made_of.read_text() == key:
            made[key] = model
            continue
        made_of.unlink(missing_ok=True)
        name = f"{recipe.network}-fold-{fold}"
        if key in made:  # folds without a drawn scene share a model
            write_card(onnx.load(made[key]), replace(ModelCard.read(made[key]), name=name), model)
            made_of.write_text(key)
            continue
        made[key] = model
        scans, watched = _labeled(objects, trained_on), _labeled(objects, held_out)
        hashes = {name: scan_hash(scan.points) for name, scan in scans.items()}
        given = Labeled([*scans.values()], [1.0] * len(scans), hashes)
        checkpoint = train(recipe, work / key, Data(given=(given, [*watched.values()])))
        proof = [scan.points for scan in scans.values()][:4]
        export(checkpoint, model, scans=proof, name=name)
        made_of.write_text(key)
    for folder in work.iterdir():
        if folder.is_dir():
            shutil.rmtree(folder)


def _labeled(objects: KittiObjects, drawn: Mapping[str, DrawnScene]) -> dict[str, LabeledScan]:
    """Name -> scan with its drawn road as ground truth; scans that cannot be read are left out."""
    found = {}
    for name, scene in drawn.items():
        try:
            scan = LabeledScan.from_frame(objects.frame(name))
        except (EdgepercError, ValueError, OSError):
            continue  # reported when the scene itself is made
        found[name] = replace(scan, surface=with_road(scan.surface, mask_of(scene.road, name)))
    return found
