"""List the models of the catalog.

example:
  crosscue model list
"""

from __future__ import annotations

import argparse

from crosscue.detectors.catalog.entries import entry, names, place_of
from crosscue.eval.commands.shared.options import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List."""
    rows = [_row(name) for name in names()]
    if args.json:
        print_json(rows)
        return 0
    if args.quiet:
        return 0
    for row in rows:
        state = "fetched" if row["is_fetched"] else "not fetched"
        print(
            f"{row['name']:28} {row['size_mb']:6.1f} MB  {row['licence']:12} {state:12} "
            f"{row['about']}"
        )
    return 0


def _row(name: str) -> dict[str, object]:
    card = entry(name)
    return {
        "name": name,
        "about": card.about,
        "kind": card.output.kind,
        "licence": card.licence,
        "size_mb": sum(file.size_bytes for file in card.files) / 1e6,
        "is_fetched": all(place_of(card, file).exists() for file in card.files),
    }
