"""Decide on stop signs and traffic lights by their tracks over frames instead of by one frame.

A far or dark light has a low score in every frame, and a look-alike a high one in some. Fifty weak
boxes in one place are more evidence than one strong box. Every box from a low score on adds the log
likelihood ratio of its score to its track (``object_tracks``), with what its pixels show: a lit
lens, or the second look at a stop sign. A frame uses only what was seen up to it.

The ratios of stop signs are those of 146 boxes of yolox-nano above 0.05 that one of us labelled by
eye on photographs of streets: the score is used as it is, up to a constant, ``AT_THRESHOLD``, the
evidence of a box at the detector's own threshold. Lights have the ``log_ratio`` of their network's
card; that of another network hides them. Without it, only the score counts.
"""

import math
import operator
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from crosscue.detectors.base import ACCEPTED, MIN_SCORE, Detections, is_repeated
from crosscue.detectors.cues.candidates import TOO_LITTLE_EVIDENCE
from crosscue.detectors.signs.second_look import OTHER_SIGNS
from crosscue.replay.columns import Floats
from crosscue.replay.vehicle.vehicle import STOP_SIGN, TRAFFIC_LIGHT, CueSpec, Vehicle

from .ground_plane import GroundPlane
from .object_tracks import CarStep, ObjectTrack, ObjectTracks
from .usable import are_cut, source_of

# Scores below this are no candidates: most of them are noise, and they would fill the tables.
MIN_CANDIDATE: Final = 0.1
AT_THRESHOLD: Final = 1.2
# The same of lights of a network without ``log_ratio``. Of 0.5, 0.75 and 1.2, the highest at which
# seven such networks are false in fewer frames without a light (0.5 %) than yolox-nano (1.1 %).
LIGHT_AT_THRESHOLD: Final = 0.75
# Maximum evidence of one box, because no network is right in more than 19 of 20 boxes.
MOST: Final = 3.0
# Evidence of a lens. Among boxes of one score, a lit red or green lens and a dark housing differ by
# 1.2; a box too small to tell is between them. Yellow is also the paint of housings.
OF_LENS: Final = {"red": 0.6, "green": 0.6, "dark": -0.6}
# Evidence of a second look that shows a stop sign: 33 of 38 stop signs look like one, and 1 of 40
# other boxes. 24 of these look like other signs and no stop sign does, which rules a track out.
OF_LOOK: Final = {"stop": 2.0}
# Maximum tangent of an angle below the horizon: a head lower than the camera, as one for cyclists,
# is not seen so steeply before it is passed. Flares and the dashboard are.
MAX_BELOW: Final = 0.2
BELOW_HORIZON: Final = "too far below the horizon"


