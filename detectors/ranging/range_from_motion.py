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

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from statistics import median
from typing import Final, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .standard_sizes import SizePrior

Floats: TypeAlias = NDArray[np.float64]


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
GRID: Final = 101
STEPS: Final = np.linspace(0.0, 1.0, GRID)
# Number of standard deviations beyond which an observation's weight decreases with the square of
# its distance.
OUTLIER: Final = 2.5
# Number of rounds of reweighting; weights converge in three or four.
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
    wide = _Grid.of(seen, *_ranges(nearest_m, furthest_m))
    weights = seen.worth * _first_weights(wide.off, seen.var)
    post = _refined(seen, wide, weights, log_var)
    for _ in range(ROUNDS):
        new = seen.worth * _weights(seen, seen.off(post.mean_m) - post.at_mean, errors)
        if (np.abs(new - weights) <= 1e-3 * weights).all():
            break
        weights = new
        post = _refined(seen, wide, weights, log_var)
    excess = median(one + log_mean for one in seen.log_excess[-5:].tolist())
    log_range_var = float(seen.var[-1]) + log_var
    before_m2 = _var_of_one_m2(log_mean - excess, log_range_var, (nearest_m, furthest_m))
    by_motion = min(max(1.0 - post.var_m2 / before_m2, 0.0), 1.0)
    log_height, log_height_var = post.log_height()
    return MotionRange(
        post.mean_m,
        post.var_m2,
        math.exp(log_mean + post.at_mean),
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
    if not (np.isfinite(travelled_m).all() and np.isfinite(height_px).all()):
        raise ValueError("travelled_m, height_px: expected finite numbers")
    if not ((height_px > 0.0).all() and 0.0 < focal_px < np.inf):
        raise ValueError("height_px, focal_px: expected positive numbers")
    step_m = np.abs(np.diff(travelled_m))
    # With a correlation of exp(-step / length) to the previous one, the weight of an observation is
    # tanh(step / length / 2).
    worth = np.concatenate(([1.0], np.tanh(0.5 * step_m / errors.resemble_m)))
    var = errors.fraction**2 + (errors.edges_px / height_px) ** 2
    log_excess = np.log(height_px / focal_px) - size.log_mean
    return _Observations(travelled_m[-1] - travelled_m, log_excess, var, worth)


class _Grid(NamedTuple):
    """Ranges, shape (G,), with their prior, and log height above its mean, shape (G, N)."""

    range_m: Floats
    prior: Floats
    off: Floats
    squares: Floats

    @classmethod
    def of(cls, seen: _Observations, range_m: Floats, prior: Floats) -> Self:
        """Compute the heights."""
        off = seen.off(range_m[:, None])
        return cls(range_m, prior, off, off * off)


@lru_cache(maxsize=8)
def _ranges(nearest_m: float, furthest_m: float) -> tuple[Floats, Floats]:
    range_m = np.geomspace(nearest_m, furthest_m, GRID)
    return range_m, np.asarray(np.gradient(range_m) / range_m, np.float64)


def _var_of_one_m2(log_mean: float, log_var: float, limits_m: tuple[float, float]) -> float:
    """Variance of the range from one observation: that of a lognormal within limits."""
    sd = math.sqrt(log_var)
    ends = [(math.log(one) - log_mean) / sd for one in limits_m]
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
    """Inverse variances, with the errors' scale from the residuals and its prior."""
    squares = residual * residual / seen.var
    most, weighted = float(squares.max()), float(seen.worth.dot(squares))
    count, scale, before = float(np.add.reduce(seen.worth)), 1.0, math.nan
    for _ in range(ROUNDS):
        if scale == before:
            break
        total, of_squares = count, weighted
        if most / scale > OUTLIER**2:
            trust = seen.worth * _trust(squares / scale)
            total, of_squares = float(np.add.reduce(trust)), float(trust.dot(squares))
        # Range and size use up two degrees of freedom.
        left = max(total - 2.0, 0.0)
        before, scale = scale, (errors.worth + of_squares) / (errors.worth + left)
    return np.asarray(_trust(squares / scale) / (scale * seen.var), np.float64)


def _trust(squares: Floats) -> Floats:
    """Weight by the square of the distance in standard deviations."""
    return OUTLIER**2 / np.maximum(squares, OUTLIER**2)


class _Posterior(NamedTuple):
    """Posterior of the range, with the size integrated out.

    Attributes:
        mean_m: Its mean.
        var_m2: Its variance.
        density: Shape (G,), of sum 1.
        pull: Shape (G,): weighted sum of the log heights at each range.
        at_mean: Log height at the mean range, above its prior mean.
        precision: Inverse variance of the log height at a given range.
    """

    mean_m: float
    var_m2: float
    density: Floats
    pull: Floats
    at_mean: float
    precision: float

    def log_height(self) -> tuple[float, float]:
        """Mean above its prior mean, and variance, of the logarithm of the height."""
        mean, var = _moments(self.density, self.pull / self.precision)
        return mean, var + 1.0 / self.precision


def _refined(seen: _Observations, grid: _Grid, weights: Floats, log_var: float) -> _Posterior:
    """Compute the posterior on successively finer grids; it can be narrower than a grid's steps."""
    precision = float(np.add.reduce(weights)) + 1.0 / log_var
    mean_m, var_m2, density, pull = _on_grid(grid, weights, precision)
    for _ in range(2):
        range_m = grid.range_m
        near = max(int(range_m.searchsorted(mean_m)), 1)
        step_m = float(range_m[min(near, GRID - 1)] - range_m[near - 1])
        reach_m = max(8.0 * math.sqrt(var_m2), 2.0 * step_m)
        near_m = max(mean_m - reach_m, float(range_m[0]))
        range_m = near_m + (min(mean_m + reach_m, float(range_m[-1])) - near_m) * STEPS
        grid = _Grid.of(seen, range_m, 1.0 / range_m)
        mean_m, var_m2, density, pull = _on_grid(grid, weights, precision)
    at_mean = float(seen.off(mean_m).dot(weights)) / precision
    return _Posterior(mean_m, max(var_m2, 1e-12), density, pull, at_mean, precision)


def _on_grid(grid: _Grid, weights: Floats, precision: float) -> tuple[float, float, Floats, Floats]:
    """Mean, variance and density of the range, and weighted sums of the log heights."""
    # Methods and ufuncs take half of the time of operators and functions on arrays of this size.
    pull = grid.off.dot(weights)
    log_density = pull * pull / precision - grid.squares.dot(weights)
    density = np.exp(0.5 * (log_density - np.maximum.reduce(log_density))) * grid.prior
    density /= np.add.reduce(density)
    return *_moments(density, grid.range_m), density, pull


def _moments(density: Floats, values: Floats) -> tuple[float, float]:
    """Mean and variance of values, shape (G,), by their density."""
    mean = float(density.dot(values))
    off = values - mean
    return mean, float(density.dot(off * off))
