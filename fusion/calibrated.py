"""Message model with fitted rates, which accounts for correlated observations.

The dissertation multiplies in the same parked car in every frame, as if observations were
independent, and uses precision as a likelihood ratio. Here a cue is a Markov chain with two states,
positive or not. It is positive at rate ``p`` if a feature is present and at rate ``q`` if not.
Successive observations have the correlation ``rho = exp(-distance / fade)``, or time instead of
distance for moving objects. The message of an observation to the feature is

    log P(now | before, present) - log P(now | before, absent),
    P(positive | positive) = p + (1 - p) rho,      P(positive | not) = p (1 - rho).

A cue that appears therefore sends log(p / q) at once and little more while it remains. One that
disappears sends log((1 - p) / (1 - q)). A standing car or a repeated picture adds nothing. A
flickering cue would add noise, so an appearance soon after another is weighted by its independent
fraction. An object that is new in this approach (a new identity, or a higher count than before)
counts as a new appearance. The message of an absent cue is fitted, in place of the dissertation's
0.49. Near and far rates are fitted separately, because absence has a different meaning there.

Cues are not conditionally independent given a feature; one exponent per feature compensates for
this. An edge without fitted rates (for example, without an annotated drive that lacks the feature)
uses the published message, discounted by the distance or time since it was last sent.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Rates

from .factor_graph import USUAL_FADE, CueNode, FactorGraph, log_odds
from .independence import effective_sample_fraction


class FittedEdge(NamedTuple):
    """One edge with fitted rates if the feature is present or absent; ``scale`` is its exponent."""

    feature: int
    if_there: float
    if_not: float
    scale: float

    def message(
        self, is_positive: bool, was_positive: bool | None, rho: float, fraction: float
    ) -> float:
        """Message of one observation, in log odds.

        Args:
            is_positive: True if the cue is positive now.
            was_positive: True if it was positive at the previous observation; None for the first.
            rho: Correlation with the previous observation.
            fraction: Weight of a change, 0 to 1.
        """
        p, q = self.if_there, self.if_not
        if was_positive is is_positive:
            if is_positive:
                return self.scale * math.log((p + (1.0 - p) * rho) / (q + (1.0 - q) * rho))
            return self.scale * math.log((1.0 - p * (1.0 - rho)) / (1.0 - q * (1.0 - rho)))
        change = math.log(p / q) if is_positive else math.log((1.0 - p) / (1.0 - q))
        return self.scale * fraction * change


class Published(NamedTuple):
    """One edge without fitted rates: the published message of a detection, times the exponent."""

    feature: int
    log_odds: float


@dataclass(frozen=True, slots=True)
class CueMessages:
    """One cue with its edges, precomputed.

    Attributes:
        cue: Name of the cue.
        can_start: True if it sends messages before presence is established.
        fade: Distance or time over which its observations become independent.
        near: Edges with fitted rates, near the intersection.
        far: Edges with fitted rates, elsewhere.
        published_near: Edges with published messages, near the intersection.
        published_far: Edges with published messages, elsewhere.
    """

    cue: str
    can_start: bool
    fade: Fade
    near: tuple[FittedEdge, ...]
    far: tuple[FittedEdge, ...]
    published_near: tuple[Published, ...]
    published_far: tuple[Published, ...]


@dataclass(slots=True)
class _History:
    """History of one cue in this approach; positions are in units of the cue's fade."""

    observed_at: float = -math.inf
    was_positive: bool | None = None
    changed_at: dict[bool, float] = field(default_factory=dict)
    sent_at: float = -math.inf
    max_count: int = 0
    known: set[int] = field(default_factory=set)


class CalibratedMessageModel:
    """Message model of one approach, with fitted rates."""

    def __init__(self, size: int, cues: Iterable[CueMessages]) -> None:
        self._size = size
        self._cues = [(messages, _History()) for messages in cues]
        self._way_m = 0.0
        self._time_s = 0.0

    def __call__(self, situation: Situation) -> list[float]:
        """Return the sum of the messages of one frame, in log odds."""
        out = [0.0] * self._size
        self._way_m += situation.moved_m
        self._time_s += situation.passed_s
        if not situation.is_new_picture:
            return out
        for messages, history in self._cues:
            count = situation.counts.get(messages.cue)
            if count is None or not (messages.can_start or situation.is_established):
                continue
            self._add_messages(messages, history, count, situation, out)
        return out

    def _add_messages(
        self,
        messages: CueMessages,
        history: _History,
        count: int,
        situation: Situation,
        out: list[float],
    ) -> None:
        fade = messages.fade
        at = self._time_s / fade.time_s if fade.time_s else self._way_m / (fade.way_m or math.inf)
        is_positive = count > 0
        is_fresh = is_positive and _is_fresh(history, count, situation.objects.get(messages.cue))
        before = False if is_fresh and history.was_positive else history.was_positive
        rho = math.exp(history.observed_at - at)
        last_at = -math.inf if is_fresh else history.changed_at.get(is_positive, -math.inf)
        fraction = effective_sample_fraction(at - last_at)
        if before is not is_positive:
            history.changed_at[is_positive] = at
        for edge in messages.near if situation.is_near else messages.far:
            out[edge.feature] += edge.message(is_positive, before, rho, fraction)
        if is_positive:
            again = 1.0 if is_fresh else effective_sample_fraction(at - history.sent_at)
            for other in messages.published_near if situation.is_near else messages.published_far:
                out[other.feature] += again * other.log_odds
            history.sent_at = at
        history.observed_at = at
        history.was_positive = is_positive


def _is_fresh(history: _History, count: int, objects: tuple[int, ...] | None) -> bool:
    """Whether an object is new in this approach; the current objects are remembered."""
    if objects is None:
        is_fresh = count > history.max_count
        history.max_count = max(history.max_count, count)
        return is_fresh
    is_fresh = not history.known.issuperset(objects)
    history.known.update(objects)
    return is_fresh


def cue_messages_of(graph: FactorGraph, learned: Calibrated) -> tuple[CueMessages, ...]:
    """Combine the graph with fitted parameters."""
    rates = {(one.cue, one.feature, one.near): one for one in learned.rates}
    scales = {name: learned.exponents.get(name, 1.0) for name in graph.feature_names}
    return tuple(
        CueMessages(
            cue.name,
            cue.can_start,
            learned.fades.get(cue.name, USUAL_FADE),
            _learned(graph, cue, True, rates, scales),
            _learned(graph, cue, False, rates, scales),
            _published(graph, cue, True, rates, scales),
            _published(graph, cue, False, rates, scales),
        )
        for cue in graph.cues
    )


_Table = Mapping[tuple[str, str, bool], Rates]


def _learned(
    graph: FactorGraph, cue: CueNode, near: bool, rates: _Table, scales: Mapping[str, float]
) -> tuple[FittedEdge, ...]:
    return tuple(
        FittedEdge(place, one.if_there, one.if_not, scales[feature])
        for place, feature in enumerate(graph.feature_names)
        if (one := rates.get((cue.name, feature, near))) is not None
    )


def _published(
    graph: FactorGraph, cue: CueNode, near: bool, rates: _Table, scales: Mapping[str, float]
) -> tuple[Published, ...]:
    message = log_odds(cue.precision)
    return tuple(
        Published(
            graph.feature_names.index(edge.feature),
            scales[edge.feature] * (message if edge.is_direct else -message),
        )
        for edge in graph.edges
        if edge.cue == cue.name and (cue.name, edge.feature, near) not in rates
    )
