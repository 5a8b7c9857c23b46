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
    """

    recipe: Recipe
    after: str | None = None


SIMULATED_ONLY = Recipe("pointseg", simulated_share=1.0, steps=1400, learning_rate=2e-3, cooldown=0.3)
MODELS = {
    "pointseg-sim": Stage(SIMULATED_ONLY),
    "pointseg": Stage(Recipe("pointseg", steps=500, learning_rate=1e-3, cooldown=0.6), after="pointseg-sim"),
    "ssadnet-sim": Stage(
        replace(SIMULATED_ONLY, network="ssadnet", steps=900, learning_rate=1.5e-3, context_width=64, n_pasted=2.0)
    ),
    "ssadnet": Stage(
        Recipe("ssadnet", steps=400, learning_rate=1e-3, cooldown=0.6, context_width=64, n_pasted=2.0),
        after="ssadnet-sim",
    ),
    "ssadnet-paper": Stage(
        Recipe("ssadnet", head="slots", steps=500, learning_rate=1e-3, cooldown=0.6, context_width=64, n_pasted=2.0),
        after="ssadnet-sim",
    ),
}


def make(
    name: str,
    out: Path,
    *,
    kitti: Path | None,
    layouts: Path | None,
    semantickitti: Path | None = None,
    fold: int | None = None,
    n_threads: int | None = None,
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
    n_threads : int or None
    version : str

    Returns
    -------
    Path
        ``out/NAME.onnx``, its figures in its card.
    """
    stage = MODELS[name]
    simulated_only = stage.recipe.simulated_share == 1.0
    if not simulated_only and (kitti is None or layouts is None):
        raise ValueError(f"{name} is trained on real scans too; give --kitti and --layouts")
    scans = out / ("scans" if simulated_only else "scans-with-layouts")
    simulate(scans, N_SIMULATED, layouts_root=None if simulated_only else layouts)
    start_from = None
    if stage.after is not None:
        make(stage.after, out, kitti=kitti, layouts=None, n_threads=n_threads, version=version)
        start_from = out / stage.after / "checkpoint.pt"
    suffix = "" if fold is None else f"-fold{fold}"
    checkpoint = train(
        stage.recipe,
        out / f"{name}{suffix}",
        kitti=kitti,
        simulated=scans,
        fold=fold,
        start_from=start_from,
        n_threads=n_threads,
    )
    path = out / f"{name}{suffix}.onnx"
    facts = {"scans": parity_scans([]), "fitness": fitness_of(None if simulated_only else kitti), "version": version}
    export(checkpoint, path, name=name, **facts)
    judged = [root for root in (kitti, semantickitti) if root is not None and (root == kitti or fold is None)]
    figures, _ = evaluate([*judged, "simulation"], [path], fold=fold)
    path.with_suffix(".json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    export(checkpoint, path, name=name, metrics=figures, **facts)
    return path
