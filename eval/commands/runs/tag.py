"""Set tags of runs, remove them, or list them.

A tag is a key and a value, such as weather=rain. It is stored in the run's tags.json, can be
queried with crosscue query, and is kept when the run is repeated. Without KEY=VALUE and --remove,
tags are listed.

examples:
  crosscue tag runs/drive-1f0e runs/drive-93aa weather=rain route=north
  crosscue tag runs --remove route
  crosscue tag runs
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "words",
        nargs="+",
        metavar="RUN",
        help="run folders, or folders of them; then KEY=VALUE for each tag to set",
    )
    parser.add_argument("--remove", nargs="+", default=[], metavar="KEY", help="tags to remove")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Change tags, and list them."""
    tags = [word for word in args.words if "=" in word and not Path(word).exists()]
    runs = [word for word in args.words if word not in tags]
    if not runs:
        raise crosscue.UsageError("tag: no run named; give run folders before KEY=VALUE")
    print_result(crosscue.tag_runs(runs, tags, args.remove), args)
    return 0
