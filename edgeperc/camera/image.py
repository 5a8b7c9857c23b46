"""A camera's image: arrays checked, scaled to a network's input, and the network's logits as labels of its pixels.

Both kernels use tables of weights that are made once for a size of image. They compute in float32 with one rounding
per operation and in one thread, so compiled code, interpreted code and any number of threads agree on every bit.
"""

from __future__ import annotations

import os
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..errors import CardMismatchError, ImageError, InferenceError
from ..system.kernels import njit
from ..types.card import CHANNELS, InputSpec
from ..types.points import Bytes, Floats32, Ints, Labels, read_only
from ..types.views import CameraGeometry

MAX_PIXELS = 2**26  # 8192 x 8192: three times a photograph of 24 megapixels, 200 MB
MAX_EDGE = 2**15


def check_size(width: int, height: int) -> None:
    """Raise `ImageError` for an image without pixels, or with more than `MAX_PIXELS` or `MAX_EDGE` along an edge."""
    if width < 1 or height < 1:
        raise ImageError(f"got an image of {width} x {height}; expected at least one pixel")
    if width * height > MAX_PIXELS or max(width, height) > MAX_EDGE:
        raise ImageError(
            f"got an image of {width} x {height}; expected at most {MAX_PIXELS:,} pixels and {MAX_EDGE:,} along an "
            "edge. Scale it down first"
        )


def as_image(array: ArrayLike) -> Bytes:
    """Check that an array is an image: (H, W, 3) uint8, red first, in any layout, at most 2**26 pixels and 2**15 along
    an edge; C-contiguous and read-only.
    """
    if isinstance(array, np.ma.MaskedArray):
        raise ImageError("got a masked array; fill it first, e.g. with array.filled(0)")
    if isinstance(array, str | os.PathLike):
        raise ImageError(f"got {os.fspath(array)!r:.80}; expected (H, W, 3) uint8: pass edgeperc.read_image(path)")
    try:
        # Ragged sequences raise ValueError; the __array__ of an object may raise anything.
        values = np.asarray(array)
    except Exception as exc:
        raise ImageError(f"got an object that is not an array: {exc}; expected (H, W, 3) uint8") from exc
    if values.ndim != 3 or values.shape[2] != 3:
        raise ImageError(
            f"got an array of shape {values.shape}; expected (H, W, 3): red, green, blue{_advice(values.shape)}"
        )
    if values.dtype != np.uint8:
        advice = ""
        if values.dtype == np.uint16:
            advice = "; if all 16 bits are used, pass (image >> 8).astype(np.uint8)"
        elif values.dtype.kind == "f":
            advice = "; if the values are 0..1, pass np.rint(255 * image).astype(np.uint8)"
        raise ImageError(f"got an image of {values.dtype}; expected uint8, 0..255{advice}")
    check_size(values.shape[1], values.shape[0])
    return read_only(values, np.uint8)


def _advice(shape: tuple[int, ...]) -> str:
    if len(shape) == 2:
        return "; if it is gray, pass np.repeat(image[:, :, None], 3, axis=2)"
    if len(shape) == 3 and shape[2] == 1:
        return "; if it is gray, pass np.repeat(image, 3, axis=2)"
    if len(shape) == 3 and shape[2] == 4:
        return "; if the fourth channel is alpha, pass image[:, :, :3]"
    if len(shape) == 3 and shape[0] == 3:
        return "; pass image.transpose(1, 2, 0)"
    if len(shape) == 4:
        return "; pass one image at a time"
    return ""


class Taps(NamedTuple):
    """The pixels of an image that count for each pixel of the output, along one axis."""

    start: Ints  # (n_out,), the first; ``start + K`` is at most the image's size
    weights: Floats32  # (n_out, K), from there; their sum is 1, but for rounding


class Channels(NamedTuple):
    """The channels of a network's input, and what they are normalized by."""

    source: Ints  # (C,): 0 red, 1 green, 2 blue
    mean: Floats32  # (C,)
    std: Floats32  # (C,)


