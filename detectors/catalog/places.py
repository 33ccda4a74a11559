"""Paths of the catalog: one card per model in ``models``, and the cache of their weights.

This repository does not contain other publishers' weights. ``crosscue model fetch`` stores them
below the cache folder (``$CROSSCUE_MODELS``, else the user's cache), in a folder named by their
hash, so that two versions of a model can coexist.
"""

import difflib
import os
from functools import cache
from pathlib import Path
from typing import Final

from crosscue.replay.errors import UsageError
from crosscue.replay.files.door import user_cache

FOLDER: Final = Path(__file__).parent / "models"
VARIABLE: Final = "CROSSCUE_MODELS"


def model_folder() -> Path:
    """Folder of fetched weights.

    Raises:
        UsageError: The user has no home folder.
    """
    asked = os.environ.get(VARIABLE)
    return Path(asked) if asked else user_cache(VARIABLE) / "models"


@cache
def names() -> tuple[str, ...]:
    """Names of all models, sorted."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def card_path(name: str) -> Path:
    """Path of the card of a model in the catalog.

    Raises:
        UsageError: The catalog has no such model; the message suggests the nearest name.
    """
    if name not in names():
        close = difflib.get_close_matches(name, names(), n=1)
        hint = f"did you mean {close[0]}?" if close else f"there are: {', '.join(names())}"
        raise UsageError(f"model {name!r}: not in the catalog; {hint}")
    return FOLDER / f"{name}.toml"


def card_named(name: str) -> Path:
    """Path of a card, from a file name that ends in ``.toml`` or a model name of the catalog.

    Raises:
        UsageError: The catalog has no such model; the message suggests the nearest name.
    """
    return Path(name) if name.endswith(".toml") else card_path(name)
