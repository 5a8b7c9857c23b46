"""``edgeperc eval``: figures of accuracy on labelled scans, other sensors and tracking sequences."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ..errors import PointsError
from ..zoo import DEFAULT
from .output import (
    Progress,
    counted_progress,
    many,
    require_matplotlib,
    require_pillow,
    table_lines,
    without_nan,
    write_figures,
)
from .run import make_perceiver

if TYPE_CHECKING:
    from ..perception import Box

__all__ = ["eval_command", "eval_sensors_command", "eval_tracking_command"]


def eval_sensors_command(arguments: argparse.Namespace) -> int:
    """``edgeperc eval sensors``: IoU of points on other sensors."""
    from ..evaluation.transfer import compare

    with counted_progress() as on_scan:
        figures = compare(arguments.datasets, arguments.model, provider=arguments.provider, on_scan=on_scan)
    lines = [f"{arguments.model}; IoU of points in per cent, mIoU over the classes shown"]
    for name, told in figures.items():
        rows = [
            ((kind, ""), {**told[kind]["iou"], "mean": told[kind]["mean_iou"]})
            for kind in ("neither", "remission", "interpolation", "both")
        ]
        there = ", ".join(f"{count:,} {label}" for label, count in told["both"]["n_points"].items())
        columns = [(label, label) for label in told["both"]["iou"] if label != "background"]
        title = f"{name}: {many(told['n_scans'], 'scan')}, {there}; remission: {told['function'] or 'no function'}"
        lines += table_lines(title, (*columns, ("mIoU", "mean")), rows)
    print("\n".join(lines))
    write_figures(arguments, figures)
    return 0


def eval_command(arguments: argparse.Namespace) -> int:
    """``edgeperc eval``: compare models with labelled scans."""
    if arguments.worst is not None:
        require_matplotlib()
    for file in filter(None, (arguments.json, arguments.worst)):
        file.parent.mkdir(parents=True, exist_ok=True)
    from ..evaluation.evaluate import evaluate

    with counted_progress() as on_scan:
        figures, mistakes = evaluate(
            arguments.datasets,
            arguments.model or DEFAULT,
            split=arguments.split,
            fold=arguments.fold,
            road_by=arguments.road_by,
            boxes_from=arguments.boxes_from,
            provider=arguments.provider,
            on_scan=on_scan,
        )
    print("\n".join(_figure_lines(figures)))
    write_figures(arguments, figures)
    if arguments.worst is not None:
        from ..view.mistakes import draw_mistakes

        models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
        draw_mistakes(mistakes, arguments.worst, title=f"the {len(mistakes)} scans with most mistakes: {models}")
    return 0


def eval_tracking_command(arguments: argparse.Namespace) -> int:
    """``edgeperc eval tracking``: tracking figures on KITTI's sequences."""
    if arguments.gif is not None:
        require_pillow()
    if arguments.boxes is not None and len(arguments.sequences or ()) != 1:
        arguments.usage_error("--boxes are of one drive; add --sequences SEQ")
    for file in filter(None, (arguments.json, arguments.gif)):
        file.parent.mkdir(parents=True, exist_ok=True)
    from ..evaluation.tracking import evaluate_kitti, read_sequence, sequence_names, track_sequence
    from ..records import read_boxes

    names = arguments.sequences or sequence_names(arguments.root)
    of = "given detections"
    boxes: dict[str, list[list[Box]]] = {}
    if arguments.boxes is not None:
        boxes, of = {names[0]: read_boxes(arguments.boxes)}, f"boxes of {arguments.boxes}"
    elif arguments.model or not (arguments.root / "detections").is_dir():
        boxes, of = _perceived(arguments, names)
    with counted_progress() as on_sequence:
        figures = {"of": of} | evaluate_kitti(
            arguments.root,
            sequences=names,
            classes=arguments.classes,
            boxes=boxes,
            iou_threshold=arguments.iou,
            on_sequence=on_sequence,
        )
    print("\n".join(_tracking_lines(figures)))
    write_figures(arguments, without_nan(figures))
    if arguments.gif is not None:
        from ..view.tracks import draw_tracks

        name = figures["sequences"][0]
        sequence = read_sequence(arguments.root, name, arguments.classes, boxes.get(name))
        draw_tracks(track_sequence(sequence)[0], arguments.gif, title=f"sequence {sequence.name}")
    return 0


def _perceived(arguments: argparse.Namespace, names: Sequence[str]) -> tuple[dict[str, list[list[Box]]], str]:
    """By sequence and frame, what the models find in the scans; and their names."""
    from ..evaluation.tracking import perceive_drive, sequence_scans

    scans = {name: sequence_scans(arguments.root, name) for name in names}
    for name, of in scans.items():
        if not of:
            raise PointsError(f"{arguments.root} has no scans of {name}; expected velodyne/{name}/*.bin, or detections")
    perceive = make_perceiver(arguments, arguments.sensor, "ignore", arguments.adapt)
    progress, counted = Progress(sum(map(len, scans.values()))), itertools.count(1)
    boxes = {
        name: perceive_drive(perceive, of, name, lambda: progress.show(next(counted))) for name, of in scans.items()
    }
    progress.clear()
    return boxes, "boxes of " + " and ".join(f"{card.name} {card.version}" for card in perceive.cards)


