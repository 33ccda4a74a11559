"""Fit a compass to a drive, and report which of its parameters are observable.

With z the direction of magnetic north as a complex number in the car's level axes, the horizontal
part of the readings is

    m = c z + d conj(z) + b,

a circle (d = 0) or ellipse about the hard iron b. A drive with a full turn determines b, c and d;
one with a half turn determines b and c. A straight drive determines only the mounting yaw, combined
with the effect of hard iron. A parameter that is not observable keeps its given value and is
reported with the reason. Without a reference heading, an ellipse is fitted to the readings, and the
mounting yaw remains unknown.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from crosscue.localization.angles import circular_mean, wrap_all
from crosscue.localization.compass import IDENTITY, CompassSettings, Vector, heading, level_field
from crosscue.replay.columns import Floats, Int64s
from crosscue.replay.errors import VehicleError

Complexes: TypeAlias = NDArray[np.complex128]

MOUNTING: Final = "mounting yaw"
HARD_IRON: Final = "hard iron"
SOFT_IRON: Final = "soft iron"

_BIN_DEG: Final = 10
_BIN_READINGS: Final = 3
# Maximum scatter of a ring, as a fraction of its radius; an unstructured cloud has about 0.5.
_RING: Final = 0.2
# Minimum coverage of headings in degrees to fit hard and soft iron, and minimum number of readings.
HARD_IRON_DEG: Final = 180.0
SOFT_IRON_DEG: Final = 300.0
MIN_READINGS: Final = 20


class NotObservable(NamedTuple):
    """A parameter that keeps its given value, and the reason."""

    parameter: str
    reason: str


@dataclass(frozen=True, slots=True)
class CompassFit:
    """A fitted compass with measures of its quality.

    Attributes:
        settings: The compass; parameters not observable keep their given values.
        observable: Names of the fitted parameters.
        not_observable: Other parameters, with reasons.
        readings: Number of readings.
        readings_used: Number of readings that are finite and, if required, have a reference.
        coverage_deg: Coverage of headings, in steps of 10 degrees.
        residual_sd_rad: S.d. of heading minus reference: the filter's compass noise. NaN without
            a reference.
        persists_s: Time over which the residuals' autocorrelation falls to 1/e. Twice this is a
            good ``heading_interval_s`` of the filter.
        persists_is_bound: True if the autocorrelation does not fall to 1/e; ``persists_s`` is then
            a lower bound.
        mounting_yaw_sd_rad: S.d. of the fitted mounting yaw, corrected for correlated residuals.
    """

    settings: CompassSettings
    observable: tuple[str, ...]
    not_observable: tuple[NotObservable, ...]
    readings: int
    readings_used: int
    coverage_deg: int
    residual_sd_rad: float
    persists_s: float
    persists_is_bound: bool
    mounting_yaw_sd_rad: float


class _Shape(NamedTuple):
    """Distortion of the horizontal field: ``m = bend @ north + hard``."""

    bend: Floats
    hard: Floats


def fit_compass(
    t_ns: Int64s, field_t: Floats, reference_rad: Floats | None, given: CompassSettings
) -> CompassFit:
    """Fit the observable parameters of hard iron, soft iron and mounting.

    Args:
        t_ns: Shape (N,), increasing: times of the readings.
        field_t: Shape (N, 3): readings in the sensor's axes.
        reference_rad: Shape (N,): heading of the car, counter-clockwise from east, such as the GNSS
            course of ``course_at``; NaN where unknown. None without a reference.
        given: Mounting rotation and declination, and default values of the other parameters.

    Raises:
        VehicleError: There are too few readings, the axes are mirrored, or the readings are not
            correlated with the headings.
        ValueError: Columns differ in length.
    """
    if field_t.shape != (len(t_ns), 3):
        raise ValueError(f"field_t: expected ({len(t_ns)}, 3), got {field_t.shape}")
    if reference_rad is not None and reference_rad.shape != t_ns.shape:
        raise ValueError(f"reference_rad: expected {t_ns.shape}, got {reference_rad.shape}")
    usable = np.isfinite(field_t).all(axis=1) & (field_t != 0.0).any(axis=1)
    if reference_rad is not None:
        usable &= np.isfinite(reference_rad)
    n = int(usable.sum())
    if n < MIN_READINGS:
        raise VehicleError(
            f"compass: {n} of {len(t_ns)} readings are finite and have a reference heading, "
            f"{MIN_READINGS} are required; use a longer drive"
        )
    if reference_rad is None:
        return _fit_alone(field_t, usable, given)
    return _fit_to(t_ns[usable], field_t[usable], reference_rad[usable], given, len(t_ns))


def coverage_deg(directions_rad: Floats) -> int:
    """Coverage of the circle in degrees, by steps of 10 degrees with at least three readings."""
    steps = 360 // _BIN_DEG
    bins = np.floor(np.degrees(directions_rad) / _BIN_DEG).astype(np.int64) % steps
    return int((np.bincount(bins, minlength=steps) >= _BIN_READINGS).sum()) * _BIN_DEG


def _fit_to(
    t_ns: Int64s, field_t: Floats, reference_rad: Floats, given: CompassSettings, readings: int
) -> CompassFit:
    covered = coverage_deg(reference_rad)
    north = np.exp(1j * (math.pi / 2 - given.declination_rad - reference_rad))
    observable: tuple[str, ...] = (MOUNTING,)
    if covered >= SOFT_IRON_DEG:
        observable = (MOUNTING, HARD_IRON, SOFT_IRON)
        fitted = _fitted_ellipse(field_t, north, given)
    elif covered >= HARD_IRON_DEG:
        observable = (MOUNTING, HARD_IRON)
        fitted = _fitted_circle(field_t, north, given)
    else:
        fitted = _fitted_yaw(field_t, reference_rad, given)
    residual = wrap_all(heading(field_t, fitted) - reference_rad)
    residual = residual[np.isfinite(residual)]
    sd = float(np.sqrt(np.mean(residual**2)))
    lasting = persistence(t_ns, residual)
    return CompassFit(
        settings=fitted,
        observable=observable,
        not_observable=_missing(
            observable, _short(covered, HARD_IRON_DEG), _short(covered, SOFT_IRON_DEG)
        ),
        readings=readings,
        readings_used=len(t_ns),
        coverage_deg=covered,
        residual_sd_rad=sd,
        persists_s=lasting.seconds,
        persists_is_bound=lasting.is_bound,
        mounting_yaw_sd_rad=sd / math.sqrt(lasting.independent),
    )


def _fit_alone(field_t: Floats, usable: NDArray[np.bool_], given: CompassSettings) -> CompassFit:
    """Fit without a reference, if the readings cover an ellipse."""
    base = replace(given, hard_iron_t=(0.0, 0.0, 0.0), soft_iron=IDENTITY)
    level = level_field(field_t[usable], base)[:, :2]
    shape = _ellipse(level)
    covered, fitted = 0, given
    observable: tuple[str, ...] = ()
    short = "the readings do not cover an ellipse"
    if shape is not None:
        north = np.linalg.solve(shape.bend, (level - shape.hard).T)
        covered = coverage_deg(np.arctan2(north[1], north[0]))
        short = _short(covered, SOFT_IRON_DEG)
    if shape is not None and covered >= SOFT_IRON_DEG:
        observable = (HARD_IRON, SOFT_IRON)
        fitted = _corrected(base, shape)
    return CompassFit(
        settings=fitted,
        observable=observable,
        not_observable=_missing(observable, short, short),
        readings=len(usable),
        readings_used=int(usable.sum()),
        coverage_deg=covered,
        residual_sd_rad=math.nan,
        persists_s=math.nan,
        persists_is_bound=False,
        mounting_yaw_sd_rad=math.nan,
    )


def _missing(
    observable: tuple[str, ...], no_hard_iron: str, no_soft_iron: str
) -> tuple[NotObservable, ...]:
    found = (
        NotObservable("declination", "has the same effect as the mounting yaw; as given"),
        NotObservable("hard iron, upward part", "has no effect while the car is level"),
        NotObservable(MOUNTING, "there is no reference heading"),
        NotObservable(HARD_IRON, no_hard_iron),
        NotObservable(SOFT_IRON, no_soft_iron),
    )
    return tuple(missing for missing in found if missing.parameter not in observable)


def _short(covered_deg: int, wanted_deg: float) -> str:
    return f"headings cover {covered_deg} of 360 degrees, {wanted_deg:.0f} are required"


def _fitted_yaw(field_t: Floats, reference_rad: Floats, given: CompassSettings) -> CompassSettings:
    apart = heading(field_t, replace(given, mounting_yaw_rad=0.0)) - reference_rad
    try:
        return replace(given, mounting_yaw_rad=circular_mean(apart[np.isfinite(apart)]))
    except ValueError:
        raise VehicleError(
            "compass: the readings are not correlated with the headings; check the topic and axes"
        ) from None


def _fitted_circle(field_t: Floats, north: Complexes, given: CompassSettings) -> CompassSettings:
    base = replace(given, hard_iron_t=(0.0, 0.0, 0.0))
    level = _as_complex(level_field(field_t, base))
    one = np.ones_like(north)
    (c, b), missed = _least_squares(np.column_stack([north, one]), level)
    _, missed_mirrored = _least_squares(np.column_stack([north.conj(), one]), level)
    if missed_mirrored < missed:
        raise _mirrored()
    return replace(
        base,
        mounting_yaw_rad=-float(np.angle(c)),
        hard_iron_t=_in_sensor_axes(base, np.array([b.real, b.imag])),
    )


def _fitted_ellipse(field_t: Floats, north: Complexes, given: CompassSettings) -> CompassSettings:
    base = replace(given, hard_iron_t=(0.0, 0.0, 0.0), soft_iron=IDENTITY)
    terms = np.column_stack([north, north.conj(), np.ones_like(north)])
    (c, d, b), _ = _least_squares(terms, _as_complex(level_field(field_t, base)))
    if abs(d) >= abs(c):
        raise _mirrored()
    bend = np.array([[(c + d).real, (d - c).imag], [(c + d).imag, (c - d).real]])
    shape = _Shape(bend, np.array([b.real, b.imag]))
    left, _, right = np.linalg.svd(bend)
    turn = left @ right
    yaw = -math.atan2(turn[1, 0], turn[0, 0])
    return replace(_corrected(base, shape), mounting_yaw_rad=yaw)


def _corrected(base: CompassSettings, shape: _Shape) -> CompassSettings:
    """Correct the distortion at constant area; its rotation is left to the mounting yaw."""
    left, stretch, _ = np.linalg.svd(shape.bend)
    level = np.eye(3)
    level[:2, :2] = math.sqrt(stretch[0] * stretch[1]) * (left / stretch) @ left.T
    to_car = np.array(base.mounting_rotation)
    soft = (to_car.T @ level @ to_car).tolist()
    return replace(
        base,
        hard_iron_t=_in_sensor_axes(base, shape.hard),
        soft_iron=(tuple(soft[0]), tuple(soft[1]), tuple(soft[2])),
    )


def _in_sensor_axes(base: CompassSettings, level: Floats) -> Vector:
    to_car = np.array(base.mounting_rotation) @ np.array(base.soft_iron)
    x, y, z = np.linalg.solve(to_car, [level[0], level[1], 0.0]).tolist()
    return x, y, z


def _ellipse(level: Floats) -> _Shape | None:
    """Fit a conic to the points by least squares; None unless they are along an ellipse."""
    middle, scale = level.mean(axis=0), float(np.std(level)) or 1.0
    x, y = ((level - middle) / scale).T
    terms = np.column_stack([x * x, 2.0 * x * y, y * y, 2.0 * x, 2.0 * y])
    xx, xy, yy, gx, gy = np.linalg.lstsq(terms, np.ones(len(x)), rcond=None)[0]
    form = np.array([[xx, xy], [xy, yy]])
    if not np.linalg.eigvalsh(form).min() > 0.0:
        return None
    center = -np.linalg.solve(form, [gx, gy])
    values, axes = np.linalg.eigh(form / (1.0 + center @ form @ center))
    bend = scale * (axes / np.sqrt(values)) @ axes.T
    shape = _Shape(bend, middle + scale * center)
    radius = np.linalg.norm(np.linalg.solve(bend, (level - shape.hard).T), axis=0)
    return shape if float(np.std(radius)) < _RING else None


def _as_complex(level: Floats) -> Complexes:
    return level[:, 0] + 1j * level[:, 1]


def _least_squares(terms: Complexes, wanted: Complexes) -> tuple[Complexes, float]:
    found: Complexes = np.linalg.lstsq(terms, wanted, rcond=None)[0].astype(np.complex128)
    return found, float(np.sum(np.abs(terms @ found - wanted) ** 2))


def _mirrored() -> VehicleError:
    return VehicleError(
        "compass: the readings turn in the wrong direction; expected axes forward, left, up (many "
        "sensors have forward, right, down); correct the mounting rotation"
    )


class ResidualPersistence(NamedTuple):
    """Persistence of residuals.

    Attributes:
        next_correlation: Correlation of successive residuals.
        seconds: Time until the autocorrelation falls to 1/e.
        is_bound: True if it does not fall to 1/e; ``seconds`` is then half of the duration.
        independent: Equivalent number of independent residuals.
    """

    next_correlation: float
    seconds: float
    is_bound: bool
    independent: float


def persistence(t_ns: Int64s, residual: Floats) -> ResidualPersistence:
    """Estimate the persistence of residuals at approximately regular times."""
    n = len(residual)
    centred = residual - residual.mean()
    power = np.abs(np.fft.rfft(centred, 2 * n)) ** 2
    correlation = np.fft.irfft(power)[: max(n // 2, 1)]
    if n < 4 or not correlation[0] > 1e-24:
        return ResidualPersistence(math.nan, 0.0, False, float(n))
    correlation = correlation / correlation[0]
    period_s = float(np.median(np.diff(t_ns))) * 1e-9
    below = np.flatnonzero(correlation < math.exp(-1.0))
    is_bound = len(below) == 0
    if is_bound:
        steps = float(len(correlation))
    else:
        k = int(below[0])
        fall = correlation[k - 1] - correlation[k]
        steps = k - 1 + float((correlation[k - 1] - math.exp(-1.0)) / fall)
    independent = min(max(n / (2.0 * steps), 1.0), float(n))
    return ResidualPersistence(float(correlation[1]), steps * period_s, is_bound, independent)
