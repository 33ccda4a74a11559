"""Inputs and settings of a result: its inputs by identity, its settings by value.

Code that continues or replaces a result compares these first, because other inputs or settings
would mix two results or destroy one.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from crosscue.replay.errors import UsageError
from crosscue.replay.files.log_identity import as_row, of_row

from .identity import identity_of_all, log_identity
from .tree_text import json_tree, strict_json

# File that `simulate` writes next to a log: it marks the log as simulated, with its settings.
SIMULATED: Final = "simulated.json"
# Inputs and settings of a result that need not be distinguished from others.
NOTHING: Final[Mapping[str, Any]] = {}


def made_of(inputs: Sequence[Path], settings: Mapping[str, object]) -> dict[str, Any]:
    """Return a record of inputs and settings, which does not depend on the inputs' paths.

    Raises:
        LogError: An input does not exist or cannot be read.
    """
    identity = as_row(identity_of_all([log_identity(path) for path in inputs])) if inputs else None
    made: dict[str, Any] = json_tree(strict_json({"identity": identity, "settings": settings}))
    return made


def refuse_another(place: Path, doing: str, there: object, mine: Mapping[str, Any]) -> None:
    """Refuse to continue or replace a result of other inputs or settings.

    Args:
        place: Path of the result.
        doing: The command-line option, for the error.
        there: Value of ``made_of`` for the result; any other value counts as unknown.
        mine: Value of ``made_of`` for the current inputs and settings.

    Raises:
        UsageError: The two differ; the message names both.
    """
    if there == mine:
        return
    try:
        assert isinstance(there, Mapping)
        theirs, settings = _name(there), there["settings"]
    except (AssertionError, KeyError, TypeError):
        raise UsageError(
            f"{place}: its inputs are not recorded; {doing} would destroy it; choose another name"
        ) from None
    ours = _name(mine)
    other = first_difference(settings, mine["settings"])
    but = "" if other is None else f" ({other})"
    raise UsageError(
        f"{place}: was made from {theirs}, not from {ours}{but}; {doing} would destroy it; choose "
        "another name, or the same input and settings"
    )


def _name(made: Mapping[str, Any]) -> str:
    return "settings" if made["identity"] is None else str(of_row(made["identity"]))


def first_difference(there: object, here: object, name: str = "") -> str | None:
    """Describe the first setting that differs, with both values; None if all are equal."""
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted({*there, *here}):
            found = first_difference(
                there.get(key), here.get(key), f"{name}.{key}" if name else key
            )
            if found is not None:
                return found
        return None
    return None if there == here else f"{name}: {_short(there)} there, {_short(here)} here"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
