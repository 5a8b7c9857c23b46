"""The one file that joins the stages: a scan in, a perception out."""

from __future__ import annotations

import math
import os
import threading
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adapt import Interpolator, condition
from .card import ModelCard, RangeImageGeometry, TopViewGeometry
from .cluster import MIN_SCORE, join_boxes, objects_from_points
from .decode import decode_classes, decode_top_view
from .errors import FitnessError
from .fitness import FitnessProfile, check_fitness
from .ground import find_ground
from .perception import Box, Perception, PointLabels, TopView
from .points import as_points
from .projection import RangeImageProjector, TopViewProjector, make_projector
from .refine import label_points, remove_outliers
from .sensor import SensorProfile, get_sensor
from .session import Session
from .zoo import DEFAULT

__all__ = ["ADAPTATIONS", "BoxesFrom", "Perceiver"]

STAGES = ("check", "project", "infer", "decode", "refine", "cluster")
Adaptation = Literal["both", "remission", "interpolation", "neither"]
BoxesFrom = Literal["both", "network", "clusters"]
ADAPTATIONS: tuple[Adaptation, ...] = ("neither", "remission", "interpolation", "both")

# A wrong set-up shows in any scan; a few are looked at, as one may be taken in a tunnel or a depot.
CHECKED_SCANS = 5


class _Stopwatch:
    """Adds up the wall time of each stage."""

    def __init__(self) -> None:
        self.ms = dict.fromkeys(STAGES, 0.0)
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


@dataclass(frozen=True)
class _Network:
    session: Session
    projector: TopViewProjector | RangeImageProjector
    index: NDArray[np.int32]
    fitness: FitnessProfile | None
    interpolator: Interpolator | None


