"""Belief over time, combined with a logistic regression over running counts of the cues.

For each cue, the steps of distance in which it was positive, and those in which it was looked for
in vain, are counted; the counts fade over distance. A car that stands adds nothing. The regression
maps them, compressed by asinh because cues are correlated, to the log odds of each feature. The
belief is the mean of these and of the log odds of the hidden Markov model: the one knows the
distance and how cues follow each other, the other only how much was seen, and their errors differ
(Bates, Granger, *The Combination of Forecasts*, Operational Research Quarterly 20, 1969). No
direction is more probable than the intersection itself.
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.vehicle.fusion import Combined

from .factor_graph import FactorGraph
from .temporal import FLOOR, PRESENCE, MeasuredRange, TemporalFilter, TemporalModel


class RunningCounts:
    """Fading counts of the steps in which each cue was positive, and of those in which it was not.

    A picture counts by the distance since the last one, as one step at most, so the result does not
    depend on the frame rate.
    """

    def __init__(self, cues: Sequence[str], step_m: float, fade_m: float) -> None:
        """Start without counts."""
        self._rows = {cue: i for i, cue in enumerate(cues)}
        self._step_m, self._fade_m = step_m, fade_m
        self._counts = np.zeros((len(cues), 2))
        self._since_m = math.inf

    def update(self, counts: Mapping[str, int], moved_m: float, *, adds: bool = True) -> None:
        """Fade over the distance, and add the cues of a new picture."""
        self._counts *= math.exp(-abs(moved_m) / self._fade_m)
        self._since_m += abs(moved_m)
        if not adds:
            return
        worth, self._since_m = min(self._since_m / self._step_m, 1.0), 0.0
        for cue, count in counts.items():
            if cue in self._rows:
                self._counts[self._rows[cue], 0 if count > 0 else 1] += worth

    def statistics(self) -> NDArray[np.float64]:
        """Return the compressed counts, shape (2 cues,): positive and not, cue after cue."""
        return np.asarray(np.arcsinh(2.0 * self._counts).ravel())


class CombinedModel:
    """Fitted regression, as arrays."""

    def __init__(self, graph: FactorGraph, settings: Combined) -> None:
        """Arrange the weights in the graph's order of features and cues."""
        self.settings = settings
        self.cues = tuple(cue.name for cue in graph.cues)
        names = graph.feature_names
        self._present = names.index(PRESENCE)
        self._intercepts = np.array([settings.intercepts.get(name, 0.0) for name in names])
        sides = settings.positive, settings.negative
        self._weights = np.array(
            [
                [side.get(name, {}).get(cue, 0.0) for cue in self.cues for side in sides]
                for name in names
            ]
        )

    def counts(self) -> RunningCounts:
        """Return the counts of a new drive."""
        return RunningCounts(self.cues, self.settings.step_m, self.settings.fade_m)

    def mixed(
        self, temporal: NDArray[np.float64], statistics: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the combined probabilities, shape (..., features).

        Args:
            temporal: Probabilities of the hidden Markov model, shape (..., features).
            statistics: Compressed counts, shape (..., 2 cues).
        """
        regressed = statistics @ self._weights.T + self._intercepts
        odds = 0.5 * (np.log(temporal) - np.log1p(-temporal) + regressed)
        found = np.clip(1.0 / (1.0 + np.exp(-np.clip(odds, -40.0, 40.0))), FLOOR, 1.0 - FLOOR)
        return np.asarray(np.minimum(found, found[..., self._present, None]))


class CombinedFilter(TemporalFilter):
    """Filter of one drive."""

    def __init__(self, model: TemporalModel, combined: CombinedModel) -> None:
        """Start with the prior and without counts."""
        super().__init__(model)
        self._combined, self._counts = combined, combined.counts()

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
        self._counts.update(counts, moved_m, adds=is_new_picture and not is_standing)

    def probabilities(self) -> NDArray[np.float64]:
        """Probability of each feature, in the graph's order, within (0, 1)."""
        return self._combined.mixed(super().probabilities(), self._counts.statistics())
