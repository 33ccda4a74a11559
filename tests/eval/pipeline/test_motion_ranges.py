"""Ranges from motion: which light or sign yields the range, and frames without a range."""

from collections.abc import Sequence

import numpy as np
import pytest

from crosscue.detectors.base import Detections
from crosscue.detectors.ranging.control_tracks import ControlTracks
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.detectors.ranging.usable import CUT
from crosscue.eval.pipeline.scene.motion_ranges import UNCONFIRMED, MotionRanges
from crosscue.eval.pipeline.scene.sign_ranges import SignRanges
from crosscue.fusion.evidence import RangePosterior
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import Ranges, Vehicle, parse

SIZE = (1920, 1080)
AHEAD = CarStep(1.0, 0.0, 0.0, 0.1)
CAMERA = "[camera]\nfocal_px = 1500.0\nx_m = 1.5\n"
SETBACK_M = Ranges().light_setback_m
# Label, range from the camera at the start, metres to the right, height.
Thing = tuple[str, float, float, float]
NEAR: Thing = ("traffic light", 57.0, -5.0, 1.3)
FAR: Thing = ("traffic light", 84.0, 2.0, 1.3)


def vehicle(text: str = CAMERA) -> Vehicle:
    return parse('version = 1\ncues.kind = "frames"\n' + text, "v.toml")


class Drive:
    """Tracks and ranges of one drive."""

    def __init__(self, car: Vehicle) -> None:
        self.tracks = ControlTracks(car)
        self.ranges = MotionRanges(car)

    def __call__(
        self, seen: Detections, motion: CarStep = AHEAD, without: frozenset[str] = frozenset()
    ) -> tuple[RangePosterior, ...]:
        """Process the next frame."""
        self.tracks([seen], motion)
        return self.ranges(self.tracks.tracks, motion, without)


def found(
    things: Sequence[Thing], gone_m: float, t_ns: int = 0, lenses: Sequence[str] = ()
) -> Detections:
    boxes = []
    for _, start_m, right_m, height_m in things:
        scale = 1500.0 / (start_m - gone_m)
        x, y, half = 960.0 + right_m * scale, 540.0 - 3.0 * scale, 0.5 * height_m * scale
        boxes.append([x - 0.4 * half, y - half, x + 0.4 * half, y + half])
    labels = tuple(one[0] for one in things)
    return Detections(
        t_ns,
        SIZE,
        np.array(boxes).reshape(-1, 4),
        np.full(len(boxes), 0.95),
        labels,
        (b"",) * len(boxes),
        tuple(lenses),
    )


def drive(
    one: Drive, things: Sequence[Thing], until_m: int, lenses: Sequence[str] = ()
) -> list[tuple[RangePosterior, ...]]:
    return [one(found(things, float(gone_m), lenses=lenses)) for gone_m in range(until_m)]


def test_far_lights_mark_end_and_groups_are_not_averaged() -> None:
    beside: Thing = ("traffic light", 57.0, -9.0, 1.3)
    rows = drive(Drive(vehicle()), [NEAR, beside, FAR], 45, ("red", "red", "red"))

    last, near = rows[-1]
    assert last.reference is Reference.END
    assert last.range_m == pytest.approx(84.0 - 44.0 + 1.5 - SETBACK_M, rel=0.04)
    assert last.measured_m == pytest.approx(last.range_m, rel=0.02)
    assert near.reference is Reference.START
    assert near.range_m == pytest.approx(57.0 - 44.0 + 1.5, rel=0.04)
    assert rows[0] == ()


@pytest.mark.parametrize("lens", ["unknown", "yellow", ""])
def test_light_of_unknown_facing_marks_nothing(lens: str) -> None:
    rows = drive(Drive(vehicle()), [NEAR, FAR], 45, (lens, lens))

    assert not any(rows)


def test_assumed_size_of_one_light_is_no_range_until_growth_confirms_it() -> None:
    standing = CarStep(0.0, 0.0, 0.0, 0.1)
    one = Drive(vehicle())

    still = [one(found([FAR], 0.0, lenses=["red"]), standing) for _ in range(40)]
    moving = drive(one, [FAR], 40, ("red",))

    assert not any(still)
    assert one.ranges.counts[UNCONFIRMED] >= 35
    assert moving[-1][0].range_m == pytest.approx(84.0 - 39.0 + 1.5 - SETBACK_M, rel=0.05)


def test_two_lights_in_one_place_confirm_each_other_and_a_third_widens_the_interval() -> None:
    standing = CarStep(0.0, 0.0, 0.0, 0.1)
    beside: Thing = ("traffic light", 84.0, 6.0, 1.3)
    off: Thing = ("traffic light", 78.0, -6.0, 1.3)

    def last(things: Sequence[Thing], motion: CarStep, until_m: int) -> RangePosterior:
        one, lenses = Drive(vehicle()), ["red"] * len(things)
        for gone_m in range(40):
            row = one(found(things, float(min(gone_m, until_m)), lenses=lenses), motion)
        return row[0]

    still = last([FAR, beside], standing, 0)
    two, three = (last(things, AHEAD, 39) for things in ([FAR, beside], [FAR, beside, off]))

    assert abs(still.range_m - (84.0 + 1.5 - SETBACK_M)) < 1.96 * np.sqrt(still.var_m2)
    assert np.sqrt(still.var_m2) > 0.15 * still.range_m
    assert three.range_m == pytest.approx(two.range_m, rel=0.03)
    assert three.var_m2 >= (0.45 * 6.0) ** 2
    assert two.var_m2 < three.var_m2


def test_nearest_stop_sign_marks_start() -> None:
    near: Thing = ("stop sign", 40.0, 4.0, 0.75)
    far: Thing = ("stop sign", 65.0, -4.0, 0.75)

    (last,) = drive(Drive(vehicle()), [far, near], 30)[-1]

    assert last.reference is Reference.START
    assert last.range_m == pytest.approx(40.0 - 29.0 + 1.5, rel=0.04)


def test_boxes_cut_by_image_edge_yield_no_range_and_are_counted() -> None:
    aside: Thing = ("traffic light", 20.0, -12.75, 1.3)
    car = vehicle()
    seen = found([aside], 0.0)
    counted = SignRanges(car)
    counted([seen])

    assert drive(Drive(car), [aside], 3)[0] == ()
    assert counted.by_cue["traffic_light"].skipped == {CUT: 1}
