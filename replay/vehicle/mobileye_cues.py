"""The vehicle file's section on Mobileye cues past the intersection."""

from __future__ import annotations

from .section import NotNegative, Positive, Section


class Past(Section):
    """When lane lines and vehicles count as past the intersection."""

    intersection_length_m: Positive = 16.0
    """From its start to its end, where only the start is known."""
    lane_reach_m: Positive = 5.0
    """A lane line must reach this far past the end of the intersection."""
    lane_within_y_m: Positive = 8.0
    """And be no further to the side there: a line that bends into the crossroad is not one."""
    lane_quality: NotNegative = 2.0
    """And be of at least this quality; the device calls 2 and 3 usable."""
    lane_types: tuple[int, ...] = (0, 1, 4, 5)
    """Dashed, solid, double, Botts' dots; without 3, a road's edge, which need not be a line."""
    vehicle_beyond_m: NotNegative = 3.0
    """A vehicle must be this far past the end of the intersection."""
    vehicle_within_y_m: Positive = 6.0
    """And no further to the side straight ahead: cars in parking lots are."""
    vehicle_types: tuple[int, ...] = (0, 1, 2)
    """Cars, trucks, motorcycles, standing or moving; without 3 and 4, pedestrians and bicycles."""
    vehicle_age_frames: NotNegative = 2.0
    """Min number of the device's images in which a vehicle was seen."""
    max_age_s: Positive = 0.5
    """What the device said longer ago is forgotten; the cues are then neutral."""
    settles_s: NotNegative = 0.03
    """Time from the first frame of an image's burst on the bus until the burst is complete."""
