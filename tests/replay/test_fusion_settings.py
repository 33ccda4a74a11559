"""User-defined cues and features in the vehicle file, and refused settings."""

from __future__ import annotations

import pytest

from crosscue.fusion.approaches import Approaches
from crosscue.fusion.evidence import FrameEvidence
from crosscue.fusion.factor_graph import graph_of
from crosscue.replay.errors import VehicleError
from crosscue.replay.vehicle.fusion import Fusion, usual_cues
from crosscue.replay.vehicle.vehicle import parse


def fusion_of(text: str) -> Fusion:
    return parse("version = 1\n" + text, "car.toml").fusion


def test_empty_file_uses_published_cues() -> None:
    assert fusion_of("") == Fusion(kind="persistent")
    assert fusion_of("").cues == usual_cues()


def test_setting_one_field_keeps_other_fields_of_cue() -> None:
    fusion = fusion_of("[fusion.cues]\nstop_sign = { precision = 0.99 }")

    assert fusion.cues["stop_sign"] == usual_cues()["stop_sign"].model_copy(
        update={"precision": 0.99}
    )
    assert fusion.cues["traffic_light"] == usual_cues()["traffic_light"]


def test_user_defined_cue_and_feature_are_fused() -> None:
    fusion = fusion_of(
        "[fusion]\nkind = 'source'\n[fusion.features]\nzebra = { prior = 0.2 }\n"
        "[fusion.cues]\nstripes = { precision = 0.8, supports = ['zebra'], can_start = true }"
    )
    graph = graph_of(fusion)
    approaches = Approaches(graph, fusion, parse("version = 1", "").range_filter)

    step = approaches(FrameEvidence(0, 0.0, 0.0, (), {"stripes": 1}))

    # odds of 0.2 / 0.8 times 0.8 / 0.2
    assert step.probabilities["zebra"] == pytest.approx(0.5)
    assert step.probabilities["left"] == 0.5


def test_disabled_cue_is_not_in_graph() -> None:
    graph = graph_of(fusion_of("[fusion.cues]\nlanes_past = { use = false }"))

    assert "lanes_past" not in {cue.name for cue in graph.cues}
    assert "lanes_past" not in {edge.cue for edge in graph.edges}


def test_edges_to_disabled_feature_are_removed() -> None:
    graph = graph_of(fusion_of("[fusion.features]\nstraight = { use = false }"))

    assert graph.feature_names == ("intersection", "left", "right")
    assert "straight" not in {edge.feature for edge in graph.edges}


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[fusion.cues]\nstop_sgn = { can_start = true }", r"did you mean stop_sign\?.*there"),
        (
            "[fusion.cues]\nstripes = { precision = 0.8, supports = ['strait'] }",
            r"stripes: no feature 'strait' \(did you mean straight\?\); there are: intersection",
        ),
        ("[fusion.cues]\nstripes = { precision = 0.8 }", "neither supports nor excludes"),
        (
            "[fusion.cues]\nroad_left = { excludes = ['left'] }",
            "road_left: a feature occurs twice",
        ),
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


def test_fusion_without_cue_that_can_start_is_refused() -> None:
    silent = "\n".join(
        f"{name} = {{ can_start = false }}" for name in usual_cues() if usual_cues()[name].can_start
    )
    with pytest.raises(VehicleError, match="none can start an approach"):
        fusion_of(f"[fusion.cues]\n{silent}")
