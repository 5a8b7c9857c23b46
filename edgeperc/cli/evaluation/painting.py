"""``edgeperc eval-painting``: how well an image's classes get to points and to the top view."""

from __future__ import annotations

import argparse

from ...system.printable import many
from ..arguments import Commands, add_command, add_figures_file, options
from ..output import lines_last, make_places, progress, table_lines, write_figures

# Places of the camera in the LiDAR's frame: as on KITTI's car, and behind a windscreen below a LiDAR on the roof.
_PLACES = {"0.3 m": (0.27, 0.0, -0.08), "0.9 m": (0.5, 0.5, -0.6)}
_COLUMNS = (
    ("points", "points_right"),
    ("untested", "points_right_untested"),
    ("seen", "points_seen"),
    ("cells", "cells_right"),
    ("to 26 m", "near_cells_right"),
    ("road IoU", "road_iou"),
    ("road seen", "road_seen"),
)


def add_parser(commands: Commands) -> None:
    """Add ``eval-painting``."""
    parser = add_command(
        commands,
        "eval-painting",
        eval_painting_command,
        help="how well an image's classes get to the points of a scan and to the top view",
        description="Shares in simulated streets, with the true classes of a camera's image. points: painted points "
        "that have the class of their own surface, at least 3 pixels from the edges of classes. untested: the same if "
        "every point took the class of its pixel, hidden or not. seen: points visible to the camera that are painted. "
        "cells: seen cells of the top view, outside vehicles, that are rightly road or not. road seen: road that the "
        "camera sees. The command needs no data and no model.",
        examples=["edgeperc eval-painting", "edgeperc eval-painting --sensor os1-64 --scenes 20 --json painting.json"],
    )
    reading = options(parser, "input")
    reading(
        "--sensor SENSOR",
        "a sensor's name or .json profile; repeat the option for several (default: hdl-64e, os1-64 and vlp-16)",
        action="append",
    )
    reading("--scenes N", "number of simulated streets (default: %(default)s)", type=int, default=10)
    add_figures_file(options(parser, "output"))


def eval_painting_command(arguments: argparse.Namespace) -> int:
    """Print shares of points and cells."""
    from ...evaluation.painting import evaluate_painting

    make_places(arguments.json)
    figures, rows = {}, []
    with progress() as show:
        for sensor in arguments.sensor or ("hdl-64e", "os1-64", "vlp-16"):
            for name, place in _PLACES.items():
                found = evaluate_painting(sensor, arguments.scenes, at_m=place, on_scene=show)
                figures[f"{sensor}, {name}"] = found
                rows.append(((sensor, name), found))
    title = f"{many(arguments.scenes, 'simulated street')}; camera 0.3 and 0.9 m from the LiDAR; per cent"
    with lines_last(table_lines(title, _COLUMNS, rows)):
        write_figures(arguments, figures)
    return 0
