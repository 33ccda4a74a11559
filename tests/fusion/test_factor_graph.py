"""Messages and marginals compared with the equation, with enumeration, and with a library."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.fusion.belief import (
    Belief,
    begin,
    establish,
    multiply,
    probabilities,
    published_message_model,
)
from crosscue.fusion.factor_graph import (
    CueNode,
    Edge,
    FactorGraph,
    Feature,
    graph_of,
    log_odds,
    probability,
)
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.fusion import Fade, Fusion
from support.fusion import graphs, graphs_with_counts, other_side, situation

FEW_EXAMPLES = settings(max_examples=60, deadline=None)
DEFAULT_GRAPH = graph_of(Fusion())
DISSENT = 0.49


def probabilities_after(
    graph: FactorGraph, frames: Iterable[Mapping[str, int]], *, near: bool = False
) -> dict[str, float]:
    """Return the probabilities of an established approach after the frames."""
    model = published_message_model(graph, DISSENT)
    belief = begin(graph)
    for counts in frames:
        belief = multiply(belief, model(situation(counts, near=near)))
    return probabilities(belief, graph)


def enumerated(graph: FactorGraph, frames: Sequence[Mapping[str, int]]) -> dict[str, float]:
    """Return the marginals by weighting every assignment of all features, without log odds."""
    names = graph.feature_names
    weights: dict[tuple[bool, ...], float] = {}
    for truth in itertools.product((False, True), repeat=len(names)):
        is_there = dict(zip(names, truth, strict=True))
        weight = math.prod(f.prior if is_there[f.name] else 1.0 - f.prior for f in graph.features)
        for cue, edge, times in sent_messages(graph, frames):
            is_agreed = is_there[edge.feature] == edge.is_direct
            weight *= (cue.precision if is_agreed else 1.0 - cue.precision) ** times
        weights[truth] = weight
    total = sum(weights.values())
    return {
        name: sum(w for truth, w in weights.items() if truth[i]) / total
        for i, name in enumerate(names)
    }


def sent_messages(
    graph: FactorGraph, frames: Iterable[Mapping[str, int]]
) -> Iterable[tuple[CueNode, Edge, int]]:
    """Yield each edge's cue, the edge, and its number of messages in each frame."""
    cues = {cue.name: cue for cue in graph.cues}
    for counts in frames:
        for edge in graph.edges:
            cue, count = cues[edge.cue], counts.get(edge.cue, 0)
            if count:
                yield cue, edge, count if cue.per_detection else 1


@FEW_EXAMPLES
@given(graphs_with_counts())
def test_marginals_equal_enumeration_of_all_assignments(
    case: tuple[FactorGraph, list[dict[str, int]]],
) -> None:
    graph, frames = case

    assert probabilities_after(graph, frames) == pytest.approx(
        enumerated(graph, frames), rel=1e-9, abs=1e-12
    )


def test_order_of_frames_does_not_matter_at_saturation() -> None:
    for_it, against = [{"stop_sign": 1}] * 500, [{"do_not_enter": 1}] * 500
    graph = FactorGraph(
        (Feature("intersection"),),
        (CueNode("stop_sign", 0.97), CueNode("do_not_enter", 0.95)),
        (Edge("stop_sign", "intersection"), Edge("do_not_enter", "intersection", False)),
    )

    there, back = (
        probabilities_after(graph, for_it + against),
        probabilities_after(graph, against + for_it),
    )

    assert there["intersection"] == back["intersection"] > 0.5


@FEW_EXAMPLES
@given(graphs_with_counts(), st.integers(0, 5))
def test_unobserved_or_absent_cues_change_nothing_far_from_intersection(
    case: tuple[FactorGraph, list[dict[str, int]]], idle: int
) -> None:
    graph, frames = case
    nothing: list[dict[str, int]] = [{}, {cue.name: 0 for cue in graph.cues}]

    assert probabilities_after(graph, [*frames, *nothing * idle]) == probabilities_after(
        graph, frames
    )


