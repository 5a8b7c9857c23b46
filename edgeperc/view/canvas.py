"""Axes and text on a figure."""

from __future__ import annotations

from typing import Any

from .colours import INK, PANEL

__all__ = ["add_axes", "lift_clear", "write_text"]


def add_axes(figure: Any, left: float, top: float, width: float, height: float) -> Any:
    """Axes at a place given in pixels from the picture's upper left corner."""
    axes = figure.add_axes((left / 1600.0, 1.0 - (top + height) / 1000.0, width / 1600.0, height / 1000.0))
    axes.set_facecolor(PANEL)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_color("#2a343f")
    return axes


def write_text(where: Any, x: float, y: float, words: str, **style: Any) -> Any:
    """Text in the bundled font; characters that it lacks become question marks."""
    # The font comes with matplotlib and holds Latin-1; "$" must not start a formula.
    words = "".join(c if c in "■…" or (c.isprintable() and ord(c) < 256) else "?" for c in words)
    style = {"color": INK, "fontsize": 10.0, "fontfamily": "DejaVu Sans", **style}
    return where.text(x, y, words, parse_math=False, **style)


def lift_clear(text: Any, taken: list[Any], step: float) -> None:
    """Move a text up until it covers none of those before it."""
    for _ in range(50):
        extent = text.get_window_extent()
        if not any(extent.overlaps(other) for other in taken):
            break
        text.set_y(text.get_position()[1] + step)
    taken.append(extent)
