"""Write a simulated drive of the studies as files that ``crosscue replay`` reads like a real drive.

The log has CAN frames with the speeds of the rear wheels, and a magnetometer. With landmarks, it
also has a camera, which sees a generated wall at each passed landmark, and there is a landmark
database. At an unnoticed landmark, the wall is not in the database. Truth is in ``truth.json``.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from crosscue.datasets.simulated.drive import FIELD_T, FILES_OF_DRIVE, START_NS
from crosscue.datasets.simulated.log_files import BUS, SOURCE, batches, can_frames
from crosscue.datasets.simulated.log_files import MAGNETOMETER as COMPASS
from crosscue.datasets.truth.truth import Mounting
from crosscue.datasets.truth.tum import planar, write_track_truth
from crosscue.localization.angles import wrap_all
from crosscue.localization.town.drive import (
    LANDMARK_MISSED,
    LANDMARK_REFUSED,
    LANDMARK_TAKEN,
    Traced,
)
from crosscue.localization.town.random_stream import key_of
from crosscue.localization.town.settings import TownDrive
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.encode import encode
from crosscue.replay.columns import Block, Bytes, Floats, Int64s, Table, Topic, image_block
from crosscue.replay.files.whole_file import write_text
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter

CAMERA: Final = Topic("/camera", "crosscue/Images", "columns")
WHEELS_ID: Final = 176
WIDTH_PX, HEIGHT_PX = 480, 360
TRUTH_EVERY: Final = 5

DBC: Final = f"""\
VERSION "1"

NS_ :

BS_:

BU_: CAR

BO_ {WHEELS_ID} REAR_WHEELS: 4 CAR
 SG_ REAR_LEFT : 0|16@1+ (0.01,-100) [-100|555.35] "km/h" CAR
 SG_ REAR_RIGHT : 16|16@1+ (0.01,-100) [-100|555.35] "km/h" CAR

CM_ "The bus of a simulated car; no real car's.";
"""

VEHICLE: Final = """\
# The simulated car of crosscue's studies.
version = 1
name = "crosscue study car"
lost_above_m = {lost_above_m}

[can]
bus = "/can"
dbc = ["study_car.dbc"]

[can.wheel_speeds]
rear_left = "REAR_WHEELS.REAR_LEFT"
rear_right = "REAR_WHEELS.REAR_RIGHT"

[odometry]
wheelbase_m = {wheelbase_m}
track_width_m = {track_width_m}
heading_from = "wheels"
slip_per_sqrt_m = {slip}
wheel_turn_rad_per_sqrt_m = {turn}

[compass]
use = {use_compass}
heading_sd_rad = {compass_sd_rad}
interval_m = {compass_interval_m}
interval_s = 0.0

[landmarks]
gate_nis = {gate_nis}
sigmas = 4.0
interval_m = 0.0
interval_s = 0.0

[start]
x_m = {x_m}
y_m = {y_m}
position_sd_m = {position_sd_m}
heading_rad = {heading_rad}
heading_sd_rad = {heading_sd_rad}
"""


@dataclass(frozen=True, slots=True)
class StudyDriveFiles:
    """The written files.

    Attributes:
        log: ``drive.mcap``.
        vehicle: ``vehicle.toml``.
        truth: ``truth.json``.
        landmarks: ``landmarks.db``; None if no landmark was passed.
    """

    log: Path
    vehicle: Path
    truth: Path
    landmarks: Path | None


def write_drive_files(
    folder: Path, settings: TownDrive, traced: Traced, seed: int, *, overwrite: bool = False
) -> StudyDriveFiles:
    """Write log, vehicle file, DBC file, truth and landmark database of one drive.

    Args:
        folder: Output folder.
        settings: Settings of the drive.
        traced: The drive.
        seed: Seed of the drive and of the walls.
        overwrite: Replace existing files.

    Raises:
        OutputError: A file already exists, or cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "drive.mcap"
    t_ns = _times(settings, len(traced.steps))
    passed = traced.of_kind(LANDMARK_MISSED, LANDMARK_TAKEN, LANDMARK_REFUSED)
    with LogWriter(log, Ledger(str(log)), overwrite=overwrite, beside=FILES_OF_DRIVE) as writer:
        write_text(folder / "study_car.dbc", DBC)
        topics = [BUS]
        topics += [COMPASS] if settings.sensors.compass_2sigma_deg is not None else []
        topics += [CAMERA] if len(passed) else []
        for topic in topics:
            writer.add_topic(topic)
        for block in _in_order(settings, traced, t_ns, passed, seed, folder):
            writer.write(block)
    write_text(folder / "vehicle.toml", town_vehicle_text(settings, traced))
    landmarks = None
    if len(passed):
        landmarks = folder / "landmarks.db"
        landmarks.unlink(missing_ok=True)
        _write_landmarks(landmarks, passed, settings.sensors.landmark_sd_m, seed)
    return StudyDriveFiles(
        log, folder / "vehicle.toml", _write_truth(folder, traced, t_ns), landmarks
    )


