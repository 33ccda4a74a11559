"""The fit of messages and of their fades, with numbers worked out by hand."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from crosscue.fusion.factor_graph import USUAL_FADE, CueNode, Edge, FactorGraph, Feature
from crosscue.fusion.fit.annotated_approach import AnnotatedApproach
from crosscue.fusion.fit.fade_fit import (
    TIMES_S,
    WAYS_M,
    Binned,
    FadeFit,
    _binned,
    _integral,
    _line,
    _residuals,
    fit_fade,
)
from crosscue.fusion.fit.message_fit import Side, _exponents, _rate, fit_messages, log_odds_of
from crosscue.replay.vehicle.fusion import Calibrated, Fade, Rates

ROAD = CueNode("road", 0.7, can_start=True)
ARROW = CueNode("arrow", 0.9)
GRAPH = FactorGraph(
    (Feature("left"), Feature("up", prior=0.8)),
    (ROAD, ARROW),
    (Edge("road", "left"), Edge("arrow", "up")),
)
LOG_2, LOG_3 = math.log(2.0), math.log(3.0)


def approach(
    road: Sequence[int],
    way_m: Sequence[float] | None = None,
    *,
    place: str = "a",
    near: Sequence[bool] | None = None,
    left: bool | None = True,
    up: bool | None = None,
    arrow: Sequence[int] | None = None,
    established: Sequence[bool] | None = None,
    time_s: Sequence[float] | None = None,
) -> AnnotatedApproach:
    """Return an approach, by default established, far, and with steps of 10 log 3 m."""
    n = len(road)
    features = {name: value for name, value in (("left", left), ("up", up)) if value is not None}
    counts = {"road": road} | ({} if arrow is None else {"arrow": arrow})
    return AnnotatedApproach(
        np.array([10.0 * LOG_3 * i for i in range(n)] if way_m is None else way_m, np.float64),
        np.zeros(n) if time_s is None else np.array(time_s, np.float64),
        np.array([False] * n if near is None else near, np.bool_),
        np.array([True] * n if established is None else established, np.bool_),
        {name: np.array(column, np.int64) for name, column in counts.items()},
        features,
        place,
    )


def test_observations_are_evaluated_frames_in_which_cue_may_speak() -> None:
    some = approach([-1, 0, 2, 0], arrow=[-1, 0, 2, 0], established=[True, False, True, True])

    assert some.observed(ROAD).tolist() == [1, 2, 3]
    assert some.observed(ARROW).tolist() == [2, 3]
    assert some.observed(CueNode("unknown", 0.9)).tolist() == []


LEFT_PLACES = [
    approach([1, 1, 1], place="a", near=[False, False, True]),
    approach([1], place="b"),
    approach([0], place="b"),
    approach([0, 1], place="c"),
]
OTHER_PLACES = [
    approach([0, 0], place="d", left=False),
    approach([0, -1], place="e", left=False),
    approach([1, 0], place="f", left=False),
]
UNKNOWN = approach([1, 1, 1], place="g", left=None)


def assert_side(
    found: Side, rates: tuple[float, ...], frames: int, observations: float, hits: float
) -> None:
    assert found.rates == pytest.approx(rates)
    assert found[1:] == pytest.approx((frames, observations, hits))


def test_rates_weigh_frames_by_independence_and_places_equally() -> None:
    """The second of two frames with a correlation of 1/3 counts half.

    With the feature, the places have rates of 1.5 / 1.5, 1 / 2 (two approaches) and 0.5 / 1.5;
    without it 0, 0 and 1 / 1.5. One place of the pooled rate (11/6 + 2/3 + 1/2) / (6 + 1) = 3/7 is
    added to either side: (11/6 + 3/7) / 4 = 95/168, and (2/3 + 3/7) / 4 = 23/84.
    """
    some = [*LEFT_PLACES, *OTHER_PLACES, UNKNOWN]

    far = _rate(some, ROAD, "left", False, USUAL_FADE)
    near = _rate(some, ROAD, "left", True, USUAL_FADE)

    assert_side(far.there, (1.0, 0.5, 1 / 3), 6, 5.0, 3.0)
    assert far.there.places == 3
    assert_side(far.missing, (0.0, 0.0, 2 / 3), 5, 4.0, 1.0)
    assert far.rates is not None
    assert (far.rates.if_there, far.rates.if_not) == pytest.approx((95 / 168, 23 / 84))
    assert (far.rates.cue, far.rates.feature, far.rates.near) == ("road", "left", False)
    assert (near.cue, near.feature, near.near, near.rates) == ("road", "left", True, None)
    assert_side(near.there, (1.0,), 1, 0.5, 0.5)
    assert_side(near.missing, (), 0, 0.0, 0.0)


@pytest.mark.parametrize("left_out", ["a", "d", "c"])
def test_rate_needs_three_places_of_either_kind_and_three_positive_ones(left_out: str) -> None:
    """Without a or d, one kind has two places. Without a road at c and f, two are positive."""
    some = [*LEFT_PLACES, *OTHER_PLACES]
    if left_out == "c":
        silent = [replace(one, counts={"road": one.counts["road"] * 0}) for one in some]
        some = [new if new.place in "cf" else old for old, new in zip(some, silent, strict=True)]
    else:
        some = [one for one in some if one.place != left_out]

    assert _rate(some, ROAD, "left", False, USUAL_FADE).rates is None


def test_frames_count_by_time_where_fade_is_a_time() -> None:
    """A frame counts half 2 log 3 s after another, and not at all at the same time.

    A place where nothing counts has no rate.
    """
    timed = approach([1, 0, 1], time_s=[0.0, 2.0 * LOG_3, 2.0 * LOG_3])
    still = approach([1, 1], [0.0, 99.0], place="b", near=[False, True])

    far = _rate([timed, still], ROAD, "left", False, Fade(time_s=2.0))
    near = _rate([timed, still], ROAD, "left", True, Fade(time_s=2.0))

    assert_side(far.there, (1 / 1.5, 1.0), 4, 2.5, 2.0)
    assert_side(near.there, (), 1, 0, 0)


def test_exponent_minimises_log_loss_of_places_with_log_normal_prior() -> None:
    """Rates of 0.8 and 0.2 send +-log 4; three places are right and three are wrong.

    The derivative of 3 log(1 + 4^-e) + 3 log(1 + 4^e) + log(e)^2 / 2 is 3 log 4 tanh(e log 2) +
    log(e) / e, which is 0 at e = 1/2: 6 log 2 / 3 - 2 log 2. A place counts once, whatever its
    approaches and frames.
    For ``up``, the prior 0.8 is log 4 and a message of log(0.05 / 0.8) = -4 log 2 cancels it at
    e = 1/2. Four places with it and three without have a derivative of 4 log 2 (4 - 3) / 2 =
    2 log 2, which the prior's -2 log 2 cancels.
    """
    rates = [Rates(cue="road", feature="left", near=False, if_there=0.8, if_not=0.2)]
    rates.append(Rates(cue="arrow", feature="up", near=False, if_there=0.05, if_not=0.8))
    still = approach([1, 1, 1], [0.0, 0.0, 0.0], place="a", left=True)
    lefts = [still, still, *(approach([n], place=p) for n, p in ((1, "b"), (0, "c")))]
    others = [approach([n], place=p, left=False) for n, p in ((0, "d"), (1, "e"), (1, "f"))]
    ups = [approach([0], place=p, left=None, up=p in "klmn", arrow=[1]) for p in "klmnopq"]
    empty = approach([], place="r", left=False, up=False)
    learned = Calibrated(rates=tuple(rates))

    assert _exponents([*lefts, *others, *ups, empty], GRAPH, learned) == {"left": 0.5, "up": 0.5}
    assert _exponents([*lefts, *others[:2], *ups, empty], GRAPH, learned) == {"up": 0.5}


def test_log_odds_of_approach_are_sums_of_its_messages() -> None:
    """+log 6, a frame without the cue, and log 11/6 after two steps of half the fade's log 3."""
    rates = tuple(
        Rates(cue="road", feature="left", near=near, if_there=there, if_not=0.1)
        for near, there in ((False, 0.6), (True, 0.9))
    )
    learned = Calibrated(rates=rates, fades={"road": Fade(way_m=20.0)})
    timed = learned.model_copy(update={"fades": {"road": Fade(time_s=2.0)}})
    seconds = [5.0, 5.0 + LOG_3, 5.0 + 2.0 * LOG_3]
    some = approach([2, -1, 1], time_s=seconds, established=[False, False, True])

    for parameters in (learned, timed):
        found = log_odds_of(some, GRAPH, parameters)
        expected = np.cumsum([math.log(6.0), 0.0, math.log(11 / 6)])
        np.testing.assert_allclose(found[:, 0], expected)
        assert not found[:, 1].any()
    near = log_odds_of(approach([1], near=[True]), GRAPH, learned)
    np.testing.assert_allclose(near, [[math.log(9.0), 0.0]])
    assert log_odds_of(approach([]), GRAPH, learned).shape == (0, 2)


