"""The tracker: interaction, prediction, association, mode update, combination, and the life of tracks.

Tracks are kept in a fixed frame: the world frame of the poses or, without poses, the sensor frame of the first scan. In
the latter case, `edgeperc.tracking.egomotion` estimates the sensor's motion.
"""

from __future__ import annotations

import math
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..errors import OptionError, StampError, TrackingError
from ..system.clock import GAP_S, LATEST_S, Clock, Step, as_seconds
from ..system.fields import OPTIONS
from ..types.frame import model_rotation
from ..types.mounting import MODEL_MOUNTING, Mounting
from ..types.perception import Box, Perception, check_perception
from ..types.points import Floats, Ints64, Records
from ..types.rigid import rigid
from . import lives
from .egomotion import fit_motion
from .imm import fill_combined, fill_interaction, fill_mode_probabilities
from .jpda import MAX_EVENTS, Detections, Gates, Predictions, fill_association, fill_likelihoods
from .tracks import PARAMETERS, ClassParameters, Tracks, strength_of
from .ukf import RANDOM_MOTION, fill_predictions, fill_updates

SMALLEST_SHARE = 1e-13  # scores are clipped to this distance from 0 and 1
# Standard deviations of random walks of center height, length, width and height after one second.
SHAPE_WALK_M = np.array([0.5, 0.1, 0.05, 0.05])

# Standard deviations of the vehicle's speed ahead and to the left [m/s] and of its turn rate [rad/s]: at the start,
# allowing for motorway speed ahead, and of their random walks after one second.
FIRST_TWIST = np.array([15.0, 1.0, 0.3])
TWIST_WALK = np.array([4.0, 0.5, 0.5])
TURN_MEMORY_S = 2.0  # without evidence, the estimated turn rate decays with this time constant
MAX_LANDMARKS = 48
PEOPLE = ("pedestrian", "cyclist")  # groups of what hardly ever stands; vehicles mostly do

# Beyond these limits squares and differences of numbers lose their meaning, or overflow.
FARTHEST_M = 1e8  # coordinates of boxes and poses; projected map coordinates are up to 1e7
SIZES_M = (1e-6, 1e6)


@dataclass(frozen=True, eq=False, slots=True)
class _Session:
    """Tracks from scan to scan without a jump of the clock, and the sensor's motion. An update makes a new one."""

    number: int = 0
    stamp_s: float = 0.0
    posed: bool | None = None  # None before the first scan
    tracks: Records = field(default_factory=lambda: np.zeros(0, lives.TRACK))
    T_world_sensor: Floats = field(default_factory=lambda: np.eye(4))
    # Without poses: the vehicle's speed ahead and to the left, its turn rate, and their variances.
    twist: Floats = field(default_factory=lambda: np.zeros(3))
    twist_variances: Floats = field(default_factory=lambda: FIRST_TWIST**2)


