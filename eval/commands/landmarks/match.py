"""Match one picture against a database, all of it or near a place.

example:
  crosscue landmarks match town.sqlite photo.jpg --near 120,80,50
"""

from __future__ import annotations

import argparse
import heapq
from pathlib import Path

from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.fit.landmark_database import near_of
from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.localization.landmarks.features import Match
from crosscue.localization.landmarks.images import grey_of, read_picture
from crosscue.replay.base import UsageError, visible
from crosscue.replay.vehicle.vehicle import Vehicle, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("database", type=Path, metavar="DB", help="landmark database")
    parser.add_argument("image", type=Path, metavar="IMAGE", help="PNG, JPEG or WebP")
    parser.add_argument(
        "--near",
        metavar="X,Y,R",
        help="only landmarks within R metres of a place; --near=-5,3,10 for x < 0",
    )
    parser.add_argument(
        "--best", type=int, default=5, metavar="N", help="number of matches to show (default: 5)"
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: camera and matcher"
    )
    parser.add_argument("--matcher", metavar="NAME", help="orb, or your own module:factory")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Match."""
    near = near_of(args.near)
    if args.best < 1:
        raise UsageError(f"--best {args.best}: expected 1 or more")
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    matcher = matcher_for(vehicle, args.matcher)
    seen = matcher.describe(grey_of(read_picture(args.image)))
    compared = 0
    best: list[tuple[float, int, Match, str]] = []
    with open_for(args.database, matcher) as database:
        for one in iter(database) if near is None else database.within(*near):
            match = matcher.match(seen, database.features(one.key))
            compared += 1
            # Of equal scores the first added comes first.
            best.append((match.score, -one.key, match, one.place.name))
            if len(best) > 2 * args.best:
                best = heapq.nlargest(args.best, best, key=lambda found: found[:2])
    best = heapq.nlargest(args.best, best, key=lambda found: found[:2])
    needed = vehicle.landmarks.min_score
    if args.json:
        rows = [
            {
                "name": name,
                "score": m.score,
                "pairs": m.pairs,
                "agreeing": m.agreeing,
                "is_match": m.score >= needed,
            }
            for _, _, m, name in best
        ]
        print_json({"points": len(seen), "compared": compared, "min_score": needed, "best": rows})
    elif not args.quiet:
        print(f"{len(seen)} points; {compared} landmarks compared; a match from {needed:g} on")
        for _, _, m, name in best:
            word = "match" if m.score >= needed else "no"
            print(f"{m.score:8.1f}  {word:5}  {m.agreeing:4} of {m.pairs:4} agree  {visible(name)}")
    return 0
