"""Print the JSON Schema of truth.json, for editors and other tools.

example:
  crosscue truth schema > truth.schema.json
"""

from __future__ import annotations

import argparse

from crosscue.datasets.truth.truth import json_schema
from crosscue.eval.commands.shared.options import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare no flags: there is but one schema."""


def run(args: argparse.Namespace) -> int:
    """Print it."""
    print_json(json_schema())
    return 0
