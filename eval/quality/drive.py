"""Everything that the checks of a drive look at, read in a few passes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from crosscue.eval.vehicle.check import SignalRow, judge_signals, read_samples
from crosscue.eval.vehicle.mounting import CarMotion, MountingWatch, watch_camera
from crosscue.eval.vehicle.picture_pass import PicturePass
from crosscue.localization.camera_delay import CameraDelay
from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import VehicleError
from crosscue.replay.logs.log_summary import LogSummary, TopicSummary, summarise_log
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan
from crosscue.replay.signals.plan import chosen_camera, plan
from crosscue.replay.vehicle.drafting.camera import first_camera
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.vehicle import Camera, Vehicle

NOTHING: Final = SignalPlan((), {})


@dataclass(frozen=True, slots=True, eq=False)
class QualityDrive:
    """A drive as the checks see it.

    Attributes:
        vehicle: The vehicle file.
        summaries: Topics, clocks and account of each log.
        samples: Readings of the signals that a run would use.
        planned: Topics of these signals.
        unplanned: Why topics could not be chosen; empty if they could.
        rows: What the signals say of each other.
        contradictions: The same, between signals, in sentences.
        camera: Topic of the camera; empty without one.
        intrinsics: What is known of the camera.
        has_focal: True if its focal length is known.
        pictures: What its pictures show; None without a camera.
        delays: Delay of the pictures by each signal.
        mounting: Mounting of the camera over the drive.
        selection: The part that was read.
    """

    vehicle: Vehicle
    summaries: tuple[LogSummary, ...]
    samples: dict[Signal, Samples] = field(default_factory=dict)
    planned: SignalPlan = NOTHING
    unplanned: str = ""
    rows: tuple[SignalRow, ...] = ()
    contradictions: tuple[str, ...] = ()
    camera: str = ""
    intrinsics: Camera = field(default_factory=Camera)
    has_focal: bool = False
    pictures: PicturePass | None = None
    delays: tuple[CameraDelay, ...] = ()
    mounting: MountingWatch | None = None
    selection: Selection = field(default_factory=Selection)

    @property
    def topics(self) -> tuple[TopicSummary, ...]:
        """Topics of all logs."""
        return tuple(topic for log in self.summaries for topic in log.topics)

    @property
    def used_topics(self) -> dict[str, str]:
        """What each topic that a run would read is used for, by its name."""
        names = {
            source.topic.name: ", ".join(words_of(signal) for signal in source.signals)
            for source in self.planned.sources
        }
        return names | ({self.camera: "camera"} if self.camera else {})

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time of the topics that a run would read."""
        times = [one.t_ns for one in self.samples.values() if len(one.t_ns)]
        if self.pictures is not None and len(self.pictures.t_ns):
            times.append(self.pictures.t_ns)
        if not times:
            return 0, 0
        return min(int(t.min()) for t in times), max(int(t.max()) for t in times)

    def series(self, signal: Signal) -> Series | None:
        """Return the readings of a signal of one column; of wheels, the mean speed of the rear."""
        found = self.samples.get(signal)
        if found is None or len(found.t_ns) < 2:
            return None
        values = found.values
        if signal is Signal.WHEEL_SPEEDS:
            values = values[:, 2:].mean(axis=1)
        elif signal is Signal.COURSE:
            values = values[:, 1]
        series = Series.of(words_of(signal), found.t_ns, values)
        return series if len(series) > 1 else None

    def moving(self, t_ns: Int64s, least_mps: float = 1.0) -> Floats:
        """Return 1 where the car moves, 0 where it stands, NaN where its speed is unknown."""
        speed = self.series(Signal.WHEEL_SPEEDS) or self.series(Signal.COURSE)
        if speed is None:
            return np.full(len(t_ns), np.nan)
        moves = (np.abs(speed.values) > least_mps).astype(np.float64)
        known = (t_ns >= speed.t_ns[0]) & (t_ns <= speed.t_ns[-1])
        return np.where(known, np.interp(t_ns, speed.t_ns, moves), np.nan)


def words_of(signal: Signal) -> str:
    """Return the name of a signal in words."""
    return signal.name.lower().replace("_", " ")


def examine_drive(logs: Sequence[Log], vehicle: Vehicle, selection: Selection) -> QualityDrive:
    """Read a drive: its clocks and account, its signals, and its pictures.

    Args:
        logs: Open logs of one drive.
        vehicle: The vehicle file.
        selection: The part to read.
    """
    summaries = tuple(summarise_log(log, selection) for log in logs)
    topics = [(i, topic) for i, log in enumerate(logs) for topic in log.topics]
    planned, camera, why = NOTHING, None, ""
    try:
        planned = plan(topics, vehicle)
        camera = chosen_camera(topics, vehicle)
    except VehicleError as error:
        why = str(error)
    samples = read_samples(logs, vehicle, planned, selection)
    rows, contradictions = judge_signals(samples, planned, vehicle)
    drive = QualityDrive(
        vehicle, summaries, samples, planned, why, tuple(rows), tuple(contradictions),
        selection=selection,
    )  # fmt: skip
    if camera is None:
        return drive
    number, topic = camera
    known = vehicle.camera
    if known.focal_px is None and (first := first_camera(logs)) is not None and first[2]:
        focal_px, center_px, _, size_px = first[2]
        known = known.model_copy(
            update={"focal_px": focal_px, "center_px": center_px, "size_px": size_px}
        )
    motion = CarMotion(drive.series(Signal.WHEEL_SPEEDS), drive.series(Signal.YAW_RATE))
    watched = watch_camera(logs[number], number, topic.name, vehicle, known, motion, selection)
    return replace(
        drive,
        camera=topic.name,
        intrinsics=known,
        has_focal=known.focal_px is not None,
        pictures=watched.seen,
        delays=watched.delays,
        mounting=watched.mounting if known.focal_px is not None else None,
    )
