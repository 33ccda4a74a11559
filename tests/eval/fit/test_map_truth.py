"""Truth from a map: the approaches of a drive with GNSS, with their legs, control and distances."""

from pathlib import Path

import pytest

import crosscue
from crosscue.datasets.truth.truth import read_truth
from crosscue.replay.errors import EmptyResultError
from support.kitti_drive import raw_drive, true_path
from support.street_map import write_crossing, write_map


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


def test_map_of_another_place_is_refused(tmp_path: Path) -> None:
    points = {"a": (0.0, 0.0), "b": (100.0, 0.0)}
    streets = write_map(tmp_path / "far.osm", points, [("ab", "")], origin=(50.0, 8.4))

    with pytest.raises(EmptyResultError, match="no intersection on the roads"):
        crosscue.truth_from_map(raw_drive(tmp_path / "kitti"), streets, tmp_path / "truth")

    assert not (tmp_path / "truth").exists()
