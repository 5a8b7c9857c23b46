"""What several tests perceive: boxes, and scans that are simulated once a process and read-only."""

from __future__ import annotations

import functools
import io

from edgeperc.simulation import random_scene, simulate
from edgeperc.simulation.scene import SimulatedScan
from edgeperc.types.perception import Box
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


@functools.cache
def urban(seed: int, sensor: str | SensorProfile = "hdl-64e") -> SimulatedScan:
    """A street of a town."""
    scan = simulate(random_scene(seed, "urban"), sensor, seed=seed)
    scan.points.flags.writeable = False
    return scan


class Terminal(io.StringIO):
    """Text that a terminal would show."""

    def isatty(self) -> bool:
        return True
