"""Hidden Markov model: compared with enumeration, and its invariants."""

import itertools
import math
from typing import Final

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from crosscue.fusion.approaches import Approaches
from crosscue.fusion.evidence import FrameEvidence, SignRange
from crosscue.fusion.factor_graph import CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.intersection_range import Reference
from crosscue.fusion.situation import Situation
from crosscue.fusion.temporal import (
    MeasuredRange,
    TemporalFilter,
    ranges_to_start,
    temporal_model,
    update_with,
    ways_of,
)
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.fusion import CueChain, Fade, Fusion, RangeFilter, Temporal

FILTER: Final = RangeFilter()
TEMPORAL: Final[dict[str, object]] = {"kind": "temporal"}
EMPTY: Final[dict[str, object]] = {"intercepts": {}, "positive": {}, "negative": {}}
GRAPH: Final = FactorGraph(
    (Feature("intersection", establishes=True), Feature("left", establishes=True)),
    (CueNode("sign", 0.9, can_start=True), CueNode("road", 0.7, can_start=True)),
    (Edge("sign", "intersection"), Edge("road", "left")),
)


def chain(
    cue: str,
    first: tuple[float, ...],
    stays: tuple[float, ...],
    appears: tuple[float, ...],
    there: tuple[str, ...] = (),
    missing: tuple[str, ...] = (),
) -> CueChain:
    return CueChain(
        cue=cue, there=there, missing=missing, first=first, stays=stays, appears=appears
    )


CHAINS: Final = (
    chain("sign", (0.05,), (0.6,), (0.02,)),
    chain("sign", (0.8, 0.3), (0.9, 0.8), (0.5, 0.1), ("intersection",)),
    chain("road", (0.1,), (0.5,), (0.05,)),
    chain("road", (0.7, 0.4), (0.9, 0.7), (0.4, 0.2), ("intersection", "left")),
    chain("road", (0.2, 0.1), (0.5, 0.5), (0.1, 0.05), ("intersection",), ("left",)),
)


def learned(**changes: object) -> Temporal:
    usual = {
        "ahead": 0.6,
        "ways": {"left": 0.7, "none": 0.3},
        "edges_m": (0.0, 4.0, 8.0),
        "chains": CHAINS,
        "spacing_m": 20.0,
        "behind_m": 2.0,
        "step_m": 1.5,
    }
    return Temporal.model_validate({**usual, **changes})


Frame = tuple[dict[str, int], float, list[MeasuredRange]]
# Index of a cell, and outgoing roads: left, none, or no intersection.
State = tuple[int, int]
CELLS, LEFT, NO_WAY, NOWHERE = 5, 0, 1, 2
P_WAY: Final = (0.7, 0.3)


def enumerated(about: Temporal, frames: list[Frame]) -> Floats:
    """Return the probabilities of intersection and left, summed over all paths of states."""
    states = list(itertools.product(range(CELLS), range(3)))
    total = np.zeros(3)
    for path in itertools.product(states, repeat=len(frames)):
        weight = path_weight(about, frames, path)
        way = path[-1][1]
        total += weight * np.array([1.0, way != NOWHERE, way == LEFT])
    return np.asarray(total[1:] / total[0])


