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

    Probabilities stand by distance, nearest first, as ``Temporal.edges_m`` divides it; a single
    one where no intersection is ahead.
    """

    cue: Name
    there: tuple[Name, ...] = ()
    """Features that are there; with none at all, here and below, no intersection is ahead."""
    missing: tuple[Name, ...] = ()
    """Features that are not."""
    first: ByDistance
    """Positive, where it was not looked for in the step before."""
    stays: ByDistance
    """Positive after a step in which it was."""
    appears: ByDistance
    """Positive after a step in which it was not."""

    @model_validator(mode="after")
    def _line_up(self) -> Self:
        if not len(self.first) == len(self.stays) == len(self.appears):
            raise PydanticCustomError(
                "temporal", "first, stays, appears: expected as many entries each"
            )
        return self


class Temporal(Section):
    """What ``crosscue fit temporal`` has learned."""

    ahead: Probability
    """An intersection lies within reach where a drive begins."""
    ways: dict[str, Probability]
    """From features that an intersection has besides being one, joined by ``+`` (``none`` for a
    dead end), to how often: ``{ "left+right" = 0.2, ... }``; the rest are taken for impossible."""
    edges_m: Annotated[tuple[float, ...], Field(min_length=2)]
    """Borders of the distances that cues depend on, rising; the last is how far one can see."""
    chains: tuple[CueChain, ...]
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """On all cues' likelihoods: given the state they still repeat one another."""
    lapse: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """A place is unlike all others so often; cues say nothing there, and what is usual stands."""
    stray: Probability = 0.05
    """A sign's range has nothing to do with the intersection so often."""
    step_m: Positive = 1.5
    """A cue is heard again after so far ..."""
    step_s: Positive = 0.5
    """... or so long."""
    spacing_m: Positive = 150.0
    """Intersections come into reach once in so far."""
    cell_m: Positive = 2.0
    """Width of the cells of distance."""
    behind_m: NotNegative = 4.0
    """An intersection is passed once it is so far behind."""

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
