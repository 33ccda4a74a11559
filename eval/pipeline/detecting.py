"""Options of the detect stage, which a replay without detectors has, too."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from crosscue.replay.vehicle.vehicle import Vehicle
from crosscue.verb import compared

if TYPE_CHECKING:
    from crosscue.detectors.base import DetectorChoice


@dataclass(frozen=True, slots=True)
class Detecting:
    """Options of the detect stage.

    Attributes:
        choices: Detectors, in order.
        cache: File with results of earlier runs, or None.
        draw: Number of pictures to write with detections drawn.
        resume: Keep detections of an earlier start that would be the same.
        is_required: The user named the detectors, so a drive without a camera is an error.
    """

    choices: tuple[DetectorChoice, ...]
    cache: Path | None = field(default=None, compare=False)
    draw: int = 0
    resume: bool = field(default=False, compare=False)
    is_required: bool = field(default=False, compare=False)

    def as_json(self) -> dict[str, object]:
        """Return the options that determine the result, as JSON values."""
        options = compared(self)
        options.pop("choices")
        return {"detectors": [choice.as_row() for choice in self.choices], **options}


def choices_of(vehicle: Vehicle) -> dict[str, DetectorChoice]:
    """Return the detectors that the vehicle file defines, by name."""
    from crosscue.detectors.base import DetectorChoice  # a replay without detectors needs none

    return {
        name: DetectorChoice(
            name,
            section.kind,
            section.settings | ({} if section.card is None else {"card": section.card}),
        )
        for name, section in vehicle.detectors.items()
    }
