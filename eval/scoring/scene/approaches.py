"""Approaches against truth: how far away an intersection is detected, and what was invented.

As in the source (its Fig. 29): an intersection is detected once p(intersection) exceeds 0.9 *and*
its range is available; the full intersection once every *present* feature exceeds 0.9. Where
neither sign nor light stands, nothing speaks of 'intersection' itself (its Fig. 27 as we read it),
yet the source detects such a one in full 6 times of 10: for the full intersection, presence that a
road or a car to the side has established counts as well. Distances are true ones, of the rear axle
to the start of the intersection. Beyond the source: detections must be confirmed (``detection``),
else they are spurious; absent features that exceeded 0.9, and approaches of the run where none
exists.

A run's approach belongs to the true one that it shares most time with, from its start until the car
enters; each belongs to one at most. A further one during the same true approach is a split, one
that meets no true approach is extra.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.truth.truth import Approach
from crosscue.eval.scoring.columns import NONE, BeliefRows, RunTables
from crosscue.eval.scoring.intervals import Mean, Proportion, fraction, mean
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, has_feature

from .detection import CONFIRM_FRAMES, RULES, Definition, Rule, held, is_range_right

THRESHOLD: Final = 0.9
UNLIKELY: Final = "never probable enough"
NOT_LOOKED_FOR: Final = "not looked for"
BRIEF: Final = f"for fewer than {CONFIRM_FRAMES} frames"
WRONG_RANGE: Final = "range outside its 95 % interval"
NEAR_M: Final = 8.0
"""The source's full detections all came at least this far away."""


