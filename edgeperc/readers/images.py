"""Read a camera's image from a file, with Pillow."""

from __future__ import annotations

import io
import os
from typing import Any

import numpy as np

from ..camera.image import check_size
from ..errors import ImageError
from ..system.extras import require
from ..system.fields import Fields
from ..types.points import Bytes
from .unknown import missing

_FIELDS = Fields("the image", ImageError)
IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".png", ".ppm", ".webp")
# Only these decoders: others of Pillow start programs (EPS), print what is damaged (TIFF) or are of no camera.
FORMATS = ("BMP", "JPEG", "PNG", "PPM", "WEBP")
MAX_FILE_BYTES = 256 * 2**20
# Modes of Pillow that have one meaning as red, green and blue of 8 bits.
CONVERTED = {"RGB", "L", "P", "RGBA", "LA", "PA"}


def read_image(path: str | os.PathLike[str]) -> Bytes:
    """Read the image of a file; needs the extra ``camera``.

    The content decides the format. The image is turned as its EXIF orientation says. Gray gets three equal channels, a
    palette its colors, and an alpha channel is dropped if it is opaque. Color profiles are ignored.

    Parameters
    ----------
    path : str or path
        A JPEG, PNG, WebP, BMP or PPM file of one image.

    Returns
    -------
    (H, W, 3) uint8
        Red, green, blue; row 0 is the top.

    Raises
    ------
    ImageError
        The file is missing, empty, cut short, damaged, larger than 256 MiB or of another format; or the image has 16
        bits a channel, transparent pixels, other channels, several frames, no pixels or more than 2**26, which is
        checked before it is decoded.
    MissingExtraError
        Pillow is not installed.
    """
    path = _FIELDS.path("the image", path)
    pillow = require("PIL.Image", "camera", "Reading an image", package="pillow")
    turned = require("PIL.ImageOps", "camera", "Reading an image", package="pillow").exif_transpose
    try:
        if not path.is_file():
            raise ImageError(missing(path, "file", "an image as .jpg, .png, .webp, .bmp or .ppm"))
        size = path.stat().st_size
        if not 0 < size <= MAX_FILE_BYTES:
            raise ImageError(f"the file has {size:,} bytes; expected 1 to {MAX_FILE_BYTES:,}")
        with pillow.open(io.BytesIO(path.read_bytes()), formats=FORMATS) as image:
            _check(image)
            image.load()
            return _rgb(turned(image))
    except ImageError as exc:
        raise ImageError(f"{path}: {exc}") from exc
    except MemoryError as exc:
        raise ImageError(f"{path}: reading it takes more memory than there is") from exc
    except Exception as exc:  # on damaged files, Pillow's decoders raise nearly every kind of error
        raise ImageError(
            f"{path}: the image cannot be read: it is damaged, cut short or of another format than "
            f"{', '.join(FORMATS)} ({type(exc).__name__}: {exc})"
        ) from exc


def _check(image: Any) -> None:
    """Refuse by its header an image that would not be read."""
    check_size(*image.size)
    if getattr(image, "n_frames", 1) != 1:
        raise ImageError(f"the file holds {image.n_frames} images; expected one")
    # A PPM file says its largest value, up to 65535, which Pillow would scale to 255.
    deep = any(
        ";16" in str(tile[3]) or (isinstance(tile[3], tuple) and str(tile[0]).startswith("ppm") and tile[3][1] > 255)
        for tile in image.tile
    )
    if deep or image.mode in ("I", "F") or image.mode.startswith("I;"):
        raise ImageError(
            f"the image has more than 8 bits a channel (mode {image.mode}); which of them to keep depends on the "
            "camera: convert it to 8 bits first"
        )
    if image.mode not in CONVERTED:
        raise ImageError(f"the image is of mode {image.mode}; expected colors or gray of 8 bits: convert it to RGB")


def _rgb(image: Any) -> Bytes:
    """Red, green and blue of a decoded image."""
    if image.mode in ("RGBA", "LA", "PA") or "transparency" in image.info:
        values = np.asarray(image.convert("RGBA"))
        n_clear = int(np.count_nonzero(values[:, :, 3] < 255))
        if n_clear:
            raise ImageError(
                f"{n_clear} of {values.shape[0] * values.shape[1]} pixels are transparent, and what is behind them is "
                "not known; put the image on a background first"
            )
        return np.ascontiguousarray(values[:, :, :3])
    return np.array(image.convert("RGB"))
