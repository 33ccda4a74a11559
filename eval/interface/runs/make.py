"""Make runs from a drive: replay, detect, or estimate again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.logs.log import Log, UnopenedLog, opened, vehicle_of
from crosscue.eval.pipeline.run import Run, run_given
from crosscue.eval.runs.folder import RunFolder, copy_files, created
from crosscue.replay.base import OutputError, UsageError
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.detectors.base import Choice


def replay_drive(
    log: Log | UnopenedLog | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: str | Sequence[object] | None = None,
    *,
    gnss: GnssUse | None = None,
    start: Path | str | None = None,
    landmarks: Path | str | None = None,
    cache: Path | str | None = None,
    draw: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    on_frames: Callable[[int, int | None], None] = lambda done, of: None,
    on_time: Callable[[float, float], None] = lambda done_s, of_s: None,
) -> Run:
    """Replay a drive: run detectors on its camera, and estimate pose, cues, ranges and beliefs.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the run.
        vehicle: The vehicle file; None for the ``vehicle.toml`` next to the log, if it exists.
        detectors: Names, model cards, ``module:factory``, classes, functions from a frame to its
            boxes, or detectors; None for those of the vehicle file. An empty list estimates only
            the pose.
        gnss: Use of GNSS: ``start``, ``truth``, ``fuse`` or ``off``; None for the vehicle file's
            ``gnss.use``.
        start: The first pose: ``X,Y,HEADING`` in metres and degrees, or a truth file with a track.
        landmarks: Landmark database to match frames against.
        cache: Detection cache; see ``default_cache``.
        draw: Max number of pictures with detections to write.
        overwrite: Replace an earlier run.
        resume: Keep valid detections of an interrupted run.
        on_frames: Called with the number of frames done, and their total.
        on_time: Called with the seconds of log done, and their total.

    Raises:
        VehicleError: The vehicle file does not fit the log.
        RunError: The folder has other contents.
        EmptyResultError: The result is empty; the folder is unchanged.
    """
    from crosscue.eval.fit.first_pose import check_start, with_start
    from crosscue.eval.pipeline.landmarks import matcher_for, open_for
    from crosscue.eval.pipeline.replay import Detecting
    from crosscue.eval.pipeline.replay import replay_drive as replay_into

    settings = vehicle_of(log, vehicle)
    first_pose = None if start is None else str(start)
    detecting = Detecting(
        choices_for(settings, detectors),
        None if cache is None else Path(cache),
        draw,
        resume,
        on_frames,
        is_required=bool(detectors),
    )
    with ExitStack() as stack:
        database = None
        if landmarks is not None:
            matcher = matcher_for(settings)
            database = stack.enter_context(open_for(Path(landmarks), matcher))
        check_start(settings, first_pose)
        drive = stack.enter_context(opened(log))
        settings = with_start(drive.logs, settings, drive.selection, gnss, first_pose)
        folder = stack.enter_context(created(Path(output), overwrite=overwrite, resume=resume))
        outcome = replay_into(
            drive.logs,
            settings,
            folder,
            drive.selection,
            on_time,
            database,
            detecting,
            overwrite=overwrite,
        )
    return Run(folder, outcome)


def detect_drive(
    log: Log | UnopenedLog | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: str | Sequence[object] | None = None,
    *,
    cache: Path | str | None = None,
    draw: int = 0,
    overwrite: bool = False,
    on_frames: Callable[[int, int | None], None] = lambda done, of: None,
) -> Run:
    """Run only the detectors on a drive's camera; as ``replay_drive`` otherwise."""
    from crosscue.detectors.registry import known
    from crosscue.eval.pipeline.detect import detect_drive as detect_into

    settings = vehicle_of(log, vehicle)
    choices = choices_for(settings, detectors)
    if not choices:
        raise UsageError(f"--detectors: none named; expected some of {', '.join(known({}))}")
    with opened(log) as drive, created(Path(output), overwrite=overwrite) as folder:
        outcome = detect_into(
            drive.logs,
            settings,
            folder,
            drive.selection,
            choices,
            None if cache is None else Path(cache),
            draw,
            on_frames,
        )
    return Run(folder, outcome)


