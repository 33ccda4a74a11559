"""Parse two text files of KITTI: OXTS packets of its GNSS/INS box, and labels of the tracking set.

A line of a packet has thirty numbers; columns and axes are those of the published
``dataformat.txt``. The box's axes are x forward, y left and z up, as in REP-103. Yaw is 0 when
heading east and increases counter-clockwise.

A label (``label_02/SEQ.txt``) has frame, track, class, truncation, occlusion, observation angle,
the box in pixels of the left colour camera, the cuboid's height, width
and length, its position right, down and ahead of the camera, and its rotation. Lines of class
DontCare mark unlabelled parts of a picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from crosscue.datasets.truth.coco import Objects
from crosscue.replay.columns import ColumnSet, Floats, Int64s, Table
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.image_header import size_in_header

from .published import lines_of

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
class Packets(ColumnSet):
    """N packets.

    Attributes:
        t_ns: Times, shape (N,), int64.
        numbers: Values in the order of ``COLUMNS``, shape (N, 30).
    """

    t_ns: Int64s
    numbers: Floats

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


HEADER_BYTES: Final = 4096
# COCO's names by class of the data set; a cyclist's box contains person and bicycle.
LABELS: Final = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Tram": "train",
    "Pedestrian": "person",
    "Person": "person",
    "Person_sitting": "person",
    "Cyclist": "cyclist",
}
# Classes that are neither missed nor false in unlabelled regions.
UNLABELLED: Final = ("car", "person")
# Visible fraction by the data set's level of occlusion: none, partly, largely.
VISIBLE: Final = {0: 1.0, 1: 0.7, 2: 0.3}


class SequenceLabels(NamedTuple):
    """Objects of a sequence, and the number of damaged lines."""

    objects: Objects
    lost: int


def read_kitti_labels(file: Path, pictures: Path, period_ns: int) -> SequenceLabels:
    """Read the labels of a sequence, frame by frame.

    Args:
        file: File of the labels.
        pictures: Folder of the sequence's pictures, for their size.
        period_ns: Time from one frame to the next; frame 0 is at 0.

    Raises:
        LogFormatError: The file cannot be read, or no picture is available for the size.
    """
    size_px = _size_px(pictures)
    by_frame: dict[int, list[tuple[str, int, list[float]]]] = {}
    lost = 0
    for line in lines_of(file):
        parts = line.split()
        try:
            frame, track, numbers = (
                int(parts[0]),
                int(parts[1]),
                [float(one) for one in parts[3:17]],
            )
        except (ValueError, IndexError):
            lost += 1
            continue
        if len(numbers) != 14 or frame < 0 or not np.isfinite(numbers).all():
            lost += 1
            continue
        by_frame.setdefault(frame, []).append((parts[2], track, numbers))
    objects = Objects()
    for frame in sorted(by_frame):
        objects.add_image(f"{frame:06d}.png", size_px, t_ns=frame * period_ns)
        for name, track, numbers in by_frame[frame]:
            x0, y0, x1, y1 = numbers[3:7]
            if name == "DontCare":
                for label in UNLABELLED:
                    objects.add(label, (x0, y0, x1, y1), iscrowd=1)
                continue
            objects.add(
                LABELS.get(name, name.lower()),
                (x0, y0, x1, y1),
                track_id=track,
                visible=VISIBLE.get(int(numbers[1])),
                x_m=round(numbers[12], 3),
                y_m=round(-numbers[10], 3),
            )
    return SequenceLabels(objects, lost)


def _size_px(pictures: Path) -> tuple[int, int]:
    for picture in sorted(pictures.glob("*.png")):
        with picture.open("rb") as file:
            size = size_in_header(file.read(HEADER_BYTES), "png")
        if size is not None:
            return size
    raise LogFormatError(f"{pictures}: no picture; expected one for the size of the labels' frames")
