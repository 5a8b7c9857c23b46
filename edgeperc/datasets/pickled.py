"""Tables that pandas pickled, as PandaSet is published, read without pandas: nothing that a pickle names is called."""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import PointsError
from ..readers.inflate import inflate

_MOST_BYTES = 1 << 26  # of a table; PandaSet's have 10 MB, and a byte of a pickle may make an object
_NUMBERS = re.compile(r"[biuf][1248]")  # types of columns; others hold objects


class _Part:
    """Stands for whatever a pickle names and would make: it keeps what that is made of, and the state it is given."""

    def __new__(cls, *made_of: Any) -> _Part:
        part = super().__new__(cls)
        part.made_of, part.state = made_of, None
        return part

    made_of: tuple[Any, ...]
    state: Any

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Slice(_Part):
    pass


class _Buffer(_Part):
    pass


class _Parts(pickle._Unpickler):  # that in C takes gigabytes for a memo with a large number
    def find_class(self, _module: str, name: str) -> type[_Part]:
        return {"slice": _Slice, "_frombuffer": _Buffer}.get(name, _Part)


def read_pickled(path: Path) -> Mapping[str, NDArray[Any]]:
    """The columns of a pickled data frame in gzip. Raises PointsError."""
    try:
        content = inflate(path.read_bytes(), "gzip", _MOST_BYTES)
        return _columns(_Parts(io.BytesIO(content)).load())
    except PointsError as exc:
        raise PointsError(f"{path}: {exc}") from exc
    except Exception as exc:  # a pickle is a program: any of its steps may fail in its own way
        raise PointsError(f"{path} is damaged, or no data frame of PandaSet ({exc!r:.100}); download it again") from exc


def _columns(frame: Any) -> dict[str, NDArray[Any]]:
    manager = frame.state["_mgr" if "_mgr" in frame.state else "_data"]
    if manager.state is None:  # of pandas 1.3 and later
        blocks, axes = manager.made_of
        pairs = [block.made_of[:2] for block in blocks]
    else:
        axes, blocks = (manager.state[3]["0.14.1"][key] for key in ("axes", "blocks"))
        pairs = [(block["values"], block["mgr_locs"]) for block in blocks]
    names = _array(axes[0].made_of[1]["data"]).tolist()
    columns, every = dict[str, NDArray[Any]](), np.arange(len(names))
    for values, places in pairs:
        slots = every[slice(*places.made_of)] if isinstance(places, _Slice) else _array(places)
        columns |= {names[slot]: row for slot, row in zip(slots.tolist(), _array(values), strict=True)}
    return columns


def _array(part: Any) -> NDArray[Any]:
    """An array as numpy pickles it."""
    if isinstance(part, _Buffer):
        data, kind, shape, order = part.made_of
    else:
        _, shape, kind, is_fortran, data = part.state
        order = "F" if is_fortran else "C"
    name = kind.made_of[0]
    if _NUMBERS.fullmatch(name):
        big = kind.state is not None and kind.state[1] == ">"
        return np.frombuffer(data, (">" if big else "<") + name).reshape(shape, order=order)
    if name not in ("O", "O8") or not isinstance(data, list):
        raise PointsError(f"a column of the type {name!r:.40}; expected numbers and texts")
    objects = np.empty(len(data), object)
    objects[:] = data
    return objects.reshape(shape)
