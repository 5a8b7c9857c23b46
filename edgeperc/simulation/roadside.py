"""What stands beside a street: poles, trees, hedges, walls, buildings, and what else may be taken for a person."""

from __future__ import annotations

import copy
import math

import numpy as np

from .people import bicycle, pram
from .raycast import (
    BANK_RISE,
    BANK_RISE_LEFT,
    BANK_SLOPE,
    BANK_SLOPE_LEFT,
    BOX,
    CYLINDER,
    FACADE,
    GLASS,
    LEAVES,
    MATTE,
    PAVEMENT,
    POROUS,
    RETRO,
)
from .shapes import Row, blob, block, post, rod
from .street import Street

# --- poles and furniture ----------------------------------------------------------------------------------------------

# Frame of all of these: x along the street, away from the driver who reads a sign, y to the left.


def _lamp(rng: np.random.Generator) -> tuple[list[Row], float]:
    height, radius = rng.uniform(3.5, 9.5), rng.uniform(0.05, 0.1)
    rows = [post(0.3, 0.0, 0.0, height, radius)]
    if rng.random() < 0.7:  # a wider base
        rows.append(post(0.3, 0.0, 0.0, rng.uniform(0.6, 1.4), radius * rng.uniform(1.2, 1.7)))
    if height > 5.0 and rng.random() < 0.6:
        arm = rng.uniform(0.6, 2.2)
        rows.append(rod(0.3, (0, 0, height - 0.1), (0, arm, height + 0.1), 0.04))
        rows.append(block(MATTE, 0.3, (0, arm, height + 0.1), (0.25, 0.6, 0.12)))
    else:
        rows.append(blob(MATTE, 0.3, (0, 0, height), (0.4, 0.4, 0.45)))
    if rng.random() < 0.25:  # a sign or a bin on it
        rows += _board(rng, rng.uniform(1.9, 2.6))
    elif rng.random() < 0.2:
        rows.append(block(MATTE, 0.25, (-0.2, 0, 0.85), (0.26, 0.34, 0.5)))
    return rows, 2.0 * radius


def _board(rng: np.random.Generator, low: float) -> list[Row]:
    edge = rng.uniform(0.4, 0.8)
    high = edge * rng.uniform(0.6, 1.5)
    face, tilt = rng.uniform(0.6, 0.99), rng.normal(0.0, 0.2)
    shape = rng.random()
    if shape < 0.45:
        rows = [block(RETRO, face, (-0.06, 0, low + high / 2), (0.03, edge, high), yaw=tilt)]
    else:  # round: a flat ellipsoid
        rows = [blob(RETRO, face, (-0.06, 0, low + edge / 2), (0.04, edge, edge))]
    if rng.random() < 0.3:  # a second, smaller one below
        rows.append(block(RETRO, 0.9, (-0.06, 0, low - 0.2), (0.03, edge * 0.9, 0.25), yaw=tilt))
    return rows


def _sign(rng: np.random.Generator) -> tuple[list[Row], float]:
    radius, low = rng.uniform(0.025, 0.045), rng.uniform(1.7, 2.5)
    if rng.random() < 0.2:  # low, as on islands and at road works
        low = rng.uniform(0.5, 1.2)
    return [post(0.3, 0.0, 0.0, low + 0.7, radius), *_board(rng, low)], 0.1


def _wide_sign(rng: np.random.Generator) -> tuple[list[Row], float]:
    width, high = rng.uniform(1.0, 3.2), rng.uniform(0.5, 1.8)
    low = rng.uniform(0.8, 2.4)
    rows = [post(0.3, 0.0, s * 0.4 * width, low + high, rng.uniform(0.03, 0.07)) for s in (-1.0, 1.0)]
    rows.append(block(RETRO, rng.uniform(0.5, 0.95), (-0.08, 0, low + high / 2), (0.04, width, high)))
    return rows, width


