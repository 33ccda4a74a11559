"""Signs: drawings, detection, the choice of its threshold, and the second look."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from crosscue.detectors.base import Detections, Frame
from crosscue.detectors.boxes import box_ious
from crosscue.detectors.signs.detector import build, orb_points
from crosscue.detectors.signs.matching import nearest, window_counts
from crosscue.detectors.signs.second_look import (
    OTHER_SIGNS,
    look_at_light,
    look_at_sign,
    with_looks,
)
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


RED, WHITE, ORANGE, YELLOW, GREY = (
    (30, 30, 190), (235, 235, 235), (20, 120, 240), (30, 200, 240), (150, 155, 160)
)  # fmt: skip
SIDE = 240


def sign(kind: str) -> Bytes:
    """A drawn sign that fills its picture, on a street's green and grey."""
    picture = np.full((SIDE, SIDE, 3), (90, 110, 100), np.uint8)
    angle = np.pi / 8 + np.arange(8) * np.pi / 4
    octagon = 120 + 118 / np.cos(np.pi / 8) * np.stack([np.cos(angle), np.sin(angle)], 1)
    diamond = np.array([[120, 2], [238, 120], [120, 238], [2, 120]], np.int32)
    if kind in ("stop", "back"):
        cv2.fillPoly(picture, [octagon.astype(np.int32)], WHITE if kind == "stop" else GREY)
    if kind == "stop":
        cv2.fillPoly(picture, [(120 + 0.93 * (octagon - 120)).astype(np.int32)], RED)
        # Four letters of strokes, because versions of OpenCV draw text differently.
        for x in (28, 78, 128, 178):
            cv2.rectangle(picture, (x, 82), (x + 34, 158), WHITE, 11)
    if kind == "no entry":
        cv2.circle(picture, (120, 120), 116, RED, -1)
        cv2.rectangle(picture, (28, 100), (212, 140), WHITE, -1)
    if kind == "red detour":
        cv2.rectangle(picture, (10, 10), (230, 230), (10, 40, 230), -1)
        for x in (28, 78, 128, 178):
            cv2.rectangle(picture, (x, 82), (x + 34, 158), (20, 20, 60), 11)
    if kind in ("detour", "signal ahead"):
        cv2.fillPoly(picture, [diamond], ORANGE if kind == "detour" else YELLOW)
        cv2.rectangle(picture, (95, 80), (145, 160), (20, 20, 20), 8)
    return picture


def seen(kind: str, side_px: int, light: float = 1.0) -> tuple[Bytes, NDArray[np.float64]]:
    """A picture with a sign of ``side_px``, and its box."""
    small = cv2.resize(sign(kind), (side_px, side_px), interpolation=cv2.INTER_AREA)
    picture = np.full((side_px + 60, side_px + 80, 3), (90, 110, 100), np.uint8)
    picture[30 : 30 + side_px, 40 : 40 + side_px] = small
    dimmed = np.asarray(np.clip(picture * light, 0, 255), np.uint8)
    return dimmed, np.array([40.0, 30.0, 40.0 + side_px, 30.0 + side_px])


@pytest.mark.parametrize("side_px", [14, 20, 33, 64, 150])
@pytest.mark.parametrize("light", [0.4, 1.0, 1.2])
@pytest.mark.parametrize(
    ("kind", "look"),
    [
        ("stop", "stop"),
        ("no entry", "bar"),
        ("detour", "orange"),
        # Sunlit, the orange of a work-zone sign is red: only its letters tell.
        ("red detour", "plain"),
        ("signal ahead", "yellow"),
        ("back", "pale"),
    ],
)
def test_look_tells_signs_apart(kind: str, look: str, side_px: int, light: float) -> None:
    assert look_at_sign(*seen(kind, side_px, light)) == look


@pytest.mark.parametrize("side_px", [14, 33, 150])
def test_stop_sign_in_a_box_that_is_not_exact_looks_like_no_other(side_px: int) -> None:
    picture, box = seen("stop", side_px)
    rng = np.random.default_rng(1)
    looks = [look_at_sign(picture, box + rng.normal(0.0, 0.05 * side_px, 4)) for _ in range(100)]

    assert not {*OTHER_SIGNS} & {*looks}
    assert looks.count("stop") > 80


def test_small_dark_and_grey_signs_are_unknown() -> None:
    picture, box = seen("stop", 40)

    assert look_at_sign(np.ascontiguousarray(picture[..., 0]), box) == "unknown"
    assert look_at_sign(*seen("stop", 10)) == "unknown"
    assert look_at_sign(*seen("stop", 40, 0.1)) == "unknown"


def test_only_signs_and_lights_are_looked_at_in_the_scale_of_the_decoded_picture() -> None:
    picture, box = seen("no entry", 60)
    frame = Frame(0, "front", picture, (2 * picture.shape[1], 2 * picture.shape[0]))
    boxes = np.array([2.0 * box, 2.0 * box, 2.0 * box])
    labels = ("stop sign", "traffic light", "car")
    found = Detections(0, frame.size_px, boxes, np.ones(3), labels, (b"", b"", b""))

    assert with_looks(found, frame, labels[:1], labels[1:2]).looks == ("bar", "", "")
    assert with_looks(found, frame, ("halt",), ("lamp",)) is found


@pytest.mark.parametrize("housing", [(40, 40, 40), YELLOW])
@pytest.mark.parametrize("side_px", [36, 60, 150])
def test_light_drawn_on_a_yellow_sign_is_no_light(
    side_px: int, housing: tuple[int, int, int]
) -> None:
    """Boxes are of the drawing or of the whole sign; a yellow housing has no sign around it."""
    picture, whole = seen("signal ahead", side_px)
    drawing = whole + side_px * np.array([0.38, 0.3, -0.38, -0.3])
    street = np.full_like(picture, 110)
    x0, y0, x1, y1 = np.rint(drawing).astype(int).tolist()
    street[y0:y1, x0:x1] = housing

    assert look_at_light(picture, drawing) == look_at_light(picture, whole) == "yellow"
    assert look_at_light(street, drawing) == ""
    assert look_at_light(np.ascontiguousarray(picture[..., 0]), whole) == ""
    assert look_at_light(picture, np.zeros(4)) == ""


@pytest.mark.parametrize("kind", ["back", "no entry"])
def test_headlamps_at_night_leave_neither_red_nor_letters_to_tell_by(kind: str) -> None:
    picture, box = seen(kind, 40)
    day = look_at_sign(picture, box)
    picture[:] = np.where(np.all(picture == (90, 110, 100), axis=2)[..., None], 12, picture)

    assert day in OTHER_SIGNS
    assert look_at_sign(picture, box) == "unknown"


def test_look_at_sign_at_the_edge_uses_what_is_visible() -> None:
    picture, box = seen("stop", 60)
    aside = np.ascontiguousarray(picture[:, 43:])

    assert look_at_sign(aside, box - np.array([43.0, 0.0, 43.0, 0.0])) == "stop"
