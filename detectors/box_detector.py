"""Base class of detectors that find boxes in one picture at a time."""

import inspect
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from math import isfinite
from typing import Any, ClassVar, Final, Self, TypeAlias

import numpy as np

from crosscue.replay.errors import UsageError, VehicleError

from .base import Detections, Frame, View
from .settings import Settings, identity_of, settings_of

# Label, score from 0 to 1, and x0, y0, x1, y1 in pixels of the decoded frame.
ScoredBox: TypeAlias = tuple[str, float, Sequence[float]]
_ITEM: Final = "(label, score, (x0, y0, x1, y1)) with finite numbers"


class BoxDetector(Settings):
    """Base class of a detector of boxes. Its fields are its settings, typed and with defaults.

    A subclass sets ``labels`` and implements ``boxes_in``. This is a whole detector::

        import cv2
        import crosscue

        class Red(crosscue.BoxDetector):
            name, labels = "red", ("stop sign",)  # with a space, as cues spell it
            min_area_px: float = 100.0  # a setting of the vehicle file

            def boxes_in(self, frame):
                blue, green, red = cv2.split(frame.pixels)  # BGR, as OpenCV has it
                is_red = (red > 150) & (green < 80) & (blue < 80)
                found = cv2.connectedComponentsWithStats(is_red.astype("uint8"))[2][1:]
                for x, y, width, height, area in found.tolist():
                    if area > self.min_area_px:
                        score = area / (width * height)  # 0 to 1; above 0.5 it counts for a cue
                        yield "stop sign", score, (x, y, x + width, y + height)

    ``crosscue.replay_drive(log, run, detectors=[Red])`` runs it, or ``--detectors module:Red`` of a
    module that can be imported. Each result is checked: order of corners, inside the picture,
    score, label.

    Attributes:
        name: Name in error messages; default: that of the class.
        labels: All class names that it can report.
        view: Resolution and channels of the frames that it needs.
        version: Increment it when the same pixels and settings yield different boxes than before,
            so that outdated cached results are not used.
    """

    name: ClassVar[str]
    labels: ClassVar[tuple[str, ...]]
    view: ClassVar[View] = View()
    version: ClassVar[int] = 1

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Name a class that has no name after itself."""
        super().__pydantic_init_subclass__(**kwargs)
        if "name" not in vars(cls):
            cls.name = cls.__name__

    @abstractmethod
    def boxes_in(self, frame: Frame) -> Iterable[ScoredBox]:
        """Yield label, score and corners of each box in one frame.

        Args:
            frame: Its ``pixels`` are BGR, shape (H, W, 3), or grey (H, W) by ``view``.

        Returns:
            For each box: one of ``labels``; a score from 0 to 1; x0, y0, x1, y1 in pixels of
            ``frame.pixels``, with x0 <= x1 and y0 <= y1, inside the picture.
        """

    @classmethod
    def build(cls, **given: Any) -> Self:
        """Build the detector with these settings.

        Raises:
            VehicleError: A setting is unknown or its value is invalid, or there are no labels.
        """
        return settings_of(cls, given, f"detector {cls.name}")

    def model_post_init(self, _: object) -> None:
        """Refuse a class without labels."""
        labels = getattr(self, "labels", None)
        if not labels or isinstance(labels, str):
            raise VehicleError(
                f"detector {self.name}: {'no labels' if not labels else f'labels is {labels!r}'}; "
                'set labels = ("stop sign",) or what it reports'
            )

    @property
    def identity(self) -> str:
        """Text that changes with the name, the version and the settings."""
        return identity_of(self.name, self.version, self.model_dump())

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Detections]:
        """Return the detections of each frame."""
        return [self._detections(frame) for frame in frames]

    def _detections(self, frame: Frame) -> Detections:
        return as_detections(frame, self.boxes_in(frame))


def as_detections(frame: Frame, found: Iterable[ScoredBox]) -> Detections:
    """Return boxes in pixels of the decoded frame as detections in the camera's pixels.

    Raises:
        UsageError: An item is not a label, a score and four numbers.
    """
    labels, scores, boxes = [], [], []
    where = f"frame at {frame.t_ns} ns: "
    if not isinstance(found, Iterable):
        raise UsageError(f"{where}returned {_short(found)}; expected {_ITEM} for each box, or none")
    for i, item in enumerate(found):
        try:
            label, score, corners = item
            numbers = [float(score), *map(float, corners)]
        except (TypeError, ValueError):
            label, numbers = None, []
        if len(numbers) != 5 or not isinstance(label, str) or not all(map(isfinite, numbers)):
            raise UsageError(f"{where}box {i}: yielded {_short(item)}; expected {_ITEM}")
        labels.append(label)
        scores.append(numbers[0])
        boxes.append(numbers[1:])
    return Detections(
        frame.t_ns,
        frame.size_px,
        np.array(boxes, np.float64).reshape(-1, 4) * np.tile(frame.scale, 2),
        np.array(scores, np.float64),
        tuple(labels),
        (b"",) * len(labels),
    )


def _short(value: object) -> str:
    return " ".join(repr(value).split())[:80]


class FunctionDetector:
    """Detector of one function from a frame to its boxes, as ``BoxDetector.boxes_in`` yields them.

    Attributes:
        view: Full size, in colour.
        identity: Name and hash of the function's source.
    """

    view: ClassVar[View] = View()

    def __init__(self, function: Callable[[Frame], Iterable[ScoredBox]]) -> None:
        """Wrap a function.

        Raises:
            UsageError: Its source cannot be read, as of one typed at Python's prompt.
        """
        self._function = function
        try:
            source = inspect.getsource(function)
        except OSError:
            raise UsageError(
                f"{function.__name__}: its source cannot be read; define it in a module"
            ) from None
        self.identity = identity_of(function.__qualname__, source)

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Detections]:
        """Return the detections of each frame."""
        return [as_detections(frame, self._function(frame)) for frame in frames]
