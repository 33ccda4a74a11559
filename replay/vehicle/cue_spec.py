"""The type of a row in the table of cues, for built-in cues and plug-ins."""

from dataclasses import dataclass
from typing import Literal

from crosscue.replay.colours import FEATURES, Colour

Scoring = Literal["object", "feature"]
Input = Literal["objects", "car pairs", "signs", "road", "mobileye", "map"]


@dataclass(frozen=True, slots=True, kw_only=True)
class CueSpec:
    """One cue: its input, the features that it implies, and its published precision.

    Attributes:
        name: Name in ``cues.parquet``, ``truth.json`` and the vehicle file.
        group: Row of Table 5; cues of one group are reported and disabled together.
        title: Heading of that row in reports.
        observed_by: Input of the cue; without this input the cue is not evaluated.
        rule: ``module:function`` that counts the cue, called with the input, the settings and this
            row.
        precision: Published precision, the default message strength.
        precision_is_lower_bound: True if the source specifies "at least".
        supports: Features whose presence it implies.
        excludes: Features whose absence it implies.
        scored_as: The source's definition of a correct cue: the object is present, or the feature
            exists.
        can_start: True if it sends messages before an intersection is established.
        per_detection: True for one message per detection instead of one per frame.
        absence_counts: True if its absence near the intersection is evidence against ``supports``.
        needs_masks: True if it cannot be evaluated from boxes alone.
        label: Detector label that it counts, if the label is fixed.
        settings: Prefix of its labels and score under ``[cues]`` of the vehicle file, if any.
        colour: Colour in recordings: red, green, blue.
        seen_frames: For the persistent belief, the required number of positive frames among the
            last ``of_frames``.
        of_frames: For the persistent belief, the number of most recent frames considered.
        within_m: For the persistent belief, the maximum distance of the intersection. The source's
            runs begin 100 m before the intersections, so no cue was validated beyond that.
        at_most: For the persistent belief, the probability that this cue can give a feature as long
            as no other cue speaks for the intersection; None for no limit.
        fade_m: Distance over which its errors are correlated, for stationary objects.
        fade_s: Time over which its errors are correlated, for moving objects; replaces ``fade_m``.
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
    colour: Colour = FEATURES["intersection"]
    seen_frames: int = 3
    of_frames: int = 5
    within_m: float = 100.0
    at_most: float | None = None
    fade_m: float = 10.0
    fade_s: float | None = None

    @property
    def claim(self) -> tuple[str, bool]:
        """The implied feature, and True if the cue implies that it is present."""
        return (self.excludes[0], False) if self.excludes else (self.supports[0], True)
