"""Fitting of a vehicle file's compass to a drive, with the GNSS course as the reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import tomlkit

from crosscue.eval.pipeline.pose import compass_settings
from crosscue.localization.compass import course_at
from crosscue.localization.fit.compass import CompassFit, fit_compass
from crosscue.replay.base import EmptyResultError, Log, Selection, VehicleError, toml_document
from crosscue.replay.signals.kinds import Signal
from crosscue.replay.vehicle.vehicle import Vehicle

from .log_signals import plan_of, read_signals


def fit(logs: Sequence[Log], vehicle: Vehicle, selection: Selection) -> CompassFit:
    """Fit hard iron, soft iron and mounting, where the drive determines them.

    Raises:
        EmptyResultError: The logs have no magnetometer.
        VehicleError: Too few readings have a reference.
    """
    if vehicle.compass.use is None:
        section = vehicle.compass.model_copy(update={"use": True})
        vehicle = vehicle.model_copy(update={"compass": section})
    planned = plan_of(logs, vehicle)
    magnetometer = planned.source_of(Signal.MAGNETIC_FIELD)
    if magnetometer is None:
        raise EmptyResultError(f"no magnetometer: {planned.missing[Signal.MAGNETIC_FIELD]}")
    found = read_signals(logs, planned, vehicle, selection, (Signal.MAGNETIC_FIELD, Signal.COURSE))
    field = found.get(Signal.MAGNETIC_FIELD)
    if field is None:
        raise VehicleError(f"{magnetometer.topic.name}: not one magnetometer reading in this part")
    reference = None
    ground = found.get(Signal.COURSE)
    if ground is not None:
        reference = course_at(field.t_ns, ground.t_ns, ground.values[:, 0], ground.values[:, 1])
    return fit_compass(field.t_ns, field.values, reference, compass_settings(vehicle))


def section_of(fitted: CompassFit) -> dict[str, object]:
    """Return the fit as a vehicle file's [compass] section."""
    compass = fitted.settings
    section: dict[str, object] = {
        "mounting_rotation": [list(row) for row in compass.mounting_rotation],
        "mounting_yaw_rad": round(compass.mounting_yaw_rad, 6),
        "hard_iron_t": [float(f"{value:.6g}") for value in compass.hard_iron_t],
        "soft_iron": [[round(value, 6) for value in row] for row in compass.soft_iron],
        "declination_rad": compass.declination_rad,
    }
    if np.isfinite(fitted.residual_sd_rad):
        section["heading_sd_rad"] = round(fitted.residual_sd_rad, 4)
    if np.isfinite(fitted.persists_s):
        section["interval_s"] = round(2.0 * fitted.persists_s, 2)
    return section


def with_section(text: str, fitted: CompassFit) -> str:
    """Return a vehicle file's text with its [compass] values replaced and comments kept."""
    document = toml_document(text)
    section = document.setdefault("compass", tomlkit.table())
    for key, value in section_of(fitted).items():
        section[key] = value
    return tomlkit.dumps(document)
