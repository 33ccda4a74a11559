"""Simulate a drive, write its log, and replay and score it like a real drive."""

from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

from crosscue.eval.pipeline.landmarks import matcher_for, open_for
from crosscue.eval.pipeline.whole_run import replay_drive
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, create
from crosscue.eval.scoring.by_drive import FOLDER, METRICS
from crosscue.eval.scoring.pose.score import PoseScore, load_truth, measure_pose
from crosscue.localization.town.drive import Traced, drive_traced
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.files.tree_text import strict_json
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.logs.opening import open_log
from crosscue.replay.vehicle.vehicle import load

from .drive_files import StudyDriveFiles, write_drive_files


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
