"""``edgeperc eval``: accuracy on labeled scans."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..extras import require
from .arguments import (
    DEFAULT,
    Commands,
    add_boxes_from,
    add_command,
    add_figures_file,
    add_model,
    add_provider,
    finite_number,
)
from .output import many, print_line, progress, table_lines, write_figures

__all__ = ["add_parser", "eval_command"]


def add_parser(commands: Commands) -> None:
    """Add ``eval``."""
    parser = add_command(
        commands,
        "eval",
        eval_command,
        help="accuracy on labeled scans: the papers' tables",
        description="Compare the models' results with the labels of scans: points, boxes, top view and road, over all "
        "distances and by range, with 95 % intervals over drives. It is an error to evaluate a model on a scan that it "
        "was trained on, except with --split train.",
        examples=[
            "edgeperc eval simulation:24",
            "edgeperc eval KITTI/ SemanticKITTI/ --model pointseg --json figures.json",
            "edgeperc eval KITTI/ --split all --worst worst.png",
        ],
    )
    reading = parser.add_argument_group("input")
    reading.add_argument(
        "datasets",
        nargs="+",
        metavar="DATASET",
        help="the root of a KITTI object set or of SemanticKITTI, or simulation:N for N simulated scans (simulation "
        "alone: 24)",
    )
    reading.add_argument(
        "--split",
        choices=("test", "validation", "train", "all"),
        help="which drives (default: test, or those of --fold); nothing is trained on test and validation drives",
    )
    reading.add_argument(
        "--fold",
        type=int,
        choices=(0, 1, 2),
        help="evaluate on the validation drives of this training fold (default: none)",
    )
    reading.add_argument(
        "--mounted",
        type=_mounted,
        metavar="M,DEG,DEG",
        help="perceive each scan as a sensor of this height, roll and pitch would have recorded it, the mounting to be "
        "estimated from that scan alone; evaluates points and boxes (default: as recorded)",
    )
    models = parser.add_argument_group("models")
    add_model(models)
    add_provider(models, provider="cpu")
    add_boxes_from(models, "network")
    models.add_argument(
        "--road-by",
        metavar="MODEL",
        help="another top-view model whose drivable cells are the ground truth on KITTI, which has no road labels "
        "(default: no road figures on KITTI)",
    )
    output = parser.add_argument_group("output")
    add_figures_file(output)
    output.add_argument(
        "--worst",
        type=Path,
        metavar="FILE",
        help="write a picture, .png, of the scans with the most errors (needs the extra 'view'; default: none)",
    )


def _mounted(text: str) -> tuple[float, float, float]:
    height_m, roll_deg, pitch_deg = (finite_number(part) for part in text.split(","))
    return height_m, roll_deg, pitch_deg


def eval_command(arguments: argparse.Namespace) -> int:
    """Compare models with labeled scans."""
    if arguments.worst is not None:
        require("matplotlib", "view", "Drawing a picture")
    for file in filter(None, (arguments.json, arguments.worst)):
        file.parent.mkdir(parents=True, exist_ok=True)
    from ..evaluation.evaluate import evaluate
    from ..mounting import Mounting

    with progress() as show:
        figures, mistakes = evaluate(
            arguments.datasets,
            arguments.model or DEFAULT,
            split=arguments.split,
            fold=arguments.fold,
            road_by=arguments.road_by,
            boxes_from=arguments.boxes_from,
            mounted=None if arguments.mounted is None else Mounting(*arguments.mounted),
            provider=arguments.provider,
            precision=arguments.precision,
            on_scan=show,
        )
    for line in _figure_lines(figures):
        print_line(line)
    write_figures(arguments, figures)
    if arguments.worst is not None:
        from ..view.mistakes import draw_mistakes

        models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
        draw_mistakes(mistakes, arguments.worst, title=models)
    return 0


# Columns of the tables: heading and key. Shares are printed in per cent.
_RATES = (("precision", "precision"), ("recall", "recall"))
_POINT_COLUMNS = (*_RATES, ("IoU", "iou"), ("95 %", "iou_interval"), ("points", "n_points"), ("objects", "n_objects"))
_BOX_COLUMNS = (
    *(("AP50", "ap"), ("95 %", "ap_interval"), *_RATES, ("mIoU@.5", "mean_iou_50"), ("mIoU@.7", "mean_iou_70")),
    *(("true", "n_truth"), ("predicted", "n_predicted"), ("hits", "n_hits")),
)
_MAP_COLUMNS = (("ACC", "accuracy"), ("mAP", "mean_ap"), ("mIoU", "mean_iou"), ("95 %", "mean_iou_interval"))
_ROAD_COLUMNS = (
    *(("F1", "f1"), ("95 %", "f1_interval"), ("AP", "ap"), ("ACC", "accuracy"), ("PRE", "precision")),
    *(("REC", "recall"), ("IoU", "iou"), ("MaxF", "max_f1"), ("observed PRE", "drivable_precision")),
    *(("observed REC", "drivable_recall"), ("cells", "n_cells")),
)
_BLOCKS = {"real": "real scans with boxes", "semantickitti": "SemanticKITTI", "simulated": "simulated scans"}


def _figure_lines(figures: Mapping[str, Any]) -> list[str]:
    models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
    fold = "" if figures["fold"] is None else f", fold {figures['fold']}"
    lines = [
        f"{models}; {figures['split']} drives{fold}; shares in per cent, intervals over drives",
        f"ran as {'; '.join(figures['providers'].values())}",
    ]
    for block, name in _BLOCKS.items():
        if block not in figures:
            continue
        of_block = figures[block]
        lines += ["", f"== {name}: {many(of_block['n_frames'], 'scan')}, {many(of_block['n_drives'], 'drive')} =="]
        for kind, title in (
            ("points", "points"),
            ("pixels", "points with the class of their pixel, before refinement"),
        ):
            lines += table_lines(title, _POINT_COLUMNS, _class_rows(of_block.get(kind, {}), "n_points"))
        for kind, of_kind in of_block.get("boxes", {}).items():
            means = {
                band: {"mean": {"ap": rows["mean_ap"], "ap_interval": rows.get("mean_ap_interval")}}
                for band, rows in of_kind.items()
                if rows["mean_ap"] is not None
            }
            rows = [*_class_rows(of_kind, "n_truth"), *_class_rows(means, "ap")]
            lines += table_lines(
                f"boxes, {kind}", _BOX_COLUMNS, sorted(rows, key=lambda row: [*of_kind].index(row[0][0]))
            )
        for kind, of_kind in of_block.get("segmentation", {}).items():
            names = next(iter(of_kind.values()))["iou"]
            columns = (*_MAP_COLUMNS, *((name, name) for name in names), ("cells", "n_cells"))
            rows = [((band, ""), {**row, **row["iou"]}) for band, row in of_kind.items() if row["n_cells"]]
            lines += table_lines(f"top view, {kind}; columns of classes are IoU", columns, rows)
        rows = [((band, ""), row) for band, row in of_block.get("road", {}).items() if row["n_cells"]]
        lines += table_lines("road", _ROAD_COLUMNS, rows)
        for (band, _), row in rows[:1]:  # over all distances
            titles = ("no road", "road")
            shares = [
                ((band, f"true {name}"), dict(zip(titles, part, strict=True)))
                for name, part in zip(titles, row["confusion"], strict=True)
            ]
            lines += table_lines(
                "road, confusion in shares of all cells", [(f"predicted {t}", t) for t in titles], shares
            )
    return lines


def _class_rows(bands: Mapping[str, Any], count: str) -> list[tuple[tuple[str, str], Mapping[str, Any]]]:
    """A row for each class and band that has objects or predictions."""
    return [
        ((band, name), row)
        for band, rows in bands.items()
        for name, row in rows.items()
        if isinstance(row, Mapping) and (row[count] or row.get("n_predicted"))
    ]
