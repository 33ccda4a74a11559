"""Check that a model card fits its network, by running it; draw what it finds in a picture.

example:
  crosscue model check my.toml --picture street.jpg
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from crosscue.detectors.networks.model_detector import build
from crosscue.eval.commands.model.shared import card_of, look
from crosscue.eval.commands.shared.options import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("model", metavar="MODEL", help="a catalog's name or a card's file name")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="run it on this picture")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE.jpg",
        help="the picture with what was found (default: beside the picture, .found.jpg)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Check."""
    card = card_of(args.model)
    detector = build(card=str(card))
    result: dict[str, object] = {"card": str(card), "identity": detector.identity}
    if args.picture is not None:
        output = args.output or args.picture.with_suffix(".found.jpg")
        found = look(detector, args.picture, output)
        result["picture"] = str(output)
        result["found"] = None if found is None else dict(Counter(found.labels))
    if args.json:
        print_json(result)
    elif not args.quiet:
        print(f"{card}: fits its network")
        if args.picture is not None:
            counts = result["found"]
            text = (
                ", ".join(f"{n} {label}" for label, n in counts.items())
                if isinstance(counts, dict)
                else "road"
            )
            print(f"found      {text or 'nothing'}; drawn in {result['picture']}")
    return 0
