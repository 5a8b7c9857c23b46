"""Make a shipped model from scratch: ``edgeperc-export make NAME OUT``."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import onnx

from edgeperc.evaluation.camvid import evaluate_images
from edgeperc.evaluation.evaluate import NETWORK_ALONE, evaluate

from .data.simulate import parity_samples, simulate
from .recipe import MODELS
from .release.object_parity import object_figures
from .release.to_onnx import export, write_card
from .training.sources import check_used
from .training.train import Data, Run, train

N_SIMULATED = 2400
OBJECT_SENSORS = ("hdl-64e", "pandar64", "vlp-16", "os1-64")
MORE_SCANS: Mapping[str, tuple[int, Mapping[str, int], str]] = {
    "sensors": (10_000, dict.fromkeys(("pandar64", "vlp-32c", "vlp-16"), 200), "street"),
    "six-sensors": (
        20_000,
        dict.fromkeys(("vlp-16", "vlp-32c", "hdl-32e", "os1-64", "pandar64", "mid-360"), 200),
        "street",
    ),
    "sparse": (30_000, {"vlp-16": 700, "vlp-32c": 400, "hdl-32e": 200, "mid-360": 200}, "street"),
    "halls": (600_000, dict.fromkeys(OBJECT_SENSORS, 90), "hall"),
    "yards": (700_000, dict.fromkeys(OBJECT_SENSORS, 120), "yard"),
}
"""Simulated scans beside those of the training sensor: the first seed, how many of each sensor, and where."""
# What a card holds of the figures of a source; `edgeperc eval` prints the rest, which is four times as long.
CARD_FIGURES = ("n_frames", "n_drives", "points", "boxes", "segmentation", "road")
ROAD_TRUTH = "ssadnet-sim"
"""Model whose road is the ground truth of KITTI's scans, which have no road labels."""


def make(
    name: str,
    out: Path,
    data: Data,
    run: Run,
    *,
    layouts: Path | None = None,
    semantickitti: Path | None = None,
    steps: int | None = None,
    version: str = "1.0.0",
) -> Path:
    """Simulate, train, export and evaluate a model of `MODELS`, ``out/NAME.onnx``, after those that it starts from or
    is distilled from; finished parts are not made again. Open models, and those whose name ends in ``-sim``, take
    ``data.kitti`` for evaluation only; ``layouts`` holds KITTI's labels and calibrations alone.
    """
    stage = MODELS[name]
    recipe = stage.recipe if steps is None else replace(stage.recipe, steps=steps)
    fold, without_kitti = data.fold, stage.is_open or stage.recipe.simulated_share == 1.0
    evaluated = data
    check_used(recipe, data)
    if recipe.task != "camera":
        if not without_kitti and (data.kitti is None or layouts is None):
            raise ValueError(f"{name} is trained on real scans too; give --kitti and --layouts")
        if without_kitti:
            layouts = None
        scans = out / ("scans" if without_kitti else "scans-with-layouts")
        simulate(scans, N_SIMULATED, layouts_root=layouts, n_workers=run.n_workers)
        scans = _with_more(out, scans, layouts, stage.also, run.n_workers)
        data = replace(data, simulated=scans, kitti=None if stage.is_open else data.kitti)

    def checkpoint_of(other: str | None) -> Path | None:
        if other is None:
            return None
        # The models that this one starts from or is distilled from must not be trained on the fold either.
        own_fold = None if MODELS[other].recipe.simulated_share == 1.0 else fold
        base = out / f"{other}{_suffix(own_fold)}"
        # The figures are written last; those of objects need KITTI.
        last = ".onnx" if MODELS[other].recipe.task == "objects" and data.kitti is None else ".json"
        if not base.with_suffix(last).exists():
            make(other, out, replace(data, fold=own_fold), run, layouts=layouts, version=version)
        return base / "checkpoint.pt"

    run = replace(run, start_from=checkpoint_of(stage.after), teacher=checkpoint_of(stage.teacher))
    path = out / f"{name}{_suffix(fold)}.onnx"
    checkpoint = train(recipe, path.with_suffix(""), data, run)
    finish(name, checkpoint, path, replace(data, kitti=evaluated.kitti), semantickitti=semantickitti, version=version)
    return path


def _with_more(out: Path, scans: Path, layouts: Path | None, also: Sequence[str], n_workers: int) -> Path:
    """A folder of the simulated scans and those of `MORE_SCANS`."""
    if not also:
        return scans
    every = out / "-and-".join([scans.name, *also])
    every.mkdir(parents=True, exist_ok=True)
    for name in also:
        first, sensors, where = MORE_SCANS[name]
        write = partial(simulate, every, where=where, n_workers=n_workers)
        for k, (sensor, n) in enumerate(sensors.items()):
            write(n, first=first + 1000 * k, sensor=sensor, layouts_root=layouts if where == "street" else None)
    for file in scans.glob("*.npz"):
        if not (every / file.name).exists():
            (every / file.name).symlink_to(file.resolve())
    return every


def _suffix(fold: int | None) -> str:
    return "" if fold is None else f"-fold{fold}"


def finish(
    name: str, checkpoint: Path, path: Path, data: Data, *, semantickitti: Path | None = None, version: str = "1.0.0"
) -> None:
    """Export a checkpoint as the model ``name`` to an .onnx file, evaluate it, and write the figures into its card and
    a JSON file beside it. If ``ssadnet-sim.onnx`` is in the same folder, its road is the ground truth of KITTI's scans.
    """
    stage, kitti, fold = MODELS[name], data.kitti, data.fold
    task = stage.recipe.task
    card = export(checkpoint, path, scans=parity_samples(task), name=name, version=version)
    figures: dict[str, Any]
    if task == "camera":
        assert data.camvid is not None
        figures = evaluate_images([data.camvid], path, split="validation")
        command = f"edgeperc eval CAMVID --split validation --model {name}:fp32"
    elif task == "objects":
        if kitti is None:
            return
        figures, command = object_figures(kitti, path, f"{name}:fp32", fold)
    else:
        datasets: dict[str, str | Path] = {"KITTI": kitti} if kitti is not None else {}
        if semantickitti is not None and fold is None:
            datasets["SEMANTICKITTI"] = semantickitti
        datasets["simulation"] = "simulation"
        # SSADNet 3.1.2 takes another network's road as ground truth where no road is labeled.
        truth = path.with_name(f"{ROAD_TRUTH}.onnx")
        learned_road = "drivable" in card.classes and kitti is not None and path != truth and truth.exists()
        road_by = truth if learned_road else None
        # The figures of a card are of its network alone.
        figures, _ = evaluate([*datasets.values()], [path], NETWORK_ALONE, fold=fold, road_by=road_by)
        options = [f"--road-by {ROAD_TRUTH}"] * learned_road + [f"--fold {fold}"] * (fold is not None)
        command = " ".join(["edgeperc eval", *datasets, f"--model {name}", *options, "--no-agreement"])
        for source in {"real", "semantickitti", "simulated"} & figures.keys():
            figures[source] = {name: of for name, of in figures[source].items() if name in CARD_FIGURES}
    figures |= {"command": command}
    path.with_suffix(".json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    write_card(onnx.load(path), replace(card, metrics=figures), path)
