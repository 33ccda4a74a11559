"""Ranges of objects: by height, by motion, by size, and of each object's track."""

from collections.abc import Sequence

import numpy as np
import pytest
from scipy.optimize import curve_fit

from crosscue.detectors.ranging import range_from_motion as module
from crosscue.detectors.ranging.height_to_range import FAMILIES, Family, fit_range, range_of
from crosscue.detectors.ranging.object_tracks import (
    SAME_MAKE,
    CarStep,
    Facing,
    ObjectTrack,
    ObjectTracks,
    shared_size,
)
from crosscue.detectors.ranging.range_from_motion import (
    OUTLIER,
    ROUNDS,
    HeightErrors,
    MotionRange,
    _checked,
    _weights,
    range_from_motion,
)
from crosscue.detectors.ranging.standard_sizes import SizePrior, light_size
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import RangeCurve

FOCAL_PX = 1500.0
CENTER_PX = (960.0, 540.0)
AHEAD = CarStep(1.0, 0.0, 0.0, 0.1)
# Range at the start, metres to the right and up, height.
Light = tuple[float, float, float, float]
NEAR: Light = (57.0, -5.0, 5.0, 1.3)
FAR: Light = (84.0, 0.0, 5.0, 1.0)
NEXT_TO_FAR: Light = (84.0, 4.0, 5.0, 1.5)


def tracks() -> ObjectTracks:
    return ObjectTracks("traffic_light", FOCAL_PX, CENTER_PX)


def box_of(light: Light, gone_m: float, turned_rad: float = 0.0) -> Floats:
    start_m, right_m, up_m, height_m = light
    scale = FOCAL_PX / (start_m - gone_m)
    x = CENTER_PX[0] + right_m * scale + FOCAL_PX * turned_rad
    y = CENTER_PX[1] - up_m * scale
    half = 0.5 * height_m * scale
    return np.array([x - 0.4 * half, y - half, x + 0.4 * half, y + half])


def take(
    followed: ObjectTracks, lights: Sequence[Light], gone_m: float, motion: CarStep = AHEAD
) -> Sequence[ObjectTrack]:
    boxes = np.array([box_of(one, gone_m) for one in lights]).reshape(-1, 4)
    return followed(motion, boxes, boxes[:, 3] - boxes[:, 1])


def test_several_lights_have_separate_tracks_and_ranges() -> None:
    followed = tracks()
    rng = np.random.default_rng(4)
    for gone_m in range(40):
        order = rng.permutation(3)
        now = take(followed, [(NEAR, FAR, NEXT_TO_FAR)[i] for i in order], float(gone_m))

    assert [one.seen for one in now] == [40, 40, 40]
    assert sorted(one.range_m for one in now) == pytest.approx([18.0, 45.0, 45.0], rel=0.06)
    heights = sorted(one.estimate.height_m for one in now)
    assert heights == pytest.approx([1.0, 1.3, 1.5], rel=0.06)


def test_near_light_narrows_the_size_of_a_far_one_of_the_same_make() -> None:
    near: Light = (45.0, -5.0, 5.0, 1.5)
    far: Light = (140.0, 2.0, 5.0, 1.5)
    alone, together = tracks(), tracks()
    for gone_m in range(25):
        (one,) = take(alone, [far], float(gone_m))
        both = take(together, [near, far], float(gone_m))

    true_m = 140.0 - 24.0
    shared = max(both, key=lambda track: track.range_m)
    assert abs(shared.range_m - true_m) < 0.5 * abs(one.range_m - true_m)
    assert shared.var_m2 < 0.6 * one.var_m2
    assert shared.alone == one.alone


def test_two_boxes_of_one_object_make_one_track() -> None:
    followed = tracks()
    box = box_of(FAR, 0.0)
    boxes = np.array([box, box + 1.0])

    now = followed(AHEAD, boxes, boxes[:, 3] - boxes[:, 1])

    assert len(now) == 1
    assert followed.counts["boxes of an object already found"] == 1


