"""``edgeperc eval-tracking``: tracking figures on KITTI's sequences."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import PointsError
from ...system.extras import require
from ...system.names import check_picture
from ...system.printable import many
from ..arguments import Commands, add_command, add_figures_file, add_networks, add_sensor, options, positive_number
from ..output import lines_last, make_places, progress, table_lines, without_nan, write_figures
from ..run import make_perceiver

if TYPE_CHECKING:
    from ...types.perception import Box


def add_parser(commands: Commands) -> None:
    """Add ``eval-tracking``."""
    parser = add_command(
        commands,
        "eval-tracking",
        eval_tracking_command,
        help="tracking figures on KITTI's sequences",
        description="Track KITTI's sequences without ego poses and compare the tracks with the labels: CLEAR-MOT at "
        "the score with the best MOTA, its averages over forty recalls, and HOTA; and how often the heading of a track "
        "points to its front. Kernels are compiled before the time is measured.\n\nThe boxes come from "
        "--boxes; without --boxes, from ROOT/detections; with --model, or if ROOT has no detections, from the models, "
        "which run on the scans in ROOT/velodyne.",
        examples=[
            "edgeperc eval-tracking tracking/",
            "edgeperc eval-tracking tracking/ --rules ab3dmot --rival ab3dmot",
            "edgeperc eval-tracking tracking/ --sequences 0000 0002 --gif 0000.gif",
            "edgeperc eval-tracking KITTI/ --model pointseg --json figures.json",
        ],
    )
    reading = options(parser, "input")
    reading(
        "root ROOT",
        "folder with label_02, calib, and detections/DETECTOR_CLASS or velodyne; or a KITTI object set with "
        "training/track_id",
        type=Path,
    )
    reading("--sequences SEQ...", "names such as 0000 0002 (default: all that have labels)")
    reading(
        "--boxes FILE",
        "track the boxes in this file, which 'edgeperc run --json' printed for one sequence; a scan's frame is the "
        "number in its name (default: none)",
    )
    add_sensor(reading)
    rules = options(parser, "evaluation")
    rules(
        "--classes CLASS...",
        "some of car, pedestrian, cyclist, vehicle; vehicle is cars, vans and trucks together, for boxes of "
        "models (default: car pedestrian cyclist)",
        choices=("car", "pedestrian", "cyclist", "vehicle"),
        default=["car", "pedestrian", "cyclist"],
    )
    rules(
        "--iou X",
        "smallest 3-D overlap (intersection over union) of a match, 0..1 (default: %(default)s)",
        type=positive_number,
        default=0.25,
    )
    rules(
        "--rules RULES",
        "ab3dmot: as AB3DMOT's program, with the image height of the detection instead of the track, sitting "
        "people not excused, and rounded scores; edgeperc: thresholds are compared exactly (default: %(default)s)",
        choices=("edgeperc", "ab3dmot"),
        default="edgeperc",
    )
    rules(
        "--smooth", "smooth the tracks of each sequence when it is over, as for labels: later scans help earlier ones"
    )
    rules(
        "--rival METHOD",
        "evaluate AB3DMOT's method, implemented again, on the same boxes by the same rules (default: none)",
        choices=("ab3dmot",),
    )
    add_networks(parser, "models, if the boxes come from scans")
    output = options(parser, "output")
    add_figures_file(output)
    output(
        "--gif FILE",
        "draw the first sequence's tracks from above, as an animation (needs the extra 'view'; default: none)",
    )


def eval_tracking_command(arguments: argparse.Namespace) -> int:
    """Print tracking figures on KITTI's sequences."""
    if arguments.gif is not None:
        require("PIL", "view", "Drawing an animation", package="pillow")
        check_picture(arguments.gif, ".gif")
    if arguments.boxes is not None and len(arguments.sequences or ()) != 1:
        arguments.usage_error("--boxes holds the boxes of one sequence; name it with --sequences SEQ")
    arguments.classes = [*dict.fromkeys(arguments.classes)]
    make_places(arguments.json, arguments.gif)
    from ...evaluation.tracking import evaluate_kitti, sequence_names, sequence_scans
    from ...records import read_boxes

    names = arguments.sequences or sequence_names(arguments.root)
    source = "given detections"
    boxes: dict[str, list[list[Box]]] = {}
    if arguments.boxes is not None:
        frames = {path.stem: frame for frame, path in sequence_scans(arguments.root, names[0]).items()}
        boxes, source = {names[0]: read_boxes(arguments.boxes, frames)}, f"boxes of {arguments.boxes}"
    elif arguments.model or arguments.weights != "default" or not (arguments.root / "detections").is_dir():
        boxes, source = _perceived(arguments, names)
    with progress("sequence") as show:
        figures = {"of": source} | evaluate_kitti(
            arguments.root,
            sequences=names,
            classes=arguments.classes,
            boxes=boxes,
            iou_threshold=arguments.iou,
            rules=arguments.rules,
            smooth=arguments.smooth,
            rival=arguments.rival is not None,
            on_sequence=show,
        )
    with lines_last(_tracking_lines(figures)):
        write_figures(arguments, without_nan(figures))
        if arguments.gif is not None:
            _draw(arguments, figures["sequences"][0], boxes)
    return 0


