"""Hidden Markov model of the intersection ahead, filtered exactly over a drive.

The state is either that no intersection is within reach, or a cell of distance to one together with
its set of outgoing roads (its *ways*). The belief in left, right or straight is therefore never
higher than the belief in the intersection itself, and is withdrawn with it.

* *Motion.* The distribution moves by whole cells with the odometer, whose remainder is kept; its
  variance spreads the distribution. A passed intersection leaves the state, and a new one comes
  within reach every ``spacing_m``.
* *Cues.* Given the state, a cue is a Markov chain with two values, positive or not. Its transitions
  depend on the features that it supports and on the distance. A cue that is not evaluated has no
  effect, and its chain restarts. Cues are evaluated once per step of distance, so that the result
  depends neither on the frame rate nor on the time that the car stands.
* *Moving objects.* Cues of moving objects also count if they appear between two such steps: the
  first appearance, once. The time without any depends on the traffic, which is not modelled.
* *Ranges.* A sign's range is Gaussian about the distance, or stray and uniform. A false sign
  without an intersection also has a fixed position, and its ranges agree with each other. That
  state therefore has a distance, too, and ranges alone are evidence of position, not of existence.

The reported probability is the posterior, mixed with the prior by the probability of a *lapse*: a
place that differs from all places of the fit. Both probabilities obey the same bounds.

With likelihoods raised to an exponent, because cues are redundant, the posterior is
``p(x | now) ~ L(now | x)^a sum p(x | x') p(x' | before)``: the forward recursion (Rabiner, *A
Tutorial on Hidden Markov Models*, Proc. IEEE 77, 1989, section III.A).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import CueChain, Temporal

from .factor_graph import CueNode, FactorGraph, log_odds
from .independence import effective_sample_fraction
from .intersection_range import Reference

# Feature on which all others depend.
PRESENCE: Final = "intersection"
# Stray ranges are uniform up to this distance.
MAX_RANGE_M: Final = 150.0
# Minimum distance of a reported probability from 0 and 1.
FLOOR: Final = 1e-9
# Maximum fraction of a cell's mass that moves to either side per step; the remaining variance is
# applied in the next step.
MAX_SPREAD: Final = 0.25


# Relative s.d. of the default length, for an intersection whose end only was measured.
LENGTH_SD_FRACTION: Final = 0.25
# Minimum weight of a range in independent ranges; below it, a repeated range is ignored.
MIN_WORTH: Final = 1e-3


def ranges_to_start(
    measured: Mapping[Reference, tuple[float, float]],
    since_m: float,
    fade_m: float,
    length_m: float,
) -> tuple[tuple[float, float], ...]:
    """Convert measured ranges to ranges and variances to the start of an intersection.

    Args:
        measured: Range and variance of each reference.
        since_m: Distance since the previous frame with ranges, whose errors are correlated.
        fade_m: Distance over which errors become independent.
        length_m: Distance from start to end.
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
    """Probabilities that one cue is positive: at first, after a negative and a positive step.

    Attributes:
        moves: True if it detects moving objects.
        nowhere: Shape (3,): without an intersection ahead.
        ahead: Shape (3, distances, ways): with an intersection ahead.
    """

    cue: str
    moves: bool
    nowhere: NDArray[np.float64]
    ahead: NDArray[np.float64]


class _Said(NamedTuple):
    """What one cue says: its value now, and in the previous step (None if not evaluated)."""

    chain: _Chain
    before: bool | None
    is_positive: bool


@dataclass(frozen=True, slots=True, eq=False)
class TemporalModel:
    """Fitted parameters, as arrays.

    Attributes:
        settings: Section of the vehicle file.
        ways: W sets of outgoing roads, as tuples of features.
        way_probabilities: Shape (W,).
        chains: Chain of each fitted cue.
        has_feature: Shape (features, W): 1 if a set has the feature, in the graph's order.
    """

    settings: Temporal
    ways: tuple[tuple[str, ...], ...]
    way_probabilities: NDArray[np.float64]
    chains: tuple[_Chain, ...]
    has_feature: NDArray[np.float64]

    @property
    def usual(self) -> NDArray[np.float64]:
        """Prior probabilities at the start of a drive, shape (features,)."""
        return np.asarray(self.settings.ahead * (self.has_feature @ self.way_probabilities))

    @property
    def cells(self) -> int:
        """Number of cells of distance."""
        reach_m = self.settings.edges_m[-1] + self.settings.behind_m
        return max(math.ceil(reach_m / self.settings.cell_m), 2)


