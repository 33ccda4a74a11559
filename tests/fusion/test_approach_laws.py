"""Laws of approaches for any evidence; a standing car gains evidence of a static thing once."""

import itertools
import math
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
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.fusion import (
    Calibrated,
    Combined,
    CueChain,
    Fade,
    Fusion,
    RangeFilter,
    Rates,
    Temporal,
)
from support.fusion import SECOND_NS, other_side

SOURCE = Fusion()
RATED = Fusion(
    kind="calibrated",
    calibrated=Calibrated(
        rates=tuple(
            Rates(cue=name, feature=feature, near=near, if_there=0.6, if_not=0.1)
            for name, cue in SOURCE.cues.items()
            for feature in cue.supports
            for near in (False, True)
        )
    ),
)
BOTH = pytest.mark.parametrize("fusion", [SOURCE, RATED], ids=["source", "calibrated"])
FEW_EXAMPLES = settings(max_examples=40, deadline=None)

number = st.floats(-20.0, 20.0) | st.sampled_from([math.nan, math.inf, -math.inf, 1e300, 0.0])
signs = st.builds(SignRange, st.sampled_from(Reference), number | st.floats(0.0, 160.0), number)
any_frame = st.builds(
    FrameEvidence,
    st.integers(0, 400).map(lambda i: i * SECOND_NS // 10),
    st.none() | number,
    number,
    st.lists(signs, max_size=3).map(tuple),
    st.dictionaries(st.sampled_from([*CUES]), st.integers(0, 4)),
    is_new_picture=st.booleans(),
    turned_rad=st.none() | number,
)
drives = st.lists(any_frame, max_size=40)
in_order = drives.map(lambda some: sorted(some, key=lambda one: one.t_ns))


def run(drive: list[FrameEvidence], fusion: Fusion) -> tuple[list[Step], Approaches]:
    loop = Approaches(graph_of(fusion), fusion, RangeFilter())
    return [loop(one) for one in drive], loop


@BOTH
@FEW_EXAMPLES
@given(drives)
def test_probabilities_and_ranges_are_always_valid(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    for step in run(drive, fusion)[0]:
        assert all(0.0 < p < 1.0 for p in step.probabilities.values())
        assert all(math.isfinite(row.range_m) and row.var_m2 > 0.0 for row in step.ranges)
        assert bool(step.probabilities) == (step.approach is not None)


@BOTH
@FEW_EXAMPLES
@given(drives)
def test_every_frame_and_approach_is_accounted_for(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    steps, loop = run(drive, fusion)
    loop.finish()
    counts = loop.counts

    closed = sum(n for what, n in counts.items() if what.startswith("approaches closed"))
    assert closed == counts["approaches opened"]
    refused = sum(n for what, n in counts.items() if what.startswith("evidence refused"))
    latest = list(itertools.accumulate((one.t_ns for one in drive), max))
    assert len(drive) - refused == len(set(latest))
    numbers = [step.approach for step in steps if step.approach is not None]
    assert sorted(set(numbers)) == list(range(1, counts["approaches opened"] + 1))
    assert numbers == sorted(numbers)


@BOTH
@FEW_EXAMPLES
@given(in_order)
def test_shifting_all_timestamps_does_not_change_results(
    fusion: Fusion, drive: list[FrameEvidence]
) -> None:
    later = [replace(one, t_ns=one.t_ns + 1_700_000_000 * SECOND_NS) for one in drive]

    now, then = run(drive, fusion)[0], run(later, fusion)[0]

    assert [replace(step, t_ns=0) for step in now] == [replace(step, t_ns=0) for step in then]


def mirrored(one: FrameEvidence) -> FrameEvidence:
    counts = {other_side(cue): n for cue, n in one.counts.items()}
    turned_rad = None if one.turned_rad is None else -one.turned_rad
    return replace(one, counts=counts, turned_rad=turned_rad)


@BOTH
@FEW_EXAMPLES
@given(in_order)
def test_mirrored_drive_swaps_left_and_right(fusion: Fusion, drive: list[FrameEvidence]) -> None:
    steps = run(drive, fusion)[0]
    in_mirror = run([mirrored(one) for one in drive], fusion)[0]

    for step, other in zip(steps, in_mirror, strict=True):
        assert step.approach == other.approach
        assert step.ranges == other.ranges
        swapped = {other_side(name): p for name, p in step.probabilities.items()}
        assert swapped == pytest.approx(dict(other.probabilities), rel=1e-9)


@BOTH
@FEW_EXAMPLES
@given(in_order)
def test_duplicate_frames_do_not_change_results(fusion: Fusion, drive: list[FrameEvidence]) -> None:
    single = list({one.t_ns: one for one in drive}.values())
    doubled = [one for one in single for _ in range(2)]

    assert run(doubled, fusion)[0][::2] == run(single, fusion)[0]


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


def test_creeping_car_believes_what_comes_into_view_and_then_counts_each_tenth_of_a_metre() -> None:
    """Three of five frames confirm a cue, also of a car that moves 3 cm between them."""
    steps = believed([evidence((LIGHT, None, None, True, {}), 0.03)] * 9, KINDS["persistent"])

    assert [bool(one.not_believed) for one in steps] == [i in (0, 1) for i in range(9)]
    assert [one.probabilities.get("intersection") for one in steps[2:]] == pytest.approx([0.95] * 7)
