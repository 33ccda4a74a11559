"""Run commands of crosscue, and Python in a process of its own."""

import io
import json
import os
import subprocess
import sys
from contextlib import redirect_stdout
from typing import Any

from crosscue.eval import cli


def output_of(*words: object, status: int = 0) -> str:
    """Run a command that has to end with an exit status, and return what it prints."""
    out = io.StringIO()
    with redirect_stdout(out):
        ended = cli.run([str(word) for word in words])
    assert ended == status
    return out.getvalue()


def json_of(*words: object, status: int = 0) -> Any:
    """Run a command with ``--json``, and return what it prints."""
    return json.loads(output_of(*words, "--json", status=status))


def python(code: str, *words: object, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run code with arguments, which imports what this process can, by ``subprocess.run``."""
    settings: dict[str, Any] = {"timeout": 120, "capture_output": True, "text": True, **more}
    path = os.pathsep.join(filter(None, sys.path))
    settings["env"] = {**(settings.get("env") or os.environ), "PYTHONPATH": path}
    return subprocess.run([sys.executable, "-c", code, *map(str, words)], check=False, **settings)
