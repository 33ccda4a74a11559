"""What changed between two runs: versions, settings, tables, metrics.

Exit status 1 when the second run is worse: a metric moved in its bad direction by more than its
tolerance, or is no longer scored. Without --tolerance none is allowed. A tolerance is a number in
the metric's unit, a fraction of the first run's value (2%), or either for the metrics of a pattern;
the last that fits counts. If a run was not scored, every difference of a table counts as worse.
Folders that crosscue score -o wrote for several runs can be compared as well.

examples:
  crosscue compare runs/before runs/after
  crosscue compare runs/before runs/after --tolerance 1% 'cues.*.precision=0.02'
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

from crosscue.eval.catalog.compare import (
    Comparison,
    MetricChange,
    TableChange,
    compare_runs,
    is_whole_run,
    open_scored,
    read_tolerance,
)
from crosscue.eval.commands.shared.options import print_json
from crosscue.replay.base import visible

T = TypeVar("T")
MAX_LINES = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("first", type=Path, metavar="RUN_A", help="reference run")
    parser.add_argument("second", type=Path, metavar="RUN_B", help="run to compare with it")
    parser.add_argument(
        "--tolerance",
        nargs="+",
        default=[],
        metavar="T",
        help="allowed deterioration of metrics: 0.01, 2%% or PATTERN=0.01",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Compare, report, and return 1 when the second run is worse, 3 when either has drops."""
    tolerances = [read_tolerance(text) for text in args.tolerance]
    runs = [open_scored(args.first), open_scored(args.second)]
    found = compare_runs(runs[0], runs[1], tolerances)
    if args.json:
        print_json(asdict(found) | {"worse": found.worse})
    elif not args.quiet:
        print("\n".join(_report_text(found)))
    return 1 if found.worse else 0 if all(map(is_whole_run, runs)) else 3


def _report_text(found: Comparison) -> Iterator[str]:
    for one in _first_of(found.changes, "settings"):
        if isinstance(one, str):
            yield one
        else:
            yield f"setting    {visible(one.path)}: {_short(one.before)} -> {_short(one.after)}"
    for table in found.tables:
        yield from _table_lines(table)
    for metric in _first_of(found.metrics, "metrics"):
        yield metric if isinstance(metric, str) else _metric_line(metric)
    yield (
        f"equal      {found.tables_same} tables, {found.metrics_same} metrics; different: "
        f"{len(found.changes)} settings, {len(found.tables)} tables, {len(found.metrics)} metrics"
    )
    if found.why_no_metrics:
        yield f"{visible(found.why_no_metrics)}; judged by tables alone"
    yield f"worse      {len(found.worse)}" if found.worse else "nothing is worse"


def _first_of(things: tuple[T, ...], what: str) -> Iterator[T | str]:
    yield from things[:MAX_LINES]
    if len(things) > MAX_LINES:
        yield f"           and {len(things) - MAX_LINES} more {what}; --json shows all"


def _short(value: object) -> str:
    text = "nothing" if value is None else visible(str(value))
    return text if len(text) <= 30 else text[:27] + "..."


def _table_lines(one: TableChange) -> Iterator[str]:
    rows = f"{_short(one.rows_before)} and {_short(one.rows_after)} rows"
    yield f"table      {visible(one.name)}: {visible(one.what)} ({rows})"
    for name, column in one.columns.items():
        far = "" if math.isnan(column.largest) else f", by up to {column.largest:.3g}"
        yield f"           {visible(name)}: {column.rows} rows differ{far}"


def _metric_line(one: MetricChange) -> str:
    label = "WORSE" if one.is_worse else "metric"
    allowed = f" (allowed {one.allowed:.3g})" if one.is_worse else ""
    return f"{label:11}{visible(one.path)}: {_value(one.before)} -> {_value(one.after)}{allowed}"


def _value(value: float) -> str:
    return "not scored" if math.isnan(value) else f"{value:.6g}"
