"""The vehicle file's ``[time]``: where a drive is split, and what a car can do meanwhile."""

from __future__ import annotations

from .section import NotNegative, Positive, Section


class Time(Section):
    """When a drive falls into time segments, and how estimators cross the gap between two."""

    max_silence_s: Positive = 1.0
    """Wheel speeds silent for longer than this begin a new segment."""
    restart_after_s: NotNegative = 5.0
    """After a longer gap, or a clock set back, the range filter and the belief start over."""
    unknown_gap_s: Positive = 1.0
    """Taken for the gap where a clock was set back: its true length cannot be known."""
    max_accel_mps2: NotNegative = 4.0
    """How fast the car may have changed its speed during a gap."""
    max_turn_rate_radps: NotNegative = 0.5
    """How fast it may have turned."""
    max_speed_mps: Positive = 60.0
    """And how fast it may have gone."""
