"""Learn the belief over time from annotated drives, for fusion.kind = "temporal".

Give finished runs and the truth of each, in the same order, including drives without an
intersection. The result (how each cue behaves from step to step, by distance, with and without a
road) goes into the vehicle file's section [fusion.temporal].

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
    """Declare flags."""
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
