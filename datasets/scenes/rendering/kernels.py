"""The loops that draw, compiled by Numba on one thread: the same pixels on every machine and run.

Camera axes are x right, y down, z ahead. Objects are drawn with ``samples`` by ``samples`` samples
a pixel into a depth buffer of 1/z; ground and sky, which have no edges, once a pixel.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]

NEAR_M: Final = 0.25
OPAQUE: Final = 110
MAX_TAPS: Final = 7


class Kernels(NamedTuple):
    """The compiled loops."""

    draw: Callable[..., None]
    cover: Callable[..., int]
    compose: Callable[..., None]
    develop: Callable[..., None]


@cache
def compiled() -> Kernels:
    """Compile, or load what an earlier process compiled."""
    from numba import njit

    loops: tuple[Callable[..., Any], ...] = (draw, cover, compose, develop)
    try:
        return Kernels(*(njit(cache=True, nogil=True)(loop) for loop in loops))
    except RuntimeError:  # no folder to keep compiled code in
        return Kernels(*(njit(nogil=True)(loop) for loop in loops))


def draw(
    order: Int64s,
    corners: Float32s,
    uv: Float32s,
    texture: Int32s,
    tint: Float32s,
    instance: Int32s,
    shift: Float32s,
    eye_axes: Float64s,
    camera_at: Float64s,
    focal: float,
    cx: float,
    cy: float,
    haze_per_m: float,
    haze: Float64s,
    atlas: Bytes,
    places: Int64s,
    depth: Float32s,
    colour: Bytes,
    owner: NDArray[np.int16],
) -> None:
    """Triangles into the sample buffers, in the order given: nearest first spares work.

    corners (T, 3, 3) world metres, uv (T, 3, 2) texture widths, tint (T, 3) light times albedo,
    shift (3,) added to all corners; places (K, 9, 3): offset, width, height of a texture's levels.
    """
    high, wide = depth.shape
    polygon = np.zeros((4, 5))
    eye = np.zeros((3, 5))
    for t in order:
        ahead = 0
        for k in range(3):
            x = corners[t, k, 0] + shift[0] - camera_at[0]
            y = corners[t, k, 1] + shift[1] - camera_at[1]
            z = corners[t, k, 2] + shift[2] - camera_at[2]
            for r in range(3):
                eye[k, r] = eye_axes[r, 0] * x + eye_axes[r, 1] * y + eye_axes[r, 2] * z
            eye[k, 3] = uv[t, k, 0]
            eye[k, 4] = uv[t, k, 1]
            if eye[k, 2] > NEAR_M:
                ahead += 1
        if ahead == 0:
            continue
        size = 0
        if ahead == 3:
            size = 3
            for k in range(3):
                for r in range(5):
                    polygon[k, r] = eye[k, r]
        else:
            for k in range(3):
                after = (k + 1) % 3
                inside = eye[k, 2] > NEAR_M
                if inside:
                    for r in range(5):
                        polygon[size, r] = eye[k, r]
                    size += 1
                if inside != (eye[after, 2] > NEAR_M):
                    s = (NEAR_M - eye[k, 2]) / (eye[after, 2] - eye[k, 2])
                    for r in range(5):
                        polygon[size, r] = eye[k, r] + s * (eye[after, r] - eye[k, r])
                    size += 1
        which = texture[t]
        for fan in range(size - 2):
            ia = 1.0 / polygon[0, 2]
            ib = 1.0 / polygon[fan + 1, 2]
            ic = 1.0 / polygon[fan + 2, 2]
            xa = focal * polygon[0, 0] * ia + cx
            ya = focal * polygon[0, 1] * ia + cy
            xb = focal * polygon[fan + 1, 0] * ib + cx
            yb = focal * polygon[fan + 1, 1] * ib + cy
            xc = focal * polygon[fan + 2, 0] * ic + cx
            yc = focal * polygon[fan + 2, 1] * ic + cy
            left = min(xa, xb, xc)
            right = max(xa, xb, xc)
            top = min(ya, yb, yc)
            bottom = max(ya, yb, yc)
            if right < 0 or left >= wide or bottom < 0 or top >= high:
                continue
            area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
            if abs(area) < 1e-9:
                continue
            # 1/z, u/z and v/z are linear over the picture: value = p + q (x - xa) + r (y - ya).
            qi = ((ib - ia) * (yc - ya) - (ic - ia) * (yb - ya)) / area
            ri = ((ic - ia) * (xb - xa) - (ib - ia) * (xc - xa)) / area
            ua = polygon[0, 3] * ia
            ub = polygon[fan + 1, 3] * ib
            uc = polygon[fan + 2, 3] * ic
            qu = ((ub - ua) * (yc - ya) - (uc - ua) * (yb - ya)) / area
            ru = ((uc - ua) * (xb - xa) - (ub - ua) * (xc - xa)) / area
            va = polygon[0, 4] * ia
            vb = polygon[fan + 1, 4] * ib
            vc = polygon[fan + 2, 4] * ic
            qv = ((vb - va) * (yc - ya) - (vc - va) * (yb - ya)) / area
            rv = ((vc - va) * (xb - xa) - (vb - va) * (xc - xa)) / area
            level = 0
            if which >= 0:
                u0 = polygon[0, 3] * places[which, 0, 1]
                u1 = polygon[fan + 1, 3] * places[which, 0, 1]
                u2 = polygon[fan + 2, 3] * places[which, 0, 1]
                v0 = polygon[0, 4] * places[which, 0, 2]
                v1 = polygon[fan + 1, 4] * places[which, 0, 2]
                v2 = polygon[fan + 2, 4] * places[which, 0, 2]
                texels = abs((u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0))
                ratio = texels / abs(area)
                while ratio > 2.0 and level < 8:
                    ratio *= 0.25
                    level += 1
            first = max(0, math.ceil(top - 0.5))
            last = min(high - 1, math.floor(bottom - 0.5))
            for row in range(first, last + 1):
                y = row + 0.5
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
                begin = max(0, math.ceil(x0 - 0.5))
                end = min(wide - 1, math.ceil(x1 - 0.5) - 1)
                for column in range(begin, end + 1):
                    dx = column + 0.5 - xa
                    near = ia + qi * dx + ri * (y - ya)
                    if near <= depth[row, column]:
                        continue
                    red = tint[t, 0]
                    green = tint[t, 1]
                    blue = tint[t, 2]
                    if which >= 0:
                        u = (ua + qu * dx + ru * (y - ya)) / near
                        v = (va + qv * dx + rv * (y - ya)) / near
                        w = places[which, level, 1]
                        h = places[which, level, 2]
                        tx = min(int((u - math.floor(u)) * w), w - 1)
                        ty = min(int((v - math.floor(v)) * h), h - 1)
                        at = places[which, level, 0] + ty * w + tx
                        if atlas[at, 3] < OPAQUE:
                            continue
                        red *= atlas[at, 0]
                        green *= atlas[at, 1]
                        blue *= atlas[at, 2]
                    else:
                        red *= 255.0
                        green *= 255.0
                        blue *= 255.0
                    hazy = haze_per_m / (haze_per_m + near)
                    red += hazy * (haze[0] - red)
                    green += hazy * (haze[1] - green)
                    blue += hazy * (haze[2] - blue)
                    depth[row, column] = near
                    colour[row, column, 0] = min(255.0, max(0.0, red))
                    colour[row, column, 1] = min(255.0, max(0.0, green))
                    colour[row, column, 2] = min(255.0, max(0.0, blue))
                    owner[row, column] = instance[t]


def cover(
    corners: Float32s,
    shift: Float32s,
    eye_axes: Float64s,
    camera_at: Float64s,
    focal: float,
    cx: float,
    cy: float,
    covered: Bytes,
    left: int,
    top: int,
) -> int:
    """Mark the samples that triangles cover, whatever stands before them; how many comes back.

    ``covered`` is a window of the sample buffer whose first sample is (top, left). Triangles that
    reach behind the camera are left out.
    """
    high, wide = covered.shape
    count = 0
    px = np.zeros(3)
    py = np.zeros(3)
    for t in range(corners.shape[0]):
        behind = False
        for k in range(3):
            x = corners[t, k, 0] + shift[0] - camera_at[0]
            y = corners[t, k, 1] + shift[1] - camera_at[1]
            z = corners[t, k, 2] + shift[2] - camera_at[2]
            ahead = eye_axes[2, 0] * x + eye_axes[2, 1] * y + eye_axes[2, 2] * z
            if ahead <= NEAR_M:
                behind = True
                break
            px[k] = (
                cx
                - left
                + focal / ahead * (eye_axes[0, 0] * x + eye_axes[0, 1] * y + eye_axes[0, 2] * z)
            )
            py[k] = (
                cy
                - top
                + focal / ahead * (eye_axes[1, 0] * x + eye_axes[1, 1] * y + eye_axes[1, 2] * z)
            )
        if behind:
            continue
        first = max(0, math.ceil(min(py[0], py[1], py[2]) - 0.5))
        last = min(high - 1, math.floor(max(py[0], py[1], py[2]) - 0.5))
        for row in range(first, last + 1):
            y = row + 0.5
            x0 = 1e9
            x1 = -1e9
            for k in range(3):
                j = (k + 1) % 3
                if (py[k] <= y) != (py[j] <= y):
                    x = px[k] + (y - py[k]) * (px[j] - px[k]) / (py[j] - py[k])
                    x0 = min(x0, x)
                    x1 = max(x1, x)
            begin = max(0, math.ceil(x0 - 0.5))
            end = min(wide - 1, math.ceil(x1 - 0.5) - 1)
            for column in range(begin, end + 1):
                if covered[row, column] == 0:
                    covered[row, column] = 1
                    count += 1
    return count


def compose(
    depth: Float32s,
    colour: Bytes,
    owner: NDArray[np.int16],
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
    world_axes: Float64s,
    camera_at: Float64s,
    focal: float,
    cx: float,
    cy: float,
    haze_per_m: float,
    haze: Float64s,
    picture: Bytes,
    mask: NDArray[np.int16],
) -> None:
    """Objects over ground over sky, one pixel after another.

    ground: all levels of the ground map, flat (N, 4) with the grain's strength as fourth channel;
    levels (L, 3): offset, width, height. shadow: (H, W) of the picture, 255 where light is whole.
    shine: how much a wet road mirrors the sky. mask: object with at least half the pixel, or -1.
    """
    high, wide, _ = picture.shape
    whole = samples * samples
    sky_high, sky_wide, _ = sky.shape
    deepest = levels.shape[0] - 1
    grain_size = grain.shape[0]
    for row in range(high):
        for column in range(wide):
            red = 0.0
            green = 0.0
            blue = 0.0
            filled = 0
            owned = -1
            votes = 0
            for j in range(samples):
                for i in range(samples):
                    r = row * samples + j
                    c = column * samples + i
                    if depth[r, c] > 0.0:
                        filled += 1
                        red += colour[r, c, 0]
                        green += colour[r, c, 1]
                        blue += colour[r, c, 2]
                        this = owner[r, c]
                        if this >= 0:
                            if this == owned:
                                votes += 1
                            elif votes == 0:
                                owned = this
                                votes = 1
                            elif whole == 4:
                                votes -= 1
            mask[row, column] = -1
            if owned >= 0:
                votes = 0
                for j in range(samples):
                    for i in range(samples):
                        r = row * samples + j
                        c = column * samples + i
                        if depth[r, c] > 0.0 and owner[r, c] == owned:
                            votes += 1
                if 2 * votes >= whole:
                    mask[row, column] = owned
            if filled < whole:
                dx = (column + 0.5 - cx) / focal
                dy = (row + 0.5 - cy) / focal
                wx = world_axes[0, 0] * dx + world_axes[0, 1] * dy + world_axes[0, 2]
                wy = world_axes[1, 0] * dx + world_axes[1, 1] * dy + world_axes[1, 2]
                wz = world_axes[2, 0] * dx + world_axes[2, 1] * dy + world_axes[2, 2]
                length = math.sqrt(wx * wx + wy * wy + wz * wz)
                up = wz / length
                back0 = 0.0
                back1 = 0.0
                back2 = 0.0
                if up >= -0.002 or shine > 0.0:
                    turn = math.atan2(wy, wx) / (2 * math.pi) + 0.5
                    sx = min(int(turn * sky_wide), sky_wide - 1)
                    sy = min(int(abs(up) * (sky_high - 1)), sky_high - 1)
                    back0 = float(sky[sy, sx, 0])
                    back1 = float(sky[sy, sx, 1])
                    back2 = float(sky[sy, sx, 2])
                if up < -0.002:
                    reach = -camera_at[2] / wz
                    gx = (camera_at[0] + reach * wx - ground_x0) * texels_per_m
                    gy = (camera_at[1] + reach * wy - ground_y0) * texels_per_m
                    across = reach / focal * texels_per_m
                    flat = math.sqrt(wx * wx + wy * wy)
                    along = across / (-up)
                    taps = min(MAX_TAPS, max(1, int(min(along / across, 1.5 * along) + 0.5)))
                    texel = max(across, along / taps)
                    level = 0
                    while texel > 1.5 and level < deepest:
                        texel *= 0.5
                        level += 1
                    shrink = 1.0 / (1 << level)
                    w = levels[level, 1]
                    h = levels[level, 2]
                    stepx = along * wx / flat / taps
                    stepy = along * wy / flat / taps
                    g0 = 0.0
                    g1 = 0.0
                    g2 = 0.0
                    g3 = 0.0
                    for tap in range(taps):
                        off = tap - 0.5 * (taps - 1)
                        px = (gx + off * stepx) * shrink - 0.5
                        py = (gy + off * stepy) * shrink - 0.5
                        px = min(max(px, 0.0), w - 1.001)
                        py = min(max(py, 0.0), h - 1.001)
                        ix = int(px)
                        iy = int(py)
                        fx = px - ix
                        fy = py - iy
                        at = levels[level, 0] + iy * w + ix
                        a = (1 - fx) * (1 - fy)
                        b = fx * (1 - fy)
                        c2 = (1 - fx) * fy
                        d = fx * fy
                        g0 += (
                            a * ground[at, 0]
                            + b * ground[at + 1, 0]
                            + c2 * ground[at + w, 0]
                            + d * ground[at + w + 1, 0]
                        )
                        g1 += (
                            a * ground[at, 1]
                            + b * ground[at + 1, 1]
                            + c2 * ground[at + w, 1]
                            + d * ground[at + w + 1, 1]
                        )
                        g2 += (
                            a * ground[at, 2]
                            + b * ground[at + 1, 2]
                            + c2 * ground[at + w, 2]
                            + d * ground[at + w + 1, 2]
                        )
                        g3 += ground[at, 3]
                    g0 /= taps
                    g1 /= taps
                    g2 /= taps
                    g3 /= taps
                    bright = shadow[row, column] / 255.0
                    if reach < 40.0:
                        # Fine grain, 2 cm a texel, fading with distance.
                        nx = int((camera_at[0] + reach * wx) * 50.0) % grain_size
                        ny = int((camera_at[1] + reach * wy) * 50.0) % grain_size
                        fade = min(1.0, 8.0 / reach) * (1.0 - reach / 40.0)
                        bright *= 1.0 + fade * g3 / 255.0 * (grain[ny, nx] - 128.0) / 230.0
                    g0 *= light[0] * bright
                    g1 *= light[1] * bright
                    g2 *= light[2] * bright
                    if shine > 0.0:
                        mirror = shine * (0.15 + 0.85 * (1.0 + up) ** 4)
                        g0 += mirror * (back0 - g0)
                        g1 += mirror * (back1 - g1)
                        g2 += mirror * (back2 - g2)
                    hazy = haze_per_m * reach / (1.0 + haze_per_m * reach)
                    back0 = g0 + hazy * (haze[0] - g0)
                    back1 = g1 + hazy * (haze[1] - g1)
                    back2 = g2 + hazy * (haze[2] - g2)
                rest = whole - filled
                red += rest * back0
                green += rest * back1
                blue += rest * back2
            picture[row, column, 0] = min(255.0, max(0.0, red / whole + 0.5))
            picture[row, column, 1] = min(255.0, max(0.0, green / whole + 0.5))
            picture[row, column, 2] = min(255.0, max(0.0, blue / whole + 0.5))


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
    """What lens and sensor add: vignette, glare about the sun, contrast, noise; in place."""
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
