"""Pictures of a perception, and files that other viewers read.

`draw`, `draw_mistakes` and `draw_tracks` need the extra ``view``; `write_html`, `write_ply` and `write_labels` need
numpy alone. One set of colours serves them all.
"""

from __future__ import annotations

import base64
import html
import io
import json
import math
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .drivable import road_ahead
from .errors import MissingExtraError, PointsError
from .perception import Box, Perception

if TYPE_CHECKING:
    from .tracking.tracker import Tracks

__all__ = [
    "CLASS_COLOURS",
    "SEMANTICKITTI_IDS",
    "Mistakes",
    "draw",
    "draw_mistakes",
    "draw_tracks",
    "write_html",
    "write_labels",
    "write_ply",
]

# Okabe and Ito's palette: tells the classes apart for colour-blind readers too, and stays clear on dark ground.
CLASS_COLOURS = {
    "background": "#8493a3",
    "drivable": "#009e73",
    "car": "#e69f00",
    "van": "#f0e442",
    "truck": "#d55e00",
    "pedestrian": "#cc79a7",
    "cyclist": "#56b4e9",
}
_OTHER_COLOUR = "#ffffff"

# The raw ids of SemanticKITTI's .label files. It counts vans as cars; 99 is its "other-object".
SEMANTICKITTI_IDS = {
    "background": 0,
    "car": 10,
    "van": 10,
    "truck": 18,
    "pedestrian": 30,
    "cyclist": 31,
    "drivable": 40,
}
_OTHER_ID = 99

_INK, _FAINT, _PANEL, _GROUND = "#e8edf2", "#8b98a7", "#0b0f14", "#131920"
_AMBER = "#ffc46b"
# From the ground up (height) and from near to far (range): dim and cool, so that the classes stand out.
_LOW, _HIGH = "#3a5067", "#c3d0dd"
_FOUND, _MISSED, _FALSE = "#00b98a", "#ff5c5c", "#ffa928"


@dataclass(frozen=True, eq=False)
class Mistakes:
    """A scan held against its truth, to be drawn.

    Attributes
    ----------
    name, drive : str
    points : (n, 4) float32
        Those to be drawn.
    wrong : (n,) uint8
        1 where a point of an object was not labelled as its class, 2 where a point of none was labelled as one.
    found : tuple of Box
        True boxes that were found.
    missed : tuple of (Box, int)
        True boxes that were not, and the points in each.
    false : tuple of Box
        Predicted boxes where there is nothing.
    wrong_share : float
        Wrong points, of those that belong to objects or were said to.
    """

    name: str
    drive: str
    points: NDArray[np.float32]
    wrong: NDArray[np.uint8]
    found: tuple[Box, ...] = ()
    missed: tuple[tuple[Box, int], ...] = ()
    false: tuple[Box, ...] = ()
    wrong_share: float = 0.0

    @property
    def n_errors(self) -> float:
        """Boxes missed and boxes made up; among equals, scans with more wrong points come first."""
        return len(self.missed) + len(self.false) + self.wrong_share

    @property
    def words(self) -> str:
        """Such as ``"missed: 2 car, 1 cyclist (340 points); false: 1 car"``."""

        def listed(boxes: Sequence[Box]) -> str:
            return ", ".join(f"{n} {label}" for label, n in Counter(box.label for box in boxes).most_common())

        told = []
        if self.missed:
            n_points = sum(n for _, n in self.missed)
            told.append(f"missed: {listed([box for box, _ in self.missed])} ({n_points:,} points)")
        if self.false:
            told.append(f"false: {listed(self.false)}")
        return "; ".join(told) or "no box missed or false"


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
    _check(points, perception)
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "Drawing a picture") from exc
    names, painted = _paint(points, perception)
    seen = np.isfinite(points).all(axis=1)
    points, painted = points[seen], painted[seen]
    ground = _ground_z(points, names, painted)

    figure = Figure(figsize=(16, 10), dpi=100, facecolor=_GROUND)
    canvas: Any = FigureCanvasAgg(figure)
    left = 28.0
    if perception.top_view is not None:
        x_range, y_range = perception.top_view.x_range_m, perception.top_view.y_range_m
        px_per_m = min(852.0 / (x_range[1] - x_range[0]), 640.0 / (y_range[1] - y_range[0]))
        width, height = px_per_m * (y_range[1] - y_range[0]), px_per_m * (x_range[1] - x_range[0])
        axes = _axes(figure, 66, 78, width, height)
        _draw_top_view(axes, points, perception, ground)
        left = 66.0 + width + 34.0
    _draw_range_image(_axes(figure, left, 78, 1572 - left, 226), points, perception, names, painted)
    _draw_from_behind(_axes(figure, left, 318, 1572 - left, 520), points, perception, names, painted, ground)
    _write_words(figure, perception, left, title)

    stream = io.BytesIO()
    canvas.print_png(stream)
    if path is not None:
        _write(path, stream.getvalue())
    return stream.getvalue()


