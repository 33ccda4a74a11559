"""One pass over the pictures of a drive: what each shows, and the motion from one to the next.

Everything that is learnt from pictures alone is computed from this pass: whether they are sound,
the delay of their time stamps, and the focal length, height and direction of the camera.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from crosscue.detectors.base import View
from crosscue.detectors.images import decode, encoded, lose
from crosscue.localization.camera_delay import PictureMotion
from crosscue.localization.visual_odometry import (
    Travel,
    VisualOdometry,
    VisualStep,
    travel_between,
)
from crosscue.replay.base import EVERYTHING, Log, Selection, name_of
from crosscue.replay.columns import Bytes, Floats, Images, Int64s
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.vehicle.camera import Camera
from crosscue.replay.vehicle.vehicle import Vehicle

WIDTH_PX: Final = 960
# Pictures in which motion is followed: those of the first minute, at most ten a second.
FOLLOWED_NS: Final = 60_000_000_000
APART_NS: Final = 90_000_000
# Growth of the scene between two pictures that show the direction of travel.
GROWTH: Final = 0.025
# Max rotation between them on a straight road.
STRAIGHT_RAD: Final = np.radians(0.3)
# Focal length that is assumed where none is known, in widths of the picture.
ASSUMED_FOCAL: Final = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class PicturePass:
    """What N pictures show.

    Attributes:
        t_ns: Their times, on the clock that a run uses.
        mean: Mean brightness, 0 to 255.
        contrast: Standard deviation of the brightness.
        digest: Checksum of the pixels.
        size_px: Size of the first picture; None without one.
        camera: Camera that the motion assumes, for reduced pictures of ``scale`` times the size.
        scale: Size of the reduced pictures, as a fraction.
        steps: Motion from picture to picture.
        expansion: Growth of the scene in each step.
        travel_ns: Times of the directions of travel.
        travel: Directions of travel on straight road.
        bends: Number of directions that were not used, in bends.
    """

    t_ns: Int64s
    mean: Floats
    contrast: Floats
    digest: Int64s
    size_px: tuple[int, int] | None
    camera: Camera
    scale: float
    steps: tuple[VisualStep, ...]
    expansion: Floats
    travel_ns: Int64s
    travel: tuple[Travel, ...]
    bends: int = 0

    @property
    def motion(self) -> PictureMotion:
        """The motion from picture to picture, as columns."""
        return PictureMotion(
            np.array([one.start_ns for one in self.steps], np.int64),
            np.array([one.t_ns for one in self.steps], np.int64),
            np.array([one.turn_rad for one in self.steps], np.float64),
            self.expansion,
            np.array([one.is_standing for one in self.steps], np.bool_),
        )


def watch_pictures(
    log: Log,
    number: int,
    camera: str,
    vehicle: Vehicle,
    known: Camera,
    selection: Selection = EVERYTHING,
) -> PicturePass:
    """Look at every picture of a camera, and follow the motion of the first minute.

    Args:
        log: The open log.
        number: Index of the log in the drive.
        camera: Topic of the camera.
        vehicle: The vehicle file.
        known: What is known of the camera; without ``focal_px``, a usual one is assumed.
        selection: Part of the log to read; its topics are ignored.
    """
    ledger = Ledger(name_of(log))
    rows: list[tuple[int, float, float, int]] = []
    steps: list[VisualStep] = []
    growth: list[float] = []
    follower: Follower | None = None
    size = None
    for t_ns, grey, size_px in _grey(log, number, camera, vehicle, ledger, selection):
        mean, contrast = float(grey.mean()), float(grey.std())
        rows.append((t_ns, mean, contrast, zlib.crc32(grey.tobytes())))
        size = size or size_px
        if follower is None:
            follower = Follower(known, size_px, grey)
        if t_ns - rows[0][0] <= FOLLOWED_NS and (step := follower.follow(t_ns, grey)) is not None:
            steps.append(step)
            growth.append(follower.odometry.expansion)
    warn_of(ledger)
    return PicturePass(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.float64),
        np.array([row[2] for row in rows], np.float64),
        np.array([row[3] for row in rows], np.int64),
        size,
        known if follower is None else follower.camera,
        1.0 if follower is None else follower.scale,
        tuple(steps),
        np.array(growth, np.float64),
        np.array([] if follower is None else follower.travel_ns, np.int64),
        () if follower is None else tuple(follower.travel),
        0 if follower is None else follower.bends,
    )


class Follower:
    """Motion from picture to picture, and over longer pairs the direction of travel."""

    def __init__(self, known: Camera, size_px: tuple[int, int], grey: Bytes) -> None:
        self.scale = grey.shape[1] / size_px[0]
        focal_px = known.focal_px or ASSUMED_FOCAL * size_px[0]
        center_px = known.center_px or (0.5 * size_px[0], 0.5 * size_px[1])
        self.camera = known.model_copy(
            update={
                "focal_px": focal_px * self.scale,
                "center_px": (center_px[0] * self.scale, center_px[1] * self.scale),
                "size_px": None,
            }
        )
        self.odometry = VisualOdometry(self.camera)
        self.travel_ns: list[int] = []
        self.travel: list[Travel] = []
        self.bends = 0
        self._last_ns: int | None = None
        self._reference: tuple[int, Bytes, float] | None = None

    def follow(self, t_ns: int, grey: Bytes) -> VisualStep | None:
        """Return the motion since the last picture that was followed."""
        if self._last_ns is not None and 0 <= t_ns - self._last_ns < APART_NS:
            return None
        self._last_ns = t_ns
        step = self.odometry(t_ns, grey, np.empty((0, 4)))
        growth = self.odometry.expansion
        if step is None or not np.isfinite(growth) or self._reference is None:
            self._reference = t_ns, grey, 0.0
            return step
        start_ns, reference, grown = self._reference
        self._reference = start_ns, reference, grown + growth
        if grown + growth >= GROWTH and reference.shape == grey.shape:
            self._reference = t_ns, grey, 0.0
            self._add_travel(start_ns, t_ns, reference, grey)
        return step

    def _add_travel(self, start_ns: int, t_ns: int, before: Bytes, after: Bytes) -> None:
        focal_px, center_px = self.camera.focal_px, self.camera.center_px
        assert focal_px is not None
        assert center_px is not None
        travel = travel_between(before, after, focal_px, center_px)
        if travel is not None and abs(travel.turned_rad) > STRAIGHT_RAD:
            self.bends += 1
        elif travel is not None:
            self.travel_ns.append(t_ns)
            self.travel.append(travel._replace(seconds=(t_ns - start_ns) * 1e-9))


def _grey(
    log: Log, number: int, camera: str, vehicle: Vehicle, ledger: Ledger, selection: Selection
) -> Iterator[tuple[int, Bytes, tuple[int, int]]]:
    """Yield undamaged pictures in order of time, small and grey, with their full size."""
    topic = next(topic for topic in log.topics if topic.name == camera)
    view = View(is_grey=True, min_width_px=WIDTH_PX)
    for block, rows in pictures_of(log, number, topic, vehicle, ledger, selection):
        assert isinstance(rows, Images)
        for row, t_ns in enumerate(block.log_ns.tolist()):
            try:
                pixels, size_px = decode(encoded(rows, row), view, vehicle.camera.depth_bits)
            except LogError as error:
                lose(ledger, block.topic, t_ns, error)
                continue
            yield t_ns, reduced(pixels), size_px


def reduced(pixels: Bytes) -> Bytes:
    """Return a picture that is at most ``WIDTH_PX`` wide."""
    if pixels.shape[1] <= WIDTH_PX:
        return pixels
    height = round(pixels.shape[0] * WIDTH_PX / pixels.shape[1])
    small = cv2.resize(pixels, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)
