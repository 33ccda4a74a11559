"""Single pictures of simulated runs, with objects or roads, to train networks.

Consecutive pictures of a drive are very similar, so a network learns more from eight pictures of
each of a hundred intersections than from a thousand pictures of one. Road pictures may also come
from a folder: ``images/NAME.jpg`` with ``masks/NAME.png``, white for road.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.simulated.drive import START_NS
from crosscue.detectors.base import View
from crosscue.detectors.images import decode, read_file
from crosscue.replay.columns import Bytes, ColumnSet, Floats
from crosscue.replay.errors import EmptyResultError, LogError, UsageError
from crosscue.replay.files.whole_file import write_bytes

from .drive import jpeg
from .scene_truth import DriveAnnotations
from .settings import SceneSettings, world_of
from .world import World

# Fraction of the pictures before the intersection; the others are within it.
BEFORE_ENTRY: Final = 0.9


def times_s(world: World, count: int, rng: np.random.Generator) -> Floats:
    """Return the times of pictures: half evenly along the path, half evenly in time, sorted.

    A car that waits at a red light is mostly in one place, while other cars pass.
    """
    motion, enter_s = world.approach.motion, world.approach.enter_s
    last_s = (len(motion) - 2) / 100.0
    fraction = rng.random(count)
    until_s = np.where(rng.random(count) < BEFORE_ENTRY, min(enter_s, last_s), last_s)
    step_m = np.abs(motion.speed_mps) * 0.01 + 1e-9
    way_m = np.concatenate([[0.0], np.cumsum(step_m)[:-1]])
    at = np.arange(len(motion)) * 0.01
    by_way = np.interp(fraction * np.interp(until_s, at, way_m), way_m, at)
    return np.sort(np.where(rng.random(count) < 0.5, by_way, fraction * until_s))


def render_frames(settings: SceneSettings, count: int, folder: Path) -> DriveAnnotations:
    """Render and write ``count`` pictures of one run to ``folder``, and return their annotations.

    Raises:
        OutputError: A picture cannot be written.
    """
    layout, conditions, world = world_of(settings)
    renderer = Renderer(world, settings.camera, settings.picture)
    rng = np.random.default_rng([conditions.seed, 12])
    objects = DriveAnnotations()
    for number, t_s in enumerate(times_s(world, count, rng).tolist()):
        picture = renderer.picture(t_s, number)
        t_ns = START_NS + round(t_s * 1e9)
        tags = conditions.tags(layout)
        objects.add(t_ns, picture, tags, -picture.view.rear_axle[0])
        name = f"{settings.name}-{number:03d}.jpg"
        objects.images[-1]["file_name"] = name
        write_bytes(folder / name, jpeg(picture.rgb, settings.picture.jpeg_quality))
    return objects


def merge_annotations(parts: Sequence[DriveAnnotations]) -> DriveAnnotations:
    """Merge the annotations of many runs, with new numbers."""
    whole = DriveAnnotations()
    for part in parts:
        images, annotations = len(whole.images), len(whole.annotations)
        whole.images += [{**image, "id": image["id"] + images} for image in part.images]
        whole.annotations += [
            {**row, "id": row["id"] + annotations, "image_id": row["image_id"] + images}
            for row in part.annotations
        ]
    return whole


@dataclass(frozen=True, slots=True, eq=False)
class RoadFrames(ColumnSet):
    """N pictures of one size.

    Attributes:
        pixels: Pictures, shape (N, H, W, 3), uint8, blue, green, red.
        road: Fraction of each pixel that is road, 0 to 255, shape (N, H, W), uint8.
    """

    pixels: NDArray[np.uint8]
    road: NDArray[np.uint8]


def concatenate_frames(parts: Sequence[RoadFrames]) -> RoadFrames:
    """Concatenate frames."""
    return RoadFrames(
        np.concatenate([p.pixels for p in parts]), np.concatenate([p.road for p in parts])
    )


def render_road_frames(settings: SceneSettings, count: int, size_px: tuple[int, int]) -> RoadFrames:
    """Render pictures of one run, evenly along the path, a few of them within the intersection.

    Args:
        settings: The run; its camera should be about twice as wide as the result.
        count: Number of pictures.
        size_px: Width and height of the result.
    """
    _, conditions, world = world_of(settings)
    rng = np.random.default_rng([conditions.seed, 13])
    motion = world.approach.motion
    last_m = min(0.6 * world.layout.end_m, float(motion.x_m.max()))
    step_m = (last_m - float(motion.x_m[0])) / count
    way = motion.x_m[0] + step_m * (np.arange(count) + rng.random(count))
    renderer = Renderer(world, settings.camera, settings.picture)
    pixels, road = [], []
    for number, x_m in enumerate(way.tolist()):
        t_s = float(np.argmax(motion.x_m >= x_m)) / 100.0
        picture = renderer.picture(t_s, number, with_road=True)
        assert picture.road is not None
        pixels.append(shrunk(np.ascontiguousarray(picture.rgb[..., ::-1]), size_px))
        road.append(shrunk(np.where(picture.road, 255, 0).astype(np.uint8), size_px))
    return RoadFrames(np.stack(pixels), np.stack(road))


def shrunk(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize a picture; each pixel is the mean of the pixels that it covers."""
    return np.asarray(cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA), np.uint8)


SUFFIXES: Final = (".jpg", ".jpeg", ".png", ".webp", ".bmp")


def load_folder(folder: Path, size_px: tuple[int, int]) -> RoadFrames:
    """Read all pictures of a folder with their masks, in order of names.

    Args:
        folder: Folder with ``images`` and ``masks``.
        size_px: Width and height of the result.

    Raises:
        UsageError: A picture and its mask have different sizes.
        EmptyResultError: There are no pictures.
        LogError: The folder of pictures is missing, or a picture or its mask is missing or does
            not decode.
    """
    images = sorted(
        path for path in (folder / "images").glob("*") if path.suffix.lower() in SUFFIXES
    )
    if not images:
        if not folder.joinpath("images").is_dir():
            raise LogError(f"{folder / 'images'}: no such folder; expected images and masks")
        raise EmptyResultError(f"{folder / 'images'}: no pictures; expected {', '.join(SUFFIXES)}")
    pixels, road = [], []
    for path in images:
        picture = _decoded(path, View())
        mask = _decoded(folder / "masks" / f"{path.stem}.png", View(is_grey=True))
        if mask.shape != picture.shape[:2]:
            raise UsageError(
                f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels, but its mask has "
                f"{mask.shape[1]} x {mask.shape[0]}; expected equal sizes"
            )
        pixels.append(shrunk(picture, size_px))
        road.append(shrunk(np.where(mask > 127, 255, 0).astype(np.uint8), size_px))
    return RoadFrames(np.stack(pixels), np.stack(road))


def _decoded(path: Path, view: View) -> Bytes:
    try:
        return decode(read_file(path), view)[0]
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}; expected a mask for every picture") from None
    except LogError as error:
        raise type(error)(f"{path}: {error}; repair or remove it") from None
