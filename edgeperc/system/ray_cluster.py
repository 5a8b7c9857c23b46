"""Map items to results in worker processes, on this computer or on a Ray cluster (``--engine``, ``--workers``)."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

from ..errors import EdgepercError
from .extras import require
from .pool import MOST_DEATHS, Worker, attempt, map_in_processes, map_to_workers

# A local cluster's memory for items and results in transit; Ray's own default is 30 % of the computer's.
STORE_BYTES = 256 * 2**20


def load_ray() -> Any:
    """Import Ray, whose usage statistics are off. Raises MissingExtraError."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else Ray warns about a future default
    return require("ray", "ray", "--engine ray")


def map_on_ray(
    make: Callable[..., Callable[[Any], Any]],
    arguments: tuple[Any, ...],
    items: Sequence[Any],
    *,
    workers: int | None = None,
    n_threads: int = 1,
) -> Iterator[Any]:
    """Map items to results as `pool.map_in_processes`, on the cluster named by the environment variable
    ``RAY_ADDRESS``, else on a local one.

    Items wait until a worker is free, and workers wait until the results are taken, so memory use does not grow with
    the number of items. Ray's dashboard and usage statistics are off. ``n_threads`` CPUs are reserved for each worker.
    """
    if not items:
        return
    ray = load_ray()
    started = not ray.is_initialized()
    if started:
        local: dict[str, Any] = {}
        if "RAY_ADDRESS" not in os.environ:
            local = {"num_cpus": (workers or os.cpu_count() or 1) * n_threads, "object_store_memory": STORE_BYTES}
        with signals_kept():
            ray.init(**local, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        n_workers = workers or max(1, int(ray.cluster_resources().get("CPU", 1)) // n_threads)
        start = partial(_Actor, ray, ray.put((make, arguments)), n_threads, [])
        yield from map_to_workers(start, lambda ends: ray.wait(ends)[0], items, n_workers)
    finally:
        if started:
            ray.shutdown()


@contextlib.contextmanager
def signals_kept() -> Iterator[None]:
    """SIGTERM has its handler again at the end: `ray.init` replaces it for the rest of the process."""
    handler = signal.getsignal(signal.SIGTERM)
    yield
    # Python sets handlers in its main thread alone, and has no name for one of native code.
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


class _Actor(Worker):
    """A process of the cluster. It starts when CPUs are free: until then others do all items."""

    def __init__(self, ray: Any, start: Any, n_threads: int, failed: list[str]) -> None:
        super().__init__()
        self._ray = ray
        self._failed = failed  # why processes ended that had not begun, since one began
        self._actor = ray.remote(_Remote).options(num_cpus=n_threads).remote()
        self._answers = deque([self._actor.start.remote(start)])

    @property
    def end(self) -> Any:
        return self._answers[0] if self._answers else None

    def begin(self, item: bytes) -> None:
        self._answers.append(self._actor.do.remote(item))

    def answer(self) -> bytes:
        try:
            answer: bytes = self._ray.get(self._answers.popleft())
        except self._ray.exceptions.RayTaskError as exc:  # a computer of the cluster without edgeperc, say
            raise EdgepercError(f"a worker process could not start: {exc}") from exc
        except self._ray.exceptions.RayError as exc:
            if not self.has_begun:
                self._failed.append(str(exc))
            raise EOFError from exc
        self._failed.clear()
        return answer

    def died_of(self) -> Sequence[int]:
        """All its items: the answer to the first one may have been lost with the process."""
        if len(self._failed) >= MOST_DEATHS:
            raise EdgepercError(f"{MOST_DEATHS} worker processes ended before their work: {self._failed[-1]}")
        return self.numbers

    def stop(self) -> None:
        self._ray.kill(self._actor)


class _Remote:
    """What an actor's process does."""

    def start(self, start: tuple[Callable[..., Callable[[Any], Any]], tuple[Any, ...]]) -> bytes:
        """Make its function; the answer says what cannot be made."""
        make, arguments = start
        try:
            self._function = make(*arguments)
        except Exception:
            return pickle.dumps(traceback.format_exc())
        return pickle.dumps(None)

    def do(self, item: bytes) -> bytes:
        """The pickled result of a pickled item."""
        return attempt(self._function, item)


ENGINES: Mapping[str, Callable[..., Iterator[Any]]] = MappingProxyType({"local": map_in_processes, "ray": map_on_ray})
"""What maps items to results, by the value of ``--engine``."""
