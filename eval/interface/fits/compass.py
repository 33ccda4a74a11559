"""A compass fitted to a drive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.fit.compass import fit, section_of, with_section
from crosscue.eval.interface.fits.vehicle_output import check_output, write_fit
from crosscue.eval.interface.logs.log import Log, opened
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.localization.fit.compass import CompassFit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedCompass:
    """Mounting, hard and soft iron as far as a drive shows them; printed with its section.

    Attributes:
        fitted: The fit, and how far to trust it.
        path: The vehicle file it was written to; None where it was not.
    """

    fitted: CompassFit
    path: Path | None

    @property
    def section(self) -> dict[str, object]:
        """The vehicle file's section ``[compass]``."""
        return section_of(self.fitted)

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue fit compass --json`` prints."""
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
            *(f"not seen    {name}: {reason}" for name, reason in fitted.not_observable),
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
        return ["residual    not known: there is no reference heading"]
    yaw_deg = math.degrees(fitted.settings.mounting_yaw_rad)
    bound = "at least " if fitted.persists_is_bound else ""
    return [
        f"mounting    {yaw_deg:.2f} +- {math.degrees(fitted.mounting_yaw_sd_rad):.2f} degrees",
        f"residual    s.d. {math.degrees(fitted.residual_sd_rad):.2f} degrees, persists for {bound}"
        f"{fitted.persists_s:.1f} s",
    ]


def fit_compass(
    log: Log | Path | str,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
) -> FittedCompass:
    """Fit a compass to a drive: mounting, hard and soft iron, as far as the drive shows them.

    The reference is the GNSS course. What a drive cannot show keeps its value and is named.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        vehicle: The vehicle file; None for the defaults.
        output: The vehicle file to write, with the fit; may be ``vehicle`` itself.
        overwrite: Replace another file that is there.

    Raises:
        EmptyResultError: No magnetometer.
        VehicleError: Too few readings with a reference.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        fitted = fit(drive.logs, settings, drive.selection)
    path = write_fit(vehicle, output, lambda text: with_section(text, fitted))
    return FittedCompass(fitted, path)
