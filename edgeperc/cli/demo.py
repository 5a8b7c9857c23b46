"""``edgeperc demo``: the bundled scene."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import MissingExtraError
from ..system.atomic import open_atomic, write_atomic
from ..system.extras import require
from ..types.choices import CAMERA
from .arguments import Commands, add_command, add_networks, chosen_models, options
from .output import make_folder, one_line, print_rows
from .run import make_perceiver

if TYPE_CHECKING:
    from ..camera.calibration import Calibration
    from ..simulation.camera import CameraImage
    from ..simulation.scene import SimulatedScan
    from ..types.perception import Box, Perception


# A junction with cars, a van, pedestrians and a cyclist, most of which the models detect. Training scenes have other
# seeds.
DEMO_SCENE = (2_000_000_218, "junction")
# Below this share of right pixels, the demo shows how painting works with the true classes instead of the network's.
_GOOD_PIXELS = 0.8


def add_parser(commands: Commands) -> None:
    """Add ``demo``."""
    parser = add_command(
        commands,
        "demo",
        demo_command,
        help="perceive a bundled scene: a table, a picture and a 3-D page",
        description="Perceive one simulated hdl-64e scan with known labels. Print the results and the time, and write "
        "scan.bin, the scan itself to try other commands on, scene.png (needs the extra 'view') and scene.html; with "
        "--camera also image.png and camera.png. The command needs no data.",
        examples=[
            "edgeperc demo",
            "edgeperc demo --camera",
            "edgeperc demo --out /tmp/demo --model pointseg --full-turn",
        ],
    )
    options(parser, "output")(
        "--out DIR",
        "folder for scan.bin, scene.png and scene.html, made if needed (default: %(default)s)",
        default=Path("edgeperc-demo"),
    )
    options(parser)(
        "--camera",
        "also draw the image of a camera in the street, label it, carry its classes to the points and its road to "
        "the top view, and write image.png and camera.png",
    )
    add_networks(parser, adapt=False)


def demo_command(arguments: argparse.Namespace) -> int:
    """Perceive the bundled scene, print a table and write a picture and a page."""
    import numpy as np

    from .. import view
    from ..datasets.layout import numbers_of_scene
    from ..ground.leveling import FROZEN_AFTER
    from ..simulation.drawn import random_scene
    from ..simulation.samples import labels_of_scene
    from ..simulation.scene import simulate
    from ..zoo import shipped_models

    if arguments.camera and not arguments.model and CAMERA in shipped_models():
        arguments.model, arguments.weights = [*chosen_models(arguments), CAMERA], "default"
    perceive = make_perceiver(arguments, sensor="hdl-64e", on_mismatch="ignore")
    make_folder(arguments.out, "--out")
    scan = simulate(random_scene(*DEMO_SCENE), "hdl-64e", DEMO_SCENE[0])
    image = None
    if arguments.camera:
        from ..simulation.camera import forward_camera, render

        calibration = forward_camera()
        drawn = render(scan.scene, calibration, scan.T_world_sensor, DEMO_SCENE[0])
        image = drawn.rgb if any(card.view.kind == "camera" for card in perceive.cards) else None
    for _ in range(FROZEN_AFTER):  # these take longer: mounting and remission are estimated from them
        perceive(scan.points, image=image)
    perception = perceive(scan.points, image=image)

    rows = [("scene", f"{perception.n_points:,} points, a simulated hdl-64e in a street with known labels")]
    if perception.top_view is not None:
        (x_near, x_far), (y_right, y_left) = perception.top_view.x_range_m, perception.top_view.y_range_m
        extent = f"{x_far - x_near:.0f} x {y_left - y_right:.0f} m"
        rows.append(("drivable", f"{perception.top_view.drivable_area_m2:.0f} m2 of the {extent} ahead"))
    texts = [_box_text(box) for box in perception.boxes] or ["none"]
    rows += [("boxes" if k == 0 else "", text) for k, text in enumerate(texts)]
    if perception.points is not None:
        labels = numbers_of_scene(perception.points.classes)[labels_of_scene(scan)]
        true = np.bincount(labels[perception.points.in_view], minlength=len(perception.points.classes))
        for k, (name, count) in enumerate(perception.points.counts().items()):
            rows.append(("points" if k == 0 else "", f"{name:<12}{count:>9,}   (true: {true[k]:,})"))
    total_ms = sum(perception.stage_ms.values())
    stages = ", ".join(f"{stage} {ms:.1f}" for stage, ms in perception.stage_ms.items())
    rows.append(("time", f"{total_ms:.1f} ms for scan {FROZEN_AFTER + 1}: {stages}"))
    for k, (name, provider) in enumerate(perception.providers.items()):
        rows.append(("ran on" if k == 0 else "", f"{name}: {provider}"))

    page, picture = arguments.out / "scene.html", arguments.out / "scene.png"
    title = "edgeperc demo: a simulated street"
    view.write_html(perception, scan.points, page, title=title)
    try:
        view.draw(perception, scan.points, picture, title=title)
        rows.append(("picture", str(picture)))
    except MissingExtraError as exc:
        rows.append(("picture", one_line(exc)))
    rows.append(("3-D page", f"{page} (open it in a browser)"))
    file = arguments.out / "scan.bin"
    write_atomic(file, scan.points.astype("<f4").tobytes())
    rows.append(("scan", f"{file} (try: edgeperc info {file})"))
    if arguments.camera:
        rows += _camera_rows(scan, drawn, calibration, perception, arguments.out / "camera.png")
    print_rows(rows)
    return 0


def _camera_rows(
    scan: SimulatedScan, drawn: CameraImage, calibration: Calibration, perception: Perception, picture: Path
) -> list[tuple[str, str]]:
    import numpy as np

    from .. import view
    from ..camera.painting import UNSEEN, camera_road, paint
    from ..simulation.camera import CAMERA_CLASSES, VOID, true_classes
    from ..types.perception import ImageLabels

    rows = [("image", f"{calibration.width} x {calibration.height} pixels, drawn from the scene, not a photograph")]
    known, labels, source = drawn.labels != VOID, perception.image, "the network's classes"
    if labels is None:
        rows.append(("camera", "no model of a camera's images ran"))
    else:
        names = [name.casefold() for name in CAMERA_CLASSES]
        to_camvid = np.array([names.index(n) if (n := name.casefold()) in names else VOID for name in labels.classes])
        share = float(np.mean(to_camvid[labels.labels[known]] == drawn.labels[known]))
        rows.append(("camera", f"{100.0 * share:.0f} % of the pixels get their true class"))
        rows.append(("", "The network was trained on photographs; a drawing says little about its accuracy."))
    if labels is None or share < _GOOD_PIXELS:
        perception = replace(perception, image=ImageLabels(drawn.labels, CAMERA_CLASSES))
        source = "the scene's true classes, not those of a network"
    painted = paint(perception, scan.points, calibration)
    seen, true = painted != UNSEEN, true_classes(scan)
    rows.append(("painted", source))
    rows.append(("", f"{np.count_nonzero(seen):,} points are seen by the camera"))
    judged = seen & (true != VOID)
    rows.append(
        ("", f"{100.0 * np.mean(painted[judged] == true[judged]):.1f} % of them have the class of their surface")
    )
    road = camera_road(perception, scan.points, calibration)
    rows.append(("road", f"{road.drivable_area_m2:.0f} m2 of the image's road lie on the ground that the scan shows"))
    try:
        image = picture.with_name("image.png")
        with open_atomic(image) as file:
            require("PIL.Image", "camera", "Writing an image", package="pillow").fromarray(drawn.rgb).save(file, "PNG")
        rows.append(("image", f"{image} (try: edgeperc run {image} --json)"))
        title = f"edgeperc demo, {source.partition(',')[0]}"  # what does not fit into the picture is cut
        view.draw_painted(perception, drawn.rgb, scan.points, calibration, picture, title=title)
        rows.append(("picture", str(picture)))
    except MissingExtraError as exc:
        rows.append(("picture", one_line(exc)))
    return rows


def _box_text(box: Box) -> str:
    x, y, _ = box.center
    length, width, height = box.size
    side = f"{abs(y):4.1f} m {'left' if y >= 0 else 'right'}"
    return (
        f"{box.label:<10}{box.score:5.2f}   {math.hypot(x, y):5.1f} m away: {x:5.1f} m ahead, {side:<13}"
        f"{length:.1f} x {width:.1f} x {height:.1f} m, heading {round(math.degrees(box.yaw)):4d} deg"
    )
