"""Picture of a street seen by both sensors: the image with its classes, the points in it, and both from above."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..camera.calibration import Calibration
from ..camera.painting import UNSEEN, camera_road, paint
from ..system.printable import many
from ..types.frame import ModelFrame
from ..types.perception import Box, Perception, TopView, scan_of
from ..types.points import Bytes, Floats, Labels, Points
from ..types.sensor import SensorProfile
from .canvas import add_axes, as_png, height_of_legend, new_figure, show, write_heading
from .colors import FAINT, color_of, pixel_colors, rgb
from .content import drawable_boxes, drawable_points, perceived_image
from .picture import Place, axes_from_above, write_frame

# Sizes in pixels.
_WIDTH, _MARGIN, _TOP, _GAP, _AXIS = 1600, 28, 128, 44, 62
_NARROWEST, _WIDEST, _HIGHEST = 750, 888, 560  # of the panels of the image; headings need the width
_BESIDE_M, _BEHIND_M, _BEYOND_M = 4.0, 8.0, 2.0  # of the panel from above, outside the view


def draw_painted(
    perception: Perception,
    image: Bytes,
    points: ArrayLike,
    calibration: Calibration,
    path: str | Path | None = None,
    *,
    sensor: str | os.PathLike[str] | SensorProfile | None = None,
    title: str = "",
) -> bytes:
    """Draw what a camera and a LiDAR see of the same street.

    Parameters
    ----------
    perception : Perception
        With an `edgeperc.ImageLabels`; its boxes are drawn from above.
    image : (H, W, 3) uint8
        The image that was perceived.
    points : (n, 4) or (n, 3) array_like, or a structured array
        The scan that was perceived: x, y, z [m] in the sensor frame, remission.
    calibration : Calibration
    path : str or Path, optional
        File to write as well; an existing file is replaced atomically.
    sensor : str, Path or SensorProfile, optional
        As for `edgeperc.paint`.
    title : str

    Returns
    -------
    png : bytes
        1600 pixels wide. Above the image in the colors of its classes, below the points in the image, each in the
        color of the class that `edgeperc.paint` gives it, beside them these points and the road of the image
        (`edgeperc.camera_road`) from above.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    ImageError, PointsError, CalibrationError
        The image, the points and the calibration do not belong to the perception.
    OptionError
        ``path`` is named as a picture of another kind.
    OSError
        The file cannot be written.
    """
    image, labels = perceived_image(image, perception)
    points = scan_of(perception, points)
    painted = paint(perception, points, calibration, sensor=sensor)
    road = camera_road(perception, points, calibration, sensor=sensor)

    aspect = calibration.width / calibration.height
    width = min(_WIDEST, _HIGHEST * aspect)
    height = width / aspect
    bottom = _TOP + max(2.0 * height + _GAP, 740.0)
    counts = np.bincount(painted, minlength=256)
    facts = {
        name: [f"{100.0 * n / labels.labels.size:.1f} %"] + [many(int(counts[k]), "point")] * bool(counts[k])
        for k, (name, n) in enumerate(labels.counts().items())
        if n
    }
    told = {color_of(name) for name in facts}
    kinds = dict.fromkeys(box.label for box in perception.boxes if color_of(box.label) not in told)
    facts |= {name: ["boxes alone"] for name in kinds}
    figure = new_figure(_WIDTH, int(bottom) + 40 + height_of_legend(facts) + 84)
    colors = pixel_colors(labels.classes)
    write_heading(figure, _MARGIN, _TOP - 20, "the camera", "a class for every pixel")
    axes = add_axes(figure, _MARGIN, _TOP, width, height)
    show(axes, 0.5 * image / 255.0 + 0.5 * colors[labels.labels], interpolation="antialiased")
    _draw_points(figure, (_MARGIN, _TOP + height + _GAP, width, height), image, points, calibration, colors, painted)
    left = _MARGIN + max(width, _NARROWEST) + 34.0 + _AXIS
    room = (left, _TOP, _WIDTH - _MARGIN - left, bottom - _TOP)
    _draw_from_above(figure, room, points, road, perception.boxes, colors, painted)

    share = f"{np.count_nonzero(painted != UNSEEN):,} of {len(points):,} points are seen by the camera"
    tops = bottom + 40, bottom + 40 + height_of_legend(facts) + 34
    write_frame(figure, perception, (title, 1000), share, facts, tops)
    return as_png(figure, path)


def _draw_points(
    figure: Any, place: Place, image: Bytes, points: Points, calibration: Calibration, colors: Floats, painted: Labels
) -> None:
    more = "in the colors of their pixels; black: hidden or no class"
    write_heading(figure, place[0], place[1] - 20, "the points in the image", more)
    axes = add_axes(figure, *place)
    gray = image.mean(axis=2, keepdims=True).repeat(3, axis=2) / 255.0
    show(axes, 0.35 + 0.4 * gray, interpolation="antialiased")
    axes.set_autoscale_on(False)
    u, v, depth = calibration.project(points)
    inside = (u >= 0.0) & (u < calibration.width) & (v >= 0.0) & (v < calibration.height)
    seen = painted != UNSEEN
    for shown, size, shades in ((inside & ~seen, 1.0, np.zeros_like(colors)), (inside & seen, 3.2, colors)):
        far_first = np.flatnonzero(shown)[np.argsort(-depth[shown], kind="stable")]
        axes.scatter(u[far_first], v[far_first], s=size, c=shades[painted[far_first]], marker="o", linewidths=0)


def _draw_from_above(
    figure: Any, room: Place, points: Points, road: TopView, boxes: tuple[Box, ...], colors: Floats, painted: Labels
) -> None:
    from matplotlib.patches import Polygon

    (x_near, x_far), (y_right, y_left) = road.x_range_m, road.y_range_m
    low, high, right, left = x_near - _BEHIND_M, x_far + _BEYOND_M, y_right - _BESIDE_M, y_left + _BESIDE_M
    frame = ModelFrame(road.mounting)
    shown = np.flatnonzero(drawable_points(points) & (painted != UNSEEN))
    x, y, z = frame.move(points[shown])[:, :3].astype(np.float64).T
    axes, _ = axes_from_above(figure, room, (low, high, right, left), bool((x < low).any()))
    more = f"the image's road ahead, {road.drivable_area_m2:.0f} m²; gray: not seen"
    write_heading(figure, room[0], room[1] - 20, "from above", more)
    layer = np.zeros((*road.labels.shape, 4))
    layer[road.drivable] = (*rgb([color_of("road")])[0], 0.62)
    layer[~road.observed] = (*rgb([FAINT])[0], 0.22)
    show(axes, layer, extent=(y_left, y_right, x_near, x_far), interpolation="nearest", zorder=1)
    order = np.argsort(z, kind="stable")
    axes.scatter(y[order], x[order], s=2.0, c=colors[painted[shown[order]]], marker="o", linewidths=0, zorder=2)
    style: dict[str, Any] = {"closed": True, "fill": False, "linewidth": 2.0, "zorder": 3}
    for box in drawable_boxes(frame.move_boxes(boxes)):
        axes.add_patch(Polygon(box.corners()[:, ::-1], edgecolor=color_of(box.label), **style))
