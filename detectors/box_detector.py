"""Base class of detectors that find boxes in one picture at a time."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np

from .base import Detections, Frame, View
from .settings import Settings, identity_of, settings_of

ScoredBox: TypeAlias = tuple[str, float, Sequence[float]]
"""Label, score from 0 to 1, and x0, y0, x1, y1 in pixels of the decoded frame."""


class BoxDetector(Settings):
    """Base class of a detector of boxes. Its fields are its settings, typed and with defaults.

    A subclass sets ``name`` and ``labels`` and implements ``boxes_in``. Its ``build`` is the
    factory for ``--detectors module:Class.build``, a table of detectors or an entry point.

    Attributes:
        name: Name in error messages.
        labels: All class names that it can report.
        view: Resolution and channels of the frames that it needs.
        version: Increment it when the same pixels and settings yield different boxes than before,
            so that outdated cached results are not used.
    """

    name: ClassVar[str]
    labels: ClassVar[tuple[str, ...]]
    view: ClassVar[View] = View()
    version: ClassVar[int] = 1

    @abstractmethod
    def boxes_in(self, frame: Frame) -> Iterable[ScoredBox]:
        """Find the boxes in one frame."""

    @classmethod
    def build(cls, **given: Any) -> Self:
        """Build the detector with these settings.

        Raises:
            VehicleError: A setting is unknown or its value is invalid.
        """
        return settings_of(cls, given, f"detector {cls.name}")

    @property
    def identity(self) -> str:
        """Text that changes with the name, the version and the settings."""
        return identity_of(self.name, self.version, self.model_dump())

    def __call__(self, frames: Sequence[Frame], /) -> Sequence[Detections]:
        """Return the detections of each frame."""
        return [self._detections(frame) for frame in frames]

    def _detections(self, frame: Frame) -> Detections:
        found = list(self.boxes_in(frame))
        boxes = np.array([box for _, _, box in found], np.float64).reshape(-1, 4)
        return Detections(
            frame.t_ns,
            frame.size_px,
            boxes * np.tile(frame.scale, 2),
            np.array([score for _, score, _ in found], np.float64),
            tuple(label for label, _, _ in found),
            (b"",) * len(found),
        )
