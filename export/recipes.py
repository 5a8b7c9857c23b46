"""How every shipped model is made, from nothing, by one command: ``edgeperc-export make NAME OUT``."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

from edgeperc.evaluate import evaluate

from .dataset import fitness_of, parity_scans, simulate
from .to_onnx import export
from .train import Recipe, train

__all__ = ["MODELS", "Stage", "make"]

N_SIMULATED = 2400


@dataclass(frozen=True)
class Stage:
    """One training run on the way to a model.

    Attributes
    ----------
    recipe : Recipe
        One whose ``simulated_share`` is 1 sees no real scan and no real layout, and owes nothing to anybody's terms.
    after : str or None
        The model whose weights the run starts from.
    teacher : str or None
        The model that the run learns from.
    """

    recipe: Recipe
    after: str | None = None
    teacher: str | None = None


# From nothing, and with its teacher's answers from the first step on: the focal loss is SqueezeSegV2's.
KULSEG = Recipe("kulseg", steps=3600, batch=4, focal_gamma=2.0, distil=1.0, seen_twice=False)
# Batches of four: for as many scans twice the steps, and better figures. SSADNet without dropout, which a network that
# sees so few scans does not need, and which upsets batch norm.
SSADNET = Recipe("ssadnet", batch=4, learning_rate=1.5e-3, context_width=64, n_pasted=3.0, dropout=0.0)
EDGE = Recipe("ssadnet", edge=True, steps=6000, batch=4, learning_rate=3e-3, cooldown=0.2, n_pasted=3.0)
TAUGHT = replace(EDGE, steps=1000, learning_rate=1e-3, cooldown=0.4, distil=1.0, seen_twice=False)
# LoDNN-I's plan at a quarter of the resolution, with the answers of the network that draws roads best from the start.
LODNN = Recipe(
    "lodnn",
    edge=True,
    steps=4500,
    batch=4,
    learning_rate=3e-3,
    n_pasted=3.0,
    distil=1.0,
    seen_twice=False,
    drawn_roads=True,
)
MODELS = {
    "pointseg-sim": Stage(Recipe("pointseg", simulated_share=1.0, steps=1000, learning_rate=2e-3, cooldown=0.3)),
    "pointseg": Stage(Recipe("pointseg", steps=3600, batch=4, learning_rate=1e-3), after="pointseg-sim"),
    "kulseg-start": Stage(KULSEG, teacher="pointseg"),
    # Trained on without the focal loss, which on top of class weights makes too many pixels a pedestrian's.
    "kulseg": Stage(
        replace(KULSEG, steps=1500, learning_rate=1e-3, cooldown=0.6, focal_gamma=0.0), "kulseg-start", "pointseg"
    ),
    "ssadnet-sim": Stage(replace(SSADNET, simulated_share=1.0, steps=1300, cooldown=0.3)),
    "ssadnet": Stage(replace(SSADNET, steps=2000), after="ssadnet-sim"),
    # On the very segmentation branch of ssadnet, so that the heads can be compared.
    "ssadnet-paper": Stage(replace(SSADNET, head="slots", head_only=True, steps=1000), after="ssadnet"),
    # A step of a network for small computers takes a quarter of the full one's, a step with its teacher's answers as
    # long: first many on labels alone, then some with both.
    "pointseg-edge-start": Stage(replace(EDGE, network="pointseg", n_pasted=6.0)),
    "pointseg-edge": Stage(
        replace(TAUGHT, network="pointseg", n_pasted=6.0, steps=1600), "pointseg-edge-start", "pointseg"
    ),
    "lodnn": Stage(LODNN, teacher="ssadnet-edge"),
    "ssadnet-edge-start": Stage(EDGE),
    "ssadnet-edge": Stage(TAUGHT, "ssadnet-edge-start", "ssadnet"),
}


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
