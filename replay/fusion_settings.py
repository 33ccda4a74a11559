"""The vehicle file's sections on intersection range and belief; rules in ``crosscue.fusion``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from .settings_section import NotNegative, Positive, Section

Probability = Annotated[float, Field(gt=0.0, lt=1.0)]


class RangeFilter(Section):
    """The 1-D filter of the distance to an intersection (eq. 8 to 12)."""

    gate_nis: Positive | None = 16.0
    """Measurements whose normalised innovation squared is larger are refused and counted."""
    most_m: Positive = 150.0
    """A sign measured further away than this is refused and counted."""


class Fusion(Section):
    """Belief over the features of an intersection (eq. 18)."""

    kind: Literal["source", "calibrated"] = "source"
    """``source`` multiplies every message in; ``calibrated`` takes learned ratios, discounted."""
    established: Probability = 0.9
    """Presence is established once a gate feature is more probable than this."""
    dissent: Probability = 0.49
    """What a direct cue of a direction sends near the intersection when it is not detected."""
    dissent_within_m: NotNegative = 20.0
    closes_behind_m: NotNegative = 2.0
    """An approach ends once the intersection is so far behind the rear axle."""
    stale_after_m: Positive = 60.0
    """Or once the car has gone this far without any evidence."""
