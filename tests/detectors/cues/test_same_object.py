"""Tests that an object found by several detectors counts once, with the better score."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from crosscue.detectors.base import Detections
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.cues.same_object import KEPT, MIN_IOU, label_meanings, same_objects
from crosscue.replay.vehicle.vehicle import Cars, Cues, Vehicle

VEHICLE = Vehicle(version=1, cues=Cues(kind="frames"), cars=Cars(labels=("car", "truck")))
MEANING = label_meanings(VEHICLE)
Object = tuple[str, float, float]
OBJECTS = st.lists(
    st.tuples(
        st.sampled_from(("car", "truck", "stop sign", "no entry", "do not enter", "dog")),
        st.floats(0.0, 1.0),
        st.floats(0.0, 60.0),
    ),
    max_size=5,
)


def found(*things: Object) -> Detections:
    """Build boxes of 20 x 10 px, each with a label, a score and a left edge."""
    boxes = np.array([(x, 5.0, x + 20.0, 15.0) for _, _, x in things]).reshape(-1, 4)
    scores = np.array([score for _, score, _ in things], np.float64)
    labels = tuple(label for label, _, _ in things)
    return Detections(0, (640, 480), boxes, scores, labels, (b"",) * len(things))


@given(st.lists(OBJECTS, min_size=1, max_size=3))
def test_dropped_detection_overlaps_a_kept_one_of_the_other_detector(
    results: list[list[Object]],
) -> None:
    boxes = [found(*things) for things in results]
    same = same_objects(boxes, MEANING, (False,) * len(boxes))

    for k, (one, whose) in enumerate(zip(boxes, same, strict=True)):
        for i, other in enumerate(whose.tolist()):
            if other == KEPT:
                continue
            assert other != k
            kept = [
                j
                for j in range(len(boxes[other]))
                if same[other][j] == KEPT
                and box_ious(one.boxes_px[i], boxes[other].boxes_px[j]) > MIN_IOU
                and boxes[other].scores[j] >= one.scores[i]
            ]
            assert kept


@given(OBJECTS)
def test_identical_second_detector_is_dropped_completely(things: list[Object]) -> None:
    one = found(*things)

    first, second = same_objects((one, one), MEANING, (False, False))

    assert (first == KEPT).all()
    assert (second == 0).all()
