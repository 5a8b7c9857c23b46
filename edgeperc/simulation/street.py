"""Parts of a street scene: ground, road strips, objects and roadside."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .raycast import (
    ASPHALT,
    BANK_RISE,
    BANK_SLOPE,
    BAY,
    CROWN,
    DITCH,
    DROPPED,
    FACADE,
    GRASS,
    KERB,
    LANE,
    LEAVES,
    LIP,
    MARKING,
    MATTE,
    PAVEMENT,
    PAVING,
    POROUS,
    RETRO,
    ROUGH,
    ROUNDING,
    ROW,
    SLOPE_X,
    SLOPE_Y,
    STRIP,
    TERRAIN,
    TILE,
    WAVE_X,
    WAVE_X_0,
    WAVE_X_K,
    WAVE_Y,
    WAVE_Y_0,
    WAVE_Y_K,
    WEAR,
    ground_at,
)
from .scene import Scene, SceneObject, wrapped
from .shapes import SHAPES, SIZES, Row, Vector, blob, block, rod

__all__ = [
    "IN_BAYS",
    "ROW_RANGE_M",
    "ROW_WIDTH_M",
    "Street",
    "add_roadside",
    "any_vehicle",
    "random_terrain",
    "strip_row",
]

# --- streets ----------------------------------------------------------------------------------------------------------


class Street:
    """Builds a scene: places objects on its roads and static shapes beside them, where the ground is free."""

    def __init__(self, rng: np.random.Generator, strips: list[Row], terrain: NDArray[np.float64]) -> None:
        self.rng = rng
        self.strips = np.array(strips, dtype=np.float64).reshape(-1, STRIP)
        self.terrain = terrain
        self.tile = _noise_tile(rng)
        self.objects: list[SceneObject] = []
        self.rows: list[Row] = []
        self.taken: list[tuple[float, float, float, float, float, float, float]] = []

    def scene(self) -> Scene:
        """Return the finished scene."""
        rows = np.array(self.rows, dtype=np.float64).reshape(-1, ROW)
        return Scene(tuple(self.objects), rows, self.strips, self.terrain, self.tile)

    def ground(self, x: float, y: float) -> tuple[float, float]:
        """Height of the ground and distance from the roads (negative on a road) at x, y [m]."""
        z, outside, _, _, _ = ground_at(self.strips, self.terrain, self.tile, float(x), float(y))
        return z, outside

    def edge(self, road: int, side: float) -> float:
        """Distance of a road's left (1) or right (-1) edge from its axis [m]; the first road includes its bays."""
        beside = self.strips[:, 9] > 0.0 if road == 0 else np.zeros(len(self.strips), np.bool_)
        beside[road] = True
        return float((side * self.strips[beside, 6 if side > 0 else 5]).max())

    def on_strip(self, s: float, u: float, strip: int = 0) -> Vector:
        """x, y [m] and direction [rad] of a strip at s along its axis and u to its left [m]."""
        x0, y0, cos, sin, curvature = self.strips[strip, :5]
        slope = curvature * s
        turn = math.atan(slope)
        a, b = s - u * math.sin(turn), 0.5 * slope * s + u * math.cos(turn)
        return x0 + cos * a - sin * b, y0 + sin * a + cos * b, math.atan2(sin, cos) + turn

    def free(self, x: float, y: float, length: float, width: float, yaw: float, gap: float = 0.25) -> bool:
        """Whether a rectangle, enlarged by ``gap`` [m], is free of occupied ground."""
        a, b = length / 2 + gap, width / 2 + gap
        cos, sin = math.cos(yaw), math.sin(yaw)
        reach = math.hypot(a, b)
        for x2, y2, cos2, sin2, a2, b2, reach2 in self.taken:
            dx, dy = x2 - x, y2 - y
            if dx * dx + dy * dy > (reach + reach2) ** 2:
                continue
            c, s = abs(cos * cos2 + sin * sin2), abs(cos * sin2 - sin * cos2)
            # Separating axes of two rectangles.
            if (
                abs(cos * dx + sin * dy) <= a + c * a2 + s * b2
                and abs(cos * dy - sin * dx) <= b + s * a2 + c * b2
                and abs(cos2 * dx + sin2 * dy) <= a2 + c * a + s * b
                and abs(cos2 * dy - sin2 * dx) <= b2 + s * a + c * b
            ):
                return False
        return True

    def take(self, x: float, y: float, length: float, width: float, yaw: float) -> None:
        """Mark the ground under an object as occupied."""
        a, b = length / 2, width / 2
        self.taken.append((x, y, math.cos(yaw), math.sin(yaw), a, b, math.hypot(a, b)))

    def add_object(
        self,
        label: str,
        x: float,
        y: float,
        yaw: float,
        size: Vector | None = None,
        speed_mps: float = 0.0,
        yaw_rate_rps: float = 0.0,
        *,
        force: bool = False,
    ) -> bool:
        """Place a labeled object if its ground is free, or always with ``force``. Return whether it was placed."""
        if size is None:
            mean, spread = SIZES[label]
            shift = np.clip(self.rng.normal(size=3), -2, 2)
            size = tuple(m + d * s for m, d, s in zip(mean, shift.tolist(), spread, strict=True))
        if not force and not self.free(x, y, size[0], size[1], yaw):
            return False
        self.take(x, y, size[0], size[1], yaw)
        index = float(len(self.objects))
        z, _ = self.ground(x, y)
        center = (float(x), float(y), float(z + size[2] / 2))
        size = (float(size[0]), float(size[1]), float(size[2]))
        self.objects.append(
            SceneObject(label, center, size, wrapped(float(yaw)), len(self.objects), float(speed_mps), yaw_rate_rps)
        )
        self.rows += [(*row[:-1], index) for row in SHAPES[label](size, self.rng)]
        return True

    def add_static(
        self, rows: list[Row], x: float, y: float, length: float, width: float, yaw: float, off_road: float = 0.1
    ) -> bool:
        """Place static shapes if the ground is free and off the roads. Return whether they were placed.

        ``rows`` are primitives in a frame at x, y on the ground, turned by ``yaw``.
        """
        cos, sin = math.cos(yaw), math.sin(yaw)
        steps = max(1, math.ceil(length / 4.0))
        for k in range(-steps, steps + 1):
            for side in (-0.5, 0.5):
                a, b = k / steps * length / 2, side * width
                if self.ground(x + cos * a - sin * b, y + sin * a + cos * b)[1] < off_road:
                    return False
        if not self.free(x, y, length, width, yaw, 0.1):
            return False
        self.take(x, y, length, width, yaw)
        z, _ = self.ground(x, y)
        for row in rows:
            cx, cy, cz = row[4:7]
            axes = []
            for i in (7, 10, 13):
                axes += [cos * row[i] - sin * row[i + 1], sin * row[i] + cos * row[i + 1], row[i + 2]]
            self.rows.append((*row[:4], x + cos * cx - sin * cy, y + sin * cx + cos * cy, z + cz, *axes, *row[16:]))
        return True

    # Roadside.

    def tree(self, x: float, y: float) -> bool:
        """Place a tree, if its ground is free."""
        rng = self.rng
        height, bole, radius = rng.uniform(4, 13), rng.uniform(1.4, 3.2), rng.uniform(0.07, 0.28)
        spread = rng.uniform(1.2, 3.4)
        rows = [rod(rng.uniform(0.25, 0.45), (0, 0, -0.3), (rng.normal(0, 0.1), rng.normal(0, 0.1), bole + 1), radius)]
        if rng.random() < 0.15:  # a conifer
            for level in np.linspace(0.6, height, 6):
                w = 2 * spread * (1.05 - level / height)
                rows.append(blob(LEAVES, 0.34, (0, 0, level), (w, w, height / 4), 1.6))
        else:
            leaf, density = rng.uniform(0.32, 0.46), rng.uniform(0.4, 1.6)
            for _ in range(int(rng.integers(5, 14))):
                turn, away = rng.uniform(0, 2 * math.pi), spread * math.sqrt(rng.random()) * 0.8
                level = rng.uniform(bole + 0.5, height)
                w = spread * rng.uniform(0.35, 1.1)
                center = (away * math.cos(turn), away * math.sin(turn), level)
                rows.append(blob(LEAVES, leaf, center, (w, w, 0.9 * w), density))
        return self.add_static(rows, x, y, 2 * radius, 2 * radius, 0.0, 0.35)

    def bush(self, x: float, y: float, size: float) -> bool:
        """Place a bush, if its ground is free."""
        rng = self.rng
        leaf = rng.uniform(0.3, 0.46)
        rows = []
        for _ in range(int(rng.integers(3, 10))):
            w, h = size * rng.uniform(0.2, 0.9), size * rng.uniform(0.3, 0.9)
            x_off, y_off = (rng.normal(0, 0.25, 2) * size).tolist()
            center = (x_off, y_off, 0.4 * h + rng.uniform(0.0, 0.4) * size)
            rows.append(blob(LEAVES, leaf, center, (w, w * rng.uniform(0.6, 1.4), h), rng.uniform(0.8, 5)))
        return self.add_static(rows, x, y, size * 0.8, size * 0.8, 0.0, 0.3)

    def pole(self, x: float, y: float, yaw: float) -> bool:
        """Place a lamp, sign, post or traffic light, if its ground is free."""
        rng = self.rng
        kind = rng.integers(0, 5)
        if kind == 0:  # a lamp
            rows = [rod(0.3, (0, 0, 0), (0, 0, rng.uniform(5, 9)), rng.uniform(0.06, 0.11))]
        elif kind <= 2:  # a traffic sign
            top = rng.uniform(2.0, 2.9)
            rows = [rod(0.3, (0, 0, 0), (0, 0, top + 0.3), 0.035)]
            edge = rng.uniform(0.45, 0.8)
            rows.append(block(RETRO, 0.99, (-0.05, 0, top), (0.03, edge, edge * rng.uniform(0.6, 1.5))))
        elif kind == 3:  # a bollard or reflector post
            rows = [rod(0.4, (0, 0, 0), (0, 0, rng.uniform(0.8, 1.1)), rng.uniform(0.05, 0.1))]
            rows.append(block(RETRO, 0.9, (-0.06, 0, 0.75), (0.05, 0.06, 0.15)))
        else:  # a cabinet, a bin or a post box
            h = rng.uniform(0.9, 1.5)
            size = (rng.uniform(0.3, 0.6), rng.uniform(0.4, 1.2), h)
            rows = [block(MATTE, rng.uniform(0.1, 0.6), (0, 0, h / 2), size)]
        return self.add_static(rows, x, y, 0.3, 0.4, yaw, 0.2)

    def building(self, x: float, y: float, yaw: float, length: float, depth: float) -> bool:
        """Place a building, if its ground is free."""
        rng = self.rng
        height, wall = rng.uniform(3.2, 11.0), rng.uniform(0.34, 0.55)
        rows = [
            block(FACADE, wall, (0, 0, height / 2 - 1), (length, depth, height + 2), density=rng.uniform(1.6, 3.4)),
            block(MATTE, 0.25, (0, 0, height + 1.3), (length + 0.5, depth + 0.7, 2.6), taper=(0.0, 0.0, 0.9)),
        ]
        for _ in range(int(rng.integers(0, 3))):  # porches, bays, steps
            w, h = rng.uniform(0.8, 2.5), rng.choice([0.4, 2.4, height])
            rows.append(
                block(MATTE, wall, (rng.uniform(-0.4, 0.4) * length, -rng.choice([-1, 1]) * depth / 2, h / 2),
                       (w, rng.uniform(0.6, 1.6), h))
            )  # fmt: skip
        return self.add_static(rows, x, y, length + 0.4, depth + 1.4, yaw, 0.8)

    def barrier(self, kind: str, x: float, y: float, yaw: float, length: float, off_road: float = 0.15) -> bool:
        """Place a hedge, wall, fence or guard rail, if its ground is free."""
        rng = self.rng
        if kind == "hedge":
            h, w = rng.uniform(0.9, 2.2), rng.uniform(0.5, 1.1)
            rows = [block(LEAVES, rng.uniform(0.32, 0.46), (0, 0, h / 2), (length, w, h), density=rng.uniform(4, 10))]
        elif kind == "wall":
            h, w = rng.uniform(0.5, 2.2), 0.25
            rows = [block(MATTE, rng.uniform(0.3, 0.5), (0, 0, h / 2 - 0.2), (length, w, h + 0.4))]
        elif kind == "rail":
            h, w = 0.75, 0.12
            rows = [block(MATTE, 0.35, (0, 0, 0.6), (length, 0.08, 0.3))]
            posts = np.arange(-length / 2, length / 2, 4.0)
            rows += [block(MATTE, 0.35, (a, -0.08, 0.35), (0.06, 0.1, 0.7)) for a in posts]
        else:
            h, w = rng.uniform(0.9, 1.8), 0.06
            rows = [block(POROUS, 0.3, (0, 0, h / 2), (length, 0.04, h), density=rng.uniform(0.2, 0.7))]
            rows += [rod(0.3, (a, 0, 0), (a, 0, h + 0.05), 0.04) for a in np.arange(-length / 2, length / 2, 2.5)]
        return self.add_static(rows, x, y, length, w, yaw, off_road)


