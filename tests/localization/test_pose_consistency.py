"""Pose tracks: agreement with the filter, independence of windows, and consistency."""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from runpy import run_path
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.ekf import PoseBelief
from crosscue.localization.odometry import (
    Increments,
    OdometrySettings,
    Pending,
    TurnSignal,
    WheelSamples,
    integrate,
)
from crosscue.localization.pose_filter import major_axis_m
from crosscue.localization.pose_track import (
    Advance,
    Headings,
    TrackCounts,
    TrackSettings,
    TrackState,
    advance_pose,
    start_belief,
)
from crosscue.replay.columns import Floats, Int64s
from support.beliefs import driven, with_heading, with_speed
from support.simulated_drive import TRACK_M, Truth, compass, drive, gyro, nees_of, wheels

ODOMETRY = OdometrySettings(
    track_width_m=TRACK_M,
    wheel_step_mps=0.01,
    slip_per_sqrt_m=0.05,
    gyro_noise_rad_per_sqrt_s=0.01,
)
EVERY_READING = TrackSettings(heading_interval_m=0.0, heading_gate_nis=None)


def draw_start(truth: Truth, rng: np.random.Generator, heading_sd: float = 0.05) -> PoseBelief:
    """Draw a start pose with errors that match its covariance."""
    x, y, heading = truth.xyh[0] + rng.normal(0.0, [1.0, 1.0, heading_sd])
    speed = truth.speed_mps[0] + rng.normal(0.0, 1.0)
    return start_belief(int(truth.t_ns[0]), x, y, heading, speed, 1.0, heading_sd, 1.0)


def run(seed: int, settings: TrackSettings, persists_s: float = 0.0) -> tuple[Advance, Truth]:
    rng = np.random.default_rng(seed)
    truth = drive(rng)
    made = integrate(wheels(truth, ODOMETRY, rng), ODOMETRY, gyro(truth, ODOMETRY, rng))
    headings = compass(truth, 0.1, rng, persists_s=persists_s)
    first = TrackState(draw_start(truth, rng))
    return advance_pose(first, made.increments, settings, headings, truth.t_ns[::200]), truth


def test_simulated_nees_and_nis_are_in_their_bands() -> None:
    runs = [run(seed, EVERY_READING) for seed in range(100)]

    for row in (2, -1):
        mean = np.mean([nees_of(done.poses, truth, row) for done, truth in runs])
        low, high = mean_band(3, 100)
        assert low < mean < high
    nis = np.concatenate([done.headings.nis for done, _ in runs])
    low, high = mean_band(1, len(nis))
    assert low < nis.mean() < high


def test_correlated_compass_errors_require_thinned_readings() -> None:
    """With an error that decays over 2 s, the filter is overconfident at 10 Hz unless thinned."""
    thinned = TrackSettings(heading_interval_m=0.0, heading_interval_s=4.0, heading_gate_nis=None)

    def mean_nees(settings: TrackSettings) -> float:
        runs = [run(seed, settings, persists_s=2.0) for seed in range(60)]
        return float(np.mean([nees_of(done.poses, truth, -1) for done, truth in runs]))

    assert mean_nees(EVERY_READING) > 1.5 * 3.0
    assert 2.4 < mean_nees(thinned) < 3.6


