"""Runs made from a drive: replayed, detected, estimated again."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.interface.logs.log import Log, opened
from crosscue.eval.interface.runs.run import Run, run_given
from crosscue.eval.runs.folder import RunFolder, created
from crosscue.replay.base import OutputError, UsageError
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, load, vehicle_given

if TYPE_CHECKING:
    from crosscue.detectors.base import Choice

VEHICLE: Final = "vehicle.toml"


def replay_drive(
    log: Log | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: Sequence[str] | None = None,
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
    """Replay a drive: run detectors over its camera, estimate pose, cues, ranges and belief.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the run.
        vehicle: The vehicle file; None for the ``vehicle.toml`` beside the log, if there is one.
        detectors: Names, model cards or ``module:factory``; None for the vehicle file's, and an
            empty list for pose alone.
        gnss: What GNSS is for: ``start``, ``truth``, ``fuse`` or ``off``; None for the vehicle
            file's ``gnss.use``.
        start: The first pose: ``X,Y,HEADING`` in metres and degrees, or a truth file with a track.
        landmarks: Database that frames are compared with.
        cache: File in which results of detectors are kept; see ``default_cache``.
        draw: Up to so many pictures are written with what was found.
        overwrite: Replace an earlier run.
        resume: Keep detections of an earlier start that would be the same.
        on_frames: Called with the number of frames that are done, and of how many.
        on_time: Called with the seconds of log that are done, and of how many.

    Raises:
        VehicleError: The vehicle file does not fit the log.
        RunError: The folder holds something else.
        EmptyResultError: The result is empty; the folder is unchanged.
    """
    from crosscue.eval.fit.first_pose import with_start
    from crosscue.eval.pipeline.landmarks import matcher_for, open_for
    from crosscue.eval.pipeline.replay import Detecting
    from crosscue.eval.pipeline.replay import replay_drive as replay_into

    with opened(log) as drive, ExitStack() as stack:
        settings = with_start(
            drive.logs,
            vehicle_of(drive, vehicle),
            drive.selection,
            gnss,
            None if start is None else str(start),
        )
        detecting = Detecting(
            choices_for(settings, detectors),
            None if cache is None else Path(cache),
            draw,
            resume,
            on_frames,
        )
        database = None
        if landmarks is not None:
            matcher = matcher_for(settings)
            database = stack.enter_context(open_for(Path(landmarks), matcher))
        folder = stack.enter_context(created(Path(output), overwrite=overwrite or resume))
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
    log: Log | Path | str,
    output: Path | str,
    vehicle: Vehicle | Path | str | None = None,
    detectors: Sequence[str] | None = None,
    *,
    cache: Path | str | None = None,
    draw: int = 0,
    overwrite: bool = False,
    on_frames: Callable[[int, int | None], None] = lambda done, of: None,
) -> Run:
    """Run detectors over a drive's camera, and nothing else; as ``replay_drive``."""
    from crosscue.detectors.registry import known
    from crosscue.eval.pipeline.detect import detect_drive as detect_into

    with opened(log) as drive:
        settings = vehicle_of(drive, vehicle)
        choices = choices_for(settings, detectors)
        if not choices:
            raise UsageError(f"--detectors: none named; there are: {', '.join(known({}))}")
        with created(Path(output), overwrite=overwrite) as folder:
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
    """Estimate again from what detectors found before; no picture is opened.

    Args:
        run: A finished run.
        vehicle: Other settings; the run's own, if left out. A first pose that the run took from
            GNSS or a truth file stays, unless the settings have one.
        output: A new folder beside the run; if left out, the run's tables are replaced.
        gnss: As in ``replay_drive``; the first pose is looked for again.
        start: As in ``replay_drive``.
        on_time: Called with the seconds of log that are done, and of how many.

    Raises:
        RunError: The run is damaged, or its log is gone.
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
    """Settings to estimate a run again with; None for its own."""
    from crosscue.eval.fit.first_pose import with_start, with_start_of, without_found_start
    from crosscue.eval.runs.logs import reopened

    if vehicle is None and gnss is None and start is None:
        return None
    manifest = folder.drive_manifest()
    if gnss is None and start is None:
        return with_start_of(manifest.settings, vehicle or manifest.settings)
    vehicle = vehicle or without_found_start(manifest.settings)
    with ExitStack() as stack:
        logs = [stack.enter_context(reopened(folder, said)) for said in manifest.logs]
        return with_start(logs, vehicle, manifest.selection.selection, gnss, start)


def choices_for(vehicle: Vehicle, detectors: Sequence[str] | None) -> tuple[Choice, ...]:
    """The detectors asked for; none where neither caller nor vehicle file names any."""
    from crosscue.detectors.registry import chosen
    from crosscue.eval.pipeline.detect import choices_of

    sections = choices_of(vehicle)
    names = [*sections] if detectors is None else [*detectors]
    return chosen(",".join(names), sections) if names else ()


def vehicle_of(log: Log, given: Vehicle | Path | str | None) -> Vehicle:
    """The settings given, or those of the ``vehicle.toml`` beside the log, or none."""
    if given is not None:
        return vehicle_given(given)
    for one in log.logs:
        beside = (one.path if one.path.is_dir() else one.path.parent) / VEHICLE
        if beside.is_file():
            return load(beside)
    return Vehicle(version=1)


def _copied(folder: RunFolder, output: Path) -> RunFolder:
    """The run in a new place, for other estimates beside it."""
    if output.resolve().parent != folder.path.resolve().parent:
        # Its manifest holds where its logs are, as seen from the folder.
        raise UsageError(f"{output}: expected a folder beside the run, {folder.path}")
    if output.exists():
        raise OutputError(f"{output}: exists; give another folder")
    shutil.copytree(folder.path, output, ignore=shutil.ignore_patterns("score", ".*"))
    return RunFolder(output, folder.logs, folder.without_images, folder.limits)
