"""The tracker: interaction, prediction, association, mode update, combination, and the life of a track.

Tracks live in a frame that stands still: the world of the poses given with the scans or, where none are given, the
sensor's frame of the first scan, followed by what `edgeperc.tracking.egomotion` makes of the objects.
"""

# ruff: noqa: N803 - T_target_source, as everywhere
from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import overload

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from ..errors import StampError, TrackingError
from ..perception import Box, Perception
from .egomotion import fit_motion
from .imm import fill_combined, fill_interaction, fill_mode_probabilities
from .jpda import MAX_EVENTS, fill_association, fill_likelihoods
from .ukf import MODES, fill_predictions, fill_updates

__all__ = ["PARAMETERS", "ClassParameters", "Track", "Tracker", "Tracks"]


@dataclass(frozen=True, slots=True)
class ClassParameters:
    """How objects of a class move, how well they are detected, and how long a track of one lives.

    Attributes
    ----------
    group : str
        Classes of one group may be taken for one another; a track keeps to its group.
    acceleration_mps2, turn_acceleration_rps2 : float
        Standard deviations of the white accelerations of constant velocity and CTRV.
    walk_m, wander_rad : float
        Random motion: how far place and heading walk in a second.
    still_mps : float
        Random motion: speed of what in truth stands still.
    birth_speed_mps, birth_turn_rps : float
        How fast a newborn track may be.
    keep_motion_s : float
        Mean time for which a track keeps its motion.
    along_m, across_m, heading_rad : float
        Standard deviations of a detection beside the sensor; they grow by their own size every ``range_m``.
    shape_m : tuple of 4 float
        Likewise of middle height, length, width and height.
    range_m : float
    detection : float
        Probability that an object in plain sight is detected in a scan.
    clutter : float
        False detections and new objects per square metre and radian.
    gate : float
        Mahalanobis distance beyond which a detection is none of a track's.
    birth_score : float
        Detections with a lower score begin no track.
    sure_score : float
        One detection with this score is told of at once, without a second.
    memory_s : float
        A track that is not detected is forgotten after this time, if it was not given up before.
    """

    group: str
    acceleration_mps2: float = 3.0
    turn_acceleration_rps2: float = 0.5
    walk_m: float = 0.3
    wander_rad: float = 0.1
    still_mps: float = 0.1
    birth_speed_mps: float = 8.0
    birth_turn_rps: float = 0.2
    keep_motion_s: float = 3.0
    along_m: float = 0.15
    across_m: float = 0.10
    heading_rad: float = 0.06
    shape_m: tuple[float, float, float, float] = (0.06, 0.25, 0.10, 0.10)
    range_m: float = 30.0
    detection: float = 0.8
    clutter: float = 1e-3
    gate: float = 5.0
    birth_score: float = 0.0
    sure_score: float = 0.95
    memory_s: float = 1.5


_VEHICLE = ClassParameters(group="vehicle")
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
)
_CYCLIST = ClassParameters(
    group="cyclist",
    turn_acceleration_rps2=0.8,
    birth_speed_mps=4.0,
    along_m=0.09,
    across_m=0.07,
    heading_rad=0.08,
    shape_m=(0.08, 0.15, 0.12, 0.08),
)
PARAMETERS: Mapping[str, ClassParameters] = {
    "car": _VEHICLE,
    "van": _VEHICLE,
    "truck": _VEHICLE,
    "pedestrian": _PEDESTRIAN,
    "cyclist": _CYCLIST,
}

