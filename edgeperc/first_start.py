"""The first start: helper processes compile a part of the kernels while the process that needs them compiles the rest.

numba compiles in one thread. Where the cache of kernels is empty and can be written, `Helpers` starts one process for
each further core, three at most. A helper runs this package in a new interpreter and puts what it compiles into the
cache; `edgeperc.kernel_cache` finds it there. It opens no model, writes nothing else, and never imports the caller's
main module. It ends by itself when its part is compiled, when the process that started it has ended, or after two
minutes, and is killed when construction ends. Everything that is not in the cache afterwards is compiled as without
helpers: one that cannot start, fails or hangs costs time, and changes no result.

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
from itertools import product
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from .agreement import agree_on_boxes, agree_on_points, clear_columns, find_support, find_voters, stand_boxes
from .cells import agree_on_cells
from .cluster import fill_rectangle, join_boxes, objects_from_points
from .drivable import compile_kernels
from .geometry import suppress_overlaps
from .ground import Ground, fill_planes, find_ground
from .kernel_cache import KernelCache, fewer_collections
from .linkage import fill_clusters
from .mounting import MODEL_HEIGHT_M
from .outline import merge_corners
from .perception import Box, PointLabels, TopView
from .tuning import usable_cores

__all__ = ["Helpers", "car_and_person", "compile_parts"]

logger = logging.getLogger(__name__)

MAX_S = 120.0  # after which a helper ends in any case; one took 12 s on two cores at 2.4 GHz
MIN_WAIT_S = 5.0

# At the end, nothing is collected or torn down, which would take a second.
START = (
    "import os, sys; sys.path[:] = sys.argv[2:]; from edgeperc.first_start import main; main(sys.argv[1]); os._exit(0)"
)


def car_and_person() -> tuple[NDArray[np.float32], PointLabels]:
    """Nine points of a car and a person on a floor, and their labels: enough to compile every kernel of objects.

    Returns
    -------
    points : (n, 4) float32
    labels : PointLabels
    """
    x, y = np.meshgrid(np.arange(-8.0, 8.0), np.arange(-8.0, 8.0))
    scan = np.zeros((x.size + 9, 4), np.float32)
    scan[:-9, 0], scan[:-9, 1], scan[:-9, 2] = x.ravel(), y.ravel(), -MODEL_HEIGHT_M
    scan[-9:, 0], scan[-9:, 1] = 5.0, np.linspace(-0.2, 0.2, 9)
    labels = (np.arange(len(scan)) >= x.size).astype(np.uint8)
    labels[-1] = 2
    return scan, PointLabels(labels, np.ones(len(scan), np.bool_), ("background", "car", "pedestrian", "cyclist"))


def _made_up() -> tuple[NDArray[np.float32], PointLabels, Ground, tuple[Box, ...]]:
    """A scan, its labels, its ground and a network's box; no kernel is needed for these."""
    scan, points = car_and_person()
    mask = points.labels == 0
    ground = Ground(mask, np.where(mask, 0.0, MODEL_HEIGHT_M).astype(np.float32), (0.0, 0.0, -MODEL_HEIGHT_M))
    return scan, points, ground, (Box("car", 0.4, (5.0, 0.0, -1.0), (4.0, 1.6, 1.5), 0.0),)


def _compile_clusters() -> None:
    scan, points, ground, _ = _made_up()
    find_voters(scan, points, ground, support=(np.zeros(len(scan), np.float32), np.zeros(len(scan), np.uint8)))


def _compile_boxes() -> None:
    scan, points, ground, boxes = _made_up()
    clusters = np.where(ground.mask, -1, 0).astype(np.int32)
    for label in (1, 2):  # one cluster of a car; one of a person, without points beside it that would be clustered
        labels = np.where(ground.mask, 0, label).astype(np.uint8)
        objects_from_points(scan, labels, points.classes, height_m=ground.height_m, clusters=clusters)
    join_boxes(boxes, boxes)
    suppress_overlaps(np.zeros((2, 5)), np.zeros(2), 0.0)


def _compile_agreement() -> None:
    scan, points, ground, boxes = _made_up()
    held = find_support(scan, points, ground, boxes)
    clusters = np.where(ground.mask, -1, 0).astype(np.int32)
    points = agree_on_points(scan, points, ground, clusters, boxes, support=held)
    agree_on_boxes(boxes, scan, points, ground)
    stand_boxes(boxes, scan, points, ground)
    cells = np.zeros((400, 200), np.uint8)
    view = TopView(cells, ("background", "drivable"), 0.1, (6.0, 46.0), (-10.0, 10.0), np.ones(cells.shape, np.bool_))
    agree_on_cells(view, scan, points, ground, boxes, boxes)


def _compile_ground() -> None:
    find_ground(car_and_person()[0], mount_height_m=MODEL_HEIGHT_M)


class Part(NamedTuple):
    """Kernels that a helper can compile.

    Attributes
    ----------
    compile : callable
        Compiles them, by calling what uses them.
    largest : Dispatcher
        The kernel that takes longest.
    seconds : float
        What all of them take on a core at 2.4 GHz.
    """

    compile: Callable[[], None]
    largest: Any
    seconds: float


