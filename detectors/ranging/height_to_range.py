"""Fit a curve from an object's height in pixels to its range.

For a pinhole camera and an object of fixed size the range is a / height. An offset accounts for a
camera ahead of the rear axle and for masks that are slightly too large. The data decide which
family of curves fits best.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError, UsageError
from crosscue.replay.vehicle.vehicle import RangeCurve
from crosscue.results import HIDDEN

Family = Literal["pinhole", "pinhole-offset", "power"]
FAMILIES: Final[tuple[Family, ...]] = ("pinhole", "pinhole-offset", "power")


@dataclass(frozen=True, slots=True)
class Bin:
    """Residuals of the pairs in an interval of ranges.

    Attributes:
        from_m: Start of the interval.
        to_m: End of the interval, exclusive.
        pairs: Number of pairs.
        mean_m: Mean of fitted minus true range.
        rms_m: Root mean square of fitted minus true range.
    """

    from_m: float
    to_m: float
    pairs: int
    mean_m: float
    rms_m: float


@dataclass(frozen=True, slots=True)
class RangeFit:
    """A fitted curve.

    Attributes:
        curve: The curve, in the form of the vehicle file.
        pairs: Number of pairs used.
        bins: Residuals by distance.
        outliers: Number of pairs left out, which have a wrong object or mask.
    """

    curve: RangeCurve = field(metadata=HIDDEN)
    pairs: int
    bins: tuple[Bin, ...]
    outliers: int = 0

    also: ClassVar = {name: f"curve.{name}" for name in RangeCurve.model_fields}


# Number of scales from the curve beyond which a pair is an outlier. It must be beyond both in
# metres and relative to the range, because it is unknown whether errors grow with the range. Scales
# are median absolute deviations, which ten per cent of bad pairs hardly change.
OUTLIER_SIGMAS: Final = 5.0
# Relative distance from the curve below which no pair is an outlier, for pairs without errors.
MIN_OUTLIER: Final = 0.02
# Relative residual above which pairs have less weight in the first fit.
SOFT_FRACTION: Final = 0.05
# Maximum number of rounds of fitting and removing outliers; two or three usually suffice.
ROUNDS: Final = 10


def range_of(height_px: Floats, curve: RangeCurve) -> Floats:
    """Compute ranges in metres from heights in pixels, shape (N,)."""
    return _CURVES[curve.family][0](height_px, np.array(curve.parameters))


def fit_range(height_px: Floats, range_m: Floats, family: Family, bin_m: float = 10.0) -> RangeFit:
    """Fit one family by least squares of the range, without outliers.

    The first fit is robust (``soft_l1`` of relative residuals). Pairs beyond ``OUTLIER_SIGMAS`` of
    it are left out and counted, and the remaining pairs are fitted.

    Args:
        height_px: Shape (N,), positive.
        range_m: Shape (N,), true ranges, positive.
        family: ``pinhole`` a / h; ``pinhole-offset`` a / h + b; ``power`` a * h ** b.
        bin_m: Width of the bins of distance.

    Raises:
        EmptyResultError: There are too few pairs.
        UsageError: A number is not finite or not positive, or too few pairs are on one curve.
    """
    model, rest = _CURVES[family]
    bad = ~(np.isfinite(height_px) & np.isfinite(range_m) & (height_px > 0.0) & (range_m > 0.0))
    if bad.any():
        raise UsageError(
            f"row {int(np.flatnonzero(bad)[0]) + 1}: height and range: expected positive"
        )
    count = 1 + len(rest)
    if len(np.unique(height_px)) <= count:
        raise EmptyResultError(f"{family}: expected more than {count} different heights to fit it")
    guess = np.array([float(np.median(range_m * height_px)), *rest])
    from scipy.optimize import least_squares

    scale = np.maximum(np.abs(guess), 1.0)

    def relative(p: Floats) -> Floats:
        return np.asarray(model(height_px, p * scale) / range_m - 1.0, np.float64)

    robust = least_squares(relative, guess / scale, loss="soft_l1", f_scale=SOFT_FRACTION)
    parameters = np.asarray(robust.x, np.float64) * scale
    keep = np.ones(len(range_m), np.bool_)
    for _ in range(ROUNDS):
        off_m = model(height_px, parameters) - range_m
        is_near = np.abs(off_m) <= MIN_OUTLIER * range_m
        before, keep = keep, _inliers(off_m) | _inliers(off_m / range_m) | is_near
        if len(np.unique(height_px[keep])) <= count:
            raise UsageError(f"{family}: too few of {len(range_m)} pairs are on one curve")
        near_px, near_m = height_px[keep], range_m[keep]
        fitted = least_squares(_residual_of(model, near_px, near_m, scale), parameters / scale)
        parameters = np.asarray(fitted.x, np.float64) * scale
        if np.array_equal(before, keep):
            break
    residual = model(near_px, parameters) - near_m
    freedom = len(near_m) - count
    sd = max(float(np.sqrt(np.sum(residual**2) / freedom)), 1e-6)
    curve = RangeCurve(family=family, parameters=tuple(parameters.tolist()), residual_sd_m=sd)
    bins = _bins(near_m, residual, bin_m)
    return RangeFit(curve, len(near_m), bins, len(range_m) - len(near_m))


def _residual_of(
    model: Callable[[Floats, Floats], Floats], height_px: Floats, range_m: Floats, scale: Floats
) -> Callable[[Floats], Floats]:
    return lambda p: model(height_px, p * scale) - range_m


def _inliers(off: Floats) -> NDArray[np.bool_]:
    """Mark the residuals that are not outliers, by the median scale."""
    away = np.abs(off - np.median(off))
    return np.asarray(away <= OUTLIER_SIGMAS * 1.4826 * np.median(away), np.bool_)


def residuals(
    height_px: Floats, range_m: Floats, curve: RangeCurve, bin_m: float = 10.0
) -> RangeFit:
    """Evaluate a curve on other pairs; its ``residual_sd_m`` is replaced by theirs.

    Args:
        height_px: Shape (N,).
        range_m: Shape (N,), true ranges.
        curve: The fitted curve.
        bin_m: Width of the bins of distance.
    """
    error = range_of(height_px, curve) - range_m
    sd = max(float(np.sqrt(np.mean(error**2))), 1e-6)
    theirs = curve.model_copy(update={"residual_sd_m": sd})
    return RangeFit(theirs, len(range_m), _bins(range_m, error, bin_m))


def _bins(range_m: Floats, residual: Floats, bin_m: float) -> tuple[Bin, ...]:
    number = np.floor(range_m / bin_m).astype(int)
    bins = []
    for i in np.unique(number).tolist():
        inside = residual[number == i]
        sd = float(np.sqrt(np.mean(inside**2)))
        bins.append(Bin(i * bin_m, (i + 1) * bin_m, len(inside), float(inside.mean()), sd))
    return tuple(bins)


# By family: range of a height, and the first guess of the parameters after the first.
_CURVES: Final[Mapping[str, tuple[Callable[[Floats, Floats], Floats], list[float]]]] = {
    "pinhole": (lambda height_px, p: p[0] / height_px, []),
    "pinhole-offset": (lambda height_px, p: p[0] / height_px + p[1], [0.0]),
    "power": (lambda height_px, p: p[0] * height_px ** p[1], [-1.0]),
}
