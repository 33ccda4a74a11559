"""The table of checks of a drive: one row and one function each.

A function yields findings. A finding says for which purposes it matters, what is wrong, and what
would help. ``missing`` makes a purpose impossible; every other kind leaves it usable with care.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias, get_args

import numpy as np

from crosscue.localization.camera_delay import PictureMotion, delay_by_yaw_rate, mean_delay
from crosscue.replay.clocks.findings import duration_text
from crosscue.replay.clocks.reports import StampReport
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.safe_text import counted
from crosscue.replay.signals.kinds import Samples, Signal
from crosscue.replay.vehicle.drafting.series import EARTH_RADIUS_M, Series

from .drive import QualityDrive, words_of

Kind: TypeAlias = Literal["missing", "slow", "late", "damaged", "wrong"]
Purpose: TypeAlias = Literal["pose", "cues", "range", "landmarks"]
PURPOSES: Final[tuple[Purpose, ...]] = get_args(Purpose)
MOTION: Final = ("pose", "range", "landmarks")
SEEING: Final = ("cues", "range", "landmarks")
SPEED: Final = "log the wheel speeds, or name their CAN signals or topic in the vehicle file"
# What each signal is for, the lowest useful rate, and the longest gap.
NEEDS: Final[Mapping[Signal, tuple[tuple[str, ...], float, float]]] = {
    Signal.WHEEL_SPEEDS: (MOTION, 5.0, 0.6),
    Signal.YAW_RATE: (("pose", "landmarks"), 5.0, 0.6),
    Signal.STEERING: (("pose", "landmarks"), 5.0, 0.6),
    Signal.POSITION: (("pose", "landmarks"), 0.4, 5.0),
}
CAMERA_HZ: Final = 4.0
CAMERA_GAP_S: Final = 1.0
SHORTEST_S: Final = 3.0
# Time after the start, or before the end, of the drive at which a signal may begin or end.
ENDS_S: Final = 3.0
GNSS_ENDS_S: Final = 20.0
# Change of a rate during a drive that is reported.
RATE_RATIO: Final = 1.6
RATE_WINDOW_NS: Final = 5_000_000_000
# Difference of a header stamp from log time that is a late clock, up to one that is another clock.
OFFSET_NS: Final = (200_000_000, 86_400_000_000_000)
DRIFT_PPM: Final = 1000.0
# Lag of a signal behind another that measures the same motion.
LAG_S: Final = 0.15
GNSS_LAG_S: Final = 0.45
SAME_SCALE, SAME_SD = (0.7, 1.4), 0.1
# Min s.d. of a signal over the drive by which its lag can be told from noise.
CHANGES: Final = {"yaw rate": 0.04, "speed": 0.5}
CAMERA_DELAY_S: Final = 0.03
# Time for which a signal that usually changes may stay the same while the car moves.
FROZEN_S: Final = 2.0
LOST: Final = 0.01
# Length of parts of the way that are compared with positions, how much further than it positions
# may move, and in which share of the parts they may.
WAY_M: Final = 30.0
TOO_FAR: Final = 1.3
FAR_PARTS: Final = 0.15
# Readings between which a car cannot change: max step, rate of change, and the time between them.
STEPS: Final = {Signal.WHEEL_SPEEDS: (2.0, 25.0), Signal.YAW_RATE: (0.5, 10.0)}
STEP_S: Final = 0.2
GNSS_MPS: Final = 100.0
DARK, BRIGHT, FLAT = 6.0, 249.0, 2.0
BAD_PICTURES: Final = 0.02
MIN_BAD: Final = 3
HEIGHT_M: Final = (0.5, 4.0)


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that makes a drive less useful.

    Attributes:
        check: Name of the check.
        kind: ``missing``, ``slow``, ``late``, ``damaged`` or ``wrong``.
        purposes: Purposes for which it matters.
        text: What was found.
        help: What would help.
    """

    check: str
    kind: Kind
    purposes: tuple[str, ...]
    text: str
    help: str


Found: TypeAlias = Iterator[tuple[Kind, tuple[str, ...], str, str]]


@dataclass(frozen=True, slots=True)
class Check:
    """One row of the table.

    Attributes:
        name: Name, in reports and in JUnit files.
        title: What it finds.
        function: Yields kind, purposes, text and help of each finding.
    """

    name: str
    title: str
    function: Callable[[QualityDrive], Found]

    def __call__(self, drive: QualityDrive) -> Iterator[Finding]:
        """Yield the findings of a drive."""
        for kind, purposes, text, advice in self.function(drive):
            yield Finding(self.name, kind, purposes, text, advice)