def _traffic_light(rng: np.random.Generator) -> tuple[list[Row], float]:
    height, radius = rng.uniform(2.9, 3.6), rng.uniform(0.05, 0.09)
    arm = rng.uniform(2.5, 5.0) if rng.random() < 0.25 else 0.0
    rows = [post(0.3, 0.0, 0.0, max(height, 5.8 * (arm > 0.0)), radius)]
    for low in (height - 1.0, *((1.1,) if rng.random() < 0.3 else ())):
        rows.append(block(MATTE, 0.1, (-0.18, 0, low + 0.45), (0.25, 0.3, 0.9 if low > 1.5 else 0.2)))
    if arm > 0.0:
        rows.append(rod(0.3, (0, 0, 5.7), (0, arm, 5.8), 0.06))
        rows.append(block(MATTE, 0.1, (-0.15, arm, 5.5), (0.25, 0.4, 1.0)))
    if rng.random() < 0.5:
        rows.append(block(MATTE, 0.1, (0.05, -0.2, 2.4), (0.25, 0.25, 0.7)))
    return rows, 0.2


def _mast(rng: np.random.Generator) -> tuple[list[Row], float]:
    # A wooden mast for cables, or one for the overhead line of a tram.
    radius, height = rng.uniform(0.1, 0.19), rng.uniform(6.0, 10.0)
    rows = [rod(rng.uniform(0.2, 0.4), (0, 0, -0.2), (rng.normal(0, 0.15), rng.normal(0, 0.15), height), radius)]
    if rng.random() < 0.2:  # with a stay
        rows.append(rod(0.3, (0, 0, 0.7 * height), (1.6, 0.0, -0.1), 0.03))
    return rows, 2.0 * radius


def _bollard(rng: np.random.Generator) -> tuple[list[Row], float]:
    radius, height = rng.uniform(0.04, 0.13), rng.uniform(0.5, 1.15)
    rows = [post(rng.uniform(0.2, 0.6), 0.0, 0.0, height, radius)]
    if rng.random() < 0.5:
        rows.append(block(RETRO, 0.9, (-radius, 0, height - 0.2), (0.03, 1.2 * radius, 0.12)))
    return rows, 2.0 * radius


def _box(rng: np.random.Generator) -> tuple[list[Row], float]:
    # A cabinet, a bin, a post box, a planter or a skip.
    kind = int(rng.integers(0, 4))
    low, high = (((0.3, 0.4, 0.9), (0.6, 1.4, 1.6)), ((0.5, 0.5, 0.9), (0.75, 0.8, 1.15)),
                 ((0.25, 0.3, 1.2), (0.5, 0.55, 1.9)), ((0.4, 0.4, 0.35), (0.9, 2.0, 0.8)))[kind]  # fmt: skip
    size = tuple(rng.uniform(a, b) for a, b in zip(low, high, strict=True))
    rows = [block(MATTE, rng.uniform(0.08, 0.6), (0, 0, size[2] / 2 - 0.05), (size[0], size[1], size[2] + 0.1),
                   taper=(0.0, 0.0, rng.uniform(-0.12, 0.12)))]  # fmt: skip
    if kind == 3:  # plants in it
        for _ in range(int(rng.integers(1, 4))):
            w = rng.uniform(0.3, 0.8)
            place = (0.0, rng.uniform(-0.3, 0.3) * size[1], size[2] + 0.3 * w)
            rows.append(blob(LEAVES, 0.36, place, (0.9 * size[0], w, rng.uniform(0.4, 1.2)), 5.0))
    return rows, size[1]


def _meter(rng: np.random.Generator) -> tuple[list[Row], float]:
    # A parking meter, a pump, a letter box or a bin on a post: as high and wide as a person.
    height, wide = rng.uniform(1.2, 1.9), rng.uniform(0.18, 0.45)
    head = rng.uniform(0.3, 0.8)
    rows = [post(0.25, 0.0, 0.0, height - 0.1, rng.uniform(0.03, 0.08))]
    rows.append(block(MATTE, rng.uniform(0.1, 0.6), (0, 0, height - head / 2), (wide * 0.7, wide, head)))
    return rows, wide


