"""Score runs against their truth, each alone and all together, with gates and ablations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.interface.runs.score import (
    Failed,
    ScoredRun,
    ScoreWork,
    score_each,
    settings_given,
    write_files,
)
from crosscue.eval.pipeline.run import Run, moved_to
from crosscue.eval.report.junit import write_junit
from crosscue.eval.report.summary import (
    gate_lines,
    pose_summary,
    poses_summary,
    reported_line,
    summary,
)
from crosscue.eval.runs.folder import account_lines, locked
from crosscue.eval.scoring.drives import Scores, ScoreSettings
from crosscue.eval.scoring.files import FOLDER
from crosscue.eval.scoring.gates import GateResult, check_gates, load_gates
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.eval.scoring.pose.smoother import smoother_text
from crosscue.eval.scoring.runs import RunScored, account_of_scores, metrics_of, scores_of
from crosscue.eval.studies.attribution import (
    Attribution,
    Drive,
    attribute,
    attribution_lines,
    attribution_tree,
)
from crosscue.eval.studies.estimated_again import estimate_of
from crosscue.replay.base import DEFAULT_LIMITS, CrosscueError, Limits, UsageError, visible


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ScoredRuns:
    """Scores of runs; its repr is the output of ``crosscue score``.

    Attributes:
        runs: The scored runs.
        failed: Errors of the runs that could not be scored, by folder.
        metrics: Metrics of all runs together, as in ``metrics.json``.
        scores: The scores that the metrics are computed from.
        gates: Outcome of each gate.
        attribution: Effect of each cue on the scores, if requested.
        report: Page with the scores; None for several runs without ``output``.
    """

    runs: tuple[ScoredRun, ...]
    failed: Mapping[Path, CrosscueError]
    metrics: Mapping[str, Any]
    scores: Scores
    gates: tuple[GateResult, ...]
    attribution: Mapping[str, Attribution]
    report: Path | None

    @property
    def is_many(self) -> bool:
        """True if several runs were to be scored."""
        return len(self.runs) + len(self.failed) > 1

    @property
    def is_whole(self) -> bool:
        """True if every run was scored, and nothing was dropped in any."""
        return not self.failed and bool(self.metrics["account"]["is_whole"])

    @property
    def has_failed_gate(self) -> bool:
        """True if a metric violates a bound."""
        return any(one.failure for one in self.gates)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue score``."""
        return {
            "metrics": self.metrics,
            "gates": [
                {
                    "metric": one.gate.metric,
                    "min": one.gate.min,
                    "max": one.gate.max,
                    "use": one.gate.use,
                    "value": one.value,
                    "passed": not one.failure,
                    "failure": one.failure,
                }
                for one in self.gates
            ],
            "runs": {str(one.scored.one.run.path): one.metrics for one in self.runs},
        }

    def __repr__(self) -> str:
        lines = _lines_together(self) if self.is_many else _lines_of_one(self)
        if self.report is not None:
            lines.append(f"written to {visible(str(self.report))}")
        if self.gates:
            lines.append(gate_lines(self.gates))
        return "\n".join(lines)


def _lines_of_one(found: ScoredRuns) -> list[str]:
    (run,) = found.runs
    one = run.scored.one
    lines = [f"run        {visible(str(one.run.path))}", *_account(found)]
    lines += [reported_line("note", visible(text)) for text in one.run.drive_manifest().notices]
    lines.append("")
    lines += _scores(found, one.why_no_pose)
    if one.pose is not None:
        lines += ["", pose_summary(one.pose)]
    if run.scored.smoothed is not None:
        lines.append(smoother_text(run.scored.smoothed))
    return lines


def _lines_together(found: ScoredRuns) -> list[str]:
    lines = []
    if found.failed:
        every = len(found.failed) + len(found.runs)
        lines.append(f"failed     {len(found.failed)} of {every} runs, left out")
    if same := found.metrics["coverage"].get("same_log", ()):
        first, second = map(visible, same[0])
        more = f" (and {len(same) - 1} pairs more)" if len(same) > 1 else ""
        text = f"{first} and {second} are runs of one log{more}: each run counts"
        lines.append(reported_line("twice", text))
    ones = _ones(found)
    why = ones[0].why_no_pose if all(one.pose is None for one in ones) else ""
    lines += [*_account(found), "", *_scores(found, why)]
    poses = [one.pose for one in ones if one.pose is not None]
    return [*lines, "", poses_summary(poses)] if poses else lines


def _account(found: ScoredRuns) -> list[str]:
    return [visible(line) for line in account_lines(account_of_scores(_ones(found)))]


def _scores(found: ScoredRuns, why_no_pose: str) -> list[str]:
    lines = [summary(found.scores, why_no_pose)]
    if found.attribution:
        lines += ["", *attribution_lines(found.attribution)]
    return lines


def _ones(found: ScoredRuns) -> list[RunScored]:
    return [run.scored.one for run in found.runs]


