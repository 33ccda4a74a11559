"""The main job: one pass over a drive's logs into a run folder."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import TYPE_CHECKING, Final

from crosscue.localization.landmark_database import LandmarkDatabase
from crosscue.localization.pose_track import PoseColumns
from crosscue.replay.clocks import Clock
from crosscue.replay.columns import Topic
from crosscue.replay.ledger import Ledger, TopicAccount
from crosscue.replay.log import Log, Selection
from crosscue.replay.run_folder import (
    RunFolder,
    TableSink,
    clear,
    locked,
    sha256_of,
    write_manifest,
)
from crosscue.replay.signals import Extractor, Plan, Signal, camera_of, plan, with_pictures
from crosscue.replay.vehicle import Vehicle
from crosscue.replay.windows import windows

from . import measurements
from .landmark_stage import looking
from .pose_stage import PoseStage, turn_signal_of

if TYPE_CHECKING:
    import pyarrow as pa

PROBE_NS: Final = 10_000_000_000
"""Log time looked at before a clock is chosen for each topic."""
COVARIANCES: Final = ("xx_m2", "xy_m2", "xh_mrad", "yy_m2", "yh_mrad", "hh_rad2")


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a replay did.

    Attributes:
        run: Its folder.
        ledgers: One account for each log.
        rows: Pose rows written.
        travelled_m: Along the estimated track.
        major_axis_m: At the end; NaN without any pose.
        notices: Plain sentences for the person who ran it.
        seconds: Wall time.
        drive_seconds: Log time from first to last pose row.
        landmark_counts: What became of camera frames; empty where no landmarks were given.
    """

    run: RunFolder
    ledgers: tuple[Ledger, ...]
    rows: int
    travelled_m: float
    major_axis_m: float
    notices: tuple[str, ...]
    seconds: float
    drive_seconds: float
    landmark_counts: dict[str, int]

    @property
    def exit_status(self) -> int:
        """3 when anything was lost, else 0."""
        return 0 if all(ledger.is_whole for ledger in self.ledgers) else 3


def replay_drive(
    logs: Sequence[Log],
    vehicle: Vehicle,
    run: RunFolder,
    selection: Selection,
    on_time: Callable[[int], None] = lambda _: None,
    landmarks: LandmarkDatabase | None = None,
) -> Outcome:
    """Replay one drive into an empty or to be overwritten run folder.

    Args:
        logs: All logs of the drive, open.
        vehicle: What the vehicle file says.
        run: Where to; locked while this works, cleared first.
        selection: Which part of the logs.
        on_time: Told the log time that has been reached, for progress.
        landmarks: Camera frames are compared with these, where given.

    Raises:
        VehicleError: The vehicle file does not fit the logs.
        OutputError: The disk is full.
    """
    began = time.monotonic()
    topics = [(i, topic) for i, log in enumerate(logs) for topic in log.topics]
    planned = plan(topics, vehicle)
    camera = None if landmarks is None else camera_of(topics, vehicle)
    if camera is not None:
        planned = with_pictures(planned, camera)
    ledgers = tuple(Ledger(str(log.path)) for log in logs)
    selections = [_narrowed(selection, planned.topics_of(i)) for i in range(len(logs))]
    clocks = [
        probe_clocks(log, Extractor(planned, vehicle, i, Ledger("")), selections[i])
        for i, log in enumerate(logs)
    ]
    extractors = [
        Extractor(planned, vehicle, i, ledger, clocks[i]) for i, ledger in enumerate(ledgers)
    ]
    stage = PoseStage(vehicle, turn_signal_of(planned, vehicle))
    if camera is not None and landmarks is not None:
        stage.landmarks = looking(landmarks, vehicle, ledgers[camera[0]])
        extractors[camera[0]].on_pictures = stage.landmarks.see
    with locked(run):
        clear(run)
        tally = _Tally()
        with (
            TableSink(run, "pose", pose_schema()) as sink,
            TableSink(run, measurements.TABLE, measurements.schema()) as measured,
        ):
            for window in windows(logs, extractors, selections, planned):
                for poses in stage(window):
                    sink.write(pose_rows(poses, stage.landmarks.take_names(poses.t_ns)))
                    tally.add(poses)
                _write_all(measured, stage.take_measured())
                on_time(window.end_ns)
            for poses in stage.finish():
                sink.write(pose_rows(poses, stage.landmarks.take_names(poses.t_ns)))
                tally.add(poses)
            _write_all(measured, stage.take_measured())
        with TableSink(run, "skipped", skipped_schema()) as sink:
            for ledger in ledgers:
                sink.write(skipped_rows(ledger))
        seconds = time.monotonic() - began
        notices = (
            *_missing(planned),
            *_no_camera(landmarks, camera),
            *stage.notices,
            *stage.doubts(),
            *_clock_changes(extractors),
        )
        write_manifest(run, {
            "versions": versions(),
            "logs": [
                {"path": str(log.path), "format": log.format, "sha256": sha256_of(log.path)}
                for log in logs
            ],
            "selection": {"start_ns": selection.start_ns, "end_ns": selection.end_ns},
            "settings": vehicle.model_dump(mode="json"),
            "sources": _sources(planned, logs),
            "clocks": [clock_rows(extractor) for extractor in extractors],
            "accounts": [account_of(ledger) for ledger in ledgers],
            "counts": stage.counts(),
            "landmarks": None if landmarks is None else {
                "database": str(landmarks.path), "landmarks": len(landmarks),
                "sha256": sha256_of(landmarks.path),
            },
            "notices": list(notices),
            "pose": {"rows": tally.rows, "travelled_m": tally.travelled_m,
                     "major_axis_m": tally.major_axis_m},
            "timings": {"seconds": seconds},
        })  # fmt: skip
    return Outcome(
        run, ledgers, tally.rows, tally.travelled_m, tally.major_axis_m, notices,
        seconds, tally.seconds, stage.landmarks.counts(),
    )  # fmt: skip


