"""Extended Kalman filter for the pose of a car, as pure functions from belief to belief.

State ``[x_m, y_m, heading_rad, speed_mps]``: the centre of the rear axle in a planar map frame
(x east, y north), heading counter-clockwise from +x (REP-103), speed negative in reverse.
Motion is the dissertation's bicycle model (eq. 5 and 6): an arc of length d that turns by dtheta,

    dx = d sin(dtheta) / dtheta,    dy = d (1 - cos(dtheta)) / dtheta    (in the car's frame),

which is rho sin(dtheta) and rho (1 - cos(dtheta)) without the division by a steering angle of
zero. Filter equations: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking
and Navigation*, section 10.3 (EKF) and eq. 5.2.3-18 (Joseph form).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from . import pose_filter
from .angles import wrap
from .pose_filter import HEADING, SPEED, State, arc

Floats: TypeAlias = NDArray[np.float64]

X: Final = 0
Y: Final = 1

# Full major axis of the 2-sigma ellipse above which the car is lost, by the dissertation.
LOST_M: Final = 100.0

_ROUNDING: Final = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class PoseBelief:
    """A Gaussian over pose and speed.

    Attributes:
        t_ns: Log time.
        mean: Shape (4,): x in metres, y in metres, heading in radians in (-pi, pi], speed in m/s.
        cov: Shape (4, 4), symmetric, in the products of those units.
    """

    t_ns: int
    mean: Floats
    cov: Floats

    def __post_init__(self) -> None:
        """Validate mean and covariance.

        Raises:
            ValueError: A shape is wrong, a value is not finite, or a variance is negative.
        """
        if self.mean.shape != (4,) or self.cov.shape != (4, 4):
            raise ValueError(
                f"expected mean (4,), cov (4, 4); got {self.mean.shape}, {self.cov.shape}"
            )
        if not (np.isfinite(self.mean).all() and np.isfinite(self.cov).all()):
            raise ValueError(f"belief at {self.t_ns} ns: expected finite numbers, got {self.mean}")
        if (np.diagonal(self.cov) < -_ROUNDING).any():
            raise ValueError(f"cov: expected variances >= 0, got {np.diagonal(self.cov)}")


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """The car's geometry, and standard deviations of its inputs in one step.

    Attributes:
        wheelbase_m: Distance between the axles.
        accel_mps2: S.d. of the acceleration.
        steering_rad: S.d. of the road-wheel angle.
        yaw_rate_radps: S.d. of the yaw rate.
        slip_per_sqrt_m: S.d. of the travelled distance after one metre; it grows with its root.
    """

    wheelbase_m: float
    accel_mps2: float = 0.0
    steering_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    slip_per_sqrt_m: float = 0.0

    def __post_init__(self) -> None:
        """Validate the values.

        Raises:
            ValueError: The wheelbase is not positive, or a standard deviation is negative.
        """
        if not self.wheelbase_m > 0.0:
            raise ValueError(f"wheelbase_m: expected > 0, got {self.wheelbase_m}")
        for name in ("accel_mps2", "steering_rad", "yaw_rate_radps", "slip_per_sqrt_m"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"{name}: expected >= 0, got {getattr(self, name)}")


class MotionStep(NamedTuple):
    """One step of the motion model.

    Attributes:
        mean: Shape (4,): the state after the step.
        by_state: Shape (4, 4): Jacobian by the state before.
        by_input: Shape (4, K): Jacobian by the K inputs.
    """

    mean: Floats
    by_state: Floats
    by_input: Floats


class Updated(NamedTuple):
    """The outcome of one measurement.

    Attributes:
        belief: The posterior, or the unchanged prior if the gate rejected the measurement.
        is_accepted: True if the measurement is inside the gate.
        innovation: Shape (m,): measured minus expected, angles wrapped.
        nis: Normalised innovation squared; chi-square with m degrees of freedom.
    """

    belief: PoseBelief
    is_accepted: bool
    innovation: Floats
    nis: float


def bicycle(
    mean: Floats, accel_mps2: float, steering_rad: float, dt_s: float, wheelbase_m: float
) -> MotionStep:
    """Equations 5 and 6 with their Jacobians by state and by (acceleration, steering).

    The dissertation's curvature is steering / wheelbase, without the tangent.
    """
    distance_m = mean[SPEED] * dt_s + 0.5 * accel_mps2 * dt_s**2
    curvature = steering_rad / wheelbase_m
    distance_by = np.array([dt_s, 0.5 * dt_s**2, 0.0])
    turn_by = np.array([curvature * dt_s, 0.5 * curvature * dt_s**2, distance_m / wheelbase_m])
    return _drive(mean, accel_mps2, dt_s, distance_m, distance_m * curvature, distance_by, turn_by)


def turning(mean: Floats, accel_mps2: float, yaw_rate_radps: float, dt_s: float) -> MotionStep:
    """The same arc by yaw rate, with Jacobians by state and by (acceleration, yaw rate)."""
    distance_m = mean[SPEED] * dt_s + 0.5 * accel_mps2 * dt_s**2
    distance_by = np.array([dt_s, 0.5 * dt_s**2, 0.0])
    turn_by = np.array([0.0, 0.0, dt_s])
    return _drive(mean, accel_mps2, dt_s, distance_m, yaw_rate_radps * dt_s, distance_by, turn_by)


def odometry_motion(mean: Floats, distance_m: float, turn_rad: float, by: Floats) -> MotionStep:
    """The arc that odometry measured, with Jacobians by state and by K parameters of the odometry.

    ``by``, shape (2, K), has the derivatives of distance and turn by the parameters.
    """
    distance_by, turn_by = np.column_stack([np.zeros(2), by])
    return _drive(mean, 0.0, 0.0, distance_m, turn_rad, distance_by, turn_by)


def predict_ekf(
    belief: PoseBelief, accel_mps2: float, steering_rad: float, dt_s: float, noise: MotionNoise
) -> PoseBelief:
    """Predict over ``dt_s`` with the given acceleration and road-wheel angle (eq. 5 and 6).

    Raises:
        ValueError: An input is not finite or ``dt_s`` is negative.
    """
    _check_inputs(dt_s, accel_mps2=accel_mps2, steering_rad=steering_rad)
    motion = bicycle(belief.mean, accel_mps2, steering_rad, dt_s, noise.wheelbase_m)
    return _predicted(belief, motion, dt_s, accel_mps2, noise, noise.steering_rad)


def predict_yaw_rate(
    belief: PoseBelief, accel_mps2: float, yaw_rate_radps: float, dt_s: float, noise: MotionNoise
) -> PoseBelief:
    """Predict over ``dt_s`` with the given acceleration and yaw rate.

    Raises:
        ValueError: An input is not finite or ``dt_s`` is negative.
    """
    _check_inputs(dt_s, accel_mps2=accel_mps2, yaw_rate_radps=yaw_rate_radps)
    motion = turning(belief.mean, accel_mps2, yaw_rate_radps, dt_s)
    return _predicted(belief, motion, dt_s, accel_mps2, noise, noise.yaw_rate_radps)


def predict_odometry(
    belief: PoseBelief,
    distance_m: float,
    turn_rad: float,
    distance_var_m2: float,
    turn_var_rad2: float,
    dt_s: float,
    accel_var_m2ps3: float,
) -> PoseBelief:
    """Predict along the arc that odometry measured; the speed's mean remains, its variance grows.

    Args:
        belief: Belief before the interval.
        distance_m: Distance travelled by the rear axle, negative in reverse.
        turn_rad: Change of heading.
        distance_var_m2: Variance of the distance.
        turn_var_rad2: Variance of the change of heading.
        dt_s: Length of the interval.
        accel_var_m2ps3: Growth of the speed's variance per second.

    Raises:
        ValueError: An input is not finite, or a variance or ``dt_s`` is negative.
    """
    _check_inputs(dt_s, distance_m=distance_m, turn_rad=turn_rad)
    if not (distance_var_m2 >= 0.0 and turn_var_rad2 >= 0.0 and accel_var_m2ps3 >= 0.0):
        raise ValueError(f"variances: expected >= 0, got {distance_var_m2}, {turn_var_rad2}")
    after = pose_filter.predict_pose(
        pack_belief(belief),
        distance_m,
        turn_rad,
        distance_var_m2,
        turn_var_rad2,
        accel_var_m2ps3 * dt_s,
    )
    return unpack_belief(belief.t_ns + round(dt_s * 1e9), after)


def coast(
    belief: PoseBelief, dt_s: float, accel_var_m2ps3: float, turn_var_rad2ps: float
) -> PoseBelief:
    """Predict without measurements, straight and at constant speed, with growing variances.

    Acceleration and yaw rate are white noise of the given power, so that two short coasts make
    one long one (Bar-Shalom, Li, Kirubarajan, section 6.2.2).

    Raises:
        ValueError: ``dt_s`` or a variance is negative or not finite.
    """
    _check_inputs(dt_s, accel_var_m2ps3=accel_var_m2ps3, turn_var_rad2ps=turn_var_rad2ps)
    if accel_var_m2ps3 < 0.0 or turn_var_rad2ps < 0.0:
        raise ValueError(f"variances: expected >= 0, got {accel_var_m2ps3}, {turn_var_rad2ps}")
    motion = turning(belief.mean, 0.0, 0.0, dt_s)
    heading, distance_m = belief.mean[HEADING], belief.mean[SPEED] * dt_s
    along = np.array([math.cos(heading), math.sin(heading), 0.0, 0.0])
    across = np.array([-math.sin(heading), math.cos(heading), 0.0, 0.0])
    faster, turned = np.eye(4)[SPEED], np.eye(4)[HEADING]
    cov = motion.by_state @ belief.cov @ motion.by_state.T
    cov += accel_var_m2ps3 * _walk(along * dt_s, faster, dt_s)
    cov += turn_var_rad2ps * _walk(across * distance_m, turned, dt_s)
    return _belief(belief.t_ns + round(dt_s * 1e9), motion.mean, cov)


def update_speed(
    belief: PoseBelief, speed_mps: float, var_m2ps2: float, gate_nis: float | None = None
) -> Updated:
    """Update with a measured speed.

    Args:
        belief: The prior.
        speed_mps: Speed of the rear axle, negative in reverse.
        var_m2ps2: Variance of the reading.
        gate_nis: NIS above which the reading is rejected; None accepts everything.

    Raises:
        ValueError: The reading is not finite or its variance not positive.
    """
    innovation = np.array([speed_mps - belief.mean[SPEED]])
    return _update_one(belief, SPEED, innovation, var_m2ps2, gate_nis)


def update_heading(
    belief: PoseBelief, heading_rad: float, var_rad2: float, gate_nis: float | None = None
) -> Updated:
    """Update with a compass heading; the innovation is wrapped.

    Raises:
        ValueError: The reading is not finite or its variance not positive.
    """
    innovation = np.array([_wrapped(heading_rad - belief.mean[HEADING])])
    return _update_one(belief, HEADING, innovation, var_rad2, gate_nis)


def update_position(
    belief: PoseBelief, xy_m: Floats, cov_m2: Floats, gate_nis: float | None = None
) -> Updated:
    """Update with a measured position and its covariance, such as a matched landmark's.

    Args:
        belief: The prior.
        xy_m: Shape (2,).
        cov_m2: Shape (2, 2), positive definite.
        gate_nis: NIS above which the position is rejected; None accepts everything.

    Raises:
        ValueError: A shape is wrong, a value is not finite, or ``cov_m2`` is not positive definite.
    """
    if xy_m.shape != (2,):
        raise ValueError(f"xy_m: expected (2,), got {xy_m.shape}")
    innovation = xy_m - belief.mean[:2]
    _check_measurement(innovation, cov_m2)
    (var_x, cov_xy), (_, var_y) = cov_m2.tolist()
    gate = math.inf if gate_nis is None else gate_nis
    found = pose_filter.update_position(
        pack_belief(belief), float(xy_m[0]), float(xy_m[1]), var_x, cov_xy, var_y, gate
    )
    after = unpack_belief(belief.t_ns, found.state) if found.is_accepted else belief
    return Updated(after, found.is_accepted, innovation, found.nis)


def major_axis_m(belief: PoseBelief) -> float:
    """Full major axis of the 2-sigma position ellipse: four standard deviations."""
    return pose_filter.major_axis_m(belief.cov[X, X], belief.cov[X, Y], belief.cov[Y, Y])


def is_lost(belief: PoseBelief, lost_m: float = LOST_M) -> bool:
    """Whether the major axis is longer than ``lost_m``."""
    return major_axis_m(belief) > lost_m


def _drive(
    mean: Floats,
    accel_mps2: float,
    dt_s: float,
    distance_m: float,
    turn_rad: float,
    distance_by: Floats,
    turn_by: Floats,
) -> MotionStep:
    """Transform the arc to the map; ``*_by`` are derivatives by speed and by the inputs."""
    step = arc(distance_m, turn_rad)
    heading = mean[HEADING]
    cosine, sine = math.cos(heading), math.sin(heading)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    moved = rotation @ np.array([step.dx_m, step.dy_m])
    arc_by = rotation @ np.array(
        [[step.dx_by_distance, step.dx_by_turn], [step.dy_by_distance, step.dy_by_turn]]
    )
    pose_by = np.vstack([arc_by @ np.vstack([distance_by, turn_by]), turn_by])
    by_state = np.eye(4)
    by_state[:2, HEADING] = -moved[1], moved[0]
    by_state[:3, SPEED] = pose_by[:, 0]
    by_input = np.zeros((4, pose_by.shape[1] - 1))
    by_input[:3], by_input[SPEED, 0] = pose_by[:, 1:], dt_s
    after = np.array(
        [
            mean[X] + moved[0],
            mean[Y] + moved[1],
            wrap(heading + turn_rad),
            mean[SPEED] + accel_mps2 * dt_s,
        ]
    )
    return MotionStep(after, by_state, by_input)


def _walk(summed: Floats, walked: Floats, dt_s: float) -> Floats:
    """Covariance of a random walk and of its integral over ``dt_s``, per unit of power."""
    both = np.outer(summed, walked)
    return dt_s * (
        np.outer(summed, summed) / 3.0 + (both + both.T) / 2.0 + np.outer(walked, walked)
    )


def _predicted(
    belief: PoseBelief,
    motion: MotionStep,
    dt_s: float,
    accel_mps2: float,
    noise: MotionNoise,
    turn_input_sd: float,
) -> PoseBelief:
    inputs = np.diag([noise.accel_mps2**2, turn_input_sd**2])
    cov = motion.by_state @ belief.cov @ motion.by_state.T
    cov += motion.by_input @ inputs @ motion.by_input.T
    distance_m = abs(belief.mean[SPEED] * dt_s + 0.5 * accel_mps2 * dt_s**2)
    along = np.array([math.cos(belief.mean[HEADING]), math.sin(belief.mean[HEADING])])
    cov[:2, :2] += noise.slip_per_sqrt_m**2 * distance_m * np.outer(along, along)
    return _belief(belief.t_ns + round(dt_s * 1e9), motion.mean, cov)


def _update_one(
    belief: PoseBelief, measured: int, innovation: Floats, var: float, gate_nis: float | None
) -> Updated:
    """Fuse a measurement of one state."""
    _check_measurement(innovation, np.array([[var]]))
    nis = float(innovation[0] ** 2 / (belief.cov[measured, measured] + var))
    if gate_nis is not None and nis > gate_nis:
        return Updated(belief, False, innovation, nis)
    after = pose_filter.update_state(pack_belief(belief), measured, float(innovation[0]), var)
    return Updated(unpack_belief(belief.t_ns, after), True, innovation, nis)


def _belief(t_ns: int, mean: Floats, cov: Floats) -> PoseBelief:
    return PoseBelief(t_ns, mean, 0.5 * (cov + cov.T))


def _wrapped(angle_rad: float) -> float:
    return wrap(angle_rad) if math.isfinite(angle_rad) else angle_rad


def _check_inputs(dt_s: float, **inputs: float) -> None:
    if not (math.isfinite(dt_s) and dt_s >= 0.0):
        raise ValueError(f"dt_s: expected finite and >= 0, got {dt_s}")
    for name, value in inputs.items():
        if not math.isfinite(value):
            raise ValueError(f"{name}: expected a finite number, got {value}")


def _check_measurement(innovation: Floats, cov: Floats) -> None:
    m = len(innovation)
    if cov.shape != (m, m):
        raise ValueError(f"measurement covariance: expected ({m}, {m}), got {cov.shape}")
    if not (np.isfinite(innovation).all() and np.isfinite(cov).all()):
        raise ValueError("measurement: expected finite numbers, got NaN or infinity")
    if (np.linalg.eigvalsh(cov) <= 0.0).any() or not np.allclose(cov, cov.T):
        raise ValueError(f"measurement covariance: expected positive definite, got {cov.tolist()}")


def pack_belief(belief: PoseBelief) -> State:
    """Convert a belief to a state, without its time."""
    p = belief.cov
    return State(*map(float, (*belief.mean, *p[0], *p[1, 1:], *p[2, 2:], p[3, 3])))


def unpack_belief(t_ns: int, state: State) -> PoseBelief:
    """Convert a state and a time to a belief."""
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    cov = np.array([[xx, xy, xh, xv], [xy, yy, yh, yv], [xh, yh, hh, hv], [xv, yv, hv, vv]])
    return PoseBelief(t_ns, np.array([x, y, heading, speed]), cov)
