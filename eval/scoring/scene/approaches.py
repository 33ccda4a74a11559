"""Scores of approaches: distances at which intersections are detected, and false detections.

As in the dissertation (Fig. 29), an intersection is detected when p(intersection) exceeds 0.9 *and*
its range is available, and the full intersection when every *present* feature exceeds 0.9. Without
a sign or a light, no cue supports 'intersection' itself (Fig. 27, as interpreted here), yet the
dissertation reports full detection of such an intersection in 6 of 10 runs. Therefore, for the full
intersection, presence established by a road or a car to the side also counts. Distances are true
ranges from the rear axle to the start of the intersection. In addition to the dissertation,
detections that are not confirmed (``detection``) are spurious; absent features that exceed 0.9 and
approaches where there is no intersection are counted.

An approach of the run is matched to the true approach with the longest common time, from its start
until the car enters, one to one. A further approach of the run during the same true approach is a
split; one without a true approach is extra.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.truth.truth import Approach
from crosscue.eval.scoring.columns import NONE, BeliefRows, RunTables
from crosscue.eval.scoring.intervals import Mean, Proportion, fraction, mean
from crosscue.eval.scoring.places import group_places
from crosscue.eval.scoring.truth import FEATURES, DriveTruth, has_feature
from crosscue.replay.columns import Floats, Int64s

from .detection import CONFIRM_FRAMES, RULES, Definition, Rule, held, is_range_right
from .trade import Reached, TradePoint, reached, trade_off

THRESHOLD: Final = 0.9
UNLIKELY: Final = "never probable enough"
NOT_LOOKED_FOR: Final = "not looked for"
BRIEF: Final = f"for fewer than {CONFIRM_FRAMES} frames"
WRONG_RANGE: Final = "range outside its 95 % interval"
# All full detections of the dissertation were at least this far away.
NEAR_M: Final = 8.0


@dataclass(frozen=True, slots=True)
class ApproachResult:
    """Result of one true approach.

    Attributes:
        drive: Name of the drive.
        approach: Id of the approach in the truth.
        intersection: Name of the intersection.
        control: Control of the intersection, as in the truth.
        conditions: Tags of conditions.
        present: Features that are present.
        run_approach: Number of the matched approach in the run; None without one.
        overlap_s: Time in common with that approach.
        splits: Number of further approaches of the run during it.
        steps: Number of steps of the belief, from start to entering.
        detected_m: True distance at detection; None if never, NaN if the true range is unknown.
        full_m: True distance at full detection; None if never, NaN if the true range is unknown.
        why_not_detected: Reason if it was not detected; else empty.
        why_not_full: Reason if it was not fully detected; else empty.
        spurious_m: True distance of a detection as published that was not confirmed; None without
            one.
        why_spurious: Reason why that detection was not confirmed; empty without one.
        features_m: True distance at which each present feature first exceeded the threshold.
        false_features: Absent features that exceeded the threshold at any time before entering.
        at_entering: Last probabilities before entering.
        place: Place of the intersection, as scores resample it.
        full_below: Threshold below which all present features are detected in several frames; -1
            for never.
        greatest: Greatest probability of each absent feature.
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
    place: str = ""
    full_below: float = -1.0
    greatest: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Probabilities and true distance over one approach; arrays of shape (N,)."""

    drive: str
    approach: int
    intersection: str
    t_ns: Int64s
    distance_m: Floats
    features: Mapping[str, Floats]


@dataclass(frozen=True, slots=True)
class ApproachesJudged:
    """All approaches of one drive.

    Attributes:
        results: Result of each true approach.
        curves: Curve of each matched approach.
        extra: Number of approaches of the run without a true one, within the truth's time.
        extra_detected: Number of those with p(intersection) above the threshold.
        not_judged: Number of approaches of the run outside the truth's time.
        rows_not_numbers: Number of belief rows left out because a probability is missing.
    """

    results: tuple[ApproachResult, ...]
    curves: tuple[Curve, ...]
    extra: int
    extra_detected: int
    not_judged: int
    rows_not_numbers: int


@dataclass(frozen=True, slots=True)
class ApproachGroup:
    """Scores of the approaches to one intersection, or under one condition."""

    approaches: int
    detected: int
    full: int
    detected_m: float
    full_m: float


@dataclass(frozen=True, slots=True)
class ApproachScore:
    """Scores of all approaches of all drives.

    Attributes:
        approaches: Number of approaches in the truth.
        matched: Number of those with a matched approach in the run.
        without_range: Number of those without a known true distance, which means leave out.
        detected: Fraction of approaches that were detected.
        full: Fraction of approaches that were fully detected.
        full_from_8_m: Fraction of approaches with full detection at least 8 m away.
        detected_m: Mean distance at detection, with its interval over places.
        full_m: Mean distance at full detection, with its interval over places.
        spurious: Number of approaches with a detection as published that was not confirmed.
        false_features: Fraction of approaches with an absent feature above the threshold.
        false_by_feature: Number of those approaches by feature.
        extra: Number of approaches of runs where there is no true approach.
        extra_detected: Number of those with p(intersection) above the threshold.
        splits: Number of true approaches that the run split.
        not_judged: Number of approaches of runs outside the truth's time.
        rows_not_numbers: Number of belief rows left out because a probability is missing.
        failures: Number of approaches by reason, for detection and full detection.
        trade: Full detection at rates of false features per approach, each at its own threshold
            (``trade``).
        by_intersection: Means by intersection, as in Fig. 29.
        by_condition: Means by condition tag.
        results: Results of all approaches.
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
    trade: tuple[TradePoint, ...]
    by_intersection: dict[str, ApproachGroup]
    by_condition: dict[str, ApproachGroup]
    results: tuple[ApproachResult, ...]


