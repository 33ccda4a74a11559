"""Choice of the signals for a drafted vehicle file: the best signals without contradictions."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .agreement import (
    SignalVerdict,
    Turning,
    judge_speed,
    judge_steering,
    judge_yaw_rate,
    of_course,
    of_rate,
    of_steering,
    of_wheels,
    spread_mps,
)
from .candidates import WHEELS, Candidate, SignalKind
from .observed import Observed
from .series import Grid, Series

# Typical wheel radius, used to detect motion where the true radius is unknown.
USUAL_RADIUS_M: Final = 0.32


@dataclass(frozen=True, slots=True, eq=False)
class ChosenSignal:
    """A candidate signal, of a bus or of an inertial unit, with its verdict.

    Attributes:
        name: Name in the vehicle file, or the topic of an inertial unit.
        bus: Topic of its bus; empty for an inertial unit.
        series: Its readings.
        verdict: Result of the comparison with other signals.
    """

    name: str
    bus: str
    series: Series
    verdict: SignalVerdict


@dataclass(frozen=True, slots=True, eq=False)
class WheelSet:
    """Wheel signals that belong together.

    Attributes:
        bus: Topic of their bus.
        wheels: Signals by wheel, a key of ``WHEELS``.
        series: Readings by wheel.
        verdict: Combined result of the comparison with other signals.
        radius_m: For signals in rad/s, the radius that fits the reference; else None.
        is_turning: True if the signals are in rad/s.
    """

    bus: str
    wheels: dict[str, Candidate]
    series: dict[str, Series]
    verdict: SignalVerdict
    radius_m: float | None
    is_turning: bool

    @property
    def has_axle(self) -> bool:
        """True if both rear wheels, which odometry needs, are included."""
        return {"rear_left", "rear_right"} <= self.wheels.keys()

    @property
    def speed(self) -> Series:
        """Mean speed of the rear wheels, m/s."""
        left, right = self.series["rear_left"], self.series["rear_right"]
        scale = (self.radius_m or USUAL_RADIUS_M) if self.is_turning else 1.0
        other = np.interp(left.t_ns, right.t_ns, right.values)
        return Series("the rear wheels", left.t_ns, 0.5 * scale * (left.values + other))


@dataclass(frozen=True, slots=True, eq=False)
class Choices:
    """Candidate signals of each kind, best first.

    Attributes:
        wheels: Sets of wheel speeds.
        speeds: Vehicle speeds, for a car without wheel speeds.
        yaw_rates: CAN signals and inertial units with yaw rates.
        steering: CAN signals with steering angles.
        tables: Topics with a speed, which ``topics.odometry`` may name.
        reference: Name of the reference for speeds; empty if none exists.
        speed: The best available speed of the car, m/s.
    """

    wheels: tuple[WheelSet, ...]
    speeds: tuple[ChosenSignal, ...]
    yaw_rates: tuple[ChosenSignal, ...]
    steering: tuple[ChosenSignal, ...]
    tables: tuple[ChosenSignal, ...]
    reference: str
    speed: Series | None

    def is_chosen(self, choice: ChosenSignal | WheelSet) -> bool:
        """Return whether it is the best of its kind and free of contradictions."""
        of_kind: Sequence[ChosenSignal | WheelSet] = next(
            kind
            for kind in (self.wheels, self.speeds, self.yaw_rates, self.steering, self.tables)
            if choice in kind
        )
        return choice is of_kind[0] and not choice.verdict.wrong


def rank_candidates(seen: Observed) -> Choices:
    """Compare every candidate with the others and rank them."""
    grid = Grid.over(seen.start_ns, seen.end_ns)
    reference = _reference_speed(seen, grid)
    wheels = sorted(_wheel_sets(seen, reference, grid), key=_wheel_rank)
    chosen = next((one for one in wheels if one.has_axle and not one.verdict.wrong), None)
    speed = chosen.speed if chosen is not None else reference
    speeds = _ranked(
        ChosenSignal(one.name, bus.topic, series, judge_speed(series, speed, grid, True))
        for bus, one, series in seen.of_kind(SignalKind.SPEED)
    )
    tables = _ranked(
        ChosenSignal(one.name, "", one, judge_speed(one, speed, grid, True))
        for one in seen.tables
        if chosen is None and len(one) > 1
    )
    for best in (*speeds[:1], *tables[:1]):
        if speed is None and not best.verdict.wrong:
            speed = best.series
    turnings = [turn for track in seen.tracks if (turn := of_course(track, grid)) is not None][:1]
    if chosen is not None and (not chosen.is_turning or chosen.radius_m is not None):
        scale = chosen.radius_m if chosen.is_turning and chosen.radius_m else 1.0
        left, right = (
            replace(one, values=one.values * scale)
            for one in (chosen.series["rear_left"], chosen.series["rear_right"])
        )
        turnings.append(of_wheels(left, right, grid))
    yaw_rates = _yaw_rates(seen, turnings, speed, grid)
    # The message type defines an inertial unit's axes. An unconfirmed CAN signal may have any sign,
    # and two of them may agree although both are wrong.
    by_rate = [
        of_rate(one.series, one.verdict.sign, grid)
        for one in yaw_rates[:1]
        if not one.verdict.wrong and (one.verdict.agrees_with or not one.bus)
    ]
    steering = _ranked(
        ChosenSignal(
            one.name,
            bus.topic,
            series,
            judge_steering(series, [*turnings[:1], *by_rate, *turnings[1:]], speed, grid),
        )
        for bus, one, series in seen.of_kind(SignalKind.STEERING)
    )
    if speed is not None and steering and steering[0].verdict.agrees_with:
        best = steering[0]
        turnings.append(of_steering(best.series, best.verdict.sign, speed, grid))
        yaw_rates = _yaw_rates(seen, turnings, speed, grid)
    return Choices(
        tuple(wheels),
        speeds,
        yaw_rates,
        steering,
        tables,
        reference.name if reference is not None else "",
        speed,
    )


def _reference_speed(seen: Observed, grid: Grid) -> Series | None:
    """Return the GNSS speed, else the median of all candidate speeds in m/s."""
    for track in seen.tracks:
        if np.isfinite(track.speed.at(grid)).sum() > 50:
            return replace(track.speed, name=f"GNSS {track.speed.name}")
    for bus, one, series in seen.of_kind(SignalKind.GNSS_SPEED):
        return replace(series, name=f"GNSS {bus.topic} {one.name}")
    others = [
        series
        for kind in (SignalKind.WHEEL, SignalKind.SPEED)
        for _, one, series in seen.of_kind(kind)
        if not one.is_turning
    ]
    if seen.speeds:
        return seen.speeds[0]
    if len(others) < 3:
        return None
    at_grid = np.stack([np.abs(one.at(grid)) for one in others])
    known = np.isfinite(at_grid).sum(axis=0) >= 3
    median: NDArray[np.float64] = np.full(len(grid.t_ns), np.nan)
    if known.any():
        median[known] = np.nanmedian(at_grid[:, known], axis=0)
    return Series.of(f"the median of {len(others)} speeds", grid.t_ns, median)


def _wheel_sets(seen: Observed, reference: Series | None, grid: Grid) -> Iterator[WheelSet]:
    groups: dict[tuple[str, str, bool], dict[str, tuple[Candidate, Series]]] = {}
    for bus, one, series in seen.of_kind(SignalKind.WHEEL):
        group = groups.setdefault((bus.topic, one.stem, one.is_turning), {})
        group.setdefault(one.wheel, (one, series))
    for (bus_name, _, is_turning), group in groups.items():
        readings = {wheel: group[wheel][1] for wheel in WHEELS if wheel in group}
        verdicts = [judge_speed(one, reference, grid, not is_turning) for one in readings.values()]
        verdict, radius_m = _combined(verdicts, readings, reference, grid, is_turning)
        names = {wheel: group[wheel][0] for wheel in readings}
        yield WheelSet(bus_name, names, readings, verdict, radius_m, is_turning)


def _combined(
    verdicts: Sequence[SignalVerdict],
    series: dict[str, Series],
    reference: Series | None,
    grid: Grid,
    is_turning: bool,
) -> tuple[SignalVerdict, float | None]:
    """Return the worst wheel's verdict, with the spread of the wheels, and the fitted radius."""
    worst = max(verdicts, key=lambda one: (len(one.wrong), one.rank))
    facts = [*worst.facts]
    radius_m = None
    if is_turning and reference is not None and worst.agrees_with:
        radius_m = _radius_m(list(series.values()), reference, grid)
    if len(series) > 1:
        spread = spread_mps(list(series.values()), grid)
        if math.isfinite(spread):
            unit = "rad/s" if is_turning else "m/s"
            facts.append(f"the {len(series)} wheels deviate {spread:.2g} {unit} from their mean")
    return replace(worst, facts=tuple(facts)), radius_m


