"""Roads of the scene, from pictures and from a map: what they say to belief and ranges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import crosscue
from crosscue.detectors import rle
from crosscue.detectors.base import Detections, Frame, RoadMask, View
from crosscue.detectors.cues import road_layout
from crosscue.detectors.cues.observed import FrameDetections, RoadFractions
from crosscue.detectors.cues.road_layout import LogOdds
from crosscue.detectors.cues.road_openings import Legs, Seen
from crosscue.eval import cli
from crosscue.eval.fit.annotated_runs import read_annotated
from crosscue.eval.pipeline.scene.roads import BY_SHAPE, Roads
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import log_odds
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.errors import UsageError
from crosscue.replay.vehicle.camera import Camera
from crosscue.replay.vehicle.fusion import OPENING_PRECISION
from crosscue.replay.vehicle.vehicle import SIMULATED_CAR, Vehicle, parse
from support.kitti_drive import raw_drive
from support.pictures import picture_log
from support.refusals import refusal
from support.road_masks import LEFT, RIGHT, ROAD, seen_from
from support.street_map import write_crossing, write_map

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


def test_a_frame_without_a_mask_says_nothing_of_roads() -> None:
    assert roads()(FrameDetections(0), evidence(1.0)) is None


def approached(made: Roads) -> RoadFractions | None:
    """Roads after a second of approach to a street on the right, from 22 m to 13 m before it."""
    for number in range(10):
        ahead = [(x_m, z_m + 8.0 - number) for x_m, z_m in RIGHT]
        road = seen_from([ROAD, ahead], 0.8, 1.4, 0.45)
        found = made(FrameDetections(number * 10**8, road=road), evidence(1.0))
    assert found is None or isinstance(found, RoadFractions)
    return found


@pytest.mark.parametrize("is_shown", [True, False])
def test_the_shape_tells_which_roads_there_are_and_openings_where(
    is_shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A street that was just passed is still an opening: nobody believes it."""
    odds = LogOdds(-2.0, 3.0 if is_shown else -3.0, 0.0, 0.0)
    monkeypatch.setattr(road_layout, "log_odds", lambda *_: odds)
    made = roads(camera=Camera(focal_px=512.0, center_px=(320.0, 162.0), z_m=1.4))

    found = approached(made)

    assert found is not None
    assert found.left == 0.0
    assert (found.right == 1.0) is is_shown
    assert found.right != 0.0
    assert (made.with_shape(evidence(1.0)).roads_ahead["road_right"]) is is_shown
    ranges = {one.reference: one.range_m for one in made.ranges()}
    assert ranges == (
        {Reference.START: pytest.approx(13.0, abs=2.5), Reference.END: pytest.approx(21.0, abs=2.5)}
        if is_shown
        else {}
    )


def test_a_road_that_the_shape_shows_is_there_where_no_opening_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(road_layout, "log_odds", lambda *_: LogOdds(3.0, 3.0, 0.0, 3.0))

    found = approached(roads(camera=Camera(focal_px=512.0, center_px=(320.0, 162.0), z_m=1.4)))

    assert found is not None
    assert (found.left, found.right) == (1.0, 1.0)


def test_without_motion_the_shape_alone_shows_roads() -> None:
    known = roads(camera=Camera(focal_px=512.0, center_px=(320.0, 162.0), z_m=1.4))
    approached(known)
    assert known.plan() is not None

    found = known(
        FrameDetections(10**9, road=seen_from([ROAD, RIGHT], 0.8, 1.4, 0.45)), evidence(None)
    )

    assert found is not None
    assert found.right == 1.0
    assert not known.ranges()
    assert known.plan() is None
    assert known.notes() == {BY_SHAPE: 1}


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


@pytest.mark.parametrize(("odds", "is_seen"), [(0.95, False), (1.05, True), (5.0, True)])
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


SPEED = '[topics]\nodometry = "oxts/ins_speed"\n'


def _replayed(folder: Path, setting: str) -> Path:
    """Replay 28 m of a drive toward a crossing with arms to the left and straight on."""
    (folder / "car.toml").write_text(f"version = 1\n{setting}\n{SPEED}")
    argv = ["replay", raw_drive(folder / "kitti"), "--vehicle", folder / "car.toml"]
    argv += ["--detectors", "support.detecting:Nothing", "--no-cache", "-q", "-o", folder / "run"]
    assert cli.run([str(one) for one in argv]) in (0, 3)
    return folder / "run"


