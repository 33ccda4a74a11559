"""What to simulate, and the world that follows from it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.datasets.scenes.rendering.render import DEFAULTS, PictureSettings
from crosscue.replay.errors import UsageError

from .conditions import Conditions, conditions_of
from .layout import Layout, layout_named
from .world import World, build

CAMERA: Final = Camera()


@dataclass(frozen=True, slots=True)
class SceneSettings:
    """One run to simulate.

    Attributes:
        layout: ``A`` to ``H``, or ``L`` or ``M`` and a seed.
        run: From 1; ten are laid down, more come from the seed.
        seed: Everything random about the run comes from it; plan and buildings do not.
        rate_hz: Pictures a second.
        camera: Size, lens, mounting.
        picture: How pictures are made.
    """

    layout: str = "A"
    run: int = 1
    seed: int = 0
    rate_hz: int = 10
    camera: Camera = CAMERA
    picture: PictureSettings = DEFAULTS

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            ValueError: Naming what was wanted.
        """
        layout_named(self.layout)
        if self.run < 1 or self.seed < 0:
            raise ValueError(f"run {self.run}, seed {self.seed}: expected 1 or more, 0 or more")
        if self.rate_hz not in (10, 20, 25, 50):
            raise ValueError(f"rate_hz: expected 10, 20, 25 or 50, got {self.rate_hz}")

    @property
    def name(self) -> str:
        """As its folder is called."""
        return f"{self.layout}-{self.run:02d}"


def camera_of_width(width_px: int) -> Camera:
    """The camera of simulated drives with pictures of another size; they are 9/16 high.

    Raises:
        UsageError: Not a size that it has.
    """
    if not 64 <= width_px <= 3840 or width_px % 16:
        raise UsageError(f"--width {width_px}: expected a multiple of 16 from 64 to 3840")
    return Camera(width_px=width_px, height_px=width_px * 9 // 16)


def world_of(
    settings: SceneSettings, *, is_painted: bool = True
) -> tuple[Layout, Conditions, World]:
    """The world that a run happens in; ``is_painted`` as ``build`` takes it."""
    layout = layout_named(settings.layout)
    conditions = conditions_of(layout, settings.run, settings.seed)
    return layout, conditions, build(layout, conditions, is_painted=is_painted)
