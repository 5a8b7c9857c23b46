"""Eleven networks compared on CamVid, as in table 4 of Jebamikyous (2021), under one budget that is the same for all.

Each network is trained from random weights by the paper's protocol (Adam, categorical cross-entropy, images divided by
255, no augmentation) with the same images in the same order, for a fixed number of epochs. Early stopping would give
each network another budget, so there is none, and the weights evaluated are the last ones. Figures follow the paper's
equations 1 to 6 over the labeled pixels of all validation images at their own size. The paper has 32 classes at 512 x
512 and its test images; here they are CamVid's eleven on its validation images, so the columns are not comparable, but
the order of the networks is.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from edgeperc.evaluation.camvid import image_figures
from edgeperc.evaluation.metrics import Confusion
from edgeperc.system.atomic import open_atomic, write_atomic
from edgeperc.types.points import Bytes, Ints64

from ..recipe import PAPER
from .camera import Camera
from .checkpoint import build_network, read_checkpoint
from .images import camvid_samples, confusions, read_camvid
from .train import Data, Run, train

ELEVEN: Mapping[str, tuple[str, float, tuple[float, ...]]] = {
    "U-Net ReLU": ("unet", 0.0, (0.3823, 0.8974, 0.5366, 0.6045, 0.9183)),
    "Small U-Net ReLU": ("unet-small", 0.0, (0.5254, 0.8796, 0.5331, 0.5954, 0.9029)),
    "Small U-Net Leaky ReLU": ("unet-small-leaky", 0.0, (0.4436, 0.8780, 0.5203, 0.5767, 0.9039)),
    "Long U-Net (dropout 0.7)": ("unet-long", 0.7, (0.3971, 0.8985, 0.5442, 0.6098, 0.9190)),
    "Long U-Net (dropout 0.5)": ("unet-long", 0.5, (0.3901, 0.8913, 0.5731, 0.6384, 0.9139)),
    "SegNet": ("segnet", 0.0, (0.4978, 0.8537, 0.4861, 0.5373, 0.8820)),
    "SegNet (dropout 0.5)": ("segnet", 0.5, (0.5652, 0.8397, 0.4652, 0.5031, 0.8665)),
    "FCN-16": ("fcn16", 0.0, (0.5027, 0.8492, 0.5000, 0.5623, 0.8805)),
    "FCN-16 (dropout 0.5)": ("fcn16", 0.5, (0.4482, 0.8585, 0.5102, 0.5639, 0.8834)),
    "FCN-8": ("fcn8", 0.0, (0.4860, 0.8603, 0.5039, 0.5686, 0.8891)),
    "FCN-8 (dropout 0.5)": ("fcn8", 0.5, (0.4216, 0.8700, 0.5176, 0.5744, 0.8938)),
}
"""Name -> network, dropout, and the paper's `FIGURES`, in the order of its table 4."""

TITLES = {"loss": "loss", "accuracy": "accuracy", "miou": "mean IoU", "f1": "F1", "dice": "Dice"}
FIGURES = (*TITLES,)
N_SHOWN = 3
N_POINTS = 12  # of each curve
# Colors of CamVid's eleven classes, as its authors draw them.
COLORS = (
    *((128, 128, 128), (128, 0, 0), (192, 192, 128), (128, 64, 128), (60, 40, 222), (128, 128, 0)),
    *((192, 128, 128), (64, 64, 128), (64, 0, 128), (64, 64, 0), (0, 128, 192)),
)
FAMILIES = {"unet": "#0072b2", "segn": "#d55e00", "fcn1": "#009e73", "fcn8": "#56b4a4"}
RESULTS, PREDICTIONS = "camvid.json", "camvid.npz"


def figures_of(counts: Ints64) -> dict[str, float]:
    """Accuracy, mean IoU, F1 and Dice by the paper's equations 1 to 6, of pixels (C, C) by truth and prediction,
    without absent classes. Dice, of all classes' masks together, equals the accuracy; by class, it would be F1.
    """
    confusion = Confusion([str(k) for k in range(len(counts))], counts)
    precision, recall = np.nan_to_num(confusion.precision()), np.nan_to_num(confusion.recall())
    present = ~np.isnan(confusion.iou())
    f1 = 2.0 * precision * recall / np.maximum(precision + recall, 1e-12)
    return {
        "accuracy": confusion.accuracy(),
        "miou": confusion.mean_iou(),
        "f1": float(f1[present].mean()),
        "dice": confusion.accuracy(),
    }


