"""Files, and contents of folders as values that can be compared."""

import hashlib
import json
from pathlib import Path

from crosscue.eval.runs.folder import TIMINGS

# Files that depend on the time and place of processing.
NO_RESULTS = {".drives", "failure.log", TIMINGS}


def written(path: Path, content: str | bytes | bytearray) -> Path:
    """Write a file, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    """Return the content of each file below a folder by its relative name."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def tree(folder: Path) -> dict[str, str]:
    """Map relative names to hashes, without the paths of logs, which depend on the run's place."""
    return {
        path.relative_to(folder).as_posix(): _hash(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not NO_RESULTS & {*path.relative_to(folder).parts}
    }


def _hash(path: Path) -> str:
    content = path.read_bytes()
    if path.name == "manifest.json":
        content = json.dumps(_without_paths(json.loads(content)), sort_keys=True).encode()
    return hashlib.sha256(content).hexdigest()


def _without_paths(value: object) -> object:
    if isinstance(value, dict):
        return {k: _without_paths(v) for k, v in value.items() if k != "path"}
    return [_without_paths(one) for one in value] if isinstance(value, list) else value
