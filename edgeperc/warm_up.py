"""Compile every kernel of a perceiver before its first scan.

`warm_up` runs the pipeline on small scans. At the first start, helper processes compile a part of the kernels while the
process that needs them compiles the rest, because numba compiles in one thread. Where the cache of kernels is empty and
can be written, `Helpers` starts one process for each further core, three at most. A helper runs this package in a new
interpreter and puts what it compiles into the cache; `system.kernel_cache` finds it there. It opens no model, writes
nothing else, and never imports the caller's main module. It ends by itself when its part is compiled, when the process
that started it has ended, or after two minutes, and is killed when construction ends. Everything that is not in the
cache afterwards is compiled as without helpers: one that cannot start, fails or hangs costs time and changes nothing.

No helper starts in a frozen application, in a program that embeds Python (`sys.executable` is then no Python
interpreter), on one core, without a cache that can be written, and at later starts.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from itertools import product
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple

import numpy as np

from .agreement import rules
from .agreement.cells import agree_on_cells, mark_cells
from .errors import MountingError
from .ground.leveling import MountingEstimator
from .ground.planes import Ground, fill_planes, find_ground
from .ground.scan import Scan
from .inference.detections import decode_detections
from .inference.session import Session
from .objects.boxes import fill_rectangle, join_boxes, objects_from_points
from .objects.linkage import fill_clusters
from .pipeline import Pipeline, RangeImageNetwork, TopViewNetwork, View
from .preprocess.condition import render
from .preprocess.findings import check_profiles
from .preprocess.fitness import FitnessProfile
from .preprocess.health import Normal, check_health
from .preprocess.remission import NO_REMISSION
from .preprocess.returns import returns
from .road.ahead import compile_kernels
from .road.outline import merge_corners
from .system.compiling import fewer_collections, tell_watchers
from .system.interpreter import interpreter, interpreter_flags
from .system.kernels import is_ahead
from .system.lanes import Lanes, Stopwatch
from .system.machine import usable_cores
from .types.frame import ModelFrame
from .types.geometry import suppress_overlaps
from .types.mounting import MODEL_HEIGHT_M, MODEL_MOUNTING, Mounting
from .types.perception import Box, PointLabels, TopView
from .types.points import Floats32, Heights, Points, read_only
from .types.sensor import SensorProfile

logger = logging.getLogger(__name__)

MAX_S = 120.0  # after which a helper ends in any case; one took 12 s on two cores at 2.4 GHz
MIN_WAIT_S = 5.0
LOOK_S = 0.25  # after which those who watch see how far the helpers are

# At the end, nothing is collected or torn down, which would take a second.
START = "import os, sys; sys.path[:] = sys.argv[2:]; from edgeperc.warm_up import main; main(sys.argv[1]); os._exit(0)"


def car_and_person() -> tuple[Floats32, PointLabels]:
    """Nine points of a car and a person on a floor, and their labels: enough to compile every kernel of objects.

    Returns points: (n, 4) float32.
    """
    x, y = np.meshgrid(np.arange(-8.0, 8.0), np.arange(-8.0, 8.0))
    scan = np.zeros((x.size + 9, 4), np.float32)
    scan[:-9, 0], scan[:-9, 1], scan[:-9, 2] = x.ravel(), y.ravel(), -MODEL_HEIGHT_M
    scan[-9:, 0], scan[-9:, 1] = 5.0, np.linspace(-0.2, 0.2, 9)
    labels = (np.arange(len(scan)) >= x.size).astype(np.uint8)
    labels[-1] = 2
    return scan, PointLabels(labels, np.ones(len(scan), np.bool_), ("background", "car", "pedestrian", "cyclist"))


class _StandIn:
    """Stands in for another object, with all that it has."""

    def __init__(self, other: object) -> None:
        vars(self).update(vars(other))


class Rehearsed(_StandIn, Session):
    """A session whose runs give the outputs of its last one, at first those of the golden input."""

    def run(self, n_rows: int = 1) -> Mapping[str, Floats32]:
        """`Session.outputs`, without running the network."""
        return self.outputs


class _RehearsedTop(_StandIn, TopViewNetwork):
    """Gives one uncertain box in place of what its network would."""

    def find_boxes(self, projected: None, score_threshold: float, named_from: float) -> list[Box]:
        return [UNCERTAIN] if self.card.box_classes else []

    def project(self, near: View) -> None:
        self.index.fill(-1)


class RehearsedRange(_StandIn, RangeImageNetwork):
    """Gives the labels that `car_and_person` wrote into the remission of the points."""

    def label(self, points: Points, height_m: Heights | None, watch: Stopwatch) -> PointLabels:
        labels = np.minimum(points[:, 3], len(self.card.classes) - 1).astype(np.uint8)  # it may know one class only
        return PointLabels(labels, np.ones(len(points), np.bool_), self.card.classes)


def warm_up(
    pipeline: Pipeline,
    needs: Collection[str],
    sensor: SensorProfile,
    fitness: Sequence[FitnessProfile],
    estimator: MountingEstimator,
) -> None:
    """Compile what a scan needs, and `edgeperc.road_ahead`, unless that was done when the package was built.

    needs : keys of `edgeperc.system.compilation.KERNELS`
    """
    if is_ahead():
        return
    few_points = np.array([[10, 0, -1, 0], [20, 1, -1, 0], [0, 0, 0, 0]], np.float32)
    options, top, ranged = pipeline.options, pipeline.top, pipeline.ranged
    objects, pillars, alone = copy(pipeline.objects), copy(pipeline.pillars), Lanes(1)
    with fewer_collections(), Helpers(needs) as helpers:
        # The networks' own stages, with their outputs for the golden input
        few_points, _ = returns(few_points, sensor)
        check_health(few_points, sensor, Normal())
        render(few_points, replace(sensor, remission=NO_REMISSION))
        check_profiles(few_points, fitness, sensor)
        if "ground" in needs:
            find_ground(few_points, mount_height_m=MODEL_HEIGHT_M)  # these show none
        golden_top, golden_ranged = copy(top), [copy(network) for network in ranged]
        for network in (golden_top, *golden_ranged):
            if network is not None:
                network.session = Rehearsed(network.session)
        apart = replace(options, rules=frozenset(), boxes_from="network")
        Pipeline(golden_top, golden_ranged, apart, alone)(few_points, MODEL_MOUNTING, Stopwatch())
        # What moves a scan
        floor, labels = car_and_person()
        with suppress(MountingError):  # the floor has no street
            estimator.add(floor)
        ModelFrame(Mounting(0.0, 0.0, 0.0, 0.0)).move(floor)
        helpers.wait()  # for what follows
        # Objects and agreement
        floor[:, 3] = labels.labels
        if objects is not None:
            objects.closely = Rehearsed(objects.closely)
            objects.sessions = [objects.closely] * len(objects.sessions)
        if pillars is not None:
            pillars.session = Rehearsed(pillars.session)
            pillars.find_boxes(read_only(floor))
            decode_detections(pillars.card, pillars.session.outputs, 1.0)
            join_boxes([UNCERTAIN], [UNCERTAIN])
            suppress_overlaps(np.zeros((2, 5)), np.zeros(2), 0.0)
        rehearsed_top = None if top is None else _RehearsedTop(top)
        rehearsed = Pipeline(
            rehearsed_top,
            [RehearsedRange(network) for network in ranged[:1]],
            replace(options, full_turn=False),
            alone,
            objects,
            pillars,
        )
        rehearsed(read_only(floor), MODEL_MOUNTING, Stopwatch())
        if "boxes" in needs:
            compile_parts(["boxes"])  # some only several boxes need
        if "standing" in needs:
            rules.stand_boxes([UNCERTAIN], *_made_up())
        if "top_view" in needs:
            compile_kernels()


UNCERTAIN = Box("car", 0.4, (5.0, 0.0, -1.0), (4.0, 1.6, 1.5), 0.0)


def _made_up() -> tuple[Scan, PointLabels]:
    """A scan with its ground, and its labels; no kernel is needed for these."""
    points, labels = car_and_person()
    mask = labels.labels == 0
    ground = Ground(mask, np.where(mask, 0.0, MODEL_HEIGHT_M).astype(np.float32), (0.0, 0.0, -MODEL_HEIGHT_M))
    return Scan.of(points, ground, labels), labels


def _compile_clusters() -> None:
    scan, labels = _made_up()
    rules.find_voters(
        scan, labels, rules.Support(np.zeros(len(scan.points), np.float32), np.zeros(len(scan.points), np.uint8))
    )


def _compile_boxes() -> None:
    scan, labels = _made_up()
    clusters = np.where(scan.ground.mask, -1, 0).astype(np.int32)
    for label in (1, 2):  # one cluster of a car; one of a person, without points next to it that would be clustered
        alike = np.where(scan.ground.mask, 0, label).astype(np.uint8)
        objects_from_points(scan.points, alike, labels.classes, height_m=scan.ground.height_m, clusters=clusters)
    join_boxes([UNCERTAIN], [UNCERTAIN])
    suppress_overlaps(np.zeros((2, 5)), np.zeros(2), 0.0)


def _compile_agreement() -> None:
    scan, labels = _made_up()
    support = rules.find_support(scan, labels, [UNCERTAIN])
    clusters = np.where(scan.ground.mask, -1, 0).astype(np.int32)
    agreed = rules.agree_on_points(scan, labels, clusters, support, rules.without_poles(scan, labels))
    rules.agree_on_boxes([UNCERTAIN], scan, agreed)
    cells = np.zeros((400, 200), np.uint8)
    view = TopView(cells, ("background", "drivable"), 0.1, (6.0, 46.0), (-10.0, 10.0), np.ones(cells.shape, np.bool_))
    agree_on_cells(view, agreed, [UNCERTAIN], [UNCERTAIN], mark_cells(view, scan, agreed))


def _compile_ground() -> None:
    find_ground(car_and_person()[0], mount_height_m=MODEL_HEIGHT_M)


class Part(NamedTuple):
    """Kernels that a helper can compile."""

    compile: Callable[[], None]  # compiles them, by calling what uses them
    largest: Any  # the kernel that takes longest
    seconds: float  # what all of them take on a core at 2.4 GHz


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "clusters": Part(_compile_clusters, fill_clusters, 3.7),
        "boxes": Part(_compile_boxes, fill_rectangle, 2.7),
        "agreement": Part(_compile_agreement, rules.clear_columns, 2.9),
        "top_view": Part(compile_kernels, merge_corners, 2.0),
        "ground": Part(_compile_ground, fill_planes, 2.2),
    }
)
OTHERS_S = 6.5  # what the other kernels of a perceiver take
MAX_HELPERS = 3


class Helpers:
    """Processes that compile parts of the kernels, for use in a ``with`` statement; at its end none is left.

    needs : those of `PARTS` among them are compiled. Those in the cache are left out.
    """

    def __init__(self, needs: Collection[str]) -> None:
        self._began_s = time.monotonic()
        self.running: list[subprocess.Popen[bytes]] = []
        parts = [part for part in PARTS if part in needs and is_cold(PARTS[part].largest)]
        self.own_parts, *self.shares = _shares(parts)

    def __enter__(self) -> Helpers:
        for share in self.shares:
            try:
                self.running.append(_start(share))
            except (OSError, ValueError) as exc:  # such as no memory, no permission, or a path with a null character
                logger.info("no helper process compiles kernels at this first start: %s", exc)
                break
        return self

    def wait(self) -> None:
        """Compile the caller's share and wait for the others, but not longer than that took (at least 5 s)."""
        if self.running:
            compile_parts(self.own_parts)
        until_s = time.monotonic() + max(MIN_WAIT_S, time.monotonic() - self._began_s)
        for helper in self.running:
            while (code := helper.poll()) is None and (left_s := until_s - time.monotonic()) > 0.0:
                tell_watchers()
                with suppress(subprocess.TimeoutExpired):
                    helper.wait(min(left_s, LOOK_S))
            if code is None:
                logger.info("a helper process that compiles kernels takes too long; they are compiled here")
            elif code != 0:
                logger.info("a helper process that compiles kernels ended with %d; they are compiled here", code)
        self._end()

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, at: TracebackType | None) -> None:
        self._end()

    def _end(self) -> None:
        while self.running:
            helper = self.running.pop()
            helper.kill()
            helper.wait()
            assert helper.stdin is not None
            helper.stdin.close()


