"""Show the progress of batches of drives: done, running, failed, stale or waiting.

A drive is stale when its worker is gone: its process has ended, or on another machine has been
silent for two minutes. Start the same replay again, or replay --retry-failed for failures alone.
Nothing is written, so it can run on any machine that sees the folders. Exit status 3 when a
drive has failed or is stale.

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
    """Declare flags."""
    parser.add_argument(
        "folders", nargs="+", type=Path, metavar="RUNS", help="folders that replay writes runs to"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Print the state; 3 when a drive has failed or is stale."""
    found = crosscue.batch_status(*args.folders)
    print_result(found, args)
    return 0 if found.is_whole else 3
