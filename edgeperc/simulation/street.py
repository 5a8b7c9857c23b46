"""Parts of a street scene: ground, road strips and labeled objects."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..types.choices import VEHICLES
from ..types.geometry import wrapped
from ..types.points import Floats
from . import raycast
from .people import cyclist, pedestrian, person_sitting
from .raycast import Ground, ground_at
from .scene import Scene, SceneObject
from .shapes import Row, Vector
from .vehicles import bus, car, misc, truck, van

SHAPES: dict[str, Callable[[Vector, np.random.Generator], list[Row]]] = {
    "car": car,
    "van": van,
    "truck": truck,
    "tram": bus,
    "misc": misc,
    "pedestrian": pedestrian,
    "person_sitting": person_sitting,
    "cyclist": cyclist,
}

# Mean and spread of length, width, height: KITTI labels. Limits are two spreads.
SIZES: dict[str, tuple[Vector, Vector]] = {
    "car": ((3.9, 1.63, 1.52), (0.42, 0.1, 0.13)),
    "van": ((5.0, 1.9, 2.18), (0.7, 0.13, 0.3)),
    "truck": ((10.0, 2.6, 3.2), (2.8, 0.15, 0.4)),
    "tram": ((24.0, 2.5, 3.5), (5.0, 0.1, 0.15)),
    "misc": ((3.6, 1.7, 1.8), (0.9, 0.2, 0.4)),
    "pedestrian": ((0.84, 0.66, 1.74), (0.22, 0.13, 0.11)),
    "person_sitting": ((0.72, 0.6, 1.26), (0.1, 0.06, 0.05)),
    "cyclist": ((1.76, 0.62, 1.74), (0.12, 0.1, 0.08)),
}


CAMERA_CLASSES = (
    "Sky",
    "Building",
    "Pole",
    "Road",
    "Pavement",
    "Tree",
    "SignSymbol",
    "Fence",
    "Car",
    "Pedestrian",
    "Bicyclist",
)
"""CamVid's eleven classes of images, in their usual order."""
_SIGN = -2.0 - CAMERA_CLASSES.index("SignSymbol")


class Street:
    """Builds a scene: places objects on its roads and static shapes beside them, where the ground is free."""

    def __init__(self, rng: np.random.Generator, strips: list[Row], terrain: Floats) -> None:
        self.rng = rng
        self.strips = np.array(strips, dtype=np.float64).reshape(-1, raycast.STRIP)
        self.terrain = terrain
        self.tile = _noise_tile(rng)
        self.objects: list[SceneObject] = []
        self.rows: list[Row] = []
        self.taken: list[tuple[float, float, float, float, float, float, float]] = []

    def scene(self) -> Scene:
        """Return the finished scene."""
        rows = np.array(self.rows, dtype=np.float64).reshape(-1, raycast.ROW)
        return Scene(tuple(self.objects), rows, self.strips, self.terrain, self.tile)

    def ground(self, x: float, y: float) -> tuple[float, float]:
        """Height of the ground and distance from the roads (negative on a road) at x, y [m]."""
        z, outside, _, _, _ = ground_at(Ground(self.strips, self.terrain, self.tile), float(x), float(y))
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
        self,
        rows: list[Row],
        x: float,
        y: float,
        length: float,
        width: float,
        yaw: float,
        off_road: float = 0.1,
        *,
        of: str = "",
    ) -> bool:
        """Place static shapes if the ground is free and off the roads; return whether they were placed.

        ``rows`` are primitives in a frame at x, y on the lowest ground below them, turned by ``yaw``. ``of`` is their
        class in a camera's image (`CAMERA_CLASSES`), empty for none; retroreflectors on poles are signs.
        """
        number = -2.0 - CAMERA_CLASSES.index(of) if of else -1.0
        cos, sin = math.cos(yaw), math.sin(yaw)
        z, outside = self.ground(x, y)
        if outside < off_road:
            return False
        steps = max(1, math.ceil(length / 4.0))
        for k in range(-steps, steps + 1):
            for side in (-0.5, 0.5):
                a, b = k / steps * length / 2, side * width
                low, outside = self.ground(x + cos * a - sin * b, y + sin * a + cos * b)
                if outside < off_road:
                    return False
                z = min(z, low)
        if not self.free(x, y, length, width, yaw, 0.1):
            return False
        self.take(x, y, length, width, yaw)
        for row in rows:
            cx, cy, cz = row[4:7]
            axes = []
            for i in (7, 10, 13):
                axes += [cos * row[i] - sin * row[i + 1], sin * row[i] + cos * row[i + 1], row[i + 2]]
            mine = _SIGN if of == "Pole" and row[1] == raycast.RETRO else number
            where = (x + cos * cx - sin * cy, y + sin * cx + cos * cy, z + cz)
            self.rows.append((*row[:4], *where, *axes, *row[16:19], mine))
        return True


