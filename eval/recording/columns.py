"""Collection of frames' rows into columns that are sent some hundred frames at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, TypeAlias

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from crosscue.replay.colours import Colour

Geometry: TypeAlias = list[NDArray[np.float64]]
Packed: TypeAlias = NDArray[np.uint32]
# Function from geometry, packed colours and labels to Rerun's columns.
ToColumns: TypeAlias = Callable[[Geometry, Packed, list[str]], rr.ComponentColumnList]


@dataclass(slots=True)
class Shapes:
    """Shapes drawn in frames, any number in each frame, including none.

    Attributes:
        entity: Path of the Rerun entity.
        to_columns: Function that makes Rerun's columns.
        geometry: One array for each shape.
    """

    entity: str
    to_columns: ToColumns
    geometry: Geometry = field(default_factory=list)
    colours: list[Colour] = field(default_factory=list)
    labels: list[str] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)

    def begin(self, t_ns: int) -> None:
        """Start a frame; shapes added next belong to it."""
        self.times.append(t_ns)
        self.counts.append(0)

    def add(self, geometry: NDArray[np.float64], colour: Colour, label: str = "") -> None:
        """Add a shape to the current frame."""
        self.geometry.append(geometry)
        self.colours.append(colour)
        self.labels.append(label)
        self.counts[-1] += 1

    def send(self, recording: rr.RecordingStream, time: DriveTime) -> None:
        """Send and discard the collected frames."""
        if not self.times:
            return
        columns = self.to_columns(self.geometry, pack_colours(self.colours), self.labels)
        recording.send_columns(
            self.entity, indexes=time.column(self.times), columns=columns.partition(self.counts)
        )
        for held in (self.geometry, self.colours, self.labels, self.times, self.counts):
            held.clear()


def boxes(geometry: Geometry, colours: Packed, labels: list[str]) -> rr.ComponentColumnList:
    """Return the columns of boxes; geometry: x0, y0, x1, y1."""
    corners = np.asarray(geometry, np.float32).reshape(-1, 4)
    return rr.Boxes2D.columns(
        centers=(corners[:, :2] + corners[:, 2:]) / 2,
        half_sizes=(corners[:, 2:] - corners[:, :2]) / 2,
        colors=colours,
        labels=labels,
    )


def strips(
    geometry: Geometry,
    colours: Packed,
    labels: list[str],
    *,
    kind: type[rr.LineStrips2D | rr.LineStrips3D] = rr.LineStrips2D,
    has_labels: bool = False,
) -> rr.ComponentColumnList:
    """Return the columns of line strips; geometry: shape (N, 2), or (N, 3) in space."""
    lines = [np.asarray(line, np.float32) for line in geometry]
    return kind.columns(strips=lines, colors=colours, labels=labels if has_labels else None)


labelled_strips: Final[ToColumns] = partial(strips, has_labels=True)
strips_above: Final[ToColumns] = partial(strips, kind=rr.LineStrips3D)


def arrows(geometry: Geometry, colours: Packed, labels: list[str]) -> rr.ComponentColumnList:
    """Return the columns of arrows; geometry: x, y of the tail, then of the vector to the tip."""
    both = np.asarray(geometry, np.float32).reshape(-1, 4)
    return rr.Arrows2D.columns(
        origins=both[:, :2], vectors=both[:, 2:], colors=colours, labels=labels
    )


def points(geometry: Geometry, colours: Packed, labels: list[str]) -> rr.ComponentColumnList:
    """Return the columns of points; geometry: x, y."""
    places = np.asarray(geometry, np.float32).reshape(-1, 2)
    return rr.Points2D.columns(positions=places, colors=colours, labels=labels)


def pack_colours(colours: Sequence[Colour]) -> Packed:
    """Return colours as Rerun's packed RGBA, opaque."""
    rgb = np.asarray(colours, np.uint32).reshape(-1, 3)
    return (rgb @ np.array([1 << 24, 1 << 16, 1 << 8], np.uint32) + 0xFF).astype(np.uint32)


# Name of the timeline; the viewer reserves ``log_time`` for the wall clock of logging.
TIMELINE: Final = "drive"


@dataclass(frozen=True, slots=True)
class DriveTime:
    """Display of a drive's times.

    Attributes:
        is_date: True to show dates; False to show durations, for clocks that start at boot.
    """

    is_date: bool

    def column(self, t_ns: NDArray[np.int64] | Sequence[int]) -> list[rr.TimeColumn]:
        """Return the index for ``send_columns`` of rows at these times."""
        times = np.asarray(t_ns, np.int64)
        if self.is_date:
            return [rr.TimeColumn(TIMELINE, timestamp=times.astype("datetime64[ns]"))]
        return [rr.TimeColumn(TIMELINE, duration=times.astype("timedelta64[ns]"))]
