"""A belief over time: a hidden Markov model of what is ahead, filtered exactly.

The state is either that no intersection is within reach, or a cell of distance to one together with
the ways that lead on from it. So what is believed of left, right or straight is never more than
what is believed of the intersection itself, and it is withdrawn with it.

* *Motion.* Cells move with the odometer by whole cells, its remainder is kept; its variance spreads
  them. An intersection that is passed leaves the state, one comes into reach every ``spacing_m``.
* *Cues.* Given the state a cue is a Markov chain with two values, positive or not. Its transitions
  depend on the features that it speaks of and on the distance. A cue that nothing looked for says
  nothing, and its chain begins again. Cues are evaluated once a step (of distance, or of time
  where the car stands), so that the result does not depend on the frame rate.
* *Ranges.* A sign's range is Gaussian about the distance, or stray and uniform. A false
  sign, where no intersection is, has a fixed place too, and its ranges agree with one another; so
  that state has a distance as well, and ranges alone say where, not whether.

What is reported is the posterior, but for a *lapse*: a place may be unlike all that were learned
from, and then the prior holds. Both probabilities obey the same bounds.

With likelihoods raised to one exponent (cues repeat one another), the posterior is
``p(x | now) ~ L(now | x)^a sum p(x | x') p(x' | before)``: the forward recursion (Rabiner, *A
Tutorial on Hidden Markov Models*, Proc. IEEE 77, 1989, section III.A).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.temporal import CueChain, Temporal

from .factor_graph import FactorGraph, log_odds
from .independence import effective_sample_fraction
from .intersection_range import Reference

PRESENCE: Final = "intersection"
"""The feature that all others need."""
MAX_RANGE_M: Final = 150.0
"""Stray ranges are spread over this."""
FLOOR: Final = 1e-9
"""A probability is reported no nearer to 0 or 1."""
MAX_SPREAD: Final = 0.25
"""Of a cell's mass to either side in one step; more variance waits for the next."""


LENGTH_SD_FRACTION: Final = 0.25
"""How well a usual length stands for an intersection whose end alone was ranged."""
MIN_WORTH: Final = 1e-3
"""A range that is worth less as an independent one is not heard again."""


def ranges_to_start(
    measured: Mapping[Reference, tuple[float, float]],
    since_m: float,
    fade_m: float,
    length_m: float,
) -> tuple[tuple[float, float], ...]:
    """Ranges to the start of an intersection, and their variances, as the filter takes them.

    Args:
        measured: From a reference to a range and its variance.
        since_m: Way since the frame that was ranged before; its errors resemble this one's.
        fade_m: Over which errors become independent.
        length_m: From start to end.
    """
    worth = 1.0 if fade_m == 0.0 else effective_sample_fraction(since_m / fade_m)
    if worth < MIN_WORTH:
        return ()
    length_var_m2 = (LENGTH_SD_FRACTION * length_m) ** 2
    return tuple(
        (range_m, var_m2 / worth)
        if reference is Reference.START
        else (range_m - length_m, var_m2 / worth + length_var_m2)
        for reference, (range_m, var_m2) in measured.items()
    )


class MeasuredRange(NamedTuple):
    """A sign's range to the start of the intersection."""

    range_m: float
    var_m2: float


class _Chain(NamedTuple):
    """One cue, made ready: columns are first, after a negative step, after a positive one.

    Attributes:
        nowhere: Shape (3,): positive where no intersection is ahead.
        ahead: Shape (3, distances, ways).
    """

    cue: str
    nowhere: NDArray[np.float64]
    ahead: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TemporalModel:
    """What was learned, as arrays.

    Attributes:
        settings: As the vehicle file has it.
        ways: W tuples of features.
        way_probabilities: Shape (W,).
        chains: One for each cue of which anything was learned.
        has_feature: Shape (features, W): in the graph's order, 1 where a way has it.
    """

    settings: Temporal
    ways: tuple[tuple[str, ...], ...]
    way_probabilities: NDArray[np.float64]
    chains: tuple[_Chain, ...]
    has_feature: NDArray[np.float64]

    @property
    def usual(self) -> NDArray[np.float64]:
        """Probabilities before a drive, shape (features,)."""
        return np.asarray(self.settings.ahead * (self.has_feature @ self.way_probabilities))

    @property
    def cells(self) -> int:
        """Of distance."""
        reach_m = self.settings.edges_m[-1] + self.settings.behind_m
        return max(math.ceil(reach_m / self.settings.cell_m), 2)