def _column(rng: np.random.Generator) -> tuple[list[Row], float]:
    # An advertising column, a gate post or a statue on its base.
    kind = int(rng.integers(0, 3))
    if kind == 0:
        radius, height = rng.uniform(0.45, 0.75), rng.uniform(2.6, 3.6)
        return [post(0.4, 0.0, 0.0, height, radius), blob(MATTE, 0.3, (0, 0, height), (1.7 * radius,) * 3)], 2 * radius
    if kind == 1:
        edge, height = rng.uniform(0.3, 0.6), rng.uniform(1.1, 2.2)
        return [block(MATTE, 0.4, (0, 0, height / 2 - 0.1), (edge, edge, height + 0.2))], edge
    height = rng.uniform(0.6, 1.4)
    rows = [block(MATTE, 0.4, (0, 0, height / 2 - 0.1), (0.7, 0.7, height + 0.2), taper=(0.1, 0.1, 0.1))]
    rows.append(blob(MATTE, 0.35, (0, 0, height + 0.7), (0.45, 0.5, 1.5)))
    return rows, 0.7


def _bench(rng: np.random.Generator) -> tuple[list[Row], float]:
    long = rng.uniform(1.2, 2.0)
    rows = [block(MATTE, 0.3, (0, 0, 0.43), (0.42, long, 0.06))]
    rows += [block(MATTE, 0.25, (0, s * 0.4 * long, 0.18), (0.4, 0.08, 0.5)) for s in (-1.0, 1.0)]
    if rng.random() < 0.6:
        rows.append(block(POROUS, 0.3, (0.2, 0, 0.65), (0.05, long, 0.4), density=0.8))
    return rows, long


def _shelter(rng: np.random.Generator) -> tuple[list[Row], float]:
    long, deep = rng.uniform(2.6, 4.5), 1.3
    rows = [block(MATTE, 0.3, (0, 0, 2.45), (deep, long, 0.12))]
    rows.append(block(GLASS, 0.05, (deep / 2, 0, 1.2), (0.03, long, 2.0), density=0.75))
    rows += [post(0.3, a * deep / 2, s * long / 2, 2.4, 0.05) for a in (-0.6, 1.0) for s in (-1.0, 1.0)]
    rows.append(block(MATTE, 0.4, (0.1, -long / 2, 1.1), (1.0, 0.1, 1.8)))
    return rows, long


_FURNITURE = (
    (_lamp, 0.15), (_sign, 0.2), (_wide_sign, 0.06), (_traffic_light, 0.08), (_mast, 0.07), (_bollard, 0.18),
    (_box, 0.18), (_meter, 0.08), (_column, 0.05), (_bench, 0.03), (_shelter, 0.02),
)  # fmt: skip
_POLES = (_lamp, _sign, _traffic_light, _mast)
_THIN = (*_POLES, _wide_sign, _bollard, _meter)  # poles to a camera


def _add_furniture(street: Street, x: float, y: float, yaw: float, place: str) -> None:
    rng = street.rng
    shares = np.array([share for _, share in _FURNITURE])
    if place in ("rural", "highway"):  # masts, signs and reflector posts
        shares *= np.array([0.3, 1.0, 1.0, 0.0, 1.0, 1.5, 0.2, 0.0, 0.1, 0.1, 0.1])
    make = _FURNITURE[int(rng.choice(len(shares), p=shares / shares.sum()))][0]
    rows, width = make(rng)
    of = "Pole" if make in _THIN else ""
    if make is _bollard and rng.random() < 0.4:  # a row of equal ones
        gap = rng.uniform(1.2, 2.2)
        for k in range(int(rng.integers(3, 9))):
            a = k * gap
            street.add_static(rows, x + a * math.cos(yaw), y + a * math.sin(yaw), width, width, yaw, 0.2, of=of)
        return
    street.add_static(rows, x, y, 1.3 if make is _shelter else min(width, 0.6), width, yaw, 0.2, of=of)


# --- plants -----------------------------------------------------------------------------------------------------------


