"""Vehicles: cars, vans, trucks, buses, trams, trailers and parked motorcycles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .raycast import GLASS, MATTE, PAINT, POROUS, RETRO
from .shapes import Row, Vector, block, rod


def _wheels(width: float, xs: Sequence[float], radius: float) -> list[Row]:
    side = width / 2.0 - 0.14
    return [rod(0.03, (x, y - 0.11, radius), (x, y + 0.11, radius), radius) for x in xs for y in (-side, side)]


def _lights(length: float, width: float, z: float, rng: np.random.Generator) -> list[Row]:
    rows = []
    for end in (-1.0, 1.0):
        x = end * (length / 2.0 - 0.02)
        rows.append(block(RETRO, 0.97, (x, 0.0, z - 0.12), (0.04, 0.5, 0.11)))
        if end < 0.0 or rng.random() < 0.4:  # tail lights are reflectors, headlights seldom
            edge = 0.75 if end < 0.0 else 0.45
            rows += [
                block(RETRO, edge, (x - end * 0.03, s * (width / 2.0 - 0.2), z + 0.08), (0.08, 0.2, 0.16))
                for s in (-1.0, 1.0)
            ]
    return rows


def _paint(rng: np.random.Generator, light_share: float) -> tuple[float, float]:
    """Draw remission and drop-out of car paint."""
    # Measured: mean remission of cars 0.01, 0.06, 0.11, 0.18, 0.27 (5, 25, 50, 75, 95 %), of vans 0.24 in the middle.
    if rng.random() < light_share:
        return rng.uniform(0.35, 0.6), rng.uniform(0.0, 0.2)
    return rng.uniform(0.0, 0.22), rng.uniform(0.1, 0.75)


def car(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a car."""
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.3)
    clearance = 0.16 + 0.06 * rng.random()
    belt = height * rng.uniform(0.57, 0.64)
    hood = belt * rng.uniform(0.84, 0.95)
    style = rng.integers(0, 4)  # saloon, hatchback, estate, van-like
    nose = length * (rng.uniform(0.18, 0.25) if style < 3 else rng.uniform(0.28, 0.36))  # where the windscreen starts
    tail = length * (-0.36 if style == 0 else -0.485)
    sides = rng.uniform(0.14, 0.24)
    screen = rng.uniform(0.45, 0.75) if style < 3 else 0.55
    back = rng.uniform(0.35, 0.6) if style == 0 else rng.uniform(0.08, 0.3)
    half = (nose - tail) / 2.0
    middle = (nose + tail) / 2.0
    roof = height - 0.07
    rise = roof - belt
    # The roof lies on the glass; the pillars are inside its edges.
    front, rear = half * (1 - screen * rise / half * 1.6), half * (1 - back * rise / half * 1.6)
    rows = [
        block(PAINT, paint, (0, 0, (clearance + hood) / 2), (length, width, hood - clearance), density=lost,
               taper=(0.05, 0.04, 0.05)),
        block(PAINT, paint, ((nose - length / 2) / 2 - 0.02, 0, (hood + belt) / 2),
               (nose + length / 2 - 0.08, width * 0.97, belt - hood), density=lost, taper=(0.1, 0.02, 0.02)),
        block(GLASS, 0.03, (middle, 0, (belt + roof) / 2), (2 * half, width * 0.93, rise),
               density=rng.uniform(0.5, 0.97), taper=(screen * rise / half * 1.6, back * rise / half * 1.6, sides)),
        block(PAINT, paint, (middle + (front - rear) / 2, 0, (roof + height) / 2),
               (front + rear, width * 0.93 * (1 - sides), height - roof), density=lost, taper=(0.15, 0.1, 0.15)),
    ]  # fmt: skip
    for x_low, x_high in (
        (middle + half, middle + front),
        (middle - half, middle - rear),
        (middle - 0.05, middle + 0.02),
    ):
        for s in (-1.0, 1.0):
            low = (x_low, s * (width * 0.465 - 0.02), belt)
            high = (x_high, s * (width * 0.465 * (1 - sides) - 0.02), roof)
            rows.append(rod(paint * 0.7, low, high, 0.045))
    radius = min(0.36, max(0.27, 0.075 * length))
    rows += _wheels(width, (-0.3 * length, 0.32 * length), radius)
    return rows + _lights(length, width, 0.62 * belt + 0.1, rng)


