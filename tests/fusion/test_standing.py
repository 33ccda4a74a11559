"""A standing car gains evidence of a static thing once, however long it stands."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from crosscue.fusion.approaches import Approaches, Step
from crosscue.fusion.evidence import FrameEvidence, RangePosterior, SignRange
from crosscue.fusion.factor_graph import graph_of
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Fusion, RangeFilter, Rates
from crosscue.replay.vehicle.temporal import Combined, CueChain, Temporal
from support.fusion import NONE_SEEN

STATIC: Final = ("traffic_light", "stop_sign", "road_left", "parked_left", "one_way_left")
FRAME_NS: Final = 100_000_000


def chain(cue: str, rate: float, there: tuple[str, ...] = ()) -> CueChain:
    """Return a cue with the same rate at all distances, which stays more often."""
    stays = (1.0 + rate) / 2.0
    return CueChain(cue=cue, there=there, first=(rate,), stays=(stays,), appears=(rate / 2.0,))


TEMPORAL: Final = Temporal(
    ahead=0.5,
    ways={"left": 0.5, "none": 0.5},
    edges_m=(0.0, 60.0),
    chains=(
        *(chain(cue, 0.1) for cue in (*STATIC, "cross_traffic_left")),
        *(chain(cue, 0.3, ("intersection",)) for cue in (*STATIC, "cross_traffic_left")),
        chain("cross_traffic_left", 0.5, ("intersection", "left")),
    ),
    exponent=0.5,
)
CALIBRATED: Final = Calibrated(
    rates=tuple(
        Rates(cue=cue, feature=feature, near=near, if_there=0.6, if_not=0.2)
        for cue, feature in (("traffic_light", "intersection"), ("road_left", "left"))
        for near in (False, True)
    )
)
COMBINED: Final = Combined(
    intercepts={"intersection": -0.5},
    positive={"intersection": {"traffic_light": 1.0}, "left": {"road_left": 1.0}},
    negative={"intersection": {"traffic_light": -0.3}, "left": {"road_left": -0.3}},
)
KINDS: Final = {
    "persistent": Fusion(kind="persistent"),
    "calibrated": Fusion(kind="calibrated", calibrated=CALIBRATED),
    "temporal": Fusion(kind="temporal", temporal=TEMPORAL),
    "combined": Fusion(kind="combined", temporal=TEMPORAL, combined=COMBINED),
}
LIGHT: Final = {**dict.fromkeys(STATIC, 0), "traffic_light": 1}

# What one frame shows: counts, a sign's range, a range from motion, whether it is new, and the
# weights of its cues.
Look = tuple[Mapping[str, int], SignRange | None, RangePosterior | None, bool, Mapping[str, float]]

RANGES_M: Final = st.floats(-5.0, 160.0)
REFERENCES: Final = st.sampled_from([*Reference])
LOOKS_OF_RANGES: Final = (
    st.none() | st.builds(SignRange, REFERENCES, RANGES_M, st.floats(0.1, 50.0)),
    st.none() | st.builds(RangePosterior, REFERENCES, RANGES_M, st.floats(0.1, 50.0), RANGES_M),
    st.booleans(),
    st.dictionaries(st.just("road_left"), st.floats(0.9, 4.0)),
)
LOOKS: Final = st.tuples(
    st.dictionaries(st.sampled_from(STATIC), st.integers(0, 2)), *LOOKS_OF_RANGES
)
MOVES: Final = st.tuples(LOOKS, st.floats(-1.0, 6.0) | st.floats(0.0, 0.09), st.floats(0.0, 9.0))


def evidence(
    look: Look, moved_m: float = 0.0, var_m2: float = 0.0, turned_rad: float = 0.0
) -> FrameEvidence:
    counts, sign, posterior, is_new, weights = look
    signs = () if sign is None else (sign,)
    posteriors = () if posterior is None else (posterior,)
    return FrameEvidence(
        0,
        moved_m,
        var_m2,
        signs,
        counts,
        is_new_picture=is_new,
        turned_rad=turned_rad,
        posteriors=posteriors,
        weights=weights,
        roads_ahead={cue: weight > 2.0 for cue, weight in weights.items()},
    )


def believed(frames: Sequence[FrameEvidence], fusion: Fusion) -> list[Step]:
    loop = Approaches(graph_of(fusion), fusion, RangeFilter())
    return [loop(replace(frame, t_ns=i * FRAME_NS)) for i, frame in enumerate(frames)]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40)
@given(
    moves=st.lists(MOVES, min_size=2, max_size=12),
    at=st.integers(1, 12),
    pause=st.lists(LOOKS, min_size=1, max_size=4),
    times=st.integers(10, 100),
)
@example(
    moves=[((LIGHT, None, None, True, {}), 2.0, 0.0)] * 6,
    at=3,
    pause=[(dict.fromkeys(STATIC, 0), None, None, True, {})],
    times=600,
)
def test_length_of_a_pause_changes_nothing(
    kind: str, moves: list[tuple[Look, float, float]], at: int, pause: list[Look], times: int
) -> None:
    """What comes into view counts once. Odometry may be uncertain, and the gyro may drift."""
    drive = [evidence(*move) for move in moves]
    standing = [evidence(look, 0.0, 1e-3, 0.01) for look in pause]

    short, long = (
        believed([*drive[:at], *standing * n, *drive[at:]], KINDS[kind])[at:][n * len(pause) :]
        for n in (10, times)
    )

    assert_same(long, short)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=40)
@given(
    moves=st.lists(st.floats(0.2, 6.0), min_size=5, max_size=12),
    pause=st.lists(st.tuples(st.just(LIGHT), *LOOKS_OF_RANGES), min_size=1, max_size=4),
    times=st.integers(1, 100),
)
def test_pause_in_which_nothing_new_is_seen_changes_nothing(
    kind: str, moves: list[float], pause: list[Look], times: int
) -> None:
    drive = [evidence((LIGHT, None, None, True, {}), moved_m) for moved_m in [*moves, 1.0, 1.0]]
    standing = [evidence(look, 0.0, 1e-3, 0.01) for look in pause] * times

    without = believed(drive, KINDS[kind])[len(moves) :]
    after = believed([*drive[:-2], *standing, *drive[-2:]], KINDS[kind])[-2:]

    assert_same(after, without)


def assert_same(steps: Sequence[Step], others: Sequence[Step]) -> None:
    assert [one.approach for one in steps] == [one.approach for one in others]
    assert [one.established for one in steps] == [one.established for one in others]
    for one, other in zip(steps, others, strict=True):
        assert one.probabilities == pytest.approx(other.probabilities, abs=1e-9)
        assert [(row.range_m, row.var_m2) for row in one.ranges] == [
            pytest.approx((row.range_m, row.var_m2), rel=1e-9) for row in other.ranges
        ]


@pytest.mark.parametrize("kind", KINDS)
def test_light_is_believed_as_long_as_a_car_stands_before_it(kind: str) -> None:
    """Also if it stands from the first picture on, and the light is found later than that."""
    dark = {**LIGHT, "traffic_light": 0}
    for late in (0, 1, 20):
        looks = [*[dark] * late, *[LIGHT] * 100]
        steps = believed([evidence((look, None, None, True, {})) for look in looks], KINDS[kind])

        if kind in ("temporal", "combined") and late:
            continue  # Its filter judges static cues by distance only.
        least = 0.5 if kind in ("temporal", "combined") else 0.6
        assert steps[late + 5].probabilities["intersection"] > least
        for one in steps[late + 6 :]:
            assert one.probabilities == pytest.approx(steps[late + 5].probabilities)
        assert {**steps[-1].counts} == LIGHT


@pytest.mark.parametrize("cue", ["traffic_light", "road_left"])
def test_static_cue_whose_errors_fade_over_time_counts_once_while_standing(cue: str) -> None:
    fades = {cue: Fade(time_s=0.5)}
    fusion = Fusion(kind="calibrated", calibrated=CALIBRATED.model_copy(update={"fades": fades}))
    look: Look = ({**LIGHT, cue: 1}, None, None, True, {})
    drive, standing = [evidence(look, 2.0)] * 4, [evidence(look)] * 50

    steps = believed([*drive, *standing], fusion)

    assert_same(steps[-1:], steps[len(drive) : len(drive) + 1])


def left_while_standing(seen: Sequence[int], kind: str = "temporal") -> list[float]:
    """Return the belief in left, at two frames per second, after a light opened an approach."""
    light = [evidence((LIGHT, None, None, True, {}), 2.0)] * 3
    cars = [
        evidence(({**NONE_SEEN, "cross_traffic_left": count}, None, None, True, {}))
        for count in seen
    ]
    loop = Approaches(graph_of(KINDS[kind]), KINDS[kind], RangeFilter())
    steps = [loop(replace(one, t_ns=i * 5 * FRAME_NS)) for i, one in enumerate([*light, *cars])]
    return [one.probabilities["left"] for one in steps[len(light) :]]


def test_cross_traffic_counts_when_it_appears_and_once_while_standing() -> None:
    """Neither how long a car is seen, nor how often, nor for how long none is, changes anything."""
    none, car, last = left_while_standing([0] * 50), left_while_standing([0, 1]), [0, 1, 1, 0, 1]

    assert none == pytest.approx([none[0]] * 50)
    assert car[1] > car[0] + 0.01
    assert left_while_standing(last * 10)[1:] == pytest.approx([car[1]] * 49)


def test_cross_traffic_is_judged_again_after_the_next_step_of_distance() -> None:
    """Each standstill has its own first appearance."""
    loop = Approaches(graph_of(KINDS["temporal"]), KINDS["temporal"], RangeFilter())
    seen = [(0, 2.0), (1, 0.0), (0, 2.0), (1, 0.0), (1, 0.0)]
    frames = [
        evidence(({**LIGHT, "cross_traffic_left": count}, None, None, True, {}), moved_m)
        for count, moved_m in seen
    ]
    steps = [loop(replace(one, t_ns=i * 5 * FRAME_NS)) for i, one in enumerate(frames)]

    left = [one.probabilities["left"] for one in steps]
    assert left[1] > left[0] + 0.01
    assert left[3] > left[2] + 0.01
    assert left[4] == pytest.approx(left[3])


def test_creeping_car_believes_what_comes_into_view_and_then_counts_each_tenth_of_a_metre() -> None:
    """Three of five frames confirm a cue, also of a car that moves 3 cm between them."""
    steps = believed([evidence((LIGHT, None, None, True, {}), 0.03)] * 9, KINDS["persistent"])

    assert [bool(one.not_believed) for one in steps] == [i in (0, 1) for i in range(9)]
    assert [one.probabilities.get("intersection") for one in steps[2:]] == pytest.approx([0.95] * 7)