def path_weight(about: Temporal, frames: list[Frame], path: tuple[State, ...]) -> float:
    cell_m, gone_m = about.cell_m, 0.0
    before: dict[str, bool] = {}
    weight = prior(about, path[0])
    for i, (counts, moved_m, ranges) in enumerate(frames):
        crossed = int((gone_m + moved_m) // cell_m) - int(gone_m // cell_m)
        gone_m += moved_m
        if i:
            weight *= transition_probability(about, path[i - 1], path[i], crossed)
        if weight == 0.0:
            return 0.0
        cell, way = path[i]
        center_m = (cell + 0.5) * cell_m - about.behind_m - gone_m % cell_m
        for cue, count in counts.items():
            p = detection_probability(about, cue, way, center_m, before.get(cue))
            weight *= (p if count else 1.0 - p) ** about.exponent
        before = {cue: count > 0 for cue, count in counts.items()}
        for one in ranges:
            var_m2 = one.var_m2 + cell_m**2 / 12.0
            normal = math.exp(-0.5 * (center_m - one.range_m) ** 2 / var_m2)
            normal /= math.sqrt(2 * math.pi * var_m2)
            weight *= (1 - about.stray) * normal + about.stray / 150.0
    return weight


def prior(about: Temporal, state: State) -> float:
    cell, way = state
    # The first cell is behind the rear axle.
    place = 1.0 / (CELLS - 1) if cell > 0 else 0.0
    return place * (1.0 - about.ahead if way == NOWHERE else about.ahead * P_WAY[way])


def transition_probability(about: Temporal, old: State, new: State, cells: int) -> float:
    assert cells in (0, 1)
    if cells == 0:
        return float(old == new)
    comes = about.cell_m / about.spacing_m
    if old[1] == NOWHERE and new[1] == NOWHERE:
        return (1.0 - comes) * (new[0] == (old[0] - 1) % CELLS)
    if old[1] == NOWHERE:
        return comes * P_WAY[new[1]] * (new[0] == CELLS - 1)
    if old[0] == 0:
        return (new[1] == NOWHERE) / CELLS
    return float(new == (old[0] - 1, old[1]))


def detection_probability(
    about: Temporal, cue: str, way: int, center_m: float, before: bool | None
) -> float:
    there = {LEFT: {"intersection", "left"}, NO_WAY: {"intersection"}, NOWHERE: set[str]()}[way]
    (one,) = (
        one
        for one in about.chains
        if one.cue == cue
        and bool(one.there or one.missing) == (way != NOWHERE)
        and there.issuperset(one.there)
        and there.isdisjoint(one.missing)
    )
    row = {None: one.first, True: one.stays, False: one.appears}[before]
    return row[0 if way == NOWHERE else int(center_m >= 4.0)]


@pytest.mark.parametrize("exponent", [1.0, 0.4])
def test_filter_equals_sum_over_all_state_paths(exponent: float) -> None:
    frames: list[Frame] = [
        ({"sign": 0, "road": 1}, 0.0, []),
        ({"road": 1}, 1.5, [MeasuredRange(4.5, 2.0)]),
        ({"sign": 2, "road": 0}, 1.5, [MeasuredRange(1.0, 1.0)]),
    ]
    about = learned(exponent=exponent)
    belief = TemporalFilter(temporal_model(GRAPH, about))

    for counts, moved_m, ranges in frames:
        belief.update(counts, ranges, moved_m, 0.0, 0.5)

    np.testing.assert_allclose(belief.probabilities(), enumerated(about, frames), rtol=1e-10)


def hand_filter(**changes: object) -> TemporalFilter:
    """Return a filter with five cells of 2 m from -2 m, with masses that can be added by hand."""
    belief = TemporalFilter(temporal_model(GRAPH, learned(**changes)))
    belief.nowhere = np.array([0.1, 0.0, 0.0, 0.0, 0.1])
    belief.ahead = np.array([[0.2, 0.1], [0.1, 0.0], [0.0, 0.1], [0.0, 0.0], [0.3, 0.0]])
    return belief


def test_prior_is_uniform_over_cells_ahead_of_the_axle() -> None:
    """Of centres at 0, 2, 4, 6 and 8 m, four are ahead: 0.4 / 4, and 0.6 / 4 * 0.75 for left."""
    about = learned(behind_m=1.0, ways={"left": 0.6, "none": 0.2})
    belief = TemporalFilter(temporal_model(GRAPH, about))

    assert belief.centers_m().tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]
    assert belief.nowhere == pytest.approx([0.0, 0.1, 0.1, 0.1, 0.1])
    assert belief.ahead[:, 0] == pytest.approx([0.0] + [0.1125] * 4)
    assert belief.ahead[:, 1] == pytest.approx([0.0] + [0.0375] * 4)
    assert belief.probabilities() == pytest.approx([0.6, 0.45])
    assert belief.distance_m() == pytest.approx(5.0)


