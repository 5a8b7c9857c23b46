"""A camera in the simulated street: classes, depths and a drawn picture, by the ray casting of the LiDAR."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..camera.calibration import Calibration
from ..errors import CalibrationError
from ..types.choices import VEHICLES
from ..types.points import Bytes, Floats, Floats32, Labels
from .raycast import FACADE, GLASS, LEAVES, PAINT, RETRO, Hits, Rays, fill_cast
from .scene import NUMBERS, Scene, SimulatedScan, place_shapes
from .street import CAMERA_CLASSES

__all__ = ["CAMERA_CLASSES", "VOID", "CameraImage", "forward_camera", "render", "surface_classes", "true_classes"]

VOID = 255
"""No class: benches, bins and other shapes that CamVid counts to none of its eleven classes."""

MOST_TILT_DEG = 20.0  # the search for the ground needs a camera that is nearly upright
_SECTORS = 1440
# From the camera's frame (x right, y down, z ahead) to that of the rays (x ahead, y left, z up).
_AHEAD = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_SKY, _ROAD, _PAVEMENT, _TREE = (CAMERA_CLASSES.index(name) for name in ("Sky", "Road", "Pavement", "Tree"))
_OF_GROUND = np.array([_ROAD, _PAVEMENT, _TREE], np.uint8)  # CamVid counts grass as trees
_OF_OBJECT = {
    **dict.fromkeys((*VEHICLES, "tram", "misc"), CAMERA_CLASSES.index("Car")),
    **dict.fromkeys(("pedestrian", "person_sitting"), CAMERA_CLASSES.index("Pedestrian")),
    "cyclist": CAMERA_CLASSES.index("Bicyclist"),
}


@dataclass(frozen=True, slots=True, eq=False)
class CameraImage:
    """What a camera sees of a simulated street, and the truth.

    Attributes
    ----------
    rgb : (height, width, 3) uint8
        A drawn picture: one color for each surface, shaded, with noise. It is no photograph.
    labels : (height, width) uint8
        True class of each pixel: index into `CAMERA_CLASSES`, `VOID` for none.
    depth_m : (height, width) float32
        Distance along the optical axis [m]; infinite for the sky.
    """

    rgb: Bytes
    labels: Labels
    depth_m: Floats32


def forward_camera(
    width: int = 960, height: int = 720, *, fov_deg: float = 60.0, at_m: tuple[float, float, float] = (0.27, 0.0, -0.08)
) -> Calibration:
    """Make the calibration of a camera that looks ahead.

    Parameters
    ----------
    width, height : int
        Size of the image [px].
    fov_deg : float
        Horizontal field of view [deg].
    at_m : tuple of 3 float
        Place of the camera in the frame of the LiDAR: x ahead, y left, z up [m]. By default as on KITTI's car.
    """
    NUMBERS.number("fov_deg", fov_deg, 1.0, 179.0)
    NUMBERS.numbers("at_m", at_m, 3)
    focal = width / (2.0 * math.tan(math.radians(fov_deg) / 2.0))
    K = np.array([[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]])
    T_camera_sensor = _AHEAD.T.copy()
    T_camera_sensor[:3, 3] = -T_camera_sensor[:3, :3] @ at_m
    return Calibration(K, T_camera_sensor, width, height)


def render(
    scene: Scene, calibration: Calibration, T_world_sensor: ArrayLike, seed: int, *, max_range_m: float = 250.0
) -> CameraImage:
    """Render what the camera sees.

    Parameters
    ----------
    scene : Scene
    calibration : Calibration
        Of the camera and the LiDAR whose pose is given.
    T_world_sensor : (4, 4) array_like
        Pose of the LiDAR (`SimulatedScan.T_world_sensor`).
    seed : int
        Seed of leaves, colors and noise. The result is the same bit for bit for the same seed.
    max_range_m : float
        Length of the rays [m]. Farther surfaces are sky.

    Returns
    -------
    CameraImage

    Raises
    ------
    CalibrationError
        The camera is tilted by more than 20 degrees.
    """
    NUMBERS.number("max_range_m", max_range_m, 0.1, math.inf)
    T_world_camera = np.asarray(T_world_sensor, np.float64) @ np.linalg.inv(calibration.T_camera_sensor)
    pose = T_world_camera @ _AHEAD.T
    if not pose[2, 2] >= math.cos(math.radians(MOST_TILT_DEG)):
        raise CalibrationError(f"the camera is tilted by more than {MOST_TILT_DEG:g} degrees, which is not simulated")
    rng = np.random.default_rng((int(seed) & 0x7FFFFFFFFFFFFFFF, 15485863))
    first_key = int(rng.integers(0, 2**63))
    width, height = calibration.width, calibration.height
    (f_x, _, c_x), (_, f_y, c_y), _ = calibration.K.tolist()
    azimuths = np.arctan((c_x - np.arange(width)) / f_x)
    slopes = (c_y - np.arange(height)) / f_y
    shapes = place_shapes(scene, pose, _SECTORS, max_range_m)
    sectors = np.floor(azimuths / (2.0 * math.pi / _SECTORS)).astype(np.int64) % _SECTORS

    # Transposed: a column of the image has one azimuth, and elevations of its own.
    shape = (width, height, 1)
    found = Hits(np.empty(shape), np.empty(shape, np.int32), np.empty(shape), np.empty(shape))
    elevations = np.arctan(slopes * np.cos(azimuths)[:, None])
    for column, sector in enumerate(sectors.tolist()):
        key = np.uint64(first_key + column * height)
        rays = Rays(elevations[column][:, None], azimuths[column : column + 1], max_range_m, key)
        part = shapes._replace(starts=shapes.starts[sector : sector + 2])
        fill_cast(part, scene.ground, pose, rays, Hits(*(of[column] for of in found)))
    ranges, hits, _, cosines = (np.ascontiguousarray(of[:, :, 0].T) for of in found)
    elevations = elevations.T
    depth = np.where(hits == -2, np.inf, ranges * np.cos(elevations) * np.cos(azimuths))

    labels = np.full(hits.shape, _SKY, dtype=np.uint8)
    solid, ground = hits >= 0, hits == -1
    surfaces = np.full(hits.shape, -1, dtype=np.int64)
    surfaces[solid] = shapes.primitives[hits[solid], 19].astype(np.int64)
    labels[solid] = surface_classes(scene)[surfaces[solid]]
    row, col = np.nonzero(ground)
    places = np.stack([-np.tan(azimuths[col]), -slopes[row], np.ones(len(row))], axis=1) * depth[ground][:, None]
    kinds, remissions = _ground_at(scene, places, T_world_camera)
    labels[ground] = _OF_GROUND[kinds]

    color = np.empty((*hits.shape, 3))
    horizon, zenith = np.array([236.0, 240.0, 245.0]), np.array([120.0, 165.0, 220.0])
    color[:] = (horizon + np.clip(4.0 * slopes, 0.0, 1.0)[:, None] * (zenith - horizon))[:, None]
    shade = 0.55 + 0.45 * cosines
    color[solid] = _surface_colors(scene, rng)[surfaces[solid]] * shade[solid][:, None]
    gray, green = np.array([1.0, 1.0, 1.02]), np.array([0.62, 0.85, 0.4])
    tint = np.stack([370.0 * gray, 560.0 * gray, 330.0 * green])[kinds]
    color[ground] = tint * remissions[:, None]
    haze = 1.0 - np.exp(-np.where(np.isfinite(depth), depth, 0.0) / 300.0)
    color = color * (1.0 - haze[..., None]) + np.array([225.0, 230.0, 236.0]) * haze[..., None]
    color += rng.normal(0.0, 5.0, hits.shape)[..., None]
    return CameraImage(np.clip(color, 0.0, 255.0).astype(np.uint8), labels, depth.astype(np.float32))


def true_classes(scan: SimulatedScan) -> Bytes:
    """Class of the surface that returned each point: index into `CAMERA_CLASSES`, `VOID` for none, (n,) uint8."""
    labels = np.append(surface_classes(scan.scene), np.uint8(0))[scan.surfaces]
    ground = scan.surfaces == -1
    kinds, _ = _ground_at(scan.scene, scan.points[ground, :3], scan.T_world_sensor)
    labels[ground] = _OF_GROUND[kinds]
    return labels


def _ground_at(scene: Scene, places: NDArray[Any], T_world_frame: Floats) -> tuple[Bytes, Floats]:
    """Kind and remission of the ground at places (n, 3) of a frame."""
    return scene.surface((places.astype(np.float64) @ T_world_frame[:3, :3].T + T_world_frame[:3, 3])[:, :2])


def surface_classes(scene: Scene) -> Bytes:
    """Class of each of ``scene.primitives`` in an image: index into `CAMERA_CLASSES`, `VOID` for none, (n,) uint8."""
    of_object = [
        CAMERA_CLASSES.index("Bicyclist") if each.label == "misc" and each.size[0] < 2.7 else _OF_OBJECT[each.label]
        for each in scene.objects
    ]  # a short "misc" object is a motorcycle, which CamVid counts to the bicycles
    number = scene.primitives[:, 19].astype(np.int64)
    lookup = np.array([*of_object, 0], dtype=np.uint8)
    static = np.where(number < -1, -2 - number, np.where(scene.primitives[:, 1] == LEAVES, _TREE, VOID))
    return np.where(number >= 0, lookup[np.maximum(number, -1)], static).astype(np.uint8)


def _surface_colors(scene: Scene, rng: np.random.Generator) -> Floats:
    """A color (n, 3) for each of ``scene.primitives``: of its material, and of its object where that is painted."""
    primitives = scene.primitives
    n = len(primitives)
    material, number = primitives[:, 1].astype(np.int64), primitives[:, 19].astype(np.int64)
    # Shapes of a person with the same remission are of one cloth.
    _, cloth = np.unique(primitives[:, [19, 2]], axis=0, return_inverse=True)
    own = (rng.uniform(40.0, 190.0, (n, 1)) + rng.normal(0.0, 22.0, (n, 3)))[cloth.reshape(-1)]
    walls = np.array([190.0, 165.0, 140.0]) + rng.normal(0.0, 22.0, (n, 1)) + rng.normal(0.0, 8.0, (n, 3))
    leaves = np.array([70.0, 105.0, 48.0]) + rng.normal(0.0, 12.0, (n, 1)) + rng.normal(0.0, 6.0, (n, 3))
    paint = rng.uniform(20.0, 225.0, (len(scene.objects) + 1, 1)) + rng.normal(0.0, 25.0, (len(scene.objects) + 1, 3))
    classes = surface_classes(scene)
    colors = np.full((n, 3), 110.0)
    building = (classes == CAMERA_CLASSES.index("Building")) | (material == FACADE)
    colors[building] = walls[building]
    colors[classes == CAMERA_CLASSES.index("Fence")] = (120.0, 108.0, 92.0)
    people = (number >= 0) & np.isin(classes, [CAMERA_CLASSES.index("Pedestrian"), CAMERA_CLASSES.index("Bicyclist")])
    colors[people] = own[people]
    colors[(number >= 0) & ~people] = 45.0  # wheels and other parts of vehicles
    colors[material == PAINT] = paint[number[material == PAINT]]
    colors[material == LEAVES] = leaves[material == LEAVES]
    colors[material == GLASS] = (48.0, 58.0, 68.0)
    colors[material == RETRO] = np.where(rng.random((n, 1)) < 0.5, (225.0, 225.0, 225.0), (190.0, 45.0, 40.0))[
        material == RETRO
    ]
    return np.asarray(np.clip(colors, 5.0, 250.0))
