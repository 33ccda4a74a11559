"""Query all runs below a folder with SQL.

The tables are runs, approaches, cues, scores, belief, range, pose, dropped and every other table
that runs contain; --schema lists their columns. The query is one SELECT in DuckDB's SQL. It is
read-only: it can neither write anything nor read any other file. Runs that cannot be read are named
on stderr, and the exit status is 3.

examples:
  crosscue query runs "select vehicle, count(*) from runs group by vehicle"
  crosscue query runs "select run, detected_m from approaches where 'dusk' in conditions" --csv
  crosscue query runs "from scores where metric = 'range.start.rmse_m'" -o ranges.parquet
  crosscue query runs --schema
"""

from __future__ import annotations

import argparse
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.rows import print_rows, write_rows
from crosscue.eval.commands.shared.terminal import refuse_existing, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("runs", metavar="RUNS", help="folder or URL of runs, or one run")
    parser.add_argument("sql", nargs="?", metavar="SQL", help="one SELECT, in quotes")
    parser.add_argument("--schema", action="store_true", help="print tables and columns instead")
    shape = parser.add_mutually_exclusive_group()
    shape.add_argument("--json", action="store_true", help="print the result as JSON")
    shape.add_argument("--csv", action="store_true", help="print the result as CSV")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="file to write: .parquet, .csv or .json"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace the output")


def run(args: argparse.Namespace) -> int:
    """Run the query, print or write its rows; return 3 when a run could not be read."""
    if (args.sql is None) != args.schema:
        raise crosscue.UsageError(
            "query: expected either SQL or --schema; see crosscue query --help"
        )
    refuse_existing(args)
    catalog = crosscue.catalog(args.runs)
    found = catalog.schema() if args.schema else catalog.query(args.sql)
    if args.output is None:
        print_rows(found, args)
    else:
        write_rows(found, args)
    for notice in () if args.quiet else catalog.notices:
        warn(notice)
    for name, why in sorted(catalog.left_out.items()):
        warn(f"left out: {name}: {why}")
    return 3 if catalog.left_out else 0
