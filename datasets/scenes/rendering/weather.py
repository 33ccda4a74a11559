"""Daylight (brightness of surfaces, the sky, haze), and rain in front of the camera."""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from crosscue.datasets.scenes.motion import Conditions, Light
from crosscue.replay.columns import Floats

from .mesh import Mesh, Rgb
from .textures import smooth_noise

SKY_HIGH, SKY_WIDE = 128, 1024


# Elevation of the sun in degrees, colours of sun, ambient light, haze and zenith, strength of the
# glare, noise of the sensor, amount of clouds.
LIGHTS: Final[dict[Light, tuple[float, Rgb, Rgb, Rgb, Rgb, float, float, float]]] = {
    "noon": (52.0, (0.72, 0.69, 0.62), (0.50, 0.54, 0.60), (206, 216, 226), (96, 142, 206),
             0.0, 2.0, 0.45),
    "overcast": (50.0, (0.05, 0.05, 0.05), (0.80, 0.82, 0.84), (208, 212, 216), (186, 192, 200),
                 0.0, 2.6, 0.9),
    "dusk": (4.0, (0.03, 0.02, 0.02), (0.36, 0.36, 0.43), (150, 130, 132), (66, 80, 124),
             0.0, 5.5, 0.5),
    "low_sun": (9.0, (1.05, 0.80, 0.50), (0.42, 0.43, 0.48), (240, 222, 188), (140, 166, 206),
                1.0, 2.4, 0.35),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Daylight:
    """Light of one run.

    Attributes:
        to_sun: Unit vector towards the sun, local frame.
        sun: Colour of direct light; zero without direct light.
        ambient: Colour of the sky's light.
        haze: Colour of distant objects, 0 to 255.
        haze_per_m: 1 over the distance at which half of the light is haze.
        sky: Colours of the sky, shape (SKY_HIGH, SKY_WIDE, 3), rows by the sine of elevation,
            columns by direction.
        flare: Strength of the glare of the sun.
        contrast: Factor of contrast.
        noise: Noise of the sensor in grey values.
        shine: Reflectivity of the road.
        lamps_on: True if cars have their lamps on.
    """

    to_sun: Floats
    sun: Floats
    ambient: Floats
    haze: Floats
    haze_per_m: float
    sky: NDArray[np.uint8]
    flare: float
    contrast: float
    noise: float
    shine: float
    lamps_on: bool

    def on(self, mesh: Mesh) -> NDArray[np.float32]:
        """Return light times albedo of each triangle, from the brighter side, (T, 3)."""
        normal = mesh.normals()
        # Both sides of a billboard are equal; solids show the side with counter-clockwise corners.
        direct = np.maximum(normal @ self.to_sun, 0.0)
        from_sky = 0.72 + 0.28 * normal[:, 2]
        light = direct[:, None] * self.sun + from_sky[:, None] * self.ambient
        light = np.where(mesh.glow[:, None] > 0.0, 1.0, light)
        return (mesh.albedo * light).astype(np.float32)

    @property
    def on_ground(self) -> Floats:
        """Return the light on the ground in the sun."""
        lit: Floats = self.ambient + self.sun * max(self.to_sun[2], 0.0)
        return lit

    @property
    def in_shadow(self) -> float:
        """Return the fraction of the ground's light that remains in shadow."""
        return float((self.ambient.sum()) / self.on_ground.sum())


def daylight(conditions: Conditions, rng: Generator) -> Daylight:
    """Return the light of a run."""
    high_deg, sun, ambient, haze, zenith, flare, noise, clouds = LIGHTS[conditions.light]
    elevation = np.deg2rad(high_deg)
    turn = conditions.sun_turn_rad
    to_sun = np.array(
        [np.cos(elevation) * np.cos(turn), np.cos(elevation) * np.sin(turn), np.sin(elevation)]
    )
    wet = conditions.rain
    dim = 1.0 - 0.28 * wet
    return Daylight(
        to_sun,
        np.array(sun) * dim,
        np.array(ambient) * dim,
        np.array(haze) * (1.0 - 0.15 * wet),
        1.0 / (900.0 - 690.0 * wet),
        _sky(
            np.array(haze) * (1 - 0.15 * wet),
            np.array(zenith) * (1 - 0.1 * wet),
            to_sun,
            clouds + 0.3 * wet,
            flare,
            rng,
        ),
        flare * float(rng.uniform(0.75, 1.25)),
        1.0 - 0.16 * wet - 0.12 * flare,
        noise + 1.5 * wet,
        0.55 * wet,
        conditions.light == "dusk" or wet > 0.3,
    )


def _sky(
    horizon: Floats, zenith: Floats, to_sun: Floats, clouds: float, flare: float, rng: Generator
) -> NDArray[np.uint8]:
    up = np.linspace(0.0, 1.0, SKY_HIGH)[:, None]
    azimuth = (np.arange(SKY_WIDE) + 0.5) / SKY_WIDE * 2 * np.pi - np.pi
    blend = (up**0.55)[..., None]
    sky = horizon * (1 - blend) + zenith * blend
    sky = np.repeat(sky, SKY_WIDE, axis=1)
    field = np.zeros((SKY_HIGH, SKY_WIDE))
    for cells, weight in ((8, 0.5), (16, 0.28), (64, 0.22)):
        field += weight * smooth_noise(rng, 1024, cells)[:SKY_HIGH]
    cover = np.clip((field - (0.68 - 0.34 * clouds)) * 4.0, 0.0, 1.0)[..., None]
    cover = cover * np.clip(0.25 + 2.0 * up[..., None], 0, 1)
    white = np.maximum(horizon, zenith) * 0.55 + 0.45 * min(255.0, float(horizon.max()) * 1.12)
    shade = (0.86 + 0.22 * field)[..., None]
    sky = sky * (1 - cover) + np.minimum(white * shade, 255.0) * cover
    if flare > 0.0:
        flat = np.sqrt(np.maximum(1 - up**2, 0))
        ahead = flat * (np.cos(azimuth) * to_sun[0] + np.sin(azimuth) * to_sun[1]) + up * to_sun[2]
        away = 1.0 - ahead
        glow = (np.exp(-away / 0.05) * 90 + np.exp(-away / 0.0006) * 255)[..., None]
        sky = sky + glow * np.array([1.0, 0.93, 0.75])
    shown: NDArray[np.uint8] = np.clip(sky, 0, 255).astype(np.uint8)
    return shown


def streaks(rgb: NDArray[np.uint8], rain: float, speed_mps: float, rng: Generator) -> None:
    """Draw falling drops as short bright lines, in place."""
    high, wide = rgb.shape[:2]
    size = wide / 1280
    veil = np.zeros((high, wide), np.uint8)
    for _ in range(round(420 * rain)):
        x, y = rng.uniform(0, wide), rng.uniform(0, high)
        near = rng.random() ** 2
        length = (8 + 34 * near) * size
        lean = 0.12 + 0.5 * (x / wide - 0.5) * min(speed_mps / 10.0, 1.0)
        ends = np.rint(np.array([x, y, x + lean * length, y + length]) * 16).astype(int).tolist()
        grey = int(30 + 50 * (1 - near))
        cv2.line(veil, (ends[0], ends[1]), (ends[2], ends[3]), grey, 1, cv2.LINE_AA, 4)
    lift = veil[..., None].astype(np.uint16)
    rgb[:] = (rgb + (255 - rgb.astype(np.uint16)) * lift // 400).astype(np.uint8)


def drops(rgb: NDArray[np.uint8], rain: float, rng: Generator) -> None:
    """Draw drops on the glass, which show the scene upside down and blurred, in place."""
    high, wide = rgb.shape[:2]
    for _ in range(round(34 * rain)):
        r = max(2, round(rng.uniform(3, 13) * wide / 1280))
        x, y = int(rng.integers(2 * r, wide - 2 * r)), int(rng.integers(2 * r, high - 2 * r))
        around = rgb[y - 2 * r : y + 2 * r, x - 2 * r : x + 2 * r]
        lens = cv2.resize(around, (2 * r, 2 * r), interpolation=cv2.INTER_AREA)[::-1]
        disc = np.zeros((2 * r, 2 * r), np.uint8)
        cv2.circle(disc, (r, r), round(0.8 * r), 210, -1, cv2.LINE_AA)
        soft = cv2.GaussianBlur(disc, (0, 0), 0.2 * r + 0.3)[..., None].astype(np.float32) / 255
        spot = rgb[y - r : y + r, x - r : x + r]
        spot[:] = (spot * (1 - soft) + np.minimum(lens * 0.94 + 10, 255) * soft).astype(np.uint8)