def test_all_mass_comes_within_reach_where_intersections_are_dense() -> None:
    belief = hand_filter(spacing_m=1.0)

    belief.update({}, moved_m=2.0)

    assert belief.nowhere == pytest.approx([0.06] * 5)
    assert belief.ahead[-1] == pytest.approx([0.14, 0.06])


def test_reverse_moves_mass_away_and_furthest_cell_out_of_reach() -> None:
    """After -1 m, the remainder is +1 m; the 0.3 out of reach are spread over five cells.

    Another metre forward completes the cell, and the remainder is 0 again.
    """
    belief = hand_filter()

    belief.update({}, moved_m=-1.0)

    assert belief.nowhere == pytest.approx([0.16, 0.16, 0.06, 0.06, 0.06])
    assert belief.ahead[:, 0] == pytest.approx([0.0, 0.2, 0.1, 0.0, 0.0])
    assert belief.ahead[:, 1] == pytest.approx([0.0, 0.1, 0.0, 0.1, 0.0])
    assert belief.centers_m()[0] == -2.0
    belief.update({}, moved_m=1.0)
    assert belief.centers_m()[0] == -1.0
    belief.update({}, moved_m=-5.0)
    assert belief.centers_m()[0] == -2.0


def test_variance_of_distance_spreads_mass_over_neighbours() -> None:
    """In cells of 3 m, 2.25 m2 move 2.25 / (2 * 3^2) = 1/8 to either side; end cells keep theirs.

    9 m2 move a quarter at most, twice: the second time without further variance.
    """

    def wide_cells() -> TemporalFilter:
        return hand_filter(cell_m=3.0, edges_m=(0.0, 4.0, 13.0))

    belief = wide_cells()
    belief.update({}, moved_var_m2=2.25)

    assert belief.nowhere == pytest.approx([0.0875, 0.0125, 0.0, 0.0125, 0.0875])
    assert belief.ahead[:, 0] == pytest.approx([0.1875, 0.1, 0.0125, 0.0375, 0.2625])
    wide, step = wide_cells(), wide_cells()
    wide.update({}, moved_var_m2=9.0)
    for _ in range(2):
        wide.update({})
    for var_m2 in (4.5, 4.5):
        step.update({}, moved_var_m2=var_m2)
    assert wide.ahead == pytest.approx(step.ahead)
    assert wide.nowhere == pytest.approx([0.0625, 0.03125, 0.0125, 0.03125, 0.0625])


def test_range_weighs_cells_by_gaussian_of_range_and_cell_or_uniform_strays() -> None:
    """Cells of 3 m add 3^2 / 12 = 0.75 to 1.25 m2; centres at 0 and 3 m, and 5 % strays."""
    about = learned(edges_m=(0.0, 4.5), behind_m=1.5, cell_m=3.0, chains=())
    belief = TemporalFilter(temporal_model(GRAPH, about))
    belief.nowhere, belief.ahead = np.array([0.25, 0.25]), np.array([[0.25, 0.0], [0.25, 0.0]])

    belief.update({}, [MeasuredRange(0.0, 1.25)])

    peak, stray = 0.95 / math.sqrt(4.0 * math.pi), 0.05 / 150.0
    at, off = peak + stray, peak * math.exp(-9.0 / 4.0) + stray
    assert belief.nowhere == pytest.approx([0.5 * at / (at + off), 0.5 * off / (at + off)])
    assert belief.ahead[:, 0] == pytest.approx(belief.nowhere)


def test_cue_is_evaluated_after_a_step_of_distance_and_not_before() -> None:
    """A step is 1.5 m in either direction, here 1 m and -0.5 m, in whatever time.

    A frame in which the car stands, or that repeats a picture, leaves the step to the next one.
    """
    belief = TemporalFilter(temporal_model(GRAPH, learned()))
    belief.update({"sign": 1})
    for _ in range(2):
        before = belief.probabilities()[0]
        belief.update({"sign": 1})
        belief.update({"sign": 1}, moved_m=1.0, passed_s=60.0)
        assert belief.probabilities()[0] == pytest.approx(before)
        belief.update({"sign": 1}, moved_m=-0.5, is_standing=True)
        belief.update({"sign": 1}, is_new_picture=False)
        assert belief.probabilities()[0] == pytest.approx(before)
        belief.update({"sign": 1})
        assert belief.probabilities()[0] > before + 1e-6


