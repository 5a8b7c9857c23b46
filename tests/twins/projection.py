"""Slow twins of projecting points."""

from __future__ import annotations

from typing import Any

import numpy as np

from edgeperc.types.card import InputSpec


def top_view_pixel(point: np.ndarray, view: Any) -> tuple[int, Any]:
    """Flat pixel of one point and its rank, the smaller the better; (-1, None) out of view."""
    x, y, z, remission = point
    (x_min, x_max), (y_min, y_max), (z_min, z_max) = np.float32([view.x_range_m, view.y_range_m, view.z_range_m])
    if not (x_min <= x < x_max and y_min <= y < y_max and z_min <= z <= z_max and np.isfinite(remission)):
        return -1, None
    cells_per_m = np.float32(1.0 / view.cell_m)
    ahead = min(int((x - x_min) * cells_per_m), view.height - 1)
    left = min(int((y - y_min) * cells_per_m), view.width - 1)
    return (view.height - 1 - ahead) * view.width + view.width - 1 - left, -z


def range_image_pixel(point: np.ndarray, view: Any, row_edges: np.ndarray, col_edges: np.ndarray) -> tuple[int, Any]:
    """Flat pixel of one point and its rank, the smaller the better; (-1, None) out of view."""
    if not np.isfinite(point).all():
        return -1, None
    x, y, z, _ = point
    squared_distance = x * x + y * y
    squared_range = squared_distance + z * z
    if squared_distance == 0 or not np.isfinite(squared_range):
        return -1, None
    azimuth = y / (abs(x) + abs(y))
    if x < 0:
        azimuth = np.float32(2 if y >= 0 else -2) - azimuth
        if azimuth == -2:  # rounded onto the far side of straight behind
            azimuth = np.nextafter(np.float32(-2), np.float32(0))
    elevation = z / (np.sqrt(squared_distance) + abs(z))
    row = np.count_nonzero(elevation <= row_edges) - 1
    col = np.count_nonzero(azimuth <= col_edges) - 1
    if not (0 <= row < view.height and 0 <= col < view.width):
        return -1, None
    return row * view.width + col, squared_range


def bend(points: np.ndarray, index: np.ndarray, flat: int, width: int) -> np.float32:
    """How much the range bends at a pixel; 0 at an end of a row and beside an empty pixel."""
    if flat % width in (0, width - 1) or min(index[flat - 1], index[flat + 1]) < 0:
        return np.float32(0.0)
    x, y, z, _ = points[index[flat - 1 : flat + 2]].T
    before, here, after = np.sqrt(x * x + y * y + z * z)
    return np.float32(abs(before - np.float32(2.0) * here + after))


def curvatures(points: np.ndarray, heights: np.ndarray | None, index: np.ndarray, width: int) -> dict[int, np.float32]:
    """The root of the bend of each pixel with a point, at most 1, less what noise beyond 4 cm of the ground's adds."""
    bends = {flat: bend(points, index, flat, width) for flat in np.flatnonzero(index >= 0).tolist()}
    level = [
        value for flat, value in bends.items() if heights is not None and value > 0 and abs(heights[index[flat]]) < 0.15
    ]
    typical = np.float32(np.median(level)) if len(level) >= 500 else np.float32(0.0)
    noise = (typical * typical - np.float32(0.04) * np.float32(0.04)) * np.float32(0.6745**-2)
    if noise > 0:
        bends = {flat: np.sqrt(np.maximum(value * value - noise, np.float32(0.0))) for flat, value in bends.items()}
    return {flat: np.sqrt(np.minimum(value, np.float32(1.0))) for flat, value in bends.items()}


def project(
    points: np.ndarray, view: Any, edges: Any, spec: InputSpec, height_m: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Twin of the kernels: image, index, pixel. ``edges``: a range image's, of rows and columns."""
    image = np.zeros((len(spec.channels), view.height * view.width), np.float32)
    index = np.full(view.height * view.width, -1, np.int32)
    pixel = np.full(len(points), -1, np.int32)
    best = {}
    mean, std = np.float32(spec.mean), np.float32(spec.std)
    with np.errstate(all="ignore"):
        for i, point in enumerate(points):
            flat, rank = (
                top_view_pixel(point, view) if view.kind == "top_view" else range_image_pixel(point, view, *edges)
            )
            pixel[i] = flat
            if flat < 0 or (flat in best and not rank < best[flat]):
                continue
            best[flat] = rank
            index[flat] = i
            x, y, z, remission = point
            distance = np.sqrt(x * x + y * y)
            above = -1.0 if height_m is None or np.isnan(height_m[i]) else min(max(height_m[i], -1.0), 5.0)
            raw = {
                "x": x, "y": y, "z": z, "height": z, "distance": distance, "range": np.sqrt(x * x + y * y + z * z),
                "remission": remission, "height_above_ground": above, "curvature": np.float32(0.0),
            }  # fmt: skip
            image[:, flat] = (np.array([raw[name] for name in spec.channels], np.float32) - mean) / std
        for c in [c for c, name in enumerate(spec.channels) if name == "curvature"]:
            heights = height_m if "height_above_ground" in spec.channels else None
            for flat, raw in curvatures(points, heights, index, view.width).items():
                image[c, flat] = (raw - mean[c]) / std[c]
    return image.reshape(-1, view.height, view.width), index.reshape(view.height, view.width), pixel
