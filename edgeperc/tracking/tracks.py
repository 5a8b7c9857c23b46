"""Results of a tracker, and its parameters for each class."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, overload

import numpy as np

from ..system.fields import OPTIONS
from ..types.geometry import wrapped
from ..types.perception import Box
from ..types.points import Floats, Ints64, Records
from .lives import MOVED, TRACK
from .ukf import MODES

# Lowest and highest value of those that may be 0 or below, and of shares: tracks would be lost without a word.
_BOUNDS = {
    **dict.fromkeys(("birth_score", "sure_score", "latest"), (0.0, 1.0)),
    **dict.fromkeys(("far_logit", "coasting_logit"), (-1e6, 1e6)),
    **dict.fromkeys(("moving_mps", "still_mps"), (0.0, 1e6)),
    "memory_s": (0.0, 3600.0),  # after 15,000 s, a covariance is no longer positive definite in float64
    "detection": (1e-3, 0.999),
    "clutter": (1e-12, 1e6),
}


@dataclass(frozen=True, slots=True)
class ClassParameters:
    """Parameters of motion, detection and life of tracks for one class of objects; without a unit, of one scan.
    OptionError for one that is no number, or out of its bounds.
    """

    group: str  # classes of one group may be confused: the label of a track changes only within its group
    # Constant velocity and CTRV: standard deviations of acceleration and turn acceleration.
    acceleration_mps2: float = 3.0
    turn_acceleration_rps2: float = 0.5
    # Random motion: standard deviations of the walks of position and heading after one second, and of the speed.
    walk_m: float = 0.3
    wander_rad: float = 0.1
    still_mps: float = 0.1
    # Standard deviations of speed and turn rate of a new track.
    birth_speed_mps: float = 8.0
    birth_turn_rps: float = 0.2
    keep_motion_s: float = 3.0  # mean time for which a track keeps its motion model
    # Standard deviations of a detection near the sensor: along and across the heading, of the heading, and of the
    # height of the center, length, width and height. They grow linearly with the distance, and are doubled at range_m.
    along_m: float = 0.15
    across_m: float = 0.10
    heading_rad: float = 0.06
    shape_m: tuple[float, float, float, float] = (0.06, 0.25, 0.10, 0.10)
    range_m: float = 30.0
    detection: float = 0.8  # probability that a visible object is detected
    clutter: float = 1e-3  # density of false detections and new objects [1/(m2 rad)]
    gate: float = 5.0  # largest Mahalanobis distance between a track and its detection
    birth_score: float = 0.0  # lowest score of a detection that begins a track
    sure_score: float = 0.95  # a detection with this score confirms a track immediately
    memory_s: float = 1.5  # longest time without detections before a track is deleted
    moving_mps: float = 1.0  # above this speed the motion of a track shows where its front is
    latest: float = 0.3  # weight of the last detection's log odds in the score; the others count by their mean
    # Log odds added to the score of a track for each range_m of distance. A detector gives lower scores to far objects,
    # so at the same score a near object is more often false. 0 for a detector with calibrated scores.
    far_logit: float = 0.0
    coasting_logit: float = 0.0  # log odds subtracted from the score for each scan since the last detection

    def __post_init__(self) -> None:
        for each in fields(self):
            value, bounds = getattr(self, each.name), _BOUNDS.get(each.name, (1e-6, 1e6))
            if each.name == "shape_m":
                object.__setattr__(self, each.name, OPTIONS.numbers(each.name, value, 4, *bounds))
            elif each.name != "group":
                object.__setattr__(self, each.name, OPTIONS.number(each.name, value, *bounds))


# The weights of scores were chosen on ten KITTI sequences. Only far_logit was fixed on one half and confirmed on the
# other; for the rest both halves were looked at. sAMOTA of cars on either half with far_logit and latest: 91.1 -> 92.9
# and 93.3 -> 93.6; of cyclists with coasting_logit: 64.3 -> 66.0 and 88.9 -> 93.1.
_VEHICLE = ClassParameters(group="vehicle", far_logit=1.0)
_PEDESTRIAN = ClassParameters(
    group="pedestrian",
    acceleration_mps2=1.5,
    turn_acceleration_rps2=1.0,
    walk_m=0.5,
    wander_rad=0.5,
    birth_speed_mps=1.5,
    birth_turn_rps=0.5,
    along_m=0.07,
    across_m=0.07,
    heading_rad=0.2,
    shape_m=(0.08, 0.15, 0.12, 0.08),
    moving_mps=0.7,
)
_CYCLIST = ClassParameters(
    group="cyclist",
    turn_acceleration_rps2=0.8,
    birth_speed_mps=4.0,
    along_m=0.09,
    across_m=0.07,
    heading_rad=0.08,
    shape_m=(0.08, 0.15, 0.12, 0.08),
    latest=0.0,
    coasting_logit=0.3,
)
PARAMETERS: Mapping[str, ClassParameters] = {
    "car": _VEHICLE,
    "van": _VEHICLE,
    "truck": _VEHICLE,
    "pedestrian": _PEDESTRIAN,
    "cyclist": _CYCLIST,
}
AHEAD_S = (1.0, 2.0, 3.0)  # for which records and evaluations hold where a track will be
_NONE = np.zeros(0, TRACK)
DOUBT = 10.0  # scans with log odds 0 that are added to the mean in a track's score


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One tracked object at the time of a scan.

    Attributes
    ----------
    id : int
        Unique for this tracker until `Tracker.reset`.
    label : str
        Class of most of its detections.
    score : float
        In 0..1, from the log odds of its detections; `ClassParameters` has the weights of their mean, of the last one,
        of the distance and of coasting.
    box : Box
        In the sensor frame of this scan. ``box.front`` is the probability that ``box.yaw`` points to the front, from
        the motion of the track and from detections with a ``front``. A parked object keeps what was learned while it
        moved. It is None without such evidence: then the yaw points as most of the detections do. A vehicle that
        reverses for about two seconds turns around, unless detections with a ``front`` contradict.
    world_box : Box
        In the world frame or, without poses, in the sensor frame of the first scan.
    velocity : (2,) float64
        Velocity over ground along x and y of the sensor frame [m/s].
    state : (5,) float64
        x, y [m], speed along the heading [m/s], heading [rad], turn rate [rad/s], in the frame of ``world_box``.
    covariance : (5, 5) float64
        Covariance of ``state``.
    modes : mapping
        Probability of ``constant_velocity``, ``constant_turn`` and ``random_motion``.
    age_s : float
        Time since its first detection [s].
    hits : int
        Number of scans in which it was detected.
    coasting : bool
        Whether it was not detected in this scan.
    T_world_sensor : (4, 4) float64
        Pose of the sensor at this scan, as in `Tracks`.
    moving_mps : float
        Speed above which it counts as moving, of the `ClassParameters` of the tracker [m/s].
    """

    id: int
    label: str
    score: float
    box: Box
    world_box: Box
    velocity: Floats
    state: Floats
    covariance: Floats
    modes: Mapping[str, float]
    age_s: float
    hits: int
    coasting: bool
    T_world_sensor: Floats
    moving_mps: float

    @property
    def world_velocity(self) -> Floats:
        """Velocity over ground along x, y, z of the frame of ``world_box``, (3,) float64 [m/s]."""
        return float(self.state[2]) * np.array([math.cos(self.state[3]), math.sin(self.state[3]), 0.0])

    def predicted(self, ahead_s: float, *, world: bool = False) -> Box:
        """Predict the box after a time, if the object keeps its speed and its turn rate (CTRV, KUL-Seg section 6).

        Parameters
        ----------
        ahead_s : float
            Time after this scan [s], in 0..60.
        world : bool
            False: in the sensor frame of this scan, as ``box``. True: in the frame of ``world_box``.

        Returns
        -------
        Box
            With the size, label, score and front of the track. It drives on an arc in the plane of the world's x and y.

        Raises
        ------
        OptionError
            ``ahead_s`` is no such number.
        """
        ahead_s = OPTIONS.number("ahead_s", ahead_s, 0.0, 60.0)  # a float32 would round the box
        _, _, speed, heading, turn_rate = self.state.tolist()
        half = 0.5 * turn_rate * ahead_s
        chord_m = speed * ahead_s * (math.sin(half) / half if half else 1.0)
        dx, dy = chord_m * math.cos(heading + half), chord_m * math.sin(heading + half)
        yaw = wrapped(self.world_box.yaw + 2.0 * half)
        if world:
            x, y, z = self.world_box.center
            return replace(self.world_box, center=(x + dx, y + dy, z), yaw=yaw)
        x, y, z = self.box.center
        (a, b, c), (d, e, f) = self.T_world_sensor[:2, :3].tolist()  # numpy would take four times as long
        cos, sin = math.cos(yaw), math.sin(yaw)
        center = x + a * dx + d * dy, y + b * dx + e * dy, z + c * dx + f * dy
        return replace(self.box, center=center, yaw=math.atan2(b * cos + e * sin, a * cos + d * sin))

    @property
    def center(self) -> tuple[float, float, float]:
        """Center of ``box``, x, y, z [m]."""
        return self.box.center

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and height of ``box`` [m]."""
        return self.box.size

    @property
    def yaw(self) -> float:
        """Heading of ``box`` about +z from +x [rad]."""
        return self.box.yaw

    def to_dict(self) -> dict[str, Any]:
        """Convert to a dict for JSON: the entries of `Box.to_dict`, and those of the track; ``predicted`` holds x, y, z
        and yaw in 1, 2 and 3 s.
        """
        return {
            "id": self.id,
            **self.box.to_dict(),
            "velocity": [round(float(v), 3) for v in self.velocity],
            "age_s": round(self.age_s, 3),
            "hits": self.hits,
            "coasting": self.coasting,
            "modes": {name: round(share, 4) for name, share in self.modes.items()},
            "predicted": [
                [*(round(v, 4) for v in box.center), round(box.yaw, 5)] for box in map(self.predicted, AHEAD_S)
            ],
        }


class Tracks(Sequence[Track]):
    """The reported tracks after one scan, in the order of their ids; a sequence of `Track`.

    Attributes
    ----------
    stamp_s : float
        Time of the scan [s].
    T_world_sensor : (4, 4) float64
        As passed to the tracker, or estimated.
    ids : (n,) int64
    sources : (n,) int64
        Index of the box that was passed for this scan and most probably belongs to the track; -1 while it coasts.
    boxes : (n, 7) float64
        x, y, z, length, width, height [m], yaw [rad], in the sensor frame of this scan.
    scores : (n,) float64
    fronts : (n,) float64
        Probability that the yaw points to the front, in 0.5..1; NaN if it is known only up to half a turn.
    n_tentative : int
        Number of tracks that are not reported: new, not detected for some time, out of view, or in the place of another
        track.
    n_approximated : int
        Number of tracks with an association from belief propagation.
    session : int
        Number of the session: 0 at first, another one after a jump of the scans' clock. Scans of one session share
        their world frame, and no two sessions share an id.
    is_late : bool
        Whether the scan came late or twice, so that it was not tracked: there are no tracks, and ``T_world_sensor`` is
        that of the last scan.
    """

    def __init__(
        self,
        rows: Records,
        labels: Sequence[str],
        classes: Records,
        stamp_s: float,
        T_world_sensor: Floats,
        n_tentative: int = 0,
        n_approximated: int = 0,
        session: int = 0,
        *,
        is_late: bool = False,
        every: Records = _NONE,
    ) -> None:
        self.rows, self.class_names, self.class_table = rows, labels, classes
        self.every = every  # tentative tracks, too, for `smooth_tracks`
        self._made: list[Track | None] = [None] * len(rows)  # the same object each time, so that `in` finds a track
        self.stamp_s, self.T_world_sensor = stamp_s, T_world_sensor
        self.n_tentative, self.n_approximated = n_tentative, n_approximated
        self.session, self.is_late = session, is_late
        self.ids: Ints64 = rows["id"]
        self.sources: Ints64 = rows["source"]
        self.scores: Floats = 1.0 / (1.0 + np.exp(-rows["score"]))
        moved = rows["fronts"][:, 0]  # counts from the second scan in which a track moves
        odds = np.where(np.abs(moved) >= 2.0 * MOVED, moved, 0.0) + rows["fronts"][:, 1]  # that the heading is right
        self.fronts: Floats = np.where(odds != 0.0, 1.0 / (1.0 + np.exp(-np.abs(odds))), math.nan)
        R, t = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
        state, turned = rows["state"], np.where(odds == 0.0, rows["fronts"][:, 2], odds) < 0.0
        world = np.column_stack([state[:, :2], rows["shape"], wrapped(state[:, 3] + math.pi * turned)])
        self._world, self.boxes = world, world.copy()
        self.boxes[:, :3] = (world[:, :3] - t) @ R
        cos, sin = np.cos(world[:, 6]), np.sin(world[:, 6])
        self.boxes[:, 6] = np.arctan2(R[0, 1] * cos + R[1, 1] * sin, R[0, 0] * cos + R[1, 0] * sin)

    @property
    def labels(self) -> list[str]:
        """The class of each track."""
        return [self.class_names[k] for k in self.rows["label"].tolist()]

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Track: ...
    @overload
    def __getitem__(self, index: slice) -> list[Track]: ...
    def __getitem__(self, index: int | slice) -> Track | list[Track]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        index = range(len(self))[index]
        track = self._made[index] = self._made[index] or self._track(index)
        return track

    def _track(self, index: int) -> Track:
        row = self.rows[index]
        label, score = self.class_names[row["label"]], float(self.scores[index])
        front = None if math.isnan(self.fronts[index]) else float(self.fronts[index])
        state = row["state"].copy()
        heading = np.array([math.cos(state[3]), math.sin(state[3]), 0.0])
        return Track(
            id=int(row["id"]),
            label=label,
            score=score,
            box=_box(label, score, self.boxes[index], front),
            world_box=_box(label, score, self._world[index], front),
            velocity=(state[2] * heading @ self.T_world_sensor[:3, :3])[:2],
            state=state,
            covariance=row["covariance"].copy(),
            modes=dict(zip(MODES, row["modes"].tolist(), strict=True)),
            age_s=float(row["age_s"]),
            hits=int(row["hits"]),
            coasting=bool(row["misses"] > 0),
            T_world_sensor=self.T_world_sensor,
            moving_mps=float(self.class_table["moving_mps"][row["label"]]),
        )


def _box(label: str, score: float, row: Floats, front: float | None) -> Box:
    x, y, z, length, width, height, yaw = row.tolist()
    return Box(label, score, (x, y, z), (length, width, height), yaw, front)


def strength_of(tracks: Records) -> Floats:
    """Log odds of tracks (n,) float64: mean log odds of their detections, with 0 for a scan without one.

    `DOUBT` scans with log odds 0 are added. If other tracks hide a track, the scan counts by its visible share.
    """
    return np.asarray(tracks["logit_sum"] / (tracks["chances"] + DOUBT))
