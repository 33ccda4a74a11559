"""Text and hash of a run's settings, by which runs of the same drive are distinguished."""

from __future__ import annotations

import hashlib
import json
import marshal
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Final, ParamSpec

from crosscue.replay.files.tree_text import json_tree

P = ParamSpec("P")
# Number of results that are kept of each function.
KEPT: Final = 256


def _kept(make: Callable[P, str]) -> Callable[P, str]:
    """Keep the results of a function of JSON values, because most runs share their settings.

    The keys are made ten times as fast as JSON, and they are only compared.
    """
    found: dict[bytes, str] = {}

    @wraps(make)
    def cached(*values: P.args, **named: P.kwargs) -> str:
        key = marshal.dumps([*values, *named.items()], 2)
        if key not in found:
            if len(found) >= KEPT:
                found.clear()
            found[key] = make(*values, **named)
        return found[key]

    return cached


@_kept
def settings_text(settings: object) -> str:
    """Return the settings as JSON."""
    return json.dumps(settings, sort_keys=True)


@_kept
def settings_sha256(settings: object, detectors: object, selection: object) -> str:
    """Return the hash of the settings, the detectors and the selection, all as JSON values.

    Only the names of files are hashed, without their folders, so that a drive replayed elsewhere
    yields the same hash.
    """
    made_with = json.dumps([settings, detectors, selection], sort_keys=True)
    plain = _without_places(json_tree(made_with))
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def _without_places(value: object) -> object:
    if isinstance(value, Mapping):
        return {name: _without_places(one) for name, one in value.items()}
    if isinstance(value, list):
        return [_without_places(one) for one in value]
    is_path = isinstance(value, str) and "/" in value and "." in value.rpartition("/")[2]
    return str(value).rpartition("/")[2] if is_path else value
