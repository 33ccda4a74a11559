"""Settings of a simulated drive: city, car, sensors, navigation; SI units, degrees where named.

The dissertation states the sizes of cities, the compass's uncertainty and the limits of 50 and
100 m. All other defaults are crosscue's; only ``sensors.compass_interval_m`` is calibrated to a
published result (9.3 km at 30 degrees).
"""

import math
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from crosscue.localization.navigation import STRATEGIES
from crosscue.replay.vehicle.section import NotNegative, Positive, Section

Proportion = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class City(Section):
    """Random gridded cities."""

    smallest_km2: Annotated[float, Field(ge=0.25, le=400.0)] = 1.0
    largest_km2: Annotated[float, Field(ge=0.25, le=400.0)] = 100.0
    shortest_block_m: Annotated[float, Field(ge=50.0, le=1000.0)] = 50.0
    longest_block_m: Annotated[float, Field(ge=50.0, le=1000.0)] = 300.0
    dead_end_fraction: Annotated[float, Field(ge=0.0, le=0.2)] = 0.03
    """Fraction of intersections that become dead ends."""
    one_way_fraction: Annotated[float, Field(ge=0.0, le=0.8)] = 0.15
    """Fraction of blocks with one-way streets."""
    goal_at_least_m: Annotated[float, Field(ge=0.0, le=250.0)] = 200.0
    """Minimum straight-line distance of a new goal from the car."""

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.smallest_km2 > self.largest_km2:
            raise ValueError("smallest_km2 is above largest_km2")
        if self.shortest_block_m > self.longest_block_m:
            raise ValueError("shortest_block_m is above longest_block_m")
        return self


class Car(Section):
    """Bicycle model (eq. 5 and 6), lanes and controllers."""

    wheelbase_m: Positive = 2.7
    track_width_m: Positive = 1.55
    step_s: Annotated[float, Field(gt=0.0, le=0.1)] = 0.1
    cruise_mps: Annotated[float, Field(ge=4.0, le=15.0)] = 10.0
    turn_mps: Annotated[float, Field(ge=2.0, le=6.0)] = 4.0
    accel_mps2: Annotated[float, Field(ge=1.0, le=4.0)] = 2.5
    lane_offset_m: Annotated[float, Field(ge=1.0, le=4.0)] = 1.75
    """Distance of the lane's centre from the street's, to the right."""
    left_radius_m: Annotated[float, Field(ge=5.0, le=12.0)] = 8.0
    right_radius_m: Annotated[float, Field(ge=5.0, le=12.0)] = 6.0
    decide_at_m: Annotated[float, Field(ge=15.0, le=32.0)] = 30.0
    """Distance of the decision before the intersection's centre; the car's sensors detect the
    intersection's kind by then."""
    steering_p: NotNegative = 0.027
    """Road-wheel angle per metre of offset from the lane."""
    steering_i: NotNegative = 0.0002
    """Road-wheel angle per metre of offset and metre driven."""
    steering_d: NotNegative = 0.54
    """Road-wheel angle per metre of change of the offset and metre driven."""
    speed_p: NotNegative = 2.0
    speed_i: NotNegative = 0.05
    speed_d: NotNegative = 0.05


class Sensors(Section):
    """Odometer, compass, landmarks, and uncertainty of the start."""

    compass_2sigma_deg: Annotated[float, Field(gt=0.0, le=180.0)] | None = 30.0
    """Two standard deviations of the compass; None for no compass."""
    compass_interval_m: Annotated[float, Field(ge=1.0, le=100.0)] = 1.876
    """Distance between readings with independent errors; ``study range --calibrate`` fits it."""
    slip_per_sqrt_m: NotNegative = 0.003
    """S.d. of a wheel's path after one metre."""
    encoder_step_m: Positive = 0.02
    """Path of a wheel per encoder count; errors are up to half of it."""
    landmark_sd_m: Positive = 5.0
    """S.d., in x and y, of the position that a recognised landmark yields."""
    landmark_gate_nis: Positive = 13.8
    """Normalised innovation squared above which a landmark is rejected (0.1 % of correct ones)."""
    detection_rate: Proportion = 1.0
    """Fraction of passed landmarks that are recognised."""
    start_position_sd_m: Positive = 1.0
    start_heading_sd_deg: Positive = 5.0
    speed_sd_mps: Positive = 0.2
    accel_var_m2ps3: Positive = 1.0