def temporal_model(graph: FactorGraph, settings: Temporal) -> TemporalModel:
    """Combine the graph's features with fitted parameters.

    Raises:
        ValueError: The graph has no feature ``intersection``.
    """
    if PRESENCE not in graph.feature_names:
        raise ValueError(f"no feature {PRESENCE!r}; there are: {', '.join(graph.feature_names)}")
    ways = tuple(ways_of(name) for name in settings.ways)
    probabilities = np.array(list(settings.ways.values()))
    has = [[float(name == PRESENCE or name in way) for way in ways] for name in graph.feature_names]
    known = {cue.name: cue for cue in graph.cues}
    names = dict.fromkeys(one.cue for one in settings.chains if one.cue in known)
    chains = tuple(_chain(known[name], settings, ways) for name in names)
    return TemporalModel(settings, ways, probabilities / probabilities.sum(), chains, np.array(has))


def ways_of(name: str) -> tuple[str, ...]:
    """Features in a key of ``Temporal.ways``."""
    return () if name == "none" else tuple(name.split("+"))


def _chain(cue: CueNode, settings: Temporal, ways: Sequence[tuple[str, ...]]) -> _Chain:
    mine = [one for one in settings.chains if one.cue == cue.name]
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
    return _Chain(cue.name, cue.moves, nowhere, ahead)


def _fits(chain: CueChain, way: tuple[str, ...]) -> bool:
    features = {PRESENCE, *way}
    return features.issuperset(chain.there) and features.isdisjoint(chain.missing)


@dataclass(slots=True, eq=False)
class TemporalFilter:
    """Filter of one drive.

    Attributes:
        model: Fitted parameters.
        nowhere: Shape (cells,): probability that no intersection is within reach and a potential
            false sign is at this distance.
        ahead: Shape (cells, ways): joint probability of distance and outgoing roads.
    """

    model: TemporalModel
    nowhere: NDArray[np.float64] = field(init=False)
    ahead: NDArray[np.float64] = field(init=False)
    _moved_m: float = 0.0
    _var_m2: float = 0.0
    _since_m: float = math.inf
    _since_s: float = math.inf
    _before: dict[str, bool] = field(default_factory=dict)
    _appeared: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Start with the prior."""
        settings = self.model.settings
        is_ahead = self.centers_m() > 0.0
        spread = is_ahead / is_ahead.sum()
        self.nowhere = (1.0 - settings.ahead) * spread
        self.ahead = settings.ahead * spread[:, None] * self.model.way_probabilities[None, :]

    def centers_m(self) -> NDArray[np.float64]:
        """Distance of each cell's centre from the rear axle, shape (cells,)."""
        settings = self.model.settings
        middle = (np.arange(self.model.cells) + 0.5) * settings.cell_m
        return np.asarray(middle - settings.behind_m - self._moved_m)

    def probabilities(self) -> NDArray[np.float64]:
        """Probability of each feature, in the graph's order, within (0, 1)."""
        lapse = self.model.settings.lapse
        mass = self.model.has_feature @ self.ahead.sum(axis=0)
        mixed = (1.0 - lapse) * mass + lapse * self.model.usual
        return np.asarray(np.clip(mixed, FLOOR, 1.0 - FLOOR))

    def distance_m(self) -> float:
        """Mean distance, given that an intersection is ahead."""
        mass = self.ahead.sum(axis=1)
        return float(mass @ self.centers_m() / max(float(mass.sum()), FLOOR))

    def update(
        self,
        counts: Mapping[str, int],
        ranges: Sequence[MeasuredRange] = (),
        moved_m: float = 0.0,
        moved_var_m2: float = 0.0,
        passed_s: float = 0.0,
        *,
        is_new_picture: bool = True,
        is_standing: bool = False,
    ) -> None:
        """Process one frame.

        Args:
            counts: Number of objects of each evaluated cue.
            ranges: Ranges measured in this frame; correlated ranges have more variance.
            moved_m: Distance since the previous frame, forwards positive.
            moved_var_m2: Variance of the distance.
            passed_s: Time since the previous frame.
            is_new_picture: False if the picture repeats the previous one.
            is_standing: True if only cues of moving objects count.
        """
        self._move(moved_m, moved_var_m2)
        if not is_standing:
            self._spread()
        self._since_m += abs(moved_m)
        self._since_s += passed_s
        settings = self.model.settings
        log_nowhere, log_ahead = np.zeros_like(self.nowhere), np.zeros_like(self.ahead)
        is_step = self._since_m >= settings.step_m and not is_standing
        if is_new_picture and (is_step or self._since_s >= settings.step_s):
            self._since_s = 0.0
            if is_step:
                self._since_m = 0.0
            said = self._all_cues(counts) if is_step else self._appearances(counts)
            nowhere, ahead = self._likelihoods(said)
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

    def _all_cues(self, counts: Mapping[str, int]) -> list[_Said]:
        """Return what all evaluated cues say after a step of distance."""
        heard = {one.cue: counts[one.cue] > 0 for one in self.model.chains if one.cue in counts}
        before, self._before = self._before, heard
        self._appeared.clear()
        return [
            _Said(chain, before.get(chain.cue), heard[chain.cue])
            for chain in self.model.chains
            if chain.cue in heard
        ]

    def _appearances(self, counts: Mapping[str, int]) -> list[_Said]:
        """Return the cues of moving objects that appear for the first time since that step."""
        new = []
        for chain in self.model.chains:
            if not chain.moves or chain.cue not in counts:
                continue
            before = self._before.get(chain.cue)
            self._before[chain.cue] = is_positive = counts[chain.cue] > 0
            if is_positive and not before and chain.cue not in self._appeared:
                self._appeared.add(chain.cue)
                new.append(_Said(chain, before, is_positive))
        return new

    def _likelihoods(self, said: Sequence[_Said]) -> tuple[float, NDArray[np.float64]]:
        """Log likelihoods of what cues say, nowhere and by cell and way."""
        settings = self.model.settings
        at = np.searchsorted(np.array(settings.edges_m[1:-1]), self.centers_m(), side="right")
        nowhere, by_distance = 0.0, np.zeros((len(settings.edges_m) - 1, len(self.model.ways)))
        for chain, before, is_positive in said:
            row = 0 if before is None else 1 + before
            p, q = chain.ahead[row], float(chain.nowhere[row])
            by_distance += np.log(p if is_positive else 1.0 - p)
            nowhere += math.log(q if is_positive else 1.0 - q)
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

    def _shift(self) -> None:
        """Move all mass one cell nearer; the nearest cell is passed, and a new one is in reach."""
        settings = self.model.settings
        comes = min(settings.cell_m / settings.spacing_m, 1.0)
        coming = float(self.nowhere.sum()) * comes
        passed = float(self.ahead[0].sum()) / self.model.cells
        # The nearest false sign is passed, too; the next one is at the maximum distance.
        self.nowhere = np.roll(self.nowhere, -1) * (1.0 - comes) + passed
        self.ahead = np.roll(self.ahead, -1, axis=0)
        self.ahead[-1] = coming * self.model.way_probabilities

    def _shift_back(self) -> None:
        """Move all mass one cell further away; the furthest cell is out of reach."""
        lost = float(self.ahead[-1].sum()) / self.model.cells
        self.nowhere = np.roll(self.nowhere, 1) + lost
        self.ahead = np.roll(self.ahead, 1, axis=0)
        self.ahead[0] = 0.0

    def _spread(self) -> None:
        cell_m = self.model.settings.cell_m
        side = min(self._var_m2 / (2.0 * cell_m**2), MAX_SPREAD)
        self._var_m2 -= side * 2.0 * cell_m**2
        self.nowhere = _blurred(self.nowhere[:, None], side)[:, 0]
        self.ahead = _blurred(self.ahead, side)


