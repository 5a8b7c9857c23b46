"""Entries of JSON documents, each of its type and within its bounds, and one way to say what is wrong with one."""

from __future__ import annotations

import functools
import json
import math
import os
import reprlib
from collections.abc import Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from numbers import Integral
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NoReturn, TypeVar, Union, get_args, get_origin, get_type_hints

from ..errors import OptionError, PointsError

T = TypeVar("T")
MAX_NUMBER = 1e300
_NAMES = {str: "text", float: "number", int: "whole number", bool: "truth value"}


@dataclass(frozen=True)
class Fields:
    """How documents of one kind are read: as dataclasses, whose annotations are the types of the entries."""

    what: str  # the document, for messages
    error: type[Exception]  # type of the errors
    advice: str = "write it again"  # what to do with a document that cannot be read as a whole
    # entries that may be missing, if the dataclass has a default; ``"*"`` stands for all that have one
    optional: Collection[str] = ()
    exact: bool = False  # unknown entries are errors; otherwise they are ignored

    def document(self, text: str, schema: int) -> dict[str, Any]:
        """Parse an object whose entry ``schema`` is the one that this version reads."""
        try:
            document = json.loads(text)
        except (RecursionError, TypeError, ValueError) as exc:
            raise self.error(f"{self.what} is not JSON ({exc}); {self.advice}") from exc
        given = document.get("schema") if isinstance(document, dict) else None
        if type(given) is not int or given != schema:
            todo = "upgrade edgeperc" if type(given) is int and given > schema else self.advice
            raise self.error(
                f"{self.what} has schema {reprlib.repr(given)}; expected {schema}, which this edgeperc reads; {todo}"
            )
        return {key: value for key, value in document.items() if key != "schema"}

    def refuse(self, name: str, value: object, expected: str) -> NoReturn:
        """Raise the error of a wrong entry."""
        raise self.error(f"{name} is {reprlib.repr(value)}; expected {expected}")

    def each(self, name: str, values: Any, kind: type[T]) -> tuple[T, ...]:
        """Objects of a type."""
        given = tuple(self.iterator(name, values, f"{kind.__name__} objects"))
        for index, value in enumerate(given):
            if not isinstance(value, kind):
                self.refuse(f"{name}[{index}]", value, f"a {kind.__name__}")
        return given

    def iterator(self, name: str, values: Any, expected: str) -> Iterator[Any]:
        """What can be taken one after another."""
        try:
            return iter(values)
        except TypeError:
            self.refuse(name, values, expected)

    def path(self, name: str, value: Any) -> Path:
        """A path that a file may have."""
        if not isinstance(value, str | os.PathLike):
            self.refuse(name, value, "a path")
        return Path(value) if "\0" not in str(value) else self.refuse(name, value, "a path without a null character")

    def number(self, name: str, value: Any, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> float:
        """A finite number from ``low`` to ``high``."""
        try:
            number = math.nan if isinstance(value, str | bytes | bool) else float(value)
        except (TypeError, ValueError, OverflowError):
            number = math.nan
        if not low <= number <= high:
            limits = "" if low == -MAX_NUMBER else f" from {low:g}" + (f" to {high:g}" if high < MAX_NUMBER else "")
            self.refuse(name, value, f"a number{limits}")
        return number

    def whole(self, name: str, value: Any, low: int, high: int) -> int:
        """A whole number from ``low`` to ``high``."""
        if isinstance(value, bool) or not isinstance(value, Integral) or not low <= int(value) <= high:
            self.refuse(name, value, f"a whole number from {low} to {high}")
        return int(value)

    def numbers(
        self, name: str, values: Any, n: int | None = None, low: float = -MAX_NUMBER, high: float = MAX_NUMBER
    ) -> tuple[float, ...]:
        """``n`` numbers, or any number of them."""
        try:
            given = () if isinstance(values, str | bytes | Mapping) else tuple(values)
        except TypeError:
            given = ()
        if len(given) != n and (n or not given):
            self.refuse(name, values, f"a list of {n} numbers" if n else "a list of numbers")
        return tuple(self.number(f"{name}[{index}]", value, low, high) for index, value in enumerate(given))

    def pair(self, name: str, values: Any, low: float = -MAX_NUMBER, high: float = MAX_NUMBER) -> tuple[float, float]:
        """Two numbers."""
        first, second = self.numbers(name, values, 2, low, high)
        return first, second

    def read(self, kind: type[T], value: object, name: str = "") -> T:
        """A value as a dataclass, or as a type that `entry` reads; ``name`` is empty for the whole document."""
        read: T = self.entry(kind, value, name)
        return read

    def entry(self, kind: Any, value: Any, name: str) -> Any:
        """A value as str, float, int, bool, a Literal, a tuple, a Mapping, a dataclass, or one of these or None."""
        origin, parts = get_origin(kind), get_args(kind)
        if origin in (Union, UnionType):
            if is_dataclass(value) or (value is None and NoneType in parts):
                return value
            return self.entry(parts[0], value, name)
        if origin is Literal and value not in parts:
            self.refuse(name, value, " or ".join(map(str, parts)))
        if kind is float:
            return self.number(name, value)
        if kind in (str, int, bool) and (not isinstance(value, kind) or isinstance(value, bool) != (kind is bool)):
            self.refuse(name, value, "true or false" if kind is bool else f"a {_NAMES[kind]}")
        if origin is tuple:
            return self._tuple(parts, value, name)
        if isinstance(origin, type) and issubclass(origin, Mapping):
            if not isinstance(value, Mapping):
                self.refuse(name, value, "an object")
            return {key: self.entry(parts[1], v, f"{name}[{reprlib.repr(key)}]") for key, v in value.items()}
        return self._record(kind, value, name) if is_dataclass(kind) else value

    def _tuple(self, parts: tuple[Any, ...], value: Any, name: str) -> tuple[Any, ...]:
        many = parts[-1] is Ellipsis
        if not isinstance(value, list | tuple) or not (many or len(value) == len(parts)):
            nouns = f"{_NAMES.get(parts[0], 'entrie')}s"
            self.refuse(name, value, f"a list of {nouns}" if many else f"a list of {len(parts)} {nouns}")
        kinds = (parts[0],) * len(value) if many else parts
        return tuple(
            self.entry(kind, v, f"{name}[{index}]") for index, (kind, v) in enumerate(zip(kinds, value, strict=True))
        )

    def _record(self, kind: Any, value: Any, name: str) -> Any:
        if isinstance(value, kind):
            return value
        kinds, defaults = _entries(kind)
        if not isinstance(value, Mapping):
            self.refuse(name or self.what, value, f"an object with {', '.join(sorted(kinds))}")
        optional = defaults if "*" in self.optional else defaults.intersection(self.optional)
        if missing := kinds.keys() - value.keys() - optional:
            raise self.error(f"{name or self.what} lacks {', '.join(sorted(missing))}; {self.advice}")
        if self.exact and (unknown := sorted(map(str, value.keys() - kinds.keys()))):
            raise self.error(
                f"{name or self.what} has unknown entries {', '.join(unknown)[:200]}; expected "
                f"{'some of ' if optional else ''}{', '.join(sorted(kinds))}"
            )
        prefix = f"{name}." if name else ""
        return kind(**{key: self.entry(kinds[key], value[key], prefix + key) for key in kinds if key in value})


OPTIONS = Fields("the options", OptionError)  # of what callers pass
SCANS = Fields("the scans", PointsError)


@functools.cache
def _entries(kind: Any) -> tuple[dict[str, Any], frozenset[str]]:
    """Types of the entries of a dataclass, and the names of those with a default."""
    given = [field for field in fields(kind) if field.init]
    hints = get_type_hints(kind)
    defaults = (f.name for f in given if f.default is not MISSING or f.default_factory is not MISSING)
    return {field.name: hints[field.name] for field in given}, frozenset(defaults)
