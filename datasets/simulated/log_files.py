"""Write a simulated drive as files: log, vehicle file, DBC file and truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from crosscue.datasets.truth.truth import Mounting, Truth, save
from crosscue.datasets.truth.tum import planar, write_tum
from crosscue.replay.files.whole_file import write_bytes, write_text
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter

from .drive import (
    FILES_OF_DRIVE,
    DriveSettings,
    TrueMotion,
    dbc_path,
    sense,
    true_motion,
    vehicle_text,
    with_simulated_noise,
)
from .sensor_blocks import BUS, GYRO, MAGNETOMETER, sensor_blocks

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
        _write_truth(folder, motion),
        float(motion.t_ns[-1] - motion.t_ns[0]) * 1e-9,
        float(np.hypot(np.diff(motion.x_m), np.diff(motion.y_m)).sum()),
    )


def _write_truth(folder: Path, motion: TrueMotion) -> Path:
    tenth = slice(None, None, 10)
    turned = np.angle(np.exp(1j * motion.heading_rad[tenth]))
    track = planar(motion.t_ns[tenth], motion.x_m[tenth], motion.y_m[tenth], turned)
    write_tum(folder / "pose.tum", track, SOURCE)
    return save(
        Truth(
            version=1,
            log="drive.mcap",
            start_ns=int(motion.t_ns[0]),
            end_ns=int(motion.t_ns[-1]) + 1,
            pose="pose.tum",
            mounting=Mounting(),
            mounting_source=SOURCE,
            source=SOURCE,
        ),
        folder,
    )
