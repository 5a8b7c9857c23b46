"""Labeled points as files: PLY and SemanticKITTI's labels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError, PointsError
from ..system.atomic import write_atomic
from ..types.perception import Perception, PointLabels, scan_of
from .colors import byte_colors
from .content import packed

# The raw ids of SemanticKITTI's .label files. It counts vans as cars; 99 is its "other-object".
SEMANTICKITTI_IDS = {
    "background": 0,
    "car": 10,
    "van": 10,
    "truck": 18,
    "pedestrian": 30,
    "cyclist": 31,
    "drivable": 40,
    "road": 40,
    "sidewalk": 48,
    "terrain": 72,
    "building": 50,
    "vegetation": 70,
    "pole": 80,
    # other classes of SemanticKITTI, by its names
    **{"bicycle": 11, "bus": 13, "motorcycle": 15, "on-rails": 16, "other-vehicle": 20},
    **{"person": 30, "bicyclist": 31, "motorcyclist": 32, "parking": 44, "other-ground": 49, "fence": 51},
    **{"other-structure": 52, "lane-marking": 60, "trunk": 71, "traffic-sign": 81},
}
_OTHER_ID = 99


def write_ply(perception: Perception, points: ArrayLike, path: str | Path) -> None:
    """Write the labeled scan as a binary PLY file.

    One row per input point, in input order: x, y, z, remission (float), label, red, green, blue (uchar). Comments in
    the header name the labels. If the perception has its place in a map (``origin_m``), x, y, z are in the map, as
    doubles.

    Parameters
    ----------
    perception : Perception
    points : (n, 4) or (n, 3) array_like, or a structured array
        The scan that was perceived: x, y, z [m] in the sensor frame, remission.
    path : str or Path
        An existing file is replaced atomically.

    Raises
    ------
    PointsError
        ``points`` is not the scan that was perceived, or the perception has no classes of points.
    OSError
        The file cannot be written.
    """
    scan = scan_of(perception, points)
    found = _labels_of(perception, "PLY file")
    in_map = perception.origin_m is not None
    fields = [*((name, "<f8" if in_map else "<f4") for name in "xyz"), ("remission", "<f4")]
    fields += [(name, "|u1") for name in ("label", "red", "green", "blue")]
    colors = byte_colors(found.classes)[found.labels]
    xyz = perception.to_map(scan) if in_map else scan
    rows = packed(fields, *xyz[:, :3].T, scan[:, 3], found.labels, *colors.T)
    kinds = {"<f4": "float", "<f8": "double", "|u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0"]
    header += [f"comment label {k} {' '.join(name.split())}" for k, name in enumerate(found.classes)]
    header += [f"element vertex {len(scan)}", *(f"property {kinds[t]} {name}" for name, t in fields), "end_header\n"]
    write_atomic(path, "\n".join(header).encode("ascii", "replace") + rows.tobytes())


def write_labels(perception: Perception, path: str | Path) -> None:
    """Write SemanticKITTI's ``.label`` layout: a uint32 for every input point, in input order.

    The upper 16 bits (the instance) are 0. The lower 16 bits hold the raw id of `SEMANTICKITTI_IDS`: 10 car, 30 person,
    31 bicyclist, 0 unlabeled (the first class, the background, and points out of view), 99 a class that SemanticKITTI
    lacks.

    Parameters
    ----------
    perception : Perception
    path : str or Path
        An existing file is replaced atomically, if it can be of this scan and this function.

    Raises
    ------
    PointsError
        The perception has no classes of points.
    OptionError
        The file there has labels of another number of points, or others than are written: perhaps the truth.
    OSError
        The file cannot be written.
    """
    found = _labels_of(perception, ".label file")
    ids = np.array([0, *(SEMANTICKITTI_IDS.get(name, _OTHER_ID) for name in found.classes[1:])], dtype="<u4")
    there = np.fromfile(path, "<u4") if Path(path).is_file() else np.empty(0)
    if len(there) not in (0, len(found.labels)) or not np.isin(there, [*SEMANTICKITTI_IDS.values(), _OTHER_ID]).all():
        raise OptionError(
            f"{path} has {len(there):,} labels of another scan, or labels that edgeperc does not write, perhaps the "
            f"truth, and stays; this scan has {len(found.labels):,} points. Choose another folder, or delete it"
        )
    write_atomic(path, ids[found.labels].tobytes())


def _labels_of(perception: Perception, what: str) -> PointLabels:
    if perception.points is None:
        raise PointsError(
            f"a {what} needs a class for every point, but no range-image model ran for this perception. "
            "Add one, such as 'pointseg'"
        )
    return perception.points
