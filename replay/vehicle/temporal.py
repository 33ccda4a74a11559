"""The vehicle file's section on the belief over time, for ``crosscue.fusion.temporal``."""

from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from .section import Name, NotNegative, Positive, Probability, Section

ByDistance = Annotated[tuple[Probability, ...], Field(min_length=1)]


class CueChain(Section):
    """Transition probabilities of a cue, given the presence and absence of features.

    Probabilities are listed by distance, nearest first, in the bins of ``Temporal.edges_m``. Where
    no intersection is ahead, each list has a single entry.
    """

    cue: Name
    there: tuple[Name, ...] = ()
    """Features that are present; if this and ``missing`` are empty, no intersection is ahead."""
    missing: tuple[Name, ...] = ()
    """Features that are absent."""
    first: ByDistance
    """Probability of a positive if the cue was not evaluated in the previous step."""
    stays: ByDistance
    """Probability of a positive after a positive."""
    appears: ByDistance
    """Probability of a positive after a negative."""

    @model_validator(mode="after")
    def _line_up(self) -> Self:
        if not len(self.first) == len(self.stays) == len(self.appears):
            raise PydanticCustomError(
                "temporal", "first, stays, appears: expected equal numbers of entries"
            )
        return self


class Temporal(Section):
    """Parameters learned by ``crosscue fit temporal``."""

    ahead: Probability
    """Probability that an intersection is within the visibility range where a drive begins."""
    ways: dict[str, Probability]
    """Prior probabilities of the combinations of roads at an intersection, joined by ``+``
    (``none`` for a dead end): ``{ "left+right" = 0.2, ... }``. Other combinations have probability
    zero."""
    edges_m: Annotated[tuple[float, ...], Field(min_length=2)]
    """Edges of the distance bins, ascending; the last one is the visibility range."""
    chains: tuple[CueChain, ...]
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0
    """Exponent of all cues' likelihoods, since cues are correlated even given the state."""
    lapse: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.0
    """Probability of an atypical place, where cues are uninformative and the prior applies."""
    stray: Probability = 0.05
    """Probability that a sign's range is unrelated to the intersection."""
    step_m: Positive = 1.5
    """Distance after which a cue is evaluated again; standing adds no evidence."""
    step_s: Positive = 0.5
    """Time after which cues of moving objects are searched for an appearance in between."""
    spacing_m: Positive = 150.0
    """Mean distance between intersections."""
    cell_m: Positive = 2.0
    """Width of the cells of the distance grid."""
    behind_m: NotNegative = 4.0
    """Distance behind the vehicle at which an intersection is passed."""

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if any(a >= b for a, b in pairwise(self.edges_m)):
            raise PydanticCustomError("temporal", "edges_m: expected ascending distances")
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


class Combined(Section):
    """Logistic regression over running counts of cues, learned by ``crosscue fit temporal``."""

    intercepts: dict[Name, float]
    """Log odds of each feature without counts."""
    positive: dict[Name, dict[Name, float]]
    """Weight of each cue's positive steps in the log odds of each feature."""
    negative: dict[Name, dict[Name, float]]
    """Weight of the steps in which the cue was looked for in vain."""
    fade_m: Positive = 50.0
    """Distance over which counts fade."""
    step_m: Positive = 5.0
    """Distance that counts as one step."""
