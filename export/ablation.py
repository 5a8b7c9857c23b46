"""What each part of the data and of the training is worth, on drives that the run has not seen.

Every variant is the same short run from the same simulation-only weights, with one thing changed, judged on a fold of
the training drives; test drives take no part.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .recipes import MODELS
from .train import PAPER, Recipe, train

__all__ = ["VARIANTS", "ablate"]

VARIANTS: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "pointseg": {
        "as shipped": {},
        "nothing pasted": {"n_pasted": 0.0},
        "no sector of another scan": {"swap": 0.0},
        "a third of what is pasted cars": {"paste_cars": 0.33},
        "never turned to a pedestrian or cyclist": {"turn_to_rare": 0.0},
        "a third of the scans turned to any side": {"turn_anywhere": 0.33},
        "no bad weather": {"weather": 0.0},
        "no change to a scan at all": {
            "augment": False, "n_pasted": 0.0, "swap": 0.0, "turn_to_rare": 0.0, "weather": 0.0,
        },
        "real scans alone": {"simulated_share": 0.0},
        "simulated scans four times of five": {"simulated_share": 0.8},
        "cross-entropy without Lovasz": {"lovasz_weight": 0.0},
        "focal loss (gamma 2)": {"focal_gamma": 2.0},
        "classes weighed alike": {"class_weights": False},
        "deep supervision (0.4)": {"deep_supervision": 0.4},
        "weights not averaged": {"ema": 0.0},
        "self-training on unlabelled scans": {"teacher": True},
        "distilled from where it starts, mirrored too": {"teacher": True, "distil": 1.0},
    },
    "ssadnet": {
        "as shipped": {},
        "nothing pasted": {"n_pasted": 0.0},
        "no change to a scan at all": {"augment": False, "n_pasted": 0.0, "weather": 0.0},
        "real scans alone": {"simulated_share": 0.0},
        "simulated scans four times of five": {"simulated_share": 0.8},
        "classes weighed alike": {"class_weights": False},
        "cross-entropy without Lovasz": {"lovasz_weight": 0.0},
        "spatial dropout (0.25)": {"dropout": 0.25},
        "batches of eight": {"batch": 8},
        "weights not averaged": {"ema": 0.0},
        "the paper's slots": {"head": "slots"},
    },
}  # fmt: skip
PAPERS = "the paper's recipe, from nothing, as many scans"


def ablate(
    network: str,
    out: Path,
    *,
    kitti: Path,
    simulated: Path,
    start_from: Path,
    fold: int,
    steps: int,
    variants: Sequence[str] = (),
    n_threads: int | None = None,
) -> list[dict[str, Any]]:
    """Run variants and add their figures to ``out/ablation.json``; those there already are not run again.

    Parameters
    ----------
    network : str
        ``"pointseg"`` or ``"ssadnet"``.
    out : Path
    kitti, simulated : Path
    start_from : Path
        Checkpoint of the network's ``-sim`` model.
    fold, steps : int
    variants : sequence of str
        Names in `VARIANTS`, or `PAPERS`; all of them by default.
    n_threads : int or None

    Returns
    -------
    list of dict
        ``network``, ``variant``, ``fold``, ``steps``, ``scans`` drawn, and ``figures`` at the end of the run.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "ablation.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    done = {(row["network"], row["variant"], row["fold"], row["steps"]) for row in rows}
    shipped = replace(MODELS[network].recipe, steps=steps)
    for variant in variants or [*VARIANTS[network], PAPERS]:
        if (network, variant, fold, steps) in done:
            continue
        changes = dict(VARIANTS[network].get(variant, {}))
        teacher = start_from if changes.pop("teacher", False) else None
        recipe: Recipe = replace(shipped, **changes)
        start: Path | None = start_from
        if variant == PAPERS:
            recipe, start = replace(PAPER[network], context_width=shipped.context_width), None
        recipe = replace(recipe, steps=max(1, steps * shipped.batch // recipe.batch))  # as many scans
        folder = out / f"{network}-{fold}-{steps}-{'-'.join(variant.split())}"
        train(
            recipe, folder, kitti=kitti, simulated=simulated, fold=fold, start_from=start, teacher=teacher,
            n_threads=n_threads, checkpoint_every=recipe.steps,
        )  # fmt: skip
        last = json.loads((folder / "log.jsonl").read_text().splitlines()[-1])
        rows.append(
            {
                "network": network,
                "variant": variant,
                "fold": fold,
                "steps": steps,
                "scans": recipe.steps * recipe.batch,
                "figures": last["validation"],
            }
        )
        path.write_text(json.dumps(rows, indent=1) + "\n")
    return rows
