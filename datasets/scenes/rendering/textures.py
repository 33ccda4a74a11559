"""Textures of surfaces: signs, leaves and house fronts, in one buffer with all mipmap levels."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from crosscue.replay.columns import Floats, Int64s

Rgba = NDArray[np.uint8]

WIDTH_M: Final[Mapping[str, float]] = {
    "stop_sign": 0.76,
    "do_not_enter": 0.76,
    "one_way_left": 1.37,
    "one_way_right": 1.37,
    "speed_limit": 0.61,
}


def sign(name: str) -> Rgba:
    """Return a sign named in ``WIDTH_M``, with a width of 128 pixels."""
    path = files("crosscue.datasets.scenes.rendering").joinpath("drawings", f"{name}.png")
    bgra = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    return np.ascontiguousarray(np.asarray(bgra, np.uint8)[..., [2, 1, 0, 3]])


LEVELS: Final = 9
# Colours of walls.
WALLS: Final = (
    (168, 92, 74), (196, 186, 168), (150, 158, 166), (206, 200, 188), (128, 104, 88),
    (176, 164, 132), (110, 120, 112),
)  # fmt: skip
# Width and height of the wall that one house-front texture covers.
FRONT_M: Final = (8.0, 6.0)


@dataclass(slots=True)
class Atlas:
    """Textures by name, each with mipmap levels at half the size, a quarter, and so on.

    Attributes:
        number: Row of ``places`` by name.
    """

    number: dict[str, int] = field(default_factory=dict)
    _texels: list[Rgba] = field(default_factory=list)
    _places: list[Int64s] = field(default_factory=list)
    _used: int = 0

    def add(self, name: str, rgba: Rgba) -> int:
        """Add a texture, and return its number."""
        place = np.zeros((LEVELS, 3), np.int64)
        level = rgba
        for k in range(LEVELS):
            high, wide = level.shape[:2]
            place[k] = (self._used, wide, high)
            self._texels.append(level.reshape(-1, 4))
            self._used += high * wide
            if min(high, wide) > 1:
                half = cv2.resize(level, (wide // 2, high // 2), interpolation=cv2.INTER_AREA)
                level = np.ascontiguousarray(half, dtype=np.uint8)
        self.number[name] = len(self._places)
        self._places.append(place)
        return self.number[name]

    def packed(self) -> tuple[NDArray[np.uint8], Int64s]:
        """Return all texels (N, 4) and places (K, LEVELS, 3): offset, width, height."""
        return np.concatenate(self._texels), np.stack(self._places)


def make_atlas(rng: Generator) -> Atlas:
    """Return an atlas of all textures of a scene."""
    atlas = Atlas()
    for name in WIDTH_M:
        atlas.add(name, sign(name))
    for i in range(4):
        atlas.add(f"leaves_{i}", leaves(rng))
    for i in range(8):
        atlas.add(f"front_{i}", front(rng, is_shop=i >= 5))
    for i in range(3):
        atlas.add(f"roof_{i}", roof(rng))
    atlas.add("bark", bark(rng))
    return atlas


def smooth_noise(rng: Generator, size: int, cells: int) -> Floats:
    """Return tileable noise in [0, 1], shape (size, size), with about ``cells`` blobs per side."""
    coarse = rng.random((cells, cells)).astype(np.float32)
    wrapped = np.pad(coarse, 2, mode="wrap")
    step = size // cells
    fine = cv2.resize(wrapped, None, fx=step, fy=step, interpolation=cv2.INTER_CUBIC)
    return np.clip(fine[2 * step : 2 * step + size, 2 * step : 2 * step + size], 0, 1).astype(
        np.float64
    )


def leaves(rng: Generator) -> Rgba:
    """Return a bunch of leaves: many small ellipses, dark ones first, on transparency."""
    size, count = 128, 420
    canvas = np.zeros((size, size, 4), np.uint8)
    base = np.array([74, 104, 42]) * rng.uniform(0.85, 1.1) + rng.normal(0, 6, 3)
    for k in range(count):
        radius = np.sqrt(rng.random()) * size * 0.42
        angle = rng.uniform(0, 2 * np.pi)
        x = size / 2 + radius * np.cos(angle) + rng.normal(0, 3)
        y = size / 2 + radius * np.sin(angle) * 0.9 + rng.normal(0, 3)
        light = 0.45 + 0.65 * k / count + 0.25 * (0.5 - y / size) + rng.normal(0, 0.08)
        colour = np.clip(base * light, 8, 220)
        axes = (round(rng.uniform(2, 5)), round(rng.uniform(1.5, 3)))
        turn = rng.uniform(0, 180)
        cv2.ellipse(canvas, (round(x), round(y)), axes, turn, 0, 360, (*colour.tolist(), 255), -1)
    empty = canvas[..., 3] == 0
    canvas[empty, :3] = np.clip(base * 0.7, 0, 255).astype(np.uint8)
    return canvas


def front(rng: Generator, *, is_shop: bool) -> Rgba:
    """Return a wall of eight by six metres with two storeys of windows."""
    size = 256
    wall = np.array(WALLS[int(rng.integers(len(WALLS)))]) * rng.uniform(0.85, 1.08)
    grain = smooth_noise(rng, size, 32)[..., None] * 0.12 + 0.94
    canvas = np.full((size, size, 4), 255, np.uint8)
    canvas[..., :3] = np.clip(wall * grain, 0, 255)
    courses = 8 if rng.random() < 0.5 else 5
    canvas[::courses, :, :3] = (canvas[::courses, :, :3] * 0.86).astype(np.uint8)
    trim = tuple((np.array([226, 224, 218]) * rng.uniform(0.7, 1.0)).tolist())
    for storey in range(2):
        shop = is_shop and storey == 1
        count = 2 if shop else int(rng.integers(3, 5))
        wide = size / count
        for k in range(count):
            margin = 0.08 if shop else 0.26
            x0, x1 = round((k + margin) * wide), round((k + 1 - margin) * wide)
            y0 = round(storey * size / 2 + (0.22 if shop else 0.26) * size / 2)
            y1 = round(storey * size / 2 + (0.92 if shop else 0.80) * size / 2)
            glass = np.array([58, 68, 78]) * rng.uniform(0.6, 1.5)
            cv2.rectangle(canvas, (x0 - 3, y0 - 3), (x1 + 3, y1 + 4), (*trim, 255), -1)
            cv2.rectangle(canvas, (x0, y0), (x1, y1), (*glass.tolist(), 255), -1)
            bright = (*np.minimum(glass * 1.5, 255).tolist(), 255)
            cv2.line(canvas, (x0 + 2, y1 - 4), (x1 - 4, y0 + 3), bright, 3)
            if not shop:
                middle = (y0 + y1) // 2
                cv2.rectangle(canvas, (x0, middle - 1), (x1, middle + 1), (*trim, 255), -1)
    if is_shop:
        band = tuple(rng.uniform(30, 190, 3).tolist())
        cv2.rectangle(canvas, (0, size // 2), (size, size // 2 + 12), (*band, 255), -1)
    return canvas


def roof(rng: Generator) -> Rgba:
    """Return a texture of shingles."""
    size = 64
    base = np.array([92, 88, 88]) * rng.uniform(0.7, 1.2) + rng.normal(0, 8, 3)
    canvas = np.full((size, size, 4), 255, np.uint8)
    light = 0.85 + 0.3 * rng.random((size // 4, size // 8))
    shingles = np.kron(light, np.ones((4, 8)))
    shingles[::4] *= 0.8
    canvas[..., :3] = np.clip(base * shingles[..., None], 0, 255)
    return canvas


def bark(rng: Generator) -> Rgba:
    """Return a texture of a tree's trunk."""
    size = 32
    canvas = np.full((size, size, 4), 255, np.uint8)
    stripes = 0.7 + 0.6 * rng.random((1, size, 1)) + 0.15 * rng.random((size, size, 1))
    canvas[..., :3] = np.clip(np.array([84, 70, 58]) * stripes, 0, 255)
    return canvas
