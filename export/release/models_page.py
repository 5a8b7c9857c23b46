"""Writes models/MODELS.md and SHA256SUMS from the cards, and from validation.json, ablation.json and folds.json."""

from __future__ import annotations

import hashlib
import json
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from edgeperc.datasets.splits import FOLDS, TEST_DRIVES, VALIDATION_DRIVES
from edgeperc.errors import ModelFileError
from edgeperc.evaluation.tables import BANDS
from edgeperc.types.card import ModelCard
from edgeperc.types.choices import SPARSE_MODELS as SPARSE
from edgeperc.types.detector import PillarGeometry
from edgeperc.types.views import CameraGeometry, ObjectGeometry, TopViewGeometry
from edgeperc.zoo import DEFAULT, MAX_LOSS, OPEN, Variant, digest, resolve

from ..recipe import Recipe

NO_AGREEMENT = "--no-agreement"

TASKS = {
    "camera": "a class for every pixel of an image",
    "objects": "boxes all around, of places where an object may be",
    "pillars": "boxes of a detector on pillars",
    "range_image": "a class for every point",
    "top_view": "drivable area and vehicles ahead",
}
SOURCES = {"real": "real", "semantickitti": "SemanticKITTI", "simulated": "simulated"}
ALL_RANGES = ("all",)
WRITTEN = "Written by `edgeperc-export models FOLDER` from the cards in the files; `edgeperc info FILE` prints one."
SHIPPED = (
    "`edgeperc-export make NAME OUT --kitti KITTI --layouts KITTI_LABELS` trains a model again. A name stands for one "
    "network and its variants. `Perceiver()` and `edgeperc run PATH` take "
    f"{', '.join(f'`{name}`' for name in DEFAULT)}. `NAME:fp32` and `NAME:int8` ask for one variant. "
    + " ".join(f"For sparse sensors, `{sparse}` takes the place of `{name}`." for name, sparse in SPARSE.items())
)
PERCENT = (
    "All figures are percentages. In brackets: 95 % bootstrap intervals over drives (over scenes for simulation), if "
    "two or more have the class. Do not average tables of real and simulated scans."
)
FIGURES = (
    f"Figures of scans are on the test drives ({', '.join(sorted(TEST_DRIVES))}), on which nothing was trained or "
    f"chosen, and on simulated scans. {PERCENT} The figures are of each network alone, before the agreement of points, "
    "boxes and cells. Simulated scans are of the streets at the time of the model's export. AP of boxes below still "
    "counts true boxes as missed whose center lies where nothing is labeled: 1 of 57 on the test drives."
)
RESEARCH = (
    "Teachers of the shipped models, the papers' own networks, and models trained on simulation alone. They are in the "
    "repository and the source distribution, not in the wheel; use one by its path, `--model "
    "models/research/NAME.onnx`."
)


def sums_of(folder: Path) -> str:
    """The SHA-256 of each model of a folder, as ``sha256sum --check`` reads them."""
    paths = sorted(folder.glob("*.onnx"))
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in paths)


def models_page(folder: Path) -> str:
    """The page (Markdown) for the models of a folder, which are shipped, and of its ``research``, which are not."""
    shipped, research = (
        sorted((variant for path in sorted(of.glob("*.onnx")) for variant in resolve(path)), key=str)
        for of in (folder, folder / "research")
    )
    if not shipped + research:
        raise ModelFileError(f"{folder} is not a folder with .onnx models; expected one that holds some")
    is_own = not {*DEFAULT} <= {variant.name for variant in shipped}
    lines = ["# Models", "", *_prose(WRITTEN), *([] if is_own else ["", *_prose(SHIPPED)])]
    lines += [*_table(shipped), *_precisions(shipped), *_open(shipped)]
    lines += [*_validation(folder / "validation.json"), "", f"## Figures of the {'' if is_own else 'shipped '}models"]
    lines += ["", *_prose(PERCENT if is_own else FIGURES)]
    for variant in shipped:
        fp32 = variant.precision == "fp32"
        lines += ["", *_model(variant), *_figures_of(variant.card, tuple(BANDS) if fp32 else ALL_RANGES)]
    lines += ["", "## Research models", "", *_prose(RESEARCH)] * bool(research)
    for variant in research:
        lines += ["", *_model(variant), *_figures_of(variant.card, ALL_RANGES)]
    lines += _folds(_read(folder / "folds.json"))
    lines += _ablations(_read(folder / "ablation.json"))
    return "\n".join(lines) + "\n"


def _read(path: Path) -> Any:
    return json.loads(path.read_text()) if path.exists() else []


def _prose(text: str) -> list[str]:
    return textwrap.wrap(text, 116, break_long_words=False, break_on_hyphens=False)


