"""ROS 2 messages of a perceived scan, and their CDR bytes, by rosbags' definitions.

Frames follow REP-103: x forward, y left, z up [m], angles counter-clockwise [rad]. Messages are in the frame of the
scan, the one of the sensor. Only the grid can be in a frame of its own: see `RosMessages`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError, PointsError
from ..road.grid import OCCUPIED, occupancy_grid
from ..system.clock import nanoseconds_of
from ..system.extras import require
from ..system.names import check_text
from ..types.points import as_points
from ..view.colors import color_of, rgb
from ..view.content import EDGES, box_corners

if TYPE_CHECKING:
    from ..records import PerceivedScan
    from ..types.perception import Box

__all__ = ["CLOUD", "OUTPUTS", "RosMessages", "nanoseconds"]

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

# vision_msgs 4 (ROS 2 Humble and later), which rosbags does not have. The other definitions are rosbags' of ROS 2
# Humble; their type hashes are the same from Iron to Lyrical.
_VISION = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
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


class RosMessages:
    """Makes messages of perceived scans, serializes them and reads clouds.

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
        for name, text in _VISION.items():
            self.typestore.register(typesys.get_types_from_msg(text, f"vision_msgs/msg/{name}"))
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

        Parameters
        ----------
        scan : PerceivedScan
        stamp_ns : int, optional
            Stamp of the header [ns], by default that of the scan.

        Returns
        -------
        message
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
        return self._make(
            CLOUD,
            header=self._header(scan, stamp_ns),
            height=1,
            width=len(rows),
            fields=fields,
            is_bigendian=False,
            point_step=_POINT.itemsize,
            row_step=rows.nbytes,
            data=rows.view(np.uint8),
            is_dense=bool(np.isfinite(points[:, :3]).all()),
        )

    def markers(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Boxes and tracks for RViz: a visualization_msgs/MarkerArray.

        The first marker deletes those of the scan before. Namespaces are ``boxes`` (cubes; ids count from 0),
        ``tracks`` (edges of the box), ``track_labels`` (class, id, speed) and ``track_velocities`` (an arrow of the way
        in one second); in the latter three, the id of a marker is that of its track.

        Parameters
        ----------
        scan, stamp_ns
            As in `points`.

        Returns
        -------
        message
        """
        header = self._header(scan, stamp_ns)
        markers = [self._marker(header, "", 0, _CUBE, action=_DELETE_ALL)]
        for k, box in enumerate(scan.perception.boxes):
            cube: dict[str, Any] = {"pose": self._pose(box), "scale": box.size, "color": (box.label, 0.4)}
            markers.append(self._marker(header, "boxes", k, _CUBE, **cube))
        for track in scan.tracks or ():
            box, color = track.box, (track.label, 0.4 if track.coasting else 1.0)
            number = track.id % 2**31
            edges = box_corners(replace(box, center=(0.0, 0.0, 0.0), yaw=0.0))[np.ravel(EDGES)]  # in the marker's pose
            thin: dict[str, Any] = {"scale": (0.08, 0.0, 0.0), "color": color}
            markers.append(
                self._marker(header, "tracks", number, _LINE_LIST, pose=self._pose(box), points=edges, **thin)
            )
            speed_mps = math.hypot(*track.velocity)
            above = (*box.center[:2], box.center[2] + box.size[2] / 2.0 + 0.5)
            text: dict[str, Any] = {"pose": self._pose(center=above), "scale": (0.0, 0.0, 0.6), "color": color}
            text["text"] = f"{track.label} {track.id} {speed_mps:.1f} m/s"
            markers.append(self._marker(header, "track_labels", number, _TEXT, **text))
            if speed_mps > _MOVING_MPS:
                way = np.array([box.center, np.add(box.center, [*track.velocity, 0.0])])
                arrow: dict[str, Any] = {"scale": (0.15, 0.3, 0.3), "color": color, "points": way}
                markers.append(self._marker(header, "track_velocities", number, _ARROW, **arrow))
        return self._make("visualization_msgs/msg/MarkerArray", markers=markers)

    def occupancy(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """The grid of `edgeperc.occupancy_grid`: a nav_msgs/OccupancyGrid, 0 drivable, 100 obstacle, -1 unknown.

        Parameters
        ----------
        scan, stamp_ns
            As in `points`.

        Returns
        -------
        message
        """
        grid = occupancy_grid(scan.perception, scan.points, cell_m=self._cell_m, sensor=scan.sensor)
        fields = grid.to_occupancy_grid(off_road=self._off_road)
        header = self._header(scan, stamp_ns, self.grid_frame_id)
        if self.grid_frame_id is None:
            placed = fields["info"]["origin"]
            pose = self._pose(center=[*placed["position"].values()], turned=tuple(placed["orientation"].values()))
        else:
            pose = self._pose(center=(grid.x_range_m[0], grid.y_range_m[0], 0.0))
        info = self._make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=header.stamp,
            resolution=fields["info"]["resolution"],
            width=fields["info"]["width"],
            height=fields["info"]["height"],
            origin=pose,
        )
        return self._make("nav_msgs/msg/OccupancyGrid", header=header, info=info, data=fields["data"])

    def detections(self, scan: PerceivedScan, stamp_ns: int | None = None) -> Any:
        """Tracks or, without a tracker, boxes: a vision_msgs/Detection3DArray of vision_msgs 4.

        The class is its name; the id is that of the track, empty without one.

        Parameters
        ----------
        scan, stamp_ns
            As in `points`.

        Returns
        -------
        message
        """
        header = self._header(scan, stamp_ns)
        boxes = [(box, "") for box in scan.perception.boxes]
        if scan.tracked is not None:
            boxes = [(track.box, str(track.id)) for track in scan.tracked]
        detections = []
        for box, track_id in boxes:
            pose = self._make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(box), covariance=np.zeros(36))
            what = self._make("vision_msgs/msg/ObjectHypothesis", class_id=box.label, score=float(box.score))
            result = self._make("vision_msgs/msg/ObjectHypothesisWithPose", hypothesis=what, pose=pose)
            around = self._make("vision_msgs/msg/BoundingBox3D", center=self._pose(box), size=self._vector(box.size))
            detections.append(
                self._make("vision_msgs/msg/Detection3D", header=header, results=[result], bbox=around, id=track_id)
            )
        return self._make("vision_msgs/msg/Detection3DArray", header=header, detections=detections)

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
            As in `points`; 0 without a scan.
        name : str
            Name of the only status.
        level : int, optional
            0 OK, 1 WARN, 2 ERROR, 3 STALE; by default from the scan's health, and STALE without a scan.
        message : str, optional
            By default the health.
        values : mapping, optional
            More keys and values, before the others.

        Returns
        -------
        message
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
        points: NDArray[np.float64] | None = None,
        text: str = "",
    ) -> Any:
        lasting_ns = nanoseconds(self._lifetime_s)
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
            scale=self._vector(scale),
            color=self._make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha),
            lifetime=self._make("builtin_interfaces/msg/Duration", sec=lasting_ns // 10**9, nanosec=lasting_ns % 10**9),
            frame_locked=False,
            points=[self._point(point) for point in (() if points is None else points)],
            colors=[],
            texture_resource="",
            texture=image,
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=mesh,
            mesh_use_embedded_materials=False,
        )

    def _point(self, place: Any) -> Any:
        return self._make("geometry_msgs/msg/Point", x=float(place[0]), y=float(place[1]), z=float(place[2]))

    def _vector(self, along: Any) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=float(along[0]), y=float(along[1]), z=float(along[2]))

    def _pose(
        self,
        box: Box | None = None,
        *,
        center: Any = (0.0, 0.0, 0.0),
        turned: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
    ) -> Any:
        if box is not None:
            center, turned = box.center, (0.0, 0.0, math.sin(box.yaw / 2.0), math.cos(box.yaw / 2.0))
        orientation = self._make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turned, strict=True)))
        return self._make("geometry_msgs/msg/Pose", position=self._point(center), orientation=orientation)
