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


def motion_of(seen: Sequence[Observation], aside_mps: float = USUAL_MPS) -> CarMotion:
    """Fit a constant velocity to one or more observations of a car.

    Args:
        seen: Observations, oldest first.
        aside_mps: Prior standard deviation of its sideways speed. It is small for a car on the ego
            vehicle's road. The change of bearing then determines the speed along the road far
            sooner than the change of size.
    """
    newest = seen[-1]
    ends = [_fit(seen, side, aside_mps) for side in (0, 1)]
    (left, left_sd, *_), (right, right_sd, *_) = ends
    agree = left * right > 0.0
    right_mps = math.copysign(min(abs(left), abs(right)), left) if agree else 0.0
    ahead_mps, ahead_sd = (0.5 * (ends[0][k] + ends[1][k]) for k in (2, 3))
    passed_s = newest.t_s - seen[0].t_s
    way_m = math.dist(newest.pose[:2], seen[0].pose[:2])
    scale_sd = HEIGHT_FRACTION * way_m / passed_s if passed_s > 0.0 else USUAL_MPS
    noses = [one.nose for one in seen if one.nose]
    return CarMotion(
        number=0,
        frames=len(seen),
        distance_m=newest.distance_m,
        bearing=0.5 * sum(map(math.tan, newest.edges_rad)),
        right_mps=right_mps,
        right_sd_mps=max(left_sd, right_sd),
        ahead_mps=ahead_mps,
        ahead_sd_mps=math.hypot(ahead_sd, scale_sd),
        is_steady=max(ends[0][4], ends[1][4]) <= MAX_MISFIT,
        long=float(np.median([one.long for one in seen])),
        nose=sum(noses) / len(noses) if noses else 0.0,
        is_hidden=newest.is_hidden,
    )


def _fit(
    seen: Sequence[Observation], side: int, aside_mps: float
) -> tuple[float, float, float, float, float]:
    """Fit one end of a car: speed to the right with s.d., speed ahead with s.d., and misfit."""
    newest = seen[-1]
    places = np.array([place_of_end(one, side, newest) for one in seen])
    weights = _weights(seen, side, newest)
    late_s = np.array([one.t_s - newest.t_s for one in seen])
    models = np.concatenate(
        [np.tile(np.eye(2), (len(seen), 1, 1)), late_s[:, None, None] * np.eye(2)], axis=2
    )
    weighted = np.swapaxes(models, 1, 2) @ weights
    prior = np.diag([0.0, 0.0, USUAL_MPS**-2, aside_mps**-2])
    covariance = np.linalg.inv(prior + (weighted @ models).sum(axis=0))
    state = covariance @ np.einsum("nij,nj->i", weighted, places)
    off = places - models @ state
    misfit = float(np.einsum("ni,nij,nj->", off, weights, off)) / max(2 * len(seen) - 4, 1)
    sd = np.sqrt(np.diagonal(covariance))
    return float(state[3]), float(sd[3]), float(state[2]), float(sd[2]), misfit


def place_of_end(one: Observation, side: int, newest: Observation) -> tuple[float, float]:
    """Position of one end of the car, ahead and to the right of the newest camera pose."""
    x, y, heading = one.pose
    sight = heading - one.edges_rad[side]
    far_m = one.distance_m / math.cos(one.edges_rad[side])
    east = x - newest.pose[0] + far_m * math.cos(sight)
    north = y - newest.pose[1] + far_m * math.sin(sight)
    cos, sin = math.cos(newest.pose[2]), math.sin(newest.pose[2])
    return east * cos + north * sin, east * sin - north * cos


def _weights(seen: Sequence[Observation], side: int, newest: Observation) -> NDArray[np.float64]:
    """Inverse covariances of ``place_of_end``, shape (N, 2, 2): large along the line of sight."""
    rows = [
        (newest.pose[2] - one.pose[2] + one.edges_rad[side], one.error, one.distance_m)
        for one in seen
    ]
    angle, error, distance_m = np.array(rows).T
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    along_sd = error * distance_m / np.cos([one.edges_rad[side] for one in seen])
    across_sd = error * CAR_HEIGHT_M
    return np.asarray(
        along[:, :, None] * along[:, None, :] / along_sd[:, None, None] ** 2
        + across[:, :, None] * across[:, None, :] / across_sd[:, None, None] ** 2
    )