MOVING: Final = FactorGraph(
    GRAPH.features,
    (
        CueNode("sign", 0.9, can_start=True),
        *(CueNode(name, 0.8, fade=Fade(time_s=2.0)) for name in ("crossing", "oncoming")),
    ),
    (Edge("sign", "intersection"), Edge("crossing", "left"), Edge("oncoming", "left")),
)


def odds_of_presence(belief: TemporalFilter) -> float:
    """Odds of an intersection, which are 0.6 / 0.4 at first."""
    p = float(belief.probabilities()[0])
    return p / (1.0 - p)


def test_moving_object_counts_where_it_first_appears_between_two_steps() -> None:
    """Cues first found, appearing and staying 4, 3 and 2 times as often at an intersection.

    The oncoming car appears 0.5 s after the step, the crossing one is not evaluated before; later
    appearances do not count, but the value of the last one is that before the next step.
    """
    chains = tuple(
        one
        for cue in ("crossing", "oncoming")
        for one in (
            chain(cue, (0.1,), (0.3,), (0.2,)),
            chain(cue, (0.4, 0.4), (0.6, 0.6), (0.6, 0.6), ("intersection",)),
        )
    )
    about = learned(chains=(*chains, *CHAINS[:2]), exponent=1.0)
    belief = TemporalFilter(temporal_model(MOVING, about))
    belief.nowhere = np.array([0.0, 0.0, 0.4, 0.0, 0.0])
    belief.ahead = np.zeros((5, 2))
    belief.ahead[2, 0] = 0.6
    expected = 1.5

    def odds_after(counts: dict[str, int], passed_s: float = 0.5, moved_m: float = 0.0) -> float:
        belief.update(counts, (), moved_m, 0.0, passed_s, is_standing=moved_m == 0.0)
        return odds_of_presence(belief)

    belief.update({"oncoming": 0})
    expected *= (1.0 - 0.4) / (1.0 - 0.1)
    assert odds_of_presence(belief) == pytest.approx(expected)
    # Not before 0.5 s, and a cue of a static object does not count at all.
    assert odds_after({"oncoming": 1}, 0.3) == pytest.approx(expected)
    expected *= 0.6 / 0.2
    assert odds_after({"oncoming": 1, "sign": 1}, 0.2) == pytest.approx(expected)
    assert odds_after({"oncoming": 2}) == pytest.approx(expected)
    assert odds_after({"oncoming": 0}) == pytest.approx(expected)
    expected *= 0.4 / 0.1
    assert odds_after({"oncoming": 1, "crossing": 1}, 0.5) == pytest.approx(expected)
    assert odds_after({"crossing": 0}, 0.4) == pytest.approx(expected)
    assert odds_after({"crossing": 0}, 0.1) == pytest.approx(expected)
    # After the step both are judged again: the one stays, the other is still absent.
    expected *= 0.6 / 0.3 * (1.0 - 0.6) / (1.0 - 0.2)
    assert odds_after({"oncoming": 1, "crossing": 0}, 0.0, 1.5) == pytest.approx(expected)
    expected *= 0.6 / 0.2
    assert odds_after({"crossing": 1}) == pytest.approx(expected)


def test_probabilities_stay_a_billionth_from_zero_and_one() -> None:
    belief = hand_filter()
    belief.ahead *= 0.0
    assert belief.probabilities().tolist() == [1e-9, 1e-9]
    belief.ahead[2] = 1.0, 0.0
    assert belief.probabilities().tolist() == [1.0 - 1e-9, 1.0 - 1e-9]


