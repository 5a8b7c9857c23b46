"""``edgeperc demo``: the bundled scene."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import MissingExtraError
from .arguments import Commands, add_command, add_model, add_network
from .output import one_line, print_rows
from .run import make_perceiver

if TYPE_CHECKING:
    from ..perception import Box, Perception

__all__ = ["add_parser", "demo_command"]

# A junction with cars, a van, pedestrians and a cyclist, most of which the models detect. Training scenes have other
# seeds.
DEMO_SCENE = (2_000_000_218, "junction")


def add_parser(commands: Commands) -> None:
    """Add ``demo``."""
    parser = add_command(
        commands,
        "demo",
        demo_command,
        help="perceive a bundled scene: a table, a picture and a 3-D page",
        description="Perceive one simulated hdl-64e scan with known labels. Print the results and the time, and write "
        "scene.png (needs the extra 'view') and scene.html. The command needs no data.",
        examples=[
            "edgeperc demo",
            "edgeperc demo --out /tmp/demo --model pointseg --full-turn",
        ],
    )
    output = parser.add_argument_group("output")
    output.add_argument(
        "--out",
        type=Path,
        default=Path("edgeperc-demo"),
        metavar="DIR",
        help="folder for scene.png and scene.html, made if needed (default: %(default)s)",
    )
    models = parser.add_argument_group("models")
    add_model(models)
    add_network(models)


def demo_command(arguments: argparse.Namespace) -> int:
    """Perceive the bundled scene, print a table and write a picture and a page."""
    import numpy as np

    from .. import view
    from ..simulation.drawn import random_scene
    from ..simulation.scene import simulate

    perceive = make_perceiver(arguments, sensor="hdl-64e", on_mismatch="ignore")
    scan = simulate(random_scene(*DEMO_SCENE), "hdl-64e", DEMO_SCENE[0])
    perceive(scan.points)  # warm-up: the first scan takes longer
    perception = perceive(scan.points)

    rows = [("scene", f"{perception.n_points:,} points, a simulated hdl-64e in a street with known labels")]
    if perception.top_view is not None:
        area_m2 = perception.top_view.drivable_area_m2
        rows.append(("drivable", f"{area_m2:.0f} m2 of the {_extent(perception)} ahead"))
    found = [_box_text(box) for box in perception.boxes] or ["none"]
    rows += [("boxes" if k == 0 else "", text) for k, text in enumerate(found)]
    if perception.points is not None:
        true = np.bincount(scan.labels[perception.points.in_view], minlength=len(perception.points.classes))
        for k, (name, count) in enumerate(perception.points.counts().items()):
            rows.append(("points" if k == 0 else "", f"{name:<12}{count:>9,}   (true: {true[k]:,})"))
    total_ms = sum(perception.stage_ms.values())
    rows.append(("time", f"{total_ms:.1f} ms: " + ", ".join(f"{k} {ms:.1f}" for k, ms in perception.stage_ms.items())))
    for k, (name, provider) in enumerate(perception.providers.items()):
        rows.append(("ran on" if k == 0 else "", f"{name}: {provider}"))

    arguments.out.mkdir(parents=True, exist_ok=True)
    page, picture = arguments.out / "scene.html", arguments.out / "scene.png"
    title = "edgeperc demo: a simulated street"
    view.write_html(perception, scan.points, page, title=title)
    try:
        view.draw(perception, scan.points, picture, title=title)
        rows.append(("picture", str(picture)))
    except MissingExtraError as exc:
        rows.append(("picture", one_line(exc)))
    rows.append(("3-D page", f"{page} (open it in a browser)"))
    print_rows(rows)
    return 0


def _extent(perception: Perception) -> str:
    assert perception.top_view is not None
    (x_near, x_far), (y_right, y_left) = perception.top_view.x_range_m, perception.top_view.y_range_m
    return f"{x_far - x_near:.0f} x {y_left - y_right:.0f} m"


def _box_text(box: Box) -> str:
    x, y, _ = box.center
    length, width, height = box.size
    side = f"{abs(y):4.1f} m {'left' if y >= 0 else 'right'}"
    return (
        f"{box.label:<10}{box.score:5.2f}   {math.hypot(x, y):5.1f} m away: {x:5.1f} m ahead, {side:<13}"
        f"{length:.1f} x {width:.1f} x {height:.1f} m, heading {round(math.degrees(box.yaw)):4d} deg"
    )