def temporal_model(graph: FactorGraph, settings: Temporal) -> TemporalModel:
    """Join the graph's features with what was learned.

    Raises:
        ValueError: The graph has no intersection.
    """
    if PRESENCE not in graph.feature_names:
        raise ValueError(f"no feature {PRESENCE!r}; there are: {', '.join(graph.feature_names)}")
    ways = tuple(ways_of(name) for name in settings.ways)
    probabilities = np.array(list(settings.ways.values()))
    has = [[float(name == PRESENCE or name in way) for way in ways] for name in graph.feature_names]
    known = {cue.name for cue in graph.cues}
    names = dict.fromkeys(one.cue for one in settings.chains if one.cue in known)
    chains = tuple(_chain(name, settings, ways) for name in names)
    return TemporalModel(settings, ways, probabilities / probabilities.sum(), chains, np.array(has))


def ways_of(name: str) -> tuple[str, ...]:
    """Features of a key of ``Temporal.ways``."""
    return () if name == "none" else tuple(name.split("+"))


def _chain(cue: str, settings: Temporal, ways: Sequence[tuple[str, ...]]) -> _Chain:
    mine = [one for one in settings.chains if one.cue == cue]
    nowhere = np.full(3, 0.5)
    ahead = np.full((3, len(settings.edges_m) - 1, len(ways)), 0.5)
    for one in mine:
        columns = np.array([one.first, one.appears, one.stays])
        if not (one.there or one.missing):
            nowhere = columns[:, 0]
            continue
        for column, way in enumerate(ways):
            if _fits(one, way):
                ahead[:, :, column] = columns
    return _Chain(cue, nowhere, ahead)


def _fits(chain: CueChain, way: tuple[str, ...]) -> bool:
    features = {PRESENCE, *way}
    return features.issuperset(chain.there) and features.isdisjoint(chain.missing)