@FEW_EXAMPLES
@given(graphs(), st.integers(1, 100_000), st.booleans())
def test_probabilities_stay_in_open_interval_for_any_number_of_messages(
    graph: FactorGraph, many: int, near: bool
) -> None:
    for counts in ({c.name: many for c in graph.cues}, {c.name: 0 for c in graph.cues}):
        now = probabilities_after(graph, [counts] * 20, near=near)
        assert all(0.0 < p < 1.0 for p in now.values())


@given(st.floats(allow_nan=False))
def test_probability_of_any_log_odds_lies_in_open_interval(odds: float) -> None:
    assert 0.0 < probability(odds) < 1.0


@given(st.floats(1e-12, 1.0 - 1e-12))
def test_probability_inverts_log_odds(p: float) -> None:
    assert probability(log_odds(p)) == pytest.approx(p, rel=1e-9)


def test_log_odds_of_three_quarters_are_log_three() -> None:
    assert log_odds(0.75) == pytest.approx(math.log(3.0))
    assert probability(math.log(3.0)) == pytest.approx(0.75)


@pytest.mark.parametrize("bad", [0.0, 1.0, -0.1, math.nan])
def test_log_odds_refuse_probability_outside_open_interval(bad: float) -> None:
    with pytest.raises(ValueError, match=rf"^probability: expected inside \(0, 1\), got {bad}$"):
        log_odds(bad)


def test_probability_is_limited_at_log_odds_of_thirty() -> None:
    assert probability(1e9) == pytest.approx(1.0 / (1.0 + math.exp(-30.0)), abs=1e-16)
    assert probability(-1e9) == pytest.approx(1.0 / (1.0 + math.exp(30.0)), abs=1e-16)


@FEW_EXAMPLES
@given(
    st.lists(st.dictionaries(st.sampled_from([*CUES]), st.integers(0, 3)), max_size=6),
    st.booleans(),
)
def test_mirrored_cues_swap_left_and_right(frames: list[dict[str, int]], near: bool) -> None:
    mirrored = [{other_side(cue): n for cue, n in counts.items()} for counts in frames]

    seen = probabilities_after(DEFAULT_GRAPH, frames, near=near)
    seen_in_mirror = probabilities_after(DEFAULT_GRAPH, mirrored, near=near)

    assert {other_side(name): p for name, p in seen.items()} == pytest.approx(seen_in_mirror)


def test_eq_18_is_normalised_product_of_messages() -> None:
    # Two parked cars and one road: 0.83^2 * 0.77 against 0.17^2 * 0.23.
    yes, no = 0.83**2 * 0.77, 0.17**2 * 0.23

    now = probabilities_after(DEFAULT_GRAPH, [{"parked_left": 2, "road_left": 1}])

    assert now["left"] == pytest.approx(yes / (yes + no))
    assert now["right"] == pytest.approx(0.5)


def test_counted_cue_sends_one_message_per_detection_others_one_per_frame() -> None:
    twice = probabilities_after(DEFAULT_GRAPH, [{"parked_left": 1, "stop_sign": 1}] * 2)
    at_once = probabilities_after(DEFAULT_GRAPH, [{"parked_left": 2, "stop_sign": 2}])

    assert at_once["left"] == pytest.approx(twice["left"])
    assert at_once["intersection"] == pytest.approx(0.97)
    assert twice["intersection"] > 0.99


def test_exclusive_edge_sends_inverted_message() -> None:
    now = probabilities_after(DEFAULT_GRAPH, [{"one_way_right": 1, "do_not_enter": 1}])

    assert now["left"] == pytest.approx(0.05)
    assert now["right"] == pytest.approx(0.95)
    assert now["straight"] == pytest.approx(0.05)


def test_absent_direction_cues_dissent_near_intersection_but_signs_do_not() -> None:
    absent = probabilities_after(DEFAULT_GRAPH, [dict.fromkeys(CUES, 0)], near=True)

    three = 0.49**3 / (0.49**3 + 0.51**3)
    assert absent == pytest.approx(
        {"intersection": 0.5, "left": three, "right": three, "straight": three}
    )


