"""Settings of the study of intersections."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from crosscue.datasets.scenes.layout import SCORED
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width, scenes_of
from crosscue.detectors.registry import EMBEDDED
from crosscue.replay.errors import UsageError
from crosscue.verb import Option


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


@dataclass(frozen=True, slots=True)
class IntersectionStudy:
    """Settings of the study of intersections.

    Attributes:
        layouts: Comma-separated layouts, A to H (default: all).
        runs: Runs per layout.
        seed: Random seed.
        width_px: Image width in pixels; height is 9/16.
        vehicle: Vehicle file (default: that of each drive).
        detectors: Comma-separated names.
    """

    layouts: Annotated[
        tuple[str, ...], Option(metavar="NAMES", convert=_names, is_one_word=True)
    ] = tuple(SCORED)
    runs: Annotated[int, Option(metavar="N")] = 10
    seed: int = 0
    width_px: Annotated[int, Option("--width")] = 1280
    vehicle: Path | None = None
    detectors: Annotated[str, Option(metavar="NAMES")] = EMBEDDED

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: A value is out of range.
        """
        if self.runs < 1 or self.seed < 0:
            raise UsageError(
                f"runs {self.runs}, seed {self.seed}: expected 1 or more runs, a seed of 0 or more"
            )
        camera_of_width(self.width_px)
        unknown = [name for name in self.layouts if name not in SCORED]
        if unknown or len(set(self.layouts)) != len(self.layouts) or not self.layouts:
            raise UsageError(
                f"layouts {', '.join(self.layouts)}: expected some of A to H, each once"
            )

    def scenes(self) -> tuple[SceneSettings, ...]:
        """Return all drives, in the order of processing."""
        return scenes_of(self.layouts, self.runs, self.seed, self.width_px)
