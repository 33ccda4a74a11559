"""Write a simulated drive as files: log, vehicle file, DBC file and truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth.truth import Mounting
from crosscue.datasets.truth.tum import Trajectory, planar, write_track_truth
from crosscue.replay.can.database import CanDatabase
from crosscue.replay.can.encode import encode
from crosscue.replay.columns import DATA, Block, Bytes, CanFrames, Floats, Int64s, Table, Topic
from crosscue.replay.files.whole_file import write_bytes, write_text
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter

from .drive import (
    FILES_OF_DRIVE,
    DriveSettings,
    Sensed,
    TrueMotion,
    dbc_path,
    sense,
    true_motion,
    vehicle_text,
    with_simulated_noise,
)

BUS: Final = Topic("/can", "crosscue/CanFrames", "columns")
GYRO: Final = Topic("/imu", "sensor_msgs/msg/Imu", "columns")
MAGNETOMETER: Final = Topic("/compass", "sensor_msgs/msg/MagneticField", "columns")
BATCH_ROWS: Final = 1000


def sensor_blocks(sensed: Sensed, seed: int) -> list[Block]:
    """Return readings as rows of a log, in batches, in order of the batches' first rows."""
    rng = np.random.default_rng([seed, 3])
    blocks = [
        *batches(_can_block(sensed, rng)),
        *batches(_stamped(GYRO.name, sensed.gyro_t_ns, "gyro_{}_radps", sensed.gyro_radps, rng)),
        *batches(_stamped(MAGNETOMETER.name, sensed.mag_t_ns, "mag_{}_t", sensed.mag_t, rng)),
    ]
    return sorted(blocks, key=lambda block: int(block.log_ns[0]))


def batches(block: Block) -> list[Block]:
    """Return the rows of a block in blocks of at most ``BATCH_ROWS``."""
    return [
        block.take(slice(start, start + BATCH_ROWS)) for start in range(0, len(block), BATCH_ROWS)
    ]


def can_frames(identifiers: list[int], coded: list[Bytes]) -> CanFrames:
    """Return classic frames: at each time one of each message, with N payloads each."""
    n, k = len(coded[0]), len(identifiers)
    payload = np.zeros((k * n, 8), np.uint8)
    for i, one in enumerate(coded):
        payload[i::k, : one.shape[1]] = one
    return CanFrames(
        np.tile(np.array(identifiers, np.uint32), n),
        np.zeros(k * n, np.bool_),
        np.full(k * n, DATA, np.uint8),
        np.tile(np.array([one.shape[1] for one in coded], np.uint8), n),
        payload,
        np.zeros(k * n, np.bool_),
    )


def _late(t_ns: Int64s, rng: np.random.Generator, min_ms: float, mean_ms: float) -> Int64s:
    """Return the times at which the recorder stores measurements of ``t_ns``; order is kept."""
    delay = min_ms + rng.exponential(mean_ms, len(t_ns))
    late: Int64s = np.maximum.accumulate(t_ns + np.rint(delay * 1e6).astype(np.int64))
    return late


def _stamped(topic: str, t_ns: Int64s, column: str, xyz: Floats, rng: np.random.Generator) -> Block:
    columns = {column.format(axis): xyz[:, i] for i, axis in enumerate("xyz")}
    return Block(topic, _late(t_ns, rng, 2.0, 0.7), Table(columns), header_ns=t_ns)


def _can_block(sensed: Sensed, rng: np.random.Generator) -> Block:
    database = CanDatabase.load([dbc_path()])
    n = len(sensed.wheel_t_ns)
    kmh = np.round(sensed.wheels_mps * 3.6, 2)
    names = ("FRONT_LEFT", "FRONT_RIGHT", "REAR_LEFT", "REAR_RIGHT")
    wheels = encode(database.named("WHEEL_SPEEDS"), dict(zip(names, kmh.T, strict=True)))
    steering = encode(
        database.named("STEERING"),
        {"WHEEL_ANGLE": np.round(np.rad2deg(sensed.steering_rad), 1), "COUNTER": np.arange(n) % 16},
    )
    frames = can_frames([176, 192], [wheels, steering])
    sent = np.repeat(sensed.wheel_t_ns, 2) + np.tile(np.array([0, 250_000]), n)
    return Block(BUS.name, _late(sent, rng, 0.3, 0.1), frames)


SOURCE: Final = "simulated by crosscue, exact"


@dataclass(frozen=True, slots=True)
class DriveFiles:
    """Files of a simulated drive.

    Attributes:
        log: Path of ``drive.mcap``.
        vehicle: Path of ``vehicle.toml``.
        truth: Path of ``truth.json``.
        seconds: Duration of the drive.
        metres: Distance driven.
    """

    log: Path
    vehicle: Path
    truth: Path
    seconds: float
    metres: float


def write_drive(folder: Path, settings: DriveSettings, *, overwrite: bool = False) -> DriveFiles:
    """Simulate a drive and write its files to ``folder``.

    Raises:
        OutputError: A file exists already, or cannot be written.
    """
    motion = true_motion(settings)
    sensed = sense(motion, settings)
    log = folder / "drive.mcap"
    ledger = Ledger(str(log))
    with LogWriter(log, ledger, overwrite=overwrite, beside=FILES_OF_DRIVE) as writer:
        for topic in (BUS, GYRO, MAGNETOMETER):
            writer.add_topic(topic)
        for block in sensor_blocks(sensed, settings.seed):
            writer.write(block)
    write_bytes(folder / "simulated_car.dbc", dbc_path().read_bytes())
    car = vehicle_text(settings, "simulated_car.dbc")
    write_text(folder / "vehicle.toml", with_simulated_noise(car, settings, motion))
    return DriveFiles(
        log,
        folder / "vehicle.toml",
        write_track_truth(
            folder,
            "drive.mcap",
            true_track(motion),
            SOURCE,
            end_ns=int(motion.t_ns[-1]) + 1,
            mounting=Mounting(),
            mounting_source=SOURCE,
            source=SOURCE,
        ),
        float(motion.t_ns[-1] - motion.t_ns[0]) * 1e-9,
        float(np.hypot(np.diff(motion.x_m), np.diff(motion.y_m)).sum()),
    )


def true_track(motion: TrueMotion) -> Trajectory:
    """Return the true trajectory at 10 Hz."""
    tenth = slice(None, None, 10)
    turned = np.angle(np.exp(1j * motion.heading_rad[tenth]))
    return planar(motion.t_ns[tenth], motion.x_m[tenth], motion.y_m[tenth], turned)
