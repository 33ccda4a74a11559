"""The published experiment on simulated drives: eight intersections, ten conditions each.

Every drive is simulated, replayed from its pixels, and scored, all from seeds. Drives are done in
the order of runs (A-01 to H-01, then A-02 ...), so that a study that is cut short has each
intersection about as often; a second start goes on with what is missing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

from crosscue.datasets.scenes.drive import write_scene
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.truth.truth import FILE
from crosscue.detectors.registry import chosen
from crosscue.eval.batch.jobs import Done, Engine, Job, Progress, fingerprint_of, run_many
from crosscue.eval.fit.messages import Annotated, annotate, graph_of_runs
from crosscue.eval.pipeline.detect import choices_of
from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.pipeline.replay import Detecting, replay_drive
from crosscue.eval.runs.folder import create, open_run
from crosscue.eval.scoring.drives import ScoreSettings, judge, score
from crosscue.eval.scoring.runs import RunScored, judge_run
from crosscue.eval.scoring.scene.belief import compare_belief
from crosscue.eval.studies.attribution import Drive, attribute
from crosscue.eval.studies.estimated_again import estimate_of
from crosscue.eval.studies.intersections.settings import IntersectionStudy
from crosscue.fusion.fit.message_fit import fit_messages
from crosscue.replay.base import EVERYTHING, RunError, versions
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.fusion import Calibrated
from crosscue.replay.vehicle.vehicle import Vehicle, load

from .tables import StudyScores

AS_PUBLISHED: Final = ScoreSettings(detection="published")
"""What the published distances are compared with counts as the source counts it."""
MIN_PLACES: Final = 3
"""Intersections, so that messages for one can be learned at two others or more."""
LOG: Final = "drive.mcap"
VEHICLE: Final = "vehicle.toml"


@dataclass(frozen=True, slots=True)
class Work:
    """What is done for one drive, here or in another process.

    Attributes:
        drives: Folder of the simulated drives.
        scenes: By name.
        vehicle: A vehicle file to replay with, or None.
        detectors: Comma-separated.
        cache: Where detectors' results are kept.
    """

    drives: Path
    scenes: Mapping[str, SceneSettings]
    vehicle: Path | None
    detectors: str
    cache: Path

    def __call__(self, job: Job) -> Outcome:
        """Simulate the drive unless it is there, then replay it."""
        folder = self.drives / job.name
        if not (folder / FILE).exists():
            write_scene(folder, self.scenes[job.name], overwrite=True)
        vehicle = load(self.vehicle or folder / VEHICLE)
        choices = chosen(self.detectors, choices_of(vehicle))
        # One cache a drive: workers never wait for one another.
        detecting = Detecting(choices, self.cache / f"{job.name}.sqlite")
        run = create(job.run, overwrite=True)
        with open_log(folder / LOG) as log:
            outcome = replay_drive([log], vehicle, run, EVERYTHING, detecting=detecting)
        return replace(outcome, ledgers=(), detected=None)


def run_drives(
    out: Path,
    settings: IntersectionStudy,
    engine: Engine,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> tuple[Done[Outcome], ...]:
    """Simulate and replay all drives that are not there yet, below ``out``.

    Raises:
        VehicleError: The vehicle file cannot be read.
    """
    scenes = {scene.name: scene for scene in settings.scenes()}
    vehicle = None if settings.vehicle is None else load(settings.vehicle).model_dump(mode="json")
    jobs = [
        Job(
            name=name,
            logs=(),
            run=out / "runs" / name,
            fingerprint=fingerprint_of(asdict(scene), vehicle, settings.detectors, versions()),
        )
        for name, scene in scenes.items()
    ]
    work = Work(out / "drives", scenes, settings.vehicle, settings.detectors, out / "cache")
    return run_many(jobs, work, engine, overwrite=True, on_progress=on_progress)


def score_study(out: Path, names: Sequence[str], *, attribution: bool = True) -> StudyScores:
    """Score the drives of a study that are done.

    Raises:
        RunError: None is done, or one is damaged.
    """
    scored = tuple(
        judge_run(open_run(out / "runs" / name), out / "drives" / name / FILE, AS_PUBLISHED)
        for name in names
    )
    if not scored:
        raise RunError(f"{out}: not one drive is done, so there is nothing to score")
    worth = {}
    if attribution:
        drives = [Drive(one.judged, one.truth, estimate_of(one.run)) for one in scored]
        worth = attribute(drives, settings=AS_PUBLISHED)
    first = [one.judged for one in scored]
    learned = calibrated_vehicles(scored)
    if learned is None:
        return StudyScores(scored, score(first, AS_PUBLISHED), worth, None, {})
    second = [
        judge(estimate_of(one.run, vehicle)(frozenset()), one.truth, AS_PUBLISHED)
        for one, vehicle in zip(scored, learned, strict=True)
    ]
    return StudyScores(
        scored,
        score(first, AS_PUBLISHED),
        worth,
        score(second, AS_PUBLISHED),
        compare_belief(
            [part for one in first for part in one.belief],
            [part for one in second for part in one.belief],
        ),
    )


def calibrated_vehicles(scored: Sequence[RunScored]) -> list[Vehicle] | None:
    """For each drive the settings with messages learned elsewhere: from all other intersections.

    No drive is judged by messages that its own intersection had a part in. None where there are
    too few intersections to learn from the others, or nothing could be learned.
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
    found = Annotated([], Counter())
    for one in scored:
        annotate(one.run, one.truth.truth, vehicle, found)
    return fit_messages(found.approaches, graph).calibrated


def _with_messages(one: RunScored, learned: Calibrated) -> Vehicle:
    vehicle = one.run.drive_manifest().settings
    fusion = vehicle.fusion.model_copy(update={"kind": "calibrated", "calibrated": learned})
    return vehicle.model_copy(update={"fusion": fusion})
