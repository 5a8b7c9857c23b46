"""Picture of a scan: from behind, from above and as a range image."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..road.ahead import FreeAhead, RoadAhead, road_ahead
from ..system.fields import OPTIONS
from ..system.printable import many
from ..types.choices import STATIC
from ..types.perception import Box, Perception, TopView, scan_of
from ..types.points import Bytes, Floats, Labels, Points
from . import canvas, content
from .colors import AMBER, FAINT, INK, PANEL, color_of, pixel_colors, ramp, rgb

# Sizes in pixels. A page that shows the picture 1000 pixels wide reduces text of 13 points to 8.
_WIDTH, _MARGIN, _TOP, _BOTTOM = 1600, 28, 128, 868
_AXIS = 62
_NEAR_M = 1.0
_HALF_STRIP_M = 1.0
_AROUND_M = (48.0, 36.0)  # ahead and behind, to each side
_AHEAD_M = ((6.0, 46.0), (-10.0, 10.0))  # x and y of what is shown at least without a top view
_SENSOR = [[0.0, 1.2], [0.9, -1.2], [-0.9, -1.2]]  # the arrowhead that stands for it in panels from above: y, x [m]

Place = tuple[float, float, float, float]
"""Left, top, width and height of a panel [px]."""


class _Drawn(NamedTuple):
    """What panels show, in the frame of the models."""

    points: Points
    names: list[str]  # of classes
    painted: Labels  # the class to show for each point
    top_view: TopView | None
    road: RoadAhead | None
    boxes: Sequence[Box]
    ground: tuple[float, float, float]  # `ground_plane`

    @property
    def above_m(self) -> Floats:
        """Heights of the points above the ground."""
        a, b, c = self.ground
        x, y, z = self.points[:, :3].astype(np.float64).T
        return z - (a + b * x + c * y)

    @property
    def colors(self) -> Floats:
        """Colors of the points' classes."""
        return rgb([color_of(name) for name in self.names])[self.painted]


def draw(perception: Perception, points: ArrayLike, path: str | Path | None = None, *, title: str = "") -> bytes:
    """Draw a scan and what was perceived in it.

    Parameters
    ----------
    perception : Perception
        The panels show the whole turn if something behind the sensor was perceived: a box from above, a class for
        points in the range image. Without it and without a top view, the picture has no panel from above.
    points : (n, 4) or (n, 3) array_like, or a structured array
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Not drawn are points and boxes that are
        not finite or farther than 1 km.
    path : str or Path, optional
        File to write as well; an existing file is replaced atomically.
    title : str
        The scan's name.

    Returns
    -------
    png : bytes
        1600 pixels wide and about 1080 high; warnings add height.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    PointsError
        ``points`` is not the scan that was perceived.
    OptionError
        ``path`` is none, or named as a picture of another kind; or ``title`` is no text.
    OSError
        The file cannot be written.
    """
    perception, points = content.in_model_frame(perception, scan_of(perception, points))
    names, painted = content.paint_points(points, perception)
    seen = content.drawable_points(points)
    points, painted = points[seen], painted[seen]
    ground = content.ground_plane(perception, points)
    boxes = content.drawable_boxes(perception.boxes)
    content.paint_vehicles(names, painted, points, boxes)
    top_view = perception.top_view
    road = None if top_view is None else road_ahead(top_view, boxes)
    # The part of the turn in which points have a class: the quarter ahead, or all of it.
    found = perception.points
    turn_deg = 360.0 if found is not None and (points[found.in_view[seen], 0] < 0.0).any() else 90.0

    facts = content.class_facts(perception)
    ruler = canvas.new_figure(_WIDTH, 100)
    warnings = [
        line for text in perception.fitness for line in canvas.wrap(ruler, text, _WIDTH - 2 * _MARGIN, fontsize=13.0)
    ]
    legend_top = _BOTTOM + 40
    notes_top = legend_top + canvas.height_of_legend(facts) + 30
    figure = canvas.new_figure(_WIDTH, notes_top + 52 + 26 * len(warnings))

    drawn = _Drawn(points, names, painted, top_view, road, boxes, ground)
    left = _MARGIN + _draw_from_above(figure, drawn)
    width = _WIDTH - _MARGIN - left
    _draw_from_behind(figure, (left, _TOP, width, 520), drawn)
    part = ("90° ahead" if turn_deg == 90.0 else "all around") + ", a class for every point" * (found is not None)
    canvas.write_heading(figure, left, 680, "as the sensor sees it", part)
    _draw_range_image(figure, (left, 700, width, _BOTTOM - 700), drawn, turn_deg)

    count = f"{perception.n_points:,} points"
    if perception.stage_ms:
        count += f" in {sum(perception.stage_ms.values()):.0f} ms"
    write_frame(figure, perception, (title, 1100), count, facts, (legend_top, notes_top))
    for k, line in enumerate(warnings):
        canvas.write_at(figure, _MARGIN, notes_top + 48 + 26 * k, line, fontsize=13.0, color=AMBER)
    return canvas.as_png(figure, path)


