"""Layouts M: every feature is present and absent in any thirteen consecutive layouts."""

from dataclasses import replace

import numpy as np
import pytest

from crosscue.datasets.scenes.layout import CURVE_SLOPE, KINDS, mixed_layout
from crosscue.datasets.scenes.motion import conditions_of, lane_y_m
from crosscue.datasets.scenes.world import build_world

FEATURES = ("intersection", "left", "right", "straight")


@pytest.mark.parametrize("first", [0, 13, 5, 1000])
@pytest.mark.parametrize("feature", FEATURES)
def test_any_thirteen_consecutive_layouts_have_every_feature_present_and_absent(
    first: int, feature: str
) -> None:
    known = [mixed_layout(first + i).features.get(feature) for i in range(len(KINDS))]

    assert {True, False} <= set(known)


def test_curved_layout_moves_car_and_objects_with_lane() -> None:
    curved = mixed_layout(12)
    straight = replace(curved, curve_per_m=0.0)
    one, other = (
        build_world(layout, conditions_of(layout, 1), is_painted=False)
        for layout in (curved, straight)
    )
    motion = one.approach.motion

    np.testing.assert_allclose(motion.y_m - curved.aside_m(motion.x_m), lane_y_m(curved), atol=0.05)
    assert abs(motion.heading_rad[-1]) == pytest.approx(np.arctan(CURVE_SLOPE), abs=0.01)
    for bent, plain in zip(one.things, other.things, strict=True):
        at_s = max(bent.span_s[0], 0.0)
        moved = plain.at[0] + plain.shift(at_s)[0]
        aside = (bent.at[1] + bent.shift(at_s)[1]) - (plain.at[1] + plain.shift(at_s)[1])
        assert aside == pytest.approx(float(curved.aside_m(np.array(moved))), abs=1e-6)
    assert one.ground.road.sum() == pytest.approx(other.ground.road.sum(), rel=0.02)
