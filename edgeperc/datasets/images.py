"""Labeled images in the folders of CamVid."""

from __future__ import annotations

import hashlib
import json
from itertools import pairwise
from pathlib import Path

import numpy as np

from ..errors import ImageError
from ..readers.images import IMAGE_SUFFIXES, read_image
from ..system.extras import require
from ..types.points import Bytes

FOLDERS = {"train": "train", "validation": "val", "test": "test"}
UNLABELED = ("unlabeled", "unlabelled", "void")  # both spellings are in data sets
IGNORE = 255


class LabeledImages:
    """Images and the classes of their pixels: ``{train,val,test}/NAME``, ``{...}annot/NAME.png``. Raises ImageError."""

    def __init__(self, root: Path) -> None:
        self.root = root
        try:
            document = json.loads((root / "classes.json").read_text("utf-8-sig"))
            names = [str(document[str(k)]) for k in range(len(document))]
        except (KeyError, OSError, RecursionError, TypeError, ValueError) as exc:
            raise ImageError(
                f"{root / 'classes.json'}: expected an object of id and name, ids from 0 ({type(exc).__name__}: {exc})"
            ) from exc
        self.classes = tuple(name for name in names if name.casefold() not in UNLABELED)
        self._n_ids, self._of_id = len(names), np.full(256, IGNORE, np.uint8)
        for k, name in enumerate(names[:256]):
            self._of_id[k] = self.classes.index(name) if name in self.classes else IGNORE

    @staticmethod
    def is_one(root: Path) -> bool:
        annotated = any((root / f"{folder}annot").is_dir() for folder in FOLDERS.values())
        return annotated and (root / "classes.json").is_file()

    def files(self, split: str) -> list[Path]:
        """The images of "train", "validation", "test", "held-back" (the last two) or "all"; ImageError without any."""
        parts = {"held-back": ("validation", "test"), "all": tuple(FOLDERS)}.get(split, (split,))
        folders = [self.root / FOLDERS[part] for part in parts]
        files = [
            file
            for folder in folders
            if folder.is_dir()
            for file in sorted(folder.glob("[!.]*"))
            if file.suffix.lower() in IMAGE_SUFFIXES
        ]
        for file, other in pairwise(files):  # they are sorted
            if file.with_suffix("") == other.with_suffix(""):
                raise ImageError(f"{file} and {other} would share the labels {file.stem}.png; remove or rename one")
        if not files:
            raise ImageError(f"{self.root} has no images of split {split}; expected some in {folders[0]}")
        return files

    def read(self, file: Path) -> tuple[Bytes, Bytes]:
        """Read an image (H, W, 3) and its labels (H, W), 255 where unlabeled. Raises ImageError."""
        image = read_image(file)
        path = file.parent.with_name(f"{file.parent.name}annot") / f"{file.stem}.png"
        pillow = require("PIL.Image", "camera", "Reading an image", package="pillow")
        try:
            with pillow.open(path, formats=("PNG",)) as opened:
                if opened.size != (image.shape[1], image.shape[0]) or opened.mode not in ("L", "P"):
                    raise ImageError(
                        f"{path}: {opened.size[0]} x {opened.size[1]} pixels of mode {opened.mode}; expected an id for "
                        f"each of the {image.shape[1]} x {image.shape[0]} pixels of {file.name}"
                    )
                ids, palette = np.asarray(opened), opened.getpalette() or []
            shown = np.array(palette, np.uint8).reshape(-1, 3)
            grays, used = shown[:, 0], np.unique(ids[ids < len(shown)])
            are_ids = ((grays[used] < self._n_ids) | (grays[used] == IGNORE)).all()
            if (shown == grays[:, None]).all() and are_ids and (grays[used] != used).any():
                raise ImageError(
                    f"{path}: the grays of its palette are ids in another order than its indices, as programs that "
                    "make PNG files smaller write them; expected the id of each pixel: save it as gray of 8 bits"
                )
            unnamed = ids[(ids >= self._n_ids) & (ids != IGNORE)]
            if unnamed.size:
                raise ImageError(
                    f"{path}: {unnamed.size} pixels have ids up to {unnamed.max()}; expected the ids 0 to "
                    f"{self._n_ids - 1} of {self.root / 'classes.json'}, or {IGNORE} for pixels without a class"
                )
        except ImageError:
            raise
        except Exception as exc:  # on damaged files, Pillow's decoders raise nearly every kind of error
            raise ImageError(f"{path}: the labels cannot be read ({type(exc).__name__}: {exc})") from exc
        return image, self._of_id[ids]


def image_hash(image: Bytes) -> str:
    """SHA-256 of an image's size and pixels, which a card records of the training images."""
    return hashlib.sha256(f"{image.shape}".encode() + np.ascontiguousarray(image).tobytes()).hexdigest()