@dataclass(frozen=True, slots=True)
class ApproachResult:
    """One true approach.

    Attributes:
        drive: Name.
        approach: Its id in the truth.
        intersection: Its name.
        control: As in the truth.
        conditions: Tags.
        present: Features that are there.
        run_approach: The run's number for it, or None where the run has none.
        overlap_s: Time shared with that one.
        splits: Further approaches of the run during it.
        steps: Of the belief, from start to entering.
        detected_m: True distance when it was detected; None if never, NaN if without true range.
        full_m: The same for the full intersection.
        why_not_detected: Empty when it was.
        why_not_full: Empty when it was.
        spurious_m: True distance of a detection as published that was not confirmed; None without.
        why_spurious: Empty without.
        features_m: True distance at which each present feature first exceeded the threshold.
        false_features: Absent features that exceeded it at any time before entering.
        at_entering: Last probabilities before entering.
    """

    drive: str
    approach: int
    intersection: str
    control: str
    conditions: tuple[str, ...]
    present: tuple[str, ...]
    run_approach: int | None
    overlap_s: float
    splits: int
    steps: int
    detected_m: float | None
    full_m: float | None
    why_not_detected: str
    why_not_full: str
    spurious_m: float | None
    why_spurious: str
    features_m: dict[str, float | None]
    false_features: tuple[str, ...]
    at_entering: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Probability against true distance over one approach; arrays of shape (N,)."""

    drive: str
    approach: int
    intersection: str
    t_ns: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    features: Mapping[str, NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class ApproachesJudged:
    """All approaches of one drive.

    Attributes:
        results: One for each true approach.
        curves: One for each that the run has.
        extra: Approaches of the run that meet no true one, within the truth's time.
        extra_detected: Those of them that said 'intersection' above the threshold.
        not_judged: Approaches of the run that are outside the truth's time.
        rows_not_numbers: Belief rows with a missing probability; left out.
    """

    results: tuple[ApproachResult, ...]
    curves: tuple[Curve, ...]
    extra: int
    extra_detected: int
    not_judged: int
    rows_not_numbers: int


@dataclass(frozen=True, slots=True)
class Group:
    """Approaches to one intersection, or under one condition."""

    approaches: int
    detected: int
    full: int
    detected_m: float
    full_m: float


@dataclass(frozen=True, slots=True)
class ApproachScore:
    """All approaches of all drives.

    Attributes:
        approaches: In the truth.
        matched: Of which the run knows.
        without_range: Of which no true distance is known; they have no part in means.
        detected: Fraction of approaches.
        full: Fraction of approaches.
        full_from_8_m: Fraction of approaches with full detection at least 8 m away.
        detected_m: Mean over those detected, its interval over approaches.
        full_m: The same for full detection.
        spurious: Approaches with a detection as published that was not confirmed.
        false_features: Fraction of approaches with at least one absent feature above the threshold.
        false_by_feature: How often each was.
        extra: Approaches of runs where none exists.
        extra_detected: Those that said 'intersection' above the threshold.
        splits: True approaches that the run broke in pieces.
        not_judged: Approaches of runs outside the truth's time.
        rows_not_numbers: Belief rows left out for a missing probability.
        failures: Reason to number of approaches, for detection and full detection.
        by_intersection: Means as in Fig. 29.
        by_condition: The same by tag.
        results: Every single one.
    """

    approaches: int
    matched: int
    without_range: int
    detected: Proportion
    full: Proportion
    full_from_8_m: Proportion
    detected_m: Mean
    full_m: Mean
    spurious: int
    false_features: Proportion
    false_by_feature: dict[str, int]
    extra: int
    extra_detected: int
    splits: int
    not_judged: int
    rows_not_numbers: int
    failures: dict[str, dict[str, int]]
    by_intersection: dict[str, Group]
    by_condition: dict[str, Group]
    results: tuple[ApproachResult, ...]


def judge_approaches(
    tables: RunTables,
    truth: DriveTruth,
    threshold: float = THRESHOLD,
    definition: Definition = "confirmed",
    not_looked_for: Collection[str] = (),
) -> ApproachesJudged | None:
    """Lay the run's approaches beside the true ones; None for a run or truth without any.

    Args:
        tables: The run's tables.
        truth: The drive's truth.
        threshold: Probability above which a feature is believed.
        definition: When a detection counts.
        not_looked_for: Features that no cue of the run could show. Where one of them is missing,
            the reason says so.
    """
    belief = tables.belief
    if belief is None or not truth.truth.approaches:
        return None
    finite = np.ones(len(belief.t_ns), np.bool_)
    for values in belief.features.values():
        finite &= np.isfinite(values)
    kept = BeliefRows(
        belief.t_ns[finite],
        belief.approach[finite],
        {name: values[finite] for name, values in belief.features.items()},
        belief.established[finite],
    )
    spans = run_spans(kept)
    pairs = associate(truth.truth.approaches, spans)
    results, curves = [], []
    for one in truth.truth.approaches:
        mine = _steps_of(kept, pairs.get(one.id), one)
        others = [n for n in spans if n not in pairs.values() and overlap_ns(one, spans[n]) > 0]
        number, rule = pairs.get(one.id), RULES[definition]
        result = _result(
            one, mine, number, len(others), tables, truth, threshold, rule, not_looked_for
        )
        results.append(result)
        if len(mine.t_ns):
            curves.append(_curve(one, mine, truth))
    extra, detected, outside = _extras(kept, spans, pairs, truth, threshold)
    return ApproachesJudged(
        tuple(results), tuple(curves), extra, detected, outside, int((~finite).sum())
    )


def run_spans(belief: BeliefRows) -> dict[int, tuple[int, int]]:
    """First and last time of each approach of a run."""
    return {
        number: (int(belief.t_ns[mine].min()), int(belief.t_ns[mine].max()))
        for number in np.unique(belief.approach[belief.approach != NONE]).tolist()
        for mine in [belief.approach == number]
    }


def overlap_ns(approach: Approach, span: tuple[int, int]) -> int:
    """Time shared, at least 1 where both have one moment in common; not positive for none."""
    return min(approach.enter_ns, span[1] + 1) - max(approach.start_ns, span[0])


def associate(
    approaches: Sequence[Approach], spans: Mapping[int, tuple[int, int]]
) -> dict[int, int]:
    """From a true approach's id to the run's number, largest shared time first."""
    ranked = sorted(
        (-overlap_ns(one, span), one.id, number)
        for one in approaches
        for number, span in spans.items()
        if overlap_ns(one, span) > 0
    )
    pairs: dict[int, int] = {}
    for _, one, number in ranked:
        if one not in pairs and number not in pairs.values():
            pairs[one] = number
    return pairs


def _steps_of(belief: BeliefRows, number: int | None, approach: Approach) -> BeliefRows:
    """Rows of the run's approach from the true one's start until the car enters, by time."""
    mine = belief.approach == number if number is not None else np.zeros(len(belief.t_ns), bool)
    mine = mine & (belief.t_ns >= approach.start_ns) & (belief.t_ns < approach.enter_ns)
    order = np.flatnonzero(mine)
    order = order[np.argsort(belief.t_ns[order], kind="stable")]
    features = {name: values[order] for name, values in belief.features.items()}
    return BeliefRows(
        belief.t_ns[order], belief.approach[order], features, belief.established[order]
    )


def _result(
    one: Approach,
    steps: BeliefRows,
    number: int | None,
    splits: int,
    tables: RunTables,
    truth: DriveTruth,
    threshold: float,
    rule: Rule,
    not_looked_for: Collection[str],
) -> ApproachResult:
    present = tuple(name for name in FEATURES if has_feature(one, name))
    absent = tuple(name for name in FEATURES if has_feature(one, name) is False)
    above = {name: values > threshold for name, values in steps.features.items()}
    never = np.zeros(len(steps.t_ns), np.bool_)
    likely = above.get("intersection", never)
    ranged = _has_range(tables, number, steps.t_ns)
    is_right = np.ones(len(steps.t_ns), np.bool_)
    if rule.checks_range:
        is_right = _is_range_right(tables, truth, number, steps.t_ns)
    published = likely & ranged
    detected = held(published & is_right, rule.frames)
    # Where a sign or light stands, it is what must be found; elsewhere nothing could speak of it.
    sure = likely | steps.established if one.control == "none" else likely
    known = above | {"intersection": sure}
    full = np.ones(len(steps.t_ns), np.bool_)
    for name in present:
        full &= known.get(name, never)
    was_full, full = full.any(), held(full, rule.frames)
    if rule.full_after_detection and detected.any():
        full &= np.maximum.accumulate(detected)
    distance = truth.start_m(steps.t_ns)
    is_spurious = bool(published.any()) and not detected[np.argmax(published)]
    missing = [name for name in present if not known.get(name, never).any()]
    return ApproachResult(
        drive=truth.drive,
        approach=one.id,
        intersection=one.intersection,
        control=one.control,
        conditions=one.conditions,
        present=present,
        run_approach=number,
        overlap_s=_overlap_s(steps),
        splits=splits,
        steps=len(steps.t_ns),
        detected_m=_first(detected, distance),
        full_m=_first(full, distance),
        why_not_detected=_why(
            number,
            detected,
            _spurious_reason(published, is_right) or _range_reason(likely, ranged, not_looked_for),
        ),
        why_not_full=_why(
            number,
            full,
            BRIEF if was_full and not missing else _full_reason(missing, steps, not_looked_for),
        ),
        spurious_m=_first(published, distance) if is_spurious else None,
        why_spurious=_spurious_reason(published, is_right) if is_spurious else "",
        features_m={name: _first(above.get(name, never), distance) for name in present},
        false_features=tuple(name for name in absent if above.get(name, never).any()),
        at_entering={
            name: float(values[-1]) for name, values in steps.features.items() if len(values)
        },
    )


def _is_range_right(
    tables: RunTables, truth: DriveTruth, number: int | None, t_ns: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """As ``is_range_right``; where the truth has no ranges, nothing can be wrong."""
    rows = tables.ranges
    if rows is None or number is None or truth.ranges is None:
        return np.ones(len(t_ns), np.bool_)
    true_m = truth.ranges.at(rows.t_ns, truth.approach_at(rows.t_ns))
    return is_range_right(rows, true_m, number, t_ns)


def _overlap_s(steps: BeliefRows) -> float:
    return float(steps.t_ns[-1] - steps.t_ns[0]) * 1e-9 if len(steps.t_ns) else 0.0


def _first(holds: NDArray[np.bool_], distance_m: NDArray[np.float64]) -> float | None:
    places = np.flatnonzero(holds)
    return float(distance_m[places[0]]) if len(places) else None


def _why(number: int | None, holds: NDArray[np.bool_], otherwise: str) -> str:
    if holds.any():
        return ""
    return "the run has no approach here" if number is None else otherwise


def _range_reason(
    likely: NDArray[np.bool_], ranged: NDArray[np.bool_], not_looked_for: Collection[str]
) -> str:
    if not likely.any():
        return NOT_LOOKED_FOR if "intersection" in not_looked_for else UNLIKELY
    return "no range" if not ranged.any() else "range only while not probable enough"


def _spurious_reason(published: NDArray[np.bool_], is_right: NDArray[np.bool_]) -> str:
    """Why the first detection as published is not confirmed; empty without any."""
    if not published.any():
        return ""
    return BRIEF if is_right[np.argmax(published)] else WRONG_RANGE


def _full_reason(missing: Sequence[str], steps: BeliefRows, not_looked_for: Collection[str]) -> str:
    """List the features that are missing: improbable, without evidence, or not looked for."""
    if not missing:
        return "never all at once"
    unsought = [name for name in missing if name in not_looked_for]
    others = [name for name in missing if name not in not_looked_for]
    unseen = [name for name in others if name in steps.features and _never_changes(steps, name)]
    unlikely = [name for name in others if name not in unseen]
    parts = ((UNLIKELY, unlikely), ("not seen", unseen), (NOT_LOOKED_FOR, unsought))
    return "; ".join(f"{what}: {', '.join(names)}" for what, names in parts if names)


def _never_changes(steps: BeliefRows, name: str) -> bool:
    values = steps.features[name]
    return len(values) > 0 and bool((values == values[0]).all())


def _has_range(tables: RunTables, number: int | None, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """From the first range of an approach on its filter always has one."""
    if tables.ranges is None or number is None:
        return np.zeros(len(t_ns), np.bool_)
    mine = (tables.ranges.approach == number) & np.isfinite(tables.ranges.range_m)
    if not mine.any():
        return np.zeros(len(t_ns), np.bool_)
    return np.asarray(t_ns >= tables.ranges.t_ns[mine].min())


def _curve(one: Approach, steps: BeliefRows, truth: DriveTruth) -> Curve:
    return Curve(
        truth.drive, one.id, one.intersection, steps.t_ns, truth.start_m(steps.t_ns), steps.features
    )


def _extras(
    belief: BeliefRows,
    spans: Mapping[int, tuple[int, int]],
    pairs: Mapping[int, int],
    truth: DriveTruth,
    threshold: float,
) -> tuple[int, int, int]:
    """Extra approaches, those of them that were detected, those outside the truth's time."""
    extra = detected = outside = 0
    for number, (first, last) in spans.items():
        meets = any(overlap_ns(one, (first, last)) > 0 for one in truth.truth.approaches)
        if number in pairs.values() or meets:
            continue
        if last < truth.truth.start_ns or first >= truth.truth.end_ns:
            outside += 1
            continue
        extra += 1
        values = belief.features.get("intersection", np.empty(0))
        detected += bool((values[belief.approach == number] > threshold).any())
    return extra, detected, outside


