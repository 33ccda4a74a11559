"""Where many drives are worked on: processes of this machine, or a Ray cluster."""

from __future__ import annotations

from crosscue.eval.batch.jobs import Engine
from crosscue.eval.batch.processes import Processes
from crosscue.replay.errors import UsageError


def engine_of(workers: int | None, ray: str | None) -> Engine:
    """Where many drives are worked on.

    Raises:
        UsageError: Too few workers.
    """
    if workers is not None and workers < 1:
        raise UsageError(f"--workers {workers}: expected 1 or more")
    if ray is not None:
        from crosscue.eval.batch.ray_jobs import OnRay

        return OnRay(ray, workers)
    return Processes(workers or 1)