@dataclass(slots=True)
class ControlTracks:
    """Tracks of the stop signs and traffic lights of a camera.

    Attributes:
        vehicle: Settings. With ``cues.kind = "frames"``, only sure boxes are tracked, for their
            range, and nothing is decided.
        tracks: Accepted tracks by cue; missing while nothing was found.
        counts: Numbers of objects followed and of duplicate boxes.
    """

    vehicle: Vehicle
    tracks: dict[str, Sequence[ObjectTrack]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    _before: tuple[Detections, ...] = ()
    _of_cue: dict[str, ObjectTracks] = field(default_factory=dict)

    def __call__(self, found: Sequence[Detections], motion: CarStep) -> tuple[Detections, ...]:
        """Track the objects of the next frame; return the detections with the decisions on them.

        Args:
            found: Detections of each detector of objects.
            motion: Motion of the car since the previous frame.
        """
        decisions = [[""] * len(one) for one in found]
        is_new, self._before = not is_repeated(self._before, found), tuple(found)
        # The variance of slip_per_sqrt_m is not used: the tracks have scale_sd of the distance.
        slip_m2 = self.vehicle.odometry.slip_per_sqrt_m**2 * abs(motion.way_m or 0.0)
        motion = motion._replace(var_m2=max(motion.var_m2 - slip_m2, 0.0))
        whole_px = [
            np.where(are_cut(one.boxes_px, one.size_px), 0.0, one.heights_px) for one in found
        ]
        for cue in (STOP_SIGN, TRAFFIC_LIGHT):
            self._track(cue, found, whole_px, motion, decisions, is_new=is_new)
        if self.vehicle.cues.kind != "tracks":
            return tuple(found)
        return tuple(
            replace(one, decisions=tuple(said)) if any(said) else one
            for one, said in zip(found, decisions, strict=True)
        )

    def restart(self) -> None:
        """Forget all objects."""
        self.tracks.clear()
        self._before = ()
        self._of_cue.clear()

    def _track(
        self,
        cue: CueSpec,
        found: Sequence[Detections],
        whole_px: Sequence[Floats],
        motion: CarStep,
        decisions: list[list[str]],
        *,
        is_new: bool,
    ) -> None:
        """Track the objects of one cue, and enter the decisions on its detections.

        Heights in ``whole_px`` are 0 for objects that the picture's edge cuts.
        """
        labels, is_tracked = self.vehicle.labels_of(cue), self.vehicle.cues.kind == "tracks"
        if not is_tracked and source_of(self.vehicle, cue.name) != "motion":
            return
        rows: list[tuple[int, int]] = []
        for k, one in enumerate(found):
            _, score = self.vehicle.threshold_of(cue)
            is_taken = one.scores >= MIN_CANDIDATE if is_tracked else one.are_sure(score)
            for i, label in enumerate(one.labels):
                if label in labels:
                    decisions[k][i] = TOO_LITTLE_EVIDENCE
                    if is_taken[i] and (is_tracked or whole_px[k][i] > 0.0):
                        rows.append((k, i))
        if cue.name not in self._of_cue:
            if not rows:
                return
            self._of_cue[cue.name] = self._new(cue, found)
        tracks = self._of_cue[cue.name]
        tracks(
            motion,
            np.array([found[k].boxes_px[i] for k, i in rows]).reshape(-1, 4),
            np.array([whole_px[k][i] for k, i in rows]),
            [(*found[k].lenses[i : i + 1], "")[0] for k, i in rows],
            np.array([self._evidence(found[k], i, cue) for k, i in rows]) if is_tracked else None,
            is_new=is_new,
        )
        for (k, i), track in zip(rows, tracks.of_boxes, strict=True):
            if track is not None:
                x0, y0, x1, y1 = found[k].boxes_px[i].tolist()
                for look in found[k].looks[i : i + 1]:
                    # Twice the size shows four times as much.
                    track.looks[look] += round((x1 - x0) * (y1 - y0))
        for (k, i), track in zip(rows, tracks.of_boxes, strict=True):
            if track is not None:
                decisions[k][i] = _other(track) or (
                    ACCEPTED if track.is_accepted else TOO_LITTLE_EVIDENCE
                )
        self.tracks[cue.name] = [
            one for one in tracks.tracks if one.is_accepted and not _other(one)
        ]

    def _new(self, cue: CueSpec, found: Sequence[Detections]) -> ObjectTracks:
        camera, size_px = self.vehicle.camera, found[0].size_px
        # Without a focal length, only the ratio of ranges is needed, which does not depend on it.
        focal_px = camera.focal_px or float(size_px[0])
        center_px = GroundPlane.of(
            camera.model_copy(update={"focal_px": focal_px}), size_px
        ).ahead_px()
        tracks = ObjectTracks(cue.name, focal_px, center_px, self.vehicle.odometry.scale_sd)
        tracks.counts = self.counts
        return tracks

    def _evidence(self, found: Detections, i: int, cue: CueSpec) -> float:
        """Log likelihood ratio of one detection."""
        _, setting = self.vehicle.threshold_of(cue)
        threshold = MIN_SCORE if found.min_scores is None else float(found.min_scores[i])
        by_score = _log_odds(float(found.scores[i])) - _log_odds(setting or threshold)
        by_box = by_score + (LIGHT_AT_THRESHOLD if cue == TRAFFIC_LIGHT else AT_THRESHOLD)
        if weights := found.log_ratios.get(found.labels[i]):
            x0, y0, x1, y1 = found.boxes_px[i].tolist()
            short_px, long_px = sorted((max(x1 - x0, 1.0), max(y1 - y0, 1.0)))
            parts = (
                by_score,
                math.log(long_px / short_px),
                math.log(long_px / max(found.size_px)),
                1.0,
            )
            by_box = sum(map(operator.mul, weights, parts))
        lens, look = (*found.lenses[i : i + 1], "")[0], (*found.looks[i : i + 1], "")[0]
        return min(by_box, MOST) + OF_LENS.get(lens, 0.0) + OF_LOOK.get(look, 0.0)


def _log_odds(score: float) -> float:
    kept = min(max(score, 1e-3), 1.0 - 1e-3)
    return math.log(kept / (1.0 - kept))


def _other(track: ObjectTrack) -> str | None:
    """Return what else a track is: by its place, or if its boxes look more like another sign."""
    middle_px = 0.5 * (track.box_px[1] + track.box_px[3])
    if middle_px - track.lens.center_px[1] > MAX_BELOW * track.lens.focal_px:
        return BELOW_HORIZON
    others = {look: n for look, n in track.looks.items() if look in OTHER_SIGNS}
    # A light that is on no sign has an empty look.
    if sum(others.values()) <= track.looks["stop"] + track.looks[""]:
        return None
    most = max(sorted(others), key=lambda look: others[look])
    return f"looks like another sign: {OTHER_SIGNS[most]}"
