"""Belief over time, combined with a logistic regression over running sums of evidence.

The sums are those of eq. 18 for each feature: the log odds of the precision of each positive cue on
a direct edge, less that on an exclusive one. They are added once per step of distance, as in
``temporal``, so a car that stands adds nothing, and they fade over distance. A fitted logistic
regression maps them, compressed by asinh because cues are correlated, to the log odds of each
feature. The belief is the mean of these log odds and those of the hidden Markov model: the one
knows the distance, the frequencies and how cues follow each other, the other only how much was
seen, and their errors differ (Bates, Granger, *The Combination of Forecasts*, 1969). No direction
is more probable than the intersection itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.vehicle.combined import Combined

from .factor_graph import FactorGraph, log_odds
from .temporal import FLOOR, PRESENCE, MeasuredRange, TemporalFilter, TemporalModel


@dataclass(slots=True, eq=False)
class EvidenceSums:
    """Running sums of the published log odds, by feature in the graph's order."""

    graph: FactorGraph
    fade_m: float
    step_m: float
    _sums: NDArray[np.float64] = field(init=False)
    _edges: dict[str, list[tuple[int, float]]] = field(init=False)
    _since_m: float = math.inf

    def __post_init__(self) -> None:
        """Start without evidence."""
        names = self.graph.feature_names
        odds = {cue.name: log_odds(cue.precision) for cue in self.graph.cues}
        self._sums = np.zeros(len(names))
        self._edges = {cue: [] for cue in odds}
        for edge in self.graph.edges:
            says = odds[edge.cue] if edge.is_direct else -odds[edge.cue]
            self._edges[edge.cue].append((names.index(edge.feature), says))

    def update(self, counts: Mapping[str, int], moved_m: float, *, adds: bool = True) -> None:
        """Fade over the distance, and add the positive cues once per step of it."""
        self._sums *= math.exp(-abs(moved_m) / self.fade_m)
        self._since_m += abs(moved_m)
        if not adds or self._since_m < self.step_m:
            return
        self._since_m = 0.0
        for cue, count in counts.items():
            if count > 0:
                for feature, says in self._edges.get(cue, ()):
                    self._sums[feature] += says

    def statistics(self) -> NDArray[np.float64]:
        """Return the compressed sums, shape (features,)."""
        return np.asarray(np.arcsinh(self._sums))


class CombinedFilter(TemporalFilter):
    """Filter of one drive."""

    def __init__(self, graph: FactorGraph, model: TemporalModel, settings: Combined) -> None:
        """Start with the prior and without evidence."""
        super().__init__(model)
        self._graph, self._settings = graph, settings
        self._evidence = EvidenceSums(graph, settings.fade_m, model.settings.step_m)

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
        """Process one frame; see ``TemporalFilter.update``."""
        super().update(
            counts,
            ranges,
            moved_m,
            moved_var_m2,
            passed_s,
            is_new_picture=is_new_picture,
            is_standing=is_standing,
        )
        self._evidence.update(counts, moved_m, adds=is_new_picture and not is_standing)

    def probabilities(self) -> NDArray[np.float64]:
        """Probability of each feature, in the graph's order, within (0, 1)."""
        statistics = self._evidence.statistics()
        return mixed(super().probabilities(), statistics, self._settings, self._graph)


def mixed(
    temporal: NDArray[np.float64],
    statistics: NDArray[np.float64],
    settings: Combined,
    graph: FactorGraph,
) -> NDArray[np.float64]:
    """Return the combined probabilities, shape (..., features).

    Args:
        temporal: Probabilities of the hidden Markov model, shape (..., features).
        statistics: Compressed sums of evidence, of the same shape.
        settings: Fitted regression.
        graph: The graph whose order of features they have.
    """
    names = graph.feature_names
    weights = np.array([[settings.weights[a].get(b, 0.0) for b in names] for a in names])
    regressed = statistics @ weights.T + np.array([settings.intercepts[name] for name in names])
    odds = 0.5 * (np.log(temporal) - np.log1p(-temporal) + regressed)
    found = np.clip(1.0 / (1.0 + np.exp(-np.clip(odds, -40.0, 40.0))), FLOOR, 1.0 - FLOOR)
    present = names.index(PRESENCE)
    return np.asarray(np.minimum(found, found[..., present : present + 1]))
