"""Slow twins of scaling images and of labeling their pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from edgeperc.types.card import InputSpec


def taps(n_in: int, n_out: int, k: int) -> dict[int, float]:
    """The pixels of the image that count for pixel k of the output, and their weights, which sum to 1."""
    scale = n_in / n_out
    reach = max(scale, 1.0)
    center = (k + 0.5) * scale - 0.5
    weights = {j: max(0.0, 1.0 - abs(j - center) / reach) for j in range(n_in)}
    weights = {j: weight for j, weight in weights.items() if weight >= 1e-6}
    total = math.fsum(weights.values())
    return {j: weight / total for j, weight in weights.items()}


def scaled(image: np.ndarray, view: Any, spec: InputSpec) -> np.ndarray:
    """The network's input in float64, pixel by pixel; (C, height, width)."""
    rows = np.zeros((view.height, image.shape[0]))
    columns = np.zeros((view.width, image.shape[1]))
    for table, n_in in ((rows, image.shape[0]), (columns, image.shape[1])):
        for k in range(len(table)):
            for j, weight in taps(n_in, len(table), k).items():
                table[k, j] = weight
    mixed = np.einsum("hi,ijc,wj->chw", rows, image.astype(np.float64), columns)
    order = [("red", "green", "blue").index(name) for name in spec.channels]
    mean, std = np.array(spec.mean)[:, None, None], np.array(spec.std)[:, None, None]
    return (mixed[order] - mean) / std


def fill_scaled(
    image: np.ndarray,
    rows: tuple[np.ndarray, np.ndarray],
    columns: tuple[np.ndarray, np.ndarray],
    normalized: tuple[np.ndarray, ...],
    out: np.ndarray,
) -> None:
    """Every operation of the kernel in its order, in float32; bit for bit the same."""
    (row_start, row_weights), (col_start, col_weights), (channels, mean, std) = rows, columns, normalized
    for row, first in enumerate(row_start):
        mixed = row_weights[row, 0] * image[first].astype(np.float32)
        for tap in range(1, row_weights.shape[1]):
            mixed = mixed + row_weights[row, tap] * image[first + tap].astype(np.float32)
        for c, channel in enumerate(channels):
            at = 3 * col_start + channel
            value = col_weights[:, 0] * mixed[at]
            for tap in range(1, col_weights.shape[1]):
                value = value + col_weights[:, tap] * mixed[at + 3 * tap]
            out[c, row] = (value - mean[c]) / std[c]


def side(n_in: int, n_out: int, k: int) -> tuple[int, int, float]:
    """The two centers of the grid around pixel k, and the weight of the second in float32."""
    at = min(max((k + 0.5) * (n_in / n_out) - 0.5, 0.0), n_in - 1.0)
    first = math.floor(at)
    weight = np.float32(at - first)
    return first, min(first + 1, n_in - 1) if weight > 0 else first, weight


def pixel_labels(logits: np.ndarray, height: int, width: int) -> np.ndarray:
    """Pixel by pixel: bilinear logits in float32, the lower class on ties; the class of four centers that share one."""
    labels = np.empty((height, width), np.uint8)
    coarse = logits.argmax(axis=0)
    for row in range(height):
        above, below, lower = side(logits.shape[1], height, row)
        for col in range(width):
            before, behind, far = side(logits.shape[2], width, col)
            around = {int(coarse[i, j]) for i in (above, below) for j in (before, behind)}
            upper, near = np.float32(1.0) - lower, np.float32(1.0) - far
            left = upper * logits[:, above, before] + lower * logits[:, below, before]
            right = upper * logits[:, above, behind] + lower * logits[:, below, behind]
            labels[row, col] = around.pop() if len(around) == 1 else (near * left + far * right).argmax()
    return labels
