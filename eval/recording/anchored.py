"""Overlays anchored to the road: its accumulated area, and the motion of cars.

Both need odometry and the estimated place of the intersection. They are therefore computed again
frame by frame, as in the scene stage.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections, Place
from crosscue.detectors.cues.tracked.judge import along, crossing, is_past, parked
from crosscue.detectors.cues.tracked.motion import CarMotion
from crosscue.eval.pipeline.scene.road_picture import opening_lines, plan_lines
from crosscue.eval.pipeline.scene.roads import Roads, pitches_of
from crosscue.eval.pipeline.scene.stage import EgoMotion, Restarts, intersection_place
from crosscue.eval.runs.folder import RunFolder
from crosscue.eval.runs.manifest import DriveManifest
from crosscue.eval.runs.tables.travelled import odometer_of
from crosscue.fusion.approaches import RangeRow
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.colours import FEATURES, ROAD
from crosscue.replay.vehicle.vehicle import Camera

from .marks import CROSSING, PARKED, Overlays

ALONG: Final = (235, 235, 235)
ARROW_S: Final = 1.0
NEAREST_M: Final = 1.0
# Length of a parked car's arrow as a fraction of the picture's width.
NOSE: Final = 0.04


@dataclass(slots=True)
class Anchored:
    """Tracking of cars and road over the frames, drawn into the marks of the same frame.

    Attributes:
        run: A run with odometry and ranges.
        manifest: Manifest of the run.
        marks: Marks to draw into.
    """

    run: RunFolder
    manifest: DriveManifest
    marks: Overlays
    _cues: CuePass = field(init=False)
    _ego: EgoMotion = field(init=False)
    _restarts: Restarts = field(init=False)
    _ranges: dict[int, list[RangeRow]] = field(init=False)
    _roads: Roads | None = None
    _before: list[RangeRow] = field(default_factory=list)

    def __post_init__(self) -> None:
        vehicle = self.manifest.settings
        if vehicle.regions.kind == "area":
            self._roads = Roads(vehicle, pitches_of(self.run))
        self._cues = CuePass(vehicle)
        self._ego = EgoMotion(odometer_of(self.run))
        self._restarts = Restarts(vehicle, self.manifest.timeline)
        self._ranges = _ranges_of(self.run)

    def add(self, frame: FrameDetections) -> None:
        """Draw one frame, with the decisions of tracks on its detections."""
        vehicle = self.manifest.settings
        fresh_ns = self._restarts.before(frame.t_ns)
        if fresh_ns is not None:
            self._ego.restart(fresh_ns)
            self._cues.restart()
            self._before = []
            if self._roads is not None:
                self._roads.restart()
        evidence, ego = self._ego(frame.t_ns)
        if self._roads is not None:
            self._roads(frame, evidence)
        place = None
        if ego.way_m is not None:
            place = intersection_place(self._before, ego.way_m, vehicle.fusion.length_m)
        self._before = self._ranges.get(frame.t_ns, [])
        found = self._cues(frame, ego, place)
        self.marks.add(frame, found.objects)
        if self._roads is not None:
            self._draw_roads(self._roads)
        if vehicle.cars.kind == "tracks":
            for car in self._cues.followed():
                self._car(car, frame.size_px, place)

    def _draw_roads(self, roads: Roads) -> None:
        plan = roads.plan()
        for line in () if plan is None else plan_lines(plan):
            self.marks.area.add(line, ROAD)
        for line, text in () if roads.seen is None else opening_lines(roads.seen):
            self.marks.openings.add(line, ROAD, text)

    def _car(self, car: CarMotion, size_px: tuple[int, int], place: Place | None) -> None:
        cars, camera = self.manifest.settings.cars, self.manifest.settings.camera
        if parked([car], cars):
            nose = np.array([NOSE * size_px[0] * np.sign(car.nose), 0.0])
            self.marks.arrow(car.center_px, nose, PARKED, "parked", size_px)
        elif crossing([car], cars):
            way_px = motion_px(car, camera, size_px)
            self.marks.arrow(car.center_px, way_px, CROSSING, "crossing", size_px)
        elif along([car], cars):
            way = "outgoing" if car.ahead_mps > 0.0 else "oncoming"
            is_beyond = place is not None and is_past(car, camera, place)
            colour = FEATURES["straight"] if is_beyond else ALONG
            way_px, label = motion_px(car, camera, size_px), f"{way} {abs(car.ahead_mps):.0f} m/s"
            self.marks.arrow(car.center_px, way_px, colour, label, size_px)


def motion_px(car: CarMotion, camera: Camera, size_px: tuple[int, int]) -> NDArray[np.float64]:
    """Return a car's displacement in the image within a second, with the camera at rest."""
    center = np.array(camera.center_px or (0.5 * size_px[0], 0.5 * size_px[1]))
    now_px = np.array(car.center_px) - center
    then_m = max(car.distance_m + ARROW_S * car.ahead_mps, NEAREST_M)
    sideways_px = np.array([(camera.focal_px or 0.0) * ARROW_S * car.right_mps / then_m, 0.0])
    return np.asarray(now_px * (car.distance_m / then_m - 1.0) + sideways_px, np.float64)


def _ranges_of(run: RunFolder) -> dict[int, list[RangeRow]]:
    """Return the ranges by time of their frame."""
    found: dict[int, list[RangeRow]] = {}
    table = run.filled("range", ["t_ns", "reference", "range_m", "var_m2"])
    for row in () if table is None else table.to_pylist():
        one = RangeRow(Reference(row["reference"]), row["range_m"], row["var_m2"], None)
        found.setdefault(row["t_ns"], []).append(one)
    return found
