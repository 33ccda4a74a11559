"""How the ego vehicle moved from frame to frame, and where gaps make all start anew."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from crosscue.detectors.ranging.object_tracks import Motion
from crosscue.eval.runs.tables.travelled import Odometer
from crosscue.fusion.evidence import FrameEvidence
from crosscue.replay.time.segments import Timeline
from crosscue.replay.vehicle.vehicle import Vehicle

COVERED: Final = 0.9
"""Odometry over less of the time between two frames does not tell the way."""


@dataclass(slots=True)
class Restarts:
    """Follows the segments along the frames."""

    vehicle: Vehicle
    timeline: Timeline
    _number: int = 0

    def before(self, t_ns: int) -> int | None:
        """Where the new segment begins if a frame at ``t_ns`` is the first after a long gap."""
        segments, found = self.timeline.segments, None
        limit_ns = round(self.vehicle.time.restart_after_s * 1e9)
        while self._number + 1 < len(segments):
            following = segments[self._number + 1]
            if following.begins_ns > t_ns:
                break
            self._number += 1
            if following.gap_ns is None or following.gap_ns > limit_ns:
                found = following.begins_ns
        return found


@dataclass(slots=True)
class EgoMotion:
    """Reads the odometry along the frames.

    Attributes:
        odometer: Of the run.
        without_odometry: Frames since whose predecessor the way was not measured.
    """

    odometer: Odometer
    without_odometry: int = 0
    _last_ns: int | None = None

    def __call__(self, t_ns: int) -> tuple[FrameEvidence, Motion]:
        """Since the frame before: evidence that holds nothing else, and what trackers take."""
        way = self.odometer.until(t_ns)
        gap_ns = 0 if self._last_ns is None else t_ns - self._last_ns
        is_covered = way.covered_ns >= COVERED * gap_ns
        self.without_odometry += way.covered_ns - way.assumed_ns < COVERED * gap_ns
        self._last_ns = t_ns if self._last_ns is None else max(t_ns, self._last_ns)
        travelled_m = way.distance_m if is_covered else None
        turned_rad = way.turn_rad if is_covered else None
        evidence = FrameEvidence(
            t_ns=t_ns,
            travelled_m=travelled_m,
            travelled_var_m2=way.var_m2,
            signs=(),
            counts={},
            turned_rad=turned_rad,
            assumed_m=way.assumed_m,
        )
        return evidence, Motion(travelled_m, way.var_m2, turned_rad or 0.0, max(gap_ns, 0) * 1e-9)

    def restart(self, t_ns: int) -> None:
        """Know nothing of what was before ``t_ns``."""
        self.odometer.skip_to(t_ns)
        self._last_ns = None