class Tracker:
    """Track objects from scan to scan.

    The boxes may come from any detector. Use one instance for each stream, in one thread. The caller owns the results.
    An error leaves the tracker unchanged.

    A clock that is wrong ends no tracking. A warning says so once for each of these cases:

    - A late or doubled scan is up to 0.25 s earlier than the last one, or less than 1 us later. It changes no track
      and has none (`Tracks.is_late`). After two such scans in a row, an earlier stamp is a jump.
    - After a jump, by more than 0.25 s back or 60 s forward (`ClassParameters.memory_s`, if that is longer), tracking
      begins anew, with new ids (`Tracks.session`).
    - If the scan after a jump continues the times before the jump, the jump was the wrong stamp of one scan: the former
      tracks go on with their ids.
    - After a pause that is longer than ``ClassParameters.memory_s``, 1.5 s, every track has ended. Where all scans are
      so far apart, or stamps in other units say so, there are hardly any tracks.

    An id is not used again before `reset`.

    Parameters
    ----------
    parameters : mapping of str to ClassParameters, optional
        Parameters by class, in place of the defaults. A class without defaults gets those of cars, in its own group.
    field_of_view_deg : tuple of 2 float
        Azimuths of the left and right edge of the detector's view [deg], counter-clockwise from +x, the left one
        higher: (220, 140) looks back. A track that leaves it is no longer reported. Default: the full turn.
    max_tracks : int
        Largest number of tracks, including tentative ones. Beyond it, the least likely tracks are deleted. This bounds
        memory and time.

    Raises
    ------
    OptionError
        The left edge is not to the left of the right one, ``max_tracks`` is no whole number, or below 0, or
        ``parameters`` are no `ClassParameters`.

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
        self._parameters: Mapping[str, ClassParameters] = PARAMETERS
        self._right, self._width = _checked_view(field_of_view_deg)
        given = {} if parameters is None else parameters
        if not isinstance(given, Mapping) or not all(isinstance(of, ClassParameters) for of in given.values()):
            raise OptionError(f"parameters is {parameters!r:.200}; expected ClassParameters by class, or None")
        self._max_tracks = OPTIONS.whole("max_tracks", max_tracks, 0, sys.maxsize)
        self._clock = Clock()
        self.reset()
        # Compile every kernel here, not in the first updates: a track begins, and is found again.
        for stamp_s in (0.0, 0.1):
            self.update([Box("car", 0.9, (10.0, 2.0, -0.9), (4.2, 1.8, 1.5), 0.0)], stamp_s)
        self._parameters = {**PARAMETERS, **given}
        self._clock = Clock(gap_s=max(GAP_S, *(of.memory_s for of in self._parameters.values())))
        self.reset()

    def reset(self) -> None:
        """Delete all tracks, and reset the time, the pose and the ids."""
        self._labels: list[str] = []
        self._groups: list[str] = []
        self.class_table = np.zeros(0, lives.CLASS)
        self._next_id, self._n_sessions = 1, 1
        self._session = _Session()
        self._former: _Session | None = None  # that before a jump, until the next scan confirms the jump
        self._clock = Clock(gap_s=self._clock.gap_s)
        self._reported: set[str] = set()

    def __call__(self, perception: Perception, T_world_sensor: ArrayLike | None = None) -> Tracks:
        """Track the boxes of a perception, at the time ``perception.stamp_s``.

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
            The perception has no stamp, or one that is not finite or beyond 1e12 s.
        TrackingError
            As in `update`.
        """
        check_perception(perception)
        if perception.stamp_s is None:
            raise StampError("the perception has no stamp_s; call perceive(points, stamp_s=...) with the scan's time")
        return self.update(perception.boxes, perception.stamp_s, T_world_sensor, mounting=perception.mounting)

    def update(
        self,
        boxes: Iterable[Box],
        stamp_s: float,
        T_world_sensor: ArrayLike | None = None,
        *,
        mounting: Mounting = MODEL_MOUNTING,
    ) -> Tracks:
        """Track the boxes of one scan.

        Parameters
        ----------
        boxes : iterable of Box
            From any detector, in the sensor frame; may be empty.
        stamp_s : float
            Time of the scan [s]. See `Tracker` for scans that are not later than the one before.
        T_world_sensor : (4, 4) array_like, optional
            Rigid pose of the sensor. Pass it with every scan or with none. Without poses, the sensor's motion on the
            ground is estimated from the static objects. With only one or two objects in view, their motion cannot be
            separated from the sensor's: tracks keep their identity, but speeds over ground are unreliable.
        mounting : Mounting
            Of the sensor (`Perception.mounting`), else OptionError: it says from where in the frame of the boxes the
            sensor looks and, without poses, which way the vehicle drives, which moves fast ahead, hardly aside and not
            up or down.

        Returns
        -------
        Tracks
            Tracks that probably exist. A track without a detection coasts: for a few scans if it should be visible,
            for longer if another track hides it. Empty for a late or doubled scan.

        Raises
        ------
        StampError
            ``stamp_s`` is no finite number, or beyond 1e12 s.
        TrackingError
            A box or the pose is malformed, not finite or farther than 1e8 m, or only some scans have poses.

        Warns
        -----
        UserWarning
            A scan was late or doubled, or the clock jumped; once each.
        """
        if not isinstance(mounting, Mounting):
            OPTIONS.refuse("mounting", mounting, "a Mounting")
        stamp_s = float(as_seconds(stamp_s))
        if not abs(stamp_s) <= LATEST_S:
            raise StampError(f"got a scan at {stamp_s} s; expected a finite time in seconds, up to {LATEST_S:g}")
        step, clock = self._clock.after(stamp_s)
        session, former = self._session, self._former
        if step == "jump":
            session, former = _Session(self._n_sessions), former or session
        elif step == "return":
            assert former is not None
            session = former
        posed = T_world_sensor is not None
        if session.posed is not None and posed != session.posed:
            raise TrackingError(
                f"got a scan {'with' if posed else 'without'} T_world_sensor, unlike those before it; pass it with all "
                "scans or with none, or call reset() before a new recording"
            )
        given, fronts, names = _checked_boxes(boxes)
        pose = None if T_world_sensor is None else rigid("T_world_sensor", T_world_sensor, TrackingError)
        if pose is not None and np.abs(pose).max() > FARTHEST_M:
            raise TrackingError(f"T_world_sensor has {np.abs(pose).max():g}; expected at most {FARTHEST_M:g} m")
        self._warn_of(step, stamp_s)
        if step == "late":
            nothing, pose, n = np.zeros(0, lives.TRACK), session.T_world_sensor.copy(), len(session.tracks)
            late = Tracks(nothing, self._labels, self.class_table, stamp_s, pose, n, 0, session.number, is_late=True)
            self._clock = clock
            return late
        kinds = self.kinds_of(names)
        classes, ranges = self.class_table[kinds], np.hypot(*(given[:, :2] - mounting.origin_m).T)

        dt = stamp_s - session.stamp_s if session.posed is not None else 0.0
        memory_s = self.class_table["memory_s"][session.tracks["label"]]
        tracks = session.tracks[session.tracks["missed_s"] + dt <= memory_s]
        if len(memory_s) and dt > memory_s.max():
            self._warn_of("pause", stamp_s)
        of = self.class_table[tracks["label"]]
        predictions = predict(mix(tracks, of, dt), of, dt)
        state, covariance = combine(*predictions)
        twist, twist_variances = session.twist, session.twist_variances
        if pose is None:
            # Vehicles that may stand are taken to: nothing else corrects a speed that they and the sensor share.
            people = [k for k, name in enumerate(self._groups) if name in PEOPLE]
            slow = np.maximum(state[:, 2] ** 2, covariance[:, 2, 2]) < of["moving_mps"] ** 2
            stands = ((tracks["hits"] == 1) | slow) & ~np.isin(of["group"], people)
            place = np.where(stands[:, None], predictions.means[:, RANDOM_MOTION], state)
            spread = np.where(stands[:, None, None], predictions.covariances[:, RANDOM_MOTION], covariance)
            of_boxes = given, ranges, classes
            estimate = self._estimated_pose(session, tracks, place, spread, *of_boxes, _leveled(mounting), dt)
            pose, twist, twist_variances = estimate
        eye = pose.copy()  # the sensor may be beside the origin of its frame
        eye[:3, 3] += pose[:3, :2] @ mounting.origin_m
        detections = _detections(given, fronts, kinds, classes["group"].copy(), ranges, pose)
        farther = 1.0 + _away(state, of, eye)  # the standard deviations of detections grow
        gates = Gates(of["sigmas"] * farther[:, None], of["odds"].copy(), tracks["group"].copy(), of["gate"].copy())
        likelihoods, beta, n_approximated = _associated(predictions, gates, detections)
        _update_motion(tracks, predictions, gates.sigmas, detections.places, likelihoods, beta)
        _update_shapes(tracks, detections, beta, of["shape"] * farther[:, None], dt)
        _update_evidence(tracks, of, detections, beta, eye, dt)
        n = len(tracks)
        tracks = self._with_newborn(tracks, detections, classes, beta)
        n_born = len(tracks) - n
        tracks = self._living(tracks)
        strength = strength_of(tracks)
        tracks["score"] = _scores(tracks, strength, self.class_table[tracks["label"]], eye)

        reported = tracks["existence"] > 0.0
        lives.mark_out_of_view(tracks, eye, self._right, self._width, reported)
        strongest_first = np.argsort(-strength, kind="stable")
        lives.mark_rivals(tracks["state"].copy(), tracks["shape"].copy(), strongest_first, reported)
        n_tentative = int(len(tracks) - np.count_nonzero(reported))
        named, number = (tracks[reported], self._labels, self.class_table), session.number
        answer = Tracks(*named, stamp_s, pose.copy(), n_tentative, n_approximated, number, every=tracks)
        session = _Session(number, stamp_s, posed, tracks, pose, twist, twist_variances)

        # Last, and without a call in between, so that an update that a signal ends can be repeated.
        self._clock, self._session, self._former = clock, session, former if step == "jump" else None
        self._n_sessions += step == "jump"
        self._next_id += n_born
        return answer

    def _warn_of(self, step: Step | Literal["pause"], stamp_s: float) -> None:
        """Say once of each kind of step what it means."""
        if step == "next" or step in self._reported:
            return
        self._reported.add(step)
        meaning = {
            "late": "a late or doubled scan has no tracks, and changes none",
            "jump": "the clock jumped, and tracking begins anew, with new ids",
            "return": "the stamp before was wrong, and the tracks before it go on",
            "pause": "every track ended, as after memory_s without a scan; objects get new ids. Stamps are in seconds",
        }[step]
        last_s = self._clock.last_s
        warnings.warn(f"got a scan at {stamp_s} s after one at {last_s} s: {meaning} (said once)", stacklevel=3)

    def kinds_of(self, names: Sequence[str]) -> Ints64:
        """Row in the table of classes for each label; new classes are added."""
        for name in names:
            if name in self._labels:
                continue
            of = self._parameters.get(name) or replace(PARAMETERS["car"], group=name)
            if of.group not in self._groups:
                self._groups = [*self._groups, of.group]  # new ones: a copy of the tracker has the former
            row = np.zeros(1, lives.CLASS)
            row["group"] = self._groups.index(of.group)
            for scalar in lives.SCALARS:
                row[scalar] = getattr(of, scalar)
            row["noise"] = of.acceleration_mps2, of.turn_acceleration_rps2, of.walk_m, of.wander_rad, of.still_mps
            row["sigmas"] = of.along_m, of.across_m, of.heading_rad
            row["shape"] = of.shape_m
            row["birth"] = of.birth_speed_mps, of.birth_turn_rps
            row["odds"] = of.detection / ((1.0 - of.detection) * of.clutter)
            row["birth_logit"], row["sure_logit"] = _logit(of.birth_score), _logit(of.sure_score)
            self._labels = [*self._labels, name]
            self.class_table = np.concatenate([self.class_table, row])
        return np.array([self._labels.index(name) for name in names], np.int64)

    def _estimated_pose(
        self,
        session: _Session,
        tracks: Records,
        state: Floats,
        covariance: Floats,
        given: Floats,
        ranges: Floats,
        classes: Records,
        leveled: Floats,
        dt: float,
    ) -> tuple[Floats, Floats, Floats]:
        """Estimate the sensor's pose (4, 4), its motion ahead, to the left and about z (3,) [m/s, m/s, rad/s], and the
        variances of the motion. ``leveled`` (3, 3) turns the sensor's axes to those on the ground.
        """
        if dt == 0.0:
            return session.T_world_sensor, session.twist, session.twist_variances
        seen = np.flatnonzero(tracks["misses"] == 0)
        landmarks = np.empty((len(seen), 4))
        places = np.column_stack([state[seen, :2], tracks["shape"][seen, 0]]) - session.T_world_sensor[:3, 3]
        landmarks[:, :2] = (places @ session.T_world_sensor[:3, :3] @ leveled.T)[:, :2]
        landmarks[:, 2] = 0.5 * (covariance[seen, 0, 0] + covariance[seen, 1, 1])
        landmarks[:, 3] = tracks["group"][seen]
        if len(landmarks) > MAX_LANDMARKS:
            landmarks = landmarks[np.argsort(landmarks[:, 2], kind="stable")[:MAX_LANDMARKS]]
        detections = np.empty((len(given), 4))
        detections[:, :2], detections[:, 3] = (given[:, :3] @ leveled.T)[:, :2], classes["group"]
        detections[:, 2] = (classes["sigmas"][:, 0] * (1.0 + ranges / classes["range_m"])) ** 2
        if len(detections) > 2 * MAX_LANDMARKS:
            detections = detections[np.argsort(detections[:, 2], kind="stable")[: 2 * MAX_LANDMARKS]]
        kept = np.array([1.0, 1.0, math.exp(-dt / TURN_MEMORY_S)])
        prior_variances = (session.twist_variances * kept**2 + TWIST_WALK**2 * dt) * dt**2
        motion, spread = np.empty(3), np.empty((3, 3))
        fit_motion(landmarks, detections, session.twist * kept * dt, prior_variances, motion, spread)
        cos, sin = math.cos(motion[2]), math.sin(motion[2])
        turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = leveled.T @ turn @ leveled, leveled.T[:, :2] @ motion[:2]
        return session.T_world_sensor @ step, motion / dt, np.minimum(np.diag(spread) / dt**2, FIRST_TWIST**2)

    def _with_newborn(self, tracks: Records, detections: Detections, classes: Records, beta: Floats) -> Records:
        """Begin tracks at the detections that probably belong to none; ``classes`` are those of the detections."""
        own = np.flatnonzero((beta[:, 1:].sum(axis=0) < 0.5) & (detections.logits >= classes["birth_logit"]))
        if not len(own):
            return tracks
        # np.concatenate takes ten times as long with named fields.
        joined = np.zeros(len(tracks) + len(own), lives.TRACK)
        joined[: len(tracks)] = tracks
        born = Detections._make(field[own] for field in detections)
        lives.fill_newborn(self._next_id, born, classes[own], joined[len(tracks) :])
        return joined

    def _living(self, tracks: Records) -> Records:
        """Tracks to keep: above `LEAST_EXISTENCE`, and at most ``max_tracks`` of them."""
        stays = tracks["existence"] > lives.LEAST_EXISTENCE
        if not stays.all():
            tracks = tracks[stays]
        if len(tracks) > self._max_tracks:
            rank = np.argsort(-tracks["existence"], kind="stable")
            tracks = tracks[np.sort(rank[: self._max_tracks])]
        return tracks


# Fields of records go to kernels as copies: of a single record a field is contiguous, of several it is not, and numba
# would compile a kernel for each layout in memory.


@lru_cache(maxsize=16)  # 8 % of the time of an update, where it is computed for each
def _leveled(mounting: Mounting) -> Floats:
    """The rotation (3, 3) from a sensor's axes to those of the models, in which the vehicle moves on the ground."""
    R = model_rotation(mounting)
    return np.eye(3) if np.allclose(R, np.eye(3), atol=1e-9) else R


