"""Evaluate the rules of the table of cues.

A rule returns a ``Count``: the number, and each candidate that is not in it with the reason. A rule
that returns only a number is accounted for by the labels and the threshold of its row.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from importlib import import_module
from typing import Any, TypeAlias, cast

from crosscue.replay.vehicle.vehicle import CUES, CueSpec, Input

from .candidates import Count, count_by_label

# Function of input, settings and the cue's row that returns its count with the reasons, or only the
# number; None if unknown.
Rule: TypeAlias = Callable[[Any, Any, CueSpec], Count | int | None]


@lru_cache(maxsize=256)
def rule_of(name: str) -> Rule:
    """Import the function that ``module:function`` names."""
    module, _, function = name.partition(":")
    return cast("Rule", getattr(import_module(module), function))


def counts_of(observed_by: Input, observed: object, settings: object) -> dict[str, Count]:
    """Compute the count of every cue of one kind of input, in the table's order.

    Args:
        observed_by: Kind of input.
        observed: The input, in the form that its rules take.
        settings: The vehicle file; for a Mobileye only ``Past``.
    """
    found: dict[str, Count] = {}
    for cue in CUES.values():
        if cue.observed_by == observed_by:
            count = rule_of(cue.rule)(observed, settings, cue)
            if isinstance(count, int):
                count = _plain(count, observed, settings, cue)
            if count is not None:
                found[cue.name] = count
    return found


def _plain(number: int, observed: Any, settings: Any, cue: CueSpec) -> Count:
    """Return a number without reasons, with those that the cue's labels show."""
    if cue.observed_by not in ("objects", "signs") or not settings.labels_of(cue):
        return Count(number, unit=None)
    setting, score = settings.threshold_of(cue)
    return count_by_label(observed, settings.labels_of(cue), number, setting, score)
