"""What the estimate stage needs beside its loop: signals, tables of the pose, account, manifest.

No picture is opened unless landmarks are searched for: detections are read from the run's tables.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final

from crosscue.eval.pipeline.outcome import DetectOutcome, Outcome
from crosscue.eval.runs.account import UNATTRIBUTED, Account, account, joined_accounts, reading_of
from crosscue.eval.runs.drive import Drive
from crosscue.eval.runs.folder import RunFolder, write_manifest, write_timings
from crosscue.eval.runs.logs import log_names, log_rows
from crosscue.eval.runs.manifest import (
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
from crosscue.eval.runs.tables.mobileye_tables import MobileyeSink
from crosscue.eval.runs.tables.parquet import TableSink, arrow_column
from crosscue.eval.runs.tables.skipped import write_skipped
from crosscue.localization.pose_track import PoseColumns
from crosscue.replay.base import Log
from crosscue.replay.files.whole_file import file_sha256, sha256_of
from crosscue.replay.ledger import Ledger
from crosscue.replay.signals.extractor import SampleExtractor, probe_clocks
from crosscue.replay.signals.kinds import Signal, SignalPlan
from crosscue.replay.signals.plan import plan, with_pictures
from crosscue.replay.signals.windows import SampleWindow, windows
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
from .drive_time import refuse_other_segments, selections_of, time_segments
from .empty_result import empty_result, silent_roles
from .pose import PoseStage, estimating_of, fused_positions, turn_signal_of
from .progress import report_time

if TYPE_CHECKING:
    import pyarrow as pa

    from crosscue.localization.landmarks.database import LandmarkDatabase

    from .visual import VisualSource

COVARIANCES: Final = ("xx_m2", "xy_m2", "xh_mrad", "yy_m2", "yh_mrad", "hh_rad2")


@dataclass(frozen=True, slots=True)
class Earlier:
    """What earlier stages found.

    Attributes:
        detected: Outcome of the detect stage, if it ran just now.
        manifest: Manifest of the detect stage, if it ran earlier.
        logs: ``log_rows`` of the run, if already computed.
    """

    detected: DetectOutcome | None = None
    manifest: DetectManifest | None = None
    logs: Sequence[LogRow] | None = None


class EstimateStage:
    """Pose and scene of a drive, with the account and the manifest of a locked run folder.

    Attributes:
        found: Manifest of the detect stage; None if no detector ran.
        pose: The pose filter.
    """

    def __init__(
        self,
        drive: Drive,
        run: RunFolder,
        before: Earlier,
        landmarks: LandmarkDatabase | None = None,
    ) -> None:
        """Plan the signals of a drive.

        Args:
            drive: The drive, with its time segments.
            run: The run folder, with or without tables of the detect stage.
            before: What earlier stages found.
            landmarks: Database with which camera frames are compared, or None.

        Raises:
            VehicleError: The vehicle file does not fit the logs.
            UsageError: The frames of the detect stage have other time segments.
        """
        self._began = time.monotonic()
        self._drive, self._run, self._before, self._landmarks = drive, run, before, landmarks
        found = before.manifest if before.detected is None else run.drive_manifest().detected
        self.found = found
        self._camera_skips = None if found is None else _camera_skips(run, found.camera)
        vehicle = drive.vehicle
        camera = None if landmarks is None else drive.camera
        self._planned = plan(drive.topics, vehicle)
        if camera is not None:
            self._planned = with_pictures(self._planned, camera)
        self._ledgers = tuple(Ledger(name) for name in log_names(drive.logs))
        self._selections = selections_of(drive, self._planned)
        clocks = [
            probe_clocks(log, self._planned, vehicle, i, self._selections[i])
            for i, log in enumerate(drive.logs)
        ]
        self._extractors = [
            SampleExtractor(
                self._planned, vehicle, i, ledger, clocks[i], shift_at=shift_of(drive.segments, i)
            )
            for i, ledger in enumerate(self._ledgers)
        ]
        if found is not None:
            refuse_other_segments(run, drive.segments)
        self.pose = PoseStage(
            vehicle,
            turn_signal_of(self._planned, vehicle),
            positions=fused_positions(vehicle),
            timeline=drive.segments,
        )
        if camera is not None and landmarks is not None:
            from .landmarks import landmark_stage  # matches pictures

            search = landmark_stage(landmarks, vehicle, self._ledgers[camera[0]])
            self.pose.landmarks = search
            self._extractors[camera[0]].on_pictures = search.see
        has_speed = self._planned.source_of(Signal.WHEEL_SPEEDS) is not None
        self._visual: VisualSource | None = None
        if not has_speed and vehicle.odometry.kind != "wheels":
            from .visual import visual_source

            self._visual = visual_source(run)
        self._tally = PoseTally()

    def windows(self) -> Iterator[SampleWindow]:
        """Yield the signals of the logs, in order of time."""
        drive = self._drive
        timed = [TimedLog(log, drive.segments.clock(i)) for i, log in enumerate(drive.logs)]
        for window in windows(timed, self._extractors, self._selections, self._planned):
            yield window
            report_time("estimating the pose", drive.segments, window.end_ns)

    def last_poses(self) -> Iterator[PoseColumns]:
        """Yield the poses that waited for more signals, and those of odometry by pictures."""
        yield from self.pose.finish()
        if self._visual is not None:
            yield from self.pose.follow(self._visual)

    @contextmanager
    def tables(self) -> Iterator[PoseTables]:
        """Yield the tables of the pose; refuse a drive without anything to estimate from.

        Raises:
            EmptyResultError: The selected part contains nothing to estimate from.
            OutputError: The disk is full.
        """
        timeline, clock = self._drive.segments, self._clock_of(Signal.WHEEL_SPEEDS)
        if self._visual is not None and self.found is not None:
            clock = timeline.clock(self.found.camera_log)
        device = self._clock_of(Signal.MOBILEYE_OBSTACLES)
        with (
            LabelledSink(self._run, "pose", timeline, clock) as poses,
            LabelledSink(self._run, measurements.TABLE, timeline, clock) as inputs,
            MobileyeSink(self._run, timeline, device) as mobileye,
        ):
            yield PoseTables(self.pose, poses, inputs, mobileye, self._tally)
        self._silent = silent_roles(self._planned, self.pose.received)
        self._refuse_empty()

    def scene_drive(self) -> Drive:
        """Return the drive with the errors that its ranges have."""
        if self._visual is None:
            return self._drive
        from .visual import with_visual_scale

        return replace(self._drive, vehicle=with_visual_scale(self._drive.vehicle))

    def finish(self, scene: SceneSummary | None) -> Outcome:
        """Write account, timings and manifest.

        Raises:
            OutputError: The disk is full.
        """
        run, drive, tally, found = self._run, self._drive, self._tally, self.found
        made = self._account(scene)
        write_skipped(run, self._ledgers, made.reading, self._camera_skips, drive.segments)
        notices = self._notices()
        detected = self._before.detected
        seconds = time.monotonic() - self._began + (0.0 if detected is None else detected.seconds)
        rows = self._before.logs
        if rows is None:
            rows = log_rows(drive.logs, run) if found is None else found.logs
        timings = None if found is None else run.timings()
        detect = None if timings is None else timings.detect
        write_timings(run, Timings(seconds=seconds, detect=detect))
        landmarks, road_map = self._landmarks, drive.vehicle.road_map
        manifest = EstimateManifest(
            versions=versions_and_commit(),
            logs=tuple(rows),
            selection=selection_record(drive.selection),
            settings=drive.vehicle,
            sources=_sources(self._planned, drive.logs),
            clocks=tuple(
                clock_rows(each.clocks, each.watch.reports()) for each in self._extractors
            ),
            account=made,
            counts=EstimateCounts(**self.pose.counts()),
            time=time_segments(drive.segments),
            landmarks=None if landmarks is None else _landmarks_used(landmarks, run),
            notices=notices,
            pose=PoseSummary(
                rows=tally.rows, travelled_m=tally.travelled_m, major_axis_m=tally.major_axis_m
            ),
            scene=scene,
            detect=found,
            map_sha256=file_sha256(Path(road_map)) if road_map and scene else None,
        )
        write_manifest(run, manifest)
        return Outcome(
            run,
            self._ledgers,
            tally.rows,
            tally.travelled_m,
            tally.major_axis_m,
            notices,
            seconds,
            _driven_s(drive.segments, tally),
            self.pose.landmarks.counts(),
            made,
            detected,
            scene,
            drive.segments.segments,
        )

    def _clock_of(self, signal: Signal) -> LogClock:
        source = self._planned.source_of(signal)
        return self._drive.segments.clock(0 if source is None else source.log)

    def _refuse_empty(self) -> None:
        """Refuse a drive whose planned wheel speeds have no row, or that has nothing to use."""
        what = self._silent.get(Signal.WHEEL_SPEEDS)
        if not (what or self._tally.rows or self.found or self._landmarks):
            why = self._planned.missing.get(Signal.WHEEL_SPEEDS, "they yielded no pose")
            what = f"no detector has run over a camera, and of the wheel speeds: {why}"
        if what is not None:
            raise empty_result(what, self._drive.logs, self._drive.selection)

    def _account(self, scene: SceneSummary | None) -> Account:
        accounts, found = reading_of(self._ledgers), self.found
        if found is None or scene is None:
            return account(accounts, {}, estimating_of(self.pose, None))
        return account(
            joined_accounts(accounts, found.account.reading, found.camera),
            found.account.detecting,
            estimating_of(self.pose, (found.counts.frames, scene.frames)),
        )

    def _notices(self) -> tuple[str, ...]:
        """Return the notices of the run, gaps first."""
        planned, found, stage = self._planned, self.found, self.pose
        return (
            *gaps_text(self._drive.segments.segments),
            *_missing(planned, has_speed=stage.visual is not None),
            *self._silent.values(),
            *_no_mobileye(found, planned),
            *_no_scene(found, self._drive),
            *_of_detecting(found, self._drive.vehicle),
            *stage.notices,
            *stage.doubts(),
            *chain.from_iterable(
                clock_changes(each.clocks, each.watch.reports()) for each in self._extractors
            ),
        )


@dataclass(frozen=True, slots=True)
class PoseTables:
    """Tables of the pose: its rows, the filter's inputs, and a Mobileye's rows."""

    pose: PoseStage
    poses: TableSink
    inputs: TableSink
    mobileye: MobileyeSink
    tally: PoseTally

    def add(self, rows: Iterable[PoseColumns], window: SampleWindow | None = None) -> None:
        """Add rows of poses, and what the filter has used for them."""
        for poses in rows:
            self.poses.write(pose_rows(poses, self.pose.landmarks.take_names(poses.t_ns)))
            self.tally.add(poses)
        for columns in self.pose.take_measured():
            if columns["kind"]:
                self.inputs.write(columns)
        if window is not None:
            self.mobileye.write(window.samples)


def _landmarks_used(landmarks: LandmarkDatabase, run: RunFolder) -> LandmarksUsed:
    return LandmarksUsed(
        database=run.relative(landmarks.path),
        landmarks=len(landmarks),
        sha256=sha256_of(landmarks.path),
    )


def _of_detecting(found: DetectManifest | None, vehicle: Vehicle) -> list[str]:
    """Return the notices of the detect stage except gaps, and those on what it stored."""
    if found is None:
        return []
    from .scene.looked_for import detector_notices

    notices = [one for one in found.notices if one not in found.time.notices]
    return list(dict.fromkeys([*notices, *detector_notices(found, vehicle)]))


def _driven_s(timeline: Timeline, tally: PoseTally) -> float:
    """Return the time from the first row to the last, without gaps."""
    later = timeline.segments[1:]
    pairs = zip(timeline.segments, later, strict=False)
    gaps_ns = sum(b.start_ns - a.end_ns for a, b in pairs if b.breaks_odometry)
    return tally.seconds - gaps_ns * 1e-9


def _camera_skips(run: RunFolder, camera: str) -> pa.Table:
    """Return the detect stage's skipped rows of the camera; other topics are read again."""
    import pyarrow as pa
    import pyarrow.compute as pc

    table = run.table("skipped")
    ours = arrow_column([camera, UNATTRIBUTED], pa.string())
    return table.filter(pc.is_in(table["topic"], value_set=ours))


