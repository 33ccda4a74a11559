"""Render annotated pictures for training."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from crosscue.datasets.scenes.scene_truth import DriveAnnotations
from crosscue.datasets.scenes.settings import SceneSettings, camera_of_width
from crosscue.datasets.scenes.single_frames import merge_annotations, render_frames
from crosscue.datasets.simulated.log_files import SOURCE
from crosscue.eval.training.inputs import check_place, training_layouts_of
from crosscue.replay.errors import OutputError, UsageError
from crosscue.replay.processes import in_processes
from crosscue.replay.progress import Progress, emit
from crosscue.replay.safe_text import counted
from crosscue.results import Result
from crosscue.verb import Option


@dataclass(frozen=True, slots=True, repr=False)
class TrainingFrames(Result):
    """Pictures with annotations; its repr is one line.

    Attributes:
        coco: Annotation file; the pictures are in the folder ``images`` next to it.
        pictures: Number of pictures.
        objects: Number of annotated objects.
    """

    coco: Path
    pictures: int
    objects: int

    def lines(self) -> Iterator[str]:
        """Yield the numbers of pictures and objects."""
        yield f"{self.coco}: {counted(self.pictures, 'picture')}, {counted(self.objects, 'object')}"


def render_training_frames(
    output: Path | str,
    layouts: Annotated[Sequence[str], Option(metavar="LAYOUT")],
    *,
    per_layout: int = 8,
    seed: int = 0,
    width_px: Annotated[int, Option("--width")] = 1280,
    workers: int = 1,
) -> TrainingFrames:
    """Render simulated intersections with COCO annotations, for training.

    Writes a few pictures of each layout to OUT/images, and their annotations to OUT/coco.json.
    Layouts are L0, L1, and so on. Layouts A to H are refused, because crosscue is scored on them.

    Examples:
        crosscue train frames L0-L299 --per-layout 8 -o frames
        crosscue train frames L900-L949 --per-layout 4 -o held_out

    Args:
        output: Folder for images and annotations.
        layouts: Layouts: L0, L17 or a range, L0-L99.
        per_layout: Images per layout.
        seed: Random seed.
        width_px: Image width in pixels; height is 9/16.
        workers: Number of layouts in parallel.

    Raises:
        UsageError: A value is out of range, or a layout is one of A to H or named twice.
        OutputError: The folder already contains annotations, or cannot be written.
    """
    if min(per_layout, workers) < 1:
        raise UsageError("per_layout, workers: expected 1 or more")
    if seed < 0:
        raise UsageError(f"seed: {seed}, expected 0 or more")
    wanted = [
        _settings(name, seed, width_px) for name in training_layouts_of(layouts, "train frames")
    ]
    target, images = Path(output) / "coco.json", Path(output) / "images"
    if target.exists():
        raise OutputError(f"{target}: exists; give another folder")
    check_place(images / "any")
    parts: list[DriveAnnotations] = []
    render = partial(render_frames, count=per_layout, folder=images)
    for part in in_processes(render, wanted, workers):
        parts.append(part)
        emit(Progress("rendering", len(parts), len(wanted), "runs"))
    whole = merge_annotations(parts)
    whole.save(target, f"{SOURCE}; layouts {' '.join(layouts)}, seed {seed}")
    return TrainingFrames(target, len(whole.images), len(whole.annotations))


def _settings(layout: str, seed: int, width_px: int) -> SceneSettings:
    # There are ten kinds of conditions, by number of the run; this uses each equally often.
    run = int(layout[1:]) % 10 + 1
    return SceneSettings(layout=layout, run=run, seed=seed, camera=camera_of_width(width_px))
