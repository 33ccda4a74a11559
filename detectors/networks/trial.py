"""Run a detector on pictures in which it must not find nonsense."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.catalog.card import Input
from crosscue.detectors.decoders.base import IMAGENET, BoxCandidates, BoxOutput, Size, named
from crosscue.detectors.decoders.plausible import oddity
from crosscue.detectors.signs.templates import draw_sign_template
from crosscue.replay.columns import Bytes, Floats

from .backends import Network
from .box_model import BoxModel
from .model_detector import RoadModel
from .picture_input import prepared

# Mean and scale of red, green and blue with which networks are trained.
_SCALES: Final = {
    "scale = 1, pixels from 0 to 255": ((0.0,) * 3, (1.0,) * 3),
    "scale = 1/255, pixels from 0 to 1": ((0.0,) * 3, (1 / 255,) * 3),
    "mean = 127.5, scale = 1/127.5": ((127.5,) * 3, (1 / 127.5,) * 3),
    "ImageNet's mean and deviation": (IMAGENET["mean"], IMAGENET["scale"]),
}
# Numbers of boxes, and of sure ones, that no network finds in one picture that is prepared rightly.
_MANY: Final = 100
_MANY_SURE: Final = 20
_SURE: Final = 0.98
# Minimum fraction of pixels without a sure class in maps of points.
_LOW_FRACTION: Final = 0.9
# The way to fit a picture that a network may be trained with instead of the card's.
_OTHER_FIT: Final = {
    "stretch": "letterbox",
    "letterbox": "stretch",
    "letterbox-center": "stretch",
}


def fault_seen(detector: Detector, picture: Bytes | None = None) -> str | None:
    """Run a detector on noise, on grey and on a picture; return what cannot be right.

    Args:
        detector: The detector; only those of model cards are examined.
        picture: Pixels (H, W, 3), blue green red; by default the drawing of a sign.
    """
    if not isinstance(detector, BoxModel | RoadModel):
        return None
    for where, pixels in _pictures(detector.card.input, picture):
        if isinstance(detector, RoadModel):
            why = _maps_on(detector, pixels)
        else:
            why = _oddity_on(detector, pixels)
        if why is not None:
            return f"on {where}, {why}"
    return None


def _maps_on(detector: RoadModel, pixels: Bytes) -> str | None:
    """Say that a network's maps are those of points, as of a pose: nearly zero nearly all over."""
    batch, _ = prepared(pixels, detector.card.input)
    raw = np.asarray(named(detector.network(batch), detector.output.name), np.float64)
    if raw.ndim != 4:
        return None
    axis = 1 if raw.shape[1] == len(detector.output.classes) else 3
    best, total = raw.max(axis=axis), raw.sum(axis=axis)
    is_low = (best < 0.5).mean() > _LOW_FRACTION and raw.min() >= 0.0 < raw.max() <= 1.0
    if not is_low or np.allclose(total, 1.0, atol=0.02):
        return None
    return f"{(best < 0.5).mean():.0%} of the pixels have no score of 0.5: these are maps of points"


def _pictures(given: Input, picture: Bytes | None) -> Iterator[tuple[str, Bytes]]:
    shape = (given.height_px, given.width_px, 3)
    yield "noise", np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    yield "grey", np.full(shape, 114, np.uint8)
    if picture is not None:
        yield "the picture", picture
    else:
        yield "the drawing of a sign", np.dstack([draw_sign_template("no entry", 512).grey] * 3)


def candidates_in(
    network: Network, output: BoxOutput, given: Input, pixels: Bytes
) -> tuple[BoxCandidates, Size]:
    """Return all candidates in one picture, and the size of the input that they are in.

    Raises:
        ValueError: The outputs are not those of this layout.
    """
    batch, placement = prepared(pixels, given)
    outputs = network(batch[0] if given.layout == "chw" else batch)
    every = output.model_copy(update={"score": 0.0})
    return every.candidates(outputs, placement.size_px), placement.size_px


def _oddity_on(detector: BoxModel, pixels: Bytes) -> str | None:
    try:
        found, size_px = candidates_in(
            detector.network, detector.output, detector.card.input, pixels
        )
    except ValueError as error:
        return str(error)
    return oddity(found, size_px, detector.score)


def fit_doubt(detector: Detector, picture: Bytes) -> str | None:
    """Say what a network finds in a picture that is fitted into its input otherwise.

    None if that cannot matter.
    """
    if not isinstance(detector, BoxModel):
        return None
    given, (height, width) = detector.card.input, picture.shape[:2]
    if given.fit not in _OTHER_FIT or width * given.height_px == height * given.width_px:
        return None
    counts = [
        f'{_said(_scores(detector, picture, fit=fit))} with fit = "{fit}"'
        for fit in (given.fit, _OTHER_FIT[given.fit])
    ]
    return f"{counts[0]}, {counts[1]} in {width} x {height}: correct input.fit if it is the other"


def input_doubt(detector: Detector, picture: Bytes) -> str | None:
    """Say what a network finds in a picture that is prepared otherwise, if its own result is odd.

    Numbers smaller than in training yield low scores or nothing, larger ones a flood of sure boxes.
    """
    if not isinstance(detector, BoxModel) or detector.card.input.dtype == "uint8":
        return None
    own = _scores(detector, picture)
    if own.size and not _is_flood(own):
        return None
    found = {what: _scores(detector, picture, **keys) for what, keys in _others(detector)}
    sane = {what: scores for what, scores in found.items() if scores.size and not _is_flood(scores)}
    if not sane:
        return None
    best = max(sane, key=lambda what: float(sane[what].sum()))
    return (
        f"{_said(own)} above {detector.score:g} in the picture, {_said(sane[best])} with {best}: "
        "correct [input] if the network is trained so"
    )


def _is_flood(scores: Floats) -> bool:
    return len(scores) >= _MANY and int((scores > _SURE).sum()) >= _MANY_SURE


def _others(detector: BoxModel) -> Iterator[tuple[str, dict[str, object]]]:
    """Ways to prepare a picture, with the keys of ``[input]`` that say so."""
    given = detector.card.input
    for what, (mean, scale) in _SCALES.items():
        order = -1 if given.colour == "bgr" else 1
        yield what, {"mean": mean[::order], "scale": scale[::order]}
    other = "rgb" if given.colour == "bgr" else "bgr"
    yield (
        f'colour = "{other}"',
        {"colour": other, "mean": given.mean[::-1], "scale": given.scale[::-1]},
    )
    if given.fit in _OTHER_FIT:
        yield f'fit = "{_OTHER_FIT[given.fit]}"', {"fit": _OTHER_FIT[given.fit]}


def _scores(detector: BoxModel, picture: Bytes, **keys: object) -> Floats:
    """Scores of the detections with other keys of ``[input]``; none if they cannot be right."""
    given = detector.card.input.model_copy(update=keys)
    other = replace(detector, card=detector.card.model_copy(update={"input": given}))
    if keys and _oddity_on(other, picture) is not None:
        return np.empty(0)
    (found,) = other([Frame(0, "", picture, (picture.shape[1], picture.shape[0]))])
    return found.scores if isinstance(found, Detections) else np.empty(0)


def _said(scores: Floats) -> str:
    return f"{len(scores)} boxes" + (
        f" with scores up to {scores.max():.2f}" if len(scores) else ""
    )
