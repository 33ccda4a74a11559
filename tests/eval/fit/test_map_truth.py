"""Truth from a map: the approaches of a drive with GNSS, with their legs, control and distances."""

from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.truth.truth import read_truth
from crosscue.replay.errors import EmptyResultError
from support.kitti_drive import raw_drive, true_path
from support.street_map import write_crossing, write_lanelets, write_map


def test_approach_of_a_map_is_a_scored_approach_with_ranges(tmp_path: Path) -> None:
    streets = write_crossing(tmp_path / "streets.osm")

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    truth = read_truth(written.path)
    (one,) = truth.approaches
    assert one.features.model_dump() == {"left": True, "right": False, "straight": True}
    assert (one.control, one.conditions) == ("none", ("control_not_stated",))
    assert one.length_m == pytest.approx(6.5)
    assert truth.ranges == "ranges.csv"
    head, *rows = (tmp_path / "truth" / truth.ranges).read_text().splitlines()
    assert head == "t_ns,approach,start_m,end_m"
    first = [float(value) for value in rows[0].split(",")]
    last = [float(value) for value in rows[-1].split(",")]
    # The crossing is 60 m east of the first position, and its road is two lanes wide.
    assert first[2] == pytest.approx(60.0 - 3.25, abs=0.5)
    east_m = true_path(len(rows))[0][:, 0]
    assert first[2] - last[2] == pytest.approx(east_m[-1], abs=0.1)
    assert "control not stated for 1 of 1" in truth.source


def test_a_sign_that_the_car_has_passed_still_controls_the_approach(tmp_path: Path) -> None:
    points = {"a": (-80.0, 0.0), "s": (20.0, 0.0), "b": (45.0, 0.0), "c": (160.0, 0.0)}
    roads = [("asbc", ""), ("bd", "")]
    signs = {"s": "highway=stop direction=forward"}
    streets = write_map(tmp_path / "a.osm", points | {"d": (45.0, 70.0)}, roads, signs)

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    (one,) = read_truth(written.path).approaches
    assert (one.control, one.conditions) == ("stop_sign", ())


def test_approaches_of_a_lanelet2_map_are_read_as_those_of_an_extract(tmp_path: Path) -> None:
    lanes = {
        name: ([(x0, 4.0), (x1, 4.0)], [(x0, -4.0), (x1, -4.0)], "one_way=no")
        for name, x0, x1 in (("w", -80.0, 56.0), ("w-e", 56.0, 64.0), ("e", 64.0, 160.0))
    }
    lanes["n"] = ([(56.0, 6.0), (56.0, 70.0)], [(64.0, 6.0), (64.0, 70.0)], "one_way=no")
    turn = [(56.0, 4.0), (56.0, 5.0), (56.0, 6.0)], [(56.0, -4.0), (63.0, -2.0), (64.0, 6.0)]
    lanes["w-n"] = (*turn, "one_way=no")
    path = write_lanelets(tmp_path / "a.osm", lanes, {"light": ("traffic_light", "w")})

    written = crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), path, tmp_path / "truth")

    (one,) = read_truth(written.path).approaches
    assert one.features.model_dump() == {"left": True, "right": False, "straight": True}
    assert one.control == "traffic_light"
    assert one.length_m == pytest.approx(8.0, abs=0.2)
    row = (tmp_path / "truth" / "ranges.csv").read_text().splitlines()[1].split(",")
    assert float(row[2]) == pytest.approx(56.0, abs=0.5)


def test_map_of_another_place_is_refused(tmp_path: Path) -> None:
    points = {"a": (0.0, 0.0), "b": (100.0, 0.0)}
    streets = write_map(tmp_path / "far.osm", points, [("ab", "")], origin=(50.0, 8.4))

    with pytest.raises(EmptyResultError, match=r"no intersection of the map .* on the roads"):
        crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    assert not (tmp_path / "truth").exists()
