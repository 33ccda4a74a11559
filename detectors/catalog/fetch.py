"""Fetch weights from their publisher, a mirror, a folder or a file, and verify their hashes.

``$CROSSCUE_MODEL_MIRROR`` names a server that is used instead of the publisher, with addresses
``MIRROR/NAME``. ``$CROSSCUE_DATA`` names a folder whose subfolder ``weights`` is searched.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from crosscue.replay.errors import UsageError
from crosscue.replay.files.transfer import Progress, download, is_there, take

from .card import ModelCard, WeightFile
from .entries import entry, weights_path

MIRROR: Final = "CROSSCUE_MODEL_MIRROR"
DATA: Final = "CROSSCUE_DATA"
OTHERWISE: Final = f"pass it with --from FILE, or name a mirror in {MIRROR}"


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """Location of a model's file, and its source."""

    path: Path
    came_from: str


def fetch_weights(
    name: str,
    given: Path | None = None,
    on_progress: Progress = lambda name, done, total: None,
) -> list[FetchedFile]:
    """Fetch all files of a catalog's model into the cache.

    Args:
        name: As ``crosscue model list`` prints it.
        given: A file, or a folder with the files, to copy; no network is used.
        on_progress: Called after each piece.

    Raises:
        UsageError: The model does not exist, or ``given`` is missing or a different file.
        CrosscueError: The download fails, or the file's hash is not the catalog's.
        OutputError: The cache cannot be written.
    """
    card = entry(name)
    if not card.files:
        raise UsageError(f"model {name}: part of crosscue; there is nothing to fetch")
    return [_fetched(name, card, file, given, on_progress) for file in card.files]


def _fetched(
    name: str,
    card: ModelCard,
    file: WeightFile,
    given: Path | None,
    on_progress: Progress,
) -> FetchedFile:
    place, owner = weights_path(card, file), f"model {name}"
    source = None if given is None else given / file.name if given.is_dir() else given
    if is_there(file, place) and (source is None or source.exists()):
        return FetchedFile(place, "the cache")
    if source is not None:
        take(source, file, place, owner)
        return FetchedFile(place, str(source))
    for copy in _local_copies(file):
        if is_there(file, copy):
            take(copy, file, place, owner)
            return FetchedFile(place, str(copy))
    mirror = os.environ.get(MIRROR)
    url = f"{mirror.rstrip('/')}/{file.name}" if mirror else file.url
    download(url, file, place, owner, OTHERWISE, on_progress)
    return FetchedFile(place, url)


def _local_copies(file: WeightFile) -> Iterator[Path]:
    """Yield the files of that name below ``$CROSSCUE_DATA/weights``."""
    folder = os.environ.get(DATA)
    if folder:
        yield from sorted(Path(folder, "weights").glob(f"*/{file.name}"))
