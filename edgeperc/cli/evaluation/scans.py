"""``edgeperc eval``: accuracy on labeled scans and images."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...system.extras import require
from ...system.names import check_picture
from ...system.printable import many
from ...types.choices import CAMERA, PUBLIC_SETS, RULES
from ..arguments import (
    Commands,
    add_boxes,
    add_command,
    add_figures_file,
    add_model,
    add_provider,
    chosen_models,
    finite_number,
    keywords,
    options,
)
from ..output import FEW, lines_last, make_places, progress, table_lines, write_figures
from ..side_by_side import add_engine, has_workers
from .box_tables import box_table_lines, interval_columns


def add_parser(commands: Commands) -> None:
    """Add ``eval``."""
    parser = add_command(
        commands,
        "eval",
        eval_command,
        help="accuracy on labeled scans and images: the papers' tables",
        description="Compare the models' results with the labels of scans: points, boxes, top view and road, over all "
        "distances and by range, with 95 % intervals over drives; boxes also as KITTI and nuScenes measure them. "
        "It is an error to evaluate a model on a scan that it was trained on, except with "
        "--split train.\n\nCompare a camera model with labeled images: IoU of each class "
        "and their mean, with 95 % intervals over images; unlabeled pixels do not count.",
        examples=[
            "edgeperc eval simulation:24",
            "edgeperc eval KITTI/ SemanticKITTI/ --model pointseg --json figures.json",
            "edgeperc eval KITTI/ --split all --worst worst.png",
            "edgeperc eval CamVid/ --model camseg",
        ],
    )
    reading = options(parser, "input")
    reading(
        "datasets DATASET...",
        "the root of a KITTI object set or of SemanticKITTI, simulation:N for N simulated scans (simulation "
        "alone: 24), or labeled scans of any sensor: a folder with scans.json, or FOLDER:LAYOUT with the name of a "
        f"public set ({', '.join(PUBLIC_SETS)}); or labeled images: a "
        "folder with classes.json, train, trainannot, val, valannot as in CamVid",
    )
    reading(
        "--split",
        "which drives (default: test, or those of --fold; of images without test images: validation); nothing is "
        "trained on test and validation drives, which are the held-back ones",
        choices=("test", "validation", "held-back", "train", "all"),
    )
    reading(
        "--fold", "evaluate on the validation drives of this training fold (default: none)", type=int, choices=(0, 1, 2)
    )
    reading(
        "--mounted M,DEG,DEG",
        "perceive each scan as a sensor of this height, roll and pitch would have recorded it, the mounting to be "
        "estimated from that scan alone; evaluates points and boxes (default: as recorded)",
        type=_mounted,
    )
    add_engine(parser)
    models = options(parser, "models")
    add_model(models)
    add_provider(models, provider="cpu")
    add_boxes(models)
    models(
        "--without-rule RULE",
        "leave out one rule of the agreement, to measure what it is worth; may be repeated: "
        f"{', '.join(RULES)} (default: none)",
        action="append",
        choices=RULES,
        default=[],
    )
    models(
        "--road-by MODEL",
        "another top-view model whose drivable cells are the ground truth on KITTI, which has no road labels "
        "(default: no road figures on KITTI)",
    )
    output = options(parser, "output")
    add_figures_file(output)
    output(
        "--worst FILE",
        "write a picture, .png, of the scans with the most errors (needs the extra 'view'; default: none)",
    )


def _mounted(text: str) -> tuple[float, float, float]:
    parts = text.split(",")
    if len(parts) != 3:
        raise argparse.ArgumentTypeError(
            f"got {text!r:.60}; expected height [m], roll and pitch [deg] with commas between them, such as 1.73,5,-4"
        )
    height_m, roll_deg, pitch_deg = map(finite_number, parts)
    return height_m, roll_deg, pitch_deg


def eval_command(arguments: argparse.Namespace) -> int:
    """Compare models with labeled scans."""
    if arguments.worst is not None:
        require("matplotlib", "view", "Drawing a picture")
        check_picture(arguments.worst, ".png")
    make_places(arguments.json, arguments.worst)
    from ...datasets.images import LabeledImages

    of_images = [Path(dataset) for dataset in arguments.datasets if LabeledImages.is_one(Path(dataset))]
    if of_images:
        return _eval_images(arguments, of_images)
    from ...evaluation.evaluate import evaluate
    from ...evaluation.judge import Perceiving
    from ...types.mounting import Mounting

    rules = frozenset(() if arguments.no_agreement else {*RULES} - {*arguments.without_rule})
    perceiving = Perceiving(
        arguments.provider, arguments.precision, arguments.boxes_from, rules, arguments.score_threshold
    )
    with progress() as show:
        figures, mistakes = evaluate(
            arguments.datasets,
            chosen_models(arguments),
            perceiving,
            mounted=None if arguments.mounted is None else Mounting(*arguments.mounted),
            on_scan=show,
            **keywords(arguments, "split", "fold", "road_by", "engine", "workers"),
        )
    with lines_last(figure_lines(figures), gray=True):
        write_figures(arguments, figures)
        if arguments.worst is not None:
            from ...evaluation.mistakes import draw_mistakes

            models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
            draw_mistakes(mistakes, arguments.worst, title=models)
    return 0


_OF_SCANS = ("fold", "mounted", "road_by", "worst", "score_threshold")


def _eval_images(arguments: argparse.Namespace, roots: Sequence[Path]) -> int:
    from ...evaluation.camvid import evaluate_images

    if len(roots) < len(arguments.datasets):
        arguments.usage_error("labeled images and labeled scans have different figures; evaluate them one by one")
    if has_workers(arguments):
        arguments.usage_error("--workers and --engine ray need scans, and these are images; leave them out")
    given = {
        **{f"--{name.replace('_', '-')}": getattr(arguments, name) is not None for name in _OF_SCANS},
        "--weights": arguments.weights != "default",
        "--boxes-from": arguments.boxes_from != "both",
        "--no-agreement": arguments.no_agreement,
        "--without-rule": bool(arguments.without_rule),
    }
    for option in (option for option, is_given in given.items() if is_given):
        arguments.usage_error(f"{option} needs scans, and these are images; leave it out")
    models = arguments.model or [CAMERA]
    if len(models) > 1:
        arguments.usage_error(f"got {len(models)} models; images are evaluated with one --model")
    with progress("image") as show:
        how = keywords(arguments, "split", "provider", "precision")
        figures = evaluate_images(roots, models[0], on_image=show, **how)
    with lines_last(_image_lines(figures)):
        write_figures(arguments, figures)
    return 0


# Columns of the tables: heading and key. Shares are printed in per cent, each with its interval.
_RATES = (("precision", "precision"), ("recall", "recall"))
_OBJECT_COUNTS = (("objects", "n_objects"), ("drives", "n_drives"))
_LABELED_COLUMNS = (("labels", "n_boxes"), *_OBJECT_COUNTS)
_POINT_COLUMNS = (
    *interval_columns(("IoU", "iou"), ("IoU by drive", "iou_by_drive"), *_RATES),
    *(("points", "n_points"), *_OBJECT_COUNTS),
)
_HIT_COLUMNS = (("true", "n_truth"), ("predicted", "n_predicted"), ("hits", "n_hits"), *_OBJECT_COUNTS)
_BOX_COLUMNS = (
    *interval_columns(("AP50", "ap"), *_RATES, ("mIoU@.5", "mean_iou_50"), ("mIoU@.7", "mean_iou_70")),
    *_HIT_COLUMNS,
)
_ALL_ROUND_COLUMNS = (*interval_columns(("AP", "ap"), *_RATES), *_HIT_COLUMNS)
_HEADING_COLUMNS = (
    *interval_columns(("heading", "heading"), ("modulo half a turn", "axis"), ("front known", "front_known")),
    *(("boxes", "n_hits"), ("objects", "n_objects")),
)
_ERROR_COLUMNS = (
    *interval_columns(("share", "share")),
    *(("points", "n_points"), ("95 %", "n_points_interval"), ("of", "n_of"), ("scans", "n_scans")),
    *_OBJECT_COUNTS,
)
_CELL_COLUMNS = (
    *interval_columns(("IoU", "iou"), ("ACC", "accuracy"), ("mAP", "mean_ap"), ("mIoU", "mean_iou")),
    ("cells", "n_cells"),
)
_ROAD_COLUMNS = (
    *interval_columns(("F1", "f1"), ("AP", "ap"), ("ACC", "accuracy"), ("PRE", "precision"), ("REC", "recall")),
    ("cells", "n_cells"),
)
_ROAD_COLUMNS_2 = (
    *interval_columns(("IoU", "iou"), ("MaxF", "max_f1")),
    *interval_columns(("observed PRE", "drivable_precision"), ("observed REC", "drivable_recall")),
    ("cells", "n_cells"),
)
_PIXEL_COLUMNS = (*interval_columns(("IoU", "iou"), *_RATES), ("pixels", "n_pixels"), ("images", "n_images"))
_IMAGE_COLUMNS = (
    *interval_columns(("mIoU", "mean_iou"), ("accuracy", "accuracy"), ("mean recall", "mean_accuracy")),
    ("pixels", "n_pixels"),
)
_BLOCKS = {"real": "real scans with boxes", "semantickitti": "SemanticKITTI", "simulated": "simulated scans"}


def figure_lines(figures: Mapping[str, Any]) -> list[str]:
    """The tables of all blocks of figures."""
    models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
    fold = "" if figures["fold"] is None else f", fold {figures['fold']}"
    lines = [
        f"{models}; {figures['split']} drives{fold}; shares in per cent, intervals over drives",
        f"ran as {'; '.join(figures['providers'].values())}",
    ]
    blocks = [(name, figures.get(block)) for block, name in _BLOCKS.items()]
    for name, of_block in (*blocks, *figures.get("folders", {}).items()):
        if of_block is not None:
            lines += ["", f"== {name}: {many(of_block['n_frames'], 'scan')}, {many(of_block['n_drives'], 'drive')} =="]
            title = "labeled objects; boxes of one drive, class and size, to the centimeter, are one object"
            rows = [((_marked(label, row), ""), row) for label, row in of_block.get("labeled", {}).items()]
            lines += table_lines(title, _LABELED_COLUMNS, rows)
            for part in (_point_lines, box_lines, box_table_lines, error_lines, _cell_lines, _road_lines):
                lines += part(of_block)
    return lines


def _image_lines(figures: Mapping[str, Any]) -> list[str]:
    images = figures["images"]
    models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
    n_images, n_classes = many(images["n_images"], "image"), len(images["classes"])
    return [
        f"{models}; {figures['split']} images; shares in per cent, intervals over images",
        f"ran as {'; '.join(figures['providers'].values())}",
        "",
        f"== {n_images}, {n_classes} classes, unlabeled pixels not counted ==",
        *table_lines("all pixels", _IMAGE_COLUMNS, [(("all", ""), images["all"])]),
        *table_lines("classes", _PIXEL_COLUMNS, [((name, ""), row) for name, row in images["classes"].items()]),
    ]


def _point_lines(of_block: Mapping[str, Any]) -> list[str]:
    lines = []
    for kind, title in (
        ("points", "points; IoU by drive: each drive counts as one scan"),
        ("sure", "points without the ground in the boxes of objects, and without people who sit"),
        ("pixels", "points with the class of their pixel, before refinement"),
    ):
        columns = [column for column in _POINT_COLUMNS if kind == "points" or "iou_by_drive" not in column[1]]
        lines += table_lines(title, columns, _class_rows(of_block.get(kind, {}), "n_points"))
    return lines


def box_lines(of_block: Mapping[str, Any]) -> list[str]:
    """The tables of boxes."""
    lines = []
    for kind, of_kind in of_block.get("boxes", {}).items():
        means = {
            band: {"mean": {"ap": rows["mean_ap"], "ap_interval": rows.get("mean_ap_interval")}}
            for band, rows in of_kind.items()
            if rows["mean_ap"] is not None
        }
        rows = [*_class_rows(of_kind, "n_truth"), *_class_rows(means, "ap")]
        order = sorted(rows, key=lambda row: [*of_kind].index(row[0][0]))
        lines += table_lines(f"boxes where they can be detected, {kind}", _BOX_COLUMNS, order)
    title = "boxes wherever the truth is known, oriented: AP50 of vehicles, AP25 of pedestrians and cyclists"
    lines += table_lines(title, _ALL_ROUND_COLUMNS, _class_rows(of_block.get("all_round", {}), "n_truth"))
    for kind, where in (("boxes", "where they can be detected"), ("all_round", "wherever the truth is known")):
        rows = _class_rows(of_block.get("heading", {}).get(kind, {}), "n_hits")
        lines += table_lines(f"heading of boxes {where}, within 45 degrees of the true one", _HEADING_COLUMNS, rows)
    return lines


def error_lines(of_block: Mapping[str, Any]) -> list[str]:
    """The table of the causes of errors."""
    rows = [
        ((error, _marked(cause, row)), row)
        for error, causes in of_block.get("errors", {}).items()
        for cause, row in causes.items()
        if causes["all"]["n_points"]
    ]
    rows += [(("car at the own bumper", cause), row) for cause, row in of_block.get("bumper", {}).items()]
    title = "errors: wrong points by cause; a cause is a share of its error, and a point may have several"
    return table_lines(title, _ERROR_COLUMNS, rows)


def _cell_lines(of_block: Mapping[str, Any]) -> list[str]:
    lines = []
    for kind, of_kind in of_block.get("segmentation", {}).items():
        rows = []
        for band, row in of_kind.items():
            if row["n_cells"]:
                rows.append(((band, ""), row | {"iou": None, "iou_interval": None}))
                for name, n_cells in row["n_cells_of"].items():
                    of_class = {key: row[key][name] for key in ("iou", "iou_interval")}
                    rows.append(((band, name), of_class | {"n_cells": n_cells}))
        lines += table_lines(f"top view, {kind}", _CELL_COLUMNS, rows)
    return lines


def _road_lines(of_block: Mapping[str, Any]) -> list[str]:
    rows = [((band, ""), row) for band, row in of_block.get("road", {}).items() if row["n_cells"]]
    lines = table_lines("road", _ROAD_COLUMNS, rows)
    lines += table_lines("road, over all thresholds and where it was observed", _ROAD_COLUMNS_2, rows)
    for (band, _), row in rows[:1]:  # over all distances
        titles = ("no road", "road")
        shares = [
            ((band, f"true {name}"), dict(zip(titles, part, strict=True)))
            for name, part in zip(titles, row["confusion"], strict=True)
        ]
        lines += table_lines("road, confusion in shares of all cells", [(f"predicted {t}", t) for t in titles], shares)
    return lines


def _class_rows(bands: Mapping[str, Any], count: str) -> list[tuple[tuple[str, str], Mapping[str, Any]]]:
    """A row for each class and band that has objects or predictions."""
    return [
        ((band, _marked(name, row)), row)
        for band, rows in bands.items()
        for name, row in rows.items()
        if isinstance(row, Mapping) and (row[count] or row.get("n_predicted"))
    ]


def _marked(name: str, row: Mapping[str, Any]) -> str:
    return f"{name}{FEW}" if row.get("few") else name
