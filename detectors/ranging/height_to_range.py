"""From an object's height in pixels to its range: a curve fitted to pairs, and its residual.

A pinhole camera sees an object of fixed size at range a / height; an offset takes up a mount ahead
of the rear axle and masks that are a little large. Which family fits is for the data to say.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from crosscue.replay.base import EmptyResultError, Floats, UsageError
from crosscue.replay.vehicle.vehicle import RangeCurve

Family = Literal["pinhole", "pinhole-offset", "power"]
FAMILIES: Final[tuple[Family, ...]] = ("pinhole", "pinhole-offset", "power")


@dataclass(frozen=True, slots=True)
class Bin:
    """Residuals of the pairs between two ranges.

    Attributes:
        from_m: Nearest.
        to_m: First no longer in it.
        pairs: How many.
        mean_m: Of fitted less true range.
        sd_m: Root of their mean square.
    """

    from_m: float
    to_m: float
    pairs: int
    mean_m: float
    sd_m: float


@dataclass(frozen=True, slots=True)
class RangeFit:
    """A fitted curve.

    Attributes:
        curve: As the vehicle file keeps it.
        pairs: How many were used.
        bins: Residuals by distance.
    """

    curve: RangeCurve
    pairs: int
    bins: tuple[Bin, ...]


def range_of(height_px: Floats, curve: RangeCurve) -> Floats:
    """Ranges in metres for heights in pixels, shape (N,)."""
    return _CURVES[curve.family][0](height_px, np.array(curve.parameters))


def fit_range(height_px: Floats, range_m: Floats, family: Family, bin_m: float = 10.0) -> RangeFit:
    """Fit one family by least squares of the range.

    Args:
        height_px: Shape (N,), positive.
        range_m: Shape (N,), true ranges, positive.
        family: ``pinhole`` a / h; ``pinhole-offset`` a / h + b; ``power`` a * h ** b.
        bin_m: Width of the bins of distance.

    Raises:
        EmptyResultError: Too few pairs.
        UsageError: A number that is not one or not positive.
    """
    model, start = _CURVES[family]
    bad = ~(np.isfinite(height_px) & np.isfinite(range_m) & (height_px > 0.0) & (range_m > 0.0))
    if bad.any():
        raise UsageError(
            f"row {int(np.flatnonzero(bad)[0]) + 1}: height and range: expected positive"
        )
    count = 1 if family == "pinhole" else 2
    if len(np.unique(height_px)) <= count:
        raise EmptyResultError(f"{family}: expected more than {count} different heights to fit it")
    guess = start(height_px, range_m)
    from scipy.optimize import least_squares

    scale = np.maximum(np.abs(guess), 1.0)
    fitted = least_squares(lambda p: model(height_px, p * scale) - range_m, guess / scale)
    parameters = np.asarray(fitted.x, np.float64) * scale
    residual = model(height_px, parameters) - range_m
    freedom = len(range_m) - len(guess)
    sd = max(float(np.sqrt(np.sum(residual**2) / freedom)), 1e-6)
    curve = RangeCurve(family=family, parameters=tuple(parameters.tolist()), residual_sd_m=sd)
    return RangeFit(curve, len(range_m), _bins(range_m, residual, bin_m))


def residuals(
    height_px: Floats, range_m: Floats, curve: RangeCurve, bin_m: float = 10.0
) -> RangeFit:
    """A curve on pairs it was not fitted to; its ``residual_sd_m`` becomes theirs.

    Args:
        height_px: Shape (N,).
        range_m: Shape (N,), true ranges.
        curve: Fitted elsewhere.
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


def _pinhole(height_px: Floats, p: Floats) -> Floats:
    return np.asarray(p[0] / height_px, np.float64)


def _pinhole_offset(height_px: Floats, p: Floats) -> Floats:
    return np.asarray(p[0] / height_px + p[1], np.float64)


def _power(height_px: Floats, p: Floats) -> Floats:
    return np.asarray(p[0] * height_px ** p[1], np.float64)


def _linear_start(height_px: Floats, range_m: Floats) -> Floats:
    return np.array([float(np.median(range_m * height_px))])


def _offset_start(height_px: Floats, range_m: Floats) -> Floats:
    return np.array([float(np.median(range_m * height_px)), 0.0])


def _power_start(height_px: Floats, range_m: Floats) -> Floats:
    return np.array([float(np.median(range_m * height_px)), -1.0])


_Curve = tuple[Callable[[Floats, Floats], Floats], Callable[[Floats, Floats], Floats]]
_CURVES: Final[Mapping[str, _Curve]] = {
    "pinhole": (_pinhole, _linear_start),
    "pinhole-offset": (_pinhole_offset, _offset_start),
    "power": (_power, _power_start),
}
