"""The one table of cues: what each observes, implies, and how it is judged and drawn (Table 5).

Detectors, belief, truth, scores, reports and recordings iterate over ``CUES``. A new cue is a row
here and its ``rule``; the simulator also keeps a function for each.
"""

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
        precision_is_lower_bound: The source gives "at least".
        supports: Features whose presence it implies.
        excludes: Features whose absence it implies.
        scored_as: The source's definition: is the object there, or does the feature exist?
        can_start: May send before an intersection is established.
        per_detection: One message per detection instead of one per frame.
        absence_counts: Near the intersection its absence is evidence against ``supports``.
        label: Detector label that it counts, if it is fixed.
        settings: Prefix of its labels and score under ``[cues]`` of the vehicle file, if any.
        colour: In recordings: red, green, blue.
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
    label: str | None = None
    settings: str | None = None
    colour: Colour = FEATURE_COLOURS["intersection"]

    @property
    def claim(self) -> tuple[str, bool]:
        """The feature it speaks about, and whether it says that the feature exists."""
        return (self.excludes[0], False) if self.excludes else (self.supports[0], True)


def _control(name: str, precision: float) -> CueSpec:
    return CueSpec(
        name=name,
        group=name,
        title=name.replace("_", " "),
        observed_by="objects",
        rule="crosscue.detectors.cues.labelled:count",
        precision=precision,
        supports=("intersection",),
        can_start=True,
        settings=name,
    )


def _road(side: str, *, can_start: bool) -> CueSpec:
    return CueSpec(
        name=f"road_{side}",
        group="road",
        title="road",
        observed_by="road",
        rule="crosscue.detectors.cues.road:is_road",
        precision=0.77,
        supports=(side,),
        can_start=can_start,
        absence_counts=True,
        colour=FEATURE_COLOURS[side],
    )


def _cars(group: str, title: str, rule: str, precision: float, side: str) -> CueSpec:
    return CueSpec(
        name=f"{group}_{side}",
        group=group,
        title=title,
        observed_by="car pairs",
        rule=f"crosscue.detectors.cues.{rule}",
        precision=precision,
        supports=(side,),
        per_detection=True,
        absence_counts=True,
        colour=FEATURE_COLOURS[side],
    )


def _past(name: str, title: str, *, per_detection: bool) -> CueSpec:
    return CueSpec(
        name=name,
        group=name,
        title=title,
        observed_by="mobileye",
        rule=f"crosscue.detectors.cues.far_side:count_{name}",
        precision=0.96,
        supports=("straight",),
        scored_as="feature",
        per_detection=per_detection,
        absence_counts=True,
        colour=FEATURE_COLOURS["straight"],
    )


def _one_way(side: str, other: str) -> CueSpec:
    return CueSpec(
        name=f"one_way_{side}",
        group="one_way",
        title="one-way sign",
        observed_by="signs",
        rule="crosscue.detectors.cues.labelled:count",
        precision=0.95,
        precision_is_lower_bound=True,
        supports=(side,),
        excludes=(other,),
        label=f"one way {side}",
        colour=FEATURE_COLOURS[side],
    )


STOP_SIGN: Final = _control("stop_sign", 0.97)
TRAFFIC_LIGHT: Final = _control("traffic_light", 0.95)
DO_NOT_ENTER: Final = CueSpec(
    name="do_not_enter",
    group="do_not_enter",
    title="do-not-enter sign",
    observed_by="signs",
    rule="crosscue.detectors.cues.labelled:count",
    precision=0.95,
    precision_is_lower_bound=True,
    excludes=("straight",),
    label="do not enter",
)

CUES: Final[dict[str, CueSpec]] = {
    spec.name: spec
    for spec in (
        STOP_SIGN,
        TRAFFIC_LIGHT,
        _road("left", can_start=True),
        _road("straight", can_start=False),
        _road("right", can_start=True),
        _cars("cross_traffic", "cross traffic", "cars:count_crossing", 0.86, "left"),
        _cars("cross_traffic", "cross traffic", "cars:count_crossing", 0.86, "right"),
        _cars("parked", "parked cars", "cars:count_parked", 0.83, "left"),
        _cars("parked", "parked cars", "cars:count_parked", 0.83, "right"),
        _past("lanes_past", "lane lines past", per_detection=False),
        _past("vehicles_past", "vehicles past", per_detection=True),
        _one_way("left", "right"),
        _one_way("right", "left"),
        DO_NOT_ENTER,
    )
}
"""By name, in the order of tables and reports; signs by the precision to which they are tuned."""


def groups() -> dict[str, tuple[CueSpec, ...]]:
    """The rows of Table 5, each with the cues that it stands for."""
    found: dict[str, tuple[CueSpec, ...]] = {}
    for spec in CUES.values():
        found[spec.group] = (*found.get(spec.group, ()), spec)
    return found
