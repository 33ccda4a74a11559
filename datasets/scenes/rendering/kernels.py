"""Drawing loops, compiled by Numba for one thread, with equal pixels on all machines.

Camera axes are x right, y down, z ahead. Objects are drawn with ``samples`` by ``samples`` samples
per pixel into a depth buffer of 1/z. Ground and sky have no edges and are drawn once per pixel.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.compiled import kept

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]

NEAR_M: Final = 0.25
OPAQUE: Final = 110
MAX_TAPS: Final = 7
# Max distance at which fine grain of the ground is visible.
GRAIN_M: Final = 40.0
# Vertical component of a ray below which it meets the ground.
HORIZON: Final = -0.002


class Lens(NamedTuple):
    """Focal length and optical centre in samples."""

    focal: float
    cx: float
    cy: float


class Eye(NamedTuple):
    """Rotation from world axes to those of the camera, or back, and the camera's position."""

    axes: Float64s
    at: Float64s


class Haze(NamedTuple):
    """Density and colour of the haze."""

    per_m: float
    colour: Float64s


class Textures(NamedTuple):
    """All texels, (N, 4); offset, width and height of each texture's levels, (K, 9, 3)."""

    atlas: Bytes
    places: Int64s


class Buffers(NamedTuple):
    """Buffers of the samples: 1/z, colour, and number of the object."""

    depth: Float32s
    colour: Bytes
    owner: NDArray[np.int16]


class Kernels(NamedTuple):
    """The compiled loops."""

    draw: Callable[..., None]
    cover: Callable[..., int]
    compose: Callable[..., None]
    develop: Callable[..., None]


@cache
def compile_kernels() -> Kernels:
    """Compile the loops, or load them from the cache of an earlier process."""
    return Kernels(kept(draw_triangles), kept(cover), kept(compose), kept(develop))


def draw_triangles(
    order: Int64s,
    corners: Float32s,
    uv: Float32s,
    texture: Int32s,
    tint: Float32s,
    instance: Int32s,
    shift: Float32s,
    eye: Eye,
    lens: Lens,
    haze: Haze,
    textures: Textures,
    buffers: Buffers,
) -> None:
    """Draw triangles into the sample buffers, in the given order; nearest first is fastest.

    corners: (T, 3, 3) in world metres. uv: (T, 3, 2) in texture widths. tint: (T, 3), light times
    albedo. shift: (3,), added to all corners.
    """
    seen = np.zeros((3, 5))
    polygon = np.zeros((4, 5))
    triangle = np.zeros((3, 5))
    for t in order:
        for k in range(3):
            _to_eye(corners[t, k], shift, eye, seen[k])
            seen[k, 3] = uv[t, k, 0]
            seen[k, 4] = uv[t, k, 1]
        size = _clip(seen, polygon)
        for fan in range(1, size - 1):
            triangle[0] = polygon[0]
            triangle[1] = polygon[fan]
            triangle[2] = polygon[fan + 1]
            _fill(triangle, texture[t], tint[t], instance[t], lens, haze, textures, buffers)


def _to_eye(corner: Float32s, shift: Float32s, eye: Eye, seen: Float64s) -> None:
    x = corner[0] + shift[0] - eye.at[0]
    y = corner[1] + shift[1] - eye.at[1]
    z = corner[2] + shift[2] - eye.at[2]
    for r in range(3):
        seen[r] = eye.axes[r, 0] * x + eye.axes[r, 1] * y + eye.axes[r, 2] * z


def _clip(eye: Float64s, polygon: Float64s) -> int:
    """Clip a triangle at the near plane, and return the number of corners: 0, 3 or 4."""
    size = 0
    for k in range(3):
        after = (k + 1) % 3
        inside = eye[k, 2] > NEAR_M
        if inside:
            polygon[size] = eye[k]
            size += 1
        if inside != (eye[after, 2] > NEAR_M):
            s = (NEAR_M - eye[k, 2]) / (eye[after, 2] - eye[k, 2])
            polygon[size] = eye[k] + s * (eye[after] - eye[k])
            size += 1
    return size


