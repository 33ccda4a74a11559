"""Ground truth of a picture: its cues with their visible fractions, and its objects as COCO."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

from crosscue.datasets.scenes.rendering.render import RenderedFrame
from crosscue.datasets.truth.coco import CocoRows
from crosscue.datasets.truth.truth import CueTruth
from crosscue.detectors.rle import encode_mask
from crosscue.replay.vehicle.cue_table import CUES

from .layout import Layout
from .world import CATEGORIES, SceneObject

# Min size of a recognizable object.
MIN_PIXELS: Final = 12
PAST_REACH_M: Final = 110.0
# Lateral distance from the road's centre line beyond which a car is in a leg.
LEG_ASIDE_M: Final = 12.0
LANES_REACH_M: Final = 45.0


class Presence(NamedTuple):
    """One cue in one picture: number of objects, and visible fraction of the best of them."""

    things: int
    visible: float


ABSENT: Final = Presence(0, 0.0)


Shows = Callable[[Layout, SceneObject, float], bool]
Simulated = Callable[[Layout, RenderedFrame], Presence]


def present(layout: Layout, picture: RenderedFrame) -> dict[str, Presence]:
    """Return the presence of every cue in a picture."""
    return {name: SIMULATED[name](layout, picture) for name in CUES if name in SIMULATED}


def _things(shows: Shows, max_m: float = math.inf) -> Simulated:
    """Return a rule that counts the objects of a cue that are large enough to be labelled."""

    def simulated(layout: Layout, picture: RenderedFrame) -> Presence:
        found = ABSENT
        for seen in picture.seen:
            if seen.distance_m > max_m or not shows(layout, seen.thing, picture.t_s):
                continue
            if seen.mask.sum() >= MIN_PIXELS:
                found = Presence(found.things + 1, max(found.visible, seen.visible))
        return found

    return simulated


def _sign(category: str) -> Simulated:
    return _things(lambda _, thing, __: thing.category == category)


def _goes_left(thing: SceneObject) -> bool:
    return thing.heading_rad > 0.0


def _crossing(*, left: bool) -> Simulated:
    def shows(_: Layout, thing: SceneObject, __: float) -> bool:
        moves = thing.velocity != (0.0, 0.0)
        return _is_car(thing, "cross") and moves and _goes_left(thing) == left

    return _things(shows)


def _in_leg(*, left: bool) -> Simulated:
    def shows(_: Layout, thing: SceneObject, t_s: float) -> bool:
        moves = thing.velocity != (0.0, 0.0)
        y_m = float(thing.at[1] + thing.shift(t_s)[1])
        return _is_car(thing, "cross") and moves and (y_m if left else -y_m) > LEG_ASIDE_M

    return _things(shows)


def _parked(*, left: bool) -> Simulated:
    return _things(
        lambda _, thing, __: _is_car(thing, "parked_cross") and _goes_left(thing) == left
    )


def _is_past(layout: Layout, thing: SceneObject, t_s: float) -> bool:
    x = thing.at[0] + thing.shift(t_s)[0]
    return _is_car(thing, "oncoming", "outgoing", "parked_past") and x > layout.end_m


def _cars_past(role: str) -> Simulated:
    return _things(
        lambda layout, thing, t_s: _is_past(layout, thing, t_s) and thing.role == role, PAST_REACH_M
    )


def _is_car(thing: SceneObject, *roles: str) -> bool:
    return thing.role in roles and thing.category == "car"


def _always(is_there: Callable[[Layout, RenderedFrame], bool]) -> Simulated:
    return lambda layout, picture: Presence(1, 1.0) if is_there(layout, picture) else ABSENT


def _runs_on(layout: Layout, picture: RenderedFrame) -> bool:
    return layout.has_ahead and picture.view.rear_axle[0] > layout.end_m - LANES_REACH_M


# Rules by cue; a cue of a plug-in without a rule is omitted from simulated truth.
SIMULATED: Final[dict[str, Simulated]] = {
    "stop_sign": _sign("stop_sign"),
    "traffic_light": _sign("traffic_light"),
    "road_left": _always(lambda layout, _: layout.has_left),
    "road_straight": _always(lambda layout, _: layout.has_ahead),
    "road_right": _always(lambda layout, _: layout.has_right),
    "cross_traffic_left": _crossing(left=True),
    "cross_traffic_right": _crossing(left=False),
    "parked_left": _parked(left=True),
    "parked_right": _parked(left=False),
    "leg_traffic_left": _in_leg(left=True),
    "leg_traffic_right": _in_leg(left=False),
    "oncoming_cars": _cars_past("oncoming"),
    "outgoing_cars": _cars_past("outgoing"),
    "lanes_past": _always(_runs_on),
    "vehicles_past": _things(_is_past, PAST_REACH_M),
    "one_way_left": _sign("one_way_left"),
    "one_way_right": _sign("one_way_right"),
    "do_not_enter": _sign("do_not_enter"),
    "map_left": _always(lambda layout, _: layout.has_left),
    "map_straight": _always(lambda layout, _: layout.has_ahead),
    "map_right": _always(lambda layout, _: layout.has_right),
}


class CueRuns:
    """Spans of time with equal presence of cues in consecutive pictures."""

    def __init__(self, period_ns: int, approach: int | None) -> None:
        """Begin an approach, or a road without one, with a picture every ``period_ns``."""
        self._period_ns = period_ns
        self._approach = approach
        self._open: dict[str, tuple[int, int, Presence]] = {}
        self._done: list[CueTruth] = []

    def add(self, t_ns: int, found: Mapping[str, Presence]) -> None:
        """Add the picture of a time; visibility is in tenths."""
        for cue, presence in found.items():
            rounded = Presence(presence.things, round(presence.visible, 1))
            run = self._open.get(cue)
            if run is not None and run[2] == rounded:
                self._open[cue] = (run[0], t_ns, rounded)
                continue
            self._close(cue)
            self._open[cue] = (t_ns, t_ns, rounded)

    def _close(self, cue: str) -> None:
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
        """Return all spans, sorted by start and cue."""
        for cue in list(self._open):
            self._close(cue)
        return tuple(sorted(self._done, key=lambda run: (run.start_ns or 0, run.cue)))


# Category numbers and names, which are those of COCO if COCO has the class.
COCO_IDS: Final = {
    "car": (3, "car"), "traffic_light": (10, "traffic light"), "stop_sign": (13, "stop sign"),
    "one_way_left": (101, "one way left"), "one_way_right": (102, "one way right"),
    "do_not_enter": (103, "do not enter"),
}  # fmt: skip


class DriveAnnotations(CocoRows):
    """Annotations of a drive, picture by picture."""

    def add(
        self, t_ns: int, picture: RenderedFrame, tags: tuple[str, ...], distance_m: float
    ) -> None:
        """Add all objects of a picture that have enough pixels."""
        high, wide = picture.owner.shape
        place = {"t_ns": t_ns, "tags": list(tags), "intersection_m": round(distance_m, 3)}
        self.add_image(f"{t_ns}.jpg", (wide, high), **place)
        for seen in picture.seen:
            area = int(seen.mask.sum())
            if area < MIN_PIXELS:
                continue
            counts = encode_mask(seen.mask, seen.box_px[:2], (wide, high)).decode("ascii")
            self.add_box(
                COCO_IDS[seen.thing.category][0],
                seen.box_px,
                area=area,
                segmentation={"size": [high, wide], "counts": counts},
                track_id=seen.thing.number,
                role=seen.thing.role,
                visible=round(seen.visible, 3),
                in_picture=round(seen.in_picture, 3),
                distance_m=round(seen.distance_m, 3),
            )

    def save(self, path: Path, source: str) -> None:
        """Write the file.

        Raises:
            OutputError: It cannot be written.
        """
        self.write(path, source, {COCO_IDS[c][1]: COCO_IDS[c][0] for c in CATEGORIES})
