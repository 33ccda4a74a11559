"""What a result was made of: its inputs by identity, its settings by value.

Whatever goes on with a result, or replaces it, asks here first: another input or other settings
would mix two things or destroy one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from crosscue.replay.base import UsageError, json_tree, strict_json
from crosscue.replay.files.log_identity import as_row, of_row

from .identity import identity_of, identity_of_all

SIMULATED: Final = "simulated.json"
"""What `simulate` writes beside its log: the mark of a simulated log, and what it is made of."""
NOTHING: Final[Mapping[str, Any]] = {}
"""Of a result that need not be told from others."""


def made_of(inputs: Sequence[Path], settings: Mapping[str, object]) -> dict[str, Any]:
    """For a file beside the result: equal for equal inputs and settings, wherever they are.

    Raises:
        LogError: An input is not there or cannot be read.
    """
    identity = as_row(identity_of_all([identity_of(path) for path in inputs])) if inputs else None
    made: dict[str, Any] = json_tree(strict_json({"identity": identity, "settings": settings}))
    return made


def refuse_another(place: Path, doing: str, there: object, mine: Mapping[str, Any]) -> None:
    """Let ``doing`` go on only over what is made of the very same.

    Args:
        place: Where the result lies.
        doing: The flag, for the error.
        there: What ``made_of`` returned for the result; anything else is nothing that is known.
        mine: What ``made_of`` returns now.

    Raises:
        UsageError: Naming both.
    """
    if there == mine:
        return
    try:
        assert isinstance(there, Mapping)
        theirs, settings = _name(there), there["settings"]
    except (AssertionError, KeyError, TypeError):
        raise UsageError(
            f"{place}: nothing says what it is made of; {doing} would destroy it: give another name"
        ) from None
    ours = _name(mine)
    other = difference(settings, mine["settings"])
    but = "" if other is None else f" ({other})"
    raise UsageError(
        f"{place}: is made of {theirs}, not of {ours}{but}; {doing} would destroy it: give another "
        "name, or the same input and settings"
    )


def _name(made: Mapping[str, Any]) -> str:
    return "settings" if made["identity"] is None else str(of_row(made["identity"]))


def difference(there: object, here: object, name: str = "") -> str | None:
    """The first setting that is not the same, with both values."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted({*there, *here}):
            found = difference(there.get(key), here.get(key), f"{name}.{key}" if name else key)
            if found is not None:
                return found
        return None
    return None if there == here else f"{name}: {_short(there)} there, {_short(here)} here"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
