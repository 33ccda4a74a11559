"""Errors of an estimated trajectory, and their consistency with its covariance.

Absolute (APE) and relative (RPE) pose errors as evo defines them (M. Grupp, *evo*; Sturm et al.,
"A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012), and the normalised estimation
error squared (NEES; Bar-Shalom, Li, Kirubarajan, section 5.4).

They use scipy's ``Rotation``, which is imported at the first use, because that takes 0.25 s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.truth.tum import Trajectory, heading_rad
from crosscue.eval.scoring.consistency import mean_band, quantile
from crosscue.localization.angles import wrap_all
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import UsageError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

Alignment: TypeAlias = Literal["none", "origin", "yaw"]
Indices: TypeAlias = NDArray[np.intp]


@dataclass(frozen=True, slots=True)
class Coverage:
    """Numbers of true poses that were scored or left out.

    Attributes:
        truth_poses: All true poses.
        scored: True poses with an estimate.
        before_estimate: True poses before the first estimate.
        after_estimate: True poses after the last estimate.
        in_gap: True poses in between, without an estimate near in time.
        ambiguous: True poses at times that occur twice on the log's clock.
    """

    truth_poses: int
    scored: int
    before_estimate: int
    after_estimate: int
    in_gap: int
    ambiguous: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Paired:
    """N true poses and the estimates for the same times.

    Attributes:
        truth: N poses.
        estimate: N poses at the times of the true ones.
        cov_xyh: Shape (N, 6): the estimate's covariance of x, y, heading: xx, xy, xh, yy, yh, hh;
            or None.
        coverage: Numbers of poses that were left out.
    """

    truth: Trajectory
    estimate: Trajectory
    cov_xyh: Floats | None
    coverage: Coverage


@dataclass(frozen=True, slots=True)
class ErrorStatistics:
    """Statistics of N errors, with evo's names; all NaN without errors."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float
    sse: float


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """N errors.

    Attributes:
        t_ns: Shape (N,): time of the pose, or of the later pose of a pair.
        translation_m: Shape (N,).
        rotation_rad: Shape (N,), in [0, pi].
    """

    t_ns: Int64s
    translation_m: Floats
    rotation_rad: Floats


@dataclass(frozen=True, slots=True)
class FilterAndSmoother:
    """Errors of a one-dimensional filter and of its smoother, at the same rows."""

    rows: int
    filter_rmse_m: float
    smoother_rmse_m: float
    filter_nees: float
    smoother_nees: float


@dataclass(frozen=True, slots=True)
class NeesSummary:
    """Consistency of errors with their covariance.

    Attributes:
        dimensions: Dimension of the error, which is the expected mean.
        rows: Number of rows with an invertible covariance.
        rows_singular: Number of rows with a singular covariance, which are left out.
        mean: Mean NEES.
        band_low: Lower end of the central 95 % interval of the mean of a consistent filter.
        band_high: Upper end of that interval.
        fraction_inside_95: Fraction of rows inside their 95 % region; 0.95 is expected.
    """

    dimensions: int
    rows: int
    rows_singular: int
    mean: float
    band_low: float
    band_high: float
    fraction_inside_95: float


def pair_poses(
    truth: Trajectory, estimate: Trajectory, max_difference_ns: int, cov_xyh: Floats | None = None
) -> Paired:
    """Interpolate the estimates at the times of the true poses.

    Args:
        truth: True poses.
        estimate: Estimated poses.
        max_difference_ns: Max time between a true pose and the nearest estimate.
        cov_xyh: Shape (M, 6): covariance of the estimates, to be paired as well.

    Raises:
        ValueError: ``cov_xyh`` does not fit the estimate.
        UsageError: No true pose has an estimate.
    """
    if cov_xyh is not None and cov_xyh.shape != (len(estimate), 6):
        raise ValueError(f"cov_xyh: expected ({len(estimate)}, 6), got {cov_xyh.shape}")
    if len(truth) == 0 or len(estimate) == 0:
        raise UsageError(f"{len(truth)} true and {len(estimate)} estimated poses: nothing to score")
    after = np.clip(np.searchsorted(estimate.t_ns, truth.t_ns), 0, len(estimate) - 1)
    before = np.maximum(after - (estimate.t_ns[after] > truth.t_ns), 0)
    to_before = np.abs(truth.t_ns - estimate.t_ns[before])
    to_after = np.abs(estimate.t_ns[after] - truth.t_ns)
    early, late = truth.t_ns < estimate.t_ns[0], truth.t_ns > estimate.t_ns[-1]
    near = (np.minimum(to_before, to_after) <= max_difference_ns) & ~early & ~late
    counts = (int(kind.sum()) for kind in (near, early, late, ~near & ~early & ~late))
    coverage = Coverage(len(truth), *counts)
    if not near.any():
        raise UsageError(f"no true pose has an estimate within {max_difference_ns} ns: {coverage}")
    at = truth.take(near)
    found, cov = _between(estimate, before[near], after[near], at.t_ns, cov_xyh)
    return Paired(at, found, cov, coverage)


