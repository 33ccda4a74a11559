"""Intersections of a map along a track: distances, legs and controls, turned and mirrored."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.lanelet2 import read_map
from crosscue.datasets.truth.road_map import Ahead, RoadMap, approaches_along
from crosscue.replay.errors import AnnotationError
from support.street_map import ahead_of, roads_of, write_map
from support.trees import written

# A street to the east with a crossing at 60 m; a T junction follows, with its arm on the left.
POINTS = {
    "a": (-80.0, 0.0), "b": (60.0, 0.0), "c": (160.0, 0.0), "d": (60.0, 70.0),
    "e": (60.0, -70.0), "f": (240.0, 0.0), "g": (160.0, 70.0),
}  # fmt: skip
STREETS = [("abc", "lanes=2"), ("cf", "lanes=2"), ("ebd", "lanes=4"), ("cg", "")]


def _ahead(roads: RoadMap, x_m: float, y_m: float = -2.0, heading_rad: float = 0.0) -> Ahead | None:
    return ahead_of(roads, x_m, y_m, heading_rad)


def _sides(roads: RoadMap, ahead: Ahead) -> set[str]:
    return {side for side, legs in roads.legs(ahead).items() if legs}


def test_next_intersection_of_a_drive_begins_after_the_last(tmp_path: Path) -> None:
    roads = roads_of(write_map(tmp_path / "a.osm", POINTS, STREETS))
    x_m = np.arange(-60.0, 155.0, 1.0)

    found = roads.along(np.column_stack([x_m, np.full(len(x_m), -2.0)]), np.zeros(len(x_m)))
    (first, stop, enter), (second, last, none) = approaches_along(np.arange(len(x_m)), found)

    assert [x_m[first], x_m[stop]] == pytest.approx([-39.0, 54.0])
    assert enter == stop
    assert [second, x_m[last - 1]] == pytest.approx([121.0, 154.0], abs=1.0)
    assert none is None
    after = found[second]
    assert after is not None
    assert _sides(roads, after) == {"left", "straight", "back"}


@pytest.mark.parametrize("turn_deg", [0.0, 37.0, 90.0, 215.0])
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_turned_or_mirrored_map_gives_the_same_distances_and_turned_legs(
    tmp_path: Path, turn_deg: float, mirrored: bool
) -> None:
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    sign = -1.0 if mirrored else 1.0
    turned = {k: (c * x - s * sign * y, s * x + c * sign * y) for k, (x, y) in POINTS.items()}
    roads = roads_of(write_map(tmp_path / "a.osm", turned, STREETS))

    crossing, ahead = (
        ahead_of(roads, c * x + s * sign * 2.0, s * x - c * sign * 2.0, np.radians(turn_deg))
        for x in (10.0, 130.0)
    )

    assert crossing is not None
    assert [crossing.start_m, crossing.end_m] == pytest.approx([43.5, 56.5], abs=0.2)
    assert _sides(roads, crossing) == {"left", "right", "straight", "back"}
    assert ahead is not None
    assert ahead.start_m == pytest.approx(30.0 - 3.25, abs=0.2)
    assert _sides(roads, ahead) == {"right" if mirrored else "left", "straight", "back"}


def test_control_counts_for_its_direction(tmp_path: Path) -> None:
    points = POINTS | {"s": (48.0, 0.0)}
    roads = [("asbc", ""), ("ebd", "")]
    said = {
        "forward": "highway=stop direction=forward",
        "backward": "highway=stop direction=backward",
        "here": "highway=traffic_signals",
    }
    found = {}
    for name, tags in said.items():
        at = {"b" if name == "here" else "s": tags}
        ahead = _ahead(roads_of(write_map(tmp_path / "a.osm", points, roads, at)), 0.0)
        assert ahead is not None
        found[name] = ahead.control

    assert found == {"forward": "stop_sign", "backward": None, "here": "traffic_light"}


def test_a_ramp_or_a_driveway_is_no_intersection(tmp_path: Path) -> None:
    points = POINTS | {"r": (200.0, -30.0), "p": (80.0, -40.0)}
    motorway = [("abcf", "highway=motorway"), ("cr", "highway=motorway_link oneway=yes")]
    driveway = ("bp", "highway=service")
    roads = roads_of(write_map(tmp_path / "a.osm", points, [*motorway, driveway]))

    assert _ahead(roads, 30.0) is None
    assert _ahead(roads, 120.0) is None


def test_dual_carriageway_is_one_intersection(tmp_path: Path) -> None:
    points = POINTS | {"h": (75.0, 0.0), "i": (75.0, 70.0), "j": (75.0, -70.0)}
    roads = [("abhc", ""), ("dbe", "oneway=yes lanes=2"), ("jhi", "oneway=yes lanes=2")]
    road_map = roads_of(write_map(tmp_path / "a.osm", points, roads))

    ahead = _ahead(road_map, 0.0)

    assert ahead is not None
    assert [ahead.start_m, ahead.end_m] == pytest.approx([60.0 - 3.25, 75.0 + 3.25], abs=0.2)
    assert _ahead(road_map, 66.0) is None


def test_roundabout_begins_at_its_ring_and_ends_behind_it(tmp_path: Path) -> None:
    ring = {k: (60.0 + 20.0 * np.cos(a), 20.0 * np.sin(a)) for k, a in zip(
        "pqrstuvw", np.radians(22.5 + 45.0 * np.arange(8)), strict=True
    )}  # fmt: skip
    points = ring | {"a": (-80.0, 0.0), "b": (40.0, 0.0), "c": (80.0, 0.0), "f": (160.0, 0.0)}
    # The ring's first point has no arm.
    roads = [("ab", ""), ("cf", ""), ("pqrsbtuvwcp", "junction=roundabout lanes=1")]
    roads += [("qd", ""), ("vg", "")]
    points |= {"d": (67.0, 90.0), "g": (52.0, -90.0)}
    road_map = roads_of(write_map(tmp_path / "a.osm", points, roads))

    ahead = _ahead(road_map, 0.0)

    assert ahead is not None
    assert [ahead.start_m, ahead.end_m] == pytest.approx([40.0 - 1.6, 80.0 + 1.6], abs=0.3)
    assert _sides(road_map, ahead) == {"left", "right", "straight", "back"}


def test_a_side_road_that_begins_beyond_the_way_ends_in_no_traceback(tmp_path: Path) -> None:
    points = {
        "w": (0.0, 0.0), "p": (60.0, 0.0), "e": (130.0, 0.0),
        "q": (70.0, -4.0), "n": (70.0, 70.0), "f": (130.0, -30.0),
    }  # fmt: skip
    roads = [("wpe", ""), ("pq", ""), ("qn", ""), ("qf", "")]
    road_map = roads_of(write_map(tmp_path / "a.osm", points, roads))

    ahead = [_ahead(road_map, x, y_m=0.0) for x in (10.0, 40.0, 55.0)]

    assert all(one is None or one.start_m < one.end_m for one in ahead)


def test_off_the_roads_there_is_nothing_ahead(tmp_path: Path) -> None:
    roads = roads_of(write_map(tmp_path / "a.osm", POINTS, STREETS))

    assert _ahead(roads, 0.0, y_m=-35.0) is None
    assert _ahead(roads, 0.0, heading_rad=np.pi / 2.0) is None


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("<html></html>", "expected <osm>"),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><osm></osm>", "document type declaration"),
        ("<osm><node id='1' lat='x' lon='2'/></osm>", "node 1: expected lat and lon"),
        ("<osm><node id='1' lat='91' lon='2'/></osm>", "expected degrees"),
        ("<osm><node id='1' lat='1' lon='2'/></osm>", "no road for cars"),
        ("<osm><way", "not XML"),
    ],
)
def test_unusable_map_is_refused_in_one_line(tmp_path: Path, content: str, said: str) -> None:
    path = written(tmp_path / "a.osm", content)

    with pytest.raises(AnnotationError, match=said) as caught:
        read_map(path)

    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
