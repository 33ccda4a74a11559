"""Fitting of a vehicle file's compass to a drive, with the GNSS course as the reference."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from crosscue.eval.logs.log import DriveGiven, opened
from crosscue.eval.pipeline.pose import compass_settings
from crosscue.eval.report.chart import Chart, Series
from crosscue.localization.angles import wrap_all
from crosscue.localization.compass import CompassSettings, course_at, heading, level_field
from crosscue.localization.fit.compass import CompassFit
from crosscue.localization.fit.compass import fit_compass as fit_readings
from crosscue.replay.base import Log, Selection
from crosscue.replay.columns import Floats
from crosscue.replay.errors import EmptyResultError, VehicleError
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given
from crosscue.results import HIDDEN
from crosscue.verb import Option

from .log_signals import read_signals, signal_plan
from .vehicle_output import Fitted, check_output, with_section, write_fit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedCompass(Fitted):
    """Fitted mounting, hard and soft iron of a compass.

    Attributes:
        fitted: Fitted values, their uncertainty, and the parameters that are not observable.
        given: The compass before the fit.
        field_t: Readings that it was fitted to, shape (N, 3).
        course_rad: Course by GNSS at their times, NaN where it is unknown; None without GNSS.
    """

    fitted: CompassFit = field(metadata=HIDDEN)
    given: CompassSettings = field(metadata=HIDDEN)
    field_t: Floats = field(metadata=HIDDEN)
    course_rad: Floats | None = field(metadata=HIDDEN)

    also: ClassVar = {
        "compass": "section",
        "observable": "fitted.observable",
        "not_observable": "not_observable",
        "readings": "fitted.readings",
        "readings_used": "fitted.readings_used",
        "coverage_deg": "fitted.coverage_deg",
        "residual_sd_rad": "fitted.residual_sd_rad",
        "persists_s": "fitted.persists_s",
        "persists_is_bound": "fitted.persists_is_bound",
        "mounting_yaw_sd_rad": "fitted.mounting_yaw_sd_rad",
    }

    @property
    def section(self) -> dict[str, object]:
        """The vehicle file's section ``[compass]``."""
        compass = self.fitted.settings
        section: dict[str, object] = {
            "mounting_rotation": [list(row) for row in compass.mounting_rotation],
            "mounting_yaw_rad": round(compass.mounting_yaw_rad, 6),
            "hard_iron_t": [float(f"{value:.6g}") for value in compass.hard_iron_t],
            "soft_iron": [[round(value, 6) for value in row] for row in compass.soft_iron],
            "declination_rad": compass.declination_rad,
        }
        if np.isfinite(self.fitted.residual_sd_rad):
            section["heading_sd_rad"] = round(self.fitted.residual_sd_rad, 4)
        if np.isfinite(self.fitted.persists_s):
            section["interval_s"] = round(2.0 * self.fitted.persists_s, 2)
        return section

    @property
    def toml(self) -> str:
        """The section as text."""
        return with_section("", "compass", self.section)

    @property
    def not_observable(self) -> dict[str, str]:
        """Reason why a parameter keeps its value, by parameter."""
        return dict(self.fitted.not_observable)

    def report(self) -> Iterator[str]:
        """Yield the quality of the fit."""
        fitted = self.fitted
        yield (
            f"readings    {fitted.readings_used} of {fitted.readings} used; headings cover "
            f"{fitted.coverage_deg} degrees of the circle"
        )
        yield f"fitted      {', '.join(fitted.observable) or 'nothing'}"
        yield from (f"not fitted  {name}: {reason}" for name, reason in fitted.not_observable)
        yield from _residual(fitted)

    def charts(self) -> Iterator[Chart]:
        """Yield the horizontal field, and the heading against the course."""
        both = ("values before", self.given), ("fitted", self.fitted.settings)
        yield Chart(
            "Horizontal field of all readings: a circle around the origin without iron",
            "forward (µT)",
            "left (µT)",
            [
                Series(name, *(1e6 * level_field(self.field_t, one)[:, :2]).T, is_line=False)
                for name, one in both
            ],
            is_map=True,
        )
        if self.course_rad is not None:
            course_deg = np.degrees(self.course_rad)
            apart = [wrap_all(heading(self.field_t, one) - self.course_rad) for _, one in both]
            yield Chart(
                "Heading less the GNSS course",
                "course, counter-clockwise from east (deg)",
                "difference (deg)",
                [
                    Series(name, course_deg, np.degrees(one), is_line=False)
                    for (name, _), one in zip(both, apart, strict=True)
                ],
            )


def _residual(fitted: CompassFit) -> list[str]:
    if math.isnan(fitted.residual_sd_rad):
        return ["residual    unknown: there is no reference heading"]
    yaw_deg = math.degrees(fitted.settings.mounting_yaw_rad)
    bound = "at least " if fitted.persists_is_bound else ""
    return [
        f"mounting    {yaw_deg:.2f} +- {math.degrees(fitted.mounting_yaw_sd_rad):.2f} degrees",
        f"residual    s.d. {math.degrees(fitted.residual_sd_rad):.2f} degrees, persists for {bound}"
        f"{fitted.persists_s:.1f} s",
    ]


def fit_compass(
    log: DriveGiven,
    vehicle: Vehicle | Path | str | None = None,
    output: Annotated[Path | str | None, Option(metavar="V.toml")] = None,
    *,
    overwrite: bool = False,
) -> FittedCompass:
    """Fit compass mounting, hard iron and soft iron to a drive.

    The reference is the GNSS course. Parameters that the drive does not determine keep their values
    and are listed. For example, a straight drive determines only the mounting angle.

    Examples:
        crosscue fit compass drive.mcap --vehicle car.toml -o car.toml

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        vehicle: Vehicle file; without one, the defaults.
        output: Vehicle file to write: a copy of --vehicle with the fit; may be the same file.
        overwrite: Replace another existing file.

    Raises:
        EmptyResultError: The drive has no magnetometer.
        VehicleError: The drive has too few readings with a reference.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        found = fit_log_compass(drive.logs, settings, drive.selection)
    path = write_fit(vehicle, output, lambda text: with_section(text, "compass", found.section))
    return replace(found, path=path)


def fit_log_compass(logs: Sequence[Log], vehicle: Vehicle, selection: Selection) -> FittedCompass:
    """Fit hard iron, soft iron and mounting, where the drive determines them.

    Raises:
        EmptyResultError: The logs have no magnetometer.
        VehicleError: Too few readings have a reference.
    """
    if vehicle.compass.use is None:
        section = vehicle.compass.model_copy(update={"use": True})
        vehicle = vehicle.model_copy(update={"compass": section})
    planned = signal_plan(logs, vehicle)
    magnetometer = planned.source_of(Signal.MAGNETIC_FIELD)
    if magnetometer is None:
        raise EmptyResultError(f"no magnetometer: {planned.missing[Signal.MAGNETIC_FIELD]}")
    found = read_signals(logs, planned, vehicle, selection, (Signal.MAGNETIC_FIELD, Signal.COURSE))
    readings = found.get(Signal.MAGNETIC_FIELD)
    if readings is None:
        raise VehicleError(f"{magnetometer.topic.name}: not one magnetometer reading in this part")
    reference = None
    ground = found.get(Signal.COURSE)
    if ground is not None:
        reference = course_at(readings.t_ns, ground.t_ns, ground.values[:, 0], ground.values[:, 1])
    given = compass_settings(vehicle)
    fitted = fit_readings(readings.t_ns, readings.values, reference, given)
    return FittedCompass(fitted, given, readings.values, reference)
