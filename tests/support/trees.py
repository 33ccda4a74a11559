"""Folders as plain values, to hold two against each other."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

NO_RESULTS = {".drives", "failure.log"}
"""Where and when drives were worked on."""


def tree(folder: Path) -> dict[str, str]:
    """From relative name to a hash of the bytes; of a manifest without timings and logs' places."""
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
