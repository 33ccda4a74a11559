"""Estimate a car's motion in the road plane from its boxes, with a moving camera.

Each observation is converted to a position. The bearing is measured in the picture, the distance
follows from the height (``focal_px * CAR_HEIGHT_M / height``), and odometry provides the camera's
position and heading. This removes the camera's own motion, so a standing car has a constant
position. A constant velocity is fitted by generalised least squares, with errors along the line of
sight that are much larger than those across it. A car taller or lower than assumed only appears to
move along the camera's path, never across it.

Both ends of a car are tracked separately, and the smaller sideways speed of the two is used,
because a car that emerges from behind another grows on one side only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from struct import Struct
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Height of a typical car; it varies by 15 %, from 1.4 (sports car) to 1.8 (van).
CAR_HEIGHT_M: Final = 1.55
HEIGHT_FRACTION: Final = 0.15
# Prior standard deviation of a car's speed.
USUAL_MPS: Final = 10.0
# Prior standard deviation of sideways speed on the ego vehicle's road: 10 m/s at 2 degrees.
ALONG_ASIDE_MPS: Final = 0.3
# Sum of squared residuals per degree of freedom above which the motion is not steady.
MAX_MISFIT: Final = 4.0
_NUMBERS: Final = Struct("8d")


class Observation(NamedTuple):
    """One box of a car.

    Attributes:
        t_s: Time.
        pose: Pose of the camera: x, y, heading in the road plane.
        edges_rad: Bearings of the car's left and right end, positive to the right.
        distance_m: Distance from its height.
        error: Relative standard deviation of the distance, from the box's error only.
        long: Length over height.
        nose: -1 left, 1 right, 0 unknown.
        is_hidden: True if another car's box covers its lower end; the car may then be higher and
            nearer.
        is_sure: True if its score is high enough for a cue; otherwise it can only continue a track.
    """

    t_s: float
    pose: tuple[float, float, float]
    edges_rad: tuple[float, float]
    distance_m: float
    error: float
    long: float
    nose: int
    is_hidden: bool = False
    is_sure: bool = True


class CarMotion(NamedTuple):
    """Estimated motion of one car in the newest frame.

    Attributes:
        number: Number of its track, from 1.
        frames: Number of frames in which it was seen.
        distance_m: Distance from the camera, along its axis.
        bearing: Tangent of the bearing, positive to the right.
        right_mps: Speed across the ego vehicle's heading, positive to the right; 0 if the signs of
            its two ends differ.
        right_sd_mps: Standard deviation of ``right_mps``.
        ahead_mps: Speed along the ego vehicle's heading.
        ahead_sd_mps: Standard deviation of ``ahead_mps``.
        is_steady: True if a constant velocity fits all frames.
        long: Length over height, median.
        nose: Mean of the observed noses, -1 to 1.
        is_hidden: True if another car covers its lower end in this frame.
        box_px: x0, y0, x1, y1.
        step_px: Displacement of its centre since the previous observation.
    """

    number: int
    frames: int
    distance_m: float
    bearing: float
    right_mps: float
    right_sd_mps: float
    ahead_mps: float
    ahead_sd_mps: float
    is_steady: bool
    long: float
    nose: float
    is_hidden: bool = False
    box_px: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    step_px: tuple[float, float] = (0.0, 0.0)

    @property
    def center_px(self) -> tuple[float, float]:
        """Centre of its box."""
        x0, y0, x1, y1 = self.box_px
        return 0.5 * (x0 + x1), 0.5 * (y0 + y1)


def motions_of(
    cars: Sequence[Sequence[Observation]], aside_mps: float = USUAL_MPS
) -> list[CarMotion]:
    """Fit a constant velocity to one or more observations of each car, for all cars at once.

    Args:
        cars: Observations of each car, oldest first.
        aside_mps: Prior standard deviation of their sideways speed. It is small for cars on the ego
            vehicle's road. The change of bearing then determines the speed along the road far
            sooner than the change of size.
    """
    numbers = [b"".join(map(numbers_of, seen)) for seen in cars]
    return Windows(cars, numbers).motions(
        [(i, len(seen)) for i, seen in enumerate(cars)], aside_mps
    )


def numbers_of(one: Observation) -> bytes:
    """Return what the fit uses of an observation, as bytes, which join fast to an array."""
    return _NUMBERS.pack(one.t_s, *one.pose, one.distance_m, one.error, *one.edges_rad)


class Windows:
    """Observations of C cars, prepared once for several fits of their motion.

    Args:
        cars: Observations of each car, oldest first.
        numbers: The same by ``numbers_of``, joined for each car.
    """

    def __init__(
        self, cars: Sequence[Sequence[Observation]], numbers: Sequence[bytes | bytearray]
    ) -> None:
        self._cars = cars
        self._rows = _rows(cars, numbers) if cars else np.empty(0)

    def motions(
        self, windows: Sequence[tuple[int, int]], aside_mps: float = USUAL_MPS
    ) -> list[CarMotion]:
        """Fit as ``motions_of``, each time a car by its index to a number of newest observations.

        All observations are used where there are fewer.
        """
        if not windows:
            return []
        seen = [self._cars[i][-frames:] for i, frames in windows]
        rows = self._rows[[i for i, _ in windows]]
        fits = zip(*(of.tolist() for of in _fit(rows, [*map(len, seen)], aside_mps)), strict=True)
        return [_motion(one, *fit) for one, fit in zip(seen, fits, strict=True)]


def _motion(
    seen: Sequence[Observation],
    speed_mps: Sequence[Sequence[float]],
    sd_mps: Sequence[Sequence[float]],
    misfit: Sequence[float],
) -> CarMotion:
    """Combine the fits of a car's two ends."""
    newest = seen[-1]
    (ahead, left), (ahead_too, right) = speed_mps
    passed_s = newest.t_s - seen[0].t_s
    way_m = math.dist(newest.pose[:2], seen[0].pose[:2])
    scale_sd = HEIGHT_FRACTION * way_m / passed_s if passed_s > 0.0 else USUAL_MPS
    noses = [one.nose for one in seen if one.nose]
    return CarMotion(
        number=0,
        frames=len(seen),
        distance_m=newest.distance_m,
        bearing=0.5 * sum(map(math.tan, newest.edges_rad)),
        right_mps=math.copysign(min(abs(left), abs(right)), left) if left * right > 0.0 else 0.0,
        right_sd_mps=max(sd_mps[0][1], sd_mps[1][1]),
        ahead_mps=0.5 * (ahead + ahead_too),
        ahead_sd_mps=math.hypot(0.5 * (sd_mps[0][0] + sd_mps[1][0]), scale_sd),
        is_steady=max(misfit) <= MAX_MISFIT,
        long=median([one.long for one in seen]),
        nose=sum(noses) / len(noses) if noses else 0.0,
        is_hidden=newest.is_hidden,
    )