def markov_approaches(step: float, *, is_time: bool) -> list[AnnotatedApproach]:
    """Return 32 approaches of three frames whose value has a correlation of 1/2 after a step.

    9 of 32 are +++, 3 ++-, 1 +-+ and 3 +--, and as many are their opposites. 16 more have two
    frames at one place, which agree.
    """
    patterns = [((1, 1, 1), 9), ((1, 1, 0), 3), ((1, 0, 1), 1), ((1, 0, 0), 3)]
    rows = [list(p) for p, many in patterns for _ in range(many)] + [[1, 1]] * 8
    still = np.full(3, 7.0)
    found = []
    for values in (*rows, *([1 - n for n in row] for row in rows)):
        moved = np.array([7.0, 7.0 + step, 7.0 + 2.0 * step] if len(values) == 3 else [7.0, 7.0])
        way_m, time_s = (still[: len(values)], moved) if is_time else (moved, still[: len(values)])
        found.append(approach(values, way_m.tolist(), time_s=time_s.tolist()))
    return found


@pytest.mark.parametrize("is_time", [False, True])
def test_fade_is_integral_of_correlation_over_an_approach(is_time: bool) -> None:
    """The correlation is 1 at 0, 1/2 at s log 2, and 1/4 at s log 4: exp(-distance / s).

    32 approaches of s log 4 and 16 of 0 have a mean of (4/3) s log 2, over which the integral is
    s (1 - 2^(-4/3)). 128 observations are positive half of the time.
    """
    scale = float((TIMES_S if is_time else WAYS_M)[20])
    some = markov_approaches(scale * LOG_2, is_time=is_time)

    found = fit_fade([approach([-1], place="empty"), *some], GRAPH, ROAD)

    length = scale * (1.0 - 2.0 ** (-4 / 3))
    fade = (found.fade.way_m, found.fade.time_s)
    assert fade == pytest.approx((None, length) if is_time else (length, None))
    assert (found.cue, found.positives, found.observations) == ("road", 64, 128)
    assert found.is_learned


