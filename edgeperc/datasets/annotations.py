"""Read the boxes that annotation tools save: labelCloud, SUSTechPOINTS, CVAT (Datumaro's JSON)."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import PointsError
from ..types.perception import Box

LARGEST_TILT = math.radians(20.0)
"""Boxes have a yaw alone. A box that is tilted further is an error."""
_PSR = ("position", "scale", "rotation")


def read_labelcloud(path: Path) -> list[Box]:
    """Read ``labels/NAME.json`` of labelCloud, in the format that ``_classes.json`` names. Raises PointsError."""
    settings = path.with_name("_classes.json")
    known = read_json(settings).get("format", "centroid_rel") if settings.exists() else "centroid_rel"
    if known not in ("centroid_rel", "centroid_abs"):
        raise PointsError(f"{settings} has format {known!r:.40}; save the labels as centroid_rel or centroid_abs")
    with _holding(path, "labels of labelCloud"):
        return [
            upright_box(
                item["name"],
                [item["centroid"][axis] for axis in "xyz"],
                [item["dimensions"][name] for name in ("length", "width", "height")],
                [_angle(item["rotations"][axis], known) for axis in "xyz"],
            )
            for item in read_json(path)["objects"]
        ]


def read_sustechpoints(path: Path) -> list[Box]:
    """Read ``label/NAME.json`` of SUSTechPOINTS. Parameters, results and errors as in `read_labelcloud`."""
    with _holding(path, "labels of SUSTechPOINTS"):
        return [
            upright_box(item["obj_type"], *([item["psr"][part][axis] for axis in "xyz"] for part in _PSR))
            for item in read_json(path, list)
        ]


def read_datumaro(path: Path) -> dict[str, list[Box]]:
    """Read ``annotations/default.json`` of "Datumaro 3D 1.0", which CVAT exports, by the name of the scan without
    folders; boxes of tracks that are outside are left out. Raises PointsError.
    """
    document, boxes = read_json(path), dict[str, list[Box]]()
    with _holding(path, "annotations of Datumaro"):
        names = [str(label["name"]) for label in document["categories"]["label"]["labels"]]
        for item in document["items"]:
            name = str(item["id"]).rpartition("/")[2]
            if name in boxes:
                raise PointsError(f"{path} has two scans called {name}; expected one")
            boxes[name] = [
                upright_box(
                    names[annotation["label_id"]], annotation["position"], annotation["scale"], annotation["rotation"]
                )
                for annotation in item["annotations"]
                if annotation["type"] == "cuboid_3d" and not annotation.get("attributes", {}).get("outside", False)
            ]
    return boxes


@contextmanager
def _holding(path: Path, what: str) -> Iterator[None]:
    """Raise `PointsError` for what is wrong with the entries of a document."""
    try:
        yield
    except PointsError:
        raise
    except (AttributeError, IndexError, KeyError, OverflowError, TypeError, ValueError) as exc:
        raise PointsError(f"{path} holds no {what} ({type(exc).__name__}: {exc})") from exc


def read_json(path: Path, kind: type = dict, expected: str = "the tool's JSON") -> Any:
    """A document whose root is of this kind. Raises PointsError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, RecursionError, ValueError) as exc:
        raise PointsError(f"{path} cannot be read ({exc}); expected {expected}") from exc
    if not isinstance(document, kind):
        raise PointsError(f"{path} holds a {type(document).__name__}; expected a {kind.__name__}")
    return document


def _angle(value: float, known: str) -> float:
    if known == "centroid_abs":
        return math.radians(value)
    if abs(value) > 2.0 * math.pi:
        raise ValueError(f"an angle of {value}, as in degrees; _classes.json of the tool says which they are")
    return value


def upright_box(name: str, center: Any, size: Any, rotation: Any) -> Box:
    """A box of its center, (length, width, height), and roll, pitch and yaw. Raises TypeError, ValueError."""
    (x, y, z), (length, width, height) = (map(float, values) for values in (center, size))
    roll, pitch, yaw = (math.remainder(float(angle), 2.0 * math.pi) for angle in rotation)
    numbers = x, y, z, length, width, height, roll, pitch, yaw
    if not all(map(math.isfinite, numbers)) or min(length, width, height) <= 0.0:
        raise ValueError(f"a box at {center} of size {size}; expected finite numbers and sizes above 0")
    if max(abs(roll), abs(pitch)) > LARGEST_TILT:
        raise ValueError(f"a box is tilted by {math.degrees(max(abs(roll), abs(pitch))):.0f} degrees; expected a yaw")
    return Box(str(name), 1.0, (x, y, z), (length, width, height), yaw)
