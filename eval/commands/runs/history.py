"""Show each metric of scored runs over commits, versions or tags, and where it changed.

The page needs no network and runs no script: for each metric its value with a 95 % interval under
each version, and change points marked. A change point is a version from which the metric differs by
more than chance, judged drive by drive; a history without any change shows one in at most 5 % of
cases, over all metrics together. With fewer than six drives, nothing is decided.

Versions come in the order in which their first run was made. Of several runs of a drive under one
version the latest counts.

examples:
  crosscue history runs -o history.html
  crosscue history runs --by model -o history.html --metrics 'cues.*.recall' 'approaches.*'
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("folder", type=Path, metavar="RUNS", help="folder of scored runs")
    parser.add_argument("-o", "--output", type=Path, metavar="HTML", help="page to write")
    parser.add_argument(
        "--by",
        default="commit",
        metavar="WHAT",
        help="commit or version of crosscue, or the name of a tag (default: commit)",
    )
    parser.add_argument(
        "--metrics", nargs="+", default=[], metavar="PATTERN", help="only these metrics"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing page")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Print what changed, and write the page."""
    found = crosscue.history(
        args.folder, args.output, args.by, args.metrics, overwrite=args.overwrite
    )
    print_result(found, args)
    return 0