def _fill(
    triangle: Float64s,
    which: int,
    tint: Float32s,
    instance: int,
    lens: Lens,
    haze: Haze,
    textures: Textures,
    buffers: Buffers,
) -> None:
    """Draw a triangle (3, 5) of x, y, z, u, v ahead of the camera; ``which`` < 0: no texture."""
    focal, cx, cy = lens
    atlas, places = textures
    depth, colour, owner = buffers
    high, wide = depth.shape
    ia, ib, ic = 1.0 / triangle[0, 2], 1.0 / triangle[1, 2], 1.0 / triangle[2, 2]
    xa, ya = focal * triangle[0, 0] * ia + cx, focal * triangle[0, 1] * ia + cy
    xb, yb = focal * triangle[1, 0] * ib + cx, focal * triangle[1, 1] * ib + cy
    xc, yc = focal * triangle[2, 0] * ic + cx, focal * triangle[2, 1] * ic + cy
    left, right = min(xa, xb, xc), max(xa, xb, xc)
    top, bottom = min(ya, yb, yc), max(ya, yb, yc)
    if right < 0 or left >= wide or bottom < 0 or top >= high:
        return
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    if abs(area) < 1e-9:
        return
    # 1/z, u/z and v/z are linear over the picture: value = p + q (x - xa) + r (y - ya).
    ua, ub, uc = triangle[0, 3] * ia, triangle[1, 3] * ib, triangle[2, 3] * ic
    va, vb, vc = triangle[0, 4] * ia, triangle[1, 4] * ib, triangle[2, 4] * ic
    qi = ((ib - ia) * (yc - ya) - (ic - ia) * (yb - ya)) / area
    ri = ((ic - ia) * (xb - xa) - (ib - ia) * (xc - xa)) / area
    qu = ((ub - ua) * (yc - ya) - (uc - ua) * (yb - ya)) / area
    ru = ((uc - ua) * (xb - xa) - (ub - ua) * (xc - xa)) / area
    qv = ((vb - va) * (yc - ya) - (vc - va) * (yb - ya)) / area
    rv = ((vc - va) * (xb - xa) - (vb - va) * (xc - xa)) / area
    level = 0
    if which >= 0:
        level = _texture_level(triangle, area, places[which])
    first = max(0, math.ceil(top - 0.5))
    last = min(high - 1, math.floor(bottom - 0.5))
    for row in range(first, last + 1):
        y = row + 0.5
        begin, end = _columns(xa, ya, xb, yb, xc, yc, y, wide)
        for column in range(begin, end):
            dx = column + 0.5 - xa
            near = ia + qi * dx + ri * (y - ya)
            if near <= depth[row, column]:
                continue
            red = tint[0]
            green = tint[1]
            blue = tint[2]
            if which >= 0:
                u = (ua + qu * dx + ru * (y - ya)) / near
                v = (va + qv * dx + rv * (y - ya)) / near
                at = _texel(u, v, places[which, level])
                if atlas[at, 3] < OPAQUE:
                    continue
                red *= atlas[at, 0]
                green *= atlas[at, 1]
                blue *= atlas[at, 2]
            else:
                red *= 255.0
                green *= 255.0
                blue *= 255.0
            hazy = haze.per_m / (haze.per_m + near)
            red += hazy * (haze.colour[0] - red)
            green += hazy * (haze.colour[1] - green)
            blue += hazy * (haze.colour[2] - blue)
            depth[row, column] = near
            colour[row, column, 0] = min(255.0, max(0.0, red))
            colour[row, column, 1] = min(255.0, max(0.0, green))
            colour[row, column, 2] = min(255.0, max(0.0, blue))
            owner[row, column] = instance


