"""Write a model card for an ONNX or OpenVINO file, or for weights of a torchvision network.

The network, or the layout of its outputs, is recognised from names, shapes and metadata. Properties
that the file does not record are listed in the card as assumptions to check. If several kinds fit,
the error lists all of them, for --kind. Weights are a state_dict (.pth, .pt) or safetensors:
tensors, without code.

example:
  crosscue model init my.onnx --picture street.jpg
  crosscue model init weights.pth --class-names names.txt
  crosscue replay drive.mcap --vehicle car.toml --detectors my.toml -o run
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "weights",
        type=Path,
        metavar="MODEL",
        help=".onnx, OpenVINO .xml, .pth, .pt or .safetensors",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="CARD.toml",
        help="card to write, in the folder of the weights (default: their name with .toml)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing card")
    parser.add_argument(
        "--kind", metavar="KIND", help="network, or layout of its outputs, if several fit"
    )
    parser.add_argument(
        "--class-names",
        type=Path,
        metavar="FILE",
        help="class names, one per line, for a file without them",
    )
    parser.add_argument(
        "--classes", metavar="NAME,NAME", help="the same names in one argument: road,curb,mark"
    )
    parser.add_argument(
        "--size", metavar="WxH", help="input size, such as 1280x736, for a network that accepts any"
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE",
        help="draw detections in a copy of this picture, next to the card",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Write the card, then run the network with it."""
    found = crosscue.draft_card(
        args.weights,
        args.output,
        kind=args.kind,
        class_names=args.class_names,
        classes=args.classes,
        size_px=args.size,
        picture=args.picture,
        overwrite=args.overwrite,
    )
    print_result(found, args)
    return 0
