"""A Ray cluster handles no signals, sends no statistics, and yields the results of one process.

One cluster on this machine serves all tests that need one: starting it takes longer than they do.
"""

import os
import signal
import socket
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from crosscue.eval.batch.jobs import exit_status_of, in_turn, run_many
from crosscue.eval.batch.ray_jobs import LOCAL, OnRay, connect_ray
from crosscue.replay.errors import CrosscueError
from support.drive_work import letters, write_jobs
from support.trees import tree

pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")
WORDS = ("plain", "dies once", "damaged", "loss", "dies", "last")


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Connect to the cluster, and disconnect at the end."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
        patch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        before = signal.getsignal(signal.SIGTERM)
        with connect_ray(LOCAL, 2) as ray:
            assert signal.getsignal(signal.SIGTERM) is before
            yield ray
        assert not ray.is_initialized()


@needs_ray
def test_missing_cluster_is_reported_in_one_line() -> None:
    with pytest.raises(CrosscueError, match="--ray no_such: no cluster") as caught:
        connect_ray("no_such").__enter__()

    assert "\n" not in str(caught.value)


@needs_ray
def test_unreachable_cluster_address_is_reported() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(CrosscueError, match=f"--ray {address}: no connection"):
        connect_ray(address).__enter__()


@pytest.mark.slow
@needs_ray
def test_cluster_is_joined_once_without_usage_statistics(cluster: Any) -> None:
    from ray._common.usage import usage_lib

    assert not usage_lib.usage_stats_enabled()
    assert cluster.cluster_resources()["CPU"] == 2.0
    with connect_ray("auto") as again:
        assert again is cluster
    assert cluster.is_initialized()


@pytest.mark.slow
@needs_ray
def test_drives_on_ray_equal_one_process_despite_dead_workers(
    cluster: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    jobs = write_jobs(tmp_path, WORDS, "ray")

    results = run_many(jobs, letters, OnRay(LOCAL, workers=2, attempts=2))

    assert [done.job for done in results] == jobs
    complete = [WORDS[i] for i, done in enumerate(results) if done.error is None]
    assert complete == ["plain", "dies once", "loss", "last"]
    assert "cut; copy it again" in str(results[2].error)
    assert "drive4: its worker died (WorkerCrashedError" in str(results[4].error)
    assert [done.attempts for done in results] == [1, 2, 1, 1, 2, 1]
    assert exit_status_of(results) == 3
    pids = {done.result.pid for done in results if done.result is not None}
    assert os.getpid() not in pids
    assert {done.result.threads for done in results if done.result is not None} == {"1"}

    here = [job for job in write_jobs(tmp_path, WORDS, "here") if job.name != "drive4"]
    run_many(here, letters, in_turn)
    there = [job for job in jobs if job.name != "drive4"]
    assert [tree(job.run) for job in there] == [tree(job.run) for job in here]
    assert all(tree(job.run) or job.name == "drive2" for job in here)
    assert capfd.readouterr().out == ""
