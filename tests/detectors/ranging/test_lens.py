"""Tests that lit lenses and housings seen from behind are distinguished."""

import cv2
import numpy as np
import pytest

from crosscue.detectors.ranging.lens import Lens, lens_of
from crosscue.replay.columns import Bytes
from support.data import shared

BGR = {"red": (40, 30, 230), "yellow": (20, 180, 240), "green": (200, 230, 60)}
WALL = (150, 180, 205)
BOX = np.array([20.0, 10.0, 44.0, 62.0])


def housing(lit: str | None, at: int = 0) -> Bytes:
    """Draw a dark housing of three lenses in front of a pale wall."""
    picture = np.full((80, 64, 3), WALL, np.uint8)
    picture[10:62, 20:44] = (45, 40, 38)
    for i in range(3):
        colour = BGR[lit] if lit is not None and i == at else (60, 50, 55)
        cv2.circle(picture, (32, 18 + 18 * i), 7, colour, -1)
    return picture


@pytest.mark.parametrize(("colour", "at"), [("red", 0), ("yellow", 1), ("green", 2)])
def test_lit_lens_is_found_at_each_position(colour: str, at: int) -> None:
    assert lens_of(housing(colour, at), BOX) == colour


@pytest.mark.parametrize(
    ("frame", "box", "lens"),
    [
        (0, (722, 292, 744, 339), "dark"),
        (0, (932, 365, 948, 397), "green"),
        (60, (660, 234, 686, 289), "dark"),
        (60, (766, 329, 782, 363), "red"),
        (79, (264, 282, 283, 330), "dark"),
        (79, (572, 182, 608, 256), "dark"),
        (79, (732, 320, 755, 366), "red"),
        (79, (919, 330, 941, 375), "green"),
    ],
)
def test_lenses_of_a_real_intersection_match_manual_labels(
    frame: int, box: tuple[int, int, int, int], lens: Lens
) -> None:
    folder = shared("sequences/pandaset_002") / "camera/front_camera"
    picture = np.asarray(cv2.imread(str(folder / f"{frame:02d}.jpg")), np.uint8)

    assert lens_of(picture, np.array(box, np.float64)) == lens


def test_small_grey_or_outside_box_has_an_unknown_lens() -> None:
    picture = housing("red")

    assert lens_of(picture, BOX * 0.2) == "unknown"
    assert lens_of(picture[:, :, 0].copy(), BOX) == "unknown"
    assert lens_of(picture, BOX + 200.0) == "unknown"
