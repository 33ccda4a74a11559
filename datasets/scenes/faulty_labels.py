"""Label images of a simulated drive, with the faults of a simulated detector.

No network is used. Masks come from the renderer, and missed objects, false detections and errors
are drawn according to ``DetectorFaults``, whose values are plausible but were not measured. Faults
are correlated in time: the error of each object, road and false detection is the sum of a part that
is constant during the drive, a part that decays over a second, and a part of the single frame.
Consecutive frames are therefore wrong together, as they are with networks.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from crosscue.datasets.scenes.rendering.ground import TEXELS_PER_M, X_M, Y_M, along_curve
from crosscue.datasets.scenes.rendering.render import (
    PictureSettings,
    RenderedFrame,
    RenderedObject,
    Renderer,
)
from crosscue.datasets.scenes.settings import SceneSettings
from crosscue.datasets.simulated.drive import START_NS
from crosscue.detectors.label_images import LabelledObject, label_image

from .drive import FROM_M, Imager, picture_times
from .layout import NEAR_KERB_M
from .world import Category, World

LABELS: Final[dict[Category, str]] = {
    "car": "car",
    "stop_sign": "stop sign",
    "traffic_light": "traffic light",
    "one_way_left": "one way left",
    "one_way_right": "one way right",
    "do_not_enter": "do not enter",
}
# Time between two pictures while the vehicle moves.
MOVING_NS: Final = 200_000_000
# Time between two pictures while the vehicle is stationary.
STANDING_NS: Final = 400_000_000
STANDS_MPS: Final = 0.3
ROAD, LEFT, RIGHT, AHEAD, FIRST_PATCH, FIRST_FALSE = 1, 2, 3, 4, 10, 200
FALSE_SIZE_M: Final[dict[Category, float]] = {
    "stop_sign": 0.75,
    "traffic_light": 1.06,
    "one_way_left": 0.3,
    "one_way_right": 0.3,
    "do_not_enter": 0.75,
}
MIRRORED: Final[dict[Category, Category]] = {
    "one_way_left": "one_way_right",
    "one_way_right": "one_way_left",
}


class Sight(NamedTuple):
    """Detection rate of a class: ``best`` at most, and one half of it at height ``half_px``."""

    best: float
    half_px: float


@dataclass(frozen=True, slots=True)
class DetectorFaults:
    """Performance of the simulated detector on pictures with a width of 640 pixels.

    Attributes:
        sights: Detection rates by class, on a clear day.
        step_fraction: Relative increase in height over which the detection rate rises.
        own: Fraction of an error's variance that is constant for an object during the drive.
        fading: Fraction that decays over ``fade_s``; the rest is that of a single frame.
        fade_s: Decay time in seconds.
        height_sd_fraction: Relative error of a mask's height, both per object and per frame.
        false_things: Number of objects mistaken for a sign or light in a drive, by class.
        false_per_frame: Probability of a false detection of each class in a frame.
        turned_around: Fraction of one-way signs that are read in the opposite direction.
        road_half_m: Distance at which half of the side roads are detected.
        ahead_half_m: Distance at which half of the roads beyond an intersection are detected.
        road_best: Max detection rate of roads.
        lot_as_road: Fraction of frames in which a parking lot is detected as road.
        driveway_as_road: Fraction of frames in which a driveway is detected as road.
        false_road: Fraction of frames in which one of ``false_roads`` places is detected as road.
        false_roads: Number of places next to the road that may be detected as road in a drive.
    """

    sights: dict[Category, Sight] = field(
        default_factory=lambda: {
            "car": Sight(0.97, 9.0),
            "stop_sign": Sight(0.97, 6.5),
            "traffic_light": Sight(0.95, 8.0),
            "one_way_left": Sight(0.8, 5.0),
            "one_way_right": Sight(0.8, 5.0),
            "do_not_enter": Sight(0.8, 8.0),
        }
    )
    step_fraction: float = 0.2
    own: float = 0.45
    fading: float = 0.35
    fade_s: float = 1.0
    height_sd_fraction: float = 0.04
    false_things: dict[Category, float] = field(
        default_factory=lambda: {
            "stop_sign": 0.08,
            "traffic_light": 0.15,
            "one_way_left": 0.04,
            "one_way_right": 0.04,
            "do_not_enter": 0.05,
        }
    )
    false_per_frame: float = 0.002
    turned_around: float = 0.03
    road_half_m: float = 42.0
    ahead_half_m: float = 60.0
    road_best: float = 0.9
    lot_as_road: float = 0.3
    driveway_as_road: float = 0.12
    false_road: float = 0.25
    false_roads: float = 1.2


DEFAULTS: Final = DetectorFaults()


@dataclass(slots=True)
class _Errors:
    """Standard normal errors that are correlated in time, one sequence for each key."""

    faults: DetectorFaults
    seed: int
    known: dict[int, tuple[Generator, float, float, float]] = field(default_factory=dict)

    def __call__(self, key: int, t_s: float) -> float:
        """Return the error at a time; times must not decrease."""
        if key not in self.known:
            rng = np.random.default_rng([self.seed, 12, key])
            self.known[key] = rng, rng.normal(), rng.normal(), t_s
        rng, own, fading, then_s = self.known[key]
        rho = math.exp((then_s - t_s) / self.faults.fade_s)
        fading = rho * fading + math.sqrt(1.0 - rho * rho) * rng.normal()
        self.known[key] = rng, own, fading, t_s
        frame = 1.0 - self.faults.own - self.faults.fading
        return float(
            math.sqrt(self.faults.own) * own
            + math.sqrt(self.faults.fading) * fading
            + math.sqrt(frame) * rng.normal()
        )

    def happens(self, key: int, t_s: float, chance: float) -> bool:
        return 0.5 * math.erfc(self(key, t_s) / math.sqrt(2.0)) < chance


@dataclass(frozen=True, slots=True)
class _FalseObject:
    category: Category
    at_m: tuple[float, float, float]


class FaultyLabels:
    """Simulated detector during one drive."""

    def __init__(
        self, world: World, settings: SceneSettings, faults: DetectorFaults = DEFAULTS
    ) -> None:
        """Draw the constant faults of the drive."""
        self._world, self._faults = world, faults
        picture = PictureSettings(samples=1)
        self._renderer = Renderer(world, settings.camera, picture)
        self._scale = settings.camera.width_px / 640.0
        seed = world.conditions.seed
        self._errors = _Errors(faults, seed)
        rng = np.random.default_rng([seed, 13])
        self._frame_rng = np.random.default_rng([seed, 14])
        self._false = [
            _FalseObject(category, _beside(world, category, rng))
            for category, rate in faults.false_things.items()
            for _ in range(int(rng.poisson(rate)))
        ]
        self._codes, self._chances = _ground_codes(world, faults, rng)
        conditions = world.conditions
        self._clear = {"dusk": 0.85, "low_sun": 0.88}.get(conditions.light, 1.0) * (
            1.0 - 0.2 * conditions.rain
        )

    def picture(self, t_s: float) -> RenderedFrame:
        """Return the label image at a time as a picture."""
        picture, ground = self._renderer.owners(t_s, self._codes)
        found = [
            one for seen in picture.seen if (one := self._found(seen, picture, t_s)) is not None
        ]
        found.sort(key=lambda pair: -pair[0])
        objects = [one for _, one in found] + self._false_finds(picture, t_s)
        image = label_image(self._road(ground, picture, t_s), objects)
        return RenderedFrame(t_s, image, picture.view, picture.owner, picture.seen)

    def _chance(self, category: Category, height_px: float) -> float:
        sight = self._faults.sights[category]
        half = sight.half_px * self._scale
        step = (height_px - half) / (self._faults.step_fraction * half)
        return sight.best * self._clear / (1.0 + math.exp(-max(min(step, 30.0), -30.0)))

    def _found(
        self, seen: RenderedObject, picture: RenderedFrame, t_s: float
    ) -> tuple[float, LabelledObject] | None:
        thing = seen.thing
        x0, y0, x1, y1 = seen.box_px
        size = min(y1 - y0, x1 - x0) if thing.category == "car" else y1 - y0
        shows = min(max((seen.visible - 0.25) / 0.4, 0.0), 1.0)
        chance = self._chance(thing.category, size) * shows
        if not self._errors.happens(thing.number, t_s, chance):
            return None
        category = thing.category
        if category in MIRRORED:
            own = np.random.default_rng([self._world.conditions.seed, 15, thing.number])
            if own.random() < self._faults.turned_around:
                category = MIRRORED[category]
        mask, top = seen.mask, y0
        if category != "car":
            mask = _stretched(mask, self._height_factor(thing.number, t_s))
            top = round((y0 + y1 - len(mask)) / 2)
        return seen.distance_m, LabelledObject(LABELS[category], 0.99, (x0, top), mask)

    def _height_factor(self, number: int, t_s: float) -> float:
        sd = math.sqrt(2.0) * self._faults.height_sd_fraction
        return math.exp(sd * self._errors(10_000 + number, t_s))

    def _false_finds(self, picture: RenderedFrame, t_s: float) -> list[LabelledObject]:
        found = []
        focal = self._renderer.camera.focal
        for number, one in enumerate(self._false):
            x, y, ahead = picture.view.project(np.array([one.at_m]))[0]
            high = focal * FALSE_SIZE_M[one.category] / max(ahead, 1.0)
            chance = 0.8 * self._chance(one.category, high)
            if ahead > 4.0 and self._errors.happens(20_000 + number, t_s, chance):
                high *= self._height_factor(30_000 + number, t_s)
                found.append(_block(one.category, x, y, high))
        high_px, wide_px = picture.owner.shape
        for category in FALSE_SIZE_M:
            if self._frame_rng.random() < self._faults.false_per_frame:
                x, y = self._frame_rng.uniform(0.2, 0.8), self._frame_rng.uniform(0.2, 0.5)
                high = self._scale * self._frame_rng.uniform(6.0, 25.0)
                found.append(_block(category, x * wide_px, y * high_px, high))
        return found

    def _road(
        self, ground: NDArray[np.uint8], picture: RenderedFrame, t_s: float
    ) -> NDArray[np.bool_]:
        to_kerb_m = max(NEAR_KERB_M - picture.view.rear_axle[0], 0.0)
        faults, best = self._faults, self._faults.road_best * self._clear
        side = best / (1.0 + math.exp((to_kerb_m - faults.road_half_m) / 8.0))
        ahead = best / (1.0 + math.exp((to_kerb_m - faults.ahead_half_m) / 10.0))
        chances = {LEFT: side, RIGHT: side, AHEAD: ahead, **self._chances}
        is_road = np.zeros(256, np.bool_)
        is_road[ROAD] = True
        for code, chance in chances.items():
            is_road[code] = self._errors.happens(40_000 + code, t_s, chance)
        return np.asarray(is_road[ground])


def _beside(world: World, category: Category, rng: Generator) -> tuple[float, float, float]:
    half_m = world.layout.half_width_m
    x, side = float(rng.uniform(-45.0, 25.0)), float(rng.choice([-1.0, 1.0]))
    if category == "traffic_light":
        return x, side * float(rng.uniform(0.0, half_m + 4.0)), float(rng.uniform(3.2, 5.5))
    return x, side * (half_m + float(rng.uniform(1.0, 6.0))), float(rng.uniform(1.8, 3.0))


def _ground_codes(
    world: World, faults: DetectorFaults, rng: Generator
) -> tuple[NDArray[np.uint8], dict[int, float]]:
    """Return a map of areas that may be detected as road, and rates of false areas by code."""
    layout, road = world.layout, world.ground.road
    codes: NDArray[np.uint8] = np.zeros(road.shape, np.uint8)
    chances: dict[int, float] = {}

    def fill(code: int, x: tuple[float, float], y: tuple[float, float]) -> None:
        rows = [min(max(round((v - Y_M[0]) * TEXELS_PER_M), 0), len(codes)) for v in sorted(y)]
        columns = [
            min(max(round((v - X_M[0]) * TEXELS_PER_M), 0), codes.shape[1]) for v in sorted(x)
        ]
        codes[rows[0] : rows[1], columns[0] : columns[1]] = code

    for number, patch in enumerate(world.patches[: FIRST_FALSE - FIRST_PATCH]):
        fill(FIRST_PATCH + number, patch.x, patch.y)
        is_lot = patch.kind == "asphalt"
        chances[FIRST_PATCH + number] = faults.lot_as_road if is_lot else faults.driveway_as_road
    for number in range(int(rng.poisson(faults.false_roads))):
        x, side = float(rng.uniform(-50.0, 25.0)), float(rng.choice([-1.0, 1.0]))
        deep, w = float(rng.uniform(3.0, 6.0)), layout.half_width_m
        fill(FIRST_FALSE + number, (x, x + deep), (side * w, side * (w + 9.0)))
        chances[FIRST_FALSE + number] = faults.false_road
    codes = along_curve(layout, codes)
    y = Y_M[0] + (np.arange(len(road)) + 0.5) / TEXELS_PER_M
    x_m = X_M[0] + (np.arange(road.shape[1]) + 0.5) / TEXELS_PER_M
    part = np.full(road.shape, ROAD, np.uint8)
    part[:, x_m > layout.far_kerb_m] = AHEAD
    part[y > layout.half_width_m] = LEFT
    part[y < -layout.half_width_m] = RIGHT
    if not layout.is_intersection and layout.has_ahead:
        part[:] = ROAD
    codes[road] = part[road]
    return codes, chances


def _stretched(mask: NDArray[np.bool_], factor: float) -> NDArray[np.bool_]:
    high = max(round(len(mask) * factor), 1)
    rows = np.minimum((np.arange(high) * len(mask)) // high, len(mask) - 1)
    return mask[rows]


def _block(category: Category, x_px: float, y_px: float, height_px: float) -> LabelledObject:
    """Return a false detection: a rectangle with the aspect ratio of its class."""
    wide = {"traffic_light": 0.35, "one_way_left": 3.0, "one_way_right": 3.0}.get(category, 1.0)
    high, across = max(round(height_px), 2), max(round(wide * height_px), 2)
    corner = (round(x_px - across / 2), round(y_px - high / 2))
    return LabelledObject(LABELS[category], 0.99, corner, np.ones((high, across), np.bool_))


def label_pictures(
    world: World, settings: SceneSettings, faults: DetectorFaults = DEFAULTS
) -> Iterator[tuple[int, RenderedFrame]]:
    """Yield times and label images from ``FROM_M`` before the intersection up to it.

    A stationary vehicle sees almost nothing new, so that there are fewer images then.
    """
    labels, motion = FaultyLabels(world, settings, faults), world.approach.motion
    due_ns = 0
    for t_ns in picture_times(world, settings).tolist():
        x_m, speed_mps = (
            float(np.interp(t_ns, motion.t_ns, column)) for column in (motion.x_m, motion.speed_mps)
        )
        t_s = (t_ns - START_NS) * 1e-9
        if x_m < -FROM_M or t_s > world.approach.enter_s + 0.2 or t_ns < due_ns:
            continue
        due_ns = t_ns + (MOVING_NS if speed_mps > STANDS_MPS else STANDING_NS)
        yield t_ns, labels.picture(t_s)


def png(picture: RenderedFrame, _: PictureSettings) -> bytes:
    """Encode a picture without loss."""
    bgr = np.ascontiguousarray(picture.rgb[..., ::-1])
    return bytes(cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1])


# Label images with faults, which a drive's camera records instead of photographs.
LABEL_IMAGES: Final = Imager("faulty labels 1", label_pictures, png, "png", is_painted=False)
# Detectors that read label images.
DETECTORS: Final = "crosscue.detectors.label_images:objects,crosscue.detectors.label_images:road"
