"""Effect of bad conditions, compared with good conditions at the same intersections."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from crosscue.eval.failures.causes import GOOD
from crosscue.eval.scoring.intervals import Mean, mean
from crosscue.eval.scoring.scene.approaches import ApproachResult, places_of_results


@dataclass(frozen=True, slots=True)
class ConditionCost:
    """Effect of a condition, compared with good conditions at the same intersections.

    Attributes:
        condition: Tag of the condition.
        approaches: Number of approaches with it, at intersections with approaches in good
            conditions.
        detected_m: Difference in the distance at detection; negative is later.
        full_m: Difference in the distance at full detection; negative is later.
        undetected: Number of those approaches that were never detected, unlike good ones.
        not_full: Number of those approaches that were never fully detected, unlike good ones.
    """

    condition: str
    approaches: int
    detected_m: Mean
    full_m: Mean
    undetected: int
    not_full: int


def condition_costs(results: Sequence[ApproachResult]) -> tuple[ConditionCost, ...]:
    """Compare every bad condition with good conditions at the same intersection.

    Conditions that always apply at an intersection (its vegetation) have no comparison and are
    ignored.
    """
    always = _always(results)
    tags = sorted({tag for one in results for tag in one.conditions} - GOOD)
    return tuple(
        _cost(tag, results, always)
        for tag in tags
        if any(tag in _changing(one, always) for one in results)
    )


def _always(results: Sequence[ApproachResult]) -> dict[str, frozenset[str]]:
    shared: dict[str, frozenset[str]] = {}
    for one in results:
        tags = frozenset(one.conditions)
        shared[one.intersection] = shared.get(one.intersection, tags) & tags
    return shared


def _changing(one: ApproachResult, always: Mapping[str, frozenset[str]]) -> set[str]:
    return set(one.conditions) - GOOD - always[one.intersection]


def _cost(
    tag: str, results: Sequence[ApproachResult], always: Mapping[str, frozenset[str]]
) -> ConditionCost:
    good: dict[str, list[ApproachResult]] = {}
    for one in results:
        if not _changing(one, always):
            good.setdefault(one.intersection, []).append(one)
    bad = [one for one in results if tag in _changing(one, always) and one.intersection in good]
    pairs = [(one, good[one.intersection]) for one in bad]
    detected = [_less(one.detected_m, [g.detected_m for g in some]) for one, some in pairs]
    full = [_less(one.full_m, [g.full_m for g in some]) for one, some in pairs]
    at = places_of_results(bad)
    return ConditionCost(
        tag,
        len(bad),
        mean(np.array(detected), at),
        mean(np.array(full), at),
        sum(
            one.detected_m is None and any(g.detected_m is not None for g in some)
            for one, some in pairs
        ),
        sum(one.full_m is None and any(g.full_m is not None for g in some) for one, some in pairs),
    )


def _less(value: float | None, others: Sequence[float | None]) -> float:
    known = [one for one in others if one is not None]
    return math.nan if value is None or not known else value - sum(known) / len(known)
