"""Where many drives are worked on: processes of this machine, or a Ray cluster."""

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
    """Where many drives are worked on.

    Args:
        workers: Drives side by side.
        ray: Address of a cluster.
        cores: Of each drive on the cluster; one if left out.
        memory_gib: Of each drive on the cluster; two if left out.

    Raises:
        UsageError: Too few of any, or cores and memory without a cluster.
    """
    if ray is None and (cores is not None or memory_gib is not None):
        raise UsageError("--cores-per-drive, --memory-per-drive: for --ray; give its address")
    if (cores is not None and cores < 1) or (memory_gib is not None and not memory_gib > 0.0):
        raise UsageError(
            f"--cores-per-drive {cores}, --memory-per-drive {memory_gib}: expected 1 core or more "
            "and GiB above 0"
        )
    if workers is not None and workers < 1:
        raise UsageError(f"--workers {workers}: expected 1 or more")
    if ray is not None:
        from crosscue.eval.batch.ray_jobs import MEMORY_BYTES, OnRay

        memory_bytes = MEMORY_BYTES if memory_gib is None else int(memory_gib * (1 << 30))
        return OnRay(ray, workers, cores=cores or 1, memory_bytes=memory_bytes)
    return Processes(workers or 1)
