"""Rerun recordings of runs, with a ready-made layout.

Everything is on one timeline, the drive time. Columns are sent in bulk, and pictures are passed
through as stored. ``save_rrd`` is the only entry point.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.legs import leg_texts
from crosscue.eval.runs.manifest import DriveManifest
from crosscue.eval.runs.moments import run_between
from crosscue.eval.runs.stored_images import StoredCamera, run_camera
from crosscue.eval.scoring.pose.truth_track import TruthTrack
from crosscue.eval.scoring.truth import TrueRanges, true_marks
from crosscue.replay.clocks.findings import is_date
from crosscue.replay.columns import Floats
from crosscue.replay.files import door
from crosscue.replay.files.tree_text import spelled
from crosscue.replay.files.whole_file import write_whole
from crosscue.replay.safe_text import counted

from .part import WHOLE, RecordingSpan

if TYPE_CHECKING:
    import rerun as rr

    from .columns import DriveTime
    from .layout import ViewData
    from .scene_rows import SceneRows


def save_rrd(
    run: RunFolder,
    path: Path,
    truth: TruthTrack | None = None,
    true_ranges: TrueRanges | None = None,
    part: RecordingSpan = WHOLE,
    labels: Path | None = None,
) -> None:
    """Write the recording of a run atomically; views without data are left out.

    Args:
        run: A finished run, or one whose detect stage has finished.
        path: The output file.
        truth: The true track, drawn into the map.
        true_ranges: The true ranges, drawn with the estimated ones.
        part: The time span and the views to record.
        labels: Truth file whose labelled boxes are drawn into the pictures.

    Raises:
        SchemaError: The labelled boxes cannot be read.
        UsageError: The run has no data for any of the views.
        RunError: The run's tables are damaged, or the log with its pictures is not found.
        OutputError: The file cannot be written.
    """
    import rerun as rr

    from .columns import DriveTime
    from .layout import ViewData, blueprint
    from .marks import log_true_boxes
    from .scene_rows import longest_m, scene_rows

    if not part.is_whole:
        run = run_between(run, part.start_ns, part.end_ns)
        if truth is not None:
            rows = part.holds(truth.t_ns)
            truth = TruthTrack(truth.t_ns[rows], truth.x_m[rows], truth.y_m[rows])
        if true_ranges is not None:
            true_ranges = true_ranges.take(part.holds(true_ranges.t_ns))
    pose = _pose(run)
    scene = scene_rows(run)
    camera = run_camera(run) if part.shows("cameras") else None
    has_scene = any(part is not None for part in (scene.cues, scene.ranges, scene.belief))
    topic = None if camera is None else camera.topic.name
    shown = ViewData(topic, pose, has_scene, longest_m(scene), part)
    layout = blueprint(shown)
    true = {} if labels is None else true_marks(labels, run, scene.frames_ns.tolist())
    first_ns = int(scene.frames_ns[0]) if len(scene.frames_ns) else 0
    time = DriveTime(is_date(first_ns if pose is None else int(pose["t_ns"][0])))

    def write(partial: Path) -> None:
        recording = rr.RecordingStream("crosscue", recording_id=spelled(run.path.resolve().name))
        # By its number, because rerun takes no name that is not UTF-8.
        with os.fdopen(door.opened(partial, os.O_WRONLY), "wb") as file:
            recording.save(f"/dev/fd/{file.fileno()}", default_blueprint=layout)
            _log_all(recording, time, run, scene, shown, (truth, true_ranges), camera)
            if part.shows("cameras") and any(one.boxes for one in true.values()):
                log_true_boxes(recording, time, true)
            recording.flush()
            recording.disconnect()

    write_whole(path, write)


def _log_all(
    recording: rr.RecordingStream,
    time: DriveTime,
    run: RunFolder,
    scene: SceneRows,
    shown: ViewData,
    known: tuple[TruthTrack | None, TrueRanges | None],
    stored: StoredCamera | None,
) -> None:
    from . import ahead, camera, plan, series
    from .notes import notes

    truth, true_ranges = known
    pose, part = shown.pose, shown.part
    manifest = run.drive_manifest()
    vehicle = manifest.settings
    more: list[str] = []
    if pose is not None and part.shows("map"):
        plan.log_pose(recording, time, pose)
        plan.log_landmarks(recording, pose, run.table("pose")["landmark"].to_pylist())
        plan.log_intersection(recording, time, pose, scene)
    if pose is not None and part.shows("pose"):
        series.log_pose_series(recording, time, pose)
    if truth is not None and part.shows("map"):
        plan.log_truth(recording, time, truth)
    if len(scene.frames_ns):
        if part.shows("ahead"):
            ahead.log_ahead(recording, time, run, vehicle, scene, true_ranges)
        if part.shows("belief"):
            series.log_belief(recording, time, scene, vehicle)
        if part.shows("ranges"):
            series.log_ranges(recording, time, scene, true_ranges)
        if part.shows("cues"):
            series.log_cues(recording, time, scene)
        if part.shows("cameras"):
            _log_marks(recording, time, run, manifest)
    if stored is not None:
        left_out = camera.send_pictures(recording, time, stored, part)
        if left_out:
            more.append(f"{stored.topic.name}: {counted(left_out, 'picture')} cannot be decoded")
    recording.log("notes", notes(run, more), static=True)


def _log_marks(
    recording: rr.RecordingStream, time: DriveTime, run: RunFolder, manifest: DriveManifest
) -> None:
    from crosscue.detectors.cues.frame import CuePass
    from crosscue.eval.runs.tables.stored_frames import stored_frames

    from .anchored import Anchored
    from .marks import FRAMES_HELD, Overlays, log_styles

    detected = manifest.detected
    if detected is None:
        return
    log_styles(recording)
    marks = Overlays(manifest.settings, leg_texts(run))
    has_odometry = run.file("measurements.parquet").exists()
    anchored = Anchored(run, manifest, marks) if has_odometry else None
    cues = CuePass(manifest.settings)
    frames = stored_frames(run, detected, manifest.settings, with_road_masks=True)
    for number, frame in enumerate(frames):
        if anchored is None:
            marks.add(frame, cues(frame).objects)
        else:
            anchored.add(frame)
        if number % FRAMES_HELD == FRAMES_HELD - 1:
            marks.send(recording, time)
    marks.send(recording, time)


def _pose(run: RunFolder) -> dict[str, Floats] | None:
    """Return the columns of the pose, or None if the run has none."""
    table = run.filled("pose")
    if table is None:
        return None
    names = [name for name in table.column_names if name != "landmark"]
    return {name: np.asarray(table[name].to_numpy()) for name in names}