def _size(variant: Variant) -> str:
    return f"{variant.path.stat().st_size / 1e6:.1f} MB"


def _table(variants: Sequence[Variant]) -> Iterable[str]:
    yield from _head("name", ["task", "classes", "view", "files", "terms of the weights"])
    for name in dict.fromkeys(variant.name for variant in variants):
        own = [variant for variant in variants if variant.name == name]
        card = own[0].card
        task = "drivable area ahead" if not card.box_classes and card.view.kind == "top_view" else TASKS[card.view.kind]
        files = ", ".join(f"{variant.precision} {_size(variant)}" for variant in own)
        yield _row(f"`{name}`", task, ", ".join(card.classes), _view(card), files, card.training.get("licence", "-"))


def _view(card: ModelCard) -> str:
    view = card.view
    if isinstance(view, TopViewGeometry | PillarGeometry):
        (near, far), (right, left) = view.x_range_m, view.y_range_m
        ranges = f"x {near:g} to {far:g} m, y {right:g} to {left:g} m"
        return f"{view.height} x {view.width} cells of {view.cell_m:g} m, {ranges}"
    if isinstance(view, CameraGeometry):
        return f"{view.height} x {view.width} pixels, images are {view.fit}ed to it"
    if isinstance(view, ObjectGeometry):
        return f"{view.n_points} points within {view.margin_m:g} m of each candidate"
    azimuths = f"azimuth {view.azimuth_left_deg:g} to {view.azimuth_right_deg:g} degrees"
    return f"{view.height} x {view.width} pixels, {azimuths}"


def _precisions(variants: Sequence[Variant]) -> Iterable[str]:
    every = [(variant, *of) for variant in variants for of in variant.card.precisions.items()]
    reduced = [each for each in every if each[1] != "fp32"]
    if not reduced:
        return
    yield from ("", "## Precision", "")
    yield from _prose(
        "Agreement of each precision with fp32, after post-processing, on labeled real scans or images. "
        "`precision=auto` takes a reduced precision only if its loss (of mean IoU or of AP, whichever is larger) is "
        f"at most {MAX_LOSS} points and the processor has instructions for it: int8 on the CPU provider and OpenVINO "
        "(VNNI, AMX, or Arm's dot product; on the CPU provider also AVX2, for weights of 7 bits), bf16 on OpenVINO "
        "(AMX or AVX-512). `precision=fp32` forbids it. "
        "`perception.providers` shows what ran."
    )
    yield from _head("model", ["equal labels", "mean IoU", "fp32", "AP50", "fp32", "loss", "scans", "measured with"])
    for variant, precision, record in reduced:
        yield _row(
            *(f"{variant.name} {precision}", f"{100 * record['label_agreement']:.2f}"),
            *(_share(record[key], 2) for key in ("mean_iou", "fp32_mean_iou", "ap", "fp32_ap")),
            *(f"{record['loss']:.2f}", record["n_scans"], record["by"]),
        )
    commands = ", ".join(f"`{command}`" for command in sorted({record["command"] for *_, record in reduced}))
    roads = " Scans of SemanticKITTI are of a test drive; they serve here only to compare precisions of one network."
    yield ""
    yield from _prose(
        "Mean IoU is of points without background, of vehicles and road, or of the eleven classes of images. Made by "
        f"{commands}.{roads * ('SEMANTICKITTI' in commands)}"
    )


def _open(variants: Sequence[Variant]) -> Iterable[str]:
    free = [variant for variant in variants if variant.name in OPEN]
    if not free:
        return
    yield from ("", "## Weights that anyone may use", "")
    yield from _prose(
        "The default models were trained on KITTI's scans, whose terms exclude commercial use. "
        f"{', '.join(f'`{name}`' for name in OPEN)} were trained without any scan, box or network of KITTI: on drawn "
        "streets and 28 scans of PandaSet. Their terms are in the table above. They take up to a fifth longer, tell "
        "road, buildings and plants apart, too, and are less accurate on KITTI's roads:"
    )
    yield from ("", "    edgeperc run PATH --weights open", '    edgeperc.Perceiver(weights="open")', "")
    yield from _prose(
        "They are in int8, with weights of 7 bits, so that every processor computes them without overflow. Their fp32 "
        "files, to train further or for other providers, are among the research models, as are the larger "
        "`pointseg-sim` and `ssadnet-sim`, trained on drawn streets alone."
    )


