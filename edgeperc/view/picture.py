"""Pictures of a perception, and files that other viewers read.

`draw`, `draw_mistakes` and `draw_tracks` need the extra ``view``; `write_html`, `write_ply` and `write_labels` need
numpy alone. One set of colours serves them all.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_whole
from ..drivable import road_ahead
from ..errors import MissingExtraError
from ..perception import Perception
from .canvas import add_axes, lift_clear, write_text
from .colours import (
    AMBER,
    EDGES,
    FAINT,
    GROUND,
    INK,
    PANEL,
    box_corners,
    check_points,
    colour_of,
    ground_height,
    paint_points,
    ramp,
    rgb,
    timing_line,
)

__all__ = ["draw"]


def draw(
    points: NDArray[np.float32], perception: Perception, path: str | Path | None = None, *, title: str = ""
) -> bytes:
    """Draw a scan and what was perceived in it: from above, from the sensor and from behind.

    Parameters
    ----------
    points : (n, 4) float32
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Rows that are not finite are left out.
    perception : Perception
        Views it does not hold are left out.
    path : str or Path, optional
        Where to write the picture as well; an existing file is replaced whole.
    title : str
        The scan's name.

    Returns
    -------
    png : bytes
        1600 by 1000 pixels.

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    PointsError
        ``points`` is not the scan that was perceived.
    OSError
        The file cannot be written.
    """
    check_points(points, perception)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "Drawing a picture") from exc
    names, painted = paint_points(points, perception)
    seen = np.isfinite(points).all(axis=1)
    points, painted = points[seen], painted[seen]
    ground = ground_height(points, names, painted)

    figure = Figure(figsize=(16, 10), dpi=100, facecolor=GROUND)
    canvas: Any = FigureCanvasAgg(figure)
    left = 28.0
    if perception.top_view is not None:
        x_range, y_range = perception.top_view.x_range_m, perception.top_view.y_range_m
        px_per_m = min(852.0 / (x_range[1] - x_range[0]), 640.0 / (y_range[1] - y_range[0]))
        width, height = px_per_m * (y_range[1] - y_range[0]), px_per_m * (x_range[1] - x_range[0])
        axes = add_axes(figure, 66, 78, width, height)
        _draw_top_view(axes, points, perception, ground)
        left = 66.0 + width + 34.0
    _draw_range_image(add_axes(figure, left, 78, 1572 - left, 226), points, perception, names, painted)
    _draw_from_behind(add_axes(figure, left, 318, 1572 - left, 520), points, perception, names, painted, ground)
    _write_words(figure, perception, left, title)

    stream = io.BytesIO()
    canvas.print_png(stream)
    if path is not None:
        write_whole(path, stream.getvalue())
    return stream.getvalue()


def _draw_top_view(axes: Any, points: NDArray[np.float32], perception: Perception, ground: float) -> None:
    from matplotlib.patches import Polygon

    top_view = perception.top_view
    assert top_view is not None
    (x_near, x_far), (y_right, y_left) = top_view.x_range_m, top_view.y_range_m
    layer = np.zeros((*top_view.labels.shape, 4))
    for k, name in enumerate(top_view.classes):
        if k:
            layer[top_view.labels == k] = (*rgb([colour_of(name)])[0], 0.5 if name == "drivable" else 0.6)
    axes.imshow(layer, extent=(y_left, y_right, x_near, x_far), aspect="auto", interpolation="nearest", zorder=1)
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    inside = np.flatnonzero((x >= x_near) & (x <= x_far) & (y >= y_right) & (y <= y_left))
    inside = inside[np.argsort(z[inside], kind="stable")]
    shade = ramp(z[inside], ground - 0.2, ground + 2.5)
    axes.scatter(y[inside], x[inside], s=1.6, c=shade, alpha=0.75, linewidths=0, zorder=2)
    metres = np.arange(math.ceil(x_near / 10.0) * 10.0, x_far + 0.01, 10.0)
    for at in metres:
        axes.axhline(at, color=INK, alpha=0.13, linewidth=0.8, zorder=3)
    axes.set_xlim(y_left, y_right)
    axes.set_ylim(x_near, x_far)
    road = road_ahead(top_view, perception.boxes)
    for ring in (road.outline, *road.holes):
        edge = Polygon(ring[:, ::-1], closed=True, fill=False, edgecolor=colour_of("drivable"), linewidth=1.2, zorder=3)
        axes.add_patch(edge)
    free = np.where(road.free_m > x_near, road.free_m, np.nan)
    axes.plot(road.y_m, free, color=INK, linewidth=1.0, alpha=0.7, drawstyle="steps-mid", zorder=4)
    taken: list[Any] = []
    for box in perception.boxes:
        colour = colour_of(box.label)
        footprint = box.corners()
        axes.add_patch(Polygon(footprint[:, ::-1], closed=True, fill=False, edgecolor=colour, linewidth=2.0, zorder=5))
        front = footprint[[0, 3]].mean(axis=0)
        tip = front + 0.25 * (front - np.asarray(box.center[:2]))
        axes.plot([box.center[1], tip[1]], [box.center[0], tip[0]], color=colour, linewidth=2.0, zorder=5)
        if not (x_near <= box.center[0] <= x_far and y_right <= box.center[1] <= y_left):
            continue  # beside or behind what is drawn
        # Beside the box, on the side with more room.
        room_right = box.center[1] - y_right >= y_left - box.center[1]
        side = footprint[:, 1].min() - 0.25 if room_right else footprint[:, 1].max() + 0.25
        ahead = min(max(box.center[0], x_near + 0.5), x_far - 0.5)
        words = write_text(axes, side, ahead, f"{box.label} {box.score:.2f}", color=colour, fontsize=9.5, zorder=6)
        words.set(ha="left" if room_right else "right", va="center", clip_on=True, fontweight="bold")
        lift_clear(words, taken, 0.2)
        words.set_bbox({"facecolor": PANEL, "edgecolor": "none", "alpha": 0.72, "pad": 1.5})
    below = x_near - 0.022 * (x_far - x_near)
    axes.plot([y_right + 5.0, y_right], [below, below], color=INK, linewidth=3, clip_on=False)
    write_text(axes, y_right + 5.4, below, "5 m", ha="right", va="center")
    axes.set_yticks(metres, labels=[f"{at:.0f} m" for at in metres])
    axes.tick_params(left=False, colors=FAINT, labelsize=9.5, labelfontfamily="DejaVu Sans")
    write_text(axes, 0.0, 1.008, "top view; the line: free ahead", color=FAINT, transform=axes.transAxes, va="bottom")


def _draw_range_image(
    axes: Any, points: NDArray[np.float32], perception: Perception, names: list[str], painted: NDArray[np.uint8]
) -> None:
    """The front quarter turn as the sensor saw it. It is a picture, and no network's projection."""
    from matplotlib.patches import Rectangle

    x, y, z = points[:, :3].astype(np.float64).T
    range_m = np.sqrt(x * x + y * y + z * z)
    azimuth = np.degrees(np.arctan2(y, x))
    ahead = np.flatnonzero((np.abs(azimuth) < 45.0) & (range_m > 0.5))
    elevation = np.degrees(np.arcsin(z[ahead] / range_m[ahead]))
    # Stray reflections below the road would squeeze the rest.
    low, high = np.percentile(elevation, [0.3, 99.9]) if len(ahead) else (-25.0, 3.0)
    low, high = low - 0.5, high + 0.5
    columns = 512
    rows = next((n for n in (16, 32, 64) if n >= len(ahead) / columns), 128)
    row = np.floor((high - elevation) / (high - low) * rows).astype(np.intp)
    col = np.floor((45.0 - azimuth[ahead]) / 90.0 * columns).astype(np.intp)
    kept = (row >= 0) & (row < rows)
    ahead, row, col = ahead[kept], row[kept], col[kept]
    nearest_last = np.argsort(-range_m[ahead], kind="stable")
    index = np.full((rows, columns), -1, dtype=np.intp)
    index[row[nearest_last], col[nearest_last]] = ahead[nearest_last]
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        # Beams are not spread evenly: a pixel that none met borrows its neighbour's return.
        neighbour = np.roll(index, shift, axis)
        edge = [slice(None), slice(None)]
        edge[axis] = slice(0, 1) if shift > 0 else slice(-1, None)
        neighbour[tuple(edge)] = -1
        index = np.where(index < 0, neighbour, index)
    picture = np.broadcast_to(rgb([PANEL])[0], (rows, columns, 3)).copy()
    hit = index >= 0
    behind = index[hit]
    shade = ramp(-np.log(np.maximum(range_m[behind], 1.0)), -math.log(70.0), -math.log(4.0))
    share = np.array([0.0 if k == 0 else 0.55 if name == "drivable" else 0.92 for k, name in enumerate(names)])
    share = share[painted[behind]][:, None]
    picture[hit] = (1.0 - share) * 0.75 * shade + share * rgb([colour_of(name) for name in names])[painted[behind]]
    axes.imshow(picture, extent=(0, columns, rows, 0), aspect="auto", interpolation="nearest")
    for box in perception.boxes:
        corner = box_corners(box)
        side = (45.0 - np.degrees(np.arctan2(corner[:, 1], corner[:, 0]))) / 90.0 * columns
        up = np.degrees(np.arctan2(corner[:, 2], np.hypot(corner[:, 0], corner[:, 1])))
        up = (high - up) / (high - low) * rows
        if side.min() >= 0 and side.max() <= columns:
            at, size = (side.min(), up.min()), (np.ptp(side), np.ptp(up))
            axes.add_patch(Rectangle(at, *size, fill=False, edgecolor=colour_of(box.label), linewidth=1.3))
    write_text(axes, 0.0, 1.03, "range image, 90° ahead", color=FAINT, transform=axes.transAxes, va="bottom")


