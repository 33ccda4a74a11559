"""What the study of intersections simulates, and how it replays that."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.rendering.camera import Camera
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.detectors.registry import EMBEDDED
from crosscue.replay.errors import UsageError


@dataclass(frozen=True, slots=True)
class IntersectionStudy:
    """What to simulate and how to replay it.

    Attributes:
        layouts: Intersections.
        runs: Of each, from 1.
        seed: Of everything that differs from run to run.
        width_px: Of the pictures, 9/16 high.
        vehicle: A vehicle file to replay with; each drive's own, if left out.
        detectors: Comma-separated, as ``replay`` takes them.
    """

    layouts: tuple[str, ...] = tuple(SCORED)
    runs: int = 10
    seed: int = 0
    width_px: int = 1280
    vehicle: Path | None = None
    detectors: str = EMBEDDED

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            UsageError: Naming what was wanted.
        """
        if self.runs < 1 or self.seed < 0:
            raise UsageError(f"runs {self.runs}, seed {self.seed}: expected 1 or more, 0 or more")
        if not 64 <= self.width_px <= 3840 or self.width_px % 16:
            raise UsageError(f"width {self.width_px}: expected a multiple of 16 from 64 to 3840")
        unknown = [name for name in self.layouts if name not in SCORED]
        if unknown or len(set(self.layouts)) != len(self.layouts) or not self.layouts:
            raise UsageError(
                f"layouts {', '.join(self.layouts)}: expected some of A to H, each once"
            )

    def scenes(self) -> tuple[SceneSettings, ...]:
        """Every drive, in the order in which they are done."""
        camera = Camera(width_px=self.width_px, height_px=self.width_px * 9 // 16)
        return tuple(
            SceneSettings(layout=layout, run=run, seed=self.seed, camera=camera)
            for run in range(1, self.runs + 1)
            for layout in self.layouts
        )
