"""Settings of the study of intersections."""

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
    """Settings of the study of intersections.

    Attributes:
        layouts: Names of the layouts.
        runs: Number of drives per layout.
        seed: Seed of everything that differs between runs.
        width_px: Width of the pictures; the height is 9/16 of it.
        vehicle: Vehicle file to replay with; default: that of each drive.
        detectors: Comma-separated names, as for ``crosscue replay``.
    """

    layouts: tuple[str, ...] = tuple(SCORED)
    runs: int = 10
    seed: int = 0
    width_px: int = 1280
    vehicle: Path | None = None
    detectors: str = EMBEDDED

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: A value is out of range.
        """
        if self.runs < 1 or self.seed < 0:
            raise UsageError(
                f"runs {self.runs}, seed {self.seed}: expected 1 or more runs, a seed of 0 or more"
            )
        if not 64 <= self.width_px <= 3840 or self.width_px % 16:
            raise UsageError(f"width {self.width_px}: expected a multiple of 16 from 64 to 3840")
        unknown = [name for name in self.layouts if name not in SCORED]
        if unknown or len(set(self.layouts)) != len(self.layouts) or not self.layouts:
            raise UsageError(
                f"layouts {', '.join(self.layouts)}: expected some of A to H, each once"
            )

    def scenes(self) -> tuple[SceneSettings, ...]:
        """Return all drives, in the order of processing."""
        camera = Camera(width_px=self.width_px, height_px=self.width_px * 9 // 16)
        return tuple(
            SceneSettings(layout=layout, run=run, seed=self.seed, camera=camera)
            for run in range(1, self.runs + 1)
            for layout in self.layouts
        )
