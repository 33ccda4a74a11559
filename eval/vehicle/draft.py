"""Draft of a first vehicle file from the contents of a drive."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path
from typing import Annotated

from crosscue.detectors.catalog.known_models import road_sections
from crosscue.eval.logs.log import WholeDriveGiven, opened
from crosscue.eval.vehicle.mounting import estimate_mounting
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.vehicle.drafting.camera import CameraMounting, MountingParameter, first_camera
from crosscue.replay.vehicle.drafting.text import Examined, draft_text, examine
from crosscue.replay.vehicle.vehicle import Vehicle, parse
from crosscue.results import Result
from crosscue.verb import Option, keywords


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleDraft(Result):
    """A first vehicle file; its text is that of the file, or the path of a written one.

    Attributes:
        text: TOML, with comments on the values to check.
        path: Path of the written file; None if it was not written.
    """

    text: str
    path: Path | None

    @property
    def vehicle(self) -> Vehicle:
        """Settings of the file, with DBC files relative to its folder."""
        return parse(self.text, "the draft")

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output, in which the text keeps its line breaks."""
        return {"vehicle": None if self.path is None else str(self.path), "text": self.text}

    def lines(self) -> Iterator[str]:
        """Yield the path of a written file, else the text."""
        yield self.text.rstrip("\n") if self.path is None else str(self.path)


@dataclass(frozen=True, slots=True)
class DraftSettings:
    """What is known of a car, and where its vehicle file is written.

    Attributes:
        databases: DBC, KCD, ARXML or SYM files of the CAN buses.
        output: Vehicle file to write (default: print it).
        camera_x_m: Distance of the camera ahead of the rear axle.
        camera_y_m: Distance to the left of the car's centre line.
        camera_height_m: Height above the road (default: estimated from speed and pictures).
        camera_pitch_deg: Angle of its axis below the horizon (default: estimated from pictures of a
            straight road).
        camera_yaw_deg: Angle of its axis to the left (default: estimated, too).
        road: Also set up the catalog's networks for objects and road, yolox-nano and
            road-segmentation-adas-0001 (both Apache-2.0); the file states their cost.
        overwrite: Replace an existing file.
    """

    databases: Annotated[Sequence[Path | str], Option("--dbc", metavar="FILE")] = ()
    output: Annotated[Path | str | None, Option(metavar="V.toml")] = None
    _: KW_ONLY
    camera_x_m: float | None = None
    camera_y_m: float | None = None
    camera_height_m: float | None = None
    camera_pitch_deg: float | None = None
    camera_yaw_deg: float | None = None
    road: bool = False
    overwrite: bool = False

    @property
    def mounting(self) -> CameraMounting:
        """The mounting of the camera, as far as it is known.

        Raises:
            UsageError: A number is out of range.
        """
        return CameraMounting(
            self._measured("camera_x_m", -20.0, 20.0),
            self._measured("camera_y_m", -5.0, 5.0),
            self._measured("camera_height_m", 0.1, 10.0),
            self._measured("camera_pitch_deg", -60.0, 60.0, math.pi / 180.0),
            self._measured("camera_yaw_deg", -180.0, 180.0, math.pi / 180.0),
        )

    def _measured(
        self, name: str, low: float, high: float, scale: float = 1.0
    ) -> MountingParameter | None:
        value: float | None = getattr(self, name)
        if value is None:
            return None
        if not low <= value <= high:
            raise UsageError(f"{name}: {value:g}, expected {low:g} to {high:g}")
        return MountingParameter(value * scale, "as given")


@keywords(DraftSettings)
def draft_vehicle(log: WholeDriveGiven, settings: DraftSettings) -> VehicleDraft:
    """Write a first vehicle file from the contents of a log.

    Wheel speeds, yaw rate and steering are the signals that agree best with GNSS and with each
    other. Height, pitch and yaw of the camera, unless given, its focal length, unless published,
    and the delay of its time stamps are estimated from the first minute of pictures; where the
    drive does not determine them, the file says what would be needed.

    Examples:
        crosscue vehicle init drive.mcap --dbc car.dbc -o car.toml

    Args:
        log: The drive, or its path.
        settings: What is known of the car.

    Raises:
        UsageError: A number of the mounting is out of range.
        EmptyResultError: No topic has a role, or none is a CAN bus for the databases.
        SchemaError: A database is not valid.
        OutputError: The file exists, or cannot be written.
    """
    path = None if settings.output is None else Path(settings.output)
    if path is not None and path.exists() and not settings.overwrite:
        raise OutputError(f"{path}: exists; give another name or --overwrite")
    folder = Path.cwd() if path is None else path.parent
    given = settings.mounting
    files = [Path(name) for name in settings.databases]
    for file in files:
        CanDatabase.load([file])
    with opened(log) as drive:
        examined = examine(drive.logs, files)
        text = draft_text(examined, folder, _mounting(examined, given))
    if settings.road:
        text = f"{text.rstrip()}\n\n{road_sections()}"
    parse(text, "the draft")
    if path is not None:
        write_text(path, text)
    return VehicleDraft(text, path)


def _mounting(examined: Examined, given: CameraMounting) -> CameraMounting:
    camera = first_camera(examined.logs)
    if camera is None:
        return given
    choices = examined.choices
    rate = next((one for one in choices.yaw_rates if not one.verdict.wrong), None)
    yaw_rate = None
    if rate is not None:
        signed = rate.verdict.sign * rate.series.values
        yaw_rate = replace(rate.series, values=signed)
    estimate = estimate_mounting(*camera, choices.speed, yaw_rate)
    notes = [*estimate.why_not]
    for name in ("z_m", "pitch_rad", "yaw_rad"):
        seen: MountingParameter | None = getattr(estimate, name)
        if getattr(given, name) is not None and seen is not None:
            notes.append(f"{name} from the pictures, not used: {seen.source}")
    return given._replace(
        z_m=given.z_m or estimate.z_m,
        pitch_rad=given.pitch_rad or estimate.pitch_rad,
        yaw_rad=given.yaw_rad or estimate.yaw_rad,
        focal_px=estimate.focal_px,
        delay_s=estimate.delay_s,
        notes=tuple(notes),
    )
