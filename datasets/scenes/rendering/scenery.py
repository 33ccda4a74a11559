"""Meshes of buildings, trees, poles, signs and lights."""

from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from numpy.random import Generator

from crosscue.replay.columns import Floats

from .mesh import Mesh, Rgb, box, disc, merge_meshes, quad, triangles, tube
from .textures import FRONT_M, WIDTH_M, Atlas

STEEL: Rgb = (0.52, 0.53, 0.54)
WOOD: Rgb = (0.34, 0.27, 0.21)


@dataclass(slots=True)
class Shadows:
    """Objects that cast shadows.

    Attributes:
        solids: Footprint (K, 2) and height of each solid.
        crowns: x, y, radius and height of each tree's crown.
    """

    solids: list[tuple[Floats, float]] = field(default_factory=list)
    crowns: list[tuple[float, float, float, float]] = field(default_factory=list)

    def outlines(self, to_sun: Floats) -> list[Floats]:
        """Return convex shadows of the solids on the ground."""
        slide = -to_sun[:2] / max(float(to_sun[2]), 0.12)
        found = []
        for foot, high in self.solids:
            both = np.concatenate([foot, foot + slide * high]).astype(np.float32)
            found.append(cv2.convexHull(both)[:, 0].astype(np.float64))
        return found

    def blobs(self, to_sun: Floats) -> list[Floats]:
        """Return shadows of crowns: x, y, half axes along and across, direction."""
        slide = -to_sun[:2] / max(float(to_sun[2]), 0.12)
        turn = float(np.arctan2(slide[1], slide[0]))
        longer = min(4.0, 1.0 / max(float(to_sun[2]), 0.2))
        return [
            np.array([x + slide[0] * h, y + slide[1] * h, r * longer, r, turn])
            for x, y, r, h in self.crowns
        ]


def building(
    x: tuple[float, float], y: tuple[float, float], atlas: Atlas, rng: Generator, *, is_shop: bool
) -> tuple[Mesh, float]:
    """Return a shop with a flat roof or a house with a gable, and its height."""
    storeys = int(rng.integers(2, 5)) if is_shop else 2
    high = 3.2 * storeys if is_shop else float(rng.uniform(5.2, 6.2))
    front = atlas.number[f"front_{int(rng.integers(5, 8) if is_shop else rng.integers(5))}"]
    shade = float(rng.uniform(0.82, 1.08))
    walls = box(x, y, (0.0, high), (shade,) * 3, texture=front, wall_m=FRONT_M)
    if is_shop:
        walls.texture[-2:] = -1
        walls.albedo[-2:] = 0.35
        edge = ((x[0] - 0.2, x[1] + 0.2), (y[0] - 0.2, y[1] + 0.2))
        lip = box(*edge, (high, high + 0.35), (0.5, 0.47, 0.44))
        return merge_meshes([walls, lip]), high
    return merge_meshes([walls, _gable(x, y, high, atlas, rng)]), high + 1.5


def _gable(
    x: tuple[float, float], y: tuple[float, float], high: float, atlas: Atlas, rng: Generator
) -> Mesh:
    tile = atlas.number[f"roof_{int(rng.integers(3))}"]
    (x0, x1), (y0, y1) = (x[0] - 0.4, x[1] + 0.4), (y[0] - 0.4, y[1] + 0.4)
    ridge = high + float(rng.uniform(2.0, 3.2))
    if rng.random() < 0.5:
        m = (y0 + y1) / 2
        slopes = [
            [(x0, y0, high), (x1, y0, high), (x1, m, ridge), (x0, m, ridge)],
            [(x1, y1, high), (x0, y1, high), (x0, m, ridge), (x1, m, ridge)],
        ]
        ends = [
            [(x0, y1, high), (x0, y0, high), (x0, m, ridge)],
            [(x1, y0, high), (x1, y1, high), (x1, m, ridge)],
        ]
    else:
        m = (x0 + x1) / 2
        slopes = [
            [(x0, y1, high), (x0, y0, high), (m, y0, ridge), (m, y1, ridge)],
            [(x1, y0, high), (x1, y1, high), (m, y1, ridge), (m, y0, ridge)],
        ]
        ends = [
            [(x0, y0, high), (x1, y0, high), (m, y0, ridge)],
            [(x1, y1, high), (x0, y1, high), (m, y1, ridge)],
        ]
    wall: Rgb = (0.62, 0.58, 0.52)
    return merge_meshes(
        [
            *(quad(s, repeat=(5.0, 2.5), texture=tile) for s in slopes),
            triangles(np.array(ends), wall),
        ]
    )


def tree(x: float, y: float, atlas: Atlas, rng: Generator) -> tuple[Mesh, float, float]:
    """Return a tree, and radius and height of its crown."""
    radius = float(rng.uniform(1.6, 3.0))
    middle = float(rng.uniform(4.2, 5.6))
    trunk = tube((x, y, 0.0), (x + rng.normal(0, 0.15), y, middle), 0.16, WOOD)
    return (
        merge_meshes([trunk, crown((x, y, middle), radius, radius * 0.95, 12, atlas, rng)]),
        radius,
        middle,
    )


def bush(x: float, y: float, radius: float, high: float, atlas: Atlas, rng: Generator) -> Mesh:
    """Return a bush on the ground."""
    return crown((x, y, high / 2), radius, high / 2, 8, atlas, rng)


