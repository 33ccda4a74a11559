"""One reference's range over time: gating, missing odometry, and the way back from a bad start.

A measurement outside the gate is refused. Refused ones that agree among themselves form a rival
belief, which takes over once it has been seen often enough: otherwise one absurd first measurement
would shut out all good ones.
"""

from __future__ import annotations

import math
from enum import StrEnum
from typing import NamedTuple

from crosscue.replay.fusion_settings import RangeFilter

from .intersection_range import RangeBelief, initialise, nis, predict, update


class Verdict(StrEnum):
    """What became of a measurement."""

    BEGAN = "began"
    TAKEN = "taken"
    REFUSED = "refused"
    RESTARTED = "restarted"


class RangeTrack(NamedTuple):
    """What is believed of one reference.

    Attributes:
        belief: None before the first measurement and after it was dropped.
        rival: What refused measurements say that agree among themselves.
        rival_seen: How many of them in a row.
    """

    belief: RangeBelief | None = None
    rival: RangeBelief | None = None
    rival_seen: int = 0


NOTHING = RangeTrack()


def advance(track: RangeTrack, travelled_m: float, var_m2: float, most_sd_m: float) -> RangeTrack:
    """The track after the car went on; without a belief once it is less sure than ``most_sd_m``."""
    if track.belief is None:
        return track
    belief = predict(track.belief, travelled_m, var_m2)
    if belief.var_m2 > most_sd_m * most_sd_m:
        return NOTHING
    rival = None if track.rival is None else predict(track.rival, travelled_m, var_m2)
    return RangeTrack(belief, rival, track.rival_seen)


def go_blind(track: RangeTrack, widens_m: float, most_sd_m: float) -> RangeTrack:
    """The track after a way that nobody measured: the mean stays, the s.d. grows by ``widens_m``.

    Standard deviations add, not variances: the unknown speed of one moment is that of the next.
    """
    if track.belief is None:
        return track
    sd_m = math.sqrt(track.belief.var_m2)
    return advance(track, 0.0, widens_m * (widens_m + 2.0 * sd_m), most_sd_m)


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
        settings: Gate, and when a rival takes over.
        restarts_beyond_m: No rival takes over from a belief nearer than this: signs further away
            are then the next intersection's.
    """
    belief = track.belief
    if belief is None:
        return RangeTrack(initialise(measured_m, sensor_var_m2)), Verdict.BEGAN
    if _inside(belief, measured_m, sensor_var_m2, settings.gate_nis):
        return RangeTrack(update(belief, measured_m, sensor_var_m2)), Verdict.TAKEN
    rival, seen = track.rival, track.rival_seen + 1
    if rival is not None and _inside(rival, measured_m, sensor_var_m2, settings.gate_nis):
        rival = update(rival, measured_m, sensor_var_m2)
    else:
        rival, seen = initialise(measured_m, sensor_var_m2), 1
    if seen >= settings.restart_after and belief.mean_m > restarts_beyond_m:
        return RangeTrack(rival), Verdict.RESTARTED
    return RangeTrack(belief, rival, seen), Verdict.REFUSED


def _inside(
    belief: RangeBelief, measured_m: float, sensor_var_m2: float, gate: float | None
) -> bool:
    return gate is None or nis(belief, measured_m, sensor_var_m2) <= gate