def test_only_four_cues_send_messages_before_presence_is_established() -> None:
    model = published_message_model(DEFAULT_GRAPH, DISSENT)

    # A map is no cue of the source.
    published = [name for name, cue in CUES.items() if cue.group != "map"]
    sending = {cue for cue in published if any(model(situation({cue: 1}, established=False)))}

    assert sending == {"traffic_light", "stop_sign", "road_left", "road_right"}


@pytest.mark.parametrize(
    ("odds", "was", "withdrawn", "expected"),
    [
        # Established above 0.9; log(0.9 / 0.1) is 2.1972, and equality is not above.
        ((log_odds(0.9), 0, 0, 0), False, None, False),
        ((2.2, 0, 0, 0), False, None, True),
        ((0, 2.2, 0, 0), False, None, True),
        ((0, 0, 2.2, 0), False, None, True),
        ((0, 0, 0, 9), False, None, False),
        # Never withdrawn by default; else at 0.5 or below, that is at log odds of 0.
        ((-5, -5, -5, -5), True, None, True),
        ((0.1, -5, -5, 9), True, 0.5, True),
        ((0, 0, 0, 9), True, 0.5, False),
        ((0.1, 0, 0, 0), False, 0.5, False),
    ],
)
def test_presence_is_established_by_intersection_left_or_right(
    odds: tuple[float, float, float, float], was: bool, withdrawn: float | None, expected: bool
) -> None:
    after = establish(Belief(odds, was), DEFAULT_GRAPH, 0.9, withdrawn)

    assert after == Belief(odds, expected)


def test_default_graph_has_three_components_as_published() -> None:
    parts = [{name} for name in DEFAULT_GRAPH.feature_names]
    for cue in DEFAULT_GRAPH.cues:
        ends = {edge.feature for edge in DEFAULT_GRAPH.edges if edge.cue == cue.name}
        touched = [part for part in parts if part & ends]
        parts = [part for part in parts if not part & ends] + [set().union(*touched)]

    assert sorted(map(sorted, parts)) == [["intersection"], ["left", "right"], ["straight"]]


def test_graph_is_that_of_the_vehicle_file_without_unused_entries() -> None:
    cue = {"precision": 0.8, "supports": ("left", "up"), "excludes": ("right",)}
    options = {"can_start": True, "per_detection": True, "absence_counts": True}
    persistence = {"seen_frames": 2, "of_frames": 7, "within_m": 30.0, "fade": {"time_s": 4.0}}
    settings = Fusion.model_validate(
        {
            "features": {"up": {"prior": 0.2, "establishes": True}, "left": {"use": False}},
            "cues": {"zebra": cue | options | persistence, "stop_sign": {"use": False}},
        }
    )

    graph = graph_of(settings)

    names = ("intersection", "right", "straight", "up")
    assert graph.feature_names == names
    assert graph.features[-1] == Feature("up", 0.2, True)
    assert {node.name for node in graph.cues} == {*CUES, "zebra"} - {"stop_sign"}
    fade = Fade(time_s=4.0)
    assert graph.cues[-1] == CueNode("zebra", 0.8, True, True, True, 2, 7, 30.0, fade)
    assert [edge for edge in graph.edges if edge.cue == "zebra"] == [
        Edge("zebra", "up"),
        Edge("zebra", "right", False),
    ]


def test_graph_without_cue_drops_only_that_cue() -> None:
    less = DEFAULT_GRAPH.without("stop_sign")

    assert {c.name for c in DEFAULT_GRAPH.cues} - {c.name for c in less.cues} == {"stop_sign"}
    assert {e.cue for e in DEFAULT_GRAPH.edges} - {e.cue for e in less.edges} == {"stop_sign"}
    assert probabilities_after(less, [{"stop_sign": 1, "road_left": 1}])["intersection"] == 0.5
    there_are = ", ".join(node.name for node in DEFAULT_GRAPH.cues)
    with pytest.raises(ValueError, match=f"^no cue 'stop_sgn'; there are: {there_are}$"):
        DEFAULT_GRAPH.without("stop_sgn")
