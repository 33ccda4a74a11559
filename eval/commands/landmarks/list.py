"""List the landmarks of a database, all or near a place.

example:
  crosscue landmarks list town.sqlite --near=-12.5,80,50
"""

from __future__ import annotations

import argparse
import math
from itertools import islice
from pathlib import Path

from crosscue.eval.commands.shared.options import print_json
from crosscue.eval.fit.landmark_database import near_of
from crosscue.localization.landmarks.database import LandmarkDatabase, Place
from crosscue.replay.base import UsageError, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("database", type=Path, metavar="DB", help="landmark database")
    parser.add_argument(
        "--near",
        metavar="X,Y,R",
        help="only landmarks within R metres of a place; --near=-5,3,10 for x < 0",
    )
    parser.add_argument(
        "--limit", type=int, default=100, metavar="N", help="max landmarks to list (default: 100)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """List."""
    near = near_of(args.near)
    if args.limit < 0:
        raise UsageError(f"--limit {args.limit}: expected 0 or more")
    with LandmarkDatabase(args.database) as database:
        total = len(database)
        found = iter(database) if near is None else database.within(*near)
        places = [one.place for one in islice(found, args.limit)]
        kind = database.kind
    if args.json:
        listed = [_as_json(place) for place in places]
        print_json({"matcher": kind, "landmarks": total, "listed": listed})
    elif not args.quiet:
        print(f"{args.database}: {total} landmarks of matcher {kind}; listed: {len(places)}")
        for place in places:
            print(_line(place))
    return 0


def _line(place: Place) -> str:
    sd_x, sd_y = math.sqrt(place.cov_m2[0, 0]), math.sqrt(place.cov_m2[1, 1])
    turn = "      -" if place.heading_rad is None else f"{math.degrees(place.heading_rad):7.1f}"
    x, y = place.xy_m
    return (
        f"{x:12.2f} {y:12.2f} m  +- {sd_x:6.2f} {sd_y:6.2f} m  heading {turn} deg  "
        f"{visible(place.name)}"
    )


def _as_json(place: Place) -> dict[str, object]:
    return {
        "name": place.name,
        "source": place.source,
        "xy_m": place.xy_m.tolist(),
        "cov_m2": place.cov_m2.tolist(),
        "heading_rad": place.heading_rad,
    }
