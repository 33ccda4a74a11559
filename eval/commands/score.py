"""Score runs against truth: metrics, figures, report, gates.

Every run gets metrics.json and figures in RUN/score. Several runs (folders, a folder of runs, a
quoted pattern, @list.txt) are scored together as well; the pooled result goes to the folder given
by -o. A run that cannot be scored does not stop the rest. Without --truth, each run's truth is the
truth.json beside its log.

A gate file (TOML) sets bounds on metrics; a gate that fails makes the exit status 1:
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.commands.shared.options import (
    add_logs_arguments,
    limits_of,
    metres,
    print_json,
)
from crosscue.eval.commands.shared.progress import Done, with_progress
from crosscue.eval.report.junit import write_junit
from crosscue.eval.report.page import REPORT, write_report
from crosscue.eval.report.score_runs import Failed, Scored, ScoreWork, score_runs
from crosscue.eval.report.summary import gate_lines, headline, pose_summary, reported_line, summary
from crosscue.eval.runs.account import account_lines
from crosscue.eval.runs.folder import locked
from crosscue.eval.scoring.drives import DEFAULTS, Scores, ScoreSettings
from crosscue.eval.scoring.gates import Gate, GateResult, check_gates, load_gates
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.eval.scoring.pose.smoother import smoother_text
from crosscue.eval.scoring.runs import (
    FOLDER,
    RunScored,
    account_of_scores,
    metrics_of,
    scores_of,
    write_scores,
)
from crosscue.eval.studies.attribution import (
    Attribution,
    Drive,
    attribute,
    attribution_lines,
    attribution_tree,
)
from crosscue.eval.studies.estimated_again import estimate_of
from crosscue.replay.base import UsageError, one_line, visible


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare flags."""
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders, or folders of them")
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="T.json",
        help="truth of all runs (default: truth.json beside each run's log)",
    )
    parser.add_argument(
        "--any-log",
        action="store_true",
        help="accept truth made for another file of the same drive, such as a converted log",
    )
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
        help="file of bounds on metrics; exit with 1 when one is violated",
    )
    parser.add_argument(
        "--threshold",
        type=float,
        default=DEFAULTS.threshold,
        metavar="P",
        help="probability above which a feature counts as detected (default: 0.9)",
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
        help="run an ablation: estimate without each cue and report the change in every metric",
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
        help="write a report without figures, in a fraction of the time",
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def run(args: argparse.Namespace) -> int:
    """Score every run, then all together; 1 for a failed gate, 3 when anything was dropped."""
    paths = runs_of(args.runs)
    if args.gate is not None and len(paths) > 1 and args.output is None:
        raise UsageError("score: several runs and --gate: say with -o DIR where junit.xml goes")
    if args.workers < 1:
        raise UsageError(f"--workers {args.workers}: want 1 or more")
    try:
        settings = ScoreSettings(threshold=args.threshold)
    except ValueError as error:
        raise UsageError(f"--threshold: {error}") from None
    gates = () if args.gate is None else load_gates(args.gate)
    work = ScoreWork(
        args.truth,
        settings,
        tuple(args.rpe),
        args.smoother is not None,
        args.any_log,
        args.logs,
        limits_of(args),
        args.has_figures,
        args.without_images,
    )
    scored, failed = _score_all(paths, work, args)
    if len(paths) == 1:
        tree = _report_one(scored[0], settings, args)
    else:
        tree = _pool(scored, failed, settings, args)
    results = _gate(gates, tree, args.output or scored[0].one.run.file(FOLDER), paths)
    if args.json:
        print_json(
            {
                "metrics": tree,
                "gates": _as_json(results),
                "runs": {str(one.one.run.path): one.metrics for one in scored},
            }
        )
    elif results and not args.quiet:
        print(gate_lines(results))
    if any(one.failure for one in results):
        return 1
    return 3 if failed or not tree["account"]["is_whole"] else 0


def _score_all(
    paths: Sequence[Path], work: ScoreWork, args: argparse.Namespace
) -> tuple[list[Scored], list[Failed]]:
    """All that can be scored; if nothing can, the first error ends the command."""
    scored: list[Scored] = []
    failed: list[Failed] = []

    def at() -> Done:
        return Done(len(scored) + len(failed), len(paths), "runs")

    for one in with_progress(score_runs(paths, work, args.workers), at, args, "scoring"):
        if isinstance(one, Scored):
            scored.append(one)
            if len(paths) > 1 and not (args.json or args.quiet):
                print(headline(str(one.one.run.path), metric_values(one.metrics)))
            continue
        failed.append(one)
        if len(paths) > 1:
            line = visible(one_line(one.error))
            print(f"crosscue: {line}; this run is left out", file=sys.stderr)
    if not scored:
        raise failed[0].error
    return scored, failed


def _report_one(found: Scored, settings: ScoreSettings, args: argparse.Namespace) -> dict[str, Any]:
    """Print one run's scores; its metrics come back."""
    one = found.one
    scores = scores_of([one], settings)
    worth = _attribution([found], found.metrics, settings, args)
    report = found.report
    if worth:
        with locked(one.run):
            _report(one.run.file(FOLDER), [one], scores, found.metrics, args)
            write_scores(one.run.file(FOLDER), [one], found.metrics)
    if args.output is not None:
        report = _report(args.output, [one], scores, found.metrics, args)
        write_scores(args.output, [one], found.metrics)
    if args.json or args.quiet:
        return found.metrics
    print(f"run        {visible(str(one.run.path))}")
    print("\n".join(map(visible, account_lines(account_of_scores([one])))) + "\n")
    _print_scores(scores, one.why_no_pose, worth)
    if one.pose is not None:
        print("\n" + pose_summary(one.pose))
    if found.smoothed is not None:
        print(smoother_text(found.smoothed))
    print(f"written to {visible(str(report))}")
    return found.metrics


def _report(
    folder: Path,
    scored: Sequence[RunScored],
    scores: Scores,
    metrics: dict[str, Any],
    args: argparse.Namespace,
) -> Path:
    return write_report(folder, scored, scores, metrics, has_figures=args.has_figures)


def _print_scores(scores: Scores, why_no_pose: str, worth: dict[str, Attribution]) -> None:
    print(summary(scores, why_no_pose))
    if worth:
        print("\n" + "\n".join(attribution_lines(worth)))


def _attribution(
    scored: Sequence[Scored],
    tree: dict[str, Any],
    settings: ScoreSettings,
    args: argparse.Namespace,
) -> dict[str, Attribution]:
    """What each cue was worth, also put into the metrics; nothing unless asked for."""
    if not args.attribution:
        return {}
    ones = [found.one for found in scored]
    drives = [Drive(one.judged, one.truth, estimate_of(one.run)) for one in ones]
    found = attribute(drives, settings=settings)
    tree["attribution"] = attribution_tree(found)
    return found


def _pool(
    scored: Sequence[Scored],
    failed: Sequence[Failed],
    settings: ScoreSettings,
    args: argparse.Namespace,
) -> dict[str, Any]:
    """Score all runs together, into the folder asked for."""
    ones = [found.one for found in scored]
    scores = scores_of(ones, settings)
    tree = metrics_of(ones, scores)
    tree["coverage"]["failed"] = {str(one.path): str(one.error) for one in failed}
    worth = _attribution(scored, tree, settings, args)
    if args.output is not None:
        _report(args.output, ones, scores, tree, args)
        write_scores(args.output, ones, tree)
    if args.json or args.quiet:
        return tree
    print()
    if failed:
        print(f"failed     {len(failed)} of {len(failed) + len(scored)} runs, left out")
    for first, second in tree["coverage"].get("same_log", ()):
        names = f"{visible(first)} and {visible(second)}"
        print(reported_line("twice", f"{names} are runs of one log, which therefore counts twice"))
    print("\n".join(map(visible, account_lines(account_of_scores(ones)))) + "\n")
    why = ones[0].why_no_pose if all(one.pose is None for one in ones) else ""
    _print_scores(scores, why, worth)
    if args.output is not None:
        print(f"written to {visible(str(args.output / REPORT))}")
    return tree


def _gate(
    gates: Sequence[Gate], tree: dict[str, Any], folder: Path, paths: Sequence[Path]
) -> tuple[GateResult, ...]:
    """Hold the gates against the metrics and write ``junit.xml``; nothing without gates."""
    if not gates:
        return ()
    results = check_gates(gates, metric_values(tree), tree["coverage"]["not_scored"])
    suite = str(paths[0]) if len(paths) == 1 else f"{len(paths)} runs"
    write_junit(folder / "junit.xml", results, suite)
    return results


def _as_json(results: Sequence[GateResult]) -> list[dict[str, Any]]:
    return [
        {
            "metric": one.gate.metric,
            "min": one.gate.min,
            "max": one.gate.max,
            "use": one.gate.use,
            "value": one.value,
            "passed": not one.failure,
            "failure": one.failure,
        }
        for one in results
    ]
