"""Small simulated scenes, built once for all tests, and mirror images of them."""

from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
import pytest

from crosscue.datasets.scenes import drive
from crosscue.datasets.scenes.layout import layout_named
from crosscue.datasets.scenes.motion import conditions_of
from crosscue.datasets.scenes.rendering.camera import SceneCamera
from crosscue.datasets.scenes.rendering.ground import Ground
from crosscue.datasets.scenes.rendering.mesh import Mesh
from crosscue.datasets.scenes.rendering.render import PictureSettings, RenderedFrame, Renderer
from crosscue.datasets.scenes.settings import world_of
from crosscue.datasets.scenes.world import SceneObject, World, build_world

SMALL: Final = SceneCamera(width_px=384, height_px=216)


@cache
def world(layout: str = "D", run: int = 1, seed: int = 0) -> World:
    plan = layout_named(layout)
    return build_world(plan, conditions_of(plan, run, seed))


def shorten(patch: pytest.MonkeyPatch, pictures: int = 15) -> None:
    """End simulated drives after a number of pictures, and build each world only once."""
    all_times = drive.picture_times
    patch.setattr(drive, "picture_times", lambda *of: all_times(*of)[:pictures])
    patch.setattr(drive, "world_of", cache(world_of))


def renderer(of: World, camera: SceneCamera = SMALL) -> Renderer:
    return Renderer(of, camera, PictureSettings())


def when_at(of: World, x_m: float) -> float:
    """Time in seconds at which the rear axle reaches ``x_m`` along the road."""
    return float(np.argmax(of.approach.motion.x_m >= x_m)) / 100.0


def picture_at(of: World, x_m: float, camera: SceneCamera = SMALL) -> RenderedFrame:
    return renderer(of, camera).picture(when_at(of, x_m))


def mirrored(of: World) -> World:
    """The same world with left and right exchanged, including text."""
    motion = of.approach.motion
    turned = replace(
        motion,
        y_m=-motion.y_m,
        heading_rad=-motion.heading_rad,
        yaw_rate_radps=-motion.yaw_rate_radps,
    )
    flip = np.array([1.0, -1.0, 1.0])
    light = replace(
        of.light, to_sun=of.light.to_sun * flip, sky=np.ascontiguousarray(of.light.sky[:, ::-1])
    )
    return replace(
        of,
        approach=replace(of.approach, motion=turned),
        light=light,
        ground=_flipped(of.ground),
        scenery=_mesh(of.scenery),
        things=tuple(_thing(one) for one in of.things),
    )


def _mesh(mesh: Mesh) -> Mesh:
    # The order of corners changes as well, so that faces keep pointing outwards.
    order = [0, 2, 1]
    corners = mesh.corners[:, order] * np.array([1, -1, 1], np.float32)
    return replace(mesh, corners=corners, uv=np.ascontiguousarray(mesh.uv[:, order]))


def _thing(thing: SceneObject) -> SceneObject:
    x, y, z = thing.at
    return replace(
        thing,
        mesh=_mesh(thing.mesh),
        later=None if thing.later is None else _mesh(thing.later),
        at=(x, -y, z),
        heading_rad=-thing.heading_rad,
        velocity=(thing.velocity[0], -thing.velocity[1]),
    )


def _flipped(ground: Ground) -> Ground:
    parts = []
    for offset, wide, high in ground.levels.tolist():
        level = ground.texels[offset : offset + wide * high].reshape(high, wide, 4)
        parts.append(level[::-1].reshape(-1, 4))
    return replace(ground, texels=np.concatenate(parts), road=ground.road[::-1])
