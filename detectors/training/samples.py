"""Draw training samples: windows of pictures, zoomed, mirrored and recoloured, from a seed.

Signs and lights are small and rare. Most windows are therefore placed around an object, and rare
classes are selected more often.
"""

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from crosscue.detectors.images import decode, read_file
from crosscue.detectors.networks.mask_rcnn.network import MEAN, SPREAD, NetworkPlan
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.errors import LogError, SchemaError

from .annotations import Box, LabelledPicture, LabelledSet, TrainingObject, mask_of

# Fraction of windows that are placed around an object.
NEAR_OBJECT: Final = 0.85
# Minimum side of an object in the window; a smaller object cannot be recognised.
MIN_SIDE_PX: Final = 3.0
# Minimum fraction of an object's pixels within the window for it to count as present.
MIN_FRACTION: Final = 0.3
MAX_OBJECTS: Final = 24


@dataclass(frozen=True, slots=True)
class SampleSettings:
    """Size and augmentation of samples.

    Attributes:
        width_px: Width of a sample.
        height_px: Height of a sample.
        zoom: Minimum and maximum factor on the network's scale.
        mirror: Probability of mirroring.
        balance: 0 selects all objects equally often, 1 all classes, regardless of their numbers.
    """

    width_px: int = 544
    height_px: int = 288
    zoom: tuple[float, float] = (0.5, 1.25)
    mirror: float = 0.5
    balance: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One training sample.

    Attributes:
        pixels: Shape (3, H, W), float32, normalised.
        boxes_px: Shape (N, 4), float32.
        labels: Shape (N,), int64, from 1.
        masks: Shape (N, H, W), uint8; the filled box where the object has no mask.
        has_mask: Shape (N,), bool.
    """

    pixels: NDArray[np.float32]
    boxes_px: NDArray[np.float32]
    labels: NDArray[np.int64]
    masks: Bytes
    has_mask: NDArray[np.bool_]


def read_bgr(picture: LabelledPicture) -> Bytes:
    """Read and decode a picture, shape (H, W, 3), blue, green, red.

    Raises:
        LogError: The file is not a picture, or is damaged.
        SchemaError: The picture is not of the annotated size.
    """
    try:
        pixels, size = decode(read_file(picture.path))
    except OSError as error:
        raise LogError(f"{picture.path}: {error.strerror}; check the file") from None
    except LogError as error:
        raise type(error)(
            f"{picture.path}: {error}; repair the file or leave it out of the annotations"
        ) from None
    if size != picture.size_px:
        width, height = picture.size_px
        raise SchemaError(
            f"{picture.path}: expected a picture of {width} x {height} as annotated, got "
            f"{size[0]} x {size[1]}; repair the file or leave it out of the annotations"
        )
    return pixels


def normalised(pixels: Bytes) -> NDArray[np.float32]:
    """Convert (H, W, 3) blue, green, red to the networks' normalised input (3, H, W)."""
    scaled = pixels[:, :, ::-1].astype(np.float32)
    mean, spread = np.array(MEAN, np.float32), np.array(SPREAD, np.float32)
    scaled = (scaled - 255.0 * mean) * (1.0 / (255.0 * spread))
    return np.ascontiguousarray(scaled.transpose(2, 0, 1), np.float32)


class Sampler:
    """Draws samples; the same seed and number yield the same sample."""

    def __init__(
        self, labelled: LabelledSet, plan: NetworkPlan, window: SampleSettings, seed: int
    ) -> None:
        """Count the objects of each class."""
        self._set, self._plan, self._window, self._seed = labelled, plan, window, seed
        places: list[tuple[int, Box]] = []
        kinds: list[int] = []
        for i, picture in enumerate(labelled.pictures):
            own = [(one.label, one.box_px) for one in picture.objects if not one.is_crowd]
            # Annotated objects of other classes are those that networks confuse with these.
            for kind, box in own + [(len(labelled.classes), box) for box in picture.decoys_px]:
                if _is_big_enough(box, picture, plan):
                    places.append((i, box))
                    kinds.append(kind)
        counts = np.maximum(np.bincount(kinds, minlength=len(labelled.classes) + 1), 1)
        weight = (counts.astype(np.float64) ** -window.balance)[kinds]
        self._places, self._chance = places, weight / max(weight.sum(), 1e-12)

    def __call__(self, number: int) -> Sample:
        """Draw the sample of a number.

        Raises:
            LogError: As ``read_bgr``.
            SchemaError: As ``read_bgr``.
        """
        rng = np.random.default_rng([self._seed, number])
        about: Box | None = None
        if self._places and rng.random() < NEAR_OBJECT:
            i, about = self._places[int(rng.choice(len(self._places), p=self._chance))]
        else:
            i = int(rng.integers(len(self._set.pictures)))
        picture = self._set.pictures[i]
        low, high = self._window.zoom
        zoom = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        scale = self._plan.width_px / picture.size_px[0] * zoom
        corner = _corner(picture.size_px, about, scale, self._window, self._plan, rng)
        warp = np.array([[scale, 0.0, -corner[0] * scale], [0.0, scale, -corner[1] * scale]])
        if rng.random() < self._window.mirror:
            warp[0] = -warp[0]
            warp[0, 2] += self._window.width_px
        pixels = recoloured(_warped(read_bgr(picture), warp, self._window, 114), rng)
        return _sample(pixels, picture, warp, self._window)


