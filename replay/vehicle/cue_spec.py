"""One row of the table of cues, as crosscue's own and a plug-in's are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

Colour = tuple[int, int, int]
Scoring = Literal["object", "feature"]
Input = Literal["objects", "car pairs", "signs", "road", "mobileye"]

FEATURE_COLOURS: Final[dict[str, Colour]] = {
    "intersection": (160, 90, 220),
    "left": (50, 130, 230),
    "right": (230, 110, 30),
    "straight": (50, 165, 80),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class CueSpec:
    """One cue: what it observes, what it implies, and how reliable it was when published.

    Attributes:
        name: Value in ``cues.parquet``, ``truth.json`` and the vehicle file.
        group: Row of Table 5; cues of one group are reported and left out together.
        title: That row's heading in reports.
        observed_by: Input that yields it; without that input the cue is not evaluated.
        rule: ``module:function`` that counts it, called with the input, the settings, this row.
        precision: Published precision, the default message strength.
        precision_is_lower_bound: The source says "at least".
        supports: Features whose presence it implies.
        excludes: Features whose absence it implies.
        scored_as: The source's definition: is the object there, or does the feature exist?
        can_start: May send before an intersection is established.
        per_detection: One message per detection instead of one per frame.
        absence_counts: Near the intersection its absence is evidence against ``supports``.
        needs_masks: Boxes alone cannot show it.
        label: Detector label that it counts, if it is fixed.
        settings: Prefix of its labels and score under ``[cues]`` of the vehicle file, if any.
        colour: In recordings: red, green, blue.
        seen_frames: Where persistence counts, it must be positive in this many ...
        of_frames: ... of this many most recent frames in which it was searched for.
        within_m: Where persistence counts, it says nothing about an intersection further away: the
            source's runs begin 100 m before theirs, so no cue was validated beyond.
        fade_m: Way over which its errors resemble each other, if it is about a standing thing.
        fade_s: Time likewise, for what moves by itself; then it replaces ``fade_m``.
    """

    name: str
    group: str
    title: str
    observed_by: Input
    rule: str
    precision: float
    precision_is_lower_bound: bool = False
    supports: tuple[str, ...] = ()
    excludes: tuple[str, ...] = ()
    scored_as: Scoring = "object"
    can_start: bool = False
    per_detection: bool = False
    absence_counts: bool = False
    needs_masks: bool = False
    label: str | None = None
    settings: str | None = None
    colour: Colour = FEATURE_COLOURS["intersection"]
    seen_frames: int = 3
    of_frames: int = 5
    within_m: float = 100.0
    fade_m: float = 10.0
    fade_s: float | None = None

    @property
    def claim(self) -> tuple[str, bool]:
        """The feature it speaks about, and whether it says that the feature exists."""
        return (self.excludes[0], False) if self.excludes else (self.supports[0], True)
