"""Choice of the engine that processes many drives: local worker processes or a Ray cluster."""

from __future__ import annotations

from crosscue.eval.batch.jobs import Engine
from crosscue.eval.batch.processes import Processes
from crosscue.replay.errors import UsageError


def engine_of(
    workers: int | None,
    ray: str | None,
    cores: int | None = None,
    memory_gib: float | None = None,
) -> Engine:
    """Return the engine that the options of a command select.

    Args:
        workers: Number of drives processed in parallel.
        ray: Address of a Ray cluster; None selects local processes.
        cores: Cores of each drive on the cluster; default 1.
        memory_gib: Memory of each drive on the cluster; default 2.

    Raises:
        UsageError: A number is too small, or cores or memory are set without a cluster.
    """
    if ray is None and (cores is not None or memory_gib is not None):
        raise UsageError(
            "cores_per_drive, memory_per_drive_gib: need a cluster; name its address with ray"
        )
    if (cores is not None and cores < 1) or (memory_gib is not None and not memory_gib > 0.0):
        raise UsageError(
            f"cores_per_drive, memory_per_drive_gib: {cores} and {memory_gib}; expected 1 core or "
            "more and GiB above 0"
        )
    if workers is not None and workers < 1:
        raise UsageError(f"workers: {workers}, expected 1 or more")
    if ray is not None:
        from crosscue.eval.batch.ray_jobs import MEMORY_BYTES, OnRay

        memory_bytes = MEMORY_BYTES if memory_gib is None else int(memory_gib * (1 << 30))
        return OnRay(ray, workers, cores=cores or 1, memory_bytes=memory_bytes)
    return Processes(workers or 1)
