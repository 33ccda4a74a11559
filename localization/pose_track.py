"""Estimate a pose track from odometry and compass, by running ``pose_filter`` over columns.

Events are processed in order of time: the end of an odometry interval, then a heading, then a
requested row. An interval that contains a heading or a requested row is divided, with distance,
turn and variances in proportion to time.

Compass errors persist (a bridge, a lorry, the car's own current), so ten readings per second do not
carry ten times the information of one, and a filter that assumes so is overconfident. Here a
reading is used only after a distance of ``heading_interval_m`` and a time of ``heading_interval_s``
since the last used one. This is the dissertation's compass of variance r every ds metres.
``fit_compass`` estimates the time over which a compass's error persists; twice that is a good
``heading_interval_s``.

Long drives are processed in windows: pass each call's ``TrackState`` to the next. It stores
headings and requested rows that are later than the odometry so far, and the track is identical, bit
for bit, to that of a single window. A ``MeasurementSource`` adds measurements at other times, such
as landmarks at a camera's frames.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Final, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Floats, Int64s

from .angles import wrap
from .constants import Constants, coast_constants, predict_constants, update_constants
from .ekf import PoseBelief, coast, pack_belief, unpack_belief
from .odometry import Increments
from .pose_filter import HEADING, SPEED, State, major_axis_m, predict_pose, update_state

ACCEPTED: Final = 0
REJECTED: Final = 1


@dataclass(frozen=True, slots=True)
class TrackSettings:
    """Settings of the use of headings and of the process noise.

    Attributes:
        heading_interval_m: Minimum distance travelled between two headings in use.
        heading_interval_s: Minimum time between two headings in use.
        heading_gate_nis: Normalised innovation squared above which a heading is rejected (10.8
            rejects one good reading in a thousand); None accepts all.
        accel_var_m2ps3: Growth of the speed's variance per second between readings.
        coast_turn_var_rad2ps: Growth of the heading's variance per second without odometry.
    """

    heading_interval_m: float = 1.0
    heading_interval_s: float = 0.0
    heading_gate_nis: float | None = 10.8
    accel_var_m2ps3: float = 1.0
    coast_turn_var_rad2ps: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Headings(ColumnSet):
    """N compass readings.

    Attributes:
        t_ns: Shape (N,), int64.
        heading_rad: Shape (N,): counter-clockwise from +x of the map.
        var_rad2: Shape (N,).
    """

    t_ns: Int64s
    heading_rad: Floats
    var_rad2: Floats


NO_HEADINGS: Final = Headings(np.empty(0, np.int64), np.empty(0), np.empty(0))
NO_TIMES: Final[Int64s] = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class TrackCounts:
    """Account of the measurements; counts of several windows can be added.

    Attributes:
        intervals: Number of odometry intervals used.
        intervals_late: Intervals skipped because they end before the belief's time.
        coasts: Number of gaps in odometry, crossed without measurements.
        coast_ns: Total length of those gaps.
        headings: Number of compass readings processed.
        headings_accepted: Readings used.
        headings_thinned: Readings skipped because they are too soon after the last used one.
        headings_rejected: Readings rejected by the gate.
        headings_late: Readings skipped because they are before the belief's time.
        headings_bad: Readings skipped because they are not finite or have no positive variance.
        rows_late: Requested rows before the belief's time, which are missing from the result.
    """

    intervals: int = 0
    intervals_late: int = 0
    coasts: int = 0
    coast_ns: int = 0
    headings: int = 0
    headings_accepted: int = 0
    headings_thinned: int = 0
    headings_rejected: int = 0
    headings_late: int = 0
    headings_bad: int = 0
    rows_late: int = 0

    def __add__(self, other: Self) -> Self:
        names = [f.name for f in fields(self)]
        return type(self)(**{name: getattr(self, name) + getattr(other, name) for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """State between two windows; the first window starts with ``TrackState(belief)``.

    Attributes:
        belief: Belief at the end of the odometry so far.
        travelled_m: Total distance so far, forwards and in reverse.
        counted_ns: Time of the last used heading, or None.
        counted_m: ``travelled_m`` at the last used heading.
        waiting: Headings later than the belief.
        waiting_rows_ns: Times of requested rows later than the belief.
        constants: Constant errors of the odometry as states; None without them.
    """

    belief: PoseBelief
    travelled_m: float = 0.0
    counted_ns: int | None = None
    counted_m: float = 0.0
    waiting: Headings = NO_HEADINGS
    waiting_rows_ns: Int64s = field(default_factory=lambda: NO_TIMES)
    constants: Constants | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PoseColumns(ColumnSet):
    """N rows of a pose track.

    Attributes:
        t_ns: Shape (N,), int64.
        x_m: Shape (N,).
        y_m: Shape (N,).
        heading_rad: Shape (N,), in (-pi, pi].
        speed_mps: Shape (N,), negative in reverse.
        cov_xyh: Shape (N, 6): covariance of x, y, heading: xx, xy, xh, yy, yh, hh.
        major_axis_m: Shape (N,): full major axis of the 2-sigma position ellipse.
        travelled_m: Shape (N,): total distance so far.
    """

    t_ns: Int64s
    x_m: Floats
    y_m: Floats
    heading_rad: Floats
    speed_mps: Floats
    cov_xyh: Floats
    major_axis_m: Floats
    travelled_m: Floats


@dataclass(frozen=True, slots=True, eq=False)
class HeadingColumns(ColumnSet):
    """N headings that reached the filter.

    Attributes:
        t_ns: Shape (N,), int64.
        heading_rad: Shape (N,): as measured.
        var_rad2: Shape (N,): variance of the measurement.
        nis: Shape (N,): normalised innovation squared, chi-square with one degree of freedom.
        outcome: Shape (N,), uint8: ``ACCEPTED`` or ``REJECTED`` by the gate.
    """

    t_ns: Int64s
    heading_rad: Floats
    var_rad2: Floats
    nis: Floats
    outcome: NDArray[np.uint8]


class MeasurementSource(Protocol):
    """Source of additional measurements at times of its own, such as a camera's landmarks."""

    def times_ns(self) -> Sequence[int]:
        """Times of measurements, in order; times after the odometry are not used in this call."""
        ...

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Return the posterior at the belief's time, or None without a measurement."""
        ...


