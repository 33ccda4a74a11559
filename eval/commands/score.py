"""Score runs against truth: metrics, figures and a report in RUN/score.

example:
  crosscue truth comma2k19/SEGMENT -o truth
  crosscue score runs/drive --truth truth/truth.json
"""

from __future__ import annotations

import argparse
import math
from dataclasses import asdict
from pathlib import Path

from crosscue.eval.report import write_report
from crosscue.eval.score_pose import PoseScore, load_truth, score, summary
from crosscue.eval.smooth_pose import SmootherScore, score_smoother, told
from crosscue.replay.errors import UsageError
from crosscue.replay.run_folder import RunFolder, locked, open_run

from .common import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="RUN", help="run folders of one drive"
    )
    parser.add_argument("--truth", required=True, type=Path, metavar="T.json", help="the truth")
    parser.add_argument(
        "--rpe", nargs="+", type=_metres, default=[10.0, 100.0], metavar="M",
        help="distances of the relative error in metres (default: 10 100)",
    )  # fmt: skip
    parser.add_argument(
        "--smoother", choices=("gtsam",),
        help="beside the filter, a batch smoother over the same measurements",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the metrics as JSON")


def _metres(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(text)
    return value


def run(args: argparse.Namespace) -> int:
    """Score every run; the report's path is named last."""
    truth, _ = load_truth(args.truth)
    if len({path.resolve() for path in args.runs}) != len(args.runs):
        raise UsageError("score: a run is named twice; name each once")
    results: dict[str, PoseScore] = {}
    smoothers: dict[str, SmootherScore | None] = {}
    for path in args.runs:
        folder = open_run(path)
        with locked(folder):
            result = score(folder, args.truth, args.rpe)
            report = write_report(folder, truth, result)
            smoothed = _smoothed(folder, args)
        results[str(path)] = result
        smoothers[str(path)] = smoothed
        if not args.json and not args.quiet:
            print(f"run        {path}")
            print(summary(result))
            if smoothed is not None:
                print(told(smoothed))
            print(f"report     {report}")
    if args.json:
        print_json({path: _as_json(result, smoothers[path]) for path, result in results.items()})
    return 0


def _smoothed(folder: RunFolder, args: argparse.Namespace) -> SmootherScore | None:
    return None if args.smoother is None else score_smoother(folder, args.truth)


def _as_json(result: PoseScore, smoothed: SmootherScore | None) -> dict[str, object]:
    beside = {} if smoothed is None else {"smoother": asdict(smoothed)}
    return asdict(result) | beside
