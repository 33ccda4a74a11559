"""The estimate stage: the pose from the logs' signals, and the scene from stored detections.

No picture is opened unless landmarks are searched for: detections are read from the run's tables.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome
from crosscue.eval.pipeline.scene.looked_for import detector_notices
from crosscue.eval.pipeline.scene.outcome import SceneOutcome
from crosscue.eval.pipeline.scene.stage import (
    estimate_scene,
    features_of,
    gives_reasons,
    scene_schemas,
)
from crosscue.eval.runs.account import UNATTRIBUTED, Account, account, joined_accounts, reading_of
from crosscue.eval.runs.candidates import candidate_rows
from crosscue.eval.runs.folder import MANIFEST, RunFolder, write_manifest, write_timings
from crosscue.eval.runs.logs import log_names, log_rows
from crosscue.eval.runs.manifest import (
    ApproachRow,
    DetectManifest,
    EstimateCounts,
    EstimateManifest,
    LandmarksUsed,
    LogRow,
    PoseSummary,
    SceneSummary,
    Timings,
    selection_record,
)
from crosscue.eval.runs.tables import measurements
from crosscue.eval.runs.tables.labelled import LabelledSink
from crosscue.eval.runs.tables.mobileye_tables import MobileyeSink, StoredMobileye
from crosscue.eval.runs.tables.parquet import TableSink
from crosscue.eval.runs.tables.pose_tables import PoseTally, pose_rows, pose_schema
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.localization.landmarks.database import LandmarkDatabase
from crosscue.replay.base import Log, Selection
from crosscue.replay.files.whole_file import sha256_of
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor, probe_clocks
from crosscue.replay.signals.kinds import Signal, SignalPlan
from crosscue.replay.signals.plan import chosen_camera, plan, with_pictures
from crosscue.replay.signals.windows import windows
from crosscue.replay.time.segments import (
    LogClock,
    TimedLog,
    Timeline,
    gaps_text,
    shift_of,
)
from crosscue.replay.vehicle.roles import Role, role_of
from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.replay.versions import versions_and_commit

from .clocks import clock_changes, clock_rows
from .drive_time import drive_timeline, refuse_other_segments, selections_of, time_segments
from .empty_result import empty_result, silent_roles
from .landmarks import landmark_stage
from .pose import PoseStage, estimating_of, fused_positions, turn_signal_of
from .progress import report_time
from .visual import VisualSource, visual_source, with_visual_scale

if TYPE_CHECKING:
    import pyarrow as pa


@dataclass(frozen=True, slots=True)
class Earlier:
    """What earlier stages found.

    Attributes:
        detected: Outcome of the detect stage, if it ran just now.
        manifest: Manifest of the detect stage, if it ran earlier.
        logs: ``log_rows`` of the run, if already computed.
        timeline: The drive's time segments, if already known.
    """

    detected: DetectOutcome | None = None
    manifest: DetectManifest | None = None
    logs: Sequence[LogRow] | None = None
    timeline: Timeline | None = None


def estimate_into(
    logs: Sequence[Log],
    vehicle: Vehicle,
    run: RunFolder,
    selection: Selection,
    before: Earlier,
    landmarks: LandmarkDatabase | None = None,
) -> Outcome:
    """Write pose, cues, ranges, beliefs and the manifest into a locked run folder.

    Args:
        logs: All open logs of the drive.
        vehicle: Settings of the vehicle file.
        run: The run folder, with or without tables of the detect stage.
        selection: The part of the logs to use.
        before: What earlier stages found.
        landmarks: Database with which camera frames are compared, or None.

    Raises:
        VehicleError: The vehicle file does not fit the logs.
        EmptyResultError: The selected part contains nothing to estimate from.
        UsageError: The frames of the detect stage have other time segments.
        OutputError: The disk is full.
    """
    began = time.monotonic()
    detected = before.detected
    found = before.manifest if detected is None else run.drive_manifest().detected
    kept = None if found is None else _camera_skips(run, found.camera)
    reading = _Reading(logs, vehicle, selection, landmarks, before.timeline, found)
    if found is not None:
        refuse_other_segments(run, reading.timeline)
    stage = _pose_stage(reading)
    if detected is None:
        begin_again(run, found)
    tally = _pose(reading, stage, run)
    silent = silent_roles(reading.planned, stage.received)
    _refuse_empty(reading, silent, tally)
    scene = None if found is None else _scene(run, vehicle, found, reading)
    made = _account(reading, stage, scene)
    write_skipped(run, reading.ledgers, made.reading, kept, reading.timeline)
    results = _Results(stage, tally, scene, made, _notices(reading, stage, silent))
    detect_s = 0.0 if detected is None else detected.seconds
    seconds = time.monotonic() - began + detect_s
    rows = _hashed(logs, run, found) if before.logs is None else tuple(before.logs)
    detecting = None if found is None else run.timings()
    detect = None if detecting is None else detecting.detect
    write_timings(run, Timings(seconds=seconds, detect=detect))
    write_manifest(run, _manifest(run, reading, results, rows))
    return Outcome(
        run,
        reading.ledgers,
        tally.rows,
        tally.travelled_m,
        tally.major_axis_m,
        results.notices,
        seconds,
        _driven_s(reading.timeline, tally),
        stage.landmarks.counts(),
        made,
        detected,
        scene,
        reading.timeline.segments,
    )


def _pose_stage(reading: _Reading) -> PoseStage:
    """Return the pose stage, connected to the search for landmarks if there is one."""
    vehicle, landmarks = reading.vehicle, reading.landmarks
    stage = PoseStage(
        vehicle,
        turn_signal_of(reading.planned, vehicle),
        positions=fused_positions(vehicle),
        timeline=reading.timeline,
    )
    if reading.camera is not None and landmarks is not None:
        at = reading.camera[0]
        search = landmark_stage(landmarks, vehicle, reading.ledgers[at])
        stage.landmarks, reading.extractors[at].on_pictures = search, search.see
    return stage


def _refuse_empty(reading: _Reading, silent: Mapping[Signal, str], tally: PoseTally) -> None:
    """Refuse a drive whose planned wheel speeds have no row, or that has nothing to estimate from.

    Raises:
        EmptyResultError: The selected part contains nothing to estimate from.
        LogError: Damage has left no row.
    """
    what = silent.get(Signal.WHEEL_SPEEDS)
    if what is None and not tally.rows and reading.found is None and reading.landmarks is None:
        why = reading.planned.missing.get(Signal.WHEEL_SPEEDS, "they yielded no pose")
        what = f"no detector has run over a camera, and of the wheel speeds: {why}"
    if what is not None:
        raise empty_result(what, reading.logs, reading.selection)


def _account(reading: _Reading, stage: PoseStage, scene: SceneOutcome | None) -> Account:
    """Return the account of the run, with the detect stage's part if it has run."""
    accounts, found = reading_of(reading.ledgers), reading.found
    if found is None or scene is None:
        return account(accounts, {}, estimating_of(stage, None))
    return account(
        joined_accounts(accounts, found.account.reading, found.camera),
        found.account.detecting,
        estimating_of(stage, (found.counts.frames, scene.frames)),
    )


