"""Text and hash of a run's settings, by which runs of the same drive are distinguished."""

from __future__ import annotations

import hashlib
import json
import marshal
from collections.abc import Mapping
from typing import Final

from crosscue.replay.files.tree_text import json_tree

# Number of results that are kept, because most runs share their settings.
KEPT: Final = 256
# Results by a key that is made ten times as fast as JSON, and only compared.
_kept: Final[dict[bytes, tuple[str, str]]] = {}


def text_and_sha256(settings: object, detectors: object, selection: object) -> tuple[str, str]:
    """Return the settings as JSON, and their hash with the detectors and the selection.

    All are JSON values. Only the names of files are hashed, without their folders, so that a drive
    replayed elsewhere yields the same hash.
    """
    key = marshal.dumps([settings, detectors, selection], 2)
    if key not in _kept:
        if len(_kept) >= KEPT:
            _kept.clear()
        made_with = json.dumps([settings, detectors, selection], sort_keys=True)
        plain = json.dumps(_without_places(json_tree(made_with)), sort_keys=True)
        text = json.dumps(settings, sort_keys=True)
        _kept[key] = text, hashlib.sha256(plain.encode()).hexdigest()
    return _kept[key]


def _without_places(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _without_places(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_places(one) for one in value]
    is_path = isinstance(value, str) and "/" in value and "." in value.rpartition("/")[2]
    return str(value).rpartition("/")[2] if is_path else value
