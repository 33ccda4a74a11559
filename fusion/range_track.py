"""One reference's range over time: gating, missing odometry, and the way back from a bad start.

A range begins once measurements enough agree: a sign that is there is seen again in the next
pictures, one that is not there mostly is not. A measurement outside the gate is refused. Refused
ones that agree among themselves form a rival belief, which takes over once it has been seen often
enough: otherwise one absurd first measurement would shut out all good ones.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import Final, NamedTuple

from crosscue.replay.vehicle.fusion import RangeFilter

from .independence import effective_sample_fraction
from .intersection_range import RangeBelief, initialise, nis, predict, update


class Verdict(StrEnum):
    """The outcome of a measurement."""

    WAITS = "waits"
    BEGAN = "began"
    TAKEN = "taken"
    REFUSED = "refused"
    RESTARTED = "restarted"


class RangeTrack(NamedTuple):
    """What is believed of one reference.

    Attributes:
        belief: None before measurements enough have agreed, and after it was dropped.
        rival: What measurements say that agree among themselves but are not a belief: the first
            ones, or refused ones.
        rival_seen: How many of them in a row.
        unseen_m: Way gone since the last measurement that was taken, or waits to be.
    """

    belief: RangeBelief | None = None
    rival: RangeBelief | None = None
    rival_seen: int = 0
    unseen_m: float = 0.0


NOTHING: Final = RangeTrack()
MIN_EFFECTIVE_SAMPLES: Final = 1e-9
"""Of an observation from the place of the last one: next to nothing, yet no division by zero."""


def advance(
    track: RangeTrack, travelled_m: float, var_m2: float, settings: RangeFilter
) -> RangeTrack:
    """The track after the car went on.

    A belief that has become less sure than ``max_sd_m`` is dropped, and first observations that
    nothing has confirmed within ``begin_within_m`` are forgotten.
    """
    if track.belief is None and track.rival is None:
        return track
    rival = None if track.rival is None else predict(track.rival, travelled_m, var_m2)
    unseen_m = track.unseen_m + abs(travelled_m)
    if track.belief is None:
        is_stale = unseen_m > settings.begin_within_m
        return NOTHING if is_stale else RangeTrack(None, rival, track.rival_seen, unseen_m)
    belief = predict(track.belief, travelled_m, var_m2)
    if belief.var_m2 > settings.max_sd_m * settings.max_sd_m:
        return NOTHING
    return RangeTrack(belief, rival, track.rival_seen, unseen_m)


def predict_without_odometry(
    track: RangeTrack, widens_m: float, settings: RangeFilter
) -> RangeTrack:
    """The track after a way that nobody measured: the mean stays, the s.d. grows by ``widens_m``.

    Standard deviations add, not variances: the unknown speed of one moment is that of the next.
    """
    first = track.rival if track.belief is None else track.belief
    if first is None:
        return track
    sd_m = math.sqrt(first.var_m2)
    gone = track._replace(unseen_m=track.unseen_m + widens_m)
    return advance(gone, 0.0, widens_m * (widens_m + 2.0 * sd_m), settings)


def measure(
    track: RangeTrack,
    measured_m: float,
    sensor_var_m2: float,
    settings: RangeFilter,
    restarts_beyond_m: float,
) -> tuple[RangeTrack, Verdict]:
    """Weigh in a measurement, or refuse it.

    Args:
        track: Before the measurement, advanced to its time.
        measured_m: Distance to the track's reference.
        sensor_var_m2: Of the measurement.
        settings: Gate, fade, how many observations begin a range, and when a rival takes over.
        restarts_beyond_m: No rival takes over from a belief nearer than this: signs further away
            are then the next intersection's.
    """
    belief = track.belief
    if belief is not None and _inside(belief, measured_m, sensor_var_m2, settings.gate_nis):
        worth = _worth(track.unseen_m, settings.fade_m)
        return RangeTrack(update(belief, measured_m, sensor_var_m2 / worth)), Verdict.TAKEN
    rival, seen = track.rival, track.rival_seen + 1
    if rival is not None and _inside(rival, measured_m, sensor_var_m2, settings.gate_nis):
        worth = 1.0 if belief is not None else _worth(track.unseen_m, settings.fade_m)
        rival = update(rival, measured_m, sensor_var_m2 / worth)
    else:
        rival, seen = initialise(measured_m, sensor_var_m2), 1
    if belief is None:
        if seen >= settings.begin_after:
            return RangeTrack(rival), Verdict.BEGAN
        return RangeTrack(None, rival, seen), Verdict.WAITS
    if seen >= settings.restart_after and belief.mean_m > restarts_beyond_m:
        return RangeTrack(rival), Verdict.RESTARTED
    return RangeTrack(belief, rival, seen, track.unseen_m), Verdict.REFUSED


def follow(
    track: RangeTrack, whole_m: float, var_m2: float, way_m: float, settings: RangeFilter
) -> tuple[RangeTrack, Verdict]:
    """Take up a range that somebody else has weighed from all observations so far.

    Its errors are those of the one before, but for what is new, so it is not an independent
    measurement: one after the other would make the belief far too sure. It is one (eq. 10 to 12)
    whose gain follows the way gone, ``1 - exp(-way / take_up_m)``, so that a correction smaller
    than ``take_up_m`` never makes the range grow while the car goes on, and nothing changes while
    it stands. The later of two such ranges is the better one, so their covariance is its variance;
    with that, the belief's variance is exact.

    Args:
        track: Advanced to the range's time.
        whole_m: The range, by all observations so far.
        var_m2: Its variance.
        way_m: Gone since the last one that was taken up.
        settings: ``take_up_m``, and the gate beyond which it replaces the belief.
    """
    belief = track.belief
    if belief is None:
        return RangeTrack(RangeBelief(whole_m, var_m2)), Verdict.BEGAN
    if not _inside(belief, whole_m, var_m2, settings.gate_nis):
        return RangeTrack(RangeBelief(whole_m, var_m2)), Verdict.RESTARTED
    gain = 1.0 if settings.take_up_m == 0.0 else -math.expm1(-way_m / settings.take_up_m)
    rest = 1.0 - gain
    mean_m = belief.mean_m + gain * (whole_m - belief.mean_m)
    shared_m2 = min(var_m2, belief.var_m2)
    var_m2 = rest**2 * belief.var_m2 + gain**2 * var_m2 + 2.0 * rest * gain * shared_m2
    return RangeTrack(RangeBelief(mean_m, var_m2)), Verdict.TAKEN


def _inside(
    belief: RangeBelief, measured_m: float, sensor_var_m2: float, gate: float | None
) -> bool:
    return gate is None or nis(belief, measured_m, sensor_var_m2) <= gate


def _worth(since_m: float, fade_m: float) -> float:
    """How many independent observations one is, so soon after another; as in ``calibrated``."""
    if fade_m == 0.0:
        return 1.0
    return max(effective_sample_fraction(since_m / fade_m), MIN_EFFECTIVE_SAMPLES)
