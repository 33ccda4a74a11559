"""Evaluate the rules of the table of cues."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from typing import Any, TypeAlias, cast

from crosscue.replay.vehicle.vehicle import CUES, CueSpec, Input

# Function of input, settings and the cue's row that returns a count; None if unknown.
Rule: TypeAlias = Callable[[Any, Any, CueSpec], int | None]


@lru_cache(maxsize=256)
def rule_of(name: str) -> Rule:
    """Import the function that ``module:function`` names."""
    module, _, function = name.partition(":")
    return cast("Rule", getattr(import_module(module), function))


def counts_of(observed_by: Input, observed: object, settings: object) -> dict[str, int]:
    """Compute the count of every cue of one kind of input, in the table's order.

    Args:
        observed_by: Kind of input.
        observed: The input, in the form that its rules take.
        settings: The vehicle file; for a Mobileye only ``Past``.
    """
    found: dict[str, int] = {}
    for cue in CUES.values():
        if cue.observed_by == observed_by:
            number = rule_of(cue.rule)(observed, settings, cue)
            if number is not None:
                found[cue.name] = number
    return found
