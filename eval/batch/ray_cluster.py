"""Joining a Ray cluster, or starting one on this machine, without Ray's own habits.

Ray reports its use to its makers, takes SIGTERM for itself and reports dead workers on stdout;
none of that is wanted here. ``local`` starts a cluster on this machine and ends it; Ray opens ports
on all of the machine's addresses, guarded by a token.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from crosscue.replay.errors import CrosscueError, UsageError, one_line

GIB: Final = 1 << 30
LOCAL: Final = "local"
WAIT_S: Final = 5.0
STORE_BYTES: Final = 96 << 20
"""Results are small; what a local cluster sets aside for them."""


@contextmanager
def joined(address: str, workers: int | None = None) -> Iterator[Any]:
    """The module ``ray``, connected; left again at the end if it was not connected before.

    Args:
        address: As Ray's clients take it (``auto``, ``10.0.0.1:6379``), or ``local``.
        workers: Cores of a local cluster; None takes all there are.

    Raises:
        UsageError: Ray is not installed.
        CrosscueError: The cluster cannot be reached or started.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise UsageError("--ray: Ray is not installed; pip install 'crosscue[ray]'") from None
    is_ours = not ray.is_initialized()
    if is_ours:
        _connect(ray, address, workers)
    try:
        yield ray
    finally:
        if is_ours:
            ray.shutdown()


def check_fits(ray: Any, address: str, cores: int, memory_bytes: int) -> None:
    """Refuse what no node can hold: Ray would wait for such a node forever.

    Raises:
        CrosscueError: Naming what a drive needs and what the largest nodes have.
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    has = [(int(one.get("CPU", 0)), int(one.get("memory", 0))) for one in nodes]
    if not any(its_cores >= cores and its_bytes >= memory_bytes for its_cores, its_bytes in has):
        max_cores = max((one for one, _ in has), default=0)
        max_bytes = max((one for _, one in has), default=0)
        raise CrosscueError(
            f"--ray {address}: a drive declares {cores} cores and {memory_bytes / GIB:.3g} GiB; no "
            f"node has both: the largest have {max_cores} cores and {max_bytes / GIB:.3g} GiB; "
            "declare less with --cores-per-drive and --memory-per-drive"
        )


def _check_reachable(address: str) -> None:
    """Refuse an address where nobody listens: Ray itself tries for many minutes.

    Raises:
        CrosscueError: Nobody listens there.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), WAIT_S).close()
    except (OSError, OverflowError) as error:
        raise CrosscueError(
            f"--ray {address}: nobody listens there ({one_line(error)}); start a cluster with ray "
            f"start, or give {LOCAL}"
        ) from None


def _connect(ray: Any, address: str, workers: int | None) -> None:
    is_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGTERM) if is_main else None
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    if address == LOCAL:
        options |= {
            "num_cpus": workers,
            "include_dashboard": False,
            "object_store_memory": STORE_BYTES,
            "_node_ip_address": "127.0.0.1",
        }
    _check_reachable(address)
    try:
        ray.init(address=address, **options)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        raise CrosscueError(
            f"--ray {address}: no cluster ({one_line(error)}); start one with ray start, or give "
            f"{LOCAL}"
        ) from None
    finally:
        if is_main:
            # Ray installs a handler of its own, which would hide a SIGTERM from the command.
            signal.signal(signal.SIGTERM, before)
    # Of workers that die Ray reports on stdout, which belongs to results; we report it ourselves.
    ray._private.worker._worker_logs_enabled = False
