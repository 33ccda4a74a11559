"""Joint estimate of range and height of a light or sign, from its growth as the car moves.

A pinhole camera of focal length f sees an object of height H at depth R as h = f H / R pixels. Over
the distance s travelled towards it, 1 / h decreases linearly: 1 / h = (R0 - s) / (f H). The growth
therefore determines R without knowledge of H. The standard size (``standard_sizes``) is the prior
of H. It is the only information while the car stands, and is outweighed as the car moves.

In logarithms, ln h = ln f + ln H - ln R + error, and H is lognormal. Given R, everything is
Gaussian, so H is integrated out exactly, and the posterior of R is computed on a grid. The prior of
R is flat in ln R, so that size alone errs equally often to either side. Two measures prevent
overconfidence:

* Errors of heights in successive frames are correlated, so an observation soon after another has
  little weight (``HeightErrors.resemble_m``).
* An observation far from the others (a box over two lights, or another object) has almost no
  weight.

The scale of the errors is estimated with the range, from residuals and a weak prior.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass
from statistics import median
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .standard_sizes import SizePrior

Floats: TypeAlias = NDArray[np.float64]
Limits: TypeAlias = tuple[float, float]


@dataclass(frozen=True, slots=True)
class HeightErrors:
    """Prior of the errors of a box's height.

    They were measured about the straight line of 1 / height over the distance travelled, with 70 to
    160 observations each: 2.1 and 2.7 % at 38 and 60 px (two lights, yolox-nano, real pictures),
    3.3 to 7.4 % at 20 to 30 px (three lights, embedded network, simulated pictures).

    Attributes:
        fraction: Standard deviation as a fraction of the height.
        edges_px: Standard deviation in pixels, added in squares.
        resemble_m: Correlation length of the errors, as distance travelled.
        worth: Weight of this prior of the errors' scale, in independent observations.
    """

    fraction: float = 0.04
    edges_px: float = 1.0
    resemble_m: float = 1.0
    worth: float = 8.0


@dataclass(frozen=True, slots=True)
class MotionRange:
    """Range at the last observation, and the object's height.

    Attributes:
        mean_m: Mean depth along the camera's axis, from the camera.
        var_m2: Variance of the depth.
        height_m: The object's height at ``mean_m``.
        by_motion: Fraction of the prior variance that motion removed, in [0, 1].
        log_height: Mean of the logarithm of the height.
        log_height_var: Variance of the logarithm of the height.
    """

    mean_m: float
    var_m2: float
    height_m: float
    by_motion: float
    log_height: float
    log_height_var: float


NEAREST_M: Final = 0.5
FURTHEST_M: Final = 500.0
WIDE: Final = np.linspace(0.0, 1.0, 101)
# Half of the width of a fine grid in standard deviations of the posterior, and its steps: sums over
# a smooth density are exact to rounding if a step is less than half a standard deviation.
REACH_SD: Final = 8.0
STEPS: Final = np.linspace(0.0, 1.0, 41)
# A fine grid fits if the mean is at most so many standard deviations off its middle, and the
# variance is right within a factor; else another grid follows.
MAX_OFF_SD: Final = 0.5
MAX_RATIO: Final = 1.25
# Number of standard deviations beyond which an observation's weight decreases with the square of
# its distance.
OUTLIER: Final = 2.5
# Maximum number of rounds of reweighting, which converges in three or four, and of fine grids.
ROUNDS: Final = 8


def range_from_motion(
    travelled_m: Floats,
    height_px: Floats,
    focal_px: float,
    size: SizePrior,
    errors: HeightErrors = HeightErrors(),
) -> MotionRange:
    """Estimate range and height of one object from all its observations.

    Args:
        travelled_m: Shape (N,), N > 0, odometer readings in time order, forwards positive.
        height_px: Shape (N,), heights of its boxes.
        focal_px: Focal length, in the same pixels.
        size: Prior of the object's height.
        errors: Prior of the errors of ``height_px``.

    Raises:
        ValueError: There are no observations, shapes differ, or a height or the focal length is not
            positive.
    """
    seen = _checked(travelled_m, height_px, focal_px, size, errors)
    log_mean, log_var = size.log_mean, size.log_var
    nearest_m = max(NEAREST_M, 1.01 * -float(seen.ahead_m.min()))
    furthest_m = max(FURTHEST_M, 2.0 * nearest_m)
    limits = (math.log(nearest_m), math.log(furthest_m))
    range_m = np.exp(limits[0] + (limits[1] - limits[0]) * WIDE)
    off = seen.off(range_m[:, None])
    new = seen.worth * _first_weights(off, seen.var)
    post, at_mean = _on_grid(range_m, WIDE, off, new, log_var), 0.0
    for _ in range(1 + ROUNDS):
        weights = new
        post = _refined(seen, post, limits, weights, log_var)
        off = seen.off(post.mean_m)
        at_mean = float(off.dot(weights)) / post.precision
        new = _weights(seen, off - at_mean, errors)
        if (np.abs(new - weights) <= 1e-3 * weights).all():
            break
    excess = median(one + log_mean for one in seen.log_excess[-5:].tolist())
    log_range_var = float(seen.var[-1]) + log_var
    before_m2 = _var_of_one_m2(log_mean - excess, log_range_var, limits)
    var_m2 = max(_moments(post.density, post.range_m)[1], 1e-12)
    by_motion = min(max(1.0 - var_m2 / before_m2, 0.0), 1.0)
    log_height, log_height_var = post.log_height()
    return MotionRange(
        post.mean_m,
        var_m2,
        math.exp(log_mean + at_mean),
        by_motion,
        log_mean + log_height,
        log_height_var,
    )


def range_from_size(height_px: float, focal_px: float, size: SizePrior) -> MotionRange:
    """Estimate the range of one box from the prior of the size alone, in closed form.

    Args:
        height_px: Height of the box, positive.
        focal_px: Focal length, in the same pixels.
        size: Prior of the object's height.
    """
    mean_m = focal_px * size.mean_m / height_px
    var_m2 = (size.spread * mean_m) ** 2
    return MotionRange(mean_m, var_m2, size.mean_m, 0.0, size.log_mean, size.log_var)


class _Observations(NamedTuple):
    """All observations, as arrays of shape (N,).

    Attributes:
        ahead_m: Range at the observation minus range at the last observation.
        log_excess: Logarithm of height over focal length, less the mean logarithm of the size.
        var: Prior variance of ``log_excess``.
        worth: Weight of each observation, in independent observations.
    """

    ahead_m: Floats
    log_excess: Floats
    var: Floats
    worth: Floats

    def off(self, range_m: Floats | float) -> Floats:
        """Log height above its mean if the last range is ``range_m``, shape (G, 1) or a number."""
        found: Floats = range_m + self.ahead_m
        np.log(found, out=found)
        found += self.log_excess
        return found


def _checked(
    travelled_m: Floats, height_px: Floats, focal_px: float, size: SizePrior, errors: HeightErrors
) -> _Observations:
    if travelled_m.ndim != 1 or travelled_m.shape != height_px.shape or not len(travelled_m):
        raise ValueError(
            f"travelled_m, height_px: expected (N,), got {travelled_m.shape}, {height_px.shape}"
        )
    if not math.isfinite(travelled_m.dot(travelled_m) + height_px.dot(height_px)):
        raise ValueError("travelled_m, height_px: expected finite numbers")
    if not (np.minimum.reduce(height_px) > 0.0 and 0.0 < focal_px < np.inf):
        raise ValueError("height_px, focal_px: expected positive numbers")
    step_m = np.abs(travelled_m[1:] - travelled_m[:-1])
    # With a correlation of exp(-step / length) to the previous one, the weight of an observation is
    # tanh(step / length / 2).
    worth = np.concatenate(([1.0], np.tanh(0.5 * step_m / errors.resemble_m)))
    var = errors.fraction**2 + (errors.edges_px / height_px) ** 2
    log_excess = np.log(height_px / focal_px) - size.log_mean
    return _Observations(travelled_m[-1] - travelled_m, log_excess, var, worth)


def _var_of_one_m2(log_mean: float, log_var: float, limits: Limits) -> float:
    """Variance of the range from one observation: that of a lognormal within limits of the log."""
    sd = math.sqrt(log_var)
    ends = [(one - log_mean) / sd for one in limits]
    # Integrals of the powers 0, 1 and 2.
    none, one, two = (
        math.exp(k * log_mean + 0.5 * (k * sd) ** 2)
        * (
            math.erf((ends[1] - k * sd) / math.sqrt(2.0))
            - math.erf((ends[0] - k * sd) / math.sqrt(2.0))
        )
        for k in range(3)
    )
    return two / none - (one / none) ** 2


def _first_weights(off: Floats, var: Floats) -> Floats:
    """Robust initial weights, from the range with the least median absolute residual."""
    away = np.abs(off - _medians(off)[:, None])
    typical = _medians(away)
    best = int((typical + np.add.reduce(away, axis=1) / len(var)).argmin())
    scale = np.maximum(1.4826 * typical[best], np.sqrt(var))
    return np.asarray(_trust((away[best] / scale) ** 2) / scale**2, np.float64)


def _medians(rows: Floats) -> Floats:
    """Median of each row, shape (G,); sorting is several times faster than ``np.median``."""
    count, ordered = rows.shape[1], rows.copy()
    ordered.sort(axis=1)
    return np.asarray(0.5 * (ordered[:, (count - 1) // 2] + ordered[:, count // 2]), np.float64)


def _weights(seen: _Observations, residual: Floats, errors: HeightErrors) -> Floats:
    """Worth times inverse variances, with the errors' scale from the residuals and its prior."""
    squares = residual * residual / seen.var
    # Sums over the nearest and over the furthest observations, of every number of them.
    order = squares.argsort()
    worth, ordered = seen.worth[order], squares[order]
    sums = np.zeros((4, len(order) + 1))
    sums[0, 1:], sums[1, 1:] = worth, worth * ordered
    sums[2, 1:], sums[3, 1:] = worth[::-1], (worth / np.maximum(ordered, 1e-300))[::-1]
    near, near_squares, far, far_shares = sums.cumsum(axis=1).tolist()
    limits, scale, before = ordered.tolist(), 1.0, math.nan
    for _ in range(ROUNDS):
        if scale == before:
            break
        limit = OUTLIER**2 * scale
        count = bisect_right(limits, limit)
        total = near[count] + limit * far_shares[len(limits) - count]
        of_squares = near_squares[count] + limit * far[len(limits) - count]
        # Range and size use up two degrees of freedom.
        left = max(total - 2.0, 0.0)
        before, scale = scale, (errors.worth + of_squares) / (errors.worth + left)
    return np.asarray(seen.worth * _trust(squares / scale) / (scale * seen.var), np.float64)


