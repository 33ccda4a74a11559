"""A first vehicle file, made from what a drive holds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.eval.interface.logs.log import Log, opened
from crosscue.eval.vehicle.mounting import estimate_mounting, yaw_notes
from crosscue.replay.base import OutputError, UsageError, write_text
from crosscue.replay.vehicle.drafting.camera import Measured, Mounting, camera_of
from crosscue.replay.vehicle.drafting.text import Examined, draft, examine
from crosscue.replay.vehicle.vehicle import Vehicle, parse


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleDraft:
    """A first vehicle file; printed as its text.

    Attributes:
        text: TOML, with comments on what is to be checked.
        path: Where it was written; None where it was not.
    """

    text: str
    path: Path | None

    @property
    def vehicle(self) -> Vehicle:
        """Its settings; DBC files are named as seen from its folder."""
        return parse(self.text, "the draft")

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue vehicle init --json`` prints."""
        return {"vehicle": None if self.path is None else str(self.path), "text": self.text}

    def __repr__(self) -> str:
        return self.text.rstrip("\n")


def draft_vehicle(
    log: Log | Path | str,
    databases: Sequence[Path | str] = (),
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
    camera_x_m: float | None = None,
    camera_y_m: float | None = None,
    camera_height_m: float | None = None,
    camera_pitch_deg: float | None = None,
) -> VehicleDraft:
    """Write a first vehicle file from what a drive holds.

    Wheel speeds, yaw rate and steering are chosen by how well signals agree with GNSS and with each
    other; the camera's pitch is estimated where it is not given, from pictures of a straight way.

    Args:
        log: The drive, or its path.
        databases: DBC, KCD, ARXML or SYM files of its CAN buses.
        output: The file; if left out, the text is returned only.
        overwrite: Replace a file that is there.
        camera_x_m: How far the camera sits ahead of the rear axle, as measured on the car.
        camera_y_m: How far to the left of the car's middle.
        camera_height_m: How far above the road.
        camera_pitch_deg: How far its axis points below the horizon.

    Raises:
        UsageError: A number of the mounting that cannot be.
        EmptyResultError: No topic plays a role in a vehicle file.
        SchemaError: A database cannot be understood.
        OutputError: The file exists, or cannot be written.
    """
    path = None if output is None else Path(output)
    if path is not None and path.exists() and not overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    folder = Path.cwd() if path is None else path.parent
    given = Mounting(
        _given(camera_x_m, "camera_x_m", -20.0, 20.0),
        _given(camera_y_m, "camera_y_m", -5.0, 5.0),
        _given(camera_height_m, "camera_height_m", 0.1, 10.0),
        _given(camera_pitch_deg, "camera_pitch_deg", -60.0, 60.0, math.pi / 180.0),
    )
    with opened(log) as drive:
        examined = examine(drive.logs, [Path(name) for name in databases])
        text = draft(examined, folder, _mounting(examined, given))
    parse(text, "the draft")
    if path is not None:
        write_text(path, text)
    return VehicleDraft(text, path)


def _given(
    value: float | None, name: str, low: float, high: float, scale: float = 1.0
) -> Measured | None:
    if value is None:
        return None
    if not low <= value <= high:
        raise UsageError(f"{name}: expected {low:g} to {high:g}, got {value:g}")
    return Measured(value * scale, "as given")


def _mounting(examined: Examined, given: Mounting) -> Mounting:
    """What was given, and what pictures of a straight way show."""
    camera = camera_of(examined.logs)
    if camera is None:
        return given
    estimate = estimate_mounting(*camera, examined.choices.speed)
    notes = yaw_notes(estimate)
    if given.pitch_rad is not None:
        if estimate.pitch_rad is not None:
            notes = (*notes, f"pitch_rad of the pictures, not used: {estimate.pitch_rad.source}")
        return given._replace(notes=notes)
    return given._replace(pitch_rad=estimate.pitch_rad, notes=notes)