def draw_mistakes(
    scans: Sequence[Mistakes], path: str | Path | None = None, *, title: str = "", columns: int = 5
) -> bytes:
    """Draw scans from above with what was found, missed and made up, a panel a scan.

    Parameters
    ----------
    scans : sequence of Mistakes
    path : str or Path, optional
        Where to write the picture as well; an existing file is replaced whole.
    title : str
    columns : int

    Returns
    -------
    png : bytes

    Raises
    ------
    MissingExtraError
        matplotlib is not installed.
    OSError
        The file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as exc:
        raise MissingExtraError("matplotlib", "view", "Drawing a picture") from exc
    columns = max(1, min(columns, len(scans)))
    rows = max(1, -(-len(scans) // columns))
    width, height, head = 470, 520, 80
    size = columns * width, rows * height + head
    figure = Figure(figsize=(size[0] / 100.0, size[1] / 100.0), dpi=100, facecolor=_GROUND)
    canvas: Any = FigureCanvasAgg(figure)
    _say(figure, 14 / size[0], 1.0 - 26 / size[1], title, fontsize=15.0, fontweight="bold", va="center")
    at = 14.0
    for colour, words in ((_FOUND, "found"), (_MISSED, "missed"), (_FALSE, "false")):
        for text, style in (("■", {"color": colour, "fontsize": 15.0}), (words, {"color": _FAINT, "fontsize": 12.0})):
            end = _say(figure, at / size[0], 1.0 - 58 / size[1], text, va="center", **style).get_window_extent().x1
            at = float(end) + 8.0
        at += 14.0
    for k, scan in enumerate(scans):
        left, top = k % columns * width + 8, k // columns * height + head + 48
        place = left / size[0], 1.0 - (top + height - 56) / size[1], (width - 16) / size[0], (height - 56) / size[1]
        axes = figure.add_axes(place)
        _draw_mistakes_of(axes, scan)
        words = scan.words if len(scan.words) <= 66 else f"{scan.words[:65]}…"
        _say(
            axes,
            0.0,
            1.055,
            "  ".join(dict.fromkeys((scan.name, scan.drive))),
            transform=axes.transAxes,
            fontweight="bold",
        )
        _say(axes, 0.0, 1.015, words, transform=axes.transAxes, color=_FAINT, fontsize=9.5)
    stream = io.BytesIO()
    canvas.print_png(stream)
    if path is not None:
        _write(path, stream.getvalue())
    return stream.getvalue()


def _draw_mistakes_of(axes: Any, scan: Mistakes) -> None:
    from matplotlib.patches import Polygon

    axes.set_facecolor(_PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlim(26.0, -26.0)  # left is left
    axes.set_ylim(-1.5, 51.5)
    for spine in axes.spines.values():
        spine.set_color("#2a343f")
    for ring in (15.0, 30.0, 46.0):
        turn = np.linspace(-math.pi / 2.0, math.pi / 2.0, 90)
        axes.plot(ring * np.sin(turn), ring * np.cos(turn), color=_INK, alpha=0.16, linewidth=0.8)
        _say(axes, -0.5 * ring, 0.87 * ring, f"{ring:.0f} m", color=_FAINT, fontsize=7.5, ha="right", va="bottom")
    for kind, colour, dot, alpha in ((0, "#66737f", 0.5, 0.6), (2, _FALSE, 2.5, 0.9), (1, _MISSED, 2.5, 0.9)):
        kept = scan.points[scan.wrong == kind]
        axes.scatter(kept[:, 1], kept[:, 0], s=dot, c=colour, alpha=alpha, linewidths=0, zorder=2 + (kind > 0))
    boxes = [(box, _FOUND, "-", "") for box in scan.found] + [(box, _FALSE, "--", box.label) for box in scan.false]
    boxes += [(box, _MISSED, "-", f"{box.label} {n}") for box, n in scan.missed]
    taken: list[Any] = []
    for box, colour, line, words in boxes:
        footprint = box.corners()[:, ::-1]
        style = {"edgecolor": colour, "linestyle": line, "linewidth": 1.6, "zorder": 5}
        axes.add_patch(Polygon(footprint, closed=True, fill=False, **style))
        if words:
            above = footprint[:, 1].max() + 0.5
            text = _say(axes, box.center[1], above, words, color=colour, fontsize=8.5, ha="center", zorder=6)
            text.set(va="bottom", clip_on=True, fontweight="bold")
            _lift_clear(text, taken, 0.5)


def draw_tracks(
    scans: Sequence[Tracks],
    path: str | Path | None = None,
    *,
    title: str = "",
    tail_s: float = 2.0,
    range_m: tuple[float, float] = (70.0, 30.0),
) -> bytes:
    """Draw tracks from above, scan by scan: footprints, where each goes in the next second, and where it was.

    Parameters
    ----------
    scans : sequence of Tracks
        In order; one of them a picture, shown for as long as it lasted.
    path : str or Path, optional
        Where to write the animation as well; an existing file is replaced whole.
    title : str
    tail_s : float
        How long a track's way behind it is shown [s].
    range_m : tuple of 2 float
        How far ahead, and how far to each side, is shown [m]; behind, as far as there are tracks, 10 to 40 m.

    Returns
    -------
    gif : bytes
        Empty where there is no scan.

    Raises
    ------
    MissingExtraError
        pillow is not installed.
    OSError
        The file cannot be written.
    """
    try:
        from PIL import Image, ImageDraw
    except ImportError as exc:
        raise MissingExtraError("pillow", "view", "Drawing an animation") from exc
    px_per_m = 8.0
    # A detector that looks all around has tracks behind; of others nothing is to be seen there.
    behind_m = min(max([10.0, *(5.0 - float(tracks.boxes[:, 0].min()) for tracks in scans if len(tracks))]), 40.0)
    size = round(2.0 * range_m[1] * px_per_m), round((range_m[0] + behind_m) * px_per_m)

    def pixels(places: NDArray[np.float64]) -> list[tuple[float, float]]:
        """x, y in the sensor's frame -> pixels: ahead is up, left is left."""
        return [((range_m[1] - y) * px_per_m, (range_m[0] - x) * px_per_m) for x, y in places[:, :2].tolist()]

    pictures: list[Any] = []
    ways: dict[int, list[tuple[float, float, float, float]]] = {}
    for tracks in scans:
        picture = Image.new("RGB", size, _PANEL)
        pen = ImageDraw.Draw(picture)
        (middle,) = pixels(np.zeros((1, 2)))
        for ring_m in (20.0, 40.0, 60.0):
            reach = ring_m * px_per_m
            pen.ellipse([middle[0] - reach, middle[1] - reach, middle[0] + reach, middle[1] + reach], outline="#2a343f")
            pen.text((middle[0] + 3.0, middle[1] - reach), f"{ring_m:.0f} m", fill=_FAINT)
        pen.polygon(pixels(np.array([[1.5, 0.0], [-1.5, 0.9], [-1.5, -0.9]])), outline=_FAINT)
        R, t = tracks.T_world_sensor[:3, :3], tracks.T_world_sensor[:3, 3]
        here = {track.id for track in tracks}
        ways = {name: way for name, way in ways.items() if name in here or way[-1][3] > tracks.stamp_s - tail_s}
        for track in tracks:
            ways.setdefault(track.id, []).append((*track.world_box.center, tracks.stamp_s))
            way = ways[track.id] = [place for place in ways[track.id] if place[3] > tracks.stamp_s - tail_s]
            colour = _colour(track.label)
            if len(way) > 1:
                pen.line(pixels((np.array(way)[:, :3] - t) @ R), fill=colour)
            pen.polygon(pixels(track.box.corners()), outline=colour, width=1 if track.coasting else 2)
            ahead = np.array([track.box.center[:2], np.array(track.box.center[:2]) + track.velocity])
            pen.line(pixels(ahead), fill=_INK)
        for track in tracks:  # names last, on a ground of their own, or neighbours' could not be told apart
            x, y = pixels(np.array([track.box.center]))[0]
            speed = math.hypot(*track.velocity)
            name = f"#{track.id}" + (f" {3.6 * speed:.0f} km/h" if speed > 1.0 else "")
            pen.rectangle(pen.textbbox((x + 10.0, y - 6.0), name), fill=_PANEL)
            pen.text((x + 10.0, y - 6.0), name, fill=_INK)
        told = f"{title}  {tracks.stamp_s:.1f} s  {len(tracks)} track{'s' * (len(tracks) != 1)}"
        pen.text((10.0, 8.0), told.strip(), fill=_INK)
        for line, label in enumerate(sorted({*tracks.labels})):
            pen.text((10.0, 24.0 + 14.0 * line), label, fill=_colour(label))
        pictures.append(picture.quantize(64))
    if not pictures:
        return b""
    stamps = [tracks.stamp_s for tracks in scans]
    lasted = [round(1e3 * (b - a)) for a, b in zip(stamps, [*stamps[1:], stamps[-1] + 1.0], strict=True)]
    stream = io.BytesIO()
    pictures[0].save(
        stream, "GIF", save_all=True, append_images=pictures[1:], duration=[max(20, ms) for ms in lasted], loop=0
    )
    if path is not None:
        _write(path, stream.getvalue())
    return stream.getvalue()


