"""Signals that estimators use, their samples, and the plan of their topics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from crosscue.replay.columns import Floats, Int64s, Topic


class Signal(Enum):
    """Signals that estimators use; the value describes shape and unit of the samples."""

    WHEEL_SPEEDS = "(N, 4) m/s: front left, front right, rear left, rear right; NaN where none"
    YAW_RATE = "(N,) rad/s, counter-clockwise"
    STEERING = "(N,) rad at the steering wheel, counter-clockwise"
    MAGNETIC_FIELD = "(N, 3) tesla, forward, left, up"
    HEADING = "(N,) rad from east, counter-clockwise"
    COURSE = "(N, 2) rad from east, counter-clockwise, and speed in m/s, of the ground track"
    POSITION = "(N, 4) latitude and longitude in degrees, altitude and horizontal s.d. in m"
    MOBILEYE_OBSTACLES = "(N, 8) vehicles and when each picture was reported; mobileye/samples.py"
    MOBILEYE_LANES = "(N, 8) lane lines left and right, as cubics; mobileye/samples.py"


MOBILEYE_SIGNALS: Final = (Signal.MOBILEYE_OBSTACLES, Signal.MOBILEYE_LANES)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Consecutive readings of one signal.

    Attributes:
        signal: The signal.
        t_ns: Times on the log clock, shape (N,), int64.
        values: Values, shape (N,) or (N, k); see ``Signal``.
    """

    signal: Signal
    t_ns: Int64s
    values: Floats

    def take(self, index: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Samples:
        """Return the readings selected by ``index``."""
        return Samples(self.signal, self.t_ns[index], self.values[index])


@dataclass(frozen=True, slots=True)
class SignalSource:
    """One topic of one log and the signals it carries."""

    log: int
    topic: Topic
    signals: tuple[Signal, ...]


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Plan of the topics that are read for each signal.

    Attributes:
        sources: Sources in the order of logs and topics.
        missing: Reasons, in plain English, by signal that no topic carries.
    """

    sources: tuple[SignalSource, ...]
    missing: Mapping[Signal, str]

    def topics_of(self, log: int) -> frozenset[str]:
        """Return the names of the topics to read from one log."""
        return frozenset(source.topic.name for source in self.sources if source.log == log)

    def source_of(self, signal: Signal) -> SignalSource | None:
        """Return the source of ``signal``, or None."""
        return next((source for source in self.sources if signal in source.signals), None)


# Columns of obstacles. A row with only ``burst`` starts the burst of an image, even without
# obstacles.
OBSTACLE_COLUMNS: Final = ("burst", "x_m", "y_m", "vx_mps", "type", "status", "valid", "age_frames")
# Columns of lanes; ``c0_m`` and ``x_end_m`` are NaN on a side without a marking.
LANE_COLUMNS: Final = (
    "side",
    "lane_type",
    "quality",
    "c0_m",
    "c1",
    "c2_per_m",
    "c3_per_m2",
    "x_end_m",
)
