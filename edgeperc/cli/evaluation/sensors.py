"""``edgeperc eval-sensors``: accuracy on other sensors, with and without adaptation."""

from __future__ import annotations

import argparse

from ...system.printable import many
from ..arguments import Commands, add_command, add_figures_file, add_provider, keywords, options, positive
from ..output import FEW, lines_last, make_places, progress, table_lines, write_figures
from .box_tables import box_table_lines


def add_parser(commands: Commands) -> None:
    """Add ``eval-sensors``."""
    parser = add_command(
        commands,
        "eval-sensors",
        eval_sensors_command,
        help="accuracy on sensors that the model was not trained on",
        description="IoU of points by class on labeled scans of sensors that the model was not trained on: without "
        "adaptation, with the remission mapped, with interpolation between beams, and with both. In scans with boxes, "
        "the class of a point is its box's, and the AP of boxes is printed too, as KITTI and nuScenes measure it.",
        examples=[
            "edgeperc eval-sensors os1-64=simulation:24",
            "edgeperc eval-sensors PandaSet/:pandaset vlp-16=simulation:8 --json out.json",
            "edgeperc eval-sensors VoD/:vod auto=VoD/:vod",
            "edgeperc eval-sensors --find vlp-16=simulation KITTI/ drive.pcap",
        ],
    )
    reading = options(parser, "input")
    reading(
        "datasets SENSOR=SOURCE...",
        "a sensor's name or .json profile, and simulation:N or a folder of labeled range images NAME.npy; or "
        "labeled scans, without SENSOR=: a folder with scans.json, or FOLDER:LAYOUT with the name of a public set. "
        "auto=SOURCE finds the sensor of labeled scans in their points",
    )
    reading(
        "--find",
        "only print which sensors are found in the points of the first three scans of each set, and whether that "
        "is right; a set may then also be a capture, SENSOR=PATH of scans, or SENSOR=simulation (default: no)",
    )
    models = options(parser, "models")
    models(
        "--model MODEL",
        "a range-image model: a name from 'edgeperc models' or an .onnx file with a card (default: %(default)s)",
        default="pointseg",
    )
    add_provider(models, provider="cpu")
    models(
        "--workers N",
        "number of worker processes, each with one data set at a time; the results are the same (default: this "
        "process alone)",
        type=positive,
    )
    add_figures_file(options(parser, "output"))


def eval_sensors_command(arguments: argparse.Namespace) -> int:
    """Print IoU of points on other sensors, or which sensors are found."""
    make_places(arguments.json)
    if arguments.find:
        return _find(arguments)
    from ...evaluation.transfer import compare
    from ...perceiver import ADAPTATIONS

    with progress() as show:
        how = keywords(arguments, "provider", "precision", "workers")
        figures = compare(arguments.datasets, arguments.model, on_scan=show, **how)
    lines = ["IoU of points in per cent, mIoU over the classes shown"]
    for name, result in figures.items():
        rows = [((kind, ""), {**result[kind]["iou"], "mean": result[kind]["mean_iou"]}) for kind in ADAPTATIONS]
        counts = ", ".join(f"{count:,} {label}" for label, count in result["both"]["n_points"].items())
        if result["n_objects"] is not None:
            counts += "; objects: " + ", ".join(f"{n} {label}" for label, n in result["n_objects"].items())
        labels = [label for label in result["both"]["iou"] if label != "background"]
        columns = [(f"{label}{FEW * (label in result['few'])}", label) for label in labels]
        function = result["function"] or "no function"
        title = f"{name}, {result['network']}: {many(result['n_scans'], 'scan')}, {counts}; remission: {function}"
        lines += table_lines(title, (*columns, ("mIoU", "mean")), rows)
        lines += box_table_lines(result.get("boxes", {}))
        if "no_boxes" in result:
            lines.append(f"  no boxes: {result['no_boxes']}")
    with lines_last(lines):
        write_figures(arguments, figures)
    return 0


def _find(arguments: argparse.Namespace) -> int:
    from ...evaluation.transfer import find_sensors

    figures, lines = find_sensors(arguments.datasets), []
    for name, result in figures.items():
        off = "" if result["off_deg"] is None else f", off by at most {result['off_deg']:.2f} deg"
        lines.append(
            f"{name} ({result['sensor']}): found {', '.join(result['found']) or 'none'}; {result['right']} right, "
            f"{result['cannot_tell']} cannot tell, {result['wrong']} wrong{off}"
        )
    with lines_last(lines):
        write_figures(arguments, figures)
    return 1 if any(result["wrong"] for result in figures.values()) else 0
