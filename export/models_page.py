"""models/MODELS.md, written from the cards, for people; no code reads it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from edgeperc.card import ModelCard, TopViewGeometry
from edgeperc.session import Session

__all__ = ["models_page"]


def models_page(folder: Path) -> str:
    """The page for every .onnx in a folder, by name."""
    parts = [
        "# Models",
        "",
        "Written by `edgeperc-export models models` from the cards in the files; `edgeperc info NAME` prints a card.",
    ]
    for path in sorted(folder.glob("*.onnx")):
        session = Session(path, "cpu")
        parts += ["", *_model(session.card, session.sha256, path.stat().st_size)]
    return "\n".join(parts) + "\n"


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
    yield f"## {card.name} {card.version}"
    yield ""
    yield f"- View: {shape}; channels {', '.join(card.input.channels)}"
    yield f"- Classes: {', '.join(card.classes)}"
    yield f"- Outputs: {', '.join(f'{o.name} ({o.kind})' for o in card.outputs)}"
    yield f"- Trained on: {card.training.get('data', 'unknown')}; recipe {_flat(card.training.get('recipe', {}))}"
    yield f"- Licence of the weights: {card.training.get('licence', 'unknown')}"
    yield f"- Parity with torch: {_flat(card.parity)}"
    yield f"- {size / 1e6:.1f} MB, SHA-256 `{sha256}`"
    metrics = card.metrics
    if metrics:
        yield "- Measured on drives that nothing was trained on, in percent:"
    if "points" in metrics:
        yield ""
        yield f"| points, {metrics['n_frames']} real frames | precision | recall | IoU | points |"
        yield "|---|---|---|---|---|"
        for name, row in metrics["points"].items():
            rates = " | ".join(_percent(row[k]) for k in ("precision", "recall", "iou"))
            yield f"| {name} | {rates} | {row['n']:,} |"
    for kind, rows in metrics.get("boxes", {}).items():
        yield ""
        head = f"| {kind} boxes, {metrics['n_frames']} real frames"
        yield f"{head} | AP50 | precision | recall | mIoU@0.5 | mIoU@0.7 | boxes |"
        yield "|---|---|---|---|---|---|---|"
        for name, row in rows.items():
            keys = ("ap", "precision", "recall", "mean_iou_50", "mean_iou_70")
            yield f"| {name} | {' | '.join(_percent(row[k]) for k in keys)} | {row['n_truth']} |"
    if "road" in metrics:
        road = metrics["road"]
        yield ""
        yield f"| road, {road['n_frames']} SemanticKITTI scans | IoU | precision | recall | F1 | accuracy | cells |"
        yield "|---|---|---|---|---|---|---|"
        keys = ("iou", "precision", "recall", "f1", "accuracy")
        yield f"| drivable | {' | '.join(_percent(road[k]) for k in keys)} | {road['n_cells']:,} |"


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f}"


def _flat(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in values.items())
