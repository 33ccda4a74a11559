"""Fit a compass to a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.fit.compass import fit, section_of, with_section
from crosscue.eval.interface.fits.vehicle_output import check_output, write_fit
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.localization.fit.compass import CompassFit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedCompass:
    """Fitted mounting, hard and soft iron of a compass.

    Attributes:
        fitted: Fitted values, their uncertainty, and the parameters that are not observable.
        path: Vehicle file that was written; None without one.
    """

    fitted: CompassFit
    path: Path | None

    @property
    def section(self) -> dict[str, object]:
        """The vehicle file's section ``[compass]``."""
        return section_of(self.fitted)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit compass``."""
        fitted = self.fitted
        return {
            "compass": self.section,
            "observable": list(fitted.observable),
            "not_observable": dict(fitted.not_observable),
            "readings": fitted.readings,
            "readings_used": fitted.readings_used,
            "coverage_deg": fitted.coverage_deg,
            "residual_sd_rad": fitted.residual_sd_rad,
            "persists_s": fitted.persists_s,
            "persists_is_bound": fitted.persists_is_bound,
            "mounting_yaw_sd_rad": fitted.mounting_yaw_sd_rad,
        }

    def __repr__(self) -> str:
        fitted = self.fitted
        lines = [
            f"readings    {fitted.readings_used} of {fitted.readings} used; headings cover "
            f"{fitted.coverage_deg} degrees of the circle",
            f"fitted      {', '.join(fitted.observable) or 'nothing'}",
            *(f"not fitted  {name}: {reason}" for name, reason in fitted.not_observable),
            *_residual(fitted),
            "",
            "[compass]",
            *(f"{key} = {value}" for key, value in self.section.items()),
        ]
        if self.path is not None:
            lines.append(f"written to {self.path}")
        return "\n".join(lines)


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
    log: Log | UnopenedLog | Path | str,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
) -> FittedCompass:
    """Fit a compass to a drive: its mounting angle, and hard and soft iron.

    The reference is the GNSS course. Parameters that the drive does not determine keep their values
    and are listed.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        vehicle: The vehicle file; None for the defaults.
        output: Vehicle file to write, with the fit; may be ``vehicle`` itself.
        overwrite: Replace another existing file.

    Raises:
        EmptyResultError: The drive has no magnetometer.
        VehicleError: The drive has too few readings with a reference.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        fitted = fit(drive.logs, settings, drive.selection)
    path = write_fit(vehicle, output, lambda text: with_section(text, fitted))
    return FittedCompass(fitted, path)
