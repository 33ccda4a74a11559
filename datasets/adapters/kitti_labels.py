"""Read KITTI tracking labels of a sequence, ``label_02/SEQ.txt``: boxes in the left colour camera.

A line has frame, track, class, truncation, occlusion, observation angle, the box's left, top, right
and bottom in pixels, the cuboid's height, width and length, its position right, down and ahead of
the camera, and its rotation. Lines of class DontCare mark unlabelled parts of a picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from crosscue.datasets.truth.objects import Objects
from crosscue.replay.errors import LogFormatError
from crosscue.replay.files.bounded import read_at_most
from crosscue.replay.files.image_header import size_in_header
from crosscue.replay.limits import MIB

MAX_FILE_BYTES: Final = 64 * MIB
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
    content = read_at_most(file, MAX_FILE_BYTES)
    if content is None:
        raise LogFormatError(f"{file}: over {MAX_FILE_BYTES // MIB} MiB; not read")
    size_px = _size_px(pictures)
    by_frame: dict[int, list[tuple[str, int, list[float]]]] = {}
    lost = 0
    for line in content.decode("utf-8", errors="replace").splitlines():
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
        objects.add_picture(frame * period_ns, f"{frame:06d}.png", size_px)
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
