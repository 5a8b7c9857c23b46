"""Vehicles, people and bicycles made of boxes, ellipsoids and cylinders."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from .raycast import BOX, CYLINDER, ELLIPSOID, GLASS, MATTE, PAINT, POROUS, RETRO

__all__ = ["SHAPES", "SIZES", "Row", "Vector", "bicycle", "blob", "block", "rod"]

# --- shapes -----------------------------------------------------------------------------------------------------------

Row = tuple[float, ...]
Vector = tuple[float, float, float]


def block(
    material: int,
    remission: float,
    center: Vector,
    size: Vector,
    *,
    yaw: float = 0.0,
    density: float = 1.0,
    taper: Vector = (0.0, 0.0, 0.0),
    kind: int = BOX,
) -> Row:
    """Make an upright primitive. ``taper``: how far front, rear and sides lean in at the top, in half sizes."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    a, b, c = (2.0 / max(edge, 1e-3) for edge in size)
    return (
        kind, material, remission, density, *center, a * cos, a * sin, 0.0, -b * sin, b * cos, 0.0, 0.0, 0.0, c,
        *taper, -1.0,
    )  # fmt: skip


def blob(material: int, remission: float, center: Vector, size: Vector, density: float = 1.0) -> Row:
    """Make an ellipsoid."""
    return block(material, remission, center, size, density=density, kind=ELLIPSOID)


def rod(remission: float, start: Vector, end: Vector, radius: float, material: int = MATTE) -> Row:
    """Make a cylinder between two points."""
    along = [e - s for s, e in zip(start, end, strict=True)]
    length = math.sqrt(sum(v * v for v in along))
    ax, ay, az = (v / length for v in along)
    # Any two axes perpendicular to the first.
    ux, uy, uz = (0.0, az, -ay) if abs(ax) < 0.8 else (-az, 0.0, ax)
    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / norm, uy / norm, uz / norm
    vx, vy, vz = ay * uz - az * uy, az * ux - ax * uz, ax * uy - ay * ux
    r, h = 1.0 / radius, 2.0 / length
    middle = [(s + e) / 2.0 for s, e in zip(start, end, strict=True)]
    return (
        CYLINDER, material, remission, 1.0, *middle, r * ux, r * uy, r * uz, r * vx, r * vy, r * vz,
        h * ax, h * ay, h * az, 0.0, 0.0, 0.0, -1.0,
    )  # fmt: skip


def _wheels(length: float, width: float, xs: Sequence[float], radius: float) -> list[Row]:
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
        return float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.0, 0.2))
    return float(rng.uniform(0.0, 0.22)), float(rng.uniform(0.1, 0.75))


def _cloth(rng: np.random.Generator) -> float:
    # Measured: mean remission of people is 0.29..0.47, and 0 for one in twelve. Most cloth is bright in near infrared.
    return float(rng.uniform(0.0, 0.15) if rng.random() < 0.06 else rng.uniform(0.3, 0.6))


def _car(size: Vector, rng: np.random.Generator) -> list[Row]:
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
    rows = [
        block(PAINT, paint, (0, 0, (clearance + hood) / 2), (length, width, hood - clearance), density=lost,
               taper=(0.05, 0.04, 0.05)),
        block(PAINT, paint, ((nose - length / 2) / 2 - 0.02, 0, (hood + belt) / 2),
               (nose + length / 2 - 0.08, width * 0.97, belt - hood), density=lost, taper=(0.1, 0.02, 0.02)),
        block(GLASS, 0.03, (middle, 0, (belt + roof) / 2), (2 * half, width * 0.93, rise),
               density=rng.uniform(0.5, 0.97), taper=(screen * rise / half * 1.6, back * rise / half * 1.6, sides)),
        block(PAINT, paint, (0, 0, 0), (1, 1, 1), density=lost),
    ]  # fmt: skip
    # The roof lies on the glass; the pillars are inside its edges.
    front, rear = half * (1 - screen * rise / half * 1.6), half * (1 - back * rise / half * 1.6)
    rows[3] = block(
        PAINT, paint, (middle + (front - rear) / 2, 0, (roof + height) / 2),
        (front + rear, width * 0.93 * (1 - sides), height - roof), density=lost, taper=(0.15, 0.1, 0.15),
    )  # fmt: skip
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
    rows += _wheels(length, width, (-0.3 * length, 0.32 * length), radius)
    return rows + _lights(length, width, 0.62 * belt + 0.1, rng)


def _van(size: Vector, rng: np.random.Generator) -> list[Row]:
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
    return rows + _wheels(length, width, (-0.3 * length, 0.34 * length), 0.34) + _lights(length, width, 0.9, rng)


def _truck(size: Vector, rng: np.random.Generator) -> list[Row]:
    length, width, height = size[0] - 0.04, size[1] - 0.04, size[2]
    paint, lost = _paint(rng, 0.6)
    cargo = float(rng.uniform(0.15, 0.6))
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
    return rows + _wheels(length, width, axles, 0.48) + _lights(length, width, 0.95, rng)


