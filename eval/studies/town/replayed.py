"""Simulate a drive, write its log, and replay and score it like a real drive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import ValidationError

from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.recording import save_rrd
from crosscue.eval.report.summary import pose_summary
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.scoring.by_drive import FOLDER, METRICS
from crosscue.eval.scoring.pose.score import PoseScore, load_truth, measure_pose, truth_track
from crosscue.localization.town.drive import Traced, drive_traced
from crosscue.localization.town.settings import Navigation, Sensors, TownDrive
from crosscue.replay.errors import UsageError
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load
from crosscue.results import HIDDEN, Result
from crosscue.verb import Option

from . import drive_figure
from .drive_files import StudyDriveFiles, write_drive_files
from .settings import StrategyName


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """One simulated drive and its replay.

    Attributes:
        traced: The simulated drive, with the navigator's filter.
        files: Its log and truth.
        run: Folder of the replay.
        score: Score of the replay.
        is_whole: True if the replay dropped nothing of the log.
        landmark_counts: Numbers of camera frames by result of the landmark match.
    """

    traced: Traced
    files: StudyDriveFiles
    run: RunFolder
    score: PoseScore
    is_whole: bool
    landmark_counts: dict[str, int]


def through_log(
    folder: Path, settings: TownDrive, seed: int, *, overwrite: bool = False
) -> Replayed:
    """Simulate a drive, write its log, replay it into ``folder/run``, and score the run.

    Raises:
        OutputError: Files already exist, or cannot be written.
        RunError: The run folder has other contents.
    """
    traced = drive_traced(settings, seed)
    files = write_drive_files(folder, settings, traced, seed, overwrite=overwrite)
    vehicle = load(files.vehicle)
    run = create(folder / "run", overwrite=overwrite)
    with ExitStack() as open_:
        log = open_.enter_context(open_log(files.log))
        landmarks = None
        if files.landmarks is not None:
            landmarks = open_.enter_context(open_for(files.landmarks, matcher_for(vehicle)))
        outcome = replay_drive(Drive([log], vehicle), run, landmarks=landmarks)
    scored = score_pose(run, files.truth)
    return Replayed(traced, files, run, scored, outcome.exit_status == 0, outcome.landmark_counts)


def score_pose(run: RunFolder, truth_path: Path) -> PoseScore:
    """Score only a run's pose; write metrics and tracks to its ``score`` folder.

    Raises:
        RunError: The run's tables are missing or damaged.
        SchemaError: The truth does not fit the run.
    """
    truth, _ = load_truth(truth_path)
    result, _ = measure_pose(run, truth_path)
    content = {"truth": truth.model_dump(mode="json"), "pose": asdict(result)}
    write_text(run.file(FOLDER) / METRICS, strict_json(content) + "\n")
    return result


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StudyDrive(Result):
    """A simulated drive, its log and its replay; the repr includes the replay's errors.

    Attributes:
        made: The simulated drive, its files, its replay and its score.
        picture: Drawing of the drive.
        recording: Rerun recording of the replay, with the true track.
    """

    made: Replayed = field(metadata=HIDDEN)
    picture: Path
    recording: Path
    also: ClassVar = {
        "result": "result",
        "log": "made.files.log",
        "truth": "made.files.truth",
        "run": "made.run.path",
    }

    @property
    def exit_status(self) -> int:
        """0, or 3 when something of the log was dropped."""
        return 0 if self.made.is_whole else 3

    @property
    def result(self) -> dict[str, Any]:
        """Result of the simulated navigator."""
        return self.made.traced.result._asdict()

    def lines(self) -> Iterator[str]:
        """Yield results of the simulation and of the replay, and the paths of the files."""
        result = self.made.traced.result
        yield (
            f"simulated  {result.travelled_m:.0f} m in {result.seconds:.0f} s, "
            f"{result.decisions} decisions, {result.detected} landmarks used\n"
        )
        yield "replay of its log, compared with the truth"
        yield f"{pose_summary(self.made.score)}\n"
        yield f"picture    {self.picture}"
        yield f"log        {self.made.files.log}"
        yield f"recording  {self.recording}"


def run_study_drive(
    output: Path | str = "study-drive",
    *,
    seed: int = 7,
    compass_2sigma_deg: Annotated[float | None, Option("--compass")] = 30.0,
    strategy: StrategyName = "straight to goal",
    landmarks_per_km2: Annotated[float, Option("--landmark-density", metavar="N")] = 0.0,
    detection_rate: Annotated[float, Option(metavar="P")] = 0.6,
    overwrite: bool = False,
) -> StudyDrive:
    """Simulate, replay and record one drive of a study, and draw it.

    A study's drives.parquet contains the seed of each drive. The same seed and settings reproduce
    the drive.

    Examples:
        crosscue study drive --seed 7 -o drive
        crosscue study drive --strategy "landmark to landmark" --landmark-density 1 -o drive
        crosscue view drive/run --truth drive/truth.json

    Args:
        output: Folder for the log, truth, picture and run.
        seed: Random seed.
        compass_2sigma_deg: 2-sigma error of the compass in degrees; 0 for no compass.
        strategy: Navigation strategy.
        landmarks_per_km2: Landmarks per square kilometre.
        detection_rate: Probability that a landmark in view is recognised.
        overwrite: Replace an existing drive.

    Raises:
        UsageError: A value is out of range.
        OutputError: The folder already contains a drive, or cannot be written.
    """
    if not 0 <= seed < 1 << 64:
        raise UsageError(f"seed: {seed}, expected 0 or more, below 2^64")
    try:
        settings = TownDrive(
            sensors=Sensors(
                compass_2sigma_deg=compass_2sigma_deg or None, detection_rate=detection_rate
            ),
            navigation=Navigation.model_validate({"strategy": strategy}),
            landmarks_per_km2=landmarks_per_km2,
        )
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{first['loc'][-1]}: {first['input']}, {first['msg'].lower()}") from None
    place = Path(output)
    made = through_log(place, settings, seed, overwrite=overwrite)
    picture = drive_figure.draw_drive(settings, made.traced, seed, place)
    recording = made.run.file("drive.rrd")
    save_rrd(made.run, recording, truth_track(made.files.truth, made.run))
    return StudyDrive(made, picture, recording)
