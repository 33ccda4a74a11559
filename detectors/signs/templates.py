"""Grey drawings of the signs that prohibit a turn, as templates of an ORB matcher.

The signs are one-way arrows (US R6-1), do not enter (US R5-1) and the international no-entry disc
(Vienna C1). The drawings are stored as files, because versions of OpenCV draw letters differently.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from crosscue.replay.errors import UsageError

Kind = Literal["one way left", "one way right", "do not enter", "no entry"]
KINDS: Final[tuple[Kind, ...]] = ("one way left", "one way right", "do not enter", "no entry")
AMERICAN: Final[tuple[Kind, ...]] = KINDS[:3]
# Labels that differ from the kind; the international disc means the same as the American sign.
LABELS: Final = {"no entry": "do not enter"}
# Width of the grey margin around a drawing, so that points at its edge have a neighbourhood.
MARGIN_PX: Final = 12
_AROUND: Final = 140
# Heights of the stored drawings: the default heights, and one to scale down to any other.
FILES_PX: Final = (48, 64, 512)


@dataclass(frozen=True, slots=True, eq=False)
class SignTemplate:
    """One sign at one size.

    Attributes:
        kind: Kind of sign.
        grey: Shape (h, w), uint8, with ``MARGIN_PX`` around the sign.
        size_px: Width and height of the sign itself.
    """

    kind: Kind
    grey: NDArray[np.uint8]
    size_px: tuple[int, int]


def drawings(
    kinds: Sequence[Kind] = KINDS, heights_px: Sequence[int] = (48, 64)
) -> list[SignTemplate]:
    """Return the drawing of each kind at each height, where ``sign_size`` is the size."""
    return [draw_sign_template(kind, height) for kind in kinds for height in heights_px]


def draw_sign_template(kind: Kind, height_px: int) -> SignTemplate:
    """Return the drawing of a sign; for a height without a file, the largest is scaled down.

    Raises:
        ValueError: The height is below 16 pixels or above the largest file's.
    """
    if not 16 <= height_px <= FILES_PX[-1]:
        raise ValueError(f"height_px: expected 16 to {FILES_PX[-1]}, got {height_px}")
    import cv2

    size = sign_size(kind, height_px)
    sign = _stored(kind, height_px if height_px in FILES_PX else FILES_PX[-1])
    if sign.shape[::-1] != size:
        sign = np.asarray(cv2.resize(sign, size, interpolation=cv2.INTER_AREA), np.uint8)
    grey = np.full((size[1] + 2 * MARGIN_PX, size[0] + 2 * MARGIN_PX), _AROUND, np.uint8)
    grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX] = sign
    return SignTemplate(kind, np.asarray(cv2.GaussianBlur(grey, (3, 3), 0.6), np.uint8), size)


def draw_sign(kind: str, height_px: int) -> NDArray[np.uint8]:
    """Draw the template of a sign, to compose test pictures.

    Args:
        kind: ``one way left``, ``one way right``, ``do not enter`` or ``no entry``.
        height_px: Height of the sign.

    Returns:
        Grey picture, uint8, shape (H, W).

    Raises:
        UsageError: The sign does not exist, or ``height_px`` is too small.
    """
    known = next((one for one in KINDS if one == kind), None)
    if known is None:
        raise UsageError(f"kind: expected one of {', '.join(KINDS)}; found {kind!r}")
    try:
        return draw_sign_template(known, height_px).grey[MARGIN_PX:-MARGIN_PX, MARGIN_PX:-MARGIN_PX]
    except ValueError as error:
        raise UsageError(f"draw_sign: {error}") from None


def sign_size(kind: Kind, height_px: int) -> tuple[int, int]:
    """Width and height of a sign.

    A one-way sign has half of ``height_px`` as its height and is three times as wide as high.
    """
    if kind.startswith("one way"):
        return height_px * 3 // 2, height_px // 2
    return height_px, height_px


def template_file(kind: Kind, height_px: int) -> str:
    """File name of a stored drawing."""
    return f"{kind.replace(' ', '_')}_{height_px}.png"


def _stored(kind: Kind, height_px: int) -> NDArray[np.uint8]:
    import cv2

    path = files("crosscue.detectors.signs").joinpath("drawings", template_file(kind, height_px))
    data = np.frombuffer(path.read_bytes(), np.uint8)
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)