def _pedestrian(size: Vector, rng: np.random.Generator) -> list[Row]:
    length, width, h = size
    cloth, trousers, skin = _cloth(rng), _cloth(rng), float(rng.uniform(0.4, 0.55))
    stride = max(0.02, length / 2 - 0.15) * rng.uniform(0.2, 1.0)
    half = max(0.12, width / 2 - 0.1)
    hip, shoulder = 0.5 * h, 0.82 * h
    swing = stride * rng.uniform(0.3, 0.9)
    rows = []
    for s in (-1.0, 1.0):
        foot = (s * stride, s * 0.09, 0.05)
        rows.append(rod(trousers, (0.0, s * 0.08, hip), foot, 0.09))
        rows.append(block(MATTE, 0.2, (foot[0] + 0.04, foot[1], 0.05), (0.2, 0.09, 0.1)))
        hand = (max(-length / 2 + 0.06, min(length / 2 - 0.06, -s * swing)), s * half, 0.47 * h)
        elbow = (hand[0] * 0.3 - 0.03, s * half, 0.63 * h)
        rows.append(rod(cloth, (0.0, s * half * 0.82, shoulder), elbow, 0.06))
        rows.append(rod(cloth, elbow, hand, 0.05))
    girth = rng.uniform(0.2, 0.27)
    rows.append(blob(MATTE, cloth, (0.0, 0.0, 0.66 * h), (girth * 1.1, min(0.46, 2 * half), 0.42 * h)))
    rows.append(block(MATTE, cloth, (0, 0, 0.66 * h), (girth, min(0.4, 1.7 * half), 0.34 * h), kind=CYLINDER))
    if rng.random() < 0.25:  # a coat or skirt
        rows.append(block(MATTE, cloth, (0, 0, 0.42 * h), (0.3, min(0.38, width - 0.04), 0.3 * h), kind=CYLINDER))
    rows.append(blob(MATTE, skin, (0.02, 0.0, 0.93 * h), (0.19, 0.16, 0.14 * h)))
    if rng.random() < 0.3 and length > 0.6:  # a rucksack
        rows.append(block(MATTE, 0.3, (-0.2, 0, 0.68 * h), (0.16, 0.28, 0.26 * h)))
    return rows


def bicycle(length: float, half: float, rng: np.random.Generator, y: float = 0.0) -> list[Row]:
    """Make a bicycle: two wheels, a frame, a handlebar."""
    r = min(0.35, 0.2 * length)
    axle = length / 2 - r

    def to(a: float, b: float, z: float) -> Vector:
        return (a, y + b, z)

    rows = []
    for s in (-1.0, 1.0):
        # A wheel is a rim with spokes: most rays pass through it.
        spokes = rod(0.2, to(s * axle, -0.02, r), to(s * axle, 0.02, r), r, POROUS)
        rows.append((*spokes[:3], 0.4, *spokes[4:]))
    seat, head, pedals = to(-0.2 * length, 0, 0.85), to(0.28 * length, 0, 0.85), to(-0.06 * length, 0, 0.3)
    for a, b in ((to(-axle, 0, r), seat), (seat, head), (pedals, head), (head, to(axle, 0, r)), (seat, pedals)):
        rows.append(rod(0.25, a, b, 0.022))
    rows.append(rod(0.2, to(0.24 * length, -half, 1.0), to(0.24 * length, half, 1.0), 0.02))
    rows.append(block(MATTE, 0.1, to(-0.2 * length, 0, 0.92), (0.25, 0.14, 0.07)))
    if rng.random() < 0.5:
        rows.append(block(RETRO, 0.6, to(-0.42 * length, 0, 0.55), (0.05, 0.07, 0.07)))
    return rows


def _cyclist(size: Vector, rng: np.random.Generator) -> list[Row]:
    length, width, h = size
    cloth, trousers = _cloth(rng), _cloth(rng)
    half = min(0.24, width / 2 - 0.08)
    hip, lean = (-0.16 * length, 0.0, 0.55 * h), rng.uniform(0.08, 0.24)
    shoulder = (hip[0] + lean * length, 0.0, 0.83 * h)
    rows = bicycle(length, min(0.27, width / 2 - 0.02), rng)
    crank = rng.uniform(-0.13, 0.13)
    for s in (-1.0, 1.0):
        knee = (0.1 * length + s * crank * 0.5, s * 0.12, 0.45 * h + s * crank * 0.6)
        rows.append(rod(trousers, (hip[0], s * 0.09, hip[2]), knee, 0.08))
        rows.append(rod(trousers, knee, (-0.04 * length, s * 0.12, 0.22 + s * crank), 0.055))
        elbow = ((shoulder[0] + 0.24 * length) / 2 - 0.03, s * half, 0.69 * h)
        rows.append(rod(cloth, (shoulder[0], s * 0.19, shoulder[2]), elbow, 0.05))
        rows.append(rod(cloth, elbow, (0.24 * length, s * half, 1.02), 0.04))
    rows.append(rod(cloth, hip, shoulder, min(0.17, width / 2 - 0.02)))
    middle = tuple((a + b) / 2 for a, b in zip(hip, shoulder, strict=True))
    rows.append(blob(MATTE, cloth, (middle[0], 0.0, middle[2]), (0.34, min(0.42, width - 0.02), 0.4 * h)))
    rows.append(blob(MATTE, 0.45, (shoulder[0] + 0.06, 0, 0.93 * h), (0.22, 0.18, 0.14 * h)))
    return rows


SHAPES: dict[str, Callable[[Vector, np.random.Generator], list[Row]]] = {
    "car": _car,
    "van": _van,
    "truck": _truck,
    "pedestrian": _pedestrian,
    "cyclist": _cyclist,
}

# Mean and spread of length, width, height: KITTI labels. Limits are two spreads.
SIZES: dict[str, tuple[Vector, Vector]] = {
    "car": ((3.9, 1.63, 1.52), (0.42, 0.1, 0.13)),
    "van": ((5.0, 1.9, 2.18), (0.7, 0.13, 0.3)),
    "truck": ((9.5, 2.55, 3.2), (2.8, 0.15, 0.35)),
    "pedestrian": ((0.82, 0.66, 1.76), (0.22, 0.13, 0.1)),
    "cyclist": ((1.76, 0.6, 1.74), (0.12, 0.1, 0.08)),
}
