"""The pose part of the estimate stage: from windows of signals to rows of the pose track."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from crosscue.datasets.geodesy import geodetic_to_enu
from crosscue.eval.runs.account import Line, line
from crosscue.eval.runs.manifest import OWN_FRAME
from crosscue.eval.runs.tables.measurements import (
    gap_rows,
    heading_rows,
    landmark_rows,
    odometry_rows,
    position_rows,
    start_rows,
)
from crosscue.localization import compass, odometry, pose_track
from crosscue.localization.constants import (
    Constants,
    coast_constants,
    effects,
    start_constants,
)
from crosscue.localization.fixes import NO_FIXES, Fixes
from crosscue.localization.gap import GapSettings, cross_gap
from crosscue.localization.landmarks.sighting import Sighting
from crosscue.localization.odometry import OdometrySettings, Pending, TurnSignal, WheelSamples
from crosscue.localization.pose_track import (
    NO_HEADINGS,
    BothSources,
    Headings,
    NoMeasurements,
    PoseColumns,
    TrackCounts,
    TrackSettings,
    TrackState,
)
from crosscue.localization.position_updates import PositionUpdates
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import VehicleError
from crosscue.replay.signals.kinds import Samples, Signal, SignalPlan
from crosscue.replay.signals.windows import SampleWindow
from crosscue.replay.time.segments import ONE_SEGMENT, Cause, Timeline, TimeSegment
from crosscue.replay.vehicle.vehicle import Vehicle

if TYPE_CHECKING:
    from .landmarks import LandmarkStage
    from .visual import VisualSource

# Max plausible fraction of rejected readings; a consistent filter rejects one in a thousand.
REJECTED_SHARE: Final = 0.1
# Time for which frames without odometry are kept.
FRAMES_WAIT_NS: Final = 10_000_000_000
FOREVER_NS: Final = int(np.iinfo(np.int64).max)
# S.d. of the first heading if it defines the map's axes and is therefore exact.
OWN_FRAME_SD_RAD: Final = 1e-3


def turn_signal_of(planned: SignalPlan, vehicle: Vehicle) -> Signal | None:
    """Return the signal for the turns of the pose; None for the difference of wheel speeds."""
    wish = vehicle.odometry.heading_from
    offers = {"yaw_rate": Signal.YAW_RATE, "steering": Signal.STEERING}
    if wish == "auto":
        return next((s for s in offers.values() if planned.source_of(s) is not None), None)
    return offers.get(wish)


def odometry_settings(vehicle: Vehicle) -> OdometrySettings:
    """Return the integrator's settings from the vehicle file."""
    left_out = {"kind", "heading_from", "accel_var_m2ps3", "constants", "fitted", "scale_sd"}
    fields = vehicle.odometry.model_dump(exclude=left_out)
    return OdometrySettings(**fields)


def odometry_constants(vehicle: Vehicle, turn: Signal | None) -> Constants | None:
    """Return the constant errors of the odometry with a source of turns; None without any."""
    stated = vehicle.odometry.constants
    if stated is None:
        return None
    cov = np.array(stated.covariance).reshape(len(stated.names), -1)
    return start_constants(stated.names, cov, stated.drift_per_sqrt_s, _kind(turn))


def track_settings(vehicle: Vehicle) -> TrackSettings:
    """Return the pose filter's settings from the vehicle file."""
    return TrackSettings(
        heading_interval_m=vehicle.compass.interval_m,
        heading_interval_s=vehicle.compass.interval_s,
        heading_gate_nis=vehicle.compass.gate_nis,
        accel_var_m2ps3=vehicle.odometry.accel_var_m2ps3,
    )


def gap_settings(vehicle: Vehicle) -> GapSettings:
    """Return the limits of motion in a gap from the vehicle file."""
    fields = vehicle.time.model_dump(exclude={"max_silence_s", "unknown_gap_s"})
    return GapSettings(**fields)


