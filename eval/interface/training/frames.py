"""Pictures to train networks on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from crosscue.datasets.scenes.drive import SOURCE
from crosscue.datasets.scenes.export.coco import Objects
from crosscue.datasets.scenes.export.training_frames import frames, joined
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.eval.interface.training.inputs import check_place, learnt_layouts_of
from crosscue.replay.errors import OutputError, UsageError


@dataclass(frozen=True, slots=True, repr=False)
class TrainingFrames:
    """Pictures with their annotations; printed in a line.

    Attributes:
        coco: The annotations; the pictures are in ``images`` beside it.
        pictures: How many.
        objects: How many are annotated in them.
    """

    coco: Path
    pictures: int
    objects: int

    def as_dict(self) -> dict[str, object]:
        """What ``crosscue train frames --json`` prints."""
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
    """Render pictures of simulated intersections with COCO annotations, to train networks on.

    Args:
        folder: Gets ``coco.json`` and ``images``.
        layouts: Names and spans: L0, L17, L0-L99. A to H are scored, so nothing may learn from
            them.
        per_layout: Pictures of each.
        seed: Of what differs from run to run.
        width_px: Of a picture, a multiple of 16; it is 9/16 high.
        workers: How many layouts are rendered side by side.
        on_runs: Called with the number of runs that are rendered, and of how many.

    Raises:
        UsageError: A value out of range, or a layout that is scored, or named twice.
        OutputError: The folder has annotations already, or cannot be written.
    """
    if per_layout < 1 or workers < 1 or seed < 0:
        raise UsageError("--per-layout, --workers: expected 1 or more; --seed: expected 0 or more")
    wanted = [
        _settings(name, seed, width_px) for name in learnt_layouts_of(layouts, "train frames")
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
    # Conditions come in ten kinds; layout and run count up together, so each kind comes as often.
    run = int(layout[1:]) % 10 + 1
    return SceneSettings(layout=layout, run=run, seed=seed, camera=camera_of_width(width_px))
