"""Show each metric of scored runs over commits, versions or tags, and where it changed.

The page needs no network and runs no script. For each metric, it shows the value and its 95 %
interval under each version, and marks change points. From a change point on, the metric differs by
more than chance, judged drive by drive. A history without any change shows a change point in at
most 5 % of cases, over all metrics together. With fewer than six drives, nothing is decided.

Versions are ordered by the time of their first run. If a drive has several runs under one version,
the latest counts.

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
    """Add the options to the parser."""
    parser.add_argument("folder", type=Path, metavar="RUNS", help="folder of scored runs")
    parser.add_argument("-o", "--output", type=Path, metavar="HTML", help="page to write")
    parser.add_argument(
        "--by",
        default="commit",
        metavar="WHAT",
        help="group runs by commit, by version of crosscue, or by this tag (default: commit)",
    )
    parser.add_argument(
        "--metrics", nargs="+", default=[], metavar="PATTERN", help="only these metrics"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing page")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the changes, and write the page."""
    found = crosscue.history(
        args.folder, args.output, args.by, args.metrics, overwrite=args.overwrite
    )
    print_result(found, args)
    return 0
