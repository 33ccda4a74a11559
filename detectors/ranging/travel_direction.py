"""Estimate a camera's direction of travel from two pictures, by the essential matrix.

While a car drives straight, its camera moves towards the road's vanishing point. The direction of
travel therefore shows how far the camera's axis points to the side of it and below it. See Hartley
and Zisserman, *Multiple View Geometry*, 2nd ed., section 9.6. Points are tracked by the method of
Lucas and Kanade, forwards and backwards.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

POINTS: Final = 600
MIN_POINTS: Final = 60
# Minimum optical flow; below it, noise dominates.
MIN_FLOW_PX: Final = 2.0
THERE_AND_BACK_PX: Final = 0.5
OFF_LINE_PX: Final = 0.7
# Minimum fraction of inliers: static points must outnumber moving ones.
INLIERS: Final = 0.5


class Travel(NamedTuple):
    """Motion of a camera between two pictures.

    Attributes:
        left_rad: Angle of its axis to the left of the direction of travel.
        below_rad: Angle of its axis below the direction of travel.
        turned_rad: Rotation between the pictures, to the left.
        points: Number of inliers.
    """

    left_rad: float
    below_rad: float
    turned_rad: float
    points: int


def travel_between(
    before: NDArray[np.uint8],
    after: NDArray[np.uint8],
    focal_px: float,
    center_px: tuple[float, float],
) -> Travel | None:
    """Estimate the direction of travel, in the axes half-way between both pictures.

    Args:
        before: Grey picture, shape (H, W), uint8.
        after: The next one, of the same size.
        focal_px: Focal length in pixels of these pictures.
        center_px: Optical center in them.

    Returns:
        The motion, or None if too few points can be tracked or they do not agree.
    """
    found = cv2.goodFeaturesToTrack(before, POINTS, 0.01, 8)
    if found is None or len(found) < MIN_POINTS:
        return None
    start, end = _followed(before, after, np.asarray(found, np.float32))
    if len(start) < MIN_POINTS or np.median(np.hypot(*(end - start).T)) < MIN_FLOW_PX:
        return None
    camera = np.array([[focal_px, 0, center_px[0]], [0, focal_px, center_px[1]], [0, 0, 1.0]])
    cv2.setRNGSeed(0)
    essential, inliers = cv2.findEssentialMat(
        start, end, camera, cv2.RANSAC, 0.999, OFF_LINE_PX, 2000
    )
    if essential is None or essential.shape != (3, 3) or inliers.sum() < INLIERS * len(start):
        return None
    agree, rotation, shift, kept = cv2.recoverPose(
        essential, start, end, camera, mask=inliers.copy()
    )
    if agree < MIN_POINTS:
        return None
    is_kept = np.asarray(kept).ravel() > 0
    rays_before, rays_after = (_rays(of[is_kept], focal_px, center_px) for of in (start, end))
    turn = np.asarray(cv2.Rodrigues(rotation)[0], np.float64).ravel()
    first = np.asarray(shift, np.float64).ravel()
    return _travel(*_refined(turn, first, rays_before, rays_after, focal_px), agree)


def _rays(
    points: NDArray[np.float32], focal_px: float, center_px: tuple[float, float]
) -> NDArray[np.float64]:
    """Directions of pixels, shape (N, 3), with last component 1."""
    flat = (points.astype(np.float64) - np.array(center_px)) / focal_px
    return np.column_stack([flat, np.ones(len(flat))])


def _refined(
    turn: NDArray[np.float64],
    shift: NDArray[np.float64],
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    focal_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refine rotation and translation by a robust fit of Sampson's distances.

    The five points of a random sample alone leave an error of degrees in the translation.
    """
    from scipy.optimize import least_squares

    def off_line_px(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
        rotation = np.asarray(cv2.Rodrigues(parameters[:3])[0], np.float64)
        x, y, z = parameters[3:] / np.linalg.norm(parameters[3:])
        essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ rotation
        lines, back = before @ essential.T, after @ essential
        size = np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))
        return np.asarray(focal_px * (after * lines).sum(axis=1) / np.maximum(size, 1e-12))

    found = least_squares(
        off_line_px, np.concatenate([turn, shift]), loss="soft_l1", f_scale=OFF_LINE_PX / 2.0
    )
    return found.x[:3], found.x[3:] / np.linalg.norm(found.x[3:])


def _followed(
    before: NDArray[np.uint8], after: NDArray[np.uint8], found: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Track points to the second picture; keep those that are tracked back to their start."""
    size = (21, 21)
    there, is_there, _ = cv2.calcOpticalFlowPyrLK(before, after, found, found.copy(), winSize=size)
    back, is_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, found.copy(), winSize=size)
    off = np.hypot(*(back - found).reshape(-1, 2).T)
    good = (is_there.ravel() == 1) & (is_back.ravel() == 1) & (off < THERE_AND_BACK_PX)
    return found.reshape(-1, 2)[good], np.asarray(there, np.float32).reshape(-1, 2)[good]


def _travel(turn: NDArray[np.float64], shift: NDArray[np.float64], points: int) -> Travel:
    """Compute the motion from the rotation and translation of the first camera's axes."""
    half = np.asarray(cv2.Rodrigues(0.5 * turn)[0], np.float64)
    # In the second camera's axes the first is at +shift; half the rotation yields the middle axes.
    ahead = -half.T @ shift
    if ahead[2] < 0.0:
        ahead = -ahead
    return Travel(
        left_rad=math.atan2(ahead[0], ahead[2]),
        below_rad=math.atan2(-ahead[1], math.hypot(ahead[0], ahead[2])),
        # About the camera's y axis, which points down: points move right as the camera turns left.
        turned_rad=float(turn[1]),
        points=points,
    )
