"""Size priors of lights, from the aspect of the box and from others of the same make."""

import numpy as np
import pytest

from crosscue.detectors.ranging.object_tracks import SAME_MAKE, shared_size
from crosscue.detectors.ranging.standard_sizes import (
    HOUSINGS,
    STOP_SIGN,
    SizePrior,
    light_size,
    size_of,
)


def test_the_proportions_are_of_all_lights() -> None:
    assert sum(one.proportion for one in HOUSINGS.values()) == pytest.approx(1.0)


def test_a_light_twice_as_high_as_wide_has_a_backplate_and_one_three_times_has_none() -> None:
    with_plate, bare, unknown = light_size(2.1), light_size(3.0), light_size()

    assert with_plate.mean_m == pytest.approx(1.27, abs=0.05)
    assert bare.mean_m == pytest.approx(1.07, abs=0.05)
    assert bare.mean_m < unknown.mean_m < with_plate.mean_m
    assert with_plate.spread < unknown.spread


@pytest.mark.parametrize("aspect", [0.3, 1.0, 2.16, 3.05, 8.0])
def test_the_spread_holds_the_sizes_that_such_a_box_may_be_of(aspect: float) -> None:
    size = light_size(aspect)

    for height_m in (1.07, 1.32):
        assert abs(height_m - size.mean_m) < 2.0 * size.spread * size.mean_m


def test_a_shape_that_is_of_no_light_says_nothing() -> None:
    assert light_size(0.2).mean_m == pytest.approx(light_size().mean_m, rel=1e-6)


def test_a_sign_has_one_size_whatever_its_box() -> None:
    assert size_of("stop_sign", 2.0) == size_of("stop_sign") == STOP_SIGN
    assert size_of("traffic_light", 2.0) == light_size(2.0)


def test_others_of_a_make_narrow_a_size_as_much_as_they_are_worth() -> None:
    size = light_size(2.1)
    alone = shared_size(size, [])
    unsure = shared_size(size, [(0.2, 0.5)])
    sure = shared_size(size, [(0.2, 1e-6)])

    assert alone.mean_m == pytest.approx(size.mean_m)
    assert alone.spread == pytest.approx(size.spread)
    assert size.mean_m < unsure.mean_m < sure.mean_m
    assert unsure.spread > sure.spread > SAME_MAKE
    assert np.log(sure.mean_m / size.mean_m) == pytest.approx(0.2, abs=0.05)


def test_a_size_given_others_is_off_by_as_much_as_it_says() -> None:
    rng = np.random.default_rng(11)
    size = SizePrior(1.27, 0.14)
    own_var = SAME_MAKE**2
    sigmas = []
    for _ in range(4000):
        common = rng.normal(0.0, np.sqrt(size.log_var - own_var))
        true = size.log_mean + common + rng.normal(0.0, SAME_MAKE)
        others = []
        for var in rng.uniform(0.001, 0.05, int(rng.integers(1, 5))):
            off = common + rng.normal(0.0, SAME_MAKE) + rng.normal(0.0, np.sqrt(var))
            others.append((float(off), float(var)))
        found = shared_size(size, others)
        sigmas.append((true - found.log_mean) / np.sqrt(found.log_var))

    assert float(np.mean(sigmas)) == pytest.approx(0.0, abs=0.06)
    assert float(np.mean(np.square(sigmas))) == pytest.approx(1.0, abs=0.1)