def van(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a van or a minibus."""
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.65)
    clearance, belt = 0.22, height * rng.uniform(0.5, 0.58)
    nose = length * (0.5 - rng.uniform(0.1, 0.2))
    screen = length * rng.uniform(0.1, 0.16)
    rows = [
        block(PAINT, paint, (0, 0, (clearance + belt * 0.9) / 2), (length, width, belt * 0.9 - clearance),
               density=lost, taper=(0.05, 0.0, 0.02)),
        block(PAINT, paint, ((nose - length / 2) / 2 + 0.06, 0, belt * 0.95), (nose + length / 2 + 0.12, width * 0.98,
               belt * 0.1), density=lost, taper=(0.05, 0.0, 0.0)),
    ]  # fmt: skip
    glazed = rng.random() < 0.45  # a minibus rather than a panel van
    back = -length / 2 + 0.02
    door = nose - screen - (0.9 if not glazed else 0.0)
    if not glazed:
        rows.append(
            block(PAINT, paint, ((back + door) / 2, 0, (belt + height) / 2), (door - back, width * 0.97,
                   height - belt), density=lost, taper=(0.0, 0.01, 0.06))
        )  # fmt: skip
    left = door if not glazed else back
    span = nose - left
    rows.append(
        block(GLASS, 0.03, ((nose + left) / 2, 0, (belt + height - 0.12) / 2),
               (span, width * 0.95, height - 0.12 - belt), density=rng.uniform(0.5, 0.97),
               taper=(2 * screen / span, 0.02, 0.08))
    )  # fmt: skip
    rows.append(
        block(PAINT, paint, ((nose - screen + back) / 2, 0, height - 0.06), (nose - screen - back, width * 0.9, 0.12),
               density=lost, taper=(0.05, 0.02, 0.05))
    )  # fmt: skip
    for x in (back + 0.05, *((back + nose) * np.array([0.35, 0.65]) if glazed else ())):
        rows += [
            rod(paint * 0.7, (x, s * (width * 0.475 - 0.02), belt), (x, s * (width * 0.44 - 0.02), height - 0.1), 0.05)
            for s in (-1.0, 1.0)
        ]
    return rows + _wheels(width, (-0.3 * length, 0.34 * length), 0.34) + _lights(length, width, 0.9, rng)


def truck(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a truck, or sometimes a bus if it is long."""
    if size[0] > 8.5 and size[2] > 2.8 and rng.random() < 0.25:
        return bus(size, rng)
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.6)
    cargo = rng.uniform(0.15, 0.6)
    cab = min(2.3, 0.35 * length)
    cab_height = min(height, 0.75 * height + 0.5)
    front = length / 2
    box_end = front - cab - 0.35
    rows = [
        block(PAINT, paint, (front - cab / 2, 0, (0.4 + cab_height) / 2), (cab, width * 0.97, cab_height - 0.4),
               density=lost, taper=(0.12, 0.0, 0.04)),
        block(GLASS, 0.03, (front - cab * 0.08 - 0.03, 0, cab_height * 0.66), (0.1, width * 0.85, cab_height * 0.26),
               density=0.7),
        block(MATTE, 0.1, (-0.1, 0, 0.75), (length - 0.4, width * 0.4, 0.3)),
    ]  # fmt: skip
    if rng.random() < 0.8:
        rows.append(
            block(PAINT if rng.random() < 0.5 else MATTE, cargo, ((box_end - front) / 2, 0, (1.0 + height) / 2),
                   (box_end + front, width, height - 1.0), density=0.1)
        )  # fmt: skip
    else:  # a tipper or flat bed
        top = 1.0 + (height - 1.0) * rng.uniform(0.3, 0.6)
        bed = (box_end + front, width, top - 1.0)
        rows.append(block(MATTE, cargo, ((box_end - front) / 2, 0, (1.0 + top) / 2), bed))
        rows.append(block(MATTE, cargo, (box_end - 0.05, 0, (1.0 + height) / 2), (0.1, width, height - 1.0)))
    axles = [front - min(1.3, 0.2 * length), -front + 0.2 * length]
    axles += [-front + 0.2 * length + 1.2] if length > 7.5 else []
    return rows + _wheels(width, axles, 0.48) + _lights(length, width, 0.95, rng)


