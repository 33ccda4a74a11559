"""A model card's settings for the scores of one class: threshold and calibration.

Both are written by ``crosscue fit detector``:

[scores."traffic light"]
threshold = 0.62
calibration = {kind = "platt", slope = 1.4, offset = 0.3}
"""

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from crosscue.detectors.settings import Proportion, Settings

Weight = Annotated[float, Field(ge=-100.0, le=100.0)]


class Platt(Settings):
    """Platt scaling (1999): the correct fraction's logit is ``slope * logit(score) + offset``."""

    kind: Literal["platt"]
    slope: Annotated[float, Field(gt=0.0, le=100.0)]
    offset: Weight

    def probabilities(self, scores: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the fraction of detections with each score that are correct, shape (N,)."""
        kept = np.clip(scores, 1e-9, 1.0 - 1e-9)
        logit = self.slope * np.log(kept / (1.0 - kept)) + self.offset
        return np.asarray(1.0 / (1.0 + np.exp(-logit)), np.float64)


class ClassScores(Settings):
    """Threshold and calibration of one class."""

    threshold: Proportion | None = None
    """Calibrated score above which a detection is a cue; the vehicle file can override it."""
    calibration: Platt | None = None
    """Maps the network's score to the fraction of such detections that are correct."""
    log_ratio: tuple[Weight, Weight, Weight, Weight] | None = None
    """Log likelihood ratio of one box, for decisions over frames: factors of its score's log odds
    less those of the threshold, of the logarithms of its longer side over the shorter one and over
    the picture's, and a constant. By default only the score counts."""