@dataclass(slots=True, eq=False)
class TemporalFilter:
    """The belief along one drive.

    Attributes:
        model: What was learned.
        nowhere: Shape (cells,): no intersection is within reach, and what may be taken for one is
            at this distance.
        ahead: Shape (cells, ways): joint probability of distance and ways.
    """

    model: TemporalModel
    nowhere: NDArray[np.float64] = field(init=False)
    ahead: NDArray[np.float64] = field(init=False)
    _moved_m: float = 0.0
    _var_m2: float = 0.0
    _since_m: float = math.inf
    _since_s: float = math.inf
    _before: dict[str, bool] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Know what is known before a drive."""
        settings = self.model.settings
        is_ahead = self.centers_m() > 0.0
        spread = is_ahead / is_ahead.sum()
        self.nowhere = (1.0 - settings.ahead) * spread
        self.ahead = settings.ahead * spread[:, None] * self.model.way_probabilities[None, :]

    def centers_m(self) -> NDArray[np.float64]:
        """Distance of each cell's middle from the rear axle, shape (cells,)."""
        settings = self.model.settings
        middle = (np.arange(self.model.cells) + 0.5) * settings.cell_m
        return np.asarray(middle - settings.behind_m - self._moved_m)

    def probabilities(self) -> NDArray[np.float64]:
        """Of each feature, in the graph's order, within (0, 1)."""
        lapse = self.model.settings.lapse
        mass = self.model.has_feature @ self.ahead.sum(axis=0)
        mixed = (1.0 - lapse) * mass + lapse * self.model.usual
        return np.asarray(np.clip(mixed, FLOOR, 1.0 - FLOOR))

    def distance_m(self) -> float:
        """Expected distance, if an intersection is ahead."""
        mass = self.ahead.sum(axis=1)
        return float(mass @ self.centers_m() / max(float(mass.sum()), FLOOR))

    def hear(
        self,
        counts: Mapping[str, int],
        ranges: Sequence[MeasuredRange] = (),
        moved_m: float = 0.0,
        moved_var_m2: float = 0.0,
        passed_s: float = 0.0,
        *,
        is_new_picture: bool = True,
    ) -> None:
        """Take one frame.

        Args:
            counts: From each cue that was looked for to how often it was found.
            ranges: Measured in this frame; one that repeats an earlier one has more variance.
            moved_m: Way since the frame before, forwards.
            moved_var_m2: Its variance.
            passed_s: Time since then.
            is_new_picture: Not the same as before.
        """
        self._move(moved_m, moved_var_m2)
        self._since_m += abs(moved_m)
        self._since_s += passed_s
        settings = self.model.settings
        log_nowhere, log_ahead = np.zeros_like(self.nowhere), np.zeros_like(self.ahead)
        is_step = self._since_m >= settings.step_m or self._since_s >= settings.step_s
        if is_step and is_new_picture:
            self._since_m = self._since_s = 0.0
            nowhere, ahead = self._cues(counts)
            log_nowhere += settings.exponent * nowhere
            log_ahead += settings.exponent * ahead
        for one in ranges:
            at_cells = self._range(one)
            log_nowhere += at_cells
            log_ahead += at_cells[:, None]
        self._weigh(log_nowhere, log_ahead)

    def _weigh(self, log_nowhere: NDArray[np.float64], log_ahead: NDArray[np.float64]) -> None:
        top = max(float(log_nowhere.max()), float(log_ahead.max()))
        self.nowhere = self.nowhere * np.exp(log_nowhere - top)
        self.ahead = self.ahead * np.exp(log_ahead - top)
        total = float(self.nowhere.sum()) + float(self.ahead.sum())
        self.nowhere /= total
        self.ahead /= total

    def _cues(self, counts: Mapping[str, int]) -> tuple[float, NDArray[np.float64]]:
        """Log likelihoods of all cues that were looked for."""
        settings = self.model.settings
        at = np.searchsorted(np.array(settings.edges_m[1:-1]), self.centers_m(), side="right")
        nowhere, by_distance = 0.0, np.zeros(self.model.chains[0].ahead.shape[1:])
        heard: dict[str, bool] = {}
        for chain in self.model.chains:
            count = counts.get(chain.cue)
            if count is None:
                continue
            before = self._before.get(chain.cue)
            row = 0 if before is None else 1 + before
            heard[chain.cue] = is_positive = count > 0
            p, q = chain.ahead[row], float(chain.nowhere[row])
            by_distance += np.log(p if is_positive else 1.0 - p)
            nowhere += math.log(q if is_positive else 1.0 - q)
        self._before = heard
        return nowhere, np.asarray(by_distance[at])

    def _range(self, one: MeasuredRange) -> NDArray[np.float64]:
        """Log likelihoods of a range, by cell."""
        settings = self.model.settings
        var_m2 = one.var_m2 + settings.cell_m**2 / 12.0
        off = self.centers_m() - one.range_m
        right = np.exp(-0.5 * off**2 / var_m2) / math.sqrt(2.0 * math.pi * var_m2)
        uniform = 1.0 / MAX_RANGE_M
        mixed = (1.0 - settings.stray) * right + settings.stray * uniform
        return np.asarray(np.log(mixed))

    def _move(self, moved_m: float, var_m2: float) -> None:
        cell_m = self.model.settings.cell_m
        self._moved_m += moved_m
        self._var_m2 += var_m2
        while self._moved_m >= cell_m:
            self._moved_m -= cell_m
            self._shift()
        while self._moved_m < 0.0:
            self._moved_m += cell_m
            self._shift_back()
        self._spread()

    def _shift(self) -> None:
        """One cell nearer: the nearest is passed, and one comes into reach."""
        settings = self.model.settings
        comes = min(settings.cell_m / settings.spacing_m, 1.0)
        coming = float(self.nowhere.sum()) * comes
        passed = float(self.ahead[0].sum()) / self.model.cells
        # What was taken for an intersection and is passed: the next is far away.
        self.nowhere = np.roll(self.nowhere, -1) * (1.0 - comes) + passed
        self.ahead = np.roll(self.ahead, -1, axis=0)
        self.ahead[-1] = coming * self.model.way_probabilities

    def _shift_back(self) -> None:
        """One cell further away: the furthest is out of reach."""
        lost = float(self.ahead[-1].sum()) / self.model.cells
        self.nowhere = np.roll(self.nowhere, 1) + lost
        self.ahead = np.roll(self.ahead, 1, axis=0)
        self.ahead[0] = 0.0

    def _spread(self) -> None:
        cell_m = self.model.settings.cell_m
        side = min(self._var_m2 / (2.0 * cell_m**2), MAX_SPREAD)
        if side <= 0.0:
            return
        self._var_m2 -= side * 2.0 * cell_m**2
        self.nowhere = _blurred(self.nowhere[:, None], side)[:, 0]
        self.ahead = _blurred(self.ahead, side)


def _blurred(mass: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """Mass with ``side`` of each cell in either neighbour; the ends keep what would leave."""
    blurred = mass * (1.0 - 2.0 * side)
    blurred[:-1] += side * mass[1:]
    blurred[1:] += side * mass[:-1]
    blurred[[0, -1]] += side * mass[[0, -1]]
    return np.asarray(blurred)


class TemporalSpeaker:
    """The filter as the messages of one approach: what it adds to the log odds before."""

    def __init__(self, graph: FactorGraph, over_drive: TemporalFilter) -> None:
        """Begin an approach; the filter goes on along the drive."""
        self._filter = over_drive
        self._odds = [log_odds(feature.prior) for feature in graph.features]

    def __call__(self, situation: Situation) -> list[float]:
        """From the belief before this frame to that after it."""
        hear(self._filter, situation)
        odds = [log_odds(p) for p in self._filter.probabilities().tolist()]
        out = [now - before for now, before in zip(odds, self._odds, strict=True)]
        self._odds = odds
        return out


def hear(over_drive: TemporalFilter, situation: Situation) -> None:
    """Let the filter take a frame."""
    over_drive.hear(
        situation.counts,
        [MeasuredRange(range_m, var_m2) for range_m, var_m2 in situation.ranges],
        situation.advanced_m,
        situation.advanced_var_m2,
        situation.passed_s,
        is_new_picture=situation.is_new_picture,
    )