def _draw_from_behind(
    axes: Any,
    points: NDArray[np.float32],
    perception: Perception,
    names: list[str],
    painted: NDArray[np.uint8],
    ground: float,
) -> None:
    from matplotlib.collections import LineCollection

    # Behind and above the sensor, looking at the road some 15 m ahead.
    eye, target = np.array([-8.0, 0.0, ground + 7.0]), np.array([15.0, 0.0, ground + 0.5])
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.array([0.0, -1.0, 0.0])
    turn = np.stack([right, np.cross(right, forward), forward])

    seen = (points[:, :3].astype(np.float64) - eye) @ turn.T
    panel = axes.get_window_extent()
    tall = 0.285
    wide = tall * panel.width / panel.height
    shown = (seen[:, 2] > 2.0) & (seen[:, 2] < 90.0)
    shown &= (np.abs(seen[:, 0]) < wide * seen[:, 2]) & (np.abs(seen[:, 1]) < tall * seen[:, 2])
    order = np.flatnonzero(shown)
    order = order[np.argsort(-seen[order, 2], kind="stable")]
    depth = seen[order, 2]
    colours = rgb([colour_of(name) for name in names])[painted[order]]
    plain = painted[order] == 0
    colours[plain] = ramp(points[order[plain], 2], ground - 0.3, ground + 3.0)
    size = np.clip(26.0 / depth, 0.8, 3.2) ** 1.5 * np.where(plain, 0.8, 1.5)
    axes.scatter(seen[order, 0] / depth, seen[order, 1] / depth, s=size, c=colours, linewidths=0)
    axes.set_xlim(-wide, wide)
    axes.set_ylim(-tall, tall)
    taken: list[Any] = []
    for found in sorted(perception.boxes, key=lambda found: found.center[0]):
        corner = (box_corners(found) - eye) @ turn.T
        if corner[:, 2].min() < 1.0:
            continue
        flat = corner[:, :2] / corner[:, 2:]
        colour = colour_of(found.label)
        axes.add_collection(LineCollection([flat[list(e)] for e in EDGES], colors=colour, linewidths=1.5))
        words = f"{found.label} {math.hypot(*found.center[:2]):.0f} m"
        text = write_text(axes, float(flat[:, 0].mean()), float(flat[:, 1].max()) + 0.006, words, color=colour)
        text.set(ha="center", va="bottom", clip_on=True, fontweight="bold")
        text.set_bbox({"facecolor": PANEL, "edgecolor": "none", "alpha": 0.6, "pad": 1.0})
        lift_clear(text, taken, 0.004)
    write_text(axes, 0.008, 0.975, "from behind", color=FAINT, transform=axes.transAxes, va="top")


