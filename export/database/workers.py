"""Makes scenes in worker processes, of this computer or of a Ray cluster."""

from __future__ import annotations

from collections.abc import Iterator

from edgeperc.system.pool import Lost
from edgeperc.system.ray_cluster import ENGINES

from ..data.roads import DatabaseError
from .scenes import Job, SceneBuilder


def run_jobs(builder: SceneBuilder, jobs: list[Job], engine: str, workers: int) -> Iterator[tuple[str, str]]:
    """Make scenes in their order; yields each name with the reason if the scene is left out, else ""."""
    # The first scene is made in this process: warnings are shown, and errors that concern all scenes stop the build.
    n_here = len(jobs) if engine == "local" and workers == 1 else 1
    for job in jobs[:n_here]:
        yield job.name, builder(job)
    rest = jobs[n_here:]
    reasons = ENGINES[engine](SceneBuilder, (builder.plan,), rest, workers=workers)
    for job, reason in zip(rest, reasons, strict=True):
        if isinstance(reason, Lost):
            raise DatabaseError(f"scene {job.name}: {reason.reason}")
        yield job.name, reason
