"""Many runs scored, side by side if asked; one that fails does not stop the rest."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from crosscue.eval.runs.folder import RunFolder, locked, open_run
from crosscue.eval.scoring.drives import ScoreSettings
from crosscue.eval.scoring.pose.score import PoseScore, load_truth, measure
from crosscue.eval.scoring.pose.smoother import SmootherScore, score_smoother
from crosscue.eval.scoring.runs import (
    FOLDER,
    METRICS,
    RunScored,
    find_truth,
    judge_run,
    metrics_of,
    scores_of,
    write_scores,
)
from crosscue.replay.base import DEFAULT_LIMITS, CrosscueError, Limits, strict_json, write_text
from crosscue.replay.processes import in_processes

from .page import write_report
from .pose_figures import draw_all
from .worst_frames import worst_frames


@dataclass(frozen=True, slots=True)
class Scored:
    """A run that was scored, its files written.

    Attributes:
        one: Laid beside its truth.
        metrics: What its ``metrics.json`` holds.
        report: Its page.
        smoothed: The batch smoother beside the filter, if asked for.
    """

    one: RunScored
    metrics: dict[str, Any]
    report: Path
    smoothed: SmootherScore | None


@dataclass(frozen=True, slots=True)
class Failed:
    """A run that could not be scored.

    Attributes:
        path: Its folder.
        error: What would have ended the command for this run alone.
    """

    path: Path
    error: CrosscueError


@dataclass(frozen=True, slots=True)
class ScoreWork:
    """What is done for one run, here or in another process.

    Attributes:
        truth: The truth of all runs, or None for the one beside each run's log.
        settings: Of the scores.
        rpe_m: Distances of the relative pose error.
        has_smoother: Run the batch smoother as well?
        any_log: Take truth that names the hash of another file?
        logs: Where the runs' logs have moved to, if they have.
        limits: What the runs' logs are read with.
        has_figures: Draw figures into the report?
        without_images: Report without pictures of the worst frames, whose logs may be gone?
    """

    truth: Path | None
    settings: ScoreSettings
    rpe_m: tuple[float, ...]
    has_smoother: bool = False
    any_log: bool = False
    logs: Path | None = None
    limits: Limits = DEFAULT_LIMITS
    has_figures: bool = True
    without_images: bool = False

    def __call__(self, path: Path) -> Scored:
        """Score one run and write its files.

        Raises:
            CrosscueError: It cannot be scored.
        """
        folder = open_run(path, self.logs, without_images=self.without_images, limits=self.limits)
        truth_path = find_truth(folder, self.truth)
        with locked(folder):
            one = judge_run(folder, truth_path, self.settings, self.rpe_m, any_log=self.any_log)
            scores = scores_of([one], self.settings)
            metrics = metrics_of([one], scores)
            smoothed = score_smoother(folder, truth_path) if self.has_smoother else None
            if smoothed is not None:
                metrics["smoother"] = asdict(smoothed)
            # First what may lack pictures: then nothing is written.
            worst = worst_frames([one])
            report = write_report(
                folder.file(FOLDER), [one], scores, metrics, worst, has_figures=self.has_figures
            )
            write_scores(folder.file(FOLDER), [one], metrics)
        return Scored(one, metrics, report, smoothed)

    def attempt(self, path: Path) -> Scored | Failed:
        """Score one run; an error of ours becomes a result."""
        try:
            return self(path)
        except CrosscueError as error:
            return Failed(path, error)


def score_pose(run: RunFolder, truth_path: Path) -> PoseScore:
    """Score a run's pose alone; metrics, tracks and figures go into its ``score`` folder.

    Raises:
        RunError: The run's tables are missing or damaged.
        SchemaError: The truth does not fit the run.
    """
    truth, _ = load_truth(truth_path)
    result, poses = measure(run, truth_path)
    content = {"truth": truth.model_dump(mode="json"), "pose": asdict(result)}
    write_text(run.file(FOLDER) / METRICS, strict_json(content) + "\n")
    draw_all(poses, run.file(FOLDER))
    return result


def score_runs(
    paths: Sequence[Path], work: ScoreWork, workers: int = 1
) -> Iterator[Scored | Failed]:
    """Score runs, in order; with several workers in as many processes."""
    return in_processes(work.attempt, paths, workers)
