"""Render pictures of simulated intersections with road masks, to train road networks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.render import Renderer
from crosscue.datasets.scenes.settings import SceneSettings, world_of


@dataclass(frozen=True, slots=True, eq=False)
class RoadFrames:
    """N pictures of one size.

    Attributes:
        pixels: Pictures, shape (N, H, W, 3), uint8, blue, green, red.
        road: Fraction of each pixel that is road, 0 to 255, shape (N, H, W), uint8.
    """

    pixels: NDArray[np.uint8]
    road: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.pixels)


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


def rendered(
    runs: Sequence[SceneSettings], count: int, size_px: tuple[int, int]
) -> Iterator[RoadFrames]:
    """Yield ``render_road_frames`` for each run."""
    for settings in runs:
        yield render_road_frames(settings, count, size_px)


def shrunk(picture: NDArray[np.uint8], size_px: tuple[int, int]) -> NDArray[np.uint8]:
    """Resize a picture; each pixel is the mean of the pixels that it covers."""
    import cv2

    return np.asarray(cv2.resize(picture, size_px, interpolation=cv2.INTER_AREA), np.uint8)