def town_vehicle_text(settings: TownDrive, traced: Traced) -> str:
    """Return the vehicle file of the simulated car and its start."""
    car, sensors = settings.car, settings.sensors
    compass = sensors.compass_2sigma_deg
    x, y, heading = traced.first_belief
    return VEHICLE.format(
        lost_above_m=settings.navigation.lost_above_m,
        wheelbase_m=car.wheelbase_m,
        track_width_m=car.track_width_m,
        slip=sensors.slip_per_sqrt_m / math.sqrt(2.0),
        turn=math.sqrt(2.0) * sensors.slip_per_sqrt_m / car.track_width_m,
        use_compass="false" if compass is None else "true",
        compass_sd_rad=math.radians(180.0 if compass is None else compass) / 2.0,
        compass_interval_m=sensors.compass_interval_m,
        gate_nis=sensors.landmark_gate_nis,
        x_m=x,
        y_m=y,
        position_sd_m=sensors.start_position_sd_m,
        heading_rad=heading,
        heading_sd_rad=math.radians(sensors.start_heading_sd_deg),
    )


def _times(settings: TownDrive, steps: int) -> Int64s:
    """Return the log time at the end of each step."""
    return START_NS + np.round(np.arange(1, steps + 1) * settings.car.step_s * 1e9).astype(np.int64)


def _in_order(
    settings: TownDrive, traced: Traced, t_ns: Int64s, passed: Floats, seed: int, folder: Path
) -> list[Block]:
    blocks = batches(_can_block(settings, traced, t_ns, folder))
    if settings.sensors.compass_2sigma_deg is not None:
        blocks += batches(_compass_block(traced, t_ns))
    blocks += [_frames_block(row, t_ns, i, seed) for i, row in enumerate(passed)]
    return sorted(blocks, key=lambda block: int(block.log_ns[0]))


def _can_block(settings: TownDrive, traced: Traced, t_ns: Int64s, folder: Path) -> Block:
    """Return the wheel speeds of each step, with the time of its middle."""
    database = CanDatabase.load([folder / "study_car.dbc"])
    kmh = np.round(traced.steps[:, 4:6] / settings.car.step_s * 3.6, 2)
    coded = encode(database.named("REAR_WHEELS"), {"REAR_LEFT": kmh[:, 0], "REAR_RIGHT": kmh[:, 1]})
    frames = can_frames([WHEELS_ID], [coded])
    return Block(BUS.name, t_ns - round(settings.car.step_s * 0.5e9), frames)


