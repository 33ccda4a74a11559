"""Tests of the batch smoother: exactness in the linear case, and consistency in simulation."""

import math
from dataclasses import replace

import numpy as np
import pytest

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import wrap_all
from crosscue.localization.constants import NO_CONSTANTS, Constants, effects
from crosscue.localization.ekf import PoseBelief, update_point
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import Increments, OdometrySettings, WheelSamples, integrate
from crosscue.localization.pose_track import (
    NO_HEADINGS,
    Headings,
    TrackSettings,
    TrackState,
    advance_pose,
    start_belief,
)
from crosscue.localization.smoother import smooth_poses
from crosscue.replay.columns import Floats, Int64s
from support.simulated_drive import TRACK_M, Truth, compass, drive, gyro, wheels

ODOMETRY = OdometrySettings(
    track_width_m=TRACK_M, wheel_step_mps=0.01, slip_per_sqrt_m=0.1, gyro_noise_rad_per_sqrt_s=0.01
)
EVERY_READING = TrackSettings(heading_interval_m=0.0, heading_gate_nis=None)


def straight(n: int, slip: float) -> Increments:
    t_ns = np.arange(n + 1, dtype=np.int64) * 1_000_000_000
    settings = OdometrySettings(
        track_width_m=TRACK_M, slip_per_sqrt_m=slip, wheel_turn_rad_per_sqrt_m=0.0, max_gap_s=2.0
    )
    return integrate(WheelSamples(t_ns, np.full((n + 1, 2), 10.0)), settings).increments


def test_straight_drive_matches_the_least_squares_solution() -> None:
    """With known heading and slip only, positions are a chain of Gaussians with a closed form."""
    slip, fix_var, start_var = 0.5, 4.0, 9.0
    made = straight(10, slip)
    start = start_belief(0, 3.0, 0.0, 0.0, 10.0, math.sqrt(start_var), 1e-4, 1.0)
    fixes = Fixes(
        np.array([4, 10]) * 1_000_000_000,
        np.array([[42.0, 0.0], [97.0, 0.0]]),
        np.tile(fix_var * np.eye(2), (2, 1, 1)),
    )
    at = np.arange(11, dtype=np.int64) * 1_000_000_000
    found = smooth_poses(start, made, NO_HEADINGS, fixes, at)

    step_var = float(made.distance_var_m2[0])
    information = np.zeros((11, 11))
    vector = np.zeros(11)
    information[0, 0], vector[0] = 1 / start_var, 3.0 / start_var
    for i in range(10):
        pull = np.zeros(11)
        pull[i], pull[i + 1] = -1.0, 1.0
        information += np.outer(pull, pull) / step_var
        vector += pull * 10.0 / step_var
    for i, x in ((4, 42.0), (10, 97.0)):
        information[i, i] += 1 / fix_var
        vector[i] += x / fix_var
    cov = np.linalg.inv(information)
    np.testing.assert_allclose(found.xyh[:, 0], cov @ vector, atol=1e-4)
    np.testing.assert_allclose(found.cov[:, 0, 0], np.diag(cov), rtol=1e-4)
    np.testing.assert_allclose(found.xyh[:, 1], 0.0, atol=1e-6)


def simulate(seed: int) -> tuple[Truth, PoseBelief, Increments, Headings, Fixes]:
    rng = np.random.default_rng(seed)
    truth = drive(rng, seconds=30.0)
    made = integrate(wheels(truth, ODOMETRY, rng), ODOMETRY, gyro(truth, ODOMETRY, rng)).increments
    off = rng.normal(0.0, [2.0, 2.0, 0.1])
    x, y, heading = truth.xyh[0] + off
    first = start_belief(int(truth.t_ns[0]), x, y, heading, truth.speed_mps[0], 2.0, 0.1, 1.0)
    headings = compass(truth, 0.2, rng, every=20)
    rows = np.arange(100, len(truth.t_ns), 150)
    cov = np.tile(np.array([[2.0, 0.5], [0.5, 1.0]]), (len(rows), 1, 1))
    noise = rng.multivariate_normal([0.0, 0.0], cov[0], len(rows))
    return truth, first, made, headings, Fixes(truth.t_ns[rows], truth.xyh[rows, :2] + noise, cov)


