"""Random halls: garages, depots, workshops, in which walls, beams and pipes may be taken for vehicles."""

from __future__ import annotations

import itertools
import math

import numpy as np

from .raycast import ASPHALT, FACADE, MATTE, ROUGH, ROUNDING, TERRAIN
from .scene import Scene
from .shapes import Vector, block, rod
from .street import Street, any_vehicle, strip_row

CLEAR_M = 0.3  # between the sensor and the ceiling


def hall(seed: int) -> tuple[Scene, Vector, float]:
    """Make a hall of 6 to 70 m, a place of the sensor in it (x, y, yaw), and the height of its ceiling [m]."""
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 611953))
    terrain = np.zeros(TERRAIN)
    terrain[[ASPHALT, ROUGH, ROUNDING]] = rng.uniform(0.1, 0.4), rng.uniform(0.0, 0.03), 5.0
    street = Street(rng, [strip_row(0, 0, 0, 0, -200.0, 200.0)], terrain)
    is_small, is_high = rng.random() < 0.25, rng.random() < 0.45
    length, width = sorted(rng.uniform(5.5, 11.0, 2) if is_small else rng.uniform(14.0, 70.0, 2), reverse=True)
    height = float(rng.uniform(4.0, 9.0) if is_high and not is_small else rng.uniform(2.1, 3.6))
    place = (float(rng.uniform(-0.4, 0.4) * (length - 4.0)), float(rng.uniform(-0.35, 0.35) * (width - 2.5)))
    yaw = float(rng.choice([0.0, 0.5, 1.0, 1.5]) * math.pi + rng.normal(0.0, 0.15))
    street.take(*place, 5.0, 2.3, yaw)
    _add_shell(street, length, width, height)
    _add_ceiling(street, length, width, height)
    _add_vehicles(street, length, width, height)
    _add_things(street, length, width, height)
    return street.scene(), (*place, yaw), height


def _add_shell(street: Street, length: float, width: float, height: float) -> None:
    """Walls of bays between pilasters: closed, with a door in them, low, or open."""
    rng, paint = street.rng, float(street.rng.uniform(0.1, 0.6))
    bay, open_share = float(rng.uniform(3.0, 8.0)), float(rng.choice([0.0, 0.1, 0.4]))
    low = float(rng.uniform(0.9, 1.3)) if rng.random() < 0.15 else height
    for along, half, other in ((True, length / 2, width / 2), (False, width / 2, length / 2)):
        edges = np.linspace(-half, half, max(2, round(2 * half / bay) + 1)).tolist()
        for side in (-other, other):
            for start, end in itertools.pairwise(edges):
                middle, wide, kind = (start + end) / 2, end - start, rng.random()
                depth = 0.2 if kind < 0.8 else float(rng.uniform(0.2, 1.2))  # a recess or a niche
                top = low if kind < 1.0 - open_share else float(rng.choice([0.0, 0.15]))
                at, size = side + math.copysign(depth / 2, side), (wide, depth)
                if top > 0.0:
                    x, y, a, b = (middle, at, *size) if along else (at, middle, *reversed(size))
                    street.rows.append(block(MATTE, paint, (x, y, top / 2), (a, b, top)))
                if rng.random() < 0.7:  # a pilaster
                    x, y = (start, side) if along else (side, start)
                    edge = float(rng.uniform(0.2, 0.6))
                    street.rows.append(block(MATTE, paint, (x, y, height / 2), (edge, edge, height)))


