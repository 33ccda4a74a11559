"""Roads of the scene: what openings say to the belief and to the ranges."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Frame, RoadMask, View
from crosscue.detectors.cues.observed import NOT_SEEN, FrameDetections, RoadFractions
from crosscue.detectors.cues.road_layout import LogOdds
from crosscue.detectors.cues.road_openings import Legs, Seen
from crosscue.eval.pipeline.scene.roads import BY_SHAPE, Roads
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import log_odds
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.camera import Camera
from crosscue.replay.vehicle.fusion import OPENING_PRECISION
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Vehicle, parse
from support.pictures import picture_log
from support.road_masks import LEFT, RIGHT, ROAD, seen_from

CAMERA = Camera(focal_px=700.0, z_m=1.6)
SIZE_PX = (640, 360)


def evidence(travelled_m: float | None) -> FrameEvidence:
    """Evidence of a frame with nothing but motion."""
    return FrameEvidence(0, travelled_m, 0.01, (), {})


def frame() -> FrameDetections:
    """A frame whose lower half is road."""
    rows = np.arange(SIZE_PX[1]) > SIZE_PX[1] // 2
    pixels = np.broadcast_to(rows[:, None], SIZE_PX[::-1])
    return FrameDetections(
        0, road=RoadMask(0, SIZE_PX, rle.encode_mask(pixels, (0, 0), SIZE_PX), SIZE_PX)
    )


def roads(seen: Seen | None = None, camera: Camera = CAMERA) -> Roads:
    """Roads after a frame with some result."""
    made = Roads(Vehicle(version=1, camera=camera), {})
    made.seen = seen
    return made


def opening(start_m: float, end_m: float) -> Seen:
    """An intersection with a road to the right."""
    return Seen((), Legs(0.0, 1.0, 1.0), start_m, end_m, 2.0)


def test_openings_mark_start_and_end_while_the_end_is_ahead() -> None:
    start, end = roads(opening(12.0, 20.0)).ranges()
    assert (start.reference, start.range_m, start.var_m2) == (Reference.START, 12.0, 4.0)
    assert (end.reference, end.range_m) == (Reference.END, 20.0)
    assert not roads(opening(-9.0, -0.5)).ranges()
    assert not roads(Seen((), Legs(0.0, math.nan, 0.0))).ranges()
    assert not roads().ranges()


@pytest.mark.parametrize(("range_m", "fits"), [(12.0, True), (25.0, True), (80.0, False)])
def test_openings_fit_lights_and_signs_at_their_place_alone(range_m: float, fits: bool) -> None:
    other = RangePosterior(Reference.END, range_m, 4.0, range_m)
    assert roads(opening(12.0, 20.0)).fits([other]) is fits
    assert roads(Seen((), Legs(0.0, math.nan, 0.0))).fits([other])


def test_without_odometry_no_road_is_seen() -> None:
    assert roads()(frame(), evidence(None)) is NOT_SEEN
    known = roads()(frame(), evidence(1.0))
    assert isinstance(known, RoadFractions)
    assert roads()(FrameDetections(0), evidence(1.0)) is None


def test_without_a_focal_length_the_mask_alone_shows_roads_and_gives_no_range() -> None:
    road = seen_from([ROAD, RIGHT], 0.8, 1.4, 0.45)
    uncalibrated = roads(camera=Camera())
    for t_ns in range(0, 10**9, 10**8):
        # Neither a distance nor the car's own motion is needed.
        found = uncalibrated(FrameDetections(t_ns, road=road), evidence(None))
    assert found is not None
    assert found.right == 1.0
    assert math.isnan(found.left)
    assert not uncalibrated.ranges()
    assert uncalibrated.plan() is None
    assert uncalibrated.notes() == {BY_SHAPE: 10}
    assert uncalibrated.with_shape(evidence(None)).roads_ahead == {
        "road_left": False,
        "road_right": True,
    }
    assert uncalibrated.with_shape(evidence(None)).weights["road_right"] > 1.0
    uncalibrated.restart()
    assert uncalibrated.with_shape(evidence(None)) == evidence(None)


@pytest.mark.parametrize(("odds", "is_seen"), [(1.2, False), (1.3, True), (5.0, True)])
def test_a_road_that_the_shape_shows_is_believed(odds: float, is_seen: bool) -> None:
    """Also just above the least log odds: a message is worth what such messages proved to be."""
    seen = roads(camera=Camera())
    seen._shape = LogOdds(odds, -1.0, odds + 1.0, odds)
    found = seen.with_shape(evidence(None))

    believed = {cue: log_odds(OPENING_PRECISION) * one for cue, one in found.weights.items()}
    assert (found.roads_ahead.get("road_left") is True) is is_seen
    assert (believed["road_left"] > log_odds(0.9)) is is_seen
    assert believed["road_straight"] == believed["road_left"]
    assert believed["road_left"] >= odds


def test_an_opening_supports_the_intersection_unless_the_method_or_the_file_says_otherwise() -> (
    None
):
    usual = Vehicle(version=1).fusion.cues["road_left"]
    assert usual.supports == ("left", "intersection")
    simulated = Vehicle(version=1, name=SIMULATED_CAR).fusion.cues["road_left"]
    drawn = parse('version = 1\n[regions]\nkind = "picture"\n', "a").fusion.cues["road_left"]
    published = parse('version = 1\n[fusion]\nkind = "source"\n', "a").fusion.cues["road_left"]
    assert {one.supports for one in (simulated, drawn, published)} == {("left",)}
    assert {one.precision for one in (simulated, drawn, published)} == {0.77}
    own = parse("version = 1\n[fusion.cues]\nroad_left = { precision = 0.8 }\n", "a")
    assert own.fusion.cues["road_left"].precision == 0.8
    assert own.fusion.cues["road_left"].supports == ("left",)


def test_settings_of_a_run_are_the_same_when_read_again() -> None:
    vehicle = Vehicle(version=1)
    assert Vehicle.model_validate(vehicle.model_dump()) == vehicle


class Streets:
    """A detector to which every picture shows the next of these roads, seen without calibration."""

    view, identity, labels = View(is_grey=True), "streets", ()
    areas = (*[[ROAD, RIGHT]] * 15, *[[ROAD]] * 5, *[[ROAD, LEFT]] * 16)

    def __call__(self, frames: Sequence[Frame], /) -> list[RoadMask]:
        """Return the mask of the picture whose grey value is its number."""
        return [
            replace(seen_from(self.areas[number], 0.8, 1.4, 0.45), t_ns=frame.t_ns)
            for frame in frames
            for number in (round(float(frame.pixels.mean()) / 5.0),)
        ]


def test_streets_that_a_car_passes_without_known_motion_are_believed_apart(tmp_path: Path) -> None:
    greys = [np.full(SIZE_PX[::-1], 5 * i, np.uint8) for i in range(len(Streets.areas))]
    log = picture_log(tmp_path / "log", greys)
    (tmp_path / "car.toml").write_text("version = 1\n")

    run = crosscue.replay_drive(log, tmp_path / "run", tmp_path / "car.toml", [Streets])

    rows = run["belief"].to_pylist()
    last = {row["approach"]: row for row in rows}
    assert [(row["right"] > 0.9, row["left"] > 0.9) for row in last.values()] == [
        (True, False),
        (False, True),
    ]
