"""Plausibility checks of a camera's intrinsics against the size of its images."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

from crosscue.replay.base import VehicleError

from .vehicle import Camera

MAX_CENTER_OFF: Final = 0.15
"""Maximum distance of the optical center from the image's middle, as a fraction of its size."""
VIEW_DEG: Final = (15.0, 150.0)
"""Plausible horizontal fields of view, from a telephoto to a wide-angle lens."""


def check_center(camera: Camera, size_px: tuple[int, int]) -> None:
    """Refuse an optical center outside the image.

    Raises:
        VehicleError: It is outside, so the intrinsics belong to another image size.
    """
    center = camera.center_px
    if center is not None and not all(0 <= c < s for c, s in zip(center, size_px, strict=True)):
        raise VehicleError(
            f"camera.center_px = ({center[0]:g}, {center[1]:g}): outside the images of "
            f"{size_px[0]} x {size_px[1]} pixels; state focal_px and center_px for that size"
        )


def doubts(camera: Camera, size_px: tuple[int, int]) -> Iterator[str]:
    """Yield a sentence for each implausible value of the intrinsics."""
    wide, high = size_px
    if camera.focal_px is not None:
        view_deg = 2.0 * math.degrees(math.atan(0.5 * wide / camera.focal_px))
        if not VIEW_DEG[0] <= view_deg <= VIEW_DEG[1]:
            yield (
                f"camera.focal_px = {camera.focal_px:g}: an image {wide} pixels wide would show "
                f"{view_deg:.0f} deg; the intrinsics belong to another image size"
            )
    if camera.center_px is not None:
        off = [abs(c - s / 2) / s for c, s in zip(camera.center_px, size_px, strict=True)]
        if max(off) > MAX_CENTER_OFF:
            yield (
                f"camera.center_px = ({camera.center_px[0]:g}, {camera.center_px[1]:g}): far from "
                f"the middle of an image of {wide} x {high}; the intrinsics belong to another "
                "image size"
            )
