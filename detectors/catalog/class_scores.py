"""What a card knows of one class's scores: a threshold for cues, and what a score is worth.

Both are written by ``crosscue fit detector``:

[scores."traffic light"]
threshold = 0.62
calibration = {kind = "platt", slope = 1.4, offset = 0.3}
"""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from crosscue.detectors.settings import Proportion, Settings

ORDER: Final = 1e-6
"""So much of the network's score is kept by ``Isotonic``, so that no two scores become equal."""


class Platt(Settings):
    """The logit of the fraction right is ``slope * logit(score) + offset`` (Platt 1999)."""

    kind: Literal["platt"]
    slope: Annotated[float, Field(gt=0.0, le=100.0)]
    offset: Annotated[float, Field(ge=-100.0, le=100.0)]

    def probabilities(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """The fraction of detections with such a score that are right, shape (N,)."""
        kept = np.clip(scores, 1e-9, 1.0 - 1e-9)
        logit = self.slope * np.log(kept / (1.0 - kept)) + self.offset
        return np.asarray(1.0 / (1.0 + np.exp(-logit)), np.float64)


class Isotonic(Settings):
    """Straight lines between points, which rise; level before the first and after the last."""

    kind: Literal["isotonic"]
    scores: Annotated[tuple[Proportion, ...], Field(min_length=1, max_length=1000)]
    fractions: tuple[Proportion, ...]

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if len(self.fractions) != len(self.scores):
            raise ValueError(f"fractions: expected {len(self.scores)}, as many as scores")
        if (np.diff(self.scores) <= 0.0).any() or (np.diff(self.fractions) < 0.0).any():
            raise ValueError("scores and fractions: expected rising numbers")
        return self

    def probabilities(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """As ``Platt``."""
        found = np.interp(scores, self.scores, self.fractions)
        return np.asarray((1.0 - ORDER) * found + ORDER * scores, np.float64)


class ClassScores(Settings):
    """Of one class."""

    threshold: Proportion | None = None
    """A detection is a cue above this score, after calibration; the vehicle file may say more."""
    calibration: Annotated[Platt | Isotonic, Field(discriminator="kind")] | None = None
    """From the network's score to the fraction of such detections that are right."""
