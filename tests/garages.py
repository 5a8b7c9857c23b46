"""Simulated places with walls and a ceiling: parking garages, depots, the small garages of a house, and rooms."""

from __future__ import annotations

import math

import numpy as np

from edgeperc.simulation import simulate
from edgeperc.simulation.raycast import ASPHALT, BOX, MATTE, ROUGH, ROUNDING, TERRAIN
from edgeperc.simulation.scene import SimulatedScan, sensor_pose
from edgeperc.simulation.shapes import Row, Vector, block, rod
from edgeperc.simulation.street import Street, strip_row
from edgeperc.types.sensor import get_sensor


def _flat(rng: np.random.Generator) -> Street:
    terrain = np.zeros(TERRAIN)
    terrain[[ASPHALT, ROUGH, ROUNDING]] = rng.uniform(0.1, 0.35), 0.02, 5.0
    return Street(rng, [strip_row(0, 0, 0, 0, -200, 200)], terrain)


def _slab(remission: float, low: Vector, high: Vector, width: float) -> Row:
    """A ramp from the middle of its low edge to that of its high edge, 0.3 m thick."""
    along = np.subtract(high, low)
    length = float(np.linalg.norm(along))
    a = along / length
    b = np.array([-a[1], a[0], 0.0]) / math.hypot(a[0], a[1])
    axes = np.concatenate([a * 2.0 / length, b * 2.0 / width, np.cross(a, b) * 2.0 / 0.3]).tolist()
    middle = (np.add(low, high) / 2.0).tolist()
    return (BOX, MATTE, remission, 1.0, *middle, *axes, 0.0, 0.0, 0.0, -1.0)


def _add_walls(street: Street, size: Vector, open_side: int | None, parapet_m: float) -> None:
    """Walls and a ceiling about the origin; one side may be open (a gate), all may end at a parapet."""
    (length, width, height), paint = size, float(street.rng.uniform(0.15, 0.6))
    for side, (x, y, a, b) in enumerate(
        [
            (length / 2, 0, 0.2, width),
            (-length / 2, 0, 0.2, width),
            (0, width / 2, length, 0.2),
            (0, -width / 2, length, 0.2),
        ]
    ):
        if side != open_side:
            high = parapet_m or height
            street.rows.append(block(MATTE, paint, (x, y, high / 2), (a, b, high)))
    street.rows.append(block(MATTE, paint, (0, 0, height + 0.15), (length, width, 0.3)))


def parking_garage(seed: int, sensor: str) -> SimulatedScan:
    """A garage with a ceiling at 2.2 to 3.5 m, or a depot with one at 4.5 to 7 m: pillars, beams, pipes, a ramp, and
    vehicles in rows, or none.
    """
    rng = np.random.default_rng((seed, 5))
    street, is_depot, share = _flat(rng), rng.random() < 0.25, float(rng.choice([0.0, 0.15, 0.5]))
    length, width = float(rng.uniform(16, 60)), float(rng.uniform(14, 40))
    height = float(rng.uniform(4.5, 7.0) if is_depot else rng.uniform(2.2, 3.5))
    gate = int(rng.integers(0, 4)) if rng.random() < 0.3 else None
    _add_walls(street, (length, width, height), gate, 1.1 if rng.random() < 0.2 else 0.0)
    paint, middle = float(rng.uniform(0.15, 0.6)), float(rng.uniform(-0.8, 0.8))
    place = (float(rng.uniform(-0.5, 0.5) * (length - 6.0)), middle, float(rng.normal(0.0, 0.05)))
    street.take(place[0], middle, 5.0, 2.4, 0.0)
    aisle, step = float(rng.uniform(15.5, 17.5)), float(rng.choice([2.6, 5.2, 7.8]))  # with a row to both sides
    for y in np.arange(-3.0, 3.1) * aisle + middle:
        for side in (-1.0, 1.0):
            edge, row = y + side * aisle / 2, y + side * (aisle / 2 - 2.7)
            if side > 0.0 and abs(edge) < width / 2 - 0.5:
                street.rows.append(block(MATTE, paint, (0, edge, height - 0.25), (length, 0.4, 0.5)))  # a beam
            for x in np.arange(-length / 2 + 2.0, length / 2 - 1.5, step).tolist():
                size = rng.uniform(0.3, 0.8, 2).tolist()
                if abs(edge) < width / 2 - 0.5 and rng.random() < 0.3:
                    street.rows.append(block(MATTE, paint, (x, edge, height / 2), (*size, height)))
                    street.take(x, edge, *size, 0.0)
            for x in np.arange(-length / 2 + 2.0, length / 2 - 2.0, 2.6).tolist():
                if abs(row) < width / 2 - 2.7 and rng.random() < share:
                    label = "van" if height > 3.0 and rng.random() < 0.1 else "car"
                    street.add_object(label, x, row, side * math.pi / 2 + math.pi * (rng.random() < 0.5))
    for _ in range(int(rng.integers(0, 6))):  # pipes and ducts
        y, z = float(rng.uniform(-0.45, 0.45) * width), height - float(rng.uniform(0.1, 0.5))
        street.rows.append(rod(0.4, (-length / 2, y, z), (length / 2, y, z), float(rng.uniform(0.04, 0.25))))
    y = float(rng.choice([-1, 1]) * (width / 2 - 2.2))
    if rng.random() < 0.5 and street.free(0.0, y, 16.0, 3.6, 0.0):
        street.rows.append(_slab(0.25, (-8.0, y, -0.1), (8.0, y, height), 3.6))
    return _from(street, sensor, place, height, seed)


