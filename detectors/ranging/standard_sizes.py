"""What is known of an object's height before it is seen: standard sizes, and how they spread.

A signal's housing follows from its lenses (United States: MUTCD and ITE; Europe: EN 12368): three
of 0.30 m are 1.07 m bare, and 1.32 m with a backplate of 0.13 m around. A box's shape says which of
them is likely: bare housings are three times as high as wide, those with a backplate about twice.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np


@dataclass(frozen=True, slots=True)
class SizePrior:
    """What is known of an object's height before it is seen: lognormal.

    Attributes:
        mean_m: Expected height.
        spread: Standard deviation as a fraction of the mean.
    """

    mean_m: float
    spread: float

    @property
    def log_var(self) -> float:
        """Variance of the logarithm."""
        return float(np.log1p(self.spread**2))

    @property
    def log_mean(self) -> float:
        """Mean of the logarithm."""
        return float(np.log(self.mean_m)) - 0.5 * self.log_var


class Housing(NamedTuple):
    """One kind of signal, seen from ahead.

    Attributes:
        height_m: With its backplate, if it has one.
        width_m: The same.
        proportion: How common it is taken to be.
    """

    height_m: float
    width_m: float
    proportion: float


HOUSINGS: Final[Mapping[str, Housing]] = {
    "3 lenses of 0.30 m": Housing(1.07, 0.35, 0.38),
    "3 lenses of 0.30 m, backplate": Housing(1.32, 0.61, 0.38),
    "3 lenses of 0.20 m": Housing(0.75, 0.25, 0.10),
    "3 lenses of 0.20 m, backplate": Housing(1.00, 0.51, 0.03),
    "4 lenses of 0.30 m": Housing(1.42, 0.35, 0.04),
    "4 lenses of 0.30 m, backplate": Housing(1.68, 0.61, 0.05),
    "2 lenses of 0.30 m": Housing(0.71, 0.35, 0.02),
}
"""The proportions are a judgement, no count of signals is at hand: new signals have lenses of
0.30 m and at least three of them (MUTCD), with or without a backplate."""
ASPECT_SPREAD: Final = 0.15
"""Of a box's height by width about its housing's, in logarithms: boxes drawn tight or wide."""
OBLIQUE: Final = 0.10
ANY_ASPECT: Final = 1.5
"""Proportion of boxes whose shape says nothing (seen from the side, with hoods, or cut), spread
over so wide a span of logarithms."""
BOX_SPREAD: Final = 0.05
"""Of a box's height about its object's."""
STOP_SIGN: Final = SizePrior(0.82, 0.13)
"""Faces of 0.75 m and 0.90 m across the flats, seldom 0.60 m, boxes drawn tight or wide."""
VEHICLES: Final[Mapping[str, SizePrior]] = {
    "car": SizePrior(1.65, 0.15),
    "truck": SizePrior(2.50, 0.35),
    "bus": SizePrior(3.10, 0.15),
}
"""By label, as COCO names them. Cars of 1.45 m, and vans and SUVs of 1.7 to 1.9 m, about as many of
each; detectors call both pick-ups of 1.9 m and lorries of 4 m trucks. Boxes drawn tight or wide are
in the spread."""


def light_size(aspect: float | None = None) -> SizePrior:
    """Height of a traffic light whose box is ``aspect`` times as high as wide.

    Args:
        aspect: Positive; None where unknown, as for lights that do not hang upright.
    """
    heights = np.array([one.height_m for one in HOUSINGS.values()])
    weights = np.array([one.proportion for one in HOUSINGS.values()])
    if aspect is not None:
        shapes = np.array([one.height_m / one.width_m for one in HOUSINGS.values()])
        off = np.log(aspect / shapes) / ASPECT_SPREAD
        density = np.exp(-0.5 * off**2) / (ASPECT_SPREAD * np.sqrt(2.0 * np.pi))
        weights = weights * ((1.0 - OBLIQUE) * density + OBLIQUE / ANY_ASPECT)
    weights = weights / weights.sum()
    mean_m = float(weights @ heights)
    spread = float(np.sqrt(weights @ (heights - mean_m) ** 2)) / mean_m
    return SizePrior(mean_m, float(np.hypot(spread, BOX_SPREAD)))


def size_of(cue: str, aspect: float | None = None) -> SizePrior:
    """Standard size of what a cue's detections are.

    Args:
        cue: ``traffic_light`` or ``stop_sign``.
        aspect: Height by width of its box.
    """
    return light_size(aspect) if cue == "traffic_light" else STOP_SIGN
