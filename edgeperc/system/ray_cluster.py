"""Map items to results in worker processes, on this computer or on a Ray cluster (``--engine``, ``--workers``)."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

from .extras import require
from .pool import DIED, MOST_DEATHS, Lost, attempt, map_in_processes

# Items of a block, the unit that a worker is given. Few, because all are done again if its process dies. Many, because
# the driver keeps some kilobytes for each block.
MOST_IN_BLOCK = 16
# A local cluster's memory for items and results in transit; Ray's own default is 30 % of the computer's.
STORE_BYTES = 256 * 2**20


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
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # else Ray warns about a future default
    ray = require("ray", "ray", "--engine ray")
    data = require("ray.data", "ray", "--engine ray", package="ray[data]")
    logging.getLogger("ray.data").setLevel(logging.ERROR)  # the rest is in Ray's log files
    started = not ray.is_initialized()
    if started:
        local: dict[str, Any] = {}
        if "RAY_ADDRESS" not in os.environ:
            local = {"num_cpus": (workers or os.cpu_count() or 1) * n_threads, "object_store_memory": STORE_BYTES}
        with signals_kept():
            ray.init(**local, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        context = data.DataContext.get_current()
        context.enable_progress_bars = False
        context.execution_options.preserve_order = True
        n_workers = workers or max(1, int(ray.cluster_resources().get("CPU", 1)) // n_threads)
        n_blocks = max(min(len(items), 4 * n_workers), -(-len(items) // MOST_IN_BLOCK))
        rows = [{"number": k, "item": pickle.dumps(item)} for k, item in enumerate(items)]
        # A process that dies, or whose computer is taken away, is replaced, and its block is done again.
        done = data.from_items(rows, override_num_blocks=n_blocks).map_batches(
            _Worker,
            fn_constructor_args=(make, arguments, ray.remote(_Deaths).options(num_cpus=0).remote()),
            compute=data.ActorPoolStrategy(size=min(n_workers, n_blocks)),
            num_cpus=n_threads,
        )
        for row in done.iter_rows():
            yield pickle.loads(row["result"])
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


class _Deaths:
    """How often the process of an item died, for all workers."""

    def __init__(self) -> None:
        self._begun: Counter[int] = Counter()

    def begin(self, number: int) -> int:
        """Note that a process begins with an item; returns how often one died of it."""
        self._begun[number] += 1
        return self._begun[number] - 1

    def end(self, number: int) -> None:
        """Note that it is done."""
        self._begun[number] -= 1


class _Worker:
    """The function of a worker process for Ray Data, which maps columns to columns."""

    def __init__(self, make: Callable[..., Callable[[Any], Any]], arguments: tuple[Any, ...], deaths: Any) -> None:
        self._ray = require("ray", "ray", "--engine ray")
        self._function, self._deaths = make(*arguments), deaths

    def __call__(self, batch: dict[str, Any]) -> Iterator[dict[str, list[Any]]]:
        """Map a block, item by item."""
        for number, item in zip(batch["number"].tolist(), batch["item"], strict=True):
            may_run = self._ray.get(self._deaths.begin.remote(number)) < MOST_DEATHS
            result = attempt(self._function, item) if may_run else pickle.dumps(Lost(DIED))
            self._deaths.end.remote(number)
            yield {"result": [result]}


ENGINES: Mapping[str, Callable[..., Iterator[Any]]] = MappingProxyType({"local": map_in_processes, "ray": map_on_ray})
"""What maps items to results, by the value of ``--engine``."""
