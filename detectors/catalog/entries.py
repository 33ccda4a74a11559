"""The models of the catalog: their cards, and the folders with their weights."""

from __future__ import annotations

from pathlib import Path

from crosscue.replay.errors import VehicleError

from .card import ModelCard, WeightFile, read_card
from .places import cache_folder, card_path


def entry(name: str) -> ModelCard:
    """A model's card.

    Raises:
        UsageError: No such model.
    """
    return read_card(card_path(name))


def place_of(card: ModelCard, file: WeightFile) -> Path:
    """Where a file of a model's weights is, or would be, in the cache."""
    return cache_folder() / card.sha256[:16] / file.name


def weights_folder(card: ModelCard, path: Path) -> Path:
    """The folder with a card's weights: beside the card, or the cache for a catalog's model.

    Raises:
        VehicleError: They are not fetched yet; with size, licence and the command.
    """
    if not card.files or (path.parent / card.weights).exists():
        return path.parent
    missing = [file for file in card.files if not place_of(card, file).exists()]
    if missing:
        size = sum(file.size_bytes for file in card.files) / 1e6
        raise VehicleError(
            f"model {path.stem}: not fetched yet ({size:.1f} MB, licence {card.licence}); "
            f"crosscue model fetch {path.stem}"
        )
    return place_of(card, card.files[0]).parent