def mix(tracks: Records, classes: Records, dt: float) -> Predictions:
    """Interaction: where the filter of each motion model starts from."""
    n = len(tracks)
    mixed, mixed_covariances, prior = np.empty((n, 3, 5)), np.empty((n, 3, 5, 5)), np.empty((n, 3))
    stay = np.exp(-dt / classes["keep_motion_s"])
    states, covariances, modes = (tracks[field].copy() for field in ("states", "covariances", "modes"))
    fill_interaction(states, covariances, modes, stay, mixed, mixed_covariances, prior)
    return Predictions(mixed, mixed_covariances, prior)


def predict(mixed: Predictions, classes: Records, dt: float) -> Predictions:
    """Prediction of each motion model."""
    states, covariances, prior = mixed
    means, predicted = np.empty_like(states), np.empty_like(covariances)
    fill_predictions(states, covariances, classes["noise"].copy(), dt, means, predicted)
    return Predictions(means, predicted, prior)


def combine(states: Floats, covariances: Floats, modes: Floats) -> tuple[Floats, Floats]:
    """Combination: state (n, 5) and covariance (n, 5, 5) of tracks over their motion models."""
    state, covariance = np.empty((len(states), 5)), np.empty((len(states), 5, 5))
    fill_combined(states, covariances, modes, state, covariance)
    return state, covariance