class ImageScaler:
    """Scale images of any size to a network's input, and normalize them.

    A pixel of the input is the mean of the image's pixels around its center, weighted by a triangle: half-pixel
    centers, one pixel of the input wide to each side, and at least one of the image. This is also what Pillow's
    ``BILINEAR`` and ``torch.nn.functional.interpolate(mode="bilinear", antialias=True)`` compute. The tables of the
    last size are kept, so use one instance per thread.
    """

    def __init__(self, view: CameraGeometry, input: InputSpec) -> None:
        self.shape = (len(input.channels), view.height, view.width)
        source = np.array([CHANNELS["camera"].index(name) for name in input.channels], np.int32)
        self._channels = Channels(source, np.array(input.mean, np.float32), np.array(input.std, np.float32))
        self._tables_of: tuple[int, int] | None = None

    def fill(self, image: Bytes, out: Floats32) -> None:
        """Scale an image into the caller's buffer: ``(value - mean) / std`` per channel."""
        image = as_image(image)
        if out.shape != self.shape or out.dtype != np.float32 or not out.flags.carray:
            raise ImageError(f"the buffer is {out.shape} {out.dtype}; expected {self.shape} float32, C-contiguous")
        rows, columns, _ = image.shape
        if self._tables_of != (rows, columns):
            self._tables = taps(rows, self.shape[1]), taps(columns, self.shape[2])
            self._tables_of = (rows, columns)
        fill_scaled(image.reshape(rows, -1), *self._tables, self._channels, out)


def taps(n_in: int, n_out: int) -> Taps:
    """The pixels of a line of the image that make each pixel of the input, and their weights."""
    scale = n_in / n_out
    reach = max(scale, 1.0)
    center = (np.arange(n_out) + 0.5) * scale - 0.5
    at = np.floor(center - reach).astype(np.int64)[:, None] + np.arange(int(np.ceil(2.0 * reach)) + 2)
    weights = np.maximum(1.0 - np.abs(at - center[:, None]) / reach, 0.0) * ((at >= 0) & (at < n_in))
    weights[weights < 1e-6] = 0.0  # a tap that only rounding makes
    counts = weights > 0.0
    first, last = counts.argmax(axis=1), counts.shape[1] - counts[:, ::-1].argmax(axis=1)
    n_taps = int((last - first).max())
    start = np.minimum(at[:, 0] + first, n_in - n_taps)
    columns = start[:, None] + np.arange(n_taps) - at[:, :1]
    inside = (columns >= 0) & (columns < at.shape[1])
    kept = np.where(inside, np.take_along_axis(weights, np.where(inside, columns, 0), axis=1), 0.0)
    return Taps(start.astype(np.int32), (kept / kept.sum(axis=1, keepdims=True)).astype(np.float32))


@njit(cache=True, nogil=True)
def fill_scaled(image: Bytes, rows: Taps, columns: Taps, channels: Channels, out: Floats32) -> None:
    """Scale and normalize an image: for each row of the output, first along columns, then along rows.

    image : (H, 3 * W) uint8, C-contiguous; red, green, blue of each pixel.
    """
    row_start, row_weights = rows
    col_start, col_weights = columns
    n_values = image.shape[1]
    n_channels, height, width = out.shape
    n_rows, n_columns = row_weights.shape[1], col_weights.shape[1]
    mixed = np.empty(n_values, np.float32)
    for row in range(height):
        first = row_start[row]
        weight = row_weights[row, 0]
        for k in range(n_values):
            mixed[k] = weight * np.float32(image[first, k])
        for tap in range(1, n_rows):
            weight = row_weights[row, tap]
            for k in range(n_values):
                mixed[k] += weight * np.float32(image[first + tap, k])
        for c in range(n_channels):
            channel = channels.source[c]
            center, spread = channels.mean[c], channels.std[c]
            for col in range(width):
                at = 3 * col_start[col] + channel
                value = col_weights[col, 0] * mixed[at]
                for tap in range(1, n_columns):
                    value += col_weights[col, tap] * mixed[at + 3 * tap]
                out[c, row, col] = (value - center) / spread


