"""A simulated drive as files, with its truth; traffic on the left is a mirror image."""

import json
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from crosscue.datasets.scenes.drive import (
    CALIBRATION,
    CAR_BUS,
    IMAGES,
    MOBILEYE_BUS,
    SPARSE_PHOTOGRAPHS,
    SceneFiles,
    write_scene,
)
from crosscue.datasets.scenes.layout import Layout, Side, layout_named
from crosscue.datasets.scenes.mobileye import HALF_VIEW_RAD, SETTINGS, lane_lines_m
from crosscue.datasets.scenes.motion import approach, conditions_of, lane_y_m
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings, scene_vehicle_text
from crosscue.datasets.scenes.world import SceneObject, build_world
from crosscue.datasets.simulate import Approaches
from crosscue.datasets.truth.truth import read_truth
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.detectors import rle
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.decode import BusDecoder
from crosscue.replay.columns import Block, CanFrames, Images, Table
from crosscue.replay.decode import decoder_for
from crosscue.replay.ledger import Ledger
from crosscue.replay.logs.opening import open_log
from crosscue.replay.mobileye.can.decode import MobileyeDecoder
from crosscue.replay.vehicle.vehicle import parse
from support.accounted import read
from support.refusals import refusal

TINY = SceneCamera(width_px=192, height_px=108)


def settings(layout: str = "C", run: int = 1, seed: int = 0) -> SceneSettings:
    return SceneSettings(layout=layout, run=run, seed=seed, camera=TINY)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    return write_scene(tmp_path_factory.mktemp("drive"), settings())


def blocks(path: Path, topic: str) -> Iterator[Block]:
    """Yield the decoded blocks of one topic."""
    ledger = Ledger(str(path))
    with open_log(path) as log:
        (one,) = [t for t in log.topics if t.name == topic]
        decoder = decoder_for(one)
        assert decoder is not None
        for block in log.read(ledger):
            if block.topic == topic:
                yield decoder(block, ledger)


def truth_of(files: SceneFiles) -> Any:
    return json.loads((files.log.parent / "objects.json").read_text())


def test_picture_spacing_does_not_change_times_of_other_sensors(
    files: SceneFiles, tmp_path: Path
) -> None:
    sparse = write_scene(tmp_path / "sparse", settings(), imager=SPARSE_PHOTOGRAPHS)

    for topic in (CAR_BUS, "/imu", "/compass"):
        all_ns, found_ns = (
            np.sort(np.concatenate([block.log_ns for block in blocks(one.log, topic)]))
            for one in (files, sparse)
        )
        np.testing.assert_array_equal(found_ns, all_ns)


def test_every_row_is_read_back_and_pictures_have_their_size(files: SceneFiles) -> None:
    import cv2

    _, ledger = read(files.log)
    assert ledger.is_whole
    assert {ledger.topic(one).declared for one in (IMAGES, CALIBRATION)} == {files.pictures}
    count = 0
    for block in blocks(files.log, IMAGES):
        assert isinstance(block.rows, Images)
        for i in range(len(block)):
            raw = np.frombuffer(block.rows.bytes_.payload(i), np.uint8)
            picture = cv2.imdecode(raw, cv2.IMREAD_COLOR)
            assert picture is not None
            assert picture.shape == (108, 192, 3)
            count += 1
    assert count == files.pictures


def test_true_range_decreases_by_travelled_distance_to_zero_at_entry(files: SceneFiles) -> None:
    rows = np.loadtxt(files.log.parent / "ranges.csv", delimiter=",", skiprows=1)
    track = read_tum(files.log.parent / "pose.tum")
    (approach,) = read_truth(files.truth).approaches
    travelled = np.hypot(*(track.xyz_m[:, :2] - track.xyz_m[0, :2]).T)
    at = np.interp(rows[:, 0], track.t_ns.astype(float), travelled)

    assert (np.diff(rows[:, 2]) <= 1e-9).all()
    assert np.allclose(rows[0, 2] - rows[:, 2], at, atol=0.05)
    assert np.allclose(rows[:, 3] - rows[:, 2], float(approach.length_m or 0.0), atol=1e-3)
    speed_mps = (rows[-2, 2] - rows[-1, 2]) / 0.1
    assert 0.0 < rows[-1, 2] < 0.11 * max(speed_mps, 1.0)


