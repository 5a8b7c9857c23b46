"""How every shipped model is made, from nothing, by one command: ``edgeperc-export make NAME OUT``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from edgeperc.evaluation.evaluate import evaluate

from .recipe import MODELS
from .simulate import fitness_of, parity_scans, simulate
from .to_onnx import export
from .train import train

__all__ = ["make"]

N_SIMULATED = 2400


def make(
    name: str,
    out: Path,
    *,
    kitti: Path | None,
    layouts: Path | None,
    semantickitti: Path | None = None,
    fold: int | None = None,
    steps: int | None = None,
    n_threads: int | None = None,
    compiled: bool = False,
    version: str = "1.0.0",
) -> Path:
    """Simulate, train, export, judge: everything a shipped model takes. What is there already is not made again.

    Parameters
    ----------
    name : str
        A key of `MODELS`.
    out : Path
        Folder for scans, checkpoints and the model.
    kitti, layouts, semantickitti : Path or None
        Roots of a KITTI object set, of its labels and calibrations alone, and of SemanticKITTI. The models called
        ``-sim`` are made without the first two, and judged on them where they are given.
    fold : int, optional
        Leave out this fold of the training drives and stop by it, as for figures over folds.
    steps : int, optional
        Another number of steps than the shipped model's, as for figures over folds.
    n_threads : int or None
    compiled : bool
        As `edgeperc_export.train.train` has it; the shipped PointSegs were, the SSADNets not.
    version : str

    Returns
    -------
    Path
        ``out/NAME.onnx``, its figures in its card.
    """
    stage = MODELS[name]
    recipe = stage.recipe if steps is None else replace(stage.recipe, steps=steps)
    simulated_only = stage.recipe.simulated_share == 1.0
    if not simulated_only and (kitti is None or layouts is None):
        raise ValueError(f"{name} is trained on real scans too; give --kitti and --layouts")
    scans = out / ("scans" if simulated_only else "scans-with-layouts")
    simulate(scans, N_SIMULATED, layouts_root=None if simulated_only else layouts)
    before: dict[str, Path | None] = {"start_from": None, "teacher": None}
    for role, other in zip(before, (stage.after, stage.teacher), strict=True):
        if other is None:
            continue
        # What a model starts or learns from must not have seen the fold either.
        base_fold = None if MODELS[other].recipe.simulated_share == 1.0 else fold
        base = out / f"{other}{_suffix(base_fold)}"
        if not base.with_suffix(".onnx").exists():
            make(
                other,
                out,
                kitti=kitti,
                layouts=layouts,
                fold=base_fold,
                n_threads=n_threads,
                compiled=compiled,
                version=version,
            )
        before[role] = base / "checkpoint.pt"
    checkpoint = train(
        recipe,
        out / f"{name}{_suffix(fold)}",
        kitti=kitti,
        simulated=scans,
        fold=fold,
        **before,
        n_threads=n_threads,
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
    fold: int | None = None,
    version: str = "1.0.0",
) -> None:
    """Export a checkpoint as a shipped model, judge the file, and write its figures into its card and beside it."""
    stage = MODELS[name]
    fitness = fitness_of(None if stage.recipe.simulated_share == 1.0 else kitti)
    facts = {"scans": parity_scans([]), "fitness": fitness, "name": name, "version": version}
    export(checkpoint, path, **facts)
    datasets = {"KITTI": kitti, "SEMANTICKITTI": semantickitti if fold is None else None, "simulation": "simulation"}
    datasets = {word: where for word, where in datasets.items() if where is not None}
    # The paper's way to a road where nobody labelled one: another network's (SSADNet 3.1.2).
    sees_road = stage.recipe.network in ("lodnn", "ssadnet") and (stage.after or stage.teacher)
    draws = "ssadnet-sim" if sees_road else None
    road_by = path.with_name(f"{draws}.onnx") if draws and kitti else None
    figures, _ = evaluate([*datasets.values()], [path], fold=fold, road_by=road_by)
    words = ["edgeperc eval", *datasets, f"--model {name}"]
    words += [f"--road-by {draws}"] * (road_by is not None) + [f"--fold {fold}"] * (fold is not None)
    figures["command"] = " ".join(words)
    path.with_suffix(".json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    export(checkpoint, path, metrics=figures, **facts)
