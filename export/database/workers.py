"""Scenes spread over processes or a Ray cluster."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict
from typing import Any

from edgeperc.errors import MissingExtraError

from ..roads import DatabaseError
from .scenes import Plan, SceneBuilder, Task

__all__ = ["run_jobs"]

# Tasks on their way to each worker: enough to keep it busy, few enough that memory stays flat.
AHEAD = 4

_builder: SceneBuilder  # of this worker process


def run_jobs(builder: SceneBuilder, tasks: list[Task], engine: str, workers: int) -> Iterator[tuple[str, str]]:
    """Make scenes in any order: their names, and why they were left out."""
    # The first is made here: it warns where scan and model do not go together, and stops what would fail everywhere.
    for task in tasks[:1]:
        yield task.name, builder(task)
    rest = tasks[1:]
    if not rest:
        return
    if engine == "ray":
        yield from _run_on_ray(builder.plan, rest, workers)
    elif workers == 1:
        yield from ((task.name, builder(task)) for task in rest)
    else:
        yield from _run_in_processes(builder.plan, rest, workers)


def _run_in_processes(plan: Plan, tasks: list[Task], workers: int) -> Iterator[tuple[str, str]]:
    # Spawned, as a fork of a process that runs an onnxruntime may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(tasks)), context, _start_worker, (plan,))
    try:
        left = iter(tasks)
        waiting: dict[Future[str], str] = {}
        while True:
            for task in left:
                waiting[pool.submit(_make_scene, task)] = task.name
                if len(waiting) >= AHEAD * workers:
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except BrokenProcessPool as exc:
        raise DatabaseError(
            f"a worker of {workers} was killed, as where memory runs out; build again to go on, with fewer --workers"
        ) from exc
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(plan: Plan) -> None:
    global _builder
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted too, and stops the workers in order
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _builder = SceneBuilder(plan)


def _die_with_parent() -> None:
    # A worker of a killed parent would wait for its next task for ever, and write until then.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _make_scene(task: Task) -> str:
    return _builder(task)


class RayWorker:
    """`SceneBuilder` as ``ray.data`` calls it: a row in, a row out, tasks as JSON for they are of uneven shape."""

    def __init__(self, plan: Plan) -> None:
        self.builder = SceneBuilder(plan)

    def __call__(self, row: dict[str, Any]) -> dict[str, Any]:
        """Make one scene."""
        task = Task(**json.loads(row["task"]))
        return {"scene": task.name, "reason": self.builder(task)}


def _run_on_ray(plan: Plan, tasks: list[Task], workers: int) -> Iterator[tuple[str, str]]:
    try:
        import ray
        import ray.data
    except ModuleNotFoundError as exc:
        raise MissingExtraError(exc.name or "ray", "ray", "--engine ray") from exc

    ours = not ray.is_initialized()
    if ours:
        cores = None if "RAY_ADDRESS" in os.environ else workers
        ray.init(num_cpus=cores, include_dashboard=False, log_to_driver=False, configure_logging=False)
    try:
        ray.data.DataContext.get_current().enable_progress_bars = False
        rows = ray.data.from_items(
            [{"task": json.dumps(asdict(task))} for task in tasks], override_num_blocks=min(len(tasks), 16 * workers)
        )
        done = rows.map(RayWorker, fn_constructor_args=(plan,), num_cpus=1, concurrency=min(workers, len(tasks)))
        for row in done.iter_rows():
            yield str(row["scene"]), str(row["reason"])
    finally:
        if ours:
            ray.shutdown()
