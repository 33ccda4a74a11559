"""The stages of a replay, in order of time.

``detect`` finds objects and road in pictures, and stores them. ``estimate`` follows what the car
did, and what it saw there. Both write into a run folder that the caller has locked (``whole_run``).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import DetectManifest, SceneSummary

from .detecting import Detecting
from .estimate import Earlier, EstimateStage

if TYPE_CHECKING:
    from crosscue.localization.landmarks.database import LandmarkDatabase

    from .scene.stage import SceneTables


def detect(drive: Drive, run: RunFolder, detecting: Detecting) -> DetectOutcome:
    """Find objects and road in the pictures of a drive; the only stage that opens pictures.

    Raises:
        VehicleError: The drive has several cameras, or a card, weights or settings are invalid.
        EmptyResultError: The drive has no camera, or the selected part contains no frame.
        OutputError: The disk is full.
    """
    from crosscue.detectors.result_cache import ResultCache

    from .detect import DetectStage

    with ResultCache(detecting.cache) as cache:
        stage = DetectStage(drive, run, detecting, cache)
        with stage.tables as tables:
            for frame in stage.frames():
                tables.add(frame)
        return stage.finish()


def estimate(
    drive: Drive, run: RunFolder, before: Earlier, landmarks: LandmarkDatabase | None = None
) -> Outcome:
    """Estimate what the car did, and what it saw, from signals and stored detections.

    Args:
        drive: The drive, with its time segments.
        run: The run folder, with or without tables of ``detect``.
        before: What earlier stages found.
        landmarks: Database with which camera frames are compared, or None.

    Raises:
        VehicleError: The vehicle file does not fit the logs.
        EmptyResultError: The selected part contains nothing to estimate from.
        UsageError: The frames of ``detect`` have other time segments.
        OutputError: The disk is full.
    """
    stage = EstimateStage(drive, run, before, landmarks)
    with stage.tables() as tables:
        for window in stage.windows():
            tables.add(stage.pose(window), window)
        tables.add(stage.last_poses())
    scene = None
    if stage.found is not None:
        from .scene.stage import tables_of_scene  # not without detectors

        seen = stage.scene_drive()
        with tables_of_scene(seen, run, stage.found) as rows:
            scene = observe(seen, run, stage.found, rows)
    return stage.finish(scene)


def observe(
    drive: Drive,
    run: RunFolder,
    detected: DetectManifest,
    tables: SceneTables,
    without: frozenset[str] = frozenset(),
) -> SceneSummary:
    """Find cues, ranges and belief in a run's stored detections and odometry.

    No picture is opened and no log is read, so settings of cues, ranges and belief can be tried in
    seconds, and each cue can be left out to measure its contribution.

    Args:
        drive: Vehicle file and time segments.
        run: A run with the tables of ``detect`` and ``measurements.parquet``.
        detected: Manifest of ``detect``.
        tables: Receives the rows.
        without: Cues to leave out, together with their ranges.

    Raises:
        RunError: A table is missing or damaged.
        VehicleError: A cue or feature of the settings does not exist.
    """
    from .scene.stage import Scene

    scene = Scene(drive, run, detected, without)
    for step in scene.steps():
        cues = scene.observe(step)
        evidence = scene.range(step, cues)
        tables.add(scene.believe(evidence), scene.objects)
    return scene.outcome()