def test_unfitted_chains_are_even_and_a_model_without_chains_is_silent() -> None:
    """A cue with no chain for a state says nothing about it; without any chain, none does."""
    only = chain("road", (0.7, 0.4), (0.9, 0.7), (0.4, 0.2), ("intersection", "left"))
    (road,) = temporal_model(GRAPH, learned(chains=(only,))).chains
    silent = TemporalFilter(temporal_model(GRAPH, learned(chains=())))

    silent.update({"sign": 1, "road": 1})

    assert road.nowhere.tolist() == [0.5, 0.5, 0.5]
    assert road.ahead[:, :, 0].tolist() == [[0.7, 0.4], [0.4, 0.2], [0.9, 0.7]]
    assert road.ahead[:, :, 1].tolist() == [[0.5, 0.5]] * 3
    assert silent.probabilities() == pytest.approx(silent.model.usual)


def test_graph_without_intersection_is_refused() -> None:
    graph = FactorGraph((Feature("left"), Feature("up")), (), ())

    with pytest.raises(ValueError, match=r"^no feature 'intersection'; there are: left, up$"):
        temporal_model(graph, learned())


def test_names_of_outgoing_roads_are_joined_by_plus() -> None:
    assert (ways_of("none"), ways_of("left+right")) == ((), ("left", "right"))


@pytest.mark.parametrize(
    ("since_m", "fade_m", "expected"),
    [
        # A correlation of 1/3 doubles the variances; a light is 16 m further, with s.d. 16 / 4.
        (2.0 * math.log(3.0), 2.0, ((40.0, 8.0), (44.0, 34.0))),
        (0.0, 0.0, ((40.0, 4.0), (44.0, 25.0))),
        (0.0, 2.0, ()),
        # At a thousandth of an independent range, 2 artanh(0.001), it still counts.
        (2.0 * math.atanh(0.001), 1.0, ((40.0, 4000.0), (44.0, 9016.0))),
        (2.0 * math.atanh(0.00099), 1.0, ()),
    ],
)
def test_ranges_to_start_have_variances_of_independent_ones(
    since_m: float, fade_m: float, expected: tuple[tuple[float, float], ...]
) -> None:
    measured = {Reference.START: (40.0, 4.0), Reference.END: (60.0, 9.0)}

    found = ranges_to_start(measured, since_m, fade_m, 16.0)

    assert list(found) == [pytest.approx(one) for one in expected]