def reference(
    belief: PoseBelief, made: Increments, settings: TrackSettings, headings: Headings
) -> PoseBelief:
    """Compute the track step by step with the filter's functions."""
    waiting = list(zip(headings.t_ns, headings.heading_rad, headings.var_rad2, strict=True))
    for k in range(len(made)):
        start, stop = int(made.start_ns[k]), int(made.stop_ns[k])
        inside = [w for w in waiting if belief.t_ns <= w[0] <= stop]
        for t_ns, heading, var in [*inside, (stop, None, None)]:
            fraction = (int(t_ns) - belief.t_ns) / (stop - start)
            dt_s = (int(t_ns) - belief.t_ns) * 1e-9
            moved = driven(
                belief,
                fraction * made.distance_m[k],
                fraction * made.turn_rad[k],
                (
                    fraction * made.distance_var_m2[k],
                    fraction * made.turn_var_rad2[k],
                    dt_s * settings.accel_var_m2ps3,
                ),
            )
            belief = PoseBelief(int(t_ns), moved.mean, moved.cov)
            if heading is not None:
                belief = with_heading(belief, heading, var)
        waiting = [w for w in waiting if w[0] > stop]
        speed, var = made.speed_mps[k], made.speed_var_m2ps2[k]
        belief = with_speed(belief, speed, var)
    return belief


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_advance_matches_the_filter_functions_step_by_step(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = drive(rng, seconds=20.0)
    made = integrate(wheels(truth, ODOMETRY, rng), ODOMETRY, gyro(truth, ODOMETRY, rng)).increments
    on_time = compass(truth, 0.1, rng, every=7)
    headings = Headings(on_time.t_ns - 7_654_321, on_time.heading_rad, on_time.var_rad2)
    belief = draw_start(truth, rng)
    mixed = belief.cov + 0.01 * np.outer([1.0, 2.0, 0.1, 0.5], [1.0, 2.0, 0.1, 0.5])
    belief = PoseBelief(belief.t_ns, belief.mean, mixed)

    done = advance_pose(TrackState(belief), made, EVERY_READING, headings)
    wanted = reference(belief, made, EVERY_READING, headings)
    np.testing.assert_allclose(done.state.belief.mean, wanted.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(done.state.belief.cov, wanted.cov, rtol=1e-9, atol=1e-9)
    assert done.state.belief.t_ns == wanted.t_ns
    (xx, xy), (_, yy) = wanted.cov[:2, :2].tolist()
    assert done.poses.major_axis_m[-1] == pytest.approx(major_axis_m(xx, xy, yy))
    assert done.counts.headings_accepted == len(headings)


def cut(t_ns: Int64s, low: int, high: int) -> slice:
    return slice(*np.searchsorted(t_ns, [low, high], side="left"))


@given(
    cuts=st.lists(st.integers(0, 12_000), max_size=6),
    seed=st.integers(0, 30),
    hole=st.integers(0, 10_000),
    every_interval=st.booleans(),
)
def test_windowed_track_is_bit_identical(
    cuts: list[int], seed: int, hole: int, every_interval: bool
) -> None:
    """The gyro has a separate clock and a gap; headings and rows are between the samples."""
    rng = np.random.default_rng(seed)
    truth = drive(rng, seconds=12.0)
    zero = int(truth.t_ns[0])
    speeds = wheels(truth, ODOMETRY, rng)
    rates = gyro(truth, ODOMETRY, rng)
    rate_t = rates.t_ns + 13_000_000
    has = np.abs(rate_t - zero - hole * 1_000_000) > 900_000_000
    rate_t, rate = rate_t[has], rates.values[has]
    readings = compass(truth, 0.1, rng, every=3)
    heading_t = readings.t_ns - 4_321_000
    frames = np.arange(zero + 10_000_000, zero + 12_000_000_000, 51_000_000)
    track = TrackSettings(heading_interval_m=2.0, heading_interval_s=0.3)
    belief = draw_start(truth, rng)

    def windowed(edges: list[int]) -> tuple[list[Floats], TrackState, TrackCounts]:
        pending, state, counts = Pending(), TrackState(belief), TrackCounts()
        columns: list[Floats] = []
        for low, high in pairwise(edges):
            w, g = cut(speeds.t_ns, low, high), cut(rate_t, low, high)
            h, f = cut(heading_t, low, high), cut(frames, low, high)
            made, pending, _ = integrate(
                WheelSamples(speeds.t_ns[w], speeds.wheels_mps[w]),
                ODOMETRY,
                TurnSignal(rate_t[g], rate[g], "yaw rate"),
                pending,
                None if high == edges[-1] else high,
            )
            state, poses, _, some = advance_pose(
                state,
                made,
                track,
                Headings(heading_t[h], readings.heading_rad[h], readings.var_rad2[h]),
                None if every_interval else frames[f],
            )
            counts += some
            columns.append(np.column_stack([poses.t_ns, poses.x_m, poses.y_m, poses.heading_rad]))
            columns[-1] = np.hstack([columns[-1], poses.cov_xyh, poses.travelled_m[:, None]])
        return columns, state, counts

    ends = [zero - 10_000_000_000, zero + 20_000_000_000]
    inner = [zero + c * 1_000_000 for c in cuts]
    whole, last, counts = windowed(ends)
    parts, last_of_parts, counts_of_parts = windowed(sorted([*ends, *inner]))
    np.testing.assert_array_equal(np.vstack(parts), np.vstack(whole))
    np.testing.assert_array_equal(last_of_parts.belief.mean, last.belief.mean)
    np.testing.assert_array_equal(last_of_parts.belief.cov, last.belief.cov)
    assert counts_of_parts == counts
    assert counts.headings_accepted > 0


def straight(n: int = 11, speed: float = 10.0, first_ns: int = 0) -> Increments:
    t_ns = first_ns + np.arange(n, dtype=np.int64) * 100_000_000
    speeds = WheelSamples(t_ns, np.full((n, 2), speed))
    return integrate(speeds, OdometrySettings(track_width_m=TRACK_M)).increments


def headings_at(*t_s: float, heading: float = 0.0, var: float = 0.01) -> Headings:
    t_ns = np.round(np.array(t_s) * 1e9).astype(np.int64)
    return Headings(t_ns, np.full(len(t_s), heading), np.full(len(t_s), var))


def test_every_heading_is_accounted_for() -> None:
    nan = Headings(np.array([400_000_000]), np.array([np.nan]), np.array([0.01]))
    given = headings_at(0.4, 0.2, 0.25, 0.3, 0.9, 5.0)
    far = headings_at(0.6, heading=2.0)
    every = Headings(
        np.concatenate([nan.t_ns, given.t_ns, far.t_ns]),
        np.concatenate([nan.heading_rad, given.heading_rad, far.heading_rad]),
        np.concatenate([nan.var_rad2, given.var_rad2, far.var_rad2]),
    )
    belief = start_belief(210_000_000, 0.0, 0.0, 0.0, heading_sd_rad=0.1)
    settings = TrackSettings(heading_interval_m=1.2)
    done = advance_pose(TrackState(belief), straight(), settings, every)

    assert done.counts == TrackCounts(
        intervals=8,
        intervals_late=2,
        headings=5,
        headings_accepted=3,
        headings_thinned=1,
        headings_rejected=1,
        headings_late=1,
        headings_bad=1,
    )
    assert done.state.waiting.t_ns.tolist() == [5_000_000_000]
    assert done.headings.t_ns.tolist() == [250_000_000, 400_000_000, 600_000_000, 900_000_000]
    assert done.headings.outcome.tolist() == [0, 0, 1, 0]


def test_time_without_odometry_is_coasted_and_counted() -> None:
    belief = start_belief(0, 0.0, 0.0, 0.0, speed_mps=10.0, speed_sd_mps=0.5)
    done = advance_pose(TrackState(belief), straight(first_ns=2_000_000_000), TrackSettings())

    assert done.counts.coasts == 1
    assert done.counts.coast_ns == 2_000_000_000
    assert done.poses.x_m[0] == pytest.approx(21.0)
    assert done.poses.travelled_m[0] == pytest.approx(1.0)
    assert done.poses.cov_xyh[0, 0] > (0.5 * 2.0) ** 2


NAMES = run_path(str(Path(__file__).parents[2] / "benchmarks" / "pose_nees.py"))
interval = cast("Callable[[list[Floats]], tuple[float, float]]", NAMES["interval"])


def drawn(rng: np.random.Generator, parts: int, windows: int, shared: float) -> list[Floats]:
    """NEES by part; windows overlap by half, and share a fraction of their error's variance."""
    found = []
    for _ in range(parts):
        own = rng.normal(size=(windows + 1, 2))
        error = np.sqrt(shared) * rng.normal(size=2)
        error = error + np.sqrt(0.5 * (1.0 - shared)) * (own[1:] + own[:-1])
        found.append(np.sum(error**2, axis=1))
    return found


def test_one_prediction_of_0_88_is_consistent() -> None:
    low, high = interval([np.array([0.88])])

    # Two over a chi-square quantile of two degrees of freedom.
    assert low == pytest.approx(0.88 * 2.0 / 7.378, rel=1e-3)
    assert high == pytest.approx(0.88 * 2.0 / 0.0506, rel=1e-3)


@pytest.mark.parametrize("parts", [1, 2, 4, 6, 24])
@pytest.mark.parametrize("shared", [0.0, 0.5, 0.95])
def test_interval_of_a_mean_nees_covers_its_expectation(parts: int, shared: float) -> None:
    rng = np.random.default_rng(parts)
    intervals = [interval(drawn(rng, parts, 6, shared)) for _ in range(300)]

    # Three standard errors below 95 %.
    assert np.mean([low <= 2.0 <= high for low, high in intervals]) >= 0.912


def test_interval_of_many_independent_predictions_decides() -> None:
    rng = np.random.default_rng(1)
    ratios = [np.divide(*interval(drawn(rng, 24, 16, 0.0))[::-1]) for _ in range(50)]

    assert np.median(ratios) < 1.5
