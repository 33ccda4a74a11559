"""Hash of a run's settings, by which runs of the same drive are distinguished."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache

from crosscue.replay.files.tree_text import json_tree


def settings_sha256(settings: object, detectors: object, selection: object) -> str:
    """Return the hash of the settings, the detectors and the selection, all as JSON values.

    Only the names of files are hashed, without their folders, so that a drive replayed elsewhere
    yields the same hash.
    """
    return _sha256_of(json.dumps([settings, detectors, selection], sort_keys=True))


@lru_cache(maxsize=256)
def _sha256_of(made_with: str) -> str:
    """Return the SHA-256 of a text, cached because most runs share their settings."""
    plain = _without_places(json_tree(made_with))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _without_places(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _without_places(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_places(one) for one in value]
    is_path = isinstance(value, str) and "/" in value and "." in value.rpartition("/")[2]
    return str(value).rpartition("/")[2] if is_path else value