def align(truth: Trajectory, estimate: Trajectory, how: Alignment) -> Trajectory:
    """Align the estimate with the truth by a rigid motion, without scaling.

    Args:
        truth: N poses.
        estimate: N poses at the same times.
        how: ``origin`` aligns the first poses. ``yaw`` rotates about the vertical and translates,
            by least squares of the positions.

    Raises:
        UsageError: The positions do not determine the rotation.
    """
    if how == "none":
        return estimate
    if how == "origin":
        turn = product(truth.quat_wxyz[0], inverse(estimate.quat_wxyz[0]))
        return _moved(estimate, turn, estimate.xyz_m[0], truth.xyz_m[0])
    center, to = estimate.xyz_m.mean(axis=0), truth.xyz_m.mean(axis=0)
    products = (estimate.xyz_m - center).T @ (truth.xyz_m - to)
    return _moved(estimate, _yaw_turn(products), center, to)


def ape(truth: Trajectory, estimate: Trajectory) -> PoseErrors:
    """Return the absolute error of each pose: evo's translation part and rotation angle."""
    turn = product(inverse(estimate.quat_wxyz), truth.quat_wxyz)
    distance = np.linalg.norm(estimate.xyz_m - truth.xyz_m, axis=1)
    return PoseErrors(truth.t_ns, distance, angle_rad(turn))


def rpe(truth: Trajectory, estimate: Trajectory, size_m: float) -> PoseErrors:
    """Return the error of the motion between consecutive poses ``size_m`` apart: evo's RPE.

    Pairs are chosen along the estimate, as in evo.

    Raises:
        ValueError: The size is not positive.
        UsageError: No two poses are that far apart.
    """
    if not (math.isfinite(size_m) and size_m > 0.0):
        raise ValueError(f"size_m: expected > 0, got {size_m}")
    stops, gone_m = [0], 0.0
    for i, step_m in enumerate(np.linalg.norm(np.diff(estimate.xyz_m, axis=0), axis=1), start=1):
        gone_m += float(step_m)
        if gone_m >= size_m:
            stops.append(i)
            gone_m = 0.0
    if len(stops) == 1:
        raise UsageError(f"no two of {len(estimate)} poses are {size_m:g} metres apart; use less")
    first, second = np.array(stops[:-1], np.intp), np.array(stops[1:], np.intp)
    true_step, true_turn = _steps(truth, first, second)
    step, turn = _steps(estimate, first, second)
    apart = np.linalg.norm(step - true_step, axis=1)
    return PoseErrors(truth.t_ns[second], apart, angle_rad(product(inverse(true_turn), turn)))


def statistics(errors: Floats) -> ErrorStatistics:
    """Return root mean square, mean, median, population s.d., extremes and sum of squares."""
    if len(errors) == 0:
        return ErrorStatistics(*[math.nan] * 7)
    squares = errors**2
    return ErrorStatistics(
        rmse=math.sqrt(squares.mean()),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        std=float(errors.std()),
        min=float(errors.min()),
        max=float(errors.max()),
        sse=float(squares.sum()),
    )


def squared_errors(paired: Paired, dimensions: Literal[2, 3]) -> Floats:
    """Return the squared error of (x, y) or (x, y, heading), normalised by the covariance.

    Returns:
        Shape (N,); NaN where the covariance cannot be inverted.

    Raises:
        ValueError: The estimate has no covariance.
    """
    if paired.cov_xyh is None:
        raise ValueError("cov_xyh: needed for NEES, got None")
    turn = wrap_all(heading_rad(paired.estimate) - heading_rad(paired.truth))
    error = np.column_stack([(paired.estimate.xyz_m - paired.truth.xyz_m)[:, :2], turn])
    upper = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    cov = paired.cov_xyh[:, upper][:, :dimensions, :dimensions]
    error = error[:, :dimensions]
    sd = np.sqrt(np.maximum(np.diagonal(cov, axis1=1, axis2=2), 0.0))
    claimed = np.asarray(np.isfinite(cov).all(axis=(1, 2)) & (sd > 0.0).all(axis=1))
    sd[~claimed] = 1.0
    correlation = np.where(claimed[:, None, None], cov, np.eye(dimensions))
    correlation = correlation / (sd[:, :, None] * sd[:, None, :])
    claimed &= np.linalg.eigvalsh(correlation)[:, 0] > 1e-12
    correlation[~claimed] = np.eye(dimensions)
    scaled = error / sd
    weighed = np.linalg.solve(correlation, scaled[:, :, None])[:, :, 0]
    return np.where(claimed, np.sum(scaled * weighed, axis=1), np.nan)


