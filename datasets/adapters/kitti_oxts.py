"""Parse OXTS packets of KITTI: thirty numbers of a GNSS/INS box on one line of text.

Columns and axes are those of the published ``dataformat.txt``. The box's axes are x forward, y left
and z up, as in REP-103. Yaw is 0 when heading east and increases counter-clockwise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.replay.columns import Floats, Int64s, Table

COLUMNS: Final = (
    "lat", "lon", "alt", "roll", "pitch", "yaw",
    "vn", "ve", "vf", "vl", "vu",
    "ax", "ay", "az", "af", "al", "au",
    "wx", "wy", "wz", "wf", "wl", "wu",
    "pos_accuracy", "vel_accuracy", "navstat", "numsats", "posmode", "velmode", "orimode",
)  # fmt: skip
_AT: Final = {name: i for i, name in enumerate(COLUMNS)}

LINE_BYTES: Final = 4096

IMU: Final = {
    "accel_x_mps2": "ax", "accel_y_mps2": "ay", "accel_z_mps2": "az",
    "gyro_x_radps": "wx", "gyro_y_radps": "wy", "gyro_z_radps": "wz",
}  # fmt: skip
GNSS: Final = {
    "latitude_deg": "lat",
    "longitude_deg": "lon",
    "altitude_m": "alt",
    "position_sd_m": "pos_accuracy",
    "satellites": "numsats",
    "position_mode": "posmode",
}
INS_SPEED: Final = {
    "speed_mps": "vf",
    "speed_left_mps": "vl",
    "speed_up_mps": "vu",
    "speed_sd_mps": "vel_accuracy",
}


@dataclass(frozen=True, slots=True, eq=False)
class Packets:
    """N packets.

    Attributes:
        t_ns: Times, shape (N,), int64.
        numbers: Values in the order of ``COLUMNS``, shape (N, 30).
    """

    t_ns: Int64s
    numbers: Floats

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, name: str) -> Floats:
        """Return a column of ``COLUMNS``, shape (N,)."""
        column: Floats = self.numbers[:, _AT[name]]
        return column

    def table(self, names: dict[str, str]) -> Table:
        """Return a table of columns with new names."""
        return Table({ours: self[theirs] for ours, theirs in names.items()})

    def gnss(self) -> Table:
        """Return position, speed and course over ground (counter-clockwise from east)."""
        columns = dict(self.table(GNSS).columns)
        columns["speed_mps"] = np.hypot(self["ve"], self["vn"])
        columns["course_rad"] = np.arctan2(self["vn"], self["ve"])
        return Table(columns)

    def attitude_wxyz(self) -> Floats:
        """Return unit quaternions that rotate the box's axes to east, north, up; shape (N, 4).

        The order is yaw about z, pitch about y, roll about x.
        """
        half = np.stack([self["roll"], self["pitch"], self["yaw"]]) / 2.0
        (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
        return np.stack(
            [
                cr * cp * cy + sr * sp * sy,
                sr * cp * cy - cr * sp * sy,
                cr * sp * cy + sr * cp * sy,
                cr * cp * sy - sr * sp * cy,
            ],
            axis=1,
        )


def parse_oxts(line: str | bytes) -> tuple[float, ...] | str:
    """Parse the thirty numbers of a line, or return the reason why it is not a packet."""
    parts: Sequence[str | bytes] = line[:LINE_BYTES].split()
    if len(parts) != len(COLUMNS):
        return f"{len(parts)} numbers; expected {len(COLUMNS)}"
    try:
        numbers = tuple(float(part) for part in parts)
    except ValueError:
        return "not all values are numbers"
    if not np.isfinite(numbers).all():
        return "a number is not finite"
    if abs(numbers[0]) > 90.0 or abs(numbers[1]) > 360.0:
        return f"latitude {numbers[0]:g}, longitude {numbers[1]:g}: out of range"
    return numbers
