"""Tests of non-maximum suppression."""

import numpy as np

from crosscue.detectors.boxes import box_ious, non_maximum_suppression


def test_suppression_keeps_the_best_of_overlapping_boxes() -> None:
    rng = np.random.default_rng(5)
    corners = rng.uniform(0.0, 60.0, (700, 2))
    boxes = np.hstack([corners, corners + rng.uniform(5.0, 30.0, (700, 2))])
    scores, groups = rng.uniform(0.0, 1.0, 700), rng.integers(0, 3, 700)

    expected: list[int] = []
    for i in np.argsort(-scores):
        rivals = [k for k in expected if groups[k] == groups[i]]
        if scores[i] >= 0.2 and not (box_ious(boxes[i], boxes[rivals]) > 0.45).any():
            expected.append(int(i))

    assert non_maximum_suppression(boxes, scores, groups, 0.2, 0.45).tolist() == expected
    assert not len(non_maximum_suppression(boxes, scores, groups, 2.0, 0.45))
