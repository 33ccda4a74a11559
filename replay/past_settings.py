"""The vehicle file's section on Mobileye cues past the intersection."""

from __future__ import annotations

from .settings_section import NotNegative, Positive, Section


class Past(Section):
    """When lane lines and vehicles count as past the intersection."""

    lane_reach_m: Positive = 5.0
    """A lane line must reach this far past the end of the intersection."""
    vehicle_beyond_m: NotNegative = 3.0
    """A vehicle must be this far past it."""
    vehicle_within_y_m: Positive = 6.0
    """And no further to the side of the way straight on."""
