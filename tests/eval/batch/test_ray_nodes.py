"""A Ray cluster of two nodes on this machine, one of which is lost while drives run on both."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from crosscue.eval.batch.jobs import JobOutcome, in_turn, run_many
from crosscue.eval.batch.ray_jobs import OnRay
from crosscue.replay.errors import CrosscueError
from support.drive_work import Letters, letters, write_jobs
from support.trees import tree

MIB = 1 << 20
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without cores and two nodes of one core, shut down after the test."""
    for name, value in {
        "PYTHONPATH": os.pathsep.join(sys.path),
        "RAY_USAGE_STATS_ENABLED": "0",
        "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
        "RAY_health_check_initial_delay_ms": "0",
        "RAY_health_check_period_ms": "500",
        "RAY_health_check_failure_threshold": "4",
    }.items():
        monkeypatch.setenv(name, value)
    from ray.cluster_utils import Cluster

    found: Any = Cluster(
        initialize_head=True,
        head_node_args={"num_cpus": 0, "include_dashboard": False, "object_store_memory": 80 * MIB},
    )
    try:
        for _ in range(2):
            found.add_node(num_cpus=1, memory=1024 * MIB, object_store_memory=80 * MIB)
        found.wait_for_nodes()
        yield found
    finally:
        found.shutdown()


def test_lost_node_repeats_only_its_running_drives(cluster: Any, tmp_path: Path) -> None:
    words = ["plain", "waits once", "loss", "waits once", "last"]
    jobs = write_jobs(tmp_path, words, "ray")
    engine = OnRay(cluster.address, memory_bytes=512 * MIB)
    begun = [tmp_path / f"drive{i}.begun" for i in (1, 3)]
    lost = ""

    found: dict[str, JobOutcome[Letters]] = {}
    end = time.monotonic() + 150.0
    for done in engine(jobs, letters):
        assert time.monotonic() < end, found
        if done is not None:
            found[done.job.name] = done
        names = [path.read_text() for path in begun if path.exists()]
        if not lost and any(names):
            # The node of a waiting drive is lost; drives on the other node continue.
            lost = next(filter(None, names))
            (node,) = [one for one in cluster.worker_nodes if one.node_id == lost]
            cluster.remove_node(node, allow_graceful=False)
            for path in begun:
                path.with_suffix(".go").touch()

    assert lost
    assert [found[job.name].error for job in jobs] == [None] * 5
    attempts = [found[job.name].attempts for job in jobs]
    # Drives that ran on it were started twice, all others once.
    assert [attempts[i] for i in (0, 2, 4)].count(1) >= 2
    assert sum(attempts) == 6
    here = write_jobs(tmp_path, words, "here")
    run_many(here, letters, in_turn)
    assert [tree(job.run) for job in jobs] == [tree(job.run) for job in here]

    with pytest.raises(
        CrosscueError, match=r"a drive declares 1 cores and 4 GiB; no node has both"
    ):
        next(OnRay(cluster.address, memory_bytes=4096 * MIB)(jobs, letters))
