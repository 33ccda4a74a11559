"""Import annotated pictures of a log as its truth.

Supported formats are COCO, FiftyOne and Label Studio (.json), CVAT for images or video, XML 1.1
(.xml), and folders of YOLO and FiftyOne. Pictures are matched to frames by t_ns, by file name, or
by frame number. With --export, they are matched by the export, which may contain many drives: the
truth file of each is written below DIR, and DIR/coco.json contains all pictures, for training.

A label that is a cue's name ("stop sign", "parked_left") means that the cue is present. A picture
annotated without it means that the cue is absent. --map assigns other labels to cues. Annotation
files contain no approaches: write these into the truth file by hand (see crosscue truth schema),
and use --add to keep them. Your own cues are those that the vehicle file defines under [cues.own].

examples:
  crosscue truth import coco.json --log drive.mcap -o truth.json
  crosscue truth import corrected.json --export labelling -o labelled
  crosscue truth import annotations.xml --log drive.mcap -o truth.json --map 'halt=stop_sign' 'dog='
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.labels import meanings_of
from crosscue.eval.commands.shared.terminal import add_limit_arguments, limits_of, print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("source", type=Path, metavar="ANNOTATIONS", help="file or folder")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--log", type=Path, metavar="LOG", help="the log that was annotated")
    what.add_argument(
        "--export", type=Path, metavar="DIR", help="folder of crosscue export that was annotated"
    )
    parser.add_argument(
        "--format",
        choices=("coco", "cvat", "yolo", "fiftyone", "labelstudio"),
        help="format of the annotations (default: detected)",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="T.json",
        help="truth file, or its folder; with --export, the folder of all truth files",
    )
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="V.toml",
        help="vehicle file: camera topic and your own cues",
    )
    parser.add_argument(
        "--map",
        dest="meanings",
        nargs="+",
        default=[],
        metavar="LABEL=NAME",
        help="cue that a label counts as; LABEL= ignores it",
    )
    parser.add_argument(
        "--add",
        action="store_true",
        help="keep the approaches and the track of an existing truth file",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing truth file")
    add_limit_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Import the annotations, and print the result."""
    if args.export is not None:
        print_result(
            crosscue.import_labels(
                args.source,
                args.export,
                args.output,
                args.vehicle,
                labels=meanings_of(meanings=args.meanings),
                add=args.add,
                overwrite=args.overwrite,
                kind=args.format,
                limits=limits_of(args),
            ),
            args,
        )
        return 0
    found = crosscue.import_truth(
        args.source,
        args.log,
        args.output,
        args.vehicle,
        labels=meanings_of(meanings=args.meanings),
        add=args.add,
        overwrite=args.overwrite,
        kind=args.format,
        limits=limits_of(args),
    )
    print_result(found, args)
    return 0
