"""User-defined cues and features in the vehicle file, and refused settings."""

from __future__ import annotations

import pytest

from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.fusion import Fusion
from crosscue.replay.vehicle.vehicle import parse


def fusion_of(text: str) -> Fusion:
    return parse("version = 1\n" + text, "car.toml").fusion


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[fusion.cues]\nstop_sgn = { can_start = true }", r"did you mean stop_sign\?.*there"),
        (
            "[fusion.cues]\nstripes = { precision = 0.8, supports = ['strait'] }",
            r"stripes: no feature 'strait' \(did you mean straight\?\); there are: intersection",
        ),
        ("[fusion.cues]\nstripes = { precision = 0.8 }", "neither supports nor excludes"),
        ("[fusion.cues]\nroad_left = { excludes = ['left'] }", "road_left: a feature occurs twice"),
        ("[fusion.cues]\nroad_left = { precision = 1.0 }", "precision: .*less than 1"),
        ("[fusion.cues]\nroad_left = { precission = 0.5 }", "precission: no such key"),
        ("[fusion.cues]\nroad_left = 0.5", "road_left: "),
        ("[fusion]\ncues = 3", "fusion.cues"),
        ("[fusion.features]\nestablished = {}", "established: a column of the belief table"),
        ("[fusion.features]\n'Big Road' = {}", "pattern"),
        (
            "[fusion.features]\nleft = { use = false }\nright = { use = false }\n"
            "intersection = { use = false }",
            "none establishes presence",
        ),
        ("[fusion]\nreference = 'middle'", "reference"),
        ("[fusion]\nkind = 'best'", "kind"),
    ],
)
def test_invalid_fusion_setting_is_refused_with_hint(text: str, match: str) -> None:
    with pytest.raises(VehicleError, match=match):
        fusion_of(text)
