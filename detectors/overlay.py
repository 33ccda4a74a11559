"""Draw detections and cues into pictures, for visual inspection."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from crosscue.replay import colours
from crosscue.replay.columns import Bytes
from crosscue.replay.files.whole_file import write_bytes

from . import rle
from .base import Detections, Found, RoadMask
from .images import Encoded, decode

FOUND: Final = colours.bgr(colours.FOUND)
TRUE: Final = colours.bgr(colours.TRUTH)
PALE: Final = (230, 230, 230)
# Margin to the left and right of the line of cues.
MARGIN_PX: Final = 10


class TrueMarks(NamedTuple):
    """What is true in a picture.

    Attributes:
        boxes: Labels and boxes (x0, y0, x1, y1) of labelled objects.
        counts: Number of objects of each cue that is present.
    """

    boxes: Sequence[tuple[str, tuple[float, float, float, float]]] = ()
    counts: Mapping[str, int] = MappingProxyType({})


NOTHING_TRUE: Final = TrueMarks()


@dataclass(slots=True)
class Drawer:
    """Writes pictures of frames that are evenly spaced along a drive of unknown length.

    It starts with every frame. Whenever there are too many pictures, it deletes every second one
    and doubles the interval.

    Attributes:
        folder: Created with the first picture.
        max_pictures: Maximum number of pictures.
    """

    folder: Path
    max_pictures: int
    _seen: int = field(default=0)
    _every: int = field(default=1)
    _written: list[Path] = field(default_factory=list)

    def __call__(self, t_ns: int, picture: Encoded, found: Sequence[Found]) -> None:
        """Draw and write one frame if its turn has come.

        Args:
            t_ns: Log time of the frame.
            picture: Encoded; decoded only if it is to be written.
            found: Result of each detector.

        Raises:
            OutputError: A picture cannot be written.
        """
        number, self._seen = self._seen, self._seen + 1
        if not self.max_pictures or number % self._every:
            return
        if len(self._written) == self.max_pictures:
            self._thin()
            if number % self._every:
                return
        pixels, _ = decode(picture)
        _, encoded = cv2.imencode(".jpg", _drawn(pixels, found, 1.0))
        path = self.folder / f"{t_ns}.jpg"
        write_bytes(path, encoded.tobytes())
        self._written.append(path)

    def _thin(self) -> None:
        for path in self._written[1::2]:
            path.unlink(missing_ok=True)
        del self._written[1::2]
        self._every *= 2


def draw_detections(
    pixels: Bytes, found: Sequence[Found], counts: Mapping[str, int], enlarge: float = 1.0
) -> Bytes:
    """Return a copy with tinted road, boxes with labels, and the positive cues at the bottom.

    Args:
        pixels: Shape (H, W, 3), uint8, blue first.
        found: Result of each detector.
        counts: Number of objects of each cue.
        enlarge: Factor on text and lines, for a picture that will be scaled down.
    """
    canvas = _drawn(pixels, found, enlarge)
    positive = [f"{cue} {count}" for cue, count in counts.items() if count]
    _line_of_text(canvas, "  ".join(positive) or "no cue", 14, (255, 255, 255), enlarge)
    return canvas


def _line_of_text(
    canvas: Bytes, text: str, above_px: int, colour: tuple[int, int, int], enlarge: float
) -> None:
    scale = _fitting(text, canvas.shape[1] - 2 * MARGIN_PX, 0.6 * enlarge)
    write_label(canvas, text, (MARGIN_PX, canvas.shape[0] - above_px), colour, scale)


def draw_frame(
    picture: Encoded,
    found: Sequence[Found],
    counts: Mapping[str, int],
    regions: Callable[[tuple[int, int]], Iterable[NDArray[np.float64]]],
    width_px: int,
    truth: TrueMarks = NOTHING_TRUE,
    lines: Sequence[str] = (),
) -> Bytes:
    """Draw all results of one frame: road, masks, boxes, regions and cues, and what is true.

    Args:
        picture: Encoded picture of the frame.
        found: Result of each detector; without any, nothing is drawn.
        counts: Number of objects of each cue.
        regions: Returns the regions' corners, shape (N, 2) each, for a picture of the given width
            and height. They are drawn only if a detector found road.
        width_px: Displayed width of the picture; lines and text are sized to be legible there.
        truth: Drawn in the colour of the truth.
        lines: Text at the top.

    Raises:
        LogError: The picture cannot be decoded.
    """
    pixels, _ = decode(picture)
    size = (pixels.shape[1], pixels.shape[0])
    enlarge = max(size[0] / width_px, 0.5)
    if not found and truth == NOTHING_TRUE and not lines:
        return np.asarray(pixels, np.uint8)
    canvas = draw_detections(pixels, found, counts, 0.8 * enlarge)
    for one in found:
        if isinstance(one, Detections):
            for box, mask in zip(one.boxes_px, one.masks, strict=True):
                for line in rle.outline(mask, one.size_px, box):
                    _line(canvas, line, FOUND, enlarge)
    has_road = any(isinstance(one, RoadMask) for one in found)
    for region in regions(size) if has_road else ():
        _line(canvas, np.vstack([region, region[:1]]), PALE, enlarge)
    for label, (x0, y0, x1, y1) in truth.boxes:
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        _line(canvas, corners, TRUE, 2.0 * enlarge)
        place = (round(x0), min(round(y1 + 14 * enlarge), size[1] - 4))
        write_label(canvas, label, place, TRUE, 0.4 * enlarge)
    if truth.counts:
        text = "true: " + "  ".join(f"{cue} {count}" for cue, count in truth.counts.items())
        _line_of_text(canvas, text, round(14 + 26 * enlarge), TRUE, 0.8 * enlarge)
    for number, text in enumerate(lines, 1):
        _line_of_text(canvas, text, size[1] - round(22 * enlarge * number), PALE, 0.8 * enlarge)
    return canvas


def _line(
    canvas: Bytes, points: NDArray[np.float64], colour: tuple[int, int, int], enlarge: float
) -> None:
    # A true box may reach far beyond the picture; OpenCV needs numbers that fit.
    far = 4.0 * max(canvas.shape[:2])
    whole = np.rint(np.clip(points, -far, far)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(canvas, [whole], False, colour, max(round(enlarge), 1), cv2.LINE_AA)


def encode_overlay(pixels: Bytes, found: Found) -> bytes:
    """Encode a picture as JPEG with one detector's boxes and labels, or road, drawn in."""
    _, encoded = cv2.imencode(".jpg", _drawn(pixels, (found,), max(pixels.shape[1] / 1280, 0.6)))
    return encoded.tobytes()


