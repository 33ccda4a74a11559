"""Causes of missed, late and invented features of an approach.

Causes are derived from the frames and not from the weather: the cues that could have shown a
feature, the numbers of frames in which their object was present and visible and in which they found
it, and whether another cue or the gate of eq. 18 held the belief back. The conditions of a drive
are reported with the cause, because the dissertation explains its failures by them.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.eval.scoring.scene.approaches import NEAR_M, ApproachResult
from crosscue.eval.scoring.scene.cues import SEEN, CueFrames
from crosscue.replay.vehicle.cue_table import CUES

Failing = Literal["missing", "late", "invented"]
Cause = Literal[
    "nothing shows it",
    "hidden",
    "not found",
    "denied",
    "waited for presence",
    "too little",
    "claimed wrongly",
]

# Max fraction of the frames showing an object in which it was found, to blame the detectors.
MOSTLY: Final = 0.5
# Conditions that explain no failure.
GOOD: Final = frozenset({"clear", "overcast"})


@dataclass(frozen=True, slots=True)
class CueEvidence:
    """Frame counts of one cue in an approach, at least ``NEAR_M`` before the intersection.

    Attributes:
        cue: Name of the cue.
        frames: Frames in which the cue was evaluated.
        there: Frames in which its object was present, where the truth knows.
        seen: Frames of ``there`` in which at least half of the object was visible.
        found: Frames in which the cue was positive.
        found_seen: Frames of ``seen`` in which the cue was positive.
        first_m: True range at its first positive; None without any.
    """

    cue: str
    frames: int
    there: int
    seen: int
    found: int
    found_seen: int
    first_m: float | None


@dataclass(frozen=True, slots=True)
class Finding:
    """One feature of an approach that was late, missing or invented.

    Attributes:
        drive: Name of the drive.
        approach: Id of the approach in the truth.
        intersection: Name of the intersection.
        conditions: Tags of the approach other than good weather.
        feature: Name of the feature.
        failing: Kind of failure.
        at_m: True range at which the feature was believed; None for never.
        cause: Cause by the rules of ``_cause``.
        reported: The cause in a short sentence with its numbers.
        cues: Counts of each cue that bears on the feature.
    """

    drive: str
    approach: int
    intersection: str
    conditions: tuple[str, ...]
    feature: str
    failing: Failing
    at_m: float | None
    cause: Cause
    reported: str
    cues: tuple[CueEvidence, ...]


def by_cause(found: Sequence[Finding]) -> dict[str, Counter[str]]:
    """Count drives by cause and intersection."""
    drives = {(one.cause, one.intersection, one.drive) for one in found}
    counts: dict[str, Counter[str]] = {}
    for cause, intersection, _ in sorted(drives):
        counts.setdefault(cause, Counter())[intersection] += 1
    return counts


def approach_findings(result: ApproachResult, cues: Sequence[CueFrames]) -> list[Finding]:
    """Return the findings of one approach, from the cues of its drive."""
    mine = {one.cue: _evidence(one, result.approach) for one in cues}
    found = []
    for feature, at_m in result.features_m.items():
        if at_m is None or at_m < NEAR_M:
            found.append(_absent(result, feature, at_m, mine))
    found += [_invented(result, feature, mine) for feature in result.false_features]
    return found


def _evidence(judged: CueFrames, approach: int) -> CueEvidence:
    far = (judged.approach == approach) & (judged.distance_m >= NEAR_M)
    is_there = far & (judged.is_object == 1)
    # An object without a visible fraction in the truth counts as visible.
    is_seen = is_there & ~(judged.visible < SEEN)
    is_found = far & (judged.count > 0)
    return CueEvidence(
        judged.cue,
        _count(far),
        _count(is_there),
        _count(is_seen),
        _count(is_found),
        _count(is_found & is_seen),
        float(judged.distance_m[is_found].max()) if is_found.any() else None,
    )


def _count(rows: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(rows))


def _relevant(
    feature: str, is_there: bool, cues: Mapping[str, CueEvidence]
) -> tuple[CueEvidence, ...]:
    return tuple(
        cues[name]
        for name, cue in CUES.items()
        if name in cues and cue.claim == (feature, is_there)
    )


def _absent(
    result: ApproachResult, feature: str, at_m: float | None, cues: Mapping[str, CueEvidence]
) -> Finding:
    for_it, against = _relevant(feature, True, cues), _relevant(feature, False, cues)
    cause, reported = _cause(result, feature, for_it, against)
    return Finding(
        drive=result.drive,
        approach=result.approach,
        intersection=result.intersection,
        conditions=_adverse(result),
        feature=feature,
        failing="missing" if at_m is None else "late",
        at_m=at_m,
        cause=cause,
        reported=reported,
        cues=(*for_it, *against),
    )


def _cause(
    result: ApproachResult,
    feature: str,
    for_it: Sequence[CueEvidence],
    against: Sequence[CueEvidence],
) -> tuple[Cause, str]:
    """Return the first cause that applies; each rule assumes that the earlier ones do not."""
    there, seen = sum(one.there for one in for_it), sum(one.seen for one in for_it)
    found, denied = sum(one.found for one in for_it), sum(one.found for one in against)
    if there == 0:
        return "nothing shows it", f"no object of its cues is present up to {NEAR_M:.0f} m"
    if seen == 0:
        return "hidden", f"more than half hidden in all {there} frames that have it"
    if denied > found:
        return "denied", f"{_names(against)} in {denied} frames against {found}"
    found_seen = sum(one.found_seen for one in for_it)
    if found_seen < MOSTLY * seen:
        return "not found", f"found in {found_seen} of {seen} frames: {_fractions(for_it)}"
    presence_m = result.features_m.get("intersection")
    if feature != "intersection" and (presence_m is None or presence_m < NEAR_M):
        when = "never" if presence_m is None else f"only at {presence_m:.0f} m"
        return "waited for presence", f"found in {found} frames; the intersection {when}"
    return "too little", f"found in {found} frames of {seen}: {_fractions(for_it)}"


def _invented(result: ApproachResult, feature: str, cues: Mapping[str, CueEvidence]) -> Finding:
    for_it = sorted(_relevant(feature, True, cues), key=lambda one: -one.found)
    loud = [one for one in for_it if one.found]
    reported = ", ".join(f"{_name(one.cue)} in {one.found} of {one.frames}" for one in loud)
    return Finding(
        drive=result.drive,
        approach=result.approach,
        intersection=result.intersection,
        conditions=_adverse(result),
        feature=feature,
        failing="invented",
        at_m=loud[0].first_m if loud else None,
        cause="claimed wrongly",
        reported=reported or "no cue of its own, only the remainder of others",
        cues=tuple(for_it),
    )


def _adverse(result: ApproachResult) -> tuple[str, ...]:
    return tuple(tag for tag in result.conditions if tag not in GOOD)


def _fractions(cues: Sequence[CueEvidence]) -> str:
    return ", ".join(f"{_name(one.cue)} {one.found_seen}/{one.seen}" for one in cues if one.seen)


def _names(cues: Sequence[CueEvidence]) -> str:
    return ", ".join(_name(one.cue) for one in cues if one.found)


def _name(cue: str) -> str:
    return cue.replace("_", " ")
