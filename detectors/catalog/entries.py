"""Cards of the catalog's models, and the folders of their weights."""

from pathlib import Path

from crosscue.replay.errors import VehicleError

from .card import ModelCard, WeightFile, read_card
from .places import card_path, model_folder


def entry(name: str) -> ModelCard:
    """Read a model's card.

    Raises:
        UsageError: The catalog has no such model.
    """
    return read_card(card_path(name))


def weights_path(card: ModelCard, file: WeightFile) -> Path:
    """Path of a weights file in the cache, whether or not it exists."""
    return model_folder() / card.sha256[:16] / file.name


def weights_folder(card: ModelCard, path: Path) -> Path:
    """Return the folder of a card's weights: the card's, or the cache for a catalog's model.

    Raises:
        VehicleError: They are not fetched yet; the message has size, licence and command.
    """
    if not card.files or (path.parent / card.weights).exists():
        return path.parent
    missing = [file for file in card.files if not weights_path(card, file).exists()]
    if missing:
        size = sum(file.size_bytes for file in card.files) / 1e6
        raise VehicleError(
            f"model {path.stem}: not fetched yet ({size:.1f} MB, licence {card.licence}); "
            f"crosscue model fetch {path.stem}"
        )
    return weights_path(card, card.files[0]).parent
