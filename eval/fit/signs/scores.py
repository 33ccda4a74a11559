"""Scoring of a sign detector on labelled pictures, from files or from drives with truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from crosscue.detectors.base import Detections, Detector, Frame
from crosscue.detectors.images import decode, read_file
from crosscue.detectors.training.operating_point import Verdicts, concatenate_verdicts, match_signs
from crosscue.eval.fit.signs.drives import drive_pictures
from crosscue.eval.fit.signs.labels import SignPicture, read_sign_labels
from crosscue.replay.columns import Floats
from crosscue.replay.errors import LogError, UsageError
from crosscue.replay.limits import DEFAULT_LIMITS, Limits


@dataclass(frozen=True, slots=True)
class ScoringRules:
    """Rules by which detections are scored.

    Attributes:
        labels: Labels of the signs to find.
        min_overlap: Min intersection over union with the true box.
        min_height_px: Min height of a true sign; smaller ones do not count.
    """

    labels: Sequence[str]
    min_overlap: float
    min_height_px: float = 0.0

    @property
    def of_judge(self) -> tuple[float, float]:
        """Arguments of ``match_signs``."""
        return self.min_overlap, self.min_height_px


def judged_pictures(
    path: Path,
    detector: Detector,
    rules: ScoringRules,
    every: slice,
    limits: Limits = DEFAULT_LIMITS,
) -> Verdicts:
    """Return a detector's detections in pictures of a file or drive, judged by the labels.

    Args:
        path: A file with labels, or a drive's folder.
        detector: Detector of signs.
        rules: Rules of scoring.
        every: Slice of the pictures to use.
        limits: Limits for reading a drive's log.

    Raises:
        UsageError: The file does not exist, or a box is outside its picture.
        LogError: A picture or a drive's log cannot be read.
        SchemaError: A drive has no truth, or its truth is invalid.
    """
    chosen = islice(_labelled(path, limits), every.start, every.stop, every.step)
    return concatenate_verdicts([_judged(one, detector, rules) for one in chosen])


def _labelled(path: Path, limits: Limits) -> Iterator[SignPicture]:
    yield from drive_pictures(path, limits) if path.is_dir() else read_sign_labels(path)


def _judged(one: SignPicture, detector: Detector, rules: ScoringRules) -> Verdicts:
    try:
        picture = read_file(one.picture) if isinstance(one.picture, Path) else one.picture
        pixels, size = decode(picture, detector.view)
    except OSError as error:
        raise LogError(f"{one.name}: {error.strerror}; check the picture column") from None
    except LogError as error:
        if one.lose is not None:
            one.lose(error)
            return concatenate_verdicts([])
        raise type(error)(f"{one.name}: {error}; repair the picture or leave it out") from None
    width, height = size
    found = detector([Frame(0, one.name, pixels, size)])[0]
    if not isinstance(found, Detections):
        raise UsageError("the detector returns no boxes; choose one for signs")
    parts = []
    for label in rules.labels:
        truth: Floats = np.array(one.boxes.get(label, []), np.float64).reshape(-1, 4)
        if len(truth) and (truth.min() < -1 or (truth[:, 2:] > (width + 1, height + 1)).any()):
            raise UsageError(
                f"{one.name}: a box lies outside its {width} x {height} px; correct it"
            )
        which = np.array([name == label for name in found.labels], np.bool_)
        parts.append(
            match_signs(found.boxes_px[which], found.scores[which], truth, *rules.of_judge)
        )
    return concatenate_verdicts(parts)
