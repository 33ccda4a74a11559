"""The vehicle file's section on the belief over time; its model is ``crosscue.fusion.temporal``."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from .section import NotNegative, Positive, Section

Probability = Annotated[float, Field(gt=0.0, lt=1.0)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]
ByDistance = Annotated[tuple[Probability, ...], Field(min_length=1)]


class CueChain(Section):
    """How a cue behaves where some features are there and others are not.

    Probabilities are listed by distance, nearest first, in the bins of ``Temporal.edges_m``; there
    is a single one where no intersection is ahead.
    """

    cue: Name
    there: tuple[Name, ...] = ()
    """Features that are present; if this and ``missing`` are empty, no intersection is ahead."""
    missing: tuple[Name, ...] = ()
    """Features that are absent."""
    first: ByDistance
    """Probability of a positive where it was not searched for in the step before."""
    stays: ByDistance
    """Probability of a positive after a positive step."""
    appears: ByDistance
    """Probability of a positive after a negative step."""

    @model_validator(mode="after")
    def _line_up(self) -> Self:
        if not len(self.first) == len(self.stays) == len(self.appears):
            raise PydanticCustomError(
                "temporal", "first, stays, appears: expected equal numbers of entries"
            )
        return self


class Temporal(Section):
    """What ``crosscue fit temporal`` has learned."""

    ahead: Probability
    """Probability that an intersection is within reach where a drive begins."""
    ways: dict[str, Probability]
    """From the ways that an intersection offers, joined by ``+`` (``none`` for a dead end), to how
    often it does: ``{ "left+right" = 0.2, ... }``; other combinations count as impossible."""
    edges_m: Annotated[tuple[float, ...], Field(min_length=2)]
    """Edges of the bins of distance, rising; the last is the visibility range."""
    chains: tuple[CueChain, ...]
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """Exponent of all cues' likelihoods, since cues are correlated even given the state."""
    lapse: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """Probability that a place is unlike all others; cues say nothing there, and the prior
    holds."""
    stray: Probability = 0.05
    """Probability that a sign's range has nothing to do with the intersection."""
    step_m: Positive = 1.5
    """A cue is evaluated again after this distance ..."""
    step_s: Positive = 0.5
    """... or this time."""
    spacing_m: Positive = 150.0
    """Mean distance between intersections."""
    cell_m: Positive = 2.0
    """Width of the cells of distance."""
    behind_m: NotNegative = 4.0
    """An intersection is passed once it is this far behind."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if any(a >= b for a, b in pairwise(self.edges_m)):
            raise PydanticCustomError("temporal", "edges_m: expected rising distances")
        bins = len(self.edges_m) - 1
        for one in self.chains:
            wanted = bins if one.there or one.missing else 1
            if len(one.first) != wanted:
                raise PydanticCustomError(
                    "temporal",
                    "{cue}: expected {wanted} entries, got {got}",
                    {"cue": one.cue, "wanted": wanted, "got": len(one.first)},
                )
        if not self.ways:
            raise PydanticCustomError("temporal", "ways: expected at least one")
        return self