def _compass_block(traced: Traced, t_ns: Int64s) -> Block:
    """Return the magnetic field at every step, whose error is constant between readings."""
    heading, read = traced.steps[:, 2], traced.steps[:, 6]
    rows = np.flatnonzero(~np.isnan(read))
    if not len(rows):
        empty = np.empty(0)
        return Block(
            COMPASS.name, t_ns[:0], Table({f"mag_{a}_t": empty for a in "xyz"}), header_ns=t_ns[:0]
        )
    last = np.maximum(np.searchsorted(rows, np.arange(len(heading)), side="right") - 1, 0)
    error = wrap_all(read[rows] - heading[rows])[last]
    north = math.pi / 2.0 - (heading + error)
    field = {
        "mag_x_t": FIELD_T[0] * np.cos(north),
        "mag_y_t": FIELD_T[0] * np.sin(north),
        "mag_z_t": np.full(len(north), FIELD_T[1]),
    }
    table = Table({name: values[rows[0] :] for name, values in field.items()})
    return Block(COMPASS.name, t_ns[rows[0] :], table, header_ns=t_ns[rows[0] :])


def _frames_block(row: Floats, t_ns: Int64s, number: int, seed: int) -> Block:
    """Return frames of the wall at a landmark, and after it, when the replay uses the match."""
    first = int(row[0]) - 1
    at_ns = t_ns[first : first + 2]
    is_known = row[1] != LANDMARK_MISSED
    walls = [number if is_known else -1 - 2 * number, -2 - 2 * number][: len(at_ns)]
    coded: list[bytes] = []
    for wall in walls:
        picture = _seen(_wall(seed, wall), seed + number)
        done, buffer = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])
        assert done
        coded.append(buffer.tobytes())
    return image_block(CAMERA.name, at_ns, coded, ["jpeg"] * len(coded), at_ns)


def _wall(seed: int, number: int) -> Bytes:
    """Generate a wall with enough corners; negative numbers are walls without a landmark."""
    rng = np.random.default_rng(key_of(seed, number & 0xFFFF_FFFF, int(number < 0)))
    picture = np.full((HEIGHT_PX, WIDTH_PX), 128, np.uint8)
    for _ in range(300):
        x, y = int(rng.integers(0, WIDTH_PX)), int(rng.integers(0, HEIGHT_PX))
        w, h = (int(side) for side in rng.integers(4, 50, 2))
        cv2.rectangle(picture, (x, y), (x + w, y + h), (int(rng.integers(0, 256)),), -1)
    return picture


def _seen(wall: Bytes, seed: int) -> Bytes:
    """Return the wall from a slightly different position, darker and with noise."""
    rng = np.random.default_rng(key_of(seed))
    centre = (WIDTH_PX / 2.0, HEIGHT_PX / 2.0)
    turn = cv2.getRotationMatrix2D(centre, rng.uniform(-4.0, 4.0), rng.uniform(0.9, 1.1))
    moved = cv2.warpAffine(wall, turn, (WIDTH_PX, HEIGHT_PX), borderMode=cv2.BORDER_REFLECT)
    noisy = 0.85 * moved + rng.normal(8.0, 4.0, moved.shape)
    seen: Bytes = np.clip(noisy, 0, 255).astype(np.uint8)
    return seen


def _write_landmarks(path: Path, passed: Floats, sd_m: float, seed: int) -> None:
    """Write one entry per recognition, at the noisy position that the drive used."""
    from crosscue.localization.landmarks.database import LandmarkPosition, LandmarkWriter
    from crosscue.localization.landmarks.features import make_matcher

    matcher = make_matcher("orb")
    with LandmarkWriter(path, matcher.kind) as writer:
        for number, row in enumerate(passed):
            if row[1] == LANDMARK_MISSED:
                continue
            place = LandmarkPosition(
                f"wall {number}", row[4:6].copy(), sd_m**2 * np.eye(2), None, "simulated"
            )
            writer.add(place, matcher.describe(_wall(seed, number)))


def _write_truth(folder: Path, traced: Traced, t_ns: Int64s) -> Path:
    kept = slice(None, None, TRUTH_EVERY)
    x, y, heading = traced.steps[kept, :3].T
    return write_track_truth(
        folder,
        "drive.mcap",
        planar(t_ns[kept], x, y, heading),
        SOURCE,
        end_ns=int(t_ns[-1]) + 1,
        mounting=Mounting(),
        mounting_source=SOURCE,
        source=SOURCE,
    )
