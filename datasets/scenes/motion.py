"""Conditions of a run, and the motion of the car towards an intersection and through it."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.random import Generator

from crosscue.datasets.simulated.drive import RATE_HZ, TrueMotion, integrated
from crosscue.replay.columns import Floats

from .layout import NEAR_KERB_M, PARKING_LANE_M, Layout

Light = Literal["noon", "overcast", "dusk", "low_sun"]


@dataclass(frozen=True, slots=True)
class Conditions:
    """Conditions of one run.

    Attributes:
        run: Number of the run, from 1.
        seed: Seed of all random numbers of the run.
        light: Kind of daylight; ``low_sun`` shines into the camera.
        rain: Amount of rain, 0 (dry) to 1.
        traffic: Factor on the layout's usual traffic.
        speed_mps: Speed on the approach.
        sun_turn_rad: Direction of the sun relative to the approach road, positive to the left.
        is_red: True if the light is red on the approach.
    """

    run: int
    seed: int
    light: Light
    rain: float
    traffic: float
    speed_mps: float
    sun_turn_rad: float
    is_red: bool

    def tags(self, layout: Layout) -> tuple[str, ...]:
        """Return the conditions as tags of ``truth.json``."""
        tags = [{"noon": "clear", "low_sun": "glare"}.get(self.light, self.light)]
        if self.rain > 0.0:
            tags.append("rain")
        if layout.vegetation:
            tags.append("occluded")
        return tuple(tags)


LIGHTS: Final[tuple[Light, ...]] = (
    "noon", "overcast", "noon", "low_sun", "noon",
    "overcast", "low_sun", "overcast", "dusk", "dusk",
)  # fmt: skip
RAIN: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.7, 0.0, 0.0, 0.5, 0.0)
TRAFFIC: Final = (1.0, 1.4, 0.6, 1.0, 1.3, 0.8, 1.0, 0.3, 1.0, 0.4)
SPEED_MPS: Final = (9.0, 8.0, 10.5, 9.0, 12.0, 8.0, 10.0, 11.0, 9.0, 8.5)


def conditions_of(layout: Layout, run: int, seed: int = 0) -> Conditions:
    """Return the conditions of a run: ten are fixed, further ones are drawn from the seed.

    Raises:
        ValueError: ``run`` is below 1.
    """
    if run < 1:
        raise ValueError(f"run: expected 1 or more, got {run}")
    rng = np.random.default_rng([seed, layout.seed, run, 0x2B])
    place = run - 1 if run <= 10 else int(rng.integers(10))
    light = LIGHTS[place]
    rain = RAIN[place]
    if layout.name == "A" and run == 7:
        light = "noon"
    if layout.name == "H":
        # The dissertation's drives of H were mostly in the rain.
        light = "dusk" if light == "dusk" else "overcast"
        rain = 0.0 if run == 1 else max(rain, float(rng.uniform(0.4, 1.0)))
    turn = rng.uniform(-0.18, 0.18) if light == "low_sun" else rng.uniform(-np.pi, np.pi)
    return Conditions(
        run=run,
        seed=int(rng.integers(2**31)),
        light=light,
        rain=rain,
        traffic=TRAFFIC[place],
        speed_mps=SPEED_MPS[place] * float(rng.uniform(0.95, 1.05)),
        sun_turn_rad=float(turn),
        is_red=bool(rng.random() < 0.75),
    )


# Distance from rear axle to front bumper.
FRONT_M: Final = 3.75
STEP_S: Final = 1.0 / RATE_HZ
Turn = Literal["left", "right", "ahead"]


@dataclass(frozen=True, slots=True, eq=False)
class ApproachMotion:
    """One approach in the intersection's frame.

    Attributes:
        motion: Motion of the rear axle in the local frame, 100 Hz.
        turn: Direction of travel.
        green_s: Time from the start at which the light turns green; negative if it always was.
        enter_s: Time at which the rear axle passes the start of the intersection.
        inside_s: Interval in which any part of the car is on the crossroad.
    """

    motion: TrueMotion
    turn: Turn
    green_s: float
    enter_s: float
    inside_s: tuple[float, float]


def lane_y_m(layout: Layout) -> float:
    """Return the lateral position of the ego lane's centre, from the road's centre line."""
    parking = PARKING_LANE_M if layout.has_parking_lane else 0.0
    return layout.own * (layout.half_width_m - parking) / 2


def approach(layout: Layout, conditions: Conditions, rng: Generator) -> ApproachMotion:
    """Simulate an approach from about 88 m, with a stop at sign or light, and the crossing."""
    chances: dict[Turn, int] = {
        "ahead": 4 * layout.goes_ahead, "left": layout.goes_left, "right": layout.goes_right,
    }  # fmt: skip
    turns = [turn for turn, count in chances.items() for _ in range(count)]
    turn = turns[int(rng.integers(len(turns)))]
    start_x = -float(rng.uniform(84.0, 90.0))
    curvature = _curvature(layout, turn, start_x)
    stop_at = -start_x - FRONT_M - float(rng.uniform(0.2, 0.8))
    is_light = layout.control == "traffic_light"
    stops = layout.control == "stop_sign" or (is_light and conditions.is_red)
    wait_s = float(rng.uniform(1.0, 2.2)) if not is_light else float(rng.uniform(1.5, 4.0))
    slow_from = -start_x if turn != "ahead" else None
    along, speed = _speeds(
        conditions.speed_mps, stop_at if stops else None, wait_s, len(curvature) - 2, slow_from
    )
    bend = np.interp(along, np.arange(len(curvature)) * 0.1, curvature)
    motion = integrated(bend, speed, start_x, lane_y_m(layout))
    t_s = np.arange(len(motion)) * STEP_S
    bumper = along + start_x + FRONT_M
    inside = (bumper > NEAR_KERB_M - 1.0) & (along + start_x < layout.far_kerb_m + 4.0)
    enter = float(t_s[np.argmax(motion.x_m >= 0.0)])
    waited = t_s[(speed < 0.05) & (along > 1.0)]
    green = float(waited[-1]) - 0.6 if is_light and conditions.is_red and len(waited) else -1.0
    return ApproachMotion(
        motion, turn, green, enter, (float(t_s[inside][0]), float(t_s[inside][-1]))
    )


def _curvature(layout: Layout, turn: Turn, start_x: float) -> Floats:
    """Return the curvature for each decimetre of the path."""
    step = 0.1
    straight_on = layout.end_m + 16.0
    if turn == "ahead":
        return _along_road(layout, start_x, straight_on, step)
    is_near = turn == layout.traffic
    lane = 0.27 if is_near else 0.73
    if layout.one_way:
        lane = 0.5
    target_x = NEAR_KERB_M + lane * layout.cross_width_m
    radius = 6.5 if is_near else 9.0
    before = round((target_x - radius - start_x) / step)
    sign = 1.0 if turn == "left" else -1.0
    bend = np.full(round(radius * np.pi / 2 / step), sign / radius)
    curvature = np.concatenate([np.zeros(before), bend, np.zeros(round(14.0 / step))])
    kernel = np.hanning(41)[1:-1]
    smoothed: Floats = np.convolve(curvature, kernel / kernel.sum(), mode="same")
    return smoothed


def _along_road(layout: Layout, start_x: float, end_x: float, step: float) -> Floats:
    """Return the curvature of a path with a constant distance from the centre line."""
    if layout.curve_per_m == 0.0:
        return np.zeros(round((end_x - start_x) / step))
    x: Floats = np.arange(start_x, end_x, step / 10.0)
    slope = np.gradient(layout.aside_m(x), x)
    way = np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(x), np.diff(layout.aside_m(x))))))
    turned = np.interp(np.arange(0.0, way[-1], step), way, np.arctan(slope))
    curvature: Floats = np.gradient(turned, step)
    return curvature


def _speeds(
    cruise: float, stop_at: float | None, wait_s: float, last: int, slow_from: float | None
) -> tuple[Floats, Floats]:
    """Return distance and speed at each step: brake at 1.9 m/s2, wait, accelerate at 1.6 m/s2."""
    end_m = last * 0.1
    at, v, waited = 0.0, cruise, 0.0
    along, speed = [], []
    while at < end_m:
        target = cruise
        if slow_from is not None:
            room = max(slow_from - 3.0 - at, 0.0)
            target = min(target, float(np.sqrt(4.2**2 + 2 * 1.9 * room)))
        if stop_at is not None and waited < wait_s:
            room = stop_at - at
            target = min(target, float(np.sqrt(max(2 * 1.9 * room, 0.0))))
            if room < 0.03:
                target = v = 0.0
                waited += STEP_S
        v += float(np.clip(target - v, -3.5 * STEP_S, 1.6 * STEP_S))
        v = max(v, 0.0)
        if v < 0.05 and stop_at is not None and waited < wait_s:
            v = 0.0
            waited += STEP_S
        at += v * STEP_S
        along.append(at)
        speed.append(v)
    return np.array(along), np.array(speed)