def _radius_m(wheels: Sequence[Series], reference: Series, grid: Grid) -> float | None:
    mean = np.abs(np.stack([one.at(grid) for one in wheels]).mean(axis=0))
    true = np.abs(reference.at(grid))
    both = np.isfinite(mean) & np.isfinite(true)
    square = float((mean[both] ** 2).sum())
    return float((true[both] * mean[both]).sum() / square) if square > 0.0 else None


def _wheel_rank(one: WheelSet) -> tuple[object, ...]:
    rate_hz = min(series.rate_hz for series in one.series.values())
    return (
        not one.has_axle,
        bool(one.verdict.wrong),
        *one.verdict.rank,
        -len(one.wheels),
        -rate_hz,
    )


def _yaw_rates(
    seen: Observed, turnings: Sequence[Turning], speed: Series | None, grid: Grid
) -> tuple[ChosenSignal, ...]:
    on_buses = seen.of_kind(SignalKind.YAW_RATE)
    found = [(one.name, bus.topic, series) for bus, one, series in on_buses]
    found += [(series.name, "", series) for series in seen.yaw_rates if len(series) > 1]
    return _ranked(
        ChosenSignal(name, bus, series, judge_yaw_rate(series, turnings, speed, grid))
        for name, bus, series in found
    )


def _ranked(choices: Iterator[ChosenSignal]) -> tuple[ChosenSignal, ...]:
    return tuple(
        sorted(choices, key=lambda one: (bool(one.verdict.wrong), *one.verdict.rank, one.name))
    )
