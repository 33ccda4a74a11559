"""Frames of a run with their detections, read one by one from its tables."""

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from crosscue.detectors.base import Detections, RoadMask
from crosscue.detectors.cues.observed import (
    DetectorRole,
    FrameDetections,
    RoadFractions,
    all_labels,
)
from crosscue.detectors.cues.same_object import KEPT, label_meanings, same_objects
from crosscue.eval.runs.manifest import DetectManifest, DetectorRow
from crosscue.replay.vehicle.vehicle import Vehicle

from .parquet import TableFolder

NO_BOXES: Final = np.empty((0, 4))


@dataclass(slots=True)
class _Rows:
    """Forward reader of a table that returns the rows of one frame after another."""

    batches: Iterator[Any]
    names: Sequence[str]
    _frames: list[int] = field(default_factory=list)
    _rows: list[tuple[Any, ...]] = field(default_factory=list)
    _next: int = 0

    def of(self, frame: int) -> list[tuple[Any, ...]]:
        """Return the rows of a frame; call it with frames in order."""
        rows: list[tuple[Any, ...]] = []
        while self._fill():
            start = bisect_left(self._frames, frame, self._next)
            self._next = bisect_right(self._frames, frame, start)
            rows += self._rows[start : self._next]
            if self._next < len(self._frames):
                break
        return rows

    def _fill(self) -> bool:
        while self._next == len(self._frames):
            batch = next(self.batches, None)
            if batch is None:
                return False
            self._frames = batch["frame"].to_pylist()
            # Runs of older versions lack the newest columns.
            known, nothing = batch.schema.names, [None] * len(self._frames)
            columns = (batch[one].to_pylist() if one in known else nothing for one in self.names)
            self._rows, self._next = list(zip(*columns, strict=True)), 0
        return True


FOUND: Final = (
    "detector",
    "label",
    "score",
    "x0",
    "y0",
    "x1",
    "y1",
    "mask",
    "height_px",
    "lens",
    "same_as",
    "look",
)
SAME_AS: Final = FOUND.index("same_as")
SHARES: Final = ("fraction_left", "fraction_straight", "fraction_right")
MASK: Final = ("mask", "mask_width_px", "mask_height_px")


def stored_frames(
    run: TableFolder, detected: DetectManifest, vehicle: Vehicle, *, with_road_masks: bool = False
) -> Iterator[FrameDetections]:
    """Yield all frames of a run in the order of detection; memory holds one batch of rows.

    Detections for which another detector has a better score are in ``doubles``.

    Args:
        run: A run with the tables of the detect stage.
        detected: Manifest of the detect stage.
        vehicle: Settings, whose labels of cues decide which detections are of the same object.
        with_road_masks: Return road masks instead of road fractions of the regions.

    Raises:
        RunError: A table is missing or damaged.
    """
    detectors, meanings = detected.detectors, label_meanings(vehicle)
    is_changed = meanings != label_meanings(detected.settings)
    scores_of = {d.name: (d.min_scores, d.log_ratios) for d in detectors}
    objects = [d.name for d in detectors if d.role == DetectorRole.OBJECTS]
    signs = [d.name for d in detectors if d.role == DetectorRole.SIGNS]
    labels = all_labels(
        d.labels for d in detectors if d.role in (DetectorRole.OBJECTS, DetectorRole.SIGNS)
    )
    has_road = any(d.role == DetectorRole.ROAD for d in detectors)
    found = _Rows(run.batches("detections", ["frame", *FOUND]), FOUND)
    columns = MASK if with_road_masks else SHARES
    road = _Rows(run.batches("road", ["frame", *columns]), columns)
    for batch in run.batches("frames", ["frame", "t_ns", "width_px", "height_px"]):
        for frame, t_ns, width, height in zip(
            *(batch[name].to_pylist() for name in batch.schema.names), strict=True
        ):
            size = (width, height)
            by_name: dict[str, list[tuple[Any, ...]]] = {}
            again: dict[str, list[tuple[Any, ...]]] = {}
            rows = found.of(frame)
            if is_changed:
                rows = _compared(rows, detectors, meanings, t_ns, size)
            for row in rows:
                (by_name if row[SAME_AS] is None else again).setdefault(row[0], []).append(row)
            fractions = road.of(frame) if has_road else []
            some, others = (
                tuple(
                    _detections(t_ns, size, by_name.get(name, [])).with_min_scores(*scores_of[name])
                    for name in names
                )
                for names in (objects, signs)
            )
            yield FrameDetections(
                t_ns,
                some,
                others,
                _road(t_ns, size, fractions[0], with_road_masks) if fractions else None,
                labels,
                tuple(_detections(t_ns, size, rows) for rows in again.values()),
                size,
            )


def _compared(
    rows: list[tuple[Any, ...]],
    detectors: Sequence[DetectorRow],
    meanings: Mapping[str, str],
    t_ns: int,
    size: tuple[int, int],
) -> list[tuple[Any, ...]]:
    """Return the rows of a frame with the detector that found the same object with a better score.

    Rows keep their order, which is by detector.
    """
    parts = [[row for row in rows if row[0] == one.name] for one in detectors]
    found = [_detections(t_ns, size, part) for part in parts]
    same = same_objects(found, meanings, [one.is_calibrated for one in detectors])
    return [
        (*row[:SAME_AS], None if k == KEPT else detectors[k].name, *row[SAME_AS + 1 :])
        for part, again in zip(parts, same, strict=True)
        for row, k in zip(part, again.tolist(), strict=True)
    ]


def _detections(t_ns: int, size: tuple[int, int], rows: list[tuple[Any, ...]]) -> Detections:
    if not rows:
        return Detections(t_ns, size, NO_BOXES, np.empty(0), (), ())
    return Detections(
        t_ns,
        size,
        np.array([row[3:7] for row in rows], np.float64),
        np.array([row[2] for row in rows], np.float64),
        tuple(row[1] for row in rows),
        tuple(row[7] or b"" for row in rows),
        tuple(row[9] or "" for row in rows),
        looks=tuple(row[11] or "" for row in rows),
        spans_px=np.array([row[8] for row in rows], np.float64),
    )


def _road(
    t_ns: int, size: tuple[int, int], row: tuple[Any, ...], with_mask: bool
) -> RoadMask | RoadFractions:
    if with_mask:
        return RoadMask(t_ns, size, row[0], (row[1], row[2]))
    return RoadFractions(*row)