def estimate_run(
    run: Run | Path | str,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    gnss: GnssUse | None = None,
    start: Path | str | None = None,
    on_time: Callable[[float, float], None] = lambda done_s, of_s: None,
) -> Run:
    """Estimate again from the stored detections, without reading pictures.

    Args:
        run: A finished run.
        vehicle: Other settings; default: those of the run. A first pose that the run took from GNSS
            or a truth file is kept, unless the settings have one.
        output: New folder, next to the run; default: the run's tables are replaced.
        gnss: As in ``replay_drive``; the first pose is determined again.
        start: As in ``replay_drive``.
        on_time: Called with the seconds of log done, and their total.

    Raises:
        RunError: The run is damaged, or its log is missing.
        OutputError: The new folder exists.
    """
    from crosscue.eval.pipeline.replay import estimate_run as estimate_in

    folder = run_given(run).folder
    settings = _settings_again(
        folder,
        None if vehicle is None else vehicle_given(vehicle),
        gnss,
        None if start is None else str(start),
    )
    if output is not None:
        folder = _copied(folder, Path(output))
    return Run(folder, estimate_in(folder, settings, on_time))


def _settings_again(
    folder: RunFolder, vehicle: Vehicle | None, gnss: GnssUse | None, start: str | None
) -> Vehicle | None:
    """Return the settings for another estimate of a run; None for those of the run."""
    from crosscue.eval.fit.first_pose import (
        check_start,
        with_start,
        with_start_of,
        without_found_start,
    )
    from crosscue.eval.runs.logs import reopened

    if vehicle is None and gnss is None and start is None:
        return None
    manifest = folder.drive_manifest()
    if gnss is None and start is None:
        return with_start_of(manifest.settings, vehicle or manifest.settings)
    vehicle = vehicle or without_found_start(manifest.settings)
    check_start(vehicle, start)
    with ExitStack() as stack:
        logs = [stack.enter_context(reopened(folder, row)) for row in manifest.logs]
        return with_start(logs, vehicle, manifest.selection.selection, gnss, start)


def check_inputs(
    vehicle: Vehicle | Path | str | None,
    detectors: str | Sequence[object] | None,
    start: str | None,
    landmarks: Path | str | None,
) -> None:
    """Refuse what a replay names and does not exist, before its logs are found and hashed.

    Without a vehicle file, detectors are checked later: the file next to a log may define them.
    """
    from crosscue.eval.fit.first_pose import check_start
    from crosscue.localization.landmarks.database import LandmarkDatabase

    settings = vehicle_given(vehicle)
    if vehicle is not None:
        choices_for(settings, detectors)
    check_start(settings, start)
    if landmarks is not None:
        LandmarkDatabase(Path(landmarks)).close()


def choices_for(vehicle: Vehicle, detectors: str | Sequence[object] | None) -> tuple[Choice, ...]:
    """Return the requested detectors, or else those of the vehicle file, which may be none.

    Raises:
        UsageError: A detector does not exist.
        VehicleError: A model card or its weights cannot be read.
    """
    from crosscue.detectors.registry import check, chosen
    from crosscue.eval.pipeline.detect import choices_of

    sections = choices_of(vehicle)
    names = [*sections] if detectors is None else detectors
    choices = chosen(names, sections) if len(names) else ()
    for choice in choices:
        check(choice)
    return choices


def _copied(folder: RunFolder, output: Path) -> RunFolder:
    """Copy a run to a new folder, for another estimate."""
    if output.resolve().parent != folder.path.resolve().parent:
        # The manifest's paths of logs are relative to the folder.
        raise UsageError(f"{output}: expected a folder next to the run, {folder.path}")
    if output.exists():
        raise OutputError(f"{output}: exists; give another folder")
    new = RunFolder(output, folder.logs, folder.without_images, folder.limits)
    output.mkdir()
    copy_files(folder, new, is_linked=False)
    return new
