"""Draft of a first vehicle file from the contents of a drive."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import numpy as np

from crosscue.detectors.base import View
from crosscue.detectors.catalog.known_models import road_sections
from crosscue.detectors.images import decode, encoded, lose
from crosscue.detectors.ranging.travel_direction import Travel, travel_between
from crosscue.eval.logs.log import WholeDriveGiven, opened
from crosscue.replay.base import EVERYTHING, Log, name_of
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.columns import Bytes, Floats, Images
from crosscue.replay.errors import LogError, OutputError, UsageError
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.vehicle.drafting.camera import (
    CameraMounting,
    Intrinsics,
    MountingParameter,
    first_camera,
)
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.drafting.text import Examined, draft_text, examine
from crosscue.replay.vehicle.vehicle import Camera, Vehicle, parse
from crosscue.results import Result
from crosscue.verb import Option, keywords

DEGREE: Final = np.pi / 180.0
WIDTH_PX: Final = 960
# Distance between two pictures: near objects move visibly, but stay in the picture.
APART_M: Final = 1.5
MOVING_MPS: Final = 2.0
# Max curvature of a straight road, a radius of 290 m.
STRAIGHT_RAD_PER_M: Final = 0.2 * DEGREE
PAIRS: Final = 200
MIN_PAIRS: Final = 10
LOOKED_AT_NS: Final = 60_000_000_000


class Estimate(NamedTuple):
    """Estimate of the mounting from pairs of pictures.

    Attributes:
        pitch_rad: Angle of the optical axis below the direction of travel; None without enough
            pairs.
        yaw_rad: Angle of the optical axis to the left of the direction of travel; likewise.
        pairs: Number of pairs of pictures used.
        why_not: Reason why the estimate is missing; empty if it is not.
    """

    pitch_rad: MountingParameter | None
    yaw_rad: MountingParameter | None
    pairs: int
    why_not: str = ""


def estimate_mounting(
    log: Log, camera: str, intrinsics: Intrinsics | None, speed: Series | None
) -> Estimate:
    """Return pitch and yaw of a log's camera, each the median over pairs of pictures.

    Args:
        log: The open log.
        camera: Topic of the camera.
        intrinsics: Intrinsics of the camera; without them there is no estimate.
        speed: Speed of the vehicle, m/s; without it there is no estimate.
    """
    if intrinsics is None or speed is None or len(speed) < 2:
        lacks = "focal_px" if intrinsics is None else "the vehicle's speed"
        return Estimate(None, None, 0, f"pitch and yaw not estimated: needs {lacks}")
    number = next(i for i, topic in enumerate(log.topics) if topic.name == camera)
    first = next(_grey(log, number, Ledger("")), None)
    focal_px, center_px, _, size_px = intrinsics
    known = Camera(focal_px=focal_px, center_px=center_px, size_px=size_px)
    if first is not None and (why := known.mismatch(first[2])) is not None:
        return Estimate(None, None, 0, f"pitch and yaw not estimated: {why}")
    seen, bends, ledger = 0, 0, Ledger(name_of(log))
    found: list[Travel] = []
    for before, after, way_m, focal_px, center_px in _pairs(log, number, intrinsics, speed, ledger):
        seen += 1
        travel = travel_between(before, after, focal_px, center_px)
        if travel is None:
            continue
        if abs(travel.turned_rad) > STRAIGHT_RAD_PER_M * way_m:
            bends += 1
            continue
        found.append(travel)
        if len(found) == PAIRS:
            break
    warn_of(ledger)
    if len(found) < MIN_PAIRS:
        return Estimate(
            None,
            None,
            len(found),
            f"pitch and yaw not estimated: {len(found)} pairs of pictures of a straight road, of "
            f"{seen} examined, {bends} in bends; expected {MIN_PAIRS} or more",
        )
    return Estimate(
        _measured(np.array([one.below_rad for one in found])),
        _measured(np.array([one.left_rad for one in found])),
        len(found),
    )


def _measured(angles_rad: Floats) -> MountingParameter:
    median = float(np.median(angles_rad))
    spread = 1.4826 * float(np.median(np.abs(angles_rad - median)))
    return MountingParameter(
        median,
        f"ESTIMATED: {median / DEGREE:.2f} deg, the vanishing point of {len(angles_rad)} pairs of "
        f"pictures on a straight road, s.d. of one {spread / DEGREE:.2f} deg",
    )


def _pairs(
    log: Log, number: int, intrinsics: Intrinsics, speed: Series, ledger: Ledger
) -> Iterator[tuple[Bytes, Bytes, float, float, tuple[float, float]]]:
    """Yield pairs of pictures about ``APART_M`` apart, with distance, focal length and centre."""
    way_m = _way_m(speed)
    waiting: deque[tuple[float, Bytes]] = deque()
    first_ns: int | None = None
    for t_ns, grey, size_px in _grey(log, number, ledger):
        first_ns = t_ns if first_ns is None else first_ns
        if t_ns - first_ns > LOOKED_AT_NS:
            return
        if not speed.t_ns[0] <= t_ns <= speed.t_ns[-1]:
            continue
        if abs(float(np.interp(t_ns, speed.t_ns, speed.values))) < MOVING_MPS:
            waiting.clear()
            continue
        here_m = float(np.interp(t_ns, speed.t_ns, way_m))
        while len(waiting) > 1 and here_m - waiting[1][0] >= APART_M:
            waiting.popleft()
        if waiting and here_m - waiting[0][0] >= APART_M and waiting[0][1].shape == grey.shape:
            scale = grey.shape[1] / size_px[0]
            focal_px = intrinsics.focal_px * scale
            center_px = (intrinsics.center_px[0] * scale, intrinsics.center_px[1] * scale)
            yield waiting[0][1], grey, here_m - waiting[0][0], focal_px, center_px
        waiting.append((here_m, grey))


def _way_m(speed: Series) -> Floats:
    steps = 0.5 * (speed.values[1:] + speed.values[:-1]) * np.diff(speed.t_ns) * 1e-9
    return np.concatenate([[0.0], np.cumsum(np.abs(steps))])


def _grey(log: Log, number: int, ledger: Ledger) -> Iterator[tuple[int, Bytes, tuple[int, int]]]:
    """Yield undamaged pictures in order of time, small and grey, with their full size."""
    import cv2

    view = View(is_grey=True, min_width_px=WIDTH_PX)
    pictures = pictures_of(log, 0, log.topics[number], Vehicle(version=1), ledger, EVERYTHING)
    for block, rows in pictures:
        assert isinstance(rows, Images)
        for row, t_ns in enumerate(block.log_ns.tolist()):
            try:
                pixels, size_px = decode(encoded(rows, row), view)
            except LogError as error:
                lose(ledger, block.topic, t_ns, error)
                continue
            if pixels.shape[1] > WIDTH_PX:
                height = round(pixels.shape[0] * WIDTH_PX / pixels.shape[1])
                small = cv2.resize(pixels, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
                pixels = np.asarray(small, np.uint8)
            yield t_ns, pixels, size_px


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
        camera_height_m: Height above the road.
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
    other. Pitch and yaw of the camera, unless given, are estimated from pictures of a straight
    road.

    Examples:
        crosscue vehicle init drive.mcap --dbc car.dbc -o car.toml

    Args:
        log: The drive, or its path.
        settings: What is known of the car.

    Raises:
        UsageError: A number of the mounting is out of range.
        EmptyResultError: No topic has a role in a vehicle file.
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
    """Return the given mounting, completed by estimates from pictures of a straight road."""
    camera = first_camera(examined.logs)
    if camera is None:
        return given
    estimate = estimate_mounting(*camera, examined.choices.speed)
    notes = [estimate.why_not] if estimate.why_not else []
    for name in ("pitch_rad", "yaw_rad"):
        seen: MountingParameter | None = getattr(estimate, name)
        if getattr(given, name) is not None and seen is not None:
            notes.append(f"{name} from the pictures, not used: {seen.source}")
    return given._replace(
        pitch_rad=given.pitch_rad or estimate.pitch_rad,
        yaw_rad=given.yaw_rad or estimate.yaw_rad,
        notes=tuple(notes),
    )
