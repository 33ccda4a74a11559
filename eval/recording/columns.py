"""Rows of frames gathered into columns and sent some hundred frames at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

Colour: TypeAlias = tuple[int, int, int]


@dataclass(slots=True)
class Shapes:
    """Things drawn in frames: every frame has any number of them, also none.

    Attributes:
        entity: Where they go.
        to_columns: From geometry (a list of arrays), colours and labels to Rerun's columns.
        geometry: One array for each thing.
    """

    entity: str
    to_columns: Callable[
        [list[NDArray[np.float64]], list[Colour], list[str]], rr.ComponentColumnList
    ]
    geometry: list[NDArray[np.float64]] = field(default_factory=list)
    colours: list[Colour] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    def begin(self, t_ns: int) -> None:
        """A frame; what is added next belongs to it."""
        self.times.append(t_ns)
        self.counts.append(0)

    def add(self, geometry: NDArray[np.float64], colour: Colour, label: str = "") -> None:
        """One thing of the frame begun last."""
        self.geometry.append(geometry)
        self.colours.append(colour)
        self.labels.append(label)
        self.counts[-1] += 1

    def send(self, recording: rr.RecordingStream, time: DriveTime) -> None:
        """Send what has been gathered, and forget it."""
        if not self.times:
            return
        columns = self.to_columns(self.geometry, self.colours, self.labels)
        recording.send_columns(
            self.entity, indexes=time.column(self.times), columns=columns.partition(self.counts)
        )
        for held in (self.geometry, self.colours, self.labels, self.times, self.counts):
            held.clear()


def boxes(
    geometry: list[NDArray[np.float64]], colours: list[Colour], labels: list[str]
) -> rr.ComponentColumnList:
    """Geometry: x0, y0, x1, y1."""
    corners = np.asarray(geometry, np.float32).reshape(-1, 4)
    return rr.Boxes2D.columns(
        centers=(corners[:, :2] + corners[:, 2:]) / 2,
        half_sizes=(corners[:, 2:] - corners[:, :2]) / 2,
        colors=packed(colours),
        labels=labels,
    )


def strips(
    geometry: list[NDArray[np.float64]], colours: list[Colour], _labels: list[str]
) -> rr.ComponentColumnList:
    """Geometry: shape (N, 2)."""
    lines = [np.asarray(line, np.float32) for line in geometry]
    return rr.LineStrips2D.columns(strips=lines, colors=packed(colours))


def labelled_strips(
    geometry: list[NDArray[np.float64]], colours: list[Colour], labels: list[str]
) -> rr.ComponentColumnList:
    """The same with a label each."""
    lines = [np.asarray(line, np.float32) for line in geometry]
    return rr.LineStrips2D.columns(strips=lines, colors=packed(colours), labels=labels)


def strips_above(
    geometry: list[NDArray[np.float64]], colours: list[Colour], _labels: list[str]
) -> rr.ComponentColumnList:
    """In space; geometry: shape (N, 3)."""
    lines = [np.asarray(line, np.float32) for line in geometry]
    return rr.LineStrips3D.columns(strips=lines, colors=packed(colours))


def arrows(
    geometry: list[NDArray[np.float64]], colours: list[Colour], labels: list[str]
) -> rr.ComponentColumnList:
    """Geometry: x, y of the tail, then of the way to the tip."""
    both = np.asarray(geometry, np.float32).reshape(-1, 4)
    return rr.Arrows2D.columns(
        origins=both[:, :2], vectors=both[:, 2:], colors=packed(colours), labels=labels
    )


def points(
    geometry: list[NDArray[np.float64]], colours: list[Colour], labels: list[str]
) -> rr.ComponentColumnList:
    """Geometry: x, y."""
    places = np.asarray(geometry, np.float32).reshape(-1, 2)
    return rr.Points2D.columns(positions=places, colors=packed(colours), labels=labels)


def packed(colours: Sequence[Colour]) -> NDArray[np.uint32]:
    """As Rerun keeps colours: red first, opaque."""
    rgb = np.asarray(colours, np.uint32).reshape(-1, 3)
    return (rgb @ np.array([1 << 24, 1 << 16, 1 << 8], np.uint32) + 0xFF).astype(np.uint32)


TIMELINE: Final = "drive"
"""Not ``log_time``: under that name the viewer keeps the wall clock of the logging itself."""
YEAR_2000_NS: Final = 946_684_800_000_000_000


@dataclass(frozen=True, slots=True)
class DriveTime:
    """How a drive's times are shown.

    Attributes:
        is_date: As dates; else as durations, for logs on a clock that begins with the machine.
    """

    is_date: bool

    def column(self, t_ns: NDArray[np.int64] | Sequence[int]) -> list[rr.TimeColumn]:
        """The index of ``send_columns`` for rows at these times."""
        times = np.asarray(t_ns, np.int64)
        if self.is_date:
            return [rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))]
        return [rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))]


def time_of(first_ns: int) -> DriveTime:
    """For a drive that begins then."""
    return DriveTime(first_ns > YEAR_2000_NS)
