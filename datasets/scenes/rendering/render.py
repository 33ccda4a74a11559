"""Render pictures of a world, with the object of each pixel."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.camera import ground_seen
from crosscue.datasets.scenes.world import SceneObject, World
from crosscue.replay.columns import Floats

from .camera import CameraView, SceneCamera, view_at
from .ground import TEXELS_PER_M, X_M, Y_M
from .kernels import Buffers, Eye, Haze, Lens, Textures, compile_kernels
from .mesh import Mesh
from .textures import smooth_noise
from .weather import drops, streaks

# Max distance from the picture, in picture sizes, at which an object's outline is measured.
MAX_ABOUT: Final = 3


@dataclass(frozen=True, slots=True)
class PictureSettings:
    """Settings of rendering.

    Attributes:
        samples: Samples per pixel in each direction, for edges of objects.
        exposure_s: Exposure time, during which a rotating camera blurs the picture.
        blur_px: Standard deviation of the lens's blur for a width of 1280 pixels.
        jpeg_quality: JPEG quality, 1 to 100.
    """

    samples: int = 2
    exposure_s: float = 0.012
    blur_px: float = 0.55
    jpeg_quality: int = 90


DEFAULTS: Final = PictureSettings()


@dataclass(frozen=True, slots=True, eq=False)
class RenderedObject:
    """One object in one picture.

    Attributes:
        thing: The object.
        mask: Mask of the pixels of its box, shape (H, W), bool.
        box_px: x0, y0, x1, y1 of the visible part, half open, in integer pixels.
        visible: Visible fraction of the object's part within the picture.
        in_picture: Fraction of the object that is within the picture.
        distance_m: Distance from the rear axle along the car's axis.
    """

    thing: SceneObject
    mask: NDArray[np.bool_]
    box_px: tuple[int, int, int, int]
    visible: float
    in_picture: float
    distance_m: float


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """One camera frame with its truth.

    Attributes:
        t_s: Time from the start of the drive.
        rgb: Pixels, shape (H, W, 3), uint8.
        view: View of the camera.
        owner: Number of each pixel's object, -1 without object, shape (H, W), int16.
        seen: All labelled objects with at least one pixel.
        road: Mask of road, shape (H, W), bool; None if not requested.
    """

    t_s: float
    rgb: NDArray[np.uint8]
    view: CameraView
    owner: NDArray[np.int16]
    seen: tuple[RenderedObject, ...]
    road: NDArray[np.bool_] | None = None


class Renderer:
    """Renderer of one world, with the data shared by all pictures."""

    def __init__(
        self, world: World, camera: SceneCamera | None = None, settings: PictureSettings = DEFAULTS
    ) -> None:
        """Compute the light on the scenery, and allocate the buffers."""
        self.world = world
        self.camera = SceneCamera() if camera is None else camera
        self.settings = settings
        self._kernels = compile_kernels()
        self._textures = Textures(*world.atlas.packed())
        self._scenery = (world.scenery, world.light.on(world.scenery))
        self._movers = [
            (
                thing,
                world.light.on(thing.mesh),
                None if thing.later is None else world.light.on(thing.later),
            )
            for thing in world.things
            if not thing.is_fixed
        ]
        n = settings.samples
        high, wide = self.camera.height_px, self.camera.width_px
        size = (high * n, wide * n)
        self._buffers = Buffers(
            np.zeros(size, np.float32), np.zeros((*size, 3), np.uint8), np.zeros(size, np.int16)
        )
        self._haze = Haze(world.light.haze_per_m, world.light.haze)
        rng = np.random.default_rng([world.conditions.seed, 5])
        self._grain = (smooth_noise(rng, 256, 64) * 140 + rng.random((256, 256)) * 116).astype(
            np.uint8
        )
        self._noise = np.clip(rng.normal(0.0, 32.0, (512, 512)), -127, 127).astype(np.int8)

    def picture(self, t_s: float, number: int = 0, *, with_road: bool = False) -> RenderedFrame:
        """Return the camera's picture at a time; ``number`` seeds its noise."""
        view = self._drawn(t_s)
        rgb, owner = self._composed(view, t_s)
        self._finish(rgb, view, number)
        road = None
        if with_road:
            on_map = self.world.ground.road.view(np.uint8)
            road = ground_seen(on_map, self._buffers.depth, self.settings.samples, view) > 0
        return RenderedFrame(t_s, rgb, view, owner, self._seen(owner, view, t_s), road)

    def owners(
        self, t_s: float, codes: NDArray[np.uint8]
    ) -> tuple[RenderedFrame, NDArray[np.uint8]]:
        """Return a picture without colours, and the codes of the ground in its pixels.

        The camera must have one sample per pixel. The world need not be painted.

        Args:
            t_s: Time from the start of the drive.
            codes: Map of the ground for ``ground_seen``.
        """
        view = self._drawn(t_s)
        owner = self._buffers.owner.copy()
        black = np.zeros((*owner.shape, 3), np.uint8)
        ground = ground_seen(codes, self._buffers.depth, self.settings.samples, view)
        return RenderedFrame(t_s, black, view, owner, self._seen(owner, view, t_s)), ground

    def _drawn(self, t_s: float) -> CameraView:
        """Draw all static and moving objects into the buffers, and return the view."""
        view = view_at(self.camera, self.world.approach, t_s)
        self._buffers.depth.fill(0.0)
        self._buffers.owner.fill(-1)
        for thing, tint, later in self._movers:
            if thing.is_there(t_s):
                mesh = thing.mesh_at(t_s)
                lit = later if later is not None and mesh is thing.later else tint
                self._draw(mesh, lit, thing.shift(t_s), view)
        self._draw(*self._scenery, np.zeros(3), view)
        return view

    def _lens(self, scale: float) -> Lens:
        cx, cy = self.camera.centre_px
        return Lens(self.camera.focal * scale, cx * scale, cy * scale)

    def _draw(self, mesh: Mesh, tint: NDArray[np.float32], shift: Floats, view: CameraView) -> None:
        ahead = mesh.corners.mean(axis=1) @ view.eye_axes[2].astype(np.float32)
        self._kernels.draw(
            np.argsort(ahead, kind="stable"),
            mesh.corners,
            mesh.uv,
            mesh.texture,
            tint,
            mesh.instance,
            shift.astype(np.float32),
            Eye(view.eye_axes, view.at_m),
            self._lens(self.settings.samples),
            self._haze,
            self._textures,
            self._buffers,
        )

    def _composed(
        self, view: CameraView, t_s: float
    ) -> tuple[NDArray[np.uint8], NDArray[np.int16]]:
        light, ground = self.world.light, self.world.ground
        high, wide = self.camera.height_px, self.camera.width_px
        rgb = np.zeros((high, wide, 3), np.uint8)
        owner = np.zeros((high, wide), np.int16)
        self._kernels.compose(
            self._buffers,
            self.settings.samples,
            ground.texels,
            ground.levels,
            X_M[0],
            Y_M[0],
            float(TEXELS_PER_M),
            self._grain,
            light.on_ground,
            self._shadows(view, t_s),
            light.shine,
            light.sky,
            Eye(np.ascontiguousarray(view.eye_axes.T), view.at_m),
            self._lens(1.0),
            self._haze,
            rgb,
            owner,
        )
        return rgb, owner

    def _shadows(self, view: CameraView, t_s: float) -> NDArray[np.uint8]:
        """Return the shadows of moving cars, directly below them and away from the sun."""
        light = self.world.light
        shade = np.full((self.camera.height_px, self.camera.width_px), 255, np.uint8)
        slide = -light.to_sun[:2] / max(float(light.to_sun[2]), 0.3) * 0.9
        for thing, _, _ in self._movers:
            if thing.category != "car" or not thing.is_there(t_s):
                continue
            middle = np.array(thing.at)[:2] + thing.shift(t_s)[:2]
            along = np.array([np.cos(thing.heading_rad), np.sin(thing.heading_rad)])
            across = np.array([-along[1], along[0]])
            a, b = along * thing.size[0] / 2, across * thing.size[1] / 2
            foot = np.array([-a - b, a - b, a + b, b - a]) + middle
            if light.sun.max() > 0.1:
                foot = np.concatenate([foot, foot + slide])
            flat = view.project(np.column_stack([foot, np.zeros(len(foot))]))
            if (flat[:, 2] > 1.0).all() and np.abs(flat[:, :2]).max() < 30_000:
                hull = cv2.convexHull(flat[:, :2].astype(np.float32))
                dark = int(255 * max(0.35, light.in_shadow * 0.9))
                cv2.fillConvexPoly(shade, np.rint(hull * 16).astype(np.int32), dark, cv2.LINE_AA, 4)
        return shade

    def _finish(self, rgb: NDArray[np.uint8], view: CameraView, number: int) -> None:
        light, wide = self.world.light, self.camera.width_px
        rng = np.random.default_rng([self.world.conditions.seed, 6, number])
        rain = self.world.conditions.rain
        if rain > 0.0:
            streaks(rgb, rain, view.speed_mps, rng)
            still = np.random.default_rng([self.world.conditions.seed, 7, number // 7])
            drops(rgb, rain, still)
        smear = abs(view.yaw_rate_radps) * self.settings.exposure_s * self.camera.focal
        if smear >= 1.5:
            rgb[:] = cv2.blur(rgb, (round(smear), 1))
        sigma = self.settings.blur_px * wide / 1280
        if sigma > 0.2:
            rgb[:] = cv2.GaussianBlur(rgb, (3, 3), sigma)
        sun = view.project(view.at_m[None] + light.to_sun[None] * 1e4)[0]
        flare = light.flare if sun[2] > 0 else 0.0
        row, column = (int(k) for k in rng.integers(0, 512, 2))
        self._kernels.develop(
            rgb,
            self._noise,
            row,
            column,
            light.noise / 32.0,
            0.22,
            np.array([255.0, 226.0, 180.0]),
            float(np.clip(sun[0], -1e5, 1e5)),
            float(np.clip(sun[1], -1e5, 1e5)),
            flare,
            light.contrast,
        )

    def _seen(
        self, owner: NDArray[np.int16], view: CameraView, t_s: float
    ) -> tuple[RenderedObject, ...]:
        counts = np.bincount(owner.ravel().astype(np.int64) + 1, minlength=1)[1:]
        seen = []
        for number in np.flatnonzero(counts):
            thing = self.world.things[int(number)]
            corners = view.project(_corners(thing, t_s))
            mask, box = _cut_out(owner, int(number), corners)
            visible, inside = self._fractions(thing, t_s, view, int(counts[number]), corners)
            seen.append(
                RenderedObject(thing, mask, box, visible, inside, distance_m(thing, t_s, view))
            )
        return tuple(seen)

    def _fractions(
        self, thing: SceneObject, t_s: float, view: CameraView, pixels: int, corners: Floats
    ) -> tuple[float, float]:
        """Return the visible fraction of the part in the picture, and that part's fraction."""
        wide, high = self.camera.width_px, self.camera.height_px
        ahead = corners[corners[:, 2] > 0.3]
        if len(ahead) < len(corners):
            return 0.0, 0.0
        left, top = np.floor(ahead[:, :2].min(0)).astype(int)
        right, bottom = np.ceil(ahead[:, :2].max(0)).astype(int)
        left, right = max(left, -MAX_ABOUT * wide), min(right, (1 + MAX_ABOUT) * wide)
        top, bottom = max(top, -MAX_ABOUT * high), min(bottom, (1 + MAX_ABOUT) * high)
        covered = np.zeros((max(bottom - top, 1), max(right - left, 1)), np.uint8)
        mesh = thing.mesh_at(t_s)
        total = self._kernels.cover(
            mesh.corners,
            thing.shift(t_s).astype(np.float32),
            Eye(view.eye_axes, view.at_m),
            self._lens(1.0),
            covered,
            left,
            top,
        )
        part = covered[max(-top, 0) : max(high - top, 0), max(-left, 0) : max(wide - left, 0)]
        within = int(part.sum())
        return min(1.0, pixels / max(within, 1)), within / max(total, 1)


def distance_m(thing: SceneObject, t_s: float, view: CameraView) -> float:
    """Return the distance from the rear axle to an object's centre, along the car's axis."""
    x, y, heading = view.rear_axle
    middle = np.array(thing.at) + thing.shift(t_s)
    return float((middle[0] - x) * np.cos(heading) + (middle[1] - y) * np.sin(heading))


def _corners(thing: SceneObject, t_s: float) -> Floats:
    points: Floats = thing.mesh_at(t_s).corners.reshape(-1, 3).astype(np.float64)
    low, high = points.min(0) + thing.shift(t_s), points.max(0) + thing.shift(t_s)
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def _cut_out(
    owner: NDArray[np.int16], number: int, corners: Floats
) -> tuple[NDArray[np.bool_], tuple[int, int, int, int]]:
    """Return an object's mask within its box, and the box, searching only near its corners."""
    high, wide = owner.shape
    x0, y0, x1, y1 = 0, 0, wide, high
    if (corners[:, 2] > 0.3).all():
        x0, y0 = np.clip(np.floor(corners[:, :2].min(0)).astype(int) - 2, 0, (wide, high))
        x1, y1 = np.clip(np.ceil(corners[:, :2].max(0)).astype(int) + 2, 0, (wide, high))
    window = owner[y0:y1, x0:x1] == number
    rows, columns = np.flatnonzero(window.any(1)), np.flatnonzero(window.any(0))
    top, bottom, left, right = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
    box = (int(x0 + left), int(y0 + top), int(x0 + right), int(y0 + bottom))
    return window[top:bottom, left:right].copy(), box