def _add_tree(street: Street, x: float, y: float, clear_m: float = 0.0) -> bool:
    """Place a tree, if its ground is free. Its foliage starts above ``clear_m``."""
    rng = street.rng
    height, radius, spread = rng.uniform(4, 13), rng.uniform(0.07, 0.36), rng.uniform(1.2, 3.4)
    bole = max(clear_m, rng.uniform(1.2, 3.2))
    height = max(height, bole + 1.5)
    wood = rng.uniform(0.2, 0.42)
    rows = [rod(wood, (0, 0, -0.3), (rng.normal(0, 0.12), rng.normal(0, 0.12), bole + 1), radius)]
    if rng.random() < 0.5:  # coarse bark: returns scatter by some centimeters
        rows[0] = (*rows[0][:1], LEAVES, wood, rng.uniform(8.0, 25.0), *rows[0][4:])
    kind = rng.random()
    if kind < 0.12 and clear_m == 0.0:  # a conifer
        for level in np.linspace(0.6, height, 6).tolist():
            w = 2 * spread * (1.05 - level / height)
            rows.append(blob(LEAVES, 0.34, (0, 0, level), (w, w, height / 4), 1.6))
    elif kind < 0.2:  # bare: branches only
        for _ in range(int(rng.integers(4, 9))):
            turn, level = rng.uniform(0, 2 * math.pi), rng.uniform(0.8, 1.3) * bole
            tip = (spread * math.cos(turn) * 0.7, spread * math.sin(turn) * 0.7, level + rng.uniform(0.8, 3.0))
            rows.append(rod(wood, (0, 0, level), tip, rng.uniform(0.02, 0.06)))
    else:
        leaf, density = rng.uniform(0.32, 0.46), rng.uniform(0.4, 1.8)
        for _ in range(int(rng.integers(4, 11))):
            turn, away = rng.uniform(0, 2 * math.pi), spread * math.sqrt(rng.random()) * 0.8
            w = spread * rng.uniform(0.4, 1.1)
            low = bole + (0.45 * w if clear_m > 0.0 else 0.5)
            level = rng.uniform(low, max(low, height))
            rows.append(
                blob(LEAVES, leaf, (away * math.cos(turn), away * math.sin(turn), level), (w, w, 0.9 * w), density)
            )
    if rng.random() < 0.15 and clear_m == 0.0:  # ivy, shoots
        rows.append(blob(LEAVES, 0.38, (0, 0, 0.5), (5 * radius, 5 * radius, rng.uniform(1.0, 3.0)), 4.0))
    return street.add_static(rows, x, y, 2 * radius, 2 * radius, 0.0, 0.35, of="Tree")


def _add_bush(street: Street, x: float, y: float, size: float) -> bool:
    """Place a bush of about ``size`` [m], if its ground is free."""
    rng = street.rng
    leaf = rng.uniform(0.3, 0.46)
    rows = []
    if size > 1.2 and rng.random() < 0.12:  # narrow and as high as a person or higher
        w, h = rng.uniform(0.4, 0.9), rng.uniform(1.3, 2.6)
        rows.append(blob(LEAVES, leaf, (0, 0, h / 2), (w, w, h), rng.uniform(6.0, 14.0)))
        return street.add_static(rows, x, y, w, w, 0.0, 0.3, of="Tree")
    for _ in range(int(rng.integers(2, 4 + 2 * math.ceil(size)))):
        w, h = size * rng.uniform(0.3, 0.9), size * rng.uniform(0.3, 0.9)
        a, b = (rng.normal(0, 0.25, 2) * size).tolist()
        center = (a, b, 0.4 * h + rng.uniform(0.0, 0.35) * size)
        rows.append(blob(LEAVES, leaf, center, (w, w * rng.uniform(0.6, 1.4), h), rng.uniform(1.5, 7)))
    return street.add_static(rows, x, y, size * 0.8, size * 0.8, 0.0, 0.3, of="Tree")


# --- borders and buildings --------------------------------------------------------------------------------------------


