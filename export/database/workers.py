"""Makes scenes in parallel, in processes or on a Ray cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

from edgeperc.system.ray_cluster import Lost, map_on_ray

from ..data.roads import DatabaseError
from .scenes import Job, Plan, SceneBuilder

# Jobs queued for each worker: enough to keep it busy, few enough that memory use stays constant.
AHEAD = 4

_builder: SceneBuilder  # of this worker process


def run_jobs(builder: SceneBuilder, jobs: list[Job], engine: str, workers: int) -> Iterator[tuple[str, str]]:
    """Make scenes, in any order; yields each name with the reason if the scene is left out, else ""."""
    # The first scene is made in this process: warnings are shown, and errors that concern all scenes stop the build.
    for job in jobs[:1]:
        yield job.name, builder(job)
    rest = jobs[1:]
    if not rest:
        return
    if engine == "ray":
        yield from _run_on_ray(builder.plan, rest, workers)
    elif workers == 1:
        yield from ((job.name, builder(job)) for job in rest)
    else:
        yield from _run_in_processes(builder.plan, rest, workers)


def _run_in_processes(plan: Plan, jobs: list[Job], workers: int) -> Iterator[tuple[str, str]]:
    # Processes are spawned, because a fork of a process that runs onnxruntime may hang.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(workers, len(jobs)), context, _start_worker, (plan,))
    try:
        left = iter(jobs)
        waiting: dict[Future[str], str] = {}
        while True:
            for job in left:
                waiting[pool.submit(_make_scene, job)] = job.name
                if len(waiting) >= AHEAD * workers:
                    break
            if not waiting:
                return
            for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                yield waiting.pop(future), future.result()
    except BrokenProcessPool as exc:
        raise DatabaseError(
            f"one of {workers} workers was killed, perhaps for lack of memory; resume with fewer --workers"
        ) from exc
    finally:
        pool.shutdown(cancel_futures=True)


def _start_worker(plan: Plan) -> None:
    global _builder
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is interrupted too, and stops the workers
    threading.Thread(target=_die_with_parent, daemon=True).start()
    _builder = SceneBuilder(plan)


def _die_with_parent() -> None:
    # Otherwise, after its parent is killed, a worker would finish its jobs and then wait forever.
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _make_scene(job: Job) -> str:
    return _builder(job)


def _run_on_ray(plan: Plan, jobs: list[Job], workers: int) -> Iterator[tuple[str, str]]:
    for job, reason in zip(jobs, map_on_ray(SceneBuilder, (plan,), jobs, workers=min(workers, len(jobs))), strict=True):
        if isinstance(reason, Lost):
            raise DatabaseError(f"scene {job.name}: {reason.reason}")
        yield job.name, reason