class Navigation(Section):
    """Eq. 4 and its three variants."""

    strategy: Literal["straight to goal", "landmark to landmark", "hybrid"] = "straight to goal"
    penalty_deg: NotNegative = 45.0
    """Penalty for each time that the same option was taken at the same intersection."""
    recognise_within_m: Positive = 30.0
    same_option_deg: Annotated[float, Field(ge=1.0, le=60.0)] = 45.0
    after_m: NotNegative = 10.0
    """Distance after the intersection at which the bearing to the goal is computed."""
    arrive_within_m: Annotated[float, Field(gt=0.0, le=100.0)] = 20.0
    """Distance within which the goal is reached; it is also reached inside the 2-sigma circle."""
    hybrid_above_m: Positive = 50.0
    lost_above_m: Positive = 100.0


class TownDrive(Section):
    """Settings of a drive; with a seed, they determine it."""

    city: City = City()
    car: Car = Car()
    sensors: Sensors = Sensors()
    navigation: Navigation = Navigation()
    landmarks_per_km2: Annotated[float, Field(ge=0.0, le=100.0)] = 0.0
    landmark_per_goal: bool = False
    """True for at most one landmark at a time, drawn again for every goal."""
    goals: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Number of successive goals; a million means to drive until lost or too far."""
    longest_m: Annotated[float, Field(gt=0.0, le=1e6)] = 60_000.0
    """Maximum distance of the drive."""
    longest_s: Annotated[float, Field(gt=0.0, le=1e6)] = 1e6
    """Maximum duration of the drive."""


class Parameters(NamedTuple):
    """The settings of ``settings.Drive`` as numbers.

    ``compass_sd_rad`` is negative without a compass; ``strategy`` is a ``navigation.Strategy``.
    """

    min_km2: float
    max_km2: float
    min_block_m: float
    max_block_m: float
    dead_end_fraction: float
    one_way_fraction: float
    min_goal_m: float
    wheelbase_m: float
    track_width_m: float
    step_s: float
    cruise_mps: float
    turn_mps: float
    accel_mps2: float
    lane_offset_m: float
    left_radius_m: float
    right_radius_m: float
    decide_at_m: float
    steering_p: float
    steering_i: float
    steering_d: float
    speed_p: float
    speed_i: float
    speed_d: float
    compass_sd_rad: float
    compass_interval_m: float
    slip_per_sqrt_m: float
    encoder_step_m: float
    landmark_sd_m: float
    landmark_gate_nis: float
    detection_rate: float
    start_position_sd_m: float
    start_heading_sd_rad: float
    speed_sd_mps: float
    accel_var_m2ps3: float
    strategy: int
    penalty_rad: float
    recognise_within_m: float
    same_option_rad: float
    after_m: float
    arrive_within_m: float
    hybrid_above_m: float
    lost_above_m: float
    landmarks_per_km2: float
    landmark_per_goal: bool
    goals: int
    max_travelled_m: float
    max_s: float


def parameters_of(settings: TownDrive) -> Parameters:
    """Convert a drive's settings to numbers; those of equal names are used unchanged."""
    city, sensors, nav = settings.city, settings.sensors, settings.navigation
    compass = sensors.compass_2sigma_deg
    sections = (city, settings.car, sensors, nav, settings)
    plain: dict[str, Any] = {
        name: value for section in sections for name, value in section if name in Parameters._fields
    }
    return Parameters(
        **plain
        | {
            "min_km2": city.smallest_km2,
            "max_km2": city.largest_km2,
            "min_block_m": city.shortest_block_m,
            "max_block_m": city.longest_block_m,
            "min_goal_m": city.goal_at_least_m,
            "compass_sd_rad": -1.0 if compass is None else math.radians(compass) / 2.0,
            "start_heading_sd_rad": math.radians(sensors.start_heading_sd_deg),
            "strategy": int(STRATEGIES[nav.strategy]),
            "penalty_rad": math.radians(nav.penalty_deg),
            "same_option_rad": math.radians(nav.same_option_deg),
            "max_travelled_m": settings.longest_m,
            "max_s": settings.longest_s,
        }
    )