def _add_ceiling(street: Street, length: float, width: float, height: float) -> None:
    """A ceiling with beams, ducts, pipes and lamps below, on columns."""
    rng = street.rng
    street.rows.append(block(MATTE, float(rng.uniform(0.2, 0.6)), (0, 0, height + 0.15), (length, width, 0.3)))
    deep, wide = float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.15, 0.5))
    step = float(rng.uniform(4.0, 9.0))
    for x in np.arange(-length / 2 + step / 2, length / 2, step).tolist() if rng.random() < 0.7 else ():
        street.rows.append(block(MATTE, 0.4, (x, 0, height - deep / 2), (wide, width, deep)))
        for y in np.arange(-width / 2 + step, width / 2 - 2.0, 2 * step).tolist():
            edge = float(rng.uniform(0.25, 0.7))
            if street.free(x, y, edge, edge, 0.0):
                street.take(x, y, edge, edge, 0.0)
                street.rows.append(block(MATTE, 0.4, (x, y, height / 2), (edge, edge, height)))
    for _ in range(int(rng.integers(0, 9))):
        z, along = height - float(rng.uniform(0.1, 0.9)), bool(rng.random() < 0.6)
        u = float(rng.uniform(-0.48, 0.48)) * (width if along else length)
        half = (length if along else width) / 2
        ends = ((-half, u, z), (half, u, z)) if along else ((u, -half, z), (u, half, z))
        if rng.random() < 0.6:
            street.rows.append(rod(0.5, *ends, float(rng.uniform(0.03, 0.3))))
        else:
            size = (2 * half, float(rng.uniform(0.2, 1.2))) if along else (float(rng.uniform(0.2, 1.2)), 2 * half)
            street.rows.append(block(MATTE, 0.6, (0.0 if along else u, u if along else 0.0, z), (*size, 0.3)))


def _add_vehicles(street: Street, length: float, width: float, height: float) -> None:
    """Rows of parked vehicles that fit below the ceiling, or none."""
    rng, fill = street.rng, float(street.rng.choice([0.0, 0.1, 0.3, 0.7]))
    trucks = float(rng.choice([0.0, 0.3, 0.8])) if height > 4.2 else 0.0
    across = bool(rng.random() < 0.6)
    for y in np.arange(-width / 2 + 2.8, width / 2 - 2.0, 2.7 if not across else 6.0).tolist():
        for x in np.arange(-length / 2 + 3.0, length / 2 - 2.5, 2.8 if across else 6.0).tolist():
            label = "truck" if rng.random() < trucks else any_vehicle(rng, 0.0)
            if rng.random() < fill and (label == "car" or height > 2.9):
                yaw = (math.pi / 2 if across else 0.0) + math.pi * bool(rng.random() < 0.5)
                street.add_object(label, x, y, yaw + float(rng.normal(0.0, 0.04)))
    for _ in range(int(rng.poisson(0.8))):
        x, y = float(rng.uniform(-0.45, 0.45) * length), float(rng.uniform(-0.45, 0.45) * width)
        street.add_object("pedestrian", x, y, float(rng.uniform(-math.pi, math.pi)))


def _add_things(street: Street, length: float, width: float, height: float) -> None:
    """Shelves, benches, stacks, bins and ramps, most of them along the walls."""
    rng = street.rng
    for _ in range(int(rng.poisson(0.12 * (length + width)))):
        a, b, c = float(rng.uniform(0.4, 4.0)), float(rng.uniform(0.3, 1.1)), float(rng.uniform(0.4, 2.4))
        x, y, yaw = float(rng.uniform(-0.47, 0.47) * length), float(rng.uniform(-0.47, 0.47) * width), 0.0
        if rng.random() < 0.8:
            side = float(rng.choice([-1.0, 1.0]))
            if rng.random() < 0.5:
                y = side * (width / 2 - b / 2 - 0.15)
            else:
                x, yaw = side * (length / 2 - b / 2 - 0.15), math.pi / 2
        if c < height - 0.2 and street.free(x, y, a, b, yaw, 0.1):
            street.take(x, y, a, b, yaw)
            shelf = FACADE if rng.random() < 0.3 else MATTE
            street.rows.append(block(shelf, float(rng.uniform(0.05, 0.7)), (x, y, c / 2), (a, b, c), yaw=yaw))