PARTS: Mapping[str, Part] = MappingProxyType(
    {
        "clusters": Part(_compile_clusters, fill_clusters, 3.0),
        "boxes": Part(_compile_boxes, fill_rectangle, 3.1),
        "agreement": Part(_compile_agreement, clear_columns, 2.9),
        "road": Part(compile_kernels, merge_corners, 2.2),
        "ground": Part(_compile_ground, fill_planes, 2.0),
    }
)
OTHERS_S = 8.3  # what the other kernels of a perceiver take
MAX_HELPERS = 3


class Helpers:
    """Processes that compile parts of the kernels, for use in a ``with`` statement; at its end none is left.

    Parameters
    ----------
    parts : collection of str
        Those of `PARTS` that the caller needs. Those in the cache are left out.
    """

    def __init__(self, parts: Collection[str]) -> None:
        self._began_s = time.monotonic()
        self._running: list[subprocess.Popen[bytes]] = []
        parts = [part for part in PARTS if part in parts and _is_cold(PARTS[part].largest)]
        self._own, *self._shares = _shares(parts)

    def __enter__(self) -> Helpers:
        for share in self._shares:
            try:
                self._running.append(_start(share))
            except (OSError, ValueError) as exc:  # such as no memory, no permission, or a path with a null character
                logger.info("no helper process compiles kernels at this first start: %s", exc)
                break
        return self

    def wait(self) -> None:
        """Compile the caller's share and wait for the others, but not longer than that took (at least 5 s)."""
        if self._running:
            compile_parts(self._own)
        until_s = time.monotonic() + max(MIN_WAIT_S, time.monotonic() - self._began_s)
        for helper in self._running:
            try:
                code = helper.wait(max(until_s - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                logger.info("a helper process that compiles kernels takes too long; they are compiled here")
            else:
                if code != 0:
                    logger.info("a helper process that compiles kernels ended with %d; they are compiled here", code)
        self._end()

    def __exit__(self, kind: type[BaseException] | None, exc: BaseException | None, at: TracebackType | None) -> None:
        self._end()

    def _end(self) -> None:
        while self._running:
            helper = self._running.pop()
            helper.kill()
            helper.wait()
            assert helper.stdin is not None
            helper.stdin.close()


def compile_parts(parts: Sequence[str]) -> None:
    """Compile parts of the kernels in this process, one after the other, into the cache.

    Parameters
    ----------
    parts : sequence of str
        Of `PARTS`.
    """
    with fewer_collections():
        for part in parts:
            PARTS[part].compile()


def main(parts: str) -> None:
    """Run a helper process: compile parts, separated by commas, until standard input ends or time is up."""

    def watch() -> None:
        os.read(0, 1)  # returns when the process that started this one closes it, or has ended
        _kill()

    def stop() -> None:
        time.sleep(MAX_S)
        _kill()

    for task in (watch, stop):
        threading.Thread(target=task, daemon=True).start()
    gc.disable()  # 0.1 GB more for a few seconds
    compile_parts(parts.split(","))


def _kill() -> None:
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def _shares(parts: Sequence[str]) -> list[list[str]]:
    """Which parts the caller compiles, and which each helper, so that all are done soon."""
    n_helpers = min(usable_cores() - 1, MAX_HELPERS) if parts and _interpreter() is not None else 0

    def seconds(owners: Sequence[int]) -> list[float]:
        loads = [OTHERS_S, *[0.0] * n_helpers]
        for part, owner in zip(parts, owners, strict=True):
            loads[owner] += PARTS[part].seconds
        return sorted(loads, reverse=True)

    owners = min(product(range(n_helpers + 1), repeat=len(parts)), key=seconds)
    shares = [[part for part, of in zip(parts, owners, strict=True) if of == owner] for owner in range(n_helpers + 1)]
    # The ground first: it is needed first.
    return [shares[0], *(sorted(share, key=lambda part: part != "ground") for share in shares[1:] if share)]


def _is_cold(kernel: Any) -> bool:
    """Whether compiling this kernel is of use: it is not in the cache, which can be written."""
    cache = getattr(kernel, "_cache", None)
    return isinstance(cache, KernelCache) and cache.is_missing()


def _interpreter() -> str | None:
    """The Python interpreter that runs this process; None where that is unknown."""
    # Where Python is embedded, `sys.executable` may be the application itself, which must not start twice.
    if getattr(sys, "frozen", False) or not sys.executable or not Path(sys.executable).stem.startswith("python"):
        return None
    return sys.executable


def _start(parts: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a helper. It inherits no files; its standard input is open until it is closed or this process ends."""
    flags = [*(["-B"] if sys.dont_write_bytecode else []), *(["-E"] if sys.flags.ignore_environment else [])]
    paths = [path for path in sys.path if isinstance(path, str)]
    environment = dict(os.environ)
    config: Any = numba.config  # may have been set without the environment
    if config.CACHE_DIR:
        environment["NUMBA_CACHE_DIR"] = str(config.CACHE_DIR)
    return subprocess.Popen(
        [str(_interpreter()), *flags, "-c", START, ",".join(parts), *paths],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env=environment,
        close_fds=True,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )
