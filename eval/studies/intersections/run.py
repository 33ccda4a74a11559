"""Repeat the published experiment on simulated drives, and compare with its results."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar, Final

from crosscue.datasets.truth.truth import FILE
from crosscue.detectors.registry import check, chosen
from crosscue.eval.batch.jobs import JobOutcome, exit_status_of
from crosscue.eval.batch.ray_jobs import engine_of
from crosscue.eval.fit.annotated_runs import annotated_approaches, graph_of_runs
from crosscue.eval.pipeline.detecting import choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import open_run
from crosscue.eval.scoring.drives import DriveJudged, ScoreSettings, pool_scores, score_drive
from crosscue.eval.scoring.runs import RunScored, judge_run
from crosscue.eval.scoring.scene.belief import compare_belief
from crosscue.eval.studies.attribution import AttributedDrive, attribute, estimate_of
from crosscue.eval.studies.simulated_drives import run_drives
from crosscue.eval.studies.study import StudyResult
from crosscue.fusion.fit.message_fit import fit_messages
from crosscue.replay.errors import RunError
from crosscue.replay.vehicle.fusion import Calibrated
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .report import SHEET, TABLES, StudyScores, write_study
from .settings import IntersectionStudy

# Settings of scores that are compared with the published distances.
AS_PUBLISHED: Final = ScoreSettings(detection="published")
# Min number of intersections, so that messages are learned at two others or more.
MIN_PLACES: Final = 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class IntersectionResult(StudyResult):
    """Results of the simulated experiment; its repr is tables with the published numbers.

    Attributes:
        drives: Outcome of each drive.
        scored: Scores of distances, cues and beliefs, and of the ablation of each cue.
    """

    drives: tuple[JobOutcome[Outcome], ...] = field(metadata=HIDDEN)
    scored: StudyScores = field(metadata=HIDDEN)

    files: ClassVar = {TABLES: "tables", SHEET: "pictures: a frame of each drive, with detections"}

    @property
    def exit_status(self) -> int:
        """0 if all drives are complete; 3 if a drive failed or something was dropped."""
        return exit_status_of(self.drives)


def run_intersection_study(
    study: IntersectionStudy,
    output: Path | str,
    *,
    workers: int = 1,
    ray: str | None = None,
    attribution: Annotated[bool, Option("--no-attribution")] = True,
) -> IntersectionResult:
    """Repeat the published experiment on simulated drives, and compare results.

    Simulates each drive, replays it from its pictures with the embedded detectors, scores it, and
    writes study.html, study.json and score/metrics.json. Distances, cues and beliefs are shown next
    to the published ones. A second start processes only the missing drives.

    Example:
        crosscue study intersections -o study --runs 10 --workers 2

    Args:
        study: Settings of the study.
        output: Folder for drives, runs, tables and page.
        workers: Number of drives in parallel.
        ray: Run on a Ray cluster that shares DIR: its address, auto, or local.
        attribution: Skip the ablation of each cue.

    Raises:
        UsageError: ``workers`` is below 1, or a detector does not exist.
        VehicleError: The vehicle file or a model card cannot be read.
        RunError: Every drive failed; the message contains the first reason.
        OutputError: A file cannot be written.
    """
    vehicle = vehicle_given(study.vehicle)
    for choice in chosen(study.detectors.split(","), choices_of(vehicle)):
        check(choice)
    folder = Path(output)
    done = run_drives(
        folder, study.scenes(), study.detectors, engine_of(workers, ray), vehicle=study.vehicle
    )
    names = [one.job.name for one in done if one.error is None]
    if not names:
        raise RunError(f"{folder}: every drive failed; the first: {done[0].error}")
    scored = score_intersection_study(folder, names, attribution=attribution)
    tables = write_study(folder, study, done, scored)
    return IntersectionResult(folder, tables, (), done, scored)


def score_intersection_study(
    out: Path, names: Sequence[str], *, attribution: bool = True
) -> StudyScores:
    """Score the finished drives of a study.

    Raises:
        RunError: No drive is finished, or one is damaged.
    """
    scored = tuple(
        judge_run(open_run(out / "runs" / name), out / "drives" / name / FILE, AS_PUBLISHED)
        for name in names
    )
    if not scored:
        raise RunError(f"{out}: no drive is finished, so there is nothing to score")
    worth = {}
    if attribution:
        drives = [AttributedDrive(one.judged, one.truth, estimate_of(one.run)) for one in scored]
        worth = attribute(drives, settings=AS_PUBLISHED)
    first = [one.judged for one in scored]
    tracked = pool_scores([_again(one, _with_tracks(one)) for one in scored], AS_PUBLISHED).cues
    learned = calibrated_vehicles(scored)
    second = [_again(one, vehicle) for one, vehicle in zip(scored, learned or (), strict=False)]
    return StudyScores(
        scored,
        pool_scores(first, AS_PUBLISHED),
        worth,
        tracked,
        pool_scores(second, AS_PUBLISHED) if second else None,
        compare_belief(
            [part for one in first for part in one.belief],
            [part for one in second for part in one.belief],
        ),
    )


def _again(one: RunScored, vehicle: Vehicle) -> DriveJudged:
    """Judge a drive estimated again with other settings."""
    return score_drive(estimate_of(one.run, vehicle)(frozenset()), one.truth, AS_PUBLISHED)


def _with_tracks(one: RunScored) -> Vehicle:
    vehicle = one.run.drive_manifest().settings
    cars = vehicle.cars.model_copy(update={"kind": "tracks"})
    return vehicle.model_copy(update={"cars": cars})


def calibrated_vehicles(scored: Sequence[RunScored]) -> list[Vehicle] | None:
    """Return, for each drive, settings with messages learned at the other intersections.

    None if there are too few intersections, or if nothing could be learned.
    """
    places = [_place(one) for one in scored]
    if len(set(places)) < MIN_PLACES or any(not place for place in places):
        return None
    fits = {
        place: _learned([one for one, at in zip(scored, places, strict=True) if at != place])
        for place in sorted(set(places))
    }
    if not any(fit.rates for fit in fits.values()):
        return None
    return [_with_messages(one, fits[place]) for one, place in zip(scored, places, strict=True)]


def _place(one: RunScored) -> str:
    approaches = one.truth.truth.approaches
    return approaches[0].intersection if approaches else ""


def _learned(scored: Sequence[RunScored]) -> Calibrated:
    graph, vehicle = graph_of_runs([one.run for one in scored])
    found = [
        approach
        for one in scored
        for approach in annotated_approaches(one.run, one.truth, vehicle, Counter())
    ]
    return fit_messages(found, graph).calibrated


def _with_messages(one: RunScored, learned: Calibrated) -> Vehicle:
    vehicle = one.run.drive_manifest().settings
    fusion = vehicle.fusion.model_copy(update={"kind": "calibrated", "calibrated": learned})
    return vehicle.model_copy(update={"fusion": fusion})
