"""A hash of what a run was made with, by which runs of the same drive are told apart."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import lru_cache

from crosscue.replay.base import json_tree


def settings_sha256(settings: object, detectors: object, selection: object) -> str:
    """Of JSON values: the settings, the detectors, and the part of the logs.

    Files count by their names alone: the same drive replayed in another place is the same run.
    """
    return _sha256_of(json.dumps([settings, detectors, selection], sort_keys=True))


@lru_cache(maxsize=256)
def _sha256_of(made_with: str) -> str:
    """Of many runs few differ in what they were made with."""
    plain = _without_places(json_tree(made_with))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _without_places(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _without_places(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_places(one) for one in value]
    is_path = isinstance(value, str) and "/" in value and "." in value.rpartition("/")[2]
    return str(value).rpartition("/")[2] if is_path else value