def _detections(
    given: Floats, fronts: Floats, kinds: Ints64, groups: Ints64, ranges: Floats, pose: Floats
) -> Detections:
    """The checked boxes (m, 8) in the world frame."""
    places = given[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    shapes = given[:, 2:6].copy()
    shapes[:, 0] = places[:, 2]
    cos, sin = np.cos(given[:, 6]), np.sin(given[:, 6])
    places[:, 2] = np.arctan2(pose[1, 0] * cos + pose[1, 1] * sin, pose[0, 0] * cos + pose[0, 1] * sin)
    return Detections(places, shapes, _logit(given[:, 7]), fronts, kinds, groups, ranges, np.arange(len(given)))


def _away(state: Floats, classes: Records, eye: Floats) -> Floats:
    """Distances of tracks from the sensor in units of ``range_m``, (n,)."""
    return np.asarray(np.hypot(state[:, 0] - eye[0, 3], state[:, 1] - eye[1, 3]) / classes["range_m"])


def _associated(predictions: Predictions, gates: Gates, detections: Detections) -> tuple[Floats, Floats, int]:
    """Data association: likelihoods (n, 3, m), probabilities (n, m + 1), number of approximated tracks."""
    n, m = len(predictions.means), len(detections.places)
    likelihoods, weights, beta = np.empty((n, 3, m)), np.empty((n, m)), np.empty((n, m + 1))
    fill_likelihoods(predictions, gates, detections, likelihoods, weights)
    return likelihoods, beta, fill_association(weights, MAX_EVENTS, beta)


def _update_motion(
    tracks: Records, predictions: Predictions, sigmas: Floats, places: Floats, likelihoods: Floats, beta: Floats
) -> None:
    """Mode probability update with the update of each motion, and combination."""
    means, predicted, prior = predictions
    shares, modes = np.empty((len(tracks), 3, beta.shape[1])), np.empty_like(prior)
    fill_mode_probabilities(prior, likelihoods, beta, shares, modes)
    states, covariances = np.empty_like(means), np.empty_like(predicted)
    fill_updates(means, predicted, places, sigmas, shares, states, covariances)
    tracks["states"], tracks["covariances"], tracks["modes"] = states, covariances, modes
    tracks["state"], tracks["covariance"] = combine(states, covariances, modes)


def _update_shapes(tracks: Records, detections: Detections, beta: Floats, sigmas: Floats, dt: float) -> None:
    """Smooth the heights and sizes; ``sigmas`` (n, 4) are those of a detection [m]."""
    shape, variance = tracks["shape"].copy(), tracks["shape_variance"].copy()
    lives.update_shapes(beta, detections.shapes, sigmas, SHAPE_WALK_M * math.sqrt(dt), shape, variance)
    tracks["shape"], tracks["shape_variance"] = shape, variance


def _update_evidence(
    tracks: Records, classes: Records, detections: Detections, beta: Floats, eye: Floats, dt: float
) -> None:
    """Collect what the scan says of fronts, labels and existence."""
    state, fronts = tracks["state"].copy(), tracks["fronts"].copy()
    speed_sigma = np.sqrt(np.maximum(tracks["covariance"][:, 2, 2], 0.0))
    moving_mps = classes["moving_mps"].copy()
    lives.update_fronts(state, speed_sigma, moving_mps, beta, detections.places, detections.fronts, fronts)
    tracks["fronts"] = fronts
    hidden = np.zeros(len(tracks))
    lives.fill_hidden(state, tracks["shape"].copy(), beta[:, 0] < 0.5, eye[:2, 3].copy(), hidden)
    lives.update_lives(tracks, classes, beta, hidden, detections.logits, detections.kinds, dt)


def _scores(tracks: Records, strength: Floats, classes: Records, eye: Floats) -> Floats:
    """Log odds (n,) of the reported scores."""
    away = _away(tracks["state"], classes, eye)
    scores = strength + classes["latest"] * (tracks["last_logit"] - strength)
    return np.asarray(scores + (classes["far_logit"] * away - classes["coasting_logit"] * tracks["misses"]))


def _checked_view(field_of_view_deg: tuple[float, float]) -> tuple[float, float]:
    """Azimuth of the right edge, and the width [rad]."""
    left, right = OPTIONS.pair("field_of_view_deg", field_of_view_deg)
    if not left > right:
        raise OptionError(
            f"field_of_view_deg is {field_of_view_deg!r}; expected the azimuths of the left and the right edge, the "
            "left one higher: (40, -40) looks ahead, (220, 140) back"
        )
    return math.radians(right), math.radians(left - right)


def _checked_boxes(boxes: Iterable[Box]) -> tuple[Floats, Floats, list[str]]:
    """Check boxes; return rows (m, 8) of x, y, z, length, width, height, yaw, score, log odds of fronts, and labels."""
    try:
        given = list(boxes)
        rows = np.array([(*box.center, *box.size, box.yaw, box.score) for box in given], np.float64).reshape(-1, 8)
        fronts = np.array([0.5 if box.front is None else box.front for box in given], np.float64)
        names = [box.label for box in given]
    except (AttributeError, OverflowError, TypeError, ValueError) as exc:
        raise TrackingError(f"got boxes that are not edgeperc.Box objects ({exc}); pass edgeperc.Box objects") from exc
    sizes = rows[:, 3:6]
    right = np.isfinite(rows).all(axis=1) & (rows[:, 7] >= 0.0) & (rows[:, 7] <= 1.0)
    right &= (np.abs(rows[:, :3]) <= FARTHEST_M).all(axis=1)
    right &= ((sizes >= SIZES_M[0]) & (sizes <= SIZES_M[1])).all(axis=1)
    right &= (fronts >= 0.0) & (fronts <= 1.0)
    right &= np.array([isinstance(name, str) for name in names], np.bool_)
    if not right.all():
        wrong = given[int(np.argmin(right))]
        raise TrackingError(
            f"got {wrong}; expected finite numbers, coordinates up to {FARTHEST_M:g} m, sizes from {SIZES_M[0]:g} to "
            f"{SIZES_M[1]:g} m, a score and a front in 0..1: drop such boxes before tracking"
        )
    return rows, _logit(fronts), names


def _logit(scores: Floats | float) -> Floats:
    inside = np.clip(scores, SMALLEST_SHARE, 1.0 - SMALLEST_SHARE)
    return np.log(inside) - np.log1p(-inside)