def _add_building(street: Street, x: float, y: float, yaw: float, length: float, depth: float) -> bool:
    """Place a building, if its ground is free."""
    rng = street.rng
    height, wall = rng.uniform(3.2, 11.0), rng.uniform(0.34, 0.55)
    rows = [
        block(FACADE, wall, (0, 0, height / 2 - 1), (length, depth, height + 2), density=rng.uniform(1.6, 3.4)),
        block(MATTE, 0.25, (0, 0, height + 1.3), (length + 0.5, depth + 0.7, 2.6), taper=(0.0, 0.0, 0.9)),
    ]
    for _ in range(int(rng.integers(0, 4))):  # porches, bays, steps, balconies
        w, h = rng.uniform(0.8, 2.5), float(rng.choice([0.4, 2.4, height]))
        low = 2.6 if h == 0.4 and rng.random() < 0.4 else 0.0
        rows.append(
            block(MATTE, wall, (rng.uniform(-0.4, 0.4) * length, -rng.choice([-1, 1]) * depth / 2, low + h / 2 - 0.05),
                   (w, rng.uniform(0.6, 1.6), h + 0.1))
        )  # fmt: skip
    return street.add_static(rows, x, y, length + 0.4, depth + 1.4, yaw, 0.8, of="Building")


class _Border:
    """A continuous hedge, wall, fence or rail: what all of its pieces have in common."""

    def __init__(self, kind: str, rng: np.random.Generator) -> None:
        self.kind = kind
        self.remission = rng.uniform(0.3, 0.5)
        low, high = {"hedge": (0.7, 2.4), "thicket": (2.0, 5.0), "wall": (0.4, 3.2), "fence": (0.8, 2.0)}.get(
            kind, (0.75, 0.75)
        )
        self.height = rng.uniform(low, high)
        self.width = {"hedge": rng.uniform(0.5, 1.2), "thicket": rng.uniform(1.0, 2.5), "wall": 0.25}.get(kind, 0.1)
        self.density = float(rng.uniform(4.0, 10.0) if kind == "hedge" else rng.uniform(1.0, 4.0))
        self.gaps = rng.uniform(0.25, 0.7) if kind == "fence" else 1.0  # share of rays that a fence returns
        self.base = rng.uniform(0.2, 0.6) if kind == "fence" and rng.random() < 0.4 else 0.0

    def rows(self, length: float, rng: np.random.Generator) -> list[Row]:
        h, w, shade = self.height, self.width, self.remission
        if self.kind == "hedge":
            h *= rng.uniform(0.95, 1.05)
            return [block(LEAVES, 0.9 * shade, (0, 0, h / 2), (length, w, h), density=self.density)]
        if self.kind == "thicket":
            rows = [block(LEAVES, 0.9 * shade, (0, 0, 0.3 * h), (length, 0.7 * w, 0.6 * h), density=self.density)]
            for _ in range(max(1, round(length / 1.5))):
                a, size = rng.uniform(-0.5, 0.5) * length, rng.uniform(0.4, 0.8) * h
                wide = rng.uniform(0.8, 1.6) * w
                place = (a, rng.normal(0, 0.2) * w, 0.3 * h + size / 2)
                rows.append(blob(LEAVES, 0.9 * shade, place, (wide, wide, size), self.density))
            return rows
        if self.kind == "wall":
            rows = [block(MATTE, shade, (0, 0, h / 2 - 0.2), (length, w, h + 0.4))]
            if h > 1.0 and rng.random() < 0.3:
                rows.append(block(MATTE, shade, (length / 2 - 0.2, 0, h / 2), (0.4, 0.4, h + 0.2)))
            return rows
        if self.kind == "rail":
            rows = [block(MATTE, 0.35, (0, 0, 0.6), (length, 0.08, 0.3))]
            return rows + [block(MATTE, 0.35, (a, -0.08, 0.3), (0.06, 0.1, 0.8)) for a in _spread(length, 4.0)]
        rows = [block(POROUS, 0.3, (0, 0, (h + self.base) / 2), (length, 0.04, h - self.base), density=self.gaps)]
        if self.base > 0.0:
            rows.append(block(MATTE, shade, (0, 0, self.base / 2 - 0.1), (length, 0.2, self.base + 0.2)))
        return rows + [post(0.3, a, 0.0, h + 0.05, 0.04) for a in _spread(length, 2.5)]


def _spread(length: float, step: float) -> list[float]:
    return np.arange(-length / 2, length / 2, step).tolist()