def _from(street: Street, sensor: str, place: Vector, height: float, seed: int) -> SimulatedScan:
    """The scan of a sensor on a vehicle at x, y and a yaw below a ceiling."""
    rng, scene = street.rng, street.scene()
    pitch, roll = rng.normal(0.0, 0.005, 2).tolist()
    x, y, yaw = place
    pose = sensor_pose(scene, sensor, x, y, yaw=yaw, pitch=pitch, roll=roll)
    pose[2, 3] = scene.ground_height(x, y) + min(get_sensor(sensor).mount_height_m, height - 0.3)
    return simulate(scene, sensor, seed, pose, ego_shadow=bool(rng.random() < 0.5))


def small_garage(seed: int, sensor: str) -> SimulatedScan:
    """A garage for one to four cars, 5.2 to 8 m deep: shelves and things along its walls, a car or none beside."""
    rng = np.random.default_rng((seed, 11))
    street = _flat(rng)
    bays = int(rng.choice([1, 2, 3, 4], p=[0.3, 0.4, 0.2, 0.1]))
    length, width, height = (
        float(rng.uniform(5.6, 8.5)),
        float(bays * rng.uniform(2.7, 3.2) + 0.5),
        float(rng.uniform(2.1, 2.9)),
    )
    _add_walls(street, (length, width, height), 0 if rng.random() < 0.5 else None, 0.0)
    bay = width / bays
    place = (
        float(rng.uniform(-0.3, 0.6)),
        (int(rng.integers(0, bays)) + 0.5) * bay - width / 2,
        float(rng.normal(0.0, 0.03)),
    )
    street.take(*place[:2], 4.6, 1.9, 0.0)
    for k in range(bays):
        if rng.random() < 0.6:
            street.add_object(
                "car", float(rng.uniform(-0.3, 0.3)), (k + 0.5) * bay - width / 2, math.pi * (rng.random() < 0.5)
            )
    for _ in range(int(rng.integers(2, 9))):
        a, b, c = (
            float(rng.uniform(0.3, 1.6)),
            float(rng.uniform(0.25, 0.6)),
            float(rng.uniform(0.3, min(2.0, height - 0.2))),
        )
        x, y, yaw = float(rng.uniform(-0.45, 0.45) * length), float(rng.choice([-1, 1]) * (width / 2 - 0.35)), 0.0
        if rng.random() < 0.4:
            x, y, yaw = -length / 2 + 0.4, float(rng.uniform(-0.45, 0.45) * width), math.pi / 2
        if street.free(x, y, a, b, yaw, 0.0):
            street.take(x, y, a, b, yaw)
            street.rows.append(block(MATTE, float(rng.uniform(0.1, 0.6)), (x, y, c / 2), (a, b, c), yaw=yaw))
    if rng.random() < 0.5:  # a beam or the rail of the gate
        street.rows.append(
            block(MATTE, 0.3, (float(rng.uniform(-0.3, 0.3)) * length, 0, height - 0.15), (0.25, width, 0.3))
        )
    return _from(street, sensor, place, height, seed)


