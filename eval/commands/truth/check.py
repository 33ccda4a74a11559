"""Check that a truth file, and every file that it names, fits its log.

Refused with one line: times outside the log, cues and classes that are not known, overlapping
approaches, boxes outside the picture, pictures of another size, another log's hash.

example:
  crosscue truth check truth.json --log drive.mcap
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from crosscue.eval.commands.shared.options import add_limit_arguments, limits_of, print_json
from crosscue.eval.fit.truth_check import TruthFit, check_truth
from crosscue.replay.vehicle.vehicle import Vehicle, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("truth", type=Path, metavar="T.json", help="truth file")
    parser.add_argument(
        "--log", type=Path, required=True, metavar="LOG", help="the log it belongs to"
    )
    parser.add_argument("--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera topic")
    add_limit_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Check, and print what the truth contains."""
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    found = check_truth(args.truth, args.log, vehicle, limits_of(args))
    if args.json:
        print_json(asdict(found))
    elif not args.quiet:
        _report(found)
    return 0


def _report(found: TruthFit) -> None:
    print(f"fits       {found.seconds:.1f} s of truth")
    print(f"holds      {found.approaches} approaches, {found.cues} statements about cues,")
    print(f"           {found.objects} objects, {found.ranges} ranges, {found.poses} poses")
    if found.outside:
        print(f"outside    {found.outside} of them reach beyond the log, whose clock was set back")
    if found.moments:
        print(f"moments    {found.moments_with_frame} of {found.moments} meet a picture of the log")
    if not found.is_checked_by_hash:
        print("log        not checked by hash: the truth names none (log_sha256)")
