"""The second look at signs and lights, drawn at every size and in dim and bright light."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.signs.second_look import (
    OTHER_SIGNS,
    look_at_light,
    look_at_sign,
    with_looks,
)
from crosscue.replay.columns import Bytes

RED, WHITE, ORANGE, YELLOW, GREY = (
    (30, 30, 190), (235, 235, 235), (20, 120, 240), (30, 200, 240), (150, 155, 160)
)  # fmt: skip
SIDE = 240


def sign(kind: str) -> Bytes:
    """A drawn sign that fills its picture, on a street's green and grey."""
    picture = np.full((SIDE, SIDE, 3), (90, 110, 100), np.uint8)
    angle = np.pi / 8 + np.arange(8) * np.pi / 4
    octagon = 120 + 118 / np.cos(np.pi / 8) * np.stack([np.cos(angle), np.sin(angle)], 1)
    diamond = np.array([[120, 2], [238, 120], [120, 238], [2, 120]], np.int32)
    if kind in ("stop", "back"):
        cv2.fillPoly(picture, [octagon.astype(np.int32)], WHITE if kind == "stop" else GREY)
    if kind == "stop":
        cv2.fillPoly(picture, [(120 + 0.93 * (octagon - 120)).astype(np.int32)], RED)
        # Four letters of strokes, because versions of OpenCV draw text differently.
        for x in (28, 78, 128, 178):
            cv2.rectangle(picture, (x, 82), (x + 34, 158), WHITE, 11)
    if kind == "no entry":
        cv2.circle(picture, (120, 120), 116, RED, -1)
        cv2.rectangle(picture, (28, 100), (212, 140), WHITE, -1)
    if kind == "red detour":
        cv2.rectangle(picture, (10, 10), (230, 230), (10, 40, 230), -1)
        for x in (28, 78, 128, 178):
            cv2.rectangle(picture, (x, 82), (x + 34, 158), (20, 20, 60), 11)
    if kind in ("detour", "signal ahead"):
        cv2.fillPoly(picture, [diamond], ORANGE if kind == "detour" else YELLOW)
        cv2.rectangle(picture, (95, 80), (145, 160), (20, 20, 20), 8)
    return picture


def seen(kind: str, side_px: int, light: float = 1.0) -> tuple[Bytes, NDArray[np.float64]]:
    """A picture with a sign of ``side_px``, and its box."""
    small = cv2.resize(sign(kind), (side_px, side_px), interpolation=cv2.INTER_AREA)
    picture = np.full((side_px + 60, side_px + 80, 3), (90, 110, 100), np.uint8)
    picture[30 : 30 + side_px, 40 : 40 + side_px] = small
    dimmed = np.asarray(np.clip(picture * light, 0, 255), np.uint8)
    return dimmed, np.array([40.0, 30.0, 40.0 + side_px, 30.0 + side_px])


@pytest.mark.parametrize("side_px", [14, 20, 33, 64, 150])
@pytest.mark.parametrize("light", [0.4, 1.0, 1.2])
@pytest.mark.parametrize(
    ("kind", "look"),
    [
        ("stop", "stop"),
        ("no entry", "bar"),
        ("detour", "orange"),
        # Sunlit, the orange of a work-zone sign is red: only its letters tell.
        ("red detour", "plain"),
        ("signal ahead", "yellow"),
        ("back", "pale"),
    ],
)
def test_look_tells_signs_apart(kind: str, look: str, side_px: int, light: float) -> None:
    assert look_at_sign(*seen(kind, side_px, light)) == look


@pytest.mark.parametrize("side_px", [14, 33, 150])
def test_stop_sign_in_a_box_that_is_not_exact_looks_like_no_other(side_px: int) -> None:
    picture, box = seen("stop", side_px)
    rng = np.random.default_rng(1)
    looks = [look_at_sign(picture, box + rng.normal(0.0, 0.05 * side_px, 4)) for _ in range(100)]

    assert not {*OTHER_SIGNS} & {*looks}
    assert looks.count("stop") > 80


def test_small_dark_and_grey_signs_are_unknown() -> None:
    picture, box = seen("stop", 40)

    assert look_at_sign(np.ascontiguousarray(picture[..., 0]), box) == "unknown"
    assert look_at_sign(*seen("stop", 10)) == "unknown"
    assert look_at_sign(*seen("stop", 40, 0.1)) == "unknown"


def test_only_signs_and_lights_are_looked_at_in_the_scale_of_the_decoded_picture() -> None:
    picture, box = seen("no entry", 60)
    frame = Frame(0, "front", picture, (2 * picture.shape[1], 2 * picture.shape[0]))
    boxes = np.array([2.0 * box, 2.0 * box, 2.0 * box])
    labels = ("stop sign", "traffic light", "car")
    found = Detections(0, frame.size_px, boxes, np.ones(3), labels, (b"", b"", b""))

    assert with_looks(found, frame, labels[:1], labels[1:2]).looks == ("bar", "", "")
    assert with_looks(found, frame, ("halt",), ("lamp",)) is found


@pytest.mark.parametrize("housing", [(40, 40, 40), YELLOW])
@pytest.mark.parametrize("side_px", [36, 60, 150])
def test_light_drawn_on_a_yellow_sign_is_no_light(
    side_px: int, housing: tuple[int, int, int]
) -> None:
    """Boxes are of the drawing or of the whole sign; a yellow housing has no sign around it."""
    picture, whole = seen("signal ahead", side_px)
    drawing = whole + side_px * np.array([0.38, 0.3, -0.38, -0.3])
    street = np.full_like(picture, 110)
    x0, y0, x1, y1 = np.rint(drawing).astype(int).tolist()
    street[y0:y1, x0:x1] = housing

    assert look_at_light(picture, drawing) == look_at_light(picture, whole) == "yellow"
    assert look_at_light(street, drawing) == ""
    assert look_at_light(np.ascontiguousarray(picture[..., 0]), whole) == ""
    assert look_at_light(picture, np.zeros(4)) == ""


@pytest.mark.parametrize("kind", ["back", "no entry"])
def test_headlamps_at_night_leave_neither_red_nor_letters_to_tell_by(kind: str) -> None:
    picture, box = seen(kind, 40)
    day = look_at_sign(picture, box)
    picture[:] = np.where(np.all(picture == (90, 110, 100), axis=2)[..., None], 12, picture)

    assert day in OTHER_SIGNS
    assert look_at_sign(picture, box) == "unknown"


def test_look_at_sign_at_the_edge_uses_what_is_visible() -> None:
    picture, box = seen("stop", 60)
    aside = np.ascontiguousarray(picture[:, 43:])

    assert look_at_sign(aside, box - np.array([43.0, 0.0, 43.0, 0.0])) == "stop"