def _write_words(figure: Any, perception: Perception, left: float, title: str) -> None:
    def say(x: float, y: float, words: str, **style: Any) -> float:
        """Write at pixels from the upper left corner; where the words end."""
        text = write_text(figure, x / 1600.0, 1.0 - y / 1000.0, words, va="center", **style)
        return float(text.get_window_extent().x1)

    say(28, 34, title if len(title) <= 90 else f"…{title[-89:]}", fontsize=16.0, fontweight="bold")
    say(1572, 34, f"{perception.n_points:,} points", fontsize=13.0, ha="right", color=FAINT)

    counts = perception.points.counts() if perception.points is not None else {}
    boxed = [box.label for box in perception.boxes]
    names = list(counts)
    names += [name for name in (perception.top_view.classes if perception.top_view else ()) if name not in names]
    x, y = left, 866.0
    for name in names:
        facts = []
        if name == "drivable" and perception.top_view is not None:
            facts.append(f"{perception.top_view.drivable_area_m2:.0f} m²")
        if name in boxed:
            facts.append(f"{boxed.count(name)} box{'es' * (boxed.count(name) > 1)}")
        if name in counts:
            facts.append(f"{counts[name]:,} points")
        if x > 1572 - 190:
            x, y = left, y + 27.0
        end = say(x, y, "■", fontsize=15.0, color=colour_of(name))
        end = say(end + 7, y, name, fontsize=11.5, fontweight="bold", alpha=1.0 if facts else 0.55)
        if facts:
            end = say(end + 8, y, ", ".join(facts), fontsize=11.5, color=FAINT)
        x = end + 24
    say(left, 935, timing_line(perception), fontsize=11.5)
    ran = " · ".join(f"{model} on {provider}" for model, provider in perception.providers.items())
    say(left, 958, ran, fontsize=10.5, color=FAINT)
    if perception.fitness:
        more = f"  (+{len(perception.fitness) - 1} more)" if len(perception.fitness) > 1 else ""
        line = perception.fitness[0]
        say(left, 982, (line if len(line) <= 125 else f"{line[:124]}…") + more, fontsize=10.5, color=AMBER)
