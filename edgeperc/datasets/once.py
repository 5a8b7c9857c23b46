"""ONCE as it is downloaded: a folder for each sequence, with one document of its frames."""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import PointsError
from ..readers.files import read_points
from .annotations import read_json, upright_box
from .tree import Labeled, Tree, present

_Rows = list[tuple[str, list[float]]]  # class, and x, y, z, length, width, height, yaw of a box, as ONCE has them


class Once(Tree):
    """The annotated scans of ONCE (Mao et al., 2021), in ``ROOT/SEQ``, ``ROOT/data/SEQ`` or ``ROOT/SPLIT/data/SEQ``.
    Its x points to the left and its y back; here, x is ahead. Frames without a box are left out, as others do.
    """

    def __init__(self, root: Path) -> None:
        self._rows = lru_cache(maxsize=2)(_annotated)
        depths = ("", "data/", "*/data/")
        found = (path for depth in depths for path in sorted(root.glob(f"{depth}[0-9]*/[0-9]*.json")))
        files = {
            f"{path.stem}_{frame}": path.with_name("lidar_roof") / f"{frame}.bin"
            for path in found
            if path.stem == path.parent.name
            for frame in _annotated(path)
        }
        if not files:
            raise PointsError(f"{root} has no annotated frame of ONCE; expected SEQ/SEQ.json or data/SEQ/SEQ.json")
        self.scans = present(files, root, "annotated scans")
        self.drives = {name: path.parents[1].name for name, path in self.scans.items()}

    def read(self, name: str) -> Labeled:
        """Read a scan, turned until x is ahead, and its boxes. Raises PointsError."""
        path = self.scans[name]
        points = read_points(path, columns=4)[:, [1, 0, 2, 3]] * np.array([-1.0, 1.0, 1.0, 1.0], np.float32)
        document = path.parents[1] / f"{path.parents[1].name}.json"
        boxes = []
        try:
            for kind, (x, y, z, length, width, height, yaw) in self._rows(document)[path.stem]:
                turned = (0.0, 0.0, yaw + 0.5 * math.pi)
                boxes.append(upright_box(kind, (-y, x, z), (length, width, height), turned))
        except (KeyError, TypeError, ValueError) as exc:
            raise PointsError(f"{document}: a box of {path.stem} is none of ONCE's ({exc!s:.200})") from exc
        return Labeled(points, boxes)


def _annotated(path: Path) -> dict[str, _Rows]:
    """The boxes of the frames that have some."""
    document, frames = read_json(path, dict, "the frames of a sequence of ONCE"), dict[str, Any]()
    try:
        for frame in document["frames"]:
            name, annotations = str(frame["frame_id"]), frame.get("annos") or {}
            if not (name.isascii() and name.isdigit()):
                raise ValueError(f"a frame_id {name!r:.40}, which is no time")
            if boxes := annotations.get("boxes_3d"):
                frames[name] = [*zip(annotations["names"], boxes, strict=True)]
            if not all(isinstance(kind, str) for kind, _ in frames.get(name, ())):
                raise TypeError("a class that is no text")
    except (AttributeError, KeyError, TypeError, ValueError) as exc:
        told = (
            f"{path} has a frame that is not ONCE's ({exc!r:.100}); expected frame_id, and names and boxes_3d in annos"
        )
        raise PointsError(told) from exc
    return frames