# As in CamVid: walls count as buildings, hedges as trees.
_BORDER_OF = {"hedge": "Tree", "thicket": "Tree", "wall": "Building", "fence": "Fence", "rail": "Fence"}
_BORDERS = {
    "urban": (("hedge", 0.24), ("wall", 0.33), ("fence", 0.23), ("thicket", 0.1), ("none", 0.1)),
    "residential": (("hedge", 0.4), ("wall", 0.24), ("fence", 0.16), ("thicket", 0.15), ("none", 0.05)),
    "junction": (("hedge", 0.25), ("wall", 0.25), ("fence", 0.2), ("thicket", 0.1), ("none", 0.2)),
    "rural": (("hedge", 0.15), ("wall", 0.1), ("fence", 0.15), ("thicket", 0.4), ("none", 0.2)),
    "highway": (("rail", 0.6), ("wall", 0.15), ("thicket", 0.15), ("none", 0.1)),
}


def _add_border(street: Street, road: int, side: float, away: float, low: float, high: float, place: str) -> None:
    """Line a side of a road with runs of hedges, walls, fences and rails, with gaps for drives."""
    rng = street.rng
    kinds, shares = zip(*_BORDERS[place], strict=True)
    s = low
    kind = str(rng.choice(kinds, p=shares))
    while s < high:
        if rng.random() < 0.25:  # another owner
            kind = str(rng.choice(kinds, p=shares))
        border = _Border(kind, rng)
        shift = away + border.width / 2 + rng.uniform(0.0, 0.6) * (kind != "rail")
        end = min(high, s + rng.uniform(6.0, 45.0))
        while kind != "none" and s < end - 1.0:
            length = min(end - s, 6.0)
            x, y, yaw = street.on_strip(s + length / 2, side * (street.edge(road, side) + shift), road)
            rows = border.rows(length + 0.05, rng)
            street.add_static(rows, x, y, length - 0.6, border.width, yaw, 0.1, of=_BORDER_OF[kind])
            s += length
        s = end + (rng.uniform(1.0, 5.0) if rng.random() < 0.7 else rng.uniform(5.0, 25.0))


# --- all of it --------------------------------------------------------------------------------------------------------


def add_roadside(street: Street, place: str) -> None:
    """Add the roadside: buildings, borders, trees, bushes, poles and street furniture."""
    rng = street.rng
    pavement = float(street.terrain[PAVEMENT])
    built = {"urban": 0.85, "residential": 0.65, "junction": 0.6, "rural": 0.06, "highway": 0.0}[place]
    built *= rng.uniform(0.3, 1.1)
    open_land = place in ("rural", "highway")
    n_roads = int(np.count_nonzero(street.strips[:, 9] == 0.0))
    for k in range(n_roads):
        for side in (-1.0, 1.0):
            edge = street.edge(k, side)
            setback = pavement + float(rng.uniform(0.1, 7.0) if place == "urban" else rng.uniform(3.0, 16.0))
            green = {"urban": 0.4, "residential": 1.0, "junction": 0.6, "rural": 1.4, "highway": 0.8}[place]
            green *= rng.uniform(0.2, 1.8)
            low, high = max(-85.0, float(street.strips[k, 7])), min(85.0, float(street.strips[k, 8]))
            s = low
            while s < high:
                if rng.random() < built:
                    length, depth = rng.uniform(7.0, 22.0), rng.uniform(6.0, 11.0)
                    u = side * (edge + setback + depth / 2 + rng.normal(0, 0.3))
                    x, y, yaw = street.on_strip(s + length / 2, u, k)
                    _add_building(street, x, y, yaw, length, depth)
                    s += length + (0.3 if rng.random() < 0.6 else rng.uniform(2.0, 9.0))
                else:
                    s += rng.uniform(5.0, 15.0)
            _add_street_trees(street, k, side, pavement, low, high, 0.0 if open_land else green)
            near, far = max(low, -60.0), min(high, 75.0)
            for _ in range(int(rng.poisson(11 if not open_land else 5))):
                u = side * (edge + rng.uniform(0.35, max(pavement, 1.0)))
                x, y, yaw = street.on_strip(rng.uniform(near, far), u, k)
                _add_furniture(street, x, y, yaw + (0.0 if side < 0 else math.pi), place)
            _add_border(street, k, side, max(pavement, 0.6) + 0.15, low, high, place)
            for _ in range(int(rng.poisson(10 * green))):
                away = pavement + abs(rng.normal(0.3, 6.0))
                x, y, _ = street.on_strip(rng.uniform(low, high), side * (edge + away + 0.4), k)
                _add_tree(street, x, y)
            for _ in range(int(rng.poisson(30 * green))):
                away = pavement * rng.uniform(0.7, 1.0) + abs(rng.normal(0.0, 4.0))
                size = float(rng.uniform(0.25, 0.9) if rng.random() < 0.6 else rng.uniform(0.9, 3.2))
                x, y, _ = street.on_strip(rng.uniform(near, far), side * (edge + away + 0.5), k)
                _add_bush(street, x, y, size)
    _add_retaining_walls(street, pavement)
    for _ in range(int(rng.integers(15, 40))):  # the background
        turn, away = rng.uniform(0, 2 * math.pi), rng.uniform(25.0, 75.0)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if rng.random() < 0.25 and built > 0.0:
            _add_building(street, x, y, turn, rng.uniform(8, 20), rng.uniform(8, 14))
        else:
            _add_tree(street, x, y)