def _sources(planned: SignalPlan, logs: Sequence[Log]) -> dict[str, str | None]:
    names = log_names(logs)
    found = {signal: planned.source_of(signal) for signal in Signal}
    return {
        signal.name.lower(): None if source is None else f"{names[source.log]}: {source.topic.name}"
        for signal, source in found.items()
    }


def _missing(planned: SignalPlan, *, has_speed: bool) -> list[str]:
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


def _no_scene(found: DetectManifest | None, drive: Drive) -> list[str]:
    if found is not None:
        return []
    if not any(role_of(topic) is Role.CAMERA for _, topic in drive.topics):
        return ["no camera in the logs, so no cue and no belief"]
    return ["no detector ran on the camera, so no cue and no belief; name some"]


@dataclass(slots=True)
class PoseTally:
    """Running summary of all poses of a run."""

    rows: int = 0
    travelled_m: float = 0.0
    major_axis_m: float = float("nan")
    first_ns: int | None = None
    last_ns: int = 0

    @property
    def seconds(self) -> float:
        """Time from the first row to the last."""
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) * 1e-9

    def add(self, poses: PoseColumns) -> None:
        """Add a non-empty batch of poses."""
        self.rows += len(poses)
        self.travelled_m = float(poses.travelled_m[-1])
        self.major_axis_m = float(poses.major_axis_m[-1])
        self.last_ns = int(poses.t_ns[-1])
        if self.first_ns is None:
            self.first_ns = int(poses.t_ns[0])


def pose_rows(poses: PoseColumns, landmarks: Sequence[str | None]) -> dict[str, object]:
    """Return rows of ``pose.parquet``, with the landmark that corrected each pose."""
    rows: dict[str, object] = {
        "t_ns": poses.t_ns,
        "x_m": poses.x_m,
        "y_m": poses.y_m,
        "heading_rad": poses.heading_rad,
        "speed_mps": poses.speed_mps,
    }
    rows |= {f"cov_{name}": poses.cov_xyh[:, i] for i, name in enumerate(COVARIANCES)}
    rows |= {"major_axis_m": poses.major_axis_m, "travelled_m": poses.travelled_m}
    return rows | {"landmark": list(landmarks)}
