"""Intersections of a map along a track, and those of a Lanelet2 map."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from crosscue.datasets.truth.lanelet2 import read_map
from crosscue.datasets.truth.lanes import MAX_STEPS
from crosscue.datasets.truth.road_map import Ahead, RoadMap, approaches_along
from crosscue.replay.errors import AnnotationError
from support.street_map import (
    LANE_M,
    MIDDLE,
    Bound,
    ahead_of,
    crossing_lanes,
    joined_lane,
    roads_of,
    straight_lane,
    write_lanelets,
    write_map,
)
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


def _turned(
    lanelets: Mapping[str, tuple[Bound, Bound, str]], turn_rad: float
) -> dict[str, tuple[Bound, Bound, str]]:
    c, s = np.cos(turn_rad), np.sin(turn_rad)

    def moved(bound: Bound) -> Bound:
        return [(c * x - s * y, s * x + c * y) for x, y in bound]

    return {k: (moved(left), moved(right), said) for k, (left, right, said) in lanelets.items()}


def _ahead_on_lane(
    roads: RoadMap, x_m: float, y_m: float = -1.75, turn_rad: float = 0.0
) -> Ahead | None:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return ahead_of(roads, c * x_m - s * y_m, s * x_m + c * y_m, turn_rad)


def _exits(roads: RoadMap, ahead: Ahead) -> set[str]:
    return {side for side, legs in roads.legs(ahead).items() if any(leg.is_out for leg in legs)}


@pytest.mark.parametrize("turn_deg", [0.0, 37.0, 215.0])
@pytest.mark.parametrize("reversed_bounds", [False, True])
def test_distances_are_those_to_the_kerbs_of_the_crossroad(
    tmp_path: Path, turn_deg: float, reversed_bounds: bool
) -> None:
    turn_rad = np.radians(turn_deg)
    lanelets = _turned(crossing_lanes(), turn_rad)
    roads = roads_of(write_lanelets(tmp_path / "a.osm", lanelets, reversed_bounds=reversed_bounds))

    ahead = _ahead_on_lane(roads, 10.0, turn_rad=turn_rad)

    assert ahead is not None
    assert [ahead.start_m, ahead.end_m] == pytest.approx([50.0, 57.0], abs=0.3)
    assert _exits(roads, ahead) == {"left", "right", "straight", "back"}


def test_an_approach_goes_on_past_the_stop_line_to_the_kerb(tmp_path: Path) -> None:
    roads = roads_of(write_lanelets(tmp_path / "a.osm", crossing_lanes()))
    x_m = np.arange(40.25, 70.0, 0.5)

    found = roads.along(np.column_stack([x_m, np.full(len(x_m), -1.75)]), np.zeros(len(x_m)))

    start_m = [x + one.start_m for x, one in zip(x_m.tolist(), found, strict=True) if one]
    assert start_m == pytest.approx([60.0] * 40, abs=0.3)


def test_an_arm_counts_where_the_map_ends_at_its_mouth(tmp_path: Path) -> None:
    cut = {key: lane for key, lane in crossing_lanes().items() if not key.startswith("n-")}
    roads = roads_of(write_lanelets(tmp_path / "a.osm", cut))

    ahead = _ahead_on_lane(roads, 10.0)

    assert ahead is not None
    assert [ahead.start_m, ahead.end_m] == pytest.approx([50.0, 57.0], abs=0.3)
    assert "left" in _exits(roads, ahead)


def test_control_is_that_of_the_lane(tmp_path: Path) -> None:
    rules = {"light": ("traffic_light", "w-in"), "sign": ("stop", "e-in")}
    roads = roads_of(write_lanelets(tmp_path / "a.osm", crossing_lanes(), rules))
    east = ahead_of(roads, 100.0, 1.75, np.pi)
    south = ahead_of(roads, MIDDLE + 1.75, -40.0, np.pi / 2.0)

    controls = [
        one.control for one in (_ahead_on_lane(roads, 30.0), east, south) if one is not None
    ]

    assert controls == ["traffic_light", "stop_sign", None]


def test_lanes_with_a_turn_direction_are_inside_and_their_rules_count_before(
    tmp_path: Path,
) -> None:
    turns = {
        k: (left, right, "turn_direction=straight" if k == "w-e" else said)
        for k, (left, right, said) in crossing_lanes().items()
        if k not in ("s-n", "n-s")
    }
    rules = {"light": ("traffic_light", "w-e")}
    roads = roads_of(write_lanelets(tmp_path / "a.osm", turns, rules))

    ahead = _ahead_on_lane(roads, 30.0)

    assert ahead is not None
    assert ahead.control == "traffic_light"
    assert ahead.start_m == pytest.approx(30.0, abs=0.3)


def _wide(a: tuple[float, float], b: tuple[float, float]) -> tuple[Bound, Bound]:
    (x0, y0), (x1, y1) = a, b
    length = np.hypot(x1 - x0, y1 - y0)
    x, y = -LANE_M * (y1 - y0) / length, LANE_M * (x1 - x0) / length
    return [(x0 + x, y0 + y), (x1 + x, y1 + y)], [(x0 - x, y0 - y), (x1 - x, y1 - y)]


def test_one_wide_lane_each_way_has_its_side_road_where_it_meets(tmp_path: Path) -> None:
    west, east = _wide((-80.0, 0.0), (55.0, 0.0)), _wide((72.0, 0.0), (160.0, 0.0))
    north = _wide((63.5, 5.0), (63.5, 60.0))
    lanelets = {"w": west, "e": east, "n": north, "w-e": joined_lane(west, east)}
    lanelets |= {
        "w-n": joined_lane(west, north),
        "n-e": joined_lane((north[0][::-1], north[1][::-1]), east),
    }
    # From the north to the east the bounds change sides.
    lanelets["n-e"] = [north[1][0], east[0][0]], [north[0][0], east[1][0]]
    told = {key: (*bounds, "one_way=no") for key, bounds in lanelets.items()}
    roads = roads_of(write_lanelets(tmp_path / "a.osm", told))

    ahead = _ahead_on_lane(roads, 0.0, y_m=0.0)

    assert ahead is not None
    assert [ahead.start_m, ahead.end_m] == pytest.approx([60.0, 67.0], abs=0.3)
    assert _exits(roads, ahead) == {"left", "straight", "back"}
    westward = ahead_of(roads, 120.0, 0.0, np.pi)
    assert westward is not None
    assert _exits(roads, westward) == {"right", "straight", "back"}


STREET = {
    f"w{part}": (*straight_lane((-80.0 + 80.0 * part, 0.0), (80.0 * part, 0.0)), "")
    for part in range(3)
}


@pytest.mark.parametrize("height_m", [0.0, 6.0])
def test_a_bridge_is_no_intersection(tmp_path: Path, height_m: float) -> None:
    over = {
        f"s{part}": (*straight_lane((20.0, -120.0 + 80.0 * part), (20.0, -40.0 + 80.0 * part)), "")
        for part in range(3)
    }
    heights_m = dict.fromkeys(over, height_m)
    path = write_lanelets(tmp_path / "a.osm", {**STREET, **over}, heights_m=heights_m)

    assert (_ahead_on_lane(roads_of(path), -30.0) is None) is (height_m > 0.0)


@pytest.mark.parametrize("tags", ["", "subtype=walkway", "participant:bicycle=yes"])
def test_a_crossing_for_people_is_no_intersection(tmp_path: Path, tags: str) -> None:
    over = {"over": (*straight_lane((30.0, -9.0), (30.0, 9.0)), tags)}
    roads = roads_of(write_lanelets(tmp_path / "a.osm", STREET | over))

    assert _ahead_on_lane(roads, -10.0) is None


@pytest.mark.parametrize("height", ["nan", "inf", "1e300", "high"])
def test_height_that_is_none_is_refused_in_one_line(tmp_path: Path, height: str) -> None:
    path = write_lanelets(tmp_path / "a.osm", crossing_lanes())
    path.write_text(path.read_text().replace("v='0.0'", f"v='{height}'"))
    with pytest.raises(AnnotationError, match=r"a.osm: node \d+: ele .*expected metres"):
        read_map(path)


def test_a_lane_around_the_earth_takes_no_more_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = {"far": (*straight_lane((0.0, 0.0), (5e6, 0.0)), "")}
    path = write_lanelets(tmp_path / "a.osm", far)
    (road,) = roads_of(path).roads
    assert len(road.nodes) == MAX_STEPS + 1

    monkeypatch.setattr("crosscue.datasets.truth.lanelet2.MAX_POINTS", 100)
    with pytest.raises(
        AnnotationError, match=r"a.osm: lanes of over .* km; cut the map to the drive"
    ):
        roads_of(path)
