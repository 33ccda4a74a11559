"""Run a command in a separate process and measure its peak memory."""

import os
import subprocess
import sys

# The child reads its peak itself, because ``getrusage`` of a child includes its parent's peak.
_CHILD = """
import sys
from pathlib import Path
from crosscue.eval.cli import run
status = run(sys.argv[1:])
peak = next(x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x)
print(status, int(peak.split()[1]) // 1024)
"""


def measured(argv: list[str], cpu_s: int | None = None) -> tuple[int, str, float]:
    """Return the exit status, the output on one line, and the peak memory in MB.

    Raises:
        CalledProcessError: The command failed, or took more than ``cpu_s`` seconds of a processor.
    """
    limit = ""
    if cpu_s is not None:
        limit = f"import resource\nresource.setrlimit(resource.RLIMIT_CPU, ({cpu_s}, {cpu_s}))"
    child = subprocess.run(
        [sys.executable, "-c", limit + _CHILD, *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
    )
    *output, status, peak_mb = child.stdout.split()
    return int(status), " ".join(output), int(peak_mb)
