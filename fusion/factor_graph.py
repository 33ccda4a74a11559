"""Factor graph of features and cues, as a table (Fig. 27, eq. 18).

All features are binary and every cue is observed, so each marginal is the normalised product of the
messages into it; in log odds, it is their sum.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Final, Self, TypeAlias

from crosscue.replay.vehicle.fusion import Fade, Fusion

# Default fade of a cue without a fitted one.
USUAL_FADE: Final = Fade(way_m=10.0)
# Limit of log odds in the conversion to a probability, which stays 1e-13 away from 0 and 1. Sums of
# log odds are not limited, so that evidence can reverse a belief and its order does not matter.
LOG_ODDS_LIMIT: Final = 30.0
# Messages of a cue: the place of each feature that it affects, and the message, in log odds.
Messages: TypeAlias = tuple[tuple[int, float], ...]


def log_odds(probability: float) -> float:
    """log(p / (1 - p)).

    Raises:
        ValueError: The probability is not strictly between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability: expected inside (0, 1), got {probability}")
    return math.log(probability) - math.log1p(-probability)


def probability(odds: float) -> float:
    """Convert log odds to a probability, which is never 0 or 1."""
    return 1.0 / (1.0 + math.exp(-max(-LOG_ODDS_LIMIT, min(LOG_ODDS_LIMIT, odds))))


@dataclass(frozen=True, slots=True)
class Feature:
    """A latent node of the graph.

    Attributes:
        name: Name, as in ``belief.parquet``.
        prior: Probability at the start of an approach.
        establishes: True if a high probability of this feature establishes presence.
    """

    name: str
    prior: float = 0.5
    establishes: bool = False


@dataclass(frozen=True, slots=True)
class CueNode:
    """An observed node of the graph.

    Attributes:
        name: Name, as in ``cues.parquet``.
        precision: Message of a detection along a direct edge, as a probability.
        can_start: True if it sends messages before presence is established.
        per_detection: True to send one message per detection.
        absence_counts: True if its absence near the intersection is evidence against its features.
        seen_frames: With persistence: minimum number of positive frames.
        of_frames: With persistence: number of last frames among which ``seen_frames`` are counted.
        within_m: With persistence: distance of the intersection beyond which it sends no message.
        fade: With persistence: distance or time over which its errors become independent.
        at_most: With persistence: probability that it can give a feature alone; None for no limit.
    """

    name: str
    precision: float
    can_start: bool = False
    per_detection: bool = False
    absence_counts: bool = False
    seen_frames: int = 1
    of_frames: int = 1
    within_m: float = math.inf
    fade: Fade = USUAL_FADE
    at_most: float | None = None

    @property
    def moves(self) -> bool:
        """Whether it detects moving objects, which a standing car sees come and go."""
        return self.fade.time_s is not None


@dataclass(frozen=True, slots=True)
class Edge:
    """A cue and a feature; direct if the cue supports the feature, else exclusive."""

    cue: str
    feature: str
    is_direct: bool = True


@dataclass(frozen=True, slots=True)
class FactorGraph:
    """Features, cues and the edges between them."""

    features: tuple[Feature, ...]
    cues: tuple[CueNode, ...]
    edges: tuple[Edge, ...]

    @property
    def feature_names(self) -> tuple[str, ...]:
        """Names of all features, in the order of lists of log odds."""
        return tuple(feature.name for feature in self.features)

    def without(self, cue: str) -> Self:
        """Return the graph without a cue.

        Raises:
            ValueError: The graph has no such cue.
        """
        names = [node.name for node in self.cues]
        if cue not in names:
            raise ValueError(f"no cue {cue!r}; there are: {', '.join(names)}")
        return replace(
            self,
            cues=tuple(node for node in self.cues if node.name != cue),
            edges=tuple(edge for edge in self.edges if edge.cue != cue),
        )


def cue_messages(
    graph: FactorGraph, dissent: float
) -> Iterator[tuple[CueNode, Messages, Messages]]:
    """Yield each cue with its messages while present, and those while absent near the intersection.

    Args:
        graph: The graph.
        dissent: Message of an absent cue.
    """
    place = {name: i for i, name in enumerate(graph.feature_names)}
    against = log_odds(dissent)
    for cue in graph.cues:
        edges = [edge for edge in graph.edges if edge.cue == cue.name]
        says = log_odds(cue.precision)
        detected = tuple((place[e.feature], says if e.is_direct else -says) for e in edges)
        absent = (e for e in edges if cue.absence_counts and e.is_direct)
        yield cue, detected, tuple((place[e.feature], against) for e in absent)


def graph_of(fusion: Fusion) -> FactorGraph:
    """Build the graph that a vehicle file describes."""
    features = {name: entry for name, entry in fusion.features.items() if entry.use}
    cues = {name: entry for name, entry in fusion.cues.items() if entry.use}
    edges = [
        Edge(name, feature, is_direct)
        for name, entry in cues.items()
        for is_direct, ends in ((True, entry.supports), (False, entry.excludes))
        for feature in ends
        if feature in features
    ]
    return FactorGraph(
        tuple(Feature(name, f.prior, f.establishes) for name, f in features.items()),
        tuple(
            CueNode(name, **{one.name: getattr(cue, one.name) for one in fields(CueNode)[1:]})
            for name, cue in cues.items()
        ),
        tuple(edges),
    )
