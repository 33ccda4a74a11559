"""Belief over the features of one intersection, in log odds, and messages of cues (eq. 18)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .factor_graph import FactorGraph, Messages, cue_messages, log_odds, probability
from .situation import Situation


class Belief(NamedTuple):
    """Belief in each feature, in the graph's order.

    Attributes:
        log_odds: Sum of the prior's log odds and of all messages so far; not limited.
        is_established: True once presence is established; permanent for the approach unless
            ``establish`` withdraws it.
    """

    log_odds: tuple[float, ...]
    is_established: bool = False


def begin(graph: FactorGraph) -> Belief:
    """Return the prior belief."""
    return Belief(tuple(log_odds(feature.prior) for feature in graph.features))


def multiply(belief: Belief, messages: Sequence[float]) -> Belief:
    """Multiply each feature's probability by one message, in log odds, and normalise (eq. 18)."""
    sums = tuple(old + new for old, new in zip(belief.log_odds, messages, strict=True))
    return Belief(sums, belief.is_established)


def establish(
    belief: Belief, graph: FactorGraph, threshold: float, withdrawn: float | None = None
) -> Belief:
    """Establish presence if a feature that establishes it exceeds ``threshold``.

    Args:
        belief: Belief before.
        graph: Factor graph, which marks the features that establish presence.
        threshold: Probability above which presence is established.
        withdrawn: Probability at or below which, for all these features, presence is withdrawn; by
            default it is never withdrawn.
    """
    if belief.is_established and withdrawn is None:
        return belief
    limit = log_odds(withdrawn if belief.is_established and withdrawn is not None else threshold)
    is_now = any(
        feature.establishes and odds > limit
        for feature, odds in zip(graph.features, belief.log_odds, strict=True)
    )
    return Belief(belief.log_odds, is_now)


def probabilities(belief: Belief, graph: FactorGraph) -> dict[str, float]:
    """Probability of each feature, strictly between 0 and 1."""
    return {
        name: probability(odds)
        for name, odds in zip(graph.feature_names, belief.log_odds, strict=True)
    }


# Message model: maps a frame's situation to the sum of messages into each feature, in log odds. It
# can depend on earlier messages of the same approach; each approach has a new instance.
MessageModel = Callable[[Situation], Sequence[float]]


class _Line(NamedTuple):
    """One cue, precomputed: the features that it affects, and its messages if present or absent."""

    cue: str
    can_start: bool
    is_per_detection: bool
    detected: Messages
    absent: Messages


@dataclass(frozen=True, slots=True)
class PublishedMessageModel:
    """The published messages: precision along direct edges, its complement along exclusive ones.

    Until earlier frames have established presence, only cues with ``can_start`` send messages.
    """

    size: int
    lines: tuple[_Line, ...]

    def __call__(self, situation: Situation) -> list[float]:
        """Sum the messages of one frame."""
        out = [0.0] * self.size
        counts = situation.counts
        for cue, can_start, is_per_detection, detected, absent in self.lines:
            count = counts.get(cue)
            if count is None or not (can_start or situation.is_established):
                continue
            if count > 0:
                times = count if is_per_detection else 1
                for feature, odds in detected:
                    out[feature] += times * odds
            elif situation.may_dissent:
                for feature, odds in absent:
                    out[feature] += odds
        return out


def published_message_model(graph: FactorGraph, dissent: float) -> PublishedMessageModel:
    """Precompute the graph's messages; ``dissent`` is the message of an absent cue when near."""
    lines = tuple(
        _Line(cue.name, cue.can_start, cue.per_detection, detected, absent)
        for cue, detected, absent in cue_messages(graph, dissent)
    )
    return PublishedMessageModel(len(graph.features), lines)
