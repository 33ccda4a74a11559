"""The vehicle file's section on Mobileye cues past the intersection."""

from .section import NotNegative, Positive, Section


class Past(Section):
    """Conditions under which lane lines and vehicles are past the intersection."""

    intersection_length_m: Positive = 16.0
    """Assumed length of the intersection, where only its start is known."""
    lane_reach_m: Positive = 5.0
    """Minimum distance that a lane line extends past the end of the intersection."""
    lane_within_y_m: Positive = 8.0
    """Maximum lateral distance of the lane line there, which excludes lines that bend into the
    crossroad."""
    lane_quality: NotNegative = 2.0
    """Minimum quality of a lane line; the device documents 2 and 3 as usable."""
    lane_types: tuple[int, ...] = (0, 1, 4, 5)
    """Accepted types of lane lines: dashed, solid, double, Botts' dots. Type 3, a road edge, need
    not be a line."""
    vehicle_beyond_m: NotNegative = 3.0
    """Minimum distance of a vehicle past the end of the intersection."""
    vehicle_within_y_m: Positive = 6.0
    """Maximum lateral distance of the vehicle, which excludes cars in parking lots."""
    vehicle_types: tuple[int, ...] = (0, 1, 2)
    """Accepted types of vehicles, stationary or moving: cars, trucks, motorcycles. Types 3 and 4
    are pedestrians and bicycles."""
    vehicle_age_frames: NotNegative = 2.0
    """Minimum number of the device's images in which the vehicle was detected."""
    max_age_s: Positive = 0.5
    """Maximum age of the device's messages; without newer messages, the cues are neutral."""
    settles_s: NotNegative = 0.03
    """Time from the first frame of an image's burst on the bus until the burst is complete."""
