"""Tests of the tally of candidates: each is counted as used, or as skipped with a reason."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.base import Detections
from crosscue.detectors.cues.candidates import (
    Candidates,
)
from crosscue.detectors.cues.frame import CuePass
from crosscue.detectors.cues.observed import FrameDetections
from crosscue.detectors.ranging.object_tracks import CarStep
from crosscue.replay.vehicle.cue_table import CUES
from crosscue.replay.vehicle.vehicle import Camera, Cars, Cues, OwnCue, Vehicle

VEHICLE = Vehicle(
    version=1,
    cues=Cues(own={"crossing": OwnCue(labels=("zebra",), score=0.3)}),
    cars=Cars(kind="pairs"),
)
TRACKED = VEHICLE.model_copy(
    update={"cars": Cars(kind="tracks"), "camera": Camera(focal_px=500.0, center_px=(320.0, 200.0))}
)
LABELS = ("traffic light", "stop sign", "car", "zebra", "one way left", "dog")
BOX = st.tuples(st.sampled_from(LABELS), st.floats(0.0, 1.0), st.floats(5.0, 300.0))
FRAMES = st.lists(st.lists(BOX, max_size=5), min_size=1, max_size=4)


def _found(t_ns: int, *found: tuple[str, float, float]) -> Detections:
    """Build objects 40 px high at the left, each with a label, score and width."""
    boxes = np.array([(5.0, 5.0, 5.0 + width, 45.0) for _, _, width in found]).reshape(-1, 4)
    scores = np.array([score for _, score, _ in found], np.float64)
    labels = tuple(label for label, _, _ in found)
    return Detections(t_ns, (640, 480), boxes, scores, labels, (b"",) * len(found))


def _pass(vehicle: Vehicle = VEHICLE) -> tuple[CuePass, dict[str, Candidates]]:
    cues = CuePass(vehicle)
    return cues, cues.candidates


# Groups of cues that need the place of an intersection.
UNPLACED = ("cars_past", "leg_traffic", "map")


@given(FRAMES, FRAMES, st.sampled_from([VEHICLE, TRACKED]))
def test_used_and_skipped_candidates_add_up_for_every_cue(
    objects: list[list[tuple[str, float, float]]],
    signs: list[list[tuple[str, float, float]]],
    vehicle: Vehicle,
) -> None:
    cues, tally = _pass(vehicle)
    ego = CarStep(0.5, 0.0, 0.0, 0.1)
    counted: dict[str, int] = {}
    for t, (some, others) in enumerate(zip(objects, signs, strict=False)):
        frame = FrameDetections(t * 10**8, objects=(_found(t, *some),), signs=(_found(t, *others),))
        for cue, number in cues(frame, ego).counts.items():
            counted[cue] = counted.get(cue, 0) + number

    for name, one in tally.items():
        assert one.seen == one.used + sum(one.skipped.values())
        assert all(number > 0 for number in one.skipped.values())
        assert one.used == counted.get(name, 0)
    evaluated = {
        name
        for name, cue in CUES.items()
        if cue.observed_by not in ("road", "mobileye") and cue.group not in UNPLACED
    }
    assert set(tally) == evaluated | {"crossing"}
