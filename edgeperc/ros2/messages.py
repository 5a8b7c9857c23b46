"""ROS 2 messages of a perceived scan, and their CDR bytes, by rosbags' definitions.

Frames follow REP-103: x forward, y left, z up [m], angles counter-clockwise [rad]. Messages are in the frame of the
scan, the one of the sensor. Only the grid can be in a frame of its own: see `RosMessages`.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from ..errors import OptionError, PointsError
from ..readers.clouds import cloud_table
from ..records import PerceivedScan
from ..road.grid import OCCUPIED, occupancy_grid
from ..road.rolling import RollingGrid
from ..system.clock import nanoseconds_of
from ..system.extras import require
from ..system.names import check_text
from ..tracking import Track
from ..tracking.moving import moving_tracks
from ..types.perception import Box
from ..types.points import Bytes, Floats, Mask, as_points
from ..view.colors import color_of, rgb
from ..view.content import EDGES, box_corners

__all__ = ["CLOUD", "LIVE_OUTPUTS", "OUTPUTS", "RosMessages", "nanoseconds"]

CLOUD = "sensor_msgs/msg/PointCloud2"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
OUTPUTS: Mapping[str, str] = {
    "points": CLOUD,
    "markers": "visualization_msgs/msg/MarkerArray",
    "occupancy": "nav_msgs/msg/OccupancyGrid",
    "detections": "vision_msgs/msg/Detection3DArray",
    "diagnostics": DIAGNOSTICS,
}
"""Methods of `RosMessages` that make a message of a scan, and the types of these messages."""
GROUND_POINTS, OBSTACLE_POINTS, ROLLING = "ground_points", "obstacle_points", "rolling"
LIVE_OUTPUTS: Mapping[str, str] = {
    **OUTPUTS,
    GROUND_POINTS: CLOUD,
    OBSTACLE_POINTS: CLOUD,
    ROLLING: "nav_msgs/msg/OccupancyGrid",
    "detected_objects": "autoware_perception_msgs/msg/DetectedObjects",
    "tracked_objects": "autoware_perception_msgs/msg/TrackedObjects",
    "predicted_objects": "autoware_perception_msgs/msg/PredictedObjects",
}
"""What a node can publish: also the two parts of the cloud, the rolling grid, and Autoware's objects."""

# vision_msgs 4 (ROS 2 Humble and later), which rosbags does not have. The other definitions are rosbags' of ROS 2
# Humble; their type hashes are the same from Iron to Lyrical.
_VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
# autoware_perception_msgs 1.3 to 1.13.
_WITH = "geometry_msgs/{0}WithCovariance {1}{2}_with_covariance\n".format
_AUTOWARE = {
    "ObjectClassification": "uint8 label\nfloat32 probability\n",
    "Shape": "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions\n",
    "PredictedPath": "geometry_msgs/Pose[] path\nbuiltin_interfaces/Duration time_step\nfloat32 confidence\n",
    "DetectedObjectKinematics": _WITH("Pose", "", "pose")
    + "bool has_position_covariance\nuint8 orientation_availability\n"
    + _WITH("Twist", "", "twist")
    + "bool has_twist\nbool has_twist_covariance\n",
    "TrackedObjectKinematics": _WITH("Pose", "", "pose")
    + _WITH("Twist", "", "twist")
    + _WITH("Accel", "", "acceleration")
    + "uint8 orientation_availability\nbool is_stationary\n",
    "PredictedObjectKinematics": _WITH("Pose", "initial_", "pose")
    + _WITH("Twist", "initial_", "twist")
    + _WITH("Accel", "initial_", "acceleration")
    + "PredictedPath[] predicted_paths\n",
    **{
        f"{kind}Object": ("" if kind == "Detected" else "unique_identifier_msgs/UUID object_id\n")
        + f"float32 existence_probability\nObjectClassification[] classification\n{kind}ObjectKinematics kinematics\n"
        + "Shape shape\n"
        for kind in ("Detected", "Tracked", "Predicted")
    },
    **{
        f"{kind}Objects": f"std_msgs/Header header\n{kind}Object[] objects\n"
        for kind in ("Detected", "Tracked", "Predicted")
    },
}
# ObjectClassification.label; anything else is 0, UNKNOWN.
_AUTOWARE_LABELS = {
    **dict.fromkeys(("car", "van", "vehicle"), 1),
    **{"truck": 2, "bus": 3, "trailer": 4},
    **dict.fromkeys(("motorcycle", "motorcyclist"), 5),
    **dict.fromkeys(("bicycle", "cyclist", "bicyclist"), 6),
    **dict.fromkeys(("pedestrian", "person", "person_sitting"), 7),
}
_SIGN_UNKNOWN, _AVAILABLE = 1, 2  # orientation_availability
_PATH_STEP_S, _PATH_STEPS = 0.5, 10
_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "label", "in_view"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "u1", "u1"],
        "offsets": [0, 4, 8, 12, 16, 17],
        "itemsize": 20,  # a multiple of 4, so that every float of the array is aligned
    }
)
_FIELD_TYPES = {"f4": 7, "u1": 2}  # PointField.FLOAT32 and UINT8
# Marker.type and Marker.action
_ARROW, _CUBE, _LINE_LIST, _TEXT = 0, 1, 5, 9
_ADD, _DELETE_ALL = 0, 3
_LEVELS = {None: 0, "OK": 0, "LATE": 1, "STALE": 3}  # of DiagnosticStatus, by the health of an answer
_MOVING_MPS = 0.5  # slower tracks get no arrow