def furnished_room(seed: int, sensor: str) -> SimulatedScan:
    """An office or a living room: tables, cupboards, chairs; the sensor on a tripod, a robot or a table."""
    rng = np.random.default_rng((seed, 13))
    street = _flat(rng)
    length, width, height = float(rng.uniform(4.0, 14.0)), float(rng.uniform(3.5, 9.0)), float(rng.uniform(2.3, 3.3))
    _add_walls(street, (length, width, height), None, 0.0)
    place = (
        float(rng.uniform(-0.3, 0.3) * length),
        float(rng.uniform(-0.3, 0.3) * width),
        float(rng.uniform(-math.pi, math.pi)),
    )
    high = float(rng.choice([rng.uniform(0.25, 0.7), rng.uniform(0.9, 1.3), rng.uniform(1.3, 1.8)]))
    street.take(*place[:2], 0.8, 0.8, 0.0)
    for _ in range(int(length * width / 5.0)):
        what = int(rng.integers(0, 3))
        x, y, yaw = (
            float(rng.uniform(-0.45, 0.45) * length),
            float(rng.uniform(-0.45, 0.45) * width),
            float(rng.choice([0.0, math.pi / 2])),
        )
        if what == 0:  # a table on four legs
            a, b, c = float(rng.uniform(1.0, 2.0)), float(rng.uniform(0.6, 1.0)), 0.73
            rows = [block(MATTE, 0.4, (x, y, c), (a, b, 0.05), yaw=yaw)]
            rows += [
                block(
                    MATTE,
                    0.3,
                    (x + i * 0.4 * (a if yaw == 0 else b), y + j * 0.4 * (b if yaw == 0 else a), c / 2),
                    (0.05, 0.05, c),
                )
                for i in (-1, 1)
                for j in (-1, 1)
            ]
        elif what == 1:  # a cupboard
            a, b, c = float(rng.uniform(0.6, 2.0)), float(rng.uniform(0.35, 0.6)), float(rng.uniform(0.8, 2.1))
            y = float(rng.choice([-1, 1]) * (width / 2 - 0.35))
            yaw = 0.0
            rows = [block(MATTE, 0.4, (x, y, c / 2), (a, b, c))]
        else:  # a chair
            a, b, c = 0.5, 0.5, 0.95
            rows = [
                block(MATTE, 0.3, (x, y, 0.45), (0.48, 0.48, 0.08)),
                block(MATTE, 0.3, (x + 0.22, y, 0.7), (0.05, 0.48, 0.5)),
                rod(0.2, (x, y, 0.0), (x, y, 0.45), 0.04),
            ]
        if street.free(x, y, a, b, yaw, 0.0):
            street.take(x, y, a, b, yaw)
            street.rows += rows
    scene = street.scene()
    pose = sensor_pose(scene, sensor, *place[:2], yaw=place[2])
    pose[2, 3] = scene.ground_height(*place[:2]) + high
    return simulate(scene, sensor, seed, pose, ego_shadow=False)


def truck_depot(seed: int, sensor: str) -> SimulatedScan:
    """A hall with a ceiling at 4.2 to 7 m, and trucks and buses in rows."""
    rng = np.random.default_rng((seed, 17))
    street = _flat(rng)
    length, width, height = float(rng.uniform(30, 70)), float(rng.uniform(18, 40)), float(rng.uniform(4.2, 7.0))
    _add_walls(street, (length, width, height), int(rng.integers(0, 4)) if rng.random() < 0.5 else None, 0.0)
    place = (float(rng.uniform(-0.3, 0.3) * length), float(rng.uniform(-1.0, 1.0)), float(rng.normal(0.0, 0.05)))
    street.take(place[0], place[1], 5.0, 2.4, 0.0)
    for y in np.arange(-3.0, 3.1).tolist():
        for x in np.arange(-length / 2 + 7.0, length / 2 - 7.0, 13.0).tolist():
            if abs(y * 5.5) < width / 2 - 2.5 and rng.random() < 0.4:
                street.add_object("truck", x, y * 5.5, math.pi * (rng.random() < 0.5))
    for x in np.arange(-length / 2 + 3.0, length / 2 - 3.0, float(rng.uniform(5.0, 8.0))).tolist():  # beams of the roof
        street.rows.append(block(MATTE, 0.3, (x, 0, height - 0.2), (0.25, width, 0.4)))
    return _from(street, sensor, place, height, seed)
