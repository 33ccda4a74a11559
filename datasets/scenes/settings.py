"""Settings of a simulated run, and the world that they define."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.rendering.render import DEFAULTS, PictureSettings
from crosscue.replay.errors import UsageError

from .layout import Layout, layout_named
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
    """

    layout: str = "A"
    run: int = 1
    seed: int = 0
    rate_hz: int = 10
    camera: SceneCamera = CAMERA
    picture: PictureSettings = DEFAULTS

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
        return f"{self.layout}-{self.run:02d}"


def camera_of_width(width_px: int) -> SceneCamera:
    """Return the camera of simulated drives for another width; the aspect ratio is 16 to 9.

    Raises:
        UsageError: The width is not supported.
    """
    if not 64 <= width_px <= 3840 or width_px % 16:
        raise UsageError(f"width_px: {width_px}, expected a multiple of 16 from 64 to 3840")
    return SceneCamera(width_px=width_px, height_px=width_px * 9 // 16)


def world_of(
    settings: SceneSettings, *, is_painted: bool = True
) -> tuple[Layout, Conditions, World]:
    """Return layout, conditions and world of a run; see ``build_world`` for ``is_painted``."""
    layout = layout_named(settings.layout)
    conditions = conditions_of(layout, settings.run, settings.seed)
    return layout, conditions, build_world(layout, conditions, is_painted=is_painted)
