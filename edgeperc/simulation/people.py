"""People, riders and bicycles."""

from __future__ import annotations

import math

import numpy as np

from .raycast import CYLINDER, MATTE, POROUS, RETRO
from .shapes import Row, Vector, blob, block, rod
from .vehicles import motorcycle


def _cloth(rng: np.random.Generator) -> float:
    # Measured: mean remission of people is 0.29..0.47, and 0 for one in twelve. Most cloth is bright in near infrared.
    return float(rng.uniform(0.0, 0.15) if rng.random() < 0.06 else rng.uniform(0.3, 0.6))


def _head(x: float, h: float, rng: np.random.Generator) -> list[Row]:
    rows = [blob(MATTE, rng.uniform(0.3, 0.55), (x, 0.0, 0.935 * h), (0.2, 0.17, 0.13 * h))]
    if rng.random() < 0.2:  # a hat or a hood
        rows.append(blob(MATTE, _cloth(rng), (x - 0.02, 0.0, 0.95 * h), (0.27, 0.25, 0.1 * h)))
    return rows


def pedestrian(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a person who stands or walks, with arms in one of several poses; some carry something."""
    length, width, h = size
    rows: list[Row] = []
    if width > 0.68 and h > 1.75 and rng.random() < 0.06:  # below an umbrella
        spread = min(length, width, 1.1) - 0.06
        rows.append(blob(MATTE, _cloth(rng), (0.0, 0.0, h - 0.12), (spread, spread, 0.22)))
        rows.append(rod(0.3, (0.12, 0.1, 0.55 * h), (0.02, 0.0, h - 0.05), 0.012))
        h *= 0.9
    cloth, trousers = _cloth(rng), _cloth(rng)
    bulk = rng.uniform(0.85, 1.2) * h / 1.75
    most = max(0.03, length / 2 - 0.16)
    # Measured: 0.54 of the length of real boxes holds returns, 0.34 if everybody stands.
    stride = most * rng.uniform(0.55, 1.0) if rng.random() < 0.75 else min(most, rng.uniform(0.0, 0.1))
    half = max(0.12, min(0.26 * bulk, width / 2 - 0.08))
    widest = max(half, width / 2 - 0.06)
    hip, shoulder = 0.51 * h, 0.82 * h
    lean = rng.uniform(0.0, 0.08) * (stride > 0.1)
    apart = rng.uniform(0.06, 0.13)
    pose = str(rng.choice(["swing", "hang", "hips", "front", "phone", "pockets"], p=[0.4, 0.2, 0.08, 0.12, 0.1, 0.1]))
    skirt = rng.random() < 0.2
    for s in (-1.0, 1.0):
        foot = (s * stride, s * apart, 0.06)
        bend = rng.uniform(0.02, 0.16) * min(1.0, most / 0.2)
        knee = (min(s * stride * 0.5 + bend, length / 2 - 0.1), s * apart, 0.28 * h)
        rows.append(rod(cloth if skirt else trousers, (0.0, s * 0.09 * bulk, hip), knee, 0.085 * bulk))
        rows.append(rod(trousers, knee, foot, 0.06 * bulk))
        rows.append(block(MATTE, 0.2, (foot[0] + min(0.05, length / 2 - abs(foot[0]) - 0.1), foot[1], 0.05),
                           (0.24 if length > 0.5 else 0.18, 0.1, 0.1)))  # fmt: skip
        side, reach = s * half, length / 2 - 0.06
        one = pose == "front" or (pose == "phone" and s > 0.0)
        if one:
            elbow, hand = (0.02, side, 0.62 * h), (min(0.3, reach), s * 0.1, (0.64 if pose == "front" else 0.78) * h)
        elif pose == "hips":
            elbow, hand = (-0.05, s * widest, 0.64 * h), (0.04, s * 0.18, 0.55 * h)
        elif pose == "pockets":
            elbow, hand = (-0.1, side, 0.64 * h), (0.08, s * 0.17, 0.51 * h)
        else:
            swing = stride * rng.uniform(0.3, 0.9) if pose == "swing" else 0.02
            hand = (max(-reach, min(reach, -s * swing)), s * min(widest, half + 0.05), 0.46 * h)
            elbow = (hand[0] * 0.4 - 0.04, s * min(widest, half + 0.03), 0.63 * h)
        rows.append(rod(cloth, (lean, s * half * 0.8, shoulder), elbow, 0.055 * bulk))
        rows.append(rod(cloth, elbow, hand, 0.045 * bulk))
        if rng.random() < 0.1 and not one and pose != "pockets":  # a bag
            edge = (min(0.34, length - 0.1), 0.1, rng.uniform(0.2, 0.42))
            low = max(0.02, hand[2] - edge[2])
            x = max(edge[0] / 2 - length / 2, min(length / 2 - edge[0] / 2, hand[0]))
            rows.append(
                block(MATTE, _cloth(rng), (x, s * min(abs(hand[1]), width / 2 - 0.06), low + edge[2] / 2), edge)
            )
    girth, breadth = rng.uniform(0.2, 0.28) * bulk, min(0.46 * bulk, 2 * half)
    rows.append(blob(MATTE, cloth, (lean / 2, 0.0, 0.66 * h), (girth * 1.15, breadth, 0.42 * h)))
    rows.append(block(MATTE, cloth, (lean / 2, 0, 0.66 * h), (girth, 0.85 * breadth, 0.34 * h), kind=CYLINDER))
    if skirt:  # or a coat
        low = rng.uniform(0.2, 0.4) * h
        around = min(0.42 * bulk, length - 0.04, width - 0.04)
        rows.append(
            block(MATTE, cloth, (0, 0, (low + 0.56 * h) / 2), (around * 0.85, around, 0.56 * h - low), kind=CYLINDER)
        )
    rows += _head(lean + 0.02, h, rng)
    if rng.random() < 0.25 and length > 0.6:  # a rucksack
        rows.append(block(MATTE, _cloth(rng), (-0.2, 0, 0.68 * h), (0.18, 0.3, 0.27 * h)))
    return rows


def person_sitting(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a person who sits, with the seat below."""
    length, width, h = size
    cloth, trousers = _cloth(rng), _cloth(rng)
    seat = 0.35 * h
    back, knees = -length / 2 + 0.2, max(0.0, length / 2 - 0.12)
    half = max(0.12, min(0.24, width / 2 - 0.08))
    rows = [block(MATTE, 0.3, (back, 0, seat - 0.12), (0.34, min(0.5, width - 0.04), 0.06))]
    for s in (-1.0, 1.0):
        rows.append(rod(trousers, (back, s * 0.1, seat), (knees, s * 0.12, seat + 0.04), 0.085))
        rows.append(rod(trousers, (knees, s * 0.12, seat + 0.04), (knees + 0.03, s * 0.12, 0.05), 0.06))
        elbow = (back + 0.06, s * half, 0.55 * h)
        rows.append(rod(cloth, (back, s * half * 0.8, 0.74 * h), elbow, 0.055))
        rows.append(rod(cloth, elbow, (knees * 0.6, s * 0.12, seat + 0.15), 0.045))
    lean = rng.uniform(-0.04, 0.12)
    rows.append(rod(cloth, (back, 0, seat), (back + lean, 0, 0.72 * h), 0.12))
    rows.append(blob(MATTE, cloth, (back + lean / 2, 0, 0.56 * h), (0.28, min(0.44, 2 * half), 0.52 * h)))
    rows.append(blob(MATTE, rng.uniform(0.3, 0.55), (back + lean + 0.03, 0, 0.9 * h), (0.2, 0.17, 0.19 * h)))
    return rows


def pram(rng: np.random.Generator) -> list[Row]:
    """Make a pram, a trolley or a walking frame, 0.9 m long."""
    cover, high = _cloth(rng), rng.uniform(0.85, 1.05)
    rows = [block(MATTE, cover, (0, 0, 0.6), (0.7, 0.36, 0.35), taper=(0.2, 0.1, 0.1))]
    if rng.random() < 0.6:
        rows.append(blob(MATTE, cover, (0.12, 0, 0.82), (0.5, 0.38, 0.42)))
    for a in (-0.28, 0.28):
        rows += [rod(0.1, (a, s * 0.22 - 0.02, 0.12), (a, s * 0.22 + 0.02, 0.12), 0.12) for s in (-1.0, 1.0)]
        rows += [rod(0.25, (a, s * 0.2, 0.12), (-0.05, s * 0.18, 0.5), 0.015) for s in (-1.0, 1.0)]
    return [*rows, rod(0.2, (-0.45, -0.2, high), (-0.45, 0.2, high), 0.015)]


def bicycle(length: float, half: float, rng: np.random.Generator, y: float = 0.0) -> list[Row]:
    """Make a bicycle: two wheels, a frame, a handlebar; some have a basket, mudguards or a child seat."""
    r = min(0.35, 0.2 * length)
    axle = length / 2 - r

    def to(a: float, b: float, z: float) -> Vector:
        return (a, y + b, z)

    rows = []
    for s in (-1.0, 1.0):
        # A wheel is a rim with spokes: most rays pass through it.
        spokes = rod(0.2, to(s * axle, -0.02, r), to(s * axle, 0.02, r), r, POROUS)
        rows.append((*spokes[:3], 0.3, *spokes[4:]))
    seat, head, pedals = to(-0.2 * length, 0, 0.85), to(0.28 * length, 0, 0.85), to(-0.06 * length, 0, 0.3)
    step_through = rng.random() < 0.5
    top = to(-0.12 * length, 0, 0.5) if step_through else seat
    for a, b in ((to(-axle, 0, r), seat), (top, head), (pedals, head), (head, to(axle, 0, r)), (seat, pedals)):
        rows.append(rod(0.25, a, b, 0.022))
    bar = to(0.24 * length, 0, 1.0)
    rows.append(rod(0.2, (bar[0], y - half, 1.0), (bar[0], y + half, 1.0), 0.02))
    rows.append(block(MATTE, 0.1, to(-0.2 * length, 0, 0.92), (0.25, 0.14, 0.07)))
    if rng.random() < 0.5:
        rows.append(block(RETRO, 0.6, to(-0.42 * length, 0, 0.55), (0.05, 0.07, 0.07)))
    if rng.random() < 0.2:
        rows.append(block(POROUS, 0.3, to(0.36 * length, 0, 0.92), (0.15 * length, 0.3, 0.24), density=0.6))
    if rng.random() < 0.3:  # bags at the rear
        rows.append(block(MATTE, _cloth(rng), to(-0.32 * length, 0, 0.6), (0.17 * length, min(0.36, 2 * half), 0.3)))
    elif rng.random() < 0.12:
        rows.append(block(MATTE, _cloth(rng), to(-0.36 * length, 0, 0.98), (0.15 * length, 0.3, 0.5)))
    return rows


def cyclist(size: Vector, rng: np.random.Generator) -> list[Row]:
    """Make a rider on a bicycle or a moped: upright or bent, pedalling, or with a foot on the ground."""
    length, width, h = size
    cloth, trousers = _cloth(rng), _cloth(rng)
    bulk = rng.uniform(0.9, 1.2)
    half, widest = min(0.25 * bulk, width / 2 - 0.06), max(0.16, width / 2 - 0.07)
    moped = width > 0.52 and rng.random() < 0.12
    bent = float(rng.uniform(0.06, 0.16) if rng.random() < 0.6 else rng.uniform(0.16, 0.3))
    hip = (-0.17 * length, 0.0, 0.55 * h)
    shoulder = (hip[0] + bent * length, 0.0, (0.85 - 0.35 * max(0.0, bent - 0.12)) * h)
    if moped:
        rows = motorcycle(length, width, 1.1, rng)
    else:
        rows = bicycle(length, min(rng.uniform(0.2, 0.32), width / 2 - 0.02), rng)
    turn = rng.uniform(0.0, 2.0 * math.pi)
    grounded = rng.random() < 0.12
    knees = min(widest, rng.uniform(0.1, 0.2))
    for s in (-1.0, 1.0):
        pedal = (-0.06 * length + s * 0.16 * math.cos(turn), s * 0.12, 0.32 + s * 0.16 * math.sin(turn))
        if moped:
            pedal = (0.12 * length, s * min(0.16, widest), 0.32)
        elif grounded and s > 0.0:
            pedal = (0.02 * length, min(0.26, widest), 0.06)
        ahead = 0.13 if grounded and s > 0.0 else 0.24
        knee = (max(hip[0], pedal[0]) * 0.4 + ahead, s * knees, min(0.5 * (hip[2] + pedal[2]) + 0.08, hip[2]))
        rows.append(rod(trousers, (hip[0], s * 0.1, hip[2]), knee, 0.08 * bulk))
        rows.append(rod(trousers, knee, pedal, 0.055 * bulk))
        rows.append(block(MATTE, 0.2, (pedal[0] + 0.06, pedal[1], max(pedal[2], 0.05)), (0.26, 0.1, 0.09)))
        elbow = ((shoulder[0] + 0.24 * length) / 2 - 0.03, s * min(widest, half + 0.06), 0.66 * h)
        rows.append(rod(cloth, (shoulder[0], s * 0.8 * half, shoulder[2] - 0.03), elbow, 0.05 * bulk))
        rows.append(rod(cloth, elbow, (0.24 * length, s * min(half, 0.26), 1.03), 0.042))
    rows.append(rod(cloth, hip, (shoulder[0], 0.0, shoulder[2] - 0.05), min(0.15, width / 2 - 0.02)))
    middle = tuple((a + b) / 2 for a, b in zip(hip, shoulder, strict=True))
    rows.append(blob(MATTE, cloth, (middle[0], 0.0, middle[2]), (0.3 * bulk, 2 * half, 0.4 * h)))
    if rng.random() < 0.25:  # a rucksack
        rows.append(block(MATTE, _cloth(rng), (middle[0] - 0.2, 0.0, middle[2] + 0.08), (0.16, 0.28, 0.4)))
    head = min(0.93 * h, shoulder[2] + 0.11 * h)
    rows.append(blob(MATTE, 0.45, (shoulder[0] + 0.07, 0, head), (0.22, 0.18, 0.14 * h)))
    if rng.random() < 0.4:  # a helmet
        rows.append(blob(MATTE, rng.uniform(0.2, 0.6), (shoulder[0] + 0.06, 0, head + 0.03), (0.28, 0.2, 0.1 * h)))
    return rows
