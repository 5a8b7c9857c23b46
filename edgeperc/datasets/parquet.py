"""Rows of Parquet files."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import PointsError
from ..system.extras import require

_Row = tuple[Any, ...]


def read_rows(path: Path, *columns: str) -> list[_Row]:
    """The rows of a table. Raises PointsError."""
    with _reading(path, columns) as file:
        return _rows(file.read(columns=[*columns]), columns)


class LargeRows:
    """The rows of a table by their keys, of which one at a time is unpacked: together they have gigabytes. Those that
    are asked for in the order of the file are unpacked once.

    groups : of rows, by key
    """

    def __init__(self, path: Path, keys: tuple[str, ...], columns: tuple[str, ...]) -> None:
        self._path, self._keys, self._columns = path, keys, columns
        self._group = -1
        self._rest: Iterator[Any] = iter(())
        self.groups: dict[_Row, int] = {}
        with _reading(path, keys) as self._file:
            for group in range(self._file.num_row_groups):
                rows = _rows(self._file.read_row_group(group, columns=[*keys]), keys)
                self.groups |= dict.fromkeys(rows, group)

    def read(self, key: _Row) -> list[Any]:
        """The values of a row, as arrays of pyarrow of one value each. Raises PointsError."""
        if key not in self.groups:
            raise PointsError(f"{self._path} has no row {key} of {', '.join(self._keys)}; download it again")
        with _reading(self._path, (*self._keys, *self._columns)):
            row: Any = self._next(key) if self.groups[key] == self._group else None
            if row is None:
                self._group, columns = self.groups[key], [*self._keys, *self._columns]
                self._rest = self._file.iter_batches(1, row_groups=[self._group], columns=columns)
                row = self._next(key)
            row.validate(full=True)
            return [row.column(name) for name in self._columns]

    def _next(self, key: _Row) -> Any:
        return next((row for row in self._rest if _rows(row, self._keys) == [key]), None)


def _rows(table: Any, columns: tuple[str, ...]) -> list[_Row]:
    table.validate(full=True)
    return [*zip(*(table.column(name).to_pylist() for name in columns), strict=True)]


@contextmanager
def _reading(path: Path, columns: Iterable[str]) -> Iterator[Any]:
    """The open file."""
    with arrow_module("parquet", path, columns) as parquet:
        yield parquet.ParquetFile(path)


@contextmanager
def arrow_module(name: str, path: Path, columns: Iterable[str]) -> Iterator[Any]:
    """The module of pyarrow for the format of a file; what is wrong with it is a `PointsError`."""
    what = f"{path}: a {name.capitalize()} file"
    arrow = require("pyarrow", "argoverse", what)
    module = require(f"pyarrow.{name}", "argoverse", what, package="pyarrow")
    try:
        yield module
    except (OSError, arrow.ArrowException, KeyError, ValueError) as exc:
        raise PointsError(f"{path} cannot be read ({exc!s:.200}); expected columns {', '.join(columns)}") from exc
