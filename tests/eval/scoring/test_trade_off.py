"""Full detection against false features, over all thresholds."""

import numpy as np
import pytest

from crosscue.eval.scoring.scene.detection import CONFIRM_FRAMES, held
from crosscue.eval.scoring.scene.trade import Reached, reached, trade_off

PRESENT, ABSENT = ("intersection", "left"), ("right",)


@pytest.mark.parametrize("seed", range(5))
def test_thresholds_agree_with_detection_at_each_threshold(seed: int) -> None:
    rng = np.random.default_rng(seed)
    features = {name: rng.random(20) for name in (*PRESENT, *ABSENT)}
    sure = rng.random(20) < 0.3
    found = reached(features, PRESENT, ABSENT, sure)

    assert found.full is not None
    so_far = np.maximum.accumulate(np.max([*features.values()], axis=0))
    for threshold in np.linspace(0.0, 1.0, 41):
        is_sure = (features["intersection"] > threshold) | (sure & (so_far > threshold))
        above = is_sure & (features["left"] > threshold)
        is_full = bool(held(above, CONFIRM_FRAMES).any())
        # Where presence is established, the intersection counts as what established it.
        assert is_full == (found.full > threshold)
        assert bool((features["right"] > threshold).any()) == (found.false[0] > threshold)


def test_established_presence_counts_alike_where_it_is_right_and_where_it_is_wrong() -> None:
    rising = {"intersection": np.linspace(0.1, 0.6, 6), "left": np.array([0, 0, 0.9, 0, 0, 0])}
    sure = np.arange(6) >= 3

    assert reached(rising, ("intersection",), (), sure) == Reached(0.9, ())
    assert reached(rising, (), ("intersection",), sure) == Reached(None, (0.9,))
    assert reached(rising, (), ("intersection",), np.zeros(6, np.bool_)) == Reached(None, (0.6,))


def test_each_rate_has_the_lowest_threshold_that_keeps_to_it() -> None:
    some = [Reached(0.1 * i, (0.1 * i - 0.05,)) for i in range(1, 11)]
    some += [Reached(None, (0.02,))] * 10
    none, half, all_ = trade_off(some, np.arange(20), (0.0, 0.25, 2.0))

    assert (none.false_features, half.false_features, all_.false_features) == (0.0, 0.25, 1.0)
    assert none.threshold == pytest.approx(0.95)
    assert none.full.value == pytest.approx(0.1)
    assert half.full.value == pytest.approx(0.6)
    assert all_.full.value == pytest.approx(1.0)
    assert half.full.of == 10


def test_belief_that_ranks_equally_has_the_same_curve() -> None:
    """Only the ranking counts: raising a threshold is no merit of the belief."""
    rng = np.random.default_rng(1)
    plain = [Reached(full, (p,)) for full, p in rng.random((40, 2)).tolist()]
    bold = [Reached((one.full or 0.0) ** 0.1, (one.false[0] ** 0.1,)) for one in plain]

    for one, other in zip(*(trade_off(x, np.arange(40)) for x in (plain, bold)), strict=True):
        assert (one.full, one.false_features) == (other.full, other.false_features)


def test_short_or_missing_belief_is_never_full() -> None:
    assert reached({}, PRESENT, ABSENT, np.zeros(0, np.bool_)) == Reached(-1.0, (0.0,))
    assert reached({"left": np.ones(9)}, PRESENT, ABSENT, np.zeros(9, np.bool_)).full == -1.0
    assert reached({"right": np.ones(1)}, (), ABSENT, np.zeros(1, np.bool_)).full is None
