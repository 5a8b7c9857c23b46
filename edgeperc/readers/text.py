"""Tables of text: a row for each point, with or without a line of names."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..types.points import plain_name
from .raw import TEXT_BYTES
from .tables import Columns

_UNNAMED = {3: ("x", "y", "z"), 4: ("x", "y", "z", "remission")}
# Of .pts, whose first line is the number of points.
_UNNAMED_PTS = {
    **_UNNAMED,
    6: ("x", "y", "z", "red", "green", "blue"),
    7: ("x", "y", "z", "intensity", "red", "green", "blue"),
}
_BLANKS = str.maketrans({",": " ", ";": " ", "\t": " "})


def begins_like_text(head: bytes) -> bool:
    """Whether the first bytes are those of a text."""
    sample = np.frombuffer(head[:4096].removeprefix(b"\xef\xbb\xbf"), np.uint8)
    return bool(len(sample) and TEXT_BYTES[sample].all())


def parse_text(data: NDArray[np.uint8], columns: Sequence[str] | int | None) -> Columns:
    """The columns of a table: separated by blanks, commas or semicolons, below comments (``#``, ``//``).

    A first line of one whole number is the number of points, as in ``.pts``. Names are those of a line of words.

    columns : names of the columns, in place of those in the file.
    Raises PointsError.
    """
    lines = data.tobytes().decode("utf-8-sig", "replace").translate(_BLANKS).splitlines()
    rows = [line for line in (line.strip() for line in lines) if line]
    names: tuple[str, ...] = ()
    counts = list[int]()
    while rows and (_numbers(rows[0]) is None or len(rows[0].split()) < 3):
        first = rows.pop(0)
        words = first.lstrip("#/").replace('"', "").split()
        if _numbers(first) is None and {"x", "y", "z"} <= {plain_name(word) for word in words}:
            names = tuple(plain_name(word) for word in words)
        elif len(words) == 1 and words[0].isdecimal() and len(words[0]) < 19:
            counts.append(int(words[0]))
        elif not first.startswith(("#", "//")):
            raise PointsError(f"the text is no table of points: it has a line {first[:60]!r}; {_EXPECTED}")
    if not rows:
        raise PointsError(f"the text has no row of three numbers; {_EXPECTED}")
    if len(counts) == 2:
        raise PointsError("this is a PTX file by its first lines; convert it with CloudCompare, to .pts, .pcd or .ply")
    n = len(rows[0].split())
    if columns is not None and not isinstance(columns, int | np.integer):
        names = tuple(str(name).lower() for name in columns)
    names = names or (_UNNAMED_PTS if counts else _UNNAMED).get(n, ())
    if len(names) != n:
        got = f"{len(names)} names" if names else "no names"
        raise PointsError(f"a row has {n} numbers, and there are {got}: pass columns= (--columns) with their names")
    try:
        table = np.loadtxt(io.StringIO("\n".join(rows)), np.float64, comments=None, ndmin=2)
    except (ValueError, OverflowError) as exc:
        raise PointsError(f"a row of text does not hold {n} numbers: {exc}") from exc
    if counts and counts[0] != len(table):
        raise PointsError(f"cut short: the first line declares {counts[0]:,} points, {len(table):,} rows follow")
    return Columns(len(table), dict(zip(names, table.T, strict=True)), names)


_EXPECTED = "expected x, y, z and remission in each row, or a first line of names"


def _numbers(line: str) -> list[float] | None:
    try:
        return [float(word) for word in line.split()]
    except ValueError:
        return None