def score_runs(
    runs: Sequence[Run | Path | str],
    truth: Path | str | None = None,
    output: Path | str | None = None,
    *,
    gates: Path | str | None = None,
    threshold: float = 0.9,
    detection: Literal["confirmed", "published"] = "confirmed",
    rpe_m: Sequence[float] = (10.0, 100.0),
    has_attribution: bool = False,
    has_smoother: bool = False,
    any_log: bool = False,
    logs: Path | str | None = None,
    without_images: bool = False,
    has_figures: bool = True,
    workers: int = 1,
    limits: Limits = DEFAULT_LIMITS,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
    on_run: Callable[[ScoredRun], None] = lambda scored: None,
    on_failed: Callable[[Path, CrosscueError], None] = lambda path, error: None,
) -> ScoredRuns:
    """Score runs against their truth, each alone and all together.

    Metrics, figures and report of each run are written to ``RUN/score``. A run that cannot be
    scored does not stop the others.

    Args:
        runs: Run folders, folders of runs, patterns, or ``@list.txt``.
        truth: Truth of all runs; None for the ``truth.json`` next to each run's log.
        output: Folder for metrics and report of all runs together.
        gates: File with bounds on metrics; ``junit.xml`` is written to ``output``.
        threshold: Probability above which a feature counts as detected.
        detection: As in ``score_run``.
        rpe_m: Distances of the relative pose error.
        has_attribution: Run an ablation: estimate without each cue, and report the effect.
        has_smoother: Also run a batch smoother on the same measurements (needs gtsam).
        any_log: Accept truth made for another file of the same drive, such as a converted log.
        logs: Folder that the runs' logs have moved to.
        without_images: Omit pictures from the report, so that logs are not needed.
        has_figures: Draw figures, which needs matplotlib.
        workers: Number of runs to score in parallel.
        limits: Limits for reading the runs' logs.
        on_runs: Called with the number of runs done, and their total.
        on_run: Called with each of several runs after it is scored.
        on_failed: Called with the folder and the error of each of several runs that fail.

    Raises:
        UsageError: A setting is out of range, or the gate file is not valid.
        CrosscueError: No run can be scored; the error of the first.
    """
    paths = runs_of([str(one.path if isinstance(one, Run) else one) for one in runs])
    folder = None if output is None else Path(output)
    if gates is not None and len(paths) > 1 and folder is None:
        raise UsageError("score: several runs with --gate: add -o DIR, the folder for junit.xml")
    if workers < 1:
        raise UsageError(f"--workers {workers}: expected 1 or more")
    settings = settings_given(threshold, detection)
    bounds = () if gates is None else load_gates(Path(gates))
    work = ScoreWork(
        None if truth is None else Path(truth),
        settings,
        tuple(rpe_m),
        has_smoother,
        any_log,
        moved_to(logs),
        limits,
        has_figures,
        without_images,
    )
    scored: list[ScoredRun] = []
    failed: dict[Path, CrosscueError] = {}
    is_many = len(paths) > 1
    for one in score_each(paths, work, workers):
        if isinstance(one, Failed):
            failed[one.path] = one.error
            if is_many:
                on_failed(one.path, one.error)
        else:
            scored.append(ScoredRun(one, one.metrics, one.report))
            if is_many:
                on_run(scored[-1])
        on_runs(len(scored) + len(failed), len(paths))
    if not scored:
        raise next(iter(failed.values()))
    together = _pool if is_many else _one
    found = together(scored, failed, settings, folder, has_attribution, has_figures)
    if not bounds:
        return found
    tree = found.metrics
    results = check_gates(bounds, metric_values(tree), tree["coverage"]["not_scored"])
    suite = f"{len(paths)} runs" if is_many else str(paths[0])
    place = folder or scored[0].scored.one.run.file(FOLDER)
    write_junit(place / "junit.xml", results, suite)
    return replace(found, gates=results)


def _one(
    runs: Sequence[ScoredRun],
    failed: Mapping[Path, CrosscueError],
    settings: ScoreSettings,
    output: Path | None,
    has_attribution: bool,
    has_figures: bool,
) -> ScoredRuns:
    """Return the scores of one run, with the attribution added to its files."""
    (run,) = runs
    one, metrics, report = run.scored.one, run.scored.metrics, run.report
    scores = scores_of([one], settings)
    worth = _attribution([one], metrics, settings) if has_attribution else {}
    if worth:
        with locked(one.run):
            write_files(one.run.file(FOLDER), [one], scores, metrics, has_figures=has_figures)
    if output is not None:
        report = write_files(output, [one], scores, metrics, has_figures=has_figures)
    return ScoredRuns(tuple(runs), failed, metrics, scores, (), worth, report)


def _pool(
    runs: Sequence[ScoredRun],
    failed: Mapping[Path, CrosscueError],
    settings: ScoreSettings,
    output: Path | None,
    has_attribution: bool,
    has_figures: bool,
) -> ScoredRuns:
    """Return the scores of all runs together, written to ``output`` if it is not None."""
    ones = [run.scored.one for run in runs]
    scores = scores_of(ones, settings)
    tree = metrics_of(ones, scores)
    tree["coverage"]["failed"] = {str(path): str(error) for path, error in failed.items()}
    worth = _attribution(ones, tree, settings) if has_attribution else {}
    report = None
    if output is not None:
        report = write_files(output, ones, scores, tree, has_figures=has_figures)
    return ScoredRuns(tuple(runs), failed, tree, scores, (), worth, report)


def _attribution(
    ones: Sequence[RunScored], tree: dict[str, Any], settings: ScoreSettings
) -> dict[str, Attribution]:
    """Return the effect of each cue on the scores, and add it to the metrics."""
    drives = [Drive(one.judged, one.truth, estimate_of(one.run)) for one in ones]
    found = attribute(drives, settings=settings)
    tree["attribution"] = attribution_tree(found)
    return found
