"""Fitting of a vehicle file's odometry to one half of a drive, tested on the other half."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import numpy as np
import tomlkit

from crosscue.eval.logs.log import DriveGiven, opened
from crosscue.eval.pipeline.pose import odometry_settings, turn_signal_of
from crosscue.eval.report.chart import Chart, Series
from crosscue.eval.scoring.consistency import mean_band
from crosscue.localization.angles import circular_mean, wrap_all
from crosscue.localization.constants import NO_CONSTANTS, TURN_PARAMETERS
from crosscue.localization.fit.compass import persistence
from crosscue.localization.fit.known_drive import Car, KnownDrive, whitened
from crosscue.localization.fit.odometry import FIX_DELAY, TURN_NOISE, OdometryFit
from crosscue.localization.fit.odometry import fit_odometry as fit_parameters
from crosscue.localization.odometry import OdometrySettings
from crosscue.replay.base import Log, Selection, name_of
from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError, FitError, VehicleError
from crosscue.replay.files.tree_text import toml_document
from crosscue.replay.safe_text import counted
from crosscue.replay.signals.kinds import Samples, Signal
from crosscue.replay.vehicle.pose import OdometryFitted
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .log_signals import read_signals, signal_plan, turn_samples, wheel_speeds
from .reference import ReferencePositions, of_gnss, of_truth
from .vehicle_output import Fitted, check_output, write_fit

SHARED: Final = (
    "wheel_scale",
    "front_left_scale",
    "front_right_scale",
    "slip_per_sqrt_m",
    "turn_delay_s",
)
# Settings that belong to a single source of turns.
OF_ONE_TURN: Final = {turn: (*names, TURN_NOISE[turn]) for turn, names in TURN_PARAMETERS.items()}


@dataclass(frozen=True, slots=True)
class OdometryErrors:
    """Errors of odometry alone against known positions, from the fitted start.

    Attributes:
        fitted_m: Root mean square error over the fitted half.
        held_out_m: Root mean square error over the other half.
        all_m: Root mean square error over both halves.
        end_m: Error at the last position.
        fitted_nees: Mean NEES over the fitted half; 2 is consistent.
        held_out_nees: Mean NEES over the other half.
        all_nees: Mean NEES over both halves.
    """

    fitted_m: float
    held_out_m: float
    all_m: float
    end_m: float
    fitted_nees: float
    held_out_nees: float
    all_nees: float


@dataclass(frozen=True, slots=True)
class SourceFit:
    """The fit with one source of turns.

    Attributes:
        fit: Fit to the first half.
        before: Errors with the original values.
        after: Errors with the fitted values.
        drive: The drive that was fitted to.
        given: The car with the original values.
        camera_yaw_rad: Yaw of the reference's body relative to the vehicle, to the left; None if
            the reference has no heading.
        camera_yaw_sd_rad: Standard deviation of the yaw; correlation of differences is taken into
            account.
    """

    fit: OdometryFit
    before: OdometryErrors
    after: OdometryErrors
    drive: KnownDrive
    given: Car
    camera_yaw_rad: float | None = None
    camera_yaw_sd_rad: float = math.nan


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedOdometry(Fitted):
    """Odometry fitted to the first half of a drive and tested on the second.

    Attributes:
        log: Name of the log.
        reference: Source of the known positions.
        is_of_camera: True if the reference is the camera's track.
        is_gnss: True if the reference is the log's GNSS, whose delay the vehicle file states.
        start_ns: Start of the fitted half.
        middle_ns: End of the fitted half and start of the held-out half.
        end_ns: End of the held-out half.
        fits: Fits by source of turns; that of the vehicle file first.
        not_fitted: Reason why a source could not be fitted, by source.
        settings: Settings with the values of all sources.
        nees_band: 95 % interval of one drive's mean NEES for a consistent filter.
    """

    log: str
    reference: str
    is_of_camera: bool = field(metadata=HIDDEN)
    is_gnss: bool = field(metadata=HIDDEN)
    start_ns: int
    middle_ns: int
    end_ns: int
    fits: tuple[SourceFit, ...] = field(metadata=HIDDEN)
    not_fitted: dict[str, str]
    settings: OdometrySettings = field(metadata=HIDDEN)
    nees_band: tuple[float, float]

    also: ClassVar = {name: name for name in ("camera_yaw_rad", "sources")} | {
        "odometry": "section"
    }

    @property
    def section(self) -> dict[str, object]:
        """The vehicle file's section ``[odometry]``, with its provenance."""
        names = [
            *SHARED,
            "wheel_delay_s",
            *(name for one in self.fits for name in OF_ONE_TURN[one.fit.source]),
        ]
        values = {
            name: float(f"{value:.6g}")
            for name in names
            if (value := getattr(self.settings, name)) is not None
        }
        return {**values, "constants": constants_section(self), "fitted": _provenance(self)}

    @property
    def toml(self) -> str:
        """The sections of the vehicle file, without the record of the fit."""
        document = toml_document(with_odometry("", self))
        del document["odometry"]["fitted"]
        return tomlkit.dumps(document)

    @property
    def camera_yaw_rad(self) -> float | None:
        """Mounting yaw of the camera; None unless the positions are the camera's track."""
        yaw_rad = self.fits[0].camera_yaw_rad
        return None if yaw_rad is None or not self.is_of_camera else round(yaw_rad, 5)

    @property
    def sources(self) -> list[dict[str, Any]]:
        """The fit with each source of the turn rate, as in JSON."""
        return [
            {
                "source": one.fit.source,
                "fitted": [value._asdict() for value in one.fit.fitted],
                "not_observable": dict(one.fit.not_observable),
                "positions": one.fit.fixes,
                "outliers": one.fit.outliers,
                "position_sd_m": one.fit.fix_sd_m,
                "position_wander_m_per_sqrt_s": one.fit.wander_m_per_sqrt_s,
                "residual_rms": one.fit.residual_rms,
                "before": asdict(one.before),
                "after": asdict(one.after),
            }
            for one in self.fits
        ]

    def report(self) -> Iterator[str]:
        """Yield the parameters and errors of each source."""
        middle_s, end_s = ((t - self.start_ns) * 1e-9 for t in (self.middle_ns, self.end_ns))
        yield f"positions   {self.reference}"
        yield f"fitted to   the first {middle_s:.1f} s of {end_s:.1f} s; the rest is held out"
        for one in self.fits:
            yield from ("", *_source(one))
        low, high = self.nees_band
        yield ""
        yield f"NEES of x, y is consistent for one drive between {low:.2f} and {high:.2f}"
        yield from (f"not fitted  {name}: {why}" for name, why in self.not_fitted.items())

    def charts(self) -> Iterator[Chart]:
        """Yield the way by odometry alone, and its error, for each source of turns."""
        for one in self.fits:
            known_m, t_s = one.drive.fixes.xy_m, one.drive.seconds
            before_m, after_m = (
                one.drive.reckon(one.fit.start, car).xy_m for car in (one.given, one.fit.car)
            )
            yield Chart(
                f"Way by odometry alone, turns from {one.fit.source}",
                "east (m)",
                "north (m)",
                (
                    Series("values before", *before_m.T),
                    Series("fitted", *after_m.T),
                    Series("known positions", *known_m.T, is_line=False, is_truth=True),
                ),
                is_map=True,
            )
            before, after = (np.hypot(*(xy_m - known_m).T) for xy_m in (before_m, after_m))
            first = one.drive.fixes.t_ns < self.middle_ns
            yield Chart(
                f"Distance from the known positions, turns from {one.fit.source}",
                "time (s)",
                "distance (m)",
                (
                    Series("values before", t_s, before),
                    Series("fitted, on the half fitted to", t_s[first], after[first]),
                    Series("fitted, held out", t_s[~first], after[~first]),
                ),
            )