@pytest.mark.parametrize(
    ("lenses", "facing"),
    [
        (["red"], Facing.UNKNOWN),
        (["red", "dark", "green"], Facing.EGO),
        (["dark"] * 9, Facing.UNKNOWN),
        (["dark"] * 10, Facing.AWAY),
        (["unknown"] * 30, Facing.UNKNOWN),
        ([""] * 30, Facing.UNKNOWN),
        (["dark"] * 28 + ["red"], Facing.AWAY),
        (["dark"] * 18 + ["red"] * 2, Facing.UNKNOWN),
        (["dark"] * 8 + ["green"] * 2, Facing.EGO),
        (["yellow"] * 30, Facing.UNKNOWN),
        (["dark"] * 10 + ["yellow"] * 5, Facing.UNKNOWN),
        (["dark"] * 19 + ["yellow"], Facing.AWAY),
    ],
)
def test_facing_requires_enough_consistent_frames(lenses: list[str], facing: Facing) -> None:
    followed = tracks()
    for gone_m, lens in enumerate(lenses):
        box = box_of(FAR, float(gone_m))[None, :]
        (track,) = followed(AHEAD, box, box[:, 3] - box[:, 1], [lens])

    assert track.facing is facing


def test_range_without_odometry_relies_on_the_size_prior() -> None:
    followed = tracks()
    for gone_m in range(20):
        (track,) = take(followed, [FAR], float(gone_m), CarStep(None, 0.0, 0.0, 0.1))

    height_px = FOCAL_PX * FAR[3] / (84.0 - 19.0)
    size = light_size(2.5)
    alone_m = FOCAL_PX * size.mean_m / height_px
    assert track.seen == 20
    assert track.range_m == pytest.approx(alone_m, rel=0.1)
    assert np.sqrt(track.var_m2) == pytest.approx(size.spread * track.range_m, rel=0.2)


LIGHT = SizePrior(1.2, 0.25)
NO_ERRORS = HeightErrors(fraction=1e-5, edges_px=0.0)


def correlated_errors(travelled_m: Floats, over_m: float, rng: np.random.Generator) -> Floats:
    """Draw standard normal errors with autocorrelation exp(-distance / over_m)."""
    errors = [float(rng.normal())]
    for step_m in np.abs(np.diff(travelled_m)).tolist():
        rho = float(np.exp(-step_m / over_m))
        errors.append(rho * errors[-1] + np.sqrt(1.0 - rho * rho) * float(rng.normal()))
    return np.array(errors)


def track(
    travelled_m: Floats, rng: np.random.Generator, size: SizePrior = LIGHT
) -> tuple[Floats, float]:
    """Simulate the heights of one track, and return them with its true range at the end."""
    errors = HeightErrors()
    last_m = float(np.exp(rng.uniform(np.log(15.0), np.log(120.0))))
    height_m = np.exp(size.log_mean + np.sqrt(size.log_var) * rng.normal())
    true_px = FOCAL_PX * height_m / (last_m + travelled_m[-1] - travelled_m)
    sd = np.hypot(errors.fraction, errors.edges_px / true_px)
    return true_px * np.exp(sd * correlated_errors(travelled_m, errors.resemble_m, rng)), last_m


@pytest.mark.parametrize("height_m", [0.7, 1.2, 1.7])
@pytest.mark.parametrize("last_m", [4.0, 35.0, 90.0])
def test_track_without_errors_yields_exact_range_and_height(height_m: float, last_m: float) -> None:
    travelled_m = np.linspace(3.0, 28.0, 60)
    height_px = FOCAL_PX * height_m / (last_m + travelled_m[-1] - travelled_m)

    found = range_from_motion(travelled_m, height_px, FOCAL_PX, LIGHT, NO_ERRORS)

    assert found.mean_m == pytest.approx(last_m, rel=2e-3)
    assert found.height_m == pytest.approx(height_m, rel=2e-3)


@pytest.mark.parametrize("height_px", [300.0, 60.0, 30.0])
def test_range_of_one_observation_is_lognormal_to_rounding(height_px: float) -> None:
    """Neither the tails nor the steps of the grid show."""
    found = range_from_motion(np.zeros(1), np.array([height_px]), 1000.0, LIGHT)

    errors = HeightErrors()
    var = LIGHT.log_var + errors.fraction**2 + (errors.edges_px / height_px) ** 2
    mean_m = 1000.0 / height_px * np.exp(LIGHT.log_mean + 0.5 * var)
    assert found.mean_m == pytest.approx(mean_m, rel=1e-9)
    assert found.var_m2 == pytest.approx(mean_m**2 * np.expm1(var), rel=1e-8)
    assert found.by_motion < 1e-8