def _trust(squares: Floats) -> Floats:
    """Weight by the square of the distance in standard deviations."""
    return OUTLIER**2 / np.maximum(squares, OUTLIER**2)


class _Posterior(NamedTuple):
    """Posterior of the range, with the size integrated out, on a grid of equal steps of its log.

    Attributes:
        range_m: Shape (G,): the grid.
        density: Shape (G,), of sum 1.
        pull: Shape (G,): weighted sum of the log heights at each range.
        precision: Inverse variance of the log height at a given range.
        mean_m: Mean of the range.
        log_mean: Mean of its logarithm.
        log_var: Variance of its logarithm.
        step: Step of the logarithm.
    """

    range_m: Floats
    density: Floats
    pull: Floats
    precision: float
    mean_m: float
    log_mean: float
    log_var: float
    step: float

    def log_height(self) -> tuple[float, float]:
        """Mean above its prior mean, and variance, of the logarithm of the height."""
        mean, var = _moments(self.density, self.pull / self.precision)
        return mean, var + 1.0 / self.precision


def _refined(
    seen: _Observations, post: _Posterior, limits: Limits, weights: Floats, log_var: float
) -> _Posterior:
    """Compute the posterior on grids around the last one, until a grid fits its posterior."""
    for _ in range(ROUNDS):
        old, reach = post, max(REACH_SD * math.sqrt(post.log_var), 2.0 * post.step)
        ends = max(post.log_mean - reach, limits[0]), min(post.log_mean + reach, limits[1])
        range_m = np.exp(ends[0] + (ends[1] - ends[0]) * STEPS)
        post = _on_grid(range_m, STEPS, seen.off(range_m[:, None]), weights, log_var)
        is_near = abs(post.log_mean - old.log_mean) <= MAX_OFF_SD * math.sqrt(post.log_var)
        if is_near and 1.0 / MAX_RATIO <= post.log_var / old.log_var <= MAX_RATIO:
            break
    return post


