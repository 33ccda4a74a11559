"""Track the range to one reference: gating, missing odometry, and recovery from a wrong start.

A range starts once enough measurements agree, because a real sign is seen again in the next
pictures and a false one mostly is not. A measurement outside the gate is rejected. Rejected
measurements that agree with each other form a rival belief, which replaces the belief once it has
enough measurements. Otherwise, one wrong first measurement would exclude all correct ones.
"""

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
    """State of the range to one reference.

    Attributes:
        belief: None until enough measurements agree, and after the belief was dropped.
        rival: Belief of measurements that agree with each other but not with ``belief``: the first
            ones, or rejected ones.
        rival_seen: Number of successive measurements in ``rival``.
        unseen_m: Distance travelled since the last measurement that was accepted or is pending.
    """

    belief: RangeBelief | None = None
    rival: RangeBelief | None = None
    rival_seen: int = 0
    unseen_m: float = 0.0


NOTHING: Final = RangeTrack()
# Weight of an observation at the position of the last one; positive to avoid a division by zero.
MIN_EFFECTIVE_SAMPLES: Final = 1e-9


def advance_range(
    track: RangeTrack, travelled_m: float, var_m2: float, settings: RangeFilter
) -> RangeTrack:
    """Predict the track over a distance.

    A belief with an s.d. above ``max_sd_m`` is dropped. First observations that are not confirmed
    within ``begin_within_m`` are forgotten.
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
    """Predict the track over an unknown distance: same mean, s.d. larger by ``widens_m``.

    Standard deviations add, not variances, because the unknown speed persists.
    """
    first = track.rival if track.belief is None else track.belief
    if first is None:
        return track
    sd_m = math.sqrt(first.var_m2)
    gone = track._replace(unseen_m=track.unseen_m + widens_m)
    return advance_range(gone, 0.0, widens_m * (widens_m + 2.0 * sd_m), settings)


def fuse_range(
    track: RangeTrack,
    measured_m: float,
    sensor_var_m2: float,
    settings: RangeFilter,
    restarts_beyond_m: float,
) -> tuple[RangeTrack, Verdict]:
    """Update with a measurement, or reject it.

    Args:
        track: Track before the measurement, predicted to its time.
        measured_m: Distance to the track's reference.
        sensor_var_m2: Variance of the measurement.
        settings: Gate, fade, and number of observations that start a range or replace it.
        restarts_beyond_m: Distance below which no rival replaces the belief, because signs further
            away then belong to the next intersection.
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
    """Follow a range that a tracker has estimated from all observations so far.

    Successive estimates share most of their errors, so they are not independent measurements, and a
    Kalman update with each would make the belief overconfident. Instead, the gain of the update
    (eq. 10 to 12) depends on the distance travelled, ``1 - exp(-distance / take_up_m)``. A
    correction smaller than ``take_up_m`` then never increases the range while the car moves
    forwards, and nothing changes while it stands. The later of two such estimates is the better
    one, so their covariance is its variance; with it, the belief's variance is exact.

    Args:
        track: Track, predicted to the range's time.
        whole_m: Range by all observations so far.
        var_m2: Variance of the range.
        way_m: Distance travelled since the previous such update.
        settings: ``take_up_m``, and the gate beyond which the range replaces the belief.
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
    """Weight of an observation soon after another, in independent ones; as in ``calibrated``."""
    if fade_m == 0.0:
        return 1.0
    return max(effective_sample_fraction(since_m / fade_m), MIN_EFFECTIVE_SAMPLES)
