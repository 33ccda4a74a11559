"""Which cue speaks about which feature, as a table, and what a cue says (Fig. 27, eq. 18).

All features are binary and every cue is observed, so each marginal is the normalised product of the
messages into it: in log odds, their sum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Self

from crosscue.replay.vehicle.fusion import Fade, Fusion

USUAL_FADE: Final = Fade(way_m=10.0)
"""Of a cue of which nothing else is known."""
LOG_ODDS_LIMIT: Final = 30.0
"""Beyond it a probability is reported as that of the limit, 1e-13 from 0 or 1. Sums are kept
whole, so that evidence can turn a belief round and the order in which it came does not matter."""


def log_odds(probability: float) -> float:
    """log(p / (1 - p)).

    Raises:
        ValueError: Not strictly between 0 and 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability: expected inside (0, 1), got {probability}")
    return math.log(probability) - math.log1p(-probability)


def probability(odds: float) -> float:
    """The probability of log odds; never 0 or 1, whatever the sum."""
    return 1.0 / (1.0 + math.exp(-max(-LOG_ODDS_LIMIT, min(LOG_ODDS_LIMIT, odds))))


@dataclass(frozen=True, slots=True)
class Feature:
    """A latent node.

    Attributes:
        name: As in ``belief.parquet``.
        prior: Probability at the start of an approach.
        establishes: Presence is established once it is probable.
    """

    name: str
    prior: float = 0.5
    establishes: bool = False


@dataclass(frozen=True, slots=True)
class CueNode:
    """An observed node.

    Attributes:
        name: As in ``cues.parquet``.
        precision: What a detection sends along a direct edge.
        speaks_first: Sends before presence is established.
        counted: One message for each detection.
        dissents: Near the intersection its absence speaks against what it supports.
        seen_frames: Where persistence counts: believed once positive in so many frames ...
        of_frames: ... of the last so many.
        within_m: Likewise: says nothing about an intersection known to be further away.
        fade: Likewise: over what its errors become independent.
    """

    name: str
    precision: float
    speaks_first: bool = False
    counted: bool = False
    dissents: bool = False
    seen_frames: int = 1
    of_frames: int = 1
    within_m: float = math.inf
    fade: Fade = USUAL_FADE


@dataclass(frozen=True, slots=True)
class Edge:
    """A cue and a feature; direct if the cue shows the feature to be there, else exclusive."""

    cue: str
    feature: str
    is_direct: bool = True


@dataclass(frozen=True, slots=True)
class FactorGraph:
    """Features, cues and the edges between them."""

    features: tuple[Feature, ...]
    cues: tuple[CueNode, ...]
    edges: tuple[Edge, ...]

    def __post_init__(self) -> None:
        """Refuse edges that lead nowhere and names that stand twice.

        Raises:
            ValueError: With the name and the names there are.
        """
        features, cues = self.feature_names, tuple(cue.name for cue in self.cues)
        for kind, names in (("feature", features), ("cue", cues)):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"{kind} {twice[0]!r} stands twice; name each once")
        for edge in self.edges:
            if edge.feature not in features:
                raise ValueError(f"no feature {edge.feature!r}; there are: {', '.join(features)}")
            if edge.cue not in cues:
                raise ValueError(f"no cue {edge.cue!r}; there are: {', '.join(cues)}")
        pairs = [(edge.cue, edge.feature) for edge in self.edges]
        if len(set(pairs)) < len(pairs):
            raise ValueError("edges: a cue and a feature are joined twice; keep one edge")

    @property
    def feature_names(self) -> tuple[str, ...]:
        """In the order of all lists of log odds."""
        return tuple(feature.name for feature in self.features)

    def without(self, cue: str) -> Self:
        """The graph with one cue left out.

        Raises:
            ValueError: No such cue.
        """
        names = [node.name for node in self.cues]
        if cue not in names:
            raise ValueError(f"no cue {cue!r}; there are: {', '.join(names)}")
        return replace(
            self,
            cues=tuple(node for node in self.cues if node.name != cue),
            edges=tuple(edge for edge in self.edges if edge.cue != cue),
        )


def graph_of(fusion: Fusion) -> FactorGraph:
    """The graph that a vehicle file describes."""
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
            CueNode(
                name,
                c.precision,
                c.speaks_first,
                c.counted,
                c.dissents,
                c.seen_frames,
                c.of_frames,
                c.within_m,
                c.fade,
            )
            for name, c in cues.items()
        ),
        tuple(edges),
    )