def _noise_tile(rng: np.random.Generator) -> Floats:
    # Three periodic octaves: full, half and eighth resolution.
    tile = rng.uniform(-1.0, 1.0, (raycast.TILE, raycast.TILE))
    for scale in (2, 8):
        coarse = rng.uniform(-1.0, 1.0, (raycast.TILE // scale, raycast.TILE // scale))
        smooth = np.repeat(np.repeat(coarse, scale, axis=0), scale, axis=1)
        for axis in (0, 1):
            smooth = sum((np.roll(smooth, k, axis) for k in range(scale)), np.zeros_like(smooth)) / scale
        tile = tile + smooth * (1.0 if scale == 2 else 1.6)
    return np.ascontiguousarray(np.clip(tile / 2.2, -1.0, 1.0))


def random_terrain(rng: np.random.Generator, environment: str) -> Floats:
    """Draw the terrain of an environment: slopes, waves, kerbs, banks, remissions."""
    terrain = np.zeros(raycast.TERRAIN)
    open_land = environment in ("rural", "highway")
    terrain[[raycast.SLOPE_X, raycast.SLOPE_Y]] = rng.normal(0.0, 0.005, 2)
    # Measured: the road 22 to 45 m ahead is 0.08 m (median) and 0.24 m (90 %) off the plane of the road nearby. Most
    # waves have a crest or a trough at the origin, because the vehicle stands level on the road.
    high = 0.6 if open_land else 0.45
    terrain[[raycast.WAVE_X, raycast.WAVE_Y]] = rng.uniform(0.0, high), rng.uniform(0.0, high / 2)
    terrain[[raycast.WAVE_X_K, raycast.WAVE_Y_K]] = 2.0 * math.pi / rng.uniform(60.0, 130.0, 2)
    terrain[[raycast.WAVE_X_0, raycast.WAVE_Y_0]] = (rng.choice([-0.5, 0.5], 2) + rng.normal(0.0, 0.08, 2)) * math.pi
    terrain[raycast.CROWN] = rng.uniform(0.0, 0.035)
    if not open_land:
        terrain[raycast.KERB] = rng.choice([0.03, 0.08, 0.12, 0.15, 0.18], p=[0.15, 0.2, 0.3, 0.25, 0.1])
    terrain[raycast.PAVEMENT] = rng.uniform(0.0, 0.7) if open_land else rng.uniform(1.2, 4.5)
    # Measured: the ground 9 to 13 m beside the road is 0.25 m (median) and 1.0 m (90 %) above or below its plane.
    for slope, rise in ((raycast.BANK_SLOPE, raycast.BANK_RISE), (raycast.BANK_SLOPE_LEFT, raycast.BANK_RISE_LEFT)):
        steep = rng.random() < (0.4 if open_land else 0.25)
        terrain[slope] = rng.uniform(0.15, 0.7) if steep else abs(rng.normal(0.0, 0.1 if open_land else 0.05))
        terrain[rise] = rng.uniform(0.2, 2.2) * (1.0 if rng.random() < 0.75 else -0.6)
    terrain[raycast.ROUGH] = (
        rng.uniform(0.02, 0.2) if open_land else rng.choice([0.03, 0.06, 0.15]) * rng.uniform(0.3, 1.0)
    )
    terrain[raycast.DITCH] = rng.uniform(0.0, 0.5) if open_land and rng.random() < 0.5 else 0.0
    terrain[raycast.ROUNDING] = rng.uniform(3.0, 9.0)
    # Measured: asphalt 0.2..0.3 by road, pavement and parking 0.30, grass 0.37.
    terrain[raycast.ASPHALT] = rng.uniform(0.19, 0.33)
    terrain[raycast.PAVING] = rng.uniform(0.24, 0.36)
    terrain[raycast.GRASS] = rng.uniform(0.33, 0.45)
    terrain[raycast.MARKING] = rng.uniform(0.35, 0.6) if rng.random() < (0.9 if open_land else 0.55) else 0.0
    terrain[raycast.LANE] = 3.4
    terrain[raycast.DROPPED] = rng.uniform(0.0, 23.0)
    terrain[raycast.WEAR] = rng.uniform(0.1, 0.35)
    # Parking bays are paved like the pavement, or have the road's asphalt.
    terrain[raycast.LIP] = rng.uniform(0.0, 0.04)
    terrain[raycast.BAY] = terrain[raycast.PAVING if rng.random() < 0.5 else raycast.ASPHALT]
    return terrain


def strip_row(
    x: float, y: float, yaw: float, curvature: float, right: float, left: float,
    s_range: tuple[float, float] = (-200.0, 200.0), bay: bool = False, island: bool = False,
) -> Row:  # fmt: skip
    """Make the row of a road strip, a bay or an island for the kernels."""
    return (x, y, math.cos(yaw), math.sin(yaw), curvature, right, left, *s_range, -1.0 if island else float(bay))


# Width of a parking row, and the probability that it is a bay rather than road (SemanticKITTI labels both).
ROW_WIDTH_M = 2.1
ROW_RANGE_M = (-70.0, 78.0)
IN_BAYS = 0.75


def any_vehicle(rng: np.random.Generator, trucks: float) -> str:
    """Draw a class of vehicle, with a given share of trucks."""
    return str(rng.choice(VEHICLES, p=[0.84 - trucks, 0.16, trucks]))
