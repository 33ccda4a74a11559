"""Learn the reliability of each cue from annotated drives, for fusion.kind = "calibrated".

Pass finished runs and the truth of each, in the same order. The result is the section
[fusion.calibrated] of a vehicle file, with the counts behind each line. Frames of one approach
resemble each other, so counts and intervals use the effective number of independent frames.

example:
  crosscue fit messages runs/* --truth drives/*/truth.json -o calibrated.toml
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
        found = crosscue.fit_messages(
            args.runs,
            args.truth,
            args.output,
            overwrite=args.overwrite,
            on_runs=line.counting("runs"),
        )
    print_result(found, args)
    return 0
