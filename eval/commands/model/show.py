"""Show a model: what it is, what its classes mean to the cues, what was measured.

example:
  crosscue model show yolox-nano
  crosscue model show my.toml --json
"""

from __future__ import annotations

import argparse

from crosscue.detectors.catalog.card import ModelCard, read_card
from crosscue.detectors.catalog.class_names import CUE_LABELS
from crosscue.eval.commands.model.shared import card_of
from crosscue.eval.commands.shared.options import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("model", metavar="MODEL", help="a catalog's name or a card's file name")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Show."""
    card = read_card(card_of(args.model))
    if args.json:
        print_json(card.model_dump(mode="json"))
    elif not args.quiet:
        print("\n".join(_lines(args.model, card)))
    return 0


def _lines(name: str, card: ModelCard) -> list[str]:
    given = card.input
    size = f"{given.width_px} x {given.height_px}" + (", resizable" if given.is_resizable else "")
    count = len(card.output.classes)
    meant = sorted({card.meaning(i) for i in range(count)} & {*CUE_LABELS})
    lines = [
        f"{name}: {card.about or 'no description'}",
        f"licence    {card.licence or 'not named'}",
        f"source     {card.source or 'not named'}",
        f"weights    {card.weights}, SHA-256 {card.sha256}",
        f"input      {size}, {given.colour}, {given.fit}",
        f"output     {card.output.kind}, {count} classes",
        f"cues       {', '.join(meant) or 'none of its classes is counted by a default cue'}",
    ]
    for one in card.evidence:
        interval = "" if one.low is None else f" ({one.low:g} to {one.high:g})"
        result = f"{one.metric} {one.value:g}{interval}"
        lines.append(f"measured   {result} on {one.pictures}. {one.note}")
    if not card.evidence:
        lines.append("measured   nothing yet")
    return lines
