"""Vehicle file of the simulated car.

Curves, regions and thresholds were chosen on layouts L only, without layouts A to H.
"""

from __future__ import annotations

from typing import Final

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.simulated.drive import CAN, HEAD, MOTION

from .mobileye import MOUNTING

# Parameters of the range: focal length times the first over the height in pixels, plus the second.
# They were fitted to detections of the embedded network, to which they are applied, not to true
# outlines: ``crosscue fit ranges --runs --min-score 0.9 --family pinhole-offset`` on L201, L203,
# L204 and L209, 187 pairs, residual 1.56 m.
STOP_SIGN_M: Final = (0.71690, 2.79455)
# Parameters fitted likewise on L206, L207, L210 and L213: 1162 pairs, residual 3.44 m.
TRAFFIC_LIGHT_M: Final = (1.00036, 4.00404)


def scene_vehicle_text(
    camera: SceneCamera, *, mounting_yaw_rad: float, declination_rad: float, heading_rad: float
) -> str:
    """Return the file's text for a camera and compass, with the heading at the start."""
    stop, light = STOP_SIGN_M, TRAFFIC_LIGHT_M
    return VEHICLE.format(
        bus="/can/car",
        dbc="simulated_car.dbc",
        mounting_yaw_rad=mounting_yaw_rad,
        declination_rad=declination_rad,
        heading_rad=round(heading_rad, 6),
        mobileye_x_m=MOUNTING.x_m,
        camera_x_m=camera.x_m,
        camera_z_m=camera.z_m,
        pitch_rad=camera.pitch_rad,
        focal_px=camera.focal,
        center_px=list(camera.centre_px),
        stop_sign=[round(stop[0] * camera.focal, 3), stop[1]],
        traffic_light=[round(light[0] * camera.focal, 3), light[1]],
    )


VEHICLE: Final = f"""\
# A car of crosscue's simulated intersections.
{HEAD}
[topics]
camera = "/camera/image/compressed"
{CAN}
[mobileye]
bus = "/can/mobileye"
revision = "classic"
x_m = {{mobileye_x_m}}
{MOTION}
[camera]
x_m = {{camera_x_m}}
z_m = {{camera_z_m}}
pitch_rad = {{pitch_rad}}
focal_px = {{focal_px}}
center_px = {{center_px}}

# Chosen on layouts L700 to L731 so that none of their roads is missed near by and no other is seen.
[regions]
left = [[0.18, 0.52], [0.38, 0.52], [0.3, 0.555], [0.18, 0.555]]
straight = [[0.45, 0.495], [0.53, 0.495], [0.53, 0.518], [0.45, 0.518]]
right = [[0.55, 0.52], [0.74, 0.52], [0.74, 0.56], [0.58, 0.56]]

[ranges.stop_sign]
family = "pinhole-offset"
parameters = {{stop_sign}}
residual_sd_m = 1.56

[ranges.traffic_light]
family = "pinhole-offset"
parameters = {{traffic_light}}
residual_sd_m = 3.44
"""
