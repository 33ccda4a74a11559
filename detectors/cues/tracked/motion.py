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
    if not cars:
        return []
    fits = zip(*(of.tolist() for of in _fit(cars, aside_mps)), strict=True)
    return [_motion(seen, *fit) for seen, fit in zip(cars, fits, strict=True)]


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


def _fit(
    cars: Sequence[Sequence[Observation]], aside_mps: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit both ends of C cars, each in the axes of the camera pose at its newest observation.

    Returns:
        Speed ahead and to the right of each end, shape (C, 2, 2), their standard deviations, and
        the misfit of each end, shape (C, 2).
    """
    counts = np.array([len(seen) for seen in cars])
    most = int(counts.max())
    # Shorter tracks are padded with their newest observation, without weight.
    values: list[float] = []
    for seen in cars:
        for one in seen:
            values += (one.t_s, *one.pose, one.distance_m, one.error, *one.edges_rad)
        values += (seen[-1].t_s, *seen[-1].pose, 1.0, 1.0, 0.0, 0.0) * (most - len(seen))
    table = np.array(values).reshape(len(cars), most, 8)
    is_real = (np.arange(most) < counts[:, None])[:, None, :]
    newest = table[np.arange(len(cars)), counts - 1, :4]
    late_s, x, y, heading = (table[:, :, :4] - newest[:, None, :]).transpose(2, 0, 1)[:, :, None, :]
    distance_m, error = table[:, None, :, 4], table[:, None, :, 5]
    edge = np.swapaxes(table[:, :, 6:], 1, 2)
    far_m, sight = distance_m / np.cos(edge), heading - edge
    cos, sin = np.cos(newest[:, 3, None, None]), np.sin(newest[:, 3, None, None])
    c, s = np.cos(sight), np.sin(sight)
    places = np.stack([x * cos + y * sin + far_m * c, x * sin - y * cos - far_m * s])
    # Inverse covariances: the errors are large along the line of sight and small across it.
    along, across = is_real / (error * far_m) ** 2, is_real / (error * CAR_HEIGHT_M) ** 2
    turned = (across - along) * c * s
    weights = np.array(
        [[along * c**2 + across * s**2, turned], [turned, along * s**2 + across * c**2]]
    )
    powers = np.broadcast_to(late_s ** np.arange(3)[:, None, None, None], (3, *far_m.shape))
    normal = np.einsum("abkin,mkin->mkiab", weights, powers)
    weighted = np.einsum("abkin,bkin->akin", weights, places)
    information = np.empty((*counts.shape, 2, 4, 4))
    pulled = [np.einsum("akin,kin->kia", weighted, one) for one in powers[:2]]
    for m in (0, 1):
        information[..., 2 * m : 2 * m + 2, :2] = normal[m]
        information[..., 2 * m : 2 * m + 2, 2:] = normal[m + 1]
    information[..., (2, 3), (2, 3)] += (USUAL_MPS**-2, aside_mps**-2)
    covariance = np.linalg.inv(information)
    state = np.einsum("kiab,kib->kia", covariance, np.concatenate(pulled, axis=2))
    predicted = state[..., :2, None] + state[..., 2:, None] * late_s[:, :, None, :]
    off = places - predicted.transpose(2, 0, 1, 3)
    squares = np.einsum("akin,abkin,bkin->ki", off, weights, off)
    sd = np.sqrt(np.diagonal(covariance, axis1=2, axis2=3))
    return state[..., 2:], sd[..., 2:], squares / np.maximum(2 * counts - 4, 1)[:, None]


def place_of_end(one: Observation, side: int, newest: Observation) -> tuple[float, float]:
    """Position of one end of the car, ahead and to the right of the newest camera pose."""
    x, y, heading = one.pose
    sight = heading - one.edges_rad[side]
    far_m = one.distance_m / math.cos(one.edges_rad[side])
    east = x - newest.pose[0] + far_m * math.cos(sight)
    north = y - newest.pose[1] + far_m * math.sin(sight)
    cos, sin = math.cos(newest.pose[2]), math.sin(newest.pose[2])
    return east * cos + north * sin, east * sin - north * cos
