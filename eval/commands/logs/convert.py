"""Convert any supported log or data set to MCAP with standard ROS 2 types, message for message.

examples:
  crosscue convert drive.bag -o drive.mcap
  crosscue convert can0.log -o can0.mcap --from 10 --to 70
  crosscue convert segment/ -o segment.mcap --topics wheels compass --compression lz4
  crosscue convert damaged.mcap -o rescued.mcap --salvage

ROS 2 messages are copied byte for byte, and ROS 1 messages are transcribed. CAN frames become
can_msgs/msg/Frame (CAN FD: crosscue_msgs/msg/CanFdFrame on TOPIC/fd). Pictures become
sensor_msgs/msg/CompressedImage, Image or foxglove_msgs/msg/CompressedVideo. Tables become the
standard type that has all their columns, or else crosscue_msgs/msg/TOPIC with one field per column.
The written file is read back and its messages are counted before the command reports success. For a
damaged log, the readable part is written, and the exit status is 3. --salvage prints every damaged
place, with its byte range if the format has byte ranges.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_part_arguments,
    open_part,
    print_json,
    progress_line,
)
from crosscue.replay.safe_text import terminal_width, wrapped

SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("log", metavar="LOG", help="a recording, a data-set folder or a URL")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT.mcap", help="MCAP file to write"
    )
    add_part_arguments(parser)
    parser.add_argument(
        "--compression",
        choices=("zstd", "lz4", "none"),
        default="zstd",
        help="compression of the chunks (default: zstd)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT.mcap")
    parser.add_argument(
        "--salvage",
        action="store_true",
        help="list every damaged place",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Convert the log, read the file back, and print the numbers of messages.

    Returns:
        0 when every selected row is in the file, 3 when some are dropped or skipped.
    """
    with open_part(args, [args.log]) as log, progress_line(args, "converting") as line:
        found = crosscue.convert(
            log,
            args.output,
            compression=args.compression,
            overwrite=args.overwrite,
            on_rows=line.counting("rows"),
        )
    if args.json:
        print_json(found.as_dict() | {"details": found.places if args.salvage else []})
    elif not args.quiet:
        print(found)
        _print_damage(found, salvage=args.salvage)
    return 0 if found.is_whole else 3


def _print_damage(found: crosscue.Converted, *, salvage: bool) -> None:
    places = found.places_text
    shown = places if salvage else places[:SHOWN]
    for line in (*found.notices[:SHOWN], *shown):
        print(wrapped(line, terminal_width()), file=sys.stderr)
    if len(shown) < len(places):
        print(f"and {len(places) - len(shown)} more places", file=sys.stderr)
    if not found.ledger.is_whole and not salvage:
        print(
            "the log is damaged; its readable part was written; crosscue convert --salvage lists "
            "every damaged place",
            file=sys.stderr,
        )