class FixMeasurements:
    """Fixes as measurements of the filter."""

    def __init__(self, fixes: Fixes) -> None:
        self.fixes = fixes

    def times_ns(self) -> list[int]:
        """Times of the fixes."""
        return [int(t) for t in self.fixes.t_ns]

    def update(self, belief: PoseBelief, travelled_m: float, /) -> PoseBelief | None:
        """Update with one fix."""
        i = int(np.searchsorted(self.fixes.t_ns, belief.t_ns))
        return update_point(belief, self.fixes.xy_m[i], self.fixes.cov_m2[i]).belief


def errors(truth: Truth, t_ns: Int64s, xyh: Floats) -> Floats:
    error: Floats = xyh - truth.xyh[np.searchsorted(truth.t_ns, t_ns)]
    error[:, 2] = wrap_all(error[:, 2])
    return error


@pytest.mark.slow
def test_smoother_is_consistent_and_more_accurate_than_the_filter() -> None:
    """Seeds 0 to 29: both agree at the end of a drive, and the smoother is better before it."""
    nees, filter_m2, smoother_m2, ends = [], [], [], []
    for seed in range(30):
        truth, first, made, headings, fixes = simulate(seed)
        at = truth.t_ns[20::20]
        measurements = FixMeasurements(fixes)
        track = advance_pose(
            TrackState(first), made, EVERY_READING, headings, at, measurements
        ).poses
        found = smooth_poses(first, made, headings, fixes, at)
        error = errors(truth, found.t_ns, found.xyh)
        nees.append(float(error[15] @ np.linalg.solve(found.cov[15], error[15])))
        smoother_m2.append(np.mean(np.sum(error[:, :2] ** 2, axis=1)))
        filtered = np.column_stack([track.x_m, track.y_m, track.heading_rad])
        filter_error = errors(truth, track.t_ns, filtered)
        filter_m2.append(np.mean(np.sum(filter_error[:, :2] ** 2, axis=1)))
        ends.append(math.dist(found.xyh[-1, :2], filtered[-1, :2]))

    low, high = mean_band(3, 30)
    assert low < np.mean(nees) < high
    assert np.sqrt(np.mean(smoother_m2)) < 0.9 * np.sqrt(np.mean(filter_m2))
    assert np.median(ends) < 0.2


def test_constant_errors_of_the_odometry_are_states_with_true_variances() -> None:
    """Seeds 100 to 139, with a scale and a bias that are off by their s.d. on average."""
    names, sd = ("wheel_scale", "gyro_bias_radps"), np.array([0.05, 0.02])
    nees: dict[str, list[float]] = {"states": [], "none": []}
    for seed in range(100, 140):
        rng = np.random.default_rng(seed)
        truth, first, _, headings, fixes = simulate(seed)
        scale, bias = rng.normal(0.0, sd).tolist()
        car = replace(ODOMETRY, wheel_scale=1.0 - scale, gyro_bias_radps=-bias)
        made = integrate(wheels(truth, ODOMETRY, rng), car, gyro(truth, ODOMETRY, rng)).increments
        cov = np.diag(sd**2)
        known = Constants(names, np.zeros(2), cov, np.zeros((4, 2)), np.zeros(2))
        at = truth.t_ns[20::20]
        for name, constants in (("states", known), ("none", NO_CONSTANTS)):
            by = effects(made, car, constants.names)
            found = smooth_poses(first, made, headings, fixes, at, (0.0, 0.0), (constants, by))
            error = errors(truth, found.t_ns, found.xyh)
            nees[name].append(float(error[15] @ np.linalg.solve(found.cov[15], error[15])))

    low, high = mean_band(3, 40)
    assert low < np.mean(nees["states"]) < high
    assert np.mean(nees["none"]) > 2.0 * high


def test_gaps_are_refused() -> None:
    made = straight(4, 0.5)
    late = start_belief(9_000_000_000, 0.0, 0.0, 0.0)
    early = start_belief(-1, 0.0, 0.0, 0.0)
    with pytest.raises(ValueError, match="expected odometry after 9000000000 ns"):
        smooth_poses(late, made, NO_HEADINGS)
    with pytest.raises(ValueError, match="expected no gaps, got one at -1 ns"):
        smooth_poses(early, made, NO_HEADINGS)
