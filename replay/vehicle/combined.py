"""The vehicle file's section on the combined belief, for ``crosscue.fusion.combined``."""

from __future__ import annotations

from .section import Positive, Section
from .temporal import Name


class Combined(Section):
    """Logistic regression learned by ``crosscue fit temporal --combined``."""

    intercepts: dict[Name, float]
    """Log odds of each feature without evidence."""
    weights: dict[Name, dict[Name, float]]
    """Weight in each feature's log odds of the evidence for each feature."""
    fade_m: Positive = 50.0
    """Distance over which evidence fades."""