def label_pixels(logits: Floats32, height: int, width: int, *, model: str = "the model") -> Bytes:
    """The most probable class of every pixel of an image; the lower one on ties.

    The logits are interpolated bilinearly between the centers of their grid, which covers the whole image; beyond the
    outermost centers they stay the same. Between four centers of one class, that class is taken: whatever the weights,
    no other can have a larger sum.
    """
    if logits.ndim != 3 or not 1 <= logits.shape[0] <= 255 or 0 in logits.shape:
        raise CardMismatchError(f"{model}: camera_logits have shape {logits.shape}; expected (C, h, w), C up to 255")
    values = read_only(logits)
    labels = np.empty((height, width), np.uint8)
    n_bad = fill_image_labels(values, *between(values.shape[1], height), *between(values.shape[2], width), labels)
    if n_bad:
        raise InferenceError(
            f"{model}: {n_bad} of {values.size} values of camera_logits are not finite; run another provider or "
            "precision, and edgeperc info MODEL"
        )
    return labels


def between(n_in: int, n_out: int) -> tuple[Ints, Floats32, Ints]:
    """Interpolation along one axis: the two centers of the grid beside each pixel (2, n_out), the weight of the second,
    and where runs of pixels between the same two begin.
    """
    at = np.clip((np.arange(n_out) + 0.5) * (n_in / n_out) - 0.5, 0.0, n_in - 1.0)
    first = np.floor(at).astype(np.int32)
    weight = (at - first).astype(np.float32)
    sides = np.stack([first, np.where(weight > 0.0, np.minimum(first + 1, n_in - 1), first)]).astype(np.int32)
    begins = np.flatnonzero((np.diff(sides, axis=1) != 0).any(axis=0)) + 1
    return sides, weight, np.concatenate([[0], begins, [n_out]]).astype(np.int32)


@njit(cache=True, nogil=True)
def fill_image_labels(
    logits: Floats32,
    row_sides: Ints,
    row_weight: Floats32,
    row_runs: Ints,
    col_sides: Ints,
    col_weight: Floats32,
    col_runs: Ints,
    labels: Labels,
) -> int:
    """Write every pixel's best class (`label_pixels`, `between`); returns how many logits are not finite."""
    n_classes, height, width = logits.shape
    n_bad = 0
    coarse = np.empty((height, width), np.uint8)
    best = np.empty(width, np.float32)
    for row in range(height):
        # Class by class along a row: each of these loops is compiled to vector instructions.
        label = coarse[row]
        for col in range(width):
            best[col] = logits[0, row, col]
            label[col] = 0
        for c in range(1, n_classes):
            for col in range(width):
                value = logits[c, row, col]
                better = value > best[col]
                best[col] = value if better else best[col]
                label[col] = np.uint8(c) if better else label[col]
        for c in range(n_classes):
            for col in range(width):
                n_bad += 0 if abs(logits[c, row, col]) < np.float32(np.inf) else 1
    if n_bad:
        return n_bad
    left, right = np.empty(n_classes, np.float32), np.empty(n_classes, np.float32)
    for j in range(len(row_runs) - 1):
        above, below = row_sides[0, row_runs[j]], row_sides[1, row_runs[j]]
        for k in range(len(col_runs) - 1):
            begin, end = col_runs[k], col_runs[k + 1]
            before, behind = col_sides[0, begin], col_sides[1, begin]
            one = coarse[above, before]
            if one == coarse[above, behind] and one == coarse[below, before] and one == coarse[below, behind]:
                for row in range(row_runs[j], row_runs[j + 1]):
                    for col in range(begin, end):
                        labels[row, col] = one
                continue
            for row in range(row_runs[j], row_runs[j + 1]):
                lower = row_weight[row]
                upper = np.float32(1.0) - lower
                for c in range(n_classes):
                    left[c] = upper * logits[c, above, before] + lower * logits[c, below, before]
                    right[c] = upper * logits[c, above, behind] + lower * logits[c, below, behind]
                for col in range(begin, end):
                    far = col_weight[col]
                    near = np.float32(1.0) - far
                    highest = near * left[0] + far * right[0]
                    found = 0
                    for c in range(1, n_classes):
                        value = near * left[c] + far * right[c]
                        if value > highest:
                            highest = value
                            found = c
                    labels[row, col] = found
    return n_bad