def _texture_level(triangle: Float64s, area: float, levels: Int64s) -> int:
    """Return the texture level whose texels are about as large as samples; 0 is the finest."""
    wide, high = levels[0, 1], levels[0, 2]
    u0, u1, u2 = triangle[0, 3] * wide, triangle[1, 3] * wide, triangle[2, 3] * wide
    v0, v1, v2 = triangle[0, 4] * high, triangle[1, 4] * high, triangle[2, 4] * high
    texels = abs((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
    ratio = texels / abs(area)
    level = 0
    while ratio > 2.0 and level < 8:
        ratio *= 0.25
        level += 1
    return level


def _texel(u: float, v: float, place: Int64s) -> int:
    wide, high = place[1], place[2]
    x = min(int((u - math.floor(u)) * wide), wide - 1)
    y = min(int((v - math.floor(v)) * high), high - 1)
    return int(place[0] + y * wide + x)


def _columns(
    xa: float, ya: float, xb: float, yb: float, xc: float, yc: float, y: float, wide: int
) -> tuple[int, int]:
    """Return the half-open range of columns whose centres are in a triangle at height ``y``."""
    x0 = 1e9
    x1 = -1e9
    if (ya <= y) != (yb <= y):
        x = xa + (y - ya) * (xb - xa) / (yb - ya)
        x0 = min(x0, x)
        x1 = max(x1, x)
    if (yb <= y) != (yc <= y):
        x = xb + (y - yb) * (xc - xb) / (yc - yb)
        x0 = min(x0, x)
        x1 = max(x1, x)
    if (yc <= y) != (ya <= y):
        x = xc + (y - yc) * (xa - xc) / (ya - yc)
        x0 = min(x0, x)
        x1 = max(x1, x)
    return max(0, math.ceil(x0 - 0.5)), min(wide, math.ceil(x1 - 0.5))


def cover(
    corners: Float32s, shift: Float32s, eye: Eye, lens: Lens, covered: Bytes, left: int, top: int
) -> int:
    """Mark the samples that triangles cover, ignoring occlusion, and return their number.

    ``covered`` is a window of the sample buffer whose first sample is (top, left). Triangles that
    extend behind the camera are omitted.
    """
    high, wide = covered.shape
    count = 0
    px = np.zeros(3)
    py = np.zeros(3)
    seen = np.zeros(3)
    for t in range(corners.shape[0]):
        behind = False
        for k in range(3):
            _to_eye(corners[t, k], shift, eye, seen)
            if seen[2] <= NEAR_M:
                behind = True
                break
            px[k] = lens.cx - left + lens.focal / seen[2] * seen[0]
            py[k] = lens.cy - top + lens.focal / seen[2] * seen[1]
        if behind:
            continue
        first = max(0, math.ceil(min(py[0], py[1], py[2]) - 0.5))
        last = min(high - 1, math.floor(max(py[0], py[1], py[2]) - 0.5))
        for row in range(first, last + 1):
            begin, end = _columns(px[0], py[0], px[1], py[1], px[2], py[2], row + 0.5, wide)
            for column in range(begin, end):
                if covered[row, column] == 0:
                    covered[row, column] = 1
                    count += 1
    return count


def compose(
    buffers: Buffers,
    samples: int,
    ground: Bytes,
    levels: Int64s,
    ground_x0: float,
    ground_y0: float,
    texels_per_m: float,
    grain: Bytes,
    light: Float64s,
    shadow: Bytes,
    shine: float,
    sky: Bytes,
    eye: Eye,
    lens: Lens,
    haze: Haze,
    picture: Bytes,
    mask: NDArray[np.int16],
) -> None:
    """Compose objects, ground and sky, one pixel after another.

    ground: all levels of the ground map, flat (N, 4), with the grain's strength as fourth channel.
    levels: (L, 3): offset, width, height. shadow: (H, W), 255 for full light. shine: reflectivity
    of a wet road. eye: rotation to world axes. mask: object that covers at least half of the pixel,
    or -1.
    """
    world_axes, camera_at = eye
    focal, cx, cy = lens
    high, wide, _ = picture.shape
    whole = samples * samples
    for row in range(high):
        for column in range(wide):
            red, green, blue, filled, mask[row, column] = _objects(
                buffers, row * samples, column * samples, samples
            )
            if filled < whole:
                dx = (column + 0.5 - cx) / focal
                dy = (row + 0.5 - cy) / focal
                wx = world_axes[0, 0] * dx + world_axes[0, 1] * dy + world_axes[0, 2]
                wy = world_axes[1, 0] * dx + world_axes[1, 1] * dy + world_axes[1, 2]
                wz = world_axes[2, 0] * dx + world_axes[2, 1] * dy + world_axes[2, 2]
                up = wz / math.sqrt(wx * wx + wy * wy + wz * wz)
                back0, back1, back2 = 0.0, 0.0, 0.0
                if up >= HORIZON or shine > 0.0:
                    back0, back1, back2 = _sky(sky, wx, wy, up)
                if up < HORIZON:
                    reach = -camera_at[2] / wz
                    gx = (camera_at[0] + reach * wx - ground_x0) * texels_per_m
                    gy = (camera_at[1] + reach * wy - ground_y0) * texels_per_m
                    across = reach / focal * texels_per_m
                    g0, g1, g2, g3 = _ground(ground, levels, gx, gy, across, wx, wy, up)
                    bright = shadow[row, column] / 255.0
                    if reach < GRAIN_M:
                        x, y = camera_at[0] + reach * wx, camera_at[1] + reach * wy
                        bright *= _grain(grain, x, y, reach, g3)
                    g0 *= light[0] * bright
                    g1 *= light[1] * bright
                    g2 *= light[2] * bright
                    if shine > 0.0:
                        mirror = shine * (0.15 + 0.85 * (1.0 + up) ** 4)
                        g0 += mirror * (back0 - g0)
                        g1 += mirror * (back1 - g1)
                        g2 += mirror * (back2 - g2)
                    hazy = haze.per_m * reach / (1.0 + haze.per_m * reach)
                    back0 = g0 + hazy * (haze.colour[0] - g0)
                    back1 = g1 + hazy * (haze.colour[1] - g1)
                    back2 = g2 + hazy * (haze.colour[2] - g2)
                rest = whole - filled
                red += rest * back0
                green += rest * back1
                blue += rest * back2
            picture[row, column, 0] = min(255.0, max(0.0, red / whole + 0.5))
            picture[row, column, 1] = min(255.0, max(0.0, green / whole + 0.5))
            picture[row, column, 2] = min(255.0, max(0.0, blue / whole + 0.5))


def _objects(
    buffers: Buffers, top: int, left: int, samples: int
) -> tuple[float, float, float, int, int]:
    """Return a pixel's sum of sample colours, number of filled samples, and object.

    The object covers at least half of the pixel; -1 without object.
    """
    depth, colour, owner = buffers
    whole = samples * samples
    red, green, blue = 0.0, 0.0, 0.0
    filled, owned, votes = 0, -1, 0
    for r in range(top, top + samples):
        for c in range(left, left + samples):
            if depth[r, c] > 0.0:
                filled += 1
                red += colour[r, c, 0]
                green += colour[r, c, 1]
                blue += colour[r, c, 2]
                this = int(owner[r, c])
                if this >= 0:
                    if this == owned:
                        votes += 1
                    elif votes == 0:
                        owned = this
                        votes = 1
                    elif whole == 4:
                        votes -= 1
    if owned >= 0:
        votes = 0
        for r in range(top, top + samples):
            for c in range(left, left + samples):
                if depth[r, c] > 0.0 and owner[r, c] == owned:
                    votes += 1
        if 2 * votes < whole:
            owned = -1
    return red, green, blue, filled, owned


def _sky(sky: Bytes, wx: float, wy: float, up: float) -> tuple[float, float, float]:
    """Return the sky's colour in the direction of a ray, or of its reflection on the ground."""
    high, wide, _ = sky.shape
    turn = math.atan2(wy, wx) / (2 * math.pi) + 0.5
    x = min(int(turn * wide), wide - 1)
    y = min(int(abs(up) * (high - 1)), high - 1)
    return float(sky[y, x, 0]), float(sky[y, x, 1]), float(sky[y, x, 2])


def _ground(
    ground: Bytes,
    levels: Int64s,
    gx: float,
    gy: float,
    across: float,
    wx: float,
    wy: float,
    up: float,
) -> tuple[float, float, float, float]:
    """Return colour and strength of the grain around texel (gx, gy), averaged along the ray.

    across: width of the pixel in texels. A pixel is longer along the ray than across, so several
    positions are averaged.
    """
    flat = math.sqrt(wx * wx + wy * wy)
    along = across / (-up)
    taps = min(MAX_TAPS, max(1, int(min(along / across, 1.5 * along) + 0.5)))
    texel = max(across, along / taps)
    level = 0
    while texel > 1.5 and level < levels.shape[0] - 1:
        texel *= 0.5
        level += 1
    shrink = 1.0 / (1 << level)
    w = levels[level, 1]
    h = levels[level, 2]
    stepx = along * wx / flat / taps
    stepy = along * wy / flat / taps
    g0, g1, g2, g3 = 0.0, 0.0, 0.0, 0.0
    for tap in range(taps):
        off = tap - 0.5 * (taps - 1)
        px = min(max((gx + off * stepx) * shrink - 0.5, 0.0), w - 1.001)
        py = min(max((gy + off * stepy) * shrink - 0.5, 0.0), h - 1.001)
        ix = int(px)
        iy = int(py)
        at = levels[level, 0] + iy * w + ix
        g0 += _between(ground, at, w, 0, px - ix, py - iy)
        g1 += _between(ground, at, w, 1, px - ix, py - iy)
        g2 += _between(ground, at, w, 2, px - ix, py - iy)
        g3 += ground[at, 3]
    return g0 / taps, g1 / taps, g2 / taps, g3 / taps


def _between(ground: Bytes, at: int, wide: int, k: int, fx: float, fy: float) -> float:
    return float(
        (1 - fx) * (1 - fy) * ground[at, k]
        + fx * (1 - fy) * ground[at + 1, k]
        + (1 - fx) * fy * ground[at + wide, k]
        + fx * fy * ground[at + wide + 1, k]
    )


def _grain(grain: Bytes, x_m: float, y_m: float, reach: float, strength: float) -> float:
    """Return the brightness of fine grain on the ground: 2 cm per texel, fading with distance."""
    size = grain.shape[0]
    fade = min(1.0, 8.0 / reach) * (1.0 - reach / GRAIN_M)
    dark = (grain[int(y_m * 50.0) % size, int(x_m * 50.0) % size] - 128.0) / 230.0
    return float(1.0 + fade * strength / 255.0 * dark)


def develop(
    picture: Bytes,
    noise: NDArray[np.int8],
    noise_row: int,
    noise_column: int,
    noise_scale: float,
    vignette: float,
    veil: Float64s,
    sun_x: float,
    sun_y: float,
    flare: float,
    contrast: float,
) -> None:
    """Apply effects of lens and sensor in place: vignette, glare of the sun, contrast, noise."""
    high, wide, _ = picture.shape
    size = noise.shape[0]
    reach = 1.0 / (0.25 * (wide * wide + high * high))
    for row in range(high):
        y = row - 0.5 * high
        for column in range(wide):
            x = column - 0.5 * wide
            dim = 1.0 - vignette * (x * x + y * y) * reach
            glow = 0.0
            if flare > 0.0:
                away = ((column - sun_x) ** 2 + (row - sun_y) ** 2) * reach
                glow = flare * (0.28 / (1.0 + 14.0 * away) + 1.6 / (1.0 + 900.0 * away))
            grain = noise_scale * noise[(row + noise_row) % size, (column + noise_column) % size]
            for k in range(3):
                value = picture[row, column, k] * dim
                value = 110.0 + contrast * (value - 110.0)
                value += glow * veil[k]
                value += grain * (0.6 + 0.4 * math.sqrt(max(value, 0.0) / 128.0))
                picture[row, column, k] = min(255.0, max(0.0, value + 0.5))