def draw_image(perception: Perception, image: Bytes, path: str | Path | None = None, *, title: str = "") -> bytes:
    """Draw a camera's image under the classes of its pixels.

    Parameters
    ----------
    perception : Perception
        With an `edgeperc.ImageLabels`.
    image : (H, W, 3) uint8
        The image that was perceived.
    path : str or Path, optional
        File to write as well; an existing file is replaced atomically.
    title : str
        The image's name.

    Returns
    -------
    png : bytes
        1600 pixels wide.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    ImageError
        ``image`` is not the image that was perceived.
    OptionError
        ``path`` is named as a picture of another kind.
    OSError
        The file cannot be written.
    """
    image, labels = content.perceived_image(image, perception)
    counts = sorted(labels.counts().items(), key=lambda item: -item[1])
    facts = {name: [f"{100.0 * n / labels.labels.size:.1f} %"] for name, n in counts if n}
    height = min(_WIDTH * image.shape[0] // image.shape[1], _WIDTH) + 1
    legend_top, legend_height = 80 + height + 24, canvas.height_of_legend(facts)
    figure = canvas.new_figure(_WIDTH, legend_top + legend_height + 72)
    axes = canvas.add_axes(figure, _MARGIN, 80, _WIDTH - 2 * _MARGIN, height)
    colors = pixel_colors(labels.classes).astype(np.float32)[labels.labels]
    canvas.show(
        axes, 0.55 * image.astype(np.float32) / 255.0 + 0.45 * colors, aspect="equal", interpolation="antialiased"
    )
    size = f"{image.shape[1]} x {image.shape[0]} pixels, {100.0 * labels.drivable_share:.1f} % road"
    write_frame(figure, perception, (title, 1000), size, facts, (legend_top, legend_top + legend_height + 34))
    return canvas.as_png(figure, path)


def write_frame(
    figure: Any,
    perception: Perception,
    title: tuple[str, int],
    about: str,
    facts: Mapping[str, Sequence[str]],
    tops: tuple[float, float],
) -> None:
    """Write what stands around panels: title of at most so many pixels and what is shown, below legend and timing."""
    text, room = OPTIONS.read(str, title[0], "title"), title[1]
    style = {"fontsize": 23.0, "fontweight": "bold"}
    canvas.write_at(figure, _MARGIN, 46, canvas.shorten(figure, text, room, **style), **style)
    canvas.write_at(figure, _WIDTH - _MARGIN, 46, about, fontsize=18.0, ha="right", color=FAINT)
    canvas.draw_legend(figure, _MARGIN, tops[0], _WIDTH - 2 * _MARGIN, facts)
    for k, ran in enumerate((content.timing_line(perception), " · ".join(content.provider_lines(perception)))):
        ran = canvas.shorten(figure, ran, _WIDTH - 2 * _MARGIN, fontsize=12.0)
        canvas.write_at(figure, _MARGIN, tops[1] + 20 * k, ran, fontsize=12.0, color=FAINT)


def _draw_arrow(axes: Any, corners: Floats, zorder: int) -> None:
    """Draw the outline of what is free ahead, filled with a veil."""
    from matplotlib.patches import Polygon

    axes.add_patch(Polygon(corners, closed=True, facecolor=INK, alpha=0.3, zorder=3))
    axes.add_patch(Polygon(corners, closed=True, fill=False, edgecolor=INK, linewidth=1.5, zorder=zorder))


def _strip(ahead: FreeAhead, x_near: float) -> tuple[str, Floats | None]:
    """The free distance ahead as text, and the corners x, y [m] of an arrow of that length; None for no arrow."""
    free_m = ahead.free_m
    if ahead.end is None:
        return "", None
    if free_m <= x_near:
        return f"not free {x_near:.0f} m ahead", None
    text = f"free ahead: {'at least ' if ahead.end == 'end of view' else ''}{free_m:.0f} m"
    half, neck = _HALF_STRIP_M, max(x_near, free_m - 2.0 * _HALF_STRIP_M)
    return text, np.array([[x_near, half], [neck, half], [free_m, 0.0], [neck, -half], [x_near, -half]])


def axes_from_above(figure: Any, room: Place, bounds: Place, all_around: bool) -> tuple[Any, Place]:
    """Add the panel from above with its grid and the sensor; ``bounds`` [m] are the lowest and highest x and y that it
    shows at least, widened if it shows the whole turn.
    """
    from matplotlib.patches import Polygon

    low, high, right, left = bounds
    if all_around:
        along, across = _AROUND_M
        low, high, right, left = min(low, -along), max(high, along), min(right, -across), max(left, across)
    px_per_m = min(room[3] / (high - low), room[2] / (left - right))
    axes = canvas.add_axes(figure, room[0], room[1], px_per_m * (left - right), px_per_m * (high - low))
    axes.set(xlim=(left, right), ylim=(low, high))  # y grows to the left
    step = 10.0 if high - low > 25.0 else 5.0
    ticks = np.arange(math.ceil(low / step) * step, high, step)[:30]
    step = step if left - right < 40.0 else 20.0
    beside = np.arange(math.ceil(right / step) * step, left, step)[:30]
    axes.set_yticks(ticks, labels=[f"{tick:.0f} m" for tick in ticks], usetex=False)
    sides = [f"{abs(tick):.0f} m{' left' * (tick > 0)}{' right' * (tick < 0)}" for tick in beside.tolist()]
    axes.set_xticks(beside, labels=sides, usetex=False)
    axes.grid(color=INK, alpha=0.12, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.add_patch(Polygon(_SENSOR, closed=True, facecolor=INK, zorder=5))
    return axes, (low, high, right, left)


def _draw_from_above(figure: Any, drawn: _Drawn) -> float:
    """Draw the panel from above; return its width [px], 0 without a top view and with nothing behind the sensor.
    Points of the surroundings have the color of their class.
    """
    from matplotlib.patches import Polygon

    points, boxes, top_view = drawn.points, drawn.boxes, drawn.top_view
    (x_near, x_far), (y_right, y_left) = _AHEAD_M if top_view is None else (top_view.x_range_m, top_view.y_range_m)
    low = min(-2.5, x_near - 2.5)
    of_scene = np.array([name in STATIC for name in drawn.names])[drawn.painted]
    behind = any(box.center[0] < low for box in boxes) or bool((points[of_scene, 0] < low).any())
    if top_view is None and not behind:
        return 0.0
    room = (_MARGIN + _AXIS, _TOP, 560.0, float(_BOTTOM - _TOP))
    axes, bounds = axes_from_above(figure, room, (low, x_far + 2.0, y_right - 4.0, y_left + 4.0), behind)
    low, high, right, left = bounds
    x, y, z = points[:, :3].astype(np.float64).T
    inside = np.flatnonzero((x >= low) & (x <= high) & (y >= right) & (y <= left))
    inside = inside[np.argsort(z[inside], kind="stable")]
    shade = ramp(drawn.above_m[inside], -0.2, 2.5)
    shade[of_scene[inside]] = drawn.colors[inside][of_scene[inside]]
    axes.scatter(y[inside], x[inside], s=1.8, c=shade, alpha=0.8, marker="o", linewidths=0, zorder=2)

    labels: list[canvas.Label] = []
    for box in sorted(boxes, key=lambda box: math.hypot(*box.center[:2])):
        color, footprint = color_of(box.label), box.corners()
        axes.add_patch(Polygon(footprint[:, ::-1], closed=True, fill=False, edgecolor=color, linewidth=2.4, zorder=5))
        front = footprint[[0, 3]].mean(axis=0)
        axes.plot([box.center[1], front[1]], [box.center[0], front[0]], color=color, linewidth=2.4, zorder=5)
        if low <= box.center[0] <= high and right <= box.center[1] <= left:
            area = canvas.area_of(axes, footprint[:, ::-1])
            labels.append(canvas.Label(area, f"{box.label} {box.score:.2f}", color))
    n_farther, taken = len(boxes) - len(labels), [canvas.area_of(axes, _SENSOR)]
    if top_view is not None and drawn.road is not None:
        _draw_cells(axes, top_view)
        taken.append(_draw_free_ahead(axes, drawn.road, x_near, labels))
    n_omitted = canvas.place_labels(axes, labels, taken)
    seen = f"{n_farther} farther" if n_farther else "scores"
    if n_omitted:  # all is wider than the panel
        seen = _omitted(seen, n_omitted)
    elif top_view is not None:
        seen = f"{seen}; gray: not observed"
    canvas.write_heading(figure, _MARGIN + _AXIS, _TOP - 20, "from above", seen)
    return float(axes.get_window_extent().width) + _AXIS + 34.0


def _draw_cells(axes: Any, top_view: TopView) -> None:
    """Draw the classes of the cells from above, what was not observed, and where they are."""
    from matplotlib.patches import Rectangle

    (x_near, x_far), (y_right, y_left) = top_view.x_range_m, top_view.y_range_m
    layer = np.zeros((*top_view.labels.shape, 4))
    for k, name in enumerate(top_view.classes):
        if k:
            layer[top_view.labels == k] = (*rgb([color_of(name)])[0], 0.62 if name == "drivable" else 0.45)
    unobserved = ~top_view.observed & ((top_view.labels == 0) | top_view.road)
    if top_view.between_beams is not None:
        layer[unobserved & top_view.between_beams & top_view.road, 3] = 0.35
        unobserved &= ~top_view.between_beams
    layer[unobserved] = (*rgb([FAINT])[0], 0.22)
    canvas.show(axes, layer, extent=(y_left, y_right, x_near, x_far), interpolation="nearest", zorder=1)
    size = y_left - y_right, x_far - x_near
    axes.add_patch(Rectangle((y_right, x_near), *size, fill=False, edgecolor=FAINT, linestyle="--"))


def _draw_free_ahead(axes: Any, road: RoadAhead, x_near: float, labels: list[canvas.Label]) -> Place:
    """Draw from above how far it is free ahead and what ends it, and add their labels; return the arrow's area."""
    strip = road.free_ahead(_HALF_STRIP_M)
    text, arrow = _strip(strip, x_near)
    if arrow is not None:
        _draw_arrow(axes, arrow[:, ::-1], 4)
    beside_arrow = canvas.area_of(axes, [[0.0, x_near]] if arrow is None else arrow[:, ::-1])
    for kind, x_m in (("obstacle", strip.obstacle_m), ("edge", strip.edge_m), ("unknown", strip.unknown_m)):
        if math.isfinite(x_m):
            axes.plot([-_HALF_STRIP_M, _HALF_STRIP_M], [x_m, x_m], color=INK, linewidth=1.5, zorder=4)
            line = canvas.area_of(axes, [[-_HALF_STRIP_M, x_m], [_HALF_STRIP_M, x_m]])
            labels.append(canvas.Label(line, f"{kind} {x_m:.1f} m", FAINT))
    if text:
        first = 0 if arrow is None else len(labels)  # without an arrow, no other panel says it
        labels.insert(first, canvas.Label(beside_arrow, text, AMBER if arrow is None else INK))
    return beside_arrow


def _omitted(text: str, n_omitted: int) -> str:
    return f"{text}; {many(n_omitted, 'label')} omitted" if n_omitted else text


def _draw_range_image(figure: Any, place: Place, drawn: _Drawn, turn_deg: float) -> None:
    """Draw a part of the turn as a range image. It is only a picture, not the projection of a network."""
    axes = canvas.add_axes(figure, *place)
    columns, outer, inner = (512, 40, 20) if turn_deg == 90.0 else (1024, 150, 75)
    names, painted = drawn.names, drawn.painted
    x, y, z = drawn.points[:, :3].astype(np.float64).T
    range_m = np.sqrt(x * x + y * y + z * z)
    azimuth = np.degrees(np.arctan2(y, x))
    half = turn_deg / 2.0
    ahead = np.flatnonzero((np.abs(azimuth) < half) & (range_m > 0.5))
    elevation = np.degrees(np.arcsin(z[ahead] / range_m[ahead]))
    # Percentiles, because stray reflections below the road would compress the image.
    low, high = np.percentile(elevation, [0.3, 99.9]) if len(ahead) else (-25.0, 3.0)
    low, high = low - 0.5, high + 0.5
    # As many as a column of the sensor has points, of some 2048 a turn; gaps between more rows would not be filled.
    rows = next((n for n in (16, 32, 64) if n >= len(ahead) / (turn_deg / 360.0 * 2048)), 128)
    row = np.floor((high - elevation) / (high - low) * rows).astype(np.intp)
    col = np.floor((half - azimuth[ahead]) / turn_deg * columns).astype(np.intp)
    in_view = (row >= 0) & (row < rows) & (col >= 0) & (col < columns)
    ahead, row, col = ahead[in_view], row[in_view], col[in_view]
    nearest_last = np.argsort(-range_m[ahead], kind="stable")
    index = np.full((rows, columns), -1, dtype=np.intp)
    index[row[nearest_last], col[nearest_last]] = ahead[nearest_last]
    for top, left in ((0, 1), (2, 1), (1, 0), (1, 2)):
        # Beams are not evenly spaced, so a pixel without a return takes that of a neighbor.
        neighbor = np.pad(index, 1, constant_values=-1)[top : top + rows, left : left + columns]
        index = np.where(index < 0, neighbor, index)
    picture = np.broadcast_to(rgb([PANEL])[0], (rows, columns, 3)).copy()
    hit = index >= 0
    behind = index[hit]
    shade = ramp(-np.log(np.maximum(range_m[behind], 1.0)), -math.log(70.0), -math.log(4.0))
    share = np.array([0.0 if k == 0 else 0.7 if name in ("drivable", *STATIC) else 1.0 for k, name in enumerate(names)])
    share = share[painted[behind]][:, None]
    picture[hit] = (1.0 - share) * 0.72 * shade + share * drawn.colors[behind]
    canvas.show(axes, picture, extent=(half, -half, 0.0, 1.0), interpolation="nearest")
    beside = [f"{outer}° left", f"{inner}° left", "straight ahead", f"{inner}° right", f"{outer}° right"]
    axes.set_xticks([outer, inner, 0, -inner, -outer], labels=beside, usetex=False)


def _draw_from_behind(figure: Any, place: Place, drawn: _Drawn) -> None:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Polygon

    points, names, painted, top_view, road, boxes, ground = drawn
    axes = canvas.add_axes(figure, *place)
    panel = axes.get_window_extent()
    tall = 0.27
    wide = tall * panel.width / panel.height
    axes.set(xlim=(-wide, wide), ylim=(-tall, tall))

    # Behind and above the sensor, looking at the road some 16 m ahead.
    a, b, c = ground
    eye, target = np.array([-7.0, 0.0, a + 6.2]), np.array([16.0, 0.0, a + 16.0 * b + 0.4])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.array([0.0, -1.0, 0.0])
    turn = np.stack([right, np.cross(right, forward), forward])  # sensor -> camera: right, up, forward

    if top_view is not None:
        layer, extent = _ground_layer(top_view, ground, eye, turn, wide, tall), (-wide, wide, -tall, tall)
        canvas.show(axes, layer, extent=extent, interpolation="bilinear", zorder=1)
    seen = (points[:, :3].astype(np.float64) - eye) @ turn.T
    shown = (seen[:, 2] > 2.0) & (seen[:, 2] < 90.0)
    shown &= (np.abs(seen[:, 0]) < wide * seen[:, 2]) & (np.abs(seen[:, 1]) < tall * seen[:, 2])
    order = np.flatnonzero(shown)
    order = order[np.argsort(-seen[order, 2], kind="stable")]
    depth = seen[order, 2]
    colors, plain = drawn.colors[order], painted[order] == 0
    colors[plain] = ramp(drawn.above_m[order[plain]], -0.3, 3.0)
    if "drivable" in names:
        colors[painted[order] == names.index("drivable")] *= 1.35
    size = np.clip(32.0 / depth, 1.1, 3.6) ** 1.5 * np.where(plain, 0.85, 1.5)
    axes.scatter(*(seen[order, :2].T / depth), s=size, c=colors.clip(0.0, 1.0), marker="o", linewidths=0, zorder=2)

    labels: list[canvas.Label] = []
    if top_view is not None and road is not None:
        strip = road.free_ahead(_HALF_STRIP_M)
        text, arrow = _strip(strip, top_view.x_range_m[0])
        text += "" if strip.end in (None, "end of view") else f" ({strip.end})"
        if arrow is not None:
            flat = (np.column_stack([arrow, a + arrow @ [b, c] + 0.02]) - eye) @ turn.T
            flat = flat[:, :2] / np.maximum(flat[:, 2:], _NEAR_M)
            _draw_arrow(axes, flat, 3)
            labels.append(canvas.Label(canvas.area_of(axes, flat), text, INK))
    # The nearest boxes last, because they occlude the others.
    for box in sorted(boxes, key=lambda box: -box.center[0]):
        corners = (content.box_corners(box) - eye) @ turn.T
        ends = content.edges_ahead(corners, _NEAR_M)
        if not len(ends):
            continue
        flat = ends[:, :, :2] / ends[:, :, 2:]
        color = color_of(box.label)
        axes.add_collection(LineCollection(list(flat), colors=color, linewidths=1.8, zorder=4))
        if corners[:, 2].min() > _NEAR_M:
            front = corners[[0, 3, 7, 4]]
            axes.add_patch(Polygon(front[:, :2] / front[:, 2:], closed=True, facecolor=color, alpha=0.25, zorder=4))
        area = np.array(canvas.area_of(axes, flat.reshape(-1, 2)))
        low, high = area[:2].clip(panel.min, panel.max), area[2:].clip(panel.min, panel.max)
        if (high - low).min() > 1.0:
            distance_m = math.hypot(*box.center[:2])
            labels.append(canvas.Label((*low.tolist(), *high.tolist()), f"{box.label} {distance_m:.0f} m", color))
    n_omitted = canvas.place_labels(axes, labels[::-1])
    more = "boxes and their distance" if top_view is None else "drivable area, boxes and their distance"
    canvas.write_heading(figure, place[0], place[1] - 20, "from behind", _omitted(more, n_omitted))


def _ground_layer(
    top_view: TopView, ground: tuple[float, float, float], eye: Floats, turn: Floats, wide: float, tall: float
) -> Floats:
    """The drivable cells on the ground as seen by the camera: RGBA, (rows, columns, 4) float64 in 0..1."""
    columns = 1200
    rows = max(1, round(columns * tall / wide))
    u, v = np.linspace(-wide, wide, columns), np.linspace(tall, -tall, rows)[:, None]
    ray = u[..., None] * turn[0] + v[..., None] * turn[1] + turn[2]
    a, b, c = ground
    # eye + k ray lies on z = a + b x + c y
    with np.errstate(divide="ignore", invalid="ignore"):
        k = (a + b * eye[0] + c * eye[1] - eye[2]) / (ray[..., 2] - b * ray[..., 0] - c * ray[..., 1])
        row, col, hit = top_view.geometry.cells(eye[0] + k * ray[..., 0], eye[1] + k * ray[..., 1])
    hit &= k > 0.0
    layer = np.zeros((rows, columns, 4))
    layer[..., :3] = rgb([color_of("drivable")])[0]
    layer[hit, 3] = 0.55 * top_view.drivable[row[hit], col[hit]]
    return layer
