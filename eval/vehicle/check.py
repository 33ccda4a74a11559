"""Check of a vehicle file: reads some seconds of a drive with it and reports contradictions."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from crosscue.detectors.images import decode, encoded, lose
from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import Bytes, Floats, Topic
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import SampleExtractor, pictures_of
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan
from crosscue.replay.signals.plan import chosen_camera, plan
from crosscue.replay.signals.windows import windows
from crosscue.replay.vehicle.drafting.agreement import (
    DEGREE,
    SignalVerdict,
    judge_speed,
    judge_steering,
    judge_yaw_rate,
    of_course,
    of_rate,
    of_steering,
    of_wheels,
)
from crosscue.replay.vehicle.drafting.camera import KnowsItsCameras
from crosscue.replay.vehicle.drafting.series import Grid, GroundTrack, Series
from crosscue.replay.vehicle.vehicle import Camera, Vehicle

WHEELS: Final = ("front left", "front right", "rear left", "rear right")
# Max relative difference of two focal lengths of the same pictures.
INTRINSICS_OFF: Final = 0.02
WHEEL_OFF: Final = 0.1
UNCONFIRMED: Final = "too few bends here for course or wheels to confirm its sign"


@dataclass(frozen=True, slots=True)
class SignalRow:
    """One signal, read as the vehicle file specifies.

    Attributes:
        signal: Name of the signal.
        source: Topic, and the signal names in the database.
        count: Number of readings in the seconds examined.
        rate_hz: Rate, from the median time between readings.
        low: Smallest reading, in ``unit``.
        high: Largest reading, in ``unit``.
        unit: Unit of ``low`` and ``high``.
        agrees: Signals that it agrees with, in words.
        wrong: Contradictions.
    """

    signal: str
    source: str
    count: int
    rate_hz: float
    low: float
    high: float
    unit: str
    agrees: str = ""
    wrong: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class CameraPicture:
    """One picture of the camera.

    Attributes:
        topic: Topic of the camera.
        t_ns: Time of the picture.
        pixels: Shape (H, W, 3), uint8, in BGR order.
    """

    topic: str
    t_ns: int
    pixels: Bytes


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """Result of a check.

    Attributes:
        signals: A row for each signal that is read.
        missing: Reason why a signal is not read, by signal.
        contradictions: Sentences, the most serious first.
        picture: Picture from the middle of the seconds examined; None without a camera.
    """

    signals: tuple[SignalRow, ...]
    missing: Mapping[str, str]
    contradictions: tuple[str, ...]
    picture: CameraPicture | None


def check_drive_signals(logs: Sequence[Log], vehicle: Vehicle, selection: Selection) -> Checked:
    """Read a part of a drive and compare its signals with each other.

    Args:
        logs: Open logs of one drive.
        vehicle: The vehicle file.
        selection: The part to read; its topics are ignored.

    Raises:
        VehicleError: The vehicle file does not fit the logs.
    """
    topics = [(i, topic) for i, log in enumerate(logs) for topic in log.topics]
    planned = plan(topics, vehicle)
    camera = chosen_camera(topics, vehicle)
    samples = read_samples(logs, vehicle, planned, selection)
    rows, contradictions = judge_signals(samples, planned, vehicle)
    picture = None
    if camera is not None:
        picture = _picture(logs[camera[0]], *camera, vehicle, selection)
        contradictions += _of_camera(picture, logs[camera[0]], vehicle.camera)
    missing = {
        signal.name.lower(): why for signal, why in planned.missing.items() if signal not in samples
    } | {
        signal.name.lower(): "not one reading in the seconds examined"
        for source in planned.sources
        for signal in source.signals
        if signal not in samples
    }
    return Checked(tuple(rows), missing, tuple(contradictions), picture)


def read_samples(
    logs: Sequence[Log], vehicle: Vehicle, planned: SignalPlan, selection: Selection
) -> dict[Signal, Samples]:
    """Return all readings in order of time, by signal.

    Args:
        logs: Open logs of one drive.
        vehicle: The vehicle file.
        planned: Topics of the signals.
        selection: The part to read; its topics are ignored.
    """
    ledgers = [Ledger(name_of(log)) for log in logs]
    extractors = [SampleExtractor(planned, vehicle, i, ledger) for i, ledger in enumerate(ledgers)]
    wanted = [
        Selection(planned.topics_of(i), selection.start_ns, selection.end_ns)
        for i in range(len(logs))
    ]
    parts: dict[Signal, list[Samples]] = {}
    for window in windows(logs, extractors, wanted, planned):
        for signal, samples in window.samples.items():
            parts.setdefault(signal, []).append(samples)
    for ledger in ledgers:
        warn_of(ledger)
    return {
        signal: Samples(
            signal,
            np.concatenate([one.t_ns for one in found]),
            np.concatenate([one.values for one in found]),
        )
        for signal, found in parts.items()
    }


def judge_signals(
    samples: Mapping[Signal, Samples], planned: SignalPlan, vehicle: Vehicle
) -> tuple[list[SignalRow], list[str]]:
    """Compare the signals with each other.

    Returns:
        A row for each signal, and the contradictions in sentences.
    """
    times = [one.t_ns for one in samples.values() if len(one.t_ns)]
    if not times:
        return [], []
    start_ns, end_ns = min(int(t[0]) for t in times), max(int(t[-1]) for t in times)
    grid = Grid.over(start_ns, end_ns)
    wheels = _wheels(samples)
    speed = wheels.get("rear")
    track = _track(samples, planned)
    turnings = [] if track is None else [of_course(track, grid)]
    references = [one for one in turnings if one is not None]
    if "rear left" in wheels and "rear right" in wheels and _differ(wheels):
        references.append(of_wheels(wheels["rear left"], wheels["rear right"], grid))
    yaw = _series(samples, planned, Signal.YAW_RATE)
    steering = _series(samples, planned, Signal.STEERING)
    verdicts: dict[Signal, SignalVerdict] = {}
    confirmed = yaw is not None and judge_yaw_rate(yaw, references, speed, grid).agrees_with > 0
    if steering is not None:
        rates = [] if yaw is None else [of_rate(yaw, 1, grid)]
        verdicts[Signal.STEERING] = judge_steering(
            _normalized(steering, vehicle), [*references, *rates], speed, grid
        )
        if speed is not None:
            references.append(of_steering(_normalized(steering, vehicle), 1, speed, grid))
    if yaw is not None:
        found = judge_yaw_rate(yaw, references, speed, grid)
        if not confirmed and not found.wrong:
            found = replace(found, facts=(*found.facts, UNCONFIRMED))
        verdicts[Signal.YAW_RATE] = found
    if speed is not None and track is not None:
        verdicts[Signal.WHEEL_SPEEDS] = judge_speed(speed, track.speed, grid, True)
    rows = [*_rows(samples, planned, vehicle, verdicts)]
    contradictions = [f"{row.signal}: {text}" for row in rows for text in row.wrong]
    return rows, [*contradictions, *_of_wheels(wheels)]


def _rows(
    samples: Mapping[Signal, Samples],
    planned: SignalPlan,
    vehicle: Vehicle,
    verdicts: Mapping[Signal, SignalVerdict],
) -> Iterator[SignalRow]:
    for signal, found in samples.items():
        source = planned.source_of(signal)
        if source is None:
            continue
        names = _named(signal, vehicle)
        verdict = verdicts.get(signal, SignalVerdict(()))
        wrong = verdict.wrong
        if verdict.sign < 0:
            wrong = ("is positive to the right: change its sign", *wrong)
        scale, unit = _UNITS.get(signal, (1.0, ""))
        values = found.values[:, 1] if signal is Signal.COURSE else found.values
        known = np.asarray(values)[np.isfinite(values)]
        yield SignalRow(
            signal.name.lower(),
            f"{source.topic.name}{': ' if names else ''}{', '.join(names)}",
            len(found.t_ns),
            Series("", found.t_ns, np.zeros(len(found.t_ns))).rate_hz,
            float(known.min() * scale) if len(known) else math.nan,
            float(known.max() * scale) if len(known) else math.nan,
            unit,
            # Rate and range have their own columns.
            ", ".join(verdict.facts[2:]),
            wrong,
        )


_UNITS: Final = {
    Signal.WHEEL_SPEEDS: (1.0, "m/s"),
    Signal.YAW_RATE: (1.0 / DEGREE, "deg/s"),
    Signal.STEERING: (1.0 / DEGREE, "deg"),
    Signal.MAGNETIC_FIELD: (1e6, "uT"),
    Signal.HEADING: (1.0 / DEGREE, "deg"),
    Signal.COURSE: (1.0, "m/s"),
}


def _named(signal: Signal, vehicle: Vehicle) -> tuple[str, ...]:
    can = vehicle.can
    if signal is Signal.WHEEL_SPEEDS and can.wheel_speeds is not None:
        of = can.wheel_speeds
        names = (of.front_left, of.front_right, of.rear_left, of.rear_right)
        return tuple(dict.fromkeys(name for name in names if name is not None))
    section = {Signal.YAW_RATE: can.yaw_rate, Signal.STEERING: can.steering}.get(signal)
    return () if section is None else (section.signal,)


def _series(
    samples: Mapping[Signal, Samples], planned: SignalPlan, signal: Signal
) -> Series | None:
    found, source = samples.get(signal), planned.source_of(signal)
    if found is None or source is None or len(found.t_ns) < 2:
        return None
    series = Series.of(source.topic.name, found.t_ns, found.values)
    return series if len(series) > 1 else None


def _normalized(steering: Series, vehicle: Vehicle) -> Series:
    """Return the steering angle converted to a typical steering ratio and without its offset."""
    odometry = vehicle.odometry
    scale = 15.0 / odometry.steering_ratio
    return replace(steering, values=(steering.values - odometry.steering_offset_rad) * scale)


def _wheels(samples: Mapping[Signal, Samples]) -> dict[str, Series]:
    """Return the speed of each wheel that is read, and the mean of the rear wheels."""
    found = samples.get(Signal.WHEEL_SPEEDS)
    if found is None:
        return {}
    wheels = {
        name: series
        for i, name in enumerate(WHEELS)
        if len(series := Series.of(name, found.t_ns, found.values[:, i])) > 1
    }
    rear = found.values[:, 2:].mean(axis=1)
    if len(series := Series.of("the rear wheels", found.t_ns, rear)) > 1:
        wheels["rear"] = series
    return wheels


def _differ(wheels: Mapping[str, Series]) -> bool:
    """Return whether left and right are separate signals; odometry topics have a single speed."""
    left, right = wheels["rear left"], wheels["rear right"]
    return len(left) != len(right) or bool((left.values != right.values).any())


def _of_wheels(wheels: Mapping[str, Series]) -> Iterator[str]:
    means = {
        name: float(np.abs(one.values).mean()) for name, one in wheels.items() if name in WHEELS
    }
    if len(means) < 2:
        return
    middle = float(np.median([*means.values()]))
    for name, mean in means.items():
        if middle > 1.0 and abs(mean - middle) > WHEEL_OFF * middle:
            yield (
                f"wheel_speeds: {name} is {mean:.2f} m/s on average where the wheels' median is "
                f"{middle:.2f} m/s"
            )


def _track(samples: Mapping[Signal, Samples], planned: SignalPlan) -> GroundTrack | None:
    found, source = samples.get(Signal.COURSE), planned.source_of(Signal.COURSE)
    if found is None or source is None or len(found.t_ns) < 2:
        return None
    course: Floats = found.values[:, 0]
    return GroundTrack.of_course(
        f"GNSS {source.topic.name}", found.t_ns, found.values[:, 1], course
    )


def _picture(
    log: Log, number: int, topic: Topic, vehicle: Vehicle, selection: Selection
) -> CameraPicture | None:
    """Return the picture in the middle of the part, or the first that decodes if it has no end."""
    ledger = Ledger(name_of(log))
    shown: CameraPicture | None = None
    middle_ns = None
    if selection.start_ns is not None and selection.end_ns is not None:
        middle_ns = (selection.start_ns + selection.end_ns) // 2
    depth = vehicle.camera.depth_bits
    for block, rows in pictures_of(log, number, topic, vehicle, ledger, selection):
        for row, t_ns in enumerate(block.log_ns.tolist()):
            if shown is not None and (middle_ns is None or t_ns > middle_ns):
                warn_of(ledger)
                return shown
            if shown is None or middle_ns is not None:
                try:
                    pixels, _ = decode(encoded(rows, row), depth_bits=depth)
                except LogError as error:
                    lose(ledger, topic.name, t_ns, error)
                    continue
                shown = CameraPicture(topic.name, t_ns, pixels)
    warn_of(ledger)
    return shown


def _of_camera(shown: CameraPicture | None, log: Log, camera: Camera) -> Iterator[str]:
    if shown is None:
        yield "camera: not one picture in the seconds examined"
        return
    wide, high = shown.pixels.shape[1], shown.pixels.shape[0]
    if (found := camera.mismatch((wide, high))) is not None:
        yield found
    published = log.intrinsics(shown.topic) if isinstance(log, KnowsItsCameras) else None
    if published is not None and camera.focal_px is not None:
        focal = published[0]
        if abs(camera.focal_px / focal - 1.0) > INTRINSICS_OFF:
            yield f"camera.focal_px = {camera.focal_px:g}: the data set publishes {focal:g}"