def test_fade_needs_twenty_positives_and_negatives_too() -> None:
    pair = approach([1, 0])
    always = approach([1] * 40)
    lone = [approach([n]) for n in (0, 1)]
    for some, positives, observations, is_learned in (
        ([pair] * 19, 19, 38, False),
        ([pair] * 20, 20, 40, True),
        ([always], 40, 40, False),
        (lone * 20, 20, 40, False),
    ):
        found = fit_fade(some, GRAPH, ROAD)
        assert found == FadeFit("road", found.fade, positives, observations, is_learned)
        # Alternating values have no positive correlation, and the distance is as good as the time.
        assert found.fade == (Fade(way_m=float(WAYS_M[0])) if is_learned else USUAL_FADE)


def test_residuals_are_from_rate_of_same_features_and_distance() -> None:
    """Left and far, 2 of 3 are positive; left and near, 1 of 1; without left, 1 of 2."""
    some = [
        approach([1, 0, 1], near=[False, False, True]),
        approach([-1, 2]),
        approach([0, 1], left=False),
        approach([-1]),
    ]

    found = _residuals(some, GRAPH, ROAD)

    assert [rows.tolist() for rows, _ in found] == [[0, 1, 2], [1], [0, 1], []]
    for (_, residual), expected in zip(
        found, ([1 / 3, -2 / 3, 0.0], [1 / 3], [-0.5, 0.5], []), strict=True
    ):
        assert residual == pytest.approx(expected)