def bus(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a bus or a tram: a long hull with a band of windows."""
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.6)
    clearance = rng.uniform(0.2, 0.35)
    sill, lintel = rng.uniform(0.9, 1.2), height - rng.uniform(0.4, 0.7)
    rows = [
        block(PAINT, paint, (0, 0, (clearance + sill) / 2), (length, width, sill - clearance), density=lost),
        block(GLASS, 0.03, (0, 0, (sill + lintel) / 2), (length * 0.99, width * 0.98, lintel - sill),
               density=rng.uniform(0.4, 0.9), taper=(0.02, 0.01, 0.03)),
        block(PAINT, paint, (0, 0, (lintel + height) / 2), (length * 0.985, width * 0.97, height - lintel),
               density=lost, taper=(0.01, 0.01, 0.05)),
    ]  # fmt: skip
    for x in np.linspace(-length / 2 + 0.06, length / 2 - 0.06, max(3, int(length / 1.8))).tolist():
        rows += [
            block(MATTE, 0.12, (x, s * (width / 2 - 0.03), (sill + lintel) / 2), (0.1, 0.05, lintel - sill))
            for s in (-1.0, 1.0)
        ]
    axles = (-length / 2 + min(2.6, 0.25 * length), length / 2 - min(2.4, 0.2 * length))
    return rows + _wheels(width, axles, 0.45) + _lights(length, width, 0.8, rng)


def misc(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make an object of KITTI's class misc, by its size: a parked motorcycle, a trailer, a caravan or a machine."""
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    if length < 2.7 and width < 1.3 and height < 1.7:
        return motorcycle(length, width, min(height, 1.3), rng)
    paint, lost = _paint(rng, 0.6)
    floor = min(0.6, 0.3 * height)
    body = length if length < 3.0 else length - 1.1  # the drawbar takes the rest
    rear = -length / 2 + body / 2
    rows = [block(PAINT, paint, (rear, 0, (floor + height) / 2), (body, width, height - floor), density=lost,
                   taper=(rng.uniform(0.0, 0.25), rng.uniform(0.0, 0.15), 0.04))]  # fmt: skip
    if height > 2.0 and rng.random() < 0.6:  # a caravan
        rows.append(
            block(GLASS, 0.03, (rear, 0, 0.65 * height), (body * 0.8, width + 0.01, 0.22 * height), density=0.7)
        )
    elif height < 1.6 and rng.random() < 0.5:  # an open trailer with a load
        rows[0] = block(MATTE, 0.3, (rear, 0, floor + 0.2), (body, width, 0.4))
        low = floor + 0.4
        load = max(height - low, 0.1)
        rows.append(block(MATTE, rng.uniform(0.1, 0.6), (rear, 0, low + load / 2), (0.6 * body, 0.7 * width, load)))
    if body < length:
        rows.append(rod(0.25, (rear + body / 2 - 0.1, 0, 0.45), (length / 2 - 0.05, 0, 0.45), 0.05))
    axles = (rear - 0.1, *(() if body < 4.0 else (rear + 0.7,)))
    return rows + _wheels(width, axles, min(0.33, 0.5 * floor + 0.1))


def motorcycle(length: float, width: float, height: float, rng: np.random.Generator) -> list[Row]:
    """Make a moped or a motorcycle without a rider, up to ``height`` [m]."""
    radius = min(0.3, 0.16 * length)
    axle = length / 2 - radius
    rows = [rod(0.05, (s * axle, -0.06, radius), (s * axle, 0.06, radius), radius) for s in (-1.0, 1.0)]
    paint, lost = _paint(rng, 0.4)
    half = min(0.36, width / 2 - 0.02)
    rows.append(block(PAINT, paint, (-0.1 * length, 0, 0.5), (0.62 * length, 0.26, 0.34), density=lost))
    rows.append(block(MATTE, 0.1, (-0.2 * length, 0, 0.74), (0.36 * length, 0.24, 0.12)))
    shield = 0.24 * length
    if rng.random() < 0.5:  # a scooter
        rows.append(block(PAINT, paint, (shield, 0, 0.62), (0.1, min(0.42, width - 0.06), 0.62), density=lost))
    rows.append(rod(0.25, (axle, 0, radius), (shield, 0, height - 0.1), 0.05))
    rows.append(rod(0.2, (shield - 0.05, -half, height - 0.12), (shield - 0.05, half, height - 0.12), 0.03))
    if rng.random() < 0.4:  # a windscreen or a box
        rows.append(block(POROUS, 0.3, (shield, 0, height - 0.14), (0.05, 0.3, 0.24), density=0.6))
    if rng.random() < 0.3:
        rows.append(block(MATTE, 0.2, (-0.4 * length, 0, 0.86), (0.16 * length, 0.3, 0.24)))
    rows.append(block(RETRO, 0.7, (-0.46 * length, 0, 0.6), (0.05, 0.1, 0.07)))
    return rows
