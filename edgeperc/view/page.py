"""The 3-D page: one self-contained HTML file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..atomic import write_atomic
from ..perception import Perception, TopView
from ..printable import printable
from .colors import HIGH, LOW, color_of
from .content import (
    box_corners,
    check_points,
    class_facts,
    drawable_boxes,
    drawable_points,
    fit_ground,
    in_model_frame,
    paint_points,
    provider_lines,
    timing_line,
)

__all__ = ["write_html"]


def write_html(perception: Perception, points: NDArray[np.float32], path: str | Path, *, title: str = "") -> None:
    """Write an interactive 3-D page for a browser. It needs no network.

    Parameters
    ----------
    perception : Perception
    points : (n, 4) float32
        The scan that was perceived: x, y, z [m] in the sensor frame, remission. Not drawn are points and boxes that are
        not finite or farther than 1 km.
    path : str or Path
        An existing file is replaced atomically.
    title : str
        The scan's name.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived.
    OSError
        The file cannot be written.
    """
    check_points(points, perception)
    perception, points = in_model_frame(perception, points)
    names, painted = paint_points(points, perception)
    seen = drawable_points(points)
    points, painted = points[seen], painted[seen]
    facts = class_facts(perception)
    listed = [*names, *(name for name in facts if name not in names)]
    # Some sensors give remission up to 255 or 65535.
    remission = np.maximum(points[:, 3], 0.0) / max(1.0, float(points[:, 3].max(initial=0.0)))
    scene = {
        "xyz": _base64(points[:, :3].astype("<f4")),
        "remission": _base64((remission * 255.0).astype(np.uint8)),
        "label": _base64(painted),
        "classes": [
            {"name": printable(name), "color": color_of(name), "facts": facts.get(name, [])} for name in listed
        ],
        "low": LOW,
        "high": HIGH,
        "ground": [round(value, 5) for value in fit_ground(points, names, painted)],
        "road": None if perception.top_view is None else _road(perception.top_view),
        "boxes": [
            {
                "name": printable(box.label),
                "corners": np.round(box_corners(box), 3).tolist(),
                "color": color_of(box.label),
                "text": f"{printable(box.label)} {box.score:.2f}",
            }
            for box in drawable_boxes(perception.boxes)
        ],
    }
    # A class name with "</script>" or "<!--" must not end the script element.
    data = json.dumps(scene, allow_nan=False).replace("<", "\\u003c")
    ran = "".join(f"<br>{_escaped(line)}" for line in provider_lines(perception))
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    filled = {
        "@@POLICY@@": _policy(template),
        "@@TITLE@@": _escaped(title or "A scan"),
        "@@FACTS@@": f"{perception.n_points:,} points · {_escaped(timing_line(perception))}{ran}",
        "@@FITNESS@@": "".join(f"<p class=warning>{_escaped(line)}</p>" for line in perception.fitness),
        "@@SCENE@@": data,
    }
    # One pass, so that a title such as "@@SCENE@@" is not replaced.
    page = re.sub("|".join(filled), lambda match: filled[match.group()], template)
    write_atomic(path, page.encode())


def _escaped(text: str) -> str:
    """A text from outside, as HTML."""
    return html.escape(printable(text))


def _policy(template: str) -> str:
    """The content security policy: the page loads nothing, and runs no script but its own, named by its hash."""
    allowed = ["default-src 'none'", "base-uri 'none'", "form-action 'none'"]
    for element in ("script", "style"):
        (content,) = re.findall(f"<{element}>(.*?)</{element}>", template, flags=re.DOTALL)
        digest = hashlib.sha256(content.encode()).digest()
        allowed.append(f"{element}-src 'sha256-{base64.b64encode(digest).decode()}'")
    return "; ".join(allowed)


def _road(top_view: TopView) -> dict[str, Any]:
    """The drivable cells, row by row: strips of row, first column and one past the last column."""
    padded = np.pad(top_view.drivable, ((0, 0), (1, 1))).astype(np.int8)
    change = np.diff(padded, axis=1)
    (row, first), (_, last) = np.nonzero(change == 1), np.nonzero(change == -1)
    return {
        "cell": top_view.cell_m,
        "x": top_view.x_range_m[1],
        "y": top_view.y_range_m[1],
        "strips": np.column_stack([row, first, last]).tolist(),
    }


def _base64(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")
