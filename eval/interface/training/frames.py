"""Render annotated pictures for training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.datasets.scenes.drive import SOURCE
from crosscue.datasets.scenes.export.coco import Objects
from crosscue.datasets.scenes.export.training_frames import frames, joined
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.eval.interface.training.inputs import check_place, training_layouts_of
from crosscue.replay.errors import OutputError, UsageError


@dataclass(frozen=True, slots=True, repr=False)
class TrainingFrames:
    """Pictures with annotations; its repr is one line.

    Attributes:
        coco: Annotation file; the pictures are in the folder ``images`` next to it.
        pictures: Number of pictures.
        objects: Number of annotated objects.
    """

    coco: Path
    pictures: int
    objects: int

    def as_dict(self) -> dict[str, object]:
        """Return the JSON output of ``crosscue train frames``."""
        return {"coco": str(self.coco), "pictures": self.pictures, "objects": self.objects}

    def __repr__(self) -> str:
        return f"{self.coco}: {self.pictures} pictures, {self.objects} objects"


def render_training_frames(
    folder: Path | str,
    layouts: Sequence[str],
    per_layout: int = 8,
    seed: int = 0,
    *,
    width_px: int = 1280,
    workers: int = 1,
    on_runs: Callable[[int, int], None] = lambda done, of: None,
) -> TrainingFrames:
    """Render pictures of simulated intersections with COCO annotations, for training.

    Args:
        folder: Output folder for ``coco.json`` and ``images``.
        layouts: Names and ranges: L0, L17, L0-L99. A to H are refused, because crosscue is scored
            on them.
        per_layout: Number of pictures of each layout.
        seed: Seed of everything that differs between runs.
        width_px: Picture width, a multiple of 16; the height is 9/16 of it.
        workers: Number of layouts to render in parallel.
        on_runs: Called with the number of runs rendered, and their total.

    Raises:
        UsageError: A value is out of range, or a layout is one of A to H or named twice.
        OutputError: The folder already contains annotations, or cannot be written.
    """
    if per_layout < 1 or workers < 1 or seed < 0:
        raise UsageError("--per-layout, --workers: expected 1 or more; --seed: expected 0 or more")
    wanted = [
        _settings(name, seed, width_px) for name in training_layouts_of(layouts, "train frames")
    ]
    target, images = Path(folder) / "coco.json", Path(folder) / "images"
    if target.exists():
        raise OutputError(f"{target}: exists; give another folder")
    check_place(images / "any")
    parts: list[Objects] = []
    for part in frames(wanted, per_layout, images, workers):
        parts.append(part)
        on_runs(len(parts), len(wanted))
    whole = joined(parts)
    whole.save(target, f"{SOURCE}; layouts {' '.join(layouts)}, seed {seed}")
    return TrainingFrames(target, len(whole.images), len(whole.annotations))


def _settings(layout: str, seed: int, width_px: int) -> SceneSettings:
    # There are ten kinds of conditions, by number of the run; this uses each equally often.
    run = int(layout[1:]) % 10 + 1
    return SceneSettings(layout=layout, run=run, seed=seed, camera=camera_of_width(width_px))
