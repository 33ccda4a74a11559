"""Overlays of detections: boxes, outlines, road, regions and moving cars.

Outlines are strips of a few points, and road is hatched every few rows. This takes a small fraction
of a mask's bytes and keeps the picture visible.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from crosscue.detectors import rle
from crosscue.detectors.base import ACCEPTED, Detections, RoadMask
from crosscue.detectors.cues.cars import (
    CarShapes,
    Pairs,
    car_shapes,
    cross_traffic,
    pair_cars,
    parked_cars,
)
from crosscue.detectors.cues.observed import FrameDetections, RoadFractions
from crosscue.detectors.cues.road import outlines, road_fractions
from crosscue.detectors.overlay import TrueMarks
from crosscue.replay.colours import FOUND, QUIET, ROAD, TRUTH, Colour
from crosscue.replay.vehicle.vehicle import Vehicle

from .columns import DriveTime, Shapes, arrows, boxes, labelled_strips, strips

# Width of the picture in the viewer, in points, as in a window of 1400 points.
PICTURE_POINTS: Final = 640.0
# Size of the viewer's text, the frame around it, and the distance below its box, in points.
LETTER: Final = (7.0, 17.0)
FRAME: Final = (10.0, 6.0)
BELOW: Final = 3.0
# Narrowest column into which the viewer wraps a label, in points.
NARROWEST: Final = 60.0


def label_places(
    boxes: NDArray[np.float64], texts: Sequence[str], width_px: int
) -> NDArray[np.float64]:
    """Return the rectangles of labels in the viewer, centred below their boxes, shape (N, 4)."""
    points = width_px / PICTURE_POINTS
    widths = LETTER[0] * np.array([len(text) for text in texts], np.float64)
    columns = np.maximum((boxes[:, 2] - boxes[:, 0]) / points, NARROWEST)
    lines = np.ceil(widths / columns)
    half_px = points * (np.minimum(widths, columns) + FRAME[0]) / 2.0
    middle_px, top_px = boxes[:, [0, 2]].mean(axis=1), boxes[:, 3] + BELOW * points
    bottom_px = top_px + points * (LETTER[1] * lines + FRAME[1])
    return np.stack([middle_px - half_px, top_px, middle_px + half_px, bottom_px], axis=1)


def labelled(
    boxes: NDArray[np.float64],
    texts: Sequence[str],
    scores: Sequence[float],
    size_px: tuple[int, int],
) -> list[bool]:
    """Return which boxes get a label: the surest first, each inside the picture and legible.

    Args:
        boxes: Corners x0, y0, x1, y1 in pixels, shape (N, 4).
        texts: Labels.
        scores: Scores of the detections; negative for boxes that only get in the way.
        size_px: Width and height of the picture.
    """
    places = label_places(boxes, texts, size_px[0])
    is_inside = (
        (np.asarray(scores) >= 0.0)
        & (places[:, :2] >= 0.0).all(axis=1)
        & (places[:, 2:] <= size_px).all(axis=1)
    )
    kept: list[int] = []
    for row in sorted(np.flatnonzero(is_inside).tolist(), key=lambda row: (-scores[row], row)):
        place = places[row]
        holds = (boxes[:, :2] <= place[:2]).all(axis=1) & (place[2:] <= boxes[:, 2:]).all(axis=1)
        if not any(_overlap(one, place) for one in (*places[kept], *boxes[~holds])):
            kept.append(row)
    return [row in kept for row in range(len(places))]


def _overlap(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    sizes = np.minimum(one[2:], other[2:]) - np.maximum(one[:2], other[:2])
    return bool((sizes > 0.0).all())


FRAMES_HELD: Final = 256
REGION: Final = (220, 220, 220)
CROSSING: Final = (255, 130, 30)
PARKED: Final = (190, 130, 255)
HATCH_ROWS: Final = 4
# Length of an arrow as a multiple of the step from one frame to the next.
ARROW_STEPS: Final = 4.0
# Min width of an object with a permanent label, as a fraction of the picture's width. Labels of
# smaller ones, and those without room, appear under the pointer.
LABELLED: Final = 0.1
# Width of the label of a region, as a fraction of the picture's.
REGION_LABEL: Final = 0.15
SIDES: Final = ("left", "straight", "right")


@dataclass(slots=True)
class Overlays:
    """Overlays of successive frames; keeps the cars of the previous frame.

    Attributes:
        vehicle: Settings with labels, thresholds and regions.
        texts: Lines on the roads of the intersection, by time of the frame.
    """

    vehicle: Vehicle
    texts: Mapping[int, Sequence[str]] = field(default_factory=dict)
    objects: Shapes = field(default_factory=lambda: Shapes("camera/objects", boxes))
    far: Shapes = field(default_factory=lambda: Shapes("camera/far_objects", boxes))
    outlines: Shapes = field(default_factory=lambda: Shapes("camera/outlines", strips))
    signs: Shapes = field(default_factory=lambda: Shapes("camera/sign_windows", boxes))
    road: Shapes = field(default_factory=lambda: Shapes("camera/road", strips))
    regions: Shapes = field(default_factory=lambda: Shapes("camera/regions", labelled_strips))
    cars: Shapes = field(default_factory=lambda: Shapes("camera/cars", arrows))
    legs: Shapes = field(default_factory=lambda: Shapes("camera/legs", boxes))
    area: Shapes = field(default_factory=lambda: Shapes("ahead/road", strips))
    openings: Shapes = field(default_factory=lambda: Shapes("ahead/openings", labelled_strips))
    _before: CarShapes | None = None

    def add(self, frame: FrameDetections, objects: Sequence[Detections]) -> None:
        """Draw one frame.

        Args:
            frame: The frame.
            objects: Its detections of objects, with the decisions of tracks on them.
        """
        for shapes in self.all():
            shapes.begin(frame.t_ns)
        self._boxes(objects, frame.signs, frame.size_px)
        if lines := self.texts.get(frame.t_ns):
            # The viewer writes the label of a box below it.
            top = np.array([0.0, 0.0, frame.size_px[0], 0.0])
            self.legs.add(top, FOUND, "\n".join(lines))
        if isinstance(frame.road, RoadMask):
            for line in road_lines(frame.road):
                self.road.add(line, ROAD)
        # Overlays anchored to the road or tracked over frames are drawn by ``anchored``.
        if self.vehicle.regions.kind == "picture":
            self._regions(frame.road, frame.size_px)
        if frame.objects and self.vehicle.cars.kind != "tracks":
            self._cars(frame.objects, frame.size_px)

    def all(self) -> Iterator[Shapes]:
        """Yield all shapes."""
        yield from (self.objects, self.far, self.outlines, self.signs)
        yield from (self.road, self.regions, self.cars, self.legs, self.area, self.openings)

    def send(self, recording: rr.RecordingStream, time: DriveTime) -> None:
        """Send the frames collected so far."""
        for shapes in self.all():
            shapes.send(recording, time)

    def _boxes(
        self, objects: Sequence[Detections], signs: Sequence[Detections], size_px: tuple[int, int]
    ) -> None:
        """Draw the boxes of a frame, with permanent labels where there is room for them."""
        drawn = [
            _Box(shapes, colour or self._colour(found, row), box, text, float(found.scores[row]))
            for shapes, group, colour in ((self.objects, objects, None), (self.signs, signs, FOUND))
            for found in group
            for box, text, row in _report_text(found)
        ]
        wide_px = {id(self.objects): LABELLED * size_px[0], id(self.signs): 0.0}
        large = [one for one in drawn if np.ptp(one.corners[[0, 2]]) >= wide_px[id(one.shapes)]]
        fits = labelled(
            np.array([one.corners for one in large], np.float64).reshape(-1, 4),
            [one.text for one in large],
            [-1.0 if one.colour == QUIET else one.score for one in large],
            size_px,
        )
        shown = {id(one) for one, has_label in zip(large, fits, strict=True) if has_label}
        for one in drawn:
            (one.shapes if id(one) in shown else self.far).add(one.corners, one.colour, one.text)
        for found in objects:
            for box, _, row in _report_text(found):
                for line in rle.outline(found.masks[row], found.size_px, box):
                    self.outlines.add(line, self._colour(found, row))

    def _colour(self, found: Detections, row: int) -> Colour:
        """Return the colour of a detection; grey if its score is too low for a cue."""
        cues, cars = self.vehicle.cues, self.vehicle.cars
        label = found.labels[row]
        is_sure = any(
            label in labels and found.are_sure(min_score)[row]
            for labels, min_score in (
                (cars.labels, cars.score),
                (cues.stop_sign_labels, cues.stop_sign_score),
                (cues.traffic_light_labels, cues.traffic_light_score),
                *((one.labels, one.score) for one in cues.own.values()),
            )
        )
        return FOUND if is_sure else QUIET

    def _regions(self, road: RoadMask | RoadFractions | None, size_px: tuple[int, int]) -> None:
        """Draw the regions, teal if they contain road; nothing without a detector of road."""
        if road is None:
            return
        fractions = (
            road_fractions(road, self.vehicle.regions) if isinstance(road, RoadMask) else road
        )
        positive = fractions.positive(self.vehicle.cues.road_fraction)
        shown = outlines(self.vehicle.regions, size_px)
        for side, is_road, corners in zip(SIDES, positive, shown, strict=True):
            colour = ROAD if is_road else REGION
            fraction = 100.0 * getattr(fractions, side)
            self.region(corners, colour, f"{side} {fraction:.0f} %", size_px)

    def region(
        self, corners: NDArray[np.float64], colour: Colour, text: str, size_px: tuple[int, int]
    ) -> None:
        """Draw the part of a region in the picture, unless its label would be cut off."""
        inside = np.clip(corners, 0.0, size_px)
        width_px, height_px = np.ptp(inside, axis=0)
        if height_px > 0.0 and width_px > REGION_LABEL * size_px[0]:
            self.regions.add(np.vstack([inside, inside[:1]]), colour, text)

    def _cars(self, found: tuple[Detections, ...], size_px: tuple[int, int]) -> None:
        now = car_shapes(found, self.vehicle.cars)
        before, self._before = self._before, now
        if before is None:
            return
        pairs = pair_cars(before, now, self.vehicle.cars)
        for i in range(len(pairs.nose)):
            one = Pairs(
                pairs.step_px[i : i + 1],
                pairs.center_px[i : i + 1],
                pairs.nose[i : i + 1],
                pairs.width_px,
            )
            if any(cross_traffic(one, self.vehicle.cars)):
                way_px = ARROW_STEPS * one.step_px[0]
                self.arrow(one.center_px[0], way_px, CROSSING, "crossing", size_px)
            elif any(parked_cars(one, self.vehicle.cars)):
                ahead = np.array([0.04 * pairs.width_px * float(one.nose[0]), 0.0])
                self.arrow(one.center_px[0], ahead, PARKED, "parked", size_px)

    def arrow(
        self,
        tail_px: Sequence[float] | NDArray[np.float64],
        way_px: NDArray[np.float64],
        colour: Colour,
        label: str,
        size_px: tuple[int, int],
    ) -> None:
        """Draw the part of an arrow in the picture."""
        tail = np.clip(tail_px, 0.0, size_px)
        way = way_px * _part_inside(tail, way_px, size_px)
        self.cars.add(np.concatenate([tail, way]), colour, label)


def _part_inside(
    tail_px: NDArray[np.float64], way_px: NDArray[np.float64], size_px: tuple[int, int]
) -> float:
    """Return the fraction of an arrow that is inside the image, to which the viewer adapts."""
    room_px = np.where(way_px > 0.0, np.subtract(size_px, tail_px), tail_px)
    leaves = np.abs(way_px) > room_px
    return float(np.min(room_px[leaves] / np.abs(way_px[leaves]), initial=1.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Box:
    shapes: Shapes
    colour: Colour
    corners: NDArray[np.float64]
    text: str
    score: float


def _report_text(found: Detections) -> Iterator[tuple[NDArray[np.float64], str, int]]:
    """Yield box, text and row of each detection."""
    for row, (label, score) in enumerate(zip(found.labels, found.scores.tolist(), strict=True)):
        why = found.decisions[row] if found.decisions else ""
        text = f"{label} {score:.2f}" + (f", {why}" if why not in ("", ACCEPTED) else "")
        yield found.boxes_px[row], text, row


def road_lines(road: RoadMask) -> list[NDArray[np.float64]]:
    """Return the road's outline and a line along every few rows of it, in pixels."""
    width, height = road.mask_size_px
    scale = np.array(road.size_px, np.float64) / (width, height)
    is_road = road.pixels()
    padded = np.zeros((-(-height // HATCH_ROWS), width + 2), np.int8)
    padded[:, 1:-1] = is_road[::HATCH_ROWS]
    # Starts and ends of runs alternate along a row, so successive pairs are the ends of one run.
    rows, columns = np.nonzero(np.diff(padded, axis=1))
    hatch = np.stack([columns, HATCH_ROWS * rows + 0.5], axis=1).reshape(-1, 2, 2)
    return [line * scale for line in (*rle.borders(is_road, (0, 0)), *hatch)]


def log_true_boxes(
    recording: rr.RecordingStream, time: DriveTime, marks: Mapping[int, TrueMarks]
) -> None:
    """Log the labelled boxes of each frame; their labels appear under the pointer."""
    shapes = Shapes("camera/truth", boxes)
    for t_ns, true in sorted(marks.items()):
        shapes.begin(t_ns)
        for label, box in true.boxes:
            shapes.add(np.array(box), TRUTH, f"true: {label}")
    shapes.send(recording, time)
    style = rr.Boxes2D.from_fields(radii=[_points(1.5)], show_labels=False)
    recording.log("camera/truth", style, static=True)


def log_styles(recording: rr.RecordingStream) -> None:
    """Log line widths in screen points, and labels where there is enough room."""
    boxes_style = rr.Boxes2D.from_fields(radii=[_points(1.0)], show_labels=True)
    recording.log("camera/legs", boxes_style, static=True)
    recording.log("camera/objects", boxes_style, static=True)
    recording.log("camera/sign_windows", boxes_style, static=True)
    far_style = rr.Boxes2D.from_fields(radii=[_points(1.0)], show_labels=False)
    recording.log("camera/far_objects", far_style, static=True)
    for entity, width in (("outlines", 1.5), ("road", 0.6), ("regions", 1.2)):
        style = rr.LineStrips2D.from_fields(radii=[_points(width)])
        recording.log(f"camera/{entity}", style, static=True)
    recording.log(
        "camera/cars", rr.Arrows2D.from_fields(radii=[_points(2.5)], show_labels=False), static=True
    )


def _points(width: float) -> float:
    """Return a radius in screen points, which Rerun encodes as a negative number."""
    return -width