def judge_approaches(
    tables: RunTables,
    truth: DriveTruth,
    threshold: float = THRESHOLD,
    definition: Definition = "confirmed",
    not_looked_for: Collection[str] = (),
) -> ApproachesJudged | None:
    """Compare the run's approaches with the true ones; None if either has none.

    Args:
        tables: The run's tables.
        truth: The drive's truth.
        threshold: Probability above which a feature is believed.
        definition: When a detection counts.
        not_looked_for: Features that no cue of the run could show. Where one of them is missing,
            the reason states it.
    """
    belief = tables.belief
    if belief is None or not truth.truth.approaches:
        return None
    finite = np.ones(len(belief.t_ns), np.bool_)
    for values in belief.features.values():
        finite &= np.isfinite(values)
    kept = belief.take(finite)
    spans = run_spans(kept)
    pairs = associate(truth.truth.approaches, spans)
    criteria = _Criteria(threshold, RULES[definition], not_looked_for)
    results, curves = [], []
    for one in truth.truth.approaches:
        number = pairs.get(one.id)
        mine = _steps_of(kept, number, one)
        others = [n for n in spans if n not in pairs.values() and overlap_ns(one, spans[n]) > 0]
        results.append(_result(one, mine, number, len(others), tables, truth, criteria))
        if len(mine.t_ns):
            start_m = truth.start_m(mine.t_ns)
            curves.append(
                Curve(truth.drive, one.id, one.intersection, mine.t_ns, start_m, mine.features)
            )
    extra, detected, outside = _extras(kept, spans, pairs, truth, threshold)
    return ApproachesJudged(
        tuple(results), tuple(curves), extra, detected, outside, int((~finite).sum())
    )


def run_spans(belief: BeliefRows) -> dict[int, tuple[int, int]]:
    """Return the first and last time of each approach of a run."""
    return {
        number: (int(belief.t_ns[mine].min()), int(belief.t_ns[mine].max()))
        for number in np.unique(belief.approach[belief.approach != NONE]).tolist()
        for mine in [belief.approach == number]
    }


def overlap_ns(approach: Approach, span: tuple[int, int]) -> int:
    """Return the common time, at least 1 for a single common moment; not positive for none."""
    return min(approach.enter_ns, span[1] + 1) - max(approach.start_ns, span[0])


def associate(
    approaches: Sequence[Approach], spans: Mapping[int, tuple[int, int]]
) -> dict[int, int]:
    """Return the run's approach number by id of the true approach, longest common time first."""
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
    """Return the run's rows from the true approach's start until the car enters, by time."""
    mine = belief.approach == number if number is not None else np.zeros(len(belief.t_ns), bool)
    mine = mine & (belief.t_ns >= approach.start_ns) & (belief.t_ns < approach.enter_ns)
    order = np.flatnonzero(mine)
    return belief.take(order[np.argsort(belief.t_ns[order], kind="stable")])


class _Criteria(NamedTuple):
    """What counts as a detection, and what could not be one."""

    threshold: float
    rule: Rule
    not_looked_for: Collection[str]


def _result(
    one: Approach,
    steps: BeliefRows,
    number: int | None,
    splits: int,
    tables: RunTables,
    truth: DriveTruth,
    criteria: _Criteria,
) -> ApproachResult:
    threshold, rule, not_looked_for = criteria
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
    # Established presence counts only without a sign or a light, which must otherwise be found.
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
    is_sure = steps.established if one.control == "none" else never
    thresholds = reached(steps.features, present, absent, is_sure)
    return ApproachResult(
        drive=truth.drive,
        approach=one.id,
        intersection=one.intersection,
        control=one.control,
        conditions=one.conditions,
        present=present,
        run_approach=number,
        overlap_s=float(steps.t_ns[-1] - steps.t_ns[0]) * 1e-9 if len(steps.t_ns) else 0.0,
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
        place=truth.places.get(one.id, f"{truth.drive}, approach {one.id}"),
        full_below=-1.0 if thresholds.full is None else thresholds.full,
        greatest=thresholds.false,
    )