def _rows(
    cars: Sequence[Sequence[Observation]], numbers: Sequence[bytes | bytearray]
) -> NDArray[np.float64]:
    """Equations of both ends of C cars, in the axes of the camera pose at the newest observation.

    Returns:
        Shape (C, 2, N, 2, 5), newest last: for each observation, an equation along its line of
        sight, whose error is large, and one across it, in standard deviations. Its numbers are the
        factors of the place ahead and to the right and of the speed in both directions, and the
        right side. Shorter tracks are padded at the front with their oldest observation.
    """
    most = max(map(len, cars))
    parts: list[bytes | bytearray] = []
    for seen, mine in zip(cars, numbers, strict=True):
        parts += (mine[: _NUMBERS.size] * (most - len(seen)), mine)
    table = np.frombuffer(b"".join(parts)).reshape(len(cars), most, 8)
    newest = table[:, -1:, :4]
    late_s, x, y, heading = (table[:, :, :4] - newest).transpose(2, 0, 1)[:, :, None, :]
    distance_m, error = table[:, None, :, 4], table[:, None, :, 5]
    edge = np.swapaxes(table[:, :, 6:], 1, 2)
    far_m, sight = distance_m / np.cos(edge), heading - edge
    cos, sin = np.cos(newest[:, :, None, 3]), np.sin(newest[:, :, None, 3])
    ahead_m, right_m = x * cos + y * sin, x * sin - y * cos
    c, s = np.cos(sight), np.sin(sight)
    rows = np.empty((*far_m.shape, 2, 5))
    along, across = rows[..., 0, :], rows[..., 1, :]
    along[..., 0], along[..., 1], along[..., 4] = c, -s, ahead_m * c - right_m * s + far_m
    across[..., 0], across[..., 1], across[..., 4] = s, c, ahead_m * s + right_m * c
    rows[..., 2:4] = rows[..., :2] * late_s[..., None, None]
    along /= (error * far_m)[..., None]
    across /= (error * CAR_HEIGHT_M)[..., None]
    return rows


def _fit(
    rows: NDArray[np.float64], frames: Sequence[int], aside_mps: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit both ends of C cars to a number of newest observations of each.

    Returns:
        Speed ahead and to the right of each end, shape (C, 2, 2), their standard deviations, and
        the misfit of each end, shape (C, 2).
    """
    most, counts = max(frames), np.array(frames)
    is_used = np.arange(most) >= (most - counts)[:, None]
    used = (rows[:, :, -most:] * is_used[:, None, :, None, None]).reshape(len(frames), 2, -1, 5)
    sums = used.swapaxes(2, 3) @ used
    sums[..., 2, 2] += USUAL_MPS**-2
    sums[..., 3, 3] += aside_mps**-2
    covariance = np.linalg.inv(sums[..., :4, :4])
    state = covariance @ sums[..., :4, 4:]
    off = used[..., :4] @ state - used[..., 4:]
    squares = np.add.reduce(off * off, axis=(2, 3))
    sd = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3)[..., 2:])
    return state[..., 2:, 0], sd, squares / np.maximum(2 * counts - 4, 1)[:, None]


def place_of_end(one: Observation, side: int, newest: Observation) -> tuple[float, float]:
    """Position of one end of the car, ahead and to the right of the newest camera pose."""
    x, y, heading = one.pose
    sight = heading - one.edges_rad[side]
    far_m = one.distance_m / math.cos(one.edges_rad[side])
    east = x - newest.pose[0] + far_m * math.cos(sight)
    north = y - newest.pose[1] + far_m * math.sin(sight)
    cos, sin = math.cos(newest.pose[2]), math.sin(newest.pose[2])
    return east * cos + north * sin, east * sin - north * cos
