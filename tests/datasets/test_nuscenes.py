"""nuScenes on generated tables with its published schema, without a drive of the data set."""

import json
from pathlib import Path

import numpy as np
import pytest

import crosscue
from crosscue.datasets.adapters.nuscenes_map import read_expansion
from crosscue.datasets.adapters.nuscenes_truth import write_nuscenes_truth
from crosscue.datasets.truth.coco import read_coco
from crosscue.datasets.truth.lanes import MAX_STEPS
from crosscue.datasets.truth.truth import read_truth
from crosscue.datasets.truth.tum import heading_rad, read_tum
from crosscue.replay.errors import LogFormatError
from crosscue.replay.logs.opening import open_log
from support.accounted import column, read_topics, times
from support.nuscenes_drive import (
    FIRST_US,
    FOCAL_PX,
    SPEED_MPS,
    YAW_RATE_RADPS,
    nuscenes_drive,
    pose,
    write_expansion,
)


def test_wheels_steering_and_imu_report_left_turn_in_si_units(tmp_path: Path) -> None:
    drive = nuscenes_drive(tmp_path / "root")

    found, _ = read_topics(drive)

    left, right = (column(found["can/wheel_speed"], f"rear_{on}_mps") for on in ("left", "right"))
    np.testing.assert_allclose(0.5 * (left + right), SPEED_MPS, rtol=1e-9)
    assert (right > left).all()
    # Published as positive to the right.
    np.testing.assert_allclose(column(found["can/steering"], "steering_rad"), 0.7)
    np.testing.assert_allclose(column(found["can/imu"], "gyro_z_radps"), YAW_RATE_RADPS)


def test_scene_is_selected_by_empty_file(tmp_path: Path) -> None:
    drive = nuscenes_drive(tmp_path / "root", scenes=3)
    with pytest.raises(LogFormatError, match=r"3 scenes; name one by an empty file: touch .*0061"):
        open_log(drive)

    (drive / "scene-0061.nuscenes").touch()
    with open_log(drive / "scene-0061.nuscenes") as log:
        assert "CAM_FRONT" in {topic.name for topic in log.topics}
    (drive / "scene-0999.nuscenes").touch()
    with pytest.raises(LogFormatError, match="no scene 'scene-0999'"):
        open_log(drive / "scene-0999.nuscenes")


def test_truth_has_rear_axle_pose_and_visible_boxes(tmp_path: Path) -> None:
    truth = read_truth(write_nuscenes_truth(nuscenes_drive(tmp_path / "root"), tmp_path / "truth"))

    assert truth.pose_point == "rear_axle"
    assert truth.pose is not None
    track = read_tum(tmp_path / "truth" / truth.pose)
    for i in range(len(track.t_ns)):
        east, north, yaw = pose((int(track.t_ns[i]) - FIRST_US * 1000) * 1e-9)
        np.testing.assert_allclose(track.xyz_m[i], (east, north, 0.0), atol=1e-6)
        assert heading_rad(track)[i] == pytest.approx(yaw, abs=1e-6)
    assert truth.objects is not None
    pictures = read_coco(tmp_path / "truth" / truth.objects).pictures
    assert [one.t_ns for one in pictures] == [(FIRST_US + 500_000 * i) * 1000 for i in range(3)]
    # The third box is behind the car.
    assert {thing.label for one in pictures for thing in one.things} == {"car", "person"}
    first = json.loads((tmp_path / "truth" / truth.objects).read_text())["annotations"][0]
    assert first["motion"] == "parked"
    assert (first["x_m"], first["y_m"]) == (20.0, 3.0)
    assert first["visible"] == 0.9


def test_truth_has_intersections_of_the_map_expansion(tmp_path: Path) -> None:
    drive = nuscenes_drive(tmp_path / "root")
    write_expansion(drive)

    written = crosscue.write_truth(drive, tmp_path / "truth")

    truth = read_truth(written.path)
    (one,) = truth.approaches
    assert one.features.model_dump() == {"left": True, "right": True, "straight": True}
    assert one.control == "traffic_light"
    assert one.length_m == pytest.approx(7.0, abs=0.3)
    assert truth.ranges is not None
    head, first, *_ = (tmp_path / "truth" / truth.ranges).read_text().splitlines()
    assert head == "t_ns,approach,start_m,end_m"
    assert float(first.split(",")[2]) == pytest.approx(40.0, abs=0.3)
    assert "intersections from the map boston-seaport.json" in written.source


