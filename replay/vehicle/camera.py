"""Camera section of the vehicle file: mounting, and intrinsics for one image size."""

import math
from typing import Annotated, Final

from pydantic import Field

from crosscue.replay.errors import VehicleError

from .section import Finite, NotNegative, Positive, Section

# Maximum distance of the optical center from the image's middle, as a fraction of its size.
MAX_CENTER_OFF: Final = 0.15
# Plausible horizontal fields of view, from a telephoto to a wide-angle lens.
VIEW_DEG: Final = (15.0, 150.0)
# Maximum relative difference of the aspect ratios of scaled images.
MAX_ASPECT_OFF: Final = 0.01
Pixels = Annotated[int, Field(gt=0, le=65535)]


class Camera(Section):
    """Pinhole camera model and mounting."""

    x_m: Finite = 0.0
    """Distance ahead of the rear axle."""
    y_m: Finite = 0.0
    z_m: Finite = 1.2
    focal_px: Positive | None = None
    center_px: tuple[Finite, Finite] | None = None
    size_px: tuple[Pixels, Pixels] | None = None
    """Width and height of the images that ``focal_px`` and ``center_px`` are for; images of
    another size are refused."""
    roll_rad: Finite = 0.0
    """Rotation about the optical axis, positive with the right side down."""
    pitch_rad: Finite = 0.0
    """Angle of the optical axis below the horizon."""
    yaw_rad: Finite = 0.0
    """Angle of the optical axis to the left; ``crosscue fit odometry`` estimates it where the truth
    is the camera's track."""
    pitch_sd_rad: NotNegative = 0.01
    """Standard deviation of the pitch in a frame: a vehicle pitches by about half a degree when it
    brakes."""
    delay_s: Annotated[Finite, Field(ge=-5.0, le=5.0)] = 0.0
    """Delay of the pictures' time stamps relative to those of the vehicle's signals; it is
    subtracted. ``vehicle init`` estimates it."""
    depth_bits: Annotated[int, Field(ge=8, le=16)] = 16
    """Number of bits used in 16-bit images; 12 for many cameras."""

    def check_size(self, size_px: tuple[int, int]) -> None:
        """Refuse intrinsics that belong to another image size.

        Raises:
            VehicleError: ``mismatch`` returns a reason.
        """
        found = self.mismatch(size_px)
        if found is not None:
            raise VehicleError(found)

    def mismatch(self, size_px: tuple[int, int]) -> str | None:
        """Return why the intrinsics do not fit images of this size, or None if they fit.

        The stated ``size_px`` decides. Without it, the optical center must lie near the image's
        middle, and the field of view must be plausible.
        """
        wide, high = size_px
        if self.size_px == size_px:
            return None
        if self.size_px is not None:
            return (
                f"camera.size_px = [{self.size_px[0]}, {self.size_px[1]}]: the images are "
                f"{wide} x {high} pixels; {self._scaled(self.size_px, size_px)}"
            )
        advice = (
            f"so it is that of another size; state focal_px and center_px for {wide} x {high}, or "
            f"size_px = [{wide}, {high}] under [camera] if they are right"
        )
        if self.center_px is not None:
            off = max(abs(c - s / 2) / s for c, s in zip(self.center_px, size_px, strict=True))
            if off > MAX_CENTER_OFF:
                return (
                    f"camera.center_px = ({self.center_px[0]:g}, {self.center_px[1]:g}): "
                    f"{'outside' if off > 0.5 else 'far from the middle of'} the images of "
                    f"{wide} x {high} pixels, {advice}"
                )
        if self.focal_px is not None:
            view_deg = 2.0 * math.degrees(math.atan(0.5 * wide / self.focal_px))
            if not VIEW_DEG[0] <= view_deg <= VIEW_DEG[1]:
                return (
                    f"camera.focal_px = {self.focal_px:g}: images of {wide} x {high} pixels would "
                    f"show {view_deg:.0f} deg, {advice}"
                )
        return None

    def _scaled(self, stated: tuple[int, int], found: tuple[int, int]) -> str:
        """Return advice with the intrinsics scaled to another image size."""
        scale, other = found[0] / stated[0], found[1] / stated[1]
        if abs(scale / other - 1.0) > MAX_ASPECT_OFF:
            return "state focal_px, center_px and size_px for those, which are cropped or stretched"
        values = [f"size_px = [{found[0]}, {found[1]}]"]
        if self.center_px is not None:
            x, y = (scale * c for c in self.center_px)
            values.insert(0, f"center_px = [{x:.6g}, {y:.6g}]")
        if self.focal_px is not None:
            values.insert(0, f"focal_px = {scale * self.focal_px:.6g}")
        return f"if they are scaled, state {', '.join(values)}"
