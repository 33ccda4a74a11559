"""Run a command in a separate process and measure its peak memory.

The processes are forked from one that has imported what ``info`` needs, which takes longer than
most of these commands.
"""

import json
import os
import subprocess
import sys
from functools import cache
from tempfile import NamedTemporaryFile
from typing import Final

# The child reads its peak itself, because ``getrusage`` of a child includes its parent's peak.
_SERVER: Final = """
import json, os, resource, sys
from pathlib import Path
from crosscue.eval.cli import run
import crosscue.eval.logs.summary

for line in sys.stdin:
    argv, cpu_s, output = json.loads(line)
    child = os.fork()
    if not child:
        place = os.open(output, os.O_WRONLY)
        os.dup2(place, 1), os.dup2(place, 2)
        if cpu_s is not None:
            resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s))
        status = run(argv)
        lines = Path("/proc/self/status").read_text().splitlines()
        peak = next(line for line in lines if "VmHWM" in line)
        print(status, int(peak.split()[1]) // 1024, flush=True)
        os._exit(0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


@cache
def _server() -> subprocess.Popen[str]:
    """Start the process that forks; it ends with this one, which closes its input."""
    return subprocess.Popen(
        [sys.executable, "-c", _SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )


def measured(argv: list[str], cpu_s: int | None = None) -> tuple[int, str, float]:
    """Return the exit status, the output on one line, and the peak memory in MB.

    Raises:
        CalledProcessError: The command failed, or took more than ``cpu_s`` seconds of a processor.
    """
    server = _server()
    assert server.stdin is not None
    assert server.stdout is not None
    with NamedTemporaryFile("r") as printed:
        server.stdin.write(json.dumps([argv, cpu_s, printed.name]) + "\n")
        server.stdin.flush()
        ended = int(server.stdout.readline())
        output = printed.read()
    if ended:
        raise subprocess.CalledProcessError(ended, argv, output)
    *words, status, peak_mb = output.split()
    return int(status), " ".join(words), int(peak_mb)
