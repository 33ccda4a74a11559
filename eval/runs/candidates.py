"""Counts of the candidates of cues and ranges by outcome, for the manifest and the summary."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Literal

from crosscue.detectors.cues.candidates import BELOW_SCORE, NO_CURVE, TOO_LITTLE_ROAD, Candidates

from .record import Record


class CandidateRow(Record):
    """Candidates of one cue or range: ``seen`` = ``used`` + all ``skipped``."""

    unit: Literal["detections", "frames"]
    """Unit of the counts: detections with the cue's labels, or frames with road in its region."""
    setting: str | None
    """Setting of the threshold in the vehicle file; None if it has none."""
    threshold: float | None
    """Score, or fraction of road, that a candidate must exceed."""
    seen: int
    used: int
    skipped: dict[str, int]
    """Number of skipped candidates by reason."""
    max_score: float | None
    """Highest score, or fraction of road, of all candidates."""


def candidate_rows(found: Mapping[str, Candidates]) -> dict[str, CandidateRow]:
    """Return candidates as rows of the manifest."""
    return {
        cue: CandidateRow(**asdict(one) | {"skipped": dict(sorted(one.skipped.items()))})
        for cue, one in found.items()
    }


def candidate_lines(
    cues: Mapping[str, CandidateRow], ranged: Mapping[str, CandidateRow]
) -> list[str]:
    """Return a sentence for each cue and range with skipped candidates; equal ones are merged.

    A road cue gets a sentence only if it was never positive, because a region without road is not a
    skipped candidate.
    """
    reported: dict[str, list[str]] = {}
    for cue, one in cues.items():
        if one.skipped and (one.unit == "detections" or not one.used):
            reported.setdefault(_text_of(one), []).append(cue)
    lines = [f"{', '.join(names)}: {text}" for text, names in reported.items()]
    return lines + [text for cue, one in ranged.items() for text in _range_text(cue, one)]


def not_looked_lines(cues: Mapping[str, str]) -> list[str]:
    """Return a sentence for each reason why cues were not evaluated."""
    same: dict[str, list[str]] = {}
    for cue, why in cues.items():
        same.setdefault(why, []).append(cue)
    return [f"not looked for, {why}: {', '.join(names)}" for why, names in same.items()]


def _text_of(one: CandidateRow) -> str:
    threshold = "" if one.threshold is None else f"{one.threshold:.2f}"
    low = one.skipped.get(BELOW_SCORE, 0) + one.skipped.get(TOO_LITTLE_ROAD, 0)
    if low == one.seen and one.max_score is not None:
        what, fit = "frames with road", ""
        if one.unit == "detections":
            what, fit = one.unit, "see crosscue fit detector, or "
        return (
            f"{one.seen:,} {what}, none above {threshold} (highest {one.max_score:.2f}); "
            f"{fit}lower {one.setting}"
        )
    reasons = ", ".join(
        f"{number:,} {why}" + (f" ({threshold})" if why == BELOW_SCORE else "")
        for why, number in one.skipped.items()
    )
    return f"{one.seen:,} {one.unit}, {one.used:,} used; {reasons}"


def _range_text(cue: str, one: CandidateRow) -> list[str]:
    """Return the sentences of a range; scores are reported with its cue."""
    skipped = {why: number for why, number in one.skipped.items() if why != BELOW_SCORE}
    things = f"{cue.replace('_', ' ')}s"
    lines = []
    unmeasured = skipped.pop(NO_CURVE, 0)
    if unmeasured:
        lines.append(
            f"range: {unmeasured:,} {things} measured, no curve: [ranges.{cue}] is not given; "
            "crosscue fit ranges, or for ranges from motion set camera.focal_px and leave out "
            "ranges.kind"
        )
    if skipped:
        reasons = ", ".join(f"{number:,} {why}" for why, number in skipped.items())
        lines.append(f"range: {one.used:,} {things} used; {reasons}")
    return lines
