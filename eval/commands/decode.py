"""Decode a drive into tables: one Parquet file for each topic, CAN message and Mobileye table.

example:
  crosscue decode drive.mcap --vehicle car.toml -o tables
"""

from __future__ import annotations

import argparse
from pathlib import Path

from crosscue.eval.catalog.decoded_logs import decode_tables
from crosscue.eval.commands.shared.options import (
    add_log_arguments,
    limits_of,
    print_json,
    selection_of,
)
from crosscue.eval.commands.shared.progress import Done, progress_line
from crosscue.eval.pipeline.drive_time import time_segments
from crosscue.eval.runs.account import account_lines
from crosscue.eval.runs.folder import create
from crosscue.replay.opening import open_logs
from crosscue.replay.safe_text import visible
from crosscue.replay.time.segments import gaps_text
from crosscue.replay.vehicle.vehicle import Vehicle, load


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    add_log_arguments(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="DIR", help="folder for the tables"
    )
    parser.add_argument(
        "--vehicle", type=Path, metavar="V.toml", help="vehicle file: DBC files, buses, mounting"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace existing tables")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Decode; 3 when something was dropped or the clock has gaps."""
    vehicle = load(args.vehicle) if args.vehicle else Vehicle(version=1)
    with open_logs(args.logs, limits_of(args)) as logs:
        folder = create(args.output, overwrite=args.overwrite)
        selection = selection_of(args, logs)
        with progress_line(args, "decoding") as shown:
            done = decode_tables(
                logs, vehicle, folder, selection, lambda n, of: shown.at(Done(n, of, "rows"))
            )
    rows, account = done.rows, done.account
    if args.json:
        print_json(
            {
                "tables": rows,
                "account": account.as_json(),
                "time": time_segments(done.timeline).as_json(),
            }
        )
    elif not args.quiet:
        width = max(map(len, rows), default=0)
        for name, count in rows.items():
            print(f"{name:{width}}  {count:>10,} rows")
        for line in (*account_lines(account), *done.details):
            print(visible(line))
        for log in account.reading:
            for sentence in log.notices:
                print(f"note     {visible(sentence)}")
        for sentence in gaps_text(done.timeline.segments):
            print(f"note     {sentence}")
    return done.exit_status