def _draw(arguments: argparse.Namespace, name: str, boxes: Mapping[str, list[list[Box]]]) -> None:
    """Draw the tracks of a sequence, above its scans if there are any."""
    import numpy as np

    from ...evaluation.tracking import read_sequence, sequence_scans, track_sequence
    from ...readers.files import read_points
    from ...view.tracks import draw_tracks, flatten_scan

    sequence = read_sequence(arguments.root, name, arguments.classes, boxes.get(name))
    tracks, scans = track_sequence(sequence, smooth=arguments.smooth)[0], sequence_scans(arguments.root, name)
    under = [
        flatten_scan(read_points(scans[k]) if k in scans else np.empty((0, 4), np.float32))
        for k in range(len(tracks) if scans else 0)
    ]
    draw_tracks(tracks, arguments.gif, under=under, title=f"sequence {sequence.name}")


def _perceived(arguments: argparse.Namespace, names: Sequence[str]) -> tuple[dict[str, list[list[Box]]], str]:
    """Run models on the scans: boxes by sequence and frame, and a text that names the models."""
    from ...evaluation.tracking import perceive_drive, sequence_scans

    scans = {name: sequence_scans(arguments.root, name) for name in names}
    for name, sequence in scans.items():
        if not sequence:
            raise PointsError(f"{arguments.root} has no scans of {name}; expected velodyne/{name}/*.bin, or detections")
    perceive = make_perceiver(arguments, sensor=arguments.sensor, on_mismatch="ignore", adapt=arguments.adapt)
    total, counted = sum(map(len, scans.values())), itertools.count(1)
    with progress() as show:
        boxes = {
            name: perceive_drive(perceive, sequence, name, lambda: show(next(counted), total))
            for name, sequence in scans.items()
        }
    return boxes, "boxes of " + " and ".join(f"{card.name} {card.version}" for card in perceive.cards)


_AVERAGE_COLUMNS = (
    *(("sAMOTA", "samota"), ("AMOTA", "amota"), ("AMOTP", "amotp"), ("MOTA", "mota"), ("MOTP", "motp")),
    *(("HOTA", "hota"), ("DetA", "deta"), ("AssA", "assa"), ("fragments", "n_fragments")),
)
_COUNT_COLUMNS = (
    *(("frames", "n_frames"), ("objects", "n_objects"), ("boxes", "n_truth"), ("false alarms", "n_false")),
    *(("missed", "n_missed"), ("ID switches", "n_switches")),
)


_HEADING_COLUMNS = (
    *(("boxes", "n_boxes"), ("tracks", "n_tracks"), ("known front", "n_resolved"), ("right of known", "right")),
    ("right of all", "right_of_all"),
)
_PREDICTION_COLUMNS = (
    *(("predictions", "n_predictions"), ("objects", "n_objects"), ("on their arc", "error_mm")),
    ("straight on", "straight_mm"),
)


def _tracking_lines(figures: Mapping[str, Any]) -> list[str]:
    methods = {"": figures["classes"]}
    if "rival" in figures:
        methods = {"edgeperc": figures["classes"], "AB3DMOT's method": figures["rival"]}
    every = [((method, name), of) for method, by in methods.items() for name, of in by.items()]
    rows = [(name, without_nan({**of, **of["best"], **of["hota"]})) for name, of in every]
    of_all = [(name, without_nan({**of, **of["all_tracks"]})) for name, of in every]
    headings = []
    for kind in ("moving", "stopped", "parked"):
        for name, of in figures["headings"].items():
            if (counts := of[kind])["n_boxes"]:
                right = counts["n_right"] / counts["n_resolved"] if counts["n_resolved"] else None
                shares = {"right": right, "right_of_all": counts["n_right_of_all"] / counts["n_boxes"]}
                headings.append(((kind, name), counts | shares))
    predictions = [
        ((name, ahead), of | {key: f"{of[key] / of['n_predictions'] / 1e3:.2f}" for key in ("error_mm", "straight_mm")})
        for name, by in figures["predictions"].items()
        for ahead, of in by.items()
        if of["n_predictions"]
    ]
    return [
        f"{many(len(figures['sequences']), 'sequence')}, {figures['of']}, 3-D IoU {figures['iou_threshold']}, rules "
        f"{figures['rules']}{', smoothed' * figures['smooth']}; {figures['frames_per_s']:,.0f} scans a second in the "
        "tracker; shares in per cent",
        *table_lines("over forty recalls; at the best MOTA", _AVERAGE_COLUMNS, rows),
        *table_lines("counts at the best MOTA", _COUNT_COLUMNS, rows),
        *table_lines("counts of all tracks, with any score", _COUNT_COLUMNS, of_all),
        *table_lines("headings within a quarter turn of the label's", _HEADING_COLUMNS, headings),
        *table_lines("from where a moving object is after a time, mean in m", _PREDICTION_COLUMNS, predictions),
    ]
