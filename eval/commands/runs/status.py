"""Show the progress of batches of drives: done, running, failed, stale or waiting.

A drive is stale when its worker's process has ended or, on another machine, has been silent for two
minutes. To process stale and failed drives, start the same replay again; to process only failed
drives, use replay --retry-failed. Nothing is written, so the command can run on any machine that
has access to the folders. The exit status is 3 when a drive has failed or is stale.

examples:
  crosscue status runs
  crosscue status shards/1 shards/2 --json
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import print_result


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="RUNS", help="folders that replay writes runs to"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the states; return 3 when a drive has failed or is stale."""
    found = crosscue.batch_status(*args.folders)
    print_result(found, args)
    return 0 if found.is_whole else 3
