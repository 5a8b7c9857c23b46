"""Tables of text: a row for each point, with or without a line of names."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from ..errors import PointsError
from ..types.points import Bytes, Floats, plain_name, remission_name
from .raw import TEXT_BYTES
from .tables import Columns
from .times import time_name

_UNNAMED = {3: ("x", "y", "z"), 4: ("x", "y", "z", "remission")}
# Of .pts, whose first line is the number of points.
_UNNAMED_PTS = {
    **_UNNAMED,
    6: ("x", "y", "z", "red", "green", "blue"),
    7: ("x", "y", "z", "intensity", "red", "green", "blue"),
}
_ASCII_SHARE = 0.9  # of the first bytes of a text; names and units may have other letters
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")  # as in "x [m]"
_METERS = ("m", "meter", "meters", "metre", "metres")
_PARAVIEW = re.compile(r"points(?:_m_xyz)?[:_]([012])$")  # "Points_m_XYZ:0" of VeloView, "Points:0"
_COMMA_NUMBER = re.compile(r"[+-]?\d+(,\d+)?(e[+-]?\d+)?", re.IGNORECASE)
_LOOKED_AT = 1000  # rows that show whether a column holds numbers
_NO_NUMBER = ("", "nan", "null", "none", "na", "n/a", "-")


def begins_like_text(head: bytes) -> bool:
    """Whether the first bytes are those of a text."""
    sample = np.frombuffer(head[:4096].removeprefix(b"\xef\xbb\xbf"), np.uint8)
    is_text = TEXT_BYTES[sample]
    return bool(len(sample) and (is_text | (sample >= 128)).all() and is_text.mean() > _ASCII_SHARE)


class _Style(NamedTuple):
    """How the rows of a table are written."""

    separator: str | None  # of the values; None: blanks
    decimal_comma: bool

    def values(self, row: str) -> list[str]:
        """The values of a row, or its names."""
        return [word.strip() for word in row.split(self.separator)]


def parse_text(data: Bytes, columns: Sequence[str] | int | None) -> tuple[Columns, bool]:
    """The columns of a table, and whether it names them: separated by blanks, commas or semicolons, below comments
    (``#``, ``//``).

    A first line of one whole number is the number of points, as in ``.pts``. Names are those of a line of words, with
    or without units; columns of words, such as classes, are left out. What is empty, or null, is NaN.

    columns : names of the columns, where no line has one for each.
    """
    lines = data.tobytes().decode("utf-8-sig", "replace").replace('"', "").splitlines()
    given = [] if columns is None or isinstance(columns, int | np.integer) else [plain_name(str(n)) for n in columns]
    header, counts, rows = _head([line for line in lines if line.strip()], bool(given))
    if not rows:
        raise PointsError(f"the text has no row of three numbers; {_EXPECTED}")
    if len(counts) == 2:
        raise PointsError("this is a PTX file by its first lines; convert it with CloudCompare, to .pts, .pcd or .ply")
    style = _style_of(rows)
    words = style.values(rows[0])
    n = len(words) - (words[-1] == "")  # a separator behind the last
    own: Sequence[str] = _names(header, style, len(words))
    is_named = bool(own) and len(own) in (n, len(words))
    names = own if is_named else given or own or (_UNNAMED_PTS if counts else _UNNAMED).get(n, ())
    n = len(words) if (header or given) and len(names) == len(words) else n
    if len(names) != n:
        got = f"{len(names)} names" if names else "no names"
        raise PointsError(f"a row has {n} numbers, and there are {got}: pass columns= (--columns) with their names")
    used = [k for k in range(n) if names[k] and names[k] not in names[:k] and _is_number(words[k], style)]
    _check_first(rows, names, used, style)
    table = _table(rows, style, used, len(words)) if used else np.empty((len(rows), 0))
    if counts and counts[0] != len(table):
        raise PointsError(f"cut short: the first line declares {counts[0]:,} points, {len(table):,} rows follow")
    return Columns(len(table), dict(zip((names[k] for k in used), table.T, strict=True)), names), is_named


def _check_first(rows: Sequence[str], names: Sequence[str], used: Sequence[int], style: _Style) -> None:
    """Refuse a first row with a word in a column of remissions or times, which would be left out with its numbers."""
    for k in {names.index(name) for name in (remission_name(names, None), time_name(names)) if name} - {*used}:
        below = [word for row in rows[1:_LOOKED_AT] for word in style.values(row)[k : k + 1]]
        if any(_is_number(word, style) and word.lower() not in _NO_NUMBER for word in below):
            raise PointsError(
                f"the first row has {style.values(rows[0])[k]!r:.60} in the column {names[k]}, and others have numbers "
                "there; write what is not known as nan"
            )


_EXPECTED = "expected x, y, z and remission in each row, or a first line of names"


def _head(lines: Sequence[str], is_named: bool) -> tuple[str, list[int], list[str]]:
    """The line of names, whole numbers that stand alone, and the rows below; ``is_named``: the names are given."""
    header, counts = "", list[int]()
    for k, line in enumerate(lines):
        style = _style(line)
        words = style.values(line.strip())
        n_numbers = sum(_is_number(word, style) for word in words)
        if len(words) == 1 and words[0].isdecimal() and len(words[0]) < 19:
            counts.append(int(words[0]))
        elif not header and {"x", "y", "z"} <= {*_names(line, style, 0)}:
            header = line
        elif not line.lstrip().startswith(_COMMENTS):
            if not header and (n_numbers < 3 or not (is_named or n_numbers == len(words))):
                raise PointsError(f"the text is no table of points: it has a line {line.strip()[:60]!r}; {_EXPECTED}")
            return header, counts, [row for row in lines[k:] if not row.lstrip().startswith(_COMMENTS)]
    return header, counts, []


_COMMENTS = ("#", "//")


def _style(row: str) -> _Style:
    """How a row is written: 1.5 2.5, 1.5,2.5 and 1.5;2.5, or with a comma in place of the point 1,5 2,5 and 1,5;2,5."""
    if ";" in row:
        return _Style(";", "," in row)
    words = row.split()
    has_commas = "," in row
    if not has_commas or (len(words) > 1 and all(map(_COMMA_NUMBER.fullmatch, words))):
        return _Style(None, has_commas)
    return _Style(",", False)


def _style_of(rows: Sequence[str]) -> _Style:
    """That of the first row with a comma, if it is separated as the first row is: 0;0;0 may stand above 1,5;2,5;3,5."""
    first = _style(rows[0])
    if "," in rows[0] or first.separator == ",":
        return first
    style = _style(next((row for row in rows if "," in row), rows[0]))
    return style if style.separator == first.separator else first


def _names(header: str, style: _Style, n: int) -> tuple[str, ...]:
    """The names of the columns in a line, separated as the rows are or otherwise, so that there are ``n``; 0: any."""
    line = header.strip().lstrip("#/").lstrip(" ") if header else ""
    if not line:
        return ()
    ways = [style.values(line), [word.strip() for word in line.split("\t")], re.split(r"[\s,;]+", line.strip(" ,;"))]
    words = next((each for each in ways if n in (0, len(each), len(each) + 1)), ways[0])
    if words is ways[0] and len(words) - 1 == n and not words[-1]:
        words = words[:-1]
    return tuple(_name(word) for word in words)


def _name(word: str) -> str:
    name = plain_name(word)
    unit = _UNIT.search(name)
    if unit is not None:
        if name[: unit.start()] in ("x", "y", "z") and unit[1] not in _METERS:
            raise PointsError(f"the coordinates are in {unit[1]!r} by the name {word!r}; expected meters: convert them")
        name = name[: unit.start()]
    axis = _PARAVIEW.match(name)
    return name if axis is None else "xyz"[int(axis[1])]


def _is_number(word: str, style: _Style) -> bool:
    """Whether a word is a number, or stands for none."""
    if word.lower() in _NO_NUMBER:
        return True
    try:
        float(word.replace(",", ".") if style.decimal_comma else word)
    except ValueError:
        return False
    return True


def _table(rows: Sequence[str], style: _Style, used: Sequence[int], n: int) -> Floats:
    """The numbers in some of ``n`` columns."""
    mark = style.separator
    for k, row in enumerate(rows):
        n_words = row.count(mark) + 1 if mark else len(row.split())
        if n_words != n:
            raise PointsError(
                f"a row of text does not hold {n} numbers: row {k + 1} of {len(rows)} has {n_words}, {row[:60]!r}"
                f"{'; the file may be cut short' if k == len(rows) - 1 else ''}"
            )
    text = "\n".join(rows)
    if style.decimal_comma:
        text = text.replace(",", ".")
    try:
        return _loaded(text, used, mark)
    except (ValueError, OverflowError) as exc:
        error = PointsError(f"a row of text does not hold {n} numbers: {exc}")
    if mark is not None:
        inside = rf"[^{mark}\n]"
        gap = rf"(?<!{inside})[ \t]*(?:{'|'.join(map(re.escape, _NO_NUMBER))})[ \t]*(?!{inside})"
        with suppress(ValueError, OverflowError):
            return _loaded(re.sub(gap, "nan", text, flags=re.IGNORECASE), used, mark)
    raise error


def _loaded(text: str, used: Sequence[int], mark: str | None) -> Floats:
    return np.loadtxt(io.StringIO(text), np.float64, comments=None, ndmin=2, usecols=used, delimiter=mark)