def write_html(points: NDArray[np.float32], perception: Perception, path: str | Path, *, title: str = "") -> None:
    """Write one page that shows the labelled points in a browser, to turn, zoom and pan. It needs no network.

    Parameters
    ----------
    points : (n, 4) float32
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Rows that are not finite are left out.
    perception : Perception
    path : str or Path
        An existing file is replaced whole.
    title : str
        The scan's name.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived.
    OSError
        The file cannot be written.
    """
    _check(points, perception)
    names, painted = _paint(points, perception)
    seen = np.isfinite(points).all(axis=1)
    points, painted = points[seen], painted[seen]
    counts = perception.points.counts() if perception.points is not None else {}
    boxed = [box.label for box in perception.boxes]
    legend = []
    for name in names:
        words = [f"{counts[name]:,} points"] if name in counts else []
        if name in boxed:
            words.append(f"{boxed.count(name)} box{'es' * (boxed.count(name) > 1)}")
        if name == "drivable" and perception.top_view is not None:
            words.append(f"{perception.top_view.drivable_area_m2:.0f} m²")
        legend.append({"name": name, "colour": _colour(name), "words": ", ".join(words)})
    # Some sensors count remission up to 255, or 65535.
    remission = np.maximum(points[:, 3], 0.0) / max(1.0, float(points[:, 3].max(initial=0.0)))
    scene = {
        "xyz": _base64(points[:, :3].astype("<f4")),
        "remission": _base64((remission * 255.0).astype(np.uint8)),
        "label": _base64(painted),
        "classes": legend,
        "low": _LOW,
        "high": _HIGH,
        "ground": round(_ground_z(points, names, painted), 3),
        "boxes": [
            {
                "corners": np.round(_corners(box), 3).tolist(),
                "colour": _colour(box.label),
                "words": f"{box.label} {box.score:.2f}",
            }
            for box in perception.boxes
        ],
    }
    # "<" would let a class name close the script element.
    data = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    facts = f"{perception.n_points:,} points · {_timing(perception)}"
    filled = {
        "@@TITLE@@": html.escape(title or "A scan"),
        "@@WORDS@@": html.escape(facts),
        "@@FITNESS@@": "".join(f"<p class=warn>{html.escape(line)}</p>" for line in perception.fitness),
        "@@SCENE@@": data,
    }
    # In one pass, so that a title that looks like a place to fill stays a title.
    page = re.sub("|".join(filled), lambda match: filled[match.group()], _PAGE)
    _write(path, page.encode(errors="replace"))