def _source(one: SourceFit) -> list[str]:
    fit, before, after = one.fit, one.before, one.after
    width = max(len(name) for name in [*(v.parameter for v in fit.fitted), "gyro_bias_radps"])
    lines = [
        f"turns from {fit.source}: {counted(fit.fixes, 'position')} of s.d. {fit.fix_sd_m:.2f} m, "
        f"whose error wanders by {fit.wander_m_per_sqrt_s:.2f} m in a second; "
        f"{counted(fit.outliers, 'outlier')}"
    ]
    lines += [
        f"  {value.parameter:{width}}  {value.value:.6g} +- {value.sd:.2g}  (was {value.given:.6g})"
        for value in fit.fitted
    ]
    lines += [f"  {name:{width}}  not observable: {why}" for name, why in fit.not_observable]
    if one.camera_yaw_rad is not None:
        degrees = math.degrees(one.camera_yaw_rad)
        sure = math.degrees(one.camera_yaw_sd_rad)
        lines.append(
            f"  heading of the true track minus the car's: {degrees:.2f} +- {sure:.2f} deg"
        )
    lines += [
        f"  odometry alone, rms    fitted half {before.fitted_m:9.2f} m -> {after.fitted_m:8.2f} m"
        f"   NEES {after.fitted_nees:6.2f}",
        f"                            held out {before.held_out_m:9.2f} m -> "
        f"{after.held_out_m:8.2f} m   NEES {after.held_out_nees:6.2f}",
        f"                           whole log {before.all_m:9.2f} m -> {after.all_m:8.2f} m"
        f"   NEES {after.all_nees:6.2f}",
    ]
    return lines


