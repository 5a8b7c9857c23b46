"""Figures in pixels, and labels that are neither cut off nor cover the things they name."""

from __future__ import annotations

import io
import textwrap
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..system.atomic import write_atomic
from ..system.extras import require
from ..system.names import check_picture
from ..types.points import Floats
from .colors import FAINT, FRAME, GROUND, INK, PANEL, color_of

_DPI = 100.0
_CLASSES_A_ROW, _LEGEND_ROW = 7, 104
# More labels would cover the picture; the rest is only counted.
_MOST_LABELS = 60
# Largest distance of a label from its object [px]; farther away it does not help.
_FARTHEST = 150.0


def new_figure(width: int, height: int) -> Any:
    """Make an empty figure of a size in pixels, without pyplot. Raises MissingExtraError."""
    agg = require("matplotlib.backends.backend_agg", "view", "Drawing a picture")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, facecolor=GROUND)
    agg.FigureCanvasAgg(figure)
    return figure


def as_png(figure: Any, path: str | Path | None) -> bytes:
    """Encode the figure as a PNG, and write it to ``path`` unless that is None."""
    check_picture(path, ".png")
    from PIL import Image  # a dependency of matplotlib

    figure.canvas.draw()
    # Six bits per channel look the same, and the file is a third smaller. zlib looks for runs alone, in a third of the
    # time: 0.11 in place of 0.33 s, and 0.91 in place of 0.83 MB.
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3] & 0xFC | 0x02
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG", compress_type=zlib.Z_RLE)
    if path is not None:
        write_atomic(path, stream.getvalue())
    return stream.getvalue()


def add_axes(figure: Any, left: float, top: float, width: float, height: float) -> Any:
    """Add axes at a position in pixels from the upper left corner of the picture."""
    across, down = figure.bbox.width, figure.bbox.height
    axes = figure.add_axes((left / across, 1.0 - (top + height) / down, width / across, height / down))
    axes.set(facecolor=PANEL, xticks=[], yticks=[])
    axes.tick_params(length=0, colors=FAINT, labelsize=12.5, labelfontfamily="DejaVu Sans")
    for spine in axes.spines.values():
        spine.set_color(FRAME)
    return axes


def show(axes: Any, picture: Any, **style: Any) -> None:
    """Show an image with row 0 at the top, whatever the user's own matplotlibrc has for ``image.origin``."""
    axes.imshow(picture, **{"origin": "upper", "aspect": "auto", **style})


def write_text(where: Any, x: float, y: float, text: str, **style: Any) -> Any:
    """Write text in matplotlib's own font; characters that it lacks become question marks."""
    # Latin-1 is in the font. parse_math=False: "$" must not start a formula.
    text = "".join(c if c in "■…≥→↑" or (c.isprintable() and ord(c) < 256) else "?" for c in text)
    style = {"color": INK, "fontsize": 13.0, "fontfamily": "DejaVu Sans", **style}
    return where.text(x, y, text, parse_math=False, usetex=False, **style)


def write_at(figure: Any, x: float, y: float, text: str, **style: Any) -> float:
    """Write at pixels from the upper left corner, centered vertically; return the x at which the text ends [px]."""
    style = {"va": "center", **style}
    written = write_text(figure, x / figure.bbox.width, 1.0 - y / figure.bbox.height, text, **style)
    return float(written.get_window_extent().x1)


def _width(figure: Any, text: str, **style: Any) -> float:
    written = write_text(figure, 0.0, 0.0, text, **style)
    width = float(written.get_window_extent().width)
    written.remove()
    return width


def _most_characters(width: float, fontsize: float) -> int:
    """More characters than fit into ``width`` pixels: measuring a name of thousands of them would take seconds."""
    return int(width / (0.25 * fontsize * _DPI / 72.0)) + 1  # the font's narrowest character has 0.275 of its size


