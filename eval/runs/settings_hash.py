"""Text and hash of a run's settings, by which runs of the same drive are distinguished."""

import hashlib
import json
import marshal
from collections.abc import Mapping
from functools import lru_cache

from crosscue.replay.files.tree_text import json_tree


def text_and_sha256(settings: object, detectors: object, selection: object) -> tuple[str, str]:
    """Return the settings as JSON, and their hash with the detectors and the selection.

    All are JSON values. Only the names of files are hashed, without their folders, so that a drive
    replayed elsewhere yields the same hash.
    """
    # Most runs share their settings. This key is made ten times as fast as JSON.
    return _text_and_sha256(marshal.dumps([settings, detectors, selection], 2))


@lru_cache(maxsize=256)
def _text_and_sha256(made_with: bytes) -> tuple[str, str]:
    given = marshal.loads(made_with)  # noqa: S302 (our own bytes)
    plain = json.dumps(_without_places(json_tree(json.dumps(given))), sort_keys=True)
    return json.dumps(given[0], sort_keys=True), hashlib.sha256(plain.encode()).hexdigest()


def _without_places(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _without_places(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_places(one) for one in value]
    is_path = isinstance(value, str) and "/" in value and "." in value.rpartition("/")[2]
    return str(value).rpartition("/")[2] if is_path else value
