"""Map of the ground from above: asphalt, lines, kerbs, sidewalks, driveways, lots and grass."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from crosscue.datasets.scenes.layout import NEAR_KERB_M, PARKING_LANE_M, Layout
from crosscue.replay.columns import Floats, Int64s

from .textures import smooth_noise

X_M: Final = (-112.0, 112.0)
Y_M: Final = (-64.0, 64.0)
TEXELS_PER_M: Final = 16
CORNER_M: Final = 5.0
WHITE: Final = (206, 206, 200)
YELLOW: Final = (212, 170, 52)
ASPHALT: Final = (104, 104, 106)
CONCRETE: Final = (168, 164, 156)
KERB: Final = (190, 187, 178)
GRASS: Final = (100, 114, 64)

Map = NDArray[np.uint8]
OfGround = TypeVar("OfGround", NDArray[np.uint8], NDArray[np.bool_])


@dataclass(frozen=True, slots=True)
class Patch:
    """A rectangle of ground.

    Attributes:
        x: Start and end along x.
        y: Start and end along y.
        kind: ``asphalt`` or ``concrete``.
    """

    x: tuple[float, float]
    y: tuple[float, float]
    kind: str = "asphalt"


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """The map at all levels of resolution.

    Attributes:
        texels: Colour, and strength of fine grain, shape (N, 4).
        levels: Offset, width and height of each level, shape (L, 3).
        road: Mask of drivable road at the finest level, shape (H, W), bool.
    """

    texels: Map
    levels: Int64s
    road: NDArray[np.bool_]


class _Canvas:
    def __init__(self) -> None:
        wide = round((X_M[1] - X_M[0]) * TEXELS_PER_M)
        high = round((Y_M[1] - Y_M[0]) * TEXELS_PER_M)
        self.map = np.zeros((high, wide, 4), np.uint8)

    def polygon(self, where: NDArray[np.generic], points: object, value: object) -> None:
        xy = np.asarray(points, np.float64)
        texels = (xy - np.array([X_M[0], Y_M[0]])) * TEXELS_PER_M
        fixed = np.rint(texels * 16).astype(np.int32)
        cv2.fillPoly(where, [fixed], value, cv2.LINE_AA if where.ndim == 3 else cv2.LINE_8, 4)  # type: ignore[call-overload]

    def rectangle(
        self, where: NDArray[np.generic], x: Sequence[float], y: Sequence[float], value: object
    ) -> None:
        points = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
        self.polygon(where, points, value)

    def line(self, x: Sequence[float], y: Sequence[float], rgb: tuple[int, int, int]) -> None:
        self.rectangle(self.map, x, y, (*rgb, 40))


def road_mask(layout: Layout) -> NDArray[np.uint8]:
    """Return a mask with 255 for road, with rounded corners; rows by y, columns by x."""
    canvas = _Canvas()
    mask = np.zeros(canvas.map.shape[:2], np.uint8)
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    canvas.rectangle(mask, (X_M[0] - 5, far), (-w, w), 255)
    y0 = Y_M[0] - 5 if layout.has_right else -w
    y1 = Y_M[1] + 5 if layout.has_left else w
    canvas.rectangle(mask, (near, far), (y0, y1), 255)
    if layout.has_ahead:
        canvas.rectangle(mask, (far - 1, X_M[1] + 5), (-w, w), 255)
    for has_arm, side in ((layout.has_left, 1.0), (layout.has_right, -1.0)):
        if has_arm:
            _corner(canvas, mask, (near, side * w), (-1.0, side))
            if layout.has_ahead:
                _corner(canvas, mask, (far, side * w), (1.0, side))
    return mask


def _corner(
    canvas: _Canvas, mask: NDArray[np.uint8], at: tuple[float, float], out: tuple[float, float]
) -> None:
    """Round a kerb: fill the square at the corner except a quarter disc."""
    angle = np.linspace(0.0, np.pi / 2, 12)
    arc_x = at[0] + out[0] * CORNER_M * (1 - np.cos(angle))
    arc_y = at[1] + out[1] * CORNER_M * (1 - np.sin(angle))
    points = np.column_stack([np.append(arc_x, at[0]), np.append(arc_y, at[1])])
    canvas.polygon(mask, points, 255)


def paint(
    layout: Layout, patches: Sequence[Patch], rng: Generator
) -> tuple[Map, NDArray[np.bool_]]:
    """Return the ground in full light, and the mask of road."""
    canvas = _Canvas()
    patchy = smooth_noise(rng, 512, 8).astype(np.float32)
    fine = smooth_noise(rng, 512, 128).astype(np.float32)
    road = road_mask(layout)
    away = cv2.distanceTransform(255 - road, cv2.DIST_L2, 5) / TEXELS_PER_M
    stone = 0.9 + 0.1 * patchy + 0.08 * fine
    tar = 0.84 + 0.18 * patchy + 0.10 * fine
    _put(canvas.map, None, GRASS, 0.72 + 0.36 * patchy + 0.24 * fine, 120)
    if layout.is_town:
        _put(canvas.map, (away > 1.3) & (away < 9.0), CONCRETE, 0.9 * stone, 30)
    walk = (away > 1.3) & (away < 3.1)
    _put(canvas.map, walk, CONCRETE, stone, 30)
    _joints(canvas.map, walk)
    paved = np.zeros_like(road)
    for patch in patches:
        area = np.zeros_like(road)
        canvas.rectangle(area, patch.x, patch.y, 255)
        paved |= area
        is_tar = patch.kind == "asphalt"
        _put(
            canvas.map,
            (area > 0) & (away > 0),
            ASPHALT if is_tar else CONCRETE,
            0.92 * tar if is_tar else stone,
            60 if is_tar else 30,
        )
    _put(canvas.map, (away > 0) & (away < 0.22) & (paved == 0), KERB, stone, 20)
    is_road = road > 0
    _put(canvas.map, is_road, ASPHALT, tar, 80)
    inside = cv2.distanceTransform(road, cv2.DIST_L2, 5) / TEXELS_PER_M
    _dim(canvas.map, is_road & (inside < 0.3), 0.8)
    _wear(canvas, layout, rng, is_road)
    _lines(canvas, layout)
    for patch in patches:
        if patch.x[1] - patch.x[0] > 12.0:
            _stalls(canvas, patch)
    return canvas.map, is_road


def _put(
    canvas: Map,
    where: NDArray[np.bool_] | None,
    rgb: tuple[int, int, int],
    light: NDArray[np.floating],
    grain: int,
) -> None:
    """Write colour times light everywhere or in a mask; ``light`` is a repeated tile."""
    tile = np.empty((*light.shape, 4), np.uint8)
    for k, value in enumerate(rgb):
        tile[..., k] = np.minimum(value * light, 255.0).astype(np.uint8)
    tile[..., 3] = grain
    # A texel's four bytes are copied as one number.
    texels = _tiled(tile.view(np.uint32)[..., 0], *canvas.shape[:2])
    np.copyto(canvas.view(np.uint32)[..., 0], texels, where=True if where is None else where)


def _dim(canvas: Map, where: NDArray[np.bool_], factor: float) -> None:
    canvas[where, :3] = (canvas[where, :3] * factor).astype(np.uint8)


def _tiled(tile: NDArray[np.uint32], high: int, wide: int) -> NDArray[np.uint32]:
    size = len(tile)
    return np.tile(tile, (-(-high // size), -(-wide // size)))[:high, :wide]


def _joints(canvas: Map, walk: NDArray[np.bool_]) -> None:
    every = round(1.5 * TEXELS_PER_M)
    joint = np.zeros_like(walk)
    joint[::every] = True
    joint[:, ::every] = True
    joint &= walk
    _dim(canvas, joint, 0.82)


def _wear(canvas: _Canvas, layout: Layout, rng: Generator, is_road: NDArray[np.bool_]) -> None:
    dark: NDArray[np.uint8] = np.zeros(is_road.shape, np.uint8)
    lane = layout.half_width_m / 2
    for side in (-1, 1):
        for track in (-0.8, 0.8):
            y = side * lane + track
            canvas.rectangle(dark, (X_M[0], 0.0), (y - 0.3, y + 0.3), 26)
            if layout.has_ahead:
                canvas.rectangle(dark, (layout.far_kerb_m, X_M[1]), (y - 0.3, y + 0.3), 26)
    for _ in range(26):
        x, y = rng.uniform(X_M[0], X_M[1]), rng.uniform(-layout.half_width_m, layout.half_width_m)
        size = rng.uniform(0.5, 4.0), rng.uniform(0.4, 1.6)
        canvas.rectangle(dark, (x, x + size[0]), (y, y + size[1]), int(rng.integers(20, 60)))
    dark = cv2.GaussianBlur(dark, (0, 0), 3.0).astype(np.uint8)
    for _ in range(60):
        at = np.array([rng.uniform(*X_M), rng.uniform(-layout.half_width_m, layout.half_width_m)])
        turn = rng.uniform(0, 2 * np.pi)
        walk = [at]
        for _ in range(12):
            turn += rng.normal(0, 0.5)
            walk.append(walk[-1] + 0.4 * np.array([np.cos(turn), np.sin(turn)]))
        texels = (np.array(walk) - np.array([X_M[0], Y_M[0]])) * TEXELS_PER_M
        cv2.polylines(dark, [np.rint(texels).astype(np.int32)], False, 90, 1)
    dark[~is_road] = 0
    for k in range(3):
        canvas.map[..., k] = cv2.multiply(canvas.map[..., k], 255 - dark, scale=1 / 255)


def _lines(canvas: _Canvas, layout: Layout) -> None:
    w, near, far = layout.half_width_m, NEAR_KERB_M, layout.far_kerb_m
    if layout.has_ahead and not layout.is_intersection:
        _lines_along(canvas, layout)
        return
    for y in (-0.17, 0.17):
        canvas.line((X_M[0], -0.6), (y - 0.055, y + 0.055), YELLOW)
        if layout.has_ahead and not layout.ahead_is_closed:
            canvas.line((far + CORNER_M, X_M[1]), (y - 0.055, y + 0.055), YELLOW)
    if layout.has_parking_lane:
        for y in (-w + PARKING_LANE_M, w - PARKING_LANE_M):
            canvas.line((X_M[0], -7.0), (y - 0.05, y + 0.05), WHITE)
            if layout.has_ahead:
                canvas.line((far + CORNER_M + 5, X_M[1]), (y - 0.05, y + 0.05), WHITE)
    if layout.control != "none":
        canvas.line((-0.65, -0.2), sorted((layout.own * (w - 0.3), layout.own * 0.35)), WHITE)
        _crosswalk(canvas, (0.9, 3.3), w)
        if layout.has_ahead:
            _crosswalk(canvas, (far + 1.2, far + 3.6), w)
    _cross_lines(canvas, layout, near, far)


def _lines_along(canvas: _Canvas, layout: Layout) -> None:
    for y in (-0.17, 0.17):
        canvas.line(X_M, (y - 0.055, y + 0.055), YELLOW)
    if layout.has_parking_lane:
        side = layout.half_width_m - PARKING_LANE_M
        for y in (-side, side):
            canvas.line(X_M, (y - 0.05, y + 0.05), WHITE)


def _crosswalk(canvas: _Canvas, x: tuple[float, float], half_m: float) -> None:
    for y in np.arange(-half_m + 0.5, half_m - 0.4, 1.1):
        canvas.line(x, (float(y), float(y) + 0.5), WHITE)


def _cross_lines(canvas: _Canvas, layout: Layout, near: float, far: float) -> None:
    middle, w = (near + far) / 2, layout.half_width_m
    arms = ((layout.has_left, 1.0, Y_M[1]), (layout.has_right, -1.0, Y_M[1]))
    for has_arm, side, reach in arms:
        if not has_arm:
            continue
        begin = w + CORNER_M
        if layout.one_way:
            for y in np.arange(begin, reach, 9.0):
                canvas.line((middle - 0.06, middle + 0.06), (side * y, side * (y + 3.0)), WHITE)
            continue
        for x in (middle - 0.17, middle + 0.17):
            canvas.line((x - 0.055, x + 0.055), (side * begin, side * reach), YELLOW)


def _stalls(canvas: _Canvas, patch: Patch) -> None:
    y0, y1 = patch.y
    for x in np.arange(patch.x[0] + 1.0, patch.x[1] - 0.5, 2.75):
        canvas.line((x - 0.05, x + 0.05), (y0 + 0.4, y0 + 5.2), WHITE)
        if y1 - y0 > 15.0:
            canvas.line((x - 0.05, x + 0.05), (y1 - 5.2, y1 - 0.4), WHITE)


def with_levels(painted: Map, road: NDArray[np.bool_]) -> Ground:
    """Return the map with its mipmap levels."""
    parts, levels, used = [], [], 0
    level = painted
    while min(level.shape[:2]) >= 32:
        high, wide = level.shape[:2]
        levels.append((used, wide, high))
        parts.append(level.reshape(-1, 4))
        used += high * wide
        level = np.asarray(
            cv2.resize(level, (wide // 2, high // 2), interpolation=cv2.INTER_AREA), np.uint8
        )
    return Ground(np.concatenate(parts), np.array(levels, np.int64), road)


def unpainted(layout: Layout) -> Ground:
    """Return the map of road only, without colours."""
    nothing = np.zeros((1, 4), np.uint8)
    road = along_curve(layout, road_mask(layout) > 0)
    return Ground(nothing, np.zeros((1, 3), np.int64), road)


def along_curve(layout: Layout, of_ground: OfGround) -> OfGround:
    """Apply the road's gentle curve to a map of the ground with a straight road."""
    if layout.curve_per_m == 0.0:
        return of_ground
    high, wide = of_ground.shape[:2]
    aside_m = layout.aside_m(X_M[0] + (np.arange(wide) + 0.5) / TEXELS_PER_M)
    rows = np.arange(high)[:, None] - np.rint(aside_m * TEXELS_PER_M).astype(np.int64)
    return of_ground[np.clip(rows, 0, high - 1), np.arange(wide)]


def cast_shadows(
    painted: Map, outlines: Sequence[Floats], blobs: Sequence[Floats], remains: float
) -> None:
    """Darken the map in place.

    Args:
        painted: The map.
        outlines: Convex outlines of solids' shadows in metres, (K, 2) each.
        blobs: Rows of x, y, radius along and across, and direction of trees' shadows.
        remains: Fraction of light in shadow.
    """
    canvas = _Canvas()
    light = np.full(painted.shape[:2], 255, np.uint8)
    for outline in outlines:
        canvas.polygon(light, outline, 0)
    for x, y, along, across, turn in blobs:
        centre = ((x - X_M[0]) * TEXELS_PER_M, (y - Y_M[0]) * TEXELS_PER_M)
        axes = (2 * along * TEXELS_PER_M, 2 * across * TEXELS_PER_M)
        cv2.ellipse(light, (centre, axes, float(np.rad2deg(turn))), 0, -1)
    light = cv2.GaussianBlur(light, (0, 0), 3.0).astype(np.uint8)
    factor = (remains + (1.0 - remains) * light.astype(np.float32) / 255.0)[..., None]
    painted[..., :3] = (painted[..., :3] * factor).astype(np.uint8)
