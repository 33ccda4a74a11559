"""Precision and recall of boxes equal those of pycocotools, and those computed by hand."""

import contextlib
import io
import math

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from crosscue.eval.scoring.boxes.matching import ALL, OVERLAPS, SIZES, LabelledBoxes, match
from crosscue.eval.scoring.boxes.reliability import class_calibration
from crosscue.eval.scoring.boxes.scores import (
    IntervalEstimate,
    _measured,
    average_precision,
    drawn,
    score_parts,
)


def boxes(
    *rows: tuple[int, int, tuple[float, float, float, float]],
    scores: list[float] | None = None,
    ignored: tuple[int, ...] = (),
    range_m: list[float] | None = None,
) -> LabelledBoxes:
    """Build boxes from rows of picture, class and corners."""
    n = len(rows)
    is_ignored = np.zeros(n, np.bool_)
    is_ignored[list(ignored)] = True
    return LabelledBoxes(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.int64),
        np.array([row[2] for row in rows], np.float64).reshape(-1, 4),
        np.ones(n) if scores is None else np.array(scores),
        is_ignored,
        np.full(n, np.nan) if range_m is None else np.array(range_m),
    )


def random_boxes(seed: int) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Random labels and detections of 12 pictures and 3 classes, with overlaps and equal scores."""
    rng = np.random.default_rng(seed)
    labels, found, scores = [], [], []
    for picture in range(12):
        for _ in range(rng.integers(0, 9)):
            x, y = rng.uniform(0, 400, 2)
            w, h = np.exp(rng.uniform(2.5, 5.2, 2))
            kind = int(rng.integers(0, 3))
            labels.append((picture, kind, (x, y, x + w, y + h)))
            for _ in range(rng.integers(0, 4)):
                off = rng.normal(0.0, 0.15, 4) * (w, h, w, h)
                x0, y0, x1, y1 = np.array([x, y, x + w, y + h]) + off
                other = int(rng.integers(0, 3)) if rng.random() < 0.1 else kind
                found.append((picture, other, (x0, y0, max(x1, x0 + 2), max(y1, y0 + 2))))
                scores.append(round(float(rng.random()), 1))
    ignored = tuple(np.flatnonzero(rng.random(len(labels)) < 0.2).tolist())
    return boxes(*labels, ignored=ignored), boxes(*found, scores=scores)


def pycocotools_precision(truth: LabelledBoxes, found: LabelledBoxes) -> np.ndarray:
    """Precision from pycocotools: overlap, recall, class, size, max detections."""
    coco = COCO()
    coco.dataset = {
        "images": [{"id": i} for i in range(12)],
        "categories": [{"id": k, "name": str(k)} for k in range(3)],
        "annotations": [
            {
                "id": i + 1,
                "image_id": int(truth.picture[i]),
                "category_id": int(truth.label[i]),
                "bbox": _xywh(truth.boxes_px[i]),
                "area": float(truth.areas_px2[i]),
                "iscrowd": int(truth.is_ignored[i]),
            }
            for i in range(len(truth))
        ],
    }
    with contextlib.redirect_stdout(io.StringIO()):
        coco.createIndex()
        answers = coco.loadRes(
            [
                {
                    "image_id": int(found.picture[i]),
                    "category_id": int(found.label[i]),
                    "bbox": _xywh(found.boxes_px[i]),
                    "score": float(found.scores[i]),
                }
                for i in range(len(found))
            ]
        )
        judge = COCOeval(coco, answers, "bbox")
        judge.evaluate()
        judge.accumulate()
    return np.asarray(judge.eval["precision"])[..., -1]


def _xywh(box: np.ndarray) -> list[float]:
    x0, y0, x1, y1 = box.tolist()
    return [x0, y0, x1 - x0, y1 - y0]


@pytest.mark.parametrize("seed", range(6))
def test_average_precision_equals_pycocotools(seed: int) -> None:
    truth, found = random_boxes(seed)
    expected = pycocotools_precision(truth, found)

    for label in range(3):
        for i, part in enumerate((ALL, *SIZES)):
            matched = match(truth, found, label, part)
            for step in range(len(OVERLAPS)):
                mine = float(average_precision(matched, step)[0])
                theirs = expected[step, :, label, i]
                if (theirs == -1).all():
                    assert math.isnan(mine)
                else:
                    assert mine == pytest.approx(theirs.mean(), abs=1e-9)


UNIT = (0.0, 0.0, 100.0, 100.0)
AWAY = (200.0, 200.0, 300.0, 300.0)


def test_precision_recall_and_ap50_computed_by_hand() -> None:
    """Two labels are found with scores 0.9 and 0.3; a false detection has score 0.6."""
    truth = boxes((0, 0, UNIT), (1, 0, UNIT))
    found = boxes((0, 0, UNIT), (0, 0, AWAY), (1, 0, UNIT), scores=[0.9, 0.6, 0.3])

    mean, all_, _ = score_parts(truth, found, ("car",), {"car": 0.5}, np.arange(2))

    # Precision 1 up to recall 0.5 (51 of 101 recalls), and 2/3 up to 1 (50 of them).
    assert all_.ap50.value == pytest.approx((51 + 50 * 2 / 3) / 101)
    assert mean.ap50.value == all_.ap50.value
    assert (all_.labels, all_.right, all_.wrong) == (2, 1, 1)
    assert (all_.precision.value, all_.recall.value) == (0.5, 0.5)


def test_labels_are_binned_by_true_and_false_detections_by_estimated_range() -> None:
    truth = boxes((0, 0, UNIT), (0, 0, AWAY), range_m=[10.0, 50.0])
    low = (400.0, 0.0, 440.0, 40.0)
    found = boxes((0, 0, UNIT), (0, 0, low), scores=[0.9, 0.8], range_m=[30.0, 45.0])

    scores = score_parts(truth, found, ("car",), {"car": 0.5}, np.arange(1))
    by_part = {one.part: (one.labels, one.right, one.wrong) for one in scores if one.label == "car"}

    assert by_part["0 to 20 m"] == (1, 1, 0)
    assert by_part["40 to 60 m"] == (1, 0, 1)
    assert "20 to 40 m" not in by_part


def _blocks_of_pictures(
    rng: np.random.Generator, blocks: int
) -> tuple[LabelledBoxes, LabelledBoxes]:
    """Blocks of four pictures with four labels each and a random recall per block."""
    found_at = np.repeat(rng.beta(4.0, 1.0, blocks), 16)
    rows = [
        (p, 0, (200.0 * i, 0.0, 200.0 * i + 100, 100.0))
        for p in range(4 * blocks)
        for i in range(4)
    ]
    is_found = rng.random(len(rows)) < found_at
    found = boxes(
        *(row if ok else (row[0], 0, AWAY) for row, ok in zip(rows, is_found, strict=True)),
        scores=rng.random(len(rows)).tolist(),
    )
    return boxes(*rows), found


def test_intervals_of_six_blocks_cover_value_of_many() -> None:
    """In 150 simulations, 93 % of intervals cover AP50; bootstrap percentiles cover 77 %."""
    rng = np.random.default_rng(5)

    def of(blocks: int, rounds: int) -> IntervalEstimate:
        truth, found = _blocks_of_pictures(rng, blocks)
        which = np.repeat(np.arange(blocks), 4)
        matched = match(truth, found, 0, overlaps=np.array([0.5]))
        value = float(average_precision(matched, 0)[0])
        return _measured(value, average_precision(matched, 0, drawn(which, 0, rounds)), which)

    true = of(500, 1).value
    covered = sum(one.low <= true <= one.high for one in (of(6, 100) for _ in range(50)))

    assert covered >= 42


def test_calibration_error_is_zero_for_calibrated_scores_only() -> None:
    rng = np.random.default_rng(0)
    scores = rng.random(20_000)
    is_right = rng.random(20_000) < scores

    assert class_calibration("car", scores, is_right).error < 0.02
    assert class_calibration(
        "car", np.full(1000, 0.95), np.zeros(1000, np.bool_)
    ).error == pytest.approx(0.95)