def test_equal_distances_share_a_bin_and_bins_have_equal_numbers() -> None:
    few = _binned(np.array([3.0, 1.0, 5.0, 1.0]), np.array([0.5, 0.2, 0.1, 0.4]))
    many = _binned(np.arange(120.0), np.ones(120))

    assert few.pairs.tolist() == [2.0, 1.0, 1.0]
    assert few.distance.tolist() == [1.0, 3.0, 5.0]
    assert few.correlation == pytest.approx([0.3, 0.5, 0.1])
    # Edges at multiples of 119 / 60: 0 and 1 are below the first, and 119 is the last edge.
    assert (len(many.pairs), many.pairs.sum(), many.pairs.max()) == (61, 120.0, 2.0)
    assert (many.pairs[0], many.pairs[-1]) == (2.0, 1.0)


@pytest.mark.parametrize(
    ("shape", "correlation", "pairs", "line"),
    [
        # Means 3/8 and 7/20, slope (3/32) / (11/64) = 6/11, and 7/20 - 3/8 * 6/11 = 8/55.
        ((1.0, 0.5, 0.0), (0.8, 0.2, 0.2), (1.0, 1.0, 2.0), (8 / 55, 6 / 11)),
        # 0.1 - 0.5 * 0.8 is negative, so the line goes through zero: 0.55 / 1.25.
        ((1.0, 0.5), (0.5, 0.1), (1.0, 1.0), (0.0, 0.44)),
        ((1.0, 0.0), (0.2, 0.6), (1.0, 1.0), (0.6, 0.0)),
        ((1.0, 0.0), (2.0, 2.0), (1.0, 1.0), (1.0, 0.0)),
        ((1.0, 0.0), (1.5, 0.0), (1.0, 1.0), (0.0, 1.0)),
        # Without any spread of distances, the mean is constant.
        ((0.5, 0.5), (0.2, 0.4), (1.0, 1.0), (0.3, 0.0)),
    ],
)
def test_correlation_is_fitted_by_a_line_within_bounds(
    shape: tuple[float, ...],
    correlation: tuple[float, ...],
    pairs: tuple[float, ...],
    line: tuple[float, float],
) -> None:
    binned = Binned(np.array(pairs), np.empty(0), np.array(correlation))

    assert _line(np.array(shape), binned) == pytest.approx(line)


def test_integral_of_best_curve_has_constant_and_fading_part() -> None:
    """1/4 + 1/2 exp(-d / 2) at 0, 2 log 2 and 2 log 4 is 3/4, 1/2 and 3/8.

    Over 2 log 2 the integral is log 2 / 2 + 1/2 * 2 * 1/2, and the squared error up to a constant
    is -(9/16 + 2/4 + 3 * 9/64). A curve of zero has the shortest scale.
    """
    distance, pairs = np.array([0.0, 2.0 * LOG_2, 4.0 * LOG_2]), np.array([1.0, 2.0, 3.0])
    scales = np.array([0.5, 2.0, 4.0])
    curve = Binned(pairs, distance, np.array([0.75, 0.5, 0.375]))
    none = Binned(pairs, distance, np.zeros(3))

    found = _integral(curve, scales, 2.0 * LOG_2)

    assert found == pytest.approx((0.5 * LOG_2 + 0.5, -95 / 64))
    assert _integral(none, scales, 9.0) == (0.5, 0.0)


def test_fit_of_messages_combines_fades_rates_and_exponents() -> None:
    """Three places of either kind: the road is always positive with it, and never without it.

    The pooled rate (3 + 0.5) / 7 = 1/2 makes the rates 3.5 / 4 and 0.5 / 4.
    """
    rows = [(list("abc"), True, 1), (list("def"), False, 0)]
    some = [
        approach([value, value], place=place, left=left)
        for places, left, value in rows
        for place in places
    ]

    few, many = fit_messages(some, GRAPH), fit_messages(some * 7, GRAPH)
    mixed = fit_messages(markov_approaches(LOG_2, is_time=False), GRAPH)

    rates = Rates(cue="road", feature="left", near=False, if_there=0.875, if_not=0.125)
    assert few.calibrated.rates == (rates,)
    assert few.calibrated.exponents == {"left": 1.0}
    assert (few.calibrated.fades, few.approaches, many.approaches) == ({}, 6, 42)
    assert [(one.cue, one.feature, one.near) for one in few.rates] == [
        ("road", "left", False),
        ("road", "left", True),
        ("arrow", "up", False),
        ("arrow", "up", True),
    ]
    assert [one.cue for one in few.fades] == ["road", "arrow"]
    assert many.calibrated.rates == (rates,)
    assert mixed.calibrated.fades == {"road": mixed.fades[0].fade}
    assert mixed.fades[0].is_learned
