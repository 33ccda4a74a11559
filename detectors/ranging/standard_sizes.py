"""Priors of an object's height: standard sizes and their spread.

The size of a signal's housing follows from its lenses (United States: MUTCD and ITE; Europe:
EN 12368): with three lenses of 0.30 m it is 1.07 m high, or 1.32 m with a backplate of 0.13 m
around. The box's aspect shows which of them is probable: housings without a backplate are three
times as high as wide, those with one about twice.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, NamedTuple


@dataclass(frozen=True)
class SizePrior:
    """Lognormal prior of an object's height.

    Attributes:
        mean_m: Expected height.
        spread: Standard deviation as a fraction of the mean.
    """

    mean_m: float
    spread: float

    @cached_property
    def log_var(self) -> float:
        """Variance of the logarithm."""
        return math.log1p(self.spread**2)

    @cached_property
    def log_mean(self) -> float:
        """Mean of the logarithm."""
        return math.log(self.mean_m) - 0.5 * self.log_var


class Housing(NamedTuple):
    """One kind of signal, seen from the front.

    Attributes:
        height_m: Height, including a backplate.
        width_m: Width, including a backplate.
        proportion: Assumed proportion of all signals.
    """

    height_m: float
    width_m: float
    proportion: float


# Kinds of signals by name. The proportions are assumed, because no count of signals is available:
# new signals have at least three lenses of 0.30 m (MUTCD), with or without a backplate.
HOUSINGS: Final[Mapping[str, Housing]] = {
    "3 lenses of 0.30 m": Housing(1.07, 0.35, 0.38),
    "3 lenses of 0.30 m, backplate": Housing(1.32, 0.61, 0.38),
    "3 lenses of 0.20 m": Housing(0.75, 0.25, 0.10),
    "3 lenses of 0.20 m, backplate": Housing(1.00, 0.51, 0.03),
    "4 lenses of 0.30 m": Housing(1.42, 0.35, 0.04),
    "4 lenses of 0.30 m, backplate": Housing(1.68, 0.61, 0.05),
    "2 lenses of 0.30 m": Housing(0.71, 0.35, 0.02),
}
# Height, logarithm of the aspect, and proportion of each.
_ROWS: Final = [(h, math.log(h / w), proportion) for h, w, proportion in HOUSINGS.values()]
# Spread of a box's aspect (height over width) about its housing's, in logarithms.
ASPECT_SPREAD: Final = 0.15
OBLIQUE: Final = 0.10
# Proportion of boxes without a characteristic aspect (seen from the side, with hoods, or cut), and
# their span of log aspects.
ANY_ASPECT: Final = 1.5
# Relative spread of a box's height about its object's.
BOX_SPREAD: Final = 0.05
# Stop signs are 0.75 m and 0.90 m across flats, rarely 0.60 m; errors of boxes are included.
STOP_SIGN: Final = SizePrior(0.82, 0.13)
# Sizes of vehicles by COCO label. Cars are 1.45 m high, vans and SUVs 1.7 to 1.9 m, in about equal
# numbers; detectors label both pick-ups of 1.9 m and lorries of 4 m as trucks. The spread includes
# the errors of boxes.
VEHICLES: Final[Mapping[str, SizePrior]] = {
    "car": SizePrior(1.65, 0.15),
    "truck": SizePrior(2.50, 0.35),
    "bus": SizePrior(3.10, 0.15),
}


@lru_cache(maxsize=256)
def light_size(aspect: float | None = None) -> SizePrior:
    """Size prior of a traffic light whose box is ``aspect`` times as high as wide.

    Args:
        aspect: Positive; None where unknown, as for lights that are not upright.
    """
    whole = first = second = 0.0
    log_aspect = math.nan if aspect is None else math.log(aspect)
    for height_m, usual, weight in _ROWS:
        if aspect is not None:
            off = (usual - log_aspect) / ASPECT_SPREAD
            density = math.exp(-0.5 * off * off) / (ASPECT_SPREAD * math.sqrt(2.0 * math.pi))
            weight *= (1.0 - OBLIQUE) * density + OBLIQUE / ANY_ASPECT
        whole += weight
        first += weight * height_m
        second += weight * height_m * height_m
    mean_m = first / whole
    spread = math.sqrt(second / whole - mean_m * mean_m) / mean_m
    return SizePrior(mean_m, math.hypot(spread, BOX_SPREAD))


def size_prior(cue: str, aspect: float | None = None) -> SizePrior:
    """Size prior of the objects of a cue.

    Args:
        cue: ``traffic_light`` or ``stop_sign``.
        aspect: Height over width of the box; None where unknown.
    """
    return light_size(aspect) if cue == "traffic_light" else STOP_SIGN