def _add_street_trees(
    street: Street, road: int, side: float, pavement: float, low: float, high: float, green: float
) -> None:
    """Add a row of trees on the pavement, whose foliage is above the heads of people."""
    rng = street.rng
    if rng.random() > 0.6 * green or pavement < 1.0:
        return
    s, away = low + rng.uniform(0.0, 8.0), rng.uniform(0.5, max(0.6, pavement - 0.3))
    gap = rng.uniform(5.0, 13.0)
    while s < high:
        x, y, _ = street.on_strip(s, side * (street.edge(road, side) + away), road)
        if rng.random() < 0.85:
            _add_tree(street, x, y, rng.uniform(1.9, 2.8))
        s += gap * rng.uniform(0.8, 1.2)


def _add_retaining_walls(street: Street, pavement: float) -> None:
    """Add walls at the foot of steep banks."""
    rng = street.rng
    for side in (-1.0, 1.0):
        slope, rise = street.terrain[[BANK_SLOPE_LEFT, BANK_RISE_LEFT] if side > 0.0 else [BANK_SLOPE, BANK_RISE]]
        if slope < 0.25 or rise < 0.5 or rng.random() < 0.5:
            continue
        low = rng.uniform(-60.0, 10.0)
        border = _Border("wall", rng)
        border.height = rng.uniform(0.4, 0.9) * float(rise)
        for s in np.arange(low, low + rng.uniform(20.0, 80.0), 6.0).tolist():
            x, y, yaw = street.on_strip(s, side * (street.edge(0, side) + pavement + 0.2))
            street.add_static(border.rows(6.05, rng), x, y, 5.4, border.width, yaw, 0.1, of="Building")


def add_beside_people(street: Street, x: float, y: float, yaw: float) -> None:
    """Place something within reach of a person: a pole, a tree, a bicycle, a pram, a bin."""
    rng = street.rng
    turn, away = rng.uniform(0, 2 * math.pi), rng.uniform(0.55, 1.1)
    px, py = x + away * math.cos(turn), y + away * math.sin(turn)
    kind = rng.random()
    if kind < 0.55:
        rows, width = _POLES[int(rng.integers(0, len(_POLES)))](rng)
        street.add_static(rows, px, py, 0.1, min(width, 0.2), yaw, 0.2, of="Pole")
    elif kind < 0.7:
        _add_tree(street, px, py, 2.1)
    elif kind < 0.85:
        _add_furniture(street, px, py, yaw, "urban")
    elif kind < 0.95:
        px, py = x + 0.95 * math.cos(yaw), y + 0.95 * math.sin(yaw)
        street.add_static(pram(rng), px, py, 0.8, 0.4, yaw, -20.0, of="Pedestrian")
    else:
        street.add_static(bicycle(1.75, 0.27, rng), px, py, 1.7, 0.4, yaw, 0.1, of="Bicyclist")


