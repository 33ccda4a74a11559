"""Estimation of a camera's pitch and yaw from its direction of motion on a straight road."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from crosscue.detectors.base import View
from crosscue.detectors.images import decode, encoded, lose
from crosscue.detectors.ranging.travel_direction import Travel, travel_between
from crosscue.replay.base import EVERYTHING, Log, name_of
from crosscue.replay.columns import Bytes, Floats, Images
from crosscue.replay.errors import LogError
from crosscue.replay.ledger import Ledger, warn_of
from crosscue.replay.signals.extractor import pictures_of
from crosscue.replay.vehicle.drafting.camera import Intrinsics, MountingParameter
from crosscue.replay.vehicle.drafting.series import Series
from crosscue.replay.vehicle.vehicle import Camera, Vehicle

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
