"""Random yards: open ground with vehicles in all directions, and walls as large as their sides."""

from __future__ import annotations

import math

import numpy as np

from .raycast import ASPHALT, FACADE, MATTE, ROUGH, ROUNDING, SLOPE_X, SLOPE_Y, TERRAIN
from .scene import Scene
from .shapes import block
from .street import SIZES, Street, any_vehicle, strip_row

TRUCKS = 0.45  # share of the vehicles: of the traffic across simulated streets they are 5 %
REACH_M = 62.0
WALL_SIZE_M = ((1.5, 14.0), (0.15, 3.5), (1.2, 4.6))  # least and largest length, width, height


def yard(seed: int) -> tuple[Scene, tuple[float, float, float]]:
    """Make a yard, and a place of the sensor in it (x, y, yaw)."""
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 350377))
    terrain = np.zeros(TERRAIN)
    terrain[[ASPHALT, ROUGH, ROUNDING]] = rng.uniform(0.15, 0.4), rng.uniform(0.0, 0.04), 5.0
    terrain[[SLOPE_X, SLOPE_Y]] = rng.normal(0.0, 0.005, 2)
    street = Street(rng, [strip_row(0, 0, 0, 0, -200.0, 200.0)], terrain)
    street.take(0.0, 0.0, 5.0, 2.3, 0.0)
    n_vehicles, n_walls = int(rng.integers(8, 26)), int(rng.integers(8, 26))
    for is_vehicle in rng.permutation(np.arange(n_vehicles + n_walls) < n_vehicles).tolist():
        # Uniform in distance, not in area: what is near fills most of the view.
        away, around = float(rng.uniform(5.0, REACH_M)), float(rng.uniform(-math.pi, math.pi))
        x, y, yaw = away * math.cos(around), away * math.sin(around), _direction(rng, around)
        if is_vehicle:
            street.add_object(any_vehicle(rng, TRUCKS), x, y, yaw)
        else:
            _add_wall(street, x, y, yaw)
    for _ in range(int(rng.poisson(2.0))):
        away, around = float(rng.uniform(3.0, 35.0)), float(rng.uniform(-math.pi, math.pi))
        street.add_object("pedestrian", away * math.cos(around), away * math.sin(around), around)
    return street.scene(), (0.0, 0.0, float(rng.normal(0.0, 0.05)))


def _direction(rng: np.random.Generator, around: float) -> float:
    """A heading: half of them across the line of sight, where the flat side is all that is seen."""
    if rng.random() < 0.5:
        return around + math.pi * (0.5 + bool(rng.random() < 0.5)) + float(rng.normal(0.0, 0.15))
    return float(rng.uniform(-math.pi, math.pi))


def _add_wall(street: Street, x: float, y: float, yaw: float) -> None:
    """A piece of wall, a container or a shed; a third of them as large as a truck."""
    rng = street.rng
    if rng.random() < 1.0 / 3.0:
        mean, spread = SIZES["truck"]
        a, b, c = (float(m + s * rng.normal()) for m, s in zip(mean, spread, strict=True))
        b = b if rng.random() < 0.5 else 0.2
    else:
        a, b, c = (float(rng.uniform(*limits)) for limits in WALL_SIZE_M)
    if street.free(x, y, a, b, yaw):
        street.take(x, y, a, b, yaw)
        ground_m, _ = street.ground(x, y)
        paint = float(rng.uniform(0.05, 0.6))
        surface = FACADE if rng.random() < 0.4 else MATTE
        street.rows.append(block(surface, paint, (x, y, ground_m + c / 2 - 0.1), (a, b, c + 0.2), yaw=yaw))
