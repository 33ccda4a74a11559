"""The vehicle file's ``[time]``: splitting of drives, and limits on motion across a gap."""

from __future__ import annotations

from .section import NotNegative, Positive, Section


class Time(Section):
    """Division of a drive into time segments, and treatment of the gaps between them."""

    max_silence_s: Positive = 1.0
    """A longer gap in the wheel speeds starts a new segment."""
    restart_after_s: NotNegative = 5.0
    """After a longer gap, or after a clock is set back, the range filter and the belief restart."""
    unknown_gap_s: Positive = 1.0
    """Assumed gap where a clock was set back, because its true length is unknown."""
    max_accel_mps2: NotNegative = 4.0
    """Maximum acceleration of the vehicle during a gap."""
    max_turn_rate_radps: NotNegative = 0.5
    """Maximum turn rate of the vehicle during a gap."""
    max_speed_mps: Positive = 60.0
    """Maximum speed of the vehicle during a gap."""
