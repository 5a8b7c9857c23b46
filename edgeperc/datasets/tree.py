"""A public set in its own tree: what a reader of one gives."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from ..errors import PointsError
from ..types.perception import Box
from ..types.points import Floats, Points
from .kitti import KittiCalibration, KittiLabels


class Camera(NamedTuple):
    """The camera in whose image objects are labeled."""

    calibration: KittiCalibration
    unlabeled: Floats  # (k, 4), DontCare: left, top, right, bottom [px]
    labels: KittiLabels | None = None  # KITTI's rows, with the classes of the set


class Labeled(NamedTuple):
    """A scan with x ahead, and what its set says of it; None where it says nothing."""

    points: Points
    boxes: list[Box] | None  # with the classes of the set
    numbers: NDArray[Any] | None = None  # of the points' classes
    drivable: tuple[Floats, ...] | None = None
    camera: Camera | None = None  # None: objects are labeled as the description says


class Tree:
    """The labeled scans of a set: their files and drives by name, and the names of points' classes by number."""

    scans: dict[str, Path]
    drives: dict[str, str]
    point_names: Mapping[int, str] = {}
    names_file = "category.json"  # of ``point_names``

    def read(self, name: str) -> Labeled:
        """Read a scan and its labels. Raises PointsError."""
        raise NotImplementedError


def present(files: Mapping[str, Path], root: Path, what: str, *, all_may_lack: bool = False) -> dict[str, Path]:
    """Those of the files that are there, as sets are downloaded in parts. Raises PointsError if none is."""
    there = {name: path for name, path in files.items() if path.is_file()}
    lacking = next((path for name, path in files.items() if name not in there), None)
    told = f"{root}: of {len(files):,} {what} {len(there):,} are there, and not {lacking or 'more'}"
    if not there and not all_may_lack:
        raise PointsError(f"{told}; expected the set's files beside its tables")
    if lacking:
        warnings.warn(f"{told}; the others are left out", stacklevel=5)
    return there