def _is_range_right(
    tables: RunTables, truth: DriveTruth, number: int | None, t_ns: Int64s
) -> NDArray[np.bool_]:
    """Return ``is_range_right``, or all True if the truth has no ranges."""
    rows = tables.ranges
    if rows is None or number is None or truth.ranges is None:
        return np.ones(len(t_ns), np.bool_)
    true_m = truth.ranges.at(rows.t_ns, truth.approach_at(rows.t_ns))
    return is_range_right(rows, true_m, number, t_ns)


def _first(holds: NDArray[np.bool_], distance_m: Floats) -> float | None:
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
    """Return why the first detection as published is not confirmed; empty without one."""
    if not published.any():
        return ""
    return BRIEF if is_right[np.argmax(published)] else WRONG_RANGE


def _full_reason(missing: Sequence[str], steps: BeliefRows, not_looked_for: Collection[str]) -> str:
    """Return the missing features: improbable, without evidence, or not searched."""
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


def _has_range(tables: RunTables, number: int | None, t_ns: Int64s) -> NDArray[np.bool_]:
    """Return True from the first range of an approach on, because its filter then keeps one."""
    if tables.ranges is None or number is None:
        return np.zeros(len(t_ns), np.bool_)
    mine = (tables.ranges.approach == number) & np.isfinite(tables.ranges.range_m)
    if not mine.any():
        return np.zeros(len(t_ns), np.bool_)
    return np.asarray(t_ns >= tables.ranges.t_ns[mine].min())


def _extras(
    belief: BeliefRows,
    spans: Mapping[int, tuple[int, int]],
    pairs: Mapping[int, int],
    truth: DriveTruth,
    threshold: float,
) -> tuple[int, int, int]:
    """Return numbers of extra approaches, of detected ones, and of those outside the truth."""
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
    """Return the scores of all drives together; None if no drive was judged."""
    results = tuple(result for one in judged for result in one.results)
    if not results:
        return None
    at = places_of_results(results)
    known = np.array([not _is_unknown(one.full_m) for one in results], np.bool_)
    near = np.array([(one.full_m or 0.0) >= NEAR_M for one in results], np.bool_)
    return ApproachScore(
        approaches=len(results),
        matched=sum(one.run_approach is not None for one in results),
        without_range=sum(
            _is_unknown(one.detected_m) or _is_unknown(one.full_m) for one in results
        ),
        detected=_fraction([one.detected_m is not None for one in results], at),
        full=_fraction([one.full_m is not None for one in results], at),
        full_from_8_m=fraction(near[known], at[known]),
        detected_m=_mean([one.detected_m for one in results], at),
        full_m=_mean([one.full_m for one in results], at),
        spurious=sum(one.spurious_m is not None for one in results),
        false_features=_fraction([bool(one.false_features) for one in results], at),
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
        trade=trade_off([Reached(one.full_below, one.greatest) for one in results], at),
        by_intersection=_groups(results, [(one.intersection,) for one in results]),
        by_condition=_groups(results, [one.conditions for one in results]),
        results=results,
    )


def _is_unknown(distance_m: float | None) -> bool:
    return distance_m is not None and math.isnan(distance_m)


def places_of_results(results: Sequence[ApproachResult]) -> Int64s:
    """Return the number of each result's place, shape (N,)."""
    return group_places([one.place or f"{one.drive}, approach {one.approach}" for one in results])


def _fraction(values: Sequence[bool], at: Int64s) -> Proportion:
    return fraction(np.array(values, np.bool_), at)


def _mean(values: Sequence[float | None], at: Int64s) -> Mean:
    return mean(np.array([math.nan if one is None else one for one in values], np.float64), at)


def _counts(names: Sequence[str]) -> dict[str, int]:
    return {name: list(names).count(name) for name in sorted(set(names)) if name}


def _groups(
    results: Sequence[ApproachResult], names: Sequence[tuple[str, ...]]
) -> dict[str, ApproachGroup]:
    """Return the groups by name; a result belongs to the groups that its names state."""
    groups: dict[str, ApproachGroup] = {}
    for name in sorted(set(chain.from_iterable(names))):
        mine = [one for one, own in zip(results, names, strict=True) if name in own]
        at = np.arange(len(mine))
        groups[name] = ApproachGroup(
            approaches=len(mine),
            detected=sum(one.detected_m is not None for one in mine),
            full=sum(one.full_m is not None for one in mine),
            detected_m=_mean([one.detected_m for one in mine], at).value,
            full_m=_mean([one.full_m for one in mine], at).value,
        )
    return groups
