"""Tests of sign drawings, of sign detection, and of the choice of its threshold from labels."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.signs.detector import build, orb_points
from crosscue.detectors.signs.matching import nearest, window_counts
from crosscue.detectors.signs.templates import AMERICAN, Kind, draw_sign_template, drawings
from crosscue.detectors.training.operating_point import Verdicts, rates_at, threshold_at_precision
from crosscue.eval.cli import run
from crosscue.replay.columns import Block, Bytes, Floats, Images, Messages, Topic
from crosscue.replay.ledger import Ledger
from crosscue.replay.write.convert import LogWriter
from support.refusals import refusal
from support.sign_scenes import clutter, scene


def _signs(grey: Bytes, **changes: object) -> Detections:
    size = (grey.shape[1], grey.shape[0])
    found = build(**changes)([Frame(7, "cam", grey, size)])[0]
    assert isinstance(found, Detections)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("kind", AMERICAN)
def test_each_american_sign_is_located_and_classified(kind: Kind) -> None:
    hits = 0
    for seed in range(8):
        grey, box = scene(kind, seed)
        found = _signs(grey)
        over = box_ious(box, found.boxes_px) if len(found) else np.empty(0)
        hits += any(
            label == kind and fraction > 0.4
            for label, fraction in zip(found.labels, over, strict=True)
        )

    assert hits >= 7


@pytest.mark.parametrize("height_px", [40, 150, 220, 320])
def test_sign_is_found_at_every_height(height_px: int) -> None:
    drawing = draw_sign_template("do not enter", height_px).grey
    grey = clutter(7, (1280, 720))
    h, w = drawing.shape
    grey[60 : 60 + h, 300 : 300 + w] = drawing
    box = np.array([300.0, 60.0, 300.0 + w, 60.0 + h])

    found = _signs(np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.7), np.uint8))

    assert "do not enter" in found.labels
    assert box_ious(box, found.boxes_px).max() > 0.5


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_ratio_test_matches_opencv(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(0, 256, (7, 32), np.uint8)
    drawn = rng.integers(0, 256, (9, 32), np.uint8)
    drawn[2] = points[4] ^ np.uint8(1)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(points, drawn, k=2)
    want = [a.trainIdx if a.distance < 0.8 * b.distance else -1 for a, b in pairs]

    got = nearest(points.view(np.uint64), drawn.view(np.uint64), np.array([0, 9]), 0.8, 256)

    assert got[0].tolist() == want
    assert got[0, 4] == 2


@pytest.mark.parametrize("max_count", [100, 20_000])
def test_points_match_upright_orb_at_any_limit(max_count: int) -> None:
    grey = clutter(5)
    orb = cv2.ORB.create(
        nfeatures=max_count, nlevels=1, edgeThreshold=8, patchSize=16, fastThreshold=6
    )
    keypoints = orb.detect(grey, None)
    for keypoint in keypoints:
        keypoint.angle = 0.0
    keypoints, descriptors = orb.compute(grey, keypoints)

    points = orb_points(grey, max_count, 6)

    assert len(keypoints) == max_count if max_count == 100 else 100 < len(keypoints) < max_count
    np.testing.assert_array_equal(points.at_px, [keypoint.pt for keypoint in keypoints])
    np.testing.assert_array_equal(points.words.view(np.uint8), descriptors)


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000), reach=st.integers(0, 3))
def test_window_counts_each_template_point_once(seed: int, reach: int) -> None:
    rng = np.random.default_rng(seed)
    cells, drawn = rng.integers(-2, 9, (40, 2)), np.sort(rng.integers(0, 6, 40))

    counts = window_counts(cells, drawn, 7, 6, reach)

    for row in range(7):
        for column in range(6):
            near = (np.abs(cells - [column, row]) <= reach).all(axis=1)
            assert counts[row, column] == len(set(drawn[near].tolist()))


def test_fit_signs_measures_on_frames_not_used_for_the_choice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = ["picture,label,x0,y0,x1,y1"]
    for seed in range(8):
        grey, box = scene("one way left", seed)
        (tmp_path / f"{seed}.png").write_bytes(png(grey).tobytes())
        rows.append(f"{seed}.png,one way left," + ",".join(map(str, box.tolist())))
    labels = tmp_path / "labels.csv"
    labels.write_text("\n".join(rows) + "\n")

    fit = ["fit", "signs", str(labels), "--label", "one way left"]
    assert run(fit) == 0

    reported = capsys.readouterr().out
    assert "min_score = " in reported
    assert "precision 1.00 (4 of 4; 95 % interval 0.51 to 1.00, by drive too few" in reported
    assert run([*fit, "--threshold", reported.split()[2]]) == 0
    assert capsys.readouterr().out == reported


KINDS: tuple[Kind, Kind] = ("one way left", "one way right")
# Number of a picture, number of the kind of its sign, and the sign's box.
Labelled = tuple[int, int, Floats]


def png(grey: Bytes) -> Bytes:
    ok, encoded = cv2.imencode(".png", grey)
    assert ok
    return np.asarray(encoded, np.uint8).ravel()


def picture_row(number: int, name: str, grey: Bytes) -> dict[str, int | str]:
    return {"id": number, "file_name": name, "width": grey.shape[1], "height": grey.shape[0]}


def write_coco(path: Path, images: list[dict[str, int | str]], signs: list[Labelled]) -> Path:
    """Write a COCO file of pictures and their signs."""
    annotations = []
    for number, (image, kind, box) in enumerate(signs):
        x0, y0, x1, y1 = box.tolist()
        sides = {"image_id": image, "category_id": kind, "bbox": [x0, y0, x1 - x0, y1 - y0]}
        annotations.append({"id": number} | sides)
    names = [{"id": i, "name": name} for i, name in enumerate(KINDS)]
    tree = {"images": images, "annotations": annotations, "categories": names}
    path.write_text(json.dumps(tree))
    return path


def coco(folder: Path, seeds: range) -> Path:
    """Write a COCO file and pictures with alternating left and right one-way signs."""
    (folder / "images").mkdir(parents=True)
    images, signs = [], []
    for seed in seeds:
        grey, box = scene(KINDS[seed % 2], seed)
        (folder / "images" / f"{seed}.png").write_bytes(png(grey).tobytes())
        images.append(picture_row(seed, f"{seed}.png", grey))
        signs.append((seed, seed % 2, box))
    return write_coco(folder / "coco.json", images, signs)


def drive(folder: Path, seeds: range) -> Path:
    """Write a drive with a sign in every second picture, and its ground truth."""
    folder.mkdir()
    times = [1_700_000_000_000_000_000 + 10**8 * i for i in range(len(seeds))]
    pictures, images = [], []
    signs: list[Labelled] = []
    for number, (t_ns, seed) in enumerate(zip(times, seeds, strict=True)):
        grey, box = scene("one way left", seed)
        has_sign = number % 2 == 0
        pictures.append(png(grey if has_sign else clutter(seed)))
        images.append(picture_row(number, f"{t_ns}.jpg", grey) | {"t_ns": t_ns})
        signs += [(number, 0, box)] if has_sign else []
    edges = np.cumsum([0, *map(len, pictures)])
    rows = Messages(np.concatenate(pictures), edges[:-1], edges[1:])
    with LogWriter(folder / "drive.mcap", Ledger("drive.mcap")) as writer:
        writer.add_topic(Topic("/camera", "crosscue/Images", "columns"))
        shown = Images(rows, ("png",) * len(pictures))
        writer.write(Block("/camera", np.array(times), shown))
    write_coco(folder / "objects.json", images, signs)
    return folder


@pytest.mark.slow
def test_fit_signs_on_drives_reports_an_interval_by_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fitted = coco(tmp_path / "a", range(4))
    drives = [str(drive(tmp_path / f"d{i}", range(10 * i, 10 * i + 2))) for i in range(6)]
    left = ["--label", "one way left", "--json"]

    assert run(["fit", "signs", str(fitted), "--test", *drives, *left]) == 0
    whole = json.loads(capsys.readouterr().out)["other_frames"]
    assert run(["fit", "signs", drives[0], "--test", *drives, *left, "--test-every", "2"]) == 0
    half = json.loads(capsys.readouterr().out)

    assert whole["signs"] == half["other_frames"]["signs"] == 6
    assert half["chosen_on"]["signs"] == 1
    low, high = whole["recall_interval_by_drive"]
    assert 0.0 <= low <= whole["recall"] <= high <= 1.0


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("a.png,stop,1,2,x,4", "labels.csv:2: expected four numbers"),
        ("a.png,stop,9,2,3,4", "expected x0 < x1"),
        ("a.png,stop,1,2,3,4", "check the picture column"),
        ("labels.csv,stop,1,2,3,4", "not a JPEG, PNG or WebP picture"),
    ],
)
def test_invalid_label_rows_are_reported_on_one_line(
    tmp_path: Path, row: str, message: str
) -> None:
    labels = tmp_path / "labels.csv"
    labels.write_text(f"picture,label,x0,y0,x1,y1\n{row}\n")

    assert message in refusal(4, "fit", "signs", labels, "--label", "stop")


def test_threshold_is_the_lowest_that_meets_the_precision() -> None:
    judged = Verdicts(np.array([0.9, 0.8, 0.7, 0.6]), np.array([True, True, False, True]), 4)

    assert threshold_at_precision(judged, 0.95) == 0.8
    assert threshold_at_precision(judged, 0.6) == 0.6
    assert rates_at(judged, 0.8).precision == 1.0
    assert rates_at(judged, 0.8).recall == 0.5
    assert threshold_at_precision(Verdicts(np.array([0.9]), np.array([False]), 1), 0.95) is None


def test_detector_drawings_do_not_depend_on_the_opencv_version() -> None:
    grey = b"".join(one.grey.tobytes() for one in drawings())

    assert hashlib.sha256(grey).hexdigest()[:12] == "43c98c5fd7d6"
