"""Whole runs: locked, resumed or replaced, by both stages or by one of them."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import MANIFEST, RunFolder, clear, locked, staged, write_input
from crosscue.eval.runs.logs import (
    input_of,
    log_rows,
    refuse_other_input,
    reopened,
    settings_changed,
)
from crosscue.eval.runs.manifest import (
    DetectManifest,
    DriveManifest,
    EstimateManifest,
    LogRow,
    selection_record,
)
from crosscue.replay.base import Log
from crosscue.replay.columns import Topic
from crosscue.replay.errors import RunError, UsageError
from crosscue.replay.files.whole_file import sha256_of
from crosscue.replay.vehicle.vehicle import Vehicle

from .detecting import Detecting
from .drive_time import with_camera_segments, with_segments
from .empty_result import nothing_left
from .estimate import Earlier
from .replay import detect, estimate

if TYPE_CHECKING:
    from crosscue.localization.landmarks.database import LandmarkDatabase

# Tables of the first stage that the second stage reads.
TABLES: Final = ("frames.parquet", "detections.parquet", "road.parquet", "skipped.parquet")
NO_DETECTORS: Final = Detecting(())


def replay_drive(
    drive: Drive,
    run: RunFolder,
    detecting: Detecting = NO_DETECTORS,
    landmarks: LandmarkDatabase | None = None,
    *,
    overwrite: bool = False,
) -> Outcome:
    """Replay one drive into a run folder.

    Args:
        drive: The drive.
        run: The run folder; locked meanwhile, and cleared first unless its detections are kept.
        detecting: Detectors to run over the camera; without any, the run has only the pose.
        landmarks: Database with which camera frames are compared, or None.
        overwrite: Replace a run of other logs or settings even if ``detecting.resume`` is set.

    Raises:
        UsageError: The folder to be resumed holds a run of other logs or settings.
        VehicleError: The vehicle file does not fit the logs.
        EmptyResultError: The result is empty, or there is no camera for the detectors or landmarks
            that the user named; the folder is unchanged.
        OutputError: The disk is full.
    """
    mine = _input(run, drive, detecting, landmarks)
    with locked(run):
        if detecting.resume and not overwrite:
            refuse_other_input(run, mine)
        drive = with_segments(drive, _camera(drive, detecting, landmarks))
        earlier = _kept(drive, run, detecting) if detecting.resume else None
        with staged(run, keep=earlier is not None, until=earlier) as new, nothing_left(new):
            found = None
            if earlier is None:
                clear(new, mine)
                if detecting.choices and drive.camera is not None:
                    found = detect(drive, new, detecting)
            outcome = estimate(drive, new, Earlier(found, earlier), landmarks)
        detected = None if outcome.detected is None else replace(outcome.detected, run=run)
        return replace(outcome, run=run, detected=detected)


def detect_drive(drive: Drive, run: RunFolder, detecting: Detecting) -> DetectOutcome:
    """Run detectors over the only camera of a drive, into an empty run folder.

    The folder is locked meanwhile, and cleared first. See ``detect`` for the errors.
    """
    with locked(run), staged(run) as new, nothing_left(new):
        clear(new, _input(run, drive, detecting))
        outcome = detect(with_camera_segments(drive), new, detecting)
    return replace(outcome, run=run)


def _input(
    run: RunFolder, drive: Drive, detecting: Detecting, landmarks: LandmarkDatabase | None = None
) -> dict[str, object]:
    database = None if landmarks is None else str(landmarks.path.resolve())
    return input_of(run, drive, {**detecting.as_json(), "landmarks": database})


def _camera(
    drive: Drive, detecting: Detecting, landmarks: LandmarkDatabase | None
) -> tuple[int, Topic] | None:
    """Return the camera if detectors or landmarks need it."""
    if not detecting.choices and landmarks is None:
        return None
    is_needed = detecting.is_required or landmarks is not None
    return drive.only_camera() if is_needed else drive.camera


def _kept(drive: Drive, run: RunFolder, detecting: Detecting) -> DetectManifest | None:
    """Return the detect stage of an earlier start if its tables would be the same again."""
    try:
        earlier = run.drive_manifest().detected
    except RunError:
        return None
    camera = drive.camera
    if earlier is None or camera is None or not all(run.file(name).exists() for name in TABLES):
        return None
    from crosscue.detectors.registry import make  # not without detectors

    wanted = (
        log_rows(drive.logs, run),
        selection_record(drive.selection),
        camera[1].name,
        [make(choice).identity for choice in detecting.choices],
        drive.vehicle.camera.depth_bits,
        drive.vehicle.time,
    )
    there = (
        earlier.logs,
        earlier.selection,
        earlier.camera,
        [detector.identity for detector in earlier.detectors],
        earlier.settings.camera.depth_bits,
        earlier.settings.time,
    )
    return earlier if wanted == there else None


def estimate_run(
    run: RunFolder,
    vehicle: Vehicle | None = None,
) -> Outcome:
    """Estimate again into the same run folder; no picture is opened.

    The run stays unchanged until the new one is complete.

    Args:
        run: A finished run, or one whose detect stage has finished.
        vehicle: Settings; default: those of the run.

    Raises:
        RunError: The run's logs are missing or have changed, or it was made with landmarks.
        VehicleError: The settings do not fit the logs.
        UsageError: The settings split the drive into other segments than those of the detections.
    """
    manifest = run.drive_manifest()
    if isinstance(manifest, EstimateManifest) and manifest.landmarks is not None:
        raise RunError(
            f"{run.path}: landmarks are searched for in pictures, which estimate does not open; "
            "run crosscue replay --landmarks again"
        )
    if vehicle is not None:
        _refuse_other_time(run, manifest, vehicle)
    with ExitStack() as stack:
        logs = [stack.enter_context(_reopened(run, row)) for row in manifest.logs]
        stack.enter_context(locked(run))
        settings = vehicle or manifest.settings
        changed = None if vehicle is None else settings_changed(run, vehicle)
        new = stack.enter_context(staged(run, keep=True, until=manifest.detected))
        if changed is not None:
            write_input(new, changed)
        drive = Drive(logs, settings, manifest.selection.selection)
        found = manifest.detected
        drive = with_segments(drive, known=None if found is None else found.timeline)
        outcome = estimate(drive, new, Earlier(manifest=found, logs=manifest.logs))
    return replace(outcome, run=run)


def _refuse_other_time(run: RunFolder, manifest: DriveManifest, vehicle: Vehicle) -> None:
    wanted = vehicle.time.model_dump()
    there = wanted if manifest.detected is None else manifest.detected.settings.time.model_dump()
    for name, value in wanted.items():
        if there[name] != value:
            raise UsageError(
                f"{run.path}: its frames are split into segments by time.{name} = "
                f"{there[name]:g}, not {value:g}, which estimate keeps; run crosscue replay again"
            )


def _reopened(run: RunFolder, row: LogRow) -> Log:
    log = reopened(run, row)
    if row.sha256 and not _is_older(log.path, run) and sha256_of(log.path) != row.sha256:
        log.close()
        raise RunError(f"{run.path}: its log {log.path} has changed since; replay again")
    return log


def _is_older(log: Path, run: RunFolder) -> bool:
    """Return whether a log is unchanged since the run hashed it, so that it need not be read again.

    The change time of the inode counts, too, because a replaced file may have an older modification
    time.
    """
    files = [log] if log.is_file() else [entry for entry in log.rglob("*") if entry.is_file()]
    hashed_ns = run.file(MANIFEST).stat().st_mtime_ns
    touched = (time for entry in files for time in _times(entry))
    return all(time < hashed_ns for time in touched)


def _times(file: Path) -> tuple[int, int]:
    found = file.stat()
    return found.st_mtime_ns, found.st_ctime_ns
