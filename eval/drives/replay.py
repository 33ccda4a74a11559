"""Make runs from a drive: replay, detect, or estimate again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from crosscue.eval.logs.log import DriveGiven, Log, UnopenedLog, opened, vehicle_of
from crosscue.eval.pipeline.run import Run, RunGiven, run_given
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, copy_files, created
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.door import user_cache
from crosscue.replay.vehicle.pose import GnssUse
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.verb import HIDDEN, Option, keywords

if TYPE_CHECKING:
    from crosscue.detectors.base import DetectorChoice


def cache_file(*, cache: Path | None = None, no_cache: bool = False) -> Path | None:
    """Return the file of the detection cache.

    Args:
        cache: Detection cache (default: ~/.cache/crosscue/detections.sqlite).
        no_cache: Run every detector again instead of using the cache.
    """
    if no_cache:
        return None
    return user_cache("XDG_CACHE_HOME") / "detections.sqlite" if cache is None else cache


Cache: TypeAlias = Annotated[Path | str | None, Option(made_by=cache_file)]
FirstPose: TypeAlias = Annotated[Path | str | None, Option(metavar="POSE")]


@dataclass(frozen=True, slots=True)
class DetectSettings:
    """Settings of detection.

    Attributes:
        vehicle: Vehicle file (default: vehicle.toml next to a drive's logs).
        detectors: Comma-separated names (default: all in the vehicle file); 'none' estimates only
            the pose. In Python also classes, functions from a frame to its boxes, or detectors.
        draw: Write up to N camera images with detections, evenly spread over the drive.
        cache: Detection cache; None runs every detector again.
        overwrite: Replace an existing run.
    """

    vehicle: Vehicle | Path | str | None = None
    detectors: Annotated[str | Sequence[object] | None, Option(metavar="NAMES")] = None
    _: KW_ONLY
    draw: int = 0
    cache: Cache = field(default=None, compare=False)
    overwrite: bool = field(default=False, compare=False)

    def __post_init__(self) -> None:
        """Check numbers.

        Raises:
            UsageError: A number is out of range.
        """
        if self.draw < 0:
            raise UsageError(f"draw: {self.draw}, expected 0 or more")

    @property
    def detector_names(self) -> str | Sequence[object] | None:
        """The detectors; empty for ``none``."""
        return () if self.detectors == "none" else self.detectors

    @property
    def cache_path(self) -> Path | None:
        """Path of the detection cache."""
        return None if self.cache is None else Path(self.cache)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplaySettings(DetectSettings):
    """Settings of a replay.

    Attributes:
        gnss: Use of GNSS: for the first pose and heading, only as truth, for the first pose and
            every later position, or not at all (default: gnss.use of the vehicle file, which is
            start unless set).
        start: First pose: X,Y,HEADING in metres and degrees counter-clockwise from east, or a truth
            file with a track.
        landmarks: Landmark database to match camera frames against.
        resume: Continue an interrupted run and keep its finished parts.
    """

    gnss: GnssUse | None = None
    start: FirstPose = None
    landmarks: Path | str | None = None
    resume: bool = field(default=False, compare=False)


@keywords(ReplaySettings, 2)
def replay_drive(
    log: Log | UnopenedLog | Path | str, output: Path | str, settings: ReplaySettings
) -> Run:
    """Replay a drive: run detectors on its camera, and estimate pose, cues, ranges and beliefs.

    The run folder contains all tables and a manifest that accounts for every message. Detections
    are cached by the content of each picture, so a second run is quick.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Folder for the run.
        settings: How to replay.

    Raises:
        VehicleError: The vehicle file does not fit the log.
        RunError: The folder has other contents.
        EmptyResultError: The result is empty; the folder is unchanged.
    """
    return replay_with(log, output, settings)


def replay_with(
    log: Log | UnopenedLog | Path | str, output: Path | str, settings: ReplaySettings
) -> Run:
    """Replay a drive, as ``replay_drive``."""
    from crosscue.eval.fit.first_pose import check_start, with_start
    from crosscue.eval.pipeline.detecting import Detecting
    from crosscue.eval.pipeline.whole_run import replay_drive as replay_into

    overwrite, resume = settings.overwrite, settings.resume
    vehicle = vehicle_of(log, settings.vehicle)
    first_pose = None if settings.start is None else str(settings.start)
    detecting = Detecting(
        choices_for(vehicle, settings.detector_names),
        settings.cache_path,
        settings.draw,
        resume,
        is_required=bool(settings.detector_names),
    )
    with ExitStack() as stack:
        database = None
        if settings.landmarks is not None:
            from crosscue.eval.pipeline.landmarks import matcher_for, open_for

            matcher = matcher_for(vehicle)
            database = stack.enter_context(open_for(Path(settings.landmarks), matcher))
        check_start(vehicle, first_pose)
        drive = stack.enter_context(opened(log))
        vehicle = with_start(drive.logs, vehicle, drive.selection, settings.gnss, first_pose)
        folder = stack.enter_context(created(Path(output), overwrite=overwrite, resume=resume))
        whole = Drive(drive.logs, vehicle, drive.selection)
        outcome = replay_into(whole, folder, detecting, database, overwrite=overwrite)
    return Run(folder, outcome)


@keywords(DetectSettings, 2)
def detect_drive(
    log: DriveGiven,
    output: Annotated[Path | str, Option(metavar="RUN")],
    settings: DetectSettings,
) -> Run:
    """Run detectors on the camera images of a log.

    Detections and road are written to a run folder; crosscue estimate finds cues in them. A
    detector is a built-in name, a section [detectors.NAME] of the vehicle file, a module:factory,
    or a model card (.toml). Results are cached by the content of each picture, so a second run is
    quick.

    Examples:
        crosscue detect drive.mcap --vehicle car.toml --detectors yolox.toml,signs -o runs/drive

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        output: Run folder.
        settings: How to detect.

    Raises:
        UsageError: No detector is named, here or in the vehicle file.
        RunError: The folder has other contents.
        EmptyResultError: The result is empty; the folder is unchanged.
    """
    from crosscue.detectors.registry import known
    from crosscue.eval.pipeline.detecting import Detecting
    from crosscue.eval.pipeline.whole_run import detect_drive as detect_into

    vehicle = vehicle_of(log, settings.vehicle)
    choices = choices_for(vehicle, settings.detector_names)
    if not choices:
        raise UsageError(f"detectors: none named; expected some of {', '.join(known({}))}")
    with opened(log) as drive, created(Path(output), overwrite=settings.overwrite) as folder:
        detecting = Detecting(choices, settings.cache_path, settings.draw)
        outcome = detect_into(Drive(drive.logs, vehicle, drive.selection), folder, detecting)
    return Run(folder, outcome)


def estimate_run(
    run: RunGiven,
    vehicle: Vehicle | Path | str | None = None,
    output: Annotated[Path | str | None, HIDDEN] = None,
    *,
    gnss: GnssUse | None = None,
    start: FirstPose = None,
) -> Run:
    """Repeat the estimate of a run from its stored detections.

    Pictures are not read, so other settings can be tried in seconds. The run's tables are replaced.

    Examples:
        crosscue estimate runs/drive --vehicle other.toml

    Args:
        run: A finished run.
        vehicle: Vehicle file with other settings (default: those of the run). A first pose that the
            run took from GNSS or a truth file is kept, unless the settings have one.
        output: New folder, next to the run; default: the run's tables are replaced.
        gnss: Use of GNSS: for the first pose and heading, only as truth, for the first pose and
            every later position, or not at all (default: as in the run).
        start: First pose: X,Y,HEADING in metres and degrees counter-clockwise from east, or a truth
            file with a track (default: as in the run).

    Raises:
        RunError: The run is damaged, or its log is missing.
        OutputError: The new folder exists.
    """
    from crosscue.eval.pipeline.whole_run import estimate_run as estimate_in

    folder = run_given(run).folder
    settings = _settings_again(
        folder,
        None if vehicle is None else vehicle_given(vehicle),
        gnss,
        None if start is None else str(start),
    )
    if output is not None:
        folder = _copied(folder, Path(output))
    return Run(folder, estimate_in(folder, settings))


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


def check_inputs(settings: ReplaySettings) -> None:
    """Refuse what a replay names and does not exist, before its logs are found and hashed.

    Without a vehicle file, detectors are checked later: the file next to a log may define them.
    """
    from crosscue.eval.fit.first_pose import check_start

    vehicle = vehicle_given(settings.vehicle)
    if settings.vehicle is not None:
        choices_for(vehicle, settings.detector_names)
    check_start(vehicle, None if settings.start is None else str(settings.start))
    if settings.landmarks is not None:
        from crosscue.localization.landmarks.database import LandmarkDatabase

        LandmarkDatabase(Path(settings.landmarks)).close()


def choices_for(
    vehicle: Vehicle, detectors: str | Sequence[object] | None
) -> tuple[DetectorChoice, ...]:
    """Return the requested detectors, or else those of the vehicle file, which may be none.

    Raises:
        UsageError: A detector does not exist.
        VehicleError: A model card or its weights cannot be read.
    """
    names = [*vehicle.detectors] if detectors is None else detectors
    if not len(names):
        return ()
    from crosscue.detectors.registry import check, chosen
    from crosscue.eval.pipeline.detecting import choices_of

    choices = chosen(names, choices_of(vehicle))
    for choice in choices:
        check(choice)
    return choices


def _copied(folder: RunFolder, output: Path) -> RunFolder:
    if output.resolve().parent != folder.path.resolve().parent:
        # The manifest's paths of logs are relative to the folder.
        raise UsageError(f"{output}: expected a folder next to the run, {folder.path}")
    if output.exists():
        raise OutputError(f"{output}: exists; give another folder")
    new = RunFolder(output, folder.logs, folder.without_images, folder.limits)
    output.mkdir()
    copy_files(folder, new, is_linked=False)
    return new