def write_ply(points: NDArray[np.float32], perception: Perception, path: str | Path) -> None:
    """Write the labelled scan as a binary PLY file.

    One row an input point, in input order: x, y, z, remission (float), label, red, green, blue (uchar). Comments in the
    header name the labels.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived, or the perception holds no class for its points.
    OSError
        The file cannot be written.
    """
    _check(points, perception)
    if perception.points is None:
        raise _no_labels("PLY file")
    fields = [(name, "<f4") for name in ("x", "y", "z", "remission")]
    fields += [(name, "|u1") for name in ("label", "red", "green", "blue")]
    rows = np.empty(len(points), dtype=fields)
    colours = (_rgb([_colour(name) for name in perception.points.classes]) * 255.0).round().astype(np.uint8)
    for k in range(4):
        rows[fields[k][0]] = points[:, k]
    rows["label"] = perception.points.labels
    for k, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[perception.points.labels, k]
    words = {"<f4": "float", "|u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment label {k} {' '.join(name.split())}" for k, name in enumerate(perception.points.classes)]
    header += [f"element vertex {len(points)}", *(f"property {words[t]} {name}" for name, t in fields), "end_header\n"]
    _write(path, "\n".join(header).encode("ascii", "replace") + rows.tobytes())


def write_labels(perception: Perception, path: str | Path) -> None:
    """Write SemanticKITTI's ``.label`` layout: a uint32 for every input point, in input order.

    The upper 16 bits, the instance, are 0. The lower hold the raw id of `SEMANTICKITTI_IDS`: 10 car, 30 person,
    31 bicyclist, 0 unlabelled, which background and points out of view both get; 99 a class that SemanticKITTI lacks.

    Raises
    ------
    PointsError
        The perception holds no class for its points.
    OSError
        The file cannot be written.
    """
    if perception.points is None:
        raise _no_labels(".label file")
    ids = np.array([SEMANTICKITTI_IDS.get(name, _OTHER_ID) for name in perception.points.classes], dtype="<u4")
    _write(path, ids[perception.points.labels].tobytes())


def _no_labels(what: str) -> PointsError:
    return PointsError(
        f"a {what} needs a class for every point, and this perception has none: no range-image model took part. "
        "Add one, such as 'pointseg'"
    )


def _check(points: NDArray[np.float32], perception: Perception) -> None:
    if points.ndim != 2 or points.shape[1] != 4:
        raise PointsError(f"points have shape {points.shape}; expected (n, 4): x, y, z, remission")
    if len(points) != perception.n_points:
        raise PointsError(
            f"{len(points)} points with a perception of {perception.n_points}; expected the scan that was perceived"
        )


def _write(path: str | Path, content: bytes) -> None:
    """Write beside the target, then rename, so that nobody ever reads half a file."""
    path = Path(path)
    aside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        aside.write_bytes(content)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _colour(name: str) -> str:
    return CLASS_COLOURS.get(name, _OTHER_COLOUR)


def _rgb(colours: list[str]) -> NDArray[np.float64]:
    """Colours "#rrggbb" as (n, 3) in 0..1."""
    return np.array([[int(c[k : k + 2], 16) / 255.0 for k in (1, 3, 5)] for c in colours]).reshape(-1, 3)


def _ramp(value: NDArray[Any], low: float, high: float) -> NDArray[np.float64]:
    """Shade ``value`` from _LOW to _HIGH, (n, 3)."""
    share = np.clip((value - low) / (high - low), 0.0, 1.0)[..., None]
    dim, bright = _rgb([_LOW, _HIGH])
    return np.asarray(dim + share * (bright - dim))


def _timing(perception: Perception) -> str:
    total = sum(perception.stage_ms.values())
    stages = ", ".join(f"{name} {ms:.1f}" for name, ms in perception.stage_ms.items())
    return f"{total:.1f} ms ({stages})" if perception.stage_ms else "not timed"


def _paint(points: NDArray[np.float32], perception: Perception) -> tuple[list[str], NDArray[np.uint8]]:
    """Classes of both views, and one for every point: its own, else what its cell of the top view lends it."""
    names = list(perception.points.classes if perception.points is not None else ("background",))
    painted = np.zeros(len(points), dtype=np.uint8)
    if perception.points is not None:
        painted[:] = perception.points.labels
    top_view = perception.top_view
    if top_view is None:
        return names, painted
    names += [name for name in top_view.classes if name not in names]
    finite = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    x, y, z = points[finite, :3].astype(np.float64).T
    row = np.floor((top_view.x_range_m[1] - x) / top_view.cell_m)
    col = np.floor((top_view.y_range_m[1] - y) / top_view.cell_m)
    inside = (row >= 0) & (row < top_view.labels.shape[0]) & (col >= 0) & (col < top_view.labels.shape[1])
    finite, z = finite[inside], z[inside]
    cell = top_view.labels[row[inside].astype(np.intp), col[inside].astype(np.intp)]
    lent = np.array([names.index(name) for name in top_view.classes], dtype=np.uint8)[cell]
    road = names.index("drivable") if "drivable" in names else -1
    take = (painted[finite] == 0) & (lent != 0)
    if perception.points is not None:
        take &= lent == road
    if (lent == road).any():
        # Leaves over the road are not road.
        take &= (lent != road) | (z < np.median(z[lent == road]) + 0.5)
    painted[finite[take]] = lent[take]
    return names, painted


