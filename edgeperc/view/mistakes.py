"""Pictures of scans with the most mistakes."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..atomic import write_whole
from ..errors import MissingExtraError
from ..evaluation.mistakes import Mistakes
from .canvas import lift_clear, write_text
from .colours import FAINT, FALSE, FOUND, GROUND, INK, MISSED, PANEL

__all__ = ["draw_mistakes"]


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
    figure = Figure(figsize=(size[0] / 100.0, size[1] / 100.0), dpi=100, facecolor=GROUND)
    canvas: Any = FigureCanvasAgg(figure)
    write_text(figure, 14 / size[0], 1.0 - 26 / size[1], title, fontsize=15.0, fontweight="bold", va="center")
    at = 14.0
    for colour, words in ((FOUND, "found"), (MISSED, "missed"), (FALSE, "false")):
        for text, style in (("■", {"color": colour, "fontsize": 15.0}), (words, {"color": FAINT, "fontsize": 12.0})):
            end = (
                write_text(figure, at / size[0], 1.0 - 58 / size[1], text, va="center", **style).get_window_extent().x1
            )
            at = float(end) + 8.0
        at += 14.0
    for k, scan in enumerate(scans):
        left, top = k % columns * width + 8, k // columns * height + head + 48
        place = left / size[0], 1.0 - (top + height - 56) / size[1], (width - 16) / size[0], (height - 56) / size[1]
        axes = figure.add_axes(place)
        _draw_mistakes_of(axes, scan)
        words = scan.words if len(scan.words) <= 66 else f"{scan.words[:65]}…"
        write_text(
            axes,
            0.0,
            1.055,
            "  ".join(dict.fromkeys((scan.name, scan.drive))),
            transform=axes.transAxes,
            fontweight="bold",
        )
        write_text(axes, 0.0, 1.015, words, transform=axes.transAxes, color=FAINT, fontsize=9.5)
    stream = io.BytesIO()
    canvas.print_png(stream)
    if path is not None:
        write_whole(path, stream.getvalue())
    return stream.getvalue()


def _draw_mistakes_of(axes: Any, scan: Mistakes) -> None:
    from matplotlib.patches import Polygon

    axes.set_facecolor(PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlim(26.0, -26.0)  # left is left
    axes.set_ylim(-1.5, 51.5)
    for spine in axes.spines.values():
        spine.set_color("#2a343f")
    for ring in (15.0, 30.0, 46.0):
        turn = np.linspace(-math.pi / 2.0, math.pi / 2.0, 90)
        axes.plot(ring * np.sin(turn), ring * np.cos(turn), color=INK, alpha=0.16, linewidth=0.8)
        write_text(axes, -0.5 * ring, 0.87 * ring, f"{ring:.0f} m", color=FAINT, fontsize=7.5, ha="right", va="bottom")
    for kind, colour, dot, alpha in ((0, "#66737f", 0.5, 0.6), (2, FALSE, 2.5, 0.9), (1, MISSED, 2.5, 0.9)):
        kept = scan.points[scan.wrong == kind]
        axes.scatter(kept[:, 1], kept[:, 0], s=dot, c=colour, alpha=alpha, linewidths=0, zorder=2 + (kind > 0))
    boxes = [(box, FOUND, "-", "") for box in scan.found] + [(box, FALSE, "--", box.label) for box in scan.false]
    boxes += [(box, MISSED, "-", f"{box.label} {n}") for box, n in scan.missed]
    taken: list[Any] = []
    for box, colour, line, words in boxes:
        footprint = box.corners()[:, ::-1]
        style = {"edgecolor": colour, "linestyle": line, "linewidth": 1.6, "zorder": 5}
        axes.add_patch(Polygon(footprint, closed=True, fill=False, **style))
        if words:
            above = footprint[:, 1].max() + 0.5
            text = write_text(axes, box.center[1], above, words, color=colour, fontsize=8.5, ha="center", zorder=6)
            text.set(va="bottom", clip_on=True, fontweight="bold")
            lift_clear(text, taken, 0.5)