def _notices(reading: _Reading, stage: PoseStage, silent: Mapping[Signal, str]) -> tuple[str, ...]:
    """Return the notices of the run, gaps first."""
    return (
        *gaps_text(reading.timeline.segments),
        *_missing(reading.planned, has_speed=stage.visual is not None),
        *silent.values(),
        *_no_mobileye(reading.found, reading.planned),
        *_no_scene(reading.found, reading),
        *_of_detecting(reading.found, reading.vehicle),
        *stage.notices,
        *stage.doubts(),
        *chain.from_iterable(
            clock_changes(each.clocks, each.watch.reports()) for each in reading.extractors
        ),
    )


class _Results(NamedTuple):
    """Results of the estimate stage."""

    stage: PoseStage
    tally: PoseTally
    scene: SceneOutcome | None
    account: Account
    notices: tuple[str, ...]


def _manifest(
    run: RunFolder,
    reading: _Reading,
    results: _Results,
    rows: tuple[LogRow, ...],
) -> EstimateManifest:
    """Return the manifest of the run."""
    tally, scene, landmarks = results.tally, results.scene, reading.landmarks
    return EstimateManifest(
        versions=versions_and_commit(),
        logs=rows,
        selection=selection_record(reading.selection),
        settings=reading.vehicle,
        sources=_sources(reading.planned, reading.logs),
        clocks=tuple(clock_rows(each.clocks, each.watch.reports()) for each in reading.extractors),
        account=results.account,
        counts=EstimateCounts(**results.stage.counts()),
        time=time_segments(reading.timeline),
        landmarks=None if landmarks is None else _landmarks_used(landmarks, run),
        notices=results.notices,
        pose=PoseSummary(
            rows=tally.rows, travelled_m=tally.travelled_m, major_axis_m=tally.major_axis_m
        ),
        scene=None if scene is None else scene_summary(scene),
        detect=reading.found,
    )


