"""Many drives on a Ray cluster on this machine, a worker killed midway."""

import os
from importlib.util import find_spec
from pathlib import Path

import pytest

from crosscue.eval.batch.jobs import exit_status_of, in_turn, run_many
from crosscue.eval.batch.ray_jobs import OnRay
from support.drive_work import letters, made_jobs
from support.trees import tree

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")
WORDS = ("plain", "dies once", "damaged", "loss", "dies", "last")


@pytest.mark.slow
@needs_ray
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_cluster_does_what_one_process_does_though_workers_die(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    jobs = made_jobs(tmp_path, WORDS, "ray")

    results = run_many(jobs, letters, OnRay("local", workers=2, attempts=2))

    assert [done.job for done in results] == jobs
    whole = [WORDS[i] for i, done in enumerate(results) if done.error is None]
    assert whole == ["plain", "dies once", "loss", "last"]
    assert "cut; copy it again" in str(results[2].error)
    assert "drive4: its worker died (WorkerCrashedError" in str(results[4].error)
    assert [done.attempts for done in results] == [1, 2, 1, 1, 2, 1]
    assert exit_status_of(results) == 3
    pids = {done.result.pid for done in results if done.result is not None}
    assert os.getpid() not in pids
    assert {done.result.threads for done in results if done.result is not None} == {"1"}

    here = [job for job in made_jobs(tmp_path, WORDS, "here") if job.name != "drive4"]
    run_many(here, letters, in_turn)
    there = [job for job in jobs if job.name != "drive4"]
    assert [tree(job.run) for job in there] == [tree(job.run) for job in here]
    assert all(tree(job.run) or job.name == "drive2" for job in here)
    assert capfd.readouterr().out == ""
