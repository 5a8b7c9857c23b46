"""The effect of each part of the data and of the training, measured on drives outside the training set.

All variants are short runs from the same weights, which were trained on simulation alone (LoDNN's are random). Each
variant changes one setting and is evaluated on a fold of the training drives. Test drives are not used. The teachers of
the shipped models are not used either, because they may have been trained on the fold.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeperc.system.atomic import write_atomic

from ..recipe import MODELS, PAPER, Recipe
from .log import whole_lines
from .train import Data, Run, train

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
        "with the height above the ground": {"height_above_ground": True},
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
        "the front of boxes too": {"front": True},
        "the paper's slots": {"head": "slots-paper"},
    },
    # The settings that the paper of LoDNN-I varies (Electronics 12, 3165, Figure 16).
    "lodnn": {
        "as shipped": {},
        **{f"learning rate {rate:g}": {"learning_rate": rate} for rate in (1e-4, 3e-4, 1e-3, 1e-2, 3e-2)},
        **{f"scans times {share:g}": {"scans": share} for share in (0.25, 0.5, 2.0)},
        **{f"batches of {batch}": {"batch": batch} for batch in (1, 2, 8, 16)},
    },
}  # fmt: skip
PAPERS = "the paper's recipe, from nothing, as many scans"
SHIPPED = {"pointseg": "pointseg-full", "ssadnet": "ssadnet-full", "lodnn": "lodnn"}
"""Network -> the model whose recipe is varied; it can be trained without a teacher."""


def ablate(
    network: str, out: Path, data: Data, run: Run, *, steps: int, variants: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Run variants (by default all, and `PAPERS`), each of ``steps`` for the shipped batch size, from the network's
    ``-sim`` model, and write their figures into ``out/ablation.json``; a finished run is not made again, and must be of
    this data. Returns the figures of this fold and number of steps. Raises ValueError.
    """
    out.mkdir(parents=True, exist_ok=True)
    path = out / "ablation.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    of_run = {"network": network, "fold": data.fold, "steps": steps}
    shipped = replace(MODELS[SHIPPED[network]].recipe, steps=steps, distil=0.0)
    known = [*VARIANTS[network], PAPERS]
    if unknown := [variant for variant in variants if variant not in known]:
        raise ValueError(f"{network} has no variant {unknown[0]!r}; expected one of: {'; '.join(known)}")
    for variant in variants or known:
        changes = dict(VARIANTS[network].get(variant, {}))
        teacher = run.start_from if changes.pop("teacher", False) else None
        n_scans = steps * shipped.batch * changes.pop("scans", 1.0)
        recipe: Recipe = replace(shipped, **changes)
        start = run.start_from
        if variant == PAPERS:
            recipe, start = replace(PAPER[network], context_width=shipped.context_width), None
        recipe = replace(recipe, steps=max(1, int(n_scans) // recipe.batch))  # the same number of scans
        folder = out / f"{network}-{data.fold}-{steps}-{'-'.join(variant.split())}"
        train(recipe, folder, data, replace(run, start_from=start, teacher=teacher, checkpoint_every=recipe.steps))
        last = whole_lines(folder / "log.jsonl")[-1]
        if "validation" not in last:
            raise ValueError(f"{data.kitti} has no scan of fold {data.fold} to evaluate on; give another --fold")
        row = {**of_run, "variant": variant, "scans": recipe.steps * recipe.batch, "figures": last["validation"]}
        rows = [*(each for each in rows if not {**of_run, "variant": variant}.items() <= each.items()), row]
        write_atomic(path, (json.dumps(rows, indent=1) + "\n").encode())
    return [row for row in rows if of_run.items() <= row.items()]


def plot(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw the search for LoDNN's learning rate, scans and batch size, like Figure 16; ValueError without a run."""
    from matplotlib.figure import Figure

    if not any(row["variant"] == "as shipped" for row in rows):
        raise ValueError("no run of lodnn as shipped to draw; run: edgeperc-export ablate lodnn OUT")
    shipped = next(row for row in rows if row["variant"] == "as shipped")
    recipe, n = MODELS[SHIPPED["lodnn"]].recipe, shipped["scans"]
    searched = (
        ("learning rate", recipe.learning_rate, "learning rate"),
        ("scans times", 1.0, f"scans drawn, times {n}"),
        ("batches of", float(recipe.batch), f"scans in a batch, {n} in all"),
    )
    figure = Figure(figsize=(10.0, 3.2), layout="constrained")
    for axes, (prefix, usual, title) in zip(figure.subplots(1, 3, sharey=True), searched, strict=True):
        found = [(float(r["variant"].rsplit(" ", 1)[1]), r) for r in rows if r["variant"].startswith(prefix)]
        found = sorted([*found, (usual, shipped)], key=lambda each: each[0])
        values = [value for value, _ in found]
        axes.plot(values, [100.0 * row["figures"]["drivable"] for _, row in found], "o-", color="#009e73")
        axes.plot([usual], [100.0 * shipped["figures"]["drivable"]], "o", color="#202020", label="as shipped")
        axes.set(xscale="log", xlabel=title)
        axes.set_xticks(values, labels=[f"{value:g}" for value in values], minor=False, fontsize=8)
        axes.set_xticks([], minor=True)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("IoU of the road [%]")
    figure.axes[0].legend(frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})
