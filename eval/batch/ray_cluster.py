"""Connection to a Ray cluster, or a local cluster, without unwanted defaults of Ray.

By default Ray sends usage statistics, handles SIGTERM itself and reports dead workers on stdout;
all three are turned off. ``local`` starts a cluster on this machine and stops it at the end; Ray
opens ports on all of the machine's addresses, protected by a token.
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
# Size of a local cluster's object store; results are small.
STORE_BYTES: Final = 96 << 20


@contextmanager
def connect_ray(address: str, workers: int | None = None) -> Iterator[Any]:
    """Yield the module ``ray``, connected; disconnect at the end unless it was connected before.

    Args:
        address: An address of Ray's clients (``auto``, ``10.0.0.1:6379``), or ``local``.
        workers: Cores of a local cluster; None uses all cores.

    Raises:
        UsageError: Ray is not installed.
        CrosscueError: The cluster cannot be reached or started.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError:
        raise UsageError("--ray: Ray is not installed; pip install ray") from None
    is_ours = not ray.is_initialized()
    if is_ours:
        _connect(ray, address, workers)
    try:
        yield ray
    finally:
        if is_ours:
            ray.shutdown()


def check_fits(ray: Any, address: str, cores: int, memory_bytes: int) -> None:
    """Refuse requirements that no node meets, because Ray would wait for such a node indefinitely.

    Raises:
        CrosscueError: No node is large enough; states the needs of a drive and the largest nodes.
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
    """Refuse an address that accepts no connection, because Ray itself retries for minutes.

    Raises:
        CrosscueError: The address accepts no connection.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), WAIT_S).close()
    except (OSError, OverflowError) as error:
        raise CrosscueError(
            f"--ray {address}: no connection ({one_line(error)}); start a cluster with ray start, "
            f"or use {LOCAL}"
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
            f"--ray {address}: no cluster ({one_line(error)}); start one with ray start, or use "
            f"{LOCAL}"
        ) from None
    finally:
        if is_main:
            # Ray installs its own handler, which would hide SIGTERM from the command.
            signal.signal(signal.SIGTERM, before)
    # Ray reports dead workers on stdout, which is reserved for results; we report them ourselves.
    ray._private.worker._worker_logs_enabled = False
