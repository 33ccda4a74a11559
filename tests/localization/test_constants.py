"""Constant errors of the odometry as states: derivatives, updates, consistency, and none at all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import wrap_all
from crosscue.localization.constants import (
    EFFECTS,
    TURN_PARAMETERS,
    Constants,
    coast_constants,
    effects,
    predict_constants,
    start_constants,
    update_constants,
)
from crosscue.localization.ekf import PoseBelief, coast, pack_belief, unpack_belief
from crosscue.localization.fixes import Fixes
from crosscue.localization.odometry import OdometrySettings, TurnKind, TurnSignal, integrate
from crosscue.localization.pose_filter import predict_pose
from crosscue.localization.pose_track import (
    NO_HEADINGS,
    Advance,
    TrackSettings,
    TrackState,
    advance_pose,
    start_belief,
)
from crosscue.localization.position_updates import PositionUpdates
from crosscue.replay.columns import Floats
from support.beliefs import with_position
from support.simulated_drive import BASE_M, TRACK_M, Truth, compass, drive, gyro, nees_of, wheels

CAR = OdometrySettings(
    track_width_m=TRACK_M,
    wheelbase_m=BASE_M,
    wheel_scale=1.02,
    right_wheel_scale=0.999,
    yaw_rate_scale=0.97,
    gyro_bias_radps=0.004,
    steering_ratio=15.0,
    steering_offset_rad=0.03,
    understeer_s2pm2=0.002,
    slip_per_sqrt_m=0.02,
    gyro_noise_rad_per_sqrt_s=1e-3,
)
NAMES = ("wheel_scale", "gyro_bias_radps", "yaw_rate_scale")
SD = np.array([0.004, 0.0008, 0.01])
NO_DRIFT: dict[str, float] = {}


def steering(truth: Truth) -> TurnSignal:
    speed = np.where(np.abs(truth.speed_mps) > 0.5, truth.speed_mps, np.inf)
    angle = np.clip(np.arctan(BASE_M * truth.yaw_radps / speed), -0.4, 0.4)
    return TurnSignal(truth.t_ns, 15.0 * angle, "steering")


@pytest.mark.parametrize("kind", ["yaw rate", "steering", "wheels"])
@pytest.mark.parametrize("name", [name for name in EFFECTS if name != "wheel_delay_s"])
def test_effect_of_a_parameter_matches_finite_differences(kind: str, name: str) -> None:
    truth = drive(np.random.default_rng(seed=5), seconds=40.0)
    turn = {"yaw rate": gyro(truth, CAR), "steering": steering(truth), "wheels": None}[kind]
    step = 1e-6 * max(abs(getattr(CAR, name)), 0.01)

    def columns(by: float) -> Floats:
        change: dict[str, Any] = {name: getattr(CAR, name) + by}
        made = integrate(wheels(truth, CAR), replace(CAR, **change), turn).increments
        return np.column_stack([made.distance_m, made.turn_rad])

    made = integrate(wheels(truth, CAR), CAR, turn).increments
    found = effects(made, CAR, (name,))[:, :, 0]

    # The right wheels' distance is computed with the turn, which is not the wheels' here.
    atol = 3e-3 if name == "right_wheel_scale" and kind != "wheels" else 2e-6
    np.testing.assert_allclose(found, (columns(step) - columns(-step)) / (2 * step), atol=atol)
    shared = name in ("wheel_scale", "right_wheel_scale") and kind != "yaw rate"
    assert found[:, 1].any() == (shared or name in TURN_PARAMETERS[kind])


def test_effect_of_a_delay_is_the_change_of_speed_between_two_times() -> None:
    truth = drive(np.random.default_rng(seed=5), seconds=40.0)

    def way_m(delay_s: float) -> Floats:
        car = replace(CAR, wheel_delay_s=delay_s)
        made = integrate(wheels(truth, CAR), car, gyro(truth, CAR)).increments
        edges = np.append(made.start_ns[:1], made.stop_ns)
        way: Floats = np.interp(at_ns, edges, np.append(0.0, np.cumsum(made.distance_m)))
        return way

    at_ns = truth.t_ns[20:-20]
    made = integrate(wheels(truth, CAR), CAR, gyro(truth, CAR)).increments
    found = effects(made, CAR, ("wheel_delay_s",))[:, :, 0]
    summed = np.interp(at_ns, made.stop_ns, np.cumsum(found[:, 0]))
    expected = (way_m(0.01) - way_m(0.0)) / 0.01

    assert np.ptp(expected) > 2.0  # the speed changes on this drive
    # The simulated speed jumps, and 10 ms see half of a jump between two rows.
    differs = np.abs(summed - summed[0] - expected + expected[0]) > 0.05
    assert differs.mean() < 0.01
    assert not found[:, 1].any()


def correlated(seed: int = 3) -> tuple[PoseBelief, Constants, Floats]:
    """Draw a pose and parameters with a joint covariance."""
    root = np.random.default_rng(seed).normal(size=(7, 7)) * np.array(
        [1.0, 1.0, 0.02, 0.3, *SD]
    ).reshape(-1, 1)
    joint = root @ root.T
    belief = PoseBelief(0, np.array([3.0, -2.0, 0.7, 8.0]), joint[:4, :4])
    off = np.array([0.002, -0.0005, 0.004])
    constants = Constants(NAMES, off, joint[4:, 4:], joint[:4, 4:], np.array([0.0, 1e-8, 0.0]))
    return belief, constants, joint


def test_prediction_propagates_the_joint_covariance_by_finite_differences() -> None:
    belief, constants, joint = correlated()
    by = np.array([[4.0, 0.0, 0.0], [0.0, -0.5, 0.3]])

    def moved(at: Floats) -> Floats:
        distance, turn = np.array([4.0, 0.3]) + by @ at[4:]
        state = predict_pose(
            pack_belief(PoseBelief(0, at[:4], belief.cov)), float(distance), float(turn), 0, 0, 0
        )
        return np.append(state[:4], at[4:])

    at = np.append(belief.mean, constants.mean)
    steps = 1e-6 * np.eye(7)
    jacobian = np.column_stack([(moved(at + d) - moved(at - d)) / 2e-6 for d in steps])
    expected = jacobian @ joint @ jacobian.T
    expected += np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.5e-8, 0.0])

    state, after = predict_constants(
        pack_belief(belief), constants, (4.0, 0.3, 0.0, 0.0, 0.0), by, 0.5
    )

    # The mean of 1 - cos of the heading, times the way, and three times its square.
    lost = (1.0 - np.exp(-0.5 * expected[2, 2])) * (moved(at) - at)[:2]
    expected[:2, :2] += 3.0 * np.outer(lost, lost)

    np.testing.assert_allclose(state[:4], moved(at)[:4], rtol=1e-12)
    found = unpack_belief(0, state).cov
    np.testing.assert_allclose(found, expected[:4, :4], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after.cross, expected[:4, 4:], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(after.cov, expected[4:, 4:], rtol=1e-6, atol=1e-12)


def test_covariance_is_that_of_the_errors_where_the_heading_becomes_uncertain() -> None:
    """150 m straight on with turns of 0.1 rad per root of a second and a bias (4,000 drives)."""
    rng = np.random.default_rng(seed=12)
    steps, dt_s, way_m, bias_sd = 100, 0.1, 1.5, 0.02
    turn_var = 0.1**2 * dt_s
    by = np.array([[0.0], [-dt_s]])
    cov = np.array([[bias_sd**2]])
    constants = Constants(("gyro_bias_radps",), np.zeros(1), cov, np.zeros((4, 1)), np.zeros(1))
    state = pack_belief(PoseBelief(0, np.zeros(4), np.diag([0.01, 0.01, 0.0, 0.0])))
    for _ in range(steps):
        step = (way_m, 0.0, 0.02**2 * way_m, turn_var, 0.0)
        state, constants = predict_constants(state, constants, step, by, dt_s)

    turns = rng.normal(0.0, np.sqrt(turn_var), (4000, steps)) - dt_s * rng.normal(
        0.0, bias_sd, (4000, 1)
    )
    heading = np.cumsum(turns, axis=1) - 0.5 * turns
    ways = way_m + rng.normal(0.0, 0.02 * np.sqrt(way_m), turns.shape)
    apart = np.stack([(ways * np.cos(heading)).sum(1), (ways * np.sin(heading)).sum(1)], axis=1)
    apart += rng.normal(0.0, 0.1, apart.shape) - np.array([state.x_m, state.y_m])
    spread = np.array([[state.xx, state.xy], [state.xy, state.yy]])
    nees = np.einsum("ni,ij,nj->n", apart, np.linalg.inv(spread), apart)

    assert 1.0 < nees.mean() < 2.5


def test_coasting_keeps_the_joint_covariance_valid() -> None:
    belief, constants, joint = correlated()
    by_state = np.eye(4)
    heading, reach = float(belief.mean[2]), 2.0 * float(belief.mean[3])
    by_state[:2, 2] = -reach * np.sin(heading), reach * np.cos(heading)
    by_state[:2, 3] = 2.0 * np.cos(heading), 2.0 * np.sin(heading)

    after = coast_constants(belief, constants, 2.0)

    np.testing.assert_allclose(after.cross, by_state @ joint[:4, 4:], rtol=1e-12)
    gone = coast(belief, 2.0, 0.0, 0.0)
    whole = np.block([[gone.cov, after.cross], [after.cross.T, after.cov]])
    assert np.linalg.eigvalsh(whole / np.sqrt(np.outer(*2 * [np.diagonal(whole)]))).min() > 0.0


def test_position_updates_parameters_as_a_filter_of_the_joint_state_does() -> None:
    belief, constants, joint = correlated()
    noise = np.array([[0.5, 0.1], [0.1, 0.8]])
    after = with_position(belief, np.array([4.0, -2.5]), noise)

    found = update_constants(constants, belief, after)

    gain = joint[:, :2] @ np.linalg.inv(joint[:2, :2] + noise)
    expected = joint - gain @ joint[:2]
    mean = np.append(belief.mean, constants.mean) + gain @ (np.array([4.0, -2.5]) - belief.mean[:2])
    np.testing.assert_allclose(found.mean, mean[4:], rtol=1e-8)
    np.testing.assert_allclose(found.cov, expected[4:, 4:], rtol=1e-6)
    np.testing.assert_allclose(found.cross, expected[:4, 4:], rtol=1e-6, atol=1e-12)


def test_update_of_a_pose_without_uncertainty_leaves_the_parameters() -> None:
    _, constants, _ = correlated()
    exact = PoseBelief(0, np.zeros(4), np.zeros((4, 4)))

    found = update_constants(replace(constants, cross=np.zeros((4, 3))), exact, exact)

    np.testing.assert_array_equal(found.cov, constants.cov)


def track(
    seed: int, cov: Floats, off: Floats, *, with_fixes: bool = False, turn: TurnKind = "yaw rate"
) -> tuple[Advance, Truth]:
    """Run the filter on a drive whose true parameters differ from the settings by ``off``."""
    rng = np.random.default_rng(seed)
    truth = drive(rng)
    own = {name: getattr(CAR, name) for name in NAMES}
    change: dict[str, Any] = dict(zip(NAMES, np.array(list(own.values())) + off, strict=True))
    real = replace(CAR, **change)
    speeds = wheels(truth, CAR, rng).wheels_mps / real.wheel_scale
    speeds[:, 1] /= real.right_wheel_scale
    rate = gyro(truth, CAR, rng)
    rate = replace(rate, values=rate.values / real.yaw_rate_scale + real.gyro_bias_radps)
    made = integrate(replace(wheels(truth, CAR), wheels_mps=speeds), CAR, rate).increments
    x, y, heading = truth.xyh[0] + rng.normal(0.0, [0.5, 0.5, 0.01])
    belief = start_belief(int(truth.t_ns[0]), x, y, heading, 0.0, 0.5, 0.01, 1.0)
    constants = start_constants(NAMES, cov, NO_DRIFT, turn)
    by = None if constants is None else effects(made, CAR, constants.names)
    updates = PositionUpdates(gate_nis=np.inf)
    if with_fixes:
        rows = slice(100, 700, 100)
        xy = truth.xyh[rows, :2] + rng.normal(0.0, 1.0, (6, 2))
        updates.add(Fixes(truth.t_ns[rows], xy, np.tile(np.eye(2), (6, 1, 1))))
    headings = compass(truth, 0.1, rng, every=200)
    state = TrackState(belief, constants=constants)
    settings = TrackSettings(heading_gate_nis=None)
    done = advance_pose(state, made, settings, headings, truth.t_ns[::200], updates, by)
    return done, truth


@pytest.mark.parametrize("with_fixes", [False, True])
def test_nees_of_pose_and_parameters_is_in_its_band(with_fixes: bool) -> None:
    """60 drives whose scale, bias and gyro scale are off by as much as stated (seeds 0 to 59)."""
    offs = np.random.default_rng(seed=9).normal(0.0, SD, (60, 3))
    runs = [
        track(seed, np.diag(SD**2), off, with_fixes=with_fixes) for seed, off in enumerate(offs)
    ]

    low, high = mean_band(3, 60)
    assert low < np.mean([nees_of(done.poses, truth, -1) for done, truth in runs]) < high
    if not with_fixes:
        ignored = [track(seed, np.zeros((3, 3)), off) for seed, off in enumerate(offs[:20])]
        assert np.mean([nees_of(done.poses, truth, -1) for done, truth in ignored]) > 3.0 * high
    of_parameters = []
    for (done, _), off in zip(runs, offs, strict=True):
        assert done.state.constants is not None
        apart = done.state.constants.mean - off
        of_parameters.append(apart @ np.linalg.solve(done.state.constants.cov, apart))
    assert low < np.mean(of_parameters) < high


def test_zero_covariance_is_the_published_filter_bit_for_bit() -> None:
    """Without uncertain parameters there are no states, so the same code runs."""
    assert start_constants(NAMES, np.zeros((3, 3)), NO_DRIFT, "yaw rate") is None
    done, _ = track(4, np.zeros((3, 3)), np.zeros(3))
    # A covariance too small to matter in 53 bits: the augmented filter gives the same pose, too,
    # and only the covariance of the position is of second order.
    same, _ = track(4, np.diag(SD**2) * 1e-40, np.zeros(3))

    assert same.state.constants is not None
    for name in ("x_m", "y_m", "heading_rad"):
        assert getattr(done.poses, name).tobytes() == getattr(same.poses, name).tobytes()
    assert done.poses.cov_xyh[:, [2, 4, 5]].tobytes() == same.poses.cov_xyh[:, [2, 4, 5]].tobytes()


def test_parameters_of_the_other_turn_signal_are_left_out() -> None:
    names = ("wheel_scale", "gyro_bias_radps", "steering_ratio", "track_width_m")

    for turn, kept in (
        ("yaw rate", ("wheel_scale", "gyro_bias_radps", "track_width_m")),
        ("steering", ("wheel_scale", "steering_ratio", "track_width_m")),
        (None, ("wheel_scale", "track_width_m")),
    ):
        found = start_constants(names, np.eye(4), NO_DRIFT, turn)  # type: ignore[arg-type]
        assert found is not None
        assert found.names == kept


def test_two_windows_give_the_track_of_one() -> None:
    truth = drive(np.random.default_rng(seed=6))
    made = integrate(wheels(truth, CAR), CAR, gyro(truth, CAR)).increments
    constants = start_constants(NAMES, np.diag(SD**2), {"gyro_bias_radps": 1e-4}, "yaw rate")
    state = TrackState(start_belief(int(truth.t_ns[0]), 0, 0, 0, 0, 1, 0.1, 1), constants=constants)
    by = effects(made, CAR, NAMES)
    whole = advance_pose(state, made, TrackSettings(), NO_HEADINGS, by=by).poses
    rows = []
    for part in (slice(0, 500), slice(500, None)):
        columns = {f: getattr(made, f)[part] for f in made.__dataclass_fields__}
        done = advance_pose(state, type(made)(**columns), TrackSettings(), by=by[part])
        state = done.state
        rows.append(done.poses.cov_xyh)

    assert np.concatenate(rows).tobytes() == whole.cov_xyh.tobytes()
    assert wrap_all(whole.heading_rad).tolist() == whole.heading_rad.tolist()
