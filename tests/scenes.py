"""What several tests perceive: boxes, and scans that are simulated once a process and read-only."""

from __future__ import annotations

import functools
import hashlib
import io
from collections import OrderedDict
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeperc.readers.origin import find_place
from edgeperc.simulation import random_scene, simulate
from edgeperc.simulation.scene import Scene, SimulatedScan
from edgeperc.types.perception import Box, Perception
from edgeperc.types.sensor import SensorProfile


def box(
    x: float,
    y: float = 0.0,
    label: str = "car",
    score: float = 1.0,
    *,
    yaw: float = 0.0,
    size: tuple[float, float, float] = (4.0, 1.8, 1.5),
    z: float = -0.9,
) -> Box:
    return Box(label, score, (float(x), float(y), z), size, float(yaw))


def rotation_of(x: float, y: float, z: float, w: float) -> NDArray[np.float64]:
    """Matrix of a unit quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@functools.cache
def urban(seed: int, sensor: str | SensorProfile = "hdl-64e") -> SimulatedScan:
    """A street of a town."""
    scan = simulate(random_scene(seed, "urban"), sensor, seed=seed)
    scan.points.flags.writeable = False
    return scan


def assert_same(one: Perception, other: Perception) -> None:
    """Of two answers to one scan: labels, cells and boxes are the same to the bit."""
    assert one.n_points == other.n_points
    assert one.boxes == other.boxes
    for part, arrays in (("points", ("labels", "in_view")), ("top_view", ("labels", "observed"))):
        found, expected = getattr(one, part), getattr(other, part)
        assert (found is None) == (expected is None)
        for array in arrays if found is not None else ():
            np.testing.assert_array_equal(getattr(found, array), getattr(expected, array))


class Once:
    """In place of what takes time in `edgeperc.simulation.samples`: the last scenes and scans are kept. And where the
    sensors of scans in a map were.
    """

    MOST = 40

    def __init__(self) -> None:
        self.scene = functools.lru_cache(self.MOST)(random_scene)
        self._scans: OrderedDict[Any, tuple[Scene, SimulatedScan]] = OrderedDict()
        self._places: dict[bytes, tuple[float, float, float]] = {}

    def scan(self, scene: Scene, *arguments: Any, **options: Any) -> SimulatedScan:
        """Each caller has arrays of its own."""
        values = (*arguments, *options.items())
        key = id(scene), repr([(each.tobytes() if isinstance(each, np.ndarray) else each) for each in values])
        if key not in self._scans:
            self._scans[key] = scene, simulate(scene, *arguments, **options)
            while len(self._scans) > self.MOST:
                self._scans.popitem(last=False)
        self._scans.move_to_end(key)
        scan = self._scans[key][1]
        arrays = {field.name: getattr(scan, field.name) for field in fields(scan)}
        return replace(scan, **{name: a.copy() for name, a in arrays.items() if isinstance(a, np.ndarray)})

    def place(self, xyz: NDArray[np.float64]) -> tuple[float, float, float]:
        """Of the sensor, in the map; an error is raised anew."""
        key = hashlib.sha256(xyz.tobytes()).digest()
        if key not in self._places:
            self._places[key] = find_place(xyz)
        return self._places[key]


class Terminal(io.StringIO):
    """Text that a terminal would show."""

    def isatty(self) -> bool:
        return True