def _ground_z(points: NDArray[np.float32], names: list[str], painted: NDArray[np.uint8]) -> float:
    """Height of the ground around the sensor [m]; good enough to stand a grid on."""
    if "drivable" in names:
        road = painted == names.index("drivable")
        if np.count_nonzero(road) >= 50:
            return float(np.median(points[road, 2]))
    near = np.hypot(points[:, 0], points[:, 1]) < 30.0
    return float(np.percentile(points[near, 2], 15.0)) if near.any() else -1.73


def _corners(box: Box) -> NDArray[np.float64]:
    """The eight corners, (8, 3) [m]: the four of `Box.corners` below, then above."""
    z = box.center[2] + np.repeat([-0.5, 0.5], 4) * box.size[2]
    return np.column_stack([np.tile(box.corners(), (2, 1)), z])


_EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))


def _axes(figure: Any, left: float, top: float, width: float, height: float) -> Any:
    """Axes at a place given in pixels from the picture's upper left corner."""
    axes = figure.add_axes((left / 1600.0, 1.0 - (top + height) / 1000.0, width / 1600.0, height / 1000.0))
    axes.set_facecolor(_PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#2a343f")
    return axes


def _say(where: Any, x: float, y: float, words: str, **style: Any) -> Any:
    # The font comes with matplotlib and holds Latin-1; "$" must not start a formula.
    words = "".join(c if c in "■…" or (c.isprintable() and ord(c) < 256) else "?" for c in words)
    style = {"color": _INK, "fontsize": 10.0, "fontfamily": "DejaVu Sans", **style}
    return where.text(x, y, words, parse_math=False, **style)


def _lift_clear(text: Any, taken: list[Any], step: float) -> None:
    """Move a text up until it covers none of those before it."""
    for _ in range(50):
        extent = text.get_window_extent()
        if not any(extent.overlaps(other) for other in taken):
            break
        text.set_y(text.get_position()[1] + step)
    taken.append(extent)


def _draw_top_view(axes: Any, points: NDArray[np.float32], perception: Perception, ground: float) -> None:
    from matplotlib.patches import Polygon

    top_view = perception.top_view
    assert top_view is not None
    (x_near, x_far), (y_right, y_left) = top_view.x_range_m, top_view.y_range_m
    layer = np.zeros((*top_view.labels.shape, 4))
    for k, name in enumerate(top_view.classes):
        if k:
            layer[top_view.labels == k] = (*_rgb([_colour(name)])[0], 0.5 if name == "drivable" else 0.6)
    axes.imshow(layer, extent=(y_left, y_right, x_near, x_far), aspect="auto", interpolation="nearest", zorder=1)
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    inside = np.flatnonzero((x >= x_near) & (x <= x_far) & (y >= y_right) & (y <= y_left))
    inside = inside[np.argsort(z[inside], kind="stable")]
    shade = _ramp(z[inside], ground - 0.2, ground + 2.5)
    axes.scatter(y[inside], x[inside], s=1.6, c=shade, alpha=0.75, linewidths=0, zorder=2)
    metres = np.arange(math.ceil(x_near / 10.0) * 10.0, x_far + 0.01, 10.0)
    for at in metres:
        axes.axhline(at, color=_INK, alpha=0.13, linewidth=0.8, zorder=3)
    axes.set_xlim(y_left, y_right)
    axes.set_ylim(x_near, x_far)
    road = road_ahead(top_view, perception.boxes)
    for ring in (road.outline, *road.holes):
        edge = Polygon(ring[:, ::-1], closed=True, fill=False, edgecolor=_colour("drivable"), linewidth=1.2, zorder=3)
        axes.add_patch(edge)
    free = np.where(road.free_m > x_near, road.free_m, np.nan)
    axes.plot(road.y_m, free, color=_INK, linewidth=1.0, alpha=0.7, drawstyle="steps-mid", zorder=4)
    taken: list[Any] = []
    for box in perception.boxes:
        colour = _colour(box.label)
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
        words = _say(axes, side, ahead, f"{box.label} {box.score:.2f}", color=colour, fontsize=9.5, zorder=6)
        words.set(ha="left" if room_right else "right", va="center", clip_on=True, fontweight="bold")
        _lift_clear(words, taken, 0.2)
        words.set_bbox({"facecolor": _PANEL, "edgecolor": "none", "alpha": 0.72, "pad": 1.5})
    below = x_near - 0.022 * (x_far - x_near)
    axes.plot([y_right + 5.0, y_right], [below, below], color=_INK, linewidth=3, clip_on=False)
    _say(axes, y_right + 5.4, below, "5 m", ha="right", va="center")
    axes.set_yticks(metres, labels=[f"{at:.0f} m" for at in metres])
    axes.tick_params(left=False, colors=_FAINT, labelsize=9.5, labelfontfamily="DejaVu Sans")
    _say(axes, 0.0, 1.008, "top view; the line: free ahead", color=_FAINT, transform=axes.transAxes, va="bottom")


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
    picture = np.broadcast_to(_rgb([_PANEL])[0], (rows, columns, 3)).copy()
    hit = index >= 0
    behind = index[hit]
    shade = _ramp(-np.log(np.maximum(range_m[behind], 1.0)), -math.log(70.0), -math.log(4.0))
    share = np.array([0.0 if k == 0 else 0.55 if name == "drivable" else 0.92 for k, name in enumerate(names)])
    share = share[painted[behind]][:, None]
    picture[hit] = (1.0 - share) * 0.75 * shade + share * _rgb([_colour(name) for name in names])[painted[behind]]
    axes.imshow(picture, extent=(0, columns, rows, 0), aspect="auto", interpolation="nearest")
    for box in perception.boxes:
        corner = _corners(box)
        side = (45.0 - np.degrees(np.arctan2(corner[:, 1], corner[:, 0]))) / 90.0 * columns
        up = np.degrees(np.arctan2(corner[:, 2], np.hypot(corner[:, 0], corner[:, 1])))
        up = (high - up) / (high - low) * rows
        if side.min() >= 0 and side.max() <= columns:
            at, size = (side.min(), up.min()), (np.ptp(side), np.ptp(up))
            axes.add_patch(Rectangle(at, *size, fill=False, edgecolor=_colour(box.label), linewidth=1.3))
    _say(axes, 0.0, 1.03, "range image, 90° ahead", color=_FAINT, transform=axes.transAxes, va="bottom")


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
    colours = _rgb([_colour(name) for name in names])[painted[order]]
    plain = painted[order] == 0
    colours[plain] = _ramp(points[order[plain], 2], ground - 0.3, ground + 3.0)
    size = np.clip(26.0 / depth, 0.8, 3.2) ** 1.5 * np.where(plain, 0.8, 1.5)
    axes.scatter(seen[order, 0] / depth, seen[order, 1] / depth, s=size, c=colours, linewidths=0)
    axes.set_xlim(-wide, wide)
    axes.set_ylim(-tall, tall)
    taken: list[Any] = []
    for found in sorted(perception.boxes, key=lambda found: found.center[0]):
        corner = (_corners(found) - eye) @ turn.T
        if corner[:, 2].min() < 1.0:
            continue
        flat = corner[:, :2] / corner[:, 2:]
        colour = _colour(found.label)
        axes.add_collection(LineCollection([flat[list(e)] for e in _EDGES], colors=colour, linewidths=1.5))
        words = f"{found.label} {math.hypot(*found.center[:2]):.0f} m"
        text = _say(axes, float(flat[:, 0].mean()), float(flat[:, 1].max()) + 0.006, words, color=colour)
        text.set(ha="center", va="bottom", clip_on=True, fontweight="bold")
        text.set_bbox({"facecolor": _PANEL, "edgecolor": "none", "alpha": 0.6, "pad": 1.0})
        _lift_clear(text, taken, 0.004)
    _say(axes, 0.008, 0.975, "from behind", color=_FAINT, transform=axes.transAxes, va="top")


def _write_words(figure: Any, perception: Perception, left: float, title: str) -> None:
    def say(x: float, y: float, words: str, **style: Any) -> float:
        """Write at pixels from the upper left corner; where the words end."""
        text = _say(figure, x / 1600.0, 1.0 - y / 1000.0, words, va="center", **style)
        return float(text.get_window_extent().x1)

    say(28, 34, title if len(title) <= 90 else f"…{title[-89:]}", fontsize=16.0, fontweight="bold")
    say(1572, 34, f"{perception.n_points:,} points", fontsize=13.0, ha="right", color=_FAINT)

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
        end = say(x, y, "■", fontsize=15.0, color=_colour(name))
        end = say(end + 7, y, name, fontsize=11.5, fontweight="bold", alpha=1.0 if facts else 0.55)
        if facts:
            end = say(end + 8, y, ", ".join(facts), fontsize=11.5, color=_FAINT)
        x = end + 24
    say(left, 935, _timing(perception), fontsize=11.5)
    ran = " · ".join(f"{model} on {provider}" for model, provider in perception.providers.items())
    say(left, 958, ran, fontsize=10.5, color=_FAINT)
    if perception.fitness:
        more = f"  (+{len(perception.fitness) - 1} more)" if len(perception.fitness) > 1 else ""
        line = perception.fitness[0]
        say(left, 982, (line if len(line) <= 125 else f"{line[:124]}…") + more, fontsize=10.5, color=_AMBER)


_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'">
<title>@@TITLE@@</title>
<style>
html, body { margin: 0; height: 100%; overflow: hidden; background: #0b0f14; color: #e8edf2;
  font: 14px/1.5 system-ui, sans-serif; }
canvas { position: absolute; inset: 0; width: 100%; height: 100%; }
#points { touch-action: none; cursor: grab; }
#words { pointer-events: none; }
aside { position: absolute; top: 16px; left: 16px; max-width: min(340px, calc(100% - 64px)); padding: 14px 18px;
  background: #131920e6; border: 1px solid #2a343f; border-radius: 8px; }
h1 { margin: 0; font-size: 17px; overflow-wrap: anywhere; }
p { margin: 2px 0 8px; color: #8b98a7; font-size: 12.5px; overflow-wrap: anywhere; }
p.warn { color: #ffc46b; }
ul { margin: 10px 0 0; padding: 0; list-style: none; }
li i { display: inline-block; width: 11px; height: 11px; margin-right: 9px; border-radius: 2px; }
li span { color: #8b98a7; }
button { padding: 3px 12px; background: #1d2630; color: inherit; border: 1px solid #34414e; border-radius: 5px;
  font: inherit; cursor: pointer; }
button[aria-pressed=true] { background: #e8edf2; color: #0b0f14; }
footer { position: absolute; bottom: 10px; right: 16px; color: #8b98a7; font-size: 12.5px; pointer-events: none; }
#sorry { position: absolute; inset: 45% 10% auto; text-align: center; color: #ffc46b; }
</style>
</head>
<body>
<canvas id="points"></canvas>
<canvas id="words"></canvas>
<div id="sorry" hidden>This browser offers no WebGL, so the points cannot be shown.
Turn hardware acceleration on, or open the page in another browser.</div>
<aside>
<h1>@@TITLE@@</h1>
<p>@@WORDS@@</p>@@FITNESS@@
<div id="modes"></div>
<ul id="legend"></ul>
</aside>
<footer>drag: turn · right-drag or two fingers: move · wheel or pinch: zoom · double-click: reset</footer>
<script id="scene" type="application/json">@@SCENE@@</script>
<script>
"use strict";
const $ = (id) => document.getElementById(id);
const scene = JSON.parse($("scene").textContent);
const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
const rgb = (hex) => [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
const xyz = new Float32Array(bytes(scene.xyz).buffer);
const remission = bytes(scene.remission), label = bytes(scene.label), n = label.length;

for (const one of scene.classes) {
  const row = $("legend").appendChild(document.createElement("li"));
  row.appendChild(document.createElement("i")).style.background = one.colour;
  row.append(one.name + " ");
  if (!one.words) row.style.opacity = 0.5;
  row.appendChild(document.createElement("span")).textContent = one.words;
}

// Colours: a byte triple for every point, made anew when another mode is chosen.
const low = rgb(scene.low), high = rgb(scene.high), palette = scene.classes.map((one) => rgb(one.colour));
const ramp = (t) => { t = Math.min(1, Math.max(0, t)); return low.map((v, k) => v + t * (high[k] - v)); };
const warm = (t) => [255 * Math.min(1, 0.15 + 1.4 * t), 255 * (0.2 + 0.75 * t * t), 255 * (0.5 - 0.3 * t)];
const height = (i) => (xyz[3 * i + 2] - scene.ground + 0.3) / 3.3;
const modes = {
  "class": (i) => label[i] ? palette[label[i]] : ramp(height(i)),
  "remission": (i) => warm(Math.sqrt(remission[i] / 255)),
  "height": (i) => warm(Math.min(1, Math.max(0, height(i)))),
};

const canvas = $("points"), gl = canvas.getContext("webgl", {antialias: true}), pen = $("words").getContext("2d");
if (gl) start(); else $("sorry").hidden = false;

function start() {
  const shader = (type, source) => {
    const made = gl.createShader(type);
    gl.shaderSource(made, source);
    gl.compileShader(made);
    gl.attachShader(program, made);
  };
  const program = gl.createProgram();
  shader(gl.VERTEX_SHADER, `
    attribute vec3 at; attribute vec3 tint; uniform mat4 view; uniform float size; varying vec3 colour;
    void main() {
      gl_Position = view * vec4(at, 1.0);
      gl_PointSize = clamp(size / gl_Position.w, 1.5, 12.0);
      colour = tint;
    }`);
  shader(gl.FRAGMENT_SHADER, `
    precision mediump float; varying vec3 colour; uniform float round;
    void main() {
      if (round > 0.5 && length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(colour, 1.0);
    }`);
  gl.linkProgram(program);
  gl.useProgram(program);
  const place = Object.fromEntries(["view", "size", "round"].map((k) => [k, gl.getUniformLocation(program, k)]));
  const load = (data) => {
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return buffer;
  };
  const at = gl.getAttribLocation(program, "at"), tint = gl.getAttribLocation(program, "tint");
  gl.enableVertexAttribArray(at);
  gl.enableVertexAttribArray(tint);
  const use = (positions, colours) => {
    gl.bindBuffer(gl.ARRAY_BUFFER, positions);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, colours);
    gl.vertexAttribPointer(tint, 3, gl.UNSIGNED_BYTE, true, 0, 0);
  };

  // Lines: a ground grid every 10 m, and the boxes with a stroke to where they head.
  const ends = [], tints = [], grid = rgb("#26313c"), reach = 80;
  const line = (a, b, colour) => { ends.push(...a, ...b); tints.push(...colour, ...colour); };
  for (let k = -reach; k <= reach; k += 10) {
    for (let part = -reach; part < reach; part += 10) {
      line([k, part, scene.ground], [k, part + 10, scene.ground], grid);
      line([part, k, scene.ground], [part + 10, k, scene.ground], grid);
    }
  }
  line([0, 0, scene.ground], [0, 0, 0], rgb("#e8edf2"));
  const middle = (...all) => [0, 1, 2].map((k) => all.reduce((sum, p) => sum + p[k], 0) / all.length);
  for (const box of scene.boxes) {
    const c = box.corners, colour = rgb(box.colour);
    for (let k = 0; k < 4; k++) {
      line(c[k], c[(k + 1) % 4], colour);
      line(c[4 + k], c[4 + (k + 1) % 4], colour);
      line(c[k], c[4 + k], colour);
    }
    line(middle(c[0], c[1], c[2], c[3]), middle(c[0], c[3]), colour);
  }
  const points = load(xyz), lines = load(new Float32Array(ends)), lineColours = load(new Uint8Array(tints));
  const pointColours = gl.createBuffer();
  const paint = (mode) => {
    const colours = new Uint8Array(3 * n);
    for (let i = 0; i < n; i++) colours.set(modes[mode](i), 3 * i);
    gl.bindBuffer(gl.ARRAY_BUFFER, pointColours);
    gl.bufferData(gl.ARRAY_BUFFER, colours, gl.STATIC_DRAW);
    for (const button of $("modes").children) button.ariaPressed = String(button.textContent === mode);
    show();
  };

  // The camera looks at a target from a distance, at an azimuth and an elevation.
  let camera;
  const home = () => ({target: [10, 0, scene.ground], distance: 34, azimuth: Math.PI, elevation: 0.42});
  const frame = () => {
    const {target, distance, azimuth, elevation} = camera;
    const flat = [Math.cos(azimuth), Math.sin(azimuth)], level = Math.cos(elevation);
    const back = [level * flat[0], level * flat[1], Math.sin(elevation)], right = [-flat[1], flat[0], 0];
    const up = [back[1] * right[2] - back[2] * right[1], back[2] * right[0] - back[0] * right[2],
      back[0] * right[1] - back[1] * right[0]];
    return {right, up, back, eye: target.map((t, k) => t + distance * back[k])};
  };
  const matrix = () => {
    const {right, up, back, eye} = frame(), f = 1.7, near = 0.3, far = 500;
    const dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
    const sx = f * canvas.height / canvas.width, a = -(far + near) / (far - near), b = -2 * far * near / (far - near);
    const out = [];
    for (let k = 0; k < 3; k++) out.push(sx * right[k], f * up[k], a * back[k], -back[k]);
    out.push(sx * dot(right), f * dot(up), a * dot(back) + b, -dot(back));
    return out;
  };
  let waiting = false;
  const show = () => { if (!waiting) { waiting = true; requestAnimationFrame(render); } };
  function render() {
    waiting = false;
    const ratio = window.devicePixelRatio || 1;
    for (const one of [canvas, $("words")]) {
      const [w, h] = [Math.round(one.clientWidth * ratio), Math.round(one.clientHeight * ratio)];
      if (one.width !== w || one.height !== h) { one.width = w; one.height = h; }
    }
    const m = matrix();
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0.043, 0.059, 0.078, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix4fv(place.view, false, m);
    gl.uniform1f(place.size, 0.075 * canvas.height);
    gl.uniform1f(place.round, 0);
    use(lines, lineColours);
    gl.drawArrays(gl.LINES, 0, ends.length / 3);
    gl.uniform1f(place.round, 1);
    use(points, pointColours);
    gl.drawArrays(gl.POINTS, 0, n);
    pen.clearRect(0, 0, canvas.width, canvas.height);
    pen.textAlign = "center";
    const taken = [];
    const say = (p, words, colour, size) => {
      const q = [0, 1, 2, 3].map((k) => m[k] * p[0] + m[4 + k] * p[1] + m[8 + k] * p[2] + m[12 + k]);
      if (q[3] < 0.3) return;
      const x = (q[0] / q[3] + 1) / 2 * canvas.width, y = (1 - q[1] / q[3]) / 2 * canvas.height;
      pen.font = `600 ${size * ratio}px system-ui, sans-serif`;
      const wide = pen.measureText(words).width, tall = size * ratio;
      const meets = ([u, v, w]) => Math.abs(u - x) < (w + wide) / 2 && Math.abs(v - y) < 1.3 * tall;
      if (size < 12 && taken.some(meets)) return;
      taken.push([x, y, wide]);
      pen.lineWidth = 4 * ratio;
      pen.strokeStyle = "#0b0f14cc";
      pen.strokeText(words, x, y - 5 * ratio);
      pen.fillStyle = colour;
      pen.fillText(words, x, y - 5 * ratio);
    };
    for (const box of scene.boxes) say(middle(...box.corners.slice(4)), box.words, box.colour, 13);
    for (let k = 10; k <= 50; k += 10) say([k, 0, scene.ground], `${k} m`, "#8b98a7", 11);
    for (let k = -30; k <= 30; k += 10) if (k) say([0, k, scene.ground], `${Math.abs(k)} m`, "#8b98a7", 11);
  }

  const turn = (dx, dy) => {
    camera.azimuth -= dx * 0.006;
    camera.elevation = Math.min(1.57, Math.max(-0.1, camera.elevation + dy * 0.006));
  };
  const move = (dx, dy) => {
    const {right, up} = frame(), step = camera.distance * 1.18 / canvas.clientHeight;
    camera.target = camera.target.map((t, k) => t + step * (dy * up[k] - dx * right[k]));
  };
  const zoom = (by) => { camera.distance = Math.min(250, Math.max(2, camera.distance * by)); };
  const held = new Map();
  canvas.addEventListener("pointerdown", (e) => {
    canvas.setPointerCapture(e.pointerId);
    held.set(e.pointerId, [e.clientX, e.clientY]);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (e) => held.delete(e.pointerId));
  canvas.addEventListener("pointermove", (e) => {
    const was = held.get(e.pointerId);
    if (!was) return;
    const [dx, dy] = [e.clientX - was[0], e.clientY - was[1]];
    const apart = () => { const [a, b] = [...held.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]) || 1; };
    const before = held.size === 2 ? apart() : 0;
    held.set(e.pointerId, [e.clientX, e.clientY]);
    if (held.size === 2) { zoom(before / apart()); move(dx / 2, dy / 2); }
    else if (e.buttons & 6 || e.shiftKey) move(dx, dy);
    else turn(dx, dy);
    show();
  });
  canvas.addEventListener("wheel", (e) => {
    e.preventDefault();
    zoom(Math.exp((e.deltaMode ? 30 : 1) * e.deltaY * 0.001));
    show();
  }, {passive: false});
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", () => { camera = home(); show(); });
  canvas.addEventListener("webglcontextlost", () => { $("sorry").hidden = false; });
  window.addEventListener("resize", show);
  for (const mode of Object.keys(modes)) {
    const button = $("modes").appendChild(document.createElement("button"));
    button.textContent = mode;
    button.addEventListener("click", () => paint(mode));
    $("modes").append(" ");
  }
  camera = home();
  paint("class");
}
</script>
</body>
</html>
"""
