"""Make a shipped model from scratch: ``edgeperc-export make NAME OUT``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx

from edgeperc.datasets.scan_folder import ScanFolder
from edgeperc.evaluation.camvid import evaluate_images
from edgeperc.evaluation.evaluate import evaluate
from edgeperc.types.card import ModelCard

from .data.simulate import fitness_of, parity_images, parity_scans, simulate
from .recipe import MODELS
from .release.to_onnx import export, write_card
from .training.train import train

N_SIMULATED = 2400
SOURCES = {"real", "semantickitti", "simulated"}
# What a card holds of the figures of a source; `edgeperc eval` prints the rest, which is four times as long.
CARD_FIGURES = ("n_frames", "n_drives", "points", "boxes", "segmentation", "road")
ROAD_TRUTH = "ssadnet-sim"
"""Model whose road is the ground truth of KITTI's scans, which have no road labels."""


def make(
    name: str,
    out: Path,
    *,
    kitti: Path | None,
    layouts: Path | None,
    semantickitti: Path | None = None,
    camvid: Path | None = None,
    scan_sets: Sequence[ScanFolder] = (),
    fold: int | None = None,
    steps: int | None = None,
    n_threads: int | None = None,
    n_workers: int = 0,
    compiled: bool = False,
    version: str = "1.0.0",
) -> Path:
    """Simulate, train, export and evaluate a model. Finished parts are not made again.

    name : a key of `MODELS`. The models that it starts from or is distilled from are made first.
    out : folder for scans, checkpoints and models.
    kitti, layouts, semantickitti : folders of a KITTI object set, of its labels and calibrations alone, and of
        SemanticKITTI. Models whose name ends in ``-sim`` need none of them; ``kitti`` then serves for evaluation
        only.
    camvid : folder of CamVid, which the network of a camera is trained and evaluated on; it needs nothing else.
    scan_sets : more real scans to train on.
    fold : validate on this fold of the training drives, and do not train on it.
    steps : number of training steps; by default the shipped model's.
    compiled : as for `edgeperc_export.training.train.train`.
    version : version to write into the card.
    Returns: ``out/NAME.onnx``, with its figures in its card.
    Raises ValueError.
    """
    stage = MODELS[name]
    recipe = stage.recipe if steps is None else replace(stage.recipe, steps=steps)
    if recipe.task == "camera":
        checkpoint = train(
            recipe, out / name, kitti=None, simulated=None, camvid=camvid, n_threads=n_threads, compiled=compiled
        )
        finish(name, checkpoint, out / f"{name}.onnx", kitti=None, semantickitti=None, camvid=camvid, version=version)
        return out / f"{name}.onnx"
    simulated_only = stage.recipe.simulated_share == 1.0
    if not simulated_only and (kitti is None or layouts is None):
        raise ValueError(f"{name} is trained on real scans too; give --kitti and --layouts")
    scans = out / ("scans" if simulated_only else "scans-with-layouts")
    simulate(scans, N_SIMULATED, layouts_root=None if simulated_only else layouts, n_workers=n_workers)

    def checkpoint_of(other: str) -> Path:
        # The models that this one starts from or is distilled from must not be trained on the fold either.
        own_fold = None if MODELS[other].recipe.simulated_share == 1.0 else fold
        base = out / f"{other}{_suffix(own_fold)}"
        if not base.with_suffix(".onnx").exists():
            make(
                other,
                out,
                kitti=kitti,
                layouts=layouts,
                scan_sets=scan_sets,
                fold=own_fold,
                n_threads=n_threads,
                n_workers=n_workers,
                compiled=compiled,
                version=version,
            )
        return base / "checkpoint.pt"

    checkpoint = train(
        recipe,
        out / f"{name}{_suffix(fold)}",
        kitti=kitti,
        simulated=scans,
        scan_sets=scan_sets,
        fold=fold,
        start_from=None if stage.after is None else checkpoint_of(stage.after),
        teacher=None if stage.teacher is None else checkpoint_of(stage.teacher),
        n_threads=n_threads,
        n_workers=n_workers,
        compiled=compiled,
    )
    path = out / f"{name}{_suffix(fold)}.onnx"
    finish(name, checkpoint, path, kitti=kitti, semantickitti=semantickitti, fold=fold, version=version)
    return path


def _suffix(fold: int | None) -> str:
    return "" if fold is None else f"-fold{fold}"


def finish(
    name: str,
    checkpoint: Path,
    path: Path,
    *,
    kitti: Path | None,
    semantickitti: Path | None,
    camvid: Path | None = None,
    fold: int | None = None,
    version: str = "1.0.0",
) -> None:
    """Export a checkpoint, evaluate the file, and write the figures into its card and a JSON file beside it.

    name : a key of `MODELS`, and the name of the model.
    path : the .onnx file to write. The JSON file has the same name, but ends in .json. If ``ssadnet-sim.onnx`` is in
        the same folder, its road is the ground truth of KITTI's scans.
    kitti, semantickitti, camvid, fold, version : as for `make`.
    """
    stage = MODELS[name]
    if stage.recipe.task == "camera":
        assert camvid is not None
        card = export(checkpoint, path, scans=parity_images([]), fitness=None, name=name, version=version)
        figures = evaluate_images([camvid], path, split="validation")
        _write_figures(
            path, card, figures | {"command": f"edgeperc eval CAMVID --split validation --model {name}:fp32"}
        )
        return
    fitness = fitness_of(None if stage.recipe.simulated_share == 1.0 else kitti)
    card = export(checkpoint, path, scans=parity_scans([]), fitness=fitness, name=name, version=version)
    datasets: dict[str, str | Path] = {"simulation": "simulation"}
    if semantickitti is not None and fold is None:
        datasets = {"SEMANTICKITTI": semantickitti, **datasets}
    if kitti is not None:
        datasets = {"KITTI": kitti, **datasets}
    # SSADNet 3.1.2 takes another network's road as ground truth where no road is labeled.
    truth = path.with_name(f"{ROAD_TRUTH}.onnx")
    learned_road = "drivable" in card.classes and kitti is not None and path != truth and truth.exists()
    road_by = truth if learned_road else None
    # The figures of a card are of its network alone.
    figures, _ = evaluate([*datasets.values()], [path], fold=fold, road_by=road_by, boxes_from="network", rules=())
    command = ["edgeperc eval", *datasets, f"--model {name}"]
    command += [f"--road-by {ROAD_TRUTH}"] if road_by else []
    command += [f"--fold {fold}"] if fold is not None else []
    command += ["--no-agreement"]
    for source in SOURCES & figures.keys():
        figures[source] = {name: of for name, of in figures[source].items() if name in CARD_FIGURES}
    _write_figures(path, card, figures | {"command": " ".join(command)})


def _write_figures(path: Path, card: ModelCard, figures: dict[str, Any]) -> None:
    """Write figures into a model's card and into the JSON file beside it."""
    path.with_suffix(".json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    write_card(onnx.load(path), replace(card, metrics=figures), path)
