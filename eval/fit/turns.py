"""Conversion of a log's samples to the inputs of the odometry."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from crosscue.localization.odometry import TurnKind, TurnSignal, WheelSamples
from crosscue.replay.signals.kinds import Samples, Signal


def wheel_speeds(samples: Samples) -> WheelSamples:
    """Return the speeds of all four wheels, or of the rear two if the front ones are unknown."""
    speeds = samples.values
    has_front = not np.isnan(speeds[:, :2]).all()
    return WheelSamples(samples.t_ns, speeds if has_front else speeds[:, 2:])


def turn_samples(signal: Signal | None, found: Mapping[Signal, Samples]) -> TurnSignal | None:
    """Return the samples of a source of turns; None for the difference of the wheel speeds."""
    if signal is None:
        return None
    kind: TurnKind = "yaw rate" if signal is Signal.YAW_RATE else "steering"
    return TurnSignal(found[signal].t_ns, found[signal].values, kind)