def _validation(path: Path) -> Iterable[str]:
    table = _read(path)
    if not table:
        return
    rows = table["rows"]
    yield from ("", "## How the shipped models were chosen", "")
    yield from _prose(
        f"Each name belongs to the network that is most accurate on {rows[0]['n_scans']} scans of "
        f"{len(VALIDATION_DRIVES)} validation drives. These drives are neither training nor test drives "
        "(`edgeperc/datasets/splits.py`). If two networks are equally accurate, the faster one is chosen. 107 of "
        "the scans are of one drive, 2011_09_26_drive_0001, with 12 cars, 2 cyclists and 1 tram, so the intervals over "
        "drives are wide. The drives' boxes, but not their scans, are among the layouts of the simulated training "
        "scenes. Relative time: time of the network alone in stock onnxruntime with two threads, divided by the time "
        "of the shipped fp32 file. Both were measured in turn on a busy computer (`bench/RESULTS.md` has times)."
    )
    of_points, of_vehicles = ([row for row in rows if key in row] for key in ("points", "vehicles"))
    classes, first = ("car", "pedestrian", "cyclist"), of_points[0]["points"]
    counts = [f"{first[c]['n_points']:,} points of {first[c]['n_objects']} {c}s" for c in classes]
    yield from _head(f"points ({', '.join(counts)})", [*(f"IoU {c}" for c in classes), "relative time"])
    for row in of_points:
        cells = [_percent(row["points"][c], "iou") for c in classes]
        yield _row(f"`{row['file']}`", *cells, f"{row['relative_time']:.1f}")
    first = of_vehicles[0]["vehicles"]
    title = f"vehicles ({first['n_boxes']} boxes, {first['n_cells']:,} cells)"
    yield from _head(title, ["AP50", "precision", "recall", "IoU of cells", "relative time"])
    for row in of_vehicles:
        cells = _rates(row["vehicles"], "ap", "precision", "recall", "iou")
        yield _row(f"`{row['file']}`", *cells, f"{row['relative_time']:.1f}")
    yield from ("", f"Made by `{_alone(table['command'])}`.")


def _model(variant: Variant) -> Iterable[str]:
    card, training = variant.card, variant.card.training
    yield f"### {variant} {card.version}"
    yield ""
    yield f"- {_size(variant)}, SHA-256 `{digest([variant])}`"
    yield f"- Input: {_view(card)}; channels {', '.join(card.input.channels)}. Outputs: " + ", ".join(
        f"{output.name} ({output.kind})" for output in card.outputs
    )
    if "quantized" in training:
        quantized = training["quantized"]
        yield (
            f"- Quantized from {quantized['from']} (fp32), calibrated on {quantized['calibration']}, weights of "
            f"{quantized['weight_bits']} bits, {len(quantized['left_alone'])} convolutions in fp32"
        )
    else:
        recipe = _recipe(training.get("recipe", {}))
        yield f"- Trained on {training.get('data', 'unknown data')}" + f": {recipe}" * bool(recipe)
        for before in training.get("started_from", []):
            yield f"- Started from: {_recipe(before)}"
    yield f"- Terms of the weights: {training.get('licence', 'unknown')}"
    if card.parity:
        yield f"- Parity with {'fp32' if 'quantized' in training else 'torch'}: {_flat(card.parity)}"


def _recipe(recipe: Mapping[str, Any]) -> str:
    """The options that differ from the defaults of `Recipe`."""
    usual = {field.name: field.default for field in fields(Recipe)}
    own = {name: tuple(value) if isinstance(value, list) else value for name, value in recipe.items()}
    return _flat({name: value for name, value in own.items() if name not in usual or value != usual[name]})


def _alone(command: str) -> str:
    """The command for a network alone; earlier exports, without one's own --json, were made before the agreement."""
    return command if NO_AGREEMENT in command or " --json" in command else f"{command} {NO_AGREEMENT}"


def _figures_of(card: ModelCard, bands: Sequence[str]) -> Iterable[str]:
    if "images" in card.metrics:
        yield f"- Figures made by `{card.metrics['command']}`"
        yield from _image_figures(card.metrics["images"])
    elif "command" in card.metrics:
        yield f"- Figures made by `{_alone(card.metrics['command'])}`"
    for source, title in SOURCES.items():
        if source in card.metrics:
            of = card.metrics[source]
            yield from _figures(of, f"{of['n_frames']} {title} scans", bands if source != "simulated" else ALL_RANGES)
    for name, of in card.metrics.get("folders", {}).items():
        yield from _figures(of, f"{of['n_frames']} scans of {name}", bands)