def _topics(drive: QualityDrive) -> Found:
    if drive.unplanned:
        yield "missing", PURPOSES, drive.unplanned, "name the topics in the vehicle file"


def _speed(drive: QualityDrive) -> Found:
    if drive.series(Signal.WHEEL_SPEEDS) is None:
        why = drive.planned.missing.get(Signal.WHEEL_SPEEDS, "no reading")
        visual = drive.camera and drive.has_focal
        purposes = ("pose", "landmarks") if visual else MOTION
        yield "missing", purposes, f"no speed: {why}", SPEED


def _turning(drive: QualityDrive) -> Found:
    if drive.series(Signal.YAW_RATE) or drive.series(Signal.STEERING):
        return
    wheels = drive.samples.get(Signal.WHEEL_SPEEDS)
    if wheels is not None and (wheels.values[:, 2] != wheels.values[:, 3]).any():
        return
    text = "no change of heading: neither yaw rate, steering nor two rear wheels"
    yield "missing", ("pose", "landmarks"), text, "log an inertial unit, or both rear wheels"


def _position(drive: QualityDrive) -> Found:
    is_known = drive.vehicle.start.model_fields_set & {"x_m", "y_m", "heading_rad", "map_origin"}
    if Signal.POSITION not in drive.samples and not is_known:
        text = "no position: no GNSS, and the vehicle file states no start"
        yield "missing", ("landmarks",), text, "log GNSS, or state [start] in the vehicle file"


def _camera(drive: QualityDrive) -> Found:
    if not drive.camera and not drive.unplanned:
        yield "missing", SEEING, "no camera", "log the pictures, or name their log, too"
    elif drive.pictures is not None and not len(drive.pictures.t_ns):
        yield "missing", SEEING, f"{drive.camera}: no picture can be used", "see crosscue info"


def _focal(drive: QualityDrive) -> Found:
    if drive.camera and not drive.has_focal:
        advice = "state camera.focal_px; crosscue vehicle init estimates it from a turn"
        yield "missing", ("range",), "the camera's focal length is unknown", advice
    elif drive.pictures is not None and drive.pictures.size_px is not None:
        why = drive.intrinsics.mismatch(drive.pictures.size_px)
        if why is not None:
            yield "wrong", ("range", "landmarks"), why, "correct [camera] in the vehicle file"


def _length(drive: QualityDrive) -> Found:
    start_ns, end_ns = drive.span_ns
    if end_ns > start_ns and (seconds := (end_ns - start_ns) * 1e-9) < SHORTEST_S:
        yield "slow", PURPOSES, f"only {seconds:.1f} s long", f"log {SHORTEST_S:g} s or more"


def _streams(drive: QualityDrive) -> Iterator[tuple[str, tuple[str, ...], float, float, Int64s]]:
    """Yield name, purposes, lowest rate, longest gap and times of what a run reads."""
    for signal, (purposes, rate_hz, gap_s) in NEEDS.items():
        if signal in drive.samples:
            yield words_of(signal), purposes, rate_hz, gap_s, drive.samples[signal].t_ns
    if drive.pictures is not None:
        yield "camera", SEEING, CAMERA_HZ, CAMERA_GAP_S, drive.pictures.t_ns


def _rates(drive: QualityDrive) -> Found:
    for name, purposes, least_hz, _, t_ns in _streams(drive):
        steps_s = _steps_s(t_ns)
        if len(steps_s) < 2:
            continue
        rate_hz = 1.0 / float(np.median(steps_s))
        if rate_hz < least_hz:
            text = f"{name}: {rate_hz:.2g} a second, expected {least_hz:g} or more"
            yield "slow", purposes, text, "log it more often"
            continue
        for at_s, there_hz in _changes(t_ns, rate_hz):
            text = f"{name}: {rate_hz:.3g} a second, but {there_hz:.3g} from {at_s:.0f} s on"
            yield "slow", purposes, text, "find out why every second reading is missing there"


def _steps_s(t_ns: Int64s) -> Floats:
    steps_s = np.diff(np.sort(t_ns)).astype(np.float64) * 1e-9
    return steps_s[steps_s > 0.0]