def test_wheel_speed_matches_trajectory(files: SceneFiles) -> None:
    database = CanDatabase.load([files.log.parent / "simulated_car.dbc"])
    track = read_tum(files.log.parent / "pose.tum")
    decoder = BusDecoder(database, CAR_BUS, Ledger("test"))
    times, speeds = [], []
    for block in blocks(files.log, CAR_BUS):
        for table in decoder(block):
            if table.topic.endswith("WHEEL_SPEEDS"):
                assert isinstance(table.rows, Table)
                times.append(table.log_ns)
                speeds.append(table.rows["REAR_LEFT"].astype(np.float64) / 3.6)
    step_m = np.hypot(*np.diff(track.xyz_m[:, :2], axis=0).T)
    true_mps = step_m / (np.diff(track.t_ns) * 1e-9)
    middle = (track.t_ns[1:] + track.t_ns[:-1]) / 2
    wheel = np.interp(middle, np.concatenate(times).astype(float), np.concatenate(speeds))

    straight = np.abs(np.diff(np.unwrap(heading_rad(track)))) < 1e-3
    assert np.sqrt(np.mean((wheel - true_mps)[straight] ** 2)) < 0.25


def test_mobileye_obstacles_match_true_vehicles(files: SceneFiles) -> None:
    decoder = MobileyeDecoder(MOBILEYE_BUS, Ledger("test"), SETTINGS)
    tables: list[Block] = []
    for block in blocks(files.log, MOBILEYE_BUS):
        assert isinstance(block.rows, CanFrames)
        tables += decoder(block)
    tables += decoder.flush()
    objects = truth_of(files)
    cars: dict[int, dict[int, float]] = {image["t_ns"]: {} for image in objects["images"]}
    time_of = {image["id"]: image["t_ns"] for image in objects["images"]}
    for one in objects["annotations"]:
        if one["category_id"] == 3:
            cars[time_of[one["image_id"]]][one["track_id"]] = one["distance_m"]
    grabbed = np.array(sorted(cars))
    names = ("t_ns", "obstacle_id", "x_m", "y_m", "length_m")
    found = 0
    for table in tables:
        assert isinstance(table.rows, Table)
        if not table.topic.endswith("/obstacles"):
            continue
        for t_ns, number, x_m, y_m, long_m in zip(
            *(table.rows[name].tolist() for name in names), strict=True
        ):
            middle_m = x_m + long_m / 2
            # The field of view refers to the vehicle's centre, the position to its near end.
            assert abs(np.arctan2(y_m, middle_m - 3.75)) < HALF_VIEW_RAD + 0.15
            true_m = cars[int(grabbed[np.argmin(np.abs(grabbed - t_ns))])].get(number - 1)
            # Vehicles with too few pixels at this picture size have no annotation.
            if true_m is not None:
                assert abs(middle_m - true_m) < 1.5 + 0.12 * x_m
                found += 1
    assert found > 20


def test_annotation_masks_match_boxes_and_areas(files: SceneFiles) -> None:
    objects = truth_of(files)
    size = {image["id"]: (image["width"], image["height"]) for image in objects["images"]}

    assert len(objects["images"]) == files.pictures
    assert len({one["id"] for one in objects["annotations"]}) == len(objects["annotations"])
    for one in objects["annotations"][::7]:
        wide, high = size[one["image_id"]]
        x, y, w, h = one["bbox"]
        mask = rle.decode_mask(one["segmentation"]["counts"].encode(), (wide, high))
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        assert [columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1] == [x, y, w, h]
        assert mask.sum() == one["area"]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["simulate", "-o", "x"], "or --all"),
        (["simulate", "J", "-o", "x"], "there are: A to H"),
        (["simulate", "A", "--run", "0", "-o", "x"], "run 0"),
        (["simulate", "A", "--run", "1", "--runs", "2", "-o", "x"], "--run"),
        (["simulate", "A", "B", "A", "-o", "x"], "named twice"),
        (["simulate", "A", "--fps", "7", "-o", "x"], "expected 10, 20, 25 or 50"),
        (["simulate", "A", "--width", "99", "-o", "x"], "multiple of 16"),
        (["simulate", "A", "--seed", "-1", "-o", "x"], "seed -1"),
    ],
)
def test_invalid_arguments_are_refused(argv: list[str], message: str) -> None:
    assert message in refusal(2, *argv)