def ablate_camvid(
    camvid: Path,
    out: Path,
    *,
    networks: Sequence[str] = (),
    width: int = 120,
    height: int = 90,
    epochs: int = 10,
    batch: int = 8,
    learning_rate: float | None = None,
    n_threads: int | None = None,
    compiled: bool = False,
) -> list[dict[str, Any]]:
    """Train and evaluate networks of `ELEVEN`, with ``epochs`` of images scaled to one size; those with results in
    ``out/camvid.json`` are not trained again, a stopped run is resumed. Labels are compared at their own size.
    """
    if unknown := [name for name in networks if name not in ELEVEN]:
        raise ValueError(f"no network {unknown[0]!r}; expected one of: {'; '.join(ELEVEN)}")
    out.mkdir(parents=True, exist_ok=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    path = out / RESULTS
    rows: list[dict[str, Any]] = json.loads(path.read_text()) if path.exists() else []
    n_images = len(read_camvid(camvid, "train").hashes)
    for name in networks or ELEVEN:
        network, dropout, _ = ELEVEN[name]
        recipe = replace(
            PAPER[network],
            dropout=dropout,
            image_width=width,
            image_height=height,
            batch=batch,
            accumulate=1,
            steps=max(1, epochs * n_images // batch),
            stop_after=0,
            learning_rate=PAPER[network].learning_rate if learning_rate is None else learning_rate,
        )
        budget = {
            **{"width": width, "height": height, "epochs": epochs, "batch": batch, "steps": recipe.steps},
            **{"images": recipe.steps * batch, "learning_rate": recipe.learning_rate},
        }
        if other := [row for row in rows if row["budget"] != budget]:
            raise ValueError(f"{path} has results of the budget {other[0]['budget']}; give it, or an empty folder")
        if any(row["name"] == name for row in rows):
            continue
        folder, began = out / "runs" / "-".join([network, f"{dropout:g}"]), time.monotonic()
        every = max(recipe.steps // N_POINTS, n_images // batch, 1)
        run = Run(n_threads=n_threads, compiled=compiled, checkpoint_every=every, save_every_s=60.0)
        checkpoint = train(recipe, folder, Data(camvid=camvid), run)
        seconds, task = time.monotonic() - began, Camera.of(recipe)
        state = read_checkpoint(checkpoint, device)
        trained = build_network(state, checkpoint).to(device, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]  # not in its stubs
        watch = camvid_samples(task, camvid, device)[1]
        counts, loss, labels = confusions(trained, watch.images, watch.truth, task.input)
        total = counts.sum(0)
        iou = np.nan_to_num(Confusion(task.classes, total).iou()).round(4).tolist()
        rows.append(
            {
                "name": name,
                "budget": budget,
                "loss": round(loss, 4),
                **{figure: round(value, 4) for figure, value in figures_of(total).items()},
                "miou_interval": image_figures(task.classes, counts)["all"]["mean_iou_interval"],
                "iou": dict(zip(task.classes, iou, strict=True)),
                "parameters": sum(weight.numel() for weight in trained.parameters()),
                "seconds": round(seconds, 1),
                "curve": state["curve"],
            }
        )
        _keep(out / PREDICTIONS, name, [*watch.images.hashes], watch.truth, labels)
        write_atomic(path, (json.dumps(rows, indent=1) + "\n").encode())
        checkpoint.unlink()
        del trained, state
    return [row for name in ELEVEN for row in rows if row["name"] == name]


def _keep(path: Path, name: str, names: Sequence[str], truth: torch.Tensor, labels: torch.Tensor) -> None:
    """Add a network's labels of three images, evenly spread, to a file."""
    kept = dict(np.load(path)) if path.exists() else {}
    shown = np.linspace(0, len(names) - 1, min(N_SHOWN, len(names)) + 2).round().astype(int)[1:-1]
    kept |= {"names": np.array([names[k] for k in shown]), "truth": truth.cpu().numpy()[shown]}
    kept[name] = labels.cpu().numpy()[shown]
    with open_atomic(path) as file:
        np.savez_compressed(file, **kept)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The results as a Markdown table: each figure here, and the paper's in parentheses."""
    head = ["network", "parameters", *(f"{TITLES[name]} (paper)" for name in FIGURES), "95 % interval of mean IoU"]
    lines = [head, ["---", *["---:"] * (len(head) - 1)]]
    for row in rows:
        (*_, theirs), (low, high) = ELEVEN[row["name"]], row["miou_interval"]
        cells = [f"{row[figure]:.3f} ({value:.3f})" for figure, value in zip(FIGURES, theirs, strict=True)]
        lines.append([row["name"], f"{row['parameters'] / 1e6:.1f} M", *cells, f"{low:.3f} to {high:.3f}"])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _color(name: str) -> str:
    return FAMILIES[ELEVEN[name][0][:4]]


def plot_camvid(rows: Sequence[Mapping[str, Any]], folder: Path) -> list[Path]:
    """Draw ``figures.png``, the networks beside the paper's (figures 7 to 11), and ``curves.png`` (12 to 19)."""
    from matplotlib.figure import Figure

    names, at = [row["name"] for row in rows], np.arange(len(rows))
    figure = Figure(figsize=(13.0, 0.34 * len(names) + 1.6), layout="constrained")
    for axes, key in zip(figure.subplots(1, len(FIGURES), sharey=True), FIGURES, strict=True):
        axes.barh(at, [row[key] for row in rows], 0.7, color=[_color(name) for name in names])
        theirs = [ELEVEN[name][2][FIGURES.index(key)] for name in names]
        axes.plot(theirs, at, "D", color="#202020", markersize=4, label="paper (32 classes)")
        if key == "miou":
            bounds = np.array([row["miou_interval"] for row in rows]).T
            axes.hlines(at, bounds[0], bounds[1], color="#202020", linewidth=1.2, label="95 % interval")
        axes.set_title(TITLES[key], fontsize=10)
        axes.set_yticks(at, labels=names, fontsize=8)
        axes.tick_params(axis="x", labelsize=8)
        axes.grid(axis="x", alpha=0.3)
        axes.set_axisbelow(True)
    axes.invert_yaxis()
    marks = figure.axes[FIGURES.index("miou")].get_legend_handles_labels()
    figure.legend(*marks, loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    paths = [folder / "figures.png", folder / "curves.png"]
    figure.savefig(paths[0], dpi=110, metadata={"Software": None})

    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    styles = ("-", "--", ":", "-.")
    seen: dict[str, int] = {}
    for row in rows:
        color, batch = _color(row["name"]), row["budget"]["batch"]
        style = styles[seen.setdefault(color, 0) % len(styles)]
        marker = "o" if seen[color] >= len(styles) else None
        seen[color] += 1
        epochs = [each["step"] * batch * row["budget"]["epochs"] / row["budget"]["images"] for each in row["curve"]]
        line = {"color": color, "linestyle": style, "linewidth": 1.3, "marker": marker, "markersize": 3}
        left.plot(epochs, [each["validation"]["mean"] for each in row["curve"]], label=row["name"], **line)
        right.plot(epochs, [each["validation_loss"] for each in row["curve"]], **line)
    for axes, title in ((left, "mean IoU of the validation images"), (right, "loss of the validation images")):
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("epochs")
        axes.grid(alpha=0.3)
    figure.legend(loc="outside right center", frameon=False, fontsize=8)
    figure.savefig(paths[1], dpi=110, metadata={"Software": None})
    return paths


def show_camvid(predictions: Path, path: Path, camvid: Path | None = None) -> None:
    """Draw three validation images under all networks, like table 5, from ``camvid.npz``; with the folder of CamVid the
    images and true labels come first, without it the picture shows nothing of CamVid.
    """
    from matplotlib.figure import Figure

    kept = np.load(predictions)
    shown: dict[str, Bytes] = {}
    colors = np.array([*COLORS, *[(0, 0, 0)] * (256 - len(COLORS))], np.uint8)
    if camvid is not None:
        images = read_camvid(camvid, "validation")
        at = [[*images.hashes].index(name) for name in kept["names"]]
        shown["image"] = images.images[at].permute(0, 2, 3, 1).numpy()
        shown["true labels"] = colors[kept["truth"]]
    shown |= {name: colors[kept[name]] for name in ELEVEN if name in kept.files}
    n_columns = 4
    n_rows = -(-len(shown) // n_columns)
    height, width = kept["truth"].shape[1:]
    figure = Figure(
        figsize=(3.4 * n_columns, 3.4 * n_rows * len(kept["names"]) * height / width + 0.3 * n_rows),
        layout="constrained",
    )
    axes = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for each, (name, pictures) in zip(axes, shown.items(), strict=False):
        each.imshow(np.concatenate([*pictures]), origin="upper", interpolation="nearest")
        each.set_title(name, fontsize=10)
    for each in axes:
        each.axis("off")
    figure.savefig(path, dpi=80, metadata={"Software": None})
