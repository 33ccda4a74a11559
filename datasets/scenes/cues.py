"""Which cues are truly there in a picture, and how much of them can be seen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from crosscue.datasets.scenes.rendering.render import Picture
from crosscue.datasets.truth.truth import CUES, Cue, CueTruth

from .layout import Layout
from .world import Thing

LEAST_PIXELS: Final = 12
"""Of a smaller thing nobody can tell what it is."""
PAST_REACH_M: Final = 110.0
LANES_REACH_M: Final = 45.0


class Presence(NamedTuple):
    """One cue in one picture: how many things show it, and the most visible one's share."""

    things: int
    visible: float


ABSENT: Final = Presence(0, 0.0)


def present(layout: Layout, picture: Picture) -> dict[Cue, Presence]:
    """Every cue's presence in a picture."""
    found = dict.fromkeys(CUES, ABSENT)
    for seen in picture.seen:
        cue = cue_of(layout, seen.thing, picture.t_s)
        if cue is not None and seen.mask.sum() >= LEAST_PIXELS:
            if cue == "vehicles_past" and seen.distance_m > PAST_REACH_M:
                continue
            before = found[cue]
            found[cue] = Presence(before.things + 1, max(before.visible, seen.visible))
    x = picture.view.rear_axle[0]
    roads: dict[Cue, bool] = {
        "road_left": layout.has_left,
        "road_straight": layout.has_ahead,
        "road_right": layout.has_right,
        "lanes_past": layout.has_ahead and x > layout.end_m - LANES_REACH_M,
    }
    for cue, is_there in roads.items():
        found[cue] = Presence(1, 1.0) if is_there else ABSENT
    return found


def cue_of(layout: Layout, thing: Thing, t_s: float) -> Cue | None:
    """The cue that a thing is, if it can be seen."""
    signs: Mapping[str, Cue] = {
        "stop_sign": "stop_sign",
        "traffic_light": "traffic_light",
        "one_way_left": "one_way_left",
        "one_way_right": "one_way_right",
        "do_not_enter": "do_not_enter",
    }
    if thing.category in signs:
        return signs[thing.category]
    goes_left = thing.heading_rad > 0.0
    if thing.role == "cross":
        if thing.velocity == (0.0, 0.0):
            return None
        return "cross_traffic_left" if goes_left else "cross_traffic_right"
    if thing.role == "parked_cross":
        return "parked_left" if goes_left else "parked_right"
    if thing.role in ("oncoming", "outgoing", "parked_past"):
        x = thing.at[0] + thing.shift(t_s)[0]
        return "vehicles_past" if x > layout.end_m else None
    return None


class CueRuns:
    """Joins equal presences of consecutive pictures into spans of time."""

    def __init__(self, period_ns: int, approach: int) -> None:
        """Begin an approach whose pictures come every ``period_ns``."""
        self._period_ns = period_ns
        self._approach = approach
        self._open: dict[Cue, tuple[int, int, Presence]] = {}
        self._done: list[CueTruth] = []

    def add(self, t_ns: int, found: Mapping[Cue, Presence]) -> None:
        """Take in the picture of a time; visibility counts in tenths."""
        for cue, presence in found.items():
            rounded = Presence(presence.things, round(presence.visible, 1))
            run = self._open.get(cue)
            if run is not None and run[2] == rounded:
                self._open[cue] = (run[0], t_ns, rounded)
                continue
            self._close(cue)
            self._open[cue] = (t_ns, t_ns, rounded)

    def _close(self, cue: Cue) -> None:
        run = self._open.pop(cue, None)
        if run is not None:
            start, last, presence = run
            self._done.append(
                CueTruth(
                    start_ns=start,
                    end_ns=last + self._period_ns,
                    cue=cue,
                    present=presence.things > 0,
                    count=presence.things,
                    visible=presence.visible,
                    approach=self._approach,
                )
            )

    def finished(self) -> tuple[CueTruth, ...]:
        """All spans, by start and cue."""
        for cue in list(self._open):
            self._close(cue)
        return tuple(sorted(self._done, key=lambda run: (run.start_ns or 0, run.cue)))