def summarise_nees(values: Floats, dimensions: int, independent: int = 1) -> NeesSummary:
    """Return the mean NEES with its 95 % band.

    Args:
        values: Shape (N,); NaN rows are left out.
        dimensions: Dimension of the error.
        independent: Number of independent errors among the rows. Rows of one drive are correlated
            and count as one, so this is the number of drives.
    """
    kept = values[np.isfinite(values)]
    low, high = mean_band(dimensions, independent)
    limit = quantile(0.95, dimensions)
    some = len(kept) > 0
    return NeesSummary(
        dimensions=dimensions,
        rows=len(kept),
        rows_singular=len(values) - len(kept),
        mean=float(kept.mean()) if some else math.nan,
        band_low=low,
        band_high=high,
        fraction_inside_95=float((kept <= limit).mean()) if some else math.nan,
    )


def _between(
    estimate: Trajectory, before: Indices, after: Indices, t_ns: Int64s, cov_xyh: Floats | None
) -> tuple[Trajectory, Floats | None]:
    span_ns = np.maximum(estimate.t_ns[after] - estimate.t_ns[before], 1)
    fraction = np.where(after > before, (t_ns - estimate.t_ns[before]) / span_ns, 0.0)

    def mixed(columns: Floats) -> Floats:
        return columns[before] + fraction[:, None] * (columns[after] - columns[before])

    quat = between(estimate.quat_wxyz[before], estimate.quat_wxyz[after], fraction)
    found = Trajectory(t_ns, mixed(estimate.xyz_m), quat)
    return found, None if cov_xyh is None else mixed(cov_xyh)


def _moved(estimate: Trajectory, turn: Floats, center: Floats, to: Floats) -> Trajectory:
    """Rotate a trajectory about ``center``, and move ``center`` to ``to``."""
    xyz = rotate(turn, estimate.xyz_m - center) + to
    return Trajectory(estimate.t_ns, xyz, product(turn, estimate.quat_wxyz))


def _yaw_turn(products: Floats) -> Floats:
    along = products[0, 0] + products[1, 1]
    across = products[0, 1] - products[1, 0]
    if math.hypot(along, across) <= 1e-12 * max(float(np.abs(products).max()), 1e-300):
        raise UsageError("the positions do not determine yaw (no motion?); align by origin or none")
    return about_z(math.atan2(across, along))


def _steps(trajectory: Trajectory, first: Indices, second: Indices) -> tuple[Floats, Floats]:
    """Return each later pose in the frame of the earlier one."""
    back = inverse(trajectory.quat_wxyz[first])
    step = rotate(back, trajectory.xyz_m[second] - trajectory.xyz_m[first])
    return step, product(back, trajectory.quat_wxyz[second])


def rotation_of(quat: Floats) -> Rotation:
    """Return the rotation of unit quaternions, shape (4,) or (N, 4)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(quat, -1, axis=-1))


def quat_of(rotation: Rotation) -> Floats:
    """Return the quaternion of a rotation, with w not negative."""
    quat: Floats = np.roll(rotation.as_quat(canonical=True), 1, axis=-1)
    return quat


def product(a: Floats, b: Floats) -> Floats:
    """Return the rotation by ``b`` and then by ``a``; shapes (4,) or (N, 4)."""
    return quat_of(rotation_of(a) * rotation_of(b))


def inverse(quat: Floats) -> Floats:
    """Return the inverse rotation; shape (4,) or (N, 4)."""
    return quat_of(rotation_of(quat).inv())


def rotate(quat: Floats, xyz: Floats) -> Floats:
    """Rotate vectors; shapes (4,) or (N, 4), and (N, 3)."""
    turned: Floats = rotation_of(quat).apply(xyz)
    return turned


def angle_rad(quat: Floats) -> Floats:
    """Return the angle of each rotation, in [0, pi]; shape () or (N,)."""
    angle: Floats = rotation_of(quat).magnitude()
    return angle


def between(a: Floats, b: Floats, fraction: Floats) -> Floats:
    """Interpolate between ``a`` and ``b`` along the shorter arc (slerp).

    Args:
        a: Shape (N, 4).
        b: Shape (N, 4).
        fraction: Shape (N,), from 0 at ``a`` to 1 at ``b``.
    """
    from scipy.spatial.transform import Rotation

    start = rotation_of(a)
    turn = (start.inv() * rotation_of(b)).as_rotvec()
    return quat_of(start * Rotation.from_rotvec(fraction[:, None] * turn))


def about_z(angle: float) -> Floats:
    """Return the rotation about the vertical by an angle; shape (4,)."""
    return np.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
