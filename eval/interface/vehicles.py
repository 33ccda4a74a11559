"""Draft a vehicle file from a drive, and check a vehicle file on a drive."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from crosscue.eval.interface.show import listing
from crosscue.eval.logs.log import Log, UnopenedLog, opened
from crosscue.eval.vehicle.check import Checked, Shown, check
from crosscue.eval.vehicle.check_page import check_output, write_check
from crosscue.eval.vehicle.mounting import estimate_mounting
from crosscue.replay.base import EmptyResultError, OutputError, UsageError, name_of, write_text
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.vehicle.drafting.camera import Measured, Mounting, camera_of
from crosscue.replay.vehicle.drafting.text import Examined, draft, examine
from crosscue.replay.vehicle.vehicle import Vehicle, parse, vehicle_given


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleDraft:
    """A first vehicle file; its repr is the file's text.

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
        """Return the JSON output of ``crosscue vehicle init``."""
        return {"vehicle": None if self.path is None else str(self.path), "text": self.text}

    def __repr__(self) -> str:
        return self.text.rstrip("\n")


def draft_vehicle(
    log: Log | UnopenedLog | Path | str,
    databases: Sequence[Path | str] = (),
    output: Path | str | None = None,
    *,
    overwrite: bool = False,
    camera_x_m: float | None = None,
    camera_y_m: float | None = None,
    camera_height_m: float | None = None,
    camera_pitch_deg: float | None = None,
    camera_yaw_deg: float | None = None,
) -> VehicleDraft:
    """Draft a vehicle file from the contents of a drive.

    Wheel speeds, yaw rate and steering are the signals that agree best with GNSS and with each
    other. Pitch and yaw of the camera, unless given, are estimated from pictures of a straight
    road.

    Args:
        log: The drive, or its path.
        databases: DBC, KCD, ARXML or SYM files of its CAN buses.
        output: File to write; default: the text is only returned.
        overwrite: Replace an existing file.
        camera_x_m: Distance of the camera ahead of the rear axle, as measured on the car.
        camera_y_m: Distance of the camera to the left of the car's centre line.
        camera_height_m: Height of the camera above the road.
        camera_pitch_deg: Angle of the camera's axis below the horizon.
        camera_yaw_deg: Angle of the camera's axis to the left.

    Raises:
        UsageError: A number of the mounting is out of range.
        EmptyResultError: No topic has a role in a vehicle file.
        SchemaError: A database is not valid.
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
        _given(camera_yaw_deg, "camera_yaw_deg", -180.0, 180.0, math.pi / 180.0),
    )
    files = [Path(name) for name in databases]
    for file in files:
        CanDatabase.load([file])
    with opened(log) as drive:
        examined = examine(drive.logs, files)
        text = draft(examined, folder, _mounting(examined, given))
    parse(text, "the draft")
    if path is not None:
        write_text(path, text)
    return VehicleDraft(text, path)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class VehicleCheck:
    """Signals of a drive as decoded with a vehicle file, and their contradictions.

    Its repr is a table.

    Attributes:
        path: The page or picture; None if it was not requested.
        part: Seconds of the drive that were examined, in words.
    """

    path: Path | None
    part: str
    _found: Checked

    @property
    def contradictions(self) -> tuple[str, ...]:
        """Contradictions between signals, one sentence each."""
        return self._found.contradictions

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue vehicle check``."""
        picture = self._found.picture
        return {
            "page": None if self.path is None else str(self.path),
            "part": self.part,
            "contradictions": list(self.contradictions),
            "signals": [_known(asdict(row)) for row in self._found.signals],
            "missing": dict(self._found.missing),
            "picture": None
            if picture is None
            else {"topic": picture.topic, "t_ns": picture.t_ns, "size_px": _size_px(picture)},
        }

    def __repr__(self) -> str:
        rows = [
            (row.signal, row.source, row.count, row.rate_hz, row.low, row.high, row.unit)
            for row in self._found.signals
        ]
        head = ("signal", "read from", "readings", "rate_hz", "lowest", "highest", "unit")
        lines = [f"examined {self.part}", "", listing(head, rows, 2) if rows else "no signal", ""]
        lines += [
            f"agrees   {row.signal}: {row.agrees}" for row in self._found.signals if row.agrees
        ]
        lines += [f"not read {signal}: {why}" for signal, why in self._found.missing.items()]
        lines += [f"WRONG    {text}" for text in self.contradictions] or ["no contradiction found"]
        lines += [str(self.path)] if self.path is not None else []
        return "\n".join(lines)


def _size_px(picture: Shown) -> tuple[int, int]:
    return picture.pixels.shape[1], picture.pixels.shape[0]


def _known(row: dict[str, object]) -> dict[str, object]:
    """Return the row with None in place of NaN and infinities, which JSON does not have."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def check_vehicle(
    log: Log | UnopenedLog | Path | str,
    vehicle: Vehicle | Path | str,
    output: Path | str | None = None,
    *,
    start_s: float = 0.0,
    seconds: float = 10.0,
    overwrite: bool = False,
) -> VehicleCheck:
    """Read a few seconds of a drive with a vehicle file, and compare its signals.

    Args:
        log: The drive, or its path.
        vehicle: The vehicle file, or its settings.
        output: Page (``.html``) or picture (``.jpg``, ``.png``) to write, with the horizon,
            distances along the road, and the searched regions; default: none is written.
        start_s: Start, in seconds after the first message.
        seconds: Number of seconds to read.
        overwrite: Replace an existing file.

    Raises:
        VehicleError: The vehicle file does not fit the drive.
        UsageError: The time span is out of range, or the output is neither a page nor a picture.
        OutputError: The file exists, or cannot be written.
        EmptyResultError: Those seconds contain neither a signal nor a picture.
    """
    path = None if output is None else Path(output)
    if path is not None:
        check_output(path, overwrite)
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise UsageError(f"seconds: expected more than 0, got {seconds:g}")
    settings = vehicle_given(vehicle)
    with opened(log) as drive:
        part = drive.part(start_s, start_s + seconds)
        found = check(part.logs, settings, part.selection)
        names = [name_of(one) for one in part.logs]
    words = f"{seconds:g} s starting at {start_s:g} s"
    if not found.signals and found.picture is None:
        why = "; ".join(f"{signal}: {text}" for signal, text in found.missing.items())
        raise EmptyResultError(f"{', '.join(names)}: {words}: no signal and no picture: {why}")
    if path is not None:
        write_check(path, found, settings, names, words)
    return VehicleCheck(path, words, found)


def _given(
    value: float | None, name: str, low: float, high: float, scale: float = 1.0
) -> Measured | None:
    if value is None:
        return None
    if not low <= value <= high:
        raise UsageError(f"{name}: expected {low:g} to {high:g}, got {value:g}")
    return Measured(value * scale, "as given")


def _mounting(examined: Examined, given: Mounting) -> Mounting:
    """Return the given mounting, completed by estimates from pictures of a straight road."""
    camera = camera_of(examined.logs)
    if camera is None:
        return given
    estimate = estimate_mounting(*camera, examined.choices.speed)
    notes = [estimate.why_not] if estimate.why_not else []
    for name in ("pitch_rad", "yaw_rad"):
        seen: Measured | None = getattr(estimate, name)
        if getattr(given, name) is not None and seen is not None:
            notes.append(f"{name} from the pictures, not used: {seen.source}")
    return given._replace(
        pitch_rad=given.pitch_rad or estimate.pitch_rad,
        yaw_rad=given.yaw_rad or estimate.yaw_rad,
        notes=tuple(notes),
    )
