"""Meshes of cars with a realistic side view: a nose below the tail, wheels, glass and lamps."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.random import Generator

from crosscue.datasets.scenes.rendering.mesh import (
    Mesh,
    Rgb,
    disc,
    merge_meshes,
    quad,
    triangles,
    upright,
)
from crosscue.replay.columns import Floats

SKIRT_M: Final = 0.24
GLASS: Final[Rgb] = (0.09, 0.11, 0.13)
TYRE: Final[Rgb] = (0.05, 0.05, 0.055)
# Offset of painted details from a side, which avoids depth ties.
TILL_SHUT_M: Final = 0.012


@dataclass(frozen=True, slots=True)
class CarShape:
    """Shape of a kind of car, seen from the right: x from tail (0) to nose, z up.

    Attributes:
        body: Upper edge of the lower body, tail to nose.
        cabin: Upper edge of the cabin, from belt line to belt line.
        pillars: x of the pillars between side windows.
        half_width_m: Half of the body's width.
        roof_half_width_m: Half of the roof's width.
        wheels_m: x of both axles.
        wheel_radius_m: Radius of a tyre.
    """

    body: tuple[tuple[float, float], ...]
    cabin: tuple[tuple[float, float], ...]
    pillars: tuple[float, ...]
    half_width_m: float
    roof_half_width_m: float
    wheels_m: tuple[float, float]
    wheel_radius_m: float = 0.33

    @property
    def length_m(self) -> float:
        """Length from bumper to bumper."""
        return self.body[-1][0]

    @property
    def height_m(self) -> float:
        """Height from ground to roof."""
        return max(z for _, z in self.cabin)


SHAPES: Final = {
    "sedan": CarShape(
        ((0.0, 0.72), (0.06, 0.96), (0.9, 1.02), (3.35, 0.96), (4.35, 0.76), (4.62, 0.62),
         (4.7, 0.45)),
        ((0.55, 1.0), (1.45, 1.42), (2.55, 1.45), (3.45, 0.95)),
        (2.15,), 0.90, 0.62, (0.95, 3.75),
    ),
    "hatchback": CarShape(
        ((0.0, 0.70), (0.04, 0.98), (0.6, 1.02), (2.95, 0.98), (3.75, 0.80), (3.98, 0.64),
         (4.05, 0.45)),
        ((0.05, 0.98), (0.42, 1.43), (1.9, 1.48), (3.1, 0.96)),
        (1.0, 1.95), 0.87, 0.62, (0.68, 3.22),
    ),
    "suv": CarShape(
        ((0.0, 0.80), (0.04, 1.10), (0.6, 1.14), (3.25, 1.10), (4.3, 0.92), (4.58, 0.78),
         (4.65, 0.55)),
        ((0.05, 1.10), (0.36, 1.66), (2.3, 1.72), (3.35, 1.09)),
        (1.1, 2.2), 0.94, 0.68, (0.88, 3.65), 0.37,
    ),
    "pickup": CarShape(
        ((0.0, 0.85), (0.02, 1.12), (2.1, 1.14), (4.15, 1.10), (5.2, 0.95), (5.5, 0.84),
         (5.55, 0.6)),
        ((2.0, 1.12), (2.16, 1.74), (3.35, 1.78), (4.2, 1.10)),
        (2.95,), 0.97, 0.70, (1.05, 4.45), 0.39,
    ),
    "van": CarShape(
        ((0.0, 0.85), (0.02, 1.05), (0.6, 1.08), (4.1, 1.02), (4.75, 0.84), (4.98, 0.70),
         (5.05, 0.5)),
        ((0.03, 1.04), (0.18, 1.74), (2.9, 1.78), (4.3, 1.0)),
        (1.3, 2.6), 0.97, 0.76, (0.95, 4.0), 0.35,
    ),
}  # fmt: skip

PAINTS: Final[tuple[Rgb, ...]] = (
    (0.78, 0.79, 0.80), (0.86, 0.86, 0.85), (0.10, 0.10, 0.11), (0.32, 0.33, 0.35),
    (0.52, 0.54, 0.56), (0.50, 0.07, 0.07), (0.10, 0.17, 0.36), (0.16, 0.27, 0.22),
    (0.46, 0.40, 0.30), (0.20, 0.34, 0.50),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Look:
    """Appearance of a car.

    Attributes:
        kind: Key of ``SHAPES``.
        paint: Red, green and blue, 0 to 1.
    """

    kind: str
    paint: Rgb

    @property
    def shape(self) -> CarShape:
        """Shape of its kind."""
        return SHAPES[self.kind]


def any_look(rng: Generator) -> Look:
    """Draw a random, typical car."""
    kind = str(
        rng.choice(["sedan", "hatchback", "suv", "pickup", "van"], p=[0.4, 0.17, 0.28, 0.09, 0.06])
    )
    return Look(kind, PAINTS[int(rng.integers(len(PAINTS)))])


def car(look: Look, *, lamps_on: bool) -> Mesh:
    """Return the mesh of a car with its centre over the origin, nose along +x."""
    shape = look.shape
    parts = [
        _slab(shape.body, SKIRT_M, shape.half_width_m, shape.half_width_m, look.paint),
        *_cabin(shape, look.paint),
        *_wheels(shape),
        *_ends(shape, lamps_on=lamps_on),
    ]
    return merge_meshes(parts).placed(-shape.length_m / 2, 0.0)


def _slab(
    top: tuple[tuple[float, float], ...], foot_m: float, low: float, high: float, rgb: Rgb
) -> Mesh:
    """Return a body below the polyline ``top``: sides from ``foot_m`` up, and the upper surface."""
    edge = np.array(top)
    parts = []
    for (xa, za), (xb, zb) in pairwise(edge):
        parts += [
            [(xa, -low, foot_m), (xb, -low, foot_m), (xb, -high, zb), (xa, -high, za)],
            [(xb, low, foot_m), (xa, low, foot_m), (xa, high, za), (xb, high, zb)],
            [(xa, -high, za), (xb, -high, zb), (xb, high, zb), (xa, high, za)],
        ]
    (x0, z0), (x1, z1) = edge[0], edge[-1]
    parts.append([(x0, low, foot_m), (x0, -low, foot_m), (x0, -high, z0), (x0, high, z0)])
    parts.append([(x1, -low, foot_m), (x1, low, foot_m), (x1, high, z1), (x1, -high, z1)])
    return merge_meshes([quad(corners, rgb) for corners in parts])


def _cabin(shape: CarShape, paint: Rgb) -> list[Mesh]:
    edge = np.array(shape.cabin)
    belt = min(edge[0, 1], edge[-1, 1])
    roof = shape.height_m
    wide = shape.half_width_m - 0.05

    def half(z: float) -> float:
        fraction = (z - belt) / (roof - belt)
        return float(wide + (shape.roof_half_width_m - wide) * fraction)

    parts = []
    last = len(edge) - 2
    for k, ((xa, za), (xb, zb)) in enumerate(pairwise(edge)):
        ya, yb = half(za), half(zb)
        # The first and the last piece are the rear window and the windscreen.
        rgb = GLASS if k in (0, last) else paint
        skin = np.array([(xa, -ya, za), (xb, -yb, zb), (xb, yb, zb), (xa, ya, za)])
        parts.append(quad(skin, rgb))
        yf = half(belt)
        for side in (-1.0, 1.0):
            ends = ((xa, yf, belt), (xb, yf, belt), (xb, yb, zb), (xa, ya, za))
            wall = [(x, side * y, z) for x, y, z in ends]
            parts.append(quad(wall if side < 0 else wall[::-1], paint))
    parts += _windows(shape, edge, belt, half)
    return parts


def _windows(
    shape: CarShape, edge: Floats, belt: float, half: Callable[[float], float]
) -> list[Mesh]:
    inset = 0.09
    sill, head = belt + 0.05, shape.height_m - inset
    xs = np.linspace(edge[0, 0], edge[-1, 0], 40)
    tops = np.minimum(np.interp(xs, edge[:, 0], edge[:, 1]) - inset * 0.9, head)
    inside = xs[tops > sill + 0.06]
    first, last = float(inside[0]), float(inside[-1])
    cuts = [first, *[p for p in shape.pillars if first + 0.2 < p < last - 0.2], last]
    parts = []
    for a, b in pairwise(cuts):
        grid = np.linspace(a + 0.035, b - 0.035, 7)
        top = np.minimum(np.interp(grid, edge[:, 0], edge[:, 1]) - inset * 0.9, head)
        for k in range(6):
            for side in (-1.0, 1.0):
                corners = [
                    (grid[i], side * (half(z) + TILL_SHUT_M), z)
                    for i, z in ((k, sill), (k + 1, sill), (k + 1, top[k + 1]), (k, top[k]))
                ]
                parts.append(quad(corners if side < 0 else corners[::-1], GLASS))
    return parts


def _wheels(shape: CarShape) -> list[Mesh]:
    parts = []
    r = shape.wheel_radius_m
    for x in shape.wheels_m:
        for side in (-1.0, 1.0):
            y = side * (shape.half_width_m + TILL_SHUT_M)
            out = (0.0, side, 0.0)
            arch = disc((x, y, r + 0.02), out, r + 0.07, (0.02, 0.02, 0.02))
            keep = arch.corners[:, :, 2].min(axis=1) > 0.0
            parts += [
                triangles(arch.corners[keep], (0.02, 0.02, 0.02)),
                disc((x, y + side * 0.006, r), out, r, TYRE),
                disc((x, y + side * 0.012, r), out, 0.62 * r, (0.55, 0.56, 0.57)),
                disc((x, y + side * 0.018, r), out, 0.2 * r, (0.2, 0.2, 0.2)),
            ]
            # The tread, which is visible below the bumpers.
            inner = side * (shape.half_width_m - 0.2)
            parts.append(quad([(x, inner, 0.0), (x, y, 0.0), (x, y, r), (x, inner, r)], TYRE))
    return parts


def _ends(shape: CarShape, *, lamps_on: bool) -> list[Mesh]:
    nose, tail = shape.length_m + TILL_SHUT_M, -TILL_SHUT_M
    w = shape.half_width_m
    low = shape.body[-2][1]
    parts = []
    for side in (-1.0, 1.0):
        near, far = side * (w - 0.36), side * (w - 0.06)
        rgb: Rgb = (1.0, 0.98, 0.9) if lamps_on else (0.75, 0.77, 0.8)
        glow = 1.0 if lamps_on else 0.0
        parts.append(upright(nose, (near, far), (low - 0.12, low + 0.02), rgb, glow=glow))
        corner = [
            (nose - 0.42, side * (w + TILL_SHUT_M), low + 0.02),
            (nose - 0.1, side * (w + TILL_SHUT_M), low - 0.02),
            (nose - 0.06, side * (w + TILL_SHUT_M), low + 0.06),
            (nose - 0.4, side * (w + TILL_SHUT_M), low + 0.13),
        ]
        parts.append(quad(corner, (0.72, 0.74, 0.78)))
        top = shape.body[0][1] - 0.02
        red: Rgb = (0.55, 0.05, 0.05)
        parts.append(upright(tail, (near, far), (top - 0.2, top), red, glow=glow))
    grille: Rgb = (0.06, 0.06, 0.06)
    parts.append(upright(nose, (-0.45, 0.45), (low - 0.3, low - 0.14), grille))
    plate_z = shape.body[0][1] - 0.3
    plate: Rgb = (0.85, 0.83, 0.6)
    parts.append(upright(tail, (-0.16, 0.16), (plate_z, plate_z + 0.16), plate))
    return parts