class Perceiver:
    """Turn a LiDAR scan into drivable area, boxes and a class for every point.

    Everything a model needs is read from its card, so a name or a path is enough. Construction loads, checks and warms
    up. Working buffers are reused between calls; results are yours. One instance answers one call at a time (others
    wait); for parallel calls make one a thread.

    Parameters
    ----------
    models : str, Path, sequence of these, or None
        Names of shipped models (``"ssadnet"``, ``"pointseg:int8"``) or paths of .onnx files with a card; at most one
        model a view. None takes the best pair, `edgeperc.zoo.DEFAULT`.
    sensor : str, Path or SensorProfile
        Where the points come from: a built-in name (`edgeperc.sensor.SENSORS`), a file that ``edgeperc adapt fit``
        wrote, or a profile. Says how raw remissions map to 0..1, and how they are rendered as the training sensor's.
    provider : str
        ``"auto"``, ``"cpu"``, ``"openvino"``, ... A provider asked for is required (`edgeperc.session.PROVIDERS`).
    precision : {"auto", "fp32", "bf16", "int8"}
        What the networks compute in. ``"auto"`` takes a reduced precision where it is native to the processor and the
        card shows that it loses at most 0.3 points (`edgeperc.zoo.choose`); ``"fp32"`` forbids that.
    n_threads : int or None
        Threads inside one call; None leaves it to the provider. The answer does not depend on it.
    on_mismatch : {"warn", "raise", "ignore"}
        What to do when one of the first scans is unlike those the model was trained on. ``"ignore"`` skips the check.
    score_threshold : float or None
        Least score of a box; None takes the card's, and 0.3 of a cluster's.
    adapt : {"both", "remission", "interpolation", "neither"}
        What is done about another sensor than the models were trained on: its remission is rendered, where its profile
        has a function, and a range image is filled between its beams and columns, where it has fewer. Nothing where
        the sensor is the same.
    boxes_from : {"both", "network", "clusters"}
        ``"network"``: the boxes of a top-view model, vehicles ahead. ``"clusters"``: those around what stands on the
        ground and carries a range-image model's labels, of every class and as far as that model sees
        (`edgeperc.cluster.objects_from_points`). ``"both"``: whichever the models allow; a cluster's box goes where
        there is a network's, and where a network looks for that class.
    all_around : bool
        Where a range-image model sees a part of the turn, run it for every part, four times for the shipped ones: then
        every point has a class, and there are boxes beside and behind the vehicle.

    Attributes
    ----------
    cards : tuple of ModelCard
    sessions : tuple of Session
        The networks as they are loaded; not to be run from outside.
    providers : mapping
        What really runs, by model name: ``"pointseg int8, CPUExecutionProvider"``.

    Raises
    ------
    ModelError, ProviderError, SensorError, MissingExtraError
        From construction only.
    PointsError, InferenceError, FitnessError
        From a call.

    Examples
    --------
    >>> perceive = Perceiver("pointseg")                        # doctest: +SKIP
    >>> perception = perceive(read_points("000000.bin"))        # doctest: +SKIP
    >>> perception.points.labels.shape                          # doctest: +SKIP
    (123397,)
    """

    def __init__(
        self,
        models: str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None = None,
        *,
        sensor: str | os.PathLike[str] | SensorProfile = "hdl-64e",
        provider: str = "auto",
        precision: str = "auto",
        n_threads: int | None = None,
        on_mismatch: Literal["warn", "raise", "ignore"] = "warn",
        score_threshold: float | None = None,
        adapt: Adaptation = "both",
        boxes_from: BoxesFrom = "both",
        all_around: bool = False,
    ) -> None:
        if adapt not in ADAPTATIONS:
            raise ValueError(f"adapt is {adapt!r}; expected one of {', '.join(ADAPTATIONS)}")
        if on_mismatch not in ("warn", "raise", "ignore"):
            raise ValueError(f"on_mismatch is {on_mismatch!r}; expected warn, raise or ignore")
        if boxes_from not in ("both", "network", "clusters"):
            raise ValueError(f"boxes_from is {boxes_from!r}; expected both, network or clusters")
        if score_threshold is not None and not 0.0 <= score_threshold <= 1.0:
            raise ValueError(f"score_threshold is {score_threshold}; expected a number in 0..1")
        self.sensor = get_sensor(sensor)
        self.on_mismatch = on_mismatch
        self.score_threshold = score_threshold
        self._interpolates = adapt in ("both", "interpolation")
        self._renders = self.sensor.remission is not None and adapt in ("both", "remission")
        self.boxes_from = boxes_from
        self.all_around = all_around
        gaps_deg = [upper - lower for upper, lower in pairwise(self.sensor.elevations_deg)]
        # Neighbouring beams and columns meet on one object, with one missing between them.
        self._distance_per_m = 2.0 * math.radians(max(np.median(gaps_deg or [0.0]), 360.0 / self.sensor.columns))
        given = [models] if isinstance(models, (str, os.PathLike)) else list(DEFAULT if models is None else models)
        self._networks = [
            self._load(Session(model, provider, precision=precision, n_threads=n_threads)) for model in given
        ]
        views = [n.session.card.view.kind for n in self._networks]
        if not views or len(views) != len(set(views)):
            raise ValueError(
                f"models {[str(m) for m in given]} have views {views}; expected at least one model, at most one a view"
            )
        if boxes_from == "clusters" and "range_image" not in views:
            raise ValueError("boxes_from is 'clusters', which takes a class for every point; add a range-image model")
        self.sessions: tuple[Session, ...] = tuple(n.session for n in self._networks)
        self.cards: tuple[ModelCard, ...] = tuple(n.session.card for n in self._networks)
        self.providers = MappingProxyType({n.session.card.name: n.session.description for n in self._networks})
        self._to_check = 0 if on_mismatch == "ignore" else CHECKED_SCANS
        self._lock = threading.Lock()
        # The first call would compile the kernels; a scan of two points, in every view, gets that over with here. The
        # networks have run already, on their golden inputs; the answers to those will do.
        warm_up = np.array([[10, 0, -1, 0], [20, 1, -1, 0]], np.float32)
        self._perceive(warm_up, None, check=self._to_check > 0, infer=False)
        if boxes_from != "network" and "range_image" in views:
            self._find_objects(*self._post_on_floor())

    def _load(self, session: Session) -> _Network:
        card = session.card
        interpolator = None
        if self._interpolates and isinstance(card.view, RangeImageGeometry):
            interpolator = Interpolator(card.view, self.sensor)
        return _Network(
            session=session,
            projector=make_projector(card.view, card.input),
            index=np.empty((card.view.height, card.view.width), np.int32),
            fitness=None if card.fitness is None else FitnessProfile.from_dict(card.fitness),
            interpolator=interpolator if interpolator is not None and interpolator.needed else None,
        )

    def __call__(self, points: ArrayLike, stamp_s: float | None = None) -> Perception:
        """Perceive one scan.

        Parameters
        ----------
        points : (n, 4) or (n, 3) array_like, or a structured array
            x, y, z [m] in the sensor frame, remission in the sensor's raw unit. Left unchanged. Rows that are not
            finite are counted, labelled 0 and otherwise ignored; an empty scan gives an empty perception.
        stamp_s : float or None
            Passed through.
        """
        scan = as_points(points)
        with self._lock:
            check = self._to_check > 0 and len(scan) > 0
            self._to_check -= check
            perception = self._perceive(scan, stamp_s, check)
        if perception.fitness and self.on_mismatch == "raise":
            raise FitnessError("; ".join(perception.fitness))
        for sentence in perception.fitness:
            warnings.warn(sentence, stacklevel=2)
        return perception

    def _perceive(
        self, scan: NDArray[np.float32], stamp_s: float | None, check: bool, infer: bool = True
    ) -> Perception:
        watch = _Stopwatch()
        scan, n_dropped = condition(scan, self.sensor, rendered=self._renders)
        watch.lap("adapt" if self._renders else "check")
        fitness = self._check(scan) if check else ()
        watch.lap("check")
        points: PointLabels | None = None
        top_view: TopView | None = None
        boxes: tuple[Box, ...] = ()
        for network in self._networks:
            if isinstance(network.session.card.view, TopViewGeometry):
                top_view, boxes = self._see_from_above(network, scan, watch, infer)
            else:
                points = (self._look_around if self.all_around else self._see_from_sensor)(network, scan, watch, infer)
        if points is not None and self.boxes_from != "network":
            clustered = self._find_objects(scan, points)
            boxes = join_boxes(boxes, self._new_to_networks(clustered)) if self.boxes_from == "both" else clustered
            watch.lap("cluster")
        return Perception(
            n_points=len(scan),
            n_dropped=n_dropped,
            points=points,
            top_view=top_view,
            boxes=boxes,
            stage_ms=MappingProxyType(watch.ms),
            providers=self.providers,
            fitness=fitness,
            stamp_s=stamp_s,
        )

    def _check(self, scan: NDArray[np.float32]) -> tuple[str, ...]:
        found: dict[str, None] = {}
        for network in self._networks:
            if network.fitness is not None:
                found |= dict.fromkeys(check_fitness(scan, network.fitness, self.sensor))
        return tuple(found)

    def _project(self, network: _Network, scan: NDArray[np.float32]) -> NDArray[np.int32]:
        pixel = np.empty(len(scan), np.int32)
        network.projector.fill(scan, network.session.input, network.index, pixel)
        return pixel

    def _see_from_above(
        self, network: _Network, scan: NDArray[np.float32], watch: _Stopwatch, infer: bool
    ) -> tuple[TopView, tuple[Box, ...]]:
        """SSADNet: segmentation map and boxes."""
        card = network.session.card
        assert isinstance(card.view, TopViewGeometry)
        self._project(network, scan)
        watch.lap("project")
        outputs = network.session.run() if infer else network.session.outputs
        watch.lap("infer")
        threshold = card.score_threshold if self.score_threshold is None else self.score_threshold
        labels, found = decode_top_view(card, network.index >= 0, outputs, threshold)
        watch.lap("decode")
        view = TopView(labels, card.classes, card.view.cell_m, card.view.x_range_m, card.view.y_range_m)
        return view, tuple(found)

    def _see_from_sensor(
        self, network: _Network, scan: NDArray[np.float32], watch: _Stopwatch, infer: bool
    ) -> PointLabels:
        """PointSeg: a class for every pixel, carried back to every point and cleaned."""
        card = network.session.card
        assert isinstance(card.view, RangeImageGeometry)
        pixel = self._project(network, scan)
        watch.lap("project")
        if network.interpolator is not None:
            assert isinstance(network.projector, RangeImageProjector)
            # Points between are in the image alone; from here on there are only those that came.
            dense, filled = network.interpolator.fill(scan, network.index)
            network.projector.fill_image(dense, filled, network.session.input)
            watch.lap("adapt")
        outputs = network.session.run() if infer else network.session.outputs
        watch.lap("infer")
        ((kind, raw),) = outputs.items()
        labels, _ = decode_classes(raw, kind, model=card.name)
        watch.lap("decode")
        full_turn = card.view.azimuth_left_deg - card.view.azimuth_right_deg == 360.0
        cleaned = remove_outliers(scan, network.index, labels, card.classes, full_turn=full_turn)
        labelled = label_points(scan, pixel, network.index, cleaned, full_turn=full_turn)
        watch.lap("refine")
        return PointLabels(labelled, pixel >= 0, card.classes)

    def _look_around(self, network: _Network, scan: NDArray[np.float32], watch: _Stopwatch, infer: bool) -> PointLabels:
        """What a network that looks ahead sees as the scan is turned; where two views meet, the earlier counts."""
        view = network.session.card.view
        assert isinstance(view, RangeImageGeometry)
        width_deg = view.azimuth_left_deg - view.azimuth_right_deg
        ahead = self._see_from_sensor(network, scan, watch, infer)
        labels, in_view = ahead.labels, ahead.in_view
        for k in range(1, math.ceil(360.0 / width_deg)):
            cos, sin = math.cos(math.radians(k * width_deg)), math.sin(math.radians(k * width_deg))
            turned = scan.copy()
            turned[:, 0] = cos * scan[:, 0] + sin * scan[:, 1]
            turned[:, 1] = cos * scan[:, 1] - sin * scan[:, 0]
            aside = self._see_from_sensor(network, turned, watch, infer)
            labels = np.where(in_view, labels, aside.labels)
            in_view = in_view | aside.in_view
        return PointLabels(labels, in_view, ahead.classes)

    def _post_on_floor(self) -> tuple[NDArray[np.float32], PointLabels]:
        """Nine points of a car on a floor, enough for every kernel of `_find_objects` to be compiled."""
        x, y = np.meshgrid(np.arange(-8.0, 8.0), np.arange(-8.0, 8.0))
        scan = np.zeros((x.size + 9, 4), np.float32)
        scan[:-9, 0], scan[:-9, 1], scan[:-9, 2] = x.ravel(), y.ravel(), -self.sensor.mount_height_m
        scan[-9:, 0], scan[-9:, 1] = 5.0, np.linspace(-0.2, 0.2, 9)
        labels = (np.arange(len(scan)) >= x.size).astype(np.uint8)
        return scan, PointLabels(labels, np.ones(len(scan), np.bool_), ("background", "car"))

    def _find_objects(self, scan: NDArray[np.float32], points: PointLabels) -> tuple[Box, ...]:
        """KUL-Seg 5.2: boxes around what stands on the ground, in clusters that one class prevails in.

        Points out of the network's view take part, as background: what the view's edge cuts gets a whole box, or none.
        """
        ground = find_ground(scan, mount_height_m=self.sensor.mount_height_m)
        return objects_from_points(
            scan,
            points.labels,
            points.classes,
            among=~ground.mask,
            height_m=ground.height_m,
            distance_per_m=self._distance_per_m,
            min_score=MIN_SCORE if self.score_threshold is None else self.score_threshold,
        )

    def _new_to_networks(self, boxes: tuple[Box, ...]) -> list[Box]:
        """Those that no network looks for: of another class, or out of its view."""
        looking = [(c.view, c.box_classes) for c in self.cards if isinstance(c.view, TopViewGeometry)]
        return [
            b for b in boxes if not any(b.label in classes and view.holds(*b.center[:2]) for view, classes in looking)
        ]
