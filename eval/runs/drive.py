"""A drive as it crosses the stages of a replay."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from crosscue.replay.base import EVERYTHING, Log, Selection
from crosscue.replay.columns import Topic
from crosscue.replay.errors import EmptyResultError
from crosscue.replay.logs.opening import unless_damaged
from crosscue.replay.signals.plan import chosen_camera
from crosscue.replay.time.segments import ONE_SEGMENT, Timeline

if TYPE_CHECKING:
    from crosscue.replay.vehicle.vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive: its logs, its car, the part of it to use, and its time segments.

    Attributes:
        logs: All open logs.
        vehicle: Settings of the vehicle file.
        selection: The part of the logs to use.
        segments: Time segments and clocks, found once (``drive_time``).
    """

    logs: Sequence[Log]
    vehicle: Vehicle
    selection: Selection = EVERYTHING
    segments: Timeline = ONE_SEGMENT

    @property
    def topics(self) -> list[tuple[int, Topic]]:
        """Topics of all logs, each with the index of its log."""
        return [(i, topic) for i, log in enumerate(self.logs) for topic in log.topics]

    @property
    def camera(self) -> tuple[int, Topic] | None:
        """Index of the camera's log, and its topic; None without a camera.

        Raises:
            VehicleError: There are several cameras.
        """
        return chosen_camera(self.topics, self.vehicle)

    def only_camera(self) -> tuple[int, Topic]:
        """Return the camera, which must exist.

        Raises:
            VehicleError: There are several cameras.
            EmptyResultError: There is none.
            LogError: There is none, and a log is damaged.
        """
        camera = self.camera
        with unless_damaged(self.logs, EmptyResultError):
            if camera is None:
                raise EmptyResultError(
                    f"{self.logs[0].path}: no camera in the logs, which detectors and landmarks "
                    "need; name its topic under [topics], or leave them out"
                )
        return camera