def _changes(t_ns: Int64s, rate_hz: float) -> Iterator[tuple[float, float]]:
    """Yield the first seconds in which a rate is another than in most of the drive."""
    ordered = np.sort(t_ns)
    window = (ordered - ordered[0]) // RATE_WINDOW_NS
    for number in np.unique(window).tolist()[:-1]:
        steps_s = _steps_s(ordered[window == number])
        if len(steps_s) >= 2:
            there_hz = 1.0 / float(np.median(steps_s))
            if not 1.0 / RATE_RATIO < there_hz / rate_hz < RATE_RATIO:
                yield number * RATE_WINDOW_NS * 1e-9, there_hz
                return


def _gaps(drive: QualityDrive) -> Found:
    start_ns, end_ns = drive.span_ns
    for name, purposes, _, limit_s, t_ns in _streams(drive):
        if len(t_ns) < 2:
            continue
        ordered = np.sort(t_ns)
        steps_s = np.diff(ordered) * 1e-9
        limit_s = max(limit_s, 4.0 * float(np.median(steps_s)))
        longest = int(np.argmax(steps_s))
        if steps_s[longest] > limit_s:
            at_s = (int(ordered[longest]) - start_ns) * 1e-9
            many = int((steps_s > limit_s).sum())
            text = (
                f"{name}: {many} gap{'s' * (many > 1)} over {limit_s:.2g} s, the longest "
                f"{steps_s[longest]:.2g} s at {at_s:.1f} s"
            )
            yield "damaged", purposes, text, "look for lost rows with crosscue info"
        ends_s = GNSS_ENDS_S if name == "position" else ENDS_S
        first_s, last_s = (ordered[0] - start_ns) * 1e-9, (end_ns - ordered[-1]) * 1e-9
        for late_s, what in ((first_s, "begins {} after the drive"), (last_s, "ends {} before it")):
            if late_s > ends_s:
                text = f"{name}: {what.format(f'{late_s:.1f} s')}"
                yield "damaged", purposes, text, "use --from and --to, or log it throughout"


def _clocks(drive: QualityDrive) -> Found:
    used = drive.used_topics
    for topic in drive.topics:
        report = topic.clocks
        if topic.name not in used or report is None:
            continue
        purposes = _purposes(used[topic.name])
        for stamps, name in ((report.log, "log time"), (report.header, "header stamp")):
            for kind, text in () if stamps is None else _faults(stamps, name):
                yield kind, purposes, f"{topic.name}: {text}", "see crosscue info, and the recorder"


def _faults(stamps: StampReport, name: str) -> Iterator[tuple[Kind, str]]:
    if stamps.resets:
        yield "wrong", f"{name} was set back {counted(stamps.resets, 'time')}"
    if stamps.late_rows > LOST * stamps.rows and not stamps.resets:
        text = f"{counted(stamps.late_rows, 'row')} out of order by {name}"
        yield "late", f"{text}, by up to {duration_text(stamps.worst_late_ns)}"
    if stamps.is_constant and stamps.rows > 2:
        yield "wrong", f"{name} never changes"
    if name == "log time":
        return
    if stamps.jumps > stamps.resets:
        yield "late", f"{name} jumps against log time, {counted(stamps.jumps, 'time')}"
    line = stamps.line
    if line is None or stamps.is_constant or stamps.rows < MIN_BAD:
        return
    if OFFSET_NS[0] < abs(line.offset_ns) < OFFSET_NS[1]:
        yield "late", f"{name} differs from log time by {duration_text(line.offset_ns)}"
    if line.drift_ppm is not None and abs(line.drift_ppm) > DRIFT_PPM + 3.0 * (
        line.drift_error_ppm or 0.0
    ):
        yield "late", f"{name} drifts by {line.drift_ppm:.0f} ppm from log time"


def _purposes(use: str) -> tuple[str, ...]:
    found = [set(purposes) for signal, (purposes, _, _) in NEEDS.items() if words_of(signal) in use]
    if use == "camera":
        found.append(set(SEEING))
    return tuple(one for one in PURPOSES if any(one in purposes for purposes in found)) or ("pose",)


def _lags(drive: QualityDrive) -> Found:
    yaw, speed = drive.series(Signal.YAW_RATE), drive.series(Signal.WHEEL_SPEEDS)
    wheels, gnss = drive.samples.get(Signal.WHEEL_SPEEDS), drive.series(Signal.COURSE)
    if yaw is not None and wheels is not None:
        rate = Series.of("wheels", wheels.t_ns, (wheels.values[:, 3] - wheels.values[:, 2]) / 1.55)
        if np.ptp(rate.values) > 0.0:
            yield from _lag(yaw, rate, "yaw rate", "the rear wheels", LAG_S, ("pose", "landmarks"))
    if speed is not None and gnss is not None:
        yield from _lag(speed, gnss, "speed", "GNSS", GNSS_LAG_S, MOTION)


