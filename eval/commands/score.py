"""Score runs against truth: metrics, figures, report, gates.

Every run gets metrics.json and figures in RUN/score. Several runs are scored together as well; the
pooled result goes to the folder given by -o. Without --truth, each run's truth is the truth.json
beside its log.

A gate file (TOML) sets bounds on metrics; a gate that fails makes the exit status 1:
  version = 1
  [[gate]]
  metric = "cues.stop_sign.precision"
  min = 0.9
  use = "low"

examples:
  crosscue score runs/A-01 --truth drives/A-01/truth.json
  crosscue score runs/* -o scored --gate gates.toml
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from crosscue.eval.attribution import (
    Attribution,
    Drive,
    attribute,
    attribution_lines,
    attribution_tree,
    estimate_of,
)
from crosscue.eval.gates import GateResult, check_gates, load_gates
from crosscue.eval.junit import write_junit
from crosscue.eval.metric_values import metric_values
from crosscue.eval.plain_text import visible
from crosscue.eval.report import write_report
from crosscue.eval.score_drives import DEFAULTS, ScoreSettings
from crosscue.eval.score_pose import summary as pose_summary
from crosscue.eval.score_run import (
    FOLDER,
    RunScored,
    find_truth,
    judge_run,
    metrics_of,
    scores_of,
    write_scores,
)
from crosscue.eval.score_summary import gate_lines, headline, summary
from crosscue.eval.smooth_pose import score_smoother, told
from crosscue.replay.errors import UsageError
from crosscue.replay.run_folder import locked, open_run

from .common import print_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run folders")
    parser.add_argument(
        "--truth", type=Path, metavar="T.json",
        help="the truth of all runs (default: the truth.json beside each run's log)",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR",
        help="folder for the pooled metrics and junit.xml of several runs",
    )  # fmt: skip
    parser.add_argument("--gate", type=Path, metavar="G.toml", help="bounds on metrics")
    parser.add_argument(
        "--threshold", type=float, default=DEFAULTS.threshold, metavar="P",
        help="a feature is detected above this probability (default: 0.9)",
    )  # fmt: skip
    parser.add_argument(
        "--rpe", nargs="+", type=_metres, default=[10.0, 100.0], metavar="M",
        help="distances of the relative pose error in metres (default: 10 100)",
    )  # fmt: skip
    parser.add_argument(
        "--attribution", action="store_true",
        help="estimate again with each cue left out, and score what it was worth",
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
    """Score every run, then all together; a failed gate gives 1."""
    if len({path.resolve() for path in args.runs}) != len(args.runs):
        raise UsageError("score: a run is named twice; name each once")
    if args.gate is not None and len(args.runs) > 1 and args.output is None:
        raise UsageError("score: several runs and --gate: say with -o DIR where junit.xml goes")
    try:
        settings = ScoreSettings(threshold=args.threshold)
    except ValueError as error:
        raise UsageError(f"--threshold: {error}") from None
    gates = None if args.gate is None else load_gates(args.gate)
    scored: list[RunScored] = []
    trees: dict[str, dict[str, Any]] = {}
    for path in args.runs:
        one, tree = _score_run(path, settings, args)
        scored.append(one)
        trees[str(path)] = tree
    pooled = trees[str(args.runs[0])] if len(scored) == 1 else _pool(scored, settings, args)
    results: tuple[GateResult, ...] = ()
    if gates is not None:
        results = check_gates(gates, metric_values(pooled), pooled["coverage"]["not_scored"])
        folder = args.output or scored[0].run.file(FOLDER)
        write_junit(folder / "junit.xml", results, " ".join(str(path) for path in args.runs))
    if args.json:
        print_json({"metrics": pooled, "runs": trees, "gates": _as_json(results)})
    elif results and not args.quiet:
        print(gate_lines(results))
    return 1 if any(one.failure for one in results) else 0


def _score_run(
    path: Path, settings: ScoreSettings, args: argparse.Namespace
) -> tuple[RunScored, dict[str, Any]]:
    """Score one run and write its files."""
    folder = open_run(path)
    truth_path = find_truth(folder, args.truth)
    with locked(folder):
        one = judge_run(folder, truth_path, settings, args.rpe)
        scores = scores_of([one], settings)
        tree = metrics_of([one], scores)
        smoothed = None if args.smoother is None else score_smoother(folder, truth_path)
        if smoothed is not None:
            tree["smoother"] = asdict(smoothed)
        # Of several runs it is asked once, of all together.
        worth = {} if len(args.runs) > 1 else _attribution([one], tree, settings, args)
        write_scores(folder.file(FOLDER), [one], tree)
        report = None if one.pose is None else write_report(folder, one.truth.truth, one.pose)
    if args.json or args.quiet:
        return one, tree
    if len(args.runs) > 1:
        print(headline(str(path), metric_values(tree)))
        return one, tree
    print(f"run        {visible(str(path))}")
    print(summary(scores, one.why_no_pose))
    if one.pose is not None:
        print("\n" + pose_summary(one.pose))
    if smoothed is not None:
        print(told(smoothed))
    if worth:
        print("\n" + "\n".join(attribution_lines(worth)))
    print(f"written to {visible(str(report or folder.file(FOLDER)))}")
    return one, tree


def _attribution(
    scored: Sequence[RunScored], tree: dict[str, Any], settings: ScoreSettings,
    args: argparse.Namespace,
) -> dict[str, Attribution]:  # fmt: skip
    """What each cue was worth, also put into the metrics; nothing unless asked for."""
    if not args.attribution:
        return {}
    drives = [Drive(one.judged, one.truth, estimate_of(one.run)) for one in scored]
    found = attribute(drives, settings=settings)
    tree["attribution"] = attribution_tree(found)
    return found


def _pool(
    scored: Sequence[RunScored], settings: ScoreSettings, args: argparse.Namespace
) -> dict[str, Any]:
    """Score all runs together, as pooled in the folder asked for."""
    scores = scores_of(scored, settings)
    tree = metrics_of(scored, scores)
    worth = _attribution(scored, tree, settings, args)
    if args.output is not None:
        write_scores(args.output, scored, tree)
    if not (args.json or args.quiet):
        why = scored[0].why_no_pose if all(one.pose is None for one in scored) else ""
        print("\n" + summary(scores, why))
        if worth:
            print("\n" + "\n".join(attribution_lines(worth)))
        if args.output is not None:
            print(f"written to {visible(str(args.output))}")
    return tree


def _as_json(results: Sequence[GateResult]) -> list[dict[str, Any]]:
    return [
        {"metric": one.gate.metric, "min": one.gate.min, "max": one.gate.max, "use": one.gate.use,
         "value": one.value, "passed": not one.failure, "failure": one.failure}
        for one in results
    ]  # fmt: skip
