"""Contents of folders as values that can be compared."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

NO_RESULTS = {".drives", "failure.log"}
"""Files that depend on the time and place of processing."""


def tree(folder: Path) -> dict[str, str]:
    """Map relative names to hashes; manifests are hashed without timings and paths of logs."""
    return {
        path.relative_to(folder).as_posix(): _hash(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not NO_RESULTS & {*path.relative_to(folder).parts}
    }


def _hash(path: Path) -> str:
    content = path.read_bytes()
    if path.name == "manifest.json":
        content = json.dumps(_without_timings(json.loads(content)), sort_keys=True).encode()
    return hashlib.sha256(content).hexdigest()


def _without_timings(value: object) -> object:
    if isinstance(value, dict):
        return {k: _without_timings(v) for k, v in value.items() if k not in ("timings", "path")}
    return [_without_timings(one) for one in value] if isinstance(value, list) else value
