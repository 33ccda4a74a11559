"""Insertion of fitted thresholds and calibrations into a model card's text, comments kept."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import tomlkit
from pydantic import ValidationError

from crosscue.detectors.catalog.card import ModelCard
from crosscue.detectors.catalog.class_names import CUE_LABELS
from crosscue.detectors.catalog.class_scores import ClassScores
from crosscue.replay.errors import UsageError, VehicleError, one_line
from crosscue.replay.files.tree_text import toml_document
from crosscue.replay.vehicle.section import tuples

from .class_fit import ClassFit

WRITTEN_BY: Final = "crosscue fit detector"


def with_fit(text: str, fits: Sequence[ClassFit], pictures: str, aim: str) -> str:
    """Return a model card's text with the fit.

    Args:
        text: Text of the card.
        fits: Fits of all classes; classes that were not fitted stay unchanged.
        pictures: Description of the pictures: which, how many, labelled by whom.
        aim: The requested aim, in words.

    Raises:
        VehicleError: The result would not be a valid card.
    """
    document = toml_document(text)
    _insert_scores(document, fits)
    evidence = [
        row
        for row in document.pop("evidence", [])
        if not str(row.get("note", "")).startswith(WRITTEN_BY)
    ]
    for fit in fits:
        if fit.held_out is not None and fit.scores and fit.scores.threshold is not None:
            evidence.append(_evidence(fit, pictures, aim))
    if evidence:
        rows = tomlkit.aot()
        for row in evidence:
            table = tomlkit.table()
            table.update(row)
            rows.append(table)
        document["evidence"] = rows
    card = _checked(document.unwrap())
    reported = {card.meaning(i) for i in range(len(card.output.classes))} & {*CUE_LABELS}
    is_calibrated = bool(reported) and all(
        label in card.scores and card.scores[label].calibration is not None for label in reported
    )
    if is_calibrated != card.is_calibrated:
        _insert_first(document, "is_calibrated", is_calibrated)
    return tomlkit.dumps(document)


def scores_text(fits: Sequence[ClassFit]) -> str:
    """Return the card's sections with thresholds and calibrations; empty without any."""
    document = tomlkit.document()
    _insert_scores(document, fits)
    return tomlkit.dumps(document)


def _insert_scores(document: tomlkit.TOMLDocument, fits: Sequence[ClassFit]) -> None:
    scores = document.setdefault("scores", tomlkit.table(is_super_table=True))
    for fit in fits:
        if fit.scores is not None:
            scores.update({label: _section(fit.scores) for label in fit.members})


def _insert_first(document: Any, key: str, value: bool) -> None:
    """Insert a top-level key of the card before its first section."""
    if key in document:
        document[key] = value
        return
    place = list(document).index("weights")
    document._insert_at(place, tomlkit.key(key), tomlkit.item(value))


def _section(scores: ClassScores) -> Any:
    table = tomlkit.table()
    if scores.threshold is not None:
        table["threshold"] = scores.threshold
    if scores.calibration is not None:
        inline = tomlkit.inline_table()
        inline.update(scores.calibration.model_dump(mode="json"))
        table["calibration"] = inline
    return table


def _evidence(fit: ClassFit, pictures: str, aim: str) -> dict[str, object]:
    assert fit.held_out is not None
    assert fit.scores is not None
    held = fit.held_out
    what, found = fit.counted
    where = " in a picture" if fit.unit == "pictures" else ""
    row: dict[str, object] = {
        "pictures": pictures,
        "boxes": held.labels,
        "metric": f"precision of {fit.name}{where} above {fit.scores.threshold:g}, held out",
        "value": round(held.precision, 4) if held.of else 0.0,
    }
    if held.of:
        row |= {"low": round(held.interval.low, 4), "high": round(held.interval.high, 4)}
    row["note"] = (
        f"{WRITTEN_BY}: {aim}; fitted to {what} and {found}, "
        f"bound {fit.bound:.4f}; held out {held.right} of {held.of} right, recall "
        f"{held.right} of {held.labels}"
    )
    return row


def _checked(tree: object) -> ModelCard:
    try:
        return ModelCard.model_validate(tuples(tree))
    except ValidationError as error:
        raise VehicleError(f"the card with the fit: {one_line(error, 200)}; report it") from None


def check_card_place(card: ModelCard, source: Path, output: Path, *, overwrite: bool) -> None:
    """Check before any work that a card can be written to a path and will find its weights there.

    Raises:
        UsageError: The file exists, or the weights are in another folder.
    """
    if output.suffix != ".toml":
        raise UsageError(f"-o {output}: expected a card's name, which ends in .toml")
    if output.exists() and not overwrite and not output.samefile(source):
        raise UsageError(f"{output}: exists; give another name or --overwrite")
    if not card.files and output.resolve().parent != source.resolve().parent:
        raise UsageError(f"{output}: a card must be in the folder of its weights, {source.parent}")
