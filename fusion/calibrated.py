"""Cues that speak as often as they have been seen to be right, and do not repeat themselves.

The source multiplies in the same parked car again in every frame, as if each observation were a new
one, and takes precision for a likelihood ratio. Here a cue is a Markov chain with two states,
positive or not: where a feature is there it is positive at a rate ``p``, where not at a rate ``q``,
and an observation resembles the one before by ``rho = exp(-way / fade)`` (or time, for what moves
by itself). Each look says to the feature

    log P(now | before, there) - log P(now | before, not there),
    P(positive | positive) = p + (1 - p) rho,      P(positive | not) = p (1 - rho),

so a cue that appears says log(p / q) at once and little more while it stays; one that goes says
log((1 - p) / (1 - q)); a car that stands, or a picture seen before, says nothing new. The chain
alone would hear noise in a cue that flickers: an appearance soon after another is worth only its
independent share. A thing not seen before in this approach (a new identity, or more things than
ever at once) appears again. Absence speaks as much as was learned, in place of the source's 0.49.
Rates are learned apart for near and far, where the same absence means different things.

Cues are not independent of each other given a feature; one exponent for each feature makes up for
it. Where nothing was learned for an edge (no annotated drive without the feature, say), the
published message stands, discounted by the way or time since it was last sent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from crosscue.fusion.situation import Situation
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Rates

from .factor_graph import USUAL_FADE, CueNode, FactorGraph, log_odds
from .independence import effective_sample_fraction


class Learned(NamedTuple):
    """One edge: rates where the feature is there and where not; ``scale`` is its exponent."""

    feature: int
    if_there: float
    if_not: float
    scale: float

    def says(
        self, is_positive: bool, was_positive: bool | None, rho: float, fraction: float
    ) -> float:
        """Log odds of one observation.

        Args:
            is_positive: Now.
            was_positive: At the look before; None for the first.
            rho: How much this look resembles the one before.
            fraction: What a change is worth, 0 to 1.
        """
        p, q = self.if_there, self.if_not
        if was_positive is is_positive:
            if is_positive:
                return self.scale * math.log((p + (1.0 - p) * rho) / (q + (1.0 - q) * rho))
            return self.scale * math.log((1.0 - p * (1.0 - rho)) / (1.0 - q * (1.0 - rho)))
        change = math.log(p / q) if is_positive else math.log((1.0 - p) / (1.0 - q))
        return self.scale * fraction * change


class Published(NamedTuple):
    """One edge of which nothing was learned: what a detection says, times the exponent."""

    feature: int
    says: float


@dataclass(frozen=True, slots=True)
class Voice:
    """One cue, made ready.

    Attributes:
        cue: Its name.
        speaks_first: Before presence is established.
        fade: Over what its looks become independent.
        near: Learned edges near the intersection.
        far: And elsewhere.
        published_near: The other edges, near.
        published_far: And elsewhere.
    """

    cue: str
    speaks_first: bool
    fade: Fade
    near: tuple[Learned, ...]
    far: tuple[Learned, ...]
    published_near: tuple[Published, ...]
    published_far: tuple[Published, ...]


@dataclass(slots=True)
class _Heard:
    """What one cue said before in this approach; places on the cue's own fading scale."""

    looked_at: float = -math.inf
    was_positive: bool | None = None
    changed_at: dict[bool, float] = field(default_factory=dict)
    sent_at: float = -math.inf
    max_count: int = 0
    known: set[int] = field(default_factory=set)


class CalibratedMessageModel:
    """The cues of one approach."""

    def __init__(self, size: int, voices: Iterable[Voice]) -> None:
        self._size = size
        self._voices = [(voice, _Heard()) for voice in voices]
        self._way_m = 0.0
        self._time_s = 0.0

    def __call__(self, situation: Situation) -> list[float]:
        """Sum of the messages of one frame, in log odds."""
        out = [0.0] * self._size
        self._way_m += situation.moved_m
        self._time_s += situation.passed_s
        if not situation.is_new_picture:
            return out
        for voice, heard in self._voices:
            count = situation.counts.get(voice.cue)
            if count is None or not (voice.speaks_first or situation.is_established):
                continue
            self._speak(voice, heard, count, situation, out)
        return out

    def _speak(
        self, voice: Voice, heard: _Heard, count: int, situation: Situation, out: list[float]
    ) -> None:
        fade = voice.fade
        at = self._time_s / fade.time_s if fade.time_s else self._way_m / (fade.way_m or math.inf)
        is_positive = count > 0
        is_fresh = is_positive and _is_fresh(heard, count, situation.objects.get(voice.cue))
        before = False if is_fresh and heard.was_positive else heard.was_positive
        rho = math.exp(heard.looked_at - at)
        fraction = 1.0
        if before is not is_positive:
            last_at = heard.changed_at.get(is_positive, -math.inf)
            fraction = 1.0 if is_fresh else effective_sample_fraction(at - last_at)
            heard.changed_at[is_positive] = at
        for edge in voice.near if situation.is_near else voice.far:
            out[edge.feature] += edge.says(is_positive, before, rho, fraction)
        if is_positive:
            again = 1.0 if is_fresh else effective_sample_fraction(at - heard.sent_at)
            for other in voice.published_near if situation.is_near else voice.published_far:
                out[other.feature] += again * other.says
            heard.sent_at = at
        heard.looked_at = at
        heard.was_positive = is_positive


def _is_fresh(heard: _Heard, count: int, objects: tuple[int, ...] | None) -> bool:
    """Is there a thing not seen before in this approach? Remembers what there is."""
    if objects is None:
        is_fresh = count > heard.max_count
        heard.max_count = max(heard.max_count, count)
        return is_fresh
    is_fresh = not heard.known.issuperset(objects)
    heard.known.update(objects)
    return is_fresh


def voices_of(graph: FactorGraph, learned: Calibrated) -> tuple[Voice, ...]:
    """Join the graph with what was learned."""
    rates = {(one.cue, one.feature, one.near): one for one in learned.rates}
    scales = {name: learned.exponents.get(name, 1.0) for name in graph.feature_names}
    return tuple(
        Voice(
            cue.name,
            cue.speaks_first,
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
) -> tuple[Learned, ...]:
    return tuple(
        Learned(place, one.if_there, one.if_not, scales[feature])
        for place, feature in enumerate(graph.feature_names)
        if (one := rates.get((cue.name, feature, near))) is not None
    )


def _published(
    graph: FactorGraph, cue: CueNode, near: bool, rates: _Table, scales: Mapping[str, float]
) -> tuple[Published, ...]:
    says = log_odds(cue.precision)
    return tuple(
        Published(
            graph.feature_names.index(edge.feature),
            scales[edge.feature] * (says if edge.is_direct else -says),
        )
        for edge in graph.edges
        if edge.cue == cue.name and (cue.name, edge.feature, near) not in rates
    )
