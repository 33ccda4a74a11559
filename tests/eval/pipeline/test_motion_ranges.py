"""Ranges from motion: which light or sign yields the range, and frames without a range."""

from collections.abc import Sequence

import numpy as np
import pytest

from crosscue.detectors.base import Detections
from crosscue.eval.pipeline.scene.motion_ranges import MotionRanges
from crosscue.eval.pipeline.scene.sign_ranges import SignRanges
from crosscue.eval.pipeline.scene.usable import CUT
from crosscue.fusion.approaches import Approaches
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.vehicle import Ranges, Vehicle, parse

SIZE = (1920, 1080)
AHEAD = FrameEvidence(0, 1.0, 0.0, (), {})
CAMERA = "[camera]\nfocal_px = 1500.0\nx_m = 1.5\n"
SETBACK_M = Ranges().light_setback_m
# Label, range from the camera at the start, metres to the right, height.
Thing = tuple[str, float, float, float]
NEAR: Thing = ("traffic light", 57.0, -5.0, 1.3)
FAR: Thing = ("traffic light", 84.0, 2.0, 1.3)


def vehicle(text: str = CAMERA) -> Vehicle:
    return parse("version = 1\n" + text, "v.toml")


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
    ranges: MotionRanges, things: Sequence[Thing], until_m: int, lenses: Sequence[str] = ()
) -> list[tuple[RangePosterior, ...]]:
    rows = []
    for gone_m in range(until_m):
        seen = found(things, float(gone_m), lenses=lenses)
        spans = seen.boxes_px[:, 3] - seen.boxes_px[:, 1]
        rows.append(ranges(AHEAD, 0.1, [seen], [spans]))
    return rows


def test_far_lights_mark_end_and_groups_are_not_averaged() -> None:
    beside: Thing = ("traffic light", 57.0, -9.0, 1.3)
    rows = drive(MotionRanges(vehicle()), [NEAR, beside, FAR], 45, ("red", "red", "red"))

    last, near = rows[-1]
    assert last.reference is Reference.END
    assert last.range_m == pytest.approx(84.0 - 44.0 + 1.5 - SETBACK_M, rel=0.04)
    assert last.measured_m == pytest.approx(last.range_m, rel=0.02)
    assert near.reference is Reference.START
    assert near.range_m == pytest.approx(57.0 - 44.0 + 1.5, rel=0.04)
    assert rows[0] == ()


def test_nearest_stop_sign_marks_start() -> None:
    near: Thing = ("stop sign", 40.0, 4.0, 0.75)
    far: Thing = ("stop sign", 65.0, -4.0, 0.75)

    (last,) = drive(MotionRanges(vehicle()), [far, near], 30)[-1]

    assert last.reference is Reference.START
    assert last.range_m == pytest.approx(40.0 - 29.0 + 1.5, rel=0.04)


def test_boxes_cut_by_image_edge_yield_no_range_and_are_counted() -> None:
    aside: Thing = ("traffic light", 20.0, -12.75, 1.3)
    car = vehicle()
    seen = found([aside], 0.0)
    counted = SignRanges(car)
    counted([seen], [seen.boxes_px[:, 3] - seen.boxes_px[:, 1]])

    assert drive(MotionRanges(car), [aside], 3)[0] == ()
    assert counted.by_cue["traffic_light"].skipped == {CUT: 1}


def test_posterior_starts_range_that_is_predicted_and_updated() -> None:
    settings = vehicle()
    loop = Approaches(graph_of(settings.fusion), settings.fusion, settings.range_filter)
    known = RangePosterior(Reference.END, 50.0, 9.0, 51.0)
    steps = [
        loop(FrameEvidence(i, 1.0, 0.01, (), {"traffic_light": 1}, posteriors=some))
        for i, some in enumerate(((known,), (known,), ()), start=1)
    ]

    first, again, carried = (step.ranges for step in steps)
    assert [(row.range_m, row.var_m2, row.measured_m) for row in first] == [(50.0, 9.0, 51.0)]
    assert 49.0 < again[0].range_m < 49.2
    assert again[0].var_m2 == pytest.approx(9.0, abs=0.02)
    assert carried[0].range_m == pytest.approx(again[0].range_m - 1.0)
    assert carried[0].var_m2 == pytest.approx(again[0].var_m2 + 0.01)
    assert carried[0].measured_m is None
