"""Settings of a simulated run, the world that they define, and the car's vehicle file.

Curves, regions and thresholds of the file were chosen on layouts L only, without layouts A to H.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.rendering.render import DEFAULTS, PictureSettings
from crosscue.datasets.simulated.drive import CAN, HEAD, MOTION
from crosscue.replay.errors import UsageError

from .layout import Layout, Side, layout_named
from .mobileye import MOUNTING
from .motion import Conditions, conditions_of
from .world import World, build_world

CAMERA: Final = SceneCamera()


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """Settings of one simulated run.

    Attributes:
        layout: Name of the layout: ``A`` to ``H``, or ``L`` or ``M`` with a seed.
        run: Number of the run, from 1; ten are fixed, further ones are drawn from the seed.
        seed: Seed of all random numbers of the run, except those of layout and buildings.
        rate_hz: Pictures per second.
        camera: Size, lens and mounting of the camera.
        picture: Settings of the rendering.
        traffic: Side of the road on which traffic drives.
    """

    layout: str = "A"
    run: int = 1
    seed: int = 0
    rate_hz: int = 10
    camera: SceneCamera = CAMERA
    picture: PictureSettings = DEFAULTS
    traffic: Side = "right"

    def __post_init__(self) -> None:
        """Check the settings.

        Raises:
            ValueError: A setting is out of range; the message states the valid values.
        """
        layout_named(self.layout)
        if self.run < 1 or self.seed < 0:
            raise ValueError(f"run {self.run}, seed {self.seed}: expected 1 or more, 0 or more")
        if self.rate_hz not in (10, 20, 25, 50):
            raise ValueError(f"rate_hz: expected 10, 20, 25 or 50, got {self.rate_hz}")

    @property
    def name(self) -> str:
        """Name of its folder."""
        return f"{self.layout}-{self.run:02d}" + ("-left" if self.traffic == "left" else "")


def camera_of_width(width_px: int) -> SceneCamera:
    """Return the camera of simulated drives for another width; the aspect ratio is 16 to 9.

    Raises:
        UsageError: The width is not supported.
    """
    if not 64 <= width_px <= 3840 or width_px % 16:
        raise UsageError(f"width_px: {width_px}, expected a multiple of 16 from 64 to 3840")
    return SceneCamera(width_px=width_px, height_px=width_px * 9 // 16)


def scenes_of(
    layouts: Sequence[str], runs: int, seed: int, width_px: int
) -> tuple[SceneSettings, ...]:
    """Return the drives of a study: the first run of each layout, then the next."""
    camera = camera_of_width(width_px)
    return tuple(
        SceneSettings(layout=layout, run=run, seed=seed, camera=camera)
        for run in range(1, runs + 1)
        for layout in layouts
    )


def world_of(
    settings: SceneSettings, *, is_painted: bool = True
) -> tuple[Layout, Conditions, World]:
    """Return layout, conditions and world of a run; see ``build_world`` for ``is_painted``."""
    layout = replace(layout_named(settings.layout), traffic=settings.traffic)
    conditions = conditions_of(layout, settings.run, settings.seed)
    return layout, conditions, build_world(layout, conditions, is_painted=is_painted)


# Parameters of the range: focal length times the first over the height in pixels, plus the second.
# They were fitted to detections of the embedded network, to which they are applied, not to true
# outlines: ``crosscue fit ranges --runs --min-score 0.9 --family pinhole-offset`` on L201, L203,
# L204 and L209, 187 pairs, residual 1.56 m.
STOP_SIGN_M: Final = (0.71690, 2.79455)
# Parameters fitted likewise on L206, L207, L210 and L213: 1162 pairs, residual 3.44 m.
TRAFFIC_LIGHT_M: Final = (1.00036, 4.00404)


def scene_vehicle_text(
    camera: SceneCamera,
    *,
    traffic: Side = "right",
    mounting_yaw_rad: float,
    declination_rad: float,
    heading_rad: float,
) -> str:
    """Return the file's text for a camera and compass, with the heading at the start."""
    stop, light = STOP_SIGN_M, TRAFFIC_LIGHT_M
    left, straight, right = POLYGONS
    if traffic == "left":
        left, straight, right = _mirrored(right), _mirrored(straight), _mirrored(left)
    return VEHICLE.format(
        left=left,
        straight=straight,
        right=right,
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


# Left, straight and right region where traffic drives on the right.
POLYGONS: Final = (
    [[0.18, 0.52], [0.38, 0.52], [0.3, 0.555], [0.18, 0.555]],
    [[0.45, 0.495], [0.53, 0.495], [0.53, 0.518], [0.45, 0.518]],
    [[0.55, 0.52], [0.74, 0.52], [0.74, 0.56], [0.58, 0.56]],
)


def _mirrored(polygon: Sequence[Sequence[float]]) -> list[list[float]]:
    return [[round(1.0 - x, 3), y] for x, y in polygon]


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
left = {{left}}
straight = {{straight}}
right = {{right}}

[ranges.stop_sign]
family = "pinhole-offset"
parameters = {{stop_sign}}
residual_sd_m = 1.56

[ranges.traffic_light]
family = "pinhole-offset"
parameters = {{traffic_light}}
residual_sd_m = 3.44
"""
