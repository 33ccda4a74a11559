"""Score one run, or many in parallel; a run that fails does not stop the others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pyarrow as pa

from crosscue.eval.failures.find import failures_beside_truth
from crosscue.eval.failures.order import diverse
from crosscue.eval.pipeline.run import Run, moved_to, run_given
from crosscue.eval.report.opening import Mistake
from crosscue.eval.report.page import MAX_FRAMES, write_report
from crosscue.eval.report.summary import headline, pose_summary, scores_text
from crosscue.eval.runs.folder import locked, open_run
from crosscue.eval.scoring.by_drive import FOLDER
from crosscue.eval.scoring.drives import PooledScores, ScoreSettings
from crosscue.eval.scoring.files import curve_table, write_scores
from crosscue.eval.scoring.metric_values import metric_values
from crosscue.eval.scoring.pose.score import load_truth
from crosscue.eval.scoring.pose.smoother import SmootherScore, score_smoother
from crosscue.eval.scoring.runs import (
    RunScored,
    SceneJudged,
    find_truth,
    judge_run,
    metrics_of,
    pooled_scores,
    remember_truth,
    smoothed_ranges,
)
from crosscue.eval.scoring.scene.detection import Definition
from crosscue.replay.errors import CrosscueError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, LimitsGiven
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True)
class Failed:
    """A run that could not be scored.

    Attributes:
        path: Its folder.
        error: The error.
    """

    path: Path
    error: CrosscueError


@dataclass(frozen=True, slots=True)
class ScoringSettings:
    """Settings of the scores of runs; called with a run, they score it.

    Attributes:
        truth: Truth of all runs (default: that of each run's last score, or truth.json next to
            its log).
        output: Folder for metrics, report and junit.xml, pooled over all runs.
        gates: File with bounds on metrics; the exit status is 1 when one is violated.
        threshold: Probability above which a feature counts as detected.
        detection: Confirmed: a detection counts when 3 frames confirm it and its range is within
            its 95 % interval; published: from the first frame, with any range.
        has_attribution: Run an ablation: estimate without each cue, and report the change in every
            metric.
        smoother: Also run a batch smoother on the same measurements and compare its error.
        any_log: Accept truth made for another file of the same drive, such as a converted log.
        logs: Folder that the run's logs have moved to; they are recognised by content.
        without_images: Leave out camera images, so the run's logs are not needed.
        limits: Limits for reading the runs' logs.
        has_figures: Write a report without figures, which is much faster.
        workers: Number of runs in parallel.
        mlflow: Also log scores, tags and report to the MLflow server or store at this address.
        experiment: Experiment in MLflow.
    """

    truth: Path | str | None = None
    output: Path | str | None = None
    _: KW_ONLY
    gates: Annotated[Path | str | None, Option("--gate", metavar="G.toml")] = None
    threshold: float = 0.9
    detection: Definition = "confirmed"
    has_attribution: bool = False
    smoother: bool = False
    any_log: bool = False
    logs: Annotated[Path | str | None, Option(metavar="DIR")] = None
    without_images: bool = False
    limits: LimitsGiven = DEFAULT_LIMITS
    has_figures: bool = True
    workers: int = 1
    mlflow: Annotated[str | None, Option(metavar="URI")] = None
    experiment: str = "crosscue"

    def __post_init__(self) -> None:
        """Check numbers.

        Raises:
            UsageError: A number is out of range.
        """
        if self.workers < 1:
            raise UsageError(f"workers: {self.workers}, expected 1 or more")

    @property
    def judged_by(self) -> ScoreSettings:
        """The part of the settings that the scores depend on.

        Raises:
            UsageError: A value is out of range.
        """
        try:
            return ScoreSettings(threshold=self.threshold, detection=self.detection)
        except ValueError as error:
            raise UsageError(f"score: {error}") from None

    def __call__(self, path: Path) -> ScoredRun:
        """Score one run and write its files.

        Raises:
            CrosscueError: The run cannot be scored.
        """
        judged_by, logs = self.judged_by, moved_to(self.logs)
        folder = open_run(path, logs, without_images=self.without_images, limits=self.limits)
        truth_path = find_truth(folder, None if self.truth is None else Path(self.truth))
        with locked(folder):
            one = judge_run(folder, truth_path, judged_by, any_log=self.any_log)
            scores = pooled_scores([one], judged_by)
            metrics = metrics_of([one], scores)
            smoothed = None
            if self.smoother:
                smoothed = score_smoother(folder, truth_path, smoothed_ranges(one))
                metrics["smoother"] = asdict(smoothed)
            report = write_files(
                folder.file(FOLDER), [one], scores, metrics, has_figures=self.has_figures
            )
            remember_truth(folder, truth_path, any_log=self.any_log)
        return ScoredRun(one, metrics, report, smoothed)

    def attempt(self, path: Path) -> ScoredRun | Failed:
        """Score one run; return a ``CrosscueError`` as a result."""
        try:
            return self(path)
        except CrosscueError as error:
            return Failed(path, error)


def write_files(
    place: Path,
    ones: Sequence[RunScored],
    scores: PooledScores,
    metrics: Mapping[str, Any],
    *,
    has_figures: bool,
) -> Path:
    """Write the report and the metrics of one run or many into ``place``.

    Returns:
        The report's path.
    """
    mistakes = mistakes_of(ones, scores.settings.threshold)
    report = write_report(place, ones, scores, metrics, mistakes, has_figures=has_figures)
    write_scores(place, ones, metrics)
    return report


def mistakes_of(ones: Sequence[RunScored], threshold: float) -> list[Mistake]:
    """Return the failures that a report shows: the worst of each kind, cause and run."""
    found = [
        failure
        for one in ones
        if one.run.file("frames.parquet").exists()
        for failure in failures_beside_truth(one.run, SceneJudged(one.truth, one.judged), threshold)
    ]
    return [
        Mistake(one.run, one.t_ns, one.at_s, one.kind, one.what, f"{one.cause}: {one.reported}")
        for one in diverse(found, MAX_FRAMES)
    ]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ScoredRun(Result):
    """Scores of a run; its text is the output of ``crosscue score``.

    Attributes:
        one: The run, compared with its truth.
        metrics: Contents of its ``metrics.json``.
        report: Page with the scores.
        smoothed: Comparison of smoothers with the filters, if requested.
    """

    one: RunScored = field(metadata=HIDDEN)
    metrics: dict[str, Any]
    report: Path
    smoothed: SmootherScore | None = None

    @property
    def headline(self) -> str:
        """Folder and most important numbers, in one line."""
        return headline(str(self.one.run.path), metric_values(self.metrics))

    @property
    def cues(self) -> pa.Table:
        """Precision and recall of each cue with 95 % intervals, and the rule it is judged by."""
        rows = []
        for name, cue in pooled_scores([self.one]).cues.items():
            row: dict[str, object] = {"cue": name}
            for what, fraction in (("precision", cue.precision), ("recall", cue.recall)):
                row |= {
                    what: None if fraction is None else fraction.value,
                    f"{what}_low": None if fraction is None else fraction.low,
                    f"{what}_high": None if fraction is None else fraction.high,
                    f"{what}_of": 0 if fraction is None else fraction.of,
                }
            rows.append(row)
        return pa.Table.from_pylist(rows)

    @property
    def curves(self) -> pa.Table:
        """Probability of each feature and true distance, one row per step."""
        return curve_table([self.one.judged])

    @property
    def true_track(self) -> pa.Table:
        """True positions over time, in the columns t_ns, x_m, y_m, z_m.

        Raises:
            SchemaError: The truth has no positions.
        """
        _, track = load_truth(self.one.truth_path)
        columns = {f"{axis}_m": track.xyz_m[:, i] for i, axis in enumerate("xyz")}
        return pa.table({"t_ns": track.t_ns, **columns})

    def lines(self) -> Iterator[str]:
        """Yield the scores of cues, approaches and ranges, and of the pose."""
        yield scores_text(pooled_scores([self.one]), self.one.why_no_pose)
        if self.one.pose is not None:
            yield ""
            yield pose_summary(self.one.pose)


def score_run(
    run: Run | Path | str,
    truth: Path | str | None = None,
    *,
    threshold: float = 0.9,
    detection: Definition = "confirmed",
    any_log: bool = False,
    has_figures: bool = True,
) -> ScoredRun:
    """Score a run against its truth; write metrics, figures and report to ``RUN/score``.

    Args:
        run: A finished run.
        truth: Its truth; None for that of its last score, or the ``truth.json`` next to its log.
        threshold: Probability above which a feature counts as detected.
        detection: ``confirmed``: a detection counts when three frames confirm it and its range is
            within its 95 % interval; ``published``: from the first frame, with any range.
        any_log: Accept truth made for another file of the same drive, such as a converted log.
        has_figures: Draw figures, which needs matplotlib.

    Raises:
        SchemaError: The truth does not fit the run.
        UsageError: No truth is passed, and there is no truth next to the log.
    """
    of = run_given(run)
    settings = ScoringSettings(
        truth,
        threshold=threshold,
        detection=detection,
        any_log=any_log,
        logs=of.folder.logs,
        limits=of.folder.limits,
        has_figures=has_figures,
    )
    return settings(of.path)
