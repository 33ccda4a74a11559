"""Settings of a drive for compiled code: plain numbers, angles in radians, no None."""

from __future__ import annotations

import math
from typing import NamedTuple

from crosscue.localization.navigation import STRATEGIES

from .settings import TownDrive


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
    """Convert a drive's settings to numbers."""
    city, car, sensors, nav = settings.city, settings.car, settings.sensors, settings.navigation
    compass = sensors.compass_2sigma_deg
    return Parameters(
        min_km2=city.smallest_km2,
        max_km2=city.largest_km2,
        min_block_m=city.shortest_block_m,
        max_block_m=city.longest_block_m,
        dead_end_fraction=city.dead_end_fraction,
        one_way_fraction=city.one_way_fraction,
        min_goal_m=city.goal_at_least_m,
        wheelbase_m=car.wheelbase_m,
        track_width_m=car.track_width_m,
        step_s=car.step_s,
        cruise_mps=car.cruise_mps,
        turn_mps=car.turn_mps,
        accel_mps2=car.accel_mps2,
        lane_offset_m=car.lane_offset_m,
        left_radius_m=car.left_radius_m,
        right_radius_m=car.right_radius_m,
        decide_at_m=car.decide_at_m,
        steering_p=car.steering_p,
        steering_i=car.steering_i,
        steering_d=car.steering_d,
        speed_p=car.speed_p,
        speed_i=car.speed_i,
        speed_d=car.speed_d,
        compass_sd_rad=-1.0 if compass is None else math.radians(compass) / 2.0,
        compass_interval_m=sensors.compass_interval_m,
        slip_per_sqrt_m=sensors.slip_per_sqrt_m,
        encoder_step_m=sensors.encoder_step_m,
        landmark_sd_m=sensors.landmark_sd_m,
        landmark_gate_nis=sensors.landmark_gate_nis,
        detection_rate=sensors.detection_rate,
        start_position_sd_m=sensors.start_position_sd_m,
        start_heading_sd_rad=math.radians(sensors.start_heading_sd_deg),
        speed_sd_mps=sensors.speed_sd_mps,
        accel_var_m2ps3=sensors.accel_var_m2ps3,
        strategy=int(STRATEGIES[nav.strategy]),
        penalty_rad=math.radians(nav.penalty_deg),
        recognise_within_m=nav.recognise_within_m,
        same_option_rad=math.radians(nav.same_option_deg),
        after_m=nav.after_m,
        arrive_within_m=nav.arrive_within_m,
        hybrid_above_m=nav.hybrid_above_m,
        lost_above_m=nav.lost_above_m,
        landmarks_per_km2=settings.landmarks_per_km2,
        landmark_per_goal=settings.landmark_per_goal,
        goals=settings.goals,
        max_travelled_m=settings.longest_m,
        max_s=settings.longest_s,
    )