def _counts(run: Path) -> dict[str, set[int]]:
    rows = pq.read_table(run / "cues.parquet", columns=["cue", "count"]).to_pylist()
    found: dict[str, set[int]] = {}
    for row in rows:
        if row["cue"].startswith("map_"):
            found.setdefault(row["cue"], set()).add(row["count"])
    return found


def test_legs_of_the_map_are_cues_that_open_an_approach(tmp_path: Path) -> None:
    write_crossing(tmp_path / "streets.osm")

    run = _replayed(tmp_path, 'road_map = "streets.osm"')

    assert _counts(run) == {"map_left": {1}, "map_straight": {1}, "map_right": {0}}
    last = pq.read_table(run / "belief.parquet").to_pylist()[-1]
    assert min(last["left"], last["straight"]) > 0.85
    assert last["right"] == 0.5


def test_without_a_map_there_is_no_such_cue(tmp_path: Path) -> None:
    assert not _counts(_replayed(tmp_path, ""))


def test_a_run_that_used_a_map_is_not_scored_by_truth_from_it(tmp_path: Path) -> None:
    streets = write_crossing(tmp_path / "streets.osm")
    other = tmp_path / "other.osm"
    other.write_text(streets.read_text() + "\n")
    run = _replayed(tmp_path, 'road_map = "streets.osm"')
    drive = tmp_path / "kitti"
    same = crosscue.truth_from_map(drive, streets, tmp_path / "same").path
    another = crosscue.truth_from_map(drive, other, tmp_path / "another").path

    said = refusal(2, "score", run, "--truth", same, "-o", tmp_path / "score")

    assert "its approaches are from the map that" in said
    assert not (tmp_path / "score").exists()
    with pytest.raises(UsageError, match="its approaches are from the map that"):
        read_annotated([run], [same], lambda *_: ())
    assert cli.run(["score", str(run), "--truth", str(another), "-q"]) in (0, 3)


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ('road_map = "none.osm"', "none.osm: No such file"),
        ('road_map = "streets.osm"\n[gnss]\nuse = "off"', "road_map: the position on the map"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, setting: str, said: str
) -> None:
    write_map(tmp_path / "streets.osm", {"a": (0.0, 0.0), "b": (9.0, 0.0)}, [("ab", "")])
    (tmp_path / "car.toml").write_text(f"version = 1\n{setting}\n{SPEED}")
    argv = ["replay", raw_drive(tmp_path / "kitti"), "--vehicle", tmp_path / "car.toml"]
    argv += ["--detectors", "support.detecting:Nothing", "--no-cache", "-o", tmp_path / "run"]

    assert said in refusal(4 if "none" in setting else 2, *argv)


class Road(Streets):
    """Every picture shows the same road."""

    areas = ([ROAD],) * 36


class Light:
    """A detector of a light in all pictures."""

    view, identity, labels = View(is_grey=True), "light", ("traffic light",)

    def __call__(self, frames: Sequence[Frame], /) -> list[Detections]:
        """Return the light, which moves a little: equal results would be a repeated picture."""
        return [
            Detections(frame.t_ns, frame.size_px, boxes_px, np.array([0.9]), self.labels, (b"",))
            for frame in frames
            for at_px in (300.0 + frame.t_ns * 1e-8,)
            for boxes_px in (np.array([[at_px, 60.0, at_px + 20.0, 110.0]]),)
        ]


@pytest.mark.parametrize("has_light", [False, True])
def test_a_light_is_the_intersection_behind_which_the_road_goes_on(
    has_light: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    odds = LogOdds(-2.0, -2.0, 4.0, 0.0)
    monkeypatch.setattr(road_layout, "log_odds", lambda *_: odds)
    log = picture_log(
        tmp_path / "log", [np.full(SIZE_PX[::-1], 5 * i, np.uint8) for i in range(36)]
    )
    (tmp_path / "car.toml").write_text("version = 1\n")
    detectors = [Road, Light] if has_light else [Road]

    run = crosscue.replay_drive(log, tmp_path / "run", tmp_path / "car.toml", detectors)

    believed = {row["straight"] > 0.9 for row in run["belief"].to_pylist()[-5:]}
    assert believed == ({True} if has_light else set())
