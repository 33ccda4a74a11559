"""Score runs against truth: metrics, figures, report, gates.

Metrics and figures of each run are written to RUN/score. Several runs (folders, a folder of runs, a
quoted pattern, @list.txt) are also scored together, and the pooled result is written to the folder
of -o. A run that cannot be scored does not stop the rest. Without --truth, each run's truth is the
truth.json next to its log.

A gate file (TOML) sets bounds on metrics. The exit status is 1 when a gate fails:
  version = 1
  [[gate]]
  metric = "cues.stop_sign.precision"
  min = 0.9
  use = "low"

examples:
  crosscue score runs/A-01 --truth drives/A-01/truth.json
  crosscue score runs -o scored --gate gates.toml --workers 8
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import crosscue
from crosscue.eval.commands.shared.terminal import (
    add_logs_arguments,
    add_truth_of_runs,
    limits_of,
    metres,
    print_json,
    progress_line,
)
from crosscue.replay.base import CrosscueError, one_line, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options to the parser."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders, or folders of them")
    add_truth_of_runs(parser)
    add_logs_arguments(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for metrics, report and junit.xml, pooled over all runs",
    )
    parser.add_argument(
        "--gate",
        type=Path,
        metavar="G.toml",
        help="file with bounds on metrics; the exit status is 1 when one is violated",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        default=0.9,
        metavar="P",
        help="probability above which a feature counts as detected (default: 0.9)",
    )
    parser.add_argument(
        "--detection",
        choices=("confirmed", "published"),
        default="confirmed",
        help="confirmed: a detection counts when 3 frames confirm it and its range is within its "
        "95 %% interval; published: from the first frame, with any range (default: confirmed)",
    )
    parser.add_argument(
        "--rpe",
        nargs="+",
        type=metres,
        default=[10.0, 100.0],
        metavar="M",
        help="distances of the relative pose error, in metres (default: 10 100)",
    )
    parser.add_argument(
        "--attribution",
        action="store_true",
        help="run an ablation: estimate without each cue, and report the change in every metric",
    )
    parser.add_argument(
        "--smoother",
        choices=("gtsam",),
        help="also run a batch smoother on the same measurements and compare its error",
    )
    parser.add_argument(
        "--workers",
        type=int,
        default=1,
        metavar="N",
        help="number of runs in parallel (default: 1)",
    )
    parser.add_argument(
        "--without-figures",
        dest="has_figures",
        action="store_false",
        help="write a report without figures, which is much faster",
    )
    parser.add_argument(
        "--mlflow",
        metavar="URI",
        help="also log scores, tags and report to the MLflow server or store at this address",
    )
    parser.add_argument(
        "--experiment",
        default="crosscue",
        metavar="NAME",
        help="experiment in MLflow (default: crosscue)",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Score each run, then all together; return 1 for a failed gate, 3 for drops."""
    # Opened first, so that a wrong address is reported before anything is scored.
    sink = None if args.mlflow is None else crosscue.open_mlflow(args.mlflow, args.experiment)
    with progress_line(args, "scoring") as line:

        def on_run(scored: crosscue.ScoredRun) -> None:
            if not (args.json or args.quiet):
                line.end()
                print(scored.headline)

        def on_failed(path: Path, error: CrosscueError) -> None:
            line.end()
            text = visible(one_line(error))
            print(f"crosscue: {text}; this run is left out", file=sys.stderr)

        found = crosscue.score_runs(
            args.runs,
            args.truth,
            args.output,
            gates=args.gate,
            threshold=args.threshold,
            detection=args.detection,
            rpe_m=args.rpe,
            has_attribution=args.attribution,
            has_smoother=args.smoother is not None,
            any_log=args.any_log,
            logs=args.logs,
            without_images=args.without_images,
            has_figures=args.has_figures,
            workers=args.workers,
            limits=limits_of(args),
            on_runs=line.counting("runs"),
            on_run=on_run,
            on_failed=on_failed,
        )
    if args.json:
        print_json(found.as_dict())
    elif not args.quiet:
        print(f"\n{found}" if found.is_many else found)
    if sink is not None:
        sink.log(found)
    if found.has_failed_gate:
        return 1
    return 0 if found.is_whole else 3