def nanoseconds(stamp_s: float) -> int:
    """A time [s] in whole nanoseconds: those of the recording, or from a float, which holds times of today to 0.2 us.

    Raises
    ------
    PointsError
        It is not finite.
    """
    if not math.isfinite(stamp_s):
        raise PointsError(f"the scan's time is {stamp_s} s; expected a finite number")
    return nanoseconds_of(stamp_s)


def _velocity(scan: PerceivedScan, track: Track) -> Floats:
    """Velocity of a track over ground along x, y, z of the scan's frame, which may be tilted (3,) [m/s]."""
    assert scan.tracks is not None
    return np.asarray(track.world_velocity @ scan.tracks.T_world_sensor[:3, :3])


class RosMessages:
    """Makes messages of perceived scans, serializes them and reads clouds.

    Methods that make one of a scan take the scan and the stamp of its header [ns], by default that of the scan.

    Parameters
    ----------
    frame_id : str
        Frame of the scans.
    grid_frame_id : str, optional
        Frame of the occupancy grid: level, on the road below the sensor, x forward, such as a ``base_footprint`` that
        lies there. By default the grid is in the frame of the scans, and its origin has the pose of the ground in it.
        Tools that ignore the origin's orientation, such as nav2's static layer, need this frame if the sensor is
        turned or tilted.
    lifetime_s : float
        Time after which a viewer removes markers that were not replaced [s].
    cell_m : float
        Edge of a cell of the grid [m].
    off_road : int
        Value of observed ground that is neither drivable nor an obstacle, as in `edgeperc.OccupancyGrid.values`.

    Attributes
    ----------
    types : mapping
        Classes of messages by name, e.g. ``"std_msgs/msg/Header"``.

    Raises
    ------
    MissingExtraError
        rosbags is not installed.
    OptionError
        A frame's name is empty, too long or not printable.
    """

    def __init__(
        self,
        frame_id: str = "lidar",
        *,
        grid_frame_id: str | None = None,
        lifetime_s: float = 0.5,
        cell_m: float = 0.2,
        off_road: int = OCCUPIED,
    ) -> None:
        for frame in (frame_id, frame_id if grid_frame_id is None else grid_frame_id):
            check_text("the frame is", frame, OptionError)
        typesys = require("rosbags.typesys", "ros", "Making ROS 2 messages")
        self.typestore: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        for package, definitions in (("vision_msgs", _VISION), ("autoware_perception_msgs", _AUTOWARE)):
            for name, text in definitions.items():
                self.typestore.register(typesys.get_types_from_msg(text, f"{package}/msg/{name}"))
        self.types: Mapping[str, Any] = self.typestore.types
        self.frame_id, self.grid_frame_id = frame_id, grid_frame_id
        self._lifetime_s, self._cell_m, self._off_road = lifetime_s, cell_m, off_road

    def type_hash(self, name: str) -> str:
        """The hash of a type, ``RIHS01_`` and the SHA-256 of its description (REP-2016)."""
        return str(self.typestore.hash_rihs01(name))

    def encode(self, message: Any) -> bytes:
        """Serialize a message as CDR, little endian, with its header of 4 bytes."""
        return bytes(self.typestore.serialize_cdr(message, message.__msgtype__))

    def decode(self, data: bytes, name: str) -> Any:
        """Read a message of CDR bytes from elsewhere.

        Raises
        ------
        PointsError
            The bytes are not such a message.
        """
        try:
            return self.typestore.deserialize_cdr(data, name)
        except Exception as exc:  # of rosbags, struct, numpy: whatever the bytes lead to
            reason = " ".join(str(exc).split()) or type(exc).__name__
            raise PointsError(f"got {len(data):,} bytes that are not a {name} ({reason}); expected one in CDR") from exc

    def points(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Every point of the scan with its class: a sensor_msgs/PointCloud2.

        Fields are ``x``, ``y``, ``z``, ``intensity`` (the remission as it came; 0 without one), ``label`` (uint8, index
        into the classes that `diagnostics` lists) and ``in_view`` (uint8, 0 where the label is not a prediction).
        """
        points, labels = as_points(scan.points), scan.perception.points
        rows = np.zeros(len(points), _POINT)
        for column, name in enumerate(("x", "y", "z", "intensity")):
            rows[name] = points[:, column]
        if labels is not None:
            rows["label"], rows["in_view"] = labels.labels, labels.in_view
        fields = [
            self._make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=int(_POINT.fields[name][1]),  # type: ignore[index]
                datatype=_FIELD_TYPES[_POINT[name].str[1:]],
                count=1,
            )
            for name in _POINT.names or ()
        ]
        is_dense = bool(np.isfinite(points[:, :3]).all())
        data = rows.view(np.uint8).reshape(-1, _POINT.itemsize)
        return self._cloud(self._header(scan, stamp_ns), fields, data, is_bigendian=False, is_dense=is_dense)

    def _cloud(self, header: Any, fields: Any, rows: Bytes, **kind: bool) -> Any:
        sizes = {"height": 1, "width": len(rows), "point_step": rows.shape[1], "row_step": rows.size}
        return self._make(CLOUD, header=header, fields=fields, **sizes, data=rows.reshape(-1), **kind)

    def markers(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Boxes and tracks for RViz: a visualization_msgs/MarkerArray.

        The first marker deletes those of the scan before. Namespaces are ``boxes`` (cubes; ids count from 0),
        ``tracks`` (edges of the box), ``track_labels`` (class, id, speed) and ``track_velocities`` (an arrow of the way
        in one second); in the latter three, the id of a marker is that of its track.
        """
        header = self._header(scan, stamp_ns)
        markers = [self._marker(header, "", 0, _CUBE, action=_DELETE_ALL)]

        def add(namespace: str, number: int, kind: int, **shown: Any) -> None:
            markers.append(self._marker(header, namespace, number, kind, **shown))

        for k, box in enumerate(scan.perception.boxes):
            add("boxes", k, _CUBE, pose=self._pose(box), scale=box.size, color=(box.label, 0.4))
        for track in scan.tracks or ():
            box, color = track.box, (track.label, 0.4 if track.coasting else 1.0)
            number = track.id % 2**31
            edges = box_corners(replace(box, center=(0.0, 0.0, 0.0), yaw=0.0))[np.ravel(EDGES)]  # in the marker's pose
            add("tracks", number, _LINE_LIST, pose=self._pose(box), points=edges, scale=(0.08, 0.0, 0.0), color=color)
            speed_mps = math.hypot(*track.world_velocity)
            above = (*box.center[:2], box.center[2] + box.size[2] / 2.0 + 0.5)
            pose, text = self._pose(center=above), f"{track.label} {track.id} {speed_mps:.1f} m/s"
            add("track_labels", number, _TEXT, pose=pose, scale=(0.0, 0.0, 0.6), color=color, text=text)
            if speed_mps > _MOVING_MPS:
                way = np.array([box.center, np.add(box.center, _velocity(scan, track))])
                add("track_velocities", number, _ARROW, scale=(0.15, 0.3, 0.3), color=color, points=way)
        return self._make("visualization_msgs/msg/MarkerArray", markers=markers)

    def occupancy(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """The grid of `edgeperc.occupancy_grid`: a nav_msgs/OccupancyGrid, 0 drivable, 100 obstacle, -1 unknown."""
        grid = occupancy_grid(scan.perception, scan.points, cell_m=self._cell_m)
        fields = grid.to_occupancy_grid(off_road=self._off_road)
        pose = None
        if self.grid_frame_id is not None:
            pose = self._pose(center=(grid.x_range_m[0], grid.y_range_m[0], 0.0))
        return self._grid(self._header(scan, stamp_ns, self.grid_frame_id), fields, pose)

    def rolling(self, grid: RollingGrid, frame_id: str, stamp_ns: int) -> Any:
        """A grid with memory: a nav_msgs/OccupancyGrid in the frame of the odometry.

        Parameters
        ----------
        grid : RollingGrid
        frame_id : str
            Of the odometry.
        stamp_ns : int
            Stamp of the header [ns].
        """
        return self._grid(self._header(None, stamp_ns, frame_id), grid.to_occupancy_grid(frame_id, self._off_road))

    def _grid(self, header: Any, fields: Mapping[str, Any], pose: Any = None) -> Any:
        """A grid; ``pose`` of its origin is by default that of the fields."""
        at = fields["info"]["origin"]
        pose = pose or self._pose(center=at["position"].values(), turned=at["orientation"].values())
        info = self._make(
            "nav_msgs/msg/MapMetaData", **{**fields["info"], "map_load_time": header.stamp, "origin": pose}
        )
        return self._make("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=fields["data"])

    def part(self, scan: PerceivedScan, cloud: Any, mask: Mask, stamp_ns: int | None = None) -> Any:
        """Some points of a cloud, byte by byte, with all its fields: a sensor_msgs/PointCloud2 of one row.

        Parameters
        ----------
        scan : PerceivedScan
        cloud : object
            The sensor_msgs/PointCloud2 of the scan.
        mask : (n,) bool
            Points to keep.
        stamp_ns : int, optional
        """
        table, data = cloud_table(cloud), np.frombuffer(cloud.data, np.uint8)
        step = table.dtype.itemsize
        rows = np.ndarray((*table.shape, step), np.uint8, data, strides=(*table.strides, 1)) if table.size else data[:0]
        kept = rows.reshape(-1, step)[mask]
        header = self._header(scan, stamp_ns)
        return self._cloud(header, cloud.fields, kept, is_bigendian=cloud.is_bigendian, is_dense=True)

    def detections(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Tracks or, without a tracker, boxes: a vision_msgs/Detection3DArray of vision_msgs 4.

        The class is its name; the id is that of the track, empty without one.
        """
        header = self._header(scan, stamp_ns)
        boxes = [(box, "") for box in scan.perception.boxes]
        if scan.tracked is not None:
            boxes = [(track.box, str(track.id)) for track in scan.tracked]
        detections = []
        for box, track_id in boxes:
            pose = self._with("Pose", self._pose(box))
            what = self._make("vision_msgs/msg/ObjectHypothesis", class_id=box.label, score=float(box.score))
            result = self._make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=what, pose=pose)
            around = self._make("vision_msgs/msg/BoundingBox3D", center=self._pose(box), size=self._xyz(box.size))
            detections.append(
                self._make("vision_msgs/msg/Detection3D", header=header, results=[result], bbox=around, id=track_id)
            )
        return self._make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)

    def detected_objects(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Boxes: an autoware_perception_msgs/DetectedObjects."""
        objects = []
        for box in scan.perception.boxes:
            kinematics = {
                "pose_with_covariance": self._with("Pose", self._pose(box)),
                "has_position_covariance": False,
                "orientation_availability": _SIGN_UNKNOWN if box.front is None else _AVAILABLE,
                "twist_with_covariance": self._with("Twist", self._twist()),
                "has_twist": False,
                "has_twist_covariance": False,
            }
            objects.append(self._object("Detected", box, kinematics))
        return self._objects("Detected", scan, stamp_ns, objects)

    def tracked_objects(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Tracks: an autoware_perception_msgs/TrackedObjects, empty without a tracker.

        Velocities are over ground along and across the box. The covariances are those of position, yaw and speed along
        the heading.
        """
        moving = {track.id for track in moving_tracks(scan.tracked or ())}
        objects = []
        for track in scan.tracked or ():
            kinematics = {
                **self._motion(scan, track, ""),
                "orientation_availability": _SIGN_UNKNOWN if track.box.front is None else _AVAILABLE,
                "is_stationary": track.id not in moving,
            }
            objects.append(self._object("Tracked", track.box, kinematics, self._uuid(scan, track)))
        return self._objects("Tracked", scan, stamp_ns, objects)

    def predicted_objects(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Tracks, each with one path of 5 s, an arc: an autoware_perception_msgs/PredictedObjects.

        The path is over ground (`Track.predicted`), as seen from where the sensor was at the scan.
        """
        step = self._duration(_PATH_STEP_S)
        objects = []
        for track in scan.tracked or ():
            path = self._make(
                "autoware_perception_msgs/msg/PredictedPath",
                path=[self._pose(track.predicted(k * _PATH_STEP_S)) for k in range(_PATH_STEPS + 1)],
                time_step=step,
                confidence=1.0,
            )
            kinematics = {**self._motion(scan, track, "initial_"), "predicted_paths": [path]}
            objects.append(self._object("Predicted", track.box, kinematics, self._uuid(scan, track)))
        return self._objects("Predicted", scan, stamp_ns, objects)

    def _objects(self, kind: str, scan: PerceivedScan, stamp_ns: int | None, objects: list[Any]) -> Any:
        name = f"autoware_perception_msgs/msg/{kind}Objects"
        return self._make(name, header=self._header(scan, stamp_ns), objects=objects)

    def _object(self, kind: str, box: Box, kinematics: Mapping[str, Any], number: Any = None) -> Any:
        package = "autoware_perception_msgs/msg"
        what = {"label": _AUTOWARE_LABELS.get(box.label, 0), "probability": 1.0}
        polygon = self._make("geometry_msgs/msg/Polygon", points=[])
        return self._make(
            f"{package}/{kind}Object",
            **({} if number is None else {"object_id": number}),
            existence_probability=float(box.score),
            classification=[self._make(f"{package}/ObjectClassification", **what)],
            kinematics=self._make(f"{package}/{kind}ObjectKinematics", **kinematics),
            shape=self._make(f"{package}/Shape", type=0, footprint=polygon, dimensions=self._xyz(box.size)),
        )

    def _motion(self, scan: PerceivedScan, track: Track, before: str) -> dict[str, Any]:
        """Pose, twist and acceleration of a track; ``before`` their names."""
        assert scan.tracks is not None
        cos, sin = math.cos(track.box.yaw), math.sin(track.box.yaw)
        vx, vy, vz = _velocity(scan, track)
        pose, twist = np.zeros((6, 6)), np.zeros((6, 6))
        R = scan.tracks.T_world_sensor[:3, :3]
        pose[:2, :2] = R[:2, :2].T @ track.covariance[:2, :2] @ R[:2, :2]
        pose[5, 5], twist[0, 0] = track.covariance[[3, 2], [3, 2]]
        zero = self._xyz((0.0, 0.0, 0.0))
        # The turn is about z of the tracker's frame: of a sensor that hangs upside down, the other way round.
        along = self._twist((cos * vx + sin * vy, cos * vy - sin * vx, vz), float(R[2, 2] * track.state[4]))
        return {
            f"{before}pose_with_covariance": self._with("Pose", self._pose(track.box), pose),
            f"{before}twist_with_covariance": self._with("Twist", along, twist),
            f"{before}acceleration_with_covariance": self._with(
                "Accel", self._make("geometry_msgs/msg/Accel", linear=zero, angular=zero)
            ),
        }

    def _twist(self, linear: tuple[float, float, float] = (0.0, 0.0, 0.0), turn: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Twist", linear=self._xyz(linear), angular=self._xyz((0.0, 0.0, turn)))

    def _with(self, kind: str, value: Any, covariance: Floats | None = None) -> Any:
        matrix = np.zeros(36) if covariance is None else covariance.ravel()
        return self._make(f"geometry_msgs/msg/{kind}WithCovariance", **{kind.lower(): value}, covariance=matrix)

    def _uuid(self, scan: PerceivedScan, track: Track) -> Any:
        """The same for a track in every scan, another one for every other track of every session."""
        session = 0 if scan.tracks is None else scan.tracks.session
        number = uuid.uuid5(uuid.NAMESPACE_OID, f"edgeperc/{session}/{track.id}")
        return self._make("unique_identifier_msgs/msg/UUID", uuid=np.frombuffer(number.bytes, np.uint8))

    def diagnostics(
        self,
        scan: PerceivedScan | None,
        stamp_ns: int | None = None,
        *,
        name: str = "edgeperc: perception",
        level: int | None = None,
        message: str | None = None,
        values: Mapping[str, object] | None = None,
    ) -> Any:
        """Health, times of the stages, providers and names of the classes: a diagnostic_msgs/DiagnosticArray.

        Parameters
        ----------
        scan : PerceivedScan or None
            The newest; None if there is none yet.
        stamp_ns : int, optional
            0 without a scan.
        name : str
            Name of the only status.
        level : int, optional
            0 OK, 1 WARN, 2 ERROR, 3 STALE; by default from the scan's health, and STALE without a scan.
        message : str, optional
            By default the health.
        values : mapping, optional
            More keys and values, before the others.
        """
        listed: dict[str, object] = dict(values or {})
        if scan is None:
            level, message = 3 if level is None else level, message or "no scan yet"
        else:
            perception = scan.perception
            level = _LEVELS[scan.health] if level is None else level
            message = message or scan.health or "OK"
            near, ego = perception.dropped.too_near, perception.dropped.ego
            listed |= {"points": perception.n_points, "points not finite": perception.n_dropped - near - ego}
            listed |= {"points too near": near} if near else {}
            listed |= {"points of the own vehicle": ego} if ego else {}
            listed |= {"boxes": len(perception.boxes)}
            if scan.tracks is not None:
                listed["tracks"] = len(scan.tracks)
            if perception.top_view is not None:
                listed["drivable [m2]"] = f"{perception.top_view.drivable_area_m2:.1f}"
            listed |= {f"{stage} [ms]": f"{ms:.1f}" for stage, ms in perception.stage_ms.items()}
            listed |= {f"provider of {model}": ran for model, ran in perception.providers.items()}
            if perception.points is not None:
                listed["labels"] = ", ".join(f"{k} {label}" for k, label in enumerate(perception.points.classes))
            listed |= {f"unlike the training scans {k}": sentence for k, sentence in enumerate(perception.fitness, 1)}
            listed |= {f"sensor {k}": sentence for k, sentence in enumerate(perception.health.findings, 1)}
            listed |= {"drops left out": perception.health.n_drops} if perception.health.n_drops else {}
            level = max(level, 1) if perception.health.findings and level < 2 else level
        status = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=name,
            message=message,
            hardware_id="" if scan is None else scan.sensor.name,
            values=[
                self._make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in listed.items()
            ],
        )
        return self._make(DIAGNOSTICS, header=self._header(scan, stamp_ns, ""), status=[status])

    def _make(self, kind: str, /, **fields: Any) -> Any:
        return self.types[kind](**fields)

    def _duration(self, seconds: float) -> Any:
        whole, rest = divmod(nanoseconds(seconds), 10**9)
        return self._make("builtin_interfaces/msg/Duration", sec=whole, nanosec=rest)

    def _header(self, scan: PerceivedScan | None, stamp_ns: int | None, frame_id: str | None = None) -> Any:
        if stamp_ns is None:
            stamp_ns = 0 if scan is None else nanoseconds(scan.stamp_s)
        # A stamp that a message held can be written again, one with more than a second of nanoseconds too.
        seconds = min(stamp_ns // 10**9, 2**31 - 1)
        rest = stamp_ns - seconds * 10**9
        if seconds < -(2**31) or rest >= 2**32:
            raise PointsError(
                f"the stamp is {1e-9 * stamp_ns} s; expected a time that 32 bits hold, up to the year 2038"
            )
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=self.frame_id if frame_id is None else frame_id)

    def _marker(
        self,
        header: Any,
        namespace: str,
        number: int,
        kind: int,
        *,
        action: int = _ADD,
        pose: Any = None,
        scale: Any = (0.0, 0.0, 0.0),
        color: tuple[str, float] = ("", 0.0),
        points: Floats | None = None,
        text: str = "",
    ) -> Any:
        (red, green, blue), alpha = rgb([color_of(color[0])])[0].tolist(), color[1]
        image = self._make("sensor_msgs/msg/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8))
        mesh = self._make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8))
        return self._make(
            "visualization_msgs/msg/Marker",
            header=header,
            ns=namespace,
            id=number,
            type=kind,
            action=action,
            pose=self._pose() if pose is None else pose,
            scale=self._xyz(scale),
            color=self._make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
            lifetime=self._duration(self._lifetime_s),
            frame_locked=False,
            points=[self._xyz(point, "Point") for point in (() if points is None else points)],
            colors=[],
            texture_resource="",
            texture=image,
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=mesh,
            mesh_use_embedded_materials=False,
        )

    def _xyz(self, values: Any, kind: str = "Vector3") -> Any:
        return self._make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, values), strict=True)))

    def _pose(
        self, box: Box | None = None, *, center: Any = (0.0, 0.0, 0.0), turned: Iterable[float] = (0.0, 0.0, 0.0, 1.0)
    ) -> Any:
        if box is not None:
            center, turned = box.center, (0.0, 0.0, math.sin(box.yaw / 2.0), math.cos(box.yaw / 2.0))
        orientation = self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turned, strict=True)))
        return self._make("geometry_msgs/msg/Pose", position=self._xyz(center, "Point"), orientation=orientation)