@pytest.mark.parametrize("seed", range(8))
def test_finer_and_wider_grids_change_nothing(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sizes spread so little that the greatest range cuts no distribution off."""
    rng, size = np.random.default_rng(seed), SizePrior(1.2, 0.12)
    travelled_m = np.cumsum(rng.uniform(-0.1, 1.0, 5 + 8 * seed))
    height_px, _ = track(travelled_m, rng, size)
    height_px[::6] *= 1.5
    found = range_from_motion(travelled_m, height_px, FOCAL_PX, size)

    monkeypatch.setattr(module, "STEPS", np.linspace(0.0, 1.0, 2001))
    monkeypatch.setattr(module, "REACH_SD", 12.0)

    finest = range_from_motion(travelled_m, height_px, FOCAL_PX, size)
    for name in MotionRange.__slots__:
        assert getattr(found, name) == pytest.approx(getattr(finest, name), rel=1e-8), name


@pytest.mark.parametrize("seed", range(20))
def test_scale_of_errors_by_sums_is_that_of_all_observations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 400))
    travelled_m = np.cumsum(rng.uniform(-1.0, 1.0, count) * (rng.random(count) < 0.8))
    errors = HeightErrors()
    seen = _checked(travelled_m, rng.uniform(8.0, 90.0, count), FOCAL_PX, LIGHT, errors)
    residual = 0.1 * rng.standard_cauchy(count) * (rng.random(count) < 0.9)

    squares, scale = residual**2 / seen.var, 1.0
    for _ in range(ROUNDS):
        trust = OUTLIER**2 / np.maximum(squares / scale, OUTLIER**2)
        total, of_squares = (seen.worth * trust).sum(), (seen.worth * trust * squares).sum()
        scale = (errors.worth + of_squares) / (errors.worth + max(total - 2.0, 0.0))
    trust = OUTLIER**2 / np.maximum(squares / scale, OUTLIER**2)

    expected = seen.worth * trust / (scale * seen.var)
    np.testing.assert_allclose(_weights(seen, residual, errors), expected, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(("gone_m", "step_m"), [(0.0, 0.0), (5.0, 0.3), (20.0, 0.3), (40.0, 0.7)])
def test_range_interval_has_its_nominal_coverage(gone_m: float, step_m: float) -> None:
    rng = np.random.default_rng(7)
    travelled_m = np.arange(0.0, gone_m + 1e-9, step_m) if step_m else np.zeros(10)
    pairs = [track(travelled_m, rng) for _ in range(1000)]

    found = [range_from_motion(travelled_m, px, FOCAL_PX, LIGHT) for px, _ in pairs]

    sigmas = np.array([_sigmas(one, m) for one, (_, m) in zip(found, pairs, strict=True)])
    assert 0.93 <= float(np.mean(np.abs(sigmas) < 1.96)) <= 0.97
    off = np.array([one.mean_m / m - 1.0 for one, (_, m) in zip(found, pairs, strict=True)])
    # The mean of a posterior skewed to the far side is slightly beyond its median.
    assert abs(float(np.median(off))) < 0.06
    assert abs(float(sigmas.mean())) < 0.15


def _sigmas(found: MotionRange, true_m: float) -> float:
    return float((found.mean_m - true_m) / np.sqrt(found.var_m2))


def test_range_and_variance_fall_as_the_car_approaches() -> None:
    travelled_m = np.arange(0.0, 45.0, 0.5)
    height_px = FOCAL_PX * 1.3 / (60.0 - travelled_m)

    found = [
        range_from_motion(travelled_m[:n], height_px[:n], FOCAL_PX, LIGHT) for n in range(1, 90, 4)
    ]

    assert (np.diff([one.mean_m for one in found]) < 0.0).all()
    assert (np.diff([one.var_m2 for one in found]) < 0.0).all()
    assert found[-1].mean_m == pytest.approx(60.0 - travelled_m[88], rel=0.03)


def test_outlying_box_heights_change_the_range_little() -> None:
    travelled_m = np.arange(0.0, 40.0, 0.5)
    height_px = FOCAL_PX * 1.3 / (60.0 - travelled_m)
    height_px[::7] *= 1.8

    found = range_from_motion(travelled_m, height_px, FOCAL_PX, LIGHT)

    assert found.mean_m == pytest.approx(60.0 - travelled_m[-1], rel=0.05)


@pytest.mark.parametrize(
    ("travelled_m", "height_px", "focal_px"),
    [
        ([], [], 1500.0),
        ([0.0, 1.0], [30.0], 1500.0),
        ([0.0], [0.0], 1500.0),
        ([0.0], [float("nan")], 1500.0),
        ([float("inf")], [30.0], 1500.0),
        ([0.0], [30.0], 0.0),
    ],
)
def test_invalid_observations_are_refused(
    travelled_m: list[float], height_px: list[float], focal_px: float
) -> None:
    with pytest.raises(ValueError, match="expected"):
        range_from_motion(np.array(travelled_m), np.array(height_px), focal_px, LIGHT)


TRUE: dict[Family, tuple[float, ...]] = {
    "pinhole": (1400.0,),
    "pinhole-offset": (1300.0, 1.8),
    "power": (900.0, -0.9),
}


def pairs(family: Family, seed: int, sd: float, pairs: int = 300) -> tuple[Floats, Floats]:
    """Draw heights of 12 to 400 px, and ranges of a true curve with a relative error of ``sd``."""
    rng = np.random.default_rng(seed)
    height_px = np.exp(rng.uniform(np.log(12.0), np.log(400.0), pairs))
    curve = RangeCurve(family=family, parameters=TRUE[family], residual_sd_m=1.0)
    return height_px, range_of(height_px, curve) * (1.0 + sd * rng.normal(size=pairs))


@pytest.mark.parametrize("family", FAMILIES)
def test_pairs_without_errors_recover_the_curve_exactly(family: Family) -> None:
    found = fit_range(*pairs(family, 1, 0.0), family)

    assert found.curve.parameters == pytest.approx(TRUE[family], rel=1e-6)
    assert (found.pairs, found.outliers) == (300, 0)


@pytest.mark.parametrize("family", FAMILIES)
def test_pairs_with_equal_errors_match_least_squares_without_outliers(family: Family) -> None:
    height_px, range_m = pairs(family, 2, 0.05)
    models = {
        "pinhole": lambda h, a: a / h,
        "pinhole-offset": lambda h, a, b: a / h + b,
        "power": lambda h, a, b: a * h**b,
    }
    plain, _ = curve_fit(models[family], height_px, range_m, TRUE[family])

    found = fit_range(height_px, range_m, family)

    assert found.outliers == 0
    assert found.curve.parameters == pytest.approx(tuple(plain), rel=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("family", FAMILIES)
def test_outlying_heights_are_rejected_and_counted(family: Family, seed: int) -> None:
    height_px, range_m = pairs(family, seed, 0.04)
    clean = fit_range(height_px, range_m, family)
    rng = np.random.default_rng(100 + seed)
    wrong = rng.choice(300, 45, replace=False)
    height_px[wrong] *= rng.uniform(1.8, 3.0, 45)

    found = fit_range(height_px, range_m, family)

    heights = np.array([15.0, 40.0, 150.0, 350.0])
    assert range_of(heights, found.curve) == pytest.approx(
        range_of(heights, clean.curve), rel=0.05, abs=0.5
    )
    assert 15 <= found.outliers <= 47
    assert found.pairs + found.outliers == 300
    assert found.curve.residual_sd_m < 1.3 * clean.curve.residual_sd_m


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


@pytest.mark.parametrize("height_px", [300.0, 40.0, 8.0, 2.5])
def test_one_observation_says_nothing_by_motion_at_any_range(height_px: float) -> None:
    """The variance before motion is in closed form; with one observation it is that on the grid.

    At 2.5 px the greatest range cuts the distribution off.
    """
    found = range_from_motion(np.zeros(1), np.array([height_px]), 1000.0, SizePrior(1.0, 0.2))

    assert found.by_motion == pytest.approx(0.0, abs=2e-3)
