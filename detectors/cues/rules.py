"""Runs the rules that the table of cues names."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from typing import Any, TypeAlias, cast

from crosscue.replay.vehicle.vehicle import CUES, CueSpec, Input

Rule: TypeAlias = Callable[[Any, Any, CueSpec], int | None]
"""From an input, the settings and the cue's row to a count; None where it cannot be evaluated."""


@lru_cache(maxsize=256)
def rule_of(name: str) -> Rule:
    """The function that ``module:function`` names."""
    module, _, function = name.partition(":")
    return cast("Rule", getattr(import_module(module), function))


def counts_of(observed_by: Input, observed: object, settings: object) -> dict[str, int]:
    """Counts of every cue that one input yields, in the table's order.

    Args:
        observed_by: Which input.
        observed: The input, as its rules take it.
        settings: The vehicle file; of a Mobileye only ``Past``.
    """
    found: dict[str, int] = {}
    for cue in CUES.values():
        if cue.observed_by == observed_by:
            number = rule_of(cue.rule)(observed, settings, cue)
            if number is not None:
                found[cue.name] = number
    return found
