"""Run a detector on pictures in which it must not find nonsense."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from crosscue.detectors.base import Detector
from crosscue.detectors.decoders.plausible import oddity
from crosscue.detectors.signs.templates import draw_sign_template
from crosscue.replay.columns import Bytes

from .box_model import BoxModel
from .picture_input import prepared


def fault_seen(detector: Detector, picture: Bytes | None = None) -> str | None:
    """Run a detector of boxes on noise, on grey and on a picture; return what cannot be right.

    Args:
        detector: The detector; only the boxes of a model card's are examined.
        picture: Pixels (H, W, 3), blue green red; by default the drawing of a sign.
    """
    if not isinstance(detector, BoxModel):
        return None
    for where, pixels in _pictures(detector, picture):
        why = _oddity_on(detector, pixels)
        if why is not None:
            return f"on {where}, {why}"
    return None


def _pictures(detector: BoxModel, picture: Bytes | None) -> Iterator[tuple[str, Bytes]]:
    given = detector.card.input
    shape = (given.height_px, given.width_px, 3)
    yield "noise", np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    yield "grey", np.full(shape, 114, np.uint8)
    if picture is not None:
        yield "the picture", picture
    else:
        yield "the drawing of a sign", np.dstack([draw_sign_template("no entry", 512).grey] * 3)


def _oddity_on(detector: BoxModel, pixels: Bytes) -> str | None:
    given, placement = prepared(pixels, detector.card.input)
    outputs = detector.network(given[0] if detector.card.input.layout == "chw" else given)
    every = detector.output.model_copy(update={"score": 0.0})
    try:
        found = every.candidates(outputs, placement.size_px)
    except ValueError as error:
        return str(error)
    return oddity(found, placement.size_px, detector.score)
