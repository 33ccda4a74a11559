"""Samples of a log as the odometry takes them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from crosscue.localization.odometry import TurnKind, TurnSignal, WheelSpeeds
from crosscue.replay.signals.kinds import Samples, Signal


def wheel_speeds(samples: Samples) -> WheelSpeeds:
    """All four wheels, or the rear two where the front ones are not known."""
    speeds = samples.values
    has_front = not np.isnan(speeds[:, :2]).all()
    return WheelSpeeds(samples.t_ns, speeds if has_front else speeds[:, 2:])


def turn_samples(signal: Signal | None, found: Mapping[Signal, Samples]) -> TurnSignal | None:
    """What reports turns; None for the wheels' difference."""
    if signal is None:
        return None
    kind: TurnKind = "yaw rate" if signal is Signal.YAW_RATE else "steering"
    return TurnSignal(found[signal].t_ns, found[signal].values, kind)