def add_cafe(street: Street, share: float) -> None:
    """Place, with the probability ``share``, rows of tables beside the first road, people and empty chairs at them."""
    rng = street.rng
    if copy.deepcopy(rng).random() >= share:  # a copy: streets without tables stay as they were
        return
    side, gap = float(rng.choice([-1.0, 1.0])), rng.uniform(2.0, 2.6)
    first, u = rng.uniform(-12.0, 25.0), street.edge(0, side) + rng.uniform(1.6, 3.0)
    for k in range(int(rng.integers(2, 8)) * 2):  # two rows
        x, y, yaw = street.on_strip(first + (k // 2) * gap, side * (u + (k % 2) * gap))
        yaw += rng.uniform(-0.3, 0.3)
        if not street.free(x, y, 1.9, 1.9, yaw):
            continue
        high, wide = rng.uniform(0.7, 0.78), rng.uniform(0.55, 0.85)
        cover, kind = rng.uniform(0.2, 0.6), int(rng.choice([BOX, CYLINDER]))
        table = [block(MATTE, cover, (0, 0, high), (wide, wide, 0.04), kind=kind), post(0.3, 0.0, 0.0, high, 0.04)]
        if rng.random() < 0.2:  # a sunshade
            table += [
                post(0.4, 0, 0, 2.3, 0.025),
                block(MATTE, 0.5, (0, 0, 2.4), (2.4, 2.4, 0.4), taper=(0.9, 0.9, 0.9)),
            ]
        if not street.add_static(table, x, y, wide, wide, yaw, 0.9):
            continue
        for turn in (0.0, math.pi / 2, math.pi, -math.pi / 2):
            faces, away = yaw + turn + rng.normal(0.0, 0.15), wide / 2 + rng.uniform(0.25, 0.45)
            seat_x, seat_y = x - away * math.cos(faces), y - away * math.sin(faces)
            if rng.random() < 0.5:
                street.add_object("person_sitting", seat_x, seat_y, faces, force=True)
            elif rng.random() < 0.7:
                street.add_static(_chair(rng), seat_x, seat_y, 0.2, 0.2, faces, 0.3)


def _chair(rng: np.random.Generator) -> list[Row]:
    """An empty chair, to be sat on from the front (x)."""
    seat, cover = rng.uniform(0.42, 0.48), rng.uniform(0.15, 0.6)
    rows = [block(MATTE, cover, (0, 0, seat), (0.42, 0.42, 0.04))]
    rows += [post(cover, a * 0.18, b * 0.18, seat, 0.015) for a in (-1.0, 1.0) for b in (-1.0, 1.0)]
    return [*rows, block(POROUS, cover, (-0.2, 0, seat + 0.25), (0.04, 0.42, 0.4), density=rng.uniform(0.4, 1.0))]


def add_parked_bicycles(street: Street, mean: float) -> None:
    """Place bicycles without riders beside the first road, alone and in rows."""
    rng = street.rng
    for _ in range(int(rng.poisson(mean))):
        side = float(rng.choice([-1.0, 1.0]))
        s, u = rng.uniform(-20, 45), side * (street.edge(0, side) + rng.uniform(0.5, 3.0))
        x, y, yaw = street.on_strip(s, u)
        yaw += float(rng.choice([0.0, math.pi / 2])) + rng.normal(0, 0.1)
        rows: list[Row] = []
        n = int(rng.integers(1, 8))
        for k in range(n):
            rows += bicycle(rng.uniform(1.6, 1.85), 0.27, rng, (k - (n - 1) / 2) * 0.5)
        street.add_static(rows, x, y, 1.8, 0.5 * n, yaw, of="Bicyclist")


def add_islands_poles(street: Street) -> None:
    """Place signs and lights on the islands."""
    rng = street.rng
    for k in np.flatnonzero(street.strips[:, 9] < 0.0).tolist():
        first, last = street.strips[k, 7:9]
        for s in (first + 0.5, last - 0.5):
            x, y, yaw = street.on_strip(float(s), float(street.strips[k, 5:7].mean()), k)
            if rng.random() < 0.7:
                rows, width = (_sign, _bollard, _traffic_light)[int(rng.choice(3, p=[0.5, 0.3, 0.2]))](rng)
                street.add_static(rows, x, y, 0.2, min(width, 0.3), yaw, 0.1, of="Pole")