_AVERAGE_COLUMNS = (
    *(("sAMOTA", "samota"), ("AMOTA", "amota"), ("AMOTP", "amotp"), ("MOTA", "mota"), ("MOTP", "motp")),
    *(("HOTA", "hota"), ("DetA", "deta"), ("AssA", "assa"), ("fragments", "n_fragments")),
)
_COUNT_COLUMNS = (
    *(("frames", "n_frames"), ("objects", "n_objects"), ("boxes", "n_truth"), ("false alarms", "n_false")),
    *(("missed", "n_missed"), ("ID switches", "n_switches")),
)


def _tracking_lines(figures: Mapping[str, Any]) -> list[str]:
    rows = [(("", name), without_nan({**of, **of["best"], **of["hota"]})) for name, of in figures["classes"].items()]
    told = [(("", name), without_nan({**of, **of["told"]})) for name, of in figures["classes"].items()]
    return [
        f"{many(len(figures['sequences']), 'sequence')}, {figures['of']}, 3-D IoU {figures['iou_threshold']}; "
        f"{figures['frames_per_s']:,.0f} scans a second in the tracker; shares in per cent",
        *table_lines("over forty recalls; at the best MOTA", _AVERAGE_COLUMNS, rows),
        *table_lines("counts at the best MOTA", _COUNT_COLUMNS, rows),
        *table_lines("counts of all tracks, whatever their score", _COUNT_COLUMNS, told),
    ]


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
    *(("REC", "recall"), ("IoU", "iou"), ("MaxF", "max_f1"), ("cells", "n_cells")),
)
_BLOCKS = {"real": "real scans with boxes", "semantickitti": "SemanticKITTI", "simulated": "simulated scans"}


def _figure_lines(figures: Mapping[str, Any]) -> list[str]:
    models = ", ".join(f"{name} {version}" for name, version in figures["models"].items())
    fold = "" if figures["fold"] is None else f", fold {figures['fold']}"
    lines = [f"{models}; {figures['split']} drives{fold}; shares in per cent, intervals over drives"]
    for block, name in _BLOCKS.items():
        if block not in figures:
            continue
        told = figures[block]
        lines += ["", f"== {name}: {many(told['n_frames'], 'scan')}, {many(told['n_drives'], 'drive')} =="]
        for kind, title in (("points", "points"), ("pixels", "points, each as its pixel, unrefined")):
            lines += table_lines(title, _POINT_COLUMNS, _class_rows(told.get(kind, {}), "n_points"))
        for kind, of_kind in told.get("boxes", {}).items():
            means = {
                band: {"mean": {"ap": rows["mean_ap"], "ap_interval": rows.get("mean_ap_interval")}}
                for band, rows in of_kind.items()
                if rows["mean_ap"] is not None
            }
            rows = [*_class_rows(of_kind, "n_truth"), *_class_rows(means, "ap")]
            lines += table_lines(
                f"boxes, {kind}", _BOX_COLUMNS, sorted(rows, key=lambda row: [*of_kind].index(row[0][0]))
            )
        for kind, of_kind in told.get("segmentation", {}).items():
            names = next(iter(of_kind.values()))["iou"]
            columns = (*_MAP_COLUMNS, *((name, name) for name in names), ("cells", "n_cells"))
            rows = [((band, ""), {**row, **row["iou"]}) for band, row in of_kind.items() if row["n_cells"]]
            lines += table_lines(f"top view, {kind}; the classes' columns are IoU", columns, rows)
        rows = [((band, ""), row) for band, row in told.get("road", {}).items() if row["n_cells"]]
        lines += table_lines("road", _ROAD_COLUMNS, rows)
        for (band, _), row in rows[:1]:  # of all of them
            titles = ("no road", "road")
            shares = [
                ((band, f"is {name}"), dict(zip(titles, part, strict=True)))
                for name, part in zip(titles, row["confusion"], strict=True)
            ]
            lines += table_lines(
                "road, confusion in shares of all cells", [(f"taken for {t}", t) for t in titles], shares
            )
    return lines


def _class_rows(bands: Mapping[str, Any], count: str) -> list[tuple[tuple[str, str], Mapping[str, Any]]]:
    """A row a class and band, of those with anything to tell."""
    return [
        ((band, name), row)
        for band, rows in bands.items()
        for name, row in rows.items()
        if isinstance(row, Mapping) and (row[count] or row.get("n_predicted"))
    ]
