"""Conditions of a run: light, rain, traffic and speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from .layout import Layout

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
