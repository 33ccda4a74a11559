"""What the study of layouts simulates, and which layouts are tested together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, get_args

from crosscue.datasets.scenes.layout import KINDS, mixed_layout
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.replay.errors import UsageError

MIN_FOLDS: Final = 2
Perception = Literal["pixels", "faults"]
PERCEPTIONS: Final[tuple[Perception, ...]] = get_args(Perception)


@dataclass(frozen=True, slots=True)
class LayoutStudy:
    """What to simulate, and what sees it.

    Layouts are ``M`` and a seed. Thirteen in a row hold every kind once, so they stay together:
    each fold is whole blocks of thirteen.

    Attributes:
        perception: ``pixels``: the embedded networks see photographs. ``faults``: no network sees
            anything, and the renderer's masks have faults made up by ``faulty_labels``.
        blocks: Of thirteen layouts.
        runs: Drives of each layout, under different conditions.
        folds: Parts of the blocks; each is tested by what was fitted on the others.
        seed: Of everything that differs from run to run.
        width_px: Of the pictures, 9/16 high.
    """

    perception: Perception = "pixels"
    blocks: int = 8
    runs: int = 2
    folds: int = 4
    seed: int = 0
    width_px: int = 960

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            UsageError: Naming what was wanted.
        """
        if self.perception not in PERCEPTIONS:
            raise UsageError(
                f"perception {self.perception!r}: expected one of {', '.join(PERCEPTIONS)}"
            )
        if not MIN_FOLDS <= self.folds <= self.blocks:
            raise UsageError(
                f"folds {self.folds}, blocks {self.blocks}: expected {MIN_FOLDS} folds or more, "
                "and a block for each"
            )
        if self.runs < 1 or self.seed < 0:
            raise UsageError(f"runs {self.runs}, seed {self.seed}: expected 1 or more, 0 or more")
        camera_of_width(self.width_px)

    @property
    def layouts(self) -> tuple[str, ...]:
        """Names of all layouts."""
        return tuple(f"M{number}" for number in range(self.blocks * len(KINDS)))

    def fold_of(self, layout: str) -> int:
        """Which fold a layout is tested in."""
        return int(layout[1:]) // len(KINDS) % self.folds

    def features_of(self, layout: str) -> dict[str, bool]:
        """What is true of it, as far as that can be said."""
        return mixed_layout(int(layout[1:])).features

    def scenes(self) -> tuple[SceneSettings, ...]:
        """Every drive, in the order in which they are done: one of each layout, then the next."""
        camera = camera_of_width(self.width_px)
        return tuple(
            SceneSettings(layout=layout, run=run, seed=self.seed, camera=camera)
            for run in range(1, self.runs + 1)
            for layout in self.layouts
        )