def _image_figures(figures: Mapping[str, Any]) -> Iterable[str]:
    n_images = max(row["n_images"] for row in figures["classes"].values())
    head = ["precision", "recall", "IoU", "pixels"]
    yield from _head(f"pixels, {n_images} validation images, intervals over images", head)
    yield _row("all, mean", "-", "-", _percent(figures["all"], "mean_iou"), f"{figures['all']['n_pixels']:,}")
    for name, row in figures["classes"].items():
        yield _row(name, *_rates(row, "precision", "recall", "iou"), f"{row['n_pixels']:,}")


def _figures(figures: Mapping[str, Any], scans: str, bands: Sequence[str]) -> Iterable[str]:
    if "points" in figures:
        yield from _head(f"points, {scans}", ["range", "precision", "recall", "IoU", "points", "objects"])
        for band, rows in _by_band(figures["points"], bands):
            for name, row in rows.items():
                counts = f"{row['n_points']:,}", row.get("n_objects") or "-"
                yield _row(name, band, *_rates(row, "precision", "recall", "iou"), *counts)
    for kind, of_kind in figures.get("boxes", {}).items():
        head = ["range", "AP50", "precision", "recall", "mIoU@0.5", "mIoU@0.7", "boxes"]
        yield from _head(f"{kind} boxes, {scans}", head)
        for band, rows in _by_band(of_kind, bands):
            yield _row("mean of classes (mAP50)", band, _percent(rows, "mean_ap"), *["-"] * 5)
            for name, row in rows.items():
                if isinstance(row, Mapping):
                    rates = _rates(row, "ap", "precision", "recall", "mean_iou_50", "mean_iou_70")
                    yield _row(name, band, *rates, row["n_truth"])
    for table, of_table in figures.get("segmentation", {}).items():
        classes = list(next(iter(of_table.values()))["iou"])
        yield from _head(
            f"segmentation, {table}, {scans}", ["ACC", "mAP", "mIoU", *(f"IoU {c}" for c in classes), "cells"]
        )
        for band, row in _by_band(of_table, bands):
            rates = _rates(row, "accuracy", "mean_ap", "mean_iou")
            yield _row(band, *rates, *(_share(row["iou"][c]) for c in classes), f"{row['n_cells']:,}")
    if "road" in figures:
        yield from _head(f"road, {scans}", ["F1", "best F1", "AP", "ACC", "PRE", "REC", "IoU", "cells"])
        for band, row in _by_band(figures["road"], bands):
            rates = _rates(row, "f1", "max_f1", "ap", "accuracy", "precision", "recall", "iou")
            yield _row(band, *rates, f"{row['n_cells']:,}")


def _by_band(rows: Mapping[str, Any], bands: Sequence[str]) -> Iterable[tuple[str, Any]]:
    """Rows in the order of the bands; a card sorts its keys."""
    return ((band, rows[band]) for band in BANDS if band in rows and band in bands)


def _folds(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """Figures on one fold of models that were trained without it."""
    if not rows:
        return
    yield from ("", "## Cross-validation", "")
    yield from _prose(
        f"Each model was trained without one of the {len(FOLDS)} folds of the training drives, by `edgeperc-export "
        "make NAME OUT --fold K --steps N`, and evaluated on frames of grade A of that fold. It had fewer steps and "
        "fewer drives than the model of the same name."
    )
    for row in rows:
        made = f"{row['name']} without fold {row['fold']}, {row['steps']} steps of {row['batch']}"
        yield from _figures(row["real"], f"{made}, {row['real']['n_frames']} real scans", ALL_RANGES)


def _ablations(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    if not rows:
        return
    yield from ("", "## Ablations", "")
    yield from _prose(
        "Short runs from the weights trained on simulation alone (LoDNN: from scratch), each with one change, "
        "evaluated on a fold outside its training set (`edgeperc-export ablate`): IoU of pixel labels, and AP50 of "
        "all vehicles as one class."
    )
    for network, fold, steps in sorted({(r["network"], r["fold"], r["steps"]) for r in rows}):
        here = [r for r in rows if (r["network"], r["fold"], r["steps"]) == (network, fold, steps)]
        names = list(here[0]["figures"])
        yield from _head(f"{network}, fold {fold}, {steps} steps", names)
        for row in here:
            yield _row(row["variant"], *(_share(row["figures"].get(name)) for name in names))


def _head(first: str, rest: Sequence[str]) -> Iterable[str]:
    yield from ("", _row(first, *rest), "|---" * (1 + len(rest)) + "|")


def _row(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _share(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{100.0 * value:.{digits}f}"


def _percent(row: Mapping[str, Any], key: str) -> str:
    interval = row.get(f"{key}_interval")
    return _share(row[key]) + ("" if interval is None else f" ({' to '.join(map(_share, interval))})")


def _rates(row: Mapping[str, Any], *keys: str) -> list[str]:
    return [_percent(row, key) for key in keys]


def _flat(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
