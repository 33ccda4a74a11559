"""Fit odometry to a drive."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.eval.fit.odometry import camera_yaw_of, fit, section_of, with_section
from crosscue.eval.fit.reference import of_truth
from crosscue.eval.interface.fits.vehicle_output import check_output, write_fit
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.replay.vehicle.vehicle import Vehicle, vehicle_given

if TYPE_CHECKING:
    from crosscue.eval.fit.odometry import DriveFit, SourceFit


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FittedOdometry:
    """Odometry fitted to the first half of a drive and tested on the second.

    Attributes:
        fitted: Fit for each source of the turn rate, with errors before and after on both halves.
        path: Vehicle file that was written; None without one.
    """

    fitted: DriveFit
    path: Path | None

    @property
    def section(self) -> dict[str, object]:
        """The vehicle file's section ``[odometry]``."""
        return section_of(self.fitted)

    @property
    def camera_yaw_rad(self) -> float | None:
        """Mounting yaw of the camera; None unless the positions are the camera's track."""
        return camera_yaw_of(self.fitted)

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue fit odometry``."""
        found = self.fitted
        return {
            "odometry": self.section,
            "camera_yaw_rad": self.camera_yaw_rad,
            "log": found.log,
            "reference": found.reference,
            "start_ns": found.start_ns,
            "middle_ns": found.middle_ns,
            "end_ns": found.end_ns,
            "nees_band": list(found.nees_band),
            "not_fitted": found.not_fitted,
            "sources": [
                {
                    "source": one.fit.source,
                    "fitted": [value._asdict() for value in one.fit.fitted],
                    "not_observable": dict(one.fit.not_observable),
                    "positions": one.fit.fixes,
                    "outliers": one.fit.outliers,
                    "position_sd_m": one.fit.fix_sd_m,
                    "residual_rms": one.fit.residual_rms,
                    "before": asdict(one.before),
                    "after": asdict(one.after),
                }
                for one in found.sources
            ],
        }

    def __repr__(self) -> str:
        found = self.fitted
        seconds = [(t_ns - found.start_ns) * 1e-9 for t_ns in (found.middle_ns, found.end_ns)]
        lines = [
            f"positions   {found.reference}",
            f"fitted to   the first {seconds[0]:.1f} s of {seconds[1]:.1f} s; the rest is held out",
        ]
        for one in found.sources:
            lines += ["", *_source(one)]
        low, high = found.nees_band
        lines += ["", f"NEES of x, y is consistent for one drive between {low:.2f} and {high:.2f}"]
        lines += [f"not fitted  {name}: {why}" for name, why in found.not_fitted.items()]
        lines += ["", "[odometry]"]
        lines += [f"{key} = {value}" for key, value in self.section.items() if key != "fitted"]
        if self.camera_yaw_rad is not None:
            lines += ["", "[camera]", f"yaw_rad = {self.camera_yaw_rad}"]
        if self.path is not None:
            lines.append(f"written to {self.path}")
        return "\n".join(lines)


def _source(one: SourceFit) -> list[str]:
    fit, before, after = one.fit, one.before, one.after
    width = max(len(name) for name in [*(v.parameter for v in fit.fitted), "gyro_bias_radps"])
    lines = [
        f"turns from {fit.source}: {fit.fixes} positions of s.d. {fit.fix_sd_m:.2f} m, "
        f"{fit.outliers} outliers"
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
    log: Log | UnopenedLog | Path | str,
    vehicle: Vehicle | Path | str | None = None,
    output: Path | str | None = None,
    *,
    truth: Path | str | None = None,
    overwrite: bool = False,
) -> FittedOdometry:
    """Fit odometry to the first half of a drive, and test it on the second.

    Scales, biases, geometry, delays and noise are fitted to GNSS or to a true track. Parameters
    that the drive does not determine keep their values and are listed.

    Args:
        log: The drive, or its path; ``log.part(...)`` for a part of it.
        vehicle: The vehicle file; None for the defaults.
        output: Vehicle file to write, with the fit; may be ``vehicle`` itself.
        truth: Truth file with the positions; None for the log's GNSS.
        overwrite: Replace another existing file.

    Raises:
        EmptyResultError: The drive has no wheel speeds, or no positions.
        VehicleError: The drive has too few positions, or is too short.
        SchemaError: The truth file does not fit the drive, or contains no pose.
        OutputError: The output exists, or cannot be written.
    """
    check_output(vehicle, output, overwrite=overwrite)
    settings = vehicle_given(vehicle)
    known = None if truth is None else of_truth(Path(truth), settings)
    with opened(log) as drive:
        found = fit(drive.logs, settings, drive.selection, known)
    path = write_fit(vehicle, output, lambda text: with_section(text, found))
    return FittedOdometry(found, path)
