"""Score runs against their truth, each alone and all together, with gates and ablations."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from crosscue.eval.catalog.find_runs import runs_of
from crosscue.eval.pipeline.outcome import MAX_LINES
from crosscue.eval.pipeline.run import Run
from crosscue.eval.report.junit import junit_text
from crosscue.eval.report.opening import judged_sentences
from crosscue.eval.report.summary import (
    gate_lines,
    pose_summary,
    poses_summary,
    reported_line,
    scores_text,
)
from crosscue.eval.runs.account import account_lines
from crosscue.eval.runs.folder import locked
from crosscue.eval.scoring.by_drive import FOLDER
from crosscue.eval.scoring.drives import PooledScores, ScoreSettings
from crosscue.eval.scoring.gates import GateResult, check_gates, load_gates
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.eval.scoring.pose.smoother import smoother_text
from crosscue.eval.scoring.runs import (
    RunScored,
    account_of_scores,
    metrics_of,
    places_of_drives,
    pooled_scores,
)
from crosscue.eval.studies.attribution import (
    AttributedDrive,
    Attribution,
    attribute,
    attribution_lines,
    attribution_tree,
    estimate_of,
)
from crosscue.replay.errors import CrosscueError, UsageError, one_line
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import visible
from crosscue.results import HIDDEN, Result
from crosscue.verb import keywords

from .score import Failed, ScoredRun, ScoringSettings, write_files
from .tracking import open_mlflow


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ScoredRuns(Result):
    """Scores of runs; its text is the output of ``crosscue score``.

    Attributes:
        runs: The scored runs.
        failed: Errors of the runs that could not be scored, by folder.
        metrics: Metrics of all runs together, as in ``metrics.json``.
        scores: The scores that the metrics are computed from.
        gates: Outcome of each gate.
        attribution: Effect of each cue on the scores, if requested.
        report: Page with the scores; None for several runs without ``output``.
    """

    runs: tuple[ScoredRun, ...] = field(metadata=HIDDEN)
    failed: Mapping[Path, CrosscueError] = field(metadata=HIDDEN)
    metrics: Mapping[str, Any]
    scores: PooledScores = field(metadata=HIDDEN)
    gates: tuple[GateResult, ...] = field(metadata=HIDDEN)
    attribution: Mapping[str, Attribution] = field(metadata=HIDDEN)
    report: Path | None = field(metadata=HIDDEN)

    also: ClassVar = {"gates": "gate_outcomes", "runs": "metrics_by_run"}
    max_lines: ClassVar = MAX_LINES

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

    @property
    def exit_status(self) -> int:
        """1 for a failed gate, 3 for runs or rows that were dropped, else 0."""
        if self.has_failed_gate:
            return 1
        return 0 if self.is_whole else 3

    @property
    def gate_outcomes(self) -> list[dict[str, object]]:
        """Each gate with its value, and whether it passed."""
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
            for one in self.gates
        ]

    @property
    def metrics_by_run(self) -> dict[str, Mapping[str, Any]]:
        """Metrics of each run, by its folder."""
        return {str(one.one.run.path): one.metrics for one in self.runs}

    def lines(self) -> Iterator[str]:
        """Yield what was found, then the scores."""
        yield from _lines_together(self) if self.is_many else _lines_of_one(self)

    def brief(self) -> str:
        """Return the text without ``--verbose``: all of it with attribution or smoother."""
        has_more = bool(self.attribution) or any(one.smoothed for one in self.runs)
        return repr(self) if has_more else Result.brief(self)

    def closing(self) -> Iterator[str]:
        """Yield where the scores were written, and the gates."""
        if self.report is not None:
            yield f"written to {visible(str(self.report))}"
        if self.gates:
            yield gate_lines(self.gates)


def _lines_of_one(found: ScoredRuns) -> list[str]:
    (run,) = found.runs
    one = run.one
    lines = [f"run        {visible(str(one.run.path))}"]
    lines += [reported_line("", visible(sentence)) for sentence in judged_sentences(one)]
    lines += [] if found.is_whole else _account(found)
    lines += ["", *_scores(found, one.why_no_pose)]
    if one.pose is not None:
        lines += ["", pose_summary(one.pose)]
    if run.smoothed is not None:
        lines.append(smoother_text(run.smoothed))
    notices = one.run.drive_manifest().notices
    notes = [reported_line("note", visible(text)) for text in notices]
    return [*lines, "", *(_account(found) if found.is_whole else []), *notes]


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
    lines += [] if found.is_whole else [*_account(found), ""]
    lines += _scores(found, why)
    posed = [one for one in ones if one.pose is not None]
    if posed:
        poses = [one.pose for one in posed if one.pose is not None]
        lines += ["", poses_summary(poses, places_of_drives(posed))]
    lines += ["", *(_account(found) if found.is_whole else [])]
    return [*lines, *(run.headline for run in found.runs)]


def _account(found: ScoredRuns) -> list[str]:
    return [visible(line) for line in account_lines(account_of_scores(_ones(found)))]


def _scores(found: ScoredRuns, why_no_pose: str) -> list[str]:
    lines = [scores_text(found.scores, why_no_pose)]
    if found.attribution:
        lines += ["", *attribution_lines(found.attribution)]
    return lines


def _ones(found: ScoredRuns) -> list[RunScored]:
    return [run.one for run in found.runs]


@keywords(ScoringSettings)
def score_runs(runs: Sequence[str | Path | Run], settings: ScoringSettings) -> ScoredRuns:
    """Score runs against truth: metrics, figures, report, gates.

    Metrics and figures of each run are written to RUN/score. Several runs (folders, a folder of
    runs, a quoted pattern, @list.txt) are also scored together, and the pooled result is written to
    the folder of -o. A run that cannot be scored does not stop the rest.

    A gate file (TOML) sets bounds on metrics. The exit status is 1 when a gate fails::

        version = 1
        [[gate]]
        metric = "cues.stop_sign.precision"
        min = 0.9
        use = "low"

    Examples:
        crosscue score runs/A-01 --truth drives/A-01/truth.json
        crosscue score runs -o scored --gate gates.toml --workers 8

    Args:
        runs: Run folders, or folders of them.
        settings: How to score.

    Raises:
        UsageError: A setting is out of range, or the gate file is not valid.
        CrosscueError: No run can be scored; the error of the first.
    """
    # Opened first, so that a wrong address is reported before anything is scored.
    sink = None if settings.mlflow is None else open_mlflow(settings.mlflow, settings.experiment)
    found = _scored(runs, settings)
    if sink is not None:
        for one in found.runs:
            sink.log_run(one)
        if found.is_many:
            name = "all" if found.report is None else found.report.parent.name
            tags = {"crosscue.runs": str(len(found.runs))}
            sink.log(name, found.metrics, tags, found.report)
    return found


def _scored(runs: Sequence[str | Path | Run], settings: ScoringSettings) -> ScoredRuns:
    paths = runs_of([str(one.path if isinstance(one, Run) else one) for one in runs])
    folder = None if settings.output is None else Path(settings.output)
    is_many = len(paths) > 1
    if settings.gates is not None and is_many and folder is None:
        raise UsageError("score: several runs with --gate: add -o DIR, the folder for junit.xml")
    judged_by = settings.judged_by
    bounds = () if settings.gates is None else load_gates(Path(settings.gates))
    scored: list[ScoredRun] = []
    failed: dict[Path, CrosscueError] = {}
    for one in in_processes(settings.attempt, paths, settings.workers):
        if isinstance(one, Failed):
            failed[one.path] = one.error
            if is_many:
                emit(CrosscueError(f"{one_line(one.error)}; this run is left out"))
        else:
            scored.append(one)
        emit(Progress("scoring", len(scored) + len(failed), len(paths), "runs"))
    if not scored:
        raise next(iter(failed.values()))
    found = _together(scored, failed, settings, judged_by)
    if not bounds:
        return found
    tree = found.metrics
    results = check_gates(bounds, metric_values(tree), tree["coverage"]["not_scored"])
    suite = f"{len(paths)} runs" if is_many else str(paths[0])
    place = folder or scored[0].one.run.file(FOLDER)
    write_text(place / "junit.xml", junit_text(results, suite))
    return replace(found, gates=results)


def _together(
    runs: Sequence[ScoredRun],
    failed: Mapping[Path, CrosscueError],
    settings: ScoringSettings,
    judged_by: ScoreSettings,
) -> ScoredRuns:
    """Return the scores of all runs, with the attribution of a single run added to its files."""
    ones = [run.one for run in runs]
    scores = pooled_scores(ones, judged_by)
    is_many = len(runs) + len(failed) > 1
    tree = metrics_of(ones, scores) if is_many else runs[0].metrics
    if is_many:
        tree["coverage"]["failed"] = {str(path): str(error) for path, error in failed.items()}
    worth = _attribution(ones, tree, judged_by) if settings.has_attribution else {}
    report = None if is_many else runs[0].report
    if worth and not is_many:
        with locked(ones[0].run):
            place = ones[0].run.file(FOLDER)
            write_files(place, ones, scores, tree, has_figures=settings.has_figures)
    if settings.output is not None:
        folder = Path(settings.output)
        report = write_files(folder, ones, scores, tree, has_figures=settings.has_figures)
    return ScoredRuns(tuple(runs), failed, tree, scores, (), worth, report)


def _attribution(
    ones: Sequence[RunScored], tree: dict[str, Any], settings: ScoreSettings
) -> dict[str, Attribution]:
    """Return the effect of each cue on the scores, and add it to the metrics."""
    drives = [AttributedDrive(one.judged, one.truth, estimate_of(one.run)) for one in ones]
    found = attribute(drives, settings=settings)
    tree["attribution"] = attribution_tree(found)
    return found
