"""Simulated traffic on the left is a mirror image, wherever the simulator names a side."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
import pytest

from crosscue.datasets.scenes.layout import Layout, Side, layout_named
from crosscue.datasets.scenes.mobileye import lane_lines_m
from crosscue.datasets.scenes.motion import approach, conditions_of, lane_y_m
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.settings import SceneSettings, scene_vehicle_text
from crosscue.datasets.scenes.world import SceneObject, build_world
from crosscue.datasets.simulate import Approaches
from crosscue.replay.vehicle.vehicle import parse

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