def crown(
    at: tuple[float, float, float],
    radius: float,
    half_high: float,
    count: int,
    atlas: Atlas,
    rng: Generator,
) -> Mesh:
    """Return randomly oriented bunches of leaves within an ellipsoid."""
    parts = []
    for _ in range(count):
        spot = rng.normal(0.0, 1.0, 3)
        spot *= rng.uniform(0.15, 0.8) / np.linalg.norm(spot)
        centre = np.array(at) + spot * np.array([radius, radius, half_high])
        size = radius * float(rng.uniform(0.55, 0.85))
        turn = float(rng.uniform(0, np.pi))
        lean = float(rng.normal(0, 0.35))
        e1 = np.array([np.cos(turn), np.sin(turn), 0.0])
        e2 = np.array([-np.sin(turn) * np.sin(lean), np.cos(turn) * np.sin(lean), np.cos(lean)])
        e2 = e2 * min(1.0, 1.3 * half_high / radius)
        light = 0.78 + 0.3 * spot[2] + float(rng.normal(0, 0.05))
        corners = [
            centre - size * e1 - size * e2,
            centre + size * e1 - size * e2,
            centre + size * e1 + size * e2,
            centre - size * e1 + size * e2,
        ]
        bunch = quad(
            corners,
            (light, light, light * 0.95),
            texture=atlas.number[f"leaves_{int(rng.integers(4))}"],
        )
        if bunch.normals()[0, 2] < 0.0:
            bunch = quad(
                [corners[i] for i in (1, 0, 3, 2)], (light,) * 3, texture=int(bunch.texture[0])
            )
        parts.append(bunch)
    return merge_meshes(parts)


def sign_face(kind: str, atlas: Atlas) -> Mesh:
    """Return a sign's face, centred at the origin, facing -x; the stop sign is an octagon."""
    wide = WIDTH_M[kind]
    high = (
        wide / 3 if kind.startswith("one_way") else wide * 1.25 if kind == "speed_limit" else wide
    )
    number = atlas.number[kind]
    if kind != "stop_sign":
        a, b = wide / 2, high / 2
        return quad([(0, a, -b), (0, -a, -b), (0, -a, b), (0, a, b)], texture=number)
    angle = np.deg2rad(22.5 + 45.0 * np.arange(9))
    rim = np.column_stack([np.cos(angle), np.sin(angle)]) / np.cos(np.deg2rad(22.5)) / 2
    fan = np.stack([np.zeros((8, 2)), rim[:-1], rim[1:]], axis=1)
    # Seen along +x, y runs to the left; v runs downwards.
    corners = np.stack([np.zeros((8, 3)), -fan[..., 0] * wide, fan[..., 1] * wide], axis=-1)
    uv = np.stack([0.5 + fan[..., 0] * 0.998, 0.5 - fan[..., 1] * 0.998], axis=-1)
    return triangles(corners, uv=uv, texture=number)


def sign_back(face: Mesh) -> Mesh:
    """Return the grey back of a sign, behind its face."""
    moved = face.placed(0.02, 0.0)
    return triangles(moved.corners[:, ::-1], STEEL)


def post(x: float, y: float, high: float) -> Mesh:
    """Return a sign's post."""
    return tube((x + 0.06, y, 0.0), (x + 0.06, y, high), 0.035, STEEL, 5)


LAMPS: dict[str, Rgb] = {
    "red": (1.0, 0.14, 0.10), "yellow": (1.0, 0.74, 0.12), "green": (0.16, 1.0, 0.58),
}  # fmt: skip
# Width and height of a traffic light's head.
HEAD_M = (0.36, 1.06)


def light_head(state: str) -> Mesh:
    """Return a traffic light's head, centred at the origin, facing -x, with one lamp on."""
    wide, high = HEAD_M
    case: Rgb = (0.10, 0.105, 0.09)
    parts = [box((0.0, 0.24), (-wide / 2, wide / 2), (-high / 2, high / 2), case)]
    for lamp, z in zip(("red", "yellow", "green"), (0.345, 0.0, -0.345), strict=True):
        lit = lamp == state
        rgb = LAMPS[lamp] if lit else tuple(0.16 * c for c in LAMPS[lamp])
        parts.append(
            disc((-0.02, 0.0, z), (-1.0, 0.0, 0.0), 0.14, (rgb[0], rgb[1], rgb[2]), glow=float(lit))
        )
        front, back = z + 0.15, z + 0.17
        hood = [(-0.2, 0.16, front), (-0.2, -0.16, front), (0.0, -0.16, back), (0.0, 0.16, back)]
        parts.append(quad(hood, case))
    return merge_meshes(parts)


def mast(x: float, y: float, arm_to_y: float) -> Mesh:
    """Return a pole with an arm over the road."""
    high = 6.3
    return merge_meshes(
        [
            tube((x + 0.3, y, 0.0), (x + 0.3, y, high + 0.3), 0.13, STEEL, 8),
            tube((x + 0.3, y, high), (x + 0.3, arm_to_y, high + 0.25), 0.07, STEEL),
        ]
    )


def utility_pole(x: float, y: float) -> Mesh:
    """Return a wooden pole with a cross-arm."""
    return merge_meshes(
        [
            tube((x, y, 0.0), (x, y, 9.5), 0.15, WOOD),
            box((x - 0.06, x + 0.06), (y - 1.1, y + 1.1), (8.7, 8.85), WOOD),
        ]
    )


def wire(a: tuple[float, float, float], b: tuple[float, float, float]) -> Mesh:
    """Return a sagging wire that is thick enough to be visible."""
    start, stop = np.array(a), np.array(b)
    fraction = np.linspace(0, 1, 9)[:, None]
    points = start + fraction * (stop - start)
    points[:, 2] -= 0.7 * 4 * (fraction * (1 - fraction))[:, 0]
    return merge_meshes([tube(p, q, 0.018, (0.08, 0.08, 0.09), 3) for p, q in pairwise(points)])
