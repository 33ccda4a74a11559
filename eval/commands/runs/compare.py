"""Compare two runs, or two sets of runs: each metric is better, worse or undecided.

Each metric is judged drive by drive, over the drives that both sides have (six or more). A metric
that did not change gets a verdict in at most 5 % of comparisons, over all cues and conditions
together. Each line shows the 95 % interval of the difference, the smallest difference that these
drives can detect, and the number of further drives needed for a decision.

With --runs and --against, two queries on a folder of runs select the runs to judge and the runs to
compare them with, one run per drive.

The exit status is 1 when a metric is worse by more than its tolerance (default: 0), or is no longer
scored. Noise alone never causes it. A tolerance is a number in the metric's unit or a fraction of
the first value (2%), for all metrics or for those of a pattern. The last tolerance that matches a
metric applies. If the two runs are not scored, the exit status is 1 when a table differs. Folders
that crosscue score -o wrote for several runs can be compared as well.

examples:
  crosscue compare runs/before runs/after
  crosscue compare runs/before runs/after --tolerance 1% 'cues.*.precision=0.02'
  crosscue compare runs --runs "tags['model'] = 'new'" --against "tags['model'] = 'old'" --markdown
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "first", metavar="RUN_A", help="reference run; with --runs, a folder of runs, or its URL"
    )
    parser.add_argument("second", nargs="?", metavar="RUN_B", help="run to compare with it")
    parser.add_argument(
        "--runs", metavar="QUERY", help="selects the runs to judge from the folder RUN_A"
    )
    parser.add_argument("--against", metavar="QUERY", help="selects the runs to compare them with")
    parser.add_argument(
        "--tolerance",
        nargs="+",
        default=[],
        metavar="T",
        help="allowed deterioration of metrics: 0.01, 2%% or PATTERN=0.01",
    )
    parser.add_argument(
        "--junit",
        type=Path,
        metavar="XML",
        help="write a JUnit file with a test case per judged metric",
    )
    shown = parser.add_mutually_exclusive_group()
    shown.add_argument(
        "--markdown", action="store_true", help="print a short table, for a pull request"
    )
    shown.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Compare and report; return 1 when a metric is worse, 3 when either side has drops."""
    found = _compared(args)
    if args.markdown and not args.quiet:
        print(found.markdown())
    else:
        print_result(found, args)
    return 0 if found.is_passed and found.is_whole else 3 if found.is_passed else 1


def _compared(args: argparse.Namespace) -> crosscue.Comparison:
    queries = [args.runs, args.against]
    if queries == [None, None]:
        if args.second is None:
            raise crosscue.UsageError("compare: expected two runs, or --runs and --against")
        return crosscue.compare_runs(args.first, args.second, args.tolerance, args.junit)
    if None in queries or args.second is not None:
        raise crosscue.UsageError("compare: expected one folder with both --runs and --against")
    return crosscue.compare_many(args.runs, args.against, args.first, args.tolerance, args.junit)
