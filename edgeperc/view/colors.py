"""Colors of classes, points and panels."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types.points import Bytes, Floats

# CIELAB distance of at least 21 for normal, deuteranope, protanope and tritanope vision (Machado et al. 2009). With the
# palette of Okabe and Ito it is 5: a deuteranope sees pedestrians in the gray of the background.
CLASS_COLORS = {
    "background": "#7c8a99",
    "drivable": "#0a7f52",
    "car": "#ff9a0a",
    "van": "#f4eb8c",
    "truck": "#e32a0c",
    "pedestrian": "#ff93f0",
    "cyclist": "#2a90ff",
}
# Classes of the surroundings in scans and images, by name in lower case; those of objects and road keep their colors.
SCENE_COLORS = {
    "sky": "#6fb7e8",
    "building": "#8f6f5e",
    "pole": "#d9d2c0",
    "road": CLASS_COLORS["drivable"],
    "pavement": "#b48ade",
    "sidewalk": "#b48ade",
    "terrain": "#a3a05a",
    "tree": "#5f7d1e",
    "vegetation": "#5f7d1e",
    "signsymbol": "#fff04a",
    "fence": "#a34a2a",
    "bicyclist": CLASS_COLORS["cyclist"],
}
_OTHER_COLOR = "#ffffff"
INK, FAINT, FRAME, PANEL, GROUND = "#eef2f6", "#9fb0c0", "#2a343f", "#0b0f14", "#131920"
AMBER = "#ffc46b"

# Ends of the ramp for height and range: dim and cool, so that the classes stand out.
LOW, HIGH = "#48627d", "#ccd8e4"
FOUND, MISSED, FALSE = "#5d7468", "#ff4d4d", "#ffe14d"


def color_of(name: str) -> str:
    """Color of a class, ``"#rrggbb"``; white for a class without a color of its own."""
    lower = name.casefold()
    return CLASS_COLORS.get(lower) or SCENE_COLORS.get(lower, _OTHER_COLOR)


def rgb(colors: list[str]) -> Floats:
    """Colors "#rrggbb" as (n, 3) float64 in 0..1."""
    return np.array([[int(c[k : k + 2], 16) / 255.0 for k in (1, 3, 5)] for c in colors]).reshape(-1, 3)


def pixel_colors(names: Iterable[str]) -> Floats:
    """Color of each label of an image, (256, 3) float64 in 0..1; gray for those without a class."""
    colors = rgb([color_of(name) for name in names])
    return np.concatenate([colors, np.full((256 - len(colors), 3), 0.5)])


def byte_colors(names: Iterable[str]) -> Bytes:
    """Colors of classes, (n, 3) uint8 red, green, blue."""
    return np.asarray((rgb([color_of(name) for name in names]) * 255.0).round().astype(np.uint8))


def ramp(value: NDArray[Any], low: float, high: float) -> Floats:
    """Interpolate from LOW (at ``low``) to HIGH (at ``high``): colors (n, 3) float64 in 0..1."""
    share = np.clip((value - low) / (high - low), 0.0, 1.0)[..., None]
    dim, bright = rgb([LOW, HIGH])
    return np.asarray(dim + share * (bright - dim))