# Sign of y on the side on which traffic drives.
OWN: Final[dict[Side, float]] = {"right": -1.0, "left": 1.0}


@cache
def things(layout: Layout) -> tuple[SceneObject, ...]:
    return build_world(layout, conditions_of(layout, 1), is_painted=False).things


def left_of(layout: Layout) -> Layout:
    return replace(layout, traffic="left")


@pytest.mark.parametrize("name", ["A", "C", "E", "F", "G"])
def test_things_beside_the_road_change_sides(name: str) -> None:
    layout = layout_named(name)
    there = {
        side: sorted(
            (one.category, round(one.at[0], 6), round(sign * one.at[1], 6))
            for one in things(replace(layout, traffic=side))
            if one.role == "furniture" and one.category in ("stop_sign", "traffic_light")
        )
        for side, sign in OWN.items()
    }

    assert there["left"]
    assert there["left"] == there["right"]


@pytest.mark.parametrize("name", ["A", "C", "E"])
def test_every_car_keeps_to_its_side(name: str) -> None:
    for side, own in OWN.items():
        layout = replace(layout_named(name), traffic=side)
        middle_m = 4.5 + 0.5 * layout.cross_width_m
        moving = [one for one in things(layout) if one.velocity != (0.0, 0.0)]
        assert moving
        for car in moving:
            if car.role == "cross":
                # To the right of its own direction where traffic drives on the right.
                assert (car.at[0] < middle_m) == (car.velocity[1] * own > 0.0)
            elif car.role in ("oncoming", "outgoing"):
                assert car.at[1] * car.velocity[0] * own > 0.0


@pytest.mark.parametrize("name", ["B", "E", "G"])
def test_parked_cars_face_along_their_side(name: str) -> None:
    layout = layout_named(name)
    for side, own in OWN.items():
        parked = [one for one in things(replace(layout, traffic=side)) if "parked" in one.role]
        assert parked
        for car in parked:
            if car.role == "parked_past":
                assert (car.at[1] * own > 0.0) == (np.cos(car.heading_rad) > 0.0)
            else:
                is_near = car.at[0] < 4.5 + 0.5 * layout.cross_width_m
                assert is_near == (car.heading_rad * own > 0.0)


def test_ego_vehicle_and_its_lane_lines_are_mirrored() -> None:
    layout = layout_named("H")
    left, right = lane_lines_m(layout)

    assert lane_y_m(left_of(layout)) == -lane_y_m(layout) > 0.0
    assert lane_lines_m(left_of(layout)) == (-right, -left)


def test_near_turn_is_short_on_either_side() -> None:
    """A turn to the own side takes the near half of the crossroad, and less room."""
    only_right = replace(layout_named("D"), has_left=False, has_ahead=False)
    only_left = replace(only_right, has_left=True, has_right=False, traffic="left")
    motions = [
        approach(one, conditions_of(one, 1), np.random.default_rng(1)).motion
        for one in (only_right, only_left)
    ]

    np.testing.assert_allclose(motions[0].x_m, motions[1].x_m, atol=1e-9)
    np.testing.assert_allclose(motions[0].y_m, -motions[1].y_m, atol=1e-9)
    np.testing.assert_allclose(motions[0].heading_rad, -motions[1].heading_rad, atol=1e-9)


def test_vehicle_file_has_the_mirrored_regions() -> None:
    text = {
        side: scene_vehicle_text(
            SceneCamera(), traffic=side, mounting_yaw_rad=0.0, declination_rad=0.0, heading_rad=0.0
        )
        for side in ("right", "left")
    }
    regions = {side: parse(one, "vehicle.toml").regions for side, one in text.items()}

    mirrored = [(1.0 - x, y) for x, y in regions["left"].left]
    np.testing.assert_allclose(mirrored, regions["right"].right, atol=1e-9)


def test_drives_on_the_left_have_a_name_and_folder_of_their_own() -> None:
    (right,) = Approaches(("A",)).scenes()
    (left,) = Approaches(("A",), traffic="left").scenes()

    assert (right.name, left.name) == ("A-01", "A-01-left")
    assert left == SceneSettings("A", traffic="left")
