"""Entries of JSON documents: read as the types of a dataclass, or refused with what came and what was expected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from edgeperc.system.fields import Fields

READ = Fields("the note", ValueError, "write it again", optional=("color",))


@dataclass(frozen=True)
class Inner:
    low: float
    high: float | None


@dataclass(frozen=True)
class Note:
    name: str
    count: int
    is_done: bool
    values: tuple[float, ...]
    size: tuple[float, float]
    parts: tuple[Inner, ...]
    sizes: Mapping[str, tuple[float, float]]
    more: Mapping[str, Any] | None
    kind: Literal["a", "b"] = "a"
    color: str = "red"
    derived: float = field(default=0.0, init=False)


NOTE = {
    "name": "n",
    "count": 3,
    "is_done": True,
    "values": [1, 2.5],
    "size": [1, 2],
    "parts": [{"low": 1, "high": None}, {"low": 2, "high": 3}],
    "sizes": {"x": [1, 2]},
    "more": None,
    "kind": "b",
}


def test_a_document_is_read_as_the_types_of_its_dataclass() -> None:
    note = READ.read(Note, NOTE)
    assert note == Note(
        "n", 3, True, (1.0, 2.5), (1.0, 2.0), (Inner(1.0, None), Inner(2.0, 3.0)), {"x": (1.0, 2.0)}, None, "b"
    )
    assert all(type(value) is float for value in (*note.values, *note.size, note.parts[0].low))
    assert READ.read(Note, NOTE | {"extra": 1, "color": "blue"}).color == "blue"
    assert READ.read(Note, note) is note


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": 3}, "name is 3; expected a text"),
        ({"count": True}, "count is True; expected a whole number"),
        ({"count": 1.0}, "count is 1.0; expected a whole number"),
        ({"is_done": 1}, "is_done is 1; expected true or false"),
        ({"values": 1}, "values is 1; expected a list of numbers"),
        ({"values": "12"}, "values is '12'; expected a list of numbers"),
        ({"values": [1, "2"]}, r"values\[1\] is '2'; expected a number"),
        ({"values": [math.nan]}, r"values\[0\] is nan; expected a number"),
        ({"values": [10**400]}, r"values\[0\] is 1000.*; expected a number"),
        ({"size": [1]}, r"size is \[1\]; expected a list of 2 numbers"),
        ({"parts": [3]}, r"parts\[0\] is 3; expected an object with high, low"),
        ({"parts": [{"low": 1}]}, r"parts\[0\] lacks high; write it again"),
        ({"parts": [{"low": 1, "high": "x"}]}, r"parts\[0\]\.high is 'x'; expected a number"),
        ({"sizes": [1]}, r"sizes is \[1\]; expected an object"),
        ({"sizes": {"x": [None, 1]}}, r"sizes\['x'\]\[0\] is None; expected a number"),
        ({"more": 3}, "more is 3; expected an object"),
        ({"kind": "c"}, "kind is 'c'; expected a or b"),
        ({"kind": []}, r"kind is \[\]; expected a or b"),
    ],
)
def test_a_wrong_entry_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        READ.read(Note, NOTE | change)


def test_entries_that_are_missing_or_unknown() -> None:
    for name in NOTE:
        with pytest.raises(ValueError, match=f"the note lacks {name}; write it again"):
            READ.read(Note, {key: value for key, value in NOTE.items() if key != name})
    with pytest.raises(ValueError, match="the note is 3; expected an object with color, count"):
        READ.read(Note, 3)
    exact = Fields("the note", ValueError, optional=("*",), exact=True)
    assert exact.read(Note, {key: value for key, value in NOTE.items() if key != "kind"}).kind == "a"
    with pytest.raises(ValueError, match="the note has unknown entries derived, x; expected some of color"):
        exact.read(Note, NOTE | {"x": 1, "derived": 1.0})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "the note is not JSON"),
        ("[" * 100_000, "the note is not JSON"),
        ("3", "the note has schema None; expected 2"),
        ('{"schema": true}', "the note has schema True; expected 2"),
        ('{"schema": 1}', "schema 1; expected 2.*write it again"),
        ('{"schema": 3}', "schema 3; expected 2.*upgrade edgeperc"),
    ],
)
def test_documents_of_another_schema(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        READ.document(text, 2)
    assert READ.document('{"schema": 2, "a": 1}', 2) == {"a": 1}


@pytest.mark.parametrize("value", [None, True, "1", b"1", [1], math.nan, math.inf, 10**400, 2.5])
def test_numbers_out_of_their_bounds(value: object) -> None:
    with pytest.raises(ValueError, match=r"v is .*; expected a number from 0 to 2$"):
        READ.number("v", value, 0, 2)
    with pytest.raises(ValueError, match=r"v is .*; expected a whole number from 0 to 2$"):
        READ.whole("v", value, 0, 2)
    assert READ.number("v", 2, 0, 2) == 2.0


@pytest.mark.parametrize("values", [None, 3, "12", {"a": 1}, [1], [1, 2, 3]])
def test_lists_of_another_length(values: object) -> None:
    with pytest.raises(ValueError, match=r"v is .*; expected a list of 2 numbers"):
        READ.pair("v", values)
    with pytest.raises(ValueError, match="expected a list of numbers"):
        READ.numbers("v", [])