def shorten(figure: Any, text: str, width: float, **style: Any) -> str:
    """Cut a text at its start so that it fits into ``width`` pixels."""
    most = _most_characters(width, style["fontsize"])
    kept = text if len(text) <= most else "…" + text[-most:]
    while len(kept) > 1 and _width(figure, kept, **style) > width:
        kept = "…" + kept[1 + max(1, len(kept) // 12) :]
    return kept


def wrap(figure: Any, text: str, width: float, **style: Any) -> list[str]:
    """Break a text into lines of at most ``width`` pixels."""
    text = " ".join(text.split())
    n = max(1, min(len(text), _most_characters(width, style["fontsize"])))
    while True:
        lines = textwrap.wrap(text, n)
        if n == 1 or all(_width(figure, line, **style) <= width for line in lines):
            return lines
        n = max(1, min(n - 1, int(0.97 * n)))


def write_heading(figure: Any, left: float, top: float, heading: str, more: str) -> None:
    """Write the heading of a panel, and in fainter text what it shows."""
    end = write_at(figure, left, top, heading, fontsize=14.5, fontweight="bold")
    write_at(figure, end + 12, top, more, fontsize=13.0, color=FAINT)


def height_of_legend(facts: Mapping[str, Sequence[str]]) -> int:
    """Height of a legend [px]."""
    return _LEGEND_ROW * -(-max(1, len(facts)) // _CLASSES_A_ROW)


def draw_legend(figure: Any, left: float, top: float, width: float, facts: Mapping[str, Sequence[str]]) -> None:
    """Draw a panel with a field for each class: color, name, and what was found (at most two lines)."""
    add_axes(figure, left, top, width, height_of_legend(facts))
    across = width / min(_CLASSES_A_ROW, max(1, len(facts)))
    for k, (name, lines) in enumerate(facts.items()):
        x = left + 16 + across * (k % _CLASSES_A_ROW)
        y = top + 24 + _LEGEND_ROW * (k // _CLASSES_A_ROW)
        end = write_at(figure, x, y, "■", fontsize=20.0, color=color_of(name))
        style = {"fontsize": 15.0, "fontweight": "bold"}
        name = shorten(figure, name, across - 56, **style)
        write_at(figure, end + 8, y, name, alpha=1.0 if lines else 0.5, **style)
        for line, fact in enumerate(lines[:2] or ["none found"]):
            write_at(figure, end + 8, y + 27 + 24 * line, fact, fontsize=13.0, color=FAINT, alpha=1.0 if lines else 0.6)


@dataclass(frozen=True)
class Label:
    """A text that names something in a picture, in an area of the figure [px]: left, bottom, right, top."""

    area: tuple[float, float, float, float]
    text: str
    color: str


def area_of(axes: Any, places: Any) -> tuple[float, float, float, float]:
    """Rectangle around places in data coordinates: left, bottom, right, top [px], for `Label.area`."""
    pixels = axes.transData.transform(places)
    (left, bottom), (right, top) = pixels.min(axis=0).tolist(), pixels.max(axis=0).tolist()
    return left, bottom, right, top


def place_labels(
    axes: Any, labels: Sequence[Label], avoid: Sequence[tuple[float, float, float, float]] = (), **style: Any
) -> int:
    """Write each label, the most important first, at the free place of the axes nearest to its object, with a line to
    it if they are apart; none covers another or an object. Returns the number for which there was no place.
    """
    from matplotlib.lines import Line2D

    figure, panel, gap = axes.figure, axes.get_window_extent(), 4.0
    taken = np.array([*(label.area for label in labels), *avoid], dtype=np.float64).reshape(-1, 4)
    n_omitted = max(0, len(labels) - _MOST_LABELS)
    for label in labels[:_MOST_LABELS]:
        text = write_text(
            figure, 0.0, 0.0, label.text, transform=None, color=label.color, zorder=7, fontweight="bold", **style
        )
        extent = text.get_window_extent()
        half = np.array([extent.width / 2.0 + gap, extent.height / 2.0 + gap])
        place = free_place(label.area, half, taken, (panel.x0, panel.y0, panel.x1, panel.y1))
        if place is None:
            text.remove()
            n_omitted += 1
            continue
        middle, apart = place
        text.set(position=tuple(middle), ha="center", va="center")
        text.set_bbox({"facecolor": PANEL, "edgecolor": "none", "alpha": 0.8, "pad": 2.0})
        taken = np.vstack([taken, [*(middle - half), *(middle + half)]])
        if apart > 3.0 * gap:
            area = np.array(label.area).reshape(2, 2)
            start = np.clip(area.mean(axis=0), middle - half, middle + half)
            end = np.clip(start, area[0], area[1])
            line = Line2D([start[0], end[0]], [start[1], end[1]], color=label.color, linewidth=1.2, alpha=0.9, zorder=6)
            line.set_transform(None)
            figure.add_artist(line)
    return n_omitted


def free_place(
    area: Sequence[float], half: Floats, taken: Floats, panel: Sequence[float]
) -> tuple[Floats, float] | None:
    """Middle of the free place [px] nearest to a named area, for a label of ``half`` a width and height, and their
    distance; inside the panel, on nothing that is taken (k, 4). None if there is none within 150 pixels.
    """
    named = np.array(area, dtype=np.float64).reshape(2, 2)
    low = np.maximum(np.array(panel[:2]) + half, named[0] - half - _FARTHEST)
    high = np.minimum(np.array(panel[2:]) - half, named[1] + half + _FARTHEST)
    x, y = (np.arange(low[k], high[k], 5.0) for k in (0, 1))
    middles = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    free = np.ones(len(middles), np.bool_)
    for left, bottom, right, top in taken.tolist():
        free &= (
            (middles[:, 0] + half[0] <= left)
            | (middles[:, 0] - half[0] >= right)
            | (middles[:, 1] + half[1] <= bottom)
            | (middles[:, 1] - half[1] >= top)
        )
    if not free.any():
        return None
    middles = middles[free]
    apart = np.hypot(*np.maximum(np.maximum(named[0] - middles - half, middles - half - named[1]), 0.0).T)
    # Mainly the distance between the rectangles, then that between their centers.
    best = int(np.argmin(apart + 0.08 * np.hypot(*(middles - named.mean(axis=0)).T)))
    return (middles[best], float(apart[best])) if apart[best] < _FARTHEST else None