def _landmarks_used(landmarks: LandmarkDatabase, run: RunFolder) -> LandmarksUsed:
    """Return the manifest's record of the landmark database."""
    return LandmarksUsed(
        database=run.relative(landmarks.path),
        landmarks=len(landmarks),
        sha256=sha256_of(landmarks.path),
    )


def _of_detecting(found: DetectManifest | None, vehicle: Vehicle) -> list[str]:
    """Return the notices of the detect stage except gaps, and those on what it stored."""
    if found is None:
        return []
    notices = [one for one in found.notices if one not in found.time.notices]
    return list(dict.fromkeys([*notices, *detector_notices(found, vehicle)]))


def _driven_s(timeline: Timeline, tally: PoseTally) -> float:
    """Return the time from the first row to the last, without gaps."""
    later = timeline.segments[1:]
    pairs = zip(timeline.segments, later, strict=False)
    gaps_ns = sum(b.start_ns - a.end_ns for a, b in pairs if b.breaks_odometry)
    return tally.seconds - gaps_ns * 1e-9


def _hashed(
    logs: Sequence[Log], run: RunFolder, found: DetectManifest | None
) -> tuple[LogRow, ...]:
    """Return the rows of the logs, from the detect stage of this run if it has hashed them."""
    return log_rows(logs, run) if found is None else found.logs


def begin_again(run: RunFolder, found: DetectManifest | None) -> None:
    """Restore the detect stage's manifest, so that an interrupted run does not look complete."""
    if found is None:
        run.file(MANIFEST).unlink(missing_ok=True)
    else:
        write_manifest(run, found)


class _Reading:
    """A drive's logs with their plan and chosen clocks."""

    def __init__(
        self,
        logs: Sequence[Log],
        vehicle: Vehicle,
        selection: Selection,
        landmarks: LandmarkDatabase | None,
        timeline: Timeline | None,
        found: DetectManifest | None,
    ) -> None:
        topics = [(i, topic) for i, log in enumerate(logs) for topic in log.topics]
        self.logs = logs
        self.vehicle = vehicle
        self.selection = selection
        self.landmarks = landmarks
        self.found = found
        self.has_camera = any(role_of(topic) is Role.CAMERA for _, topic in topics)
        self.planned = plan(topics, vehicle)
        self.camera = None if landmarks is None else chosen_camera(topics, vehicle)
        if self.camera is not None:
            self.planned = with_pictures(self.planned, self.camera)
        self.ledgers = tuple(Ledger(name) for name in log_names(logs))
        self.selections = selections_of(logs, self.planned, selection)
        if timeline is None:
            known = None if found is None else found.timeline
            timeline = drive_timeline(logs, vehicle, selection, self.camera, known)
        self.timeline = timeline
        clocks = [
            probe_clocks(log, self.planned, vehicle, i, self.selections[i])
            for i, log in enumerate(logs)
        ]
        self.extractors = [
            SampleExtractor(
                self.planned, vehicle, i, ledger, clocks[i], shift_at=shift_of(timeline, i)
            )
            for i, ledger in enumerate(self.ledgers)
        ]

    @property
    def timed(self) -> list[TimedLog]:
        """The logs in drive time."""
        return [TimedLog(log, self.timeline.clock(i)) for i, log in enumerate(self.logs)]

    def visual(self, run: RunFolder) -> VisualSource | None:
        """Return the odometry by the pictures, if the run has it and no log has a speed."""
        has_speed = self.planned.source_of(Signal.WHEEL_SPEEDS) is not None
        return None if has_speed or self.vehicle.odometry.kind == "wheels" else visual_source(run)

    def clock_of(self, signal: Signal) -> LogClock:
        """Return the clock of the log that a signal comes from."""
        source = self.planned.source_of(signal)
        return self.timeline.clock(0 if source is None else source.log)