def _write_all(sink: TableSink, parts: Sequence[Mapping[str, object]]) -> None:
    for columns in parts:
        if columns["kind"]:
            sink.write(columns)


def probe_clocks(log: Log, extractor: Extractor, selection: Selection) -> dict[str, Clock]:
    """Which clock to use for each planned topic, judged by the log's first seconds."""
    first_ns: int | None = None
    for block in log.read(extractor.ledger, selection):
        if not len(block):
            continue
        first_ns = int(block.log_ns[0]) if first_ns is None else first_ns
        for _ in extractor(block):
            pass
        if int(block.log_ns[0]) - first_ns > PROBE_NS:
            break
    return {name: report.used for name, report in extractor.watch.reports().items()}


def clock_rows(extractor: Extractor) -> dict[str, object]:
    """Clock used and the whole pass's report for each topic, as plain values."""
    return {
        name: {
            "used": extractor.clocks.get(name, Clock.LOG).value,
            "why": report.why,
            "rows": report.of_used.rows,
            "rate_hz": report.rate_hz,
        }
        for name, report in extractor.watch.reports().items()
    }


def _clock_changes(extractors: Sequence[Extractor]) -> list[str]:
    """Topics whose clock would have been chosen otherwise in hindsight."""
    return [
        f"{name}: used the {extractor.clocks[name].value}, but over the whole log: {report.why}"
        for extractor in extractors
        for name, report in extractor.watch.reports().items()
        if name in extractor.clocks and extractor.clocks[name] is not report.used
    ]


@dataclass(slots=True)
class _Tally:
    rows: int = 0
    travelled_m: float = 0.0
    major_axis_m: float = float("nan")
    first_ns: int | None = None
    last_ns: int = 0

    @property
    def seconds(self) -> float:
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) * 1e-9

    def add(self, poses: PoseColumns) -> None:
        self.rows += len(poses)
        self.travelled_m = float(poses.travelled_m[-1])
        self.major_axis_m = float(poses.major_axis_m[-1])
        self.last_ns = int(poses.t_ns[-1])
        if self.first_ns is None:
            self.first_ns = int(poses.t_ns[0])


