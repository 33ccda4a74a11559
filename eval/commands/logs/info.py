"""Show the contents of a log: topics, counts, rates, gaps, clocks and damage.

examples:
  crosscue info drive.mcap
  crosscue info drive.mcap can0.log --json > drive.json
  crosscue info --quick drive.bag      only read what the file declares about itself
  crosscue info https://host/drive.mcap --from 60 --to 62

Offset and drift compare the header stamp, or else the publish time, with the log time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    Done,
    add_part_arguments,
    limits_of,
    open_part,
    print_json,
    with_progress,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="recordings; paths or URLs")
    add_part_arguments(parser)
    parser.add_argument(
        "--vehicle",
        type=Path,
        metavar="V.toml",
        help="vehicle file: topic of wheel speeds, to find gaps",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="print what the log declares, and whether its end is missing, without reading its "
        "messages",
    )


def run(args: argparse.Namespace) -> int:
    """Read each log, and print its contents.

    Returns:
        0 when all logs are complete, 3 when something is dropped or a log has several segments.
    """
    vehicle = crosscue.load_vehicle(args.vehicle) if args.vehicle else None
    opened = crosscue.open(*args.logs, limits=limits_of(args)) if args.quick else None
    with opened or open_part(args, args.logs) as log:
        found = log.summary(
            vehicle,
            quick=args.quick,
            progress=lambda blocks, rows: with_progress(
                blocks, lambda: Done(*rows(), "rows"), args, "reading"
            ),
        )
    if args.json:
        print_json(found.as_dict())
    else:
        print(found)
    return 0 if found.is_whole and not found.has_gaps else 3