def test_arcs_of_the_map_expansion_are_followed(tmp_path: Path) -> None:
    drive = nuscenes_drive(tmp_path / "root")
    place = write_expansion(drive)
    tree = json.loads(place.read_text())
    radius = 12.0
    piece = tree["arcline_path_3"]["w-n"][0]
    piece |= {"start_pose": [600.0, 1600.0, 0.0], "shape": "LSR", "radius": radius}
    piece["segment_length"] = [radius * np.pi / 2.0, 5.0, radius * np.pi / 4.0]
    place.write_text(json.dumps(tree))

    roads = read_expansion(place)

    (turn,) = [one for one in roads.roads if one.nodes[1].startswith("w-n:")]
    inner = np.array([roads.points_m[at] for at in turn.nodes[1:-1]])
    # Left about (600, 1612), straight to the north, then right about (624, 1617).
    np.testing.assert_allclose(np.hypot(*(inner[:9] - (600.0, 1612.0)).T), radius, atol=1e-6)
    np.testing.assert_allclose(inner[9:11, 0], 612.0, atol=1e-6)
    np.testing.assert_allclose(np.hypot(*(inner[11:] - (624.0, 1617.0)).T), radius, atol=1e-6)


def test_truth_says_which_map_is_missing(tmp_path: Path) -> None:
    drive = nuscenes_drive(tmp_path / "root")

    written = crosscue.write_truth(drive, tmp_path / "truth")

    assert not read_truth(written.path).approaches
    assert "no intersections: maps/expansion/boston-seaport.json is missing" in written.source
    assert [*written.lines()][-1].startswith("source")


@pytest.mark.parametrize("text", ["{", "[]", '{"lane": 3}', '{"lane": [{"token": 1}]}'])
def test_unusable_map_expansion_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    drive = nuscenes_drive(tmp_path / "root")
    write_expansion(drive).write_text(text)

    with pytest.raises(LogFormatError, match=r"boston-seaport.json: .*map expansion") as caught:
        crosscue.write_truth(drive, tmp_path / "truth")

    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "wrong",
    [{"radius": 0.0}, {"segment_length": [1e999, 1.0, 1.0]}, {"start_pose": [1e999, 0.0, 0.0]}],
)
def test_lane_without_end_is_refused_in_one_line(tmp_path: Path, wrong: dict[str, object]) -> None:
    place = write_expansion(nuscenes_drive(tmp_path / "root"))
    tree = json.loads(place.read_text())
    tree["arcline_path_3"]["w-n"][0] |= wrong
    place.write_text(json.dumps(tree).replace("Infinity", "1e999"))

    with pytest.raises(LogFormatError, match="not a map expansion"):
        read_expansion(place)


def test_stated_lengths_do_not_decide_on_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = write_expansion(nuscenes_drive(tmp_path / "root"))
    tree = json.loads(place.read_text())
    tree["arcline_path_3"]["w-n"][0]["segment_length"] = [1e15, 1e15, 1e15]
    place.write_text(json.dumps(tree))
    roads = read_expansion(place)
    assert max(len(one.nodes) for one in roads.roads) < 4 * MAX_STEPS

    monkeypatch.setattr("crosscue.datasets.adapters.nuscenes_map.MAX_POINTS", 100)
    with pytest.raises(LogFormatError, match="lanes of over"):
        read_expansion(place)


def test_box_matches_pinhole_projection(tmp_path: Path) -> None:
    truth = read_truth(write_nuscenes_truth(nuscenes_drive(tmp_path / "root"), tmp_path / "truth"))

    assert truth.objects is not None
    box_px = read_coco(tmp_path / "truth" / truth.objects).pictures[0].things[0].box_px
    assert box_px is not None
    x0, y0, x1, y1 = box_px
    # The car's near end is 20 - 2.25 - 1.7 m ahead of the camera, its roof 1.6 m above the road
    # and so 0.1 m above the camera; its right side is 3 - 0.95 m to the left.
    near_m, far_m = 20.0 - 2.25 - 1.7, 20.0 + 2.25 - 1.7
    assert x0 == pytest.approx(816 - FOCAL_PX * 3.95 / near_m, abs=0.01)
    assert x1 == pytest.approx(816 - FOCAL_PX * 2.05 / far_m, abs=0.01)
    assert y0 == pytest.approx(491 - FOCAL_PX * 0.1 / near_m, abs=0.01)
    assert y1 == pytest.approx(491 + FOCAL_PX * 1.5 / near_m, abs=0.01)


@pytest.mark.parametrize("what", ["value", "opening brace", "closing brace"])
def test_damaged_table_row_is_dropped_and_counted(tmp_path: Path, what: str) -> None:
    drive = nuscenes_drive(tmp_path / "root")
    table = drive / "v1.0-mini" / "sample_data.json"
    text = table.read_text()
    value = text.index('"token": "d7"')
    braces = {"opening brace": text.rindex("{", 0, value), "closing brace": text.index("}", value)}
    at = braces.get(what, value)
    table.write_text(text[:at] + "?" + text[at + 1 :])

    found, ledger = read_topics(drive)

    assert len(times(found["CAM_FRONT"])) == 11
    assert ledger.topic("").dropped.total() == 1
    assert "sample_data.json" in next(iter(ledger.topic("").dropped))