def test_filter_receives_all_of_a_situation(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[object] = []

    def update(
        _filter: TemporalFilter, *values: object, is_new_picture: bool, is_standing: bool
    ) -> None:
        seen.extend([*values, is_new_picture, is_standing])

    belief = hand_filter()
    monkeypatch.setattr(TemporalFilter, "update", update)
    ranges = ((5.0, 2.0), (6.0, 3.0))
    update_with(
        belief,
        Situation(
            {"sign": 2},
            True,
            is_new_picture=False,
            moved_m=9.0,
            passed_s=0.3,
            advanced_m=-1.5,
            advanced_var_m2=0.7,
            ranges=ranges,
            is_standing=True,
        ),
    )

    expected = [MeasuredRange(*one) for one in ranges]
    assert seen == [{"sign": 2}, expected, -1.5, 0.7, 0.3, False, True]


STEPS = st.lists(
    st.tuples(
        st.dictionaries(st.sampled_from(["sign", "road"]), st.integers(0, 2)),
        st.floats(-3.0, 6.0),
        st.floats(0.0, 9.0),
        st.lists(st.tuples(st.floats(-20.0, 160.0), st.floats(1e-3, 1e4)), max_size=2),
    ),
    max_size=25,
)


@given(STEPS)
@settings(max_examples=30)
def test_left_never_exceeds_intersection_and_mass_is_conserved(
    steps: list[tuple[dict[str, int], float, float, list[tuple[float, float]]]],
) -> None:
    belief = TemporalFilter(temporal_model(GRAPH, learned()))

    for counts, moved_m, var_m2, ranges in steps:
        belief.update(counts, [MeasuredRange(*one) for one in ranges], moved_m, var_m2, 0.1)
        intersection, left = belief.probabilities()
        assert left <= intersection
        assert belief.nowhere.sum() + belief.ahead.sum() == pytest.approx(1.0)
        assert (belief.nowhere >= 0.0).all()
        assert (belief.ahead >= 0.0).all()


def test_consistent_ranges_update_distance_but_not_presence() -> None:
    belief = TemporalFilter(temporal_model(GRAPH, learned(spacing_m=1e9)))
    before = belief.probabilities()[0]

    for _ in range(3):
        belief.update({}, [MeasuredRange(5.0, 1.0)])

    assert belief.probabilities()[0] == pytest.approx(before)
    assert belief.distance_m() == pytest.approx(5.0, abs=0.5)


def test_lapse_mixes_prior_into_probabilities() -> None:
    sure, careful = (
        TemporalFilter(temporal_model(GRAPH, learned(lapse=lapse))) for lapse in (0.0, 0.1)
    )
    for belief in (sure, careful):
        for _ in range(3):
            belief.update({"sign": 1, "road": 1}, moved_m=2.0)

    usual = careful.model.usual
    np.testing.assert_allclose(
        careful.probabilities(), 0.9 * sure.probabilities() + 0.1 * usual, rtol=1e-12
    )
    assert careful.probabilities()[1] <= careful.probabilities()[0]


def frame(number: int, sign: int, range_m: float | None = None) -> FrameEvidence:
    signs = () if range_m is None else (SignRange(Reference.START, range_m, 4.0),)
    return FrameEvidence(
        number * 200_000_000, 2.0 if number else None, 0.0, signs, {"sign": sign, "road": sign}
    )


def test_presence_is_established_with_hysteresis_and_withdrawn_without_cues() -> None:
    edges_m = (0.0, 80.0)
    chains = tuple(
        one.model_copy(
            update={name: getattr(one, name)[:1] for name in ("first", "stays", "appears")}
        )
        for one in learned().chains
    )
    about = learned(edges_m=edges_m, chains=chains)
    belief = Approaches(GRAPH, Fusion().model_copy(update=TEMPORAL | {"temporal": about}), FILTER)

    seen = [belief(frame(i, 1, 40.0 - 2.0 * i)) for i in range(6)]
    gone = [belief(frame(i, 0)) for i in range(6, 18)]

    assert seen[-1].established
    assert not gone[-1].established
    between = [step.probabilities["intersection"] for step in gone if step.established]
    assert min(between) < 0.9
    for step in (*seen, *gone):
        intersection = step.probabilities["intersection"]
        assert step.probabilities["left"] <= intersection + 1e-9
        assert intersection > 0.5 or not step.established


def test_filter_of_a_drive_receives_situations_inside_and_outside_approaches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ranges of signs that the gate takes, to the start: a light's is 16 m shorter.

    After 2 log 3 m with a fade of 2 m, half a range is independent: 4 / 0.5, and 9 / 0.5 + 4^2.
    """
    seen: list[tuple[TemporalFilter, Situation]] = []

    def record(over_drive: TemporalFilter, situation: Situation) -> None:
        seen.append((over_drive, situation))

    monkeypatch.setattr("crosscue.fusion.approaches.update_with", record)
    monkeypatch.setattr("crosscue.fusion.temporal.update_with", record)
    fusion = Fusion().model_copy(
        update=TEMPORAL | {"temporal": learned(), "length_m": 16.0, "rest_m": 0.0}
    )
    about = RangeFilter(sd_fraction=0.0, begin_after=1, fade_m=2.0, gate_nis=16.0)
    loop = Approaches(GRAPH, fusion, about)
    moved_m = 2.0 * math.log(3.0)

    def evidence(number: int, moved_m: float, *ranges: tuple[Reference, float]) -> FrameEvidence:
        variances = {Reference.START: 4.0, Reference.END: 9.0}
        signs = tuple(SignRange(ref, range_m, variances[ref]) for ref, range_m in ranges)
        return FrameEvidence(number * 10**8, moved_m, 0.5, signs, {"road": 0})

    start, end = Reference.START, Reference.END
    for one in (
        evidence(0, 0.0),
        evidence(1, 1.0, (start, 50.0), (end, 66.0)),
        evidence(2, moved_m / 2),
        evidence(3, moved_m / 2, (start, 90.0), (end, 66.0 - moved_m)),
        evidence(4, 0.0),
    ):
        loop(one)
    loop.restart()
    loop(evidence(0, 1.0, (end, 66.0)))

    assert [situation.ranges for _, situation in seen] == [
        (),
        ((50.0, 4.0), (50.0, 25.0)),
        (),
        (pytest.approx((50.0 - moved_m, 34.0)),),
        (),
        ((50.0, 25.0),),
    ]
    outside = seen[0][1]
    assert outside == Situation({"road": 0}, False)
    assert [one.is_established for _, one in seen] == [False] * 6
    assert [one.advanced_m for _, one in seen] == [0.0, 1.0, moved_m / 2, moved_m / 2, 0.0, 0.0]
    assert len({id(over_drive) for over_drive, _ in seen[:-1]}) == 1
    assert seen[-1][0] is not seen[0][0]


# Counts, distance and its variance, a sign's range with its variance, and ``is_new_picture``.
SEQUENCE = st.lists(
    st.tuples(
        st.dictionaries(st.sampled_from(["sign", "road"]), st.integers(0, 2)),
        st.floats(-1.0, 8.0),
        st.floats(0.0, 4.0),
        st.none() | st.tuples(st.floats(-10.0, 200.0), st.floats(1e-2, 1e3)),
        st.booleans(),
    ),
    min_size=1,
    max_size=40,
)


@given(SEQUENCE, st.floats(0.0, 0.2))
def test_steps_respect_probability_bounds_and_hysteresis(
    frames: list[tuple[dict[str, int], float, float, tuple[float, float] | None, bool]],
    lapse: float,
) -> None:
    fusion = Fusion().model_copy(update=TEMPORAL | {"temporal": learned(lapse=lapse)})
    belief, was, approach = Approaches(GRAPH, fusion, FILTER), False, None

    for i, (counts, way_m, var_m2, sign, is_new) in enumerate(frames):
        signs = () if sign is None else (SignRange(Reference.START, *sign),)
        step = belief(
            FrameEvidence(i * 200_000_000, way_m, var_m2, signs, counts, is_new_picture=is_new)
        )
        if step.approach != approach:
            was, approach = False, step.approach
        if step.approach is None:
            continue
        intersection = step.probabilities["intersection"]
        assert 0.0 < step.probabilities["left"] <= intersection + 1e-12 < 1.0
        # Established above 0.9, withdrawn below 0.5, and unchanged in between.
        limit = fusion.withdrawn if was else fusion.established
        if abs(intersection - limit) > 1e-9:
            assert step.established == (intersection > limit)
        was = step.established


@pytest.mark.parametrize(
    ("given_settings", "why"),
    [
        ({"kind": "temporal"}, "kind temporal needs"),
        ({"kind": "combined"}, r"kind combined needs \[fusion.temporal\]"),
        ({"combined": {**EMPTY, "positive": {"up": {}}}}, "no feature 'up'"),
        ({"combined": {**EMPTY, "negative": {"left": {"sign": 1.0}}}}, "no cue 'sign'"),
        ({"kind": "temporal", "temporal": learned(chains=()), "withdrawn": 0.95}, "to be smaller"),
        ({"temporal": learned()}, "no cue 'sign'"),
    ],
)
def test_invalid_fusion_settings_are_refused(given_settings: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        Fusion.model_validate(given_settings)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"edges_m": (0.0, 8.0, 4.0)}, "ascending"),
        ({"edges_m": (0.0, 4.0)}, "expected 1 entries, got 2"),
        ({"ways": {}}, "at least one"),
    ],
)
def test_inconsistent_temporal_model_is_refused(changes: dict[str, object], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        learned(**changes)
