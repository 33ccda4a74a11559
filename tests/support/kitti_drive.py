"""A simulated KITTI raw drive in the published layout: a constant turn at constant speed."""

from pathlib import Path

import numpy as np

from crosscue.datasets.geodesy import ecef_to_enu_matrix, ecef_to_geodetic, geodetic_to_ecef
from crosscue.replay.columns import Floats
from support.pictures import picture

ORIGIN = (49.0, 8.4, 110.0)
SPEED_MPS = 10.0
YAW_RATE_RADPS = 0.2
FIRST = "2011-09-26 13:02:"


def dates(count: int, start_ns: int = 964_389_445) -> str:
    """Text of ``timestamps.txt`` at 10 Hz from 13:02:00 on, in nanoseconds."""
    lines = []
    for i in range(count):
        whole, rest = divmod(start_ns + 100_000_000 * i, 1_000_000_000)
        lines.append(f"{FIRST}{whole:02d}.{rest:09d}")
    return "\n".join(lines) + "\n"


def true_path(count: int) -> tuple[Floats, Floats]:
    """East and north in metres, shape (N, 2), and yaw in rad, shape (N,)."""
    yaw: Floats = YAW_RATE_RADPS * 0.1 * np.arange(count, dtype=np.float64)
    radius = SPEED_MPS / YAW_RATE_RADPS
    return radius * np.column_stack([np.sin(yaw), 1.0 - np.cos(yaw)]), yaw


def packet_lines(count: int) -> list[str]:
    east_north, yaw = true_path(count)
    enu = np.column_stack([east_north, np.zeros(count)])
    matrix = ecef_to_enu_matrix(np.radians(ORIGIN[0]), np.radians(ORIGIN[1]))
    lat, lon, alt = ecef_to_geodetic(geodetic_to_ecef(*ORIGIN) + enu @ matrix)
    lines = []
    for i in range(count):
        north, east = SPEED_MPS * np.sin(yaw[i]), SPEED_MPS * np.cos(yaw[i])
        sideways = SPEED_MPS * YAW_RATE_RADPS
        numbers = np.r_[
            (lat[i], lon[i], alt[i], 0.0, 0.0, np.arctan2(np.sin(yaw[i]), np.cos(yaw[i]))),
            (north, east, SPEED_MPS, 0.0, 0.0),  # velocities
            (0.0, sideways, 9.81, 0.0, sideways, 9.81),  # accelerations in two systems
            (0.0, 0.0, YAW_RATE_RADPS, 0.0, 0.0, YAW_RATE_RADPS, 0.05, 0.02),  # rates, accuracies
        ]
        lines.append(" ".join(repr(float(n)) for n in numbers) + " 4 9 4 4 0")
    return lines


def raw_drive(path: Path, count: int = 30, cameras: tuple[str, ...] = ("image_02",)) -> Path:
    (path / "oxts" / "data").mkdir(parents=True)
    (path / "oxts" / "timestamps.txt").write_text(dates(count))
    for i, line in enumerate(packet_lines(count)):
        (path / "oxts" / "data" / f"{i:010d}.txt").write_text(line + "\n")
    for camera in cameras:
        (path / camera / "data").mkdir(parents=True)
        (path / camera / "timestamps.txt").write_text(dates(count, 950_000_000))
        for i in range(count):
            (path / camera / "data" / f"{i:010d}.png").write_bytes(picture(i))
    return path


def tracking_drive(path: Path, count: int = 30) -> Path:
    """Write one sequence in the layout of the tracking benchmark."""
    (path / "oxts").mkdir(parents=True)
    (path / "oxts" / "0003.txt").write_text("\n".join(packet_lines(count)) + "\n")
    (path / "image_02" / "0003").mkdir(parents=True)
    for i in range(count):
        (path / "image_02" / "0003" / f"{i:06d}.png").write_bytes(picture(i))
    return path