def compile_parts(parts: Sequence[str]) -> None:
    """Compile parts of the kernels in this process, one after the other, into the cache."""
    with fewer_collections():
        for part in parts:
            PARTS[part].compile()


def main(parts: str) -> None:
    """Run a helper process: compile parts, separated by commas, until standard input ends or time is up."""

    def watch() -> None:
        os.read(0, 1)  # returns when the process that started this one closes it, or has ended
        _kill()

    for thread in (threading.Thread(target=watch), threading.Timer(MAX_S, _kill)):
        thread.daemon = True
        thread.start()
    gc.disable()  # 0.1 GB more for a few seconds
    compile_parts(parts.split(","))


def _kill() -> None:
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def n_processes() -> int:
    """How many processes compile at a first start: this one, and one for each further core."""
    return 1 + min(usable_cores() - 1, MAX_HELPERS) if interpreter() is not None else 1


def _shares(parts: Sequence[str]) -> list[list[str]]:
    """Which parts the caller compiles, and which each helper, so that all are done soon."""
    n_helpers = n_processes() - 1 if parts else 0

    def seconds(owners: Sequence[int]) -> list[float]:
        loads = [OTHERS_S, *[0.0] * n_helpers]
        for part, owner in zip(parts, owners, strict=True):
            loads[owner] += PARTS[part].seconds
        return sorted(loads, reverse=True)

    owners = min(product(range(n_helpers + 1), repeat=len(parts)), key=seconds)
    shares = [[part for part, of in zip(parts, owners, strict=True) if of == owner] for owner in range(n_helpers + 1)]
    # The ground first: it is needed first.
    return [shares[0], *(sorted(share, key=lambda part: part != "ground") for share in shares[1:] if share)]


def is_cold(kernel: Any) -> bool:
    """Whether compiling this kernel is of use: it is not in the cache, which can be written."""
    is_missing = getattr(getattr(kernel, "_cache", None), "is_missing", None)
    return is_missing is not None and bool(is_missing())


def _start(parts: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a helper. It inherits no files; its standard input is open until it is closed or this process ends."""
    paths = [path for path in sys.path if isinstance(path, str)]
    environment = dict(os.environ)
    import numba

    config: Any = numba.config  # may have been set without the environment
    if config.CACHE_DIR:
        environment["NUMBA_CACHE_DIR"] = str(config.CACHE_DIR)
    return subprocess.Popen(
        [str(interpreter()), *interpreter_flags(), "-c", START, ",".join(parts), *paths],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
        close_fds=True,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )
