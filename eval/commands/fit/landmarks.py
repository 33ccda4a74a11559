"""Choose the match threshold for a wanted false-match rate, from labelled pictures.

Half of the query pictures choose it, the other half gives the rates. Pairs come from a CSV file
query,known,same (pictures relative to its folder; same is 1 or 0), or from a drive with known poses
against a database that another drive made.

example:
  crosscue fit landmarks --pairs pairs.csv --false-match-rate 0.01
  crosscue fit landmarks second.mcap --database town.sqlite --poses truth.json \
--vehicle car.toml -o car.toml
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from crosscue.eval.commands.shared.drive_part import selection_of
from crosscue.eval.commands.shared.options import (
    add_part_arguments,
    add_vehicle_output,
    check_vehicle_output,
    limits_of,
    metres,
    print_json,
)
from crosscue.eval.fit.landmark_database import camera_frames, read_poses
from crosscue.eval.fit.landmark_pairs import pairs_of_drive, pairs_of_table, with_min_score
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.features import Matcher
from crosscue.localization.landmarks.fit import LandmarkFit, Rate, ScoredPairs, fit_landmarks
from crosscue.replay.base import Ledger, SchemaError, UsageError, write_text
from crosscue.replay.logs.opening import open_logs
from crosscue.replay.losses import warn_of
from crosscue.replay.vehicle.vehicle import Vehicle, load, parse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("logs", nargs="*", type=Path, metavar="LOG", help="recordings of one drive")
    parser.add_argument("--pairs", type=Path, metavar="FILE.csv", help="labelled pairs of images")
    parser.add_argument(
        "--database", type=Path, metavar="DB", help="landmark database made from another drive"
    )
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="RUN|T.json",
        help="poses of the vehicle: a run or a truth file",
    )
    parser.add_argument(
        "--false-match-rate",
        type=_fraction,
        default=0.001,
        metavar="P",
        help="max fraction of pairs from different places that match (default: 0.001)",
    )
    for flag, default, what in (
        ("--every", 5.0, "distance between the frames used, in metres"),
        ("--same-within", 5.0, "max distance of a landmark of the same place, in metres"),
        ("--different-beyond", 50.0, "min distance of a landmark of another place, in metres"),
    ):
        parser.add_argument(
            flag, type=metres, default=default, metavar="M", help=f"{what} (default: {default:g})"
        )
    parser.add_argument(
        "--max-landmarks",
        type=int,
        default=50,
        metavar="N",
        help="max landmarks per frame (default: 50)",
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera and matcher"
    )
    parser.add_argument("--matcher", metavar="NAME", help="orb, or your own module:factory")
    add_vehicle_output(parser)
    add_part_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _fraction(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1.0:
        raise ValueError(text)
    return value


def run(args: argparse.Namespace) -> int:
    """Fit, report, and write where asked."""
    given = (bool(args.pairs), bool(args.logs), bool(args.database), bool(args.poses))
    if given not in ((True, False, False, False), (False, True, True, True)):
        raise UsageError("fit landmarks: give --pairs, or LOG... with --database and --poses")
    check_vehicle_output(args)
    if args.max_landmarks < 1:
        raise UsageError(f"--max-landmarks {args.max_landmarks}: expected 1 or more")
    if args.same_within >= args.different_beyond:
        raise UsageError(
            f"--same-within {args.same_within:g}: expected less than --different-beyond "
            f"{args.different_beyond:g}"
        )
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    matcher = matcher_for(vehicle, args.matcher)
    if args.pairs:
        pairs = pairs_of_table(args.pairs, matcher)
    else:
        pairs = _pairs_of_logs(args, vehicle, matcher)
    try:
        fitted = fit_landmarks(pairs, args.false_match_rate)
    except ValueError as error:
        raise SchemaError(f"fit landmarks: {error}; give more labelled pictures") from None
    if args.output is not None:
        text = with_min_score(args.vehicle.read_text(encoding="utf-8"), fitted.min_score)
        parse(text, str(args.vehicle))
        write_text(args.output, text)
    if args.json:
        print_json({**asdict(fitted), "is_shown": fitted.is_shown, "matcher": matcher.kind})
    elif not args.quiet:
        print(_report_text(fitted))
        if args.output is not None:
            print(f"written to {args.output}")
    return 0


def _pairs_of_logs(args: argparse.Namespace, vehicle: Vehicle, matcher: Matcher) -> ScoredPairs:
    poses = read_poses(args.poses, vehicle)
    with (
        open_for(args.database, matcher) as database,
        open_logs(args.logs, limits_of(args)) as logs,
    ):
        ledgers = [Ledger(str(log.path)) for log in logs]
        frames = camera_frames(logs, vehicle, selection_of(args, logs), ledgers)
        pairs = pairs_of_drive(
            frames,
            poses,
            database,
            matcher,
            args.every,
            args.same_within,
            args.different_beyond,
            args.max_landmarks,
            ledgers,
        )
    for ledger in ledgers:
        warn_of(ledger)
    return pairs


def _report_text(fitted: LandmarkFit) -> str:
    lines = [
        f"threshold   min_score = {fitted.min_score:g} for a false-match rate of "
        f"{fitted.wanted_rate:g}",
        "",
        "                       fitted                        held out",
    ]
    for name, fit, held in (
        ("false matches", fitted.fitted_false, fitted.held_out_false),
        ("places found", fitted.fitted_found, fitted.held_out_found),
    ):
        lines.append(f"{name:14} {_rate(fit):>29} {_rate(held):>31}")
    if not fitted.is_shown:
        lines += [
            "",
            f"the {fitted.held_out_false.of} held-out pairs cannot show a rate of "
            f"{fitted.wanted_rate:g}: it may be up to {fitted.held_out_false.high:.2g}",
        ]
    return "\n".join(lines)


def _rate(rate: Rate) -> str:
    return f"{rate.hits} of {rate.of} ({rate.low:.2g} to {rate.high:.2g})"