def fit_odometry(
    log: DriveGiven,
    vehicle: Vehicle | Path | str | None = None,
    output: Annotated[Path | str | None, Option(metavar="V.toml")] = None,
    *,
    truth: Path | str | None = None,
    keep: bool = False,
    overwrite: bool = False,
) -> FittedOdometry:
    """Fit wheels, gyro, steering and noise to a drive.

    Scales, biases, geometry, delays and noise are fitted to the first half of the drive and tested
    on the second. The reference positions are the log's GNSS or, with --truth, a true track.
    Parameters that the drive does not determine keep their values and are listed. For example, a
    straight drive determines neither the gyro's scale nor the steering ratio. A fit that makes the
    error on the second half larger is refused.

    Examples:
        crosscue fit odometry drive.mcap --vehicle car.toml -o car.toml
        crosscue fit odometry drive.mcap --vehicle car.toml --truth truth/ -o car.toml

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        vehicle: Vehicle file; without one, the defaults.
        output: Vehicle file to write: a copy of --vehicle with the fit; may be the same file.
        truth: Truth file with the true track, or its folder (default: the log's GNSS).
        keep: Accept a fit that makes the error on the second half larger.
        overwrite: Replace another existing file.

    Raises:
        EmptyResultError: The drive has no wheel speeds, or no positions.
        FitError: The fit makes the error on the second half larger.
        VehicleError: The drive has too few positions, or is too short.
        SchemaError: The truth file does not fit the drive, or contains no pose.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    settings = vehicle_given(vehicle)
    known = None if truth is None else of_truth(Path(truth), settings)
    with opened(log) as drive:
        found = fit_log_odometry(drive.logs, settings, drive.selection, known, keep=keep)
    path = write_fit(vehicle, output, lambda text: with_odometry(text, found))
    return replace(found, path=path)


def fit_log_odometry(
    logs: Sequence[Log],
    vehicle: Vehicle,
    selection: Selection,
    known: ReferencePositions | None = None,
    *,
    keep: bool = False,
) -> FittedOdometry:
    """Fit to the first half of the drive and test on the second.

    Args:
        logs: Open logs.
        vehicle: Initial settings.
        selection: The part of the logs to use.
        known: True positions; None for the log's GNSS.
        keep: Accept a fit that makes the held-out error larger.

    Raises:
        EmptyResultError: The drive has no wheel speeds, or no positions.
        FitError: The first source's fit makes the held-out error larger.
        VehicleError: The drive is too short.
    """
    planned = signal_plan(logs, vehicle)
    gnss = planned.source_of(Signal.POSITION)
    if known is None and gnss is None:
        raise EmptyResultError(
            f"no positions to fit to: no GNSS in the log ({planned.missing[Signal.POSITION]}); "
            "name a truth file with --truth"
        )
    wanted = [Signal.WHEEL_SPEEDS, Signal.YAW_RATE, Signal.STEERING]
    found = read_signals(
        logs, planned, vehicle, selection, wanted + ([Signal.POSITION] if known is None else [])
    )
    if (wheels := found.get(Signal.WHEEL_SPEEDS)) is None:
        none = "no wheel speeds: not one row in this part"
        raise EmptyResultError(planned.missing.get(Signal.WHEEL_SPEEDS, none))
    reference = known or _gnss_track(
        found.get(Signal.POSITION), gnss.topic.name if gnss else None, vehicle
    )
    given = odometry_settings(vehicle)
    first = turn_signal_of(planned, vehicle)
    turns: list[Signal | None] = [Signal.YAW_RATE, Signal.STEERING, None]
    turns = [first, *(turn for turn in turns if turn is not first)]
    sources: list[SourceFit] = []
    not_fitted: dict[str, str] = {}
    span = (0, 0, 0)
    for turn in turns:
        if turn is not None and turn not in found:
            not_fitted[_name(turn)] = planned.missing.get(turn, "not one row in this part")
            continue
        drive = KnownDrive(
            wheel_speeds(wheels), turn_samples(turn, found), reference.fixes, reference.lever_m
        )
        try:
            fitted = _fitted(drive, given, reference)
            if not keep:
                _check_held_out(fitted)
            sources.append(fitted)
        except (VehicleError, FitError) as error:
            if not sources and turn is first:
                raise
            not_fitted[_name(turn)] = str(error)
            continue
        if len(sources) == 1:
            t_ns = drive.fixes.t_ns
            span = int(t_ns[0]), _middle_ns(drive), int(t_ns[-1]) + 1
    return FittedOdometry(
        ", ".join(name_of(log).rstrip("/").rpartition("/")[2] for log in logs),
        reference.name,
        reference.is_of_camera,
        known is None,
        *span,
        tuple(sources),
        not_fitted,
        _together(given, sources, is_gnss=known is None),
        mean_band(2, 1),
    )


def _gnss_track(samples: Samples | None, topic: str | None, vehicle: Vehicle) -> ReferencePositions:
    if samples is None or topic is None:
        raise EmptyResultError(f"{topic}: not one GNSS position in this part of the log")
    return of_gnss(topic, samples, vehicle)


def _name(turn: Signal | None) -> str:
    return "wheels" if turn is None else turn.name.lower().replace("_", " ")


def _middle_ns(drive: KnownDrive) -> int:
    t_ns = drive.fixes.t_ns
    return (int(t_ns[0]) + int(t_ns[-1])) // 2


def _fitted(drive: KnownDrive, given: OdometrySettings, reference: ReferencePositions) -> SourceFit:
    half = drive.until(_middle_ns(drive)) if len(drive.fixes) else drive
    fit = fit_parameters(half, given)
    car = fit.car._replace(settings=given, constants=NO_CONSTANTS, delay_s=0.0)
    before, after = _errors(drive, fit, car), _errors(drive, fit, fit.car)
    yaw = () if reference.heading_rad is None else _yaw(half, fit, reference)
    return SourceFit(fit, before, after, drive, car, *yaw)


def _check_held_out(fitted: SourceFit) -> None:
    before_m, after_m = fitted.before.held_out_m, fitted.after.held_out_m
    if after_m > before_m:
        raise FitError(
            f"odometry, turns from {fitted.fit.source}: the error on the held-out half is "
            f"{after_m:.2f} m rms with the fit, {before_m:.2f} m with the values before it; "
            "use a longer drive with turns and changes of speed, or --keep the fit"
        )


def _errors(drive: KnownDrive, fit: OdometryFit, car: Car) -> OdometryErrors:
    found = drive.reckon(fit.start, car)
    fixes = drive.fixes
    apart = np.hypot(*(found.xy_m - fixes.xy_m).T)
    cov = np.tile(np.eye(2) * fit.fix_sd_m**2, (len(fixes), 1, 1))
    nees = np.sum(whitened(found, fixes.xy_m, cov)[0] ** 2, axis=1)
    first = fixes.t_ns < _middle_ns(drive)
    return OdometryErrors(
        fitted_m=_rms(apart[first]),
        held_out_m=_rms(apart[~first]),
        all_m=_rms(apart),
        end_m=float(apart[-1]),
        fitted_nees=float(nees[first].mean()),
        held_out_nees=float(nees[~first].mean()),
        all_nees=float(nees.mean()),
    )


def _rms(values: Floats) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _yaw(half: KnownDrive, fit: OdometryFit, reference: ReferencePositions) -> tuple[float, float]:
    """Return the mean yaw of the reference relative to the vehicle in the fitted half, and s.d."""
    assert reference.heading_rad is not None
    fixes = half.fixes
    rows = np.searchsorted(reference.fixes.t_ns, fixes.t_ns)
    car = half.reckon(fit.start, fit.car, len(fixes))
    apart = wrap_all(reference.heading_rad[rows] - car.heading_rad)
    yaw_rad = circular_mean(apart)
    around = wrap_all(apart - yaw_rad)
    independent = persistence(fixes.t_ns, around).independent
    spread = float(np.std(around)) / math.sqrt(independent)
    return yaw_rad, math.hypot(spread, math.sqrt(fit.start.hh))


def _together(
    given: OdometrySettings, sources: Sequence[SourceFit], *, is_gnss: bool
) -> OdometrySettings:
    """Return settings with the first source's shared values and each source's own values."""
    values = {name: getattr(sources[0].fit.settings, name) for name in SHARED}
    if not is_gnss:
        # A true track that is early means wheel speeds that are late.
        late_s = given.wheel_delay_s - sources[0].fit.value(FIX_DELAY)
        values["wheel_delay_s"] = max(late_s, 0.0)
    for source in sources:
        names = OF_ONE_TURN[source.fit.source]
        values |= {name: getattr(source.fit.settings, name) for name in names}
    return replace(given, **values)


def constants_section(found: FittedOdometry) -> dict[str, object]:
    """Return the errors of the fitted values as a section [odometry.constants].

    Values of several sources of turns are independent; the first source determines shared ones.
    """
    from scipy.linalg import block_diag

    names: list[str] = []
    blocks: list[Floats] = []
    drift: dict[str, float] = {}
    for of in (source.fit.constants for source in found.fits):
        rows = [i for i, name in enumerate(of.names) if name not in names]
        names += [of.names[i] for i in rows]
        blocks.append(of.cov[np.ix_(rows, rows)])
        walk = zip(of.names, np.sqrt(of.drift_var_per_s).tolist(), strict=True)
        drift |= {name: float(f"{sd:.3g}") for name, sd in walk if sd > 0.0}
    cov = block_diag(*blocks)
    rounded = [[float(f"{value:.9g}") for value in row] for row in cov.tolist()]
    return {"names": names, "covariance": rounded, "drift_per_sqrt_s": drift}


def _provenance(found: FittedOdometry) -> dict[str, object]:
    first = found.fits[0]
    shown = [
        one
        for source in found.fits
        for one in source.fit.fitted
        if hasattr(found.settings, one.parameter) or one.parameter == FIX_DELAY
    ]
    missing = [one.parameter for source in found.fits for one in source.fit.not_observable]
    rounded = OdometryFitted(
        log=found.log,
        reference=found.reference,
        start_ns=found.start_ns,
        end_ns=found.middle_ns,
        positions=first.fit.fixes,
        outliers=first.fit.outliers,
        position_sd_m=round(first.fit.fix_sd_m, 3),
        rms_m=round(first.after.fitted_m, 3),
        held_out_rms_m=round(first.after.held_out_m, 3),
        held_out_before_rms_m=round(first.before.held_out_m, 3),
        sd={one.parameter: float(f"{one.sd:.3g}") for one in reversed(shown)},
        not_observable=tuple(dict.fromkeys(missing)),
    )
    return rounded.model_dump(mode="json")


def with_odometry(text: str, found: FittedOdometry) -> str:
    """Return a vehicle file's text with its [odometry] values replaced and comments kept."""
    document = toml_document(text)
    section = document.setdefault("odometry", tomlkit.table())
    for key, value in found.section.items():
        section[key] = value
    if found.is_gnss and (delay_s := found.fits[0].fit.value(FIX_DELAY)):
        gnss = document.setdefault("gnss", tomlkit.table())
        gnss["delay_s"] = round(float(gnss.get("delay_s", 0.0)) + delay_s, 4)
    if (yaw_rad := found.camera_yaw_rad) is not None:
        document.setdefault("camera", tomlkit.table())["yaw_rad"] = yaw_rad
    return tomlkit.dumps(document)