def _is_big_enough(box: Box, picture: LabelledPicture, plan: NetworkPlan) -> bool:
    scale = plan.width_px / picture.size_px[0]
    x0, y0, x1, y1 = box
    return min(x1 - x0, y1 - y0) * scale >= MIN_SIDE_PX


def _corner(
    size_px: tuple[int, int],
    about: Box | None,
    scale: float,
    window: SampleSettings,
    plan: NetworkPlan,
    rng: Generator,
) -> Floats:
    """Top left of the window in the picture; the window may exceed a smaller picture."""
    span = np.array([window.width_px, window.height_px]) / scale
    low = np.array([0.0, plan.top * size_px[1]])
    high = np.array([size_px[0], (1.0 - plan.bottom) * size_px[1]]) - span
    low, high = np.minimum(low, high), np.maximum(low, high)
    if about is None:
        return np.asarray(rng.uniform(low, high))
    x0, y0, x1, y1 = about
    middle = np.array([x0 + x1, y0 + y1]) / 2.0
    room = np.maximum(span - [x1 - x0, y1 - y0], 0.2 * span)
    corner = middle - span / 2.0 + rng.uniform(-0.5, 0.5, 2) * room
    return np.asarray(np.clip(corner, low, high))


def _warped(pixels: Bytes, warp: Floats, window: SampleSettings, border: int) -> Bytes:
    return np.asarray(
        cv2.warpAffine(
            pixels,
            _to_middles(warp),
            (window.width_px, window.height_px),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(border, border, border),
        ),
        np.uint8,
    )


def _to_middles(warp: Floats) -> Floats:
    """Convert a transform of pixel corners, as of boxes, to one of pixel centres, as in OpenCV."""
    moved = warp.copy()
    moved[:, 2] += 0.5 * (warp[:, 0] + warp[:, 1]) - 0.5
    return moved


def recoloured(pixels: Bytes, rng: Generator) -> Bytes:
    """Vary lighting, contrast, colour and noise."""
    gain = rng.uniform(0.7, 1.35) * rng.uniform(0.9, 1.1, 3)
    levels = np.arange(256.0) / 255.0
    gamma, lift = np.exp(rng.uniform(-0.3, 0.3)), rng.uniform(-0.06, 0.06)
    table = np.clip((levels[:, None] ** gamma * gain + lift) * 255.0, 0, 255).astype(np.uint8)
    changed = np.asarray(cv2.LUT(pixels, table.reshape(1, 256, 3)), np.uint8)
    if rng.random() < 0.3:
        grey = cv2.cvtColor(changed, cv2.COLOR_BGR2GRAY)[:, :, None].repeat(3, axis=2)
        fraction = rng.uniform(0.0, 1.0)
        changed = np.asarray(
            cv2.addWeighted(changed, 1.0 - fraction, grey, fraction, 0.0), np.uint8
        )
    if rng.random() < 0.25:
        changed = np.asarray(cv2.GaussianBlur(changed, (3, 3), rng.uniform(0.3, 1.0)), np.uint8)
    if rng.random() < 0.25:
        noise = rng.integers(-12, 13, changed.shape, np.int16)
        changed = np.clip(changed + noise, 0, 255).astype(np.uint8)
    return changed


def _sample(
    pixels: Bytes, picture: LabelledPicture, warp: Floats, window: SampleSettings
) -> Sample:
    boxes, labels, masks, has_mask = [], [], [], []
    for one in picture.objects:
        if one.is_crowd or not _may_be_inside(one, warp, window):
            continue
        whole = mask_of(one, picture.size_px)
        grey = _warped(whole.astype(np.uint8) * 255, warp, window, 0)
        mask = np.asarray(grey >= 128, np.uint8)
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        if not len(rows):
            continue
        box = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
        scale = np.hypot(*warp[0, :2])
        fraction = mask.sum() / max(float(whole.sum()) * scale * scale, 1.0)
        if min(box[2] - box[0], box[3] - box[1]) >= MIN_SIDE_PX and fraction >= MIN_FRACTION:
            boxes.append(box)
            labels.append(one.label + 1)
            masks.append(mask)
            has_mask.append(one.mask is not None)
    if len(boxes) > MAX_OBJECTS:
        order = np.argsort([-int(mask.sum()) for mask in masks], kind="stable")[:MAX_OBJECTS]
        boxes, labels, masks, has_mask = (
            [part[i] for i in order] for part in (boxes, labels, masks, has_mask)
        )
    size = (window.height_px, window.width_px)
    return Sample(
        normalised(pixels),
        np.array(boxes, np.float32).reshape(-1, 4),
        np.array(labels, np.int64),
        np.stack(masks) if masks else np.zeros((0, *size), np.uint8),
        np.array(has_mask, np.bool_),
    )


def _may_be_inside(one: TrainingObject, warp: Floats, window: SampleSettings) -> bool:
    x0, y0, x1, y1 = one.box_px
    across = np.sort(warp[0, 0] * np.array([x0, x1]) + warp[0, 2])
    down = warp[1, 1] * np.array([y0, y1]) + warp[1, 2]
    return bool(
        across[1] > 0 and across[0] < window.width_px and down[1] > 0 and down[0] < window.height_px
    )
