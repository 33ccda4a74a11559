"""Fetch the weights of models of the catalog, checked by their SHA-256 before they are used.

What is already at hand below $CROSSCUE_DATA/weights is taken from there. A transfer that was cut
goes on where it stopped. $CROSSCUE_MODEL_MIRROR names a server to ask instead of the publisher,
$CROSSCUE_MODELS the folder to keep them in.

example:
  crosscue model fetch yolox-nano
  crosscue model fetch yolox-s --weights Downloads/object_detection_yolox_2022nov.onnx
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.detectors.catalog.fetch import Fetched, fetch
from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.commands.shared.progress import Done, ProgressLine, progress_line
from crosscue.replay.errors import UsageError
from crosscue.replay.files.transfer import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("models", nargs="+", metavar="MODEL", help="names from crosscue model list")
    parser.add_argument(
        "--weights",
        dest="given",
        type=Path,
        metavar="FILE",
        help="take the weights from this file, or a folder with them; no network is used",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fetch."""
    if args.given is not None and len(args.models) > 1:
        raise UsageError("--weights: one model at a time")
    found: dict[str, list[Fetched]] = {}
    for name in args.models:
        with progress_line(args, "fetching") as line:
            found[name] = fetch(name, args.given, _megabytes(line))
        if not args.quiet and not args.json:
            for file in found[name]:
                print(f"{name}: {file.path} (from {file.came_from})")
    if args.json:
        print_json({name: [str(file.path) for file in files] for name, files in found.items()})
    return 0


def _megabytes(line: ProgressLine) -> Progress:
    def show(file: str, done: int, of: int) -> None:
        line.at(Done(done / 1e6, of / 1e6, "MB"), file)

    return show
