"""Triangle meshes with texture, colour and object number, and simple solids."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.columns import ColumnSet, Floats

Float32s = NDArray[np.float32]
Rgb = tuple[float, float, float]

NOBODY = -1


@dataclass(frozen=True, slots=True, eq=False)
class Mesh(ColumnSet):
    """T triangles.

    Attributes:
        corners: Corners in metres, shape (T, 3, 3).
        uv: Texture coordinates in widths and heights of the texture, v downwards, shape (T, 3, 2).
        texture: Number in the atlas, -1 without texture, shape (T,).
        albedo: Colour, 0 to 1, or factor on the texture, shape (T, 3).
        glow: 1 for a surface that emits light, shape (T,).
        instance: Number of the object, ``NOBODY`` for scenery, shape (T,).
    """

    corners: Float32s
    uv: Float32s
    texture: NDArray[np.int32]
    albedo: Float32s
    glow: Float32s
    instance: NDArray[np.int32]

    def owned_by(self, instance: int) -> Mesh:
        """Return the triangles with the number of an object."""
        return replace(self, instance=np.full(len(self), instance, np.int32))

    def placed(self, x_m: float, y_m: float, yaw_rad: float = 0.0, z_m: float = 0.0) -> Mesh:
        """Return the mesh rotated about the vertical axis, then translated."""
        c, s = np.cos(yaw_rad), np.sin(yaw_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        moved = self.corners @ turn.T + np.array([x_m, y_m, z_m])
        return replace(self, corners=moved.astype(np.float32))

    def aside(self, of_x_m: Callable[[Floats], Floats]) -> Mesh:
        """Return the mesh with each corner translated along y by a function of its x."""
        moved = self.corners.copy()
        moved[..., 1] += of_x_m(moved[..., 0].astype(np.float64)).astype(np.float32)
        return replace(self, corners=moved)

    def normals(self) -> Floats:
        """Return unit normals, shape (T, 3); corners are counter-clockwise for the viewer."""
        side_a = self.corners[:, 1].astype(np.float64) - self.corners[:, 0]
        side_b = self.corners[:, 2].astype(np.float64) - self.corners[:, 0]
        across = np.cross(side_a, side_b)
        length = np.linalg.norm(across, axis=1, keepdims=True)
        unit: Floats = across / np.maximum(length, 1e-12)
        return unit


def nothing() -> Mesh:
    """Return an empty mesh."""
    return Mesh(
        np.zeros((0, 3, 3), np.float32),
        np.zeros((0, 3, 2), np.float32),
        np.zeros(0, np.int32),
        np.zeros((0, 3), np.float32),
        np.zeros(0, np.float32),
        np.zeros(0, np.int32),
    )


def merge_meshes(parts: Sequence[Mesh]) -> Mesh:
    """Return one mesh with the triangles of all parts."""
    if not parts:
        return nothing()
    names = (column.name for column in fields(Mesh))
    return Mesh(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def triangles(
    corners: NDArray[np.generic],
    rgb: Rgb = (1.0, 1.0, 1.0),
    *,
    uv: NDArray[np.generic] | None = None,
    texture: int = -1,
    glow: float = 0.0,
) -> Mesh:
    """Return triangles of one colour, with corners of shape (T, 3, 3)."""
    n = len(corners)
    return Mesh(
        np.asarray(corners, np.float32),
        np.zeros((n, 3, 2), np.float32) if uv is None else np.asarray(uv, np.float32),
        np.full(n, texture, np.int32),
        np.tile(np.asarray(rgb, np.float32), (n, 1)),
        np.full(n, glow, np.float32),
        np.full(n, NOBODY, np.int32),
    )


def quad(
    corners: NDArray[np.generic] | Sequence[Sequence[float]],
    rgb: Rgb = (1.0, 1.0, 1.0),
    *,
    repeat: tuple[float, float] = (1.0, 1.0),
    texture: int = -1,
    glow: float = 0.0,
) -> Mesh:
    """Return a quad with corners bottom left, bottom right, top right, top left of its texture."""
    four = np.asarray(corners, np.float64)
    u, v = repeat[0] * 0.9999, repeat[1] * 0.9999
    at = np.array([[0.0, v], [u, v], [u, 0.0], [0.0, 0.0]])
    order = np.array([[0, 1, 2], [0, 2, 3]])
    return triangles(four[order], rgb, uv=at[order], texture=texture, glow=glow)


def upright(
    x: float, y: tuple[float, float], z: tuple[float, float], rgb: Rgb, *, glow: float = 0.0
) -> Mesh:
    """Return a vertical quad across the x axis."""
    corners = [(x, y[0], z[0]), (x, y[1], z[0]), (x, y[1], z[1]), (x, y[0], z[1])]
    return quad(corners, rgb, glow=glow)


def box(
    x: tuple[float, float],
    y: tuple[float, float],
    z: tuple[float, float],
    rgb: Rgb,
    *,
    texture: int = -1,
    wall_m: tuple[float, float] = (1.0, 1.0),
) -> Mesh:
    """Return a box without floor; walls repeat their texture every ``wall_m``."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    high = max(1.0, round((z1 - z0) / wall_m[1])) if texture >= 0 else 1.0
    along_x = max(1.0, round((x1 - x0) / wall_m[0])) if texture >= 0 else 1.0
    along_y = max(1.0, round((y1 - y0) / wall_m[0])) if texture >= 0 else 1.0
    sides = [
        ([(x0, y0), (x1, y0)], along_x),
        ([(x1, y0), (x1, y1)], along_y),
        ([(x1, y1), (x0, y1)], along_x),
        ([(x0, y1), (x0, y0)], along_y),
    ]
    parts = [
        quad([(*a, z0), (*b, z0), (*b, z1), (*a, z1)], rgb, repeat=(times, high), texture=texture)
        for (a, b), times in sides
    ]
    parts.append(quad([(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)], rgb))
    return merge_meshes(parts)


def tube(a: Sequence[float], b: Sequence[float], radius_m: float, rgb: Rgb, sides: int = 6) -> Mesh:
    """Return a thin pole from ``a`` to ``b``."""
    start, stop = np.asarray(a, np.float64), np.asarray(b, np.float64)
    along = (stop - start) / np.linalg.norm(stop - start)
    ring = _ring(along, radius_m, sides, is_level=bool(abs(along[2]) <= 0.9))
    return merge_meshes(
        [
            quad([start + ring[k], start + ring[k + 1], stop + ring[k + 1], stop + ring[k]], rgb)
            for k in range(sides)
        ]
    )


def _ring(along: Floats, radius_m: float, sides: int, *, is_level: bool) -> Floats:
    e1 = np.cross([0.0, 0.0, 1.0] if is_level else [1.0, 0.0, 0.0], along)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(along, e1)
    angle = np.arange(sides + 1) * 2 * np.pi / sides
    return np.asarray(radius_m * (np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2))


def disc(
    centre: Sequence[float],
    normal: Sequence[float],
    radius_m: float,
    rgb: Rgb,
    *,
    glow: float = 0.0,
) -> Mesh:
    """Return a flat disc facing along ``normal``."""
    middle, n = np.asarray(centre, np.float64), np.asarray(normal, np.float64)
    sides = 14
    rim = middle + _ring(n, radius_m, sides, is_level=bool(abs(n[2]) < 0.9))
    fan = np.stack([np.tile(middle, (sides, 1)), rim[:-1], rim[1:]], axis=1)
    return triangles(fan, rgb, glow=glow)
