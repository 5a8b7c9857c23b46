"""Compare the answers of two computers (`answers.py`)."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Answers = tuple[dict[str, NDArray[Any]], dict[str, Any]]

MAX_UNLIKE = 0.001
"""Largest share of points, cells and pixels with another class, and of boxes without a counterpart."""

# Largest distance between two boxes that count as the same [m, rad, 1].
CENTER_M, SIZE_M, YAW_RAD, SCORE = 0.1, 0.1, 0.05, 0.02


def read(path: Path) -> Answers:
    """The arrays and the document of a file that `answers.py` wrote."""
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    document: dict[str, Any] = json.loads(str(arrays.pop("document")))
    return arrays, document


def unlike_values(one: Answers, other: Answers, start: str) -> tuple[int, int]:
    """Number of values of ``other`` that ``one`` lacks or has otherwise, and of all, in arrays whose name begins so."""
    unlike = total = 0
    for name, array in other[0].items():
        if name.startswith(start):
            total += array.size
            found = one[0].get(name)
            is_comparable = found is not None and found.shape == array.shape
            unlike += int(np.count_nonzero(found != array)) if is_comparable else array.size
    return unlike, total


def unlike_boxes(one: Sequence[Mapping[str, Any]], other: Sequence[Mapping[str, Any]]) -> int:
    """Number of boxes, of both lists, without a counterpart in the other one."""
    left, unlike = [*other], 0
    for box in one:
        found = next((k for k, candidate in enumerate(left) if _is_same(box, candidate)), None)
        if found is None:
            unlike += 1
        else:
            del left[found]
    return unlike + len(left)


def _is_same(box: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    turned = abs(math.remainder(box["yaw"] - other["yaw"], 2.0 * math.pi))
    return (
        box["label"] == other["label"]
        and math.dist(box["center"], other["center"]) <= CENTER_M
        and math.dist(box["size"], other["size"]) <= SIZE_M
        and turned <= YAW_RAD
        and abs(box["score"] - other["score"]) <= SCORE
    )


def compare(
    name: str, here: Answers, there: Answers, kind: str, auto: Mapping[str, str]
) -> tuple[list[list[str]], list[str]]:
    """Compare the answers of another processor, to "scans" or of "networks", with those of this one: rows of a table
    with the columns of `COLUMNS`, and what differs more than it may. ``auto``: network -> the precision that ``"auto"``
    should take there.
    """
    rows, faults = [], []
    for precision in ("fp32", "int8"):
        whats = {"scans": ("points", "cells"), "networks": ("pixels",)}[kind]
        counts = {what: unlike_values(there, here, f"{precision} {what} ") for what in whats}
        if kind == "scans":
            boxes = {key: value for key, value in here[1]["boxes"].items() if key.startswith(precision)}
            unlike = sum(unlike_boxes(value, there[1]["boxes"].get(key, [])) for key, value in boxes.items())
            counts["boxes"] = unlike, sum(map(len, boxes.values()))
        for what, (unlike, total) in counts.items():
            rows.append([name, precision, what, f"{total:,}", f"{unlike:,}"])
            if total == 0 or unlike > MAX_UNLIKE * total:
                faults.append(f"{name}, {precision}: {unlike:,} of {total:,} {what} differ")
    if kind == "networks" and there[1]["auto"] != dict(auto):
        faults.append(f"{name}: precision auto took {there[1]['auto']}, expected {dict(auto)}")
    return rows, faults


COLUMNS = ("processor", "precision", "what", "number", "differ from x86")
