"""The pipeline from a scan to a perception."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType
from typing import Literal, NamedTuple, NoReturn, get_args

import numpy as np
from numpy.typing import ArrayLike

from .agreement.rules import RULES
from .camera.image import ImageScaler, as_image, label_pixels
from .errors import EdgepercError, FitnessError, ImageError, MountingError, OptionError, PointsError
from .ground.ceiling import find_ceiling
from .ground.leveling import MountingEstimate, MountingEstimator, near_support, share_below
from .inference.object_network import BoxesFrom, ObjectNetwork
from .inference.pillar_network import PillarNetwork
from .inference.session import Session
from .inference.sessions import Sessions
from .objects.boxes import MIN_SCORE
from .pipeline import Options, Parts, Pipeline, RangeImageNetwork, TopViewNetwork
from .preprocess import findings
from .preprocess.condition import scale
from .preprocess.fitness import FitnessProfile
from .preprocess.health import Normal, check_health, findings_of, sample_step, without_drops
from .preprocess.interpolation import Interpolator
from .preprocess.remission import RemissionMatcher
from .preprocess.returns import about_sensor, about_too_near, own_returns, returns
from .preprocess.sensor_estimate import SensorEstimate, compile_votes, estimate_sensor
from .system.clock import as_seconds
from .system.compilation import Compilation, kernels_of
from .system.fields import OPTIONS
from .system.lanes import Calls, Lanes, Stopwatch
from .system.names import nearest
from .types.card import ModelCard
from .types.choices import AUTO_SENSOR, DEFAULT_SENSOR, WEIGHTS
from .types.detector import PillarGeometry
from .types.frame import ModelFrame
from .types.mounting import Mounting
from .types.perception import ImageLabels, Perception, SensorHealth
from .types.points import Bytes, Points, as_origin, as_points
from .types.sensor import SensorProfile, get_sensor
from .types.views import CameraGeometry, ObjectGeometry, RangeImageGeometry, TopViewGeometry
from .warm_up import Rehearsed, n_processes, warm_up
from .zoo import CAMERA, DEFAULT, resolve

Adaptation = Literal["both", "remission", "interpolation", "none"]
OnMismatch = Literal["refuse", "warn", "raise", "ignore"]
ADAPTATIONS: tuple[Adaptation, ...] = ("none", "remission", "interpolation", "both")

# A wrong set-up shows in any scan. Several are checked, because one may have been taken in a tunnel or a depot.
# A refused scan does not count.
CHECKED_SCANS = 5

COARSE_SENSOR = "vlp-16"  # with gaps between its beams


@dataclass(frozen=True)
class _Camera:
    session: Session
    scaler: ImageScaler

    def label(self, image: Bytes, watch: Stopwatch) -> ImageLabels:
        """Class of every pixel of an image, at its own size."""
        card, (height, width, _) = self.session.card, image.shape
        self.scaler.fill(image, self.session.input)
        watch.lap("project")
        outputs = self.session.run()
        watch.lap("infer")
        labels = label_pixels(outputs["camera_logits"], height, width, model=card.name)
        watch.lap("decode")
        return ImageLabels(labels, card.classes)


class Learned(NamedTuple):
    """What a perceiver has learned from its scans so far; it can be pickled."""

    mounting: MountingEstimator
    remission: RemissionMatcher
    to_check: int  # number of scans that are still compared with the training scans
    is_settled: bool = False  # whether more scans change nothing: the answer to a scan then depends on this scan alone
    sensor_estimate: SensorEstimate | None = None  # what ``sensor="auto"`` found
    normal: Normal = Normal()  # what the sensor shows in clear air with a clean window


def _card_of(model: str | os.PathLike[str]) -> ModelCard | None:
    """A model's card; None if it cannot be read, which the model's session reports."""
    try:
        return resolve(model)[0].card
    except EdgepercError:
        return None


def _check_choice(option: str, value: object, choices: Sequence[object]) -> None:
    if not isinstance(value, Hashable) or value not in choices:  # an array is compared element by element
        *others, last = known = [*map(str, choices)]
        raise OptionError(f"{option} is {value!r}{nearest(str(value), known)}; expected {', '.join(others)} or {last}")


def _listed(models: object, weights: str) -> list[str | os.PathLike[str]]:
    """The models as a list; one name or path becomes a list of one."""
    _check_choice("weights", weights, (*WEIGHTS,))
    if models is None:
        return list(WEIGHTS[weights])
    if weights != "default":
        raise OptionError(f"weights is {weights!r}, and models={models!r}; pass one of the two")
    given = models if isinstance(models, Sequence) and not isinstance(models, str) else [models]
    listed = [model for model in given if isinstance(model, str | os.PathLike)]
    if not listed or len(listed) < len(given):
        raise OptionError(f"models is {models!r}; expected names or paths of models, at least one, or None")
    return listed


class Perceiver:
    """Turn a LiDAR scan into drivable area, boxes and a class for every point, and a camera's image into its classes.

    Construction loads the models, checks them against their cards and compiles every kernel; at the first start, helper
    processes compile a part of them into the cache (`edgeperc.warm_up`). Results own their arrays; internal buffers
    are reused between calls. One instance processes one call at a time, and other threads wait; for parallel calls use
    one instance per thread. Options cannot be changed after construction.

    Parameters
    ----------
    models : str, Path, sequence of these, or None
        Names of shipped models (``"ssadnet"``, ``"pointseg:int8"``) or paths of .onnx files with a card; at most one
        model per view: top view, range image, objects, pillars (a detector of yours) and camera. None takes the LiDAR
        models together that ``weights`` names, by default the best ones, `edgeperc.zoo.DEFAULT`. For a sparse sensor
        (`SensorProfile.is_sparse`), ``"pointseg"`` is ``"pointseg-sparse"``; ``"pointseg:int8"`` is not. The options
        of scans have no effect on a camera.
    sensor : str, Path or SensorProfile
        The sensor that takes the scans: a built-in name (`edgeperc.sensors`), a file written by ``edgeperc
        fit-sensor``, or a profile. ``"auto"``: the one whose beams the first scan has, or a profile of its beams
        (`preprocess.sensor_estimate`); a scan that does not tell is refused.
    mounting : Mounting or None
        How the sensor is mounted. What is None in it is estimated from the ground in the first five scans that show
        it (`leveling.MountingEstimator`). None: as the sensor's profile says, which for the built-in ones is
        nothing.
    provider : str
        ``"auto"``, ``"cpu"``, ``"openvino"``, ... Any other value than ``"auto"`` is required, without fallback
        (`edgeperc.inference.providers.PROVIDERS`).
    precision : {"auto", "fp32", "bf16", "int8"}
        Precision of the networks. ``"auto"`` takes a reduced precision if the processor computes it natively and the
        card shows a loss of at most 0.3 points (`edgeperc.zoo.choose`). Any other value is required.
    n_threads : int or None
        Threads of a network, one network after the other. None leaves it to the provider; on onnxruntime's CPU provider
        the networks of the range image and of the top view then run concurrently, each on half of the cores. The
        results do not depend on it.
    on_mismatch : {"refuse", "warn", "raise", "ignore"}
        What to do when one of the first five scans is unlike the training scans. ``"refuse"``: raise FitnessError,
        before anything is perceived, if a difference is gross (`findings.check_fitness` lists them), and warn
        of others. ``"warn"``: warn of all. ``"raise"``: raise FitnessError for any. ``"ignore"``: skip the check.
    score_threshold : float or None
        Lowest score of a box, in 0..1. None takes the card's threshold for boxes of a network, and 0.3 for boxes of
        clusters. That of a model of objects is the one of its boxes.
    adapt : {"both", "remission", "interpolation", "none"}
        How to adapt scans of a sensor that the models were not trained on. ``"remission"``: convert its remission to
        that of the training sensor, by the function of its profile or one that is matched to the first five scans
        (`edgeperc.preprocess.remission.RemissionMatcher`). ``"interpolation"``: fill the range image
        between its beams and columns, if they are fewer. Scans of the training sensor are not changed.
    boxes_from : {"both", "network", "clusters"}
        ``"network"``: boxes of a top-view model, vehicles ahead. ``"clusters"``: boxes around clusters of labeled
        points above the ground, of every class and everywhere in the range image
        (`edgeperc.objects.boxes.objects_from_points`). ``"both"``: use both. A cluster's box is dropped if it overlaps
        a network's box, unless it is a person's with the better score. Otherwise it stays wherever it is: a network
        that detects its class, and sees it, but has not found it, halves its score, in part if it sees the object in
        part.
        A model of objects replaces both, at candidates from the top view, from clusters of points of any class, or from
        both. Boxes of labeled people stay, with the mean of both scores; people without labels, if points are labeled,
        keep half of their scores. A vehicle that the others show stays only where it sees one, or has too few points.
        Boxes of a detector on pillars stay as they are; with ``"clusters"`` it does not run. Other boxes are dropped
        where it has one. In its range, those of its classes keep half of their score, as it has not found them.
    full_turn : bool
        Run a range-image model once for each sector, four times for the shipped models. Every point then has a class,
        and there are boxes next to and behind the vehicle. A detector that looks ahead runs four times, too, one that
        looks all around once.
    agree : bool or collection of str
        Correct the parts of the result by one another (`agreement.rules`): the clusters of points above the ground
        vote on their class, boxes support or complete labels, and no cell below an object is drivable. Boxes below
        ``score_threshold`` take no part. False, for comparisons: labels and cells are those of the networks. Of a
        collection, the rules apply that it names (`edgeperc.agreement.rules.RULES`).
    trusted : bool
        Open model files whose graphs are otherwise refused: with unusual operators, functions, subgraphs or sizes
        (`edgeperc.inference.session.Session`). Only for files whose origin you know.
    weights : {"default", "open"}
        The models of None: the most accurate ones, whose weights have the terms of KITTI, or `edgeperc.zoo.OPEN`, whose
        weights anyone may use, commercially too, and whose points have classes for the surroundings as well.

    Attributes
    ----------
    sensor : SensorProfile
        With ``"auto"``, that of the training scans until the first scan has told.
    sensor_estimate : SensorEstimate or None
        What ``"auto"`` found, and how sure it is.
    mounting : MountingEstimate or None
        The mounting by the scans so far; None if it is to be estimated and no scan has shown the ground.
    on_mismatch, score_threshold, adapt, boxes_from, full_turn, agree
        As given; read-only.
    cards : tuple of ModelCard
    sessions : tuple of Session
        The loaded networks. Do not run them from outside.
    providers : mapping
        What runs, by model name: ``"pointseg int8, CPUExecutionProvider"``.

    Raises
    ------
    OptionError
        An option is unknown or out of range, or the models cannot be combined.
    ModelError, ProviderError, SensorError, MissingExtraError
        A model, a provider or a sensor is missing or does not fit. Only construction raises these.
    PointsError, ImageError, InferenceError, FitnessError
        Only a call raises these. With ``sensor="auto"``, it raises SensorError, too.

    Examples
    --------
    >>> perceive = Perceiver("pointseg")                        # doctest: +SKIP
    >>> perception = perceive(read_points("000000.bin"))        # doctest: +SKIP
    >>> perception.points.labels.shape                          # doctest: +SKIP
    (123397,)
    """

    sensor: SensorProfile
    on_mismatch: OnMismatch
    score_threshold: float | None
    adapt: Adaptation
    boxes_from: BoxesFrom
    full_turn: bool
    agree: bool | frozenset[str]
    cards: tuple[ModelCard, ...]
    sessions: tuple[Session, ...]
    providers: Mapping[str, str]
    _learned: Learned

    def __init__(
        self,
        models: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
        *,
        sensor: str | os.PathLike[str] | SensorProfile = "hdl-64e",
        mounting: Mounting | None = None,
        provider: str = "auto",
        precision: str = "auto",
        n_threads: int | None = None,
        on_mismatch: OnMismatch = "refuse",
        score_threshold: float | None = None,
        adapt: Adaptation = "both",
        boxes_from: BoxesFrom = "both",
        full_turn: bool = False,
        agree: bool | Collection[str] = True,
        trusted: bool = False,
        weights: str = "default",
    ) -> None:
        _check_choice("adapt", adapt, ADAPTATIONS)
        _check_choice("on_mismatch", on_mismatch, get_args(OnMismatch))
        _check_choice("boxes_from", boxes_from, get_args(BoxesFrom))
        _check_choice("full_turn", full_turn, (True, False))
        _check_choice("trusted", trusted, (True, False))
        rules = agree if isinstance(agree, Collection) and not isinstance(agree, str | np.ndarray) else None
        known = isinstance(agree, Hashable) and agree in (True, False)
        if not known if rules is None else any(name not in [*RULES] for name in rules):
            raise OptionError(f"agree is {agree!r}; expected True, False or some of {', '.join(sorted(RULES))}")
        least = None if score_threshold is None else OPTIONS.number("score_threshold", score_threshold, 0.0, 1.0)
        for option, given in (("provider", provider), ("precision", precision)):
            OPTIONS.entry(str, given, option)
        wanted = _listed(models, weights)
        if mounting is not None and not isinstance(mounting, Mounting):
            raise OptionError(f"mounting is {mounting!r:.80}; expected a Mounting, or None")
        self._finds_sensor = isinstance(sensor, str) and sensor == AUTO_SENSOR
        self.sensor = get_sensor(DEFAULT_SENSOR if self._finds_sensor else sensor)
        self.on_mismatch = on_mismatch
        self.score_threshold = least
        self.adapt = adapt
        self._interpolates = adapt in ("both", "interpolation")
        self._renders = adapt in ("both", "remission")
        self.boxes_from = boxes_from
        self.full_turn = full_turn
        self.agree = bool(agree) if rules is None else frozenset(rules)
        self._begin(self.sensor.mounting if mounting is None else mounting)
        cards = [card for card in map(_card_of, wanted) if card is not None]
        needs = self._kernel_needs(cards)
        with Compilation(lambda: kernels_of(needs), n_processes()):
            self._construct(wanted, needs, provider, precision, n_threads, trusted)

    def _kernel_needs(self, cards: Sequence[ModelCard]) -> frozenset[str]:
        """Which kernels are needed: keys of `edgeperc.system.compilation.KERNELS`."""
        kinds: set[str] = {card.view.kind for card in cards}
        scans = [card for card in cards if not isinstance(card.view, CameraGeometry)]
        points, top_view, objects = "range_image" in kinds, "top_view" in kinds, "objects" in kinds
        boxes = points and self.boxes_from != "network"
        agreement = points and bool(self.agree)
        detections = any(card.box_classes for card in scans if card.view.kind == "top_view")
        gaps = self._interpolates and any(
            self._finds_sensor or Interpolator(card.view, self.sensor.upright(self._learned.mounting.known)).needed
            for card in scans
            if isinstance(card.view, RangeImageGeometry)
        )
        needs = {
            "scans": bool(scans),
            "views": points or top_view,
            "fitness": self.on_mismatch != "ignore" and any(card.fitness is not None for card in scans),
            "curvature": any("curvature" in card.input.channels for card in scans),
            "gaps": gaps,
            "turn": points and self.full_turn,
            "ground": bool(scans)
            and (bool(self.agree) or boxes or objects or any(card.input.needs_ground for card in scans)),
            "sensor": self._finds_sensor and bool(scans),
            "clusters": boxes or agreement,
            "boxes": boxes,
            "agreement": agreement,
            "candidates": objects and self.boxes_from != "network",
            "standing": bool(self.agree) and not objects and (boxes or detections),
            "cells": top_view and bool(self.agree),
            "detections": detections,
            "blocks": any(output.block != (1, 1) for card in scans for output in card.outputs),
        }
        return frozenset(kinds | {name for name, is_needed in needs.items() if is_needed})

    def _construct(
        self,
        wanted: Sequence[str | os.PathLike[str]],
        needs: frozenset[str],
        provider: str,
        precision: str,
        n_threads: int | None,
        trusted: bool,
    ) -> None:
        """Load the models, assemble the pipeline and compile every kernel."""
        at_once = 2 if {"top_view", "range_image"} <= needs else 1
        load = partial(
            Session, provider=provider, precision=precision, n_threads=n_threads, at_once=at_once, trusted=trusted
        )
        self._sessions = Sessions(wanted, precision, load)
        self._load(self.sensor)
        views = [card.view.kind for card in self.cards]
        if len(views) != len(set(views)):
            raise OptionError(f"models {[str(m) for m in wanted]} have views {views}; expected at most one a view")
        self._camera: _Camera | None = None
        for session in self.sessions:
            if isinstance(session.card.view, CameraGeometry):
                self._camera = _Camera(session, ImageScaler(session.card.view, session.card.input))
        if self.boxes_from == "clusters" and not {"range_image", "objects"} & {*views}:
            raise OptionError(
                "boxes_from is 'clusters', which needs a class for every point or for every cluster; add a range-image "
                "model or one of objects"
            )
        self._calls = Calls("a Perceiver")
        self._lanes = Lanes(2 if at_once == 2 and all(session.shares_cores for session in self.sessions) else 1)
        self._pipeline = self._assemble(self.sensor)
        # Compile every kernel here, not in the first call. The networks have already run on their golden inputs.
        if self._camera is not None:
            _Camera(Rehearsed(self._camera.session), self._camera.scaler).label(
                as_image(np.zeros((1, 1, 3), np.uint8)), Stopwatch()
            )
        if self._pipeline is not None:
            fitness, mounting = self._fitness if self._learned.to_check else [], self._learned.mounting
            warm_up(self._pipeline, needs, self.sensor, fitness, mounting)
            if self._finds_sensor:
                compile_votes()
                coarse = get_sensor(COARSE_SENSOR)  # fills the gaps between its beams
                warm_up(self._assemble(coarse) or self._pipeline, needs, coarse, [], mounting)

    def _load(self, sensor: SensorProfile) -> None:
        """Load the networks of a sensor."""
        own = vars(self)
        own["sessions"] = sessions = self._sessions.of(sensor)
        own["cards"] = tuple(session.card for session in sessions)
        own["providers"] = MappingProxyType({session.card.name: session.description for session in sessions})
        self._fitness = [FitnessProfile.from_dict(card.fitness) for card in self.cards if card.fitness is not None]

    def _assemble(self, sensor: SensorProfile) -> Pipeline | None:
        """The pipeline of the LiDAR networks; None without any."""
        sensor = sensor.upright(self._learned.mounting.known)
        top: TopViewNetwork | None = None
        ranged: list[RangeImageNetwork] = []
        objects: ObjectNetwork | None = None
        pillars: PillarNetwork | None = None
        for session in self.sessions:
            if isinstance(session.card.view, TopViewGeometry):
                top = TopViewNetwork(session, sensor)
            elif isinstance(session.card.view, RangeImageGeometry):
                interpolator = Interpolator(session.card.view, sensor) if self._interpolates else None
                needed = interpolator if interpolator is not None and interpolator.needed else None
                ranged = [RangeImageNetwork(session, needed)]
            elif isinstance(session.card.view, ObjectGeometry):
                objects = ObjectNetwork(session)
            elif isinstance(session.card.view, PillarGeometry):
                pillars = PillarNetwork(session, self._least_score(session), self.full_turn)
        if top is None and not ranged and objects is None and pillars is None:
            return None
        if self.full_turn and self._lanes.n == 2 and ranged:  # either lane may take a sector
            ranged.append(ranged[0].second())
        options = Options(
            rules=frozenset(RULES if self.agree is True else self.agree or ()),
            boxes_from=self.boxes_from,
            network_score=self._least_score(top),
            cluster_score=self._least_score(None),
            object_score=self._least_score(objects),
            distance_per_m=sensor.link_per_m,
            slope=math.tan(math.radians(min(sensor.fov_up_deg, 89.0))),
            full_turn=self.full_turn,
        )
        return Pipeline(top, ranged, options, self._lanes, objects, pillars)

    def _least_score(self, network: TopViewNetwork | ObjectNetwork | Session | None) -> float:
        """The lowest score of a box: as given, of the network's card, or of boxes around clusters."""
        if self.score_threshold is not None:
            return self.score_threshold
        return MIN_SCORE if network is None else network.card.score_threshold

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_") and "_calls" in vars(self):  # the last attribute of construction
            raise AttributeError(f"{name} of a Perceiver cannot be set after construction; make another Perceiver")
        super().__setattr__(name, value)

    def __reduce__(self) -> NoReturn:
        raise EdgepercError("a Perceiver cannot be pickled or copied; construct it in the process that calls it")

    @property
    def mounting(self) -> MountingEstimate | None:
        """See the class."""
        try:
            return self._learned.mounting.estimate()
        except MountingError:
            return None

    @property
    def sensor_estimate(self) -> SensorEstimate | None:
        """See the class."""
        return self._learned.sensor_estimate

    @property
    def pipeline(self) -> Pipeline | None:
        """What computes a perception of a scan; None without a LiDAR model."""
        return self._pipeline

    def reset_mounting(self) -> None:
        """Estimate mounting and remission anew, for scans of another vehicle; the next five scans settle both.

        The next scans are checked as the first ones are (``on_mismatch``), and what was warned of once is warned of
        anew. With ``sensor="auto"``, the next one tells the sensor.
        """
        with self._calls.one():
            self._begin(self._learned.mounting.known)

    def _begin(self, known: Mounting) -> None:
        """Be as before the first scan, of a sensor whose mounting is known as far as this says."""
        self._has_drops = False  # of the last scan
        self._told_of: set[str] = set()  # kinds of findings
        to_check = 0 if self.on_mismatch == "ignore" else CHECKED_SCANS
        self._learn(Learned(MountingEstimator(known), RemissionMatcher(self.sensor), to_check))

    @property
    def learned(self) -> Learned:
        """What the scans so far have shown, for a perceiver of the same options elsewhere (`start_from`)."""
        now = self._learned
        parts = [self._is_sensor_known, now.mounting.is_complete, now.remission.is_complete or not self._renders]
        is_settled = all(parts) and now.to_check == 0 and (now.normal.is_complete or self._pipeline is None)
        return now._replace(is_settled=is_settled)

    def start_from(self, learned: Learned) -> None:
        """Forget the scans so far, and continue from what another perceiver has learned."""
        with self._calls.one():
            if self._finds_sensor:
                self._use(learned.remission.sensor)
            self._learn(learned)

    @property
    def _is_sensor_known(self) -> bool:
        return not self._finds_sensor or self._learned.sensor_estimate is not None

    def _find_sensor(self, scan: Points) -> None:
        """Use the sensor whose beams the scan has; SensorError if it does not tell."""
        found = estimate_sensor([about_sensor(scan, self._learned.mounting.known.origin_m)])
        found.tell_doubt(self.on_mismatch)
        self._use(found.profile)
        self._learned = self._learned._replace(sensor_estimate=found)

    def _use(self, sensor: SensorProfile) -> None:
        """Take further scans as this sensor's."""
        if sensor == self.sensor:
            return
        self._load(sensor)
        vars(self)["sensor"] = sensor
        self._learned = self._learned._replace(remission=RemissionMatcher(sensor), normal=Normal())
        self._pipeline = self._assemble(sensor)

    def _learn(self, learned: Learned) -> None:
        self._learned = learned
        self._mounting = learned.mounting.mounting()
        self._frame = ModelFrame(self._mounting)

    def __call__(
        self,
        points: ArrayLike | None = None,
        stamp_s: float | None = None,
        *,
        image: ArrayLike | None = None,
        origin_m: Sequence[float] | None = None,
        earlier: ArrayLike | None = None,
    ) -> Perception:
        """Perceive one scan, one image, or a scan and an image of the same moment.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like, or a structured array; None without a LiDAR model
            x, y, z [m] about the sensor, z up; remission in the sensor's raw unit. Not modified. Rows whose x, y or z
            is not finite, nearer than the sensor measures, or inside its ``ego_box`` are counted
            (`Perception.dropped`), labeled 0 and otherwise ignored; an empty scan gives an empty perception. A
            remission that is not finite is taken as the median of the others.
        stamp_s : float or None
            Time of the scan [s], for the tracker; returned in the perception.
        image : (H, W, 3) uint8 array_like; None without a camera model
            Red, green and blue, row 0 at the top (`edgeperc.read_image`), of any size up to 2**26 pixels. Not modified.
        origin_m : sequence of 3 float or None
            Place of the points' frame in a map [m]: what `edgeperc.read_points` subtracted. It is not subtracted here,
            but returned in the perception, which places its boxes in the map (`Perception.map_boxes`).
        earlier : (m, 4) or (m, 3) array_like, optional
            Points of earlier scans on what stands still, in the frame and unit of this one (`Sweeps.earlier`). They
            help to find the ground and objects, but get no labels, and neither labels of points nor cells depend on
            them otherwise.

        Raises
        ------
        PointsError
            ``points`` is not a scan, or is missing, or no LiDAR model is loaded for it.
        ImageError
            ``image`` is not an image, or is missing, or no camera model is loaded for it.
        InferenceError
            A network failed, or its output has values that are not finite.
        FitnessError
            The scan differs from the training scans, grossly if ``on_mismatch`` is ``"refuse"``.
        OptionError
            ``origin_m`` is not three finite numbers.
        StampError
            ``stamp_s`` is not a number.
        """
        self._check_given(points, image)
        if stamp_s is not None:
            stamp_s = as_seconds(stamp_s)
        place = None if origin_m is None else as_origin(origin_m)
        scan = None if points is None else as_points(points)
        pixels = None if image is None else as_image(image)
        before = None if earlier is None else as_points(earlier)
        with self._calls.one():
            watch = Stopwatch()
            if scan is None:
                perception = Perception(0, 0, None, None, (), watch.ms, dict(self.providers), (), stamp_s)
            else:
                if not self._is_sensor_known and len(scan):
                    self._find_sensor(scan)
                    watch.lap("check")
                check = self._learned.to_check > 0 and len(scan) > 0
                perception = self._perceive(scan, stamp_s, watch, check, before)
                if check:
                    self._learned = self._learned._replace(to_check=self._learned.to_check - 1)
            if pixels is not None and self._camera is not None:
                perception = replace(perception, image=self._camera.label(pixels, watch))
            if place is not None:
                perception = replace(perception, origin_m=place)
            found = findings.by_kind(perception.fitness)
            if perception.dropped.too_near:
                found["too near"] = about_too_near(perception.dropped, perception.n_points, self.sensor)
            detector = None if scan is None or self._pipeline is None else self._pipeline.pillars
            if detector is not None and (left_out := detector.about_left_out()):
                found["left out"] = left_out
            if perception.health is not None and self.on_mismatch != "ignore":
                found |= findings_of(perception.health)
            news = [text for kind, text in found.items() if kind not in self._told_of]
            self._told_of |= {*found}
        for sentence in news:
            warnings.warn(sentence, stacklevel=2)
        return perception

    def _check_given(self, points: ArrayLike | None, image: ArrayLike | None) -> None:
        """Raise `PointsError` or `ImageError` if there is no input for a model, or no model for an input."""
        loaded = ", ".join(card.name for card in self.cards)
        if points is None and self._pipeline is not None:
            name = next(card.name for card in self.cards if not isinstance(card.view, CameraGeometry))
            raise PointsError(f"got no points, and {name} needs a scan; pass points, (n, 4), or leave out {name}")
        if points is not None and self._pipeline is None:
            raise PointsError(
                f"got points, and the only model is of a camera ({loaded}); pass image= alone, or add LiDAR models: "
                f"Perceiver({[*DEFAULT, loaded]})"
            )
        if image is None and self._camera is not None:
            name = self._camera.session.card.name
            raise ImageError(f"got no image, and {name} needs one; pass image=, (H, W, 3) uint8, or leave out {name}")
        if image is not None and self._camera is None:
            raise ImageError(
                f"got an image, and none of the models is of a camera ({loaded}); add one such as {CAMERA} to models="
            )

    def _perceive(
        self, scan: Points, stamp_s: float | None, watch: Stopwatch, check: bool, earlier: Points | None
    ) -> Perception:
        given, before, profile = scan, self._learned, self.sensor
        known = before.mounting.known
        hidden: tuple[findings.Finding | None, ...] = ()
        turned: tuple[findings.Finding, ...] = ()
        matched: tuple[findings.Finding, ...] = ()
        scan, dropped = returns(given, profile, known.origin_m)
        centered = about_sensor(scan, known.origin_m)
        if self._renders:
            remission, profile, matched = before.remission.add(centered)
            self._learned = before._replace(remission=remission)
        scan, n_overflowed = scale(scan, profile, rendered=self._renders)
        if earlier is not None:
            earlier, _ = scale(returns(earlier, profile, known.origin_m)[0], profile, rendered=self._renders)
        dropped = replace(dropped, not_finite=dropped.not_finite + n_overflowed)
        watch.lap("adapt" if self._renders and profile.remission is not None else "check")
        if check and known.roll_deg is not None:
            turned = findings.check_hanging(centered, near_support, share_below, known)
        if not before.mounting.is_complete and len(scan):
            if check and known.roll_deg is None:
                turned = findings.check_beams(centered, profile) or findings.check_ground(
                    centered, near_support, share_below, profile
                )
            try:
                self._learn(self._learned._replace(mounting=before.mounting.add(scan)))
                hidden = self._about_height(), self._about_tilt()
            except MountingError as exc:
                hidden = (self._without_ground(exc),)
            watch.lap("check")
        if check and (known.roll_deg, known.pitch_deg) != (None, None):
            lying = findings.about_lying(known)
            hidden = (*hidden, lying, findings.about_given_tilt(self._mounting, before.mounting.contradicted_by(scan)))
            watch.lap("check")
        upright = profile.upright(known)
        if not self._frame.is_identity:
            scan = self._frame.move(scan)
            earlier = None if earlier is None else self._frame.move(earlier)
            watch.lap("adapt")
        fitness = findings.check_dropped(given, dropped, profile) if check else ()
        if check and not fitness:
            ceiling_m = find_ceiling(scan, float(self._frame.eye[2]))
            fitness = turned or findings.check_profiles(scan, self._fitness, upright, self._frame, ceiling_m)
            fitness = findings.with_raw_remission(fitness, given, profile)
        if check and not any(finding.gross for finding in fitness):
            fitness = (*fitness, *filter(None, hidden))
        if self.on_mismatch != "ignore":
            fitness = (*fitness, *matched)
        if check:
            try:
                self._refuse(fitness)
            except FitnessError:
                # Nothing is learnt from a refused scan; nor the sensor, if no scan before it told that.
                self._learn(before if before.to_check < CHECKED_SCANS else before._replace(sensor_estimate=None))
                raise
        scan, health, parts = self._without_drops(scan, given, upright, watch, earlier)
        return Perception(
            n_points=len(scan),
            n_dropped=dropped.total,
            points=parts.points,
            top_view=parts.top_view,
            boxes=self._frame.boxes_back(parts.boxes),
            stage_ms=watch.ms,
            providers=dict(self.providers),
            fitness=fitness,
            stamp_s=stamp_s,
            mounting=self._mounting,
            remission=profile.remission if self._renders else None,
            dropped=dropped,
            ground=parts.ground,
            health=health,
            sensor=self.sensor,
        )

    def _without_drops(
        self, scan: Points, given: Points, profile: SensorProfile, watch: Stopwatch, earlier: Points | None
    ) -> tuple[Points, SensorHealth, Parts]:
        """The scan without rain and snow, the sensor's health (by the scan as given), and what is perceived.

        Drops come in scan after scan. Where the last one had none, this one is perceived while it is checked (1.7 ms on
        one core), and anew if it has some.
        """
        assert self._pipeline is not None
        own: Points | None = None
        if profile.ego_box is not None:
            sample = given[:: sample_step(len(given))]
            own = self._frame.move(own_returns(sample, profile, self._learned.mounting.known.origin_m))
        check = partial(check_health, sensor=profile, normal=self._learned.normal, eye_m=self._frame.eye, own=own)
        parts = None if self._has_drops else self._pipeline(scan, self._mounting, watch, check, earlier)
        health, normal = check(scan) if parts is None else parts.beside
        self._learned, self._has_drops = self._learned._replace(normal=normal), health.has_drops
        if health.has_drops:
            scan, n_drops = without_drops(scan, profile, self._frame.eye)
            health, parts = replace(health, n_drops=n_drops), None
        watch.lap("check")
        return scan, health, parts or self._pipeline(scan, self._mounting, watch, earlier=earlier)

    def _without_ground(self, reason: MountingError) -> findings.Finding | None:
        """What to say of a scan that does not show how the sensor is mounted, if no other scan has."""
        if self.mounting is not None:
            return None
        return findings.Finding(
            f"The mounting of the sensor cannot be estimated ({reason}); it is taken as "
            f"{self._mounting.height_m:g} m above the road and level: pass mounting= (on the command line "
            "--mount-height or --extrinsic)."
        )

    def _about_height(self) -> findings.Finding | None:
        """What to say of a height that was found from little ground: that of a sensor that is high, or looks up."""
        if not self._learned.mounting.is_height_unsure():
            return None
        found = self._learned.mounting.estimate()
        return findings.Finding(
            f"The sensor seems to be {found.mounting.height_m:.1f} +- {found.height_sd_m:.1f} m above the road. It "
            "sees little of the road near by, and its height may be off by a meter: pass mounting= (on the command "
            "line --mount-height)."
        )

    def _about_tilt(self) -> findings.Finding | None:
        """What to say if the scans suggest a tilt, and their ground is too uneven to be sure."""
        doubtful = self._learned.mounting.doubtful()
        if not doubtful:
            return None
        found = self._learned.mounting.estimate()
        shown = " and ".join(
            f"{name} of {getattr(found.mounting, f'{name}_deg'):.1f} +- {getattr(found, f'{name}_sd_deg'):.1f} deg"
            for name in (name.removesuffix("_deg") for name in doubtful)
        )
        return findings.Finding(
            f"The ground suggests a {shown}, but it is too uneven to tell a tilt of the sensor from its own slope: "
            "the sensor is taken as level until scans of other places agree. If you know its tilt, pass mounting= "
            "(on the command line --roll, --pitch or --extrinsic)."
        )

    def _refuse(self, fitness: tuple[findings.Finding, ...]) -> None:
        """Raise FitnessError if ``on_mismatch`` asks for it."""
        if self.on_mismatch == "raise" and fitness:
            raise FitnessError(" ".join(fitness))
        if self.on_mismatch == "refuse" and any(finding.gross for finding in fitness):
            raise FitnessError(
                f"{' '.join(fitness)} Results would be meaningless. To perceive it all the same, pass "
                'on_mismatch="warn" (on the command line --anyway).'
            )
