"""Download the weights of catalog models, and verify them by their SHA-256.

Files that exist below $CROSSCUE_DATA/weights are copied from there. An interrupted download
continues where it stopped. $CROSSCUE_MODEL_MIRROR is a server to download from instead of the
publisher's, and $CROSSCUE_MODELS is the folder to keep the weights in.

example:
  crosscue model fetch yolox-nano
  crosscue model fetch yolox-s --from Downloads/object_detection_yolox_2022nov.onnx
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import Done, ProgressLine, print_json, progress_line


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("models", nargs="+", metavar="MODEL", help="names from crosscue model list")
    parser.add_argument(
        "--from",
        dest="given",
        type=Path,
        metavar="FILE",
        help="copy the weights from this file or folder instead of downloading them",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Fetch the models."""
    if args.given is not None and len(args.models) > 1:
        raise crosscue.UsageError("--from: one model at a time")
    found: dict[str, object] = {}
    for name in args.models:
        with progress_line(args, "fetching") as line:
            fetched = crosscue.fetch_model(name, args.given, on_bytes=_megabytes(line))
        found |= fetched.as_dict()
        if not args.quiet and not args.json:
            print(fetched)
    if args.json:
        print_json(found)
    return 0


def _megabytes(line: ProgressLine) -> Callable[[str, int, int], None]:
    def show(file: str, done: int, of: int) -> None:
        line.at(Done(done / 1e6, of / 1e6, "MB"), file)

    return show