def _lag(
    late: Series, reference: Series, name: str, against: str, limit_s: float, of: tuple[str, ...]
) -> Found:
    """Compare two signals of one motion; the slower one is integrated between its own times."""
    step_s = max(0.1, 1.0 / max(reference.rate_hz, 0.1))
    edges_ns = np.arange(reference.t_ns[0], reference.t_ns[-1], round(step_s * 1e9))
    if len(edges_ns) < 3:
        return
    area = np.cumsum(0.5 * (reference.values[1:] + reference.values[:-1]) * np.diff(reference.t_ns))
    turned = np.interp(edges_ns, reference.t_ns, np.concatenate([[0.0], area * 1e-9]))
    if float(np.std(np.diff(turned))) < CHANGES[name] * step_s:
        return
    motion = PictureMotion(
        edges_ns[:-1], edges_ns[1:], np.diff(turned), np.diff(turned), np.diff(turned) > np.inf
    )
    found = delay_by_yaw_rate(motion, late.t_ns, late.values)
    # Both must measure the same motion.
    is_same = SAME_SCALE[0] < found.scale < SAME_SCALE[1] and found.scale_sd < SAME_SD
    if is_same and found.is_bounded and abs(found.delay_s) > limit_s + 4.0 * found.sd_s:
        # The delay is that of the reference.
        text = f"{name}: {-found.delay_s * 1e3:+.0f} ms late against {against}"
        yield "late", of, text, "correct its time stamps, or state its delay under [odometry]"


def _camera_delay(drive: QualityDrive) -> Found:
    found = mean_delay(drive.delays)
    if found is not None and abs(found.delay_s) > CAMERA_DELAY_S + 3.0 * found.sd_s:
        total_s = drive.vehicle.camera.delay_s + found.delay_s
        advice = f"set camera.delay_s = {total_s:.3f}"
        if not found.is_observable:
            advice = "correct their time stamps, or record a turn, which shows the delay to set"
        yield "late", SEEING, f"pictures: {found}", advice
    for one in drive.delays:
        if one.scale < -4.0 * one.scale_sd:
            text = "yaw rate: turns to the other side than the pictures"
            yield "wrong", ("pose", "landmarks"), text, "change its sign in the vehicle file"


def _frozen(drive: QualityDrive) -> Found:
    for signal, column, name in (
        *((Signal.WHEEL_SPEEDS, i, f"wheel speeds, column {i + 1}") for i in range(4)),
        (Signal.YAW_RATE, None, "yaw rate"),
        (Signal.STEERING, None, "steering"),
        (Signal.POSITION, 0, "position"),
    ):
        if (found := drive.samples.get(signal)) is None or len(found.t_ns) < MIN_BAD:
            continue
        values = found.values if column is None else found.values[:, column]
        frozen_s, at_ns = _longest_same(drive, found.t_ns, values)
        periods_s = 5.0 * float(np.median(np.diff(found.t_ns))) * 1e-9
        if frozen_s > max(FROZEN_S, periods_s):
            at_s = (at_ns - drive.span_ns[0]) * 1e-9
            text = f"{name}: the same value for {frozen_s:.1f} s at {at_s:.1f} s, while moving"
            yield "wrong", NEEDS[signal][0], text, "check the sensor, and its driver"


