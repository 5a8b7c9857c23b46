"""Slow twin of `edgeperc.inference.decode.fill_pixels`."""

from __future__ import annotations

import numpy as np


def pixels(blocks: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Twin of `blocks.fill_pixels`: the image (C, H, W) of blocks (C x rows x cols, H / rows, W / cols)."""
    n, height, width = blocks.shape
    image = np.empty((n // (rows * cols), height * rows, width * cols), blocks.dtype)
    for c, row, col in np.ndindex(*image.shape):
        channel = (c * rows + row % rows) * cols + col % cols
        image[c, row, col] = blocks[channel, row // rows, col // cols]
    return image
