"""Print the JSON Schema of truth.json, for editors and other tools.

example:
  crosscue truth schema -o truth.schema.json
"""

from __future__ import annotations

import argparse

import crosscue
from crosscue.eval.commands.shared.terminal import add_schema_output, print_schema


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    add_schema_output(parser)


def run(args: argparse.Namespace) -> int:
    """Print or write the schema."""
    print_schema(crosscue.truth_schema(), args)
    return 0
