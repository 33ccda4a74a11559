"""The table of cues: input, implied features, scoring and colour of each cue (Table 5).

Detectors, belief, truth, scores, reports and recordings iterate over ``CUES``. A new cue takes one
row in this table and a function for its ``rule``. The simulator also has a function for each cue.
"""

from dataclasses import replace
from typing import Final

from crosscue.replay.colours import FEATURES
from crosscue.replay.plugins import loaded

from .cue_spec import CueSpec

# Proportion of lights that are at an intersection; the others are at pedestrian crossings, railways
# and exits. Of the annotated approaches with lights in benchmarks/real_roads.json, 42 of 44.
AT_INTERSECTIONS: Final = 0.95


def _control(name: str, precision: float, at_most: float | None = None) -> CueSpec:
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
        at_most=at_most,
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
        colour=FEATURES[side],
    )


# Frames, of five, in which a sign must be found: sign search is tuned for precision at a low recall
# (eq. 17).
SIGN_FRAMES: Final = 2
# Typical time for which a crossing car is visible; a later detection is another car.
MOVES_FADE_S: Final = 2.0


def _cars(
    group: str, title: str, rule: str, precision: float, side: str, fade_s: float | None = None
) -> CueSpec:
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
        needs_masks=group == "parked",
        colour=FEATURES[side],
        fade_s=fade_s,
    )


def _crossing(side: str) -> CueSpec:
    return _cars("cross_traffic", "cross traffic", "cars:count_crossing", 0.86, side, MOVES_FADE_S)


def _leg_traffic(side: str) -> CueSpec:
    row = _cars("leg_traffic", "traffic in a leg", "cars:count_in_leg", 0.86, side, MOVES_FADE_S)
    return replace(row, absence_counts=False)


# Precision on eight simulated drives with perfect boxes (``benchmarks/tracked_cars.py``). It is the
# lower end of the 95 % interval for 184 correct of 189 cars, measured when the rule was introduced.
# Now 189 of 190 cars are correct. The lower end would be 0.97, but frames of one car are
# correlated.
PAST_PRECISION: Final = 0.94


def _cars_past(way: str) -> CueSpec:
    return CueSpec(
        name=f"{way}_cars",
        group="cars_past",
        title="oncoming and outgoing cars",
        observed_by="car pairs",
        rule=f"crosscue.detectors.cues.cars:count_{way}",
        precision=PAST_PRECISION,
        precision_is_lower_bound=True,
        supports=("straight",),
        per_detection=True,
        colour=FEATURES["straight"],
        fade_s=MOVES_FADE_S,
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
        colour=FEATURES["straight"],
        fade_s=MOVES_FADE_S if per_detection else None,
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
        colour=FEATURES[side],
        seen_frames=SIGN_FRAMES,
    )


# Assumed, as nobody has counted: maps are out of date, and a position may be on the wrong road.
MAP_PRECISION: Final = 0.9


def _map(side: str, *, can_start: bool) -> CueSpec:
    return CueSpec(
        name=f"map_{side}",
        group="map",
        title="map",
        observed_by="map",
        rule="crosscue.detectors.cues.road:is_on_map",
        precision=MAP_PRECISION,
        supports=(side,),
        scored_as="feature",
        can_start=can_start,
        colour=FEATURES[side],
        # An error of the map is the same over the whole approach.
        fade_m=100.0,
    )


STOP_SIGN: Final = _control("stop_sign", 0.97)
TRAFFIC_LIGHT: Final = _control("traffic_light", 0.95, AT_INTERSECTIONS)
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
    seen_frames=SIGN_FRAMES,
)

# Labels of the American and the international sign, which are equivalent.
SAME_SIGN: Final = {"do not enter": ("do not enter", "no entry")}

# Built-in cues by name, in the order of tables; the precision of signs is their tuning target.
BUILTIN_CUES: Final[dict[str, CueSpec]] = {
    spec.name: spec
    for spec in (
        STOP_SIGN,
        TRAFFIC_LIGHT,
        _road("left", can_start=True),
        _road("straight", can_start=False),
        _road("right", can_start=True),
        _crossing("left"),
        _crossing("right"),
        _cars("parked", "parked cars", "cars:count_parked", 0.83, "left"),
        _cars("parked", "parked cars", "cars:count_parked", 0.83, "right"),
        _leg_traffic("left"),
        _leg_traffic("right"),
        _cars_past("oncoming"),
        _cars_past("outgoing"),
        _past("lanes_past", "lane lines past", per_detection=False),
        _past("vehicles_past", "vehicles past", per_detection=True),
        _one_way("left", "right"),
        _one_way("right", "left"),
        DO_NOT_ENTER,
        _map("left", can_start=True),
        _map("straight", can_start=False),
        _map("right", can_start=True),
    )
}

# Every cue by name, in the order of tables and reports: built-in cues, then those of plug-ins.
CUES: Final[dict[str, CueSpec]] = BUILTIN_CUES | dict(loaded("cue", CueSpec, BUILTIN_CUES))


def groups() -> dict[str, tuple[CueSpec, ...]]:
    """Return the rows of Table 5 with the cues that each row covers."""
    found: dict[str, tuple[CueSpec, ...]] = {}
    for spec in CUES.values():
        found[spec.group] = (*found.get(spec.group, ()), spec)
    return found