# One row a track. Everything the tracker knows of it is here, so that a frame that fails leaves no trace.
_TRACK = np.dtype(
    [
        ("id", np.int64),
        ("label", np.int64),
        ("group", np.int64),
        ("label_weight", np.float64),
        ("states", np.float64, (3, 5)),
        ("covariances", np.float64, (3, 5, 5)),
        ("modes", np.float64, 3),
        ("state", np.float64, 5),
        ("covariance", np.float64, (5, 5)),
        ("shape", np.float64, 4),
        ("shape_variance", np.float64, 4),
        ("front", np.float64),
        ("logit_sum", np.float64),
        ("chances", np.float64),
        ("age_s", np.float64),
        ("missed_s", np.float64),
        ("hits", np.int64),
        ("misses", np.int64),
        ("existence", np.float64),
    ]
)
# One row a class seen so far: its parameters as the kernels take them.
_CLASS = np.dtype(
    [
        ("group", np.int64),
        ("noise", np.float64, 5),
        ("sigmas", np.float64, 3),
        ("shape", np.float64, 4),
        ("birth", np.float64, 2),
        *(
            (name, np.float64)
            for name in (
                "still_mps",
                "keep_motion_s",
                "range_m",
                "detection",
                "odds",
                "gate",
                "birth_logit",
                "sure_logit",
            )
        ),
        ("memory_s", np.float64),
    ]
)
SMALLEST_SHARE = 1e-13  # scores of 0 and 1 are no surer than that
DOUBT = 10.0
# Existence, as log odds: a track is told of above 0 and given up below the least. A detection counts by its score, and
# for lying where it was expected; without a most, what was long there would be told of long after it is gone.
EXPECTED, MOST_EXISTENCE, LEAST_EXISTENCE = 1.0, 5.0, -6.0
# What covers a track may be covering it by a little less than its own box says.
MOST_HIDDEN = 0.9
SHAPE_WALK_M = np.array([0.5, 0.1, 0.05, 0.05])  # of middle height, length, width and height in a second
# A vehicle begins anywhere up to motorway speed, and straight ahead; then its speed and turn rate walk.
FIRST_TWIST = np.array([15.0, 1.0, 0.3])
TWIST_WALK = np.array([4.0, 0.5, 0.5])  # in a second
TURN_MEMORY_S = 2.0  # a turn that nothing speaks for any longer ends
MAX_LANDMARKS = 48


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One object, as it is now.

    Attributes
    ----------
    id : int
        Never used again.
    label : str
        The class it was detected as most of the time.
    score : float
        In 0..1: of its detections, taken together.
    box : Box
        In the sensor's frame of this scan.
    world_box : Box
        In the world's frame or, without poses, the sensor's frame of the first scan.
    velocity : (2,) float64
        Over ground, along x and y of the sensor's frame [m/s].
    state : (5,) float64
        x, y [m], speed along the heading [m/s], heading [rad], turn rate [rad/s], in the frame of ``world_box``.
    covariance : (5, 5) float64
    modes : mapping
        Probability of ``constant_velocity``, ``constant_turn`` and ``random_motion``.
    age_s : float
        Since its first detection.
    hits : int
        Scans in which it was detected.
    coasting : bool
        Not detected in this scan.
    """

    id: int
    label: str
    score: float
    box: Box
    world_box: Box
    velocity: NDArray[np.float64]
    state: NDArray[np.float64]
    covariance: NDArray[np.float64]
    modes: Mapping[str, float]
    age_s: float
    hits: int
    coasting: bool


class Tracks(Sequence[Track]):
    """The tracks that are told of after one scan, in the order of their ids; `Track` objects are made when asked for.

    Attributes
    ----------
    stamp_s : float
    T_world_sensor : (4, 4) float64
        As given, or as estimated.
    ids : (n,) int64
    boxes : (n, 7) float64
        x, y, z, length, width, height [m], yaw [rad], in the sensor's frame of this scan.
    scores : (n,) float64
    n_tentative : int
        Tracks too doubtful to be told of: new ones, and those not detected for too long.
    n_approximated : int
        Tracks whose association was solved by belief propagation.
    """

    __slots__ = (
        "T_world_sensor",
        "_labels",
        "_rows",
        "boxes",
        "ids",
        "n_approximated",
        "n_tentative",
        "scores",
        "stamp_s",
    )

    def __init__(
        self,
        rows: NDArray[np.void],
        labels: Sequence[str],
        stamp_s: float,
        T_world_sensor: NDArray[np.float64],
        n_tentative: int = 0,
        n_approximated: int = 0,
    ) -> None:
        self._rows, self._labels = rows, labels
        self.stamp_s, self.T_world_sensor = stamp_s, T_world_sensor
        self.n_tentative, self.n_approximated = n_tentative, n_approximated
        self.ids: NDArray[np.int64] = rows["id"]
        self.scores: NDArray[np.float64] = 1.0 / (1.0 + np.exp(-_strength(rows)))
        R, t = T_world_sensor[:3, :3], T_world_sensor[:3, 3]
        world = self._world_boxes()
        self.boxes: NDArray[np.float64] = world.copy()
        self.boxes[:, :3] = (world[:, :3] - t) @ R
        cos, sin = np.cos(world[:, 6]), np.sin(world[:, 6])
        self.boxes[:, 6] = np.arctan2(R[0, 1] * cos + R[1, 1] * sin, R[0, 0] * cos + R[1, 0] * sin)

    def _world_boxes(self) -> NDArray[np.float64]:
        state, shape = self._rows["state"], self._rows["shape"]
        boxes = np.empty((len(state), 7))
        boxes[:, :2], boxes[:, 2:6] = state[:, :2], shape
        boxes[:, 6] = _wrap(state[:, 3] + math.pi * (self._rows["front"] < 0.0))
        return boxes

    @property
    def labels(self) -> list[str]:
        """Class of each track."""
        return [self._labels[k] for k in self._rows["label"].tolist()]

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Track: ...
    @overload
    def __getitem__(self, index: slice) -> list[Track]: ...
    def __getitem__(self, index: int | slice) -> Track | list[Track]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        row = self._rows[index]
        label, score = self._labels[row["label"]], float(self.scores[index])
        state = row["state"].copy()
        heading = np.array([math.cos(state[3]), math.sin(state[3]), 0.0])
        return Track(
            id=int(row["id"]),
            label=label,
            score=score,
            box=_box(label, score, self.boxes[index]),
            world_box=_box(label, score, self._world_boxes()[index]),
            velocity=(state[2] * heading @ self.T_world_sensor[:3, :3])[:2],
            state=state,
            covariance=row["covariance"].copy(),
            modes=dict(zip(MODES, row["modes"].tolist(), strict=True)),
            age_s=float(row["age_s"]),
            hits=int(row["hits"]),
            coasting=bool(row["misses"] > 0),
        )

    def __iter__(self) -> Iterator[Track]:
        return (self[k] for k in range(len(self)))


class Tracker:
    """Follow objects from scan to scan.

    Takes the boxes of any detector. One instance follows one stream, in one thread; results are yours. An error leaves
    it as it was before the call.

    Parameters
    ----------
    parameters : mapping of str to ClassParameters, optional
        By class; those not named keep their defaults, and classes without any are followed like cars, apart from them.
    field_of_view_deg : tuple of 2 float
        Azimuths of the detector's left and right edge, counter-clockwise from ahead. What leaves it is not told of any
        longer. By default all around.
    max_tracks : int
        Tracks kept at a time, tentative ones included; beyond, the weakest go. Bounds memory and the time a scan takes.

    Examples
    --------
    >>> tracker = Tracker()
    >>> for k in range(3):
    ...     tracks = tracker.update([Box("car", 0.9, (10.0 + k, 2.0, -0.9), (4.2, 1.8, 1.5), 0.0)], stamp_s=0.1 * k)
    >>> [(track.id, track.label) for track in tracks]
    [(1, 'car')]
    """

    def __init__(
        self,
        parameters: Mapping[str, ClassParameters] | None = None,
        *,
        field_of_view_deg: tuple[float, float] = (180.0, -180.0),
        max_tracks: int = 1024,
    ) -> None:
        self._parameters = {**PARAMETERS, **(parameters or {})}
        self._left, self._right = np.radians(field_of_view_deg)
        self._max_tracks = max_tracks
        self.reset()

    def reset(self) -> None:
        """Forget every track, the time and the pose."""
        self._labels: list[str] = []
        self._groups: list[str] = []
        self._tracks = np.zeros(0, _TRACK)
        self._next_id = 1
        self._stamp_s = -math.inf
        self._T_world_sensor = np.eye(4)
        self._posed: bool | None = None
        # Without poses: speed along x and y, turn rate of the sensor, and their variances.
        self._twist = np.zeros(3)
        self._twist_variances = FIRST_TWIST**2
        self._classes = np.zeros(0, _CLASS)

    def __call__(self, perception: Perception, T_world_sensor: ArrayLike | None = None) -> Tracks:
        """Follow the boxes of a perception, at the time that was given with its scan.

        Parameters
        ----------
        perception : Perception
        T_world_sensor : (4, 4) array_like, optional
            As in `update`.

        Returns
        -------
        Tracks

        Raises
        ------
        StampError
            The perception has no stamp, or one that is no later than the last.
        TrackingError
            As in `update`.
        """
        if perception.stamp_s is None:
            raise StampError("the perception has no stamp_s; call perceive(points, stamp_s=...) with the scan's time")
        return self.update(perception.boxes, perception.stamp_s, T_world_sensor)

    def update(self, boxes: Iterable[Box], stamp_s: float, T_world_sensor: ArrayLike | None = None) -> Tracks:
        """Take in one scan's boxes.

        Parameters
        ----------
        boxes : iterable of Box
            Any detector's, in the sensor's frame; there may be none.
        stamp_s : float
            When the scan was taken [s]; later than the last.
        T_world_sensor : (4, 4) array_like, optional
            Pose of the sensor, rigid. Give it with every scan or with none; without, the sensor's motion on the ground
            is estimated from the objects that stand still. Where only one or two objects are seen, theirs and the
            sensor's motion cannot be told apart: tracks keep their identity, and speeds over ground mean little.

        Returns
        -------
        Tracks
            Those more likely there than not. One that is not detected coasts, in plain sight for a few scans, behind
            another track for longer.

        Raises
        ------
        StampError
            ``stamp_s`` is not finite, or no later than that of the last scan.
        TrackingError
            A box or the pose is not finite or none, or poses come with some scans only.
        """
        stamp_s = float(stamp_s)
        if not math.isfinite(stamp_s) or stamp_s <= self._stamp_s:
            raise StampError(
                f"got a scan at {stamp_s} s after one at {self._stamp_s} s; pass scans in the order of their times, "
                "each once, or call reset() before a new recording"
            )
        posed = T_world_sensor is not None
        if self._posed is not None and posed != self._posed:
            raise TrackingError(
                f"got a scan {'with' if posed else 'without'} T_world_sensor, unlike those before it; pass it with all "
                "scans or with none, or call reset() before a new recording"
            )
        given, names = _checked_boxes(boxes)
        pose = None if T_world_sensor is None else _checked_pose(T_world_sensor)
        kinds = self._kinds(names)
        classes = self._classes[kinds]

        dt = stamp_s - self._stamp_s if self._posed is not None else 0.0
        tracks = self._tracks[self._tracks["missed_s"] + dt <= self._classes["memory_s"][self._tracks["label"]]]
        of = self._classes[tracks["label"]]
        n, m = len(tracks), len(given)

        # Interaction.
        mixed, mixed_covariances, prior = np.empty((n, 3, 5)), np.empty((n, 3, 5, 5)), np.empty((n, 3))
        stay = np.exp(-dt / of["keep_motion_s"])
        fill_interaction(
            tracks["states"], tracks["covariances"], tracks["modes"], stay, mixed, mixed_covariances, prior
        )

        # Prediction.
        means, predicted = np.empty_like(mixed), np.empty_like(mixed_covariances)
        fill_predictions(mixed, mixed_covariances, of["noise"], dt, means, predicted)
        state, covariance = np.empty((n, 5)), np.empty((n, 5, 5))
        fill_combined(means, predicted, prior, state, covariance)
        twist, twist_variances = self._twist, self._twist_variances
        if pose is None:
            pose, twist, twist_variances = self._estimated_pose(tracks, state, covariance, given, classes, dt)

        # Data association.
        detections, heights = _in_world(given, pose)
        shapes = given[:, 2:6].copy()
        shapes[:, 0] = heights
        farther = 1.0 + np.hypot(state[:, 0] - pose[0, 3], state[:, 1] - pose[1, 3]) / of["range_m"]
        sigmas = of["sigmas"] * farther[:, None]
        likelihoods, weights, beta = np.empty((n, 3, m)), np.empty((n, m)), np.empty((n, m + 1))
        fill_likelihoods(
            means,
            predicted,
            sigmas,
            prior,
            of["odds"],
            tracks["group"],
            detections,
            classes["group"],
            of["gate"],
            likelihoods,
            weights,
        )
        n_approximated = fill_association(weights, MAX_EVENTS, beta)

        # Mode probability update, with the update of each motion.
        shares = np.empty((n, 3, m + 1))
        fill_mode_probabilities(prior, likelihoods, beta, shares, tracks["modes"])
        fill_updates(means, predicted, detections, sigmas, shares, tracks["states"], tracks["covariances"])

        # Combination.
        fill_combined(tracks["states"], tracks["covariances"], tracks["modes"], tracks["state"], tracks["covariance"])
        update_shapes(
            tracks["state"],
            beta,
            detections,
            shapes,
            of["shape"] * farther[:, None],
            SHAPE_WALK_M * math.sqrt(dt),
            tracks["shape"],
            tracks["shape_variance"],
            tracks["front"],
        )
        hidden = np.zeros(n)
        fill_hidden(tracks["state"], tracks["shape"], beta[:, 0] < 0.5, pose[:2, 3], hidden)
        logits = _logit(given[:, 7])
        update_lives(tracks, of, beta, hidden, logits, kinds, dt)

        # A detection that is most likely nobody's begins a track.
        own = np.flatnonzero((beta[:, 1:].sum(axis=0) < 0.5) & (logits >= classes["birth_logit"]))
        if len(own):
            ranges = np.hypot(given[own, 0], given[own, 1])
            joined = np.zeros(n + len(own), _TRACK)  # concatenate takes ten times as long over named fields
            joined[:n] = tracks
            fill_newborn(
                self._next_id, kinds[own], classes[own], detections[own], shapes[own], logits[own], ranges, joined[n:]
            )
            tracks = joined
        tracks = self._living(tracks)

        self._posed, self._stamp_s, self._tracks, self._T_world_sensor = posed, stamp_s, tracks, pose
        self._next_id += len(own)
        self._twist, self._twist_variances = twist, twist_variances
        told = tracks["existence"] > 0.0
        mark_out_of_view(tracks, pose, self._left, self._right, told)
        mark_rivals(tracks["state"], tracks["shape"], _strength(tracks), told)
        return Tracks(
            tracks[told], self._labels, stamp_s, pose.copy(), int(len(tracks) - np.count_nonzero(told)), n_approximated
        )

    def _kinds(self, names: Sequence[str]) -> NDArray[np.int64]:
        """Row of each box's class, which is made when it is first met."""
        for name in names:
            if name in self._labels:
                continue
            of = self._parameters.get(name) or replace(PARAMETERS["car"], group=name)
            if of.group not in self._groups:
                self._groups.append(of.group)
            row = np.zeros(1, _CLASS)
            row["group"] = self._groups.index(of.group)
            for field in ("still_mps", "keep_motion_s", "range_m", "detection", "gate", "memory_s"):
                row[field] = getattr(of, field)
            row["noise"] = of.acceleration_mps2, of.turn_acceleration_rps2, of.walk_m, of.wander_rad, of.still_mps
            row["sigmas"] = of.along_m, of.across_m, of.heading_rad
            row["shape"] = of.shape_m
            row["birth"] = of.birth_speed_mps, of.birth_turn_rps
            row["odds"] = of.detection / ((1.0 - of.detection) * of.clutter)
            row["birth_logit"], row["sure_logit"] = _logit(of.birth_score), _logit(of.sure_score)
            self._labels.append(name)
            self._classes = np.concatenate([self._classes, row])
        return np.array([self._labels.index(name) for name in names], np.int64)

    def _estimated_pose(
        self,
        tracks: NDArray[np.void],
        state: NDArray[np.float64],
        covariance: NDArray[np.float64],
        given: NDArray[np.float64],
        classes: NDArray[np.void],
        dt: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Where the sensor is by now, how it moves (x, y [m/s], turn [rad/s]) and with what variances."""
        if dt == 0.0:
            return self._T_world_sensor, self._twist, self._twist_variances
        seen = np.flatnonzero(tracks["misses"] == 0)
        landmarks = np.empty((len(seen), 4))
        landmarks[:, :2] = (state[seen, :2] - self._T_world_sensor[:2, 3]) @ self._T_world_sensor[:2, :2]
        landmarks[:, 2] = 0.5 * (covariance[seen, 0, 0] + covariance[seen, 1, 1])
        landmarks[:, 3] = tracks["group"][seen]
        if len(landmarks) > MAX_LANDMARKS:
            landmarks = landmarks[np.argsort(landmarks[:, 2], kind="stable")[:MAX_LANDMARKS]]
        detections = np.empty((len(given), 4))
        detections[:, :2], detections[:, 3] = given[:, :2], classes["group"]
        farther = 1.0 + np.hypot(given[:, 0], given[:, 1]) / classes["range_m"]
        detections[:, 2] = (classes["sigmas"][:, 0] * farther) ** 2
        if len(detections) > 2 * MAX_LANDMARKS:
            detections = detections[np.argsort(detections[:, 2], kind="stable")[: 2 * MAX_LANDMARKS]]
        kept = np.array([1.0, 1.0, math.exp(-dt / TURN_MEMORY_S)])
        prior_variances = (self._twist_variances * kept**2 + TWIST_WALK**2 * dt) * dt**2
        motion, spread = np.empty(3), np.empty((3, 3))
        fit_motion(landmarks, detections, self._twist * kept * dt, prior_variances, motion, spread)
        cos, sin = math.cos(motion[2]), math.sin(motion[2])
        step = np.array([[cos, -sin, 0, motion[0]], [sin, cos, 0, motion[1]], [0, 0, 1, 0], [0, 0, 0, 1]])
        return self._T_world_sensor @ step, motion / dt, np.minimum(np.diag(spread) / dt**2, FIRST_TWIST**2)

    def _living(self, tracks: NDArray[np.void]) -> NDArray[np.void]:
        """Tracks that are not given up; of too many, the likeliest."""
        stays = tracks["existence"] > LEAST_EXISTENCE
        if not stays.all():
            tracks = tracks[stays]
        if len(tracks) > self._max_tracks:
            rank = np.argsort(-tracks["existence"], kind="stable")
            tracks = tracks[np.sort(rank[: self._max_tracks])]
        return tracks


@njit(cache=True, nogil=True)
def fill_newborn(
    first_id: int,
    kinds: NDArray[np.int64],
    classes: NDArray[np.void],
    detections: NDArray[np.float64],
    shapes: NDArray[np.float64],
    logits: NDArray[np.float64],
    ranges: NDArray[np.float64],
    tracks: NDArray[np.void],
) -> None:
    """Begin a track with each detection; it stands still until the next scan.

    Parameters
    ----------
    first_id : int
    kinds : (n,) int64
        Labels.
    classes : (n,) record
        Parameters of each detection's class.
    detections : (n, 3) float64
        x, y [m], heading [rad].
    shapes : (n, 4) float64
        Height of the middle, length, width, height [m].
    logits : (n,) float64
        Scores.
    ranges : (n,) float64
        Distances from the sensor [m].
    tracks : (n,) record, overwritten
        All fields 0 beforehand.
    """
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        farther = 1.0 + ranges[i] / of["range_m"]
        x, y, heading = detections[i, 0], detections[i, 1], detections[i, 2]
        cos, sin = math.cos(heading), math.sin(heading)
        along, across, turn = of["sigmas"][0] * farther, of["sigmas"][1] * farther, of["sigmas"][2] * farther
        track["id"], track["label"], track["group"] = first_id + i, kinds[i], of["group"]
        track["hits"], track["chances"], track["front"], track["label_weight"] = 1, 1.0, 1.0, 1.0
        track["logit_sum"] = logits[i]
        track["existence"] = min(logits[i] - of["sure_logit"], MOST_EXISTENCE)
        for a in range(4):
            track["shape"][a] = shapes[i, a]
            track["shape_variance"][a] = (of["shape"][a] * farther) ** 2
        for mode in range(3):
            track["modes"][mode] = 1.0 / 3.0
            state, spread = track["states"][mode], track["covariances"][mode]
            state[0], state[1], state[3] = x, y, heading
            spread[0, 0] = (along * cos) ** 2 + (across * sin) ** 2
            spread[1, 1] = (along * sin) ** 2 + (across * cos) ** 2
            spread[0, 1] = spread[1, 0] = (along**2 - across**2) * cos * sin
            spread[2, 2] = of["birth"][0] ** 2 if mode < 2 else of["still_mps"] ** 2
            spread[3, 3] = turn**2
            spread[4, 4] = of["birth"][1] ** 2
            for a in range(5):
                track["state"][a] = state[a]
                for b in range(5):
                    track["covariance"][a, b] += spread[a, b] / 3.0


@njit(cache=True, nogil=True)
def mark_out_of_view(
    tracks: NDArray[np.void], pose: NDArray[np.float64], left: float, right: float, told: NDArray[np.bool_]
) -> None:
    """Leave out tracks that were not detected and of whose footprint a corner lies beyond the field of view.

    Parameters
    ----------
    tracks : (n,) record
    pose : (4, 4) float64
        T_world_sensor.
    left, right : float
        Azimuths of the edges [rad].
    told : (n,) bool
        Those left out become False.
    """
    for i in range(len(tracks)):
        if not told[i] or tracks[i]["misses"] == 0:
            continue
        state, shape = tracks[i]["state"], tracks[i]["shape"]
        cos, sin = math.cos(state[3]), math.sin(state[3])
        for corner in range(4):
            along = 0.5 * shape[1] * (1.0 if corner < 2 else -1.0)
            across = 0.5 * shape[2] * (1.0 if corner % 2 == 0 else -1.0)
            x = state[0] + along * cos - across * sin - pose[0, 3]
            y = state[1] + along * sin + across * cos - pose[1, 3]
            azimuth = math.atan2(x * pose[0, 1] + y * pose[1, 1], x * pose[0, 0] + y * pose[1, 0])
            if not right <= azimuth <= left:
                told[i] = False


@njit(cache=True, nogil=True)
def fill_hidden(
    state: NDArray[np.float64],
    shape: NDArray[np.float64],
    seen: NDArray[np.bool_],
    sensor: NDArray[np.float64],
    hidden: NDArray[np.float64],
) -> None:
    """Write which share of each track stands behind others, seen from the sensor.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate.
    shape : (n, 4) float64
        Height of the middle, length, width, height.
    seen : (n,) bool
        Tracks detected in this scan; these cover others, and are covered by none.
    sensor : (2,) float64
        x, y [m].
    hidden : (n,) float64, overwritten
        In 0..1, of nine rays over the width of the footprint.
    """
    n = len(hidden)
    azimuth, half, distance = np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        dx, dy = state[i, 0] - sensor[0], state[i, 1] - sensor[1]
        azimuth[i], distance[i] = math.atan2(dy, dx), math.hypot(dx, dy)
        turned = state[i, 3] - azimuth[i]
        width = shape[i, 1] * abs(math.sin(turned)) + shape[i, 2] * abs(math.cos(turned))
        half[i] = math.atan2(0.5 * width, distance[i])
    hidden[:] = 0.0
    for i in range(n):
        if seen[i]:
            continue
        for ray in range(9):
            at = azimuth[i] + half[i] * (0.25 * ray - 1.0)
            for j in range(n):
                off = at - azimuth[j]
                off -= 2.0 * math.pi * math.floor(off / (2.0 * math.pi) + 0.5)
                if seen[j] and distance[j] < distance[i] - 1.0 and abs(off) <= half[j]:
                    hidden[i] += 1.0 / 9.0
                    break


@njit(cache=True, nogil=True)
def mark_rivals(
    state: NDArray[np.float64], shape: NDArray[np.float64], strength: NDArray[np.float64], told: NDArray[np.bool_]
) -> None:
    """Leave out tracks whose middle lies in a stronger one's footprint, or the other way round.

    No two things share a place, whatever a detector calls them: a cyclist is often found as a pedestrian, too.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate.
    shape : (n, 4) float64
        Height of the middle, length, width, height.
    strength : (n,) float64
        Of equals the earlier stays.
    told : (n,) bool
        Those left out become False.
    """
    # All of the stronger ones of a track stand before it in this order, so their verdicts are final.
    order = np.argsort(-strength, kind="mergesort")
    for b in range(len(order)):
        weak = order[b]
        for a in range(b):
            strong = order[a]
            if not told[weak]:
                break
            if not told[strong]:
                continue
            dx, dy = state[weak, 0] - state[strong, 0], state[weak, 1] - state[strong, 1]
            reach = 0.5 * max(shape[weak, 1] + shape[weak, 2], shape[strong, 1] + shape[strong, 2])
            if abs(dx) > reach or abs(dy) > reach:  # as nearly all are, in a tenth of the time
                continue
            for i in (weak, strong):
                cos, sin = math.cos(state[i, 3]), math.sin(state[i, 3])
                if abs(dx * cos + dy * sin) < 0.5 * shape[i, 1] and abs(dy * cos - dx * sin) < 0.5 * shape[i, 2]:
                    told[weak] = False


@njit(cache=True, nogil=True)
def update_shapes(
    state: NDArray[np.float64],
    beta: NDArray[np.float64],
    detections: NDArray[np.float64],
    shapes: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    walk: NDArray[np.float64],
    shape: NDArray[np.float64],
    variance: NDArray[np.float64],
    front: NDArray[np.float64],
) -> None:
    """Smooth middle height and size by a Kalman filter each, and vote on which end is the front; in place.

    Parameters
    ----------
    state : (n, 5) float64
        x, y, v, heading, turn rate after the update.
    beta : (n, m + 1) float64
        Probability that the track was not detected, and that each detection is the track's.
    detections : (m, 3) float64
        x, y [m], heading [rad].
    shapes : (m, 4) float64
        Height of the middle, length, width, height [m].
    sigmas : (n, 4) float64
        Their standard deviations [m].
    walk : (4,) float64
        How far they walk between the scans [m].
    shape, variance : (n, 4) float64
    front : (n,) float64
        Votes, in -10..10; below 0 the front is behind. What moves, mostly moves forward.
    """
    for i in range(len(front)):
        vote = 0.5 * math.tanh(state[i, 2] / 3.0)
        seen = np.zeros(4)
        for j in range(len(detections)):
            if beta[i, j + 1] == 0.0:
                continue
            vote += beta[i, j + 1] * math.cos(detections[j, 2] - state[i, 3])
            for a in range(4):
                seen[a] += beta[i, j + 1] * shapes[j, a]
        front[i] = min(max(front[i] + vote, -10.0), 10.0)
        detected = 1.0 - beta[i, 0]
        for a in range(4):
            variance[i, a] += walk[a] * walk[a]
            gain = variance[i, a] / (variance[i, a] + sigmas[i, a] * sigmas[i, a])
            shape[i, a] += gain * (seen[a] - detected * shape[i, a])
            variance[i, a] *= 1.0 - gain * detected


@njit(cache=True, nogil=True)
def update_lives(
    tracks: NDArray[np.void],
    classes: NDArray[np.void],
    beta: NDArray[np.float64],
    hidden: NDArray[np.float64],
    logits: NDArray[np.float64],
    kinds: NDArray[np.int64],
    dt: float,
) -> None:
    """Count hits and misses, take the label of the majority, weigh how likely each is still there; in place.

    Parameters
    ----------
    tracks : (n,) record
    classes : (n,) record
        Parameters of each track's class.
    beta : (n, m + 1) float64
        Probability that the track was not detected, and that each detection is the track's.
    hidden : (n,) float64
        From `fill_hidden`.
    logits : (m,) float64
        Scores of the detections.
    kinds : (m,) int64
        Their labels.
    dt : float
    """
    for i in range(len(tracks)):
        track, of = tracks[i], classes[i]
        track["age_s"] += dt
        if beta[i, 0] >= 0.5:
            track["chances"] += 1.0 - MOST_HIDDEN * hidden[i]
            track["misses"] += 1
            track["missed_s"] += dt
            # The odds go by how likely a miss is if something is there, over 1 if nothing is.
            track["existence"] += math.log(1.0 - of["detection"] * (1.0 - MOST_HIDDEN * hidden[i]))
            continue
        best = np.argmax(beta[i, 1:])
        track["misses"], track["missed_s"] = 0, 0.0
        track["hits"] += 1
        track["chances"] += 1.0
        track["logit_sum"] += logits[best]
        # Boyer and Moore's vote: a label goes when the others have outnumbered it.
        weight = track["label_weight"] + (1.0 if track["label"] == kinds[best] else -1.0)
        if weight < 0.0:
            track["label"] = kinds[best]
        track["label_weight"] = min(abs(weight), 20.0)
        # What is seen again is worth no less than what is seen for the first time.
        existence = max(track["existence"], -of["sure_logit"]) + max(logits[best], 0.0) + EXPECTED
        track["existence"] = min(existence, MOST_EXISTENCE)


def _checked_boxes(boxes: Iterable[Box]) -> tuple[NDArray[np.float64], list[str]]:
    """Rows x, y, z, length, width, height, yaw, score, and the labels."""
    given = list(boxes)
    try:
        rows = np.array([(*box.center, *box.size, box.yaw, box.score) for box in given], np.float64).reshape(-1, 8)
        names = [box.label for box in given]
    except (AttributeError, TypeError, ValueError) as exc:
        raise TrackingError(f"got boxes that are none ({exc}); pass edgeperc.Box objects") from exc
    right = np.isfinite(rows).all(axis=1) & (rows[:, 3:6] > 0.0).all(axis=1) & (rows[:, 7] >= 0.0) & (rows[:, 7] <= 1.0)
    if not right.all():
        wrong = given[int(np.argmin(right))]
        raise TrackingError(
            f"got {wrong}; expected finite numbers, sizes above 0 and a score in 0..1: drop such boxes before tracking"
        )
    return rows, names


def _checked_pose(given: ArrayLike) -> NDArray[np.float64]:
    try:
        pose = np.array(given, np.float64)
    except (TypeError, ValueError) as exc:
        raise TrackingError(f"got a T_world_sensor that is no matrix ({exc}); expected (4, 4) numbers") from exc
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise TrackingError(f"got a T_world_sensor of shape {pose.shape}; expected (4, 4) finite numbers")
    off = np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(pose[:3, :3]) < 0.0 or (pose[3] != [0.0, 0.0, 0.0, 1.0]).any():
        raise TrackingError("got a T_world_sensor that is not rigid; expected a rotation and a translation")
    return pose


def _in_world(given: NDArray[np.float64], pose: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x, y and heading (m, 3), and the heights of the middles (m,), in the world's frame."""
    placed = given[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    cos, sin = np.cos(given[:, 6]), np.sin(given[:, 6])
    heights = placed[:, 2].copy()
    placed[:, 2] = np.arctan2(pose[1, 0] * cos + pose[1, 1] * sin, pose[0, 0] * cos + pose[0, 1] * sin)
    return placed, heights


def _box(label: str, score: float, row: NDArray[np.float64]) -> Box:
    x, y, z, length, width, height, yaw = row.tolist()
    return Box(label, score, (x, y, z), (length, width, height), yaw)


def _logit(scores: NDArray[np.float64] | float) -> NDArray[np.float64]:
    inside = np.clip(scores, SMALLEST_SHARE, 1.0 - SMALLEST_SHARE)
    return np.log(inside) - np.log1p(-inside)


def _strength(tracks: NDArray[np.void]) -> NDArray[np.float64]:
    """Log odds of a track: the mean of its detections', scans without one and `DOUBT` scans before it being even.

    A scan in which others hid it counts by how much of it was to be seen.
    """
    return np.asarray(tracks["logit_sum"] / (tracks["chances"] + DOUBT))


def _wrap(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray((angles + math.pi) % (2.0 * math.pi) - math.pi)