def _drawn(pixels: Bytes, results: Sequence[Found], enlarge: float) -> Bytes:
    canvas = pixels.copy()
    for found in results:
        if isinstance(found, RoadMask):
            _tint(canvas, found)
    for found in results:
        if isinstance(found, Detections):
            _boxes(canvas, found, enlarge)
    return canvas


def _fitting(text: str, width_px: int, scale: float) -> float:
    """Return the scale, reduced where necessary for the text to fit into ``width_px``."""
    # Strokes are whole pixels, so a text at half the scale is not half as wide: measure again.
    for _ in range(4):
        (wide, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, _thickness(scale))
        scale *= min(1.0, width_px / wide)
    return scale


def _tint(canvas: Bytes, road: RoadMask) -> None:
    mask = road.pixels().astype(np.uint8)
    size = (canvas.shape[1], canvas.shape[0])
    is_road = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST).astype(np.bool_)
    canvas[is_road] = canvas[is_road] // 2 + np.array(colours.bgr(colours.ROAD), np.uint8) // 2


def _boxes(canvas: Bytes, found: Detections, enlarge: float) -> None:
    for box, score, label in zip(found.boxes_px, found.scores, found.labels, strict=True):
        x0, y0, x1, y1 = (round(float(side)) for side in box)
        place = (x0, max(y0 - 4, round(12 * enlarge)))
        write_label(canvas, f"{label} {score:.2f}", place, FOUND, 0.5 * enlarge)
        # Drawn after the label: its dark box extends below the letters, in OpenCV 4 over this side.
        cv2.rectangle(canvas, (x0, y0), (x1, y1), FOUND, round(2 * enlarge))


def write_label(
    canvas: Bytes, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float
) -> None:
    """Write a text on a dark box; ``at`` is the left end of its baseline."""
    # A box, because from OpenCV 5 on an outline of thicker letters differs in width and covers
    # the text.
    thick = _thickness(scale)
    (wide, high), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    corners = (at[0] - 1, at[1] - high - 2), (at[0] + wide + 1, at[1] + below)
    cv2.rectangle(canvas, *corners, (0, 0, 0), -1)
    cv2.putText(canvas, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thick)


def _thickness(scale: float) -> int:
    """Thickness of a text's strokes in pixels."""
    return max(round(2 * scale), 1)
