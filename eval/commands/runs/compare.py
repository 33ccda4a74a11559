"""What changed between two runs: versions, settings, tables, metrics.

Each metric is better, worse or undecided, by the drives that both runs have (six or more). Two runs
that differ by chance only are all undecided in at least 95 % of comparisons. Each line shows the
95 % interval of the difference, and how large a difference these drives would have shown.

Exit status 1 when a metric is worse by more than its tolerance (default: 0) or no longer scored. A
tolerance is a number in the metric's unit, a fraction of the first run's value (2%), or either for
the metrics of a pattern; the last that fits counts. Runs that were not scored: exit status 1 when a
table differs. Folders that crosscue score -o wrote for several runs can be compared as well.

examples:
  crosscue compare runs/before runs/after
  crosscue compare runs/before runs/after --tolerance 1% 'cues.*.precision=0.02'
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("first", type=Path, metavar="RUN_A", help="reference run")
    parser.add_argument("second", type=Path, metavar="RUN_B", help="run to compare with it")
    parser.add_argument(
        "--tolerance",
        nargs="+",
        default=[],
        metavar="T",
        help="allowed deterioration of metrics: 0.01, 2%% or PATTERN=0.01",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Compare, report, and return 1 when the second run is worse, 3 when either has drops."""
    found = crosscue.compare_runs(args.first, args.second, args.tolerance)
    print_result(found, args)
    return 0 if found.is_passed and found.is_whole else 3 if found.is_passed else 1
