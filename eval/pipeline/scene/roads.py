"""Roads of the scene: which there are, by the mask's shape, and where, by openings in its area."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from crosscue.detectors.base import RoadMask
from crosscue.detectors.cues.observed import FrameDetections, RoadFractions
from crosscue.detectors.cues.road_area import NEAREST_M, RoadArea, RoadPlan, reach_of
from crosscue.detectors.cues.road_layout import SEEN, LogOdds, RoadLayout
from crosscue.detectors.cues.road_openings import RoadOpenings, Seen
from crosscue.eval.pipeline.visual import MOVING, TABLE, moving_boxes
from crosscue.eval.runs.tables.parquet import TableFolder
from crosscue.fusion.evidence import FrameEvidence, RangePosterior
from crosscue.fusion.factor_graph import log_odds
from crosscue.fusion.intersection_range import Reference
from crosscue.replay.vehicle.fusion import OPENING_PRECISION
from crosscue.replay.vehicle.vehicle import Vehicle

# Distance between an opening and a range from lights or signs that can belong together.
TOGETHER_M: Final = 15.0
# Least score of a box that hides the road from the rule by shape.
HIDES: Final = 0.3
# Least log odds that a road seen by the shape is worth: with the network before this one it was
# seen, in development, eleven times as often where it is there (22 of 37) as where it is not (1 of
# 38, counted as 2); on 30 other drives, with this one, 25 of 41 and 2 of 37.
SHAPE_LOG_ODDS: Final = 2.4
BY_SHAPE: Final = "roads to the sides by the shape of the road mask"


@dataclass(slots=True)
class Roads:
    """Roads over the frames of a drive.

    Attributes:
        vehicle: Settings.
        pitches_rad: Pitch of the camera by the time of a frame, where the pictures tell it.
        area: The accumulated road; None before the first mask.
        seen: Openings in the newest frame.
        by_shape: Number of frames without a focal length or motion, in which nothing is ranged.
    """

    vehicle: Vehicle
    pitches_rad: Mapping[int, float]
    area: RoadArea | None = None
    seen: Seen | None = None
    by_shape: int = 0
    _layout: RoadLayout = field(default_factory=RoadLayout)
    _shape: LogOdds | None = None
    _openings: RoadOpenings = field(init=False)
    _pitch_rad: float = field(init=False)

    def __post_init__(self) -> None:
        camera = self.vehicle.camera
        self._openings = RoadOpenings(camera.z_m, NEAREST_M + camera.x_m)
        self._pitch_rad = next(iter(self.pitches_rad.values()), self.vehicle.camera.pitch_rad)

    def __call__(self, frame: FrameDetections, evidence: FrameEvidence) -> RoadFractions | None:
        """Process the next frame; return 1 for roads seen, 0 for missing ones, NaN for unseen."""
        self.seen = self._shape = None
        if not isinstance(frame.road, RoadMask):
            return frame.road
        camera = self.vehicle.camera
        labels = {*self.vehicle.cars.labels, *MOVING}
        legs = self._layout(frame.t_ns, frame.road, moving_boxes(frame.objects, labels, HIDES))
        self._shape = self._layout.mean
        reach_m = reach_of(camera, frame.road)
        if reach_m <= 0.0 or evidence.travelled_m is None:
            self.area = None
            self._openings.restart()
            self.by_shape += 1
            return RoadFractions(*legs)
        if self.area is None:
            self.area = RoadArea(camera, reach_m)
        turned_rad = evidence.turned_rad or 0.0
        self.area.move(evidence.travelled_m, turned_rad)
        self._pitch_rad = self.pitches_rad.get(frame.t_ns, self._pitch_rad)
        self.area.see(frame.road, moving_boxes(frame.objects, labels), self._pitch_rad)
        sides = [side for side, leg in ((1, legs.left), (-1, legs.right)) if leg == 1.0]
        self.seen = self._openings(self.area.plan(), evidence.travelled_m, turned_rad, sides)
        where = zip(legs, self.seen.legs, strict=True)
        return RoadFractions(
            *(0.0 if leg != 1.0 and opening == 0.0 else leg for leg, opening in where)
        )

    def ranges(self) -> tuple[RangePosterior, ...]:
        """Return the ranges to the intersection that the openings make, if its end is ahead."""
        seen = self.seen
        if seen is None or not seen.end_m > 0.0:
            return ()
        var_m2 = seen.sd_m**2
        return (
            RangePosterior(Reference.START, seen.start_m, var_m2, seen.start_m),
            RangePosterior(Reference.END, seen.end_m, var_m2, seen.end_m),
        )

    def fits(self, others: Sequence[RangePosterior]) -> bool:
        """Return whether the openings can be at the intersection of ranges from lights or signs."""
        seen = self.seen
        if seen is None or math.isnan(seen.start_m):
            return True
        return any(
            seen.start_m - away_m <= one.range_m <= seen.end_m + away_m
            for one in others
            for away_m in (TOGETHER_M + 2.0 * math.sqrt(one.var_m2 + seen.sd_m**2),)
        )

    def with_shape(self, evidence: FrameEvidence) -> FrameEvidence:
        """Add how sure the mask's shape is of each road, and which ones begin ahead."""
        mean = self._shape
        if mean is None:
            return evidence
        sides = {"road_left": mean.left, "road_right": mean.right}
        odds = {**sides, "road_straight": mean.goes_on(self._layout.is_believed)}
        worth = {cue: max(one, SHAPE_LOG_ODDS * (one > SEEN)) for cue, one in odds.items()}
        return replace(
            evidence,
            weights={cue: one / log_odds(OPENING_PRECISION) for cue, one in worth.items()},
            roads_ahead={cue: one > SEEN for cue, one in sides.items() if not 0.0 <= one <= SEEN},
        )

    def believe(self, is_established: bool) -> None:
        """Note whether an intersection is believed: a road straight on is one behind it."""
        self._layout.is_believed = is_established

    def plan(self) -> RoadPlan | None:
        """Return the plan view after the newest frame."""
        return None if self.area is None else self.area.plan()

    def notes(self) -> Counter[str]:
        """Number of frames in which roads could not be ranged, by the rule that was used."""
        return Counter({BY_SHAPE: self.by_shape} if self.by_shape else {})

    def restart(self) -> None:
        """Forget the road."""
        self.area = self.seen = self._shape = None
        self._openings.restart()
        self._layout.restart()


def pitches_of(run: TableFolder) -> dict[int, float]:
    """Return the pitch of the camera by the time of a frame, as visual odometry found it."""
    if not run.file(f"{TABLE}.parquet").exists():
        return {}
    table = run.table(TABLE, ["t_ns", "pitch_rad"])
    return dict(zip(table["t_ns"].to_pylist(), table["pitch_rad"].to_pylist(), strict=True))
