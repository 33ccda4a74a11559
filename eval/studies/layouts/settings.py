"""Settings of the study of layouts, and its folds."""

from dataclasses import dataclass
from typing import Annotated, Final, Literal, get_args

from crosscue.datasets.scenes.layout import KINDS, mixed_layout
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width, scenes_of
from crosscue.replay.errors import UsageError
from crosscue.verb import Option

MIN_FOLDS: Final = 2
Perception = Literal["pixels", "faults"]
PERCEPTIONS: Final[tuple[Perception, ...]] = get_args(Perception)


@dataclass(frozen=True, slots=True)
class LayoutStudy:
    """Settings of the study of layouts.

    Layouts are named ``M`` and a seed. A block of thirteen consecutive layouts contains every kind
    once, so a fold consists of complete blocks.

    Attributes:
        perception: Detections from networks on pixels, or from simulated faults.
        blocks: Blocks of thirteen layouts.
        runs: Drives per layout.
        folds: Folds, by layout.
        seed: Random seed of the drives. The layouts stay the same.
        layouts_from: Number of the first layout; another one draws layouts never seen before.
        width_px: Image width in pixels; height is 9/16.
    """

    perception: Perception = "pixels"
    blocks: int = 8
    runs: Annotated[int, Option(metavar="N")] = 2
    folds: int = 4
    seed: int = 0
    layouts_from: Annotated[int, Option(metavar="N")] = 0
    width_px: Annotated[int, Option("--width")] = 960

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            UsageError: A value is out of range.
        """
        if self.perception not in PERCEPTIONS:
            raise UsageError(
                f"perception {self.perception!r}: expected one of {', '.join(PERCEPTIONS)}"
            )
        if not MIN_FOLDS <= self.folds <= self.blocks:
            raise UsageError(
                f"folds {self.folds}, blocks {self.blocks}: expected {MIN_FOLDS} folds or more, "
                "and at least as many blocks"
            )
        if self.runs < 1 or min(self.seed, self.layouts_from) < 0:
            raise UsageError(
                f"runs {self.runs}, seed {self.seed}, layouts_from {self.layouts_from}: expected 1 "
                "or more runs, the others 0 or more"
            )
        camera_of_width(self.width_px)

    @property
    def layouts(self) -> tuple[str, ...]:
        """Names of all layouts."""
        numbers = range(self.layouts_from, self.layouts_from + self.blocks * len(KINDS))
        return tuple(f"M{number}" for number in numbers)

    def fold_of(self, layout: str) -> int:
        """Return the fold that a layout is tested in."""
        return (int(layout[1:]) - self.layouts_from) // len(KINDS) % self.folds

    def features_of(self, layout: str) -> dict[str, bool]:
        """Return the true features of a layout, where known."""
        return mixed_layout(int(layout[1:])).features

    def scenes(self) -> tuple[SceneSettings, ...]:
        """Return all drives in the order of processing: one of each layout, then the next."""
        return scenes_of(self.layouts, self.runs, self.seed, self.width_px)
