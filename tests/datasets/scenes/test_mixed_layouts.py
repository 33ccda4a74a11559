"""Layouts M: every feature is there and not there wherever twelve follow one another."""

import pytest

from crosscue.datasets.scenes.conditions import conditions_of
from crosscue.datasets.scenes.layout import (
    KINDS,
    TABLE_6,
    any_layout,
    layout_named,
    mixed_kind,
    mixed_layout,
)

FEATURES = ("intersection", "left", "right", "straight")


@pytest.mark.parametrize("first", [0, 12, 5, 1000])
@pytest.mark.parametrize("feature", FEATURES)
def test_any_twelve_in_a_row_have_every_feature_with_both_values(first: int, feature: str) -> None:
    known = [mixed_layout(first + i).features.get(feature) for i in range(len(KINDS))]

    assert {True, False} <= set(known)


def test_a_road_without_an_intersection_has_no_control_and_no_sign_of_one() -> None:
    roads = [mixed_layout(seed) for seed in range(120) if not mixed_layout(seed).is_intersection]

    kinds = {mixed_kind(int(road.name[1:])) for road in roads}
    assert kinds == {"straight", "bend", "driveways", "lot"}
    for road in roads:
        assert (road.control, road.one_way, road.do_not_enter) == ("none", None, False)


def test_published_and_training_layouts_are_all_intersections() -> None:
    assert all(layout.is_intersection for layout in TABLE_6.values())
    assert all(any_layout(seed).is_intersection for seed in range(200))


def test_a_name_stands_for_the_same_layout_every_time_and_no_two_are_alike() -> None:
    layouts = [layout_named(f"M{seed}") for seed in range(120)]

    assert layouts == [mixed_layout(seed) for seed in range(120)]
    assert len({layout.half_width_m for layout in layouts}) == 120


def test_two_runs_of_a_layout_differ_in_light_or_weather_traffic_and_speed() -> None:
    first, second = (conditions_of(mixed_layout(3), run) for run in (1, 2))

    assert first.light != second.light
    assert first.traffic != second.traffic
    assert first.speed_mps != second.speed_mps
