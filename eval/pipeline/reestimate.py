"""The second stage once more, over a run whose detections are there already."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from crosscue.eval.pipeline.outcome import Outcome
from crosscue.eval.runs.folder import (
    MANIFEST,
    DriveManifest,
    EstimateManifest,
    LogRow,
    RunFolder,
    locked,
    staged,
    write_input,
)
from crosscue.eval.runs.input import settings_changed
from crosscue.eval.runs.logs import reopened
from crosscue.replay.base import Log, RunError, UsageError, sha256_of
from crosscue.replay.vehicle.vehicle import Vehicle

from .estimate import begin_again, estimate_into
from .progress import OnTime, unwatched_time


def estimate_run(
    run: RunFolder,
    vehicle: Vehicle | None = None,
    on_time: OnTime = unwatched_time,
) -> Outcome:
    """Estimate again into the same run folder; no picture is opened.

    The run stays as it was until the new one is whole.

    Args:
        run: A finished run, or one whose detect stage has finished.
        vehicle: Other settings; those of the run, if left out.
        on_time: Called with the seconds done, and those there are.

    Raises:
        RunError: Its logs are gone or have changed, or it was made with landmarks.
        VehicleError: The settings do not fit the logs.
        UsageError: They split the drive otherwise than detections are labelled.
    """
    manifest = run.drive_manifest()
    if isinstance(manifest, EstimateManifest) and manifest.landmarks is not None:
        raise RunError(
            f"{run.path}: landmarks are looked for in pictures, which estimate does not open; run "
            "crosscue replay --landmarks again"
        )
    if vehicle is not None:
        _refuse_other_time(run, manifest, vehicle)
    with ExitStack() as stack:
        logs = [stack.enter_context(_reopened(run, said)) for said in manifest.logs]
        stack.enter_context(locked(run))
        settings = vehicle or manifest.settings
        changed = None if vehicle is None else settings_changed(run, vehicle)
        new = stack.enter_context(staged(run, keep=True, until=manifest.detected))
        if changed is not None:
            # In this order a run cut short between them does not pass for a whole one.
            begin_again(new, manifest.detected)
            write_input(new, changed)
        outcome = estimate_into(
            logs,
            settings,
            new,
            manifest.selection.selection,
            on_time,
            earlier=manifest.detected,
            reported=manifest.logs,
        )
    return replace(outcome, run=run)


def _refuse_other_time(run: RunFolder, manifest: DriveManifest, vehicle: Vehicle) -> None:
    """Frames and detections carry segments by the ``[time]`` they were detected with."""
    wanted = vehicle.time.model_dump()
    there = wanted if manifest.detected is None else manifest.detected.settings.time.model_dump()
    for name, value in wanted.items():
        if there[name] != value:
            raise UsageError(
                f"{run.path}: its frames are split into segments by time.{name} = "
                f"{there[name]:g}, not {value:g}; estimate keeps that: run crosscue replay again"
            )


def _reopened(run: RunFolder, said: LogRow) -> Log:
    log = reopened(run, said)
    if said.sha256 and not _is_older(log.path, run) and sha256_of(log.path) != said.sha256:
        log.close()
        raise RunError(f"{run.path}: its log {log.path} has changed since; replay again")
    return log


def _is_older(log: Path, run: RunFolder) -> bool:
    """Has nobody touched the log since the run hashed it? Then there is no need to read it all.

    The time of its entry counts, too: a file put in its place may bring an older time of its own.
    """
    files = [log] if log.is_file() else [entry for entry in log.rglob("*") if entry.is_file()]
    hashed_ns = run.file(MANIFEST).stat().st_mtime_ns
    touched = (time for entry in files for time in _times(entry))
    return all(time < hashed_ns for time in touched)


def _times(file: Path) -> tuple[int, int]:
    found = file.stat()
    return found.st_mtime_ns, found.st_ctime_ns