class NoMeasurements:
    """A ``MeasurementSource`` without measurements."""

    def times_ns(self) -> Sequence[int]:
        """Return no times."""
        return ()

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Return None."""
        return None


@dataclass(slots=True)
class BothSources:
    """Two sources combined, each used at its own times."""

    first: MeasurementSource
    second: MeasurementSource
    _due: list[tuple[int, bool]] = field(default_factory=list)

    def times_ns(self) -> Sequence[int]:
        """Times of both, in order."""
        of_first = [(t_ns, False) for t_ns in self.first.times_ns()]
        self._due = sorted(of_first + [(t_ns, True) for t_ns in self.second.times_ns()])
        return [t_ns for t_ns, _ in self._due]

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Update with the measurement of the one whose time it is."""
        while self._due[0][0] < belief.t_ns:
            self._due.pop(0)
        _, is_second = self._due.pop(0)
        whose = self.second if is_second else self.first
        return whose.update(belief, travelled_m)


class Advance(NamedTuple):
    """Result of one window."""

    state: TrackState
    poses: PoseColumns
    headings: HeadingColumns
    counts: TrackCounts


NO_MEASUREMENTS: Final = NoMeasurements()


def start_belief(
    t_ns: int,
    x_m: float,
    y_m: float,
    heading_rad: float,
    speed_mps: float = 0.0,
    position_sd_m: float = 0.0,
    heading_sd_rad: float = 0.0,
    speed_sd_mps: float = 10.0,
) -> PoseBelief:
    """Build a belief with independent errors."""
    mean = np.array([x_m, y_m, wrap(heading_rad), speed_mps])
    sd = np.array([position_sd_m, position_sd_m, heading_sd_rad, speed_sd_mps])
    return PoseBelief(t_ns, mean, np.diag(sd**2))


def advance_pose(
    state: TrackState,
    increments: Increments,
    settings: TrackSettings,
    headings: Headings = NO_HEADINGS,
    rows_ns: Int64s | None = None,
    measurements: MeasurementSource = NO_MEASUREMENTS,
    by: Floats | None = None,
) -> Advance:
    """Predict along the increments, and update with headings in order of time.

    Args:
        state: State after the previous window.
        increments: Increments by ``odometry.integrate``, in order.
        settings: Settings of the track.
        headings: The window's compass readings in any order; later ones wait for odometry.
        rows_ns: Shape (M,): times of requested rows; None for a row after every interval. The
            choice must be the same in every window.
        measurements: Additional measurements, used after headings of the same time. With a row
            after every interval, there is also a row after each measurement.
        by: Shape (N, 2, K): ``constants.effects`` of the increments; required with constants.

    Returns:
        The state for the next window, the rows, the outcome of each heading that reached the
        filter, and counts.
    """
    headings = state.waiting + headings
    headings = headings.take(np.argsort(headings.t_ns, kind="stable"))
    wanted = None
    if rows_ns is not None:
        wanted = np.sort(np.concatenate([state.waiting_rows_ns, rows_ns]))
    run = _Run(state, settings, headings, wanted, measurements)
    effects = [None] * len(increments) if by is None else by
    for start, stop, *interval, effect in zip(
        increments.start_ns.tolist(),
        increments.stop_ns.tolist(),
        increments.distance_m.tolist(),
        increments.turn_rad.tolist(),
        increments.distance_var_m2.tolist(),
        increments.turn_var_rad2.tolist(),
        increments.speed_mps.tolist(),
        increments.speed_var_m2ps2.tolist(),
        effects,
        strict=True,
    ):
        run.by = effect
        run.drive(start, stop, interval)
    return run.result()


