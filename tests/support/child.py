"""Python code in another process."""

import os
import subprocess
import sys
from typing import Any


def python(code: str, *words: object, **more: Any) -> subprocess.CompletedProcess[str]:
    """Run code with arguments, which imports what this process can, by ``subprocess.run``."""
    settings: dict[str, Any] = {"timeout": 120, "capture_output": True, "text": True, **more}
    path = os.pathsep.join(filter(None, sys.path))
    settings["env"] = {**(settings.get("env") or os.environ), "PYTHONPATH": path}
    return subprocess.run([sys.executable, "-c", code, *map(str, words)], check=False, **settings)
