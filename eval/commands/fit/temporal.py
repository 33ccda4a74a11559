"""Learn the belief over time from annotated drives, for fusion.kind = "temporal".

Pass finished runs and the truth of each, in the same order, including drives without an
intersection. The result is the section [fusion.temporal] of a vehicle file. It describes how each
cue changes from step to step, by distance, with and without a road.

example:
  crosscue fit temporal runs/* --truth drives/*/truth.json -o temporal.toml
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_annotated_runs,
    add_file_output,
    print_result,
    progress_line,
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_annotated_runs(parser)
    add_file_output(parser, "TOML", "file to write the section to (default: print it)")


def run(args: argparse.Namespace) -> int:
    """Learn and report."""
    with progress_line(args, "reading") as line:
        found = crosscue.fit_temporal(
            args.runs,
            args.truth,
            args.output,
            overwrite=args.overwrite,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 0
