"""The vehicle file's ``[time]``: splitting of drives, and limits on motion across a gap."""

from crosscue.replay.time.segments import SplitLimits

from .section import NotNegative, Positive, Section

_SPLIT = SplitLimits()


class Time(Section):
    """Division of a drive into time segments, and treatment of the gaps between them."""

    max_silence_s: Positive = _SPLIT.max_silence_s
    """A longer gap in the wheel speeds starts a new segment."""
    restart_after_s: NotNegative = 5.0
    """After a longer gap, or after a clock is set back, the range filter and the belief restart."""
    unknown_gap_s: Positive = _SPLIT.unknown_gap_s
    """Assumed gap where a clock was set back, because its true length is unknown."""
    max_accel_mps2: NotNegative = 4.0
    """Maximum acceleration of the vehicle during a gap."""
    max_turn_rate_radps: NotNegative = 0.5
    """Maximum turn rate of the vehicle during a gap."""
    max_speed_mps: Positive = 60.0
    """Maximum speed of the vehicle during a gap."""

    @property
    def split(self) -> SplitLimits:
        """Limits at which a drive is split."""
        return SplitLimits(self.max_silence_s, self.unknown_gap_s)