def _noise_tile(rng: np.random.Generator) -> NDArray[np.float64]:
    # Three periodic octaves: full, half and eighth resolution.
    tile = rng.uniform(-1.0, 1.0, (TILE, TILE))
    for scale in (2, 8):
        coarse = rng.uniform(-1.0, 1.0, (TILE // scale, TILE // scale))
        smooth = np.repeat(np.repeat(coarse, scale, axis=0), scale, axis=1)
        for axis in (0, 1):
            smooth = sum((np.roll(smooth, k, axis) for k in range(scale)), np.zeros_like(smooth)) / scale
        tile = tile + smooth * (1.0 if scale == 2 else 1.6)
    return np.ascontiguousarray(np.clip(tile / 2.2, -1.0, 1.0))


def random_terrain(rng: np.random.Generator, environment: str) -> NDArray[np.float64]:
    """Draw the terrain of an environment: slopes, waves, kerbs, banks, remissions."""
    terrain = np.zeros(TERRAIN)
    open_land = environment in ("rural", "highway")
    terrain[[SLOPE_X, SLOPE_Y]] = rng.normal(0.0, 0.008, 2)
    terrain[[WAVE_X, WAVE_Y]] = rng.uniform(0.0, 0.25 if open_land else 0.12, 2)
    terrain[[WAVE_X_K, WAVE_Y_K]] = 2.0 * math.pi / rng.uniform(45.0, 140.0, 2)
    # Waves that are zero at the origin.
    terrain[[WAVE_X_0, WAVE_Y_0]] = rng.choice([0.0, math.pi], 2)
    terrain[CROWN] = rng.uniform(0.0, 0.025)
    terrain[KERB] = 0.0 if open_land else rng.choice([0.03, 0.08, 0.12, 0.15, 0.18], p=[0.15, 0.2, 0.3, 0.25, 0.1])
    terrain[PAVEMENT] = rng.uniform(0.0, 0.7) if open_land else rng.uniform(1.2, 4.5)
    terrain[BANK_SLOPE] = abs(rng.normal(0.0, 0.12 if open_land else 0.03))
    terrain[BANK_RISE] = rng.uniform(0.2, 1.6) * (1.0 if rng.random() < 0.65 else -1.0)
    terrain[ROUGH] = rng.uniform(0.02, 0.12) if open_land else rng.uniform(0.01, 0.06)
    terrain[DITCH] = rng.uniform(0.0, 0.5) if open_land and rng.random() < 0.5 else 0.0
    terrain[ROUNDING] = rng.uniform(3.0, 9.0)
    # Measured: asphalt 0.2..0.3 by road, pavement and parking 0.30, grass 0.37.
    terrain[ASPHALT] = rng.uniform(0.19, 0.33)
    terrain[PAVING] = rng.uniform(0.24, 0.36)
    terrain[GRASS] = rng.uniform(0.33, 0.45)
    terrain[MARKING] = rng.uniform(0.35, 0.6) if rng.random() < (0.9 if open_land else 0.55) else 0.0
    terrain[LANE] = 3.4
    terrain[DROPPED] = rng.uniform(0.0, 23.0)
    terrain[WEAR] = rng.uniform(0.1, 0.35)
    # Parking bays are paved like the pavement, or have the road's asphalt.
    terrain[LIP] = rng.uniform(0.0, 0.04)
    terrain[BAY] = terrain[PAVING if rng.random() < 0.5 else ASPHALT]
    return terrain


def strip_row(
    x: float, y: float, yaw: float, curvature: float, right: float, left: float,
    s_range: tuple[float, float] = (-200.0, 200.0), bay: bool = False,
) -> Row:  # fmt: skip
    """Make the row of a road strip or a bay for the kernels."""
    return (x, y, math.cos(yaw), math.sin(yaw), curvature, right, left, *s_range, float(bay))


# Width of a parking row, and the probability that it is a bay rather than road (SemanticKITTI labels both).
ROW_WIDTH_M = 2.1
ROW_RANGE_M = (-70.0, 78.0)
IN_BAYS = 0.75


def any_vehicle(rng: np.random.Generator, trucks: float) -> str:
    """Draw a class of vehicle, with a given share of trucks."""
    return str(rng.choice(["car", "van", "truck"], p=[0.84 - trucks, 0.16, trucks]))


def add_roadside(street: Street, place: str) -> None:
    """Add the roadside: buildings, borders, trees, bushes and poles."""
    rng = street.rng
    pavement = float(street.terrain[PAVEMENT])
    built = {"urban": 0.85, "residential": 0.65, "junction": 0.6, "rural": 0.06, "highway": 0.0}[place]
    built *= rng.uniform(0.3, 1.1)
    n_roads = int(np.count_nonzero(street.strips[:, 9] == 0.0))
    for k in range(n_roads):
        for side in (-1.0, 1.0):
            edge = street.edge(k, side)
            setback = pavement + (rng.uniform(0.1, 7.0) if place == "urban" else rng.uniform(3.0, 16.0))
            border = str(rng.choice(["hedge", "wall", "fence", "none"], p=[0.3, 0.2, 0.2, 0.3]))
            if place == "highway":
                border = "rail"
            green = {"urban": 0.35, "residential": 1.0, "junction": 0.6, "rural": 1.4, "highway": 0.8}[place]
            green *= rng.uniform(0.2, 1.8)
            low, high = max(-85.0, street.strips[k, 7]), min(85.0, street.strips[k, 8])
            s = low
            while s < high:
                if rng.random() < built:
                    length, depth = rng.uniform(7.0, 22.0), rng.uniform(6.0, 11.0)
                    u = side * (edge + setback + depth / 2 + rng.normal(0, 0.3))
                    x, y, yaw = street.on_strip(s + length / 2, u, k)
                    street.building(x, y, yaw, length, depth)
                    s += length + (0.3 if rng.random() < 0.6 else rng.uniform(2.0, 9.0))
                else:
                    s += rng.uniform(5.0, 15.0)
            if border != "none":
                u = side * (edge + (pavement + 0.4 if border != "rail" else max(0.6, pavement)))
                s = low
                while s < high:
                    length = 8.0 if border == "rail" else float(rng.uniform(3.0, 11.0))
                    x, y, yaw = street.on_strip(s + length / 2, u, k)
                    if border == "rail" or rng.random() < 0.6:
                        street.barrier(border, x, y, yaw, length)
                    s += length
            for _ in range(int(rng.poisson(14 * green))):
                away = pavement + abs(rng.normal(0.3, 6.0)) if place != "urban" else rng.uniform(0.5, pavement + 1)
                x, y, _ = street.on_strip(rng.uniform(low, high), side * (edge + away + 0.4), k)
                street.tree(x, y)
            for _ in range(int(rng.poisson(22 * green))):
                away = pavement + abs(rng.normal(0.0, 7.0))
                x, y, _ = street.on_strip(rng.uniform(low, high), side * (edge + away + 0.5), k)
                street.bush(x, y, rng.uniform(0.4, 3.0))
            for _ in range(int(rng.poisson(9 if place != "rural" else 3))):
                u = side * (edge + rng.uniform(0.3, max(pavement, 1.0)))
                x, y, yaw = street.on_strip(rng.uniform(low, high), u, k)
                street.pole(x, y, yaw + (0.0 if side < 0 else math.pi))
    for _ in range(int(rng.integers(15, 50))):  # the background
        turn, away = rng.uniform(0, 2 * math.pi), rng.uniform(25.0, 75.0)
        x, y = away * math.cos(turn), away * math.sin(turn)
        if rng.random() < 0.25 and built > 0.0:
            street.building(x, y, turn, rng.uniform(8, 20), rng.uniform(8, 14))
        else:
            street.tree(x, y)