def _sources(planned: Plan, logs: Sequence[Log]) -> dict[str, str | None]:
    """From a signal to the log and topic that gave it."""
    found = {signal: planned.source_of(signal) for signal in Signal}
    return {
        signal.name.lower(): None
        if source is None
        else f"{logs[source.log].path}: {source.topic.name}"
        for signal, source in found.items()
    }


def _missing(planned: Plan) -> list[str]:
    """What the run had to do without, in plain words."""
    names = {
        Signal.WHEEL_SPEEDS: "no wheel speeds, so no pose",
        Signal.MAGNETIC_FIELD: "no compass, so the heading drifts",
    }
    has_heading = planned.source_of(Signal.HEADING) is not None
    return [
        f"{what}: {planned.missing[signal]}"
        for signal, what in names.items()
        if signal in planned.missing and not (signal is Signal.MAGNETIC_FIELD and has_heading)
    ]


def _no_camera(landmarks: LandmarkDatabase | None, camera: tuple[int, Topic] | None) -> list[str]:
    if landmarks is None or camera is not None:
        return []
    return ["landmarks were given, but the logs have no camera: none is looked for"]


def _narrowed(selection: Selection, planned: frozenset[str]) -> Selection:
    topics = planned if selection.topics is None else planned & selection.topics
    return Selection(topics, selection.start_ns, selection.end_ns)


def pose_schema() -> pa.Schema:
    """Columns of ``pose.parquet``."""
    import pyarrow as pa

    numbers = [
        "x_m", "y_m", "heading_rad", "speed_mps",
        *(f"cov_{name}" for name in COVARIANCES), "major_axis_m", "travelled_m",
    ]  # fmt: skip
    return pa.schema(
        [
            ("t_ns", pa.int64()),
            *((name, pa.float64()) for name in numbers),
            ("landmark", pa.string()),
        ]
    )


def pose_rows(poses: PoseColumns, landmarks: Sequence[str | None]) -> dict[str, object]:
    """Rows of ``pose.parquet``, with the landmark weighed in at each."""
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


def skipped_schema() -> pa.Schema:
    """Columns of ``skipped.parquet``."""
    import pyarrow as pa

    return pa.schema(
        [
            ("t_ns", pa.int64()),
            ("topic", pa.string()),
            ("reason", pa.string()),
            ("detail", pa.string()),
            ("count", pa.int64()),
            ("is_loss", pa.bool_()),
            ("log", pa.string()),
        ]
    )


def skipped_rows(ledger: Ledger) -> dict[str, object]:
    """Rows of ``skipped.parquet``: single skips and losses of one log."""
    details = ledger.details
    return {
        "t_ns": [d.t_ns for d in details],
        "topic": [d.topic for d in details],
        "reason": [d.reason for d in details],
        "detail": [d.detail for d in details],
        "count": [d.count for d in details],
        "is_loss": [d.is_loss for d in details],
        "log": [ledger.log] * len(details),
    }


def account_of(ledger: Ledger) -> dict[str, object]:
    """One log's account as plain values, for manifest and JSON output."""
    return {
        "log": ledger.log,
        "integrity": ledger.integrity,
        "is_whole": ledger.is_whole,
        "notices": list(ledger.notices),
        "topics": {name: _account(a) for name, a in sorted(ledger.accounts.items())},
    }


def _account(account: TopicAccount) -> dict[str, object]:
    return {
        "declared": account.declared,
        "in_file": account.in_file,
        "found": account.found,
        "used": account.used,
        "skipped": dict(sorted(account.skipped.items())),
        "lost": dict(sorted(account.lost.items())),
        "lost_unknown": sorted(set(account.lost_unknown)),
    }


def versions() -> dict[str, str]:
    """Of crosscue, Python and the libraries that results depend on."""
    libraries = ("crosscue", "numpy", "numba", "cantools", "rosbags", "mcap", "pyarrow")
    return {"python": platform.python_version(), **{name: version(name) for name in libraries}}