def _on_grid(
    range_m: Floats, steps: Floats, off: Floats, weights: Floats, size_var: float
) -> _Posterior:
    """Posterior from log heights, shape (G, N), at ranges whose logarithms are at ``steps``."""
    # Methods and ufuncs take half of the time of operators and functions on arrays of this size.
    precision = float(np.add.reduce(weights)) + 1.0 / size_var
    pull = off.dot(weights)
    density = pull * pull
    density *= 0.5 / precision
    density -= (off * off).dot(0.5 * weights)
    density -= np.maximum.reduce(density)
    np.exp(density, out=density)
    # The trapezoidal rule, for a density that the limits cut off.
    density[:: len(steps) - 1] *= 0.5
    density /= np.add.reduce(density)
    first, wide = math.log(range_m[0]), math.log(range_m[-1] / range_m[0])
    (mean, var), mean_m = _moments(density, steps), float(density.dot(range_m))
    log_mean, log_var = first + mean * wide, max(var * wide * wide, 1e-12)
    step = wide * float(steps[1])
    return _Posterior(range_m, density, pull, precision, mean_m, log_mean, log_var, step)


def _moments(density: Floats, values: Floats) -> tuple[float, float]:
    """Mean and variance of values, shape (G,), by their density."""
    mean = float(density.dot(values))
    off = values - mean
    return mean, float(density.dot(off * off))
