"""Joining a Ray cluster takes nothing over and reports nobody."""

import signal
import socket
import sys
from importlib.util import find_spec

import pytest

from crosscue.eval.batch.ray_cluster import LOCAL, joined
from crosscue.replay.base import CrosscueError, UsageError

needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")


@pytest.mark.slow
@needs_ray
@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_ray_neither_reports_its_use_nor_takes_sigterm_and_is_left(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("RAY_USAGE_STATS_ENABLED", raising=False)
    monkeypatch.setenv("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    before = signal.getsignal(signal.SIGTERM)

    with joined(LOCAL, 1) as ray:
        from ray._common.usage import usage_lib

        assert not usage_lib.usage_stats_enabled()
        assert ray.cluster_resources()["CPU"] == 1.0
        assert signal.getsignal(signal.SIGTERM) is before
        with joined("auto") as again:
            assert again is ray
        assert ray.is_initialized()

    assert not ray.is_initialized()


@needs_ray
def test_a_cluster_that_is_not_there_is_one_line() -> None:
    with pytest.raises(CrosscueError, match="--ray no_such: no cluster") as caught:
        joined("no_such").__enter__()

    assert "\n" not in str(caught.value)


@needs_ray
def test_an_address_where_nobody_listens_is_reported_at_once() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(CrosscueError, match=f"--ray {address}: nobody listens there"):
        joined(address).__enter__()


def test_without_ray_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)

    with pytest.raises(UsageError, match=r"pip install 'crosscue\[ray\]'"), joined(LOCAL):
        pass
