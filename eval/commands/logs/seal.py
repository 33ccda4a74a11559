"""Write a hash of each MiB of a log to a seal file, so that later damage is detected and located.

examples:
  crosscue seal drive.bag can0.log        writes drive.bag.seal and can0.log.seal
  crosscue seal --check drive.bag         verifies the entire log
  crosscue seal segment/                  writes segment.seal, for all files of the folder

ROS 1 bags, .db3, candump, ASC and TRC logs, videos and .npy data sets contain no checksum, so a
flipped payload byte goes unnoticed. Seal a log once it is known to be good. Every later command
verifies the parts of the log that it reads, and reports damaged byte ranges. A seal that no longer
matches its log is replaced only with --overwrite; run --check first. URLs cannot be sealed.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import Done, print_json, progress_line
from crosscue.replay.base import visible

SHOWN = 20
MEGABYTE = 1_000_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("logs", nargs="+", metavar="LOG", help="recordings on this machine")
    parser.add_argument("--check", action="store_true", help="verify against the seal")
    parser.add_argument(
        "--overwrite", action="store_true", help="replace a seal that does not match the log"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Seal or check each log.

    Returns:
        0 on success, 3 when a checked log differs from its seal.
    """
    found = _check(args) if args.check else _seal(args)
    if args.json:
        print_json({"logs": [one.as_dict() for one in found]})
    return 0 if all(one.is_whole for one in found) else 3


def _seal(args: argparse.Namespace) -> crosscue.Seals:
    with progress_line(args, "sealing") as line:

        def on_bytes(log: Path, done: int, of: int) -> None:
            line.at(Done(done / MEGABYTE, of / MEGABYTE, "MB"), f"sealing {log.name}")

        def on_log(one: crosscue.Sealed) -> None:
            line.end()
            if not args.json and not args.quiet:
                print(one)

        return crosscue.seal(*args.logs, overwrite=args.overwrite, on_bytes=on_bytes, on_log=on_log)


def _check(args: argparse.Namespace) -> crosscue.SealChecks:
    with progress_line(args, "checking") as line:

        def on_blocks(log: Path, done: int, of: int) -> None:
            line.at(Done(done, of, "MiB"), f"checking {log.name}")

        def on_log(one: crosscue.SealCheck) -> None:
            line.end()
            if not args.json:
                _print_check(one, quiet=args.quiet)

        return crosscue.check_seal(*args.logs, on_blocks=on_blocks, on_log=on_log)


def _print_check(found: crosscue.SealCheck, *, quiet: bool) -> None:
    if found.is_whole:
        if not quiet:
            print(found)
        return
    for sentence in found.files_changed:
        print(visible(f"{found.log}: {sentence}"), file=sys.stderr)
    for line in found.differences[:SHOWN]:
        print(line, file=sys.stderr)
    if len(found.differences) > SHOWN:
        print(f"and {len(found.differences) - SHOWN} more; --json lists them", file=sys.stderr)
