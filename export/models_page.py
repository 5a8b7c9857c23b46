"""models/MODELS.md, written from the cards and from ablation.json and folds.json beside them, for people to read."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from edgeperc.card import ModelCard, TopViewGeometry
from edgeperc.evaluation.splits import FOLDS, TEST_DRIVES
from edgeperc.evaluation.tables import BANDS
from edgeperc.session import Session

__all__ = ["models_page"]


def models_page(folder: Path) -> str:
    """The page for every .onnx in a folder, by name."""
    lines = [
        "# Models",
        "",
        "Written by `edgeperc-export models models` from the cards in the files; `edgeperc info NAME` prints a card,",
        "`edgeperc-export make NAME OUT --kitti KITTI --layouts KITTI_LABELS` makes a model again. Figures are of the",
        f"test drives ({', '.join(sorted(TEST_DRIVES))}; `edgeperc/splits.py`),",
        "by which nothing was trained or chosen. All are percentages, in brackets their 95 % bootstrap intervals over",
        "drives (over scenes for simulation), where two or more have what is judged. Real and simulated scans are",
        "never put together.",
    ]
    for path in sorted(folder.glob("*.onnx")):
        session = Session(path, "cpu")
        lines += ["", *_model(session.card, session.sha256, path.stat().st_size)]
    lines += _folds(_read(folder / "folds.json"))
    lines += _ablations(_read(folder / "ablation.json"))
    return "\n".join(lines) + "\n"


def _read(path: Path) -> list[dict[str, Any]]:
    return json.loads(path.read_text()) if path.exists() else []


def _model(card: ModelCard, sha256: str, size: int) -> Iterable[str]:
    view = card.view
    if isinstance(view, TopViewGeometry):
        place = (
            f"x {view.x_range_m[0]:g} to {view.x_range_m[1]:g} m, y {view.y_range_m[0]:g} to {view.y_range_m[1]:g} m"
        )
        shape = f"top view, {view.height} x {view.width} cells of {view.cell_m:g} m, {place}"
    else:
        azimuths = f"azimuth {view.azimuth_left_deg:g} to {view.azimuth_right_deg:g} degrees"
        shape = f"range image, {view.height} x {view.width}, {azimuths}"
    training, metrics = card.training, card.metrics
    yield f"## {card.name} {card.version}"
    yield ""
    yield f"- View: {shape}; channels {', '.join(card.input.channels)}"
    yield f"- Classes: {', '.join(card.classes)}"
    yield f"- Outputs: {', '.join(f'{o.name} ({o.kind})' for o in card.outputs)}"
    yield f"- Trained on: {training.get('data', 'unknown')}; recipe {_flat(training.get('recipe', {}))}"
    for before in training.get("started_from", []):
        yield f"- Before that: {_flat(before)}"
    yield f"- Licence of the weights: {training.get('licence', 'unknown')}"
    yield f"- Parity with torch: {_flat(card.parity)}"
    yield f"- {size / 1e6:.1f} MB, SHA-256 `{sha256}`"
    if "command" in metrics:
        yield f"- Figures made by: `{metrics['command']}`"
    for source, title in (("real", "real"), ("semantickitti", "SemanticKITTI"), ("simulated", "simulated")):
        if source in metrics:
            yield from _figures(metrics[source], f"{metrics[source]['n_frames']} {title} scans")
    yield from _curve(training.get("curve", []))


def _figures(figures: Mapping[str, Any], scans: str) -> Iterable[str]:
    if "points" in figures:
        yield from _head(f"points, {scans}", ["range", "precision", "recall", "IoU", "points", "objects"])
        for band, rows in _by_band(figures["points"]):
            for name, row in rows.items():
                rates = [_percent(row, key) for key in ("precision", "recall", "iou")]
                yield _row(name, band, *rates, f"{row['n_points']:,}", row["n_objects"] or "-")
    for kind, bands in figures.get("boxes", {}).items():
        head = ["range", "AP50", "precision", "recall", "mIoU@0.5", "mIoU@0.7", "boxes"]
        yield from _head(f"{kind} boxes, {scans}", head)
        for band, rows in _by_band(bands):
            yield _row("mean of classes (mAP50)", band, _percent(rows, "mean_ap"), *["-"] * 5)
            for name, row in rows.items():
                if isinstance(row, Mapping):
                    keys = ("ap", "precision", "recall", "mean_iou_50", "mean_iou_70")
                    yield _row(name, band, *(_percent(row, key) for key in keys), row["n_truth"])
    for table, bands in figures.get("segmentation", {}).items():
        classes = list(next(iter(bands.values()))["iou"])
        yield from _head(
            f"segmentation, {table}, {scans}", ["ACC", "mAP", "mIoU", *(f"IoU {c}" for c in classes), "cells"]
        )
        for band, row in _by_band(bands):
            rates = [_percent(row, key) for key in ("accuracy", "mean_ap", "mean_iou")]
            yield _row(band, *rates, *(_share(row["iou"][c]) for c in classes), f"{row['n_cells']:,}")
    if "road" in figures:
        yield from _head(f"road, {scans}", ["F1", "best F1", "AP", "ACC", "PRE", "REC", "IoU", "cells"])
        for band, row in _by_band(figures["road"]):
            keys = ("f1", "max_f1", "ap", "accuracy", "precision", "recall", "iou")
            yield _row(band, *(_percent(row, key) for key in keys), f"{row['n_cells']:,}")


def _by_band(rows: Mapping[str, Any]) -> Iterable[tuple[str, Any]]:
    """In the order of the bands, which a card's sorted keys lose."""
    return ((band, rows[band]) for band in BANDS if band in rows)


def _curve(curve: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    if not curve:
        return
    watched = list(curve[-1].get("validation", {}))
    yield from _head("training: step", ["loss", *(f"watched {name}" for name in watched)])
    for line in curve[:: max(1, len(curve) // 8)]:
        yield _row(line["step"], f"{line['loss']:.3f}", *(_share(line["validation"][name]) for name in watched))


def _folds(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    """What models made without a fold of the training drives reach on it."""
    if not rows:
        return
    yield from (
        "",
        "## Over folds",
        "",
        f"Each model was made without one of the {len(FOLDS)} folds of the training drives, by",
        "`edgeperc-export make NAME OUT --fold K --steps N`, and judged on that fold, grade A frames. The steps are",
        "fewer than the shipped models', and so are the drives.",
    )
    for row in rows:
        made = f"{row['name']} without fold {row['fold']}, {row['steps']} steps of {row['batch']}"
        yield from _figures(row["real"], f"{made}, {row['real']['n_frames']} real scans")


def _ablations(rows: Sequence[Mapping[str, Any]]) -> Iterable[str]:
    if not rows:
        return
    yield from (
        "",
        "## What each part is worth",
        "",
        "Short runs from the simulation-only weights (LoDNN's from nothing), each with one thing changed, judged on a",
        "fold of the training drives that the run has not seen (`edgeperc-export ablate`): IoU of pixel labels, and",
        "AP50 of all vehicles as one class.",
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


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f}"


def _percent(row: Mapping[str, Any], key: str) -> str:
    interval = row.get(f"{key}_interval")
    return _share(row[key]) + ("" if interval is None else f" ({' to '.join(map(_share, interval))})")


def _flat(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
