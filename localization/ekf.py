"""A belief of the pose at a time, and the derivatives of its motion.

State ``[x_m, y_m, heading_rad, speed_mps]``: the centre of the rear axle in a planar map frame
(x east, y north), heading counter-clockwise from +x (REP-103), speed negative in reverse. The
filter's equations are those of ``pose_filter``.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from crosscue.replay.columns import Floats

from .pose_filter import HEADING, SPEED, State, arc, at_point, update_position

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


class Updated(NamedTuple):
    """The outcome of one measurement.

    Attributes:
        belief: The posterior, or the unchanged prior if the gate rejected the measurement.
        is_accepted: True if the measurement is inside the gate.
        nis: Normalised innovation squared; chi-square with two degrees of freedom.
    """

    belief: PoseBelief
    is_accepted: bool
    nis: float


def update_point(
    belief: PoseBelief,
    xy_m: Floats,
    cov_m2: Floats,
    lever_m: tuple[float, float] = (0.0, 0.0),
    gate_nis: float | None = None,
) -> Updated:
    """Update with a measured position of a point of the car.

    Args:
        belief: The prior.
        xy_m: Shape (2,).
        cov_m2: Shape (2, 2), positive definite.
        lever_m: The point, ahead of and to the left of the rear axle.
        gate_nis: NIS above which the position is rejected; None accepts everything.

    Raises:
        ValueError: A number is not finite.
    """
    if not (np.isfinite(xy_m).all() and np.isfinite(cov_m2).all()):
        raise ValueError(f"position: expected finite numbers, got {xy_m}, {cov_m2}")
    (x_m, y_m), ((xx, xy), (_, yy)) = xy_m.tolist(), cov_m2.tolist()
    ahead_m, left_m = lever_m
    gate = math.inf if gate_nis is None else gate_nis
    point = at_point(pack_belief(belief), ahead_m, left_m)
    done = update_position(point, x_m, y_m, xx, xy, yy, gate)
    if not done.is_accepted:
        return Updated(belief, False, done.nis)
    after = unpack_belief(belief.t_ns, at_point(done.state, -ahead_m, -left_m))
    return Updated(after, True, done.nis)


def odometry_derivatives(
    heading_rad: float, distance_m: float, turn_rad: float, by: Floats
) -> tuple[Floats, Floats]:
    """Derivatives of the pose after an arc of odometry by the state before and by K parameters.

    ``by``, shape (2, K), has the derivatives of distance and turn by the parameters; the result has
    shapes (4, 4) and (4, K).
    """
    step = arc(distance_m, turn_rad)
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    moved_x, moved_y = rotation @ np.array([step.dx_m, step.dy_m])
    arc_by = np.array(
        [[step.dx_by_distance, step.dx_by_turn], [step.dy_by_distance, step.dy_by_turn]]
    )
    by_state = np.eye(4)
    by_state[:2, HEADING] = -moved_y, moved_x
    by_input = np.zeros((4, by.shape[1]))
    by_input[:2], by_input[HEADING] = rotation @ arc_by @ by, by[1]
    return by_state, by_input


def coasting(mean: Floats, dt_s: float) -> tuple[Floats, Floats]:
    """The mean after a straight drive at constant speed, and its derivatives by the one before."""
    along = np.array([math.cos(mean[HEADING]), math.sin(mean[HEADING])])
    distance_m = mean[SPEED] * dt_s
    after, by_state = mean.copy(), np.eye(4)
    after[:2] += distance_m * along
    by_state[:2, HEADING] = -distance_m * along[1], distance_m * along[0]
    by_state[:2, SPEED] = dt_s * along
    return after, by_state


def coast(
    belief: PoseBelief, dt_s: float, accel_var_m2ps3: float, turn_var_rad2ps: float
) -> PoseBelief:
    """Predict without measurements, straight and at constant speed, with growing variances.

    Acceleration and yaw rate are white noise of the given power, so that two short coasts make
    one long one (Bar-Shalom, Li, Kirubarajan, section 6.2.2).

    Raises:
        ValueError: ``dt_s`` or a variance is negative or not finite.
    """
    for name, value in (
        ("dt_s", dt_s),
        ("accel_var_m2ps3", accel_var_m2ps3),
        ("turn_var_rad2ps", turn_var_rad2ps),
    ):
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name}: expected finite and >= 0, got {value}")
    mean, by_state = coasting(belief.mean, dt_s)
    heading, distance_m = belief.mean[HEADING], belief.mean[SPEED] * dt_s
    along = np.array([math.cos(heading), math.sin(heading), 0.0, 0.0])
    across = np.array([-math.sin(heading), math.cos(heading), 0.0, 0.0])
    faster, turned = np.eye(4)[SPEED], np.eye(4)[HEADING]
    cov = by_state @ belief.cov @ by_state.T
    cov += accel_var_m2ps3 * _walk(along * dt_s, faster, dt_s)
    cov += turn_var_rad2ps * _walk(across * distance_m, turned, dt_s)
    return PoseBelief(belief.t_ns + round(dt_s * 1e9), mean, 0.5 * (cov + cov.T))


def _walk(summed: Floats, walked: Floats, dt_s: float) -> Floats:
    """Covariance of a random walk and of its integral over ``dt_s``, per unit of power."""
    both = np.outer(summed, walked)
    return dt_s * (
        np.outer(summed, summed) / 3.0 + (both + both.T) / 2.0 + np.outer(walked, walked)
    )


def pack_belief(belief: PoseBelief) -> State:
    """Convert a belief to a state, without its time."""
    p = belief.cov
    return State(*map(float, (*belief.mean, *p[0], *p[1, 1:], *p[2, 2:], p[3, 3])))


def unpack_belief(t_ns: int, state: State) -> PoseBelief:
    """Convert a state and a time to a belief."""
    x, y, heading, speed, xx, xy, xh, xv, yy, yh, yv, hh, hv, vv = state
    cov = np.array([[xx, xy, xh, xv], [xy, yy, yh, yv], [xh, yh, hh, hv], [xv, yv, hv, vv]])
    return PoseBelief(t_ns, np.array([x, y, heading, speed]), cov)