def _pose(reading: _Reading, stage: PoseStage, run: RunFolder) -> PoseTally:
    tally = PoseTally()
    timeline, clock = reading.timeline, reading.clock_of(Signal.WHEEL_SPEEDS)
    visual = reading.visual(run)
    if visual is not None and reading.found is not None:
        clock = timeline.clock(reading.found.camera_log)
    with (
        LabelledSink(run, "pose", pose_schema(), timeline, clock) as sink,
        LabelledSink(
            run, measurements.TABLE, measurements.measurement_schema(), timeline, clock
        ) as measured,
        MobileyeSink(run, timeline, reading.clock_of(Signal.MOBILEYE_OBSTACLES)) as mobileye,
    ):
        for window in windows(
            reading.timed, reading.extractors, reading.selections, reading.planned
        ):
            for poses in stage(window):
                sink.write(pose_rows(poses, stage.landmarks.take_names(poses.t_ns)))
                tally.add(poses)
            _write_all(measured, stage.take_measured())
            mobileye.write(window.samples)
            report_time("estimating the pose", timeline, window.end_ns)
        for poses in chain(stage.finish(), () if visual is None else stage.follow(visual)):
            sink.write(pose_rows(poses, stage.landmarks.take_names(poses.t_ns)))
            tally.add(poses)
        _write_all(measured, stage.take_measured())
    return tally


def _write_all(sink: TableSink, parts: Sequence[Mapping[str, object]]) -> None:
    for columns in parts:
        if columns["kind"]:
            sink.write(columns)


def _scene(
    run: RunFolder, vehicle: Vehicle, found: DetectManifest, reading: _Reading
) -> SceneOutcome:
    timeline, clock = reading.timeline, reading.timeline.clock(found.camera_log)
    if reading.visual(run) is not None:
        vehicle = with_visual_scale(vehicle)
    with ExitStack() as stack:
        sinks = {
            name: stack.enter_context(LabelledSink(run, name, schema, timeline, clock))
            for name, schema in scene_schemas(
                features_of(vehicle), gives_reasons=gives_reasons(vehicle)
            ).items()
        }
        past = StoredMobileye(run, vehicle.past)
        return estimate_scene(
            run,
            vehicle,
            found,
            lambda name, rows: sinks[name].write(rows),
            past.cues,
            timeline=timeline,
            on_restart=past.forget_before,
        )


def scene_summary(scene: SceneOutcome) -> SceneSummary:
    """Return the scene in the form of the manifest."""
    return SceneSummary(
        frames=scene.frames,
        positive=dict(scene.positive),
        counts=dict(scene.counts),
        without_odometry=scene.without_odometry,
        approaches=tuple(ApproachRow(**asdict(one)) for one in scene.approaches),
        candidates=candidate_rows(scene.candidates),
        ranged=candidate_rows(scene.ranged),
        not_looked_for=dict(scene.not_looked_for),
    )


def _camera_skips(run: RunFolder, camera: str) -> pa.Table:
    """Return the detect stage's skipped rows of the camera; other topics are read again."""
    import pyarrow.compute as pc

    table = run.table("skipped")
    ours = pc.or_(pc.equal(table["topic"], camera), pc.equal(table["topic"], UNATTRIBUTED))
    return table.filter(ours)


def _sources(planned: SignalPlan, logs: Sequence[Log]) -> dict[str, str | None]:
    """Return the log and topic of each signal."""
    names = log_names(logs)
    found = {signal: planned.source_of(signal) for signal in Signal}
    return {
        signal.name.lower(): None if source is None else f"{names[source.log]}: {source.topic.name}"
        for signal, source in found.items()
    }


def _missing(planned: SignalPlan, *, has_speed: bool) -> list[str]:
    """Return notices about missing signals; ``has_speed`` if the pictures give the speed."""
    names = {
        Signal.WHEEL_SPEEDS: "no wheel speeds, so no pose",
        Signal.MAGNETIC_FIELD: "no compass, so the heading drifts",
    }
    has_heading = planned.source_of(Signal.HEADING) is not None
    return [
        f"{what}: {planned.missing[signal]}"
        for signal, what in names.items()
        if signal in planned.missing
        and not (has_heading if signal is Signal.MAGNETIC_FIELD else has_speed)
    ]


def _no_mobileye(found: DetectManifest | None, planned: SignalPlan) -> list[str]:
    reason = planned.missing.get(Signal.MOBILEYE_OBSTACLES)
    if found is None or reason is None:
        return []
    return [f"no Mobileye, so no lane lines or vehicles beyond the intersection: {reason}"]


def _no_scene(found: DetectManifest | None, reading: _Reading) -> list[str]:
    if found is not None:
        return []
    if not reading.has_camera:
        return ["no camera in the logs, so no cue and no belief"]
    return ["no detector ran on the camera, so no cue and no belief; name some"]