def fused_positions(vehicle: Vehicle) -> PositionUpdates | None:
    """Return the updater for GNSS positions, or None if the vehicle file does not request it.

    Raises:
        VehicleError: The geodetic position of the map's origin is unknown.
    """
    gnss = vehicle.gnss
    if gnss.use != "fuse":
        return None
    if vehicle.start.map_origin is None:
        raise VehicleError(
            "gnss.use = 'fuse': the map's origin is unknown; expected GNSS in the first "
            "seconds, with the vehicle moving, or start.map_origin in the vehicle file"
        )
    return PositionUpdates((gnss.x_m, gnss.y_m), gnss.interval_s, gnss.gate_nis, gnss.delay_s)


class NoLandmarks(NoMeasurements):
    """A replay without a landmark database."""

    def take_sightings(self) -> list[Sighting]:
        """Return an empty list."""
        return []

    def take_names(self, t_ns: Int64s) -> list[str | None]:
        """Return None for every row."""
        return [None] * len(t_ns)

    def cross_gap(self) -> None:
        """Do nothing."""

    def let_go(self, before_ns: int) -> None:
        """Do nothing, because no frames are kept."""

    def counts(self) -> dict[str, int]:
        """Return no counts."""
        return {}


@dataclass(slots=True)
class PoseStage:
    """Pose filter over the windows of a drive and across its gaps.

    Attributes:
        vehicle: Settings of the vehicle file.
        turn: Signal for the turns of the pose, from ``turn_signal_of``.
        notices: Notices about the start, for the manifest.
        odometry_counts: Numbers of wheel rows by outcome.
        track_counts: Numbers of headings and intervals by outcome.
        landmarks: Search for landmarks.
        positions: Updater for GNSS positions, from ``fused_positions``.
        received: Numbers of samples received, by signal.
        started_with: Number of headings used for the first belief.
        turn_early: Number of turn samples before the first wheel speeds.
        timeline: Time segments of the drive.
        visual: Odometry by the pictures, if it is used.
    """

    vehicle: Vehicle
    turn: Signal | None
    landmarks: LandmarkStage | NoLandmarks = field(default_factory=NoLandmarks)
    positions: PositionUpdates | None = None
    notices: list[str] = field(default_factory=list)
    odometry_counts: odometry.OdometryCounts = field(default_factory=odometry.OdometryCounts)
    track_counts: TrackCounts = field(default_factory=TrackCounts)
    received: Counter[Signal] = field(default_factory=Counter)
    started_with: int = 0
    turn_early: int = 0
    timeline: Timeline = ONE_SEGMENT
    visual: VisualSource | None = None
    _pending: Pending = field(default_factory=Pending)
    _state: TrackState | None = None
    _last_ns: int | None = None
    _measured: list[dict[str, object]] = field(default_factory=list)
    _gap: TimeSegment | None = None
    _segment: int = 0

    def __call__(self, window: SampleWindow) -> Iterator[PoseColumns]:
        """Yield the rows that a window completes."""
        self.received.update({signal: len(of.t_ns) for signal, of in window.samples.items()})
        while (following := self._following(window.end_ns)) is not None:
            if following.begins_ns > window.start_ns:
                before, window = _split(window, following.begins_ns)
                yield from self._advance(before, before.end_ns)
            if following.breaks_odometry:
                yield from self._end_segment(following)
        yield from self._advance(window, window.end_ns)

    def _following(self, until_ns: int) -> TimeSegment | None:
        """Return the next segment if it begins before ``until_ns``."""
        segments = self.timeline.segments
        if self._segment + 1 >= len(segments):
            return None
        following = segments[self._segment + 1]
        if following.begins_ns >= until_ns:
            return None
        self._segment += 1
        return following

    def finish(self) -> Iterator[PoseColumns]:
        """Yield the rows that waited for more odometry."""
        yield from self._close()
        self._let_go(FOREVER_NS)

    def follow(self, visual: VisualSource) -> Iterator[PoseColumns]:
        """Yield the rows of odometry by pictures, which needs no integration."""
        self.visual, increments = visual, visual.increments
        if not len(increments):
            return
        self._start(int(increments.start_ns[0]), float(increments.speed_mps[0]), NO_HEADINGS)
        assert self._state is not None
        made = pose_track.advance_pose(self._state, increments, track_settings(self.vehicle))
        self._state = made.state
        self._measured.append(odometry_rows(increments, is_visual=True))
        self.track_counts += made.counts
        yield made.poses

    def _let_go(self, before_ns: int) -> None:
        self.landmarks.let_go(before_ns)
        if self.positions is not None:
            self.positions.let_go(before_ns)

    def _close(self) -> Iterator[PoseColumns]:
        if self._state is not None and self._last_ns is not None:
            yield from self._advance(SampleWindow(self._last_ns, self._last_ns, {}), None)

    def _end_segment(self, following: TimeSegment) -> Iterator[PoseColumns]:
        """Close a segment; the following one is processed like a new drive with a known start."""
        yield from self._close()
        self._pending = Pending()
        if self._state is not None:
            self._gap = following

    def _cross(self, segment: TimeSegment, until_ns: int) -> None:
        """Predict the belief across the gap before ``segment``, to its first wheel speed."""
        assert self._state is not None
        restarts = segment.cause is Cause.SET_BACK
        before_ns = self._state.belief.t_ns
        before, constants = self._state.belief, self._state.constants
        crossed = cross_gap(before, until_ns, gap_settings(self.vehicle), restarts=restarts)
        # After a long gap the mean remains, as if the car had not moved.
        if constants is not None and crossed.distance_m:
            constants = coast_constants(before, constants, (until_ns - before_ns) * 1e-9)
        self._state = replace(
            self._state, belief=crossed.belief, counted_ns=None, constants=constants
        )
        self._measured.append(gap_rows(before_ns, crossed))
        self.landmarks.cross_gap()
        self._gap = None

    def take_measured(self) -> list[dict[str, object]]:
        """Return the filter's inputs since the last call, as rows of ``measurements.parquet``."""
        taken, self._measured = self._measured, []
        return taken

    def doubts(self) -> list[str]:
        """Return notices about counts that contradict the settings."""
        if self.visual is not None:
            return [self.visual.notice()]
        if self._state is None:
            return ["no wheel speed in the selected part, so no pose"]
        counts = self.track_counts
        judged = counts.headings_accepted + counts.headings_rejected
        if not judged or counts.headings_rejected <= REJECTED_SHARE * judged:
            return []
        return [
            f"{counts.headings_rejected} of {judged} compass readings were rejected by the gate: "
            "compass or odometry err more than the vehicle file states; fit the compass, or raise "
            "heading_sd_rad and the odometry's noise"
        ]

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the numbers of odometry rows and headings by outcome, for the manifest."""
        return {
            "odometry": asdict(self.odometry_counts),
            "track": asdict(self.track_counts),
            "landmarks": self.landmarks.counts(),
            "gnss": {} if self.positions is None else asdict(self.positions.counts),
        }

    @property
    def waiting(self) -> int:
        """Number of headings waiting for wheel speeds."""
        return 0 if self._state is None else len(self._state.waiting)

    def _advance(self, window: SampleWindow, until_ns: int | None) -> Iterator[PoseColumns]:
        wheels = window.samples.get(Signal.WHEEL_SPEEDS)
        settings = odometry_settings(self.vehicle)
        headings = self._headings(window)
        if self.positions is not None:
            self.positions.add(self._fixes(window))
        if self._state is None:
            first = odometry.first_reading(_wheels(wheels), settings)
            if first is None:
                n = 0 if wheels is None else len(wheels.t_ns)
                self.odometry_counts += odometry.OdometryCounts(rows=n, not_finite=n)
                self._missed(headings)
                self.turn_early += 0 if (turn := self._turn(window)) is None else len(turn)
                self._let_go(window.end_ns)
                return
            headings = self._start(*first, headings)
        assert self._state is not None
        self._last_ns = window.end_ns
        if self._gap is not None:
            if wheels is None:
                self._missed(headings)
                self.turn_early += 0 if (turn := self._turn(window)) is None else len(turn)
                self._let_go(window.end_ns)
                return
            self._cross(self._gap, int(wheels.t_ns[0]) - round(settings.wheel_delay_s * 1e9))
        step = odometry.integrate(
            _wheels(wheels),
            settings,
            self._turn(window),
            self._pending,
            until_ns,
        )
        self._pending = step.pending
        self.odometry_counts += step.counts
        constants = self._state.constants
        made = pose_track.advance_pose(
            self._state,
            step.increments,
            track_settings(self.vehicle),
            headings,
            measurements=self.landmarks
            if self.positions is None
            else BothSources(self.landmarks, self.positions),
            by=None if constants is None else effects(step.increments, settings, constants.names),
        )
        self._state = made.state
        self._measured += [
            odometry_rows(step.increments),
            heading_rows(made.headings),
            landmark_rows(self.landmarks.take_sightings()),
            position_rows([] if self.positions is None else self.positions.take_used()),
        ]
        self._let_go(window.end_ns - FRAMES_WAIT_NS)
        self.track_counts += made.counts
        if len(made.poses):
            yield made.poses

    def _start(self, t_ns: int, speed_mps: float, headings: Headings) -> Headings:
        """Set the first belief at the first wheel speed; return the headings not used for it."""
        start = self.vehicle.start
        heading_rad, sd_rad = start.heading_rad, start.heading_sd_rad
        if heading_rad is not None and start.source:
            self.notices.append(f"start heading {np.rad2deg(heading_rad):.1f} deg: {start.source}")
        if heading_rad is None and len(headings):
            mean = np.exp(1j * headings.heading_rad).mean()
            heading_rad, sd_rad = float(np.angle(mean)), float(np.sqrt(headings.var_rad2[0]))
            self.notices.append(
                f"start heading {np.rad2deg(heading_rad):.1f} deg from the first "
                f"{len(headings)} compass readings"
            )
            self.started_with = len(headings)
            headings = NO_HEADINGS
        elif heading_rad is None:
            heading_rad, sd_rad = 0.0, OWN_FRAME_SD_RAD
            self.notices.append(OWN_FRAME)
        belief = pose_track.start_belief(
            t_ns,
            start.x_m,
            start.y_m,
            heading_rad,
            speed_mps,
            position_sd_m=start.position_sd_m,
            heading_sd_rad=sd_rad,
        )
        constants = None if self.visual else odometry_constants(self.vehicle, self.turn)
        self._state = TrackState(belief, constants=constants)
        self._measured.append(start_rows(belief))
        return headings

    def _missed(self, headings: Headings) -> None:
        self.track_counts += TrackCounts(headings=len(headings), headings_late=len(headings))

    def _turn(self, window: SampleWindow) -> TurnSignal | None:
        if self.turn is None or (kind := _kind(self.turn)) is None:
            return None
        found = window.samples.get(self.turn)
        if found is None:
            return TurnSignal(np.empty(0, np.int64), np.empty(0), kind)
        return TurnSignal(found.t_ns, found.values, kind)

    def _fixes(self, window: SampleWindow) -> Fixes:
        found, origin = window.samples.get(Signal.POSITION), self.vehicle.start.map_origin
        if found is None or origin is None:
            return NO_FIXES
        lat, lon, alt, sd = found.values.T
        xyz = geodetic_to_enu(lat, lon, np.where(np.isfinite(alt), alt, origin[2]), origin)
        var = np.where(np.isfinite(sd), sd, self.vehicle.gnss.position_sd_m) ** 2
        return Fixes(found.t_ns, xyz[:, :2], var[:, None, None] * np.eye(2))

    def _headings(self, window: SampleWindow) -> Headings:
        variance = self.vehicle.compass.heading_sd_rad**2
        found = window.samples.get(Signal.HEADING)
        if found is not None:
            return Headings(found.t_ns, found.values, np.full(len(found.t_ns), variance))
        found = window.samples.get(Signal.MAGNETIC_FIELD)
        if found is None:
            return NO_HEADINGS
        heading_rad = compass.heading(found.values, compass_settings(self.vehicle))
        return Headings(found.t_ns, heading_rad, np.full(len(found.t_ns), variance))


def _kind(turn: Signal | None) -> odometry.TurnKind | None:
    if turn is None:
        return None
    return "yaw rate" if turn is Signal.YAW_RATE else "steering"


def _split(window: SampleWindow, at_ns: int) -> tuple[SampleWindow, SampleWindow]:
    before: dict[Signal, Samples] = {}
    after: dict[Signal, Samples] = {}
    for signal, samples in window.samples.items():
        is_before = samples.t_ns < at_ns
        if is_before.any():
            before[signal] = samples.take(is_before)
        if not is_before.all():
            after[signal] = samples.take(~is_before)
    return SampleWindow(window.start_ns, at_ns, before), SampleWindow(at_ns, window.end_ns, after)


def compass_settings(vehicle: Vehicle) -> compass.CompassSettings:
    """Return the compass settings from the vehicle file."""
    names = {field.name for field in fields(compass.CompassSettings)}
    return compass.CompassSettings(**vehicle.compass.model_dump(include=names))


def _wheels(found: Samples | None) -> WheelSamples:
    if found is None:
        return WheelSamples(np.empty(0, np.int64), np.empty((0, 4)))
    speeds: Floats = found.values
    if np.isnan(speeds[:, :2]).all():
        speeds = speeds[:, 2:]
    return WheelSamples(found.t_ns, speeds)


def estimating_of(stage: PoseStage, frames: tuple[int, int] | None) -> dict[str, Line]:
    """Return the account of the filters' inputs.

    Args:
        stage: The stage after its last window.
        frames: Numbers of frames detected, and of frames used for cues and belief; or None.
    """
    wheels, track, got = stage.odometry_counts, stage.track_counts, stage.received
    rejected = {
        "not finite": wheels.not_finite,
        "repeated time": wheels.repeated,
        "out of order": wheels.out_of_order,
    }
    found = {
        "wheel speeds": line(
            got[Signal.WHEEL_SPEEDS], wheels.rows - sum(rejected.values()), rejected
        ),
        "headings": line(
            got[Signal.HEADING] + got[Signal.MAGNETIC_FIELD],
            track.headings_accepted + stage.started_with,
            {
                "too soon after the last one used": track.headings_thinned,
                "rejected by the gate": track.headings_rejected,
                "earlier than the estimate": track.headings_late,
                "not finite": track.headings_bad,
                "after the last wheel speeds": stage.waiting,
            },
        ),
    }
    if stage.positions is not None:
        fused = stage.positions.counts
        found["positions"] = line(
            fused.received,
            fused.accepted,
            {
                "too soon after the last one used": fused.thinned,
                "rejected by the gate": fused.rejected,
                "without wheel speeds": fused.late,
            },
        )
    if stage.turn is not None:
        found["turn rates"] = line(
            got[stage.turn],
            wheels.turn_rows - wheels.turn_dropped,
            {
                "not finite, repeated or out of order": wheels.turn_dropped,
                "before the first wheel speeds": stage.turn_early,
            },
        )
    if stage.visual is not None:
        found["pairs of pictures"] = stage.visual.account()
    if frames is not None:
        found["frames"] = line(*frames, {})
    return {name: one for name, one in found.items() if one.entered}
