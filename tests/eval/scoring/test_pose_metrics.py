"""Pose metrics satisfy invariants, and equal those of evo."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.datasets.truth.tum import Trajectory, planar
from crosscue.eval.scoring import consistency as chi_square
from crosscue.eval.scoring.pose.errors import (
    Coverage,
    Paired,
    align,
    ape,
    pair_poses,
    product,
    rotate,
    rpe,
    squared_errors,
    statistics,
    summarise_nees,
)
from crosscue.replay.columns import Floats
from crosscue.replay.errors import UsageError

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from evo.core import metrics
    from evo.core.trajectory import PoseTrajectory3D
    from evo.core.units import Unit

SEEDS = st.integers(0, 10_000)


def random_walk(seed: int, n: int = 60, flat: bool = False) -> Trajectory:
    """Generate a random trajectory with ten poses per second."""
    rng = np.random.default_rng(seed)
    xyz = np.cumsum(rng.normal(0.4, 1.0, (n, 3)), axis=0)
    t_ns = np.arange(n, dtype=np.int64) * 100_000_000
    if flat:
        heading = np.cumsum(rng.normal(0.0, 0.2, n))
        return planar(t_ns, xyz[:, 0], xyz[:, 1], heading)
    quat = rng.normal(size=(n, 4))
    return Trajectory(t_ns, xyz, quat / np.linalg.norm(quat, axis=1, keepdims=True))


def with_errors(truth: Trajectory, seed: int, sd_m: float = 0.5, sd_rad: float = 0.1) -> Trajectory:
    """Add small errors to each pose, and one rigid transform to all."""
    rng = np.random.default_rng(seed)
    n = len(truth)
    half = rng.normal(0.0, sd_rad / 2, (n, 3))
    wobble = np.column_stack([np.ones(n), half])
    wobble /= np.linalg.norm(wobble, axis=1, keepdims=True)
    turn = rng.normal(size=4)
    turn /= np.linalg.norm(turn)
    xyz = rotate(turn, truth.xyz_m + rng.normal(0.0, sd_m, (n, 3))) + rng.normal(0.0, 9.0, 3)
    return Trajectory(truth.t_ns, xyz, product(turn, product(truth.quat_wxyz, wobble)))


def to_evo(trajectory: Trajectory) -> Any:
    return PoseTrajectory3D(
        trajectory.xyz_m.copy(), trajectory.quat_wxyz.copy(), trajectory.t_ns * 1e-9
    )


def evo_errors(metric: Any, truth: Any, estimate: Any) -> tuple[Floats, dict[str, float]]:
    metric.process_data((truth, estimate))
    return metric.error, metric.get_all_statistics()


@given(seed=SEEDS)
@settings(max_examples=25)
def test_ape_equals_evo(seed: int) -> None:
    truth = random_walk(seed)
    estimate = with_errors(truth, seed + 1)
    ours = ape(truth, estimate)
    for relation, errors in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, ours.rotation_rad),
    ):
        theirs, numbers = evo_errors(metrics.APE(relation), to_evo(truth), to_evo(estimate))
        np.testing.assert_allclose(errors, theirs, rtol=0, atol=1e-9)
        stats = statistics(errors)
        for name, number in numbers.items():
            assert getattr(stats, name) == pytest.approx(number, rel=1e-9, abs=1e-9)


@given(seed=SEEDS, size_m=st.floats(0.5, 30.0), is_stationary=st.booleans())
@settings(max_examples=40)
def test_rpe_equals_evo(seed: int, size_m: float, is_stationary: bool) -> None:
    truth = random_walk(seed)
    if is_stationary:
        twice = np.repeat(np.arange(len(truth)), 2)
        t_ns = np.arange(len(twice), dtype=np.int64) * 50_000_000
        truth = Trajectory(t_ns, truth.xyz_m[twice], truth.quat_wxyz[twice])
    estimate = with_errors(truth, seed + 1, sd_m=0.0 if is_stationary else 0.5)
    ours = rpe(truth, estimate, size_m)
    for relation, errors in (
        (metrics.PoseRelation.translation_part, ours.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, ours.rotation_rad),
    ):
        metric = metrics.RPE(relation, size_m, Unit.meters, all_pairs=False)
        theirs, numbers = evo_errors(metric, to_evo(truth), to_evo(estimate))
        np.testing.assert_allclose(errors, theirs, rtol=0, atol=1e-9)
        assert statistics(errors).rmse == pytest.approx(numbers["rmse"], abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=25)
def test_alignment_equals_evo(seed: int) -> None:
    truth = random_walk(seed)
    estimate = with_errors(truth, seed + 1)
    theirs, ours = to_evo(estimate), align(truth, estimate, "origin")
    theirs.align_origin(to_evo(truth))
    np.testing.assert_allclose(ours.xyz_m, theirs.positions_xyz, rtol=0, atol=1e-9)
    made = ape(truth, ours)
    for relation, found in (
        (metrics.PoseRelation.translation_part, made.translation_m),
        (metrics.PoseRelation.rotation_angle_rad, made.rotation_rad),
    ):
        errors, _ = evo_errors(metrics.APE(relation), to_evo(truth), theirs)
        np.testing.assert_allclose(found, errors, rtol=0, atol=1e-9)


@given(seed=SEEDS, yaw=st.floats(-3.1, 3.1), x=st.floats(-50, 50), z=st.floats(-5, 5))
@settings(max_examples=25)
def test_yaw_alignment_recovers_rotation_about_vertical(
    seed: int, yaw: float, x: float, z: float
) -> None:
    truth = random_walk(seed)
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    xyz = rotate(turn, truth.xyz_m) + np.array([x, 1.0, z])
    moved = Trajectory(truth.t_ns, xyz, product(turn, truth.quat_wxyz))
    back = align(truth, moved, "yaw")

    assert ape(truth, back).translation_m.max() < 1e-9
    assert ape(truth, back).rotation_rad.max() < 1e-7


def test_coverage_accounts_for_every_true_pose() -> None:
    truth = random_walk(1, 100)
    keep = np.ones(100, np.bool_)
    keep[:10] = keep[40:50] = keep[95:] = False
    estimate = Trajectory(truth.t_ns[keep], truth.xyz_m[keep], truth.quat_wxyz[keep])

    assert pair_poses(truth, estimate, 250_000_000).coverage == Coverage(100, 79, 10, 5, 6)


def paired_with(error: Floats, cov_xyh: Floats) -> Paired:
    n = len(error)
    t_ns = np.arange(n, dtype=np.int64)
    zero = np.zeros(n)
    truth = planar(t_ns, zero, zero, np.full(n, 3.0))
    estimate = planar(t_ns, error[:, 0], error[:, 1], 3.0 + error[:, 2])
    return Paired(truth, estimate, cov_xyh, Coverage(n, n, 0, 0, 0))


def test_nees_of_consistent_errors_is_in_band() -> None:
    rng = np.random.default_rng(11)
    root = np.array([[3.0, 0.0, 0.0], [1.0, 2.0, 0.0], [0.02, -0.03, 0.05]])
    cov = root @ root.T
    error = rng.normal(size=(2000, 3)) @ root.T
    upper = np.tile(cov[np.triu_indices(3)], (2000, 1))
    for dimensions in (2, 3):
        values = squared_errors(paired_with(error, upper), 2 if dimensions == 2 else 3)
        summary = summarise_nees(values, dimensions, independent=2000)
        assert summary.band_low < summary.mean < summary.band_high
        assert summary.fraction_inside_95 == pytest.approx(0.95, abs=0.02)
        overconfident = summarise_nees(4.0 * values, dimensions, independent=2000)
        assert overconfident.mean > overconfident.band_high


def test_rows_with_singular_covariance_are_counted_not_scored() -> None:
    upper = np.array(
        [
            [1.0, 0.0, 0.0, 1.0, 0.0, 1.0],
            [0.0, 0.0, 0.0, 1.0, 0.0, 1.0],
            [1.0, 1.0, 0.0, 1.0, 0.0, 1.0],
            [np.nan, 0.0, 0.0, 1.0, 0.0, 1.0],
            [1.0, 0.0, 0.0, -1.0, 0.0, 1.0],
        ]
    )
    summary = summarise_nees(squared_errors(paired_with(np.ones((5, 3)), upper), 3), 3)

    assert (summary.rows, summary.rows_singular) == (1, 4)
    assert summary.mean == pytest.approx(3.0)
    assert summarise_nees(np.full(3, np.nan), 3).rows == 0


def test_mean_band_covers_95_percent_of_simulated_means() -> None:
    rng = np.random.default_rng(11)
    means = rng.chisquare(3, (20_000, 5)).mean(axis=1)

    low, high = chi_square.mean_band(3, 5)

    # 20,000 draws: the fraction's own s.d. is 0.0015.
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.006)


def stationary_track() -> Trajectory:
    return planar(np.arange(5, dtype=np.int64), np.ones(5), np.ones(5), np.zeros(5))


def straight_track() -> Trajectory:
    return planar(np.arange(5, dtype=np.int64), np.arange(5.0), np.zeros(5), np.zeros(5))


NO_COVERAGE = Coverage(0, 0, 0, 0, 0)
TRACK = random_walk(1)
LATER = replace(TRACK, t_ns=TRACK.t_ns + 10)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: align(stationary_track(), stationary_track(), "yaw"), "do not determine yaw"),
        (lambda: rpe(straight_track(), straight_track(), 9.0), "no two of 5"),
        (lambda: rpe(straight_track(), straight_track(), 0.0), "expected > 0"),
        (lambda: pair_poses(LATER, stationary_track(), 1), "no true pose has an estimate"),
        (lambda: pair_poses(random_walk(1, 0), stationary_track(), 1), "0 true and 5 estimated"),
        (lambda: pair_poses(TRACK, TRACK, 1, np.zeros((3, 6))), r"expected \(60, 6\)"),
        (lambda: squared_errors(Paired(TRACK, TRACK, None, NO_COVERAGE), 2), "needed for NEES"),
    ],
)
def test_trajectories_that_cannot_be_scored_are_refused(
    call: Callable[[], object], message: str
) -> None:
    with pytest.raises((UsageError, ValueError), match=message):
        call()


def test_statistics_of_empty_array_are_nan() -> None:
    assert math.isnan(statistics(np.empty(0)).rmse)
