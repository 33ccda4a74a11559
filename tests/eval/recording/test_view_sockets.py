"""The viewer in a browser: it listens on this machine only, and ends with the command."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from crosscue.datasets.simulated.drive import DriveSettings
from crosscue.datasets.simulated.log_files import write_drive
from crosscue.eval import cli

LISTENING = "0A"
PORTS = (9090, 9876)


def _processes_of_session(leader: int) -> list[int]:
    """Return the processes of a session, also those whose parent has ended."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            fields = place.joinpath("stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == leader and fields[0] != "Z":
            found.append(int(place.name))
    return found


def _listening_sockets(pids: list[int]) -> Iterator[tuple[str, int]]:
    """Yield address, in the kernel's notation, and port of each listening socket."""
    sockets = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                sockets.add(os.readlink(link))  # noqa: PTH115
            except OSError:
                continue
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and f"socket:[{fields[9]}]" in sockets:
                address, _, port = fields[1].partition(":")
                yield address, int(port, 16)


def _are_free(ports: tuple[int, ...]) -> bool:
    for port in ports:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return False
    return True


@pytest.mark.slow
@pytest.mark.skipif(not _are_free(PORTS), reason="another viewer is open on this machine")
def test_web_viewer_listens_on_loopback_only_and_ends_with_the_command(tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive", DriveSettings(seed=1, blocks=2))
    run = tmp_path / "run"
    replay = ["replay", str(drive.log), "--vehicle", str(drive.vehicle), "-o", str(run), "-q"]
    assert cli.run(replay) == 0
    code = "from crosscue.eval.cli import main; main()"
    view = subprocess.Popen(
        [sys.executable, "-c", code, "view", str(run), "--web"],
        env={**os.environ, "BROWSER": "true"},
        start_new_session=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        listening: set[tuple[str, int]] = set()
        end = time.monotonic() + 40.0
        while len(listening) < len(PORTS) and time.monotonic() < end and view.poll() is None:
            time.sleep(0.1)
            listening = set(_listening_sockets(_processes_of_session(view.pid)))
        assert {port for _, port in listening} == set(PORTS)
        assert {address for address, _ in listening} == {"0100007F"}

        view.send_signal(signal.SIGTERM)
        assert view.wait(20) == 143
        end = time.monotonic() + 10.0
        while _processes_of_session(view.pid) and time.monotonic() < end:
            time.sleep(0.05)
        assert _processes_of_session(view.pid) == []
    finally:
        for pid in _processes_of_session(view.pid):
            os.kill(pid, signal.SIGKILL)
        view.wait()