_NEVER: Final = np.iinfo(np.int64).max


class _Run:
    """State during a call of ``advance_pose``."""

    def __init__(
        self,
        state: TrackState,
        settings: TrackSettings,
        headings: Headings,
        rows: Int64s | None,
        measurements: MeasurementSource,
    ) -> None:
        self.settings = settings
        self.t_ns = state.belief.t_ns
        self.state = pack_belief(state.belief)
        self.constants = state.constants
        self.by: Floats | None = None
        self.travelled_m = state.travelled_m
        self.counted_ns = state.counted_ns
        self.counted_m = state.counted_m
        usable = np.isfinite(headings.heading_rad) & (headings.var_rad2 > 0.0)
        usable &= np.isfinite(headings.var_rad2)
        late = usable & (headings.t_ns < self.t_ns)
        self.headings = headings.take(usable & ~late)
        self.heading_rows = list(
            zip(
                self.headings.t_ns.tolist(),
                self.headings.heading_rad.tolist(),
                self.headings.var_rad2.tolist(),
                strict=True,
            )
        )
        self.every_interval = rows is None
        self.rows = NO_TIMES if rows is None else rows[rows >= self.t_ns]
        self.row_times = self.rows.tolist()
        self.measurements = measurements
        self.measurement_times = [t for t in measurements.times_ns() if t >= self.t_ns]
        self.next_measurement = 0
        self.next_heading = 0
        self.next_row = 0
        self.event_ns = 0
        self.poses: list[tuple[float, ...]] = []
        self.pose_times: list[int] = []
        self.used: list[tuple[int, float, float, float, int]] = []
        self.tally = dict.fromkeys((f.name for f in fields(TrackCounts)), 0)
        self.tally["headings_bad"] = int((~usable).sum())
        self.tally["headings_late"] = int(late.sum())
        self.tally["rows_late"] = 0 if rows is None else len(rows) - len(self.rows)
        self._find_event()

    def drive(self, start_ns: int, stop_ns: int, interval: Sequence[float]) -> None:
        """Predict over an interval: distance, turn, their variances, speed and its variance."""
        distance_m, turn_rad, distance_var, turn_var, speed_mps, speed_var = interval
        if stop_ns <= self.t_ns:
            self.tally["intervals_late"] += 1
            return
        if start_ns > self.t_ns:
            self._coast(start_ns)
        self.tally["intervals"] += 1
        per_ns = 1.0 / (stop_ns - start_ns)
        while True:
            to_ns = min(self.event_ns, stop_ns)
            if to_ns > self.t_ns:
                fraction = (to_ns - self.t_ns) * per_ns
                self._move(
                    to_ns,
                    fraction,
                    fraction * distance_m,
                    fraction * turn_rad,
                    fraction * distance_var,
                    fraction * turn_var,
                )
            if to_ns == stop_ns:
                break
            self._handle_events()
        innovation = speed_mps - self.state[SPEED]
        self._set_updated(update_state(self.state, SPEED, innovation, speed_var))
        if self.event_ns == stop_ns:
            self._handle_events()
        if self.every_interval:
            self._keep_row()

    def _move(
        self,
        to_ns: int,
        fraction: float,
        distance_m: float,
        turn_rad: float,
        distance_var: float,
        turn_var: float,
    ) -> None:
        dt_s = (to_ns - self.t_ns) * 1e-9
        step = (distance_m, turn_rad, distance_var, turn_var, self.settings.accel_var_m2ps3 * dt_s)
        if self.constants is None or self.by is None:
            self.state = predict_pose(self.state, *step)
        else:
            self.state, self.constants = predict_constants(
                self.state, self.constants, step, fraction * self.by, dt_s
            )
        self.travelled_m += abs(distance_m)
        self.t_ns = to_ns

    def _coast(self, stop_ns: int) -> None:
        """Predict at the last speed; the assumed distance does not count as travelled."""
        self.tally["coasts"] += 1
        self.tally["coast_ns"] += stop_ns - self.t_ns
        while self.t_ns < stop_ns:
            to_ns = min(self.event_ns, stop_ns)
            before = unpack_belief(self.t_ns, self.state)
            dt_s = (to_ns - self.t_ns) * 1e-9
            after = coast(
                before, dt_s, self.settings.accel_var_m2ps3, self.settings.coast_turn_var_rad2ps
            )
            if self.constants is not None:
                self.constants = coast_constants(before, self.constants, dt_s)
            self.state, self.t_ns = pack_belief(after), to_ns
            if to_ns < stop_ns:
                self._handle_events()

    def _handle_events(self) -> None:
        """Process the events of the current time; rows come last, so that they include the rest."""
        rows = self.heading_rows
        while self.next_heading < len(rows) and rows[self.next_heading][0] == self.t_ns:
            self._weigh_heading(*rows[self.next_heading][1:])
            self.next_heading += 1
        while (
            self.next_measurement < len(self.measurement_times)
            and self.measurement_times[self.next_measurement] == self.t_ns
        ):
            self._measure()
            self.next_measurement += 1
        while self.next_row < len(self.row_times) and self.row_times[self.next_row] == self.t_ns:
            self._keep_row()
            self.next_row += 1
        self._find_event()

    def _measure(self) -> None:
        found = self.measurements.update(unpack_belief(self.t_ns, self.state), self.travelled_m)
        if found is None:
            return
        self._set_updated(pack_belief(found))
        if self.every_interval:
            self._keep_row()

    def _set_updated(self, after: State) -> None:
        """Set the state after a measurement, which also tells of the constants."""
        before, self.state = self.state, after
        # A speed without correlation with the pose, as is usual, tells nothing.
        same = after._replace(speed_mps=before.speed_mps, vv=before.vv) == before
        if self.constants is not None and not same:
            both = unpack_belief(0, before), unpack_belief(0, after)
            self.constants = update_constants(self.constants, *both)

    def _find_event(self) -> None:
        heading_ns, row_ns, measured_ns = _NEVER, _NEVER, _NEVER
        if self.next_heading < len(self.heading_rows):
            heading_ns = self.heading_rows[self.next_heading][0]
        if self.next_row < len(self.row_times):
            row_ns = self.row_times[self.next_row]
        if self.next_measurement < len(self.measurement_times):
            measured_ns = self.measurement_times[self.next_measurement]
        self.event_ns = min(heading_ns, row_ns, measured_ns)

    def _weigh_heading(self, heading_rad: float, var_rad2: float) -> None:
        self.tally["headings"] += 1
        if not self._is_due():
            self.tally["headings_thinned"] += 1
            return
        innovation = wrap(heading_rad - self.state[HEADING])
        nis = innovation * innovation / (self.state.hh + var_rad2)
        gate = self.settings.heading_gate_nis
        outcome = ACCEPTED if gate is None or nis <= gate else REJECTED
        self.used.append((self.t_ns, heading_rad, var_rad2, nis, outcome))
        if outcome == REJECTED:
            self.tally["headings_rejected"] += 1
            return
        self.tally["headings_accepted"] += 1
        self.counted_ns, self.counted_m = self.t_ns, self.travelled_m
        self._set_updated(update_state(self.state, HEADING, innovation, var_rad2))

    def _is_due(self) -> bool:
        if self.counted_ns is None:
            return True
        gone_m = self.travelled_m - self.counted_m
        passed_s = (self.t_ns - self.counted_ns) * 1e-9
        settings = self.settings
        return gone_m >= settings.heading_interval_m and passed_s >= settings.heading_interval_s

    def _keep_row(self) -> None:
        if self.every_interval and self.pose_times and self.pose_times[-1] == self.t_ns:
            self.pose_times.pop()
            self.poses.pop()
        x, y, heading, speed, xx, xy, xh, _, yy, yh, _, hh, _, _ = self.state
        self.pose_times.append(self.t_ns)
        axis = major_axis_m(xx, xy, yy)
        self.poses.append((x, y, heading, speed, xx, xy, xh, yy, yh, hh, axis, self.travelled_m))

    def result(self) -> Advance:
        poses = np.array(self.poses).reshape(-1, 12)
        used = np.array(self.used, dtype=np.float64).reshape(-1, 5)
        state = TrackState(
            belief=unpack_belief(self.t_ns, self.state),
            travelled_m=self.travelled_m,
            counted_ns=self.counted_ns,
            counted_m=self.counted_m,
            waiting=self.headings.take(slice(self.next_heading, None)),
            waiting_rows_ns=self.rows[self.next_row :],
            constants=self.constants,
        )
        x, y, heading, speed = poses[:, :4].T
        axis, travelled = poses[:, 10:].T
        t_ns = np.array(self.pose_times, np.int64)
        columns = PoseColumns(t_ns, x, y, heading, speed, poses[:, 4:10], axis, travelled)
        measured, var, nis, outcome = used[:, 1:].T
        t_ns = np.array([t for t, *_ in self.used], np.int64)
        headings = HeadingColumns(t_ns, measured, var, nis, outcome.astype(np.uint8))
        return Advance(state, columns, headings, TrackCounts(**self.tally))