def _blurred(mass: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """Move the fraction ``side`` of each cell to either neighbour; the end cells keep theirs."""
    blurred = mass * (1.0 - 2.0 * side)
    blurred[:-1] += side * mass[1:]
    blurred[1:] += side * mass[:-1]
    blurred[[0, -1]] += side * mass[[0, -1]]
    return np.asarray(blurred)


class TemporalMessageModel:
    """Message model of one approach: the filter's changes of the log odds."""

    def __init__(self, graph: FactorGraph, over_drive: TemporalFilter) -> None:
        """Start an approach; the filter continues along the drive."""
        self._filter = over_drive
        self._odds = [log_odds(feature.prior) for feature in graph.features]

    def __call__(self, situation: Situation) -> list[float]:
        """Process a frame; return the change of the log odds."""
        update_with(self._filter, situation)
        odds = [log_odds(p) for p in self._filter.probabilities().tolist()]
        out = [now - before for now, before in zip(odds, self._odds, strict=True)]
        self._odds = odds
        return out


def update_with(over_drive: TemporalFilter, situation: Situation) -> None:
    """Process a frame's situation with the filter."""
    over_drive.update(
        situation.counts,
        [MeasuredRange(range_m, var_m2) for range_m, var_m2 in situation.ranges],
        situation.advanced_m,
        situation.advanced_var_m2,
        situation.passed_s,
        is_new_picture=situation.is_new_picture,
        is_standing=situation.is_standing,
    )
