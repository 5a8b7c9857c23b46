"""Missed objects, false detections and wrong points of a scan, for a picture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..system.printable import many
from ..types.perception import Box
from ..types.points import Bytes, Mask, Points
from ..view.canvas import (
    Label,
    add_axes,
    area_of,
    as_png,
    new_figure,
    place_labels,
    shorten,
    wrap,
    write_at,
    write_text,
)
from ..view.colors import FAINT, FALSE, FOUND, INK, MISSED
from ..view.content import drawable_boxes, drawable_points


@dataclass(frozen=True, eq=False)
class Mistakes:
    """A scan compared with its ground truth, to be drawn."""

    name: str
    drive: str
    points: Points  # x, y, z [m] in the sensor frame, remission
    wrong: Bytes  # 1: point of an object with another label; 2: background with that of an object
    found: tuple[Box, ...] = ()
    missed: tuple[tuple[Box, int], ...] = ()  # with the number of points in each
    false: tuple[Box, ...] = ()  # where there is no object
    wrong_share: float = 0.0  # of the points that are on objects or were labeled as objects

    @property
    def n_errors(self) -> float:
        """Number of missed and false boxes, plus `wrong_share` to rank scans with equal numbers; 0 without mistakes."""
        return len(self.missed) + len(self.false) + self.wrong_share

    @property
    def reach_m(self) -> tuple[float, float, float]:
        """How far a panel shows behind, ahead and to each side: all around, if a box in it would lie outside."""
        places = [box.center[:2] for box in drawable_boxes([*(box for box, _ in self.missed), *self.false])]
        if all(-_BEHIND_M < x < _FAR_M and abs(y) < _BESIDE_M for x, y in places):
            return _BEHIND_M, _FAR_M, _BESIDE_M
        reach_m = max(_FAR_M, *(_BEHIND_M + max(abs(x), abs(y)) / _ASPECT for x, y in places))
        return reach_m, reach_m, reach_m * _ASPECT

    @property
    def shown(self) -> Mask:
        """Which points a panel shows, (n,) bool."""
        (behind, ahead, beside), (x, y) = self.reach_m, self.points[:, :2].T
        return drawable_points(self.points) & (x > -behind) & (x < ahead) & (np.abs(y) < beside)

    @property
    def summary(self) -> str:
        """One line, such as ``"missed: 2 car, 1 cyclist (340 points); false: 1 car; 57 points wrong"``."""

        def listed(boxes: Sequence[Box]) -> str:
            return ", ".join(f"{n} {label}" for label, n in Counter(box.label for box in boxes).most_common())

        parts = []
        if self.missed:
            n_points = sum(n for _, n in self.missed)
            parts.append(f"missed: {listed([box for box, _ in self.missed])} ({n_points:,} points)")
        if self.false:
            parts.append(f"false: {listed(self.false)}")
        n_wrong, n_shown = (int(np.count_nonzero(each)) for each in (self.wrong, self.wrong[self.shown]))
        if n_wrong:
            farther = f", {n_wrong - n_shown:,} of them farther" if n_shown < n_wrong else ""
            parts.append(f"{many(n_wrong, 'point')} wrong{farther}")
        return "; ".join(parts) or "no mistake"


_WIDTH, _MARGIN, _TOP, _GAP, _CAPTION = 1600, 28, 168, 20, 84  # pixels
_BEHIND_M, _FAR_M, _BESIDE_M = 3.0, 52.0, 27.0  # of a panel that does not show the whole turn
_ASPECT = 2.0 * _BESIDE_M / (_BEHIND_M + _FAR_M)
_LEGEND = (
    (MISSED, "missed", "object that was not found, its number of points; dots: points of objects with another label"),
    (FALSE, "false", "box where there is no object; dots: background points with the label of an object"),
    (FOUND, "found", "object that was found"),
)


def draw_mistakes(
    scans: Sequence[Mistakes], path: str | Path | None = None, *, title: str = "", columns: int = 3
) -> bytes:
    """Draw mistakes from above, a panel for each scan with some; returns a PNG. Raises MissingExtraError, OSError."""
    wrong = [scan for scan in scans if scan.n_errors > 0]
    columns = max(1, min(columns, max(1, len(wrong))))
    # A single panel takes half of the width.
    width = (_WIDTH - 2 * _MARGIN - (columns - 1) * _GAP) // max(columns, 2)
    height = round(width / _ASPECT)
    rows = -(-len(wrong) // columns)
    figure = new_figure(_WIDTH, _TOP + (rows * (height + _CAPTION + _GAP) if wrong else 90))
    heading = f"{many(len(wrong), 'scan')} with mistakes"
    if len(wrong) < len(scans):
        heading += f", {len(scans) - len(wrong)} without"
    style = {"fontsize": 21.0, "fontweight": "bold"}
    end = write_at(figure, _MARGIN, 42, heading, **style) + 18
    write_at(figure, end, 43, shorten(figure, title, _WIDTH - _MARGIN - end, fontsize=16.0), fontsize=16.0, color=FAINT)
    for k, (color, name, meaning) in enumerate(_LEGEND):
        end = write_at(figure, _MARGIN, 84 + 27 * k, "■", fontsize=17.0, color=color)
        write_at(figure, end + 8, 84 + 27 * k, name, fontsize=14.0, fontweight="bold")
        write_at(figure, _MARGIN + 128, 84 + 27 * k, meaning, fontsize=14.0, color=FAINT)
    if not wrong:
        text = "No mistakes: every object was found, and none is false." if scans else "No scans were given."
        write_at(figure, _MARGIN, _TOP + 36, text, fontsize=17.0)
    for k, scan in enumerate(wrong):
        left = _MARGIN + k % columns * (width + _GAP)
        top = _TOP + k // columns * (height + _CAPTION + _GAP)
        name = "  ".join(dict.fromkeys((scan.name, scan.drive)))
        style = {"fontsize": 14.5, "fontweight": "bold"}
        write_at(figure, left, top + 16, shorten(figure, name, width, **style), **style)
        lines = wrap(figure, scan.summary, width, fontsize=12.0)
        if len(lines) > 2:
            lines = [lines[0], f"{lines[1]} …"]
        for line, text in enumerate(lines):
            write_at(figure, left, top + 40 + 22 * line, text, fontsize=12.0, color=FAINT)
        _draw_panel(add_axes(figure, left, top + _CAPTION - 8, width, height), scan)
    return as_png(figure, path)


def _draw_panel(axes: Any, scan: Mistakes) -> None:
    from matplotlib.patches import Polygon

    behind, ahead, beside = scan.reach_m
    axes.set_xlim(beside, -beside)  # y grows to the left
    axes.set_ylim(-behind, ahead)
    for ring in (15.0, 30.0, 45.0):
        turn = np.linspace(-math.pi, math.pi, 180)
        axes.plot(ring * np.sin(turn), ring * np.cos(turn), color=INK, alpha=0.16, linewidth=0.8)
        write_text(axes, 0.0, ring, f"{ring:.0f} m", color=FAINT, fontsize=10.5, ha="center", va="bottom", alpha=0.8)
    sensor = np.array([[0.0, 1.0], [0.8, -1.2], [-0.8, -1.2]])
    axes.add_patch(Polygon(sensor, closed=True, facecolor=INK))
    for kind, color, size, alpha in ((0, "#66737f", 0.7, 0.6), (2, FALSE, 7.0, 0.9), (1, MISSED, 7.0, 0.9)):
        shown = scan.points[scan.shown & (scan.wrong == kind)]
        axes.scatter(*shown[:, 1::-1].T, s=size, c=color, alpha=alpha, marker="o", linewidths=0, zorder=2 + (kind > 0))
    boxes = [(box, FOUND, "-", "") for box in scan.found]
    boxes += [(box, FALSE, "--", box.label) for box in scan.false]
    boxes += [(box, MISSED, "-", f"{box.label} · {n:,}") for box, n in scan.missed]
    labels = []
    for box, color, line, text in boxes:
        if not drawable_boxes([box]):
            continue
        footprint = box.corners()[:, ::-1]
        style = {"edgecolor": color, "linestyle": line, "linewidth": 2.2 if text else 1.2, "zorder": 5 if text else 4}
        axes.add_patch(Polygon(footprint, closed=True, fill=False, **style))
        if text:
            labels.append(Label(area_of(axes, footprint), text, color))
    place_labels(axes, labels, [area_of(axes, sensor)], fontsize=12.0)
