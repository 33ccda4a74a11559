"""The catalog: known models, one card each in ``models``, and where their weights are kept.

Weights of others are never in this repository. ``crosscue model fetch`` puts them below the cache
folder (``$CROSSCUE_MODELS``, else the user's cache), under their hash, so that two versions of a
model lie side by side.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final

from crosscue.replay.errors import UsageError

FOLDER: Final = Path(__file__).parent / "models"
VARIABLE: Final = "CROSSCUE_MODELS"


def cache_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where fetched weights are kept.

    Raises:
        UsageError: No such place can be named: the machine has no home folder.
    """
    asked = environment.get(VARIABLE)
    return Path(asked) if asked else user_cache(VARIABLE, environment) / "models"


def user_cache(variable: str, environment: Mapping[str, str] = os.environ) -> Path:
    """The user's cache folder of crosscue.

    Args:
        variable: That names another place, for errors.
        environment: For ``$XDG_CACHE_HOME``.

    Raises:
        UsageError: No such place can be named: the machine has no home folder.
    """
    base = Path(environment.get("XDG_CACHE_HOME", ""))
    try:
        base = base if base.is_absolute() else Path.home() / ".cache"
    except RuntimeError:
        raise UsageError(
            f"no home folder to keep files in; name one in the variable {variable}"
        ) from None
    return base / "crosscue"


@cache
def names() -> tuple[str, ...]:
    """Of all models, sorted."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def card_path(name: str) -> Path:
    """The card of a model in the catalog.

    Raises:
        UsageError: No such model; the nearest is named.
    """
    if name not in names():
        close = difflib.get_close_matches(name, names(), n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(names())}"
        raise UsageError(f"model {name!r}: not in the catalog; {hint}")
    return FOLDER / f"{name}.toml"


def card_named(name: str) -> Path:
    """A card's file, from its name, which ends in ``.toml``, or from the catalog's.

    Raises:
        UsageError: The catalog has no such model; the nearest is named.
    """
    return Path(name) if name.endswith(".toml") else card_path(name)
