"""The primitives that objects are made of: boxes, ellipsoids and cylinders."""

from __future__ import annotations

import math

from .raycast import BOX, CYLINDER, ELLIPSOID, MATTE

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


def post(remission: float, x: float, y: float, height: float, radius: float) -> Row:
    """Make an upright cylinder that stands 0.2 m in the ground."""
    return rod(remission, (x, y, -0.2), (x, y, height), radius)