def _longest_same(drive: QualityDrive, t_ns: Int64s, values: Floats) -> tuple[float, int]:
    """Return the longest time with one value in motion, of a signal that usually changes."""
    same = np.diff(values) == 0.0
    still = same & (drive.moving(t_ns[1:]) == 1.0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    if not len(edges):
        return 0.0, 0
    starts, stops = edges[::2], edges[1::2]
    longest = int(np.argmax(stops - starts))
    length = int(stops[longest] - starts[longest])
    # A signal that never changes is a fault where GNSS shows that the car does.
    gnss = drive.series(Signal.COURSE)
    is_dead = bool(same.all()) and gnss is not None and float(np.ptp(gnss.values)) > 2.0
    if not is_dead and (same.sum() - length > 0.5 * (len(same) - length) or same.all()):
        return 0.0, 0
    begin_ns = int(t_ns[starts[longest]])
    return (int(t_ns[stops[longest]]) - begin_ns) * 1e-9, begin_ns


def _invalid(drive: QualityDrive) -> Found:
    for signal, (purposes, _, _) in NEEDS.items():
        found = drive.samples.get(signal)
        if found is None or not len(found.t_ns):
            continue
        values = found.values.reshape(len(found.t_ns), -1)
        # Front wheels may be missing, and the altitude and accuracy of a position.
        columns = values[:, 2:] if signal is Signal.WHEEL_SPEEDS else values[:, :2]
        lost = float((~np.isfinite(columns)).any(axis=1).mean())
        if lost > LOST:
            text = f"{words_of(signal)}: {lost:.0%} of the readings are not numbers"
            yield "damaged", purposes, text, "check the sensor, and what the log stores for invalid"


def _jumps(drive: QualityDrive) -> Found:
    for signal, (step, rate) in STEPS.items():
        series = drive.series(signal)
        if series is None or len(series) < MIN_BAD:
            continue
        seconds = np.diff(series.t_ns) * 1e-9
        change = np.abs(np.diff(series.values))
        near = (seconds > 0.0) & (seconds < STEP_S)
        jumps = int((near & (change > step) & (change > rate * seconds)).sum())
        if jumps:
            text = f"{words_of(signal)}: {counted(jumps, 'jump')} above {step:g}, as no car makes"
            yield "wrong", NEEDS[signal][0], text, "check its unit, and for invalid readings"
    position = drive.samples.get(Signal.POSITION)
    if position is not None and len(position.t_ns) > 1:
        yield from _position_jumps(position)


def _position_jumps(position: Samples) -> Found:
    lat, lon = np.radians(position.values[:, 0]), np.radians(position.values[:, 1])
    if (np.abs(position.values[:, :2]).max(axis=1) < 1e-6).mean() > LOST:
        text = "position: latitude and longitude are 0"
        yield "wrong", ("pose", "landmarks"), text, "log positions only with a fix"
        return
    north, east = np.diff(lat), np.diff(lon) * np.cos(lat[:-1])
    way_m = EARTH_RADIUS_M * np.hypot(north, east)
    seconds = np.maximum(np.diff(position.t_ns) * 1e-9, 0.05)
    jumps = int(((way_m > 30.0) & (way_m > GNSS_MPS * seconds)).sum())
    if jumps:
        text = f"position: {counted(jumps, 'jump')}, the largest {way_m.max():.0f} m"
        yield "wrong", ("pose", "landmarks"), text, "check the receiver; gnss.gate_nis rejects some"


def _wheels(drive: QualityDrive) -> Found:
    for text in drive.contradictions:
        turns = text.startswith(("yaw_rate", "steering"))
        purposes = ("pose", "landmarks") if turns else MOTION
        advice = "check names, units and signs of the signals in the vehicle file"
        yield "wrong", purposes, text.replace("_", " "), advice
    yield from _ways(drive)


def _ways(drive: QualityDrive) -> Found:
    """Compare positions with the way by the wheels, which no straight line between them exceeds."""
    position, speed = drive.samples.get(Signal.POSITION), drive.series(Signal.WHEEL_SPEEDS)
    if position is None or speed is None:
        return
    means = 0.5 * np.abs(speed.values[1:] + speed.values[:-1])
    driven_m = np.concatenate([[0.0], np.cumsum(means * np.diff(speed.t_ns) * 1e-9)])
    at_m = np.interp(position.t_ns, speed.t_ns, driven_m)
    firsts = np.unique(at_m // WAY_M, return_index=True)[1]
    lat, lon = np.radians(position.values[firsts, :2]).T
    line_m = EARTH_RADIUS_M * np.hypot(np.diff(lat), np.diff(lon) * np.cos(lat[:-1]))
    way_m = np.diff(at_m[firsts])
    far = line_m[way_m > 0.5 * WAY_M] / way_m[way_m > 0.5 * WAY_M] > TOO_FAR
    if far.sum() > 1 and far.mean() > FAR_PARTS:
        text = f"position: further than the wheels roll, in {far.sum()} of {len(far)} parts"
        advice = "check its unit, and that latitude and longitude are not exchanged"
        yield "wrong", ("pose", "landmarks"), text, advice


def _pictures(drive: QualityDrive) -> Found:
    seen = drive.pictures
    if seen is None or not len(seen.t_ns):
        return
    bad = {
        "black": seen.mean < DARK,
        "white": seen.mean > BRIGHT,
        "empty of any contrast": (seen.contrast < FLAT)
        & (seen.mean >= DARK)
        & (seen.mean <= BRIGHT),
    }
    moving = drive.moving(seen.t_ns[1:])
    bad["the same as the picture before"] = np.concatenate(
        [[False], (np.diff(seen.digest) == 0) & ((moving == 1.0) | np.isnan(moving))]
    )
    for what, is_so in bad.items():
        count = int(is_so.sum())
        if count >= MIN_BAD and count > BAD_PICTURES * len(is_so):
            at_s = (int(seen.t_ns[int(np.argmax(is_so))]) - drive.span_ns[0]) * 1e-9
            text = f"camera: {count} of {len(is_so)} pictures are {what}, from {at_s:.1f} s on"
            yield "damaged", SEEING, text, "check the camera, its cable and its driver"


def _standing(drive: QualityDrive) -> Found:
    if drive.pictures is None or drive.series(Signal.WHEEL_SPEEDS) is None:
        return
    motion = drive.pictures.motion
    moving = drive.moving(motion.t_ns, 2.0)
    moves = (motion.expansion > 0.005) & (moving == 0.0)
    for count, what in (
        (int((motion.is_standing & (moving == 1.0)).sum()), "stands in {} pictures, but not by it"),
        (int(moves.sum()), "moves on in {} pictures, but stands by it"),
    ):
        if count > max(MIN_BAD, 0.1 * len(motion.t_ns)):
            text = f"speed: the car {what.format(count)}"
            yield "wrong", MOTION, text, "check which signal is the speed, and the camera's clock"


def _damage(drive: QualityDrive) -> Found:
    for log in drive.summaries:
        if log.unattributed_dropped or log.unattributed_unknown:
            yield "damaged", PURPOSES, f"{log.path}: rows of unknown topics are lost", "see info"
    for topic in drive.topics:
        dropped = sum(topic.dropped.values())
        if topic.name in drive.used_topics and (dropped or topic.dropped_unknown):
            purposes = _purposes(drive.used_topics[topic.name])
            text = f"{topic.name}: {dropped} of {counted(topic.found + dropped, 'row')} lost"
            yield "damaged", purposes, text, "see crosscue info; copy the log again"


def _duplicates(drive: QualityDrive) -> Found:
    for topic in drive.topics:
        if topic.name in drive.used_topics and topic.duplicates > LOST * max(topic.found, 1):
            purposes = _purposes(drive.used_topics[topic.name])
            copies = counted(topic.duplicates, "exact copy", "exact copies")
            text = f"{topic.name}: {copies} of the row before"
            yield "damaged", purposes, text, "log each message once"


def _mounting(drive: QualityDrive) -> Found:
    watch = drive.mounting
    if watch is None:
        return
    for step in watch.steps:
        at_s = (step.t_ns - drive.span_ns[0]) * 1e-9
        text = f"camera: {step} at {at_s:.0f} s"
        yield "wrong", ("range", "landmarks"), text, "fix the camera; use the drive up to there"
    height = watch.whole.get("height")
    if height is not None and not HEIGHT_M[0] < height.mean < HEIGHT_M[1]:
        text = f"the camera would be {height.mean:.1f} m above the road by the speed"
        yield "wrong", MOTION, text, "check the unit of the speed, and camera.focal_px"


# Checks in the order in which their findings are listed.
CHECKS: Final = (
    Check("topics", "several topics for one role", _topics),
    Check("speed", "no speed", _speed),
    Check("turning", "no change of heading", _turning),
    Check("position", "no position", _position),
    Check("camera", "no camera", _camera),
    Check("calibration", "no focal length, or that of another picture size", _focal),
    Check("length", "a drive of less than 3 s", _length),
    Check("damage", "lost rows", _damage),
    Check("duplicates", "rows stored twice", _duplicates),
    Check("rate", "rates too low, or changing", _rates),
    Check("gaps", "gaps, late starts, early ends", _gaps),
    Check("clocks", "clocks that are set back, jump, drift, or differ", _clocks),
    Check("lag", "signals late against each other", _lags),
    Check("camera delay", "pictures late against the signals", _camera_delay),
    Check("frozen", "signals that stay the same", _frozen),
    Check("invalid", "readings that are not numbers", _invalid),
    Check("jumps", "readings that no car can produce", _jumps),
    Check("agreement", "wheels, signs and units that contradict each other", _wheels),
    Check("pictures", "black, white, empty or repeated pictures", _pictures),
    Check("standstill", "standing by pictures and moving by speed, or the reverse", _standing),
    Check("mounting", "a camera that moved, or a speed that its height contradicts", _mounting),
)