def score_approaches(judged: Sequence[ApproachesJudged]) -> ApproachScore | None:
    """All drives together; None where none was judged."""
    results = tuple(result for one in judged for result in one.results)
    if not results:
        return None
    return ApproachScore(
        approaches=len(results),
        matched=sum(one.run_approach is not None for one in results),
        without_range=sum(
            _is_unknown(one.detected_m) or _is_unknown(one.full_m) for one in results
        ),
        detected=_fraction([one.detected_m is not None for one in results]),
        full=_fraction([one.full_m is not None for one in results]),
        full_from_8_m=_fraction(
            [(one.full_m or 0.0) >= NEAR_M for one in results if not _is_unknown(one.full_m)]
        ),
        detected_m=_mean([one.detected_m for one in results]),
        full_m=_mean([one.full_m for one in results]),
        spurious=sum(one.spurious_m is not None for one in results),
        false_features=_fraction([bool(one.false_features) for one in results]),
        false_by_feature=_counts([name for one in results for name in one.false_features]),
        extra=sum(one.extra for one in judged),
        extra_detected=sum(one.extra_detected for one in judged),
        splits=sum(one.splits > 0 for one in results),
        not_judged=sum(one.not_judged for one in judged),
        rows_not_numbers=sum(one.rows_not_numbers for one in judged),
        failures={
            "detected": _counts([one.why_not_detected for one in results]),
            "full": _counts([one.why_not_full for one in results]),
        },
        by_intersection=_groups(
            {one.intersection for one in results},
            results,
            lambda name, one: one.intersection == name,
        ),
        by_condition=_groups(
            {tag for one in results for tag in one.conditions},
            results,
            lambda tag, one: tag in one.conditions,
        ),
        results=results,
    )


def _is_unknown(distance_m: float | None) -> bool:
    return distance_m is not None and math.isnan(distance_m)


def _fraction(values: Sequence[bool]) -> Proportion:
    # Approaches are the clusters, so Wilson's interval is the one that counts.
    return fraction(np.array(values, np.bool_), np.arange(len(values)))


def _mean(values: Sequence[float | None]) -> Mean:
    known = np.array([math.nan if value is None else value for value in values], np.float64)
    return mean(known, np.arange(len(known)))


def _counts(names: Sequence[str]) -> dict[str, int]:
    return {name: list(names).count(name) for name in sorted(set(names)) if name}


def _groups(
    names: set[str],
    results: Sequence[ApproachResult],
    belongs: Callable[[str, ApproachResult], bool],
) -> dict[str, Group]:
    groups: dict[str, Group] = {}
    for name in sorted(names):
        mine = [one for one in results if belongs(name, one)]
        groups[name] = Group(
            approaches=len(mine),
            detected=sum(one.detected_m is not None for one in mine),
            full=sum(one.full_m is not None for one in mine),
            detected_m=_mean([one.detected_m for one in mine]).value,
            full_m=_mean([one.full_m for one in mine]).value,
        )
    return groups
