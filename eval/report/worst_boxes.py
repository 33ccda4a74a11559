"""Pictures with the most mistakes of a detector, with false boxes and misses drawn."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from crosscue.detectors.base import View
from crosscue.detectors.images import Encoded, decode
from crosscue.detectors.overlay import FOUND, TRUE, write_label
from crosscue.eval.runs.stored_images import StoredCamera, picture_at, run_camera
from crosscue.eval.scoring.boxes.labelled_run import LabelledRun
from crosscue.eval.scoring.boxes.matching import match
from crosscue.replay import colours
from crosscue.replay.columns import Bytes, Floats
from crosscue.replay.errors import CrosscueError

# Pictures closer in time than this show the same mistakes, so only the worst is shown.
APART_NS: Final = 1_000_000_000
WIDTH_PX: Final = 960
QUALITY: Final = 80
WRONG: Final = colours.bgr(colours.WRONG)
GREY: Final = (150, 150, 150)


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """A box to draw."""

    box_px: Floats
    colour: tuple[int, int, int]
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class WorstPicture:
    """One picture with mistakes.

    Attributes:
        name: Name of the picture in the labels.
        t_ns: Time of the frame.
        wrong: Number of detections above the threshold that match no label.
        missed: Number of labels that no detection above the threshold matches.
        picture: JPEG in base64, or None if it cannot be read.
    """

    name: str
    t_ns: int
    wrong: int
    missed: int
    picture: str | None = None


def worst_pictures(labelled: LabelledRun, overlap: float, max_count: int) -> list[WorstPicture]:
    """Return the pictures with the most mistakes, at most one for each moment.

    Raises:
        RunError: The log with the pictures is not found.
        LogError: That log cannot be opened.
    """
    marks = _marks(labelled, overlap)
    order = sorted(
        (i for i in range(len(marks)) if any(one.colour in (WRONG, TRUE) for one in marks[i])),
        key=lambda i: (-sum(one.colour in (WRONG, TRUE) for one in marks[i]), i),
    )
    chosen: list[int] = []
    for i in order:
        if len(chosen) < max_count and all(
            abs(int(labelled.t_ns[i] - labelled.t_ns[k])) >= APART_NS for k in chosen
        ):
            chosen.append(i)
    camera = run_camera(labelled.run) if chosen else None
    return [
        WorstPicture(
            labelled.names[i],
            int(labelled.t_ns[i]),
            sum(one.colour == WRONG for one in marks[i]),
            sum(one.colour == TRUE for one in marks[i]),
            _picture(camera, int(labelled.t_ns[i]), marks[i]),
        )
        for i in chosen
    ]


def _marks(labelled: LabelledRun, overlap: float) -> list[list[Drawn]]:
    """Return the ignored, right, missed and wrong boxes of each picture."""
    truth, found = labelled.truth, labelled.found
    marks: list[list[Drawn]] = [[] for _ in labelled.names]
    for row in np.flatnonzero(truth.is_ignored).tolist():
        marks[truth.picture[row]].append(Drawn(truth.boxes_px[row], GREY, ""))
    for k, name in enumerate(labelled.classes):
        matched = match(truth, found, k, overlaps=np.array([overlap]))
        sure = matched.scores > labelled.threshold(name)
        hit = set(matched.took[0][sure].tolist())
        for row in np.flatnonzero((truth.label == k) & ~truth.is_ignored).tolist():
            if row not in hit:
                missed = Drawn(truth.boxes_px[row], TRUE, f"missed {name}")
                marks[truth.picture[row]].append(missed)
        for is_some, colour in ((matched.is_right[0], FOUND), (matched.is_wrong[0], WRONG)):
            for i in np.flatnonzero(is_some & sure).tolist():
                row = matched.row[i]
                text = f"{name} {matched.scores[i]:.2f}"
                marks[found.picture[row]].append(Drawn(found.boxes_px[row], colour, text))
    return marks


def _picture(camera: StoredCamera | None, t_ns: int, marks: Sequence[Drawn]) -> str | None:
    if camera is None:
        return None
    try:
        found = picture_at(camera, t_ns)
        return None if found is None else _drawn(found, marks)
    except CrosscueError:
        # The page states that this picture cannot be read.
        return None


def _drawn(picture: Encoded, marks: Sequence[Drawn]) -> str | None:
    import cv2

    pixels, whole = decode(picture, View(min_width_px=WIDTH_PX))
    size = (WIDTH_PX, round(whole[1] * WIDTH_PX / whole[0]))
    canvas: Bytes = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    for one in marks:
        x0, y0, x1, y1 = np.rint(one.box_px * (size[0] / whole[0])).astype(int).tolist()
        thick = 1 if one.colour in (GREY, FOUND) else 2
        cv2.rectangle(canvas, (x0, y0), (x1, y1), one.colour, thick)
        if thick == 2:
            write_label(canvas, one.text, (x0, max(y0 - 4, 12)), one.colour, 0.4)
    ok, jpeg = cv2.imencode(".jpg", canvas, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return base64.b64encode(jpeg.tobytes()).decode() if ok else None
