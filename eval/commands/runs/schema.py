"""Print the JSON Schema of a run's manifest.json, for editors and other tools.

example:
  crosscue run schema -o manifest.schema.json
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
    print_schema(crosscue.run_schema(), args)
    return 0
