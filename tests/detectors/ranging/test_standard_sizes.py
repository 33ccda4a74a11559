"""Tests of the size priors of lights, from the box's aspect and from lights of the same make."""

import numpy as np
import pytest

from crosscue.detectors.ranging.object_tracks import SAME_MAKE, shared_size
from crosscue.detectors.ranging.standard_sizes import SizePrior, light_size


@pytest.mark.parametrize("aspect", [0.3, 1.0, 2.16, 3.05, 8.0])
def test_size_prior_covers_the_sizes_of_every_aspect(aspect: float) -> None:
    size = light_size(aspect)

    for height_m in (1.07, 1.32):
        assert abs(height_m - size.mean_m) < 2.0 * size.spread * size.mean_m


def test_shared_size_is_consistent_with_its_variance() -> None:
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
